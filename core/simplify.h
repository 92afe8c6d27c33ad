/* Bounded-error simplification of a patch whose border is settled (law L5).
 *
 * The surface stays within the tolerance both ways: every vertex that goes is kept in the list of a triangle near it
 * and tested against every triangle that takes that one's place; for the way back the mean squared distance of a
 * vertex to the planes it stands for is bounded too. */
#ifndef FACET_CORE_SIMPLIFY_H
#define FACET_CORE_SIMPLIFY_H

#include "core/border.h"
#include "core/distance.h"
#include "core/halfedge.h"
#include "core/nearby.h"
#include "core/quadric.h"

/* A plane: normal * p + offset = 0, lattice units, unit normal. */
struct region_plane {
	struct vec3 normal;
	double offset;
};

struct simplify {
	struct halfedge_mesh mesh;
	struct border border;
	struct vec3 *origin;     /* [nv] where the vertex was in the raw mesh, lattice units */
	struct quadric *quadric; /* [nv] of the raw triangles it stands for */
	bool *fixed;             /* [nv] neither moves nor goes */
	uint32_t *points;        /* [cap_nt] vertices that went, tested against this triangle: first of a list */
	uint32_t *rim_points;    /* [3 cap_nt] vertices that went from this half-edge of an open rim */
	uint32_t *next_point;    /* [nv] */
	uint32_t *plane;         /* [cap_nt] planar region, or UINT32_MAX */
	struct region_plane *region;
	struct nearby nearby;
	double tolerance_squared; /* lattice units, squared */
	double rim_squared;       /* how far an open rim may move sideways, squared */
};

/* Loads `raw` with the border found for it. 0 or -ENOMEM. */
int simplify_init(struct simplify *, const struct surface *raw, const struct border *border, double tolerance,
                  struct arena *arena);

/* Marks as fixed what must stay, once the border is fitted. */
void simplify_settle(struct simplify *);

/* Collapses as long as the bounds allow. 0 or -ENOMEM. */
int simplify_collapse(struct simplify *, struct arena *arena);

/* The place of a vertex as doubles. */
static inline struct vec3 simplify_place(const struct simplify *s, uint32_t v)
{
	const int32_t *p = s->mesh.position[v];
	return (struct vec3){p[0], p[1], p[2]};
}

#endif

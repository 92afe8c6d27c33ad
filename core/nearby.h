/* Whether a place has a raw vertex within a cell or so: what keeps new triangles from bridging where nothing was. */
#ifndef FACET_CORE_NEARBY_H
#define FACET_CORE_NEARBY_H

#include "core/arena.h"
#include "core/cubes.h"
#include "core/vec.h"

struct nearby {
	uint32_t *first; /* per cell of the patch: a vertex, or UINT32_MAX */
	uint32_t *next;  /* per vertex */
	const uint16_t (*vertex)[3];
};

/* Refers to `raw`, which must live as long. 0 or -ENOMEM. */
int nearby_init(struct nearby *, const struct surface *raw, struct arena *arena);

/* Whether a raw vertex lies within NEARBY_REACH of p. */
#define NEARBY_REACH (0.95 * LATTICE)
bool nearby_has(const struct nearby *, struct vec3 p);

/* Into how many parts a segment is cut to be looked at, at most 1.2 cells long; one where its ends vouch for it. */
int nearby_parts(double length_squared);

/* Whether the points between the parts of the segment from a are near raw vertices. */
bool nearby_has_segment(const struct nearby *, struct vec3 a, struct vec3 along, int parts);

#endif

/* A half-edge mesh over the triangles of one patch.
 *
 * Half-edge 3 t + k runs from corner k to corner k + 1 of triangle t; its twin runs the other way in the neighbour, or
 * is HALFEDGE_NONE at a border. Every vertex has the list of the half-edges that leave it, so that a vertex where two
 * fans touch (diagonally opposite complete cells) needs no copy. Slots of removed triangles stay, marked. */
#ifndef FACET_CORE_HALFEDGE_H
#define FACET_CORE_HALFEDGE_H

#include "core/arena.h"
#include "core/cubes.h"

#define HALFEDGE_NONE UINT32_MAX

struct halfedge_mesh {
	uint32_t nv, nt, cap_nt; /* slots, those of removed ones included */
	int32_t (*position)[3];  /* [nv] lattice */
	uint32_t *first;         /* [nv] a half-edge that leaves it; HALFEDGE_NONE: the vertex is in no triangle */
	uint32_t *origin;        /* [3 nt] vertex; HALFEDGE_NONE in a removed triangle */
	uint32_t *twin;          /* [3 nt] */
	uint32_t *next_leaving;  /* [3 nt] next half-edge that leaves the same vertex */
	uint32_t *mark, stamp;   /* [nv] scratch of the link condition */
};

static inline uint32_t halfedge_next(uint32_t h)
{
	return h % 3 == 2 ? h - 2 : h + 1;
}

static inline uint32_t halfedge_previous(uint32_t h)
{
	return h % 3 == 0 ? h + 2 : h - 1;
}

static inline uint32_t halfedge_target(const struct halfedge_mesh *mesh, uint32_t h)
{
	return mesh->origin[halfedge_next(h)];
}

/* The end of h that is not v. */
static inline uint32_t halfedge_other(const struct halfedge_mesh *mesh, uint32_t h, uint32_t v)
{
	return mesh->origin[h] == v ? halfedge_target(mesh, h) : mesh->origin[h];
}

static inline bool halfedge_alive(const struct halfedge_mesh *mesh, uint32_t triangle)
{
	return mesh->origin[3 * triangle] != HALFEDGE_NONE;
}

#define HALFEDGE_EACH(mesh, h, v) for (uint32_t h = (mesh)->first[v]; h != HALFEDGE_NONE; h = (mesh)->next_leaving[h])

/* Room for `spare` triangles more than `surface` has. 0, -ENOMEM, or -EINVAL where an edge has more than two faces or
 * two of one direction. */
int halfedge_build(const struct surface *surface, uint32_t spare, struct arena *arena, struct halfedge_mesh *ret);

/* The half-edge from a to b, or HALFEDGE_NONE. */
uint32_t halfedge_find(const struct halfedge_mesh *mesh, uint32_t a, uint32_t b);
bool halfedge_joined(const struct halfedge_mesh *mesh, uint32_t a, uint32_t b); /* in either direction */

/* The half-edge without a twin that leaves v (or ends in v), or HALFEDGE_NONE. The first one at a touching vertex. */
uint32_t halfedge_border_from(const struct halfedge_mesh *mesh, uint32_t v);
uint32_t halfedge_border_into(const struct halfedge_mesh *mesh, uint32_t v);
uint32_t halfedge_valence(const struct halfedge_mesh *mesh, uint32_t v); /* triangles at v */

/* Adds or removes a triangle and links it with its neighbours. No half-edge of an added one may exist yet;
 * `slot` is that of a removed triangle or mesh->nt (which then grows; within cap_nt). */
void halfedge_add(struct halfedge_mesh *mesh, uint32_t slot, uint32_t a, uint32_t b, uint32_t c);
void halfedge_remove(struct halfedge_mesh *mesh, uint32_t triangle);

/* Turns the edge of h, which has a twin, to the other diagonal, which must not exist yet: (tip of h, origin of h, tip of the
 * twin) takes the slot of h, the other triangle that of the twin. As removing both and adding these. */
void halfedge_flip(struct halfedge_mesh *mesh, uint32_t h);

/* The triangles at vertex v, in the order of its list: half-edge h[k] runs from v to x[k], the third corner is y[k]. */
#define HALFEDGE_RING_MAX 64
struct halfedge_ring {
	uint32_t v, n;
	uint32_t tail; /* of a border vertex: the neighbour that is no x; or HALFEDGE_NONE */
	uint32_t h[HALFEDGE_RING_MAX], x[HALFEDGE_RING_MAX], y[HALFEDGE_RING_MAX];
};

/* false where v has more than HALFEDGE_RING_MAX triangles. */
bool halfedge_gather(const struct halfedge_mesh *mesh, uint32_t v, struct halfedge_ring *ret);

/* Whether moving the vertex of `ring`, an end of h, into the other end keeps a surface: their common neighbours are just
 * the tips of the triangles at h, a border vertex moves along its border only, no triangle is left alone or doubled. The
 * neighbours of the other end must be marked; the vertex must not be a touching one. */
bool halfedge_may_collapse(const struct halfedge_mesh *mesh, const struct halfedge_ring *ring, uint32_t h);

/* Does it. Triangles keep their slots; those at h are removed. */
void halfedge_collapse(struct halfedge_mesh *mesh, uint32_t h, uint32_t v);

/* Gives the neighbours of v the mark mesh->stamp, fresh. Returns how many triangles v has. */
uint32_t halfedge_mark_ring(struct halfedge_mesh *mesh, uint32_t v);

static inline bool halfedge_marked(const struct halfedge_mesh *mesh, uint32_t v)
{
	return mesh->mark[v] == mesh->stamp;
}

/* NULL, or the first invariant that does not hold, as a sentence. For tests and asserts. */
const char *halfedge_check(const struct halfedge_mesh *mesh);

#endif

/* Corners inside go one by one, each along an edge, as long as every triangle keeps its turn in the plane, no edge comes to
 * lie in a patch face and none is doubled: what stands is a triangulation at every moment, whatever the outline is like.
 * (To cut ears off the outline is less sure: where a surface runs along a patch face, diagonals from hole to hole are forbidden,
 * and a third of the regions of a noisy floor had no other.) Distances are not asked for on the way. At the end every
 * corner that went is handed to the triangle over or under it; one that is too far from that comes back, the farthest of
 * each triangle first, until none is too far.
 *
 * No triangle is turned against the plane in the projection along its dominant axis, before or after, so both cover the same
 * points as often. The projection leaves a coordinate out, which is exact. */
#include "core/slab.h"

#include <errno.h>
#include <math.h>
#include <string.h>

#include "core/guard.h"
#include "core/predicates.h"

#define NONE       UINT32_MAX
#define STRIPS     (PATCH_SIDE + 1)
#define PASSES_MAX 4
#define FLIPS_MAX  8  /* per edge, against rings of equal circles */
#define ROUNDS_MAX 12 /* of corners that come back */

/* A triangle as it was: half-edges' origins and twins. */
struct former {
	uint32_t slot, origin[3], twin[3];
};

static void project_vertices(struct slab *slab)
{
	int first = (slab->axis + 1) % 3, second = (slab->axis + 2) % 3;
	for (uint32_t k = 0; k < slab->nv; k++) {
		const int32_t *p = slab->s->mesh.position[slab->vertex[k]];
		int32_t *at = slab->projected[slab->vertex[k]];
		at[0] = p[slab->mirrored ? second : first];
		at[1] = p[slab->mirrored ? first : second];
	}
}

/* Whether all triangles of a vertex are of the slab and go once around it. */
static bool inside(const struct slab *slab, const struct halfedge_ring *ring)
{
	bool all = ring->tail == HALFEDGE_NONE;
	for (uint32_t k = 0; k < ring->n; k++)
		all &= slab->region[ring->h[k] / 3] == slab->number;
	return all;
}

/* Whether the triangles of the ring that stay keep their turn when its vertex moves into u. */
static bool turns_stay(const struct slab *slab, const struct halfedge_ring *ring, uint32_t u)
{
	const int32_t *p = slab->projected[u];
	for (uint32_t k = 0; k < ring->n; k++)
		if (ring->x[k] != u && ring->y[k] != u &&
		    orientation(p, slab->projected[ring->x[k]], slab->projected[ring->y[k]]) <= 0)
			return false;
	return true;
}

/* Moves the vertex of the ring into its nearest neighbour that will do; false where none will. */
static bool take_out(struct slab *slab, const struct halfedge_ring *ring)
{
	struct halfedge_mesh *mesh = &slab->s->mesh;
	int64_t distance[HALFEDGE_RING_MAX];
	for (uint32_t k = 0; k < ring->n; k++)
		distance[k] = distance_squared2(slab->projected[ring->v], slab->projected[ring->x[k]]);
	for (uint32_t tries = 0; tries < ring->n; tries++) {
		uint32_t best = 0;
		for (uint32_t k = 1; k < ring->n; k++)
			best = distance[k] < distance[best] ? k : best;
		uint32_t u = ring->x[best], h = ring->h[best];
		distance[best] = INT64_MAX;
		if (!turns_stay(slab, ring, u) || halfedge_mark_ring(mesh, u) + ring->n - 4 > GUARD_VALENCE_MAX ||
		    !guard_patch_faces(mesh, slab->s->border.faces, ring, u, HALFEDGE_NONE) ||
		    !halfedge_may_collapse(mesh, ring, h))
			continue;
		halfedge_collapse(mesh, h, ring->v);
		return true;
	}
	return false;
}

/* Triangles that stand come first in `taken` then. */
static void take_all_out(struct slab *slab)
{
	const struct halfedge_mesh *mesh = &slab->s->mesh;
	struct halfedge_ring ring;
	for (uint32_t pass = 0, gone = 1; gone && pass < PASSES_MAX; pass++) {
		gone = 0;
		for (uint32_t k = 0; k < slab->nv; k++) {
			uint32_t v = slab->vertex[k];
			if (mesh->first[v] != HALFEDGE_NONE && halfedge_gather(mesh, v, &ring) && inside(slab, &ring))
				gone += take_out(slab, &ring);
		}
	}
	slab->standing = 0;
	for (uint32_t k = 0; k < slab->n; k++) {
		uint32_t t = slab->taken[k];
		if (!halfedge_alive(mesh, t))
			continue;
		slab->taken[k] = slab->taken[slab->standing];
		slab->taken[slab->standing++] = t;
	}
}

/* The edges of triangle t are to be looked at, from either side. */
static void want_look(struct slab *slab, uint32_t t)
{
	for (uint32_t h = 3 * t; h < 3 * t + 3; h++) {
		slab->settled[h] = false;
		if (slab->s->mesh.twin[h] != HALFEDGE_NONE)
			slab->settled[slab->s->mesh.twin[h]] = false;
	}
}

/* Turns the edge of h to the other diagonal of its two triangles where Delaunay wants it and it is allowed. An edge that
 * Delaunay keeps is settled, on both sides, until one of its triangles changes. */
static bool flip(struct slab *slab, uint32_t h)
{
	struct halfedge_mesh *mesh = &slab->s->mesh;
	uint32_t twin = mesh->twin[h];
	if (slab->settled[h])
		return false;
	if (twin == HALFEDGE_NONE || slab->region[twin / 3] != slab->region[h / 3]) {
		slab->settled[h] = true;
		return false;
	}
	uint32_t a = mesh->origin[h], b = mesh->origin[twin];
	uint32_t c = mesh->origin[halfedge_previous(h)], d = mesh->origin[halfedge_previous(twin)];
	const int32_t *pa = slab->projected[a], *pb = slab->projected[b], *pc = slab->projected[c],
	              *pd = slab->projected[d];
	if (in_circle(pa, pb, pc, pd) <= 0 || orientation(pc, pa, pd) <= 0 || orientation(pd, pb, pc) <= 0) {
		slab->settled[h] = slab->settled[twin] = true;
		return false;
	}
	const uint8_t *faces = slab->s->border.faces;
	if ((faces[c] & faces[d]) || c == d || halfedge_joined(mesh, c, d))
		return false;
	halfedge_flip(mesh, h);
	want_look(slab, h / 3);
	want_look(slab, twin / 3);
	return true;
}

static void make_delaunay(struct slab *slab)
{
	for (uint32_t round = 0, flips = 1; flips && round < FLIPS_MAX; round++) {
		flips = 0;
		for (uint32_t k = 0; k < slab->standing; k++)
			for (uint32_t corner = 0; corner < 3; corner++)
				flips += flip(slab, 3 * slab->taken[k] + corner);
	}
}

/* A triangle as its three half-planes: coefficients of x, y and 1, none negative inside. */
struct cover {
	int32_t edge[3][3];
	bool made; /* `flat` is */
	struct flat flat;
	double farthest; /* squared distance of `far`; 0: nobody is too far */
	uint32_t far;
};

/* The standing triangles; a bit each for those that reach into a strip of one cell, along either axis. */
struct covers {
	struct cover *cover;
	uint64_t *strip[2][STRIPS]; /* [words] */
	uint32_t n, words;
	bool far; /* somebody is too far */
};

static void cover_make(const struct slab *slab, uint32_t t, struct cover *ret)
{
	const uint32_t *corner = slab->s->mesh.origin + 3 * t;
	for (int k = 0; k < 3; k++) {
		const int32_t *a = slab->projected[corner[k]], *b = slab->projected[corner[(k + 1) % 3]];
		ret->edge[k][0] = a[1] - b[1];
		ret->edge[k][1] = b[0] - a[0];
		ret->edge[k][2] = a[0] * b[1] - a[1] * b[0];
	}
	ret->made = false;
	ret->farthest = 0;
}

static void note_strips(const struct slab *slab, struct covers *covers, uint32_t k)
{
	const uint32_t *corner = slab->s->mesh.origin + 3 * slab->taken[k];
	const int32_t *a = slab->projected[corner[0]], *b = slab->projected[corner[1]], *c = slab->projected[corner[2]];
	for (int axis = 0; axis < 2; axis++) {
		int32_t low = a[axis] < b[axis] ? a[axis] : b[axis], high = a[axis] < b[axis] ? b[axis] : a[axis];
		low = c[axis] < low ? c[axis] : low;
		high = c[axis] > high ? c[axis] : high;
		for (int32_t strip = low / LATTICE; strip <= high / LATTICE; strip++)
			covers->strip[axis][strip][k / 64] |= (uint64_t)1 << k % 64;
	}
}

static int covers_make(const struct slab *slab, struct covers *ret)
{
	uint32_t words = (slab->standing + 63) / 64;
	uint64_t *bits = ARENA_NEW(slab->arena, uint64_t, 2 * STRIPS * words);
	*ret = (struct covers){
	    .cover = ARENA_TAKE(slab->arena, struct cover, slab->standing), .n = slab->standing, .words = words};
	if (!bits || !ret->cover)
		return -ENOMEM;
	for (uint32_t k = 0; k < 2 * STRIPS; k++)
		ret->strip[k / STRIPS][k % STRIPS] = bits + k * words;
	for (uint32_t k = 0; k < slab->standing; k++) {
		cover_make(slab, slab->taken[k], &ret->cover[k]);
		note_strips(slab, ret, k);
	}
	return 0;
}

/* Sides are taken together: which one refuses is a coin's toss that no processor foresees. */
static bool covers_point(const struct cover *cover, const int32_t p[2])
{
	int32_t side[3];
	for (int k = 0; k < 3; k++)
		side[k] = cover->edge[k][0] * p[0] + cover->edge[k][1] * p[1] + cover->edge[k][2];
	return (side[0] | side[1] | side[2]) >= 0;
}

static double distance_squared(const struct slab *slab, struct cover *cover, uint32_t t, uint32_t v)
{
	const uint32_t *corner = slab->s->mesh.origin + 3 * t;
	if (!cover->made)
		cover->flat = flat_make(slab->place[corner[0]], slab->place[corner[1]], slab->place[corner[2]]);
	cover->made = true;
	return flat_distance_squared(&cover->flat, slab->s->origin[v]);
}

/* Hands vertex v, which went, to the first triangle over or under it that is near enough; where none is, the nearest of
 * them notes it. -EDOM where there is none at all. */
static int hand_over(struct slab *slab, uint32_t v, struct covers *covers)
{
	struct simplify *s = slab->s;
	const uint64_t *column = covers->strip[0][slab->projected[v][0] / LATTICE];
	const uint64_t *row = covers->strip[1][slab->projected[v][1] / LATTICE];
	struct cover *nearest = NULL;
	double least = INFINITY;
	for (uint32_t word = 0; word < covers->words; word++)
		for (uint64_t near = column[word] & row[word]; near; near &= near - 1) {
			uint32_t k = 64 * word + (uint32_t)__builtin_ctzll(near), t = slab->taken[k];
			struct cover *cover = &covers->cover[k];
			if (!covers_point(cover, slab->projected[v]))
				continue;
			double squared = distance_squared(slab, cover, t, v);
			if (squared <= s->tolerance_squared) {
				s->next_point[v] = s->points[t];
				s->points[t] = v;
				return 0;
			}
			nearest = squared < least ? cover : nearest;
			least = squared < least ? squared : least;
		}
	if (!nearest)
		return -EDOM;
	covers->far = true;
	if (least > nearest->farthest) {
		nearest->farthest = least;
		nearest->far = v;
	}
	return 0;
}

/* The corners that went, in the triangles that stand. 0, -EDOM or -ENOMEM. */
static int hand_over_all(struct slab *slab, struct covers *covers)
{
	int r = covers_make(slab, covers);
	for (uint32_t k = 0; !r && k < slab->standing; k++)
		slab->s->points[slab->taken[k]] = NONE;
	for (uint32_t k = 0; !r && k < slab->nv; k++)
		if (slab->s->mesh.first[slab->vertex[k]] == HALFEDGE_NONE)
			r = hand_over(slab, slab->vertex[k], covers);
	return r;
}

static void stand(struct slab *slab, uint32_t slot, uint32_t a, uint32_t b, uint32_t c)
{
	halfedge_add(&slab->s->mesh, slot, a, b, c);
	want_look(slab, slot);
}

static uint32_t next_slot(struct slab *slab)
{
	return slab->taken[slab->standing++];
}

/* Makes v, which lies within triangle t, a corner of three in its place. */
static void split_triangle(struct slab *slab, uint32_t t, uint32_t v)
{
	const uint32_t *corner = slab->s->mesh.origin + 3 * t, a = corner[0], b = corner[1], c = corner[2];
	halfedge_remove(&slab->s->mesh, t);
	stand(slab, t, a, b, v);
	stand(slab, next_slot(slab), b, c, v);
	stand(slab, next_slot(slab), c, a, v);
}

/* The same of v on the edge of h; what the triangle behind it has noted is out of date then. -EDOM where none of the slab is. */
static int split_edge(struct slab *slab, struct covers *covers, uint32_t h, uint32_t v)
{
	struct halfedge_mesh *mesh = &slab->s->mesh;
	uint32_t twin = mesh->twin[h], t = h / 3, u = twin / 3;
	if (twin == HALFEDGE_NONE || slab->region[u] != slab->number)
		return -EDOM;
	uint32_t a = mesh->origin[h], b = mesh->origin[twin];
	uint32_t c = mesh->origin[halfedge_previous(h)], d = mesh->origin[halfedge_previous(twin)];
	for (uint32_t k = 0; k < covers->n; k++)
		if (slab->taken[k] == u)
			covers->cover[k].farthest = 0;
	halfedge_remove(mesh, t);
	halfedge_remove(mesh, u);
	stand(slab, t, a, v, c);
	stand(slab, u, v, a, d);
	stand(slab, next_slot(slab), v, b, c);
	stand(slab, next_slot(slab), b, v, d);
	return 0;
}

/* Vertex v, which lies over triangle t, is a corner again; it left two slots when it went. */
static int bring_back(struct slab *slab, struct covers *covers, uint32_t t, uint32_t v)
{
	const uint32_t *corner = slab->s->mesh.origin + 3 * t;
	uint32_t edge = 0, edges = 0;
	for (uint32_t k = 0; k < 3; k++)
		if (!orientation(slab->projected[corner[k]], slab->projected[corner[(k + 1) % 3]],
		                 slab->projected[v])) {
			edge = k;
			edges++;
		}
	if (edges > 1)
		return -EDOM;
	if (edges)
		return split_edge(slab, covers, 3 * t + edge, v);
	split_triangle(slab, t, v);
	return 0;
}

/* 0, -EDOM or -ENOMEM. */
static int settle(struct slab *slab)
{
	for (int round = 0; round < ROUNDS_MAX; round++) {
		struct covers covers;
		make_delaunay(slab);
		int r = hand_over_all(slab, &covers);
		for (uint32_t k = 0; !r && k < covers.n; k++)
			if (covers.cover[k].farthest > 0)
				r = bring_back(slab, &covers, slab->taken[k], covers.cover[k].far);
		if (r || !covers.far)
			return r;
	}
	return -EDOM;
}

static struct former *remember(const struct slab *slab)
{
	const struct halfedge_mesh *mesh = &slab->s->mesh;
	struct former *former = ARENA_TAKE(slab->arena, struct former, slab->n);
	for (uint32_t k = 0; former && k < slab->n; k++) {
		former[k].slot = slab->taken[k];
		memcpy(former[k].origin, mesh->origin + 3 * slab->taken[k], sizeof former[k].origin);
		memcpy(former[k].twin, mesh->twin + 3 * slab->taken[k], sizeof former[k].twin);
	}
	return former;
}

/* Puts the triangles back as halfedge_add does one by one, but knows their twins. */
static void restore(struct slab *slab, const struct former *former)
{
	struct halfedge_mesh *mesh = &slab->s->mesh;
	for (uint32_t k = 0; k < slab->n; k++) {
		if (halfedge_alive(mesh, slab->taken[k]))
			halfedge_remove(mesh, slab->taken[k]);
		slab->s->points[slab->taken[k]] = NONE;
	}
	for (uint32_t k = 0; k < slab->n; k++)
		for (uint32_t corner = 0; corner < 3; corner++) {
			uint32_t h = 3 * former[k].slot + corner, v = former[k].origin[corner],
			         twin = former[k].twin[corner];
			mesh->origin[h] = v;
			mesh->next_leaving[h] = mesh->first[v];
			mesh->first[v] = h;
			mesh->twin[h] = twin;
			if (twin != HALFEDGE_NONE)
				mesh->twin[twin] = h;
		}
}

int slab_thin(struct slab *slab)
{
	struct former *former = remember(slab);
	if (!former)
		return -ENOMEM;
	project_vertices(slab);
	take_all_out(slab);
	int r = settle(slab);
	if (r)
		restore(slab, former);
	return r;
}

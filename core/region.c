/* Regions grow over the mesh, from where it is densest in flat vertices.
 *
 * Bins of 4 cells are tried by the number of their vertices: a plane is fitted to a bin, and from one of its
 * triangles on the region takes every neighbour whose three corners lie in the slab about the plane and whose normal is within 60
 * degrees of the plane's. The plane is then fitted to what it took, and it grows once more.
 *
 * All corners lie in a slab of half the tolerance to both sides, and all triangles face the plane's way in the
 * projection along the dominant axis. So any triangulation of the outline whose triangles face that way too covers
 * the same points as often, and none is moved by more than the tolerance (smoothed vertices are measured nevertheless).
 * The outline goes to integers by leaving out one coordinate, hence exactly. The triangles are then turned to Delaunay's,
 * as far as diagonals are allowed: none within a patch face, none that the mesh has elsewhere. */
#include "core/region.h"

#include <assert.h>
#include <errno.h>
#include <string.h>

#include "core/contour.h"
#include "core/predicates.h"
#include "core/triangulate.h"

#define NONE          UINT32_MAX
#define BIN_CELLS     4
#define BINS_SIDE     (PATCH_SIDE / BIN_CELLS)
#define BINS          (BINS_SIDE * BINS_SIDE * BINS_SIDE)
#define SEED_MIN      12   /* vertices of a bin */
#define REGION_MIN    16   /* vertices of a region */
#define SLAB_SHARE    0.5  /* of the tolerance, to either side */
#define SEED_SPREAD   0.35 /* variance of a bin about its plane, in squared slabs */
#define COSINE_WITHIN 0.5  /* 60 degrees */
#define COSINE_DOUBT  1e-9 /* of squares of cosines: far beyond all roundings */
#define STRIPS        (PATCH_SIDE + 1)
#define FLIPS_MAX     8 /* per edge, against rings of equal circles */

/* Between these the square of theta swallows the 1 that Jacobi adds to it, and that of t is swallowed: the roots need not be
 * taken, the bits are the same. */
#define THETA_LARGE 0x1p28
#define THETA_HUGE  0x1p500

/* The normal of a triangle, twice its area long, and the square of that. */
struct turn {
	struct vec3 normal;
	double squared;
};

struct grower {
	struct simplify *s;
	struct arena *arena;
	struct vec3 *place;      /* [nv] */
	struct turn *turn;       /* [nt] */
	uint32_t *region;        /* [cap_nt] number, or NONE */
	uint32_t *taken, n;      /* triangles of the region that grows */
	uint8_t *entry;          /* which of their half-edges the region came over */
	uint32_t *vertex, nv;    /* its vertices */
	uint32_t *seen, stamp;   /* [nv] */
	int32_t (*projected)[2]; /* [nv] vertices of the region in its plane */
	bool *settled;           /* [3 nt] half-edges that Delaunay keeps */
	struct vec3 *point;      /* scratch of fits */
	double slab;
	struct region_plane plane;
	int axis; /* the dominant one, left out in the projection */
	bool mirrored;
};

/* One rotation of Jacobi's method: makes m[p][q] zero. */
static void rotate(double m[3][3], double v[3][3], int p, int q)
{
	if (m[p][q] == 0)
		return;
	double theta = (m[q][q] - m[p][p]) / (2 * m[p][q]), size = fabs(theta), t, c = 1;
	if (size > THETA_LARGE && size < THETA_HUGE) {
		t = 0.5 / theta;
	} else {
		t = (theta >= 0 ? 1 : -1) / (size + sqrt(theta * theta + 1));
		c = 1 / sqrt(t * t + 1);
	}
	double s = t * c;
	for (int k = 0; k < 3; k++) {
		double a = m[k][p], b = m[k][q];
		m[k][p] = c * a - s * b;
		m[k][q] = s * a + c * b;
	}
	for (int k = 0; k < 3; k++) {
		double a = m[p][k], b = m[q][k];
		m[p][k] = c * a - s * b;
		m[q][k] = s * a + c * b;
		a = v[k][p];
		b = v[k][q];
		v[k][p] = c * a - s * b;
		v[k][q] = s * a + c * b;
	}
}

struct region_plane region_fit(const struct vec3 *point, uint32_t n, double *ret_variance)
{
	struct vec3 mean = {0, 0, 0};
	double m[3][3] = {{0}}, v[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
	for (uint32_t k = 0; k < n; k++)
		mean = vec3_add(mean, point[k]);
	mean = vec3_scale(mean, 1.0 / n);
	for (uint32_t k = 0; k < n; k++) {
		struct vec3 d = vec3_sub(point[k], mean);
		m[0][0] += d.x * d.x;
		m[0][1] += d.x * d.y;
		m[0][2] += d.x * d.z;
		m[1][1] += d.y * d.y;
		m[1][2] += d.y * d.z;
		m[2][2] += d.z * d.z;
	}
	m[1][0] = m[0][1];
	m[2][0] = m[0][2];
	m[2][1] = m[1][2];
	for (int sweep = 0; sweep < 6; sweep++) {
		rotate(m, v, 0, 1);
		rotate(m, v, 0, 2);
		rotate(m, v, 1, 2);
	}
	int least = m[1][1] < m[0][0] ? 1 : 0;
	least = m[2][2] < m[least][least] ? 2 : least;
	struct vec3 normal = {v[0][least], v[1][least], v[2][least]};
	*ret_variance = m[least][least] / n;
	return (struct region_plane){normal, -vec3_dot(normal, mean)};
}

static double height(const struct region_plane *plane, struct vec3 p)
{
	return vec3_dot(plane->normal, p) + plane->offset;
}

/* Smoothing moves vertices, and errors are measured from where they were: both places count. */
static bool in_slab(const struct grower *g, uint32_t v)
{
	return fabs(height(&g->plane, g->place[v])) <= g->slab && fabs(height(&g->plane, g->s->origin[v])) <= g->slab;
}

static void project_vertices(struct grower *g)
{
	int first = (g->axis + 1) % 3, second = (g->axis + 2) % 3;
	for (uint32_t k = 0; k < g->nv; k++) {
		const int32_t *p = g->s->mesh.position[g->vertex[k]];
		int32_t *at = g->projected[g->vertex[k]];
		at[0] = p[g->mirrored ? second : first];
		at[1] = p[g->mirrored ? first : second];
	}
}

static double component(struct vec3 v, int axis)
{
	return axis == 0 ? v.x : axis == 1 ? v.y : v.z;
}

static struct vec3 unit_normal(const struct turn *turn)
{
	return vec3_scale(turn->normal, 1 / sqrt(turn->squared));
}

/* Whether triangle t is in no region and turned the plane's way. The unit normal decides, but its root is taken only where
 * the angle is so near to the bound that roundings matter. */
static bool turned_alike(const struct grower *g, uint32_t t)
{
	const struct turn *turn = &g->turn[t];
	double along = component(turn->normal, g->axis);
	if (g->region[t] != NONE || !(g->mirrored ? along < 0 : along > 0))
		return false;
	double cosine = vec3_dot(turn->normal, g->plane.normal);
	double over = cosine * cosine - COSINE_WITHIN * COSINE_WITHIN * turn->squared;
	if (fabs(over) > COSINE_DOUBT * turn->squared)
		return cosine > 0 && over > 0;
	return vec3_dot(unit_normal(turn), g->plane.normal) >= COSINE_WITHIN;
}

static bool fits(const struct grower *g, uint32_t t)
{
	const uint32_t *corner = g->s->mesh.origin + 3 * t;
	return turned_alike(g, t) && in_slab(g, corner[0]) && in_slab(g, corner[1]) && in_slab(g, corner[2]);
}

static void choose_axis(struct grower *g)
{
	struct vec3 n = g->plane.normal;
	double x = fabs(n.x), y = fabs(n.y), z = fabs(n.z);
	g->axis = x >= y && x >= z ? 0 : y >= z ? 1 : 2;
	g->mirrored = component(n, g->axis) < 0;
}

static void take_vertex(struct grower *g, uint32_t v)
{
	g->seen[v] = g->stamp;
	g->vertex[g->nv++] = v;
}

/* The triangle of h, reached over h. */
static void take(struct grower *g, uint32_t h, uint32_t number)
{
	g->region[h / 3] = number;
	g->entry[g->n] = h % 3;
	g->taken[g->n++] = h / 3;
}

/* Takes the neighbour beyond h if it fits. Of its corners only the far one is new; one seen before lies in the slab. */
static void try_beyond(struct grower *g, uint32_t h, uint32_t number)
{
	const struct halfedge_mesh *mesh = &g->s->mesh;
	uint32_t twin = mesh->twin[h];
	if (twin == HALFEDGE_NONE || !turned_alike(g, twin / 3))
		return;
	uint32_t far = mesh->origin[halfedge_previous(twin)];
	if (g->seen[far] != g->stamp) {
		if (!in_slab(g, far))
			return;
		take_vertex(g, far);
	}
	take(g, twin, number);
}

/* From triangle `from`, which fits. */
static void grow(struct grower *g, uint32_t from, uint32_t number)
{
	g->n = g->nv = 0;
	g->stamp++;
	take(g, 3 * from, number);
	for (uint32_t k = 0; k < 3; k++)
		take_vertex(g, g->s->mesh.origin[3 * from + k]);
	for (uint32_t h = 3 * from; h < 3 * from + 3; h++)
		try_beyond(g, h, number);
	for (uint32_t k = 1; k < g->n; k++) {
		uint32_t h = 3 * g->taken[k], entry = g->entry[k];
		try_beyond(g, entry == 0 ? h + 1 : h, number);
		try_beyond(g, entry == 2 ? h + 1 : h + 2, number);
	}
}

static void let_go(struct grower *g)
{
	for (uint32_t k = 0; k < g->n; k++)
		g->region[g->taken[k]] = NONE;
}

/* Fits the plane to `n` vertices, facing the way of triangle t. The variance about it. */
static double fit(struct grower *g, const uint32_t *vertex, uint32_t n, uint32_t t)
{
	double variance;
	for (uint32_t k = 0; k < n; k++)
		g->point[k] = g->place[vertex[k]];
	g->plane = region_fit(g->point, n, &variance);
	if (vec3_dot(g->plane.normal, unit_normal(&g->turn[t])) < 0)
		g->plane = (struct region_plane){vec3_scale(g->plane.normal, -1), -g->plane.offset};
	choose_axis(g);
	return variance;
}

/* What the outline needs to be triangulated. */
struct outline {
	const struct grower *g;
	struct contour contour;
	int32_t (*point)[2];
};

static bool allows(const void *ctx, uint32_t a, uint32_t b)
{
	const struct outline *outline = ctx;
	uint32_t v = outline->contour.vertex[a], w = outline->contour.vertex[b];
	const struct simplify *s = outline->g->s;
	return v != w && !(s->border.faces[v] & s->border.faces[w]) && !halfedge_joined(&s->mesh, v, w);
}

static int64_t loop_area(const struct outline *outline, uint32_t first, uint32_t end)
{
	int64_t sum = 0;
	for (uint32_t k = first; k < end; k++) {
		const int32_t *a = outline->point[k], *b = outline->point[k + 1 < end ? k + 1 : first];
		sum += (int64_t)a[0] * b[1] - (int64_t)b[0] * a[1];
	}
	return sum;
}

static void place_outline(struct outline *outline)
{
	const struct contour *c = &outline->contour;
	for (uint32_t k = 0; k < c->n; k++)
		memcpy(outline->point[k], outline->g->projected[c->vertex[k]], sizeof outline->point[k]);
}

/* Puts the outer loop first. False where there is not exactly one. */
static bool order_loops(struct outline *outline, struct arena *arena)
{
	struct contour *c = &outline->contour, sorted = *c;
	uint32_t outer = NONE, outers = 0;
	for (uint32_t l = 0, first = 0; l < c->loops; first = c->loop_end[l++])
		if (loop_area(outline, first, c->loop_end[l]) > 0) {
			outer = l;
			outers++;
		}
	if (outers != 1)
		return false;
	if (outer == 0)
		return true;
	sorted.vertex = ARENA_TAKE(arena, uint32_t, c->n);
	sorted.loop_end = ARENA_TAKE(arena, uint32_t, c->loops);
	if (!sorted.vertex || !sorted.loop_end)
		return false;
	sorted.n = 0;
	for (uint32_t k = 0; k < c->loops; k++) {
		uint32_t l = k == 0 ? outer : k <= outer ? k - 1 : k, first = l ? c->loop_end[l - 1] : 0;
		for (uint32_t i = first; i < c->loop_end[l]; i++)
			sorted.vertex[sorted.n++] = c->vertex[i];
		sorted.loop_end[k] = sorted.n;
	}
	*c = sorted;
	place_outline(outline);
	return true;
}

/* The edges of triangle t are to be looked at, from either side. */
static void want_look(struct grower *g, uint32_t t)
{
	for (uint32_t h = 3 * t; h < 3 * t + 3; h++) {
		g->settled[h] = false;
		if (g->s->mesh.twin[h] != HALFEDGE_NONE)
			g->settled[g->s->mesh.twin[h]] = false;
	}
}

/* Turns the edge of h to the other diagonal of its two triangles where Delaunay wants it and it is allowed. An edge that
 * Delaunay keeps is settled, on both sides, until one of its triangles changes. */
static bool flip(struct grower *g, uint32_t h)
{
	struct halfedge_mesh *mesh = &g->s->mesh;
	uint32_t twin = mesh->twin[h];
	if (g->settled[h])
		return false;
	if (twin == HALFEDGE_NONE || g->region[twin / 3] != g->region[h / 3]) {
		g->settled[h] = true;
		return false;
	}
	uint32_t a = mesh->origin[h], b = mesh->origin[twin];
	uint32_t c = mesh->origin[halfedge_previous(h)], d = mesh->origin[halfedge_previous(twin)];
	const int32_t *pa = g->projected[a], *pb = g->projected[b], *pc = g->projected[c], *pd = g->projected[d];
	if (in_circle(pa, pb, pc, pd) <= 0 || orientation(pc, pa, pd) <= 0 || orientation(pd, pb, pc) <= 0) {
		g->settled[h] = g->settled[twin] = true;
		return false;
	}
	const uint8_t *faces = g->s->border.faces;
	if ((faces[c] & faces[d]) || c == d || halfedge_joined(mesh, c, d))
		return false;
	halfedge_flip(mesh, h);
	want_look(g, h / 3);
	want_look(g, twin / 3);
	return true;
}

static void make_delaunay(struct grower *g, const uint32_t *slot, uint32_t n)
{
	for (uint32_t round = 0, flips = 1; flips && round < FLIPS_MAX; round++) {
		flips = 0;
		for (uint32_t k = 0; k < n; k++)
			for (uint32_t corner = 0; corner < 3; corner++)
				flips += flip(g, 3 * slot[k] + corner);
	}
}

/* A triangle of the outline as its three half-planes: coefficients of x, y and 1, none negative inside. */
struct cover {
	int32_t edge[3][3];
	bool made; /* `flat` is */
	struct flat flat;
};

/* The triangles of the outline; a bit each for those that reach into a strip of one cell, along either axis. */
struct covers {
	struct cover *cover;
	uint64_t *strip[2][STRIPS]; /* [words] */
	uint32_t n, words;
};

static void cover_make(const struct grower *g, uint32_t t, struct cover *ret)
{
	const uint32_t *corner = g->s->mesh.origin + 3 * t;
	for (int k = 0; k < 3; k++) {
		const int32_t *a = g->projected[corner[k]], *b = g->projected[corner[(k + 1) % 3]];
		ret->edge[k][0] = a[1] - b[1];
		ret->edge[k][1] = b[0] - a[0];
		ret->edge[k][2] = a[0] * b[1] - a[1] * b[0];
	}
	ret->made = false;
}

static void note_strips(const struct grower *g, struct covers *covers, uint32_t k)
{
	const uint32_t *corner = g->s->mesh.origin + 3 * g->taken[k];
	const int32_t *a = g->projected[corner[0]], *b = g->projected[corner[1]], *c = g->projected[corner[2]];
	for (int axis = 0; axis < 2; axis++) {
		int32_t low = a[axis] < b[axis] ? a[axis] : b[axis], high = a[axis] < b[axis] ? b[axis] : a[axis];
		low = c[axis] < low ? c[axis] : low;
		high = c[axis] > high ? c[axis] : high;
		for (int32_t strip = low / LATTICE; strip <= high / LATTICE; strip++)
			covers->strip[axis][strip][k / 64] |= (uint64_t)1 << k % 64;
	}
}

/* Of the first `n` slots of the region. */
static int covers_make(const struct grower *g, uint32_t n, struct covers *ret)
{
	uint32_t words = (n + 63) / 64;
	uint64_t *bits = ARENA_NEW(g->arena, uint64_t, 2 * STRIPS * words);
	*ret = (struct covers){.cover = ARENA_TAKE(g->arena, struct cover, n), .n = n, .words = words};
	if (!bits || !ret->cover)
		return -ENOMEM;
	for (uint32_t k = 0; k < 2 * STRIPS; k++)
		ret->strip[k / STRIPS][k % STRIPS] = bits + k * words;
	for (uint32_t k = 0; k < n; k++) {
		cover_make(g, g->taken[k], &ret->cover[k]);
		note_strips(g, ret, k);
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

/* Gives vertex v, which went, to the triangle over or under it, if it is that; false where it is not, or too far. */
static bool hand_to(struct grower *g, uint32_t v, struct cover *cover, uint32_t t)
{
	struct simplify *s = g->s;
	if (!covers_point(cover, g->projected[v]))
		return false;
	const uint32_t *corner = s->mesh.origin + 3 * t;
	if (!cover->made)
		cover->flat = flat_make(g->place[corner[0]], g->place[corner[1]], g->place[corner[2]]);
	cover->made = true;
	if (flat_distance_squared(&cover->flat, s->origin[v]) > s->tolerance_squared)
		return false;
	s->next_point[v] = s->points[t];
	s->points[t] = v;
	return true;
}

/* To the first that takes it; false where none does. */
static bool hand_over(struct grower *g, uint32_t v, struct covers *covers)
{
	const uint64_t *column = covers->strip[0][g->projected[v][0] / LATTICE];
	const uint64_t *row = covers->strip[1][g->projected[v][1] / LATTICE];
	for (uint32_t word = 0; word < covers->words; word++)
		for (uint64_t near = column[word] & row[word]; near; near &= near - 1) {
			uint32_t k = 64 * word + (uint32_t)__builtin_ctzll(near);
			if (hand_to(g, v, &covers->cover[k], g->taken[k]))
				return true;
		}
	return false;
}

/* The vertices that went, in the triangles that came: the first `n` slots. 0, -EDOM or -ENOMEM. */
static int hand_over_all(struct grower *g, uint32_t n)
{
	struct covers covers;
	int r = covers_make(g, n, &covers);
	if (r)
		return r;
	for (uint32_t k = 0; k < g->nv; k++)
		if (g->s->mesh.first[g->vertex[k]] == HALFEDGE_NONE && !hand_over(g, g->vertex[k], &covers))
			return -EDOM;
	return 0;
}

/* A triangle as it was: half-edges' origins and twins. */
struct former {
	uint32_t origin[3], twin[3];
};

/* Takes the triangles of the region out of the mesh: as halfedge_remove does one by one, but walks each list once. */
static void remove_all(struct grower *g, uint32_t number, struct former *ret)
{
	struct halfedge_mesh *mesh = &g->s->mesh;
	for (uint32_t k = 0; k < g->nv; k++) {
		uint32_t *link = &mesh->first[g->vertex[k]];
		for (uint32_t h = *link; h != HALFEDGE_NONE; h = mesh->next_leaving[h])
			if (g->region[h / 3] != number) {
				*link = h;
				link = &mesh->next_leaving[h];
			}
		*link = HALFEDGE_NONE;
	}
	for (uint32_t k = 0; k < g->n; k++) {
		memcpy(ret[k].origin, mesh->origin + 3 * g->taken[k], sizeof ret[k].origin);
		memcpy(ret[k].twin, mesh->twin + 3 * g->taken[k], sizeof ret[k].twin);
	}
	for (uint32_t k = 0; k < g->n; k++)
		for (uint32_t h = 3 * g->taken[k]; h < 3 * g->taken[k] + 3; h++) {
			if (mesh->twin[h] != HALFEDGE_NONE)
				mesh->twin[mesh->twin[h]] = HALFEDGE_NONE;
			mesh->origin[h] = mesh->twin[h] = HALFEDGE_NONE;
		}
}

/* Puts them back as halfedge_add does one by one, but knows their twins. */
static void restore(struct grower *g, const struct former *former)
{
	struct halfedge_mesh *mesh = &g->s->mesh;
	for (uint32_t k = 0; k < g->n; k++) {
		if (halfedge_alive(mesh, g->taken[k]))
			halfedge_remove(mesh, g->taken[k]);
		g->s->points[g->taken[k]] = UINT32_MAX;
	}
	for (uint32_t k = 0; k < g->n; k++)
		for (uint32_t corner = 0; corner < 3; corner++) {
			uint32_t h = 3 * g->taken[k] + corner, v = former[k].origin[corner],
			         twin = former[k].twin[corner];
			mesh->origin[h] = v;
			mesh->next_leaving[h] = mesh->first[v];
			mesh->first[v] = h;
			mesh->twin[h] = twin;
			if (twin != HALFEDGE_NONE)
				mesh->twin[twin] = h;
		}
}

/* Replaces the triangles of the region, all removed already, by those of its outline. -EDOM where a vertex that goes would
 * be too far from them. */
static int replace(struct grower *g, const struct outline *outline, uint32_t (*triangle)[3], uint32_t n)
{
	struct simplify *s = g->s;
	const uint32_t *vertex = outline->contour.vertex;
	for (uint32_t k = 0; k < n; k++)
		halfedge_add(&s->mesh, g->taken[k], vertex[triangle[k][0]], vertex[triangle[k][1]],
		             vertex[triangle[k][2]]);
	make_delaunay(g, g->taken, n);
	return hand_over_all(g, n);
}

/* Triangulates the region from its outline. 0; -EDOM where that cannot be, the region is then as before; -ENOMEM. */
static int flatten(struct grower *g, uint32_t number)
{
	struct halfedge_mesh *mesh = &g->s->mesh;
	struct outline outline = {.g = g};
	int r = contour_find(mesh, g->taken, g->n, g->region, number, g->arena, &outline.contour);
	if (r)
		return r;
	project_vertices(g);
	outline.point = arena_take(g->arena, outline.contour.n, sizeof *outline.point);
	struct former *former = ARENA_TAKE(g->arena, struct former, g->n);
	uint32_t(*triangle)[3], n;
	if (!outline.point || !former)
		return -ENOMEM;
	place_outline(&outline);
	if (!order_loops(&outline, g->arena) || outline.contour.n < 4)
		return -EDOM;
	remove_all(g, number, former);
	const struct polygon polygon = {(const int32_t(*)[2])outline.point, outline.contour.loop_end, outline.contour.n,
	                                outline.contour.loops};
	r = triangulate(&polygon, allows, &outline, g->arena, &triangle, &n);
	if (!r)
		r = replace(g, &outline, triangle, n);
	if (r)
		restore(g, former);
	return r;
}

/* Grows a region from triangle t; true where it is worth a number. */
static bool find_region(struct grower *g, uint32_t t, uint32_t number)
{
	grow(g, t, number);
	let_go(g);
	if (g->nv < REGION_MIN)
		return false;
	fit(g, g->vertex, g->nv, t);
	if (!fits(g, t))
		return false;
	grow(g, t, number);
	if (g->nv >= REGION_MIN)
		return true;
	let_go(g);
	return false;
}

static int note_region(struct grower *g, uint32_t number, struct reduce_stats *stats)
{
	struct simplify *s = g->s;
	s->region[number] = g->plane;
	int r = flatten(g, number);
	if (r == -ENOMEM)
		return r;
	stats->regions++;
	stats->regions_kept += r != 0;
	for (uint32_t k = 0; k < g->n; k++)
		if (halfedge_alive(&s->mesh, g->taken[k]))
			s->plane[g->taken[k]] = number;
	return 0;
}

struct bins {
	uint32_t first[BINS + 1]; /* of `triangle` */
	uint32_t *triangle;
	uint32_t order[BINS], n; /* those with vertices enough to be tried */
};

static uint8_t bin_of(const struct simplify *s, uint32_t v)
{
	uint32_t at[3];
	for (int axis = 0; axis < 3; axis++) {
		uint32_t cell = (uint32_t)s->mesh.position[v][axis] / LATTICE / BIN_CELLS;
		at[axis] = cell < BINS_SIDE ? cell : BINS_SIDE - 1;
	}
	return (uint8_t)((at[2] * BINS_SIDE + at[1]) * BINS_SIDE + at[0]);
}

/* Those with most vertices first. */
static void order_bins(struct bins *bins, const uint32_t count[BINS])
{
	bins->n = 0;
	for (uint32_t b = 0; b < BINS; b++) {
		if (count[b] < SEED_MIN)
			continue;
		uint32_t k = bins->n++;
		for (; k && count[bins->order[k - 1]] < count[b]; k--)
			bins->order[k] = bins->order[k - 1];
		bins->order[k] = b;
	}
}

/* Sorts the triangles into the bins of their first corners. */
static int sort_bins(const struct grower *g, struct bins *bins)
{
	const struct halfedge_mesh *mesh = &g->s->mesh;
	uint32_t fill[BINS], count[BINS] = {0};
	uint8_t *bin = ARENA_TAKE(g->arena, uint8_t, mesh->nv);
	*bins = (struct bins){.triangle = ARENA_TAKE(g->arena, uint32_t, mesh->nt)};
	if (!bin || !bins->triangle)
		return -ENOMEM;
	for (uint32_t v = 0; v < mesh->nv; v++) {
		bin[v] = bin_of(g->s, v);
		count[bin[v]] += mesh->first[v] != HALFEDGE_NONE;
	}
	for (uint32_t t = 0; t < mesh->nt; t++)
		if (halfedge_alive(mesh, t))
			bins->first[bin[mesh->origin[3 * t]] + 1]++;
	for (uint32_t b = 0; b < BINS; b++)
		fill[b] = bins->first[b + 1] += bins->first[b];
	for (uint32_t t = mesh->nt; t-- > 0;)
		if (halfedge_alive(mesh, t))
			bins->triangle[--fill[bin[mesh->origin[3 * t]]]] = t;
	order_bins(bins, count);
	return 0;
}

/* Vertices of the triangles of a bin that are in no region yet. */
static uint32_t free_vertices(struct grower *g, const struct bins *bins, uint32_t bin)
{
	g->nv = 0;
	g->stamp++;
	for (uint32_t k = bins->first[bin]; k < bins->first[bin + 1]; k++) {
		uint32_t t = bins->triangle[k];
		for (int c = 0; c < 3 && g->region[t] == NONE; c++) {
			uint32_t v = g->s->mesh.origin[3 * t + c];
			if (g->seen[v] != g->stamp)
				g->vertex[g->nv++] = v;
			g->seen[v] = g->stamp;
		}
	}
	return g->nv;
}

static uint32_t first_free(const struct grower *g, const struct bins *bins, uint32_t bin)
{
	for (uint32_t k = bins->first[bin]; k < bins->first[bin + 1]; k++)
		if (g->region[bins->triangle[k]] == NONE)
			return bins->triangle[k];
	return NONE;
}

static int search_bin(struct grower *g, const struct bins *bins, uint32_t bin, uint32_t *number,
                      struct reduce_stats *stats)
{
	if (free_vertices(g, bins, bin) < SEED_MIN)
		return 0;
	uint32_t seed = first_free(g, bins, bin);
	if (fit(g, g->vertex, g->nv, seed) > SEED_SPREAD * g->slab * g->slab)
		return 0;
	for (uint32_t k = bins->first[bin]; k < bins->first[bin + 1]; k++) {
		if (!fits(g, bins->triangle[k]))
			continue;
		if (!find_region(g, bins->triangle[k], *number))
			return 0;
		return note_region(g, (*number)++, stats);
	}
	return 0;
}

static int prepare(struct grower *g, struct simplify *s, struct arena *arena)
{
	const struct halfedge_mesh *mesh = &s->mesh;
	*g = (struct grower){.s = s, .arena = arena, .slab = SLAB_SHARE * sqrt(s->tolerance_squared)};
	g->place = ARENA_TAKE(arena, struct vec3, mesh->nv);
	g->turn = ARENA_TAKE(arena, struct turn, mesh->nt);
	g->region = ARENA_TAKE(arena, uint32_t, mesh->cap_nt);
	g->taken = ARENA_TAKE(arena, uint32_t, mesh->nt);
	g->entry = ARENA_TAKE(arena, uint8_t, mesh->nt);
	g->vertex = ARENA_TAKE(arena, uint32_t, mesh->nv);
	g->seen = ARENA_NEW(arena, uint32_t, mesh->nv);
	g->projected = arena_take(arena, mesh->nv, sizeof *g->projected);
	g->settled = ARENA_NEW(arena, bool, 3 * (size_t)mesh->nt);
	g->point = ARENA_TAKE(arena, struct vec3, mesh->nv);
	s->region = ARENA_TAKE(arena, struct region_plane, BINS);
	if (!g->place || !g->turn || !g->region || !g->taken || !g->entry || !g->vertex || !g->seen || !g->projected ||
	    !g->settled || !g->point || !s->region)
		return -ENOMEM;
	memset(g->region, 0xff, mesh->cap_nt * sizeof *g->region);
	for (uint32_t v = 0; v < mesh->nv; v++)
		g->place[v] = simplify_place(s, v);
	for (uint32_t t = 0; t < mesh->nt; t++) {
		if (!halfedge_alive(mesh, t))
			continue;
		const uint32_t *corner = &mesh->origin[3 * t];
		struct vec3 a = g->place[corner[0]];
		struct vec3 n = vec3_cross(vec3_sub(g->place[corner[1]], a), vec3_sub(g->place[corner[2]], a));
		g->turn[t] = (struct turn){n, vec3_dot(n, n)};
	}
	return 0;
}

int region_flatten(struct simplify *s, struct arena *arena, struct reduce_stats *stats)
{
	struct grower g;
	struct bins bins;
	uint32_t number = 0;
	int r = prepare(&g, s, arena);
	if (!r)
		r = sort_bins(&g, &bins);
	for (uint32_t k = 0; !r && k < bins.n; k++)
		r = search_bin(&g, &bins, bins.order[k], &number, stats);
	return r;
}

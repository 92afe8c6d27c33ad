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
#define FLIPS_MAX     8    /* per edge, against rings of equal circles */

struct grower {
	struct simplify *s;
	struct arena *arena;
	struct vec3 *normal;   /* [nt] unit */
	uint32_t *region;      /* [cap_nt] number, or NONE */
	uint32_t *taken, n;    /* triangles of the region that grows */
	uint32_t *vertex, nv;  /* its vertices */
	uint32_t *seen, stamp; /* [nv] */
	struct vec3 *point;    /* scratch of fits */
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
	double theta = (m[q][q] - m[p][p]) / (2 * m[p][q]);
	double t = (theta >= 0 ? 1 : -1) / (fabs(theta) + sqrt(theta * theta + 1));
	double c = 1 / sqrt(t * t + 1), s = t * c;
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
	return fabs(height(&g->plane, simplify_place(g->s, v))) <= g->slab &&
	       fabs(height(&g->plane, g->s->origin[v])) <= g->slab;
}

static void project(const struct grower *g, uint32_t v, int32_t ret_point[2])
{
	const int32_t *p = g->s->mesh.position[v];
	int first = (g->axis + 1) % 3, second = (g->axis + 2) % 3;
	ret_point[0] = p[g->mirrored ? second : first];
	ret_point[1] = p[g->mirrored ? first : second];
}

static double component(struct vec3 v, int axis)
{
	return axis == 0 ? v.x : axis == 1 ? v.y : v.z;
}

static bool fits(const struct grower *g, uint32_t t)
{
	const struct halfedge_mesh *mesh = &g->s->mesh;
	double along = component(g->normal[t], g->axis);
	return g->region[t] == NONE && vec3_dot(g->normal[t], g->plane.normal) >= COSINE_WITHIN &&
	       (g->mirrored ? along < 0 : along > 0) && in_slab(g, mesh->origin[3 * t]) &&
	       in_slab(g, mesh->origin[3 * t + 1]) && in_slab(g, mesh->origin[3 * t + 2]);
}

static void choose_axis(struct grower *g)
{
	struct vec3 n = g->plane.normal;
	double x = fabs(n.x), y = fabs(n.y), z = fabs(n.z);
	g->axis = x >= y && x >= z ? 0 : y >= z ? 1 : 2;
	g->mirrored = component(n, g->axis) < 0;
}

static void take(struct grower *g, uint32_t t, uint32_t number)
{
	g->region[t] = number;
	g->taken[g->n++] = t;
	for (int k = 0; k < 3; k++) {
		uint32_t v = g->s->mesh.origin[3 * t + k];
		if (g->seen[v] == g->stamp)
			continue;
		g->seen[v] = g->stamp;
		g->vertex[g->nv++] = v;
	}
}

static void grow(struct grower *g, uint32_t from, uint32_t number)
{
	const struct halfedge_mesh *mesh = &g->s->mesh;
	g->n = g->nv = 0;
	g->stamp++;
	take(g, from, number);
	for (uint32_t k = 0; k < g->n; k++)
		for (uint32_t h = 3 * g->taken[k]; h < 3 * g->taken[k] + 3; h++) {
			uint32_t twin = mesh->twin[h];
			if (twin != HALFEDGE_NONE && fits(g, twin / 3))
				take(g, twin / 3, number);
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
		g->point[k] = simplify_place(g->s, vertex[k]);
	g->plane = region_fit(g->point, n, &variance);
	if (vec3_dot(g->plane.normal, g->normal[t]) < 0)
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
	sorted.vertex = ARENA_NEW(arena, uint32_t, c->n);
	sorted.loop_end = ARENA_NEW(arena, uint32_t, c->loops);
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
	for (uint32_t k = 0; k < c->n; k++)
		project(outline->g, c->vertex[k], outline->point[k]);
	return true;
}

static void corners(const struct grower *g, uint32_t t, int32_t ret_point[3][2])
{
	for (int k = 0; k < 3; k++)
		project(g, g->s->mesh.origin[3 * t + k], ret_point[k]);
}

/* Turns the edge of h to the other diagonal of its two triangles where Delaunay wants it and it is allowed. */
static bool flip(struct grower *g, uint32_t h)
{
	struct halfedge_mesh *mesh = &g->s->mesh;
	uint32_t twin = mesh->twin[h];
	if (twin == HALFEDGE_NONE || g->region[twin / 3] != g->region[h / 3])
		return false;
	uint32_t a = mesh->origin[h], b = mesh->origin[twin];
	uint32_t c = mesh->origin[halfedge_previous(h)], d = mesh->origin[halfedge_previous(twin)];
	int32_t pa[2], pb[2], pc[2], pd[2];
	project(g, a, pa);
	project(g, b, pb);
	project(g, c, pc);
	project(g, d, pd);
	if (in_circle(pa, pb, pc, pd) <= 0 || orientation(pc, pa, pd) <= 0 || orientation(pd, pb, pc) <= 0)
		return false;
	const uint8_t *faces = g->s->border.faces;
	if ((faces[c] & faces[d]) || c == d || halfedge_joined(mesh, c, d))
		return false;
	uint32_t first = h / 3, second = twin / 3;
	halfedge_remove(mesh, first);
	halfedge_remove(mesh, second);
	halfedge_add(mesh, first, c, a, d);
	halfedge_add(mesh, second, d, b, c);
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

/* Gives vertex v, which went, to the triangle over or under it; false where that is farther than the tolerance. */
static bool hand_over(struct grower *g, uint32_t v, const uint32_t *slot, uint32_t n)
{
	struct simplify *s = g->s;
	int32_t p[2], corner[3][2];
	project(g, v, p);
	for (uint32_t k = 0; k < n; k++) {
		const uint32_t *at = &s->mesh.origin[3 * slot[k]];
		corners(g, slot[k], corner);
		if (orientation(corner[0], corner[1], p) < 0 || orientation(corner[1], corner[2], p) < 0 ||
		    orientation(corner[2], corner[0], p) < 0)
			continue;
		struct flat flat =
		    flat_make(simplify_place(s, at[0]), simplify_place(s, at[1]), simplify_place(s, at[2]));
		if (flat_distance_squared(&flat, s->origin[v]) > s->tolerance_squared)
			continue;
		s->next_point[v] = s->points[slot[k]];
		s->points[slot[k]] = v;
		return true;
	}
	return false;
}

static void restore(struct grower *g, uint32_t (*before)[3])
{
	for (uint32_t k = 0; k < g->n; k++) {
		if (halfedge_alive(&g->s->mesh, g->taken[k]))
			halfedge_remove(&g->s->mesh, g->taken[k]);
		g->s->points[g->taken[k]] = UINT32_MAX;
	}
	for (uint32_t k = 0; k < g->n; k++)
		halfedge_add(&g->s->mesh, g->taken[k], before[k][0], before[k][1], before[k][2]);
}

/* Replaces the triangles of the region, all removed already, by those of its outline; false where a vertex that goes
 * would be too far from them. */
static bool replace(struct grower *g, const struct outline *outline, uint32_t (*triangle)[3], uint32_t n)
{
	struct simplify *s = g->s;
	const uint32_t *vertex = outline->contour.vertex;
	for (uint32_t k = 0; k < n; k++)
		halfedge_add(&s->mesh, g->taken[k], vertex[triangle[k][0]], vertex[triangle[k][1]],
		             vertex[triangle[k][2]]);
	make_delaunay(g, g->taken, n);
	for (uint32_t k = 0; k < g->nv; k++)
		if (s->mesh.first[g->vertex[k]] == HALFEDGE_NONE && !hand_over(g, g->vertex[k], g->taken, n))
			return false;
	return true;
}

/* Triangulates the region from its outline. 0; -EDOM where that cannot be, the region is then as before; -ENOMEM. */
static int flatten(struct grower *g, uint32_t number)
{
	struct halfedge_mesh *mesh = &g->s->mesh;
	struct outline outline = {.g = g};
	int r = contour_find(mesh, g->taken, g->n, g->region, number, g->arena, &outline.contour);
	if (r)
		return r;
	outline.point = arena_alloc(g->arena, outline.contour.n, sizeof *outline.point);
	uint32_t(*before)[3] = arena_alloc(g->arena, g->n, sizeof *before), (*triangle)[3], n;
	if (!outline.point || !before)
		return -ENOMEM;
	for (uint32_t k = 0; k < outline.contour.n; k++)
		project(g, outline.contour.vertex[k], outline.point[k]);
	if (!order_loops(&outline, g->arena) || outline.contour.n < 4)
		return -EDOM;
	for (uint32_t k = 0; k < g->n; k++) {
		memcpy(before[k], &mesh->origin[3 * g->taken[k]], sizeof before[k]);
		halfedge_remove(mesh, g->taken[k]);
	}
	const struct polygon polygon = {(const int32_t(*)[2])outline.point, outline.contour.loop_end, outline.contour.n,
	                                outline.contour.loops};
	r = triangulate(&polygon, allows, &outline, g->arena, &triangle, &n);
	if (!r && !replace(g, &outline, triangle, n))
		r = -EDOM;
	if (r)
		restore(g, before);
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
	uint32_t count[BINS]; /* vertices */
	uint32_t order[BINS];
};

static uint32_t bin_of(const struct simplify *s, uint32_t v)
{
	uint32_t at[3];
	for (int axis = 0; axis < 3; axis++) {
		uint32_t cell = (uint32_t)s->mesh.position[v][axis] / LATTICE / BIN_CELLS;
		at[axis] = cell < BINS_SIDE ? cell : BINS_SIDE - 1;
	}
	return (at[2] * BINS_SIDE + at[1]) * BINS_SIDE + at[0];
}

/* Sorts the triangles into the bins of their first corners, the bins by their vertices. */
static int sort_bins(const struct grower *g, struct bins *bins)
{
	const struct simplify *s = g->s;
	const struct halfedge_mesh *mesh = &s->mesh;
	uint32_t fill[BINS];
	*bins = (struct bins){.triangle = ARENA_NEW(g->arena, uint32_t, mesh->nt)};
	if (!bins->triangle)
		return -ENOMEM;
	for (uint32_t v = 0; v < mesh->nv; v++)
		bins->count[bin_of(s, v)] += mesh->first[v] != HALFEDGE_NONE;
	for (uint32_t t = 0; t < mesh->nt; t++)
		if (halfedge_alive(mesh, t))
			bins->first[bin_of(s, mesh->origin[3 * t]) + 1]++;
	for (uint32_t b = 0; b < BINS; b++)
		fill[b] = bins->first[b + 1] += bins->first[b];
	for (uint32_t t = mesh->nt; t-- > 0;)
		if (halfedge_alive(mesh, t))
			bins->triangle[--fill[bin_of(s, mesh->origin[3 * t])]] = t;
	for (uint32_t b = 0; b < BINS; b++) {
		uint32_t k = b;
		for (; k && bins->count[bins->order[k - 1]] < bins->count[b]; k--)
			bins->order[k] = bins->order[k - 1];
		bins->order[k] = b;
	}
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
	if (bins->count[bin] < SEED_MIN || free_vertices(g, bins, bin) < SEED_MIN)
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
	g->normal = ARENA_NEW(arena, struct vec3, mesh->nt);
	g->region = ARENA_NEW(arena, uint32_t, mesh->cap_nt);
	g->taken = ARENA_NEW(arena, uint32_t, mesh->nt);
	g->vertex = ARENA_NEW(arena, uint32_t, mesh->nv);
	g->seen = ARENA_NEW(arena, uint32_t, mesh->nv);
	g->point = ARENA_NEW(arena, struct vec3, mesh->nv);
	s->region = ARENA_NEW(arena, struct region_plane, BINS);
	if (!g->normal || !g->region || !g->taken || !g->vertex || !g->seen || !g->point || !s->region)
		return -ENOMEM;
	memset(g->region, 0xff, mesh->cap_nt * sizeof *g->region);
	for (uint32_t t = 0; t < mesh->nt; t++) {
		if (!halfedge_alive(mesh, t))
			continue;
		struct vec3 a = simplify_place(s, mesh->origin[3 * t]);
		struct vec3 n = vec3_cross(vec3_sub(simplify_place(s, mesh->origin[3 * t + 1]), a),
		                           vec3_sub(simplify_place(s, mesh->origin[3 * t + 2]), a));
		g->normal[t] = vec3_scale(n, 1 / vec3_norm(n));
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
	for (uint32_t k = 0; k < BINS && !r; k++)
		r = search_bin(&g, &bins, bins.order[k], &number, stats);
	return r;
}

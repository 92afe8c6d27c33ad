/* Regions grow over the mesh, from where it is densest in flat vertices.
 *
 * Bins of 4 cells are tried by the number of their vertices: a plane is fitted to a bin, and from one of its triangles on,
 * turned within 60 degrees of the plane, the region takes every neighbour that is not turned against the plane and whose three
 * corners lie in the slab about it. The plane is then fitted to what it took, and it grows once more. The slab is as high as the
 * tolerance to both sides, so that the noise of a new surface does not tear it; what lies in it is made fewer by slab.c,
 * which asks for every distance. */
#include "core/region.h"

#include <assert.h>
#include <errno.h>
#include <string.h>

#include "core/slab.h"

#define NONE          UINT32_MAX
#define BIN_CELLS     4
#define BINS_SIDE     (PATCH_SIDE / BIN_CELLS)
#define BINS          (BINS_SIDE * BINS_SIDE * BINS_SIDE)
#define SEED_MIN      12  /* vertices of a bin */
#define REGION_MIN    16  /* vertices of a region */
#define SLAB_SHARE    1.0 /* of the tolerance, to either side */
#define SEED_SPREAD   0.6 /* variance of a bin about its plane, in squared slabs */
#define COSINE_WITHIN 0.5 /* 60 degrees */

/* Between these the square of theta swallows the 1 that Jacobi adds to it, and that of t is swallowed: the roots need not be
 * taken, the bits are the same. */
#define THETA_LARGE 0x1p28
#define THETA_HUGE  0x1p500

struct grower {
	struct slab slab;      /* the region that grows */
	struct vec3 *normal;   /* [nt] of the triangles, twice their areas long */
	uint8_t *entry;        /* which of their half-edges the region came over, as slab.taken */
	uint32_t *seen, stamp; /* [nv] */
	struct vec3 *point;    /* scratch of fits */
	double height;         /* of the slab, to either side */
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
	return fabs(height(&g->slab.plane, g->slab.place[v])) <= g->height &&
	       fabs(height(&g->slab.plane, g->slab.s->origin[v])) <= g->height;
}

static double component(struct vec3 v, int axis)
{
	return axis == 0 ? v.x : axis == 1 ? v.y : v.z;
}

static struct vec3 unit_normal(const struct grower *g, uint32_t t)
{
	return vec3_scale(g->normal[t], 1 / vec3_norm(g->normal[t]));
}

/* Whether triangle t is in no region and not turned against the plane: one that stands upright is a small step, or none
 * at all in the projection. */
static bool turned_alike(const struct grower *g, uint32_t t)
{
	double along = component(g->normal[t], g->slab.axis);
	return g->slab.region[t] == NONE && (g->slab.mirrored ? along <= 0 : along >= 0);
}

/* Whether a region may begin with triangle t. */
static bool fits(const struct grower *g, uint32_t t)
{
	const uint32_t *corner = g->slab.s->mesh.origin + 3 * t;
	return turned_alike(g, t) && vec3_dot(unit_normal(g, t), g->slab.plane.normal) >= COSINE_WITHIN &&
	       in_slab(g, corner[0]) && in_slab(g, corner[1]) && in_slab(g, corner[2]);
}

static void choose_axis(struct grower *g)
{
	struct vec3 n = g->slab.plane.normal;
	double x = fabs(n.x), y = fabs(n.y), z = fabs(n.z);
	g->slab.axis = x >= y && x >= z ? 0 : y >= z ? 1 : 2;
	g->slab.mirrored = component(n, g->slab.axis) < 0;
}

static void take_vertex(struct grower *g, uint32_t v)
{
	g->seen[v] = g->stamp;
	g->slab.vertex[g->slab.nv++] = v;
}

/* The triangle of h, reached over h. */
static void take(struct grower *g, uint32_t h)
{
	g->slab.region[h / 3] = g->slab.number;
	g->entry[g->slab.n] = h % 3;
	g->slab.taken[g->slab.n++] = h / 3;
}

/* Takes the neighbour beyond h if it fits. Of its corners only the far one is new; one seen before lies in the slab. */
static void try_beyond(struct grower *g, uint32_t h)
{
	const struct halfedge_mesh *mesh = &g->slab.s->mesh;
	uint32_t twin = mesh->twin[h];
	if (twin == HALFEDGE_NONE || !turned_alike(g, twin / 3))
		return;
	uint32_t far = mesh->origin[halfedge_previous(twin)];
	if (g->seen[far] != g->stamp) {
		if (!in_slab(g, far))
			return;
		take_vertex(g, far);
	}
	take(g, twin);
}

/* From triangle `from`, which fits. */
static void grow(struct grower *g, uint32_t from)
{
	g->slab.n = g->slab.nv = 0;
	g->stamp++;
	take(g, 3 * from);
	for (uint32_t k = 0; k < 3; k++)
		take_vertex(g, g->slab.s->mesh.origin[3 * from + k]);
	for (uint32_t h = 3 * from; h < 3 * from + 3; h++)
		try_beyond(g, h);
	for (uint32_t k = 1; k < g->slab.n; k++) {
		uint32_t h = 3 * g->slab.taken[k], entry = g->entry[k];
		try_beyond(g, entry == 0 ? h + 1 : h);
		try_beyond(g, entry == 2 ? h + 1 : h + 2);
	}
}

static void let_go(struct grower *g)
{
	for (uint32_t k = 0; k < g->slab.n; k++)
		g->slab.region[g->slab.taken[k]] = NONE;
}

/* Fits the plane to `n` vertices, facing the way of triangle t. The variance about it. */
static double fit(struct grower *g, const uint32_t *vertex, uint32_t n, uint32_t t)
{
	double variance;
	for (uint32_t k = 0; k < n; k++)
		g->point[k] = g->slab.place[vertex[k]];
	g->slab.plane = region_fit(g->point, n, &variance);
	if (vec3_dot(g->slab.plane.normal, unit_normal(g, t)) < 0)
		g->slab.plane = (struct region_plane){vec3_scale(g->slab.plane.normal, -1), -g->slab.plane.offset};
	choose_axis(g);
	return variance;
}

/* Grows a region from triangle t; true where it is worth a number. */
static bool find_region(struct grower *g, uint32_t t)
{
	grow(g, t);
	let_go(g);
	if (g->slab.nv < REGION_MIN)
		return false;
	fit(g, g->slab.vertex, g->slab.nv, t);
	if (!fits(g, t))
		return false;
	grow(g, t);
	if (g->slab.nv >= REGION_MIN)
		return true;
	let_go(g);
	return false;
}

static int note_region(struct grower *g, struct reduce_stats *stats)
{
	struct simplify *s = g->slab.s;
	s->region[g->slab.number] = g->slab.plane;
	int r = slab_thin(&g->slab);
	if (r == -ENOMEM)
		return r;
	stats->regions++;
	stats->regions_kept += r != 0;
	for (uint32_t k = 0; k < g->slab.n; k++)
		if (halfedge_alive(&s->mesh, g->slab.taken[k]))
			s->plane[g->slab.taken[k]] = g->slab.number;
	g->slab.number++;
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
	const struct halfedge_mesh *mesh = &g->slab.s->mesh;
	uint32_t fill[BINS], count[BINS] = {0};
	uint8_t *bin = ARENA_TAKE(g->slab.arena, uint8_t, mesh->nv);
	*bins = (struct bins){.triangle = ARENA_TAKE(g->slab.arena, uint32_t, mesh->nt)};
	if (!bin || !bins->triangle)
		return -ENOMEM;
	for (uint32_t v = 0; v < mesh->nv; v++) {
		bin[v] = bin_of(g->slab.s, v);
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
	g->slab.nv = 0;
	g->stamp++;
	for (uint32_t k = bins->first[bin]; k < bins->first[bin + 1]; k++) {
		uint32_t t = bins->triangle[k];
		for (int c = 0; c < 3 && g->slab.region[t] == NONE; c++) {
			uint32_t v = g->slab.s->mesh.origin[3 * t + c];
			if (g->seen[v] != g->stamp)
				g->slab.vertex[g->slab.nv++] = v;
			g->seen[v] = g->stamp;
		}
	}
	return g->slab.nv;
}

static uint32_t first_free(const struct grower *g, const struct bins *bins, uint32_t bin)
{
	for (uint32_t k = bins->first[bin]; k < bins->first[bin + 1]; k++)
		if (g->slab.region[bins->triangle[k]] == NONE)
			return bins->triangle[k];
	return NONE;
}

static int search_bin(struct grower *g, const struct bins *bins, uint32_t bin, struct reduce_stats *stats)
{
	if (free_vertices(g, bins, bin) < SEED_MIN)
		return 0;
	uint32_t seed = first_free(g, bins, bin);
	if (fit(g, g->slab.vertex, g->slab.nv, seed) > SEED_SPREAD * g->height * g->height)
		return 0;
	for (uint32_t k = bins->first[bin]; k < bins->first[bin + 1]; k++) {
		if (!fits(g, bins->triangle[k]))
			continue;
		return find_region(g, bins->triangle[k]) ? note_region(g, stats) : 0;
	}
	return 0;
}

static int prepare(struct grower *g, struct simplify *s, struct arena *arena)
{
	const struct halfedge_mesh *mesh = &s->mesh;
	*g = (struct grower){.slab = {.s = s, .arena = arena}, .height = SLAB_SHARE * sqrt(s->tolerance_squared)};
	g->slab.place = ARENA_TAKE(arena, struct vec3, mesh->nv);
	g->normal = ARENA_TAKE(arena, struct vec3, mesh->nt);
	g->slab.region = ARENA_TAKE(arena, uint32_t, mesh->cap_nt);
	g->slab.taken = ARENA_TAKE(arena, uint32_t, mesh->nt);
	g->entry = ARENA_TAKE(arena, uint8_t, mesh->nt);
	g->slab.vertex = ARENA_TAKE(arena, uint32_t, mesh->nv);
	g->seen = ARENA_NEW(arena, uint32_t, mesh->nv);
	g->slab.projected = arena_take(arena, mesh->nv, sizeof *g->slab.projected);
	g->slab.settled = ARENA_NEW(arena, bool, 3 * (size_t)mesh->nt);
	g->point = ARENA_TAKE(arena, struct vec3, mesh->nv);
	s->region = ARENA_TAKE(arena, struct region_plane, BINS);
	if (!g->slab.place || !g->normal || !g->slab.region || !g->slab.taken || !g->entry || !g->slab.vertex ||
	    !g->seen || !g->slab.projected || !g->slab.settled || !g->point || !s->region)
		return -ENOMEM;
	memset(g->slab.region, 0xff, mesh->cap_nt * sizeof *g->slab.region);
	for (uint32_t v = 0; v < mesh->nv; v++)
		g->slab.place[v] = simplify_place(s, v);
	for (uint32_t t = 0; t < mesh->nt; t++) {
		if (!halfedge_alive(mesh, t))
			continue;
		const uint32_t *corner = &mesh->origin[3 * t];
		struct vec3 a = g->slab.place[corner[0]];
		g->normal[t] = vec3_cross(vec3_sub(g->slab.place[corner[1]], a), vec3_sub(g->slab.place[corner[2]], a));
	}
	return 0;
}

int region_flatten(struct simplify *s, struct arena *arena, struct reduce_stats *stats)
{
	struct grower g;
	struct bins bins;
	int r = prepare(&g, s, arena);
	if (!r)
		r = sort_bins(&g, &bins);
	for (uint32_t k = 0; !r && k < bins.n; k++)
		r = search_bin(&g, &bins, bins.order[k], stats);
	return r;
}

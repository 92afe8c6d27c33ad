/* D6, L4: marching cubes closes every field, neighbouring patches fit, and a patch is a function of its voxels alone.
 */
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <cmocka.h>

#include "core/cubes.h"
#include "tests/soup.h"

#define UNKNOWN VOXEL_UNKNOWN

/* The convention of cubes_table.c, written down once more: edge -> its two corners. */
static const int edge_ends[12][2] = {{0, 1}, {2, 3}, {4, 5}, {6, 7}, {0, 2}, {1, 3},
                                     {4, 6}, {5, 7}, {0, 4}, {1, 5}, {2, 6}, {3, 7}};

static bool edge_in_face(int edge, int axis, int side)
{
	return (edge_ends[edge][0] >> axis & 1) == side && (edge_ends[edge][1] >> axis & 1) == side;
}

/* Directed edges of the triangles of a case whose reverse the case does not have: its outline. */
static int outline(int code, int ret_segments[32][2])
{
	int count[12][12] = {0}, n = 0;
	for (const int8_t *e = cubes_triangles[code]; *e >= 0; e += 3)
		for (int c = 0; c < 3; c++)
			count[e[c]][e[(c + 1) % 3]]++;
	for (int a = 0; a < 12; a++)
		for (int b = 0; b < 12; b++)
			if (count[a][b] && !count[b][a]) {
				ret_segments[n][0] = a;
				ret_segments[n++][1] = b;
			}
	return n;
}

static void a_case_uses_exactly_the_edges_that_change_sign(void **state)
{
	(void)state;
	for (int code = 0; code < 256; code++) {
		unsigned used = 0, changes = 0;
		int n = 0;
		for (; cubes_triangles[code][n] >= 0; n++)
			used |= 1u << cubes_triangles[code][n];
		for (int e = 0; e < 12; e++)
			changes |= (unsigned)((code >> edge_ends[e][0] ^ code >> edge_ends[e][1]) & 1) << e;
		assert_int_equal(used, changes);
		assert_int_equal(n % 3, 0);
		assert_true(n <= 15);
	}
}

static void an_edge_inside_a_case_lies_in_no_cube_face(void **state)
{
	(void)state;
	int inner = 0;
	for (int code = 0; code < 256; code++) {
		int count[12][12] = {0};
		for (const int8_t *e = cubes_triangles[code]; *e >= 0; e += 3)
			for (int c = 0; c < 3; c++)
				count[e[c]][e[(c + 1) % 3]]++;
		for (int a = 0; a < 12; a++)
			for (int b = 0; b < 12; b++) {
				assert_true(count[a][b] <= 1);
				if (!count[a][b] || !count[b][a])
					continue;
				inner++;
				for (int face = 0; face < 6; face++)
					assert_false(edge_in_face(a, face >> 1, face & 1) &&
					             edge_in_face(b, face >> 1, face & 1));
			}
	}
	assert_true(inner > 256);
}

/* On a face, a segment joins the edges at the two ends of a run of inside corners. */
static void an_outline_lies_in_the_faces_and_every_ambiguous_face_separates_its_inside_corners(void **state)
{
	(void)state;
	int ambiguous = 0;
	for (int code = 0; code < 256; code++) {
		int segments[32][2], n = outline(code, segments), placed = 0;
		for (int face = 0; face < 6; face++) {
			int inside = 0, here = 0, around_inside = 0;
			for (int c = 0; c < 8; c++)
				inside += (c >> (face >> 1) & 1) == (face & 1) && (code >> c & 1);
			for (int s = 0; s < n; s++) {
				const int *a = edge_ends[segments[s][0]], *b = edge_ends[segments[s][1]];
				if (!edge_in_face(segments[s][0], face >> 1, face & 1) ||
				    !edge_in_face(segments[s][1], face >> 1, face & 1))
					continue;
				here++;
				for (int i = 0; i < 4; i++) /* both edges end at one inside corner */
					around_inside += a[i >> 1] == b[i & 1] && (code >> a[i >> 1] & 1);
			}
			placed += here;
			assert_true(here <= 2 && (here > 0) == (inside > 0 && inside < 4));
			if (here == 2) {
				ambiguous++;
				assert_int_equal(inside, 2);
				assert_int_equal(around_inside, 2);
			}
		}
		assert_int_equal(placed, n);
	}
	assert_int_equal(ambiguous, 6 * 2 * 16);
}

static int shifted(int edge, int axis) /* the same edge seen from the cube above along `axis` */
{
	for (int e = 0; e < 12; e++)
		if (edge_ends[e][0] == (edge_ends[edge][0] ^ 1 << axis) &&
		    edge_ends[e][1] == (edge_ends[edge][1] ^ 1 << axis))
			return e;
	return -1;
}

static bool corners_match(int low, int high, int axis)
{
	for (int c = 0; c < 8; c++)
		if ((c >> axis & 1) && (low >> c & 1) != (high >> (c ^ 1 << axis) & 1))
			return false;
	return true;
}

static void all_pairs_of_neighbours_draw_opposite_segments_on_their_face(void **state)
{
	(void)state;
	int pairs = 0;
	for (int axis = 0; axis < 3; axis++)
		for (int low = 0; low < 256; low++)
			for (int high = 0; high < 256; high++) {
				if (!corners_match(low, high, axis))
					continue;
				int a[32][2], b[32][2], n = outline(low, a), m = outline(high, b), on_low = 0,
				                        on_high = 0, met = 0;
				pairs++;
				for (int s = 0; s < m; s++)
					on_high += edge_in_face(b[s][0], axis, 0) && edge_in_face(b[s][1], axis, 0);
				for (int s = 0; s < n; s++) {
					if (!edge_in_face(a[s][0], axis, 1) || !edge_in_face(a[s][1], axis, 1))
						continue;
					on_low++;
					for (int t = 0; t < m; t++)
						met += b[t][0] == shifted(a[s][1], axis) &&
						       b[t][1] == shifted(a[s][0], axis);
				}
				assert_true(on_low == on_high && met == on_low);
			}
	assert_int_equal(pairs, 3 * 256 * 16);
}

/* Random numbers of a test: xorshift, seeded by the test. */
static uint64_t random_next(uint64_t *state)
{
	*state ^= *state << 13;
	*state ^= *state >> 7;
	*state ^= *state << 17;
	return *state >> 11;
}

static int random_below(uint64_t *state, int n)
{
	return (int)(random_next(state) % (uint64_t)n);
}

static void set_voxel(struct grid *grid, int i, int j, int k, int16_t value)
{
	struct block_key key = {i >> BLOCK_SHIFT, j >> BLOCK_SHIFT, k >> BLOCK_SHIFT};
	struct block *block = grid_touch(grid, key);
	assert_non_null(block);
	block_publish(block, ((k & 7) * BLOCK_SIDE + (j & 7)) * BLOCK_SIDE + (i & 7), value);
	grid_mark_changed(
	    grid, key, (const uint8_t[3]){(uint8_t)(1 << (i & 7)), (uint8_t)(1 << (j & 7)), (uint8_t)(1 << (k & 7))});
}

struct tools {
	struct window window;
	struct arena arena;
	uint64_t cases[256]; /* how often each case with a surface was met */
	uint64_t vertices_at_clamp;
};

static struct tools *tools_create(void)
{
	struct tools *tools = calloc(1, sizeof *tools);
	assert_non_null(tools);
	arena_init(&tools->arena);
	return tools;
}

static void tools_destroy(struct tools *tools)
{
	arena_finish(&tools->arena);
	free(tools);
}

static bool inside(const struct window *window, int i, int j, int k)
{
	return window->inside[window_row(j, k)] >> (i + WINDOW_LOW) & 1;
}

static void count_cases(struct tools *tools)
{
	for (int k = 0; k < PATCH_SIDE; k++)
		for (int j = 0; j < PATCH_SIDE; j++)
			for (int i = 0; i < PATCH_SIDE; i++) {
				int code = 0;
				if (!window_active(&tools->window, i, j, k))
					continue;
				for (int c = 0; c < 8; c++)
					code |= inside(&tools->window, i + (c & 1), j + (c >> 1 & 1), k + (c >> 2))
					        << c;
				tools->cases[code]++;
			}
}

static void mesh(struct tools *tools, const struct grid *grid, struct patch_key key, struct surface *ret)
{
	arena_reset(&tools->arena);
	cubes_gather(grid, key, &tools->window);
	assert_int_equal(cubes_extract(&tools->window, &tools->arena, ret), 0);
	if (tools->window.empty)
		assert_int_equal(ret->nt, 0);
	else
		assert_true(ret->nt > 0);
}

/* Every vertex keeps its distance from the corners and carries its name. */
static void check_vertices(struct tools *tools, const struct surface *surface)
{
	for (uint32_t v = 0; v < surface->nv; v++) {
		int off_lattice = 0, at[3], axis = 0;
		for (int a = 0; a < 3; a++) {
			int rest = surface->vertex[v][a] % LATTICE;
			at[a] = surface->vertex[v][a] / LATTICE;
			if (rest) {
				off_lattice++;
				axis = a;
				assert_true(rest >= 4 && rest <= 252);
				tools->vertices_at_clamp += rest == 4 || rest == 252;
			}
		}
		assert_int_equal(off_lattice, 1);
		assert_int_equal(surface->name[v], vertex_name(at[0], at[1], at[2], axis));
	}
}

/* Meshes all dirty patches of a fresh grid into a soup. */
static uint32_t mesh_dirty(struct tools *tools, struct grid *grid, struct soup *soup)
{
	const struct patch_key *keys;
	size_t n = grid_take_dirty(grid, &keys);
	uint32_t patches = 0;
	for (size_t i = 0; i < n; i++) {
		struct surface surface;
		mesh(tools, grid, keys[i], &surface);
		count_cases(tools);
		check_vertices(tools, &surface);
		soup_add(soup, keys[i], surface.nv, (const uint16_t(*)[3])surface.vertex, surface.nt,
		         (const uint32_t(*)[3])surface.triangle);
		patches += surface.nt > 0;
	}
	return patches;
}

/* Values of one of several kinds of field: wide, near zero with exact zeros, chequered (all faces ambiguous), a ball.
 */
static int16_t field_value(uint64_t *random, int kind, int i, int j, int k)
{
	switch (kind) {
	case 0:
		return (int16_t)(random_below(random, 1401) - 700);
	case 1:
		return (int16_t)(random_below(random, 3) - 1);
	case 2:
		return (int16_t)(((i + j + k) & 1 ? 1 : -1) * (1 + random_below(random, 40)));
	case 3:
		return (int16_t)((i - 3) * (i - 3) * 60 + (j - 2) * (j - 2) * 70 + (k - 3) * (k - 3) * 50 - 300 +
		                 random_below(random, 30));
	default:
		return (int16_t)(random_below(random, 4) ? 0 : random_below(random, 65535) - 32767);
	}
}

/* A box of `side` corners from `low`, closed by a layer of outside values. */
static void fill_box(struct grid *grid, uint64_t *random, const int low[3], const int side[3], int kind,
                     int unknown_of_8)
{
	for (int k = 0; k < side[2]; k++)
		for (int j = 0; j < side[1]; j++)
			for (int i = 0; i < side[0]; i++) {
				bool rim = !i || !j || !k || i == side[0] - 1 || j == side[1] - 1 || k == side[2] - 1;
				int16_t value = field_value(random, kind, i, j, k);
				if (rim && value < 0)
					value = (int16_t)-value;
				if (random_below(random, 8) < unknown_of_8)
					value = UNKNOWN;
				set_voxel(grid, low[0] + i, low[1] + j, low[2] + k, value);
			}
}

/* `base` and `spread` choose where boxes lie: inside one patch, or across the borders of several. */
static uint32_t check_random_fields(struct tools *tools, int grids, int base, int spread, int unknown_of_8,
                                    uint64_t seed)
{
	uint32_t most_patches = 0;
	for (int g = 0; g < grids; g++) {
		struct grid *grid = grid_create(64 << 20);
		struct soup soup = {0};
		int low[3], side[3];
		for (int a = 0; a < 3; a++) {
			low[a] = base + random_below(&seed, spread);
			side[a] = 4 + random_below(&seed, 4);
		}
		fill_box(grid, &seed, low, side, g % 5, unknown_of_8);
		uint32_t patches = mesh_dirty(tools, grid, &soup);
		struct soup_faults faults = soup_judge(&soup);
		assert_int_equal(faults.repeated_edges, 0);
		assert_int_equal(faults.flat, 0);
		if (!unknown_of_8) {
			assert_int_equal(faults.open_edges, 0);
			assert_int_equal(faults.split_points, 0);
		}
		if (patches > most_patches)
			most_patches = patches;
		soup_finish(&soup);
		grid_destroy(grid);
	}
	return most_patches;
}

static void every_random_field_in_one_patch_closes(void **state)
{
	(void)state;
	struct tools *tools = tools_create();
	assert_int_equal(check_random_fields(tools, 6000, 3, 4, 0, 1), 1);
	for (int c = 1; c < 255; c++)
		assert_true(tools->cases[c] > 0);
	assert_true(tools->vertices_at_clamp > 1000);
	tools_destroy(tools);
}

static void every_random_field_across_patches_closes(void **state)
{
	(void)state;
	struct tools *tools = tools_create();
	assert_int_equal(check_random_fields(tools, 6000, -7, 6, 0, 2), 8);
	for (int c = 1; c < 255; c++)
		assert_true(tools->cases[c] > 0);
	tools_destroy(tools);
}

static void half_unknown_fields_give_oriented_edges_of_two_faces(void **state)
{
	(void)state;
	struct tools *tools = tools_create();
	check_random_fields(tools, 3000, -7, 6, 1, 3);
	check_random_fields(tools, 3000, 12, 6, 3, 4);
	tools_destroy(tools);
}

/* How often the mesh winds around a corner: the solid angles of its faces (van Oosterom and Strackee, 1983). */
static double winding(const struct soup *soup, const double p[3])
{
	double sum = 0;
	for (uint32_t t = 0; t < soup->nt; t++) {
		double r[3][3], l[3], dot[3];
		for (int c = 0; c < 3; c++) {
			for (int a = 0; a < 3; a++)
				r[c][a] = (double)soup->point[soup->triangle[t][c]].at[a] / LATTICE - p[a];
			l[c] = sqrt(r[c][0] * r[c][0] + r[c][1] * r[c][1] + r[c][2] * r[c][2]);
		}
		for (int c = 0; c < 3; c++) {
			const double *u = r[c], *v = r[(c + 1) % 3];
			dot[c] = u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
		}
		double volume = r[0][0] * (r[1][1] * r[2][2] - r[1][2] * r[2][1]) +
		                r[0][1] * (r[1][2] * r[2][0] - r[1][0] * r[2][2]) +
		                r[0][2] * (r[1][0] * r[2][1] - r[1][1] * r[2][0]);
		sum += 2 * atan2(volume, l[0] * l[1] * l[2] + dot[0] * l[2] + dot[1] * l[0] + dot[2] * l[1]);
	}
	return sum / (4 * acos(-1.0));
}

static void every_case_separates_its_inside_corners_from_the_outside(void **state)
{
	(void)state;
	struct tools *tools = tools_create();
	for (int code = 0; code < 256; code++) {
		struct grid *grid = grid_create(64 << 20);
		struct soup soup = {0};
		for (int c = 0; c < 64; c++) {
			int i = c & 3, j = c >> 2 & 3, k = c >> 4;
			bool middle = i && j && k && i < 3 && j < 3 && k < 3;
			bool inside = middle && (code >> ((i - 1) + 2 * (j - 1) + 4 * (k - 1)) & 1);
			set_voxel(grid, 14 + i, 14 + j, 14 + k, inside ? -100 : 130);
		}
		mesh_dirty(tools, grid, &soup);
		struct soup_faults faults = soup_judge(&soup);
		assert_int_equal(faults.open_edges + faults.repeated_edges + faults.split_points, 0);
		for (int c = 0; c < 8; c++) {
			double at[3] = {15 + (c & 1), 15 + (c >> 1 & 1), 15 + (c >> 2)};
			assert_true(fabs(winding(&soup, at) - (code >> c & 1)) < 1e-6);
		}
		soup_finish(&soup);
		grid_destroy(grid);
	}
	tools_destroy(tools);
}

/* The fill rule, as the header says it, one corner at a time. */
static int16_t filled_value(const struct grid *grid, int i, int j, int k)
{
	static const int step[6][3] = {{-1, 0, 0}, {1, 0, 0}, {0, -1, 0}, {0, 1, 0}, {0, 0, -1}, {0, 0, 1}};
	int16_t own = grid_published(grid, i, j, k), best = 0;
	int axes = 0, inside = 0, outside = 0;
	if (own != UNKNOWN)
		return own;
	for (int s = 0; s < 6; s++) {
		int16_t v = grid_published(grid, i + step[s][0], j + step[s][1], k + step[s][2]);
		if (v == UNKNOWN)
			continue;
		axes |= 1 << (s >> 1);
		inside += v < 0;
		outside += v >= 0;
		best = abs(v) > abs(best) ? v : best;
	}
	bool two = axes == 3 || axes > 4;
	return two && !(inside && outside) ? best : UNKNOWN;
}

static bool cell_has_surface(const int16_t value[8])
{
	int inside = 0;
	for (int c = 0; c < 8; c++) {
		if (value[c] == UNKNOWN)
			return false;
		inside += value[c] < 0;
	}
	return inside && inside < 8;
}

/* The cell's edges that cross the surface, and of a cell behind a face those in that face only: their ends have values. */
static void compare_values(const struct window *window, const int at[3], const int16_t expected[8])
{
	for (int c = 0; c < 8; c++)
		for (int axis = 0; axis < 3; axis++) {
			int other = c | 1 << axis, low[3], high[3];
			bool within = c != other && (expected[c] < 0) != (expected[other] < 0);
			for (int a = 0; a < 3; a++) {
				low[a] = at[a] + (c >> a & 1);
				high[a] = at[a] + (other >> a & 1);
				within &= low[a] >= 0 && high[a] <= 16;
			}
			if (!within)
				continue;
			assert_int_equal(window->value[window_at(low[0], low[1], low[2])], expected[c]);
			assert_int_equal(window->value[window_at(high[0], high[1], high[2])], expected[other]);
		}
}

static void compare_cell(const struct grid *grid, const struct window *window, const int at[3], uint64_t *ret_filled,
                         bool *surface)
{
	const struct patch_key key = window->key;
	int beyond = 0;
	int16_t expected[8];
	for (int a = 0; a < 3; a++)
		beyond += at[a] < 0 || at[a] > 15;
	for (int c = 0; c < 8; c++) {
		int x = key.x * 16 + at[0] + (c & 1), y = key.y * 16 + at[1] + (c >> 1 & 1),
		    z = key.z * 16 + at[2] + (c >> 2);
		expected[c] = filled_value(grid, x, y, z);
		*ret_filled += expected[c] != grid_published(grid, x, y, z);
	}
	*surface |= cell_has_surface(expected) && !beyond;
	if (window->empty || beyond > 1)
		return;
	assert_int_equal(cell_has_surface(expected), window_active(window, at[0], at[1], at[2]));
	if (!cell_has_surface(expected))
		return;
	for (int c = 0; c < 8; c++)
		assert_int_equal(inside(window, at[0] + (c & 1), at[1] + (c >> 1 & 1), at[2] + (c >> 2)),
		                 expected[c] < 0);
	compare_values(window, at, expected);
}

static void compare_window(const struct grid *grid, const struct window *window, uint64_t *ret_filled)
{
	bool surface = false;
	for (int k = -1; k <= 16; k++)
		for (int j = -1; j <= 16; j++)
			for (int i = -1; i <= 16; i++)
				compare_cell(grid, window, (const int[3]){i, j, k}, ret_filled, &surface);
	assert_int_equal(window->empty, !surface);
}

static void a_window_shows_the_cells_with_a_surface_and_the_values_beside_it(void **state)
{
	(void)state;
	struct tools *tools = tools_create();
	uint64_t random = 5, filled = 0;
	for (int g = 0; g < 12; g++) {
		struct grid *grid = grid_create(64 << 20);
		fill_box(grid, &random, (const int[3]){-22, -20, -19}, (const int[3]){41, 38, 24}, g % 5, 1 + g % 4);
		for (int c = 0; c < 8; c++) {
			cubes_gather(grid, (struct patch_key){-(c & 1), -(c >> 1 & 1), -(c >> 2)}, &tools->window);
			compare_window(grid, &tools->window, &filled);
		}
		grid_destroy(grid);
	}
	assert_true(filled > 10000);
	tools_destroy(tools);
}

/* The corner of the cell that belongs to the patch's own blocks is a filled one. */
static void a_patch_without_a_block_of_its_own_can_have_cells(void **state)
{
	(void)state;
	struct tools *tools = tools_create();
	struct grid *grid = grid_create(64 << 20);
	struct surface surface;
	uint64_t filled = 0;
	for (int k = 4; k < 6; k++) {
		set_voxel(grid, 16, 15, k, 100);
		set_voxel(grid, 15, 16, k, 200);
		set_voxel(grid, 16, 16, k, -50);
	}
	mesh(tools, grid, (struct patch_key){0, 0, 0}, &surface);
	assert_int_equal(surface.nt, 2);
	compare_window(grid, &tools->window, &filled);
	assert_true(window_active(&tools->window, 15, 15, 4) && !inside(&tools->window, 15, 15, 4));
	for (int c = 0; c < 27; c++) {
		struct patch_key key = {c % 3 - 1, c / 3 % 3 - 1, c / 9 - 1};
		mesh(tools, grid, key, &surface);
		compare_window(grid, &tools->window, &filled);
	}
	tools_destroy(tools);
	grid_destroy(grid);
}

static void a_field_of_one_sign_or_none_is_empty(void **state)
{
	(void)state;
	struct tools *tools = tools_create();
	struct grid *grid = grid_create(64 << 20);
	struct surface surface;
	mesh(tools, grid, (struct patch_key){0, 0, 0}, &surface);
	assert_true(tools->window.empty);
	for (int c = 0; c < 4096; c++)
		set_voxel(grid, c & 15, c >> 4 & 15, c >> 8, 0);
	mesh(tools, grid, (struct patch_key){0, 0, 0}, &surface);
	assert_true(tools->window.empty && surface.nv == 0 && surface.nt == 0);
	tools_destroy(tools);
	grid_destroy(grid);
}

static void a_vertex_lies_where_the_values_say_rounded_to_the_lattice(void **state)
{
	(void)state;
	static const struct {
		int16_t low, high;
		int at;
	} expected[] = {{-128, 128, 128}, {128, -128, 128},     {-1, 0, 252},   {0, -1, 4},
	                {-1, 3, 64},      {-3, 1, 192},         {-1, 2, 85},    {-2, 1, 171},
	                {-1, 1, 128},     {-32767, 32767, 128}, {-1, 32767, 4}, {-512, 512 - 1, 128},
	                {-300, 1, 252},   {-1, 511, 4},         {-3, 509, 4},   {-9, 503, 5}};
	struct tools *tools = tools_create();
	for (size_t n = 0; n < sizeof expected / sizeof *expected; n++) {
		struct grid *grid = grid_create(64 << 20);
		struct surface surface;
		for (int c = 0; c < 8; c++)
			set_voxel(grid, 5 + (c & 1), 6 + (c >> 1 & 1), 7 + (c >> 2),
			          c & 1 ? expected[n].high : expected[n].low);
		mesh(tools, grid, (struct patch_key){0, 0, 0}, &surface);
		assert_int_equal(surface.nv, 4);
		assert_int_equal(surface.nt, 2);
		for (uint32_t v = 0; v < 4; v++)
			assert_int_equal(surface.vertex[v][0], 5 * LATTICE + expected[n].at);
		grid_destroy(grid);
	}
	tools_destroy(tools);
}

/* Triangles are seen counter-clockwise from the free side: a floor's normals point up. */
static void a_floor_faces_up(void **state)
{
	(void)state;
	struct tools *tools = tools_create();
	struct grid *grid = grid_create(64 << 20);
	struct surface surface;
	for (int k = 2; k < 6; k++)
		for (int c = 0; c < 17 * 17; c++)
			set_voxel(grid, c % 17, c / 17, k, (int16_t)((k - 4) * 256 + 100));
	mesh(tools, grid, (struct patch_key){0, 0, 0}, &surface);
	assert_int_equal(surface.nt, 2 * 16 * 16);
	for (uint32_t t = 0; t < surface.nt; t++) {
		const uint16_t *a = surface.vertex[surface.triangle[t][0]], *b = surface.vertex[surface.triangle[t][1]],
		               *c = surface.vertex[surface.triangle[t][2]];
		assert_true((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) > 0);
		assert_int_equal(a[2], 4 * LATTICE - 100);
	}
	tools_destroy(tools);
	grid_destroy(grid);
}

/* Re-meshing after single changes. The region of patches that may change. */
#define REGION      3
#define REGION_KEYS (REGION * REGION * REGION)

struct held {
	uint32_t nv, nt;
	uint16_t (*vertex)[3];
	uint32_t (*triangle)[3];
};

static struct patch_key region_key(int n)
{
	return (struct patch_key){n % REGION - 1, n / REGION % REGION - 1, n / REGION / REGION - 1};
}

static void hold(struct held *held, const struct surface *surface)
{
	free(held->vertex);
	free(held->triangle);
	*held = (struct held){surface->nv, surface->nt, malloc(surface->nv * 6 + 1), malloc(surface->nt * 12 + 1)};
	if (surface->nv)
		memcpy(held->vertex, surface->vertex, surface->nv * 6);
	if (surface->nt)
		memcpy(held->triangle, surface->triangle, surface->nt * 12);
}

static bool same(const struct held *held, const struct surface *surface)
{
	return held->nv == surface->nv && held->nt == surface->nt &&
	       (!held->nv || !memcmp(held->vertex, surface->vertex, held->nv * 6)) &&
	       (!held->nt || !memcmp(held->triangle, surface->triangle, held->nt * 12));
}

/* The patches that read corner `i` along one axis when their halo is `halo` corners wide below the patch's first corner
 * and above its last one. */
static bool reads(int patch, int i, int halo)
{
	return i >= patch * PATCH_SIDE - halo && i <= patch * PATCH_SIDE + PATCH_SIDE + halo;
}

/* Flips voxels one by one on every layer modulo 16 of each axis and re-meshes what is dirty: the grid's dirty patches
 * (halo < 0), or those a halo of that width would mark. How many of the meshes held at the end, or after any single
 * change, are not what meshing everything gives. */
static int stale_patches(int halo, int changes_a_layer)
{
	struct tools *tools = tools_create();
	struct grid *grid = grid_create(256 << 20);
	struct held held[REGION_KEYS] = {0};
	uint64_t random = 77;
	const struct patch_key *keys;
	struct surface surface;
	int stale = 0;
	fill_box(grid, &random, (const int[3]){-12, -12, -12}, (const int[3]){40, 40, 40}, 0, 4);
	grid_take_dirty(grid, &keys);
	for (int n = 0; n < REGION_KEYS; n++) {
		mesh(tools, grid, region_key(n), &surface);
		hold(&held[n], &surface);
	}
	for (int change = 0; change < 48 * changes_a_layer; change++) {
		int at[3] = {random_below(&random, 20) - 2, random_below(&random, 20) - 2,
		             random_below(&random, 20) - 2};
		at[change % 3] = change / 3 % 16;
		bool known = grid_published(grid, at[0], at[1], at[2]) != UNKNOWN, odd = (change + change / 48) & 1;
		int16_t value = known && odd ? UNKNOWN : (int16_t)(random_below(&random, 1401) - 700);
		set_voxel(grid, at[0], at[1], at[2], value);
		size_t dirty = grid_take_dirty(grid, &keys);
		for (int n = 0; n < REGION_KEYS; n++) {
			struct patch_key key = region_key(n);
			bool marked =
			    reads(key.x, at[0], halo) && reads(key.y, at[1], halo) && reads(key.z, at[2], halo);
			for (size_t d = 0; d < dirty && halo < 0; d++)
				marked |= !patch_key_compare(key, keys[d]);
			mesh(tools, grid, key, &surface);
			stale += !marked && !same(&held[n], &surface);
			hold(&held[n], &surface);
		}
	}
	for (int n = 0; n < REGION_KEYS; n++)
		hold(&held[n], &(struct surface){0});
	for (int n = 0; n < REGION_KEYS; n++) {
		free(held[n].vertex);
		free(held[n].triangle);
	}
	grid_destroy(grid);
	tools_destroy(tools);
	return stale;
}

static void meshing_the_dirty_patches_is_meshing_all(void **state)
{
	(void)state;
	assert_int_equal(stale_patches(-1, 6), 0);
}

/* Extraction itself reads [-1, 17]; the halo of [-2, 18] is the reduction's (test_map). */
static void a_halo_one_voxel_too_small_leaves_stale_patches(void **state)
{
	(void)state;
	assert_int_equal(stale_patches(1, 6), 0);
	assert_true(stale_patches(0, 6) > 0);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_case_uses_exactly_the_edges_that_change_sign),
	    cmocka_unit_test(an_edge_inside_a_case_lies_in_no_cube_face),
	    cmocka_unit_test(an_outline_lies_in_the_faces_and_every_ambiguous_face_separates_its_inside_corners),
	    cmocka_unit_test(all_pairs_of_neighbours_draw_opposite_segments_on_their_face),
	    cmocka_unit_test(every_case_separates_its_inside_corners_from_the_outside),
	    cmocka_unit_test(every_random_field_in_one_patch_closes),
	    cmocka_unit_test(every_random_field_across_patches_closes),
	    cmocka_unit_test(half_unknown_fields_give_oriented_edges_of_two_faces),
	    cmocka_unit_test(a_window_shows_the_cells_with_a_surface_and_the_values_beside_it),
	    cmocka_unit_test(a_patch_without_a_block_of_its_own_can_have_cells),
	    cmocka_unit_test(a_field_of_one_sign_or_none_is_empty),
	    cmocka_unit_test(a_vertex_lies_where_the_values_say_rounded_to_the_lattice),
	    cmocka_unit_test(a_floor_faces_up),
	    cmocka_unit_test(meshing_the_dirty_patches_is_meshing_all),
	    cmocka_unit_test(a_halo_one_voxel_too_small_leaves_stale_patches),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

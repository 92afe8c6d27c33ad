/* L4, L5: a reduced map has no crack, no doubled edge, no rim that the raw one has not, and stays within its bounds. */
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <cmocka.h>

#include "core/distance.h"
#include "core/reduce.h"
#include "tests/soup.h"

struct bench {
	struct arena arena;
	struct window window;
	struct reduce_stats stats;
	struct soup raw, reduced;
	uint64_t faces_raw, faces;
};

static uint64_t random_next(uint64_t *state)
{
	*state = *state * 6364136223846793005ull + 1442695040888963407ull;
	return soup_mix(*state);
}

static int random_below(uint64_t *state, int n)
{
	return (int)(random_next(state) % (uint64_t)n);
}

static void set_voxel(struct grid *grid, const int at[3], int16_t value)
{
	struct block_key key = {at[0] >> BLOCK_SHIFT, at[1] >> BLOCK_SHIFT, at[2] >> BLOCK_SHIFT};
	struct block *block = grid_touch(grid, key);
	int i = at[0] & 7, j = at[1] & 7, k = at[2] & 7;
	const uint8_t layers[3] = {(uint8_t)(1 << i), (uint8_t)(1 << j), (uint8_t)(1 << k)};
	assert_non_null(block);
	block_publish(block, (k * BLOCK_SIDE + j) * BLOCK_SIDE + i, value);
	grid_mark_changed(grid, key, layers);
}

static void soup_add_surface(struct soup *soup, struct patch_key key, const struct surface *surface)
{
	soup_add(soup, key, surface->nv, (const uint16_t(*)[3])surface->vertex, surface->nt,
	         (const uint32_t(*)[3])surface->triangle);
}

/* Meshes and reduces every dirty patch into the two soups. */
static void reduce_all(struct bench *bench, struct grid *grid, double tolerance)
{
	const struct patch_key *keys;
	const struct reduce_params params = {.tolerance = tolerance};
	size_t n = grid_take_dirty(grid, &keys);
	soup_finish(&bench->raw);
	soup_finish(&bench->reduced);
	for (size_t i = 0; i < n; i++) {
		struct surface raw, reduced;
		arena_reset(&bench->arena);
		cubes_gather(grid, keys[i], &bench->window);
		assert_int_equal(cubes_extract(&bench->window, &bench->arena, &raw), 0);
		assert_int_equal(reduce_surface(&bench->window, &raw, &params, &bench->arena, &bench->stats, &reduced),
		                 0);
		soup_add_surface(&bench->raw, keys[i], &raw);
		soup_add_surface(&bench->reduced, keys[i], &reduced);
		bench->faces_raw += raw.nt;
		bench->faces += reduced.nt;
	}
}

/* Edges without their reverse, as pairs of points. */
static uint32_t open_edges(const struct soup *soup, uint32_t (**ret_edges)[2])
{
	size_t slots = 64;
	while (slots < (size_t)soup->nt * 6)
		slots *= 2;
	struct soup_edge *table = calloc(slots, sizeof *table);
	uint32_t(*edges)[2] = calloc(3 * (size_t)soup->nt + 1, sizeof *edges), n = 0;
	for (uint32_t t = 0; t < soup->nt; t++)
		for (int c = 0; c < 3; c++) {
			uint32_t a = soup->triangle[t][c], b = soup->triangle[t][(c + 1) % 3];
			*soup_edge(table, slots, a, b) = (struct soup_edge){a, b, soup->triangle[t][(c + 2) % 3], 1};
		}
	for (uint32_t t = 0; t < soup->nt; t++) {
		uint32_t same = 0;
		for (int c = 0; c < 3; c++) {
			uint32_t a = soup->triangle[t][c], b = soup->triangle[t][(c + 1) % 3];
			const struct soup_edge *back = soup_edge(table, slots, b, a);
			if (!back->used) {
				edges[n][0] = a;
				edges[n++][1] = b;
			}
			same += back->used && back->apex == soup->triangle[t][(c + 2) % 3];
		}
		assert_true(same < 3); /* two faces back to back */
	}
	free(table);
	*ret_edges = edges;
	return n;
}

static struct vec3 place(const struct soup *soup, uint32_t v)
{
	const int64_t *at = soup->point[v].at;
	return (struct vec3){(double)at[0], (double)at[1], (double)at[2]};
}

/* How often a vertex of an open edge lies on another open edge, exactly or within `gap` lattice units. */
static uint32_t junctions(const struct soup *soup, const uint32_t (*edges)[2], uint32_t n, double gap)
{
	uint32_t found = 0;
	for (uint32_t e = 0; e < n; e++)
		for (uint32_t f = 0; f < n; f++) {
			uint32_t v = edges[f][0], a = edges[e][0], b = edges[e][1];
			if (v == a || v == b)
				continue;
			struct vec3 pa = place(soup, a), ab = vec3_sub(place(soup, b), pa),
			            av = vec3_sub(place(soup, v), pa);
			double along = vec3_dot(ab, av), length = vec3_dot(ab, ab);
			if (along <= 0 || along >= length)
				continue;
			struct vec3 foot = vec3_sub(av, vec3_scale(ab, along / length));
			found += vec3_dot(foot, foot) < gap * gap;
		}
	return found;
}

static double rim_distance(const struct soup *soup, const uint32_t (*edges)[2], uint32_t n, struct vec3 p)
{
	double best = INFINITY;
	for (uint32_t e = 0; e < n; e++) {
		double squared = segment_distance_squared(place(soup, edges[e][0]), place(soup, edges[e][1]), p);
		best = squared < best ? squared : best;
	}
	return sqrt(best);
}

static double soup_distance(const struct soup *soup, struct vec3 p)
{
	double best = INFINITY;
	for (uint32_t t = 0; t < soup->nt; t++) {
		const uint32_t *v = soup->triangle[t];
		struct flat flat = flat_make(place(soup, v[0]), place(soup, v[1]), place(soup, v[2]));
		double squared = flat_distance_squared(&flat, p);
		best = squared < best ? squared : best;
	}
	return sqrt(best);
}

/* Sound, and open only where the raw one is, or half a cell beside it. */
static void check_topology(struct bench *bench)
{
	struct soup_faults raw = soup_judge(&bench->raw), faults = soup_judge(&bench->reduced);
	assert_int_equal(faults.repeated_edges, 0);
	assert_int_equal(faults.flat, 0);
	if (!raw.open_edges) {
		assert_int_equal(faults.open_edges, 0);
		if (!raw.split_points)
			assert_int_equal(faults.split_points, 0);
	}
	uint32_t(*edges)[2], (*before)[2], n = open_edges(&bench->reduced, &edges),
	                                   m = open_edges(&bench->raw, &before);
	assert_int_equal(junctions(&bench->reduced, (const uint32_t(*)[2])edges, n, 0.1), 0);
	for (uint32_t e = 0; e < n; e++)
		for (int step = 0; step <= 4; step++) {
			struct vec3 p = vec3_lerp(place(&bench->reduced, edges[e][0]),
			                          place(&bench->reduced, edges[e][1]), step / 4.0);
			assert_true(rim_distance(&bench->raw, (const uint32_t(*)[2])before, m, p) < 0.51 * LATTICE);
		}
	free(edges);
	free(before);
}

/* No raw vertex is farther from the reduced surface than the tolerance, or half a cell beside a rim. */
static void check_distance(struct bench *bench, double tolerance)
{
	uint32_t(*before)[2], m = open_edges(&bench->raw, &before);
	for (uint32_t v = 0; v < bench->raw.nv; v++) {
		double distance = soup_distance(&bench->reduced, place(&bench->raw, v));
		if (distance <= tolerance * LATTICE + 1e-6)
			continue;
		assert_true(distance <= 0.5 * LATTICE + 1e-6);
		assert_true(rim_distance(&bench->raw, (const uint32_t(*)[2])before, m, place(&bench->raw, v)) < 1e-6);
	}
	free(before);
}

/* Values of one of several kinds of field: noise, chequered, a ball, a thin wall, a slanted plane, an edge. */
static int16_t field_value(uint64_t *random, int kind, const int at[3], const int slope[3])
{
	int x = at[0], y = at[1], z = at[2], noise = random_below(random, 41) - 20;
	int plane = slope[0] * x + slope[1] * y + slope[2] * z;
	switch (kind) {
	case 0:
		return (int16_t)(random_below(random, 1401) - 700);
	case 1:
		return (int16_t)(random_below(random, 3) - 1);
	case 2:
		return (int16_t)(((x + y + z) & 1 ? 1 : -1) * (1 + random_below(random, 40)));
	case 3:
		return (int16_t)((x * x + y * y + z * z - 12) * 30 + noise);
	case 4:
		return (int16_t)((plane < 0 ? -plane : plane) - 200 + noise);
	case 5:
		return (int16_t)(plane + noise);
	default:
		return (int16_t)((plane > y * 250 ? plane : y * 250) + noise / 4);
	}
}

/* A box of random side and place; `closed` gives it a layer of outside values. */
static void fill_box(struct grid *grid, uint64_t *random, int base, int spread, int kind, int unknown_of_8, bool closed)
{
	int low[3], side[3], slope[3];
	for (int a = 0; a < 3; a++) {
		low[a] = base + random_below(random, spread);
		side[a] = 4 + random_below(random, 6);
		slope[a] = random_below(random, 401) - 200;
	}
	for (int k = 0; k < side[2]; k++)
		for (int j = 0; j < side[1]; j++)
			for (int i = 0; i < side[0]; i++) {
				const int at[3] = {low[0] + i, low[1] + j, low[2] + k};
				const int from[3] = {i - side[0] / 2, j - side[1] / 2, k - side[2] / 2};
				bool rim = !i || !j || !k || i == side[0] - 1 || j == side[1] - 1 || k == side[2] - 1;
				int16_t value = field_value(random, kind, from, slope);
				if (closed && rim && value < 0)
					value = (int16_t)-value;
				if (random_below(random, 8) < unknown_of_8)
					value = VOXEL_UNKNOWN;
				set_voxel(grid, at, value);
			}
}

static void check_random_fields(struct bench *bench, int grids, int unknown_of_8, bool closed, uint64_t seed)
{
	bench->faces_raw = bench->faces = 0;
	for (int g = 0; g < grids; g++) {
		struct grid *grid = grid_create(16 << 20);
		static const double tolerances[3] = {0.5, 0.25, 0.05};
		double tolerance = tolerances[g % 3];
		fill_box(grid, &seed, 8, 8, g % 7, unknown_of_8, closed);
		reduce_all(bench, grid, tolerance);
		check_topology(bench);
		if (g % 10 == 0)
			check_distance(bench, tolerance);
		grid_destroy(grid);
	}
	assert_int_equal(bench->stats.border_merged, 0);
	assert_true(bench->faces < bench->faces_raw);
}

static void a_closed_random_field_across_patches_stays_closed(void **state)
{
	check_random_fields(*state, 4000, 0, true, 1);
}

static void a_random_field_with_rims_gets_no_other_rims(void **state)
{
	check_random_fields(*state, 3000, 0, false, 2);
}

static void a_half_unknown_random_field_gets_no_crack(void **state)
{
	check_random_fields(*state, 3000, 1, false, 3);
	check_random_fields(*state, 1000, 3, false, 4);
	struct bench *bench = *state;
	printf("note: border: %llu collapsed, %llu relaxed, %llu ears, %llu merged\n",
	       (unsigned long long)bench->stats.border_collapsed, (unsigned long long)bench->stats.border_relaxed,
	       (unsigned long long)bench->stats.border_ears, (unsigned long long)bench->stats.border_merged);
}

static double least(double a, double b)
{
	return a < b ? a : b;
}

static double distance_to_box(const double p[3], const double low[3], const double high[3])
{
	double outside = 0, inside = -INFINITY;
	for (int a = 0; a < 3; a++) {
		double d = p[a] < low[a] + high[a] - p[a] ? low[a] - p[a] : p[a] - high[a];
		outside += d > 0 ? d * d : 0;
		inside = d > inside ? d : inside;
	}
	return outside > 0 ? sqrt(outside) : inside;
}

/* A floor, a cupboard, a table top of one cell, a ball and a slanted wall, in cells. */
static double world(const double p[3])
{
	static const double cupboard[2][3] = {{6.3, 20.2, 0}, {19.6, 33.7, 27.4}};
	static const double table[2][3] = {{24.2, 5.1, 17.3}, {42.8, 18.4, 18.5}};
	double x = p[0] - 34.5, y = p[1] - 34.2, z = p[2] - 20.6, d = p[2] - 4.37 - 0.02 * p[0];
	d = least(d, distance_to_box(p, cupboard[0], cupboard[1]));
	d = least(d, distance_to_box(p, table[0], table[1]));
	d = least(d, sqrt(x * x + y * y + z * z) - 7.7);
	return least(d, 0.8 * p[0] + 0.6 * p[1] - 9.3);
}

/* The world in a band of three cells, noise of a tenth of a cell, a corner of it never seen. */
static void fill_world(struct grid *grid, uint64_t *random)
{
	for (int k = 0; k < 3 * PATCH_SIDE; k++)
		for (int j = 0; j < 3 * PATCH_SIDE; j++)
			for (int i = 0; i < 3 * PATCH_SIDE; i++) {
				const int at[3] = {i - PATCH_SIDE, j, k};
				const double p[3] = {i, j, k};
				double d = world(p) * LATTICE + random_below(random, 51) - 25;
				bool unknown = fabs(d) > 3 * LATTICE || i + j + k + random_below(random, 4) > 105;
				set_voxel(grid, at, unknown ? VOXEL_UNKNOWN : (int16_t)d);
			}
}

static void a_furnished_world_of_27_patches_is_sound_and_within_its_bounds(void **state)
{
	struct bench *bench = *state;
	uint64_t seed = 11;
	for (int noise = 0; noise < 2; noise++) {
		struct grid *grid = grid_create(64 << 20);
		fill_world(grid, &seed);
		bench->faces_raw = bench->faces = 0;
		reduce_all(bench, grid, 0.25);
		assert_true(bench->faces_raw > 10000);
		assert_true(bench->faces * 100 < bench->faces_raw * 12);
		check_topology(bench);
		check_distance(bench, 0.25);
		grid_destroy(grid);
	}
	assert_int_equal(bench->stats.border_merged, 0);
	printf("note: world of 27 patches: %llu of %llu faces\n", (unsigned long long)bench->faces,
	       (unsigned long long)bench->faces_raw);
}

static void the_order_of_patches_and_what_was_before_do_not_matter(void **state)
{
	struct bench *bench = *state;
	struct grid *grid = grid_create(64 << 20);
	const struct patch_key *keys;
	const struct reduce_params params = {.tolerance = 0.25};
	uint64_t seed = 12, hash[2][216];
	fill_world(grid, &seed);
	size_t n = grid_take_dirty(grid, &keys);
	assert_true(n <= 216);
	for (int backwards = 0; backwards < 2; backwards++)
		for (size_t k = 0; k < n; k++) {
			size_t i = backwards ? n - 1 - k : k;
			struct surface raw, reduced;
			if (!backwards)
				arena_reset(&bench->arena);
			cubes_gather(grid, keys[i], &bench->window);
			assert_int_equal(cubes_extract(&bench->window, &bench->arena, &raw), 0);
			assert_int_equal(
			    reduce_surface(&bench->window, &raw, &params, &bench->arena, &bench->stats, &reduced), 0);
			uint64_t h = reduced.nt;
			for (uint32_t t = 0; t < reduced.nt; t++)
				for (int c = 0; c < 3; c++)
					for (int a = 0; a < 3; a++)
						h = soup_mix(h + reduced.vertex[reduced.triangle[t][c]][a]);
			hash[backwards][i] = h;
		}
	assert_memory_equal(hash[0], hash[1], n * sizeof hash[0][0]);
	grid_destroy(grid);
}

static int create(void **state)
{
	struct bench *bench = calloc(1, sizeof *bench);
	arena_init(&bench->arena);
	*state = bench;
	return 0;
}

static int destroy(void **state)
{
	struct bench *bench = *state;
	arena_finish(&bench->arena);
	soup_finish(&bench->raw);
	soup_finish(&bench->reduced);
	free(bench);
	return 0;
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_closed_random_field_across_patches_stays_closed),
	    cmocka_unit_test(a_random_field_with_rims_gets_no_other_rims),
	    cmocka_unit_test(a_half_unknown_random_field_gets_no_crack),
	    cmocka_unit_test(a_furnished_world_of_27_patches_is_sound_and_within_its_bounds),
	    cmocka_unit_test(the_order_of_patches_and_what_was_before_do_not_matter),
	};
	return cmocka_run_group_tests(tests, create, destroy);
}

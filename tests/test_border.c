/* L4: both neighbours of a patch face find the same polyline on it, and end with exactly that. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>
#include <cmocka.h>

#include "core/border_fit.h"
#include "core/predicates.h"
#include "tests/window.h"

#define TOLERANCE 64

struct side {
	struct window window;
	struct surface raw;
	struct border border;
};

struct polyline {
	int32_t point[1024][2];
	bool kept[1024];
	uint32_t n;
	bool closed;
};

/* Noise of several kinds about two crossing walls; `unknown` of 64 corners unknown. */
static int crossing_walls(struct window_noise *noise, int kind, int i, int j, int k)
{
	int a = i * 90 + j * 61 - k * 40 - 1000, b = j * 100 - i * 30 + k * 70 - 900, value = a > b ? a : b;
	int random = (int)(window_random(&noise->random) % (uint64_t)(2 * noise->noise + 1)) - noise->noise;
	if ((int)(window_random(&noise->random) % 64) < noise->unknown_of_64)
		return VOXEL_UNKNOWN;
	return kind == 0 ? value + random : kind == 1 ? random : (i + j + k) & 1 ? random : -random;
}

/* The windows of patch 0,0,0 and of its upper neighbour along `axis`. */
static void make_sides(struct side side[2], int axis, int kind, struct window_noise noise, struct arena *arena)
{
	struct grid *grid = grid_create(64 << 20);
	int high[3] = {WINDOW_SIDE - WINDOW_LOW, WINDOW_SIDE - WINDOW_LOW, WINDOW_SIDE - WINDOW_LOW};
	high[axis] += PATCH_SIDE;
	for (int k = -WINDOW_LOW; k < high[2]; k++)
		for (int j = -WINDOW_LOW; j < high[1]; j++)
			for (int i = -WINDOW_LOW; i < high[0]; i++)
				window_set(grid, i, j, k, crossing_walls(&noise, kind, i, j, k));
	for (int s = 0; s < 2; s++) {
		struct patch_key key = {s && axis == 0, s && axis == 1, s && axis == 2};
		cubes_gather(grid, key, &side[s].window);
		assert_int_equal(cubes_extract(&side[s].window, arena, &side[s].raw), 0);
		assert_int_equal(border_find(&side[s].window, &side[s].raw, TOLERANCE, arena, &side[s].border), 0);
	}
	grid_destroy(grid);
}

/* The chains on one face, in that face's two coordinates. */
static uint32_t polylines(const struct side *side, int axis, int high, struct polyline *ret)
{
	const int in[2] = {axis == 0, axis == 2 ? 1 : 2};
	uint32_t n = 0;
	for (uint32_t c = 0; c < side->border.chains; c++) {
		const struct border_chain *chain = &side->border.chain[c];
		if (chain->axis != axis || chain->high != high)
			continue;
		struct polyline *line = &ret[n++];
		line->n = chain->n;
		line->closed = chain->closed;
		for (uint32_t k = 0; k < chain->n; k++) {
			const uint16_t *p = side->raw.vertex[side->border.member[chain->first + k]];
			assert_int_equal(p[axis], high * PATCH_SIDE * LATTICE);
			line->point[k][0] = p[in[0]];
			line->point[k][1] = p[in[1]];
			line->kept[k] = side->border.kept[chain->first + k];
		}
	}
	return n;
}

/* Ends stay, a closed one keeps three, what goes is near the step that replaces it. Returns how many went. */
static uint32_t check_polyline(const struct polyline *line)
{
	uint32_t kept = 0, before = 0;
	assert_true(line->kept[0] && (line->closed || line->kept[line->n - 1]));
	for (uint32_t k = 0; k < line->n; k++) {
		kept += line->kept[k];
		before = line->kept[k] ? k : before;
		uint32_t after = k;
		while (!line->kept[after % line->n])
			after++;
		const int32_t *a = line->point[before], *b = line->point[after % line->n], *p = line->point[k];
		int64_t across = orientation(a, b, p);
		assert_true(across * across <= (int64_t)TOLERANCE * TOLERANCE * distance_squared2(a, b));
	}
	assert_true(!line->closed || kept >= 3);
	return line->n - kept;
}

struct step {
	int32_t a[2], b[2];
};

/* Steps of one face meet in common ends only. */
static void check_steps(const struct polyline *line, uint32_t lines)
{
	static struct step step[4096];
	uint32_t n = 0;
	for (uint32_t l = 0; l < lines; l++)
		for (uint32_t k = 0; k < line[l].n; k++) {
			if (!line[l].kept[k] || (!line[l].closed && k + 1 == line[l].n))
				continue;
			uint32_t after = k + 1;
			while (!line[l].kept[after % line[l].n])
				after++;
			memcpy(step[n].a, line[l].point[k], sizeof step[n].a);
			memcpy(step[n++].b, line[l].point[after % line[l].n], sizeof step[n].b);
		}
	for (uint32_t i = 0; i < n; i++)
		for (uint32_t j = 0; j < i; j++) {
			bool joined = !memcmp(step[i].a, step[j].a, 8) || !memcmp(step[i].a, step[j].b, 8) ||
			              !memcmp(step[i].b, step[j].a, 8) || !memcmp(step[i].b, step[j].b, 8);
			assert_true(joined || !segments_touch(step[i].a, step[i].b, step[j].a, step[j].b));
		}
}

static void both_neighbours_find_the_same_polylines(void **state)
{
	(void)state;
	static struct side side[2];
	static struct polyline line[2][512];
	struct arena arena;
	uint32_t lines = 0, gone = 0;
	arena_init(&arena);
	for (int i = 0; i < 120; i++) {
		int axis = i % 3, kind = i / 3 % 3;
		struct window_noise noise = {(uint64_t)i, kind ? 300 : 60, i % 4 * 3};
		arena_reset(&arena);
		make_sides(side, axis, kind, noise, &arena);
		uint32_t n = polylines(&side[0], axis, 1, line[0]), m = polylines(&side[1], axis, 0, line[1]);
		assert_int_equal(n, m);
		lines += n;
		for (uint32_t l = 0; l < n; l++) {
			const struct polyline *a = &line[0][l], *b = &line[1][l];
			assert_int_equal(a->n, b->n);
			assert_int_equal(a->closed, b->closed);
			assert_memory_equal(a->point, b->point, a->n * sizeof a->point[0]);
			assert_memory_equal(a->kept, b->kept, a->n * sizeof a->kept[0]);
			gone += check_polyline(a);
		}
		check_steps(line[0], n);
	}
	assert_true(lines > 1000 && gone > 1000);
	arena_finish(&arena);
}

/* All border half-edges within patch faces whose ends are border vertices are the steps and nothing else. */
static void check_fitted(const struct halfedge_mesh *mesh, const struct border *border)
{
	for (uint32_t c = 0; c < border->chains; c++) {
		const struct border_chain *chain = &border->chain[c];
		uint32_t before = border->member[chain->first];
		for (uint32_t k = 1; k < chain->n + chain->closed; k++) {
			uint32_t m = chain->first + k % chain->n, v = border->member[m];
			if (!border->kept[m]) {
				assert_true(mesh->first[v] == HALFEDGE_NONE || border->faces[v] == 0);
				continue;
			}
			uint32_t h = halfedge_find(mesh, before, v), g = halfedge_find(mesh, v, before);
			assert_true((h == HALFEDGE_NONE) != (g == HALFEDGE_NONE));
			before = v;
		}
	}
}

static void the_mesh_ends_with_exactly_the_polylines(void **state)
{
	(void)state;
	static struct side side[2];
	struct arena arena;
	struct reduce_stats stats = {0};
	arena_init(&arena);
	for (int i = 0; i < 120; i++) {
		struct window_noise noise = {(uint64_t)i + 1000, i % 2 ? 300 : 60, i % 4 * 3};
		arena_reset(&arena);
		make_sides(side, i % 3, i % 4, noise, &arena);
		for (int s = 0; s < 2; s++) {
			struct halfedge_mesh mesh;
			if (!side[s].raw.nt)
				continue;
			assert_int_equal(halfedge_build(&side[s].raw, side[s].border.members, &arena, &mesh), 0);
			border_fit(&mesh, &side[s].border, &stats);
			assert_null(halfedge_check(&mesh));
			check_fitted(&mesh, &side[s].border);
		}
	}
	assert_int_equal(stats.border_merged, 0);
	assert_true(stats.border_collapsed > 1000 && stats.border_ears > 10);
	arena_finish(&arena);
}

static int wall(void *ctx, int i, int j, int k)
{
	(void)ctx;
	(void)i;
	(void)j;
	return k * 256 - 2100;
}

static int wall_known_to_the_face(void *ctx, int i, int j, int k)
{
	return i > PATCH_SIDE ? VOXEL_UNKNOWN : wall(ctx, i, j, k);
}

static void a_flat_wall_keeps_its_four_corners(void **state)
{
	(void)state;
	static struct side side;
	struct arena arena;
	uint32_t kept = 0;
	arena_init(&arena);
	window_sample(&side.window, wall, NULL);
	assert_int_equal(cubes_extract(&side.window, &arena, &side.raw), 0);
	assert_int_equal(border_find(&side.window, &side.raw, TOLERANCE, &arena, &side.border), 0);
	assert_int_equal(side.border.chains, 4);
	for (uint32_t m = 0; m < side.border.members; m++)
		kept += side.border.kept[m];
	assert_int_equal(kept, 8); /* each corner on two faces */
	arena_finish(&arena);
}

static void where_only_one_side_has_a_surface_there_is_no_chain(void **state)
{
	(void)state;
	static struct side side;
	struct arena arena;
	uint32_t free_vertices = 0;
	arena_init(&arena);
	window_sample(&side.window, wall_known_to_the_face, NULL);
	assert_int_equal(cubes_extract(&side.window, &arena, &side.raw), 0);
	assert_int_equal(border_find(&side.window, &side.raw, TOLERANCE, &arena, &side.border), 0);
	assert_int_equal(side.border.chains, 3);
	for (uint32_t v = 0; v < side.raw.nv; v++)
		free_vertices += side.border.kind[v] == BORDER_FREE;
	assert_int_equal(free_vertices, PATCH_SIDE - 1);
	arena_finish(&arena);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(both_neighbours_find_the_same_polylines),
	    cmocka_unit_test(the_mesh_ends_with_exactly_the_polylines),
	    cmocka_unit_test(a_flat_wall_keeps_its_four_corners),
	    cmocka_unit_test(where_only_one_side_has_a_surface_there_is_no_chain),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

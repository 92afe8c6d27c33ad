/* L5: what is simplified stays within the tolerance both ways, rims within half a cell, and is the same every time. */
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

#include "core/border_fit.h"
#include "core/simplify.h"
#include "tests/window.h"

struct made {
	struct window window;
	struct surface raw;
	struct simplify s;
	struct arena arena;
};

static void make(struct made *made, window_field *field, void *ctx)
{
	struct border border;
	struct reduce_stats stats = {0};
	arena_reset(&made->arena);
	window_sample(&made->window, field, ctx);
	assert_int_equal(cubes_extract(&made->window, &made->arena, &made->raw), 0);
	assert_int_equal(border_find(&made->window, &made->raw, 64, &made->arena, &border), 0);
	assert_int_equal(simplify_init(&made->s, &made->raw, &border, 0.25, &made->arena), 0);
	border_fit(&made->s.mesh, &made->s.border, &stats);
	simplify_settle(&made->s);
	assert_int_equal(simplify_collapse(&made->s, &made->arena), 0);
	assert_null(halfedge_check(&made->s.mesh));
}

static uint32_t triangles(const struct halfedge_mesh *mesh)
{
	uint32_t n = 0;
	for (uint32_t t = 0; t < mesh->nt; t++)
		n += halfedge_alive(mesh, t);
	return n;
}

static struct flat flat_of(const struct simplify *s, uint32_t t)
{
	return flat_make(simplify_place(s, s->mesh.origin[3 * t]), simplify_place(s, s->mesh.origin[3 * t + 1]),
	                 simplify_place(s, s->mesh.origin[3 * t + 2]));
}

static double distance_to_mesh(const struct simplify *s, struct vec3 p)
{
	double best = INFINITY;
	for (uint32_t t = 0; t < s->mesh.nt; t++) {
		if (!halfedge_alive(&s->mesh, t))
			continue;
		struct flat flat = flat_of(s, t);
		double squared = flat_distance_squared(&flat, p);
		best = squared < best ? squared : best;
	}
	return sqrt(best);
}

static double distance_to_raw(const struct made *made, struct vec3 p)
{
	double best = INFINITY;
	for (uint32_t t = 0; t < made->raw.nt; t++) {
		const uint32_t *v = made->raw.triangle[t];
		struct flat flat = flat_make(made->s.origin[v[0]], made->s.origin[v[1]], made->s.origin[v[2]]);
		double squared = flat_distance_squared(&flat, p);
		best = squared < best ? squared : best;
	}
	return sqrt(best);
}

/* Distances of points spread over the triangles; how many of `ret_n` lie beyond the tolerance. */
static uint32_t far_points(const struct made *made, uint32_t *ret_n, double *ret_most)
{
	uint32_t far = 0;
	*ret_n = 0;
	*ret_most = 0;
	for (uint32_t t = 0; t < made->s.mesh.nt; t++) {
		if (!halfedge_alive(&made->s.mesh, t))
			continue;
		struct flat flat = flat_of(&made->s, t);
		for (int i = 0; i < 6; i++)
			for (int j = 0; i + j < 6; j++, (*ret_n)++) {
				struct vec3 p = vec3_add(flat.a, vec3_add(vec3_scale(flat.ab, (i + 0.3) / 6),
				                                          vec3_scale(flat.ac, (j + 0.3) / 6)));
				double distance = distance_to_raw(made, p);
				far += distance > 64;
				*ret_most = distance > *ret_most ? distance : *ret_most;
			}
	}
	return far;
}

static void a_noisy_ball_stays_within_the_tolerance_both_ways(void **state)
{
	struct made *made = *state;
	for (uint64_t seed = 0; seed < 4; seed++) {
		struct window_noise noise = {seed, 120, 0};
		uint32_t n;
		double most;
		make(made, window_noisy_ball, &noise);
		for (uint32_t v = 0; v < made->raw.nv; v++)
			assert_true(distance_to_mesh(&made->s, made->s.origin[v]) <= 64 + 1e-6);
		uint32_t far = far_points(made, &n, &most);
		assert_true(far * 50 <= n);
		assert_true(most <= LATTICE);
		assert_true(triangles(&made->s.mesh) < made->raw.nt * 3 / 5);
	}
}

static int wall(void *ctx, int i, int j, int k)
{
	const int *known = ctx;
	return i > known[0] || j > known[1] + (i & 1) ? VOXEL_UNKNOWN : k * 256 - 2100 - 9 * i + 4 * j;
}

static void a_flat_wall_ends_as_two_triangles(void **state)
{
	struct made *made = *state;
	int known[2] = {100, 100};
	make(made, wall, known);
	assert_int_equal(triangles(&made->s.mesh), 2);
}

static void a_rim_moves_sideways_by_half_a_cell_at_most(void **state)
{
	struct made *made = *state;
	int known[2] = {11, 9};
	make(made, wall, known);
	assert_true(triangles(&made->s.mesh) < made->raw.nt / 5);
	for (uint32_t v = 0; v < made->raw.nv; v++)
		assert_true(distance_to_mesh(&made->s, made->s.origin[v]) <= LATTICE / 2.0 + 1e-6);
}

static int corner(void *ctx, int i, int j, int k)
{
	(void)ctx;
	int a = i * 256 - 1300, b = j * 256 - 1500, c = k * 256 - 1700, most = a > b ? a : b;
	return most > c ? most : c;
}

static void the_corner_of_a_room_keeps_few_triangles(void **state)
{
	struct made *made = *state;
	make(made, corner, NULL);
	assert_true(made->raw.nt > 150);
	assert_true(triangles(&made->s.mesh) <= 24);
}

/* Every vertex that went is in one list: of a triangle that stays, or of a half-edge of a rim that stays. */
static void what_went_is_listed_exactly_once(void **state)
{
	struct made *made = *state;
	for (uint64_t seed = 0; seed < 6; seed++) {
		struct window_noise noise = {seed, 200, (int)seed};
		make(made, window_noisy_ball, &noise);
		const struct simplify *s = &made->s;
		uint32_t *count = ARENA_NEW(&made->arena, uint32_t, s->mesh.nv);
		for (uint32_t t = 0; t < s->mesh.nt; t++) {
			if (!halfedge_alive(&s->mesh, t))
				continue;
			for (uint32_t p = s->points[t]; p != UINT32_MAX; p = s->next_point[p])
				count[p]++;
			for (uint32_t h = 3 * t; h < 3 * t + 3; h++)
				for (uint32_t p = s->rim_points[h]; p != UINT32_MAX; p = s->next_point[p]) {
					assert_true(s->mesh.twin[h] == HALFEDGE_NONE);
					count[p]++;
				}
		}
		for (uint32_t v = 0; v < s->mesh.nv; v++) {
			bool border = s->border.kind[v] == BORDER_CHAIN;
			assert_int_equal(count[v], s->mesh.first[v] == HALFEDGE_NONE && !border);
		}
	}
}

static void the_same_window_gives_the_same_mesh_whatever_the_arena_held(void **state)
{
	struct made *made = *state;
	struct window_noise noise = {5, 300, 2};
	make(made, window_noisy_ball, &noise);
	uint32_t nt = made->s.mesh.nt, *before = malloc(3 * (size_t)nt * sizeof *before);
	memcpy(before, made->s.mesh.origin, 3 * (size_t)nt * sizeof *before);
	for (int size = 100; size < 3000; size += 700) {
		arena_reset(&made->arena);
		memset(arena_alloc(&made->arena, 1000, (size_t)size), 0xa5, 1000 * (size_t)size);
		noise = (struct window_noise){5, 300, 2};
		make(made, window_noisy_ball, &noise);
		assert_int_equal(made->s.mesh.nt, nt);
		assert_memory_equal(made->s.mesh.origin, before, 3 * (size_t)nt * sizeof *before);
	}
	free(before);
}

static int create(void **state)
{
	struct made *made = calloc(1, sizeof *made);
	arena_init(&made->arena);
	*state = made;
	return 0;
}

static int destroy(void **state)
{
	struct made *made = *state;
	arena_finish(&made->arena);
	free(made);
	return 0;
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_noisy_ball_stays_within_the_tolerance_both_ways),
	    cmocka_unit_test(a_flat_wall_ends_as_two_triangles),
	    cmocka_unit_test(a_rim_moves_sideways_by_half_a_cell_at_most),
	    cmocka_unit_test(the_corner_of_a_room_keeps_few_triangles),
	    cmocka_unit_test(what_went_is_listed_exactly_once),
	    cmocka_unit_test(the_same_window_gives_the_same_mesh_whatever_the_arena_held),
	};
	return cmocka_run_group_tests(tests, create, destroy);
}

/* The half-edge mesh keeps its invariants through every operation, and its check finds each of them broken. */
#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>
#include <cmocka.h>

#include "core/halfedge.h"
#include "tests/window.h"

static struct window window;

static void make_mesh(struct arena *arena, struct window_noise noise, struct halfedge_mesh *ret)
{
	struct surface surface;
	window_sample(&window, window_noisy_ball, &noise);
	assert_int_equal(cubes_extract(&window, arena, &surface), 0);
	assert_int_equal(halfedge_build(&surface, 4, arena, ret), 0);
}

/* Vertices - edges + triangles. */
static int characteristic(const struct halfedge_mesh *mesh)
{
	int vertices = 0, half = 0, border = 0, triangles = 0;
	for (uint32_t v = 0; v < mesh->nv; v++)
		vertices += mesh->first[v] != HALFEDGE_NONE;
	for (uint32_t h = 0; h < 3 * mesh->nt; h++) {
		half += mesh->origin[h] != HALFEDGE_NONE;
		border += mesh->origin[h] != HALFEDGE_NONE && mesh->twin[h] == HALFEDGE_NONE;
	}
	for (uint32_t t = 0; t < mesh->nt; t++)
		triangles += halfedge_alive(mesh, t);
	return vertices - (half + border) / 2 + triangles;
}

static bool touching(const struct halfedge_mesh *mesh, uint32_t v)
{
	int borders = 0;
	HALFEDGE_EACH(mesh, h, v)
	borders += mesh->twin[h] == HALFEDGE_NONE;
	return borders > 1;
}

static void raw_surfaces_of_random_fields_are_sound(void **state)
{
	(void)state;
	struct arena arena;
	arena_init(&arena);
	for (uint64_t seed = 0; seed < 40; seed++) {
		struct halfedge_mesh mesh;
		arena_reset(&arena);
		make_mesh(&arena, (struct window_noise){seed, seed % 4 ? 400 : 0, (int)(seed % 8)}, &mesh);
		assert_null(halfedge_check(&mesh));
		assert_true(mesh.nt > 100);
	}
	arena_finish(&arena);
}

static bool may_collapse(struct halfedge_mesh *mesh, uint32_t h, uint32_t v)
{
	struct halfedge_ring ring;
	halfedge_mark_ring(mesh, halfedge_other(mesh, h, v));
	return halfedge_gather(mesh, v, &ring) && halfedge_may_collapse(mesh, &ring, h);
}

static void every_collapse_that_may_be_keeps_a_surface_of_the_same_kind(void **state)
{
	(void)state;
	struct arena arena;
	uint64_t random = 3;
	uint32_t done = 0;
	arena_init(&arena);
	for (uint64_t seed = 0; seed < 12; seed++) {
		struct halfedge_mesh mesh;
		arena_reset(&arena);
		make_mesh(&arena, (struct window_noise){seed, 300, (int)(seed % 3)}, &mesh);
		int before = characteristic(&mesh);
		for (int i = 0; i < 6000; i++) {
			uint32_t h = (uint32_t)(window_random(&random) % (3 * mesh.nt));
			if (mesh.origin[h] == HALFEDGE_NONE)
				continue;
			uint32_t v = i & 1 ? mesh.origin[h] : halfedge_target(&mesh, h);
			if (touching(&mesh, v) || !may_collapse(&mesh, h, v))
				continue;
			halfedge_collapse(&mesh, h, v);
			done++;
			if (i % 50 == 0)
				assert_null(halfedge_check(&mesh));
		}
		assert_null(halfedge_check(&mesh));
		assert_int_equal(characteristic(&mesh), before);
	}
	assert_true(done > 3000);
	arena_finish(&arena);
}

static void a_triangle_that_is_removed_and_added_again_changes_nothing(void **state)
{
	(void)state;
	struct arena arena;
	struct halfedge_mesh mesh;
	uint64_t random = 5;
	arena_init(&arena);
	make_mesh(&arena, (struct window_noise){1, 200, 1}, &mesh);
	int before = characteristic(&mesh);
	for (int i = 0; i < 500; i++) {
		uint32_t t = (uint32_t)(window_random(&random) % mesh.nt), corner[3];
		memcpy(corner, &mesh.origin[3 * t], sizeof corner);
		halfedge_remove(&mesh, t);
		assert_false(halfedge_alive(&mesh, t));
		if (i % 25 == 0)
			assert_null(halfedge_check(&mesh));
		halfedge_add(&mesh, t, corner[1], corner[2], corner[0]);
	}
	assert_null(halfedge_check(&mesh));
	assert_int_equal(characteristic(&mesh), before);
	arena_finish(&arena);
}

/* The same lists too: what comes later goes through them in order. */
static void a_flip_is_two_triangles_removed_and_two_added(void **state)
{
	(void)state;
	struct arena arena;
	arena_init(&arena);
	for (uint64_t seed = 0; seed < 8; seed++) {
		struct halfedge_mesh mesh, other;
		uint32_t flips = 0;
		arena_reset(&arena);
		make_mesh(&arena, (struct window_noise){seed, 400, 3}, &mesh);
		make_mesh(&arena, (struct window_noise){seed, 400, 3}, &other);
		for (uint32_t h = 0; h < 3 * mesh.nt; h++) {
			uint32_t g = mesh.twin[h];
			if (g == HALFEDGE_NONE)
				continue;
			uint32_t a = mesh.origin[h], b = mesh.origin[g];
			uint32_t c = mesh.origin[halfedge_previous(h)], d = mesh.origin[halfedge_previous(g)];
			if (c == d || halfedge_joined(&mesh, c, d))
				continue;
			halfedge_flip(&mesh, h);
			halfedge_remove(&other, h / 3);
			halfedge_remove(&other, g / 3);
			halfedge_add(&other, h / 3, c, a, d);
			halfedge_add(&other, g / 3, d, b, c);
			flips++;
		}
		assert_true(flips > 100);
		assert_null(halfedge_check(&mesh));
		assert_memory_equal(mesh.first, other.first, mesh.nv * sizeof *mesh.first);
		assert_memory_equal(mesh.origin, other.origin, 3 * mesh.nt * sizeof *mesh.origin);
		assert_memory_equal(mesh.twin, other.twin, 3 * mesh.nt * sizeof *mesh.twin);
		assert_memory_equal(mesh.next_leaving, other.next_leaving, 3 * mesh.nt * sizeof *mesh.next_leaving);
	}
	arena_finish(&arena);
}

static void an_edge_of_three_faces_is_refused(void **state)
{
	(void)state;
	struct arena arena;
	struct halfedge_mesh mesh;
	uint16_t vertex[5][3] = {{0, 0, 0}, {9, 0, 0}, {0, 9, 0}, {0, 0, 9}, {9, 9, 9}};
	uint32_t fan[3][3] = {{0, 1, 2}, {1, 0, 3}, {0, 1, 4}}, twice[1][3] = {{0, 1, 1}};
	arena_init(&arena);
	struct surface surface = {.nv = 5, .nt = 3, .vertex = vertex, .triangle = fan};
	assert_int_equal(halfedge_build(&surface, 0, &arena, &mesh), -EINVAL);
	surface.nt = 2;
	assert_int_equal(halfedge_build(&surface, 0, &arena, &mesh), 0);
	surface = (struct surface){.nv = 5, .nt = 1, .vertex = vertex, .triangle = twice};
	assert_int_equal(halfedge_build(&surface, 0, &arena, &mesh), -EINVAL);
	arena_finish(&arena);
}

static void a_tetrahedron_and_a_lone_triangle_do_not_collapse(void **state)
{
	(void)state;
	struct arena arena;
	struct halfedge_mesh mesh;
	uint16_t vertex[4][3] = {{0, 0, 0}, {9, 0, 0}, {0, 9, 0}, {0, 0, 9}};
	uint32_t triangle[4][3] = {{0, 2, 1}, {0, 1, 3}, {1, 2, 3}, {2, 0, 3}};
	arena_init(&arena);
	for (uint32_t nt = 1; nt <= 4; nt += 3) {
		struct surface surface = {.nv = 4, .nt = nt, .vertex = vertex, .triangle = triangle};
		assert_int_equal(halfedge_build(&surface, 0, &arena, &mesh), 0);
		for (uint32_t h = 0; h < 3 * nt; h++)
			assert_false(may_collapse(&mesh, h, mesh.origin[h]));
	}
	arena_finish(&arena);
}

static void the_check_finds_each_broken_invariant(void **state)
{
	(void)state;
	struct arena arena;
	arena_init(&arena);
	for (int kind = 0; kind < 4; kind++) {
		struct halfedge_mesh mesh;
		arena_reset(&arena);
		make_mesh(&arena, (struct window_noise){2, 0, 0}, &mesh);
		assert_null(halfedge_check(&mesh));
		uint32_t h = 30;
		while (mesh.twin[h] == HALFEDGE_NONE)
			h++;
		if (kind == 0)
			mesh.twin[h] = HALFEDGE_NONE;
		else if (kind == 1)
			mesh.first[mesh.origin[h]] = mesh.next_leaving[mesh.first[mesh.origin[h]]];
		else if (kind == 2)
			mesh.origin[h] = mesh.origin[halfedge_next(h)];
		else
			mesh.twin[mesh.twin[h]] = h ^ 1;
		assert_non_null(halfedge_check(&mesh));
	}
	arena_finish(&arena);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(raw_surfaces_of_random_fields_are_sound),
	    cmocka_unit_test(every_collapse_that_may_be_keeps_a_surface_of_the_same_kind),
	    cmocka_unit_test(a_triangle_that_is_removed_and_added_again_changes_nothing),
	    cmocka_unit_test(a_flip_is_two_triangles_removed_and_two_added),
	    cmocka_unit_test(an_edge_of_three_faces_is_refused),
	    cmocka_unit_test(a_tetrahedron_and_a_lone_triangle_do_not_collapse),
	    cmocka_unit_test(the_check_finds_each_broken_invariant),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

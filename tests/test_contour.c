/* The outline of a set of triangles encloses exactly the set, holes and touching corners included. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>
#include <cmocka.h>

#include "core/contour.h"
#include "core/predicates.h"
#include "tests/window.h"

static struct window window;

static int slanted(void *ctx, int i, int j, int k)
{
	(void)ctx;
	return k * 256 - 2100 + 31 * i - 17 * j;
}

static void project(const struct halfedge_mesh *mesh, uint32_t v, int32_t ret_point[2])
{
	ret_point[0] = mesh->position[v][0];
	ret_point[1] = mesh->position[v][1];
}

static int64_t area_of_triangle(const struct halfedge_mesh *mesh, uint32_t t)
{
	int32_t p[3][2];
	for (int k = 0; k < 3; k++)
		project(mesh, mesh->origin[3 * t + k], p[k]);
	return orientation(p[0], p[1], p[2]);
}

static int64_t area_of_contour(const struct halfedge_mesh *mesh, const struct contour *contour)
{
	int64_t sum = 0;
	for (uint32_t l = 0, first = 0; l < contour->loops; first = contour->loop_end[l++])
		for (uint32_t k = first; k < contour->loop_end[l]; k++) {
			int32_t a[2], b[2];
			project(mesh, contour->vertex[k], a);
			project(mesh, contour->vertex[k + 1 < contour->loop_end[l] ? k + 1 : first], b);
			sum += (int64_t)a[0] * b[1] - (int64_t)b[0] * a[1];
		}
	return sum;
}

static void outlines_of_random_sets_have_their_area_and_their_edges(void **state)
{
	(void)state;
	struct arena arena;
	struct halfedge_mesh mesh;
	struct surface surface;
	uint64_t random = 1;
	uint32_t most_loops = 0;
	arena_init(&arena);
	window_sample(&window, slanted, NULL);
	for (int i = 0; i < 300; i++) {
		arena_reset(&arena);
		assert_int_equal(cubes_extract(&window, &arena, &surface), 0);
		assert_int_equal(halfedge_build(&surface, 0, &arena, &mesh), 0);
		uint32_t *region = ARENA_NEW(&arena, uint32_t, mesh.nt), *set = ARENA_NEW(&arena, uint32_t, mesh.nt);
		uint32_t n = 0, edges = 0, share = 1 + (uint32_t)i % 8;
		int64_t area = 0;
		for (uint32_t t = 0; t < mesh.nt; t++)
			if (window_random(&random) % 8 < share) {
				region[t] = 7;
				set[n++] = t;
				area += area_of_triangle(&mesh, t);
			}
		for (uint32_t h = 0; h < 3 * mesh.nt; h++)
			edges += region[h / 3] == 7 && (mesh.twin[h] == HALFEDGE_NONE || region[mesh.twin[h] / 3] != 7);
		struct contour contour;
		assert_int_equal(contour_find(&mesh, set, n, region, 7, &arena, &contour), 0);
		assert_int_equal(contour.n, edges);
		assert_true(area_of_contour(&mesh, &contour) == area);
		for (uint32_t l = 0, first = 0; l < contour.loops; first = contour.loop_end[l++])
			for (uint32_t k = first; k < contour.loop_end[l]; k++) {
				uint32_t next = k + 1 < contour.loop_end[l] ? k + 1 : first;
				assert_true(halfedge_find(&mesh, contour.vertex[k], contour.vertex[next]) !=
				            HALFEDGE_NONE);
			}
		most_loops = contour.loops > most_loops ? contour.loops : most_loops;
	}
	assert_true(most_loops > 10);
	arena_finish(&arena);
}

static void a_whole_wall_has_one_outline(void **state)
{
	(void)state;
	struct arena arena;
	struct halfedge_mesh mesh;
	struct surface surface;
	struct contour contour;
	arena_init(&arena);
	window_sample(&window, slanted, NULL);
	assert_int_equal(cubes_extract(&window, &arena, &surface), 0);
	assert_int_equal(halfedge_build(&surface, 0, &arena, &mesh), 0);
	uint32_t *region = ARENA_NEW(&arena, uint32_t, mesh.nt), *set = ARENA_NEW(&arena, uint32_t, mesh.nt);
	for (uint32_t t = 0; t < mesh.nt; t++)
		set[t] = t;
	assert_int_equal(contour_find(&mesh, set, mesh.nt, region, 0, &arena, &contour), 0);
	assert_int_equal(contour.loops, 1);
	assert_true(area_of_contour(&mesh, &contour) == 2ll * 4096 * 4096);
	arena_finish(&arena);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(outlines_of_random_sets_have_their_area_and_their_edges),
	    cmocka_unit_test(a_whole_wall_has_one_outline),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

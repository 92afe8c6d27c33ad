/* Planar regions: what is flat within the tolerance loses its inside, what is not is left alone. */
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>
#include <cmocka.h>

#include "core/border_fit.h"
#include "core/predicates.h"
#include "core/region.h"
#include "tests/window.h"

struct made {
	struct window window;
	struct surface raw;
	struct simplify s;
	struct reduce_stats stats;
};

static void make(struct made *made, window_field *field, void *ctx, struct arena *arena)
{
	struct border border;
	memset(&made->stats, 0, sizeof made->stats);
	arena_reset(arena);
	window_sample(&made->window, field, ctx);
	assert_int_equal(cubes_extract(&made->window, arena, &made->raw), 0);
	assert_int_equal(border_find(&made->window, &made->raw, 64, arena, &border), 0);
	assert_int_equal(simplify_init(&made->s, &made->raw, &border, 0.25, arena), 0);
	border_fit(&made->s.mesh, &made->s.border, &made->stats);
	simplify_settle(&made->s);
	assert_int_equal(region_flatten(&made->s, arena, &made->stats), 0);
	assert_null(halfedge_check(&made->s.mesh));
}

static int64_t projected_area(const struct halfedge_mesh *mesh)
{
	int64_t sum = 0;
	for (uint32_t t = 0; t < mesh->nt; t++) {
		int64_t normal[3];
		if (!halfedge_alive(mesh, t))
			continue;
		triangle_normal(mesh->position[mesh->origin[3 * t]], mesh->position[mesh->origin[3 * t + 1]],
		                mesh->position[mesh->origin[3 * t + 2]], normal);
		sum += normal[2];
	}
	return sum;
}

static uint32_t triangles(const struct halfedge_mesh *mesh)
{
	uint32_t n = 0;
	for (uint32_t t = 0; t < mesh->nt; t++)
		n += halfedge_alive(mesh, t);
	return n;
}

/* A wall with ripples of +-15 lattice units, and with holes where a pattern says so. */
static int rippled(void *ctx, int i, int j, int k)
{
	const int *hole_every = ctx;
	int ripple = (i * 7 + j * 13) % 31 - 15;
	if (*hole_every && i > 0 && j > 0 && i < 16 && j < 16) {
		int x = i % *hole_every, y = j % *hole_every;
		if (x >= 2 && x <= 5 && y >= 3 && y <= 6)
			return VOXEL_UNKNOWN;
	}
	return k * 256 - 2100 - i * 20 + ripple;
}

static void a_rippled_wall_is_two_triangles_of_the_same_area(void **state)
{
	(void)state;
	static struct made made;
	struct arena arena;
	int no_holes = 0;
	arena_init(&arena);
	make(&made, rippled, &no_holes, &arena);
	assert_int_equal(made.stats.regions, 1);
	assert_int_equal(made.stats.regions_kept, 0);
	assert_int_equal(triangles(&made.s.mesh), 2);
	assert_true(projected_area(&made.s.mesh) == 2ll * 4096 * 4096);
	for (uint32_t t = 0; t < made.s.mesh.nt; t++)
		assert_true(!halfedge_alive(&made.s.mesh, t) || made.s.plane[t] == 0);
	arena_finish(&arena);
}

/* Every vertex that went is in the list of one triangle, and there within the tolerance. */
static void check_lists(const struct made *made)
{
	const struct simplify *s = &made->s;
	uint32_t listed = 0, gone = 0;
	for (uint32_t t = 0; t < s->mesh.nt; t++) {
		if (!halfedge_alive(&s->mesh, t))
			continue;
		struct flat flat =
		    flat_make(simplify_place(s, s->mesh.origin[3 * t]), simplify_place(s, s->mesh.origin[3 * t + 1]),
		              simplify_place(s, s->mesh.origin[3 * t + 2]));
		for (uint32_t p = s->points[t]; p != UINT32_MAX; p = s->next_point[p], listed++)
			assert_true(flat_distance_squared(&flat, s->origin[p]) <= s->tolerance_squared);
	}
	for (uint32_t v = 0; v < s->mesh.nv; v++)
		gone += s->mesh.first[v] == HALFEDGE_NONE && s->border.kind[v] == BORDER_INSIDE;
	assert_int_equal(listed, gone);
}

static void holes_of_a_wall_stay_holes(void **state)
{
	(void)state;
	static struct made made, whole;
	struct arena arena, other;
	arena_init(&arena);
	arena_init(&other);
	for (int every = 8; every <= 10; every++) {
		int no_holes = 0;
		make(&made, rippled, &every, &arena);
		make(&whole, rippled, &no_holes, &other);
		assert_true(made.raw.nt < whole.raw.nt);
		struct halfedge_mesh raw;
		assert_int_equal(halfedge_build(&made.raw, 0, &other, &raw), 0);
		assert_true(projected_area(&made.s.mesh) == projected_area(&raw));
		assert_true(triangles(&made.s.mesh) < made.raw.nt / 2);
		assert_true(made.stats.regions >= 1);
		check_lists(&made);
	}
	arena_finish(&arena);
	arena_finish(&other);
}

/* How many vertices that are not on the border stand, of how many. */
static uint32_t inside_left(const struct made *made, uint32_t *ret_inside)
{
	uint32_t left = 0;
	*ret_inside = 0;
	for (uint32_t v = 0; v < made->s.mesh.nv; v++) {
		if (made->s.border.kind[v] != BORDER_INSIDE)
			continue;
		++*ret_inside;
		left += made->s.mesh.first[v] != HALFEDGE_NONE;
	}
	return left;
}

/* A floor that runs along a patch face, now a little above it and now below: its outline is full of holes in that face. */
static int in_a_face(void *ctx, int i, int j, int k)
{
	const int *seed = ctx;
	return k * 256 - 10 + (i * 7 + j * 13 + i * j * *seed) % 31 - 15;
}

static void a_floor_in_a_patch_face_loses_its_inside(void **state)
{
	(void)state;
	static struct made made;
	struct arena arena;
	uint32_t inside;
	arena_init(&arena);
	for (int seed = 1; seed <= 5; seed++) {
		make(&made, in_a_face, &seed, &arena);
		assert_true(made.stats.regions >= 1);
		assert_int_equal(made.stats.regions_kept, 0);
		assert_true(4 * inside_left(&made, &inside) < inside);
		check_lists(&made);
	}
	arena_finish(&arena);
}

/* Ripples of nearly the tolerance to both sides: a triangle may lie twice as far from a corner that went. */
static int rough(void *ctx, int i, int j, int k)
{
	const int *seed = ctx;
	return k * 256 - 2100 - i * 20 + 4 * ((i * 7 + j * 13 + i * j * *seed) % 31 - 15);
}

static void corners_too_far_from_what_is_left_come_back(void **state)
{
	(void)state;
	static struct made made;
	struct arena arena;
	arena_init(&arena);
	for (int seed = 1; seed <= 5; seed++) {
		uint32_t inside;
		make(&made, rough, &seed, &arena);
		assert_true(made.stats.regions >= 1);
		assert_int_equal(made.stats.regions_kept, 0);
		assert_true(projected_area(&made.s.mesh) == 2ll * 4096 * 4096);
		check_lists(&made);
		assert_true(inside_left(&made, &inside) > 0 && triangles(&made.s.mesh) < made.raw.nt / 2);
	}
	arena_finish(&arena);
}

static int ball(void *ctx, int i, int j, int k)
{
	(void)ctx;
	double x = i - 8.1, y = j - 7.9, z = k - 8.05;
	return (int)((sqrt(x * x + y * y + z * z) - 4) * 256);
}

static void a_small_ball_has_no_region(void **state)
{
	(void)state;
	static struct made made;
	struct arena arena;
	arena_init(&arena);
	make(&made, ball, NULL, &arena);
	assert_int_equal(made.stats.regions, 0);
	assert_int_equal(triangles(&made.s.mesh), made.raw.nt);
	arena_finish(&arena);
}

static int box_edge(void *ctx, int i, int j, int k)
{
	(void)ctx;
	int a = k * 256 - 2100, b = i * 256 - 2000 + 20 * j;
	return a > b ? a : b;
}

static void two_walls_are_two_regions(void **state)
{
	(void)state;
	static struct made made;
	struct arena arena;
	arena_init(&arena);
	make(&made, box_edge, NULL, &arena);
	assert_int_equal(made.stats.regions, 2);
	check_lists(&made);
	for (uint32_t t = 0; t < made.s.mesh.nt; t++) {
		if (!halfedge_alive(&made.s.mesh, t) || made.s.plane[t] == UINT32_MAX)
			continue;
		const struct region_plane *plane = &made.s.region[made.s.plane[t]];
		for (int k = 0; k < 3; k++) {
			struct vec3 p = simplify_place(&made.s, made.s.mesh.origin[3 * t + k]);
			assert_true(fabs(vec3_dot(plane->normal, p) + plane->offset) <= 64);
		}
	}
	arena_finish(&arena);
}

static void a_fit_finds_the_plane_through_noise(void **state)
{
	(void)state;
	struct vec3 point[200], normal = {0.6, -0.48, 0.64};
	uint64_t random = 4;
	double variance;
	for (int n = 0; n < 200; n++) {
		struct vec3 p = {(double)(window_random(&random) % 4096), (double)(window_random(&random) % 4096), 0};
		double noise = (double)(window_random(&random) % 21) - 10;
		p.z = (500 - normal.x * p.x - normal.y * p.y) / normal.z;
		point[n] = vec3_add(p, vec3_scale(normal, noise));
	}
	struct region_plane plane = region_fit(point, 200, &variance);
	assert_true(fabs(vec3_dot(plane.normal, normal)) > 0.99999);
	assert_true(variance > 20 && variance < 50);
	assert_true(fabs(fabs(plane.offset) - 500) < 10);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_rippled_wall_is_two_triangles_of_the_same_area),
	    cmocka_unit_test(holes_of_a_wall_stay_holes),
	    cmocka_unit_test(a_floor_in_a_patch_face_loses_its_inside),
	    cmocka_unit_test(corners_too_far_from_what_is_left_come_back),
	    cmocka_unit_test(a_small_ball_has_no_region),
	    cmocka_unit_test(two_walls_are_two_regions),
	    cmocka_unit_test(a_fit_finds_the_plane_through_noise),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

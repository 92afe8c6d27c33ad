/* Polygons with holes become triangles of exactly their area: touching corners, slivers and straight runs too. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <cmocka.h>

#include "core/predicates.h"
#include "core/triangulate.h"

#define GRID       14
#define POINTS_MAX 4096

struct sheet {
	int32_t point[POINTS_MAX][2];
	uint32_t loop_end[256];
	struct polygon polygon;
};

static uint64_t random_next(uint64_t *state)
{
	*state = *state * 6364136223846793005ull + 1442695040888963407ull;
	return (*state ^ *state >> 29) >> 16;
}

static int random_below(uint64_t *state, int n)
{
	return (int)(random_next(state) % (uint64_t)n);
}

static void finish_loops(struct sheet *sheet, uint32_t n, uint32_t loops)
{
	sheet->polygon = (struct polygon){(const int32_t(*)[2])sheet->point, sheet->loop_end, n, loops};
}

/* A set of squares that grows over shared sides. */
static void grow_squares(uint64_t *random, int squares, bool ret_in[GRID + 2][GRID + 2])
{
	memset(ret_in, 0, sizeof(bool[GRID + 2][GRID + 2]));
	ret_in[GRID / 2][GRID / 2] = true;
	for (int n = 1, tries = 0; n < squares && tries < 5000; tries++) {
		int x = 1 + random_below(random, GRID), y = 1 + random_below(random, GRID);
		if (ret_in[y][x] || !(ret_in[y - 1][x] || ret_in[y + 1][x] || ret_in[y][x - 1] || ret_in[y][x + 1]))
			continue;
		ret_in[y][x] = true;
		n++;
	}
}

/* Walks one loop of the outline, the squares to the left; where two squares touch in a corner it stays with its own. */
static uint32_t walk(bool in[GRID + 2][GRID + 2], bool seen[4][GRID + 3][GRID + 3], int x, int y, int direction,
                     int32_t (*point)[2])
{
	static const int dx[4] = {1, 0, -1, 0}, dy[4] = {0, 1, 0, -1};
	/* the squares to the left and right ahead of a corner, by direction */
	static const int left[4][2] = {{0, 0}, {-1, 0}, {-1, -1}, {0, -1}};
	uint32_t n = 0;
	while (!seen[direction][y][x]) {
		seen[direction][y][x] = true;
		point[n][0] = x;
		point[n++][1] = y;
		x += dx[direction];
		y += dy[direction];
		for (int turn = 1; turn >= -1; turn--) { /* left, straight, right */
			int d = (direction + turn + 4) % 4, r = (d + 3) % 4;
			if (in[y + left[d][1]][x + left[d][0]] && !in[y + left[r][1]][x + left[r][0]]) {
				direction = d;
				break;
			}
		}
	}
	return n;
}

static int64_t loop_area(const int32_t (*point)[2], uint32_t n)
{
	int64_t sum = 0;
	for (uint32_t p = 0; p < n; p++) {
		const int32_t *a = point[p], *b = point[(p + 1) % n];
		sum += (int64_t)a[0] * b[1] - (int64_t)b[0] * a[1];
	}
	return sum;
}

/* Puts the outer loop first. */
static void collect_loops(struct sheet *sheet, bool in[GRID + 2][GRID + 2])
{
	static bool seen[4][GRID + 3][GRID + 3];
	static int32_t loop[256][600][2];
	uint32_t length[256], loops = 0, outer = 0, n = 0, kept = 0;
	memset(seen, 0, sizeof seen);
	for (int y = 1; y <= GRID; y++)
		for (int x = 1; x <= GRID; x++) {
			if (!in[y][x] || in[y - 1][x] || seen[0][y][x])
				continue;
			length[loops] = walk(in, seen, x, y, 0, loop[loops]);
			loops++;
		}
	for (uint32_t l = 0; l < loops; l++)
		if (loop_area((const int32_t(*)[2])loop[l], length[l]) > 0)
			outer = l;
	for (uint32_t k = 0; k < loops; k++) {
		uint32_t l = k == 0 ? outer : k <= outer ? k - 1 : k;
		memcpy(sheet->point[n], loop[l], length[l] * sizeof loop[l][0]);
		n += length[l];
		sheet->loop_end[kept++] = n;
	}
	finish_loops(sheet, n, kept);
}

/* Squares on a lattice whose lines are 1 to 1000 apart, sheared: straight runs, slivers, touching corners. */
static void make_squares(struct sheet *sheet, uint64_t *random)
{
	bool in[GRID + 2][GRID + 2];
	int32_t x[GRID + 3] = {0}, y[GRID + 3] = {0}, shear = random_below(random, 5) - 2;
	bool thin = random_below(random, 2);
	grow_squares(random, 1 + random_below(random, GRID * GRID * 3 / 4), in);
	collect_loops(sheet, in);
	for (int k = 1; k < GRID + 3; k++) {
		x[k] = x[k - 1] + 1 + (thin ? random_below(random, 2) * random_below(random, 1000) : 0);
		y[k] = y[k - 1] + 1 + (thin ? random_below(random, 2) * random_below(random, 1000) : 0);
	}
	for (uint32_t p = 0; p < sheet->polygon.n; p++) {
		int32_t *at = sheet->point[p];
		at[1] = y[at[1]];
		at[0] = x[at[0]] + shear * at[1];
	}
}

/* A loop around the origin, each point on its own of `n` rays that turn once around a square. */
static uint32_t star(int32_t (*point)[2], uint64_t *random, int n, int low, int high, bool hole)
{
	for (int k = 0; k < n; k++) {
		int at = hole ? n - 1 - k : k, side = at * 4 / n;
		int32_t s = (int32_t)(at * 4 - side * n), r = low + random_below(random, high - low);
		int32_t along = (int32_t)((int64_t)2 * r * s / n) - r;
		const int32_t place[4][2] = {{r, along}, {-along, r}, {-r, -along}, {along, -r}};
		point[k][0] = place[side][0];
		point[k][1] = place[side][1];
	}
	return (uint32_t)n;
}

static void make_star(struct sheet *sheet, uint64_t *random, int n)
{
	uint32_t outer = star(sheet->point, random, n, 60000, 100000, false);
	sheet->loop_end[0] = outer;
	uint32_t inner = star(&sheet->point[outer], random, 4 + n / 4 * 4 / 3, 10000, 29000, true);
	sheet->loop_end[1] = outer + inner;
	finish_loops(sheet, outer + inner, 2);
}

static int compare_edges(const void *a, const void *b)
{
	return memcmp(a, b, 4 * sizeof(int32_t));
}

/* Area, orientation, and every edge met once each way but for the outline. */
static void check(const struct sheet *sheet, uint32_t (*triangle)[3], uint32_t n)
{
	static int32_t edge[6 * POINTS_MAX][4];
	int64_t area = 0;
	uint32_t edges = 0;
	for (uint32_t t = 0; t < n; t++) {
		const int32_t *a = sheet->point[triangle[t][0]], *b = sheet->point[triangle[t][1]],
		              *c = sheet->point[triangle[t][2]];
		int64_t twice = orientation(a, b, c);
		assert_true(twice > 0);
		area += twice;
		for (int k = 0; k < 3; k++, edges++) {
			memcpy(&edge[edges][0], sheet->point[triangle[t][k]], 8);
			memcpy(&edge[edges][2], sheet->point[triangle[t][(k + 1) % 3]], 8);
		}
	}
	assert_true(area == polygon_area(&sheet->polygon));
	qsort(edge, edges, sizeof edge[0], compare_edges);
	uint32_t open = 0;
	for (uint32_t e = 0; e < edges; e++) {
		assert_true(!e || compare_edges(edge[e - 1], edge[e]));
		int32_t back[4] = {edge[e][2], edge[e][3], edge[e][0], edge[e][1]};
		open += !bsearch(back, edge, edges, sizeof edge[0], compare_edges);
	}
	assert_int_equal(open, sheet->polygon.n);
}

static void random_polygons_give_exactly_their_area(void **state)
{
	(void)state;
	static struct sheet sheet;
	struct arena arena;
	uint64_t random = 7;
	uint32_t holes = 0, points = 0;
	arena_init(&arena);
	for (int i = 0; i < 12000; i++) {
		uint32_t(*triangle)[3], n;
		if (i % 4)
			make_squares(&sheet, &random);
		else
			make_star(&sheet, &random, 8 + random_below(&random, 60) / 4 * 4);
		arena_reset(&arena);
		assert_int_equal(triangulate(&sheet.polygon, NULL, NULL, &arena, &triangle, &n), 0);
		check(&sheet, triangle, n);
		holes += sheet.polygon.loops - 1;
		points += sheet.polygon.n;
	}
	assert_true(holes > 10000);
	printf("note: 12000 polygons, %u points, %u holes\n", points, holes);
	arena_finish(&arena);
}

/* A diagonal in the left half is forbidden to have both ends there. */
static bool not_both_left(const void *ctx, uint32_t a, uint32_t b)
{
	const struct sheet *sheet = ctx;
	return sheet->point[a][0] >= 0 || sheet->point[b][0] >= 0;
}

static void a_forbidden_diagonal_is_never_used(void **state)
{
	(void)state;
	static struct sheet sheet;
	struct arena arena;
	uint64_t random = 9;
	int done = 0;
	arena_init(&arena);
	for (int i = 0; i < 300; i++) {
		uint32_t(*triangle)[3], n;
		uint32_t points = star(sheet.point, &random, 12, 99000, 100000, false);
		sheet.loop_end[0] = points;
		finish_loops(&sheet, points, 1);
		arena_reset(&arena);
		if (triangulate(&sheet.polygon, not_both_left, &sheet, &arena, &triangle, &n))
			continue;
		done++;
		check(&sheet, triangle, n);
		for (uint32_t t = 0; t < n; t++)
			for (int k = 0; k < 3; k++) {
				uint32_t a = triangle[t][k], b = triangle[t][(k + 1) % 3];
				bool outline = (a + 1) % points == b || (b + 1) % points == a;
				assert_true(outline || not_both_left(&sheet, a, b));
			}
	}
	assert_true(done > 150);
	arena_finish(&arena);
}

static void loops_without_area_or_that_cross_are_refused_or_harmless(void **state)
{
	(void)state;
	struct arena arena;
	uint32_t(*triangle)[3], n, end = 4;
	const int32_t line[4][2] = {{0, 0}, {1, 1}, {2, 2}, {3, 3}}, clockwise[4][2] = {{0, 0}, {0, 9}, {9, 9}, {9, 0}};
	arena_init(&arena);
	struct polygon polygon = {line, &end, 4, 1};
	assert_int_not_equal(triangulate(&polygon, NULL, NULL, &arena, &triangle, &n), 0);
	polygon.point = clockwise;
	assert_int_not_equal(triangulate(&polygon, NULL, NULL, &arena, &triangle, &n), 0);
	arena_finish(&arena);
}

static void a_polygon_of_a_thousand_points_is_cut_again_and_again(void **state)
{
	(void)state;
	static struct sheet sheet;
	struct arena arena;
	uint64_t random = 5;
	uint32_t points = 0;
	arena_init(&arena);
	make_star(&sheet, &random, 752);
	clock_t begin = clock();
	for (int i = 0; i < 200; i++) {
		uint32_t(*triangle)[3], n;
		arena_reset(&arena);
		assert_int_equal(triangulate(&sheet.polygon, NULL, NULL, &arena, &triangle, &n), 0);
		points += sheet.polygon.n;
	}
	double seconds = (double)(clock() - begin) / CLOCKS_PER_SEC;
	printf("note: %u points a polygon, %.2f M points/s\n", sheet.polygon.n, points / seconds / 1e6);
	arena_finish(&arena);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(random_polygons_give_exactly_their_area),
	    cmocka_unit_test(a_forbidden_diagonal_is_never_used),
	    cmocka_unit_test(loops_without_area_or_that_cross_are_refused_or_harmless),
	    cmocka_unit_test(a_polygon_of_a_thousand_points_is_cut_again_and_again),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

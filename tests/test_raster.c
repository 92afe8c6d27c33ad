/* Design 1.3: neighbouring beams of neighbouring rows are a surface, with normals from a window that stops at jumps. */
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <cmocka.h>

#include "core/raster.h"
#include "core/trig.h"

#define BEAMS 121
#define ROWS  40
#define CELL  0.05

/* A scene says how far a beam goes. */
typedef double scene_fn(struct vec3 origin, struct vec3 direction);

static double plane_range(struct vec3 o, struct vec3 d, struct vec3 n, double distance)
{
	double r = (distance - vec3_dot(n, o)) / vec3_dot(n, d);

	return r > 0 ? r : 1e9;
}

static const struct vec3 slanted = {0.8, 0.36, 0.48};

static double wall_scene(struct vec3 o, struct vec3 d)
{
	return plane_range(o, d, slanted, 1.5);
}

static double corner_scene(struct vec3 o, struct vec3 d)
{
	double a = plane_range(o, d, (struct vec3){1, 0, 0}, 2), b = plane_range(o, d, (struct vec3){0, 1, 0}, 0.7);

	return a < b ? a : b;
}

static double step_scene(struct vec3 o, struct vec3 d)
{
	double near = plane_range(o, d, (struct vec3){1, 0, 0}, 1.5);
	struct vec3 p = vec3_add(o, vec3_scale(d, near));

	return p.y > 0.1 ? near : plane_range(o, d, (struct vec3){1, 0, 0}, 2.5);
}

static double floor_scene(struct vec3 o, struct vec3 d)
{
	return plane_range(o, d, (struct vec3){0, 0, 1}, -0.05);
}

/* A row of `BEAMS` half-degree beams, symmetrical about straight ahead; `shift` in steps. */
static struct row *make_row(scene_fn *scene, struct vec3 origin, double tilt_rad, double shift)
{
	struct row *row = row_create(BEAMS);
	struct transform tilt = transform_tilt(tilt_rad);

	row->step_rad = 0.5 * TRIG_DEG;
	row->first_rad = (shift - BEAMS / 2) * row->step_rad;
	for (int k = 0; k < BEAMS; k++) {
		double bearing = row->first_rad + k * row->step_rad;
		struct vec3 d = transform_direction(&tilt, (struct vec3){trig_cos(bearing), trig_sin(bearing), 0});
		double r = scene((struct vec3){0}, d);

		row->beam[k] = (struct row_beam){.origin = origin,
		                                 .point = vec3_add(origin, vec3_scale(d, r)),
		                                 .range_m = (float)r,
		                                 .state = r < 30 ? BEAM_OK : BEAM_NO_ECHO};
	}
	return row;
}

static void fill(struct raster *raster, scene_fn *scene, struct vec3 origin, int rows, double shift_odd)
{
	for (int r = 0; r < rows; r++) {
		struct row *row = make_row(scene, origin, (r - rows / 2) * 0.5 * TRIG_DEG, r % 2 ? shift_odd : 0);

		if (r == 0)
			assert_int_equal(raster_begin(raster, row), 0);
		assert_true(raster_accepts(raster, row));
		raster_push(raster, row);
	}
}

static double angle_deg(const float n[3], struct vec3 m)
{
	struct vec3 v = {(double)n[0], (double)n[1], (double)n[2]};
	double sine = vec3_norm(vec3_cross(v, m));

	return trig_atan2(sine, vec3_dot(v, m)) / TRIG_DEG;
}

/* Worst angle of the normals of a line to either of two directions; every beam with a point must have a normal. */
static double worst_angle(struct raster *raster, uint64_t number, struct vec3 a, struct vec3 b, int except)
{
	struct raster_line *line = raster_line(raster, number);
	double worst = 0;
	int left_out = 0;

	raster_normals(raster, number, number + RASTER_LOOKAHEAD);
	for (int32_t c = 0; c < raster->width; c++) {
		if (!(line->flags[c] & RASTER_POINT))
			continue;
		assert_true(line->flags[c] & RASTER_NORMAL);
		double angle = fmin(angle_deg(line->normal[c], a), angle_deg(line->normal[c], b));

		if (angle > 2 && left_out++ < except)
			continue;
		worst = fmax(worst, angle);
	}
	return worst;
}

static void a_slanted_wall_gives_its_normal(void **state)
{
	struct raster raster;
	struct vec3 n = vec3_scale(slanted, -1);

	(void)state;
	raster_init(&raster, CELL);
	fill(&raster, wall_scene, (struct vec3){-3, -7, 2}, ROWS, 0);
	for (uint64_t r = ROWS - 10; r < ROWS - RASTER_LOOKAHEAD; r++)
		assert_true(worst_angle(&raster, r, n, n, 0) < 0.2);
	raster_finish(&raster);
}

static void far_from_the_origin_nothing_is_lost(void **state)
{
	struct raster raster;
	struct vec3 n = vec3_scale(slanted, -1);
	double worst;

	(void)state;
	raster_init(&raster, CELL);
	fill(&raster, wall_scene, (struct vec3){150000, -180000, 90000}, ROWS, 0);
	worst = worst_angle(&raster, ROWS - 3, n, n, 0);
	printf("note: 250 km from the origin normals are off by at most %.2g degrees\n", worst);
	assert_true(worst < 0.2);
	raster_finish(&raster);
}

static void a_corner_keeps_both_normals(void **state)
{
	struct raster raster;

	(void)state;
	raster_init(&raster, CELL);
	fill(&raster, corner_scene, (struct vec3){0}, ROWS, 0);
	assert_true(worst_angle(&raster, ROWS - 5, (struct vec3){-1, 0, 0}, (struct vec3){0, -1, 0}, 6) < 2);
	raster_finish(&raster);
}

static void a_depth_jump_joins_nothing(void **state)
{
	struct raster raster;
	struct raster_line *line;
	struct vec3 n = {-1, 0, 0};
	int jumps = 0;

	(void)state;
	raster_init(&raster, CELL);
	fill(&raster, step_scene, (struct vec3){0}, ROWS, 0);
	line = raster_line(&raster, ROWS - 4);
	for (int32_t c = line->first; c + 1 < line->first + BEAMS; c++)
		if (fabs(line->point[c].x - line->point[c + 1].x) > 10) {
			jumps++;
			assert_false(line->flags[c] & (RASTER_RIGHT | RASTER_QUAD));
			assert_int_equal(line->right[c], 0);
			assert_int_equal(line->left[c + 1], 0);
		}
	assert_int_equal(jumps, 1);
	assert_true(worst_angle(&raster, ROWS - 4, n, n, 0) < 0.3);
	raster_finish(&raster);
}

static void rows_shifted_by_half_a_step_keep_their_columns(void **state)
{
	struct raster raster;
	struct vec3 n = vec3_scale(slanted, -1);

	(void)state;
	raster_init(&raster, CELL);
	fill(&raster, wall_scene, (struct vec3){0}, ROWS, 0.5);
	for (uint64_t r = ROWS - 8; r < ROWS; r++) {
		struct raster_line *line = raster_line(&raster, r);

		assert_int_equal(line->first, raster_line(&raster, r - 1)->first);
		for (int32_t c = line->first; c + 1 < line->first + BEAMS; c++)
			assert_true(line->flags[c] & RASTER_QUAD);
	}
	assert_true(worst_angle(&raster, ROWS - 4, n, n, 0) < 0.2);
	raster_finish(&raster);
}

static void rounding_of_a_bearing_moves_no_column(void **state)
{
	struct raster raster;
	const double nudge[4] = {0, 1e-12, -1e-12, 1e-9};

	(void)state;
	raster_init(&raster, CELL);
	for (int i = 0; i < 4; i++) {
		struct row *row = make_row(wall_scene, (struct vec3){0}, 0, 0);

		row->first_rad += nudge[i];
		if (i == 0)
			assert_int_equal(raster_begin(&raster, row), 0);
		raster_push(&raster, row);
		assert_int_equal(raster_line(&raster, (uint64_t)i)->first, raster_line(&raster, 0)->first);
	}
	raster_finish(&raster);
}

static void rows_of_another_raster_are_not_accepted(void **state)
{
	struct raster raster;
	struct row *row = make_row(wall_scene, (struct vec3){0}, 0, 0);

	(void)state;
	raster_init(&raster, CELL);
	assert_false(raster_accepts(&raster, row));
	assert_int_equal(raster_begin(&raster, row), 0);
	assert_true(raster_accepts(&raster, row));
	row->first_rad += 3 * row->step_rad; /* within the margin */
	assert_true(raster_accepts(&raster, row));
	row->first_rad += 40 * row->step_rad;
	assert_false(raster_accepts(&raster, row));
	row->first_rad = NAN;
	raster_accepts(&raster, row); /* either answer, no crash */
	row->first_rad = (-BEAMS / 2) * row->step_rad;
	row->step_rad *= 0.5;
	assert_false(raster_accepts(&raster, row));
	row_destroy(row);
	raster_finish(&raster);
}

static void what_is_seen_too_flat_is_no_quad(void **state)
{
	struct raster raster;
	int quads = 0, joined = 0;

	(void)state;
	raster_init(&raster, CELL);
	for (int r = 0; r < 8; r++) { /* a floor 5 cm below, seen at 2 to 2.8 degrees */
		struct row *row = make_row(floor_scene, (struct vec3){0}, (2 + 0.1 * r) * TRIG_DEG, 0);

		if (r == 0)
			assert_int_equal(raster_begin(&raster, row), 0);
		raster_push(&raster, row);
		for (int32_t c = 0; c < raster.width; c++) {
			uint8_t flags = raster_line(&raster, (uint64_t)r)->flags[c];

			quads += (flags & RASTER_QUAD) != 0;
			joined += (flags & RASTER_UP) != 0;
		}
	}
	assert_true(joined > 100);
	assert_int_equal(quads, 0);
	raster_finish(&raster);
}

/* A row folded late, when more rows are there, must see what it would have seen in time. */
static void the_window_reads_no_further_than_told(void **state)
{
	struct raster early, late;
	const uint64_t number = 20;

	(void)state;
	raster_init(&early, CELL);
	raster_init(&late, CELL);
	fill(&late, corner_scene, (struct vec3){0}, 24, 0);
	for (int r = 0; r <= 22; r++) {
		struct row *row = make_row(corner_scene, (struct vec3){0}, (r - 12) * 0.5 * TRIG_DEG, 0);

		if (r == 0)
			assert_int_equal(raster_begin(&early, row), 0);
		raster_push(&early, row);
	}
	raster_normals(&early, number, 22);
	raster_normals(&late, number, 22);
	assert_memory_equal(raster_line(&early, number)->flags, raster_line(&late, number)->flags, (size_t)early.width);
	for (int32_t c = 0; c < early.width; c++)
		if (raster_line(&early, number)->flags[c] & RASTER_NORMAL)
			assert_memory_equal(raster_line(&early, number)->normal[c],
			                    raster_line(&late, number)->normal[c], sizeof(float[3]));
	raster_finish(&early);
	raster_finish(&late);
}

static void beams_beyond_the_map_are_no_points(void **state)
{
	struct raster raster;
	struct row *row = make_row(wall_scene, (struct vec3){0}, 0, 0);
	struct raster_line *line;

	(void)state;
	row->beam[3].point.x = 1e9;
	row->beam[4].point.y = NAN;
	row->beam[5].origin.z = -INFINITY;
	row->beam[6].state = BEAM_MIXED;
	raster_init(&raster, CELL);
	assert_int_equal(raster_begin(&raster, row), 0);
	raster_push(&raster, row);
	line = raster_line(&raster, 0);
	for (int k = 3; k < 7; k++)
		assert_int_equal(line->flags[line->first + k], 0);
	assert_true(line->flags[line->first + 7] & RASTER_POINT);
	raster_finish(&raster);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_slanted_wall_gives_its_normal),
	    cmocka_unit_test(far_from_the_origin_nothing_is_lost),
	    cmocka_unit_test(a_corner_keeps_both_normals),
	    cmocka_unit_test(a_depth_jump_joins_nothing),
	    cmocka_unit_test(rows_shifted_by_half_a_step_keep_their_columns),
	    cmocka_unit_test(rounding_of_a_bearing_moves_no_column),
	    cmocka_unit_test(rows_of_another_raster_are_not_accepted),
	    cmocka_unit_test(what_is_seen_too_flat_is_no_quad),
	    cmocka_unit_test(the_window_reads_no_further_than_told),
	    cmocka_unit_test(beams_beyond_the_map_are_no_points),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

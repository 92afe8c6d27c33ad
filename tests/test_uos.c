/* Laws L1, L2, L8: a scan's raster comes back as the scanner had it, whatever the file; bad files are refused by their line. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/model.h"
#include "core/text.h"
#include "core/trig.h"
#include "tests/real_sweeps.h"

struct file {
	char *text;
	size_t len, cap;
};

static void file_point(struct file *f, double bearing_deg, double up_deg, double range_cm)
{
	if (f->cap - f->len < 128) {
		f->cap = f->cap ? 2 * f->cap : 4096;
		f->text = realloc(f->text, f->cap);
	}
	double b = bearing_deg * TRIG_DEG, t = up_deg * TRIG_DEG;
	f->len += (size_t)sprintf(f->text + f->len, "%.6g %.6g %.6g\n", range_cm * cos(b), range_cm * sin(b) * sin(t),
	                          range_cm * sin(b) * cos(t));
}

static int read_file(const struct file *f, struct uos_scan *scan, struct parse_error *error)
{
	return uos_read((const uint8_t *)f->text, f->len, scan, error);
}

static double range_mm(int row, int beam)
{
	return 500 + (row * 7919 + beam * 104729) % 20000;
}

static void fill(struct file *f, int rows, double step_deg, int beams, int every_nth_missing)
{
	for (int i = 0; i < rows; i++)
		for (int k = 0; k < beams; k++)
			if (!every_nth_missing || (i + k) % every_nth_missing)
				file_point(f, k * step_deg, -40 + 0.517 * i, range_mm(i, k) / 10);
}

static void a_raster_comes_back_as_the_scanner_had_it(void **state)
{
	struct file f = {0};
	struct uos_scan scan;
	struct parse_error error;
	(void)state;
	fill(&f, 9, 0.5, 361, 0);
	assert_int_equal(read_file(&f, &scan, &error), 0);
	assert_int_equal(scan.rows, 9);
	for (int i = 0; i < 9; i++) {
		const struct uos_row *row = &scan.row[i];
		assert_int_equal(row->n, 361);
		assert_true(fabs(row->tilt_rad - (40 - 0.517 * i) * TRIG_DEG) < 2e-6);
		assert_true(fabs(row->first_rad + TRIG_PI / 2) < 1e-12);
		assert_true(fabs(row->step_rad - 0.5 * TRIG_DEG) < 1e-15);
		for (int k = 0; k < 361; k++) {
			assert_true(row->range_m[k] == (float)(range_mm(i, k) / 1000));
			assert_int_equal(row->state[k], BEAM_OK);
		}
	}
	uos_finish(&scan);
	free(f.text);
}

static void the_step_is_the_coarsest_that_fits(void **state)
{
	static const double steps[] = {1, 0.5, 0.25};
	(void)state;
	for (int i = 0; i < 3; i++) {
		struct file f = {0};
		struct uos_scan scan;
		struct parse_error error;
		fill(&f, 4, steps[i], 150, 0);
		assert_int_equal(read_file(&f, &scan, &error), 0);
		assert_int_equal(scan.rows, 4);
		assert_true(fabs(scan.row[0].step_rad - steps[i] * TRIG_DEG) < 1e-12);
		assert_int_equal(scan.row[3].n, 150);
		uos_finish(&scan);
		free(f.text);
	}
}

static void rows_that_differ_in_length_are_placed_by_bearing(void **state)
{
	struct file f = {0};
	struct uos_scan scan;
	struct parse_error error;
	(void)state;
	fill(&f, 10, 0.5, 361, 7);
	assert_int_equal(read_file(&f, &scan, &error), 0);
	assert_int_equal(scan.rows, 10);
	for (int i = 0; i < 10; i++)
		for (int k = 0; k < 361; k++) {
			bool missing = (i + k) % 7 == 0;
			assert_int_equal(scan.row[i].state[k], missing ? BEAM_NO_ECHO : BEAM_OK);
			assert_true(scan.row[i].range_m[k] == (missing ? 0 : (float)(range_mm(i, k) / 1000)));
		}
	uos_finish(&scan);
	free(f.text);
}

static void a_fan_written_from_the_left_is_the_same_raster(void **state)
{
	struct file f = {0};
	struct uos_scan scan;
	struct parse_error error;
	(void)state;
	for (int i = 0; i < 5; i++)
		for (int k = 180; k >= 0; k--)
			file_point(&f, k, 10 - i, range_mm(i, k) / 10);
	assert_int_equal(read_file(&f, &scan, &error), 0);
	assert_int_equal(scan.rows, 5);
	assert_int_equal(scan.row[2].n, 181);
	assert_true(scan.row[2].range_m[5] == (float)(range_mm(2, 5) / 1000));
	uos_finish(&scan);
	free(f.text);
}

static void error_codes_are_states_and_not_ranges(void **state)
{
	static const struct {
		double mm;
		uint8_t state;
	} beams[] = {{32767, BEAM_NO_ECHO},
	             {32766, BEAM_DAZZLED},
	             {32765, BEAM_OVERFLOW},
	             {32764, BEAM_RESERVED},
	             {32763, BEAM_WEAK},
	             {32762, BEAM_CHANNEL_ERROR},
	             {32761, BEAM_RESERVED},
	             {32759, BEAM_BEYOND_MAX},
	             {32758, BEAM_OUT_OF_RANGE},
	             {30001, BEAM_OUT_OF_RANGE},
	             {29999, BEAM_OK},
	             {299, BEAM_OUT_OF_RANGE},
	             {301, BEAM_OK}};
	int n = sizeof beams / sizeof *beams;
	struct file f = {0};
	struct uos_scan scan;
	struct parse_error error;
	(void)state;
	for (int i = 0; i < 2; i++)
		for (int k = 0; k < n; k++)
			file_point(&f, 40 + k, 5 + i, beams[k].mm / 10);
	assert_int_equal(read_file(&f, &scan, &error), 0);
	assert_int_equal(scan.rows, 2);
	for (int k = 0; k < n; k++)
		assert_int_equal(scan.row[1].state[k], beams[k].state);
	uos_finish(&scan);
	free(f.text);
}

static void points_off_the_raster_are_a_cloud_in_our_frame(void **state)
{
	static const char text[] = "100 20 300\n-50 1 70.5\n13 17 19\n4 5 6\n";
	struct uos_scan scan;
	struct parse_error error;
	(void)state;
	assert_int_equal(uos_read((const uint8_t *)text, sizeof text - 1, &scan, &error), 0);
	assert_int_equal(scan.rows, 0);
	assert_int_equal(scan.cloud.n, 4);
	assert_true(scan.cloud.point[0].x == 3 && scan.cloud.point[0].y == -1 && scan.cloud.point[0].z == 0.2);
	uos_finish(&scan);
}

/* 200 rows of one beam each would be a raster of mostly nothing. */
static void a_sparse_raster_is_a_cloud(void **state)
{
	struct file f = {0};
	struct uos_scan scan;
	struct parse_error error;
	(void)state;
	for (int i = 0; i < 200; i++)
		file_point(&f, 180 - i * 0.25 * (i % 7), i * 0.1, 1000);
	assert_int_equal(read_file(&f, &scan, &error), 0);
	assert_int_equal(scan.rows, 0);
	assert_int_equal(scan.cloud.n, 200);
	uos_finish(&scan);
	free(f.text);
}

static void a_row_that_is_bent_is_no_raster(void **state)
{
	struct file f = {0};
	struct uos_scan scan;
	struct parse_error error;
	(void)state;
	for (int i = 0; i < 5; i++)
		for (int k = 0; k < 181; k++)
			file_point(&f, k, 10 * i + 0.05 * k, 500);
	assert_int_equal(read_file(&f, &scan, &error), 0);
	assert_int_equal(scan.rows, 0);
	uos_finish(&scan);
	free(f.text);
}

static void refused_at(const char *text, uint32_t line)
{
	struct uos_scan scan = {.rows = 77};
	struct parse_error error = {.line = 99};
	assert_int_equal(uos_read((const uint8_t *)text, strlen(text), &scan, &error), -EINVAL);
	assert_int_equal(error.line, line);
	assert_true(strlen(error.text) > 10);
	assert_int_equal(scan.rows, 77); /* results are untouched on failure */
}

static void what_is_no_scan_is_refused_by_its_line(void **state)
{
	(void)state;
	refused_at("", 0);
	refused_at("# nothing\n\n", 0);
	refused_at("1 2 3\n4 5\n", 2);
	refused_at("header 7\n1 2 3\n\n4 five 6\n", 4);
	refused_at("1 2 3\n4 5 6x\n", 2);
	refused_at("1 2 nan\n", 1);
	refused_at("1 2 3\n1e9 0 0\n", 2);
}

static void a_header_and_a_fourth_column_are_left_aside(void **state)
{
	static const char text[] = "3 points\r\n1 2 3 0.5\r\n4 5 6 0.5 7\r\n7 8 10.5";
	struct uos_scan scan;
	struct parse_error error;
	(void)state;
	assert_int_equal(uos_read((const uint8_t *)text, sizeof text - 1, &scan, &error), 0);
	assert_int_equal(scan.cloud.n, 3);
	assert_true(scan.cloud.point[2].x == 0.105);
	uos_finish(&scan);
}

static void every_shorter_file_is_read_or_refused(void **state)
{
	struct file f = {0};
	(void)state;
	fill(&f, 3, 1, 12, 0);
	for (size_t len = 0; len <= f.len; len++) {
		uint8_t *copy = malloc(len + (len == 0));
		struct uos_scan scan;
		struct parse_error error;
		memcpy(copy, f.text, len);
		if (uos_read(copy, len, &scan, &error) == 0)
			uos_finish(&scan);
		free(copy);
	}
	free(f.text);
}

static double random_double(uint64_t *seed)
{
	*seed = *seed * 6364136223846793005u + 1442695040888963407u;
	return (double)(*seed >> 11) * 0x1p-53;
}

static void numbers_are_read_as_the_library_reads_them(void **state)
{
	static const char *const formats[] = {"%.6g", "%.17g", "%.3f", "%.12e", "%+.9f", "%.0f"};
	uint64_t seed = 1;
	double worst = 0;
	(void)state;
	for (int i = 0; i < 60000; i++) {
		char word[400];
		double scale = pow(10, floor(random_double(&seed) * 24) - 12), value;
		sprintf(word, formats[i % 6], (random_double(&seed) - 0.5) * scale);
		struct text text;
		text_init(&text, word, strlen(word));
		assert_true(text_number(&text, &value));
		assert_true(text_ended(&text));
		double expected = strtod(word, NULL), error = fabs(value - expected);
		worst = expected != 0 ? fmax(worst, error / fabs(expected)) : fmax(worst, error);
	}
	printf("note: numbers: worst relative error %.2g\n", worst);
	assert_true(worst < 1e-15);
}

static void a_number_ends_where_a_number_ends(void **state)
{
	static const char *const bad[] = {"",     "-",    ".",  "+-1", "1.2.3", "1e", "1e+",
	                                  "0x10", "nano", "in", "--1", "e5",    "1-"};
	static const struct {
		const char *word;
		double value;
	} good[] = {{".5", 0.5},
	            {"5.", 5},
	            {"-0", -0.0},
	            {"1E3", 1000},
	            {"1e-400", 0},
	            {"1e400", INFINITY},
	            {"-Infinity", -INFINITY},
	            {"00012", 12},
	            {"\t ,;7", 7},
	            {"1e99999999999", INFINITY},
	            {"123456789012345678901234567890", 123456789012345678901234567890.0},
	            {"0.00000000000000000000000000001", 1e-29}};
	struct text text;
	double value;
	(void)state;
	for (size_t i = 0; i < sizeof bad / sizeof *bad; i++) {
		text_init(&text, bad[i], strlen(bad[i]));
		assert_false(text_number(&text, &value));
		assert_ptr_equal(text.at, bad[i]);
	}
	for (size_t i = 0; i < sizeof good / sizeof *good; i++) {
		text_init(&text, good[i].word, strlen(good[i].word));
		assert_true(text_number(&text, &value));
		assert_true(value == good[i].value || fabs(value / good[i].value - 1) < 1e-15);
	}
}

/* The rotation of the file, applied to a point of the file, then turned to our axes: the other way round must agree. */
static void a_pose_turns_points_as_in_its_own_frame(void **state)
{
	static const char text[] = "-3.10605 -7.50803 156.917\n1.35694 -70.852409 33.56224\n\n";
	const double a = 1.35694 * TRIG_DEG, b = -70.852409 * TRIG_DEG, c = 33.56224 * TRIG_DEG;
	double p[3] = {120, -45, 310}, q[3];
	struct transform pose;
	struct parse_error error;
	(void)state;
	assert_int_equal(uos_read_pose(text, sizeof text - 1, &pose, &error), 0);
	struct vec3 ours = transform_point(&pose, (struct vec3){p[2] / 100, -p[0] / 100, p[1] / 100});
	q[0] = cos(c) * p[0] - sin(c) * p[1]; /* Rz first, */
	q[1] = sin(c) * p[0] + cos(c) * p[1];
	p[0] = cos(b) * q[0] + sin(b) * p[2]; /* then Ry, */
	p[2] = -sin(b) * q[0] + cos(b) * p[2];
	q[2] = sin(a) * q[1] + cos(a) * p[2]; /* then Rx */
	q[1] = cos(a) * q[1] - sin(a) * p[2];
	assert_true(fabs(ours.x - (q[2] + 156.917) / 100) < 1e-12);
	assert_true(fabs(ours.y + (p[0] - 3.10605) / 100) < 1e-12);
	assert_true(fabs(ours.z - (q[1] - 7.50803) / 100) < 1e-12);
}

static void a_pose_of_fewer_numbers_is_refused(void **state)
{
	static const char *const bad[] = {"", "0 0 0\n0 0\n", "0 0 0\nzero 0 0\n", "1e9 0 0 0 0 0", "0 0 0 0 0 inf"};
	struct transform pose;
	struct parse_error error;
	(void)state;
	for (size_t i = 0; i < sizeof bad / sizeof *bad; i++)
		assert_int_equal(uos_read_pose(bad[i], strlen(bad[i]), &pose, &error), -EINVAL);
	assert_int_equal(uos_read_pose("0 0 0 0 0 0", 11, &pose, &error), 0);
}

static void compare_with_profiles(const struct uos_scan *scan, struct text *csv)
{
	for (uint32_t i = 0; i < scan->rows; i++) {
		double up_deg = 0, mm;
		assert_true(text_skip_empty(csv) && text_number(csv, &up_deg));
		assert_true(fabs(scan->row[i].tilt_rad + up_deg * TRIG_DEG) < 0.0002 * TRIG_DEG);
		for (uint32_t k = 0; k < scan->row[i].n; k++) {
			assert_true(text_number(csv, &mm));
			assert_true(scan->row[i].range_m[k] == (float)(mm / 1000));
			assert_true((scan->row[i].state[k] == BEAM_OK) == (mm >= 300 && mm <= 30000) || mm == 300);
		}
		text_next_line(csv);
	}
}

static void real_scans_hold_what_the_scanner_said(void **state)
{
	(void)state;
	for (int i = 0; i < REAL_SWEEPS; i++) {
		size_t len = 0, csv_len = 0;
		uint8_t *data = real_scan(i, &len), *csv = data ? real_profiles(i, &csv_len) : NULL;
		struct uos_scan scan;
		struct parse_error error;
		struct text text;
		if (!csv) {
			print_message("the real sweeps (../shared/data) are not here\n");
			free(data);
			skip();
		}
		assert_int_equal(uos_read(data, len, &scan, &error), 0);
		assert_int_equal(scan.rows, REAL_ROWS);
		assert_int_equal(scan.row[0].n, REAL_BEAMS);
		text_init(&text, csv, csv_len);
		compare_with_profiles(&scan, &text);
		uos_finish(&scan);
		free(data);
		free(csv);
	}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_raster_comes_back_as_the_scanner_had_it),
	    cmocka_unit_test(the_step_is_the_coarsest_that_fits),
	    cmocka_unit_test(rows_that_differ_in_length_are_placed_by_bearing),
	    cmocka_unit_test(a_fan_written_from_the_left_is_the_same_raster),
	    cmocka_unit_test(error_codes_are_states_and_not_ranges),
	    cmocka_unit_test(points_off_the_raster_are_a_cloud_in_our_frame),
	    cmocka_unit_test(a_sparse_raster_is_a_cloud),
	    cmocka_unit_test(a_row_that_is_bent_is_no_raster),
	    cmocka_unit_test(what_is_no_scan_is_refused_by_its_line),
	    cmocka_unit_test(a_header_and_a_fourth_column_are_left_aside),
	    cmocka_unit_test(every_shorter_file_is_read_or_refused),
	    cmocka_unit_test(numbers_are_read_as_the_library_reads_them),
	    cmocka_unit_test(a_number_ends_where_a_number_ends),
	    cmocka_unit_test(a_pose_turns_points_as_in_its_own_frame),
	    cmocka_unit_test(a_pose_of_fewer_numbers_is_refused),
	    cmocka_unit_test(real_scans_hold_what_the_scanner_said),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

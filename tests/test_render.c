/* Law: a picture shows what is there: nearer hides farther, the cut takes away what lies above, nothing is left out. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>
#include <errno.h>
#include <math.h>

#include "tools/mesh_read.h"
#include "tools/render.h"
#include "tests/scarce.h"

/* Two squares that look up: a large one on the floor, a small one above its middle; the third one looks down. */
static const char table[] = "ply\r\nformat ascii 1.0\ncomment a table\nelement vertex 12\nproperty float x\n"
                            "property double y\nproperty float32 z\nproperty uchar red\nelement face 3\n"
                            "property list uchar int vertex_indices\nproperty uchar class\nend_header\n"
                            "-2 -2 0 9\n2 -2 0 9\n2 2 0 9\n-2 2 0 9\n-1 -1 1 9\n1 -1 1 9\n1 1 1 9\n-1 1 1 9\n"
                            "-2 -2 3 9\n-2 2 3 9\n2 2 3 9\n2 -2 3 9\n4 0 1 2 3 1\n4 4 5 6 7 8\n4 8 9 10 11 2\n";

static struct mesh read_table(void)
{
	struct mesh mesh;
	struct parse_error error;
	if (mesh_read_ply((const uint8_t *)table, sizeof(table) - 1, &mesh, &error))
		fail_msg("line %u: %s", error.line, error.text);
	return mesh;
}

static struct picture draw(const struct mesh *mesh, double cut_m, bool edges)
{
	const struct render_view view = {
	    .width = 80, .height = 60, .yaw_rad = 0, .pitch_rad = 1.5707963, .cut_m = cut_m, .edges = edges};
	struct picture picture;
	assert_int_equal(render_mesh(mesh, &view, &picture), 0);
	return picture;
}

static const uint8_t *pixel(const struct picture *picture, int x, int y)
{
	return picture->rgb + 3 * (y * picture->width + x);
}

static int difference(const uint8_t *a, const uint8_t *b)
{
	return abs(a[0] - b[0]) + abs(a[1] - b[1]) + abs(a[2] - b[2]);
}

static void a_ply_of_polygons_becomes_triangles_with_classes(void **state)
{
	(void)state;
	struct mesh mesh = read_table();
	assert_int_equal(mesh.nv, 12);
	assert_int_equal(mesh.nt, 6);
	assert_int_equal(mesh.class[0], 1);
	assert_int_equal(mesh.class[3], 8);
	assert_int_equal(mesh.triangle[1][2], 3);
	assert_true(mesh.vertex[4][2] == 1.0f);
	mesh_finish(&mesh);
}

static void the_nearer_face_hides_the_farther_one(void **state)
{
	(void)state;
	struct mesh mesh = read_table();
	struct picture picture = draw(&mesh, 2, false);
	const uint8_t *middle = pixel(&picture, 40, 30), *beside = pixel(&picture, 14, 30);
	assert_true(middle[2] > middle[0]); /* the table is bluish, the floor warm */
	assert_true(beside[0] > beside[2]);
	picture_finish(&picture);
	mesh_finish(&mesh);
}

static void the_cut_takes_away_what_lies_above_it(void **state)
{
	(void)state;
	struct mesh mesh = read_table();
	struct picture picture = draw(&mesh, 0.5, false);
	const uint8_t *middle = pixel(&picture, 40, 30);
	assert_true(middle[0] > middle[2]);
	picture_finish(&picture);
	mesh_finish(&mesh);
}

static void a_back_is_a_veil_and_not_a_wall(void **state)
{
	(void)state;
	struct mesh mesh = read_table();
	struct picture open = draw(&mesh, 2, false), veiled = draw(&mesh, INFINITY, false);
	const int d = difference(pixel(&open, 40, 30), pixel(&veiled, 40, 30));
	assert_true(d > 3 && d < 120);
	picture_finish(&open);
	picture_finish(&veiled);
	mesh_finish(&mesh);
}

static void the_picture_is_filled_to_its_margin(void **state)
{
	(void)state;
	struct mesh mesh = read_table();
	struct picture picture = draw(&mesh, 0.5, false);
	int first = 0, last = 0;
	for (int y = 0; y < picture.height; y++)
		if (difference(pixel(&picture, 40, y), pixel(&picture, 1, y)) > 60) {
			first = first ? first : y;
			last = y;
		}
	assert_in_range(first, 1, 4);
	assert_in_range(last, 55, 58);
	picture_finish(&picture);
	mesh_finish(&mesh);
}

static void edges_are_drawn_where_asked(void **state)
{
	(void)state;
	struct mesh mesh = read_table();
	struct picture plain = draw(&mesh, 2, false), drawn = draw(&mesh, 2, true), again = draw(&mesh, 2, true);
	int darker = 0;
	for (int i = 0; i < 80 * 60; i++)
		darker += drawn.rgb[3 * i] + 8 < plain.rgb[3 * i];
	assert_in_range(darker, 80, 80 * 30);
	assert_memory_equal(drawn.rgb, again.rgb, 80 * 60 * 3);
	picture_finish(&plain);
	picture_finish(&drawn);
	picture_finish(&again);
	mesh_finish(&mesh);
}

static void the_cut_is_found_between_floor_and_ceiling(void **state)
{
	(void)state;
	struct mesh mesh = read_table();
	const double cut = render_cut_height(&mesh);
	assert_true(cut > 1.8 && cut < 2.6);
	mesh.nt = 4; /* without the ceiling */
	assert_true(isinf(render_cut_height(&mesh)));
	mesh_finish(&mesh);
}

static void a_picture_becomes_a_png(void **state)
{
	(void)state;
	struct mesh mesh = read_table();
	struct picture picture = draw(&mesh, 2, false);
	struct buffer png = {0};
	assert_int_equal(render_png(&picture, &png), 0);
	assert_memory_equal(png.data, "\x89PNG\r\n\x1a\n", 8);
	assert_int_equal(png.data[19], 80); /* IHDR: width, height */
	assert_int_equal(png.data[23], 60);
	buffer_finish(&png);
	picture_finish(&picture);
	mesh_finish(&mesh);
}

static void what_cannot_be_drawn_is_refused(void **state)
{
	(void)state;
	struct mesh mesh = read_table();
	struct picture picture;
	struct render_view view = {.width = 80, .height = 60, .pitch_rad = 1, .cut_m = -1};
	assert_int_equal(render_mesh(&mesh, &view, &picture), -EINVAL);
	view.cut_m = 5;
	view.width = RENDER_SIDE_MAX + 1;
	assert_int_equal(render_mesh(&mesh, &view, &picture), -EINVAL);
	mesh_finish(&mesh);
}

/* The same square three ways. */
static void both_byte_orders_are_read(void **state)
{
	(void)state;
	static const uint8_t big[] =
	    "ply\nformat binary_big_endian 1.0\nelement vertex 3\nproperty short x\nproperty short y\n"
	    "property short z\nelement face 1\nproperty list uchar ushort vertex_index\nend_header\n"
	    "\0\1\0\2\xff\xfd\0\0\0\0\0\0\0\0\0\1\0\0\3\0\0\0\1\0\2";
	static const uint8_t little[] =
	    "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty short x\nproperty short y\n"
	    "property short z\nelement face 1\nproperty list uchar ushort vertex_index\nend_header\n"
	    "\1\0\2\0\xfd\xff\0\0\0\0\0\0\0\0\1\0\0\0\3\0\0\1\0\2\0";
	const struct {
		const uint8_t *data;
		size_t len;
	} files[] = {{big, sizeof(big) - 1}, {little, sizeof(little) - 1}};
	for (int i = 0; i < 2; i++) {
		struct mesh mesh;
		struct parse_error error;
		if (mesh_read_ply(files[i].data, files[i].len, &mesh, &error))
			fail_msg("%s", error.text);
		assert_true(mesh.vertex[0][0] == 1 && mesh.vertex[0][1] == 2 && mesh.vertex[0][2] == -3);
		assert_int_equal(mesh.triangle[0][2], 2);
		mesh_finish(&mesh);
	}
}

static void a_file_cut_anywhere_is_refused(void **state)
{
	(void)state;
	/* the last number needs its last digit only */
	for (size_t len = 0; len < sizeof(table) - 3; len++) {
		struct mesh mesh;
		struct parse_error error;
		uint8_t *exact = malloc(len + 1);
		assert_non_null(exact);
		memcpy(exact + 1, table, len);
		if (mesh_read_ply(exact + 1, len, &mesh, &error) != -EINVAL)
			fail_msg("taken at %zu bytes", len);
		assert_true(error.text[0]);
		free(exact);
	}
}

static void bad_files_are_refused_with_line_and_reason(void **state)
{
	(void)state;
	static const struct {
		const char *text, *part;
	} bad[] = {
	    {"obj\n", "not a PLY"},
	    {"ply\nend_header\n", "no format"},
	    {"ply\nformat ascii 2.0\n", "format is not known"},
	    {"ply\nformat ascii 1.0\nproperty int x\n", "before any element"},
	    {"ply\nformat ascii 1.0\nelement vertex -1\n", "name and a count"},
	    {"ply\nformat ascii 1.0\nelement vertex 99999999999\n", "name and a count"},
	    {"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\n", "type of a property"},
	    {"ply\nformat ascii 1.0\nelement vertex 1\nproperty list quad int x\n", "type of a list"},
	    {"ply\nformat ascii 1.0\nnonsense\n", "not understood"},
	    {"ply\nformat ascii 1.0\nelement vertex 1000000\nproperty int x\nend_header\n1\n",
	     "too short for its counts"},
	    {"ply\nformat ascii 1.0\nelement vertex 1\nproperty int x\nend_header\n1\n", "no x, y and z"},
	    {"ply\nformat ascii 1.0\nend_header\n", "no vertices"},
	};
	for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
		struct mesh mesh;
		struct parse_error error = {0};
		assert_int_equal(mesh_read_ply((const uint8_t *)bad[i].text, strlen(bad[i].text), &mesh, &error),
		                 -EINVAL);
		if (!strstr(error.text, bad[i].part))
			fail_msg("%zu gave '%s'", i, error.text);
	}
}

static void faces_that_cannot_be_are_refused(void **state)
{
	(void)state;
	static const char head[] =
	    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
	    "property float z\nelement face 1\nproperty list int int vertex_indices\nend_header\n";
	static const struct {
		const char *rows, *part;
	} bad[] = {
	    {"0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", "does not exist"},
	    {"0 0 0\n1 0 0\n0 1 0\n3 0 1 -1\n", "not a number of a vertex"},
	    {"0 0 0\n1 0 0\n0 1 0\n-3 0 1 2\n", "corners"},
	    {"0 0 0\n1 0 0\n0 1 0\n9999 0 1 2\n", "corners"},
	    {"0 0 0\n1 0 nan\n0 1 0\n3 0 1 2\n", "kilometres"},
	    {"0 0 0\n1 0 a\n0 1 0\n3 0 1 2\n", "a word stands"},
	    {"0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "too early"},
	};
	for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
		char text[600];
		struct mesh mesh;
		struct parse_error error = {0};
		snprintf(text, sizeof(text), "%s%s", head, bad[i].rows);
		assert_int_equal(mesh_read_ply((const uint8_t *)text, strlen(text), &mesh, &error), -EINVAL);
		if (!strstr(error.text, bad[i].part))
			fail_msg("%zu gave '%s'", i, error.text);
	}
}

static int read_and_draw(void)
{
	const struct render_view view = {.width = 20, .height = 15, .pitch_rad = 1, .cut_m = 2, .edges = true};
	struct mesh mesh;
	struct picture picture;
	struct parse_error error;
	struct buffer png = {0};
	int status = mesh_read_ply((const uint8_t *)table, sizeof(table) - 1, &mesh, &error);
	if (status)
		return status;
	status = render_mesh(&mesh, &view, &picture);
	mesh_finish(&mesh);
	if (status)
		return status;
	status = render_png(&picture, &png);
	picture_finish(&picture);
	buffer_finish(&png);
	return status;
}

static void memory_that_runs_out_anywhere_leaves_nothing_behind(void **state)
{
	(void)state;
	if (!SCARCE_WORKS)
		skip();
	int status = -ENOMEM;
	long calls = 0;
	for (; status != 0; calls++) {
		const long live = scarce_live;
		scarce_left = calls;
		status = read_and_draw();
		scarce_left = -1;
		const long leaked = scarce_live - live;
		assert_int_equal(leaked, 0);
		assert_true(status == 0 || status == -ENOMEM);
	}
	assert_true(calls > 12);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_ply_of_polygons_becomes_triangles_with_classes),
	    cmocka_unit_test(the_nearer_face_hides_the_farther_one),
	    cmocka_unit_test(the_cut_takes_away_what_lies_above_it),
	    cmocka_unit_test(a_back_is_a_veil_and_not_a_wall),
	    cmocka_unit_test(the_picture_is_filled_to_its_margin),
	    cmocka_unit_test(edges_are_drawn_where_asked),
	    cmocka_unit_test(the_cut_is_found_between_floor_and_ceiling),
	    cmocka_unit_test(a_picture_becomes_a_png),
	    cmocka_unit_test(what_cannot_be_drawn_is_refused),
	    cmocka_unit_test(both_byte_orders_are_read),
	    cmocka_unit_test(a_file_cut_anywhere_is_refused),
	    cmocka_unit_test(bad_files_are_refused_with_line_and_reason),
	    cmocka_unit_test(faces_that_cannot_be_are_refused),
	    cmocka_unit_test(memory_that_runs_out_anywhere_leaves_nothing_behind),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

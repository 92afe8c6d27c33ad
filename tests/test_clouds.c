/* Laws L8, L9: clouds of every kind are read alike; a file that is cut, damaged or boastful is refused by name. */
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

typedef int reader(const uint8_t *, size_t, struct cloud *, struct parse_error *);

struct bytes {
	uint8_t data[4096];
	size_t len;
};

static const double points[4][3] = {{1.25, -0.5, 0.125}, {-3, 4, 5.5}, {0, 0, 0}, {100.75, -2e-3, 7}};

static void add_text(struct bytes *b, const char *text)
{
	memcpy(b->data + b->len, text, strlen(text));
	b->len += strlen(text);
}

static void add_number(struct bytes *b, uint64_t bits, int size, bool big_endian)
{
	for (int i = 0; i < size; i++)
		b->data[b->len++] = (uint8_t)(bits >> (8 * (big_endian ? size - 1 - i : i)));
}

static void add_float(struct bytes *b, double value, bool big_endian)
{
	float f = (float)value;
	uint32_t bits;
	memcpy(&bits, &f, sizeof bits);
	add_number(b, bits, 4, big_endian);
}

static void add_double(struct bytes *b, double value, bool big_endian)
{
	uint64_t bits;
	memcpy(&bits, &value, sizeof bits);
	add_number(b, bits, 8, big_endian);
}

static void expect_points(reader *read, const struct bytes *b)
{
	struct cloud cloud;
	struct parse_error error = {0};
	if (read(b->data, b->len, &cloud, &error) != 0)
		fail_msg("line %u: %s", error.line, error.text);
	assert_int_equal(cloud.n, 4);
	for (int i = 0; i < 4; i++) {
		assert_true(fabs(cloud.point[i].x - points[i][0]) < 1e-6);
		assert_true(fabs(cloud.point[i].y - points[i][1]) < 1e-6);
		assert_true(fabs(cloud.point[i].z - points[i][2]) < 1e-6);
	}
	cloud_finish(&cloud);
}

/* Every shorter file, in memory of just its size, is read or refused with a sentence. */
static void expect_shorter_ones_judged(reader *read, const struct bytes *b, size_t must_refuse_below)
{
	for (size_t len = 0; len < b->len; len++) {
		uint8_t *copy = malloc(len + (len == 0));
		struct cloud cloud = {.n = 77};
		struct parse_error error = {0};
		memcpy(copy, b->data, len);
		int r = read(copy, len, &cloud, &error);
		if (r == 0) {
			assert_true(len >= must_refuse_below);
			cloud_finish(&cloud);
		} else {
			assert_int_equal(r, -EINVAL);
			assert_true(strlen(error.text) > 5);
			assert_int_equal(cloud.n, 77);
		}
		free(copy);
	}
}

static void expect_refused(reader *read, const char *text, uint32_t line, const char *word)
{
	struct cloud cloud;
	struct parse_error error = {0};
	assert_int_equal(read((const uint8_t *)text, strlen(text), &cloud, &error), -EINVAL);
	assert_int_equal(error.line, line);
	if (!strstr(error.text, word))
		fail_msg("'%s' is not in '%s'", word, error.text);
}

static void lines_of_text_are_points(void **state)
{
	struct bytes b = {.len = 0};
	(void)state;
	add_text(&b, "# a comment\n1.25 -0.5 0.125 17 255 0 0\n\n-3,4;5.5\r\n\t0 0 0\n100.75 -2e-3 7");
	expect_points(xyz_read, &b);
	b.len = 0;
	add_text(&b, "4\n1.25 -0.5 0.125\n-3 4 5.5\nnan nan nan\n0 0 0\n100.75 -2e-3 7\n");
	expect_points(xyz_read, &b);
	b.len = 0;
	add_text(&b, "//X Y Z\n1.25 -0.5 0.125\n-3 4 5.5\n0 0 0\n1e30 0 0\n100.75 -2e-3 7\n");
	expect_points(xyz_read, &b);
	expect_shorter_ones_judged(xyz_read, &b, 0);
	expect_refused(xyz_read, "1 2 3\n4 5\n", 2, "x y z");
	expect_refused(xyz_read, "x y z\nx y z\n", 2, "x y z");
	expect_refused(xyz_read, "", 0, "no points");
	expect_refused(xyz_read, "7\nnan nan nan\n", 0, "no points");
	expect_refused(xyz_read, "500000 5400000 300\n", 0, "shift"); /* metres of a national grid */
}

static void pcd_as_text_is_read_by_its_fields(void **state)
{
	struct bytes b = {.len = 0};
	(void)state;
	add_text(&b,
	         "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS rgb z histogram y x\nSIZE 4 4 4 4 4\n"
	         "TYPE U F F F F\nCOUNT 1 1 2 1 1\nWIDTH 5\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 5\nDATA ascii\n");
	size_t header = b.len;
	add_text(&b, "7 0.125 0 0 -0.5 1.25\n7 5.5 0 0 4 -3\n7 nan 0 0 nan nan\n7 0 9 9 0 0\n7 7 0 0 -2e-3 100.75\n");
	expect_points(pcd_read, &b);
	expect_shorter_ones_judged(pcd_read, &b, header);
}

static void pcd_as_numbers_is_read_by_its_sizes(void **state)
{
	struct bytes b = {.len = 0};
	(void)state;
	add_text(&b, "VERSION .7\nFIELDS x label y z\nSIZE 8 2 8 4\nTYPE F I F F\nWIDTH 2\nHEIGHT 2\nDATA binary\n");
	for (int i = 0; i < 4; i++) {
		add_double(&b, points[i][0], false);
		add_number(&b, 0x1234, 2, false);
		add_double(&b, points[i][1], false);
		add_float(&b, points[i][2], false);
	}
	expect_points(pcd_read, &b);
	expect_shorter_ones_judged(pcd_read, &b, b.len);
}

/* Whole numbers of every size are coordinates too. */
static void pcd_may_hold_whole_numbers(void **state)
{
	static const struct {
		const char *type;
		int size;
	} kinds[] = {{"I", 1}, {"U", 1}, {"I", 2}, {"U", 2}, {"I", 4}, {"U", 4}, {"I", 8}, {"U", 8}};
	(void)state;
	for (size_t i = 0; i < sizeof kinds / sizeof *kinds; i++) {
		struct bytes b = {.len = 0};
		struct cloud cloud;
		struct parse_error error;
		char head[200];
		sprintf(head, "FIELDS x y z\nSIZE %d %d %d\nTYPE %s %s %s\nPOINTS 1\nDATA binary\n", kinds[i].size,
		        kinds[i].size, kinds[i].size, kinds[i].type, kinds[i].type, kinds[i].type);
		bool is_signed = kinds[i].type[0] == 'I';
		add_text(&b, head);
		add_number(&b, 5, kinds[i].size, false);
		add_number(&b, is_signed ? (uint64_t)-7 : 200, kinds[i].size, false);
		add_number(&b, 0, kinds[i].size, false);
		assert_int_equal(pcd_read(b.data, b.len, &cloud, &error), 0);
		assert_true(cloud.point[0].x == 5 && cloud.point[0].y == (is_signed ? -7 : 200) &&
		            cloud.point[0].z == 0);
		cloud_finish(&cloud);
	}
}

/* x, y, z of four points as three arrays of floats: literals, then a run that repeats itself. */
static void make_compressed(struct bytes *b, uint32_t points_said)
{
	char head[120];
	sprintf(head, "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS %u\nDATA binary_compressed\n",
	        points_said);
	struct bytes plain = {.len = 0}, packed = {.len = 0};
	for (int axis = 0; axis < 3; axis++)
		for (int i = 0; i < 4; i++)
			add_float(&plain, axis == 2 ? 1.5 : points[i][axis], false);
	packed.data[packed.len++] = 31; /* 32 literals: x and y */
	memcpy(packed.data + packed.len, plain.data, 32);
	packed.len += 32;
	packed.data[packed.len++] = 3; /* the first z, */
	memcpy(packed.data + packed.len, plain.data + 32, 4);
	packed.len += 4;
	packed.data[packed.len++] = 7 << 5; /* and 12 bytes from 4 back: 7 + 3 + 2 */
	packed.data[packed.len++] = 3;
	packed.data[packed.len++] = 3;
	b->len = 0;
	add_text(b, head);
	add_number(b, packed.len, 4, false);
	add_number(b, plain.len, 4, false);
	memcpy(b->data + b->len, packed.data, packed.len);
	b->len += packed.len;
}

static void pcd_that_is_compressed_is_expanded(void **state)
{
	struct bytes b;
	struct cloud cloud;
	struct parse_error error;
	(void)state;
	make_compressed(&b, 4);
	assert_int_equal(pcd_read(b.data, b.len, &cloud, &error), 0);
	assert_int_equal(cloud.n, 4);
	for (int i = 0; i < 4; i++)
		assert_true(fabs(cloud.point[i].x - points[i][0]) < 1e-6 &&
		            fabs(cloud.point[i].y - points[i][1]) < 1e-6 && cloud.point[i].z == 1.5);
	cloud_finish(&cloud);
	expect_shorter_ones_judged(pcd_read, &b, b.len);
	size_t end = b.len;
	b.data[end - 1] = 200; /* farther back than there is */
	assert_int_equal(pcd_read(b.data, b.len, &cloud, &error), -EINVAL);
	b.data[end - 1] = 3;
	b.data[end - 2] = 60; /* longer than there is room */
	assert_int_equal(pcd_read(b.data, b.len, &cloud, &error), -EINVAL);
	b.data[end - 2] = 2; /* shorter than was said */
	assert_int_equal(pcd_read(b.data, b.len, &cloud, &error), -EINVAL);
	make_compressed(&b, 5);
	assert_int_equal(pcd_read(b.data, b.len, &cloud, &error), -EINVAL);
	make_compressed(&b, 300000000); /* 3.6 GB from 40 bytes */
	assert_int_equal(pcd_read(b.data, b.len, &cloud, &error), -EINVAL);
}

static void pcd_headers_are_judged(void **state)
{
	(void)state;
	expect_refused(pcd_read, "", 1, "DATA");
	expect_refused(pcd_read, "hello\n", 1, "PCD");
	expect_refused(pcd_read, "FIELDS x y\nSIZE 4 4\nTYPE F F\nPOINTS 1\nDATA ascii\n1 2\n", 6, "x y z");
	expect_refused(pcd_read, "FIELDS x y z\nSIZE 4 4\n", 2, "PCD");
	expect_refused(pcd_read, "FIELDS x y z\nSIZE 4 4 4 4\n", 2, "PCD");
	expect_refused(pcd_read, "FIELDS x y z\nSIZE 4 4 3\n", 2, "PCD");
	expect_refused(pcd_read, "FIELDS x y z\nTYPE F F Q\n", 2, "PCD");
	expect_refused(pcd_read, "FIELDS x y z\nCOUNT 1 1 99999999\n", 2, "PCD");
	expect_refused(pcd_read, "FIELDS x y z\nSIZE 2 2 2\nTYPE F F F\nPOINTS 1\nDATA ascii\n", 6, "size");
	expect_refused(pcd_read, "FIELDS x y z\nCOUNT 2 1 1\nPOINTS 1\nDATA ascii\n", 5, "size");
	expect_refused(pcd_read, "FIELDS x y z\nDATA ascii\n1 2 3\n", 3, "POINTS");
	expect_refused(pcd_read, "FIELDS x y z\nPOINTS many\n", 2, "PCD");
	expect_refused(pcd_read, "FIELDS x y z\nPOINTS 1\nDATA zipped\n", 3, "PCD");
	expect_refused(pcd_read, "FIELDS x y z\nPOINTS 2\nDATA ascii\n1 2 3\n", 5, "cut");
	expect_refused(pcd_read, "FIELDS x y z\nPOINTS 2\nDATA ascii\n1 2 3\n4 5\n", 5, "fewer");
	expect_refused(pcd_read, "FIELDS x y z\nPOINTS 1000000000000\nDATA binary\n1234", 0, "cut");
	expect_refused(pcd_read, "FIELDS x y z\nPOINTS 0\nDATA binary\n", 0, "no points");
	char many[400] = "FIELDS x y z";
	for (int i = 0; i < 64; i++)
		strcat(many, " a");
	strcat(many, "\n");
	expect_refused(pcd_read, many, 1, "PCD");
}

static void ply_as_text_is_read_by_its_properties(void **state)
{
	struct bytes b = {.len = 0};
	(void)state;
	add_text(&b,
	         "ply\r\nformat ascii 1.0\r\ncomment made by hand\nobj_info none\n\nelement material 2\nproperty list "
	         "uchar int "
	         "ids\nproperty float shine\nelement vertex 4\nproperty uchar red\nproperty float z\nproperty float x\n"
	         "property double y\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n");
	size_t header = b.len;
	add_text(&b, "3 7 8 9 0.5\n0 0.25\n255 0.125 1.25 -0.5\n255 5.5 -3\n4\n1 0 0 0\n2 7 100.75 -2e-3\n3 0 1 2\n");
	expect_points(ply_read_cloud, &b);
	expect_shorter_ones_judged(ply_read_cloud, &b, header);
}

static void make_binary_ply(struct bytes *b, bool big_endian)
{
	b->len = 0;
	add_text(b, big_endian ? "ply\nformat binary_big_endian 1.0\n" : "ply\nformat binary_little_endian 1.0\n");
	add_text(
	    b,
	    "element before 2\nproperty list ushort int16 ids\nproperty uint8 one\nelement empty 3\nelement vertex 4\n"
	    "property float x\nproperty list uchar double normals\nproperty double y\nproperty float32 "
	    "z\nend_header\n");
	for (int i = 0; i < 2; i++) {
		add_number(b, (uint64_t)(2 - i), 2, big_endian);
		for (int k = 0; k < 2 - i; k++)
			add_number(b, 999, 2, big_endian);
		add_number(b, 1, 1, big_endian);
	}
	for (int i = 0; i < 4; i++) {
		add_float(b, points[i][0], big_endian);
		add_number(b, 1, 1, big_endian);
		add_double(b, 0.5, big_endian);
		add_double(b, points[i][1], big_endian);
		add_float(b, points[i][2], big_endian);
	}
}

static void ply_as_numbers_is_read_in_both_orders(void **state)
{
	struct bytes b;
	(void)state;
	for (int big_endian = 0; big_endian < 2; big_endian++) {
		make_binary_ply(&b, big_endian);
		expect_points(ply_read_cloud, &b);
		expect_shorter_ones_judged(ply_read_cloud, &b, b.len);
	}
}

#define XYZ "property float x\nproperty float y\nproperty float z\n"

static void ply_headers_are_judged(void **state)
{
	(void)state;
	expect_refused(ply_read_cloud, "", 1, "ply");
	expect_refused(ply_read_cloud, "plyx\n", 1, "ply");
	expect_refused(ply_read_cloud, "ply\nformat ascii 1.0\nelement vertex 1\n", 4, "cut");
	expect_refused(ply_read_cloud, "ply\nelement vertex 1\n" XYZ "end_header\n1 2 3\n", 6, "format");
	expect_refused(ply_read_cloud, "ply\nformat middle_endian 1.0\n", 2, "PLY");
	expect_refused(ply_read_cloud, "ply\nformat ascii 1.0\nelement vertex\n", 3, "PLY");
	expect_refused(ply_read_cloud, "ply\nformat ascii 1.0\nelement vertex -4\n", 3, "PLY");
	expect_refused(ply_read_cloud, "ply\nformat ascii 1.0\nproperty float x\n", 3, "PLY");
	expect_refused(ply_read_cloud, "ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\n", 4, "PLY");
	expect_refused(ply_read_cloud, "ply\nformat ascii 1.0\nelement vertex 1\nproperty list float int x\n", 4,
	               "PLY");
	expect_refused(ply_read_cloud, "ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int\n", 4, "PLY");
	expect_refused(ply_read_cloud, "ply\nformat ascii 1.0\nnonsense\n", 3, "PLY");
	expect_refused(ply_read_cloud, "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", 5,
	               "x y z");
	expect_refused(ply_read_cloud, "ply\nformat ascii 1.0\nelement face 1\nend_header\n", 4, "vertices");
	expect_refused(ply_read_cloud, "ply\nformat ascii 1.0\nelement vertex 2\n" XYZ "end_header\n1 2 3\n4 five 6\n",
	               9, "vertex");
	expect_refused(ply_read_cloud,
	               "ply\nformat binary_little_endian 1.0\nelement vertex 999999999999\n" XYZ "end_header\n123", 0,
	               "cut");
	/* A list of four thousand million numbers that are not there. */
	struct bytes b = {.len = 0};
	struct cloud cloud;
	struct parse_error error;
	add_text(&b,
	         "ply\nformat binary_little_endian 1.0\nelement a 1\nproperty list uint uchar n\nelement vertex 1\n" XYZ
	         "end_header\n\xff\xff\xff\xff");
	assert_int_equal(ply_read_cloud(b.data, b.len, &cloud, &error), -EINVAL);
	char many[4096] = "ply\nformat ascii 1.0\n";
	for (int i = 0; i < 17; i++)
		strcat(many, "element a 1\n");
	expect_refused(ply_read_cloud, many, 19, "PLY");
	strcpy(many, "ply\nformat ascii 1.0\nelement vertex 1\n");
	for (int i = 0; i < 65; i++)
		strcat(many, "property float a\n");
	expect_refused(ply_read_cloud, many, 68, "PLY");
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(lines_of_text_are_points),
	    cmocka_unit_test(pcd_as_text_is_read_by_its_fields),
	    cmocka_unit_test(pcd_as_numbers_is_read_by_its_sizes),
	    cmocka_unit_test(pcd_may_hold_whole_numbers),
	    cmocka_unit_test(pcd_that_is_compressed_is_expanded),
	    cmocka_unit_test(pcd_headers_are_judged),
	    cmocka_unit_test(ply_as_text_is_read_by_its_properties),
	    cmocka_unit_test(ply_as_numbers_is_read_in_both_orders),
	    cmocka_unit_test(ply_headers_are_judged),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

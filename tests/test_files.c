/* What is written is what was meshed: welded by lattice point, readable, with every number where the format wants it. */
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

#include "core/model.h"

/* Two patches that meet at x = 4096: a square of two faces on plane 5, and beyond the border one face, on no plane. An
 * unused vertex stands first. */
static struct patch_store *two_patches(int32_t x)
{
	uint16_t left[5][3] = {{9, 9, 9}, {3840, 0, 256}, {4096, 0, 256}, {4096, 512, 256}, {3840, 512, 256}};
	uint16_t right[3][3] = {{0, 0, 256}, {768, 0, 256}, {0, 512, 256}};
	uint32_t left_face[2][3] = {{1, 2, 3}, {1, 3, 4}}, right_face[1][3] = {{0, 1, 2}}, plane[2] = {5, 5};
	struct surface a = {.nv = 5, .nt = 2, .vertex = left, .triangle = left_face, .plane = plane};
	struct surface b = {.nv = 3, .nt = 1, .vertex = right, .triangle = right_face};
	struct patch_store *store = patch_store_create();
	assert_int_equal(patch_store_put(store, patch_create((struct patch_key){x + 1, 0, 0}, &b)), 0);
	assert_int_equal(patch_store_put(store, patch_create((struct patch_key){x, 0, 0}, &a)), 0);
	patch_store_get(store, (struct patch_key){x, 0, 0})->run[0].class = 1;
	return store;
}

static struct model weld(int32_t x, double cell_m)
{
	struct patch_store *store = two_patches(x);
	struct model model;
	assert_int_equal(model_weld(store, cell_m, &model), 0);
	patch_store_destroy(store);
	return model;
}

static void vertices_weld_across_patches_and_unused_ones_go(void **state)
{
	(void)state;
	static const double expected[5][3] = {{-1, 0, 1}, {0, 0, 1}, {0, 2, 1}, {-1, 2, 1}, {3, 0, 1}};
	static const uint32_t triangles[3][3] = {{0, 1, 2}, {0, 2, 3}, {1, 4, 2}};
	struct model model = weld(-1, 1.0);
	assert_int_equal(model.nv, 5);
	assert_int_equal(model.nt, 3);
	assert_memory_equal(model.vertex, expected, sizeof expected);
	assert_memory_equal(model.triangle, triangles, sizeof triangles);
	for (uint32_t v = 0; v < 5; v++)
		assert_true(model.normal[v][0] == 0 && model.normal[v][1] == 0 && model.normal[v][2] == 1);
	assert_true(model.plane[0] == 0 && model.plane[1] == 0 && model.plane[2] == -1);
	assert_true(model.class[0] == 1 && model.class[1] == 1 && model.class[2] == 0);
	model_finish(&model);
}

static void planes_of_two_patches_are_two_planes(void **state)
{
	(void)state;
	uint16_t vertex[3][3] = {{0, 0, 0}, {256, 0, 0}, {0, 256, 0}};
	uint32_t face[2][3] = {{0, 1, 2}, {0, 2, 1}}, plane[2] = {0, 1};
	struct surface surface = {.nv = 3, .nt = 2, .vertex = vertex, .triangle = face, .plane = plane};
	struct patch_store *store = patch_store_create();
	for (int x = 0; x < 2; x++)
		patch_store_put(store, patch_create((struct patch_key){x, 0, 0}, &surface));
	struct model model;
	assert_int_equal(model_weld(store, 1.0, &model), 0);
	for (int t = 0; t < 4; t++)
		assert_int_equal(model.plane[t], t);
	for (uint32_t v = 0; v < model.nv; v++) /* the two faces cancel out: straight up */
		assert_true(model.normal[v][0] == 0 && model.normal[v][1] == 0 && model.normal[v][2] == 1);
	model_finish(&model);
	patch_store_destroy(store);
}

/* A floor of area 2 and a wall of area 1 along one edge. */
static void normals_are_weighted_by_area(void **state)
{
	(void)state;
	uint16_t vertex[4][3] = {{0, 0, 0}, {256, 0, 0}, {0, 512, 0}, {0, 0, 256}};
	uint32_t face[2][3] = {{0, 1, 2}, {0, 3, 1}};
	struct surface surface = {.nv = 4, .nt = 2, .vertex = vertex, .triangle = face};
	struct patch_store *store = patch_store_create();
	patch_store_put(store, patch_create((struct patch_key){0, 0, 0}, &surface));
	struct model model;
	assert_int_equal(model_weld(store, 0.05, &model), 0);
	assert_true(fabs((double)model.normal[0][1] - 1 / sqrt(5)) < 1e-6 &&
	            fabs((double)model.normal[0][2] - 2 / sqrt(5)) < 1e-6);
	assert_true(model.normal[2][2] == 1 && model.normal[3][1] == 1);
	model_finish(&model);
	patch_store_destroy(store);
}

static void far_from_the_origin_lattice_points_stay_apart_and_equal_ones_equal(void **state)
{
	(void)state;
	struct model model = weld(-262000, 0.05), other = weld(200000, 0.05);
	assert_int_equal(model.nv, 5);
	assert_true(model.vertex[0][0] == (-262000.0 * 4096 + 3840) * (0.05 / 256));
	assert_true(other.vertex[1][0] == 200001.0 * 4096 * (0.05 / 256));
	model_finish(&model);
	model_finish(&other);
}

static const char golden_ply[] = "ply\n"
                                 "format ascii 1.0\n"
                                 "comment facetd: metres, map frame, z up\n"
                                 "element vertex 5\n"
                                 "property double x\n"
                                 "property double y\n"
                                 "property double z\n"
                                 "property float nx\n"
                                 "property float ny\n"
                                 "property float nz\n"
                                 "element face 3\n"
                                 "property list uchar int vertex_indices\n"
                                 "property int plane\n"
                                 "property uchar class\n"
                                 "end_header\n"
                                 "0.75 0 0.050000000000000003 0 0 1\n"
                                 "0.80000000000000004 0 0.050000000000000003 0 0 1\n"
                                 "0.80000000000000004 0.10000000000000001 0.050000000000000003 0 0 1\n"
                                 "0.75 0.10000000000000001 0.050000000000000003 0 0 1\n"
                                 "0.95000000000000007 0 0.050000000000000003 0 0 1\n"
                                 "3 0 1 2 0 1\n"
                                 "3 0 2 3 0 1\n"
                                 "3 1 4 2 -1 0\n";

static const char golden_obj[] = "# facetd: metres, map frame, z up; 5 vertices, 3 faces\n"
                                 "v 0.75 0 0.05\n"
                                 "v 0.8 0 0.05\n"
                                 "v 0.8 0.1 0.05\n"
                                 "v 0.75 0.1 0.05\n"
                                 "v 0.95 0 0.05\n"
                                 "vn 0 0 1\n"
                                 "vn 0 0 1\n"
                                 "vn 0 0 1\n"
                                 "vn 0 0 1\n"
                                 "vn 0 0 1\n"
                                 "f 1//1 2//2 3//3\n"
                                 "f 1//1 3//3 4//4\n"
                                 "f 2//2 5//5 3//3\n";

static void text_files_are_the_golden_ones(void **state)
{
	(void)state;
	struct model model = weld(0, 0.05);
	struct buffer ply = {0}, obj = {0};
	ply_write(&model, true, &ply);
	obj_write(&model, &obj);
	assert_int_equal(ply.error | obj.error, 0);
	assert_int_equal(ply.len, sizeof golden_ply - 1);
	assert_memory_equal(ply.data, golden_ply, ply.len);
	assert_int_equal(obj.len, sizeof golden_obj - 1);
	assert_memory_equal(obj.data, golden_obj, obj.len);
	buffer_finish(&ply);
	buffer_finish(&obj);
	model_finish(&model);
}

static uint32_t u32_at(const uint8_t *data)
{
	return data[0] | (uint32_t)data[1] << 8 | (uint32_t)data[2] << 16 | (uint32_t)data[3] << 24;
}

static double f64_at(const uint8_t *data)
{
	uint64_t bits = u32_at(data) | (uint64_t)u32_at(data + 4) << 32;
	double value;
	memcpy(&value, &bits, 8);
	return value;
}

static float f32_at(const uint8_t *data)
{
	uint32_t bits = u32_at(data);
	float value;
	memcpy(&value, &bits, 4);
	return value;
}

static void binary_ply_reads_back(void **state)
{
	(void)state;
	struct model model = weld(-3, 0.05);
	struct buffer ply = {0};
	ply_write(&model, false, &ply);
	const char *end = "end_header\n";
	const uint8_t *at = memmem(ply.data, ply.len, end, strlen(end));
	assert_non_null(at);
	assert_non_null(memmem(ply.data, ply.len, "format binary_little_endian 1.0\n", 32));
	at += strlen(end);
	assert_int_equal(ply.data + ply.len - at, 5 * 36 + 3 * 18);
	for (uint32_t v = 0; v < model.nv; v++, at += 36)
		for (int a = 0; a < 3; a++) {
			assert_true(f64_at(at + 8 * a) == model.vertex[v][a]);
			assert_true(f32_at(at + 24 + 4 * a) == model.normal[v][a]);
		}
	for (uint32_t t = 0; t < model.nt; t++, at += 18) {
		assert_int_equal(at[0], 3);
		for (int c = 0; c < 3; c++)
			assert_int_equal(u32_at(at + 1 + 4 * c), model.triangle[t][c]);
		assert_int_equal((int32_t)u32_at(at + 13), model.plane[t]);
		assert_int_equal(at[17], model.class[t]);
	}
	buffer_finish(&ply);
	model_finish(&model);
}

static void ascii_ply_brings_the_same_doubles_back(void **state)
{
	(void)state;
	struct model model = weld(-26151, 0.03);
	struct buffer ply = {0};
	ply_write(&model, true, &ply);
	buffer_append(&ply, "", 1);
	char *at = strstr((char *)ply.data, "end_header\n") + 11;
	for (uint32_t v = 0; v < model.nv; v++)
		for (int n = 0; n < 6; n++) {
			double value = strtod(at, &at);
			assert_true(n < 3 ? value == model.vertex[v][n] : (float)value == model.normal[v][n - 3]);
		}
	buffer_finish(&ply);
	model_finish(&model);
}

static void stl_reads_back(void **state)
{
	(void)state;
	struct model model = weld(-1, 0.05);
	struct buffer stl = {0};
	stl_write(&model, &stl);
	assert_int_equal(stl.len, 84 + 3 * 50);
	assert_memory_not_equal(stl.data, "solid", 5);
	assert_int_equal(u32_at(stl.data + 80), 3);
	for (uint32_t t = 0; t < 3; t++) {
		const uint8_t *at = stl.data + 84 + 50 * t;
		assert_true(f32_at(at) == 0 && f32_at(at + 4) == 0 && f32_at(at + 8) == 1);
		for (int n = 0; n < 9; n++)
			assert_true(f32_at(at + 12 + 4 * n) == (float)model.vertex[model.triangle[t][n / 3]][n % 3]);
		assert_int_equal(at[48] | at[49], 0);
	}
	buffer_finish(&stl);
	model_finish(&model);
}

static void check_glb_header(const struct buffer *glb, uint32_t *ret_json_len)
{
	assert_memory_equal(glb->data, "glTF", 4);
	assert_int_equal(u32_at(glb->data + 4), 2);
	assert_int_equal(u32_at(glb->data + 8), glb->len);
	*ret_json_len = u32_at(glb->data + 12);
	assert_memory_equal(glb->data + 16, "JSON", 4);
	assert_int_equal(*ret_json_len % 4, 0);
	assert_true(20 + *ret_json_len <= glb->len);
}

static void expect_in(const char *json, const char *text)
{
	if (!strstr(json, text))
		fail_msg("%s is not in %s", text, json);
}

static void glb_holds_positions_normals_and_indices_turned_y_up(void **state)
{
	(void)state;
	struct model model = weld(-1, 0.05);
	struct buffer glb = {0};
	uint32_t json_len;
	gltf_write(&model, &glb);
	check_glb_header(&glb, &json_len);
	char *json = strndup((char *)glb.data + 20, json_len);
	expect_in(json, "{\"asset\":{\"version\":\"2.0\"");
	expect_in(json, "\"componentType\":5126,\"count\":5,\"type\":\"VEC3\","
	                "\"min\":[0,0.0500000007,-0.0500000007],\"max\":[0.100000001,0.0500000007,0.150000006]");
	expect_in(json, "\"componentType\":5125,\"count\":9,\"type\":\"SCALAR\"");
	expect_in(json, "{\"buffer\":0,\"byteOffset\":0,\"byteLength\":60,\"target\":34962}");
	expect_in(json, "{\"buffer\":0,\"byteOffset\":60,\"byteLength\":60,\"target\":34962}");
	expect_in(json, "{\"buffer\":0,\"byteOffset\":120,\"byteLength\":36,\"target\":34963}");
	expect_in(json, "\"buffers\":[{\"byteLength\":156}]");
	free(json);
	const uint8_t *bin = glb.data + 20 + json_len;
	assert_int_equal(u32_at(bin), 156);
	assert_memory_equal(bin + 4, "BIN", 4);
	assert_int_equal(glb.len, 20 + json_len + 8 + 156);
	for (uint32_t v = 0; v < 5; v++)
		for (int a = 0; a < 3; a++) {
			assert_true(f32_at(bin + 8 + 12 * v + 4 * a) == (float)model.vertex[v][(a + 1) % 3]);
			assert_true(f32_at(bin + 68 + 12 * v + 4 * a) == (float)(a == 1));
		}
	for (int n = 0; n < 9; n++)
		assert_int_equal(u32_at(bin + 128 + 4 * n), model.triangle[n / 3][n % 3]);
	buffer_finish(&glb);
	model_finish(&model);
}

static void an_empty_map_gives_valid_files(void **state)
{
	(void)state;
	struct patch_store *store = patch_store_create();
	struct model model;
	struct buffer file = {0};
	uint32_t json_len;
	assert_int_equal(model_weld(store, 0.05, &model), 0);
	assert_int_equal(model.nv | model.nt, 0);
	gltf_write(&model, &file);
	check_glb_header(&file, &json_len);
	assert_int_equal(file.len, 20 + json_len);
	assert_null(memmem(file.data, file.len, "accessors", 9));
	file.len = 0;
	stl_write(&model, &file);
	assert_int_equal(file.len, 84);
	file.len = 0;
	ply_write(&model, false, &file);
	assert_non_null(memmem(file.data, file.len, "element vertex 0\n", 17));
	buffer_finish(&file);
	model_finish(&model);
	patch_store_destroy(store);
}

static void a_buffer_grows_and_remembers_a_failure(void **state)
{
	(void)state;
	struct buffer buffer = {0};
	char text[700];
	memset(text, 'x', sizeof text);
	text[sizeof text - 1] = 0;
	for (int i = 0; i < 1000; i++)
		buffer_printf(&buffer, "%d,", i);
	assert_int_equal(buffer.len, 2 * 10 + 3 * 90 + 4 * 900);
	assert_memory_equal(buffer.data, "0,1,2,3,", 8);
	buffer_printf(&buffer, "<%s>", text); /* longer than what is formatted on the stack */
	assert_int_equal(buffer.len, 3890 + 701);
	assert_memory_equal(buffer.data + buffer.len - 3, "xx>", 3);
	buffer_append(&buffer, text, SIZE_MAX - 10000);
	assert_true(buffer.error < 0);
	buffer_append(&buffer, "y", 1);
	assert_int_equal(buffer.len, 3890 + 701);
	buffer_finish(&buffer);
	assert_null(buffer.data);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(vertices_weld_across_patches_and_unused_ones_go),
	    cmocka_unit_test(planes_of_two_patches_are_two_planes),
	    cmocka_unit_test(normals_are_weighted_by_area),
	    cmocka_unit_test(far_from_the_origin_lattice_points_stay_apart_and_equal_ones_equal),
	    cmocka_unit_test(text_files_are_the_golden_ones),
	    cmocka_unit_test(binary_ply_reads_back),
	    cmocka_unit_test(ascii_ply_brings_the_same_doubles_back),
	    cmocka_unit_test(stl_reads_back),
	    cmocka_unit_test(glb_holds_positions_normals_and_indices_turned_y_up),
	    cmocka_unit_test(an_empty_map_gives_valid_files),
	    cmocka_unit_test(a_buffer_grows_and_remembers_a_failure),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

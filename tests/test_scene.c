/* Law: a patch as an entity of a scene has every triangle of the patch once, at its place, under the class it has. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>
#include <jansson.h>

#include "core/protobuf.h"
#include "core/scene.h"

#define CELL 0.05

/* A tetrahedron: two triangles of one plane, two of no plane. */
static struct patch *tetrahedron(struct patch_key key, uint64_t version)
{
	uint16_t vertex[4][3] = {{0, 0, 0}, {256, 0, 0}, {0, 256, 0}, {0, 0, 4096}};
	uint32_t triangle[4][3] = {{0, 2, 1}, {0, 1, 3}, {0, 3, 2}, {1, 2, 3}};
	uint32_t plane[4] = {7, 7, UINT32_MAX, UINT32_MAX};
	struct surface surface = {.nv = 4, .nt = 4, .vertex = vertex, .triangle = triangle, .plane = plane};
	struct patch *patch = patch_create(key, &surface);

	assert_non_null(patch);
	patch->version = version;
	patch->t_first_ns = 1;
	patch->t_last_ns = 1700000000250000000;
	return patch;
}

static void expect_text(struct buffer *b, const char *text)
{
	assert_int_equal(b->error, 0);
	buffer_append(b, "", 1);
	assert_string_equal((char *)b->data, text);
	b->len = 0;
}

static void expect_bytes(struct buffer *b, const char *hex)
{
	char text[4096];

	assert_int_equal(b->error, 0);
	assert_true(b->len * 2 < sizeof(text));
	for (size_t i = 0; i < b->len; i++)
		snprintf(text + 2 * i, 3, "%02x", b->data[i]);
	text[b->len * 2] = 0;
	assert_string_equal(text, hex);
	b->len = 0;
}

static void an_entity_has_its_golden_text(void **state)
{
	struct patch *patch = tetrahedron((struct patch_key){-1, 2, 0}, 77);
	struct buffer b = {0};

	(void)state;
	scene_put_entity(&b, SCENE_AS_JSON, patch, CELL);
	expect_text(
	    &b, "{\"timestamp\":{\"sec\":1700000000,\"nsec\":250000000},\"frame_id\":\"map\",\"id\":\"-1,2,0\","
	        "\"lifetime\":{\"sec\":0,\"nsec\":0},\"frame_locked\":true,"
	        "\"metadata\":[{\"key\":\"version\",\"value\":\"77\"}],"
	        "\"arrows\":[],\"cubes\":[],\"spheres\":[],\"cylinders\":[],\"lines\":[],\"triangles\":["
	        "{\"pose\":{\"position\":{\"x\":0,\"y\":0,\"z\":0},\"orientation\":{\"x\":0,\"y\":0,\"z\":0,\"w\":1}},"
	        "\"points\":[{\"x\":-0.8,\"y\":1.6,\"z\":0},{\"x\":-0.8,\"y\":1.65,\"z\":0},"
	        "{\"x\":-0.75,\"y\":1.6,\"z\":0},{\"x\":-0.8,\"y\":1.6,\"z\":0.8}],"
	        "\"color\":{\"r\":0.66,\"g\":0.70,\"b\":0.76,\"a\":1},\"colors\":[],"
	        "\"indices\":[0,1,2,0,2,3,0,3,1,2,1,3]}],\"texts\":[],\"models\":[]}");
	buffer_finish(&b);
	patch_unref(patch);
}

static void an_entity_has_its_golden_bytes(void **state)
{
	struct patch *patch = tetrahedron((struct patch_key){0, 0, 0}, 77);
	struct buffer b = {0};

	(void)state;
	scene_put_entity(&b, SCENE_AS_PROTOBUF, patch, 256);
	expect_bytes(&b,
	             "128a020a0b0880e2cfaa061080e59a7712036d61701a05302c302c3022002801320d0a0776657273696f6e1202373762"
	             "db010a0d0a00120921000000000000f03f121b090000000000000000110000000000000000190000000000000000121b"
	             "090000000000000000110000000000007040190000000000000000121b09000000000000704011000000000000000019"
	             "0000000000000000121b09000000000000000011000000000000000019000000000000b0401a24091f85eb51b81ee53f"
	             "11666666666666e63f1952b81e85eb51e83f21000000000000f03f2a3000000000010000000200000000000000020000"
	             "0003000000000000000300000001000000020000000100000003000000");
	buffer_finish(&b);
	patch_unref(patch);
}

static void deletions_have_their_golden_bytes(void **state)
{
	const struct scene_deletion one = {.t_ns = 1500000000, .key = {-3, 0, 12}}, all = {.t_ns = -1, .all = true};
	struct buffer b = {0};

	(void)state;
	scene_put_deletion(&b, SCENE_AS_JSON, &one);
	expect_text(&b, "{\"timestamp\":{\"sec\":1,\"nsec\":500000000},\"type\":0,\"id\":\"-3,0,12\"}");
	scene_put_deletion(&b, SCENE_AS_JSON, &all);
	expect_text(&b, "{\"timestamp\":{\"sec\":-1,\"nsec\":999999999},\"type\":1,\"id\":\"\"}");
	scene_put_deletion(&b, SCENE_AS_PROTOBUF, &one);
	expect_bytes(&b, "0a15"
	                 "0a08080110"
	                 "80cab5ee01"
	                 "1000"
	                 "1a072d332c302c3132");
	scene_put_deletion(&b, SCENE_AS_PROTOBUF, &all);
	expect_bytes(&b, "0a17"
	                 "0a1108ffffffffffffffffff0110ff93ebdc03"
	                 "1001"
	                 "1a00");
	buffer_finish(&b);
}

/* Points and triangles of one class come to their own list; together they are the patch. */
static void classes_come_apart_and_nothing_is_lost(void **state)
{
	struct patch *patch = tetrahedron((struct patch_key){0, 0, 0}, 1);
	struct buffer b = {0};
	json_t *entity, *lists;
	json_error_t error;
	size_t triangles = 0;

	(void)state;
	assert_int_equal(patch->nruns, 2);
	patch->run[0].class = 3;
	patch->run[1].class = 200; /* of a later version */
	scene_put_entity(&b, SCENE_AS_JSON, patch, CELL);
	entity = json_loadb((char *)b.data, b.len, JSON_REJECT_DUPLICATES, &error);
	assert_non_null(entity);
	lists = json_object_get(entity, "triangles");
	assert_int_equal(json_array_size(lists), 2);
	for (size_t i = 0; i < 2; i++) {
		const json_t *list = json_array_get(lists, i), *indices = json_object_get(list, "indices");
		const size_t points = json_array_size(json_object_get(list, "points"));

		assert_int_equal(json_array_size(indices), patch->run[1 - i].triangles * 3);
		triangles += json_array_size(indices) / 3;
		assert_true(points >= 3 && points <= patch->nv);
		for (size_t k = 0; k < json_array_size(indices); k++)
			assert_true(json_integer_value(json_array_get(indices, k)) < (json_int_t)points);
	}
	assert_int_equal(triangles, patch->nt);
	json_decref(entity);
	buffer_finish(&b);
	patch_unref(patch);
}

static void an_update_is_deletions_then_entities(void **state)
{
	struct patch *patch[3] = {tetrahedron((struct patch_key){1, 0, 0}, 1),
	                          tetrahedron((struct patch_key){2, 0, 0}, 1),
	                          patch_allocate((struct patch_key){3, 0, 0}, 0, 0, 0)};
	struct buffer b = {0};
	json_t *update;
	json_error_t error;

	(void)state;
	for (int all = 0; all < 2; all++) {
		b.len = 0;
		scene_put_update(&b, SCENE_AS_JSON, 5, all, patch, 3, CELL);
		update = json_loadb((char *)b.data, b.len, JSON_REJECT_DUPLICATES, &error);
		assert_non_null(update);
		assert_int_equal(json_array_size(json_object_get(update, "deletions")), 1);
		assert_int_equal(json_array_size(json_object_get(update, "entities")), 2);
		json_decref(update);
	}
	b.len = 0;
	scene_put_update(&b, SCENE_AS_JSON, 5, false, patch, 0, CELL);
	expect_text(&b, SCENE_JSON_BEGIN SCENE_JSON_MIDDLE SCENE_JSON_END);
	buffer_finish(&b);
	for (int i = 0; i < 3; i++)
		patch_unref(patch[i]);
}

/* Lattice points of far patches, as text and as they are. */
static void positions_are_right_to_a_twentieth_of_a_millimetre(void **state)
{
	const struct patch_key key[] = {{0, 0, 0}, {-1, -1, -1}, {250000, -250000, 3}, {-262144, 262143, 0}};
	struct buffer b = {0};
	json_error_t error;

	(void)state;
	for (size_t i = 0; i < sizeof(key) / sizeof(key[0]); i++) {
		struct patch *patch = tetrahedron(key[i], 1);
		json_t *entity, *point;

		b.len = 0;
		patch->vertex[0][0] = 1; /* the least there is */
		scene_put_entity(&b, SCENE_AS_JSON, patch, CELL);
		entity = json_loadb((char *)b.data, b.len, JSON_DECODE_INT_AS_REAL, &error);
		point = json_array_get(
		    json_object_get(json_array_get(json_object_get(entity, "triangles"), 0), "points"), 0);
		assert_true(fabs(json_real_value(json_object_get(point, "x")) - (key[i].x * 16.0 + 1.0 / 256) * CELL) <=
		            0.00005000001);
		assert_true(fabs(json_real_value(json_object_get(point, "y")) - key[i].y * 16.0 * CELL) <=
		            0.00005000001);
		json_decref(entity);
		patch_unref(patch);
	}
	buffer_finish(&b);
}

/* Lengths of one, two and three bytes; times before 1970. */
static void lengths_and_numbers_take_the_bytes_they_need(void **state)
{
	static const char text[20000] = {0};
	struct buffer b = {0};

	(void)state;
	for (size_t len = 0; len < sizeof(text); len = len * 3 + 1) {
		const size_t head = len < 128 ? 2 : len < 16384 ? 3 : 4;
		size_t begun;

		b.len = 0;
		begun = protobuf_begin(&b, 1);
		buffer_append(&b, text, len);
		protobuf_end(&b, begun);
		assert_int_equal(b.len, head + len);
		assert_memory_equal(b.data + head, text, len);
	}
	b.len = 0;
	protobuf_uint(&b, 16, 300);
	protobuf_double(&b, 1, -2);
	protobuf_fixed32(&b, 2, 258);
	protobuf_string(&b, 3, "ab");
	protobuf_varint(&b, UINT64_MAX);
	expect_bytes(&b, "8001ac02"
	                 "0900000000000000c0"
	                 "1502010000"
	                 "1a026162"
	                 "ffffffffffffffffff01");
	buffer_finish(&b);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(an_entity_has_its_golden_text),
	    cmocka_unit_test(an_entity_has_its_golden_bytes),
	    cmocka_unit_test(deletions_have_their_golden_bytes),
	    cmocka_unit_test(classes_come_apart_and_nothing_is_lost),
	    cmocka_unit_test(an_update_is_deletions_then_entities),
	    cmocka_unit_test(positions_are_right_to_a_twentieth_of_a_millimetre),
	    cmocka_unit_test(lengths_and_numbers_take_the_bytes_they_need),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

/* Law: every byte of the native protocol is as interfaces 4 says, for ever; nothing that is no message passes as one.
 */
#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "core/native.h"

static void expect_bytes(struct buffer *b, const char *hex)
{
	char text[1024];

	assert_int_equal(b->error, 0);
	assert_true(b->len * 2 < sizeof(text));
	for (size_t i = 0; i < b->len; i++)
		snprintf(text + 2 * i, 3, "%02x", b->data[i]);
	text[b->len * 2] = 0;
	assert_string_equal(text, hex);
	b->len = 0;
}

/* A tetrahedron in two runs. */
static struct patch *tetrahedron(struct patch_key key, uint64_t version, uint16_t size)
{
	uint16_t vertex[4][3] = {{0, 0, 0}, {size, 0, 0}, {0, size, 0}, {0, 0, 4096}};
	uint32_t triangle[4][3] = {{0, 2, 1}, {0, 1, 3}, {0, 3, 2}, {1, 2, 3}};
	uint32_t plane[4] = {7, 7, 7, 7};
	struct surface surface = {.nv = 4, .nt = 4, .vertex = vertex, .triangle = triangle, .plane = plane};
	struct patch *patch = patch_create(key, &surface);

	assert_non_null(patch);
	patch->version = version;
	patch->t_first_ns = 1;
	patch->t_last_ns = 2;
	return patch;
}

static void every_message_has_its_golden_bytes(void **state)
{
	struct buffer b = {0};
	struct native_hello hello = {.major = 1, .minor = 2, .generation = 3, .cell_m = 0.05, .step = 258, .t_ns = -1};
	struct native_want want = {.flags = 5, .bytes_per_s = 1000, .region = {1, -1, 0, 0, 0, 2}};
	struct native_begin begin = {0x0102030405060708, 9, 10, true};
	struct patch *patch = tetrahedron((struct patch_key){-1, 2, 3}, 77, 256);

	(void)state;
	for (int i = 0; i < 16; i++)
		hello.map_id[i] = (uint8_t)(0xa0 + i);
	native_put_hello(&b, &hello);
	expect_bytes(&b, "34000000"
	                 "01000000"
	                 "01000200"
	                 "a0a1a2a3a4a5a6a7a8a9aaabacadaeaf"
	                 "03000000"
	                 "9a9999999999a93f"
	                 "0201000000000000"
	                 "ffffffffffffffff");
	native_put_want(&b, &want);
	expect_bytes(&b, "24000000"
	                 "02000000"
	                 "05000000"
	                 "e8030000"
	                 "0000803f000080bf000000000000000000000000"
	                 "00000040");
	native_put_begin(&b, &begin);
	expect_bytes(&b, "15000000"
	                 "03000000"
	                 "0807060504030201"
	                 "09000000"
	                 "0a000000"
	                 "01");
	patch->run[0].plane = 7;
	patch->run[0].class = 3;
	native_put_patch(&b, patch);
	expect_bytes(&b, "59000000"
	                 "04000000"
	                 "ffffffff0200000003000000"
	                 "4d00000000000000"
	                 "0100000000000000"
	                 "0200000000000000"
	                 "040004000100"
	                 "000000000000"
	                 "000100000000"
	                 "000000010000"
	                 "000000000010"
	                 "07000000030400"
	                 "000201"
	                 "000103"
	                 "000302"
	                 "010203");
	native_put_remove(&b, (struct patch_key){1, -2, 3});
	expect_bytes(&b, "10000000"
	                 "05000000"
	                 "01000000feffffff03000000");
	native_put_step(&b, NATIVE_COMMIT, 258);
	expect_bytes(&b, "0c000000"
	                 "08000000"
	                 "0201000000000000");
	native_put_step(&b, NATIVE_ABORT, 258);
	expect_bytes(&b, "0c000000"
	                 "09000000"
	                 "0201000000000000");
	native_put_json(&b, "{}", 2);
	expect_bytes(&b, "06000000"
	                 "0a000000"
	                 "7b7d");
	native_put_ping(&b);
	expect_bytes(&b, "04000000"
	                 "0b000000");
	patch_unref(patch);
	buffer_finish(&b);
}

static void no_frame_begins_like_text(void **state)
{
	char text[300];

	(void)state;
	memset(text, 'x', sizeof(text));
	for (size_t len = 0; len < sizeof(text); len++) {
		struct buffer b = {0};
		struct native_message message;
		char error[128];

		native_put_json(&b, text, len);
		assert_int_not_equal(b.data[0], '?');
		assert_int_not_equal(b.data[0], '{');
		assert_int_equal(native_decode(b.data, b.len, &message, error), 0);
		assert_memory_equal(message.json.text, text, len);
		buffer_finish(&b);
	}
}

static struct native_message decoded(struct buffer *b)
{
	struct native_message message;
	char error[128] = "";

	assert_int_equal(native_scan(b->data, b->len, NATIVE_TO_CLIENT_MAX), (int)b->len);
	if (native_decode(b->data, b->len, &message, error) != 0)
		fail_msg("%s", error);
	b->len = 0;
	return message;
}

static void what_is_put_is_what_is_decoded(void **state)
{
	struct buffer b = {0};
	struct native_hello hello = {.major = 1, .generation = 9, .cell_m = 0.1, .step = 5, .t_ns = 6};
	struct native_message message;
	struct patch *patch = tetrahedron((struct patch_key){-3, 0, 70000}, 12, 4096);

	(void)state;
	native_put_hello(&b, &hello);
	message = decoded(&b);
	assert_int_equal(message.type, NATIVE_HELLO);
	assert_memory_equal(&message.hello, &hello, sizeof(hello));
	native_put_patch(&b, patch);
	message = decoded(&b);
	assert_int_equal(message.type, NATIVE_PATCH);
	assert_true(patch_equal(patch, message.patch));
	assert_int_equal(message.patch->key.z, 70000);
	assert_int_equal(message.patch->version, 12);
	native_message_finish(&message);
	native_put_remove(&b, (struct patch_key){1, -2, 3});
	message = decoded(&b);
	assert_int_equal(message.remove.y, -2);
	native_put_step(&b, NATIVE_COMMIT, 1ull << 40);
	message = decoded(&b);
	assert_true(message.type == NATIVE_COMMIT && message.step == 1ull << 40);
	native_put_begin(&b, &(struct native_begin){4, 5, 6, false});
	message = decoded(&b);
	assert_true(message.begin.step == 4 && message.begin.patches == 5 && message.begin.removals == 6);
	assert_false(message.begin.reset);
	patch_unref(patch);
	buffer_finish(&b);
}

/* 300 vertices: indices take two bytes. */
static void wide_patches_carry_wide_indices(void **state)
{
	static uint16_t vertex[300][3];
	static uint32_t triangle[600][3];
	struct surface surface = {.nv = 300, .nt = 600, .vertex = vertex, .triangle = triangle};
	struct buffer b = {0};
	struct native_message message;
	struct patch *patch;

	(void)state;
	for (uint32_t i = 0; i < 300; i++) {
		vertex[i][0] = (uint16_t)i;
		vertex[i][1] = (uint16_t)(i * i % 4097);
	}
	for (uint32_t i = 0; i < 600; i++) {
		triangle[i][0] = i % 298;
		triangle[i][1] = i % 298 + 1;
		triangle[i][2] = i % 298 + 2;
	}
	patch = patch_create((struct patch_key){0, 0, 0}, &surface);
	native_put_patch(&b, patch);
	assert_int_equal(b.len, NATIVE_HEAD + 42 + 300 * 6 + 7 * patch->nruns + 600 * 6);
	message = decoded(&b);
	assert_true(patch_equal(patch, message.patch));
	native_message_finish(&message);
	patch_unref(patch);
	buffer_finish(&b);
}

static void every_shorter_buffer_is_no_message(void **state)
{
	struct buffer b = {0};
	struct native_message message;
	char error[128];
	struct patch *patch = tetrahedron((struct patch_key){0, 0, 0}, 1, 1);

	(void)state;
	native_put_patch(&b, patch);
	for (size_t len = 0; len < b.len; len++) {
		/* A copy of exactly this size, so that a sanitizer sees any read beyond. */
		uint8_t *cut = malloc(len ? len : 1);

		memcpy(cut, b.data, len);
		assert_int_equal(native_scan(cut, len, NATIVE_TO_CLIENT_MAX), 0);
		assert_int_equal(native_decode(cut, len, &message, error), -EPROTO);
		if (len >= NATIVE_HEAD) { /* the length says what there is: now the counts must object */
			uint32_t length = (uint32_t)len - 4;

			memcpy(cut, &length, 4);
			assert_int_equal(native_decode(cut, len, &message, error), -EPROTO);
		}
		free(cut);
	}
	patch_unref(patch);
	buffer_finish(&b);
}

static void no_patch_with_impossible_contents_is_decoded(void **state)
{
	struct buffer b = {0};
	struct native_message message;
	char error[128];
	struct patch *patch = tetrahedron((struct patch_key){0, 0, 0}, 1, 1);
	static const struct {
		size_t at;
		uint8_t value;
		const char *why;
	} damage[] = {
	    {NATIVE_HEAD + 3, 0x7f, "key beyond the map"},  {NATIVE_HEAD + 36, 5, "count of vertices"},
	    {NATIVE_HEAD + 38, 0, "no triangles"},          {NATIVE_HEAD + 40, 2, "count of runs"},
	    {NATIVE_HEAD + 42 + 1, 0x11, "vertex outside"}, {NATIVE_HEAD + 42 + 24 + 5, 3, "runs do not add up"},
	    {NATIVE_HEAD + 42 + 24 + 7, 4, "index beyond"}, {NATIVE_HEAD + 42 + 24 + 7 + 1, 0, "vertex twice"},
	};

	(void)state;
	native_put_patch(&b, patch);
	for (size_t i = 0; i < sizeof(damage) / sizeof(damage[0]); i++) {
		uint8_t before = b.data[damage[i].at];

		b.data[damage[i].at] = damage[i].value;
		if (native_decode(b.data, b.len, &message, error) != -EPROTO)
			fail_msg("accepted: %s", damage[i].why);
		assert_true(strlen(error) > 0);
		b.data[damage[i].at] = before;
	}
	assert_int_equal(native_decode(b.data, b.len, &message, error), 0);
	native_message_finish(&message);
	patch_unref(patch);
	buffer_finish(&b);
}

static void a_length_is_judged_before_it_is_waited_for(void **state)
{
	uint8_t bytes[8] = {0};
	uint32_t length = NATIVE_FROM_CLIENT_MAX - 4;

	(void)state;
	memcpy(bytes, &length, 4);
	assert_int_equal(native_scan(bytes, 4, NATIVE_FROM_CLIENT_MAX), 0);
	length++;
	memcpy(bytes, &length, 4);
	assert_int_equal(native_scan(bytes, 4, NATIVE_FROM_CLIENT_MAX), -EPROTO);
	length = 3;
	memcpy(bytes, &length, 4);
	assert_int_equal(native_scan(bytes, 4, NATIVE_FROM_CLIENT_MAX), -EPROTO);
	length = 4;
	memcpy(bytes, &length, 4);
	bytes[6] = 1;
	assert_int_equal(native_scan(bytes, 8, NATIVE_FROM_CLIENT_MAX), -EPROTO);
	bytes[6] = 0;
	bytes[5] = 2;
	assert_int_equal(native_scan(bytes, 8, NATIVE_FROM_CLIENT_MAX), -EPROTO);
}

static void an_unknown_type_may_be_skipped(void **state)
{
	uint8_t bytes[8] = {4, 0, 0, 0, 99, 0, 0, 0};
	struct native_message message;
	char error[128];

	(void)state;
	assert_int_equal(native_scan(bytes, 8, NATIVE_TO_CLIENT_MAX), 8);
	assert_int_equal(native_decode(bytes, 8, &message, error), -ENOTSUP);
	bytes[4] = NATIVE_PING;
	bytes[5] = 1; /* compressed */
	assert_int_equal(native_decode(bytes, 8, &message, error), -ENOTSUP);
}

/* Feeds whole frames into a mirror; the last answer. */
static int feed(struct native_mirror *mirror, struct buffer *b)
{
	size_t at = 0;
	int r = 0;

	while (at < b->len && r >= 0) {
		ssize_t n = native_scan(b->data + at, b->len - at, NATIVE_TO_CLIENT_MAX);
		struct native_message message;
		char error[128];

		assert_true(n > 0);
		assert_int_equal(native_decode(b->data + at, (size_t)n, &message, error), 0);
		r = native_mirror_apply(mirror, &message, error);
		at += (size_t)n;
	}
	b->len = 0;
	return r;
}

static void put_tetrahedron(struct buffer *b, int32_t x, uint64_t version)
{
	struct patch *patch = tetrahedron((struct patch_key){x, 0, 0}, version, (uint16_t)version);

	native_put_patch(b, patch);
	patch_unref(patch);
}

static void a_mirror_changes_by_whole_batches_only(void **state)
{
	struct native_mirror *mirror = native_mirror_create();
	struct native_hello hello = {.major = 1, .cell_m = 0.05};
	struct buffer b = {0};

	(void)state;
	assert_null(native_mirror_hello(mirror));
	native_put_hello(&b, &hello);
	native_put_begin(&b, &(struct native_begin){5, 2, 0, true});
	put_tetrahedron(&b, 1, 4);
	put_tetrahedron(&b, 2, 5);
	assert_int_equal(feed(mirror, &b), 0);
	assert_int_equal(patch_store_count(native_mirror_patches(mirror)), 0);
	native_put_step(&b, NATIVE_COMMIT, 5);
	assert_int_equal(feed(mirror, &b), 1);
	assert_int_equal(patch_store_count(native_mirror_patches(mirror)), 2);
	assert_int_equal(native_mirror_step(mirror), 5);

	native_put_begin(&b, &(struct native_begin){7, 1, 1, false});
	put_tetrahedron(&b, 3, 7);
	native_put_step(&b, NATIVE_ABORT, 7);
	assert_int_equal(feed(mirror, &b), 0);
	assert_int_equal(native_mirror_step(mirror), 5);

	native_put_begin(&b, &(struct native_begin){8, 0, 1, false});
	native_put_remove(&b, (struct patch_key){1, 0, 0});
	native_put_step(&b, NATIVE_COMMIT, 8);
	assert_int_equal(feed(mirror, &b), 1);
	assert_int_equal(patch_store_count(native_mirror_patches(mirror)), 1);

	native_put_begin(&b, &(struct native_begin){2, 0, 0, true});
	native_put_step(&b, NATIVE_COMMIT, 2);
	assert_int_equal(feed(mirror, &b), 1);
	assert_int_equal(patch_store_count(native_mirror_patches(mirror)), 0);
	assert_int_equal(native_mirror_step(mirror), 2);
	native_mirror_destroy(mirror);
	buffer_finish(&b);
}

static void a_mirror_refuses_a_batch_that_does_not_add_up(void **state)
{
	struct native_hello hello = {.major = 1, .cell_m = 0.05};

	(void)state;
	for (int fault = 0; fault < 8; fault++) {
		struct native_mirror *mirror = native_mirror_create();
		struct buffer b = {0};

		if (fault != 0)
			native_put_hello(&b, &hello);
		native_put_begin(&b, &(struct native_begin){5, fault == 1 ? 2 : 1, fault == 2, true});
		if (fault == 3)
			native_put_begin(&b, &(struct native_begin){5, 1, 0, true});
		put_tetrahedron(&b, 1, fault == 4 ? 6 : 4);
		if (fault == 5)
			put_tetrahedron(&b, 2, 4);
		if (fault == 6)
			native_put_remove(&b, (struct patch_key){1, 0, 0});
		native_put_step(&b, NATIVE_COMMIT, fault == 7 ? 4 : 5);
		assert_int_equal(feed(mirror, &b), -EPROTO);
		assert_int_equal(patch_store_count(native_mirror_patches(mirror)), 0);
		native_mirror_destroy(mirror);
		buffer_finish(&b);
	}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(every_message_has_its_golden_bytes),
	    cmocka_unit_test(no_frame_begins_like_text),
	    cmocka_unit_test(what_is_put_is_what_is_decoded),
	    cmocka_unit_test(wide_patches_carry_wide_indices),
	    cmocka_unit_test(every_shorter_buffer_is_no_message),
	    cmocka_unit_test(no_patch_with_impossible_contents_is_decoded),
	    cmocka_unit_test(a_length_is_judged_before_it_is_waited_for),
	    cmocka_unit_test(an_unknown_type_may_be_skipped),
	    cmocka_unit_test(a_mirror_changes_by_whole_batches_only),
	    cmocka_unit_test(a_mirror_refuses_a_batch_that_does_not_add_up),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

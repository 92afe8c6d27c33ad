/* The protocol does not drift: every message with a fixed content is, byte for byte, what it was when version 1 was made,
 * and what was written then is still read. The bytes follow docs/protocol.md; to change one is to break clients. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "core/coded.h"
#include "core/native.h"

/* Two planes and a loose triangle over a unit square, as a small patch holds them. */
static struct patch *make_patch(uint32_t nv)
{
	static const uint32_t triangle[3][3] = {{0, 1, 2}, {0, 2, 3}, {1, 4, 2}};
	struct patch *patch = patch_allocate((struct patch_key){-2, 3, 0}, nv, 3, 2);

	assert_non_null(patch);
	patch->version = 812;
	patch->t_first_ns = 1764000000000000001;
	patch->t_last_ns = 1764000000250000002;
	for (uint32_t i = 0; i < nv; i++) {
		patch->vertex[i][0] = (uint16_t)(i * 16 % 4097);
		patch->vertex[i][1] = (uint16_t)(4096 - i % 7);
		patch->vertex[i][2] = (uint16_t)(128 + i % 3);
	}
	memcpy(patch->triangle, triangle, sizeof(triangle));
	patch->run[0] = (struct patch_run){.plane = 7, .class = 1, .triangles = 2};
	patch->run[1] = (struct patch_run){.plane = PLANE_NONE, .class = 0, .triangles = 1};
	return patch;
}

static void put_hello(struct buffer *b)
{
	const struct native_hello hello = {.major = 1,
	                                   .minor = 1,
	                                   .map_id = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 255},
	                                   .generation = 3,
	                                   .cell_m = 0.05,
	                                   .step = 5312,
	                                   .t_ns = 1764000000250000000};

	native_put_hello(b, &hello);
}

static void put_want_box(struct buffer *b)
{
	const struct native_want want = {.flags = NATIVE_WANT_PLANES | NATIVE_WANT_CODED | NATIVE_WANT_BOX,
	                                 .bytes_per_s = 100000,
	                                 .region = {-1, -2, -3.5f, 4, 5, 6}};

	native_put_want(b, &want);
}

static void put_want_radius(struct buffer *b)
{
	const struct native_want want = {.flags = NATIVE_WANT_RADIUS | NATIVE_WANT_ZSTD, .region = {12.5f}};

	native_put_want(b, &want);
}

static void put_begin(struct buffer *b)
{
	const struct native_begin begin = {.step = 812, .patches = 66, .removals = 2, .reset = true};

	native_put_begin(b, &begin);
}

static void put_small_patch(struct buffer *b)
{
	struct patch *patch = make_patch(5);

	native_put_patch(b, patch);
	patch_unref(patch);
}

static void put_coded(struct buffer *b)
{
	struct patch *patch = make_patch(5);
	struct buffer coded = {0};

	coded_put_patch(&coded, patch);
	coded_put_patch(&coded, patch);
	native_put_coded(b, coded.data, coded.len);
	buffer_finish(&coded);
	patch_unref(patch);
}

static void put_remove(struct buffer *b)
{
	native_put_remove(b, (struct patch_key){-2, 3, 0});
}

static void put_plane(struct buffer *b)
{
	const struct native_plane plane = {.id = 9,
	                                   .normal = {0, -1, 0},
	                                   .distance_m = 2.25,
	                                   .class = 3,
	                                   .area_m2 = 12.5f,
	                                   .covariance = {1, 2, 3, 4, 5, 6},
	                                   .t_ns = 1764000000250000000};

	native_put_plane(b, &plane);
}

static void put_plane_gone(struct buffer *b)
{
	native_put_plane_gone(b, 9);
}

static void put_commit(struct buffer *b)
{
	native_put_step(b, NATIVE_COMMIT, 812);
}

static void put_abort(struct buffer *b)
{
	native_put_step(b, NATIVE_ABORT, 812);
}

static void put_json(struct buffer *b)
{
	native_put_json(b, "{\"class\":\"VERSION\"}", 19);
}

/* 59 bytes would give a length whose low byte is `?`. */
static void put_padded_json(struct buffer *b)
{
	native_put_json(b, "{\"class\":\"NOTICE\",\"message\":\"0123456789012345678901234567\"}", 59);
}

static void put_ping(struct buffer *b)
{
	native_put_ping(b);
}

static const struct {
	const char *name;
	enum native_type type;
	void (*put)(struct buffer *);
	const char *hex;
} golden[] = {
#include "tests/golden_messages.h"
};

#define MESSAGES (sizeof(golden) / sizeof(*golden))

static void to_hex(const uint8_t *bytes, size_t n, char *ret)
{
	for (size_t i = 0; i < n; i++)
		sprintf(ret + 2 * i, "%02x", bytes[i]);
}

static size_t from_hex(const char *hex, uint8_t *ret)
{
	size_t n = strlen(hex) / 2;

	for (size_t i = 0; i < n; i++) {
		unsigned byte = 0;

		assert_int_equal(sscanf(hex + 2 * i, "%2x", &byte), 1);
		ret[i] = (uint8_t)byte;
	}
	return n;
}

static void every_message_is_written_as_it_was(void **state)
{
	(void)state;
	for (size_t i = 0; i < MESSAGES; i++) {
		struct buffer b = {0};
		static char hex[8192];

		golden[i].put(&b);
		assert_int_equal(b.error, 0);
		to_hex(b.data, b.len, hex);
		if (strcmp(hex, golden[i].hex) != 0)
			fail_msg("%s is now %s", golden[i].name, hex);
		buffer_finish(&b);
	}
}

static void every_message_is_read_as_it_was(void **state)
{
	uint32_t seen = 0;

	(void)state;
	for (size_t i = 0; i < MESSAGES; i++) {
		static uint8_t bytes[4096];
		size_t n = from_hex(golden[i].hex, bytes);
		struct native_message message;
		char error[128];

		assert_int_equal(native_scan(bytes, n, NATIVE_TO_CLIENT_MAX), n);
		assert_int_equal(native_decode(bytes, n, &message, error), 0);
		assert_int_equal(message.type, golden[i].type);
		seen |= 1u << message.type;
		native_message_finish(&message);
		for (size_t shorter = 0; shorter < n; shorter++)
			assert_true(native_decode(bytes, shorter, &message, error) < 0);
	}
	for (int type = NATIVE_HELLO; type <= NATIVE_CODED; type++)
		if (!(seen & 1u << type))
			fail_msg("no golden bytes of message %d", type);
}

static void made_up_planes_come_back_as_they_were(void **state)
{
	static uint8_t bytes[4096];
	struct native_message message;
	struct buffer b = {0};
	char error[128];

	(void)state;
	put_plane(&b);
	assert_int_equal(native_decode(b.data, b.len, &message, error), 0);
	assert_true(message.plane.id == 9 && message.plane.normal[1] == -1 && message.plane.distance_m == 2.25 &&
	            message.plane.class == 3 && message.plane.area_m2 == 12.5f && message.plane.covariance[5] == 6 &&
	            message.plane.t_ns == 1764000000250000000);
	memcpy(bytes, b.data, b.len);
	memset(bytes + NATIVE_HEAD + 4, 0xff, 4); /* a normal that is no number */
	assert_int_equal(native_decode(bytes, b.len, &message, error), -71 /* EPROTO */);
	buffer_finish(&b);
	put_plane_gone(&b);
	assert_int_equal(native_decode(b.data, b.len, &message, error), 0);
	assert_int_equal(message.plane_gone, 9);
	buffer_finish(&b);
}

/* zstd's bytes are its version's; what was compressed once is read for ever. */
static void what_was_compressed_once_is_still_read(void **state)
{
	static const char packed[] =
#include "tests/golden_packed.h"
	    ;
	static uint8_t bytes[4096];
	size_t n = from_hex(packed, bytes);
	struct buffer plain = {0}, truth = {0};
	struct patch *patch = make_patch(64);
	char error[128];

	(void)state;
	native_put_patch(&truth, patch);
	assert_true(native_is_packed(bytes) && n < truth.len);
	assert_int_equal(native_unpack(bytes, n, NATIVE_TO_CLIENT_MAX, &plain, error), 0);
	assert_int_equal(plain.len, truth.len);
	assert_memory_equal(plain.data, truth.data, truth.len);
	buffer_finish(&plain);
	buffer_finish(&truth);
	patch_unref(patch);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(every_message_is_written_as_it_was),
	    cmocka_unit_test(every_message_is_read_as_it_was),
	    cmocka_unit_test(made_up_planes_come_back_as_they_were),
	    cmocka_unit_test(what_was_compressed_once_is_still_read),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

/* What tests of the publisher share: a map of made-up patches with its whole history, and clients that read the native
 * stream in any pieces and know, from the history, what they must hold at every COMMIT. */
#ifndef FACET_TESTS_PUBLISHER_BED_H
#define FACET_TESTS_PUBLISHER_BED_H

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "core/coded.h"
#include "daemon/interest.h"
#include "daemon/publisher.h"

#define KEYS    120
#define STEPS   200
#define CELL_M  0.05
#define PATCH_M (CELL_M * 16)

static uint64_t random_state;

static inline uint32_t pick(uint32_t n) /* 0 .. n - 1; xorshift */
{
	random_state ^= random_state << 13;
	random_state ^= random_state >> 7;
	random_state ^= random_state << 17;
	return (uint32_t)(random_state >> 33) % n;
}

/* The patch of a key with a content: its size and its integers follow from both. */
static inline struct patch *make_patch(uint32_t key, uint32_t content, uint64_t version, uint32_t side)
{
	static uint16_t vertex[512][3];
	static uint32_t triangle[512][3];
	struct surface surface = {.vertex = vertex, .triangle = triangle};
	struct patch *patch;

	if (content > 0) {
		surface.nv = 3 + content % side;
		surface.nt = surface.nv - 2;
	}
	for (uint32_t i = 0; i < surface.nv; i++) {
		vertex[i][0] = (uint16_t)(content % 4097);
		vertex[i][1] = (uint16_t)i;
		vertex[i][2] = (uint16_t)key;
	}
	for (uint32_t i = 0; i < surface.nt; i++) {
		triangle[i][0] = i;
		triangle[i][1] = i + 1;
		triangle[i][2] = i + 2;
	}
	patch = patch_create((struct patch_key){(int32_t)key - KEYS / 2, 0, 7}, &surface);
	assert_non_null(patch);
	patch->version = version;
	return patch;
}

/* The truth: what each key holds after each step (0: nothing) and when it came to hold it. */
struct history {
	uint32_t content[STEPS + 1][KEYS];
	uint64_t version[STEPS + 1][KEYS];
	uint64_t step;
	uint32_t side;
};

static inline void advance_history(struct history *h, struct publisher *p, uint32_t changes)
{
	struct patch *patch[KEYS];
	uint32_t raw[KEYS];
	size_t n = 0;

	h->step++;
	memcpy(h->content[h->step], h->content[h->step - 1], sizeof(h->content[0]));
	memcpy(h->version[h->step], h->version[h->step - 1], sizeof(h->version[0]));
	for (uint32_t key = 0; key < KEYS; key++) {
		if (pick(KEYS) >= changes)
			continue;
		h->content[h->step][key] = pick(4) == 0 ? 0 : 1 + pick(4000);
		h->version[h->step][key] = h->step;
		raw[n] = 100;
		patch[n++] = make_patch(key, h->content[h->step][key], h->step, h->side);
	}
	assert_int_equal(publisher_publish(p, h->step, patch, raw, n), 0);
	while (n > 0)
		patch_unref(patch[--n]);
}

/* `held` is what make_patch makes, without making it. */
static inline bool is_content(const struct patch *held, uint32_t key, uint32_t content, uint32_t side)
{
	uint32_t nv = 3 + content % side;
	bool same = held->nv == nv && held->nt == nv - 2 && held->nruns == 1;

	for (uint32_t i = 0; i < nv && same; i++)
		same = held->vertex[i][0] == content % 4097 && held->vertex[i][1] == i && held->vertex[i][2] == key;
	for (uint32_t i = 0; same && i < nv - 2; i++)
		same = held->triangle[i][0] == i && held->triangle[i][1] == i + 1 && held->triangle[i][2] == i + 2;
	return same;
}

/* What `mirror` holds is what of the map of its step lies in the region, and nothing else. */
static inline bool is_mirror_of(const struct history *h, const struct native_mirror *mirror,
                                const struct interest *region)
{
	uint64_t step = native_mirror_step(mirror);
	bool same = step <= h->step;

	for (uint32_t i = 0; i < KEYS && same; i++) {
		struct patch_key key = {(int32_t)i - KEYS / 2, 0, 7};
		const struct patch *held = patch_store_get(native_mirror_patches(mirror), key);
		uint32_t content = h->content[step][i];

		if (content == 0 || !interest_has(region, key))
			same = !held || held->nt == 0;
		else
			same = held && held->nt > 0 && is_content(held, i, content, h->side) &&
			       held->version == h->version[step][i];
	}
	return same;
}

/* A client's end of the wire: bytes come in as they were written, in any pieces. What it wants may change under way, and
 * the robot moves: a batch holds to what was wanted when it began, which is one of the regions since the last COMMIT. */
#define REGIONS_MAX 4096
struct reader {
	struct publisher_client *client;
	struct native_mirror *mirror;
	struct buffer in, plain;
	struct native_want want;
	struct interest *region; /* [REGIONS_MAX] as they came */
	size_t regions, regions_at;
	unsigned commits, aborts, hellos, jsons, pings, coded, packed;
	size_t most_bytes;
};

/* The reader may be sent this from now on. */
static inline void reader_wants(struct reader *reader, struct patch_key robot)
{
	struct interest region;

	assert_int_equal(interest_of(&reader->want, CELL_M, robot, &region), 0);
	if (reader->regions > 0 && interest_equal(&region, &reader->region[reader->regions - 1]))
		return;
	assert_true(reader->regions < REGIONS_MAX);
	reader->region[reader->regions++] = region;
}

static inline void reader_join(struct reader *reader, struct publisher *p, const struct native_want *want,
                               struct patch_key robot)
{
	memset(reader, 0, sizeof(*reader));
	reader->want = *want;
	reader->region = calloc(REGIONS_MAX, sizeof(*reader->region));
	reader->client = publisher_join(p, want);
	reader->mirror = native_mirror_create();
	assert_true(reader->client && reader->mirror && reader->region);
	reader_wants(reader, robot);
}

static inline void reader_open(struct reader *reader, struct publisher *p)
{
	struct native_want want = {0};

	reader_join(reader, p, &want, (struct patch_key){0});
}

static inline void reader_close(struct reader *reader)
{
	if (reader->client)
		publisher_leave(reader->client);
	native_mirror_destroy(reader->mirror);
	buffer_finish(&reader->in);
	buffer_finish(&reader->plain);
	free(reader->region);
	memset(reader, 0, sizeof(*reader));
}

static inline void expect_commit(struct reader *reader, const struct history *h)
{
	while (!is_mirror_of(h, reader->mirror, &reader->region[reader->regions_at])) {
		reader->regions_at++;
		if (reader->regions_at == reader->regions)
			fail_msg("a mirror at step %llu that holds none of its regions",
			         (unsigned long long)native_mirror_step(reader->mirror));
	}
	reader->commits++;
}

static inline void reader_frame(struct reader *reader, const struct history *h, const uint8_t *frame, size_t len)
{
	struct native_message message;
	char error[128] = "";
	int r;

	if (native_is_packed(frame)) {
		assert_true(reader->want.flags & NATIVE_WANT_ZSTD);
		reader->packed++;
		reader->plain.len = 0;
		assert_int_equal(native_unpack(frame, len, NATIVE_TO_CLIENT_MAX, &reader->plain, error), 0);
		frame = reader->plain.data;
		len = reader->plain.len;
	}
	assert_int_equal(native_decode(frame, len, &message, error), 0);
	reader->aborts += message.type == NATIVE_ABORT;
	reader->hellos += message.type == NATIVE_HELLO;
	reader->jsons += message.type == NATIVE_JSON;
	reader->pings += message.type == NATIVE_PING;
	reader->coded += message.type == NATIVE_CODED;
	r = native_mirror_apply(reader->mirror, &message, error);
	if (r < 0)
		fail_msg("%s", error);
	if (r == 1)
		expect_commit(reader, h);
}

static inline void reader_frames(struct reader *reader, const struct history *h)
{
	size_t at = 0;
	ssize_t n;

	if (reader->in.len == 0)
		return;
	while ((n = native_scan(reader->in.data + at, reader->in.len - at, NATIVE_TO_CLIENT_MAX)) > 0) {
		reader_frame(reader, h, reader->in.data + at, (size_t)n);
		at += (size_t)n;
	}
	assert_int_equal(n, 0);
	memmove(reader->in.data, reader->in.data + at, reader->in.len - at);
	reader->in.len -= at;
}

/* Writes at most `capacity` bytes, in pieces; how many there were. */
static inline size_t reader_pump(struct reader *reader, const struct history *h, size_t capacity)
{
	size_t total = 0, n;
	const uint8_t *bytes;

	while (total < capacity && (n = publisher_peek(reader->client, 0, &bytes)) > 0) {
		if (n > capacity - total)
			n = capacity - total;
		n = 1 + pick((uint32_t)n);
		buffer_append(&reader->in, bytes, n);
		publisher_wrote(reader->client, n, 0);
		total += n;
	}
	reader_frames(reader, h);
	return total;
}

static inline struct publisher *start_with(struct history *h, uint32_t side, size_t pinned_max, size_t window)
{
	struct publisher_params params = {.cell_m = CELL_M, .pinned_max = pinned_max, .window = window};
	struct publisher *p = publisher_create(&params);

	assert_non_null(p);
	memset(h, 0, sizeof(*h));
	h->side = side;
	return p;
}

static inline struct publisher *start(struct history *h, uint32_t side, size_t pinned_max)
{
	return start_with(h, side, pinned_max, 0);
}

static inline void expect_converged(struct reader *reader, const struct history *h)
{
	while (reader_pump(reader, h, SIZE_MAX / 2) > 0)
		;
	assert_int_equal(native_mirror_step(reader->mirror), h->step);
	assert_true(is_mirror_of(h, reader->mirror, &reader->region[reader->regions - 1]));
}

#endif

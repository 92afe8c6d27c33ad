/* Law L6, L4: whatever the pace of its client and whatever happens meanwhile, every mirror at every COMMIT is byte for
 * byte the map of that step, converges to the newest one, and costs bounded memory. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "daemon/publisher.h"

#define KEYS    120
#define STEPS   200
#define CLIENTS 5

static uint64_t random_state;

static uint32_t pick(uint32_t n) /* 0 .. n - 1; xorshift */
{
	random_state ^= random_state << 13;
	random_state ^= random_state >> 7;
	random_state ^= random_state << 17;
	return (uint32_t)(random_state >> 33) % n;
}

/* The patch of a key with a content: its size and its integers follow from both. */
static struct patch *make_patch(uint32_t key, uint32_t content, uint64_t version, uint32_t side)
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

static void advance_history(struct history *h, struct publisher *p, uint32_t changes)
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

static void expect_mirror_of(const struct history *h, const struct native_mirror *mirror)
{
	uint64_t step = native_mirror_step(mirror);

	assert_true(step <= h->step);
	for (uint32_t key = 0; key < KEYS; key++) {
		struct patch *truth = make_patch(key, h->content[step][key], h->version[step][key], h->side);
		struct patch *held = patch_store_get(native_mirror_patches(mirror), truth->key);

		if (truth->nt == 0) {
			assert_true(!held || held->nt == 0);
		} else {
			assert_non_null(held);
			assert_true(patch_equal(truth, held));
			assert_int_equal(truth->version, held->version);
		}
		patch_unref(truth);
	}
}

/* A client's end of the wire: bytes come in as they were written, in any pieces. */
struct reader {
	struct publisher_client *client;
	struct native_mirror *mirror;
	struct buffer in;
	unsigned commits, aborts, hellos, jsons, pings;
	size_t most_held;
};

static void reader_open(struct reader *reader, struct publisher *p)
{
	struct native_want want = {0};

	memset(reader, 0, sizeof(*reader));
	reader->client = publisher_join(p, &want);
	reader->mirror = native_mirror_create();
	assert_non_null(reader->client);
}

static void reader_close(struct reader *reader)
{
	if (reader->client)
		publisher_leave(reader->client);
	native_mirror_destroy(reader->mirror);
	buffer_finish(&reader->in);
	memset(reader, 0, sizeof(*reader));
}

static void reader_frames(struct reader *reader, const struct history *h)
{
	size_t at = 0;
	ssize_t n;

	if (reader->in.len == 0)
		return;
	while ((n = native_scan(reader->in.data + at, reader->in.len - at, NATIVE_TO_CLIENT_MAX)) > 0) {
		struct native_message message;
		char error[128] = "";
		int r;

		assert_int_equal(native_decode(reader->in.data + at, (size_t)n, &message, error), 0);
		reader->aborts += message.type == NATIVE_ABORT;
		reader->hellos += message.type == NATIVE_HELLO;
		reader->jsons += message.type == NATIVE_JSON;
		reader->pings += message.type == NATIVE_PING;
		r = native_mirror_apply(reader->mirror, &message, error);
		if (r < 0)
			fail_msg("%s", error);
		if (r == 1) {
			reader->commits++;
			expect_mirror_of(h, reader->mirror);
		}
		at += (size_t)n;
	}
	assert_int_equal(n, 0);
	memmove(reader->in.data, reader->in.data + at, reader->in.len - at);
	reader->in.len -= at;
}

/* Writes at most `capacity` bytes, in pieces; how many there were. */
static size_t reader_pump(struct reader *reader, const struct history *h, size_t capacity)
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

static struct publisher *start(struct history *h, uint32_t side, size_t pinned_max)
{
	struct publisher_params params = {.cell_m = 0.05, .pinned_max = pinned_max};
	struct publisher *p = publisher_create(&params);

	assert_non_null(p);
	memset(h, 0, sizeof(*h));
	h->side = side;
	return p;
}

static void expect_converged(struct reader *reader, const struct history *h)
{
	while (reader_pump(reader, h, SIZE_MAX / 2) > 0)
		;
	assert_int_equal(native_mirror_step(reader->mirror), h->step);
	expect_mirror_of(h, reader->mirror);
}

/* One random history: clients of any pace come, go and stall while the map changes. */
static void random_history(uint64_t seed, size_t pinned_max, unsigned *ret_aborts)
{
	static struct history h;
	struct publisher *p = start(&h, 400, pinned_max);
	struct reader reader[CLIENTS];
	uint32_t pace[CLIENTS] = {0}, changes;

	random_state = seed * 0x9e3779b97f4a7c15ull + 1;
	changes = 1 + pick(KEYS / 2);
	memset(reader, 0, sizeof(reader));
	while (h.step < STEPS) {
		advance_history(&h, p, changes);
		for (int i = 0; i < CLIENTS; i++) {
			if (!reader[i].client && pick(10) == 0)
				reader_open(&reader[i], p);
			if (pick(20) == 0)
				pace[i] = pick(3) == 0 ? 0 : 1u << pick(17);
			if (!reader[i].client)
				continue;
			reader_pump(&reader[i], &h, pace[i]);
			*ret_aborts += reader[i].aborts;
			reader[i].aborts = 0;
			if (pick(100) == 0 || publisher_reason(reader[i].client))
				reader_close(&reader[i]);
		}
	}
	for (int i = 0; i < CLIENTS; i++) {
		if (reader[i].client && !publisher_reason(reader[i].client))
			expect_converged(&reader[i], &h);
		if (reader[i].client)
			reader_close(&reader[i]);
	}
	publisher_destroy(p);
}

static void random_histories_converge_and_every_commit_is_the_map_of_its_step(void **state)
{
	unsigned aborts = 0;

	(void)state;
	for (uint64_t seed = 1; seed <= 20; seed++)
		random_history(seed, 0, &aborts);
	assert_int_equal(aborts, 0);
}

static void random_histories_with_little_room_for_pins_converge_too(void **state)
{
	unsigned aborts = 0;

	(void)state;
	for (uint64_t seed = 101; seed <= 120; seed++)
		random_history(seed, 100000, &aborts);
	assert_true(aborts > 20);
}

static void a_late_joiner_gets_the_whole_map_as_one_batch_with_reset(void **state)
{
	static struct history h;
	struct publisher *p = start(&h, 50, 0);
	struct reader reader;
	const uint8_t *bytes;
	size_t n;
	struct native_message message;
	char error[128];

	(void)state;
	random_state = 5;
	while (h.step < 50)
		advance_history(&h, p, 10);
	reader_open(&reader, p);
	n = publisher_peek(reader.client, 77, &bytes);
	assert_true(n > 60);
	assert_int_equal(native_decode(bytes, 52 + 4, &message, error), 0);
	assert_true(message.type == NATIVE_HELLO && message.hello.step == 50 && message.hello.t_ns == 77);
	assert_int_equal(native_decode(bytes + 56, 25, &message, error), 0);
	assert_true(message.type == NATIVE_BEGIN && message.begin.reset && message.begin.removals == 0);
	expect_converged(&reader, &h);
	assert_int_equal(reader.commits, 1);
	assert_int_equal(reader.hellos, 1);
	reader_close(&reader);
	publisher_destroy(p);
}

static void a_stalled_client_costs_bounded_memory_and_skips_to_the_newest_state(void **state)
{
	static struct history h;
	size_t pinned_max = 50000;
	struct publisher *p = start(&h, 400, pinned_max);
	struct reader stalled, quick;
	struct publisher_stats stats;
	struct publisher_client_stats client;

	(void)state;
	random_state = 9;
	advance_history(&h, p, KEYS);
	reader_open(&stalled, p);
	reader_open(&quick, p);
	reader_pump(&stalled, &h, 100);
	while (h.step < STEPS) {
		advance_history(&h, p, 20);
		expect_converged(&quick, &h);
		publisher_stats(p, &stats);
		/* beside the limit: the one frame that is half written */
		assert_true(stats.pinned <= pinned_max + 6000);
	}
	publisher_client_stats(stalled.client, &client);
	assert_int_equal(client.behind_steps, STEPS);
	assert_int_equal(client.aborts, 1);
	assert_true(client.queued < 64 << 10);
	expect_converged(&stalled, &h);
	assert_int_equal(stalled.aborts, 1);
	assert_true(stalled.commits <= 2);
	assert_int_equal(quick.commits, STEPS - 1);
	assert_int_equal(quick.aborts, 0);
	publisher_client_stats(quick.client, &client);
	assert_true(client.behind_peak <= 2); /* the first batch follows the second step */
	reader_close(&stalled);
	reader_close(&quick);
	publisher_stats(p, &stats);
	assert_int_equal(stats.pinned, 0);
	publisher_destroy(p);
}

static void after_three_aborts_running_a_client_is_closed_with_the_reason(void **state)
{
	static struct history h;
	struct publisher *p = start(&h, 400, 20000);
	struct reader reader;

	(void)state;
	random_state = 3;
	advance_history(&h, p, KEYS);
	reader_open(&reader, p);
	while (!publisher_reason(reader.client)) {
		assert_true(h.step < STEPS);
		reader_pump(&reader, &h, 12000); /* enough to begin, never to end */
		advance_history(&h, p, KEYS);
	}
	assert_false(publisher_done(reader.client));
	while (reader_pump(&reader, &h, 1000) > 0)
		;
	assert_true(publisher_done(reader.client));
	assert_int_equal(reader.aborts, 3);
	assert_int_equal(reader.jsons, 1);
	assert_int_equal(reader.commits, 0);
	reader_close(&reader);
	publisher_destroy(p);
}

/* `n` patches of one triangle each, or of none, at a step of their own. */
static void publish_many(struct publisher *p, uint64_t step, uint32_t n, uint32_t content)
{
	static struct patch *patch[4000];

	for (uint32_t i = 0; i < n; i++)
		patch[i] = make_patch(i, content, step, 1);
	assert_int_equal(publisher_publish(p, step, patch, NULL, n), 0);
	while (n > 0)
		patch_unref(patch[--n]);
}

static void write_some(struct publisher_client *client, size_t capacity)
{
	const uint8_t *bytes;
	size_t n;

	while (capacity > 0 && (n = publisher_peek(client, 0, &bytes)) > 0) {
		n = n < capacity ? n : capacity;
		publisher_wrote(client, n, 0);
		capacity -= n;
	}
}

static void a_list_of_pins_is_counted_and_never_longer_than_64_kb(void **state)
{
	static struct history h;
	struct publisher *p = start(&h, 1, 0);
	struct native_want want = {0};
	struct publisher_client *client = publisher_join(p, &want);
	struct publisher_client_stats stats;
	struct publisher_stats all;

	(void)state;
	publish_many(p, 1, 4000, 1);
	for (uint64_t step = 2; step < 8; step += 2) {
		size_t bytes;

		assert_null(publisher_reason(client));
		write_some(client, 40000); /* begins a batch, then stalls */
		publisher_stats(p, &all);
		bytes = all.pinned;
		publish_many(p, step, 2300, 1);
		publisher_client_stats(client, &stats);
		publisher_stats(p, &all);
		assert_int_equal(stats.aborts, step / 2 - 1);
		assert_true(stats.queued < (256 << 10) + PUBLISHER_JSON_MAX);
		assert_true(all.pinned - bytes > 1000 * 2 * sizeof(void *)); /* besides the sheets */
		publish_many(p, step + 1, 4000, 1);
		publisher_client_stats(client, &stats);
		assert_int_equal(stats.aborts, step / 2);
	}
	assert_non_null(publisher_reason(client));
	publisher_leave(client);
	publisher_stats(p, &all);
	assert_int_equal(all.pinned, 0);
	publisher_destroy(p);
}

static void removals_under_a_stalled_client_are_limited_too(void **state)
{
	static struct history h;
	struct publisher *p = start(&h, 1, 20000);
	struct native_want want = {0};
	struct publisher_client *client[3];
	struct publisher_stats all;
	uint64_t aborts = 0;

	(void)state;
	for (int i = 0; i < 3; i++)
		client[i] = publisher_join(p, &want);
	publish_many(p, 1, 2600, 1);
	for (int i = 0; i < 3; i++)
		write_some(client[i], SIZE_MAX);
	publish_many(p, 2, 2600, 0); /* a batch of removals alone: what it pins are no sheets */
	for (int i = 0; i < 3; i++)
		write_some(client[i], 1000);
	publish_many(p, 3, 2600, 1);
	publisher_stats(p, &all);
	assert_true(all.pinned <= 20000);
	for (int i = 0; i < 3; i++) {
		struct publisher_client_stats stats;

		publisher_client_stats(client[i], &stats);
		aborts += stats.aborts;
		publisher_leave(client[i]);
	}
	assert_in_range(aborts, 1, 3);
	publisher_destroy(p);
}

static void after_a_reset_every_client_begins_anew(void **state)
{
	static struct history h, after;
	struct publisher *p = start(&h, 400, 0);
	struct reader idle, busy;
	struct publisher_stats stats;

	(void)state;
	random_state = 3;
	for (int i = 0; i < 10; i++)
		advance_history(&h, p, 20);
	reader_open(&idle, p);
	reader_open(&busy, p);
	expect_converged(&idle, &h);
	reader_pump(&busy, &h, 150); /* within its first batch */
	publisher_reset(p);
	after.side = 400;
	for (int i = 0; i < 3; i++)
		advance_history(&after, p, 20);
	expect_converged(&idle, &after);
	expect_converged(&busy, &after);
	assert_int_equal(idle.hellos, 2);
	assert_int_equal(native_mirror_hello(idle.mirror)->generation, 2);
	assert_int_equal(busy.aborts, 1);
	reader_close(&idle);
	reader_close(&busy);
	publisher_stats(p, &stats);
	assert_int_equal(stats.generation, 2);
	assert_int_equal(stats.pinned, 0);
	publisher_destroy(p);
}

/* One client is in the middle of a frame of the old map, which is copied; the rest goes to its new owner as it is. */
static void a_map_that_ends_is_handed_out_whole(void **state)
{
	static const uint8_t next[16] = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};
	static struct history h;
	struct publisher *p = start(&h, 200, 0);
	struct publisher_stats stats;
	struct publisher_old *old;
	struct reader reader, slow;
	size_t living = 0;

	(void)state;
	reader_open(&reader, p);
	reader_open(&slow, p);
	for (int i = 0; i < 10; i++)
		advance_history(&h, p, 30);
	expect_converged(&reader, &h);
	write_some(slow.client, 3000);
	publisher_stats(p, &stats);
	old = publisher_begin_map(p, next);
	assert_non_null(old);
	for (size_t i = 0; i < publisher_old_count(old); i++) {
		struct native_message message;
		char error[128];
		size_t len;
		const uint8_t *frame = publisher_old_frame(old, i, &len);
		uint32_t key;

		assert_int_equal(native_decode(frame, len, &message, error), 0);
		key = (uint32_t)(message.patch->key.x + KEYS / 2);
		struct patch *truth = make_patch(key, h.content[h.step][key], h.version[h.step][key], h.side);
		assert_true(patch_equal(truth, message.patch));
		patch_unref(truth);
		native_message_finish(&message);
		living++;
	}
	assert_int_equal(living, stats.patches);
	publisher_old_destroy(old);
	publisher_stats(p, &stats);
	assert_int_equal(stats.patches, 0);
	assert_int_equal(stats.bytes, 0);
	assert_int_equal(stats.generation, 2);
	memset(&h, 0, sizeof(h));
	h.side = 200;
	advance_history(&h, p, 30);
	expect_converged(&reader, &h);
	assert_memory_equal(native_mirror_hello(reader.mirror)->map_id, next, 16);
	reader_close(&reader);
	reader_close(&slow);
	publisher_stats(p, &stats);
	assert_int_equal(stats.pinned, 0);
	publisher_destroy(p);
}

static void a_step_without_a_changed_patch_is_committed_too(void **state)
{
	static struct history h;
	struct publisher *p = start(&h, 50, 0);
	struct reader reader;

	(void)state;
	random_state = 3;
	reader_open(&reader, p);
	expect_converged(&reader, &h); /* an empty map */
	advance_history(&h, p, 20);
	expect_converged(&reader, &h);
	advance_history(&h, p, 0);
	expect_converged(&reader, &h);
	assert_int_equal(reader.commits, 3);
	assert_int_equal(reader_pump(&reader, &h, 1000), 0);
	reader_close(&reader);
	publisher_destroy(p);
}

static void the_counts_of_faces_and_patches_follow_the_map(void **state)
{
	static struct history h;
	struct publisher *p = start(&h, 50, 0);
	struct publisher_stats stats;
	uint64_t faces = 0;
	size_t patches = 0;

	(void)state;
	random_state = 11;
	while (h.step < 60)
		advance_history(&h, p, 10);
	for (uint32_t key = 0; key < KEYS; key++)
		if (h.content[h.step][key]) {
			patches++;
			faces += 1 + h.content[h.step][key] % 50;
		}
	publisher_stats(p, &stats);
	assert_int_equal(stats.patches, patches);
	assert_int_equal(stats.faces, faces);
	assert_int_equal(stats.faces_raw, patches * 100);
	publisher_destroy(p);
}

static void messages_come_between_frames_and_are_bounded(void **state)
{
	static struct history h;
	struct publisher *p = start(&h, 50, 0);
	struct reader reader;
	char text[1000];
	unsigned taken = 0;
	struct publisher_client_stats stats;

	(void)state;
	random_state = 3;
	memset(text, ' ', sizeof(text));
	advance_history(&h, p, KEYS);
	reader_open(&reader, p);
	reader_pump(&reader, &h, 100);
	for (int i = 0; i < 1000; i++)
		taken += publisher_json(reader.client, text, sizeof(text));
	assert_in_range(taken, 50, PUBLISHER_JSON_MAX / sizeof(text));
	publisher_ping(reader.client);
	publisher_client_stats(reader.client, &stats);
	assert_int_equal(stats.skipped_json, 1000 - taken);
	expect_converged(&reader, &h);
	assert_int_equal(reader.jsons, taken);
	reader_close(&reader);
	publisher_destroy(p);
}

static void a_client_that_wants_a_rate_gets_no_more(void **state)
{
	static struct history h;
	struct publisher *p = start(&h, 200, 0);
	struct native_want want = {.bytes_per_s = 2000};
	struct publisher_client *client;
	const uint8_t *bytes;
	int64_t t_ns = 1000000000, end_ns = t_ns + 2000000000;
	size_t total = 0, n;

	(void)state;
	random_state = 3;
	advance_history(&h, p, KEYS);
	client = publisher_join(p, &want);
	while (t_ns < end_ns) {
		while ((n = publisher_peek(client, t_ns, &bytes)) > 0) {
			publisher_wrote(client, n, t_ns);
			total += n;
		}
		assert_true(publisher_deadline(client) > t_ns);
		t_ns = publisher_deadline(client);
	}
	assert_in_range(total, 3800, 4600);
	publisher_leave(client);
	publisher_destroy(p);
}

static void nothing_but_the_reason_of_a_refusal_comes_before_hello(void **state)
{
	static struct history h;
	struct publisher *p = start(&h, 50, 0);
	struct native_want want = {.flags = 4, .region = {0, 0, 0, 1, 1, 1}};
	struct publisher_client *client = publisher_join(p, &want), *refused = publisher_join(p, &want);
	struct native_message message;
	const uint8_t *bytes;
	char error[128];
	size_t n;

	(void)state;
	publisher_json(client, "{}", 2);
	publisher_ping(client);
	n = publisher_peek(client, 0, &bytes);
	n = (size_t)native_scan(bytes, n, NATIVE_TO_CLIENT_MAX);
	assert_int_equal(native_decode(bytes, n, &message, error), 0);
	assert_int_equal(message.type, NATIVE_HELLO);
	publisher_leave(client);
	publisher_dismiss(refused, "full");
	n = publisher_peek(refused, 0, &bytes);
	assert_int_equal(native_scan(bytes, n, NATIVE_TO_CLIENT_MAX), n);
	assert_int_equal(native_decode(bytes, n, &message, error), 0);
	assert_int_equal(message.type, NATIVE_JSON);
	native_message_finish(&message);
	publisher_wrote(refused, n, 0);
	assert_true(publisher_done(refused));
	publisher_leave(refused);
	publisher_destroy(p);
}

static void what_is_wanted_and_not_served_is_said(void **state)
{
	static struct history h;
	struct publisher *p = start(&h, 50, 0);
	struct reader reader = {0};
	struct native_want want = {.flags = NATIVE_WANT_CODED};

	(void)state;
	random_state = 3;
	reader.client = publisher_join(p, &want);
	reader.mirror = native_mirror_create();
	expect_converged(&reader, &h);
	assert_int_equal(reader.jsons, 1);
	reader_close(&reader);
	publisher_destroy(p);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(random_histories_converge_and_every_commit_is_the_map_of_its_step),
	    cmocka_unit_test(random_histories_with_little_room_for_pins_converge_too),
	    cmocka_unit_test(a_late_joiner_gets_the_whole_map_as_one_batch_with_reset),
	    cmocka_unit_test(a_stalled_client_costs_bounded_memory_and_skips_to_the_newest_state),
	    cmocka_unit_test(after_three_aborts_running_a_client_is_closed_with_the_reason),
	    cmocka_unit_test(a_list_of_pins_is_counted_and_never_longer_than_64_kb),
	    cmocka_unit_test(removals_under_a_stalled_client_are_limited_too),
	    cmocka_unit_test(after_a_reset_every_client_begins_anew),
	    cmocka_unit_test(a_map_that_ends_is_handed_out_whole),
	    cmocka_unit_test(a_step_without_a_changed_patch_is_committed_too),
	    cmocka_unit_test(the_counts_of_faces_and_patches_follow_the_map),
	    cmocka_unit_test(messages_come_between_frames_and_are_bounded),
	    cmocka_unit_test(a_client_that_wants_a_rate_gets_no_more),
	    cmocka_unit_test(nothing_but_the_reason_of_a_refusal_comes_before_hello),
	    cmocka_unit_test(what_is_wanted_and_not_served_is_said),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

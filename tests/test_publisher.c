/* Law L6, L4: whatever the pace of its client and whatever happens meanwhile, every mirror at every COMMIT is byte for
 * byte the map of that step, converges to the newest one, and costs bounded memory. */
#include "tests/publisher_bed.h"

#define CLIENTS 5

/* What a client may wish for: any form, and any region that patches of the map come into and leave. */
static struct native_want random_want(void)
{
	struct native_want want = {.flags = (uint8_t)(pick(2) * NATIVE_WANT_CODED | pick(2) * NATIVE_WANT_ZSTD)};
	float low = (float)((pick(KEYS) - KEYS / 2.0) * PATCH_M), width = (float)(pick(KEYS) * PATCH_M / 2);
	uint32_t kind = pick(3);

	if (kind == 1) {
		want.flags |= NATIVE_WANT_BOX;
		memcpy(want.region, (float[6]){low, -1, -100, low + width, 1, 100}, sizeof(want.region));
	} else if (kind == 2) {
		want.flags |= NATIVE_WANT_RADIUS;
		want.region[0] = 6 + width;
	}
	return want;
}

/* The robot drives along the row of patches, and back and forth on the border of two. */
static struct patch_key move_robot(struct publisher *p, struct patch_key *robot, double *x_m)
{
	*x_m += pick(3) == 0 ? (pick(41) - 20.0) * 0.1 : (pick(3) - 1.0) * 0.05;
	*x_m = *x_m < -40 ? -40 : *x_m > 40 ? 40 : *x_m;
	publisher_robot(p, *x_m, 0.4, 5.8);
	interest_follow(robot, CELL_M, *x_m, 0.4, 5.8);
	return *robot;
}

struct random_run {
	unsigned aborts, commits, coded, packed, regions;
	size_t most_bytes;
};

static void close_random(struct reader *reader, struct random_run *run)
{
	struct publisher_client_stats stats;

	publisher_client_stats(reader->client, &stats);
	run->aborts += reader->aborts;
	run->commits += reader->commits;
	run->coded += reader->coded;
	run->packed += reader->packed;
	run->regions += (unsigned)reader->regions - 1;
	reader_close(reader);
}

/* One random history: clients of any pace and any wish come, go, stall and change their minds while the map changes. */
static void random_history(uint64_t seed, uint64_t steps, uint32_t side, size_t pinned_max, struct random_run *run)
{
	static struct history h;
	struct publisher *p = start_with(&h, side, pinned_max, seed % 2 ? 0 : 1 + seed % 30);
	struct reader reader[CLIENTS];
	struct patch_key robot = {0};
	struct publisher_stats stats;
	uint32_t pace[CLIENTS] = {0}, changes;
	double x_m = 0;

	random_state = seed * 0x9e3779b97f4a7c15ull + 1;
	changes = 1 + pick(KEYS / 2);
	memset(reader, 0, sizeof(reader));
	while (h.step < steps) {
		advance_history(&h, p, changes);
		move_robot(p, &robot, &x_m);
		for (int i = 0; i < CLIENTS; i++) {
			struct native_want want = random_want();

			if (!reader[i].client && pick(10) == 0)
				reader_join(&reader[i], p, &want, robot);
			if (pick(20) == 0)
				pace[i] = pick(3) == 0 ? 0 : 1u << pick(17);
			if (!reader[i].client)
				continue;
			if (pick(30) == 0) {
				reader[i].want = want;
				reader[i].want.flags |= NATIVE_WANT_ZSTD; /* may still come */
				publisher_want(reader[i].client, &reader[i].want);
			}
			reader_wants(&reader[i], robot);
			reader_pump(&reader[i], &h, pace[i]);
			if (pick(100) == 0 || publisher_reason(reader[i].client))
				close_random(&reader[i], run);
		}
	}
	publisher_stats(p, &stats);
	assert_true(stats.clients_peak_bytes <= PUBLISHER_CLIENT_MAX);
	run->most_bytes = run->most_bytes > stats.clients_peak_bytes ? run->most_bytes : stats.clients_peak_bytes;
	for (int i = 0; i < CLIENTS; i++) {
		if (reader[i].client && !publisher_reason(reader[i].client))
			expect_converged(&reader[i], &h);
		if (reader[i].client)
			close_random(&reader[i], run);
	}
	publisher_stats(p, &stats);
	assert_int_equal(stats.pinned, 0);
	publisher_destroy(p);
}

static void random_histories_converge_and_every_commit_is_the_map_of_its_step(void **state)
{
	struct random_run run = {0};

	(void)state;
	for (uint64_t seed = 1; seed <= 6; seed++)
		random_history(seed, STEPS, 400, 0, &run);
	for (uint64_t seed = 1000; seed < 3000; seed++)
		random_history(seed, 20, 20, 0, &run);
	assert_int_equal(run.aborts, 0);
	assert_true(run.coded > 1000 && run.packed > 1000 && run.regions > 1000);
	printf("note: 2,006 random schedules: %u commits judged, %u regions changed, a client cost at most %zu bytes\n",
	       run.commits, run.regions, run.most_bytes);
}

static void random_histories_with_little_room_for_pins_converge_too(void **state)
{
	struct random_run run = {0};

	(void)state;
	for (uint64_t seed = 101; seed <= 106; seed++)
		random_history(seed, STEPS, 400, 50000, &run);
	for (uint64_t seed = 3000; seed < 4000; seed++)
		random_history(seed, 20, 20, 500, &run);
	printf("note: 1,006 more with little room for pins: %u commits judged, %u batches aborted\n", run.commits,
	       run.aborts);
	assert_true(run.aborts > 20);
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

static void what_stalled_clients_need_is_kept_once_for_all_and_counted(void **state)
{
	static struct history h;
	struct publisher *p = start(&h, 1, 0);
	struct native_want want = {0};
	struct publisher_client *client[20];
	struct publisher_client_stats stats;
	struct publisher_stats all;
	size_t kept = 0;

	(void)state;
	publish_many(p, 1, 4000, 1);
	for (int i = 0; i < 20; i++) {
		client[i] = publisher_join(p, &want);
		write_some(client[i], 40000); /* begins a batch, then stalls */
	}
	for (uint64_t step = 2; step < 8; step++) {
		publish_many(p, step, 4000, 1);
		publisher_stats(p, &all);
		kept = kept ? kept : all.pinned;
		assert_int_equal(all.pinned, kept);
		assert_true(all.pinned > 4000 * 4 * sizeof(void *)); /* besides the sheets */
	}
	for (int i = 0; i < 20; i++) {
		publisher_client_stats(client[i], &stats);
		assert_true(stats.aborts == 0 && stats.bytes <= PUBLISHER_CLIENT_MAX);
		assert_true(stats.queued <= 64 << 10);
		publisher_stats(p, &all);
		assert_int_equal(all.pinned, kept); /* the last of them needs all of it */
		publisher_leave(client[i]);
	}
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

/* The rate cuts what is written anywhere. What is said to end a frame does, and nothing else. */
static void a_limited_rate_does_not_hide_where_frames_end(void **state)
{
	static struct history h;
	struct publisher *p = start(&h, 200, 0);
	struct native_want want = {.bytes_per_s = 20000};
	struct publisher_client *client;
	struct buffer got = {0};
	const uint8_t *bytes;
	int64_t t_ns = 1000000000;
	size_t n, at = 0, ends = 0, cuts = 0;

	(void)state;
	random_state = 3;
	advance_history(&h, p, KEYS);
	client = publisher_join(p, &want);
	for (int i = 0; i < 5000 && ends < 2; i++, t_ns = publisher_deadline(client))
		while ((n = publisher_peek(client, t_ns, &bytes)) > 0) {
			const bool whole = publisher_ends_frame(client, n);
			ssize_t frame = 0;

			buffer_append(&got, bytes, n);
			while (at < got.len &&
			       (frame = native_scan(got.data + at, got.len - at, NATIVE_TO_CLIENT_MAX)) > 0)
				at += (size_t)frame;
			assert_int_equal(whole, at == got.len);
			ends += whole;
			cuts += !whole;
			publisher_wrote(client, n, t_ns);
		}
	assert_true(ends > 0 && cuts > 0);
	buffer_finish(&got);
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

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(random_histories_converge_and_every_commit_is_the_map_of_its_step),
	    cmocka_unit_test(random_histories_with_little_room_for_pins_converge_too),
	    cmocka_unit_test(a_late_joiner_gets_the_whole_map_as_one_batch_with_reset),
	    cmocka_unit_test(a_stalled_client_costs_bounded_memory_and_skips_to_the_newest_state),
	    cmocka_unit_test(after_three_aborts_running_a_client_is_closed_with_the_reason),
	    cmocka_unit_test(what_stalled_clients_need_is_kept_once_for_all_and_counted),
	    cmocka_unit_test(removals_under_a_stalled_client_are_limited_too),
	    cmocka_unit_test(after_a_reset_every_client_begins_anew),
	    cmocka_unit_test(a_map_that_ends_is_handed_out_whole),
	    cmocka_unit_test(a_step_without_a_changed_patch_is_committed_too),
	    cmocka_unit_test(the_counts_of_faces_and_patches_follow_the_map),
	    cmocka_unit_test(messages_come_between_frames_and_are_bounded),
	    cmocka_unit_test(a_client_that_wants_a_rate_gets_no_more),
	    cmocka_unit_test(a_limited_rate_does_not_hide_where_frames_end),
	    cmocka_unit_test(nothing_but_the_reason_of_a_refusal_comes_before_hello),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

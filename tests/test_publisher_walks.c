/* Laws L3, L6: whoever has a wire of his own gets the same batches, nearest first; every form of a patch is made once for
 * all; regions are kept, what leaves one is removed, and a robot that stands costs nothing. */
#include "tests/publisher_bed.h"

#include <errno.h>
#include <math.h>
#include <time.h>

/* A form that says which patch it is of. */
static void encode_name(void *ctx, struct buffer *ret, const struct patch *patch)
{
	(*(unsigned *)ctx)++;
	buffer_printf(ret, "%d at %llu", patch->key.x, (unsigned long long)patch->version);
}

static struct publisher *start_named(unsigned *encoded, size_t forms_bytes)
{
	struct publisher_params params = {.cell_m = CELL_M, .forms_bytes = forms_bytes};
	struct publisher *p;

	params.encoder[PUBLISHER_SCENE_JSON] = (struct publisher_encoder){encode_name, encoded};
	p = publisher_create(&params);
	assert_non_null(p);
	return p;
}

/* Patches of keys [from, from + n), all of one content (0: gone), as one step. */
static void publish_keys(struct publisher *p, uint64_t step, uint32_t from, uint32_t n, uint32_t content)
{
	static struct patch *patch[6000];

	for (uint32_t i = 0; i < n; i++)
		patch[i] = make_patch(from + i, content, step, 1);
	assert_int_equal(publisher_publish(p, step, patch, NULL, n), 0);
	while (n > 0)
		patch_unref(patch[--n]);
}

static struct publisher_client *join_walk(struct publisher *p, uint8_t flags, float a, enum publisher_form form)
{
	struct native_want want = {.flags = flags, .region = {a, -1, -100, -a, 1, 100}};
	struct publisher_client *client = publisher_join_walk(p, &want, form);

	assert_non_null(client);
	return client;
}

struct walked {
	struct native_begin begin;
	uint32_t patches, removals;
	int32_t first, last; /* x of the keys of patches */
};

/* A whole batch; false: nothing new. Judges counts and order: removals, then patches, farther and farther. */
static bool walk(struct publisher_client *client, int32_t origin, struct walked *ret)
{
	struct publisher_item item;
	int64_t nearest = -1;
	int r = publisher_walk_begin(client, &ret->begin);

	ret->patches = ret->removals = 0;
	if (r == 0)
		return false;
	assert_int_equal(r, 1);
	while ((r = publisher_walk_next(client, &item)) == 1) {
		int64_t distance = item.key.x < origin ? origin - item.key.x : item.key.x - origin;

		ret->removals += item.removed;
		if (item.removed) {
			assert_int_equal(ret->patches, 0);
			assert_null(item.bytes);
			continue;
		}
		assert_true(distance >= nearest);
		nearest = distance;
		ret->first = ret->patches++ == 0 ? item.key.x : ret->first;
		ret->last = item.key.x;
	}
	assert_int_equal(r, 0);
	assert_int_equal(publisher_walk_commit(client), 0);
	assert_int_equal(ret->patches, ret->begin.patches);
	assert_int_equal(ret->removals, ret->begin.removals);
	return true;
}

static void a_walk_brings_what_changed_and_nothing_twice(void **state)
{
	unsigned encoded = 0;
	struct publisher *p = start_named(&encoded, 0);
	struct publisher_client *client = join_walk(p, 0, 0, PUBLISHER_SCENE_JSON);
	struct walked w;

	(void)state;
	assert_true(walk(client, 0, &w)); /* an empty map is said too */
	assert_true(w.begin.reset && w.patches == 0);
	publish_keys(p, 1, 0, 100, 7);
	assert_true(walk(client, 0, &w));
	assert_true(!w.begin.reset && w.patches == 100 && w.begin.step == 1);
	assert_false(walk(client, 0, &w));
	publish_keys(p, 2, 40, 10, 8);
	publish_keys(p, 3, 45, 10, 0);
	assert_true(walk(client, 0, &w));
	assert_true(w.patches == 5 && w.removals == 10 && w.begin.step == 3);
	assert_int_equal(encoded, 105);
	publisher_leave(client);
	publisher_destroy(p);
}

static void a_form_is_made_once_for_all_and_only_if_somebody_asks(void **state)
{
	unsigned encoded = 0;
	struct publisher *p = start_named(&encoded, 0);
	struct publisher_client *client[10];
	struct publisher_stats stats;
	struct walked w;

	(void)state;
	publish_keys(p, 1, 0, 100, 7);
	for (int i = 0; i < 10; i++)
		client[i] = join_walk(p, 0, 0, i < 5 ? PUBLISHER_SCENE_JSON : PUBLISHER_CODED);
	assert_int_equal(encoded, 0);
	for (uint64_t step = 2; step < 5; step++) {
		for (int i = 0; i < 10; i++)
			assert_true(walk(client[i], 0, &w));
		publish_keys(p, step, 10, 20, (uint32_t)step);
	}
	publisher_stats(p, &stats);
	assert_int_equal(encoded, 100 + 2 * 20);
	assert_int_equal(stats.encodes[PUBLISHER_SCENE_JSON], encoded);
	assert_int_equal(stats.encodes[PUBLISHER_CODED], encoded);
	assert_int_equal(stats.encodes[PUBLISHER_NATIVE], 100 + 3 * 20);
	assert_int_equal(stats.encodes[PUBLISHER_PACKED], 0);
	for (int i = 0; i < 10; i++)
		publisher_leave(client[i]);
	publish_keys(p, 5, 0, 100, 0);
	publisher_stats(p, &stats);
	assert_int_equal(stats.forms_bytes, 0);
	publisher_destroy(p);
}

static void forms_beyond_their_limit_are_made_again(void **state)
{
	unsigned encoded = 0;
	struct publisher *p = start_named(&encoded, 200);
	struct publisher_client *a = join_walk(p, 0, 0, PUBLISHER_SCENE_JSON);
	struct publisher_client *b = join_walk(p, 0, 0, PUBLISHER_SCENE_JSON);
	struct publisher_stats stats;
	struct walked w;

	(void)state;
	publish_keys(p, 1, 0, 100, 7);
	assert_true(walk(a, 0, &w) && walk(b, 0, &w));
	assert_int_equal(encoded, 200);
	publisher_stats(p, &stats);
	assert_in_range(stats.forms_bytes, 100, 200);
	publisher_leave(a);
	publisher_leave(b);
	publisher_destroy(p);
}

static void a_batch_under_which_all_changes_is_sent_as_it_was(void **state)
{
	unsigned encoded = 0;
	struct publisher *p = start_named(&encoded, 0);
	struct publisher_client *client = join_walk(p, 0, 0, PUBLISHER_SCENE_JSON);
	struct publisher_item item;
	struct native_begin begin;
	char text[40] = "";
	int n = 0;

	(void)state;
	publish_keys(p, 1, 0, 1500, 7);
	assert_int_equal(publisher_walk_begin(client, &begin), 1);
	while (publisher_walk_next(client, &item) == 1) {
		snprintf(text, sizeof(text), "%d at 1", item.key.x);
		assert_int_equal(item.version, 1);
		assert_int_equal(item.len, strlen(text));
		assert_memory_equal(item.bytes, text, item.len);
		if (n++ == 100)
			publish_keys(p, 2, 0, 1500, 8);
		assert_memory_equal(item.bytes, text, item.len); /* also when it is changed meanwhile */
	}
	assert_int_equal(n, 1500);
	assert_int_equal(publisher_walk_commit(client), 0);
	publisher_leave(client);
	publisher_destroy(p);
}

static void a_walk_hears_once_that_its_batch_is_void(void **state)
{
	unsigned encoded = 0;
	struct publisher *p = start_named(&encoded, 0);
	struct publisher_client *client = join_walk(p, 0, 0, PUBLISHER_SCENE_JSON);
	struct publisher_item item;
	struct native_begin begin;

	(void)state;
	publish_keys(p, 1, 0, 100, 7);
	assert_int_equal(publisher_walk_begin(client, &begin), 1);
	assert_int_equal(publisher_walk_next(client, &item), 1);
	publisher_reset(p);
	assert_int_equal(item.bytes[0], item.key.x < 0 ? '-' : '0' + item.key.x); /* still borrowed */
	assert_int_equal(publisher_walk_next(client, &item), -ECANCELED);
	assert_int_equal(publisher_walk_begin(client, &begin), 1);
	assert_true(begin.reset && begin.patches == 0);
	assert_int_equal(publisher_walk_next(client, &item), 0);
	publisher_reset(p);
	assert_int_equal(publisher_walk_commit(client), -ECANCELED);
	publisher_dismiss(client, "enough");
	assert_int_equal(publisher_walk_begin(client, &begin), 0);
	assert_string_equal(publisher_reason(client), "enough");
	publisher_leave(client);
	publisher_destroy(p);
}

static void what_is_near_comes_first_however_many_there_are(void **state)
{
	unsigned encoded = 0;
	struct publisher *p = start_named(&encoded, 0);
	struct publisher_client *client = join_walk(p, 0, 0, PUBLISHER_NATIVE);
	struct publisher_stats stats;
	struct walked w;

	(void)state;
	publish_keys(p, 1, 0, 6000, 7);
	assert_false(publisher_robot(p, 2000 * PATCH_M + 0.1, 0.1, 5.7)); /* nobody wants a radius */
	assert_true(walk(client, 2000, &w));
	assert_int_equal(w.patches, 6000);
	assert_int_equal(w.first, 2000);
	assert_int_equal(w.last, 5999 - KEYS / 2);
	publisher_stats(p, &stats);
	assert_true(stats.clients_peak_bytes <= 24 << 10); /* the window, however long the batch */
	publisher_leave(client);
	publisher_destroy(p);
}

static void what_leaves_the_region_is_removed_and_what_enters_is_sent(void **state)
{
	unsigned encoded = 0;
	struct publisher *p = start_named(&encoded, 0);
	struct publisher_client *client = join_walk(p, NATIVE_WANT_RADIUS, (float)(5 * PATCH_M), PUBLISHER_NATIVE);
	struct publisher_client_stats stats;
	struct walked w;

	(void)state;
	publisher_robot(p, 0.1, 0.1, 7.5 * PATCH_M);
	publish_keys(p, 1, 0, 120, 7);
	assert_true(walk(client, 0, &w));
	assert_int_equal(w.patches, 13); /* five between, on both sides, and the one at the end of them, and its own */
	assert_true(publisher_robot(p, 2.5 * PATCH_M, 0.1, 7.5 * PATCH_M));
	assert_true(walk(client, 2, &w));
	assert_true(w.patches == 2 && w.removals == 2 && w.begin.step == 1 && !w.begin.reset);
	for (int i = 0; i < 100; i++) /* trembles on the border of two patches */
		assert_false(publisher_robot(p, (i % 2 ? 3.01 : 2.99) * PATCH_M, 0.1, 7.5 * PATCH_M));
	assert_false(walk(client, 2, &w));
	publisher_client_stats(client, &stats);
	assert_int_equal(stats.batches, 2);
	publish_keys(p, 2, 0, 20, 8); /* far off: the step is told, no patch */
	assert_true(walk(client, 2, &w));
	assert_true(w.patches == 0 && w.removals == 0 && w.begin.step == 2);
	publisher_leave(client);
	publisher_destroy(p);
}

static void a_region_may_be_changed_and_given_up_without_a_reset(void **state)
{
	unsigned encoded = 0;
	struct publisher *p = start_named(&encoded, 0);
	struct publisher_client *client = join_walk(p, NATIVE_WANT_BOX, -2.0f, PUBLISHER_NATIVE);
	struct native_want all = {0}, elsewhere = {.flags = NATIVE_WANT_BOX, .region = {8, -1, -100, 9, 1, 100}};
	struct walked w;

	(void)state;
	publish_keys(p, 1, 0, 120, 7);
	assert_true(walk(client, 0, &w));
	assert_true(w.begin.reset && w.patches == 6); /* -2 m .. 2 m: patches -3 .. 2 */
	publisher_want(client, &elsewhere);
	assert_true(walk(client, 0, &w));
	assert_true(!w.begin.reset && w.patches == 2 && w.removals == 6);
	publisher_want(client, &all);
	assert_true(walk(client, 0, &w));
	assert_true(!w.begin.reset && w.patches == 118 && w.removals == 0);
	publisher_leave(client);
	publisher_destroy(p);
}

static void a_region_that_is_none_closes_the_client(void **state)
{
	const struct native_want wrong[] = {
	    {.flags = NATIVE_WANT_BOX, .region = {1, 0, 0, 0, 1, 1}},
	    {.flags = NATIVE_WANT_BOX, .region = {0, 0, 0, 1, NAN, 1}},
	    {.flags = NATIVE_WANT_RADIUS, .region = {-1}},
	    {.flags = NATIVE_WANT_RADIUS, .region = {NAN}},
	    {.flags = NATIVE_WANT_RADIUS | NATIVE_WANT_BOX, .region = {1, 1, 1, 2, 2, 2}},
	};
	const struct native_want boundless[] = {
	    {.flags = NATIVE_WANT_BOX, .region = {-INFINITY, -INFINITY, -INFINITY, INFINITY, INFINITY, INFINITY}},
	    {.flags = NATIVE_WANT_RADIUS, .region = {INFINITY}},
	    {.flags = NATIVE_WANT_RADIUS, .region = {3e38f}},
	};
	unsigned encoded = 0;
	struct publisher *p = start_named(&encoded, 0);
	struct publisher_client *client;
	struct walked w;

	(void)state;
	publish_keys(p, 1, 0, 120, 7);
	for (size_t i = 0; i < sizeof(wrong) / sizeof(*wrong); i++) {
		client = publisher_join(p, &wrong[i]);
		assert_non_null(publisher_reason(client));
		publisher_leave(client);
	}
	for (size_t i = 0; i < sizeof(boundless) / sizeof(*boundless); i++) {
		client = publisher_join_walk(p, &boundless[i], PUBLISHER_NATIVE);
		assert_true(walk(client, 0, &w));
		assert_int_equal(w.patches, 120);
		publisher_leave(client);
	}
	publisher_destroy(p);
}

/* The least distance of a point of one patch to a point of another, in patches. */
static double between(struct patch_key a, struct patch_key b)
{
	double d[3] = {fabs((double)a.x - b.x) - 1, fabs((double)a.y - b.y) - 1, fabs((double)a.z - b.z) - 1};
	double sum = 0;

	for (int i = 0; i < 3; i++)
		sum += d[i] > 0 ? d[i] * d[i] : 0;
	return sqrt(sum);
}

static void a_radius_holds_all_that_is_within_and_little_more(void **state)
{
	struct patch_key robot = {0};
	double x_m = 0, y_m = 0, radius_m = 7.3;

	(void)state;
	random_state = 77;
	for (int i = 0; i < 20000; i++) {
		struct native_want want = {.flags = NATIVE_WANT_RADIUS, .region = {(float)radius_m}};
		struct patch_key key = {(int32_t)pick(40) - 20 + robot.x, (int32_t)pick(40) - 20 + robot.y,
		                        (int32_t)pick(40) - 20};
		double at[3] = {x_m, y_m, 1}, low[3] = {key.x * PATCH_M, key.y * PATCH_M, key.z * PATCH_M}, sum = 0;
		struct interest region;

		for (int k = 0; k < 3; k++) {
			double d = at[k] < low[k] ? low[k] - at[k] : at[k] - low[k] - PATCH_M;

			sum += d > 0 ? d * d : 0;
		}
		assert_int_equal(interest_of(&want, CELL_M, robot, &region), 0);
		if (sqrt(sum) <= radius_m)
			assert_true(interest_has(&region, key));
		if (between(key, robot) * PATCH_M > radius_m + PATCH_M)
			assert_false(interest_has(&region, key));
		x_m += (pick(3) - 1.0) * 0.3;
		y_m += (pick(3) - 1.0) * 0.3;
		interest_follow(&robot, CELL_M, x_m, y_m, 1);
	}
	assert_false(interest_follow(&robot, CELL_M, NAN, 0, 0));
	assert_false(interest_follow(&robot, CELL_M, 1e30, 0, 0));
}

static void a_pinned_step_stays_as_it_was(void **state)
{
	unsigned encoded = 0;
	struct publisher *p = start_named(&encoded, 0);
	struct publisher_snapshot *snapshot, *more[PUBLISHER_SNAPSHOTS_MAX];
	struct publisher_stats stats;

	(void)state;
	publish_keys(p, 1, 0, 100, 7);
	snapshot = publisher_pin(p);
	assert_true(snapshot && snapshot->step == 1 && snapshot->generation == 1 && snapshot->patches == 100);
	publish_keys(p, 2, 0, 50, 8);
	publisher_reset(p);
	for (size_t i = 0; i < snapshot->patches; i++) {
		struct native_message message;
		size_t len;
		const uint8_t *frame = publisher_snapshot_frame(snapshot, i, &len);
		char error[128];

		assert_int_equal(native_decode(frame, len, &message, error), 0);
		assert_true(is_content(message.patch, (uint32_t)(message.patch->key.x + KEYS / 2), 7, 1));
		native_message_finish(&message);
	}
	for (int i = 0; i < PUBLISHER_SNAPSHOTS_MAX - 1; i++)
		assert_non_null(more[i] = publisher_pin(p));
	assert_null(publisher_pin(p));
	publisher_release(p, snapshot);
	for (int i = 0; i < PUBLISHER_SNAPSHOTS_MAX - 1; i++)
		publisher_release(p, more[i]);
	publisher_stats(p, &stats);
	assert_int_equal(stats.pinned, 0);
	publisher_destroy(p);
}

/* One that stalls in its first batch is asked about a patch once, not with every change of it: what it pins stays. */
static void stalled_clients_pin_what_they_lack_and_no_change_more(void **state)
{
	unsigned encoded = 0;
	struct publisher *p = start_named(&encoded, 0);
	struct publisher_client *client[150];
	struct publisher_stats before, after;
	struct native_begin begin;

	(void)state;
	publish_keys(p, 1, 0, 1000, 7);
	for (int i = 0; i < 150; i++) {
		client[i] = join_walk(p, 0, 0, PUBLISHER_NATIVE);
		assert_int_equal(publisher_walk_begin(client[i], &begin), 1);
	}
	publish_keys(p, 2, 0, 300, 8);
	publisher_stats(p, &before);
	for (uint64_t step = 3; step < 200; step++)
		publish_keys(p, step, 0, 300, (uint32_t)step);
	publisher_stats(p, &after);
	assert_int_equal(before.pinned, after.pinned);
	assert_true(after.clients_peak_bytes <= PUBLISHER_CLIENT_MAX);
	for (int i = 0; i < 150; i++)
		publisher_leave(client[i]);
	publisher_destroy(p);
}

/* Stalled in as many different steps as there are, or in one: a change asks one of them. */
static void a_change_asks_one_of_however_many_stalled_clients(void **state)
{
	unsigned encoded = 0;
	struct publisher *p = start_named(&encoded, 0);
	struct publisher_client *client[150];
	struct publisher_stats before, after;
	struct publisher_item item;
	struct native_begin begin;

	(void)state;
	publish_keys(p, 1, 0, 1000, 7);
	for (uint64_t step = 2; step < 152; step++) {
		client[step - 2] = join_walk(p, 0, 0, PUBLISHER_NATIVE);
		assert_int_equal(publisher_walk_begin(client[step - 2], &begin), 1);
		publisher_stats(p, &before);
		publish_keys(p, step, (uint32_t)step, 60, (uint32_t)step);
		publisher_stats(p, &after);
		assert_int_equal(after.asked - before.asked, 60);
	}
	publish_keys(p, 152, 152, 58, 1); /* changed since all of them began */
	publisher_stats(p, &before);
	assert_int_equal(before.asked, after.asked);
	for (int i = 0; i < 150; i++) { /* in any order: what the others need stays */
		const int at = i * 67 % 150;

		for (int n = 0; n < 1000; n++) {
			assert_int_equal(publisher_walk_next(client[at], &item), 1);
			const int64_t key = item.key.x + KEYS / 2, last = key < at + 1 ? key : at + 1;

			assert_int_equal(item.version, last >= 2 && last > key - 60 ? last : 1);
		}
		assert_int_equal(publisher_walk_next(client[at], &item), 0);
		publisher_leave(client[at]);
	}
	publisher_stats(p, &after);
	assert_int_equal(after.pinned, 0);
	publisher_destroy(p);
}

static double cpu_s(void)
{
	struct timespec t;

	clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
	return (double)t.tv_sec + (double)t.tv_nsec * 1e-9;
}

/* A figure, not a claim: what a step of 60 patches costs the publisher, 150 clients stalled in their first batch or none, in
 * turns. */
static void a_step_beside_stalled_clients_is_measured(void **state)
{
	unsigned encoded = 0;
	struct publisher *p[2] = {start_named(&encoded, 0), start_named(&encoded, 0)};
	struct publisher_client *client[150];
	struct native_begin begin;
	double spent_s[2] = {0};

	(void)state;
	for (int k = 0; k < 2; k++)
		publish_keys(p[k], 1, 0, 3000, 7);
	for (int i = 0; i < 150; i++) {
		client[i] = join_walk(p[1], 0, 0, PUBLISHER_NATIVE);
		assert_int_equal(publisher_walk_begin(client[i], &begin), 1);
	}
	for (uint64_t step = 2; step < 3000; step++)
		for (int k = 0; k < 2; k++) {
			const double begin_s = cpu_s();

			publish_keys(p[k], step, (uint32_t)(step / 100 * 10), 60, 8);
			spent_s[k] += cpu_s() - begin_s;
		}
	printf("note: a step of 60 patches: %.1f us, %.1f us beside 150 stalled clients, ratio %.2f\n",
	       spent_s[0] / 2998 * 1e6, spent_s[1] / 2998 * 1e6, spent_s[1] / spent_s[0]);
	for (int i = 0; i < 150; i++)
		publisher_leave(client[i]);
	publisher_destroy(p[0]);
	publisher_destroy(p[1]);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_walk_brings_what_changed_and_nothing_twice),
	    cmocka_unit_test(a_form_is_made_once_for_all_and_only_if_somebody_asks),
	    cmocka_unit_test(forms_beyond_their_limit_are_made_again),
	    cmocka_unit_test(a_batch_under_which_all_changes_is_sent_as_it_was),
	    cmocka_unit_test(a_walk_hears_once_that_its_batch_is_void),
	    cmocka_unit_test(what_is_near_comes_first_however_many_there_are),
	    cmocka_unit_test(what_leaves_the_region_is_removed_and_what_enters_is_sent),
	    cmocka_unit_test(a_region_may_be_changed_and_given_up_without_a_reset),
	    cmocka_unit_test(a_region_that_is_none_closes_the_client),
	    cmocka_unit_test(a_radius_holds_all_that_is_within_and_little_more),
	    cmocka_unit_test(a_pinned_step_stays_as_it_was),
	    cmocka_unit_test(stalled_clients_pin_what_they_lack_and_no_change_more),
	    cmocka_unit_test(a_change_asks_one_of_however_many_stalled_clients),
	    cmocka_unit_test(a_step_beside_stalled_clients_is_measured),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

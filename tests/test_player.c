/* Law L7 at any pace: a replay that is stopped, sought in, slowed down and starved hands over each event once, in order, never
 * before it is due, and catches up nothing in a rush. The recording is a list here, and the clock is a number. */
#include <errno.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "daemon/player.h"

#define MS         INT64_C(1000000)
#define S          (1000 * MS)
#define BEGIN_NS   (INT64_C(1700000000) * S) /* of the recording */
#define MONO_NS    (77 * S)                  /* of the real clock, when the player begins */
#define EVENTS     200
#define STEP_NS    (100 * MS)
#define ROUNDED_NS 1000 /* a time divided by a speed, as a double */

/* A recording: an event every STEP_NS; a map begins with it and in the middle of it. */
struct replay {
	int at;
	int met; /* the farthest event that was told */
	int damaged_at;
};

static int64_t log_ns(int i)
{
	return BEGIN_NS + i * STEP_NS;
}

static bool begins(int i)
{
	return i == 0 || i == EVENTS / 2;
}

void replay_span(const struct replay *replay, int64_t *ret_begin_ns, int64_t *ret_end_ns)
{
	(void)replay;
	*ret_begin_ns = log_ns(0);
	*ret_end_ns = log_ns(EVENTS - 1);
}

int replay_next(struct replay *replay, struct replay_event *ret, char error[REPLAY_ERROR_MAX])
{
	if (replay->at == EVENTS)
		return 0;
	if (replay->damaged_at && replay->at == replay->damaged_at) {
		snprintf(error, REPLAY_ERROR_MAX, "damaged");
		return -EINVAL;
	}
	*ret = (struct replay_event){.kind = begins(replay->at) ? REPLAY_BEGIN : REPLAY_TICK,
	                             .log_ns = log_ns(replay->at)};
	replay->met = replay->at > replay->met ? replay->at : replay->met;
	replay->at++;
	return 1;
}

int64_t replay_next_ns(const struct replay *replay)
{
	return replay->at == EVENTS ? INT64_MAX : log_ns(replay->at);
}

static int begin_before(const struct replay *replay, int64_t t_ns)
{
	return t_ns >= log_ns(EVENTS / 2) && replay->met >= EVENTS / 2 ? EVENTS / 2 : 0;
}

int replay_back(struct replay *replay, int64_t t_ns, char error[REPLAY_ERROR_MAX])
{
	(void)error;
	replay->at = begin_before(replay, t_ns);
	return 0;
}

int64_t replay_back_ns(const struct replay *replay, int64_t t_ns)
{
	return log_ns(begin_before(replay, t_ns));
}

/* A host that writes down what it was handed, and the real time of it. */
struct bed {
	struct replay replay;
	struct player *player;
	int64_t mono_ns;
	struct {
		int64_t log_ns, mono_ns;
	} told[4 * EVENTS];
	int n, again, ended, rushes;
	bool full, rushing, refuse;
};

static bool room(void *ctx)
{
	return !((struct bed *)ctx)->full;
}

static int take_event(void *ctx, const struct replay_event *event, char error[REPLAY_ERROR_MAX])
{
	struct bed *b = ctx;

	if (b->refuse) {
		snprintf(error, REPLAY_ERROR_MAX, "refused");
		return -EINVAL;
	}
	assert_true(b->n < 4 * EVENTS);
	b->told[b->n].log_ns = event->log_ns;
	b->told[b->n++].mono_ns = b->mono_ns;
	return 0;
}

static void note_rush(void *ctx, bool on)
{
	struct bed *b = ctx;

	assert_true(on != b->rushing);
	b->rushing = on;
	b->rushes += on;
}

static void note_again(void *ctx)
{
	((struct bed *)ctx)->again++;
}

static void note_end(void *ctx)
{
	((struct bed *)ctx)->ended++;
}

static void bed_begin(struct bed *b, double speed)
{
	const struct player_host host = {b, room, take_event, note_rush, note_again, note_end};

	memset(b, 0, sizeof(*b));
	b->mono_ns = MONO_NS;
	b->player = player_create(&b->replay, &host, speed);
	assert_non_null(b->player);
}

/* Real time goes by until `mono_ns`; the player is called when it asked to be, as a loop with a timer does it. */
static void run(struct bed *b, int64_t mono_ns)
{
	for (;;) {
		const int64_t next_ns = player_turn(b->player, b->mono_ns);

		if (next_ns > mono_ns) {
			b->mono_ns = mono_ns;
			return;
		}
		assert_true(next_ns >= b->mono_ns);
		b->mono_ns = next_ns;
	}
}

static struct player_status status(const struct bed *b)
{
	struct player_status s;

	player_status(b->player, b->mono_ns, &s);
	return s;
}

static void seek(struct bed *b, int64_t t_ns)
{
	char error[200] = "";

	if (!player_seek(b->player, t_ns, b->mono_ns, error))
		fail_msg("%s", error);
}

static void set_speed(struct bed *b, double speed)
{
	char error[200] = "";

	if (!player_speed(b->player, speed, b->mono_ns, error))
		fail_msg("%s", error);
}

/* Events `first` and on, from the `from`th that was told; each when it is due at `speed` behind (mono_ns, of log time). */
static void expect_paced(const struct bed *b, int from, int first, int64_t mono_ns, int64_t anchor_ns, double speed)
{
	for (int i = from; i < b->n; i++) {
		const int64_t due_ns = mono_ns + (int64_t)((double)(log_ns(first + i - from) - anchor_ns) / speed);

		assert_int_equal(b->told[i].log_ns, log_ns(first + i - from));
		assert_in_range(b->told[i].mono_ns - due_ns + ROUNDED_NS, 0, 2 * ROUNDED_NS);
	}
}

static void every_event_comes_once_and_when_it_is_due(void **state)
{
	static const double speed[] = {PLAYER_SPEED_MIN, 0.5, 1, 3, 20, PLAYER_SPEED_MAX};
	struct bed b;

	(void)state;
	for (size_t i = 0; i < sizeof(speed) / sizeof(*speed); i++) {
		bed_begin(&b, speed[i]);
		run(&b, MONO_NS + 1000 * S);
		assert_int_equal(b.n, EVENTS);
		expect_paced(&b, 0, 0, MONO_NS, BEGIN_NS, speed[i]);
		assert_int_equal(status(&b).state, PLAYER_ENDED);
		assert_int_equal(status(&b).now_ns, log_ns(EVENTS - 1));
		assert_int_equal(b.ended, 1);
		assert_int_equal(b.rushes, 0);
		player_destroy(b.player);
	}
}

static void as_fast_as_can_be_takes_no_time_but_many_turns(void **state)
{
	struct bed b;
	int turns = 1;

	(void)state;
	bed_begin(&b, 0);
	for (; player_turn(b.player, MONO_NS) == MONO_NS; turns++) {
		assert_true(b.n <= turns * PLAYER_EVENTS_MAX);
		assert_true(b.rushing);
	}
	assert_int_equal(turns, EVENTS / PLAYER_EVENTS_MAX + 1);
	assert_int_equal(b.n, EVENTS);
	assert_int_equal(b.rushes, 1);
	assert_false(b.rushing); /* the end is shown */
	player_destroy(b.player);
}

static void a_pause_of_hours_costs_nothing_and_nothing_is_caught_up(void **state)
{
	struct bed b;
	int told;

	(void)state;
	bed_begin(&b, 0.5);
	run(&b, MONO_NS + 10 * S + 60 * MS); /* 5.03 s of the recording: 0.03 s behind an event */
	player_play(b.player, false, b.mono_ns);
	told = b.n;
	assert_int_equal(told, 51);
	assert_int_equal(status(&b).state, PLAYER_PAUSED);
	assert_int_equal(status(&b).now_ns, BEGIN_NS + 5030 * MS);
	run(&b, b.mono_ns + 7200 * S);
	assert_int_equal(b.n, told);
	assert_int_equal(status(&b).now_ns, BEGIN_NS + 5030 * MS);
	player_play(b.player, true, b.mono_ns);
	run(&b, b.mono_ns + 4 * S);
	assert_int_equal(b.n, told + 20);
	expect_paced(&b, told, told, MONO_NS + 10 * S + 60 * MS + 7200 * S, BEGIN_NS + 5030 * MS, 0.5);
	player_destroy(b.player);
}

static void who_says_play_again_and_again_holds_nothing_up(void **state)
{
	struct bed b;

	(void)state;
	bed_begin(&b, 1);
	for (int i = 1; i <= 500; i++) { /* each 10 ms, events each 100 */
		run(&b, MONO_NS + i * 10 * MS);
		player_play(b.player, true, b.mono_ns);
	}
	assert_int_equal(b.n, 51);
	expect_paced(&b, 0, 0, MONO_NS, BEGIN_NS, 1);
	for (int i = 1; i <= 500; i++) {
		run(&b, MONO_NS + 5 * S + i * 10 * MS);
		set_speed(&b, 1);
	}
	assert_int_equal(b.n, 101);
	expect_paced(&b, 0, 0, MONO_NS, BEGIN_NS, 1);
	player_destroy(b.player);
}

static void another_speed_goes_on_from_where_it_stands(void **state)
{
	static const double speed[] = {0.1, 10, 0.5, 1000, 1};
	struct bed b;
	int64_t at_ns = BEGIN_NS;

	(void)state;
	bed_begin(&b, 1);
	for (size_t i = 0; i < sizeof(speed) / sizeof(*speed); i++) {
		const int64_t mono_ns = b.mono_ns, for_ns = (int64_t)(1330 * (double)MS / speed[i]);
		const int told = b.n;

		set_speed(&b, speed[i]);
		run(&b, b.mono_ns + for_ns);
		expect_paced(&b, told, told, mono_ns, at_ns, speed[i]);
		at_ns += 1330 * MS;
		assert_in_range(status(&b).now_ns - at_ns + ROUNDED_NS, 0, 2 * ROUNDED_NS);
	}
	assert_int_equal(b.n, 67); /* 6.65 s */
	player_destroy(b.player);
}

static void a_seek_forward_goes_through_all_that_lies_between_and_stands_at_its_place(void **state)
{
	struct bed b;

	(void)state;
	bed_begin(&b, 1);
	run(&b, MONO_NS + S);
	seek(&b, BEGIN_NS + 8030 * MS);
	assert_int_equal(status(&b).state, PLAYER_SEEKING);
	run(&b, b.mono_ns); /* no time goes by */
	assert_int_equal(status(&b).state, PLAYER_PLAYING);
	assert_int_equal(status(&b).now_ns, BEGIN_NS + 8030 * MS);
	assert_int_equal(b.n, 81);
	assert_int_equal(b.again, 0);
	assert_int_equal(b.rushes, 1);
	assert_false(b.rushing);
	run(&b, b.mono_ns + 2 * S);
	for (int i = 0; i < b.n; i++)
		assert_int_equal(b.told[i].log_ns, log_ns(i));
	expect_paced(&b, 81, 81, MONO_NS + S, BEGIN_NS + 8030 * MS, 1);
	assert_int_equal(status(&b).seeks, 1);
	player_destroy(b.player);
}

/* The map that the place is in begins anew, and everything before the place is handed over again. */
static void a_seek_back_begins_with_the_map_that_its_place_is_in(void **state)
{
	struct bed b;

	(void)state;
	bed_begin(&b, 1);
	run(&b, MONO_NS + 15 * S);
	for (int late = 0; late < 2; late++) {
		const int first = late ? EVENTS / 2 : 0, told = b.n;
		const int64_t place_ns = log_ns(first) + 3050 * MS, mono_ns = b.mono_ns;

		player_play(b.player, false, b.mono_ns);
		seek(&b, place_ns);
		run(&b, b.mono_ns + 100 * S);
		assert_int_equal(b.again, late + 1);
		assert_int_equal(b.n, told + 31);
		assert_int_equal(b.told[told].log_ns, log_ns(first));
		assert_int_equal(status(&b).state, PLAYER_PAUSED);
		assert_int_equal(status(&b).now_ns, place_ns);
		player_play(b.player, true, b.mono_ns);
		run(&b, b.mono_ns + 12 * S - 50 * MS);
		expect_paced(&b, told + 31, first + 31, mono_ns + 100 * S, place_ns, 1);
		assert_int_equal(b.rushes, late + 1);
		if (!late)
			assert_int_equal(b.told[b.n - 1].log_ns, BEGIN_NS + 15 * S);
	}
	player_destroy(b.player);
}

static void from_the_end_it_can_be_sought_and_played_again(void **state)
{
	struct bed b;

	(void)state;
	bed_begin(&b, 0);
	run(&b, MONO_NS);
	assert_int_equal(status(&b).state, PLAYER_ENDED);
	player_play(b.player, true, b.mono_ns); /* from the start */
	run(&b, b.mono_ns);
	assert_int_equal(b.n, 2 * EVENTS);
	assert_int_equal(b.again, 1);
	assert_int_equal(b.ended, 2);
	player_play(b.player, false, b.mono_ns);
	seek(&b, log_ns(EVENTS - 1)); /* the end itself is a place, too */
	run(&b, b.mono_ns);
	assert_int_equal(status(&b).now_ns, log_ns(EVENTS - 1));
	assert_int_equal(b.told[b.n - 1].log_ns, log_ns(EVENTS - 1));
	assert_false(b.rushing);
	player_destroy(b.player);
}

static void a_host_without_room_stops_the_clock(void **state)
{
	struct bed b;

	(void)state;
	bed_begin(&b, 2);
	run(&b, MONO_NS + S);
	assert_int_equal(b.n, 21);
	b.full = true;
	run(&b, b.mono_ns + 60 * S);
	assert_int_equal(b.n, 21);
	b.full = false;
	run(&b, b.mono_ns);
	assert_int_equal(b.n, 22); /* the one that waited, and no rush behind it */
	run(&b, b.mono_ns + S);
	assert_int_equal(b.n, 42);
	expect_paced(&b, 21, 21, MONO_NS + 61 * S, log_ns(21), 2);
	player_destroy(b.player);
}

static void what_ends_it_early_is_told_and_seeking_back_is_still_possible(void **state)
{
	struct bed b;

	(void)state;
	bed_begin(&b, 1);
	b.replay.damaged_at = 20;
	run(&b, MONO_NS + 60 * S);
	assert_int_equal(status(&b).state, PLAYER_ENDED);
	assert_string_equal(player_error(b.player), "damaged");
	assert_int_equal(b.n, 20);
	player_play(b.player, false, b.mono_ns);
	seek(&b, BEGIN_NS + S);
	run(&b, b.mono_ns);
	assert_string_equal(player_error(b.player), "");
	assert_int_equal(b.n, 31);
	assert_int_equal(status(&b).state, PLAYER_PAUSED);
	b.refuse = true;
	player_play(b.player, true, b.mono_ns);
	run(&b, b.mono_ns + S);
	assert_int_equal(status(&b).state, PLAYER_ENDED);
	assert_string_equal(player_error(b.player), "refused");
	assert_int_equal(b.ended, 2);
	player_destroy(b.player);
}

static void a_place_outside_and_an_impossible_speed_are_refused_and_change_nothing(void **state)
{
	static const double bad[] = {-1, 0.0999, 1000.1, NAN, INFINITY};
	static const int64_t outside_ns[] = {BEGIN_NS - MS, BEGIN_NS + EVENTS * STEP_NS, INT64_MIN / 2, INT64_MAX};
	char error[200];
	struct bed b;

	(void)state;
	bed_begin(&b, 1);
	run(&b, MONO_NS + S);
	for (size_t i = 0; i < sizeof(bad) / sizeof(*bad); i++) {
		*error = 0;
		assert_false(player_speed(b.player, bad[i], b.mono_ns, error));
		assert_non_null(strstr(error, "0.1 to 1000"));
	}
	for (size_t i = 0; i < sizeof(outside_ns) / sizeof(*outside_ns); i++) {
		*error = 0;
		assert_false(player_seek(b.player, outside_ns[i], b.mono_ns, error));
		assert_non_null(strstr(error, "seek within it"));
	}
	run(&b, MONO_NS + 2 * S);
	assert_int_equal(b.n, 21);
	expect_paced(&b, 0, 0, MONO_NS, BEGIN_NS, 1);
	assert_true(player_seek(b.player, BEGIN_NS - MS + 1, b.mono_ns, error)); /* a double's rounding */
	run(&b, b.mono_ns);
	assert_int_equal(status(&b).now_ns, BEGIN_NS);
	player_destroy(b.player);
}

/* Between two events the position goes on, but not beyond what comes next, however late the loop is. */
static void the_position_goes_on_between_events_and_never_beyond_the_next(void **state)
{
	struct bed b;

	(void)state;
	bed_begin(&b, 1);
	run(&b, MONO_NS + S);
	b.mono_ns += 40 * MS;
	assert_int_equal(status(&b).now_ns, BEGIN_NS + 1040 * MS);
	b.mono_ns += 5 * S;
	assert_int_equal(status(&b).now_ns, BEGIN_NS + 1100 * MS);
	player_destroy(b.player);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(every_event_comes_once_and_when_it_is_due),
	    cmocka_unit_test(as_fast_as_can_be_takes_no_time_but_many_turns),
	    cmocka_unit_test(a_pause_of_hours_costs_nothing_and_nothing_is_caught_up),
	    cmocka_unit_test(who_says_play_again_and_again_holds_nothing_up),
	    cmocka_unit_test(another_speed_goes_on_from_where_it_stands),
	    cmocka_unit_test(a_seek_forward_goes_through_all_that_lies_between_and_stands_at_its_place),
	    cmocka_unit_test(a_seek_back_begins_with_the_map_that_its_place_is_in),
	    cmocka_unit_test(from_the_end_it_can_be_sought_and_played_again),
	    cmocka_unit_test(a_host_without_room_stops_the_clock),
	    cmocka_unit_test(what_ends_it_early_is_told_and_seeking_back_is_still_possible),
	    cmocka_unit_test(a_place_outside_and_an_impossible_speed_are_refused_and_change_nothing),
	    cmocka_unit_test(the_position_goes_on_between_events_and_never_beyond_the_next),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

/* Laws L1, L2, L7, L9: every beam is placed by the tilt and the pose of its own time; what cannot be placed is dropped, counted
 * and named; deadlines are judged by the log time of the next record; nothing depends on a clock. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "core/mixed.h"
#include "core/model.h"
#include "core/sweep.h"
#include "core/trig.h"
#include "tests/real_sweeps.h"

#define MS      1000000LL
#define TURN_NS 13333333
#define BEAM_NS 37037

static struct sweep_params plain_params(void)
{
	return (struct sweep_params){
	    .base_tilt = transform_identity(),
	    .tilt_laser = transform_identity(),
	    .range_min_m = 0.3,
	    .range_max_m = 30,
	    .hold_ns = 30 * MS,
	    .fixed_pose = true,
	    .map_base = transform_identity(),
	};
}

/* 180 degrees in steps of 1 / interlace; everything at `range_m`. */
static struct profile *make_profile(int64_t t_ns, int interlace, float range_m)
{
	static struct profile p;
	p.t_ns = t_ns;
	p.beam_ns = BEAM_NS;
	p.turn_ns = TURN_NS;
	p.interlace = (uint8_t)interlace;
	p.part = 0;
	p.parts = 1;
	p.n = (uint16_t)(180 * interlace + 1);
	p.first_rad = -90 * TRIG_DEG;
	p.step_rad = TRIG_DEG / interlace;
	for (int k = 0; k < p.n; k++) {
		p.range_m[k] = range_m;
		p.state[k] = BEAM_OK;
	}
	return &p;
}

static int64_t time_of_beam(const struct profile *p, int k)
{
	return p->t_ns + k % p->interlace * (int64_t)TURN_NS + k / p->interlace * (int64_t)BEAM_NS;
}

static void add_tilt(struct sweep *s, int64_t t_ns, double rad)
{
	sweep_tilt(s, &(struct tilt){t_ns, rad});
}

static void add_pose(struct sweep *s, int64_t t_ns, double x_m)
{
	sweep_pose(s, &(struct pose){t_ns, {x_m, 0, 0}, {1, 0, 0, 0}, 0, 0, false});
}

static struct row *expect_row(struct sweep *s, int64_t log_ns)
{
	struct row *row = NULL;
	enum sweep_drop drop;
	assert_int_equal(sweep_next(s, log_ns, false, &row, &drop), SWEEP_ROW);
	return row;
}

static void expect_wait(struct sweep *s, int64_t log_ns)
{
	struct row *row;
	enum sweep_drop drop;
	assert_int_equal(sweep_next(s, log_ns, false, &row, &drop), SWEEP_WAIT);
}

static void expect_drop(struct sweep *s, int64_t log_ns, enum sweep_drop why)
{
	struct row *row;
	enum sweep_drop drop;
	struct sweep_stats before, after;
	sweep_stats(s, &before);
	assert_int_equal(sweep_next(s, log_ns, false, &row, &drop), SWEEP_DROPPED);
	assert_int_equal(drop, why);
	sweep_stats(s, &after);
	assert_int_equal(after.dropped[why], before.dropped[why] + 1);
	assert_int_equal(after.rows, before.rows);
}

static double rate = 0.5; /* rad/s of the servo in these tests */

static double tilt_at_time(int64_t t_ns)
{
	return -0.3 + rate * 1e-9 * (double)t_ns;
}

static void feed_tilt(struct sweep *s, int64_t from_ns, int64_t to_ns, int64_t period_ns)
{
	for (int64_t t = from_ns; t <= to_ns; t += period_ns)
		add_tilt(s, t, tilt_at_time(t));
}

/* Where beam k of `p` has to end, for a scanner without lever arms in a base at the origin. */
static void assert_beam_at(const struct row_beam *beam, const struct profile *p, int k, int64_t t_ns)
{
	double bearing = p->first_rad + k * p->step_rad, tilt = tilt_at_time(t_ns), r = (double)p->range_m[k];
	assert_true(fabs(beam->point.x - r * cos(bearing) * cos(tilt)) < 1e-9);
	assert_true(fabs(beam->point.y - r * sin(bearing)) < 1e-9);
	assert_true(fabs(beam->point.z + r * cos(bearing) * sin(tilt)) < 1e-9); /* positive looks down */
}

static void interlaced_beams_have_the_times_of_their_turns(int interlace)
{
	struct sweep_params params = plain_params();
	struct sweep *s = sweep_create(&params);
	struct profile *p = make_profile(100 * MS, interlace, 5);
	feed_tilt(s, 90 * MS, 170 * MS, 5 * MS);
	sweep_profile(s, p, 170 * MS);
	for (int turn = 0; turn < interlace; turn++) {
		struct row *row = expect_row(s, 170 * MS);
		assert_int_equal(row->n, turn == 0 ? 181 : 180);
		assert_int_equal(row->t_ns, time_of_beam(p, turn));
		assert_true(fabs(row->first_rad - (-90 + (double)turn / interlace) * TRIG_DEG) < 1e-12);
		assert_true(fabs(row->step_rad - TRIG_DEG) < 1e-12);
		for (uint32_t i = 0; i < row->n; i++) {
			int k = turn + (int)i * interlace;
			assert_int_equal(row->beam[i].state, BEAM_OK);
			assert_beam_at(&row->beam[i], p, k, time_of_beam(p, k));
		}
		row_destroy(row);
	}
	expect_wait(s, 170 * MS);
	sweep_destroy(s);
}

static void an_interlaced_profile_is_a_row_for_each_turn(void **state)
{
	(void)state;
	interlaced_beams_have_the_times_of_their_turns(1);
	interlaced_beams_have_the_times_of_their_turns(2);
	interlaced_beams_have_the_times_of_their_turns(4);
}

/* Samples at 95 and 135 ms enclose the profile (100 .. 120 ms); the one at 140 ms may be anywhere. */
static uint32_t beams_of_first_row(double span_rad)
{
	struct sweep_params params = plain_params();
	struct sweep *s = sweep_create(&params);
	add_tilt(s, 80 * MS, 0.5);
	add_tilt(s, 95 * MS, 0.1);
	add_tilt(s, 110 * MS, 0.1 + span_rad);
	add_tilt(s, 135 * MS, 0.1 + span_rad / 2);
	add_tilt(s, 140 * MS, 0.7);
	sweep_profile(s, make_profile(100 * MS, 2, 5), 140 * MS);
	struct row *row = expect_row(s, 140 * MS);
	uint32_t n = row->n;
	row_destroy(row);
	sweep_destroy(s);
	return n;
}

static void turns_are_one_row_when_the_servo_stood(void **state)
{
	(void)state;
	assert_int_equal(beams_of_first_row(0), 361);
	assert_int_equal(beams_of_first_row(0.0199 * TRIG_DEG), 361);
	assert_int_equal(beams_of_first_row(0.0201 * TRIG_DEG), 181);
}

/* The pose moves on while the servo stands: beams of the one row still have the times of their turns. */
static void one_row_of_two_turns_keeps_each_beams_time(void **state)
{
	struct sweep_params params = plain_params();
	params.fixed_pose = false;
	params.fixed_tilt = true;
	struct sweep *s = sweep_create(&params);
	struct profile *p = make_profile(100 * MS, 2, 5);
	(void)state;
	for (int64_t t = 90 * MS; t <= 130 * MS; t += 10 * MS)
		add_pose(s, t, 1.5e-9 * (double)t);
	sweep_profile(s, p, 130 * MS);
	struct row *row = expect_row(s, 130 * MS);
	assert_int_equal(row->n, 361);
	for (int k = 0; k < 361; k++)
		assert_true(fabs(row->beam[k].origin.x - 1.5e-9 * (double)time_of_beam(p, k)) < 1e-12);
	row_destroy(row);
	sweep_destroy(s);
}

static void a_partial_scan_is_a_row_with_its_own_bearings(void **state)
{
	struct sweep_params params = plain_params();
	struct sweep *s = sweep_create(&params);
	struct profile *p = make_profile(100 * MS, 1, 5);
	(void)state;
	p->n = 180;
	p->part = 3;
	p->parts = 4;
	p->first_rad += 0.75 * TRIG_DEG;
	feed_tilt(s, 90 * MS, 130 * MS, 5 * MS);
	sweep_profile(s, p, 130 * MS);
	struct row *row = expect_row(s, 130 * MS);
	assert_int_equal(row->n, 180);
	assert_true(row->first_rad == p->first_rad);
	assert_beam_at(&row->beam[17], p, 17, time_of_beam(p, 17));
	row_destroy(row);
	expect_wait(s, 130 * MS);
	sweep_destroy(s);
}

/* Partial scan `part` of a quarter degree, one turn after the other. */
static struct profile *make_part(int part, int64_t t_ns)
{
	struct profile *p = make_profile(t_ns + part * TURN_NS, 1, 5 + 0.01f * (float)part);
	p->n = part == 0 ? 181 : 180;
	p->part = (uint8_t)part;
	p->parts = 4;
	p->first_rad += part * 0.25 * TRIG_DEG;
	return p;
}

static struct sweep *on_a_moving_robot(void)
{
	struct sweep_params params = plain_params();
	params.fixed_pose = false;
	struct sweep *s = sweep_create(&params);
	for (int64_t t = 0; t <= 300 * MS; t += 10 * MS)
		add_pose(s, t, 1.5e-9 * (double)t);
	return s;
}

static void partial_scans_are_one_row_when_the_servo_stood(void **state)
{
	struct sweep *s = on_a_moving_robot();
	(void)state;
	for (int64_t t = 90 * MS; t <= 160 * MS; t += 5 * MS)
		add_tilt(s, t, 0.25);
	add_tilt(s, 165 * MS, 0.5); /* it moves on, but only afterwards */
	for (int part = 0; part < 4; part++) {
		expect_wait(s, 150 * MS);
		sweep_profile(s, make_part(part, 100 * MS), 150 * MS);
	}
	struct row *row = expect_row(s, 150 * MS);
	assert_int_equal(row->n, 721);
	assert_true(fabs(row->step_rad - 0.25 * TRIG_DEG) < 1e-12);
	for (int i = 0; i < 721; i++) {
		double time_s = 0.1 + i % 4 * 1e-9 * TURN_NS + i / 4 * 1e-9 * BEAM_NS,
		       bearing = (-90 + 0.25 * i) * TRIG_DEG;
		assert_true(fabs(row->beam[i].origin.x - 1.5 * time_s) < 1e-9);
		assert_true(row->beam[i].range_m == 5 + 0.01f * (float)(i % 4));
		assert_true(fabs(row->beam[i].point.y - (double)row->beam[i].range_m * sin(bearing)) < 1e-9);
	}
	row_destroy(row);
	expect_wait(s, 150 * MS);
	sweep_destroy(s);
}

static void expect_parts_alone(struct sweep *s, int n, int64_t log_ns)
{
	for (int i = 0; i < n; i++) {
		struct row *row = expect_row(s, log_ns);
		assert_true(row->n <= 181);
		row_destroy(row);
	}
	expect_wait(s, log_ns);
}

static void partial_scans_do_not_wait_for_one_that_was_lost(void **state)
{
	struct sweep *s = on_a_moving_robot();
	(void)state;
	for (int64_t t = 90 * MS; t <= 300 * MS; t += 5 * MS)
		add_tilt(s, t, 0.25);
	sweep_profile(s, make_part(0, 100 * MS), 110 * MS);
	sweep_profile(s, make_part(1, 100 * MS), 123 * MS);
	expect_wait(s, 124 * MS);
	sweep_profile(s, make_part(3, 100 * MS), 150 * MS);
	expect_parts_alone(s, 3, 150 * MS);
	sweep_profile(s, make_part(0, 200 * MS), 210 * MS);
	expect_wait(s, 210 * MS + 30 * MS + 4 * TURN_NS - 1);
	expect_parts_alone(s, 1, 210 * MS + 30 * MS + 4 * TURN_NS);
	sweep_destroy(s);
}

static void partial_scans_do_not_wait_once_the_servo_moves(void **state)
{
	struct sweep *s = on_a_moving_robot();
	(void)state;
	for (int64_t t = 90 * MS; t <= 120 * MS; t += 5 * MS)
		add_tilt(s, t, 0.25);
	sweep_profile(s, make_part(0, 100 * MS), 110 * MS);
	expect_wait(s, 121 * MS);
	add_tilt(s, 125 * MS, 0.26);
	expect_parts_alone(s, 1, 125 * MS);
	sweep_destroy(s);
}

/* A raster too wide for a row, and one whose parts are of most unequal length. */
static void partial_scans_that_do_not_fit_a_row_stay_alone(void **state)
{
	struct sweep *s = on_a_moving_robot();
	(void)state;
	for (int64_t t = 90 * MS; t <= 300 * MS; t += 5 * MS)
		add_tilt(s, t, 0.25);
	for (int part = 0; part < 4; part++) {
		struct profile *p = make_part(part, 100 * MS);
		if (part == 1)
			p->n = 513;
		sweep_profile(s, p, 150 * MS);
	}
	for (int i = 0; i < 4; i++)
		row_destroy(expect_row(s, 300 * MS));
	expect_wait(s, 300 * MS);
	sweep_destroy(s);
}

static void a_profile_waits_for_samples_behind_its_last_beam(void **state)
{
	struct sweep_params params = plain_params();
	params.fixed_pose = false;
	struct sweep *s = sweep_create(&params);
	int64_t last = 100 * MS + 180 * BEAM_NS;
	(void)state;
	sweep_profile(s, make_profile(100 * MS, 1, 5), 110 * MS);
	expect_wait(s, 110 * MS);
	feed_tilt(s, 95 * MS, 105 * MS, 5 * MS);
	add_pose(s, 90 * MS, 0);
	expect_wait(s, 111 * MS);
	add_tilt(s, last, 0);
	expect_wait(s, 112 * MS);
	add_pose(s, last - 1, 0);
	expect_wait(s, 113 * MS);
	add_pose(s, last, 0);
	row_destroy(expect_row(s, 114 * MS));
	sweep_destroy(s);
}

static void hold_is_judged_by_the_log_time_of_the_next_record(void **state)
{
	struct sweep_params params = plain_params();
	struct sweep *s = sweep_create(&params);
	(void)state;
	/* Samples every 5 ms up to 105: the last beam at 106.7 is 1.7 ms beyond, within 1.5 periods. */
	feed_tilt(s, 50 * MS, 105 * MS, 5 * MS);
	struct profile *p = make_profile(100 * MS, 1, 5);
	sweep_profile(s, p, 200 * MS);
	expect_wait(s, 200 * MS);
	expect_wait(s, 230 * MS - 1);
	struct row *row = expect_row(s, 230 * MS);
	assert_beam_at(&row->beam[180], p, 180, time_of_beam(p, 180));
	row_destroy(row);
	sweep_destroy(s);
}

static void nothing_is_waited_for_at_the_end_of_an_input(void **state)
{
	struct sweep_params params = plain_params();
	struct sweep *s = sweep_create(&params);
	struct row *row;
	enum sweep_drop drop;
	(void)state;
	feed_tilt(s, 50 * MS, 105 * MS, 5 * MS);
	for (int i = 0; i < 2; i++)
		sweep_profile(s, make_profile(100 * MS, 1, 5), 200 * MS);
	for (int i = 0; i < 2; i++) {
		assert_int_equal(sweep_next(s, 200 * MS, true, &row, &drop), SWEEP_ROW);
		assert_int_equal(row->ends_sweep, i == 1);
		row_destroy(row);
	}
	assert_int_equal(sweep_next(s, 200 * MS, true, &row, &drop), SWEEP_WAIT);
	sweep_destroy(s);
}

/* Tilt samples every 5 ms (one pause of 20 ms, one burst) until `beyond` before the last beam. */
static struct sweep *after_late_tilt(int64_t beyond_ns)
{
	struct sweep_params params = plain_params();
	struct sweep *s = sweep_create(&params);
	int64_t last = 100 * MS + 180 * BEAM_NS, newest = last - beyond_ns;
	feed_tilt(s, newest - 70 * MS, newest - 50 * MS, 5 * MS);
	feed_tilt(s, newest - 31 * MS, newest - 30 * MS, MS);
	feed_tilt(s, newest - 25 * MS, newest, 5 * MS);
	sweep_profile(s, make_profile(100 * MS, 1, 5), 110 * MS);
	return s;
}

static void the_tilt_goes_on_for_one_and_a_half_periods(void **state)
{
	(void)state;
	struct sweep *s = after_late_tilt(7500000);
	row_destroy(expect_row(s, 140 * MS));
	sweep_destroy(s);
	s = after_late_tilt(7500001);
	expect_wait(s, 139 * MS);
	expect_drop(s, 140 * MS, SWEEP_STALE_TILT);
	expect_wait(s, 141 * MS);
	sweep_destroy(s);
}

/* Who was silent for longer than a profile may wait may have turned round meanwhile; who stands where it stood has not. */
static void angles_are_not_joined_over_a_long_silence(void **state)
{
	static const struct {
		int64_t gap_ns;
		double turned_rad;
		bool joined;
	} known[] = {{30 * MS, 0.1, true},
	             {37 * MS, 0.1, true},
	             {38 * MS, 0.1, false},
	             {5000 * MS, 0.1, false},
	             {5000 * MS, 0.0003, true}};
	struct sweep_params params = plain_params();

	(void)state;
	assert_int_equal(params.hold_ns, 30 * MS);
	for (size_t i = 0; i < sizeof known / sizeof known[0]; i++) {
		struct sweep *s = sweep_create(&params);
		int64_t t_ns = 10000 * MS, end_ns = t_ns + 180 * BEAM_NS;

		for (int k = 20; k >= 0; k--)
			add_tilt(s, end_ns + MS - known[i].gap_ns - 5 * k * MS, 0);
		sweep_profile(s, make_profile(t_ns, 1, 5), end_ns);
		add_tilt(s, end_ns + MS, known[i].turned_rad);
		if (known[i].joined)
			row_destroy(expect_row(s, end_ns + MS));
		else
			expect_drop(s, end_ns + MS, SWEEP_STALE_TILT);
		sweep_destroy(s);
	}
}

static void the_pose_goes_on_for_50_ms_with_its_last_twist(void **state)
{
	struct sweep_params params = plain_params();
	params.fixed_pose = false;
	params.fixed_tilt = true;
	int64_t last = 100 * MS + 180 * BEAM_NS;
	(void)state;
	for (int64_t late = 0; late < 2; late++) {
		struct sweep *s = sweep_create(&params);
		int64_t newest = last - 50 * MS - late;
		struct profile *p = make_profile(100 * MS, 1, 5);
		double yaw = 0.01; /* rad in the last 10 ms */
		sweep_pose(s, &(struct pose){newest - 10 * MS, {1, 0, 0}, {1, 0, 0, 0}, 0, 0, false});
		sweep_pose(s, &(struct pose){newest, {1.02, 0, 0}, {cos(yaw / 2), 0, 0, sin(yaw / 2)}, 0, 0, false});
		sweep_profile(s, p, 110 * MS);
		if (late) {
			expect_drop(s, 140 * MS, SWEEP_STALE_POSE);
		} else {
			struct row *row = expect_row(s, 140 * MS);
			struct vec3 v = vec3_sub(row->beam[180].point, row->beam[180].origin);
			assert_true(fabs(row->beam[180].origin.x - 1.12) < 1e-9);
			assert_true(fabs(trig_atan2(v.y, v.x) - (90 * TRIG_DEG + 0.06)) <
			            1e-4); /* a tenth of a millimetre a metre */
			row_destroy(row);
		}
		sweep_destroy(s);
	}
}

static void rows_without_samples_are_dropped_with_their_reason(void **state)
{
	struct sweep_params params = plain_params();
	params.fixed_pose = false;
	struct sweep *s = sweep_create(&params);
	(void)state;
	sweep_profile(s, make_profile(100 * MS, 2, 5), 130 * MS);
	expect_wait(s, 130 * MS);
	expect_drop(s, 160 * MS, SWEEP_NO_TILT); /* a row for each turn: nothing says that the servo stood */
	expect_drop(s, 160 * MS, SWEEP_NO_TILT);
	expect_wait(s, 160 * MS);
	feed_tilt(s, 150 * MS, 250 * MS, 5 * MS);
	sweep_profile(s, make_profile(160 * MS, 1, 5), 180 * MS);
	expect_drop(s, 210 * MS, SWEEP_NO_POSE);
	/* Samples that begin after the first beam do not help it. */
	add_pose(s, 201 * MS, 0);
	add_pose(s, 250 * MS, 0);
	sweep_profile(s, make_profile(200 * MS, 1, 5), 220 * MS);
	expect_drop(s, 220 * MS, SWEEP_NO_POSE);
	sweep_profile(s, make_profile(140 * MS, 1, 5), 220 * MS);
	expect_drop(s, 220 * MS, SWEEP_NO_TILT);
	for (int i = 0; i < SWEEP_DROPS; i++)
		assert_true(strlen(sweep_drop_name((enum sweep_drop)i)) > 3);
	sweep_destroy(s);
}

static void the_oldest_profile_gives_way_when_too_many_wait(void **state)
{
	struct sweep_params params = plain_params();
	struct sweep *s = sweep_create(&params);
	struct row *row;
	(void)state;
	for (int i = 0; i < SWEEP_PROFILES_WAITING_MAX + 2; i++)
		sweep_profile(s, make_profile(i * 100 * MS, 2, 5), 0);
	for (int i = 0; i < 4; i++) /* two profiles of two turns */
		expect_drop(s, 0, SWEEP_OVERFLOW);
	feed_tilt(s, 0, 7000 * MS, 10 * MS);
	row = expect_row(s, 0);
	assert_int_equal(row->t_ns, 200 * MS);
	row_destroy(row);
	sweep_destroy(s);
}

static void samples_out_of_order_are_ignored_until_time_was_set_back(void **state)
{
	struct sweep_params params = plain_params();
	struct sweep *s = sweep_create(&params);
	(void)state;
	add_tilt(s, 10000 * MS, 0.25);
	add_tilt(s, 9990 * MS, 0.75);  /* older: ignored */
	add_tilt(s, 10000 * MS, 0.75); /* the same instant: ignored */
	add_tilt(s, 10020 * MS, 0.25);
	sweep_profile(s, make_profile(10000 * MS, 1, 5), 0);
	struct row *row = expect_row(s, 0);
	assert_true(row->tilt_rad == 0.25);
	row_destroy(row);
	add_tilt(s, 1000 * MS, 0.5); /* seconds older: the device began anew */
	add_tilt(s, 1020 * MS, 0.5);
	sweep_profile(s, make_profile(1000 * MS, 1, 5), 0);
	row = expect_row(s, 0);
	assert_true(row->tilt_rad == 0.5);
	row_destroy(row);
	sweep_destroy(s);
}

/* A ring keeps the newest samples, however many came. */
static void old_samples_give_way(void **state)
{
	struct sweep_params params = plain_params();
	struct sweep *s = sweep_create(&params);
	struct profile *p = make_profile(19900 * MS, 1, 5);
	(void)state;
	feed_tilt(s, 0, 20000 * MS, MS);
	sweep_profile(s, p, 0);
	struct row *row = expect_row(s, 0);
	assert_beam_at(&row->beam[100], p, 100, time_of_beam(p, 100));
	row_destroy(row);
	sweep_profile(s, make_profile(0, 1, 5), 0);
	expect_drop(s, 0, SWEEP_NO_TILT);
	sweep_destroy(s);
}

static void lever_arms_are_part_of_the_chain(void **state)
{
	struct sweep_params params = plain_params();
	params.base_tilt = transform_rpy((struct vec3){0.2, 0.1, 0.4}, (struct vec3){0.02, 0.3, -0.1});
	params.tilt_laser = transform_rpy((struct vec3){0.03, -0.01, 0.05}, (struct vec3){0.01, 0, 0.2});
	params.map_base = transform_rpy((struct vec3){7, -3, 0.5}, (struct vec3){0, 0.1, 2});
	struct sweep *s = sweep_create(&params);
	struct profile *p = make_profile(100 * MS, 1, 4);
	(void)state;
	feed_tilt(s, 90 * MS, 120 * MS, 5 * MS);
	sweep_profile(s, p, 0);
	struct row *row = expect_row(s, 0);
	for (int k = 0; k < p->n; k++) {
		struct transform tilt = transform_tilt(tilt_at_time(time_of_beam(p, k)));
		struct transform t = transform_compose(&params.map_base, &params.base_tilt);
		t = transform_compose(&t, &tilt);
		t = transform_compose(&t, &params.tilt_laser);
		double bearing = p->first_rad + k * p->step_rad;
		struct vec3 point = transform_point(&t, (struct vec3){4 * cos(bearing), 4 * sin(bearing), 0});
		assert_true(vec3_norm(vec3_sub(point, row->beam[k].point)) < 1e-9);
		assert_true(vec3_norm(vec3_sub(t.t, row->beam[k].origin)) < 1e-9);
	}
	row_destroy(row);
	sweep_destroy(s);
}

static void ranges_masks_and_the_robot_are_left_out(void **state)
{
	struct sweep_params params = plain_params();
	params.range_min_m = 0.7;
	params.masks = 1;
	params.mask[0].from_rad = 30 * TRIG_DEG;
	params.mask[0].to_rad = 40 * TRIG_DEG;
	params.has_box = true;
	params.box_min = (struct vec3){-1, -2, -1};
	params.box_max = (struct vec3){1, -0.5, 1};
	params.map_base = transform_rpy((struct vec3){50, 0, 0}, (struct vec3){0, 0, 1}); /* the box is the base's */
	params.fixed_tilt = true;
	struct sweep *s = sweep_create(&params);
	struct profile *p = make_profile(0, 1, 1.2f);
	(void)state;
	p->range_m[150] = 0.7f; /* exactly the limit, as a float */
	p->range_m[151] = 0.69f;
	p->range_m[152] = 30;
	p->range_m[153] = 30.01f;
	p->range_m[154] = NAN;
	p->state[155] = BEAM_DAZZLED;
	p->state[125] = BEAM_WEAK; /* in the mask, but the device has said why */
	sweep_profile(s, p, 0);
	struct row *row = expect_row(s, 0);
	struct sweep_stats stats;
	sweep_stats(s, &stats);
	assert_int_equal(row->beam[150].state, BEAM_OK);
	assert_int_equal(row->beam[151].state, BEAM_OUT_OF_RANGE);
	assert_int_equal(row->beam[152].state, BEAM_OK);
	assert_int_equal(row->beam[153].state, BEAM_OUT_OF_RANGE);
	assert_int_equal(row->beam[154].state, BEAM_OUT_OF_RANGE);
	assert_int_equal(row->beam[155].state, BEAM_DAZZLED);
	assert_int_equal(row->beam[125].state, BEAM_WEAK);
	assert_int_equal(row->beam[119].state, BEAM_OK);
	assert_int_equal(row->beam[120].state, BEAM_MASKED);
	assert_int_equal(row->beam[130].state, BEAM_MASKED);
	assert_int_equal(row->beam[131].state, BEAM_OK);
	for (int k = 0; k < 100; k++) {
		double b = (k - 90) * TRIG_DEG, x = 1.2 * cos(b), y = 1.2 * sin(b);
		assert_int_equal(row->beam[k].state, x <= 1 && y <= -0.5 ? BEAM_SELF : BEAM_OK);
	}
	assert_int_equal(stats.beams[BEAM_MASKED], 10);
	assert_int_equal(stats.beams[BEAM_OUT_OF_RANGE], 3);
	assert_true(stats.beams[BEAM_SELF] > 20);
	row_destroy(row);
	sweep_destroy(s);
}

/* Rows at the angles of `angle` (degrees); which of them begin a sweep, as a string of 0 and 1. */
static void starts_at(const double *angle_deg, int n, char *ret)
{
	struct sweep_params params = plain_params();
	struct sweep *s = sweep_create(&params);
	for (int i = 0; i < n; i++) {
		add_tilt(s, i * 100 * MS, angle_deg[i] * TRIG_DEG);
		add_tilt(s, i * 100 * MS + 50 * MS, angle_deg[i] * TRIG_DEG);
		sweep_profile(s, make_profile(i * 100 * MS, 1, 5), 0);
		struct row *row = expect_row(s, 0);
		ret[i] = row->starts_sweep ? '1' : '0';
		row_destroy(row);
	}
	ret[n] = 0;
	sweep_destroy(s);
}

static void a_sweep_begins_where_the_servo_turns(void **state)
{
	char starts[32];
	(void)state;
	starts_at((double[]){0, 1, 2, 3, 2, 1, 0, 1, 2}, 9, starts);
	assert_string_equal(starts, "100010010");
	/* Noise of less than 0.1 degree is no turn, also where the servo creeps or stands. */
	starts_at((double[]){0, 0.5, 0.45, 1, 1.02, 0.95, 0.93, 1.5, 1.42, 1.9}, 10, starts);
	assert_string_equal(starts, "1000000000");
	/* Back by more than that, in steps that are smaller. */
	starts_at((double[]){0, 1, 2, 1.95, 1.91, 1.89, 1.8, 1.7}, 8, starts);
	assert_string_equal(starts, "10000100");
	/* A fly-back of one row and the sweep after it: one new sweep, not two. */
	starts_at((double[]){60, 60.5, 61, -48, -47.5, -47, -46.5}, 7, starts);
	assert_string_equal(starts, "1001000");
	/* A gap where rows were dropped: no surface across it. */
	starts_at((double[]){0, 1, 2, 9, 10, 11}, 6, starts);
	assert_string_equal(starts, "100100");
}

static void a_sweep_of_a_servo_that_stands_ends_after_2048_rows(void **state)
{
	struct sweep_params params = plain_params();
	params.fixed_tilt = true;
	struct sweep *s = sweep_create(&params);
	(void)state;
	for (int i = 0; i < 5000; i++) {
		sweep_profile(s, make_profile(i * 10 * MS, 1, 5), 0);
		struct row *row = expect_row(s, 0);
		assert_int_equal(row->starts_sweep, i % 2048 == 0);
		row_destroy(row);
	}
	struct sweep_stats stats;
	sweep_stats(s, &stats);
	assert_int_equal(stats.sweeps, 3);
	assert_int_equal(stats.rows, 5000);
	sweep_destroy(s);
}

static void a_robot_that_went_on_meanwhile_begins_a_sweep(void **state)
{
	struct sweep_params params = plain_params();
	params.fixed_tilt = true;
	params.fixed_pose = false;
	struct sweep *s = sweep_create(&params);
	static const double x_m[] = {0, 0.4, 0.8, 1.4, 1.5};
	static const bool starts[] = {true, false, false, true, false};
	(void)state;
	for (int i = 0; i < 5; i++) {
		add_pose(s, i * 1000 * MS, x_m[i]);
		add_pose(s, i * 1000 * MS + 20 * MS, x_m[i]);
		sweep_profile(s, make_profile(i * 1000 * MS, 1, 5), 0);
		struct row *row = expect_row(s, 0);
		assert_int_equal(row->starts_sweep, starts[i]);
		row_destroy(row);
	}
	sweep_destroy(s);
}

/* A corridor 2.4 m wide along y = +-1.2 with an end at 28 m, seen from its middle: no beam may be lost. */
static void walls_of_a_corridor_are_not_mixed(void **state)
{
	static const double steps[] = {0.25, 0.5, 1};
	(void)state;
	for (int c = 0; c < 3; c++) {
		float range[721];
		uint8_t states[721] = {0};
		uint32_t n = (uint32_t)lround(180 / steps[c]) + 1;
		int jumps = 0;
		uint64_t seed = 5;
		for (uint32_t k = 0; k < n; k++) {
			double b = (k * steps[c] - 90) * TRIG_DEG;
			double r = fmin(1.2 / fmax(fabs(sin(b)), 1e-9), 28 / fmax(cos(b), 1e-9));
			seed = seed * 6364136223846793005u + 1442695040888963407u;
			range[k] = (float)(r + 0.01 * ((double)(seed >> 40) * 0x1p-24 - 0.5));
		}
		mixed_mark(range, states, n, steps[c] * TRIG_DEG);
		for (uint32_t k = 1; k + 1 < n; k++) {
			jumps += fabsf(range[k] - range[k - 1]) > 0.2f && fabsf(range[k] - range[k + 1]) > 0.2f;
			/* But for the few where wall and end meet. */
			double b = fabs((k * steps[c] - 90) * TRIG_DEG), corner = atan2(1.2, 28);
			if (fabs(b - corner) > 1.5 * steps[c] * TRIG_DEG)
				assert_int_equal(states[k], BEAM_OK);
		}
		assert_true(jumps > 5); /* they do jump */
	}
}

static void mark(const float *range, const uint8_t *given, uint32_t n, char *ret)
{
	uint8_t states[32] = {0};
	if (given)
		memcpy(states, given, n);
	mixed_mark(range, states, n, 0.5 * TRIG_DEG);
	for (uint32_t i = 0; i < n; i++)
		ret[i] = states[i] == BEAM_MIXED ? 'm' : states[i] == BEAM_OK ? '.' : 'x';
	ret[n] = 0;
}

static void a_beam_that_jumps_to_both_valid_neighbours_is_mixed(void **state)
{
	char marks[33];
	(void)state;
	mark((float[]){2, 2, 2, 3.1f, 4, 4, 4}, NULL, 7, marks); /* between an edge and the wall behind */
	assert_string_equal(marks, "...m...");
	mark((float[]){2, 2, 2, 1.5f, 2, 2, 2}, NULL, 7, marks); /* alone before a wall */
	assert_string_equal(marks, "...m...");
	mark((float[]){2, 2, 2, 2.15f, 4, 4, 4}, NULL, 7, marks); /* near enough to one side */
	assert_string_equal(marks, ".......");
	mark((float[]){2, 2, 2, 3.1f, 4, 4, 4}, (uint8_t[]){0, 0, BEAM_WEAK, 0, 0, 0, 0}, 7, marks);
	assert_string_equal(marks, "..x....");    /* a missing neighbour is no evidence */
	mark((float[]){3, 2, 2}, NULL, 3, marks); /* nor is the end of the fan */
	assert_string_equal(marks, "...");
	mark((float[]){2, 3, 4.1f, 2, 3.3f, 5, 5}, NULL, 7, marks); /* mixed beams side by side: all of them */
	assert_string_equal(marks, ".mmmm..");
	mark(NULL, NULL, 0, marks);
	mark((float[]){1}, NULL, 1, marks);
	assert_string_equal(marks, ".");
}

static void add_scan(struct sweep *s, const struct uos_scan *scan, double moving_rad, double *ret_us)
{
	static struct profile p;
	struct timespec begin, end;
	clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &begin);
	for (uint32_t i = 0; i < scan->rows; i++) {
		p = (struct profile){.t_ns = i * 100 * MS,
		                     .beam_ns = BEAM_NS / 2,
		                     .interlace = 1,
		                     .n = (uint16_t)scan->row[i].n,
		                     .first_rad = scan->row[i].first_rad,
		                     .step_rad = scan->row[i].step_rad};
		memcpy(p.range_m, scan->row[i].range_m, p.n * sizeof *p.range_m);
		memcpy(p.state, scan->row[i].state, p.n);
		add_tilt(s, p.t_ns, scan->row[i].tilt_rad);
		add_tilt(s, p.t_ns + 20 * MS, scan->row[i].tilt_rad + moving_rad);
		sweep_profile(s, &p, 0);
		row_destroy(expect_row(s, 0));
	}
	clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &end);
	*ret_us =
	    ((double)(end.tv_sec - begin.tv_sec) * 1e9 + (double)(end.tv_nsec - begin.tv_nsec)) / 1e3 / scan->rows;
}

static int candidates(const struct uos_scan *scan)
{
	int n = 0;
	for (uint32_t i = 0; i < scan->rows; i++) {
		const float *r = scan->row[i].range_m;
		for (uint32_t k = 1; k + 1 < scan->row[i].n; k++)
			n += scan->row[i].state[k] == BEAM_OK && fabsf(r[k] - r[k - 1]) > 0.2f &&
			     fabsf(r[k] - r[k + 1]) > 0.2f;
	}
	return n;
}

static void real_sweeps_have_the_beams_that_are_written_down(void **state)
{
	static const int usable[] = {77887, 78262, 77934}, invalid_per_myriad[] = {184, 162, 211};
	static const double mixed_percent[] = {2.8, 2.3, 2.4};
	(void)state;
	for (int i = 0; i < REAL_SWEEPS; i++) {
		size_t len = 0;
		uint8_t *data = real_scan(i, &len);
		struct uos_scan scan;
		struct parse_error error;
		struct sweep_params params = plain_params();
		struct sweep_stats stats;
		if (!data) {
			print_message("the real sweeps (../shared/data/kurt3d) are not here\n");
			skip();
		}
		assert_int_equal(uos_read(data, len, &scan, &error), 0);
		struct sweep *s = sweep_create(&params);
		double stood_us, moved_us;
		add_scan(s, &scan, 0, &stood_us);
		sweep_stats(s, &stats);
		int invalid = 0;
		for (uint32_t r = 0; r < scan.rows; r++)
			for (uint32_t k = 0; k < scan.row[r].n; k++)
				invalid +=
				    (scan.row[r].state[k] != BEAM_OK && scan.row[r].state[k] != BEAM_OUT_OF_RANGE) ||
				    scan.row[r].range_m[k] > 30;
		int cells = (int)(scan.rows * scan.row[0].n);
		assert_int_equal(stats.beams[BEAM_OK] + stats.beams[BEAM_MIXED], usable[i]);
		assert_int_equal((invalid * 10000 + cells / 2) / cells, invalid_per_myriad[i]);
		assert_true(fabs(100.0 * candidates(&scan) / cells - mixed_percent[i]) < 0.1);
		assert_int_equal(stats.sweeps, 1);
		sweep_destroy(s);
		s = sweep_create(&params);
		add_scan(s, &scan, 0.005, &moved_us);
		printf("note: sweep %d: %.2f %% mixed, %.1f us a profile standing, %.1f moving\n", i,
		       100.0 * (double)stats.beams[BEAM_MIXED] / cells, stood_us, moved_us);
		sweep_destroy(s);
		uos_finish(&scan);
		free(data);
	}
}

/* Poses at 100 Hz along x at 1 m/s from `from_ms`; at `jump_ms` the map is moved by 5 m, and so is what follows. */
static void feed_jumping_poses(struct sweep *s, int from_ms, int to_ms, int jump_ms)
{
	for (int t = from_ms; t <= to_ms; t += 10)
		sweep_pose(s, &(struct pose){.t_ns = t * MS,
		                             .position_m = {0.001 * t + (t >= jump_ms ? 5 : 0), 0, 0},
		                             .rotation = {.w = 1},
		                             .jumped = t == jump_ms});
}

static struct sweep *open_moving(void)
{
	struct sweep_params params = plain_params();

	params.fixed_pose = false;
	params.fixed_tilt = true;
	return sweep_create(&params);
}

/* A profile takes 6.7 ms. The frame changes at 200 ms. */
static void nothing_is_interpolated_across_a_jump(void **state)
{
	struct sweep *s = open_moving();
	struct row *row;

	(void)state;
	feed_jumping_poses(s, 100, 300, 200);
	/* Before the jump; between the last pose before it and the jump; across it; after it. */
	static const int begin_ms[] = {170, 192, 197, 203}, frame[] = {0, 0, 0, 1};
	for (int i = 0; i < 4; i++) {
		struct profile *p = make_profile(begin_ms[i] * MS, 1, 5);
		sweep_profile(s, p, 300 * MS);
		row = expect_row(s, 300 * MS);
		for (uint32_t k = 0; k < row->n; k++) {
			const double t_s = 1e-9 * (double)time_of_beam(p, (int)k);
			assert_true(fabs(row->beam[k].origin.x - t_s - 5 * frame[i]) < 1e-9);
		}
		assert_int_equal(row->starts_sweep, i == 0 || i == 3); /* no surface is spanned between the frames */
		row_destroy(row);
	}
	sweep_destroy(s);
}

static void a_row_too_far_beyond_the_last_pose_of_its_frame_is_dropped(void **state)
{
	struct sweep *s = open_moving();

	(void)state;
	feed_jumping_poses(s, 100, 130, 1000);
	feed_jumping_poses(s, 200, 300, 200);
	sweep_profile(s, make_profile(170 * MS, 1, 5), 300 * MS);
	row_destroy(expect_row(s, 300 * MS)); /* its last beam is 47 ms behind the pose */
	sweep_profile(s, make_profile(177 * MS, 1, 5), 300 * MS);
	expect_drop(s, 300 * MS, SWEEP_STALE_POSE);
	sweep_destroy(s);
}

/* The twist behind a jump is none until the frame has two poses. */
static void a_jump_is_no_speed(void **state)
{
	struct sweep *s = open_moving();
	struct row *row;

	(void)state;
	feed_jumping_poses(s, 100, 200, 200);
	sweep_profile(s, make_profile(210 * MS, 1, 5), 210 * MS);
	expect_wait(s, 230 * MS);
	row = expect_row(s, 240 * MS);
	assert_true(fabs(row->beam[180].origin.x - 5.2) < 1e-9);
	row_destroy(row);
	sweep_destroy(s);
}

static void what_was_measured_before_a_new_map_is_dropped(void **state)
{
	struct sweep *s = open_moving();
	struct row *row;

	(void)state;
	feed_jumping_poses(s, 100, 190, 1000);
	sweep_profile(s, make_profile(185 * MS, 1, 5), 195 * MS); /* its last beam is at 191.7 */
	sweep_profile(s, make_profile(197 * MS, 1, 5), 205 * MS); /* across the jump */
	expect_wait(s, 206 * MS);
	feed_jumping_poses(s, 200, 200, 200);
	row = expect_row(s, 207 * MS); /* complete with the jump: the old map's last one */
	row_destroy(row);
	expect_wait(s, 207 * MS);
	sweep_new_map(s);
	feed_jumping_poses(s, 210, 300, 200);
	expect_drop(s, 210 * MS, SWEEP_BEFORE_JUMP);
	sweep_profile(s, make_profile(215 * MS, 1, 5), 230 * MS);
	row = expect_row(s, 230 * MS);
	assert_true(row->starts_sweep);
	row_destroy(row);
	sweep_destroy(s);
}

/* A silence of the pose is not filled, unless the robot stood. */
static void a_long_silence_of_the_pose_is_not_interpolated(void **state)
{
	(void)state;
	for (int moves = 0; moves < 2; moves++) {
		struct sweep *s = open_moving();

		add_pose(s, 100 * MS, 0);
		add_pose(s, 110 * MS, 0);
		sweep_profile(s, make_profile(400 * MS, 1, 5), 641 * MS);
		add_pose(s, 641 * MS, moves ? 0.1 : 0.01); /* 531 ms: 500 and `hold` */
		if (moves)
			expect_drop(s, 641 * MS, SWEEP_STALE_POSE);
		else
			row_destroy(expect_row(s, 641 * MS));
		sweep_destroy(s);
	}
	struct sweep *s = open_moving();
	add_pose(s, 110 * MS, 0);
	sweep_profile(s, make_profile(400 * MS, 1, 5), 639 * MS);
	add_pose(s, 639 * MS, 0.1);
	row_destroy(expect_row(s, 639 * MS));
	sweep_destroy(s);
}

static void rows_are_dropped_while_the_pose_is_less_certain_than_trusted(void **state)
{
	struct sweep_params params = plain_params();
	struct sweep *s;

	(void)state;
	params.fixed_pose = false;
	params.fixed_tilt = true;
	params.trust_m = 0.1;
	s = sweep_create(&params);
	for (int t = 100; t < 400; t += 10) /* sigma 0.05, then 0.2, then 0.1 */
		sweep_pose(s, &(struct pose){.t_ns = t * MS,
		                             .rotation = {.w = 1},
		                             .variance_m2 = t < 200   ? 0.0025
		                                            : t < 300 ? 0.04
		                                                      : 0.01});
	sweep_profile(s, make_profile(150 * MS, 1, 5), 400 * MS);
	row_destroy(expect_row(s, 400 * MS));
	sweep_profile(s, make_profile(197 * MS, 1, 5), 400 * MS);
	expect_drop(s, 400 * MS, SWEEP_UNCERTAIN_POSE);
	sweep_profile(s, make_profile(250 * MS, 1, 5), 400 * MS);
	expect_drop(s, 400 * MS, SWEEP_UNCERTAIN_POSE);
	sweep_profile(s, make_profile(305 * MS, 1, 5), 400 * MS);
	row_destroy(expect_row(s, 400 * MS));
	sweep_destroy(s);
}

/* `profile: step`: 50 ms at each angle, 20 ms to the next one. */
static double step_at(int t_ms)
{
	const int n = t_ms / 70, in = t_ms % 70;

	return 0.01 * (n + (in > 50 ? (in - 50) / 20.0 : 0));
}

static void a_profile_during_which_the_servo_moved_is_dropped_in_step_mode(void **state)
{
	(void)state;
	for (int step = 0; step < 2; step++) {
		struct sweep_params params = plain_params();
		struct sweep_stats stats;
		struct sweep *s;
		int rows = 0, dropped = 0;

		params.step = step;
		s = sweep_create(&params);
		for (int t = 0, next = 20; t < 2000; t++) {
			add_tilt(s, t * MS, step_at(t));
			if (t == next) {
				struct row *row = NULL;
				enum sweep_drop drop;
				enum sweep_verdict verdict;
				const int begin =
				    t - 8; /* 6.7 ms of beams, and the servo stood or not from before to after */

				sweep_profile(s, make_profile(begin * MS, 1, 5), t * MS);
				verdict = sweep_next(s, t * MS, false, &row, &drop);
				const bool stood = step_at(begin) == step_at(begin + 7);
				if (step && !stood) {
					assert_int_equal(verdict, SWEEP_DROPPED);
					assert_int_equal(drop, SWEEP_MOVED);
					dropped++;
				} else {
					assert_int_equal(verdict, SWEEP_ROW);
					assert_true(!stood || fabs(row->tilt_rad - step_at(begin)) < 1e-12);
					row_destroy(row);
					rows++;
				}
				next += 13;
			}
		}
		sweep_stats(s, &stats);
		assert_int_equal(stats.dropped[SWEEP_MOVED], dropped);
		assert_int_equal(stats.rows, rows);
		assert_true(step ? dropped > 40 && rows > 80 : dropped == 0);
		sweep_destroy(s);
	}
}

/* The servo's bus is down for half a second and the servo has stood meanwhile, or gone on a little: rows on both sides are
 * no neighbours. */
static void a_tilt_that_was_lost_cuts_the_raster(void **state)
{
	(void)state;
	for (int gap = 0; gap < 2; gap++) {
		struct sweep_params params = plain_params();
		struct sweep *s = sweep_create(&params);
		int starts = 0;

		for (int t = 0; t < 2000; t += 5) {
			struct row *row = NULL;
			enum sweep_drop drop;

			if (!gap || t < 800 || t >= 1300)
				add_tilt(s, t * MS, 0.3 + 1e-5 * t);
			if (t % 15 == 0 && t > 0)
				sweep_profile(s, make_profile((t - 8) * MS, 1, 5), t * MS);
			while (sweep_next(s, t * MS, false, &row, &drop) != SWEEP_WAIT)
				if (row) {
					starts += row->starts_sweep;
					assert_true(!row->starts_sweep || row->t_ns < 100 * MS ||
					            row->t_ns > 1250 * MS);
					row_destroy(row);
					row = NULL;
				}
		}
		assert_int_equal(starts, 1 + gap);
		sweep_destroy(s);
	}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(an_interlaced_profile_is_a_row_for_each_turn),
	    cmocka_unit_test(turns_are_one_row_when_the_servo_stood),
	    cmocka_unit_test(one_row_of_two_turns_keeps_each_beams_time),
	    cmocka_unit_test(a_partial_scan_is_a_row_with_its_own_bearings),
	    cmocka_unit_test(partial_scans_are_one_row_when_the_servo_stood),
	    cmocka_unit_test(partial_scans_do_not_wait_for_one_that_was_lost),
	    cmocka_unit_test(partial_scans_do_not_wait_once_the_servo_moves),
	    cmocka_unit_test(partial_scans_that_do_not_fit_a_row_stay_alone),
	    cmocka_unit_test(a_profile_waits_for_samples_behind_its_last_beam),
	    cmocka_unit_test(hold_is_judged_by_the_log_time_of_the_next_record),
	    cmocka_unit_test(nothing_is_waited_for_at_the_end_of_an_input),
	    cmocka_unit_test(the_tilt_goes_on_for_one_and_a_half_periods),
	    cmocka_unit_test(angles_are_not_joined_over_a_long_silence),
	    cmocka_unit_test(the_pose_goes_on_for_50_ms_with_its_last_twist),
	    cmocka_unit_test(rows_without_samples_are_dropped_with_their_reason),
	    cmocka_unit_test(the_oldest_profile_gives_way_when_too_many_wait),
	    cmocka_unit_test(samples_out_of_order_are_ignored_until_time_was_set_back),
	    cmocka_unit_test(old_samples_give_way),
	    cmocka_unit_test(lever_arms_are_part_of_the_chain),
	    cmocka_unit_test(ranges_masks_and_the_robot_are_left_out),
	    cmocka_unit_test(a_sweep_begins_where_the_servo_turns),
	    cmocka_unit_test(a_sweep_of_a_servo_that_stands_ends_after_2048_rows),
	    cmocka_unit_test(a_robot_that_went_on_meanwhile_begins_a_sweep),
	    cmocka_unit_test(walls_of_a_corridor_are_not_mixed),
	    cmocka_unit_test(a_beam_that_jumps_to_both_valid_neighbours_is_mixed),
	    cmocka_unit_test(real_sweeps_have_the_beams_that_are_written_down),
	    cmocka_unit_test(nothing_is_interpolated_across_a_jump),
	    cmocka_unit_test(a_row_too_far_beyond_the_last_pose_of_its_frame_is_dropped),
	    cmocka_unit_test(a_jump_is_no_speed),
	    cmocka_unit_test(what_was_measured_before_a_new_map_is_dropped),
	    cmocka_unit_test(a_long_silence_of_the_pose_is_not_interpolated),
	    cmocka_unit_test(rows_are_dropped_while_the_pose_is_less_certain_than_trusted),
	    cmocka_unit_test(a_profile_during_which_the_servo_moved_is_dropped_in_step_mode),
	    cmocka_unit_test(a_tilt_that_was_lost_cuts_the_raster),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

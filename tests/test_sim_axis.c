/* The simulated axis is physical: within its limits, at rest exactly where it was sent, its past never changes. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "core/trig.h"
#include "tools/sim_axis.h"
#include "tools/sim_device.h"

#define DEG    TRIG_DEG
#define MS     INT64_C(1000000)
#define SECOND INT64_C(1000000000)
#define STEP   (MS / 10)

static struct sim_axis axis; /* 160 KB: not on the stack */

static uint64_t seed;

static double between(double low, double high)
{
	return low + (high - low) * sim_random(&seed);
}

/* Any command, within 60 degrees/s and 300 degrees/s^2. */
static void command(int64_t t_ns)
{
	double reach = between(0, 2) < 1 ? 5 * DEG : 70 * DEG; /* short ways never get to their speed */
	double to = between(-reach, reach), speed = between(1 * DEG, 60 * DEG);

	switch ((int)between(0, 3)) {
	case 0:
		sim_axis_velocity(&axis, between(-60 * DEG, 60 * DEG), 300 * DEG, t_ns);
		break;
	case 1:
		sim_axis_stop(&axis, 300 * DEG, t_ns);
		break;
	default:
		sim_axis_goto(&axis, to, speed, 300 * DEG, t_ns);
		break;
	}
}

static void whatever_is_commanded_speed_and_acceleration_stay_within_their_limits(void **state)
{
	double angle = 0.0, speed = 0.0, sum = 0.0;
	double worst_v = 0.0, worst_a = 0.0, worst_p = 0.0;
	int64_t next_ns = 0;

	(void)state;
	seed = 1;
	sim_axis_init(&axis, 0.0, 0);
	for (int64_t t = 0; t < 60 * SECOND; t += STEP) {
		if (t >= next_ns) {
			command(t);
			next_ns = t + (int64_t)between(1e6, 5e8);
			next_ns -= next_ns % STEP;
		}
		angle = sim_axis_angle(&axis, t + STEP);
		worst_v = fmax(worst_v, fabs(sim_axis_speed(&axis, t + STEP)));
		worst_a = fmax(worst_a, fabs(sim_axis_speed(&axis, t + STEP) - speed) / 1e-4);
		/* the angle is the integral of the speed: Simpson, exact where a piece does not end */
		sum += (speed + 4 * sim_axis_speed(&axis, t + STEP / 2) + sim_axis_speed(&axis, t + STEP)) / 6 * 1e-4;
		worst_p = fmax(worst_p, fabs(sum - angle));
		speed = sim_axis_speed(&axis, t + STEP);
	}
	assert_true(worst_v <= 60 * DEG + 1e-9);
	assert_true(worst_a <= 300 * DEG + 1e-6);
	assert_true(worst_p < 1e-5);
	printf("note: 60 s of random commands: integral of speed against angle, worst %.2g rad\n", worst_p);
}

static void it_rests_exactly_where_it_was_sent_and_as_late_as_the_trapezoid_says(void **state)
{
	int64_t arrival_ns;

	(void)state;
	sim_axis_init(&axis, 10 * DEG, 5 * SECOND);
	sim_axis_goto(&axis, -50 * DEG, 30 * DEG, 100 * DEG, 6 * SECOND);
	arrival_ns = sim_axis_arrival_ns(&axis);
	/* 60 degrees at 30 degrees/s and 0.3 s for the ramps */
	assert_in_range(arrival_ns, 8300 * MS - 2, 8300 * MS + 2);
	assert_true(sim_axis_angle(&axis, arrival_ns) == -50 * DEG);
	assert_true(sim_axis_angle(&axis, arrival_ns + 1000 * SECOND) == -50 * DEG);
	assert_true(sim_axis_speed(&axis, arrival_ns) == 0.0);
	assert_false(sim_axis_arrived(&axis, arrival_ns - 1));
	assert_true(sim_axis_arrived(&axis, arrival_ns));
	assert_true(fabs(sim_axis_angle(&axis, 7150 * MS) + 20 * DEG) < 1e-9); /* half way, half the time */
	/* a short way has no time for its speed: 1 degree at 100 degrees/s^2 takes 0.2 s */
	sim_axis_goto(&axis, -49 * DEG, 30 * DEG, 100 * DEG, 10 * SECOND);
	assert_in_range(sim_axis_arrival_ns(&axis), 10200 * MS - 2, 10200 * MS + 2);
}

static void a_target_behind_it_is_reached_by_turning_and_one_too_near_by_coming_back(void **state)
{
	double most = 0.0;

	(void)state;
	sim_axis_init(&axis, 0.0, 0);
	sim_axis_velocity(&axis, 40 * DEG, 0.0, 0);
	sim_axis_goto(&axis, 41 * DEG, 40 * DEG, 200 * DEG, SECOND); /* braking takes 4 degrees, it has one */
	for (int64_t t = SECOND; t < 3 * SECOND; t += MS)
		most = fmax(most, sim_axis_angle(&axis, t));
	assert_true(most > 43.9 * DEG && most < 44.1 * DEG);
	assert_true(sim_axis_angle(&axis, 5 * SECOND) == 41 * DEG);
	sim_axis_velocity(&axis, 40 * DEG, 0.0, 5 * SECOND);
	sim_axis_goto(&axis, 0.0, 10 * DEG, 200 * DEG, 6 * SECOND); /* faster than allowed, and away from it */
	assert_true(sim_axis_angle(&axis, 6200 * MS) > 84.9 * DEG);
	assert_true(sim_axis_angle(&axis, 30 * SECOND) == 0.0);
}

static void without_acceleration_speeds_change_at_once(void **state)
{
	(void)state;
	sim_axis_init(&axis, -10 * DEG, 0);
	sim_axis_goto(&axis, 30 * DEG, 20 * DEG, 0.0, SECOND);
	assert_true(fabs(sim_axis_angle(&axis, 2 * SECOND) - 10 * DEG) < 1e-12);
	assert_true(sim_axis_angle(&axis, 3 * SECOND) == 30 * DEG);
	sim_axis_stop(&axis, 0.0, 2 * SECOND); /* a command may be in the past, after the last one */
	assert_true(fabs(sim_axis_angle(&axis, 9 * SECOND) - 10 * DEG) < 1e-12);
	sim_axis_goto(&axis, 99 * DEG, 0.0, 0.0, 3 * SECOND); /* no speed: it does not move */
	assert_true(fabs(sim_axis_angle(&axis, 9 * SECOND) - 10 * DEG) < 1e-12);
}

static void what_never_ends_does_not_overflow_the_clock(void **state)
{
	int64_t now_ns = INT64_C(1800000000) * SECOND; /* as a wall clock says it */

	(void)state;
	sim_axis_init(&axis, 0.0, now_ns);
	sim_axis_goto(&axis, 1e6, 1e-9, 1e-3, now_ns);
	assert_int_equal(sim_axis_arrival_ns(&axis), INT64_MAX);
	assert_true(fabs(sim_axis_angle(&axis, now_ns + 1000 * SECOND) - 1e-6) < 1e-9);
	sim_axis_stop(&axis, 1.0, now_ns + 1000 * SECOND);
	assert_true(sim_axis_arrived(&axis, now_ns + 1001 * SECOND));
}

static void its_past_stays_as_it_was(void **state)
{
	static double was[4000];
	int64_t t_ns = 0;
	int n = 0;

	(void)state;
	seed = 7;
	sim_axis_init(&axis, 0.0, 0);
	for (; n < 4000; n++, t_ns += MS) {
		if (n % 40 == 0)
			command(t_ns);
		was[n] = sim_axis_angle(&axis, t_ns);
	}
	for (int i = 0; i < n; i++)
		assert_true(sim_axis_angle(&axis, i * MS) == was[i]);
}

static void more_motion_than_it_remembers_is_answered_by_the_oldest(void **state)
{
	(void)state;
	sim_axis_init(&axis, 1.0, 0);
	for (int i = 1; i < 3 * SIM_AXIS_PIECES; i++)
		sim_axis_place(&axis, i, i * MS);
	assert_true(sim_axis_angle(&axis, 0) == 2.0 * SIM_AXIS_PIECES);
	assert_true(sim_axis_angle(&axis, 2 * SIM_AXIS_PIECES * MS) == 2.0 * SIM_AXIS_PIECES);
	assert_true(sim_axis_angle(&axis, INT64_MAX) == 3.0 * SIM_AXIS_PIECES - 1);
}

/* Set-points of a sinus every 10 ms: between them it goes straight, so it is never further off than the chord's height. */
static void cyclic_set_points_are_followed_a_cycle_behind(void **state)
{
	double worst = 0.0, w = 2.0 * TRIG_PI / 4.0;

	(void)state;
	seed = 3;
	sim_axis_init(&axis, 0.0, 0);
	for (int i = 0; i < 1000; i++) {
		int64_t late_ns = (int64_t)between(0, 200e3);

		sim_axis_track(&axis, 0.5 * trig_sin(w * (i + 1) * 0.01), 10 * MS, 0.0, 0.0, i * 10 * MS + late_ns);
		if (i > 2)
			worst = fmax(worst, fabs(sim_axis_angle(&axis, i * 10 * MS - 5 * MS) -
			                         0.5 * trig_sin(w * (i * 0.01 - 0.005))));
	}
	assert_true(worst < 0.5 * w * 0.0002 + 0.5 * w * w * 1e-4);
	/* late set-points do not make it begin from rest, which takes what an acceleration takes */
	sim_axis_init(&axis, 0.0, 0);
	for (int i = 0; i < 200; i++)
		sim_axis_track(&axis, (i + 1) * 0.3 * DEG, 10 * MS, 0.0, 300 * DEG, i * 10 * MS + (i % 2 ? 150000 : 0));
	assert_true(fabs(sim_axis_angle(&axis, 2000 * MS + 200000) - 60 * DEG) < 0.05 * DEG);
	sim_axis_init(&axis, 0.0, 0);
	for (int i = 0; i < 1000; i++)
		sim_axis_track(&axis, 0.5 * trig_sin(w * (i + 1) * 0.01), 10 * MS, 0.0, 0.0, i * 10 * MS);
	/* none comes any more: it stands at the last one */
	assert_true(fabs(sim_axis_angle(&axis, 99 * SECOND) - 0.5 * trig_sin(w * 10.0)) < 1e-12);
	/* and a set-point too far away is gone to with the speed there is */
	sim_axis_track(&axis, 2.0, 10 * MS, 0.1, 0.0, 100 * SECOND);
	assert_true(fabs(sim_axis_speed(&axis, 100 * SECOND + MS) - 0.1) < 1e-12);
}

static void a_stuck_axis_stands_while_the_demand_goes_on_and_then_catches_up(void **state)
{
	(void)state;
	sim_axis_init(&axis, 0.0, 0);
	sim_axis_goto(&axis, 50 * DEG, 20 * DEG, 300 * DEG, 0);
	sim_axis_stuck(&axis, true, SECOND);
	double there = sim_axis_angle(&axis, SECOND);

	assert_true(sim_axis_angle(&axis, 2 * SECOND) == there);
	assert_true(fabs(sim_axis_demand(&axis, 2 * SECOND) - there - 20 * DEG) < 1e-9);
	sim_axis_stuck(&axis, false, 2 * SECOND);
	assert_true(sim_axis_angle(&axis, 10 * SECOND) == 50 * DEG);
	sim_axis_stuck(&axis, true, 10 * SECOND);
	sim_axis_goto(&axis, 0.0, 20 * DEG, 300 * DEG, 10 * SECOND);
	sim_axis_stop(&axis, 300 * DEG, 11 * SECOND); /* the demand gives up what it was ahead */
	assert_true(sim_axis_demand(&axis, 11 * SECOND) == 50 * DEG);
	sim_axis_stuck(&axis, false, 12 * SECOND);
	assert_true(sim_axis_angle(&axis, 20 * SECOND) == 50 * DEG);
}

static void a_slow_axis_falls_behind_as_far_as_was_ordered(void **state)
{
	(void)state;
	sim_axis_init(&axis, 0.0, 0);
	sim_axis_slow(&axis, 0.5, 0);
	sim_axis_goto(&axis, 60 * DEG, 20 * DEG, 0.0, 0);
	assert_true(fabs(sim_axis_demand(&axis, 2 * SECOND) - sim_axis_angle(&axis, 2 * SECOND) - 20 * DEG) < 1e-9);
	sim_axis_init(&axis, 0.0, 0);
	sim_axis_slow(&axis, 0.5, 0);
	for (int i = 0; i < 200; i++)
		sim_axis_track(&axis, (i + 1) * 0.2 * DEG, 10 * MS, 0.0, 0.0, i * 10 * MS);
	assert_true(fabs(sim_axis_angle(&axis, 2 * SECOND) - 20 * DEG) < 1e-9);
}

static void moved_by_hand_it_swings_between_its_ends(void **state)
{
	double low = 9, high = -9, speed = 0, change = 0, before;

	(void)state;
	sim_axis_init(&axis, 0.0, 0);
	sim_axis_sinus(&axis, -60 * DEG, 40 * DEG, 4 * SECOND, SECOND);
	assert_true(fabs(sim_axis_angle(&axis, SECOND) + 10 * DEG) < 1e-12);
	assert_true(fabs(sim_axis_angle(&axis, 2 * SECOND) - 40 * DEG) < 1e-12);
	assert_true(fabs(sim_axis_angle(&axis, 4 * SECOND + 4000 * SECOND) + 60 * DEG) < 1e-9);
	assert_int_equal(sim_axis_arrival_ns(&axis), INT64_MAX);
	sim_axis_triangle(&axis, -60 * DEG, 40 * DEG, 37.5 * DEG, 300 * DEG, 10 * SECOND);
	before = sim_axis_speed(&axis, 10 * SECOND);
	for (int64_t t = 10 * SECOND; t < 30 * SECOND; t += MS) {
		low = fmin(low, sim_axis_angle(&axis, t));
		high = fmax(high, sim_axis_angle(&axis, t));
		speed = fmax(speed, fabs(sim_axis_speed(&axis, t)));
		change = fmax(change, fabs(sim_axis_speed(&axis, t) - before));
		before = sim_axis_speed(&axis, t);
	}
	assert_true(low >= -60 * DEG - 1e-12 && low < -59.99 * DEG && high <= 40 * DEG + 1e-12 && high > 39.99 * DEG);
	assert_true(fabs(speed - 37.5 * DEG) < 1e-12);
	assert_true(change < 0.3 * DEG + 1e-9); /* 300 degrees/s^2 in a millisecond */
	/* half its period: 100 degrees and the ramps */
	assert_true(fabs(sim_axis_angle(&axis, 10 * SECOND + (int64_t)rint((100.0 / 37.5 + 0.125) * 1e9)) - 40 * DEG) <
	            1e-12);
	sim_axis_stuck(&axis, true, 31 * SECOND);
	assert_true(sim_axis_angle(&axis, 40 * SECOND) == sim_axis_angle(&axis, 31 * SECOND));
	sim_axis_stuck(&axis, false, 41 * SECOND);
	assert_true(sim_axis_angle(&axis, 42 * SECOND) == sim_axis_demand(&axis, 42 * SECOND));
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(whatever_is_commanded_speed_and_acceleration_stay_within_their_limits),
	    cmocka_unit_test(it_rests_exactly_where_it_was_sent_and_as_late_as_the_trapezoid_says),
	    cmocka_unit_test(a_target_behind_it_is_reached_by_turning_and_one_too_near_by_coming_back),
	    cmocka_unit_test(without_acceleration_speeds_change_at_once),
	    cmocka_unit_test(what_never_ends_does_not_overflow_the_clock),
	    cmocka_unit_test(its_past_stays_as_it_was),
	    cmocka_unit_test(more_motion_than_it_remembers_is_answered_by_the_oldest),
	    cmocka_unit_test(cyclic_set_points_are_followed_a_cycle_behind),
	    cmocka_unit_test(a_stuck_axis_stands_while_the_demand_goes_on_and_then_catches_up),
	    cmocka_unit_test(a_slow_axis_falls_behind_as_far_as_was_ordered),
	    cmocka_unit_test(moved_by_hand_it_swings_between_its_ends),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

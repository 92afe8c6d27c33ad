/* Laws L1 and L9: a servo is sent where it may go and nowhere else, and one that goes elsewhere is halted; in virtual time. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <math.h>
#include <string.h>

#include "core/trig.h"
#include "drivers/sweeper.h"

#define DEG TRIG_DEG
#define MS  INT64_C(1000000)

static struct config sweep_config(void)
{
	struct config config = {.devices = 1};

	strcpy(config.device[0].name, "servo");
	config.device[0].following_rad = 10.0 * DEG;
	config.device[0].acceleration_rad_s2 = 300.0 * DEG;
	config.sweep.set = true;
	strcpy(config.sweep.device, "servo");
	config.sweep.from_rad = -20.0 * DEG;
	config.sweep.to_rad = 30.0 * DEG;
	config.sweep.speed_rad_s = 40.0 * DEG;
	config.sweep.step_rad = 7.0 * DEG;
	config.sweep.settle_ns = 300 * MS;
	return config;
}

/* A servo that moves by itself. What it does wrong is in its members. */
struct servo {
	double angle, speed, target, told; /* rad; `told`: its speed, rad/s */
	double share;                      /* of the speed that it was told; negative: the wrong way */
	double acceleration;               /* 0: it has its speed at once */
	double dead_band;                  /* it stops so far from its target */
	double overshoot;                  /* it first goes so far beyond */
	double wall;                       /* it goes no farther than this */
	int misses;                        /* targets that it does not hear */
	double beyond;                     /* where it is going, the overshoot included */
	int targets, speeds, turns, direction;
	double low, high;               /* of the targets */
	double angle_low, angle_high;   /* of its angle */
	double speed_low, fastest_seen; /* of what it was told */
};

static struct servo good_servo(double angle)
{
	return (struct servo){.angle = angle,
	                      .target = angle,
	                      .beyond = angle,
	                      .share = 1.0,
	                      .wall = 1e9,
	                      .low = 1e9,
	                      .high = -1e9,
	                      .angle_low = 1e9,
	                      .angle_high = -1e9,
	                      .speed_low = 1e9};
}

static void servo_take(struct servo *servo, double target)
{
	servo->targets++;
	servo->low = fmin(servo->low, target);
	servo->high = fmax(servo->high, target);
	if (servo->misses-- > 0)
		return;
	servo->target = target;
	servo->beyond = target + (target > servo->angle ? servo->overshoot : -servo->overshoot);
}

static void servo_move(struct servo *servo, double dt)
{
	double way = servo->beyond - servo->angle, sign = way < 0.0 ? -1.0 : 1.0,
	       most = fabs(servo->share) * servo->told;
	double before = servo->angle;
	int direction;

	if (fabs(way) <= servo->dead_band)
		return;
	servo->speed = servo->acceleration > 0.0 ? fmin(most, servo->speed + servo->acceleration * dt) : most;
	if (servo->acceleration > 0.0)
		servo->speed = fmin(servo->speed, sqrt(2.0 * servo->acceleration * fabs(way)));
	if (servo->share >= 0.0 && fabs(way) <= servo->speed * dt) {
		servo->angle = servo->beyond;
		servo->beyond = servo->target; /* and back from where it went too far */
		servo->speed = 0.0;
	} else {
		servo->angle += (servo->share < 0.0 ? -sign : sign) * servo->speed * dt;
	}
	servo->angle = fmin(servo->angle, servo->wall);
	direction = servo->angle > before ? 1 : servo->angle < before ? -1 : servo->direction;
	servo->turns += servo->direction && direction != servo->direction;
	servo->direction = direction;
	servo->angle_low = fmin(servo->angle_low, servo->angle);
	servo->angle_high = fmax(servo->angle_high, servo->angle);
}

/* One look, as a driver does it: the speed first, one write at a time. */
static enum sweeper_state look(struct sweeper *sweeper, struct servo *servo, int64_t t_ns, struct sweeper_wish *wish)
{
	sweeper_look(sweeper, t_ns, wish);
	assert_true(wish->deadline_ns > t_ns);
	if (wish->speed) {
		servo->told = wish->speed_rad_s;
		servo->speeds++;
		servo->speed_low = fmin(servo->speed_low, wish->speed_rad_s);
		servo->fastest_seen = fmax(servo->fastest_seen, wish->speed_rad_s);
		sweeper_speed_taken(sweeper, wish->speed_rad_s, t_ns);
	} else if (wish->target) {
		servo_take(servo, wish->target_rad);
		sweeper_target_taken(sweeper, wish->target_rad, t_ns);
	}
	return wish->state;
}

/* An angle every 10 ms. Ends early when it does not run any more. */
static enum sweeper_state run(struct sweeper *sweeper, struct servo *servo, int64_t *t_ns, double seconds,
                              struct sweeper_wish *wish)
{
	int64_t end_ns = *t_ns + (int64_t)(seconds * 1e9);

	for (; *t_ns < end_ns; *t_ns += 10 * MS) {
		servo_move(servo, 0.01);
		sweeper_angle(sweeper, servo->angle, *t_ns);
		if (look(sweeper, servo, *t_ns, wish) != SWEEPER_RUNS)
			return wish->state;
	}
	return wish->state;
}

static enum sweeper_state run_config(const struct config *config, struct servo *servo, double seconds,
                                     struct sweeper_wish *wish)
{
	static struct sweeper sweeper;
	int64_t t_ns = 5000 * MS;

	sweeper_init(&sweeper, config, 0, false, true);
	sweeper_begin(&sweeper, t_ns);
	return run(&sweeper, servo, &t_ns, seconds, wish);
}

/* ---- servos that move by themselves ---- */

static void a_triangle_sweeps_between_its_ends_for_hours(void **state)
{
	struct config config = sweep_config();
	struct servo servo = good_servo(3.0 * DEG);
	struct sweeper_wish wish;

	(void)state;
	assert_int_equal(run_config(&config, &servo, 3600.0, &wish), SWEEPER_RUNS);
	assert_in_range(servo.turns, 2700, 2900); /* 50 degrees at 40 degrees a second: 1.25 s each way */
	assert_true(servo.low == -20.0 * DEG && servo.high == 30.0 * DEG);
	assert_true(servo.angle_low < -19.0 * DEG && servo.angle_high > 29.0 * DEG);
	assert_int_equal(servo.speeds, 1);
}

static void a_sinus_slows_down_towards_its_ends(void **state)
{
	struct config config = sweep_config();
	struct servo servo = good_servo(-20.0 * DEG);
	struct sweeper_wish wish;

	(void)state;
	config.sweep.profile = SWEEP_SINUS;
	assert_int_equal(run_config(&config, &servo, 120.0, &wish), SWEEPER_RUNS);
	assert_in_range(servo.turns, 55, 72); /* half a period is pi A / peak = 1.96 s */
	assert_true(servo.angle_low < -19.0 * DEG && servo.angle_high > 29.0 * DEG);
	assert_true(servo.speed_low <= 0.06 * 40.0 * DEG && servo.fastest_seen == 40.0 * DEG);
}

static void steps_are_settled_and_stay_within_the_ends(void **state)
{
	struct config config = sweep_config();
	struct servo servo = good_servo(0.0);
	struct sweeper_wish wish;

	(void)state;
	config.sweep.profile = SWEEP_STEP; /* 50 degrees: seven steps and a short one */
	assert_int_equal(run_config(&config, &servo, 60.0, &wish), SWEEPER_RUNS);
	assert_in_range(servo.targets, 100, 130); /* a step takes 0.175 s and 0.3 s of settling */
	assert_true(servo.low == -20.0 * DEG && servo.high == 30.0 * DEG);
}

static void nothing_is_sent_before_an_angle_is_known(void **state)
{
	struct config config = sweep_config();
	struct sweeper sweeper;
	struct sweeper_wish wish;

	(void)state;
	sweeper_init(&sweeper, &config, 0, false, true);
	sweeper_begin(&sweeper, 0);
	for (int64_t t_ns = 0; t_ns < 10000 * MS; t_ns += 50 * MS) {
		sweeper_look(&sweeper, t_ns, &wish);
		assert_true(wish.state == SWEEPER_RUNS && !wish.target && !wish.speed);
	}
	sweeper_angle(&sweeper, NAN, 10000 * MS);
	sweeper_look(&sweeper, 10000 * MS, &wish);
	assert_false(wish.target || wish.speed);
	sweeper_angle(&sweeper, 0.1, 10000 * MS);
	sweeper_look(&sweeper, 10000 * MS, &wish);
	assert_true(wish.speed && wish.target);
}

static void another_device_than_the_sweeps_is_told_nothing(void **state)
{
	struct config config = sweep_config();
	struct servo servo = good_servo(0.0);
	struct sweeper_wish wish;

	(void)state;
	strcpy(config.sweep.device, "other");
	assert_int_equal(run_config(&config, &servo, 10.0, &wish), SWEEPER_RUNS);
	assert_int_equal(servo.targets + servo.speeds, 0);
}

/* What real servos are like is no following error. */
static void servos_with_a_ramp_a_dead_band_or_an_overshoot_sweep_on(void **state)
{
	struct config config = sweep_config();
	struct sweeper_wish wish;

	(void)state;
	for (int kind = 0; kind < 5; kind++) {
		struct servo servo = good_servo(0.0);

		servo.acceleration = kind == 0 ? 90.0 * DEG : kind == 1 ? 300.0 * DEG : 0.0;
		servo.dead_band = kind == 2 ? 0.8 * DEG : 0.0;
		servo.overshoot = kind == 3 ? 4.0 * DEG : 0.0;
		servo.share = kind == 4 ? 0.9 : 1.0;
		config.device[0].acceleration_rad_s2 = kind == 1 ? 300.0 * DEG : 0.0;
		for (config.sweep.profile = SWEEP_TRIANGLE; config.sweep.profile <= SWEEP_STEP;
		     config.sweep.profile++) {
			assert_int_equal(run_config(&config, &servo, 200.0, &wish), SWEEPER_RUNS);
			assert_true(servo.turns > 10 && servo.angle_low < -19.0 * DEG && servo.angle_high > 29.0 * DEG);
			servo.turns = 0;
		}
	}
}

static void a_servo_of_half_the_speed_is_halted_with_a_sentence_and_told_to_stay(void **state)
{
	struct config config = sweep_config();
	struct servo servo = good_servo(-20.0 * DEG);
	struct sweeper_wish wish;

	(void)state;
	servo.share = 0.5;
	assert_int_equal(run_config(&config, &servo, 10.0, &wish), SWEEPER_HALTED);
	assert_non_null(strstr(wish.why, "behind where it should be"));
	assert_true(fabs(servo.target - servo.angle) < 0.5 * DEG);
	servo = good_servo(-20.0 * DEG);
	servo.share = 0.5;
	config.device[0].following_rad = 0.0; /* not judged */
	assert_int_equal(run_config(&config, &servo, 100.0, &wish), SWEEPER_RUNS);
	assert_in_range(servo.turns, 35, 42);
}

static void a_servo_that_is_too_fast_goes_too_far_or_the_wrong_way_is_halted(void **state)
{
	static const struct {
		double share, overshoot;
		const char *why;
	} wrong[] = {
	    {3.0, 0.0, "ahead of where"}, {1.0, 15.0, "beyond its target"}, {-1.0, 0.0, "farther from its target"}};
	struct config config = sweep_config();
	struct sweeper_wish wish;

	(void)state;
	for (size_t i = 0; i < sizeof wrong / sizeof *wrong; i++) {
		struct servo servo = good_servo(30.0 * DEG);

		config.sweep.profile =
		    wrong[i].overshoot > 0.0 ? SWEEP_STEP : SWEEP_TRIANGLE; /* nobody calls it back */
		servo.share = wrong[i].share;
		servo.overshoot = wrong[i].overshoot * DEG;
		assert_int_equal(run_config(&config, &servo, 10.0, &wish), SWEEPER_HALTED);
		assert_non_null(strstr(wish.why, wrong[i].why));
		assert_true(servo.low >= -20.0 * DEG && servo.high <= 30.0 * DEG);
	}
}

static void a_servo_that_runs_against_a_wall_is_halted_within_a_second(void **state)
{
	struct config config = sweep_config();
	struct servo servo = good_servo(-20.0 * DEG);
	struct sweeper sweeper;
	struct sweeper_wish wish;
	int64_t t_ns = 0, hit_ns;

	(void)state;
	servo.wall = 5.0 * DEG;
	sweeper_init(&sweeper, &config, 0, false, true);
	sweeper_begin(&sweeper, t_ns);
	while (servo.angle < servo.wall)
		assert_int_equal(run(&sweeper, &servo, &t_ns, 0.01, &wish), SWEEPER_RUNS);
	hit_ns = t_ns;
	assert_int_equal(run(&sweeper, &servo, &t_ns, 10.0, &wish), SWEEPER_HALTED);
	assert_true(t_ns - hit_ns < 1000 * MS);
	assert_non_null(strstr(wish.why, "behind where"));
}

/* It is not pressed against what blocks it; but an angle that never moved is believed nowhere outside of the sweep. */
static void a_servo_that_is_blocked_on_its_way_in_or_out_is_told_to_stay_there(void **state)
{
	struct config config = sweep_config();
	struct sweeper sweeper;
	struct sweeper_wish wish;
	int64_t t_ns = 0;

	(void)state;
	for (int limited = 0; limited < 2; limited++) {
		struct servo servo = good_servo(80.0 * DEG);

		config.device[0].has_limits = limited;
		config.device[0].limits_rad[0] = -60.0 * DEG;
		config.device[0].limits_rad[1] = 50.0 * DEG;
		sweeper_init(&sweeper, &config, 0, false, true);
		sweeper_begin(&sweeper, t_ns);
		while (servo.angle > 70.0 * DEG)
			assert_int_equal(run(&sweeper, &servo, &t_ns, 0.01, &wish), SWEEPER_RUNS);
		servo.share = 0.0;
		assert_int_equal(run(&sweeper, &servo, &t_ns, 10.0, &wish), SWEEPER_HALTED);
		assert_true(fabs(servo.target - (limited ? 50.0 * DEG : servo.angle)) < 0.01 * DEG);
	}
	config.device[0].has_limits = false;
	config.sweep.has_rest = true;
	config.sweep.rest_rad = 90.0 * DEG;
	struct servo servo = good_servo(0.0);

	sweeper_init(&sweeper, &config, 0, false, true);
	sweeper_begin(&sweeper, t_ns);
	run(&sweeper, &servo, &t_ns, 3.0, &wish);
	sweeper_stop(&sweeper, t_ns);
	servo.wall = 60.0 * DEG;
	assert_int_equal(run(&sweeper, &servo, &t_ns, 10.0, &wish), SWEEPER_HALTED);
	assert_true(fabs(servo.target - 60.0 * DEG) < 0.01 * DEG);

	servo = good_servo(80.0 * DEG);
	servo.share = 0.0;
	sweeper_begin(&sweeper, t_ns);
	assert_int_equal(run(&sweeper, &servo, &t_ns, 10.0, &wish), SWEEPER_HALTED);
	assert_true(servo.target == 30.0 * DEG);
}

static void a_servo_that_never_moves_is_told_three_times_then_halted(void **state)
{
	struct config config = sweep_config();
	struct servo servo = good_servo(0.0);
	struct sweeper_wish wish;

	(void)state;
	servo.share = 0.0;
	assert_int_equal(run_config(&config, &servo, 30.0, &wish), SWEEPER_HALTED);
	assert_int_equal(servo.targets, 3 + 1); /* and once that it is to stay */
	assert_non_null(strstr(wish.why, "stands still"));
}

static void a_servo_that_missed_a_target_is_told_again(void **state)
{
	struct config config = sweep_config();
	struct servo servo = good_servo(0.0);
	struct sweeper_wish wish;

	(void)state;
	servo.misses = 2;
	assert_int_equal(run_config(&config, &servo, 30.0, &wish), SWEEPER_RUNS);
	assert_true(servo.turns > 10);
}

/* ---- limits ---- */

static void a_target_beyond_a_limit_is_never_sent(void **state)
{
	struct config config = sweep_config();
	struct servo servo = good_servo(0.0);
	struct sweeper_wish wish;

	(void)state;
	config.device[0].has_limits = true;
	config.device[0].limits_rad[0] = -20.0 * DEG;
	config.device[0].limits_rad[1] = 30.0 * DEG;
	assert_int_equal(run_config(&config, &servo, 10.0, &wish), SWEEPER_RUNS);
	servo = good_servo(0.0);
	config.device[0].limits_rad[1] = 29.9 * DEG;
	assert_int_equal(run_config(&config, &servo, 10.0, &wish), SWEEPER_HALTED);
	assert_int_equal(servo.targets, 0);
	assert_string_equal(
	    wish.why, "is to go to 30.0 degrees, but its limits are -20.0 and 29.9; correct `sweep`, or the limits");
	config.device[0].limits_rad[1] = 40.0 * DEG;
	config.sweep.has_rest = true;
	config.sweep.rest_rad = -21.0 * DEG;
	assert_int_equal(run_config(&config, &servo, 10.0, &wish), SWEEPER_HALTED);
	assert_int_equal(servo.targets, 0);
}

static void limits_that_are_learned_later_halt_the_sweep_inside_of_them(void **state)
{
	struct config config = sweep_config();
	struct servo servo = good_servo(0.0);
	struct sweeper sweeper;
	struct sweeper_wish wish;
	int64_t t_ns = 0;

	(void)state;
	sweeper_init(&sweeper, &config, 0, false, true);
	sweeper_begin(&sweeper, t_ns);
	sweeper_limits(&sweeper, -90.0 * DEG, 90.0 * DEG);
	assert_int_equal(run(&sweeper, &servo, &t_ns, 5.0, &wish), SWEEPER_RUNS);
	sweeper_limits(&sweeper, -5.0 * DEG, 5.0 * DEG);
	servo.targets = 0;
	assert_int_equal(run(&sweeper, &servo, &t_ns, 1.0, &wish), SWEEPER_HALTED);
	assert_true(servo.targets <= 1 && servo.target >= -5.0 * DEG && servo.target <= 5.0 * DEG);
	sweeper_begin(&sweeper, t_ns); /* they were the drive's, which may be another one now */
	assert_int_equal(run(&sweeper, &servo, &t_ns, 5.0, &wish), SWEEPER_RUNS);
}

/* ---- ends and halts ---- */

static void stopping_goes_to_the_rest_angle_and_is_done(void **state)
{
	struct config config = sweep_config();
	struct servo servo = good_servo(0.0);
	struct sweeper sweeper;
	struct sweeper_wish wish;
	int64_t t_ns = 0;

	(void)state;
	config.sweep.has_rest = true;
	config.sweep.rest_rad = -35.0 * DEG; /* outside from..to: only the rest may be */
	sweeper_init(&sweeper, &config, 0, false, true);
	sweeper_begin(&sweeper, t_ns);
	run(&sweeper, &servo, &t_ns, 3.0, &wish);
	assert_true(servo.low == -20.0 * DEG);
	sweeper_stop(&sweeper, t_ns);
	assert_int_equal(run(&sweeper, &servo, &t_ns, 10.0, &wish), SWEEPER_DONE);
	assert_true(fabs(servo.angle + 35.0 * DEG) < 0.11 * DEG);
	assert_int_equal(run(&sweeper, &servo, &t_ns, 10.0, &wish), SWEEPER_DONE);
}

static void stopping_without_a_rest_angle_stops_where_it_is(void **state)
{
	struct config config = sweep_config();
	struct servo servo = good_servo(0.0);
	struct sweeper sweeper;
	struct sweeper_wish wish;
	int64_t t_ns = 0;

	(void)state;
	sweeper_init(&sweeper, &config, 0, false, true);
	sweeper_begin(&sweeper, t_ns);
	run(&sweeper, &servo, &t_ns, 3.3, &wish);
	sweeper_stop(&sweeper, t_ns);
	assert_int_equal(run(&sweeper, &servo, &t_ns, 1.0, &wish), SWEEPER_DONE);
	assert_true(fabs(servo.target - servo.angle) < 1.0 * DEG);
}

static void a_stop_that_cannot_be_reached_is_over_in_good_time(void **state)
{
	struct config config = sweep_config();
	struct servo servo = good_servo(0.0);
	struct sweeper sweeper;
	struct sweeper_wish wish;
	int64_t t_ns = 0, begun_ns;

	(void)state;
	config.sweep.has_rest = true;
	sweeper_init(&sweeper, &config, 0, false, true);
	sweeper_begin(&sweeper, t_ns);
	run(&sweeper, &servo, &t_ns, 3.0, &wish);
	servo.share = 0.0;
	begun_ns = t_ns;
	sweeper_stop(&sweeper, t_ns);
	assert_int_equal(run(&sweeper, &servo, &t_ns, 100.0, &wish), SWEEPER_DONE);
	assert_true(t_ns - begun_ns < 4000 * MS);
}

static void a_halt_from_outside_sends_nothing_and_lasts_until_it_begins_anew(void **state)
{
	struct config config = sweep_config();
	struct servo servo = good_servo(0.0);
	struct sweeper sweeper;
	struct sweeper_wish wish;
	int64_t t_ns = 0;

	(void)state;
	sweeper_init(&sweeper, &config, 0, false, true);
	sweeper_begin(&sweeper, t_ns);
	run(&sweeper, &servo, &t_ns, 3.0, &wish);
	servo.targets = 0;
	sweeper_halt(&sweeper, "has a fault");
	sweeper_halt(&sweeper, "and another");
	for (int i = 0; i < 1000; i++)
		assert_int_equal(run(&sweeper, &servo, &t_ns, 0.02, &wish), SWEEPER_HALTED);
	assert_string_equal(wish.why, "has a fault");
	assert_int_equal(servo.targets, 0);
	sweeper_begin(&sweeper, t_ns);
	assert_int_equal(run(&sweeper, &servo, &t_ns, 30.0, &wish), SWEEPER_RUNS);
	assert_true(servo.targets > 10);
	assert_string_equal(wish.why, "");
	sweeper_halt(&sweeper, "has a fault");
	sweeper_stop(&sweeper, t_ns);
	assert_int_equal(run(&sweeper, &servo, &t_ns, 1.0, &wish), SWEEPER_DONE);
}

/* A program that was stopped for a while saw nothing, and that is nobody's fault but its own. */
static void a_pause_of_the_program_is_no_following_error(void **state)
{
	struct config config = sweep_config();
	struct servo servo = good_servo(0.0);
	struct sweeper sweeper;
	struct sweeper_wish wish;
	int64_t t_ns = 0;

	(void)state;
	sweeper_init(&sweeper, &config, 0, false, true);
	sweeper_begin(&sweeper, t_ns);
	for (int i = 0; i < 50; i++) {
		assert_int_equal(run(&sweeper, &servo, &t_ns, 0.7 + 0.03 * i, &wish), SWEEPER_RUNS);
		t_ns += i % 3 == 2 ? 300 * MS : 3000 * MS;
		if (i % 2) /* the servo went on ... */
			servo_move(&servo, 3.0);
		else /* ... or its watchdog stopped it */
			servo.target = servo.beyond = servo.angle;
	}
	assert_true(servo.turns > 30);
}

/* ---- cyclic ---- */

struct way {
	double low, high, last, speed, fastest, jump, hardest;
	int turns;
};

/* Set-points every 10 ms, followed by a drive that is one of them behind. */
static enum sweeper_state follow(struct sweeper *sweeper, int64_t *t_ns, double seconds, int64_t pause_ns,
                                 struct way *way, struct sweeper_wish *wish)
{
	int64_t end_ns = *t_ns + (int64_t)(seconds * 1e9);
	double angle = way->last;

	for (; *t_ns < end_ns; *t_ns += pause_ns) {
		double setpoint, speed;

		sweeper_angle(sweeper, angle, *t_ns);
		sweeper_look(sweeper, *t_ns, wish);
		assert_false(wish->target || wish->speed);
		if (wish->state == SWEEPER_DONE)
			return wish->state;
		if (!sweeper_setpoint(sweeper, *t_ns, &setpoint, &speed))
			continue;
		way->jump = fmax(way->jump, fabs(setpoint - way->last));
		way->hardest = fmax(way->hardest, fabs(speed - way->speed));
		way->fastest = fmax(way->fastest, fabs(speed));
		way->turns += speed * way->speed < 0.0 || (speed != 0.0 && way->speed == 0.0);
		way->low = fmin(way->low, setpoint);
		way->high = fmax(way->high, setpoint);
		angle = way->last;
		way->last = setpoint;
		way->speed = speed;
	}
	return wish->state;
}

static void set_points_are_continuous_and_keep_speed_acceleration_and_ends(void **state)
{
	struct config config = sweep_config();

	(void)state;
	for (config.sweep.profile = SWEEP_TRIANGLE; config.sweep.profile <= SWEEP_STEP; config.sweep.profile++) {
		struct sweeper sweeper;
		struct sweeper_wish wish;
		struct way way = {.last = 3.0 * DEG};
		int64_t t_ns = 0;

		sweeper_init(&sweeper, &config, 0, true, true);
		sweeper_begin(&sweeper, t_ns);
		assert_int_equal(follow(&sweeper, &t_ns, 600.0, 10 * MS, &way, &wish), SWEEPER_RUNS);
		assert_true(way.turns > 200);
		assert_true(way.low > -20.0 * DEG - 1e-12 && way.low < -19.9 * DEG);
		assert_true(way.high < 30.0 * DEG + 1e-12 && way.high > 29.9 * DEG);
		assert_true(way.fastest <= 40.0 * DEG + 1e-12 && way.fastest > 30.0 * DEG);
		assert_true(way.jump <= 0.4001 * DEG);
		assert_true(way.hardest <= 300.0 * DEG * 0.0101); /* a change of speed in 10 ms */
	}
}

static void a_stop_brakes_and_goes_to_rest(void **state)
{
	struct config config = sweep_config();

	(void)state;
	config.sweep.has_rest = true;
	config.sweep.rest_rad = 35.0 * DEG;
	for (int i = 0; i < 300; i++) { /* at any time of a sweep */
		struct sweeper sweeper;
		struct sweeper_wish wish;
		struct way way = {.last = 3.0 * DEG};
		int64_t t_ns = 0;

		config.sweep.profile = i % 3;
		sweeper_init(&sweeper, &config, 0, true, true);
		sweeper_begin(&sweeper, t_ns);
		follow(&sweeper, &t_ns, 3.0 + 0.02 * i, 10 * MS, &way, &wish);
		sweeper_stop(&sweeper, t_ns);
		assert_int_equal(follow(&sweeper, &t_ns, 10.0, 10 * MS, &way, &wish), SWEEPER_DONE);
		assert_true(fabs(way.last - 35.0 * DEG) < 1e-9 && way.low > -20.0 * DEG - 1e-12);
		assert_true(way.jump <= 0.4001 * DEG && way.hardest <= 300.0 * DEG * 0.0101);
	}
}

static void a_pause_does_not_make_the_set_point_jump(void **state)
{
	struct config config = sweep_config();
	struct sweeper sweeper;
	struct sweeper_wish wish;
	struct way way = {.last = 3.0 * DEG};
	int64_t t_ns = 0;

	(void)state;
	sweeper_init(&sweeper, &config, 0, true, true);
	sweeper_begin(&sweeper, t_ns);
	for (int i = 0; i < 100; i++) {
		assert_int_equal(follow(&sweeper, &t_ns, 0.33, 10 * MS, &way, &wish), SWEEPER_RUNS);
		t_ns += 5000 * MS;
	}
	assert_true(way.jump <= 2.001 * DEG); /* 50 ms at 40 degrees a second */
}

static void a_drive_that_leaves_its_set_point_is_halted_and_the_set_point_stands(void **state)
{
	struct config config = sweep_config();
	struct sweeper sweeper;
	struct sweeper_wish wish = {0};
	struct way way = {.last = 3.0 * DEG};
	double stuck, setpoint, speed;
	int64_t t_ns = 0;

	(void)state;
	sweeper_init(&sweeper, &config, 0, true, true);
	sweeper_begin(&sweeper, t_ns);
	follow(&sweeper, &t_ns, 3.0, 10 * MS, &way, &wish);
	stuck = way.last;
	for (int i = 0; i < 100; i++, t_ns += 10 * MS) {
		sweeper_angle(&sweeper, stuck, t_ns);
		sweeper_setpoint(&sweeper, t_ns, &setpoint, &speed);
		sweeper_look(&sweeper, t_ns, &wish);
	}
	assert_int_equal(wish.state, SWEEPER_HALTED);
	assert_non_null(strstr(wish.why, "off where it should be"));
	assert_true(speed == 0.0 && fabs(setpoint - stuck) < 15.0 * DEG);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_triangle_sweeps_between_its_ends_for_hours),
	    cmocka_unit_test(a_sinus_slows_down_towards_its_ends),
	    cmocka_unit_test(steps_are_settled_and_stay_within_the_ends),
	    cmocka_unit_test(nothing_is_sent_before_an_angle_is_known),
	    cmocka_unit_test(another_device_than_the_sweeps_is_told_nothing),
	    cmocka_unit_test(servos_with_a_ramp_a_dead_band_or_an_overshoot_sweep_on),
	    cmocka_unit_test(a_servo_of_half_the_speed_is_halted_with_a_sentence_and_told_to_stay),
	    cmocka_unit_test(a_servo_that_is_too_fast_goes_too_far_or_the_wrong_way_is_halted),
	    cmocka_unit_test(a_servo_that_runs_against_a_wall_is_halted_within_a_second),
	    cmocka_unit_test(a_servo_that_is_blocked_on_its_way_in_or_out_is_told_to_stay_there),
	    cmocka_unit_test(a_servo_that_never_moves_is_told_three_times_then_halted),
	    cmocka_unit_test(a_servo_that_missed_a_target_is_told_again),
	    cmocka_unit_test(a_target_beyond_a_limit_is_never_sent),
	    cmocka_unit_test(limits_that_are_learned_later_halt_the_sweep_inside_of_them),
	    cmocka_unit_test(stopping_goes_to_the_rest_angle_and_is_done),
	    cmocka_unit_test(stopping_without_a_rest_angle_stops_where_it_is),
	    cmocka_unit_test(a_stop_that_cannot_be_reached_is_over_in_good_time),
	    cmocka_unit_test(a_halt_from_outside_sends_nothing_and_lasts_until_it_begins_anew),
	    cmocka_unit_test(a_pause_of_the_program_is_no_following_error),
	    cmocka_unit_test(set_points_are_continuous_and_keep_speed_acceleration_and_ends),
	    cmocka_unit_test(a_stop_brakes_and_goes_to_rest),
	    cmocka_unit_test(a_pause_does_not_make_the_set_point_jump),
	    cmocka_unit_test(a_drive_that_leaves_its_set_point_is_halted_and_the_set_point_stands),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

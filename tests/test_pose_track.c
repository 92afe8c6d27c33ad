/* Laws L2, L7, L8: the track without odometry is the poses that came, bit for bit; with it, it is where the wheels led, known as
 * well as they know it, and where absolute poses say. A jump is told once, by its size, and done as it was ordered; a
 * snapshot taken anywhere goes on as if nothing had been. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/pose_track.h"
#include "core/trig.h"

#define MS INT64_C(1000000)
#define T0 (INT64_C(1700000000000) * MS)

static const struct pose_track_params wheels = {
    .motion = true, .drift = 0.02, .turn_drift_rad = TRIG_DEG, .jump_m = 0.3, .jump_rad = 5 * TRIG_DEG};
static const struct pose_track_params both = {.motion = true,
                                              .absolute = true,
                                              .drift = 0.02,
                                              .turn_drift_rad = TRIG_DEG,
                                              .jump_m = 0.3,
                                              .jump_rad = 5 * TRIG_DEG};

static struct pose_track_params poses(enum pose_track_on_jump on_jump)
{
	return (struct pose_track_params){
	    .absolute = true, .jump_m = 0.3, .jump_rad = 5 * TRIG_DEG, .on_jump = on_jump};
}

static struct pose_track *open_track(struct pose_track_params params)
{
	struct pose_track *track = pose_track_create(&params);

	assert_non_null(track);
	return track;
}

static struct pose pose_at(int64_t t_ns, double x, double y, double yaw)
{
	return (struct pose){
	    .t_ns = t_ns, .position_m = {x, y, 0}, .rotation = {.w = trig_cos(yaw / 2), .z = trig_sin(yaw / 2)}};
}

static double yaw_of(const struct pose *pose)
{
	return 2 * trig_atan2(pose->rotation.z, pose->rotation.w);
}

static struct pose_track_out take(struct pose_track *track, struct pose pose)
{
	struct pose_track_out out;

	pose_track_absolute(track, &pose, &out);
	return out;
}

static struct pose_track_out drive(struct pose_track *track, int64_t from_ns, int64_t t_ns, double ahead, double turn)
{
	const struct motion motion = {from_ns, t_ns, ahead, turn};
	struct pose_track_out out;

	pose_track_motion(track, &motion, &out);
	return out;
}

static void assert_near(double is, double wanted, double tolerance)
{
	if (!(fabs(is - wanted) <= tolerance))
		fail_msg("%.9g is not %.9g within %g", is, wanted, tolerance);
}

static void assert_place(const struct pose *pose, double x, double y, double yaw, double tolerance)
{
	assert_near(pose->position_m.x, x, tolerance);
	assert_near(pose->position_m.y, y, tolerance);
	assert_near(remainder(yaw_of(pose) - yaw, 2 * TRIG_PI), 0, tolerance);
}

static struct pose_track_status status_of(const struct pose_track *track)
{
	struct pose_track_status status;

	pose_track_status(track, &status);
	return status;
}

/* A localisation that stays away: nobody knows where the wheels began. */
static void an_origin_that_nobody_knows_is_not_trusted(void **state)
{
	struct pose_track *lost = open_track(both), *alone = open_track(wheels);
	struct pose_track_out of_lost = {0}, of_alone = {0};

	(void)state;
	for (int i = 0; i < 300; i++) {
		of_lost = drive(lost, T0 + i * 10 * MS, T0 + (i + 1) * 10 * MS, 0.005, 0);
		of_alone = drive(alone, T0 + i * 10 * MS, T0 + (i + 1) * 10 * MS, 0.005, 0);
	}
	assert_true(of_lost.has_pose && of_alone.has_pose);
	assert_true(of_lost.pose.variance_m2 > 1e4);
	assert_true(of_alone.pose.variance_m2 < 0.1);
	take(lost, pose_at(T0 + 3000 * MS, 7, 8, 1));
	of_lost = drive(lost, T0 + 3000 * MS, T0 + 3010 * MS, 0, 0);
	assert_true(of_lost.pose.variance_m2 < 0.1);
	assert_place(&of_lost.pose, 7, 8, 1, 1e-6);
	pose_track_destroy(lost);
	pose_track_destroy(alone);
}

static void without_odometry_poses_pass_to_the_bit(void **state)
{
	struct pose_track *track = open_track(poses(POSE_TRACK_KEEP));

	(void)state;
	for (int i = 0; i < 500; i++) {
		struct pose pose;

		memset(&pose, 0, sizeof(pose));
		pose.t_ns = T0 + (i == 77 ? i - 3 : i) * 10 * MS; /* one comes late */
		pose.position_m = (struct vec3){0.01 * i, sin(0.01 * i), 1.0 / 3};
		pose.rotation = (struct quat){.w = cos(0.002 * i), .y = sin(0.002 * i)};
		pose.variance_m2 = 0.1 * i;
		const struct pose_track_out out = take(track, pose);
		assert_true(out.has_pose);
		assert_false(out.has_jump);
		assert_memory_equal(&out.pose, &pose, sizeof(pose));
	}
	assert_int_equal(status_of(track).late, 1);
	pose_track_destroy(track);
}

/* A circle of 2 m radius, in pieces of any length: the way round ends where it began, each piece on the circle. */
static void a_circle_is_driven_in_closed_form(void **state)
{
	(void)state;
	for (int pieces = 3; pieces < 2000; pieces = pieces * 3 + 1) {
		struct pose_track *track = open_track(wheels);
		struct pose_track_out out = {0};

		for (int i = 0; i < pieces; i++) {
			const double angle = 2 * TRIG_PI * (i + 1) / pieces;

			out = drive(track, T0 + i * MS, T0 + (i + 1) * MS, 2 * 2 * TRIG_PI / pieces,
			            2 * TRIG_PI / pieces);
			assert_true(out.has_pose);
			assert_false(out.pose.jumped);
			assert_int_equal(out.pose.t_ns, T0 + (i + 1) * MS);
			assert_place(&out.pose, 2 * sin(angle), 2 - 2 * cos(angle), angle, 1e-9);
		}
		assert_place(&out.pose, 0, 0, 0, 1e-9);
		pose_track_destroy(track);
	}
}

static void a_square_is_driven_backwards_too(void **state)
{
	struct pose_track *track = open_track(wheels);
	static const double corner[4][2] = {{-3, 0}, {-3, -3}, {0, -3}, {0, 0}};
	struct pose_track_out out = {0};
	int64_t t_ns = T0;

	(void)state;
	for (int side = 0; side < 4; side++) {
		for (int i = 0; i < 100; i++, t_ns += 10 * MS)
			out = drive(track, t_ns, t_ns + 10 * MS, -0.03, 0);
		assert_near(out.pose.position_m.x, corner[side][0], 1e-9);
		assert_near(out.pose.position_m.y, corner[side][1], 1e-9);
		for (int i = 0; i < 50; i++, t_ns += 10 * MS)
			out = drive(track, t_ns, t_ns + 10 * MS, 0, TRIG_PI / 100);
	}
	assert_place(&out.pose, 0, 0, 0, 1e-9);
	pose_track_destroy(track);
}

/* Variances of a straight way of d metres: drift^2 d along it, turn^2 d^3 / 3 across, turn^2 d of the heading. */
static void the_covariance_grows_with_the_way_whatever_its_pieces(void **state)
{
	const double d = 9, along = 0.02 * 0.02 * d, heading = TRIG_DEG * TRIG_DEG * d,
	             across = TRIG_DEG * TRIG_DEG * d * d * d / 3;

	(void)state;
	for (int pieces = 1; pieces <= 900; pieces *= 30) {
		struct pose_track *track = open_track(wheels);
		double before = -1;

		for (int i = 0; i < pieces; i++) {
			const struct pose_track_out out =
			    drive(track, T0 + i * 10 * MS, T0 + (i + 1) * 10 * MS, d / pieces, 0);

			assert_true(out.pose.variance_m2 > before);
			before = out.pose.variance_m2;
		}
		assert_near(status_of(track).sigma_m, sqrt(across > along ? across : along), 1e-9);
		assert_near(status_of(track).sigma_rad, sqrt(heading), 1e-12);
		for (int i = 0; i < 100; i++) /* it stands */
			drive(track, T0 + (pieces + i) * 10 * MS, T0 + (pieces + i + 1) * 10 * MS, 0, 0);
		assert_near(status_of(track).sigma_m, sqrt(across > along ? across : along), 1e-9);
		pose_track_destroy(track);
	}
}

/* Straight ahead at 1 m/s, 100 Hz, from `from` to `to` (steps). */
static struct pose_track_out straight(struct pose_track *track, int from, int to)
{
	struct pose_track_out out = {0};

	for (int i = from; i < to; i++)
		out = drive(track, T0 + i * 10 * MS, T0 + (i + 1) * 10 * MS, 0.01, 0);
	return out;
}

static void an_absolute_pose_without_variance_is_taken_whole(void **state)
{
	struct pose_track *track = open_track(both);
	struct pose_track_out out = take(track, pose_at(T0, 0, 0, 0));

	(void)state;
	assert_true(out.has_pose && !out.has_jump);
	straight(track, 0, 100);
	assert_true(status_of(track).sigma_m > 0.005);
	out = take(track, pose_at(T0 + 1000 * MS, 1.1, 0.2, 0.05));
	assert_false(out.has_jump);
	assert_false(out.has_pose); /* it is of a time that was handed out */
	out = straight(track, 100, 101);
	assert_place(&out.pose, 1.1 + 0.01 * cos(0.05), 0.2 + 0.01 * sin(0.05), 0.05, 1e-9);
	assert_false(out.pose.jumped);
	assert_true(status_of(track).sigma_m < 0.0025);
	assert_int_equal(status_of(track).adjusted, 1);
	pose_track_destroy(track);
}

/* The pose is of a moment 300 ms ago: what was driven since is laid upon it. */
static void a_late_pose_corrects_what_follows(void **state)
{
	struct pose_track *track = open_track(both);
	struct pose_track_out out;

	(void)state;
	take(track, pose_at(T0, 0, 0, 0));
	straight(track, 0, 70);
	for (int i = 70; i < 100; i++)
		drive(track, T0 + i * 10 * MS, T0 + (i + 1) * 10 * MS, 0.01, TRIG_PI / 60);
	take(track, pose_at(T0 + 700 * MS, 0.8, 0.1, 0.02)); /* it was 0.7, 0, 0 by the wheels */
	assert_int_equal(take(track, pose_at(T0 + 650 * MS, 5, 5, 5)).has_pose, false); /* older than the one before */
	assert_int_equal(status_of(track).late, 1);
	out = straight(track, 100, 101);
	/* A quarter turn to the left on an arc of 0.3 m: 0.19 ahead and 0.19 aside, then 1 cm ahead. */
	const double r = 0.3 / (TRIG_PI / 2), c = cos(0.02), s = sin(0.02);
	assert_place(&out.pose, 0.8 + c * r - s * (r + 0.01), 0.1 + s * r + c * (r + 0.01), 0.02 + TRIG_PI / 2, 1e-9);
	pose_track_destroy(track);
}

/* Between two marks, and with another late pose in the same piece. */
static void late_poses_within_a_piece_agree(void **state)
{
	struct pose_track *track = open_track(both);
	struct pose_track_out out;

	(void)state;
	take(track, pose_at(T0, 0, 0, 0));
	drive(track, T0, T0 + 100 * MS, 0.1, 0);
	drive(track, T0 + 100 * MS, T0 + 200 * MS, 0.1, 0);
	take(track, pose_at(T0 + 120 * MS, 0.12, 0.05, 0));
	take(track, pose_at(T0 + 160 * MS, 0.16, 0.05, 0)); /* as the first one has it: changes nothing */
	out = drive(track, T0 + 200 * MS, T0 + 300 * MS, 0.1, 0);
	assert_place(&out.pose, 0.3, 0.05, 0, 1e-12);
	pose_track_destroy(track);
}

/* Equal variances meet half way; a much better pose wins, a much worse one is hardly heard. */
static void a_pose_with_a_variance_is_weighed(void **state)
{
	static const struct {
		double share, low, high;
	} cases[] = {{1, 0.45, 0.55}, {1e-4, 0.99, 1}, {1e4, 0, 0.06}};

	(void)state;
	for (size_t i = 0; i < 3; i++) {
		struct pose_track_params params = both;
		struct pose_track *track;
		struct pose pose = pose_at(T0 + 1000 * MS, 1.2, 0, 0);
		struct pose_track_out out;
		double before;

		params.turn_drift_rad = 0;
		params.drift = 0.1;
		track = open_track(params);
		take(track, pose_at(T0, 0, 0, 0));
		straight(track, 0, 100);
		before = status_of(track).sigma_m; /* 0.1 after one metre */
		assert_near(before, 0.1, 1e-9);
		pose.variance_m2 = cases[i].share * before * before;
		pose.variance_rad2 = 1e-4;
		take(track, pose);
		out = straight(track, 100, 101);
		assert_true(out.pose.position_m.x >= 1.01 + 0.2 * cases[i].low &&
		            out.pose.position_m.x <= 1.01 + 0.2 * cases[i].high);
		if (cases[i].share <= 1)
			assert_true(status_of(track).sigma_m < 0.8 * before);
		pose_track_destroy(track);
	}
}

/* With noise of 10 cm in the poses and 2 % in the wheels, the track is better than either. */
static void many_noisy_poses_make_a_good_track(void **state)
{
	struct pose_track *track = open_track(both);
	uint32_t random = 1;
	double squares = 0;
	struct pose_track_out out = {0};

	(void)state;
	for (int i = 0; i < 3000; i++) {
		struct pose pose = pose_at(T0 + i * 10 * MS, 0, 0, 0);
		double noise[2];

		for (int k = 0; k < 2; k++) {
			random = random * 1664525u + 1013904223u;
			noise[k] = ((double)(random >> 8) / (1 << 24) - 0.5) * 0.34; /* sigma 0.1 */
		}
		pose.position_m = (struct vec3){0.01 * i + noise[0], noise[1], 0};
		pose.variance_m2 = 0.01;
		pose.variance_rad2 = 0.01;
		if (i % 10 == 0)
			assert_false(take(track, pose).has_jump);
		out = drive(track, T0 + i * 10 * MS, T0 + (i + 1) * 10 * MS, 0.0102, 0);
		if (i > 500)
			squares += pow(out.pose.position_m.x - 0.01 * (i + 1), 2) + pow(out.pose.position_m.y, 2);
	}
	print_message("note: poses with sigma 10 cm, wheels 2 %% wrong: the track off by %.1f cm rms\n",
	              100 * sqrt(squares / 2499));
	assert_true(sqrt(squares / 2499) < 0.07); /* half of the poses' own, 0.14 in the plane */
	assert_true(status_of(track).sigma_m < 0.05);
	pose_track_destroy(track);
}

static void height_and_slope_are_those_of_the_last_absolute_pose(void **state)
{
	struct pose_track *track = open_track(both);
	struct pose pose = pose_at(T0, 1, 2, 0);
	struct pose_track_out out;

	(void)state;
	/* Yaw 90 degrees, then a pitch of 0.1 in the robot's own frame: q = yaw * pitch. */
	const double h = TRIG_PI / 4, p = 0.05;
	pose.position_m.z = 0.7;
	pose.rotation =
	    (struct quat){.w = cos(h) * cos(p), .x = -sin(h) * sin(p), .y = cos(h) * sin(p), .z = sin(h) * cos(p)};
	take(track, pose);
	out = drive(track, T0, T0 + 10 * MS, 0.5, -TRIG_PI / 2); /* a quarter turn to the right: yaw 0 */
	assert_near(out.pose.position_m.z, 0.7, 1e-12);
	assert_near(out.pose.rotation.y, sin(p), 1e-9);
	assert_near(out.pose.rotation.w, cos(p), 1e-9);
	assert_near(out.pose.rotation.x, 0, 1e-9);
	pose_track_destroy(track);
}

static void the_track_begins_at_the_origin_where_nobody_says_more(void **state)
{
	struct pose_track *track = open_track(wheels);
	struct pose_track_out out;

	(void)state;
	out = straight(track, 0, 1);
	assert_true(out.has_pose);
	assert_place(&out.pose, 0.01, 0, 0, 1e-12);
	pose_track_destroy(track);
	/* With a pose device it waits two seconds for a first pose. */
	track = open_track(both);
	assert_false(straight(track, 0, 199).has_pose);
	assert_true(straight(track, 199, 201).has_pose);
	pose_track_destroy(track);
	track = open_track(both);
	assert_false(straight(track, 0, 50).has_pose);
	out = take(track, pose_at(T0 + 500 * MS, 7, 8, 1));
	assert_true(out.has_pose && !out.has_jump);
	out = straight(track, 50, 51);
	assert_place(&out.pose, 7 + 0.01 * cos(1), 8 + 0.01 * sin(1), 1, 1e-9);
	pose_track_destroy(track);
}

/* The wheels come back most of a second after the last pose: what the robot did meanwhile is told by the next one, which
 * moved no map. A pose after that one is measured by the wheels alone again, and so is one of before the silence. */
static void what_a_silence_hid_is_no_jump(void **state)
{
	static const double far_m[] = {0.9, 0.0}, turned[] = {0.0, 0.5};

	(void)state;
	for (int i = 0; i < 2; i++) {
		struct pose_track *track = open_track(both);
		struct pose_track_out out;

		take(track, pose_at(T0, 0, 0, 0));
		straight(track, 0, 100);
		out = take(track, pose_at(T0 + 3000 * MS, 2, 0, 0)); /* the wheels are silent */
		assert_false(out.has_jump);
		drive(track, T0 + 3900 * MS, T0 + 3910 * MS, 0.01, 0);
		drive(track, T0 + 3910 * MS, T0 + 3990 * MS, 0.09, 0);
		out = take(track, pose_at(T0 + 3990 * MS, 2.1 + far_m[i], 0, turned[i]));
		assert_false(out.has_jump);
		assert_int_equal(status_of(track).jumps, 0);
		drive(track, T0 + 3990 * MS, T0 + 4100 * MS, 0.0, 0);
		out = take(track, pose_at(T0 + 4100 * MS, 2.1 + far_m[i] + 0.4, 0, turned[i]));
		assert_true(out.has_jump);
		pose_track_destroy(track);
	}
}

static void a_jump_in_a_silence_is_still_one(void **state)
{
	struct pose_track *track = open_track(both);

	(void)state;
	take(track, pose_at(T0, 0, 0, 0));
	straight(track, 0, 100);
	drive(track, T0 + 1200 * MS, T0 + 1210 * MS, 0.01, 0);
	assert_true(take(track, pose_at(T0 + 1210 * MS, 2.0, 0, 0)).has_jump);
	pose_track_destroy(track);

	track = open_track(both); /* late, and of before it */
	take(track, pose_at(T0, 0, 0, 0));
	straight(track, 0, 100);
	drive(track, T0 + 1900 * MS, T0 + 1910 * MS, 0.01, 0);
	assert_true(take(track, pose_at(T0 + 990 * MS, 1.5, 0, 0)).has_jump);
	assert_false(take(track, pose_at(T0 + 1910 * MS, 2.3, 0, 0)).has_jump);
	pose_track_destroy(track);
}

/* Poses a little ahead of the wheels go on as the wheels turned last; the motion that follows is not driven twice. */
static void a_pose_ahead_of_the_wheels_costs_no_way(void **state)
{
	struct pose_track *track = open_track(both);
	struct pose_track_out out;

	(void)state;
	take(track, pose_at(T0, 0, 0, 0));
	straight(track, 0, 100);
	out = take(track, pose_at(T0 + 1004 * MS, 1.054, 0, 0)); /* 5 cm farther on than the wheels say */
	assert_true(out.has_pose && !out.has_jump);
	assert_int_equal(out.pose.t_ns, T0 + 1004 * MS);
	out = straight(track, 100, 101);
	assert_int_equal(out.pose.t_ns, T0 + 1010 * MS);
	assert_place(&out.pose, 1.06, 0, 0, 1e-9);
	pose_track_destroy(track);
}

/* Nothing is reckoned across a silence of the wheels; what comes after it is marked, and known less well. */
static void a_silence_of_the_wheels_is_no_way(void **state)
{
	struct pose_track *track = open_track(wheels);
	struct pose_track_out out;

	(void)state;
	straight(track, 0, 100);
	out = drive(track, T0 + 3000 * MS, T0 + 3010 * MS, 0.01, 0);
	assert_true(out.pose.jumped);
	assert_place(&out.pose, 1.01, 0, 0, 1e-9);
	assert_true(status_of(track).sigma_m > 1.9); /* it may have gone on for two seconds */
	assert_int_equal(status_of(track).gaps, 1);
	out = drive(track, T0 + 3010 * MS, T0 + 3020 * MS, 0.01, 0);
	assert_false(out.pose.jumped);
	/* One piece that is longer than anybody reckons: driven, but nothing is known of what lay in it. */
	out = drive(track, T0 + 3020 * MS, T0 + 3420 * MS, 0.4, 0);
	assert_true(out.pose.jumped);
	pose_track_destroy(track);
}

/* While the wheels are silent absolute poses are taken as they come, also those that say how good they are. */
static void poses_alone_are_followed_while_the_wheels_are_silent(void **state)
{
	struct pose_track *track = open_track(both);
	struct pose_track_out out = {0};

	(void)state;
	take(track, pose_at(T0, 0, 0, 0));
	straight(track, 0, 100);
	for (int i = 15; i < 60; i++) {
		struct pose pose = pose_at(T0 + (1000 + i * 10) * MS, 1 + 0.02 * i, 0, 0);

		pose.variance_m2 = 0.01;
		pose.variance_rad2 = 0.01;
		out = take(track, pose);
		assert_true(out.has_pose && !out.has_jump);
		assert_place(&out.pose, 1 + 0.02 * i, 0, 0, 1e-9);
	}
	pose_track_destroy(track);
}

static void motions_that_no_robot_makes_are_refused(void **state)
{
	struct pose_track *track = open_track(wheels);
	struct pose_track_out out;

	(void)state;
	straight(track, 0, 1);
	assert_false(drive(track, T0 + 10 * MS, T0 + 20 * MS, NAN, 0).has_pose);
	assert_false(drive(track, T0 + 10 * MS, T0 + 20 * MS, 0, INFINITY).has_pose);
	assert_false(drive(track, T0 + 10 * MS, T0 + 20 * MS, 1e9, 0).has_pose);
	assert_false(drive(track, T0 + 20 * MS, T0 + 20 * MS, 0.1, 0).has_pose);
	assert_int_equal(status_of(track).refused, 4);
	out = straight(track, 1, 2);
	assert_place(&out.pose, 0.02, 0, 0, 1e-12);
	pose_track_destroy(track);
	track = open_track(poses(POSE_TRACK_KEEP)); /* nobody asked for wheels */
	assert_false(drive(track, T0, T0 + 10 * MS, 0.01, 0).has_pose);
	pose_track_destroy(track);
}

/* Jumps. A drive at 1 m/s along x; from step `at` on (and up to `until`) the map lies 2 m to the side, turned by 20 degrees. */
struct drive_of_poses {
	int step_ms, at, until, n;
};

static struct pose moved_pose(const struct drive_of_poses *d, int i)
{
	const bool moved = i >= d->at && i < d->until;
	const double x = 0.001 * d->step_ms * i, c = cos(20 * TRIG_DEG), s = sin(20 * TRIG_DEG);

	return moved ? pose_at(T0 + i * d->step_ms * MS, c * x, s * x + 2, 20 * TRIG_DEG)
	             : pose_at(T0 + i * d->step_ms * MS, x, 0, 0);
}

/* At every rate a localisation has. */
static const int step_ms[] = {2, 10, 25, 100, 250, 500};

static void a_jump_kept_is_marked_and_told_once(void **state)
{
	(void)state;
	for (size_t k = 0; k < sizeof(step_ms) / sizeof(*step_ms); k++) {
		const struct drive_of_poses d = {step_ms[k], 20, 1000, 40};
		struct pose_track *track = open_track(poses(POSE_TRACK_KEEP));

		for (int i = 0; i < d.n; i++) {
			const struct pose pose = moved_pose(&d, i);
			const struct pose_track_out out = take(track, pose);

			assert_int_equal(out.has_jump, i == 20);
			assert_int_equal(out.pose.jumped, i == 20);
			assert_place(&out.pose, pose.position_m.x, pose.position_m.y, yaw_of(&pose), 0);
			if (i != 20)
				continue;
			const double x = 0.001 * d.step_ms * 20;
			assert_near(out.jump.distance_m,
			            hypot(x * (cos(20 * TRIG_DEG) - 1), x * sin(20 * TRIG_DEG) + 2), 1e-6);
			assert_near(out.jump.angle_rad, 20 * TRIG_DEG, 1e-6);
			assert_false(out.jump.back);
			assert_int_equal(out.jump.done, POSE_TRACK_KEEP);
			assert_int_equal(out.jump.t_ns, pose.t_ns);
		}
		assert_int_equal(status_of(track).jumps, 1);
		pose_track_destroy(track);
	}
}

static void a_jump_ignored_leaves_no_trace(void **state)
{
	(void)state;
	for (size_t k = 0; k < sizeof(step_ms) / sizeof(*step_ms); k++) {
		const struct drive_of_poses d = {step_ms[k], 20, 1000, 60};
		struct pose_track *track = open_track(poses(POSE_TRACK_IGNORE));

		for (int i = 0; i < d.n; i++) {
			const struct pose_track_out out = take(track, moved_pose(&d, i));

			assert_int_equal(out.has_jump, i == 20);
			assert_false(out.pose.jumped);
			assert_place(&out.pose, 0.001 * d.step_ms * i, 0, 0, 1e-9);
		}
		pose_track_destroy(track);
	}
}

static void an_outlier_is_one_jump_and_one_back(void **state)
{
	static const enum pose_track_on_jump modes[] = {POSE_TRACK_KEEP, POSE_TRACK_IGNORE, POSE_TRACK_NEW_MAP};

	(void)state;
	for (size_t k = 0; k < sizeof(step_ms) / sizeof(*step_ms); k++)
		for (size_t m = 0; m < 3; m++) {
			const struct drive_of_poses d = {step_ms[k], 20, 21, 40};
			struct pose_track *track = open_track(poses(modes[m]));

			for (int i = 0; i < d.n; i++) {
				const struct pose pose = moved_pose(&d, i);
				const struct pose_track_out out = take(track, pose);

				assert_int_equal(out.has_jump, i == 20 || i == 21);
				assert_int_equal(out.has_jump && out.jump.back, i == 21);
				assert_int_equal(out.pose.jumped, out.has_jump && modes[m] != POSE_TRACK_IGNORE);
				if (i != 20) /* to the bit, also where it was ignored */
					assert_memory_equal(&out.pose.position_m, &pose.position_m,
					                    sizeof(pose.position_m));
			}
			pose_track_destroy(track);
		}
}

/* Nobody moved the map: a robot that starts, brakes, turns, and poses with gaps and noise. */
static void an_ordinary_drive_has_no_jumps(void **state)
{
	(void)state;
	for (size_t k = 0; k < sizeof(step_ms) / sizeof(*step_ms); k++) {
		struct pose_track *track = open_track(poses(POSE_TRACK_KEEP));
		double x = 0, y = 0, yaw = 0;
		uint32_t random = 7;

		for (int i = 0, t_ms = 0; t_ms < 60000; i++) {
			const int gap = i % 37 == 36 ? 5 * step_ms[k] : step_ms[k];
			double noise[2];

			for (int j = 0; j < gap;
			     j++, t_ms++) { /* full speed from one moment to the other, and turns on the spot */
				const double v = t_ms / 3000 % 2 ? 0.8 : 0, w = t_ms / 3000 % 4 == 2 ? 0.6 : 0;

				x += 0.001 * v * cos(yaw);
				y += 0.001 * v * sin(yaw);
				yaw += 0.001 * w;
			}
			for (int j = 0; j < 2; j++) {
				random = random * 1664525u + 1013904223u;
				noise[j] = ((double)(random >> 8) / (1 << 24) - 0.5) * 0.04;
			}
			if (take(track, pose_at(T0 + t_ms * MS, x + noise[0], y + noise[1], yaw)).has_jump)
				fail_msg("poses %d ms apart: a jump at %d ms", step_ms[k], t_ms);
		}
		pose_track_destroy(track);
	}
}

/* A localisation that comes up after the wheels: what was held until then was the origin, and no correction. */
static void the_first_absolute_pose_is_never_ignored(void **state)
{
	struct pose_track_params params = both;
	struct pose_track *track;
	struct pose_track_out out;

	(void)state;
	params.on_jump = POSE_TRACK_IGNORE;
	track = open_track(params);
	straight(track, 0, 300);
	out = take(track, pose_at(T0 + 2995 * MS, 7, 8, 0));
	assert_true(out.has_jump && out.jump.done == POSE_TRACK_KEEP && out.pose.jumped);
	out = straight(track, 300, 301);
	assert_place(&out.pose, 7.015, 8, 0, 1e-6);
	/* From then on jumps are. */
	out = take(track, pose_at(T0 + 3005 * MS, 20, 8, 0));
	assert_true(out.has_jump && out.jump.done == POSE_TRACK_IGNORE && !out.jump.back);
	out = straight(track, 301, 302);
	assert_place(&out.pose, 7.025, 8, 0, 1e-6);
	out = take(track, pose_at(T0 + 3015 * MS, 7.02, 8, 0));
	assert_true(out.has_jump && out.jump.back);
	out = straight(track, 302, 303);
	assert_place(&out.pose, 7.035, 8, 0, 1e-6);
	pose_track_destroy(track);
}

static void a_jump_under_odometry_is_done_as_ordered(void **state)
{
	static const enum pose_track_on_jump modes[] = {POSE_TRACK_KEEP, POSE_TRACK_IGNORE, POSE_TRACK_NEW_MAP};

	(void)state;
	for (size_t m = 0; m < 3; m++)
		for (int late = 0; late < 2; late++) {
			struct pose_track_params params = both;
			struct pose_track *track;
			struct pose_track_out out;
			const int64_t t_ns = T0 + (late ? 900 : 1005) * MS;
			const double x = late ? 0.9 : 1.005;

			params.on_jump = modes[m];
			track = open_track(params);
			take(track, pose_at(T0, 0, 0, 0));
			straight(track, 0, 100);
			out = take(track, pose_at(t_ns, x, 2, 0));
			assert_true(out.has_jump);
			assert_near(out.jump.distance_m, 2, 1e-9);
			if (modes[m] == POSE_TRACK_IGNORE) {
				assert_int_equal(out.has_pose, !late);
				assert_false(out.has_pose && out.pose.jumped);
				out = straight(track, 100, 101);
				assert_place(&out.pose, 1.01, 0, 0, 1e-9);
				out =
				    take(track, pose_at(T0 + 1012 * MS, 1.012, 2.1, 0)); /* in the frame that is held */
				assert_false(out.has_jump);
				assert_place(&out.pose, 1.012, 0.1, 0, 1e-9);
			} else { /* the frame ends where the track does: at once */
				assert_true(out.has_pose && out.pose.jumped);
				assert_int_equal(out.pose.t_ns, late ? T0 + 1000 * MS + 1 : t_ns);
				out = straight(track, 100, 101);
				assert_false(out.pose.jumped);
				assert_place(&out.pose, 1.01, 2, 0, 1e-7);
				out = take(track, pose_at(T0 + 1012 * MS, 1.012, 0, 0));
				assert_true(out.has_jump && out.jump.back);
			}
			pose_track_destroy(track);
		}
}

/* A hundred corrections just below the threshold are none. */
static void corrections_below_the_threshold_are_no_jumps(void **state)
{
	struct pose_track *track = open_track(both);

	(void)state;
	take(track, pose_at(T0, 0, 0, 0));
	for (int i = 0; i < 100; i++) {
		struct pose_track_out out = straight(track, 10 * i, 10 * (i + 1));

		out = take(track, pose_at(T0 + (i + 1) * 100 * MS, 0.1 * (i + 1), i % 2 ? 0 : 0.29, 0));
		assert_false(out.has_jump || (out.has_pose && out.pose.jumped));
	}
	assert_int_equal(status_of(track).jumps, 0);
	pose_track_destroy(track);
}

/* One session of everything: `i` of N. */
#define SESSION 600

static void play(struct pose_track *track, int i, struct pose_track_out *ret)
{
	const int64_t t_ns = T0 + i * 10 * MS;
	const double side = i >= 300 && i < 420 ? 2 : 0;
	struct pose pose = pose_at(t_ns - (i % 3) * 7 * MS, 0.01 * i + 0.002 * (i % 5), side, 0.001 * i);

	memset(ret, 0, sizeof(*ret));
	if (i % 7 == 3) {
		pose.variance_m2 = i % 2 ? 0.01 : 0;
		pose.variance_rad2 = i % 2 ? 0.001 : 0;
		*ret = take(track, pose);
	} else if (i < 200 || i > 260) {
		*ret = drive(track, t_ns, t_ns + 10 * MS, 0.01, 0.001);
	}
}

static size_t save(struct pose_track *track, uint8_t *bytes, size_t cap)
{
	struct state s;

	state_save(&s, bytes, cap);
	pose_track_state(&s, track);
	assert_true(state_done(&s));
	return s.at;
}

static void a_snapshot_goes_on_from_anywhere(void **state)
{
	static uint8_t bytes[1 << 18], again[1 << 18];
	static const enum pose_track_on_jump modes[] = {POSE_TRACK_KEEP, POSE_TRACK_IGNORE};

	(void)state;
	for (int kind = 0; kind < 4; kind++)
		for (int cut = 0; cut < SESSION; cut += 13) {
			struct pose_track_params params = both;
			struct pose_track *whole, *part;
			struct pose_track_out a, b;
			struct state s;
			size_t len;

			params.on_jump = modes[kind % 2];
			params.motion = kind < 2;
			whole = open_track(params);
			part = open_track(params);
			for (int i = 0; i < cut; i++)
				play(whole, i, &a);
			len = save(whole, bytes, sizeof(bytes));
			state_load(&s, bytes, len);
			pose_track_state(&s, part);
			assert_true(state_done(&s));
			for (int i = cut; i < SESSION && i < cut + 150; i++) {
				play(whole, i, &a);
				play(part, i, &b);
				assert_int_equal(a.has_pose, b.has_pose);
				assert_int_equal(a.has_jump, b.has_jump);
				if (a.has_pose)
					assert_memory_equal(&a.pose, &b.pose, sizeof(a.pose));
			}
			len = save(whole, bytes, sizeof(bytes));
			assert_int_equal(save(part, again, sizeof(again)), len);
			assert_memory_equal(bytes, again, len);
			pose_track_destroy(whole);
			pose_track_destroy(part);
		}
}

static void a_damaged_snapshot_leaves_the_track_as_new(void **state)
{
	static uint8_t bytes[1 << 18], fresh[1 << 18], after[1 << 18];
	struct pose_track *track = open_track(both), *other = open_track(both);
	struct pose_track_out out;
	struct state s;
	const size_t fresh_len = save(other, fresh, sizeof(fresh));
	size_t len;

	(void)state;
	for (int i = 0; i < 50; i++)
		play(track, i, &out);
	len = save(track, bytes, sizeof(bytes));
	for (size_t cut = 0; cut < len; cut += 11) {
		state_load(&s, bytes, cut);
		pose_track_state(&s, other);
		assert_true(s.failed);
		assert_int_equal(save(other, after, sizeof(after)), fresh_len);
		assert_memory_equal(after, fresh, fresh_len);
	}
	pose_track_destroy(track);
	pose_track_destroy(other);
}

/* The same sequence gives the same bits, whatever was done before in this process. */
static void time_set_back_begins_the_way_anew(void **state)
{
	struct pose_track *track = open_track(wheels);
	struct pose_track_out out;

	(void)state;
	straight(track, 0, 1000);
	out = drive(track, T0, T0 + 10 * MS, 0.01, 0);
	assert_true(out.has_pose);
	assert_int_equal(out.pose.t_ns, T0 + 10 * MS);
	assert_place(&out.pose, 10.01, 0, 0, 1e-9);
	pose_track_destroy(track);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(an_origin_that_nobody_knows_is_not_trusted),
	    cmocka_unit_test(without_odometry_poses_pass_to_the_bit),
	    cmocka_unit_test(a_circle_is_driven_in_closed_form),
	    cmocka_unit_test(a_square_is_driven_backwards_too),
	    cmocka_unit_test(the_covariance_grows_with_the_way_whatever_its_pieces),
	    cmocka_unit_test(an_absolute_pose_without_variance_is_taken_whole),
	    cmocka_unit_test(a_late_pose_corrects_what_follows),
	    cmocka_unit_test(late_poses_within_a_piece_agree),
	    cmocka_unit_test(a_pose_with_a_variance_is_weighed),
	    cmocka_unit_test(many_noisy_poses_make_a_good_track),
	    cmocka_unit_test(height_and_slope_are_those_of_the_last_absolute_pose),
	    cmocka_unit_test(the_track_begins_at_the_origin_where_nobody_says_more),
	    cmocka_unit_test(a_pose_ahead_of_the_wheels_costs_no_way),
	    cmocka_unit_test(a_silence_of_the_wheels_is_no_way),
	    cmocka_unit_test(what_a_silence_hid_is_no_jump),
	    cmocka_unit_test(a_jump_in_a_silence_is_still_one),
	    cmocka_unit_test(poses_alone_are_followed_while_the_wheels_are_silent),
	    cmocka_unit_test(motions_that_no_robot_makes_are_refused),
	    cmocka_unit_test(a_jump_kept_is_marked_and_told_once),
	    cmocka_unit_test(a_jump_ignored_leaves_no_trace),
	    cmocka_unit_test(an_outlier_is_one_jump_and_one_back),
	    cmocka_unit_test(an_ordinary_drive_has_no_jumps),
	    cmocka_unit_test(the_first_absolute_pose_is_never_ignored),
	    cmocka_unit_test(a_jump_under_odometry_is_done_as_ordered),
	    cmocka_unit_test(corrections_below_the_threshold_are_no_jumps),
	    cmocka_unit_test(a_snapshot_goes_on_from_anywhere),
	    cmocka_unit_test(a_damaged_snapshot_leaves_the_track_as_new),
	    cmocka_unit_test(time_set_back_begins_the_way_anew),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

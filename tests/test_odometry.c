/* Laws L7, L8: motion is what the frames say and nothing more: golden frames give golden ways, counts wrap, both models agree on
 * one drive; silences, steps of a count and frames that say something else are counted and not driven. */
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
#include "drivers/can_bus.h"
#include "drivers/can_signal.h"
#include "drivers/driver.h"

#define MS INT64_C(1000000)
#define T0 (INT64_C(1700000000000) * MS)

struct bench {
	struct config config;
	struct decoder *decoder;
	struct dialogue *dialogue;
	struct motion last;
	double way, turn;
	int motions, replies;
	bool gap; /* a motion did not begin where the one before ended */
	int64_t now_ns;
};

static void on_motion(void *ctx, int device, const struct motion *motion)
{
	struct bench *b = ctx;

	assert_int_equal(device, 0);
	assert_true(motion->t_ns > motion->from_ns);
	b->gap |= b->motions > 0 && motion->from_ns != b->last.t_ns;
	b->last = *motion;
	b->way += motion->ahead_m;
	b->turn += motion->turn_rad;
	b->motions++;
	if (b->dialogue)
		driver_odometry.dialogue_data(b->dialogue, b->now_ns);
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	struct bench *b = ctx;

	(void)device;
	b->replies++;
	if (b->dialogue)
		driver_odometry.dialogue_reply(b->dialogue, reply);
}

/* `keys`: of the device, as in the file. */
static void open_bench(struct bench *b, const char *keys)
{
	char text[1024];
	struct config_error error;

	memset(b, 0, sizeof(*b));
	snprintf(text, sizeof(text), "devices: [{name: wheels, driver: odometry, connect: can0, %s}]", keys);
	if (config_read(text, strlen(text), "test", &b->config, &error) < 0)
		fail_msg("%s", error.text);
	b->decoder = driver_odometry.decoder_create(&b->config.device[0], 0);
	assert_non_null(b->decoder);
	b->now_ns = T0;
}

static void close_bench(struct bench *b)
{
	driver_odometry.decoder_destroy(b->decoder);
	if (b->dialogue)
		driver_odometry.dialogue_destroy(b->dialogue);
}

static void give_bytes(struct bench *b, enum direction direction, const uint8_t *bytes, size_t len)
{
	const struct record_sink sink = {.ctx = b, .motion = on_motion, .reply = on_reply};
	const struct record record = {
	    .log_ns = b->now_ns, .t_ns = b->now_ns, .direction = direction, .bytes = bytes, .len = len};

	driver_odometry.decode(b->decoder, &record, &sink);
}

static void give(struct bench *b, struct can_frame_at frame, int64_t t_ns)
{
	uint8_t bytes[CAN_WIRE_ENTRY_FD];

	frame.t_ns = t_ns;
	b->now_ns = t_ns > b->now_ns ? t_ns : b->now_ns;
	give_bytes(b, FROM_DEVICE, bytes, can_wire_put(&frame, bytes));
}

static uint64_t counter(const struct bench *b, const char *name)
{
	struct decoder_counters counters;

	driver_odometry.counters(b->decoder, &counters);
	assert_true(counters.n <= DECODER_COUNTERS_MAX);
	for (int i = 0; i < counters.n; i++)
		if (strcmp(counters.counter[i].name, name) == 0)
			return counters.counter[i].count;
	fail_msg("no counter '%s'", name);
	return 0;
}

static void assert_near(double is, double wanted, double tolerance)
{
	if (!(fabs(is - wanted) <= tolerance))
		fail_msg("%.9g is not %.9g within %g", is, wanted, tolerance);
}

static const char SPEEDS[] = "speed: {id: 0x200, start: 0, length: 16, scale: 1mm/s}, "
                             "turn: {id: 0x200, start: 16, length: 16, scale: 0.1deg/s}";
static const char WHEELS[] = "left: {id: 0x201, start: 0, length: 16, type: unsigned, scale: 0.1mm}, "
                             "right: {id: 0x201, start: 16, length: 16, type: unsigned, scale: 0.1mm}, track: 0.5";
static const char WHEELS_APART[] =
    "left: {id: 0x201, start: 7, length: 16, order: motorola, scale: 0.1mm}, "
    "right: {id: 0x202, start: 7, length: 16, order: motorola, scale: -0.1mm}, track: 0.5";

/* 500 mm/s and 10 degrees/s: F4 01 64 00. */
static void golden_frames_of_speed_and_turn(void **state)
{
	const uint8_t first[] = {0xF4, 0x01, 0x64, 0x00},
	              second[] = {0x58, 0x02, 0x9C, 0xFF}; /* 600 mm/s, -10 degrees/s */
	struct bench b;

	(void)state;
	open_bench(&b, SPEEDS);
	give(&b, can_wire_frame(0x200, first, 4), T0);
	assert_int_equal(b.motions, 0); /* how it came to that nobody knows */
	give(&b, can_wire_frame(0x200, first, 4), T0 + 20 * MS);
	assert_int_equal(b.motions, 1);
	assert_int_equal(b.last.from_ns, T0);
	assert_int_equal(b.last.t_ns, T0 + 20 * MS);
	assert_near(b.last.ahead_m, 0.01, 1e-12);
	assert_near(b.last.turn_rad, 0.2 * 3.14159265358979 / 180, 1e-12);
	give(&b, can_wire_frame(0x200, second, 4), T0 + 40 * MS); /* even between the two: the mean */
	assert_near(b.last.ahead_m, 0.011, 1e-12);
	assert_near(b.last.turn_rad, 0, 1e-12);
	close_bench(&b);
}

static struct can_frame_at counts(uint16_t left, uint16_t right)
{
	const uint8_t data[4] = {(uint8_t)left, (uint8_t)(left >> 8), (uint8_t)right, (uint8_t)(right >> 8)};

	return can_wire_frame(0x201, data, 4);
}

static void golden_frames_of_two_wheels(void **state)
{
	struct bench b;

	(void)state;
	open_bench(&b, WHEELS);
	give(&b, counts(1000, 2000), T0);
	give(&b, counts(1100, 2200), T0 + 20 * MS); /* 1 cm and 2 cm */
	assert_near(b.last.ahead_m, 0.015, 1e-12);
	assert_near(b.last.turn_rad, 0.02, 1e-12);
	give(&b, counts(1000, 2300), T0 + 40 * MS);
	assert_near(b.last.ahead_m, 0, 1e-12);
	assert_near(b.last.turn_rad, 0.04, 1e-12);
	close_bench(&b);
}

static void counts_wrap_where_their_bits_or_the_configuration_say(void **state)
{
	struct bench b;

	(void)state;
	open_bench(&b, WHEELS);
	give(&b, counts(65500, 100), T0);
	give(&b, counts(64, 65436), T0 + 20 * MS); /* 100 on, 200 back */
	assert_near(b.way, -0.005, 1e-12);
	assert_near(b.turn, -0.06, 1e-12);
	close_bench(&b);
	open_bench(&b,
	           "left: {id: 0x201, start: 0, length: 16, type: unsigned, scale: 1mm, wrap: 10000}, "
	           "right: {id: 0x201, start: 16, length: 16, type: unsigned, scale: 1mm, wrap: 10000}, track: 0.5");
	give(&b, counts(9990, 5), T0);
	give(&b, counts(10, 9985), T0 + 20 * MS);
	assert_near(b.way, 0, 1e-12);
	assert_near(b.turn, -0.08, 1e-12);
	assert_int_equal(counter(&b, "jumps of a count"), 0);
	close_bench(&b);
}

/* Frames of the two wheels 3 ms apart, one signed and turning the other way: the same circle. */
static void two_frames_are_as_good_as_one(void **state)
{
	struct bench b;

	(void)state;
	open_bench(&b, WHEELS_APART);
	for (int i = 0; i <= 200; i++) {
		const int64_t t_ns = T0 + i * 10 * MS;
		const int left = 100 * i, right = -(110 * i + 33); /* 3 ms later: 0.3 of a period more */
		const uint8_t one[2] = {(uint8_t)(left >> 8), (uint8_t)left},
		              other[2] = {(uint8_t)(right >> 8), (uint8_t)right};

		give(&b, can_wire_frame(0x201, one, 2), t_ns);
		give(&b, can_wire_frame(0x202, other, 2), t_ns + 3 * MS);
	}
	/* From the first time at which both are known (3 ms) to the last (2 s). */
	assert_false(b.gap);
	assert_int_equal(b.last.t_ns, T0 + 2000 * MS);
	assert_near(b.way, 1.05 * 1.997, 1e-9);
	assert_near(b.turn, 0.1 * 1.997 / 0.5, 1e-9);
	close_bench(&b);
}

/* The fast one is summed up until the slow one has come. */
static void different_rates_lose_nothing(void **state)
{
	struct bench b;

	(void)state;
	open_bench(&b, "speed: {id: 0x200, length: 16, scale: 1mm/s}, turn: {id: 0x300, length: 16, scale: 0.1deg/s}");
	for (int i = 0; i <= 400; i++) {
		const uint8_t speed[2] = {(uint8_t)i, (uint8_t)(i >> 8)}, turn[2] = {100, 0}; /* i mm/s */

		give(&b, can_wire_frame(0x200, speed, 2), T0 + i * 5 * MS);
		if (i % 20 == 0)
			give(&b, can_wire_frame(0x300, turn, 2), T0 + i * 5 * MS);
	}
	assert_false(b.gap);
	assert_int_equal(b.motions, 20);
	assert_near(b.way, 0.4 * 2 / 2, 1e-9);
	assert_near(b.turn, 20 * 3.14159265358979 / 180, 1e-9);
	close_bench(&b);
}

/* Where the robot is on its drive: an eight, at a speed that changes. */
static void both_models_agree_on_one_drive(void **state)
{
	const struct pose_track_params params = {.motion = true, .drift = 0.02, .turn_drift_rad = 0.02};
	const double track_m = 0.5;
	struct pose end[2];

	(void)state;
	for (int wheels = 0; wheels < 2; wheels++) {
		struct bench b;
		struct pose_track *track = pose_track_create(&params);
		struct pose_track_out out = {0};
		double left = 0, right = 0, x = 0, y = 0, heading = 0;
		int told = 0;

		open_bench(&b, wheels ? WHEELS : SPEEDS);
		for (int i = 0; i <= 40000; i++) { /* 1 ms steps of the truth, a frame every 10 */
			const double t = 0.001 * i, v = 0.5 + 0.3 * sin(0.7 * t), w = 0.6 * sin(0.31 * t);

			if (i % 10 == 0) {
				struct can_frame_at f = {.id = 0x200, .len = 4};

				if (wheels) {
					f = counts((uint16_t)(int64_t)rint(left / 1e-4),
					           (uint16_t)(int64_t)rint(right / 1e-4));
				} else {
					can_signal_put(&b.config.device[0].ahead, v, &f);
					can_signal_put(&b.config.device[0].turn, w, &f);
				}
				give(&b, f, T0 + i * MS);
				if (b.motions > told)
					pose_track_motion(track, &b.last, &out);
				told = b.motions;
			}
			left += 0.001 * (v - w * track_m / 2);
			right += 0.001 * (v + w * track_m / 2);
			x += 0.001 * v * cos(heading + 0.0005 * w);
			y += 0.001 * v * sin(heading + 0.0005 * w);
			heading += 0.001 * w;
		}
		assert_true(out.has_pose);
		end[wheels] = out.pose;
		print_message("note: 40 s of an eight by %s: %.1f mm from the truth\n", wheels ? "counts" : "speeds",
		              1000 * hypot(out.pose.position_m.x - x, out.pose.position_m.y - y));
		assert_true(hypot(out.pose.position_m.x - x, out.pose.position_m.y - y) < 0.02);
		pose_track_destroy(track);
		close_bench(&b);
	}
	assert_true(hypot(end[0].position_m.x - end[1].position_m.x, end[0].position_m.y - end[1].position_m.y) < 0.03);
}

/* A speed is not carried on; a count knows what was driven, as long as its device is not lost. */
static void silences_are_not_driven(void **state)
{
	const uint8_t fast[] = {0xE8, 0x03, 0, 0}; /* 1 m/s */
	struct bench b;

	(void)state;
	open_bench(&b, SPEEDS);
	give(&b, can_wire_frame(0x200, fast, 4), T0);
	give(&b, can_wire_frame(0x200, fast, 4), T0 + 250 * MS);
	assert_near(b.way, 0.25, 1e-12);
	give(&b, can_wire_frame(0x200, fast, 4), T0 + 501 * MS);
	assert_near(b.way, 0.25, 1e-12);
	assert_int_equal(counter(&b, "gaps"), 2); /* of both numbers */
	give(&b, can_wire_frame(0x200, fast, 4), T0 + 521 * MS);
	assert_true(b.gap);
	assert_near(b.way, 0.27, 1e-12);
	assert_int_equal(b.last.from_ns, T0 + 501 * MS);
	close_bench(&b);

	open_bench(&b, WHEELS);
	give(&b, counts(0, 0), T0);
	give(&b, counts(4000, 4000), T0 + 400 * MS);
	assert_near(b.way, 0.4, 1e-12);
	give(&b, counts(8000, 8000), T0 + 950 * MS);
	assert_near(b.way, 0.4, 1e-12);
	give(&b, counts(8100, 8100), T0 + 960 * MS);
	assert_near(b.way, 0.41, 1e-12);
	close_bench(&b);
}

/* The encoder was switched off and on: 3 m in 20 ms. */
static void a_step_of_a_count_is_counted_and_not_driven(void **state)
{
	struct bench b;

	(void)state;
	open_bench(&b, WHEELS);
	give(&b, counts(30000, 30000), T0);
	give(&b, counts(30100, 30100), T0 + 20 * MS);
	give(&b, counts(0, 0), T0 + 40 * MS);
	assert_near(b.way, 0.01, 1e-12);
	assert_int_equal(counter(&b, "jumps of a count"), 2);
	give(&b, counts(100, 100), T0 + 60 * MS);
	assert_near(b.way, 0.02, 1e-12);
	assert_int_equal(b.last.from_ns, T0 + 40 * MS);
	close_bench(&b);
}

static void frames_that_say_something_else_are_counted_by_reason(void **state)
{
	const uint8_t data[4] = {1, 2, 3, 4};
	static const char *const keys =
	    "speed: {id: 0x200, length: 16, scale: 1mm/s, valid: {bit: 40}, counter: {start: 32, length: 8}}, "
	    "turn: {id: 0x200, start: 16, length: 16, scale: 10rad/s}";
	uint8_t good[6] = {100, 0, 0, 0, 1, 1};
	struct can_frame_at f;
	struct bench b;

	(void)state;
	open_bench(&b, SPEEDS);
	give(&b, can_wire_frame(0x201, data, 4), T0); /* not ours at all */
	give(&b, can_wire_frame(0x200, data, 3), T0); /* the turn is cut off; the speed is whole */
	give(&b, can_wire_frame(0x200 | CAN_WIRE_EXTENDED, data, 4), T0);
	give(&b, can_wire_frame(0x200 | CAN_WIRE_REMOTE, data, 0), T0);
	assert_int_equal(counter(&b, "values"), 1);
	assert_int_equal(counter(&b, "short"), 1);
	assert_int_equal(counter(&b, "foreign"), 2);
	assert_int_equal(counter(&b, "remote"), 2);
	give_bytes(&b, FROM_DEVICE, data, 4);
	assert_int_equal(counter(&b, "malformed"), 1);
	give(&b, can_wire_frame(0x200, data, 4), INT64_MAX);
	assert_int_equal(counter(&b, "malformed"), 2);
	close_bench(&b);

	open_bench(&b, keys);
	give(&b, can_wire_frame(0x200, good, 6), T0);
	good[4] = 5;
	give(&b, can_wire_frame(0x200, good, 6), T0 + 10 * MS);
	assert_int_equal(counter(&b, "lost by counter"), 3);
	good[5] = 0;
	give(&b, can_wire_frame(0x200, good, 6), T0 + 20 * MS);
	assert_int_equal(counter(&b, "invalid"), 1);
	assert_int_equal(counter(&b, "counter stuck"), 1);
	good[5] = 1;
	good[2] = 6; /* 60 rad/s */
	give(&b, can_wire_frame(0x200, good, 6), T0 + 30 * MS);
	assert_int_equal(counter(&b, "implausible"), 1);
	f = can_wire_frame(CAN_WIRE_ERROR | CAN_WIRE_ERROR_BUS_OFF, data, 4);
	f.len = 8;
	give(&b, f, T0 + 40 * MS);
	assert_true(b.replies > 0);
	close_bench(&b);
}

static void times_that_do_not_rise_are_ignored_until_time_was_set_back(void **state)
{
	struct bench b;

	(void)state;
	open_bench(&b, WHEELS);
	give(&b, counts(0, 0), T0 + 5000 * MS);
	give(&b, counts(100, 100), T0 + 5020 * MS);
	give(&b, counts(50, 50), T0 + 5010 * MS);
	give(&b, counts(100, 100), T0 + 5020 * MS);
	assert_near(b.way, 0.01, 1e-12);
	assert_int_equal(b.motions, 1);
	give(&b, counts(200, 200), T0);
	give(&b, counts(300, 300), T0 + 20 * MS);
	assert_near(b.way, 0.02, 1e-12);
	assert_int_equal(b.last.t_ns, T0 + 20 * MS);
	close_bench(&b);
}

static size_t save(struct bench *b, uint8_t *bytes, size_t cap)
{
	struct state s;

	state_save(&s, bytes, cap);
	driver_odometry.state(b->decoder, &s);
	assert_true(state_done(&s));
	return s.at;
}

static void a_snapshot_goes_on_from_anywhere(void **state)
{
	static uint8_t bytes[1 << 14], again[1 << 14];

	(void)state;
	for (int cut = 0; cut < 60; cut++) {
		struct bench whole, part;
		struct state s;
		size_t len;

		open_bench(&whole, WHEELS_APART);
		open_bench(&part, WHEELS_APART);
		for (int i = 0; i < 120; i++) {
			const uint8_t data[2] = {(uint8_t)(i * 30 >> 8), (uint8_t)(i * 30)};
			const struct can_frame_at f = can_wire_frame(i % 3 ? 0x201 : 0x202, data, i == 33 ? 1 : 2);

			if (i == cut) {
				len = save(&whole, bytes, sizeof(bytes));
				state_load(&s, bytes, len);
				driver_odometry.state(part.decoder, &s);
				assert_true(state_done(&s));
			}
			give(&whole, f, T0 + i * (i == 70 ? 20 : 7) * MS);
			if (i < cut)
				continue;
			give(&part, f, T0 + i * (i == 70 ? 20 : 7) * MS);
			assert_memory_equal(&whole.last.t_ns, part.motions ? &part.last.t_ns : &whole.last.t_ns, 8);
		}
		len = save(&whole, bytes, sizeof(bytes));
		assert_int_equal(save(&part, again, sizeof(again)), len);
		assert_memory_equal(bytes, again, len);
		assert_true(cut > 5 || part.motions > 20);
		/* Cut short it is refused, and leaves the decoder as new. */
		state_load(&s, bytes, len - 1);
		driver_odometry.state(part.decoder, &s);
		assert_true(s.failed);
		assert_int_equal(counter(&part, "motions"), 0);
		close_bench(&whole);
		close_bench(&part);
	}
}

static struct dialogue_step step(struct bench *b, int64_t t_ns)
{
	struct dialogue_step ret;

	b->now_ns = t_ns;
	driver_odometry.dialogue_step(b->dialogue, t_ns, &ret);
	assert_int_equal(ret.write_len, 0); /* it never writes */
	return ret;
}

static void says(const struct dialogue_step *step, const char *words)
{
	if (!strstr(step->error, words))
		fail_msg("'%s' does not say '%s'", step->error, words);
}

static void the_dialogue_says_why_there_is_no_motion(void **state)
{
	const uint8_t data[4] = {1, 0, 0, 0};
	struct dialogue_step now;
	struct bench b;

	(void)state;
	open_bench(&b, "speed: {id: 0x200, length: 16, scale: 1mm/s}, turn: {id: 0x300, length: 16, scale: 0.1deg/s}");
	b.dialogue = driver_odometry.dialogue_create(&b.config, 0);
	driver_odometry.dialogue_reset(b.dialogue, T0);
	now = step(&b, T0);
	assert_int_equal(now.state, DIALOGUE_CONFIGURING);
	says(&now, "no frame 0x200");
	give(&b, can_wire_frame(0x200, data, 2), T0 + 10 * MS);
	now = step(&b, T0 + 10 * MS);
	says(&now, "no frame 0x300");
	give(&b, can_wire_frame(0x300, data, 1), T0 + 10 * MS);
	now = step(&b, T0 + 10 * MS);
	says(&now, "no `turn` in frames 0x300: they are too short");
	for (int i = 2; i < 5; i++) {
		give(&b, can_wire_frame(0x200, data, 2), T0 + i * 10 * MS);
		give(&b, can_wire_frame(0x300, data, 2), T0 + i * 10 * MS);
	}
	now = step(&b, T0 + 40 * MS);
	assert_int_equal(now.state, DIALOGUE_STREAMING);
	assert_int_equal(now.error[0], 0);
	assert_int_equal(now.deadline_ns, T0 + 540 * MS);
	now = step(&b, T0 + 540 * MS); /* silent for `timeout` */
	assert_int_equal(now.state, DIALOGUE_CONFIGURING);
	says(&now, "within 0.5 s");
	now = step(&b, now.deadline_ns);
	assert_int_equal(now.state, DIALOGUE_FAILED);
	driver_odometry.dialogue_reset(b.dialogue, T0);
	struct can_frame_at off = can_wire_frame(CAN_WIRE_ERROR | CAN_WIRE_ERROR_BUS_OFF, data, 4);
	off.len = 8;
	give(&b, off, T0);
	now = step(&b, T0);
	says(&now, "can0");
	says(&now, "off");
	driver_odometry.dialogue_stop(b.dialogue, T0);
	now = step(&b, T0);
	assert_int_equal(now.state, DIALOGUE_FAILED);
	assert_int_equal(now.error[0], 0);
	close_bench(&b);
}

static void a_reason_has_a_key_to_look_at(void **state)
{
	static const struct {
		enum can_signal_verdict verdict;
		const char *words;
	} cases[] = {{CAN_SIGNAL_FOREIGN, "extended: on"}, {CAN_SIGNAL_REMOTE, "asks for them"},
	             {CAN_SIGNAL_SHORT, "too short"},      {CAN_SIGNAL_OTHER_MUX, "`mux`"},
	             {CAN_SIGNAL_INVALID, "`valid`"},      {CAN_SIGNAL_NO_NUMBER, "`scale`"}};
	struct bench b;

	(void)state;
	open_bench(&b, WHEELS);
	b.dialogue = driver_odometry.dialogue_create(&b.config, 0);
	for (size_t i = 0; i < sizeof(cases) / sizeof(*cases); i++) {
		const uint8_t payload[2] = {1, (uint8_t)cases[i].verdict};
		const struct reply reply = {.kind = 1, .len = 2, .payload = payload};
		struct dialogue_step now;

		driver_odometry.dialogue_reset(b.dialogue, T0);
		driver_odometry.dialogue_reply(b.dialogue, &reply);
		now = step(&b, T0);
		says(&now, "`right`");
		says(&now, cases[i].words);
	}
	close_bench(&b);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(golden_frames_of_speed_and_turn),
	    cmocka_unit_test(golden_frames_of_two_wheels),
	    cmocka_unit_test(counts_wrap_where_their_bits_or_the_configuration_say),
	    cmocka_unit_test(two_frames_are_as_good_as_one),
	    cmocka_unit_test(different_rates_lose_nothing),
	    cmocka_unit_test(both_models_agree_on_one_drive),
	    cmocka_unit_test(silences_are_not_driven),
	    cmocka_unit_test(a_step_of_a_count_is_counted_and_not_driven),
	    cmocka_unit_test(frames_that_say_something_else_are_counted_by_reason),
	    cmocka_unit_test(times_that_do_not_rise_are_ignored_until_time_was_set_back),
	    cmocka_unit_test(a_snapshot_goes_on_from_anywhere),
	    cmocka_unit_test(the_dialogue_says_why_there_is_no_motion),
	    cmocka_unit_test(a_reason_has_a_key_to_look_at),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

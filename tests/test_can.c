/* Law: the angle in a frame becomes a tilt at the time of the frame; whatever else the bus carries is counted by its reason,
 * nothing is ever written, and why there is no angle is said in one sentence. Virtual time; the link has its own tests. */
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "core/trig.h"
#include "drivers/can_bus.h"
#include "drivers/can_signal.h"
#include "drivers/driver.h"

#define MS     INT64_C(1000000)
#define SECOND INT64_C(1000000000)
#define T0     INT64_C(1600000000000000000)

static struct bed {
	struct config config;
	struct decoder *decoder;
	struct dialogue *dialogue;
	struct tilt tilt; /* the newest */
	int tilts, replies;
	int64_t now_ns;
} bed;

static void on_tilt(void *ctx, int device, const struct tilt *tilt)
{
	(void)ctx;
	assert_int_equal(device, 0);
	bed.tilt = *tilt;
	bed.tilts++;
	driver_can.dialogue_data(bed.dialogue, bed.now_ns);
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	(void)ctx;
	assert_int_equal(device, 0);
	bed.replies++;
	driver_can.dialogue_reply(bed.dialogue, reply);
}

static const struct record_sink sink = {.tilt = on_tilt, .reply = on_reply};

static struct config_signal *angle(void)
{
	return &bed.config.device[0].angle;
}

static void create(void)
{
	bed.decoder = driver_can.decoder_create(&bed.config.device[0], 0);
	bed.dialogue = driver_can.dialogue_create(&bed.config, 0);
	assert_true(bed.decoder && bed.dialogue);
}

static int set_up(void **state)
{
	struct config_device *d = &bed.config.device[0];

	(void)state;
	memset(&bed, 0, sizeof bed);
	bed.config.devices = 1;
	bed.now_ns = T0;
	strcpy(d->name, "servo");
	strcpy(d->connect, "can0");
	d->timeout_ns = 500 * MS;
	d->angle = (struct config_signal){.set = true, .id = 0x181, .length = 16, .scale = 0.01 * TRIG_DEG};
	create();
	return 0;
}

static int tear_down(void **state)
{
	(void)state;
	driver_can.decoder_destroy(bed.decoder);
	driver_can.dialogue_destroy(bed.dialogue);
	return 0;
}

static void again(void) /* with another configuration */
{
	tear_down(NULL);
	create();
}

static void give_bytes(const void *bytes, size_t len, enum direction direction)
{
	const struct record r = {
	    .log_ns = bed.now_ns, .t_ns = bed.now_ns, .direction = direction, .bytes = bytes, .len = len};

	driver_can.decode(bed.decoder, &r, &sink);
}

static void give(const struct can_frame_at *f)
{
	uint8_t bytes[CAN_WIRE_ENTRY_FD];

	give_bytes(bytes, can_wire_put(f, bytes), FROM_DEVICE);
}

static void opened(void)
{
	give_bytes("", 0, LINK_OPENED);
	driver_can.dialogue_reset(bed.dialogue, bed.now_ns);
}

/* A good frame of so many degrees, which was on the bus 2 ms ago. */
static void say_angle(double deg)
{
	struct can_frame_at f = can_signal_frame(angle());

	can_signal_put(angle(), deg * TRIG_DEG, &f);
	f.t_ns = bed.now_ns - 2 * MS;
	give(&f);
}

static void say_error(uint32_t classes, uint8_t level)
{
	struct can_frame_at f = {.id = CAN_WIRE_ERROR | classes, .len = 8, .data = {0, level}, .t_ns = bed.now_ns};

	give(&f);
}

static uint64_t count(const char *name)
{
	struct decoder_counters c;

	driver_can.counters(bed.decoder, &c);
	assert_true(c.n <= DECODER_COUNTERS_MAX);
	for (int i = 0; i < c.n; i++)
		if (strcmp(c.counter[i].name, name) == 0)
			return c.counter[i].count;
	fail_msg("no counter '%s'", name);
	return 0;
}

static struct dialogue_step step(void)
{
	struct dialogue_step s;

	driver_can.dialogue_step(bed.dialogue, bed.now_ns, &s);
	assert_int_equal(s.write_len, 0);
	assert_int_equal(s.baud, 0);
	assert_true(strlen(s.error) < sizeof s.error);
	assert_true(s.deadline_ns > bed.now_ns || s.state == DIALOGUE_FAILED);
	return s;
}

static void expect_says(const struct dialogue_step *s, const char *words)
{
	if (!strstr(s->error, words))
		fail_msg("'%s' lacks '%s'", s->error, words);
}

static void an_angle_has_the_time_of_its_frame(void **state)
{
	(void)state;
	opened();
	say_angle(-12.34);
	assert_int_equal(bed.tilts, 1);
	assert_true(fabs(bed.tilt.angle_rad - -12.34 * TRIG_DEG) < 1e-9);
	assert_int_equal(bed.tilt.t_ns, bed.now_ns - 2 * MS);
	assert_int_equal(count("angles"), 1);
}

static void everything_else_is_counted_by_its_reason(void **state)
{
	struct can_frame_at f;

	(void)state;
	opened();
	f = can_wire_frame(0x181 | CAN_WIRE_EXTENDED, "ab", 2);
	give(&f);
	f = can_wire_frame(0x181 | CAN_WIRE_REMOTE, "", 0);
	give(&f);
	f = can_wire_frame(0x181, "a", 1);
	give(&f);
	say_error(CAN_WIRE_ERROR_BUS, 0);
	f = can_wire_frame(CAN_WIRE_LOST, "\x03\0\0\0\x02\x01\0\0", 8);
	give(&f);
	assert_int_equal(bed.tilts, 0);
	assert_int_equal(count("angles"), 0);
	assert_int_equal(count("foreign"), 1);
	assert_int_equal(count("remote"), 1);
	assert_int_equal(count("short"), 1);
	assert_int_equal(count("error frames"), 1);
	assert_int_equal(count("not received"), 3);
	assert_int_equal(count("not sent"), 0x102);
}

static void a_record_of_several_frames_gives_several_angles(void **state)
{
	uint8_t bytes[40 * CAN_WIRE_ENTRY];
	struct can_frame_at f = can_signal_frame(angle());
	size_t n = 0;

	(void)state;
	opened();
	for (int i = 0; i < 40; i++) {
		can_signal_put(angle(), i * TRIG_DEG, &f);
		f.t_ns = bed.now_ns + i;
		n += can_wire_put(&f, bytes + n);
	}
	give_bytes(bytes, n - 1, FROM_DEVICE); /* the last one is cut */
	assert_int_equal(bed.tilts, 39);
	assert_int_equal(bed.tilt.t_ns, bed.now_ns + 38);
	assert_int_equal(count("malformed"), 1);
}

static void a_gap_of_the_counter_is_counted_and_its_angle_used(void **state)
{
	static const uint32_t numbers[] = {250, 251, 255, 0, 0, 5};
	struct decoder_timing timing;

	(void)state;
	angle()->counter.set = true;
	angle()->counter.start = 16;
	angle()->counter.length = 8;
	again();
	opened();
	for (size_t i = 0; i < 6; i++) {
		struct can_frame_at f = can_signal_frame(angle());

		can_signal_put_counter(angle(), numbers[i], &f);
		f.t_ns = bed.now_ns + (int64_t)i;
		give(&f);
	}
	assert_int_equal(bed.tilts, 6);
	assert_int_equal(count("lost by counter"), 3 + 4);
	assert_int_equal(count("counter stuck"), 1);
	driver_can.timing(bed.decoder, &timing);
	assert_true(timing.known && timing.lost == 7);
}

/* 36000 counts a turn, from 0: 350 degrees are -10. */
static void an_encoder_that_counts_from_0_again_means_the_angle_nearest_to_0(void **state)
{
	(void)state;
	angle()->type = SIGNAL_UNSIGNED;
	angle()->wrap = 36000;
	again();
	opened();
	for (int deg = 0; deg < 360; deg += 10) {
		say_angle(deg);
		assert_true(fabs(bed.tilt.angle_rad - (deg < 180 ? deg : deg - 360) * TRIG_DEG) < 1e-9);
	}
}

static void what_no_servo_can_mean_is_refused(void **state)
{
	struct can_frame_at f;

	(void)state;
	angle()->type = SIGNAL_FLOAT;
	angle()->length = 64;
	angle()->scale = 1;
	again();
	opened();
	f = can_signal_frame(angle());
	can_signal_put(angle(), 1e7, &f);
	give(&f);
	can_signal_put(angle(), NAN, &f);
	give(&f);
	assert_int_equal(bed.tilts, 0);
	assert_int_equal(count("no number"), 2);
	f = can_signal_frame(angle());
	f.t_ns = INT64_MIN;
	give(&f);
	f.t_ns = INT64_MAX;
	give(&f);
	assert_int_equal(bed.tilts, 0);
	assert_int_equal(count("malformed"), 2);
}

static void it_streams_once_angles_come_and_is_lost_without(void **state)
{
	struct dialogue_step s;

	(void)state;
	opened();
	s = step();
	assert_int_equal(s.state, DIALOGUE_CONFIGURING);
	bed.now_ns += 100 * MS;
	say_angle(1);
	s = step();
	assert_int_equal(s.state, DIALOGUE_STREAMING);
	assert_string_equal(s.error, "");
	assert_int_equal(s.deadline_ns, bed.now_ns + 500 * MS);
	bed.now_ns += 500 * MS;
	s = step();
	assert_int_equal(s.state, DIALOGUE_CONFIGURING);
	expect_says(&s, "no frame 0x181 within 0.5 s");
	/* The first good frame brings it back, on the same link. */
	bed.now_ns += 1000 * MS;
	say_angle(2);
	assert_int_equal(step().state, DIALOGUE_STREAMING);
	bed.now_ns += 10 * SECOND;
	s = step();
	assert_int_equal(s.state, DIALOGUE_FAILED);
	expect_says(&s, "no frame 0x181");
}

static void silence_after_opening_is_said(void **state)
{
	struct dialogue_step s;

	(void)state;
	opened();
	s = step();
	bed.now_ns = s.deadline_ns;
	assert_true(bed.now_ns <= T0 + 5 * SECOND);
	s = step();
	assert_int_equal(s.state, DIALOGUE_FAILED);
	expect_says(&s, "can0: no frame 0x181");
}

static void why_the_frames_hold_no_angle_is_said(void **state)
{
	struct can_frame_at f;
	struct dialogue_step s;

	(void)state;
	angle()->mux.set = angle()->valid.set = true;
	angle()->mux.start = 24;
	angle()->mux.length = 8;
	angle()->mux.value = 7;
	angle()->valid.bit = 16;
	angle()->valid.value = 1;
	again();
	const struct {
		uint32_t id;
		const char *data;
		uint8_t len;
		const char *says;
	} frames[] = {{0x181 | CAN_WIRE_EXTENDED, "abcd", 4, "extended: on"},
	              {0x181 | CAN_WIRE_REMOTE, "", 0, "somebody asks for them"},
	              {0x181, "abc", 3, "too short"},
	              {0x181, "ab\x01\x06", 4, "none has this `mux`"},
	              {0x181, "ab\0\x07", 4, "not `valid`"}};
	for (size_t i = 0; i < sizeof frames / sizeof *frames; i++) {
		opened();
		f = can_wire_frame(frames[i].id, frames[i].data, frames[i].len);
		give(&f);
		bed.now_ns += 3 * SECOND;
		s = step();
		assert_int_equal(s.state, DIALOGUE_FAILED);
		expect_says(&s, frames[i].says);
	}
	angle()->extended = true;
	angle()->mux.set = angle()->valid.set = false;
	angle()->type = SIGNAL_FLOAT;
	angle()->length = 32;
	again();
	opened();
	f = can_wire_frame(0x181, "abcd", 4);
	give(&f);
	bed.now_ns += 3 * SECOND;
	s = step();
	expect_says(&s, "extended: off");
	f = can_wire_frame(0x181 | CAN_WIRE_EXTENDED, "\0\0\xC0\x7F", 4); /* not a number */
	give(&f);
	s = step();
	expect_says(&s, "correct `type`");
}

static void the_state_of_the_bus_is_a_note_while_angles_come_and_the_reason_when_they_do_not(void **state)
{
	struct dialogue_step s;

	(void)state;
	opened();
	say_angle(1);
	say_error(CAN_WIRE_ERROR_CONTROLLER, 0x08);
	s = step();
	assert_int_equal(s.state, DIALOGUE_STREAMING);
	expect_says(&s, "warns of many errors");
	say_error(CAN_WIRE_ERROR_CONTROLLER, 0x20);
	s = step();
	expect_says(&s, "error passive");
	say_error(CAN_WIRE_ERROR_BUS_OFF, 0);
	s = step();
	assert_int_equal(s.state, DIALOGUE_STREAMING);
	expect_says(&s, "bus-off");
	bed.now_ns += SECOND;
	s = step();
	assert_int_equal(s.state, DIALOGUE_CONFIGURING);
	expect_says(&s, "bus-off");
	expect_says(&s, "ip link set can0 type can restart");
	say_error(CAN_WIRE_ERROR_RESTARTED, 0);
	say_angle(1);
	s = step();
	assert_int_equal(s.state, DIALOGUE_STREAMING);
	assert_string_equal(s.error, "");
	assert_int_equal(count("bus off"), 1);
	/* Once each, however often it is repeated. */
	bed.replies = 0;
	for (int i = 0; i < 100; i++)
		say_error(CAN_WIRE_ERROR_CONTROLLER, 0x04);
	assert_int_equal(bed.replies, 1);
}

static void the_orderly_end_needs_nothing(void **state)
{
	struct dialogue_step s;

	(void)state;
	opened();
	say_angle(1);
	driver_can.dialogue_stop(bed.dialogue, bed.now_ns);
	s = step();
	assert_int_equal(s.state, DIALOGUE_FAILED);
	assert_string_equal(s.error, "");
}

static void a_decoder_goes_on_from_its_snapshot(void **state)
{
	uint8_t bytes[1024], back[1024];
	struct state s;
	size_t len;

	(void)state;
	angle()->counter.set = true;
	angle()->counter.start = 16;
	angle()->counter.length = 8;
	again();
	opened();
	say_angle(3);
	say_error(CAN_WIRE_ERROR_BUS_OFF, 0);
	state_save(&s, bytes, sizeof bytes);
	driver_can.state(bed.decoder, &s);
	assert_true(state_done(&s));
	len = s.at;
	again();
	state_load(&s, bytes, len);
	driver_can.state(bed.decoder, &s);
	assert_true(state_done(&s));
	assert_int_equal(count("angles"), 1);
	assert_int_equal(count("bus off"), 1);
	struct can_frame_at f = can_signal_frame(angle());

	can_signal_put_counter(angle(), 2, &f);
	give(&f); /* 0 was the one before */
	assert_int_equal(count("lost by counter"), 1);
	for (size_t cut = 0; cut < len; cut++) {
		again();
		state_load(&s, bytes, cut);
		driver_can.state(bed.decoder, &s);
		assert_false(state_done(&s));
		assert_int_equal(count("angles"), 0);
	}
	state_save(&s, back, sizeof back);
	driver_can.state(bed.decoder, &s);
	assert_int_equal(s.at, len);
}

#define TEST(name) cmocka_unit_test_setup_teardown(name, set_up, tear_down)

int main(void)
{
	const struct CMUnitTest tests[] = {
	    TEST(an_angle_has_the_time_of_its_frame),
	    TEST(everything_else_is_counted_by_its_reason),
	    TEST(a_record_of_several_frames_gives_several_angles),
	    TEST(a_gap_of_the_counter_is_counted_and_its_angle_used),
	    TEST(an_encoder_that_counts_from_0_again_means_the_angle_nearest_to_0),
	    TEST(what_no_servo_can_mean_is_refused),
	    TEST(it_streams_once_angles_come_and_is_lost_without),
	    TEST(silence_after_opening_is_said),
	    TEST(why_the_frames_hold_no_angle_is_said),
	    TEST(the_state_of_the_bus_is_a_note_while_angles_come_and_the_reason_when_they_do_not),
	    TEST(the_orderly_end_needs_nothing),
	    TEST(a_decoder_goes_on_from_its_snapshot),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

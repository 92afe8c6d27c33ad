/* Laws L7 and L8: registers become angles by a pure function of recorded bytes; whatever the bus does, the loop goes on. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <modbus.h>
#include <netdb.h>
#include <netinet/in.h>
#include <poll.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "core/trig.h"
#include "drivers/modbus_parts.h"
#include "tools/simulator.h"

#define DEG TRIG_DEG
#define MS  INT64_C(1000000)

static int64_t now_ns(void)
{
	struct timespec ts;

	clock_gettime(CLOCK_MONOTONIC, &ts);
	return (int64_t)ts.tv_sec * 1000000000 + ts.tv_nsec;
}

static struct config_register milli(uint16_t address)
{
	return (struct config_register){.set = true,
	                                .function = 3,
	                                .address = address,
	                                .type = REGISTER_I32,
	                                .order = ORDER_ABCD,
	                                .scale = 0.001 * DEG,
	                                .sign = 1};
}

/* The servo of the simulator: angles count up there, so its sign is -1. */
static struct config servo_config(void)
{
	struct config config = {.devices = 1};
	struct config_device *d = &config.device[0];

	strcpy(d->name, "servo");
	strcpy(d->driver, "modbus");
	d->slave = 1;
	d->parity = 'N';
	d->baud = 115200;
	d->period_ns = 2 * MS;
	d->position = milli(SIM_SERVO_POSITION);
	d->target = milli(SIM_SERVO_TARGET);
	d->speed = milli(SIM_SERVO_SPEED);
	d->position.sign = d->target.sign = -1;
	config.sweep.set = true;
	strcpy(config.sweep.device, "servo");
	config.sweep.from_rad = -20.0 * DEG;
	config.sweep.to_rad = 30.0 * DEG;
	config.sweep.speed_rad_s = 40.0 * DEG;
	return config;
}

/* ---- registers ---- */

static void all_four_orders_give_the_same_number(void **state)
{
	static const uint16_t bytes[4][2] = {{0x1234, 0x5678}, {0x5678, 0x1234}, {0x3412, 0x7856}, {0x7856, 0x3412}};

	(void)state;
	for (int order = ORDER_ABCD; order <= ORDER_DCBA; order++) {
		struct config_register r = {.type = REGISTER_I32, .order = order, .scale = 1.0, .sign = 1};
		uint16_t back[2];
		double v;

		assert_int_equal(modbus_wire_decode(&r, bytes[order], &v), 0);
		assert_true(v == 0x12345678);
		assert_int_equal(modbus_wire_encode(&r, v, back), 0);
		assert_memory_equal(back, bytes[order], sizeof back);
	}
}

static void every_type_goes_there_and_back_at_its_limits(void **state)
{
	static const struct {
		int type;
		double low, high, beyond;
	} of[] = {{REGISTER_I16, -32768, 32767, 32768},
	          {REGISTER_U16, 0, 65535, -1},
	          {REGISTER_I32, -2147483648.0, 2147483647.0, 2147483648.0},
	          {REGISTER_U32, 0, 4294967295.0, -1},
	          {REGISTER_F32, -1.5e30, 1.5e30, 1e300}};

	(void)state;
	for (size_t i = 0; i < sizeof of / sizeof *of; i++)
		for (int order = ORDER_ABCD; order <= ORDER_DCBA; order++) {
			struct config_register r = {.type = of[i].type, .order = order, .scale = 1.0, .sign = 1};
			const double value[] = {of[i].low, of[i].high, 1.0};
			uint16_t raw[2] = {0x5a5a, 0x5a5a};
			double v;

			for (int k = 0; k < 3; k++) {
				assert_int_equal(modbus_wire_encode(&r, value[k], raw), 0);
				assert_int_equal(modbus_wire_decode(&r, raw, &v), 0);
				assert_true(fabs(v - value[k]) <= 1e-7 * fabs(value[k]));
			}
			assert_int_equal(modbus_wire_encode(&r, of[i].beyond, raw), -ERANGE);
			assert_int_equal(modbus_wire_encode(&r, NAN, raw), -ERANGE);
		}
}

static void scale_zero_and_sign_are_applied_as_documented(void **state)
{
	struct config_register r = {.type = REGISTER_I16, .scale = 0.01 * DEG, .zero = 100, .sign = -1};
	uint16_t raw[2] = {600}, back[2];
	double v;

	(void)state;
	assert_int_equal(modbus_wire_decode(&r, raw, &v), 0);
	assert_true(fabs(v + 5.0 * DEG) < 1e-12);
	assert_int_equal(modbus_wire_encode(&r, v, back), 0);
	assert_int_equal(back[0], 600);
}

static void a_float_that_is_no_number_is_refused(void **state)
{
	static const uint16_t nan[2] = {0x7fc0, 0}, inf[2] = {0xff80, 0};
	struct config_register r = {.type = REGISTER_F32, .scale = 1.0, .sign = 1};
	double v = 3.0;

	(void)state;
	assert_int_equal(modbus_wire_decode(&r, nan, &v), -ERANGE);
	assert_int_equal(modbus_wire_decode(&r, inf, &v), -ERANGE);
	assert_true(v == 3.0);
}

/* ---- records ---- */

static void a_record_has_the_documented_bytes(void **state)
{
	static const uint8_t bytes[] = {1, 0, 0, 0, 0, 0,    0,    0, 2, 1,    0,    0,    0,
	                                0, 0, 0, 7, 3, 0x34, 0x12, 2, 0, 0xcd, 0xab, 0x01, 0xef};
	struct modbus_transaction t = {.t_request_ns = 1,
	                               .t_answer_ns = 258,
	                               .unit = 7,
	                               .function = 3,
	                               .address = 0x1234,
	                               .n = 2,
	                               .value = {0xabcd, 0xef01}};
	uint8_t out[MODBUS_WIRE_MAX];

	(void)state;
	assert_int_equal(modbus_wire_put(&t, out), sizeof bytes);
	assert_memory_equal(out, bytes, sizeof bytes);
}

static void every_cut_record_waits_and_every_bad_one_is_refused(void **state)
{
	struct modbus_transaction t = {.unit = 1, .function = 16, .n = 3, .value = {1, 2, 3}}, back;
	uint8_t out[MODBUS_WIRE_MAX];
	size_t len = modbus_wire_put(&t, out);

	(void)state;
	for (size_t cut = 0; cut < len; cut++) {
		uint8_t *copy = malloc(cut ? cut : 1);

		memcpy(copy, out, cut);
		assert_int_equal(modbus_wire_get(copy, cut, &back), 0);
		free(copy);
	}
	assert_int_equal(modbus_wire_get(out, len, &back), (ssize_t)len);
	out[20] = 126;
	assert_int_equal(modbus_wire_get(out, len, &back), -EINVAL);
	out[20] = 0;
	assert_int_equal(modbus_wire_get(out, len, &back), -EINVAL);
	out[20] = 3;
	out[17] = 5;
	assert_int_equal(modbus_wire_get(out, len, &back), -EINVAL);
	out[17] = 16;
	out[16] = 0;
	assert_int_equal(modbus_wire_get(out, len, &back), -EINVAL);
}

/* ---- the decoder ---- */

struct seen {
	int tilts, replies, kind;
	struct tilt tilt;
};

static void see_tilt(void *ctx, int device, const struct tilt *tilt)
{
	struct seen *seen = ctx;

	(void)device;
	seen->tilts++;
	seen->tilt = *tilt;
}

static void see_reply(void *ctx, int device, const struct reply *reply)
{
	struct seen *seen = ctx;

	(void)device;
	seen->replies++;
	seen->kind = reply->kind;
}

static struct record_sink sink_of(struct seen *seen)
{
	return (struct record_sink){.ctx = seen, .tilt = see_tilt, .reply = see_reply};
}

static uint64_t counter(const struct decoder *decoder, const char *name)
{
	struct decoder_counters counters;

	driver_modbus.counters(decoder, &counters);
	for (int i = 0; i < counters.n; i++)
		if (!strcmp(counters.counter[i].name, name))
			return counters.counter[i].count;
	fail_msg("no counter %s", name);
	return 0;
}

static void feed(struct decoder *decoder, const struct modbus_transaction *t, struct seen *seen)
{
	uint8_t bytes[MODBUS_WIRE_MAX];
	struct record record = {.bytes = bytes, .len = modbus_wire_put(t, bytes)};
	struct record_sink sink = sink_of(seen);

	driver_modbus.decode(decoder, &record, &sink);
}

static struct modbus_transaction angle_of(int64_t t_ns, int64_t rtt_ns, int32_t counts)
{
	return (struct modbus_transaction){.t_request_ns = t_ns,
	                                   .t_answer_ns = t_ns + rtt_ns,
	                                   .unit = 1,
	                                   .function = 3,
	                                   .n = 2,
	                                   .value = {(uint16_t)((uint32_t)counts >> 16), (uint16_t)counts}};
}

static void an_angle_is_stamped_at_the_midpoint(void **state)
{
	struct config config = servo_config();
	struct decoder *decoder = driver_modbus.decoder_create(&config.device[0], 0);
	struct modbus_transaction t = angle_of(1000 * MS, 4 * MS, -12345);
	struct seen seen = {0};

	(void)state;
	feed(decoder, &t, &seen);
	assert_int_equal(seen.tilts, 1);
	assert_int_equal(seen.tilt.t_ns, 1002 * MS);
	assert_true(fabs(seen.tilt.angle_rad - 12.345 * DEG) < 1e-12);
	assert_int_equal(seen.kind, MODBUS_ANGLE);
	driver_modbus.decoder_destroy(decoder);
}

static void a_slow_round_trip_is_refused_and_a_slower_bus_is_followed(void **state)
{
	struct config config = servo_config();
	struct decoder *decoder = driver_modbus.decoder_create(&config.device[0], 0);
	struct seen seen = {0};

	(void)state;
	for (int i = 0; i < 20; i++) {
		struct modbus_transaction t = angle_of(i * 10 * MS, 2 * MS, i);

		feed(decoder, &t, &seen);
	}
	assert_int_equal(seen.tilts, 20);
	struct modbus_transaction three = angle_of(300 * MS, 6 * MS, 0), more = angle_of(320 * MS, 6 * MS + 3, 5);

	feed(decoder, &three, &seen);
	assert_int_equal(seen.tilts, 21);
	feed(decoder, &more, &seen);
	assert_int_equal(seen.tilts, 21);
	assert_int_equal(counter(decoder, "slow"), 1);
	for (int i = 0; i < 40; i++) {
		struct modbus_transaction t = angle_of((400 + i * 20) * MS, 9 * MS, i);

		feed(decoder, &t, &seen);
	}
	assert_true(seen.tilts > 21 + 20);
	driver_modbus.decoder_destroy(decoder);
}

static void a_slow_answer_of_a_servo_that_stands_is_taken(void **state)
{
	struct config config = servo_config();
	struct decoder *decoder = driver_modbus.decoder_create(&config.device[0], 0);
	struct seen seen = {0};

	(void)state;
	for (int i = 0; i < 20; i++) {
		struct modbus_transaction t = angle_of(i * 10 * MS, 2 * MS, 0);

		feed(decoder, &t, &seen);
	}
	struct modbus_transaction moved = angle_of(300 * MS, 20 * MS, 7), stood = angle_of(330 * MS, 20 * MS, 7);

	feed(decoder, &moved, &seen);
	assert_int_equal(seen.tilts, 20);
	feed(decoder, &stood, &seen);
	assert_int_equal(seen.tilts, 21);
	assert_int_equal(counter(decoder, "slow"), 1);
	driver_modbus.decoder_destroy(decoder);
}

static void foreign_refused_and_absurd_records_are_counted_not_decoded(void **state)
{
	struct config config = servo_config();
	struct decoder *decoder = driver_modbus.decoder_create(&config.device[0], 0);
	struct modbus_transaction t = angle_of(0, MS, 0);
	struct seen seen = {0};

	(void)state;
	t.unit = 9;
	feed(decoder, &t, &seen);
	t = angle_of(0, MS, 0);
	t.address = 8;
	feed(decoder, &t, &seen);
	assert_int_equal(counter(decoder, "foreign"), 2);
	t = angle_of(MS, -2 * MS, 0);
	feed(decoder, &t, &seen);
	t.t_request_ns = INT64_MIN;
	t.t_answer_ns = INT64_MAX;
	feed(decoder, &t, &seen);
	assert_int_equal(counter(decoder, "malformed"), 2);
	assert_int_equal(seen.tilts + seen.replies, 0);
	t = angle_of(0, MS, 0);
	t.function = 3 | MODBUS_WIRE_REFUSED;
	t.n = 1;
	t.value[0] = 2;
	feed(decoder, &t, &seen);
	assert_int_equal(counter(decoder, "refused"), 1);
	assert_int_equal(seen.kind, MODBUS_REFUSED);
	driver_modbus.decoder_destroy(decoder);
}

/* ---- the dialogue, against a servo in virtual time ---- */

struct virtual_servo {
	double angle, target, speed; /* rad, positive down, as the configuration says */
	bool deaf;                   /* answers writes, moves nowhere */
	int writes, initial, targets;
	double low, high; /* of the targets */
};

static void virtual_write(struct virtual_servo *servo, const struct config *config, const struct dialogue_step *step)
{
	const struct config_device *d = &config->device[0];
	struct modbus_transaction t;
	double v;

	assert_int_equal(modbus_wire_get(step->write, step->write_len, &t), (ssize_t)step->write_len);
	servo->writes++;
	if (t.address == d->target.address) {
		assert_int_equal(modbus_wire_decode(&d->target, t.value, &v), 0);
		servo->target = v;
		servo->low = servo->targets ? fmin(servo->low, v) : v;
		servo->high = servo->targets ? fmax(servo->high, v) : v;
		servo->targets++;
	} else if (t.address == d->speed.address) {
		assert_int_equal(modbus_wire_decode(&d->speed, t.value, &servo->speed), 0);
	} else {
		servo->initial++;
	}
}

static void virtual_move(struct virtual_servo *servo, double seconds)
{
	double way = servo->speed * seconds, whole = servo->target - servo->angle;

	if (servo->deaf)
		return;
	servo->angle = fabs(whole) <= way ? servo->target : servo->angle + (whole > 0.0 ? way : -way);
}

/* Runs `seconds`, an angle each 10 ms; calls `look` with every angle. Answers the last step's state. */
static enum dialogue_state virtual_run(struct dialogue *d, struct virtual_servo *servo, const struct config *config,
                                       int64_t *t_ns, double seconds, struct dialogue_step *ret,
                                       void (*look)(void *, double), void *ctx)
{
	int64_t end_ns = *t_ns + (int64_t)(seconds * 1e9);

	for (; *t_ns < end_ns; *t_ns += 10 * MS) {
		struct reply angle = {
		    .t_ns = *t_ns, .kind = MODBUS_ANGLE, .len = sizeof(double), .payload = (uint8_t *)&servo->angle};
		uint16_t address = 0;
		struct reply written = {
		    .t_ns = *t_ns, .kind = MODBUS_WRITTEN, .len = 2, .payload = (uint8_t *)&address};

		virtual_move(servo, 0.01);
		driver_modbus.dialogue_reply(d, &angle);
		driver_modbus.dialogue_data(d, *t_ns);
		driver_modbus.dialogue_step(d, *t_ns, ret);
		if (ret->state == DIALOGUE_FAILED)
			return ret->state;
		if (ret->write_len) {
			virtual_write(servo, config, ret);
			driver_modbus.dialogue_reply(d, &written);
		}
		if (look)
			look(ctx, servo->angle);
	}
	return ret->state;
}

struct turns {
	int n, direction;
	double last, low, high;
};

static void count_turns(void *ctx, double angle)
{
	struct turns *turns = ctx;
	int direction = angle > turns->last ? 1 : angle < turns->last ? -1 : turns->direction;

	if (turns->direction && direction != turns->direction)
		turns->n++;
	turns->direction = direction;
	turns->last = angle;
	turns->low = fmin(turns->low, angle);
	turns->high = fmax(turns->high, angle);
}

static void a_servo_that_never_answered_does_not_stream(void **state)
{
	struct config config = servo_config();
	struct dialogue *d = driver_modbus.dialogue_create(&config, 0);
	struct virtual_servo servo = {.angle = 0};
	struct dialogue_step step;
	int64_t t_ns = 5000000000;

	(void)state;
	for (int life = 0; life < 2; life++) { /* a link that is lost and opened anew begins again */
		driver_modbus.dialogue_reset(d, t_ns);
		driver_modbus.dialogue_step(d, t_ns, &step);
		assert_int_equal(step.state, DIALOGUE_CONFIGURING);
		virtual_run(d, &servo, &config, &t_ns, 1.0, &step, NULL, NULL);
		assert_int_equal(step.state, DIALOGUE_STREAMING);
	}
	driver_modbus.dialogue_destroy(d);
}

static void a_triangle_sweeps_between_its_ends_for_hours(void **state)
{
	struct config config = servo_config();
	struct dialogue *d = driver_modbus.dialogue_create(&config, 0);
	struct virtual_servo servo = {.angle = 3.0 * DEG};
	struct dialogue_step step;
	struct turns turns = {0};
	int64_t t_ns = 5000000000;

	(void)state;
	driver_modbus.dialogue_reset(d, t_ns);
	assert_int_equal(virtual_run(d, &servo, &config, &t_ns, 3600.0, &step, count_turns, &turns),
	                 DIALOGUE_STREAMING);
	assert_true(fabs(servo.speed - 40.0 * DEG) < 1e-6);
	/* 50 degrees at 40 degrees a second: 1.25 s each way */
	assert_in_range(turns.n, 2700, 2900);
	assert_true(turns.low > -20.0001 * DEG && turns.low < -19.0 * DEG);
	assert_true(turns.high < 30.0001 * DEG && turns.high > 29.0 * DEG);
	assert_true(servo.low > -20.001 * DEG && servo.high < 30.001 * DEG);
	driver_modbus.dialogue_destroy(d);
}

static void a_sinus_slows_down_towards_its_ends(void **state)
{
	struct config config = servo_config();
	struct virtual_servo servo = {.angle = -20.0 * DEG};
	struct dialogue_step step;
	struct turns turns = {0};
	struct dialogue *d;
	int64_t t_ns = 0;

	(void)state;
	config.sweep.profile = SWEEP_SINUS;
	d = driver_modbus.dialogue_create(&config, 0);
	driver_modbus.dialogue_reset(d, t_ns);
	assert_int_equal(virtual_run(d, &servo, &config, &t_ns, 120.0, &step, count_turns, &turns), DIALOGUE_STREAMING);
	/* Half a period is pi A / peak = 1.96 s, less 6 % for turning a tenth of a degree early at each end, where it is
	 * slowest; a triangle would take 1.25 s, a speed that never rises again 50 s. */
	assert_in_range(turns.n, 55, 72);
	assert_true(turns.low < -19.0 * DEG && turns.high > 29.0 * DEG);
	driver_modbus.dialogue_destroy(d);
}

static void steps_are_settled_and_stay_within_the_ends(void **state)
{
	struct config config = servo_config();
	struct virtual_servo servo = {0};
	struct dialogue_step step;
	struct dialogue *d;
	int64_t t_ns = 0;

	(void)state;
	config.sweep.profile = SWEEP_STEP;
	config.sweep.step_rad = 7.0 * DEG; /* 50 degrees: seven steps and a short one */
	config.sweep.settle_ns = 300 * MS;
	d = driver_modbus.dialogue_create(&config, 0);
	driver_modbus.dialogue_reset(d, t_ns);
	assert_int_equal(virtual_run(d, &servo, &config, &t_ns, 60.0, &step, NULL, NULL), DIALOGUE_STREAMING);
	/* a step takes 0.175 s and 0.3 s of settling */
	assert_in_range(servo.targets, 100, 130);
	assert_true(servo.low > -20.001 * DEG && servo.high < 30.001 * DEG && servo.high > 29.9 * DEG);
	driver_modbus.dialogue_destroy(d);
}

static void initial_writes_come_first_and_again_after_a_reset(void **state)
{
	struct config config = servo_config();
	struct virtual_servo servo = {0};
	struct dialogue_step step;
	struct dialogue *d;
	int64_t t_ns = 0;

	(void)state;
	config.device[0].writes = 2;
	config.device[0].write[0].address = 10;
	config.device[0].write[1].address = 11;
	d = driver_modbus.dialogue_create(&config, 0);
	driver_modbus.dialogue_reset(d, t_ns);
	driver_modbus.dialogue_step(d, t_ns, &step);
	assert_int_equal(step.state, DIALOGUE_CONFIGURING);
	driver_modbus.dialogue_reset(d, t_ns);
	assert_int_equal(virtual_run(d, &servo, &config, &t_ns, 1.0, &step, NULL, NULL), DIALOGUE_STREAMING);
	assert_int_equal(servo.initial, 2);
	driver_modbus.dialogue_reset(d, t_ns);
	virtual_run(d, &servo, &config, &t_ns, 1.0, &step, NULL, NULL);
	assert_int_equal(servo.initial, 4);
	driver_modbus.dialogue_destroy(d);
}

static void a_write_without_an_answer_is_said_three_times_then_given_up(void **state)
{
	struct config config = servo_config();
	struct dialogue *d = driver_modbus.dialogue_create(&config, 0);
	struct dialogue_step step = {0};
	int writes = 0;
	int64_t t_ns = 0;

	(void)state;
	driver_modbus.dialogue_reset(d, t_ns);
	for (int i = 0; i < 100 && step.state != DIALOGUE_FAILED; i++) {
		driver_modbus.dialogue_data(d, t_ns);
		driver_modbus.dialogue_step(d, t_ns, &step);
		writes += step.write_len > 0;
		assert_true(step.state == DIALOGUE_FAILED || step.deadline_ns > t_ns);
		t_ns = step.deadline_ns;
	}
	assert_int_equal(writes, 3);
	assert_non_null(strstr(step.error, "does not answer"));
	driver_modbus.dialogue_destroy(d);
}

static void a_servo_that_stands_still_is_given_up_with_a_sentence(void **state)
{
	struct config config = servo_config();
	struct dialogue *d = driver_modbus.dialogue_create(&config, 0);
	struct virtual_servo servo = {.deaf = true};
	struct dialogue_step step;
	int64_t t_ns = 0;

	(void)state;
	driver_modbus.dialogue_reset(d, t_ns);
	assert_int_equal(virtual_run(d, &servo, &config, &t_ns, 30.0, &step, NULL, NULL), DIALOGUE_FAILED);
	assert_int_equal(servo.targets, 6);
	assert_non_null(strstr(step.error, "stands still"));
	driver_modbus.dialogue_destroy(d);
}

static void a_servo_without_a_sweep_is_read_and_never_told_anything(void **state)
{
	struct config config = servo_config();
	struct virtual_servo servo = {0};
	struct dialogue_step step;
	struct dialogue *d;
	int64_t t_ns = 0;

	(void)state;
	strcpy(config.sweep.device, "other");
	d = driver_modbus.dialogue_create(&config, 0);
	driver_modbus.dialogue_reset(d, t_ns);
	assert_int_equal(virtual_run(d, &servo, &config, &t_ns, 10.0, &step, NULL, NULL), DIALOGUE_STREAMING);
	assert_int_equal(servo.writes, 0);
	/* A program that slept itself has not listened; one that looked and heard nothing for three seconds has. */
	t_ns += 60000 * MS;
	driver_modbus.dialogue_step(d, t_ns, &step);
	assert_int_equal(step.state, DIALOGUE_STREAMING);
	for (int i = 0; i < 100 && step.state != DIALOGUE_FAILED; i++) {
		t_ns = step.deadline_ns;
		driver_modbus.dialogue_step(d, t_ns, &step);
	}
	assert_int_equal(step.state, DIALOGUE_FAILED);
	assert_non_null(strstr(step.error, "no angle"));
	driver_modbus.dialogue_destroy(d);
}

static void stopping_goes_to_the_rest_angle_and_is_done(void **state)
{
	struct config config = servo_config();
	struct virtual_servo servo = {0};
	struct dialogue_step step;
	struct dialogue *d;
	int64_t t_ns = 0;

	(void)state;
	config.sweep.has_rest = true;
	config.sweep.rest_rad = -35.0 * DEG; /* outside from..to: only the rest may be */
	d = driver_modbus.dialogue_create(&config, 0);
	driver_modbus.dialogue_reset(d, t_ns);
	virtual_run(d, &servo, &config, &t_ns, 3.0, &step, NULL, NULL);
	assert_true(servo.low > -20.001 * DEG);
	driver_modbus.dialogue_stop(d, t_ns);
	assert_int_equal(virtual_run(d, &servo, &config, &t_ns, 10.0, &step, NULL, NULL), DIALOGUE_FAILED);
	assert_string_equal(step.error, "");
	assert_true(fabs(servo.angle + 35.0 * DEG) < 0.11 * DEG);
	driver_modbus.dialogue_destroy(d);
}

static void a_sinus_without_a_speed_register_is_refused(void **state)
{
	struct config config = servo_config();
	struct dialogue_step step;
	struct dialogue *d;

	(void)state;
	config.sweep.profile = SWEEP_SINUS;
	config.device[0].speed.set = false;
	d = driver_modbus.dialogue_create(&config, 0);
	driver_modbus.dialogue_reset(d, 0);
	driver_modbus.dialogue_step(d, 0, &step);
	assert_int_equal(step.state, DIALOGUE_FAILED);
	assert_non_null(strstr(step.error, "triangle"));
	driver_modbus.dialogue_destroy(d);
}

/* ---- the bus ---- */

static char dir[64], rtu[96];

static int make_dir(void **state)
{
	(void)state;
	strcpy(dir, "/tmp/test_modbus.XXXXXX");
	if (!mkdtemp(dir))
		return -1;
	snprintf(rtu, sizeof rtu, "%s/servo", dir);
	return 0;
}

static int remove_dir(void **state)
{
	(void)state;
	return rmdir(dir);
}

/* Waits at most 20 s for what the link says next: bytes, or -errno. */
static ssize_t await(struct link *link, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	struct pollfd p = {.fd = driver_modbus.link_fd(link), .events = POLLIN};

	assert_int_equal(poll(&p, 1, 20000), 1);
	*t_ns = now_ns();
	return driver_modbus.link_read(link, buf, cap, t_ns);
}

static void read_angles(const struct config_device *device, struct sim_servo *servo, int n)
{
	struct decoder *decoder = driver_modbus.decoder_create(device, 0);
	struct seen seen = {0};
	struct record_sink sink = sink_of(&seen);
	char error[160] = "";
	struct link *link = driver_modbus.link_open(device, error);
	uint8_t buf[MODBUS_WIRE_MAX];

	assert_string_equal(error, "");
	while (seen.tilts < n) {
		struct record record = {.bytes = buf};
		ssize_t len = await(link, buf, sizeof buf, &record.t_ns);

		assert_true(len > 0);
		record.len = (size_t)len;
		driver_modbus.decode(decoder, &record, &sink);
		assert_true(fabs(seen.tilt.angle_rad + sim_servo_angle(servo, seen.tilt.t_ns)) < 0.0006 * DEG);
	}
	driver_modbus.link_close(link);
	driver_modbus.decoder_destroy(decoder);
}

static void angles_come_over_a_serial_line(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 1, .angle_rad = 12.345 * DEG};
	struct config config = servo_config();
	char error[160] = "";
	struct sim_servo *servo = sim_servo_create(&params, error);

	(void)state;
	assert_string_equal(error, "");
	strcpy(config.device[0].connect, rtu);
	read_angles(&config.device[0], servo, 50);
	read_angles(&config.device[0], servo, 5); /* the line can be opened again */
	sim_servo_destroy(servo);
}

static void angles_come_over_tcp_and_from_input_registers(void **state)
{
	struct sim_servo_params params = {.tcp = "127.0.0.1:0", .slave = 1, .angle_rad = -0.5};
	struct config config = servo_config();
	char error[160] = "";
	struct sim_servo *servo = sim_servo_create(&params, error);

	(void)state;
	assert_string_equal(error, "");
	snprintf(config.device[0].connect, sizeof config.device[0].connect, "localhost:%d", sim_servo_port(servo));
	config.device[0].position.function = 4;
	config.device[0].position.address = 1;
	config.device[0].address_base = 1;
	read_angles(&config.device[0], servo, 50);
	sim_servo_destroy(servo);
}

static void a_wish_is_written_and_its_answer_comes_back(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 1};
	struct modbus_transaction wish = {.unit = 1,
	                                  .function = 16,
	                                  .address = SIM_SERVO_TARGET,
	                                  .n = 2,
	                                  .value = {0, 5000}},
	                          t = {0};
	struct config config = servo_config();
	uint8_t buf[MODBUS_WIRE_MAX];
	char error[160] = "";
	struct sim_servo *servo = sim_servo_create(&params, error);
	struct link *link;
	int64_t t_ns;

	(void)state;
	strcpy(config.device[0].connect, rtu);
	link = driver_modbus.link_open(&config.device[0], error);
	assert_non_null(link);
	assert_true(driver_modbus.link_write(link, buf, modbus_wire_put(&wish, buf)) > 0);
	for (int i = 0; i < 1000 && t.function != 16; i++) {
		ssize_t len = await(link, buf, sizeof buf, &t_ns);

		assert_true(len > 0);
		assert_int_equal(modbus_wire_get(buf, (size_t)len, &t), len);
		assert_true(t.t_answer_ns >= t.t_request_ns && t.t_answer_ns <= now_ns());
	}
	assert_int_equal(t.function, 16);
	assert_true(fabs(sim_servo_angle(servo, now_ns() + INT64_C(1000000000)) - 5.0 * DEG) < 1e-9);
	driver_modbus.link_close(link);
	sim_servo_destroy(servo);
}

static void a_register_that_is_not_there_is_a_refusal_not_a_lost_bus(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 1};
	struct config config = servo_config();
	struct modbus_transaction t;
	uint8_t buf[MODBUS_WIRE_MAX];
	char error[160] = "";
	struct sim_servo *servo = sim_servo_create(&params, error);
	struct link *link;
	int64_t t_ns;

	(void)state;
	strcpy(config.device[0].connect, rtu);
	config.device[0].position.address = 400;
	link = driver_modbus.link_open(&config.device[0], error);
	for (int i = 0; i < 5; i++) {
		ssize_t len = await(link, buf, sizeof buf, &t_ns);

		assert_true(len > 0);
		assert_int_equal(modbus_wire_get(buf, (size_t)len, &t), len);
		assert_int_equal(t.function, 3 | MODBUS_WIRE_REFUSED);
		assert_int_equal(t.value[0], 2);
	}
	driver_modbus.link_close(link);
	sim_servo_destroy(servo);
}

/* Reads until the bus is lost and answers why. */
static ssize_t until_lost(struct link *link)
{
	uint8_t buf[MODBUS_WIRE_MAX];
	ssize_t n;
	int64_t t_ns;

	do
		n = await(link, buf, sizeof buf, &t_ns);
	while (n > 0);
	return n;
}

static void a_lost_bus_is_reported_and_can_be_opened_again(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 1};
	struct config config = servo_config();
	uint8_t buf[MODBUS_WIRE_MAX];
	char error[160] = "";
	struct link *link;
	int64_t t_ns;

	(void)state;
	strcpy(config.device[0].connect, rtu);
	for (int i = 0; i < 3; i++) {
		struct sim_servo *servo = sim_servo_create(&params, error);

		link = driver_modbus.link_open(&config.device[0], error);
		assert_non_null(link);
		assert_true(await(link, buf, sizeof buf, &t_ns) > 0);
		sim_servo_destroy(servo);
		assert_true(until_lost(link) < 0);
		driver_modbus.link_close(link);
	}
	assert_null(driver_modbus.link_open(&config.device[0], error));
	assert_non_null(strstr(error, "No such file"));
}

static void a_host_that_refuses_costs_the_loop_nothing(void **state)
{
	struct sockaddr_in address = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
	struct config config = servo_config();
	int fd = socket(AF_INET, SOCK_STREAM, 0);
	socklen_t len = sizeof address;
	char error[160] = "";
	struct link *link;

	(void)state;
	assert_int_equal(bind(fd, (struct sockaddr *)&address, len), 0); /* bound, and nobody listens */
	assert_int_equal(getsockname(fd, (struct sockaddr *)&address, &len), 0);
	snprintf(config.device[0].connect, sizeof config.device[0].connect, "127.0.0.1:%d", ntohs(address.sin_port));
	link = driver_modbus.link_open(&config.device[0], error);
	assert_non_null(link);
	assert_true(until_lost(link) == -ECONNREFUSED);
	driver_modbus.link_close(link);
	close(fd);
}

static void a_line_in_use_is_left_alone(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 1};
	struct config config = servo_config();
	uint8_t buf[MODBUS_WIRE_MAX];
	char error[160] = "";
	struct sim_servo *servo = sim_servo_create(&params, error);
	struct link *first, *second;
	int64_t t_ns;

	(void)state;
	strcpy(config.device[0].connect, rtu);
	first = driver_modbus.link_open(&config.device[0], error);
	assert_true(await(first, buf, sizeof buf, &t_ns) > 0);
	second = driver_modbus.link_open(&config.device[0], error);
	assert_true(until_lost(second) == -EBUSY);
	assert_true(await(first, buf, sizeof buf, &t_ns) > 0);
	driver_modbus.link_close(second);
	driver_modbus.link_close(first);
	sim_servo_destroy(servo);
}

/* A resolver that does not answer until it is let go. */
static pthread_mutex_t resolver_lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t resolver_changed = PTHREAD_COND_INITIALIZER;
static bool resolver_answers;
static int resolver_waiting;

int getaddrinfo(const char *node, const char *service, const struct addrinfo *hints, struct addrinfo **ret)
{
	int (*real)(const char *, const char *, const struct addrinfo *, struct addrinfo **);

	if (node && !strcmp(node, "never.answers")) {
		pthread_mutex_lock(&resolver_lock);
		resolver_waiting++;
		pthread_cond_broadcast(&resolver_changed);
		while (!resolver_answers)
			pthread_cond_wait(&resolver_changed, &resolver_lock);
		resolver_waiting--;
		pthread_cond_broadcast(&resolver_changed);
		pthread_mutex_unlock(&resolver_lock);
		return EAI_FAIL;
	}
	*(void **)&real = dlsym(RTLD_NEXT, "getaddrinfo");
	return real(node, service, hints, ret);
}

static void await_resolver(int waiting)
{
	pthread_mutex_lock(&resolver_lock);
	while (resolver_waiting != waiting)
		pthread_cond_wait(&resolver_changed, &resolver_lock);
	pthread_mutex_unlock(&resolver_lock);
}

static void a_resolver_that_hangs_costs_a_bounded_number_of_threads(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 1};
	struct config config = servo_config(), other = servo_config();
	uint8_t buf[MODBUS_WIRE_MAX];
	char error[160] = "";
	struct sim_servo *servo = sim_servo_create(&params, error);
	struct link *link = NULL;
	int64_t t_ns;

	(void)state;
	strcpy(config.device[0].name, "distant");
	strcpy(config.device[0].connect, "never.answers:502");
	for (int i = 0; i < MODBUS_THREADS_MAX; i++) {
		link = driver_modbus.link_open(&config.device[0], error);
		assert_non_null(link);
		driver_modbus.link_close(link);
	}
	await_resolver(MODBUS_THREADS_MAX);
	for (int i = 0; i < 100; i++)
		assert_null(driver_modbus.link_open(&config.device[0], error));
	assert_non_null(strstr(error, "4 earlier tries"));
	/* Another device is not concerned. */
	strcpy(other.device[0].connect, rtu);
	link = driver_modbus.link_open(&other.device[0], error);
	assert_non_null(link);
	assert_true(await(link, buf, sizeof buf, &t_ns) > 0);
	driver_modbus.link_close(link);
	pthread_mutex_lock(&resolver_lock);
	resolver_answers = true;
	pthread_cond_broadcast(&resolver_changed);
	pthread_mutex_unlock(&resolver_lock);
	/* They end, and the device can be opened again. */
	link = NULL;
	for (int i = 0; i < 2000 && !link; i++, usleep(10000))
		link = driver_modbus.link_open(&config.device[0], error);
	assert_non_null(link);
	assert_true(until_lost(link) < 0);
	driver_modbus.link_close(link);
	sim_servo_destroy(servo);
}

/* A peer that answers the first request only after its time-out, and each answer carries its number. */
struct late_peer {
	int master;
	modbus_t *modbus;
	atomic_bool stop;
};

static void *late_peer_thread(void *arg)
{
	struct late_peer *peer = arg;
	modbus_mapping_t *map = modbus_mapping_new(0, 0, 4, 4);
	uint8_t request[MODBUS_RTU_MAX_ADU_LENGTH];
	int served = 0;

	while (!peer->stop) {
		struct pollfd p = {.fd = peer->master, .events = POLLIN};

		if (poll(&p, 1, 20) <= 0)
			continue;
		int n = modbus_receive(peer->modbus, request);

		if (n <= 0)
			continue;
		map->tab_registers[1] = (uint16_t)served;
		if (served++ == 0)
			usleep(700000); /* later than the driver's 500 ms */
		modbus_reply(peer->modbus, request, n, map);
	}
	modbus_mapping_free(map);
	return NULL;
}

static void a_late_answer_is_never_taken_for_the_next_one(void **state)
{
	struct config config = servo_config();
	struct late_peer peer = {.master = posix_openpt(O_RDWR | O_NOCTTY)};
	struct modbus_transaction t;
	struct termios raw;
	uint8_t buf[MODBUS_WIRE_MAX];
	char error[160] = "", name[64];
	struct link *link;
	pthread_t thread;
	int64_t t_ns;
	ssize_t len;
	int slave;

	(void)state;
	assert_int_equal(grantpt(peer.master) | unlockpt(peer.master) | ptsname_r(peer.master, name, sizeof name), 0);
	slave = open(name, O_RDWR | O_NOCTTY);
	tcgetattr(slave, &raw);
	cfmakeraw(&raw);
	tcsetattr(slave, TCSANOW, &raw);
	peer.modbus = modbus_new_rtu(name, 115200, 'N', 8, 1);
	modbus_set_slave(peer.modbus, 1);
	modbus_set_socket(peer.modbus, peer.master);
	pthread_create(&thread, NULL, late_peer_thread, &peer);
	snprintf(config.device[0].connect, sizeof config.device[0].connect, "%s", name);
	link = driver_modbus.link_open(&config.device[0], error);
	assert_non_null(link);
	len = await(link, buf, sizeof buf, &t_ns);
	assert_int_equal(modbus_wire_get(buf, (size_t)len, &t), len);
	assert_int_equal(t.function, 3 | MODBUS_WIRE_REFUSED);
	assert_int_equal(t.value[0], 0);
	for (int i = 1; i < 5; i++) { /* the answer numbered 0 is never seen */
		len = await(link, buf, sizeof buf, &t_ns);
		assert_int_equal(modbus_wire_get(buf, (size_t)len, &t), len);
		assert_int_equal(t.function, 3);
		assert_int_equal(t.value[1], i);
	}
	driver_modbus.link_close(link);
	peer.stop = true;
	pthread_join(thread, NULL);
	modbus_free(peer.modbus);
	close(slave);
	close(peer.master);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(all_four_orders_give_the_same_number),
	    cmocka_unit_test(every_type_goes_there_and_back_at_its_limits),
	    cmocka_unit_test(scale_zero_and_sign_are_applied_as_documented),
	    cmocka_unit_test(a_float_that_is_no_number_is_refused),
	    cmocka_unit_test(a_record_has_the_documented_bytes),
	    cmocka_unit_test(every_cut_record_waits_and_every_bad_one_is_refused),
	    cmocka_unit_test(an_angle_is_stamped_at_the_midpoint),
	    cmocka_unit_test(a_slow_round_trip_is_refused_and_a_slower_bus_is_followed),
	    cmocka_unit_test(a_slow_answer_of_a_servo_that_stands_is_taken),
	    cmocka_unit_test(foreign_refused_and_absurd_records_are_counted_not_decoded),
	    cmocka_unit_test(a_servo_that_never_answered_does_not_stream),
	    cmocka_unit_test(a_triangle_sweeps_between_its_ends_for_hours),
	    cmocka_unit_test(a_sinus_slows_down_towards_its_ends),
	    cmocka_unit_test(steps_are_settled_and_stay_within_the_ends),
	    cmocka_unit_test(initial_writes_come_first_and_again_after_a_reset),
	    cmocka_unit_test(a_write_without_an_answer_is_said_three_times_then_given_up),
	    cmocka_unit_test(a_servo_that_stands_still_is_given_up_with_a_sentence),
	    cmocka_unit_test(a_servo_without_a_sweep_is_read_and_never_told_anything),
	    cmocka_unit_test(stopping_goes_to_the_rest_angle_and_is_done),
	    cmocka_unit_test(a_sinus_without_a_speed_register_is_refused),
	    cmocka_unit_test(angles_come_over_a_serial_line),
	    cmocka_unit_test(angles_come_over_tcp_and_from_input_registers),
	    cmocka_unit_test(a_wish_is_written_and_its_answer_comes_back),
	    cmocka_unit_test(a_register_that_is_not_there_is_a_refusal_not_a_lost_bus),
	    cmocka_unit_test(a_lost_bus_is_reported_and_can_be_opened_again),
	    cmocka_unit_test(a_host_that_refuses_costs_the_loop_nothing),
	    cmocka_unit_test(a_line_in_use_is_left_alone),
	    cmocka_unit_test(a_resolver_that_hangs_costs_a_bounded_number_of_threads),
	    cmocka_unit_test(a_late_answer_is_never_taken_for_the_next_one),
	};

	return cmocka_run_group_tests(tests, make_dir, remove_dir);
}

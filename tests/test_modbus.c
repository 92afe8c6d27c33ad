/* Laws L7 and L8: registers become angles by a pure function of recorded bytes, whatever those are. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <errno.h>
#include <math.h>
#include <stdlib.h>

#include "tests/modbus_servo.h"

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

/* 0xc0490fdb is -3.14159274 as a float, 3226013659 unsigned, -1068953637 signed; 0xc049 alone 49225 and -16311. */
static void every_type_reads_its_bytes_in_every_order(void **state)
{
	static const uint16_t wide[4][2] = {{0xc049, 0x0fdb}, {0x0fdb, 0xc049}, {0x49c0, 0xdb0f}, {0xdb0f, 0x49c0}};
	static const uint16_t narrow[4] = {0xc049, 0xc049, 0x49c0, 0x49c0};
	static const struct {
		int type;
		double value;
	} of[] = {{REGISTER_I16, -16311},
	          {REGISTER_U16, 49225},
	          {REGISTER_I32, -1068953637},
	          {REGISTER_U32, 3226013659},
	          {REGISTER_F32, -3.1415927410125732}};

	(void)state;
	for (size_t i = 0; i < sizeof of / sizeof *of; i++)
		for (int order = ORDER_ABCD; order <= ORDER_DCBA; order++) {
			struct config_register r = {.type = of[i].type, .order = order, .scale = 1.0, .sign = 1};
			const int n = modbus_wire_registers(&r);
			const uint16_t *raw = n == 1 ? &narrow[order] : wide[order];
			uint16_t back[2];
			double v;

			assert_int_equal(modbus_wire_decode(&r, raw, &v), 0);
			assert_true(v == of[i].value);
			assert_int_equal(modbus_wire_encode(&r, v, back), 0);
			assert_memory_equal(back, raw, (size_t)n * sizeof *raw);
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

static void round_trips_tell_the_jitter_and_the_period_the_rate(void **state)
{
	struct config config = servo_config();
	struct decoder_timing timing;
	struct decoder *decoder;
	struct seen seen = {0};

	(void)state;
	config.device[0].period_ns = 20 * MS;
	decoder = driver_modbus.decoder_create(&config.device[0], 0);
	driver_modbus.timing(decoder, &timing);
	assert_false(timing.known);
	for (int i = 0; i < 2000; i++) { /* two of a hundred take 3 ms longer, every third half a millisecond */
		int64_t rtt_ns = MS + (i % 50 == 7 ? 3 * MS : (i % 3 == 0) * MS / 2);
		struct modbus_transaction t = angle_of(i * 20 * MS, rtt_ns, i);

		feed(decoder, &t, &seen);
	}
	driver_modbus.timing(decoder, &timing);
	assert_true(timing.known && !timing.stamps);
	assert_true(timing.expected_hz == 50.0);
	assert_int_equal(timing.jitter_p50_ns, 0);
	assert_int_equal(timing.jitter_p99_ns, 3 * MS);
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

/* What its dialogue asks for: a status, a step that waits. Nobody else's register is an angle or an answer. */
static void one_register_is_read_for_the_dialogue_beside_the_angle(void **state)
{
	struct config config = servo_config();
	struct config_device *d = &config.device[0];
	struct modbus_transaction t = angle_of(MS, MS, 0);
	struct seen seen = {0};
	struct decoder *decoder;

	(void)state;
	d->status.set = true;
	d->status.function = 4;
	d->status.address = 17;
	d->reset.n = 1;
	d->reset.item[0].until.set = true;
	d->reset.item[0].until.address = 6;
	decoder = driver_modbus.decoder_create(d, 0);
	t.n = 1;
	t.function = 4;
	t.address = 17;
	feed(decoder, &t, &seen);
	t.function = 3;
	t.address = 6;
	feed(decoder, &t, &seen);
	assert_int_equal(counter(decoder, "reads"), 2);
	assert_int_equal(seen.replies, 2);
	assert_int_equal(seen.kind, MODBUS_READ);
	t.function = 4; /* a holding register is no input register */
	feed(decoder, &t, &seen);
	t.function = 3;
	t.n = 2;
	feed(decoder, &t, &seen);
	assert_int_equal(counter(decoder, "foreign"), 2);
	assert_int_equal(seen.replies, 2);
	driver_modbus.decoder_destroy(decoder);
	d->position.type = REGISTER_I16; /* a register may be the angle and be waited for */
	d->position.address = 6;
	decoder = driver_modbus.decoder_create(d, 0);
	t.n = 1;
	seen = (struct seen){0};
	feed(decoder, &t, &seen);
	assert_int_equal(seen.tilts, 1);
	assert_int_equal(seen.replies, 2);
	assert_int_equal(seen.kind, MODBUS_READ);
	driver_modbus.decoder_destroy(decoder);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(all_four_orders_give_the_same_number),
	    cmocka_unit_test(every_type_reads_its_bytes_in_every_order),
	    cmocka_unit_test(every_type_goes_there_and_back_at_its_limits),
	    cmocka_unit_test(scale_zero_and_sign_are_applied_as_documented),
	    cmocka_unit_test(a_float_that_is_no_number_is_refused),
	    cmocka_unit_test(a_record_has_the_documented_bytes),
	    cmocka_unit_test(every_cut_record_waits_and_every_bad_one_is_refused),
	    cmocka_unit_test(an_angle_is_stamped_at_the_midpoint),
	    cmocka_unit_test(a_slow_round_trip_is_refused_and_a_slower_bus_is_followed),
	    cmocka_unit_test(a_slow_answer_of_a_servo_that_stands_is_taken),
	    cmocka_unit_test(round_trips_tell_the_jitter_and_the_period_the_rate),
	    cmocka_unit_test(one_register_is_read_for_the_dialogue_beside_the_angle),
	    cmocka_unit_test(foreign_refused_and_absurd_records_are_counted_not_decoded),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

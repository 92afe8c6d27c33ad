/* Law: a number is found in a frame where a DBC file says it is, and a frame that does not hold it gives a reason instead. */
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include <cmocka.h>

#include "drivers/can_signal.h"

#define COUNT(array) (sizeof(array) / sizeof *(array))

static const uint8_t golden[] = {0x12, 0x34, 0x56, 0x78, 0x9A, 0xBC, 0xDE, 0xF0};

static struct config_signal plain(int start, int length, int order, int type)
{
	struct config_signal s = {.set = true, .id = 0x181, .start = start, .length = length, .scale = 1};

	s.order = order;
	s.type = type;
	return s;
}

static struct can_frame_at frame(uint32_t id, const void *data, uint8_t len)
{
	return can_wire_frame(id, data, len);
}

static double read_good(const struct config_signal *s, const struct can_frame_at *f)
{
	struct can_signal_value v;

	assert_int_equal(can_signal_get(s, f, &v), CAN_SIGNAL_GOOD);
	return v.value;
}

static void the_golden_cases_read_as_in_a_dbc_file(void **state)
{
	static const struct {
		int start, length, order, type;
		double value;
	} cases[] = {
	    {0, 16, SIGNAL_INTEL, SIGNAL_UNSIGNED, 0x3412},        {7, 16, SIGNAL_MOTOROLA, SIGNAL_UNSIGNED, 0x1234},
	    {4, 12, SIGNAL_INTEL, SIGNAL_UNSIGNED, 0x341},         {3, 12, SIGNAL_MOTOROLA, SIGNAL_UNSIGNED, 0x234},
	    {39, 32, SIGNAL_MOTOROLA, SIGNAL_SIGNED, -1698898192}, {32, 32, SIGNAL_INTEL, SIGNAL_SIGNED, -253838182},
	};
	const struct can_frame_at f = frame(0x181, golden, 8);

	(void)state;
	for (size_t i = 0; i < COUNT(cases); i++) {
		const struct config_signal s = plain(cases[i].start, cases[i].length, cases[i].order, cases[i].type);

		assert_true(read_good(&s, &f) == cases[i].value);
	}
}

/* Written anew from the definition, bit by bit with the frame as one long number: independent of the code under test. */
static uint64_t slow_read(const uint8_t data[64], int start, int length, int order, bool *ret_inside)
{
	uint64_t bits = 0;
	int byte = start / 8, bit = start % 8;

	*ret_inside = true;
	for (int i = 0; i < length; i++) {
		if (byte > 63) {
			*ret_inside = false;
			return 0;
		}
		if (order == SIGNAL_INTEL) {
			bits |= (uint64_t)(data[byte] >> bit & 1) << i;
			bit++;
			byte += bit / 8;
			bit %= 8;
		} else {
			bits = bits << 1 | (data[byte] >> bit & 1);
			byte += bit == 0;
			bit = bit == 0 ? 7 : bit - 1;
		}
	}
	return bits;
}

static uint64_t random_bits(uint64_t *seed)
{
	uint64_t z = *seed += 0x9e3779b97f4a7c15ull;

	z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9ull;
	z = (z ^ z >> 27) * 0x94d049bb133111ebull;
	return z ^ z >> 31;
}

/* All 2 x 512 x 64 of them: read, needed length, written back, and no bit beside touched. */
static void every_start_and_length_reads_and_writes_its_own_bits(void **state)
{
	uint64_t seed = 5;

	(void)state;
	for (int order = SIGNAL_INTEL; order <= SIGNAL_MOTOROLA; order++)
		for (int start = 0; start < 512; start++)
			for (int length = 1; length <= 64; length++) {
				struct config_signal s = plain(start, length, order, SIGNAL_UNSIGNED);
				struct can_frame_at f = {.id = 0x181, .len = 64, .flags = CAN_WIRE_FD}, g;
				struct can_signal_value v;
				bool inside;
				uint64_t bits, other = random_bits(&seed) >> (64 - length);

				for (int i = 0; i < 64; i++)
					f.data[i] = (uint8_t)random_bits(&seed);
				bits = slow_read(f.data, start, length, order, &inside);
				if (!inside) {
					assert_true(can_signal_needs(&s) > 64);
					assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_SHORT);
					g = f;
					can_signal_put_bits(&s, other, &g);
					assert_memory_equal(&f, &g, sizeof f);
					continue;
				}
				assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_GOOD);
				assert_true(v.bits == bits && v.raw == (double)bits);
				g = f;
				can_signal_put_bits(&s, other, &g);
				assert_int_equal(can_signal_get(&s, &g, &v), CAN_SIGNAL_GOOD);
				assert_true(v.bits == other);
				can_signal_put_bits(&s, bits, &g);
				assert_memory_equal(f.data, g.data, 64);
				f.len = (uint8_t)can_signal_needs(&s);
				assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_GOOD);
				f.len--;
				assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_SHORT);
			}
}

static void signed_numbers_of_every_length_have_their_sign(void **state)
{
	(void)state;
	for (int length = 1; length <= 64; length++) {
		struct config_signal s = plain(0, length, SIGNAL_INTEL, SIGNAL_SIGNED);
		struct can_frame_at f = can_signal_frame(&s);

		can_signal_put_bits(&s, UINT64_MAX, &f);
		assert_true(read_good(&s, &f) == -1);
		can_signal_put_bits(&s, UINT64_C(1) << (length - 1), &f);
		assert_true(read_good(&s, &f) == -ldexp(1, length - 1));
		can_signal_put_bits(&s, (UINT64_C(1) << (length - 1)) - 1, &f);
		assert_true(read_good(&s, &f) == (double)((UINT64_C(1) << (length - 1)) - 1));
	}
}

static void quantities_come_back_within_half_a_count_and_are_limited(void **state)
{
	(void)state;
	for (int type = SIGNAL_SIGNED; type <= SIGNAL_UNSIGNED; type++)
		for (int length = 2; length <= 52; length++) {
			struct config_signal s = plain(13, length, length % 2, type);
			const double low = type == SIGNAL_SIGNED ? -ldexp(1, length - 1) : 0,
			             high = type == SIGNAL_SIGNED ? ldexp(1, length - 1) - 1 : ldexp(1, length) - 1;
			struct can_frame_at f;

			s.scale = -0.25;
			s.offset = 3;
			f = can_signal_frame(&s);
			for (int i = 0; i <= 16; i++) {
				const double raw = low + (high - low) / 16 * i, value = raw * s.scale + s.offset;

				can_signal_put(&s, value, &f);
				assert_true(fabs(read_good(&s, &f) - value) <= 0.125);
			}
			can_signal_put(&s, (high + 5) * s.scale + s.offset, &f);
			assert_true(read_good(&s, &f) == high * s.scale + s.offset);
			can_signal_put(&s, (low - 5) * s.scale + s.offset, &f);
			assert_true(read_good(&s, &f) == low * s.scale + s.offset);
			can_signal_put(&s, NAN, &f); /* something that the bits can say, no trap */
			read_good(&s, &f);
		}
}

static void floats_of_both_widths_and_orders_come_back(void **state)
{
	static const double value[] = {0, -0.5, 0.0078125, 1e-3, -3.25e10};

	(void)state;
	for (int order = SIGNAL_INTEL; order <= SIGNAL_MOTOROLA; order++)
		for (int length = 32; length <= 64; length += 32)
			for (size_t i = 0; i < COUNT(value); i++) {
				struct config_signal s =
				    plain(order == SIGNAL_INTEL ? 0 : 7, length, order, SIGNAL_FLOAT);
				struct can_frame_at f = can_signal_frame(&s);

				can_signal_put(&s, value[i], &f);
				assert_true(read_good(&s, &f) == (length == 64 ? value[i] : (double)(float)value[i]));
			}
}

static void what_is_no_number_is_refused(void **state)
{
	struct config_signal s = plain(0, 64, SIGNAL_INTEL, SIGNAL_FLOAT);
	struct can_frame_at f = can_signal_frame(&s);
	struct can_signal_value v;

	(void)state;
	can_signal_put(&s, NAN, &f);
	assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_NO_NUMBER);
	can_signal_put(&s, -INFINITY, &f);
	assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_NO_NUMBER);
	can_signal_put(&s, 1e300, &f);
	assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_GOOD);
	s.scale = 1e300;
	assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_NO_NUMBER);
	s = plain(0, 33, SIGNAL_INTEL, SIGNAL_FLOAT); /* refused by the configuration, too */
	assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_NO_NUMBER);
}

static void the_same_number_of_both_kinds_of_identifiers_never_mixes(void **state)
{
	struct config_signal s = plain(0, 16, SIGNAL_INTEL, SIGNAL_UNSIGNED);
	struct can_signal_value v;
	struct can_frame_at standard = frame(0x181, golden, 8), extended = frame(0x181 | CAN_WIRE_EXTENDED, golden, 8);

	(void)state;
	assert_int_equal(can_signal_get(&s, &standard, &v), CAN_SIGNAL_GOOD);
	assert_int_equal(can_signal_get(&s, &extended, &v), CAN_SIGNAL_FOREIGN);
	s.extended = true;
	assert_int_equal(can_signal_get(&s, &standard, &v), CAN_SIGNAL_FOREIGN);
	assert_int_equal(can_signal_get(&s, &extended, &v), CAN_SIGNAL_GOOD);
	s.id = 0x18FF0201;
	extended.id = 0x18FF0201 | CAN_WIRE_EXTENDED;
	assert_int_equal(can_signal_get(&s, &extended, &v), CAN_SIGNAL_GOOD);
	extended.id ^= 1;
	assert_int_equal(can_signal_get(&s, &extended, &v), CAN_SIGNAL_FOREIGN);
}

static void every_reason_has_its_frame(void **state)
{
	struct config_signal s = plain(0, 16, SIGNAL_INTEL, SIGNAL_UNSIGNED);
	struct can_signal_value v = {.value = 77};
	struct can_frame_at f = frame(0x181, golden, 8);

	(void)state;
	f.id |= CAN_WIRE_REMOTE;
	assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_REMOTE);
	f.id = CAN_WIRE_ERROR | 0x181;
	assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_ERROR);
	f.id = CAN_WIRE_LOST;
	assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_FOREIGN);
	f.id = 0x182;
	assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_FOREIGN);
	f.id = 0x181;
	s.min_dlc = 8;
	f.len = 7;
	assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_SHORT);
	s.min_dlc = 0;
	f.len = 1;
	assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_SHORT);
	f.len = 8;
	s.mux.set = true;
	s.mux.start = 56;
	s.mux.length = 8;
	s.mux.value = 0xF1;
	assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_OTHER_MUX);
	s.mux.value = 0xF0;
	s.valid.set = true;
	s.valid.bit = 16; /* 0x56: 0 */
	s.valid.value = 1;
	assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_INVALID);
	assert_true(v.value == 77); /* untouched */
	s.valid.value = 0;
	assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_GOOD);
	for (int i = 0; i < CAN_SIGNAL_VERDICTS; i++)
		for (int j = 0; j < i; j++)
			assert_string_not_equal(can_signal_name(i), can_signal_name(j));
}

static void multiplexor_counter_and_valid_bit_need_room_too(void **state)
{
	struct config_signal s = plain(0, 8, SIGNAL_INTEL, SIGNAL_UNSIGNED);

	(void)state;
	assert_int_equal(can_signal_needs(&s), 1);
	s.counter.set = true;
	s.counter.start = 12;
	s.counter.length = 4;
	assert_int_equal(can_signal_needs(&s), 2);
	s.valid.set = true;
	s.valid.bit = 16;
	assert_int_equal(can_signal_needs(&s), 3);
	s.mux.set = true;
	s.mux.start = 24;
	s.mux.length = 32;
	assert_int_equal(can_signal_needs(&s), 7);
	s.min_dlc = 8;
	assert_int_equal(can_signal_needs(&s), 8);
	assert_int_equal(can_signal_frame(&s).len, 8);
	assert_int_equal(can_signal_frame(&s).flags, 0);
	s.min_dlc = 9;
	assert_int_equal(can_signal_frame(&s).len, 12);
	assert_int_equal(can_signal_frame(&s).flags, CAN_WIRE_FD);
}

static void a_frame_made_for_a_signal_is_read_as_that_signal(void **state)
{
	struct config_signal s = plain(7, 16, SIGNAL_MOTOROLA, SIGNAL_SIGNED);
	struct can_frame_at f;
	struct can_signal_value v;

	(void)state;
	s.extended = true;
	s.id = 0x1ABCDEF0;
	s.scale = 0.01;
	s.mux.set = s.counter.set = s.valid.set = true;
	s.mux.start = 23;
	s.mux.length = 4;
	s.mux.value = 9;
	s.counter.start = 19;
	s.counter.length = 4;
	s.valid.bit = 24;
	s.valid.value = 1;
	f = can_signal_frame(&s);
	can_signal_put(&s, -12.34, &f);
	can_signal_put_counter(&s, 13, &f);
	assert_int_equal(f.id, 0x1ABCDEF0u | CAN_WIRE_EXTENDED);
	assert_int_equal(f.len, 4);
	assert_memory_equal(f.data, ((uint8_t[]){0xFB, 0x2E, 0x9D, 0x01}), 4);
	assert_int_equal(can_signal_get(&s, &f, &v), CAN_SIGNAL_GOOD);
	assert_true(fabs(v.value + 12.34) < 1e-12);
	assert_int_equal(v.counter, 13);
}

/* A frame whose value is not valid has been received all the same. */
static void a_gap_of_the_counter_is_counted_and_the_frame_is_used(void **state)
{
	struct config_signal s = plain(0, 8, SIGNAL_INTEL, SIGNAL_UNSIGNED);
	struct can_signal_counter c = {0};

	(void)state;
	s.counter.set = true;
	s.counter.start = 8;
	s.counter.length = 4;
	can_signal_follow(&s, &c, 13);
	can_signal_follow(&s, &c, 14);
	can_signal_follow(&s, &c, 15);
	can_signal_follow(&s, &c, 0);
	assert_true(c.lost == 0 && c.stuck == 0);
	can_signal_follow(&s, &c, 3);
	assert_true(c.lost == 2);
	can_signal_follow(&s, &c, 2);
	assert_true(c.lost == 2 + 14);
	can_signal_follow(&s, &c, 2);
	assert_true(c.lost == 16 && c.stuck == 1);
	s.counter.length = 32;
	c = (struct can_signal_counter){.known = true, .last = UINT32_MAX};
	can_signal_follow(&s, &c, 1);
	assert_true(c.lost == 1);
	s.counter.set = false;
	can_signal_follow(&s, &c, 50);
	assert_true(c.lost == 1);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(the_golden_cases_read_as_in_a_dbc_file),
	    cmocka_unit_test(every_start_and_length_reads_and_writes_its_own_bits),
	    cmocka_unit_test(signed_numbers_of_every_length_have_their_sign),
	    cmocka_unit_test(quantities_come_back_within_half_a_count_and_are_limited),
	    cmocka_unit_test(floats_of_both_widths_and_orders_come_back),
	    cmocka_unit_test(what_is_no_number_is_refused),
	    cmocka_unit_test(the_same_number_of_both_kinds_of_identifiers_never_mixes),
	    cmocka_unit_test(every_reason_has_its_frame),
	    cmocka_unit_test(multiplexor_counter_and_valid_bit_need_room_too),
	    cmocka_unit_test(a_frame_made_for_a_signal_is_read_as_that_signal),
	    cmocka_unit_test(a_gap_of_the_counter_is_counted_and_the_frame_is_used),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

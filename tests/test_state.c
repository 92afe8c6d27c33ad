/* Law L7: what a snapshot saved, a load gives back bit for bit; a cut, damaged or foreign one is refused, and what it had
 * not yet reached stays as it was. */
#include <float.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "core/state.h"

/* One of each kind, in the manner of a module. */
struct module {
	uint8_t u8;
	uint16_t u16;
	uint32_t u32;
	uint64_t u64;
	int64_t i64, t_ns;
	double real;
	float single;
	bool yes;
	int number;
	size_t size;
	uint8_t bytes[5];
};

static void module_state(struct state *s, struct module *m)
{
	state_tag(s, "module1");
	state_u8(s, &m->u8);
	state_u16(s, &m->u16);
	state_u32(s, &m->u32);
	state_u64(s, &m->u64);
	state_i64(s, &m->i64);
	state_time(s, &m->t_ns);
	state_double(s, &m->real);
	state_float(s, &m->single);
	state_bool(s, &m->yes);
	state_int(s, &m->number, -7, 7);
	state_size(s, &m->size, 1000);
	state_bytes(s, m->bytes, sizeof(m->bytes));
}

static const struct module FULL = {.u8 = 0xfe,
                                   .u16 = 0xfedc,
                                   .u32 = 0xfedcba98u,
                                   .u64 = 0xfedcba9876543210u,
                                   .i64 = INT64_MIN,
                                   .t_ns = 1732200000123456789,
                                   .real = -0x1.23456789abcdfp-7,
                                   .single = -0.1f,
                                   .yes = true,
                                   .number = -7,
                                   .size = 1000,
                                   .bytes = {1, 2, 3, 4, 5}};

/* Fields in order, so that a prefix of them can be compared. */
static int fields_equal(const struct module *a, const struct module *b)
{
	const bool equal[] = {a->u8 == b->u8,
	                      a->u16 == b->u16,
	                      a->u32 == b->u32,
	                      a->u64 == b->u64,
	                      a->i64 == b->i64,
	                      a->t_ns == b->t_ns,
	                      memcmp(&a->real, &b->real, sizeof(a->real)) == 0,
	                      memcmp(&a->single, &b->single, sizeof(a->single)) == 0,
	                      a->yes == b->yes,
	                      a->number == b->number,
	                      a->size == b->size,
	                      memcmp(a->bytes, b->bytes, sizeof(a->bytes)) == 0};
	int n = 0;

	for (size_t i = 0; i < sizeof(equal) / sizeof(*equal); i++)
		n += equal[i];
	return n;
}

enum { FIELDS = 12, CAP = 256 };

static size_t save(const struct module *m, uint8_t bytes[CAP])
{
	struct module copy = *m;
	struct state s;

	state_save(&s, bytes, CAP);
	module_state(&s, &copy);
	assert_true(state_done(&s));
	return s.at;
}

static bool load(const uint8_t *bytes, size_t len, struct module *ret)
{
	struct state s;

	state_load(&s, bytes, len);
	module_state(&s, ret);
	return state_done(&s);
}

static void a_load_gives_back_what_was_saved(void **state)
{
	const struct module extremes[] = {
	    FULL,
	    {0},
	    {.real = -0.0, .single = -0.0f, .i64 = INT64_MAX, .t_ns = STATE_TIME_MIN, .number = 7},
	    {.real = DBL_MAX, .single = FLT_MAX, .u64 = UINT64_MAX, .t_ns = STATE_TIME_MAX},
	    {.real = 0x1p-1074, .single = 0x1p-149f, .i64 = -1, .t_ns = -1, .number = -1},
	};
	uint8_t bytes[CAP];

	(void)state;
	for (size_t i = 0; i < sizeof(extremes) / sizeof(*extremes); i++) {
		struct module back = {.u8 = 77};

		assert_true(load(bytes, save(&extremes[i], bytes), &back));
		assert_int_equal(fields_equal(&back, &extremes[i]), FIELDS);
	}
}

/* The layout is little-endian on every machine: these bytes were written down, not computed. */
static void the_bytes_are_the_documented_ones(void **state)
{
	static const uint8_t expected[] = {'o', 'n',  'e',  0,    0x34, 0x12, 0,    0,    0,    0,   0,
	                                   0,   0xfe, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0,   0,
	                                   0,   0,    0,    0,    0xf8, 0xbf, 0,    0,    0x80, 0x3f};
	uint8_t bytes[sizeof(expected)];
	uint16_t u16 = 0x1234;
	int number = -2;
	double real = -1.5;
	float single = 1;
	struct state s;

	(void)state;
	state_save(&s, bytes, sizeof(bytes));
	state_tag(&s, "one");
	state_u16(&s, &u16);
	state_int(&s, &number, -5, 5);
	state_double(&s, &real);
	state_float(&s, &single);
	assert_true(state_done(&s));
	assert_int_equal(s.at, sizeof(expected));
	assert_memory_equal(bytes, expected, sizeof(expected));
}

static void every_shorter_snapshot_is_refused_and_a_longer_one_too(void **state)
{
	uint8_t bytes[CAP];
	size_t len = save(&FULL, bytes);

	(void)state;
	for (size_t cut = 0; cut < len; cut++) {
		uint8_t *copy = malloc(cut ? cut : 1); /* its own memory: a read beyond it is found by sanitizers */
		struct module back = {0};

		memcpy(copy, bytes, cut);
		assert_false(load(copy, cut, &back));
		free(copy);
	}
	struct module back = {0};

	bytes[len] = 0;
	assert_false(load(bytes, len + 1, &back));
}

static void saving_needs_the_same_room_whether_it_has_it_or_not(void **state)
{
	uint8_t bytes[CAP], guard = 0xa5;
	size_t len = save(&FULL, bytes);
	struct module copy = FULL;
	struct state s;

	(void)state;
	for (size_t cap = 0; cap < len; cap++) {
		uint8_t *room = malloc(cap + 1);

		room[cap] = guard;
		state_save(&s, cap ? room : NULL, cap);
		module_state(&s, &copy);
		assert_false(state_done(&s));
		assert_int_equal(s.at, len);
		assert_int_equal(room[cap], guard);
		free(room);
	}
	assert_int_equal(fields_equal(&copy, &FULL), FIELDS);
}

/* Places of the fields behind the tag "module1": eight bytes each, the float four. */
enum { AT_U8 = 8, AT_U16 = 16, AT_U32 = 24, AT_TIME = 48, AT_REAL = 56, AT_YES = 68, AT_NUMBER = 76, AT_SIZE = 84 };

static void put(uint8_t *bytes, int64_t value)
{
	for (int i = 0; i < 8; i++)
		bytes[i] = (uint8_t)((uint64_t)value >> 8 * i);
}

static void a_value_outside_its_bounds_fails_the_load_from_there_on(void **state)
{
	static const struct {
		size_t at;
		int64_t value;
		int before; /* fields that come before it */
	} bad[] = {{AT_U8, 256, 0},
	           {AT_U8, -1, 0},
	           {AT_U16, 65536, 1},
	           {AT_U32, INT64_C(1) << 32, 2},
	           {AT_TIME, STATE_TIME_MAX + 1, 5},
	           {AT_TIME, STATE_TIME_MIN - 1, 5},
	           {AT_REAL, 0x7ff0000000000000, 6},        /* infinite */
	           {AT_REAL, INT64_C(-0x8000000000000), 6}, /* fff8...: no number */
	           {AT_YES, 2, 8},
	           {AT_NUMBER, 8, 9},
	           {AT_NUMBER, -8, 9},
	           {AT_NUMBER, INT64_C(1) << 32, 9}, /* 0 as an int */
	           {AT_SIZE, 1001, 10},
	           {AT_SIZE, -1, 10}};
	/* Differs from FULL in every field. */
	const struct module other = {
	    .u8 = 1, .u16 = 1, .u32 = 1, .u64 = 1, .t_ns = 1, .real = 1, .single = 1, .bytes = {9}};
	uint8_t bytes[CAP];

	(void)state;
	assert_int_equal(fields_equal(&other, &FULL), 0);
	for (size_t i = 0; i < sizeof(bad) / sizeof(*bad); i++) {
		size_t len = save(&FULL, bytes);
		struct module back = other;

		put(bytes + bad[i].at, bad[i].value);
		assert_false(load(bytes, len, &back));
		assert_int_equal(fields_equal(&back, &FULL), bad[i].before);
		assert_int_equal(fields_equal(&back, &other), FIELDS - bad[i].before);
	}
}

static void another_tag_or_another_version_is_refused(void **state)
{
	static const char *const word[] = {"clock1", "clock2", "clock10", "clock", "", "fifteen_letters"};
	uint8_t bytes[CAP];

	(void)state;
	for (size_t i = 0; i < sizeof(word) / sizeof(*word); i++)
		for (size_t k = 0; k < sizeof(word) / sizeof(*word); k++) {
			struct state s;
			size_t len;

			state_save(&s, bytes, CAP);
			state_tag(&s, word[i]);
			len = s.at;
			state_load(&s, bytes, len);
			state_tag(&s, word[k]);
			assert_true(state_done(&s) == (i == k));
		}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_load_gives_back_what_was_saved),
	    cmocka_unit_test(the_bytes_are_the_documented_ones),
	    cmocka_unit_test(every_shorter_snapshot_is_refused_and_a_longer_one_too),
	    cmocka_unit_test(saving_needs_the_same_room_whether_it_has_it_or_not),
	    cmocka_unit_test(a_value_outside_its_bounds_fails_the_load_from_there_on),
	    cmocka_unit_test(another_tag_or_another_version_is_refused),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

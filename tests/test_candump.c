/* Law L8: every line that candump writes is read as it was meant, and no other line is taken for one. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "drivers/candump.h"

static enum candump_kind read_line(const char *text, struct candump_line *ret)
{
	return candump_read(text, strlen(text), ret);
}

/* The data of a frame as hex digits. */
static const char *hex_of(const struct can_frame_at *f)
{
	static char text[2 * sizeof f->data + 1];

	text[0] = 0;
	for (int i = 0; i < f->len; i++)
		sprintf(text + (size_t)2 * (size_t)i, "%02X", f->data[i]);
	return text;
}

static void each_form_of_a_frame_is_read(void **state)
{
	static const struct {
		const char *text;
		uint32_t id;
		int len, flags, raw_dlc;
		char direction;
		int64_t t_ns;
		const char *data;
	} of[] = {
	    {"(1604665855.310219) can0 181#A8000001", 0x181, 4, 0, 0, 0, 1604665855310219000, "A8000001"},
	    {"(1604665855.310219001) can0 181#A8000001\n", 0x181, 4, 0, 0, 0, 1604665855310219001, "A8000001"},
	    {"(0.000000) can0 764#00\r\n", 0x764, 1, 0, 0, 0, 0, "00"},
	    {"(1.5) vcan12 00000181#", 0x181 | CAN_WIRE_EXTENDED, 0, 0, 0, 0, 1500000000, ""},
	    {"(1.000000) can0 1FFFFFFF#11.22.33 R", 0x1fffffff | CAN_WIRE_EXTENDED, 3, 0, 0, 'R', 1000000000, "112233"},
	    {"(1.000000) can0 20000004#000C000000000000", CAN_WIRE_ERROR | 4, 8, 0, 0, 0, 1000000000,
	     "000C000000000000"},
	    {"(1.000000) can0 181#R", 0x181 | CAN_WIRE_REMOTE, 0, 0, 0, 0, 1000000000, ""},
	    {"(1.000000) can0 181#R5 T", 0x181 | CAN_WIRE_REMOTE, 5, 0, 0, 'T', 1000000000, "0000000000"},
	    {"(1.000000) can0 181##1A80102030405060708090a0b", 0x181, 12, CAN_WIRE_FD | CAN_WIRE_BRS, 0, 0, 1000000000,
	     "A80102030405060708090A0B"},
	    {"(1.000000) can0 181##0", 0x181, 0, CAN_WIRE_FD, 0, 0, 1000000000, ""},
	    {"(1.000000) can0 181#1122334455667788_F", 0x181, 8, 0, 15, 0, 1000000000, "1122334455667788"},
	    {"can0 181#01", 0x181, 1, 0, 0, 0, 0, "01"},
	    {"  can0  764   [1]  00", 0x764, 1, 0, 0, 0, 0, "00"},
	    {"  can0  080   [0] ", 0x080, 0, 0, 0, 0, 0, ""},
	    {" (000.304418)  can0  601   [8]  23 FE 60 01 00 00 80 01", 0x601, 8, 0, 0, 0, 304418000,
	     "23FE600100008001"},
	    {" (2020-11-06 12:30:55.310219)  can0  601   [2]  23 FE   '#.'", 0x601, 2, 0, 0, 0, 1604665855310219000,
	     "23FE"},
	    {" (000.000001)  can0  RX - -  123   [2]  11 22", 0x123, 2, 0, 0, 'R', 1000, "1122"},
	    {"  can0  TX B E  00000123  [12]  00 01 02 03 04 05 06 07 08 09 0A 0B", 0x123 | CAN_WIRE_EXTENDED, 12,
	     CAN_WIRE_FD, 0, 'T', 0, "000102030405060708090A0B"},
	    {"  can0  123   [4]  remote request", 0x123 | CAN_WIRE_REMOTE, 4, 0, 0, 0, 0, "00000000"},
	    {"  can0  123   {C}  11 22 33 44 55 66 77 88", 0x123, 8, 0, 12, 0, 0, "1122334455667788"},
	    {"  can0  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME", CAN_WIRE_ERROR | 4, 8, 0, 0, 0, 0,
	     "0004000000000000"},
	};
	struct candump_line line;

	(void)state;
	for (size_t i = 0; i < sizeof of / sizeof of[0]; i++) {
		if (read_line(of[i].text, &line) != CANDUMP_FRAME)
			fail_msg("not read: %s", of[i].text);
		assert_int_equal(line.frame.id, of[i].id);
		assert_int_equal(line.frame.len, of[i].len);
		assert_int_equal(line.frame.flags, of[i].flags);
		assert_int_equal(line.raw_dlc, of[i].raw_dlc);
		assert_int_equal(line.direction, of[i].direction);
		assert_int_equal(line.frame.t_ns, of[i].t_ns);
		assert_int_equal(line.timed, strchr(of[i].text, '(') != NULL);
		assert_string_equal(hex_of(&line.frame), of[i].data);
	}
}

static void the_interface_is_told(void **state)
{
	struct candump_line line;

	(void)state;
	assert_int_equal(read_line("(1.000000) slcan_front_axi 181#", &line), CANDUMP_FRAME);
	assert_string_equal(line.interface, "slcan_front_axi");
	assert_int_equal(read_line("(1.000000) slcan_front_axis 181#", &line), CANDUMP_BAD);
}

static void frames_that_candump_lost_are_told(void **state)
{
	struct candump_line line;

	(void)state;
	assert_int_equal(read_line("DROPCOUNT: dropped 5 CAN frames on 'can0' socket (total drops 7)", &line),
	                 CANDUMP_DROPPED);
	assert_int_equal(line.dropped, 5);
	assert_string_equal(line.interface, "can0");
	assert_int_equal(read_line("DROPCOUNT: dropped 1 CAN frame on 'can1' socket (total drops 8)", &line),
	                 CANDUMP_DROPPED);
	assert_int_equal(line.dropped, 1);
}

static void what_is_no_frame_is_passed_over(void **state)
{
	static const char *const nothing[] = {"", "\n", "   ", "# a comment", "\tcontroller-problem{tx-error-warning}"};
	struct candump_line line;

	(void)state;
	for (size_t i = 0; i < sizeof nothing / sizeof nothing[0]; i++)
		assert_int_equal(read_line(nothing[i], &line), CANDUMP_NOTHING);
}

static void a_line_that_is_not_candumps_is_refused(void **state)
{
	static const char *const bad[] = {
	    "hello",
	    "can0",
	    "can0 ",
	    "can0 181",
	    "can0 18#00",
	    "can0 1810#00",
	    "can0 800#00",                     /* more than 11 bits */
	    "(2305843009.213694) can0 181#00", /* 2043: no entry can say it */
	    "(2043-01-26 12:00:00.000000) can0 181#00",
	    "can0 40000000#00",              /* more than 29 */
	    "can0 181#0",                    /* half a byte */
	    "can0 181#001122334455667788",   /* 9 bytes */
	    "can0 181#R9",                   /* a remote frame of 9 */
	    "can0 181##",                    /* FD without flags */
	    "can0 181##1001122334455667788", /* FD of 9 bytes */
	    "can0 181#1122_F",               /* a raw length with 2 bytes */
	    "can0 181#1122334455667788_8",   /* which is not raw */
	    "can0 181#00 X",
	    "can0 181#00 R R",
	    "(1.000000 can0 181#00",
	    "(1) can0 181#00",
	    "(.5) can0 181#00",
	    "(1.) can0 181#00",
	    "(1.0000000001) can0 181#00",
	    "(99999999999.0) can0 181#00",
	    "(2020-13-06 12:30:55.310219) can0 181#00",
	    "(2020-11-06 12:30.310219) can0 181#00",
	    "  can0  181   [9]  00 00 00 00 00 00 00 00 00",
	    "  can0  181   [2]  00",
	    "  can0  181   [2]  00 00 00",
	    "  can0  181   [2",
	    "  can0  181   [13]  00",
	    "  can0  181   {8}  11 22 33 44 55 66 77 88",
	    "  can0  181   [12]  remote request",
	    "  can0  181   ",
	    "  can0  RX",
	    "DROPCOUNT: dropped frames",
	    "DROPCOUNT: dropped 5 CAN frames",
	    "DROPCOUNT: dropped 5 CAN frames on 'can",
	};
	struct candump_line line;

	(void)state;
	for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
		if (read_line(bad[i], &line) != CANDUMP_BAD)
			fail_msg("taken: %s", bad[i]);
		assert_int_equal(line.frame.id, 0);
	}
}

/* No shorter line reads beyond its end: it is a copy of its own (a sanitizer watches). */
static void every_cut_line_is_read_within_its_end(void **state)
{
	static const char *const whole[] = {
	    "(2020-11-06 12:30:55.310219) can0  RX - -  00000123  [12]  00 01 02 03 04 05 06 07 08 09 0A 0B",
	    "(1604665855.310219) can0 181##1A80102030405060708090A0B R",
	    "(1604665855.310219) can0 181#1122334455667788_F T",
	    "DROPCOUNT: dropped 5 CAN frames on 'can0' socket (total drops 7)",
	};
	struct candump_line line;

	(void)state;
	for (size_t i = 0; i < sizeof whole / sizeof whole[0]; i++)
		for (size_t len = 0; len <= strlen(whole[i]); len++) {
			char *cut = malloc(len ? len : 1);

			memcpy(cut, whole[i], len);
			candump_read(cut, len, &line);
			assert_true(line.frame.len <= 64);
			free(cut);
		}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(each_form_of_a_frame_is_read),
	    cmocka_unit_test(the_interface_is_told),
	    cmocka_unit_test(frames_that_candump_lost_are_told),
	    cmocka_unit_test(what_is_no_frame_is_passed_over),
	    cmocka_unit_test(a_line_that_is_not_candumps_is_refused),
	    cmocka_unit_test(every_cut_line_is_read_within_its_end),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

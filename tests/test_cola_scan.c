/* Law: whatever a scan telegram holds is read field by field as it was written, in either dialect, and one that is cut,
 * too long or not understood to its last byte is refused. */
#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include <cmocka.h>

#include "tests/cola_telegrams.h"

static uint8_t frame[COLA_TELEGRAM_MAX];

static int read_frame(size_t len, struct cola_scan *ret)
{
	const uint8_t *payload;
	size_t payload_len;

	assert_true(len > 0);
	assert_int_equal(cola_scan_frame(NULL, frame, len, true), len);
	const enum cola_dialect dialect = cola_payload(frame, len, &payload, &payload_len);
	return cola_scan_read(dialect, payload, payload_len, ret);
}

/* Everything there can be at once. */
static struct cola_scan full_scan(void)
{
	struct cola_scan s = telegram_tim();

	s.status[1] = 1;
	s.telegram_counter = 65535;
	s.inputs[0] = 3, s.inputs[1] = 1, s.outputs[0] = 0x3F, s.outputs[1] = 7;
	s.layer = -250;
	s.encoders = 2;
	s.encoder[0].ticks = 0xFFFFFFF0, s.encoder[0].speed = 17;
	s.encoder[1].ticks = 3;
	s.channels = 4;
	s.channel[0].n = 3;
	s.channel[1] = (struct cola_channel){
	    .name = "DIST2", .scale = 2, .offset = -0.5f, .start_tdeg = 0, .step_tdeg = 3333, .n = 0, .bytes = 2};
	s.channel[2] = (struct cola_channel){
	    .name = "RSSI1", .scale = 1, .start_tdeg = -450000, .step_tdeg = 10000, .n = 3, .bytes = 1};
	s.channel[3] = (struct cola_channel){
	    .name = "VANG1", .scale = 0.1f, .start_tdeg = 2249997, .step_tdeg = 65535, .n = 1, .bytes = 1};
	s.has_position = true;
	for (int i = 0; i < 6; i++)
		s.position[i] = (float)i - 2.5f;
	s.position_type = 2;
	s.name = "not defined", s.name_len = 11;
	s.comment = " 2 blanks", s.comment_len = 9;
	s.has_time = true;
	s.year = 1970, s.month = 1, s.day = 2, s.hour = 23, s.minute = 59, s.second = 58, s.microsecond = 999999;
	s.has_event = true;
	memcpy(s.event, "FDIN", 5);
	s.event_encoder = 5, s.event_us = 0xFFFFFFFF, s.event_angle = -900000;
	return s;
}

static void check_text(const char *got, size_t got_len, const char *want, size_t want_len)
{
	assert_int_equal(got != NULL, want != NULL);
	assert_int_equal(got_len, want_len);
	if (want_len > 0)
		assert_memory_equal(got, want, want_len);
}

static void check_same(const struct cola_scan *got, const struct cola_scan *want)
{
	struct cola_scan g = *got, w = *want;

	check_text(g.name, g.name_len, w.name, w.name_len);
	check_text(g.comment, g.comment_len, w.comment, w.comment_len);
	g.name = g.comment = w.name = w.comment = NULL;
	for (int i = 0; i < COLA_CHANNELS_MAX; i++)
		g.channel[i].values = w.channel[i].values = (struct cola_reader){0};
	for (int i = 0; i < w.channels; i++) {
		assert_string_equal(g.channel[i].name, w.channel[i].name);
		assert_true(g.channel[i].scale == w.channel[i].scale && g.channel[i].offset == w.channel[i].offset);
		assert_int_equal(g.channel[i].start_tdeg, w.channel[i].start_tdeg);
		assert_int_equal(g.channel[i].step_tdeg, w.channel[i].step_tdeg);
		assert_int_equal(g.channel[i].n, w.channel[i].n);
		assert_int_equal(g.channel[i].bytes, w.channel[i].bytes);
	}
	assert_memory_equal(g.position, w.position, sizeof(g.position));
	assert_memory_equal(g.encoder, w.encoder, sizeof(g.encoder));
	assert_string_equal(g.event, w.event);
#define SAME(field) assert_int_equal(g.field, w.field)
	SAME(monitored), SAME(version), SAME(device), SAME(serial), SAME(status[0]), SAME(status[1]);
	SAME(telegram_counter), SAME(scan_counter), SAME(t_startup_us), SAME(t_transmit_us);
	SAME(inputs[0]), SAME(inputs[1]), SAME(outputs[0]), SAME(outputs[1]), SAME(layer), SAME(frequency_chz);
	SAME(measurement_hhz), SAME(encoders), SAME(channels), SAME(has_position), SAME(position_type), SAME(has_time);
	SAME(year), SAME(month), SAME(day), SAME(hour), SAME(minute), SAME(second), SAME(microsecond), SAME(has_event);
	SAME(event_encoder), SAME(event_us), SAME(event_angle);
}

static void everything_at_once_is_read_as_written(void **state)
{
	struct cola_scan want = full_scan(), got;
	uint16_t values[8];

	(void)state;
	for (int dialect = COLA_A; dialect <= COLA_B; dialect++) {
		const enum cola_dialect d = (enum cola_dialect)dialect;
		size_t len = telegram_scan(d, "sSN LMDscandata", &want, 250, 1, frame, sizeof(frame));
		assert_int_equal(read_frame(len, &got), 0);
		check_same(&got, &want);
		cola_channel_values(&got.channel[0], values);
		assert_int_equal(values[0], 250);
		assert_int_equal(values[2], 252);
		cola_channel_values(cola_scan_channel(&got, "RSSI1"), values);
		assert_int_equal(values[1], 251);
		assert_ptr_equal(cola_scan_channel(&got, "VANG1"), &got.channel[3]);
		assert_null(cola_scan_channel(&got, "ANGL1"));
		want.monitored = true;
		len = telegram_scan(d, "sRA LMDscandatamon", &want, 250, 1, frame, sizeof(frame));
		assert_int_equal(read_frame(len, &got), 0);
		check_same(&got, &want);
		want.monitored = false;
	}
}

static void every_choice_of_parts_is_read_as_written(void **state)
{
	(void)state;
	for (unsigned choice = 0; choice < 512; choice++) {
		struct cola_scan want = full_scan(), got;
		want.has_position = choice & 1;
		want.has_time = choice & 2;
		want.has_event = choice & 4;
		want.encoders = choice & 8 ? 1 : 0;
		want.channels = (int)(choice >> 4 & 3) + 1;
		want.comment_len = choice & 64 ? 0 : 9;
		want.name_len = choice & 128 ? 0 : 11;
		memset(want.encoder + want.encoders, 0, sizeof(want.encoder[0]) * (size_t)(2 - want.encoders));
		if (!want.has_position)
			memset(want.position, 0, sizeof(want.position)), want.position_type = 0;
		if (!want.has_time)
			want.year = 0, want.month = want.day = want.hour = want.minute = want.second = 0,
			want.microsecond = 0;
		if (!want.has_event)
			want.event[0] = 0, want.event_encoder = want.event_us = 0, want.event_angle = 0;
		if (choice & 256)
			want.name = NULL, want.name_len = 0;
		for (int dialect = COLA_A; dialect <= COLA_B; dialect++) {
			const size_t len = telegram_scan((enum cola_dialect)dialect, "sSN LMDscandata", &want, 7, 100,
			                                 frame, sizeof(frame));
			/* 8-bit values beyond 255 wrap when written: what is read is judged elsewhere. */
			assert_int_equal(read_frame(len, &got), 0);
			check_same(&got, &want);
		}
	}
}

/* A copy of exactly the payload, so that reading beyond it is found by the sanitizers. */
static int read_copy(enum cola_dialect dialect, const uint8_t *payload, size_t len)
{
	uint8_t *copy = test_malloc(len > 0 ? len : 1);
	struct cola_scan got;

	memcpy(copy, payload, len);
	const int r = cola_scan_read(dialect, copy, len, &got);
	test_free(copy);
	return r;
}

static void every_shorter_payload_is_refused(void **state)
{
	const struct cola_scan s = full_scan();

	(void)state;
	for (int dialect = COLA_A; dialect <= COLA_B; dialect++) {
		const enum cola_dialect d = (enum cola_dialect)dialect;
		const size_t len = telegram_scan(d, "sSN LMDscandata", &s, 1, 1, frame, sizeof(frame));
		const uint8_t *payload;
		size_t n;
		cola_payload(frame, len, &payload, &n);
		assert_int_equal(read_copy(d, payload, n), 0);
		for (size_t cut = 0; cut < n; cut++) {
			/* The last token of CoLa-A, FFF244A0, is still a number when it is cut. */
			const bool number = d == COLA_A && n - cut < 8;
			assert_int_equal(read_copy(d, payload, cut), number ? 0 : -EINVAL);
		}
	}
}

static void bytes_behind_the_last_field_are_not_understood(void **state)
{
	static const char text[] = "sRA LMDscandata 1 1 5 0 0 1 1 1 1 0 0 0 0 0 5DC 36 0 0 0 0 0 0 0 0";
	struct cola_scan got;
	uint8_t bytes[128];

	(void)state;
	memcpy(bytes, text, sizeof(text));
	const size_t n = sizeof(text) - 1;
	assert_int_equal(cola_scan_read(COLA_A, bytes, n, &got), 0); /* an empty one: 26 tokens */
	assert_int_equal(got.channels, 0);
	assert_null(got.name);
	bytes[n] = ' ';
	assert_int_equal(cola_scan_read(COLA_A, bytes, n + 1, &got), 0); /* a trailing blank is nothing */
	bytes[n + 1] = '0';
	assert_int_equal(cola_scan_read(COLA_A, bytes, n + 2, &got), -EINVAL);

	const struct cola_scan s = telegram_tim();
	const size_t len = telegram_scan(COLA_B, "sSN LMDscandata", &s, 1, 1, frame, sizeof(frame));
	assert_int_equal(cola_scan_read(COLA_B, frame + 8, len - 9, &got), 0);
	assert_int_equal(cola_scan_read(COLA_B, frame + 8, len - 8, &got), -EINVAL);
}

static void counts_beyond_what_is_documented_are_refused(void **state)
{
	struct cola_scan s = telegram_tim(), got;

	(void)state;
	for (int dialect = COLA_A; dialect <= COLA_B; dialect++) {
		const enum cola_dialect d = (enum cola_dialect)dialect;
		for (s.encoders = 0; s.encoders <= COLA_ENCODERS_MAX + 1; s.encoders++) {
			const size_t len = telegram_scan(d, "sSN LMDscandata", &s, 1, 1, frame, sizeof(frame));
			assert_int_equal(read_frame(len, &got), s.encoders <= COLA_ENCODERS_MAX ? 0 : -EINVAL);
		}
		s.encoders = 0;
		for (unsigned wide = 0; wide <= COLA_CHANNELS_MAX + 1; wide += COLA_CHANNELS_MAX + 1) {
			for (unsigned narrow = 0; narrow <= COLA_CHANNELS_MAX + 1; narrow++) {
				struct cola_writer w;
				const struct cola_channel empty = {.name = "DIST1", .scale = 1};
				cola_writer_init(&w, d, frame, sizeof(frame), "sSN LMDscandata");
				telegram_head(&w, &s);
				cola_write_u(&w, wide, 2);
				for (unsigned i = 0; i < wide; i++)
					telegram_channel(&w, &empty, 0, 0);
				cola_write_u(&w, narrow, 2);
				for (unsigned i = 0; i < narrow; i++)
					telegram_channel(&w, &empty, 0, 0);
				telegram_tail(&w, &s);
				const bool fits = wide + narrow <= COLA_CHANNELS_MAX;
				assert_int_equal(read_frame(cola_writer_end(&w), &got), fits ? 0 : -EINVAL);
			}
		}
	}
}

static void a_flag_is_0_or_1(void **state)
{
	const struct cola_scan s = telegram_tim();
	struct cola_scan got;
	const size_t len = telegram_scan(COLA_B, "sSN LMDscandata", &s, 1, 1, frame, sizeof(frame));

	(void)state;
	for (size_t flag = 1; flag <= 5; flag++) {
		uint8_t *at = frame + len - 1 - 2 * flag + 1;
		*at = 2;
		assert_int_equal(cola_scan_read(COLA_B, frame + 8, len - 9, &got), -EINVAL);
		*at = 0;
	}
	assert_int_equal(cola_scan_read(COLA_B, frame + 8, len - 9, &got), 0);
}

static void other_names_are_other_telegrams(void **state)
{
	static const char *const names[] = {"sSN LMDscandat", "sSN LMDscandata2", "sSN LMDscandatamon2", "sSN X"};
	const struct cola_scan s = telegram_tim();
	struct cola_scan got;

	(void)state;
	for (size_t i = 0; i < sizeof(names) / sizeof(names[0]); i++) {
		const size_t len = telegram_scan(COLA_A, names[i], &s, 1, 1, frame, sizeof(frame));
		assert_int_equal(read_frame(len, &got), -EINVAL);
	}
}

static void a_value_too_wide_for_its_channel_is_refused(void **state)
{
	static const char good[] =
	    "sRA LMDscandata 1 1 5 0 0 1 1 1 1 0 0 0 0 0 5DC 36 0 1 DIST1 3F800000 0 0 1 1 FFFF 0 0 0 0 0 0";
	char bad[sizeof(good) + 1];
	struct cola_scan got;

	(void)state;
	assert_int_equal(cola_scan_read(COLA_A, (const uint8_t *)good, sizeof(good) - 1, &got), 0);
	const size_t at = (size_t)(strstr(good, "FFFF") - good);
	memcpy(bad, good, at);
	bad[at] = '1';
	memcpy(bad + at + 1, good + at, sizeof(good) - at);
	assert_int_equal(cola_scan_read(COLA_A, (const uint8_t *)bad, sizeof(bad) - 1, &got), -EINVAL);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(everything_at_once_is_read_as_written),
	    cmocka_unit_test(every_choice_of_parts_is_read_as_written),
	    cmocka_unit_test(every_shorter_payload_is_refused),
	    cmocka_unit_test(bytes_behind_the_last_field_are_not_understood),
	    cmocka_unit_test(counts_beyond_what_is_documented_are_refused),
	    cmocka_unit_test(a_flag_is_0_or_1),
	    cmocka_unit_test(other_names_are_other_telegrams),
	    cmocka_unit_test(a_value_too_wide_for_its_channel_is_refused),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

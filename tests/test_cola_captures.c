/* Law: what real scanners sent decodes to the values that were read from it by hand, however it was cut into reads, and
 * its stamps and counters show how well each device keeps time. */
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
#include "drivers/cola.h"
#include "drivers/cola_scan.h"
#include "tests/captures.h"

#define SCANS_MAX 200

/* What the notes beside the captures say of them. */
static const struct expected {
	const char *file, *driver;
	uint64_t telegrams, profiles, duplicates, errors; /* errors: sFA */
	uint16_t n;
	uint32_t serial;
	int32_t start_tdeg, step_tdeg;
	uint32_t frequency_chz;
	int encoders;
	int rssi_bytes;   /* 0: none */
	const char *name; /* NULL: none */
	bool has_time;
	double step_deg;
	uint32_t sending_us[2];             /* t_transmit - t_startup */
	double median_ms[2], highest_ms[2]; /* of arrivals behind the least delayed one, those of duplicates too */
} expected[] = {
    {.file = "cola_a/tim561_stream.bin",
     .driver = "tim",
     .telegrams = 25,
     .profiles = 24,
     .n = 811,
     .serial = 0xE5A5AD,
     .start_tdeg = -450000,
     .step_tdeg = 3333,
     .step_deg = 1 / 3.0,
     .frequency_chz = 1500,
     .name = "not defined",
     .sending_us = {4200, 4850}},
    {.file = "cola_a/tim571_name_sRA.bin",
     .driver = "tim",
     .telegrams = 1,
     .profiles = 1,
     .n = 811,
     .serial = 0x10A719E,
     .start_tdeg = -450000,
     .step_tdeg = 3333,
     .step_deg = 1 / 3.0,
     .frequency_chz = 1500,
     .name = "not defined",
     .sending_us = {7050, 7150}},
    {.file = "cola_a/lms5xx_encoder_rssi8_name_time_sRA.bin",
     .driver = "lms5xx",
     .telegrams = 1,
     .profiles = 1,
     .n = 570,
     .serial = 0x1160456,
     .start_tdeg = -48333,
     .step_tdeg = 3333,
     .step_deg = 1 / 3.0,
     .frequency_chz = 5000,
     .encoders = 1,
     .rssi_bytes = 1,
     .name = "SN 18220118",
     .has_time = true,
     .sending_us = {22150, 22250}},
    {.file = "cola_b/lms111_20210302.txt",
     .driver = "lms1xx",
     .telegrams = 228,
     .profiles = 172,
     .duplicates = 3,
     .n = 541,
     .serial = 0x114097A,
     .start_tdeg = -450000,
     .step_tdeg = 5000,
     .step_deg = 0.5,
     .frequency_chz = 5000,
     .has_time = true,
     .sending_us = {3065, 3275},
     .median_ms = {0.07, 0.09},
     .highest_ms = {2.9, 3.1}},
    {.file = "cola_b/lms511_20210301.txt",
     .driver = "lms5xx",
     .telegrams = 210,
     .profiles = 136,
     .errors = 18,
     .n = 1141,
     .serial = 0x1145856,
     .start_tdeg = -50000,
     .step_tdeg = 1667,
     .step_deg = 1 / 6.0,
     .frequency_chz = 2500,
     .rssi_bytes = 1,
     .has_time = true,
     .sending_us = {40200, 41000},
     .median_ms = {0.09, 0.11},
     .highest_ms = {1.3, 1.4}},
    {.file = "cola_b/sick_scan_xd_test.pcapng",
     .driver = "tim",
     .telegrams = 16,
     .profiles = 16,
     .n = 811,
     .serial = 18480390,
     .start_tdeg = -450000,
     .step_tdeg = 3333,
     .step_deg = 1 / 3.0,
     .frequency_chz = 1500,
     .rssi_bytes = 2,
     .has_time = true,
     .sending_us = {6200, 7700},
     .median_ms = {0.09, 0.11},
     .highest_ms = {0.25, 0.28}},
};
enum { EXPECTED = sizeof(expected) / sizeof(expected[0]) };

/* How chunks are handed over. */
enum cut { AS_READ, BYTEWISE, RANDOM, GLUED };

struct rig {
	struct decoder *decoder;
	const struct expected *expected;
	struct capture capture;
	int64_t t_ns;
	size_t profiles, errors;
	uint64_t ranges, times;      /* hashes of all profiles */
	double behind_ms[SCANS_MAX]; /* arrival - transmission, less its least */
	size_t arrivals;
	uint32_t sending_us[2];
	uint16_t value[SCANS_MAX][PROFILE_BEAMS_MAX]; /* as read by hand from the bytes, without duplicates */
	size_t scans;
	int telegram_counter; /* of the last one */
	bool compare, with_encoder;
	size_t tilts;
	struct tilt tilt;
};

static uint64_t mix(uint64_t hash, const void *bytes, size_t len)
{
	for (size_t i = 0; i < len; i++)
		hash = (hash ^ ((const uint8_t *)bytes)[i]) * 0x100000001B3u;
	return hash;
}

static void check_profile(const struct rig *rig, const struct profile *p, const uint16_t *value)
{
	const struct expected *e = rig->expected;
	const int least = strcmp(e->driver, "tim") == 0 ? 16 : 1;

	assert_int_equal(p->n, e->n);
	assert_true(fabs(p->first_rad - (e->start_tdeg / 1e4 - 90) * TRIG_DEG) < 1e-9);
	assert_true(fabs(p->step_rad - e->step_deg * TRIG_DEG) < 1e-9);
	assert_true(fabs(p->beam_ns / (1e11 / e->frequency_chz * e->step_deg / 360) - 1) <
	            0.04); /* a TiM's mirror wanders */
	for (unsigned i = 0; i < p->n; i++) {
		assert_int_equal(p->state[i] == BEAM_OK, value[i] >= least);
		if (p->state[i] == BEAM_OK)
			assert_true(fabs((double)p->range_m[i] - value[i] * 0.001) < 1e-5);
	}
}

static void on_profile(void *ctx, int device, const struct profile *p)
{
	struct rig *rig = ctx;

	(void)device;
	if (rig->compare)
		check_profile(rig, p, rig->value[rig->profiles]);
	rig->profiles++;
	rig->ranges = mix(rig->ranges, p->range_m, sizeof(p->range_m[0]) * p->n);
	rig->ranges = mix(rig->ranges, p->state, p->n);
	rig->times = mix(rig->times, &p->t_ns, sizeof(p->t_ns));
}

static void on_tilt(void *ctx, int device, const struct tilt *tilt)
{
	struct rig *rig = ctx;

	(void)device;
	rig->tilts++;
	rig->tilt = *tilt;
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	struct rig *rig = ctx;
	struct cola_reader r;

	(void)device;
	assert_true(reply->len <= REPLY_MAX);
	if ((reply->kind & ~COLA_B_FLAG) != COLA_ERROR)
		return;
	cola_reader_init(&r, COLA_B, reply->payload, reply->len, "");
	assert_int_equal(cola_read_u(&r, 2), 3);
	assert_true(cola_reader_done(&r));
	rig->errors++;
}

static void feed(struct rig *rig, enum direction direction, int64_t t_ns, const uint8_t *bytes, size_t len)
{
	const struct record_sink sink = {.ctx = rig, .profile = on_profile, .tilt = on_tilt, .reply = on_reply};
	const struct record r = {.log_ns = t_ns, .t_ns = t_ns, .direction = direction, .bytes = bytes, .len = len};

	cola_decode(rig->decoder, &r, &sink);
}

static void restart(struct rig *rig)
{
	struct config_device config = {.encoder = {.set = rig->with_encoder, .scale = 0.001, .zero = -500, .sign = 1}};

	cola_decoder_destroy(rig->decoder);
	snprintf(config.driver, sizeof(config.driver), "%s", rig->expected->driver);
	rig->decoder = cola_decoder_create(&config, 0);
	assert_non_null(rig->decoder);
	rig->profiles = rig->errors = 0;
	rig->ranges = rig->times = 0;
	feed(rig, LINK_OPENED, 0, NULL, 0);
}

static uint64_t count(const struct rig *rig, const char *name)
{
	struct decoder_counters counters;

	cola_counters(rig->decoder, &counters);
	for (int i = 0; i < counters.n; i++) {
		if (strcmp(counters.counter[i].name, name) == 0)
			return counters.counter[i].count;
	}
	fail_msg("no counter %s", name);
	return 0;
}

/* The values of a scan by the offsets and the order of tokens in the notes, by nothing of the decoder's. */
static size_t values_by_hand(const uint8_t *telegram, size_t len, uint16_t *ret)
{
	if (telegram[1] == 2) {
		const size_t channel = 64 + 6u * telegram[61];
		const size_t n = (size_t)(telegram[channel + 19] << 8 | telegram[channel + 20]);
		for (size_t i = 0; i < n; i++)
			ret[i] = (uint16_t)(telegram[channel + 21 + 2 * i] << 8 | telegram[channel + 22 + 2 * i]);
		return n;
	}
	char *text = calloc(1, len + 1), *at;
	memcpy(text, telegram, len);
	at = strstr(text, "DIST1 ");
	for (int i = 0; i < 5; i++)
		at = strchr(at, ' ') + 1;
	const size_t n = strtoul(at, &at, 16);
	for (size_t i = 0; i < n; i++)
		ret[i] = (uint16_t)strtoul(at, &at, 16);
	free(text);
	return n;
}

static void check_scan(struct rig *rig, const struct cola_scan *s)
{
	const struct expected *e = rig->expected;
	const struct cola_channel *rssi = cola_scan_channel(s, "RSSI1");

	assert_int_equal(s->channels, e->rssi_bytes > 0 ? 2 : 1);
	assert_string_equal(s->channel[0].name, "DIST1");
	assert_int_equal(s->channel[0].bytes, 2);
	assert_int_equal(s->channel[0].n, e->n);
	assert_int_equal(s->channel[0].start_tdeg, e->start_tdeg);
	assert_int_equal(s->channel[0].step_tdeg, e->step_tdeg);
	assert_true(s->channel[0].scale == (float)1 && s->channel[0].offset == 0);
	assert_int_equal(rssi != NULL, e->rssi_bytes > 0);
	if (rssi != NULL) {
		assert_int_equal(rssi->bytes, e->rssi_bytes);
		assert_int_equal(rssi->n, e->n);
	}
	assert_int_equal(s->serial, e->serial);
	assert_int_equal(s->frequency_chz, e->frequency_chz);
	assert_int_equal(s->encoders, e->encoders);
	assert_int_equal(s->name != NULL, e->name != NULL);
	if (e->name != NULL) {
		assert_int_equal(s->name_len, strlen(e->name));
		assert_memory_equal(s->name, e->name, s->name_len);
	}
	assert_int_equal(s->has_time, e->has_time);
	assert_true(!s->has_time || s->year == 1970);
	assert_false(s->has_position || s->has_event || s->comment != NULL || s->monitored);
}

/* A telegram of the capture, framed by the scan function alone. */
static void note_telegram(struct rig *rig, const uint8_t *telegram, size_t telegram_len, int64_t t_ns)
{
	const uint8_t *payload;
	size_t len;
	struct cola_scan s;
	const enum cola_dialect dialect = cola_payload(telegram, telegram_len, &payload, &len);

	if (cola_scan_read(dialect, payload, len, &s) != 0)
		return;
	check_scan(rig, &s);
	const uint32_t sending_us = s.t_transmit_us - s.t_startup_us;
	if (rig->arrivals == 0)
		rig->sending_us[0] = rig->sending_us[1] = sending_us;
	rig->sending_us[0] = sending_us < rig->sending_us[0] ? sending_us : rig->sending_us[0];
	rig->sending_us[1] = sending_us > rig->sending_us[1] ? sending_us : rig->sending_us[1];
	assert_true(rig->arrivals < SCANS_MAX);
	rig->behind_ms[rig->arrivals] = (double)t_ns / 1e6 - s.t_transmit_us / 1e3;
	rig->arrivals++;
	if (s.telegram_counter == rig->telegram_counter)
		return;
	rig->telegram_counter = s.telegram_counter;
	assert_int_equal(values_by_hand(telegram, telegram_len, rig->value[rig->scans]), rig->expected->n);
	rig->scans++;
}

static void note_telegrams(struct rig *rig)
{
	static uint8_t all[1 << 20];
	size_t begin = 0, end = 0;

	rig->arrivals = rig->scans = 0;
	rig->telegram_counter = -1;
	for (size_t i = 0; i < rig->capture.n; i++) {
		const struct chunk *c = &rig->capture.chunk[i];
		if (c->to_device)
			continue;
		memcpy(all + end, c->bytes, c->len);
		end += c->len;
		while (begin < end) {
			const int r = cola_scan_frame(NULL, all + begin, end - begin, true);
			assert_true(r >= 0); /* nothing but telegrams */
			if (r == 0)
				break;
			note_telegram(rig, all + begin, (size_t)r, c->t_ns);
			begin += (size_t)r;
		}
	}
}

static void play_chunk(struct rig *rig, const struct chunk *c, enum cut cut, uint32_t *random)
{
	const enum direction direction = c->to_device ? TO_DEVICE : FROM_DEVICE;

	for (size_t at = 0; at < c->len;) {
		*random = *random * 1664525 + 1013904223;
		size_t len = cut == BYTEWISE ? 1 : cut == RANDOM ? 1 + (*random >> 16) % 2000 : c->len;
		len = len < c->len - at ? len : c->len - at;
		feed(rig, direction, c->t_ns, c->bytes + at, len);
		at += len;
	}
}

static void play(struct rig *rig, enum cut cut, uint32_t random)
{
	restart(rig);
	if (cut != GLUED) {
		for (size_t i = 0; i < rig->capture.n; i++)
			play_chunk(rig, &rig->capture.chunk[i], cut, &random);
		return;
	}
	uint8_t *all = malloc(rig->capture.from_device);
	size_t len = 0;
	for (size_t i = 0; i < rig->capture.n; i++) {
		const struct chunk *c = &rig->capture.chunk[i];
		if (!c->to_device) {
			memcpy(all + len, c->bytes, c->len);
			len += c->len;
		}
	}
	feed(rig, FROM_DEVICE, 1, all, len);
	free(all);
}

static void check_counts(const struct rig *rig)
{
	static const char *const none[] = {"check sum",     "bad start",     "too long",    "cut",
	                                   "garbage bytes", "malformed",     "implausible", "without ranges",
	                                   "scans lost",    "device errors", "tilts",       "too many beams"};
	const struct expected *e = rig->expected;

	assert_int_equal(rig->profiles, e->profiles);
	assert_int_equal(count(rig, "profiles"), e->profiles);
	assert_int_equal(count(rig, "duplicates"), e->duplicates);
	assert_int_equal(count(rig, "requests refused"), e->errors);
	assert_int_equal(rig->errors, e->errors);
	assert_int_equal(count(rig, "telegrams"), e->telegrams);
	for (size_t i = 0; i < sizeof(none) / sizeof(none[0]); i++)
		assert_int_equal(count(rig, none[i]), 0);
}

static int by_value(const void *a, const void *b)
{
	const double x = *(const double *)a, y = *(const double *)b;

	return (x > y) - (x < y);
}

static void check_jitter(struct rig *rig)
{
	const struct expected *e = rig->expected;
	struct decoder_timing timing;

	assert_in_range(rig->sending_us[0], e->sending_us[0], e->sending_us[1]);
	assert_in_range(rig->sending_us[1], e->sending_us[0], e->sending_us[1]);
	qsort(rig->behind_ms, rig->arrivals, sizeof(double), by_value);
	const double median = rig->behind_ms[rig->arrivals / 2] - rig->behind_ms[0];
	const double highest = rig->behind_ms[rig->arrivals - 1] - rig->behind_ms[0];
	cola_timing(rig->decoder, &timing);
	if (e->highest_ms[1] > 0) {
		assert_true(median >= e->median_ms[0] && median <= e->median_ms[1]);
		assert_true(highest >= e->highest_ms[0] && highest <= e->highest_ms[1]);
		assert_true(timing.jitter_p50_ns < 500000 && timing.expected_hz == e->frequency_chz / 100.0);
		printf("note: %s: %zu scans, stamp to sending %.2f-%.2f ms, arrival jitter median %.2f max %.2f ms, "
		       "behind the clock filter p50 %.2f p99 %.2f ms\n",
		       e->file, rig->arrivals, rig->sending_us[0] / 1e3, rig->sending_us[1] / 1e3, median, highest,
		       (double)timing.jitter_p50_ns / 1e6, (double)timing.jitter_p99_ns / 1e6);
	} else {
		printf("note: %s: %zu scans, stamp to sending %.2f-%.2f ms\n", e->file, rig->arrivals,
		       rig->sending_us[0] / 1e3, rig->sending_us[1] / 1e3);
	}
}

/* Every place where a read may end inside the telegram at `at`. */
static void check_every_cut(struct rig *rig, const uint8_t *telegram, size_t len)
{
	play_chunk(rig, &(struct chunk){.bytes = (uint8_t *)(uintptr_t)telegram, .len = len}, AS_READ, &(uint32_t){0});
	const uint64_t telegrams = count(rig, "telegrams");
	assert_int_equal(telegrams, 1);
	rig->ranges = 0;
	feed(rig, LINK_OPENED, 0, NULL, 0);
	feed(rig, FROM_DEVICE, 0, telegram, len);
	const uint64_t whole = rig->ranges;
	for (size_t cut = 1; cut < len; cut++) {
		rig->ranges = 0;
		feed(rig, LINK_OPENED, 0, NULL, 0);
		feed(rig, FROM_DEVICE, 0, telegram, cut);
		assert_int_equal(count(rig, "telegrams"), telegrams + cut);
		feed(rig, FROM_DEVICE, 0, telegram + cut, len - cut);
		assert_int_equal(rig->ranges, whole);
	}
	assert_int_equal(count(rig, "telegrams"), telegrams + len);
	assert_int_equal(count(rig, "garbage bytes"), 0);
}

static void each_capture_decodes_to_what_was_read_by_hand(void **state)
{
	struct rig *rig = *state;

	for (int i = 0; i < EXPECTED; i++) {
		rig->expected = &expected[i];
		assert_true(capture_load(&rig->capture, expected[i].file));
		note_telegrams(rig);
		assert_int_equal(rig->arrivals, expected[i].profiles + expected[i].duplicates);
		assert_int_equal(rig->scans, expected[i].profiles);
		rig->compare = true;
		play(rig, AS_READ, 0);
		rig->compare = false;
		check_counts(rig);
		check_jitter(rig);
		capture_free(&rig->capture);
	}
}

static void however_it_is_cut_it_is_the_same(void **state)
{
	struct rig *rig = *state;

	for (int i = 0; i < EXPECTED; i++) {
		rig->expected = &expected[i];
		assert_true(capture_load(&rig->capture, expected[i].file));
		play(rig, AS_READ, 0);
		const uint64_t ranges = rig->ranges, times = rig->times;
		play(rig, GLUED, 0);
		check_counts(rig);
		assert_int_equal(rig->ranges, ranges);
		play(rig, BYTEWISE, 0);
		check_counts(rig);
		assert_int_equal(rig->ranges, ranges);
		assert_int_equal(rig->times, times);
		for (uint32_t seed = 1; seed <= 5; seed++) {
			play(rig, RANDOM, seed);
			check_counts(rig);
			assert_int_equal(rig->ranges, ranges);
			assert_int_equal(rig->times, times);
		}
		capture_free(&rig->capture);
	}
}

static void a_telegram_is_the_same_wherever_a_read_ends(void **state)
{
	struct rig *rig = *state;

	for (int i = 0; i < EXPECTED; i++) {
		rig->expected = &expected[i];
		assert_true(capture_load(&rig->capture, expected[i].file));
		/* The first, the middle and the last one of a whole capture; segments are put together first. */
		static uint8_t all[1 << 20];
		size_t len = 0, at = 0, n = 0;
		for (size_t k = 0; k < rig->capture.n; k++) {
			if (!rig->capture.chunk[k].to_device)
				memcpy(all + len, rig->capture.chunk[k].bytes, rig->capture.chunk[k].len);
			len += rig->capture.chunk[k].to_device ? 0 : rig->capture.chunk[k].len;
		}
		for (int r; (r = cola_scan_frame(NULL, all + at, len - at, true)) > 0; at += (size_t)r, n++) {
			if (at + (size_t)r >= len || n % 40 == 1 || (n < 60 && r < 100)) {
				restart(rig);
				check_every_cut(rig, all + at, (size_t)r);
			}
			if (at + (size_t)r == len)
				break;
		}
		assert_true(n >= expected[i].profiles - 1);
		capture_free(&rig->capture);
	}
}

static void a_capture_cut_short_ends_in_a_begun_telegram(void **state)
{
	struct rig *rig = *state;

	rig->expected = &expected[0]; /* 24 whole ones and a beginning */
	assert_true(capture_load(&rig->capture, expected[0].file));
	play(rig, AS_READ, 0);
	assert_int_equal(count(rig, "cut"), 0);
	feed(rig, LINK_OPENED, 0, NULL, 0);
	assert_int_equal(count(rig, "cut"), 1);
	assert_int_equal(count(rig, "garbage bytes"), 3000);
	capture_free(&rig->capture);
}

static void the_encoder_of_the_lms5xx_is_a_tilt(void **state)
{
	struct rig *rig = *state;

	rig->expected = &expected[2];
	rig->with_encoder = true;
	assert_true(capture_load(&rig->capture, expected[2].file));
	play(rig, AS_READ, 0);
	rig->with_encoder = false;
	assert_int_equal(rig->tilts, 1);
	assert_true(fabs(rig->tilt.angle_rad - 0.5) < 1e-12); /* it stands at tick 0 */
	capture_free(&rig->capture);
}

static void the_clock_of_the_lms5xx_is_read_to_the_microsecond(void **state)
{
	struct capture c;
	struct cola_scan s;
	const uint8_t *payload;
	size_t len;

	(void)state;
	assert_true(capture_load(&c, expected[2].file));
	const int r = cola_scan_frame(NULL, c.chunk[0].bytes, c.chunk[0].len, true);
	assert_true(r > 0);
	cola_payload(c.chunk[0].bytes, (size_t)r, &payload, &len);
	assert_int_equal(cola_scan_read(COLA_A, payload, len, &s), 0);
	const uint8_t time[] = {s.month, s.day, s.hour, s.minute, s.second};
	assert_memory_equal(time, ((const uint8_t[]){1, 1, 8, 36, 22}), sizeof(time));
	assert_int_equal(s.microsecond, 364000);
	capture_free(&c);
}

int main(void)
{
	static struct rig rig;
	void *state = &rig;
	struct capture probe;

	for (int i = 0; i < EXPECTED; i++) {
		if (!capture_load(&probe, expected[i].file)) {
			printf("the captures are not here: " CAPTURES "%s\n", expected[i].file);
			return 77;
		}
		capture_free(&probe);
	}
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test_prestate(each_capture_decodes_to_what_was_read_by_hand, state),
	    cmocka_unit_test_prestate(however_it_is_cut_it_is_the_same, state),
	    cmocka_unit_test_prestate(a_telegram_is_the_same_wherever_a_read_ends, state),
	    cmocka_unit_test_prestate(a_capture_cut_short_ends_in_a_begun_telegram, state),
	    cmocka_unit_test_prestate(the_encoder_of_the_lms5xx_is_a_tilt, state),
	    cmocka_unit_test(the_clock_of_the_lms5xx_is_read_to_the_microsecond),
	};
	const int failed = cmocka_run_group_tests(tests, NULL, NULL);
	cola_decoder_destroy(rig.decoder);
	return failed;
}

/* Law: the CoLa decoder turns telegrams of either dialect into profiles with true ranges, bearings and times, guesses
 * nothing, counts what it drops, and goes on from a snapshot as if nothing had happened. */
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
#include "tests/cola_telegrams.h"

#define MS 1000000ll

struct rig {
	struct decoder *decoder;
	struct config_device config;
	enum cola_dialect dialect;
	int64_t t_ns;
	int profiles, tilts, replies, last_kind;
	size_t last_len;
	bool tilt_came_first;
	struct profile last;
	struct tilt tilt;
};

static void on_profile(void *ctx, int device, const struct profile *p)
{
	struct rig *rig = ctx;

	assert_int_equal(device, 5);
	rig->profiles++;
	rig->last = *p;
}

static void on_tilt(void *ctx, int device, const struct tilt *tilt)
{
	struct rig *rig = ctx;

	assert_int_equal(device, 5);
	rig->tilt_came_first = rig->tilts == rig->profiles;
	rig->tilts++;
	rig->tilt = *tilt;
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	struct rig *rig = ctx;

	assert_int_equal(device, 5);
	rig->replies++;
	rig->last_kind = reply->kind;
	rig->last_len = reply->len;
	assert_int_equal(reply->payload[0], 's');
}

static void feed(struct rig *rig, enum direction direction, const uint8_t *bytes, size_t len)
{
	const struct record_sink sink = {.ctx = rig, .profile = on_profile, .tilt = on_tilt, .reply = on_reply};
	const struct record r = {
	    .log_ns = rig->t_ns, .t_ns = rig->t_ns, .device = 5, .direction = direction, .bytes = bytes, .len = len};

	cola_decode(rig->decoder, &r, &sink);
}

static void open_as(struct rig *rig, const char *driver)
{
	cola_decoder_destroy(rig->decoder);
	snprintf(rig->config.driver, sizeof(rig->config.driver), "%s", driver);
	rig->decoder = cola_decoder_create(&rig->config, 5);
	assert_non_null(rig->decoder);
	rig->profiles = rig->tilts = rig->replies = 0;
	feed(rig, LINK_OPENED, NULL, 0);
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

static uint8_t frame[COLA_TELEGRAM_MAX];

static void feed_scan(struct rig *rig, const struct cola_scan *s, unsigned base, unsigned rise)
{
	const size_t len = telegram_scan(rig->dialect, "sSN LMDscandata", s, base, rise, frame, sizeof(frame));

	assert_true(len > 0);
	feed(rig, FROM_DEVICE, frame, len);
}

/* Time goes on by `scans` scans. */
static void next_scan(struct rig *rig, struct cola_scan *s, int scans)
{
	s->telegram_counter++;
	s->scan_counter = (uint16_t)(s->scan_counter + scans);
	s->t_startup_us += 66667u * (unsigned)scans;
	s->t_transmit_us += 66667u * (unsigned)scans;
	rig->t_ns += 66667000ll * scans;
}

static void feed_words(struct rig *rig, const char *words)
{
	struct cola_writer w;

	cola_writer_init(&w, rig->dialect, frame, sizeof(frame), words);
	feed(rig, FROM_DEVICE, frame, cola_writer_end(&w));
}

static void tell_model(struct rig *rig, const char *name)
{
	struct cola_writer w;

	cola_writer_init(&w, rig->dialect, frame, sizeof(frame), "sRA DeviceIdent");
	cola_write_string(&w, name, strlen(name), 2);
	cola_write_string(&w, "V1.0", 4, 2);
	feed(rig, FROM_DEVICE, frame, cola_writer_end(&w));
}

static int setup(void **state)
{
	struct rig *rig = calloc(1, sizeof(*rig));

	rig->t_ns = 5000 * MS;
	*state = rig;
	open_as(rig, "tim");
	return 0;
}

static int teardown(void **state)
{
	struct rig *rig = *state;

	cola_decoder_destroy(rig->decoder);
	free(rig);
	return 0;
}

static void ranges_are_scaled_millimetres_at_sick_bearings_turned(void **state)
{
	struct rig *rig = *state;
	struct cola_scan s = telegram_tim();

	for (int dialect = COLA_A; dialect <= COLA_B; dialect++) {
		rig->dialect = (enum cola_dialect)dialect;
		s.channel[0].scale = 2;
		s.channel[0].offset = -10;
		next_scan(rig, &s, 1);
		feed_scan(rig, &s, 1000, 3);
		assert_int_equal(rig->profiles, dialect + 1);
		assert_int_equal(rig->last.n, 271);
		assert_int_equal(rig->last.interlace, 1);
		assert_int_equal(rig->last.parts, 1);
		for (int i = 0; i < 271; i++) {
			assert_int_equal(rig->last.state[i], BEAM_OK);
			assert_true(fabs((double)rig->last.range_m[i] - (1.990 + 0.006 * i)) < 1e-6);
		}
		assert_true(fabs(rig->last.first_rad + 135 * TRIG_DEG) < 1e-12);
		assert_true(fabs(rig->last.step_rad - TRIG_DEG) < 1e-12);
	}
}

static void steps_cut_by_the_telegram_are_thirds_and_sixths(void **state)
{
	static const struct {
		int32_t tdeg;
		double deg;
	} cases[] = {{3333, 1 / 3.0}, {6667, 2 / 3.0}, {1667, 1 / 6.0}, {1666, 1 / 6.0}, {833, 1 / 12.0},
	             {5000, 0.5},     {2500, 0.25},    {1000, 0.1},     {10000, 1},      {30000, 3},
	             {1250, 0.125},   {3300, 0.33},    {1, 0.0001}};
	struct rig *rig = *state;
	struct cola_scan s = telegram_tim();

	for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
		s.channel[0].step_tdeg = cases[i].tdeg;
		s.channel[0].n = 100;
		next_scan(rig, &s, 1);
		feed_scan(rig, &s, 1000, 0);
		assert_true(fabs(rig->last.step_rad - cases[i].deg * TRIG_DEG) < 1e-12);
	}
}

static void codes_become_states_by_the_family(void **state)
{
	struct rig *rig = *state;
	const struct cola_scan s = telegram_tim();

	feed_scan(rig, &s, 0, 1);
	assert_int_equal(rig->last.state[0], BEAM_NO_ECHO);
	assert_int_equal(rig->last.state[1], BEAM_DAZZLED);
	assert_int_equal(rig->last.state[2], BEAM_NO_ECHO);
	for (int i = 3; i < 16; i++)
		assert_int_equal(rig->last.state[i], BEAM_RESERVED);
	for (int i = 0; i < 16; i++)
		assert_true(rig->last.range_m[i] == 0);
	assert_int_equal(rig->last.state[16], BEAM_OK);
	assert_true(fabs((double)rig->last.range_m[16] - 0.016) < 1e-9);
	static const char *const others[] = {"lms1xx", "lms5xx"};
	for (int i = 0; i < 2; i++) {
		open_as(rig, others[i]);
		feed_scan(rig, &s, 0, 1);
		assert_int_equal(rig->last.state[0], BEAM_NO_ECHO);
		assert_int_equal(rig->last.state[1], BEAM_OK);
	}
}

static void the_first_beam_is_dated_by_what_the_stamp_marks(void **state)
{
	struct rig *rig = *state;
	const struct cola_scan s = telegram_tim(); /* transmitted 4 ms after the stamp, 15 Hz, 270 degrees */
	const int64_t stamp_ns = rig->t_ns - 4 * MS, sweep_ns = 50 * MS;

	feed_scan(rig, &s, 1000, 0);
	assert_true(llabs(rig->last.t_ns - (stamp_ns - sweep_ns)) < 1000);
	assert_true(llabs(rig->last.beam_ns - 185185) <= 1);
	assert_true(llabs(rig->last.turn_ns - 66666667) <= 1);
	open_as(rig, "lms1xx");
	feed_scan(rig, &s, 1000, 0);
	assert_true(llabs(rig->last.t_ns - (stamp_ns - sweep_ns)) < 1000);
	open_as(rig, "lms5xx");
	feed_scan(rig, &s, 1000, 0);
	assert_true(llabs(rig->last.t_ns - stamp_ns) < 1000);
	rig->config.stamp = STAMP_END;
	rig->config.latency_ns = 7 * MS;
	open_as(rig, "lms5xx");
	feed_scan(rig, &s, 1000, 0);
	assert_true(llabs(rig->last.t_ns - (stamp_ns - sweep_ns - 7 * MS)) < 1000);
	rig->config.stamp = STAMP_START;
	rig->config.latency_ns = -7 * MS;
	open_as(rig, "tim");
	feed_scan(rig, &s, 1000, 0);
	assert_true(llabs(rig->last.t_ns - (stamp_ns + 7 * MS)) < 1000);
}

static void a_model_that_names_itself_is_believed_until_the_link_is_opened_anew(void **state)
{
	struct rig *rig = *state;
	struct cola_scan s = telegram_tim();

	for (int dialect = COLA_A; dialect <= COLA_B; dialect++) {
		rig->dialect = (enum cola_dialect)dialect;
		open_as(rig, "lms5xx");
		tell_model(rig, "TiM571-2050101");
		feed_scan(rig, &s, 0, 1);
		assert_true(llabs(rig->last.t_ns - (rig->t_ns - 54 * MS)) < 1000);
		assert_int_equal(rig->last.state[1], BEAM_DAZZLED);
		tell_model(rig, "XYZ");
		next_scan(rig, &s, 1);
		feed_scan(rig, &s, 0, 1);
		assert_true(llabs(rig->last.t_ns - (rig->t_ns - 4 * MS)) < 1000);
		tell_model(rig, "LMS10x_FieldEval");
		feed(rig, LINK_OPENED, NULL, 0);
		next_scan(rig, &s, 1);
		feed_scan(rig, &s, 0, 1);
		assert_true(llabs(rig->last.t_ns - (rig->t_ns - 4 * MS)) < 1000);
	}
	rig->dialect = COLA_A;
	open_as(rig, "lms5xx");
	feed_words(rig, "sRA 0 6 TiM561 E V2.51-21.08.15");
	feed_scan(rig, &s, 0, 1);
	assert_true(llabs(rig->last.t_ns - (rig->t_ns - 54 * MS)) < 1000);
}

static void a_late_arrival_does_not_move_the_scan(void **state)
{
	struct rig *rig = *state;
	struct cola_scan s = telegram_tim();
	int64_t first_ns = 0;

	s.t_startup_us = UINT32_MAX - 300000; /* the microseconds start again within */
	s.t_transmit_us = s.t_startup_us + 4000;
	for (int i = 0; i < 100; i++) {
		const int64_t delay_ns = i % 7 == 3 ? 20 * MS : 0;
		rig->t_ns += delay_ns;
		feed_scan(rig, &s, 1000, 0);
		rig->t_ns -= delay_ns;
		if (i == 0)
			first_ns = rig->last.t_ns;
		assert_true(llabs(rig->last.t_ns - first_ns - 66667000ll * i) < 100000);
		next_scan(rig, &s, 1);
	}
	struct decoder_timing timing;
	cola_timing(rig->decoder, &timing);
	assert_true(timing.known && timing.stamps);
	assert_true(timing.expected_hz == 15);
	assert_true(timing.jitter_p50_ns < MS && timing.jitter_p99_ns > 19 * MS);
	assert_true(fabs(timing.drift_ppm) < 50);
	assert_int_equal(timing.lost, 0);
}

static void gaps_in_the_count_of_scans_are_lost_scans(void **state)
{
	struct rig *rig = *state;
	struct cola_scan s = telegram_tim();
	struct decoder_timing timing;

	s.scan_counter = 65530; /* it wraps */
	feed_scan(rig, &s, 1000, 0);
	static const int steps[] = {1, 1, 3, 1, 1, 5, 1, 1, 1};
	for (size_t i = 0; i < sizeof(steps) / sizeof(steps[0]); i++) {
		next_scan(rig, &s, steps[i]);
		feed_scan(rig, &s, 1000, 0);
	}
	assert_int_equal(count(rig, "scans lost"), 2 + 4);
	s.scan_counter = 3; /* it was switched on again */
	next_scan(rig, &s, 1);
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(count(rig, "scans lost"), 6);
	cola_timing(rig->decoder, &timing);
	assert_int_equal(timing.lost, 6);
	assert_int_equal(rig->profiles, 11);
}

static void every_nth_scan_is_no_loss_and_the_first_gap_is_told_in_hindsight(void **state)
{
	struct rig *rig = *state;
	struct cola_scan s = telegram_tim();
	struct decoder_timing timing;

	rig->config.every = 5;
	open_as(rig, "tim");
	cola_timing(rig->decoder, &timing);
	assert_true(timing.expected_hz == 3 && !timing.stamps);
	feed_scan(rig, &s, 1000, 0);
	next_scan(rig, &s, 15);
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(count(rig, "scans lost"), 0);
	for (int i = 0; i < 4; i++) {
		next_scan(rig, &s, i == 2 ? 10 : 5);
		feed_scan(rig, &s, 1000, 0);
	}
	assert_int_equal(count(rig, "scans lost"), 2 + 1);
	cola_timing(rig->decoder, &timing);
	assert_true(timing.expected_hz == 3);
	/* The stream is set up anew, for every scan: what came between was not meant to come. */
	for (int dialect = COLA_A; dialect <= COLA_B; dialect++) {
		rig->dialect = (enum cola_dialect)dialect;
		feed_words(rig, "sWA LMDscandatacfg");
		next_scan(rig, &s, 100);
		feed_scan(rig, &s, 1000, 0);
		next_scan(rig, &s, 1);
		feed_scan(rig, &s, 1000, 0);
		feed(rig, LINK_OPENED, NULL, 0);
		next_scan(rig, &s, 1000);
		feed_scan(rig, &s, 1000, 0);
	}
	assert_int_equal(count(rig, "scans lost"), 3);
}

static void a_telegram_sent_twice_is_one_profile(void **state)
{
	struct rig *rig = *state;
	struct cola_scan s = telegram_tim();

	feed_scan(rig, &s, 1000, 0);
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(rig->profiles, 1);
	assert_int_equal(count(rig, "duplicates"), 1);
	feed_words(rig, "sEA LFErec"); /* an answer between the two changes nothing */
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(rig->profiles, 1);
	assert_int_equal(count(rig, "duplicates"), 2);
	s.t_transmit_us++; /* some models do not count, but stamp */
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(rig->profiles, 2);
	feed(rig, LINK_OPENED, NULL, 0);
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(rig->profiles, 3);
}

static void remission_is_kept_where_the_device_sends_as_much_of_it(void **state)
{
	struct rig *rig = *state;
	struct cola_scan s = telegram_tim();

	feed_scan(rig, &s, 1000, 1);
	assert_false(rig->last.has_remission);
	s.channels = 2;
	s.channel[1] = s.channel[0];
	memcpy(s.channel[1].name, "RSSI1", 5);
	next_scan(rig, &s, 1);
	feed_scan(rig, &s, 1000, 1);
	assert_true(rig->last.has_remission);
	assert_true(rig->last.remission[270] > rig->last.remission[0]);
	s.channel[1].n = 100;
	next_scan(rig, &s, 1);
	feed_scan(rig, &s, 1000, 1);
	assert_int_equal(rig->profiles, 3);
	assert_false(rig->last.has_remission);
}

static void what_cannot_be_a_profile_is_counted_and_dropped(void **state)
{
	struct rig *rig = *state;
	struct cola_scan s = telegram_tim();

	s.channel[0].n = PROFILE_BEAMS_MAX;
	s.channel[0].step_tdeg = 1000;
	feed_scan(rig, &s, 1000, 1);
	assert_int_equal(rig->profiles, 1);
	next_scan(rig, &s, 1);
	s.channel[0].n++;
	feed_scan(rig, &s, 1000, 1);
	assert_int_equal(count(rig, "too many beams"), 1);
	s = telegram_tim();
	s.channels = 0;
	feed_scan(rig, &s, 1000, 1);
	memcpy(s.channel[0].name, "RSSI1", 5);
	s.channels = 1;
	next_scan(rig, &s, 1);
	feed_scan(rig, &s, 1000, 1);
	s = telegram_tim();
	s.channel[0].n = 0;
	next_scan(rig, &s, 3);
	feed_scan(rig, &s, 1000, 1);
	assert_int_equal(count(rig, "without ranges"), 3);
	for (int i = 0; i < 6; i++) {
		struct cola_scan odd = telegram_tim();
		struct cola_channel *c = &odd.channel[0];
		*(i == 0 ? &c->scale : &(float){0}) = 0;
		*(i == 1 ? &c->scale : &(float){0}) = -1;
		*(i == 2 ? &c->scale : &(float){0}) = 1e30f;
		*(i == 3 ? &c->offset : &(float){0}) = 1e30f;
		*(i == 4 ? &c->step_tdeg : &(int32_t){0}) = 0;
		*(i == 5 ? &c->start_tdeg : &(int32_t){0}) = INT32_MIN;
		next_scan(rig, &s, 1);
		odd.t_transmit_us = s.t_transmit_us;
		odd.t_startup_us = s.t_startup_us;
		feed_scan(rig, &odd, 1000, 1);
		assert_int_equal(count(rig, "malformed"), i + 1);
	}
	feed_words(rig, "sSN LMDscandata 1 1");
	assert_int_equal(count(rig, "malformed"), 7);
	assert_int_equal(rig->profiles, 1);
	assert_int_equal(rig->replies, 12); /* and each is a telegram for whoever waits for one */
}

static void a_rate_or_stamp_beyond_belief_is_counted_and_the_last_one_kept(void **state)
{
	struct rig *rig = *state;
	struct cola_scan s = telegram_tim();

	s.frequency_chz = 0;
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(rig->last.turn_ns, 66666667); /* what a TiM does */
	s.frequency_chz = 5000;
	next_scan(rig, &s, 1);
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(rig->last.turn_ns, 20000000);
	s.frequency_chz = 60001;
	next_scan(rig, &s, 1);
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(rig->last.turn_ns, 20000000);
	assert_int_equal(count(rig, "implausible"), 2);
	s.frequency_chz = 1500;
	s.t_startup_us = s.t_transmit_us - 2000000; /* dated by its transmission then */
	next_scan(rig, &s, 1);
	feed_scan(rig, &s, 1000, 0);
	assert_true(llabs(rig->last.t_ns - (rig->t_ns - 50 * MS)) < 100000);
	s.t_startup_us = s.t_transmit_us + 1;
	next_scan(rig, &s, 1);
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(count(rig, "implausible"), 4);
	assert_int_equal(rig->profiles, 5);
}

static void encoder_ticks_are_the_tilt_when_the_scan_was_stamped(void **state)
{
	struct rig *rig = *state;
	struct cola_scan s = telegram_tim();

	s.encoders = 1;
	s.encoder[0].ticks = 1100;
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(rig->tilts, 0); /* nobody asked */
	rig->config.encoder.set = true;
	rig->config.encoder.scale = 0.001;
	rig->config.encoder.zero = 1000;
	rig->config.encoder.sign = -1;
	open_as(rig, "lms1xx");
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(rig->tilts, 1);
	assert_true(rig->tilt_came_first);
	assert_true(fabs(rig->tilt.angle_rad + 0.1) < 1e-12);
	const int64_t sweep_ns = (int64_t)(rig->last.n - 1) * rig->last.beam_ns; /* the beam's time is rounded */
	assert_true(llabs(rig->tilt.t_ns - (rig->last.t_ns + sweep_ns)) < rig->last.n);
	rig->config.stamp = STAMP_START;
	rig->config.latency_ns = 3 * MS;
	open_as(rig, "lms1xx");
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(rig->tilt.t_ns, rig->last.t_ns);
	static const struct {
		uint32_t ticks;
		double wrap, angle;
	} cases[] = {{900, 0, 0.1},       {UINT32_MAX, 0, 1.001}, {0, 0, 1},           {0, 4096, 1},
	             {3900, 4096, 1.196}, {3048, 4096, 2.048},    {3047, 4096, -2.047}};
	for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
		rig->config.encoder.wrap = cases[i].wrap;
		open_as(rig, "lms1xx");
		s.encoder[0].ticks = cases[i].ticks;
		feed_scan(rig, &s, 1000, 0);
		assert_true(fabs(rig->tilt.angle_rad - cases[i].angle) < 1e-12);
	}
	s.encoders = 0;
	next_scan(rig, &s, 1);
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(rig->tilts, 1);
	assert_int_equal(rig->profiles, 2);
}

static void answers_go_to_the_dialogue_with_their_dialect(void **state)
{
	struct rig *rig = *state;

	feed_words(rig, "sWA EIHstCola");
	assert_int_equal(rig->last_kind, COLA_WRITTEN);
	assert_int_equal(rig->last_len, 13);
	rig->dialect = COLA_B;
	feed_words(rig, "sMA mEEwriteall ");
	assert_int_equal(rig->last_kind, COLA_LATER | COLA_B_FLAG);
	static const uint8_t unknown[] = {2, 2, 2, 2, 0, 0, 0, 5, 's', 'F', 'A', 0, 3, 0x77};
	feed(rig, FROM_DEVICE, unknown, sizeof(unknown));
	assert_int_equal(rig->last_kind, COLA_ERROR | COLA_B_FLAG);
	assert_int_equal(count(rig, "requests refused"), 1);
	feed(rig, TO_DEVICE, unknown, sizeof(unknown));
	assert_int_equal(rig->replies, 3);
	struct cola_scan s = telegram_tim();
	feed_scan(rig, &s, 1000, 0); /* a telegram longer than a reply may be: its beginning */
	s.channel[0].n = 2000;
	s.channel[0].step_tdeg = 1000;
	next_scan(rig, &s, 1);
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(rig->last_kind, COLA_DATA | COLA_B_FLAG);
	assert_int_equal(rig->last_len, REPLY_MAX);
	assert_int_equal(count(rig, "telegrams"), 5);
}

static void errors_of_the_device_and_of_the_wire_are_counted(void **state)
{
	struct rig *rig = *state;
	struct cola_scan s = telegram_tim();

	rig->dialect = COLA_B;
	s.status[0] = 1; /* LMS111 while it starts */
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(count(rig, "device errors"), 0);
	s.status[1] = 1;
	next_scan(rig, &s, 1);
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(count(rig, "device errors"), 1);
	next_scan(rig, &s, 1);
	const size_t len = telegram_scan(COLA_B, "sSN LMDscandata", &s, 1, 1, frame, sizeof(frame));
	frame[len - 1] ^= 1;
	feed(rig, FROM_DEVICE, frame, len);
	assert_int_equal(count(rig, "check sum"), 1);
	assert_true(count(rig, "garbage bytes") > 100);
	next_scan(rig, &s, 1);
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(rig->profiles, 3);
	assert_int_equal(count(rig, "scans lost"), 1);
	feed(rig, FROM_DEVICE, frame, 40);
	feed(rig, LINK_OPENED, NULL, 0);
	assert_int_equal(count(rig, "cut"), 1);
	next_scan(rig, &s, 1);
	feed_scan(rig, &s, 1000, 0);
	assert_int_equal(rig->profiles, 4);
}

static void a_snapshot_goes_on_in_mid_telegram_and_a_broken_one_is_as_new(void **state)
{
	static uint8_t snapshot[200000];
	struct rig *rig = *state;
	struct rig other = {.config = rig->config};
	struct cola_scan s = telegram_tim();
	struct state st;

	rig->dialect = COLA_B;
	tell_model(rig, "LMS511");
	for (int i = 0; i < 40; i++) {
		rig->t_ns += i % 5 * MS;
		feed_scan(rig, &s, 1000, 0);
		rig->t_ns -= i % 5 * MS;
		next_scan(rig, &s, i % 9 == 8 ? 2 : 1);
	}
	const size_t len = telegram_scan(COLA_B, "sSN LMDscandata", &s, 1000, 1, frame, sizeof(frame));
	feed(rig, FROM_DEVICE, frame, 333);
	state_save(&st, snapshot, sizeof(snapshot));
	cola_decoder_state(rig->decoder, &st);
	assert_true(state_done(&st));
	const size_t size = st.at;

	open_as(&other, "tim");
	other.t_ns = rig->t_ns;
	state_load(&st, snapshot, size);
	cola_decoder_state(other.decoder, &st);
	assert_true(state_done(&st));
	struct decoder_counters a, b;
	struct decoder_timing ta, tb;
	for (int i = 0; i < 2; i++) {
		feed(i == 0 ? rig : &other, FROM_DEVICE, frame + 333, len - 333);
	}
	assert_int_equal(other.profiles, 1);
	assert_int_equal(rig->last.t_ns, other.last.t_ns);
	assert_memory_equal(rig->last.range_m, other.last.range_m, sizeof(other.last.range_m[0]) * other.last.n);
	cola_counters(rig->decoder, &a), cola_counters(other.decoder, &b);
	for (int i = 0; i < a.n; i++)
		assert_int_equal(a.counter[i].count, b.counter[i].count);
	cola_timing(rig->decoder, &ta), cola_timing(other.decoder, &tb);
	assert_true(ta.offset_ns == tb.offset_ns && ta.drift_ppm == tb.drift_ppm && ta.lost == tb.lost);
	assert_int_equal(ta.lost, 4);

	for (size_t cut = 0; cut < size; cut += cut < 400 || size - cut < 400 ? 1 : 97) {
		state_load(&st, snapshot, cut);
		cola_decoder_state(other.decoder, &st);
		assert_false(state_done(&st));
		cola_counters(other.decoder, &b);
		for (int i = 0; i < b.n; i++)
			assert_int_equal(b.counter[i].count, 0);
	}
	other.profiles = 0;
	feed(&other, FROM_DEVICE, frame, len);
	assert_int_equal(other.profiles, 1);
	cola_decoder_destroy(other.decoder);
}

int main(void)
{
#define RIGGED(name) cmocka_unit_test_setup_teardown(name, setup, teardown)
	const struct CMUnitTest tests[] = {
	    RIGGED(ranges_are_scaled_millimetres_at_sick_bearings_turned),
	    RIGGED(steps_cut_by_the_telegram_are_thirds_and_sixths),
	    RIGGED(codes_become_states_by_the_family),
	    RIGGED(the_first_beam_is_dated_by_what_the_stamp_marks),
	    RIGGED(a_model_that_names_itself_is_believed_until_the_link_is_opened_anew),
	    RIGGED(a_late_arrival_does_not_move_the_scan),
	    RIGGED(gaps_in_the_count_of_scans_are_lost_scans),
	    RIGGED(every_nth_scan_is_no_loss_and_the_first_gap_is_told_in_hindsight),
	    RIGGED(a_telegram_sent_twice_is_one_profile),
	    RIGGED(remission_is_kept_where_the_device_sends_as_much_of_it),
	    RIGGED(what_cannot_be_a_profile_is_counted_and_dropped),
	    RIGGED(a_rate_or_stamp_beyond_belief_is_counted_and_the_last_one_kept),
	    RIGGED(encoder_ticks_are_the_tilt_when_the_scan_was_stamped),
	    RIGGED(answers_go_to_the_dialogue_with_their_dialect),
	    RIGGED(errors_of_the_device_and_of_the_wire_are_counted),
	    RIGGED(a_snapshot_goes_on_in_mid_telegram_and_a_broken_one_is_as_new),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

/* Law: the LMS2xx decoder turns bytes into profiles with true ranges, bearings and times, guesses nothing, and loses no more
 * than the telegram that was broken. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "core/trig.h"
#include "drivers/driver.h"
#include "drivers/lms2xx_wire.h"

#define CAPTURE "../shared/data/captures/lms2xx/lms200_b0_361_mm_real.bin"
#define MS      1000000ll

struct rig {
	struct decoder *decoder;
	int64_t t_ns;
	int profiles, replies, kinds[256];
	struct profile last;
	uint8_t real[2048];
	size_t real_len;
};

static void on_profile(void *ctx, int device, const struct profile *p)
{
	struct rig *rig = ctx;
	assert_int_equal(device, 3);
	rig->profiles++;
	rig->last = *p;
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	struct rig *rig = ctx;
	assert_int_equal(device, 3);
	rig->replies++;
	rig->kinds[reply->kind & 255]++;
	if (reply->len > 0)
		assert_int_equal(reply->payload[0], reply->kind);
}

static void feed(struct rig *rig, enum direction direction, const uint8_t *bytes, size_t len)
{
	const struct record_sink sink = {.ctx = rig, .profile = on_profile, .reply = on_reply};
	const struct record r = {
	    .log_ns = rig->t_ns, .t_ns = rig->t_ns, .device = 3, .direction = direction, .bytes = bytes, .len = len};
	driver_lms2xx.decode(rig->decoder, &r, &sink);
}

static void feed_payload(struct rig *rig, const uint8_t *payload, size_t len)
{
	uint8_t bytes[LMS2XX_TELEGRAM_MAX];
	feed(rig, FROM_DEVICE, bytes, lms2xx_encode(0x80, payload, len, bytes));
}

static void tell_mode(struct rig *rig, int mode)
{
	uint8_t p[36] = {LMS2XX_CONFIG_REPLY};
	p[1 + LMS2XX_CONFIG_MODE] = (uint8_t)mode;
	feed_payload(rig, p, sizeof p);
}

static void tell_variant(struct rig *rig, int fov_deg, int resolution_cdeg)
{
	feed_payload(
	    rig, (const uint8_t[]){LMS2XX_VARIANT_REPLY, 1, (uint8_t)fov_deg, 0, (uint8_t)resolution_cdeg, 0, 0x10}, 7);
}

/* A measurement whose values are their index + 100. */
static size_t make_scan(uint8_t *ret, struct lms2xx_scan scan)
{
	uint8_t words[2 * LMS2XX_BEAMS_MAX];
	for (unsigned i = 0; i < scan.n; i++) {
		words[2 * i] = (uint8_t)(i + 100);
		words[2 * i + 1] = (uint8_t)((i + 100) >> 8);
	}
	scan.stride = 2;
	scan.value = words;
	if (scan.command == 0)
		scan.command = LMS2XX_SCAN;
	return lms2xx_encode_scan(&scan, ret);
}

static void feed_scan(struct rig *rig, struct lms2xx_scan scan)
{
	uint8_t bytes[LMS2XX_TELEGRAM_MAX];
	feed(rig, FROM_DEVICE, bytes, make_scan(bytes, scan));
}

static uint64_t count(const struct rig *rig, const char *name)
{
	struct decoder_counters counters;
	driver_lms2xx.counters(rig->decoder, &counters);
	for (int i = 0; i < counters.n; i++)
		if (strcmp(counters.counter[i].name, name) == 0)
			return counters.counter[i].count;
	fail_msg("no counter %s", name);
	return 0;
}

static void restart(struct rig *rig)
{
	static const struct config_device config = {.baud = 500000, .fov_deg = 180, .resolution_cdeg = 50};
	driver_lms2xx.decoder_destroy(rig->decoder);
	rig->decoder = driver_lms2xx.decoder_create(&config, 3);
	rig->profiles = rig->replies = 0;
	memset(rig->kinds, 0, sizeof rig->kinds);
	rig->t_ns = 1000 * MS;
}

static int setup(void **state)
{
	struct rig *rig = calloc(1, sizeof *rig);
	FILE *file = fopen(CAPTURE, "rb");
	if (file != NULL) {
		rig->real_len = fread(rig->real, 1, sizeof rig->real, file);
		fclose(file);
	} else {
		print_message("note: %s is missing, a made telegram stands in for the real one\n", CAPTURE);
		rig->real_len = make_scan(rig->real, (struct lms2xx_scan){.n = 361, .unit = LMS2XX_MM, .status = 0x10});
	}
	restart(rig);
	*state = rig;
	return 0;
}

static int teardown(void **state)
{
	struct rig *rig = *state;
	driver_lms2xx.decoder_destroy(rig->decoder);
	free(rig);
	return 0;
}

static void the_real_telegram_decodes_as_documented(void **state)
{
	struct rig *rig = *state;
	if (rig->real[7] != 0xCB) {
		print_message("note: the real telegram (../shared/data/captures/lms2xx) is not here: SKIPPED\n");
		skip();
	}
	tell_mode(rig,
	          0x02); /* 13 bit and three field flags: this room is 0.5 .. 4.7 m, the last third stands in a field */
	feed(rig, FROM_DEVICE, rig->real, rig->real_len);
	assert_int_equal(rig->profiles, 1);
	assert_int_equal(rig->last.n, 361);
	assert_int_equal(rig->last.interlace, 2);
	assert_float_equal(rig->last.range_m[0], 2.251, 1e-6);
	assert_float_equal(rig->last.range_m[1], 2.251, 1e-6);
	assert_float_equal(rig->last.range_m[360], 1.304, 1e-6);
	for (int i = 0; i < 361; i++) {
		assert_int_equal(rig->last.state[i], BEAM_OK);
		assert_in_range((int)(rig->last.range_m[i] * 1000), 300, 5000);
	}
	/* The same bytes in another mode are other ranges: that is why nothing is decoded before the mode is known. */
	tell_mode(rig, 0x05);
	feed(rig, FROM_DEVICE, rig->real, rig->real_len);
	assert_true(rig->last.range_m[300] > 8);
}

static void before_the_mode_is_known_profiles_are_counted_and_dropped(void **state)
{
	struct rig *rig = *state;
	feed(rig, FROM_DEVICE, rig->real, rig->real_len);
	assert_int_equal(rig->profiles, 0);
	assert_int_equal(count(rig, "mode unknown"), 1);
	assert_int_equal(rig->kinds[LMS2XX_SCAN], 1);
	tell_mode(rig, 0x3F);
	feed(rig, FROM_DEVICE, rig->real, rig->real_len);
	assert_int_equal(rig->profiles, 0);
	assert_int_equal(count(rig, "mode without ranges"), 1);
	tell_mode(rig, 0x05);
	feed(rig, FROM_DEVICE, rig->real, rig->real_len);
	assert_int_equal(rig->profiles, 1);
	/* It was switched on: perhaps another one. */
	feed_payload(rig, (const uint8_t[]){LMS2XX_POWER_ON, 'L', 'M', 'S', 0x13}, 5);
	feed(rig, FROM_DEVICE, rig->real, rig->real_len);
	assert_int_equal(rig->profiles, 1);
	assert_int_equal(count(rig, "mode unknown"), 2);
}

static void the_configuration_written_is_learned_when_it_is_taken(void **state)
{
	struct rig *rig = *state;
	uint8_t p[37] = {LMS2XX_CONFIG_WRITTEN, 0};
	p[2 + LMS2XX_CONFIG_MODE] = 0x05;
	feed_payload(rig, p, sizeof p);
	feed(rig, FROM_DEVICE, rig->real, rig->real_len);
	assert_int_equal(rig->profiles, 0);
	p[1] = 1;
	feed_payload(rig, p, sizeof p);
	feed(rig, FROM_DEVICE, rig->real, rig->real_len);
	assert_int_equal(rig->profiles, 1);
}

static void a_telegram_split_at_any_byte_is_the_same_telegram(void **state)
{
	struct rig *rig = *state;
	tell_mode(rig, 0x05);
	feed(rig, FROM_DEVICE, rig->real, rig->real_len);
	const struct profile whole = rig->last;
	for (size_t cut = 1; cut < rig->real_len; cut++) {
		rig->t_ns += 27 * MS;
		feed(rig, FROM_DEVICE, rig->real, cut);
		feed(rig, FROM_DEVICE, rig->real + cut, rig->real_len - cut);
		assert_int_equal(rig->profiles, 1 + cut);
		assert_memory_equal(rig->last.range_m, whole.range_m, sizeof(float) * 361);
		assert_memory_equal(rig->last.state, whole.state, 361);
	}
	assert_int_equal(count(rig, "garbage bytes"), 0);
}

static void a_telegram_cut_at_any_byte_is_refused_and_the_next_one_found(void **state)
{
	struct rig *rig = *state;
	for (size_t cut = 1; cut < rig->real_len; cut++) {
		restart(rig);
		tell_mode(rig, 0x05);
		feed(rig, FROM_DEVICE, rig->real, cut);
		assert_int_equal(rig->profiles, 0);
		feed(rig, FROM_DEVICE, rig->real, rig->real_len);
		assert_int_equal(rig->profiles, 1);
		assert_int_equal(rig->kinds[LMS2XX_SCAN], 1);
		assert_int_equal(count(rig, "garbage bytes"), cut);
	}
}

static void a_telegram_corrupted_at_any_byte_is_refused_and_the_next_one_found(void **state)
{
	struct rig *rig = *state;
	static const uint8_t changes[] = {0x01, 0x80, 0xFF, 0x04, 0x55};
	for (size_t at = 0; at < rig->real_len; at++) {
		for (size_t i = 0; i < sizeof changes; i++) {
			restart(rig);
			tell_mode(rig, 0x05);
			uint8_t broken[sizeof rig->real];
			memcpy(broken, rig->real, rig->real_len);
			broken[at] ^= changes[i];
			feed(rig, FROM_DEVICE, broken, rig->real_len);
			assert_int_equal(rig->profiles, 0);
			feed(rig, FROM_DEVICE, rig->real, rig->real_len);
			assert_int_equal(rig->profiles, 1);
			const int more =
			    rig->kinds[LMS2XX_ACK] + rig->kinds[LMS2XX_NAK]; /* the first byte became one */
			assert_int_equal(count(rig, "garbage bytes") + (uint64_t)more, rig->real_len);
		}
	}
}

static void a_begun_telegram_is_dropped_after_silence(void **state)
{
	struct rig *rig = *state;
	tell_mode(rig, 0x05);
	feed(rig, FROM_DEVICE, rig->real, 100);
	rig->t_ns += 251 * MS;
	feed(rig, FROM_DEVICE, (const uint8_t[]){LMS2XX_ACK}, 1);
	assert_int_equal(rig->kinds[LMS2XX_ACK], 1);
	assert_true(count(rig, "cut") >= 1);
	assert_int_equal(rig->profiles, 0);
	/* Where it was the host that slept the rest is there when it wakes. */
	feed(rig, FROM_DEVICE, rig->real, 100);
	rig->t_ns += 3000 * MS;
	feed(rig, FROM_DEVICE, rig->real + 100, rig->real_len - 100);
	assert_int_equal(rig->profiles, 1);
}

static void acknowledgements_inside_telegrams_are_data(void **state)
{
	struct rig *rig = *state;
	uint8_t words[2 * 361], bytes[LMS2XX_TELEGRAM_MAX];
	memset(words, 0x06, sizeof words);
	const struct lms2xx_scan scan = {
	    .command = LMS2XX_SCAN, .unit = 1, .n = 361, .stride = 2, .value = words, .status = 0x10};
	const size_t len = lms2xx_encode_scan(&scan, bytes);
	feed(rig, FROM_DEVICE, bytes + 6, len - 6); /* the rest of a running one, when the host connects */
	feed(rig, FROM_DEVICE, bytes, len);
	feed(rig, FROM_DEVICE, (const uint8_t[]){LMS2XX_ACK, LMS2XX_NAK}, 2);
	assert_int_equal(rig->kinds[LMS2XX_ACK], 1);
	assert_int_equal(rig->kinds[LMS2XX_NAK], 1);
	assert_int_equal(rig->kinds[LMS2XX_SCAN], 1);
	assert_int_equal(count(rig, "nak"), 1);
}

static void bearings_begin_at_the_right_in_every_raster(void **state)
{
	struct rig *rig = *state;
	static const struct {
		uint16_t n;
		int fov_deg, step_cdeg, interlace;
	} rasters[] = {{181, 180, 100, 1}, {361, 180, 50, 2}, {101, 100, 100, 1}, {201, 100, 50, 2}, {401, 100, 25, 4}};
	tell_mode(rig, 0x05);
	for (size_t i = 0; i < 5; i++) {
		rig->t_ns += 100 * MS;
		feed_scan(rig, (struct lms2xx_scan){.n = rasters[i].n, .unit = LMS2XX_CM, .status = 0x10});
		const struct profile *p = &rig->last;
		assert_int_equal(p->n, rasters[i].n);
		assert_float_equal(p->first_rad, -rasters[i].fov_deg / 2.0 * TRIG_DEG, 1e-12);
		assert_float_equal(p->step_rad, rasters[i].step_cdeg / 100.0 * TRIG_DEG, 1e-12);
		assert_int_equal(p->interlace, rasters[i].interlace);
		assert_int_equal(p->parts, 1);
		assert_int_equal(p->beam_ns, 37037);
		assert_int_equal(p->turn_ns, 13333333);
		assert_float_equal(p->range_m[10], 1.10, 1e-6);
	}
	feed_scan(rig, (struct lms2xx_scan){.n = 200, .unit = LMS2XX_CM, .status = 0x10});
	assert_int_equal(count(rig, "raster unknown"), 1);
	/* The fast S14 says 181 values too: half a degree over 90, in one turn. */
	tell_variant(rig, 90, 50);
	feed_scan(rig, (struct lms2xx_scan){.n = 181, .unit = LMS2XX_CM, .status = 0x10});
	assert_float_equal(rig->last.first_rad, -45 * TRIG_DEG, 1e-12);
	assert_int_equal(rig->last.interlace, 1);
	assert_int_equal(rig->last.beam_ns, 18518);
}

static void the_first_beam_is_dated_back_from_the_last_byte(void **state)
{
	struct rig *rig = *state;
	static const struct {
		uint16_t n;
		int turns, fov_deg;
	} rasters[] = {{181, 1, 180}, {361, 2, 180}, {401, 4, 100}};
	for (size_t i = 0; i < 3; i++) {
		restart(rig);
		tell_mode(rig, 0x05);
		feed_scan(rig, (struct lms2xx_scan){.n = rasters[i].n, .unit = LMS2XX_MM, .status = 0x10});
		const int64_t transfer_ns = (2 * rasters[i].n + 10) * 20000ll; /* 500 kBd */
		const int64_t want =
		    rig->t_ns - transfer_ns - (rasters[i].turns - 1) * 13333333ll - rasters[i].fov_deg * 37037ll;
		assert_int_equal(rig->last.t_ns, want);
	}
}

static void a_backlog_is_not_one_instant(void **state)
{
	struct rig *rig = *state;
	tell_mode(rig, 0x05);
	int64_t before = 0;
	for (int i = 0; i < 60; i++) {
		rig->t_ns = 1000 * MS + (i < 50 ? i : 54) * 26666667ll; /* the host slept through five telegrams */
		feed_scan(rig, (struct lms2xx_scan){.n = 361, .unit = LMS2XX_MM, .status = 0x10});
		if (i > 0 && i < 55)
			assert_in_range(rig->last.t_ns - before, 26666600, 26666700);
		before = rig->last.t_ns;
	}
}

static void the_rate_is_learned_from_the_request_that_sets_it(void **state)
{
	struct rig *rig = *state;
	uint8_t bytes[16];
	tell_mode(rig, 0x05);
	feed(rig, TO_DEVICE, bytes, lms2xx_encode(0, (const uint8_t[]){LMS2XX_MODE, LMS2XX_MODE_38400}, 2, bytes));
	feed_payload(rig, (const uint8_t[]){LMS2XX_MODE_REPLY, 0, 0x10}, 3);
	feed(rig, FROM_DEVICE, rig->real, rig->real_len);
	assert_int_equal(rig->last.t_ns, rig->t_ns - 732 * 10 * 1000000000ll / 38400 - 13333333 - 180 * 37037);
}

static void partial_scans_stand_a_quarter_degree_apart(void **state)
{
	struct rig *rig = *state;
	tell_mode(rig, 0x05);
	for (uint8_t part = 0; part < 4; part++) {
		const uint16_t n = part == 0 ? 181 : 180;
		rig->t_ns += 13333333;
		feed_scan(rig, (struct lms2xx_scan){
		                   .n = n, .unit = LMS2XX_MM, .partial = true, .part = part, .status = 0x10});
		assert_int_equal(rig->last.n, n);
		assert_int_equal(rig->last.part, part);
		assert_int_equal(rig->last.parts, 4);
		assert_int_equal(rig->last.interlace, 1);
		assert_float_equal(rig->last.first_rad, (-90 + part * 0.25) * TRIG_DEG, 1e-12);
		assert_float_equal(rig->last.step_rad, TRIG_DEG, 1e-12);
	}
	feed_scan(rig, (struct lms2xx_scan){.n = 100, .unit = LMS2XX_MM, .partial = true, .part = 1, .status = 0x10});
	assert_float_equal(rig->last.first_rad, -49.75 * TRIG_DEG, 1e-12);
	feed_scan(rig, (struct lms2xx_scan){.n = 181, .unit = LMS2XX_MM, .partial = true, .part = 1, .status = 0x10});
	assert_int_equal(rig->profiles, 5);
	assert_int_equal(count(rig, "raster unknown"), 1);
}

static void sub_ranges_need_the_variant_and_begin_with_the_first_turn(void **state)
{
	struct rig *rig = *state;
	struct lms2xx_scan scan = {
	    .command = LMS2XX_SCAN_RANGE, .n = 11, .start = 22, .stop = 32, .unit = LMS2XX_MM, .status = 0x10};
	tell_mode(rig, 0x05);
	feed_scan(rig, scan);
	assert_int_equal(rig->profiles, 0);
	assert_int_equal(count(rig, "raster unknown"), 1);
	tell_variant(rig, 180, 50);
	feed_scan(rig, scan);
	assert_int_equal(rig->profiles, 1);
	assert_int_equal(rig->last.n, 10); /* beam 21 (from 0) was measured in the second turn */
	assert_float_equal(rig->last.first_rad, (-90 + 11) * TRIG_DEG, 1e-12);
	assert_float_equal(rig->last.range_m[0], 0.101, 1e-6);
	const int64_t end_ns = rig->t_ns - (11 * 2 + 14) * 20000ll;
	assert_int_equal(rig->last.t_ns, end_ns - 13333333 - 180 * 37037 + 11 * 37037);
	scan.stop = 33;
	feed_scan(rig, scan);
	scan.start = 352;
	scan.stop = 362;
	feed_scan(rig, scan);
	assert_int_equal(rig->profiles, 1);
	assert_int_equal(count(rig, "raster unknown"), 3);
}

static void indices_tell_what_was_skipped_and_what_was_lost(void **state)
{
	struct rig *rig = *state;
	struct lms2xx_scan scan = {.n = 181, .unit = LMS2XX_MM, .indexed = true, .status = 0x10};
	struct decoder_timing timing;
	tell_mode(rig, 0x05);
	for (int i = 0; i < 100; i++) {
		scan.scan_index = (uint8_t)(i * 8);
		scan.telegram_index = (uint8_t)i;
		rig->t_ns += 320 * MS / 3;
		if (i % 10 != 5) /* every tenth is lost on its way */
			feed_scan(rig, scan);
	}
	assert_int_equal(rig->profiles, 90);
	assert_int_equal(count(rig, "scans skipped"), 99 * 7);
	assert_int_equal(count(rig, "telegrams lost"), 10);
	driver_lms2xx.timing(rig->decoder, &timing);
	assert_true(timing.known && timing.stamps);
	assert_int_equal(timing.lost, 10);
	assert_true(timing.drift_ppm > -100 && timing.drift_ppm < 100);
}

/* Index and arrival of scan k of a mirror that runs 1 % of a turn a second slow; delays are below 2 ms. */
static int64_t mirror_ns(int k)
{
	return 1000 * MS + (int64_t)(k * 26666666.667 * 1.00013);
}

static void send_indexed(struct rig *rig, int k, int telegram, int64_t delay_ns)
{
	rig->t_ns = mirror_ns(k) + 372 * 20000 + 361 * 20000 + 3 * MS + delay_ns;
	feed_scan(rig, (struct lms2xx_scan){.n = 361,
	                                    .unit = LMS2XX_MM,
	                                    .indexed = true,
	                                    .scan_index = (uint8_t)k,
	                                    .telegram_index = (uint8_t)telegram,
	                                    .status = 0x10});
}

/* Without an index a late telegram and a lost one look alike at first; with it there is nothing to guess. */
static void with_indices_a_lost_telegram_misplaces_nothing(void **state)
{
	struct rig *rig = *state;
	int64_t first_ns = 0, worst_ns = 0;
	uint64_t lost = 0;
	tell_mode(rig, 0x05);
	for (int k = 0; k < 4000; k++) {
		if (k % 50 == 49 || (k > 2000 && k < 2060)) {
			lost++;
			continue;
		}
		const int before = rig->profiles;
		send_indexed(rig, k, k, k % 7 == 0 ? 0 : k % 13 * MS / 7);
		assert_int_equal(rig->profiles, before + 1);
		const int64_t error_ns = rig->last.t_ns - mirror_ns(k);
		if (k == 400)
			first_ns = error_ns;
		if (k > 400 && llabs(error_ns - first_ns) > worst_ns)
			worst_ns = llabs(error_ns - first_ns);
	}
	assert_true(worst_ns < 100000);
	assert_int_equal(count(rig, "telegrams lost"), lost - 1); /* nobody can know of the last */
	assert_int_equal(count(rig, "scans skipped"), 0);
}

static void partial_scans_are_dated_by_their_arrival_whatever_the_index(void **state)
{
	struct rig *rig = *state;
	int64_t before_ns = 0;
	tell_mode(rig, 0x05);
	for (int i = 0; i < 400; i++) {
		const uint8_t part = i & 3;
		rig->t_ns = 1000 * MS + i * 40 * MS / 3;
		feed_scan(rig, (struct lms2xx_scan){.n = part ? 180 : 181,
		                                    .unit = LMS2XX_MM,
		                                    .partial = true,
		                                    .part = part,
		                                    .indexed = true,
		                                    .scan_index = (uint8_t)(i / 4),
		                                    .telegram_index = (uint8_t)i,
		                                    .status = 0x10});
		assert_true(i == 0 || llabs(rig->last.t_ns - before_ns - 40 * MS / 3) < MS / 10);
		before_ns = rig->last.t_ns;
	}
}

static void latency_moves_every_beam(void **state)
{
	struct rig *rig = *state;
	static const struct config_device config = {.baud = 500000, .latency_ns = 2500000};
	tell_mode(rig, 0x05);
	feed(rig, FROM_DEVICE, rig->real, rig->real_len);
	const int64_t without_ns = rig->last.t_ns;
	driver_lms2xx.decoder_destroy(rig->decoder);
	rig->decoder = driver_lms2xx.decoder_create(&config, 3);
	tell_mode(rig, 0x05);
	feed(rig, FROM_DEVICE, rig->real, rig->real_len);
	assert_int_equal(rig->last.t_ns, without_ns - 2500000);
}

static void the_expected_rate_is_what_the_line_lets_through(void **state)
{
	struct rig *rig = *state;
	struct decoder_timing timing;
	static const struct {
		uint32_t baud;
		uint16_t n;
		double hz; /* protocols, A.9; 38400 with 361 values: 4.7 seen */
	} rates[] = {{500000, 181, 75},      {500000, 361, 37.5},    {500000, 401, 18.75}, {38400, 181, 75 / 8.0},
	             {38400, 361, 37.5 / 8}, {9600, 361, 37.5 / 29}, {9600, 181, 2.5}};
	driver_lms2xx.timing(rig->decoder, &timing);
	assert_false(timing.known);
	for (int i = 0; i < 7; i++) {
		const struct config_device config = {.baud = rates[i].baud};
		driver_lms2xx.decoder_destroy(rig->decoder);
		rig->decoder = driver_lms2xx.decoder_create(&config, 3);
		tell_mode(rig, 0x05);
		feed_scan(rig, (struct lms2xx_scan){.n = rates[i].n, .unit = LMS2XX_MM, .status = 0x10});
		driver_lms2xx.timing(rig->decoder, &timing);
		assert_true(timing.known && !timing.stamps);
		assert_float_equal(timing.expected_hz, rates[i].hz, 0.01);
	}
}

/* A scanner that stands at another rate than the configured one, and is left there, is never asked for a rate. */
static void the_rate_is_also_learned_from_the_status(void **state)
{
	struct rig *rig = *state;
	struct decoder_timing timing;
	static const struct {
		size_t len, at;
		uint16_t word;
		double hz; /* 361 values */
	} said[] = {{154, 116, 0x8019, 37.5 / 8},
	            {148, 110, 0x8067, 37.5 / 29},
	            {154, 116, 0x8001, 37.5},
	            {154, 116, 0x1234, 37.5},
	            {150, 116, 0x8019, 37.5}};
	for (size_t i = 0; i < sizeof said / sizeof said[0]; i++) {
		uint8_t p[154] = {LMS2XX_STATUS_REPLY};
		p[said[i].at] = (uint8_t)said[i].word;
		p[said[i].at + 1] = (uint8_t)(said[i].word >> 8);
		feed_payload(rig, p, said[i].len);
		tell_mode(rig, 0x05);
		feed_scan(rig, (struct lms2xx_scan){.n = 361, .unit = LMS2XX_MM, .status = 0x10});
		driver_lms2xx.timing(rig->decoder, &timing);
		assert_float_equal(timing.expected_hz, said[i].hz, 0.01);
	}
}

static size_t save(struct rig *rig, uint8_t *ret, size_t cap)
{
	struct state s;
	state_save(&s, ret, cap);
	driver_lms2xx.state(rig->decoder, &s);
	assert_true(state_done(&s));
	return s.at;
}

static bool load(struct rig *rig, const uint8_t *bytes, size_t len)
{
	struct state s;
	state_load(&s, bytes, len);
	driver_lms2xx.state(rig->decoder, &s);
	return state_done(&s);
}

/* The telegrams of a session, each read in two pieces, the second with the first of the next: a snapshot stands within. */
static uint64_t session(struct rig *rig, int from, int to, bool indexed)
{
	uint64_t seen = 0;
	uint8_t bytes[2 * LMS2XX_TELEGRAM_MAX];
	for (int i = from; i < to; i++) {
		const struct lms2xx_scan scan = {.n = 361, .unit = LMS2XX_MM, .indexed = indexed, .status = 0x10};
		struct lms2xx_scan one = scan, next = scan;
		one.scan_index = (uint8_t)(i + i / 5);
		one.telegram_index = (uint8_t)i;
		next.scan_index = (uint8_t)(i + 1 + (i + 1) / 5);
		next.telegram_index = (uint8_t)(i + 1);
		const size_t len = make_scan(bytes, one);
		make_scan(bytes + len, next);
		const int before = rig->profiles;
		rig->t_ns = 1000 * MS + (i + i / 5) * 80 * MS / 3 + i * 7919 % 3 * MS;
		feed(rig, FROM_DEVICE, i == 0 ? bytes : bytes + 40, i == 0 ? len + 40 : len);
		assert_int_equal(rig->profiles, before + 1);
		seen = (seen ^ (uint64_t)rig->last.t_ns) * 0x100000001B3u;
	}
	return seen;
}

static void a_snapshot_anywhere_goes_on_the_same(void **state)
{
	struct rig *rig = *state;
	static uint8_t bytes[1 << 14];
	for (int indexed = 0; indexed < 2; indexed++)
		for (int at = 1; at < 120; at += 7) {
			restart(rig);
			tell_mode(rig, 0x05);
			session(rig, 0, at, indexed);
			const size_t len = save(rig, bytes, sizeof bytes);
			const uint64_t live = session(rig, at, at + 60, indexed);
			restart(rig);
			assert_true(load(rig, bytes, len));
			assert_int_equal(session(rig, at, at + 60, indexed), live);
		}
}

static void a_broken_snapshot_leaves_the_decoder_as_new(void **state)
{
	struct rig *rig = *state;
	static uint8_t bytes[1 << 14], new[1 << 14], after[1 << 14];
	const size_t new_len = save(rig, new, sizeof new);
	tell_mode(rig, 0x05);
	session(rig, 0, 100, true);
	const size_t len = save(rig, bytes, sizeof bytes);
	for (size_t cut = 0; cut < len; cut += 11) {
		assert_false(load(rig, bytes, cut));
		assert_int_equal(save(rig, after, sizeof after), new_len);
		assert_memory_equal(after, new, new_len);
	}
	for (size_t at = 0; at < len; at++) {
		bytes[at] ^= 0x80;
		load(rig, bytes, len); /* taken or not, it bears what comes */
		for (int i = 0; i < 3; i++) {
			rig->t_ns += 20 * MS;
			feed_scan(rig, (struct lms2xx_scan){.n = 361,
			                                    .unit = LMS2XX_MM,
			                                    .indexed = i > 0,
			                                    .scan_index = (uint8_t)(at + (size_t)i)});
		}
		bytes[at] ^= 0x80;
	}
	assert_true(load(rig, bytes, len));
}

static void what_the_device_says_of_itself_is_counted(void **state)
{
	struct rig *rig = *state;
	tell_mode(rig, 0x05);
	feed_scan(rig, (struct lms2xx_scan){.n = 181, .unit = LMS2XX_MM, .status = 0x13});
	feed_scan(rig, (struct lms2xx_scan){.n = 181, .unit = 3, .status = 0x10});
	feed_payload(rig, (const uint8_t[]){LMS2XX_REJECTED, 0x10}, 2);
	feed_payload(rig, (const uint8_t[]){0xEE, 1, 2, 3}, 4);
	feed_payload(rig, (const uint8_t[]){LMS2XX_SCAN_MEAN, 9, 2, 0x40, 1, 0, 2, 0, 0x10}, 9);
	assert_int_equal(count(rig, "device errors"), 1);
	assert_int_equal(count(rig, "malformed"), 1);
	assert_int_equal(count(rig, "rejected"), 1);
	assert_int_equal(count(rig, "unknown telegram"), 2);
	assert_int_equal(rig->profiles, 1);
	assert_int_equal(count(rig, "telegrams"), 6);
}

static void error_codes_become_states_by_the_mode(void **state)
{
	struct rig *rig = *state;
	static const int modes[] = {0x01, 0x03, 0x05, 0x0F};
	static const uint8_t states[] = {BEAM_NO_ECHO,       BEAM_DAZZLED,  BEAM_OVERFLOW, BEAM_RESERVED,   BEAM_WEAK,
	                                 BEAM_CHANNEL_ERROR, BEAM_RESERVED, BEAM_RESERVED, BEAM_BEYOND_MAX, BEAM_OK};
	for (int m = 0; m < 4; m++) {
		const unsigned max = (1u << (13 + m)) - 1;
		uint8_t words[2 * 181] = {0}, bytes[LMS2XX_TELEGRAM_MAX];
		for (unsigned i = 0; i < 10; i++) {
			words[2 * i] = (uint8_t)(max - i);
			words[2 * i + 1] = (uint8_t)((max - i) >> 8);
		}
		const struct lms2xx_scan scan = {
		    .command = LMS2XX_SCAN, .unit = 1, .n = 181, .stride = 2, .value = words};
		tell_mode(rig, modes[m]);
		feed(rig, FROM_DEVICE, bytes, lms2xx_encode_scan(&scan, bytes));
		assert_memory_equal(rig->last.state, states, sizeof states);
		assert_float_equal(rig->last.range_m[9], (max - 9) * 0.001, 1e-5);
	}
}

/* Levels stand above the range in some modes; a C4 has amplitudes of some beams behind its ranges. */
static void remission_is_kept_where_the_scanner_sends_it(void **state)
{
	struct rig *rig = *state;
	static const int modes[] = {0x01, 0x03, 0x05};
	uint8_t words[2 * 181] = {0}, bytes[LMS2XX_TELEGRAM_MAX];
	uint8_t c4[3 + 2 * 181 + 6 + 3 + 1] = {LMS2XX_SCAN_REFLECTIVITY, 181, 0x40};
	const struct lms2xx_scan scan = {.command = LMS2XX_SCAN, .unit = 1, .n = 181, .stride = 2, .value = words};

	for (int m = 0; m < 3; m++) {
		const int bits = 13 + m;

		words[2 * 7] = 100;
		words[2 * 7 + 1] = 0xff & ~((1 << (bits - 8)) - 1);
		tell_mode(rig, modes[m]);
		feed(rig, FROM_DEVICE, bytes, lms2xx_encode_scan(&scan, bytes));
		assert_true(rig->last.has_remission);
		assert_int_equal(rig->last.remission[6], 0);
		assert_int_equal(rig->last.remission[7], (1 << (16 - bits)) - 1);
		assert_float_equal(rig->last.range_m[7], 0.1, 1e-6);
	}
	tell_mode(rig, 0x06);
	feed(rig, FROM_DEVICE, bytes, lms2xx_encode_scan(&scan, bytes));
	assert_false(rig->last.has_remission);
	memcpy(c4 + 3 + 2 * 181, (uint8_t[]){3, 0, 11, 0, 13, 0, 50, 51, 52, 0x10}, 10);
	feed_payload(rig, c4, sizeof(c4));
	assert_true(rig->last.has_remission);
	assert_int_equal(rig->last.remission[9], 0);
	assert_int_equal(rig->last.remission[10], 50);
	assert_int_equal(rig->last.remission[12], 52);
	assert_int_equal(rig->last.remission[13], 0);
}

int main(void)
{
#define RIGGED(name) cmocka_unit_test_setup_teardown(name, setup, teardown)
	const struct CMUnitTest tests[] = {
	    RIGGED(the_real_telegram_decodes_as_documented),
	    RIGGED(before_the_mode_is_known_profiles_are_counted_and_dropped),
	    RIGGED(the_configuration_written_is_learned_when_it_is_taken),
	    RIGGED(a_telegram_split_at_any_byte_is_the_same_telegram),
	    RIGGED(a_telegram_cut_at_any_byte_is_refused_and_the_next_one_found),
	    RIGGED(a_telegram_corrupted_at_any_byte_is_refused_and_the_next_one_found),
	    RIGGED(a_begun_telegram_is_dropped_after_silence),
	    RIGGED(acknowledgements_inside_telegrams_are_data),
	    RIGGED(bearings_begin_at_the_right_in_every_raster),
	    RIGGED(the_first_beam_is_dated_back_from_the_last_byte),
	    RIGGED(a_backlog_is_not_one_instant),
	    RIGGED(the_rate_is_learned_from_the_request_that_sets_it),
	    RIGGED(partial_scans_stand_a_quarter_degree_apart),
	    RIGGED(sub_ranges_need_the_variant_and_begin_with_the_first_turn),
	    RIGGED(indices_tell_what_was_skipped_and_what_was_lost),
	    RIGGED(with_indices_a_lost_telegram_misplaces_nothing),
	    RIGGED(partial_scans_are_dated_by_their_arrival_whatever_the_index),
	    RIGGED(latency_moves_every_beam),
	    RIGGED(the_expected_rate_is_what_the_line_lets_through),
	    RIGGED(the_rate_is_also_learned_from_the_status),
	    RIGGED(a_snapshot_anywhere_goes_on_the_same),
	    RIGGED(a_broken_snapshot_leaves_the_decoder_as_new),
	    RIGGED(what_the_device_says_of_itself_is_counted),
	    RIGGED(error_codes_become_states_by_the_mode),
	    RIGGED(remission_is_kept_where_the_scanner_sends_it),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

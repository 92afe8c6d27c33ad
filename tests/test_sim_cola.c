/* Law: a simulated CoLa scanner says, byte for byte, what real ones were seen to say; whatever it sends is a telegram that
 * the parser reads whole; and its ranges, stamps and angles belong to the times at which it says they were measured. */
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
#include "drivers/cola_scan.h"
#include "tools/sim_device.h"

#define MS 1000000ll

struct bench {
	struct sim_cola_params params;
	struct sim_device device;
	int64_t now_ns;
	uint8_t out[1 << 20];
	size_t len;
	struct framer framer;
	uint8_t buf[COLA_TELEGRAM_MAX];
	/* the scans that came, and the last of them */
	int scans, pieces;
	struct cola_scan scan;
	uint8_t payload[COLA_TELEGRAM_MAX];
	uint16_t range[2048];
	int64_t arrived_ns;
};

/* The world: a range that tells beam and time apart: 1 m + bearing + a slow ramp. */
static double truth_m(double bearing_rad, int64_t t_ns)
{
	return 4.0 + bearing_rad + (double)(t_ns % 1000000000) * 1e-9;
}

static void scene_scan(void *ctx, struct profile *p)
{
	(void)ctx;
	for (int i = 0; i < p->n; i++) {
		p->state[i] = i == 5 ? BEAM_NO_ECHO : BEAM_OK;
		p->range_m[i] = (float)truth_m(p->first_rad + i * p->step_rad, p->t_ns + (int64_t)i * p->beam_ns);
	}
}

static double encoder_angle(void *ctx, int64_t t_ns)
{
	(void)ctx;
	return (double)t_ns * 1e-9 * 0.1;
}

static void make(struct bench *b, enum sim_cola_model_id model)
{
	const struct scene scene = {.scan = scene_scan};
	b->params.model = model;
	b->now_ns = 50 * MS;
	framer_init(&b->framer, cola_scan_frame, NULL, b->buf, sizeof b->buf);
	assert_int_equal(sim_cola_create(&b->params, &scene, b->now_ns, &b->device), 0);
	b->device.connected(b->device.ctx, true, b->now_ns);
}

static int setup(void **state)
{
	*state = calloc(1, sizeof(struct bench));
	return *state == NULL ? -1 : 0;
}

static int teardown(void **state)
{
	struct bench *b = *state;
	b->device.destroy(b->device.ctx);
	free(b);
	return 0;
}

/* Collects until t_ns what leaves the device, at its own deadlines. */
static void run(struct bench *b, int64_t t_ns)
{
	size_t n;
	while (b->now_ns < t_ns) {
		const int64_t deadline_ns = b->device.deadline(b->device.ctx);
		b->now_ns = deadline_ns < t_ns ? (deadline_ns > b->now_ns ? deadline_ns : b->now_ns + 1) : t_ns;
		b->device.advance(b->device.ctx, b->now_ns);
		while ((n = b->device.transmit(b->device.ctx, b->out + b->len, 16384)) > 0) {
			b->len += n;
			b->pieces++;
			assert_true(b->len + 16384 <= sizeof b->out);
		}
	}
}

static void take_scan(struct bench *b, const uint8_t *frame, size_t len)
{
	const uint8_t *payload;
	size_t n;
	const enum cola_dialect dialect = cola_payload(frame, len, &payload, &n);
	if ((cola_reply_kind(dialect, payload, n) & ~COLA_B_FLAG) != COLA_DATA)
		return;
	memcpy(b->payload, payload, n);
	assert_int_equal(cola_scan_read(dialect, b->payload, n, &b->scan), 0);
	cola_channel_values(&b->scan.channel[0], b->range);
	b->scans++;
}

/* All that came is parsed; none of it is refused. */
static void parse(struct bench *b)
{
	const uint8_t *frame;
	size_t n;
	for (size_t done = 0; done < b->len;) {
		done += framer_push(&b->framer, b->out + done, b->len - done);
		while ((n = framer_take(&b->framer, &frame)) > 0)
			take_scan(b, frame, n);
	}
	b->len = 0;
}

static void stream_for(struct bench *b, int64_t for_ns)
{
	const int64_t end_ns = b->now_ns + for_ns;
	while (b->now_ns < end_ns) {
		const int before = b->scans;
		run(b, b->now_ns + MS / 4 < end_ns ? b->now_ns + MS / 4 : end_ns);
		parse(b);
		if (b->scans > before)
			b->arrived_ns = b->now_ns;
	}
}

static size_t from_hex(const char *hex, uint8_t *ret)
{
	size_t n = 0;
	for (; *hex; hex++) {
		unsigned byte;
		if (*hex == ' ')
			continue;
		assert_int_equal(sscanf(hex, "%2x", &byte), 1);
		ret[n++] = (uint8_t)byte;
		hex++;
	}
	return n;
}

/* Sends the bytes, expects exactly those within 10 ms. */
static void exchange(struct bench *b, const uint8_t *out, size_t n, const uint8_t *in, size_t m)
{
	b->len = 0;
	b->device.receive(b->device.ctx, out, n, b->now_ns);
	run(b, b->now_ns + 10 * MS);
	if (b->len != m || memcmp(b->out, in, m) != 0)
		fail_msg("asked %.*s: %zu bytes where %zu were expected: %.*s", (int)n, (const char *)out, b->len, m,
		         (int)b->len, (const char *)b->out);
	b->len = 0;
}

static void exchange_hex(struct bench *b, const char *request, const char *answer)
{
	uint8_t out[256], in[512];
	const size_t n = from_hex(request, out), m = from_hex(answer, in);
	exchange(b, out, n, in, m);
}

static void exchange_a(struct bench *b, const char *request, const char *answer)
{
	char out[300], in[300];
	const int n = snprintf(out, sizeof out, "\x02%s\x03", request);
	const int m = *answer ? snprintf(in, sizeof in, "\x02%s\x03", answer) : 0;
	exchange(b, (const uint8_t *)out, (size_t)n, (const uint8_t *)in, (size_t)m);
}

static void order(struct bench *b, const char *kind, double value, int64_t for_ns, bool on)
{
	struct sim_fault fault = {.value = value, .for_ns = for_ns};
	snprintf(fault.kind, sizeof fault.kind, "%s", kind);
	assert_true(b->device.fault(b->device.ctx, &fault, on, b->now_ns));
}

static void ask_a(struct bench *b, const char *request)
{
	char out[300];
	const int n = snprintf(out, sizeof out, "\x02%s\x03", request);
	b->device.receive(b->device.ctx, (const uint8_t *)out, (size_t)n, b->now_ns);
}

static void the_dialog_of_a_real_lms111_is_answered_with_the_same_bytes(void **state)
{
	struct bench *b = *state;
	make(b, SIM_LMS111);
	exchange_hex(b, "02020202 00000017 734D4E20 5365744163636573734D6F6465 20 03 F4724744 B3",
	             "02020202 00000013 73414E20 5365744163636573734D6F6465 20 01 38");
	exchange_hex(b, "02020202 0000000F 73574E20 4549487374436F6C61 20 01 09",
	             "02020202 0000000E 735741204549487374436F6C612007");
	exchange_hex(b, "02020202 00000013 73524E20 4669726D7761726556657273696F6E 24",
	             "02020202 0000001F 73524120 4669726D7761726556657273696F6E 20000956312E38302E3220205F");
	exchange_hex(b, "02020202 00000011 73524E20 5343646576696365737461746530",
	             "02020202 00000013 73524120 5343646576696365737461746520001F");
	exchange_hex(b, "02020202 00000010 73524E20 4C6F636174696F6E4E616D6555",
	             "02020202 0000001E 73524120 4C6F636174696F6E4E616D6520000B6E6F7420646566696E656445");
	exchange_hex(b, "02020202 00000012 73524E20 4C4D506F757470757452616E6765 5E",
	             "02020202 00000021 73524120 4C4D506F757470757452616E676520 0001 00001388 FFF92233 0022550D 86");
	exchange_hex(b, "02020202 00000021 73574E20 4C4D506F757470757452616E676520 0001 00001388 FFF92233 0022550D 8C",
	             "02020202 00000013 73574120 4C4D506F757470757452616E676520 74");
	exchange_hex(b,
	             "02020202 00000020 73574E20 4C4D447363616E6461746163666720 0100 00 00 00 0000 00 00 00 01 0001 43",
	             "02020202 00000013 73574120 4C4D447363616E6461746163666720 4D");
	exchange_hex(b, "02020202 00000010 734D4E20 4C4D4373746172746D656173 68",
	             "02020202 00000012 73414E20 4C4D4373746172746D656173 20 00 44");
	exchange_hex(b, "02020202 00000007 734D4E20 52756E 19", "02020202 00000009 73414E20 52756E 20 01 34");
	exchange_hex(b, "02020202 00000011 73454E20 4C4D447363616E64617461 20 01 33",
	             "02020202 00000011 73454120 4C4D447363616E64617461 20 01 3C");
}

static void errors_are_two_bytes_behind_their_word(void **state)
{
	struct bench *b = *state;
	make(b, SIM_LMS111);
	exchange_hex(b, "02020202 00000007 73524E20 616263 2F", "02020202 00000005 734641 0003 77");
	order(b, "sfa", 0x0F, 0, true);
	exchange_hex(b, "02020202 00000010 73524E20 4C6F636174696F6E4E616D6555", "02020202 00000005 734641 000F 7B");
	for (int code = 1; code <= 0x1A; code++) {
		const uint8_t sum = (uint8_t)(0x73 ^ 0x46 ^ 0x41 ^ code);
		char answer[64];
		snprintf(answer, sizeof answer, "02020202 00000005 734641 00%02X %02X", code, sum);
		order(b, "sfa", code, 0, true);
		exchange_hex(b, "02020202 00000010 73524E20 4C6F636174696F6E4E616D6555", answer);
	}
}

static void a_tim_speaks_cola_a_and_is_silent_to_the_other_dialect(void **state)
{
	struct bench *b = *state;
	make(b, SIM_TIM561);
	exchange_a(b, "sRI 0", "sRA 0 6 TiM561 E V2.51-21.08.15");
	exchange_a(b, "sRN SerialNumber", "sRA SerialNumber 8 15050157");
	exchange_a(b, "sMN SetAccessMode 03 F4724744", "sAN SetAccessMode 1");
	exchange_a(b, "sMN SetAccessMode 03 F4724745", "sAN SetAccessMode 0");
	exchange_a(b, "sRN LMDscandatacfg", "sRA LMDscandatacfg 1 0 0 0 0 0 0 0 0 0 0 1");
	exchange_a(b, "sWN LMDscandatacfg 01 00 1 1 0 00 00 0 0 0 0 +1", "sWA LMDscandatacfg");
	exchange_a(b, "sRN LMDscandatacfg", "sRA LMDscandatacfg 1 0 1 1 0 0 0 0 0 0 0 1");
	exchange_a(b, "sMN mLMPsetscancfg +1500 +1 +3333 -450000 +2250000", "sFA 3");
	exchange_hex(b, "02020202 00000011 73454E20 4C4D447363616E64617461 20 01 33", "");
	exchange_a(b, "sWN EIHstCola 1", "sWA EIHstCola");
	exchange_a(b, "sRN SerialNumber", "");
	exchange_hex(b, "02020202 00000010 73524E20 4C6F636174696F6E4E616D6555",
	             "02020202 0000001E 73524120 4C6F636174696F6E4E616D6520000B6E6F7420646566696E656445");
}

static void nothing_is_written_without_a_login(void **state)
{
	struct bench *b = *state;
	make(b, SIM_TIM561);
	exchange_a(b, "sWN LMDscandatacfg 01 00 1 1 0 00 00 0 0 0 0 +1", "sFA A");
	exchange_a(b, "sMN mSCreboot", "sFA 1");
	exchange_a(b, "sMN SetAccessMode 3 F4724744", "sAN SetAccessMode 1");
	exchange_a(b, "sWN LMDscandatacfg 01 00 2 1 0 00 00 0 0 0 0 +1", "sFA 4");
	exchange_a(b, "sWN LMDscandatacfg 01 00 1 1", "sFA 8");
	exchange_a(b, "sMN Run", "sAN Run 1");
	exchange_a(b, "sWN LMDscandatacfg 01 00 1 1 0 00 00 0 0 0 0 +1", "sFA A");
}

/* What the parser makes of a scan belongs to the times it names. */
static void check_scan(const struct bench *b, double step_deg, bool stamps_end, double late_ms)
{
	const struct cola_channel *c = &b->scan.channel[0];
	const double turn_ns = 1e11 / b->scan.frequency_chz, beam_ns = turn_ns * step_deg / 360.0;
	/* The device's clock began at 0 when it was made, at 50 ms. */
	const int64_t stamp_ns = 50 * MS + (int64_t)b->scan.t_startup_us * 1000;
	const int64_t first_ns = stamps_end ? stamp_ns - (int64_t)((c->n - 1) * beam_ns) : stamp_ns;
	for (int i = 0; i < c->n; i++) {
		const double bearing = (c->start_tdeg / 10000.0 + i * step_deg - 90.0) * TRIG_DEG;
		if (i == 5)
			continue;
		const double expected = truth_m(bearing, first_ns + (int64_t)(i * beam_ns)) * 1000.0;
		if (fabs(expected - b->range[i] * (double)c->scale) > 1.1 && fabs(expected - b->range[i]) < 900.0)
			fail_msg("beam %d: %u where %.2f is true", i, b->range[i], expected);
	}
	const double late = (double)(b->scan.t_transmit_us - b->scan.t_startup_us) / 1000.0;
	assert_true(fabs(late - late_ms) < 0.5);
	assert_true(b->arrived_ns > stamp_ns && b->arrived_ns < stamp_ns + (int64_t)((late_ms + 1.0) * 1e6));
}

static void a_tim561_measures_811_beams_and_stamps_their_end(void **state)
{
	struct bench *b = *state;
	make(b, SIM_TIM561);
	ask_a(b, "sEN LMDscandata 1");
	stream_for(b, 1000 * MS);
	assert_in_range(b->scans, 13, 15);
	assert_int_equal(b->scan.channel[0].n, 811);
	assert_int_equal(b->scan.channel[0].start_tdeg, -450000);
	assert_int_equal(b->scan.channel[0].step_tdeg, 3333);
	assert_int_equal(b->range[5], 2);
	check_scan(b, 1.0 / 3.0, true, 4.35);
	assert_int_equal(b->framer.skipped, 0);
}

static void an_lms111_stamps_the_end_and_an_lms511_the_start(void **state)
{
	struct bench *b = *state;
	make(b, SIM_LMS111);
	b->device.destroy(b->device.ctx);
	b->params.dialect = SIM_COLA_A;
	make(b, SIM_LMS111);
	ask_a(b, "sEN LMDscandata 1");
	stream_for(b, 1000 * MS);
	assert_in_range(b->scans, 48, 50);
	assert_int_equal(b->scan.channel[0].n, 541);
	check_scan(b, 0.5, true, 3.17);
	b->device.destroy(b->device.ctx);
	b->scans = 0;
	make(b, SIM_LMS511);
	ask_a(b, "sEN LMDscandata 1");
	stream_for(b, 1000 * MS);
	assert_in_range(b->scans, 23, 25);
	assert_int_equal(b->scan.channel[0].n, 1141);
	assert_int_equal(b->scan.version, 0);
	check_scan(b, 1.0 / 6.0, false, 40.6);
}

static void what_is_written_changes_what_is_sent(void **state)
{
	struct bench *b = *state;
	b->params = (struct sim_cola_params){.dialect = SIM_COLA_A, .angle = encoder_angle, .ticks_per_rad = 10000};
	make(b, SIM_LMS111);
	exchange_a(b, "sMN SetAccessMode 3 F4724744", "sAN SetAccessMode 1");
	exchange_a(b, "sMN mLMPsetscancfg +2500 +1 +2500 -450000 +2250000",
	           "sAN mLMPsetscancfg 0 9C4 1 9C4 FFF92230 225510");
	exchange_a(b, "sMN mLMPsetscancfg +2600 +1 +2500 -450000 +2250000",
	           "sAN mLMPsetscancfg 1 9C4 1 9C4 FFF92230 225510");
	exchange_a(b, "sMN mLMPsetscancfg +2500 +1 +5000 -450000 +2250000",
	           "sAN mLMPsetscancfg 2 9C4 1 9C4 FFF92230 225510");
	exchange_a(b, "sWN LMPoutputRange 1 +2500 +0 +1800000", "sWA LMPoutputRange");
	exchange_a(b, "sWN LMDscandatacfg 01 00 1 0 0 01 00 1 1 1 1 +2", "sWA LMDscandatacfg");
	exchange_a(b, "sWN LocationName 7 left 01", "sWA LocationName");
	ask_a(b, "sEN LMDscandata 1");
	stream_for(b, 1000 * MS);
	assert_in_range(b->scans, 11, 13);
	assert_int_equal(b->scan.frequency_chz, 2500);
	assert_int_equal(b->scan.channels, 2);
	assert_string_equal(b->scan.channel[1].name, "RSSI1");
	assert_int_equal(b->scan.channel[1].bytes, 1);
	assert_int_equal(b->scan.channel[0].n, 721);
	assert_int_equal(b->scan.channel[0].start_tdeg, 0);
	assert_int_equal(b->scan.encoders, 1);
	assert_true(abs((int)b->scan.encoder[0].ticks - (int)(b->scan.t_startup_us / 1000 + 50)) <= 1);
	assert_true(b->scan.has_position && b->scan.has_time && b->scan.comment != NULL);
	assert_int_equal(b->scan.name_len, 7);
	assert_memory_equal(b->scan.name, "left 01", 7);
	check_scan(b, 0.25, true, 3.17);
}

static void whatever_is_switched_on_the_parser_reads_it(void **state)
{
	static const char *const kinds[] = {"name empty", "name blanks", "position", "comment", "time",      "event",
	                                    "encoders",   "scale",       "echoes",   "angles",  "monitored", "codes"};
	struct bench *b = *state;
	for (int dialect = SIM_COLA_A; dialect <= SIM_COLA_B; dialect++) {
		b->params.dialect = dialect;
		if (b->device.ctx != NULL)
			b->device.destroy(b->device.ctx);
		make(b, SIM_LMS511);
		order(b, "streaming", 0, 0, true);
		for (size_t i = 0; i < sizeof kinds / sizeof kinds[0]; i++) {
			const int before = b->scans;
			order(b, kinds[i], 0, 0, true);
			stream_for(b, 100 * MS);
			assert_true(b->scans > before);
		}
		assert_int_equal(b->scan.channels, 6);
		assert_int_equal(b->scan.encoders, 2);
		assert_true(b->scan.monitored && b->scan.has_event && b->scan.has_time);
		assert_true(b->scan.name != NULL && b->scan.name_len == 0);
		assert_true(b->scan.channel[0].scale == 2.0f);
		assert_int_equal(b->framer.skipped, 0);
	}
}

static void clocks_and_counters_wrap_step_and_drift(void **state)
{
	struct bench *b = *state;
	make(b, SIM_TIM561);
	ask_a(b, "sEN LMDscandata 1");
	stream_for(b, 1000 * MS);
	order(b, "counter wrap", 3, 0, true);
	stream_for(b, 400 * MS);
	assert_true(b->scan.telegram_counter < 5 && b->scan.scan_counter < 5);
	order(b, "clock wrap", 0.2, 0, true);
	stream_for(b, 1000 * MS);
	assert_in_range(b->scan.t_transmit_us, 700000, 800000);
	const uint32_t before_us = b->scan.t_transmit_us;
	order(b, "clock step", 5, 0, true);
	stream_for(b, 1000 * MS);
	assert_in_range(b->scan.t_transmit_us - before_us, 5900000, 6100000);
	order(b, "drift", 200, INT64_MAX, true);
	stream_for(b, 1000 * MS);
	const uint32_t first_us = b->scan.t_transmit_us;
	const int64_t first_ns = b->arrived_ns;
	stream_for(b, 100000 * MS);
	const double ran_us = b->scan.t_transmit_us - first_us, passed_us = (double)(b->arrived_ns - first_ns) / 1000;
	assert_true(fabs(ran_us / passed_us - 1.0002) < 1e-5);
}

static struct sim_counts counts_of(const struct bench *b)
{
	struct sim_counts counts;
	b->device.counts(b->device.ctx, &counts);
	return counts;
}

static void faults_of_the_line_are_counted_as_they_befell(void **state)
{
	struct bench *b = *state;
	make(b, SIM_TIM561);
	ask_a(b, "sEN LMDscandata 1");
	stream_for(b, 500 * MS);
	order(b, "lost", 0, 0, true);
	order(b, "corrupt", 0, 0, true);
	stream_for(b, 1000 * MS);
	struct sim_counts counts = counts_of(b);
	assert_int_equal(counts.dropped, 1);
	assert_int_equal(counts.corrupted, 1);
	assert_int_equal(counts.sent + counts.dropped + counts.corrupted, counts.profiles);
	order(b, "duplicate", 0, 0, true);
	const int before = b->scans;
	const uint64_t sent = counts.sent;
	stream_for(b, 1000 * MS);
	counts = counts_of(b);
	assert_int_equal(b->scans - before, (int)(counts.sent - sent) + 1);
	order(b, "garbage", 0, 500 * MS, true);
	stream_for(b, 20 * MS);
	order(b, "garbage", 0, 500 * MS, false);
	counts = counts_of(b);
	assert_in_range(counts.garbage, 100000, 200000);
	assert_in_range(b->framer.skipped, counts.garbage / 2, counts.garbage + 70000);
	order(b, "silence", 0, 300 * MS, true);
	const int quiet = b->scans;
	stream_for(b, 300 * MS);
	assert_int_equal(b->scans, quiet);
	order(b, "silence", 0, 300 * MS, false);
	stream_for(b, 300 * MS);
	assert_in_range(b->scans - quiet, 3, 6);
}

static void a_stalled_scanner_sends_what_it_kept(void **state)
{
	struct bench *b = *state;
	make(b, SIM_TIM561);
	ask_a(b, "sEN LMDscandata 1");
	stream_for(b, 500 * MS);
	const int before = b->scans;
	order(b, "stall", 0, 400 * MS, true);
	stream_for(b, 400 * MS);
	assert_int_equal(b->scans, before);
	order(b, "stall", 0, 400 * MS, false);
	stream_for(b, 1 * MS);
	assert_in_range(b->scans - before, 5, 7);
}

static void segments_come_as_they_were_measured(void **state)
{
	struct bench *b = *state;
	b->params = (struct sim_cola_params){.dialect = SIM_COLA_A, .segments = true};
	make(b, SIM_TIM561);
	ask_a(b, "sEN LMDscandata 1");
	stream_for(b, 20000 * MS);
	assert_in_range(b->scans, 295, 300);
	assert_in_range(b->pieces, b->scans * 19 / 10, b->scans * 2 + 1);
	order(b, "split", 0, INT64_MAX, true);
	const int before = b->pieces;
	stream_for(b, 200 * MS);
	assert_true(b->pieces - before > 4000);
	order(b, "split", 0, INT64_MAX, false);
	order(b, "merge", 3, INT64_MAX, true);
	const int merged = b->pieces, scans = b->scans;
	stream_for(b, 2000 * MS);
	assert_in_range(b->scans - scans, 24, 33);
	assert_true(b->pieces - merged <= (b->scans - scans) * 2);
	assert_int_equal(b->framer.skipped, 0);
}

static void without_power_it_forgets_what_it_was_told(void **state)
{
	struct bench *b = *state;
	make(b, SIM_TIM561);
	ask_a(b, "sEN LMDscandata 1");
	stream_for(b, 500 * MS);
	order(b, "power", 0, 1000 * MS, true);
	assert_false(b->device.alive(b->device.ctx));
	b->device.connected(b->device.ctx, false, b->now_ns);
	run(b, b->now_ns + 1000 * MS);
	order(b, "power", 0, 1000 * MS, false);
	assert_true(b->device.alive(b->device.ctx));
	b->device.connected(b->device.ctx, true, b->now_ns);
	const int before = b->scans;
	stream_for(b, 500 * MS);
	assert_int_equal(b->scans, before);
	ask_a(b, "sEN LMDscandata 1");
	stream_for(b, 500 * MS);
	assert_in_range(b->scans - before, 6, 8);
	assert_true(b->scan.t_startup_us < 1100000);
	assert_true(b->scan.telegram_counter < 10);
}

static void two_readers_get_the_same_scans(void **state)
{
	struct bench *b = *state;
	struct sim_device other;
	uint8_t bytes[16384], last[16384];
	size_t n, last_len = 0;
	int scans = 0;
	make(b, SIM_TIM561);
	assert_true(b->device.session(b->device.ctx, &other));
	other.connected(other.ctx, true, b->now_ns);
	other.receive(other.ctx, (const uint8_t *)"\x02sEN LMDscandata 1\x03", 19, b->now_ns);
	ask_a(b, "sEN LMDscandata 1");
	for (int i = 0; i < 500; i++) {
		stream_for(b, MS);
		while ((n = other.transmit(other.ctx, bytes, sizeof bytes)) > 0) {
			scans += n > 1000;
			memcpy(last, bytes, last_len = n);
		}
	}
	assert_int_equal(scans, b->scans);
	assert_memory_equal(last + 1, b->payload, last_len - 2);
	other.destroy(other.ctx);
}

static void without_ranging_there_is_no_scan(void **state)
{
	struct bench *b = *state;
	make(b, SIM_TIM310);
	exchange_a(b, "sRN DeviceIdent", "sRA DeviceIdent E TiM310-1030000 E V2.50-16.02.15");
	exchange_a(b, "sEN LMDscandata 1", "sFA F");
	stream_for(b, 500 * MS);
	assert_int_equal(b->scans, 0);
}

static void one_scan_can_be_asked_for(void **state)
{
	struct bench *b = *state;
	struct cola_scan scan;
	const uint8_t *payload;
	size_t n;
	make(b, SIM_TIM571);
	ask_a(b, "sRN LMDscandata");
	run(b, b->now_ns + 200 * MS);
	assert_true(b->len > 2000);
	assert_int_equal(cola_payload(b->out, b->len, &payload, &n), COLA_A);
	assert_memory_equal(payload, "sRA LMDscandata ", 16);
	assert_int_equal(cola_scan_read(COLA_A, payload, n, &scan), 0);
	assert_int_equal(scan.channel[0].n, 811);
}

int main(void)
{
#define BENCHED(name) cmocka_unit_test_setup_teardown(name, setup, teardown)
	const struct CMUnitTest tests[] = {
	    BENCHED(the_dialog_of_a_real_lms111_is_answered_with_the_same_bytes),
	    BENCHED(errors_are_two_bytes_behind_their_word),
	    BENCHED(a_tim_speaks_cola_a_and_is_silent_to_the_other_dialect),
	    BENCHED(nothing_is_written_without_a_login),
	    BENCHED(a_tim561_measures_811_beams_and_stamps_their_end),
	    BENCHED(an_lms111_stamps_the_end_and_an_lms511_the_start),
	    BENCHED(what_is_written_changes_what_is_sent),
	    BENCHED(whatever_is_switched_on_the_parser_reads_it),
	    BENCHED(clocks_and_counters_wrap_step_and_drift),
	    BENCHED(faults_of_the_line_are_counted_as_they_befell),
	    BENCHED(a_stalled_scanner_sends_what_it_kept),
	    BENCHED(segments_come_as_they_were_measured),
	    BENCHED(without_power_it_forgets_what_it_was_told),
	    BENCHED(two_readers_get_the_same_scans),
	    BENCHED(without_ranging_there_is_no_scan),
	    BENCHED(one_scan_can_be_asked_for),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

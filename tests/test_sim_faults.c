/* Law: a simulated LMS2xx answers the documented telegrams byte for byte, and what goes wrong with it is what was ordered,
 * when it was ordered, and counted; a played recording's line is never lost among it. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "drivers/lms2xx_wire.h"
#include "tools/sim_device.h"

#define MS 1000000ll

struct bench {
	struct sim_lms2xx_params params;
	struct sim_device device;
	int64_t now_ns, gap_ns, last_ns; /* longest pause between bytes of a telegram */
	uint8_t out[1 << 16];
	size_t len;
	int pieces;
	struct framer framer;
	uint8_t buf[LMS2XX_TELEGRAM_MAX + 64];
	int scans, acks, naks, replies;
	uint8_t command; /* of the last reply */
	struct lms2xx_scan scan;
	uint8_t payload[LMS2XX_PAYLOAD_MAX];
	int parts; /* bit set */
};

static void scene_scan(void *ctx, struct profile *p)
{
	(void)ctx;
	for (int i = 0; i < p->n; i++) {
		p->state[i] = BEAM_OK;
		p->range_m[i] = 2.0f + (float)i * 0.01f;
	}
}

static void make(struct bench *b)
{
	const struct scene scene = {.scan = scene_scan};
	b->now_ns = 50 * MS;
	framer_init(&b->framer, lms2xx_scan_device, NULL, b->buf, sizeof b->buf);
	assert_int_equal(sim_lms2xx_create(&b->params, &scene, b->now_ns, &b->device), 0);
	b->device.connected(b->device.ctx, true, b->now_ns);
}

static int setup(void **state)
{
	struct bench *b = calloc(1, sizeof *b);
	*state = b;
	if (b == NULL)
		return -1;
	b->params = (struct sim_lms2xx_params){.baud = 500000, .mode = 0x05, .millimetres = true};
	make(b);
	return 0;
}

static int teardown(void **state)
{
	struct bench *b = *state;
	b->device.destroy(b->device.ctx);
	free(b);
	return 0;
}

static void restart(struct bench *b)
{
	b->device.destroy(b->device.ctx);
	b->len = 0;
	make(b);
}

static void drain(struct bench *b)
{
	size_t n;
	while ((n = b->device.transmit(b->device.ctx, b->out + b->len, 4096)) > 0) {
		assert_true(b->len + n + 4096 <= sizeof b->out);
		if (b->len > 0 && b->now_ns - b->last_ns > b->gap_ns)
			b->gap_ns = b->now_ns - b->last_ns;
		b->last_ns = b->now_ns;
		b->len += n;
		b->pieces++;
	}
}

static void run(struct bench *b, int64_t for_ns)
{
	const int64_t end_ns = b->now_ns + for_ns;
	while (b->now_ns < end_ns) {
		const int64_t deadline_ns = b->device.deadline(b->device.ctx);
		b->now_ns = deadline_ns < end_ns ? (deadline_ns > b->now_ns ? deadline_ns : b->now_ns + 1) : end_ns;
		b->device.advance(b->device.ctx, b->now_ns);
		drain(b);
	}
}

static void take(struct bench *b, const uint8_t *telegram, size_t n)
{
	if (n == 1) {
		b->acks += telegram[0] == LMS2XX_ACK;
		b->naks += telegram[0] == LMS2XX_NAK;
		return;
	}
	if (!lms2xx_is_scan(telegram[4])) {
		b->replies++;
		b->command = telegram[4];
		return;
	}
	memcpy(b->payload, telegram + 4, n - 6);
	assert_true(lms2xx_decode_scan(b->payload, n - 6, &b->scan));
	b->scans++;
	b->parts |= b->scan.partial ? 1 << b->scan.part : 0;
}

static void parse(struct bench *b)
{
	const uint8_t *telegram;
	size_t n;
	for (size_t done = 0; done < b->len;) {
		done += framer_push(&b->framer, b->out + done, b->len - done);
		while ((n = framer_take(&b->framer, &telegram)) > 0)
			take(b, telegram, n);
	}
	b->len = 0;
}

static void stream(struct bench *b, int64_t for_ns)
{
	for (int64_t i = 0; i < for_ns; i += 10 * MS) {
		run(b, 10 * MS);
		parse(b);
	}
}

static void say(struct bench *b, const uint8_t *payload, size_t len)
{
	uint8_t telegram[LMS2XX_TELEGRAM_MAX];
	const size_t n = lms2xx_encode(0, payload, len, telegram);
	b->device.receive(b->device.ctx, telegram, n, b->now_ns);
}

#define SEND(b, ...) say(b, (const uint8_t[]){__VA_ARGS__}, sizeof(const uint8_t[]){__VA_ARGS__})

static void order(struct bench *b, const char *kind, double value, int64_t for_ns, bool on)
{
	struct sim_fault fault = {.value = value, .for_ns = for_ns};
	snprintf(fault.kind, sizeof fault.kind, "%s", kind);
	assert_true(b->device.fault(b->device.ctx, &fault, on, b->now_ns));
}

static struct sim_counts counts_of(const struct bench *b)
{
	struct sim_counts counts;
	b->device.counts(b->device.ctx, &counts);
	return counts;
}

static size_t from_hex(const char *hex, uint8_t *ret)
{
	size_t n = 0;
	unsigned byte;
	int used;
	for (; sscanf(hex, " %2x%n", &byte, &used) == 1; hex += used)
		ret[n++] = (uint8_t)byte;
	return n;
}

static void exchange(struct bench *b, const char *request, const char *answer)
{
	uint8_t out[64], in[200];
	const size_t n = from_hex(request, out), m = from_hex(answer, in);
	b->len = 0;
	b->device.receive(b->device.ctx, out, n, b->now_ns);
	run(b, 20 * MS);
	if (b->len < m || memcmp(b->out, in, m) != 0)
		fail_msg("%s: the answer is not %s", request, answer);
	b->len = 0;
}

static void documented_requests_have_documented_answers(void **state)
{
	struct bench *b = *state;
	exchange(b, "02 00 02 00 20 25 35 08", "06 02 80 03 00 A0 00 10 16 0A");
	exchange(b, "02 00 0A 00 20 00 53 49 43 4B 5F 4C 4D 53 BE C5", "06 02 80 03 00 A0 00 10 16 0A");
	exchange(b, "02 00 05 00 3B 64 00 64 00 1D 0F", "06 02 80 07 00 BB 01 64 00 64 00 10");
	exchange(b, "02 00 05 00 3B B4 00 32 00 3B 1F", "06 02 80 07 00 BB 01 B4 00 32 00 10");
	exchange(
	    b,
	    "02 00 23 00 77 00 00 46 00 02 02 00 00 00 02 02 02 00 00 0A 0A 50 64 00 0A 0A 50 64 00 0A 0A 50 64 00 "
	    "00 00 00 02 00 9F 11",
	    "06 02 80 25 00 F7 01 00 00 46 00 02 02 00 00 00 02 02 02 00 00 0A 0A 50 64");
	exchange(b, "02 00 01 00 74 50 12", "06 02 80 24 00 F4 00 00 46 00 02 02 00");
	exchange(b, "02 00 01 00 3A 1E 12", "06 02 80 17 00 BA 4C 4D 53 32 30 30 3B 33 30 31 30 36 33");
	exchange(b, "02 00 01 00 31 15 12", "06 02 80 9A 00 B1 56 30 32 2E 30 36 20 00");
	exchange(b, "02 00 01 00 32 16 12", "06 02 80 02 00 B2 10");
	exchange(b, "02 00 01 00 31 15 13", "15");
	exchange(b, "02 00 02 00 30 01 31 18", "06 02 80 02 00 92 10");
	exchange(b, "02 00 01 00 10 34 12", "06 02 80 02 00 91 10 79 30 02 80 17 00 90 4C 4D 53 32 30 30 3B");
}

static void single_faults_befall_the_next_request(void **state)
{
	struct bench *b = *state;
	order(b, "nak", 0, 0, true);
	exchange(b, "02 00 01 00 31 15 12", "15");
	order(b, "reject", 0, 0, true);
	exchange(b, "02 00 01 00 31 15 12", "06 02 80 02 00 92 10");
	order(b, "ack lost", 0, 0, true);
	exchange(b, "02 00 02 00 20 25 35 08", "02 80 03 00 A0 00 10 16 0A");
	order(b, "no answer", 0, 0, true);
	SEND(b, LMS2XX_STATUS);
	run(b, 20 * MS);
	assert_int_equal(b->len, 0);
	exchange(b, "02 00 02 00 20 25 35 08", "06 02 80 03 00 A0 00 10 16 0A");
}

static void telegrams_that_leave_wrong_are_counted(void **state)
{
	struct bench *b = *state;
	SEND(b, LMS2XX_MODE, LMS2XX_MODE_STREAM);
	stream(b, 500 * MS);
	const int before = b->scans;
	const uint64_t profiles = counts_of(b).profiles;
	order(b, "crc", 0, 0, true);
	order(b, "corrupt", 0, 0, true);
	order(b, "lost", 0, 0, true);
	stream(b, 1000 * MS);
	const struct sim_counts counts = counts_of(b);
	assert_int_equal(counts.dropped, 1);
	assert_in_range(counts.corrupted, 1, 2); /* two faults may befall the same telegram */
	assert_int_equal(b->scans - before, (int)(counts.profiles - profiles) - (int)(counts.corrupted + 1));
	assert_true(b->framer.refused[LMS2XX_BAD_CRC] > 0);
}

static void a_false_begin_costs_bytes_and_no_telegram(void **state)
{
	struct bench *b = *state;
	SEND(b, LMS2XX_MODE, LMS2XX_MODE_STREAM);
	order(b, "false start", 0, INT64_MAX, true);
	order(b, "false stx", 0, INT64_MAX, true);
	stream(b, 2000 * MS);
	order(b, "false start", 0, INT64_MAX, false);
	order(b, "false stx", 0, INT64_MAX, false);
	stream(b, 100 * MS);
	assert_int_equal(b->scans, (int)counts_of(b).sent);
	assert_true(b->scans > 60);
	assert_true(b->framer.skipped >= 4 * 70);
}

static void bytes_come_one_by_one_and_with_gaps(void **state)
{
	struct bench *b = *state;
	SEND(b, LMS2XX_MODE, LMS2XX_MODE_STREAM);
	run(b, 100 * MS);
	parse(b);
	order(b, "split", 0, INT64_MAX, true);
	const int before = b->pieces, scans = b->scans;
	stream(b, 200 * MS);
	assert_in_range(b->scans - scans, 6, 8);
	assert_true(b->pieces - before > 6 * 700);
	order(b, "split", 0, INT64_MAX, false);
	order(b, "gap", 0, 0, true);
	b->gap_ns = 0;
	b->scans = 0;
	while (b->scans == 0 && b->gap_ns < 14 * MS) {
		run(b, 2 * MS);
		if (b->gap_ns >= 14 * MS)
			break;
	}
	assert_in_range(b->gap_ns, 14 * MS, 16 * MS);
	parse(b);
	assert_int_equal(b->framer.skipped, 0);
}

static void every_error_code_comes_in_every_width(void **state)
{
	static const int modes[] = {0x00, 0x03, 0x05, 0x0F};
	struct bench *b = *state;
	for (int i = 0; i < 4; i++) {
		unsigned seen = 0;
		uint16_t range;
		b->params.mode = modes[i];
		restart(b);
		order(b, "codes", 0, INT64_MAX, true);
		SEND(b, LMS2XX_MODE, LMS2XX_MODE_STREAM);
		stream(b, 200 * MS);
		for (unsigned k = 0; k < b->scan.n; k++)
			seen |= 1u << lms2xx_range((uint16_t)(b->scan.value[2 * k] | b->scan.value[2 * k + 1] << 8),
			                           modes[i], &range);
		for (int code = BEAM_NO_ECHO; code <= BEAM_RESERVED; code++)
			assert_true(seen & 1u << code);
		assert_true(seen & 1u << BEAM_OK);
	}
}

static void settings_change_what_is_sent(void **state)
{
	struct bench *b = *state;
	SEND(b, LMS2XX_MODE, LMS2XX_MODE_STREAM);
	stream(b, 200 * MS);
	assert_int_equal(b->scan.unit, LMS2XX_MM);
	assert_false(b->scan.indexed);
	order(b, "cm", 0, 0, true);
	order(b, "indices", 0, 0, true);
	stream(b, 200 * MS);
	assert_int_equal(b->scan.unit, LMS2XX_CM);
	assert_true(b->scan.indexed);
	const uint8_t index = b->scan.scan_index;
	stream(b, 200 * MS);
	assert_in_range((uint8_t)(b->scan.scan_index - index), 7, 8);
	order(b, "mm", 0, 0, true);
	order(b, "no indices", 0, 0, true);
	order(b, "parts", 0, 0, true);
	stream(b, 200 * MS);
	assert_int_equal(b->scan.unit, LMS2XX_MM);
	assert_false(b->scan.indexed);
	assert_int_equal(b->parts, 15);
}

static void a_slow_line_skips_scans_and_the_index_tells(void **state)
{
	struct bench *b = *state;
	b->params.baud = 38400;
	b->params.indices = true;
	restart(b);
	SEND(b, LMS2XX_MODE, LMS2XX_MODE_STREAM);
	stream(b, 1000 * MS);
	const int before = b->scans;
	const uint8_t index = b->scan.scan_index;
	stream(b, 4000 * MS);
	assert_in_range(b->scans - before, 17, 22);
	const int passed = (uint8_t)(b->scan.scan_index - index);
	assert_in_range(passed, 140, 152);
	const struct sim_counts counts = counts_of(b);
	assert_in_range(counts.profiles - counts.sent - counts.dropped, 0, 1);
}

static void at_another_rate_both_directions_are_garbled(void **state)
{
	struct bench *b = *state;
	SEND(b, LMS2XX_MODE, LMS2XX_MODE_STREAM);
	stream(b, 200 * MS);
	const int before = b->scans;
	b->device.host_baud(b->device.ctx, 38400);
	SEND(b, LMS2XX_MODE, LMS2XX_MODE_IDLE);
	const uint64_t requests = counts_of(b).requests;
	stream(b, 500 * MS);
	assert_int_equal(b->scans, before);
	assert_int_equal(counts_of(b).requests, requests);
	assert_true(counts_of(b).corrupted >= 17);
	order(b, "baud", 38400, 0, true);
	stream(b, 1000 * MS);
	assert_true(b->scans > before);
}

static void power_falls_back_to_the_permanent_rate_and_says_90(void **state)
{
	struct bench *b = *state;
	b->params.baud = 9600;
	restart(b);
	b->device.host_baud(b->device.ctx, 9600);
	SEND(b, LMS2XX_MODE, LMS2XX_MODE_38400);
	stream(b, 100 * MS);
	b->device.host_baud(b->device.ctx, 38400);
	SEND(b, LMS2XX_STATUS);
	stream(b, 100 * MS);
	assert_int_equal(b->command, LMS2XX_STATUS_REPLY);
	order(b, "power", 0, 500 * MS, true);
	SEND(b, LMS2XX_STATUS);
	const int replies = b->replies;
	stream(b, 500 * MS);
	assert_int_equal(b->replies, replies);
	b->device.host_baud(b->device.ctx, 9600);
	order(b, "power", 0, 500 * MS, false);
	stream(b, 100 * MS);
	assert_int_equal(b->command, LMS2XX_POWER_ON);
	order(b, "permanent baud", 38400, 0, true);
	order(b, "power", 0, 0, true);
	b->device.host_baud(b->device.ctx, 38400);
	b->command = 0;
	stream(b, 100 * MS);
	assert_int_equal(b->command, LMS2XX_POWER_ON);
	assert_int_equal(counts_of(b).power_cycles, 2);
}

static void silence_stall_and_garbage_end_with_the_order(void **state)
{
	struct bench *b = *state;
	SEND(b, LMS2XX_MODE, LMS2XX_MODE_STREAM);
	stream(b, 200 * MS);
	int before = b->scans;
	order(b, "silence", 0, 500 * MS, true);
	stream(b, 500 * MS);
	assert_int_equal(b->scans, before);
	order(b, "silence", 0, 500 * MS, false);
	stream(b, 200 * MS);
	assert_in_range(b->scans - before, 6, 8);
	before = b->scans;
	order(b, "stall", 0, 500 * MS, true);
	stream(b, 500 * MS);
	assert_int_equal(b->scans, before);
	order(b, "stall", 0, 500 * MS, false);
	stream(b, 200 * MS);
	assert_in_range(b->scans - before, 6, 9); /* while its line is busy a scanner skips scans */
	before = b->scans;
	order(b, "garbage", 0, 500 * MS, true);
	stream(b, 500 * MS);
	assert_in_range(counts_of(b).garbage, 24000, 25000); /* 50 kB/s */
	order(b, "garbage", 0, 500 * MS, false);
	stream(b, 300 * MS);
	assert_in_range(b->scans - before, 8, 12);
}

static void the_mirror_drifts_by_so_many_millionths(void **state)
{
	struct bench *b = *state;
	b->params.indices = true;
	restart(b);
	order(b, "drift", 1000, INT64_MAX, true);
	SEND(b, LMS2XX_MODE, LMS2XX_MODE_STREAM);
	stream(b, 100000 * MS);
	assert_in_range(counts_of(b).profiles, 3752, 3754);
}

static void an_unknown_fault_is_not_its_own(void **state)
{
	struct bench *b = *state;
	struct sim_fault fault = {.kind = "unplug"};
	assert_false(b->device.fault(b->device.ctx, &fault, true, b->now_ns));
}

int main(void)
{
#define BENCHED(name) cmocka_unit_test_setup_teardown(name, setup, teardown)
	const struct CMUnitTest tests[] = {
	    BENCHED(documented_requests_have_documented_answers),
	    BENCHED(single_faults_befall_the_next_request),
	    BENCHED(telegrams_that_leave_wrong_are_counted),
	    BENCHED(a_false_begin_costs_bytes_and_no_telegram),
	    BENCHED(bytes_come_one_by_one_and_with_gaps),
	    BENCHED(every_error_code_comes_in_every_width),
	    BENCHED(settings_change_what_is_sent),
	    BENCHED(a_slow_line_skips_scans_and_the_index_tells),
	    BENCHED(at_another_rate_both_directions_are_garbled),
	    BENCHED(power_falls_back_to_the_permanent_rate_and_says_90),
	    BENCHED(silence_stall_and_garbage_end_with_the_order),
	    BENCHED(the_mirror_drifts_by_so_many_millionths),
	    BENCHED(an_unknown_fault_is_not_its_own),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

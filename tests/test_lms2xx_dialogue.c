/* Law: from whatever state the scanner is in, and whatever gets lost on the way, the dialogue reaches the stream that was asked for
 * or says in a sentence why not; it writes an EEPROM only for a difference. Hours of it run in virtual time. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "drivers/driver.h"
#include "drivers/lms2xx.h"
#include "drivers/lms2xx_wire.h"

#define MS      1000000ll
#define SECONDS 1000000000ll
#define NEVER   INT64_MAX

enum { OUT = 64, REQUESTS = 64 };

/* A scanner in memory, in the world's virtual time, written apart from the simulator. */
struct scanner {
	bool deaf;
	uint32_t baud, power_on_baud;
	uint8_t mode;
	int fov_deg, resolution_cdeg;
	uint8_t config[34];
	bool wrong_password, refuses_config, refuses_variant, refuses_baud, forgets_config;
	uint8_t in[128];
	size_t in_len;
	int64_t in_ns;
	int64_t next_scan_ns;
	/* one fault, at the request with this number */
	int fault_at;
	enum { FAULT_NONE, FAULT_NAK, FAULT_NO_ACK, FAULT_NO_REPLY, FAULT_NOTHING, FAULT_REJECT } fault;
	/* what happened */
	int requests;
	uint8_t request[REQUESTS];
	int config_writes;
	uint8_t written[34];
};

struct chunk {
	int64_t t_ns;
	uint32_t baud;
	size_t len;
	uint8_t bytes[LMS2XX_TELEGRAM_MAX];
};

struct world {
	int64_t now_ns;
	struct scanner scanner;
	struct chunk out[OUT];
	int outs;
	uint32_t line_baud;
	struct config *config;
	struct decoder *decoder;
	struct dialogue *dialogue;
	struct dialogue_step step;
	int64_t due_ns;
	char note[160]; /* said with the stream */
	int losses;
	uint32_t line_max; /* the line takes no higher rate; 0: any */
	int profiles, bytes_written, writes;
	int64_t write_ns[REQUESTS]; /* of the first writes */
	uint32_t write_baud[REQUESTS];
	int64_t byte_ns, least_gap_ns;
	int stall_after;  /* the host is busy after this many bytes ... */
	int64_t stall_ns; /* ... for so long */
};

static void put(struct world *w, int64_t t_ns, const uint8_t *bytes, size_t len)
{
	assert_true(w->outs < OUT && len <= LMS2XX_TELEGRAM_MAX);
	struct chunk *c = &w->out[w->outs++];
	const int64_t free_ns = w->outs > 1 ? c[-1].t_ns : 0;
	*c = (struct chunk){.t_ns = t_ns > free_ns ? t_ns : free_ns + 1, .baud = w->scanner.baud, .len = len};
	memcpy(c->bytes, bytes, len);
}

static void put_payload(struct world *w, int64_t delay_ns, const uint8_t *payload, size_t len)
{
	uint8_t bytes[LMS2XX_TELEGRAM_MAX];
	const size_t n = lms2xx_encode(0x81, payload, len, bytes);
	put(w, w->now_ns + delay_ns + (int64_t)n * 10 * SECONDS / w->scanner.baud, bytes, n);
}

static void put_config(struct world *w, const uint8_t *front, size_t n)
{
	uint8_t p[40];
	memcpy(p, front, n);
	memcpy(p + n, w->scanner.config, 34);
	p[n + 34] = 0x10;
	put_payload(w, 20 * MS, p, n + 35);
}

static void put_status(struct world *w)
{
	uint8_t p[154] = {LMS2XX_STATUS_REPLY};
	p[107] = (uint8_t)w->scanner.fov_deg;
	p[109] = (uint8_t)w->scanner.resolution_cdeg;
	put_payload(w, 20 * MS, p, sizeof p);
}

static void take_mode(struct world *w, const uint8_t *p)
{
	struct scanner *s = &w->scanner;
	const uint32_t baud = lms2xx_mode_baud(p[1]);
	uint8_t result = 0;
	if (p[1] == LMS2XX_MODE_INSTALL && s->wrong_password)
		result = 1;
	else if (baud != 0 && s->refuses_baud)
		result = 2;
	else if (baud == 0)
		s->mode = p[1];
	s->next_scan_ns = s->mode == LMS2XX_MODE_STREAM || s->mode == LMS2XX_MODE_PARTS ? w->now_ns + 50 * MS : NEVER;
	put_payload(w, 10 * MS, (const uint8_t[]){LMS2XX_MODE_REPLY, result, 0x10}, 3);
	if (baud != 0 && result == 0)
		s->baud = baud; /* chunks keep the rate they were put at */
}

static void take_variant(struct world *w, const uint8_t *p)
{
	struct scanner *s = &w->scanner;
	assert_true(s->mode == LMS2XX_MODE_IDLE || s->mode == LMS2XX_MODE_INSTALL);
	if (!s->refuses_variant) {
		s->fov_deg = p[1];
		s->resolution_cdeg = p[3];
	}
	put_payload(w, 20 * MS, (const uint8_t[]){LMS2XX_VARIANT_REPLY, !s->refuses_variant, p[1], 0, p[3], 0, 0x10},
	            7);
}

static void take_config(struct world *w, const uint8_t *p, size_t len)
{
	struct scanner *s = &w->scanner;
	assert_int_equal(s->mode, LMS2XX_MODE_INSTALL);
	assert_int_equal(len, 35);
	s->config_writes++;
	memcpy(s->written, p + 1, 34);
	if (!s->refuses_config && !s->forgets_config)
		memcpy(s->config, p + 1, 34);
	put_config(w, (const uint8_t[]){LMS2XX_CONFIG_WRITTEN, !s->refuses_config}, 2);
}

static void answer(struct world *w, const uint8_t *p, size_t len)
{
	struct scanner *s = &w->scanner;
	const int fault = s->requests == s->fault_at ? (int)s->fault : FAULT_NONE;
	assert_true(s->requests < REQUESTS);
	s->request[s->requests++] = p[0];
	if (fault == FAULT_NAK) {
		put(w, w->now_ns + 10 * MS, (const uint8_t[]){LMS2XX_NAK}, 1);
		return;
	}
	if (fault == FAULT_NOTHING)
		return;
	if (fault != FAULT_NO_ACK)
		put(w, w->now_ns + 5 * MS, (const uint8_t[]){LMS2XX_ACK}, 1);
	if (fault == FAULT_REJECT)
		put_payload(w, 10 * MS, (const uint8_t[]){LMS2XX_REJECTED, 0x10}, 2);
	if (fault == FAULT_NO_REPLY || fault == FAULT_REJECT)
		return;
	switch (p[0]) {
	case LMS2XX_MODE:
		take_mode(w, p);
		break;
	case LMS2XX_TYPE:
		put_payload(w, 20 * MS, (const uint8_t[]){LMS2XX_TYPE_REPLY, 'L', 'M', 'S', 0x10}, 5);
		break;
	case LMS2XX_STATUS:
		put_status(w);
		break;
	case LMS2XX_CONFIG_READ:
		put_config(w, (const uint8_t[]){LMS2XX_CONFIG_REPLY}, 1);
		break;
	case LMS2XX_CONFIG_WRITE:
		take_config(w, p, len);
		break;
	case LMS2XX_VARIANT:
		take_variant(w, p);
		break;
	default:
		fail_msg("request %02x is none of the dialogue's", p[0]);
	}
}

/* The scanner drops what was begun when the gap is too long; its patience is the documented one. */
static void hear(struct world *w, const uint8_t *bytes, size_t len)
{
	struct scanner *s = &w->scanner;
	if (s->deaf || w->line_baud != s->baud)
		return;
	if (s->baud == 500000)
		assert_int_equal(len, 1); /* one by one, please */
	if (w->now_ns - s->in_ns > 14 * MS)
		s->in_len = 0;
	s->in_ns = w->now_ns;
	for (size_t i = 0; i < len && s->in_len < sizeof s->in; i++)
		s->in[s->in_len++] = bytes[i];
	const int n = s->in_len > 0 ? lms2xx_scan_host(NULL, s->in, s->in_len, true) : 0;
	if (n > 0) {
		s->in_len = 0;
		answer(w, s->in + 4, (size_t)n - 6);
	}
}

static void stream(struct world *w)
{
	struct scanner *s = &w->scanner;
	uint8_t words[2 * LMS2XX_BEAMS_MAX] = {0}, bytes[LMS2XX_TELEGRAM_MAX];
	const bool parts = s->mode == LMS2XX_MODE_PARTS;
	const int n = s->fov_deg * 100 / (parts ? 100 : s->resolution_cdeg) + 1;
	const struct lms2xx_scan scan = {.command = LMS2XX_SCAN,
	                                 .unit = s->config[LMS2XX_CONFIG_UNIT],
	                                 .n = (uint16_t)n,
	                                 .stride = 2,
	                                 .value = words,
	                                 .partial = parts,
	                                 .status = 0x10};
	const size_t len = lms2xx_encode_scan(&scan, bytes);
	const int64_t transfer_ns = (int64_t)len * 10 * SECONDS / s->baud;
	s->next_scan_ns = w->now_ns + (transfer_ns > 27 * MS ? transfer_ns : 27 * MS);
	if (w->outs < OUT / 2)
		put(w, w->now_ns + transfer_ns, bytes, len);
}

static void power_cycle(struct world *w, int64_t boot_ns)
{
	struct scanner *s = &w->scanner;
	s->baud = s->power_on_baud;
	s->mode = LMS2XX_MODE_IDLE;
	s->fov_deg = 180;
	s->resolution_cdeg = 50;
	s->next_scan_ns = NEVER;
	w->outs = 0;
	put_payload(w, boot_ns, (const uint8_t[]){LMS2XX_POWER_ON, 'L', 'M', 'S', 0x13}, 5);
}

static void on_profile(void *ctx, int device, const struct profile *p)
{
	struct world *w = ctx;
	(void)device;
	(void)p;
	w->profiles++;
	driver_lms2xx.dialogue_data(w->dialogue, w->now_ns);
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	struct world *w = ctx;
	(void)device;
	driver_lms2xx.dialogue_reply(w->dialogue, reply);
}

static void decode(struct world *w, enum direction direction, const uint8_t *bytes, size_t len)
{
	const struct record_sink sink = {.ctx = w, .profile = on_profile, .reply = on_reply};
	const struct record r = {
	    .log_ns = w->now_ns, .t_ns = w->now_ns, .direction = direction, .bytes = bytes, .len = len};
	driver_lms2xx.decode(w->decoder, &r, &sink);
}

static void note_write(struct world *w)
{
	const int64_t gap_ns = w->now_ns - w->byte_ns;
	if (w->writes < REQUESTS) {
		w->write_baud[w->writes] = w->line_baud;
		w->write_ns[w->writes++] = w->now_ns;
	}
	if (w->bytes_written > 0) {
		w->least_gap_ns = gap_ns < w->least_gap_ns ? gap_ns : w->least_gap_ns;
	}
	w->byte_ns = w->now_ns;
	w->bytes_written += (int)w->step.write_len;
}

/* As the supervisor does: closed, opened again after a while. */
static void lose_line(struct world *w, int64_t after_ns)
{
	w->losses++;
	w->outs = 0;
	w->now_ns += after_ns;
	driver_lms2xx.dialogue_reset(w->dialogue, w->now_ns);
	w->due_ns = w->now_ns;
	w->step.state = DIALOGUE_CONFIGURING;
}

static void act(struct world *w)
{
	driver_lms2xx.dialogue_step(w->dialogue, w->now_ns, &w->step);
	w->due_ns = w->step.deadline_ns;
	assert_true(w->due_ns > w->now_ns || w->step.write_len > 0);
	if (w->step.state == DIALOGUE_STREAMING && w->step.error[0] != 0)
		strcpy(w->note, w->step.error);
	else if (w->step.state == DIALOGUE_STREAMING)
		w->note[0] = 0;
	if (w->step.write_len > 0) {
		note_write(w);
		decode(w, TO_DEVICE, w->step.write, w->step.write_len);
		hear(w, w->step.write, w->step.write_len);
		if (w->stall_after != 0 && w->bytes_written >= w->stall_after) {
			w->due_ns += w->stall_ns;
			w->stall_after = 0;
		}
	}
	if (w->step.baud != 0 && w->line_max != 0 && w->step.baud > w->line_max)
		lose_line(w, 250 * MS);
	else if (w->step.baud != 0)
		w->line_baud = w->step.baud;
	if (w->step.flush)
		w->outs = 0;
}

static void deliver(struct world *w)
{
	const struct chunk c = w->out[0];
	memmove(w->out, w->out + 1, sizeof w->out[0] * (size_t)--w->outs);
	uint8_t garbled[LMS2XX_TELEGRAM_MAX];
	for (size_t i = 0; i < c.len; i++)
		garbled[i] = (uint8_t)(c.bytes[i] * 5 + i);
	decode(w, FROM_DEVICE, c.baud == w->line_baud ? c.bytes : garbled, c.len);
	act(w);
}

/* Until `end` or the dialogue is in `state`. */
static void run(struct world *w, int64_t end_ns, int state)
{
	while (w->now_ns < end_ns && (int)w->step.state != state) {
		int64_t next_ns = end_ns;
		if (w->due_ns < next_ns)
			next_ns = w->due_ns;
		if (w->outs > 0 && w->out[0].t_ns < next_ns)
			next_ns = w->out[0].t_ns;
		if (w->scanner.next_scan_ns < next_ns)
			next_ns = w->scanner.next_scan_ns;
		w->now_ns = next_ns > w->now_ns ? next_ns : w->now_ns;
		if (w->outs > 0 && w->out[0].t_ns <= w->now_ns)
			deliver(w);
		else if (w->scanner.next_scan_ns <= w->now_ns)
			stream(w);
		else if (w->due_ns <= w->now_ns)
			act(w);
	}
}

static void begin(struct world *w)
{
	w->decoder = driver_lms2xx.decoder_create(&w->config->device[0], 0);
	w->dialogue = driver_lms2xx.dialogue_create(w->config, 0);
	driver_lms2xx.dialogue_reset(w->dialogue, w->now_ns);
	w->due_ns = w->now_ns;
	w->step.state = DIALOGUE_CONFIGURING;
}

static void end(struct world *w)
{
	driver_lms2xx.decoder_destroy(w->decoder);
	driver_lms2xx.dialogue_destroy(w->dialogue);
	w->decoder = NULL;
	w->dialogue = NULL;
}

static void fresh(struct world *w)
{
	struct config *config = w->config;
	end(w);
	*w = (struct world){.now_ns = 100 * SECONDS, .config = config, .least_gap_ns = NEVER};
	w->scanner = (struct scanner){.baud = 9600,
	                              .power_on_baud = 9600,
	                              .mode = LMS2XX_MODE_IDLE,
	                              .fov_deg = 180,
	                              .resolution_cdeg = 50,
	                              .next_scan_ns = NEVER,
	                              .fault_at = -1};
	for (int i = 0; i < 34; i++)
		w->scanner.config[i] = (uint8_t)(i + 50);
	w->scanner.config[LMS2XX_CONFIG_MODE] = 0x05;
	w->scanner.config[LMS2XX_CONFIG_UNIT] = LMS2XX_MM;
	memset(config, 0, sizeof *config);
	config->devices = 1;
	config->device[0] = (struct config_device){.baud = 500000, .fov_deg = 180, .resolution_cdeg = 50, .mode = -1};
}

static int setup(void **state)
{
	struct world *w = calloc(1, sizeof *w);
	w->config = calloc(1, sizeof *w->config);
	fresh(w);
	*state = w;
	return 0;
}

static int teardown(void **state)
{
	struct world *w = *state;
	end(w);
	free(w->config);
	free(w);
	return 0;
}

/* It streams, at the wanted rate, and profiles come. */
static void must_stream(struct world *w, int64_t within_ns)
{
	run(w, w->now_ns + within_ns, DIALOGUE_STREAMING);
	assert_int_equal(w->step.state, DIALOGUE_STREAMING);
	assert_true(w->note[0] != 0 || w->line_baud == w->config->device[0].baud);
	const int before = w->profiles;
	run(w, w->now_ns + SECONDS, -1);
	assert_true(w->profiles > before);
}

static void a_scanner_as_from_the_factory_streams_within_seconds(void **state)
{
	struct world *w = *state;
	begin(w);
	must_stream(w, 10 * SECONDS);
	assert_int_equal(w->scanner.config_writes, 0);
	static const uint8_t asked[] = {0x20, 0x3A, 0x31, 0x74, 0x20, 0x31, 0x20};
	assert_int_equal(w->scanner.requests, sizeof asked);
	assert_memory_equal(w->scanner.request, asked, sizeof asked);
}

static void it_is_found_at_every_rate_also_while_it_streams(void **state)
{
	struct world *w = *state;
	static const uint32_t bauds[] = {9600, 19200, 38400, 500000};
	for (int is = 0; is < 4; is++) {
		for (int wanted = 0; wanted < 4; wanted++) {
			for (int streams = 0; streams < 3; streams++) {
				fresh(w);
				w->scanner.baud = bauds[is];
				w->config->device[0].baud = bauds[wanted];
				if (streams > 0) {
					w->scanner.mode = streams == 1 ? LMS2XX_MODE_STREAM : LMS2XX_MODE_PARTS;
					w->scanner.next_scan_ns = w->now_ns;
				}
				begin(w);
				must_stream(w, 20 * SECONDS);
			}
		}
	}
}

static void only_what_differs_is_written_and_only_once(void **state)
{
	struct world *w = *state;
	uint8_t was[34];
	w->config->device[0].range_unit = UNIT_CM;
	w->config->device[0].mode = 0x03;
	memcpy(was, w->scanner.config, 34);
	begin(w);
	must_stream(w, 10 * SECONDS);
	assert_int_equal(w->scanner.config_writes, 1);
	was[LMS2XX_CONFIG_MODE] = 0x03;
	was[LMS2XX_CONFIG_UNIT] = LMS2XX_CM;
	assert_memory_equal(w->scanner.written, was, 34);
	end(w);
	begin(w); /* the next start */
	must_stream(w, 10 * SECONDS);
	assert_int_equal(w->scanner.config_writes, 1);
	w->config->device[0].range_unit = UNIT_MM;
	w->config->device[0].mode = -1;
	end(w);
	begin(w);
	must_stream(w, 10 * SECONDS);
	assert_int_equal(w->scanner.config_writes, 2);
	assert_int_equal(w->scanner.config[LMS2XX_CONFIG_MODE], 0x03);
}

static void variants_are_switched_only_where_they_differ(void **state)
{
	struct world *w = *state;
	w->config->device[0].fov_deg = 100;
	w->config->device[0].resolution_cdeg = 25;
	begin(w);
	must_stream(w, 10 * SECONDS);
	assert_int_equal(w->scanner.resolution_cdeg, 25);
	assert_int_equal(w->scanner.fov_deg, 100);
	fresh(w);
	w->config->device[0].resolution_cdeg = 25; /* over 180 degrees: partial scans */
	begin(w);
	must_stream(w, 10 * SECONDS);
	assert_int_equal(w->scanner.mode, LMS2XX_MODE_PARTS);
	for (int i = 0; i < w->scanner.requests; i++)
		assert_int_not_equal(w->scanner.request[i], LMS2XX_VARIANT);
}

static void any_single_fault_at_any_request_is_overcome(void **state)
{
	struct world *w = *state;
	for (int fault = FAULT_NAK; fault <= FAULT_REJECT; fault++) {
		for (int at = 0; at < 12; at++) {
			fresh(w);
			w->config->device[0].mode = 0x01;
			w->config->device[0].fov_deg = 100;
			w->scanner.fault = fault;
			w->scanner.fault_at = at;
			begin(w);
			must_stream(w, 40 * SECONDS);
			assert_true(at >= 11 || w->scanner.requests > at);
			assert_in_range(w->scanner.config_writes, 1, 2);
		}
	}
}

static void after_a_nak_the_scanner_is_left_alone_for_30_ms(void **state)
{
	struct world *w = *state;
	w->config->device[0].baud = 9600;
	w->scanner.fault = FAULT_NAK;
	w->scanner.fault_at = 2;
	begin(w);
	run(w, w->now_ns + 20 * SECONDS, DIALOGUE_STREAMING);
	assert_int_equal(w->scanner.request[2], LMS2XX_STATUS);
	assert_int_equal(w->scanner.request[3], LMS2XX_STATUS);
	/* The NAK comes after 10 ms here. */
	assert_int_equal(w->write_ns[3] - w->write_ns[2], 10 * MS + 30 * MS);
}

static void at_500_kbd_bytes_go_one_by_one(void **state)
{
	struct world *w = *state;
	w->scanner.baud = 500000;
	begin(w);
	must_stream(w, 5 * SECONDS);
	assert_int_equal(w->least_gap_ns, 1 * MS);
}

static void a_gap_beyond_6_ms_repeats_the_telegram_after_30_ms(void **state)
{
	struct world *w = *state;
	for (int after = 1; after < 20; after++) {
		fresh(w);
		w->scanner.baud = 500000;
		w->stall_after = after;
		w->stall_ns = 5500000; /* with the tick: 6.5 ms */
		begin(w);
		must_stream(w, 10 * SECONDS);
		/* 20 25, then 3A, then 31: bytes at which a telegram is not yet complete cost one repetition. */
		const bool inside = after != 8 && after != 15;
		static const int all = 8 + 7 + 7 + 7 + 8;
		const int lost = after < 8 ? after : after < 15 ? after - 8 : after < 22 ? after - 15 : 0;
		assert_int_equal(w->bytes_written, all + (inside ? lost : 0));
		assert_int_equal(w->scanner.requests, 5);
	}
	fresh(w);
	w->scanner.baud = 500000;
	w->stall_after = 3;
	w->stall_ns = 4 * MS; /* with the tick: 5 ms, which the scanner bears */
	begin(w);
	must_stream(w, 10 * SECONDS);
	assert_int_equal(w->bytes_written, 8 + 7 + 7 + 7 + 8);
}

static void a_host_that_is_always_late_is_told_apart_from_hope(void **state)
{
	struct world *w = *state;
	w->scanner.baud = 500000;
	begin(w);
	const int64_t end_ns = w->now_ns + 600 * SECONDS;
	while (w->now_ns < end_ns && w->step.state == DIALOGUE_CONFIGURING) {
		w->stall_after = 1;
		w->stall_ns = 10 * MS;
		run(w, w->now_ns + 5 * MS, DIALOGUE_FAILED);
	}
	assert_int_equal(w->step.state, DIALOGUE_FAILED);
}

static void nobody_there_is_said_in_a_sentence(void **state)
{
	struct world *w = *state;
	w->scanner.deaf = true;
	begin(w);
	run(w, w->now_ns + 30 * SECONDS, DIALOGUE_FAILED);
	assert_string_equal(
	    w->step.error,
	    "no scanner answers at 500000, 9600, 38400, 19200 Bd: check its power, the cable, and `port`");
	int at_9600 = 0;
	for (int i = 0; i < w->writes; i++)
		at_9600 += w->write_baud[i] == 9600;
	assert_int_equal(at_9600,
	                 2); /* it is asked twice at a rate: its first answer may be lost behind a measurement */
	/* The supervisor comes back later, and then somebody is there. */
	w->scanner.deaf = false;
	driver_lms2xx.dialogue_reset(w->dialogue, w->now_ns);
	w->step = (struct dialogue_step){0};
	w->due_ns = w->now_ns;
	must_stream(w, 20 * SECONDS);
}

static void refusals_are_said_in_a_sentence(void **state)
{
	struct world *w = *state;
	static const char *const says[] = {"refuses the password", "does not take its new settings",
	                                   "does not know this variant"};
	for (int i = 0; i < 3; i++) {
		fresh(w);
		w->config->device[0].mode = i < 2 ? 0x01 : -1;
		w->config->device[0].fov_deg = i == 2 ? 100 : 180;
		w->scanner.wrong_password = i == 0;
		w->scanner.refuses_config = i == 1;
		w->scanner.refuses_variant = i == 2;
		begin(w);
		run(w, w->now_ns + 60 * SECONDS, DIALOGUE_FAILED);
		assert_int_equal(w->step.state, DIALOGUE_FAILED);
		assert_non_null(strstr(w->step.error, says[i]));
	}
}

static void a_power_cycle_while_streaming_sets_everything_up_anew(void **state)
{
	struct world *w = *state;
	static const uint32_t power_on_bauds[] = {9600, 500000}; /* the latter: told to keep its rate */
	for (int i = 0; i < 2; i++) {
		fresh(w);
		w->scanner.power_on_baud = power_on_bauds[i];
		w->config->device[0].fov_deg = 100;
		begin(w);
		must_stream(w, 20 * SECONDS);
		power_cycle(w, 10 * SECONDS);
		run(w, w->now_ns + 20 * SECONDS, DIALOGUE_CONFIGURING);
		assert_int_equal(w->step.state, DIALOGUE_CONFIGURING);
		must_stream(w, 60 * SECONDS);
		assert_int_equal(w->scanner.fov_deg, 100);
	}
}

static void a_message_of_power_on_is_not_waited_after(void **state)
{
	struct world *w = *state;
	w->scanner.power_on_baud = 500000;
	begin(w);
	must_stream(w, 20 * SECONDS);
	power_cycle(w, 100 * MS);
	const int64_t since_ns = w->now_ns;
	run(w, w->now_ns + 20 * SECONDS, DIALOGUE_CONFIGURING);
	assert_in_range(w->now_ns - since_ns, 100 * MS, 200 * MS);
	must_stream(w, 20 * SECONDS);
}

static void an_acknowledgement_behind_a_measurement_is_waited_for(void **state)
{
	struct world *w = *state;
	w->config->device[0].baud = 9600;
	w->scanner.mode = LMS2XX_MODE_STREAM;
	w->scanner.next_scan_ns = w->now_ns + 29 * MS; /* takes 762 ms */
	begin(w);
	must_stream(w, 20 * SECONDS);
	assert_int_equal(w->scanner.request[0], LMS2XX_MODE);
	assert_int_equal(w->scanner.request[1], LMS2XX_TYPE);
}

static void two_seconds_of_silence_begin_anew(void **state)
{
	struct world *w = *state;
	begin(w);
	must_stream(w, 20 * SECONDS);
	w->scanner.mode = LMS2XX_MODE_IDLE; /* somebody else's stop */
	w->scanner.next_scan_ns = NEVER;
	const int64_t since_ns = w->now_ns;
	run(w, w->now_ns + 20 * SECONDS, DIALOGUE_CONFIGURING);
	assert_in_range(w->now_ns - since_ns, 1900 * MS, 2100 * MS);
	must_stream(w, 20 * SECONDS);
}

static void the_stop_is_sent_and_ends_it(void **state)
{
	struct world *w = *state;
	begin(w);
	must_stream(w, 20 * SECONDS);
	driver_lms2xx.dialogue_stop(w->dialogue, w->now_ns);
	w->due_ns = w->now_ns;
	run(w, w->now_ns + 2 * SECONDS, DIALOGUE_FAILED);
	assert_int_equal(w->step.state, DIALOGUE_FAILED);
	assert_string_equal(w->step.error, "");
	assert_int_equal(w->scanner.mode, LMS2XX_MODE_IDLE);
}

static void a_stop_ends_in_any_state_whoever_is_there(void **state)
{
	struct world *w = *state;
	for (int i = 0; i < 300; i++) {
		fresh(w);
		begin(w);
		run(w, w->now_ns + i * 20 * MS, -1);
		w->scanner.deaf = i % 2 == 0;
		driver_lms2xx.dialogue_stop(w->dialogue, w->now_ns);
		w->due_ns = w->now_ns;
		run(w, w->now_ns + 10 * SECONDS, DIALOGUE_FAILED);
		assert_int_equal(w->step.state, DIALOGUE_FAILED);
		assert_string_equal(w->step.error, "");
	}
}

static void a_rate_the_line_broke_at_twice_is_not_searched_again(void **state)
{
	struct world *w = *state;
	w->scanner.deaf = true;
	w->config->device[0].baud = 38400;
	w->line_max = 115200;
	begin(w);
	run(w, w->now_ns + 30 * SECONDS, DIALOGUE_FAILED);
	assert_int_equal(w->losses, 2);
	assert_string_equal(w->step.error,
	                    "no scanner answers at 38400, 9600, 19200 Bd: check its power, the cable, and `port`");
}

/* A 16550 keeps its old rate: the link says so once, and what works is streamed at. */
static void a_rate_the_line_refuses_is_replaced_by_the_next_lower(void **state)
{
	struct world *w = *state;
	static const uint32_t highest[] = {9600, 19200, 38400, 115200, 9600};
	for (int i = 0; i < 5; i++) {
		fresh(w);
		w->config->device[0].baud = i < 4 ? 500000 : 38400;
		w->line_max = highest[i];
		begin(w);
		must_stream(w, 20 * SECONDS);
		assert_int_equal(w->line_baud, highest[i] == 115200 ? 38400 : highest[i]);
		assert_non_null(strstr(w->note, i < 4 ? "the line refuses 500000" : "the line refuses 38400"));
		/* Unplugged, and plugged in again behind an adapter that knows the rate. */
		w->line_max = 0;
		lose_line(w, SECONDS);
		must_stream(w, 20 * SECONDS);
		assert_string_equal(w->note, "");
		assert_int_equal(w->line_baud, w->config->device[0].baud);
	}
}

static void a_plug_pulled_while_the_rate_is_set_is_no_refusal(void **state)
{
	struct world *w = *state;
	begin(w);
	act(w);
	assert_int_equal(w->step.baud, 500000);
	lose_line(w, SECONDS);
	must_stream(w, 20 * SECONDS);
	assert_int_equal(w->line_baud, 500000);
	assert_string_equal(w->note, "");
}

static void a_rate_the_scanner_refuses_is_said_and_done_without(void **state)
{
	struct world *w = *state;
	w->scanner.refuses_baud = true;
	begin(w);
	must_stream(w, 20 * SECONDS);
	assert_int_equal(w->line_baud, 9600);
	assert_string_equal(w->note,
	                    "streams at 9600 Bd: the scanner refuses 500000, set `baud` to a rate that it knows");
}

static void indices_are_switched_on_once_and_only_if_asked_for(void **state)
{
	struct world *w = *state;
	begin(w);
	must_stream(w, 20 * SECONDS);
	assert_int_equal(w->scanner.config_writes, 0);
	end(w);
	w->config->device[0].indices = INDICES_ON;
	uint8_t was[34];
	w->scanner.config[LMS2XX_CONFIG_AVAILABILITY] = 0x05;
	memcpy(was, w->scanner.config, 34);
	begin(w);
	must_stream(w, 20 * SECONDS);
	was[LMS2XX_CONFIG_AVAILABILITY] = 0x07; /* bit 1 */
	assert_memory_equal(w->scanner.written, was, 34);
	for (int i = 0; i < 3; i++) {
		end(w);
		begin(w);
		must_stream(w, 20 * SECONDS);
	}
	assert_int_equal(w->scanner.config_writes, 1);
}

/* Its memory wears: who does not keep what it took is not asked for ever. */
static void a_scanner_that_forgets_its_settings_is_written_three_times_at_most(void **state)
{
	struct world *w = *state;
	w->config->device[0].indices = INDICES_ON;
	w->scanner.config[LMS2XX_CONFIG_AVAILABILITY] = 0;
	w->scanner.forgets_config = true;
	begin(w);
	for (int i = 0; i < 20; i++) {
		run(w, w->now_ns + 10 * SECONDS, DIALOGUE_FAILED);
		w->step = (struct dialogue_step){0};
		w->scanner.requests = 0;
		lose_line(w, SECONDS);
	}
	assert_int_equal(w->scanner.config_writes, 3);
}

/* What was never sent wears nothing. */
static void a_scanner_that_refused_its_password_is_written_once_it_takes_it(void **state)
{
	struct world *w = *state;
	w->config->device[0].indices = INDICES_ON;
	w->scanner.config[LMS2XX_CONFIG_AVAILABILITY] = 0;
	w->scanner.wrong_password = true;
	begin(w);
	for (int i = 0; i < 6; i++) {
		run(w, w->now_ns + 30 * SECONDS, DIALOGUE_FAILED);
		assert_non_null(strstr(w->step.error, "refuses the password"));
		w->step = (struct dialogue_step){0};
		w->scanner.requests = 0;
		lose_line(w, SECONDS);
	}
	w->scanner.wrong_password = false;
	must_stream(w, 60 * SECONDS);
	assert_int_equal(w->scanner.config_writes, 1);
}

static void a_power_cycle_while_it_is_set_up_begins_anew(void **state)
{
	struct world *w = *state;
	static const uint32_t power_on_bauds[] = {9600, 500000};
	for (int i = 0; i < 2; i++)
		for (int at = 0; at < 60; at++) {
			fresh(w);
			w->scanner.power_on_baud = w->scanner.baud = power_on_bauds[i];
			w->config->device[0].fov_deg = 100;
			w->config->device[0].indices = INDICES_ON;
			w->scanner.config[LMS2XX_CONFIG_AVAILABILITY] = 0;
			begin(w);
			run(w, w->now_ns + at * 20 * MS, DIALOGUE_STREAMING);
			power_cycle(w, 300 * MS);
			w->scanner.deaf = true; /* as long as it starts */
			run(w, w->now_ns + 299 * MS, -1);
			w->scanner.deaf = false;
			run(w, w->now_ns + 10 * MS, -1);
			must_stream(w, 60 * SECONDS);
			assert_int_equal(w->scanner.fov_deg, 100);
			assert_int_equal(w->scanner.config_writes, 1);
		}
}

int main(void)
{
#define RIGGED(name) cmocka_unit_test_setup_teardown(name, setup, teardown)
	const struct CMUnitTest tests[] = {
	    RIGGED(a_scanner_as_from_the_factory_streams_within_seconds),
	    RIGGED(it_is_found_at_every_rate_also_while_it_streams),
	    RIGGED(only_what_differs_is_written_and_only_once),
	    RIGGED(variants_are_switched_only_where_they_differ),
	    RIGGED(any_single_fault_at_any_request_is_overcome),
	    RIGGED(after_a_nak_the_scanner_is_left_alone_for_30_ms),
	    RIGGED(at_500_kbd_bytes_go_one_by_one),
	    RIGGED(a_gap_beyond_6_ms_repeats_the_telegram_after_30_ms),
	    RIGGED(a_host_that_is_always_late_is_told_apart_from_hope),
	    RIGGED(nobody_there_is_said_in_a_sentence),
	    RIGGED(refusals_are_said_in_a_sentence),
	    RIGGED(a_power_cycle_while_streaming_sets_everything_up_anew),
	    RIGGED(a_message_of_power_on_is_not_waited_after),
	    RIGGED(an_acknowledgement_behind_a_measurement_is_waited_for),
	    RIGGED(two_seconds_of_silence_begin_anew),
	    RIGGED(the_stop_is_sent_and_ends_it),
	    RIGGED(a_stop_ends_in_any_state_whoever_is_there),
	    RIGGED(a_rate_the_line_broke_at_twice_is_not_searched_again),
	    RIGGED(a_rate_the_line_refuses_is_replaced_by_the_next_lower),
	    RIGGED(a_plug_pulled_while_the_rate_is_set_is_no_refusal),
	    RIGGED(a_rate_the_scanner_refuses_is_said_and_done_without),
	    RIGGED(indices_are_switched_on_once_and_only_if_asked_for),
	    RIGGED(a_scanner_that_forgets_its_settings_is_written_three_times_at_most),
	    RIGGED(a_scanner_that_refused_its_password_is_written_once_it_takes_it),
	    RIGGED(a_power_cycle_while_it_is_set_up_begins_anew),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

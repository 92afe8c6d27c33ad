/* Law: whatever a scanner with CoLa is doing, in either dialect, the dialogue reaches the stream that was asked for, writes only
 * what differs, and otherwise says in a sentence why not; silence is noticed within five scans. All in virtual time. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "drivers/cola.h"

#define MS      1000000ll
#define SECONDS 1000000000ll
#define NEVER   INT64_MAX
#define DEG     0.017453292519943295

enum { OUT = 64, REQUESTS = 128, FRAME = 256 };

/* A scanner in memory, in the world's virtual time, written apart from the simulator. */
struct scanner {
	bool deaf;        /* answers nothing, sends nothing */
	bool speaks[2];   /* by dialect */
	bool safe;        /* its stream is LMDscandatamon, its password another */
	bool no_login;    /* refuses every password */
	bool few;         /* knows no variable of the settings (TiM) */
	bool stands;      /* acknowledges streaming and sends nothing until it was started */
	bool never_sends; /* ... at all */
	bool stays_off;   /* answers that the stream is off, whatever was asked */
	const char *model, *version, *serial;
	int64_t answer_ns;
	uint32_t frequency_chz, resolution_tdeg;
	int32_t from_tdeg, to_tdeg, out_from_tdeg, out_to_tdeg;
	uint32_t out_step_tdeg;
	uint8_t data[11];
	uint16_t every;
	uint32_t licencset, licsrc, licencres, do3and4;
	uint16_t stlms;
	int64_t ready_ns; /* STlms says 7 from here on */
	uint8_t set_result, start_result, run_result;
	/* one request in trouble, by its name */
	const char *trouble;
	int trouble_times; /* the first so many; -1: always */
	enum { NO_TROUBLE, REFUSE, SILENCE, LATER, LATE } kind;
	uint32_t code;
	int64_t delay_ns;
	/* what it does */
	int level;
	bool streams;
	bool garbage; /* before every answer */
	int64_t period_ns, next_scan_ns;
};

struct world {
	int64_t now_ns;
	struct scanner scanner;
	struct {
		int64_t t_ns;
		size_t len;
		uint8_t bytes[FRAME];
	} out[OUT];
	int outs;
	struct framer device, host; /* of what each of them receives */
	uint8_t device_buf[2 * FRAME], host_buf[4 * FRAME];
	struct config *config;
	struct dialogue *dialogue;
	struct dialogue_step step;
	int64_t due_ns, connected_ns; /* writes are taken from then on */
	uint8_t unwritten[DIALOGUE_WRITE_MAX];
	size_t unwritten_len;
	bool ended;
	int scans;
	/* what was asked */
	int requests;
	char request[REQUESTS][40]; /* "sRN LMPscancfg" */
	enum cola_dialect dialect[REQUESTS];
	uint8_t bytes[REQUESTS][FRAME];
	size_t len[REQUESTS];
	int64_t asked_ns[REQUESTS];
};

/* The scanner ---------------------------------------------------------------------------------------------------- */

static void put(struct world *w, int64_t t_ns, const uint8_t *bytes, size_t len)
{
	assert_true(w->outs < OUT && len <= FRAME);
	int i = w->outs++;
	for (; i > 0 && w->out[i - 1].t_ns > t_ns; i--)
		w->out[i] = w->out[i - 1];
	w->out[i].t_ns = t_ns;
	w->out[i].len = len;
	memcpy(w->out[i].bytes, bytes, len);
}

static void put_frame(struct world *w, struct cola_writer *writer, int64_t delay_ns)
{
	static const uint8_t garbage[] = {0x02, 0x55, 0x02, 0x02, 0x73, 0x03, 0xff, 0x02, 0x02, 0x02, 0x02, 0x00};
	const size_t len = cola_writer_end(writer);
	assert_true(len > 0);
	if (w->scanner.garbage)
		put(w, w->now_ns + delay_ns, garbage, sizeof garbage);
	put(w, w->now_ns + delay_ns, writer->bytes, len);
}

static void put_error(struct world *w, enum cola_dialect dialect, uint32_t code)
{
	uint8_t bytes[FRAME];
	struct cola_writer a;
	cola_writer_init(&a, dialect, bytes, sizeof bytes, "sFA");
	cola_write_u(&a, code, 2);
	put_frame(w, &a, w->scanner.answer_ns);
}

static bool is(const char *text, const char *other)
{
	return strcmp(text, other) == 0;
}

static bool is_setting(const char *name)
{
	return strncmp(name, "LMP", 3) == 0 || strncmp(name, "LIC", 3) == 0 || is(name, "LMDscandatacfg") ||
	       is(name, "mLMPsetscancfg") || is(name, "DO3And4Fnc") || is(name, "STlms") || is(name, "DeviceIdent") ||
	       is(name, "FirmwareVersion") || is(name, "SerialNumber");
}

/* The values of a read. False: unknown. */
static bool tell(struct world *w, const char *name, struct cola_writer *a)
{
	const struct scanner *s = &w->scanner;
	if (is(name, "DeviceIdent") || is(name, "0")) {
		cola_write_string(a, s->model, strlen(s->model), 2);
		cola_write_string(a, s->version, strlen(s->version), 2);
	} else if (is(name, "FirmwareVersion")) {
		cola_write_string(a, s->version, strlen(s->version), 2);
	} else if (is(name, "SerialNumber")) {
		cola_write_string(a, s->serial, strlen(s->serial), 2);
	} else if (is(name, "SCdevicestate")) {
		cola_write_u(a, 0, 1);
	} else if (is(name, "LMPscancfg")) {
		cola_write_u(a, s->frequency_chz, 4);
		cola_write_i(a, 1, 2);
		cola_write_u(a, s->resolution_tdeg, 4);
		cola_write_i(a, s->from_tdeg, 4);
		cola_write_i(a, s->to_tdeg, 4);
	} else if (is(name, "LMPoutputRange")) {
		cola_write_u(a, 1, 2);
		cola_write_u(a, s->out_step_tdeg, 4);
		cola_write_i(a, s->out_from_tdeg, 4);
		cola_write_i(a, s->out_to_tdeg, 4);
	} else if (is(name, "LMDscandatacfg")) {
		for (int i = 0; i < 11; i++)
			cola_write_u(a, s->data[i], 1);
		cola_write_u(a, s->every, 2);
	} else if (is(name, "LICencset")) {
		cola_write_u(a, s->licencset, 1);
	} else if (is(name, "LICsrc")) {
		cola_write_u(a, s->licsrc, 1);
	} else if (is(name, "LICencres")) {
		cola_write_u(a, s->licencres, 4);
	} else if (is(name, "DO3And4Fnc")) {
		cola_write_u(a, s->do3and4, 1);
	} else if (is(name, "STlms")) {
		cola_write_u(a, w->now_ns >= s->ready_ns ? 7 : s->stlms, 2);
		cola_write_u(a, 0, 1);
	} else {
		return false;
	}
	return true;
}

static void take_setting(struct scanner *s, const char *name, struct cola_reader *r)
{
	if (is(name, "mLMPsetscancfg")) {
		s->frequency_chz = cola_read_u(r, 4);
		assert_int_equal(cola_read_i(r, 2), 1);
		s->resolution_tdeg = cola_read_u(r, 4);
		s->from_tdeg = cola_read_i(r, 4);
		s->to_tdeg = cola_read_i(r, 4);
	} else if (is(name, "LMPoutputRange")) {
		assert_int_equal(cola_read_u(r, 2), 1);
		s->out_step_tdeg = cola_read_u(r, 4);
		s->out_from_tdeg = cola_read_i(r, 4);
		s->out_to_tdeg = cola_read_i(r, 4);
	} else if (is(name, "LMDscandatacfg")) {
		for (int i = 0; i < 11; i++)
			s->data[i] = (uint8_t)cola_read_u(r, 1);
		s->every = (uint16_t)cola_read_u(r, 2);
	} else if (is(name, "LICencset")) {
		s->licencset = cola_read_u(r, 1);
	} else if (is(name, "LICsrc")) {
		s->licsrc = cola_read_u(r, 1);
	} else if (is(name, "LICencres")) {
		s->licencres = cola_read_u(r, 4);
	} else if (is(name, "DO3And4Fnc")) {
		s->do3and4 = cola_read_u(r, 1);
	}
	assert_true(cola_reader_done(r));
}

/* A result, or an error code (negated); LOGIN and the like. */
static int do_method(struct world *w, const char *name, struct cola_reader *r)
{
	struct scanner *s = &w->scanner;
	if (is(name, "SetAccessMode")) {
		const uint32_t level = cola_read_u(r, 1), hash = cola_read_u(r, 4);
		const bool good = !s->no_login && level == 3 && hash == (s->safe ? 0x6FD62C05u : 0xF4724744u);
		s->level = good ? 3 : s->level;
		return good;
	}
	if (is(name, "Run")) {
		s->level = 0;
		return s->run_result;
	}
	if (s->level < 3)
		return -1;
	if (is(name, "mLMPsetscancfg")) {
		if (s->set_result == 0)
			take_setting(s, name, r);
		return s->set_result;
	}
	if (is(name, "LMCstartmeas")) {
		s->stands = false;
		s->stlms = s->stlms == 3 ? 7 : s->stlms;
		return s->start_result;
	}
	return -2;
}

static void answer(struct world *w, enum cola_dialect dialect, const char *command, const char *name,
                   struct cola_reader *r)
{
	struct scanner *s = &w->scanner;
	uint8_t bytes[FRAME];
	char words[48];
	struct cola_writer a;
	const char *reply = is(command, "sRN") || is(command, "sRI") ? "sRA"
	                    : is(command, "sWN")                     ? "sWA"
	                    : is(command, "sMN")                     ? "sAN"
	                                                             : "sEA";
	snprintf(words, sizeof words, "%s %s", reply, name);
	cola_writer_init(&a, dialect, bytes, sizeof bytes, words);
	if ((s->few && is_setting(name)) || (is(reply, "sRA") && !tell(w, name, &a))) {
		put_error(w, dialect, 3);
		return;
	}
	if (is(reply, "sWA") && s->level < 3) {
		put_error(w, dialect, 0xa);
		return;
	}
	if (is(reply, "sWA"))
		take_setting(s, name, r);
	if (is(reply, "sAN")) {
		const int result = do_method(w, name, r);
		if (result < 0) {
			put_error(w, dialect, (uint32_t)-result);
			return;
		}
		cola_write_u(&a, (uint32_t)result, 1);
	}
	if (is(reply, "sEA")) {
		if (!is(name, s->safe ? "LMDscandatamon" : "LMDscandata")) {
			put_error(w, dialect, 0xf);
			return;
		}
		s->streams = cola_read_u(r, 1);
		s->next_scan_ns = s->streams ? w->now_ns + s->answer_ns + s->period_ns : NEVER;
		s->streams = s->streams && !s->stays_off;
		cola_write_u(&a, s->streams, 1);
	}
	put_frame(w, &a, s->kind == LATE && s->trouble && is(s->trouble, name) ? s->delay_ns : s->answer_ns);
}

/* True: the trouble was all there was. */
static bool make_trouble(struct world *w, enum cola_dialect dialect, const char *name)
{
	struct scanner *s = &w->scanner;
	uint8_t bytes[FRAME];
	char words[48];
	struct cola_writer a;
	if (!s->trouble || !is(s->trouble, name) || s->trouble_times == 0)
		return false;
	if (s->trouble_times > 0)
		s->trouble_times--;
	if (s->kind == REFUSE) {
		put_error(w, dialect, s->code);
	} else if (s->kind == LATER) {
		snprintf(words, sizeof words, "sMA %s", name);
		cola_writer_init(&a, dialect, bytes, sizeof bytes, words);
		put_frame(w, &a, s->answer_ns);
		s->kind = LATE;
		s->trouble_times = 0;
	}
	return s->kind == REFUSE || s->kind == SILENCE;
}

static void take_request(struct world *w, const uint8_t *frame, size_t len)
{
	const uint8_t *payload;
	size_t payload_len;
	char command[4] = "", name[32] = "";
	const enum cola_dialect dialect = cola_payload(frame, len, &payload, &payload_len);
	struct cola_reader r;
	memcpy(command, payload, 3);
	for (size_t i = 4; i < payload_len && payload[i] != ' ' && i < 4 + sizeof name - 1; i++)
		name[i - 4] = (char)payload[i];
	assert_true(w->requests < REQUESTS);
	const int n = w->requests++;
	snprintf(w->request[n], sizeof w->request[n], "%s %s", command, name);
	memcpy(w->bytes[n], frame, len);
	w->len[n] = len;
	w->dialect[n] = dialect;
	w->asked_ns[n] = w->now_ns;
	if (w->scanner.deaf || !w->scanner.speaks[dialect] || make_trouble(w, dialect, name))
		return;
	cola_reader_init(&r, dialect, payload, payload_len, name);
	answer(w, dialect, command, name, &r);
}

static void send_scan(struct world *w)
{
	uint8_t bytes[FRAME];
	struct cola_writer a;
	cola_writer_init(&a, w->scanner.speaks[COLA_A] ? COLA_A : COLA_B, bytes, sizeof bytes,
	                 w->scanner.safe ? "sSN LMDscandatamon" : "sSN LMDscandata");
	cola_write_u(&a, 1, 2);
	if (!w->scanner.deaf && !w->scanner.stands && !w->scanner.never_sends)
		put_frame(w, &a, 0);
	w->scanner.next_scan_ns += w->scanner.period_ns;
}

/* The host ------------------------------------------------------------------------------------------------------- */

static void push(struct framer *framer, struct world *w, const uint8_t *bytes, size_t len,
                 void (*take)(struct world *, const uint8_t *, size_t))
{
	const uint8_t *frame;
	while (len > 0) {
		const size_t n = framer_push(framer, bytes, len);
		bytes += n;
		len -= n;
		for (size_t size; (size = framer_take(framer, &frame)) > 0;)
			take(w, frame, size);
	}
}

static void hear(struct world *w, const uint8_t *frame, size_t len)
{
	struct reply reply = {.t_ns = w->now_ns};
	const enum cola_dialect dialect = cola_payload(frame, len, &reply.payload, &reply.len);
	reply.kind = cola_reply_kind(dialect, reply.payload, reply.len);
	cola_dialogue_reply(w->dialogue, &reply);
	if ((reply.kind & ~COLA_B_FLAG) == COLA_DATA) {
		w->scans++;
		cola_dialogue_data(w->dialogue, w->now_ns);
	}
}

static bool write_owed(struct world *w)
{
	if (w->unwritten_len > 0 && w->now_ns >= w->connected_ns) {
		push(&w->device, w, w->unwritten, w->unwritten_len, take_request);
		w->unwritten_len = 0;
	}
	return w->unwritten_len == 0;
}

static void converse(struct world *w)
{
	for (int i = 0; i < 16 && !w->ended && write_owed(w); i++) {
		cola_dialogue_step(w->dialogue, w->now_ns, &w->step);
		memcpy(w->unwritten, w->step.write, w->step.write_len);
		w->unwritten_len = w->step.write_len;
		w->due_ns = w->step.deadline_ns;
		w->ended = w->step.state == DIALOGUE_FAILED;
		if (w->step.write_len == 0 && w->due_ns > w->now_ns)
			return;
	}
}

static int64_t next_ns(const struct world *w)
{
	int64_t t_ns = w->unwritten_len > 0 ? w->connected_ns : w->due_ns;
	if (w->outs > 0 && w->out[0].t_ns < t_ns)
		t_ns = w->out[0].t_ns;
	return w->scanner.next_scan_ns < t_ns ? w->scanner.next_scan_ns : t_ns;
}

/* Until the dialogue failed or `for_ns` are over. */
static void run(struct world *w, int64_t for_ns)
{
	const int64_t end_ns = w->now_ns + for_ns;
	converse(w);
	while (!w->ended && next_ns(w) <= end_ns) {
		w->now_ns = next_ns(w) > w->now_ns ? next_ns(w) : w->now_ns;
		if (w->scanner.next_scan_ns <= w->now_ns)
			send_scan(w);
		if (w->outs > 0 && w->out[0].t_ns <= w->now_ns) {
			uint8_t bytes[FRAME];
			const size_t len = w->out[0].len;
			memcpy(bytes, w->out[0].bytes, len);
			memmove(w->out, w->out + 1, (size_t)--w->outs * sizeof w->out[0]);
			push(&w->host, w, bytes, len, hear);
		}
		converse(w);
	}
	if (!w->ended)
		w->now_ns = end_ns;
}

static void reopen(struct world *w)
{
	w->ended = false;
	w->unwritten_len = 0;
	w->outs = w->requests = w->scans = 0;
	w->scanner.streams = false;
	w->scanner.next_scan_ns = NEVER;
	w->scanner.level = 0;
	w->connected_ns = w->now_ns;
	framer_restart(&w->host);
	framer_restart(&w->device);
	cola_dialogue_reset(w->dialogue, w->now_ns);
}

static struct world *create(const char *device)
{
	struct world *w = calloc(1, sizeof *w);
	struct config_error error;
	char text[400];
	assert_non_null(w);
	w->config = malloc(sizeof *w->config);
	assert_non_null(w->config);
	snprintf(text, sizeof text, "devices: [{name: s, %s}]", device);
	if (config_read(text, strlen(text), "f", w->config, &error))
		fail_msg("%s", error.text);
	framer_init(&w->device, cola_scan_frame, NULL, w->device_buf, sizeof w->device_buf);
	framer_init(&w->host, cola_scan_frame, NULL, w->host_buf, sizeof w->host_buf);
	w->scanner = (struct scanner){.speaks = {true, false},
	                              .model = "LMS10x_FieldEval",
	                              .version = "V1.80-12.10.2012",
	                              .serial = "12345678",
	                              .answer_ns = 3 * MS,
	                              .frequency_chz = 5000,
	                              .resolution_tdeg = 5000,
	                              .from_tdeg = -450000,
	                              .to_tdeg = 2250000,
	                              .out_step_tdeg = 5000,
	                              .out_from_tdeg = -449997,
	                              .out_to_tdeg = 2249997,
	                              .data = {1},
	                              .every = 1,
	                              .stlms = 7,
	                              .run_result = 1,
	                              .period_ns = 20 * MS,
	                              .next_scan_ns = NEVER};
	w->now_ns = 5 * SECONDS;
	w->dialogue = cola_dialogue_create(w->config, 0);
	assert_non_null(w->dialogue);
	reopen(w);
	return w;
}

static void destroy(struct world *w)
{
	cola_dialogue_destroy(w->dialogue);
	free(w->config);
	free(w);
}

/* What a test asks ----------------------------------------------------------------------------------------------- */

static void assert_streams(struct world *w)
{
	if (w->ended || w->step.state != DIALOGUE_STREAMING) {
		for (int i = 0; i < w->requests; i++)
			print_error("  %lld ms %s\n", (long long)(w->asked_ns[i] / MS), w->request[i]);
		fail_msg("it does not stream: %s", w->ended ? w->step.error : "still configuring");
	}
}

static void assert_failed(struct world *w, const char *part)
{
	if (!w->ended || !strstr(w->step.error, part)) {
		for (int i = 0; i < w->requests; i++)
			print_error("  %lld ms %s\n", (long long)(w->asked_ns[i] / MS), w->request[i]);
		fail_msg("expected '%s', got %s '%s'", part, w->ended ? "failed" : "not failed", w->step.error);
	}
}

/* Requests that change something: writes and methods. */
static int changes(const struct world *w)
{
	int n = 0;
	for (int i = 0; i < w->requests; i++)
		n += w->request[i][1] == 'W' || w->request[i][1] == 'M';
	return n;
}

static int asked(const struct world *w, const char *request)
{
	int n = 0;
	for (int i = 0; i < w->requests; i++)
		n += is(w->request[i], request);
	return n;
}

/* The bytes of the first such request, as hexadecimal without blanks. */
static void assert_bytes(const struct world *w, const char *request, const char *hex)
{
	char got[2 * FRAME + 1], wanted[2 * FRAME + 1];
	size_t n = 0;
	for (int i = 0; i < w->requests; i++) {
		if (!is(w->request[i], request))
			continue;
		for (size_t k = 0; k < w->len[i]; k++)
			snprintf(got + 2 * k, 3, "%02X", w->bytes[i][k]);
		for (; *hex; hex++)
			if (*hex != ' ')
				wanted[n++] = *hex;
		wanted[n] = '\0';
		assert_string_equal(got, wanted);
		return;
	}
	fail_msg("%s was not asked", request);
}

static void assert_text(const struct world *w, const char *request, const char *text)
{
	for (int i = 0; i < w->requests; i++)
		if (is(w->request[i], request)) {
			char got[FRAME] = "";
			memcpy(got, w->bytes[i] + 1, w->len[i] - 2);
			assert_string_equal(got, text);
			return;
		}
	fail_msg("%s was not asked", request);
}

#define TIM    "driver: tim, connect: usb"
#define LMS1XX "driver: lms1xx, connect: 10.0.0.1"
#define LMS5XX "driver: lms5xx, connect: 10.0.0.1"

/* Claims --------------------------------------------------------------------------------------------------------- */

static void nothing_is_written_when_all_is_as_wanted(void **state)
{
	static const char *const device[] = {TIM, LMS1XX, LMS5XX, LMS1XX ", frequency: 50Hz, resolution: 0.5deg",
	                                     LMS1XX
	                                     ", angles: [-135deg, 135deg], every: 1, remission: off, protocol: b"};
	(void)state;
	for (size_t i = 0; i < sizeof device / sizeof device[0]; i++)
		for (int dialect = 0; dialect < 2; dialect++) {
			if (strstr(device[i], "protocol: b") && dialect == COLA_A)
				continue;
			struct world *w = create(device[i]);
			w->scanner.speaks[COLA_A] = dialect == COLA_A;
			w->scanner.speaks[COLA_B] = dialect == COLA_B;
			run(w, 2 * SECONDS);
			assert_streams(w);
			assert_int_equal(changes(w), 0);
			assert_true(w->scans > 50);
			destroy(w);
		}
}

static void exactly_what_differs_is_written(void **state)
{
	static const struct {
		const char *device, *request;
	} wanted[] = {
	    {LMS1XX ", frequency: 25Hz, resolution: 0.25deg", "sMN mLMPsetscancfg"},
	    {LMS1XX ", angles: [-90deg, 90deg]", "sWN LMPoutputRange"},
	    {LMS1XX ", every: 2", "sWN LMDscandatacfg"},
	    {LMS1XX ", remission: 16", "sWN LMDscandatacfg"},
	    {LMS5XX ", remission: 8", "sWN LMDscandatacfg"},
	};
	(void)state;
	for (size_t i = 0; i < sizeof wanted / sizeof wanted[0]; i++) {
		struct world *w = create(wanted[i].device);
		w->scanner.out_step_tdeg = strstr(wanted[i].device, "0.25deg") ? 2500 : 5000;
		run(w, 2 * SECONDS);
		assert_streams(w);
		assert_int_equal(asked(w, wanted[i].request), 1);
		assert_int_equal(changes(w), 4); /* login, the one write, start, run */
		assert_int_equal(asked(w, "sMN SetAccessMode"), 1);
		assert_int_equal(asked(w, "sMN LMCstartmeas"), 1);
		assert_int_equal(asked(w, "sMN Run"), 1);
		if (strstr(wanted[i].device, "remission")) {
			assert_int_equal(w->scanner.data[2], 1);
			assert_int_equal(w->scanner.data[3], strstr(wanted[i].device, "16") != NULL);
		}
		reopen(w); /* and the next time it is as wanted */
		run(w, 2 * SECONDS);
		assert_streams(w);
		assert_int_equal(changes(w), 0);
		destroy(w);
	}
}

static void what_is_written_has_the_documented_bytes_in_cola_b(void **state)
{
	(void)state;
	struct world *w = create(LMS1XX ", protocol: b, frequency: 25Hz, resolution: 0.25deg, remission: off, every: 1,"
	                                " angles: [-45deg, 135deg]");
	w->scanner.speaks[COLA_A] = false;
	w->scanner.speaks[COLA_B] = true;
	w->scanner.data[2] = 1; /* remission; the time stamp, on, is to stay */
	w->scanner.data[10] = 1;
	run(w, 2 * SECONDS);
	assert_streams(w);
	assert_bytes(w, "sEN LMDscandata", "02020202 00000011 73454E20 4C4D447363616E64617461 20 00 32");
	assert_bytes(w, "sMN SetAccessMode", "02020202 00000017 734D4E20 5365744163636573734D6F6465 20 03 F4724744 B3");
	assert_bytes(w, "sRN LMPoutputRange", "02020202 00000012 73524E20 4C4D506F757470757452616E6765 5E");
	assert_bytes(
	    w, "sWN LMDscandatacfg",
	    "02020202 00000020 73574E20 4C4D447363616E6461746163666720 0100 00 00 00 0000 00 00 00 01 0001 43");
	assert_bytes(w, "sMN LMCstartmeas", "02020202 00000010 734D4E20 4C4D4373746172746D656173 68");
	assert_bytes(w, "sMN Run", "02020202 00000007 734D4E20 52756E 19");
	assert_bytes(
	    w, "sMN mLMPsetscancfg",
	    "02020202 00000025 734D4E20 6D4C4D507365747363616E63666720 000009C4 0001 000009C4 FFF92230 00225510 "
	    "21");
	assert_bytes(w, "sWN LMPoutputRange",
	             "02020202 00000021 73574E20 4C4D506F757470757452616E676520 0001 000009C4 0006DDD0 00225510 DB");
	assert_bytes(w, "sRN LMPscancfg", "02020202 0000000E 73524E20 4C4D507363616E636667 63");
	destroy(w);
}

static void what_is_written_has_the_documented_text_in_cola_a(void **state)
{
	(void)state;
	struct world *w = create(LMS1XX ", frequency: 25Hz, resolution: 0.25deg, remission: 16, every: 1,"
	                                " angles: [-45deg, 135deg]");
	run(w, 2 * SECONDS);
	assert_streams(w);
	assert_text(w, "sEN LMDscandata", "sEN LMDscandata 0");
	assert_text(w, "sMN SetAccessMode", "sMN SetAccessMode 03 F4724744");
	assert_text(w, "sWN LMDscandatacfg", "sWN LMDscandatacfg 01 00 1 1 0 00 00 0 0 0 0 +1");
	assert_text(w, "sMN mLMPsetscancfg", "sMN mLMPsetscancfg 9C4 +1 9C4 FFF92230 225510");
	assert_text(w, "sWN LMPoutputRange", "sWN LMPoutputRange 1 9C4 6DDD0 225510");
	assert_text(w, "sMN LMCstartmeas", "sMN LMCstartmeas");
	assert_text(w, "sMN Run", "sMN Run");
	destroy(w);
}

static void the_dialect_is_found_by_trying_and_remembered(void **state)
{
	(void)state;
	struct world *w = create(LMS1XX);
	w->scanner.speaks[COLA_A] = false;
	w->scanner.speaks[COLA_B] = true;
	run(w, 2 * SECONDS);
	assert_streams(w);
	assert_int_equal(w->dialect[0], COLA_A);
	assert_int_equal(w->dialect[1], COLA_B);
	assert_true(w->asked_ns[1] - w->asked_ns[0] <= 500 * MS);
	reopen(w);
	run(w, SECONDS);
	assert_streams(w);
	for (int i = 0; i < w->requests; i++)
		assert_int_equal(w->dialect[i], COLA_B);
	w->scanner.speaks[COLA_A] = true; /* another one was plugged in */
	w->scanner.speaks[COLA_B] = false;
	reopen(w);
	run(w, 2 * SECONDS);
	assert_streams(w);
	destroy(w);
}

static void a_dialect_that_nobody_speaks_is_said(void **state)
{
	(void)state;
	struct world *w = create(LMS1XX ", protocol: a");
	w->scanner.speaks[COLA_A] = false;
	w->scanner.speaks[COLA_B] = true;
	run(w, 10 * SECONDS);
	assert_failed(w, "set `protocol: auto`");
	for (int i = 0; i < w->requests; i++)
		assert_int_equal(w->dialect[i], COLA_A);
	destroy(w);
	w = create(LMS1XX);
	w->scanner.deaf = true;
	run(w, 10 * SECONDS);
	assert_failed(w, "no scanner answers, in CoLa-A or in CoLa-B");
	assert_true(w->now_ns - 5 * SECONDS <= 2 * SECONDS);
	assert_int_equal(w->requests, 4);
	reopen(w); /* and as often the next time */
	run(w, 10 * SECONDS);
	assert_int_equal(w->requests, 4);
	destroy(w);
}

/* It is boot time, and it takes its time: the answer to the first dialect comes when the second was tried already. */
static void an_answer_that_comes_late_still_tells_the_dialect(void **state)
{
	(void)state;
	struct world *w = create(LMS1XX);
	w->scanner.trouble = "LMDscandata";
	w->scanner.kind = LATE;
	w->scanner.delay_ns = 600 * MS;
	run(w, 700 * MS);
	assert_int_equal(asked(w, "sRN DeviceIdent"), 1); /* at once, in the dialect of the answer */
	w->scanner.kind = NO_TROUBLE;
	run(w, 2 * SECONDS);
	assert_streams(w);
	assert_int_equal(w->dialect[w->requests - 1], COLA_A);
	destroy(w);
}

static void no_time_runs_while_the_connection_is_made(void **state)
{
	(void)state;
	struct world *w = create(LMS1XX ", protocol: a");
	w->connected_ns = w->now_ns + 1400 * MS;
	run(w, 1405 * MS);
	assert_false(w->ended);
	assert_int_equal(asked(w, "sEN LMDscandata"), 1);
	run(w, SECONDS);
	assert_streams(w);
	destroy(w);
}

static void one_request_is_outstanding_ever(void **state)
{
	(void)state;
	struct world *w = create(LMS5XX ", every: 2, remission: 8, encoder: {scale: 1deg}, angles: [-45deg, 45deg]");
	w->scanner.answer_ns = 150 * MS;
	run(w, 10 * SECONDS);
	assert_streams(w);
	for (int i = 1; i < w->requests; i++)
		assert_true(w->asked_ns[i] - w->asked_ns[i - 1] >= 150 * MS);
	destroy(w);
}

static void an_earlier_stream_is_switched_off_and_runs_dry(void **state)
{
	(void)state;
	struct world *w = create(TIM);
	w->scanner.answer_ns = 22 * MS;
	w->scanner.period_ns = 0;
	for (w->scanner.next_scan_ns = 0; w->outs < 12;) /* on their way when the stream is switched off */
		send_scan(w);
	for (int i = 0; i < w->outs; i++)
		w->out[i].t_ns = w->now_ns + (i + 1) * 5 * MS;
	w->scanner.next_scan_ns = NEVER;
	w->scanner.period_ns = 20 * MS;
	run(w, 155 * MS); /* the last telegram came at 60 ms */
	assert_int_equal(w->scans, 12);
	assert_int_equal(w->requests, 1);
	run(w, 2 * SECONDS);
	assert_streams(w);
	destroy(w);
}

static void a_safety_scanner_streams_under_its_other_name(void **state)
{
	(void)state;
	struct world *w = create(TIM ", every: 2");
	w->scanner.safe = true;
	run(w, 3 * SECONDS);
	assert_streams(w);
	assert_int_equal(asked(w, "sEN LMDscandatamon"), 2); /* off, on */
	assert_int_equal(asked(w, "sMN SetAccessMode"), 2);  /* the second password fits */
	cola_dialogue_stop(w->dialogue, w->now_ns);
	run(w, SECONDS);
	assert_failed(w, "");
	assert_string_equal(w->request[w->requests - 1], "sEN LMDscandatamon");
	assert_false(w->scanner.streams);
	destroy(w);
}

static void a_tim_that_knows_few_variables_streams(void **state)
{
	(void)state;
	struct world *w = create(TIM);
	w->scanner.few = true;
	run(w, 2 * SECONDS);
	assert_streams(w);
	assert_int_equal(changes(w), 0);
	destroy(w);
}

static void every_error_code_of_a_write_is_told_in_words_and_of_a_read_it_is_no_harm(void **state)
{
	(void)state;
	for (uint32_t code = 1; code <= 0x1a; code++)
		for (int dialect = 0; dialect < 2; dialect++) {
			struct world *w = create(LMS1XX ", every: 3, remission: 8");
			w->scanner.speaks[COLA_A] = dialect == COLA_A;
			w->scanner.speaks[COLA_B] = dialect == COLA_B;
			w->scanner.kind = REFUSE;
			w->scanner.code = code;
			w->scanner.trouble = "LMDscandatacfg";
			w->scanner.trouble_times = -1;
			run(w, 60 * SECONDS); /* busy is asked again before it is given up */
			assert_failed(w, cola_error_text(code));
			assert_failed(w, "LMDscandatacfg");
			assert_failed(w, "keep `remission` and `every`");
			destroy(w);
			w = create(LMS1XX);
			w->scanner.speaks[COLA_A] = dialect == COLA_A;
			w->scanner.speaks[COLA_B] = dialect == COLA_B;
			w->scanner.kind = REFUSE;
			w->scanner.code = code;
			w->scanner.trouble = "LMPscancfg";
			w->scanner.trouble_times = -1;
			run(w, 60 * SECONDS);
			assert_streams(w);
			destroy(w);
		}
}

static void a_refused_stream_is_told_by_its_own_name_and_reason(void **state)
{
	(void)state;
	for (uint32_t code = 1; code <= 0x1a; code++) {
		struct world *w = create(TIM);
		w->scanner.kind = REFUSE;
		w->scanner.code = code;
		w->scanner.trouble = "LMDscandata";
		w->scanner.trouble_times = -1;
		run(w, 60 * SECONDS);
		assert_failed(w, code == 3 || code == 0xf ? "LMDscandatamon: event unknown" : "refuses LMDscandata: ");
		assert_failed(w, code == 3 ? "event unknown" : cola_error_text(code));
		destroy(w);
	}
}

static void any_one_request_may_be_refused_or_unanswered_once(void **state)
{
	static const char *const names[] = {
	    "LMDscandata",    "DeviceIdent",   "SerialNumber",   "STlms",        "LMPscancfg", "mLMPsetscancfg",
	    "LMPoutputRange", "SetAccessMode", "LMDscandatacfg", "LMCstartmeas", "Run",        "LICencset",
	};
	(void)state;
	for (size_t i = 0; i < sizeof names / sizeof names[0]; i++)
		for (int kind = 0; kind < 2; kind++) {
			struct world *w = create(LMS1XX ", frequency: 25Hz, every: 2, encoder: {scale: 1deg}");
			w->scanner.kind = kind == 0 ? SILENCE : REFUSE;
			w->scanner.code = 0xd; /* busy */
			w->scanner.trouble = names[i];
			w->scanner.trouble_times = 1;
			run(w, 20 * SECONDS);
			assert_streams(w);
			if (strcmp(names[i], "SetAccessMode") != 0)
				assert_int_equal(w->scanner.every, 2);
			destroy(w);
		}
}

static void whoever_stops_answering_is_said_with_the_request(void **state)
{
	static const char *const names[] = {"LMPscancfg", "LMPoutputRange", "LMDscandatacfg", "STlms"};
	(void)state;
	for (size_t i = 0; i < sizeof names / sizeof names[0]; i++) {
		struct world *w = create(LMS1XX);
		w->scanner.kind = SILENCE;
		w->scanner.trouble = names[i];
		w->scanner.trouble_times = -1;
		run(w, 20 * SECONDS);
		assert_failed(w, names[i]);
		assert_failed(w, "does not answer");
		destroy(w);
	}
}

static void a_result_that_comes_later_is_waited_for(void **state)
{
	(void)state;
	struct world *w = create(LMS1XX ", frequency: 25Hz");
	w->scanner.kind = LATER;
	w->scanner.trouble = "mLMPsetscancfg";
	w->scanner.trouble_times = 1;
	w->scanner.delay_ns = 25 * SECONDS;
	run(w, 27 * SECONDS);
	assert_streams(w);
	assert_int_equal(asked(w, "sMN mLMPsetscancfg"), 1);
	assert_int_equal(w->scanner.frequency_chz, 2500);
	destroy(w);
}

static void garbage_between_answers_is_passed_over(void **state)
{
	(void)state;
	for (int dialect = 0; dialect < 2; dialect++) {
		struct world *w = create(LMS1XX ", every: 2, angles: [0deg, 45deg]");
		w->scanner.speaks[COLA_A] = dialect == COLA_A;
		w->scanner.speaks[COLA_B] = dialect == COLA_B;
		w->scanner.garbage = true;
		run(w, 20 * SECONDS);
		assert_streams(w);
		assert_int_equal(w->scanner.every, 2);
		assert_int_equal(w->scanner.out_from_tdeg, 900000);
		destroy(w);
	}
}

static void a_refused_login_is_said_only_where_something_must_be_written(void **state)
{
	(void)state;
	struct world *w = create(TIM);
	w->scanner.no_login = true;
	run(w, 2 * SECONDS);
	assert_streams(w);
	destroy(w);
	w = create(TIM ", every: 2");
	w->scanner.no_login = true;
	run(w, 2 * SECONDS);
	assert_failed(w, "refuses the login");
	assert_failed(w, "settings differ");
	destroy(w);
}

static void result_codes_of_the_scan_configuration_are_words(void **state)
{
	static const char *const words[] = {"no such frequency", "no such resolution", "over this area", "no such area",
	                                    "for a reason"};
	(void)state;
	for (uint8_t code = 1; code <= 5; code++) {
		struct world *w = create(LMS5XX ", frequency: 35Hz, resolution: 0.1667deg");
		w->scanner.set_result = code;
		run(w, 5 * SECONDS);
		assert_failed(w, words[code - 1]);
		assert_failed(w, "remove `frequency` and `resolution`");
		destroy(w);
	}
}

static void settings_nobody_can_change_are_said(void **state)
{
	(void)state;
	struct world *w = create(TIM ", frequency: 25Hz");
	w->scanner.few = true;
	run(w, 2 * SECONDS);
	assert_failed(w, "remove both from the configuration");
	destroy(w);
	w = create(TIM ", angles: [-45deg, 45deg]");
	w->scanner.few = true;
	run(w, 2 * SECONDS);
	assert_failed(w, "use `mask` instead of `angles`");
	destroy(w);
}

static void an_encoder_is_switched_on_where_it_is_off(void **state)
{
	(void)state;
	for (int dialect = 0; dialect < 2; dialect++) {
		struct world *w = create(LMS5XX ", encoder: {scale: 1deg}");
		w->scanner.speaks[COLA_A] = dialect == COLA_A;
		w->scanner.speaks[COLA_B] = dialect == COLA_B;
		run(w, 2 * SECONDS);
		assert_streams(w);
		assert_int_equal(w->scanner.licencset, 2);
		assert_int_equal(w->scanner.licsrc, 1);
		assert_int_equal(w->scanner.licencres, dialect == COLA_A ? 1 : 0x3f800000);
		assert_int_equal(w->scanner.do3and4, 1);
		assert_int_equal(w->scanner.data[5], 1);
		w->scanner.licencset = 3; /* how it is wired is its owner's business */
		reopen(w);
		run(w, 2 * SECONDS);
		assert_streams(w);
		assert_int_equal(changes(w), 0);
		destroy(w);
	}
	struct world *w = create(LMS1XX ", encoder: {scale: 1deg}");
	run(w, 2 * SECONDS);
	assert_streams(w);
	assert_int_equal(asked(w, "sRN DO3And4Fnc"), 0);
	assert_int_equal(w->scanner.licsrc, 1);
	destroy(w);
}

static void an_lms1xx_is_waited_for_until_it_is_ready(void **state)
{
	(void)state;
	struct world *w = create(LMS1XX);
	w->scanner.stlms = 5;
	w->scanner.ready_ns = w->now_ns + 40 * SECONDS;
	run(w, 39 * SECONDS);
	assert_false(w->ended);
	assert_int_equal(w->step.state, DIALOGUE_CONFIGURING);
	assert_true(asked(w, "sRN STlms") < 100);
	run(w, 2 * SECONDS);
	assert_streams(w);
	w->scanner.ready_ns = NEVER;
	reopen(w);
	run(w, 70 * SECONDS);
	assert_failed(w, "does not get ready to measure (its state is 5, in preparation)");
	destroy(w);
}

static void a_scanner_that_is_idle_is_started(void **state)
{
	(void)state;
	struct world *w = create(LMS1XX);
	w->scanner.stlms = 3;
	w->scanner.ready_ns = NEVER;
	run(w, 3 * SECONDS);
	assert_streams(w);
	assert_int_equal(asked(w, "sMN LMCstartmeas"), 1);
	assert_int_equal(asked(w, "sMN Run"), 1);
	destroy(w);
	w = create(LMS5XX); /* says nothing of its state, acknowledges and stands */
	w->scanner.stands = true;
	run(w, 10 * SECONDS);
	assert_failed(w, "sends no scan");
	reopen(w);
	run(w, 2 * SECONDS);
	assert_streams(w);
	assert_int_equal(asked(w, "sMN LMCstartmeas"), 1);
	destroy(w);
}

static void a_scanner_without_ranges_is_said_so_and_left_in_peace(void **state)
{
	(void)state;
	struct world *w = create(TIM);
	w->scanner.model = "TiM320-1031000";
	w->scanner.version = "V2.51-21.08.15";
	run(w, 2 * SECONDS);
	assert_failed(w, "this is a TiM320-1031000 with firmware V2.51-21.08.15, which sends no ranges");
	const int requests = w->requests;
	int total = 0;
	const int64_t begin_ns = w->now_ns;
	while (w->now_ns - begin_ns < 300 * SECONDS) { /* the supervisor tries again and again */
		w->now_ns += SECONDS / 4;
		reopen(w);
		run(w, 100 * SECONDS);
		assert_failed(w, "which sends no ranges");
		total += w->requests;
	}
	assert_true(total <= 12 * requests);
	w->scanner.version = "V2.49-01.01.14"; /* another one was plugged in: it is asked at once */
	reopen(w);
	run(w, SECONDS);
	assert_streams(w);
	destroy(w);
}

/* Refused for good it is asked less and less often; refused for a while it streams soon after. */
static void a_refusal_is_not_repeated_fast_and_not_kept_for_long(void **state)
{
	(void)state;
	struct world *w = create(LMS1XX ", every: 2");
	w->scanner.kind = REFUSE;
	w->scanner.code = 4;
	w->scanner.trouble = "LMDscandatacfg";
	w->scanner.trouble_times = -1;
	const int64_t begin_ns = w->now_ns;
	int times = 0;
	for (; w->now_ns - begin_ns < 120 * SECONDS; times++) {
		run(w, 100 * SECONDS);
		assert_failed(w, "a value is out of its limits");
		w->now_ns += SECONDS / 4;
		reopen(w);
	}
	assert_true(times >= 5 && times <= 12);
	destroy(w);
	w = create(LMS1XX ", every: 2");
	w->scanner.kind = REFUSE;
	w->scanner.code = 4;
	w->scanner.trouble = "LMDscandatacfg";
	w->scanner.trouble_times = 6; /* three times read and written */
	for (times = 0; times < 10; times++) {
		run(w, 5 * SECONDS);
		if (!w->ended)
			break;
		w->now_ns += SECONDS / 4;
		reopen(w);
	}
	assert_int_equal(times, 3);
	assert_streams(w);
	w->scanner.trouble_times = 2; /* it streamed meanwhile: told at once */
	reopen(w);
	const int64_t again_ns = w->now_ns;
	w->scanner.every = 1;
	run(w, 5 * SECONDS);
	assert_failed(w, "a value is out of its limits");
	assert_true(w->now_ns - again_ns < SECONDS);
	destroy(w);
}

static void half_open_connections_are_found_within_five_scans(void **state)
{
	static const struct {
		uint32_t frequency_chz;
		uint16_t every;
		int64_t most_ms;
	} rate[] = {{1500, 1, 334},  {2500, 1, 250},   {5000, 1, 250},
	            {1500, 5, 1667}, {2500, 50, 4000}, {1500, 10, 2000}};
	(void)state;
	for (size_t i = 0; i < sizeof rate / sizeof rate[0]; i++) {
		struct world *w = create(TIM);
		w->scanner.frequency_chz = rate[i].frequency_chz;
		w->scanner.every = rate[i].every;
		w->scanner.period_ns = 100 * SECONDS / rate[i].frequency_chz * rate[i].every;
		run(w, 30 * SECONDS + 7 * MS);
		assert_streams(w);
		const int64_t begin_ns = w->now_ns;
		w->scanner.deaf = true;
		run(w, 20 * SECONDS);
		assert_failed(w, "no scan for");
		assert_true(w->now_ns - begin_ns <= (rate[i].most_ms + 25) * MS);
		destroy(w);
	}
}

/* Who does not say how often it sends is learned; one that sends slower than it says is believed, too. */
static void a_slow_stream_is_no_dead_one(void **state)
{
	(void)state;
	for (int few = 0; few < 2; few++) {
		struct world *w = create(TIM);
		w->scanner.few = few;
		w->scanner.period_ns = few ? 900 * MS : 400 * MS;
		run(w, 60 * SECONDS);
		assert_streams(w);
		destroy(w);
	}
}

static void a_line_with_hiccups_is_given_more_time(void **state)
{
	(void)state;
	struct world *w = create(LMS1XX);
	int losses = 0;
	run(w, 2 * SECONDS);
	for (int i = 0; i < 10; i++) {
		assert_streams(w);
		w->scanner.deaf = true;
		run(w, 300 * MS);
		w->scanner.deaf = false;
		if (w->ended) {
			losses++;
			reopen(w);
		}
		run(w, 5 * SECONDS);
	}
	assert_streams(w);
	assert_true(losses >= 1 && losses <= 2);
	run(w, 60 * SECONDS); /* without any: found as soon as at first */
	const int64_t begin_ns = w->now_ns;
	w->scanner.deaf = true;
	run(w, 5 * SECONDS);
	assert_failed(w, "no scan for");
	assert_true(w->now_ns - begin_ns <= 275 * MS);
	destroy(w);
}

/* The loop slept for half a second: what waits in the socket is read after the timer's turn. */
static void a_host_that_slept_loses_no_connection(void **state)
{
	(void)state;
	struct world *w = create(TIM);
	run(w, 2 * SECONDS);
	assert_streams(w);
	w->now_ns += 500 * MS;
	cola_dialogue_step(w->dialogue, w->now_ns, &w->step);
	assert_int_equal(w->step.state, DIALOGUE_STREAMING);
	assert_true(w->step.deadline_ns > w->now_ns);
	run(w, 2 * SECONDS);
	assert_streams(w);
	destroy(w);
}

static void silence_after_the_stream_was_switched_on_is_said(void **state)
{
	(void)state;
	struct world *w = create(TIM);
	w->scanner.never_sends = true;
	run(w, 10 * SECONDS);
	assert_failed(w, "sends no scan that can be read");
	assert_true(w->now_ns <= 10 * SECONDS);
	destroy(w);
}

static void a_stream_that_is_not_switched_on_is_said(void **state)
{
	(void)state;
	struct world *w = create(TIM);
	w->scanner.safe = w->scanner.stays_off = true;
	run(w, 10 * SECONDS);
	assert_failed(w, "the scanner refuses LMDscandatamon: it does not switch it on");
	destroy(w);
	w = create(TIM);
	w->scanner.stays_off = true;
	run(w, 10 * SECONDS);
	assert_failed(w, "event unknown"); /* it has no other name for it */
	destroy(w);
}

/* Another client's stream on a line that both share: it never gets quiet. */
static void a_stream_that_does_not_end_is_not_waited_for(void **state)
{
	(void)state;
	struct world *w = create(TIM);
	run(w, 2 * MS);
	for (int i = 0; i < 60; i++) {
		cola_dialogue_data(w->dialogue, w->now_ns);
		run(w, 50 * MS);
	}
	assert_streams(w);
	assert_true(w->asked_ns[1] - w->asked_ns[0] <= 1010 * MS);
	destroy(w);
}

static void a_scanner_that_stands_and_refuses_the_login_is_asked_to_stream_all_the_same(void **state)
{
	(void)state;
	struct world *w = create(LMS5XX);
	w->scanner.no_login = w->scanner.stands = true;
	run(w, 10 * SECONDS);
	assert_failed(w, "sends no scan");
	w->scanner.stands = false; /* somebody pressed its button */
	reopen(w);
	run(w, 2 * SECONDS);
	assert_streams(w);
	assert_int_equal(asked(w, "sMN SetAccessMode"), 2);
	assert_int_equal(asked(w, "sMN LMCstartmeas"), 0);
	destroy(w);
}

static void who_does_not_know_its_name_is_asked_otherwise(void **state)
{
	(void)state;
	for (int dialect = 0; dialect < 2; dialect++) {
		struct world *w = create(TIM);
		w->scanner.speaks[COLA_A] = dialect == COLA_A;
		w->scanner.speaks[COLA_B] = dialect == COLA_B;
		w->scanner.model = "TiM310 ";
		w->scanner.version = "V2.60";
		w->scanner.kind = REFUSE;
		w->scanner.code = 3;
		w->scanner.trouble = "DeviceIdent";
		w->scanner.trouble_times = -1;
		if (dialect == COLA_A) { /* sRI 0 says both */
			run(w, 5 * SECONDS);
			assert_failed(w, "this is a TiM310 with firmware V2.60, which sends no ranges");
		} else { /* the version alone accuses nobody */
			run(w, 5 * SECONDS);
			assert_streams(w);
			assert_int_equal(asked(w, "sRN FirmwareVersion"), 1);
		}
		destroy(w);
	}
}

static void without_any_echo_in_its_telegrams_one_is_asked_for(void **state)
{
	(void)state;
	struct world *w = create(LMS1XX);
	w->scanner.data[0] = 0;
	run(w, 2 * SECONDS);
	assert_streams(w);
	assert_int_equal(w->scanner.data[0], 1);
	destroy(w);
}

static void the_end_switches_the_stream_off(void **state)
{
	(void)state;
	struct world *w = create(LMS1XX);
	run(w, 2 * SECONDS);
	assert_streams(w);
	cola_dialogue_stop(w->dialogue, w->now_ns);
	run(w, SECONDS);
	assert_true(w->ended);
	assert_string_equal(w->step.error, "");
	assert_false(w->scanner.streams);
	cola_dialogue_stop(w->dialogue, w->now_ns); /* and once more */
	destroy(w);
	w = create(LMS1XX); /* nobody there: no time is lost */
	w->scanner.deaf = true;
	run(w, 100 * MS);
	cola_dialogue_stop(w->dialogue, w->now_ns);
	run(w, 10 * MS);
	assert_true(w->ended);
	assert_string_equal(w->step.error, "");
	destroy(w);
	w = create(LMS1XX); /* it dies meanwhile */
	run(w, 2 * SECONDS);
	w->scanner.deaf = true;
	cola_dialogue_stop(w->dialogue, w->now_ns);
	run(w, 600 * MS);
	assert_true(w->ended);
	assert_string_equal(w->step.error, "");
	destroy(w);
}

static void a_stop_at_any_moment_ends_in_peace(void **state)
{
	(void)state;
	for (int64_t after_ns = 0; after_ns < 400 * MS; after_ns += MS) {
		struct world *w = create(LMS5XX ", every: 2, encoder: {scale: 1deg}");
		w->scanner.answer_ns = 7 * MS;
		run(w, after_ns);
		cola_dialogue_stop(w->dialogue, w->now_ns);
		run(w, SECONDS);
		assert_true(w->ended);
		assert_string_equal(w->step.error, "");
		assert_false(w->scanner.streams);
		destroy(w);
	}
}

static void a_link_that_is_lost_at_any_moment_begins_anew(void **state)
{
	(void)state;
	for (int64_t after_ns = 0; after_ns < 400 * MS; after_ns += MS) {
		struct world *w = create(LMS5XX ", every: 2, encoder: {scale: 1deg}");
		w->scanner.answer_ns = 7 * MS;
		run(w, after_ns);
		reopen(w);
		run(w, 2 * SECONDS);
		assert_streams(w);
		assert_int_equal(w->scanner.every, 2);
		destroy(w);
	}
}

static void an_answer_to_another_request_is_none(void **state)
{
	static const char text[] = "sRA LMDscandatacfg 01 00 0 0 0 00 00 0 0 0 0 +7";
	const struct reply reply = {.payload = (const uint8_t *)text, .len = sizeof text - 1, .kind = COLA_READ};
	int tried = 0;
	(void)state;
	for (int64_t after_ns = 0; after_ns < 100 * MS; after_ns += MS) {
		struct world *w = create(LMS1XX ", every: 1");
		run(w, after_ns);
		if (!is(w->request[w->requests - 1], "sRN LMDscandatacfg")) {
			cola_dialogue_reply(w->dialogue, &reply);
			tried++;
		}
		run(w, 2 * SECONDS);
		assert_streams(w);
		assert_int_equal(changes(w), 0);
		destroy(w);
	}
	assert_true(tried > 80);
}

static void answers_that_are_cut_or_nonsense_do_no_harm(void **state)
{
	static const char *const texts[] = {"sRA LMPscancfg",
	                                    "sRA LMPscancfg 5",
	                                    "sRA DeviceIdent FFFF X",
	                                    "sRA STlms",
	                                    "sAN SetAccessMode",
	                                    "sAN mLMPsetscancfg",
	                                    "sEA LMDscandata",
	                                    "sFA",
	                                    "sFA ZZ",
	                                    "sRA LMDscandatacfg 01",
	                                    "sRA LMPoutputRange 1",
	                                    "sAN Run",
	                                    "sRA SerialNumber 99 1",
	                                    "sWA",
	                                    "sAN"};
	(void)state;
	for (size_t i = 0; i < sizeof texts / sizeof texts[0]; i++)
		for (int64_t after_ns = 0; after_ns < 200 * MS; after_ns += 3 * MS) {
			struct world *w = create(LMS5XX ", every: 2, frequency: 25Hz, encoder: {scale: 1deg}");
			run(w, after_ns);
			const struct reply reply = {
			    .t_ns = w->now_ns,
			    .payload = (const uint8_t *)texts[i],
			    .len = strlen(texts[i]),
			    .kind = cola_reply_kind(COLA_A, (const uint8_t *)texts[i], strlen(texts[i]))};
			cola_dialogue_reply(w->dialogue, &reply);
			run(w, 20 * SECONDS);
			assert_true(w->ended ? w->step.error[0] != '\0' : w->step.state == DIALOGUE_STREAMING);
			destroy(w);
		}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(nothing_is_written_when_all_is_as_wanted),
	    cmocka_unit_test(exactly_what_differs_is_written),
	    cmocka_unit_test(what_is_written_has_the_documented_bytes_in_cola_b),
	    cmocka_unit_test(what_is_written_has_the_documented_text_in_cola_a),
	    cmocka_unit_test(the_dialect_is_found_by_trying_and_remembered),
	    cmocka_unit_test(a_dialect_that_nobody_speaks_is_said),
	    cmocka_unit_test(an_answer_that_comes_late_still_tells_the_dialect),
	    cmocka_unit_test(no_time_runs_while_the_connection_is_made),
	    cmocka_unit_test(one_request_is_outstanding_ever),
	    cmocka_unit_test(an_earlier_stream_is_switched_off_and_runs_dry),
	    cmocka_unit_test(a_safety_scanner_streams_under_its_other_name),
	    cmocka_unit_test(a_tim_that_knows_few_variables_streams),
	    cmocka_unit_test(every_error_code_of_a_write_is_told_in_words_and_of_a_read_it_is_no_harm),
	    cmocka_unit_test(a_refused_stream_is_told_by_its_own_name_and_reason),
	    cmocka_unit_test(any_one_request_may_be_refused_or_unanswered_once),
	    cmocka_unit_test(whoever_stops_answering_is_said_with_the_request),
	    cmocka_unit_test(a_result_that_comes_later_is_waited_for),
	    cmocka_unit_test(garbage_between_answers_is_passed_over),
	    cmocka_unit_test(a_refused_login_is_said_only_where_something_must_be_written),
	    cmocka_unit_test(result_codes_of_the_scan_configuration_are_words),
	    cmocka_unit_test(settings_nobody_can_change_are_said),
	    cmocka_unit_test(an_encoder_is_switched_on_where_it_is_off),
	    cmocka_unit_test(an_lms1xx_is_waited_for_until_it_is_ready),
	    cmocka_unit_test(a_scanner_that_is_idle_is_started),
	    cmocka_unit_test(a_scanner_without_ranges_is_said_so_and_left_in_peace),
	    cmocka_unit_test(a_refusal_is_not_repeated_fast_and_not_kept_for_long),
	    cmocka_unit_test(half_open_connections_are_found_within_five_scans),
	    cmocka_unit_test(a_slow_stream_is_no_dead_one),
	    cmocka_unit_test(a_line_with_hiccups_is_given_more_time),
	    cmocka_unit_test(a_host_that_slept_loses_no_connection),
	    cmocka_unit_test(silence_after_the_stream_was_switched_on_is_said),
	    cmocka_unit_test(a_stream_that_is_not_switched_on_is_said),
	    cmocka_unit_test(a_stream_that_does_not_end_is_not_waited_for),
	    cmocka_unit_test(a_scanner_that_stands_and_refuses_the_login_is_asked_to_stream_all_the_same),
	    cmocka_unit_test(who_does_not_know_its_name_is_asked_otherwise),
	    cmocka_unit_test(without_any_echo_in_its_telegrams_one_is_asked_for),
	    cmocka_unit_test(the_end_switches_the_stream_off),
	    cmocka_unit_test(a_stop_at_any_moment_ends_in_peace),
	    cmocka_unit_test(a_link_that_is_lost_at_any_moment_begins_anew),
	    cmocka_unit_test(an_answer_to_another_request_is_none),
	    cmocka_unit_test(answers_that_are_cut_or_nonsense_do_no_harm),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

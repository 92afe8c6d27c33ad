/* CoLa: from whatever the scanner is doing to the stream that was asked for. Pure, in virtual time.
 *
 *   PROBE  stream off, in the dialect that is wanted or worked last, then the other: whatever answers speaks it
 *   -> DRAIN                           what an earlier client left streaming runs dry
 *   -> IDENT, SERIAL, STATE            who it is; what cannot range is said so, what is not the wanted one, too
 *   -> SCAN, RANGE, DATA, ENCODER      each setting is read first; only what differs is written, after a login
 *   -> START -> RUN                    only after a login, or where it stands still
 *   -> READY                           LMS1xx: until STlms says 7
 *   -> STREAM -> FIRST -> STREAMING    on; it streams when the first telegram came
 *
 * An error answer does not say which request it is for: one request is outstanding, ever. A request whose answer is not
 * needed goes on when it is refused (most TiM know few variables); one that was asked for in the configuration fails
 * with the scanner's own reason. A failure that would only repeat itself is told at once, and when it comes again, kept
 * longer and longer: a scanner that can never do what is asked is not asked twice a second.
 *
 * The time of an exchange begins when its bytes are with the kernel, which is when the step after the write comes: while
 * a connection is being made nothing is outstanding.
 *
 * While streaming, silence for five scans is a lost link: a pulled cable tells nobody. A line that only has hiccups (lost
 * packets that TCP repeats after 200 ms and more) is given more time after the first of them. */
#include "drivers/cola.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "drivers/cola_settings.h"

#define NEVER      INT64_MAX
#define MS         1000000ll
#define PROBE_NS   (500 * MS)
#define READ_NS    (1000 * MS)
#define WRITE_NS   (5000 * MS)
#define LATER_NS   (30000 * MS) /* after sMA: the EEPROM is slow */
#define PAUSE_NS   (200 * MS)   /* before a repetition: a late answer is taken in it */
#define BUSY_NS    (500 * MS)   /* busy with another method: asked again then ... */
#define BUSY_MAX   20           /* ... so often */
#define QUIET_NS   (100 * MS)   /* DRAIN: so long without a telegram ... */
#define DRAIN_NS   (1000 * MS)  /* ... or so long in all */
#define POLL_NS    (500 * MS)   /* READY */
#define READY_NS   (60000 * MS) /* an LMS1xx needs 20 to 40 s after power-on */
#define FIRST_NS   (3000 * MS)  /* to the first telegram: a mirror may have to spin up */
#define SILENT_NS  (250 * MS)   /* at least, five scans at most so long ... */
#define SILENT_MAX (2000 * MS)  /* ... and at most, but two scans at least */
#define FLOOR_MAX  (1000 * MS)  /* SILENT_NS is doubled up to here while a line has hiccups ... */
#define STEADY_NS  (20000 * MS) /* ... and halved after so long without one */
#define GRACE_NS   (20 * MS)    /* the host itself may have slept: what waits in its buffers is read first */
#define HOLD_NS    (1000 * MS)  /* doubled with every time ... */
#define HOLD_MAX   (30000 * MS) /* ... up to here */
#define HASH       0xF4724744u  /* of the password of level 3, authorised client */
#define HASH_SAFE  0x6FD62C05u  /* ... of the safety variants */
#define LEVEL      3
enum { PROBES = 4, SCANS_LOST = 5, PERIODS = 8 };

enum stage {
	STAGE_PROBE,
	STAGE_PROBE_SAFE, /* the other name of the stream */
	STAGE_DRAIN,
	STAGE_IDENT,
	STAGE_IDENT_INDEX,
	STAGE_FIRMWARE,
	STAGE_SERIAL,
	STAGE_STATE,
	STAGE_LOGIN,
	STAGE_LOGIN_SAFE,
	STAGE_SCAN,
	STAGE_SCAN_SET,
	STAGE_RANGE,
	STAGE_RANGE_SET,
	STAGE_DATA,
	STAGE_DATA_SET,
	STAGE_ENCODER,
	STAGE_ENCODER_SET,
	STAGE_START,
	STAGE_RUN,
	STAGE_READY,
	STAGE_STREAM,
	STAGE_STREAM_SAFE,
	STAGE_FIRST,
	STAGE_STREAMING,
	STAGE_STOP,
	STAGE_HOLD,
	STAGE_FAILED,
	STAGES
};

/* One exchange: what is asked, which answer is waited for. No command: nothing is outstanding in this stage. */
static const struct exchange {
	const char *command, *name;
	enum cola_reply answer;
	int64_t patience_ns;
	int tries;
	bool asks; /* an error answer, or none, is no harm */
	const char *advice;
} exchanges[STAGES] = {
    [STAGE_PROBE] = {"sEN", "LMDscandata", COLA_EVENT, PROBE_NS, 1, true, NULL},
    [STAGE_PROBE_SAFE] = {"sEN", "LMDscandatamon", COLA_EVENT, READ_NS, 1, true, NULL},
    [STAGE_IDENT] = {"sRN", "DeviceIdent", COLA_READ, READ_NS, 2, true, NULL},
    [STAGE_IDENT_INDEX] = {"sRI", "0", COLA_READ, READ_NS, 1, true, NULL},
    [STAGE_FIRMWARE] = {"sRN", "FirmwareVersion", COLA_READ, READ_NS, 1, true, NULL},
    [STAGE_SERIAL] = {"sRN", "SerialNumber", COLA_READ, READ_NS, 2, true, NULL},
    [STAGE_STATE] = {"sRN", "SCdevicestate", COLA_READ, READ_NS, 1, true, NULL},
    [STAGE_LOGIN] = {"sMN", "SetAccessMode", COLA_METHOD, WRITE_NS, 2, false, "switch it off and on"},
    [STAGE_LOGIN_SAFE] = {"sMN", "SetAccessMode", COLA_METHOD, WRITE_NS, 2, false, "switch it off and on"},
    [STAGE_SCAN] = {"sRN", "LMPscancfg", COLA_READ, READ_NS, 3, true, NULL},
    [STAGE_SCAN_SET] = {"sMN", "mLMPsetscancfg", COLA_METHOD, WRITE_NS, 2, false,
                        "remove `frequency` and `resolution`"},
    [STAGE_RANGE] = {"sRN", "LMPoutputRange", COLA_READ, READ_NS, 3, true, NULL},
    [STAGE_RANGE_SET] = {"sWN", "LMPoutputRange", COLA_WRITTEN, WRITE_NS, 2, false, "change `angles`"},
    [STAGE_DATA] = {"sRN", "LMDscandatacfg", COLA_READ, READ_NS, 3, true, NULL},
    [STAGE_DATA_SET] = {"sWN", "LMDscandatacfg", COLA_WRITTEN, WRITE_NS, 2, false, "keep `remission` and `every`"},
    [STAGE_ENCODER] = {"sRN", NULL, COLA_READ, READ_NS, 3, true, NULL},
    [STAGE_ENCODER_SET] = {"sWN", NULL, COLA_WRITTEN, WRITE_NS, 2, false, "remove `encoder`"},
    [STAGE_START] = {"sMN", "LMCstartmeas", COLA_METHOD, WRITE_NS, 2, true, NULL},
    [STAGE_RUN] = {"sMN", "Run", COLA_METHOD, WRITE_NS, 2, true, NULL},
    [STAGE_READY] = {"sRN", "STlms", COLA_READ, READ_NS, 3, true, NULL},
    [STAGE_STREAM] = {"sEN", "LMDscandata", COLA_EVENT, READ_NS, 3, false, "switch it off and on"},
    [STAGE_STREAM_SAFE] = {"sEN", "LMDscandatamon", COLA_EVENT, READ_NS, 3, false, "switch it off and on"},
    [STAGE_STOP] = {"sEN", "LMDscandata", COLA_EVENT, PROBE_NS, 1, true, NULL},
};

struct dialogue {
	const struct config_device *config; /* borrowed */
	const struct cola_family *family;

	enum stage stage;
	enum cola_dialect dialect;
	bool found;  /* somebody answered in that dialect since the link was opened */
	bool worked; /* ... ever: then it is tried first */
	int probes;

	/* the exchange */
	enum { ASK_SENDING, ASK_SENT, ASK_WAITING, ASK_PAUSING } ask;
	int64_t until_ns; /* WAITING: end of patience; PAUSING, DRAIN, HOLD, READY: end of the pause */
	int tries, busy;

	/* what is known since the link was opened */
	char model[48], version[24];
	bool safe; /* its stream is LMDscandatamon */
	bool logged_in, started;
	enum stage after_login;
	struct cola_scan_setup scan;
	struct cola_range_setup range;
	struct cola_data_setup data;
	int encoder; /* variable that is looked at */
	struct cola_number number;
	int64_t ready_ns; /* end of patience with READY */

	/* what is kept over openings */
	bool stood_still;            /* it acknowledged the stream and sent nothing: it is started the next time */
	char told[160];              /* the last failure that would repeat itself, empty since it streamed ... */
	int64_t hold_ns;             /* ... and how long it is held when it comes again */
	int64_t floor_ns, steady_ns; /* silence that is no loss, and since when it is enough */

	int64_t heard_ns; /* last telegram with a scan, or the link's opening; */
	bool heard;       /* ... which of the two */
	int64_t drain_ns; /* end of patience with DRAIN */
	int64_t interval_ns[PERIODS];
	int intervals;
	int64_t late_ns; /* STREAMING: it is silent, and has its grace up to here; 0: it is not */
	char error[160];
};

static void enter(struct dialogue *d, enum stage stage)
{
	d->stage = stage;
	d->ask = ASK_SENDING;
	d->tries = d->busy = 0;
}

/* Failing ---------------------------------------------------------------------------------------------------------- */

static void fail(struct dialogue *d, const char *sentence)
{
	d->stage = STAGE_FAILED;
	snprintf(d->error, sizeof d->error, "%s", sentence);
}

/* A failure that stays until somebody changes something: told at once the first time, then after a while. */
static void fail_for_long(struct dialogue *d, const char *sentence, int64_t t_ns)
{
	fail(d, sentence);
	if (strcmp(d->told, d->error) != 0) {
		memcpy(d->told, d->error, sizeof d->told);
		d->hold_ns = HOLD_NS;
		return;
	}
	d->stage = STAGE_HOLD;
	d->until_ns = t_ns + d->hold_ns;
	d->hold_ns = 2 * d->hold_ns < HOLD_MAX ? 2 * d->hold_ns : HOLD_MAX;
}

static const char *name_of(const struct dialogue *d, enum stage stage)
{
	if (stage == STAGE_ENCODER || stage == STAGE_ENCODER_SET)
		return cola_encoder_variable(d->encoder, d->config->driver);
	if (stage == STAGE_STOP && d->safe)
		return exchanges[STAGE_PROBE_SAFE].name;
	if (stage == STAGE_STATE && d->family->waits_ready)
		return exchanges[STAGE_READY].name;
	return exchanges[stage].name;
}

static void fail_refused(struct dialogue *d, const char *why, int64_t t_ns)
{
	char sentence[160];
	snprintf(sentence, sizeof sentence, "the scanner refuses %s: %s; %s", name_of(d, d->stage), why,
	         exchanges[d->stage].advice);
	fail_for_long(d, sentence, t_ns);
}

/* The way through the stages ---------------------------------------------------------------------------------------- */

/* What is to be written needs a login before the first time. */
static void enter_logged_in(struct dialogue *d, enum stage stage)
{
	d->after_login = stage;
	enter(d, d->logged_in ? stage : STAGE_LOGIN);
}

static void after_settings(struct dialogue *d)
{
	if (!d->started && (d->logged_in || d->stood_still))
		enter_logged_in(d, STAGE_START);
	else
		enter(d, d->family->waits_ready ? STAGE_READY : STAGE_STREAM);
}

static void look_at_encoder(struct dialogue *d, int variable)
{
	d->encoder = variable;
	d->number = (struct cola_number){0};
	while (d->encoder < COLA_ENCODER_VARIABLES && !cola_encoder_variable(d->encoder, d->config->driver))
		d->encoder++;
	if (d->config->encoder.set && d->encoder < COLA_ENCODER_VARIABLES)
		enter(d, STAGE_ENCODER);
	else
		after_settings(d);
}

static void compare_scan(struct dialogue *d, int64_t t_ns)
{
	const bool known = d->scan.known;
	if (!cola_scan_setup_want(&d->scan, d->config))
		enter(d, STAGE_RANGE);
	else if (known)
		enter_logged_in(d, STAGE_SCAN_SET);
	else
		fail_for_long(d,
		              "the scanner does not say its frequency and resolution: remove both from the "
		              "configuration, it has only one",
		              t_ns);
}

static void compare_range(struct dialogue *d, int64_t t_ns)
{
	const bool known = d->range.known;
	if (!cola_range_setup_want(&d->range, d->config))
		enter(d, STAGE_DATA);
	else if (known)
		enter_logged_in(d, STAGE_RANGE_SET);
	else
		fail_for_long(d,
		              "the scanner does not say which angles it sends, so they cannot be changed: use `mask` "
		              "instead of `angles`",
		              t_ns);
}

static void compare_data(struct dialogue *d)
{
	if (cola_data_setup_want(&d->data, d->config))
		enter_logged_in(d, STAGE_DATA_SET);
	else
		look_at_encoder(d, 0);
}

static void compare_encoder(struct dialogue *d)
{
	if (cola_encoder_want(d->encoder, &d->number))
		enter_logged_in(d, STAGE_ENCODER_SET);
	else
		look_at_encoder(d, d->encoder + 1);
}

/* Identity ----------------------------------------------------------------------------------------------------------- */

/* Text of a device made fit for a sentence. */
static void keep_text(char *ret, size_t cap, const char *text, size_t len)
{
	size_t n = 0;
	for (size_t i = 0; i < len && n + 1 < cap; i++)
		if (text[i] > ' ' || (text[i] == ' ' && n > 0))
			ret[n++] = text[i] < 127 ? text[i] : '?';
	while (n > 0 && ret[n - 1] == ' ')
		n--;
	ret[n] = '\0';
}

/* "V2.51-21.08.15" -> 251; 0: none in it. */
static int version_number(const char *text)
{
	const size_t n = strcspn(text, "0123456789");
	char *end;
	const long major = strtol(text + n, &end, 10);
	const long minor = *end == '.' ? strtol(end + 1, NULL, 10) : 0;
	return major >= 0 && major < 100 && minor >= 0 && minor < 100 ? (int)(major * 100 + minor) : 0;
}

/* From firmware 2.50 on the TiM3xx evaluate fields only. */
static bool has_ranges(const struct dialogue *d)
{
	return strncmp(d->model, "TiM3", 4) != 0 || version_number(d->version) < 250;
}

static void judge_identity(struct dialogue *d, int64_t t_ns)
{
	char sentence[160];
	if (has_ranges(d)) {
		enter(d, STAGE_SERIAL);
		return;
	}
	snprintf(
	    sentence, sizeof sentence,
	    "this is a %.40s with firmware %.20s, which sends no ranges (a TiM3xx from 2.50 on): use another scanner",
	    d->model, d->version);
	fail_for_long(d, sentence, t_ns);
	d->hold_ns = HOLD_MAX; /* what it is does not change */
}

static void take_identity(struct dialogue *d, struct cola_reader *r, int64_t t_ns)
{
	const char *model, *version;
	size_t model_len, version_len;
	cola_read_string(r, 2, &model, &model_len);
	cola_read_string(r, 2, &version, &version_len);
	if (r->failed) {
		enter(d, STAGE_FIRMWARE);
		return;
	}
	keep_text(d->model, sizeof d->model, model, model_len);
	keep_text(d->version, sizeof d->version, version, version_len);
	judge_identity(d, t_ns);
}

static void take_firmware(struct dialogue *d, struct cola_reader *r, int64_t t_ns)
{
	const char *version;
	size_t len;
	cola_read_string(r, 2, &version, &len);
	if (!r->failed)
		keep_text(d->version, sizeof d->version, version, len);
	judge_identity(d, t_ns);
}

/* Answers ------------------------------------------------------------------------------------------------------------ */

static void take_login(struct dialogue *d, struct cola_reader *r, int64_t t_ns)
{
	if (cola_read_u(r, 1) == 1 && !r->failed) {
		d->logged_in = true;
		enter(d, d->after_login);
	} else if (d->stage == STAGE_LOGIN) {
		enter(d, STAGE_LOGIN_SAFE);
	} else if (d->after_login == STAGE_START) {
		d->started = true; /* it may do without */
		after_settings(d);
	} else {
		fail_for_long(d,
		              "the scanner refuses the login, and its settings differ from the configuration: keep its "
		              "own, or set it with SICK's tool",
		              t_ns);
	}
}

static void take_scan_set(struct dialogue *d, struct cola_reader *r, int64_t t_ns)
{
	static const char *const why[] = {"", "it knows no such frequency", "it knows no such resolution",
	                                  "no such resolution over this area", "no such area"};
	const uint32_t code = cola_read_u(r, 1);
	if (r->failed || code != 0)
		fail_refused(d, !r->failed && code < 5 ? why[code] : "for a reason it does not tell", t_ns);
	else
		enter(d, STAGE_RANGE);
}

static const char *status_text(uint32_t status)
{
	static const char *const texts[] = {"undefined",      "initialising", "being configured", "idle", "rotated",
	                                    "in preparation", "ready",        "measuring"};
	return status < 8 ? texts[status] : "unknown";
}

static void take_ready(struct dialogue *d, struct cola_reader *r, int64_t t_ns)
{
	enum { IDLE = 3, MEASURING = 7 };
	const uint32_t status = cola_read_u(r, 2);
	char sentence[160];
	if (r->failed || status == MEASURING) {
		enter(d, STAGE_STREAM);
	} else if (status == IDLE && !d->started) {
		enter_logged_in(d, STAGE_START);
	} else if (d->ready_ns && t_ns >= d->ready_ns) {
		snprintf(sentence, sizeof sentence,
		         "the scanner does not get ready to measure (its state is %u, %s): switch it off and on",
		         (unsigned)status, status_text(status));
		d->stood_still = true;
		fail(d, sentence);
	} else {
		if (!d->ready_ns)
			d->ready_ns = t_ns + READY_NS;
		enter(d, STAGE_READY);
		d->ask = ASK_PAUSING;
		d->until_ns = t_ns + POLL_NS;
	}
}

static void take_stream(struct dialogue *d, struct cola_reader *r, int64_t t_ns)
{
	if (cola_read_u(r, 1) != 1 || r->failed) {
		if (d->stage == STAGE_STREAM)
			enter(d, STAGE_STREAM_SAFE);
		else
			fail_refused(d, "it does not switch it on", t_ns);
		return;
	}
	d->safe = d->stage == STAGE_STREAM_SAFE;
	d->stage = STAGE_FIRST;
	d->until_ns = t_ns + FIRST_NS;
}

static void drain(struct dialogue *d, int64_t t_ns)
{
	d->stage = STAGE_DRAIN;
	d->drain_ns = t_ns + DRAIN_NS;
	d->heard = d->heard && t_ns - d->heard_ns < QUIET_NS;
}

/* The answer to the exchange of this stage came; the reader stands behind its name. */
static void advance(struct dialogue *d, struct cola_reader *r, int64_t t_ns)
{
	switch (d->stage) {
	case STAGE_PROBE:
	case STAGE_PROBE_SAFE:
		drain(d, t_ns);
		break;
	case STAGE_IDENT:
	case STAGE_IDENT_INDEX:
		take_identity(d, r, t_ns);
		break;
	case STAGE_FIRMWARE:
		take_firmware(d, r, t_ns);
		break;
	case STAGE_SERIAL:
		enter(d, STAGE_STATE); /* for the recording; a USB link chose its scanner when it was opened */
		break;
	case STAGE_STATE:
		enter(d, STAGE_SCAN); /* LMS and TiM that measure were seen to say 0, busy: nothing follows from it */
		break;
	case STAGE_LOGIN:
	case STAGE_LOGIN_SAFE:
		take_login(d, r, t_ns);
		break;
	case STAGE_SCAN:
		cola_scan_setup_read(r, &d->scan);
		compare_scan(d, t_ns);
		break;
	case STAGE_SCAN_SET:
		take_scan_set(d, r, t_ns);
		break;
	case STAGE_RANGE:
		cola_range_setup_read(r, &d->range);
		compare_range(d, t_ns);
		break;
	case STAGE_RANGE_SET:
		enter(d, STAGE_DATA);
		break;
	case STAGE_DATA:
		cola_data_setup_read(r, &d->data);
		compare_data(d);
		break;
	case STAGE_DATA_SET:
		d->data.known = true;
		look_at_encoder(d, 0);
		break;
	case STAGE_ENCODER:
		cola_number_read(r, &d->number);
		compare_encoder(d);
		break;
	case STAGE_ENCODER_SET:
		look_at_encoder(d, d->encoder + 1);
		break;
	case STAGE_START:
		d->started = true;
		enter(d, STAGE_RUN);
		break;
	case STAGE_RUN:
		d->logged_in = false;
		after_settings(d);
		break;
	case STAGE_READY:
		take_ready(d, r, t_ns);
		break;
	case STAGE_STREAM:
	case STAGE_STREAM_SAFE:
		take_stream(d, r, t_ns);
		break;
	default: /* STOP */
		fail(d, "");
		break;
	}
}

/* Refused, or not answered, and no harm: on as if nothing had been asked. */
static void go_on(struct dialogue *d, int64_t t_ns)
{
	struct cola_reader nothing = {.dialect = d->dialect, .failed = true};
	if (d->stage == STAGE_IDENT)
		enter(d, d->dialect == COLA_A ? STAGE_IDENT_INDEX : STAGE_FIRMWARE);
	else if (d->stage == STAGE_IDENT_INDEX)
		enter(d, STAGE_FIRMWARE);
	else
		advance(d, &nothing, t_ns);
}

static void take_error(struct dialogue *d, uint32_t code, int64_t t_ns)
{
	enum { VARIABLE_UNKNOWN = 3, BUSY = 0xd, EVENT_UNKNOWN = 0xf };
	const bool unknown = code == EVENT_UNKNOWN || code == VARIABLE_UNKNOWN;
	if (code == BUSY && d->stage != STAGE_STOP && ++d->busy <= BUSY_MAX) {
		d->ask = ASK_PAUSING;
		d->until_ns = t_ns + BUSY_NS;
	} else if (d->stage == STAGE_PROBE && code == EVENT_UNKNOWN) {
		d->safe = true;
		enter(d, STAGE_PROBE_SAFE);
	} else if (d->stage == STAGE_STREAM && unknown) {
		enter(d, STAGE_STREAM_SAFE);
	} else if (d->stage == STAGE_LOGIN || d->stage == STAGE_LOGIN_SAFE) {
		struct cola_reader nothing = {.dialect = d->dialect, .failed = true};
		take_login(d, &nothing, t_ns);
	} else if (exchanges[d->stage].asks) {
		go_on(d, t_ns);
	} else {
		fail_refused(d, cola_error_text(code), t_ns);
	}
}

/* Time --------------------------------------------------------------------------------------------------------------- */

static enum cola_dialect other(enum cola_dialect dialect)
{
	return dialect == COLA_A ? COLA_B : COLA_A;
}

static void probe_again(struct dialogue *d)
{
	const bool any = d->config->protocol == PROTOCOL_AUTO;
	if (++d->probes < PROBES) {
		if (any)
			d->dialect = other(d->dialect);
		enter(d, STAGE_PROBE);
		return;
	}
	if (any)
		fail(d, "connected, but no scanner answers, in CoLa-A or in CoLa-B: check the address; after "
		        "power-on it needs up to 40 s");
	else
		fail(
		    d,
		    d->config->protocol == PROTOCOL_COLA_A
		        ? "no scanner answers in CoLa-A: set `protocol: auto` to try CoLa-B, too, and check the address"
		        : "no scanner answers in CoLa-B: set `protocol: auto` to try CoLa-A, too, and check the "
		          "address");
}

/* The answer did not come in time. */
static void silent(struct dialogue *d, int64_t t_ns)
{
	char sentence[160];
	if (d->stage == STAGE_PROBE) {
		probe_again(d);
	} else if (++d->tries < exchanges[d->stage].tries) {
		d->ask = ASK_PAUSING;
		d->until_ns = t_ns + PAUSE_NS;
	} else if (exchanges[d->stage].asks && exchanges[d->stage].tries == 1) {
		go_on(d, t_ns);
	} else {
		snprintf(sentence, sizeof sentence,
		         "the scanner does not answer to %s %s: check the line, or switch it off and on",
		         exchanges[d->stage].command, name_of(d, d->stage));
		fail(d, sentence);
	}
}

/* Between two telegrams, by what the scanner said, or by what came where it said nothing or sends less. 0: not known. */
static int64_t period_ns(const struct dialogue *d)
{
	int64_t said_ns = 0, seen_ns = 0;
	if (d->scan.known && d->scan.frequency_chz && d->data.known && d->data.every)
		said_ns = 100 * 1000000000ll / d->scan.frequency_chz * d->data.every;
	for (int i = 0; i < PERIODS; i++)
		seen_ns += d->interval_ns[i] / PERIODS;
	if (d->intervals < PERIODS)
		return said_ns;
	return seen_ns > said_ns ? seen_ns : said_ns;
}

static int64_t silence_ns(const struct dialogue *d)
{
	const int64_t period = period_ns(d), most = 2 * period > SILENT_MAX ? 2 * period : SILENT_MAX;
	const int64_t five = period && d->intervals >= PERIODS ? SCANS_LOST * period : most; /* it may say too much */
	return five < d->floor_ns ? d->floor_ns : five > most ? most : five;
}

static void judge_silence(struct dialogue *d, int64_t t_ns)
{
	char sentence[160];
	if (t_ns - d->heard_ns < silence_ns(d))
		return;
	if (!d->late_ns)
		d->late_ns = t_ns + GRACE_NS;
	if (t_ns < d->late_ns)
		return;
	d->floor_ns = 2 * d->floor_ns < FLOOR_MAX ? 2 * d->floor_ns : FLOOR_MAX;
	snprintf(sentence, sizeof sentence,
	         "no scan for %d ms, %d were due: the connection is dead or the scanner stands still",
	         (int)((t_ns - d->heard_ns) / MS),
	         period_ns(d) ? (int)((t_ns - d->heard_ns) / period_ns(d)) : SCANS_LOST);
	fail(d, sentence);
}

static void wait_for_first(struct dialogue *d, int64_t t_ns)
{
	if (t_ns < d->until_ns)
		return;
	d->stood_still = true;
	fail(d, "the scanner was switched to streaming and sends no scan that can be read: is it measuring?");
}

static void drain_step(struct dialogue *d, int64_t t_ns)
{
	d->until_ns = d->heard ? d->heard_ns + QUIET_NS : t_ns;
	if (d->until_ns > d->drain_ns)
		d->until_ns = d->drain_ns;
	if (t_ns >= d->until_ns)
		enter(d, STAGE_IDENT);
}

/* Requests ----------------------------------------------------------------------------------------------------------- */

static size_t request(const struct dialogue *d, uint8_t *ret)
{
	struct cola_writer w;
	char words[48];
	snprintf(words, sizeof words, "%s %s", exchanges[d->stage].command, name_of(d, d->stage));
	cola_writer_init(&w, d->dialect, ret, DIALOGUE_WRITE_MAX, words);
	switch (d->stage) {
	case STAGE_PROBE:
	case STAGE_PROBE_SAFE:
	case STAGE_STOP:
		cola_write_u(&w, 0, 1);
		break;
	case STAGE_STREAM:
	case STAGE_STREAM_SAFE:
		cola_write_u(&w, 1, 1);
		break;
	case STAGE_LOGIN:
	case STAGE_LOGIN_SAFE:
		cola_write_digits(&w, LEVEL, 1);
		cola_write_digits(&w, d->stage == STAGE_LOGIN ? HASH : HASH_SAFE, 4);
		break;
	case STAGE_SCAN_SET:
		cola_scan_setup_write(&w, &d->scan);
		break;
	case STAGE_RANGE_SET:
		cola_range_setup_write(&w, &d->range);
		break;
	case STAGE_DATA_SET:
		cola_data_setup_write(&w, &d->data);
		break;
	case STAGE_ENCODER_SET:
		cola_number_write(&w, &d->number);
		break;
	default:
		break;
	}
	return cola_writer_end(&w);
}

static void exchange_step(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	if (d->ask == ASK_SENT) { /* the bytes are with the kernel now */
		d->ask = ASK_WAITING;
		d->until_ns = t_ns + exchanges[d->stage].patience_ns;
	}
	if (d->ask == ASK_WAITING && t_ns >= d->until_ns)
		silent(d, t_ns);
	if (!exchanges[d->stage].command)
		return; /* given up, or gone on to where nothing is asked */
	if (d->ask == ASK_PAUSING && t_ns >= d->until_ns)
		d->ask = ASK_SENDING;
	if (d->ask == ASK_SENDING) {
		ret->write_len = request(d, ret->write);
		d->ask = ASK_SENT;
		d->until_ns = t_ns + exchanges[d->stage].patience_ns;
	}
}

/* What the supervisor calls ------------------------------------------------------------------------------------------ */

void cola_dialogue_reply(struct dialogue *d, const struct reply *reply)
{
	const enum cola_dialect dialect = reply->kind & COLA_B_FLAG ? COLA_B : COLA_A;
	const enum cola_reply kind = (enum cola_reply)(reply->kind & ~COLA_B_FLAG);
	struct cola_reader r;
	if (!exchanges[d->stage].command || d->ask == ASK_SENDING)
		return;
	if (dialect != d->dialect && (d->found || d->config->protocol != PROTOCOL_AUTO))
		return;
	if (kind == COLA_DATA || kind == COLA_OTHER)
		return;
	d->dialect = dialect;
	d->found = d->worked = true;
	if (kind == COLA_ERROR) {
		cola_reader_init(&r, dialect, reply->payload, reply->len, "");
		take_error(d, cola_read_u(&r, 2), reply->t_ns);
		return;
	}
	if (!cola_reader_init(&r, dialect, reply->payload, reply->len, name_of(d, d->stage)))
		return; /* of an earlier request */
	if (kind == COLA_LATER) {
		d->ask = ASK_WAITING;
		d->until_ns = reply->t_ns + LATER_NS;
	} else if (kind == exchanges[d->stage].answer) {
		advance(d, &r, reply->t_ns);
	}
}

/* Time that was given for hiccups is taken back when none needed it any more. */
static void follow_hiccups(struct dialogue *d, int64_t t_ns)
{
	if (t_ns - d->heard_ns > d->floor_ns / 2)
		d->steady_ns = t_ns;
	if (t_ns - d->steady_ns < STEADY_NS)
		return;
	d->floor_ns = d->floor_ns / 2 > SILENT_NS ? d->floor_ns / 2 : SILENT_NS;
	d->steady_ns = t_ns;
}

void cola_dialogue_data(struct dialogue *d, int64_t t_ns)
{
	if (d->stage == STAGE_STREAMING && t_ns > d->heard_ns) /* several came at once: one, as far as time goes */
		d->interval_ns[d->intervals++ % PERIODS] = t_ns - d->heard_ns;
	if (d->stage == STAGE_STREAMING)
		follow_hiccups(d, t_ns);
	d->heard = true;
	d->heard_ns = t_ns;
	d->late_ns = 0;
	if (d->stage == STAGE_FIRST) {
		d->stage = STAGE_STREAMING;
		d->steady_ns = t_ns;
		d->intervals = 0;
		d->told[0] = '\0';
		d->stood_still = false;
	}
}

void cola_dialogue_step(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	*ret = (struct dialogue_step){.deadline_ns = NEVER, .state = DIALOGUE_CONFIGURING};
	if (d->stage == STAGE_DRAIN)
		drain_step(d, t_ns);
	if (d->stage == STAGE_FIRST)
		wait_for_first(d, t_ns);
	if (d->stage == STAGE_STREAMING)
		judge_silence(d, t_ns);
	if (d->stage == STAGE_HOLD && t_ns >= d->until_ns)
		d->stage = STAGE_FAILED;
	if (exchanges[d->stage].command)
		exchange_step(d, t_ns, ret);

	if (d->stage == STAGE_FAILED) {
		ret->state = DIALOGUE_FAILED;
		memcpy(ret->error, d->error, sizeof ret->error);
	} else if (d->stage == STAGE_STREAMING) {
		ret->state = DIALOGUE_STREAMING;
		ret->deadline_ns = d->late_ns ? d->late_ns : d->heard_ns + silence_ns(d);
	} else {
		ret->deadline_ns = d->until_ns;
	}
}

void cola_dialogue_stop(struct dialogue *d, int64_t t_ns)
{
	(void)t_ns;
	if (d->stage == STAGE_STOP)
		return;
	if (d->found && d->stage != STAGE_FAILED)
		enter(d, STAGE_STOP);
	else
		fail(d, ""); /* nobody is known to listen */
}

void cola_dialogue_reset(struct dialogue *d, int64_t t_ns)
{
	if (d->config->protocol != PROTOCOL_AUTO)
		d->dialect = d->config->protocol == PROTOCOL_COLA_B ? COLA_B : COLA_A;
	else if (!d->worked)
		d->dialect = COLA_A;
	d->found = d->safe = d->logged_in = d->started = d->heard = false;
	d->probes = d->intervals = 0;
	d->model[0] = d->version[0] = d->error[0] = '\0';
	d->scan = (struct cola_scan_setup){0};
	d->range = (struct cola_range_setup){0};
	d->data = (struct cola_data_setup){0};
	memset(d->interval_ns, 0, sizeof d->interval_ns);
	d->ready_ns = d->late_ns = 0;
	d->heard_ns = t_ns;
	enter(d, STAGE_PROBE);
}

struct dialogue *cola_dialogue_create(const struct config *config, int device)
{
	struct dialogue *d = calloc(1, sizeof *d);
	if (!d)
		return NULL;
	d->config = &config->device[device];
	d->family = cola_family(d->config->driver);
	d->floor_ns = SILENT_NS;
	cola_dialogue_reset(d, 0);
	return d;
}

void cola_dialogue_destroy(struct dialogue *d)
{
	free(d);
}

/* What a simulated CoLa scanner answers. It speaks the dialect it is set to and says nothing to the other one.
 *
 * Variables are one table: name, width of each value, who may write. What is written is checked, kept, and changes what
 * is sent from the next scan on. */
#include <stdio.h>
#include <string.h>

#include "tools/sim_cola.h"

#define ANSWER_NS 2000000     /* a request takes 1 to 5 ms */
#define START_NS  500000000ll /* until the mirror measures again */

enum {
	METHOD_DENIED = 0x1,
	UNKNOWN_VARIABLE = 0x3,
	OUT_OF_RANGE = 0x4,
	TOO_FEW = 0x8,
	WRITE_DENIED = 0xA,
	UNKNOWN_COMMAND = 0xC,
	UNKNOWN_EVENT = 0xF
};
enum { CLIENT = 3 };

static const struct {
	const char *name, *widths; /* bytes of each value */
	bool lms;                  /* TiM do not have it */
} variables[VARIABLES] = {
    [DATA_CONFIG] = {"LMDscandatacfg", "111111111112", false},
    [OUTPUT_RANGE] = {"LMPoutputRange", "2444", false},
    [SCAN_CONFIG] = {"LMPscancfg", "42444", true},
    [ENCODER_SET] = {"LICencset", "1", true},
    [ENCODER_SOURCE] = {"LICsrc", "1", true},
    [ENCODER_STEPS] = {"LICencres", "4", true},
    [OUTPUTS_34] = {"DO3And4Fnc", "1", true},
    [CLOCK_ROLE] = {"TSCRole", "1", false},
    [CLOCK_PORT] = {"TSCTCInterface", "1", false},
    [CLOCK_SERVER] = {"TSCTCSrvAddr", "1111", false},
};

void sim_cola_set_factory(struct cola *d)
{
	const struct cola_model *m = d->model;
	const uint32_t config[] = {1, 0, 0, 0, 0, 0, 0, 0, 0, 0, m->lms, 1};
	const uint32_t scan[] = {m->frequency_chz, 1, m->step_tdeg, (uint32_t)m->start_tdeg, (uint32_t)m->stop_tdeg};
	memset(d->value, 0, sizeof d->value);
	memcpy(d->value[DATA_CONFIG], config, sizeof config);
	memcpy(d->value[OUTPUT_RANGE], m->range, sizeof m->range);
	memcpy(d->value[SCAN_CONFIG], scan, sizeof scan);
	snprintf(d->name, sizeof d->name, "not defined");
}

/* Answers */

struct request {
	struct cola_session *session;
	struct cola *d;
	char word[4], name[40];
	struct cola_reader reader; /* at the first value */
	struct cola_writer writer;
	uint8_t answer[512];
};

/* "sAN Run": what comes behind it is written by the caller. */
static void begin(struct request *q, const char *word)
{
	char words[48];
	snprintf(words, sizeof words, "%s %s", word, q->name);
	cola_writer_init(&q->writer, q->d->dialect, q->answer, sizeof q->answer, words);
}

static void finish(struct request *q)
{
	const size_t len = cola_writer_end(&q->writer);
	q->d->counts.replies++;
	sim_line_put(&q->session->line, q->answer, len, q->d->now_ns + ANSWER_NS, false);
}

/* Without values, CoLa-B ends in a blank. */
static void answer_done(struct request *q, const char *word)
{
	begin(q, word);
	if (q->d->dialect == COLA_B)
		cola_write_chars(&q->writer, "", 0);
	finish(q);
}

static void answer_number(struct request *q, const char *word, uint32_t value, int bytes)
{
	begin(q, word);
	cola_write_u(&q->writer, value, bytes);
	finish(q);
}

static void answer_text(struct request *q, const char *text)
{
	begin(q, "sRA");
	cola_write_string(&q->writer, text, strlen(text), 2);
	finish(q);
}

static void answer_error(struct request *q, uint32_t code)
{
	cola_writer_init(&q->writer, q->d->dialect, q->answer, sizeof q->answer, "sFA");
	cola_write_u(&q->writer, code, 2);
	finish(q);
}

/* Variables */

static int variable(const struct cola *d, const char *name)
{
	for (int i = 0; i < VARIABLES; i++)
		if (strcmp(variables[i].name, name) == 0 && (d->model->lms || !variables[i].lms))
			return i;
	return -1;
}

static void answer_variable(struct request *q, int i)
{
	begin(q, "sRA");
	for (int k = 0; variables[i].widths[k] != '\0'; k++)
		cola_write_u(&q->writer, q->d->value[i][k], variables[i].widths[k] - '0');
	finish(q);
}

/* False: too few values, or too many. */
static bool read_values(struct request *q, int i, uint32_t *ret)
{
	for (int k = 0; variables[i].widths[k] != '\0'; k++)
		ret[k] = variables[i].widths[k] == '4' ? (uint32_t)cola_read_i(&q->reader, 4)
		                                       : cola_read_u(&q->reader, variables[i].widths[k] - '0');
	return cola_reader_done(&q->reader);
}

static bool allowed(const struct cola *d, int i, const uint32_t *value)
{
	const int32_t start = (int32_t)value[RANGE_START], stop = (int32_t)value[RANGE_STOP];
	switch (i) {
	case DATA_CONFIG:
		return value[CONFIG_CHANNEL] >= 1 && value[CONFIG_REMISSION] <= 1 && value[CONFIG_WIDE] <= 1 &&
		       value[CONFIG_EVERY] >= 1;
	case OUTPUT_RANGE:
		return start < stop && start >= d->model->start_tdeg - 10 && stop <= d->model->stop_tdeg + 10;
	default:
		return i != SCAN_CONFIG; /* by its method only */
	}
}

static void write_variable(struct request *q, int i)
{
	uint32_t value[SIM_COLA_VALUES] = {0};
	if (q->session->level < CLIENT)
		answer_error(q, WRITE_DENIED);
	else if (!read_values(q, i, value))
		answer_error(q, TOO_FEW);
	else if (!allowed(q->d, i, value))
		answer_error(q, i == SCAN_CONFIG ? WRITE_DENIED : OUT_OF_RANGE);
	else {
		memcpy(q->d->value[i], value, sizeof value);
		answer_done(q, "sWA");
	}
}

/* sRN, sRI */

static uint32_t measuring_state(struct cola *d)
{
	enum { INIT = 1, IDLE = 3, PREPARING = 5, MEASURES = 7 };
	if (cola_fault(d, SIM_COLA_BUSY)->on)
		return PREPARING;
	if (d->now_ns < d->on_ns + START_NS)
		return INIT;
	return !d->measuring ? IDLE : d->now_ns < d->ready_ns ? PREPARING : MEASURES;
}

static void answer_state(struct request *q)
{
	begin(q, "sRA");
	cola_write_u(&q->writer, measuring_state(q->d), 2);
	cola_write_u(&q->writer, 0, 1);
	cola_write_string(&q->writer, "00:00:00", 8, 2);
	cola_write_string(&q->writer, "01.01.1970", 10, 2);
	for (int i = 0; i < 3; i++)
		cola_write_u(&q->writer, 0, 1);
	finish(q);
}

static void answer_identity(struct request *q)
{
	begin(q, "sRA");
	cola_write_string(&q->writer, q->d->model->name, strlen(q->d->model->name), 2);
	cola_write_string(&q->writer, q->d->model->version, strlen(q->d->model->version), 2);
	finish(q);
}

static uint32_t device_state(struct cola *d)
{
	if (cola_fault(d, SIM_COLA_ERROR_STATE)->on)
		return 2;
	return !cola_fault(d, SIM_COLA_BUSY)->on && !d->model->lms; /* LMS say 0 while they work */
}

static void read_other(struct request *q)
{
	struct cola *d = q->d;
	char serial[12];
	snprintf(serial, sizeof serial, "%08u", d->params.serial);
	if (!strcmp(q->name, "DeviceIdent") || (!strcmp(q->word, "sRI") && !strcmp(q->name, "0")))
		answer_identity(q);
	else if (!strcmp(q->name, "SerialNumber"))
		answer_text(q, serial);
	else if (!strcmp(q->name, "FirmwareVersion"))
		answer_text(q, d->model->version);
	else if (!strcmp(q->name, "LocationName"))
		answer_text(q, d->name);
	else if (!strcmp(q->name, "SCdevicestate"))
		answer_number(q, "sRA", device_state(d), 1);
	else if (!strcmp(q->name, "ODoprh"))
		answer_number(q, "sRA", 0x456, 4);
	else if (!strcmp(q->name, "ODpwrc"))
		answer_number(q, "sRA", 63 + (uint32_t)d->counts.power_cycles, 4);
	else if (!strcmp(q->name, "STlms") && d->model->lms)
		answer_state(q);
	else if (!strcmp(q->name, "LMDscandata") && d->model->ranging)
		q->session->single = true; /* the next scan is the answer */
	else
		answer_error(q, UNKNOWN_VARIABLE);
}

/* sWN */

static void write_dialect(struct request *q)
{
	const uint32_t wanted = cola_read_u(&q->reader, 1);
	if (!cola_reader_done(&q->reader) || wanted > 1) {
		answer_error(q, OUT_OF_RANGE);
		return;
	}
	answer_done(q, "sWA"); /* still in the one it was asked in */
	q->d->dialect = wanted ? COLA_B : COLA_A;
}

static void write_name(struct request *q)
{
	const char *text = NULL;
	size_t len = 0;
	cola_read_string(&q->reader, 2, &text, &len);
	if (q->session->level < CLIENT)
		answer_error(q, WRITE_DENIED);
	else if (!cola_reader_done(&q->reader) || len > 16)
		answer_error(q, OUT_OF_RANGE);
	else {
		memcpy(q->d->name, text, len);
		q->d->name[len] = '\0';
		answer_done(q, "sWA");
	}
}

/* sMN */

static void log_in(struct request *q)
{
	static const uint32_t hashes[] = {0, 0, 0xB21ACE26, 0, 0x81BE23AA};
	const uint32_t level = cola_read_u(&q->reader, 1), hash = cola_read_u(&q->reader, 4);
	const bool known = !q->reader.failed && level >= 2 && level <= 4 &&
	                   hash == (level == CLIENT ? q->d->model->hash : hashes[level]);
	if (known)
		q->session->level = (int)level;
	answer_number(q, "sAN", known, 1);
}

static bool mirror_can(const struct cola *d, uint32_t frequency_chz, uint32_t step_tdeg, uint32_t *ret_code)
{
	static const struct {
		uint32_t frequency_chz, step_tdeg[3];
	} lms1xx[] = {{2500, {2500}}, {5000, {5000, 2500}}, {0}},
	  lms5xx[] = {{2500, {1667, 2500}},  {3500, {2500, 5000}},   {5000, {3333, 5000}},
	              {7500, {5000, 10000}}, {10000, {6667, 10000}}, {0}};
	*ret_code = 1;
	for (int i = 0; (d->model->wire_version ? lms1xx : lms5xx)[i].frequency_chz != 0; i++) {
		if ((d->model->wire_version ? lms1xx : lms5xx)[i].frequency_chz != frequency_chz)
			continue;
		*ret_code = 2;
		for (int k = 0; k < 3; k++)
			if ((d->model->wire_version ? lms1xx : lms5xx)[i].step_tdeg[k] == step_tdeg && step_tdeg != 0)
				return true;
	}
	return false;
}

static void set_scan(struct request *q)
{
	struct cola *d = q->d;
	uint32_t value[SIM_COLA_VALUES] = {0}, code = 5;
	if (q->session->level < CLIENT) {
		answer_error(q, METHOD_DENIED);
		return;
	}
	if (!read_values(q, SCAN_CONFIG, value)) {
		answer_error(q, TOO_FEW);
		return;
	}
	if (mirror_can(d, value[SCAN_FREQUENCY], value[SCAN_STEP], &code))
		code = (int32_t)value[SCAN_START] >= (int32_t)value[SCAN_STOP] ? 4 : 0;
	if (code == 0) {
		d->value[SCAN_CONFIG][SCAN_FREQUENCY] = value[SCAN_FREQUENCY];
		d->value[SCAN_CONFIG][SCAN_STEP] = value[SCAN_STEP];
		memcpy(d->value[OUTPUT_RANGE], d->model->range, sizeof d->model->range); /* to be written anew */
		d->value[OUTPUT_RANGE][RANGE_STEP] = value[SCAN_STEP];
		sim_cola_start_mirror(d);
	}
	begin(q, "sAN");
	cola_write_u(&q->writer, code, 1);
	for (int k = 0; k < 5; k++)
		cola_write_u(&q->writer, d->value[SCAN_CONFIG][k], k == SCAN_SECTORS ? 2 : 4);
	finish(q);
}

static void start_measuring(struct cola *d, bool on)
{
	if (on && !d->measuring) {
		d->ready_ns = d->now_ns + START_NS;
		d->measuring = true;
		sim_cola_start_mirror(d);
	}
	d->measuring = on;
}

static void reboot(struct cola *d)
{
	d->counts.power_cycles++;
	d->off = true;
	d->ready_ns = d->now_ns + d->model->boot_ns;
	for (int i = 0; i < SIM_COLA_SESSIONS; i++)
		d->session[i].streaming = d->session[i].single = false;
}

static void run_method(struct request *q)
{
	struct cola *d = q->d;
	const bool client = q->session->level >= CLIENT;
	const bool measures = !strcmp(q->name, "LMCstartmeas"), stops = !strcmp(q->name, "LMCstopmeas"),
	           rests = !strcmp(q->name, "LMCstandby");
	if (!strcmp(q->name, "SetAccessMode")) {
		log_in(q);
	} else if (!strcmp(q->name, "Run")) {
		q->session->level = 0;
		answer_number(q, "sAN", 1, 1);
	} else if (!strcmp(q->name, "mLMPsetscancfg") && d->model->lms) {
		set_scan(q);
	} else if ((measures || stops || rests) && (client || measures)) {
		start_measuring(d, measures);
		answer_number(q, "sAN", 0, 1); /* 0 is well */
	} else if (!strcmp(q->name, "mEEwriteall") && client) {
		answer_number(q, "sAN", 1, 1);
	} else if (!strcmp(q->name, "mSCreboot") && client) {
		answer_done(q, "sAN");
		reboot(d);
	} else {
		const bool known = stops || rests || !strcmp(q->name, "mEEwriteall") || !strcmp(q->name, "mSCreboot");
		answer_error(q, known ? METHOD_DENIED : UNKNOWN_VARIABLE);
	}
}

/* sEN */

static void switch_event(struct request *q)
{
	struct cola *d = q->d;
	const uint32_t on = cola_read_u(&q->reader, 1);
	const bool monitored = d->model->monitored || cola_fault(d, SIM_COLA_MONITORED)->on;
	const char *stream = d->model->monitored ? "LMDscandatamon" : "LMDscandata";
	const bool scans =
	    d->model->ranging && (!strcmp(q->name, stream) || (monitored && !strcmp(q->name, "LMDscandatamon")));
	const bool other = !strcmp(q->name, "LIDoutputstate") || !strcmp(q->name, "LIDinputstate") ||
	                   (d->model->lms && !strcmp(q->name, "LFErec"));
	if (!cola_reader_done(&q->reader) || on > 1) {
		answer_error(q, OUT_OF_RANGE);
	} else if (!scans && !other) {
		answer_error(q, UNKNOWN_EVENT);
	} else {
		answer_number(q, "sEA", on, 1);
		if (scans)
			q->session->streaming = on;
	}
}

/* Requests */

static void obey(struct request *q)
{
	const int i = variable(q->d, q->name);
	if (!strcmp(q->word, "sRN") && i >= 0)
		answer_variable(q, i);
	else if (!strcmp(q->word, "sRN") || !strcmp(q->word, "sRI"))
		read_other(q);
	else if (!strcmp(q->word, "sWN") && !strcmp(q->name, "EIHstCola"))
		write_dialect(q);
	else if (!strcmp(q->word, "sWN") && !strcmp(q->name, "LocationName"))
		write_name(q);
	else if (!strcmp(q->word, "sWN") && i >= 0)
		write_variable(q, i);
	else if (!strcmp(q->word, "sMN"))
		run_method(q);
	else if (!strcmp(q->word, "sEN"))
		switch_event(q);
	else
		answer_error(q, !strcmp(q->word, "sWN") ? UNKNOWN_VARIABLE : UNKNOWN_COMMAND);
}

/* "sRN LMPscancfg ...": the word, the name, and a reader behind them. */
static bool take_words(struct request *q, enum cola_dialect dialect, const uint8_t *payload, size_t len)
{
	size_t end = 4;
	if (len < 5)
		return false;
	while (end < len && payload[end] != ' ')
		end++;
	if (end - 4 >= sizeof q->name)
		return false;
	memcpy(q->word, payload, 3);
	memcpy(q->name, payload + 4, end - 4);
	return cola_reader_init(&q->reader, dialect, payload, len, q->name);
}

void sim_cola_answer(struct cola_session *session, const uint8_t *frame, size_t len)
{
	struct cola *d = session->device;
	struct request q = {.session = session, .d = d};
	const uint8_t *payload;
	size_t payload_len;
	const enum cola_dialect dialect = cola_payload(frame, len, &payload, &payload_len);
	if (dialect != d->dialect || !take_words(&q, dialect, payload, payload_len))
		return;
	d->counts.requests++;
	if (sim_fault_due(cola_fault(d, SIM_COLA_NO_ANSWER)))
		return;
	if (sim_fault_due(cola_fault(d, SIM_COLA_SFA)))
		answer_error(&q, (uint32_t)sim_fault_value(cola_fault(d, SIM_COLA_SFA), UNKNOWN_VARIABLE));
	else
		obey(&q);
}

/* LMS2xx: from any state the scanner may be in to the stream that was asked for. Pure, in virtual time.
 *
 *   LINE -> SETTLE -> PROBE     at each rate until 20 25 is answered: the configured one first, then the last that
 * worked
 *   -> TYPE -> STATUS -> CONFIG     who it is and how it is set up; the decoder learns from the same bytes
 *   -> [INSTALL -> WRITE -> LEAVE]  only where the configuration differs: it is written to an EEPROM
 *   -> [VARIANT]                    only where it differs
 *   -> [BAUD -> LINE -> VERIFY]     the answer still comes at the old rate
 *   -> START -> STREAMING
 *
 * Every stage between SETTLE and STREAMING is one exchange: telegram out, ACK, reply. A NAK, a time-out or a gap among
 * the bytes repeats it; a lost ACK is forgiven, since the reply says more. Where a scanner streams, its ACK may hide
 * behind the rest of a measurement, so 20 25 is sent twice at a rate before the next is tried.
 *
 * At 500 kBd the scanner wants its bytes one by one: one per step, 1 ms apart; when the host was busy for more than
 * 6 ms the scanner has given up on the telegram, and it is repeated from its first byte after a pause.
 *
 * While streaming, 2 s without a telegram, or a message of power-on, begin everything anew.
 *
 * A rate that the line cannot do is found before the scanner is told of it, since the wanted rate is the first that is
 * tried: the link fails and is opened again, and the next lower rate is streamed at. The like where the scanner refuses. */
#include "drivers/lms2xx.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "drivers/lms2xx_wire.h"

enum stage {
	STAGE_LINE,
	STAGE_SETTLE,
	STAGE_PROBE,
	STAGE_TYPE,
	STAGE_STATUS,
	STAGE_CONFIG,
	STAGE_INSTALL,
	STAGE_WRITE,
	STAGE_LEAVE,
	STAGE_VARIANT,
	STAGE_BAUD,
	STAGE_VERIFY,
	STAGE_START,
	STAGE_STREAMING,
	STAGE_STOP,
	STAGE_FAILED,
	STAGES
};

/* What an exchange waits for, and what it is called in a sentence. */
static const struct {
	uint8_t expect;
	int64_t reply_ns;
	const char *what;
} exchanges[STAGES] = {
    [STAGE_PROBE] = {LMS2XX_MODE_REPLY, LMS2XX_REPLY_NS, "to stop measuring"},
    [STAGE_TYPE] = {LMS2XX_TYPE_REPLY, LMS2XX_REPLY_NS, "for its type"},
    [STAGE_STATUS] = {LMS2XX_STATUS_REPLY, LMS2XX_REPLY_NS, "for its status"},
    [STAGE_CONFIG] = {LMS2XX_CONFIG_REPLY, LMS2XX_REPLY_NS, "for its configuration"},
    [STAGE_INSTALL] = {LMS2XX_MODE_REPLY, LMS2XX_REPLY_NS, "for installation mode"},
    [STAGE_WRITE] = {LMS2XX_CONFIG_WRITTEN, LMS2XX_WRITE_NS, "to take its new settings"},
    [STAGE_LEAVE] = {LMS2XX_MODE_REPLY, LMS2XX_REPLY_NS, "to leave installation mode"},
    [STAGE_VARIANT] = {LMS2XX_VARIANT_REPLY, LMS2XX_REPLY_NS, "for the variant"},
    [STAGE_BAUD] = {LMS2XX_MODE_REPLY, LMS2XX_REPLY_NS, "for the rate"},
    [STAGE_VERIFY] = {LMS2XX_STATUS_REPLY, LMS2XX_REPLY_NS, "for its status at the new rate"},
    [STAGE_START] = {LMS2XX_MODE_REPLY, LMS2XX_REPLY_NS, "to measure"},
    [STAGE_STOP] = {LMS2XX_MODE_REPLY, LMS2XX_REPLY_NS, "to stop measuring"},
};

enum { RATES = 7, GAPS_MAX = 20, RESTARTS_MAX = 3, WRITES_MAX = 3 };
#define NEVER INT64_MAX

struct dialogue {
	/* what is wanted */
	uint32_t wanted_baud;
	int fov_deg, resolution_cdeg;
	bool parts;   /* a quarter degree over 180 degrees: by partial scans */
	int mode;     /* measuring mode, -1: as it is */
	int unit;     /* enum lms2xx_unit, -1: as it is */
	bool indices; /* real-time indices on; else as they are */

	enum stage stage;
	enum stage after_settle;
	int64_t until_ns; /* end of SETTLE */

	/* the search */
	uint32_t rate[RATES];
	int rates, at;
	uint32_t target;  /* rate to stream at: the wanted one, or the next lower that is not refused */
	uint32_t worked;  /* rate of the last contact, 0: none yet */
	unsigned suspect; /* rate at which the line was lost the last time, as a bit */
	unsigned refused; /* rates at which the line was lost when they were set, twice running: not tried again */
	bool declined;    /* the scanner does not take the target */
	bool setting;     /* a rate was asked for and no step came since */
	int restarts;     /* searches since the last stream */

	/* the exchange */
	uint8_t telegram[LMS2XX_REQUEST_MAX + 6];
	size_t len, sent;
	enum { ASK_SENDING, ASK_WAITING, ASK_PAUSING } ask;
	int64_t next_ns; /* SENDING: of the next byte; WAITING: end of patience; PAUSING: end of the pause */
	int64_t last_byte_ns;
	int tries, gaps;
	bool rejected; /* its last try ended with a refusal, not with silence */

	bool variant_fits;
	struct lms2xx_config config; /* to be written */
	int writes;                  /* of it since it was as wanted: its memory wears */
	int64_t heard_ns;            /* last valid telegram */
	const char *why;             /* everything begins anew, NULL: it is the first time */
	char error[160];
	char note[160]; /* why it does not stream at the wanted rate */
};

static const uint32_t all_rates[] = {500000, 38400, 19200, 9600};
enum { ALL_RATES = sizeof all_rates / sizeof all_rates[0] };

static unsigned rate_bit(uint32_t baud)
{
	for (unsigned i = 0; i < ALL_RATES; i++)
		if (all_rates[i] == baud)
			return 1u << i;
	return 0;
}

static uint32_t rate_now(const struct dialogue *d)
{
	return d->rate[d->at];
}

/* A byte takes ten bits. */
static int64_t transfer_ns(uint32_t baud, size_t bytes)
{
	return (int64_t)bytes * 10 * 1000000000 / baud;
}

static void fail(struct dialogue *d, const char *sentence)
{
	d->stage = STAGE_FAILED;
	snprintf(d->error, sizeof d->error, "%s", sentence);
}

static void add_rate(struct dialogue *d, uint32_t baud)
{
	if (baud == 0 || (d->refused & rate_bit(baud)) != 0)
		return;
	for (int i = 0; i < d->rates; i++)
		if (d->rate[i] == baud)
			return;
	d->rate[d->rates++] = baud;
}

/* The wanted rate, else the next lower one that the line does, else any. */
static void choose_target(struct dialogue *d)
{
	d->declined = false;
	d->note[0] = 0;
	d->target = d->wanted_baud;
	for (int i = 0; i < ALL_RATES && (d->refused & rate_bit(d->target)) != 0; i++)
		if (all_rates[i] < d->wanted_baud)
			d->target = all_rates[i];
	for (int i = ALL_RATES - 1; i >= 0 && (d->refused & rate_bit(d->target)) != 0; i--)
		d->target = all_rates[i];
	if (d->target != d->wanted_baud)
		snprintf(d->note, sizeof d->note,
		         "streams at %u Bd: the line refuses %u, use an adapter that knows it or set `baud`",
		         (unsigned)d->target, (unsigned)d->wanted_baud);
}

/* Everything anew, beginning at rate `first` (0: as usual). */
static void search(struct dialogue *d, uint32_t first)
{
	choose_target(d);
	d->rates = d->at = 0;
	add_rate(d, first);
	add_rate(d, d->target);
	add_rate(d, d->worked);
	add_rate(d, 9600);
	add_rate(d, 38400);
	add_rate(d, 19200);
	add_rate(d, 500000);
	d->stage = STAGE_LINE;
	d->after_settle = STAGE_PROBE;
}

static size_t request(const struct dialogue *d, enum stage stage, uint8_t *ret)
{
	uint8_t p[LMS2XX_REQUEST_MAX] = {LMS2XX_MODE};
	size_t len = 2;
	switch (stage) {
	case STAGE_TYPE:
		p[0] = LMS2XX_TYPE;
		len = 1;
		break;
	case STAGE_STATUS:
	case STAGE_VERIFY:
		p[0] = LMS2XX_STATUS;
		len = 1;
		break;
	case STAGE_CONFIG:
		p[0] = LMS2XX_CONFIG_READ;
		len = 1;
		break;
	case STAGE_INSTALL:
		p[1] = LMS2XX_MODE_INSTALL;
		memcpy(p + 2, LMS2XX_PASSWORD, 8);
		len = 10;
		break;
	case STAGE_WRITE:
		p[0] = LMS2XX_CONFIG_WRITE;
		memcpy(p + 1, d->config.bytes, d->config.len);
		len = 1 + d->config.len;
		break;
	case STAGE_VARIANT:
		p[0] = LMS2XX_VARIANT;
		p[1] = (uint8_t)d->fov_deg;
		p[3] = (uint8_t)d->resolution_cdeg;
		len = 5;
		break;
	case STAGE_BAUD:
		p[1] = lms2xx_baud_mode(d->target);
		break;
	case STAGE_START:
		p[1] = d->parts ? LMS2XX_MODE_PARTS : LMS2XX_MODE_STREAM;
		break;
	default: /* PROBE, LEAVE, STOP */
		p[1] = LMS2XX_MODE_IDLE;
		break;
	}
	return lms2xx_encode(0, p, len, ret);
}

static void enter(struct dialogue *d, enum stage stage, int64_t t_ns)
{
	const bool cut = d->sent > 0 && d->sent < d->len; /* the scanner has part of another telegram: let it forget */
	d->stage = stage;
	d->len = request(d, stage, d->telegram);
	d->sent = 0;
	d->tries = d->gaps = 0;
	d->rejected = false;
	d->ask = cut ? ASK_PAUSING : ASK_SENDING;
	d->next_ns = cut ? t_ns + LMS2XX_PAUSE_NS : t_ns;
}

static void after_baud(struct dialogue *d, int64_t t_ns)
{
	enter(d, rate_now(d) == d->target || d->declined ? STAGE_START : STAGE_BAUD, t_ns);
}

static void after_config(struct dialogue *d, int64_t t_ns)
{
	if (d->variant_fits)
		after_baud(d, t_ns);
	else
		enter(d, STAGE_VARIANT, t_ns);
}

/* Read-modify-write: what nobody asked for stays as it is. */
static void compare_config(struct dialogue *d, const struct reply *reply)
{
	if (!lms2xx_decode_config(reply->payload, reply->len, &d->config))
		return; /* of no known size: repeated when the time is over */
	const struct lms2xx_config was = d->config;
	if (d->mode >= 0)
		d->config.bytes[LMS2XX_CONFIG_MODE] = (uint8_t)d->mode;
	if (d->unit >= 0)
		d->config.bytes[LMS2XX_CONFIG_UNIT] = (uint8_t)d->unit;
	if (d->indices)
		d->config.bytes[LMS2XX_CONFIG_AVAILABILITY] |= LMS2XX_AVAILABILITY_INDICES;
	const bool differs = memcmp(was.bytes, d->config.bytes, was.len) != 0;
	if (!differs)
		d->writes = 0;
	if (differs && d->writes >= WRITES_MAX)
		fail(d, "the scanner does not keep its new settings: remove `unit`, `mode` and `indices`");
	else if (differs)
		enter(d, STAGE_INSTALL, reply->t_ns);
	else
		after_config(d, reply->t_ns);
}

static void compare_variant(struct dialogue *d, const struct reply *reply)
{
	struct lms2xx_status status;
	if (!lms2xx_decode_status(reply->payload, reply->len, &status))
		return;
	d->variant_fits = status.fov_deg == d->fov_deg && status.resolution_cdeg == d->resolution_cdeg;
	enter(d, STAGE_CONFIG, reply->t_ns);
}

static void written(struct dialogue *d, const struct reply *reply)
{
	struct lms2xx_config taken;
	if (lms2xx_decode_config(reply->payload, reply->len, &taken))
		enter(d, STAGE_LEAVE, reply->t_ns);
	else
		fail(d, "the scanner does not take its new settings: remove `unit`, `mode` and `indices`");
}

static void switched(struct dialogue *d, const struct reply *reply)
{
	bool taken = false;
	int fov_deg, resolution_cdeg;
	if (lms2xx_decode_variant(reply->payload, reply->len, &taken, &fov_deg, &resolution_cdeg) && taken)
		after_baud(d, reply->t_ns);
	else
		fail(d, "the scanner does not know this variant: choose another `variant` (0.25 needs 100 degrees)");
}

/* The rate is the scanner's from now on; the line follows. */
static void follow_baud(struct dialogue *d)
{
	search(d, d->target);
	d->after_settle = STAGE_VERIFY;
}

static void mode_refused(struct dialogue *d, uint8_t result)
{
	char sentence[160];
	if (d->stage == STAGE_INSTALL && result == 1)
		snprintf(sentence, sizeof sentence,
		         "the scanner refuses the password for its settings: remove `unit`, `mode` and `indices`");
	else
		snprintf(sentence, sizeof sentence,
		         "the scanner was asked %s and reports a fault (%u): look at its manual",
		         exchanges[d->stage].what, result);
	fail(d, sentence);
}

/* It stays at the rate it has. */
static void decline(struct dialogue *d)
{
	d->declined = true;
	snprintf(d->note, sizeof d->note,
	         "streams at %u Bd: the scanner refuses %u, set `baud` to a rate that it knows", (unsigned)rate_now(d),
	         (unsigned)d->target);
}

/* The expected reply to the exchange of this stage came. */
static void advance(struct dialogue *d, const struct reply *reply)
{
	const int64_t t_ns = reply->t_ns;
	if (reply->kind == LMS2XX_MODE_REPLY && reply->payload[1] != 0 && d->stage == STAGE_BAUD) {
		decline(d);
		enter(d, STAGE_START, t_ns);
		return;
	}
	if (reply->kind == LMS2XX_MODE_REPLY && reply->payload[1] != 0 && d->stage != STAGE_STOP) {
		mode_refused(d, reply->payload[1]);
		return;
	}
	switch (d->stage) {
	case STAGE_PROBE:
		d->worked = rate_now(d);
		enter(d, STAGE_TYPE, t_ns);
		break;
	case STAGE_TYPE:
		enter(d, STAGE_STATUS, t_ns);
		break;
	case STAGE_STATUS:
		compare_variant(d, reply);
		break;
	case STAGE_CONFIG:
		compare_config(d, reply);
		break;
	case STAGE_INSTALL:
		d->writes++;
		enter(d, STAGE_WRITE, t_ns);
		break;
	case STAGE_WRITE:
		written(d, reply);
		break;
	case STAGE_LEAVE:
		after_config(d, t_ns);
		break;
	case STAGE_VARIANT:
		switched(d, reply);
		break;
	case STAGE_BAUD:
		follow_baud(d);
		break;
	case STAGE_VERIFY:
		d->worked = rate_now(d);
		enter(d, STAGE_START, t_ns);
		break;
	case STAGE_START:
		d->stage = STAGE_STREAMING;
		d->restarts = 0;
		break;
	default: /* STOP: done */
		fail(d, "");
		break;
	}
}

static void nobody_there(struct dialogue *d)
{
	char rates[64] = "";
	size_t len = 0;
	for (int i = 0; i < d->rates; i++)
		len +=
		    (size_t)snprintf(rates + len, sizeof rates - len, "%s%u", i == 0 ? "" : ", ", (unsigned)d->rate[i]);
	d->stage = STAGE_FAILED;
	snprintf(d->error, sizeof d->error, "no scanner answers at %s Bd: check its power, the cable, and `port`",
	         rates);
}

/* All tries of an exchange are used up. */
static void give_up(struct dialogue *d, int64_t t_ns)
{
	if (d->stage == STAGE_STOP) {
		fail(d, "");
	} else if (d->stage == STAGE_PROBE) {
		if (++d->at < d->rates) {
			d->stage = STAGE_LINE;
			return;
		}
		d->at = d->rates - 1;
		nobody_there(d);
	} else if (d->stage == STAGE_BAUD && d->rejected) {
		decline(d);
		enter(d, STAGE_START, t_ns);
	} else if (d->rejected || ++d->restarts >= RESTARTS_MAX) {
		char sentence[160];
		snprintf(sentence, sizeof sentence, "the scanner was asked %s and %s: switch it off and on",
		         exchanges[d->stage].what, d->rejected ? "refuses" : "does not answer");
		d->restarts = 0;
		fail(d, sentence);
	} else {
		search(d, rate_now(d));
	}
}

/* The try failed. */
static void again(struct dialogue *d, int64_t t_ns)
{
	const int tries = d->stage == STAGE_PROBE || d->stage == STAGE_STOP ? 2 : LMS2XX_TRIES;
	if (++d->tries >= tries) {
		give_up(d, t_ns);
		return;
	}
	d->ask = ASK_PAUSING;
	d->sent = 0;
	d->next_ns = t_ns + LMS2XX_PAUSE_NS;
}

void lms2xx_dialogue_reply(struct dialogue *d, const struct reply *reply)
{
	if (d->stage == STAGE_FAILED || d->stage == STAGE_LINE || d->stage == STAGE_SETTLE)
		return;
	d->heard_ns = reply->t_ns;
	if (reply->kind == LMS2XX_POWER_ON && d->stage != STAGE_STOP) {
		d->why = "it was switched off and on";
		search(d, rate_now(d));
		return;
	}
	if (d->stage == STAGE_STREAMING || d->ask == ASK_SENDING)
		return;
	if (reply->kind == exchanges[d->stage].expect)
		advance(d, reply);
	else if (d->ask == ASK_PAUSING)
		return;
	else if (reply->kind == LMS2XX_ACK)
		d->next_ns = reply->t_ns + exchanges[d->stage].reply_ns;
	else if (reply->kind == LMS2XX_NAK || reply->kind == LMS2XX_REJECTED) {
		d->rejected = reply->kind == LMS2XX_REJECTED;
		again(d, reply->t_ns);
	}
}

void lms2xx_dialogue_data(struct dialogue *d, int64_t t_ns)
{
	d->heard_ns = t_ns;
}

/* How long an ACK may take: where the scanner streams, it ends a measurement first. */
static int64_t ack_patience_ns(const struct dialogue *d)
{
	const size_t before = d->stage == STAGE_PROBE || d->stage == STAGE_STOP ? 2 * LMS2XX_BEAMS_MAX + 12 : 0;
	return LMS2XX_ACK_NS + transfer_ns(rate_now(d), d->len + before);
}

static void wait_for_ack(struct dialogue *d, int64_t t_ns)
{
	d->ask = ASK_WAITING;
	d->next_ns = t_ns + ack_patience_ns(d);
}

static void send_byte(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	if (d->sent > 0 && t_ns - d->last_byte_ns > LMS2XX_GAP_NS) {
		d->ask = ASK_PAUSING;
		d->sent = 0;
		d->next_ns = t_ns + LMS2XX_PAUSE_NS;
		if (++d->gaps >= GAPS_MAX) {
			d->gaps = 0;
			again(d, t_ns);
		}
		return;
	}
	ret->write[0] = d->telegram[d->sent++];
	ret->write_len = 1;
	d->last_byte_ns = t_ns;
	d->next_ns = t_ns + LMS2XX_TICK_NS;
}

static void exchange_step(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	if (d->ask == ASK_WAITING && t_ns >= d->next_ns) {
		d->rejected = false;
		again(d, t_ns);
	}
	if (exchanges[d->stage].expect == 0)
		return; /* given up */
	if (d->ask == ASK_PAUSING && t_ns >= d->next_ns)
		d->ask = ASK_SENDING;
	if (d->ask == ASK_SENDING && t_ns >= d->next_ns) {
		if (rate_now(d) == 500000) {
			send_byte(d, t_ns, ret);
		} else {
			memcpy(ret->write, d->telegram, d->len);
			ret->write_len = d->sent = d->len;
		}
		if (d->sent == d->len)
			wait_for_ack(d, t_ns);
	}
}

static void set_line(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	ret->baud = rate_now(d);
	ret->flush = true;
	d->setting = true;
	d->stage = STAGE_SETTLE;
	d->until_ns = t_ns + (d->after_settle == STAGE_VERIFY ? LMS2XX_SETTLE_NS : LMS2XX_PAUSE_NS);
}

void lms2xx_dialogue_step(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	*ret = (struct dialogue_step){.deadline_ns = NEVER, .state = DIALOGUE_CONFIGURING};
	d->setting = false;
	if (d->stage == STAGE_SETTLE && t_ns >= d->until_ns) {
		d->sent = 0;
		enter(d, d->after_settle, t_ns);
		d->after_settle = STAGE_PROBE;
	}
	if (d->stage == STAGE_STREAMING && t_ns - d->heard_ns >= LMS2XX_QUIET_NS) {
		d->why = "it stopped sending";
		search(d, 0);
	}
	if (exchanges[d->stage].expect != 0)
		exchange_step(d, t_ns, ret);
	if (d->stage == STAGE_LINE && ret->write_len == 0)
		set_line(d, t_ns, ret);

	if (d->stage == STAGE_FAILED) {
		ret->state = DIALOGUE_FAILED;
		memcpy(ret->error, d->error, sizeof ret->error);
	} else if (d->stage == STAGE_STREAMING) {
		ret->state = DIALOGUE_STREAMING;
		ret->deadline_ns = d->heard_ns + LMS2XX_QUIET_NS;
		memcpy(ret->error, d->note, sizeof ret->error);
	} else {
		ret->deadline_ns = d->stage == STAGE_SETTLE ? d->until_ns : d->next_ns;
		snprintf(ret->error, sizeof ret->error, "%s", d->why ? d->why : "");
	}
}

void lms2xx_dialogue_stop(struct dialogue *d, int64_t t_ns)
{
	if (d->stage == STAGE_FAILED || d->stage == STAGE_STOP)
		return;
	if (d->worked == 0 || d->stage == STAGE_LINE || d->stage == STAGE_SETTLE || d->stage == STAGE_PROBE)
		fail(d, ""); /* nobody is known to listen at this rate */
	else
		enter(d, STAGE_STOP, t_ns);
}

void lms2xx_dialogue_reset(struct dialogue *d, int64_t t_ns)
{
	const unsigned bit = d->setting ? rate_bit(rate_now(d)) : 0;
	d->refused |= bit & d->suspect; /* once it may have been the plug */
	if (bit == 0 && d->stage != STAGE_FAILED)
		d->refused = 0; /* what was unplugged comes back as it likes, with another adapter even */
	if (d->refused == (1u << ALL_RATES) - 1)
		d->refused = 0;
	d->suspect = bit;
	d->setting = false;
	d->sent = d->len = 0;
	d->restarts = 0;
	d->heard_ns = t_ns;
	search(d, 0);
}

struct dialogue *lms2xx_dialogue_create(const struct config *config, int device)
{
	struct dialogue *d = calloc(1, sizeof *d);
	if (d == NULL)
		return NULL;
	const struct config_device *c = &config->device[device];
	d->wanted_baud = d->target = c->baud;
	d->indices = c->indices == INDICES_ON;
	d->fov_deg = c->fov_deg;
	d->resolution_cdeg = c->resolution_cdeg;
	d->parts = c->fov_deg == 180 && c->resolution_cdeg == 25;
	if (d->parts)
		d->resolution_cdeg = 50; /* the scanner refuses 180/0.25, its turns are taken one by one */
	d->mode = c->mode;
	d->unit = c->range_unit == UNIT_MM ? LMS2XX_MM : c->range_unit == UNIT_CM ? LMS2XX_CM : -1;
	search(d, 0);
	return d;
}

void lms2xx_dialogue_destroy(struct dialogue *d)
{
	free(d);
}

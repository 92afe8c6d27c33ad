/* CoLa scanners: bytes -> profiles, tilts and replies. Passive (law L7): answers name what they answer, so nothing has to
 * be learned from the requests, and the bytes to the device are not looked at.
 *
 * Times. A telegram carries two stamps of the device's microseconds: of its transmission, a short and even delay before
 * it arrives, and of the scan. The first one and the arrival feed the clock filter; the second one, through it, gives
 *
 *     end of scan   (TiM, LMS1xx)   first beam = stamp - (beams - 1) * step / 360 degrees / rate of the mirror
 *     start of scan (LMS5xx, MRS)   first beam = stamp
 *
 * The mirror is not as even as it is said to be: a TiM561's turns were seen to take 64.2 to 69.0 ms, slowly to and fro. So a
 * turn is what lies between this stamp and the last one, where that is near the rate that is said.
 *
 * What a stamp marks was measured and contradicts a manual, so the configuration may say it; else it is the family's, or
 * that of the model whose name passes by. The rate of measurements that a telegram says is not used: some firmware sends
 * a ninth or a hundredfold of it.
 *
 * Lost scans show as gaps in the device's count of scans. It counts those too that it was told not to send, so the
 * smallest step since the stream was set up is what a scan counts: lost = sum of the steps / smallest step - scans seen,
 * which a smaller step corrects in hindsight. LMS1xx now and then send a telegram twice; the second one is dropped.
 *
 * Steps of a third, a sixth or a twelfth of a degree are cut to 1/10000 in the telegram, which over a fan of 1141 beams
 * adds up to 0.04 degrees; they are taken for what they are. */
#include "drivers/cola.h"

#include <stdlib.h>
#include <string.h>

#include <math.h>

#include "core/trig.h"
#include "drivers/cola_scan.h"
#include "drivers/device_clock.h"

#define TICK_NS     1000.0 /* stamps are microseconds in 32 bits */
#define WRAP        (UINT64_C(1) << 32)
#define DRIFT_MAX   500e-6
#define AHEAD_TDEG  900000 /* SICK's 90 degrees are straight ahead */
#define TURN_TDEG   3600000
#define RATE_MIN    100 /* of the mirror, 1/100 Hz: what is beyond was not meant */
#define RATE_MAX    60000
#define SENDING_US  1000000 /* no device holds a scan back for so long; and none sends it before it is there */
#define SCALE_MAX   100.0
#define OFFSET_MAX  1e6 /* mm */
#define RESTART_GAP 0x8000
#define TURN_OFF    0.1 /* of a turn: stamps farther apart or closer than what is said mark something else */
#define TURNS_MAX   4   /* over more of them the mean says little about the last */

enum counter {
	TELEGRAMS,
	PROFILES,
	TILTS,
	BAD_SUM,
	BAD_START,
	TOO_LONG,
	CUT,
	GARBAGE_BYTES,
	MALFORMED,
	IMPLAUSIBLE,
	WITHOUT_RANGES,
	TOO_MANY_BEAMS,
	DUPLICATES,
	LOST,
	DEVICE_ERRORS,
	REFUSED,
	COUNTERS
};

static const char *const counter_names[COUNTERS] = {
    "telegrams",  "profiles",      "tilts",         "check sum",       "bad start",      "too long",
    "cut",        "garbage bytes", "malformed",     "implausible",     "without ranges", "too many beams",
    "duplicates", "scans lost",    "device errors", "requests refused"};
_Static_assert(COUNTERS <= DECODER_COUNTERS_MAX, "the counters of a decoder have a limit");

/* What models differ in, by the beginning of the name they give; after the table comes the family's. */
static const struct model {
	const char *name;
	bool stamp_at_end;
	uint16_t valid_from; /* smaller values are codes */
} models[] = {{"TiM", true, 16}, {"LMS1", true, 1}, {"LMS5", false, 1}, {"MRS", false, 1}};
enum { MODELS = sizeof(models) / sizeof(models[0]) };

/* The device's count of scans since its stream was set up. */
struct scan_count {
	bool known;
	uint16_t last;
	uint32_t step; /* the smallest there was; 0: none yet */
	uint64_t span; /* sum of the steps */
	uint64_t steps;
	uint64_t lost_before;
};

struct decoder {
	int device;
	struct config_device config;
	const struct cola_family *family;
	int model;              /* index into models, MODELS: not said */
	uint32_t frequency_chz; /* last one believed; 0: none */
	bool seen;              /* a scan was, since the link was opened; these tell it from the next */
	uint16_t telegram_counter, scan_counter;
	uint32_t t_startup_us, t_transmit_us;
	struct scan_count scans;
	double turn_ns; /* of the scan at hand */
	struct device_clock clock;
	struct framer framer;
	uint64_t count[COUNTERS];
	uint8_t bytes[COLA_TELEGRAM_MAX];
	uint16_t value[PROFILE_BEAMS_MAX];
	struct profile profile;
};

static void init(struct decoder *d)
{
	d->model = MODELS;
	d->frequency_chz = 0;
	d->seen = false;
	d->telegram_counter = d->scan_counter = 0;
	d->t_startup_us = d->t_transmit_us = 0;
	d->scans = (struct scan_count){0};
	memset(d->count, 0, sizeof(d->count));
	device_clock_init(&d->clock, TICK_NS, WRAP, DRIFT_MAX);
	framer_init(&d->framer, cola_scan_frame, NULL, d->bytes, sizeof(d->bytes));
}

struct decoder *cola_decoder_create(const struct config_device *config, int device)
{
	struct decoder *d = calloc(1, sizeof(*d));

	if (d == NULL)
		return NULL;
	d->device = device;
	d->config = *config;
	d->family = cola_family(config->driver);
	if (d->family == NULL)
		d->family = cola_family("tim");
	init(d);
	return d;
}

void cola_decoder_destroy(struct decoder *d)
{
	free(d);
}

static uint64_t lost(const struct scan_count *c)
{
	return c->lost_before + (c->step > 0 ? c->span / c->step - c->steps : 0);
}

void cola_counters(const struct decoder *d, struct decoder_counters *ret)
{
	ret->n = COUNTERS;
	for (int i = 0; i < COUNTERS; i++) {
		ret->counter[i].name = counter_names[i];
		ret->counter[i].count = d->count[i];
	}
	ret->counter[BAD_SUM].count = d->framer.refused[COLA_BAD_SUM];
	ret->counter[BAD_START].count = d->framer.refused[COLA_BAD_BYTE];
	ret->counter[TOO_LONG].count = d->framer.refused[COLA_TOO_LONG];
	ret->counter[CUT].count = d->framer.refused[FRAMER_CUT];
	ret->counter[GARBAGE_BYTES].count = d->framer.skipped;
	ret->counter[LOST].count = lost(&d->scans);
}

static uint32_t rate_chz(const struct decoder *d)
{
	return d->frequency_chz > 0 ? d->frequency_chz : (uint32_t)(d->family->measures_hz * 100);
}

void cola_timing(const struct decoder *d, struct decoder_timing *ret)
{
	const uint32_t asked = d->config.every > 0 ? (uint32_t)d->config.every : 1;

	*ret = (struct decoder_timing){.known = true, .lost = lost(&d->scans), .stamps = d->clock.started};
	ret->expected_hz = rate_chz(d) / 100.0 / (d->scans.step > 0 ? d->scans.step : asked);
	if (!d->clock.started)
		return;
	device_clock_jitter(&d->clock, &ret->jitter_p50_ns, &ret->jitter_p99_ns);
	ret->offset_ns = d->clock.offset_ns;
	ret->drift_ppm = d->clock.drift * 1e6;
}

/* Scans */

/* The stream is set up anew: what was not sent meanwhile is not lost. */
static void forget_count(struct decoder *d)
{
	d->scans = (struct scan_count){.lost_before = lost(&d->scans)};
}

static void follow_count(struct decoder *d, uint16_t now)
{
	struct scan_count *c = &d->scans;
	const uint16_t step = (uint16_t)(now - c->last);

	if (c->known && step >= RESTART_GAP)
		forget_count(d);
	if (c->known && step > 0) {
		c->span += step;
		c->steps++;
		if (c->step == 0 || step < c->step)
			c->step = step;
	}
	c->known = true;
	c->last = now;
}

static bool is_duplicate(struct decoder *d, const struct cola_scan *s)
{
	const bool same = d->seen && s->telegram_counter == d->telegram_counter && s->scan_counter == d->scan_counter &&
	                  s->t_startup_us == d->t_startup_us && s->t_transmit_us == d->t_transmit_us;

	d->seen = true;
	d->telegram_counter = s->telegram_counter;
	d->scan_counter = s->scan_counter;
	d->t_startup_us = s->t_startup_us;
	d->t_transmit_us = s->t_transmit_us;
	return same;
}

/* Log time of what the scan's stamp marks. */
static int64_t stamp_of(struct decoder *d, const struct cola_scan *s, int64_t arrival_ns)
{
	const int64_t transmit_ns = device_clock_stamp(&d->clock, s->t_transmit_us, arrival_ns);
	const int32_t sending_us = (int32_t)(s->t_transmit_us - s->t_startup_us);

	if (sending_us >= 0 && sending_us <= SENDING_US)
		return device_clock_at(&d->clock, s->t_startup_us);
	d->count[IMPLAUSIBLE]++;
	return transmit_ns;
}

static void follow_rate(struct decoder *d, const struct cola_scan *s)
{
	if (s->frequency_chz >= RATE_MIN && s->frequency_chz <= RATE_MAX)
		d->frequency_chz = s->frequency_chz;
	else
		d->count[IMPLAUSIBLE]++;
}

/* From the stamp before, of scan `last`, to this one. */
static double turn_ns(const struct decoder *d, const struct cola_scan *s, bool known, uint16_t last, uint32_t last_us)
{
	const double said_ns = 1e11 / rate_chz(d);
	const uint16_t turns = (uint16_t)(s->scan_counter - last);
	const double seen_ns = turns > 0 ? (double)(uint32_t)(s->t_startup_us - last_us) * TICK_NS / turns : 0;

	return known && turns <= TURNS_MAX && fabs(seen_ns - said_ns) <= TURN_OFF * said_ns ? seen_ns : said_ns;
}

static double step_deg(int32_t step_tdeg)
{
	for (int parts = 3; parts <= 12; parts *= 2) {
		const double whole = rint(step_tdeg * parts / 1e4);
		if (whole > 0 && fabs(step_tdeg - whole * 1e4 / parts) < 1)
			return whole / parts;
	}
	return step_tdeg / 1e4;
}

static bool stamp_at_end(const struct decoder *d)
{
	if (d->config.stamp != STAMP_AUTO)
		return d->config.stamp == STAMP_END;
	return d->model < MODELS ? models[d->model].stamp_at_end : d->family->stamp_at_end;
}

static uint16_t valid_from(const struct decoder *d)
{
	if (d->model < MODELS)
		return models[d->model].valid_from;
	return strcmp(d->family->driver, "tim") == 0 ? 16 : 1;
}

/* 2 is what a TiM sends where nothing came back, beside 0; what stands between is reserved. */
static enum beam_state state_of_code(uint16_t value)
{
	if (value == 1)
		return BEAM_DAZZLED;
	return value == 0 || value == 2 ? BEAM_NO_ECHO : BEAM_RESERVED;
}

static void fill_ranges(struct decoder *d, const struct cola_channel *c)
{
	struct profile *p = &d->profile;
	const uint16_t least = valid_from(d);

	cola_channel_values(c, d->value);
	for (unsigned i = 0; i < c->n; i++) {
		const double mm = d->value[i] * (double)c->scale + (double)c->offset;
		if (d->value[i] < least)
			p->state[i] = (uint8_t)state_of_code(d->value[i]);
		else
			p->state[i] = mm > 0 ? BEAM_OK : BEAM_NO_ECHO;
		p->range_m[i] = p->state[i] == BEAM_OK ? (float)(mm / 1000) : 0;
	}
}

/* `c` NULL: it sends none. One of another length belongs to another raster. */
static void fill_remission(struct decoder *d, const struct cola_channel *c)
{
	struct profile *p = &d->profile;

	p->has_remission = c != NULL && c->n == p->n;
	if (p->has_remission)
		cola_channel_values(c, p->remission);
}

/* The raster and the times between beams; `t_ns` is what the stamp marks. */
static void fill_profile(struct decoder *d, const struct cola_channel *c, int64_t t_ns)
{
	struct profile *p = &d->profile;
	const double step = step_deg(c->step_tdeg);
	const double beam_ns = d->turn_ns * step / 360;

	p->interlace = 1;
	p->parts = 1;
	p->part = 0;
	p->n = c->n;
	p->turn_ns = (int32_t)rint(d->turn_ns);
	p->beam_ns = (int32_t)rint(beam_ns);
	p->first_rad = (c->start_tdeg - AHEAD_TDEG) / 1e4 * TRIG_DEG;
	p->step_rad = step * TRIG_DEG;
	p->t_ns = t_ns - d->config.latency_ns;
	if (stamp_at_end(d))
		p->t_ns -= (int64_t)rint((c->n - 1) * beam_ns);
	fill_ranges(d, c);
}

static bool is_sane(const struct cola_channel *c)
{
	const bool turns = c->step_tdeg > 0 && (int64_t)c->step_tdeg * (c->n - 1) <= TURN_TDEG;
	const bool starts = c->start_tdeg >= -TURN_TDEG && c->start_tdeg <= TURN_TDEG;
	const bool scales = c->scale > 0 && c->scale <= SCALE_MAX && fabs((double)c->offset) <= OFFSET_MAX;

	return turns && starts && scales;
}

/* The angle nearest to 0 that the ticks may mean. They are read when the scan is stamped, be that its start or its end. */
static void take_encoder(struct decoder *d, const struct cola_scan *s, int64_t stamp_ns, const struct record_sink *sink)
{
	const double wrap = d->config.encoder.wrap > 0 ? d->config.encoder.wrap : (double)WRAP;
	double ticks = s->encoder[0].ticks - d->config.encoder.zero;

	if (!d->config.encoder.set || s->encoders == 0)
		return;
	ticks -= wrap * floor(ticks / wrap + 0.5);
	const double sign = d->config.encoder.sign < 0 ? -1 : 1;
	const struct tilt tilt = {.t_ns = stamp_ns - d->config.latency_ns,
	                          .angle_rad = sign * d->config.encoder.scale * ticks};
	d->count[TILTS]++;
	sink->tilt(sink->ctx, d->device, &tilt);
}

static void take_profile(struct decoder *d, const struct cola_scan *s, int64_t stamp_ns, const struct record_sink *sink)
{
	const struct cola_channel *c = cola_scan_channel(s, "DIST1");

	if (c == NULL || c->n == 0) {
		d->count[WITHOUT_RANGES]++;
	} else if (c->n > PROFILE_BEAMS_MAX) {
		d->count[TOO_MANY_BEAMS]++;
	} else if (!is_sane(c)) {
		d->count[MALFORMED]++;
	} else {
		fill_profile(d, c, stamp_ns);
		fill_remission(d, cola_scan_channel(s, "RSSI1"));
		take_encoder(d, s, stamp_ns, sink);
		d->count[PROFILES]++;
		sink->profile(sink->ctx, d->device, &d->profile);
	}
}

static void take_scan(struct decoder *d, const struct cola_scan *s, int64_t arrival_ns, const struct record_sink *sink)
{
	const bool known = d->seen && d->scans.known;
	const uint16_t last = d->scans.last;
	const uint32_t last_us = d->t_startup_us;

	if (is_duplicate(d, s)) {
		d->count[DUPLICATES]++;
		return;
	}
	follow_count(d, s->scan_counter);
	follow_rate(d, s);
	d->turn_ns = turn_ns(d, s, known, last, last_us);
	if ((s->status[1] & 1) != 0)
		d->count[DEVICE_ERRORS]++;
	take_profile(d, s, stamp_of(d, s, arrival_ns), sink);
}

/* Answers */

/* sRA DeviceIdent, and sRA 0 in CoLa-A: a name and a version. */
static void learn_model(struct decoder *d, enum cola_dialect dialect, const uint8_t *payload, size_t len)
{
	struct cola_reader r;
	const char *name;
	size_t name_len;

	if (!cola_reader_init(&r, dialect, payload, len, "DeviceIdent") &&
	    !cola_reader_init(&r, dialect, payload, len, "0"))
		return;
	cola_read_string(&r, 2, &name, &name_len);
	if (r.failed)
		return;
	d->model = MODELS;
	for (int i = 0; i < MODELS; i++) {
		const size_t n = strlen(models[i].name);
		if (name_len >= n && memcmp(name, models[i].name, n) == 0)
			d->model = i;
	}
}

static bool names_scan(const uint8_t *payload, size_t len)
{
	static const char name[] = " LMDscandata";

	return len > sizeof(name) + 2 && memcmp(payload + 3, name, sizeof(name) - 1) == 0 &&
	       (payload[sizeof(name) + 2] == ' ' || payload[sizeof(name) + 2] == 'm');
}

static void take_telegram(struct decoder *d, const uint8_t *telegram, size_t telegram_len, int64_t t_ns,
                          const struct record_sink *sink)
{
	const uint8_t *payload;
	size_t len;
	struct cola_scan scan;
	const enum cola_dialect dialect = cola_payload(telegram, telegram_len, &payload, &len);
	const int kind = cola_reply_kind(dialect, payload, len), plain = kind & ~COLA_B_FLAG;

	d->count[TELEGRAMS]++;
	if ((plain == COLA_DATA || plain == COLA_READ) && names_scan(payload, len)) {
		if (cola_scan_read(dialect, payload, len, &scan) == 0)
			take_scan(d, &scan, t_ns, sink);
		else
			d->count[MALFORMED]++;
	} else if (plain == COLA_READ) {
		learn_model(d, dialect, payload, len);
	} else if (plain == COLA_ERROR) {
		d->count[REFUSED]++;
	} else if (plain == COLA_WRITTEN || plain == COLA_METHOD || plain == COLA_EVENT) {
		forget_count(d);
	}
	if (sink->reply != NULL) {
		const struct reply reply = {
		    .t_ns = t_ns, .kind = kind, .payload = payload, .len = len < REPLY_MAX ? len : REPLY_MAX};
		sink->reply(sink->ctx, d->device, &reply);
	}
}

static void open_link(struct decoder *d)
{
	framer_restart(&d->framer);
	device_clock_restart(&d->clock);
	forget_count(d);
	d->seen = false;
	d->model = MODELS; /* it may be another one */
}

void cola_decode(struct decoder *d, const struct record *record, const struct record_sink *sink)
{
	const uint8_t *telegram;
	size_t len;

	if (record->direction == LINK_OPENED) {
		open_link(d);
		return;
	}
	if (record->direction != FROM_DEVICE)
		return;
	for (size_t done = 0; done < record->len;) {
		done += framer_push(&d->framer, record->bytes + done, record->len - done);
		while ((len = framer_take(&d->framer, &telegram)) > 0)
			take_telegram(d, telegram, len, record->t_ns, sink);
	}
}

/* Snapshots */

static void name_fields(struct decoder *d, struct state *s)
{
	state_tag(s, "cola1");
	state_int(s, &d->model, 0, MODELS);
	state_u32(s, &d->frequency_chz);
	state_bool(s, &d->seen);
	state_u16(s, &d->telegram_counter);
	state_u16(s, &d->scan_counter);
	state_u32(s, &d->t_startup_us);
	state_u32(s, &d->t_transmit_us);
	state_bool(s, &d->scans.known);
	state_u16(s, &d->scans.last);
	state_u32(s, &d->scans.step);
	state_u64(s, &d->scans.span);
	state_u64(s, &d->scans.steps);
	state_u64(s, &d->scans.lost_before);
	for (int i = 0; i < COUNTERS; i++)
		state_u64(s, &d->count[i]);
	if (d->frequency_chz != 0 && (d->frequency_chz < RATE_MIN || d->frequency_chz > RATE_MAX))
		s->failed = true;
	device_clock_state(s, &d->clock);
	framer_state(s, &d->framer);
}

void cola_decoder_state(struct decoder *d, struct state *s)
{
	if (s->loading)
		init(d);
	name_fields(d, s);
	if (s->loading && s->failed)
		init(d);
}

/* LMS2xx: bytes of both directions -> profiles and replies. Passive (law L7).
 *
 * What a range word means is decided by the measuring mode, which no measurement says: it is learned from the
 * configuration whenever one passes by (F4, F7), and until then profiles are counted and dropped, never guessed; a
 * power cycle forgets it. The raster is told by the count of values (181, 361, 401 ... values exist in one raster
 * each); only where it is not (a sub-range, the fast S14) does the variant last answered decide.
 *
 * Times. The scanner sends a scan when its last beam is measured; the read that delivers the last byte comes a telegram
 * later (bytes * 10 / baud), and whatever the host added. So
 *     end of scan = clock(last byte - transfer),   first beam = end - (turns - 1) * 13.3 ms - fov * 37.04 us - latency.
 * A scan of 0.5 (0.25) degree is 2 (4) turns of the mirror interlaced, each measuring every second (fourth) beam in
 * this order: struct profile says so and every beam gets its time from there. What the scanner adds itself (it is not
 * published) is a constant for calibration, `latency`. The rate is learned from the request that sets it, and from status.
 *
 * Which clock: where real-time indices follow the values, the scan index counts every scan that the mirror made, also
 * those that a slow line skipped or lost, so the index is the time and a device clock follows it. Where they are off, and
 * for partial scans (what the index counts there is not documented), arrivals are fitted to the mirror's period. */
#include "drivers/lms2xx.h"

#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "drivers/arrivals.h"
#include "drivers/clock_filter.h"
#include "drivers/device_clock.h"
#include "drivers/jitter.h"
#include "drivers/lms2xx_wire.h"

#define LINE_BYTES   4096 /* more than the longest telegram */
#define TURN_NS      (40e6 / 3)
#define INDEX_WRAP   256
#define MIRROR_DRIFT 0.01 /* a motor: far from what any was seen to do */

enum counter {
	TELEGRAMS,
	PROFILES,
	CRC,
	GARBAGE_BYTES,
	TOO_LONG,
	BAD_SIZE,
	CUT,
	UNKNOWN_TELEGRAM,
	MODE_UNKNOWN,
	MODE_WITHOUT_RANGES,
	RASTER_UNKNOWN,
	MALFORMED,
	NOT_ACKNOWLEDGED,
	REJECTED,
	SCANS_SKIPPED,
	TELEGRAMS_LOST,
	DEVICE_ERRORS,
	COUNTERS
};

static const char *const counter_names[COUNTERS] = {
    "telegrams", "profiles",         "crc",           "garbage bytes",       "too long",       "bad size",
    "cut",       "unknown telegram", "mode unknown",  "mode without ranges", "raster unknown", "malformed",
    "nak",       "rejected",         "scans skipped", "telegrams lost",      "device errors"};
_Static_assert(COUNTERS <= DECODER_COUNTERS_MAX, "the counters of a decoder have a limit");

struct decoder {
	int device;
	uint32_t configured_baud, baud;
	uint8_t asked_mode; /* second byte of the last mode request: a rate counts when it is answered */
	bool mode_known;
	int mode;                     /* measuring mode */
	int fov_deg, resolution_cdeg; /* variant last answered; 0: not known */
	bool index_known;
	uint8_t scan_index, telegram_index; /* of the last scan that had them */
	bool counts;                        /* `mirror` dates the scans, else `filter` */
	struct clock_filter filter;
	uint64_t skipped; /* bytes that made no telegram, up to the last scan */
	struct device_clock mirror;
	double expected_hz;   /* by raster and rate; 0: nothing came yet */
	struct jitter jitter; /* of the filter: for the status, not in the snapshot */
	int64_t latency_ns;
	int64_t heard_ns[2]; /* last bytes of a direction */
	struct framer framer[2];
	struct arrivals arrivals;  /* from the device */
	int64_t begin_ns, last_ns; /* arrival of the first and the last byte of the telegram at hand */
	uint8_t bytes[2][LINE_BYTES];
	uint64_t count[COUNTERS];
	struct profile profile;
};

static void clocks_init(struct decoder *d)
{
	d->index_known = d->counts = false;
	d->expected_hz = 0;
	clock_filter_init(&d->filter, LMS2XX_TURN_NS);
	device_clock_init(&d->mirror, TURN_NS, INDEX_WRAP, MIRROR_DRIFT);
}

/* As new. */
static void start(struct decoder *d, uint32_t baud)
{
	const int device = d->device;
	const int64_t latency_ns = d->latency_ns;

	memset(d, 0, sizeof *d);
	d->device = device;
	d->latency_ns = latency_ns;
	d->configured_baud = d->baud = baud;
	clocks_init(d);
	framer_init(&d->framer[FROM_DEVICE], lms2xx_scan_device, NULL, d->bytes[FROM_DEVICE], LINE_BYTES);
	framer_init(&d->framer[TO_DEVICE], lms2xx_scan_host, NULL, d->bytes[TO_DEVICE], LINE_BYTES);
}

struct decoder *lms2xx_decoder_create(const struct config_device *config, int device)
{
	struct decoder *d = calloc(1, sizeof *d);
	if (d == NULL)
		return NULL;
	d->device = device;
	d->latency_ns = config->latency_ns;
	start(d, config->baud);
	return d;
}

void lms2xx_decoder_destroy(struct decoder *d)
{
	free(d);
}

void lms2xx_counters(const struct decoder *d, struct decoder_counters *ret)
{
	const struct framer *f = &d->framer[FROM_DEVICE];
	ret->n = COUNTERS;
	for (int i = 0; i < COUNTERS; i++) {
		ret->counter[i].name = counter_names[i];
		ret->counter[i].count = d->count[i];
	}
	ret->counter[CRC].count = f->refused[LMS2XX_BAD_CRC];
	ret->counter[GARBAGE_BYTES].count = f->skipped;
	ret->counter[TOO_LONG].count = f->refused[LMS2XX_TOO_LONG];
	ret->counter[BAD_SIZE].count = f->refused[LMS2XX_BAD_SIZE];
	ret->counter[CUT].count = f->refused[FRAMER_CUT];
}

/* How the values of a scan lie in the fan. */
struct raster {
	int fov_deg;
	int step_cdeg;
	int interlace; /* turns of the mirror */
	int first;     /* beams before the first value */
	int skip;      /* leading values left out, so that the first one kept belongs to the first turn */
};

static bool raster_by_count(const struct decoder *d, unsigned n, struct raster *ret)
{
	static const struct {
		uint16_t n;
		int fov_deg, step_cdeg;
	} known[] = {{181, 180, 100}, {361, 180, 50}, {101, 100, 100}, {201, 100, 50}, {401, 100, 25}};
	if (n == 181 && d->fov_deg == 90) { /* S14: half a degree in one turn */
		*ret = (struct raster){.fov_deg = 90, .step_cdeg = 50, .interlace = 1};
		return true;
	}
	for (size_t i = 0; i < sizeof known / sizeof known[0]; i++) {
		if (known[i].n == n) {
			*ret = (struct raster){.fov_deg = known[i].fov_deg,
			                       .step_cdeg = known[i].step_cdeg,
			                       .interlace = 100 / known[i].step_cdeg};
			return true;
		}
	}
	return false;
}

static bool raster_of_part(const struct lms2xx_scan *scan, struct raster *ret)
{
	const unsigned full = scan->n + (scan->part > 0 ? 1u : 0u); /* only part 0 reaches the last degree */
	if (full != 181 && full != 101)
		return false;
	*ret = (struct raster){.fov_deg = (int)full - 1, .step_cdeg = 100, .interlace = 1};
	return true;
}

static bool raster_of_range(const struct decoder *d, const struct lms2xx_scan *scan, struct raster *ret)
{
	if (d->fov_deg <= 0 || d->resolution_cdeg <= 0 || scan->start < 1 || scan->stop < scan->start ||
	    scan->n != scan->stop - scan->start + 1)
		return false;
	const unsigned full = (unsigned)(d->fov_deg * 100 / d->resolution_cdeg) + 1;
	if (scan->stop > full || !raster_by_count(d, full, ret))
		return false;
	ret->first = scan->start - 1;
	ret->skip = (ret->interlace - ret->first % ret->interlace) % ret->interlace;
	return scan->n > ret->skip;
}

static bool raster_of(const struct decoder *d, const struct lms2xx_scan *scan, struct raster *ret)
{
	if (scan->command == LMS2XX_SCAN_RANGE)
		return raster_of_range(d, scan, ret);
	if (scan->partial)
		return raster_of_part(scan, ret);
	return raster_by_count(d, scan->n, ret);
}

/* What a word has above its range: levels of reflectivity, or the flag of a reflector. Other modes tell fields and
 * dazzling there, which are nothing of the surface. */
static bool words_have_remission(int mode)
{
	return mode == 0x01 || mode == 0x03 || mode == 0x05;
}

static void fill_remission(struct decoder *d, const struct lms2xx_scan *scan, const struct raster *raster)
{
	struct profile *p = &d->profile;
	const int bits = lms2xx_range_bits(d->mode);

	p->has_remission = words_have_remission(d->mode) || scan->amplitudes > 0;
	if (!p->has_remission)
		return;
	for (unsigned i = 0; i < p->n; i++) {
		const unsigned at = i + (unsigned)raster->skip;
		const uint8_t *word = scan->value + at * scan->stride;
		const unsigned beam = at + 1; /* as the scanner counts */

		if (scan->amplitudes == 0)
			p->remission[i] = (uint16_t)((word[0] | word[1] << 8) >> bits);
		else if (beam >= scan->start && beam - scan->start < scan->amplitudes)
			p->remission[i] = scan->amplitude[beam - scan->start];
		else
			p->remission[i] = 0;
	}
}

static void fill_profile(struct decoder *d, const struct lms2xx_scan *scan, const struct raster *raster, double unit_m)
{
	struct profile *p = &d->profile;
	const int first = raster->first + raster->skip;
	p->interlace = (uint8_t)raster->interlace;
	p->turn_ns = LMS2XX_TURN_NS;
	p->beam_ns = LMS2XX_BEAM_NS * raster->step_cdeg * raster->interlace / 100;
	p->part = scan->part;
	p->parts = scan->partial ? 4 : 1;
	p->n = (uint16_t)(scan->n - raster->skip);
	p->step_rad = raster->step_cdeg / 100.0 * TRIG_DEG;
	p->first_rad = (raster->fov_deg * -50 + first * raster->step_cdeg + 25 * scan->part) / 100.0 * TRIG_DEG;
	for (unsigned i = 0; i < p->n; i++) {
		const uint8_t *word = scan->value + (i + (unsigned)raster->skip) * scan->stride;
		uint16_t range = 0;
		p->state[i] = (uint8_t)lms2xx_range((uint16_t)(word[0] | word[1] << 8), d->mode, &range);
		p->range_m[i] = p->state[i] == BEAM_OK ? (float)(range * unit_m) : 0;
	}
	fill_remission(d, scan, raster);
}

/* Scans a second that the line lets through: while one is on its way, those that end are skipped. */
static double expected_hz(const struct raster *raster, int64_t transfer_ns)
{
	const double scan_ns = raster->interlace * TURN_NS;
	const int64_t scans = 1 + (int64_t)((double)transfer_ns / scan_ns);

	return 1e9 / (scan_ns * (double)scans);
}

/* When the last beam of the scan was measured. */
static int64_t end_of_scan(struct decoder *d, const struct lms2xx_scan *scan, const struct raster *raster,
                           int64_t sent_ns)
{
	const double scan_ns = raster->interlace * TURN_NS;

	d->counts = scan->indexed && !scan->partial;
	if (d->framer[FROM_DEVICE].skipped != d->skipped)
		clock_filter_lost(&d->filter);
	d->skipped = d->framer[FROM_DEVICE].skipped;
	if (!d->counts) {
		const int64_t end_ns = clock_filter_stamp(&d->filter, sent_ns, raster->interlace);

		jitter_note(&d->jitter, sent_ns - end_ns);
		return end_ns;
	}
	if (d->mirror.tick_ns < scan_ns || d->mirror.tick_ns > scan_ns) /* another variant */
		device_clock_init(&d->mirror, scan_ns, INDEX_WRAP, MIRROR_DRIFT);
	return device_clock_stamp(&d->mirror, scan->scan_index, sent_ns);
}

/* Time of the first beam of the profile, from the arrival of its telegram: the scan had ended when its first byte came,
 * and a transfer's time before its last one. A gap makes the second late, a read of many bytes the first. */
static int64_t first_beam(struct decoder *d, const struct lms2xx_scan *scan, const struct raster *raster,
                          size_t telegram_len)
{
	const int64_t transfer_ns = d->baud > 0 ? (int64_t)telegram_len * 10 * 1000000000 / d->baud : 0;
	const int64_t whole_ns = d->last_ns - transfer_ns;
	const int64_t sent_ns = transfer_ns > 0 && d->begin_ns < whole_ns ? d->begin_ns : whole_ns;
	const int64_t end_ns = end_of_scan(d, scan, raster, sent_ns);
	const int64_t start_ns =
	    end_ns - (raster->interlace - 1) * (int64_t)LMS2XX_TURN_NS - raster->fov_deg * LMS2XX_BEAM_NS;

	d->expected_hz = expected_hz(raster, transfer_ns);
	return start_ns + (raster->first + raster->skip) / raster->interlace * (int64_t)d->profile.beam_ns -
	       d->latency_ns;
}

/* Real-time indices count the scans that the mirror made and the telegrams that left: what the line lost is missing in
 * both, what the scanner skipped because the line was busy in the first alone. */
static void follow_indices(struct decoder *d, const struct lms2xx_scan *scan)
{
	if (scan->indexed && d->index_known) {
		const uint8_t scans = (uint8_t)(scan->scan_index - d->scan_index - 1);
		const uint8_t lost = (uint8_t)(scan->telegram_index - d->telegram_index - 1);

		d->count[TELEGRAMS_LOST] += lost;
		d->count[SCANS_SKIPPED] += scans > lost ? (uint64_t)(scans - lost) : 0;
	}
	d->index_known = scan->indexed;
	d->scan_index = scan->scan_index;
	d->telegram_index = scan->telegram_index;
}

static void take_scan(struct decoder *d, const uint8_t *payload, size_t len, const struct record_sink *sink)
{
	struct lms2xx_scan scan;
	struct raster raster;
	const bool sane = lms2xx_decode_scan(payload, len, &scan) && lms2xx_unit_m(scan.unit) > 0;
	if (!sane) {
		d->count[MALFORMED]++;
		return;
	}
	follow_indices(d, &scan);
	if ((scan.status & 7) >= 3)
		d->count[DEVICE_ERRORS]++;
	if (scan.command != LMS2XX_SCAN && scan.command != LMS2XX_SCAN_RANGE &&
	    scan.command != LMS2XX_SCAN_REFLECTIVITY) {
		d->count[UNKNOWN_TELEGRAM]++; /* means over several scans have no time; nobody here asks for them */
		return;
	}
	if (!d->mode_known) {
		d->count[MODE_UNKNOWN]++;
		return;
	}
	if (lms2xx_range_bits(d->mode) == 0) {
		d->count[MODE_WITHOUT_RANGES]++;
		return;
	}
	if (!raster_of(d, &scan, &raster)) {
		d->count[RASTER_UNKNOWN]++;
		return;
	}
	fill_profile(d, &scan, &raster, lms2xx_unit_m(scan.unit));
	d->profile.t_ns = first_beam(d, &scan, &raster, len + 6);
	d->count[PROFILES]++;
	sink->profile(sink->ctx, d->device, &d->profile);
}

static void take_baud(struct decoder *d, uint32_t baud)
{
	if (baud == 0 || baud == d->baud)
		return;
	d->baud = baud;
	clocks_init(d);
}

/* The status says the rate, too: where the scanner stands at the wanted one already, or keeps its own, none is asked for. */
static void learn_variant(struct decoder *d, const uint8_t *payload, size_t len)
{
	struct lms2xx_status status;
	bool taken;
	int fov_deg, resolution_cdeg;
	if (payload[0] == LMS2XX_STATUS_REPLY && lms2xx_decode_status(payload, len, &status)) {
		d->fov_deg = status.fov_deg;
		d->resolution_cdeg = status.resolution_cdeg;
		take_baud(d, status.baud);
	} else if (lms2xx_decode_variant(payload, len, &taken, &fov_deg, &resolution_cdeg) && taken) {
		d->fov_deg = fov_deg;
		d->resolution_cdeg = resolution_cdeg;
	}
}

static void learn_baud(struct decoder *d, const uint8_t *payload)
{
	if (payload[1] == 0)
		take_baud(d, lms2xx_mode_baud(d->asked_mode));
	d->asked_mode = 0;
}

/* The scanner was switched on: what is volatile is gone, and it may be another one. */
static void forget(struct decoder *d)
{
	d->mode_known = false;
	d->fov_deg = d->resolution_cdeg = 0;
	clocks_init(d);
}

static void take_telegram(struct decoder *d, const uint8_t *payload, size_t len, const struct record_sink *sink)
{
	struct lms2xx_config config;
	switch (payload[0]) {
	case LMS2XX_SCAN:
	case LMS2XX_SCAN_MEAN:
	case LMS2XX_SCAN_RANGE:
	case LMS2XX_SCAN_RANGE_MEAN:
	case LMS2XX_SCAN_REFLECTIVITY:
	case LMS2XX_PARTS_REFLECTIVITY:
		take_scan(d, payload, len, sink);
		break;
	case LMS2XX_CONFIG_REPLY:
	case LMS2XX_CONFIG_WRITTEN:
		if (lms2xx_decode_config(payload, len, &config)) {
			d->mode = config.bytes[LMS2XX_CONFIG_MODE];
			d->mode_known = true;
		}
		break;
	case LMS2XX_STATUS_REPLY:
	case LMS2XX_VARIANT_REPLY:
		learn_variant(d, payload, len);
		break;
	case LMS2XX_MODE_REPLY:
		learn_baud(d, payload);
		break;
	case LMS2XX_POWER_ON:
		forget(d);
		break;
	case LMS2XX_REJECTED:
		d->count[REJECTED]++;
		break;
	case LMS2XX_RESET_DONE:
	case LMS2XX_ERRORS_REPLY:
	case LMS2XX_TYPE_REPLY:
	case LMS2XX_KEEP_BAUD_REPLY:
		break;
	default:
		d->count[UNKNOWN_TELEGRAM]++;
		break;
	}
}

static void from_device(struct decoder *d, const uint8_t *telegram, size_t len, int64_t t_ns,
                        const struct record_sink *sink)
{
	struct reply reply = {.t_ns = t_ns, .kind = telegram[0]};
	if (len > 1) {
		d->count[TELEGRAMS]++;
		reply.payload = telegram + 4;
		reply.len = len - 6;
		reply.kind = reply.payload[0];
		take_telegram(d, reply.payload, reply.len, sink);
	} else if (telegram[0] == LMS2XX_NAK) {
		d->count[NOT_ACKNOWLEDGED]++;
	}
	if (sink->reply != NULL)
		sink->reply(sink->ctx, d->device, &reply);
}

static void to_device(struct decoder *d, const uint8_t *telegram, size_t len)
{
	if (len >= 8 && telegram[4] == LMS2XX_MODE)
		d->asked_mode = telegram[5];
}

/* What the framer has not judged yet stands behind the telegram. */
static void date_telegram(struct decoder *d, size_t len)
{
	const struct framer *f = &d->framer[FROM_DEVICE];
	const size_t behind = f->end - f->begin;

	d->begin_ns = arrivals_at(&d->arrivals, behind + len);
	d->last_ns = arrivals_at(&d->arrivals, behind + 1);
}

static void drain(struct decoder *d, enum direction direction, int64_t t_ns, const struct record_sink *sink)
{
	const uint8_t *telegram;
	size_t len;
	while ((len = framer_take(&d->framer[direction], &telegram)) > 0) {
		if (direction == FROM_DEVICE)
			date_telegram(d, len);
		if (direction == FROM_DEVICE)
			from_device(d, telegram, len, t_ns, sink);
		else
			to_device(d, telegram, len);
	}
}

void lms2xx_decode(struct decoder *d, const struct record *record, const struct record_sink *sink)
{
	const enum direction direction = record->direction == TO_DEVICE ? TO_DEVICE : FROM_DEVICE;
	struct framer *framer = &d->framer[direction];
	if (record->direction == LINK_OPENED) {
		framer_restart(&d->framer[FROM_DEVICE]);
		framer_restart(&d->framer[TO_DEVICE]);
		clocks_init(d);
		return;
	}
	if (record->t_ns - d->heard_ns[direction] > LMS2XX_STALE_NS)
		framer_silence(framer);
	d->heard_ns[direction] = record->t_ns;
	for (size_t done = 0; done < record->len;) {
		const size_t taken = framer_push(framer, record->bytes + done, record->len - done);
		done += taken;
		if (direction == FROM_DEVICE)
			arrivals_note(&d->arrivals, taken, record->t_ns);
		drain(d, direction, record->t_ns, sink);
	}
}

/* How well it keeps time. Without indices nobody knows what was lost, nor the mirror's own time. */
void lms2xx_timing(const struct decoder *d, struct decoder_timing *ret)
{
	*ret = (struct decoder_timing){
	    .known = d->expected_hz > 0, .expected_hz = d->expected_hz, .lost = d->count[TELEGRAMS_LOST]};
	if (!d->counts) {
		jitter_percentiles(&d->jitter, &ret->jitter_p50_ns, &ret->jitter_p99_ns);
		return;
	}
	ret->stamps = true;
	ret->offset_ns = d->mirror.offset_ns;
	ret->drift_ppm = d->mirror.drift * 1e6;
	device_clock_jitter(&d->mirror, &ret->jitter_p50_ns, &ret->jitter_p99_ns);
}

static void fields(struct decoder *d, struct state *s)
{
	state_tag(s, "lms2xx1");
	state_u32(s, &d->baud);
	state_u8(s, &d->asked_mode);
	state_bool(s, &d->mode_known);
	state_int(s, &d->mode, 0, UINT8_MAX);
	state_int(s, &d->fov_deg, 0, UINT16_MAX);
	state_int(s, &d->resolution_cdeg, 0, UINT16_MAX);
	state_bool(s, &d->index_known);
	state_u8(s, &d->scan_index);
	state_u8(s, &d->telegram_index);
	state_bool(s, &d->counts);
	state_double(s, &d->expected_hz);
	clock_filter_state(s, &d->filter);
	state_u64(s, &d->skipped);
	device_clock_state(s, &d->mirror);
	for (int i = 0; i < 2; i++) {
		state_time(s, &d->heard_ns[i]);
		framer_state(s, &d->framer[i]);
	}
	arrivals_state(s, &d->arrivals);
	for (int i = 0; i < COUNTERS; i++)
		state_u64(s, &d->count[i]);
}

/* What lies in the scan's scratch is written anew by every scan. */
void lms2xx_decoder_state(struct decoder *d, struct state *s)
{
	if (s->loading)
		start(d, d->configured_baud);
	fields(d, s);
	if (s->loading && s->failed)
		start(d, d->configured_baud);
}

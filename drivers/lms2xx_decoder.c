/* LMS2xx: bytes of both directions -> profiles and replies. Passive (law L7).
 *
 * What a range word means is decided by the measuring mode, which no measurement says: it is learned from the
 * configuration whenever one passes by (F4, F7), and until then profiles are counted and dropped, never guessed; a
 * power cycle forgets it. The raster is told by the count of values (181, 361, 401 ... values exist in one raster
 * each); only where it is not (a sub-range, the fast S14) does the variant last answered decide.
 *
 * Times. The scanner sends a scan when its last beam is measured; the read that delivers the last byte comes a telegram
 * later (bytes * 10 / baud), and whatever the host added. So
 *     end of scan = clock filter(last byte - transfer),   first beam = end - (turns - 1) * 13.3 ms - fov * 37.04 us.
 * A scan of 0.5 (0.25) degree is 2 (4) turns of the mirror interlaced, each measuring every second (fourth) beam in
 * this order: struct profile says so and every beam gets its time from there. What the scanner adds itself (it is not
 * published) is a constant for calibration. The rate is learned from the request that sets it. */
#include "drivers/lms2xx.h"

#include <stdlib.h>

#include "core/trig.h"
#include "drivers/clock_filter.h"
#include "drivers/lms2xx_wire.h"

#define LINE_BYTES 4096 /* more than the longest telegram */

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
	DEVICE_ERRORS,
	COUNTERS
};

static const char *const counter_names[COUNTERS] = {
    "telegrams", "profiles",         "crc",           "garbage bytes",       "too long",       "bad size",
    "cut",       "unknown telegram", "mode unknown",  "mode without ranges", "raster unknown", "malformed",
    "nak",       "rejected",         "scans skipped", "device errors"};
_Static_assert(COUNTERS <= DECODER_COUNTERS_MAX, "the counters of a decoder have a limit");

struct decoder {
	int device;
	uint32_t baud;
	uint8_t asked_mode; /* second byte of the last mode request: a rate counts when it is answered */
	bool mode_known;
	int mode;                     /* measuring mode */
	int fov_deg, resolution_cdeg; /* variant last answered; 0: not known */
	bool index_known;
	uint8_t index; /* of the last scan that had one */
	struct clock_filter clock;
	int64_t heard_ns[2]; /* last bytes of a direction */
	struct framer framer[2];
	uint8_t bytes[2][LINE_BYTES];
	uint64_t count[COUNTERS];
	struct profile profile;
};

struct decoder *lms2xx_decoder_create(const struct config_device *config, int device)
{
	struct decoder *d = calloc(1, sizeof *d);
	if (d == NULL)
		return NULL;
	d->device = device;
	d->baud = config->baud;
	clock_filter_init(&d->clock, LMS2XX_TURN_NS);
	framer_init(&d->framer[FROM_DEVICE], lms2xx_scan_device, NULL, d->bytes[FROM_DEVICE], LINE_BYTES);
	framer_init(&d->framer[TO_DEVICE], lms2xx_scan_host, NULL, d->bytes[TO_DEVICE], LINE_BYTES);
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
}

/* Time of the first beam of the profile, from the arrival of its telegram's last byte. */
static int64_t first_beam(struct decoder *d, const struct raster *raster, size_t telegram_len, int64_t arrival_ns)
{
	const int64_t transfer_ns = d->baud > 0 ? (int64_t)telegram_len * 10 * 1000000000 / d->baud : 0;
	const int64_t end_ns = clock_filter_stamp(&d->clock, arrival_ns - transfer_ns, raster->interlace);
	const int64_t start_ns =
	    end_ns - (raster->interlace - 1) * (int64_t)LMS2XX_TURN_NS - raster->fov_deg * LMS2XX_BEAM_NS;
	return start_ns + (raster->first + raster->skip) / raster->interlace * (int64_t)d->profile.beam_ns;
}

/* Real-time indices count the scans that the mirror made: what lies between two telegrams was skipped on a slow line.
 */
static void follow_index(struct decoder *d, const struct lms2xx_scan *scan)
{
	if (scan->indexed && d->index_known)
		d->count[SCANS_SKIPPED] += (uint8_t)(scan->scan_index - d->index - 1);
	d->index_known = scan->indexed;
	d->index = scan->scan_index;
}

static void take_scan(struct decoder *d, const uint8_t *payload, size_t len, int64_t t_ns,
                      const struct record_sink *sink)
{
	struct lms2xx_scan scan;
	struct raster raster;
	const bool sane = lms2xx_decode_scan(payload, len, &scan) && lms2xx_unit_m(scan.unit) > 0;
	if (!sane) {
		d->count[MALFORMED]++;
		return;
	}
	follow_index(d, &scan);
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
	d->profile.t_ns = first_beam(d, &raster, len + 6, t_ns);
	d->count[PROFILES]++;
	sink->profile(sink->ctx, d->device, &d->profile);
}

static void learn_variant(struct decoder *d, const uint8_t *payload, size_t len)
{
	struct lms2xx_status status;
	bool taken;
	int fov_deg, resolution_cdeg;
	if (payload[0] == LMS2XX_STATUS_REPLY && lms2xx_decode_status(payload, len, &status)) {
		d->fov_deg = status.fov_deg;
		d->resolution_cdeg = status.resolution_cdeg;
	} else if (lms2xx_decode_variant(payload, len, &taken, &fov_deg, &resolution_cdeg) && taken) {
		d->fov_deg = fov_deg;
		d->resolution_cdeg = resolution_cdeg;
	}
}

static void learn_baud(struct decoder *d, const uint8_t *payload)
{
	const uint32_t baud = lms2xx_mode_baud(d->asked_mode);
	if (baud != 0 && payload[1] == 0 && baud != d->baud) {
		d->baud = baud;
		clock_filter_init(&d->clock, LMS2XX_TURN_NS);
	}
	d->asked_mode = 0;
}

/* The scanner was switched on: what is volatile is gone, and it may be another one. */
static void forget(struct decoder *d)
{
	d->mode_known = false;
	d->fov_deg = d->resolution_cdeg = 0;
	d->index_known = false;
	clock_filter_init(&d->clock, LMS2XX_TURN_NS);
}

static void take_telegram(struct decoder *d, const uint8_t *payload, size_t len, int64_t t_ns,
                          const struct record_sink *sink)
{
	struct lms2xx_config config;
	switch (payload[0]) {
	case LMS2XX_SCAN:
	case LMS2XX_SCAN_MEAN:
	case LMS2XX_SCAN_RANGE:
	case LMS2XX_SCAN_RANGE_MEAN:
	case LMS2XX_SCAN_REFLECTIVITY:
	case LMS2XX_PARTS_REFLECTIVITY:
		take_scan(d, payload, len, t_ns, sink);
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
		take_telegram(d, reply.payload, reply.len, t_ns, sink);
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

static void drain(struct decoder *d, enum direction direction, int64_t t_ns, const struct record_sink *sink)
{
	const uint8_t *telegram;
	size_t len;
	while ((len = framer_take(&d->framer[direction], &telegram)) > 0) {
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
		return;
	}
	if (record->t_ns - d->heard_ns[direction] > LMS2XX_STALE_NS)
		framer_silence(framer);
	d->heard_ns[direction] = record->t_ns;
	for (size_t done = 0; done < record->len;) {
		done += framer_push(framer, record->bytes + done, record->len - done);
		drain(d, direction, record->t_ns, sink);
	}
}

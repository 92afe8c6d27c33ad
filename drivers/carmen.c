/* Lines of a CARMEN log as a scanner with a tilt channel: passive, for replay alone (`facet replay`, `facetd --replay`).
 *
 * One device takes the message it is told to (`message`; else the front laser: FLASER, ROBOTLASER1, RAWLASER1) and the
 * PANTILT lines; it may be its own `tilt`. A line's time (record.t_ns) is when the scanner's telegram had come, so the
 * first beam was a scan earlier: half a turn of a mirror with 75 Hz, two where half degrees are interlaced. What the line took
 * on its way nobody recorded: `latency`. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/carmen_lines.h"
#include "core/trig.h"
#include "drivers/driver.h"

#define TURN_NS      13333333 /* of the mirror of every LMS2xx */
#define BEAM_NS      37037    /* for one degree */
#define INTERLACED_N 300      /* values; half a circle in steps of a degree has 181 */

enum { PROFILES, ANGLES, OTHERS, BAD, COUNTERS };

struct decoder {
	struct config_device device;
	int index;
	uint64_t count[COUNTERS];
	struct carmen_line line;
	struct profile profile;
};

static struct decoder *decoder_create(const struct config_device *device, int index)
{
	struct decoder *d = calloc(1, sizeof *d);

	if (d) {
		d->device = *device;
		d->index = index;
	}
	return d;
}

static void decoder_destroy(struct decoder *d)
{
	free(d);
}

static bool is_wanted(const struct decoder *d)
{
	const char *name = d->line.name;

	if (*d->device.message)
		return strcmp(name, d->device.message) == 0;
	return strcmp(name, "FLASER") == 0 || strcmp(name, "ROBOTLASER1") == 0 || strcmp(name, "RAWLASER1") == 0;
}

static uint8_t state_of(const struct decoder *d, float range_m)
{
	if (!(range_m > 0))
		return BEAM_NO_ECHO;
	return range_m >= CARMEN_CODES_M || (d->line.max_range_m > 0 && range_m >= d->line.max_range_m)
	           ? BEAM_BEYOND_MAX
	           : BEAM_OK;
}

static void take_laser(struct decoder *d, int64_t t_ns, const struct record_sink *sink)
{
	const bool interlaced = d->line.n > INTERLACED_N;
	struct profile *p = &d->profile;

	p->interlace = interlaced ? 2 : 1;
	p->beam_ns = (int32_t)(d->line.step_rad / TRIG_DEG * BEAM_NS) * p->interlace;
	p->turn_ns = TURN_NS;
	p->parts = 1;
	p->n = (uint16_t)d->line.n;
	p->first_rad = d->line.first_rad;
	p->step_rad = d->line.step_rad;
	p->t_ns =
	    t_ns - (int64_t)(d->line.n / p->interlace) * p->beam_ns - (interlaced ? TURN_NS : 0) - d->device.latency_ns;
	memcpy(p->range_m, d->line.range_m, d->line.n * sizeof *p->range_m);
	for (uint32_t i = 0; i < d->line.n; i++)
		p->state[i] = state_of(d, p->range_m[i]);
	d->count[PROFILES]++;
	sink->profile(sink->ctx, d->index, p);
}

static void take_tilt(struct decoder *d, int64_t t_ns, const struct record_sink *sink)
{
	const double sign = d->device.encoder.set ? d->device.encoder.sign : 1;
	const double scale = d->device.encoder.set ? d->device.encoder.scale : 1;
	const double zero = d->device.encoder.set ? d->device.encoder.zero : 0;
	const struct tilt tilt = {t_ns, sign * scale * (d->line.tilt_rad - zero)};

	d->count[ANGLES]++;
	sink->tilt(sink->ctx, d->index, &tilt);
}

static void decode(struct decoder *d, const struct record *record, const struct record_sink *sink)
{
	enum carmen_kind kind;

	if (record->direction != FROM_DEVICE)
		return;
	kind = carmen_read((const char *)record->bytes, record->len, &d->line);
	if (kind == CARMEN_LASER && is_wanted(d))
		take_laser(d, record->t_ns, sink);
	else if (kind == CARMEN_PANTILT)
		take_tilt(d, record->t_ns, sink);
	else
		d->count[kind == CARMEN_BAD ? BAD : OTHERS]++;
}

static void counters(const struct decoder *d, struct decoder_counters *ret)
{
	static const char *const name[COUNTERS] = {"profiles", "angles", "other messages", "bad lines"};

	ret->n = COUNTERS;
	for (int i = 0; i < COUNTERS; i++) {
		ret->counter[i].name = name[i];
		ret->counter[i].count = d->count[i];
	}
}

/* A line says all there is: nothing is remembered from one to the next. */
static void state(struct decoder *d, struct state *s)
{
	(void)d;
	state_tag(s, "carmen1");
}

static struct link *link_open(const struct config_device *device, char error[160])
{
	snprintf(error, 160, "%s is no device but a log: play it with facetd --replay FILE", device->name);
	return NULL;
}

static int link_fd(const struct link *link)
{
	(void)link;
	return -1;
}

static ssize_t link_read(struct link *link, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	(void)link, (void)buf, (void)cap, (void)t_ns;
	return 0;
}

static void link_close(struct link *link)
{
	(void)link;
}

const struct driver driver_carmen = {
    .name = "carmen",
    .role = ROLE_LASER,
    .decoder_create = decoder_create,
    .decoder_destroy = decoder_destroy,
    .decode = decode,
    .counters = counters,
    .state = state,
    .link_open = link_open,
    .link_fd = link_fd,
    .link_read = link_read,
    .link_close = link_close,
};

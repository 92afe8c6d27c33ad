/* An angle in a CAN frame that somebody sends: an inclinometer, an encoder, another computer's servo. Read only: nothing is
 * ever written to the bus.
 *
 * The decoder takes each entry (can_wire.h) as an error frame, a loss, or a frame of ours, and judges the latter by reason
 * (can_signal.h). Where the device counts from 0 again, the angle nearest to 0 is meant. A frame's time is when it was on
 * the bus; how long the sender had kept the angle nobody knows, and `facet calibrate` finds it.
 *
 * The filter lets through the number in both kinds of identifier, and requests for it: a frame of the other kind is never
 * taken, but that it comes is the answer to "why is there no angle?", as are frames that are too short or not valid. The
 * dialogue keeps the reason that was met last and puts it into its sentence. It listens on while the angle is missing, so
 * the first good frame brings it back, and asks for a new link only when nothing has come for long. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "drivers/can_bus.h"
#include "drivers/can_link.h"
#include "drivers/can_signal.h"
#include "drivers/driver.h"
#include "drivers/jitter.h"

#define CAN_REFUSED 1 /* kind of a reply: the reason has changed; payload: one byte, enum can_signal_verdict */

#define RENEW_NS 2000000000ll /* a link on which nothing good came for so long is opened anew */

/* Decoder */

enum { MALFORMED = CAN_SIGNAL_VERDICTS, COUNTERS };

struct decoder {
	struct config_device device;
	int index;
	struct can_bus bus;
	struct can_signal_counter counter;
	uint64_t count[COUNTERS];
	enum can_signal_verdict last; /* of the frames with our number */
	struct jitter jitter;         /* from the bus to the loop: for the status, not in the snapshot */
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

static void say(const struct decoder *d, const struct record_sink *sink, int64_t t_ns, int kind, int what)
{
	const uint8_t payload = (uint8_t)what;
	const struct reply reply = {.t_ns = t_ns, .kind = kind, .payload = &payload, .len = 1};

	if (sink->reply)
		sink->reply(sink->ctx, d->index, &reply);
}

/* The angle nearest to 0 that the number may mean. */
static double unwrap(const struct config_signal *s, double angle_rad)
{
	const double turn_rad = fabs(s->scale * s->wrap);

	return turn_rad > 0 ? angle_rad - turn_rad * floor(angle_rad / turn_rad + 0.5) : angle_rad;
}

static enum can_signal_verdict judge(struct decoder *d, const struct can_frame_at *f, double *ret_rad)
{
	const struct config_signal *s = &d->device.angle;
	struct can_signal_value v = {0};
	enum can_signal_verdict verdict = can_signal_get(s, f, &v);

	if (verdict == CAN_SIGNAL_GOOD || verdict == CAN_SIGNAL_INVALID || verdict == CAN_SIGNAL_NO_NUMBER)
		can_signal_follow(s, &d->counter, v.counter);
	if (verdict == CAN_SIGNAL_GOOD) {
		*ret_rad = unwrap(s, v.value);
		if (!(fabs(*ret_rad) <= TRIG_ANGLE_MAX))
			verdict = CAN_SIGNAL_NO_NUMBER;
	}
	return verdict;
}

static void take_frame(struct decoder *d, const struct can_frame_at *f, int64_t log_ns, const struct record_sink *sink)
{
	struct tilt tilt = {.t_ns = f->t_ns};
	enum can_signal_verdict verdict;

	if (can_bus_take(&d->bus, f))
		say(d, sink, f->t_ns, CAN_BUS_REPLY, (int)d->bus.health);
	if (f->id & CAN_WIRE_ERROR) /* and CAN_WIRE_LOST */
		return;
	verdict = judge(d, f, &tilt.angle_rad);
	d->count[verdict]++;
	if (verdict != d->last && verdict != CAN_SIGNAL_GOOD)
		say(d, sink, f->t_ns, CAN_REFUSED, (int)verdict);
	d->last = verdict;
	if (verdict != CAN_SIGNAL_GOOD)
		return;
	if (log_ns > -CAN_WIRE_TIME_MAX && log_ns < CAN_WIRE_TIME_MAX)
		jitter_note(&d->jitter, log_ns - f->t_ns);
	sink->tilt(sink->ctx, d->index, &tilt);
}

static void decode(struct decoder *d, const struct record *record, const struct record_sink *sink)
{
	if (record->direction == LINK_OPENED) {
		can_bus_opened(&d->bus);
		d->counter.known = false;
		d->last = CAN_SIGNAL_GOOD;
	}
	if (record->direction != FROM_DEVICE)
		return;
	for (size_t at = 0; at < record->len;) {
		struct can_frame_at f;
		const ssize_t n = can_wire_get(record->bytes + at, record->len - at, &f);

		if (n <= 0) {
			d->count[MALFORMED]++;
			return;
		}
		take_frame(d, &f, record->log_ns, sink);
		at += (size_t)n;
	}
}

static void add(struct decoder_counters *ret, const char *name, uint64_t count)
{
	ret->counter[ret->n].name = name;
	ret->counter[ret->n++].count = count;
}

static void counters(const struct decoder *d, struct decoder_counters *ret)
{
	ret->n = 0;
	add(ret, "angles", d->count[CAN_SIGNAL_GOOD]);
	for (int i = CAN_SIGNAL_GOOD + 1; i < CAN_SIGNAL_VERDICTS; i++)
		if (i != CAN_SIGNAL_ERROR)
			add(ret, can_signal_name((enum can_signal_verdict)i), d->count[i]);
	add(ret, "lost by counter", d->counter.lost);
	add(ret, "counter stuck", d->counter.stuck);
	add(ret, "malformed", d->count[MALFORMED]);
	can_bus_counters(&d->bus, ret);
}

static void timing(const struct decoder *d, struct decoder_timing *ret)
{
	*ret = (struct decoder_timing){.known = d->jitter.n > 0, .lost = d->counter.lost};
	jitter_percentiles(&d->jitter, &ret->jitter_p50_ns, &ret->jitter_p99_ns);
}

static void fields_state(struct decoder *d, struct state *s)
{
	int last = (int)d->last;

	state_tag(s, "can1");
	can_bus_state(s, &d->bus);
	can_signal_state(s, &d->counter);
	for (int i = 0; i < COUNTERS; i++)
		state_u64(s, &d->count[i]);
	state_int(s, &last, 0, CAN_SIGNAL_VERDICTS - 1);
	d->last = (enum can_signal_verdict)last;
}

static void state(struct decoder *d, struct state *s)
{
	struct decoder aside = {.device = d->device, .index = d->index};

	if (!s->loading) {
		fields_state(d, s);
		return;
	}
	fields_state(&aside, s);
	*d = s->failed ? (struct decoder){.device = d->device, .index = d->index} : aside;
}

/* Dialogue */

struct dialogue {
	struct config_device device;
	bool heard;       /* an angle, since it was opened or lost */
	bool met;         /* any frame with our number */
	int64_t heard_ns; /* ... or when it was opened */
	int64_t renew_ns;
	enum can_signal_verdict refused;
	enum can_bus_health health;
	bool stopping;
};

static struct dialogue *dialogue_create(const struct config *config, int device)
{
	struct dialogue *d = calloc(1, sizeof *d);

	if (d)
		d->device = config->device[device];
	return d;
}

static void dialogue_destroy(struct dialogue *d)
{
	free(d);
}

static void dialogue_reset(struct dialogue *d, int64_t t_ns)
{
	*d = (struct dialogue){.device = d->device, .heard_ns = t_ns};
	d->renew_ns = t_ns + (d->device.timeout_ns > RENEW_NS ? d->device.timeout_ns : RENEW_NS);
}

static void dialogue_reply(struct dialogue *d, const struct reply *reply)
{
	if (reply->len < 1)
		return;
	if (reply->kind == CAN_BUS_REPLY && reply->payload[0] < CAN_BUS_HEALTHS)
		d->health = (enum can_bus_health)reply->payload[0];
	if (reply->kind == CAN_REFUSED && reply->payload[0] < CAN_SIGNAL_VERDICTS) {
		d->met = true;
		d->refused = (enum can_signal_verdict)reply->payload[0];
	}
}

static void dialogue_data(struct dialogue *d, int64_t t_ns)
{
	d->heard = d->met = true;
	d->refused = CAN_SIGNAL_GOOD;
	d->heard_ns = t_ns;
	d->renew_ns = t_ns + d->device.timeout_ns + RENEW_NS;
}

/* What the frames with our number lack, and which key says what they should be. */
static const char *why_refused(const struct dialogue *d)
{
	switch (d->refused) {
	case CAN_SIGNAL_FOREIGN:
		return d->device.angle.extended ? "they have 11 bits of identifier: `extended: off`?"
		                                : "they have 29 bits of identifier: `extended: on`?";
	case CAN_SIGNAL_REMOTE:
		return "somebody asks for them, nobody sends them";
	case CAN_SIGNAL_SHORT:
		return "they are too short: correct `start`, `length`, `min_dlc`";
	case CAN_SIGNAL_OTHER_MUX:
		return "none has this `mux`";
	case CAN_SIGNAL_INVALID:
		return "the sender says that its value is not `valid`";
	default:
		return "what they hold is no angle: correct `type`, `start`, `order`";
	}
}

static void why_silent(const struct dialogue *d, char ret[160])
{
	const struct config_device *c = &d->device;

	if (d->health != CAN_BUS_ACTIVE)
		can_bus_sentence(d->health, c->connect, ret);
	else if (d->met && d->refused != CAN_SIGNAL_GOOD)
		snprintf(ret, 160, "%.30s: no angle in frames 0x%X: %s", c->connect, c->angle.id, why_refused(d));
	else
		snprintf(ret, 160, "%.30s: no frame 0x%X within %.3g s: is the sender on, is `id` right, the bit rate?",
		         c->connect, c->angle.id, (double)c->timeout_ns / 1e9);
}

static void dialogue_step(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	memset(ret, 0, sizeof *ret);
	ret->state = DIALOGUE_CONFIGURING;
	ret->deadline_ns = d->renew_ns;
	if (d->stopping) {
		ret->state = DIALOGUE_FAILED;
		return;
	}
	if (d->heard && t_ns - d->heard_ns < d->device.timeout_ns) {
		ret->state = DIALOGUE_STREAMING;
		ret->deadline_ns = d->heard_ns + d->device.timeout_ns;
		can_bus_sentence(d->health, d->device.connect, ret->error);
		return;
	}
	d->heard = false;
	why_silent(d, ret->error);
	if (t_ns >= d->renew_ns)
		ret->state = DIALOGUE_FAILED;
}

static void dialogue_stop(struct dialogue *d, int64_t t_ns)
{
	(void)t_ns;
	d->stopping = true;
}

/* Link */

#define NUMBER 0x1FFFFFFFu /* of either kind, data or remote */

static struct link *link_open(const struct config_device *device, char error[160])
{
	const struct can_link_filter filter = {device->angle.id, NUMBER};

	return can_link_open(device->connect, &filter, 1, error);
}

const struct driver driver_can = {
    .name = "can",
    .role = ROLE_TILT,
    .decoder_create = decoder_create,
    .decoder_destroy = decoder_destroy,
    .decode = decode,
    .counters = counters,
    .timing = timing,
    .state = state,
    .dialogue_create = dialogue_create,
    .dialogue_destroy = dialogue_destroy,
    .dialogue_reset = dialogue_reset,
    .dialogue_reply = dialogue_reply,
    .dialogue_data = dialogue_data,
    .dialogue_step = dialogue_step,
    .dialogue_stop = dialogue_stop,
    .link_open = link_open,
    .link_fd = can_link_fd,
    .link_read = can_link_read,
    .link_write = can_link_write,
    .link_error = can_link_error,
    .link_note = can_link_note,
    .link_close = can_link_close,
};

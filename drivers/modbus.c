/* A tilt servo behind Modbus: decoder and table; the bus itself is modbus_bus.c, the sweeping modbus_dialogue.c.
 *
 * A polled angle was true somewhere between request and answer, so it is stamped at their midpoint; its uncertainty is
 * half the round trip. An answer that took more than three times the median of the last ones waited somewhere nobody
 * knows: it is refused and counted. Round trips of up to a millisecond are never refused: half of that is 0.015 degree
 * at 30 degrees a second, and on a fast network three times the median is within the jitter of any scheduler.
 *
 * Both registers of a position are read by one request, and yet there are devices that fill them one after the other: an
 * angle torn at a carry leaps by 65,536 counts. Whatever leaps further than any servo turns is refused and counted, unless
 * the next one says the same: then the device counts anew. */
#include "drivers/modbus_parts.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "drivers/jitter.h"

#define RTT_KEPT    31 /* odd: the median is one of them */
#define RTT_JUDGED  7  /* before so many are known nothing is refused */
#define RTT_GOOD_NS 1000000
#define RTT_LIMIT   3
#define RTT_MAX_NS  INT64_C(60000000000)
#define LEAP_RAD    (2 * TRIG_DEG)
#define LEAP_RAD_S  (1000 * TRIG_DEG)
#define TIME_MAX_NS (INT64_MAX / 4)

enum { ANGLES, READS, WRITES, REFUSED, NO_ANSWER, SLOW, TORN, FOREIGN, MALFORMED, COUNTERS };
static const char *const counter_name[COUNTERS] = {"angles", "reads", "writes",  "refused",  "no answer",
                                                   "slow",   "torn",  "foreign", "malformed"};

struct sample {
	bool known;
	double rad;
	int64_t t_ns;
};

struct decoder {
	struct config_device device;
	int index;
	int64_t rtt_ns[RTT_KEPT];
	int rtt_n, rtt_next;
	double last_rad; /* of the answer before, a refused one too */
	bool answered;
	struct sample used, doubted; /* the newest angles that were, and were not */
	uint64_t count[COUNTERS];
	struct jitter jitter; /* round trips: for the status, not in the snapshot */
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

static int64_t rtt_median(const struct decoder *d)
{
	int64_t sorted[RTT_KEPT] = {0};

	for (int i = 0; i < d->rtt_n; i++) {
		int at = i;

		for (; at > 0 && sorted[at - 1] > d->rtt_ns[i]; at--)
			sorted[at] = sorted[at - 1];
		sorted[at] = d->rtt_ns[i];
	}
	return sorted[d->rtt_n / 2];
}

/* Slow ones are remembered too: a bus that becomes slower for good is followed. */
static bool rtt_is_slow(struct decoder *d, int64_t rtt_ns)
{
	bool slow = d->rtt_n >= RTT_JUDGED && rtt_ns > RTT_GOOD_NS && rtt_ns / RTT_LIMIT > rtt_median(d);

	d->rtt_ns[d->rtt_next] = rtt_ns;
	d->rtt_next = (d->rtt_next + 1) % RTT_KEPT;
	if (d->rtt_n < RTT_KEPT)
		d->rtt_n++;
	return slow;
}

static void say(struct decoder *d, const struct record_sink *sink, int64_t t_ns, int kind, const void *payload,
                size_t len)
{
	struct reply reply = {.t_ns = t_ns, .kind = kind, .payload = payload, .len = len};

	if (sink->reply)
		sink->reply(sink->ctx, d->index, &reply);
}

static bool is_position(const struct decoder *d, const struct modbus_transaction *t)
{
	const struct config_register *position = &d->device.position;

	return t->function == modbus_wire_read_function(position) &&
	       t->address == modbus_wire_address(&d->device, position->address) &&
	       t->n == modbus_wire_registers(position);
}

static bool is_awaited(const struct decoder *d, const struct config_writes *list, const struct modbus_transaction *t)
{
	for (int i = 0; i < list->n; i++)
		if (list->item[i].until.set && t->function == 3 &&
		    t->address == modbus_wire_address(&d->device, list->item[i].until.address))
			return true;
	return false;
}

/* One register that its dialogue asks for: the status, or what a step of a sequence waits for. */
static bool is_asked(const struct decoder *d, const struct modbus_transaction *t)
{
	const struct config_device *c = &d->device;

	if (t->n != 1)
		return false;
	return (c->status.set && t->function == c->status.function &&
	        t->address == modbus_wire_address(c, c->status.address)) ||
	       is_awaited(d, &c->write, t) || is_awaited(d, &c->reset, t) || is_awaited(d, &c->stop, t);
}

static bool leads_to(const struct sample *s, const struct tilt *tilt)
{
	return s->known &&
	       fabs(tilt->angle_rad - s->rad) <= LEAP_RAD + LEAP_RAD_S * 1e-9 * fabs((double)(tilt->t_ns - s->t_ns));
}

static bool is_torn(struct decoder *d, const struct tilt *tilt)
{
	struct sample now = {true, tilt->angle_rad, tilt->t_ns};
	bool torn = d->used.known && !leads_to(&d->used, tilt) && !leads_to(&d->doubted, tilt);

	if (torn) {
		d->doubted = now;
	} else {
		d->used = now;
		d->doubted.known = false;
	}
	return torn;
}

static void decode_angle(struct decoder *d, const struct modbus_transaction *t, const struct record_sink *sink)
{
	const struct config_register *position = &d->device.position;
	int64_t rtt_ns = t->t_answer_ns - t->t_request_ns;
	struct tilt tilt = {.t_ns = t->t_request_ns + rtt_ns / 2};

	if (modbus_wire_decode(position, t->value, &tilt.angle_rad) < 0) {
		d->count[MALFORMED]++;
		return;
	}
	bool stands = d->answered && tilt.angle_rad == d->last_rad;

	d->answered = true;
	d->last_rad = tilt.angle_rad;
	jitter_note(&d->jitter, rtt_ns);
	/* When a servo that stands was read does not matter: such an answer is good however long it took. */
	if (rtt_is_slow(d, rtt_ns) && !stands) {
		d->count[SLOW]++;
		return;
	}
	if (is_torn(d, &tilt)) {
		d->count[TORN]++;
		return;
	}
	d->count[ANGLES]++;
	sink->tilt(sink->ctx, d->index, &tilt);
	say(d, sink, t->t_answer_ns, MODBUS_ANGLE, &tilt.angle_rad, sizeof tilt.angle_rad);
}

/* A register may be the angle and be waited for: then it is both. */
static void decode_read(struct decoder *d, const struct modbus_transaction *t, const struct record_sink *sink)
{
	uint16_t what[3] = {t->function, t->address, t->value[0]};
	bool angle = is_position(d, t), asked = is_asked(d, t);

	if (angle)
		decode_angle(d, t, sink);
	else if (asked)
		d->count[READS]++;
	else
		d->count[FOREIGN]++;
	if (asked)
		say(d, sink, t->t_answer_ns, MODBUS_READ, what, sizeof what);
}

static void decode_refusal(struct decoder *d, const struct modbus_transaction *t, const struct record_sink *sink)
{
	uint16_t what[3] = {(uint16_t)(t->function & ~MODBUS_WIRE_REFUSED), t->address, t->value[0]};

	d->count[t->value[0] ? REFUSED : NO_ANSWER]++;
	say(d, sink, t->t_answer_ns, MODBUS_REFUSED, what, sizeof what);
}

static void decode_transaction(struct decoder *d, const struct modbus_transaction *t, const struct record_sink *sink)
{
	int64_t rtt_ns = 0;

	/* A replayed or hostile record may carry any times: those of this age have room for differences, and a round
	 * trip is positive and shorter than any time-out. */
	if (llabs(t->t_request_ns / 2) < TIME_MAX_NS && llabs(t->t_answer_ns / 2) < TIME_MAX_NS)
		rtt_ns = t->t_answer_ns - t->t_request_ns;
	if (rtt_ns <= 0 || rtt_ns > RTT_MAX_NS) {
		d->count[MALFORMED]++;
		return;
	}
	if (t->unit != d->device.slave) {
		d->count[FOREIGN]++;
	} else if (t->function & MODBUS_WIRE_REFUSED) {
		decode_refusal(d, t, sink);
	} else if (t->function == 3 || t->function == 4) {
		decode_read(d, t, sink);
	} else {
		d->count[WRITES]++;
		say(d, sink, t->t_answer_ns, MODBUS_WRITTEN, &t->address, sizeof t->address);
	}
}

/* What goes to the device carries nothing that its answer does not say again. */
static void decode(struct decoder *d, const struct record *record, const struct record_sink *sink)
{
	struct modbus_transaction t;
	size_t at = 0;

	if (record->direction != FROM_DEVICE)
		return;
	while (at < record->len) {
		ssize_t n = modbus_wire_get(record->bytes + at, record->len - at, &t);

		if (n <= 0) {
			d->count[MALFORMED]++;
			return;
		}
		decode_transaction(d, &t, sink);
		at += (size_t)n;
	}
}

static void counters(const struct decoder *d, struct decoder_counters *ret)
{
	ret->n = COUNTERS;
	for (int i = 0; i < COUNTERS; i++) {
		ret->counter[i].name = counter_name[i];
		ret->counter[i].count = d->count[i];
	}
}

static void timing(const struct decoder *d, struct decoder_timing *ret)
{
	const int64_t period_ns =
	    d->device.period_ns > MODBUS_PERIOD_MIN_NS ? d->device.period_ns : MODBUS_PERIOD_MIN_NS;

	*ret = (struct decoder_timing){.known = d->jitter.n > 0};
	if (d->device.period_ns > 0) /* else as fast as the answers come, and how fast they are the line decides */
		ret->expected_hz = 1e9 / (double)period_ns;
	jitter_percentiles(&d->jitter, &ret->jitter_p50_ns, &ret->jitter_p99_ns);
}

static void sample_state(struct state *s, struct sample *sample)
{
	state_bool(s, &sample->known);
	state_double(s, &sample->rad);
	state_i64(s, &sample->t_ns);
	s->failed |= s->loading && llabs(sample->t_ns / 2) >= TIME_MAX_NS;
}

/* Round trips are kept oldest first: where they lie in their ring matters to nobody. */
static void fields_state(struct decoder *d, struct state *s)
{
	const int oldest = d->rtt_n < RTT_KEPT ? 0 : d->rtt_next;

	state_tag(s, "modbus3");
	state_int(s, &d->rtt_n, 0, RTT_KEPT);
	for (int i = 0; i < d->rtt_n && !s->failed; i++) {
		state_time(s, &d->rtt_ns[(oldest + i) % RTT_KEPT]);
		s->failed |= s->loading && (d->rtt_ns[i] <= 0 || d->rtt_ns[i] > RTT_MAX_NS);
	}
	d->rtt_next = s->loading ? d->rtt_n % RTT_KEPT : d->rtt_next;
	state_double(s, &d->last_rad);
	state_bool(s, &d->answered);
	sample_state(s, &d->used);
	sample_state(s, &d->doubted);
	for (int i = 0; i < COUNTERS; i++)
		state_u64(s, &d->count[i]);
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

const struct driver driver_modbus = {
    .name = "modbus",
    .role = ROLE_TILT,
    .decoder_create = decoder_create,
    .decoder_destroy = decoder_destroy,
    .decode = decode,
    .counters = counters,
    .timing = timing,
    .state = state,
    .dialogue_create = modbus_dialogue_create,
    .dialogue_destroy = modbus_dialogue_destroy,
    .dialogue_reset = modbus_dialogue_reset,
    .dialogue_reply = modbus_dialogue_reply,
    .dialogue_data = modbus_dialogue_data,
    .dialogue_step = modbus_dialogue_step,
    .dialogue_stop = modbus_dialogue_stop,
    .link_open = modbus_bus_open,
    .link_fd = modbus_bus_fd,
    .link_read = modbus_bus_read,
    .link_write = modbus_bus_write,
    .link_error = modbus_bus_error,
    .link_close = modbus_bus_close,
};

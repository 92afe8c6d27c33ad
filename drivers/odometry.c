/* The motion of the robot's wheels, in CAN frames that somebody sends: speed and rate of turn, or what the encoders of a
 * left and a right wheel count. Read only.
 *
 * The two numbers may come in one frame or in two, at the same rate or not, so each is a lane of its own: samples in a
 * ring, with the sum up to each (of a count: the way; of a speed: its integral, which is linear between two frames). A
 * motion reaches from where the last one ended to where both lanes have arrived; within a lane's last step its sum is
 * interpolated. So nothing has to be paired, and it does not matter how frames of the two alternate.
 *
 *   left   x-----x-----x-----x           wheels: ahead = (left + right) / 2, turn = (right - left) / track
 *   right     x-----x-----x
 *   motion   ...-|--|--|--|
 *
 * What is not driven, but counted: a silence beyond the limit (what a speed was meanwhile nobody knows; a count knows, up
 * to the device's timeout), a step of a count that no wheel makes (the encoder was switched off and on), numbers that no
 * robot drives. The lane then begins anew, and so does the motion: the track sees that a piece is missing. Counts wrap at
 * `wrap`, or where their bits do: the shorter way round is meant. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "drivers/can_bus.h"
#include "drivers/can_link.h"
#include "drivers/can_signal.h"
#include "drivers/driver.h"
#include "drivers/jitter.h"

#define ODOMETRY_VERDICT \
	1 /* kind of a reply: of a lane, the verdict has changed; payload: lane, enum can_signal_verdict */

#define LANES       2
#define SAMPLES     64                  /* of a lane, that the other one has not reached */
#define RENEW_NS    INT64_C(2000000000) /* a link on which nothing good came for so long is opened anew */
#define SILENCE_NS  INT64_C(250000000)  /* a speed is not carried on for longer */
#define SET_BACK_NS INT64_C(2000000000) /* older by more than this: time was set back */
#define SPEED_MAX   50.0                /* m/s, of a wheel too */
#define TURN_MAX    50.0                /* rad/s */
#define SUM_MAX     1e9                 /* begun anew beyond: metres there are no bits for */

struct sample {
	int64_t t_ns;
	double value; /* m/s, rad/s, or counts */
	double sum;   /* m or rad, since the lane began */
};

struct lane {
	uint64_t begin, end;
	struct sample sample[SAMPLES]; /* ring, times rise strictly */
	struct can_signal_counter counter;
	enum can_signal_verdict last; /* of the frames with our number */
	bool met;                     /* there was one since the link was opened */
};

enum { MALFORMED = CAN_SIGNAL_VERDICTS, MOTIONS, GAPS, JUMPS, IMPLAUSIBLE, COUNTERS };

struct decoder {
	struct config_device device;
	int index;
	bool wheels;
	struct can_bus bus;
	struct lane lane[LANES];
	bool begun;      /* a motion has ended at ... */
	int64_t done_ns; /* ... then */
	uint64_t count[COUNTERS];
	struct jitter jitter; /* from the bus to the loop: for the status, not in the snapshot */
};

static const struct config_signal *signal_of(const struct decoder *d, int lane)
{
	if (d->wheels)
		return lane ? &d->device.right : &d->device.left;
	return lane ? &d->device.turn : &d->device.ahead;
}

static struct decoder *decoder_create(const struct config_device *device, int index)
{
	struct decoder *d = calloc(1, sizeof *d);

	if (d) {
		d->device = *device;
		d->index = index;
		d->wheels = device->left.set;
	}
	return d;
}

static void decoder_destroy(struct decoder *d)
{
	free(d);
}

/* Lanes */

static struct sample *sample_at(struct lane *lane, uint64_t i)
{
	return &lane->sample[i % SAMPLES];
}

static struct sample *newest(struct lane *lane)
{
	return sample_at(lane, lane->end - 1);
}

static void put_sample(struct lane *lane, struct sample sample)
{
	if (lane->end - lane->begin == SAMPLES)
		lane->begin++;
	*sample_at(lane, lane->end++) = sample;
}

static void begin_lane(struct lane *lane, int64_t t_ns, double value)
{
	lane->begin = lane->end;
	put_sample(lane, (struct sample){.t_ns = t_ns, .value = value});
}

/* The way since the last count, by the shorter way round. */
static double counted(const struct config_signal *s, double from, double to)
{
	const double wrap = s->wrap > 0 ? s->wrap : s->type == SIGNAL_FLOAT ? 0 : ldexp(1, s->length);
	double step = to - from;

	if (wrap > 0)
		step -= wrap * rint(step / wrap);
	return step * s->scale;
}

static bool is_plausible(const struct decoder *d, int lane, double value)
{
	return d->wheels || fabs(value) <= (lane ? TURN_MAX : SPEED_MAX);
}

/* A good value of a lane. */
static void take_value(struct decoder *d, int which, int64_t t_ns, double value)
{
	const struct config_signal *s = signal_of(d, which);
	const int64_t timeout_ns = d->device.timeout_ns;
	const int64_t limit_ns = d->wheels || timeout_ns < SILENCE_NS ? timeout_ns : SILENCE_NS;
	struct lane *lane = &d->lane[which];
	struct sample last;
	double seconds, step;

	if (lane->end == lane->begin) {
		begin_lane(lane, t_ns, value);
		return;
	}
	last = *newest(lane);
	if (t_ns <= last.t_ns && last.t_ns - t_ns < SET_BACK_NS)
		return;
	seconds = (double)(t_ns - last.t_ns) * 1e-9;
	step = d->wheels ? counted(s, last.value, value) : (last.value + value) / 2 * seconds;
	if (t_ns < last.t_ns || t_ns - last.t_ns > limit_ns || !(fabs(last.sum) <= SUM_MAX)) {
		d->count[GAPS]++;
		begin_lane(lane, t_ns, value);
	} else if (d->wheels && !(fabs(step) <= SPEED_MAX * seconds + 2 * fabs(s->scale))) {
		d->count[JUMPS]++;
		begin_lane(lane, t_ns, value);
	} else {
		put_sample(lane, (struct sample){t_ns, value, last.sum + step});
	}
}

/* The sum at a time within the lane. */
static double sum_at(const struct decoder *d, struct lane *lane, int64_t t_ns)
{
	uint64_t i = lane->end - 1;
	const struct sample *a, *b;
	double at, whole;

	while (i > lane->begin && sample_at(lane, i)->t_ns > t_ns)
		i--;
	a = sample_at(lane, i);
	if (t_ns <= a->t_ns)
		return a->sum;
	b = sample_at(lane, i + 1);
	at = (double)(t_ns - a->t_ns) * 1e-9;
	whole = (double)(b->t_ns - a->t_ns) * 1e-9;
	if (d->wheels)
		return a->sum + (b->sum - a->sum) * at / whole;
	return a->sum + at * (a->value + (b->value - a->value) * at / (2 * whole));
}

/* What lies before t_ns is needed no more, but for the sample before it. */
static void forget(struct lane *lane, int64_t t_ns)
{
	while (lane->begin + 1 < lane->end && sample_at(lane, lane->begin + 1)->t_ns <= t_ns)
		lane->begin++;
}

/* Tells the motion up to where both lanes have arrived. */
static void advance(struct decoder *d, const struct record_sink *sink)
{
	struct lane *a = &d->lane[0], *b = &d->lane[1];
	struct motion motion;
	double first, second;
	int64_t from_ns;

	if (a->end == a->begin || b->end == b->begin)
		return;
	from_ns = sample_at(a, a->begin)->t_ns;
	if (sample_at(b, b->begin)->t_ns > from_ns)
		from_ns = sample_at(b, b->begin)->t_ns;
	motion.t_ns = newest(a)->t_ns < newest(b)->t_ns ? newest(a)->t_ns : newest(b)->t_ns;
	motion.from_ns = d->begun && d->done_ns > from_ns && d->done_ns - from_ns < SET_BACK_NS ? d->done_ns : from_ns;
	if (motion.t_ns <= motion.from_ns)
		return;
	first = sum_at(d, a, motion.t_ns) - sum_at(d, a, motion.from_ns);
	second = sum_at(d, b, motion.t_ns) - sum_at(d, b, motion.from_ns);
	motion.ahead_m = d->wheels ? (first + second) / 2 : first;
	motion.turn_rad = d->wheels ? (second - first) / d->device.track_m : second;
	d->begun = true;
	d->done_ns = motion.t_ns;
	forget(a, motion.t_ns);
	forget(b, motion.t_ns);
	d->count[MOTIONS]++;
	if (sink->motion)
		sink->motion(sink->ctx, d->index, &motion);
}

/* Decoder */

static void say(const struct decoder *d, const struct record_sink *sink, int64_t t_ns, int kind, const uint8_t *payload,
                size_t len)
{
	const struct reply reply = {.t_ns = t_ns, .kind = kind, .payload = payload, .len = len};

	if (sink->reply)
		sink->reply(sink->ctx, d->index, &reply);
}

#define NUMBER 0x1FFFFFFFu /* of either kind, data or remote */

/* True: there was a good value in it. */
static bool take_lane(struct decoder *d, int which, const struct can_frame_at *f, const struct record_sink *sink)
{
	const struct config_signal *s = signal_of(d, which);
	struct lane *lane = &d->lane[which];
	struct can_signal_value v = {0};
	enum can_signal_verdict verdict;

	if ((f->id & NUMBER) != s->id)
		return false;
	verdict = can_signal_get(s, f, &v);
	if (verdict == CAN_SIGNAL_GOOD || verdict == CAN_SIGNAL_INVALID || verdict == CAN_SIGNAL_NO_NUMBER)
		can_signal_follow(s, &lane->counter, v.counter);
	if (verdict == CAN_SIGNAL_GOOD && !is_plausible(d, which, v.value)) {
		d->count[IMPLAUSIBLE]++;
		verdict = CAN_SIGNAL_NO_NUMBER;
	}
	d->count[verdict]++;
	if (!lane->met || verdict != lane->last)
		say(d, sink, f->t_ns, ODOMETRY_VERDICT, (const uint8_t[]){(uint8_t)which, (uint8_t)verdict}, 2);
	lane->met = true;
	lane->last = verdict;
	if (verdict == CAN_SIGNAL_GOOD)
		take_value(d, which, f->t_ns, d->wheels ? v.raw : v.value);
	return verdict == CAN_SIGNAL_GOOD;
}

static void take_frame(struct decoder *d, const struct can_frame_at *f, int64_t log_ns, const struct record_sink *sink)
{
	bool good = false;

	if (can_bus_take(&d->bus, f))
		say(d, sink, f->t_ns, CAN_BUS_REPLY, (const uint8_t[]){(uint8_t)d->bus.health}, 1);
	if (f->id & CAN_WIRE_ERROR) /* and CAN_WIRE_LOST */
		return;
	for (int i = 0; i < LANES; i++)
		good |= take_lane(d, i, f, sink);
	if (!good)
		return;
	if (log_ns > -CAN_WIRE_TIME_MAX && log_ns < CAN_WIRE_TIME_MAX)
		jitter_note(&d->jitter, log_ns - f->t_ns);
	advance(d, sink);
}

static void decode(struct decoder *d, const struct record *record, const struct record_sink *sink)
{
	if (record->direction == LINK_OPENED) {
		can_bus_opened(&d->bus);
		for (int i = 0; i < LANES; i++) {
			d->lane[i].counter.known = false;
			d->lane[i].met = false;
		}
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
	add(ret, "motions", d->count[MOTIONS]);
	add(ret, "values", d->count[CAN_SIGNAL_GOOD]);
	for (int i = CAN_SIGNAL_GOOD + 1; i < CAN_SIGNAL_VERDICTS; i++)
		if (i != CAN_SIGNAL_ERROR)
			add(ret, can_signal_name((enum can_signal_verdict)i), d->count[i]);
	add(ret, "implausible", d->count[IMPLAUSIBLE]);
	add(ret, "gaps", d->count[GAPS]);
	add(ret, "jumps of a count", d->count[JUMPS]);
	add(ret, "lost by counter", d->lane[0].counter.lost + d->lane[1].counter.lost);
	add(ret, "counter stuck", d->lane[0].counter.stuck + d->lane[1].counter.stuck);
	add(ret, "malformed", d->count[MALFORMED]);
	can_bus_counters(&d->bus, ret);
}

static void timing(const struct decoder *d, struct decoder_timing *ret)
{
	*ret = (struct decoder_timing){.known = d->jitter.n > 0,
	                               .lost = d->lane[0].counter.lost + d->lane[1].counter.lost};
	jitter_percentiles(&d->jitter, &ret->jitter_p50_ns, &ret->jitter_p99_ns);
}

static void lane_state(struct lane *lane, struct state *s)
{
	size_t n = (size_t)(lane->end - lane->begin);
	int last = (int)lane->last;

	state_size(s, &n, SAMPLES);
	if (s->loading) {
		lane->begin = 0;
		lane->end = s->failed ? 0 : n;
	}
	for (uint64_t i = lane->begin; i < lane->end && !s->failed; i++) {
		struct sample *sample = sample_at(lane, i);

		state_time(s, &sample->t_ns);
		state_double(s, &sample->value);
		state_double(s, &sample->sum);
		s->failed |= s->loading && i > lane->begin && sample->t_ns <= sample_at(lane, i - 1)->t_ns;
		s->failed |= s->loading && !(fabs(sample->sum) <= 2 * SUM_MAX);
	}
	can_signal_state(s, &lane->counter);
	state_int(s, &last, 0, CAN_SIGNAL_VERDICTS - 1);
	lane->last = (enum can_signal_verdict)last;
	state_bool(s, &lane->met);
}

static void fields_state(struct decoder *d, struct state *s)
{
	state_tag(s, "odometry1");
	can_bus_state(s, &d->bus);
	for (int i = 0; i < LANES; i++)
		lane_state(&d->lane[i], s);
	state_bool(s, &d->begun);
	state_time(s, &d->done_ns);
	for (int i = 0; i < COUNTERS; i++)
		state_u64(s, &d->count[i]);
}

static void state(struct decoder *d, struct state *s)
{
	struct decoder aside = {.device = d->device, .index = d->index, .wheels = d->wheels};
	const struct decoder fresh = aside;

	if (!s->loading) {
		fields_state(d, s);
		return;
	}
	fields_state(&aside, s);
	*d = s->failed ? fresh : aside;
}

/* Dialogue */

struct dialogue {
	struct config_device device;
	bool heard;       /* a motion, since it was opened or lost */
	int64_t heard_ns; /* ... or when it was opened */
	int64_t renew_ns;
	struct {
		bool met; /* any frame with its number */
		enum can_signal_verdict last;
	} lane[LANES];
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
	if (reply->kind == CAN_BUS_REPLY && reply->len >= 1 && reply->payload[0] < CAN_BUS_HEALTHS)
		d->health = (enum can_bus_health)reply->payload[0];
	if (reply->kind != ODOMETRY_VERDICT || reply->len < 2 || reply->payload[0] >= LANES ||
	    reply->payload[1] >= CAN_SIGNAL_VERDICTS)
		return;
	d->lane[reply->payload[0]].met = true;
	d->lane[reply->payload[0]].last = (enum can_signal_verdict)reply->payload[1];
}

static void dialogue_data(struct dialogue *d, int64_t t_ns)
{
	d->heard = true;
	d->heard_ns = t_ns;
	d->renew_ns = t_ns + d->device.timeout_ns + RENEW_NS;
}

/* What the frames of a signal lack, and which key says what they should be. */
static const char *why_refused(const struct config_signal *s, enum can_signal_verdict verdict)
{
	switch (verdict) {
	case CAN_SIGNAL_FOREIGN:
		return s->extended ? "they have 11 bits of identifier: `extended: off`?"
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
		return "no robot drives so: correct `scale`, `type`, `start`, `order`";
	}
}

static void why_silent(const struct dialogue *d, char ret[160])
{
	const struct config_device *c = &d->device;
	const struct config_signal *signal[LANES] = {c->left.set ? &c->left : &c->ahead,
	                                             c->left.set ? &c->right : &c->turn};

	if (d->health != CAN_BUS_ACTIVE) {
		can_bus_sentence(d->health, c->connect, ret);
		return;
	}
	for (int i = 0; i < LANES; i++)
		if (d->lane[i].met && d->lane[i].last != CAN_SIGNAL_GOOD) {
			snprintf(ret, 160, "%.30s: no `%s` in frames 0x%X: %s", c->connect,
			         c->left.set ? (i ? "right" : "left") : (i ? "turn" : "speed"), signal[i]->id,
			         why_refused(signal[i], d->lane[i].last));
			return;
		}
	for (int i = 0; i < LANES; i++)
		if (!d->lane[i].met || i == LANES - 1) {
			snprintf(ret, 160,
			         "%.30s: no frame 0x%X within %.3g s: is the sender on, is `id` right, the bit rate?",
			         c->connect, d->lane[i].met ? signal[0]->id : signal[i]->id,
			         (double)c->timeout_ns / 1e9);
			return;
		}
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

static struct link *link_open(const struct config_device *c, char error[160])
{
	const struct can_link_filter filter[LANES] = {{c->left.set ? c->left.id : c->ahead.id, NUMBER},
	                                              {c->left.set ? c->right.id : c->turn.id, NUMBER}};

	return can_link_open(c->connect, filter, LANES, error);
}

const struct driver driver_odometry = {
    .name = "odometry",
    .role = ROLE_MOTION,
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

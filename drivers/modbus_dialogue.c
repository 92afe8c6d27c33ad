/* Setting up and sweeping a servo: pure, in the caller's time.
 *
 *   closed -> initial writes -> sweeping: speed, then one end point after the other -> (stop) rest angle -> done
 *
 * Only one write is under way at a time and each is answered (or said again, at most three times) before the next. The
 * servo moves by itself between the end points at its own speed, so the bus carries one target per half sweep and all
 * other turns are for reading the angle.
 *
 *   triangle   from -> to -> from ... at the same speed
 *   sinus      the same end points; the speed follows the sine's: w * sqrt(A^2 - (angle - middle)^2), never below a
 *              twentieth of its peak, so that the ends are reached
 *   step       from, from + step, ... to and back; each is left `settle` after it was reached
 *
 * A target is reached within a tenth of a degree, or where the servo stands still near it (its own dead band). Where it
 * stands still elsewhere the target is sent again; a servo that does not move after five of them is given up with a
 * sentence. No target ever lies outside from..to, but for the rest angle. */
#include "drivers/modbus_parts.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"

#define ANSWER_NS     1000000000 /* a write is answered by then, or said again */
#define TRIES_MAX     3
#define SILENCE_NS    3000000000 /* no angle for so long: given up */
#define LOOK_NS       50000000   /* how often the movement is looked at while nothing else happens */
#define IDLE_NS       500000000  /* the same without a sweep */
#define REACHED_RAD   (0.1 * TRIG_DEG)
#define NEAR_RAD      (1.0 * TRIG_DEG)
#define STILL_RAD     (0.02 * TRIG_DEG)
#define STILL_NS      200000000
#define STUCK_NS      1000000000
#define NUDGES_MAX    5
#define SINUS_FLOOR   0.05 /* of the peak speed */
#define SINUS_CHANGE  0.1  /* a new speed is sent when it differs by so much of the present one */
#define REST_GRACE_NS 2000000000
#define REST_MAX_S    60.0

enum phase { WRITING, RUNNING, STOPPING, STOPPED, FAILED };
enum wish { WISH_NONE, WISH_INITIAL, WISH_SPEED, WISH_TARGET };

struct dialogue {
	struct config_device device;
	bool sweeps;
	double from_rad, to_rad, peak_rad_s, step_rad, rest_rad;
	bool has_rest;
	int profile; /* SWEEP_TRIANGLE ... */
	int64_t settle_ns;

	enum phase phase;
	int next_write;    /* of the initial ones */
	enum wish waiting; /* the write under way */
	bool sent;
	int tries;
	int64_t sent_ns;

	bool speed_due, target_due;
	double speed_rad_s, target_rad;
	bool towards_to;
	int64_t since_ns; /* the present target was taken by the servo then */
	int nudges;
	bool settling;
	int64_t settled_ns;

	bool angle_known;
	double angle_rad, still_rad;
	int64_t angle_ns, still_ns;   /* it has stood near still_rad since still_ns */
	int64_t silent_ns, looked_ns; /* without an angle for so long, as far as it was looked at */
	int64_t stop_by_ns;
	char error[160];
};

struct dialogue *modbus_dialogue_create(const struct config *config, int device)
{
	struct dialogue *d = calloc(1, sizeof *d);

	if (!d)
		return NULL;
	d->device = config->device[device];
	d->sweeps = config->sweep.set && !strcmp(config->sweep.device, d->device.name);
	d->from_rad = config->sweep.from_rad;
	d->to_rad = config->sweep.to_rad;
	d->peak_rad_s = config->sweep.speed_rad_s;
	d->step_rad = config->sweep.step_rad;
	d->rest_rad = config->sweep.rest_rad;
	d->has_rest = config->sweep.has_rest;
	d->profile = config->sweep.profile;
	d->settle_ns = config->sweep.settle_ns;
	d->target_rad = d->from_rad;
	return d;
}

void modbus_dialogue_destroy(struct dialogue *d)
{
	free(d);
}

static void fail(struct dialogue *d, const char *what, const char *todo)
{
	d->phase = FAILED;
	snprintf(d->error, sizeof d->error, "%s %s; %s", d->device.name, what, todo);
}

/* What the sweep needs and the configuration lacks is said before anything moves. */
static bool sweep_is_possible(struct dialogue *d)
{
	if (!d->device.target.set)
		fail(d, "cannot be told where to go", "give it a `target` register or take it out of `sweep`");
	else if (d->profile == SWEEP_SINUS && !d->device.speed.set)
		fail(d, "cannot follow a sinus without a `speed` register", "give it one or use `profile: triangle`");
	else if (d->profile == SWEEP_STEP && !(d->step_rad > 0.0))
		fail(d, "is to step by nothing", "give `sweep.step`");
	return d->phase != FAILED;
}

void modbus_dialogue_reset(struct dialogue *d, int64_t t_ns)
{
	d->phase = WRITING;
	d->next_write = 0;
	d->waiting = WISH_NONE;
	d->sent = false;
	d->tries = 0;
	d->nudges = 0;
	d->settling = false;
	d->angle_known = false;
	d->silent_ns = 0;
	d->looked_ns = d->since_ns = t_ns;
	d->speed_rad_s = d->peak_rad_s;
	d->speed_due = d->sweeps && d->device.speed.set && d->peak_rad_s > 0.0;
	d->target_due = d->sweeps;
	if (d->sweeps)
		sweep_is_possible(d);
}

static void written(struct dialogue *d, int64_t t_ns)
{
	switch (d->waiting) {
	case WISH_INITIAL:
		d->next_write++;
		break;
	case WISH_TARGET:
		d->since_ns = t_ns;
		d->still_ns = t_ns;
		break;
	default:
		break;
	}
	d->waiting = WISH_NONE;
	d->sent = false;
	d->tries = 0;
}

static void said_again(struct dialogue *d)
{
	d->sent = false;
	if (++d->tries >= TRIES_MAX)
		fail(d, "does not answer a write", "check `unit`, `target`, `speed` and `write`");
}

static void refused(struct dialogue *d, const uint8_t *payload)
{
	uint16_t what[3]; /* function, address, code */
	char text[80];

	memcpy(what, payload, sizeof what);
	if (what[2] == 0 || what[2] == 5 || what[2] == 6) { /* no answer, will do it, busy */
		if (d->sent && (what[0] == 6 || what[0] == 16))
			said_again(d);
		return;
	}
	snprintf(text, sizeof text, "refuses function %d at address %d with exception %d", what[0], what[1], what[2]);
	fail(d, text, "check its registers and `address_base`");
}

static void moved(struct dialogue *d, double angle_rad, int64_t t_ns)
{
	if (!d->angle_known || fabs(angle_rad - d->still_rad) > STILL_RAD) {
		d->still_rad = angle_rad;
		d->still_ns = t_ns;
	}
	d->angle_known = true;
	d->angle_rad = angle_rad;
	d->angle_ns = t_ns;
	d->silent_ns = 0;
}

void modbus_dialogue_reply(struct dialogue *d, const struct reply *reply)
{
	double angle_rad;

	if (d->phase == FAILED || d->phase == STOPPED)
		return;
	if (reply->kind == MODBUS_ANGLE && reply->len == sizeof angle_rad) {
		memcpy(&angle_rad, reply->payload, sizeof angle_rad);
		moved(d, angle_rad, reply->t_ns);
	} else if (reply->kind == MODBUS_WRITTEN && d->sent) {
		written(d, reply->t_ns);
	} else if (reply->kind == MODBUS_REFUSED && reply->len == 3 * sizeof(uint16_t)) {
		refused(d, reply->payload);
	}
}

void modbus_dialogue_data(struct dialogue *d, int64_t t_ns)
{
	(void)t_ns;
	d->silent_ns = 0;
}

static void go(struct dialogue *d, double target_rad)
{
	d->target_rad = target_rad;
	d->target_due = true;
	d->nudges = 0;
	d->settling = false;
}

static bool has_reached(const struct dialogue *d, int64_t t_ns)
{
	double off_rad = fabs(d->angle_rad - d->target_rad);

	if (!d->angle_known || d->angle_ns < d->since_ns)
		return false;
	return off_rad <= REACHED_RAD || (off_rad <= NEAR_RAD && t_ns - d->still_ns >= STILL_NS);
}

static void next_step(struct dialogue *d)
{
	double sign = d->to_rad >= d->from_rad ? 1.0 : -1.0;
	double end = d->towards_to ? d->to_rad : d->from_rad;
	double step = d->towards_to ? sign * d->step_rad : -sign * d->step_rad;

	if (fabs(end - d->target_rad) < 1e-9) {
		d->towards_to = !d->towards_to;
		next_step(d);
		return;
	}
	go(d, fabs(end - d->target_rad) <= d->step_rad ? end : d->target_rad + step);
}

static void next_target(struct dialogue *d, int64_t t_ns)
{
	if (d->from_rad == d->to_rad)
		return; /* a sweep of no width: it stands */
	if (d->profile != SWEEP_STEP) {
		d->towards_to = d->target_rad != d->to_rad;
		go(d, d->towards_to ? d->to_rad : d->from_rad);
		return;
	}
	if (!d->settling) {
		d->settling = true;
		d->settled_ns = t_ns + d->settle_ns;
	}
	if (t_ns >= d->settled_ns)
		next_step(d);
}

static void nudge(struct dialogue *d, int64_t t_ns)
{
	if (t_ns - d->still_ns < STUCK_NS || t_ns - d->since_ns < STUCK_NS || !d->angle_known)
		return;
	if (++d->nudges > NUDGES_MAX) {
		fail(d, "stands still and does not go where it is told",
		     "is it enabled? see `write`, `target`, `speed`");
		return;
	}
	d->since_ns = t_ns;
	d->target_due = true;
}

static void follow_sinus(struct dialogue *d)
{
	double half = 0.5 * fabs(d->to_rad - d->from_rad), off = d->angle_rad - 0.5 * (d->from_rad + d->to_rad);
	double square = half * half - off * off, speed;

	if (!d->angle_known || half == 0.0)
		return;
	speed = square > 0.0 ? d->peak_rad_s * sqrt(square) / half : 0.0;
	if (speed < SINUS_FLOOR * d->peak_rad_s)
		speed = SINUS_FLOOR * d->peak_rad_s;
	if (fabs(speed - d->speed_rad_s) <= SINUS_CHANGE * d->speed_rad_s)
		return;
	d->speed_rad_s = speed;
	d->speed_due = true;
}

/* A program that was itself stopped for seconds has not listened: that is no silence of the servo's. */
static bool is_silent(struct dialogue *d, int64_t t_ns)
{
	int64_t gap_ns = t_ns - d->looked_ns;

	d->silent_ns += gap_ns < IDLE_NS ? gap_ns : IDLE_NS;
	d->looked_ns = t_ns;
	return d->silent_ns > SILENCE_NS;
}

/* Decides, from the angles seen so far, what is to be written next. */
static void look(struct dialogue *d, int64_t t_ns)
{
	if (d->phase == WRITING && d->next_write == d->device.write.n)
		d->phase = RUNNING;
	if (d->phase != RUNNING && d->phase != STOPPING)
		return;
	if (is_silent(d, t_ns)) {
		fail(d, "gave no angle for 3 s", "check `unit` and `position`");
		return;
	}
	if (!d->sweeps || d->target_due || d->waiting != WISH_NONE)
		return;
	if (d->phase == STOPPING) {
		if (!d->has_rest || has_reached(d, t_ns) || t_ns >= d->stop_by_ns)
			d->phase = STOPPED;
		return;
	}
	if (has_reached(d, t_ns))
		next_target(d, t_ns);
	else
		nudge(d, t_ns);
	if (d->profile == SWEEP_SINUS && d->phase == RUNNING)
		follow_sinus(d);
}

static enum wish choose(struct dialogue *d)
{
	if (d->phase == WRITING)
		return d->next_write < d->device.write.n ? WISH_INITIAL : WISH_NONE;
	if (d->speed_due) {
		d->speed_due = false;
		return WISH_SPEED;
	}
	if (d->target_due) {
		d->target_due = false;
		return WISH_TARGET;
	}
	return WISH_NONE;
}

/* Fills the wish's address and registers. */
static int value_of(const struct dialogue *d, struct modbus_transaction *t)
{
	const struct config_register *r = d->waiting == WISH_SPEED ? &d->device.speed : &d->device.target;
	int error;

	if (d->waiting == WISH_INITIAL) {
		t->address = modbus_wire_address(&d->device, d->device.write.item[d->next_write].address);
		t->n = 1;
		t->value[0] = d->device.write.item[d->next_write].value;
		t->function = 6;
		return 0;
	}
	t->address = modbus_wire_address(&d->device, r->address);
	t->n = (uint16_t)modbus_wire_registers(r);
	t->function = t->n == 1 && r->function != 16 ? 6 : 16;
	error = modbus_wire_encode(r, d->waiting == WISH_SPEED ? d->speed_rad_s : d->target_rad, t->value);
	return error;
}

static void write_wish(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	struct modbus_transaction t = {.unit = (uint8_t)d->device.slave};

	if (d->sent && t_ns - d->sent_ns >= ANSWER_NS)
		said_again(d);
	if (d->phase == FAILED || d->phase == STOPPED || d->sent)
		return;
	if (d->waiting == WISH_NONE)
		d->waiting = choose(d);
	if (d->waiting == WISH_NONE)
		return;
	if (value_of(d, &t) < 0) {
		fail(d, d->waiting == WISH_SPEED ? "cannot be told this speed" : "cannot be told this angle",
		     "its register's `type` and `scale` do not hold it");
		return;
	}
	ret->write_len = modbus_wire_put(&t, ret->write);
	d->sent = true;
	d->sent_ns = t_ns;
}

static int64_t deadline(const struct dialogue *d, int64_t t_ns)
{
	int64_t at_ns = t_ns + (d->sweeps ? LOOK_NS : IDLE_NS);

	if (d->sent && d->sent_ns + ANSWER_NS < at_ns)
		at_ns = d->sent_ns + ANSWER_NS;
	if (d->settling && d->settled_ns > t_ns && d->settled_ns < at_ns)
		at_ns = d->settled_ns;
	return at_ns;
}

void modbus_dialogue_step(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	memset(ret, 0, sizeof *ret);
	ret->deadline_ns = INT64_MAX;
	look(d, t_ns);
	write_wish(d, t_ns, ret);
	if (d->phase == FAILED || d->phase == STOPPED) {
		ret->state = DIALOGUE_FAILED;
		if (d->phase == FAILED)
			snprintf(ret->error, sizeof ret->error, "%s", d->error);
		return;
	}
	/* Nothing streams before the first answer: a servo that is away would else be lost and back at every try. */
	ret->state = d->phase == WRITING || !d->angle_known ? DIALOGUE_CONFIGURING : DIALOGUE_STREAMING;
	ret->deadline_ns = deadline(d, t_ns);
}

/* A servo that is still on its way in stops at the nearer end. */
static double within(const struct dialogue *d, double angle_rad)
{
	double low = d->from_rad < d->to_rad ? d->from_rad : d->to_rad;
	double high = d->from_rad < d->to_rad ? d->to_rad : d->from_rad;

	return angle_rad < low ? low : angle_rad > high ? high : angle_rad;
}

void modbus_dialogue_stop(struct dialogue *d, int64_t t_ns)
{
	double speed = d->peak_rad_s > 0.0 ? d->peak_rad_s : 10.0 * TRIG_DEG;
	double way_s;

	if (d->phase == FAILED || d->phase == STOPPED)
		return;
	if (!d->sweeps || !d->angle_known || d->phase == WRITING) {
		d->phase = STOPPED;
		return;
	}
	d->phase = STOPPING;
	d->speed_due = d->device.speed.set && d->speed_rad_s != d->peak_rad_s;
	d->speed_rad_s = d->peak_rad_s;
	way_s = d->has_rest ? fabs(d->angle_rad - d->rest_rad) / speed : 0.0;
	if (!(way_s < REST_MAX_S)) /* a float register may say any angle */
		way_s = REST_MAX_S;
	d->stop_by_ns = t_ns + REST_GRACE_NS + (int64_t)(way_s * 1e9);
	go(d, d->has_rest ? d->rest_rad : within(d, d->angle_rad));
}

/* Setting up, watching and sweeping a servo: pure, in the caller's time.
 *
 *   `write` ─► running: speed, then one target after the other ─► rest angle ─► `stop` ─► done
 *      ▲          │ fault                   ▲
 *      │          ▼                         │ the fault was cleared elsewhere: `write` again
 *      └──── `reset`, once ─ it stays ─► halted: angles are read, nothing is commanded
 *
 * Only one request is under way at a time, and each is answered (or said again, at most three times) before the next; the
 * angle is polled by the bus itself (modbus_bus.c). Which comes first: the watchdog, since its drive counts; then the
 * strobe of a target; a step of a sequence; speed; target; the status.
 *
 * What to command when is known to the sweeper. It is told of a target when the servo has taken it, with its strobe.
 *
 * Halted is no failure of the link: whoever set a servo up anew because of a fault would reset and enable it for ever. A
 * servo is given up (and opened anew) only when it does not answer. A request that it refuses for good halts it, too.
 * After a fault that went away by itself it is set up again at once, but not more often than every RESUME_NS. */
#include "drivers/modbus_parts.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "drivers/sweeper.h"

#define ANSWER_NS  1000000000 /* a request is answered by then, or said again */
#define TRIES_MAX  3
#define BUSY_NS    50000000     /* who is busy is asked again so much later, ... */
#define BUSY_MAX   40           /* ... so often */
#define SILENCE_NS 3000000000   /* no angle for so long: given up */
#define GAP_NS     500000000    /* a longer time without a look is no silence of the servo's */
#define STATUS_NS  100000000    /* how often the status is read */
#define CLEAR_NS   1000000000   /* a fault is gone so long after its reset, or stays */
#define RESUME_NS  30000000000  /* between two set-ups because a fault went away */
#define FORGIVE_NS 600000000000 /* who ran well for so long may be reset again */

enum phase { SEQUENCE, CLEARING, RUNNING, HALTED, STOPPING, STOPPED, FAILED };
enum wish {
	WISH_NONE,
	WISH_ABANDONED, /* its answer is still awaited, but matters no more */
	WISH_WATCHDOG,
	WISH_STROBE_ON,
	WISH_STROBE_OFF,
	WISH_WRITE,
	WISH_READ,
	WISH_SPEED,
	WISH_TARGET,
	WISH_STATUS
};

struct dialogue {
	struct config_device device;
	struct sweeper sweeper;
	enum phase phase;
	struct modbus_sequence sequence;
	bool streams;
	char error[160]; /* FAILED: why; else what halted it, without the sweeper's reasons */

	enum wish waiting; /* the request under way */
	uint8_t function;
	uint16_t address;
	double quantity; /* the speed or target in it */
	bool sent;
	int tries, busy;
	int64_t sent_ns, again_ns; /* not before again_ns */

	enum wish strobe; /* WISH_NONE, or what of it is due */
	int64_t watchdog_ns, status_ns;
	bool watchdog_flip, watchdog_refused, status_refused;

	bool faulty, reset_used;
	int64_t clear_by_ns, resume_ns, begun_ns;

	bool angle_known;
	int64_t silent_ns, looked_ns; /* without an angle for so long, as far as it was looked at */
};

struct dialogue *modbus_dialogue_create(const struct config *config, int device)
{
	struct dialogue *d = calloc(1, sizeof *d);

	if (!d)
		return NULL;
	d->device = config->device[device];
	sweeper_init(&d->sweeper, config, device, false, d->device.speed.set);
	modbus_sequence_begin(&d->sequence, &d->device.write);
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
static void check_sweep(struct dialogue *d, const struct sweeper *s)
{
	if (!d->device.target.set)
		fail(d, "cannot be told where to go", "give it a `target` register or take it out of `sweep`");
	else if (s->profile == SWEEP_SINUS && !d->device.speed.set)
		fail(d, "cannot follow a sinus without a `speed` register", "give it one or use `profile: triangle`");
	else if (s->profile == SWEEP_STEP && !(s->step_rad > 0.0))
		fail(d, "is to step by nothing", "give `sweep.step`");
}

static void begin_sequence(struct dialogue *d, const struct config_writes *list)
{
	d->phase = SEQUENCE;
	modbus_sequence_begin(&d->sequence, list);
}

void modbus_dialogue_reset(struct dialogue *d, int64_t t_ns)
{
	d->waiting = d->strobe = WISH_NONE;
	d->sent = d->streams = d->angle_known = false;
	d->tries = d->busy = 0;
	d->again_ns = t_ns;
	d->error[0] = '\0';
	d->watchdog_ns = d->status_ns = t_ns;
	d->watchdog_flip = d->watchdog_refused = d->status_refused = false;
	d->faulty = d->reset_used = false;
	d->resume_ns = INT64_MAX;
	d->begun_ns = t_ns - RESUME_NS;
	d->silent_ns = 0;
	d->looked_ns = t_ns;
	sweeper_halt(&d->sweeper, ""); /* of the time before the link was opened */
	begin_sequence(d, &d->device.write);
	if (sweeper_sweeps(&d->sweeper))
		check_sweep(d, &d->sweeper);
}

/* ---- halts and faults ---- */

static void abandon(struct dialogue *d)
{
	d->strobe = WISH_NONE;
	d->waiting = d->sent ? WISH_ABANDONED : WISH_NONE;
}

/* Nothing is commanded any more. An end that was under way is over. */
static void halt(struct dialogue *d, const char *what, const char *todo)
{
	bool ends = d->phase == STOPPING || (d->phase == SEQUENCE && d->sequence.list == &d->device.stop);

	abandon(d);
	snprintf(d->error, sizeof d->error, "%s %s; %s", d->device.name, what, todo);
	sweeper_halt(&d->sweeper, what);
	d->phase = ends ? STOPPED : HALTED;
}

static bool sweeper_is_halted(struct dialogue *d, int64_t t_ns)
{
	struct sweeper_wish wish;

	sweeper_look(&d->sweeper, t_ns, &wish);
	return wish.state == SWEEPER_HALTED && wish.why[0];
}

/* A fault after the sweep was halted for another reason, or while something is written already, is not reset. */
static void fault(struct dialogue *d, uint16_t status, int64_t t_ns)
{
	bool sets_up = d->phase == SEQUENCE && d->sequence.list == &d->device.write;

	if (d->phase == RUNNING && t_ns - d->begun_ns >= FORGIVE_NS)
		d->reset_used = false;
	bool resets = d->device.reset.n > 0 && !d->reset_used &&
	              ((d->phase == RUNNING && !sweeper_is_halted(d, t_ns)) || sets_up);
	char what[80];

	snprintf(what, sizeof what, "has a fault%s: register %d is 0x%04x", d->reset_used ? " again" : "",
	         d->device.status.address, status);
	d->resume_ns = INT64_MAX;
	if (d->phase == CLEARING || (d->phase == SEQUENCE && !sets_up))
		return; /* being reset, or on its way to the end */
	halt(d, what, resets ? "it is reset, once" : "the sweep stopped until it is cleared");
	if (resets) {
		d->reset_used = true;
		begin_sequence(d, &d->device.reset);
	}
}

static void take_status(struct dialogue *d, uint16_t status, int64_t t_ns)
{
	bool was = d->faulty;
	int64_t earliest_ns = d->begun_ns + RESUME_NS;

	d->faulty = status & d->device.status.fault;
	if (d->faulty && !was)
		fault(d, status, t_ns);
	if (d->phase == CLEARING && !d->faulty)
		begin_sequence(d, &d->device.write);
	else if (d->phase == HALTED && was && !d->faulty)
		d->resume_ns = t_ns > earliest_ns ? t_ns : earliest_ns;
}

static void sequence_failed(struct dialogue *d)
{
	const struct modbus_sequence *s = &d->sequence;
	const struct config_write *at = &s->list->item[s->at];
	const char *name = s->list == &d->device.write ? "write" : s->list == &d->device.reset ? "reset" : "stop";
	char what[90];

	snprintf(what, sizeof what, "is not ready: register %d is 0x%04x after step %d of `%s`", at->until.address,
	         s->seen, s->at + 1, name);
	halt(d, what, "check the drive and `until`");
}

static void sequence_done(struct dialogue *d, int64_t t_ns)
{
	if (d->sequence.list == &d->device.stop) {
		d->phase = STOPPED;
	} else if (d->sequence.list == &d->device.reset) {
		d->phase = CLEARING;
		d->clear_by_ns = t_ns + CLEAR_NS;
		d->status_ns = t_ns;
		d->faulty = true; /* until a status says otherwise that was read from now on */
	} else {
		d->phase = RUNNING;
		d->begun_ns = t_ns;
		d->error[0] = '\0';
		sweeper_begin(&d->sweeper, t_ns);
	}
}

/* ---- answers ---- */

static void answered(struct dialogue *d)
{
	d->waiting = WISH_NONE;
	d->sent = false;
	d->tries = d->busy = 0;
}

static void written(struct dialogue *d, int64_t t_ns)
{
	const enum wish done = d->waiting;

	answered(d);
	switch (done) {
	case WISH_WATCHDOG:
		d->watchdog_flip = !d->watchdog_flip;
		break;
	case WISH_WRITE:
		modbus_sequence_written(&d->sequence, t_ns);
		break;
	case WISH_SPEED:
		sweeper_speed_taken(&d->sweeper, d->quantity, t_ns);
		break;
	case WISH_TARGET:
		d->strobe = d->device.strobe.set ? WISH_STROBE_ON : WISH_NONE;
		if (!d->device.strobe.set)
			sweeper_target_taken(&d->sweeper, d->quantity, t_ns);
		break;
	case WISH_STROBE_ON:
		d->strobe = WISH_STROBE_OFF;
		break;
	case WISH_STROBE_OFF:
		d->strobe = WISH_NONE;
		sweeper_target_taken(&d->sweeper, d->quantity, t_ns);
		break;
	default:
		break;
	}
}

static void was_read(struct dialogue *d, uint16_t value, int64_t t_ns)
{
	const enum wish done = d->waiting;

	answered(d);
	if (done == WISH_STATUS)
		take_status(d, value, t_ns);
	else if (done == WISH_READ)
		modbus_sequence_read(&d->sequence, value, t_ns);
}

static void said_again(struct dialogue *d)
{
	d->sent = false;
	if (d->waiting == WISH_ABANDONED)
		answered(d);
	else if (++d->tries >= TRIES_MAX)
		fail(d,
		     d->waiting == WISH_READ || d->waiting == WISH_STATUS ? "does not answer"
		                                                          : "does not answer a write",
		     "check `unit`, its registers, and the line");
}

static void busy(struct dialogue *d, int64_t t_ns)
{
	d->sent = false;
	d->again_ns = t_ns + BUSY_NS;
	if (d->waiting == WISH_ABANDONED)
		answered(d);
	else if (++d->busy >= BUSY_MAX)
		fail(d, "says that it is busy, again and again", "is another master on its line?");
}

/* What it refuses for good is not asked for again. */
static void refused_wish(struct dialogue *d, const char *text)
{
	const enum wish wish = d->waiting;

	answered(d);
	d->watchdog_refused |= wish == WISH_WATCHDOG;
	d->status_refused |= wish == WISH_STATUS;
	if (wish != WISH_ABANDONED)
		halt(d, text, "check its registers and `address_base`");
}

static void refused(struct dialogue *d, const uint8_t *payload, int64_t t_ns)
{
	uint16_t what[3]; /* function, address, code */
	char text[80];

	memcpy(what, payload, sizeof what);
	const bool wished = d->sent && what[0] == d->function && what[1] == d->address;

	if (what[2] == 0 || what[2] == 5 || what[2] == 6) { /* no answer, will do it, busy */
		if (wished && what[2] == 0)
			said_again(d);
		else if (wished)
			busy(d, t_ns);
		return;
	}
	snprintf(text, sizeof text, "refuses function %d at address %d with exception %d", what[0], what[1], what[2]);
	if (wished)
		refused_wish(d, text);
	else if (what[2] == 10 || what[2] == 11)
		fail(d, "is not reached by its gateway", "check its power, its line and `unit`");
	else if (what[0] == 3 || what[0] == 4)
		fail(d, text, "check `position` and `address_base`");
}

void modbus_dialogue_reply(struct dialogue *d, const struct reply *reply)
{
	double angle_rad;
	uint16_t what[3];

	if (d->phase == FAILED || d->phase == STOPPED)
		return;
	if (reply->kind == MODBUS_ANGLE && reply->len == sizeof angle_rad) {
		memcpy(&angle_rad, reply->payload, sizeof angle_rad);
		d->angle_known = true;
		d->silent_ns = 0;
		sweeper_angle(&d->sweeper, angle_rad, reply->t_ns);
	} else if (reply->kind == MODBUS_WRITTEN && reply->len == sizeof *what) {
		memcpy(what, reply->payload, sizeof *what);
		if (d->sent && (d->function == 6 || d->function == 16) && what[0] == d->address)
			written(d, reply->t_ns);
	} else if (reply->kind == MODBUS_READ && reply->len == sizeof what) {
		memcpy(what, reply->payload, sizeof what);
		if (d->sent && what[0] == d->function && what[1] == d->address)
			was_read(d, what[2], reply->t_ns);
	} else if (reply->kind == MODBUS_REFUSED && reply->len == sizeof what) {
		refused(d, reply->payload, reply->t_ns);
	}
}

void modbus_dialogue_data(struct dialogue *d, int64_t t_ns)
{
	(void)t_ns;
	d->silent_ns = 0;
}

/* ---- requests ---- */

static bool watchdog_due(const struct dialogue *d, int64_t t_ns)
{
	return d->device.watchdog.set && !d->watchdog_refused && t_ns >= d->watchdog_ns;
}

static bool status_due(const struct dialogue *d, int64_t t_ns)
{
	return d->device.status.set && !d->status_refused && t_ns >= d->status_ns;
}

static enum wish choose(struct dialogue *d, const struct sweeper_wish *wish, int64_t t_ns)
{
	if (watchdog_due(d, t_ns))
		return WISH_WATCHDOG;
	if (d->strobe != WISH_NONE)
		return d->strobe;
	if (d->phase == SEQUENCE && d->sequence.state == MODBUS_SEQUENCE_WRITE)
		return WISH_WRITE;
	if (d->phase == SEQUENCE && d->sequence.state == MODBUS_SEQUENCE_READ)
		return WISH_READ;
	if ((d->phase == RUNNING || d->phase == STOPPING) && (wish->speed || wish->target))
		return wish->speed ? WISH_SPEED : WISH_TARGET;
	return status_due(d, t_ns) ? WISH_STATUS : WISH_NONE;
}

static void one_register(struct modbus_transaction *t, uint8_t function, uint16_t address, uint16_t value)
{
	t->function = function;
	t->address = address;
	t->n = 1;
	t->value[0] = value;
}

/* A speed or a target. -ERANGE: its register cannot hold it. */
static int quantity_of(struct dialogue *d, const struct sweeper_wish *wish, struct modbus_transaction *t)
{
	const struct config_register *r = d->waiting == WISH_SPEED ? &d->device.speed : &d->device.target;

	d->quantity = d->waiting == WISH_SPEED ? wish->speed_rad_s : wish->target_rad;
	t->address = r->address;
	t->n = (uint16_t)modbus_wire_registers(r);
	t->function = t->n == 1 && r->function != 16 ? 6 : 16;
	return modbus_wire_encode(r, d->quantity, t->value);
}

/* Fills the request; addresses are the configuration's. */
static int request_of(struct dialogue *d, const struct sweeper_wish *wish, struct modbus_transaction *t)
{
	const struct config_device *c = &d->device;
	const struct config_write *at = d->sequence.list->item + d->sequence.at;

	switch (d->waiting) {
	case WISH_WATCHDOG:
		one_register(t, 6, c->watchdog.address,
		             c->watchdog.value ^ (d->watchdog_flip ? c->watchdog.toggle : 0));
		return 0;
	case WISH_STROBE_ON:
		one_register(t, 6, c->strobe.address, c->strobe.on);
		return 0;
	case WISH_STROBE_OFF:
		one_register(t, 6, c->strobe.address, c->strobe.off);
		return 0;
	case WISH_WRITE:
		one_register(t, 6, at->address, at->value);
		return 0;
	case WISH_READ:
		one_register(t, 3, at->until.address, 0);
		return 0;
	case WISH_STATUS:
		one_register(t, c->status.function, c->status.address, 0);
		return 0;
	default:
		return quantity_of(d, wish, t);
	}
}

static void note_sent(struct dialogue *d, const struct modbus_transaction *t, int64_t t_ns)
{
	if (d->waiting == WISH_WATCHDOG)
		d->watchdog_ns = t_ns + d->device.watchdog.period_ns;
	if (d->waiting == WISH_STATUS)
		d->status_ns = t_ns + STATUS_NS;
	d->function = t->function;
	d->address = t->address;
	d->sent = true;
	d->sent_ns = t_ns;
}

static void request(struct dialogue *d, const struct sweeper_wish *wish, int64_t t_ns, struct dialogue_step *ret)
{
	struct modbus_transaction t = {.unit = (uint8_t)d->device.slave};

	if (d->sent && t_ns - d->sent_ns >= ANSWER_NS)
		said_again(d);
	if (d->phase == FAILED || d->phase == STOPPED || d->sent || t_ns < d->again_ns)
		return;
	if (d->waiting == WISH_NONE)
		d->waiting = choose(d, wish, t_ns);
	if (d->waiting == WISH_NONE)
		return;
	if (request_of(d, wish, &t) < 0) {
		halt(d, d->waiting == WISH_SPEED ? "cannot be told this speed" : "cannot be told this angle",
		     "its register's `type` and `scale` do not hold it");
		return;
	}
	t.address = modbus_wire_address(&d->device, t.address);
	ret->write_len = modbus_wire_put(&t, ret->write);
	note_sent(d, &t, t_ns);
}

/* ---- time ---- */

/* A program that was itself stopped for seconds has not listened: that is no silence of the servo's. */
static bool is_silent(struct dialogue *d, int64_t t_ns)
{
	int64_t gap_ns = t_ns - d->looked_ns;

	d->silent_ns += gap_ns < GAP_NS ? gap_ns : GAP_NS;
	d->looked_ns = t_ns;
	return d->silent_ns > SILENCE_NS;
}

/* What has come about by now. */
static void look(struct dialogue *d, int64_t t_ns, struct sweeper_wish *wish)
{
	if (d->phase == SEQUENCE) {
		const enum modbus_sequence_state state = modbus_sequence_look(&d->sequence, t_ns);

		if (state == MODBUS_SEQUENCE_DONE)
			sequence_done(d, t_ns);
		else if (state == MODBUS_SEQUENCE_FAILED)
			sequence_failed(d);
	} else if (d->phase == CLEARING && t_ns >= d->clear_by_ns) {
		halt(d, "has a fault that its reset did not clear", "the sweep stopped until it is cleared");
	} else if (d->phase == HALTED && t_ns >= d->resume_ns) {
		d->resume_ns = INT64_MAX;
		begin_sequence(d, &d->device.write);
	}
	sweeper_look(&d->sweeper, t_ns, wish);
	if (d->phase == STOPPING && wish->state != SWEEPER_RUNS && d->strobe == WISH_NONE)
		begin_sequence(d, &d->device.stop);
	if (d->phase != FAILED && d->phase != STOPPED && is_silent(d, t_ns))
		fail(d, "gave no angle for 3 s", "check `unit` and `position`");
}

static int64_t earlier(int64_t a, int64_t b)
{
	return a < b ? a : b;
}

static int64_t deadline(const struct dialogue *d, const struct sweeper_wish *wish)
{
	int64_t at_ns = wish->deadline_ns;

	if (d->sent)
		return earlier(at_ns, d->sent_ns + ANSWER_NS);
	if (d->waiting != WISH_NONE) /* busy */
		return earlier(at_ns, d->again_ns);
	if (d->phase == SEQUENCE && d->sequence.state == MODBUS_SEQUENCE_WAIT)
		at_ns = earlier(at_ns, d->sequence.due_ns);
	if (d->device.watchdog.set && !d->watchdog_refused)
		at_ns = earlier(at_ns, d->watchdog_ns);
	if (d->device.status.set && !d->status_refused)
		at_ns = earlier(at_ns, d->status_ns);
	if (d->phase == CLEARING)
		at_ns = earlier(at_ns, d->clear_by_ns);
	return at_ns;
}

void modbus_dialogue_step(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	struct sweeper_wish wish;

	memset(ret, 0, sizeof *ret);
	ret->deadline_ns = INT64_MAX;
	look(d, t_ns, &wish);
	request(d, &wish, t_ns, ret);
	if (d->phase == FAILED || d->phase == STOPPED) {
		ret->state = DIALOGUE_FAILED;
		if (d->phase == FAILED)
			snprintf(ret->error, sizeof ret->error, "%s", d->error);
		return;
	}
	/* Nothing streams before the first answer: a servo that is away would else be lost and back at every try. */
	d->streams |= d->phase != SEQUENCE && d->angle_known;
	ret->state = d->streams ? DIALOGUE_STREAMING : DIALOGUE_CONFIGURING;
	ret->deadline_ns = deadline(d, &wish);
	if (d->streams && d->error[0])
		snprintf(ret->error, sizeof ret->error, "%s", d->error);
	else if (d->streams && wish.state == SWEEPER_HALTED)
		snprintf(ret->error, sizeof ret->error, "the sweep stopped: %s %s", d->device.name, wish.why);
}

void modbus_dialogue_stop(struct dialogue *d, int64_t t_ns)
{
	const bool ends = d->phase == STOPPING || (d->phase == SEQUENCE && d->sequence.list == &d->device.stop);

	if (d->phase == FAILED || d->phase == STOPPED || ends)
		return;
	sweeper_stop(&d->sweeper, t_ns);
	if (d->phase == RUNNING) {
		d->phase = STOPPING;
		return;
	}
	abandon(d);
	begin_sequence(d, &d->device.stop);
}

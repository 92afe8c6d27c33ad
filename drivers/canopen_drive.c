/* The state machine of a CiA 402 drive, seen from its master (protocols C.4).
 *
 *              0006                0007              000F
 *   disabled ───────► ready ───────────► switched ─────────► enabled ──0002──► quick stop ──0000──► disabled
 *      ▲    0000 from everywhere            ▲───── 0007 ───────┘
 *      └── 0080 after 0000 ── fault ◄── fault reaction ◄── any
 *
 * A command is decided by the state that the drive shows, never by what was sent last, and is repeated while it shows no
 * effect: a frame that got lost costs a tenth of a second. What is repeated is the same frame, so bit 7 (fault reset) has
 * one rising edge however often it is sent.
 *
 * A drive that is found enabled is made to stand before anything of it is changed. 607A is what 6064 says until it runs,
 * or a drive in mode cyclic would jump. Mode position: target and bit 4 go in two frames, because many drives apply the
 * objects of a PDO in their order, and 6040 comes first; both are repeated while it does not acknowledge. Bit 5 (at once)
 * is set only while it is still on its way.
 *
 * A fault is reset once. It may be reset again when it was gone for ten minutes of running, or the drive was switched off
 * and on, or somebody else has reset it: a drive that trips at every sweep is reported, not driven on. Faults of the
 * communication (81xx) are of our own making (facetd was away), so these may be reset at once again, five times in a row
 * at most; likewise a drive that has no fault then but stops. Whoever was switched off by something else (an enable input,
 * another master) is switched on again three times. */
#include "drivers/canopen_drive.h"

#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#define CONTROL_SHUTDOWN   0x0006
#define CONTROL_SWITCH_ON  0x0007
#define CONTROL_ENABLE     0x000f
#define CONTROL_QUICK_STOP 0x0002
#define CONTROL_VOLTAGE    0x0000
#define CONTROL_RESET      0x0080
#define CONTROL_BEGIN      0x0010 /* bit 4: new set-point, or homing */
#define CONTROL_AT_ONCE    0x0020
#define CONTROL_HALT       0x0100

#define STATUS_VOLTAGE   0x0010
#define STATUS_REMOTE    0x0200
#define STATUS_REACHED   0x0400
#define STATUS_LIMIT     0x0800
#define STATUS_ACK       0x1000
#define STATUS_FOLLOWING 0x2000
#define STATUS_HOMING    0x3400

#define MODE_HOMING 6

#define EDGE_NS       INT64_C(20000000)   /* a level that is to be seen stands so long */
#define LOOK_NS       INT64_C(20000000)   /* between two looks at 6061 */
#define HOMING_NS     INT64_C(50000000)   /* bits of a homing before count for nothing */
#define REACTION_NS   INT64_C(5000000000) /* a fault reaction is over by then */
#define SELF_TEST_NS  INT64_C(10000000000)
#define LIMIT_NS      INT64_C(500000000) /* internal limit for so long: it will not get there */
#define QUICK_STOP_NS INT64_C(300000000)
#define LOSSES_MAX    3

/* What is read and written before it runs, in this order. */
enum { ALWAYS = 1, POSITION = 2, VELOCITY = 4, CYCLIC = 8, HOMING = 16, READ = 32, NEEDED = 64 };
static const struct object {
	uint16_t index;
	uint8_t sub, size, when;
} object[] = {
    {0x6502, 0, 4, ALWAYS | READ},   {0x607d, 1, 4, ALWAYS | READ}, {0x607d, 2, 4, ALWAYS | READ},
    {0x6083, 0, 4, POSITION},        {0x6083, 0, 4, VELOCITY},      {0x6084, 0, 4, POSITION},
    {0x6084, 0, 4, VELOCITY},        {0x60c2, 1, 1, CYCLIC},        {0x60c2, 2, 1, CYCLIC},
    {0x6098, 0, 1, HOMING | NEEDED}, {0x6099, 1, 4, HOMING},        {0x6099, 2, 4, HOMING},
    {0x607c, 0, 4, HOMING | NEEDED},
};
#define OBJECTS ((int)(sizeof object / sizeof object[0]))

void canopen_drive_init(struct canopen_drive *d, const struct canopen_drive_setup *setup)
{
	memset(d, 0, sizeof *d);
	d->setup = *setup;
	d->state = CANOPEN_DRIVE_UNKNOWN;
	d->shown = INT_MIN;
}

/* 607A of a drive that is to stay where it is; 60FF of one that is to stand. */
static int32_t still(const struct canopen_drive *d)
{
	return d->setup.mode == CANOPEN_VELOCITY ? 0 : d->position;
}

static void enter(struct canopen_drive *d, enum canopen_drive_phase phase, int64_t t_ns)
{
	d->phase = phase;
	d->begun_ns = d->due_ns = d->step_ns = t_ns;
	d->step_state = d->state;
	d->at = 0;
	d->handshake = SET_POINT_NONE;
	d->goes = d->moves = d->speed_due = d->bit_seen = false;
}

__attribute__((format(printf, 4, 5))) static void stand(struct canopen_drive *d, int64_t t_ns, int reason,
                                                        const char *format, ...)
{
	va_list args;

	va_start(args, format);
	vsnprintf(d->why, sizeof d->why, format, args);
	va_end(args);
	d->reason = reason;
	d->was_fault = d->state == CANOPEN_FAULT || d->state == CANOPEN_FAULT_REACTION;
	d->cured = false;
	d->control = d->state == CANOPEN_ENABLED ? CONTROL_ENABLE | CONTROL_HALT : CONTROL_VOLTAGE;
	d->demand = still(d);
	d->send = true;
	enter(d, CANOPEN_DRIVE_STANDING, t_ns);
}

void canopen_drive_begin(struct canopen_drive *d, int64_t t_ns)
{
	d->why[0] = d->note[0] = 0;
	d->status_known = d->position_known = d->limited = false;
	d->shown = INT_MIN;
	d->send = false;
	enter(d, CANOPEN_DRIVE_WAITING, t_ns);
}

void canopen_drive_booted(struct canopen_drive *d)
{
	d->homed = d->spent = d->silent = false;
	d->unheard = d->losses = 0;
	d->code = 0;
}

/* Sends it again when it shows no effect; a new command at once. */
static void command(struct canopen_drive *d, uint16_t control, int64_t t_ns)
{
	if (control == d->control && t_ns < d->due_ns)
		return;
	d->control = control;
	d->due_ns = t_ns + CANOPEN_DRIVE_REPEAT_NS;
	d->send = true;
}

static bool has_fault(const struct canopen_drive *d)
{
	return d->status_known && (d->state == CANOPEN_FAULT || d->state == CANOPEN_FAULT_REACTION);
}

void canopen_drive_status(struct canopen_drive *d, uint16_t statusword, int64_t t_ns)
{
	const uint16_t came = statusword & (uint16_t)~d->status;

	if (d->phase == CANOPEN_DRIVE_STANDING && d->status_known)
		d->cured |= (came & (STATUS_VOLTAGE | STATUS_REMOTE)) != 0;
	d->status = statusword;
	d->state = canopen_wire_drive_state(statusword);
	d->status_known = true;
	d->status_ns = t_ns;
}

void canopen_drive_position(struct canopen_drive *d, int32_t count)
{
	d->position = count;
	d->position_known = true;
}

static bool is_communication(uint16_t code)
{
	return code >> 8 == 0x81;
}

void canopen_drive_emergency(struct canopen_drive *d, uint16_t code)
{
	if (!code)
		return;
	d->code = code;
	d->silent |= is_communication(code);
}

/* Commands that it is asked to take */

static bool within(const struct canopen_drive *d, int32_t count)
{
	return !d->limited || (count >= d->limit[0] && count <= d->limit[1]);
}

bool canopen_drive_goto(struct canopen_drive *d, int32_t count)
{
	if (d->phase != CANOPEN_DRIVE_RUNNING || d->setup.mode != CANOPEN_POSITION)
		return true;
	if (!within(d, count))
		return false;
	d->target = count;
	d->goes = true;
	return true;
}

void canopen_drive_speed(struct canopen_drive *d, uint32_t counts_per_s)
{
	if (d->phase != CANOPEN_DRIVE_RUNNING || d->setup.mode != CANOPEN_POSITION)
		return;
	d->speed = counts_per_s;
	d->speed_due = true;
}

bool canopen_drive_follow(struct canopen_drive *d, int32_t demand)
{
	if (d->setup.mode == CANOPEN_POSITION || d->phase < CANOPEN_DRIVE_CALMING || d->phase > CANOPEN_DRIVE_ENDING)
		return true;
	d->send = true;
	if (d->phase != CANOPEN_DRIVE_RUNNING)
		return true;
	if (d->setup.mode == CANOPEN_CYCLIC && !within(d, demand))
		return false;
	d->demand = demand;
	return true;
}

void canopen_drive_halt(struct canopen_drive *d, const char *why, int64_t t_ns)
{
	if (d->phase == CANOPEN_DRIVE_RUNNING)
		stand(d, t_ns, STANDS_BY_ITSELF, "%s", why);
}

void canopen_drive_end(struct canopen_drive *d, int64_t t_ns)
{
	if (d->phase >= CANOPEN_DRIVE_ENDING)
		return;
	d->demand = still(d);
	enter(d, d->phase == CANOPEN_DRIVE_IDLE || !d->status_known ? CANOPEN_DRIVE_ENDED : CANOPEN_DRIVE_ENDING, t_ns);
}

/* The phases: each looks at what was heard, and commands, asks, or goes on to another one. */

static void ask(bool download, const struct object *o, uint32_t value, struct canopen_drive_wish *ret)
{
	ret->asks = true;
	ret->ask.download = download;
	ret->ask.index = o->index;
	ret->ask.sub = o->sub;
	ret->ask.size = o->size;
	ret->ask.value = value;
}

static void wait_for_state(struct canopen_drive *d, int64_t t_ns)
{
	const int64_t patience_ns = d->state == CANOPEN_NOT_READY ? SELF_TEST_NS : CANOPEN_DRIVE_STEP_NS;

	if (!d->status_known || d->state == CANOPEN_NOT_READY || d->state == CANOPEN_DRIVE_UNKNOWN ||
	    !d->position_known) {
		if (t_ns - d->begun_ns < patience_ns)
			return;
		if (!d->status_known || !d->position_known)
			stand(d, t_ns, STANDS_BY_STATE, "tells no %s", d->status_known ? "position" : "statusword");
		else
			stand(d, t_ns, STANDS_BY_STATE, "stays in a state that cannot be left (statusword %04X)",
			      d->status);
		return;
	}
	enter(d, CANOPEN_DRIVE_CALMING, t_ns);
}

static void calm(struct canopen_drive *d, int64_t t_ns)
{
	if (d->state != CANOPEN_ENABLED && d->state != CANOPEN_QUICK_STOP) {
		/* What is sent while it is prepared keeps it in the state it is in. */
		d->control = d->state == CANOPEN_SWITCHED_ON          ? CONTROL_SWITCH_ON
		             : d->state == CANOPEN_READY_TO_SWITCH_ON ? CONTROL_SHUTDOWN
		                                                      : CONTROL_VOLTAGE;
		enter(d, CANOPEN_DRIVE_PREPARING, t_ns);
	} else if (t_ns - d->begun_ns >= 2 * CANOPEN_DRIVE_STEP_NS) {
		/* Being enabled is what is wrong with it, and nothing to go on by. */
		stand(d, t_ns, d->state == CANOPEN_ENABLED ? STANDS_BY_ITSELF : STANDS_BY_STATE,
		      "does not leave the state %s", canopen_wire_drive_text(d->state));
	} else {
		/* One that does not care for the gentle way loses its power. */
		const bool gentle = d->state == CANOPEN_ENABLED && t_ns - d->begun_ns < CANOPEN_DRIVE_STEP_NS;

		d->demand = still(d);
		command(d, gentle ? CONTROL_SWITCH_ON : CONTROL_VOLTAGE, t_ns);
	}
}

/* Preparing */

static bool homes(const struct canopen_drive *d)
{
	return d->setup.homes && !d->homed;
}

static bool is_wanted(const struct canopen_drive *d, const struct object *o)
{
	const int mode = d->setup.mode == CANOPEN_POSITION   ? POSITION
	                 : d->setup.mode == CANOPEN_VELOCITY ? VELOCITY
	                                                     : CYCLIC;

	return (o->when & ALWAYS) || (o->when & mode) || ((o->when & HOMING) && homes(d));
}

/* 60C2 as value * 10^exponent seconds, the finest that one byte holds. */
static void interpolation(int64_t period_ns, uint8_t *ret_value, int8_t *ret_exponent)
{
	int64_t unit_ns = 100000; /* finer ones are refused by some */
	int8_t exponent = -4;

	if (period_ns % 1000000 == 0 || period_ns > 255 * unit_ns) {
		unit_ns = 1000000;
		exponent = -3;
	}
	while (period_ns > 255 * unit_ns) {
		unit_ns *= 10;
		exponent++;
	}
	*ret_value = (uint8_t)((period_ns + unit_ns / 2) / unit_ns);
	*ret_exponent = exponent;
}

static uint32_t value_of(const struct canopen_drive *d, const struct object *o)
{
	uint8_t value;
	int8_t exponent;

	switch (o->index) {
	case 0x6083:
	case 0x6084:
		return d->setup.acceleration;
	case 0x6098:
		return (uint32_t)d->setup.method;
	case 0x6099:
		return d->setup.homing_speed;
	case 0x607c:
		return (uint32_t)d->setup.home_count;
	case 0x60c2:
		interpolation(d->setup.period_ns, &value, &exponent);
		return o->sub == 1 ? value : (uint8_t)exponent;
	default:
		return 0;
	}
}

static void prepare(struct canopen_drive *d, int64_t t_ns, struct canopen_drive_wish *ret)
{
	while (d->at < OBJECTS && !is_wanted(d, &object[d->at]))
		d->at++;
	if (d->at == OBJECTS) {
		d->limited &= d->limit[0] < d->limit[1];
		enter(d, CANOPEN_DRIVE_SWITCHING, t_ns);
		return;
	}
	ask(!(object[d->at].when & READ), &object[d->at], value_of(d, &object[d->at]), ret);
}

static const char *mode_text(int mode)
{
	return mode == MODE_HOMING ? "homing"
	       : mode == 1         ? "profile position"
	       : mode == 3         ? "profile velocity"
	                           : "cyclic position";
}

static int wanted_mode(const struct canopen_drive *d)
{
	return homes(d)                            ? MODE_HOMING
	       : d->setup.mode == CANOPEN_POSITION ? 1
	       : d->setup.mode == CANOPEN_VELOCITY ? 3
	                                           : 8;
}

static void learn(struct canopen_drive *d, const struct object *o, uint32_t value, int64_t t_ns)
{
	const int mode = wanted_mode(d);

	if (o->index == 0x607d) {
		d->limit[o->sub - 1] = (int32_t)value;
		d->limited = o->sub == 2;
	} else if (o->index == 0x6502 && value && !(value & 1u << (mode - 1))) {
		stand(d, t_ns, STANDS_BY_ITSELF, "has no mode %s (object 6502 is %08X); choose another `mode`",
		      mode_text(mode), value);
	}
}

static void prepared(struct canopen_drive *d, bool good, uint32_t value, int64_t t_ns)
{
	const struct object *o = &object[d->at];

	d->at++;
	if (good && (o->when & READ)) {
		learn(d, o, value, t_ns);
	} else if (!good && o->index == 0x607d) {
		d->at += o->sub == 1; /* it has none */
	} else if (!good && (o->when & NEEDED)) {
		stand(d, t_ns, STANDS_BY_ITSELF, "refuses object %04X, which homing needs (%s)", o->index,
		      canopen_wire_abort_text(value));
	} else if (!good && !(o->when & READ) && !d->note[0]) {
		snprintf(d->note, sizeof d->note, "object %04X:%02X cannot be set (%s), so its own value holds",
		         o->index, o->sub, canopen_wire_abort_text(value));
	}
}

/* Switching: 6061 is looked at first, and until it says what 6060 was told. */

static void switch_mode(struct canopen_drive *d, int64_t t_ns, struct canopen_drive_wish *ret)
{
	static const struct object display = {0x6061, 0, 1, 0}, mode = {0x6060, 0, 1, 0};

	if (d->shown == wanted_mode(d)) {
		enter(d, CANOPEN_DRIVE_ENABLING, t_ns);
	} else if (t_ns - d->begun_ns >= 2 * CANOPEN_DRIVE_STEP_NS) {
		stand(d, t_ns, STANDS_BY_ITSELF, "does not change to the mode %s (6061 is %d)",
		      mode_text(wanted_mode(d)), d->shown);
	} else if (d->at == 1) {
		ask(true, &mode, (uint32_t)wanted_mode(d), ret);
	} else if (t_ns >= d->due_ns) {
		ask(false, &display, 0, ret);
	}
}

static void switched(struct canopen_drive *d, bool good, uint32_t value, int64_t t_ns)
{
	if (d->at == 1 && !good) {
		stand(d, t_ns, STANDS_BY_ITSELF, "refuses the mode %s (%s)", mode_text(wanted_mode(d)),
		      canopen_wire_abort_text(value));
		return;
	}
	if (d->at != 1) {
		/* A drive without 6061 is believed. */
		d->shown = good ? (int8_t)value : d->at == 2 ? wanted_mode(d) : INT_MIN;
		d->due_ns = d->at == 2 ? t_ns + LOOK_NS : t_ns;
	}
	d->at = d->at == 0 ? 1 : 2;
}

/* Enabling */

static void enable(struct canopen_drive *d, int64_t t_ns)
{
	const int64_t patience_ns = d->state == CANOPEN_SWITCHED_ON ? CANOPEN_DRIVE_ENABLE_NS : CANOPEN_DRIVE_STEP_NS;

	if (d->state == CANOPEN_ENABLED) {
		const bool home = d->shown == MODE_HOMING && homes(d);

		d->demand = still(d);
		d->control = CONTROL_ENABLE;
		d->send = true;
		d->silent = false;
		enter(d, home ? CANOPEN_DRIVE_HOMING : CANOPEN_DRIVE_RUNNING, t_ns);
		d->ran_since_ns = t_ns;
		return;
	}
	if (d->state != d->step_state) {
		d->step_state = d->state;
		d->step_ns = t_ns;
	} else if (t_ns - d->step_ns >= patience_ns) {
		stand(d, t_ns, STANDS_BY_STATE, "stays in the state %s%s", canopen_wire_drive_text(d->state),
		      !(d->status & STATUS_REMOTE)    ? ": it is not controlled by CAN (statusword bit 9)"
		      : !(d->status & STATUS_VOLTAGE) ? ": its power stage has no voltage (statusword bit 4)"
		                                      : ": is its enable input set?");
		return;
	}
	d->demand = still(d);
	command(d,
	        d->state == CANOPEN_SWITCH_ON_DISABLED   ? CONTROL_SHUTDOWN
	        : d->state == CANOPEN_READY_TO_SWITCH_ON ? CONTROL_SWITCH_ON
	        : d->state == CANOPEN_SWITCHED_ON        ? CONTROL_ENABLE
	                                                 : CONTROL_VOLTAGE,
	        t_ns);
}

/* It is enabled no longer, and has no fault: the way up once more, a few times. */
static void lose(struct canopen_drive *d, int64_t t_ns)
{
	if (d->silent ? d->unheard >= CANOPEN_DRIVE_UNHEARD : d->losses >= LOSSES_MAX) {
		stand(d, t_ns, STANDS_BY_STATE, "%s again and again (it is in the state %s)",
		      d->silent ? "misses facetd's heartbeat" : "is disabled by something else",
		      canopen_wire_drive_text(d->state));
		return;
	}
	if (d->silent)
		d->unheard++;
	else
		d->losses++;
	enter(d, CANOPEN_DRIVE_WAITING, t_ns);
}

/* Homing */

static void homing_over(struct canopen_drive *d, int64_t t_ns)
{
	const int64_t off = (int64_t)d->position - d->setup.home_count,
	              other = (int64_t)d->position + d->setup.home_count;

	/* The standard can be read in two ways; a drive that took the other one would be wrong by twice the offset. */
	if (d->setup.home_count && (other < 0 ? -other : other) < (off < 0 ? -off : off)) {
		stand(d, t_ns, STANDS_BY_ITSELF,
		      "counts its home offset the other way (%d instead of %d); change the sign of `homing.offset`",
		      d->position, d->setup.home_count);
		return;
	}
	d->homed = true;
	d->control = CONTROL_ENABLE;
	d->demand = still(d);
	d->send = true;
	enter(d, CANOPEN_DRIVE_SWITCHING, t_ns);
}

static void home(struct canopen_drive *d, int64_t t_ns)
{
	const uint16_t bits = d->status & STATUS_HOMING;
	const bool counts = d->at == 1 && d->status_ns - d->step_ns >= HOMING_NS;

	if (d->state != CANOPEN_ENABLED) {
		lose(d, t_ns);
	} else if (d->at == 0) {
		command(d, CONTROL_ENABLE, t_ns);
		if (t_ns - d->begun_ns < EDGE_NS)
			return;
		d->at = 1;
		d->step_ns = t_ns;
		command(d, CONTROL_ENABLE | CONTROL_BEGIN, t_ns);
	} else if (counts && bits == (STATUS_ACK | STATUS_REACHED)) {
		homing_over(d, t_ns);
	} else if (counts && (bits & STATUS_FOLLOWING)) {
		stand(d, t_ns, STANDS_BY_ITSELF, "could not be homed by method %d (statusword %04X)", d->setup.method,
		      d->status);
	} else if (t_ns - d->begun_ns >= d->setup.homing_ns) {
		stand(d, t_ns, STANDS_BY_ITSELF, "was not home within %lld s; is `homing.method` right?",
		      (long long)(d->setup.homing_ns / 1000000000));
	} else {
		command(d, CONTROL_ENABLE | CONTROL_BEGIN, t_ns);
	}
}

/* Running */

static void put(struct canopen_drive_wish *ret, uint16_t control, int32_t demand)
{
	if (ret->frames == CANOPEN_DRIVE_FRAMES)
		return;
	ret->frame[ret->frames].control = control;
	ret->frame[ret->frames++].demand = demand;
}

/* The target first, then the edge. */
static void put_set_point(struct canopen_drive *d, int64_t t_ns, struct canopen_drive_wish *ret)
{
	put(ret, CONTROL_ENABLE, d->demand);
	put(ret, d->control, d->demand);
	d->send = false;
	d->due_ns = t_ns + CANOPEN_DRIVE_REPEAT_NS;
}

static void shake(struct canopen_drive *d, int64_t t_ns, int hand)
{
	d->handshake = hand;
	d->step_ns = d->looked_ns = t_ns;
	d->waited_ns = 0;
}

/* A program that stood still itself has not listened meanwhile, and says again what it wants before it judges. */
static bool is_unanswered(struct canopen_drive *d, int64_t t_ns)
{
	const int64_t gap_ns = t_ns - d->looked_ns;

	d->waited_ns += gap_ns < CANOPEN_DRIVE_REPEAT_NS ? gap_ns : CANOPEN_DRIVE_REPEAT_NS;
	d->looked_ns = t_ns;
	return d->waited_ns >= CANOPEN_DRIVE_STEP_NS;
}

static void raise_set_point(struct canopen_drive *d, int64_t t_ns, struct canopen_drive_wish *ret)
{
	d->raised = d->demand = d->target;
	d->goes = false;
	d->moves = true;
	d->control = CONTROL_ENABLE | CONTROL_BEGIN | (d->status & STATUS_REACHED ? 0 : CONTROL_AT_ONCE);
	shake(d, t_ns, SET_POINT_RAISED);
	put_set_point(d, t_ns, ret);
}

static void shake_hands(struct canopen_drive *d, int64_t t_ns, struct canopen_drive_wish *ret)
{
	const bool ack = d->status & STATUS_ACK;

	switch (d->handshake) {
	case SET_POINT_NONE:
		if (!d->goes || d->speed_due)
			break;
		if (ack) { /* nobody's, or what homing made of this bit: it has to go first */
			shake(d, t_ns, SET_POINT_LOWERED);
			command(d, CONTROL_ENABLE, t_ns);
		} else {
			raise_set_point(d, t_ns, ret);
		}
		break;
	case SET_POINT_RAISED:
		if (ack) {
			d->taken++;
			d->taken_count = d->raised;
			shake(d, t_ns, SET_POINT_LOWERED);
			command(d, CONTROL_ENABLE, t_ns);
		} else if (t_ns >= d->due_ns) {
			put_set_point(d, t_ns, ret); /* both were lost, or the one with the target was */
		}
		break;
	case SET_POINT_LOWERED:
		if (!ack)
			d->handshake = SET_POINT_NONE;
		else
			command(d, CONTROL_ENABLE, t_ns);
		break;
	}
	if (d->handshake != SET_POINT_NONE && is_unanswered(d, t_ns))
		stand(d, t_ns, STANDS_BY_ITSELF, "%s (statusword %04X, bit 12)",
		      d->handshake == SET_POINT_RAISED ? "does not acknowledge its target"
		                                       : "does not take its acknowledgement back",
		      d->status);
	else if (d->handshake == SET_POINT_NONE && d->goes && !d->speed_due) /* the bit has gone */
		shake_hands(d, t_ns, ret);
}

/* What the drive itself sees going wrong. True: it stands now. */
static bool watch_bits(struct canopen_drive *d, int64_t t_ns)
{
	if (d->setup.mode != CANOPEN_VELOCITY && (d->status & STATUS_FOLLOWING)) {
		stand(d, t_ns, STANDS_BY_ITSELF, "reports a following error (statusword %04X, bit 13): is it blocked?",
		      d->status);
		return true;
	}
	if (!(d->status & STATUS_LIMIT)) {
		d->bit_seen = false;
	} else if (!d->bit_seen) {
		d->bit_seen = true;
		d->bit_since_ns = d->status_ns;
	} else if (d->status_ns - d->bit_since_ns >= LIMIT_NS) {
		stand(d, t_ns, STANDS_BY_ITSELF, "is at a limit of its own (statusword %04X, bit 11)", d->status);
		return true;
	}
	return false;
}

static void forgive(struct canopen_drive *d, int64_t t_ns)
{
	if (t_ns - d->ran_since_ns >= CANOPEN_DRIVE_UNHEARD_NS)
		d->unheard = 0;
	if (t_ns - d->ran_since_ns < CANOPEN_DRIVE_EARNED_NS)
		return;
	d->spent = false;
	d->losses = 0;
}

static void run(struct canopen_drive *d, int64_t t_ns, struct canopen_drive_wish *ret)
{
	static const struct object speed = {0x6081, 0, 4, 0};

	forgive(d, t_ns);
	if (d->state != CANOPEN_ENABLED) {
		lose(d, t_ns);
		return;
	}
	if (watch_bits(d, t_ns) || d->setup.mode != CANOPEN_POSITION)
		return;
	if (d->speed_due)
		ask(true, &speed, d->speed, ret);
	shake_hands(d, t_ns, ret);
}

/* A speed holds from the next set-point on, so a drive on its way gets its target once more. */
static void speed_answered(struct canopen_drive *d, bool good, uint32_t value)
{
	d->speed_due = false;
	d->taken_speed = d->speed;
	d->speeds++;
	if (!good && !d->note[0])
		snprintf(d->note, sizeof d->note, "its speed cannot be set (object 6081: %s), so its own value holds",
		         canopen_wire_abort_text(value));
	if (good && d->moves && !(d->status & STATUS_REACHED))
		d->goes = true;
}

/* Faults */

static void fault_stays(struct canopen_drive *d, const char *how, int64_t t_ns)
{
	stand(d, t_ns, STANDS_BY_FAULT, "has the fault %04X (%.40s), which %s", d->code,
	      canopen_wire_emcy_text(d->code), how);
}

static void forgive_or_not(struct canopen_drive *d, int64_t t_ns)
{
	const bool unheard = is_communication(d->code);

	if (unheard ? d->unheard >= CANOPEN_DRIVE_UNHEARD : d->spent) {
		fault_stays(d, "was there again after a reset", t_ns);
		return;
	}
	if (unheard)
		d->unheard++;
	else
		d->spent = true;
	d->at = 2;
	d->step_ns = d->due_ns = t_ns;
}

static void reset(struct canopen_drive *d, int64_t t_ns, struct canopen_drive_wish *ret)
{
	static const struct object code = {0x603f, 0, 2, 0};

	d->demand = still(d);
	if (!has_fault(d)) {
		d->control = CONTROL_VOLTAGE; /* bit 7 is low again before anything else is wanted */
		d->send = true;
		enter(d, CANOPEN_DRIVE_WAITING, t_ns);
	} else if (d->at == 0) {
		if (d->state == CANOPEN_FAULT || t_ns - d->begun_ns >= REACTION_NS)
			ask(false, &code, 0, ret);
	} else if (d->at == 1) {
		forgive_or_not(d, t_ns);
	} else if (d->at == 2) {
		command(d, CONTROL_VOLTAGE, t_ns);
		if (t_ns - d->step_ns < EDGE_NS)
			return;
		d->at = 3;
		d->step_ns = t_ns;
		d->resets++;
		command(d, CONTROL_RESET, t_ns);
	} else if (t_ns - d->step_ns >= CANOPEN_DRIVE_STEP_NS) {
		fault_stays(d, "a reset does not clear", t_ns);
	} else {
		command(d, CONTROL_RESET, t_ns);
	}
}

/* Standing: until somebody has seen to it. */

static void stay(struct canopen_drive *d, int64_t t_ns)
{
	const bool fault = has_fault(d);
	const bool cleared = d->was_fault && !fault && d->status_known;
	const bool given = d->reason == STANDS_BY_STATE && !fault && (d->cured || d->state == CANOPEN_ENABLED);

	d->was_fault |= fault;
	if (!cleared && !given)
		return;
	d->spent = false;
	d->losses = 0;
	d->send = false;
	d->why[0] = 0;
	enter(d, CANOPEN_DRIVE_WAITING, t_ns);
}

static void end(struct canopen_drive *d, int64_t t_ns)
{
	const bool moves = d->state == CANOPEN_ENABLED || d->state == CANOPEN_QUICK_STOP;

	if (!moves || t_ns - d->begun_ns >= CANOPEN_DRIVE_STEP_NS) {
		if (moves || d->state == CANOPEN_SWITCHED_ON || d->state == CANOPEN_READY_TO_SWITCH_ON) {
			d->control = CONTROL_VOLTAGE;
			d->send = true;
		}
		enter(d, CANOPEN_DRIVE_ENDED, t_ns);
	} else if (d->state == CANOPEN_QUICK_STOP && t_ns - d->begun_ns >= QUICK_STOP_NS) {
		command(d, CONTROL_VOLTAGE, t_ns);
	} else {
		command(d, CONTROL_QUICK_STOP, t_ns);
	}
}

void canopen_drive_answer(struct canopen_drive *d, bool good, uint32_t value, int64_t t_ns)
{
	switch (d->phase) {
	case CANOPEN_DRIVE_PREPARING:
		prepared(d, good, value, t_ns);
		break;
	case CANOPEN_DRIVE_SWITCHING:
		switched(d, good, value, t_ns);
		break;
	case CANOPEN_DRIVE_RESETTING:
		if (d->at == 0) {
			d->code = good && (value & 0xffff) ? (uint16_t)value : d->code;
			d->at = 1;
		}
		break;
	case CANOPEN_DRIVE_RUNNING:
		speed_answered(d, good, value);
		break;
	default:
		break;
	}
}

static void act(struct canopen_drive *d, int64_t t_ns, struct canopen_drive_wish *ret)
{
	switch (d->phase) {
	case CANOPEN_DRIVE_WAITING:
		wait_for_state(d, t_ns);
		break;
	case CANOPEN_DRIVE_RESETTING:
		reset(d, t_ns, ret);
		break;
	case CANOPEN_DRIVE_CALMING:
		calm(d, t_ns);
		break;
	case CANOPEN_DRIVE_PREPARING:
		prepare(d, t_ns, ret);
		break;
	case CANOPEN_DRIVE_SWITCHING:
		switch_mode(d, t_ns, ret);
		break;
	case CANOPEN_DRIVE_ENABLING:
		enable(d, t_ns);
		break;
	case CANOPEN_DRIVE_HOMING:
		home(d, t_ns);
		break;
	case CANOPEN_DRIVE_RUNNING:
		run(d, t_ns, ret);
		break;
	case CANOPEN_DRIVE_STANDING:
		stay(d, t_ns);
		break;
	case CANOPEN_DRIVE_ENDING:
		end(d, t_ns);
		break;
	case CANOPEN_DRIVE_IDLE:
	case CANOPEN_DRIVE_ENDED:
		break;
	}
}

static bool commands(const struct canopen_drive *d)
{
	return d->phase >= CANOPEN_DRIVE_WAITING && d->phase <= CANOPEN_DRIVE_RUNNING;
}

void canopen_drive_step(struct canopen_drive *d, int64_t t_ns, struct canopen_drive_wish *ret)
{
	enum canopen_drive_phase before;

	memset(ret, 0, sizeof *ret);
	if (has_fault(d) && commands(d) && d->phase != CANOPEN_DRIVE_RESETTING)
		enter(d, CANOPEN_DRIVE_RESETTING, t_ns);
	do {
		before = d->phase;
		ret->asks = false;
		act(d, t_ns, ret);
	} while (d->phase != before);
	if (d->send && d->phase > CANOPEN_DRIVE_CALMING && d->phase < CANOPEN_DRIVE_RUNNING)
		d->demand = still(d);
	if (d->send)
		put(ret, d->control, d->demand);
	d->send = false;
	ret->deadline_ns =
	    d->phase == CANOPEN_DRIVE_IDLE || d->phase == CANOPEN_DRIVE_ENDED ? INT64_MAX : t_ns + LOOK_NS;
}

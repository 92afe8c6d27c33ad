/* A simulated drive (CiA 402): states, profile position, profile velocity, cyclic synchronous position, homing.
 *
 *   not ready -> switch on disabled -6-> ready -7-> switched on -F-> operation enabled -2-> quick stop active
 *                      ^                                                   |
 *                      +-- 0 from anywhere; after a quick stop             +--> fault reaction -> fault -80-> disabled
 *
 * The control word acts when it is written. Enabling takes the time in which a brake opens, a fault the time in which the
 * axis comes to rest. All motion is the axis' (sim_axis.h), one acceleration for both ramps: the smaller of 6083, 6084.
 *
 * Soft limits (607D) clip targets and set-points and raise bit 11. A velocity is a motion to the limit in its
 * direction. The following error is what the set-point of the mode is ahead of the axis; beyond 6065 for 6066 ms the
 * drive is in fault 8611, in every mode. A cyclic set-point is gone to within the interpolation time (60C2), faster than 607F never:
 * a set-point far away is therefore a following error too, as in real drives that were enabled before their target was
 * set to where they stand. */
#include "tools/sim_node.h"

#include <math.h>
#include <stdlib.h>

#include "core/trig.h"

#define MS             INT64_C(1000000)
#define ENABLE_NS      (10 * MS) /* a brake opens */
#define MODE_NS        (2 * MS)
#define LOOK_NS        (5 * MS)  /* how often it is looked whether the axis follows, where it may not */
#define HOME_NS        (20 * MS) /* methods that only say: here */
#define BACK_RAD       TRIG_DEG  /* so far off its limit switch homing ends */
#define HEARD_NO_MORE  0x8130
#define FOLLOWING      0x8611
#define GENERIC        0x4310
#define REGISTER_ERROR 0x01

enum mode { PROFILE_POSITION = 1, PROFILE_VELOCITY = 3, HOMING = 6, CYCLIC_POSITION = 8 };
enum control { NEW_SET_POINT = 0x10, AT_ONCE = 0x20, RELATIVE = 0x40, RESET = 0x80, HALT = 0x100 };

static const uint16_t state_bits[] = {0x00, 0x40, 0x21, 0x23, 0x27, 0x07, 0x0f, 0x28, 0x00};

static double scale(const struct sim_node *n)
{
	return n->params.count_rad * n->params.sign;
}

static double to_rad(const struct sim_node *n, double counts)
{
	return n->drive.zero_rad + counts * scale(n);
}

static double to_counts(const struct sim_node *n, double rad)
{
	return (rad - n->drive.zero_rad) / scale(n);
}

/* In rad, of what is kept in counts; of two the smaller. */
static double kept(const struct sim_node *n, uint16_t index, uint8_t sub)
{
	return (double)sim_node_value(n, index, sub) * n->params.count_rad;
}

static double acceleration(const struct sim_node *n)
{
	return fmin(kept(n, 0x6083, 0), kept(n, 0x6084, 0));
}

static void stop(struct sim_node *n, uint16_t deceleration, int64_t t_ns)
{
	n->drive.queued = n->drive.fresh = false;
	n->drive.behind_ns = INT64_MAX;
	sim_axis_stop(n->axis, kept(n, deceleration, 0), t_ns);
}

static bool standing(const struct sim_node *n, int64_t t_ns)
{
	return sim_axis_arrived(n->axis, t_ns) && sim_axis_speed(n->axis, t_ns) == 0.0;
}

/* Within the soft limits, where there are any. */
static double clip(struct sim_node *n, double counts)
{
	double low = (double)sim_node_value(n, 0x607D, 1), high = (double)sim_node_value(n, 0x607D, 2);
	double clipped = low < high ? fmin(fmax(counts, low), high) : counts;

	n->drive.limited = clipped != counts || n->fault[SIM_FAULT_LIMIT].on;
	return clipped;
}

static void go(struct sim_node *n, double target, int64_t t_ns)
{
	struct sim_node_drive *d = &n->drive;

	d->target = clip(n, target);
	if (!n->fault[SIM_FAULT_LIMIT].on)
		sim_axis_goto(n->axis, to_rad(n, d->target), fmin(kept(n, 0x6081, 0), kept(n, 0x607F, 0)),
		              acceleration(n), t_ns);
}

/* Profile velocity: a motion to the soft limit in its direction, or to the end of what it can count. */
static void run(struct sim_node *n, int64_t t_ns)
{
	double most = kept(n, 0x607F, 0), speed = fmin(fmax(kept(n, 0x60FF, 0), -most), most);

	if (speed == 0.0 || n->fault[SIM_FAULT_LIMIT].on) {
		stop(n, 0x6084, t_ns);
		return;
	}
	n->drive.target = clip(n, speed > 0.0 ? INT32_MAX : INT32_MIN);
	n->drive.limited = false; /* it is when it has come there */
	sim_axis_goto(n->axis, to_rad(n, n->drive.target), fabs(speed), acceleration(n), t_ns);
}

/* The rising edge of bit 4 in profile position. */
static void set_point(struct sim_node *n, int64_t t_ns)
{
	struct sim_node_drive *d = &n->drive;
	double target = (double)sim_node_value(n, 0x607A, 0);

	if (d->control & RELATIVE)
		target += d->target;
	d->acknowledged = true;
	if (d->control & AT_ONCE || standing(n, t_ns)) {
		d->queued = false;
		go(n, target, t_ns);
	} else {
		d->queued = true;
		d->next = target;
	}
}

/* Limit switches: 17 the one at low counts, 18 the one at high ones. */
static double switch_rad(const struct sim_node *n, int64_t method)
{
	return n->params.switch_rad[(method == 17) == (n->params.sign < 0)];
}

static void home(struct sim_node *n, int64_t t_ns)
{
	int64_t method = sim_node_value(n, 0x6098, 0);

	n->drive.homing_ns = t_ns + HOME_NS;
	n->drive.homing = SIM_HOMING_STARTED;
	if (method != 17 && method != 18)
		return;
	n->drive.homing = SIM_HOMING_SEEK;
	sim_axis_goto(n->axis, switch_rad(n, method), kept(n, 0x6099, 1), kept(n, 0x609A, 0), t_ns);
}

/* Home is here, or was there: it counts what 607C says at it. */
static void homed(struct sim_node *n, double home_rad, int64_t t_ns)
{
	n->drive.homing = SIM_HOMING_DONE;
	n->drive.zero_rad = home_rad - (double)sim_node_value(n, 0x607C, 0) * scale(n);
	n->drive.target = to_counts(n, sim_axis_angle(n->axis, t_ns));
}

static bool is_homing(const struct sim_node *n)
{
	return n->drive.homing >= SIM_HOMING_STARTED && n->drive.homing <= SIM_HOMING_BACK;
}

static void homing_advance(struct sim_node *n, int64_t t_ns)
{
	int64_t method = sim_node_value(n, 0x6098, 0);
	double at = sim_axis_angle(n->axis, t_ns), end = switch_rad(n, method);

	if (!is_homing(n) || t_ns < n->drive.homing_ns)
		return;
	if (sim_fault_due(&n->fault[SIM_FAULT_HOMING])) {
		stop(n, 0x609A, t_ns);
		n->drive.homing = SIM_HOMING_FAILED;
	} else if (n->drive.homing == SIM_HOMING_STARTED) {
		homed(n, at, t_ns);
	} else if (n->drive.homing == SIM_HOMING_SEEK && standing(n, t_ns) && at == end) {
		n->drive.homing = SIM_HOMING_BACK;
		sim_axis_goto(n->axis, end + (end > n->params.switch_rad[0] ? -BACK_RAD : BACK_RAD), kept(n, 0x6099, 2),
		              kept(n, 0x609A, 0), t_ns);
	} else if (n->drive.homing == SIM_HOMING_BACK && standing(n, t_ns) && at != end) {
		homed(n, end, t_ns);
	}
}

/* Operation is enabled: it holds where it stands. A cyclic mode goes to its set-point, wherever that is. */
static void enabled(struct sim_node *n, int64_t t_ns)
{
	struct sim_node_drive *d = &n->drive;

	stop(n, 0x6085, t_ns);
	d->state = CANOPEN_ENABLED;
	d->enable_ns = INT64_MAX;
	d->target = to_counts(n, sim_axis_angle(n->axis, t_ns));
	d->fresh = true;
	if (d->mode == PROFILE_VELOCITY && !(d->control & HALT))
		run(n, t_ns);
}

static void leave(struct sim_node *n, enum canopen_drive_state state, uint16_t deceleration, int64_t t_ns)
{
	if (n->drive.state == CANOPEN_ENABLED || n->drive.state == CANOPEN_QUICK_STOP)
		stop(n, deceleration, t_ns);
	if (is_homing(n))
		n->drive.homing = SIM_HOMING_NONE;
	n->drive.acknowledged = false;
	n->drive.enable_ns = INT64_MAX;
	n->drive.state = state;
}

static void quick_stop(struct sim_node *n, int64_t t_ns)
{
	if (n->drive.state == CANOPEN_ENABLED && sim_node_value(n, 0x605A, 0) != 0)
		leave(n, CANOPEN_QUICK_STOP, 0x6085, t_ns);
	else if (n->drive.state != CANOPEN_QUICK_STOP)
		leave(n, CANOPEN_SWITCH_ON_DISABLED, 0x6085, t_ns);
}

/* The low bits of the control word, in the states that listen to them. */
static void command(struct sim_node *n, uint16_t control, int64_t t_ns)
{
	struct sim_node_drive *d = &n->drive;
	bool on =
	    d->state == CANOPEN_READY_TO_SWITCH_ON || d->state == CANOPEN_SWITCHED_ON || d->state == CANOPEN_ENABLED;

	if (!on && d->state != CANOPEN_QUICK_STOP && d->state != CANOPEN_SWITCH_ON_DISABLED)
		return;
	if (!(control & 0x02)) {
		leave(n, CANOPEN_SWITCH_ON_DISABLED, 0x6085, t_ns);
	} else if (!(control & 0x04)) {
		quick_stop(n, t_ns);
	} else if (!(control & 0x01)) {
		if (d->state != CANOPEN_QUICK_STOP)
			leave(n, CANOPEN_READY_TO_SWITCH_ON, 0x6084, t_ns);
	} else if (!(control & 0x08)) {
		if (on)
			leave(n, CANOPEN_SWITCHED_ON, 0x6084, t_ns);
	} else if (d->state == CANOPEN_READY_TO_SWITCH_ON || d->state == CANOPEN_SWITCHED_ON) {
		d->state = CANOPEN_SWITCHED_ON;
		if (d->enable_ns == INT64_MAX)
			d->enable_ns = t_ns + ENABLE_NS;
	} else if (d->state == CANOPEN_QUICK_STOP && sim_node_value(n, 0x605A, 0) >= 5) {
		enabled(n, t_ns);
	}
}

/* The bits that mean something to the mode. */
static void operate(struct sim_node *n, uint16_t up, uint16_t down, int64_t t_ns)
{
	struct sim_node_drive *d = &n->drive;

	if (up & HALT)
		stop(n, 0x6084, t_ns);
	if (d->mode == PROFILE_POSITION) {
		if (down & HALT)
			go(n, d->target, t_ns);
		if (up & NEW_SET_POINT && !(d->control & HALT) && !d->acknowledged)
			set_point(n, t_ns);
	} else if (d->mode == PROFILE_VELOCITY && down & HALT) {
		run(n, t_ns);
	} else if (d->mode == HOMING && up & NEW_SET_POINT && !(d->control & HALT)) {
		home(n, t_ns);
	} else if (d->mode == HOMING && (down & NEW_SET_POINT || up & HALT) && is_homing(n)) {
		stop(n, 0x609A, t_ns);
		d->homing = SIM_HOMING_NONE;
	}
	if (!(d->control & NEW_SET_POINT) && !d->queued)
		d->acknowledged = false;
}

static void controlled(struct sim_node *n, int64_t t_ns)
{
	struct sim_node_drive *d = &n->drive;
	uint16_t now = (uint16_t)sim_node_value(n, 0x6040, 0), before = d->control;

	d->control = now;
	if (now & (uint16_t)~before & RESET && d->state == CANOPEN_FAULT && !n->fault[SIM_FAULT_FAULT].on) {
		d->state = CANOPEN_SWITCH_ON_DISABLED;
		d->error = 0;
		n->error_register = 0;
		sim_node_emergency(n, 0, 0);
		return; /* its low bits were the reset's */
	}
	command(n, now, t_ns);
	if (d->state == CANOPEN_ENABLED)
		operate(n, now & (uint16_t)~before, before & (uint16_t)~now, t_ns);
}

static bool judge_following(const struct sim_node *n)
{
	return n->drive.state == CANOPEN_ENABLED && sim_node_value(n, 0x6065, 0) != UINT32_MAX;
}

static double following(const struct sim_node *n, int64_t t_ns)
{
	const struct sim_node_drive *d = &n->drive;

	if (d->mode == CYCLIC_POSITION && d->state == CANOPEN_ENABLED)
		return d->target - to_counts(n, sim_axis_angle(n->axis, t_ns > d->cycle_ns ? t_ns : d->cycle_ns));
	return to_counts(n, sim_axis_demand(n->axis, t_ns)) - to_counts(n, sim_axis_angle(n->axis, t_ns));
}

static void look_behind(struct sim_node *n, int64_t t_ns)
{
	struct sim_node_drive *d = &n->drive;

	d->look_ns = t_ns + LOOK_NS;
	if (!judge_following(n) || fabs(following(n, t_ns)) <= (double)sim_node_value(n, 0x6065, 0))
		d->behind_ns = INT64_MAX;
	else if (d->behind_ns == INT64_MAX)
		d->behind_ns = t_ns;
	else if (t_ns - d->behind_ns >= sim_node_value(n, 0x6066, 0) * MS)
		sim_node_drive_fail(n, FOLLOWING, t_ns);
}

void sim_node_drive_cycle(struct sim_node *n, int64_t t_ns)
{
	struct sim_node_drive *d = &n->drive;
	double cycle_s = (double)sim_node_value(n, 0x60C2, 1);

	if (d->state != CANOPEN_ENABLED || d->mode != CYCLIC_POSITION || !d->fresh || d->control & HALT)
		return;
	d->fresh = false;
	for (int64_t i = sim_node_value(n, 0x60C2, 2); i < 0; i++)
		cycle_s /= 10.0;
	d->target = clip(n, (double)sim_node_value(n, 0x607A, 0));
	d->cycle_ns = t_ns + (int64_t)rint(cycle_s * 1e9);
	if (!n->fault[SIM_FAULT_LIMIT].on)
		sim_axis_track(n->axis, to_rad(n, d->target), d->cycle_ns - t_ns, kept(n, 0x607F, 0),
		               kept(n, 0x60C5, 0), t_ns);
	look_behind(n, t_ns);
}

void sim_node_drive_boot(struct sim_node *n, int64_t t_ns)
{
	struct sim_node_drive *d = &n->drive;

	*d = (struct sim_node_drive){.state = CANOPEN_SWITCH_ON_DISABLED,
	                             .enable_ns = INT64_MAX,
	                             .mode_ns = INT64_MAX,
	                             .behind_ns = INT64_MAX,
	                             .look_ns = t_ns};
	d->zero_rad = n->params.unhomed ? sim_axis_angle(n->axis, t_ns) : 0.0;
	d->mode = (int8_t)sim_node_value(n, 0x6060, 0);
}

void sim_node_drive_off(struct sim_node *n, int64_t t_ns)
{
	leave(n, CANOPEN_SWITCH_ON_DISABLED, 0x6085, t_ns);
	n->drive.error = 0;
	n->drive.control = 0;
	sim_node_set(n, 0x6040, 0, 0);
}

uint32_t sim_node_drive_judge(const struct sim_node *n, const struct sim_node_object *o, int64_t value)
{
	(void)n;
	switch (o->index) {
	case 0x6060:
		return value == 0 || value == PROFILE_POSITION || value == PROFILE_VELOCITY || value == HOMING ||
		               value == CYCLIC_POSITION
		           ? 0
		           : CANOPEN_ABORT_RANGE;
	case 0x6098:
		return value == 0 || value == 17 || value == 18 || value == 35 || value == 37 ? 0 : CANOPEN_ABORT_RANGE;
	case 0x605A:
		return value == 3 || value == 4 || value == 7 || value == 8 ? CANOPEN_ABORT_RANGE : 0;
	case 0x6086:
		return value == 0 ? 0 : CANOPEN_ABORT_RANGE;
	}
	return 0;
}

void sim_node_drive_written(struct sim_node *n, const struct sim_node_object *o, int64_t t_ns)
{
	switch (o->index) {
	case 0x6040:
		controlled(n, t_ns);
		break;
	case 0x6060:
		n->drive.mode_ns = t_ns + MODE_NS;
		break;
	case 0x607A:
		n->drive.fresh = true;
		break;
	case 0x60FF:
		if (n->drive.state == CANOPEN_ENABLED && n->drive.mode == PROFILE_VELOCITY &&
		    !(n->drive.control & HALT))
			run(n, t_ns);
		break;
	}
}

static void take_mode(struct sim_node *n, int64_t t_ns)
{
	struct sim_node_drive *d = &n->drive;
	int8_t mode = (int8_t)sim_node_value(n, 0x6060, 0);

	d->mode_ns = INT64_MAX;
	if (mode == d->mode)
		return;
	if (d->state == CANOPEN_ENABLED) {
		stop(n, 0x6084, t_ns);
		d->target = to_counts(n, sim_axis_angle(n->axis, t_ns));
		d->fresh = mode == CYCLIC_POSITION;
	}
	if (is_homing(n))
		d->homing = SIM_HOMING_NONE;
	d->acknowledged = d->limited = false;
	d->mode = mode;
	d->cycle_ns = t_ns;
}

void sim_node_drive_advance(struct sim_node *n, int64_t t_ns)
{
	struct sim_node_drive *d = &n->drive;

	if (d->mode_ns <= t_ns)
		take_mode(n, t_ns);
	if (d->enable_ns <= t_ns)
		enabled(n, t_ns);
	if (d->state == CANOPEN_FAULT_REACTION && standing(n, t_ns))
		d->state = CANOPEN_FAULT;
	if (d->state == CANOPEN_QUICK_STOP && standing(n, t_ns) && sim_node_value(n, 0x605A, 0) < 5)
		d->state = CANOPEN_SWITCH_ON_DISABLED;
	if (d->state != CANOPEN_ENABLED)
		return;
	homing_advance(n, t_ns);
	if (d->queued && standing(n, t_ns)) {
		d->queued = false;
		go(n, d->next, t_ns);
		d->acknowledged = d->control & NEW_SET_POINT;
	}
	if (d->mode == PROFILE_VELOCITY && !d->limited && standing(n, t_ns) && sim_node_value(n, 0x60FF, 0) != 0 &&
	    !(d->control & HALT))
		d->limited = true;
	look_behind(n, t_ns);
}

static int64_t earlier(int64_t a, int64_t b)
{
	return a < b ? a : b;
}

int64_t sim_node_drive_deadline(const struct sim_node *n)
{
	const struct sim_node_drive *d = &n->drive;
	int64_t deadline = earlier(d->mode_ns, d->enable_ns), arrival = sim_axis_arrival_ns(n->axis);
	bool waits = d->state == CANOPEN_FAULT_REACTION || d->state == CANOPEN_QUICK_STOP || d->queued ||
	             is_homing(n) || (d->state == CANOPEN_ENABLED && d->mode == PROFILE_VELOCITY);

	if (waits && arrival > n->now_ns)
		deadline = earlier(deadline, arrival);
	if (is_homing(n) && d->homing_ns > n->now_ns)
		deadline = earlier(deadline, d->homing_ns);
	/* What the axis does by itself while it does not follow cannot be known beforehand. */
	if (waits || (d->state == CANOPEN_ENABLED && (!sim_axis_follows(n->axis) || d->behind_ns != INT64_MAX)))
		deadline = earlier(deadline, n->now_ns + LOOK_NS);
	return deadline;
}

void sim_node_drive_fail(struct sim_node *n, uint16_t code, int64_t t_ns)
{
	if (n->drive.state != CANOPEN_FAULT && n->drive.state != CANOPEN_FAULT_REACTION) {
		leave(n, CANOPEN_FAULT_REACTION, 0x6085, t_ns);
		if (standing(n, t_ns))
			n->drive.state = CANOPEN_FAULT;
	}
	n->drive.error = code;
	sim_node_emergency(n, code, (uint8_t)(REGISTER_ERROR | (code >> 8 == 0x81 ? 0x10 : 0)));
}

void sim_node_drive_abandoned(struct sim_node *n, int64_t t_ns)
{
	switch (sim_node_value(n, 0x6007, 0)) {
	case 1:
		sim_node_drive_fail(n, HEARD_NO_MORE, t_ns);
		break;
	case 2:
		if (n->drive.state != CANOPEN_FAULT && n->drive.state != CANOPEN_FAULT_REACTION)
			leave(n, CANOPEN_SWITCH_ON_DISABLED, 0x6085, t_ns);
		break;
	case 3:
		if (n->drive.state == CANOPEN_ENABLED)
			quick_stop(n, t_ns);
		break;
	}
}

void sim_node_drive_limit(struct sim_node *n, bool on, int64_t t_ns)
{
	n->drive.limited = on;
	if (on)
		sim_axis_stop(n->axis, 0.0, t_ns);
}

static bool reached(const struct sim_node *n, int64_t t_ns)
{
	const struct sim_node_drive *d = &n->drive;
	double window = (double)sim_node_value(n, 0x6067, 0);

	switch (d->mode) {
	case PROFILE_POSITION:
		if (d->control & HALT)
			return standing(n, t_ns);
		return standing(n, t_ns) && !d->queued &&
		       t_ns >= sim_axis_arrival_ns(n->axis) + sim_node_value(n, 0x6068, 0) * MS &&
		       fabs(to_counts(n, sim_axis_angle(n->axis, t_ns)) - d->target) <= window;
	case PROFILE_VELOCITY:
		return fabs(sim_axis_speed(n->axis, t_ns) / scale(n) - (double)sim_node_value(n, 0x60FF, 0)) <= window;
	case HOMING:
		return !is_homing(n) && standing(n, t_ns);
	}
	return false;
}

static uint16_t mode_bits(const struct sim_node *n, int64_t t_ns)
{
	const struct sim_node_drive *d = &n->drive;

	switch (d->mode) {
	case PROFILE_POSITION:
		return (uint16_t)((d->acknowledged ? 0x1000 : 0) | (d->behind_ns != INT64_MAX ? 0x2000 : 0));
	case PROFILE_VELOCITY:
		return sim_axis_speed(n->axis, t_ns) == 0.0 ? 0x1000 : 0;
	case HOMING:
		return d->homing == SIM_HOMING_DONE ? 0x1000 : d->homing == SIM_HOMING_FAILED ? 0x2000 : 0;
	case CYCLIC_POSITION:
		return (uint16_t)((d->state == CANOPEN_ENABLED ? 0x1000 : 0) |
		                  (d->behind_ns != INT64_MAX ? 0x2000 : 0));
	}
	return 0;
}

uint16_t sim_node_drive_status(const struct sim_node *n, int64_t t_ns)
{
	const struct sim_node_drive *d = &n->drive;

	return (uint16_t)(state_bits[d->state] | 0x0210 | (reached(n, t_ns) ? 0x0400 : 0) | (d->limited ? 0x0800 : 0) |
	                  mode_bits(n, t_ns));
}

int64_t sim_node_drive_measure(const struct sim_node *n, uint16_t index, int64_t t_ns, int64_t value)
{
	switch (index) {
	case 0x603F:
		return n->drive.error;
	case 0x6041:
		return sim_node_drive_status(n, t_ns);
	case 0x6061:
		return n->drive.mode;
	case 0x6062:
		return llrint(to_counts(n, sim_axis_demand(n->axis, t_ns)));
	case 0x6063:
	case 0x6064:
		return llrint(to_counts(n, sim_axis_angle(n->axis, t_ns)));
	case 0x606C:
		return llrint(sim_axis_speed(n->axis, t_ns) / scale(n));
	case 0x60F4:
		return llrint(following(n, t_ns));
	case 0x60FD:
		return n->fault[SIM_FAULT_LIMIT].on ? 3 : 0;
	}
	return value;
}

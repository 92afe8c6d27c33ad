/* One axis of a simulated robot, see sim_axis.h.
 *
 * A command is planned at once to its end: a trapezoid is up to three pieces of constant acceleration and a piece at
 * rest, the first beginning now, the others in the future. The next command takes position and speed of its own time
 * and throws away what lies behind. So the past stays as it was, and where the axis stands needs no stepping, whatever
 * the pace at which its owners look.
 *
 * From position p with speed v, a trapezoid goes in the direction in which the way remains after braking:
 *
 *    x = way - v |v| / 2a        w = min(speed, sqrt(a way + v^2 / 2))    the speed at its top, both along that direction
 *
 * which holds for speeds against it and beyond the limit too. Pieces begin at whole ns and with the position that was
 * computed, not with that at the rounded time: they do not meet by less than half a ns of way, and rest is exact. */
#include "tools/sim_axis.h"

#include <math.h>
#include <string.h>

#include "core/trig.h"

struct at { /* of an axis at a time */
	double p, v;
};

static double seconds(int64_t ns)
{
	return (double)ns * 1e-9;
}

/* What takes longer than a clock of our days can say never ends. */
static int64_t after(int64_t t_ns, double s)
{
	return s < 1e9 ? t_ns + (int64_t)rint(s * 1e9) : INT64_MAX;
}

/* Up to the other end, in the time since it was at its begin. */
static double triangle_way(double s, double length, double speed, double acceleration)
{
	double ramp = acceleration > 0.0 ? speed / acceleration : 0.0, half = length / speed + ramp;

	if (s < ramp)
		return acceleration * s * s / 2.0;
	if (s < half - ramp)
		return speed * (s - ramp / 2.0);
	return length - acceleration * (half - s) * (half - s) / 2.0;
}

static double triangle_speed(double s, double length, double speed, double acceleration)
{
	double ramp = acceleration > 0.0 ? speed / acceleration : 0.0, half = length / speed + ramp;

	if (s < ramp)
		return acceleration * s;
	return s < half - ramp ? speed : acceleration * (half - s);
}

static struct at triangle_at(const struct sim_axis_piece *piece, double s)
{
	double length = fabs(piece->span), sign = piece->span < 0.0 ? -1.0 : 1.0;
	double ramp = piece->acceleration > 0.0 ? piece->speed / piece->acceleration : 0.0;
	double half = length / piece->speed + ramp, phase = fmod(s, 2.0 * half);
	bool back = phase >= half;
	double since = back ? phase - half : phase;
	double way = triangle_way(since, length, piece->speed, piece->acceleration);
	double speed = triangle_speed(since, length, piece->speed, piece->acceleration);

	return (struct at){piece->at + sign * (back ? length - way : way), sign * (back ? -speed : speed)};
}

static struct at sinus_at(const struct sim_axis_piece *piece, int64_t dt_ns)
{
	double period_s = 2.0 * TRIG_PI / piece->acceleration;
	double phase = fmod(seconds(dt_ns), period_s) * piece->acceleration;

	return (struct at){piece->at + piece->speed * trig_sin(phase),
	                   piece->speed * piece->acceleration * trig_cos(phase)};
}

static struct at piece_at(const struct sim_axis_piece *piece, int64_t t_ns)
{
	int64_t dt_ns = t_ns > piece->t_ns ? t_ns - piece->t_ns : 0;
	double s = seconds(dt_ns);

	switch (piece->kind) {
	case SIM_AXIS_SINUS:
		return sinus_at(piece, dt_ns);
	case SIM_AXIS_TRIANGLE:
		return triangle_at(piece, s);
	default:
		return (struct at){piece->at + (piece->speed + piece->acceleration * s / 2.0) * s,
		                   piece->speed + piece->acceleration * s};
	}
}

/* The piece in force at t_ns: the newest that began by then; the oldest there is answers for all that was before. */
static const struct sim_axis_piece *piece_of(const struct sim_axis_path *path, int64_t t_ns)
{
	uint64_t high = path->pieces - 1, low = path->pieces > SIM_AXIS_PIECES ? path->pieces - SIM_AXIS_PIECES : 0;

	while (low < high) {
		uint64_t middle = low + (high - low + 1) / 2;

		if (path->piece[middle % SIM_AXIS_PIECES].t_ns <= t_ns)
			low = middle;
		else
			high = middle - 1;
	}
	return &path->piece[low % SIM_AXIS_PIECES];
}

static struct at path_at(const struct sim_axis_path *path, int64_t t_ns)
{
	return piece_at(piece_of(path, t_ns), t_ns);
}

static void add(struct sim_axis_path *path, struct sim_axis_piece piece)
{
	path->piece[path->pieces++ % SIM_AXIS_PIECES] = piece;
}

/* What was planned after t_ns is forgotten, one piece at least stays. Those that were overwritten by a plan are lost to
 * the past: plans are short and the past is long. */
static void forget_after(struct sim_axis_path *path, int64_t t_ns)
{
	uint64_t oldest = path->pieces > SIM_AXIS_PIECES ? path->pieces - SIM_AXIS_PIECES : 0;

	while (path->pieces > oldest + 1 && path->piece[(path->pieces - 1) % SIM_AXIS_PIECES].t_ns >= t_ns)
		path->pieces--;
}

static void add_even(struct sim_axis_path *path, int64_t t_ns, double at, double speed, double acceleration)
{
	add(path, (struct sim_axis_piece){.t_ns = t_ns, .at = at, .speed = speed, .acceleration = acceleration});
}

/* To another speed, from where it is. */
static void plan_speed(struct sim_axis_path *path, struct at now, double speed, double acceleration, int64_t t_ns)
{
	double a = speed < now.v ? -acceleration : acceleration;

	forget_after(path, t_ns);
	if (acceleration > 0.0 && speed != now.v) {
		double s = (speed - now.v) / a;

		add_even(path, t_ns, now.p, now.v, a);
		now.p += (now.v + speed) / 2.0 * s;
		t_ns = after(t_ns, s);
	}
	add_even(path, t_ns, now.p, speed, 0.0);
}

/* The trapezoid along its direction `d` (+1, -1): from speed v (along d) over `way`. */
static void plan_ramps(struct sim_axis_path *path, double p, double v, double d, double way, double speed, double a,
                       int64_t t_ns)
{
	double top = fmin(speed, sqrt(a * way + v * v / 2.0));
	double s1 = fabs(top - v) / a, way1 = (top + v) / 2.0 * s1, way3 = top * top / (2.0 * a);
	double way2 = fmax(way - way1 - way3, 0.0), s2 = top > 0.0 ? way2 / top : 0.0;

	add_even(path, t_ns, p, d * v, top < v ? -d * a : d * a);
	add_even(path, after(t_ns, s1), p + d * way1, d * top, 0.0);
	add_even(path, after(t_ns, s1 + s2), p + d * (way1 + way2), d * top, -d * a);
	add_even(path, after(t_ns, s1 + s2 + top / a), p + d * way, 0.0, 0.0);
}

static void plan_goto(struct sim_axis_path *path, struct at now, double to, double speed, double a, int64_t t_ns)
{
	double stand =
	    a > 0.0 ? now.p + now.v * fabs(now.v) / (2.0 * a) : now.p; /* where it would stand if it braked */
	double d = to < stand || (to == stand && now.v < 0.0) ? -1.0 : 1.0;

	forget_after(path, t_ns);
	if (speed <= 0.0 || (to == now.p && now.v == 0.0)) {
		add_even(path, t_ns, now.p, 0.0, 0.0);
	} else if (a > 0.0) {
		plan_ramps(path, now.p, d * now.v, d, d * (to - now.p), speed, a, t_ns);
		path->piece[(path->pieces - 1) % SIM_AXIS_PIECES].at = to;
	} else {
		add_even(path, t_ns, now.p, d * speed, 0.0);
		add_even(path, after(t_ns, fabs(to - now.p) / speed), to, 0.0, 0.0);
	}
}

/* A straight line to a set-point; what the limits leave of it. Returns its speed. */
static double plan_track(struct sim_axis_path *path, struct at now, double to, int64_t within_ns, double speed,
                         double a, int64_t t_ns)
{
	double s = seconds(within_ns), v = (to - now.p) / s, most = speed > 0.0 ? speed : HUGE_VAL;
	double change = a > 0.0 ? a * s : HUGE_VAL;

	v = fmax(fmin(v, now.v + change), now.v - change);
	v = fmax(fmin(v, most), -most);
	forget_after(path, t_ns);
	add_even(path, t_ns, now.p, v, 0.0);
	add_even(path, t_ns + within_ns, v == (to - now.p) / s ? to : now.p + v * s, 0.0, 0.0);
	return v;
}

/* What the mechanics make of the order, from `now` on. A track's set-point is gone: the next one moves it. */
static void follow(struct sim_axis *axis, int64_t t_ns)
{
	const struct sim_axis_order *order = &axis->order;
	struct at now = path_at(&axis->motion, t_ns);

	if (axis->stuck) {
		forget_after(&axis->motion, t_ns);
		add_even(&axis->motion, t_ns, now.p, 0.0, 0.0);
		return;
	}
	switch (order->kind) {
	case SIM_AXIS_GOTO:
		plan_goto(&axis->motion, now, order->to, order->speed * axis->slow, order->acceleration, t_ns);
		break;
	case SIM_AXIS_VELOCITY:
	case SIM_AXIS_STOP:
		plan_speed(&axis->motion, now, order->speed * axis->slow, order->acceleration, t_ns);
		break;
	case SIM_AXIS_FREE:
		forget_after(&axis->motion, t_ns);
		add(&axis->motion, *piece_of(&axis->demand, t_ns));
		break;
	default:
		break;
	}
}

void sim_axis_init(struct sim_axis *axis, double angle_rad, int64_t t_ns)
{
	memset(axis, 0, sizeof *axis);
	axis->slow = 1.0;
	sim_axis_place(axis, angle_rad, t_ns);
}

void sim_axis_goto(struct sim_axis *axis, double to_rad, double speed, double acceleration, int64_t t_ns)
{
	axis->order = (struct sim_axis_order){SIM_AXIS_GOTO, to_rad, speed, acceleration};
	plan_goto(&axis->demand, path_at(&axis->demand, t_ns), to_rad, speed, acceleration, t_ns);
	follow(axis, t_ns);
}

void sim_axis_velocity(struct sim_axis *axis, double speed, double acceleration, int64_t t_ns)
{
	axis->order = (struct sim_axis_order){SIM_AXIS_VELOCITY, 0.0, speed, acceleration};
	plan_speed(&axis->demand, path_at(&axis->demand, t_ns), speed, acceleration, t_ns);
	follow(axis, t_ns);
}

void sim_axis_track(struct sim_axis *axis, double to_rad, int64_t within_ns, double speed, double acceleration,
                    int64_t t_ns)
{
	struct at demand = path_at(&axis->demand, t_ns), motion = path_at(&axis->motion, t_ns);
	double asked, share;

	if (within_ns < 1)
		within_ns = 1;
	/* A set-point that comes a little late finds the axis standing for a moment: it had not stopped. */
	if (axis->order.kind == SIM_AXIS_TRACK && t_ns >= axis->tracked_ns && t_ns - axis->tracked_ns < within_ns)
		demand.v = motion.v = axis->tracked;
	axis->order = (struct sim_axis_order){SIM_AXIS_TRACK, to_rad, speed, acceleration};
	asked = plan_track(&axis->demand, demand, to_rad, within_ns, speed, acceleration, t_ns);
	axis->tracked = asked;
	axis->tracked_ns = t_ns + within_ns;
	if (axis->stuck)
		return;
	share = axis->slow < 1.0 ? fabs(asked) * axis->slow : speed;
	if (axis->slow < 1.0 && asked == 0.0)
		return; /* no limit of 0: that would be none */
	plan_track(&axis->motion, motion, to_rad, within_ns, share, acceleration, t_ns);
}

/* Whoever stops means where it is: what the demand was ahead is given up. */
void sim_axis_stop(struct sim_axis *axis, double deceleration, int64_t t_ns)
{
	axis->order = (struct sim_axis_order){SIM_AXIS_STOP, 0.0, 0.0, deceleration};
	plan_speed(&axis->demand, path_at(&axis->motion, t_ns), 0.0, deceleration, t_ns);
	follow(axis, t_ns);
}

void sim_axis_place(struct sim_axis *axis, double angle_rad, int64_t t_ns)
{
	axis->order = (struct sim_axis_order){.kind = SIM_AXIS_STAND};
	forget_after(&axis->demand, t_ns);
	forget_after(&axis->motion, t_ns);
	add_even(&axis->demand, t_ns, angle_rad, 0.0, 0.0);
	add_even(&axis->motion, t_ns, angle_rad, 0.0, 0.0);
}

static void swing(struct sim_axis *axis, struct sim_axis_piece piece)
{
	axis->order = (struct sim_axis_order){.kind = SIM_AXIS_FREE};
	forget_after(&axis->demand, piece.t_ns);
	add(&axis->demand, piece);
	follow(axis, piece.t_ns);
}

void sim_axis_sinus(struct sim_axis *axis, double from_rad, double to_rad, int64_t period_ns, int64_t t_ns)
{
	swing(axis, (struct sim_axis_piece){.t_ns = t_ns,
	                                    .kind = SIM_AXIS_SINUS,
	                                    .at = (from_rad + to_rad) / 2.0,
	                                    .speed = (to_rad - from_rad) / 2.0,
	                                    .acceleration = 2.0 * TRIG_PI / seconds(period_ns)});
}

void sim_axis_triangle(struct sim_axis *axis, double from_rad, double to_rad, double speed, double acceleration,
                       int64_t t_ns)
{
	double length = fabs(to_rad - from_rad);

	if (length == 0.0 || speed <= 0.0) {
		sim_axis_place(axis, from_rad, t_ns);
		return;
	}
	if (acceleration > 0.0)
		speed = fmin(speed, sqrt(acceleration * length));
	swing(axis, (struct sim_axis_piece){.t_ns = t_ns,
	                                    .kind = SIM_AXIS_TRIANGLE,
	                                    .at = from_rad,
	                                    .speed = speed,
	                                    .acceleration = acceleration,
	                                    .span = to_rad - from_rad});
}

void sim_axis_stuck(struct sim_axis *axis, bool on, int64_t t_ns)
{
	if (axis->stuck == on)
		return;
	axis->stuck = on;
	follow(axis, t_ns);
}

void sim_axis_slow(struct sim_axis *axis, double share, int64_t t_ns)
{
	axis->slow = share;
	follow(axis, t_ns);
}

bool sim_axis_follows(const struct sim_axis *axis)
{
	return !axis->stuck && axis->slow >= 1.0;
}

double sim_axis_angle(const struct sim_axis *axis, int64_t t_ns)
{
	return path_at(&axis->motion, t_ns).p;
}

double sim_axis_speed(const struct sim_axis *axis, int64_t t_ns)
{
	return path_at(&axis->motion, t_ns).v;
}

double sim_axis_demand(const struct sim_axis *axis, int64_t t_ns)
{
	return path_at(&axis->demand, t_ns).p;
}

int64_t sim_axis_arrival_ns(const struct sim_axis *axis)
{
	const struct sim_axis_path *path = &axis->demand;
	uint64_t oldest = path->pieces > SIM_AXIS_PIECES ? path->pieces - SIM_AXIS_PIECES : 0, i = path->pieces - 1;
	const struct sim_axis_piece *last = &path->piece[i % SIM_AXIS_PIECES], *before;

	if (last->kind != SIM_AXIS_EVEN || last->speed != 0.0 || last->acceleration != 0.0)
		return INT64_MAX;
	for (; i > oldest; i--) {
		before = &path->piece[(i - 1) % SIM_AXIS_PIECES];
		if (before->kind != SIM_AXIS_EVEN || before->speed != 0.0 || before->acceleration != 0.0)
			break;
	}
	return path->piece[i % SIM_AXIS_PIECES].t_ns;
}

bool sim_axis_arrived(const struct sim_axis *axis, int64_t t_ns)
{
	return sim_axis_arrival_ns(axis) <= t_ns;
}

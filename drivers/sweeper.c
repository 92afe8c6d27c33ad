/* Sweeping.
 *
 *   triangle   from -> to -> from ... at the same speed
 *   sinus      the same end points; the speed follows the sine's: w * sqrt(A^2 - (angle - middle)^2), never below a
 *              twentieth of its peak, so that the ends are reached
 *   step       from, from + step, ... to and back; each is left `settle` after it was reached
 *
 * A target is reached within a tenth of a degree, or where the servo stands still near it (its own dead band). Where it
 * stands still elsewhere, and never set out, the target is sent again, twice: a command may be lost. Then it is halted.
 *
 * Following error. How fast a servo speeds up and how long it thinks first is not known, so its angle must lie between
 * those of two models, by the tolerance `following`: a fast one, which has the full speed at once, and a slow one, which
 * thinks for DEAD_S and needs RAMP_S for its speed (or has the configured acceleration). A servo whose speed cannot be
 * told has no models: it must not leave the way between start and target by more than the tolerance, and not stand.
 *
 * A program that was itself stopped for a while, or heard nothing, has seen nothing, and a servo's watchdog may have
 * stopped it meanwhile: then it is told its target again.
 *
 * A cyclic drive gets the way itself: legs that end at a stand, with the configured acceleration (leg.h), and must be
 * within the tolerance of it. Its time makes steps of at most STEP_MAX_NS: after a pause of the program the set-point
 * goes on from where it was. */
#include "drivers/sweeper.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "core/trig.h"

#define LOOK_NS       50000000  /* how often the movement is looked at while nothing else happens */
#define IDLE_NS       500000000 /* the same without a sweep */
#define REACHED_RAD   (0.1 * TRIG_DEG)
#define NEAR_RAD      (1.0 * TRIG_DEG)
#define STILL_RAD     (0.02 * TRIG_DEG)
#define STILL_NS      200000000
#define STUCK_NS      1000000000
#define NUDGES_MAX    2
#define SINUS_FLOOR   0.05 /* of the peak speed */
#define SINUS_CHANGE  0.1  /* a new speed is sent when it differs by so much of the present one */
#define REST_GRACE_NS 2000000000
#define REST_MAX_S    60.0
#define SPEED_RAD_S   (10.0 * TRIG_DEG) /* where nothing says how fast it goes */
#define DEAD_S        0.2
#define RAMP_S        0.5
#define STEP_MAX_NS   50000000
#define PAUSE_NS      250000000 /* watchdogs are slower */
#define LEGS_MAX      16        /* begun in one step: shorter ones than a millisecond or three are held up */
#define HOLD_S        1e9
#define SAME_RAD      1e-9

void sweeper_init(struct sweeper *s, const struct config *config, int device, bool cyclic, bool has_speed)
{
	const struct config_device *servo = &config->device[device];
	const int64_t period_ns = servo->period_ns > servo->sync_ns ? servo->period_ns : servo->sync_ns;

	memset(s, 0, sizeof *s);
	s->sweeps = config->sweep.set && !strcmp(config->sweep.device, servo->name);
	s->cyclic = cyclic;
	s->has_speed = has_speed;
	s->from_rad = config->sweep.from_rad;
	s->to_rad = config->sweep.to_rad;
	s->peak_rad_s = config->sweep.speed_rad_s;
	s->step_rad = config->sweep.step_rad;
	s->rest_rad = config->sweep.rest_rad;
	s->has_rest = config->sweep.has_rest;
	s->profile = config->sweep.profile;
	s->settle_ns = config->sweep.settle_ns;
	s->acceleration_rad_s2 = servo->acceleration_rad_s2;
	s->following_rad = servo->following_rad;
	s->pause_ns = 3 * period_ns > PAUSE_NS ? 3 * period_ns : PAUSE_NS;
	s->config_limited = servo->has_limits;
	memcpy(s->config_limit_rad, servo->limits_rad, sizeof s->config_limit_rad);
	s->target_rad = s->from_rad;
}

bool sweeper_sweeps(const struct sweeper *s)
{
	return s->sweeps;
}

static double speed_of(const struct sweeper *s)
{
	return s->peak_rad_s > 0.0 ? s->peak_rad_s : SPEED_RAD_S;
}

static double acceleration_of(const struct sweeper *s)
{
	return s->acceleration_rad_s2 > 0.0 ? s->acceleration_rad_s2 : speed_of(s) / RAMP_S;
}

static double clamp(double v, double a, double b)
{
	double low = a < b ? a : b, high = a < b ? b : a;

	return v < low ? low : v > high ? high : v;
}

/* Seen to move since it took its target. */
static bool has_set_out(const struct sweeper *s)
{
	return fabs(s->angle_rad - s->start_rad) > NEAR_RAD;
}

/* Where a servo is told to stay: where it is. An angle may be nonsense, so outside of the sweep it is believed only of a
 * servo that was seen to set out, and to be between where it stood and its target: on its way in, or to rest. */
static double stay(const struct sweeper *s)
{
	bool way = s->told && has_set_out(s) && (s->angle_rad - s->start_rad) * (s->target_rad - s->angle_rad) >= 0.0;
	double angle = way ? s->angle_rad : clamp(s->angle_rad, s->from_rad, s->to_rad);

	return s->limited ? clamp(angle, s->limit_rad[0], s->limit_rad[1]) : angle;
}

static void go(struct sweeper *s, double target_rad)
{
	s->target_rad = target_rad;
	s->target_due = true;
	s->told = false;
	s->nudges = 0;
	s->settling = false;
}

static void plan(struct sweeper *s, struct leg leg)
{
	s->leg = leg;
	s->leg_s = 0.0;
}

/* ---- halts ---- */

/* What is on its way is braked. */
static void brake(struct sweeper *s)
{
	if (s->planned)
		plan(s, leg_brake(s->setpoint_rad, s->setpoint_rad_s, acceleration_of(s)));
}

void sweeper_halt(struct sweeper *s, const char *why)
{
	if (s->phase == SWEEPER_BROKEN || s->phase == SWEEPER_STOOD || !s->sweeps)
		return;
	s->phase = SWEEPER_BROKEN;
	snprintf(s->why, sizeof s->why, "%s", why);
	s->speed_due = s->target_due = s->told = false;
	brake(s);
}

/* The servo itself is well and would go on to its target: it is told to stay. */
static void halt_here(struct sweeper *s, const char *why)
{
	double angle = stay(s);

	sweeper_halt(s, why);
	if (s->cyclic)
		return;
	s->target_rad = angle;
	s->target_due = true;
}

static void halt_off(struct sweeper *s, double off_rad, const char *what, const char *todo)
{
	char text[sizeof s->why];

	snprintf(text, sizeof text, "is %.1f degrees %s; %s", off_rad / TRIG_DEG, what, todo);
	halt_here(s, text);
}

/* All that it may ever be sent to is judged before the first of it is sent. */
static void check_limits(struct sweeper *s)
{
	const double target[] = {s->from_rad, s->to_rad, s->has_rest ? s->rest_rad : s->from_rad};
	char text[sizeof s->why];

	if (!s->limited || s->phase != SWEEPER_SWEEPING)
		return;
	for (size_t i = 0; i < sizeof target / sizeof *target; i++) {
		if (target[i] >= s->limit_rad[0] && target[i] <= s->limit_rad[1])
			continue;
		snprintf(text, sizeof text,
		         "is to go to %.1f degrees, but its limits are %.1f and %.1f; correct `sweep`, or the limits",
		         target[i] / TRIG_DEG, s->limit_rad[0] / TRIG_DEG, s->limit_rad[1] / TRIG_DEG);
		if (s->angle_known)
			halt_here(s, text);
		else
			sweeper_halt(s, text);
		return;
	}
}

void sweeper_limits(struct sweeper *s, double min_rad, double max_rad)
{
	if (!(min_rad < max_rad))
		return;
	if (!s->limited || min_rad > s->limit_rad[0])
		s->limit_rad[0] = min_rad;
	if (!s->limited || max_rad < s->limit_rad[1])
		s->limit_rad[1] = max_rad;
	s->limited = true;
	check_limits(s);
}

void sweeper_begin(struct sweeper *s, int64_t t_ns)
{
	s->phase = s->sweeps ? SWEEPER_SWEEPING : SWEEPER_IDLE;
	s->why[0] = '\0';
	s->limited = s->config_limited;
	memcpy(s->limit_rad, s->config_limit_rad, sizeof s->limit_rad);
	s->angle_known = s->planned = s->towards_to = false;
	s->clock_ns = s->model_ns = s->taken_ns = s->looked_ns = t_ns;
	s->speed_rad_s = s->peak_rad_s;
	s->model_rad_s = 0.0;
	s->speed_due = s->sweeps && s->has_speed && s->peak_rad_s > 0.0;
	go(s, s->from_rad);
	s->target_due = s->sweeps;
	check_limits(s);
}

/* ---- following ---- */

/* The models go on to t_ns. */
static void advance_models(struct sweeper *s, int64_t t_ns)
{
	double sign = s->target_rad < s->start_rad ? -1.0 : 1.0, whole = fabs(s->target_rad - s->start_rad);
	double slow = sign * (s->slow_rad - s->start_rad), fast = sign * (s->fast_rad - s->start_rad);
	double a = acceleration_of(s), dt_s = (double)(t_ns - s->model_ns) * 1e-9, braked;

	if (t_ns <= s->model_ns)
		return;
	s->model_ns = t_ns;
	fast += s->model_rad_s * dt_s;
	s->fast_rad = s->start_rad + sign * (fast < whole ? fast : whole);
	if ((double)(t_ns - s->taken_ns) * 1e-9 < DEAD_S)
		return;
	if (dt_s > (double)STEP_MAX_NS * 1e-9)
		dt_s = (double)STEP_MAX_NS * 1e-9;
	braked = whole > slow ? sqrt(2.0 * a * (whole - slow)) : 0.0;
	s->slow_rad_s += a * dt_s;
	if (s->slow_rad_s > s->model_rad_s)
		s->slow_rad_s = s->model_rad_s;
	if (s->slow_rad_s > braked)
		s->slow_rad_s = braked;
	slow += s->slow_rad_s * dt_s;
	s->slow_rad = s->start_rad + sign * (slow < whole ? slow : whole);
}

static void judge_target(struct sweeper *s)
{
	double sign = s->target_rad < s->start_rad ? -1.0 : 1.0, way = sign * (s->angle_rad - s->start_rad);
	double ahead = sign * (s->angle_rad - s->fast_rad), behind = sign * (s->slow_rad - s->angle_rad);
	double beyond = sign * (s->angle_rad - s->target_rad);

	/* One that never set out is nudged. */
	bool lags = s->model_rad_s > 0.0 && behind > s->following_rad && has_set_out(s);

	if (-way > s->following_rad || (lags && way < 0.0))
		halt_off(s, -way, "farther from its target than it was", "check `sign`");
	else if (beyond > s->following_rad)
		halt_off(s, beyond, "beyond its target", "check `sign` and `scale`, or raise `following`");
	else if (s->model_rad_s > 0.0 && ahead > s->following_rad)
		halt_off(s, ahead, "ahead of where it should be", "check the scale of its speed, or raise `following`");
	else if (lags)
		halt_off(s, behind, "behind where it should be", "is it blocked? Or lower `sweep.speed`");
}

static void judge_setpoint(struct sweeper *s)
{
	double off = fabs(s->angle_rad - s->setpoint_rad);

	if (off > s->following_rad)
		halt_off(s, off, "off where it should be", "is it blocked? Or lower `sweep.speed`");
}

/* Nobody looked for a while. */
static void tell_again(struct sweeper *s)
{
	if (s->phase != SWEEPER_SWEEPING || !s->told)
		return;
	s->told = false;
	s->target_due = true;
}

void sweeper_angle(struct sweeper *s, double angle_rad, int64_t t_ns)
{
	if (!isfinite(angle_rad))
		return;
	if (s->angle_known && t_ns - s->angle_ns > s->pause_ns)
		tell_again(s);
	if (!s->angle_known || fabs(angle_rad - s->still_rad) > STILL_RAD) {
		s->still_rad = angle_rad;
		s->still_ns = t_ns;
	}
	s->angle_known = true;
	s->angle_rad = angle_rad;
	s->angle_ns = t_ns;
	if ((s->phase != SWEEPER_SWEEPING && s->phase != SWEEPER_STOPPING) || !(s->following_rad > 0.0))
		return;
	if (s->planned) {
		judge_setpoint(s);
	} else if (s->told && t_ns >= s->taken_ns) {
		advance_models(s, t_ns);
		judge_target(s);
	}
}

void sweeper_speed_taken(struct sweeper *s, double speed_rad_s, int64_t t_ns)
{
	if (s->told)
		advance_models(s, t_ns);
	s->model_rad_s = speed_rad_s;
	if (speed_rad_s == s->speed_rad_s)
		s->speed_due = false;
}

void sweeper_target_taken(struct sweeper *s, double target_rad, int64_t t_ns)
{
	if (!s->target_due || target_rad != s->target_rad)
		return;
	s->target_due = false;
	s->told = true;
	s->taken_ns = s->model_ns = t_ns;
	s->still_ns = t_ns;
	s->start_rad = s->slow_rad = s->fast_rad = s->angle_rad;
	s->slow_rad_s = 0.0;
}

/* ---- the next target ---- */

static bool has_reached(const struct sweeper *s, int64_t t_ns)
{
	double off_rad = fabs(s->angle_rad - s->target_rad);

	if (!s->angle_known || s->angle_ns < s->taken_ns)
		return false;
	return off_rad <= REACHED_RAD || (off_rad <= NEAR_RAD && t_ns - s->still_ns >= STILL_NS);
}

/* Where the step after `at_rad` leads; at an end it turns. */
static double step_after(struct sweeper *s, double at_rad)
{
	double end = s->towards_to ? s->to_rad : s->from_rad;

	if (fabs(end - at_rad) < SAME_RAD) {
		s->towards_to = !s->towards_to;
		end = s->towards_to ? s->to_rad : s->from_rad;
	}
	if (!(s->step_rad > 0.0) || fabs(end - at_rad) <= s->step_rad)
		return end;
	return end < at_rad ? at_rad - s->step_rad : at_rad + s->step_rad;
}

static double end_after(struct sweeper *s, double at_rad)
{
	s->towards_to = at_rad != s->to_rad;
	return s->towards_to ? s->to_rad : s->from_rad;
}

static void next_target(struct sweeper *s, int64_t t_ns)
{
	if (s->from_rad == s->to_rad)
		return; /* a sweep of no width: it stands */
	if (s->profile != SWEEP_STEP) {
		go(s, end_after(s, s->target_rad));
		return;
	}
	if (!s->settling) {
		s->settling = true;
		s->settled_ns = t_ns + s->settle_ns;
	}
	if (t_ns >= s->settled_ns)
		go(s, step_after(s, s->target_rad));
}

/* It was seen to stand: what was not looked at for a second may have moved. */
static void nudge(struct sweeper *s, int64_t t_ns)
{
	if (s->angle_ns - s->still_ns < STUCK_NS || t_ns - s->taken_ns < STUCK_NS || s->angle_ns < s->taken_ns)
		return;
	if (s->following_rad > 0.0 && ++s->nudges > NUDGES_MAX) {
		halt_here(s, "stands still and does not go where it is told; is it enabled, and free to move?");
		return;
	}
	s->taken_ns = t_ns;
	s->target_due = true;
}

static void follow_sinus(struct sweeper *s)
{
	double half = 0.5 * fabs(s->to_rad - s->from_rad), off = s->angle_rad - 0.5 * (s->from_rad + s->to_rad);
	double square = half * half - off * off, speed;

	if (half == 0.0 || !s->has_speed)
		return;
	speed = square > 0.0 ? s->peak_rad_s * sqrt(square) / half : 0.0;
	if (speed < SINUS_FLOOR * s->peak_rad_s)
		speed = SINUS_FLOOR * s->peak_rad_s;
	if (fabs(speed - s->speed_rad_s) <= SINUS_CHANGE * s->speed_rad_s)
		return;
	s->speed_rad_s = speed;
	s->speed_due = true;
}

/* Decides, from the angles seen so far, what is to be sent next. */
static void decide(struct sweeper *s, int64_t t_ns)
{
	if (s->told)
		advance_models(s, t_ns);
	if (s->target_due)
		return;
	if (s->phase == SWEEPER_STOPPING) {
		if (!s->has_rest || has_reached(s, t_ns))
			s->phase = SWEEPER_STOOD;
		return;
	}
	if (has_reached(s, t_ns))
		next_target(s, t_ns);
	else
		nudge(s, t_ns);
	if (s->profile == SWEEP_SINUS && s->phase == SWEEPER_SWEEPING)
		follow_sinus(s);
}

void sweeper_look(struct sweeper *s, int64_t t_ns, struct sweeper_wish *ret)
{
	bool moves = s->phase == SWEEPER_SWEEPING || s->phase == SWEEPER_STOPPING;

	if (t_ns - s->looked_ns > s->pause_ns)
		tell_again(s);
	s->looked_ns = t_ns;
	if (moves && s->angle_known && !s->cyclic)
		decide(s, t_ns);
	if (s->phase == SWEEPER_STOPPING && t_ns >= s->stop_by_ns)
		s->phase = SWEEPER_STOOD;
	*ret = (struct sweeper_wish){.state = s->phase == SWEEPER_BROKEN  ? SWEEPER_HALTED
	                                      : s->phase == SWEEPER_STOOD ? SWEEPER_DONE
	                                                                  : SWEEPER_RUNS,
	                             .speed_rad_s = s->speed_rad_s,
	                             .target_rad = s->target_rad,
	                             .deadline_ns = t_ns + (s->sweeps ? LOOK_NS : IDLE_NS),
	                             .why = s->why};
	if (s->settling && s->settled_ns > t_ns && s->settled_ns < ret->deadline_ns)
		ret->deadline_ns = s->settled_ns;
	if (s->cyclic || !s->angle_known || s->phase == SWEEPER_IDLE || s->phase == SWEEPER_STOOD)
		return;
	ret->speed = s->speed_due;
	ret->target = s->target_due;
}

/* ---- cyclic ---- */

/* A leg is over: what comes after it. */
static struct leg next_leg(struct sweeper *s)
{
	double at = s->leg.to_rad, speed = speed_of(s), a = acceleration_of(s);

	if (s->phase == SWEEPER_STOPPING && s->has_rest && at != s->rest_rad)
		return leg_ramps(at, s->rest_rad, speed, a);
	if (s->phase != SWEEPER_SWEEPING || s->from_rad == s->to_rad)
		return leg_hold(at, HOLD_S);
	if (s->profile != SWEEP_STEP) {
		s->target_rad = end_after(s, at);
		return s->profile == SWEEP_SINUS ? leg_sinus(at, s->target_rad, speed, a)
		                                 : leg_ramps(at, s->target_rad, speed, a);
	}
	if (s->leg.kind != LEG_HOLD && s->settle_ns > 0)
		return leg_hold(at, (double)s->settle_ns * 1e-9);
	s->target_rad = step_after(s, at);
	return leg_ramps(at, s->target_rad, speed, a);
}

static void begin_way(struct sweeper *s, int64_t t_ns)
{
	s->planned = true;
	s->clock_ns = t_ns;
	s->setpoint_rad = s->angle_rad;
	s->setpoint_rad_s = 0.0;
	plan(s, leg_ramps(s->angle_rad, s->from_rad, speed_of(s), acceleration_of(s)));
}

/* It stands at its last set-point, or has had the time for it. */
static void end_way(struct sweeper *s)
{
	bool over = s->leg.kind == LEG_HOLD && s->leg.lasts_s == HOLD_S;

	if (s->phase == SWEEPER_STOPPING && over && fabs(s->angle_rad - s->setpoint_rad) <= NEAR_RAD)
		s->phase = SWEEPER_STOOD;
}

bool sweeper_setpoint(struct sweeper *s, int64_t t_ns, double *ret_rad, double *ret_rad_s)
{
	int64_t step_ns;

	if (s->phase == SWEEPER_IDLE || !s->angle_known || (!s->planned && s->phase != SWEEPER_SWEEPING))
		return false;
	if (!s->planned)
		begin_way(s, t_ns);
	step_ns = t_ns - s->clock_ns;
	if (step_ns > 0) {
		s->leg_s += (double)(step_ns < STEP_MAX_NS ? step_ns : STEP_MAX_NS) * 1e-9;
		s->clock_ns = t_ns;
	}
	for (int i = 0; i < LEGS_MAX && s->leg_s >= s->leg.lasts_s; i++) {
		double left_s = s->leg_s - s->leg.lasts_s;

		plan(s, next_leg(s));
		s->leg_s = left_s;
	}
	s->setpoint_rad = leg_at(&s->leg, s->leg_s, &s->setpoint_rad_s);
	end_way(s);
	*ret_rad = s->setpoint_rad;
	*ret_rad_s = s->setpoint_rad_s;
	return true;
}

/* ---- the end ---- */

static void stop_by(struct sweeper *s, int64_t t_ns)
{
	double way_s = s->has_rest ? fabs(s->angle_rad - s->rest_rad) / speed_of(s) : 0.0;

	if (!(way_s < REST_MAX_S)) /* a float register may say any angle */
		way_s = REST_MAX_S;
	s->stop_by_ns = t_ns + REST_GRACE_NS + (int64_t)(way_s * 1e9);
}

void sweeper_stop(struct sweeper *s, int64_t t_ns)
{
	if (s->phase == SWEEPER_STOPPING || s->phase == SWEEPER_STOOD)
		return;
	if (s->phase != SWEEPER_SWEEPING || !s->angle_known || (s->cyclic && !s->planned)) {
		s->phase = SWEEPER_STOOD;
		return;
	}
	s->phase = SWEEPER_STOPPING;
	stop_by(s, t_ns);
	if (s->cyclic) {
		brake(s);
		return;
	}
	s->speed_due = s->has_speed && s->speed_rad_s != s->peak_rad_s;
	s->speed_rad_s = s->peak_rad_s;
	go(s, s->has_rest ? s->rest_rad : stay(s));
}

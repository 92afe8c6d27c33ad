/* Legs: see leg.h. All of them are closed formulas of time, so nothing adds up over hours. */
#include "drivers/leg.h"

#include <math.h>

#include "core/trig.h"

struct leg leg_hold(double at_rad, double lasts_s)
{
	return (struct leg){.kind = LEG_HOLD, .from_rad = at_rad, .to_rad = at_rad, .lasts_s = lasts_s};
}

/* A way too short to reach the speed is sped up over its first half and slowed down over its second. */
struct leg leg_ramps(double from_rad, double to_rad, double speed_rad_s, double acceleration_rad_s2)
{
	double way = fabs(to_rad - from_rad), reachable = sqrt(way * acceleration_rad_s2);
	struct leg leg = {.kind = LEG_RAMPS,
	                  .from_rad = from_rad,
	                  .to_rad = to_rad,
	                  .speed_rad_s = reachable < speed_rad_s ? reachable : speed_rad_s,
	                  .acceleration_rad_s2 = acceleration_rad_s2};

	if (leg.speed_rad_s > 0.0)
		leg.lasts_s = way / leg.speed_rad_s + leg.speed_rad_s / acceleration_rad_s2;
	return leg;
}

/* angle = middle - A cos(w t): its speed is at most A w, its acceleration at most A w^2. */
struct leg leg_sinus(double from_rad, double to_rad, double peak_rad_s, double acceleration_rad_s2)
{
	double half = 0.5 * fabs(to_rad - from_rad), softest = sqrt(half * acceleration_rad_s2);
	struct leg leg = {.kind = LEG_SINUS,
	                  .from_rad = from_rad,
	                  .to_rad = to_rad,
	                  .speed_rad_s = softest < peak_rad_s ? softest : peak_rad_s,
	                  .acceleration_rad_s2 = acceleration_rad_s2};

	if (leg.speed_rad_s > 0.0)
		leg.lasts_s = TRIG_PI * half / leg.speed_rad_s;
	return leg;
}

struct leg leg_brake(double from_rad, double speed_rad_s, double acceleration_rad_s2)
{
	return (struct leg){.kind = LEG_BRAKE,
	                    .from_rad = from_rad,
	                    .to_rad = from_rad + 0.5 * speed_rad_s * fabs(speed_rad_s) / acceleration_rad_s2,
	                    .speed_rad_s = speed_rad_s,
	                    .acceleration_rad_s2 = acceleration_rad_s2,
	                    .lasts_s = fabs(speed_rad_s) / acceleration_rad_s2};
}

/* How far it is after t of a leg with ramps; the second half is the first one seen from the end. */
static double ramps_way(const struct leg *leg, double t_s, double *ret_speed)
{
	double a = leg->acceleration_rad_s2, ramp_s = leg->speed_rad_s / a;

	if (t_s < ramp_s) {
		*ret_speed = a * t_s;
		return 0.5 * a * t_s * t_s;
	}
	*ret_speed = leg->speed_rad_s;
	return leg->speed_rad_s * (t_s - 0.5 * ramp_s);
}

static double ramps_at(const struct leg *leg, double t_s, double *ret_speed)
{
	double left_s = leg->lasts_s - t_s, sign = leg->to_rad < leg->from_rad ? -1.0 : 1.0, angle;

	if (t_s <= left_s)
		angle = leg->from_rad + sign * ramps_way(leg, t_s, ret_speed);
	else
		angle = leg->to_rad - sign * ramps_way(leg, left_s, ret_speed);
	*ret_speed *= sign;
	return angle;
}

static double sinus_at(const struct leg *leg, double t_s, double *ret_speed)
{
	double half = 0.5 * (leg->to_rad - leg->from_rad), phase = TRIG_PI * t_s / leg->lasts_s;

	*ret_speed = half * TRIG_PI / leg->lasts_s * trig_sin(phase);
	return leg->from_rad + half * (1.0 - trig_cos(phase));
}

static double brake_at(const struct leg *leg, double t_s, double *ret_speed)
{
	double sign = leg->speed_rad_s < 0.0 ? -1.0 : 1.0, left_s = leg->lasts_s - t_s;

	*ret_speed = sign * leg->acceleration_rad_s2 * left_s;
	return leg->to_rad - sign * 0.5 * leg->acceleration_rad_s2 * left_s * left_s;
}

double leg_at(const struct leg *leg, double t_s, double *ret_rad_s)
{
	*ret_rad_s = 0.0;
	if (t_s <= 0.0)
		return leg->from_rad;
	if (t_s >= leg->lasts_s)
		return leg->to_rad;
	switch (leg->kind) {
	case LEG_RAMPS:
		return ramps_at(leg, t_s, ret_rad_s);
	case LEG_SINUS:
		return sinus_at(leg, t_s, ret_rad_s);
	case LEG_BRAKE:
		return brake_at(leg, t_s, ret_rad_s);
	default:
		return leg->from_rad;
	}
}

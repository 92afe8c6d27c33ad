/* One axis of a simulated robot: the physical thing behind every simulated servo, encoder and inclinometer.
 *
 *   drive -- goto, velocity, track, stop --> demand: what its profile generator asks for
 *                                              | mechanics: stuck, slow
 *                                              v
 *   scene, encoders <-- angle, speed at t -- true motion
 *
 * Both motions are rows of pieces, each a closed form from its time on: of constant acceleration, or a swing. Nothing is
 * advanced: where it stands is a function of time, also of times to come if nobody commands anything else, and of the
 * past as far as the last SIM_AXIS_PIECES pieces reach. A command at t forgets what was planned after t; commands come
 * in the order of their times. rad, rad/s, rad/s^2; an acceleration of 0 is infinite: speeds change at once. */
#ifndef FACET_TOOLS_SIM_AXIS_H
#define FACET_TOOLS_SIM_AXIS_H

#include <stdbool.h>
#include <stdint.h>

#define SIM_AXIS_PIECES 2048 /* a power of two; older motion is forgotten (its oldest piece answers for it) */

struct sim_axis_piece {
	int64_t t_ns;
	enum { SIM_AXIS_EVEN, SIM_AXIS_SINUS, SIM_AXIS_TRIANGLE } kind;
	double at, speed, acceleration; /* at t_ns; sinus: centre, amplitude, rad of phase per second */
	double span;                    /* triangle: from `at` so far and back, signed */
};

struct sim_axis_path {
	struct sim_axis_piece piece[SIM_AXIS_PIECES];
	uint64_t pieces; /* ever begun */
};

/* In the caller's memory; its fields are nobody else's business. No locks: its owner has one if it has threads. */
struct sim_axis {
	struct sim_axis_path demand, motion;
	struct sim_axis_order {
		enum {
			SIM_AXIS_STAND,
			SIM_AXIS_GOTO,
			SIM_AXIS_VELOCITY,
			SIM_AXIS_TRACK,
			SIM_AXIS_STOP,
			SIM_AXIS_FREE
		} kind;
		double to, speed, acceleration;
	} order;            /* the last one, for mechanics that come free again */
	double tracked;     /* demand's speed towards the last set-point ... */
	int64_t tracked_ns; /* ... which it reaches then */
	bool stuck;
	double slow; /* share of the commanded speed that it makes */
};

void sim_axis_init(struct sim_axis *, double angle_rad, int64_t t_ns);

/* To an angle with at most `speed`, in a trapezoid from whatever it does now. */
void sim_axis_goto(struct sim_axis *, double to_rad, double speed, double acceleration, int64_t t_ns);
/* For ever, until something else comes. */
void sim_axis_velocity(struct sim_axis *, double speed, double acceleration, int64_t t_ns);
/* A set-point to be reached `within_ns` from now, in a straight line as far as the limits allow (speed 0: none); the axis
 * stands there when the next one does not come. */
void sim_axis_track(struct sim_axis *, double to_rad, int64_t within_ns, double speed, double acceleration,
                    int64_t t_ns);
void sim_axis_stop(struct sim_axis *, double deceleration, int64_t t_ns);
/* It stands there, by magic: recorded sweeps being played. */
void sim_axis_place(struct sim_axis *, double angle_rad, int64_t t_ns);
/* Moved by something else, for devices that are only read: between two angles for ever. It jumps to its begin: `from`;
 * the sinus begins at its centre and goes towards `to`. The triangle's turns are rounded by the acceleration. */
void sim_axis_sinus(struct sim_axis *, double from_rad, double to_rad, int64_t period_ns, int64_t t_ns);
void sim_axis_triangle(struct sim_axis *, double from_rad, double to_rad, double speed, double acceleration,
                       int64_t t_ns);

/* Faults of the mechanics: the demand goes on, the axis does not follow. Free again it goes on towards the demand. */
void sim_axis_stuck(struct sim_axis *, bool on, int64_t t_ns);
void sim_axis_slow(struct sim_axis *, double share, int64_t t_ns); /* 0 < share <= 1; 1: all is well */

bool sim_axis_follows(const struct sim_axis *); /* neither stuck nor slow */

double sim_axis_angle(const struct sim_axis *, int64_t t_ns); /* true */
double sim_axis_speed(const struct sim_axis *, int64_t t_ns);
double sim_axis_demand(const struct sim_axis *, int64_t t_ns); /* where it should be */
bool sim_axis_arrived(const struct sim_axis *, int64_t t_ns);  /* the demand stands from t_ns on */
int64_t sim_axis_arrival_ns(const struct sim_axis *);          /* since when, or from when on; INT64_MAX: never */

#endif

/* What a commanded servo is to do when: pure, in the caller's time, the same for every bus.
 *
 * Servos that move by themselves to a target are told one now and then:
 *
 *   sweeper_begin ─► sweeper_angle ... sweeper_look ─► wish {speed, target} ─ the driver sends, the servo takes ─►
 *   sweeper_speed_taken, sweeper_target_taken ─► ... ─► sweeper_stop ─► look until DONE
 *
 * Servos that follow a set-point every few milliseconds (`cyclic`) get it from sweeper_setpoint, and sweeper_look then
 * wishes for nothing but says how it stands. A drive that is told speeds only adds a part of what it is behind to the
 * set-point's speed.
 *
 * No target and no set-point ever lies outside the limits, nor outside from..to but for the rest angle and for a servo that
 * is to stay where it is on its way from or to there. A sweep that is halted
 * stays so until sweeper_begin: angles go on being read, nothing more is wished for. */
#ifndef FACET_DRIVERS_SWEEPER_H
#define FACET_DRIVERS_SWEEPER_H

#include "config/config.h"
#include "drivers/leg.h"

enum sweeper_state {
	SWEEPER_RUNS,
	/* What was wrong is `why`. A servo that cannot be stopped otherwise is sent one last target, where it stands. */
	SWEEPER_HALTED,
	SWEEPER_DONE /* after sweeper_stop: it stands at the rest angle, or has had the time for it */
};

struct sweeper_wish {
	enum sweeper_state state;
	bool speed, target; /* to be sent now, the speed first; repeated until taken */
	double speed_rad_s; /* always positive */
	double target_rad;
	int64_t deadline_ns; /* look again at the latest then */
	const char *why; /* HALTED: one sentence, without the device's name; else empty. Lives as long as the sweeper */
};

/* By value; its members are its own business. */
struct sweeper {
	bool sweeps, cyclic, has_speed;
	double from_rad, to_rad, peak_rad_s, step_rad, rest_rad;
	bool has_rest;
	int profile; /* SWEEP_TRIANGLE ... */
	int64_t settle_ns;
	double acceleration_rad_s2; /* 0: not known */
	double following_rad;
	int64_t
	    pause_ns; /* without a look or an angle for so long, the servo may have stopped by its own supervision */
	bool config_limited;
	double config_limit_rad[2]; /* of the configuration ... */
	bool limited;
	double limit_rad[2]; /* ... and with those that were learned since begin */

	enum { SWEEPER_IDLE, SWEEPER_SWEEPING, SWEEPER_STOPPING, SWEEPER_STOOD, SWEEPER_BROKEN } phase;
	char why[120];
	bool speed_due, target_due;
	double speed_rad_s, target_rad;
	bool towards_to;
	bool settling;
	int64_t settled_ns, stop_by_ns;

	bool angle_known;
	double angle_rad, still_rad;
	int64_t angle_ns, still_ns; /* it has stood near still_rad since still_ns */
	int64_t looked_ns;

	/* The target it has taken, and between where a slow servo would be by now and a fast one. */
	bool told;
	int64_t taken_ns;
	int nudges;
	double start_rad; /* where it stood when it took it */
	double slow_rad, slow_rad_s, fast_rad;
	double model_rad_s; /* the speed that it has taken */
	int64_t model_ns;

	/* Cyclic: the way, in a time of its own that makes no large steps. */
	bool planned;
	int64_t clock_ns; /* of the last set-point */
	double leg_s;     /* since the leg began */
	struct leg leg;
	double setpoint_rad, setpoint_rad_s;
};

/* `device`: index of the servo. `cyclic`: it will be led by set-points. `has_speed`: it can be told a speed. */
void sweeper_init(struct sweeper *, const struct config *, int device, bool cyclic, bool has_speed);

/* Is this the servo of `sweep`? If not, nothing is ever wished for. */
bool sweeper_sweeps(const struct sweeper *);

/* The servo stands ready (enabled, homed): it begins from wherever it is, as soon as an angle after this is known. What
 * was halted is forgotten; so are limits that were learned. */
void sweeper_begin(struct sweeper *, int64_t t_ns);

/* Limits that the drive has itself; they narrow the configured ones. */
void sweeper_limits(struct sweeper *, double min_rad, double max_rad);

/* An angle that was true at t_ns. */
void sweeper_angle(struct sweeper *, double angle_rad, int64_t t_ns);

/* What is to be done now. Before sweeper_begin: nothing, RUNS. */
void sweeper_look(struct sweeper *, int64_t t_ns, struct sweeper_wish *ret);

/* The servo took what was sent; something older than the present wish counts for nothing. */
void sweeper_speed_taken(struct sweeper *, double speed_rad_s, int64_t t_ns);
void sweeper_target_taken(struct sweeper *, double target_rad, int64_t t_ns);

/* Cyclic: the set-point of t_ns and its speed (signed); continuous, whatever the pauses between calls, and no faster and
 * no harder than configured. False: no angle is known yet, or nothing was begun; the results are then untouched. */
bool sweeper_setpoint(struct sweeper *, int64_t t_ns, double *ret_rad, double *ret_rad_s);

/* The drive has a fault, or was taken away: the sweep is over until sweeper_begin. The first reason stays. */
void sweeper_halt(struct sweeper *, const char *why);

/* Orderly end: to the rest angle, or to a stand where it is. A sweep that is halted or never began is done at once. */
void sweeper_stop(struct sweeper *, int64_t t_ns);

#endif

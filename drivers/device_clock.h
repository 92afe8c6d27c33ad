/* Device time -> log time, for every device that stamps: SICK's microseconds since start-up, a counter of scans.
 *
 * A stamp is taken when the device sends (or measures), the arrival lies a delay behind it, and delays are only ever
 * positive: the least delayed arrivals lie on a line, offset + drift, which the filter keeps as the lower envelope of
 * (arrival - device time). Pure. Starts anew where the device's time steps (power cycle) or nothing came for long; a step
 * of the host's wall clock does not concern it, log time has none.
 *
 *   arrival - device |   x    x      x             x
 *                    |_x____x___x_x____x__x__x______x___  envelope: offset(t), slope = drift, up to some hundred ppm
 */
#ifndef FACET_DRIVERS_DEVICE_CLOCK_H
#define FACET_DRIVERS_DEVICE_CLOCK_H

#include <stdbool.h>
#include <stdint.h>

#include "core/state.h"
#include "drivers/jitter.h"

#define DEVICE_CLOCK_POINTS 64 /* of the envelope */

struct device_clock {
	/* What kind of clock it is. */
	double tick_ns;   /* nominal */
	uint64_t wrap;    /* ticks after which it counts from 0 again */
	double drift_max; /* ratio, e.g. 500e-6 for a crystal, 0.02 for a mirror */

	bool started;
	int64_t ticks;         /* of the newest stamp that was believed, unwrapped */
	int64_t born_ticks;    /* of the first */
	int64_t believed_ns;   /* arrival of the newest that was believed */
	int64_t arrival_ns;    /* of the newest */
	uint32_t answered;     /* the newest, as read ... */
	int64_t answered_ns;   /* ... and what was answered */
	bool answers;          /* anything was, ever */
	int64_t interval_tick; /* every so many ticks have one point, the least delayed */
	/* Points of the envelope, oldest first. */
	struct device_clock_point {
		int64_t ticks, delay_ns; /* unwrapped; arrival - ticks * tick_ns */
	} point[DEVICE_CLOCK_POINTS];
	int points;
	double slope; /* the envelope: through this point, host ns - device ns per device ns */
	struct device_clock_point touches;

	bool doubted; /* stamps came that do not fit: another time, or rubbish? */
	int64_t doubt_since_ns, doubt_run_ns, doubt_ns;
	int64_t doubt_ticks, doubt_least_ns, doubt_most_ns;

	int64_t offset_ns;    /* log time - device time, at `ticks` */
	double drift;         /* device ns per host ns - 1 */
	int restarts;         /* steps of the device's time */
	struct jitter jitter; /* arrivals behind the envelope: for the status, not in the snapshot */
};

/* tick_ns 1 .. 1e9, wrap 2 .. 2^32 (together 1e18 ns at most), drift_max up to 0.1. */
void device_clock_init(struct device_clock *, double tick_ns, uint64_t wrap, double drift_max);

/* A stamp `tick` arrived at `arrival_ns` (log time). Answers the log time of the stamp: never later than the arrival and
 * later than the answer before (by a nanosecond where both cannot be: a backlog that comes first of all); within 0.3 ms
 * of the truth plus the least delay once it has seen 5 s (200 ppm, delays of some ms). */
int64_t device_clock_stamp(struct device_clock *, uint32_t tick, int64_t arrival_ns);

/* Log time of another stamp of the same device near the last one, e.g. when a scan began. */
int64_t device_clock_at(const struct device_clock *, uint32_t tick);

/* Percentiles of how late arrivals were, ns; 0 before anything came. */
void device_clock_jitter(const struct device_clock *, int64_t *ret_p50_ns, int64_t *ret_p99_ns);

void device_clock_restart(struct device_clock *); /* what was learned is forgotten (the link was opened anew) */
/* A load that failed changes nothing. */
void device_clock_state(struct state *, struct device_clock *);

#endif

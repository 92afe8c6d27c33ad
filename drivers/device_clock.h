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

#define DEVICE_CLOCK_POINTS 64   /* of the envelope */
#define DEVICE_CLOCK_DELAYS 1024 /* the newest, for the percentiles of jitter */

struct device_clock {
	/* What kind of clock it is. */
	double tick_ns;   /* nominal */
	uint64_t wrap;    /* ticks after which it counts from 0 again */
	double drift_max; /* ratio, e.g. 500e-6 for a crystal, 0.02 for a mirror */

	bool started;
	uint32_t last_tick; /* as read */
	int64_t ticks;      /* unwrapped, since it started */
	int64_t first_ns, last_arrival_ns, last_ns;
	/* Points of the envelope, oldest first: the implementation's own (see device_clock.c). */
	struct device_clock_point {
		int64_t ticks, delay_ns;
	} point[DEVICE_CLOCK_POINTS];
	int points;
	double drift;      /* device ns per host ns - 1 */
	int64_t offset_ns; /* at `ticks` */
	int restarts;
	int32_t delay_us[DEVICE_CLOCK_DELAYS]; /* ring: arrivals behind the envelope */
	uint64_t delays;
};

void device_clock_init(struct device_clock *, double tick_ns, uint64_t wrap, double drift_max);

/* A stamp `tick` arrived at `arrival_ns` (log time). Answers the log time of the stamp: never later than the arrival;
 * within 0.3 ms of the truth plus the least delay once it has seen 5 s (200 ppm, delays of some ms). */
int64_t device_clock_stamp(struct device_clock *, uint32_t tick, int64_t arrival_ns);

/* Log time of another stamp of the same device near the last one, e.g. when a scan began. */
int64_t device_clock_at(const struct device_clock *, uint32_t tick);

/* Percentiles of how late arrivals were, ns; 0 before anything came. */
void device_clock_jitter(const struct device_clock *, int64_t *ret_p50_ns, int64_t *ret_p99_ns);

void device_clock_restart(struct device_clock *); /* what was learned is forgotten (the link was opened anew) */
void device_clock_state(struct state *, struct device_clock *);

#endif

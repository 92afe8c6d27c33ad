/* Arrival stamps -> measuring times: the lower envelope over a device's period (design 1; protocols A.9, B.5).
 * A backlog read at once is then not one instant. Pure; 200 ppm of drift between the clocks is followed. */
#ifndef FACET_DRIVERS_CLOCK_FILTER_H
#define FACET_DRIVERS_CLOCK_FILTER_H

#include <stdbool.h>
#include <stdint.h>

#include "core/state.h"

#define CLOCK_FILTER_PHASES 8

struct clock_filter {
	int64_t period_ns; /* of the mirror: telegrams end a whole number of these apart */
	bool started;
	int64_t last_ns; /* filtered time of the last arrival; the grid of possible times is this plus whole periods */
	int64_t last_arrival_ns;
	int steady;   /* telegrams running that followed without a gap */
	int late;     /* telegrams running that came a period or more after their time */
	int patience; /* so many of those mean that one was lost; more where arrivals are ragged */
	int calm;     /* telegrams since arrivals were ragged */
	bool lost;    /* the caller saw one being lost since the last */
	/* A stream with gaps: how far the last arrivals were behind the grid, 0 .. period. */
	int64_t phase_ns[CLOCK_FILTER_PHASES];
	int phases, oldest;
	/* A steady stream: the least delays of this and the previous run of telegrams. */
	int64_t least_ns[2];
	int counted;
};

void clock_filter_init(struct clock_filter *, int64_t period_ns);

/* Filtered time of a telegram that arrived at `arrival_ns` and took `turns` periods (1, 2, 4) to measure. Strictly
 * increasing and never later than the arrival (but by a nanosecond, where several arrive at once and nothing is known
 * yet); `turns` periods or more apart, less what a telegram that was quicker than all before it shows of their delay.
 * Starts anew after a gap of 2 s. */
int64_t clock_filter_stamp(struct clock_filter *, int64_t arrival_ns, int turns);

/* A telegram was lost since the last one, or may have been (bytes came that made none): if the next is late, that is why. */
void clock_filter_lost(struct clock_filter *);

void clock_filter_state(struct state *, struct clock_filter *); /* a load that failed changes nothing */

#endif

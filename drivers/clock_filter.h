/* Arrival stamps -> measuring times: the lower envelope over a device's period (design 1; protocols A.9, B.5).
 * A backlog read at once is then not one instant. Pure; 200 ppm of drift between the clocks is followed. */
#ifndef FACET_DRIVERS_CLOCK_FILTER_H
#define FACET_DRIVERS_CLOCK_FILTER_H

#include <stdbool.h>
#include <stdint.h>

struct clock_filter {
	int64_t period_ns;     /* of the mirror: telegrams end a whole number of these apart */
	bool started;
	int64_t last_ns;       /* filtered time of the last arrival */
	int64_t envelope_ns;   /* phase: how much later than the least delayed arrival the grid stands; see .c */
	int64_t last_arrival_ns;
};

void clock_filter_init(struct clock_filter *, int64_t period_ns);

/* Filtered time of a telegram that arrived at `arrival_ns` and took `turns` periods (1, 2, 4) to measure. Strictly increasing by
 * at least `turns` periods within a stream; never later than the arrival; starts anew after a gap of 2 s. */
int64_t clock_filter_stamp(struct clock_filter *, int64_t arrival_ns, int turns);

#endif

/* From the clocks of a kernel or a thread to log time, the loop's clock.
 *
 * Log time is CLOCK_MONOTONIC plus a constant that nobody says. It is learned: the loop hands its time to each read, which
 * was taken a little before, so the difference is never too large, and the largest one seen is the constant.
 *
 * Kernels stamp with CLOCK_REALTIME, which somebody may set between the stamp and the read. Its distance to CLOCK_MONOTONIC
 * changes by such steps only, so the last two distances are kept: a stamp is taken by the newer one unless it would then
 * lie in the future, or before all that can still have waited to be read, and by the older one makes sense. */
#ifndef FACET_DRIVERS_LOOP_CLOCK_H
#define FACET_DRIVERS_LOOP_CLOCK_H

#include <stdbool.h>
#include <stdint.h>

#define LOOP_CLOCK_EARLY_NS 10000000 /* between its stamp and its reader's queue a frame may take so long */

struct loop_clock {
	bool known, wall_known;
	int64_t offset_ns;                /* the loop's clock - CLOCK_MONOTONIC */
	int64_t wall_ns, wall_before_ns;  /* CLOCK_REALTIME - CLOCK_MONOTONIC, now and before its last step */
	int64_t within_ns;                /* how far `wall_ns` may be off */
	int64_t monotonic_ns, drained_ns; /* CLOCK_MONOTONIC: of the last look, and when nothing was left to read */
};

struct loop_clock_look { /* what a look at the clocks saw */
	int64_t loop_ns;
	int64_t monotonic_ns, wall_ns;
	int64_t within_ns; /* the two were read within so long */
};

/* A link was opened: nothing older comes. */
void loop_clock_start(struct loop_clock *);

/* Pure. */
void loop_clock_take(struct loop_clock *, const struct loop_clock_look *);
int64_t loop_clock_of_monotonic(const struct loop_clock *, int64_t monotonic_ns);
int64_t loop_clock_of_wall(const struct loop_clock *, int64_t wall_ns); /* never after the last look */
void loop_clock_drained(struct loop_clock *);                           /* at the last look: all that waited was read */

/* Looks at the clocks of this machine, after the read of what is to be converted; log time of the look. */
int64_t loop_clock_look(struct loop_clock *, int64_t loop_ns);

#endif

/* The two clocks of the host, and how far they are apart. For the loop and for simulated devices: nobody else reads one. */
#ifndef FACET_DAEMON_WALL_CLOCK_H
#define FACET_DAEMON_WALL_CLOCK_H

#include <stdbool.h>
#include <stdint.h>
#include <time.h>

int64_t wall_clock_read(clockid_t);

/* CLOCK_REALTIME - CLOCK_MONOTONIC, ns. False: the machine did something else between the looks; what was seen is written
 * all the same, look again later. */
bool wall_clock_offset(int64_t *ret_ns);

/* The same, patiently: for a start. */
int64_t wall_clock_first_offset(void);

#endif

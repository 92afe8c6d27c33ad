/* Orders of faults to running simulators: from the command line, and by a unix socket that takes one sentence or one JSON
 * object a line and answers each with one line.
 *
 *   laser: unplug for 2s                           ok
 *   status                                         laser: profiles 120, sent 117, ...
 *   {"fault": "laser: unplug for 2s"}              {"ok": true}
 *   {"status": true}                               {"ok": true, "status": "laser: ..."}
 *   laser: smoke                                   error: 'smoke': laser has no such fault; it has ...
 */
#ifndef FACET_TOOLS_SIM_CONTROL_H
#define FACET_TOOLS_SIM_CONTROL_H

#include "tools/fault.h"

#define SIM_CONTROL_STATUS_MAX 1000

struct sim_control_params {
	const char *socket;                /* path; replaced when it is a socket that nobody listens on */
	const struct fault_target *target; /* borrowed for the control's life */
	int targets;
	void *ctx;
	bool (*order)(void *ctx, const struct sim_fault *, bool on);
	void (*status)(void *ctx, char ret[SIM_CONTROL_STATUS_MAX]); /* one line */
};

struct sim_control;
/* NULL with one sentence. Times of command line orders count from here. */
struct sim_control *sim_control_create(uv_loop_t *, const struct sim_control_params *, char error[FAULT_ERROR_MAX]);
void sim_control_destroy(struct sim_control *); /* removes the socket; the loop must run once more */
/* A sentence, whose `at` counts from the beginning. 0 or -errno with one sentence. */
int sim_control_order(struct sim_control *, const char *sentence, char error[FAULT_ERROR_MAX]);

#endif

/* What moves in a scenario: the tilt axis with the servo on it, behind Modbus or on a CAN bus, and the robot's wheels. */
#ifndef FACET_TOOLS_SCENARIO_MOTION_H
#define FACET_TOOLS_SCENARIO_MOTION_H

#include "tools/fault.h"
#include "tools/scenario.h"

#define SCENARIO_MOTION_TARGETS 3

struct scenario_motion;
/* NULL with one sentence. The parameters and the stage are borrowed for its life. */
struct scenario_motion *scenario_motion_create(uv_loop_t *, const struct scenario_params *, const struct stage *,
                                               char error[SCENARIO_ERROR_MAX]);
void scenario_motion_destroy(struct scenario_motion *); /* the loop must run once more */
struct stage_axis scenario_motion_axis(struct scenario_motion *);
struct sim_servo *scenario_motion_servo(const struct scenario_motion *); /* NULL: not behind Modbus */
int scenario_motion_port(const struct scenario_motion *);                /* of Modbus TCP, or 0 */

/* Whom faults can befall: servo, can, odometry, as far as they are there. How many. */
int scenario_motion_targets(const struct scenario_motion *, struct fault_target ret[SCENARIO_MOTION_TARGETS]);
/* False: none of these devices, or no such kind. */
bool scenario_motion_fault(struct scenario_motion *, const struct sim_fault *, bool on);
/* "; servo ...: angle ... deg, speed ... deg/s; can: ..." */
void scenario_motion_status(const struct scenario_motion *, int64_t now_ns, char *ret, size_t cap);

#endif

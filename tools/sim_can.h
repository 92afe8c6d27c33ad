/* Brains that are neither CANopen nor know of it: a servo's angle in a frame, and the odometry of two wheels. What they
 * send is described as facetd's configuration describes it (struct config_signal). */
#ifndef FACET_TOOLS_SIM_CAN_H
#define FACET_TOOLS_SIM_CAN_H

#include "config/config.h"
#include "tools/sim_device.h"

/* Faults: "silence"; "gap": the counter jumps by so many (5), once or in every frame; "invalid": the valid bit says no, and
 * the angle is wrong; "short": frames without their last bytes; "wrong id": it sends with the next id; "frozen": the angle
 * stays as it is; "jitter": sent up to so many ms late (5). */
struct sim_can_angle_params {
	struct config_signal signal; /* its counter and valid bit are filled where they are described */
	int64_t period_ns;
	double (*angle)(void *ctx, int64_t t_ns); /* rad, in the sense of the signal */
	void *ctx;
	uint64_t seed;
};
int sim_can_angle_create(const struct sim_can_angle_params *, int64_t t_ns, struct sim_device *ret); /* 0 or -ENOMEM */

/* Faults: "silence"; "slip": wheels turn further than the robot goes, by this share (0.2); "blocked": the left wheel stands;
 * "power": off so long, then its counts begin at 0; "gap", "short", "invalid", "wrong id" as above. */
struct sim_can_wheels_params {
	/* Either `ahead` and `turn` (of one frame or of two), or `left` and `right`: what the wheels' encoders count. */
	struct config_signal ahead, turn, left, right;
	double track_m; /* between the wheels */
	int64_t period_ns;
	struct pose (*pose)(void *ctx, int64_t t_ns); /* where the robot is */
	void *ctx;
	uint64_t seed;
};
int sim_can_wheels_create(const struct sim_can_wheels_params *, int64_t t_ns, struct sim_device *ret);

#endif

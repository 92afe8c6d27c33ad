/* A robot that drives through a built-in world with a sweeping scanner: the stage of `building` and `hall`.
 *
 * Every beam is cast at its own time, from where the robot and the servo were then. The noise of a beam is a hash of the
 * seed and of the beam's number since the start, so a run's noise does not depend on when anything happened. The drive
 * begins with the first profile that is asked for: a robot does not leave before its scanner runs. */
#include "tools/scenario.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "core/trig.h"

#define NOISE_M  0.015 /* uniform, +- */
#define REACH_M  32.0
#define HEIGHT_M 0.40 /* of the tilt axis above the floor, and 0.2 m before the robot's middle */
#define AHEAD_M  0.20
#define MIRROR_M 0.05 /* the mirror's centre above the axis */

struct drive {
	struct world *world;
	struct stage_axis axis;
	uint64_t seed, beams;
	bool started, endless;
	int64_t start_ns;
};

/* splitmix64 */
static uint64_t mix(uint64_t v)
{
	v += 0x9e3779b97f4a7c15u;
	v = (v ^ v >> 30) * 0xbf58476d1ce4e5b9u;
	v = (v ^ v >> 27) * 0x94d049bb133111ebu;
	return v ^ v >> 31;
}

static double noise(struct drive *d)
{
	uint64_t bits = mix(mix(d->seed) + d->beams++);

	return NOISE_M * ((double)(bits >> 11) / 4503599627370496.0 - 1.0);
}

static struct pose pose_at(void *ctx, int64_t t_ns)
{
	struct drive *d = ctx;
	double t_s = d->started ? (double)(t_ns - d->start_ns) * 1e-9 : 0.0, whole_s = world_drive_seconds(d->world);

	if (d->endless && t_s > 0.0) { /* there and, backwards, back */
		t_s -= 2.0 * whole_s * floor(t_s / (2.0 * whole_s));
		t_s = t_s < whole_s ? t_s : 2.0 * whole_s - t_s;
	}
	return world_drive(d->world, t_s);
}

static struct transform laser_at(struct drive *d, int64_t t_ns)
{
	struct pose pose = pose_at(d, t_ns);
	struct transform map_base = transform_quat(pose.position_m, pose.rotation), base_axis = transform_identity();
	struct transform tilt = transform_tilt(-d->axis.angle(d->axis.ctx, t_ns)), axis_laser = transform_identity(), t;

	base_axis.t = (struct vec3){AHEAD_M, 0.0, HEIGHT_M};
	axis_laser.t.z = MIRROR_M;
	t = transform_compose(&map_base, &base_axis);
	t = transform_compose(&t, &tilt);
	return transform_compose(&t, &axis_laser);
}

static void scan(void *ctx, struct profile *p)
{
	struct drive *d = ctx;

	if (!d->started) {
		d->started = true;
		d->start_ns = p->t_ns;
	}
	for (int k = 0; k < p->n; k++) {
		int64_t t_ns =
		    p->t_ns + (int64_t)(k % p->interlace) * p->turn_ns + (int64_t)(k / p->interlace) * p->beam_ns;
		struct transform laser = laser_at(d, t_ns);
		double bearing = p->first_rad + k * p->step_rad, off = noise(d), range;
		struct vec3 beam = {trig_cos(bearing), trig_sin(bearing), 0.0};

		range = world_cast(d->world, laser.t, transform_direction(&laser, beam), REACH_M);
		p->range_m[k] = range > 0.0 ? (float)(range + off) : 0.0f;
		p->state[k] = range > 0.0 ? BEAM_OK : BEAM_NO_ECHO;
	}
}

static bool ended(void *ctx, int64_t t_ns, char said[80])
{
	struct drive *d = ctx;
	double seconds = world_drive_seconds(d->world);

	if (!d->started || d->endless || (double)(t_ns - d->start_ns) * 1e-9 < seconds)
		return false;
	snprintf(said, 80, "drove %.0f s", seconds);
	return true;
}

static void join(void *ctx, const struct stage_axis *axis, struct sim_servo *servo)
{
	(void)servo;
	((struct drive *)ctx)->axis = *axis;
}

static void destroy(void *ctx)
{
	struct drive *d = ctx;

	world_destroy(d->world);
	free(d);
}

int drive_stage(const char *world, uint64_t seed, struct stage *ret, char error[SCENARIO_ERROR_MAX])
{
	struct drive *d = calloc(1, sizeof *d);

	if (!d) {
		snprintf(error, SCENARIO_ERROR_MAX, "out of memory");
		return -ENOMEM;
	}
	d->seed = seed;
	d->world = world_create(world, error);
	if (!d->world) {
		free(d);
		return -EINVAL;
	}
	*ret = (struct stage){.ctx = d,
	                      .scene = {.ctx = d, .scan = scan},
	                      .sweeps = true,
	                      .join = join,
	                      .pose = pose_at,
	                      .ended = ended,
	                      .destroy = destroy};
	return 0;
}

void drive_endless(struct stage *stage)
{
	((struct drive *)stage->ctx)->endless = true;
}

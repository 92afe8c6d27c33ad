/* A servo behind Modbus lives in a thread and owns its axis. Everything on CAN lives on the loop, and its axis is ours: a
 * drive moves it when it is told to, encoder, inclinometer and the angle in a frame stand on one that somebody else
 * moves, to and fro as a commanded one would be.
 *
 * The nodes learn what to send from the configuration that is written for facetd. */
#include "tools/scenario_motion.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "daemon/wall_clock.h"
#include "tools/sim_axis.h"
#include "tools/sim_can.h"
#include "tools/sim_can_bus.h"
#include "tools/sim_canopen.h"
#include "tools/sim_drive.h"

#define ANGLE_NS  INT64_C(5000000)
#define WHEELS_NS INT64_C(20000000)
#define SPEED_NS  20000000 /* over which a speed is told */
/* Of an axis that somebody else moves, in its own sense: up is positive. */
#define UPPER_DEG   65.0
#define LOWER_DEG   -45.0
#define SPEED_DEG   30.0
#define RAMP_DEG_S2 300.0
#define SOME_PORT   1 /* the configuration is read back before there is one */

struct scenario_motion {
	const struct scenario_params *params;
	const struct stage *stage;
	struct sim_servo *modbus;
	struct sim_axis axis; /* of all others */
	struct sim_can_bus *bus;
	int servo_node, wheels_node;                 /* -1: none */
	struct sim_device servo_brain, wheels_brain; /* the bus's; to be asked */
};

static double angle(void *ctx, int64_t t_ns)
{
	struct scenario_motion *m = ctx;

	return m->modbus ? sim_servo_angle(m->modbus, t_ns) : sim_axis_angle(&m->axis, t_ns);
}

/* As facetd means it. */
static double angle_down(void *ctx, int64_t t_ns)
{
	return -angle(ctx, t_ns);
}

/* ---- making ---- */

static int start_modbus(struct scenario_motion *m, char error[SCENARIO_ERROR_MAX])
{
	const struct sim_drive_params drive = {.acceleration = RAMP_DEG_S2 * TRIG_DEG, .seed = m->params->seed};
	char link[128];
	struct sim_servo_params params = {.rtu = m->params->servo == SCENARIO_MODBUS ? link : NULL,
	                                  .tcp = "127.0.0.1:0",
	                                  .slave = SCENARIO_UNIT,
	                                  .angle_rad = m->stage->angle_rad,
	                                  .drive = m->stage->sweeps ? &drive : NULL};

	snprintf(link, sizeof link, "%.110s/servo", m->params->dir);
	m->modbus = sim_servo_create(&params, error);
	return m->modbus ? 0 : -EIO;
}

static int create_canopen(struct scenario_motion *m, int64_t t_ns)
{
	static const enum sim_canopen_kind kind[SCENARIO_SERVOS] = {
	    [SCENARIO_CAN_ENCODER] = SIM_CANOPEN_ENCODER, [SCENARIO_INCLINOMETER] = SIM_CANOPEN_INCLINOMETER};
	const struct sim_canopen_params params = {
	    .kind = kind[m->params->servo], .node = SCENARIO_NODE, .axis = &m->axis, .seed = m->params->seed};

	return sim_canopen_create(&params, t_ns, &m->servo_brain);
}

static int create_angle(struct scenario_motion *m, const struct config_device *d, int64_t t_ns)
{
	const struct sim_can_angle_params params = {
	    .signal = d->angle, .period_ns = ANGLE_NS, .angle = angle_down, .ctx = m, .seed = m->params->seed};

	return sim_can_angle_create(&params, t_ns, &m->servo_brain);
}

static int create_wheels(struct scenario_motion *m, const struct config_device *d, int64_t t_ns)
{
	const struct sim_can_wheels_params params = {.ahead = d->ahead,
	                                             .turn = d->turn,
	                                             .left = d->left,
	                                             .right = d->right,
	                                             .track_m = d->track_m,
	                                             .period_ns = WHEELS_NS,
	                                             .pose = m->stage->pose,
	                                             .ctx = m->stage->ctx,
	                                             .seed = m->params->seed};

	return sim_can_wheels_create(&params, t_ns, &m->wheels_brain);
}

static int attach(struct scenario_motion *m, const struct sim_device *brain, int *ret_node)
{
	*ret_node = sim_can_bus_attach(m->bus, brain);
	return *ret_node < 0 ? *ret_node : 0;
}

/* What the nodes are to send stands in the configuration. */
static int attach_nodes(struct scenario_motion *m, const struct config *config, int64_t t_ns)
{
	int r = 0;

	for (int i = 0; !r && i < config->devices; i++) {
		const struct config_device *d = &config->device[i];

		if (!strcmp(d->driver, "odometry")) {
			r = create_wheels(m, d, t_ns);
			r = r ? r : attach(m, &m->wheels_brain, &m->wheels_node);
		} else if (!strcmp(d->driver, "can") || !strcmp(d->driver, "canopen")) {
			r = !strcmp(d->driver, "can") ? create_angle(m, d, t_ns) : create_canopen(m, t_ns);
			r = r ? r : attach(m, &m->servo_brain, &m->servo_node);
		}
	}
	return r;
}

static int start_nodes(struct scenario_motion *m, int64_t t_ns, char error[SCENARIO_ERROR_MAX])
{
	struct config *config = malloc(sizeof *config);
	char yaml[SCENARIO_YAML_MAX];
	struct config_error why = {0};
	int n = scenario_yaml(m->params, m->stage->sweeps, SOME_PORT, SOME_PORT, yaml, sizeof yaml), r = -ENOMEM;

	if (config && n > 0)
		r = config_read(yaml, (size_t)n, "facetd.yaml", config, &why);
	if (!r)
		r = attach_nodes(m, config, t_ns);
	free(config);
	if (r < 0)
		snprintf(error, SCENARIO_ERROR_MAX, "no nodes on the CAN bus: %s", *why.text ? why.text : strerror(-r));
	return r;
}

static int start_can(struct scenario_motion *m, uv_loop_t *loop, char error[SCENARIO_ERROR_MAX])
{
	char path[128];
	const struct sim_can_bus_params params = {
	    .path = m->params->can ? NULL : path, .interface = m->params->can, .seed = m->params->seed};

	snprintf(path, sizeof path, "%.110s/can.sock", m->params->dir);
	m->bus = sim_can_bus_create(loop, &params, error);
	return m->bus ? start_nodes(m, wall_clock_read(CLOCK_MONOTONIC), error) : -EIO;
}

static void place_axis(struct scenario_motion *m, int64_t t_ns)
{
	double at = m->params->servo == SCENARIO_FIXED ? -SCENARIO_FIXED_DEG * TRIG_DEG : m->stage->angle_rad;

	sim_axis_init(&m->axis, at, t_ns);
	if (m->params->servo != SCENARIO_FIXED && !scenario_servo_commanded(m->params->servo))
		sim_axis_triangle(&m->axis, UPPER_DEG * TRIG_DEG, LOWER_DEG * TRIG_DEG, SPEED_DEG * TRIG_DEG,
		                  RAMP_DEG_S2 * TRIG_DEG, t_ns);
}

struct scenario_motion *scenario_motion_create(uv_loop_t *loop, const struct scenario_params *params,
                                               const struct stage *stage, char error[SCENARIO_ERROR_MAX])
{
	struct scenario_motion *m = calloc(1, sizeof *m);
	int r = 0;

	if (!m) {
		snprintf(error, SCENARIO_ERROR_MAX, "out of memory");
		return NULL;
	}
	m->params = params;
	m->stage = stage;
	m->servo_node = m->wheels_node = -1;
	place_axis(m, wall_clock_read(CLOCK_MONOTONIC));
	if (params->servo == SCENARIO_MODBUS || params->servo == SCENARIO_MODBUS_TCP)
		r = start_modbus(m, error);
	if (!r && scenario_uses_can(params))
		r = start_can(m, loop, error);
	if (!r)
		return m;
	scenario_motion_destroy(m);
	return NULL;
}

void scenario_motion_destroy(struct scenario_motion *m)
{
	if (!m)
		return;
	sim_can_bus_destroy(m->bus);
	sim_servo_destroy(m->modbus);
	free(m);
}

/* ---- asking ---- */

struct stage_axis scenario_motion_axis(struct scenario_motion *m)
{
	return (struct stage_axis){.ctx = m, .angle = angle};
}

struct sim_servo *scenario_motion_servo(const struct scenario_motion *m)
{
	return m->modbus;
}

int scenario_motion_port(const struct scenario_motion *m)
{
	return m->modbus ? sim_servo_port(m->modbus) : 0;
}

int scenario_motion_targets(const struct scenario_motion *m, struct fault_target ret[SCENARIO_MOTION_TARGETS])
{
	int n = 0;

	if (m->modbus)
		ret[n++] = (struct fault_target){"servo", {sim_servo_fault_kinds(), NULL}};
	if (m->servo_node >= 0)
		ret[n++] = (struct fault_target){"servo", {m->servo_brain.fault_kinds, NULL}};
	if (m->bus)
		ret[n++] = (struct fault_target){"can", {sim_can_bus_fault_kinds(m->bus), NULL}};
	if (m->wheels_node >= 0)
		ret[n++] = (struct fault_target){"odometry", {m->wheels_brain.fault_kinds, NULL}};
	return n;
}

bool scenario_motion_fault(struct scenario_motion *m, const struct sim_fault *fault, bool on)
{
	if (!strcmp(fault->device, "servo") && m->modbus)
		return sim_servo_fault(m->modbus, fault, on);
	if (!strcmp(fault->device, "servo") && m->servo_node >= 0)
		return sim_can_bus_node_fault(m->bus, m->servo_node, fault, on);
	if (!strcmp(fault->device, "can") && m->bus)
		return sim_can_bus_fault(m->bus, fault, on);
	if (!strcmp(fault->device, "odometry") && m->wheels_node >= 0)
		return sim_can_bus_node_fault(m->bus, m->wheels_node, fault, on);
	return false;
}

static int print_bus(const struct scenario_motion *m, char *ret, size_t cap)
{
	struct sim_can_bus_counts c;

	sim_can_bus_counts(m->bus, &c);
	return snprintf(
	    ret, cap,
	    "; can: frames %llu, received %llu, refused %llu, dropped %llu, missed %llu, errors %llu, clients "
	    "%d, connections %llu",
	    (unsigned long long)c.frames, (unsigned long long)c.received, (unsigned long long)c.refused,
	    (unsigned long long)c.dropped, (unsigned long long)c.missed, (unsigned long long)c.errors, c.clients,
	    (unsigned long long)c.connections);
}

void scenario_motion_status(const struct scenario_motion *m, int64_t now_ns, char *ret, size_t cap)
{
	struct scenario_motion *asked = (struct scenario_motion *)m; /* its servo has a lock, nothing changes */
	double at = angle_down(asked, now_ns), before = angle_down(asked, now_ns - SPEED_NS);
	int n =
	    snprintf(ret, cap, "; servo %s: angle %.3f deg, speed %.3f deg/s", scenario_servo_word(m->params->servo),
	             at / TRIG_DEG, (at - before) / TRIG_DEG / (SPEED_NS * 1e-9));
	int word = m->servo_node >= 0 && scenario_servo_commanded(m->params->servo)
	               ? sim_canopen_status_word(&m->servo_brain)
	               : -1;

	if (word >= 0 && (size_t)n < cap)
		n += snprintf(ret + n, cap - (size_t)n, ", status word %04x, nmt %02x", (unsigned)word,
		              (unsigned)sim_canopen_nmt_state(&m->servo_brain));
	if (m->bus && (size_t)n < cap)
		print_bus(m, ret + n, cap - (size_t)n);
}

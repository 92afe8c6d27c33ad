/* The servo's axis, its drive and the keys that describe it, for every kind of servo: what differs between buses is here,
 * and nothing else. */
#include "tests/rig_robot.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "tools/sim_can.h"
#include "tools/sim_canopen.h"

#define ACCELERATION (300 * TRIG_DEG)
#define NODE         5
#define YAML_MAX     4000

static struct sim_axis axis;
static struct sim_device servo_brain;
static char yaml[YAML_MAX];

struct sim_axis *robot_axis(void)
{
	return &axis;
}

double robot_tilt(int64_t t_ns)
{
	return -sim_axis_angle(&axis, t_ns);
}

double robot_speed(const struct rig *rig)
{
	return -sim_axis_speed(&axis, rig_epoch_ns(rig));
}

const struct sim_device *robot_servo_brain(void)
{
	return &servo_brain;
}

const char *robot_yaml(void)
{
	return yaml;
}

const char *robot_servo_name(enum robot_servo servo)
{
	static const char *const name[] = {"CAN signal",       "CANopen cyclic",  "CANopen position",
	                                   "CANopen velocity", "CANopen encoder", "CANopen inclinometer",
	                                   "Modbus RTU",       "Modbus TCP"};

	return name[servo];
}

static bool is_swung(const struct robot_params *p)
{
	const enum robot_servo servo = p->servo;

	return p->swung || servo == ROBOT_CAN || servo == ROBOT_ENCODER || servo == ROBOT_INCLINOMETER;
}

static double axis_angle(void *ctx, int64_t t_ns)
{
	(void)ctx;
	return sim_axis_angle(&axis, t_ns);
}

static double tilt_of_axis(void *ctx, int64_t t_ns)
{
	(void)ctx;
	return robot_tilt(t_ns);
}

static struct pose wheels_pose(void *ctx, int64_t t_ns)
{
	return rig_pose(ctx, t_ns);
}

/* The configuration */

static void add(const char *format, ...)
{
	const size_t len = strlen(yaml);
	va_list args;

	va_start(args, format);
	vsnprintf(yaml + len, sizeof(yaml) - len, format, args);
	va_end(args);
}

static void add_modbus(const struct robot_params *p, const char *keys)
{
	static const char *const order[] = {"ABCD", "CDAB", "BADC", "DCBA"};
	const char *of = order[p->order & 3];

	add("  - {name: servo, driver: modbus, connect: %s, parity: none, unit: 3,\n",
	    p->servo == ROBOT_RTU ? "/dev/servo" : "\"10.0.0.7:502\"");
	if (p->floats)
		add("     position: {address: 8, type: f32, order: %s, scale: 1deg, sign: -1},\n"
		    "     target: {address: 14, type: f32, order: %s, scale: 1deg, sign: -1},\n",
		    of, of);
	else
		add("     position: {address: 0, type: i32, order: %s, scale: 0.001deg, sign: -1},\n"
		    "     target: {address: 2, type: i32, order: %s, scale: 0.001deg, sign: -1},\n",
		    of, of);
	add("     speed: {address: 4, type: u32, order: %s, scale: 0.001deg}%s}\n", of, keys);
}

static void add_servo(const struct robot_params *p)
{
	static const char *const mode[] = {
	    [ROBOT_CYCLIC] = "cyclic", [ROBOT_POSITION] = "position", [ROBOT_VELOCITY] = "velocity"};
	const char *keys = p->keys ? p->keys : "";

	switch (p->servo) {
	case ROBOT_CAN:
		add("  - {name: servo, driver: can, connect: can0, angle: {id: 0x181, start: 7, length: 32, order: "
		    "motorola,\n"
		    "     scale: -0.001deg, counter: {start: 39, length: 8}, valid: {bit: 40}}%s}\n",
		    keys);
		break;
	case ROBOT_CYCLIC:
	case ROBOT_POSITION:
	case ROBOT_VELOCITY:
		add("  - {name: servo, driver: canopen, connect: can0, node: %d, kind: drive, mode: %s, scale: "
		    "0.001deg, sign: -1%s}\n",
		    NODE, mode[p->servo], keys);
		break;
	case ROBOT_ENCODER:
		add("  - {name: servo, driver: canopen, connect: can0, node: %d, scale: 0.001deg, sign: -1, wrap: "
		    "360000%s}\n",
		    NODE, keys);
		break;
	case ROBOT_INCLINOMETER:
		add("  - {name: servo, driver: canopen, connect: can0, node: %d, sign: -1%s}\n", NODE, keys);
		break;
	default:
		add_modbus(p, keys);
	}
}

static void write_yaml(const struct robot_params *p)
{
	yaml[0] = 0;
	add("mount: {base_tilt: {xyz: [0.2, 0, 0.4]}, tilt_laser: {xyz: [0, 0, 0.05]}}\n"
	    "devices:\n"
	    "  - {name: laser, driver: lms2xx, port: /dev/lms, baud: 500000, variant: 180/0.5, range: [0.1, 30], tilt: "
	    "servo}\n");
	add_servo(p);
	if (!p->no_pose)
		add("  - {name: pose, driver: pose, listen: \"unix:/run/pose.sock\"}\n");
	if (p->odometry)
		add("  - {name: wheels, driver: odometry, connect: can1, track: 0.5,\n"
		    "     left: {id: 0x201, start: 0, length: 32, scale: 0.0001},\n"
		    "     right: {id: 0x201, start: 32, length: 32, scale: 0.0001}}\n");
	add("%s", p->devices ? p->devices : "");
	if (!is_swung(p))
		add("sweep: {device: servo, from: -65deg, to: 45deg, speed: %gdeg%s}\n",
		    p->speed_deg > 0 ? p->speed_deg : 30, p->sweep ? p->sweep : "");
}

/* The devices */

static void attach_laser(struct rig *rig)
{
	struct sim_lms2xx_params params = {.mode = 0x05, .millimetres = true};
	struct sim_device brain;
	struct scene scene;

	rig_scene(rig, "laser", &scene);
	if (sim_lms2xx_create(&params, &scene, rig_epoch_ns(rig), &brain) < 0)
		exit(1);
	rig_attach(rig, "laser", RIG_SERIAL, &brain);
}

/* As the configuration says it; its frame is the axis' own sense, so that the sign is undone by it. */
static struct config_signal angle_signal(void)
{
	return (struct config_signal){.set = true,
	                              .id = 0x181,
	                              .start = 7,
	                              .length = 32,
	                              .order = SIGNAL_MOTOROLA,
	                              .type = SIGNAL_SIGNED,
	                              .scale = 0.001 * TRIG_DEG,
	                              .counter = {true, 39, 8},
	                              .valid = {true, 40, 1}};
}

static void attach_can(struct rig *rig, const struct robot_params *p)
{
	static const enum sim_canopen_kind kind[] = {
	    [ROBOT_ENCODER] = SIM_CANOPEN_ENCODER, [ROBOT_INCLINOMETER] = SIM_CANOPEN_INCLINOMETER, [ROBOT_RTU] = 0};
	struct sim_can_angle_params angle = {
	    .signal = angle_signal(), .period_ns = 5 * RIG_MS, .angle = axis_angle, .seed = p->rig.seed};
	struct sim_canopen_params node = {
	    .kind = kind[p->servo], .node = NODE, .axis = &axis, .factory = true, .seed = p->rig.seed};
	const int64_t t_ns = rig_epoch_ns(rig);
	const int r = p->servo == ROBOT_CAN ? sim_can_angle_create(&angle, t_ns, &servo_brain)
	                                    : sim_canopen_create(&node, t_ns, &servo_brain);

	if (r < 0)
		exit(1);
	rig_attach(rig, "servo", RIG_CAN, &servo_brain);
}

static void attach_modbus(struct rig *rig, const struct robot_params *p)
{
	struct sim_drive_params params = {.unit = 3,
	                                  .strict = p->strict,
	                                  .order = p->order,
	                                  .axis = &axis,
	                                  .acceleration = ACCELERATION,
	                                  .seed = p->rig.seed};
	struct sim_drive *drive = sim_drive_create(&params, rig_epoch_ns(rig));

	if (!drive)
		exit(1);
	rig_attach_drive(rig, "servo", drive);
}

static void attach_wheels(struct rig *rig, const struct robot_params *p)
{
	struct sim_can_wheels_params params = {
	    .track_m = 0.5, .period_ns = 10 * RIG_MS, .pose = wheels_pose, .ctx = rig, .seed = p->rig.seed};
	struct sim_device brain;

	params.left =
	    (struct config_signal){.set = true, .id = 0x201, .length = 32, .type = SIGNAL_SIGNED, .scale = 0.0001};
	params.right = params.left;
	params.right.start = 32;
	if (sim_can_wheels_create(&params, rig_epoch_ns(rig), &brain) < 0)
		exit(1);
	rig_attach(rig, "wheels", RIG_CAN, &brain);
}

struct rig *robot_create(const struct robot_params *p)
{
	struct rig_params params = p->rig;
	struct rig *rig;

	write_yaml(p);
	params.yaml = yaml;
	rig = rig_create(&params);
	sim_axis_init(&axis, -p->angle_deg * TRIG_DEG, rig_epoch_ns(rig));
	if (is_swung(p))
		sim_axis_triangle(&axis, 65 * TRIG_DEG, -45 * TRIG_DEG,
		                  (p->speed_deg > 0 ? p->speed_deg : 30) * TRIG_DEG, ACCELERATION, rig_epoch_ns(rig));
	rig_follow(rig, tilt_of_axis, NULL);
	attach_laser(rig);
	if (p->servo == ROBOT_RTU || p->servo == ROBOT_TCP)
		attach_modbus(rig, p);
	else
		attach_can(rig, p);
	if (p->odometry)
		attach_wheels(rig, p);
	return rig;
}

/* A robot for the rig: an LMS2xx, a servo of some kind that tilts it, poses. The servo is a simulated axis behind a
 * simulated drive; the driver under test moves it. Its axis counts up where the scanner looks up, as most do. */
#ifndef FACET_TESTS_RIG_ROBOT_H
#define FACET_TESTS_RIG_ROBOT_H

#include "tests/rig.h"

enum robot_servo {
	ROBOT_CAN,          /* somebody else swings it; its angle is in a frame, 200 Hz */
	ROBOT_CYCLIC,       /* CANopen drive, cyclic synchronous position, SYNC every 10 ms */
	ROBOT_POSITION,     /* ... profile position */
	ROBOT_VELOCITY,     /* ... profile velocity */
	ROBOT_ENCODER,      /* CANopen encoder, swung by somebody else */
	ROBOT_INCLINOMETER, /* the same with an inclinometer */
	ROBOT_RTU,          /* Modbus drive, 115200 Bd */
	ROBOT_TCP,
	ROBOT_SERVOS
};
const char *robot_servo_name(enum robot_servo);

struct robot_params {
	enum robot_servo servo;
	const char *keys;      /* further keys of the servo: ", following: 3deg" */
	const char *sweep;     /* further keys of the sweep: ", profile: step" */
	const char *devices;   /* further devices: lines of YAML */
	bool odometry;         /* wheels at 100 Hz on the bus `can1` */
	double speed_deg;      /* of the sweep; 0: 30 */
	double angle_deg;      /* tilt at first */
	bool swung;            /* somebody else moves it, and it is only read, whatever it could do */
	bool strict;           /* Modbus: it wants to be enabled, and started for each target */
	int order;             /* Modbus: of the bytes of 32 bits, as sim_drive_params' */
	bool floats;           /* Modbus: its numbers are read and written as floats */
	bool no_pose;          /* nobody but the wheels says where it is */
	struct rig_params rig; /* without yaml */
};

/* The rig with "laser", "servo", "pose" (and "wheels") attached, not started. */
struct rig *robot_create(const struct robot_params *);
/* Of the robot that was made last. */
struct sim_axis *robot_axis(void);
double robot_tilt(int64_t t_ns);                  /* true, rad, positive looks down */
double robot_speed(const struct rig *);           /* now, rad/s, in the same sense */
const struct sim_device *robot_servo_brain(void); /* of CANopen servos */
const char *robot_yaml(void);                     /* its configuration */

#endif

/* A scenario: the simulated devices, what moves under them, and the configuration that reaches them.
 *
 * What moves is a stage. A world's stage (drive.c) goes on by itself; a played recording's (playback.c) goes on when its
 * reader does. Neither knows a device; the scenario joins them. */
#ifndef FACET_TOOLS_SCENARIO_H
#define FACET_TOOLS_SCENARIO_H

#include "tools/sim_device.h"

#define SCENARIO_ERROR_MAX 1024

/* Times are CLOCK_MONOTONIC in ns. */
struct stage_axis {
	void *ctx;
	double (*angle)(void *ctx, int64_t t_ns); /* rad */
};

struct stage {
	void *ctx;
	struct scene scene;
	double angle_rad; /* where the servo stands at first, in its own sense: positive looks up */
	bool sweeps;      /* the configuration lets the servo sweep */
	/* Where the servo stands, in that sense, once there is one: `angle` at any time of the last seconds. Who plays a
	 * recording needs the simulator behind Modbus, which is NULL otherwise. */
	void (*join)(void *ctx, const struct stage_axis *, struct sim_servo *);
	/* map <- base at t_ns. */
	struct pose (*pose)(void *ctx, int64_t t_ns);
	/* A datagram with the pose just asked for was taken by a reader. May be NULL. */
	void (*pose_sent)(void *ctx);
	/* Over? Then what there was, e.g. "played 678 lines". */
	bool (*ended)(void *ctx, int64_t t_ns, char said[80]);
	void (*destroy)(void *ctx);
};

/* 0, or -errno with one sentence. `seed` makes the range noise. */
int drive_stage(const char *world, uint64_t seed, struct stage *ret, char error[SCENARIO_ERROR_MAX]);

/* That drive goes there and back again for ever. */
void drive_endless(struct stage *);

/* `source`: "uos:DIR" or "profiles:FILE.csv"; `more`: further files of the latter. */
int playback_stage(const char *source, char *const *more, int n, struct stage *ret, char error[SCENARIO_ERROR_MAX]);

/* Which scanner: an LMS2xx on a pseudo-terminal, or a TiM571, LMS111, LMS511 on TCP. */
enum scenario_laser { SCENARIO_LMS2XX, SCENARIO_TIM, SCENARIO_LMS1XX, SCENARIO_LMS5XX, SCENARIO_LASERS };
/* By its driver's name, "lms2xx"; SCENARIO_LASERS: there is none. */
enum scenario_laser scenario_laser(const char *driver);

/* Which servo tilts it, and who commands it. */
enum scenario_servo {
	SCENARIO_MODBUS,           /* RTU on a pseudo-terminal */
	SCENARIO_MODBUS_TCP,       /* on 127.0.0.1 */
	SCENARIO_CAN,              /* moves by itself; its angle in a frame */
	SCENARIO_CANOPEN,          /* CiA 402, profile position */
	SCENARIO_CANOPEN_CYCLIC,   /* ... cyclic synchronous position */
	SCENARIO_CANOPEN_VELOCITY, /* ... profile velocity */
	SCENARIO_CAN_ENCODER,      /* CiA 406, on a servo that moves by itself */
	SCENARIO_INCLINOMETER,     /* CiA 410, the same */
	SCENARIO_FIXED,            /* none */
	SCENARIO_SERVOS
};
/* By its word of the command line, "canopen-cyclic"; SCENARIO_SERVOS: there is none. */
enum scenario_servo scenario_servo(const char *word);

const char *scenario_servo_word(enum scenario_servo);
bool scenario_servo_commanded(enum scenario_servo);

/* What the wheels tell, if anything; poses then come once a second. */
enum scenario_odometry { SCENARIO_NO_ODOMETRY, SCENARIO_WHEELS, SCENARIO_SPEEDS };

#define SCENARIO_UNIT      1    /* of the servo behind Modbus */
#define SCENARIO_NODE      5    /* ... on CANopen */
#define SCENARIO_TICK_DEG  0.01 /* of the encoder in a scanner's telegrams */
#define SCENARIO_FIXED_DEG 15.0 /* so a scanner without a servo looks down */

/* `truth`: where the axis truly was, as text, a line a millisecond, written while it runs:
 *
 *   T ANGLE X Y Z YAW
 *
 * T CLOCK_REALTIME in ns; ANGLE of the tilt axis in rad, positive looks down, as facetd means it; then the robot in the map,
 * m and rad. Between two lines a straight line is right to 0.0001 degree. */
struct scenario_params {
	const char *name;  /* "building", "hall", "uos:DIR", "profiles:FILE.csv" */
	char *const *more; /* further profile files */
	int more_n;
	const char *dir; /* absolute; exists */
	bool fast;       /* playback without the wire's pace */
	enum scenario_laser laser;
	enum scenario_servo servo;
	enum scenario_odometry odometry;
	const char *can;        /* a real interface where the nodes are; NULL: a hub at DIR/can.sock */
	const char *can_config; /* ... and the one that the configuration names; NULL: the same */
	const char *truth;      /* file, or NULL */
	const char *sent;       /* likewise, LMS2xx only: its lines are those of scenario_sent.h */
	bool usb;               /* the scanner on USB: the TiM, as root on a kernel with gadgets */
	bool encoder;           /* the angle comes in the scanner's telegrams (LMS1xx, LMS5xx) */
	bool endless;           /* the drive goes there and back again until it is ended */
	char *const *fault;     /* sentences (fault.h) */
	int faults;
	const char *tcp;  /* HOST:PORT where the daemon is to listen too, or NULL */
	const char *http; /* HOST:PORT of its page, or NULL */
	uint64_t seed;
	void *ctx;
	void (*ended)(void *ctx, const char *said); /* called once */
};

/* Is anything on a CAN bus? */
bool scenario_uses_can(const struct scenario_params *);

/* Is it a world, which goes on by itself (and takes no --speed)? */
bool scenario_is_world(const char *name);

struct scenario;
/* Starts everything and writes DIR/facetd.yaml. NULL with one sentence. */
struct scenario *scenario_create(uv_loop_t *, const struct scenario_params *, char error[SCENARIO_ERROR_MAX]);
/* Closes the devices and removes their links; the loop must run once more to let go of the timer. */
void scenario_destroy(struct scenario *);

/* What the scanner did so far, for the eye of a user: one line without its end. */
void scenario_status(const struct scenario *, char *ret, size_t cap);

#define SCENARIO_YAML_MAX 4096
/* The configuration, as it is written. The length, or -ENOSPC. */
int scenario_yaml(const struct scenario_params *, bool sweeps, int servo_port, int laser_port, char *ret, size_t cap);

#endif

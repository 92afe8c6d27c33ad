/* Simulated devices: implementations of the wire, never flags in the program (style, rule 6). They stand on one libuv
 * loop (the Modbus server in a thread of its own) and share one physical model, the scene. Every t_ns is uv_hrtime(). */
#ifndef FACET_TOOLS_SIMULATOR_H
#define FACET_TOOLS_SIMULATOR_H

#include <uv.h>

#include "core/types.h"

/* What a scanner would measure. A world that moves continuously answers any time; a played recording is paced by its
 * reader: its scanner measures only when `ready`. */
struct scene {
	void *ctx;
	/* Fills range_m and state of `profile`, whose times, bearings and n are set: each beam cast at its own time. Called when the
	 * last beam has passed. A profile that the host breaks off is begun anew and asked for again. */
	void (*scan)(void *ctx, struct profile *profile);
	/* May a profile begin from t_ns (now) on? NULL: always. Asked every millisecond while streaming and not measuring, until it
	 * says yes; the profile then begins so much later that also what its
	 * reader takes for its begin is later. */
	bool (*ready)(void *ctx, int64_t t_ns);
	/* The profile begun last was taken by its reader (nothing of it is left in the line). May be NULL. */
	void (*taken)(void *ctx, int64_t t_ns);
	/* Instead: its reader cannot have understood it (another rate was set): it is to be measured again. May be NULL. */
	void (*lost)(void *ctx, int64_t t_ns);
};

/* A device's other end (struct sim_device, sim_device.h). */
struct sim_device;
struct sim_fault;

/* An LMS2xx. The mirror turns all the time; profiles begin at its phase. */
struct sim_lms2xx_params {
	bool fast;     /* drop the wire's pace (not the mirror's): bytes go as fast as they are read */
	uint32_t baud; /* rate the device starts with; 0: 9600, as from the factory */
	int mode;      /* measuring mode in its configuration (protocols A.6), e.g. 0x05: 15 bit */
	bool millimetres;
	bool indices; /* real-time indices are sent */
};

/* A serial device behind a pseudo-terminal: `link` becomes a symbolic link to its slave. Takes the device over, also
 * when it fails: NULL with one sentence in `error`. */
struct sim_pty;
struct sim_pty *sim_pty_create(uv_loop_t *, const char *link, const struct sim_device *, char error[160]);
/* `wrote` hears of every piece of bytes, all of which the line took, and of when they began to be written. */
void sim_pty_watch(struct sim_pty *, void (*wrote)(void *ctx, int64_t t_ns), void *ctx);
void sim_pty_destroy(struct sim_pty *); /* closes the pty, removes the link; the loop must run once more */
/* The device's faults and the line's own: "unplug". False: no such kind. */
bool sim_pty_fault(struct sim_pty *, const struct sim_fault *, bool on);
const char *const *sim_pty_fault_kinds(void); /* the line's own; ends with NULL */

/* A scanner that speaks CoLa, by TCP or USB. Paced scenes are not for it: it measures when its mirror turns. */
enum sim_cola_model_id { SIM_TIM561, SIM_TIM571, SIM_TIM310, SIM_TIM781S, SIM_LMS111, SIM_LMS511, SIM_COLA_MODELS };
struct sim_cola_params {
	enum sim_cola_model_id model;
	enum { SIM_COLA_FACTORY, SIM_COLA_A, SIM_COLA_B } dialect; /* it speaks at first */
	bool segments;                                             /* telegrams are cut as TCP was seen to cut them */
	uint32_t serial;                                           /* 0: the model's */
	uint32_t start_us;                                         /* of its clock, e.g. near the wrap */
	double drift_ppm;                         /* of its clock (and mirror) against the host's: positive runs fast */
	double ticks_per_rad;                     /* of the encoder; 0: no encoder is connected */
	double (*angle)(void *ctx, int64_t t_ns); /* what the encoder counts; NULL: none */
	void *ctx;
};
const char *sim_cola_model_name(enum sim_cola_model_id);   /* "TiM561" */
const char *sim_cola_model_driver(enum sim_cola_model_id); /* "tim" */

/* A device behind a TCP port on loopback; port 0: any. Takes the device over, also when it fails: NULL with one
 * sentence. */
struct sim_tcp;
struct sim_tcp *sim_tcp_create(uv_loop_t *, int port, const struct sim_device *, char error[160]);
void sim_tcp_destroy(struct sim_tcp *); /* the loop must run once more */
int sim_tcp_port(const struct sim_tcp *);
/* The device's faults and the connection's own: "refuse", "timeout", "reset", "half-open", "unplug". */
bool sim_tcp_fault(struct sim_tcp *, const struct sim_fault *, bool on);
const char *const *sim_tcp_fault_kinds(void);

/* A servo behind Modbus (libmodbus server): really moves with a speed. Position in 0.001 degree, i32 in two registers. */
enum sim_servo_register { /* holding registers, also readable as input registers; 32-bit values high word first */
	                  SIM_SERVO_POSITION = 0,  /* 0,1: actual position */
	                  SIM_SERVO_TARGET = 2,    /* 2,3: where to go */
	                  SIM_SERVO_SPEED = 4,     /* 4,5: 0.001 degree/s, unsigned */
	                  SIM_SERVO_MOVING = 6,    /* 1 while it moves */
	                  SIM_SERVO_REGISTERS = 32 /* the others: sim_drive.h */
};
struct sim_drive_params;
struct sim_servo_params {
	const char *rtu;  /* path of the link to a pty's slave (8N1), or NULL */
	const char *tcp;  /* host:port, port 0: any; or NULL */
	int slave;        /* unit id */
	double angle_rad; /* where it stands at first, in the servo's own sense */
	/* NULL: the simple one, without acceleration; its own unit, axis and angle do not count */
	const struct sim_drive_params *drive;
};
struct sim_servo;
struct sim_servo *sim_servo_create(const struct sim_servo_params *, char error[160]);
void sim_servo_destroy(struct sim_servo *);
int sim_servo_port(const struct sim_servo *); /* TCP port it listens on */
double sim_servo_angle(
    struct sim_servo *,
    int64_t t_ns); /* rad, at any time within the last seconds (CLOCK_MONOTONIC, as uv_hrtime); any thread */
void sim_servo_place(struct sim_servo *, double angle_rad); /* stands there from now on (playback steps) */
uint64_t sim_servo_answers(
    struct sim_servo *); /* position reads so far whose answer was taken in good time, as the next request shows */
/* Its faults: those of sim_drive.h. */
bool sim_servo_fault(struct sim_servo *, const struct sim_fault *, bool on);
const char *const *sim_servo_fault_kinds(void);

/* Built-in worlds of flat and round things; distances in metres, map frame (z up, floor at 0). */
struct world;
struct world *world_create(const char *name, char error[160]); /* "building", "hall" */
void world_destroy(struct world *);
/* Distance to the first surface along the unit direction, or a negative number for none within `max_m`. */
double world_cast(const struct world *, struct vec3 origin, struct vec3 direction, double max_m);
/* Where the simulated robot is (base frame) at `t_s` seconds after the start; the drive ends at world_drive_seconds. */
struct pose world_drive(const struct world *, double t_s);
double world_drive_seconds(const struct world *);

#endif

/* The configuration as the program uses it: SI units, defaults filled in. Filled by config_read from YAML under one
 * table of keys (keys.c), from which checks, --help, the commented manual and error messages come. */
#ifndef FACET_CONFIG_CONFIG_H
#define FACET_CONFIG_CONFIG_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "core/sweep.h"

#define CONFIG_DEVICES_MAX 16
#define CONFIG_NAME_MAX    32
#define CONFIG_TEXT_MAX    256
#define CONFIG_LISTEN_MAX  4
#define CONFIG_WRITES_MAX  16

struct config_register { /* a Modbus value */
	bool set;
	uint8_t function; /* 3 holding, 4 input; targets are written with 6 or 16 */
	uint16_t address;
	enum { REGISTER_I16, REGISTER_U16, REGISTER_I32, REGISTER_U32, REGISTER_F32 } type;
	enum { ORDER_ABCD, ORDER_CDAB, ORDER_BADC, ORDER_DCBA } order;
	double scale; /* radians (or rad/s) = sign * scale * (raw - zero); written `0.001deg` */
	double zero;  /* raw counts */
	int sign;     /* +1 or -1 */
};

/* A number in a CAN frame, as DBC files describe it (protocols C.1): quantity = raw * scale + offset, in SI. */
struct config_signal {
	bool set;
	uint32_t id; /* 11 bits, or 29 where `extended` */
	bool extended;
	int start, length; /* DBC's bit numbers: intel, of the lowest bit; motorola, of the highest */
	enum { SIGNAL_INTEL, SIGNAL_MOTOROLA } order;
	enum { SIGNAL_SIGNED, SIGNAL_UNSIGNED, SIGNAL_FLOAT } type; /* float: 32 or 64 bits */
	double scale, offset;
	double wrap; /* raw counts after which the device counts from 0 again; 0: it never does */
	int min_dlc; /* bytes; shorter frames are refused */
	struct {
		bool set;
		int start, length; /* goes up by one from frame to frame; order as the signal's */
	} counter;
	struct {
		bool set;
		int bit;   /* intel numbering */
		int value; /* 0 or 1: the signal is good then */
	} valid;
	struct {
		bool set;
		int start, length; /* order as the signal's */
		int64_t value;     /* the signal is in frames whose multiplexor says this */
	} mux;
};

struct config_write { /* one step of a sequence of writes to a Modbus device */
	uint16_t address, value;
	int64_t delay_ns; /* to wait after it was answered */
	struct {
		bool set;
		uint16_t address, mask, value; /* read until (register & mask) == value ... */
		int64_t within_ns;             /* ... or it has failed */
	} until;                               /* before the next step */
};
struct config_writes {
	int n;
	struct config_write item[CONFIG_WRITES_MAX];
};

struct config_device {
	char name[CONFIG_NAME_MAX];
	char driver[CONFIG_NAME_MAX]; /* a name of keys_driver */
	int line;                     /* of the file, for messages */

	/* lms2xx */
	char port[CONFIG_TEXT_MAX];
	uint32_t baud;       /* lms2xx: 9600, 19200, 38400, 500000; modbus rtu: any */
	int fov_deg;         /* variant: 100 or 180 */
	int resolution_cdeg; /* variant: 100, 50 or 25 (180/0.25 is made of partial scans) */
	enum { UNIT_KEEP, UNIT_MM, UNIT_CM } range_unit; /* `unit` of a scanner */
	int mode;                                        /* measuring mode to set, -1: respect the device's */
	double range_min_m, range_max_m;
	struct {
		double from_rad, to_rad;
	} mask[SWEEP_MASKS_MAX];
	int masks;
	char tilt[CONFIG_NAME_MAX]; /* name of the device that tilts this one; empty: fixed */
	double tilt_fixed_rad;

	enum { INDICES_KEEP, INDICES_ON } indices; /* lms2xx: real-time indices; setting them writes its memory */

	/* every scanner: how much earlier a profile was measured than its time says; calibrated, may be negative */
	int64_t latency_ns;

	/* tim, lms1xx, lms5xx; 0: as the device is set */
	enum { PROTOCOL_AUTO, PROTOCOL_COLA_A, PROTOCOL_COLA_B } protocol;
	double frequency_hz, resolution_rad;
	double angles_from_rad, angles_to_rad; /* output range; 0 is straight ahead, positive left. Equal: as it is */
	int every;                             /* every n-th scan is sent */
	enum { REMISSION_KEEP, REMISSION_OFF, REMISSION_8, REMISSION_16 } remission;
	enum { STAMP_AUTO, STAMP_START, STAMP_END } stamp; /* what the device's stamp marks; auto: by the model */
	struct {
		bool set;
		double scale; /* rad of a tick; angle = sign * scale * (ticks - zero) */
		double zero;  /* ticks */
		int sign;
		double wrap; /* ticks after which they count from 0 again; 0: 2^32 */
	} encoder;           /* in the telegrams; the device may then be its own `tilt` */

	/* modbus: path of a serial line (RTU) or HOST:PORT (TCP). Scanners: HOST[:PORT], usb, usb:SERIAL, usb:BUS-PORT */
	char connect[CONFIG_TEXT_MAX];
	char parity;       /* N, E, O */
	int slave;         /* `unit` of a Modbus device, 1..247 */
	int64_t period_ns; /* between polls; 0: as fast as the answers come */
	int address_base;  /* 0 or 1 */
	struct config_register position, target, speed;
	struct config_writes write; /* at every start: enable, home, ... */
	struct config_writes reset; /* once, when `status` says that it has a fault */
	struct config_writes stop;  /* at an orderly end, after the rest angle was reached */
	struct {
		bool set;
		uint16_t address, on, off;
	} strobe; /* written after every target: `on`, then `off` */
	struct {
		bool set;
		uint16_t address, value, toggle; /* these bits change from one time to the next */
		int64_t period_ns;
	} watchdog; /* the drive stops by itself when nobody writes it any more */
	struct {
		bool set;
		uint8_t function;        /* 3 or 4 */
		uint16_t address, fault; /* any of these bits: it has a fault */
	} status;

	/* every commanded servo */
	bool has_limits;
	double limits_rad[2]; /* no target is ever sent that lies outside */
	double
	    following_rad; /* so far from where it was told to be, or not moving at all: the sweep stops; 0: not judged */
	int64_t timeout_ns; /* can, canopen, odometry: nothing for so long: lost */

	/* can: the angle. odometry: speed and rate of turn, or the ways of two wheels */
	struct config_signal angle, ahead, turn, left, right;
	double track_m;                 /* between the wheels */
	double drift, turn_drift_rad_m; /* sigma: of a way, per metre of it; of the heading, per metre */
	double trust_m;                 /* rows are dropped while the position's sigma is larger; 0: never */

	/* canopen */
	int node, master; /* its id, and ours */
	enum { CANOPEN_AUTO, CANOPEN_DRIVE, CANOPEN_ENCODER, CANOPEN_INCLINOMETER } kind;
	int64_t sync_ns;      /* we produce SYNC so often; 0: somebody else does, or nobody */
	int64_t heartbeat_ns; /* ours and its; 0: none */
	enum { CANOPEN_POSITION, CANOPEN_VELOCITY, CANOPEN_CYCLIC } drive_mode; /* `mode` of a drive */
	enum { CANOPEN_LONGITUDINAL, CANOPEN_LATERAL } axis;                    /* of an inclinometer */
	struct {
		bool set;
		double scale; /* rad of a count; angle = sign * scale * (count - zero) */
		double zero;  /* counts */
		int sign;
		double wrap; /* counts after which it counts from 0 again; 0: never */
	} count;
	double acceleration_rad_s2;
	struct {
		bool set;
		int method; /* CiA 402, 6098 */
		double speed_rad_s;
		double offset_rad; /* the angle at the home position */
		int64_t within_ns;
	} homing;

	char message[CONFIG_NAME_MAX]; /* carmen: its name; empty: the front laser's */

	/* pose */
	enum { JUMP_KEEP, JUMP_IGNORE, JUMP_NEW_MAP } on_jump;
	double jump_m, jump_rad;      /* beyond what the motion explains: a jump */
	char listen[CONFIG_TEXT_MAX]; /* unix:PATH or udp:HOST:PORT */
	bool fixed;
	struct transform fixed_pose; /* map <- base */
};

struct config {
	struct {
		double cell_m;
		bool planes, reduce;
		double tolerance, snap; /* cells */
		int lookahead;          /* rows */
		uint64_t memory;        /* bytes */
		int64_t hold_ns;
		char archive
		    [CONFIG_TEXT_MAX]; /* where a map that ends by a jump is saved; empty: the working directory */
	} map;
	struct {
		bool has_box;
		struct vec3 box_min, box_max;
	} robot;
	struct {
		struct transform base_tilt, tilt_laser;
	} mount;
	struct config_device device[CONFIG_DEVICES_MAX];
	int devices;
	struct {
		bool set;
		char device[CONFIG_NAME_MAX];
		double from_rad, to_rad, speed_rad_s;
		enum { SWEEP_TRIANGLE, SWEEP_SINUS, SWEEP_STEP } profile;
		double step_rad;
		int64_t settle_ns;
		bool has_rest;
		double rest_rad;
	} sweep;
	struct {
		char native[CONFIG_LISTEN_MAX][CONFIG_TEXT_MAX]; /* unix:PATH, tcp:HOST:PORT */
		int natives;
		char group[CONFIG_NAME_MAX];
		int send_buffer;            /* bytes; 0: the system's */
		int clients;                /* at the limit: accept, say why, close */
		char http[CONFIG_TEXT_MAX]; /* HOST:PORT; empty: none */
		bool http_set;              /* written by the user: then it must be possible */
		char token_file[CONFIG_TEXT_MAX];
		bool has_tls;
		char certificate[CONFIG_TEXT_MAX], key[CONFIG_TEXT_MAX];
		char origin[CONFIG_LISTEN_MAX][CONFIG_TEXT_MAX]; /* of other pages that may open WebSockets */
		int origins;
	} listen;
	struct {
		char dir[CONFIG_TEXT_MAX]; /* empty: none is begun with the daemon */
		int64_t chunk_ns;
		uint64_t max_size;  /* bytes; 0: no limit */
		int64_t max_age_ns; /* 0: no limit */
		uint64_t keep;      /* bytes of all files in `dir`; 0: none is deleted */
		bool messages;
	} record;
};

struct config_error {
	char text[512]; /* "FILE:LINE: what is wrong, what to do" */
};

/* Parses `len` bytes of YAML; `file` is for messages. 0, -EINVAL (with the sentence), -ENOMEM. Nothing is half filled. */
int config_read(const char *text, size_t len, const char *file, struct config *ret, struct config_error *error);

/* All defaults, no devices. */
void config_default(struct config *);

/* Assembler parameters of the scanner `device` (index into config->device). */
void config_sweep_params(const struct config *, int device, struct sweep_params *ret);

#endif

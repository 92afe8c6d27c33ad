/* A drive behind Modbus as a map of registers: pure, in anybody's time. sim_servo.c puts it behind libmodbus in a
 * thread, the rig behind a virtual bus.
 *
 * Registers, holding and input alike; 32-bit values in the order of the parameters (default: high word first):
 *
 *    0,1  position i32, 0.001 degree        12,13 acceleration u32, 0.001 degree/s^2; 0: infinite
 *    2,3  target   i32, 0.001 degree        14,15 target f32, degrees (writes go to 2,3)
 *    4,5  speed    u32, 0.001 degree/s      16    control
 *    6    1 while it moves; strict: status  17    status
 *    7    position i16, 0.01 degree         18    error code, 0: none
 *    8,9  position f32, degrees             20    watchdog
 *    10,11 speed  f32, degrees/s            21    its time, ms (300)
 *
 *    control  6: ready; 15: enabled; edges up: 0x10 start, 0x20 home (here is angle 0), 0x80 fault reset; 0x100 halt
 *    status   1 moving, 2 ready, 4 enabled, 8 fault, 16 in position, 32 homed, 64 stopped by the watchdog
 *
 * The simple drive (default) goes where `target` says as soon as it is written. The strict one takes a target only when it
 * is enabled and at the edge of `start`. The watchdog begins with its first write: not written for its time, the drive stops, in either kind, and takes no target until it is written again. A fault
 * disables; it is left by the edge of reset. */
#ifndef FACET_TOOLS_SIM_DRIVE_H
#define FACET_TOOLS_SIM_DRIVE_H

#include "drivers/modbus_wire.h"
#include "tools/sim_axis.h"
#include "tools/sim_device.h"

enum sim_drive_register {
	SIM_DRIVE_POSITION = 0,
	SIM_DRIVE_TARGET = 2,
	SIM_DRIVE_SPEED = 4,
	SIM_DRIVE_MOVING = 6,
	SIM_DRIVE_POSITION_I16 = 7,
	SIM_DRIVE_POSITION_F32 = 8,
	SIM_DRIVE_SPEED_F32 = 10,
	SIM_DRIVE_ACCELERATION = 12,
	SIM_DRIVE_TARGET_F32 = 14,
	SIM_DRIVE_CONTROL = 16,
	SIM_DRIVE_STATUS = 17,
	SIM_DRIVE_ERROR = 18,
	SIM_DRIVE_WATCHDOG = 20,
	SIM_DRIVE_WATCHDOG_TIME = 21,
	SIM_DRIVE_REGISTERS = 32
};
enum sim_drive_status {
	SIM_DRIVE_IS_MOVING = 1,
	SIM_DRIVE_IS_READY = 2,
	SIM_DRIVE_IS_ENABLED = 4,
	SIM_DRIVE_HAS_FAULT = 8,
	SIM_DRIVE_IN_POSITION = 16,
	SIM_DRIVE_IS_HOMED = 32,
	SIM_DRIVE_UNWATCHED = 64
};

struct sim_drive_params {
	int unit;     /* 1..247 */
	bool strict;  /* enable and start are needed */
	bool unhomed; /* strict: no start before `home` */
	bool toggles; /* the watchdog counts only a value that differs from the one before */
	enum { SIM_DRIVE_ABCD, SIM_DRIVE_CDAB, SIM_DRIVE_BADC, SIM_DRIVE_DCBA } order; /* as config_register's */
	struct sim_axis *axis;                                                         /* borrowed; NULL: its own ... */
	double angle_rad;    /* ... that stands there at first */
	double acceleration; /* rad/s^2; 0: infinite. The register's first value */
	uint64_t seed;
};

struct sim_drive;
struct sim_drive *sim_drive_create(const struct sim_drive_params *, int64_t t_ns); /* NULL: out of memory */
void sim_drive_destroy(struct sim_drive *);
struct sim_axis *sim_drive_axis(struct sim_drive *);

/* The registers as they are at t_ns, times never going back. 0, or the exception code: 2 no such register, 3 no such value,
 * 4 not in this state. A write of several is done whole or not at all. */
int sim_drive_read(struct sim_drive *, uint16_t address, uint16_t n, int64_t t_ns, uint16_t *ret_values);
int sim_drive_write(struct sim_drive *, uint16_t address, uint16_t n, const uint16_t *values, int64_t t_ns);

/* It stands there, by magic, and that is its target: recorded sweeps being played. */
void sim_drive_place(struct sim_drive *, double angle_rad, int64_t t_ns);

/* A request and what comes back, faults included. Of `request` the unit, the function (3, 4, 6, 16), address, n and, of
 * writes, the values count. */
struct sim_drive_answer {
	enum sim_drive_verdict {
		SIM_DRIVE_ANSWERED, /* `transaction`; refused: function | MODBUS_WIRE_REFUSED and the code in value[0] */
		SIM_DRIVE_SILENT,   /* nothing comes */
		SIM_DRIVE_WRONG_UNIT, /* the answer is right but for its unit, which is transaction.unit */
		SIM_DRIVE_CORRUPT,    /* its check sum is wrong */
		SIM_DRIVE_DROPPED     /* the connection ends; on a serial line: silent */
	} verdict;
	int64_t delay_ns; /* it leaves so much later; it carries what was true when the request came */
	struct modbus_transaction transaction;
};
void sim_drive_transact(struct sim_drive *, const struct modbus_transaction *request, int64_t t_ns,
                        struct sim_drive_answer *ret);

/* The drive stops by itself: its owner calls `advance` at the latest at `deadline` (INT64_MAX: none). */
void sim_drive_advance(struct sim_drive *, int64_t t_ns);
int64_t sim_drive_deadline(const struct sim_drive *);

/* Faults: "silence" (no answers), "lost" (share of them, or the next), "busy" (exception 6), "late" (ms, default 20),
 * "jitter" (answers take up to so many ms longer, default 20), "wrong unit", "crc", "drop" (the connection ends), "torn" (registers
 * are sampled one after the other, ms apart, default 2), "fault" (error code, default 0x4310; with `for` it cannot be reset so long),
 * "stuck", "slow" (share of the speed, default 0.5), "restart" (as after a power cycle: registers as at first). */
bool sim_drive_fault(struct sim_drive *, const struct sim_fault *, bool on, int64_t t_ns);
const char *const *sim_drive_fault_kinds(void);

#endif

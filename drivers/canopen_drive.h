/* A drive after CiA 402, from whatever state it is in to one that does what it is told: pure, in the caller's time.
 *
 *   begin ─► waiting ─► calming ─► preparing ─► switching ─► enabling ─► (homing ─► switching) ─► running ─► ending ─► ended
 *               │  ▲                                                                        │
 *      a fault  ▼  │ reset, once                                                            ▼
 *            resetting ──────────── the fault stays ──────────────────────────────────► standing: `why`
 *
 * What the drive says comes in by its statusword, its position, EMCY and answers to SDO transfers; what it is to be told
 * goes out as frames of RPDO 1 (6040 and 607A, in mode velocity 60FF) and one SDO transfer at a time. */
#ifndef FACET_DRIVERS_CANOPEN_DRIVE_H
#define FACET_DRIVERS_CANOPEN_DRIVE_H

#include "config/config.h"
#include "drivers/canopen_wire.h"

#define CANOPEN_DRIVE_FRAMES     3                     /* of one step: a target, its edge, and a halt */
#define CANOPEN_DRIVE_STEP_NS    INT64_C(1000000000)   /* for each transition, and each answer to a command */
#define CANOPEN_DRIVE_ENABLE_NS  INT64_C(3000000000)   /* for the last one: brakes open, motors find their phases */
#define CANOPEN_DRIVE_REPEAT_NS  INT64_C(100000000)    /* a command that shows no effect is sent again */
#define CANOPEN_DRIVE_EARNED_NS  INT64_C(600000000000) /* who ran so long without a fault may be reset once more */
#define CANOPEN_DRIVE_UNHEARD_NS INT64_C(2000000000)   /* ... after a fault, or a stop, of the communication (81xx) */
#define CANOPEN_DRIVE_UNHEARD    5                     /* of those in a row, each before it ran so long: it stays */

struct canopen_drive_setup {
	int mode;              /* CANOPEN_POSITION, CANOPEN_VELOCITY, CANOPEN_CYCLIC */
	uint32_t acceleration; /* counts/s^2 */
	int64_t period_ns;     /* of SYNC: the time that cyclic set-points are apart */
	bool homes;
	int method;            /* 6098 */
	uint32_t homing_speed; /* counts/s */
	int32_t home_count;    /* its position at home, 607C */
	int64_t homing_ns;
};

enum canopen_drive_phase {
	CANOPEN_DRIVE_IDLE, /* listened to only */
	CANOPEN_DRIVE_WAITING,
	CANOPEN_DRIVE_RESETTING,
	CANOPEN_DRIVE_CALMING,
	CANOPEN_DRIVE_PREPARING,
	CANOPEN_DRIVE_SWITCHING,
	CANOPEN_DRIVE_ENABLING,
	CANOPEN_DRIVE_HOMING,
	CANOPEN_DRIVE_RUNNING,
	CANOPEN_DRIVE_STANDING,
	CANOPEN_DRIVE_ENDING,
	CANOPEN_DRIVE_ENDED
};

struct canopen_drive_wish {
	int frames; /* of RPDO 1, to be sent now and in this order */
	struct {
		uint16_t control;
		int32_t demand; /* counts, in mode velocity counts/s */
	} frame[CANOPEN_DRIVE_FRAMES];
	bool asks; /* this transfer is wanted, until canopen_drive_answer */
	struct {
		bool download;
		uint16_t index;
		uint8_t sub, size;
		uint32_t value;
	} ask;
	int64_t deadline_ns;
};

/* By value; what is not named a result is its own business. */
struct canopen_drive {
	struct canopen_drive_setup setup;

	/* Results. */
	enum canopen_drive_phase phase;
	char why[120];  /* STANDING: one sentence without the drive's name */
	char note[120]; /* what it refused and can do without; else empty */
	bool homed;     /* since it was switched on, as far as this side knows */
	bool limited;   /* 607D says: */
	int32_t limit[2];
	int resets;             /* rising edges of the fault reset, ever */
	uint32_t taken, speeds; /* set-points acknowledged, speeds written: counted up */
	int32_t taken_count;    /* the last of each */
	uint32_t taken_speed;
	enum canopen_drive_state state;

	/* What was heard. */
	uint16_t status;
	bool status_known, position_known;
	int32_t position;
	int64_t status_ns;
	int shown;     /* 6061; INT_MIN: not known */
	uint16_t code; /* of the last EMCY that was none of "gone", or 603F */

	/* The present phase. */
	int64_t begun_ns, due_ns, step_ns;
	enum canopen_drive_state step_state; /* that of the last transition */
	int at;                              /* which object; which part of a handshake */
	uint16_t control;
	int32_t demand;
	bool send;

	/* Set-points of mode position. */
	enum { SET_POINT_NONE, SET_POINT_RAISED, SET_POINT_LOWERED } handshake;
	int64_t waited_ns, looked_ns; /* for its other hand, as far as it was looked at; when that was */
	bool goes, speed_due, moves;
	int32_t target, raised;
	uint32_t speed;

	/* What may still be forgiven. */
	bool spent, was_fault, cured;
	bool silent; /* an EMCY of the communication came since it was enabled */
	int unheard, losses;
	int64_t ran_since_ns, bit_since_ns;
	bool bit_seen;
	enum { STANDS_BY_FAULT, STANDS_BY_STATE, STANDS_BY_ITSELF } reason;
};

void canopen_drive_init(struct canopen_drive *, const struct canopen_drive_setup *);
/* The way up begins, from whatever state it is in; what it stood for is forgotten, the reset it had is not. */
void canopen_drive_begin(struct canopen_drive *, int64_t t_ns);
/* It was switched off and on: it has no home, and a fault may be reset again. */
void canopen_drive_booted(struct canopen_drive *);

void canopen_drive_status(struct canopen_drive *, uint16_t statusword, int64_t t_ns);
void canopen_drive_position(struct canopen_drive *, int32_t count);
void canopen_drive_emergency(struct canopen_drive *, uint16_t code);
/* The transfer that was asked for: `value` uploaded, or the abort code. */
void canopen_drive_answer(struct canopen_drive *, bool good, uint32_t value, int64_t t_ns);

/* Mode position, RUNNING: a target, and the speed towards it (taken before it). False: beyond the limits; it is not sent. */
bool canopen_drive_goto(struct canopen_drive *, int32_t count);
void canopen_drive_speed(struct canopen_drive *, uint32_t counts_per_s);
/* The other modes, at every SYNC: the set-point (counts, or counts/s). Outside RUNNING it is ignored, and the drive is
 * sent what keeps it still. False: beyond the limits; the one before is sent. */
bool canopen_drive_follow(struct canopen_drive *, int32_t demand);

/* Stands, enabled, until it is begun anew. */
void canopen_drive_halt(struct canopen_drive *, const char *why, int64_t t_ns);
/* Quick stop, then without power: ENDED. */
void canopen_drive_end(struct canopen_drive *, int64_t t_ns);

void canopen_drive_step(struct canopen_drive *, int64_t t_ns, struct canopen_drive_wish *ret);

#endif

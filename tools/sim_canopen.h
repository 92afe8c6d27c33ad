/* Simulated CANopen nodes: a drive (CiA 402), an encoder (CiA 406), an inclinometer (CiA 410). Brains (sim_device.h)
 * whose bytes are whole entries of drivers/can_wire.h in both directions, on the owner's clock:
 *
 *   receive   frames of everybody on the bus, its own apart; t_ns of an entry: when it was on the bus, 0: now
 *   transmit  whole entries, as many as fit in `cap`; t_ns: when the frame left
 *
 * The node boots when it is made (boot-up message, pre-operational) and waits to be started by NMT. Server, mappings,
 * states are an independent reading of the standards: they refuse what a real node refuses.
 *
 * A drive stops by itself: when the master's heartbeat (1016) is late by more than its time it does what 6007 says, at
 * the deceleration of 6085 (fault, quick stop) or at once (voltage off). Out of the box 6007 is 0 and 1016 empty: it goes
 * on for ever, as many real drives do. What is written is kept over NMT resets and lost with the power, unless `keeps`. */
#ifndef FACET_TOOLS_SIM_CANOPEN_H
#define FACET_TOOLS_SIM_CANOPEN_H

#include "tools/sim_axis.h"
#include "tools/sim_device.h"

enum sim_canopen_kind { SIM_CANOPEN_DRIVE, SIM_CANOPEN_ENCODER, SIM_CANOPEN_INCLINOMETER };

struct sim_canopen_params {
	enum sim_canopen_kind kind;
	int node;              /* 1..127 */
	struct sim_axis *axis; /* on which it stands, borrowed: a drive moves it; NULL: one of its own ... */
	double angle_rad;      /* ... that stands there at first */
	double count_rad;      /* of its position; 0: 0.001 degree. The inclinometer's is its resolution (6000) */
	int sign;              /* of counts against the axis; 0: 1 */
	bool unhomed;          /* drive: it counts from 0 where it was switched on, and is not homed */
	double switch_rad
	    [2];       /* drive: limit switches for homing methods 17 and 18, in the axis' sense; equal: +-90 degrees */
	bool keeps;    /* what was written outlives its power */
	bool factory;  /* encoder, inclinometer: mapped as the profiles say; else, and drives always: something else */
	bool lateral;  /* inclinometer: the axis tilts 6020, not 6010 */
	uint64_t seed; /* of how long its answers take */
};

/* Faults to order (struct sim_fault). Those with `for` hold so long; without it they befall once.
 *   "heartbeat"    its heartbeat does not come
 *   "silent"       it sends nothing at all (and hears: a drive goes on moving)
 *   "power cycle"  value: off for so many s (default 1), then it boots up
 *   "off"          it has no power as long as this holds, then it boots up
 *   "emcy"         an emergency message, value: its code (default 0x8110), the state does not change
 *   "fault"        drive: into the state fault with code `value` (default 0x4310); `for`: it cannot be reset so long
 *   "stuck"        drive: the axis stands; a following error (8611) follows
 *   "slow"         drive: the axis makes so much of the speed (value, default 0.5)
 *   "homing"       drive: homing ends in an error
 *   "limit"        drive: its limit switch is hit: internal limit (bit 11), it stops
 *   "sdo abort"    value: the index (default 0: the next), refused with 08000022
 *   "sdo timeout"  requests are not answered
 *   "sdo echo"     answers to writes carry the data back
 *   "sdo short"    answers are only as long as their data
 *   "late"         TPDOs leave so many ms (value, default 3) after their SYNC
 *   "no pdo"       it does not send TPDOs
 *   "mapping"      the mapping was lost (as after a power cycle), nobody is told */

/* 0, -EINVAL, -ENOMEM; ret->destroy frees. counts: profiles: angles sent in TPDOs; requests, replies: SDO. */
int sim_canopen_create(const struct sim_canopen_params *, int64_t t_ns, struct sim_device *ret);

/* Its axis: where the scanner truly looks. */
struct sim_axis *sim_canopen_axis(const struct sim_device *);
/* What a test may want to know of a drive; -1 elsewhere. */
int sim_canopen_status_word(const struct sim_device *); /* 6041 */
int sim_canopen_nmt_state(const struct sim_device *);   /* 0x04, 0x05, 0x7f; 0: no power */

#endif

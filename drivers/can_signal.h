/* A number in a CAN frame, as DBC files describe it (protocols C.1): pure.
 *
 *   byte   0                 1                          intel: `start` is the lowest bit, and the number goes on to
 *   bit    7 6 5 4 3 2 1 0   15 14 13 12 11 10 9 8      higher ones; motorola: `start` is the highest bit, and it goes
 *                                                       down to bit 0 of the byte, then to bit 7 of the next byte
 *
 * so 16 bits from byte 0 are `start: 0` in intel's order and `start: 7` in motorola's. */
#ifndef FACET_DRIVERS_CAN_SIGNAL_H
#define FACET_DRIVERS_CAN_SIGNAL_H

#include "config/config.h"
#include "core/state.h"
#include "drivers/can_wire.h"

/* Why a frame holds no value, in the order in which it is judged. */
enum can_signal_verdict {
	CAN_SIGNAL_GOOD,
	CAN_SIGNAL_FOREIGN,   /* another id, or the same number in the other kind of ids; CAN_WIRE_LOST too */
	CAN_SIGNAL_ERROR,     /* an error frame */
	CAN_SIGNAL_REMOTE,    /* a request for this frame */
	CAN_SIGNAL_SHORT,     /* below min_dlc, or a bit lies beyond its end */
	CAN_SIGNAL_OTHER_MUX, /* its multiplexor says that it holds something else */
	CAN_SIGNAL_INVALID,   /* the sender says that the value is not good */
	CAN_SIGNAL_NO_NUMBER, /* a float that is none, or a quantity that is not finite */
	CAN_SIGNAL_VERDICTS
};
const char *can_signal_name(enum can_signal_verdict); /* for counters */

struct can_signal_value {
	double value;     /* raw * scale + offset */
	double raw;       /* the number as it is in the frame; beyond 2^53 rounded */
	uint64_t bits;    /* its bits, the lowest first */
	uint32_t counter; /* of a signal that has one; else 0 */
};
enum can_signal_verdict can_signal_get(const struct config_signal *, const struct can_frame_at *,
                                       struct can_signal_value *ret);

/* Bytes that a frame must have for all of the signal: min_dlc, its bits, its counter, valid bit and multiplexor. Beyond 64
 * no frame has it. */
int can_signal_needs(const struct config_signal *);

/* What the counter tells of good frames, and of frames whose valid bit was not set. A gap is counted, the frame is used. */
struct can_signal_counter {
	bool known;
	uint32_t last;
	uint64_t lost;  /* frames that never came */
	uint64_t stuck; /* frames whose counter was the one before */
};
void can_signal_follow(const struct config_signal *, struct can_signal_counter *, uint32_t counter);
void can_signal_state(struct state *, struct can_signal_counter *);

/* For senders: an empty frame that has room for the signal (FD beyond 8 bytes), and the value put into a frame that has:
 * rounded, limited to what its bits can say, with multiplexor and valid bit. Other bits stay. */
struct can_frame_at can_signal_frame(const struct config_signal *);
void can_signal_put(const struct config_signal *, double value, struct can_frame_at *);
void can_signal_put_bits(const struct config_signal *, uint64_t bits, struct can_frame_at *); /* the raw number's */
void can_signal_put_counter(const struct config_signal *, uint32_t counter, struct can_frame_at *);

#endif

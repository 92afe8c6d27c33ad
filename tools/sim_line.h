/* What leaves a simulated device, and when: telegrams in, pieces of bytes out at their times, and the faults that befall
 * any telegram on its way. No descriptor, no clock. */
#ifndef FACET_TOOLS_SIM_LINE_H
#define FACET_TOOLS_SIM_LINE_H

#include "tools/sim_device.h"

#define SIM_LINE_PIECES 128 /* more than wait here do not fit: the telegram is lost */

/* Kinds every line has, in the order of enum sim_line_fault; a device's own follow in its table. Those with a share of
 * telegrams ("lost 0.1") take every one without it. Without a duration they befall the next telegram with a profile. */
#define SIM_LINE_KINDS \
	"silence", "stall", "garbage", "corrupt", "crc", "lost", "duplicate", "split", "merge", "gap", "jitter"
enum sim_line_fault {
	SIM_SILENCE,   /* nothing leaves, replies neither; it is lost */
	SIM_STALL,     /* nothing leaves, then all that fits at once */
	SIM_GARBAGE,   /* bytes that mean nothing at the full rate, instead of telegrams */
	SIM_CORRUPT,   /* a byte of the telegram is wrong; share */
	SIM_CRC,       /* its last byte is: check sum, or CoLa-A's end; share */
	SIM_LOST,      /* share */
	SIM_DUPLICATE, /* sent twice; share */
	SIM_SPLIT,     /* every byte is a piece of its own */
	SIM_MERGE,     /* so many telegrams wait for each other and leave as one piece; 2 */
	SIM_GAP,       /* pause within the telegram, ms; 14 */
	SIM_JITTER,    /* leaves late by up to so many ms; 5 */
	SIM_LINE_FAULTS
};

struct sim_piece {
	size_t len, sent;
	int64_t begin_ns, end_ns; /* its first byte may leave from begin on, its last at end */
	bool last, profile, bad;  /* ends a telegram; of a profile; which left wrong */
	bool joined;              /* the next one leaves in the same transfer */
};

struct sim_line {
	double byte_ns; /* time of a byte at the line's pace; 0: a piece leaves at once */
	bool text;      /* telegrams are text, without a check sum: a wrong byte is one that text cannot have */
	size_t segment; /* a longer telegram leaves in pieces of this size, 0.3 ms apart; 0: whole */
	struct sim_fault_state fault[SIM_LINE_FAULTS];
	struct sim_counts counts;
	uint64_t random;
	uint8_t *bytes; /* what waits, one piece behind the other */
	size_t cap, begin, end;
	struct sim_piece piece[SIM_LINE_PIECES]; /* a ring */
	unsigned first, pieces;
	int64_t end_ns; /* when the last byte will have left */
	int64_t garbage_ns;
	int merged;
};

int sim_line_init(struct sim_line *, size_t cap, uint64_t seed);
void sim_line_finish(struct sim_line *);
void sim_line_clear(struct sim_line *); /* what waits is lost */

/* A telegram that is ready at from_ns, a profile or not. False: it never leaves (counted). */
bool sim_line_put(struct sim_line *, const uint8_t *telegram, size_t len, int64_t from_ns, bool profile);
/* Bytes of one piece that have left by t_ns. `spoil`: a telegram that leaves now counts as wrong. */
size_t sim_line_take(struct sim_line *, uint8_t *buf, size_t cap, int64_t t_ns, bool spoil);
int64_t sim_line_deadline(const struct sim_line *, int64_t t_ns); /* INT64_MAX: nothing waits */
bool sim_line_idle(const struct sim_line *);
/* False: no fault of a line. */
bool sim_line_order(struct sim_line *, const struct sim_fault *, bool on, int64_t t_ns);

#endif

/* SDO client of one node: pure. One transfer at a time, of any object up to CANOPEN_SDO_MAX bytes; time is the
 * caller's.
 *
 *   canopen_sdo_upload(c, 0x1018, 1);
 *   while (c->state == CANOPEN_SDO_BUSY): canopen_sdo_step(c, t_ns, &frame) says whether `frame` is to be sent now,
 *   canopen_sdo_answer(c, bytes, len) takes what came, canopen_sdo_deadline(c) says when to step again at the latest.
 *
 * An answer about another object, one out of turn, or a late one of a transfer given up is never taken. An answer that
 * does not come within CANOPEN_SDO_TIMEOUT_NS is given up with an abort and the transfer begun anew, at most
 * CANOPEN_SDO_TRIES times in all. */
#ifndef FACET_DRIVERS_CANOPEN_SDO_H
#define FACET_DRIVERS_CANOPEN_SDO_H

#include "drivers/canopen_wire.h"

#define CANOPEN_SDO_MAX        256 /* a longer object is aborted: 0x05040005 */
#define CANOPEN_SDO_TIMEOUT_NS INT64_C(500000000)
#define CANOPEN_SDO_TRIES      3

struct canopen_sdo {
	int node;
	enum { CANOPEN_SDO_IDLE, CANOPEN_SDO_BUSY, CANOPEN_SDO_DONE, CANOPEN_SDO_FAILED } state;
	uint16_t index;
	uint8_t sub;
	bool download;
	uint32_t abort; /* FAILED: why; CANOPEN_ABORT_TIMEOUT: no answer */
	bool refused;   /* FAILED: the node aborted it, not this side */
	bool sized;     /* DONE, upload: the node said the length; else `data` may be longer than the object */
	size_t len;
	uint8_t data[CANOPEN_SDO_MAX]; /* uploaded, or to be downloaded */

	/* Its own. */
	int tries;
	bool send, toggle, begun, announced;
	uint32_t abort_first; /* to be sent before anything else */
	uint16_t abort_index;
	uint8_t abort_sub;
	size_t at;   /* bytes done */
	size_t size; /* announced by the node */
	int64_t deadline_ns;
	uint64_t ignored; /* answers that were not taken */
};

void canopen_sdo_init(struct canopen_sdo *, int node);
/* Begins; a transfer that was under way is given up (an abort goes out first). */
void canopen_sdo_upload(struct canopen_sdo *, uint16_t index, uint8_t sub);
void canopen_sdo_download(struct canopen_sdo *, uint16_t index, uint8_t sub, const void *data, size_t len);
/* Number of `size` bytes, little-endian. */
void canopen_sdo_write(struct canopen_sdo *, uint16_t index, uint8_t sub, uint8_t size, uint32_t value);

/* Data of a frame CANOPEN_SDO_ANSWER + node. True: it belonged to the transfer. */
bool canopen_sdo_answer(struct canopen_sdo *, const uint8_t *bytes, size_t len);
/* True: `ret` is to be sent now, and this called again. */
bool canopen_sdo_step(struct canopen_sdo *, int64_t t_ns, struct can_frame_at *ret);
/* INT64_MIN: something is to be sent; INT64_MAX: nothing is awaited. */
int64_t canopen_sdo_deadline(const struct canopen_sdo *);
/* What was uploaded as a number of `size` (1..4) bytes; shorter data are widened with 0. */
uint32_t canopen_sdo_number(const struct canopen_sdo *, uint8_t size);

#endif

/* Which SYNC an answer belongs to: pure. A node sends a TPDO of transmission type n once in n SYNCs, in their order, so as
 * long as no more SYNCs are unanswered than that, the newest one it is. One TPDO that leaves late, behind the next SYNC,
 * would take that one's time and be wrong by a period: at 37.5 degrees/s and 10 ms by 0.375 degree.
 *
 * Too many unanswered SYNCs mean that a TPDO is late, or lost. Which of them shows by its delay: one that comes as soon
 * after a SYNC as ever is that one's, and what was missing is lost. One that comes at another time is not used. Late ones
 * catch up: two come between two SYNCs, and the count is right again. When for CANOPEN_PAIRING_STEADY SYNCs each had its
 * one answer, the node has become slower, and counting begins anew. */
#ifndef FACET_DRIVERS_CANOPEN_PAIRING_H
#define FACET_DRIVERS_CANOPEN_PAIRING_H

#include <stdbool.h>
#include <stdint.h>

#include "core/state.h"

#define CANOPEN_PAIRING_STEADY 4

struct canopen_pairing { /* of one TPDO */
	bool heard;
	uint8_t unanswered; /* SYNCs; at its limit it stays */
	uint8_t came;       /* answers since the last SYNC */
	uint8_t steady;     /* SYNCs in a row with one answer, while in doubt */
	bool doubted;       /* the answer since the last SYNC */
	int64_t delay_ns;   /* of answers that nobody doubts, smoothed */
};

void canopen_pairing_sync(struct canopen_pairing *);
/* A TPDO of type `every` (1..240) came so long after the newest SYNC; true: it belongs to that one, or that one's successor
 * was missed (it is older than a period, and answered). */
bool canopen_pairing_take(struct canopen_pairing *, uint8_t every, int64_t delay_ns, int64_t period_ns);
void canopen_pairing_state(struct state *, struct canopen_pairing *);

#endif

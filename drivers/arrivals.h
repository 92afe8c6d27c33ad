/* Which read delivered which byte. A telegram may be found long after its bytes came: what looked like the begin of another
 * one stood before it and asked for more. Its time is that of its own bytes. Pure. */
#ifndef FACET_DRIVERS_ARRIVALS_H
#define FACET_DRIVERS_ARRIVALS_H

#include <stddef.h>
#include <stdint.h>

#include "core/state.h"

#define ARRIVALS_MAX 64 /* newest reads; bytes of older ones are dated by the oldest of these */

struct arrivals {
	uint64_t bytes; /* so far */
	int first, n;
	struct arrivals_read {
		int64_t t_ns;
		uint64_t end; /* count of bytes with it */
	} read[ARRIVALS_MAX]; /* a ring */
};

void arrivals_note(struct arrivals *, size_t len, int64_t t_ns);
/* When the byte came that stands `back` bytes before the end; 1: the last one. 0: nothing came yet. */
int64_t arrivals_at(const struct arrivals *, uint64_t back);
void arrivals_state(struct state *, struct arrivals *);

#endif

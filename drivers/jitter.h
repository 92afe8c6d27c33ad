/* How far arrivals are behind the least delayed ones, over the last thousand: for the status, nothing is decided by it.
 * For devices without a clock of their own; those that stamp have device_clock.h. */
#ifndef FACET_DRIVERS_JITTER_H
#define FACET_DRIVERS_JITTER_H

#include <stdint.h>

#define JITTER_KEPT 1024

struct jitter {
	uint64_t n;                    /* ever noted */
	int32_t delay_us[JITTER_KEPT]; /* ring */
};

/* Delays beyond half an hour either way count as that. */
void jitter_note(struct jitter *, int64_t delay_ns);
/* 0 before anything was noted. */
void jitter_percentiles(const struct jitter *, int64_t *ret_p50_ns, int64_t *ret_p99_ns);

#endif

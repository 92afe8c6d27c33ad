/* One framer for every protocol: it owns the buffer and the search for the next telegram; a protocol only judges bytes.
 *
 *   push bytes -> | skipped | telegram | telegram | begun ... |
 *                           ^ scan looks here: a length, "need more", or "not here, because"
 *
 * A false start costs one byte, so a good telegram is found wherever it begins, also inside a broken one. Memory is the
 * caller's buffer; what is longer than it is refused. Pure: silence is told by the caller, who knows the times. */
#ifndef FACET_DRIVERS_FRAMER_H
#define FACET_DRIVERS_FRAMER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "core/state.h"

/* Answers of a scan. Reasons of refusal are the protocol's own, from FRAMER_OWN on. */
enum framer_reason {
	FRAMER_MORE = 0,
	FRAMER_CUT = 1,      /* it never got its end: silence, or the buffer is full */
	FRAMER_NO_START = 2, /* not the first byte of a telegram */
	FRAMER_OWN = 3,
	FRAMER_REASONS = 8
};

/* Judges the bytes at buf: > 0 the length of the whole and checked telegram that begins here (at most len),
 * FRAMER_MORE, or minus a reason. `boundary`: directly after a telegram or a silence, where single-byte answers may
 * stand. */
typedef int framer_scan(void *ctx, const uint8_t *buf, size_t len, bool boundary);

struct framer {
	framer_scan *scan;
	void *ctx;
	uint64_t refused[FRAMER_REASONS]; /* by reason */
	uint64_t skipped;                 /* bytes that belong to no telegram */
	size_t begin, end;                /* what of buf is not yet judged */
	size_t silence;                   /* end of what came before the last silence, 0: none is left of it */
	bool boundary;
	uint8_t *buf; /* borrowed */
	size_t cap;
};

/* `buf`: `cap` bytes that live as long as the framer; no telegram may be longer. */
void framer_init(struct framer *, framer_scan *, void *ctx, uint8_t *buf, size_t cap);

/* Takes bytes, as many as there is room for; after framer_take has answered 0 there is room for at least one. */
size_t framer_push(struct framer *, const uint8_t *bytes, size_t len);

/* The next telegram's length, or 0: push more. The telegram is borrowed until the next call. */
size_t framer_take(struct framer *, const uint8_t **ret_telegram);

/* Nothing came for long; what is pushed from here on came after a silence. A telegram that was begun before is still taken when
 * the next push makes it whole (it was the host that slept, and the line kept the rest), else it is refused, so that what
 * stands behind it is not held up; the silence is a boundary, too. */
void framer_silence(struct framer *);

/* The link was opened anew: what was begun is refused, whatever comes next stands at a boundary. Counters stay. */
void framer_restart(struct framer *);

/* Snapshot (core/state.h); scan, ctx and buffer stay the framer's own. */
void framer_state(struct state *, struct framer *);

#endif

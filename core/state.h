/* Snapshots of what has memory: decoders, clock filters, rings (law L7: every recording begins with them).
 *
 * One function per module names its fields once and serves both ways:
 *
 *   void clock_state(struct state *s, struct clock *c)
 *   {
 *           state_i64(s, &c->offset_ns);
 *           state_int(s, &c->n, 0, CLOCK_SAMPLES);
 *   }
 *
 * Saving appends the field, loading fills it; little-endian, the same on every machine. A snapshot comes from a file, so
 * nothing in it is trusted: bounds are given with the field, and a value outside fails the whole load. Failure is sticky;
 * fields are left as they were from there on, so a module is loaded aside and taken over only when all went well. */
#ifndef FACET_CORE_STATE_H
#define FACET_CORE_STATE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Times from 1900 to 2093, so that sums of two, and half as much again as a difference, are within an int64_t. */
#define STATE_TIME_MIN (-INT64_C(2200000000000000000))
#define STATE_TIME_MAX INT64_C(3900000000000000000)

struct state {
	bool loading;
	uint8_t *bytes; /* saving: the caller's memory, cap bytes; loading: read only */
	size_t cap;     /* saving: room; loading: what there is */
	size_t at;      /* saving: bytes needed so far, also beyond cap */
	bool failed;    /* loading: cut, or a value outside its bounds */
};

void state_save(struct state *, void *bytes, size_t cap); /* NULL, 0: only to learn how many bytes it takes */
void state_load(struct state *, const void *bytes, size_t len);
bool state_done(
    const struct state *); /* saving: all of it had room; loading: all of it was good, and nothing is left */

void state_u8(struct state *, uint8_t *);
void state_u16(struct state *, uint16_t *);
void state_u32(struct state *, uint32_t *);
void state_u64(struct state *, uint64_t *);
void state_i64(struct state *, int64_t *);
void state_double(struct state *, double *); /* its bits; no NaN, no infinity is accepted */
void state_float(struct state *, float *);   /* its bits, whatever they say: four bytes, for long arrays */
void state_bool(struct state *, bool *);
void state_int(struct state *, int *, int min, int max);
void state_size(struct state *, size_t *, size_t max);
void state_time(struct state *, int64_t *); /* ns, within STATE_TIME_MIN .. _MAX */
void state_bytes(struct state *, void *, size_t len);
/* A word of at most 15 letters that must be there when loading: the name and version of what follows, e.g. "clock1". */
void state_tag(struct state *, const char *word);

#endif

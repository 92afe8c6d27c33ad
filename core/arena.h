/* Scratch memory that is reset between units of work: no allocation per point or per profile in steady state.
 * An arena grows by whole chunks, keeps them over a reset and remembers its peak. */
#ifndef FACET_CORE_ARENA_H
#define FACET_CORE_ARENA_H

#include <stddef.h>

struct arena_chunk;

struct arena {
	struct arena_chunk *first, *current;
	size_t used;  /* bytes given out since the last reset */
	size_t peak;  /* most bytes ever given out between two resets */
	size_t total; /* bytes of all chunks */
};

void arena_init(struct arena *);
void arena_finish(struct arena *);
void arena_reset(struct arena *);

/* `n` * `size` zeroed bytes, aligned to 16; NULL when memory is out (or n * size overflows). */
void *arena_alloc(struct arena *, size_t n, size_t size);

/* The same, but the bytes are what they were: for arrays whose every element is written before it is read. A build without
 * optimisation fills them, so that one that is read too early shows. */
void *arena_take(struct arena *, size_t n, size_t size);

#define ARENA_TAKE(arena, type, n) ((type *)arena_take((arena), (n), sizeof(type)))
#define ARENA_NEW(arena, type, n)  ((type *)arena_alloc((arena), (n), sizeof(type)))

#endif

/* A list of chunks that only grows: allocation moves a mark through the current chunk, a reset moves it back to the
 * first. A request that does not fit goes to the next chunk that is large enough; what it skips is lost until the
 * reset, which costs little since chunks double. */
#include "core/arena.h"

#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define ALIGNMENT   16
#define CHUNK_FIRST ((size_t)64 << 10)
#define CHUNK_MOST  ((size_t)4 << 20) /* chunks double up to here; a larger request gets a chunk of its own size */

struct arena_chunk {
	struct arena_chunk *next;
	size_t size, used;
	size_t pad; /* keeps the bytes that follow aligned */
};

_Static_assert(sizeof(struct arena_chunk) % ALIGNMENT == 0, "bytes behind a chunk's head are aligned");

void arena_init(struct arena *arena)
{
	*arena = (struct arena){0};
}

void arena_finish(struct arena *arena)
{
	while (arena->first) {
		struct arena_chunk *next = arena->first->next;

		free(arena->first);
		arena->first = next;
	}
	arena_init(arena);
}

void arena_reset(struct arena *arena)
{
	for (struct arena_chunk *c = arena->first; c; c = c->next)
		c->used = 0;
	arena->current = arena->first;
	arena->used = 0;
}

static struct arena_chunk *chunk_append(struct arena *arena, size_t bytes)
{
	struct arena_chunk *last = arena->current, *c;
	size_t size = CHUNK_FIRST;

	while (last && last->next)
		last = last->next;
	if (last)
		size = last->size < CHUNK_MOST / 2 ? 2 * last->size : CHUNK_MOST;
	if (size < bytes)
		size = bytes;
	c = malloc(sizeof(*c) + size);
	if (!c)
		return NULL;
	*c = (struct arena_chunk){.size = size};
	if (last)
		last->next = c;
	else
		arena->first = c;
	arena->total += sizeof(*c) + size;
	return c;
}

/* `bytes` is a multiple of ALIGNMENT. */
static void *arena_push(struct arena *arena, size_t bytes)
{
	struct arena_chunk *c = arena->current;

	while (c && c->size - c->used < bytes)
		c = c->next;
	if (!c)
		c = chunk_append(arena, bytes);
	if (!c)
		return NULL;
	arena->current = c;
	void *p = (unsigned char *)(c + 1) + c->used;

	c->used += bytes;
	arena->used += bytes;
	if (arena->used > arena->peak)
		arena->peak = arena->used;
	return p;
}

/* False where the product overflows. */
static bool round_up(size_t n, size_t size, size_t *ret_bytes)
{
	if (size && n > (SIZE_MAX / 2 - ALIGNMENT) / size)
		return false;
	*ret_bytes = (n * size + ALIGNMENT - 1) & ~(size_t)(ALIGNMENT - 1);
	return true;
}

void *arena_take(struct arena *arena, size_t n, size_t size)
{
	size_t bytes;
	void *p = round_up(n, size, &bytes) ? arena_push(arena, bytes) : NULL;

#ifndef __OPTIMIZE__
	if (p)
		memset(p, 0xa5, bytes);
#endif
	return p;
}

void *arena_alloc(struct arena *arena, size_t n, size_t size)
{
	size_t bytes;
	void *p = round_up(n, size, &bytes) ? arena_push(arena, bytes) : NULL;

	return p ? memset(p, 0, bytes) : NULL;
}

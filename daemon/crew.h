/* The crew: threads that mesh different patches of one map at once (decision D4). */
#ifndef FACET_DAEMON_CREW_H
#define FACET_DAEMON_CREW_H

#include "core/map.h"

#define CREW_THREADS_MAX 4 /* the caller's included; more would only wait for each other's memory */

/* One task: patch[i] and faces_raw[i] become those of key[i]. All borrowed until crew_mesh returns. */
struct crew_task {
	const struct map *map; /* nobody applies a row meanwhile */
	const struct patch_key *key;
	size_t n;
	struct patch **patch; /* NULL where memory was out, or where `stop` came first */
	uint32_t *faces_raw;
	const atomic_bool *stop;        /* patches not begun when it turns true are left out */
	atomic_uint_fast64_t *progress; /* one more for every patch */
};

struct crew;

/* `threads` with the caller's own; 0: as many as there are processors, at most CREW_THREADS_MAX. NULL when memory is out;
 * where threads are out there are fewer. */
struct crew *crew_create(int threads);
void crew_destroy(struct crew *);
void crew_mesh(struct crew *, const struct crew_task *); /* returns when all of it is done */

#endif

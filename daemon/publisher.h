/* The publisher: what each client of the native protocol is sent next (laws L4, L6; interfaces, section 4).
 * A state machine without sockets or a clock: bytes are asked for when there is room for them. One thread. */
#ifndef FACET_DAEMON_PUBLISHER_H
#define FACET_DAEMON_PUBLISHER_H

#include "core/native.h"

#define PUBLISHER_PINNED_MAX \
	(32u << 20) /* bytes that live only because a batch pins them, over all clients; beyond, the
					    batch that pins most is aborted and begun again at the newest step */
#define PUBLISHER_PINS_MAX   (64u << 10) /* bytes of the list of pins of one client: beyond, likewise */
#define PUBLISHER_ABORTS_MAX 3           /* so many running: the client is closed with the reason */
#define PUBLISHER_JSON_MAX   (64u << 10) /* of one client, waiting; a message beyond is dropped and counted */

struct publisher_params {
	uint8_t map_id[16];
	double cell_m;
	size_t pinned_max; /* 0: PUBLISHER_PINNED_MAX */
};

struct publisher;
struct publisher *publisher_create(const struct publisher_params *); /* NULL when memory is out */
void publisher_destroy(struct publisher *);                          /* clients leave first */

/* A dirty set as of `step`, whole; patches are borrowed. `faces_raw` (may be NULL): of each, before the reduction.
 * 0 or -ENOMEM: then the store is no longer what the map is, and nothing can be published any more. */
int publisher_publish(struct publisher *, uint64_t step, struct patch *const *, const uint32_t *faces_raw, size_t n);

/* The map begins anew: empty, a new generation; every client gets HELLO and a batch with `reset`. */
void publisher_reset(struct publisher *);

/* The same, and it is another map, `map_id`. What the old one was, as PATCH frames, is the caller's, and may go to another
 * thread; NULL when memory is out. */
struct publisher_old;
struct publisher_old *publisher_begin_map(struct publisher *, const uint8_t map_id[16]);
size_t publisher_old_count(const struct publisher_old *);
const uint8_t *publisher_old_frame(const struct publisher_old *, size_t i, size_t *ret_len);
void publisher_old_destroy(struct publisher_old *);

struct publisher_stats {
	uint64_t step;
	uint32_t generation;
	size_t patches, bytes; /* living, encoded */
	uint64_t faces, faces_raw;
	size_t pinned; /* bytes that live only because they are pinned, and of the lists of pins */
	size_t clients;
};
void publisher_stats(const struct publisher *, struct publisher_stats *ret);

/* A client begins with the HELLO that answers its WANT, then the whole map. NULL when memory is out. */
struct publisher_client;
struct publisher_client *publisher_join(struct publisher *, const struct native_want *);
void publisher_leave(struct publisher_client *);
void publisher_want(struct publisher_client *, const struct native_want *); /* again, on the same connection */

/* What is to be written next, borrowed until publisher_wrote or publisher_leave; 0: nothing now. */
size_t publisher_peek(struct publisher_client *, int64_t t_ns, const uint8_t **ret);
void publisher_wrote(struct publisher_client *, size_t n, int64_t t_ns);
/* When to ask again, for one that wanted a limited rate; INT64_MAX: when something was published or written. */
int64_t publisher_deadline(const struct publisher_client *);

/* A JSON message between others. False: dropped, too much waits already. */
bool publisher_json(struct publisher_client *, const char *text, size_t len);
size_t publisher_json_room(const struct publisher_client *); /* the longest text it takes now */
void publisher_ping(struct publisher_client *);

/* True once the client is to be closed and everything it is still owed, the reason included, has been written. */
bool publisher_done(const struct publisher_client *);
/* Closes a client: what is being written is ended, the reason sent, and nothing more. */
void publisher_dismiss(struct publisher_client *, const char *reason);
const char *publisher_reason(const struct publisher_client *); /* NULL: it is not to be closed */

struct publisher_client_stats {
	uint64_t step;                                /* last committed */
	uint64_t behind_steps;                        /* the newest step is so many further */
	uint64_t behind_peak;                         /* the most that ever were */
	size_t queued;                                /* bytes it holds: begun frame, messages, pins */
	uint64_t batches, aborts, skipped_json, sent; /* the last one in bytes */
};
void publisher_client_stats(const struct publisher_client *, struct publisher_client_stats *ret);

#endif

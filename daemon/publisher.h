/* The publisher: what each client is sent next (laws L4, L6; interfaces, section 4).
 *
 * It keeps the newest *sheet* of every patch, in several *forms*, each made once for all clients. A client is what it
 * last committed, and at most one *batch* that is being walked: what it misses as of one step, removals first, then
 * patches from the nearest to the robot on. Whoever has a wire of his own walks (publisher_join_walk); clients of the
 * native protocol are framed here (publisher_join). A state machine without sockets or a clock. One thread. */
#ifndef FACET_DAEMON_PUBLISHER_H
#define FACET_DAEMON_PUBLISHER_H

#include "core/native.h"

/* Bytes that live only because a batch that began before may send them, over all clients; beyond, the batch that began first
 * is aborted, and begun again at the newest step. */
#define PUBLISHER_PINNED_MAX (32u << 20)
/* What one client may cost besides its JSON messages: write buffer and window. */
#define PUBLISHER_CLIENT_MAX    (64u << 10)
#define PUBLISHER_ABORTS_MAX    3           /* so many running: the client is closed with the reason */
#define PUBLISHER_JSON_MAX      (64u << 10) /* of one client, waiting; a message beyond is dropped and counted */
#define PUBLISHER_FORMS_BYTES   (32u << 20) /* of forms other than NATIVE that are kept; the one used longest ago goes */
#define PUBLISHER_SNAPSHOTS_MAX 4           /* publisher_pin at a time; a further one is refused */

enum publisher_form {
	PUBLISHER_NATIVE, /* a PATCH frame */
	PUBLISHER_CODED,  /* a patch of core/coded.h, without a frame */
	PUBLISHER_PACKED, /* a PATCH frame compressed with zstd */
	PUBLISHER_SCENE_JSON,
	PUBLISHER_SCENE_PROTOBUF,
	PUBLISHER_FORMS
};

/* Appends a patch in one form. Pure: the bytes follow from the patch. An error of the buffer means that memory is out. */
struct publisher_encoder {
	void (*encode)(void *ctx, struct buffer *, const struct patch *); /* NULL: the form is not to be had */
	void *ctx;
};

struct publisher_params {
	uint8_t map_id[16];
	double cell_m;
	size_t pinned_max;  /* 0: PUBLISHER_PINNED_MAX */
	size_t forms_bytes; /* 0: PUBLISHER_FORMS_BYTES */
	size_t window; /* of a batch, in patches: at most as many as 0 means, which is right for everything but tests */
	struct publisher_encoder encoder[PUBLISHER_FORMS]; /* of the scenes; the first three need none */
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

/* Where the robot is, m: origin of "nearest first", and centre of the regions of clients that wanted a radius. Takes
 * effect when it has left its patch by a quarter of a patch; true then: some clients have news. */
bool publisher_robot(struct publisher *, double x_m, double y_m, double z_m);

/* The newest step, whole, kept as it is until it is released: its living patches as PATCH frames, in no order. Frames may
 * be read by another thread meanwhile; pin and release are the publisher's thread's, release before
 * publisher_destroy. NULL: PUBLISHER_SNAPSHOTS_MAX are pinned, or memory is out. */
struct publisher_snapshot {
	uint8_t map_id[16];
	uint32_t generation;
	double cell_m;
	uint64_t step;
	size_t patches;
};
struct publisher_snapshot *publisher_pin(struct publisher *);
const uint8_t *publisher_snapshot_frame(const struct publisher_snapshot *, size_t i, size_t *ret_len);
void publisher_release(struct publisher *, struct publisher_snapshot *);

struct publisher_stats {
	uint64_t step;
	uint32_t generation;
	size_t patches, bytes; /* living, encoded */
	uint64_t faces, faces_raw;
	size_t pinned;                      /* bytes that live only because a batch or a snapshot may need them */
	size_t clients, clients_peak_bytes; /* the most that one client ever cost, its JSON messages apart */
	uint64_t encodes[PUBLISHER_FORMS];  /* so often was a patch made into that form */
	size_t forms_bytes;                 /* kept of forms other than NATIVE */
	uint64_t asked;                     /* so often was a batch asked whether it needs what a patch was */
};
void publisher_stats(const struct publisher *, struct publisher_stats *ret);

/* A client begins with the HELLO that answers its WANT, then the whole map. NULL when memory is out. */
struct publisher_client;
struct publisher_client *publisher_join(struct publisher *, const struct native_want *);
void publisher_leave(struct publisher_client *);
/* Again, on the same connection: the next batch brings what comes into the region and removes what leaves it. */
void publisher_want(struct publisher_client *, const struct native_want *);

/* Walks
 *
 *   client = publisher_join_walk(publisher, &want, PUBLISHER_SCENE_JSON);
 *   on every wake, and after a commit:
 *     if (publisher_walk_begin(client, &begin) == 1)
 *       while ((r = publisher_walk_next(client, &item)) == 1) ...      as there is room on the wire
 *       r == 0: publisher_walk_commit(client)       r == -ECANCELED: forget the batch, begin again
 *
 * A client joined so has no wire here: publisher_peek and its kin are not for it. Of the WANT, the region holds. Bytes a
 * second are its owner's to keep. publisher_reason says when it is to be closed; publisher_leave ends it. */
struct publisher_client *publisher_join_walk(struct publisher *, const struct native_want *, enum publisher_form);
/* 1: a batch began; 0: nothing new. A batch with `reset` is the whole map: forget everything held before. One that is
 * being walked is given up for the new one. */
int publisher_walk_begin(struct publisher_client *, struct native_begin *ret);

struct publisher_item {
	struct patch_key key;
	bool removed; /* then no bytes, and version and time are 0 */
	uint64_t version;
	int64_t t_last_ns;
	const uint8_t *bytes; /* borrowed until the client's next walk_* call, or publisher_leave */
	size_t len;
};
/* 1: an item, removals before patches; 0: the end; -ECANCELED: the batch was aborted (too much was pinned, or the map
 * began anew): what came of it is void. -ENOMEM: the same, for want of memory. */
int publisher_walk_next(struct publisher_client *, struct publisher_item *ret);
/* After the end: the client holds the batch. 0, or -ECANCELED: the map began anew meanwhile. */
int publisher_walk_commit(struct publisher_client *);

/* The native protocol's bytes */

/* What is to be written next, borrowed until publisher_wrote or publisher_leave; 0: nothing now. */
size_t publisher_peek(struct publisher_client *, int64_t t_ns, const uint8_t **ret);
void publisher_wrote(struct publisher_client *, size_t n, int64_t t_ns);
/* The first `n` bytes that publisher_peek gave end with the end of a frame. */
bool publisher_ends_frame(const struct publisher_client *, size_t n);
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
	uint64_t step;         /* last committed */
	uint64_t behind_steps; /* the newest step is so many further */
	uint64_t behind_peak;  /* the most that ever were */
	size_t queued;         /* bytes it holds: begun frame, messages */
	size_t bytes;          /* it costs: its structure, write buffer, window, messages */
	uint64_t batches, aborts, skipped_json;
	uint64_t sent; /* bytes; 0 of walks */
};
void publisher_client_stats(const struct publisher_client *, struct publisher_client_stats *ret);

#endif

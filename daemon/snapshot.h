/* Snapshots: the whole map of one step as one file, in memory for HTTP or on the robot's disk for ?SAVE. Patches are pinned on the
 * loop, the file is made from them by a thread of libuv's pool. */
#ifndef FACET_DAEMON_SNAPSHOT_H
#define FACET_DAEMON_SNAPSHOT_H

#include <uv.h>

#include "daemon/publisher.h"

#define SNAPSHOTS_MAX      2        /* in memory at once, being made or sent; a further one is refused */
#define SNAPSHOT_FACES_MAX 4000000u /* of the map; a larger one is for `facet save`, which has its own memory */
#define SNAPSHOT_NAME_MAX  128      /* bytes of a file's name, with the 0 */
#define SNAPSHOT_ETAG_MAX  128
#define SNAPSHOT_ERROR_MAX 640

enum snapshot_format { SNAPSHOT_PLY, SNAPSHOT_GLB, SNAPSHOT_OBJ, SNAPSHOT_STL, SNAPSHOT_FORMATS };
const char *snapshot_ending(enum snapshot_format); /* "ply", ... */

struct snapshots;
/* A file of ?SAVE is done: its path, or (NULL) why not. */
typedef void (*snapshot_saved)(void *ctx, const char *path, const char *error);
struct snapshots *snapshots_create(uv_loop_t *, struct publisher *, const char *folder, snapshot_saved, void *ctx);
/* What is being made goes on: the loop waits for it when it runs dry; nobody is told any more. */
void snapshots_stop(struct snapshots *);
void snapshots_destroy(struct snapshots *); /* once the loop has run dry, before the publisher */

/* One file; who takes one drops it. Takers of the same step and format share it. */
struct snapshot;
/* NULL with a sentence: too many are at work, or the map is too large. */
struct snapshot *snapshot_take(struct snapshots *, enum snapshot_format, char error[SNAPSHOT_ERROR_MAX]);
void snapshot_drop(struct snapshot *);
/* 1 with its bytes, which stay until it is dropped; 0: is being made; -errno. */
int snapshot_bytes(const struct snapshot *, const uint8_t **ret, size_t *ret_len);
/* Called on the loop whenever one is made. */
void snapshots_watch(struct snapshots *, void (*made)(void *ctx), void *ctx);
/* The name of what snapshot_take would give now: with quotes, another one for every other content. */
void snapshots_etag(const struct snapshots *, enum snapshot_format, char ret[SNAPSHOT_ETAG_MAX]);

/* Begins to write `name` into the folder. False with a sentence. */
bool snapshot_save(struct snapshots *, const char *name, char error[SNAPSHOT_ERROR_MAX]);

#endif

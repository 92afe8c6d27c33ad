/* The archive: the mesh of a map that has ended, saved by a thread of its own. Written beside and renamed: a reader sees
 * the whole file or none. */
#ifndef FACET_DAEMON_ARCHIVE_H
#define FACET_DAEMON_ARCHIVE_H

#include <uv.h>

#include "config/config.h"
#include "daemon/publisher.h"

#define ARCHIVE_MAX 2 /* at work at once; a map that ends meanwhile is not saved, and the caller says so */

struct archive_result {
	const char *map;  /* its id, 32 hex digits */
	const char *file; /* where it is; NULL: nowhere, then `error` says why in one sentence */
	const char *error;
	uint32_t triangles;
};
/* Files of maps in the folder, of whatever run: a localisation that jumps and jumps fills no disk. At the limit nothing more is
 * saved, and the sentence says so; nothing is ever deleted here. */
#define ARCHIVE_FILES_MAX 100
typedef void (*archive_done)(void *ctx, const struct archive_result *); /* on the loop */

struct archive;
struct archive *archive_create(uv_loop_t *, const char *folder, double cell_m, archive_done, void *ctx);
/* What is at work goes on: the loop waits for it when it runs dry, after which `done` is not called any more. */
void archive_stop(struct archive *);
void archive_destroy(struct archive *); /* once the loop has run dry */

/* Takes `old` over, whatever comes. False with a sentence: it is not saved. */
bool archive_save(struct archive *, const uint8_t map_id[16], struct publisher_old *old, char error[200]);

/* Writes a file beside `path` and renames it. 0 or -errno. Any thread. */
int archive_write_file(const char *path, const struct buffer *);

#endif

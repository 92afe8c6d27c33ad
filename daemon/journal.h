/* The journal: what the loop handed to the pipeline, in that order (law L7). A sink of records; the daemon calls it
 * before pipeline_handle. A recording file comes later on the same seam. */
#ifndef FACET_DAEMON_JOURNAL_H
#define FACET_DAEMON_JOURNAL_H

#include "core/model.h"
#include "daemon/pipeline.h"

struct journal_sink {
	void *ctx;
	/* The map begins (anew) here: what follows is a list of its own, which goes on from this snapshot (pipeline_state). */
	void (*begin)(void *ctx, const void *snapshot, size_t len);
	void (*record)(void *ctx, const struct record *);
	void (*tick)(void *ctx, int64_t log_ns);
	void (*not_applied)(void *ctx, uint64_t number);
	void (*clock)(void *ctx, int64_t ahead_ns);
};

/* The pipeline's state as it stands. 0 or -ENOMEM. */
int journal_snapshot(struct pipeline *, struct buffer *ret);

/* Says `begin` with a snapshot of the pipeline as it stands. 0 or -ENOMEM. */
int journal_begin(const struct journal_sink *, struct pipeline *);

/* Lists kept in files (tests, `facetd --journal FILE` for them): plain bytes, described in journal.c. The first list is
 * FILE, the next, when the map began anew, FILE.2, and so on to FILE.99; after that nothing is kept. */
#define JOURNAL_FILES_MAX 99
struct journal;
struct journal *journal_create(const char *path, char error[160]);
void journal_destroy(struct journal *);
void journal_sink(struct journal *, struct journal_sink *ret);

/* 0, or -errno of the first write that failed (the disk is full): nothing was kept from there on. */
int journal_error(const struct journal *);

/* Feeds a kept list into a new `pipeline`: rows not applied are told first, then the snapshot, then all that came, in order.
 * The input is not ended: that is pipeline_end, the caller's. 0, or -EINVAL / -errno with a sentence. */
int journal_feed(const char *path, struct pipeline *, char error[160]);

/* Reading them entry by entry (daemon/replay.h, what feeds them above). */
enum journal_kind { JOURNAL_SNAPSHOT = 1, JOURNAL_RECORD, JOURNAL_TICK, JOURNAL_NOT_APPLIED, JOURNAL_CLOCK };
struct journal_entry {
	uint8_t kind;
	const uint8_t *data; /* after the kind, as journal.c draws it; borrowed */
	size_t len;          /* with the kind: where the next one is */
};
#define JOURNAL_MAGIC 8 /* bytes before the first entry */
/* 0; -EINVAL: no journal; -ENOTSUP: an older facetd's. */
int journal_is(const uint8_t *data, size_t len);
/* 1; 0 at the end (also within an entry); -EINVAL: no such entry. */
int journal_entry_at(const uint8_t *data, size_t len, struct journal_entry *ret);
/* Of a JOURNAL_RECORD that is whole; its device and direction are not judged. */
void journal_record(const struct journal_entry *, struct record *ret);

#endif

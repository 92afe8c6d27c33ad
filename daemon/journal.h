/* The journal: what the loop handed to the pipeline, in that order (law L7). A sink of records; the daemon calls it
 * before pipeline_handle. Kept in memory by tests; a recording file comes later on the same seam. */
#ifndef FACET_DAEMON_JOURNAL_H
#define FACET_DAEMON_JOURNAL_H

#include "daemon/pipeline.h"

struct journal_sink {
	void *ctx;
	void (*record)(void *ctx, const struct record *);
	void (*tick)(void *ctx, int64_t log_ns);
	void (*not_applied)(void *ctx, uint64_t number);
	void (*reset)(void *ctx); /* the map began anew here */
	void (*clock)(void *ctx, int64_t ahead_ns);
};

/* A list kept in a file (tests, `facetd --journal FILE` for them): plain bytes, described in journal.c. */
struct journal;
struct journal *journal_create(const char *path, char error[160]);
void journal_destroy(struct journal *);
void journal_sink(struct journal *, struct journal_sink *ret);

/* 0, or -errno of the first write that failed (the disk is full): nothing was kept from there on. */
int journal_error(const struct journal *);

/* Feeds a kept list into `pipeline` (rows not applied are skipped first). At a reset the pipeline begins anew and `reset`
 * (may be NULL) is called for the map to do so too. The input is not ended: that is pipeline_end, the caller's.
 * 0, or -EINVAL / -errno with a sentence. */
int journal_feed(const char *path, struct pipeline *, void (*reset)(void *ctx), void *ctx, char error[160]);

#endif

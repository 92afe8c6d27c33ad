/* A batch: what one client misses as of one step, in the order in which it is sent. */
#ifndef FACET_DAEMON_BATCH_H
#define FACET_DAEMON_BATCH_H

#include "daemon/interest.h"
#include "daemon/sheets.h"

#define BATCH_WINDOW \
	1024 /* the nearest unsent ones that are held at a time; when they are sent, the next are looked up */

/* Where something stands in the order: removals, then patches, both by distance from the origin, then by key. */
struct batch_waiting {
	uint64_t rank;
	struct entry *entry;
};

struct batch {
	bool whole;                /* the client holds nothing */
	uint64_t begin, end, step; /* sequence numbers (begin, end] */
	struct interest from, to;  /* the region it holds, the one it wants */
	struct patch_key origin;
	bool started; /* something was sent: what comes up to rank and key is */
	uint64_t rank;
	struct patch_key key;
	size_t left; /* announced and not sent */
	struct batch_waiting *window;
	size_t window_at, window_n, window_cap;
	struct past *past; /* what is kept for it, and maybe for some that began before */
};

/* Shared by all batches: memory in which a window is made. */
struct batch_scratch {
	size_t window; /* 1 .. BATCH_WINDOW: so many are held at a time */
	struct batch_waiting nearest[BATCH_WINDOW];
};

/* `whole`, `begin`, `from`, `to`, `origin` are set, everything else is zero. Counts; 0 or -ENOMEM. */
int batch_begin(struct batch *, const struct sheets *, struct batch_scratch *, uint32_t *ret_patches,
                uint32_t *ret_removals);

/* The next one: 1, with its entry, and its sheet (a reference for the caller) unless it is a removal; 0 at the end;
 * -ENOMEM. */
int batch_next(struct batch *, const struct sheets *, struct batch_scratch *, struct entry **ret_entry,
               struct sheet **ret_sheet);

/* The entry, as it was when the batch began, is still to be sent. */
bool batch_needs(const struct batch *, const struct entry *);

void batch_finish(struct batch *);        /* all zero again; what was kept has been let go */
size_t batch_bytes(const struct batch *); /* memory of its own */

#endif

/* The worker: the thread that owns the map (decision D4). Rows go in through a bounded queue, sets of new patches come
 * out. All calls but worker_create's `ready` are made by one thread, the loop's. */
#ifndef FACET_DAEMON_WORKER_H
#define FACET_DAEMON_WORKER_H

#include "core/map.h"

#define WORKER_ROWS_MAX    256 /* rows waiting; a further one is refused: it is not applied, and the caller says so */
#define WORKER_RESULTS_MAX 8   /* results not yet taken; at the limit the worker waits, so rows pile up instead */
#define WORKER_MESH_ROWS \
	32 /* at the latest after so many rows the dirty patches are meshed, however long the queue \
	                       */

struct worker_params {
	bool patient; /* of a replay: no row is refused; worker_room says when to hand over none */
	struct map_params map;
	size_t rows_max;          /* that may wait, 1 .. WORKER_ROWS_MAX; 0: WORKER_ROWS_MAX */
	int threads;              /* that mesh, the worker's own included; 0: see crew.h */
	void (*ready)(void *ctx); /* called by the worker's thread: a result waits (or the worker failed) */
	void *ctx;
};

/* A dirty set, whole: what the map at `step` differs in from the result before. */
struct worker_result {
	bool reset; /* the map began anew before this: all earlier patches are void */
	bool ended; /* ... and the one before it was whole: it came to its end (worker_end) */
	uint64_t step;
	int64_t t_ns; /* of the newest applied row */
	size_t patches;
	struct patch **patch; /* in key order; nt == 0: gone */
	uint32_t *faces_raw;  /* of each patch, before the reduction */
	size_t arrivals;
	int64_t arrival_ns[WORKER_MESH_ROWS]; /* of the rows that made the map advance */
	struct grid_stats grid;
	struct field_stats field;
	struct worker_result *next; /* the worker's */
};

struct worker_status {
	size_t queued, queued_peak; /* rows */
	size_t rows_max;
	uint64_t rows, refused, meshed; /* taken, refused, patches made */
	bool idle;                      /* nothing is queued, being done or waiting to be taken */
	bool failed; /* memory is out: the map is no longer whole and nothing more will be published */
};

struct worker;

/* NULL when memory or threads are out. */
struct worker *worker_create(const struct worker_params *);
void worker_destroy(struct worker *); /* ends after the patch at hand; what is queued is lost */

/* Takes the row over and is true, or false when the queue is full. */
bool worker_row(struct worker *, struct row *, int64_t arrival_ns);
/* Patient: false while `rows_max` rows wait. What one record completes may still be handed over, so the queue is longer by
 * that at most; `ready` is called when half of it is done. */
bool worker_room(struct worker *);
/* While it holds, rows are applied but nothing is meshed or handed over; then all of it at once. */
void worker_hold(struct worker *, bool hold);
void worker_mesh(struct worker *); /* once, also while it holds: in the order of rows */
/* These go through the queue in their place, and are never refused: two in a row are one, so they are bounded as rows
 * are. */
void worker_flush(struct worker *);
void worker_reset(struct worker *);
/* The map comes to its end: what it still lacks is folded and handed over, then it begins anew. */
void worker_end(struct worker *);

/* The oldest result, the caller's; NULL when there is none. */
struct worker_result *worker_take(struct worker *);
void worker_result_destroy(struct worker_result *);

void worker_status(struct worker *, struct worker_status *ret);
/* For the watchdog: it waits for work, or has done some since the last call. */
bool worker_alive(struct worker *);

#endif

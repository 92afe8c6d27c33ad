/* The mapping thread behind its queue.
 *
 *   loop:    worker_row, worker_flush, worker_reset, worker_end ──► queue ──► worker: map_row, map_flush, a new map
 *   loop:    worker_take ◄── results ◄── worker: map_take_dirty, map_mesh_patch
 *
 * Meshes are made when the queue is empty, so that a change is seen as soon as it can be, and at the latest after
 * WORKER_MESH_ROWS rows, so that under load many rows share one extraction but nobody waits for ever: extraction is
 * what is saved first, rows are refused last. Because a mesh is a function of the voxels alone, what was skipped leaves
 * no trace (law L2). The patches of a set are meshed by a crew of threads, the worker's own among them. The dirty set of a step goes to the loop as one result or not at all (law L4).
 *
 * Loop and worker share what `lock` guards, the progress counter and the wish to stop, nothing else; patches cross by reference count. */
#include "daemon/worker.h"

#include <assert.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/crew.h"

enum item_kind { ITEM_ROW, ITEM_MESH, ITEM_FLUSH, ITEM_RESET, ITEM_END };

struct item {
	enum item_kind kind;
	struct row *row;
	int64_t arrival_ns;
};

/* Between two rows stand at most a wish for meshes, a flush, a reset and an end: see push_control. A patient worker's queue
 * grows by what one record completes. */
#define ITEMS_MAX (5 * (WORKER_ROWS_MAX + 1))

struct worker {
	struct worker_params params;
	pthread_t thread;
	pthread_mutex_t lock;
	pthread_cond_t wake; /* the worker waits: for an item, or for room among the results */
	atomic_uint_fast64_t progress;
	atomic_bool hold;
	atomic_bool stop;       /* set under `lock`, read without it between patches */
	uint64_t progress_seen; /* the loop's */

	/* Under `lock`. */
	struct item *item; /* ring */
	size_t first, items, cap;
	struct worker_result *oldest, **newest;
	size_t results;
	bool idle;
	struct worker_status status;

	/* The worker's own. */
	struct map *map;
	struct crew *crew;
	struct worker_result *result; /* the one being made; arrivals gather here */
	uint64_t published_step;
	size_t rows_since_mesh;
};

/* The worker's side */

static void progress(struct worker *w)
{
	atomic_fetch_add_explicit(&w->progress, 1, memory_order_relaxed);
}

/* False: stop. Sets *ret_more when another item waits already. */
static bool next_item(struct worker *w, struct item *ret, bool *ret_more)
{
	bool room;

	pthread_mutex_lock(&w->lock);
	while (!w->stop && w->items == 0) {
		w->idle = true;
		pthread_cond_wait(&w->wake, &w->lock);
	}
	w->idle = false;
	if (w->stop) {
		pthread_mutex_unlock(&w->lock);
		return false;
	}
	*ret = w->item[w->first];
	w->first = (w->first + 1) % w->cap;
	w->items--;
	if (ret->kind == ITEM_ROW) {
		w->status.queued--;
		w->status.rows++;
	}
	*ret_more = w->items > 0;
	room = w->params.patient && ret->kind == ITEM_ROW && w->status.queued == w->status.rows_max / 2;
	pthread_mutex_unlock(&w->lock);
	if (room)
		w->params.ready(w->params.ctx);
	return true;
}

static bool begin_map(struct worker *w)
{
	map_destroy(w->map);
	w->map = map_create(&w->params.map);
	w->published_step = 0;
	return w->map != NULL;
}

static bool publish(struct worker *w);

/* False when memory is out. */
static bool begin_anew(struct worker *w, bool ended)
{
	w->result->reset = true;
	w->result->ended |= ended;
	w->result->arrivals = 0;
	return begin_map(w);
}

static bool apply(struct worker *w, const struct item *item)
{
	switch (item->kind) {
	case ITEM_ROW:
		w->rows_since_mesh++;
		if (map_row(w->map, item->row) > 0 && w->result->arrivals < WORKER_MESH_ROWS)
			w->result->arrival_ns[w->result->arrivals++] = item->arrival_ns;
		return true;
	case ITEM_MESH:
		return publish(w);
	case ITEM_FLUSH:
		map_flush(w->map);
		return true;
	case ITEM_RESET:
		return begin_anew(w, false);
	case ITEM_END:
		map_flush(w->map);
		return publish(w) && (w->stop || begin_anew(w, true));
	}
	return false;
}

/* False when memory is out. A set that was cut short by `stop` has NULLs too, but is never looked at. */
static bool mesh_dirty(struct worker *w, struct worker_result *result)
{
	struct crew_task task = {.map = w->map, .stop = &w->stop, .progress = &w->progress};
	bool whole = true;

	task.n = map_take_dirty(w->map, &task.key);
	if (task.n == 0)
		return true;
	task.patch = result->patch = calloc(task.n, sizeof(*result->patch));
	task.faces_raw = result->faces_raw = calloc(task.n, sizeof(*result->faces_raw));
	if (!result->patch || !result->faces_raw)
		return false;
	result->patches = task.n;
	crew_mesh(w->crew, &task);
	for (size_t i = 0; i < task.n; i++)
		whole &= result->patch[i] != NULL;
	return whole || w->stop;
}

/* Waits for room: the loop is behind, and rows will pile up in the queue, which has a limit. */
static void hand_over(struct worker *w, struct worker_result *result)
{
	pthread_mutex_lock(&w->lock);
	while (!w->stop && w->results == WORKER_RESULTS_MAX) {
		w->idle = true;
		pthread_cond_wait(&w->wake, &w->lock);
	}
	w->idle = false;
	*w->newest = result;
	w->newest = &result->next;
	w->results++;
	w->status.meshed += result->patches;
	pthread_mutex_unlock(&w->lock);
	w->params.ready(w->params.ctx);
}

static bool publish(struct worker *w)
{
	struct worker_result *result = w->result;

	w->rows_since_mesh = 0;
	if (map_step(w->map) == w->published_step && !result->reset)
		return true;
	if (!mesh_dirty(w, result))
		return false;
	if (w->stop) /* the set may be cut short */
		return true;
	w->result = calloc(1, sizeof(*w->result));
	if (!w->result) {
		w->result = result;
		return false;
	}
	result->step = w->published_step = map_step(w->map);
	result->t_ns = map_time_ns(w->map);
	grid_stats(map_grid(w->map), &result->grid);
	field_stats(map_field(w->map), &result->field);
	hand_over(w, result);
	return true;
}

static void *run(void *ctx)
{
	struct worker *w = ctx;
	struct item item;
	bool more = false, good = true;

	while (good && next_item(w, &item, &more)) {
		good = apply(w, &item);
		progress(w);
		if (good && !w->hold && (!more || w->rows_since_mesh >= WORKER_MESH_ROWS))
			good = publish(w);
	}
	if (!good) {
		pthread_mutex_lock(&w->lock);
		w->status.failed = true;
		pthread_mutex_unlock(&w->lock);
		w->params.ready(w->params.ctx);
	}
	return NULL;
}

/* The loop's side */

static struct worker *worker_allocate(const struct worker_params *params)
{
	struct worker *w = calloc(1, sizeof(*w));

	if (!w)
		return NULL;
	w->params = *params;
	w->status.rows_max = params->rows_max ? params->rows_max : WORKER_ROWS_MAX;
	w->newest = &w->oldest;
	w->crew = crew_create(params->threads);
	w->result = calloc(1, sizeof(*w->result));
	w->item = calloc(ITEMS_MAX, sizeof(*w->item));
	w->cap = ITEMS_MAX;
	if (w->crew && w->result && w->item && begin_map(w))
		return w;
	map_destroy(w->map);
	crew_destroy(w->crew);
	free(w->result);
	free(w->item);
	free(w);
	return NULL;
}

static void worker_free(struct worker *w)
{
	struct worker_result *result;

	for (; w->items > 0; w->items--, w->first = (w->first + 1) % w->cap)
		if (w->item[w->first].kind == ITEM_ROW)
			row_destroy(w->item[w->first].row);
	while ((result = w->oldest) != NULL) {
		w->oldest = result->next;
		worker_result_destroy(result);
	}
	worker_result_destroy(w->result);
	map_destroy(w->map);
	crew_destroy(w->crew);
	pthread_cond_destroy(&w->wake);
	pthread_mutex_destroy(&w->lock);
	free(w->item);
	free(w);
}

struct worker *worker_create(const struct worker_params *params)
{
	struct worker *w;

	assert(params->ready && params->rows_max <= WORKER_ROWS_MAX);
	w = worker_allocate(params);
	if (!w)
		return NULL;
	pthread_mutex_init(&w->lock, NULL);
	pthread_cond_init(&w->wake, NULL);
	if (pthread_create(&w->thread, NULL, run, w) != 0) {
		worker_free(w);
		return NULL;
	}
	return w;
}

void worker_destroy(struct worker *w)
{
	if (!w)
		return;
	pthread_mutex_lock(&w->lock);
	w->stop = true;
	pthread_cond_signal(&w->wake);
	pthread_mutex_unlock(&w->lock);
	pthread_join(w->thread, NULL);
	worker_free(w);
}

/* Patient: twice the room. False when memory is out. */
static bool grow(struct worker *w)
{
	struct item *grown = calloc(2 * w->cap, sizeof(*grown));

	if (!grown)
		return false;
	for (size_t i = 0; i < w->items; i++)
		grown[i] = w->item[(w->first + i) % w->cap];
	free(w->item);
	w->item = grown;
	w->first = 0;
	w->cap *= 2;
	return true;
}

static bool push(struct worker *w, struct item item)
{
	if (w->items == w->cap && !grow(w)) {
		w->status.failed = true;
		return false;
	}
	w->item[(w->first + w->items++) % w->cap] = item;
	pthread_cond_signal(&w->wake);
	return true;
}

bool worker_row(struct worker *w, struct row *row, int64_t arrival_ns)
{
	bool taken;

	pthread_mutex_lock(&w->lock);
	taken = (w->params.patient || w->status.queued < w->status.rows_max) &&
	        push(w, (struct item){ITEM_ROW, row, arrival_ns});
	if (taken) {
		w->status.queued++;
		if (w->status.queued_peak < w->status.queued)
			w->status.queued_peak = w->status.queued;
	} else {
		w->status.refused++;
	}
	pthread_mutex_unlock(&w->lock);
	return taken;
}

bool worker_room(struct worker *w)
{
	bool room;

	pthread_mutex_lock(&w->lock);
	room = w->status.queued < w->status.rows_max;
	pthread_mutex_unlock(&w->lock);
	return room;
}

/* Without rows between them, what comes after an equal or a stronger one changes nothing; so at most a wish, flush, reset, end stand
 * in a row. */
static void push_control(struct worker *w, enum item_kind kind)
{
	enum item_kind last = ITEM_ROW;

	pthread_mutex_lock(&w->lock);
	if (w->items > 0)
		last = w->item[(w->first + w->items - 1) % w->cap].kind;
	if (last < kind)
		push(w, (struct item){.kind = kind});
	pthread_mutex_unlock(&w->lock);
}

void worker_hold(struct worker *w, bool hold)
{
	w->hold = hold;
	if (!hold)
		push_control(w, ITEM_MESH);
}

void worker_mesh(struct worker *w)
{
	push_control(w, ITEM_MESH);
}

void worker_flush(struct worker *w)
{
	push_control(w, ITEM_FLUSH);
}

void worker_reset(struct worker *w)
{
	push_control(w, ITEM_RESET);
}

void worker_end(struct worker *w)
{
	push_control(w, ITEM_END);
}

struct worker_result *worker_take(struct worker *w)
{
	struct worker_result *result;

	pthread_mutex_lock(&w->lock);
	result = w->oldest;
	if (result) {
		w->oldest = result->next;
		if (!w->oldest)
			w->newest = &w->oldest;
		if (w->results-- == WORKER_RESULTS_MAX)
			pthread_cond_signal(&w->wake);
	}
	pthread_mutex_unlock(&w->lock);
	return result;
}

void worker_result_destroy(struct worker_result *result)
{
	if (!result)
		return;
	for (size_t i = 0; i < result->patches; i++)
		patch_unref(result->patch[i]);
	free(result->patch);
	free(result->faces_raw);
	free(result);
}

void worker_status(struct worker *w, struct worker_status *ret)
{
	pthread_mutex_lock(&w->lock);
	*ret = w->status;
	ret->idle = w->idle && w->items == 0 && w->results == 0;
	pthread_mutex_unlock(&w->lock);
}

bool worker_alive(struct worker *w)
{
	uint64_t now = atomic_load_explicit(&w->progress, memory_order_relaxed);
	bool alive;

	pthread_mutex_lock(&w->lock);
	alive = now != w->progress_seen || (w->idle && !w->status.failed);
	pthread_mutex_unlock(&w->lock);
	w->progress_seen = now;
	return alive;
}

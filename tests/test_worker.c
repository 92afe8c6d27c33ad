/* Law: rows go through the worker in their order, every change comes out once and whole, full is a normal state, and
 * the two threads share nothing unguarded (run under ThreadSanitizer: make config=thread). The map here is a counter
 * per patch behind a gate, so that the test decides when the worker is slow. */
#include <errno.h>
#include <pthread.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include <cmocka.h>

#include "daemon/worker.h"

#define KEYS 7

struct map {
	struct grid *grid;
	uint64_t step, rows;
	int lookahead, waiting;
	uint16_t content[KEYS]; /* step of the last row that touched the patch */
	bool dirty[KEYS];
	struct patch_key taken[KEYS];
};

struct mesher {
	int unused;
};

static pthread_mutex_t gate_lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t gate_moved = PTHREAD_COND_INITIALIZER;
static bool gate_closed, gate_reached, fail_meshing;
static uint64_t flushes, maps;

static void gate_set(bool closed)
{
	pthread_mutex_lock(&gate_lock);
	gate_closed = closed;
	gate_reached = false;
	pthread_cond_broadcast(&gate_moved);
	pthread_mutex_unlock(&gate_lock);
}

static void gate_pass(void)
{
	pthread_mutex_lock(&gate_lock);
	while (gate_closed) {
		gate_reached = true;
		pthread_cond_broadcast(&gate_moved);
		pthread_cond_wait(&gate_moved, &gate_lock);
	}
	pthread_mutex_unlock(&gate_lock);
}

static void gate_wait_reached(void)
{
	pthread_mutex_lock(&gate_lock);
	while (!gate_reached)
		pthread_cond_wait(&gate_moved, &gate_lock);
	pthread_mutex_unlock(&gate_lock);
}

struct map *map_create(const struct map_params *params)
{
	struct map *map = calloc(1, sizeof(*map));

	map->grid = grid_create(1 << 20);
	map->lookahead = params->lookahead;
	maps++;
	return map;
}

void map_destroy(struct map *map)
{
	if (map)
		grid_destroy(map->grid);
	free(map);
}

struct field *map_field(struct map *map)
{
	(void)map;
	return NULL;
}

struct grid *map_grid(struct map *map)
{
	return map->grid;
}

void field_stats(const struct field *field, struct field_stats *ret)
{
	(void)field;
	memset(ret, 0, sizeof(*ret));
}

static void fold(struct map *map)
{
	int key = (int)(map->step++ % KEYS);

	map->content[key] = (uint16_t)map->step;
	map->dirty[key] = true;
}

int map_row(struct map *map, struct row *row)
{
	gate_pass();
	assert_int_equal(row->number, map->rows);
	map->rows++;
	row_destroy(row);
	if (map->waiting < map->lookahead) {
		map->waiting++;
		return 0;
	}
	fold(map);
	return 1;
}

int map_flush(struct map *map)
{
	int n = map->waiting;

	flushes++;
	for (; map->waiting > 0; map->waiting--)
		fold(map);
	return n;
}

uint64_t map_step(const struct map *map)
{
	return map->step;
}

int64_t map_time_ns(const struct map *map)
{
	return (int64_t)map->step * 1000;
}

size_t map_take_dirty(struct map *map, const struct patch_key **ret_keys)
{
	size_t n = 0;

	for (int i = 0; i < KEYS; i++)
		if (map->dirty[i]) {
			map->taken[n++] = (struct patch_key){i, 0, 0};
			map->dirty[i] = false;
		}
	*ret_keys = map->taken;
	return n;
}

struct mesher *mesher_create(void)
{
	return calloc(1, sizeof(struct mesher));
}

void mesher_destroy(struct mesher *mesher)
{
	free(mesher);
}

struct patch *map_mesh_patch(const struct map *map, struct mesher *mesher, struct patch_key key,
                             uint32_t *ret_raw_faces)
{
	uint16_t vertex[3][3] = {{0, 0, 0}, {1, 0, 0}, {map->content[key.x], 1, 0}};
	uint32_t triangle[1][3] = {{0, 1, 2}};
	struct surface surface = {.nv = 3, .nt = 1, .vertex = vertex, .triangle = triangle};
	struct patch *patch;

	(void)mesher;
	if (fail_meshing)
		return NULL;
	patch = patch_create(key, &surface);
	patch->version = map->step;
	*ret_raw_faces = 10;
	return patch;
}

/* The loop's side of a test: a counter that `ready` raises. */
static pthread_mutex_t ready_lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t ready_moved = PTHREAD_COND_INITIALIZER;
static unsigned readies;

static void on_ready(void *ctx)
{
	(void)ctx;
	pthread_mutex_lock(&ready_lock);
	readies++;
	pthread_cond_broadcast(&ready_moved);
	pthread_mutex_unlock(&ready_lock);
}

static struct worker_result *wait_result(struct worker *worker)
{
	struct worker_result *result;

	while (!(result = worker_take(worker))) {
		pthread_mutex_lock(&ready_lock);
		while (readies == 0)
			pthread_cond_wait(&ready_moved, &ready_lock);
		readies--;
		pthread_mutex_unlock(&ready_lock);
	}
	return result;
}

static struct worker *start(int lookahead)
{
	struct worker_params params = {
	    .map = {.cell_m = 0.05, .lookahead = lookahead, .memory = 1 << 20}, .ready = on_ready, .threads = 3};
	struct worker *worker;

	readies = 0;
	flushes = maps = 0;
	fail_meshing = false;
	gate_set(false);
	worker = worker_create(&params);
	assert_non_null(worker);
	return worker;
}

static bool give_row(struct worker *worker, uint64_t number)
{
	struct row *row = row_create(1);

	row->number = number;
	if (worker_row(worker, row, (int64_t)number))
		return true;
	row_destroy(row);
	return false;
}

/* What a client that takes every result holds. */
struct view {
	uint64_t step;
	uint16_t content[KEYS];
};

/* Applies a result and checks that it is whole: everything that changed up to its step is in it, as of its step. */
static void take_into(struct view *view, struct worker_result *result)
{
	if (result->reset)
		memset(view, 0, sizeof(*view));
	assert_true(result->step >= view->step);
	for (size_t i = 0; i < result->patches; i++) {
		assert_int_equal(result->patch[i]->version, result->step);
		view->content[result->patch[i]->key.x] = result->patch[i]->vertex[2][0];
	}
	view->step = result->step;
	for (uint64_t step = view->step > KEYS ? view->step - KEYS : 0; step < view->step; step++)
		assert_int_equal(view->content[step % KEYS], step + 1);
	assert_int_equal(result->t_ns, result->step * 1000);
	worker_result_destroy(result);
}

static void every_row_arrives_in_its_order_and_every_set_is_whole(void **state)
{
	struct worker *worker = start(0);
	struct view view = {0};
	uint64_t given = 0;

	(void)state;
	while (view.step < 5000) {
		struct worker_result *result;

		while (given < 5000 && give_row(worker, given))
			given++;
		result = wait_result(worker);
		assert_in_range(result->arrivals, 1, WORKER_MESH_ROWS);
		assert_int_equal(result->arrival_ns[result->arrivals - 1] + 1, result->step);
		take_into(&view, result);
	}
	assert_int_equal(given, 5000);
	worker_destroy(worker);
}

static void a_full_queue_refuses_rows_and_counts_them(void **state)
{
	struct worker *worker = start(0);
	struct worker_status status;
	struct view view = {0};

	(void)state;
	gate_set(true);
	assert_true(give_row(worker, 0));
	gate_wait_reached(); /* row 0 is in the worker's hands now */
	for (uint64_t i = 1; i <= WORKER_ROWS_MAX; i++)
		assert_true(give_row(worker, i));
	assert_false(give_row(worker, WORKER_ROWS_MAX + 1));
	assert_false(give_row(worker, WORKER_ROWS_MAX + 1));
	worker_status(worker, &status);
	assert_int_equal(status.queued, WORKER_ROWS_MAX);
	assert_int_equal(status.refused, 2);
	gate_set(false);
	while (view.step < WORKER_ROWS_MAX + 1)
		take_into(&view, wait_result(worker));
	worker_destroy(worker);
}

static void under_load_many_rows_share_a_mesh_but_none_waits_for_ever(void **state)
{
	struct worker *worker = start(0);
	struct view view = {0};
	unsigned results = 0;

	(void)state;
	gate_set(true);
	assert_true(give_row(worker, 0));
	gate_wait_reached(); /* row 0 is in the worker's hands: what comes now waits behind it */
	for (uint64_t i = 1; i < WORKER_ROWS_MAX; i++)
		assert_true(give_row(worker, i));
	gate_set(false);
	while (view.step < WORKER_ROWS_MAX) {
		uint64_t before = view.step;

		take_into(&view, wait_result(worker));
		assert_in_range(view.step - before, 1, WORKER_MESH_ROWS);
		results++;
	}
	/* Row 0 found nobody behind it and may be a set of its own; all others waited and fill their sets. */
	assert_in_range(results, WORKER_ROWS_MAX / WORKER_MESH_ROWS, WORKER_ROWS_MAX / WORKER_MESH_ROWS + 1);
	worker_destroy(worker);
}

static void a_flush_travels_with_the_rows_and_folds_what_waits(void **state)
{
	struct worker *worker = start(2);
	struct view view = {0};

	(void)state;
	gate_set(true);
	assert_true(give_row(worker, 0));
	gate_wait_reached();
	assert_true(give_row(worker, 1));
	worker_flush(worker);
	worker_flush(worker);
	assert_true(give_row(worker, 2));
	gate_set(false);
	while (view.step < 2)
		take_into(&view, wait_result(worker));
	assert_int_equal(view.step, 2);
	worker_flush(worker);
	while (view.step < 3)
		take_into(&view, wait_result(worker));
	worker_destroy(worker);
	assert_int_equal(flushes, 2); /* two in a row are one */
}

static void any_number_of_controls_is_bounded(void **state)
{
	struct worker *worker = start(0);
	struct view view = {.step = 1};

	(void)state;
	gate_set(true);
	assert_true(give_row(worker, 0));
	gate_wait_reached();
	for (int i = 0; i < 100000; i++) {
		worker_flush(worker);
		worker_reset(worker);
		worker_end(worker);
	}
	gate_set(false);
	while (view.step > 0)
		take_into(&view, wait_result(worker));
	worker_destroy(worker);
	assert_in_range(maps, 2, 4);
}

static void after_a_reset_the_map_is_empty_and_says_so(void **state)
{
	struct worker *worker = start(0);
	struct view view = {0};
	struct worker_result *result;
	bool reset = false;

	(void)state;
	for (uint64_t i = 0; i < 5; i++)
		assert_true(give_row(worker, i));
	while (view.step < 5)
		take_into(&view, wait_result(worker));
	worker_reset(worker);
	assert_true(give_row(worker, 0));
	while (view.step != 1) {
		result = wait_result(worker);
		reset |= result->reset;
		take_into(&view, result);
	}
	assert_true(reset);
	worker_destroy(worker);
}

/* Two rows wait for their look-ahead: they belong to the map that ends, and are handed over before it does. */
static void a_map_that_ends_is_handed_over_whole_first(void **state)
{
	struct worker *worker = start(2);
	struct view view = {0};
	bool ended = false;

	(void)state;
	for (int later = 0; later < 2; later++) { /* a reset behind it forgets nothing of it */
		gate_set(true);
		for (uint64_t i = 0; i < 9; i++)
			assert_true(give_row(worker, i));
		gate_wait_reached();
		worker_end(worker);
		for (uint64_t i = 0; i < 5; i++)
			assert_true(give_row(worker, i));
		if (later) {
			worker_reset(worker);
			for (uint64_t i = 0; i < 5; i++)
				assert_true(give_row(worker, i));
		}
		gate_set(false);
		for (ended = false; !ended;) {
			struct worker_result *result = wait_result(worker);

			ended = result->ended;
			if (ended) {
				assert_true(result->reset);
				assert_int_equal(view.step, 9);
			}
			take_into(&view, result);
		}
		while (view.step < 3)
			take_into(&view, wait_result(worker));
		worker_reset(worker);
		while (view.step > 0)
			take_into(&view, wait_result(worker));
	}
	worker_destroy(worker);
}

static void the_worker_waits_when_nobody_takes_its_results(void **state)
{
	struct worker *worker = start(0);
	struct view view = {0};
	uint64_t given = 0;
	struct worker_status status;

	(void)state;
	for (;;) { /* until the queue stays full though the gate is open */
		while (give_row(worker, given))
			given++;
		worker_status(worker, &status);
		if (status.refused > 50 && given >= WORKER_ROWS_MAX + WORKER_RESULTS_MAX)
			break;
	}
	assert_true(given <= (WORKER_RESULTS_MAX + 2) * WORKER_MESH_ROWS + WORKER_ROWS_MAX);
	while (view.step < given)
		take_into(&view, wait_result(worker));
	worker_destroy(worker);
}

static void the_watchdog_sees_work_and_idleness_but_no_standstill(void **state)
{
	struct worker *worker = start(0);
	struct view view = {0};

	(void)state;
	gate_set(true);
	assert_true(give_row(worker, 0));
	gate_wait_reached();
	worker_alive(worker);
	assert_false(worker_alive(worker)); /* stuck in a row */
	gate_set(false);
	while (view.step < 1)
		take_into(&view, wait_result(worker));
	assert_true(worker_alive(worker));
	worker_destroy(worker);
}

static void without_memory_the_worker_fails_and_publishes_nothing_more(void **state)
{
	struct worker *worker = start(0);
	struct worker_status status = {0};

	(void)state;
	fail_meshing = true;
	assert_true(give_row(worker, 0));
	pthread_mutex_lock(&ready_lock);
	while (readies == 0)
		pthread_cond_wait(&ready_moved, &ready_lock);
	pthread_mutex_unlock(&ready_lock);
	worker_status(worker, &status);
	assert_true(status.failed);
	assert_null(worker_take(worker));
	assert_false(worker_alive(worker) && worker_alive(worker));
	worker_destroy(worker);
}

static void it_ends_with_a_full_queue_and_untaken_results(void **state)
{
	struct worker *worker = start(0);
	uint64_t given = 0;

	(void)state;
	for (int i = 0; i < 2000; i++)
		given += give_row(worker, given);
	worker_flush(worker);
	worker_reset(worker);
	worker_destroy(worker);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(every_row_arrives_in_its_order_and_every_set_is_whole),
	    cmocka_unit_test(a_full_queue_refuses_rows_and_counts_them),
	    cmocka_unit_test(under_load_many_rows_share_a_mesh_but_none_waits_for_ever),
	    cmocka_unit_test(a_flush_travels_with_the_rows_and_folds_what_waits),
	    cmocka_unit_test(any_number_of_controls_is_bounded),
	    cmocka_unit_test(after_a_reset_the_map_is_empty_and_says_so),
	    cmocka_unit_test(a_map_that_ends_is_handed_over_whole_first),
	    cmocka_unit_test(the_worker_waits_when_nobody_takes_its_results),
	    cmocka_unit_test(the_watchdog_sees_work_and_idleness_but_no_standstill),
	    cmocka_unit_test(without_memory_the_worker_fails_and_publishes_nothing_more),
	    cmocka_unit_test(it_ends_with_a_full_queue_and_untaken_results),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

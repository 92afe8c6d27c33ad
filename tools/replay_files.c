/* `facet replay`: a recorded drive into a mesh, without a daemon.
 *
 *   files -> events -> pipeline -> rows -> map, every so often a batch: the dirty patches meshed -> one model -> file
 *
 * What comes out does not depend on speed, batches or threads (law L2); they are there to be measured, and because a
 * daemon has them. A recording in which the map began anew gives the last map. */
#include <argp.h>
#include <errno.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "core/map.h"
#include "core/model.h"
#include "daemon/crew.h"
#include "daemon/player.h"
#include "daemon/wall_clock.h"
#include "tools/commands.h"
#include "tools/figures.h"
#include "tools/mapped.h"
#include "tools/options.h"

#define CONFIG_BYTES_MAX (1u << 20)
#define SECOND_NS        1000000000

enum { KEY_SPEED = 1, KEY_CONFIG, KEY_BATCH };

struct run {
	struct options options;
	const char *config_path;
	double speed; /* 0: max */
	enum { BATCH_END, BATCH_ROW, BATCH_SECOND, BATCH_ROWS } batch;
	uint64_t batch_rows;

	struct config config;
	struct replay *replay;
	struct pipeline *pipeline;
	struct map *map;
	struct crew *crew;
	struct mesher *mesher; /* of a run on one thread, which tells the two steps apart */
	struct patch_store *store;
	struct figures figures;
	double lap;
	uint64_t rows_since_batch;
	int64_t batch_ns, begin_ns, begin_mono_ns;
	int failed;
	atomic_uint_fast64_t progress;
	atomic_bool stop;
};

static void lap(struct run *run, enum stage stage)
{
	double now = figures_cpu(CLOCK_PROCESS_CPUTIME_ID);

	run->figures.seconds[stage] += now - run->lap;
	run->lap = now;
}

/* One lap through both steps of meshing, the first of which took `extract` of it, 0 .. 1. */
static void lap_split(struct run *run, double extract)
{
	double before = run->lap;

	lap(run, REDUCE);
	run->figures.seconds[REDUCE] -= extract * (run->lap - before);
	run->figures.seconds[EXTRACT] += extract * (run->lap - before);
}

/* Options */

static void parse_batch(struct run *run, const char *word)
{
	if (strcmp(word, "row") == 0) {
		run->batch = BATCH_ROW;
	} else if (strcmp(word, "second") == 0) {
		run->batch = BATCH_SECOND;
	} else if (strcmp(word, "end") == 0) {
		run->batch = BATCH_END;
	} else {
		run->batch_rows = (uint64_t)options_number("batch", word, 1, 1e9);
		run->batch = BATCH_ROWS;
	}
}

static error_t parse(int key, char *word, struct argp_state *state)
{
	struct run *run = state->input;

	switch (key) {
	case ARGP_KEY_INIT:
		state->child_inputs[0] = &run->options;
		return 0;
	case KEY_SPEED:
		run->speed =
		    strcmp(word, "max") == 0 ? 0 : options_number("speed", word, PLAYER_SPEED_MIN, PLAYER_SPEED_MAX);
		return 0;
	case KEY_CONFIG:
		run->config_path = word;
		return 0;
	case KEY_BATCH:
		parse_batch(run, word);
		return 0;
	default:
		return ARGP_ERR_UNKNOWN;
	}
}

static void parse_options(int argc, char **argv, struct run *run)
{
	static const struct argp_option table[] = {
	    {"speed", KEY_SPEED, "X|max", 0, "so many times as fast as it was recorded; max: as fast as can be (max)",
	     0},
	    {"config", KEY_CONFIG, "FILE", 0, "what to replay with instead of the configuration that was recorded", 0},
	    {"batch", KEY_BATCH, "row|second|N|end", 0,
	     "mesh what has changed after every row, every recorded second, every N rows, or once (end); the mesh does "
	     "not depend on it",
	     0},
	    {0}};
	const struct argp_child children[] = {{&options_argp, 0, NULL, 0}, {0}};
	const struct argp argp = {
	    .options = table,
	    .parser = parse,
	    .children = children,
	    .args_doc = "-o OUT FILE...",
	    .doc = "A recorded drive into a mesh.\vFILE: recordings (.mcap; those of one rotation go on one another), "
	           "lists "
	           "kept by facetd --journal; with --config also candump logs, captures of a scanner's TCP (pcap, "
	           "pcapng), "
	           "CARMEN logs and poses as JSON lines, put together by their times; or a folder of uos scans."};

	options_default(&run->options);
	argp_parse(&argp, argc, argv, 0, NULL, run);
	options_check(&run->options, "replay");
	if (run->options.pose != POSE_BESIDE)
		options_refuse("--pose, --no-pose and --poses are for facet reconstruct: a recording knows its poses");
}

/* Configuration */

static int parse_config(struct run *run, const char *text, size_t len, const char *name)
{
	struct config_error error = {""};
	int r = config_read(text, len, name, &run->config, &error);

	if (r < 0)
		return options_complain("%s", r == -ENOMEM ? "out of memory" : error.text);
	return 0;
}

static int load_config(struct run *run)
{
	const char *attached;
	struct mapped file;
	char error[400];
	size_t len;
	int r;

	if (run->config_path) {
		if (mapped_open(run->config_path, &file, error) < 0)
			return options_complain("%s", error);
		r = file.len > CONFIG_BYTES_MAX
		        ? options_complain("%s: more than 1 MB; is it a configuration?", run->config_path)
		        : parse_config(run, (const char *)file.data, file.len, run->config_path);
		mapped_close(&file);
		return r;
	}
	attached = replay_config(run->replay, &len);
	if (!attached)
		return options_complain(
		    "%s: says nothing of the configuration it was recorded with; give it with --config FILE",
		    run->options.input[0]);
	return parse_config(run, attached, len, "facetd.yaml of the recording");
}

/* What the command line says goes before what was recorded. */
static struct map_params map_params(const struct run *run)
{
	const struct options *o = &run->options;
	const struct config *c = &run->config;
	struct map_params params = {.cell_m = c->map.cell_m,
	                            .tolerance = c->map.tolerance,
	                            .reduce = c->map.reduce,
	                            .lookahead = c->map.lookahead,
	                            .memory = c->map.memory};

	if (o->given & OPTION_CELL)
		params.cell_m = o->map.cell_m;
	if (o->given & OPTION_TOLERANCE)
		params.tolerance = o->map.tolerance;
	if (o->given & OPTION_REDUCE)
		params.reduce = o->map.reduce;
	return params;
}

/* Batches */

struct batch {
	size_t n;
	struct patch **patch;
	uint32_t *faces_raw;
};

/* The CPU's clock is read once a batch: it costs a system call, as much as a small patch. Its time is split between the
 * two steps as the wall clock's is. */
static bool mesh_alone(struct run *run, const struct patch_key *key, struct batch *batch)
{
	int64_t begin_ns = wall_clock_read(CLOCK_MONOTONIC), extract_ns = 0, now_ns = begin_ns;
	bool good = true;

	lap(run, REDUCE);
	for (size_t i = 0; i < batch->n && good; i++) {
		good = map_extract(run->map, run->mesher, key[i]) == 0;
		extract_ns -= now_ns;
		extract_ns += wall_clock_read(CLOCK_MONOTONIC);
		if (good)
			batch->patch[i] = map_reduce(run->map, run->mesher);
		good &= batch->patch[i] != NULL;
		now_ns = wall_clock_read(CLOCK_MONOTONIC);
	}
	lap_split(run, now_ns > begin_ns ? (double)extract_ns / (double)(now_ns - begin_ns) : 0);
	return good;
}

static bool mesh_together(struct run *run, const struct patch_key *key, struct batch *batch)
{
	struct crew_task task = {.map = run->map,
	                         .key = key,
	                         .n = batch->n,
	                         .patch = batch->patch,
	                         .faces_raw = batch->faces_raw,
	                         .stop = &run->stop,
	                         .progress = &run->progress};
	bool whole = true;

	crew_mesh(run->crew, &task);
	lap(run, EXTRACT);
	for (size_t i = 0; i < batch->n; i++)
		whole &= batch->patch[i] != NULL;
	return whole;
}

static void keep_batch(struct run *run, struct batch *batch, bool *good)
{
	for (size_t i = 0; i < batch->n; i++) {
		struct patch *patch = batch->patch[i];

		if (!patch)
			continue;
		if (*good)
			*good = patch_store_put(run->store, patch) == 0;
		else
			patch_unref(patch);
	}
	run->figures.batch_patches += batch->n;
}

static int make_batch(struct run *run)
{
	const struct patch_key *key;
	struct batch batch = {.n = map_take_dirty(run->map, &key)};
	bool good = true;

	lap(run, ASSEMBLE);
	run->rows_since_batch = 0;
	if (batch.n == 0)
		return 0;
	batch.patch = calloc(batch.n, sizeof(*batch.patch));
	batch.faces_raw = calloc(batch.n, sizeof(*batch.faces_raw));
	good = batch.patch && batch.faces_raw;
	if (good)
		good = run->crew ? mesh_together(run, key, &batch) : mesh_alone(run, key, &batch);
	if (batch.patch)
		keep_batch(run, &batch, &good);
	free(batch.patch);
	free(batch.faces_raw);
	run->figures.batches++;
	lap(run, REDUCE);
	return good ? 0 : -ENOMEM;
}

/* The pipeline's sink */

static void fold(struct run *run, int folded)
{
	run->rows_since_batch += (uint64_t)folded;
	if (folded > 0 &&
	    (run->batch == BATCH_ROW || (run->batch == BATCH_ROWS && run->rows_since_batch >= run->batch_rows)) &&
	    make_batch(run) < 0)
		run->failed = -ENOMEM;
}

static bool take_row(void *ctx, struct row *row)
{
	struct run *run = ctx;

	lap(run, ASSEMBLE);
	run->figures.rows++;
	for (uint32_t i = 0; i < row->n; i++)
		run->figures.points += row->beam[i].state == BEAM_OK || row->beam[i].state == BEAM_MIXED;
	run->figures.sweeps += row->starts_sweep;
	int folded = map_row(run->map, row);
	lap(run, INTEGRATE);
	fold(run, folded);
	return true;
}

static void on_flush(void *ctx)
{
	struct run *run = ctx;

	lap(run, ASSEMBLE);
	int folded = map_flush(run->map);
	lap(run, INTEGRATE);
	fold(run, folded);
}

static void on_not_applied(void *ctx, uint64_t number, const char *reason)
{
	struct run *run = ctx;

	(void)number;
	(void)reason;
	run->figures.not_applied++;
}

/* The map begins anew: what was is void. */
static int begin_map(struct run *run)
{
	const struct map_params params = map_params(run);

	map_destroy(run->map);
	if (run->store)
		patch_store_destroy(run->store);
	run->map = map_create(&params);
	run->store = patch_store_create();
	run->figures.maps++;
	run->figures.rows = run->figures.points = run->figures.sweeps = run->figures.not_applied = 0;
	return run->map && run->store ? 0 : -ENOMEM;
}

static void on_jump(void *ctx, int device, const struct pose_jump *jump)
{
	struct run *run = ctx;

	(void)device;
	if (jump->done != POSE_TRACK_NEW_MAP)
		return;
	pipeline_reset(run->pipeline);
	if (begin_map(run) < 0)
		run->failed = -ENOMEM;
	replay_began(run->replay);
}

/* The run */

/* Waits until an event of `log_ns` is due. */
static void keep_pace(struct run *run, int64_t log_ns)
{
	int64_t due_ns, now_ns;

	if (run->speed == 0)
		return;
	if (run->begin_mono_ns == 0) {
		run->begin_mono_ns = wall_clock_read(CLOCK_MONOTONIC);
		run->begin_ns = log_ns;
	}
	due_ns = run->begin_mono_ns + (int64_t)((double)(log_ns - run->begin_ns) / run->speed);
	now_ns = wall_clock_read(CLOCK_MONOTONIC);
	if (due_ns > now_ns)
		nanosleep(&(struct timespec){(due_ns - now_ns) / SECOND_NS, (due_ns - now_ns) % SECOND_NS}, NULL);
}

static int take_event(struct run *run, const struct replay_event *event, char error[REPLAY_ERROR_MAX])
{
	bool anew;
	int r;

	run->figures.events++;
	r = replay_feed(run->replay, event, run->pipeline, &anew, error);
	if (r == 0 && anew)
		run->failed = begin_map(run);
	if (event->kind == REPLAY_ROW)
		take_row(run, event->row);
	if (run->batch == BATCH_SECOND && event->log_ns - run->batch_ns >= SECOND_NS) {
		run->batch_ns = event->log_ns;
		if (make_batch(run) < 0)
			run->failed = -ENOMEM;
	}
	return r < 0 ? r : run->failed;
}

static void show_progress(const struct run *run, int64_t log_ns, int64_t begin_ns, int64_t end_ns)
{
	if (run->figures.events % 1024 == 0 && end_ns > begin_ns && isatty(STDERR_FILENO))
		fprintf(stderr, "\r\033[Kfacet: %.0f %%",
		        100.0 * (double)(log_ns - begin_ns) / (double)(end_ns - begin_ns));
}

/* To read an event takes less time than to look at the clock of the process: it counts as assembling. */
static int play(struct run *run, char error[REPLAY_ERROR_MAX])
{
	struct replay_event event;
	int64_t begin_ns, end_ns;
	int r;

	replay_span(run->replay, &begin_ns, &end_ns);
	run->figures.recorded_s = (double)(end_ns - begin_ns) / SECOND_NS;
	run->batch_ns = begin_ns;
	run->lap = figures_cpu(CLOCK_PROCESS_CPUTIME_ID);
	while ((r = replay_next(run->replay, &event, error)) == 1) {
		keep_pace(run, event.log_ns);
		show_progress(run, event.log_ns, begin_ns, end_ns);
		r = take_event(run, &event, error);
		if (r < 0)
			break;
	}
	if (isatty(STDERR_FILENO))
		fputs("\r\033[K", stderr);
	if (r == 0 && replay_ends(run->replay)) {
		pipeline_end(run->pipeline);
		on_flush(run);
	}
	if (r == 0)
		r = make_batch(run);
	return r < 0 ? r : run->failed;
}

/* What the mesh had before its reduction is asked once more: batches have counted what they replaced. */
static int count_patches(struct run *run)
{
	struct mesher *mesher = mesher_create();
	struct patch **patch = NULL;
	size_t n = patch_store_living(run->store, &patch);
	int r = mesher && patch ? 0 : -ENOMEM;

	for (size_t i = 0; i < n && r == 0; i++) {
		figures_patch(&run->figures, patch[i]);
		r = map_extract(run->map, mesher, patch[i]->key);
	}
	if (mesher)
		run->figures.faces_raw = mesher_faces_raw(mesher);
	mesher_destroy(mesher);
	free(patch);
	return r;
}

static int write_mesh(struct run *run)
{
	struct figures *f = &run->figures;
	struct output_error error;
	struct grid_stats grid;
	struct model model;
	int r;

	if (count_patches(run) < 0)
		return options_complain("out of memory");
	grid_stats(map_grid(run->map), &grid);
	f->blocks = grid.blocks;
	if (model_weld(run->store, map_params(run).cell_m, &model) < 0)
		return options_complain("out of memory");
	r = output_mesh(run->options.output, &model, run->options.ascii, &error);
	model_finish(&model);
	lap(run, WRITE);
	patch_store_hash(run->store, f->hash);
	if (r == 0 && run->options.stats)
		r = figures_write(f, run->options.stats, &error);
	return r < 0 ? options_complain("%s", error.text) : 0;
}

static void tell(const struct run *run)
{
	const struct figures *f = &run->figures;
	const double cpu_s = figures_cpu(CLOCK_PROCESS_CPUTIME_ID);

	if (*replay_note(run->replay))
		fprintf(stderr, "facet: %s\n", replay_note(run->replay));
	if (f->rows == 0)
		fprintf(stderr, "facet: no row was measured in it: look at `devices` (tilt, range) and at the poses\n");
	printf("%s: %llu faces, %llu rows, %llu not applied, map %llu\n", run->options.output,
	       (unsigned long long)f->faces, (unsigned long long)f->rows, (unsigned long long)f->not_applied,
	       (unsigned long long)f->maps);
	printf("%llu batches of %.1f patches; %.2f s recorded in %.2f s CPU: %.1f times as fast\n",
	       (unsigned long long)f->batches, f->batches ? (double)f->batch_patches / (double)f->batches : 0,
	       f->recorded_s, cpu_s, f->recorded_s / cpu_s);
	printf("hash %s\n", f->hash);
}

static int replay(struct run *run)
{
	const struct pipeline_sink sink = {
	    .ctx = run, .row = take_row, .not_applied = on_not_applied, .flush = on_flush, .jump = on_jump};
	char error[REPLAY_ERROR_MAX] = "";
	int r;

	if (run->options.threads > 1)
		run->crew = crew_create(run->options.threads);
	else
		run->mesher = mesher_create();
	run->pipeline = pipeline_create(&run->config, &sink);
	if (begin_map(run) < 0 || !run->pipeline || !(run->crew || run->mesher))
		return options_complain("out of memory");
	r = replay_use(run->replay, &run->config, error);
	if (r == 0)
		r = play(run, error);
	if (r < 0)
		return options_complain("%s", *error ? error : "out of memory; use a larger --cell");
	r = write_mesh(run);
	if (r == 0)
		tell(run);
	return r;
}

static int check_outputs(const struct options *o)
{
	struct output_error error;

	if (output_check(o->output, &error) < 0 || (o->stats && output_check(o->stats, &error) < 0))
		return options_complain("%s", error.text);
	return 0;
}

int replay_main(int argc, char **argv)
{
	static struct run run; /* a configuration is large */
	char error[REPLAY_ERROR_MAX];
	int r;

	run.figures.replay = true;
	parse_options(argc, argv, &run);
	r = check_outputs(&run.options);
	if (r == 0 && replay_open((const char *const *)run.options.input, run.options.inputs, &run.replay, error) < 0)
		r = options_complain("%s", error);
	if (r == 0)
		r = load_config(&run);
	if (r == 0)
		r = replay(&run);
	replay_close(run.replay);
	pipeline_destroy(run.pipeline);
	if (run.store)
		patch_store_destroy(run.store);
	map_destroy(run.map);
	mesher_destroy(run.mesher);
	crew_destroy(run.crew);
	return r;
}

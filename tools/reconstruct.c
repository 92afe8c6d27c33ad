/* `facet reconstruct`: files of scans and clouds into one mesh.
 *
 *   file -> rows (raster recovered) or points -> field -> patches, meshed by several threads -> one model -> file
 *
 * Scans go the way of live profiles: the same assembler, with tilt samples before and after each profile as a servo that
 * steps would give them, so that the daemon, fed with the same profiles, makes the same surface.
 * Everything that can be judged before the work is: options, endings, poses' files, the folder of the output. */
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "core/map.h"
#include "core/model.h"
#include "core/text.h"
#include "core/trig.h"
#include "daemon/scan_rows.h"
#include "tools/commands.h"
#include "tools/figures.h"
#include "tools/options.h"
#include "tools/output.h"

#define FILE_MAX ((size_t)4 << 30)

struct run {
	struct options options;
	struct map *map;
	struct patch_store *store;
	struct transform *pose; /* of POSE_FILE (one) and POSE_LIST (one each) */
	int poses;
	int input; /* the one being read */
	struct figures figures;
	double lap; /* CPU seconds at the last call of lap() */
};

struct bytes {
	uint8_t *data;
	size_t len;
};

static int out_of_memory(const char *path)
{
	return options_complain("%s: not enough memory; use a larger --cell or fewer inputs", path);
}

static int complain_parse(const char *path, int r, const struct parse_error *error)
{
	if (r == -ENOMEM)
		return out_of_memory(path);
	if (error->line)
		return options_complain("%s:%u: %s", path, error->line, error->text);
	return options_complain("%s: %s", path, error->text);
}

/* What this process has used since the last call goes to `stage`. */
static void lap(struct run *run, enum stage stage)
{
	double now = figures_cpu(CLOCK_PROCESS_CPUTIME_ID);
	run->figures.seconds[stage] += now - run->lap;
	run->lap = now;
}

static int read_all(int fd, struct bytes *ret)
{
	struct stat info;
	if (fstat(fd, &info) < 0)
		return -errno;
	if (S_ISDIR(info.st_mode))
		return -EISDIR;
	if (!S_ISREG(info.st_mode))
		return -EINVAL;
	if ((size_t)info.st_size > FILE_MAX)
		return -EFBIG;
	struct bytes bytes = {malloc((size_t)info.st_size + 1), 0};
	if (!bytes.data)
		return -ENOMEM;
	while (bytes.len < (size_t)info.st_size) {
		ssize_t n = read(fd, bytes.data + bytes.len, (size_t)info.st_size - bytes.len);
		if (n < 0 && errno == EINTR)
			continue;
		if (n < 0) {
			int r = -errno;
			free(bytes.data);
			return r;
		}
		if (n == 0)
			break;
		bytes.len += (size_t)n;
	}
	*ret = bytes;
	return 0;
}

static int read_file(const char *path, struct bytes *ret)
{
	int fd = open(path, O_RDONLY | O_CLOEXEC | O_NONBLOCK);
	int r = fd < 0 ? -errno : read_all(fd, ret);
	if (fd >= 0)
		close(fd);
	return r;
}

static int read_or_options_complain(const char *path, struct bytes *ret)
{
	int r = read_file(path, ret);
	if (r == -EINVAL)
		return options_complain("%s: is no ordinary file; save it to one first", path);
	return r < 0 ? options_complain("%s: cannot be read: %s", path, strerror(-r)) : 0;
}

/* Poses */

static int read_pose(const char *path, struct transform *ret)
{
	struct bytes bytes;
	if (read_or_options_complain(path, &bytes))
		return 1;
	struct parse_error error;
	int r = uos_read_pose((const char *)bytes.data, bytes.len, ret, &error);
	free(bytes.data);
	return r < 0 ? complain_parse(path, r, &error) : 0;
}

static int parse_tum(struct run *run, const struct bytes *bytes)
{
	struct text text;
	text_init(&text, bytes->data, bytes->len);
	while (run->poses < run->options.inputs && text_skip_empty(&text)) {
		double v[8];
		bool good = text_numbers(&text, 8, v) == 8;
		for (int i = 1; good && i < 8; i++)
			good = v[i] >= -1e6 && v[i] <= 1e6;
		if (!good)
			return options_complain("%s:%u: expected eight numbers: t x y z qx qy qz qw",
			                        run->options.pose_path, text.line);
		double length2 = v[4] * v[4] + v[5] * v[5] + v[6] * v[6] + v[7] * v[7];
		if (!(length2 > 0.98 && length2 < 1.02))
			return options_complain("%s:%u: qx qy qz qw have the length %.3g, a rotation has 1",
			                        run->options.pose_path, text.line, sqrt(length2));
		struct quat q = quat_normalise((struct quat){v[7], v[4], v[5], v[6]});
		run->pose[run->poses++] = transform_quat((struct vec3){v[1], v[2], v[3]}, q);
		text_next_line(&text);
	}
	if (run->poses < run->options.inputs)
		return options_complain("%s: has %d poses for %d inputs; give a line for each", run->options.pose_path,
		                        run->poses, run->options.inputs);
	return 0;
}

static int read_poses(struct run *run)
{
	const struct options *o = &run->options;
	run->pose = calloc((size_t)o->inputs, sizeof *run->pose);
	if (!run->pose)
		return out_of_memory(o->output);
	if (o->pose == POSE_FILE)
		return read_pose(o->pose_path, run->pose);
	if (o->pose != POSE_LIST)
		return 0;
	struct bytes bytes;
	if (read_or_options_complain(o->pose_path, &bytes))
		return 1;
	int r = parse_tum(run, &bytes);
	free(bytes.data);
	return r;
}

/* scanNNN.pose beside scanNNN.3d. */
static int pose_beside(const char *path, struct transform *ret)
{
	char beside[PATH_MAX];
	size_t stem = strlen(path) - strlen(".3d");
	if (stem + sizeof ".pose" > sizeof beside)
		return options_complain("%s: the name is too long", path);
	memcpy(beside, path, stem);
	strcpy(beside + stem, ".pose");
	if (access(beside, F_OK) < 0)
		return options_complain("%s: there is no %s beside it; give --pose FILE or --no-pose", path, beside);
	return read_pose(beside, ret);
}

/* map <- scanner of the input being read. A cloud has no file beside it: its frame is the map. */
static int find_pose(const struct run *run, bool scan, struct transform *ret)
{
	switch (run->options.pose) {
	case POSE_FILE:
		*ret = run->pose[0];
		return 0;
	case POSE_LIST:
		*ret = run->pose[run->input];
		return 0;
	case POSE_BESIDE:
		if (scan)
			return pose_beside(run->options.input[run->input], ret);
		break;
	case POSE_NONE:
		break;
	}
	*ret = transform_identity();
	return 0;
}

/* Inputs */

static int feed_rows(struct run *run, struct scan_rows *rows)
{
	struct row *row;
	int r;

	while ((r = scan_rows_next(rows, &row)) == 1) {
		lap(run, ASSEMBLE);
		row->number = run->figures.rows++;
		map_row(run->map, row);
		lap(run, INTEGRATE);
	}
	lap(run, ASSEMBLE);
	return r < 0 ? out_of_memory(run->options.input[run->input]) : 0;
}

static int add_raster(struct run *run, const struct uos_scan *scan, const struct transform *pose)
{
	struct sweep_stats stats;
	struct scan_rows rows;

	if (scan_rows_begin(&rows, scan, pose, (int64_t)run->figures.rows * SCAN_ROW_NS) < 0)
		return out_of_memory(run->options.input[run->input]);
	int r = feed_rows(run, &rows);
	scan_rows_stats(&rows, &stats);
	run->figures.points += stats.beams[BEAM_OK] + stats.beams[BEAM_MIXED];
	run->figures.sweeps += stats.sweeps;
	scan_rows_finish(&rows);
	return r;
}

/* Points between two folds are one row to the field: a bounded number, in the order of the file. */
#define CLOUD_ROW 4096

static void add_cloud(struct run *run, const struct cloud *cloud, const struct transform *pose, double min_m,
                      double max_m)
{
	size_t waiting = 0;
	for (size_t i = 0; i < cloud->n; i++) {
		double range = vec3_norm(cloud->point[i]);
		if (!(range >= min_m && range <= max_m))
			continue;
		field_point(map_field(run->map), pose->t, transform_point(pose, cloud->point[i]));
		run->figures.points++;
		if (++waiting == CLOUD_ROW) {
			field_fold_points(map_field(run->map));
			waiting = 0;
		}
	}
	field_fold_points(map_field(run->map));
	lap(run, INTEGRATE);
}

static int add_uos(struct run *run, const struct bytes *bytes, struct parse_error *error)
{
	struct transform pose;
	struct uos_scan scan;
	int r = uos_read(bytes->data, bytes->len, &scan, error);
	if (r < 0)
		return r;
	lap(run, READ);
	r = find_pose(run, true, &pose);
	if (r == 0 && scan.rows)
		r = add_raster(run, &scan, &pose);
	else if (r == 0)
		add_cloud(run, &scan.cloud, &pose, UOS_RANGE_MIN_M, UOS_RANGE_MAX_M);
	uos_finish(&scan);
	return r;
}

typedef int cloud_reader(const uint8_t *, size_t, struct cloud *, struct parse_error *);

static int add_points(struct run *run, cloud_reader *reader, const struct bytes *bytes, struct parse_error *error)
{
	struct transform pose;
	struct cloud cloud;
	int r = reader(bytes->data, bytes->len, &cloud, error);
	if (r < 0)
		return r;
	lap(run, READ);
	r = find_pose(run, false, &pose);
	if (r == 0)
		add_cloud(run, &cloud, &pose, 0, 1e6);
	cloud_finish(&cloud);
	return r;
}

static int add_pcd(struct run *run, const struct bytes *bytes, struct parse_error *error)
{
	return add_points(run, pcd_read, bytes, error);
}

static int add_ply(struct run *run, const struct bytes *bytes, struct parse_error *error)
{
	return add_points(run, ply_read_cloud, bytes, error);
}

static int add_xyz(struct run *run, const struct bytes *bytes, struct parse_error *error)
{
	return add_points(run, xyz_read, bytes, error);
}

static const struct format {
	const char *ending;
	int (*add)(struct run *, const struct bytes *,
	           struct parse_error *); /* 0, 1 (complained), -errno. NULL: later */
} formats[] = {
    {".3d", add_uos},  {".pcd", add_pcd}, {".ply", add_ply}, {".xyz", add_xyz},
    {".pts", add_xyz}, {".csv", NULL},    {".mcap", NULL},
};

static const struct format *find_format(const char *path)
{
	size_t len = strlen(path);
	for (size_t i = 0; i < sizeof formats / sizeof *formats; i++) {
		size_t n = strlen(formats[i].ending);
		if (len > n && strcasecmp(path + len - n, formats[i].ending) == 0)
			return &formats[i];
	}
	return NULL;
}

static int check_inputs(const struct options *o)
{
	for (int i = 0; i < o->inputs; i++) {
		const struct format *format = find_format(o->input[i]);
		if (format && format->add)
			continue;
		if (format)
			options_complain("%s: %s files come in a later version; give .3d, .pcd, .ply, .xyz or .pts",
			                 o->input[i], format->ending);
		else
			options_complain(
			    "%s: the ending names no format that is read; give .3d, .pcd, .ply, .xyz or .pts",
			    o->input[i]);
		return 2;
	}
	return 0;
}

static void show_progress(const char *what)
{
	if (isatty(STDERR_FILENO))
		fprintf(stderr, "\r\033[Kfacet: %s", what);
}

static void end_progress(void)
{
	if (isatty(STDERR_FILENO))
		fputs("\r\033[K", stderr);
}

static int add_input(struct run *run, const char *path)
{
	struct bytes bytes;
	struct parse_error error = {0};
	if (read_or_options_complain(path, &bytes))
		return 1;
	int r = find_format(path)->add(run, &bytes, &error);
	free(bytes.data);
	lap(run, READ);
	return r < 0 ? complain_parse(path, r, &error) : r;
}

static int add_inputs(struct run *run)
{
	int r = 0;
	for (run->input = 0; r == 0 && run->input < run->options.inputs; run->input++) {
		show_progress(run->options.input[run->input]);
		r = add_input(run, run->options.input[run->input]);
	}
	end_progress();
	lap(run, READ);
	map_flush(run->map);
	lap(run, INTEGRATE);
	return r;
}

/* Meshing */

struct work {
	const struct map *map;
	const struct patch_key *key;
	size_t n;
	struct patch **patch; /* in key order, whoever made it */
	atomic_size_t next;
};

struct worker {
	struct work *work;
	pthread_t thread;
	struct mesher *mesher;
	bool failed;
	double extract, reduce; /* CPU seconds */
};

static void *mesh_patches(void *arg)
{
	struct worker *worker = arg;
	struct work *work = worker->work;
	double begin = figures_cpu(CLOCK_THREAD_CPUTIME_ID);
	for (size_t i; (i = atomic_fetch_add(&work->next, 1)) < work->n;) {
		int r = map_extract(work->map, worker->mesher, work->key[i]);
		double extracted = figures_cpu(CLOCK_THREAD_CPUTIME_ID);
		work->patch[i] = r == 0 ? map_reduce(work->map, worker->mesher) : NULL;
		worker->failed |= !work->patch[i];
		double reduced = figures_cpu(CLOCK_THREAD_CPUTIME_ID);
		worker->extract += extracted - begin;
		worker->reduce += reduced - extracted;
		begin = reduced;
	}
	return NULL;
}

/* A thread that cannot be started is one less; the caller's own does the work then. */
static bool run_workers(struct run *run, struct work *work, struct worker *worker, int n)
{
	bool good = true;
	int started = 1;
	for (int i = 0; i < n; i++) {
		worker[i] = (struct worker){.work = work, .mesher = mesher_create()};
		good &= worker[i].mesher != NULL;
	}
	for (; good && started < n; started++)
		if (pthread_create(&worker[started].thread, NULL, mesh_patches, &worker[started]) != 0)
			break;
	if (good)
		mesh_patches(&worker[0]);
	for (int i = 1; good && i < started; i++)
		pthread_join(worker[i].thread, NULL);
	for (int i = 0; i < n; i++) {
		good &= !worker[i].failed;
		if (worker[i].mesher)
			run->figures.faces_raw += mesher_faces_raw(worker[i].mesher);
		run->figures.seconds[EXTRACT] += worker[i].extract;
		run->figures.seconds[REDUCE] += worker[i].reduce;
		mesher_destroy(worker[i].mesher);
	}
	return good;
}

/* Puts what has a surface into the store; takes all patches over. */
static bool keep_patches(struct run *run, struct patch **patch, size_t n)
{
	bool good = true;
	for (size_t i = 0; i < n; i++) {
		if (!patch[i])
			continue;
		if (!good || patch[i]->nt == 0) {
			patch_unref(patch[i]);
			continue;
		}
		figures_patch(&run->figures, patch[i]);
		good = patch_store_put(run->store, patch[i]) == 0;
	}
	return good;
}

static int make_mesh(struct run *run)
{
	struct work work = {.map = run->map};
	work.n = map_take_dirty(run->map, &work.key);
	work.patch = calloc(work.n + 1, sizeof(struct patch *));
	struct worker *worker = calloc((size_t)run->options.threads, sizeof *worker);
	show_progress("meshing");
	bool good = work.patch && worker && run_workers(run, &work, worker, run->options.threads);
	run->lap = figures_cpu(CLOCK_PROCESS_CPUTIME_ID); /* the threads have measured themselves */
	if (work.patch)
		good &= keep_patches(run, work.patch, work.n);
	free(work.patch);
	free(worker);
	end_progress();
	lap(run, WRITE);
	return good ? 0 : out_of_memory(run->options.output);
}

/* Results */

static int write_mesh(struct run *run)
{
	struct model model;
	struct output_error error;
	if (model_weld(run->store, run->options.map.cell_m, &model) < 0)
		return out_of_memory(run->options.output);
	int r = output_mesh(run->options.output, &model, run->options.ascii, &error);
	model_finish(&model);
	lap(run, WRITE);
	return r < 0 ? options_complain("%s", error.text) : 0;
}

static int write_stats(struct run *run)
{
	struct output_error error;
	int r = figures_write(&run->figures, run->options.stats, &error);
	return r < 0 ? options_complain("%s", error.text) : 0;
}

static void tell(const struct run *run)
{
	const struct figures *f = &run->figures;
	struct grid_stats grid;
	struct field_stats field;
	grid_stats(map_grid(run->map), &grid);
	field_stats(map_field(run->map), &field);
	if (grid.refused_memory)
		fprintf(stderr,
		        "facet: the map is full (%zu MB): %llu times a block found no room; use a larger --cell\n",
		        run->options.map.memory >> 20, (unsigned long long)grid.refused_memory);
	if (field.far_points)
		fprintf(stderr, "facet: %llu points lay too far from the map's origin; shift the cloud nearer to it\n",
		        (unsigned long long)field.far_points);
	if (f->faces == 0)
		fprintf(stderr, "facet: no surface was found in %llu points; use a larger --cell\n",
		        (unsigned long long)f->points);
	printf("%s: %llu faces of %llu (%.1f %% less), %llu points, %.2f s CPU\n", run->options.output,
	       (unsigned long long)f->faces, (unsigned long long)f->faces_raw, 100 * figures_reduction(f),
	       (unsigned long long)f->points, figures_cpu(CLOCK_PROCESS_CPUTIME_ID));
}

static int check_outputs(const struct options *o)
{
	struct output_error error;
	if (output_check(o->output, &error) < 0 || (o->stats && output_check(o->stats, &error) < 0))
		return options_complain("%s", error.text);
	return 0;
}

static int reconstruct(struct run *run)
{
	int r = add_inputs(run);
	if (r)
		return r;
	struct grid_stats grid;
	grid_stats(map_grid(run->map), &grid);
	run->figures.blocks = grid.blocks;
	if (make_mesh(run) || write_mesh(run))
		return 1;
	patch_store_hash(run->store, run->figures.hash);
	if (run->options.stats && write_stats(run))
		return 1;
	tell(run);
	return 0;
}

int reconstruct_main(int argc, char **argv)
{
	static const char doc[] = "Files of scans or points into a mesh, in metres, x forward, y left, z up.\v"
	                          "INPUT: uos scans scanNNN.3d (scanNNN.pose beside it says where the scanner was), or "
	                          "clouds .pcd .ply .xyz .pts "
	                          "in metres, whose points are taken as seen from the origin of their frame; --pose "
	                          "places that frame in the map.";
	struct run run = {.figures.batches = 1};
	options_parse(argc, argv, doc, &run.options);
	int r = check_inputs(&run.options);
	if (r == 0)
		r = check_outputs(&run.options);
	if (r == 0)
		r = read_poses(&run);
	if (r == 0) {
		run.map = map_create(&run.options.map);
		run.store = patch_store_create();
		run.lap = figures_cpu(CLOCK_PROCESS_CPUTIME_ID);
		r = run.map && run.store ? reconstruct(&run) : out_of_memory(run.options.output);
	}
	if (run.store)
		patch_store_destroy(run.store);
	if (run.map)
		map_destroy(run.map);
	free(run.pose);
	return r;
}

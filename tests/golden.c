/* Law L2: the same rows give the same bytes, whatever compiler, option or machine. Prints the hash of the map of a made-up
 * drive through a room with a column; tests/e2e_golden.sh builds it in many ways and compares.
 *
 *   golden [ROWS [SCAN.3d...]]     ROWS a commit (0: meshed once, at the end); with files: the map of these sweeps instead,
 *                                  each at the pose beside it */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/map.h"
#include "core/model.h"
#include "core/sweep.h"
#include "core/trig.h"

#define BEAMS   361
#define TURN_NS 13333333

struct run {
	struct map *map;
	struct sweep *sweep;
	struct mesher *mesher;
	struct patch_store *store;
	uint64_t rows, rows_a_commit;
	char snapshot[65]; /* hash of the assembler's, half way; empty: there was none */
};

static void commit(struct run *run)
{
	const struct patch_key *dirty;
	size_t n = map_take_dirty(run->map, &dirty);
	for (size_t i = 0; i < n; i++)
		patch_store_put(run->store, map_mesh_patch(run->map, run->mesher, dirty[i], NULL));
}

static struct vec3 in_plane(double bearing_rad)
{
	return (struct vec3){trig_cos(bearing_rad), trig_sin(bearing_rad), 0};
}

/* Distance along d to the walls of a box about the origin. */
static double cast_box(struct vec3 o, struct vec3 d)
{
	const double half[3] = {3.1, 2.3, 1.4};
	const double from[3] = {o.x, o.y, o.z}, way[3] = {d.x, d.y, d.z};
	double best = 1e9;
	for (int axis = 0; axis < 3; axis++)
		for (int side = -1; side <= 1; side += 2) {
			double s = way[axis] * side > 1e-9 ? (side * half[axis] - from[axis]) / way[axis] : 1e9;
			if (s > 0 && s < best)
				best = s;
		}
	return best;
}

/* Distance along d to an upright column at (1.5, 0.4). */
static double cast_column(struct vec3 o, struct vec3 d)
{
	double ox = o.x - 1.5, oy = o.y - 0.4;
	double a = d.x * d.x + d.y * d.y, b = ox * d.x + oy * d.y, c = ox * ox + oy * oy - 0.09;
	double root = b * b - a * c;
	if (a < 1e-12 || root < 0)
		return 1e9;
	double s = (-b - sqrt(root)) / a;
	return s > 0 ? s : 1e9;
}

static void measure(struct profile *p, const struct sweep_params *params, double tilt_rad, const struct pose *pose,
                    uint32_t *noise)
{
	struct transform base = transform_quat(pose->position_m, pose->rotation), tilt = transform_tilt(tilt_rad);
	struct transform a = transform_compose(&base, &params->base_tilt), b = transform_compose(&a, &tilt);
	struct transform laser = transform_compose(&b, &params->tilt_laser);
	for (int k = 0; k < p->n; k++) {
		struct vec3 d = transform_direction(&laser, in_plane(p->first_rad + k * p->step_rad));
		double box = cast_box(laser.t, d), column = cast_column(laser.t, d);
		*noise = *noise * 1664525u + 1013904223u;
		int mm = (int)((box < column ? box : column) * 1000 + (*noise >> 24) * (1.0 / 32) - 4);
		p->range_m[k] = (float)mm / 1000.0f;
		p->state[k] = k % 97 == 96 ? BEAM_NO_ECHO : BEAM_OK;
	}
}

static void drain(struct run *run, int64_t log_ns, bool end)
{
	struct row *row;
	enum sweep_drop drop;
	for (;;) {
		enum sweep_verdict v = sweep_next(run->sweep, log_ns, end, &row, &drop);
		if (v == SWEEP_WAIT || v == SWEEP_NOMEM)
			return;
		if (v == SWEEP_DROPPED)
			continue;
		row->number = run->rows++;
		map_row(run->map, row);
		if (run->rows_a_commit && run->rows % run->rows_a_commit == 0)
			commit(run);
	}
}

/* Law L7: the drive goes on from a snapshot of the assembler in another one, and the map is the same. */
static void change_sweeps(struct run *run, const struct sweep_params *params)
{
	static uint8_t bytes[1 << 20];
	struct sha256 sha;
	struct state s;
	state_save(&s, bytes, sizeof bytes);
	sweep_state(&s, run->sweep);
	sha256_init(&sha);
	sha256_add(&sha, bytes, s.at);
	sha256_hex(&sha, run->snapshot);
	sweep_destroy(run->sweep);
	run->sweep = sweep_create(params);
	state_load(&s, bytes, s.at);
	sweep_state(&s, run->sweep);
	if (!state_done(&s))
		snprintf(run->snapshot, sizeof run->snapshot, "refused");
}

/* Two half sweeps, down and up again, while the robot creeps forward and turns a little. */
static void drive(struct run *run)
{
	struct sweep_params params = {.base_tilt = transform_rpy((struct vec3){0.2, 0, 0.1}, (struct vec3){0, 0.01, 0}),
	                              .tilt_laser = transform_rpy((struct vec3){0, 0, 0.05}, (struct vec3){0, 0, 0}),
	                              .range_min_m = 0.3,
	                              .range_max_m = 30,
	                              .hold_ns = 30000000};
	static struct profile p;
	uint32_t noise = 1;
	run->sweep = sweep_create(&params);
	for (int i = 0; i < 240; i++) {
		int64_t t = (int64_t)i * 2 * TURN_NS;
		double tilt_rad = (i < 120 ? i : 240 - i) * 0.5 * TRIG_DEG - 25 * TRIG_DEG;
		struct pose pose = {.t_ns = t,
		                    .position_m = {i * 0.001, 0, 0},
		                    .rotation = quat_normalise((struct quat){1, 0, 0, i * 0.0002})};
		sweep_tilt(run->sweep, &(struct tilt){t, tilt_rad});
		sweep_pose(run->sweep, &pose);
		p = (struct profile){.t_ns = t,
		                     .beam_ns = 37037,
		                     .turn_ns = TURN_NS,
		                     .interlace = 2,
		                     .parts = 1,
		                     .n = BEAMS,
		                     .first_rad = -90 * TRIG_DEG,
		                     .step_rad = 0.5 * TRIG_DEG};
		measure(&p, &params, tilt_rad, &pose, &noise);
		sweep_profile(run->sweep, &p, t + 2 * TURN_NS);
		drain(run, t, false);
		if (i == 100)
			change_sweeps(run, &params);
	}
	drain(run, INT64_MAX / 2, true);
	map_flush(run->map);
	sweep_destroy(run->sweep);
}

/* The whole file in memory that stays; its length, 0 where it is not there. */
static size_t read_file(const char *path, uint8_t *ret, size_t cap)
{
	FILE *f = fopen(path, "rb");
	size_t len = f ? fread(ret, 1, cap, f) : 0;
	if (f)
		fclose(f);
	return len;
}

static int read_sweep(const char *path, struct uos_scan *ret, struct transform *ret_pose)
{
	static uint8_t data[4 << 20];
	char beside[512];
	struct parse_error error;
	size_t len = read_file(path, data, sizeof data);
	if (!len || uos_read(data, len, ret, &error) < 0)
		return -1;
	snprintf(beside, sizeof beside, "%.*s.pose", (int)strlen(path) - 3, path);
	len = read_file(beside, data, sizeof data);
	return len ? uos_read_pose((char *)data, len, ret_pose, &error) : -1;
}

static int play(struct run *run, struct sweep_params *params, const char *path)
{
	static struct profile p;
	struct uos_scan scan;
	if (read_sweep(path, &scan, &params->map_base) < 0)
		return -1;
	run->sweep = sweep_create(params);
	for (uint32_t i = 0; i < scan.rows; i++) {
		const struct uos_row *r = &scan.row[i];
		int64_t t = (int64_t)i * 4 * TURN_NS;
		p = (struct profile){.t_ns = t,
		                     .beam_ns = 37037,
		                     .turn_ns = TURN_NS,
		                     .interlace = 2,
		                     .parts = 1,
		                     .n = (uint16_t)r->n,
		                     .first_rad = r->first_rad,
		                     .step_rad = r->step_rad};
		memcpy(p.range_m, r->range_m, r->n * sizeof(float));
		memcpy(p.state, r->state, r->n);
		sweep_tilt(run->sweep, &(struct tilt){t - TURN_NS / 4, r->tilt_rad});
		sweep_tilt(run->sweep, &(struct tilt){t + 3 * TURN_NS, r->tilt_rad});
		sweep_profile(run->sweep, &p, t + 3 * TURN_NS);
		drain(run, t + 3 * TURN_NS, false);
	}
	uos_finish(&scan);
	drain(run, INT64_MAX / 2, true);
	map_flush(run->map);
	sweep_destroy(run->sweep);
	return 0;
}

int main(int argc, char **argv)
{
	struct map_params map_params = {
	    .cell_m = 0.05, .tolerance = 0.25, .reduce = true, .lookahead = 2, .memory = 256 << 20};
	struct sweep_params still = {.base_tilt = transform_identity(),
	                             .tilt_laser = transform_identity(),
	                             .fixed_pose = true,
	                             .range_min_m = 0.3,
	                             .range_max_m = 30,
	                             .hold_ns = 30000000};
	struct run run = {.map = map_create(&map_params),
	                  .mesher = mesher_create(),
	                  .store = patch_store_create(),
	                  .rows_a_commit = argc > 1 ? strtoull(argv[1], NULL, 10) : 0};
	for (int i = 2; i < argc; i++)
		if (play(&run, &still, argv[i]) < 0) {
			fprintf(stderr, "golden: cannot read %s\n", argv[i]);
			return 1;
		}
	if (argc <= 2)
		drive(&run);
	commit(&run);
	char hash[65];
	patch_store_hash(run.store, hash);
	printf("%s %zu patches %llu rows", hash, patch_store_count(run.store), (unsigned long long)run.rows);
	if (*run.snapshot)
		printf(" snapshot %.16s", run.snapshot);
	printf("\n");
	return 0;
}

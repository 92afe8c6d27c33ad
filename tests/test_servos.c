/* Law: it does not matter over which bus the angle comes. The same drive with the tilt over a CAN signal, CANopen, Modbus RTU
 * and Modbus TCP gives the same surfaces, within 5 mm both ways; every beam knows its angle, whoever moves the servo; and
 * what was kept of a session, fed in again, is the live map byte for byte, also from a list that begins in mid-session (L7).
 * In virtual time.
 *
 * Surfaces are compared of one motion of the axis, read over each bus: two sweeps that begin at different times look at
 * edges in other places, and differ there by 13 mm (p99), whatever the bus. They are compared before the reduction, which
 * may move either by a quarter of a cell: reduced ones differ by 8 mm. */
#include <float.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <cmocka.h>

#include "core/distance.h"
#include "core/map.h"
#include "core/model.h"
#include "tests/rig_robot.h"

#define SECOND    RIG_SECOND
#define DRIVE_NS  (20 * SECOND) /* whose surface is compared */
#define FIRST_NS  (8 * SECOND)  /* a map from its begin on */
#define SECOND_NS (6 * SECOND)  /* ... and the one that begins in mid-session, with faults */
#define SAMPLE_M2 0.0004        /* a sample for so much surface */
#define NEAR_M    0.005
#define ANGLE_DEG 0.05
#define SPEED_DEG 37.5
#define HISTOGRAM 20000 /* of 0.01 mm */
#define BIN_CELLS 2     /* no triangle of a surface that was not reduced is larger than one */

/* A live map, fed row by row. */
struct live {
	struct config config;
	struct map *map;
	uint64_t rows;
};

static struct map *new_map(const struct config *config)
{
	struct map_params params = {.cell_m = config->map.cell_m,
	                            .tolerance = config->map.tolerance,
	                            .reduce = config->map.reduce,
	                            .lookahead = config->map.lookahead,
	                            .memory = config->map.memory};

	return map_create(&params);
}

static void take_row(void *ctx, struct row *row)
{
	struct live *live = ctx;

	live->rows++;
	map_row(live->map, row);
}

static void flush(void *ctx)
{
	map_flush(((struct live *)ctx)->map);
}

static struct patch_store *mesh_all(struct map *map)
{
	struct patch_store *patches = patch_store_create();
	const struct patch_key *key;
	const size_t n = map_take_dirty(map, &key);
	struct mesher *mesher = mesher_create();

	for (size_t i = 0; i < n; i++)
		patch_store_put(patches, map_mesh_patch(map, mesher, key[i], NULL));
	mesher_destroy(mesher);
	return patches;
}

/* What a kept list gives */

static bool feed_row(void *ctx, struct row *row)
{
	take_row(ctx, row);
	return true;
}

static void expect_fed(const struct live *live, const char *journal, const struct patch_store *patches,
                       const char *what)
{
	struct live fed = {.config = live->config, .map = new_map(&live->config)};
	const struct pipeline_sink sink = {.ctx = &fed, .row = feed_row, .flush = flush};
	struct pipeline *pipeline = pipeline_create(&fed.config, &sink);
	char error[160] = "", one[65], other[65];
	struct patch_store *again;

	if (journal_feed(journal, pipeline, error) < 0)
		fail_msg("%s: %s", what, error);
	again = mesh_all(fed.map);
	patch_store_hash(patches, one);
	patch_store_hash(again, other);
	if (fed.rows != live->rows || strcmp(one, other) != 0)
		fail_msg("%s: %llu rows live, %llu fed; %.16s is not %.16s", what, (unsigned long long)live->rows,
		         (unsigned long long)fed.rows, one, other);
	patch_store_destroy(again);
	pipeline_destroy(pipeline);
	map_destroy(fed.map);
}

/* Surfaces */

struct skin {
	struct model model;
	double side_m; /* of a bin: who is farther away than that is far */
	struct bin {
		int32_t x, y, z;
		uint32_t triangle;
	} * bin; /* [nt], ascending */
};

static int compare_bins(const void *a, const void *b)
{
	const struct bin *p = a, *q = b;

	return p->x != q->x   ? (p->x < q->x ? -1 : 1)
	       : p->y != q->y ? (p->y < q->y ? -1 : 1)
	       : p->z != q->z ? (p->z < q->z ? -1 : 1)
	                      : (p->triangle > q->triangle) - (p->triangle < q->triangle);
}

static struct vec3 corner(const struct skin *s, uint32_t triangle, int i)
{
	const double *v = s->model.vertex[s->model.triangle[triangle][i]];

	return (struct vec3){v[0], v[1], v[2]};
}

static void skin_make(struct skin *s, const struct patch_store *patches, double cell_m)
{
	assert_int_equal(model_weld(patches, cell_m, &s->model), 0);
	s->side_m = BIN_CELLS * cell_m;
	s->bin = calloc(s->model.nt + 1, sizeof(*s->bin));
	assert_non_null(s->bin);
	for (uint32_t i = 0; i < s->model.nt; i++) {
		const struct vec3 a = corner(s, i, 0), b = corner(s, i, 1), c = corner(s, i, 2);

		s->bin[i] = (struct bin){(int32_t)floor((a.x + b.x + c.x) / 3 / s->side_m),
		                         (int32_t)floor((a.y + b.y + c.y) / 3 / s->side_m),
		                         (int32_t)floor((a.z + b.z + c.z) / 3 / s->side_m), i};
	}
	qsort(s->bin, s->model.nt, sizeof(*s->bin), compare_bins);
}

static void skin_finish(struct skin *s)
{
	model_finish(&s->model);
	free(s->bin);
}

/* Distance to the triangles of one column of bins. */
static double column_distance2(const struct skin *s, int32_t x, int32_t y, int32_t z, struct vec3 p)
{
	const struct bin from = {x, y, z, 0};
	uint32_t low = 0, high = s->model.nt;
	double best = DBL_MAX;

	while (low < high) {
		const uint32_t middle = low + (high - low) / 2;

		if (compare_bins(&s->bin[middle], &from) < 0)
			low = middle + 1;
		else
			high = middle;
	}
	for (; low < s->model.nt && s->bin[low].x == x && s->bin[low].y == y && s->bin[low].z <= z + 2; low++) {
		const uint32_t t = s->bin[low].triangle;
		const struct flat flat = flat_make(corner(s, t, 0), corner(s, t, 1), corner(s, t, 2));
		const double d = flat_distance_squared(&flat, p);

		best = d < best ? d : best;
	}
	return best;
}

static double distance_m(const struct skin *s, struct vec3 p)
{
	const int32_t x = (int32_t)floor(p.x / s->side_m), y = (int32_t)floor(p.y / s->side_m),
	              z = (int32_t)floor(p.z / s->side_m);
	double best = s->side_m * s->side_m;

	for (int32_t dx = -1; dx <= 1; dx++)
		for (int32_t dy = -1; dy <= 1; dy++) {
			const double d = column_distance2(s, x + dx, y + dy, z - 1, p);

			best = d < best ? d : best;
		}
	return sqrt(best);
}

struct apart {
	uint64_t samples, off[HISTOGRAM + 1];
};

static double share_m(const struct apart *a, double share)
{
	uint64_t sum = 0;

	for (int i = 0; i <= HISTOGRAM; i++)
		if ((double)(sum += a->off[i]) >= share * (double)a->samples)
			return 1e-5 * (i + 1);
	return 1;
}

/* Samples of each triangle in proportion to its area, at places of a fixed sequence. */
static void compare(const struct skin *of, const struct skin *to, struct apart *ret)
{
	double owed = 0;
	uint64_t random = 1;

	memset(ret, 0, sizeof(*ret));
	for (uint32_t i = 0; i < of->model.nt; i++) {
		const struct vec3 a = corner(of, i, 0), ab = vec3_sub(corner(of, i, 1), a),
		                  ac = vec3_sub(corner(of, i, 2), a);

		owed += 0.5 * vec3_norm(vec3_cross(ab, ac)) / (25 * SAMPLE_M2);
		for (; owed >= 1; owed--) {
			double u = sim_random(&random), v = sim_random(&random), d;

			if (u + v > 1) {
				u = 1 - u;
				v = 1 - v;
			}
			d = distance_m(to, (struct vec3){a.x + u * ab.x + v * ac.x, a.y + u * ab.y + v * ac.y,
			                                 a.z + u * ab.z + v * ac.z});
			ret->samples++;
			ret->off[d < 1e-5 * HISTOGRAM ? (int)(d * 1e5) : HISTOGRAM]++;
		}
	}
}

/* Sessions */

static void in_trouble(struct rig *rig, enum robot_servo servo)
{
	const char *kind = servo == ROBOT_RTU ? "unplug" : servo == ROBOT_TCP ? "refuse" : "bus-off";

	rig_run(rig, 2 * SECOND);
	assert_true(rig_fault(rig, "servo", kind, 0, true));
	rig_run(rig, SECOND);
	assert_true(rig_fault(rig, "servo", kind, 0, false));
	assert_true(rig_fault(rig, "laser", "corrupt", 0.1, true));
	rig_run(rig, SECOND);
	assert_true(rig_fault(rig, "laser", "corrupt", 0.1, false));
	assert_true(rig_fault(rig, "servo", "wall clock", 10, true));
	rig_run(rig, SECOND_NS - 4 * SECOND);
}

static void note(struct rig *rig, enum robot_servo servo)
{
	struct rig_points points;

	rig_points(rig, "laser", &points);
	printf("note: %s: angle off by %.3f degree (p50), %.3f (p99), %.3f (worst) at %.1f degrees/s\n",
	       robot_servo_name(servo), points.angle_p50_deg, points.angle_p99_deg, points.angle_worst_deg, SPEED_DEG);
	if (points.angle_p99_deg > ANGLE_DEG)
		fail_msg("%s: angles are off by %.3f degree", robot_servo_name(servo), points.angle_p99_deg);
	assert_true(points.points > 0 && points.near * 1000 >= points.points * 999);
}

static void open_live(struct live *live, bool reduce, struct config *ret_config)
{
	struct config_error error;

	assert_int_equal(config_read(robot_yaml(), strlen(robot_yaml()), "robot", ret_config, &error), 0);
	ret_config->map.reduce = reduce;
	live->config = *ret_config;
	live->map = new_map(&live->config);
	live->rows = 0;
}

/* The axis is swung by somebody else, as it is for all; only who tells its angle differs. */
static void drive(enum robot_servo servo, struct skin *ret)
{
	struct rig *rig = robot_create(
	    &(struct robot_params){.servo = servo, .swung = true, .speed_deg = SPEED_DEG, .rig = {.seed = 11}});
	struct rig_keeper keeper = {.row = take_row, .flush = flush};
	struct patch_store *patches;
	struct config config;
	struct live live;

	open_live(&live, false, &config);
	keeper.ctx = &live;
	rig_keep(rig, &keeper);
	rig_start(rig);
	rig_run(rig, DRIVE_NS);
	note(rig, servo);
	patches = mesh_all(live.map);
	skin_make(ret, patches, config.map.cell_m);
	patch_store_destroy(patches);
	map_destroy(live.map);
	rig_destroy(rig);
}

static void whatever_the_bus_the_surface_is_the_same(void **state)
{
	static const enum robot_servo servos[] = {ROBOT_CAN, ROBOT_POSITION, ROBOT_RTU, ROBOT_TCP};
	enum { SERVOS = sizeof(servos) / sizeof(servos[0]) };
	static struct apart there, back;
	struct skin skin[SERVOS];

	(void)state;
	for (int i = 0; i < SERVOS; i++)
		drive(servos[i], &skin[i]);
	for (int i = 0; i < SERVOS; i++)
		for (int k = i + 1; k < SERVOS; k++) {
			compare(&skin[i], &skin[k], &there);
			compare(&skin[k], &skin[i], &back);
			printf("note: %s and %s: %.2f and %.2f mm apart (p99), %.2f and %.2f (p50), %llu samples\n",
			       robot_servo_name(servos[i]), robot_servo_name(servos[k]), 1e3 * share_m(&there, 0.99),
			       1e3 * share_m(&back, 0.99), 1e3 * share_m(&there, 0.5), 1e3 * share_m(&back, 0.5),
			       (unsigned long long)there.samples);
			if (share_m(&there, 0.99) > NEAR_M || share_m(&back, 0.99) > NEAR_M)
				fail_msg("%s and %s differ", robot_servo_name(servos[i]), robot_servo_name(servos[k]));
		}
	for (int i = 0; i < SERVOS; i++)
		skin_finish(&skin[i]);
}

/* A session of two maps, the second of which begins in its middle. */
static void session(enum robot_servo servo)
{
	struct rig *rig = robot_create(&(struct robot_params){
	    .servo = servo, .speed_deg = SPEED_DEG, .odometry = true, .rig = {.seed = 11, .thin = 4}});
	char path[64], second[72], error[160] = "";
	struct rig_keeper keeper = {.row = take_row, .flush = flush};
	struct patch_store *patches;
	struct journal *journal;
	struct config config;
	struct live live, first;

	snprintf(path, sizeof(path), "/tmp/facet-servos-%d", (int)getpid());
	snprintf(second, sizeof(second), "%s.2", path);
	journal = journal_create(path, error);
	assert_non_null(journal);
	journal_sink(journal, &keeper.journal);
	open_live(&live, true, &config);
	keeper.ctx = &live;
	rig_keep(rig, &keeper);
	rig_start(rig);
	rig_run(rig, FIRST_NS);
	note(rig, servo);
	first = live;
	patches = mesh_all(first.map);
	open_live(&live, true, &config);
	rig_new_map(rig);
	in_trouble(rig, servo);
	rig_destroy(rig);
	assert_int_equal(journal_error(journal), 0);
	journal_destroy(journal);
	expect_fed(&first, path, patches, robot_servo_name(servo));
	patch_store_destroy(patches);
	patches = mesh_all(live.map);
	expect_fed(&live, second, patches, "from mid-session on");
	printf("note: %s: %llu and %llu rows fed in again are the live maps\n", robot_servo_name(servo),
	       (unsigned long long)first.rows, (unsigned long long)live.rows);
	assert_true(first.rows > 400 && live.rows > 100);
	patch_store_destroy(patches);
	map_destroy(first.map);
	map_destroy(live.map);
	unlink(path);
	unlink(second);
}

static void beams_know_their_angle_and_kept_lists_give_the_live_maps(void **state)
{
	(void)state;
	for (int servo = 0; servo < ROBOT_SERVOS; servo++)
		session((enum robot_servo)servo);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(whatever_the_bus_the_surface_is_the_same),
	    cmocka_unit_test(beams_know_their_angle_and_kept_lists_give_the_live_maps),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

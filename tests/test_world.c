/* The simulated worlds are what they are said to be: solid, closed where they should be, the same on every machine. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "core/trig.h"
#include "tools/scenario.h"
#include "tools/world_parts.h"

static struct world *open_world(const char *name)
{
	char error[160] = "";
	struct world *world = world_create(name, error);

	assert_string_equal(error, "");
	return world;
}

static double cast(const struct world *w, double x, double y, double z, double dx, double dy, double dz)
{
	double n = sqrt(dx * dx + dy * dy + dz * dz);

	return world_cast(w, (struct vec3){x, y, z}, (struct vec3){dx / n, dy / n, dz / n}, 50.0);
}

static void the_hall_has_its_size(void **state)
{
	struct world *w = open_world("hall");

	(void)state;
	assert_true(fabs(cast(w, 7.9, 4.5, 1.5, 0, 0, -1) - 1.5) < 1e-9);
	assert_true(fabs(cast(w, 7.9, 4.5, 1.5, 0, 0, 1) - 1.7) < 1e-9);
	assert_true(fabs(cast(w, 2.9, 4.0, 2.7, -1, 0, 0) - 2.9) < 1e-9);
	assert_true(fabs(cast(w, 12.0, 2.0, 2.7, 1, 0, 0) - 2.0) < 1e-9);
	assert_true(fabs(cast(w, 2.9, 4.0, 2.7, 0, -1, 0) - 4.0) < 1e-9);
	assert_true(fabs(cast(w, 2.9, 4.0, 2.7, 0, 1, 0) - 5.0) < 1e-9);
	/* A door leaf stands 8 cm back, a window pane 20 cm. */
	assert_true(fabs(cast(w, 3.5, 1.0, 1.0, 0, -1, 0) - 1.08) < 1e-9);
	assert_true(fabs(cast(w, 1.8, 8.5, 1.5, 0, 1, 0) - 0.7) < 1e-9);
	world_destroy(w);
}

static void a_ray_meets_a_cylinder_and_a_turned_box_where_they_are(void **state)
{
	struct world *w = open_world("hall");

	(void)state;
	/* The column stands at (6.6, 4.4) with a radius of 0.35 m. */
	assert_true(fabs(cast(w, 5.6, 4.4, 2.0, 1, 0, 0) - 0.65) < 1e-9);
	assert_true(fabs(cast(w, 6.6 + 1.0, 4.4 + 1.0, 2.0, -1, -1, 0) - (sqrt(2.0) - 0.35)) < 1e-9);
	/* A cupboard of 1.2 x 0.45 m at (6.0, 0.5), turned by 8 degrees: its side is reached along its own normal. */
	double c = trig_cos(8.0 * TRIG_DEG), s = trig_sin(8.0 * TRIG_DEG);

	assert_true(fabs(cast(w, 6.0 - s * 1.0, 0.5 + c * 1.0, 1.0, s, -c, 0) - (1.0 - 0.225)) < 1e-9);
	world_destroy(w);
}

/* From inside the hall nothing escapes: it is closed. */
static void the_hall_is_closed(void **state)
{
	struct world *w = open_world("hall");
	uint32_t random = 1;

	(void)state;
	for (int i = 0; i < 200000; i++) {
		double v[3];

		for (int k = 0; k < 3; k++) {
			random = random * 1664525u + 1013904223u;
			v[k] = (random >> 8) / 8388608.0 - 1.0;
		}
		if (v[0] == 0.0 && v[1] == 0.0 && v[2] == 0.0)
			continue;
		assert_true(cast(w, 2.9, 1.7, 0.45, v[0], v[1], v[2]) > 0.0);
	}
	world_destroy(w);
}

/* Against every solid in turn, without the tree: rays begin in open space, so the nearest hit is the answer. */
static void the_tree_changes_no_answer(void **state)
{
	static const char *const name[] = {"hall", "building"};
	uint32_t random = 7;
	int hits = 0;

	(void)state;
	for (int n = 0; n < 2; n++) {
		struct world *w = open_world(name[n]);

		for (int i = 0; i < 5000; i++) {
			double v[3], far, near;

			for (int k = 0; k < 3; k++) {
				random = random * 1664525u + 1013904223u;
				v[k] = (random >> 8) / 8388608.0 - 1.0;
			}
			/* A limit just behind the hit finds it, one just before it finds nothing. */
			double l = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]) + 1e-300;
			struct vec3 o = world_drive(w, i * 0.008).position_m, d = {v[0] / l, v[1] / l, v[2] / l};

			o.z = 0.45;
			far = world_cast(w, o, d, 50.0);
			if (far < 0.0)
				continue;
			near = world_cast(w, o, d, far + 1e-9);
			assert_true(near == far);
			assert_true(world_cast(w, o, d, far - 1e-9) < 0.0);
			hits++;
		}
		world_destroy(w);
	}
	assert_true(hits > 9000);
}

static void the_drive_is_steady_slow_and_touches_nothing(void **state)
{
	static const char *const name[] = {"hall", "building"};

	(void)state;
	for (int n = 0; n < 2; n++) {
		struct world *w = open_world(name[n]);
		struct pose last = world_drive(w, 0.0);
		double seconds = world_drive_seconds(w), way = 0.0;

		assert_true(seconds > 28.0 && seconds < 45.0);
		for (double t = 0.01; t < seconds + 1.0; t += 0.01) {
			struct pose pose = world_drive(w, t);
			double step = vec3_norm(vec3_sub(pose.position_m, last.position_m));

			assert_true(step <= 0.8 * 0.01 + 1e-9);
			assert_true(fabs(pose.rotation.z * last.rotation.w - pose.rotation.w * last.rotation.z) < 0.01);
			way += step;
			last = pose;
			for (int k = 0; k < 36; k++) {
				double a = k * 10.0 * TRIG_DEG;
				double r = cast(w, pose.position_m.x, pose.position_m.y, 0.05 + 0.08 * (k % 12),
				                trig_cos(a), trig_sin(a), 0.0);

				assert_true(r < 0.0 || r > 0.45);
			}
		}
		assert_true(way > 18.0);
		printf("note: %s: %.1f m in %.1f s\n", name[n], way, seconds);
		world_destroy(w);
	}
}

static void an_unknown_world_is_refused_with_those_there_are(void **state)
{
	char error[160] = "";

	(void)state;
	assert_null(world_create("castle", error));
	assert_non_null(strstr(error, "building and hall"));
}

/* ---- the stage ---- */

static struct profile fan(int64_t t_ns)
{
	return (struct profile){.t_ns = t_ns,
	                        .beam_ns = 37037,
	                        .turn_ns = 13333333,
	                        .interlace = 2,
	                        .parts = 1,
	                        .n = 361,
	                        .first_rad = -90.0 * TRIG_DEG,
	                        .step_rad = 0.5 * TRIG_DEG};
}

static double servo_angle(void *ctx, int64_t t_ns)
{
	return sim_servo_angle(ctx, t_ns);
}

static void join(struct stage *stage, struct sim_servo *servo)
{
	stage->join(stage->ctx, &(struct stage_axis){servo, servo_angle}, servo);
}

static void the_noise_of_a_seed_is_the_same_at_every_run_and_within_15_mm(void **state)
{
	struct sim_servo_params params = {.tcp = "127.0.0.1:0", .slave = 1};
	char error[SCENARIO_ERROR_MAX] = "";
	struct sim_servo *servo = sim_servo_create(&params, error);
	struct profile p[3];
	struct stage stage;
	double widest = 0.0;

	(void)state;
	assert_non_null(servo);
	for (int i = 0; i < 3; i++) {
		assert_int_equal(drive_stage("hall", i < 2 ? 5 : 6, &stage, error), 0);
		join(&stage, servo);
		p[i] = fan(1000 + i);
		stage.scene.scan(stage.ctx, &p[i]);
		stage.destroy(stage.ctx);
	}
	assert_memory_equal(p[0].range_m, p[1].range_m, sizeof p[0].range_m);
	assert_memory_not_equal(p[0].range_m, p[2].range_m, sizeof p[0].range_m);
	for (int k = 0; k < 361; k++)
		widest = fmax(widest, fabs(p[0].range_m[k] - p[2].range_m[k]));
	assert_true(widest > 0.02 && widest <= 0.03001);
	sim_servo_destroy(servo);
}

static void a_profile_costs_little(void **state)
{
	struct sim_servo_params params = {.tcp = "127.0.0.1:0", .slave = 1};
	char error[SCENARIO_ERROR_MAX] = "";
	struct sim_servo *servo = sim_servo_create(&params, error);
	struct profile p = fan(0);
	struct stage stage;
	clock_t begin;

	(void)state;
	assert_int_equal(drive_stage("building", 1, &stage, error), 0);
	join(&stage, servo);
	begin = clock();
	for (int i = 0; i < 1000; i++) {
		p.t_ns = i * INT64_C(40000000);
		stage.scene.scan(stage.ctx, &p);
	}
	printf("note: a profile of 361 beams in the building: %.3f ms\n", (double)(clock() - begin) / CLOCKS_PER_SEC);
	assert_true(p.state[180] == BEAM_OK);
	stage.destroy(stage.ctx);
	sim_servo_destroy(servo);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(the_hall_has_its_size),
	    cmocka_unit_test(a_ray_meets_a_cylinder_and_a_turned_box_where_they_are),
	    cmocka_unit_test(the_hall_is_closed),
	    cmocka_unit_test(the_tree_changes_no_answer),
	    cmocka_unit_test(the_drive_is_steady_slow_and_touches_nothing),
	    cmocka_unit_test(an_unknown_world_is_refused_with_those_there_are),
	    cmocka_unit_test(the_noise_of_a_seed_is_the_same_at_every_run_and_within_15_mm),
	    cmocka_unit_test(a_profile_costs_little),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

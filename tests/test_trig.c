/* Law L2: sine and arc tangent agree with libm to 1e-15 and are made of basic operations only. */
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <cmocka.h>

#include "core/trig.h"
#include "core/vec.h"

static double random_in(uint64_t *seed, double low, double high)
{
	*seed = *seed * 6364136223846793005u + 1442695040888963407u;
	return low + (high - low) * (double)(*seed >> 11) / 9007199254740992.0;
}

static void sine_and_cosine_agree_with_libm(void **state)
{
	uint64_t seed = 1;
	double worst = 0;

	(void)state;
	for (int i = 0; i < 400000; i++) {
		double x = random_in(&seed, -100, 100) * (i % 4 == 0 ? 0.01 : 1);

		worst = fmax(worst, fabs(trig_sin(x) - sin(x)));
		worst = fmax(worst, fabs(trig_cos(x) - cos(x)));
	}
	for (int k = -256; k <= 256; k++) { /* where quadrants meet */
		double x = k * (TRIG_PI / 8);

		worst = fmax(worst, fabs(trig_sin(x) - sin(x)));
		worst = fmax(worst, fabs(trig_cos(x) - cos(x)));
	}
	printf("note: sin, cos: worst error %.2g\n", worst);
	assert_true(worst <= 1e-15);
}

static void arc_tangent_agrees_with_libm(void **state)
{
	uint64_t seed = 2;
	double worst = 0;

	(void)state;
	for (int i = 0; i < 400000; i++) {
		double scale = i % 3 == 0 ? 1e-6 : 1;
		double y = random_in(&seed, -40, 40) * scale, x = random_in(&seed, -40, 40);

		worst = fmax(worst, fabs(trig_atan2(y, x) - atan2(y, x)));
		worst = fmax(worst, fabs(trig_atan2(x, y) - atan2(x, y)));
	}
	printf("note: atan2: worst error %.2g\n", worst);
	assert_true(worst <= 1e-15);
}

static void the_axes_are_exact(void **state)
{
	(void)state;
	assert_true(trig_sin(0) == 0 && trig_cos(0) == 1);
	assert_true(trig_atan2(0, 0) == 0);
	assert_true(trig_atan2(0, 1) == 0);
	assert_true(trig_atan2(1, 0) == TRIG_PI / 2);
	assert_true(trig_atan2(-1, 0) == -TRIG_PI / 2);
	assert_true(trig_atan2(0, -1) == TRIG_PI);
	assert_true(trig_atan2(1, 1) == TRIG_PI / 4);
}

static void nonsense_is_not_a_number(void **state)
{
	(void)state;
	assert_true(isnan(trig_sin(NAN)) && isnan(trig_cos(INFINITY)) && isnan(trig_sin(1e9)));
	assert_true(isnan(trig_atan2(NAN, 1)) && isnan(trig_atan2(1, INFINITY)));
}

/* A hash of many results: any compiler and flag that changes a bit fails here. */
static void the_bits_are_the_same_everywhere(void **state)
{
	uint64_t seed = 3, hash = 14695981039346656037u;

	(void)state;
	for (int i = 0; i < 100000; i++) {
		double a = random_in(&seed, -7, 7), b = random_in(&seed, -7, 7);
		double v[3] = {trig_sin(a), trig_cos(a), trig_atan2(a, b)};

		for (int k = 0; k < 3; k++) {
			uint64_t bits;

			memcpy(&bits, &v[k], 8);
			hash = (hash ^ bits) * 1099511628211u;
		}
	}
	printf("note: trig bits %016llx\n", (unsigned long long)hash);
	assert_true(hash == 0x96efec2b25ee8888u);
}

static void assert_near(struct vec3 a, struct vec3 b)
{
	assert_true(vec3_norm(vec3_sub(a, b)) < 1e-12);
}

static void transforms_follow_rep_103(void **state)
{
	struct vec3 forward = {1, 0, 0}, zero = {0, 0, 0};
	struct transform down = transform_tilt(30 * TRIG_DEG);
	struct transform left = transform_rpy(zero, (struct vec3){0, 0, 90 * TRIG_DEG});
	struct transform pitch = transform_rpy(zero, (struct vec3){0, 30 * TRIG_DEG, 0});

	(void)state;
	assert_near(transform_direction(&down, forward), (struct vec3){cos(30 * TRIG_DEG), 0, -0.5});
	assert_near(transform_direction(&pitch, forward), transform_direction(&down, forward));
	assert_near(transform_direction(&left, forward), (struct vec3){0, 1, 0});
}

static void a_transform_and_its_inverse_cancel(void **state)
{
	struct transform a = transform_rpy((struct vec3){1, -2, 3}, (struct vec3){0.3, -0.7, 2.1});
	struct transform b = transform_inverse(&a), c = transform_compose(&a, &b);
	struct vec3 p = {4, 5, -6};

	(void)state;
	assert_near(transform_point(&c, p), p);
	assert_near(transform_point(&b, transform_point(&a, p)), p);
}

static void quaternions_turn_as_their_angles_say(void **state)
{
	double h = 40 * TRIG_DEG;
	struct quat a = {1, 0, 0, 0}, b = {cos(h), 0, 0, sin(h)}; /* yaw of 80 degrees */
	struct quat minus = {-b.w, -b.x, -b.y, -b.z};
	struct transform yaw = transform_rpy((struct vec3){0}, (struct vec3){0, 0, 80 * TRIG_DEG});
	struct transform half = transform_rpy((struct vec3){0}, (struct vec3){0, 0, 40 * TRIG_DEG});
	struct transform t = transform_quat((struct vec3){0}, b);
	struct transform m = transform_quat((struct vec3){0}, quat_between(a, b, 0.5));
	struct transform n = transform_quat((struct vec3){0}, quat_between(a, minus, 0.5));
	struct vec3 p = {1, 2, 3};

	(void)state;
	assert_near(transform_point(&t, p), transform_point(&yaw, p));
	assert_near(transform_point(&m, p), transform_point(&half, p));
	assert_near(transform_point(&n, p), transform_point(&half, p));
	assert_true(quat_normalise((struct quat){0}).w == 1);
	assert_true(quat_normalise((struct quat){1, NAN, 0, 0}).w == 1);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(sine_and_cosine_agree_with_libm),
	    cmocka_unit_test(arc_tangent_agrees_with_libm),
	    cmocka_unit_test(the_axes_are_exact),
	    cmocka_unit_test(nonsense_is_not_a_number),
	    cmocka_unit_test(the_bits_are_the_same_everywhere),
	    cmocka_unit_test(transforms_follow_rep_103),
	    cmocka_unit_test(a_transform_and_its_inverse_cancel),
	    cmocka_unit_test(quaternions_turn_as_their_angles_say),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

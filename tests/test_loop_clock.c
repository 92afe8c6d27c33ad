/* Law: a stamp of the kernel becomes log time whatever is done to the wall clock: never in the future, never before what
 * was read, and wrong by no more than a look at the clocks. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>

#include <cmocka.h>

#include "drivers/loop_clock.h"

#define MS     INT64_C(1000000)
#define SECOND INT64_C(1000000000)
#define WALL   INT64_C(1700000000000000000) /* realtime - monotonic at the begin */
#define LOG    INT64_C(1600000000000000000) /* log time - monotonic */

/* A look at this monotonic time, the loop having taken its time `lag_ns` before. */
static void look(struct loop_clock *c, int64_t monotonic_ns, int64_t lag_ns, int64_t wall_offset_ns, int64_t within_ns)
{
	const struct loop_clock_look l = {.loop_ns = monotonic_ns - lag_ns + LOG,
	                                  .monotonic_ns = monotonic_ns,
	                                  .wall_ns = monotonic_ns + wall_offset_ns,
	                                  .within_ns = within_ns};

	loop_clock_take(c, &l);
}

static void a_stamp_is_dated_by_its_age(void **state)
{
	struct loop_clock c = {.drained_ns = SECOND};

	(void)state;
	look(&c, 2 * SECOND, 0, WALL, 1000);
	assert_int_equal(loop_clock_of_wall(&c, 2 * SECOND - 3 * MS + WALL), 2 * SECOND - 3 * MS + LOG);
	assert_int_equal(loop_clock_of_monotonic(&c, SECOND), SECOND + LOG);
}

static void the_constant_is_the_largest_difference_seen(void **state)
{
	struct loop_clock c = {0};

	(void)state;
	for (int i = 1; i < 100; i++)
		look(&c, i * 10 * MS, i == 40 ? 0 : (1 + i % 7) * MS, WALL, 1000);
	assert_int_equal(c.offset_ns, LOG);
}

static void a_stamp_is_never_later_than_the_look(void **state)
{
	struct loop_clock c = {.drained_ns = SECOND};

	(void)state;
	look(&c, 2 * SECOND, 0, WALL, 1000);
	assert_int_equal(loop_clock_of_wall(&c, 2 * SECOND + WALL + MS / 2), 2 * SECOND + LOG);
	assert_int_equal(loop_clock_of_wall(&c, 3 * SECOND + WALL), 2 * SECOND + LOG);
}

/* Frames that waited in the queue while somebody set the clock, either way and by whatever, carry old stamps. */
static void a_step_of_the_wall_clock_while_frames_wait_changes_no_time(void **state)
{
	static const int64_t steps[] = {3600 * SECOND, -3600 * SECOND, SECOND, -SECOND, 30 * MS, -30 * MS};

	(void)state;
	for (size_t i = 0; i < sizeof steps / sizeof *steps; i++) {
		struct loop_clock c = {.drained_ns = SECOND};

		look(&c, 2 * SECOND, 0, WALL, 1000);
		loop_clock_drained(&c);
		look(&c, 2 * SECOND + 8 * MS, 0, WALL + steps[i], 1000);
		/* one from before the step, one from after it */
		assert_int_equal(loop_clock_of_wall(&c, 2 * SECOND + 2 * MS + WALL), 2 * SECOND + 2 * MS + LOG);
		assert_int_equal(loop_clock_of_wall(&c, 2 * SECOND + 5 * MS + WALL + steps[i]),
		                 2 * SECOND + 5 * MS + LOG);
		loop_clock_drained(&c);
		look(&c, 2 * SECOND + 12 * MS, 0, WALL + steps[i], 1000);
		assert_int_equal(loop_clock_of_wall(&c, 2 * SECOND + 11 * MS + WALL + steps[i]),
		                 2 * SECOND + 11 * MS + LOG);
	}
}

static void a_stamp_that_fits_nothing_is_bounded_by_what_can_have_waited(void **state)
{
	struct loop_clock c = {.drained_ns = SECOND};

	(void)state;
	look(&c, 2 * SECOND, 0, WALL, 1000);
	loop_clock_drained(&c);
	look(&c, 2 * SECOND + 8 * MS, 0, WALL, 1000);
	assert_int_equal(loop_clock_of_wall(&c, WALL - 5 * SECOND), 2 * SECOND + LOG);
	assert_int_equal(loop_clock_of_wall(&c, -1), 2 * SECOND + 8 * MS + LOG);
	assert_int_equal(loop_clock_of_wall(&c, INT64_MAX), 2 * SECOND + 8 * MS + LOG);
	assert_int_equal(loop_clock_of_wall(&c, INT64_MIN), 2 * SECOND + 8 * MS + LOG);
}

static void an_interrupted_look_is_no_step(void **state)
{
	struct loop_clock c = {.drained_ns = 0};

	(void)state;
	look(&c, SECOND, 0, WALL, 1000);
	look(&c, SECOND + MS, 0, WALL - 700000, 800000);
	assert_int_equal(c.wall_ns, WALL);
	look(&c, SECOND + 2 * MS, 0, WALL - 700000, 1000);
	assert_int_equal(c.wall_ns, WALL - 700000);
	assert_int_equal(c.wall_before_ns, WALL);
}

static void this_machines_clocks_agree_with_themselves(void **state)
{
	struct loop_clock c;
	int64_t first_ns, second_ns;

	(void)state;
	loop_clock_start(&c);
	first_ns = loop_clock_look(&c, 5 * SECOND);
	assert_int_equal(first_ns, 5 * SECOND);
	second_ns = loop_clock_look(&c, 5 * SECOND);
	assert_true(second_ns >= first_ns);
	assert_true(loop_clock_of_wall(&c, c.wall_ns + c.monotonic_ns) == second_ns);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_stamp_is_dated_by_its_age),
	    cmocka_unit_test(the_constant_is_the_largest_difference_seen),
	    cmocka_unit_test(a_stamp_is_never_later_than_the_look),
	    cmocka_unit_test(a_step_of_the_wall_clock_while_frames_wait_changes_no_time),
	    cmocka_unit_test(a_stamp_that_fits_nothing_is_bounded_by_what_can_have_waited),
	    cmocka_unit_test(an_interrupted_look_is_no_step),
	    cmocka_unit_test(this_machines_clocks_agree_with_themselves),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

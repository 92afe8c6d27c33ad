/* Law: a byte has the time of the read that delivered it, however late it is understood. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include "drivers/arrivals.h"

static void every_byte_has_the_time_of_its_read(void **state)
{
	struct arrivals a = {0};

	(void)state;
	assert_int_equal(arrivals_at(&a, 1), 0);
	for (int i = 1; i <= 40; i++)
		arrivals_note(&a, (size_t)i, 1000 * i);
	for (uint64_t back = 1, i = 40; i >= 1; i--)
		for (uint64_t k = 0; k < i; k++)
			assert_int_equal(arrivals_at(&a, back++), 1000 * i);
}

static void reads_of_one_time_are_one(void **state)
{
	struct arrivals a = {0};

	(void)state;
	arrivals_note(&a, 5, 10);
	for (int i = 0; i < 1000; i++)
		arrivals_note(&a, 1, 20);
	assert_int_equal(arrivals_at(&a, 1), 20);
	assert_int_equal(arrivals_at(&a, 1000), 20);
	assert_int_equal(arrivals_at(&a, 1001), 10);
}

static void bytes_of_forgotten_reads_are_dated_by_the_oldest_kept(void **state)
{
	struct arrivals a = {0};

	(void)state;
	for (int i = 0; i < 1000; i++)
		arrivals_note(&a, 1, i);
	assert_int_equal(arrivals_at(&a, 1), 999);
	assert_int_equal(arrivals_at(&a, ARRIVALS_MAX), 1000 - ARRIVALS_MAX);
	assert_int_equal(arrivals_at(&a, 500), 1000 - ARRIVALS_MAX);
	assert_int_equal(arrivals_at(&a, 5000), 1000 - ARRIVALS_MAX);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(every_byte_has_the_time_of_its_read),
	    cmocka_unit_test(reads_of_one_time_are_one),
	    cmocka_unit_test(bytes_of_forgotten_reads_are_dated_by_the_oldest_kept),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

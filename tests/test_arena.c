/* Style rule 20: scratch memory is reset between units of work, and steady work allocates nothing. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#include <cmocka.h>

#include "core/arena.h"

static void memory_is_zeroed_and_aligned_also_after_use(void **state)
{
	struct arena arena;

	(void)state;
	arena_init(&arena);
	for (int round = 0; round < 3; round++) {
		for (size_t n = 0; n < 300; n++) {
			unsigned char *p = arena_alloc(&arena, n, 7);

			assert_non_null(p);
			assert_true((uintptr_t)p % 16 == 0);
			for (size_t i = 0; i < 7 * n; i++)
				assert_int_equal(p[i], 0);
			memset(p, 0xab, 7 * n);
		}
		arena_reset(&arena);
	}
	arena_finish(&arena);
}

static void pieces_do_not_overlap(void **state)
{
	struct arena arena;
	uint32_t *piece[200];

	(void)state;
	arena_init(&arena);
	for (uint32_t i = 0; i < 200; i++) {
		piece[i] = ARENA_NEW(&arena, uint32_t, 1000 + i);
		for (uint32_t k = 0; k < 1000 + i; k++)
			piece[i][k] = i;
	}
	for (uint32_t i = 0; i < 200; i++)
		for (uint32_t k = 0; k < 1000 + i; k++)
			assert_int_equal(piece[i][k], i);
	arena_finish(&arena);
}

static void taken_memory_is_aligned_and_counted_and_its_neighbours_are_zeroed(void **state)
{
	struct arena arena;

	(void)state;
	arena_init(&arena);
	for (int round = 0; round < 3; round++) {
		for (size_t n = 1; n < 300; n++) {
			unsigned char *p = ARENA_TAKE(&arena, unsigned char, 7 * n);
			size_t used = arena.used;

			assert_true((uintptr_t)p % 16 == 0);
			memset(p, 0xab, 7 * n);
			assert_int_equal(*ARENA_NEW(&arena, unsigned char, 1), 0);
			assert_int_equal(arena.used, used + 16);
		}
		arena_reset(&arena);
	}
	assert_null(arena_take(&arena, SIZE_MAX / 2, 3));
	arena_finish(&arena);
}

static void steady_work_takes_no_new_memory(void **state)
{
	struct arena arena;
	size_t total = 0;

	(void)state;
	arena_init(&arena);
	for (int round = 0; round < 20; round++) {
		for (size_t i = 0; i < 100; i++)
			assert_non_null(arena_alloc(&arena, 1 + (i * 7919) % 5000, 16));
		if (round == 0)
			total = arena.total;
		assert_int_equal(arena.total, total);
		assert_true(arena.peak >= arena.used && arena.total >= arena.peak);
		arena_reset(&arena);
		assert_int_equal(arena.used, 0);
	}
	arena_finish(&arena);
	assert_int_equal(arena.total, 0);
}

static void a_product_that_overflows_is_refused(void **state)
{
	struct arena arena;

	(void)state;
	arena_init(&arena);
	assert_null(arena_alloc(&arena, SIZE_MAX / 2, 4));
	assert_null(arena_alloc(&arena, SIZE_MAX, 1));
	assert_non_null(arena_alloc(&arena, 1, 1));
	arena_finish(&arena);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(memory_is_zeroed_and_aligned_also_after_use),
	    cmocka_unit_test(pieces_do_not_overlap),
	    cmocka_unit_test(taken_memory_is_aligned_and_counted_and_its_neighbours_are_zeroed),
	    cmocka_unit_test(steady_work_takes_no_new_memory),
	    cmocka_unit_test(a_product_that_overflows_is_refused),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

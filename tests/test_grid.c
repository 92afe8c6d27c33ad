/* Laws L2, L3, L9: blocks at any coordinates, exactly the patches that read a change are dirty, memory is capped. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <cmocka.h>

#include "core/grid.h"

static struct block_key block_of(int32_t i, int32_t j, int32_t k)
{
	return (struct block_key){i >> 3, j >> 3, k >> 3};
}

static void change_voxel(struct grid *grid, int32_t i, int32_t j, int32_t k)
{
	struct block *block = grid_touch(grid, block_of(i, j, k));
	const uint8_t layers[3] = {1u << (i & 7), 1u << (j & 7), 1u << (k & 7)};

	assert_non_null(block);
	block_publish(block, ((k & 7) * 8 + (j & 7)) * 8 + (i & 7), 1);
	grid_mark_changed(grid, block->key, layers);
}

static void a_new_block_is_unknown_everywhere(void **state)
{
	struct grid *grid = grid_create(1 << 20);
	struct block *block;

	(void)state;
	assert_null(grid_find(grid, block_of(-1, -1, -1)));
	assert_int_equal(grid_published(grid, -1, -1, -1), VOXEL_UNKNOWN);
	block = grid_touch(grid, block_of(-1, -1, -1));
	assert_int_equal(block->key.x, -1);
	for (int i = 0; i < BLOCK_VOXELS; i++) {
		assert_int_equal(block->voxel[i].published, VOXEL_UNKNOWN);
		assert_int_equal(block->voxel[i].weight, 0);
	}
	grid_destroy(grid);
}

static void blocks_keep_their_place_and_content(void **state)
{
	enum { N = 3000 };
	static struct block *made[N];
	struct grid *grid = grid_create((size_t)64 << 20);
	uint32_t seed = 7;

	(void)state;
	for (int n = 0; n < N; n++) {
		seed = seed * 1664525u + 1013904223u;
		struct block_key key = {(int32_t)(seed >> 26) - 32, n - N / 2, (int32_t)(seed >> 20 & 63) - 32};

		made[n] = grid_touch(grid, key);
		made[n]->voxel[n % BLOCK_VOXELS].sum = n;
		block_publish(made[n], n % BLOCK_VOXELS, (int16_t)n);
	}
	for (int n = 0; n < N; n++) {
		struct block_key key = made[n]->key;
		int v = n % BLOCK_VOXELS;

		assert_ptr_equal(grid_find(grid, key), made[n]);
		assert_ptr_equal(grid_touch(grid, key), made[n]);
		assert_int_equal(made[n]->voxel[v].sum, n);
		assert_int_equal(grid_published(grid, key.x * 8 + v % 8, key.y * 8 + v / 8 % 8, key.z * 8 + v / 64), n);
	}
	grid_destroy(grid);
}

/* Every voxel modulo 16 on each axis, negative coordinates too: dirty is what (i-3)>>4 .. (i+2)>>4 says, no more. */
static void exactly_the_readers_of_a_voxel_become_dirty(void **state)
{
	struct grid *grid = grid_create((size_t)64 << 20);

	(void)state;
	for (int32_t i = -20; i < 20; i++)
		for (int32_t j = -20; j < 20; j += 3)
			for (int32_t k = -17; k < 17; k += 5) {
				const struct patch_key *keys;
				size_t n, want = 0;

				change_voxel(grid, i, j, k);
				n = grid_take_dirty(grid, &keys);
				for (int32_t z = (k - 3) >> 4; z <= (k + 2) >> 4; z++)
					for (int32_t y = (j - 3) >> 4; y <= (j + 2) >> 4; y++)
						for (int32_t x = (i - 3) >> 4; x <= (i + 2) >> 4; x++, want++) {
							assert_true(want < n);
							assert_int_equal(
							    patch_key_compare(keys[want], (struct patch_key){x, y, z}),
							    0);
						}
				assert_int_equal(n, want);
				assert_int_equal(grid_take_dirty(grid, &keys), 0);
			}
	grid_destroy(grid);
}

static void dirty_patches_come_once_and_in_key_order(void **state)
{
	struct grid *grid = grid_create((size_t)64 << 20);
	const struct patch_key *keys;
	size_t n;

	(void)state;
	for (int round = 0; round < 2; round++)
		for (int i = 40; i >= -40; i--)
			change_voxel(grid, i, -3 * i, i * i % 31);
	n = grid_take_dirty(grid, &keys);
	assert_true(n > 20);
	for (size_t i = 1; i < n; i++)
		assert_true(patch_key_compare(keys[i - 1], keys[i]) < 0);
	grid_destroy(grid);
}

static void no_change_marks_nothing(void **state)
{
	struct grid *grid = grid_create(1 << 20);
	const uint8_t none[3] = {0, 0, 0};
	const struct patch_key *keys;

	(void)state;
	grid_touch(grid, block_of(0, 0, 0));
	grid_mark_changed(grid, block_of(0, 0, 0), none);
	assert_int_equal(grid_take_dirty(grid, &keys), 0);
	grid_destroy(grid);
}

static void at_the_memory_cap_blocks_are_refused_and_counted(void **state)
{
	const size_t cap = 1000000;
	struct grid *grid = grid_create(cap);
	struct grid_stats stats;
	int made = 0;

	(void)state;
	for (int n = 0; n < 1000; n++)
		if (grid_touch(grid, (struct block_key){n, -n, 3}))
			made++;
	grid_stats(grid, &stats);
	assert_true(made > 150);
	assert_int_equal(stats.blocks, made);
	assert_int_equal(stats.refused_memory, 1000 - made);
	assert_true(stats.bytes <= cap);
	assert_non_null(grid_touch(grid, (struct block_key){0, 0, 3})); /* what exists is still found */
	grid_destroy(grid);

	grid = grid_create(0);
	assert_null(grid_touch(grid, (struct block_key){0, 0, 0}));
	grid_destroy(grid);
}

static void taking_dirty_patches_does_not_move_the_cap(void **state)
{
	size_t bytes[2];

	(void)state;
	for (int often = 0; often < 2; often++) {
		struct grid *grid = grid_create((size_t)64 << 20);
		const struct patch_key *keys;
		struct grid_stats stats;

		for (int i = 0; i < 3000; i += 5) {
			change_voxel(grid, i, i / 2, -i);
			if (often)
				grid_take_dirty(grid, &keys);
		}
		grid_stats(grid, &stats);
		bytes[often] = stats.bytes;
		grid_destroy(grid);
	}
	assert_int_equal(bytes[0], bytes[1]);
}

static void what_lies_too_far_is_refused_and_counted(void **state)
{
	struct grid *grid = grid_create(1 << 20);
	struct grid_stats stats;
	const uint8_t all[3] = {0xff, 0xff, 0xff};
	const struct patch_key *keys;
	size_t n;

	(void)state;
	assert_null(grid_touch(grid, (struct block_key){2 * GRID_PATCH_LIMIT + 2, 0, 0}));
	assert_null(grid_touch(grid, (struct block_key){0, -2 * GRID_PATCH_LIMIT - 1, 0}));
	assert_null(grid_touch(grid, (struct block_key){0, 0, INT32_MIN}));
	assert_non_null(grid_touch(grid, (struct block_key){2 * GRID_PATCH_LIMIT + 1, 0, -2 * GRID_PATCH_LIMIT}));
	grid_mark_changed(grid, (struct block_key){2 * GRID_PATCH_LIMIT + 1, 0, -2 * GRID_PATCH_LIMIT}, all);
	n = grid_take_dirty(grid, &keys);
	assert_true(n > 0);
	for (size_t i = 0; i < n; i++)
		assert_true(abs(keys[i].x) <= GRID_PATCH_LIMIT && abs(keys[i].z) <= GRID_PATCH_LIMIT);
	grid_stats(grid, &stats);
	assert_int_equal(stats.refused_far, 3);
	assert_int_equal(stats.blocks, 1);
	grid_destroy(grid);
}

static void count_block(void *ctx, struct block *block)
{
	*(int32_t *)ctx += block->key.x;
}

static void each_block_is_visited_once(void **state)
{
	struct grid *grid = grid_create((size_t)16 << 20);
	int32_t sum = 0;

	(void)state;
	for (int32_t n = 1; n <= 100; n++)
		grid_touch(grid, (struct block_key){n, 0, 0});
	grid_each(grid, count_block, &sum);
	assert_int_equal(sum, 5050);
	grid_destroy(grid);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_new_block_is_unknown_everywhere),
	    cmocka_unit_test(blocks_keep_their_place_and_content),
	    cmocka_unit_test(exactly_the_readers_of_a_voxel_become_dirty),
	    cmocka_unit_test(dirty_patches_come_once_and_in_key_order),
	    cmocka_unit_test(no_change_marks_nothing),
	    cmocka_unit_test(at_the_memory_cap_blocks_are_refused_and_counted),
	    cmocka_unit_test(taking_dirty_patches_does_not_move_the_cap),
	    cmocka_unit_test(what_lies_too_far_is_refused_and_counted),
	    cmocka_unit_test(each_block_is_visited_once),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

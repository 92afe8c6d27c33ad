/* Windows of fields made by hand: sampled over a patch and its halo, in a grid of their own. */
#ifndef FACET_TESTS_WINDOW_H
#define FACET_TESTS_WINDOW_H

#include <stdint.h>

#include "core/cubes.h"

static inline uint64_t window_random(uint64_t *state)
{
	*state = *state * 6364136223846793005ull + 1442695040888963407ull;
	return (*state ^ *state >> 29) >> 16;
}

typedef int window_field(void *ctx, int i, int j, int k); /* 1/256 cell, or VOXEL_UNKNOWN */

static inline void window_set(struct grid *grid, int i, int j, int k, int value)
{
	struct block *block =
	    grid_touch(grid, (struct block_key){i >> BLOCK_SHIFT, j >> BLOCK_SHIFT, k >> BLOCK_SHIFT});
	if (value != VOXEL_UNKNOWN)
		value = value > 768 ? 768 : value < -768 ? -768 : value;
	block_publish(block, ((k & 7) * BLOCK_SIDE + (j & 7)) * BLOCK_SIDE + (i & 7), (int16_t)value);
}

/* The window of patch 0,0,0. */
static inline void window_sample(struct window *window, window_field *field, void *ctx)
{
	struct grid *grid = grid_create(16 << 20);
	for (int k = -WINDOW_LOW; k < WINDOW_SIDE - WINDOW_LOW; k++)
		for (int j = -WINDOW_LOW; j < WINDOW_SIDE - WINDOW_LOW; j++)
			for (int i = -WINDOW_LOW; i < WINDOW_SIDE - WINDOW_LOW; i++)
				window_set(grid, i, j, k, field(ctx, i, j, k));
	cubes_gather(grid, (struct patch_key){0, 0, 0}, window);
	grid_destroy(grid);
}

/* Noise about a ball, a part of it unknown. */
struct window_noise {
	uint64_t random;
	int noise, unknown_of_64;
};

static inline int window_noisy_ball(void *ctx, int i, int j, int k)
{
	struct window_noise *n = ctx;
	int x = i - 8, y = j - 8, z = k - 8, value = (x * x + y * y + z * z - 60) * 20;
	value += n->noise ? (int)(window_random(&n->random) % (uint64_t)(2 * n->noise)) - n->noise : 0;
	return (int)(window_random(&n->random) % 64) < n->unknown_of_64 ? VOXEL_UNKNOWN : value;
}

#endif

/* Blocks of accumulators, wide enough never to saturate: shared by fold.c and rays.c, nobody else's business. */
#ifndef FACET_CORE_SCRATCH_H
#define FACET_CORE_SCRATCH_H

#include "core/fold.h"

/* Sums of one voxel in one word: weight * distance in the upper 40 bits, weight in the lower 24. A contribution weighs at
 * most 129, so FOLD_SAMPLES_MAX of them fit; then the row is folded in parts. 0: nothing (a contribution weighs at least 1). */
typedef int64_t accumulator;

#define WEIGHT_BITS      24
#define FOLD_SAMPLES_MAX 130000

struct scratch_block {
	struct block_key key;
	uint32_t slot;
	uint64_t seen[BLOCK_SIDE];   /* bit y * 8 + x of word z: got surface weight, columns along z apart */
	uint64_t columns;            /* bit y * 8 + x: somewhere in this column along z there is surface weight */
	uint64_t passed[BLOCK_SIDE]; /* as `seen`: a ray took weight */
	accumulator at[BLOCK_VOXELS];
	uint32_t rays[BLOCK_VOXELS]; /* that passed through */
};

struct ray {
	struct vec3 origin, end; /* cells, of the first ray that ended here */
	int32_t x, y, z;         /* voxel of the end */
	uint32_t count;
};

struct fold {
	struct grid *grid;
	struct scratch_block **block; /* in order of their making; allocated ones stay */
	uint32_t used, made;
	uint32_t samples;                /* since the last fold */
	uint32_t *slot;                  /* block number + 1, 0: empty */
	struct scratch_block *recent[8]; /* by the parity of the key: neighbours never evict each other */
	struct ray *ray;
	uint32_t rays, rays_cap;
	uint32_t *ray_slot; /* ray number + 1, 0: empty; 2 * rays_cap of them */
	struct fold_stats stats;
};

/* The accumulators of a block; NULL when scratch or memory is full. scratch_seek looks beyond the recent ones. */
struct scratch_block *scratch_seek(struct fold *, int32_t x, int32_t y, int32_t z);

static inline struct scratch_block *scratch_touch(struct fold *fold, int32_t x, int32_t y, int32_t z)
{
	struct scratch_block *b = fold->recent[(x & 1) | (y & 1) << 1 | (z & 1) << 2];

	return b && b->key.x == x && b->key.y == y && b->key.z == z ? b : scratch_seek(fold, x, y, z);
}

/* Walks every ray through the blocks that exist and marks the voxels it may clear; no ray is left. */
void rays_walk(struct fold *);

static inline int32_t floor_int(double v) /* |v| < 2^31 */
{
	int32_t i = (int32_t)v;

	return i - (v < i);
}

static inline uint32_t hash3(int32_t x, int32_t y, int32_t z)
{
	uint64_t h = (uint32_t)x * UINT64_C(0x9e3779b97f4a7c15) + (uint32_t)y * UINT64_C(0xd1b54a32d192ed03) +
	             (uint32_t)z * UINT64_C(0xabc98388fb8fac03);

	return (uint32_t)((h ^ h >> 32) * UINT64_C(0x9fb21c651e98df25) >> 32);
}

#endif

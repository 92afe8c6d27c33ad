/* Blocks of accumulators, wide enough never to saturate: shared by fold.c and rays.c, nobody else's business. */
#ifndef FACET_CORE_SCRATCH_H
#define FACET_CORE_SCRATCH_H

#include "core/fold.h"

/* Sums of one voxel in one word: weight * (distance + BAND_UNITS), which is never negative, in the upper 40 bits, weight in
 * the lower 24. A contribution weighs at most 129, so FOLD_SAMPLES_MAX of them fit; then the row is folded in parts. 0:
 * nothing (a contribution weighs at least 1). */
typedef uint64_t accumulator;

#define WEIGHT_BITS      24
#define BAND_UNITS       (BAND_CELLS * LATTICE)
#define FOLD_SAMPLES_MAX 130000

/* A sample writes to a column of voxels along x, y or z, eight in one block. The columns of a row lie close together in the
 * cache, wherever their blocks are. At most 42 MB of them are ever made. */
struct column {
	_Alignas(64) accumulator at[BLOCK_SIDE];
};

#define SAMPLE_COLUMNS  3 /* that a sample writes to: its band is at most 11 voxels long */
#define COLUMNS_AT_HAND (BLOCK_SIDE * BLOCK_SIDE)
#define SLAB_COLUMNS    1024
#define SLABS_MAX \
	((SAMPLE_COLUMNS * FOLD_SAMPLES_MAX + FOLD_BLOCKS_MAX * COLUMNS_AT_HAND) / (SLAB_COLUMNS - COLUMNS_AT_HAND) + 2)

/* Column c of an axis: the lesser of the other two coordinates in bits 0..2 of c, the greater one in bits 3..5. */
struct scratch_block {
	struct block_key key;
	uint32_t slot;
	uint64_t seen[3];                                  /* bit c: column c of this axis got surface weight */
	struct column *column[3][BLOCK_SIDE * BLOCK_SIDE]; /* where seen */
	uint64_t passed[BLOCK_SIDE];                       /* bit y * 8 + x of word z: a ray took weight */
	uint32_t rays[BLOCK_VOXELS];                       /* that passed through */
};

struct ray {
	struct vec3 origin, end; /* cells, of the first ray that ended here */
	int32_t x, y, z;         /* voxel of the end */
	uint32_t count;
};

/* Blocks of a row in the order in which they are folded. */
struct turn {
	uint64_t key;
	struct scratch_block *block;
};

#define FOUND_SIZE  512 /* 8 x 8 x 8 neighbours never evict each other */
#define HOLLOW_SIDE 64  /* blocks */

struct fold {
	struct grid *grid;
	struct block *found[FOUND_SIZE]; /* of the grid, whose blocks never move */
	/* Bit x of word z, y (each modulo its number): a block there has, or once had, a negative voxel. */
	uint64_t hollow[HOLLOW_SIDE / 4][HOLLOW_SIDE];
	struct column *slab[SLABS_MAX];     /* allocated ones stay, all zero between rows */
	struct column *column, *column_end; /* the next ones, in the last slab in use */
	uint32_t slabs;                     /* in use */
	struct turn *turn;                  /* [2 * FOLD_BLOCKS_MAX] */
	struct scratch_block **block;       /* in order of their making; allocated ones stay */
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

/* A block of the grid, or NULL. */
struct block *fold_find(struct fold *, int32_t x, int32_t y, int32_t z);

static inline uint64_t *hollow_word(struct fold *fold, int32_t y, int32_t z)
{
	return &fold->hollow[z & (HOLLOW_SIDE / 4 - 1)][y & (HOLLOW_SIDE - 1)];
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

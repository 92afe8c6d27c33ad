/* HashGrid: a sparse grid of integer voxels in blocks of 8x8x8, any integer coordinates (thesis 3.3.1; laws L2, L3,
 * L9).
 *
 * Corner (voxel) i,j,k lies at (i,j,k) * cell. Block = i >> 3, patch = i >> 4 (interfaces, section 2).
 * A voxel keeps integer sums, never a running average, and the value it has *published* to meshes: the fold takes the
 * new mean over into `published` only when it differs by at least 1/16 cell or when known becomes unknown or back. A mean
 * hardly behind a surface (TOUCHING in fold.h) is published as 0, on it. */
#ifndef FACET_CORE_GRID_H
#define FACET_CORE_GRID_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define BLOCK_SHIFT      3
#define BLOCK_SIDE       (1 << BLOCK_SHIFT)
#define BLOCK_VOXELS     (BLOCK_SIDE * BLOCK_SIDE * BLOCK_SIDE)
#define PATCH_SHIFT      4
#define PATCH_SIDE       (1 << PATCH_SHIFT) /* cells a side; a build constant */
#define LATTICE          256                /* lattice units a cell */
#define GRID_PATCH_LIMIT (1 << 18)          /* what lies beyond +-this many patches is dropped and counted */

/* `published` of a voxel no surface has been seen near. */
#define VOXEL_UNKNOWN INT16_MIN

struct voxel {
	int32_t sum;       /* of weight * distance; distance in 1/256 cell, positive before the surface */
	uint16_t weight;   /* capped by scaling sum and weight together */
	int16_t published; /* distance in 1/256 cell, or VOXEL_UNKNOWN: all a mesh ever reads; see block_publish */
};

struct block_key {
	int32_t x, y, z;
};

struct patch_key {
	int32_t x, y, z;
};

struct block {
	struct block_key key;
	uint8_t layers[3]; /* kept by the field, as is `negative`: bit b where layer b along x, y, z has such a voxel */
	uint64_t negative[BLOCK_SIDE]; /* bit y * 8 + x of word z: the sum is negative, so a ray may clear the voxel */
	uint64_t known[BLOCK_SIDE], inside[BLOCK_SIDE]; /* as `negative`: published as known, as behind a surface */
	_Alignas(64) struct voxel
	    voxel[BLOCK_VOXELS]; /* a row of eight along x is one line of the cache; index (z * 8 + y) * 8 + x */
};

/* Sets the published value of a voxel, by its index, with its bits. */
static inline void block_publish(struct block *block, int index, int16_t value)
{
	const uint64_t bit = UINT64_C(1) << (index & 63);
	const int z = index >> 6;

	block->voxel[index].published = value;
	block->known[z] = value != VOXEL_UNKNOWN ? block->known[z] | bit : block->known[z] & ~bit;
	block->inside[z] = value != VOXEL_UNKNOWN && value < 0 ? block->inside[z] | bit : block->inside[z] & ~bit;
}

struct grid;

/* `memory` bytes is the cap of everything the grid owns: at the cap new blocks are refused and counted (L9). What it
 * owns depends on the blocks alone, not on when dirty patches were taken (L2). */
struct grid *grid_create(size_t memory);
void grid_destroy(struct grid *);

/* NULL where there is none. */
struct block *grid_find(const struct grid *, struct block_key);

#define GRID_BOX_SIDE 4

/* The blocks of a box from `low`, NULL where there are none; index (z * 4 + y) * 4 + x. */
void grid_find_box(const struct grid *, struct block_key low,
                   const struct block *ret_blocks[GRID_BOX_SIDE * GRID_BOX_SIDE * GRID_BOX_SIDE]);

/* The block, made if absent; NULL beyond the limits (counted in grid_stats). */
struct block *grid_touch(struct grid *, struct block_key);

/* Published value of any voxel; VOXEL_UNKNOWN where there is no block. */
int16_t grid_published(const struct grid *, int32_t i, int32_t j, int32_t k);

/* Marks every patch that reads a voxel of `block` whose published value changed (patches (i-3)>>4 .. (i+2)>>4 per
 * axis); `layers[axis]` has bit b set where a voxel in layer b along that axis changed. */
void grid_mark_changed(struct grid *, struct block_key, const uint8_t layers[3]);

/* The dirty patches in ascending key order (z, then y, then x), and none are dirty afterwards.
 * The array is the grid's, valid until the next grid_mark_changed. */
size_t grid_take_dirty(struct grid *, const struct patch_key **ret_keys);

struct grid_stats {
	uint64_t blocks, refused_memory, refused_far;
	size_t bytes;
};
void grid_stats(const struct grid *, struct grid_stats *ret);

/* Total order of patch keys: z, then y, then x. */
int patch_key_compare(struct patch_key a, struct patch_key b);

/* Every block, in no particular order, for tests and audits. */
void grid_each(const struct grid *, void (*visit)(void *ctx, struct block *), void *ctx);

#endif

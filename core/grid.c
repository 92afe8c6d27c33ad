/* Two open-addressing tables on integer keys, with linear probing and at most half full: blocks, and the patches that
 * read them.
 *
 * Blocks live in slabs that never move, so pointers to blocks stay valid; the table maps a key to a block's number.
 * A patch gets its entry when the first block it reads is made. So marking it dirty allocates nothing and cannot fail,
 * and the memory in use, which decides where blocks are refused, follows from the blocks alone: law L2 forbids that it
 * depend on how often somebody took the dirty patches.
 *
 * Look-ups go without a cache here, since several threads may read at once; who walks through neighbouring blocks keeps
 * the last ones himself. */
#include "core/grid.h"

#include <assert.h>
#include <stdlib.h>
#include <string.h>

#define SLAB_SHIFT  4
#define SLAB_BLOCKS (1 << SLAB_SHIFT)
#define SLOTS_FIRST 256 /* a power of two */

enum { PATCH_NONE, PATCH_CLEAN, PATCH_DIRTY };

struct slot {
	int32_t x, y, z;
	uint32_t value; /* block table: number + 1, 0 where empty; patch table: PATCH_... */
};

struct table {
	struct slot *slot;
	size_t slots, used; /* slots is a power of two */
};

struct grid {
	size_t memory, bytes;
	struct table blocks, patches;
	struct block **slab;
	size_t slabs, slabs_cap;
	struct patch_key *dirty; /* room for half of patches.slots */
	size_t dirty_n;
	uint64_t refused_memory, refused_far;
};

static size_t hash_of(int32_t x, int32_t y, int32_t z)
{
	uint64_t h = (uint32_t)x * UINT64_C(0x9e3779b97f4a7c15) + (uint32_t)y * UINT64_C(0xd1b54a32d192ed03) +
	             (uint32_t)z * UINT64_C(0xabc98388fb8fac03);

	h ^= h >> 32;
	h *= UINT64_C(0x9fb21c651e98df25);
	return (size_t)(h >> 32);
}

/* The slot of a key, or the empty one where it belongs. */
static struct slot *table_at(const struct table *table, int32_t x, int32_t y, int32_t z)
{
	size_t mask = table->slots - 1;
	size_t i = hash_of(x, y, z) & mask;

	while (table->slot[i].value && (table->slot[i].x != x || table->slot[i].y != y || table->slot[i].z != z))
		i = (i + 1) & mask;
	return &table->slot[i];
}

static void table_rehash(struct table *table, struct slot *slot, size_t slots)
{
	struct table wider = {.slot = slot, .slots = slots, .used = table->used};

	for (size_t i = 0; i < table->slots; i++) {
		const struct slot *s = &table->slot[i];

		if (s->value)
			*table_at(&wider, s->x, s->y, s->z) = *s;
	}
	free(table->slot);
	*table = wider;
}

static bool room_for(struct grid *grid, size_t bytes)
{
	return grid->bytes <= grid->memory && bytes <= grid->memory - grid->bytes;
}

static bool blocks_reserve(struct grid *grid)
{
	struct table *table = &grid->blocks;

	if (2 * (table->used + 1) > table->slots) {
		size_t bytes = table->slots * sizeof(struct slot);
		struct slot *slot = room_for(grid, bytes) ? calloc(2 * table->slots, sizeof(*slot)) : NULL;

		if (!slot)
			return false;
		table_rehash(table, slot, 2 * table->slots);
		grid->bytes += bytes;
	}
	return true;
}

/* Room for `n` more patches, in the table and in the list of dirty ones. */
static bool patches_reserve(struct grid *grid, size_t n)
{
	struct table *table = &grid->patches;

	if (2 * (table->used + n) > table->slots) {
		size_t slots = 2 * table->slots;
		size_t bytes = table->slots * sizeof(struct slot) + table->slots / 2 * sizeof(struct patch_key);
		struct patch_key *dirty;
		struct slot *slot;

		if (!room_for(grid, bytes))
			return false;
		dirty = realloc(grid->dirty, slots / 2 * sizeof(*dirty));
		if (!dirty)
			return false;
		grid->dirty = dirty;
		slot = calloc(slots, sizeof(*slot));
		if (!slot)
			return false;
		table_rehash(table, slot, slots);
		grid->bytes += bytes;
	}
	return true;
}

static bool slab_reserve(struct grid *grid)
{
	struct block **list;

	if (grid->blocks.used < grid->slabs << SLAB_SHIFT)
		return true;
	if (grid->slabs == grid->slabs_cap) {
		size_t cap = grid->slabs_cap ? 2 * grid->slabs_cap : 16;
		size_t bytes = (cap - grid->slabs_cap) * sizeof(*list);

		list = room_for(grid, bytes) ? realloc(grid->slab, cap * sizeof(*list)) : NULL;
		if (!list)
			return false;
		grid->slab = list;
		grid->slabs_cap = cap;
		grid->bytes += bytes;
	}
	if (!room_for(grid, SLAB_BLOCKS * sizeof(struct block)))
		return false;
	grid->slab[grid->slabs] = aligned_alloc(_Alignof(struct block), SLAB_BLOCKS * sizeof(struct block));
	if (!grid->slab[grid->slabs])
		return false;
	grid->slabs++;
	grid->bytes += SLAB_BLOCKS * sizeof(struct block);
	return true;
}

static struct block *block_at(const struct grid *grid, size_t number)
{
	return &grid->slab[number >> SLAB_SHIFT][number & (SLAB_BLOCKS - 1)];
}

struct grid *grid_create(size_t memory)
{
	struct grid *grid = calloc(1, sizeof(*grid));

	if (!grid)
		return NULL;
	grid->memory = memory;
	grid->blocks.slots = grid->patches.slots = SLOTS_FIRST;
	grid->blocks.slot = calloc(SLOTS_FIRST, sizeof(struct slot));
	grid->patches.slot = calloc(SLOTS_FIRST, sizeof(struct slot));
	grid->dirty = malloc(SLOTS_FIRST / 2 * sizeof(*grid->dirty));
	if (!grid->blocks.slot || !grid->patches.slot || !grid->dirty) {
		grid_destroy(grid);
		return NULL;
	}
	grid->bytes = sizeof(*grid) + 2 * SLOTS_FIRST * sizeof(struct slot) + SLOTS_FIRST / 2 * sizeof(*grid->dirty);
	return grid;
}

void grid_destroy(struct grid *grid)
{
	if (!grid)
		return;
	for (size_t i = 0; i < grid->slabs; i++)
		free(grid->slab[i]);
	free(grid->slab);
	free(grid->dirty);
	free(grid->patches.slot);
	free(grid->blocks.slot);
	free(grid);
}

struct block *grid_find(const struct grid *grid, struct block_key key)
{
	const struct slot *slot = table_at(&grid->blocks, key.x, key.y, key.z);

	return slot->value ? block_at(grid, slot->value - 1) : NULL;
}

/* One look-up waits for the next, and blocks lie anywhere: so first all of the table's lines are asked for, then the bits
 * of all blocks, and the memory answers them together. */
void grid_find_box(const struct grid *grid, struct block_key low,
                   const struct block *ret_blocks[GRID_BOX_SIDE * GRID_BOX_SIDE * GRID_BOX_SIDE])
{
	enum { SIDE = GRID_BOX_SIDE, BLOCKS = SIDE * SIDE * SIDE };
	const size_t mask = grid->blocks.slots - 1;

	for (int n = 0; n < BLOCKS; n++) {
		size_t hash = hash_of(low.x + n % SIDE, low.y + n / SIDE % SIDE, low.z + n / (SIDE * SIDE));

		__builtin_prefetch(&grid->blocks.slot[hash & mask]);
	}
	for (int n = 0; n < BLOCKS; n++) {
		struct block_key key = {low.x + n % SIDE, low.y + n / SIDE % SIDE, low.z + n / (SIDE * SIDE)};
		const struct block *block = ret_blocks[n] = grid_find(grid, key);

		if (block) {
			__builtin_prefetch(block->known);
			__builtin_prefetch(block->inside);
			__builtin_prefetch(block->inside + BLOCK_SIDE - 1);
		}
	}
}

static bool patch_within(int32_t x, int32_t y, int32_t z)
{
	return x >= -GRID_PATCH_LIMIT && x <= GRID_PATCH_LIMIT && y >= -GRID_PATCH_LIMIT && y <= GRID_PATCH_LIMIT &&
	       z >= -GRID_PATCH_LIMIT && z <= GRID_PATCH_LIMIT;
}

/* The patches along one axis that read the layers low..high of block `b`. */
static void readers(int32_t b, int low, int high, int32_t *ret_from, int32_t *ret_to)
{
	*ret_from = (b * BLOCK_SIDE + low - 3) >> PATCH_SHIFT;
	*ret_to = (b * BLOCK_SIDE + high + 2) >> PATCH_SHIFT;
}

/* Entries for every patch that reads any voxel of the block: at most two along each axis. */
static bool patches_enter(struct grid *grid, struct block_key key)
{
	int32_t x0, x1, y0, y1, z0, z1;

	if (!patches_reserve(grid, 8))
		return false;
	readers(key.x, 0, BLOCK_SIDE - 1, &x0, &x1);
	readers(key.y, 0, BLOCK_SIDE - 1, &y0, &y1);
	readers(key.z, 0, BLOCK_SIDE - 1, &z0, &z1);
	for (int32_t z = z0; z <= z1; z++)
		for (int32_t y = y0; y <= y1; y++)
			for (int32_t x = x0; x <= x1; x++) {
				struct slot *slot = table_at(&grid->patches, x, y, z);

				if (!slot->value) {
					*slot = (struct slot){x, y, z, PATCH_CLEAN};
					grid->patches.used++;
				}
			}
	return true;
}

static void block_clear(struct block *block, struct block_key key)
{
	memset(block, 0, sizeof(*block));
	block->key = key;
	for (int i = 0; i < BLOCK_VOXELS; i++)
		block->voxel[i].published = VOXEL_UNKNOWN;
}

struct block *grid_touch(struct grid *grid, struct block_key key)
{
	const int to_patch = PATCH_SHIFT - BLOCK_SHIFT;
	struct block *block = grid_find(grid, key);

	if (block)
		return block;
	if (!patch_within(key.x >> to_patch, key.y >> to_patch, key.z >> to_patch)) {
		grid->refused_far++;
		return NULL;
	}
	if (!slab_reserve(grid) || !blocks_reserve(grid) || !patches_enter(grid, key)) {
		grid->refused_memory++;
		return NULL;
	}
	block = block_at(grid, grid->blocks.used++);
	block_clear(block, key);
	*table_at(&grid->blocks, key.x, key.y, key.z) = (struct slot){key.x, key.y, key.z, (uint32_t)grid->blocks.used};
	return block;
}

int16_t grid_published(const struct grid *grid, int32_t i, int32_t j, int32_t k)
{
	const struct block *block =
	    grid_find(grid, (struct block_key){i >> BLOCK_SHIFT, j >> BLOCK_SHIFT, k >> BLOCK_SHIFT});
	const int32_t in = BLOCK_SIDE - 1;

	if (!block)
		return VOXEL_UNKNOWN;
	return block->voxel[((k & in) * BLOCK_SIDE + (j & in)) * BLOCK_SIDE + (i & in)].published;
}

static int lowest_bit(uint8_t bits)
{
	return __builtin_ctz(bits);
}

static int highest_bit(uint8_t bits)
{
	return 31 - __builtin_clz(bits);
}

void grid_mark_changed(struct grid *grid, struct block_key key, const uint8_t layers[3])
{
	const int32_t at[3] = {key.x, key.y, key.z};
	int32_t from[3], to[3];

	if (!layers[0] || !layers[1] || !layers[2])
		return;
	for (int a = 0; a < 3; a++)
		readers(at[a], lowest_bit(layers[a]), highest_bit(layers[a]), &from[a], &to[a]);
	for (int32_t z = from[2]; z <= to[2]; z++)
		for (int32_t y = from[1]; y <= to[1]; y++)
			for (int32_t x = from[0]; x <= to[0]; x++) {
				struct slot *slot = table_at(&grid->patches, x, y, z);

				assert(slot->value); /* entered when the block was made */
				if (slot->value != PATCH_CLEAN || !patch_within(x, y, z))
					continue;
				slot->value = PATCH_DIRTY;
				grid->dirty[grid->dirty_n++] = (struct patch_key){x, y, z};
			}
}

static int compare_dirty(const void *a, const void *b)
{
	return patch_key_compare(*(const struct patch_key *)a, *(const struct patch_key *)b);
}

size_t grid_take_dirty(struct grid *grid, const struct patch_key **ret_keys)
{
	size_t n = grid->dirty_n;

	for (size_t i = 0; i < n; i++)
		table_at(&grid->patches, grid->dirty[i].x, grid->dirty[i].y, grid->dirty[i].z)->value = PATCH_CLEAN;
	qsort(grid->dirty, n, sizeof(*grid->dirty), compare_dirty);
	grid->dirty_n = 0;
	*ret_keys = grid->dirty;
	return n;
}

void grid_stats(const struct grid *grid, struct grid_stats *ret)
{
	*ret = (struct grid_stats){
	    .blocks = grid->blocks.used,
	    .refused_memory = grid->refused_memory,
	    .refused_far = grid->refused_far,
	    .bytes = grid->bytes,
	};
}

void grid_each(const struct grid *grid, void (*visit)(void *ctx, struct block *), void *ctx)
{
	for (size_t i = 0; i < grid->blocks.used; i++)
		visit(ctx, block_at(grid, i));
}

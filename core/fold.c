/* From samples to voxels.
 *
 * A sample is a point with a plane through it. It gives the voxels of its column, along the axis that the plane faces
 * most, their distance to the plane; the weight falls off linearly to the end of the band, three cells on either side.
 * A narrower band with a quadratic fall is sharper on perfect poses; with odometry it makes two surfaces of one wall.
 * Distances step along the column by a constant, in integers of 1/65536 cell.
 *
 * A row's contributions gather in blocks of wide accumulators. Then each voxel that got any is folded once:
 *   surface:  sum and weight are added; beyond WEIGHT_MAX both are scaled down to it, so the map forgets slowly
 *   rays only: weight is taken, the mean stays; below WEIGHT_KNOWN the voxel is unknown again and empty
 * and its published value follows by the rule of grid.h. Blocks are folded in key order, so that at the memory cap the
 * same ones are refused whatever the order of the contributions. */
#include "core/scratch.h"

#include <assert.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#define SLOTS        (4 * FOLD_BLOCKS_MAX)
#define WEIGHT_SCALE 4

_Static_assert((SLOTS & (SLOTS - 1)) == 0, "slots are a power of two");

/* Rays look into blocks that have negative voxels. */
static void hollow_mark(void *ctx, struct block *block)
{
	if (block->layers[0])
		*hollow_word(ctx, block->key.y, block->key.z) |= UINT64_C(1) << (block->key.x & (HOLLOW_SIDE - 1));
}

struct fold *fold_create(struct grid *grid)
{
	struct fold *fold = calloc(1, sizeof(*fold));

	if (!fold)
		return NULL;
	fold->grid = grid;
	fold->rays_cap = 1024;
	fold->block = calloc(FOLD_BLOCKS_MAX, sizeof(*fold->block));
	fold->slot = calloc(SLOTS, sizeof(*fold->slot));
	fold->turn = malloc(2 * FOLD_BLOCKS_MAX * sizeof(*fold->turn));
	fold->ray = malloc(fold->rays_cap * sizeof(*fold->ray));
	fold->ray_slot = calloc(2 * (size_t)fold->rays_cap, sizeof(*fold->ray_slot));
	if (!fold->block || !fold->slot || !fold->turn || !fold->ray || !fold->ray_slot) {
		fold_destroy(fold);
		return NULL;
	}
	grid_each(grid, hollow_mark, fold);
	return fold;
}

void fold_destroy(struct fold *fold)
{
	if (!fold)
		return;
	for (uint32_t i = 0; i < fold->made; i++)
		free(fold->block[i]);
	for (uint32_t i = 0; i < SLABS_MAX; i++)
		free(fold->slab[i]);
	free(fold->turn);
	free(fold->block);
	free(fold->slot);
	free(fold->ray);
	free(fold->ray_slot);
	free(fold);
}

struct scratch_block *scratch_seek(struct fold *fold, int32_t x, int32_t y, int32_t z)
{
	struct scratch_block **recent = &fold->recent[(x & 1) | (y & 1) << 1 | (z & 1) << 2], *b;
	uint32_t i;

	for (i = hash3(x, y, z) & (SLOTS - 1); fold->slot[i]; i = (i + 1) & (SLOTS - 1)) {
		b = fold->block[fold->slot[i] - 1];
		if (b->key.x == x && b->key.y == y && b->key.z == z)
			return *recent = b;
	}
	if (fold->used == FOLD_BLOCKS_MAX)
		return NULL;
	if (fold->used == fold->made) {
		fold->block[fold->made] = calloc(1, sizeof(*b));
		if (!fold->block[fold->made])
			return NULL;
		fold->made++;
	}
	b = fold->block[fold->used++];
	b->key = (struct block_key){x, y, z};
	b->slot = i;
	fold->slot[i] = fold->used;
	return *recent = b;
}

/* Sees to it that as many columns are at hand, all zero, as a sample or a block may need. */
static bool columns_reserve(struct fold *fold)
{
	struct column **slab = &fold->slab[fold->slabs];

	if (fold->column_end - fold->column >= COLUMNS_AT_HAND)
		return true;
	assert(fold->slabs < SLABS_MAX);
	if (!*slab) {
		*slab = aligned_alloc(_Alignof(struct column), SLAB_COLUMNS * sizeof(**slab));
		if (!*slab)
			return false;
		memset(*slab, 0, SLAB_COLUMNS * sizeof(**slab));
	}
	fold->slabs++;
	fold->column = *slab;
	fold->column_end = *slab + SLAB_COLUMNS;
	return true;
}

/* The column with a number along an axis of a block; a new one if there is none, without a branch. */
static inline struct column *column_of(struct fold *fold, struct scratch_block *block, int axis, int number)
{
	const int seen = (int)(block->seen[axis] >> number & 1);
	struct column *const either[2] = {fold->column, block->column[axis][number]}, *const column = either[seen];

	block->seen[axis] |= UINT64_C(1) << number;
	block->column[axis][number] = column;
	fold->column += !seen;
	return column;
}

/* The coordinates of a point or a normal in the order of a plane: along its axis, the lesser and the greater other one. */
static void turn_to(int axis, struct vec3 v, double ret[3])
{
	ret[0] = axis == 0 ? v.x : axis == 1 ? v.y : v.z;
	ret[1] = axis == 0 ? v.y : v.x;
	ret[2] = axis == 2 ? v.y : v.z;
}

struct fold_plane fold_plane(struct vec3 normal, double weight)
{
	const double x = fabs(normal.x), y = fabs(normal.y), z = fabs(normal.z);
	struct fold_plane plane = {.axis = y > x ? 1 : 0};

	if (z > (x > y ? x : y))
		plane.axis = 2;
	turn_to(plane.axis, normal, plane.n);
	plane.inverse = 1 / plane.n[0];
	plane.half = BAND_CELLS * fabs(plane.inverse);
	plane.step = floor_int(plane.n[0] * 65536 + 0.5);
	for (int i = 0; i < BLOCK_SIDE; i++) {
		plane.high[i] = (int16_t)(i * plane.step >> 8);
		plane.low[i] = (int16_t)(i * plane.step & 255);
		plane.weight[i] = (int16_t)(weight * (WEIGHT_SCALE * 65536.0 / BAND_UNITS) + 0.5);
	}
	return plane;
}

/* Adds to the voxels first..last of one column in one block; `d` is the distance of voxel 0 in 1/65536 cell. All eight are
 * computed, without a branch, in loops that compilers turn into vectors of 16-bit numbers; what is not wanted weighs 0.
 * Inlined, it would be unrolled into single numbers. */
static __attribute__((noinline)) void column_add(accumulator *restrict at, const struct fold_plane *restrict plane,
                                                 int32_t d, int32_t first, int32_t last)
{
	static const int16_t from[2 * BLOCK_SIDE] = {0, 0, 0, 0, 0, 0, 0, 0, -1, -1, -1, -1, -1, -1, -1, -1};
	static const int16_t to[2 * BLOCK_SIDE] = {-1, -1, -1, -1, -1, -1, -1, -1, 0, 0, 0, 0, 0, 0, 0, 0};
	const int16_t *const not_before = from + BLOCK_SIDE - first, *const not_after = to + BLOCK_SIDE - 1 - last;
	const int16_t high = (int16_t)(((d + 128) >> 8) + BAND_UNITS), low = (int16_t)((d + 128) & 255);
	int16_t depth[BLOCK_SIDE], weight[BLOCK_SIDE]; /* depth: from the far end of the band */

	for (int i = 0; i < BLOCK_SIDE; i++) {
		int16_t carry = (int16_t)((int16_t)(low + plane->low[i]) >> 8);
		int16_t front = (int16_t)(high + plane->high[i] + carry), back = (int16_t)(2 * BAND_UNITS - front);
		int16_t left = front < back ? front : back;
		int16_t w = (int16_t)(left * plane->weight[i] >> 16);

		w = (int16_t)(w + (uint16_t)((uint16_t)(left * plane->weight[i]) >> 15)); /* rounds */
		weight[i] = (int16_t)((w > 1 ? w : 1) & not_before[i] & not_after[i]);
		depth[i] = front;
	}
	for (int i = 0; i < BLOCK_SIDE; i++)
		at[i] += (uint64_t)(uint32_t)(weight[i] * depth[i]) * (1 << WEIGHT_BITS) + (uint16_t)weight[i];
}

/* A full scratch is folded; what follows goes into the empty one. */
static struct scratch_block *scratch_make_room(struct fold *fold, int32_t x, int32_t y, int32_t z)
{
	struct scratch_block *b = scratch_touch(fold, x, y, z);

	if (!b && fold->used) {
		fold_apply(fold);
		b = scratch_touch(fold, x, y, z);
	}
	return b;
}

/* Where the band of a sample lies: in the column b, c of the other two axes, voxels first..last along the plane's. */
struct reach {
	int32_t b, c, first, last;
	int32_t d; /* distance of the first in 1/65536 cell */
};

/* The sample need not lie on a column: what counts is where the plane crosses the nearest one. */
static struct reach reach_of(const struct fold_plane *plane, const double p[3])
{
	const int32_t b = floor_int(p[1] + 0.5), c = floor_int(p[2] + 0.5);
	const double crossing = p[0] - (plane->n[1] * (b - p[1]) + plane->n[2] * (c - p[2])) * plane->inverse;
	const int32_t first = -floor_int(plane->half - crossing), last = floor_int(crossing + plane->half);

	return (struct reach){b, c, first, last, floor_int((first - crossing) * plane->n[0] * 65536 + 0.5)};
}

/* Inlined for each axis: what depends on it is then known to the compiler. */
static inline __attribute__((always_inline)) void reach_add(struct fold *fold, const struct fold_plane *plane, int axis,
                                                            const struct reach *r)
{
	const int32_t in = BLOCK_SIDE - 1, b = r->b >> BLOCK_SHIFT, c = r->c >> BLOCK_SHIFT;
	const int number = (r->c & in) * BLOCK_SIDE + (r->b & in);
	int32_t k = r->first & ~in, first = r->first & in, d = r->d - first * plane->step;

	for (; k <= r->last; k += BLOCK_SIDE, first = 0, d += plane->step * BLOCK_SIDE) {
		const int32_t a = k >> BLOCK_SHIFT;
		struct scratch_block *block = scratch_make_room(fold, axis == 0 ? a : b,
		                                                axis == 0   ? b
		                                                : axis == 1 ? a
		                                                            : c,
		                                                axis == 2 ? a : c);

		if (block && columns_reserve(fold))
			column_add(column_of(fold, block, axis, number)->at, plane, d, first,
			           r->last - k < in ? r->last - k : in);
	}
}

static void reaches_add(struct fold *fold, const struct fold_plane *plane, const struct reach *reach, int n)
{
	fold->stats.samples += (uint64_t)n;
	for (; n > 0; n--, reach++) {
		if (fold->samples == FOLD_SAMPLES_MAX)
			fold_apply(fold);
		fold->samples++;
		if (plane->axis == 0)
			reach_add(fold, plane, 0, reach);
		else if (plane->axis == 1)
			reach_add(fold, plane, 1, reach);
		else
			reach_add(fold, plane, 2, reach);
	}
}

void fold_sample(struct fold *fold, const struct fold_plane *plane, struct vec3 point)
{
	struct reach reach;
	double p[3];

	turn_to(plane->axis, point, p);
	reach = reach_of(plane, p);
	reaches_add(fold, plane, &reach, 1);
}

static double between(double a, double b, double s)
{
	return a + (b - a) * s;
}

/* All samples are first calculated and then added: a long chain of arithmetic without branches, then branches that wait
 * for nothing. */
void fold_patch(struct fold *fold, const struct fold_plane *plane, const struct vec3 corner[4], int across, int along)
{
	struct reach reach[FOLD_PATCH_SIDE * FOLD_PATCH_SIDE], *next = reach;
	double p[4][3], share[FOLD_PATCH_SIDE];

	for (int i = 0; i < 4; i++)
		turn_to(plane->axis, corner[i], p[i]);
	for (int i = 0; i < across; i++)
		share[i] = (i + 0.5) / across;
	for (int j = 0; j < along; j++) {
		double v = (j + 0.5) / along, left[3], right[3], point[3];

		for (int a = 0; a < 3; a++) {
			left[a] = between(p[0][a], p[2][a], v);
			right[a] = between(p[1][a], p[3][a], v);
		}
		for (int i = 0; i < across; i++) {
			for (int a = 0; a < 3; a++)
				point[a] = between(left[a], right[a], share[i]);
			*next++ = reach_of(plane, point);
		}
	}
	reaches_add(fold, plane, reach, across * along);
}

static int64_t divide_rounded(int64_t a, int64_t b) /* b > 0; halves away from zero */
{
	return a >= 0 ? (a + b / 2) / b : -((-a + b / 2) / b);
}

static void voxel_add(struct voxel *v, accumulator a)
{
	int64_t added = a & ((1 << WEIGHT_BITS) - 1), weight = v->weight + added;
	int64_t sum = v->sum + (int64_t)(a >> WEIGHT_BITS) - BAND_UNITS * added;

	if (weight > WEIGHT_MAX) {
		sum = divide_rounded(sum * WEIGHT_MAX, weight);
		weight = WEIGHT_MAX;
	}
	v->sum = (int32_t)sum;
	v->weight = (uint16_t)weight;
}

static void voxel_clear(struct voxel *v, uint32_t rays)
{
	int64_t taken = (int64_t)rays * FREE_WEIGHT, rest = v->weight > taken ? v->weight - taken : 0;

	if (v->sum >= 0)
		return;
	if (rest < WEIGHT_KNOWN)
		rest = 0;
	v->sum = rest ? (int32_t)divide_rounded(v->sum * rest, v->weight) : 0;
	v->weight = (uint16_t)rest;
}

/* A voxel hardly behind a surface is published as lying on it, and once on a side it takes more to change. Walls and floors
 * like to lie on the lattice's planes; there the noise of the mean would toss a coin for the side of every voxel, and the
 * mesh be a rubble of slivers (a simulated hall: 521,000 raw faces instead of 357,000, reduced by 74 instead of 92 %). */
static int published_mean(const struct voxel *v)
{
	int mean = (int)divide_rounded(v->sum, v->weight);
	int touching = TOUCHING;

	if (v->published != VOXEL_UNKNOWN)
		touching += v->published < 0 ? -TOUCHING_STICKS : TOUCHING_STICKS;
	return mean < 0 && mean >= -touching ? 0 : mean;
}

/* Is a known voxel's mean, without a division, so near to the published value that it is no news? False: perhaps it is.
 * VOXEL_UNKNOWN is far from every mean. On the far side a mean that touches would be published as 0. */
static bool is_no_news(const struct voxel *v)
{
	const int32_t weight = v->weight, apart = v->sum - v->published * weight, most = (PUBLISH_STEP - 1) * weight;
	const int32_t touching = -(TOUCHING - TOUCHING_STICKS + 1) * weight;

	return ((uint32_t)(apart + most) <= (uint32_t)(2 * most)) & ((v->published >= 0) | (v->sum <= touching)) &
	       (weight >= WEIGHT_KNOWN);
}

/* What is to be published of a voxel: the old value where there is no news. */
static int16_t published_after(const struct voxel *v)
{
	int mean;

	if (v->weight < WEIGHT_KNOWN)
		return VOXEL_UNKNOWN;
	mean = published_mean(v);
	return v->published != VOXEL_UNKNOWN && abs(mean - v->published) < PUBLISH_STEP ? v->published : (int16_t)mean;
}

/* A column's voxels are first, first + stride, ... */
static int first_of(int axis, int number)
{
	const int in = BLOCK_SIDE - 1;

	return axis == 0 ? number * BLOCK_SIDE : axis == 1 ? (number & ~in) * BLOCK_SIDE + (number & in) : number;
}

static int stride_of(int axis)
{
	return 1 << BLOCK_SHIFT * axis;
}

/* The column of a voxel and its place there. */
static int number_of(int axis, int voxel, int *ret_place)
{
	const int in = BLOCK_SIDE - 1, x = voxel & in, y = voxel >> BLOCK_SHIFT & in, z = voxel >> 2 * BLOCK_SHIFT;

	*ret_place = axis == 0 ? x : axis == 1 ? y : z;
	return (axis == 2 ? y : z) * BLOCK_SIDE + (axis == 0 ? y : x);
}

/* What a voxel is after it got its share; `before` is what its sum was. Most get no news. */
static inline void voxel_settle(struct fold *fold, struct block *block, int i, int32_t before,
                                uint64_t changed[BLOCK_SIDE])
{
	const struct voxel *v = &block->voxel[i];
	const uint64_t bit = UINT64_C(1) << (i & 63);
	int16_t value;

	if ((before ^ v->sum) < 0)
		block->negative[i >> 6] ^= bit;
	if (is_no_news(v))
		return;
	value = published_after(v);
	if (value == v->published)
		return;
	block_publish(block, i, value);
	changed[i >> 6] |= bit;
	fold->stats.cleared += value == VOXEL_UNKNOWN;
}

/* Adds the columns of one axis to those of another, since a voxel is folded once. */
static void columns_move(struct fold *fold, struct scratch_block *from, int axis, int to)
{
	for (uint64_t bits = from->seen[axis]; bits; bits &= bits - 1) {
		int number = __builtin_ctzll(bits), voxel = first_of(axis, number), place;
		accumulator *at = from->column[axis][number]->at;

		for (int i = 0; i < BLOCK_SIDE; i++, voxel += stride_of(axis)) {
			if (!at[i])
				continue;
			number = number_of(to, voxel, &place);
			column_of(fold, from, to, number)->at[place] += at[i];
		}
	}
}

static void columns_drop(struct scratch_block *from, int axis)
{
	for (uint64_t bits = from->seen[axis]; bits; bits &= bits - 1)
		memset(from->column[axis][__builtin_ctzll(bits)], 0, sizeof(struct column));
	from->seen[axis] = 0;
}

/* Gathers all columns of a block in one axis, which it says. Few blocks of a row see more than one. Without memory those of
 * the other axes are lost. */
static int columns_gather(struct fold *fold, struct scratch_block *from)
{
	int to = from->seen[2] ? 2 : from->seen[1] ? 1 : 0;

	for (int axis = 0; axis < to; axis++) {
		if (from->seen[axis] && columns_reserve(fold))
			columns_move(fold, from, axis, to);
		columns_drop(from, axis);
	}
	return to;
}

/* Folds the voxels that rays passed and no surface came to. */
static void passed_fold(struct fold *fold, struct block *block, struct scratch_block *from, int axis,
                        uint64_t changed[BLOCK_SIDE])
{
	for (int z = 0; z < BLOCK_SIDE; z++) {
		for (uint64_t bits = from->passed[z]; bits; bits &= bits - 1) {
			int voxel = z * 64 + __builtin_ctzll(bits), place, number = number_of(axis, voxel, &place);

			if (!(from->seen[axis] >> number & 1) || !from->column[axis][number]->at[place]) {
				int32_t before = block->voxel[voxel].sum;

				voxel_clear(&block->voxel[voxel], from->rays[voxel]);
				voxel_settle(fold, block, voxel, before, changed);
			}
			from->rays[voxel] = 0;
		}
		from->passed[z] = 0;
	}
}

struct share {
	accumulator sum;
	uint32_t voxel;
};

/* The voxels that got something, and empties the columns of an axis. */
static int shares_take(struct scratch_block *from, int axis, struct share ret[BLOCK_VOXELS])
{
	const int stride = stride_of(axis);
	int n = 0;

	for (uint64_t bits = from->seen[axis]; bits; bits &= bits - 1) {
		int number = __builtin_ctzll(bits), first = first_of(axis, number);
		struct column *column = from->column[axis][number];

		for (int i = 0; i < BLOCK_SIDE; i++) {
			ret[n] = (struct share){column->at[i], (uint32_t)(first + i * stride)};
			n += column->at[i] != 0;
		}
		memset(column, 0, sizeof(*column));
	}
	from->seen[axis] = 0;
	return n;
}

/* Folds the voxels of all columns along an axis. Voxels are far apart: they are asked for some time before. */
static void columns_fold(struct fold *fold, struct block *block, struct scratch_block *from, int axis,
                         uint64_t changed[BLOCK_SIDE])
{
	struct share share[BLOCK_VOXELS + 1];
	const int n = shares_take(from, axis, share), ahead = 12;

	for (int i = 0; i < n && i < ahead; i++)
		__builtin_prefetch(&block->voxel[share[i].voxel], 1);
	for (int i = 0; i < n; i++) {
		__builtin_prefetch(&block->voxel[share[i + ahead < n ? i + ahead : i].voxel], 1);
		struct voxel *v = &block->voxel[share[i].voxel];
		int32_t before = v->sum;

		voxel_add(v, share[i].sum);
		voxel_settle(fold, block, (int)share[i].voxel, before, changed);
	}
}

/* Projects the bits of a block onto its layers along x, y and z. */
static void layers_of(const uint64_t bits[BLOCK_SIDE], uint8_t ret_layers[3])
{
	uint64_t all = 0;

	memset(ret_layers, 0, 3);
	for (int z = 0; z < BLOCK_SIDE; z++) {
		all |= bits[z];
		ret_layers[2] |= (uint8_t)((bits[z] != 0) << z);
	}
	for (int y = 0; y < BLOCK_SIDE; y++) {
		uint8_t row = (uint8_t)(all >> 8 * y);

		ret_layers[0] |= row;
		ret_layers[1] |= (uint8_t)((row != 0) << y);
	}
}

/* Folds a block and empties its accumulators. */
static void block_fold(struct fold *fold, struct block *block, struct scratch_block *from)
{
	uint64_t changed[BLOCK_SIDE] = {0};
	uint8_t layers[3];
	const int axis = columns_gather(fold, from);

	passed_fold(fold, block, from, axis, changed);
	columns_fold(fold, block, from, axis, changed);
	layers_of(block->negative, block->layers);
	hollow_mark(fold, block);
	layers_of(changed, layers);
	grid_mark_changed(fold->grid, block->key, layers);
}

/* The grid refused the block: what was for it is lost. */
static void block_drop(struct scratch_block *from)
{
	for (int axis = 0; axis < 3; axis++)
		columns_drop(from, axis);
	memset(from->passed, 0, sizeof(from->passed));
	memset(from->rays, 0, sizeof(from->rays));
}

static struct block **found_at(struct fold *fold, int32_t x, int32_t y, int32_t z)
{
	return &fold->found[(x & 7) | (y & 7) << 3 | (z & 7) << 6];
}

struct block *fold_find(struct fold *fold, int32_t x, int32_t y, int32_t z)
{
	struct block **found = found_at(fold, x, y, z), *block = *found;

	if (block && block->key.x == x && block->key.y == y && block->key.z == z)
		return block;
	block = grid_find(fold->grid, (struct block_key){x, y, z});
	if (block)
		*found = block;
	return block;
}

static struct block *block_touch(struct fold *fold, struct block_key key)
{
	struct block *block = fold_find(fold, key.x, key.y, key.z);

	return block ? block : grid_touch(fold->grid, key);
}

/* Orders like patch_key_compare; a block's coordinates fit 21 bits. */
static uint64_t turn_key(struct block_key key)
{
	const int32_t middle = 1 << 20;

	return (uint64_t)(key.z + middle) << 42 | (uint64_t)(key.y + middle) << 21 | (uint64_t)(key.x + middle);
}

/* Sorts by merging into the second half of fold->turn and back: packed keys need no call back for every comparison. */
static const struct turn *turns_sort(struct fold *fold)
{
	const uint32_t n = fold->used;
	struct turn *from = fold->turn, *to = fold->turn + FOLD_BLOCKS_MAX, *swap;

	for (uint32_t i = 0; i < n; i++)
		from[i] = (struct turn){turn_key(fold->block[i]->key), fold->block[i]};
	for (uint32_t width = 1; width < n; width *= 2, swap = from, from = to, to = swap)
		for (uint32_t begin = 0; begin < n; begin += 2 * width) {
			uint32_t i = begin, i_end = n - i < width ? n : i + width;
			uint32_t j = i_end, j_end = n - j < width ? n : j + width, k = begin;

			while (i < i_end && j < j_end) {
				bool later = from[j].key < from[i].key;

				to[k++] = from[later ? j : i];
				i += !later;
				j += later;
			}
			while (i < i_end)
				to[k++] = from[i++];
			while (j < j_end)
				to[k++] = from[j++];
		}
	return from;
}

void fold_apply(struct fold *fold)
{
	const struct turn *turn;

	rays_walk(fold);
	for (uint32_t i = 0; i < fold->used; i++)
		fold->slot[fold->block[i]->slot] = 0;
	turn = turns_sort(fold);
	for (uint32_t i = 0; i < fold->used; i++) {
		struct block *block = block_touch(fold, turn[i].block->key);

		if (block)
			block_fold(fold, block, turn[i].block);
		else
			block_drop(turn[i].block);
	}
	fold->used = 0;
	fold->samples = 0;
	fold->slabs = 0;
	fold->column = fold->column_end = NULL;
	memset(fold->recent, 0, sizeof(fold->recent));
}

void fold_stats(const struct fold *fold, struct fold_stats *ret)
{
	*ret = fold->stats;
}

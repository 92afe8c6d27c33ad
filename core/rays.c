/* Free space: what a ray passed through is no longer believed to be inside of something.
 *
 * A ray takes weight only from voxels with a negative sum that got no surface in the same row, and it makes no unknown
 * voxel known: taking from any voxel cost completeness in a trial, free-as-known tripled the ghosts. So only blocks
 * that exist and have a negative voxel matter, and a ray steps from block to block, looking into those few voxel by
 * voxel (Amanatides and Woo, A Fast Voxel Traversal Algorithm, 1987, on both levels). Neighbouring beams that end in
 * one voxel took nearly the same way: they are walked once and counted. */
#include "core/scratch.h"

#include <stdlib.h>
#include <string.h>

/* A walk through cells of side `size` along origin + t * direction, t in [0, 1]. */
struct line {
	double origin[3], direction[3];
	double inverse[3]; /* 1 / direction; where that is 0, a number that no t reaches */
};

struct walk {
	int32_t cell[3];
	int32_t step[3];
	double next[3]; /* t where the line leaves the cell through that axis */
	double delta[3];
};

#define NEVER 1e30

static void walk_axis_begin(struct walk *w, const struct line *l, int a, int32_t cell, double size)
{
	bool up = l->direction[a] > 0;

	w->cell[a] = cell;
	w->step[a] = up ? 1 : -1;
	w->delta[a] = size * fabs(l->inverse[a]);
	w->next[a] = l->direction[a] == 0 ? NEVER : ((cell + up) * size - l->origin[a]) * l->inverse[a];
}

static int walk_axis(const struct walk *w)
{
	int a = w->next[1] < w->next[0] ? 1 : 0;

	return w->next[2] < w->next[a] ? 2 : a;
}

static int32_t clamp(int32_t v, int32_t low, int32_t high)
{
	return v < low ? low : v > high ? high : v;
}

/* Where the line enters (t0) and leaves (t1) a block, in its voxels; false where no negative voxel lies between. */
static bool block_enter(const struct block *block, const struct line *l, double t0, double t1, int32_t ret_low[3],
                        struct walk *ret)
{
	const int32_t key[3] = {block->key.x, block->key.y, block->key.z};
	int32_t from[3];

	for (int a = 0; a < 3; a++) {
		int32_t low = key[a] * BLOCK_SIDE, to;

		/* a point may lie a rounding error outside of the block it enters */
		from[a] = clamp(floor_int(l->origin[a] + t0 * l->direction[a]) - low, 0, BLOCK_SIDE - 1);
		to = clamp(floor_int(l->origin[a] + t1 * l->direction[a]) - low, 0, BLOCK_SIDE - 1);
		int32_t first = from[a] < to ? from[a] : to, last = from[a] < to ? to : from[a];

		if (!(block->layers[a] >> first & ((2 << (last - first)) - 1)))
			return false;
		ret_low[a] = low;
	}
	for (int a = 0; a < 3; a++)
		walk_axis_begin(ret, l, a, ret_low[a] + from[a], 1);
	return true;
}

static void block_pass(struct fold *fold, const struct block *block, const struct line *l, double t0, double t1,
                       uint32_t count)
{
	struct scratch_block *scratch = NULL;
	int32_t low[3];
	struct walk w;
	int axis;

	if (!block_enter(block, l, t0, t1, low, &w))
		return;
	do {
		int z = w.cell[2] - low[2], bit = (w.cell[1] - low[1]) * BLOCK_SIDE + (w.cell[0] - low[0]);

		if (block->negative[z] >> bit & 1) {
			if (!scratch)
				scratch = scratch_touch(fold, block->key.x, block->key.y, block->key.z);
			if (!scratch)
				return;
			scratch->rays[z * 64 + bit] += count;
			scratch->passed[z] |= UINT64_C(1) << bit;
		}
		axis = walk_axis(&w);
		if (w.next[axis] > 1)
			return;
		w.next[axis] += w.delta[axis];
		w.cell[axis] += w.step[axis];
	} while ((uint32_t)(w.cell[axis] - low[axis]) < BLOCK_SIDE);
}

/* The blocks of a line, without a branch but the one for a block that may matter: which axis comes next is a matter of chance
 * that no processor guesses. Adding nothing leaves a number as it is, so every crossing is the sum of the same steps. */
static void blocks_walk(struct fold *fold, const struct line *l, const struct walk *begin, uint32_t count)
{
	const double dx[2] = {0, begin->delta[0]}, dy[2] = {0, begin->delta[1]}, dz[2] = {0, begin->delta[2]};
	double nx = begin->next[0], ny = begin->next[1], nz = begin->next[2], t = 0, out;
	int32_t x = begin->cell[0], y = begin->cell[1], z = begin->cell[2];

	for (; t <= 1; t = out) {
		const int y_first = ny < nx;
		const double first = ny < nx ? ny : nx;
		const int to_z = nz < first, to_y = y_first & !to_z, to_x = !(y_first | to_z);

		out = nz < first ? nz : first;
		if (*hollow_word(fold, y, z) >> (x & (HOLLOW_SIDE - 1)) & 1) {
			const struct block *block = fold_find(fold, x, y, z);

			if (block && block->layers[0])
				block_pass(fold, block, l, t, out < 1 ? out : 1, count);
		}
		nx += dx[to_x];
		ny += dy[to_y];
		nz += dz[to_z];
		x += begin->step[0] & -to_x;
		y += begin->step[1] & -to_y;
		z += begin->step[2] & -to_z;
	}
}

static void ray_walk(struct fold *fold, const struct ray *ray)
{
	/* voxels are the cells about corners: half a cell on, floor finds the nearest corner */
	struct line l = {
	    .origin = {ray->origin.x + 0.5, ray->origin.y + 0.5, ray->origin.z + 0.5},
	    .direction = {ray->end.x - ray->origin.x, ray->end.y - ray->origin.y, ray->end.z - ray->origin.z}};
	struct walk w;

	for (int a = 0; a < 3; a++) {
		l.inverse[a] = l.direction[a] == 0 ? NEVER : 1 / l.direction[a];
		walk_axis_begin(&w, &l, a, floor_int(l.origin[a]) >> BLOCK_SHIFT, BLOCK_SIDE);
	}
	blocks_walk(fold, &l, &w, ray->count);
}

void rays_walk(struct fold *fold)
{
	for (uint32_t i = 0; i < fold->rays; i++)
		ray_walk(fold, &fold->ray[i]);
	if (fold->rays)
		memset(fold->ray_slot, 0, 2 * (size_t)fold->rays_cap * sizeof(*fold->ray_slot));
	fold->stats.rays += fold->rays;
	fold->rays = 0;
}

static uint32_t *ray_slot(const struct fold *fold, int32_t x, int32_t y, int32_t z)
{
	uint32_t mask = 2 * fold->rays_cap - 1, i;

	for (i = hash3(x, y, z) & mask; fold->ray_slot[i]; i = (i + 1) & mask) {
		const struct ray *ray = &fold->ray[fold->ray_slot[i] - 1];

		if (ray->x == x && ray->y == y && ray->z == z)
			break;
	}
	return &fold->ray_slot[i];
}

static bool rays_grow(struct fold *fold)
{
	size_t cap = 2 * (size_t)fold->rays_cap;
	struct ray *ray = cap <= FOLD_RAYS_MAX ? realloc(fold->ray, cap * sizeof(*ray)) : NULL;
	uint32_t *slot;

	if (!ray)
		return false;
	fold->ray = ray;
	slot = calloc(2 * cap, sizeof(*slot));
	if (!slot)
		return false;
	free(fold->ray_slot);
	fold->ray_slot = slot;
	fold->rays_cap = (uint32_t)cap;
	for (uint32_t i = 0; i < fold->rays; i++)
		*ray_slot(fold, ray[i].x, ray[i].y, ray[i].z) = i + 1;
	return true;
}

void fold_ray(struct fold *fold, struct vec3 origin, struct vec3 end)
{
	struct vec3 d = vec3_sub(end, origin);
	struct ray ray = {.origin = origin, .end = end, .count = 1};
	uint32_t *slot;

	if (!(vec3_dot(d, d) <= RAY_LENGTH_MAX * RAY_LENGTH_MAX))
		return;
	ray.x = floor_int(end.x + 0.5);
	ray.y = floor_int(end.y + 0.5);
	ray.z = floor_int(end.z + 0.5);
	slot = ray_slot(fold, ray.x, ray.y, ray.z);
	if (*slot) {
		fold->ray[*slot - 1].count++;
		return;
	}
	if (fold->rays == fold->rays_cap) {
		if (!rays_grow(fold))
			return;
		slot = ray_slot(fold, ray.x, ray.y, ray.z);
	}
	fold->ray[fold->rays] = ray;
	*slot = ++fold->rays;
}

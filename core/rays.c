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

/* A walk through cells of a side of 1 along origin + t * direction. */
struct walk {
	int32_t cell[3];
	int32_t step[3];
	double next[3]; /* t where the ray leaves the cell through that axis */
	double delta[3];
};

static struct walk walk_begin(const double origin[3], const double direction[3], double t, const int32_t low[3],
                              const int32_t high[3])
{
	struct walk w;

	for (int a = 0; a < 3; a++) {
		int32_t c = floor_int(origin[a] + t * direction[a]);

		/* the point may lie a rounding error outside of the box it enters */
		c = c < low[a] ? low[a] : c > high[a] ? high[a] : c;
		w.cell[a] = c;
		w.step[a] = direction[a] > 0 ? 1 : -1;
		if (direction[a] == 0) {
			w.next[a] = w.delta[a] = 1e30;
			continue;
		}
		w.delta[a] = 1 / fabs(direction[a]);
		w.next[a] = (c + (direction[a] > 0) - origin[a]) / direction[a];
	}
	return w;
}

static int walk_axis(const struct walk *w)
{
	int a = w->next[1] < w->next[0] ? 1 : 0;

	return w->next[2] < w->next[a] ? 2 : a;
}

static void walk_step(struct walk *w, int axis)
{
	w->cell[axis] += w->step[axis];
	w->next[axis] += w->delta[axis];
}

/* From t to the end of the ray or of the block. */
static void block_pass(struct fold *fold, const struct block *block, const double origin[3], const double direction[3],
                       double t, uint32_t count)
{
	const int32_t low[3] = {block->key.x * BLOCK_SIDE, block->key.y * BLOCK_SIDE, block->key.z * BLOCK_SIDE};
	const int32_t high[3] = {low[0] + BLOCK_SIDE - 1, low[1] + BLOCK_SIDE - 1, low[2] + BLOCK_SIDE - 1};
	struct walk w = walk_begin(origin, direction, t, low, high);
	struct scratch_block *scratch = NULL;

	for (;;) {
		int i = ((w.cell[2] - low[2]) * BLOCK_SIDE + (w.cell[1] - low[1])) * BLOCK_SIDE + (w.cell[0] - low[0]);
		int axis;

		if (block->voxel[i].sum < 0) {
			if (!scratch)
				scratch = scratch_touch(fold, block->key.x, block->key.y, block->key.z);
			if (!scratch)
				return;
			scratch->at[i].rays += count;
			scratch->passed[i >> 6] |= UINT64_C(1) << (i & 63);
		}
		axis = walk_axis(&w);
		if (w.next[axis] > 1)
			return;
		walk_step(&w, axis);
		if (w.cell[axis] < low[axis] || w.cell[axis] > high[axis])
			return;
	}
}

static void ray_walk(struct fold *fold, const struct ray *ray)
{
	static const int32_t low[3] = {INT32_MIN, INT32_MIN, INT32_MIN}, high[3] = {INT32_MAX, INT32_MAX, INT32_MAX};
	/* voxels are the cells about corners: half a cell on, floor finds the nearest corner */
	const double origin[3] = {ray->origin.x + 0.5, ray->origin.y + 0.5, ray->origin.z + 0.5};
	const double direction[3] = {ray->end.x - ray->origin.x, ray->end.y - ray->origin.y,
	                             ray->end.z - ray->origin.z};
	const double per_block = 1.0 / BLOCK_SIDE;
	const double coarse_origin[3] = {origin[0] * per_block, origin[1] * per_block, origin[2] * per_block};
	const double coarse[3] = {direction[0] * per_block, direction[1] * per_block, direction[2] * per_block};
	struct walk w = walk_begin(coarse_origin, coarse, 0, low, high);
	double t = 0;

	while (t <= 1) {
		const struct block *block = grid_find(fold->grid, (struct block_key){w.cell[0], w.cell[1], w.cell[2]});
		int axis = walk_axis(&w);

		if (block && block->negatives)
			block_pass(fold, block, origin, direction, t, ray->count);
		t = w.next[axis];
		walk_step(&w, axis);
	}
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

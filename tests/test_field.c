/* Law L2: the voxels are a function of the sequence of rows alone; and the field is where the surface is. */
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

#include "core/field.h"
#include "core/fold.h"
#include "core/scratch.h"
#include "core/trig.h"
#include "tests/scarce.h"

#define BEAMS  121
#define ROWS   60
#define CELL   0.05
#define MEMORY ((size_t)64 << 20)
#define GOLDEN 0x6aa18d6e83b1c2a2u

struct rig {
	struct grid *grid;
	struct field *field;
	uint64_t rows;
};

static struct rig rig_begin(size_t memory, int lookahead)
{
	struct rig rig = {.grid = grid_create(memory)};

	rig.field = field_create(&(struct field_params){CELL, lookahead}, rig.grid);
	assert_non_null(rig.field);
	return rig;
}

static void rig_end(struct rig *rig)
{
	field_destroy(rig->field);
	grid_destroy(rig->grid);
}

/* FNV-1a of one block; blocks are added up, so their order does not count. */
static void block_hash(void *ctx, struct block *block)
{
	const int32_t key[3] = {block->key.x, block->key.y, block->key.z};
	const unsigned char *bytes[2] = {(const unsigned char *)key, (const unsigned char *)block->voxel};
	const size_t len[2] = {sizeof(key), sizeof(block->voxel)};
	uint64_t h = 14695981039346656037u;

	for (int k = 0; k < 2; k++)
		for (size_t i = 0; i < len[k]; i++)
			h = (h ^ bytes[k][i]) * 1099511628211u;
	*(uint64_t *)ctx += h;
}

static uint64_t voxels_hash(const struct rig *rig)
{
	uint64_t h = 0;

	grid_each(rig->grid, block_hash, &h);
	return h;
}

static void block_known(void *ctx, struct block *block)
{
	for (int i = 0; i < BLOCK_VOXELS; i++) {
		const int16_t value = block->voxel[i].published;

		*(int *)ctx += value != VOXEL_UNKNOWN;
		assert_int_equal(block->known[i >> 6] >> (i & 63) & 1, value != VOXEL_UNKNOWN);
		assert_int_equal(block->inside[i >> 6] >> (i & 63) & 1, value != VOXEL_UNKNOWN && value < 0);
	}
}

static int known_voxels(const struct rig *rig)
{
	int n = 0;

	grid_each(rig->grid, block_known, &n);
	return n;
}

/* Scenes: how far a beam goes. `wall_x` metres ahead; a box of `box` metres before it, or none. */
struct scene {
	double wall_x, box_x, noise_m;
	uint32_t seed;
};

static double scene_range(struct scene *scene, struct vec3 d)
{
	double r = d.x > 0.05 ? scene->wall_x / d.x : 1e9;

	if (scene->box_x > 0 && d.x > 0) {
		double b = scene->box_x / d.x;

		if (fabs(b * d.y) < 0.3 && fabs(b * d.z) < 0.3)
			r = b;
	}
	scene->seed = scene->seed * 1664525u + 1013904223u;
	return r + scene->noise_m * ((scene->seed >> 8) / 8388608.0 - 1);
}

static struct row *scene_row(struct scene *scene, struct vec3 origin, int r)
{
	struct row *row = row_create(BEAMS);
	struct transform tilt = transform_tilt((r - ROWS / 2) * 0.5 * TRIG_DEG);

	row->step_rad = 0.5 * TRIG_DEG;
	row->first_rad = -(BEAMS / 2) * row->step_rad;
	row->starts_sweep = r == 0;
	for (int k = 0; k < BEAMS; k++) {
		double bearing = row->first_rad + k * row->step_rad;
		struct vec3 d = transform_direction(&tilt, (struct vec3){trig_cos(bearing), trig_sin(bearing), 0});
		double range = scene_range(scene, d);

		row->beam[k] = (struct row_beam){.origin = origin,
		                                 .point = vec3_add(origin, vec3_scale(d, range)),
		                                 .range_m = (float)range,
		                                 .state = range < 30 ? BEAM_OK : BEAM_NO_ECHO};
	}
	return row;
}

static int rig_sweep(struct rig *rig, struct scene *scene, struct vec3 origin)
{
	int rows = 0;

	for (int r = 0; r < ROWS; r++) {
		struct row *row = scene_row(scene, origin, r);

		row->number = rig->rows++;
		rows += field_row(rig->field, row);
	}
	return rows;
}

static size_t dirty_of(struct rig *rig)
{
	const struct patch_key *keys;

	return grid_take_dirty(rig->grid, &keys);
}

/* Published values against the true distance to the wall, away from its rim. */
static void a_plane_is_where_it_is(void **state)
{
	const struct vec3 origins[3] = {{0, 0, 0}, {-7.013, -3.37, -11.9}, {103.33, -250.1, 2.2}};

	(void)state;
	for (int o = 0; o < 3; o++) {
		struct rig rig = rig_begin(MEMORY, 2);
		struct scene scene = {.wall_x = 2.013};
		double wall = (origins[o].x + scene.wall_x) / CELL;
		int worst = 0, checked = 0;

		rig_sweep(&rig, &scene, origins[o]);
		field_flush(rig.field);
		for (int32_t j = -15; j <= 15; j++)
			for (int32_t k = -5; k <= 5; k++)
				for (int32_t i = (int32_t)ceil(wall) - 3; i < wall + 3; i++) {
					int32_t y = j + (int32_t)floor(origins[o].y / CELL);
					int32_t z = k + (int32_t)floor(origins[o].z / CELL);
					int16_t value = grid_published(rig.grid, i, y, z);
					int want = (int)rint(256 * (wall - i));

					assert_int_not_equal(value, VOXEL_UNKNOWN);
					worst = abs(value - want) > worst ? abs(value - want) : worst;
					checked++;
				}
		assert_true(checked > 1500);
		assert_true(worst <= 4);
		rig_end(&rig);
	}
}

/* Noise must not toss a coin for the side of every voxel of a wall that lies on the lattice's plane. */
static void a_wall_on_the_lattice_has_its_voxels_on_one_side(void **state)
{
	struct rig rig = rig_begin(MEMORY, 2);
	struct scene scene = {.wall_x = 2.0, .noise_m = 0.01, .seed = 11};
	int inside = 0, all = 0;

	(void)state;
	for (int pass = 0; pass < 2; pass++)
		rig_sweep(&rig, &scene, (struct vec3){0});
	field_flush(rig.field);
	for (int32_t j = -15; j <= 15; j++)
		for (int32_t k = -6; k <= 6; k++, all++) {
			int16_t value = grid_published(rig.grid, 40, j, k);

			assert_int_not_equal(value, VOXEL_UNKNOWN);
			inside += value < 0;
		}
	printf("note: %d of %d voxels of a noisy wall on the lattice are inside\n", inside, all);
	assert_true(inside * 50 < all);
	rig_end(&rig);
}

/* Samples of many planes, in two orders. */
static void a_fold_does_not_know_the_order_of_contributions(void **state)
{
	enum { N = 5000 };
	uint64_t hash[2];

	(void)state;
	for (int reversed = 0; reversed < 2; reversed++) {
		struct rig rig = {.grid = grid_create(MEMORY)};
		struct fold *fold = fold_create(rig.grid);

		for (int n = 0; n < N; n++) {
			uint32_t s = (uint32_t)(reversed ? N - 1 - n : n) * 2654435761u;
			double a = (s >> 8 & 1023) * 0.01, b = (s >> 18) * 0.001;
			struct vec3 normal = {trig_cos(a) * trig_cos(b), trig_sin(a) * trig_cos(b), trig_sin(b)};
			struct fold_plane plane = fold_plane(normal, 1 + (s & 31));

			fold_sample(fold, &plane,
			            (struct vec3){(s >> 4 & 255) * 0.2 - 25, (s >> 12 & 255) * 0.1, (s >> 20) * 0.01});
		}
		fold_apply(fold);
		hash[reversed] = voxels_hash(&rig);
		fold_destroy(fold);
		grid_destroy(rig.grid);
	}
	assert_true(hash[0] == hash[1]);
}

static void rays_of_one_row_that_end_together_are_one_with_their_count(void **state)
{
	struct voxel after[2];

	(void)state;
	for (int together = 0; together < 2; together++) {
		struct grid *grid = grid_create(MEMORY);
		struct fold *fold = fold_create(grid);
		struct fold_plane plane = fold_plane((struct vec3){-1, 0, 0}, 32);
		struct fold_stats stats;

		for (int n = 0; n < 20; n++)
			fold_sample(fold, &plane, (struct vec3){10, 5, 5});
		fold_apply(fold);
		for (int n = 0; n < 5; n++)
			fold_ray(fold, (struct vec3){-30, 5, 5}, (struct vec3){30 + (together ? 0 : n), 5, 5});
		fold_apply(fold);
		fold_stats(fold, &stats);
		assert_int_equal(stats.rays, together ? 1 : 5);
		after[together] = grid_find(grid, (struct block_key){1, 0, 0})->voxel[(5 * 8 + 5) * 8 + 3];
		assert_int_equal(grid_find(grid, (struct block_key){1, 0, 0})->voxel[(5 * 8 + 5) * 8 + 0].weight,
		                 20 * 43); /* two cells before: a third of 128, and no ray takes from it */
		fold_destroy(fold);
		grid_destroy(grid);
	}
	assert_memory_equal(&after[0], &after[1], sizeof(after[0]));
	assert_int_equal(after[0].weight, 20 * 85 - 5 * FREE_WEIGHT); /* one cell behind: two thirds, less the rays */
}

static void at_the_cap_sum_and_weight_shrink_together(void **state)
{
	struct grid *grid = grid_create(MEMORY);
	struct fold *fold = fold_create(grid);
	const struct fold_plane plane = fold_plane((struct vec3){0, 0, 1}, 32);
	const struct voxel *v;
	int16_t first = 0;

	(void)state;
	for (int row = 0; row < 60; row++) {
		for (int n = 0; n < 10; n++)
			fold_sample(fold, &plane, (struct vec3){0, 0, 0.3});
		fold_apply(fold);
		v = &grid_find(grid, (struct block_key){0, 0, 0})->voxel[0];
		first = row == 0 ? v->published : first;
		assert_true(v->weight <= WEIGHT_MAX);
		assert_true(abs((int)rint((double)v->sum / v->weight) - first) <= 1);
	}
	assert_int_equal(v->weight, WEIGHT_MAX);
	assert_int_equal(first, -77); /* 0.3 cell below the surface */
	fold_destroy(fold);
	grid_destroy(grid);
}

/* Far more contributions than one word of accumulators holds: the fold is made in parts, nothing wraps. */
static void a_crowd_of_points_in_one_place_does_not_overflow(void **state)
{
	struct rig rig = rig_begin(MEMORY, 2);
	const struct voxel *v;

	(void)state;
	for (int n = 0; n < 400000; n++)
		field_point(rig.field, (struct vec3){-1, 0, 0}, (struct vec3){0.5, 0.02, 0.02});
	field_fold_points(rig.field);
	v = &grid_find(rig.grid, (struct block_key){1, 0, 0})->voxel[2 + 0];
	assert_int_equal(v->weight, WEIGHT_MAX);
	assert_int_equal(v->published, 0);
	assert_int_equal(grid_published(rig.grid, 9, 0, 0), 256);
	assert_int_equal(grid_published(rig.grid, 11, 0, 0), -256);
	rig_end(&rig);
}

static void weights_add(void *ctx, struct block *block)
{
	for (int i = 0; i < BLOCK_VOXELS; i++)
		*(uint64_t *)ctx += block->voxel[i].weight;
}

/* Bands that reach over a block's border, in more blocks than there is scratch for. */
static void a_full_scratch_is_folded_and_nothing_is_lost(void **state)
{
	enum { N = 3 * FOLD_BLOCKS_MAX / 4 };
	struct rig rig = {.grid = grid_create(MEMORY)};
	struct fold *fold = fold_create(rig.grid);
	struct fold_plane plane = fold_plane((struct vec3){0, 1, 0}, 32);
	uint64_t one = 0, all = 0;
	struct grid_stats stats;

	(void)state;
	fold_sample(fold, &plane, (struct vec3){4, 7.5, 4});
	fold_apply(fold);
	grid_each(rig.grid, weights_add, &one);
	for (int n = 1; n < N; n++)
		fold_sample(fold, &plane, (struct vec3){4 + 16 * (n % 64), 7.5, 4 + 16 * (n / 64)});
	fold_apply(fold);
	grid_each(rig.grid, weights_add, &all);
	grid_stats(rig.grid, &stats);
	assert_int_equal(stats.blocks, 2 * N);
	assert_true(one > 0);
	assert_int_equal(all, N * one);
	fold_destroy(fold);
	grid_destroy(rig.grid);
}

/* A block's columns along several axes are gathered in one; where there is no memory for that, they are lost, and none of them
 * is left for a later row. */
static void without_memory_no_column_is_left_for_later_rows(void **state)
{
	struct rig rig = {.grid = NULL};
	struct fold *fold;
	struct fold_plane flat = fold_plane((struct vec3){0, 0, 1}, 32), wall = fold_plane((struct vec3){1, 0, 0}, 32);
	uint64_t weight[3] = {0};

	(void)state;
	if (!SCARCE_WORKS)
		skip();
	rig.grid = grid_create(MEMORY);
	fold = fold_create(rig.grid);
	for (int n = 0; n < 5 * 5; n++) /* all the blocks */
		fold_sample(fold, &flat, (struct vec3){8 * (n % 5), 8 * (n / 5), 3.5});
	fold_apply(fold);
	fold_sample(fold, &wall, (struct vec3){3.5, 4, 4});
	fold_sample(fold, &flat, (struct vec3){2, 2, 3.5});
	for (int n = 0; n < SLAB_COLUMNS - COLUMNS_AT_HAND - 1; n++) /* one more than leaves enough to gather */
		fold_sample(fold, &flat, (struct vec3){8 + n % 31, n / 31, 3.5});
	scarce_left = 0;
	fold_apply(fold);
	assert_int_equal(scarce_left, -1); /* it ran out */
	grid_each(rig.grid, weights_add, &weight[0]);
	for (int row = 1; row < 3; row++) {
		fold_sample(fold, &flat, (struct vec3){5, 5, 3.5});
		fold_apply(fold);
		grid_each(rig.grid, weights_add, &weight[row]);
	}
	assert_true(weight[1] > weight[0]);
	assert_int_equal(weight[1] - weight[0], weight[2] - weight[1]);
	fold_destroy(fold);
	grid_destroy(rig.grid);
}

/* Also where bands along several axes meet in one block. */
static void a_patch_is_the_sum_of_its_samples(void **state)
{
	const struct vec3 normal[3] = {{0.9, 0.3, -0.316}, {-0.2, -0.8, 0.566}, {0.577, 0.577, 0.578}};
	const struct vec3 corner[4] = {{-3, 2, 1}, {2.5, 3, 0.5}, {-2.7, -4, 2}, {3, -3.5, 5}};
	uint64_t hash[2];

	(void)state;
	for (int single = 0; single < 2; single++) {
		struct rig rig = {.grid = grid_create(MEMORY)};
		struct fold *fold = fold_create(rig.grid);

		for (int k = 0; k < 3; k++) {
			struct fold_plane plane = fold_plane(normal[k], 20);
			const int across = 7 + k, along = FOLD_PATCH_SIDE;

			if (!single)
				fold_patch(fold, &plane, corner, across, along);
			for (int i = 0; single && i < across * along; i++) {
				double v = (i / across + 0.5) / along;
				struct vec3 left = vec3_lerp(corner[0], corner[2], v);

				fold_sample(
				    fold, &plane,
				    vec3_lerp(left, vec3_lerp(corner[1], corner[3], v), (i % across + 0.5) / across));
			}
		}
		fold_apply(fold);
		hash[single] = voxels_hash(&rig);
		fold_destroy(fold);
		grid_destroy(rig.grid);
	}
	assert_true(hash[0] == hash[1]);
}

/* However the end of a sweep becomes known, its rows see the same neighbours. */
static void a_row_that_waited_gives_the_same_voxels(void **state)
{
	uint64_t hash[3];

	(void)state;
	for (int way = 0; way < 3; way++) {
		struct rig rig = rig_begin(MEMORY, 2);
		struct scene scene = {.wall_x = 2, .box_x = 1.3, .noise_m = 0.01, .seed = 5};
		int folded = 0;

		for (int r = 0; r < ROWS; r++) {
			struct row *row = scene_row(&scene, (struct vec3){0}, r);

			row->number = (uint64_t)r;
			row->ends_sweep = way == 1 && r == ROWS - 1;
			folded += field_row(rig.field, row);
		}
		assert_int_equal(folded, way == 1 ? ROWS : ROWS - 2);
		if (way == 0)
			folded += field_flush(rig.field);
		if (way == 2) { /* the next sweep's first row sees nothing at all */
			struct scene nothing = {.wall_x = 1e9};

			folded += field_row(rig.field, scene_row(&nothing, (struct vec3){0}, 0));
		}
		assert_int_equal(folded, ROWS);
		hash[way] = voxels_hash(&rig);
		rig_end(&rig);
	}
	assert_true(hash[0] == hash[1] && hash[0] == hash[2]);
}

static void lookahead_says_how_many_rows_wait(void **state)
{
	(void)state;
	for (int lookahead = 0; lookahead <= 2; lookahead++) {
		struct rig rig = rig_begin(MEMORY, lookahead);
		struct scene scene = {.wall_x = 2};

		assert_int_equal(rig_sweep(&rig, &scene, (struct vec3){0}), ROWS - lookahead);
		assert_int_equal(field_flush(rig.field), lookahead);
		assert_int_equal(field_flush(rig.field), 0);
		assert_true(known_voxels(&rig) > 5000);
		rig_end(&rig);
	}
}

static void meshing_in_between_leaves_no_trace(void **state)
{
	uint64_t hash[2];

	(void)state;
	for (int often = 0; often < 2; often++) {
		struct rig rig = rig_begin(MEMORY, 2);
		struct scene scene = {.wall_x = 2, .box_x = 1, .noise_m = 0.01, .seed = 9};

		for (int r = 0; r < 2 * ROWS; r++) {
			field_row(rig.field, scene_row(&scene, (struct vec3){0}, r % ROWS));
			if (often)
				dirty_of(&rig);
		}
		field_flush(rig.field);
		hash[often] = voxels_hash(&rig);
		rig_end(&rig);
	}
	assert_true(hash[0] == hash[1]);
}

enum { SPAN = 64 }; /* the scenes lie in voxels 0 .. SPAN - 1 along x, -SPAN / 2 .. along y and z */

static void known_map(const struct rig *rig, uint8_t *ret_known)
{
	for (int i = 0; i < SPAN; i++)
		for (int j = 0; j < SPAN; j++)
			for (int k = 0; k < SPAN; k++)
				ret_known[(i * SPAN + j) * SPAN + k] =
				    grid_published(rig->grid, i, j - SPAN / 2, k - SPAN / 2) != VOXEL_UNKNOWN;
}

/* A box stands before the wall, and is taken away. What is known then was known before, or the wall alone makes it so. */
static void free_space_clears_what_is_gone_and_makes_nothing_known(void **state)
{
	static uint8_t before[SPAN * SPAN * SPAN], after[SPAN * SPAN * SPAN], wall[SPAN * SPAN * SPAN];
	struct rig rig = rig_begin(MEMORY, 2), other = rig_begin(MEMORY, 2);
	struct scene with = {.wall_x = 2.5, .box_x = 1.21}, without = {.wall_x = 2.5};
	const int32_t box = (int32_t)(1.21 / CELL);
	int left, sweeps = 0;

	(void)state;
	rig_sweep(&rig, &with, (struct vec3){0});
	field_flush(rig.field);
	known_map(&rig, before);
	assert_true(grid_published(rig.grid, box + 1, 0, 0) < 0);
	assert_true(grid_published(rig.grid, box - 1, 0, 0) > 0);
	do {
		rig_sweep(&rig, &without, (struct vec3){0});
		rig_sweep(&other, &without, (struct vec3){0});
		field_flush(rig.field);
		field_flush(other.field);
		left = 0;
		for (int32_t j = -3; j <= 3; j++)
			for (int32_t k = -3; k <= 3; k++)
				for (int32_t i = box + 1; i <= box + 3; i++)
					left += grid_published(rig.grid, i, j, k) != VOXEL_UNKNOWN;
		sweeps++;
	} while (left && sweeps < 20);
	printf("note: a box at 1.2 m is gone after %d sweeps without it\n", sweeps);
	assert_int_equal(left, 0);
	assert_true(grid_published(rig.grid, box - 1, 0, 0) > 0); /* free space before it stays as it was */
	known_map(&rig, after);
	known_map(&other, wall);
	for (int v = 0; v < SPAN * SPAN * SPAN; v++)
		assert_true(!after[v] || before[v] || wall[v]);
	rig_end(&rig);
	rig_end(&other);
}

static void beams_without_an_echo_clear_nothing(void **state)
{
	struct rig rig = rig_begin(MEMORY, 2);
	struct scene box = {.wall_x = 2.5, .box_x = 1.2}, wall = {.wall_x = 2.5};
	uint64_t hash;

	(void)state;
	rig_sweep(&rig, &box, (struct vec3){0});
	field_flush(rig.field);
	hash = voxels_hash(&rig);
	for (int r = 0; r < ROWS; r++) {
		struct row *row = scene_row(&wall, (struct vec3){0}, r);

		for (int k = 0; k < BEAMS; k++)
			row->beam[k].state = (uint8_t)(1 + (r + k) % (BEAM_STATES - 1));
		field_row(rig.field, row);
	}
	field_flush(rig.field);
	assert_true(voxels_hash(&rig) == hash);
	rig_end(&rig);
}

static void a_wall_seen_again_is_hardly_news(void **state)
{
	struct rig rig = rig_begin(MEMORY, 2);
	struct scene scene = {.wall_x = 2, .noise_m = 0.005, .seed = 3};
	size_t dirty[4] = {0};

	(void)state;
	for (int pass = 0; pass < 4; pass++)
		for (int r = 0; r < ROWS; r++) {
			field_row(rig.field, scene_row(&scene, (struct vec3){0}, r));
			dirty[pass] += dirty_of(&rig);
		}
	printf("note: dirty patches a row: %.1f, then %.1f, %.1f, %.1f\n", (double)dirty[0] / ROWS,
	       (double)dirty[1] / ROWS, (double)dirty[2] / ROWS, (double)dirty[3] / ROWS);
	assert_true(3 * dirty[3] < dirty[0]);
	rig_end(&rig);
}

static void what_is_too_far_is_dropped_and_counted(void **state)
{
	struct rig rig = rig_begin(MEMORY, 2);
	struct scene scene = {.wall_x = 2};
	struct field_stats stats;

	(void)state;
	for (int r = 0; r < 10; r++) {
		struct row *row = scene_row(&scene, (struct vec3){0}, r);

		row->beam[7].point.x = 1e7;
		row->beam[8].point.y = NAN;
		row->beam[9].point.z = -INFINITY;
		row->beam[10].state = BEAM_WEAK;
		field_row(rig.field, row);
	}
	field_flush(rig.field);
	field_point(rig.field, (struct vec3){0}, (struct vec3){0, 1e9, 0});
	field_point(rig.field, (struct vec3){NAN, 0, 0}, (struct vec3){0, 1, 0});
	field_fold_points(rig.field);
	field_stats(rig.field, &stats);
	assert_int_equal(stats.far_points, 32);
	assert_int_equal(stats.points, 10 * (BEAMS - 4));
	rig_end(&rig);
}

static void at_the_memory_cap_the_field_goes_on(void **state)
{
	const size_t cap = 200000;
	struct rig rig = rig_begin(cap, 2);
	struct scene scene = {.wall_x = 2, .noise_m = 0.01, .seed = 1};
	struct grid_stats stats;
	uint64_t hash[2];

	(void)state;
	for (int again = 0; again < 2; again++) {
		if (again) {
			rig_end(&rig);
			rig = rig_begin(cap, 2);
			scene.seed = 1;
		}
		rig_sweep(&rig, &scene, (struct vec3){0});
		field_flush(rig.field);
		grid_stats(rig.grid, &stats);
		assert_true(stats.refused_memory > 0 && stats.bytes <= cap && stats.blocks > 20);
		hash[again] = voxels_hash(&rig);
	}
	assert_true(hash[0] == hash[1]);
	rig_end(&rig);
}

static void rasters_of_two_scanners_do_not_mix(void **state)
{
	uint64_t hash[2];

	(void)state;
	for (int mixed = 0; mixed < 2; mixed++) {
		struct rig rig = rig_begin(MEMORY, 2);
		struct scene a = {.wall_x = 2, .noise_m = 0.01, .seed = 1},
		             b = {.wall_x = 3, .noise_m = 0.01, .seed = 2};
		const struct vec3 here = {0, 0, 0}, there = {0, 100, 0};

		for (int n = 0; n < 2 * ROWS; n++) {
			bool second = mixed ? n % 2 : n >= ROWS;
			int r = mixed ? n / 2 : n % ROWS;
			struct row *row = scene_row(second ? &b : &a, second ? there : here, r);

			row->raster = second ? 1 : 0;
			row->number = (uint64_t)n;
			field_row(rig.field, row);
		}
		assert_int_equal(field_flush(rig.field), 4);
		hash[mixed] = voxels_hash(&rig);
		rig_end(&rig);
	}
	assert_true(hash[0] == hash[1]);
}

static void points_without_a_raster_complete_cells(void **state)
{
	struct rig rig = rig_begin(MEMORY, 2);
	struct field_stats stats;
	int complete = 0;

	(void)state;
	for (int j = -20; j <= 20; j++)
		for (int k = -20; k <= 20; k++)
			field_point(rig.field, (struct vec3){0},
			            (struct vec3){1.017, j * 0.05 + 0.01, k * 0.05 - 0.02});
	field_fold_points(rig.field);
	field_stats(rig.field, &stats);
	assert_int_equal(stats.points, 41 * 41);
	assert_int_equal(stats.step, 1);
	for (int j = -15; j < 15; j++)
		for (int k = -15; k < 15; k++)
			complete += grid_published(rig.grid, 20, j, k) > 0 && grid_published(rig.grid, 21, j, k) < 0;
	assert_int_equal(complete, 900);
	rig_end(&rig);
}

static double random_in(uint64_t *seed, double low, double high)
{
	*seed = *seed * 6364136223846793005u + 1442695040888963407u;
	return low + (high - low) * (double)(*seed >> 11) / 9007199254740992.0;
}

/* Rows nobody would measure: jumps, strange states, other lengths and steps, moving origins. */
static struct row *random_row(uint64_t *seed)
{
	uint32_t n = 1 + (uint32_t)random_in(seed, 0, 200);
	struct row *row = row_create(n);
	double range = random_in(seed, 0.5, 6);
	/* one after the other: the order in an initializer is the compiler's */
	double tilt_rad = random_in(seed, -0.5, 0.5), yaw_rad = random_in(seed, -3, 3);
	double x = random_in(seed, -2, 2), y = random_in(seed, -2, 2);
	struct transform at = transform_rpy((struct vec3){x, y, 1}, (struct vec3){0.01, tilt_rad, yaw_rad});

	row->step_rad = (random_in(seed, 0, 1) < 0.1 ? 1.0 : 0.5) * TRIG_DEG;
	row->first_rad = -0.25 * n * TRIG_DEG;
	row->starts_sweep = random_in(seed, 0, 1) < 0.05;
	row->raster = (uint32_t)random_in(seed, 0, 2);
	for (uint32_t k = 0; k < n; k++) {
		double b = row->first_rad + k * row->step_rad, jump = random_in(seed, 0, 1);

		range += jump < 0.02 ? random_in(seed, -1, 1) : random_in(seed, -0.02, 0.02);
		range = range < 0.3 ? 0.3 : range;
		row->beam[k].origin = at.t;
		row->beam[k].range_m = (float)range;
		row->beam[k].state = jump > 0.97 ? BEAM_WEAK : BEAM_OK;
		row->beam[k].point = transform_point(&at, (struct vec3){range * trig_cos(b), range * trig_sin(b), 0});
	}
	return row;
}

/* Any compiler or option that changes a bit of any voxel fails here. A new rule of the field changes GOLDEN: say so. */
static void random_rows_give_the_same_voxels_everywhere(void **state)
{
	struct rig rig = rig_begin(MEMORY, 2);
	struct field_stats stats;
	uint64_t seed = 2024, hash;

	(void)state;
	for (int r = 0; r < 400; r++) {
		struct row *row = random_row(&seed);

		row->number = (uint64_t)r;
		field_row(rig.field, row);
	}
	field_flush(rig.field);
	field_stats(rig.field, &stats);
	hash = voxels_hash(&rig);
	printf("note: golden voxels %016llx, %llu samples, %llu rays\n", (unsigned long long)hash,
	       (unsigned long long)stats.samples, (unsigned long long)stats.rays);
	assert_int_equal(stats.rows, 400);
	assert_true(hash == GOLDEN);
	rig_end(&rig);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_plane_is_where_it_is),
	    cmocka_unit_test(a_wall_on_the_lattice_has_its_voxels_on_one_side),
	    cmocka_unit_test(a_fold_does_not_know_the_order_of_contributions),
	    cmocka_unit_test(rays_of_one_row_that_end_together_are_one_with_their_count),
	    cmocka_unit_test(at_the_cap_sum_and_weight_shrink_together),
	    cmocka_unit_test(a_crowd_of_points_in_one_place_does_not_overflow),
	    cmocka_unit_test(a_full_scratch_is_folded_and_nothing_is_lost),
	    cmocka_unit_test(without_memory_no_column_is_left_for_later_rows),
	    cmocka_unit_test(a_patch_is_the_sum_of_its_samples),
	    cmocka_unit_test(a_row_that_waited_gives_the_same_voxels),
	    cmocka_unit_test(lookahead_says_how_many_rows_wait),
	    cmocka_unit_test(meshing_in_between_leaves_no_trace),
	    cmocka_unit_test(free_space_clears_what_is_gone_and_makes_nothing_known),
	    cmocka_unit_test(beams_without_an_echo_clear_nothing),
	    cmocka_unit_test(a_wall_seen_again_is_hardly_news),
	    cmocka_unit_test(what_is_too_far_is_dropped_and_counted),
	    cmocka_unit_test(at_the_memory_cap_the_field_goes_on),
	    cmocka_unit_test(rasters_of_two_scanners_do_not_mix),
	    cmocka_unit_test(points_without_a_raster_complete_cells),
	    cmocka_unit_test(random_rows_give_the_same_voxels_everywhere),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

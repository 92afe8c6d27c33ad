/* The integers of one row on their way into the voxels (law L2): contributions are summed in any order, then folded
 * once into each voxel. Lengths in cells. */
#ifndef FACET_CORE_FOLD_H
#define FACET_CORE_FOLD_H

#include "core/grid.h"
#include "core/types.h"

#define BAND_CELLS      3      /* how far a sample reaches before and behind its surface */
#define WEIGHT_KNOWN    4      /* least weight of a known voxel */
#define WEIGHT_MAX      16384  /* the cap: sum and weight are scaled down to it together */
#define PUBLISH_STEP    16     /* 1/256 cell: a lesser change is no news */
#define TOUCHING        24     /* 1/256 cell: a mean no farther behind a surface is published as 0, on it */
#define TOUCHING_STICKS 8      /* more on the side where a voxel is, less where it is not yet */
#define FREE_WEIGHT     32     /* what one ray takes from a voxel it passes through */
#define FOLD_BLOCKS_MAX 4096   /* blocks of one row (15 MB); when they are full the row is folded in parts */
#define FOLD_RAYS_MAX   65536  /* distinct rays of one row; rays beyond are not looked at */
#define FOLD_PATCH_SIDE 32     /* samples along one side of a patch */
#define RAY_LENGTH_MAX  8192.0 /* cells; a longer ray clears nothing */

struct fold;

/* NULL when memory is out. */
struct fold *fold_create(struct grid *);
void fold_destroy(struct fold *);

/* A piece of plane, prepared once for all its samples. */
struct fold_plane {
	double n[3]; /* towards the scanner, unit length; along the axis, then the lesser and the greater other one */
	double inverse;                            /* 1 / n[0] */
	double half;                               /* voxels along the axis on either side */
	int32_t step;                              /* distance from voxel to voxel along the axis, 1/65536 cell */
	int16_t high[BLOCK_SIDE], low[BLOCK_SIDE]; /* i steps: in 1/256 cell, and what is left */
	int16_t weight[BLOCK_SIDE];                /* 4 w / (256 BAND_CELLS), in 1/65536, eight times */
	int axis;                                  /* the dominant one, 0..2 */
};

/* `weight` of a sample right on a voxel is 4 * weight, at most 32 * 4. */
struct fold_plane fold_plane(struct vec3 normal, double weight);

/* Adds a sample: the voxels of the column nearest to `point` (cells, within the map) along the plane's axis. */
void fold_sample(struct fold *, const struct fold_plane *, struct vec3 point);

/* Adds across * along samples, each at most FOLD_PATCH_SIDE, spread evenly over the patch with corners 0 1 / 2 3. */
void fold_patch(struct fold *, const struct fold_plane *, const struct vec3 corner[4], int across, int along);

/* A ray that passes through free space from `origin` to `end`. Rays that end in one voxel are one ray with their count.
 */
void fold_ray(struct fold *, struct vec3 origin, struct vec3 end);

/* Folds what was added, marks what changed, and is empty again. */
void fold_apply(struct fold *);

struct fold_stats {
	uint64_t samples, rays, cleared; /* rays after merging; voxels that became unknown */
};
void fold_stats(const struct fold *, struct fold_stats *ret);

#endif

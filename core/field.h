/* The field: rows of beams -> voxels. One interface for the ways to give a corner its value (field_distance.c now).
 *
 * A row waits until `lookahead` later rows of its raster are known (its normals read them), at most until the end of
 * the sweep; then it is folded. The voxels are a function of the sequence of rows and of nothing else (law L2). */
#ifndef FACET_CORE_FIELD_H
#define FACET_CORE_FIELD_H

#include "core/grid.h"
#include "core/types.h"

struct field_params {
	double cell_m;
	int lookahead; /* rows, 0..2 */
};

struct field;

/* The field writes into `grid`, which must outlive it. NULL when memory is out. */
struct field *field_create(const struct field_params *, struct grid *);
void field_destroy(struct field *);

/* Takes `row` over. Folds as many rows as became complete, and says how many. */
int field_row(struct field *, struct row *row);

/* Folds all rows that still wait (end of a sweep, of the input, or a second without a row); the rasters start anew. */
int field_flush(struct field *);

/* A cloud without a raster: a point along its ray from `origin`, splatted 2x2 at half-cell offsets. Points between two
 * field_fold_points are one row to law L2. */
void field_point(struct field *, struct vec3 origin, struct vec3 point);
void field_fold_points(struct field *);

struct field_stats {
	uint64_t rows, points, samples, singles, rays, far_points; /* folded so far */
	uint64_t step;                                             /* applied (folded) rows */
};
void field_stats(const struct field *, struct field_stats *ret);

#endif

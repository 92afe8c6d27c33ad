/* The rows of one sweep as a raster: which beams are neighbours on one surface, and the surface's normal at each.
 *
 * Columns are bearings: column = floor(bearing / step) counted from the sweep's first, so rows of an interlaced
 * scanner, shifted by a fraction of a step, keep the same neighbours all the way. Lines are rows. The newest
 * RASTER_LINES lines are held; points are in cells, distances between them in metres. */
#ifndef FACET_CORE_RASTER_H
#define FACET_CORE_RASTER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "core/types.h"

#define RASTER_LINES \
	20 /* the window's reach above (15), the line below it, the line itself, look-ahead 2, one more \
	                 */
#define RASTER_LOOKAHEAD 2     /* lines at most */
#define RASTER_BEAMS_MAX 16384 /* of a row; what is beyond is not looked at */

enum raster_flag {
	RASTER_POINT = 1, /* the beam ends on a surface within the map's limits */
	RASTER_RIGHT = 2, /* joined to column + 1 */
	RASTER_UP = 4,    /* joined to the line before */
	RASTER_QUAD =
	    8, /* columns c, c + 1 of this line and the one before are a piece of surface, not seen too flat */
	RASTER_NORMAL = 16 /* normal[c] is valid */
};

/* Integral image of the points' moments, in 1/8 mm: sums over all lines up to this one and all columns before this one.
 * All integers are taken modulo 2^32 or 2^64: a window's sums about its own centre fit, whatever the whole adds up to.
 */
struct raster_sums {
	uint32_t n, s[3];
	uint64_t q[6]; /* xx xy xz yy yz zz */
};

struct raster_line {
	struct row *row;         /* owned */
	struct vec3 *point;      /* [width] cells */
	float (*normal)[3];      /* [width] towards the scanner, unit length */
	float *right_m2, *up_m2; /* [width] squared distance to the neighbour, where joined */
	uint8_t *flags;          /* [width] enum raster_flag */
	uint8_t *left, *right;   /* [width] joined neighbours in a run on either side, at most 15 */
	uint8_t *up;             /* [width] likewise in the lines before */
	struct raster_sums *sum; /* [width + 1] */
	int32_t first;           /* column of beam 0 */
};

struct raster {
	double cell_m, step_rad;
	double column0; /* bearing / step of column 0 */
	int32_t width;  /* columns */
	int32_t width_cap;
	uint64_t lines; /* taken since raster_begin */
	void *memory;
	struct raster_sums *zero; /* [width + 1] the line before the first */
	struct raster_line line[RASTER_LINES];
};

void raster_init(struct raster *, double cell_m);
void raster_finish(struct raster *);

/* Does the row continue the raster (same step, columns within)? */
bool raster_accepts(const struct raster *, const struct row *);

/* An empty raster with columns for rows like this one. 0 or -ENOMEM. */
int raster_begin(struct raster *, const struct row *);

/* Takes over a row that raster_accepts as the newest line. */
void raster_push(struct raster *, struct row *);

/* Line `number`, one of the newest RASTER_LINES. */
struct raster_line *raster_line(struct raster *, uint64_t number);

/* Computes the normals of a line from a window that ends at line `last`, at most RASTER_LOOKAHEAD after it. */
void raster_normals(struct raster *, uint64_t number, uint64_t last);

/* Within 2^18 patches of the origin, less one for the band; false for what is no number. */
static inline bool raster_within_map(struct vec3 cells)
{
	const double limit = 16.0 * ((1 << 18) - 1);

	return fabs(cells.x) < limit && fabs(cells.y) < limit && fabs(cells.z) < limit;
}

/* The beam behind a column, or NULL. */
static inline const struct row_beam *raster_beam(const struct raster_line *line, int32_t column)
{
	uint32_t k = (uint32_t)(column - line->first);

	return k < line->row->n ? &line->row->beam[k] : NULL;
}

#endif

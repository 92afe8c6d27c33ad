/* Polygons with holes to triangles, in exact integers. */
#ifndef FACET_CORE_TRIANGULATE_H
#define FACET_CORE_TRIANGULATE_H

#include <stdbool.h>
#include <stdint.h>

#include "core/arena.h"

/* Coordinates are within +-2^20, so that every predicate is exact. */
#define TRIANGULATE_COORDINATE_MAX (1 << 20)

/* Loops of points, one after the other, the inside to the left of every edge: the outer loop first (counter-clockwise), then
 * holes (clockwise). Loops may touch themselves and each other in points that are corners of both; they may not cross. */
struct polygon {
	const int32_t (*point)[2];
	const uint32_t *loop_end; /* [loops] index behind the last point of a loop */
	uint32_t n, loops;
};

/* Whether the diagonal between points a and b may be used; NULL: all may. */
typedef bool triangulate_allows(const void *ctx, uint32_t a, uint32_t b);

/* At most n + 2 (loops - 1) - 2 triangles of point indices, counter-clockwise, none without area, in `ret_triangle`
 * (in the arena). 0; -ENOMEM; -EDOM where allowed diagonals do not suffice, or the loops are no polygon. */
int triangulate(const struct polygon *polygon, triangulate_allows *allows, const void *ctx, struct arena *arena,
                uint32_t (**ret_triangle)[3], uint32_t *ret_n);

/* Twice the signed area. */
int64_t polygon_area(const struct polygon *polygon);

#endif

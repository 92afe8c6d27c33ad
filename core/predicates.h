/* Exact predicates on lattice integers.
 *
 * Inside a patch a coordinate is 0 .. 4096; differences of two fit 13 bits and a sign, so every value below is far
 * inside 64 bits: orientation 2^27, squares of it 2^54, the in-circle determinant 2^55. No predicate ever rounds. */
#ifndef FACET_CORE_PREDICATES_H
#define FACET_CORE_PREDICATES_H

#include <stdbool.h>
#include <stdint.h>

/* Twice the area of a, b, c: positive counter-clockwise, zero where they lie on a line. */
static inline int64_t orientation(const int32_t a[2], const int32_t b[2], const int32_t c[2])
{
	return (int64_t)(b[0] - a[0]) * (c[1] - a[1]) - (int64_t)(b[1] - a[1]) * (c[0] - a[0]);
}

static inline int64_t distance_squared2(const int32_t a[2], const int32_t b[2])
{
	int64_t x = b[0] - a[0], y = b[1] - a[1];
	return x * x + y * y;
}

/* p on the line through a and b: whether it lies between them, ends included. */
static inline bool between(const int32_t a[2], const int32_t b[2], const int32_t p[2])
{
	int64_t x = (int64_t)(p[0] - a[0]) * (p[0] - b[0]), y = (int64_t)(p[1] - a[1]) * (p[1] - b[1]);
	return x <= 0 && y <= 0;
}

/* Whether the closed segments a-b and c-d have a point in common. */
static inline bool segments_touch(const int32_t a[2], const int32_t b[2], const int32_t c[2], const int32_t d[2])
{
	int64_t abc = orientation(a, b, c), abd = orientation(a, b, d);
	int64_t cda = orientation(c, d, a), cdb = orientation(c, d, b);
	if (((abc > 0 && abd < 0) || (abc < 0 && abd > 0)) && ((cda > 0 && cdb < 0) || (cda < 0 && cdb > 0)))
		return true;
	return (abc == 0 && between(a, b, c)) || (abd == 0 && between(a, b, d)) || (cda == 0 && between(c, d, a)) ||
	       (cdb == 0 && between(c, d, b));
}

/* Positive where d lies inside the circle through a, b, c (counter-clockwise); zero on it. */
static inline int64_t in_circle(const int32_t a[2], const int32_t b[2], const int32_t c[2], const int32_t d[2])
{
	int64_t ax = a[0] - d[0], ay = a[1] - d[1], bx = b[0] - d[0], by = b[1] - d[1];
	int64_t cx = c[0] - d[0], cy = c[1] - d[1];
	return (ax * ax + ay * ay) * (bx * cy - by * cx) - (bx * bx + by * by) * (ax * cy - ay * cx) +
	       (cx * cx + cy * cy) * (ax * by - ay * bx);
}

/* Normal of the triangle a, b, c; its length is twice the area. */
static inline void triangle_normal(const int32_t a[3], const int32_t b[3], const int32_t c[3], int64_t ret_normal[3])
{
	int64_t ux = b[0] - a[0], uy = b[1] - a[1], uz = b[2] - a[2];
	int64_t vx = c[0] - a[0], vy = c[1] - a[1], vz = c[2] - a[2];
	ret_normal[0] = uy * vz - uz * vy;
	ret_normal[1] = uz * vx - ux * vz;
	ret_normal[2] = ux * vy - uy * vx;
}

static inline int64_t distance_squared3(const int32_t a[3], const int32_t b[3])
{
	int64_t x = b[0] - a[0], y = b[1] - a[1], z = b[2] - a[2];
	return x * x + y * y + z * z;
}

#endif

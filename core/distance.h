/* Distances to triangles and segments, in lattice units, double precision. */
#ifndef FACET_CORE_DISTANCE_H
#define FACET_CORE_DISTANCE_H

#include <stdbool.h>
#include <stdint.h>

#include "core/vec.h"

/* A triangle with what repeated distance queries share. */
struct flat {
	struct vec3 a, ab, ac;
	struct vec3 normal; /* unit */
	double ab_ab, ab_ac, ac_ac, determinant;
};

struct flat flat_make(struct vec3 a, struct vec3 b, struct vec3 c); /* with an area */
double flat_distance_squared(const struct flat *, struct vec3 p);

/* Triangles at one place, and for each what bounds the distance of a point from below. */
#define FAN_MAX 32
struct fan {
	uint32_t n;
	struct flat flat[FAN_MAX];
	double share[FAN_MAX][3]; /* of a squared barycentric coordinate: the squared distance from that side */
};

/* Once its flats are there, with normals as long as twice their areas. */
void fan_close(struct fan *);

/* The nearest triangle, of several the first. */
uint32_t fan_nearest(const struct fan *, struct vec3 p, double *ret_squared);

double segment_distance_squared(struct vec3 a, struct vec3 b, struct vec3 p);

#endif

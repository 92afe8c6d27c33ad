/* Distances to triangles and segments, in lattice units, double precision. */
#ifndef FACET_CORE_DISTANCE_H
#define FACET_CORE_DISTANCE_H

#include <stdbool.h>

#include "core/vec.h"

/* A triangle with what repeated distance queries share. */
struct flat {
	struct vec3 a, ab, ac;
	struct vec3 normal; /* unit */
	double ab_ab, ab_ac, ac_ac, determinant;
};

struct flat flat_make(struct vec3 a, struct vec3 b, struct vec3 c); /* with an area */
double flat_distance_squared(const struct flat *, struct vec3 p);
double segment_distance_squared(struct vec3 a, struct vec3 b, struct vec3 p);

#endif

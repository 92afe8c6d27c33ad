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

/* Triangles that share their first corner, side by side: what is asked of one is asked of all. Entries from n on, up to
 * an even number, repeat the last. */
#define FAN_MAX 32
struct fan {
	uint32_t n;
	struct vec3 a;
	double ab[3][FAN_MAX], ac[3][FAN_MAX]; /* x, y, z */
	double normal[3][FAN_MAX];
	double ab_ab[FAN_MAX], ab_ac[FAN_MAX], ac_ac[FAN_MAX], bc_bc[FAN_MAX], determinant[FAN_MAX];
	double share[3][FAN_MAX]; /* of twice a barycentric coordinate, squared: the squared distance from that side */
};

/* A fan is begun, gets its triangles and their normals, which then are as long as twice the areas, and is closed. */
static inline void fan_begin(struct fan *fan, struct vec3 a)
{
	fan->a = a;
	fan->n = 0;
}

static inline void fan_add(struct fan *fan, struct vec3 b, struct vec3 c)
{
	struct vec3 ab = vec3_sub(b, fan->a), ac = vec3_sub(c, fan->a);
	uint32_t k = fan->n++;
	fan->ab[0][k] = ab.x, fan->ab[1][k] = ab.y, fan->ab[2][k] = ab.z;
	fan->ac[0][k] = ac.x, fan->ac[1][k] = ac.y, fan->ac[2][k] = ac.z;
}

void fan_span(struct fan *);
void fan_close(struct fan *);

/* The nearest triangle, of several the first. */
uint32_t fan_nearest(const struct fan *, struct vec3 p, double *ret_squared);

/* How high p lies over the plane of a triangle. */
static inline double fan_height(const struct fan *fan, uint32_t k, struct vec3 p)
{
	struct vec3 d = vec3_sub(p, fan->a);
	return d.x * fan->normal[0][k] + d.y * fan->normal[1][k] + d.z * fan->normal[2][k];
}

double segment_distance_squared(struct vec3 a, struct vec3 b, struct vec3 p);

#endif

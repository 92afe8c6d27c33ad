/* The distance of a point to a triangle: to its plane where the foot lies inside, else to the nearest edge. The foot is
 * judged by barycentric coordinates, whose divisor is made once per triangle.
 *
 * Of a fan the triangle with the least lower bound is looked at first; hardly another one then has a bound that asks for
 * its distance. Bounds round, by far less than BOUND_SLACK, which is taken off them: the answer is that of all the
 * distances. */
#include "core/distance.h"

#define BOUND_SLACK 0.001 /* squared lattice units; triangles with an altitude of a lattice unit round by 1e-4 */

struct flat flat_make(struct vec3 a, struct vec3 b, struct vec3 c)
{
	struct flat f = {.a = a, .ab = vec3_sub(b, a), .ac = vec3_sub(c, a)};
	struct vec3 normal = vec3_cross(f.ab, f.ac);
	f.normal = vec3_scale(normal, 1 / vec3_norm(normal));
	f.ab_ab = vec3_dot(f.ab, f.ab);
	f.ab_ac = vec3_dot(f.ab, f.ac);
	f.ac_ac = vec3_dot(f.ac, f.ac);
	f.determinant = f.ab_ab * f.ac_ac - f.ab_ac * f.ab_ac;
	return f;
}

static double to_segment(struct vec3 from, struct vec3 along, double length_squared, struct vec3 p)
{
	struct vec3 d = vec3_sub(p, from);
	double t = vec3_dot(d, along);
	if (t > 0) {
		t = t < length_squared ? t / length_squared : 1;
		d = vec3_sub(d, vec3_scale(along, t));
	}
	return vec3_dot(d, d);
}

double segment_distance_squared(struct vec3 a, struct vec3 b, struct vec3 p)
{
	struct vec3 along = vec3_sub(b, a);
	return to_segment(a, along, vec3_dot(along, along), p);
}

static inline double to_flat(const struct flat *f, struct vec3 p)
{
	struct vec3 d = vec3_sub(p, f->a);
	double db = vec3_dot(d, f->ab), dc = vec3_dot(d, f->ac);
	double s = f->ac_ac * db - f->ab_ac * dc, t = f->ab_ab * dc - f->ab_ac * db;
	if (s >= 0 && t >= 0 && s + t <= f->determinant) {
		double height = vec3_dot(d, f->normal);
		return height * height;
	}
	double best = INFINITY;
	if (t < 0)
		best = to_segment(f->a, f->ab, f->ab_ab, p);
	if (s < 0) {
		double other = to_segment(f->a, f->ac, f->ac_ac, p);
		best = other < best ? other : best;
	}
	if (s + t > f->determinant) {
		struct vec3 bc = vec3_sub(f->ac, f->ab);
		double other = to_segment(vec3_add(f->a, f->ab), bc, vec3_dot(bc, bc), p);
		best = other < best ? other : best;
	}
	return best;
}

double flat_distance_squared(const struct flat *f, struct vec3 p)
{
	return to_flat(f, p);
}

static inline struct flat flat_of(const struct fan *fan, uint32_t k)
{
	return (struct flat){fan->a,
	                     {fan->ab[0][k], fan->ab[1][k], fan->ab[2][k]},
	                     {fan->ac[0][k], fan->ac[1][k], fan->ac[2][k]},
	                     {fan->normal[0][k], fan->normal[1][k], fan->normal[2][k]},
	                     fan->ab_ab[k],
	                     fan->ab_ac[k],
	                     fan->ac_ac[k],
	                     fan->determinant[k]};
}

/* Loops over a fan run over pairs: so they are done two at a time, without a rest. */
static uint32_t pairs(const struct fan *fan)
{
	return (fan->n + 1) & ~1u;
}

void fan_span(struct fan *fan)
{
	if (fan->n & 1)
		for (int axis = 0; axis < 3; axis++) {
			fan->ab[axis][fan->n] = fan->ab[axis][fan->n - 1];
			fan->ac[axis][fan->n] = fan->ac[axis][fan->n - 1];
		}
	for (uint32_t k = 0, n = pairs(fan); k < n; k++) {
		double bx = fan->ab[0][k], by = fan->ab[1][k], bz = fan->ab[2][k];
		double cx = fan->ac[0][k], cy = fan->ac[1][k], cz = fan->ac[2][k];
		fan->normal[0][k] = by * cz - bz * cy;
		fan->normal[1][k] = bz * cx - bx * cz;
		fan->normal[2][k] = bx * cy - by * cx;
		fan->ab_ab[k] = bx * bx + by * by + bz * bz;
		fan->ab_ac[k] = bx * cx + by * cy + bz * cz;
		fan->ac_ac[k] = cx * cx + cy * cy + cz * cz;
		fan->bc_bc[k] = fan->ab_ab[k] + fan->ac_ac[k] - 2 * fan->ab_ac[k];
	}
}

void fan_close(struct fan *fan)
{
	for (uint32_t k = 0, n = pairs(fan); k < n; k++) {
		double x = fan->normal[0][k], y = fan->normal[1][k], z = fan->normal[2][k];
		double unit = 1 / sqrt(x * x + y * y + z * z);
		double bb = fan->ab_ab[k], cc = fan->ac_ac[k], third = fan->bc_bc[k];
		double determinant = bb * cc - fan->ab_ac[k] * fan->ab_ac[k];
		double share = 0.25 / (determinant * bb * cc * third);
		fan->normal[0][k] = x * unit;
		fan->normal[1][k] = y * unit;
		fan->normal[2][k] = z * unit;
		fan->determinant[k] = determinant;
		fan->share[0][k] = share * bb * third;
		fan->share[1][k] = share * cc * third;
		fan->share[2][k] = share * bb * cc;
	}
}

/* Of a barycentric coordinate below zero the squared distance it stands for; else zero. */
static inline double beyond(double coordinate, double share)
{
	double twice = coordinate - fabs(coordinate); /* written so that compilers take two at a time */
	return twice * twice * share;
}

/* Of each triangle the squared height of p, plus how far it lies beyond the side it is farthest outside of. Returns the
 * least of them. */
static double least_squared(const struct fan *fan, struct vec3 p, double ret_least[FAN_MAX])
{
	struct vec3 d = vec3_sub(p, fan->a);
	for (uint32_t k = 0, n = pairs(fan); k < n; k++) {
		double db = d.x * fan->ab[0][k] + d.y * fan->ab[1][k] + d.z * fan->ab[2][k];
		double dc = d.x * fan->ac[0][k] + d.y * fan->ac[1][k] + d.z * fan->ac[2][k];
		double height = d.x * fan->normal[0][k] + d.y * fan->normal[1][k] + d.z * fan->normal[2][k];
		double s = fan->ac_ac[k] * db - fan->ab_ac[k] * dc, t = fan->ab_ab[k] * dc - fan->ab_ac[k] * db;
		double first = beyond(s, fan->share[0][k]), second = beyond(t, fan->share[1][k]);
		double third = beyond(fan->determinant[k] - s - t, fan->share[2][k]);
		first = first > second ? first : second;
		ret_least[k] = height * height + (first > third ? first : third);
	}
	double least = INFINITY;
	for (uint32_t k = 0; k < fan->n; k++)
		least = ret_least[k] < least ? ret_least[k] : least;
	return least;
}

/* The triangles, one bit each, whose bound is not above `most`. */
static uint32_t candidates(const struct fan *fan, const double least[FAN_MAX], double most)
{
	uint32_t set = 0;
	for (uint32_t k = 0; k < fan->n; k++)
		set |= (uint32_t) !(least[k] > most) << k;
	return set;
}

uint32_t fan_nearest(const struct fan *fan, struct vec3 p, double *ret_squared)
{
	double least[FAN_MAX];
	double lowest = least_squared(fan, p, least);
	uint32_t best = (uint32_t)__builtin_ctz(candidates(fan, least, lowest));
	struct flat flat = flat_of(fan, best);
	double squared = to_flat(&flat, p);
	uint32_t set = candidates(fan, least, squared + BOUND_SLACK) & ~(1u << best);
	for (; set; set &= set - 1) {
		uint32_t k = (uint32_t)__builtin_ctz(set);
		flat = flat_of(fan, k);
		double other = to_flat(&flat, p);
		if (other < squared || (other == squared && k < best)) {
			squared = other;
			best = k;
		}
	}
	*ret_squared = squared;
	return best;
}

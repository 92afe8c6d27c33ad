/* The distance of a point to a triangle: to its plane where the foot lies inside, else to the nearest edge. The foot is
 * judged by barycentric coordinates, whose divisor is made once per triangle.
 *
 * Of several triangles the one with the least lower bound is looked at first; hardly another one then has a bound that
 * asks for its distance. Bounds round, by far less than BOUND_SLACK, which is taken off them: the answer is that of all
 * the distances. */
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

double flat_distance_squared(const struct flat *f, struct vec3 p)
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

void fan_close(struct fan *fan)
{
	for (uint32_t k = 0; k < fan->n; k++) {
		struct flat *f = &fan->flat[k];
		f->normal = vec3_scale(f->normal, 1 / vec3_norm(f->normal));
		f->determinant = f->ab_ab * f->ac_ac - f->ab_ac * f->ab_ac;
		double bc_bc = f->ab_ab + f->ac_ac - 2 * f->ab_ac;
		double share = 1 / (f->determinant * f->ab_ab * f->ac_ac * bc_bc);
		fan->share[k][0] = share * f->ab_ab * bc_bc;
		fan->share[k][1] = share * f->ac_ac * bc_bc;
		fan->share[k][2] = share * f->ab_ab * f->ac_ac;
	}
}

static double beyond(double coordinate, double share)
{
	double outside = coordinate < 0 ? coordinate : 0;
	return outside * outside * share;
}

/* The squared height, plus how far p lies beyond the side it is farthest outside of. */
static double least_squared(const struct flat *f, const double share[3], struct vec3 p)
{
	struct vec3 d = vec3_sub(p, f->a);
	double db = vec3_dot(d, f->ab), dc = vec3_dot(d, f->ac), height = vec3_dot(d, f->normal);
	double s = f->ac_ac * db - f->ab_ac * dc, t = f->ab_ab * dc - f->ab_ac * db;
	double first = beyond(s, share[0]), second = beyond(t, share[1]);
	double third = beyond(f->determinant - s - t, share[2]);
	first = first > second ? first : second;
	return height * height + (first > third ? first : third);
}

uint32_t fan_nearest(const struct fan *fan, struct vec3 p, double *ret_squared)
{
	double least[FAN_MAX];
	uint32_t best = 0;
	for (uint32_t k = 0; k < fan->n; k++) {
		least[k] = least_squared(&fan->flat[k], fan->share[k], p);
		best = least[k] < least[best] ? k : best;
	}
	double squared = flat_distance_squared(&fan->flat[best], p);
	for (uint32_t k = 0, first = best; k < fan->n; k++) {
		if (k == first || least[k] > squared + BOUND_SLACK)
			continue;
		double other = flat_distance_squared(&fan->flat[k], p);
		if (other < squared || (other == squared && k < best)) {
			squared = other;
			best = k;
		}
	}
	*ret_squared = squared;
	return best;
}

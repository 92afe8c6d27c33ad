/* The distance of a point to a triangle: to its plane where the foot lies inside, else to the nearest edge. The foot is
 * judged by barycentric coordinates, whose divisor is made once per triangle. */
#include "core/distance.h"

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

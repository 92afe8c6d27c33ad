/* Rotations and rigid transforms. A transform keeps a matrix: a row turns hundreds of points by it; a quaternion only
 * where poses are interpolated. Sums are written out in a fixed order, so every compiler gives the same bits (law L2).
 */
#include "core/vec.h"
#include "core/trig.h"

struct transform transform_identity(void)
{
	return (struct transform){.r = {1, 0, 0, 0, 1, 0, 0, 0, 1}};
}

struct transform transform_compose(const struct transform *a, const struct transform *b)
{
	struct transform c = {.t = transform_point(a, b->t)};

	for (int i = 0; i < 3; i++)
		for (int j = 0; j < 3; j++)
			c.r[3 * i + j] =
			    a->r[3 * i] * b->r[j] + a->r[3 * i + 1] * b->r[3 + j] + a->r[3 * i + 2] * b->r[6 + j];
	return c;
}

struct transform transform_inverse(const struct transform *a)
{
	const double *r = a->r;
	struct transform c = {.r = {r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]}};

	c.t = vec3_scale(transform_direction(&c, a->t), -1);
	return c;
}

struct transform transform_rpy(struct vec3 xyz_m, struct vec3 rpy_rad)
{
	double sr = trig_sin(rpy_rad.x), cr = trig_cos(rpy_rad.x);
	double sp = trig_sin(rpy_rad.y), cp = trig_cos(rpy_rad.y);
	double sy = trig_sin(rpy_rad.z), cy = trig_cos(rpy_rad.z);

	return (struct transform){.r = {cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, sy * cp,
	                                sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, -sp, cp * sr, cp * cr},
	                          .t = xyz_m};
}

struct transform transform_tilt(double angle_rad)
{
	double s = trig_sin(angle_rad), c = trig_cos(angle_rad);

	return (struct transform){.r = {c, 0, s, 0, 1, 0, -s, 0, c}};
}

struct transform transform_quat(struct vec3 t, struct quat q)
{
	double w = q.w, x = q.x, y = q.y, z = q.z;

	return (struct transform){.r = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
	                                2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
	                                2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)},
	                          .t = t};
}

/* Scaled by the largest component first: neither huge nor tiny quaternions lose their direction. */
struct quat quat_normalise(struct quat q)
{
	double m = fabs(q.w);

	m = fabs(q.x) > m ? fabs(q.x) : m;
	m = fabs(q.y) > m ? fabs(q.y) : m;
	m = fabs(q.z) > m ? fabs(q.z) : m;
	if (!(m > 0) || !(m <= 1.7e308))
		return (struct quat){.w = 1};
	double w = q.w / m, x = q.x / m, y = q.y / m, z = q.z / m;
	double n = sqrt(w * w + x * x + y * y + z * z);

	return n > 0 ? (struct quat){w / n, x / n, y / n, z / n} : (struct quat){.w = 1};
}

struct quat quat_between(struct quat a, struct quat b, double s)
{
	double dot = a.w * b.w + a.x * b.x + a.y * b.y + a.z * b.z;
	double sb = dot < 0 ? -s : s; /* q and -q are one rotation: take the nearer one */
	double sa = 1 - s;

	return quat_normalise(
	    (struct quat){sa * a.w + sb * b.w, sa * a.x + sb * b.x, sa * a.y + sb * b.y, sa * a.z + sb * b.z});
}

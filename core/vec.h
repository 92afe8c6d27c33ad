/* Small vectors, rotations and rigid transforms, in double precision and without libm beyond sqrt (law L2). */
#ifndef FACET_CORE_VEC_H
#define FACET_CORE_VEC_H

#include <math.h>

struct vec3 {
	double x, y, z;
};

struct quat {
	double w, x, y, z; /* unit length */
};

/* p_to = R p_from + t; `r` is row-major. A transform "a <- b" takes points of frame b to frame a. */
struct transform {
	double r[9];
	struct vec3 t; /* m */
};

static inline struct vec3 vec3_add(struct vec3 a, struct vec3 b)
{
	return (struct vec3){a.x + b.x, a.y + b.y, a.z + b.z};
}

static inline struct vec3 vec3_sub(struct vec3 a, struct vec3 b)
{
	return (struct vec3){a.x - b.x, a.y - b.y, a.z - b.z};
}

static inline struct vec3 vec3_scale(struct vec3 a, double s)
{
	return (struct vec3){a.x * s, a.y * s, a.z * s};
}

static inline double vec3_dot(struct vec3 a, struct vec3 b)
{
	return a.x * b.x + a.y * b.y + a.z * b.z;
}

static inline struct vec3 vec3_cross(struct vec3 a, struct vec3 b)
{
	return (struct vec3){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

static inline double vec3_norm(struct vec3 a)
{
	return sqrt(vec3_dot(a, a));
}

static inline struct vec3 vec3_lerp(struct vec3 a, struct vec3 b, double s)
{
	return vec3_add(a, vec3_scale(vec3_sub(b, a), s));
}

struct transform transform_identity(void);

/* first b, then a: (a <- b) of (b <- c) gives (a <- c). */
struct transform transform_compose(const struct transform *a, const struct transform *b);
struct transform transform_inverse(const struct transform *a);

static inline struct vec3 transform_direction(const struct transform *a, struct vec3 d)
{
	const double *r = a->r;

	return (struct vec3){r[0] * d.x + r[1] * d.y + r[2] * d.z, r[3] * d.x + r[4] * d.y + r[5] * d.z,
	                     r[6] * d.x + r[7] * d.y + r[8] * d.z};
}

static inline struct vec3 transform_point(const struct transform *a, struct vec3 p)
{
	return vec3_add(transform_direction(a, p), a->t);
}

/* Roll, pitch, yaw in radians about the fixed axes x, y, z (REP-103): R = Rz Ry Rx. */
struct transform transform_rpy(struct vec3 xyz_m, struct vec3 rpy_rad);

/* A rotation about y by `angle_rad`, right-handed: positive looks down (interfaces, section 2). */
struct transform transform_tilt(double angle_rad);
struct transform transform_quat(struct vec3 t, struct quat q);

/* The quaternion of unit length; the identity where `q` has no length. */
struct quat quat_normalise(struct quat q);

/* The shortest way from a to b, s in [0, 1] or slightly beyond (normalised linear: poses are 10 ms apart). */
struct quat quat_between(struct quat a, struct quat b, double s);

#endif

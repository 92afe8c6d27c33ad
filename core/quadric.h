/* Plane quadrics (Garland and Heckbert 1997): the sum of squared distances of a point to planes, and how many they are. */
#ifndef FACET_CORE_QUADRIC_H
#define FACET_CORE_QUADRIC_H

struct quadric {
	double xx, xy, xz, yy, yz, zz; /* sum of n n^T */
	double x, y, z;                /* sum of d n */
	double constant;               /* sum of d^2 */
	double planes;                 /* sum of weights */
};

/* The plane through `at` with unit normal `normal`. */
static inline void quadric_add_plane(struct quadric *q, const double normal[3], const double at[3], double weight)
{
	double a = normal[0], b = normal[1], c = normal[2], d = -(a * at[0] + b * at[1] + c * at[2]);
	q->xx += weight * a * a;
	q->xy += weight * a * b;
	q->xz += weight * a * c;
	q->yy += weight * b * b;
	q->yz += weight * b * c;
	q->zz += weight * c * c;
	q->x += weight * d * a;
	q->y += weight * d * b;
	q->z += weight * d * c;
	q->constant += weight * d * d;
	q->planes += weight;
}

static inline void quadric_add(struct quadric *q, const struct quadric *other)
{
	q->xx += other->xx;
	q->xy += other->xy;
	q->xz += other->xz;
	q->yy += other->yy;
	q->yz += other->yz;
	q->zz += other->zz;
	q->x += other->x;
	q->y += other->y;
	q->z += other->z;
	q->constant += other->constant;
	q->planes += other->planes;
}

static inline double quadric_at(const struct quadric *q, const double p[3])
{
	double x = p[0], y = p[1], z = p[2];
	double second = q->xx * x * x + q->yy * y * y + q->zz * z * z;
	double mixed = q->xy * x * y + q->xz * x * z + q->yz * y * z;
	double first = q->x * x + q->y * y + q->z * z;
	return second + 2 * mixed + 2 * first + q->constant;
}

#endif

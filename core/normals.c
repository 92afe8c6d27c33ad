/* Normals from a window of the raster.
 *
 * The window reaches about 10 cm each way, at most to the next depth jump and down to the newest line known. Its
 * moments come from the integral image in four look-ups; shifted to the beam in the middle they are small integers, so
 * nothing cancels. The normal is the direction of least variance. The least eigenvalue is found by Newton's steps on
 * the characteristic polynomial, from 0, where they rise monotonously to the least root; the eigenvector is the longest
 * cross product of two rows. No cosine of a third of an angle: law L2 allows only the basic operations and sqrt.
 *
 * Where the window does not fit one plane (a crease), the four windows that end at the beam are tried and the best one
 * taken; so creases stay sharp. Where all of them are poor the best is kept still: a single quad's normal is worse. */
#include "core/raster.h"

#define REACH_M       0.10
#define HALF_MAX      10    /* beams or lines */
#define RESIDUAL_M    0.015 /* rms beyond which other windows are tried */
#define UNITS_M       8000.0
#define LINE_RATIO    1e-6 /* least second eigenvalue of the greatest: below it the points lie on a line */
#define TILT_VARIANCE 0.1  /* rad2: a normal less certain than this is none */

struct fit {
	struct vec3 normal; /* either way round */
	double variance;    /* along the normal, 1/64 mm2; < 0: no plane */
};

struct frame { /* a window: lines and columns, both ends included */
	uint64_t line0, line1;
	int32_t column0, column1;
};

/* The ten sums of a window about the point `at` (units of the moments). */
static double window_sums(struct raster *raster, const struct frame *w, const uint32_t at[3], double s[3], double q[6])
{
	const struct raster_sums *low = w->line0 ? raster_line(raster, w->line0 - 1)->sum : raster->zero;
	const struct raster_sums *high = raster_line(raster, w->line1)->sum;
	const struct raster_sums *a = &high[w->column1 + 1], *b = &high[w->column0];
	const struct raster_sums *c = &low[w->column1 + 1], *d = &low[w->column0];
	static const uint8_t first[6] = {0, 0, 0, 1, 1, 2}, second[6] = {0, 1, 2, 1, 2, 2};
	uint32_t n = a->n - b->n - c->n + d->n;
	uint64_t m[3], p[3]; /* sums, centre */

	for (int i = 0; i < 3; i++) {
		/* the sum about the centre fits 32 bits; the sum itself is rebuilt from it in 64 */
		int32_t centred = (int32_t)(a->s[i] - b->s[i] - c->s[i] + d->s[i] - n * at[i]);

		s[i] = centred;
		p[i] = (uint64_t)(int32_t)at[i];
		m[i] = (uint64_t)(int64_t)centred;
	}
	for (int i = 0; i < 6; i++) {
		int f = first[i], g = second[i];
		uint64_t sum = a->q[i] - b->q[i] - c->q[i] + d->q[i];

		/* sum (x - px)(y - py) = sum xy - px sum(y - py) - py sum(x - px) - n px py */
		q[i] = (double)(int64_t)(sum - p[f] * m[g] - p[g] * m[f] - n * p[f] * p[g]);
	}
	return n;
}

/* Least root of x^3 - c2 x^2 + c1 x - c0, the characteristic polynomial of a matrix without negative eigenvalues.
 * Newton's steps from 0; the third no longer moves a normal. */
static double least_root(double c2, double c1, double c0)
{
	double x = c0 / c1;

	for (int i = 0; i < 2; i++) {
		double slope = (3 * x - 2 * c2) * x + c1;

		if (!(slope > 1e-9 * c1))
			break;
		x -= (((x - c2) * x + c1) * x - c0) / slope;
	}
	return x > 0 ? x : 0;
}

static struct vec3 longest(struct vec3 a, struct vec3 b)
{
	return vec3_dot(a, a) >= vec3_dot(b, b) ? a : b;
}

/* No plane: fewer than four points, points on a line, or a slope that the scatter leaves open. */
static struct fit fit_sums(double n, const double s[3], const double q[6])
{
	const double per_n = 1 / n, mx = s[0] * per_n, my = s[1] * per_n, mz = s[2] * per_n;
	double xx = q[0] - s[0] * mx, xy = q[1] - s[0] * my, xz = q[2] - s[0] * mz;
	double yy = q[3] - s[1] * my, yz = q[4] - s[1] * mz, zz = q[5] - s[2] * mz;
	double c2 = xx + yy + zz;
	double c1 = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz;
	double c0 = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz);
	const struct fit none = {.variance = -1};
	double least;

	if (!(c1 > LINE_RATIO * c2 * c2))
		return none;
	least = least_root(c2, c1, c0);
	/* the slope's variance is that of the scatter over n times the second eigenvalue, which c1 / c2 bounds from below */
	if (least * c2 > TILT_VARIANCE * (n - 3) * c1)
		return none;
	struct vec3 x = {xx - least, xy, xz}, y = {xy, yy - least, yz}, z = {xz, yz, zz - least};
	struct vec3 v = longest(longest(vec3_cross(x, y), vec3_cross(y, z)), vec3_cross(z, x));
	double length = vec3_norm(v);

	if (!(length > 0))
		return none;
	return (struct fit){.normal = vec3_scale(v, 1 / length), .variance = least / (n - 3)};
}

static struct fit fit_window(struct raster *raster, const struct frame *w, const uint32_t at[3])
{
	double s[3], q[6];
	double n = window_sums(raster, w, at, s, q);

	return n >= 4 ? fit_sums(n, s, q) : (struct fit){.variance = -1};
}

static struct fit better(struct fit a, struct fit b)
{
	if (b.variance < 0)
		return a;
	return a.variance < 0 || b.variance < a.variance ? b : a;
}

/* How many neighbours at this squared spacing lie within reach. */
static int half_width(float spacing_m2)
{
	double ratio2 = REACH_M * REACH_M / ((double)spacing_m2 + 1e-9);
	int half = ratio2 >= HALF_MAX * HALF_MAX ? HALF_MAX : (int)sqrt(ratio2);

	return half > 1 ? half : 1;
}

static int lesser(int a, int b)
{
	return a < b ? a : b;
}

struct extent {
	int left, right, up, down;
};

/* How far the window may reach from a beam, jumps and the newest line considered. */
static struct extent extent_of(struct raster *raster, uint64_t number, uint64_t last, int32_t c)
{
	const struct raster_line *line = raster_line(raster, number);
	struct extent e = {.left = line->left[c], .right = line->right[c], .up = line->up[c]};
	float across = 0, along = 0;

	if (e.right)
		across = line->right_m2[c];
	if (e.left && line->right_m2[c - 1] > across)
		across = line->right_m2[c - 1];
	if (e.up)
		along = line->up_m2[c];
	for (uint64_t r = number + 1; r <= last; r++) {
		const struct raster_line *below = raster_line(raster, r);

		if (!(below->flags[c] & RASTER_UP))
			break;
		if (below->up_m2[c] > along)
			along = below->up_m2[c];
		e.down++;
	}
	int columns = half_width(across), lines = half_width(along);

	e.left = lesser(e.left, columns);
	e.right = lesser(e.right, columns);
	e.up = lesser(e.up, lines);
	e.down = lesser(e.down, lines);
	return e;
}

static struct fit fit_beam(struct raster *raster, uint64_t number, int32_t c, const struct extent *e)
{
	const double limit = RESIDUAL_M * UNITS_M * RESIDUAL_M * UNITS_M;
	const double scale = raster->cell_m * UNITS_M;
	const struct vec3 *p = &raster_line(raster, number)->point[c];
	const uint32_t at[3] = {(uint32_t)(int64_t)(p->x * scale), (uint32_t)(int64_t)(p->y * scale),
	                        (uint32_t)(int64_t)(p->z * scale)};
	const struct frame all = {number - (uint64_t)e->up, number + (uint64_t)e->down, c - e->left, c + e->right};
	struct fit fit = fit_window(raster, &all, at);

	if (fit.variance >= 0 && fit.variance <= limit)
		return fit;
	struct frame part[4] = {all, all, all, all};

	part[0].column1 = c;
	part[1].column0 = c;
	part[2].line1 = number;
	part[3].line0 = number;
	for (int i = 0; i < 4; i++)
		fit = better(fit, fit_window(raster, &part[i], at));
	return fit;
}

void raster_normals(struct raster *raster, uint64_t number, uint64_t last)
{
	struct raster_line *line = raster_line(raster, number);

	for (int32_t c = 0; c < raster->width; c++) {
		struct extent e;
		struct fit fit;

		if (!(line->flags[c] & RASTER_POINT))
			continue;
		e = extent_of(raster, number, last, c);
		fit = fit_beam(raster, number, c, &e);
		if (fit.variance < 0)
			continue;
		struct vec3 view =
		    vec3_sub(vec3_scale(raster_beam(line, c)->origin, 1 / raster->cell_m), line->point[c]);
		double sign = vec3_dot(fit.normal, view) < 0 ? -1 : 1;

		line->normal[c][0] = (float)(sign * fit.normal.x);
		line->normal[c][1] = (float)(sign * fit.normal.y);
		line->normal[c][2] = (float)(sign * fit.normal.z);
		line->flags[c] |= RASTER_NORMAL;
	}
}

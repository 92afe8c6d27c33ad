/* Sine, cosine and arc tangent from + - * / and rint alone.
 *
 * libm picks other code paths on other processors: the same binary was seen to give other last bits of sin and atan2
 * with and without FMA, and law L2 wants the same map everywhere. Here the argument is reduced by multiples of pi/2
 * (kept as three numbers, so that the products with up to 2^20 quarters are exact), and Taylor's series does the rest:
 * on [-pi/4, pi/4] its first left-out term is below 1e-18. The arc tangent first turns (x, y) by the nearest of nine
 * directions with tangents 0/8 .. 8/8, exact in binary, after which the series in |u| <= 1/16 needs seven terms. */
#include "core/trig.h"

#include <math.h>

#define HALF_PI_HIGH 0x1.921fb54000000p+0 /* 30 bits each: k * HIGH and k * MID are exact for |k| < 2^20 */
#define HALF_PI_MID  0x1.10b4611800000p-30
#define HALF_PI_LOW  0x1.313198a2e0370p-61

static double series_sin(double x)
{
	double z = x * x;
	double s = 1.0 / 355687428096000.0; /* 1/17! */

	s = s * z - 1.0 / 1307674368000.0;
	s = s * z + 1.0 / 6227020800.0;
	s = s * z - 1.0 / 39916800.0;
	s = s * z + 1.0 / 362880.0;
	s = s * z - 1.0 / 5040.0;
	s = s * z + 1.0 / 120.0;
	s = s * z - 1.0 / 6.0;
	return x + x * (z * s);
}

static double series_cos(double x)
{
	double z = x * x;
	double s = 1.0 / 20922789888000.0; /* 1/16! */

	s = s * z - 1.0 / 87178291200.0;
	s = s * z + 1.0 / 479001600.0;
	s = s * z - 1.0 / 3628800.0;
	s = s * z + 1.0 / 40320.0;
	s = s * z - 1.0 / 720.0;
	s = s * z + 1.0 / 24.0;
	return 1 - (0.5 * z - z * z * s);
}

/* sin(rad + quarters * pi/2) */
static double sine_of(double rad, int quarters)
{
	if (!(fabs(rad) <= TRIG_ANGLE_MAX))
		return NAN;
	double k = rint(rad * (2 / TRIG_PI));
	double x = ((rad - k * HALF_PI_HIGH) - k * HALF_PI_MID) - k * HALF_PI_LOW;

	switch (((int)k + quarters) & 3) {
	case 0:
		return series_sin(x);
	case 1:
		return series_cos(x);
	case 2:
		return -series_sin(x);
	default:
		return -series_cos(x);
	}
}

double trig_sin(double rad)
{
	return sine_of(rad, 0);
}

double trig_cos(double rad)
{
	return sine_of(rad, 1);
}

/* atan(y / x) for 0 <= y <= x, x > 0 */
static double first_octant(double y, double x)
{
	static const double eighths[9] = {
	    0,
	    0x1.fd5ba9aac2f6ep-4,
	    0x1.f5b75f92c80ddp-3,
	    0x1.6f61941e4def1p-2,
	    0x1.dac670561bb4fp-2,
	    0x1.1e00babdefeb4p-1,
	    0x1.4978fa3269ee1p-1,
	    0x1.700a7c5784634p-1,
	    0x1.921fb54442d18p-1,
	}; /* atan(i / 8) */
	int i = (int)(8 * (y / x) + 0.5);
	double c = i / 8.0;
	double u = (y - c * x) / (x + c * y);
	double z = u * u;
	double s = 1.0 / 13.0;

	s = s * z - 1.0 / 11.0;
	s = s * z + 1.0 / 9.0;
	s = s * z - 1.0 / 7.0;
	s = s * z + 1.0 / 5.0;
	s = s * z - 1.0 / 3.0;
	return eighths[i] + (u + u * (z * s));
}

double trig_atan2(double y, double x)
{
	double ay = fabs(y), ax = fabs(x);
	double a;

	if (ay == 0 && ax == 0)
		return 0;
	if (!(ax <= 1e300) || !(ay <= 1e300))
		return NAN;
	a = ay <= ax ? first_octant(ay, ax) : TRIG_PI / 2 - first_octant(ax, ay);
	if (x < 0)
		a = TRIG_PI - a;
	return y < 0 ? -a : a;
}

/* Own sine, cosine and arc tangent: the same bits with every compiler, libm and machine (law L2).
 * Absolute error <= 1e-15 against libm for |x| <= 100 rad. */
#ifndef FACET_CORE_TRIG_H
#define FACET_CORE_TRIG_H

#define TRIG_PI        3.14159265358979323846
#define TRIG_DEG       (TRIG_PI / 180.0)
#define TRIG_ANGLE_MAX 1.0e6 /* rad; beyond it sine and cosine are not a number rather than a wrong one */

double trig_sin(double rad);
double trig_cos(double rad);
double trig_atan2(double y, double x); /* (-pi, pi]; 0 for (0, 0) */

#endif

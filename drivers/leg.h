/* One leg of a servo's way as a function of time: pure (set-points for cyclic drives, see sweeper.h). Angles in rad, times
 * in seconds since the leg began; every leg ends at a stand. */
#ifndef FACET_DRIVERS_LEG_H
#define FACET_DRIVERS_LEG_H

struct leg {
	enum { LEG_HOLD, LEG_RAMPS, LEG_SINUS, LEG_BRAKE } kind;
	double from_rad, to_rad;
	double speed_rad_s; /* highest; BRAKE: at its begin, signed */
	double acceleration_rad_s2;
	double lasts_s;
};

/* Stands for so long. */
struct leg leg_hold(double at_rad, double lasts_s);

/* From a stand to a stand: speed up evenly, go evenly, slow down evenly. Speed and acceleration are positive. */
struct leg leg_ramps(double from_rad, double to_rad, double speed_rad_s, double acceleration_rad_s2);

/* Half a period of a sine, slower than its peak speed where the acceleration at its ends would be too high. */
struct leg leg_sinus(double from_rad, double to_rad, double peak_rad_s, double acceleration_rad_s2);

/* From a (signed) speed to a stand. */
struct leg leg_brake(double from_rad, double speed_rad_s, double acceleration_rad_s2);

/* Angle and signed speed at a time; before its begin and after its end it stands. */
double leg_at(const struct leg *, double t_s, double *ret_rad_s);

#endif

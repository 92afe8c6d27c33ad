/* Lines of a CARMEN log (carmen.sourceforge.net, logger): one message a line, its name first, and at its end the time of the
 * message, the host that sent it and the logger's own time.
 *
 *   FLASER n r..  x y theta  odom_x odom_y odom_theta  T host t      the old form; front (RLASER: rear)
 *   ROBOTLASER1 type start fov step max accuracy mode  n r..  m remission..  laser pose (3)  robot pose (3)  tv rv 3 safeties  T host t
 *   RAWLASER1   type start fov step max accuracy mode  n r..  m remission..  T host t
 *   ODOM x y theta tv rv acceleration  T host t
 *   PANTILT pan tilt  T host t
 *
 * Metres, radians; beams from right to left, 0 straight ahead. Old logs have SICK's error codes as ranges (81.83 .. 81.91).
 * Some were printed with 6 digits, so that a time of the year 2005 is off by minutes (1.13486e+09): `coarse`. Pure. */
#ifndef FACET_CORE_CARMEN_LINES_H
#define FACET_CORE_CARMEN_LINES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "core/types.h"

#define CARMEN_NAME_MAX 16
#define CARMEN_CODES_M  81.8 /* ranges from here on are codes of errors */

enum carmen_kind {
	CARMEN_LASER,
	CARMEN_ODOM,
	CARMEN_PANTILT,
	CARMEN_OTHER, /* blank, a comment, a message that is none of these */
	CARMEN_BAD    /* one of these, but cut, or with impossible counts */
};

struct carmen_line {
	char name[CARMEN_NAME_MAX];
	double time_s, logger_s; /* of the message; the logger's, from its start */
	bool coarse;             /* time_s has lost its digits */

	/* LASER */
	uint32_t n;
	double first_rad, step_rad, max_range_m; /* the latter 0: not said */
	float range_m[PROFILE_BEAMS_MAX];

	/* ODOM, and LASER where has_pose: of the robot */
	bool has_pose;
	double x_m, y_m, theta_rad;

	double pan_rad, tilt_rad; /* PANTILT */
};

/* One line, with or without its end. Of `ret` is filled what the kind names. */
enum carmen_kind carmen_read(const char *line, size_t len, struct carmen_line *ret);

#endif

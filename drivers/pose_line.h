/* A pose as somebody else's program says it: one JSON object per datagram, at most 2048 bytes.
 *
 *   {"t": 1732200000.123456, "position": [x, y, z], "orientation": [x, y, z, w], "covariance": [...]}
 *
 *   t            seconds of CLOCK_REALTIME on this host when the robot was there; absent: when the datagram arrived
 *   position     metres, map frame: where the base frame stands
 *   orientation  unit quaternion, the real part last (as ROS writes it), map <- base
 *
 *   covariance   how good it is: the 36 numbers of ROS's PoseWithCovariance (6 x 6, row by row, of x, y, z and the turns
 *                about x, y, z; m2, m rad, rad2), or the 6 of its diagonal. Weighed against odometry, where there is one:
 *                x, y and the turn about z count. Absent, all zero, or -1 first (ROS: not known): the pose is taken whole
 *
 * Other keys are left alone, so that a sender may say more than is needed here. Refused, each counted for itself: what is
 * no such object; numbers that are not finite; positions beyond POSE_LINE_FAR_M from the map's origin; quaternions whose
 * length is not 1 within 1 in 1000 (it is then made exactly 1); times more than a second away from the arrival; covariances
 * that are none. Pure. */
#ifndef FACET_DRIVERS_POSE_LINE_H
#define FACET_DRIVERS_POSE_LINE_H

#include <stddef.h>
#include <stdint.h>

#include "core/types.h"

#define POSE_LINE_MAX     2048     /* bytes; a longer datagram is refused before it is parsed */
#define POSE_LINE_FAR_M   100000.0 /* along each axis */
#define POSE_LINE_LATE_NS INT64_C(1000000000)

enum pose_line_verdict {
	POSE_LINE_OK,
	POSE_LINE_LONG,       /* more than POSE_LINE_MAX bytes */
	POSE_LINE_MALFORMED,  /* not this JSON object */
	POSE_LINE_FAR,        /* position not finite or too far away */
	POSE_LINE_NOT_UNIT,   /* orientation is no unit quaternion */
	POSE_LINE_TIME,       /* t is more than a second from the arrival */
	POSE_LINE_COVARIANCE, /* no covariance: its length, a number that is none, a negative square */
	POSE_LINE_VERDICTS
};

/* `t_ns` is the arrival. *ret is untouched unless POSE_LINE_OK. */
enum pose_line_verdict pose_line_parse(const char *text, size_t len, int64_t t_ns, struct pose *ret);

/* Writes the same line, for senders: its length without the closing 0, or -ENOSPC. With its variances, if it has any. */
int pose_line_print(const struct pose *, char *ret, size_t cap);

const char *pose_line_name(enum pose_line_verdict);

#endif

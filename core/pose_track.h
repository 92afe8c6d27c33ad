/* The robot's track: absolute poses (somebody's localisation) and motions (its wheels) in, the poses that place the beams
 * out, with how sure they are, and the jumps of the map under the robot.
 *
 * Without odometry absolute poses pass unchanged. With it the track is reckoned from motion to motion in the plane (x, y,
 * heading; height, roll and pitch are those of the last absolute pose), its covariance grows with the way, and an absolute
 * pose of time t, late ones too, corrects the track from t on: whole where it says no variance, else weighted with the
 * track's own. Time only comes in with poses and motions. */
#ifndef FACET_CORE_POSE_TRACK_H
#define FACET_CORE_POSE_TRACK_H

#include "core/state.h"
#include "core/types.h"

enum pose_track_on_jump {
	POSE_TRACK_KEEP,   /* the track follows: the pose is marked `jumped` */
	POSE_TRACK_IGNORE, /* this and later poses are expressed in the frame before the jump */
	POSE_TRACK_NEW_MAP /* as KEEP; what comes is another map */
};

struct pose_track_params {
	bool motion;             /* there is odometry */
	bool absolute;           /* somebody may send absolute poses: the track waits a little for the first one */
	double drift;            /* sigma of a way after one metre, m; it grows with the root of the way */
	double turn_drift_rad;   /* sigma of the heading after one metre, or after one radian turned; likewise */
	double jump_m, jump_rad; /* farther from where the motion leads is a jump; 0: nothing is one */
	enum pose_track_on_jump on_jump;
};

struct pose_jump {
	int64_t t_ns; /* of the pose that jumped */
	double distance_m, angle_rad;
	enum pose_track_on_jump done;
	bool back; /* it leads back to where the jump before came from */
};

struct pose_track_out {
	bool has_pose, has_jump;
	struct pose pose; /* times only rise, unless time itself was set back by seconds */
	struct pose_jump jump;
};

struct pose_track;
struct pose_track *pose_track_create(const struct pose_track_params *); /* NULL when memory is out */
void pose_track_destroy(struct pose_track *);

void pose_track_absolute(struct pose_track *, const struct pose *, struct pose_track_out *ret);
void pose_track_motion(struct pose_track *, const struct motion *, struct pose_track_out *ret);

struct pose_track_status {
	bool known;        /* a pose was handed out */
	bool sure;         /* the two below mean something: somebody said a variance, or there is odometry */
	double sigma_m;    /* of the position, along the axis where it is worst */
	double sigma_rad;  /* of the heading */
	uint64_t jumps;    /* all of them */
	uint64_t late;     /* absolute poses older than another, or than anything remembered */
	uint64_t refused;  /* motions that no robot makes */
	uint64_t gaps;     /* silences of the odometry across which nothing was reckoned */
	uint64_t adjusted; /* absolute poses that corrected the track */
};
void pose_track_status(const struct pose_track *, struct pose_track_status *ret);

/* Snapshot of all but the parameters. A load that failed leaves the track as new. */
void pose_track_state(struct state *, struct pose_track *);

#endif

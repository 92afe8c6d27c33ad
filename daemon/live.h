/* What the robot measures now: the newest profile of each scanner, angle, pose, and the last lines of the log. Filled from the
 * pipeline's taps, read by whoever shows it (daemon/foxglove, the recording of messages); each reader remembers the sequence
 * number it showed last, so a slow one skips to the newest and nothing waits. One thread, no clock. */
#ifndef FACET_DAEMON_LIVE_H
#define FACET_DAEMON_LIVE_H

#include "config/config.h"
#include "core/types.h"

#define LIVE_LINES    64  /* lines of the log that are kept; a reader who is slower misses the older ones */
#define LIVE_LINE_MAX 400 /* longer ones are cut */

struct live;
struct live *live_create(const struct config *); /* borrowed; NULL when memory is out */
void live_destroy(struct live *);

/* Called after every tap: somebody may have news. One listener. */
void live_listen(struct live *, void (*changed)(void *ctx), void *ctx);

/* Taps; `device` is an index into config->device. Copied. */
void live_profile(struct live *, int device, const struct profile *);
void live_tilt(struct live *, int device, const struct tilt *);
void live_pose(struct live *, const struct pose *);
/* `priority` as of syslog; text may be any bytes. */
void live_log(struct live *, int64_t t_ns, int priority, const char *text);
/* Time goes back (a replay seeks): nothing is known any more, but the lines of the log. */
void live_reset(struct live *);

/* Scanners, in the order of the configuration. Frames are called `tilt` and `laser` where there is one, else
 * `tilt_NAME` and `laser_NAME`. */
#define LIVE_FRAME_MAX (CONFIG_NAME_MAX + 8)
struct live_scanner {
	int device;
	const char *name; /* of the device */
	char tilt_frame[LIVE_FRAME_MAX], laser_frame[LIVE_FRAME_MAX];
	uint64_t sequence; /* of the newest profile; 0: none came yet */
	struct profile profile;
};
int live_scanners(const struct live *);
const struct live_scanner *live_scanner(const struct live *, int i);

/* The newest pose of the robot (a fixed one from the start); false: not known yet. */
bool live_pose_now(const struct live *, struct pose *ret, uint64_t *ret_sequence);

/* parent <- child, as known now: map <- base, and for each scanner base <- tilt (with the angle in it), tilt <- laser. What is
 * not known yet is left out. */
struct live_transform {
	int64_t t_ns; /* of the measurement; 0: it is mounted so */
	char parent[LIVE_FRAME_MAX], child[LIVE_FRAME_MAX];
	struct vec3 translation_m;
	struct quat rotation;
};
#define LIVE_TRANSFORMS_MAX (1 + 2 * CONFIG_DEVICES_MAX)
int live_transforms(const struct live *, struct live_transform ret[LIVE_TRANSFORMS_MAX]);
uint64_t live_transforms_sequence(const struct live *); /* goes up when one of them changed */

struct live_line {
	int64_t t_ns;
	int priority;
	const char *text; /* UTF-8 */
};
uint64_t live_lines(const struct live *); /* lines that ever came; the last one has this number, the first 1 */
/* Line `number`; false where it is too old or has not come yet. */
bool live_line(const struct live *, uint64_t number, struct live_line *ret);

#endif

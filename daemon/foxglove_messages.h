/* What the robot measures, as messages in the schemas that Foxglove reads: JSON text or protobuf bytes. Pure. The map's
 * messages are core/scene.h. */
#ifndef FACET_DAEMON_FOXGLOVE_MESSAGES_H
#define FACET_DAEMON_FOXGLOVE_MESSAGES_H

#include "core/scene.h"
#include "daemon/live.h"

/* Each appends one whole message. */

/* LaserScan: every beam at its bearing, in `frame`; 0 m where the beam saw nothing. Remission, where the device sends it, as the
 * device counts. Of an interlaced profile, too: beams are in the order of their bearings. */
void foxglove_put_scan(struct buffer *, enum scene_encoding, const struct profile *, const char *frame);

/* FrameTransforms; one whose time is 0 gets `t_ns`. */
void foxglove_put_transforms(struct buffer *, enum scene_encoding, const struct live_transform *, int n, int64_t t_ns);

/* PoseInFrame: the robot in the map. */
void foxglove_put_pose(struct buffer *, enum scene_encoding, const struct pose *);

/* Log, of `facetd`. */
void foxglove_put_log(struct buffer *, enum scene_encoding, const struct live_line *);

#endif

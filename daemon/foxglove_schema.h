/* The schemas of the messages that Foxglove reads, as data: their JSON Schema texts and their protobuf descriptors are both made
 * from one table of fields. Pure. */
#ifndef FACET_DAEMON_FOXGLOVE_SCHEMA_H
#define FACET_DAEMON_FOXGLOVE_SCHEMA_H

#include "core/model.h"

enum foxglove_schema {
	FOXGLOVE_SCENE_UPDATE,
	FOXGLOVE_LASER_SCAN,
	FOXGLOVE_FRAME_TRANSFORMS,
	FOXGLOVE_POSE_IN_FRAME,
	FOXGLOVE_LOG,
	FOXGLOVE_SCHEMAS
};

const char *foxglove_schema_name(enum foxglove_schema); /* "foxglove.SceneUpdate", ... */

/* A JSON Schema, all parts written out in place (readers follow no references). */
void foxglove_schema_json(struct buffer *, enum foxglove_schema);

/* A serialised google.protobuf.FileDescriptorSet: a file for each message it needs, those a file imports before it. As
 * it is for MCAP; over a WebSocket in base64. */
void foxglove_schema_protobuf(struct buffer *, enum foxglove_schema);

#endif

/* One table of messages, two ways to write it down.
 *
 *   FileDescriptorSet    file = 1
 *   FileDescriptorProto  name = 1, package = 2, dependency = 3, message_type = 4, syntax = 12
 *   DescriptorProto      name = 1, field = 2, enum_type = 4
 *   FieldDescriptorProto name = 1, number = 3, label = 4 (1 optional, 3 repeated), type = 5, type_name = 6, json_name = 10
 *   EnumDescriptorProto  name = 1, value = 2 (name = 1, number = 2)
 *
 * (source: google/protobuf/descriptor.proto). Names, numbers and types are those of Foxglove's published schemas, so that
 * programs which know them by name find what they expect; one file a message, called as there, because readers merge
 * the files of several channels by name. In JSON, times are objects {sec, nsec} and enumerations their numbers. */
#include "daemon/foxglove_schema.h"

#include <assert.h>
#include <stdio.h>
#include <string.h>

#include "core/protobuf.h"

/* Numbers of FieldDescriptorProto.Type; the last three are shown as messages. */
enum kind { DOUBLE = 1, INT64 = 3, INT32 = 5, FIXED32 = 7, BOOL = 8, STRING = 9, MESSAGE = 11, BYTES = 12, ENUM = 14 };

enum message {
	M_TIMESTAMP,
	M_DURATION,
	M_VECTOR3,
	M_QUATERNION,
	M_POINT3,
	M_POSE,
	M_COLOR,
	M_KEY_VALUE,
	M_ARROW,
	M_CUBE,
	M_SPHERE,
	M_CYLINDER,
	M_LINE,
	M_TRIANGLES,
	M_TEXT,
	M_MODEL,
	M_DELETION,
	M_ENTITY,
	M_SCENE_UPDATE,
	M_LASER_SCAN,
	M_TRANSFORM,
	M_TRANSFORMS,
	M_POSE_IN_FRAME,
	M_LOG,
	MESSAGES
};

struct field {
	const char *name;
	enum kind kind;
	uint8_t message; /* of a MESSAGE */
	bool repeated;
};

#define FIELDS_MAX 14
#define VALUES_MAX 6

/* Fields are numbered from 1 in the order of the table; values of an enumeration from 0. */
struct shape {
	const char *package, *name;
	struct field field[FIELDS_MAX + 1]; /* ends with a NULL name */
	const char *enumeration;            /* of its only ENUM field */
	const char *value[VALUES_MAX + 1];
};

#define MANY(name, message)                      \
	{                                        \
		(name), MESSAGE, (message), true \
	}
#define ONE(name, message)                        \
	{                                         \
		(name), MESSAGE, (message), false \
	}
#define PLAIN(name, kind)                \
	{                                \
		(name), (kind), 0, false \
	}
#define PLAIN_MANY(name, kind)          \
	{                               \
		(name), (kind), 0, true \
	}
#define TIME   ONE("timestamp", M_TIMESTAMP)
#define FRAME  PLAIN("frame_id", STRING)
#define POSE   ONE("pose", M_POSE)
#define COLOR  ONE("color", M_COLOR)
#define GOOGLE "google.protobuf"

static const struct shape shapes[MESSAGES] = {
    [M_TIMESTAMP] = {GOOGLE, "Timestamp", {PLAIN("seconds", INT64), PLAIN("nanos", INT32)}, NULL, {NULL}},
    [M_DURATION] = {GOOGLE, "Duration", {PLAIN("seconds", INT64), PLAIN("nanos", INT32)}, NULL, {NULL}},
    [M_VECTOR3] = {"foxglove", "Vector3", {PLAIN("x", DOUBLE), PLAIN("y", DOUBLE), PLAIN("z", DOUBLE)}, NULL, {NULL}},
    [M_QUATERNION] = {"foxglove",
                      "Quaternion",
                      {PLAIN("x", DOUBLE), PLAIN("y", DOUBLE), PLAIN("z", DOUBLE), PLAIN("w", DOUBLE)},
                      NULL,
                      {NULL}},
    [M_POINT3] = {"foxglove", "Point3", {PLAIN("x", DOUBLE), PLAIN("y", DOUBLE), PLAIN("z", DOUBLE)}, NULL, {NULL}},
    [M_POSE] = {"foxglove", "Pose", {ONE("position", M_VECTOR3), ONE("orientation", M_QUATERNION)}, NULL, {NULL}},
    [M_COLOR] = {"foxglove",
                 "Color",
                 {PLAIN("r", DOUBLE), PLAIN("g", DOUBLE), PLAIN("b", DOUBLE), PLAIN("a", DOUBLE)},
                 NULL,
                 {NULL}},
    [M_KEY_VALUE] = {"foxglove", "KeyValuePair", {PLAIN("key", STRING), PLAIN("value", STRING)}, NULL, {NULL}},
    [M_ARROW] = {"foxglove",
                 "ArrowPrimitive",
                 {POSE, PLAIN("shaft_length", DOUBLE), PLAIN("shaft_diameter", DOUBLE), PLAIN("head_length", DOUBLE),
                  PLAIN("head_diameter", DOUBLE), COLOR},
                 NULL,
                 {NULL}},
    [M_CUBE] = {"foxglove", "CubePrimitive", {POSE, ONE("size", M_VECTOR3), COLOR}, NULL, {NULL}},
    [M_SPHERE] = {"foxglove", "SpherePrimitive", {POSE, ONE("size", M_VECTOR3), COLOR}, NULL, {NULL}},
    [M_CYLINDER] = {"foxglove",
                    "CylinderPrimitive",
                    {POSE, ONE("size", M_VECTOR3), PLAIN("bottom_scale", DOUBLE), PLAIN("top_scale", DOUBLE), COLOR},
                    NULL,
                    {NULL}},
    [M_LINE] = {"foxglove",
                "LinePrimitive",
                {PLAIN("type", ENUM), POSE, PLAIN("thickness", DOUBLE), PLAIN("scale_invariant", BOOL),
                 MANY("points", M_POINT3), COLOR, MANY("colors", M_COLOR), PLAIN_MANY("indices", FIXED32)},
                "Type",
                {"LINE_STRIP", "LINE_LOOP", "LINE_LIST"}},
    [M_TRIANGLES] = {"foxglove",
                     "TriangleListPrimitive",
                     {POSE, MANY("points", M_POINT3), COLOR, MANY("colors", M_COLOR), PLAIN_MANY("indices", FIXED32)},
                     NULL,
                     {NULL}},
    [M_TEXT] = {"foxglove",
                "TextPrimitive",
                {POSE, PLAIN("billboard", BOOL), PLAIN("font_size", DOUBLE), PLAIN("scale_invariant", BOOL), COLOR,
                 PLAIN("text", STRING)},
                NULL,
                {NULL}},
    [M_MODEL] = {"foxglove",
                 "ModelPrimitive",
                 {POSE, ONE("scale", M_VECTOR3), COLOR, PLAIN("override_color", BOOL), PLAIN("url", STRING),
                  PLAIN("media_type", STRING), PLAIN("data", BYTES)},
                 NULL,
                 {NULL}},
    [M_DELETION] = {"foxglove",
                    "SceneEntityDeletion",
                    {TIME, PLAIN("type", ENUM), PLAIN("id", STRING)},
                    "Type",
                    {"MATCHING_ID", "ALL"}},
    [M_ENTITY] = {"foxglove",
                  "SceneEntity",
                  {TIME, FRAME, PLAIN("id", STRING), ONE("lifetime", M_DURATION), PLAIN("frame_locked", BOOL),
                   MANY("metadata", M_KEY_VALUE), MANY("arrows", M_ARROW), MANY("cubes", M_CUBE),
                   MANY("spheres", M_SPHERE), MANY("cylinders", M_CYLINDER), MANY("lines", M_LINE),
                   MANY("triangles", M_TRIANGLES), MANY("texts", M_TEXT), MANY("models", M_MODEL)},
                  NULL,
                  {NULL}},
    [M_SCENE_UPDATE] =
        {"foxglove", "SceneUpdate", {MANY("deletions", M_DELETION), MANY("entities", M_ENTITY)}, NULL, {NULL}},
    [M_LASER_SCAN] = {"foxglove",
                      "LaserScan",
                      {TIME, FRAME, POSE, PLAIN("start_angle", DOUBLE), PLAIN("end_angle", DOUBLE),
                       PLAIN_MANY("ranges", DOUBLE), PLAIN_MANY("intensities", DOUBLE)},
                      NULL,
                      {NULL}},
    [M_TRANSFORM] = {"foxglove",
                     "FrameTransform",
                     {TIME, PLAIN("parent_frame_id", STRING), PLAIN("child_frame_id", STRING),
                      ONE("translation", M_VECTOR3), ONE("rotation", M_QUATERNION)},
                     NULL,
                     {NULL}},
    [M_TRANSFORMS] = {"foxglove", "FrameTransforms", {MANY("transforms", M_TRANSFORM)}, NULL, {NULL}},
    [M_POSE_IN_FRAME] = {"foxglove", "PoseInFrame", {TIME, FRAME, POSE}, NULL, {NULL}},
    [M_LOG] = {"foxglove",
               "Log",
               {TIME, PLAIN("level", ENUM), PLAIN("message", STRING), PLAIN("name", STRING), PLAIN("file", STRING),
                PLAIN("line", FIXED32)},
               "Level",
               {"UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL"}},
};

static const struct {
	enum message message;
	const char *name;
} roots[FOXGLOVE_SCHEMAS] = {
    [FOXGLOVE_SCENE_UPDATE] = {M_SCENE_UPDATE, "foxglove.SceneUpdate"},
    [FOXGLOVE_LASER_SCAN] = {M_LASER_SCAN, "foxglove.LaserScan"},
    [FOXGLOVE_FRAME_TRANSFORMS] = {M_TRANSFORMS, "foxglove.FrameTransforms"},
    [FOXGLOVE_POSE_IN_FRAME] = {M_POSE_IN_FRAME, "foxglove.PoseInFrame"},
    [FOXGLOVE_LOG] = {M_LOG, "foxglove.Log"},
};

const char *foxglove_schema_name(enum foxglove_schema schema)
{
	assert(schema < FOXGLOVE_SCHEMAS);
	return roots[schema].name;
}

/* JSON Schema */

static void put_text(struct buffer *b, const char *text)
{
	buffer_append(b, text, strlen(text));
}

static void put_json_message(struct buffer *, enum message);

static void put_json_time(struct buffer *b, const char *title)
{
	buffer_printf(
	    b,
	    "{\"type\":\"object\",\"title\":\"%s\",\"properties\":{\"sec\":{\"type\":\"integer\",\"minimum\":0},"
	    "\"nsec\":{\"type\":\"integer\",\"minimum\":0,\"maximum\":999999999}}}",
	    title);
}

static void put_json_kind(struct buffer *b, const struct field *field)
{
	switch (field->kind) {
	case DOUBLE:
		put_text(b, "{\"type\":\"number\"}");
		break;
	case BOOL:
		put_text(b, "{\"type\":\"boolean\"}");
		break;
	case STRING:
		put_text(b, "{\"type\":\"string\"}");
		break;
	case BYTES:
		put_text(b, "{\"type\":\"string\",\"contentEncoding\":\"base64\"}");
		break;
	case MESSAGE:
		put_json_message(b, (enum message)field->message);
		break;
	case FIXED32:
	case ENUM:
	case INT32:
	case INT64:
		put_text(b, "{\"type\":\"integer\",\"minimum\":0}");
		break;
	}
}

/* Nothing contains itself, so this ends. */
static void put_json_message(struct buffer *b, enum message message)
{
	const struct shape *shape = &shapes[message];

	if (message == M_TIMESTAMP || message == M_DURATION) {
		put_json_time(b, message == M_TIMESTAMP ? "time" : "duration");
		return;
	}
	buffer_printf(b, "{\"title\":\"%s.%s\",\"type\":\"object\",\"properties\":{", shape->package, shape->name);
	for (const struct field *field = shape->field; field->name; field++) {
		buffer_printf(b, "%s\"%s\":", field > shape->field ? "," : "", field->name);
		if (field->repeated)
			put_text(b, "{\"type\":\"array\",\"items\":");
		put_json_kind(b, field);
		if (field->repeated)
			put_text(b, "}");
	}
	put_text(b, "}}");
}

void foxglove_schema_json(struct buffer *b, enum foxglove_schema schema)
{
	assert(schema < FOXGLOVE_SCHEMAS);
	put_json_message(b, roots[schema].message);
}

/* Descriptors */

static void file_name(enum message message, char ret[64])
{
	const struct shape *shape = &shapes[message];

	if (message == M_TIMESTAMP || message == M_DURATION)
		snprintf(ret, 64, "google/protobuf/%s.proto", message == M_TIMESTAMP ? "timestamp" : "duration");
	else
		snprintf(ret, 64, "%s/%s.proto", shape->package, shape->name);
}

static void put_type_name(struct buffer *b, const struct shape *shape, const struct field *field)
{
	char name[64];

	if (field->kind == MESSAGE)
		snprintf(name, sizeof(name), ".%s.%s", shapes[field->message].package, shapes[field->message].name);
	else
		snprintf(name, sizeof(name), ".%s.%s.%s", shape->package, shape->name, shape->enumeration);
	protobuf_string(b, 6, name);
}

/* "frame_id" -> "frameId": what protoc writes for a field, and some readers insist on. */
static void put_json_name(struct buffer *b, const char *name)
{
	char camel[32];
	size_t n = 0;

	for (const char *c = name; *c && n + 1 < sizeof(camel); c++) {
		if (*c == '_' && c[1])
			camel[n++] = (char)(*++c - 'a' + 'A');
		else
			camel[n++] = *c;
	}
	camel[n] = 0;
	protobuf_string(b, 10, camel);
}

static void put_field(struct buffer *b, const struct shape *shape, const struct field *field)
{
	const size_t begun = protobuf_begin(b, 2);

	protobuf_string(b, 1, field->name);
	protobuf_uint(b, 3, (uint64_t)(field - shape->field) + 1);
	protobuf_uint(b, 4, field->repeated ? 3 : 1);
	protobuf_uint(b, 5, field->kind);
	if (field->kind == MESSAGE || field->kind == ENUM)
		put_type_name(b, shape, field);
	put_json_name(b, field->name);
	protobuf_end(b, begun);
}

static void put_enumeration(struct buffer *b, const struct shape *shape)
{
	const size_t begun = protobuf_begin(b, 4);

	protobuf_string(b, 1, shape->enumeration);
	for (unsigned i = 0; shape->value[i]; i++) {
		const size_t value = protobuf_begin(b, 2);

		protobuf_string(b, 1, shape->value[i]);
		protobuf_uint(b, 2, i);
		protobuf_end(b, value);
	}
	protobuf_end(b, begun);
}

static void put_imports(struct buffer *b, const struct shape *shape)
{
	bool named[MESSAGES] = {false};
	char name[64];

	for (const struct field *field = shape->field; field->name; field++) {
		if (field->kind != MESSAGE || named[field->message])
			continue;
		named[field->message] = true;
		file_name((enum message)field->message, name);
		protobuf_string(b, 3, name);
	}
}

static void put_file(struct buffer *b, enum message message)
{
	const struct shape *shape = &shapes[message];
	const size_t file = protobuf_begin(b, 1);
	char name[64];
	size_t type;

	file_name(message, name);
	protobuf_string(b, 1, name);
	protobuf_string(b, 2, shape->package);
	put_imports(b, shape);
	type = protobuf_begin(b, 4);
	protobuf_string(b, 1, shape->name);
	for (const struct field *field = shape->field; field->name; field++)
		put_field(b, shape, field);
	if (shape->enumeration)
		put_enumeration(b, shape);
	protobuf_end(b, type);
	protobuf_string(b, 12, "proto3");
	protobuf_end(b, file);
}

static void put_files(struct buffer *b, enum message message, bool put[MESSAGES])
{
	if (put[message])
		return;
	put[message] = true;
	for (const struct field *field = shapes[message].field; field->name; field++)
		if (field->kind == MESSAGE)
			put_files(b, (enum message)field->message, put);
	put_file(b, message);
}

void foxglove_schema_protobuf(struct buffer *b, enum foxglove_schema schema)
{
	bool put[MESSAGES] = {false};

	assert(schema < FOXGLOVE_SCHEMAS);
	put_files(b, roots[schema].message, put);
}

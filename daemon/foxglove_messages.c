/* Messages of what is measured.
 *
 *   LaserScan        timestamp = 1, frame_id = 2, pose = 3, start_angle = 4, end_angle = 5, ranges = 6, intensities = 7
 *   FrameTransforms  transforms = 1: timestamp = 1, parent_frame_id = 2, child_frame_id = 3, translation = 4, rotation = 5
 *   PoseInFrame      timestamp = 1, frame_id = 2, pose = 3
 *   Log              timestamp = 1, level = 2 (1 debug .. 5 fatal), message = 3, name = 4
 *
 * Ranges in JSON are in millimetres' steps: no scanner says more. A range that is none is 0 in both encodings: JSON has
 * no NaN, and a reader should not have to care which encoding it got. */
#include "daemon/foxglove_messages.h"

#include <stdio.h>
#include <string.h>
#include <syslog.h>

#include "core/protobuf.h"

#define NAME "facetd"

static const struct quat no_rotation = {1, 0, 0, 0};

static void put_text(struct buffer *b, const char *text)
{
	buffer_append(b, text, strlen(text));
}

static void json_time(struct buffer *b, int64_t t_ns)
{
	const int64_t second_ns = 1000000000, seconds = t_ns / second_ns - (t_ns % second_ns < 0);

	buffer_printf(b, "{\"sec\":%lld,\"nsec\":%lld}", (long long)seconds, (long long)(t_ns - seconds * second_ns));
}

static void json_string(struct buffer *b, const char *text)
{
	put_text(b, "\"");
	for (const char *c = text; *c; c++) {
		if (*c == '"' || *c == '\\')
			buffer_printf(b, "\\%c", *c);
		else if ((unsigned char)*c < ' ')
			buffer_printf(b, "\\u%04x", *c);
		else
			buffer_append(b, c, 1);
	}
	put_text(b, "\"");
}

static void json_vector(struct buffer *b, struct vec3 v)
{
	buffer_printf(b, "{\"x\":%.9g,\"y\":%.9g,\"z\":%.9g}", v.x, v.y, v.z);
}

static void json_quat(struct buffer *b, struct quat q)
{
	buffer_printf(b, "{\"x\":%.9g,\"y\":%.9g,\"z\":%.9g,\"w\":%.9g}", q.x, q.y, q.z, q.w);
}

static void json_pose(struct buffer *b, struct vec3 position, struct quat rotation)
{
	put_text(b, "{\"position\":");
	json_vector(b, position);
	put_text(b, ",\"orientation\":");
	json_quat(b, rotation);
	put_text(b, "}");
}

static void protobuf_vector(struct buffer *b, unsigned field, struct vec3 v)
{
	const size_t begun = protobuf_begin(b, field);

	protobuf_double(b, 1, v.x);
	protobuf_double(b, 2, v.y);
	protobuf_double(b, 3, v.z);
	protobuf_end(b, begun);
}

static void protobuf_quat(struct buffer *b, unsigned field, struct quat q)
{
	const size_t begun = protobuf_begin(b, field);

	protobuf_double(b, 1, q.x);
	protobuf_double(b, 2, q.y);
	protobuf_double(b, 3, q.z);
	protobuf_double(b, 4, q.w);
	protobuf_end(b, begun);
}

static void protobuf_pose(struct buffer *b, unsigned field, struct vec3 position, struct quat rotation)
{
	const size_t begun = protobuf_begin(b, field);

	protobuf_vector(b, 1, position);
	protobuf_quat(b, 2, rotation);
	protobuf_end(b, begun);
}

/* Scans */

static double range_of(const struct profile *profile, int i)
{
	return profile->state[i] == BEAM_OK ? (double)profile->range_m[i] : 0;
}

static double last_rad(const struct profile *profile)
{
	return profile->first_rad + (profile->n > 0 ? profile->n - 1 : 0) * profile->step_rad;
}

static void scan_json(struct buffer *b, const struct profile *profile, const char *frame)
{
	char text[32];
	int n;

	put_text(b, "{\"timestamp\":");
	json_time(b, profile->t_ns);
	put_text(b, ",\"frame_id\":");
	json_string(b, frame);
	put_text(b, ",\"pose\":");
	json_pose(b, (struct vec3){0, 0, 0}, no_rotation);
	buffer_printf(b, ",\"start_angle\":%.9g,\"end_angle\":%.9g,\"ranges\":[", profile->first_rad,
	              last_rad(profile));
	for (int i = 0; i < profile->n; i++) {
		const double range = range_of(profile, i);

		n = range > 0 ? snprintf(text, sizeof(text), "%s%.3f", i ? "," : "", range)
		              : snprintf(text, sizeof(text), "%s0", i ? "," : "");
		buffer_append(b, text, (size_t)n);
	}
	put_text(b, "],\"intensities\":[");
	for (int i = 0; profile->has_remission && i < profile->n; i++) {
		n = snprintf(text, sizeof(text), "%s%u", i ? "," : "", profile->remission[i]);
		buffer_append(b, text, (size_t)n);
	}
	put_text(b, "]}");
}

static void scan_protobuf(struct buffer *b, const struct profile *profile, const char *frame)
{
	protobuf_time(b, 1, profile->t_ns);
	protobuf_string(b, 2, frame);
	protobuf_pose(b, 3, (struct vec3){0, 0, 0}, no_rotation);
	protobuf_double(b, 4, profile->first_rad);
	protobuf_double(b, 5, last_rad(profile));
	protobuf_head(b, 6, (size_t)profile->n * 8);
	for (int i = 0; i < profile->n; i++) {
		const double range = range_of(profile, i);

		buffer_append(b, &range, 8);
	}
	if (!profile->has_remission)
		return;
	protobuf_head(b, 7, (size_t)profile->n * 8);
	for (int i = 0; i < profile->n; i++) {
		const double remission = profile->remission[i];

		buffer_append(b, &remission, 8);
	}
}

void foxglove_put_scan(struct buffer *b, enum scene_encoding encoding, const struct profile *profile, const char *frame)
{
	(encoding == SCENE_AS_JSON ? scan_json : scan_protobuf)(b, profile, frame);
}

/* Transforms */

static void transform_json(struct buffer *b, const struct live_transform *transform, int64_t t_ns)
{
	put_text(b, "{\"timestamp\":");
	json_time(b, t_ns);
	put_text(b, ",\"parent_frame_id\":");
	json_string(b, transform->parent);
	put_text(b, ",\"child_frame_id\":");
	json_string(b, transform->child);
	put_text(b, ",\"translation\":");
	json_vector(b, transform->translation_m);
	put_text(b, ",\"rotation\":");
	json_quat(b, transform->rotation);
	put_text(b, "}");
}

static void transform_protobuf(struct buffer *b, const struct live_transform *transform, int64_t t_ns)
{
	const size_t begun = protobuf_begin(b, 1);

	protobuf_time(b, 1, t_ns);
	protobuf_string(b, 2, transform->parent);
	protobuf_string(b, 3, transform->child);
	protobuf_vector(b, 4, transform->translation_m);
	protobuf_quat(b, 5, transform->rotation);
	protobuf_end(b, begun);
}

void foxglove_put_transforms(struct buffer *b, enum scene_encoding encoding, const struct live_transform *transform,
                             int n, int64_t t_ns)
{
	const bool json = encoding == SCENE_AS_JSON;

	if (json)
		put_text(b, "{\"transforms\":[");
	for (int i = 0; i < n; i++) {
		const int64_t at_ns = transform[i].t_ns ? transform[i].t_ns : t_ns;

		if (json && i > 0)
			put_text(b, ",");
		(json ? transform_json : transform_protobuf)(b, &transform[i], at_ns);
	}
	if (json)
		put_text(b, "]}");
}

void foxglove_put_pose(struct buffer *b, enum scene_encoding encoding, const struct pose *pose)
{
	if (encoding == SCENE_AS_PROTOBUF) {
		protobuf_time(b, 1, pose->t_ns);
		protobuf_string(b, 2, SCENE_FRAME);
		protobuf_pose(b, 3, pose->position_m, pose->rotation);
		return;
	}
	put_text(b, "{\"timestamp\":");
	json_time(b, pose->t_ns);
	put_text(b, ",\"frame_id\":\"" SCENE_FRAME "\",\"pose\":");
	json_pose(b, pose->position_m, pose->rotation);
	put_text(b, "}");
}

/* Log */

static int level_of(int priority)
{
	static const int level[] = {5, 5, 5, 4, 3, 2, 2, 1}; /* LOG_EMERG .. LOG_DEBUG */

	return level[LOG_PRI(priority)];
}

void foxglove_put_log(struct buffer *b, enum scene_encoding encoding, const struct live_line *line)
{
	if (encoding == SCENE_AS_PROTOBUF) {
		protobuf_time(b, 1, line->t_ns);
		protobuf_uint(b, 2, (uint64_t)level_of(line->priority));
		protobuf_string(b, 3, line->text);
		protobuf_string(b, 4, NAME);
		return;
	}
	put_text(b, "{\"timestamp\":");
	json_time(b, line->t_ns);
	buffer_printf(b, ",\"level\":%d,\"message\":", level_of(line->priority));
	json_string(b, line->text);
	put_text(b, ",\"name\":\"" NAME "\",\"file\":\"\",\"line\":0}");
}

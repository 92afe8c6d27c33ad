/* Law: the messages of what is measured are what the schemas say, in both encodings; frames hang together as the
 * configuration mounts them. protoc, which knows our descriptors only, reads what we write. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/wait.h>
#include <syslog.h>
#include <unistd.h>

#include <cmocka.h>
#include <jansson.h>

#include "daemon/foxglove_messages.h"
#include "daemon/foxglove_schema.h"

#define T_NS 1700000000250000000

static void fan(struct profile *profile)
{
	memset(profile, 0, sizeof(*profile));
	profile->t_ns = T_NS;
	profile->n = 3;
	profile->first_rad = -0.5;
	profile->step_rad = 0.5;
	profile->range_m[0] = 1.5f;
	profile->range_m[1] = 9;
	profile->range_m[2] = 2.0625f;
	profile->state[1] = BEAM_DAZZLED;
}

static const struct pose pose = {.t_ns = T_NS, .position_m = {1, -2, 0.5}, .rotation = {0.5, -0.5, 0.5, -0.5}};
static const struct live_transform transforms[] = {
    {.t_ns = T_NS, .parent = "map", .child = "base", .translation_m = {1, 2, 3}, .rotation = {1, 0, 0, 0}},
    {.t_ns = 0, .parent = "tilt", .child = "laser", .rotation = {0, 0, 1, 0}}};
static const struct live_line line = {T_NS, LOG_WARNING, "it \"says\"\n"};

static void put_message(struct buffer *b, enum scene_encoding encoding, enum foxglove_schema schema)
{
	static struct profile profile;
	struct patch *patch = patch_allocate((struct patch_key){1, -2, 3}, 0, 0, 0);

	fan(&profile);
	profile.has_remission = true;
	profile.remission[2] = 258;
	if (schema == FOXGLOVE_SCENE_UPDATE)
		scene_put_update(b, encoding, T_NS, false, &patch, 1, 0.05);
	else if (schema == FOXGLOVE_LASER_SCAN)
		foxglove_put_scan(b, encoding, &profile, "laser");
	else if (schema == FOXGLOVE_FRAME_TRANSFORMS)
		foxglove_put_transforms(b, encoding, transforms, 2, 1500000000);
	else if (schema == FOXGLOVE_POSE_IN_FRAME)
		foxglove_put_pose(b, encoding, &pose);
	else
		foxglove_put_log(b, encoding, &line);
	patch_unref(patch);
}

#define SEC "{\"sec\":1700000000,\"nsec\":250000000}"

static void messages_have_their_golden_text(void **state)
{
	static const char *const golden[FOXGLOVE_SCHEMAS] = {
	    [FOXGLOVE_SCENE_UPDATE] =
	        "{\"deletions\":[{\"timestamp\":" SEC ",\"type\":0,\"id\":\"1,-2,3\"}],\"entities\":[]}",
	    [FOXGLOVE_LASER_SCAN] =
	        "{\"timestamp\":" SEC ",\"frame_id\":\"laser\",\"pose\":{\"position\":{\"x\":0,\"y\":0,\"z\":0},"
	        "\"orientation\":{\"x\":0,\"y\":0,\"z\":0,\"w\":1}},\"start_angle\":-0.5,\"end_angle\":0.5,"
	        "\"ranges\":[1.500,0,2.062],\"intensities\":[0,0,258]}",
	    [FOXGLOVE_FRAME_TRANSFORMS] =
	        "{\"transforms\":[{\"timestamp\":" SEC ",\"parent_frame_id\":\"map\",\"child_frame_id\":\"base\","
	        "\"translation\":{\"x\":1,\"y\":2,\"z\":3},\"rotation\":{\"x\":0,\"y\":0,\"z\":0,\"w\":1}},"
	        "{\"timestamp\":{\"sec\":1,\"nsec\":500000000},\"parent_frame_id\":\"tilt\",\"child_frame_id\":"
	        "\"laser\","
	        "\"translation\":{\"x\":0,\"y\":0,\"z\":0},\"rotation\":{\"x\":0,\"y\":1,\"z\":0,\"w\":0}}]}",
	    [FOXGLOVE_POSE_IN_FRAME] =
	        "{\"timestamp\":" SEC ",\"frame_id\":\"map\",\"pose\":{\"position\":{\"x\":1,\"y\":-2,\"z\":0.5},"
	        "\"orientation\":{\"x\":-0.5,\"y\":0.5,\"z\":-0.5,\"w\":0.5}}}",
	    [FOXGLOVE_LOG] = "{\"timestamp\":" SEC ",\"level\":3,\"message\":\"it \\\"says\\\"\\u000a\","
	                     "\"name\":\"facetd\",\"file\":\"\",\"line\":0}",
	};
	struct buffer b = {0};

	(void)state;
	for (int schema = 0; schema < FOXGLOVE_SCHEMAS; schema++) {
		b.len = 0;
		put_message(&b, SCENE_AS_JSON, (enum foxglove_schema)schema);
		buffer_append(&b, "", 1);
		assert_string_equal((char *)b.data, golden[schema]);
	}
	buffer_finish(&b);
}

static void messages_have_their_golden_bytes(void **state)
{
	static const char *const golden[FOXGLOVE_SCHEMAS] = {
	    ("0a170a0b0880e2cfaa061080e59a7710001a06312c2d322c33"),
	    ("0a0b0880e2cfaa061080e59a7712056c617365721a430a1b090000000000000000110000000000000000190000000000"
	     "000000122409000000000000000011000000000000000019000000000000000021000000000000f03f21000000000000"
	     "e0bf29000000000000e03f3218000000000000f83f000000000000000000000000008000403a18000000000000000000"
	     "000000000000000000000000207040"),
	    ("0a5b0a0b0880e2cfaa061080e59a7712036d61701a0462617365221b09000000000000f03f1100000000000000401900"
	     "000000000008402a2409000000000000000011000000000000000019000000000000000021000000000000f03f0a5a0a"
	     "0808011080cab5ee01120474696c741a056c61736572221b090000000000000000110000000000000000190000000000"
	     "0000002a2409000000000000000011000000000000f03f190000000000000000210000000000000000"),
	    ("0a0b0880e2cfaa061080e59a7712036d61701a430a1b09000000000000f03f1100000000000000c019000000000000e0"
	     "3f122409000000000000e0bf11000000000000e03f19000000000000e0bf21000000000000e03f"),
	    ("0a0b0880e2cfaa061080e59a7710031a0a6974202273617973220a2206666163657464")};
	struct buffer b = {0};
	char text[2048];

	(void)state;
	for (int schema = 0; schema < FOXGLOVE_SCHEMAS; schema++) {
		b.len = 0;
		put_message(&b, SCENE_AS_PROTOBUF, (enum foxglove_schema)schema);
		for (size_t i = 0; i < b.len; i++)
			snprintf(text + 2 * i, 3, "%02x", b.data[i]);
		assert_string_equal(text, golden[schema]);
	}
	buffer_finish(&b);
}

/* What JSON has, its schema knows, and the other way round; no more is asked of a schema that says no types of lists. */
static void expect_shape(const json_t *schema, const json_t *value)
{
	const char *type = json_string_value(json_object_get(schema, "type")), *key;
	const json_t *properties = json_object_get(schema, "properties");
	json_t *part;

	assert_non_null(type);
	if (strcmp(type, "object") == 0) {
		assert_int_equal(json_object_size(properties), json_object_size(value));
		json_object_foreach((json_t *)(uintptr_t)value, key, part)
		{
			assert_non_null(json_object_get(properties, key));
			expect_shape(json_object_get(properties, key), part);
		}
	} else if (strcmp(type, "array") == 0) {
		assert_true(json_is_array(value));
		for (size_t i = 0; i < json_array_size(value); i++)
			expect_shape(json_object_get(schema, "items"), json_array_get(value, i));
	} else {
		assert_true(strcmp(type, "number") == 0    ? json_is_number(value)
		            : strcmp(type, "integer") == 0 ? json_is_integer(value)
		            : strcmp(type, "boolean") == 0 ? json_is_boolean(value)
		                                           : json_is_string(value));
	}
}

static struct patch *triangle(void)
{
	struct patch *patch = patch_allocate((struct patch_key){0, 0, -1}, 3, 1, 1);

	patch->vertex[1][0] = 4096;
	patch->vertex[2][1] = 4096;
	patch->triangle[0][1] = 1;
	patch->triangle[0][2] = 2;
	patch->run[0] = (struct patch_run){PLANE_NONE, 1, 1};
	patch->t_last_ns = T_NS;
	return patch;
}

static void json_is_as_its_schema_says(void **state)
{
	struct patch *patch = triangle();
	struct buffer b = {0};
	json_error_t error;

	(void)state;
	for (int schema = 0; schema < FOXGLOVE_SCHEMAS; schema++) {
		json_t *message, *text;

		b.len = 0;
		put_message(&b, SCENE_AS_JSON, (enum foxglove_schema)schema);
		if (schema == FOXGLOVE_SCENE_UPDATE) {
			b.len = 0;
			scene_put_update(&b, SCENE_AS_JSON, T_NS, true, &patch, 1, 0.05);
		}
		message = json_loadb((char *)b.data, b.len, JSON_REJECT_DUPLICATES, &error);
		b.len = 0;
		foxglove_schema_json(&b, (enum foxglove_schema)schema);
		text = json_loadb((char *)b.data, b.len, JSON_REJECT_DUPLICATES, &error);
		assert_non_null(text);
		assert_string_equal(json_string_value(json_object_get(text, "title")),
		                    foxglove_schema_name((enum foxglove_schema)schema));
		expect_shape(text, message);
		json_decref(text);
		json_decref(message);
	}
	buffer_finish(&b);
	patch_unref(patch);
}

static void write_file(const char *path, const struct buffer *b)
{
	FILE *file = fopen(path, "w");

	assert_non_null(file);
	assert_int_equal(fwrite(b->data, 1, b->len, file), b->len);
	fclose(file);
}

static void decode(enum foxglove_schema schema, const struct buffer *message, char *ret, size_t cap)
{
	char set[] = "/tmp/facetd-set-XXXXXX", bytes[] = "/tmp/facetd-message-XXXXXX", command[300];
	struct buffer b = {0};
	FILE *pipe;
	size_t n;

	close(mkstemp(set));
	close(mkstemp(bytes));
	foxglove_schema_protobuf(&b, schema);
	write_file(set, &b);
	write_file(bytes, message);
	snprintf(command, sizeof(command), "protoc --descriptor_set_in=%s --decode=%s <%s 2>&1 | tr -s ' \\n' ' '", set,
	         foxglove_schema_name(schema), bytes);
	pipe = popen(command, "r");
	assert_non_null(pipe);
	n = fread(ret, 1, cap - 1, pipe);
	ret[n] = 0;
	pclose(pipe);
	unlink(set);
	unlink(bytes);
	buffer_finish(&b);
}

static void protoc_reads_what_we_write(void **state)
{
	static const char *const said[FOXGLOVE_SCHEMAS] = {
	    [FOXGLOVE_SCENE_UPDATE] =
	        "deletions { timestamp { seconds: 1700000000 nanos: 250000000 } id: \"1,-2,3\" } ",
	    [FOXGLOVE_LASER_SCAN] =
	        "timestamp { seconds: 1700000000 nanos: 250000000 } frame_id: \"laser\" pose { position { } "
	        "orientation { w: 1 } } start_angle: -0.5 end_angle: 0.5 ranges: 1.5 ranges: 0 ranges: 2.0625 "
	        "intensities: 0 intensities: 0 intensities: 258 ",
	    [FOXGLOVE_FRAME_TRANSFORMS] =
	        "transforms { timestamp { seconds: 1700000000 nanos: 250000000 } parent_frame_id: \"map\" "
	        "child_frame_id: \"base\" translation { x: 1 y: 2 z: 3 } rotation { w: 1 } } transforms { timestamp { "
	        "seconds: 1 nanos: 500000000 } parent_frame_id: \"tilt\" child_frame_id: \"laser\" translation { } "
	        "rotation { y: 1 } } ",
	    [FOXGLOVE_POSE_IN_FRAME] =
	        "timestamp { seconds: 1700000000 nanos: 250000000 } frame_id: \"map\" pose { "
	        "position { x: 1 y: -2 z: 0.5 } orientation { x: -0.5 y: 0.5 z: -0.5 w: 0.5 } } ",
	    [FOXGLOVE_LOG] = "timestamp { seconds: 1700000000 nanos: 250000000 } level: WARNING "
	                     "message: \"it \\\"says\\\"\\n\" name: \"facetd\" ",
	};
	struct patch *patch = triangle();
	struct buffer b = {0};
	char text[4096];

	(void)state;
	if (system("protoc --version >/dev/null 2>&1") != 0) {
		print_message("note: protoc is not installed (protobuf-compiler): nobody else has read the bytes\n");
		patch_unref(patch);
		skip();
	}
	for (int schema = 0; schema < FOXGLOVE_SCHEMAS; schema++) {
		b.len = 0;
		put_message(&b, SCENE_AS_PROTOBUF, (enum foxglove_schema)schema);
		decode((enum foxglove_schema)schema, &b, text, sizeof(text));
		assert_string_equal(text, said[schema]);
	}
	b.len = 0;
	scene_put_update(&b, SCENE_AS_PROTOBUF, T_NS, true, &patch, 1, 0.05);
	decode(FOXGLOVE_SCENE_UPDATE, &b, text, sizeof(text));
	assert_string_equal(
	    text, "deletions { timestamp { seconds: 1700000000 nanos: 250000000 } type: ALL } entities { timestamp { "
	          "seconds: 1700000000 nanos: 250000000 } frame_id: \"map\" id: \"0,0,-1\" lifetime { } "
	          "frame_locked: true metadata { key: \"version\" value: \"0\" } triangles { pose { position { } "
	          "orientation { w: 1 } } points { z: -0.8 } points { x: 0.8 z: -0.8 } points { y: 0.8 z: -0.8 } "
	          "color { r: 0.36 g: 0.55 b: 0.42 a: 1 } indices: 0 indices: 1 indices: 2 } } ");
	buffer_finish(&b);
	patch_unref(patch);
}

/* Live */

static const char one[] =
    "mount: {base_tilt: {xyz: [0.2, 0, 0.4], rpy: [0, 0, 90deg]}, tilt_laser: {xyz: [0, 0, 0.05]}}\n"
    "devices:\n"
    "  - {name: front, driver: lms2xx, port: /dev/null, tilt: servo}\n"
    "  - {name: servo, driver: modbus, connect: /dev/zero, position: {address: 0, scale: 1deg}}\n"
    "  - {name: pose, driver: pose, listen: unix:/tmp/facetd-none.sock}\n";
static const char two[] = "devices:\n"
                          "  - {name: a, driver: lms2xx, port: /dev/null, tilt: 10deg}\n"
                          "  - {name: b, driver: lms2xx, port: /dev/zero}\n"
                          "  - {name: pose, driver: pose, fixed: {xyz: [5, 6, 7], rpy: [0, 0, 180deg]}}\n";

static void read_config(const char *yaml, struct config *ret)
{
	struct config_error error;

	if (config_read(yaml, strlen(yaml), "test", ret, &error) < 0)
		fail_msg("%s", error.text);
}

/* The point of frame `from` in the map, by the transforms that are told. */
static struct vec3 in_map(const struct live_transform *t, int n, const char *from, struct vec3 point)
{
	while (strcmp(from, "map") != 0) {
		int i = 0;

		while (i < n && strcmp(t[i].child, from) != 0)
			i++;
		assert_true(i < n);
		const struct transform transform = transform_quat(t[i].translation_m, t[i].rotation);

		point = transform_point(&transform, point);
		from = t[i].parent;
	}
	return point;
}

/* A beam ends where the assembler's arithmetic puts it, whatever the angle and the pose. */
static void frames_put_a_beam_where_the_assembler_does(void **state)
{
	struct live_transform t[LIVE_TRANSFORMS_MAX];
	struct sweep_params params;
	struct config config;
	struct live *live;

	(void)state;
	read_config(one, &config);
	config_sweep_params(&config, 0, &params);
	live = live_create(&config);
	assert_int_equal(live_transforms(live, t), 1); /* nothing is known yet but how the laser is mounted */
	for (int i = -180; i <= 180; i += 15) {
		const struct tilt tilt = {T_NS + i, i * 0.0174532925199433};
		const struct pose at = {.t_ns = T_NS + i,
		                        .position_m = {i, 1, 2},
		                        .rotation = quat_normalise((struct quat){1, i * 0.1, 2, -i * 0.3})};
		const struct transform turn = transform_tilt(tilt.angle_rad);
		const struct transform base = transform_quat(at.position_m, at.rotation);
		struct vec3 p = {3, 0.5, 0}, q;

		live_tilt(live, 1, &tilt);
		live_pose(live, &at);
		assert_int_equal(live_transforms(live, t), 3);
		q = in_map(t, 3, "laser", p);
		p = transform_point(&params.tilt_laser, p);
		p = transform_point(&turn, p);
		p = transform_point(&params.base_tilt, p);
		p = transform_point(&base, p);
		assert_true(vec3_norm(vec3_sub(p, q)) < 1e-9);
	}
	live_reset(live);
	assert_int_equal(live_transforms(live, t), 1);
	live_destroy(live);
}

static void several_scanners_have_frames_of_their_own(void **state)
{
	static struct profile profile;
	struct live_transform t[LIVE_TRANSFORMS_MAX];
	struct config config;
	struct live *live;
	uint64_t sequence;
	struct pose at;

	(void)state;
	read_config(two, &config);
	live = live_create(&config);
	assert_int_equal(live_scanners(live), 2);
	assert_int_equal(live_transforms(live, t), 5);
	assert_string_equal(t[0].child, "base");
	assert_string_equal(t[1].child, "tilt_a");
	assert_string_equal(t[4].child, "laser_b");
	assert_true(live_pose_now(live, &at, &sequence));
	assert_true(at.position_m.z == 7 && fabs(at.rotation.z) > 0.999);
	fan(&profile);
	live_profile(live, 1, &profile);
	assert_int_equal(live_scanner(live, 0)->sequence, 0);
	assert_int_equal(live_scanner(live, 1)->sequence, 1);
	assert_int_equal(live_scanner(live, 1)->profile.n, 3);
	assert_string_equal(live_scanner(live, 1)->name, "b");
	live_destroy(live);
}

static void lines_that_were_kept_can_be_read_again(void **state)
{
	struct config config;
	struct live_line read;
	struct live *live;
	char text[2 * LIVE_LINE_MAX];

	(void)state;
	read_config(two, &config);
	live = live_create(&config);
	assert_false(live_line(live, 0, &read));
	assert_false(live_line(live, 1, &read));
	for (int i = 1; i <= LIVE_LINES + 5; i++) {
		snprintf(text, sizeof(text), "line %d", i);
		live_log(live, i, LOG_INFO, text);
	}
	assert_int_equal(live_lines(live), LIVE_LINES + 5);
	assert_false(live_line(live, 5, &read));
	assert_true(live_line(live, 6, &read));
	assert_string_equal(read.text, "line 6");
	assert_false(live_line(live, LIVE_LINES + 6, &read));
	memset(text, 'x', sizeof(text) - 1);
	text[sizeof(text) - 1] = 0;
	memcpy(text + LIVE_LINE_MAX - 2, "\xc3\xbc", 2); /* cut in the middle of a letter */
	live_log(live, 0, LOG_INFO, text);
	assert_true(live_line(live, live_lines(live), &read));
	assert_int_equal(strlen(read.text), LIVE_LINE_MAX - 1);
	assert_int_equal(read.text[LIVE_LINE_MAX - 2], '?');
	live_log(live, 0, LOG_INFO, "\xc0\x80 \xed\xa0\x80 \xf4\x90\x80\x80 \xe2\x82\xac \x1b");
	assert_true(live_line(live, live_lines(live), &read));
	assert_string_equal(read.text, "?? ??? ???? \xe2\x82\xac ?");
	live_destroy(live);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(messages_have_their_golden_text),
	    cmocka_unit_test(messages_have_their_golden_bytes),
	    cmocka_unit_test(json_is_as_its_schema_says),
	    cmocka_unit_test(protoc_reads_what_we_write),
	    cmocka_unit_test(frames_put_a_beam_where_the_assembler_does),
	    cmocka_unit_test(several_scanners_have_frames_of_their_own),
	    cmocka_unit_test(lines_that_were_kept_can_be_read_again),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

/* Law: no line of a client crashes the reader of commands or makes it read beyond it; what it refuses it says in one
 * sentence, what it takes it answers; and whatever bytes a device's message holds, what is said to clients is JSON on one
 * line, or nothing. */
#include <jansson.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/control.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void must(bool condition)
{
	if (!condition)
		abort();
}

static void check_said(struct buffer *b)
{
	json_t *json = b->len > 0 ? json_loadb((const char *)b->data, b->len, 0, NULL) : NULL;

	must(b->len == 0 || (json_is_object(json) && json_object_get(json, "class")));
	must(b->len == 0 || !memchr(b->data, '\n', b->len));
	json_decref(json);
	buffer_finish(b);
	*b = (struct buffer){0};
}

static void check_line(const char *text, size_t len)
{
	struct control_command command;
	struct buffer b = {0};
	char error[200] = "";
	/* Exactly as long as it is, so that a byte beyond is seen. */
	char *copy = malloc(len ? len : 1);
	int r;

	memcpy(copy, text, len);
	r = control_parse(copy, len, &command, error);
	free(copy);
	if (r < 0) {
		must(error[0] && memchr(error, 0, sizeof(error)));
		control_put_error(&b, error);
		must(b.len > 0);
	} else {
		must(strlen(command.file) < sizeof(command.file) && control_name(command.word)[0]);
		must(!control_plays(command.word) || control_changes(command.word));
		control_put_answer(&b, &command);
		must(b.len > 0);
	}
	check_said(&b);
}

static void say_events(const char *text, uint8_t choice)
{
	const struct pose_jump jump = {
	    .done = (enum pose_track_on_jump)(choice % 3), .distance_m = 1, .back = choice & 1};
	struct recorder_notice notice = {.state = "recording"};
	static const uint8_t id[16] = {1, 2, 3};
	struct buffer b = {0};

	snprintf(notice.file, sizeof(notice.file), "%s", choice & 2 ? text : "");
	snprintf(notice.sentence, sizeof(notice.sentence), "%s", text);
	control_put_version(&b);
	check_said(&b);
	control_put_error(&b, text);
	check_said(&b);
	control_put_device_event(&b, "laser", "closed", text);
	check_said(&b);
	control_put_jump_event(&b, "pose", &jump);
	check_said(&b);
	control_put_map_event(&b, id, 3, id);
	check_said(&b);
	control_put_saved_event(&b, "00", choice & 1 ? text : NULL, choice & 2 ? text : NULL);
	check_said(&b);
	control_put_record_event(&b, &notice);
	check_said(&b);
	control_put_end(&b, text);
	check_said(&b);
	control_put_clock_event(&b, -5, choice);
	check_said(&b);
}

static void say_status(const char *text, uint8_t choice)
{
	static struct control_status s;
	struct control_client client = {.id = 1, .kind = "native"};
	struct buffer b = {0};

	memset(&s, 0, sizeof(s));
	snprintf(client.address, sizeof(client.address), "%s", text);
	s.clients = choice & 1;
	s.client = &client;
	s.devices = 1;
	s.device[0].name = "laser";
	s.device[0].driver = "lms2xx";
	s.device[0].line.state = choice & 2 ? SUPERVISOR_STREAMING : SUPERVISOR_CLOSED;
	snprintf(s.device[0].line.error, sizeof(s.device[0].line.error), "%s", text);
	snprintf(s.device[0].line.note, sizeof(s.device[0].line.note), "%s", text);
	s.device[0].timing.known = choice & 4;
	s.device[0].timing.stamps = choice & 8;
	s.device[0].track.known = choice & 16;
	s.device[0].track.sure = choice & 32;
	s.device[0].counters.n = 1;
	s.device[0].counters.counter[0].name = "crc";
	snprintf(s.record.file, sizeof(s.record.file), "%s", choice & 64 ? text : "");
	s.replays = choice & 128;
	s.replay_error = s.replay_note = text;
	control_put_status(&b, &s);
	check_said(&b);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	uint8_t choice = size > 0 ? data[size - 1] : 0;
	char *text = malloc(size + 1);
	size_t at = 0;

	memcpy(text, data, size);
	text[size] = 0;
	while (at < size) {
		const char *end = memchr(text + at, '\n', size - at);
		size_t len = end ? (size_t)(end - text) - at : size - at;

		check_line(text + at, len);
		at += len + 1;
	}
	say_events(text, choice);
	say_status(text, choice);
	free(text);
	return 0;
}

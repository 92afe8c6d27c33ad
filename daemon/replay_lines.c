/* Imports know no states: a device whose bytes give profiles, angles or poses streams. */
#include "daemon/replay_lines.h"

#include <jansson.h>
#include <stdio.h>
#include <string.h>

void replay_lines_reset(struct replay_lines *lines)
{
	memset(lines, 0, sizeof(*lines));
}

static void enter(struct supervisor_device *line, enum supervisor_state state, int64_t t_ns, const char *text)
{
	if (line->state == SUPERVISOR_STREAMING && state != SUPERVISOR_STREAMING)
		line->losses++;
	if (line->state != state)
		line->since_ns = t_ns;
	line->state = state;
	snprintf(line->error, sizeof(line->error), "%s", state == SUPERVISOR_STREAMING ? "" : text);
}

static void hear(struct replay_lines *lines, const struct config *config, const struct replay_event *event)
{
	json_t *json = json_loadb((const char *)event->bytes, event->len, 0, NULL);
	const char *class = json_string_value(json_object_get(json, "class"));
	const char *name = json_string_value(json_object_get(json, "name"));
	const char *state = json_string_value(json_object_get(json, "state"));
	const char *text = json_string_value(json_object_get(json, "message"));

	if (class && name && state && strcmp(class, "DEVICE") == 0)
		for (int i = 0; i < config->devices; i++)
			for (int k = SUPERVISOR_CLOSED; k <= SUPERVISOR_BACKING_OFF; k++)
				if (strcmp(config->device[i].name, name) == 0 &&
				    strcmp(supervisor_state_name((enum supervisor_state)k), state) == 0)
					enter(&lines->line[i], (enum supervisor_state)k, event->log_ns,
					      text ? text : "");
	json_decref(json);
}

void replay_lines_event(struct replay_lines *lines, const struct config *config, const struct replay_event *event)
{
	struct supervisor_device *line;

	if (event->kind == REPLAY_EVENT)
		hear(lines, config, event);
	if (event->kind != REPLAY_RECORD)
		return;
	line = &lines->line[event->record.device];
	line->records++;
	if (event->record.direction == FROM_DEVICE)
		line->bytes_in += event->record.len;
	else if (event->record.direction == TO_DEVICE)
		line->bytes_out += event->record.len;
	else
		line->opens++;
	if (event->record.direction == LINK_OPENED || line->state == SUPERVISOR_CLOSED)
		enter(line, SUPERVISOR_CONFIGURING, event->log_ns, "");
}

void replay_lines_data(struct replay_lines *lines, int device, int64_t t_ns)
{
	struct supervisor_device *line = &lines->line[device];

	line->decoded++;
	line->decoded_ns = t_ns;
	if (line->state != SUPERVISOR_STREAMING)
		enter(line, SUPERVISOR_STREAMING, t_ns, "");
}

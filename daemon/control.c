/* Answers to clients, in gpsd's manner: one JSON object on one line, its `class` first. */
#include "daemon/control.h"

#include <errno.h>
#include <jansson.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* Jansson's failures (memory) leave the text out; the reader then misses one message. */

static void put(struct buffer *b, json_t *json)
{
	char *text = json ? json_dumps(json, JSON_COMPACT | JSON_REAL_PRECISION(15)) : NULL;

	if (text)
		buffer_append(b, text, strlen(text));
	free(text);
	json_decref(json);
}

void control_put_version(struct buffer *b)
{
	put(b, json_pack("{s:s, s:s, s:[i,i]}", "class", "VERSION", "release", FACET_VERSION, "protocol", NATIVE_MAJOR,
	                 NATIVE_MINOR));
}

void control_put_answer(struct buffer *b, const struct control_command *command)
{
	if (command->word == CONTROL_RECORD)
		put(b, json_pack("{s:s, s:b, s:b}", "class", "RECORD", "enable", command->enable, "stream",
		                 command->stream));
	else if (command->word == CONTROL_WATCH)
		put(b, json_pack("{s:s, s:b}", "class", "WATCH", "enable", command->enable));
	else
		put(b, json_pack("{s:s, s:s}", "class", "OK", "command", control_name(command->word)));
}

void control_put_error(struct buffer *b, const char *sentence)
{
	put(b, json_pack("{s:s, s:s}", "class", "ERROR", "error", sentence));
}

void control_put_device_event(struct buffer *b, const char *device, const char *state, const char *text)
{
	/* A driver's sentence may repeat a user's bytes, which need not be UTF-8 */
	json_t *message = json_string(text);

	put(b, json_pack("{s:s, s:s, s:s, s:o}", "class", "DEVICE", "name", device, "state", state, "message",
	                 message ? message : json_string("(not UTF-8)")));
}

void control_put_clock_event(struct buffer *b, int64_t step_ns, int64_t ahead_ns)
{
	put(b, json_pack("{s:s, s:f, s:f}", "class", "CLOCK", "step", (double)step_ns / 1e9, "ahead",
	                 (double)ahead_ns / 1e9));
}

const char *control_on_jump(enum pose_track_on_jump done)
{
	static const char *const names[] = {
	    [POSE_TRACK_KEEP] = "keep", [POSE_TRACK_IGNORE] = "ignore", [POSE_TRACK_NEW_MAP] = "new_map"};

	return names[done];
}

void control_put_jump_event(struct buffer *b, const char *device, const struct pose_jump *jump)
{
	put(b, json_pack("{s:s, s:s, s:f, s:f, s:f, s:s, s:b}", "class", "JUMP", "device", device, "t",
	                 (double)jump->t_ns / 1e9, "distance", jump->distance_m, "angle", jump->angle_rad, "done",
	                 control_on_jump(jump->done), "back", jump->back));
}

static void put_id(const uint8_t map_id[16], char ret[33])
{
	for (int i = 0; i < 16; i++)
		snprintf(ret + 2 * i, 3, "%02x", map_id[i]);
}

void control_put_map_event(struct buffer *b, const uint8_t map_id[16], uint32_t generation, const uint8_t before[16])
{
	char id[33], old[33];

	put_id(map_id, id);
	put_id(before, old);
	put(b, json_pack("{s:s, s:s, s:I, s:s}", "class", "MAP", "map", id, "generation", (json_int_t)generation,
	                 "before", old));
}

static json_t *text_json(const char *text);

void control_put_saved_event(struct buffer *b, const char *map, const char *file, const char *error)
{
	json_t *json =
	    json_pack("{s:s, s:s, s:o}", "class", "SAVED", "map", map, "file", file ? text_json(file) : json_null());

	if (error)
		json_object_set_new(json, "error", text_json(error));
	put(b, json);
}

void control_put_record_event(struct buffer *b, const struct recorder_notice *notice)
{
	put(b,
	    json_pack("{s:s, s:s, s:o, s:o}", "class", "RECORD", "state", notice->state, "file",
	              notice->file[0] ? text_json(notice->file) : json_null(), "message", text_json(notice->sentence)));
}

void control_put_end(struct buffer *b, const char *reason)
{
	put(b, json_pack("{s:s, s:s, s:s}", "class", "RECORD", "state", "ended", "message", reason));
}

static json_t *integer(uint64_t value)
{
	return json_integer((json_int_t)value);
}

const char *control_beam_name(enum beam_state state)
{
	static const char *const names[BEAM_STATES] = {"ok",           "no echo",       "dazzled",        "overflow",
	                                               "weak",         "channel error", "beyond maximum", "reserved",
	                                               "out of range", "masked",        "self",           "mixed"};

	return names[state];
}

static json_t *rows_json(const struct control_status *s)
{
	json_t *dropped = json_object(), *beams = json_object();

	for (int i = 0; i < SWEEP_DROPS; i++)
		json_object_set_new(dropped, sweep_drop_name((enum sweep_drop)i), integer(s->rows.sweep.dropped[i]));
	json_object_set_new(dropped, "queue full", integer(s->rows.queue_full));
	json_object_set_new(dropped, "paused", integer(s->rows.paused));
	for (int i = 0; i < BEAM_STATES; i++)
		json_object_set_new(beams, control_beam_name((enum beam_state)i), integer(s->rows.sweep.beams[i]));
	return json_pack("{s:I, s:I, s:I, s:f, s:I, s:I, s:o, s:o}", "assembled", (json_int_t)s->rows.assembled,
	                 "applied", (json_int_t)s->rows.applied, "not_applied", (json_int_t)s->rows.not_applied, "rate",
	                 s->rows.rate, "profiles", (json_int_t)s->rows.sweep.profiles, "sweeps",
	                 (json_int_t)s->rows.sweep.sweeps, "dropped", dropped, "beams", beams);
}

static json_t *text_json(const char *text)
{
	json_t *json = json_string(text);

	return json ? json : json_string("(not UTF-8)");
}

/* null where nothing is known. Without a clock of its own a device has no drift, and nobody can count what was lost. */
static json_t *timing_json(const struct decoder_timing *t)
{
	json_t *json;

	if (!t->known)
		return json_null();
	json = json_pack("{s:f, s:{s:f, s:f}, s:I}", "expected", t->expected_hz, "jitter_ms", "p50",
	                 (double)t->jitter_p50_ns / 1e6, "p99", (double)t->jitter_p99_ns / 1e6, "lost",
	                 (json_int_t)t->lost);
	if (t->stamps) {
		json_object_set_new(json, "offset", json_real((double)t->offset_ns / 1e9));
		json_object_set_new(json, "drift_ppm", json_real(t->drift_ppm));
	}
	return json;
}

/* How sure the robot's place is; null where nobody can tell. */
static json_t *sigma_json(const struct pose_track_status *track)
{
	return track->sure ? json_pack("{s:f, s:f}", "position", track->sigma_m, "heading", track->sigma_rad)
	                   : json_null();
}

/* Of a device that says where the robot is, or how it moves. */
static void put_track(json_t *device, const struct pose_track_status *track)
{
	if (!track->known)
		return;
	json_object_set_new(device, "sigma", sigma_json(track));
	json_object_set_new(device, "jumps", integer(track->jumps));
	json_object_set_new(device, "late", integer(track->late));
	json_object_set_new(device, "gaps", integer(track->gaps));
}

/* Seconds for which nothing came from a device that streams; null where that means nothing. */
static json_t *silent_json(const struct supervisor_device *line, bool fixed, int64_t t_ns)
{
	int64_t last_ns = line->decoded_ns > line->since_ns ? line->decoded_ns : line->since_ns;

	if (line->state != SUPERVISOR_STREAMING || fixed)
		return json_null();
	return json_real(t_ns > last_ns ? (double)(t_ns - last_ns) / 1e9 : 0);
}

static json_t *devices_json(const struct control_status *s)
{
	json_t *list = json_array();

	for (int i = 0; i < s->devices; i++) {
		const struct supervisor_device *line = &s->device[i].line;
		json_t *counters = json_object();

		for (int k = 0; k < s->device[i].counters.n; k++)
			json_object_set_new(counters, s->device[i].counters.counter[k].name,
			                    integer(s->device[i].counters.counter[k].count));
		json_t *device =
		    json_pack("{s:s, s:s, s:s, s:f, s:o, s:f, s:o, s:I, s:I, s:I, s:I, s:I, s:o, s:o, s:o}", "name",
		              s->device[i].name, "driver", s->device[i].driver, "state",
		              supervisor_state_name(line->state), "since", (double)(s->t_ns - line->since_ns) / 1e9,
		              "silent", silent_json(line, s->device[i].fixed, s->t_ns), "rate", s->device[i].rate,
		              "timing", timing_json(&s->device[i].timing), "records", (json_int_t)line->decoded,
		              "bytes_in", (json_int_t)line->bytes_in, "bytes_out", (json_int_t)line->bytes_out, "opens",
		              (json_int_t)line->opens, "losses", (json_int_t)line->losses, "error",
		              text_json(line->error), "note", text_json(line->note), "counters", counters);
		put_track(device, &s->device[i].track);
		json_array_append_new(list, device);
	}
	return list;
}

static json_t *record_json(const struct control_status *s)
{
	const struct recorder_status *record = &s->record;

	return json_pack("{s:b, s:b, s:o, s:I, s:I, s:I, s:I, s:I, s:I, s:o, s:I}", "enabled", record->enabled,
	                 "recording", record->recording, "file",
	                 record->file[0] ? text_json(record->file) : json_null(), "bytes", (json_int_t)record->bytes,
	                 "messages", (json_int_t)record->messages, "files", (json_int_t)record->files, "gaps",
	                 (json_int_t)record->gaps, "dropped", (json_int_t)record->dropped, "queued",
	                 (json_int_t)record->queued, "error", record->error[0] ? text_json(record->error) : json_null(),
	                 "streams", (json_int_t)s->streams);
}

static json_t *clients_json(const struct control_status *s)
{
	json_t *list = json_array();

	for (size_t i = 0; i < s->clients; i++) {
		const struct control_client *c = &s->client[i];

		json_array_append_new(list, json_pack("{s:I, s:s, s:s, s:I, s:I, s:I, s:I, s:I, s:I, s:I}", "id",
		                                      (json_int_t)c->id, "kind", c->kind, "address", c->address, "step",
		                                      (json_int_t)c->step, "behind", (json_int_t)c->behind,
		                                      "behind_peak", (json_int_t)c->behind_peak, "bytes",
		                                      (json_int_t)c->sent, "queued", (json_int_t)c->queued, "batches",
		                                      (json_int_t)c->batches, "aborts", (json_int_t)c->aborts));
	}
	return list;
}

static json_t *replay_json(const struct control_status *s)
{
	const struct player_status *p = &s->replay;

	return json_pack("{s:s, s:f, s:f, s:f, s:o, s:I, s:o, s:o}", "state", player_state_name(p->state), "position",
	                 (double)p->now_ns / 1e9, "begin", (double)p->begin_ns / 1e9, "end", (double)p->end_ns / 1e9,
	                 "speed", p->speed == 0 ? json_string("max") : json_real(p->speed), "seeks",
	                 (json_int_t)p->seeks, "error", text_json(s->replay_error), "note", text_json(s->replay_note));
}

void control_put_status(struct buffer *b, const struct control_status *s)
{
	char map_id[33];
	json_t *json = json_object();

	put_id(s->map_id, map_id);
	json_object_update_new(json,
	                       json_pack("{s:s, s:s, s:s, s:I, s:f, s:f, s:f, s:I, s:b}", "class", "STATUS", "version",
	                                 FACET_VERSION, "map", map_id, "generation", (json_int_t)s->generation, "cell",
	                                 s->cell_m, "t", (double)s->t_ns / 1e9, "uptime", (double)s->uptime_ns / 1e9,
	                                 "step", (json_int_t)s->step, "paused", s->paused));
	json_object_set_new(json, "rows", rows_json(s));
	json_object_set_new(json, "map_size",
	                    json_pack("{s:I, s:I, s:I, s:I}", "blocks", (json_int_t)s->grid.blocks, "patches",
	                              (json_int_t)s->patches, "triangles_raw", (json_int_t)s->faces_raw, "triangles",
	                              (json_int_t)s->faces));
	json_object_set_new(json, "memory",
	                    json_pack("{s:I, s:I, s:I, s:I, s:I, s:I, s:I}", "used", (json_int_t)s->grid.bytes, "cap",
	                              (json_int_t)s->memory_cap, "refused_blocks", (json_int_t)s->grid.refused_memory,
	                              "refused_far", (json_int_t)s->grid.refused_far, "encoded",
	                              (json_int_t)s->encoded_bytes, "pinned", (json_int_t)s->pinned_bytes, "rss",
	                              (json_int_t)s->rss_bytes));
	json_object_set_new(json, "queue",
	                    json_pack("{s:I, s:I, s:I, s:b}", "length", (json_int_t)s->worker.queued, "peak",
	                              (json_int_t)s->worker.queued_peak, "cap", (json_int_t)s->worker.rows_max, "idle",
	                              s->worker.idle));
	json_object_set_new(json, "latency_ms",
	                    json_pack("{s:f, s:f, s:I}", "p50", s->latency_p50_ms, "p99", s->latency_p99_ms, "n",
	                              (json_int_t)s->latencies));
	if (s->replays)
		json_object_set_new(json, "replay", replay_json(s));
	json_object_set_new(json, "devices", devices_json(s));
	json_object_set_new(json, "record", record_json(s));
	json_object_set_new(json, "clients", clients_json(s));
	put(b, json);
}

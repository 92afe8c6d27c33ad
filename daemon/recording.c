/* See recording.h. What a channel is for is found once, when its first message comes; a message is then one switch.
 *
 * The row that was not applied is told after the record that completed it, since nobody knew before, but must be known to a
 * pipeline first. So a record or tick is held while the messages behind it are looked through, up to the next one that moves
 * the pipeline, or the chunk's end; the ROW events among them are handed out, then the record, and the walk goes on right
 * behind it. Each message is thus read twice at most. */
#include "daemon/recording.h"

#include <assert.h>
#include <errno.h>
#include <inttypes.h>
#include <jansson.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/state.h"

#define BYTES_HEAD    9 /* of facetd.bytes.v1: i64 t_read_ns, u8 flags */
#define FLAG_OPENED   1
#define FLAG_WRITTEN  2 /* to the device; on a channel that is not one of what was written */
#define CONFIG_NAME   "facetd.yaml"
#define METADATA_NAME "facetd"

enum payload { PAYLOAD_BYTES, PAYLOAD_CAN, PAYLOAD_MODBUS, PAYLOAD_POSE };

static enum payload payload_of(const char *driver)
{
	static const struct {
		const char *driver;
		enum payload payload;
	} table[] = {{"can", PAYLOAD_CAN},
	             {"canopen", PAYLOAD_CAN},
	             {"odometry", PAYLOAD_CAN},
	             {"modbus", PAYLOAD_MODBUS},
	             {"pose", PAYLOAD_POSE}};

	for (size_t i = 0; i < sizeof(table) / sizeof(table[0]); i++)
		if (strcmp(driver, table[i].driver) == 0)
			return table[i].payload;
	return PAYLOAD_BYTES;
}

/* Writing */

struct recording_writer {
	const struct config *config;
	const char *version;
	struct mcap_writer *mcap;
	int64_t log_ns;
	int error; /* of a definition */
	struct {
		enum payload payload;
		int in, out,
		    own; /* channels: facetd.bytes.v1, what was written, and what came in the device's own encoding */
	} device[CONFIG_DEVICES_MAX];
	int event, control, tick, state, json_schema;
	int published[FOXGLOVE_SCHEMAS]; /* 0: not yet */
};

static int channel(struct recording_writer *w, int schema, const char *encoding, const char *device,
                   const char *direction, const char *format, ...) __attribute__((format(printf, 6, 7)));

/* `device` NULL: of none. */
static int channel(struct recording_writer *w, int schema, const char *encoding, const char *device,
                   const char *direction, const char *format, ...)
{
	const struct mcap_pair pair[] = {{"device", device}, {"direction", direction}};
	char topic[CONFIG_NAME_MAX + 32];
	va_list args;
	int r;

	va_start(args, format);
	vsnprintf(topic, sizeof(topic), format, args);
	va_end(args);
	r = mcap_writer_channel(w->mcap, schema, topic, encoding, pair, device ? 2 : 0);
	if (r < 0)
		w->error = r;
	return r;
}

static void device_channels(struct recording_writer *w, int i, int poses)
{
	static const char *const encoding[] = {[PAYLOAD_BYTES] = "facetd.bytes.v1",
	                                       [PAYLOAD_CAN] = "facetd.can.v1",
	                                       [PAYLOAD_MODBUS] = "facetd.modbus.v1",
	                                       [PAYLOAD_POSE] = "json"};
	const char *name = w->config->device[i].name;
	const enum payload payload = payload_of(w->config->device[i].driver);

	w->device[i].payload = payload;
	w->device[i].in = channel(w, 0, encoding[PAYLOAD_BYTES], name, "in", "/raw/%s/in", name);
	w->device[i].own = w->device[i].out = w->device[i].in;
	if (payload == PAYLOAD_POSE && poses == 0)
		w->device[i].own = channel(w, w->json_schema, encoding[payload], name, "in", "/pose");
	else if (payload == PAYLOAD_POSE)
		w->device[i].own = channel(w, w->json_schema, encoding[payload], name, "in", "/pose/%s", name);
	else
		w->device[i].out = channel(w, 0, encoding[payload], name, "out", "/raw/%s/out", name);
	if (payload == PAYLOAD_CAN || payload == PAYLOAD_MODBUS)
		w->device[i].own = channel(w, 0, encoding[payload], name, "in", "/raw/%s", name);
}

static void define_all(struct recording_writer *w)
{
	static const char any_object[] = "{\"type\":\"object\"}";
	int poses = 0;

	w->json_schema = mcap_writer_schema(w->mcap, "facetd.json", "jsonschema", any_object, sizeof(any_object) - 1);
	if (w->json_schema < 0) {
		w->error = w->json_schema;
		return;
	}
	for (int i = 0; i < w->config->devices; i++) {
		device_channels(w, i, poses);
		poses += w->device[i].payload == PAYLOAD_POSE;
	}
	w->event = channel(w, w->json_schema, "json", NULL, NULL, "/event");
	w->control = channel(w, w->json_schema, "json", NULL, NULL, "/control");
	w->tick = channel(w, 0, "facetd.tick.v1", NULL, NULL, "/tick");
	w->state = channel(w, 0, "facetd.state.v1", NULL, NULL, "/state/pipeline");
}

static void put_hex(char *ret, const uint8_t *bytes, size_t len)
{
	for (size_t i = 0; i < len; i++)
		snprintf(ret + 2 * i, 3, "%02x", bytes[i]);
}

static void put_head(struct recording_writer *w, const struct recording_params *params,
                     const struct recording_begin *begin)
{
	char map[33], generation[12], session[17], part[12];
	const struct mcap_pair pair[] = {
	    {"version", params->version}, {"map", map},   {"generation", generation},
	    {"session", session},         {"part", part}, {"whole", begin->whole ? "true" : "false"}};

	put_hex(map, begin->map_id, 16);
	snprintf(generation, sizeof(generation), "%" PRIu32, begin->generation);
	snprintf(session, sizeof(session), "%016" PRIx64, begin->session);
	snprintf(part, sizeof(part), "%" PRIu32, begin->part);
	mcap_writer_metadata(w->mcap, METADATA_NAME, pair, sizeof(pair) / sizeof(pair[0]));
	mcap_writer_attach(w->mcap, begin->log_ns, CONFIG_NAME, "application/yaml", params->config_text,
	                   strlen(params->config_text));
}

struct recording_writer *recording_writer_create(const struct recording_params *params,
                                                 const struct recording_begin *begin, struct buffer *out)
{
	struct recording_writer *w = calloc(1, sizeof(*w));
	const struct mcap_params mcap = {"facetd " FACET_VERSION, params->level};

	if (!w)
		return NULL;
	w->config = params->config;
	w->version = params->version;
	w->log_ns = begin->log_ns;
	w->mcap = mcap_writer_create(&mcap, out);
	if (w->mcap)
		define_all(w);
	if (w->mcap && w->error == 0) {
		put_head(w, params, begin);
		w->error = recording_put_begin(w, begin);
	}
	if (w->mcap && w->error == 0)
		return w;
	recording_writer_destroy(w);
	return NULL;
}

void recording_writer_destroy(struct recording_writer *w)
{
	if (!w)
		return;
	mcap_writer_destroy(w->mcap);
	free(w);
}

struct mcap_writer *recording_writer_mcap(struct recording_writer *w)
{
	return w->mcap;
}

static int put(struct recording_writer *w, int to, int64_t t_ns, const void *head, size_t head_len, const void *data,
               size_t len)
{
	const struct mcap_message message = {(uint16_t)to, w->log_ns, t_ns, head, head_len, data, len};

	return mcap_writer_message(w->mcap, &message);
}

static void advance(struct recording_writer *w, int64_t log_ns)
{
	w->log_ns = log_ns > w->log_ns ? log_ns : w->log_ns;
}

int recording_put_event(struct recording_writer *w, const char *json, size_t len)
{
	return put(w, w->event, w->log_ns, NULL, 0, json, len);
}

int recording_put_control(struct recording_writer *w, const char *json, size_t len)
{
	return put(w, w->control, w->log_ns, NULL, 0, json, len);
}

static int put_json(struct recording_writer *w, json_t *json)
{
	char *text = json ? json_dumps(json, JSON_COMPACT) : NULL;
	int r = text ? recording_put_event(w, text, strlen(text)) : -ENOMEM;

	free(text);
	json_decref(json);
	return r;
}

int recording_put_begin(struct recording_writer *w, const struct recording_begin *begin)
{
	char map[33], session[17];
	int r;

	advance(w, begin->log_ns);
	put_hex(map, begin->map_id, 16);
	snprintf(session, sizeof(session), "%016" PRIx64, begin->session);
	r = put(w, w->state, w->log_ns, NULL, 0, begin->snapshot, begin->len);
	if (r < 0)
		return r;
	return put_json(w, json_pack("{s:s, s:s, s:I, s:b, s:s, s:I, s:s}", "class", "BEGIN", "map", map, "generation",
	                             (json_int_t)begin->generation, "whole", begin->whole, "session", session, "part",
	                             (json_int_t)begin->part, "version", w->version));
}

static bool is_json(const void *bytes, size_t len)
{
	json_t *json = json_loadb(bytes, len, 0, NULL);
	bool good = json_is_object(json);

	json_decref(json);
	return good;
}

int recording_put_record(struct recording_writer *w, const struct record *record)
{
	const int i = record->device;
	const bool bytes = w->device[i].payload == PAYLOAD_BYTES, pose = w->device[i].payload == PAYLOAD_POSE;
	uint8_t head[BYTES_HEAD];
	uint64_t t_ns = (uint64_t)record->t_ns;

	assert(i >= 0 && i < w->config->devices);
	advance(w, record->log_ns);
	for (int k = 0; k < 8; k++)
		head[k] = (uint8_t)(t_ns >> 8 * k);
	head[8] = record->direction == LINK_OPENED ? FLAG_OPENED : 0;
	if (record->direction == FROM_DEVICE && !bytes && (!pose || is_json(record->bytes, record->len)))
		return put(w, w->device[i].own, record->t_ns, NULL, 0, record->bytes, record->len);
	if (record->direction == TO_DEVICE && !bytes && !pose)
		return put(w, w->device[i].out, record->t_ns, NULL, 0, record->bytes, record->len);
	if (record->direction == TO_DEVICE && !bytes)
		head[8] |= FLAG_WRITTEN;
	return put(w, record->direction == TO_DEVICE ? w->device[i].out : w->device[i].in, record->t_ns, head,
	           sizeof(head), record->bytes, record->len);
}

int recording_put_tick(struct recording_writer *w, int64_t log_ns)
{
	advance(w, log_ns);
	return put(w, w->tick, w->log_ns, NULL, 0, NULL, 0);
}

int recording_put_skip(struct recording_writer *w, uint64_t number, const char *reason)
{
	return put_json(w, json_pack("{s:s, s:I, s:b, s:s}", "class", "ROW", "number", (json_int_t)number, "applied", 0,
	                             "reason", reason));
}

int recording_put_clock(struct recording_writer *w, int64_t ahead_ns)
{
	return put_json(w, json_pack("{s:s, s:I}", "class", "CLOCK", "ahead_ns", (json_int_t)ahead_ns));
}

/* Channels of published messages are there when the first one comes: most recordings have none. */
static int published_channel(struct recording_writer *w, enum foxglove_schema which)
{
	static const char *const topic[] = {[FOXGLOVE_SCENE_UPDATE] = "/map",
	                                    [FOXGLOVE_LASER_SCAN] = "/scan",
	                                    [FOXGLOVE_FRAME_TRANSFORMS] = "/tf",
	                                    [FOXGLOVE_POSE_IN_FRAME] = "/robot/pose",
	                                    [FOXGLOVE_LOG] = "/log"};
	struct buffer schema = {0};
	int r;

	foxglove_schema_protobuf(&schema, which);
	r = schema.error
	        ? schema.error
	        : mcap_writer_schema(w->mcap, foxglove_schema_name(which), "protobuf", schema.data, schema.len);
	buffer_finish(&schema);
	return r < 0 ? r : mcap_writer_channel(w->mcap, r, topic[which], "protobuf", NULL, 0);
}

int recording_put_message(struct recording_writer *w, enum foxglove_schema which, const void *data, size_t len)
{
	if (w->published[which] == 0) {
		int r = published_channel(w, which);

		if (r < 0)
			return r;
		w->published[which] = r;
	}
	return put(w, w->published[which], w->log_ns, NULL, 0, data, len);
}

int recording_end(struct recording_writer *w, const char *reason)
{
	int r = put_json(w, json_pack("{s:s, s:s}", "class", "END", "reason", reason));

	return r < 0 ? r : mcap_writer_end(w->mcap);
}

/* Reading */

enum role_kind { ROLE_OTHER, ROLE_BYTES, ROLE_PLAIN, ROLE_EVENT, ROLE_CONTROL, ROLE_TICK, ROLE_STATE };

struct role { /* of a channel */
	enum role_kind kind;
	enum direction direction;
	char device[CONFIG_NAME_MAX];
	int index;
};

struct recording_reader {
	struct mcap_reader *mcap;
	const struct config *config;
	const char *config_text;
	size_t config_len;
	struct role *role;
	size_t roles, roles_cap;
	int64_t log_ns;
	struct recording_event held; /* a record or tick whose skips are handed out first */
	bool holds, told;            /* told: the skips behind the last record were handed out before it */
	size_t behind;               /* the held one, within the chunk */
	const uint8_t *snapshot;     /* whose BEGIN follows */
	size_t snapshot_len;
};

static bool text_ends(struct mcap_text text, const char *word)
{
	size_t n = strlen(word);

	return text.len >= n && memcmp(text.at + text.len - n, word, n) == 0;
}

static void find_device(const struct recording_reader *r, struct role *role)
{
	role->index = -1;
	for (int i = 0; r->config && i < r->config->devices; i++)
		if (strcmp(r->config->device[i].name, role->device) == 0)
			role->index = i;
}

static void take_role(const struct recording_reader *r, const struct mcap_channel *channel, struct role *ret)
{
	static const struct {
		const char *encoding;
		enum role_kind kind;
	} table[] = {{"facetd.bytes.v1", ROLE_BYTES},
	             {"facetd.can.v1", ROLE_PLAIN},
	             {"facetd.modbus.v1", ROLE_PLAIN},
	             {"facetd.tick.v1", ROLE_TICK},
	             {"facetd.state.v1", ROLE_STATE}};

	*ret = (struct role){.direction = text_ends(channel->topic, "/out") ? TO_DEVICE : FROM_DEVICE};
	for (size_t i = 0; i < sizeof(table) / sizeof(table[0]); i++)
		if (mcap_text_is(channel->encoding, table[i].encoding))
			ret->kind = table[i].kind;
	if (mcap_text_is(channel->topic, "/event"))
		ret->kind = ROLE_EVENT;
	else if (mcap_text_is(channel->topic, "/control"))
		ret->kind = ROLE_CONTROL;
	else if (channel->topic.len >= 5 && memcmp(channel->topic.at, "/pose", 5) == 0)
		ret->kind = ROLE_PLAIN;
	for (size_t i = 0; i < channel->metadata.n; i++) {
		const struct mcap_text value = channel->metadata.pair[i].value;

		if (mcap_text_is(channel->metadata.pair[i].key, "device") && value.len < sizeof(ret->device))
			memcpy(ret->device, value.at, value.len);
	}
	find_device(r, ret);
}

/* NULL when memory is out. */
static const struct role *role_of(struct recording_reader *r, struct mcap_channel *channel)
{
	size_t at = (size_t)(uintptr_t)channel->user;

	if (at > 0)
		return &r->role[at - 1];
	if (r->roles == r->roles_cap) {
		size_t cap = r->roles_cap ? r->roles_cap * 2 : 32;
		struct role *grown = realloc(r->role, cap * sizeof(*grown));

		if (!grown)
			return NULL;
		r->role = grown;
		r->roles_cap = cap;
	}
	take_role(r, channel, &r->role[r->roles]);
	channel->user = (void *)(uintptr_t)++r->roles;
	return &r->role[r->roles - 1];
}

static bool is_time(int64_t t_ns)
{
	return t_ns >= STATE_TIME_MIN && t_ns <= STATE_TIME_MAX;
}

/* What reading one message, or one event's JSON, says: an event, nothing for the caller, or damage. */
enum verdict { VERDICT_EVENT, VERDICT_NOTHING, VERDICT_DAMAGED, VERDICT_NOMEM };

static enum verdict damaged(struct recording_event *ret, const char *what)
{
	ret->kind = RECORDING_DAMAGED;
	ret->damage = what;
	return VERDICT_DAMAGED;
}

static bool read_hex(const char *text, uint8_t *ret, size_t len)
{
	if (!text || strlen(text) != 2 * len)
		return false;
	for (size_t i = 0; i < len; i++) {
		unsigned value;

		if (strspn(text + 2 * i, "0123456789abcdef") < 2 || sscanf(text + 2 * i, "%2x", &value) != 1)
			return false;
		ret[i] = (uint8_t)value;
	}
	return true;
}

static enum verdict read_begin(struct recording_reader *r, json_t *json, struct recording_event *ret)
{
	struct recording_begin *begin = &ret->begin;
	uint8_t session[8];

	if (!r->snapshot)
		return damaged(ret, "a beginning without its snapshot");
	ret->kind = RECORDING_BEGIN;
	*begin = (struct recording_begin){.log_ns = ret->log_ns, .snapshot = r->snapshot, .len = r->snapshot_len};
	r->snapshot = NULL;
	begin->generation = (uint32_t)json_integer_value(json_object_get(json, "generation"));
	begin->part = (uint32_t)json_integer_value(json_object_get(json, "part"));
	begin->whole = json_is_true(json_object_get(json, "whole"));
	if (!read_hex(json_string_value(json_object_get(json, "map")), begin->map_id, 16) ||
	    !read_hex(json_string_value(json_object_get(json, "session")), session, 8))
		return damaged(ret, "a beginning that names no map");
	for (int i = 0; i < 8; i++)
		begin->session = begin->session << 8 | session[i];
	return VERDICT_EVENT;
}

static enum verdict read_event(struct recording_reader *r, const uint8_t *data, size_t len, struct recording_event *ret)
{
	json_error_t error;
	json_t *json = json_loadb((const char *)data, len, 0, &error);
	const char *class = json_string_value(json_object_get(json, "class"));
	json_t *number = json_object_get(json, "number"), *ahead = json_object_get(json, "ahead_ns");
	enum verdict verdict = VERDICT_EVENT;

	ret->kind = RECORDING_EVENT;
	ret->json.text = (const char *)data;
	ret->json.len = len;
	if (!json && (json_error_code(&error) == json_error_out_of_memory || !error.text[0]))
		verdict = VERDICT_NOMEM;
	else if (!class)
		verdict = damaged(ret, "an event that is none");
	else if (strcmp(class, "BEGIN") == 0)
		verdict = read_begin(r, json, ret);
	else if (strcmp(class, "GAP") == 0)
		verdict = damaged(ret, "a part was damaged and left out");
	else if (strcmp(class, "END") == 0)
		ret->kind = RECORDING_END;
	else if (strcmp(class, "ROW") == 0 && json_is_integer(number) && json_integer_value(number) >= 0) {
		ret->kind = RECORDING_SKIP;
		ret->skip = (uint64_t)json_integer_value(number);
	} else if (strcmp(class, "CLOCK") == 0 && json_is_integer(ahead) && is_time(json_integer_value(ahead))) {
		ret->kind = RECORDING_CLOCK;
		ret->ahead_ns = json_integer_value(ahead);
	}
	json_decref(json);
	return verdict;
}

static enum verdict read_record(const struct role *role, const struct mcap_item *item, struct recording_event *ret)
{
	const uint8_t *data = item->message.data;
	struct record *record = &ret->record;
	uint64_t t_ns = item->message.publish_ns;

	ret->kind = RECORDING_RECORD;
	ret->device = role->device;
	*record = (struct record){.log_ns = ret->log_ns, .device = role->index, .direction = role->direction};
	record->bytes = data;
	record->len = item->message.len;
	if (role->kind == ROLE_BYTES) {
		if (item->message.len < BYTES_HEAD)
			return damaged(ret, "a record that is too short");
		t_ns = 0;
		for (int i = 0; i < 8; i++)
			t_ns |= (uint64_t)data[i] << 8 * i;
		if (data[8] & FLAG_OPENED)
			record->direction = LINK_OPENED;
		else if (data[8] & FLAG_WRITTEN)
			record->direction = TO_DEVICE;
		record->bytes += BYTES_HEAD;
		record->len -= BYTES_HEAD;
	}
	record->t_ns = (int64_t)t_ns;
	return is_time(record->t_ns) ? VERDICT_EVENT : damaged(ret, "a record of another age");
}

static enum verdict read_message(struct recording_reader *r, const struct role *role, const struct mcap_item *item,
                                 struct recording_event *ret)
{
	const int64_t log_ns = (int64_t)item->message.log_ns;

	if (role->kind == ROLE_OTHER)
		return VERDICT_NOTHING;
	if (!is_time(log_ns) || log_ns < r->log_ns)
		return damaged(ret, "a time that runs backwards");
	r->log_ns = ret->log_ns = log_ns;
	switch (role->kind) {
	case ROLE_BYTES:
	case ROLE_PLAIN:
		return read_record(role, item, ret);
	case ROLE_EVENT:
		return read_event(r, item->message.data, item->message.len, ret);
	case ROLE_TICK:
		ret->kind = RECORDING_TICK;
		return VERDICT_EVENT;
	case ROLE_STATE:
		r->snapshot = item->message.data;
		r->snapshot_len = item->message.len;
		return VERDICT_NOTHING;
	default:
		ret->kind = RECORDING_CONTROL;
		ret->json.text = (const char *)item->message.data;
		ret->json.len = item->message.len;
		return VERDICT_EVENT;
	}
}

/* 1: an event; 0: nothing for the caller; -ENOMEM. */
static int read_item(struct recording_reader *r, const struct mcap_item *item, struct recording_event *ret)
{
	const struct role *role;
	enum verdict verdict;

	*ret = (struct recording_event){.log_ns = r->log_ns, .offset = item->offset};
	if (item->kind == MCAP_CHUNK)
		r->snapshot = NULL; /* it was the last chunk's */
	if (item->kind == MCAP_DAMAGED) {
		damaged(ret, item->damage);
		return 1;
	}
	if (item->kind != MCAP_MESSAGE)
		return 0;
	role = role_of(r, item->message.channel);
	if (!role)
		return -ENOMEM;
	verdict = read_message(r, role, item, ret);
	return verdict == VERDICT_NOMEM ? -ENOMEM : verdict != VERDICT_NOTHING;
}

static bool moves(enum recording_kind kind)
{
	return kind == RECORDING_RECORD || kind == RECORDING_TICK || kind == RECORDING_CLOCK ||
	       kind == RECORDING_BEGIN || kind == RECORDING_END || kind == RECORDING_DAMAGED;
}

/* The next skip that belongs to what is held, and 1; 0: there is none left, and the walk is behind the held one again. */
static int next_skip(struct recording_reader *r, struct recording_event *ret)
{
	const int64_t log_ns = r->log_ns;
	struct mcap_item item;
	bool found = true;
	int got;

	while (found && (got = mcap_reader_next_in_chunk(r->mcap, &item)) == 1) {
		got = read_item(r, &item, ret);
		if (got < 0)
			return got;
		if (got == 1 && ret->kind == RECORDING_SKIP)
			return 1;
		found = got == 0 || !moves(ret->kind);
	}
	mcap_reader_return(r->mcap, r->behind);
	r->log_ns = log_ns;
	r->snapshot = NULL;
	return 0;
}

static int next_event(struct recording_reader *r, struct recording_event *ret)
{
	struct mcap_item item;
	int got = 0;

	while (got == 0) {
		got = mcap_reader_next(r->mcap, &item);
		if (got <= 0)
			return got;
		got = read_item(r, &item, ret);
		if (got == 1 && ret->kind == RECORDING_SKIP && r->told)
			got = 0;
	}
	return got;
}

int recording_reader_next(struct recording_reader *r, struct recording_event *ret)
{
	int got;

	if (!r->holds) {
		got = next_event(r, ret);
		if (got == 1 && moves(ret->kind))
			r->told = false;
		if (got != 1 || (ret->kind != RECORDING_RECORD && ret->kind != RECORDING_TICK))
			return got;
		r->held = *ret;
		r->holds = true;
		r->behind = mcap_reader_tell(r->mcap);
	}
	got = next_skip(r, ret);
	if (got != 0)
		return got;
	*ret = r->held;
	r->holds = false;
	r->told = true;
	return 1;
}

void recording_reader_rewind(struct recording_reader *r)
{
	mcap_reader_rewind(r->mcap);
	r->log_ns = STATE_TIME_MIN;
	r->holds = r->told = false;
	r->snapshot = NULL;
}

void recording_reader_span(struct recording_reader *r, int64_t *ret_first_ns, int64_t *ret_last_ns)
{
	uint64_t first_ns, last_ns;

	mcap_reader_span(r->mcap, &first_ns, &last_ns);
	*ret_first_ns = (int64_t)first_ns;
	*ret_last_ns = (int64_t)last_ns;
}

const struct mcap_reader *recording_reader_mcap(const struct recording_reader *r)
{
	return r->mcap;
}

const char *recording_reader_config(const struct recording_reader *r, size_t *ret_len)
{
	*ret_len = r->config_len;
	return r->config_text;
}

void recording_reader_use(struct recording_reader *r, const struct config *config)
{
	r->config = config;
	for (size_t i = 0; i < r->roles; i++)
		find_device(r, &r->role[i]);
}

/* What stands before the first message; 1: this is a recording of facetd. */
static int read_head(struct recording_reader *r)
{
	struct mcap_item item = {.kind = MCAP_HEADER};
	bool ours = false;
	int got;

	while ((got = mcap_reader_next(r->mcap, &item)) == 1 && item.kind != MCAP_MESSAGE) {
		if (item.kind == MCAP_ATTACHMENT && mcap_text_is(item.attachment.name, CONFIG_NAME)) {
			r->config_text = (const char *)item.attachment.data;
			r->config_len = item.attachment.len;
		}
		ours |= item.kind == MCAP_METADATA && mcap_text_is(item.metadata.name, METADATA_NAME);
	}
	for (struct mcap_channel *c = mcap_reader_channel(r->mcap, 0); c && !ours;
	     c = mcap_reader_channel(r->mcap, c->id + 1u))
		ours = mcap_text_is(c->encoding, "facetd.tick.v1");
	recording_reader_rewind(r);
	return got < 0 ? got : ours;
}

int recording_reader_create(const uint8_t *data, size_t len, struct recording_reader **ret, char error[160])
{
	struct recording_reader *r = calloc(1, sizeof(*r));
	int got = r ? mcap_reader_create(data, len, &r->mcap, error) : -ENOMEM;

	if (got == 0)
		got = read_head(r);
	if (got == 0) {
		snprintf(error, 160, "is an MCAP file, but no recording of facetd");
		got = -EINVAL;
	} else if (got == -ENOMEM) {
		snprintf(error, 160, "out of memory");
	}
	if (got < 0) {
		recording_reader_destroy(r);
		return got;
	}
	*ret = r;
	return 0;
}

void recording_reader_destroy(struct recording_reader *r)
{
	if (!r)
		return;
	mcap_reader_destroy(r->mcap);
	free(r->role);
	free(r);
}

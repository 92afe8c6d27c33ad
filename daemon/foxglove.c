/* One connection of a Foxglove client.
 *
 *   text, JSON with `op`     to the client    serverInfo, advertise, status, serviceCallFailure
 *                            from the client  subscribe, unsubscribe; the rest is for other servers and is answered
 *   binary, little-endian    to the client    01 u32 subscription u64 ns payload      a message of a channel
 *                                             02 u64 ns                               time
 *                                             04 u32 request u8 1 u32 n text u32 0    no asset
 *                                             05 u8 state u64 ns f32 speed u8 seeked u32 n name    a replay
 *                            from the client  01 u32 channel payload  02 u32 service u32 call ...
 *                                             03 u8 pause f32 speed u8 seek u64 ns u32 n name
 *
 * A channel is subscribed once at most, so a client holds a fixed number of streams, and each stream remembers what it has
 * shown, not what it has to show: profile, pose and transforms go out as they are when their turn comes. Of the map it is
 * the publisher that remembers (a walk): a SceneUpdate is written as the batch is walked, piece by piece, and never
 * exists whole. A walk that is aborted ends its message where it stands; nothing is wrong with what was said until then
 * (entities replace one another by id) and the next walk brings all the rest. The whole map begins with a deletion of
 * everything, which is how a late or restarted reader comes to hold the map and nothing else.
 *
 * A deletion goes for entities older than itself, so its time is later than that of everything that was sent before. */
#include "daemon/foxglove.h"

#include <assert.h>
#include <errno.h>
#include <jansson.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/foxglove_messages.h"
#include "daemon/foxglove_schema.h"

enum { OP_MESSAGE = 1, OP_TIME = 2, OP_ASSET = 4, OP_PLAYBACK = 5 };     /* to the client */
enum { OP_HEARD_MESSAGE = 1, OP_HEARD_CALL = 2, OP_HEARD_PLAYBACK = 3 }; /* from it */
enum { LEVEL_INFO, LEVEL_WARNING, LEVEL_ERROR };                         /* of status */
enum { CHANNEL_MAP, CHANNEL_TF, CHANNEL_POSE, CHANNEL_LOG, CHANNEL_STATUS, CHANNEL_SCANS };

#define CHANNELS_MAX   (CHANNEL_SCANS + CONFIG_DEVICES_MAX)
#define CHANNEL_ID(at) ((uint32_t)(at) + 1)
#define TOPIC_MAX      (CONFIG_NAME_MAX + 8)
#define ANSWER_HEAD    5            /* u32 length, u8 text */
#define RETRY_NS       1000000000ll /* after memory was out */

struct stream {
	bool subscribed;
	uint32_t subscription;
	uint64_t shown;  /* the sequence number of what was told last */
	int64_t next_ns; /* not before then */
};

/* The SceneUpdate that is being said. */
struct scene {
	struct publisher_client *walk; /* NULL: the map is not asked for */
	bool talking, ended, whole;    /* whole: the walk came to its end */
	bool dismissed;                /* unsubscribed meanwhile: the message ends, then the walk */
	bool reset, begun, first, entities;
	bool quiet; /* nothing was new when last asked */
	uint32_t subscription;
	const uint8_t *item; /* borrowed of the walk */
	size_t item_left;
	int64_t newest_ns; /* no entity that was sent is younger */
};

struct foxglove_client {
	struct foxglove *foxglove;
	struct foxglove_client *next;
	enum scene_encoding encoding;
	bool may_play;
	struct foxglove_wire wire;
	int64_t joined_ns, told_ns; /* told_ns: the deadline the wire knows of */
	bool greeted, advertised;
	struct stream stream[CHANNELS_MAX], time;
	unsigned turn;
	struct scene scene;
	struct buffer answers; /* messages, each behind ANSWER_HEAD bytes */
	size_t answers_at;
	struct buffer out; /* of the message that is being said */
	size_t out_at;
	bool out_text;
	struct player_status playback; /* as told */
	bool playback_told;
	uint64_t messages, dropped;
};

struct foxglove {
	struct publisher *publisher;
	struct live *live;
	struct foxglove_host host;
	struct foxglove_client *clients;
	int channels;
	int64_t begun_ns;
};

/* Bytes */

static void put_u8(struct buffer *b, uint8_t v)
{
	buffer_append(b, &v, 1);
}

static void put_u32(struct buffer *b, uint32_t v)
{
	buffer_append(b, &v, 4);
}

static void put_u64(struct buffer *b, uint64_t v)
{
	buffer_append(b, &v, 8);
}

static void put_text(struct buffer *b, const char *text)
{
	buffer_append(b, text, strlen(text));
}

static uint32_t get_u32(const uint8_t *at)
{
	uint32_t v;

	memcpy(&v, at, 4);
	return v;
}

/* Of text that is valid UTF-8. */
static void put_json_string(struct buffer *b, const char *text, size_t len)
{
	put_text(b, "\"");
	for (size_t i = 0; i < len; i++) {
		if (text[i] == '"' || text[i] == '\\')
			buffer_printf(b, "\\%c", text[i]);
		else if ((unsigned char)text[i] < ' ')
			buffer_printf(b, "\\u%04x", (unsigned)(unsigned char)text[i]);
		else
			buffer_append(b, text + i, 1);
	}
	put_text(b, "\"");
}

static void put_base64(struct buffer *b, const uint8_t *data, size_t len)
{
	static const char digit[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

	for (size_t i = 0; i < len; i += 3) {
		const size_t left = len - i;
		const uint32_t v = (uint32_t)data[i] << 16 | (left > 1 ? (uint32_t)data[i + 1] << 8 : 0) |
		                   (left > 2 ? data[i + 2] : 0);
		const char four[4] = {digit[v >> 18], digit[v >> 12 & 63], left > 1 ? digit[v >> 6 & 63] : '=',
		                      left > 2 ? digit[v & 63] : '='};

		buffer_append(b, four, 4);
	}
}

/* Waking */

static int64_t earlier(int64_t a, int64_t b)
{
	return a < b ? a : b;
}

/* The wire asks again only when it is told to, or when the time it knows of has come. */
static void wake(struct foxglove_client *client)
{
	const int64_t deadline_ns = foxglove_deadline(client);

	if (deadline_ns >= client->told_ns)
		return;
	client->told_ns = deadline_ns;
	client->wire.wake(client->wire.ctx);
}

static void on_live(void *ctx)
{
	struct foxglove *f = ctx;

	for (struct foxglove_client *client = f->clients; client; client = client->next)
		wake(client);
}

/* Answers */

static void answer(struct foxglove_client *client, const void *data, size_t len, bool text)
{
	struct buffer *b = &client->answers;

	if (b->len - client->answers_at + len > FOXGLOVE_ANSWERS_MAX || b->error) {
		client->dropped++;
		return;
	}
	if (client->answers_at > 0) { /* what was said makes room */
		memmove(b->data, b->data + client->answers_at, b->len - client->answers_at);
		b->len -= client->answers_at;
		client->answers_at = 0;
	}
	put_u32(b, (uint32_t)len);
	put_u8(b, text);
	buffer_append(b, data, len);
}

static void answer_buffer(struct foxglove_client *client, struct buffer *b, bool text)
{
	if (b->error)
		client->dropped++;
	else
		answer(client, b->data, b->len, text);
	buffer_finish(b);
}

/* The sentence holds nothing that the client said but words and numbers. */
static void __attribute__((format(printf, 3, 4)))
say_status(struct foxglove_client *client, int level, const char *format, ...)
{
	struct buffer b = {0};
	char text[300];
	va_list arguments;

	va_start(arguments, format);
	vsnprintf(text, sizeof(text), format, arguments);
	va_end(arguments);
	buffer_printf(&b, "{\"op\":\"status\",\"level\":%d,\"message\":", level);
	put_json_string(&b, text, strlen(text));
	put_text(&b, "}");
	answer_buffer(client, &b, true);
}

/* A word of the client's as it may be repeated: letters of ASCII, else "?". */
static const char *plain_word(const char *word)
{
	size_t n = 0;

	while ((word[n] >= 'a' && word[n] <= 'z') || (word[n] >= 'A' && word[n] <= 'Z'))
		n++;
	return word[n] || n == 0 || n > 40 ? "?" : word;
}

/* Channels */

static void topic_of(const struct foxglove *f, int channel, char ret[TOPIC_MAX])
{
	static const char *const topic[CHANNEL_SCANS] = {"/map", "/tf", "/pose", "/log", "/status"};

	if (channel < CHANNEL_SCANS)
		snprintf(ret, TOPIC_MAX, "%s", topic[channel]);
	else
		snprintf(ret, TOPIC_MAX, "/scan/%s", live_scanner(f->live, channel - CHANNEL_SCANS)->name);
}

static enum foxglove_schema schema_of(int channel)
{
	static const enum foxglove_schema schema[] = {[CHANNEL_MAP] = FOXGLOVE_SCENE_UPDATE,
	                                              [CHANNEL_TF] = FOXGLOVE_FRAME_TRANSFORMS,
	                                              [CHANNEL_POSE] = FOXGLOVE_POSE_IN_FRAME,
	                                              [CHANNEL_LOG] = FOXGLOVE_LOG};

	return channel >= CHANNEL_SCANS ? FOXGLOVE_LASER_SCAN : schema[channel];
}

static void put_channel(struct buffer *b, const struct foxglove *f, int channel, enum scene_encoding encoding)
{
	struct buffer schema = {0};
	char topic[TOPIC_MAX];
	const bool json = encoding == SCENE_AS_JSON || channel == CHANNEL_STATUS;

	topic_of(f, channel, topic);
	buffer_printf(b, "{\"id\":%u,\"topic\":", CHANNEL_ID(channel));
	put_json_string(b, topic, strlen(topic));
	buffer_printf(b, ",\"encoding\":\"%s\",\"schemaName\":\"%s\",\"schemaEncoding\":\"%s\",\"schema\":",
	              json ? "json" : "protobuf",
	              channel == CHANNEL_STATUS ? "facetd.Status" : foxglove_schema_name(schema_of(channel)),
	              json ? "jsonschema" : "protobuf");
	if (channel == CHANNEL_STATUS)
		put_text(&schema, "{\"title\":\"facetd.Status\",\"type\":\"object\"}");
	else
		(json ? foxglove_schema_json : foxglove_schema_protobuf)(&schema, schema_of(channel));
	if (json) {
		put_json_string(b, (const char *)schema.data, schema.len);
	} else {
		put_text(b, "\"");
		put_base64(b, schema.data, schema.len);
		put_text(b, "\"");
	}
	put_text(b, "}");
	if (schema.error)
		b->error = schema.error;
	buffer_finish(&schema);
}

static void put_advertise(struct buffer *b, const struct foxglove_client *client)
{
	const struct foxglove *f = client->foxglove;

	put_text(b, "{\"op\":\"advertise\",\"channels\":[");
	for (int channel = 0; channel < f->channels; channel++) {
		if (channel > 0)
			put_text(b, ",");
		put_channel(b, f, channel, client->encoding);
	}
	put_text(b, "]}");
}

static void put_moment(struct buffer *b, const char *name, int64_t t_ns)
{
	const int64_t t = t_ns > 0 ? t_ns : 0;

	buffer_printf(b, ",\"%s\":{\"sec\":%lld,\"nsec\":%lld}", name, (long long)(t / 1000000000),
	              (long long)(t % 1000000000));
}

static void put_server_info(struct buffer *b, const struct foxglove_client *client)
{
	const struct foxglove *f = client->foxglove;
	const bool replays = f->host.playback != NULL;
	struct player_status status;

	buffer_printf(b,
	              "{\"op\":\"serverInfo\",\"name\":\"facetd\",\"capabilities\":[\"time\"%s],"
	              "\"supportedEncodings\":[\"json\",\"protobuf\"],\"metadata\":{\"version\":\"%s\","
	              "\"encoding\":\"%s\"},\"sessionId\":\"%lld\"",
	              replays ? ",\"playbackControl\"" : "", FACET_VERSION,
	              client->encoding == SCENE_AS_JSON ? "json; ?encoding=protobuf in the address for protobuf"
	                                                : "protobuf",
	              (long long)f->begun_ns);
	if (replays) {
		f->host.playback(f->host.ctx, &status);
		put_moment(b, "dataStartTime", status.begin_ns);
		put_moment(b, "dataEndTime", status.end_ns);
	}
	put_text(b, "}");
}

/* Playback */

static void put_playback(struct buffer *b, const struct player_status *status, bool seeked, const char *name,
                         size_t len)
{
	const float speed = (float)(status->speed > 0 ? status->speed : PLAYER_SPEED_MAX);

	put_u8(b, OP_PLAYBACK);
	put_u8(b, (uint8_t)status->state);
	put_u64(b, (uint64_t)status->now_ns);
	buffer_append(b, &speed, 4);
	put_u8(b, seeked);
	put_u32(b, (uint32_t)len);
	buffer_append(b, name, len);
}

static void tell_playback(struct foxglove_client *client, const char *name, size_t len)
{
	const struct foxglove_host *host = &client->foxglove->host;
	struct player_status status;
	struct buffer b = {0};

	host->playback(host->ctx, &status);
	put_playback(&b, &status, client->playback_told && status.seeks != client->playback.seeks, name, len);
	answer_buffer(client, &b, false);
	client->playback = status;
	client->playback_told = true;
}

static void look_at_playback(struct foxglove_client *client)
{
	const struct foxglove_host *host = &client->foxglove->host;
	const struct player_status *told = &client->playback;
	struct player_status status;

	if (!host->playback)
		return;
	host->playback(host->ctx, &status);
	if (!client->playback_told || status.state != told->state || status.seeks != told->seeks ||
	    status.speed < told->speed || status.speed > told->speed)
		tell_playback(client, "", 0);
}

static void hear_playback(struct foxglove_client *client, const uint8_t *data, size_t len)
{
	const struct foxglove_host *host = &client->foxglove->host;
	struct foxglove_request request;
	char error[200] = "";
	float speed;
	uint32_t name_len;
	int64_t seek_ns;

	if (len < 19 || (name_len = get_u32(data + 15)) > len - 19 || name_len > FOXGLOVE_REQUEST_MAX || data[1] > 1) {
		say_status(client, LEVEL_ERROR, "this playback request cannot be read");
		return;
	}
	memcpy(&speed, data + 2, 4);
	memcpy(&seek_ns, data + 7, 8);
	request = (struct foxglove_request){.play = data[1] == 0, .speed = speed, .seek = data[6], .seek_ns = seek_ns};
	if (!host->play)
		say_status(client, LEVEL_ERROR, "nothing is replayed here: playback cannot be controlled");
	else if (!client->may_play)
		say_status(client, LEVEL_ERROR,
		           "playback is controlled from this machine, or with the token in the address (?token=...)");
	else if (!isfinite(speed) || speed <= 0)
		say_status(client, LEVEL_ERROR, "a speed of playback is a number above 0");
	else if (!host->play(host->ctx, &request, error))
		say_status(client, LEVEL_ERROR, "%s", error);
	if (host->playback)
		tell_playback(client, (const char *)data + 19, name_len);
}

/* What clients say */

static void leave_map(struct foxglove_client *client)
{
	if (client->scene.walk)
		publisher_leave(client->scene.walk);
	client->scene.walk = NULL;
}

static int channel_of(const struct foxglove *f, json_int_t id)
{
	return id >= 1 && id <= f->channels ? (int)id - 1 : -1;
}

static struct stream *find_subscription(struct foxglove_client *client, uint32_t subscription)
{
	for (int i = 0; i < CHANNELS_MAX; i++)
		if (client->stream[i].subscribed && client->stream[i].subscription == subscription)
			return &client->stream[i];
	return NULL;
}

static void subscribe_one(struct foxglove_client *client, const json_t *one)
{
	const json_t *id = json_object_get(one, "id"), *channel_id = json_object_get(one, "channelId");
	const json_int_t number = json_integer_value(id);
	int channel;

	if (!json_is_integer(id) || !json_is_integer(channel_id) || number < 0 || number > UINT32_MAX) {
		say_status(client, LEVEL_ERROR, "a subscription has an `id` (0 .. 4294967295) and a `channelId`");
		return;
	}
	channel = channel_of(client->foxglove, json_integer_value(channel_id));
	if (channel < 0) {
		say_status(client, LEVEL_ERROR, "channel %" JSON_INTEGER_FORMAT " does not exist",
		           json_integer_value(channel_id));
	} else if (client->stream[channel].subscribed) {
		say_status(client, LEVEL_WARNING, "channel %d is subscribed already (as %u)", channel + 1,
		           client->stream[channel].subscription);
	} else if (find_subscription(client, (uint32_t)number)) {
		say_status(client, LEVEL_ERROR, "subscription %" JSON_INTEGER_FORMAT " is another one's id", number);
	} else {
		const uint64_t lines = live_lines(client->foxglove->live);

		client->stream[channel] = (struct stream){.subscribed = true, .subscription = (uint32_t)number};
		client->scene.quiet &= channel != CHANNEL_MAP;
		if (channel == CHANNEL_LOG && lines > LIVE_LINES) /* those that are kept come first */
			client->stream[channel].shown = lines - LIVE_LINES;
	}
}

static void unsubscribe_one(struct foxglove_client *client, const json_t *id)
{
	const json_int_t number = json_integer_value(id);
	struct stream *stream = json_is_integer(id) && number >= 0 && number <= UINT32_MAX
	                            ? find_subscription(client, (uint32_t)number)
	                            : NULL;

	if (!stream) {
		say_status(client, LEVEL_WARNING, "there is no such subscription");
		return;
	}
	stream->subscribed = false;
	if (stream != &client->stream[CHANNEL_MAP])
		return;
	client->scene.dismissed = client->scene.talking;
	if (!client->scene.talking)
		leave_map(client);
}

static void hear_list(struct foxglove_client *client, const json_t *message, const char *key,
                      void (*one)(struct foxglove_client *, const json_t *))
{
	const json_t *list = json_object_get(message, key);

	if (!json_is_array(list)) {
		say_status(client, LEVEL_ERROR, "`%s` is missing, or is no list", key);
		return;
	}
	for (size_t i = 0; i < json_array_size(list); i++)
		one(client, json_array_get(list, i));
}

static void hear_fetch(struct foxglove_client *client, const json_t *message)
{
	static const char reason[] = "facetd has no assets";
	struct buffer b = {0};

	put_u8(&b, OP_ASSET);
	put_u32(&b, (uint32_t)json_integer_value(json_object_get(message, "requestId")));
	put_u8(&b, 1);
	put_u32(&b, sizeof(reason) - 1);
	put_text(&b, reason);
	answer_buffer(client, &b, false);
}

/* What servers may offer and this one does not. */
static bool is_foreign(const char *op)
{
	static const char *const ops[] = {"advertise",
	                                  "unadvertise",
	                                  "getParameters",
	                                  "setParameters",
	                                  "subscribeParameterUpdates",
	                                  "unsubscribeParameterUpdates",
	                                  "subscribeConnectionGraph",
	                                  "unsubscribeConnectionGraph"};

	for (size_t i = 0; i < sizeof(ops) / sizeof(ops[0]); i++)
		if (strcmp(op, ops[i]) == 0)
			return true;
	return false;
}

static void hear_text(struct foxglove_client *client, const char *text, size_t len)
{
	json_error_t error;
	json_t *message = json_loadb(text, len, JSON_REJECT_DUPLICATES, &error);
	const char *op = json_string_value(json_object_get(message, "op"));

	if (!op)
		say_status(client, LEVEL_ERROR, "this is no message: a JSON object with an `op` is one");
	else if (strcmp(op, "subscribe") == 0)
		hear_list(client, message, "subscriptions", subscribe_one);
	else if (strcmp(op, "unsubscribe") == 0)
		hear_list(client, message, "subscriptionIds", unsubscribe_one);
	else if (strcmp(op, "fetchAsset") == 0)
		hear_fetch(client, message);
	else if (is_foreign(op))
		say_status(client, LEVEL_WARNING, "facetd only tells: it takes no `%s`", op);
	else
		say_status(client, LEVEL_ERROR, "`%s` is not an operation that facetd knows", plain_word(op));
	json_decref(message);
}

static void hear_call(struct foxglove_client *client, const uint8_t *data, size_t len)
{
	struct buffer b = {0};

	if (len < 9) {
		say_status(client, LEVEL_ERROR, "this call of a service cannot be read");
		return;
	}
	buffer_printf(&b,
	              "{\"op\":\"serviceCallFailure\",\"serviceId\":%u,\"callId\":%u,"
	              "\"message\":\"facetd offers no services\"}",
	              get_u32(data + 1), get_u32(data + 5));
	answer_buffer(client, &b, true);
}

static void hear_binary(struct foxglove_client *client, const uint8_t *data, size_t len)
{
	const int op = len > 0 ? data[0] : 0;

	if (op == OP_HEARD_MESSAGE)
		say_status(client, LEVEL_WARNING, "facetd only tells: it takes no messages");
	else if (op == OP_HEARD_CALL)
		hear_call(client, data, len);
	else if (op == OP_HEARD_PLAYBACK)
		hear_playback(client, data, len);
	else
		say_status(client, LEVEL_ERROR, "%d begins no message that facetd knows", op);
}

void foxglove_hear(struct foxglove_client *client, const uint8_t *data, size_t len, bool text)
{
	if (text)
		hear_text(client, (const char *)data, len);
	else
		hear_binary(client, data, len);
	wake(client);
}

/* The map */

static void begin_message(struct foxglove_client *client, uint32_t subscription, int64_t time_ns)
{
	put_u8(&client->out, OP_MESSAGE);
	put_u32(&client->out, subscription);
	put_u64(&client->out, (uint64_t)time_ns);
}

static void put_deletion(struct foxglove_client *client, bool all, struct patch_key key)
{
	struct scene *scene = &client->scene;
	const struct scene_deletion deletion = {.t_ns = scene->newest_ns + 1, .all = all, .key = key};

	if (!scene->first && client->encoding == SCENE_AS_JSON)
		put_text(&client->out, ",");
	scene->first = false;
	scene_put_deletion(&client->out, client->encoding, &deletion);
}

static void begin_scene(struct foxglove_client *client)
{
	const struct foxglove_host *host = &client->foxglove->host;
	struct scene *scene = &client->scene;
	const int64_t time_ns = host->time(host->ctx);

	scene->newest_ns = time_ns > scene->newest_ns ? time_ns : scene->newest_ns;
	scene->begun = scene->first = true;
	begin_message(client, scene->subscription, time_ns);
	if (client->encoding == SCENE_AS_JSON)
		put_text(&client->out, SCENE_JSON_BEGIN);
	if (scene->reset)
		put_deletion(client, true, (struct patch_key){0});
}

static void put_entity(struct foxglove_client *client, const struct publisher_item *item)
{
	struct scene *scene = &client->scene;

	if (client->encoding == SCENE_AS_JSON)
		put_text(&client->out, scene->entities ? "," : SCENE_JSON_MIDDLE);
	scene->entities = true;
	scene->item = item->bytes;
	scene->item_left = item->len;
	if (item->t_last_ns > scene->newest_ns)
		scene->newest_ns = item->t_last_ns;
}

static void end_scene(struct foxglove_client *client)
{
	struct scene *scene = &client->scene;

	scene->ended = true;
	if (client->encoding == SCENE_AS_JSON) {
		if (!scene->entities)
			put_text(&client->out, SCENE_JSON_MIDDLE);
		put_text(&client->out, SCENE_JSON_END);
	}
}

/* A little more of the message: into `out`, or as an item. */
static void scene_step(struct foxglove_client *client)
{
	struct scene *scene = &client->scene;
	struct publisher_item item;
	int r;

	client->out.len = client->out_at = 0;
	if (!scene->begun) {
		begin_scene(client);
		return;
	}
	r = scene->dismissed ? -ECANCELED : publisher_walk_next(scene->walk, &item);
	if (r == 1 && item.removed) {
		assert(!scene->entities);
		put_deletion(client, false, item.key);
	} else if (r == 1) {
		put_entity(client, &item);
	} else {
		scene->whole = r == 0;
		end_scene(client);
	}
}

static bool scene_pends(const struct foxglove_client *client)
{
	return client->out_at < client->out.len || client->scene.item_left > 0;
}

static size_t scene_copy(struct foxglove_client *client, uint8_t *buf, size_t cap)
{
	struct scene *scene = &client->scene;
	const size_t left = client->out.len - client->out_at;
	size_t n;

	if (left > 0) {
		n = left < cap ? left : cap;
		memcpy(buf, client->out.data + client->out_at, n);
		client->out_at += n;
		return n;
	}
	n = scene->item_left < cap ? scene->item_left : cap;
	memcpy(buf, scene->item, n);
	scene->item += n;
	scene->item_left -= n;
	return n;
}

/* The message was said to its end. */
static void scene_said(struct foxglove_client *client, int64_t t_ns)
{
	struct scene *scene = &client->scene;
	const bool broken = client->out.error != 0;

	scene->talking = false;
	if (broken)
		buffer_finish(&client->out);
	if (scene->whole && !broken)
		publisher_walk_commit(scene->walk);
	client->messages++;
	client->stream[CHANNEL_MAP].next_ns = t_ns + (broken ? RETRY_NS : FOXGLOVE_MAP_NS);
	if (scene->dismissed)
		leave_map(client);
	scene->dismissed = false;
}

static size_t scene_next(struct foxglove_client *client, uint8_t *buf, size_t cap, int64_t t_ns, bool *ret_final)
{
	size_t n = 0;

	for (;;) {
		while (!scene_pends(client) && !client->scene.ended)
			scene_step(client);
		if (!scene_pends(client) || n == cap)
			break;
		n += scene_copy(client, buf + n, cap - n);
	}
	*ret_final = !scene_pends(client);
	if (*ret_final)
		scene_said(client, t_ns);
	return n;
}

/* True: a message is begun. */
static bool scene_begin(struct foxglove_client *client)
{
	struct scene *scene = &client->scene;
	struct native_want want = {0};
	struct native_begin begin;

	if (!scene->walk)
		scene->walk = publisher_join_walk(client->foxglove->publisher, &want,
		                                  client->encoding == SCENE_AS_JSON ? PUBLISHER_SCENE_JSON
		                                                                    : PUBLISHER_SCENE_PROTOBUF);
	scene->quiet = !scene->walk || publisher_walk_begin(scene->walk, &begin) != 1;
	if (scene->quiet)
		return false;
	scene->talking = true;
	scene->reset = begin.reset;
	scene->begun = scene->ended = scene->whole = scene->entities = false;
	scene->subscription = client->stream[CHANNEL_MAP].subscription;
	scene->item_left = 0;
	return true;
}

/* The other channels */

/* Of channels that follow what is measured: its number now. */
static uint64_t sequence_of(const struct foxglove_client *client, int channel)
{
	const struct live *live = client->foxglove->live;
	uint64_t sequence = 0;
	struct pose pose;

	if (channel == CHANNEL_TF)
		return live_transforms_sequence(live);
	if (channel == CHANNEL_LOG)
		return live_lines(live);
	if (channel == CHANNEL_POSE)
		return live_pose_now(live, &pose, &sequence) ? sequence : client->stream[channel].shown;
	return live_scanner(live, channel - CHANNEL_SCANS)->sequence;
}

static bool has_news(const struct foxglove_client *client, int channel)
{
	if (!client->stream[channel].subscribed)
		return false;
	if (channel == CHANNEL_MAP)
		return !client->scene.quiet;
	return channel == CHANNEL_STATUS || client->stream[channel].shown != sequence_of(client, channel);
}

static int64_t period_ns(int channel)
{
	if (channel == CHANNEL_LOG)
		return 0;
	if (channel == CHANNEL_STATUS)
		return FOXGLOVE_STATUS_NS;
	return channel >= CHANNEL_SCANS ? FOXGLOVE_SCAN_NS : FOXGLOVE_POSE_NS;
}

static void put_log(struct foxglove_client *client, struct stream *stream)
{
	const struct live *live = client->foxglove->live;
	const uint64_t lines = live_lines(live);
	struct live_line line;

	if (lines - stream->shown > LIVE_LINES)
		stream->shown = lines - LIVE_LINES;
	if (live_line(live, stream->shown + 1, &line))
		foxglove_put_log(&client->out, client->encoding, &line);
	stream->shown++;
}

static void put_measured(struct foxglove_client *client, int channel, int64_t time_ns)
{
	const struct live *live = client->foxglove->live;
	struct live_transform transform[LIVE_TRANSFORMS_MAX];
	struct stream *stream = &client->stream[channel];
	struct pose pose;

	if (channel == CHANNEL_TF) {
		stream->shown = live_transforms_sequence(live);
		foxglove_put_transforms(&client->out, client->encoding, transform, live_transforms(live, transform),
		                        time_ns);
	} else if (channel == CHANNEL_POSE) {
		if (live_pose_now(live, &pose, &stream->shown))
			foxglove_put_pose(&client->out, client->encoding, &pose);
	} else {
		const struct live_scanner *scanner = live_scanner(live, channel - CHANNEL_SCANS);

		stream->shown = scanner->sequence;
		foxglove_put_scan(&client->out, client->encoding, &scanner->profile, scanner->laser_frame);
	}
}

static void put_message(struct foxglove_client *client, int channel, int64_t t_ns)
{
	const struct foxglove_host *host = &client->foxglove->host;
	struct stream *stream = &client->stream[channel];
	const int64_t time_ns = host->time(host->ctx);

	client->out_text = false;
	begin_message(client, stream->subscription, time_ns);
	if (channel == CHANNEL_LOG)
		put_log(client, stream);
	else if (channel == CHANNEL_STATUS)
		host->status(host->ctx, &client->out);
	else
		put_measured(client, channel, time_ns);
	stream->next_ns = t_ns + period_ns(channel);
}

/* What to say next */

static bool any_subscribed(const struct foxglove_client *client)
{
	for (int i = 0; i < client->foxglove->channels; i++)
		if (client->stream[i].subscribed)
			return true;
	return false;
}

/* Who shows a replay follows its clock even before it has subscribed. */
static bool wants_time(const struct foxglove_client *client)
{
	return client->greeted && client->advertised && (client->foxglove->host.playback || any_subscribed(client));
}

static bool say_greeting(struct foxglove_client *client)
{
	client->out_text = true;
	if (!client->greeted)
		put_server_info(&client->out, client);
	else if (!client->advertised)
		put_advertise(&client->out, client);
	else
		return false;
	client->advertised = client->greeted;
	client->greeted = true;
	return true;
}

static bool say_answer(struct foxglove_client *client)
{
	struct buffer *b = &client->answers;
	const uint8_t *at;
	uint32_t len;

	if (client->answers_at == b->len) {
		if (b->cap > 0) /* they are rare: no memory is kept for them */
			buffer_finish(b);
		client->answers_at = 0;
		return false;
	}
	at = b->data + client->answers_at;
	len = get_u32(at);
	client->out_text = at[4];
	buffer_append(&client->out, at + ANSWER_HEAD, len);
	client->answers_at += ANSWER_HEAD + len;
	return true;
}

static bool say_time(struct foxglove_client *client, int64_t t_ns)
{
	const struct foxglove_host *host = &client->foxglove->host;
	const uint64_t time_ns = (uint64_t)host->time(host->ctx);

	if (!wants_time(client) || t_ns < client->time.next_ns)
		return false;
	client->time.next_ns = t_ns + FOXGLOVE_POSE_NS;
	if (time_ns == client->time.shown)
		return false;
	client->time.shown = time_ns;
	client->out_text = false;
	put_u8(&client->out, OP_TIME);
	put_u64(&client->out, time_ns);
	return true;
}

/* In turns, so that a map that always has news leaves the others theirs. */
static bool say_channel(struct foxglove_client *client, int64_t t_ns)
{
	const unsigned channels = (unsigned)client->foxglove->channels;

	for (unsigned i = 0; i < channels; i++) {
		const unsigned channel = (client->turn + i) % channels;

		if (!client->stream[channel].subscribed || t_ns < client->stream[channel].next_ns)
			continue;
		if (channel != CHANNEL_MAP && !has_news(client, (int)channel))
			continue;
		if (channel == CHANNEL_MAP && !scene_begin(client))
			continue;
		client->turn = channel + 1;
		if (channel != CHANNEL_MAP)
			put_message(client, (int)channel, t_ns);
		return true;
	}
	return false;
}

/* Into `out`, or a scene is begun. */
static bool say_something(struct foxglove_client *client, int64_t t_ns)
{
	client->out.len = client->out_at = 0;
	if (say_greeting(client))
		return true;
	if (client->out.cap > FOXGLOVE_ANSWERS_MAX * 4) /* the greeting was long, and once */
		buffer_finish(&client->out);
	if (t_ns >= client->time.next_ns)
		look_at_playback(client);
	return say_answer(client) || say_time(client, t_ns) || say_channel(client, t_ns);
}

size_t foxglove_next(struct foxglove_client *client, uint8_t *buf, size_t cap, int64_t t_ns, bool *ret_text,
                     bool *ret_final)
{
	size_t n = 0;

	assert(cap > 0);
	*ret_final = true;
	if (t_ns < client->joined_ns + FOXGLOVE_SETTLE_NS || foxglove_reason(client)) {
		client->told_ns = foxglove_deadline(client);
		return 0;
	}
	if (!client->scene.talking && client->out_at == client->out.len && !say_something(client, t_ns)) {
		client->told_ns = foxglove_deadline(client);
		return 0;
	}
	*ret_text = !client->scene.talking && client->out_text;
	if (client->scene.talking) {
		n = scene_next(client, buf, cap, t_ns, ret_final);
	} else if (client->out.error) { /* memory is out: this one is not said */
		buffer_finish(&client->out);
		client->out_at = 0;
		client->dropped++;
	} else {
		n = client->out.len - client->out_at < cap ? client->out.len - client->out_at : cap;
		memcpy(buf, client->out.data + client->out_at, n);
		client->out_at += n;
		*ret_final = client->out_at == client->out.len;
		client->messages += *ret_final;
	}
	client->told_ns = foxglove_deadline(client);
	return n;
}

int64_t foxglove_deadline(const struct foxglove_client *client)
{
	const int64_t settled_ns = client->joined_ns + FOXGLOVE_SETTLE_NS;
	int64_t deadline_ns = INT64_MAX;

	if (foxglove_reason(client))
		return INT64_MAX;
	if (!client->advertised || client->scene.talking || client->out_at < client->out.len ||
	    client->answers_at < client->answers.len)
		return settled_ns;
	if (wants_time(client))
		deadline_ns = client->time.next_ns;
	for (int i = 0; i < client->foxglove->channels; i++)
		if (has_news(client, i))
			deadline_ns = earlier(deadline_ns, client->stream[i].next_ns);
	return deadline_ns > settled_ns ? deadline_ns : settled_ns;
}

const char *foxglove_reason(const struct foxglove_client *client)
{
	return client->scene.walk && !client->scene.talking ? publisher_reason(client->scene.walk) : NULL;
}

void foxglove_client_stats(const struct foxglove_client *client, struct foxglove_client_stats *ret)
{
	*ret = (struct foxglove_client_stats){.messages = client->messages, .dropped = client->dropped};
	if (client->scene.walk)
		publisher_client_stats(client->scene.walk, &ret->map);
	ret->bytes = sizeof(*client) + client->out.cap + client->answers.cap + ret->map.bytes;
}

/* Life */

struct foxglove_client *foxglove_join(struct foxglove *f, enum scene_encoding encoding, bool may_play,
                                      const struct foxglove_wire *wire, int64_t t_ns)
{
	struct foxglove_client *client = calloc(1, sizeof(*client));

	if (!client)
		return NULL;
	client->foxglove = f;
	client->encoding = encoding;
	client->may_play = may_play;
	client->wire = *wire;
	client->joined_ns = t_ns;
	client->told_ns = INT64_MAX;
	client->next = f->clients;
	f->clients = client;
	return client;
}

void foxglove_leave(struct foxglove_client *client)
{
	struct foxglove_client **link = &client->foxglove->clients;

	while (*link != client)
		link = &(*link)->next;
	*link = client->next;
	leave_map(client);
	buffer_finish(&client->out);
	buffer_finish(&client->answers);
	free(client);
}

struct foxglove *foxglove_create(struct publisher *publisher, struct live *live, const struct foxglove_host *host)
{
	struct foxglove *f = calloc(1, sizeof(*f));

	assert(host->now && host->time && host->status && !host->playback == !host->play);
	if (!f)
		return NULL;
	f->publisher = publisher;
	f->live = live;
	f->host = *host;
	f->channels = CHANNEL_SCANS + live_scanners(live);
	f->begun_ns = host->now(host->ctx);
	live_listen(live, on_live, f);
	return f;
}

void foxglove_destroy(struct foxglove *f)
{
	if (!f)
		return;
	assert(!f->clients);
	live_listen(f->live, NULL, NULL);
	free(f);
}

static void encode_json(void *ctx, struct buffer *b, const struct patch *patch)
{
	scene_put_entity(b, SCENE_AS_JSON, patch, *(const double *)ctx);
}

static void encode_protobuf(void *ctx, struct buffer *b, const struct patch *patch)
{
	scene_put_entity(b, SCENE_AS_PROTOBUF, patch, *(const double *)ctx);
}

void foxglove_encoders(struct publisher_params *params, const double *cell_m)
{
	void *ctx = (void *)(uintptr_t)cell_m; /* only read */

	params->encoder[PUBLISHER_SCENE_JSON] = (struct publisher_encoder){encode_json, ctx};
	params->encoder[PUBLISHER_SCENE_PROTOBUF] = (struct publisher_encoder){encode_protobuf, ctx};
}

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
#include "daemon/foxglove_parts.h"

#include <assert.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/foxglove_messages.h"
#include "daemon/foxglove_schema.h"

/* Waking */

static int64_t earlier(int64_t a, int64_t b)
{
	return a < b ? a : b;
}

/* The wire asks again only when it is told to, or when the time it knows of has come. */
void foxglove_wake(struct foxglove_client *client)
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
		foxglove_wake(client);
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

/* Messages */

void foxglove_begin_message(struct foxglove_client *client, uint32_t subscription, int64_t time_ns)
{
	put_u8(&client->out, OP_MESSAGE);
	put_u32(&client->out, subscription);
	put_u64(&client->out, (uint64_t)time_ns);
}

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
	foxglove_begin_message(client, stream->subscription, time_ns);
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
		if (channel == CHANNEL_MAP && !foxglove_map_begin(client))
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
		foxglove_look_at_playback(client);
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
		n = foxglove_map_next(client, buf, cap, t_ns, ret_final);
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
	foxglove_map_leave(client);
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

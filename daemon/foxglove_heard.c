/* What Foxglove clients say, and what they are answered. Nothing here is trusted: a message is at most 64 KB long, a list in it
 * names subscriptions of which there are as many as channels, and answers that nobody reads are dropped. */
#include "daemon/foxglove_parts.h"

#include <jansson.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

/* Answers */

static void answer(struct foxglove_client *client, const void *data, size_t len, bool text)
{
	struct buffer *b = &client->answers;
	size_t before;

	if (b->len - client->answers_at + len > FOXGLOVE_ANSWERS_MAX) {
		client->dropped++;
		return;
	}
	if (client->answers_at > 0) { /* what was said makes room */
		memmove(b->data, b->data + client->answers_at, b->len - client->answers_at);
		b->len -= client->answers_at;
		client->answers_at = 0;
	}
	before = b->len;
	put_u32(b, (uint32_t)len);
	put_u8(b, text);
	buffer_append(b, data, len);
	if (b->error) { /* whole or not at all */
		b->len = before;
		b->error = 0;
		client->dropped++;
	}
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

void foxglove_look_at_playback(struct foxglove_client *client)
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
		foxglove_map_leave(client);
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
	foxglove_wake(client);
}

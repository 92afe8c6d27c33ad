/* One connection, two kinds of messages.
 *
 *   binary   to us: whole frames (WANT, JSON, PING)      from us: whole frames, one or more a message, long ones in pieces
 *   text     to us: a command as in JSON lines           from us: its answer; events and a status a second after ?WATCH
 *
 * Answers go the way the command came. A message is never begun inside another, so a text waits for the end of a frame. */
#include "daemon/web_native.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define STATUS_EVERY_NS 1000000000ll

enum way { WAY_TEXT, WAY_FRAME };

struct speech {
	struct web_connection *connection;
	struct publisher_client *client; /* after its WANT */
	struct buffer texts;             /* {u32 length, text}, waiting */
	size_t texts_at, text_left;      /* text_left: of the message that is being said */
	bool frame_begun;                /* a binary message is being said */
	bool watches, held;
	enum way watches_way;
	int64_t status_ns; /* of the next status */
};

static void *open_speech(void *ctx, struct web_connection *connection, const char *name)
{
	struct speech *s = calloc(1, sizeof(*s));

	(void)ctx;
	(void)name;
	if (s)
		s->connection = connection;
	return s;
}

static void close_speech(void *state)
{
	struct speech *s = state;

	if (s->client)
		publisher_leave(s->client);
	buffer_finish(&s->texts);
	free(s);
}

/* Speaking */

static size_t waiting(const struct speech *s)
{
	return s->texts.len - s->texts_at;
}

static void put_text(struct speech *s, const void *text, size_t len)
{
	const uint32_t n = (uint32_t)len;

	if (n == 0)
		return;
	buffer_append(&s->texts, &n, sizeof(n));
	buffer_append(&s->texts, text, len);
	if (!s->held && waiting(s) > WEB_NATIVE_TEXTS_MAX) {
		s->held = true;
		web_hold(s->connection, true);
	}
}

static void say(struct speech *s, enum way way, const struct buffer *text)
{
	if (text->error)
		return;
	if (way == WAY_FRAME && s->client)
		publisher_json(s->client, (const char *)text->data, text->len);
	else
		put_text(s, text->data, text->len);
	if (s->texts.error)
		web_close(s->connection, 1011, "out of memory");
	web_wake_one(s->connection);
}

static void say_error(struct speech *s, enum way way, const char *sentence)
{
	struct buffer text = {0};

	control_put_error(&text, sentence);
	say(s, way, &text);
	buffer_finish(&text);
}

/* What is left of the text at the front, or the next one. */
static size_t next_text(struct speech *s, uint8_t *buf, size_t cap, struct web_piece *ret)
{
	uint32_t len;
	size_t n;

	if (s->text_left == 0) {
		memcpy(&len, s->texts.data + s->texts_at, sizeof(len));
		s->texts_at += sizeof(len);
		s->text_left = len;
	}
	n = s->text_left < cap ? s->text_left : cap;
	memcpy(buf, s->texts.data + s->texts_at, n);
	s->texts_at += n;
	s->text_left -= n;
	*ret = (struct web_piece){.text = true, .final = s->text_left == 0};
	if (waiting(s) == 0) {
		buffer_finish(&s->texts);
		s->texts_at = 0;
	}
	if (s->held && waiting(s) < WEB_NATIVE_TEXTS_MAX / 2) {
		s->held = false;
		web_hold(s->connection, false);
	}
	return n;
}

static size_t next_frames(struct speech *s, uint8_t *buf, size_t cap, int64_t t_ns, struct web_piece *ret)
{
	const uint8_t *bytes;
	size_t n = publisher_peek(s->client, t_ns, &bytes), taken = n < cap ? n : cap;

	if (n == 0)
		return 0;
	memcpy(buf, bytes, taken);
	*ret = (struct web_piece){.final = publisher_ends_frame(s->client, taken)};
	s->frame_begun = !ret->final;
	publisher_wrote(s->client, taken, t_ns);
	return taken;
}

static void tell_status(struct speech *s, int64_t t_ns)
{
	if (!s->watches || t_ns < s->status_ns)
		return;
	s->status_ns = t_ns + STATUS_EVERY_NS;
	/* One that does not read misses messages, not memory. */
	if (waiting(s) < WEB_NATIVE_TEXTS_MAX / 2)
		say(s, s->watches_way, web_status(s->connection));
}

static size_t next(void *state, uint8_t *buf, size_t cap, int64_t t_ns, struct web_piece *ret)
{
	struct speech *s = state;
	size_t n = 0;

	tell_status(s, t_ns);
	if (!s->frame_begun && waiting(s) > 0)
		return next_text(s, buf, cap, ret);
	if (s->client)
		n = next_frames(s, buf, cap, t_ns, ret);
	if (n == 0 && s->client && publisher_done(s->client))
		web_close(s->connection, 1008, publisher_reason(s->client));
	return n;
}

static int64_t deadline(const void *state)
{
	const struct speech *s = state;
	const int64_t status_ns = s->watches ? s->status_ns : INT64_MAX,
	              paced_ns = s->client ? publisher_deadline(s->client) : INT64_MAX;

	return status_ns < paced_ns ? status_ns : paced_ns;
}

static void event(void *state, const char *text, size_t len)
{
	struct speech *s = state;
	struct buffer copy = {0};

	if (!s->watches || waiting(s) > WEB_NATIVE_TEXTS_MAX / 2)
		return;
	buffer_append(&copy, text, len);
	say(s, s->watches_way, &copy);
	buffer_finish(&copy);
}

/* Hearing */

static bool may(const struct speech *s, enum control_word word)
{
	const struct web_rights *rights = web_rights(s->connection);

	return !control_changes(word) || rights->may_change || (rights->may_play && control_plays(word));
}

/* Into the answer to ?WATCH: a page offers what it may do, and no more. */
static void put_rights(struct buffer *answer, const struct web_rights *rights)
{
	answer->len--; /* the brace */
	buffer_printf(answer, ",\"may\":{\"change\":%s,\"play\":%s}}", rights->may_change ? "true" : "false",
	              rights->may_play ? "true" : "false");
}

static void do_command(struct speech *s, enum way way, const struct control_command *command)
{
	const struct server_host *host = web_server_host(s->connection);
	struct buffer text = {0};
	char error[200];

	if (!may(s, command->word)) {
		say_error(
		    s, way,
		    "commands that change something need the token of listen.token_file: open ws://.../?token=TOKEN");
		return;
	}
	if (command->stream) {
		say_error(s, way, "a recording is taken over the unix socket: facet record unix:PATH");
		return;
	}
	if (control_changes(command->word)) {
		if (!host->command(host->ctx, command, error)) {
			say_error(s, way, error);
			return;
		}
		web_forget_status(s->connection); /* who changes something and asks sees the change */
	}
	if (command->word == CONTROL_WATCH) {
		s->watches = command->enable;
		s->watches_way = way;
		s->status_ns = 0;
	}
	if (command->word == CONTROL_STATUS) {
		say(s, way, web_status(s->connection));
		return;
	}
	control_put_answer(&text, command);
	if (command->word == CONTROL_WATCH)
		put_rights(&text, web_rights(s->connection));
	say(s, way, &text);
	buffer_finish(&text);
}

static void hear_command(struct speech *s, enum way way, const char *text, size_t len)
{
	struct control_command command;
	char error[200];

	if (control_parse(text, len, &command, error) < 0)
		say_error(s, way, error);
	else
		do_command(s, way, &command);
}

static void hear_want(struct speech *s, const struct native_want *want)
{
	if (s->client)
		publisher_want(s->client, want);
	else
		s->client = publisher_join(web_publisher(s->connection), want);
	if (!s->client)
		web_close(s->connection, 1011, "out of memory");
	web_wake_one(s->connection);
}

/* One frame from the front; bytes taken, 0: the connection is to be closed. */
static size_t hear_frame(struct speech *s, const uint8_t *data, size_t len)
{
	ssize_t n = native_scan(data, len, NATIVE_FROM_CLIENT_MAX);
	struct native_message message;
	char error[128];
	int r;

	if (n <= 0) {
		web_close(s->connection, 1002, "a binary message holds whole frames of the native protocol");
		return 0;
	}
	r = native_decode(data, (size_t)n, &message, error);
	if (r == -ENOTSUP)
		return (size_t)n;
	if (r < 0) {
		web_close(s->connection, 1002, error);
		return 0;
	}
	if (message.type == NATIVE_WANT)
		hear_want(s, &message.want);
	else if (message.type == NATIVE_JSON)
		hear_command(s, WAY_FRAME, message.json.text, message.json.len);
	else if (message.type != NATIVE_PING)
		web_close(s->connection, 1002, "a message that only the server sends");
	native_message_finish(&message);
	return (size_t)n;
}

static void hear(void *state, const uint8_t *data, size_t len, bool text)
{
	struct speech *s = state;
	size_t at = 0, n = 1;

	if (text)
		hear_command(s, WAY_TEXT, (const char *)data, len);
	while (!text && at < len && n > 0) {
		n = hear_frame(s, data + at, len - at);
		at += n;
	}
}

static void fill_stats(const void *state, struct control_client *ret)
{
	const struct speech *s = state;
	struct publisher_client_stats stats = {0};

	if (s->client)
		publisher_client_stats(s->client, &stats);
	ret->step = stats.step;
	ret->behind = stats.behind_steps;
	ret->behind_peak = stats.behind_peak;
	ret->queued = stats.queued + waiting(s);
	ret->batches = stats.batches;
	ret->aborts = stats.aborts;
}

static const char *const names[] = {"facetd.v1", NULL};

const struct web_language web_native_language = {.names = names,
                                                 .kind = "web",
                                                 .open = open_speech,
                                                 .hear = hear,
                                                 .next = next,
                                                 .deadline = deadline,
                                                 .event = event,
                                                 .stats = fill_stats,
                                                 .close = close_speech};

/* The wire of the native protocol: a walk as frames, with HELLO before it, JSON messages between, and a limited rate.
 *
 * Frames are gathered in a small buffer, so that a batch of many small ones is few writes; what does not fit in is taken
 * over piece by piece from the sheet, which is not copied for the client. Nothing else queues: the next frame is chosen
 * when there is room for it.
 *
 * Compressed frames are made once a patch, as every form is. Coded patches share frames and are not compressed on top:
 * zstd takes 5 % more off them, and would have to do it for every client anew. */
#include "daemon/publisher_client.h"

#include <assert.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

struct native_stream *native_stream_create(void)
{
	return calloc(1, sizeof(struct native_stream));
}

void native_stream_destroy(struct native_stream *stream)
{
	if (!stream)
		return;
	buffer_finish(&stream->small);
	buffer_finish(&stream->json);
	free(stream);
}

static size_t pending(const struct native_stream *stream)
{
	return stream->small.len - stream->small_at + stream->source_left;
}

size_t native_stream_queued(const struct native_stream *stream)
{
	return stream->out_len - stream->out_at + pending(stream) + stream->json.len;
}

/* Frames */

#define NO_FRAME SIZE_MAX

/* The open frame, all of which is in `out`, takes no more: the times and versions that its patches share make it a tenth
 * shorter by zstd. One that cannot be packed goes as it is. */
static void close_frame(struct native_stream *stream)
{
	const size_t at = stream->open_at, len = stream->out_len - at;
	struct buffer packed = {0};

	stream->open_at = NO_FRAME;
	if (at == NO_FRAME || !stream->packer)
		return;
	if (native_put_packed(stream->packer, &packed, stream->out + at, len) == 0 && packed.len < len) {
		memcpy(stream->out + at, packed.data, packed.len);
		stream->out_len = at + packed.len;
	}
	buffer_finish(&packed);
}

/* What is in `small` comes next. */
static void send_small(struct native_stream *stream)
{
	stream->small_at = 0;
	close_frame(stream);
	if (stream->small.error)
		stream->broken = true;
}

static void send_hello(struct publisher_client *client, int64_t t_ns)
{
	const struct publisher *p = client->publisher;
	struct native_hello hello = {.major = NATIVE_MAJOR,
	                             .minor = NATIVE_MINOR,
	                             .generation = p->generation,
	                             .cell_m = p->params.cell_m,
	                             .step = p->step,
	                             .t_ns = t_ns};

	memcpy(hello.map_id, p->params.map_id, sizeof(hello.map_id));
	native_put_hello(&client->stream->small, &hello);
	send_small(client->stream);
	client->stream->greeted = p->generation;
}

static void send_reason(struct publisher_client *client)
{
	struct native_stream *stream = client->stream;
	char text[256];
	int n = snprintf(text, sizeof(text), "{\"class\":\"ERROR\",\"error\":\"%s\"}", client->reason);

	if (stream->greeted != client->publisher->generation)
		stream->json.len = 0; /* answers come after HELLO, which it will not get */
	native_put_json(&stream->small, text, (size_t)n);
	send_small(stream);
	stream->reason_sent = true;
}

static void send_json(struct native_stream *stream)
{
	struct buffer empty = stream->small;

	stream->small = stream->json;
	stream->json = empty;
	stream->json.len = 0;
	send_small(stream);
}

static bool send_begin(struct publisher_client *client)
{
	struct native_begin begin;
	int r = publisher_walk_begin(client, &begin);

	if (r < 0)
		publisher_dismiss(client, "no memory for a batch");
	if (r <= 0)
		return r < 0;
	native_put_begin(&client->stream->small, &begin);
	send_small(client->stream);
	return true;
}

/* Coded patches are small: as many as fit into the buffer share a frame, which is open as long as only such come. */
static void send_coded(struct native_stream *stream, const struct publisher_item *item)
{
	if (stream->open_at != NO_FRAME && item->len <= STREAM_OUT_BYTES - stream->out_len) {
		uint8_t *head = stream->out + stream->open_at;
		uint32_t length;

		memcpy(&length, head, sizeof(length));
		length += (uint32_t)item->len;
		memcpy(head, &length, sizeof(length));
		memcpy(stream->out + stream->out_len, item->bytes, item->len);
		stream->out_len += item->len;
		return;
	}
	native_put_coded_head(&stream->small, item->len);
	send_small(stream);
	stream->source = item->bytes;
	stream->source_left = item->len;
	if (pending(stream) <= STREAM_OUT_BYTES - stream->out_len)
		stream->open_at = stream->out_len;
}

static void send_item(struct publisher_client *client)
{
	struct native_stream *stream = client->stream;
	enum publisher_form form = client->form;
	struct publisher_item item;
	int r = publisher_walk_next(client, &item);

	if (r == 1 && !item.removed && form == PUBLISHER_CODED) {
		send_coded(stream, &item);
		return;
	}
	if (r == 1 && !item.removed) {
		stream->source = item.bytes;
		stream->source_left = item.len;
	} else if (r == 1) {
		native_put_remove(&stream->small, item.key);
	} else {
		native_put_step(&stream->small, r == 0 ? NATIVE_COMMIT : NATIVE_ABORT, client->batch_step);
	}
	if (r == 0)
		publisher_walk_commit(client);
	if (r == -ENOMEM)
		publisher_dismiss(client, "no memory for a batch");
	send_small(stream);
}

/* Chooses the next frame; false: nothing is to be sent now. An ABORT comes before everything that is no batch's. */
static bool send_next(struct publisher_client *client, int64_t t_ns)
{
	struct native_stream *stream = client->stream;
	bool greeted = stream->greeted == client->publisher->generation;

	stream->small.len = stream->small_at = 0;
	publisher_client_let_go(client);
	if (stream->broken)
		return false;
	if (stream->json.len > 0 && greeted)
		send_json(stream);
	else if (stream->reason_sent)
		return false;
	else if (client->state != CLIENT_IDLE)
		send_item(client);
	else if (client->dismissed)
		send_reason(client);
	else if (!greeted)
		send_hello(client, t_ns);
	else
		return send_begin(client);
	return true;
}

static void append(struct native_stream *stream, const uint8_t *bytes, size_t n)
{
	memcpy(stream->out + stream->out_len, bytes, n);
	stream->out_len += n;
}

static void gather(struct publisher_client *client, int64_t t_ns)
{
	struct native_stream *stream = client->stream;

	stream->out_at = stream->out_len = 0;
	stream->open_at = NO_FRAME;
	while (stream->out_len < STREAM_OUT_BYTES) {
		size_t room = STREAM_OUT_BYTES - stream->out_len, n = stream->small.len - stream->small_at;

		if (pending(stream) == 0) {
			if (!send_next(client, t_ns) || stream->broken)
				return;
		} else if (n > 0) {
			n = n < room ? n : room;
			append(stream, stream->small.data + stream->small_at, n);
			stream->small_at += n;
		} else {
			n = stream->source_left < room ? stream->source_left : room;
			append(stream, stream->source, n);
			stream->source += n;
			stream->source_left -= n;
		}
	}
}

static void fill(struct publisher_client *client, int64_t t_ns)
{
	gather(client, t_ns);
	close_frame(client->stream);
}

/* The rate */

size_t publisher_peek(struct publisher_client *client, int64_t t_ns, const uint8_t **ret)
{
	struct native_stream *stream = client->stream;
	size_t n, burst = stream->bytes_per_s / 10 + 64;

	if (stream->bytes_per_s && t_ns < stream->next_ns)
		return 0;
	if (stream->out_at == stream->out_len)
		fill(client, t_ns);
	n = stream->out_len - stream->out_at;
	*ret = stream->out + stream->out_at;
	return stream->bytes_per_s && n > burst ? burst : n;
}

void publisher_wrote(struct publisher_client *client, size_t n, int64_t t_ns)
{
	struct native_stream *stream = client->stream;

	assert(n <= stream->out_len - stream->out_at);
	stream->out_at += n;
	client->stats.sent += n;
	if (stream->bytes_per_s) {
		int64_t from = stream->next_ns > t_ns ? stream->next_ns : t_ns;

		stream->next_ns = from + (int64_t)(n * 1000000000ull / stream->bytes_per_s);
	}
}

bool publisher_ends_frame(const struct publisher_client *client, size_t n)
{
	const struct native_stream *stream = client->stream;

	return n == stream->out_len - stream->out_at && pending(stream) == 0;
}

int64_t publisher_deadline(const struct publisher_client *client)
{
	return client->stream->bytes_per_s ? client->stream->next_ns : INT64_MAX;
}

/* Messages */

size_t publisher_json_room(const struct publisher_client *client)
{
	size_t used = client->stream->json.len + NATIVE_HEAD + 1;

	return used > PUBLISHER_JSON_MAX || client->dismissed ? 0 : PUBLISHER_JSON_MAX - used;
}

bool publisher_json(struct publisher_client *client, const char *text, size_t len)
{
	if (client->dismissed || len > publisher_json_room(client)) {
		client->stats.skipped_json++;
		return false;
	}
	native_put_json(&client->stream->json, text, len);
	return true;
}

void publisher_ping(struct publisher_client *client)
{
	if (client->stream->json.len + NATIVE_HEAD <= PUBLISHER_JSON_MAX)
		native_put_ping(&client->stream->json);
}

void native_stream_want(struct publisher_client *client, const struct native_want *want)
{
	struct sheets *sheets = &client->publisher->sheets;
	const uint8_t both = NATIVE_WANT_CODED | NATIVE_WANT_ZSTD;

	client->stream->bytes_per_s = want->bytes_per_s;
	client->stream->packer = (want->flags & both) == both ? sheets_packer(sheets) : NULL;
	client->form = want->flags & NATIVE_WANT_CODED  ? PUBLISHER_CODED
	               : want->flags & NATIVE_WANT_ZSTD ? PUBLISHER_PACKED
	                                                : PUBLISHER_NATIVE;
}

/* The end */

const char *publisher_reason(const struct publisher_client *client)
{
	if (client->dismissed)
		return client->reason;
	return client->stream && client->stream->broken ? "no memory for a message" : NULL;
}

bool publisher_done(const struct publisher_client *client)
{
	const struct native_stream *stream = client->stream;

	return stream->broken || (stream->reason_sent && pending(stream) == 0 && stream->out_at == stream->out_len &&
	                          stream->json.len == 0);
}

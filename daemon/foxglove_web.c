/* One connection of the web that speaks Foxglove's protocol. JSON unless the address says ?encoding=protobuf: a client has no
 * other way to choose before channels are advertised, and two channels of one topic are an error to Foxglove. */
#include "daemon/foxglove_web.h"

#include <stdlib.h>
#include <string.h>

#define TRY_AGAIN_LATER 1013 /* RFC 6455's registry of close codes */

struct listener {
	struct foxglove_client *client;
	struct web_connection *connection;
};

static void wake(void *ctx)
{
	web_wake_one(ctx);
}

static void *open_listener(void *ctx, struct web_connection *connection, const char *name)
{
	const struct server_host *host = web_server_host(connection);
	const struct foxglove_wire wire = {connection, wake};
	struct listener *listener = calloc(1, sizeof(*listener));
	char encoding[16] = "";

	(void)name;
	if (!listener)
		return NULL;
	web_query(connection, "encoding", encoding, sizeof(encoding));
	listener->connection = connection;
	listener->client = foxglove_join(ctx, strcmp(encoding, "protobuf") == 0 ? SCENE_AS_PROTOBUF : SCENE_AS_JSON,
	                                 web_rights(connection)->may_play, &wire, host->now(host->ctx));
	if (listener->client)
		return listener;
	free(listener);
	return NULL;
}

static void hear(void *state, const uint8_t *data, size_t len, bool text)
{
	foxglove_hear(((struct listener *)state)->client, data, len, text);
}

static size_t next(void *state, uint8_t *buf, size_t cap, int64_t t_ns, struct web_piece *ret)
{
	struct listener *listener = state;
	const size_t n = foxglove_next(listener->client, buf, cap, t_ns, &ret->text, &ret->final);
	const char *reason = foxglove_reason(listener->client);

	if (n == 0 && reason)
		web_close(listener->connection, TRY_AGAIN_LATER, reason);
	return n;
}

static int64_t deadline(const void *state)
{
	return foxglove_deadline(((const struct listener *)state)->client);
}

static void stats(const void *state, struct control_client *ret)
{
	struct foxglove_client_stats stats;

	foxglove_client_stats(((const struct listener *)state)->client, &stats);
	ret->step = stats.map.step;
	ret->behind = stats.map.behind_steps;
	ret->behind_peak = stats.map.behind_peak;
	ret->queued = stats.bytes;
	ret->batches = stats.map.batches;
	ret->aborts = stats.map.aborts;
}

static void close_listener(void *state)
{
	struct listener *listener = state;

	foxglove_leave(listener->client);
	free(listener);
}

static const char *const names[] = {"foxglove.sdk.v1", "foxglove.websocket.v1", NULL};

const struct web_language foxglove_language = {
    .names = names,
    .kind = "foxglove",
    .ping_first = true,
    .open = open_listener,
    .hear = hear,
    .next = next,
    .deadline = deadline,
    .stats = stats,
    .close = close_listener,
};

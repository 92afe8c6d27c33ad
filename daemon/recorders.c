/* See recorders.h. */
#include "daemon/recorders.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>

enum { FOLDER, FIRST_STREAM, RECORDERS = FIRST_STREAM + RECORDERS_STREAMS };

struct recorders {
	const struct config *config;
	char *config_text;
	struct recorders_host host;
	uv_async_t ready;
	struct recorder *recorder[RECORDERS]; /* NULL: none */
	struct recorded_messages *messages;   /* NULL: not wanted */
	bool stopped;
};

static void on_ready(uv_async_t *async)
{
	struct recorders *all = async->data;
	struct recorder_notice notice;

	for (int i = 0; i < RECORDERS; i++)
		while (all->recorder[i] && recorder_notice(all->recorder[i], &notice))
			all->host.say(all->host.ctx, &notice);
	all->host.streams(all->host.ctx);
}

static void wake(void *ctx) /* a recorder's thread */
{
	uv_async_send(ctx);
}

static bool add(struct recorders *all, int i, const char *dir)
{
	struct recorder_params params = {
	    .config = all->config, .config_text = all->config_text, .dir = dir, .ready = wake, .ctx = &all->ready};

	if (getrandom(&params.session, sizeof(params.session), GRND_NONBLOCK) < 0)
		params.session = uv_hrtime();
	all->recorder[i] = recorder_create(&params);
	return all->recorder[i] != NULL;
}

struct recorders *recorders_create(uv_loop_t *loop, const struct config *config, const char *config_text,
                                   const struct recorders_host *host)
{
	struct recorders *all = calloc(1, sizeof(*all));

	if (!all)
		return NULL;
	all->config = config;
	all->host = *host;
	all->config_text = strdup(config_text);
	uv_async_init(loop, &all->ready, on_ready);
	all->ready.data = all;
	if (all->config_text && (!config->record.dir[0] || add(all, FOLDER, config->record.dir)))
		return all;
	recorders_stop(all);
	uv_run(loop, UV_RUN_NOWAIT); /* the handle's last turn */
	recorders_destroy(all);
	return NULL;
}

void recorders_stop(struct recorders *all)
{
	if (!all || all->stopped)
		return;
	all->stopped = true;
	recorded_messages_destroy(all->messages);
	all->messages = NULL;
	for (int i = 0; i < RECORDERS; i++) {
		recorder_destroy(all->recorder[i]);
		all->recorder[i] = NULL;
	}
	uv_close((uv_handle_t *)&all->ready, NULL);
}

void recorders_destroy(struct recorders *all)
{
	if (!all)
		return;
	free(all->config_text);
	free(all);
}

/* Those that want it (all, where `map`) begin with one snapshot. */
static void begin(struct recorders *all, int64_t log_ns, bool map)
{
	struct recording_begin from = {0};
	struct buffer bytes = {0};
	bool any = false;

	for (int i = 0; i < RECORDERS; i++)
		any |= all->recorder[i] && (map || recorder_wants_begin(all->recorder[i], log_ns));
	if (any && all->host.snapshot(all->host.ctx, &from, &bytes)) {
		from.whole = map;
		from.snapshot = bytes.data;
		from.len = bytes.len;
		for (int i = 0; i < RECORDERS; i++)
			if (all->recorder[i] && (map || recorder_wants_begin(all->recorder[i], log_ns)))
				recorder_begin(all->recorder[i], &from);
	}
	buffer_finish(&bytes);
}

void recorders_map(struct recorders *all)
{
	begin(all, 0, true);
}

void recorders_record(struct recorders *all, const struct record *record)
{
	for (int i = 0; i < RECORDERS; i++)
		if (all->recorder[i])
			recorder_record(all->recorder[i], record);
}

void recorders_publish(struct recorders *all, struct publisher *publisher, const struct live *live)
{
	if (all->config->record.messages && all->recorder[FOLDER])
		all->messages = recorded_messages_create(publisher, live);
}

static void put_message(void *ctx, enum foxglove_schema schema, const struct buffer *message)
{
	struct recorders *all = ctx;

	if (!message->error)
		recorder_message(all->recorder[FOLDER], schema, message->data, message->len);
}

void recorders_tick(struct recorders *all, int64_t log_ns)
{
	begin(all, log_ns, false);
	for (int i = 0; i < RECORDERS; i++)
		if (all->recorder[i])
			recorder_tick(all->recorder[i], log_ns);
	if (!all->messages)
		return;
	if (recorder_begun(all->recorder[FOLDER]))
		recorded_messages_again(all->messages);
	recorded_messages_tick(all->messages, log_ns, put_message, all);
}

void recorders_skip(struct recorders *all, uint64_t number, const char *reason)
{
	for (int i = 0; i < RECORDERS; i++)
		if (all->recorder[i])
			recorder_skip(all->recorder[i], number, reason);
}

void recorders_clock(struct recorders *all, int64_t ahead_ns)
{
	for (int i = 0; i < RECORDERS; i++)
		if (all->recorder[i])
			recorder_clock(all->recorder[i], ahead_ns);
}

void recorders_event(struct recorders *all, const char *json, size_t len)
{
	for (int i = 0; i < RECORDERS; i++)
		if (all->recorder[i])
			recorder_event(all->recorder[i], json, len);
}

void recorders_control(struct recorders *all, const char *json, size_t len)
{
	for (int i = 0; i < RECORDERS; i++)
		if (all->recorder[i])
			recorder_control(all->recorder[i], json, len);
}

bool recorders_enable(struct recorders *all, bool enable, char error[200])
{
	if (!all->recorder[FOLDER]) {
		snprintf(error, 200,
		         "no folder for recordings: set record.dir, or run `facet record ADDRESS -o FILE.mcap`");
		return false;
	}
	recorder_enable(all->recorder[FOLDER], enable);
	return true;
}

struct recorder *recorders_stream(struct recorders *all, char error[200])
{
	for (int i = FIRST_STREAM; i < RECORDERS; i++)
		if (!all->recorder[i] && !all->stopped) {
			if (!add(all, i, NULL))
				snprintf(error, 200, "out of memory");
			return all->recorder[i];
		}
	snprintf(error, 200, "%d recordings are taken by clients already; end one of them", RECORDERS_STREAMS);
	return NULL;
}

void recorders_stream_end(struct recorders *all, struct recorder *stream)
{
	for (int i = FIRST_STREAM; i < RECORDERS; i++)
		if (all->recorder[i] == stream && stream) {
			recorder_destroy(stream);
			all->recorder[i] = NULL;
		}
}

size_t recorders_status(struct recorders *all, struct recorder_status *ret)
{
	size_t streams = 0;

	memset(ret, 0, sizeof(*ret));
	if (all->recorder[FOLDER])
		recorder_status(all->recorder[FOLDER], ret);
	for (int i = FIRST_STREAM; i < RECORDERS; i++)
		streams += all->recorder[i] != NULL;
	return streams;
}

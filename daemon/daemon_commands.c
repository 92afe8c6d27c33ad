/* What clients ask of the daemon: to pause, begin anew, save, play and record. */
#include "daemon/daemon_parts.h"

#include <stdio.h>
#include <string.h>

#include "config/redact.h"
#include "daemon/log.h"

static bool save(struct daemon *d, const char *file, char error[200])
{
	char sentence[SNAPSHOT_ERROR_MAX];

	if (snapshot_save(d->snapshots, file, sentence))
		return true;
	snprintf(error, 200, "%.199s", sentence);
	return false;
}

static bool snapshot(void *ctx, struct recording_begin *ret, struct buffer *ret_bytes)
{
	struct daemon *d = ctx;
	const int64_t log_ns = pipeline_log_ns(d->pipeline);

	/* Not now: the tick or the record that is being handled is dated already, and its time would have to be put off. */
	ret->log_ns = log_ns ? log_ns : daemon_now(d);
	ret->generation = d->list_generation;
	memcpy(ret->map_id, d->list_map_id, sizeof(ret->map_id));
	return journal_snapshot(d->pipeline, ret_bytes) == 0;
}

static void on_recorder(void *ctx, const struct recorder_notice *notice)
{
	struct buffer message = {0};

	log_line(notice->priority, "%s", notice->sentence);
	control_put_record_event(&message, notice);
	daemon_tell(ctx, &message);
}

static void on_streams(void *ctx)
{
	struct daemon *d = ctx;

	if (d->server)
		server_streams(d->server);
}

static bool may_record(const struct daemon *d, char error[200])
{
	if (d->replay)
		snprintf(error, 200, "a recording is being replayed: copy its file, there is nothing else to record");
	return !d->replay;
}

struct recorder *daemon_begin_stream(void *ctx, char error[200])
{
	struct daemon *d = ctx;

	if (!may_record(d, error))
		return NULL;
	log_line(LOG_INFO, "a client records");
	return recorders_stream(d->recorders, error);
}

void daemon_end_stream(void *ctx, struct recorder *stream)
{
	recorders_stream_end(((struct daemon *)ctx)->recorders, stream);
}

bool daemon_begin_recorders(struct daemon *d, const char *config_text)
{
	struct recorders_host host = {d, snapshot, on_recorder, on_streams};
	struct buffer text = {0};
	int r = config_text ? config_redact(config_text, strlen(config_text), &text) : 0;

	buffer_append(&text, "", 1);
	if (r == 0 && text.error == 0)
		d->recorders = recorders_create(&d->loop, d->config, (const char *)text.data, &host);
	buffer_finish(&text);
	if (d->recorders)
		recorders_publish(d->recorders, d->publisher, d->live);
	return d->recorders != NULL;
}

static void note_command(struct daemon *d, enum control_word word)
{
	char text[64];
	int n = snprintf(text, sizeof(text), "{\"command\":\"%s\"}", control_name(word));

	recorders_control(d->recorders, text, (size_t)n);
}

bool daemon_command(void *ctx, const struct control_command *command, char error[200])
{
	struct daemon *d = ctx;

	log_line(LOG_INFO, "a client asks for %s", control_name(command->word));
	note_command(d, command->word);
	if (command->word == CONTROL_RECORD)
		return may_record(d, error) && recorders_enable(d->recorders, command->enable, error);
	if (command->word == CONTROL_SAVE)
		return save(d, command->file, error);
	if (d->player || command->word == CONTROL_SEEK)
		return daemon_playback(d, command, error);
	if (command->word == CONTROL_RESET) {
		pipeline_reset(d->pipeline);
		worker_reset(d->worker);
		daemon_begin_list(d);
	} else {
		d->paused = command->word == CONTROL_PAUSE;
	}
	return true;
}

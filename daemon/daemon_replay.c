/* A replay in the daemon: the player stands where devices, ticks and the clock stand in a live one, and who looks on may stop
 * it, seek in it and change its speed. */
#include "daemon/daemon_parts.h"

#include <stdio.h>

#include "daemon/log.h"
#include "daemon/wall_clock.h"

/* Plays what is due; in a replay the devices' timer is the player's. */
void daemon_play(struct daemon *d)
{
	const int64_t t_ns = wall_clock_read(CLOCK_MONOTONIC);
	int64_t next_ns;

	if (d->closed || d->stopping)
		return;
	next_ns = player_turn(d->player, t_ns);
	if (d->closed || next_ns == INT64_MAX)
		return;
	daemon_wake_devices(d, next_ns <= t_ns ? 0 : next_ns - t_ns);
}

static bool has_room(void *ctx)
{
	return worker_room(((struct daemon *)ctx)->worker);
}

static int on_replayed(void *ctx, const struct replay_event *event, char error[REPLAY_ERROR_MAX])
{
	struct daemon *d = ctx;
	bool anew;
	int r;

	replay_lines_event(&d->lines, d->config, event);
	r = replay_feed(d->replay, event, d->pipeline, &anew, error);
	if (r == 0 && anew)
		worker_reset(d->worker);
	if (event->kind == REPLAY_ROW)
		daemon_take_row(d, event->row);
	if (event->kind == REPLAY_EVENT) {
		struct buffer message = {0};

		buffer_append(&message, event->bytes, event->len);
		daemon_tell(d, &message);
	}
	return r;
}

static void on_rushing(void *ctx, bool on)
{
	worker_hold(((struct daemon *)ctx)->worker, on);
}

static void on_again(void *ctx)
{
	struct daemon *d = ctx;

	replay_lines_reset(&d->lines);
	live_reset(d->live);
	worker_reset(d->worker);
}

static void on_ended(void *ctx)
{
	struct daemon *d = ctx;

	if (replay_ends(d->replay)) {
		pipeline_end(d->pipeline);
		worker_flush(d->worker);
	}
	if (*player_error(d->player))
		log_line(LOG_ERR, "%s: the replay ends there", player_error(d->player));
	else
		log_line(LOG_INFO, "the recording was replayed to its end%s%s", *replay_note(d->replay) ? ": " : "",
		         replay_note(d->replay));
}

static bool seek(struct daemon *d, const struct control_command *command, int64_t t_ns, char error[200])
{
	if (command->pace && !player_speed(d->player, command->speed, t_ns, error))
		return false;
	return !command->seek || player_seek(d->player, command->seek_ns, t_ns, error);
}

bool daemon_playback(struct daemon *d, const struct control_command *command, char error[200])
{
	const int64_t t_ns = wall_clock_read(CLOCK_MONOTONIC);
	struct player_status status;
	bool done = true;

	if (!d->player) {
		snprintf(error, 200, "nothing is replayed: run facetd --replay FILE");
		return false;
	}
	player_status(d->player, t_ns, &status);
	if (command->word == CONTROL_SEEK)
		done = seek(d, command, t_ns, error);
	else if (command->word == CONTROL_RESET)
		done = player_seek(d->player, status.begin_ns, t_ns, error);
	else
		player_play(d->player, command->word == CONTROL_RESUME, t_ns);
	daemon_wake_devices(d, 0);
	return done;
}

/* Who plays as fast as can be shows a map once a second; who seeks, none. */
void daemon_show_rush(struct daemon *d)
{
	struct player_status status;

	player_status(d->player, wall_clock_read(CLOCK_MONOTONIC), &status);
	if (status.state == PLAYER_PLAYING && status.speed == 0)
		worker_mesh(d->worker);
}

/* Log time; in a replay the recorded one. */
int64_t daemon_data_time(void *ctx)
{
	const struct daemon *d = ctx;
	struct player_status status;

	if (!d->player)
		return daemon_now(ctx);
	player_status(d->player, wall_clock_read(CLOCK_MONOTONIC), &status);
	return status.now_ns;
}

static void put_playback(void *ctx, struct player_status *ret)
{
	const struct daemon *d = ctx;

	player_status(d->player, wall_clock_read(CLOCK_MONOTONIC), ret);
}

static bool do_request(void *ctx, const struct foxglove_request *request, char error[200])
{
	struct daemon *d = ctx;
	const int64_t t_ns = wall_clock_read(CLOCK_MONOTONIC);
	struct player_status status;
	bool done = true;

	player_status(d->player, t_ns, &status);
	if (request->speed > 0 && request->speed != status.speed)
		done = player_speed(d->player, request->speed, t_ns, error);
	player_play(d->player, request->play, t_ns);
	if (request->seek)
		done = player_seek(d->player, request->seek_ns, t_ns, error) && done;
	daemon_wake_devices(d, 0);
	return done;
}

void daemon_replay_foxglove(struct foxglove_host *host)
{
	host->playback = put_playback;
	host->play = do_request;
}

bool daemon_begin_replay(struct daemon *d, double speed)
{
	const struct player_host host = {d, has_room, on_replayed, on_rushing, on_again, on_ended};

	d->player = player_create(d->replay, &host, speed);
	return d->player != NULL;
}

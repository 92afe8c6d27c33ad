/* The loop.
 *
 *   device readable ─► supervisor ─► on_record: journal, pipeline ─► worker's queue
 *   10 Hz ───────────► on_tick:      journal, pipeline; was the wall clock set?
 *   worker ready ────► on_results:   publisher, then every client that has room; a map that ended, to the archive
 *   second ──────────► on_second:    rates, the journal's disk
 *   watchdog ────────► on_watchdog:  only while the worker works or is idle
 *
 * Log time is taken here and nowhere else: realtime at the start plus what the monotonic clock has counted since, so it
 * never goes back and a corrected wall clock moves nothing: only who sends us its time is told. All records of one turn of a device carry one time.
 *
 * The end: devices are stopped (a second at most, more where a servo goes to its rest angle), then sockets and handles
 * are closed and the loop runs dry; whatever hangs, LAST_MS later everything is closed. */
#include "daemon/daemon.h"

#include <assert.h>
#include <errno.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <unistd.h>
#include <uv.h>

#include "config/redact.h"
#include "daemon/archive.h"
#include "daemon/control.h"
#include "daemon/foxglove_web.h"
#include "daemon/journal.h"
#include "daemon/live.h"
#include "daemon/log.h"
#include "daemon/notify.h"
#include "daemon/player.h"
#include "daemon/publisher.h"
#include "daemon/recorders.h"
#include "daemon/replay_lines.h"
#include "daemon/server.h"
#include "daemon/snapshot.h"
#include "daemon/supervisor.h"
#include "daemon/wall_clock.h"
#include "daemon/web.h"
#include "daemon/web_metrics.h"
#include "daemon/web_native.h"
#include "daemon/worker.h"

#define TICK_MS       100
#define STEP_NS       1000000 /* the wall clock was set if it is off by more */
#define LAST_MS       1000
#define LATENCIES     1024 /* the newest, for the percentiles */
#define RATE_SECONDS  4    /* rates are means over so long */
#define CLIENTS_SHOWN 64
#define JUMP_LOG_NS   1000000000

/* A device's descriptor in the loop; freed by libuv's last call. */
struct watcher {
	uv_poll_t poll;
	struct daemon *daemon;
	int device;
};

struct daemon {
	const struct config *config;
	const struct driver *driver[CONFIG_DEVICES_MAX];
	uv_loop_t loop;
	int64_t clock_offset_ns, started_ns; /* realtime - monotonic at the start */
	int64_t wall_offset_ns;              /* the same now */
	struct publisher *publisher;
	struct worker *worker;
	struct pipeline *pipeline;
	struct supervisor *supervisor;
	struct replay *replay; /* NULL: live. Instead of devices, ticks and supervisor: */
	struct player *player;
	struct replay_lines lines;
	struct server *server;
	struct web *web; /* NULL: there is none */
	struct live *live;
	struct foxglove *foxglove;
	struct snapshots *snapshots;
	struct archive *archive;
	struct journal *journal;
	struct journal_sink keep; /* empty without a journal */
	bool journal_failed;
	struct recorders *recorders;
	uint8_t
	    list_map_id[16]; /* of the map that is recorded: after a jump it is ahead of map_id until the worker is */
	uint32_t list_generation;
	bool list_ahead;
	struct watcher *watcher[CONFIG_DEVICES_MAX];

	uv_async_t results;
	uv_timer_t devices, tick, second, watchdog, last;
	uv_signal_t interrupt, terminate;
	bool stopping, closed;
	int failure; /* what ended it, if not a signal */
	char *error;

	/* For the status. */
	bool paused;
	uint64_t queue_full, rows_paused;
	uint64_t overload_begin; /* queue_full when the worker fell behind; it still does while `overloaded` */
	uint64_t queue_full_seen;
	bool overloaded, memory_full;
	uint8_t map_id[16];
	int64_t jump_told_ns; /* a line was logged of a jump */
	uint64_t jumps_untold;
	double latency_ms[LATENCIES];
	uint64_t latencies;
	struct grid_stats grid;
	struct field_stats field;
	uint64_t decoded[RATE_SECONDS + 1][CONFIG_DEVICES_MAX], rows[RATE_SECONDS + 1]; /* rings, a column a second */
	uint64_t seconds;
};

static int64_t now(void *ctx)
{
	const struct daemon *d = ctx;

	return wall_clock_read(CLOCK_MONOTONIC) + d->clock_offset_ns;
}

static void stop(struct daemon *d);
static void close_all(struct daemon *d);

/* Ends the daemon with a sentence. */
static void fail(struct daemon *d, int r, const char *sentence)
{
	if (d->failure == 0) {
		d->failure = r;
		snprintf(d->error, 320, "%s", sentence);
	}
	stop(d);
}

/* Events */

static void tell_clients(struct daemon *d, struct buffer *message)
{
	if (d->server)
		server_event(d->server, (const char *)message->data, message->len);
	web_event(d->web, (const char *)message->data, message->len);
	if (d->recorders)
		recorders_event(d->recorders, (const char *)message->data, message->len);
	buffer_finish(message);
}

/* Devices */

static void set_device_timer(struct daemon *d);
static void on_devices(uv_timer_t *timer);

static void on_device(uv_poll_t *poll, int status, int events)
{
	struct watcher *watcher = poll->data;
	struct daemon *d = watcher->daemon;

	/* An error on the descriptor is found by reading it, and told by the driver. */
	supervisor_ready(d->supervisor, watcher->device, status < 0 || (events & UV_READABLE), events & UV_WRITABLE,
	                 now(d));
	if (status < 0 && d->watcher[watcher->device] == watcher)
		uv_poll_start(&watcher->poll, UV_READABLE, on_device);
	set_device_timer(d);
}

static void on_watcher_closed(uv_handle_t *handle)
{
	free(handle->data);
}

static void unwatch(struct daemon *d, int device)
{
	struct watcher *watcher = d->watcher[device];

	if (!watcher)
		return;
	d->watcher[device] = NULL;
	uv_poll_stop(&watcher->poll);
	uv_close((uv_handle_t *)&watcher->poll, on_watcher_closed);
}

static struct watcher *make_watcher(struct daemon *d, int device, int fd)
{
	struct watcher *watcher = calloc(1, sizeof(*watcher));

	if (!watcher || uv_poll_init(&d->loop, &watcher->poll, fd) < 0) {
		log_line(LOG_ERR, "%s: its descriptor cannot be polled; is it a device?",
		         d->config->device[device].name);
		free(watcher);
		return NULL;
	}
	watcher->poll.data = watcher;
	watcher->daemon = d;
	watcher->device = device;
	return watcher;
}

static void watch_device(void *ctx, int device, int fd, bool readable, bool writable)
{
	struct daemon *d = ctx;

	if (fd < 0) {
		unwatch(d, device);
		return;
	}
	if (!d->watcher[device])
		d->watcher[device] = make_watcher(d, device, fd);
	if (d->watcher[device])
		uv_poll_start(&d->watcher[device]->poll, (readable ? UV_READABLE : 0) | (writable ? UV_WRITABLE : 0),
		              on_device);
}

/* A step of the wall clock changes how poses are dated, so it is an entry of the journal (law L7), and
 * clients are told, who compare their own times with ours. */
static void look_for_step(struct daemon *d)
{
	struct buffer message = {0};
	int64_t offset_ns, step_ns;

	if (!wall_clock_offset(&offset_ns))
		return;
	step_ns = offset_ns - d->wall_offset_ns;
	if (step_ns >= -STEP_NS && step_ns <= STEP_NS)
		return;
	log_line(LOG_NOTICE, "the wall clock was set by %+.3f s; the times of poses follow it", (double)step_ns / 1e9);
	d->wall_offset_ns = offset_ns;
	if (d->keep.clock)
		d->keep.clock(d->keep.ctx, offset_ns - d->clock_offset_ns);
	recorders_clock(d->recorders, offset_ns - d->clock_offset_ns);
	pipeline_clock(d->pipeline, offset_ns - d->clock_offset_ns);
	control_put_clock_event(&message, step_ns, offset_ns - d->clock_offset_ns);
	tell_clients(d, &message);
}

static void on_record(void *ctx, const struct record *record)
{
	struct daemon *d = ctx;

	/* Who dates by the wall clock may be quicker than the tick. */
	if (d->driver[record->device]->clock && record->direction == FROM_DEVICE)
		look_for_step(d);
	if (d->keep.record)
		d->keep.record(d->keep.ctx, record);
	recorders_record(d->recorders, record);
	pipeline_handle(d->pipeline, record);
}

/* A transition, with what the decoder has counted so far. */
static void log_device(void *ctx, int device, int priority, const char *text)
{
	struct daemon *d = ctx;
	const struct supervisor_device *line = supervisor_device(d->supervisor, device);
	struct decoder_counters counters;
	struct buffer message = {0};
	char counted[300] = "";

	pipeline_counters(d->pipeline, device, &counters);
	for (int i = 0; i < counters.n; i++)
		if (counters.counter[i].count > 0 && strlen(counted) < 200)
			snprintf(counted + strlen(counted), sizeof(counted) - strlen(counted), "%s%s %llu",
			         counted[0] ? ", " : " (", counters.counter[i].name,
			         (unsigned long long)counters.counter[i].count);
	log_line(priority, "%s: %s%s%s", d->config->device[device].name, text, counted, counted[0] ? ")" : "");
	control_put_device_event(&message, d->config->device[device].name, supervisor_state_name(line->state), text);
	tell_clients(d, &message);
}

/* Plays what is due; in a replay the devices' timer is the player's. */
static void play(struct daemon *d)
{
	const int64_t t_ns = wall_clock_read(CLOCK_MONOTONIC);
	int64_t next_ns;

	if (d->closed || d->stopping)
		return;
	next_ns = player_turn(d->player, t_ns);
	if (d->closed || next_ns == INT64_MAX)
		return;
	uv_timer_start(&d->devices, on_devices, next_ns <= t_ns ? 0 : (uint64_t)(next_ns - t_ns + 999999) / 1000000, 0);
}

static void on_devices(uv_timer_t *timer)
{
	struct daemon *d = timer->data;

	if (d->replay) {
		play(d);
		return;
	}
	supervisor_timer(d->supervisor, now(d));
	set_device_timer(d);
}

/* One timer for the nearest deadline of all devices. */
static void set_device_timer(struct daemon *d)
{
	if (d->replay) {
		if (d->stopping)
			close_all(d);
		return;
	}
	int64_t deadline_ns = supervisor_deadline(d->supervisor), wait_ns = deadline_ns - now(d);

	if (d->closed)
		return;
	if (d->stopping && supervisor_stopped(d->supervisor))
		close_all(d);
	else if (deadline_ns == INT64_MAX)
		uv_timer_stop(&d->devices);
	else /* rounded up: a timer that fires early finds nothing to do */
		uv_timer_start(&d->devices, on_devices, wait_ns <= 0 ? 0 : (uint64_t)(wait_ns + 999999) / 1000000, 0);
}

/* The pipeline's sink */

static bool take_row(void *ctx, struct row *row)
{
	struct daemon *d = ctx;
	const int64_t arrival_ns = d->replay ? now(d) : pipeline_arrival_ns(d->pipeline);
	struct vec3 at = row->n > 0 ? row->beam[0].origin : (struct vec3){0};
	bool taken = !d->paused && worker_row(d->worker, row, arrival_ns);

	d->rows_paused += d->paused;
	d->queue_full += !d->paused && !taken;
	if (publisher_robot(d->publisher, at.x, at.y, at.z)) {
		server_wake(d->server);
		web_wake(d->web);
	}
	return taken;
}

static void on_not_applied(void *ctx, uint64_t number, const char *reason)
{
	struct daemon *d = ctx;

	if (d->keep.not_applied)
		d->keep.not_applied(d->keep.ctx, number);
	recorders_skip(d->recorders, number, d->paused && strcmp(reason, "queue full") == 0 ? "paused" : reason);
}

static void on_flush(void *ctx)
{
	worker_flush(((struct daemon *)ctx)->worker);
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	struct daemon *d = ctx;

	if (!d->replay)
		supervisor_reply(d->supervisor, device, reply);
}

static void on_data(void *ctx, int device, int64_t t_ns)
{
	struct daemon *d = ctx;

	if (d->replay)
		replay_lines_data(&d->lines, device, t_ns);
	else
		supervisor_data(d->supervisor, device, t_ns);
}

static void on_profile(void *ctx, int device, const struct profile *profile)
{
	live_profile(((struct daemon *)ctx)->live, device, profile);
}

static void on_tilt(void *ctx, int device, const struct tilt *tilt)
{
	live_tilt(((struct daemon *)ctx)->live, device, tilt);
}

static void on_pose(void *ctx, const struct pose *pose)
{
	live_pose(((struct daemon *)ctx)->live, pose);
}

static void begin_list(struct daemon *d);

static void make_map_id(struct daemon *d, uint8_t ret[16])
{
	const int64_t t_ns = now(d);

	memset(ret, 0, 16);
	if (getrandom(ret, 16, GRND_NONBLOCK) < 0)
		memcpy(ret, &t_ns, sizeof(t_ns)); /* early at boot: the time will do */
}

/* One line a second at most: a localisation that cannot decide jumps with every pose. */
static void log_jump(struct daemon *d, int device, const struct pose_jump *jump)
{
	static const char *const what[] = {[POSE_TRACK_KEEP] = "the map goes on",
	                                   [POSE_TRACK_IGNORE] = "ignored: the old correction is held",
	                                   [POSE_TRACK_NEW_MAP] = "a new map begins"};
	const int64_t t_ns = now(d);
	char more[60] = "";

	if (d->jump_told_ns && t_ns - d->jump_told_ns < JUMP_LOG_NS) {
		d->jumps_untold++;
		return;
	}
	if (d->jumps_untold)
		snprintf(more, sizeof(more), " (and %llu jumps before it)", (unsigned long long)d->jumps_untold);
	log_line(LOG_WARNING, "%s: the pose jumped%s by %.2f m, %.1f degrees: %s%s", d->config->device[device].name,
	         jump->back ? " back" : "", jump->distance_m, jump->angle_rad * 57.29577951308232, what[jump->done],
	         more);
	d->jump_told_ns = t_ns;
	d->jumps_untold = 0;
}

static void on_jump(void *ctx, int device, const struct pose_jump *jump)
{
	struct daemon *d = ctx;
	struct buffer message = {0};

	log_jump(d, device, jump);
	control_put_jump_event(&message, d->config->device[device].name, jump);
	tell_clients(d, &message);
	if (jump->done != POSE_TRACK_NEW_MAP)
		return;
	pipeline_reset(d->pipeline);
	if (d->replay) { /* what was saved live is not saved again */
		worker_reset(d->worker);
		replay_began(d->replay);
		return;
	}
	worker_end(d->worker);
	make_map_id(d, d->list_map_id);
	d->list_ahead = true;
	begin_list(d);
}

/* The player's host */

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
		take_row(d, event->row);
	if (event->kind == REPLAY_EVENT) {
		struct buffer message = {0};

		buffer_append(&message, event->bytes, event->len);
		tell_clients(d, &message);
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

static bool do_playback(struct daemon *d, const struct control_command *command, char error[200])
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
	uv_timer_start(&d->devices, on_devices, 0, 0);
	return done;
}

static void on_tick(uv_timer_t *timer)
{
	struct daemon *d = timer->data;
	int64_t t_ns = now(d);

	look_for_step(d);
	if (d->keep.tick)
		d->keep.tick(d->keep.ctx, t_ns);
	recorders_tick(d->recorders, t_ns);
	pipeline_tick(d->pipeline, t_ns);
}

/* Results of the worker */

static void on_worker_ready(void *ctx) /* the worker's thread */
{
	uv_async_send(ctx);
}

static void note_latencies(struct daemon *d, const struct worker_result *result)
{
	int64_t t_ns = now(d);

	for (size_t i = 0; i < result->arrivals; i++)
		d->latency_ms[d->latencies++ % LATENCIES] = (double)(t_ns - result->arrival_ns[i]) / 1e6;
}

static void on_saved(void *ctx, const struct archive_result *result)
{
	struct daemon *d = ctx;
	struct buffer message = {0};

	if (result->file)
		log_line(LOG_INFO, "the map that ended was saved as %s, %u triangles", result->file, result->triangles);
	else
		log_line(LOG_ERR, "the map that ended was not saved: %s", result->error);
	control_put_saved_event(&message, result->map, result->file, result->error);
	tell_clients(d, &message);
}

static void on_snapshot_saved(void *ctx, const char *path, const char *error)
{
	struct daemon *d = ctx;
	struct buffer message = {0};
	char map[33];

	for (int i = 0; i < 16; i++)
		snprintf(map + 2 * i, 3, "%02x", d->map_id[i]);
	log_line(path ? LOG_INFO : LOG_ERR, "%s %s",
	         path ? "the map was saved as" : "the map was not saved:", path ? path : error);
	control_put_saved_event(&message, map, path, path ? NULL : error);
	tell_clients(d, &message);
}

/* Everything of the old map is with the publisher. */
static void end_map(struct daemon *d)
{
	struct archive_result result = {0};
	struct publisher_stats stats;
	struct publisher_old *old;
	struct buffer message = {0};
	char map[33], error[200] = "out of memory";
	uint8_t before[16];

	memcpy(before, d->map_id, sizeof(before));
	for (int i = 0; i < 16; i++)
		snprintf(map + 2 * i, 3, "%02x", before[i]);
	if (!d->list_ahead)
		make_map_id(d, d->list_map_id);
	d->list_ahead = false;
	memcpy(d->map_id, d->list_map_id, sizeof(d->map_id));
	old = publisher_begin_map(d->publisher, d->map_id);
	publisher_stats(d->publisher, &stats);
	control_put_map_event(&message, d->map_id, stats.generation, before);
	tell_clients(d, &message);
	if (old && publisher_old_count(old) == 0) {
		publisher_old_destroy(old);
		snprintf(error, sizeof(error), "nothing was in it");
	} else if (old && archive_save(d->archive, before, old, error)) {
		return;
	}
	result.map = map;
	result.error = error;
	on_saved(d, &result);
}

static int publish(struct daemon *d, const struct worker_result *result)
{
	if (result->ended)
		end_map(d);
	else if (result->reset)
		publisher_reset(d->publisher);
	d->grid = result->grid;
	d->field = result->field;
	return publisher_publish(d->publisher, result->step, result->patch, result->faces_raw, result->patches);
}

static void on_results(uv_async_t *async)
{
	struct daemon *d = async->data;
	struct worker_status status;
	struct worker_result *result;
	int r = 0;

	worker_status(d->worker, &status);
	while (r == 0 && (result = worker_take(d->worker)) != NULL) {
		r = publish(d, result);
		server_wake(d->server);
		web_wake(d->web);
		note_latencies(d, result);
		worker_result_destroy(result);
	}
	if (d->player && r == 0)
		play(d); /* there may be room again */
	if (r < 0 || status.failed)
		fail(d, -ENOMEM, "out of memory; give the machine more, or set a smaller map.memory");
}

/* Status and commands */

static int compare_doubles(const void *a, const void *b)
{
	double x = *(const double *)a, y = *(const double *)b;

	return x < y ? -1 : x > y;
}

static void fill_latency(const struct daemon *d, struct control_status *s)
{
	double sorted[LATENCIES];
	size_t n = d->latencies < LATENCIES ? (size_t)d->latencies : LATENCIES;

	s->latencies = d->latencies;
	if (n == 0)
		return;
	memcpy(sorted, d->latency_ms, n * sizeof(*sorted));
	qsort(sorted, n, sizeof(*sorted), compare_doubles);
	s->latency_p50_ms = sorted[n / 2];
	s->latency_p99_ms = sorted[n * 99 / 100];
}

static double rate(uint64_t newest, uint64_t oldest, uint64_t seconds)
{
	return seconds > 0 ? (double)(newest - oldest) / (double)seconds : 0;
}

static const struct supervisor_device *device_line(const struct daemon *d, int device)
{
	return d->replay ? &d->lines.line[device] : supervisor_device(d->supervisor, device);
}

static void fill_devices(const struct daemon *d, struct control_status *s)
{
	uint64_t span = d->seconds < RATE_SECONDS ? d->seconds : RATE_SECONDS;
	size_t last = d->seconds % (RATE_SECONDS + 1), first = (d->seconds - span) % (RATE_SECONDS + 1);

	s->devices = d->config->devices;
	for (int i = 0; i < s->devices; i++) {
		s->device[i].name = d->config->device[i].name;
		s->device[i].driver = d->config->device[i].driver;
		s->device[i].line = *device_line(d, i);
		s->device[i].rate = rate(d->decoded[last][i], d->decoded[first][i], span);
		s->device[i].fixed = d->config->device[i].fixed;
		pipeline_counters(d->pipeline, i, &s->device[i].counters);
		pipeline_timing(d->pipeline, i, &s->device[i].timing);
		pipeline_track(d->pipeline, i, &s->device[i].track);
	}
	s->rows.rate = rate(d->rows[last], d->rows[first], span);
}

/* The time is that of the recording. */
static void fill_replay(const struct daemon *d, struct control_status *s)
{
	s->replays = true;
	player_status(d->player, wall_clock_read(CLOCK_MONOTONIC), &s->replay);
	if (!s->worker.idle && (s->replay.state == PLAYER_PAUSED || s->replay.state == PLAYER_ENDED))
		s->replay.state = PLAYER_SEEKING; /* the map is not there yet */
	s->t_ns = s->replay.now_ns;
	s->paused = s->replay.state == PLAYER_PAUSED;
	s->replay_error = player_error(d->player);
	s->replay_note = replay_note(d->replay);
}

static size_t resident_bytes(void)
{
	FILE *file = fopen("/proc/self/statm", "re");
	unsigned long size = 0, resident = 0;

	if (file && fscanf(file, "%lu %lu", &size, &resident) != 2)
		resident = 0;
	if (file)
		fclose(file);
	return resident * (size_t)sysconf(_SC_PAGESIZE);
}

static size_t list_clients(const struct daemon *d, struct control_client client[CLIENTS_SHOWN])
{
	size_t n = server_clients(d->server, client, CLIENTS_SHOWN);

	n = n < CLIENTS_SHOWN ? n : CLIENTS_SHOWN;
	n += web_clients(d->web, client + n, CLIENTS_SHOWN - n);
	return n < CLIENTS_SHOWN ? n : CLIENTS_SHOWN;
}

static void fill_status(struct daemon *d, struct control_client client[CLIENTS_SHOWN], struct control_status *ret)
{
	struct control_status s = {.client = client};
	struct pipeline_stats rows;
	struct publisher_stats map;

	pipeline_stats(d->pipeline, &rows);
	publisher_stats(d->publisher, &map);
	worker_status(d->worker, &s.worker);
	memcpy(s.map_id, d->map_id, sizeof(s.map_id));
	s.generation = map.generation;
	s.cell_m = d->config->map.cell_m;
	s.t_ns = now(d);
	s.uptime_ns = s.t_ns - d->started_ns;
	s.step = map.step;
	s.paused = d->paused;
	if (d->player)
		fill_replay(d, &s);
	s.rows.assembled = rows.rows;
	s.rows.applied = d->field.step;
	s.rows.not_applied = rows.not_applied;
	s.rows.queue_full = d->queue_full;
	s.rows.paused = d->rows_paused;
	s.rows.sweep = rows.sweep;
	s.patches = map.patches;
	s.faces = map.faces;
	s.faces_raw = map.faces_raw;
	s.encoded_bytes = map.bytes;
	s.pinned_bytes = map.pinned;
	s.grid = d->grid;
	s.memory_cap = d->config->map.memory;
	s.rss_bytes = resident_bytes();
	fill_latency(d, &s);
	fill_devices(d, &s);
	s.streams = recorders_status(d->recorders, &s.record);
	s.clients = list_clients(d, client);
	*ret = s;
}

static void put_status(void *ctx, struct buffer *ret)
{
	struct control_client client[CLIENTS_SHOWN];
	struct control_status s;

	fill_status(ctx, client, &s);
	control_put_status(ret, &s);
}

static void put_metrics(void *ctx, struct buffer *ret)
{
	struct daemon *d = ctx;
	struct control_client client[CLIENTS_SHOWN];
	struct control_status s;
	struct publisher_stats map;

	fill_status(d, client, &s);
	publisher_stats(d->publisher, &map);
	web_metrics_put(ret, &s, &map);
}

/* What is kept and recorded from here on gives the map that begins here. */
static void begin_list(struct daemon *d)
{
	d->list_generation++;
	recorders_map(d->recorders);
	if (!d->keep.begin || journal_begin(&d->keep, d->pipeline) == 0)
		return;
	log_line(LOG_ERR, "out of memory: the journal ends here");
	memset(&d->keep, 0, sizeof(d->keep));
}

static bool save(struct daemon *d, const char *file, char error[200])
{
	char sentence[SNAPSHOT_ERROR_MAX];

	if (snapshot_save(d->snapshots, file, sentence))
		return true;
	snprintf(error, 200, "%.199s", sentence);
	return false;
}

/* Recordings */

static bool snapshot(void *ctx, struct recording_begin *ret, struct buffer *ret_bytes)
{
	struct daemon *d = ctx;

	ret->log_ns = now(d);
	ret->generation = d->list_generation;
	memcpy(ret->map_id, d->list_map_id, sizeof(ret->map_id));
	return journal_snapshot(d->pipeline, ret_bytes) == 0;
}

static void on_recorder(void *ctx, const struct recorder_notice *notice)
{
	struct buffer message = {0};

	log_line(notice->priority, "%s", notice->sentence);
	control_put_record_event(&message, notice);
	tell_clients(ctx, &message);
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

static struct recorder *begin_stream(void *ctx, char error[200])
{
	struct daemon *d = ctx;

	if (!may_record(d, error))
		return NULL;
	log_line(LOG_INFO, "a client records");
	return recorders_stream(d->recorders, error);
}

static void end_stream(void *ctx, struct recorder *stream)
{
	recorders_stream_end(((struct daemon *)ctx)->recorders, stream);
}

static bool begin_recorders(struct daemon *d, const char *config_text)
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

static bool do_command(void *ctx, const struct control_command *command, char error[200])
{
	struct daemon *d = ctx;

	log_line(LOG_INFO, "a client asks for %s", control_name(command->word));
	note_command(d, command->word);
	if (command->word == CONTROL_RECORD)
		return may_record(d, error) && recorders_enable(d->recorders, command->enable, error);
	if (command->word == CONTROL_SAVE)
		return save(d, command->file, error);
	if (d->player || command->word == CONTROL_SEEK)
		return do_playback(d, command, error);
	if (command->word == CONTROL_RESET) {
		pipeline_reset(d->pipeline);
		worker_reset(d->worker);
		begin_list(d);
	} else {
		d->paused = command->word == CONTROL_PAUSE;
	}
	return true;
}

static void log_server(void *ctx, int priority, const char *text)
{
	(void)ctx;
	log_line(priority, "%s", text);
}

/* Once a second */

/* Limits are told when they are reached and when they are left, not once a row. */
static void log_limits(struct daemon *d)
{
	bool behind = d->queue_full != d->queue_full_seen;
	bool full = d->grid.refused_memory > 0;

	if (behind && !d->overloaded) {
		d->overload_begin = d->queue_full_seen;
		log_line(LOG_WARNING,
		         "the machine cannot keep up: rows are not applied; use a larger map.cell or fewer scanners");
	}
	if (!behind && d->overloaded)
		log_line(LOG_INFO, "keeps up again; %llu rows were not applied",
		         (unsigned long long)(d->queue_full - d->overload_begin));
	if (full && !d->memory_full)
		log_line(
		    LOG_WARNING,
		    "the map has reached map.memory: what is new is left out; allow more, or use a larger map.cell");
	d->overloaded = behind;
	d->queue_full_seen = d->queue_full;
	d->memory_full = full;
}

/* Who plays as fast as can be shows a map once a second; who seeks, none. */
static void show_rush(struct daemon *d)
{
	struct player_status status;

	player_status(d->player, wall_clock_read(CLOCK_MONOTONIC), &status);
	if (status.state == PLAYER_PLAYING && status.speed == 0)
		worker_mesh(d->worker);
}

static void on_second(uv_timer_t *timer)
{
	struct daemon *d = timer->data;
	struct pipeline_stats rows;
	size_t column = ++d->seconds % (RATE_SECONDS + 1);

	pipeline_stats(d->pipeline, &rows);
	d->rows[column] = rows.rows;
	if (d->player)
		show_rush(d);
	log_limits(d);
	for (int i = 0; i < d->config->devices; i++)
		d->decoded[column][i] = device_line(d, i)->decoded;
	if (d->journal && !d->journal_failed && journal_error(d->journal) < 0) {
		d->journal_failed = true;
		log_line(LOG_ERR, "the journal can no longer be written (%s); it ends here",
		         strerror(-journal_error(d->journal)));
	}
}

static void on_watchdog(uv_timer_t *timer)
{
	struct daemon *d = timer->data;

	if (worker_alive(d->worker))
		notify_alive();
}

/* Beginning and end */

static void on_signal(uv_signal_t *handle, int number)
{
	struct daemon *d = handle->data;

	if (d->stopping)
		close_all(d); /* asked twice: at once */
	else
		log_line(LOG_INFO, "ends (%s)", number == SIGINT ? "interrupted" : "terminated");
	stop(d);
}

static void on_last(uv_timer_t *timer)
{
	close_all(timer->data);
}

static void stop(struct daemon *d)
{
	if (d->stopping)
		return;
	d->stopping = true;
	notify_stopping();
	uv_timer_start(&d->last, on_last, (uint64_t)supervisor_stop_ns(d->config) / 1000000 + LAST_MS, 0);
	if (!d->replay)
		supervisor_stop(d->supervisor, now(d));
	set_device_timer(d);
}

/* After this the loop runs dry. */
static void close_all(struct daemon *d)
{
	uv_handle_t *handles[] = {(uv_handle_t *)&d->results,   (uv_handle_t *)&d->devices,  (uv_handle_t *)&d->tick,
	                          (uv_handle_t *)&d->second,    (uv_handle_t *)&d->watchdog, (uv_handle_t *)&d->last,
	                          (uv_handle_t *)&d->interrupt, (uv_handle_t *)&d->terminate};

	if (d->closed)
		return;
	d->closed = true;
	for (int i = 0; i < d->config->devices; i++)
		unwatch(d, i);
	if (d->server)
		server_stop(d->server);
	web_stop(d->web);
	snapshots_stop(d->snapshots);
	worker_destroy(d->worker); /* before the handle that its thread speaks to */
	d->worker = NULL;
	recorders_stop(d->recorders);
	for (size_t i = 0; i < sizeof(handles) / sizeof(handles[0]); i++)
		uv_close(handles[i], NULL);
}

static void begin_handles(struct daemon *d)
{
	uv_timer_t *timers[] = {&d->devices, &d->tick, &d->second, &d->watchdog, &d->last};
	uint64_t watchdog_ms = notify_watchdog_ms();

	uv_async_init(&d->loop, &d->results, on_results);
	d->results.data = d;
	for (size_t i = 0; i < sizeof(timers) / sizeof(timers[0]); i++) {
		uv_timer_init(&d->loop, timers[i]);
		timers[i]->data = d;
	}
	uv_signal_init(&d->loop, &d->interrupt);
	uv_signal_init(&d->loop, &d->terminate);
	d->interrupt.data = d->terminate.data = d;
	uv_signal_start(&d->interrupt, on_signal, SIGINT);
	uv_signal_start(&d->terminate, on_signal, SIGTERM);
	if (!d->replay)
		uv_timer_start(&d->tick, on_tick, TICK_MS, TICK_MS);
	uv_timer_start(&d->second, on_second, 1000, 1000);
	if (watchdog_ms > 0)
		uv_timer_start(&d->watchdog, on_watchdog, watchdog_ms, watchdog_ms);
}

static void on_log(void *ctx, int priority, const char *text)
{
	struct daemon *d = ctx;

	live_log(d->live, now(d), priority, text);
}

/* Log time; in a replay the recorded one. */
static int64_t data_time(void *ctx)
{
	const struct daemon *d = ctx;
	struct player_status status;

	if (!d->player)
		return now(ctx);
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
	uv_timer_start(&d->devices, on_devices, 0, 0);
	return done;
}

static bool begin_parts(struct daemon *d, const struct daemon_options *options)
{
	const struct player_host player = {d, has_room, on_replayed, on_rushing, on_again, on_ended};
	const struct config *config = d->config;
	struct publisher_params publisher = {.cell_m = config->map.cell_m};
	struct worker_params worker = {.map = {.cell_m = config->map.cell_m,
	                                       .tolerance = config->map.tolerance,
	                                       .reduce = config->map.reduce,
	                                       .lookahead = config->map.lookahead,
	                                       .memory = config->map.memory},
	                               .rows_max = options->rows_max,
	                               .patient = d->replay != NULL,
	                               .ready = on_worker_ready,
	                               .ctx = &d->results};
	struct pipeline_sink sink = {.ctx = d,
	                             .row = take_row,
	                             .not_applied = on_not_applied,
	                             .flush = on_flush,
	                             .reply = on_reply,
	                             .data = on_data,
	                             .jump = on_jump,
	                             .profile = on_profile,
	                             .tilt = on_tilt,
	                             .pose = on_pose};
	struct foxglove_host foxglove = {.ctx = d, .now = now, .time = data_time, .status = put_status};
	struct supervisor_host host = {d, watch_device, on_record, log_device};

	memcpy(publisher.map_id, d->map_id, sizeof(publisher.map_id));
	for (int i = 0; i < config->devices; i++)
		d->driver[i] = driver_find(config->device[i].driver);
	if (d->replay) {
		foxglove.playback = put_playback;
		foxglove.play = do_request;
	}
	foxglove_encoders(&publisher, &config->map.cell_m);
	d->publisher = publisher_create(&publisher);
	d->live = live_create(config);
	d->foxglove = d->publisher && d->live ? foxglove_create(d->publisher, d->live, &foxglove) : NULL;
	if (d->live)
		log_listen(on_log, d);
	d->worker = worker_create(&worker);
	d->pipeline = pipeline_create(config, &sink);
	d->supervisor = supervisor_create(config, d->driver, &host);
	d->archive = archive_create(&d->loop, config->map.archive, config->map.cell_m, on_saved, d);
	d->snapshots = snapshots_create(&d->loop, d->publisher, config->map.archive, on_snapshot_saved, d);
	if (d->replay)
		d->player = player_create(d->replay, &player, options->speed);
	return d->foxglove && d->worker && d->pipeline && d->supervisor && d->archive && d->snapshots &&
	       (d->player || !d->replay) && begin_recorders(d, options->config_text);
}

/* A web that the configuration names must be possible. The default one need not: a second daemon on this machine, or a build
 * without it, maps all the same. */
static int begin_web(struct daemon *d, const struct server_host *server)
{
	const struct web_host host = {*server, put_metrics, d->snapshots, d->replay != NULL};
	bool elsewhere; /* not a mistake in what was configured */
	int r;

	d->web = web_create(&d->loop, d->config, d->publisher, &host, &r, d->error);
	elsewhere = r == -EADDRINUSE || r == -EADDRNOTAVAIL || r == -EACCES || r == -ENOTSUP;
	if (!d->web && elsewhere && !d->config->listen.http_set) {
		log_line(LOG_WARNING, "%s; the map goes on without it", d->error);
		return 0;
	}
	if (!d->web)
		return r;
	web_speak(d->web, &web_native_language, NULL);
	web_speak(d->web, &foxglove_language, d->foxglove);
	return web_start(d->web, d->error);
}

static int begin(struct daemon *d, const struct daemon_options *options)
{
	struct server_host host = {d,          now,          put_status, do_command,
	                           log_server, begin_stream, end_stream, d->replay != NULL};

	if (options->journal) {
		d->journal = journal_create(options->journal, d->error);
		if (!d->journal)
			return -EIO;
		journal_sink(d->journal, &d->keep);
	}
	if (!begin_parts(d, options)) {
		snprintf(d->error, 320, "out of memory; give the machine more, or set a smaller map.memory");
		return -ENOMEM;
	}
	begin_list(d);
	d->server = server_create(&d->loop, d->config, d->publisher, &host, d->error);
	if (!d->server)
		return -EADDRINUSE;
	return begin_web(d, &host);
}

static void finish(struct daemon *d)
{
	supervisor_destroy(d->supervisor);
	server_destroy(d->server);
	player_destroy(d->player);
	pipeline_destroy(d->pipeline);
	archive_stop(d->archive);
	journal_destroy(d->journal);
}

static void announce(struct daemon *d)
{
	const char *address;

	for (int i = 0; (address = server_address(d->server, i)) != NULL; i++)
		log_line(LOG_INFO, "listens on %s", address);
	if (web_address(d->web))
		log_line(LOG_INFO, "listens on %s", web_address(d->web));
	notify_ready();
}

int daemon_run(const struct config *config, const struct daemon_options *options, char error[320])
{
	struct daemon *d = calloc(1, sizeof(*d));
	int r;

	if (!d || uv_loop_init(&d->loop) < 0) {
		free(d);
		snprintf(error, 320, "out of memory");
		return -ENOMEM;
	}
	signal(SIGPIPE, SIG_IGN);
	d->config = config;
	d->error = error;
	d->replay = options->replay;
	d->wall_offset_ns = d->clock_offset_ns = wall_clock_first_offset();
	d->started_ns = now(d);
	make_map_id(d, d->map_id);
	memcpy(d->list_map_id, d->map_id, sizeof(d->map_id));
	begin_handles(d);
	r = begin(d, options);
	if (r == 0) {
		if (d->replay) {
			uv_timer_start(&d->devices, on_devices, 0, 0);
		} else {
			supervisor_start(d->supervisor, now(d));
			set_device_timer(d);
		}
		announce(d);
		uv_run(&d->loop, UV_RUN_DEFAULT);
		r = d->failure;
	} else {
		close_all(d);
		uv_run(&d->loop, UV_RUN_DEFAULT);
	}
	/* Devices are closed with their supervisor, whose descriptors are then no longer polled. */
	finish(d);
	uv_run(&d->loop, UV_RUN_DEFAULT);
	/* Snapshots that were being made hold pins until here. */
	web_destroy(d->web);
	foxglove_destroy(d->foxglove);
	log_listen(NULL, NULL);
	live_destroy(d->live);
	snapshots_destroy(d->snapshots);
	publisher_destroy(d->publisher);
	uv_loop_close(&d->loop);
	archive_destroy(d->archive);
	recorders_destroy(d->recorders);
	free(d);
	return r;
}

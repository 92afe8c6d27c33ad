/* The life of the daemon: its parts are made, the loop runs, everything is closed. daemon_parts.h says what the other files
 * of it do; in a replay daemon_replay.c stands where devices stand here.
 *
 *   device readable ─► supervisor ─► on_record: journal, pipeline ─► worker's queue
 *   10 Hz ───────────► on_tick:      journal, pipeline; was the wall clock set?
 *   worker ready ────► daemon_results (daemon_maps.c): publisher, then every client that has room; a map that ended, to the archive
 *   a command ───────► daemon_command (daemon_commands.c)
 *   second ──────────► on_second:    rates, the journal's disk
 *   watchdog ────────► on_watchdog:  only while the worker works or is idle
 *
 * Log time is taken here and nowhere else: realtime at the start plus what the monotonic clock has counted since, so it
 * never goes back and a corrected wall clock moves nothing: only who sends us its time is told. All records of one turn of a device carry one time.
 *
 * The end: devices are stopped (a second at most, more where a servo goes to its rest angle), then sockets and handles
 * are closed and the loop runs dry; whatever hangs, LAST_MS later everything is closed. */
#include "daemon/daemon.h"

#include <errno.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/daemon_parts.h"
#include "daemon/listener.h"
#include "daemon/log.h"
#include "daemon/notify.h"
#include "daemon/wall_clock.h"
#include "daemon/web_native.h"

#define TICK_MS    100
#define STEP_NS    1000000 /* the wall clock was set if it is off by more */
#define LAST_MS    1000
#define STREAMS_MS 20 /* until it is looked again whether clients have their recordings whole */

int64_t daemon_now(void *ctx)
{
	const struct daemon *d = ctx;

	return wall_clock_read(CLOCK_MONOTONIC) + d->clock_offset_ns;
}

static void stop(struct daemon *d);
static void close_all(struct daemon *d);

void daemon_fail(struct daemon *d, int r, const char *sentence)
{
	if (d->failure == 0) {
		d->failure = r;
		snprintf(d->error, 320, "%s", sentence);
	}
	stop(d);
}

/* Events */

void daemon_tell(struct daemon *d, struct buffer *message)
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

static void on_device(void *ctx, int device, bool readable, bool writable)
{
	struct daemon *d = ctx;

	supervisor_ready(d->supervisor, device, readable, writable, daemon_now(d));
	set_device_timer(d);
}

static void watch_device(void *ctx, int device, int fd, bool readable, bool writable)
{
	struct daemon *d = ctx;

	if (fd < 0)
		watchers_leave(&d->watchers, device);
	else if (!watchers_watch(&d->watchers, device, fd, readable, writable))
		log_line(LOG_ERR, "%s: its descriptor cannot be polled; is it a device?",
		         d->config->device[device].name);
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
	daemon_tell(d, &message);
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
	daemon_tell(d, &message);
}

static void on_devices(uv_timer_t *timer)
{
	struct daemon *d = timer->data;

	if (d->replay) {
		daemon_play(d);
		return;
	}
	supervisor_timer(d->supervisor, daemon_now(d));
	set_device_timer(d);
}

/* Rounded up: a timer that fires early finds nothing to do. */
void daemon_wake_devices(struct daemon *d, int64_t wait_ns)
{
	uv_timer_start(&d->devices, on_devices, wait_ns <= 0 ? 0 : (uint64_t)(wait_ns + 999999) / 1000000, 0);
}

/* Clients that take a recording get its end first; one that does not read is waited for until on_last. */
static void close_in_order(struct daemon *d)
{
	if (d->server && server_end_streams(d->server) > 0)
		uv_timer_start(&d->devices, on_devices, STREAMS_MS, 0);
	else
		close_all(d);
}

/* One timer for the nearest deadline of all devices. */
static void set_device_timer(struct daemon *d)
{
	if (d->replay) {
		if (d->stopping)
			close_all(d);
		return;
	}
	int64_t deadline_ns = supervisor_deadline(d->supervisor), wait_ns = deadline_ns - daemon_now(d);

	if (d->closed)
		return;
	if (d->stopping && supervisor_stopped(d->supervisor))
		close_in_order(d);
	else if (deadline_ns == INT64_MAX)
		uv_timer_stop(&d->devices);
	else
		daemon_wake_devices(d, wait_ns);
}

/* The pipeline's sink */

bool daemon_take_row(void *ctx, struct row *row)
{
	struct daemon *d = ctx;
	const int64_t arrival_ns = d->replay ? daemon_now(d) : pipeline_arrival_ns(d->pipeline);
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

/* Time */

static void on_tick(uv_timer_t *timer)
{
	struct daemon *d = timer->data;
	int64_t t_ns = daemon_now(d);

	look_for_step(d);
	if (d->keep.tick)
		d->keep.tick(d->keep.ctx, t_ns);
	recorders_tick(d->recorders, t_ns);
	pipeline_tick(d->pipeline, t_ns);
}

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

static void on_second(uv_timer_t *timer)
{
	struct daemon *d = timer->data;

	daemon_note_second(d);
	if (d->player)
		daemon_show_rush(d);
	log_limits(d);
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
		supervisor_stop(d->supervisor, daemon_now(d));
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
		watchers_leave(&d->watchers, i);
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

	uv_async_init(&d->loop, &d->results, daemon_results);
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

static void on_worker_ready(void *ctx) /* the worker's thread */
{
	uv_async_send(ctx);
}

static void log_server(void *ctx, int priority, const char *text)
{
	(void)ctx;
	log_line(priority, "%s", text);
}

static void on_log(void *ctx, int priority, const char *text)
{
	struct daemon *d = ctx;

	live_log(d->live, daemon_now(d), priority, text);
}

static bool begin_parts(struct daemon *d, const struct daemon_options *options)
{
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
	                             .row = daemon_take_row,
	                             .not_applied = on_not_applied,
	                             .flush = on_flush,
	                             .reply = on_reply,
	                             .data = on_data,
	                             .jump = daemon_jump,
	                             .profile = on_profile,
	                             .tilt = on_tilt,
	                             .pose = on_pose};
	struct foxglove_host foxglove = {
	    .ctx = d, .now = daemon_now, .time = daemon_data_time, .status = daemon_put_status};
	struct supervisor_host host = {d, watch_device, on_record, log_device};

	memcpy(publisher.map_id, d->map_id, sizeof(publisher.map_id));
	for (int i = 0; i < config->devices; i++)
		d->driver[i] = driver_find(config->device[i].driver);
	if (d->replay)
		daemon_replay_foxglove(&foxglove);
	foxglove_encoders(&publisher, &config->map.cell_m);
	d->publisher = publisher_create(&publisher);
	d->live = live_create(config);
	d->foxglove = d->publisher && d->live ? foxglove_create(d->publisher, d->live, &foxglove) : NULL;
	if (d->live)
		log_listen(on_log, d);
	d->worker = worker_create(&worker);
	d->pipeline = pipeline_create(config, &sink);
	d->supervisor = supervisor_create(config, d->driver, &host);
	d->archive = archive_create(&d->loop, config->map.archive, config->map.cell_m, daemon_archived, d);
	d->snapshots = snapshots_create(&d->loop, d->publisher, config->map.archive, daemon_saved, d);
	return d->foxglove && d->worker && d->pipeline && d->supervisor && d->archive && d->snapshots &&
	       (!d->replay || daemon_begin_replay(d, options->speed)) &&
	       daemon_begin_recorders(d, options->config_text);
}

/* A web that the configuration names must be possible. The default one need not: a second daemon on this machine, or a build
 * without it, maps all the same. */
static int begin_web(struct daemon *d, const struct server_host *server)
{
	const struct web_host host = {*server, daemon_put_metrics, d->snapshots, d->replay != NULL};
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
	struct server_host host = {d,          daemon_now,          daemon_put_status, daemon_command,
	                           log_server, daemon_begin_stream, daemon_end_stream, d->replay != NULL};

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
	daemon_begin_list(d);
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

/* A socket unit and a configuration that do not fit each other are told apart from a daemon that does not answer. */
static void report_passed(const struct daemon *d)
{
	const int left = listener_passed() - server_passed(d->server) - web_passed(d->web);

	if (left > 0)
		log_line(LOG_WARNING,
		         "systemd passed %d socket%s that neither listen.native nor listen.http names; nobody is "
		         "served there",
		         left, left == 1 ? "" : "s");
}

static void announce(struct daemon *d)
{
	const char *address;

	for (int i = 0; (address = server_address(d->server, i)) != NULL; i++)
		log_line(LOG_INFO, "listens on %s", address);
	if (web_address(d->web))
		log_line(LOG_INFO, "listens on %s", web_address(d->web));
	report_passed(d);
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
	d->watchers = (struct watchers){.loop = &d->loop, .ready = on_device, .ctx = d};
	d->wall_offset_ns = d->clock_offset_ns = wall_clock_first_offset();
	d->started_ns = daemon_now(d);
	daemon_make_map_id(d, d->map_id);
	memcpy(d->list_map_id, d->map_id, sizeof(d->map_id));
	begin_handles(d);
	r = begin(d, options);
	if (r == 0) {
		if (d->replay) {
			daemon_wake_devices(d, 0);
		} else {
			supervisor_start(d->supervisor, daemon_now(d));
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

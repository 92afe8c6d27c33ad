/* What the daemon tells of itself: one struct control_status, of which STATUS and /metrics are made. */
#include "daemon/daemon_parts.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/wall_clock.h"
#include "daemon/web_metrics.h"

#define CLIENTS_SHOWN 64

void daemon_note_latencies(struct daemon *d, const struct worker_result *result)
{
	int64_t t_ns = daemon_now(d);

	for (size_t i = 0; i < result->arrivals; i++)
		d->latency_ms[d->latencies++ % LATENCIES] = (double)(t_ns - result->arrival_ns[i]) / 1e6;
}

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

void daemon_note_second(struct daemon *d)
{
	struct pipeline_stats rows;
	size_t column = ++d->seconds % (RATE_SECONDS + 1);

	pipeline_stats(d->pipeline, &rows);
	d->rows[column] = rows.rows;
	for (int i = 0; i < d->config->devices; i++)
		d->decoded[column][i] = daemon_device(d, i)->decoded;
}

static double rate(uint64_t newest, uint64_t oldest, uint64_t seconds)
{
	return seconds > 0 ? (double)(newest - oldest) / (double)seconds : 0;
}

const struct supervisor_device *daemon_device(const struct daemon *d, int device)
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
		s->device[i].line = *daemon_device(d, i);
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
	s.t_ns = daemon_now(d);
	s.uptime_ns = s.t_ns - d->started_ns;
	s.step = map.step;
	s.paused = d->paused;
	if (d->player)
		fill_replay(d, &s);
	s.rows.assembled = rows.rows;
	s.rows.applied = d->field.step;
	s.rows.not_applied = rows.not_applied;
	s.worker.idle &= !rows.looks_ahead;
	s.rows.queue_full = d->queue_full;
	s.rows.paused = d->rows_paused;
	s.rows.sweep = rows.sweep;
	s.patches = map.patches;
	s.faces = map.faces;
	s.faces_raw = map.faces_raw;
	s.batches = d->batches;
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

void daemon_put_status(void *ctx, struct buffer *ret)
{
	struct control_client client[CLIENTS_SHOWN];
	struct control_status s;

	fill_status(ctx, client, &s);
	control_put_status(ret, &s);
}

void daemon_put_metrics(void *ctx, struct buffer *ret)
{
	struct daemon *d = ctx;
	struct control_client client[CLIENTS_SHOWN];
	struct control_status s;
	struct publisher_stats map;

	fill_status(d, client, &s);
	publisher_stats(d->publisher, &map);
	web_metrics_put(ret, &s, &map);
}

/* Names: facetd_, the thing, its base unit, and _total behind what only grows. A family is one HELP, one TYPE and its samples;
 * what is labelled (devices, reasons) keeps its samples while the daemon runs, so that a missing one means a missing daemon. */
#include "daemon/web_metrics.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

static void family(struct buffer *b, const char *name, const char *type, const char *help)
{
	buffer_printf(b, "# HELP facetd_%s %s\n# TYPE facetd_%s %s\n", name, help, name, type);
}

static void number(struct buffer *b, double value)
{
	if (isfinite(value))
		buffer_printf(b, " %.15g\n", value);
	else
		buffer_printf(b, isnan(value) ? " NaN\n" : " +Inf\n");
}

/* One without labels. */
static void single(struct buffer *b, const char *name, const char *type, const char *help, double value)
{
	family(b, name, type, help);
	buffer_printf(b, "facetd_%s", name);
	number(b, value);
}

static void gauge(struct buffer *b, const char *name, const char *help, double value)
{
	single(b, name, "gauge", help, value);
}

static void counter(struct buffer *b, const char *name, const char *help, uint64_t value)
{
	family(b, name, "counter", help);
	buffer_printf(b, "facetd_%s %llu\n", name, (unsigned long long)value);
}

/* {name="value"}, with what would end the value escaped. */
static void label(struct buffer *b, const char *before, const char *name, const char *value)
{
	buffer_printf(b, "%s%s=\"", before, name);
	for (const char *c = value; *c; c++) {
		if (*c == '\\' || *c == '"')
			buffer_printf(b, "\\%c", *c);
		else
			buffer_printf(b, "%c", *c == '\n' ? ' ' : *c);
	}
	buffer_printf(b, "\"");
}

static void sample(struct buffer *b, const char *name, const char *label_name, const char *value, double what)
{
	buffer_printf(b, "facetd_%s", name);
	label(b, "{", label_name, value);
	buffer_printf(b, "}");
	number(b, what);
}

/* Sections */

static void put_daemon(struct buffer *b, const struct control_status *s)
{
	char map[33];

	for (int i = 0; i < 16; i++)
		snprintf(map + 2 * i, 3, "%02x", s->map_id[i]);
	family(b, "info", "gauge", "What runs, and the map it makes.");
	buffer_printf(b, "facetd_info");
	label(b, "{", "version", FACET_VERSION);
	label(b, ",", "map", map);
	buffer_printf(b, "} 1\n");
	gauge(b, "uptime_seconds", "Since the daemon began.", (double)s->uptime_ns / 1e9);
	gauge(b, "map_generation", "Grows with every reset of the map.", s->generation);
	gauge(b, "map_step", "Rows that are in the published map.", (double)s->step);
	gauge(b, "map_cell_meters", "Edge of a voxel.", s->cell_m);
	gauge(b, "paused", "Whether the map takes no rows on command.", s->paused);
}

static void put_rows(struct buffer *b, const struct control_status *s)
{
	counter(b, "rows_assembled_total", "Rows made from profiles.", s->rows.assembled);
	counter(b, "rows_applied_total", "Rows that are in the map.", s->rows.applied);
	counter(b, "rows_not_applied_total", "Rows that will never be.", s->rows.not_applied);
	gauge(b, "rows_per_second", "Rows assembled, mean over some seconds.", s->rows.rate);
	counter(b, "profiles_total", "Profiles of all scanners.", s->rows.sweep.profiles);
	counter(b, "sweeps_total", "Turns of the servo.", s->rows.sweep.sweeps);
	family(b, "rows_dropped_total", "counter", "Rows that were not applied, by reason.");
	for (int i = 0; i < SWEEP_DROPS; i++)
		sample(b, "rows_dropped_total", "reason", sweep_drop_name((enum sweep_drop)i),
		       (double)s->rows.sweep.dropped[i]);
	sample(b, "rows_dropped_total", "reason", "queue full", (double)s->rows.queue_full);
	sample(b, "rows_dropped_total", "reason", "paused", (double)s->rows.paused);
	family(b, "beams_total", "counter", "Beams by what became of them.");
	for (int i = 0; i < BEAM_STATES; i++)
		sample(b, "beams_total", "state", control_beam_name((enum beam_state)i),
		       (double)s->rows.sweep.beams[i]);
}

static void put_map(struct buffer *b, const struct control_status *s)
{
	counter(b, "batches_total", "Sets of changed patches that were published.", s->batches);
	gauge(b, "blocks", "Blocks of voxels.", (double)s->grid.blocks);
	gauge(b, "patches", "Patches with triangles.", (double)s->patches);
	family(b, "triangles", "gauge", "Triangles of the map, before and after the reduction.");
	sample(b, "triangles", "mesh", "raw", (double)s->faces_raw);
	sample(b, "triangles", "mesh", "reduced", (double)s->faces);
	gauge(b, "memory_used_bytes", "What the voxels of the map take.", (double)s->grid.bytes);
	gauge(b, "memory_cap_bytes", "What they may take: map.memory.", (double)s->memory_cap);
	family(b, "blocks_refused_total", "counter", "Blocks that were not made, by reason.");
	sample(b, "blocks_refused_total", "reason", "memory", (double)s->grid.refused_memory);
	sample(b, "blocks_refused_total", "reason", "far", (double)s->grid.refused_far);
	gauge(b, "resident_memory_bytes", "What the daemon takes of the machine.", (double)s->rss_bytes);
	gauge(b, "queue_rows", "Rows that wait for the worker.", (double)s->worker.queued);
	gauge(b, "queue_rows_peak", "The most that ever waited.", (double)s->worker.queued_peak);
	gauge(b, "queue_rows_cap", "The most that may wait.", (double)s->worker.rows_max);
	family(b, "latency_seconds", "summary", "From a row's last byte to its published mesh, over the newest rows.");
	if (s->latencies > 0) {
		sample(b, "latency_seconds", "quantile", "0.5", s->latency_p50_ms / 1e3);
		sample(b, "latency_seconds", "quantile", "0.99", s->latency_p99_ms / 1e3);
	}
	buffer_printf(b, "facetd_latency_seconds_count %llu\n", (unsigned long long)s->latencies);
}

static double seen(const struct control_status *s, int i)
{
	return s->device[i].line.state == SUPERVISOR_STREAMING;
}

static double rate(const struct control_status *s, int i)
{
	return s->device[i].rate;
}

static double expected(const struct control_status *s, int i)
{
	return s->device[i].timing.known ? s->device[i].timing.expected_hz : NAN;
}

static double lost(const struct control_status *s, int i)
{
	return s->device[i].timing.known ? (double)s->device[i].timing.lost : NAN;
}

static double losses(const struct control_status *s, int i)
{
	return (double)s->device[i].line.losses;
}

static double opens(const struct control_status *s, int i)
{
	return (double)s->device[i].line.opens;
}

static double records(const struct control_status *s, int i)
{
	return (double)s->device[i].line.decoded;
}

static double bytes_in(const struct control_status *s, int i)
{
	return (double)s->device[i].line.bytes_in;
}

static double bytes_out(const struct control_status *s, int i)
{
	return (double)s->device[i].line.bytes_out;
}

static const struct {
	const char *name, *type, *help;
	double (*value)(const struct control_status *, int device);
} of_devices[] = {
    {"device_up", "gauge", "Whether the device streams.", seen},
    {"device_rate_hertz", "gauge", "Profiles, angles or poses a second, mean over some seconds.", rate},
    {"device_expected_hertz", "gauge", "What it should be; NaN: not known.", expected},
    {"device_samples_lost_total", "counter", "Samples that its clock or counter says are missing; NaN: not known.",
     lost},
    {"device_losses_total", "counter", "How often the device was lost.", losses},
    {"device_opens_total", "counter", "How often it was opened.", opens},
    {"device_records_total", "counter", "Records decoded.", records},
    {"device_received_bytes_total", "counter", "Bytes from the device.", bytes_in},
    {"device_sent_bytes_total", "counter", "Bytes to the device.", bytes_out},
};

static void put_devices(struct buffer *b, const struct control_status *s)
{
	for (size_t k = 0; k < sizeof(of_devices) / sizeof(of_devices[0]); k++) {
		family(b, of_devices[k].name, of_devices[k].type, of_devices[k].help);
		for (int i = 0; i < s->devices; i++)
			sample(b, of_devices[k].name, "device", s->device[i].name, of_devices[k].value(s, i));
	}
	family(b, "device_counts_total", "counter", "What its decoder counted, by name.");
	for (int i = 0; i < s->devices; i++)
		for (int k = 0; k < s->device[i].counters.n; k++) {
			buffer_printf(b, "facetd_device_counts_total");
			label(b, "{", "device", s->device[i].name);
			label(b, ",", "what", s->device[i].counters.counter[k].name);
			buffer_printf(b, "} %llu\n", (unsigned long long)s->device[i].counters.counter[k].count);
		}
}

static void put_client(struct buffer *b, const char *name, const struct control_client *c, uint64_t value)
{
	char id[24];

	snprintf(id, sizeof(id), "%llu", (unsigned long long)c->id);
	buffer_printf(b, "facetd_%s", name);
	label(b, "{", "client", id);
	label(b, ",", "kind", c->kind);
	buffer_printf(b, "} %llu\n", (unsigned long long)value);
}

static void put_clients(struct buffer *b, const struct control_status *s)
{
	gauge(b, "clients", "Connected.", (double)s->clients);
	family(b, "client_sent_bytes_total", "counter", "Bytes to a client, as long as it is connected.");
	for (size_t i = 0; i < s->clients; i++)
		put_client(b, "client_sent_bytes_total", &s->client[i], s->client[i].sent);
	family(b, "client_behind_steps", "gauge", "How many steps a client lacks.");
	for (size_t i = 0; i < s->clients; i++)
		put_client(b, "client_behind_steps", &s->client[i], s->client[i].behind);
	family(b, "client_queued_bytes", "gauge", "What is held for a client.");
	for (size_t i = 0; i < s->clients; i++)
		put_client(b, "client_queued_bytes", &s->client[i], s->client[i].queued);
	family(b, "client_aborts_total", "counter", "Batches that were given up because a client was slow.");
	for (size_t i = 0; i < s->clients; i++)
		put_client(b, "client_aborts_total", &s->client[i], s->client[i].aborts);
}

static void put_publisher(struct buffer *b, const struct publisher_stats *p)
{
	static const char *const form[PUBLISHER_FORMS] = {[PUBLISHER_NATIVE] = "native",
	                                                  [PUBLISHER_CODED] = "coded",
	                                                  [PUBLISHER_PACKED] = "packed",
	                                                  [PUBLISHER_SCENE_JSON] = "scene json",
	                                                  [PUBLISHER_SCENE_PROTOBUF] = "scene protobuf"};

	gauge(b, "encoded_bytes", "Patches as they are sent.", (double)p->bytes);
	gauge(b, "pinned_bytes", "Patches that are no longer new and not yet sent.", (double)p->pinned);
	gauge(b, "encoded_more_bytes", "Patches kept in forms other than the native one.", (double)p->forms_bytes);
	family(b, "encodes_total", "counter", "Patches encoded, by form: once for all clients.");
	for (int i = 0; i < PUBLISHER_FORMS; i++)
		sample(b, "encodes_total", "form", form[i], (double)p->encodes[i]);
}

static void put_recording(struct buffer *b, const struct control_status *s)
{
	const struct recorder_status *r = &s->record;
	const char *state = r->recording ? "recording" : r->enabled ? "waiting" : "off";
	static const char *const states[] = {"off", "waiting", "recording"};

	family(b, "recording", "gauge",
	       "State of the recording of the folder; waiting: it is wanted, and cannot be written now.");
	for (size_t i = 0; i < sizeof(states) / sizeof(states[0]); i++)
		sample(b, "recording", "state", states[i], strcmp(states[i], state) == 0);
	gauge(b, "recording_file_bytes", "Of the newest file.", (double)r->bytes);
	gauge(b, "recording_file_messages", "In the newest file.", (double)r->messages);
	counter(b, "recording_files_total", "Files begun.", r->files);
	counter(b, "recording_gaps_total", "Times that something is missing between two files.", r->gaps);
	counter(b, "recording_dropped_total", "Events that found no room, or no file.", r->dropped);
	gauge(b, "recording_queued_bytes", "What waits for the disk.", (double)r->queued);
	gauge(b, "recording_queued_bytes_peak", "The most that ever waited.", (double)r->queued_peak);
	gauge(b, "recording_streams", "Recordings that clients take.", (double)s->streams);
}

/* Only there while something is replayed. */
static void put_replay(struct buffer *b, const struct control_status *s)
{
	const struct player_status *p = &s->replay;

	if (!s->replays)
		return;
	family(b, "replay", "gauge", "State of the replay.");
	for (int i = PLAYER_PLAYING; i <= PLAYER_ENDED; i++)
		sample(b, "replay", "state", player_state_name((enum player_state)i), (int)p->state == i);
	gauge(b, "replay_position_seconds", "Recorded time gone through.", (double)(p->now_ns - p->begin_ns) / 1e9);
	gauge(b, "replay_length_seconds", "Recorded time there is.", (double)(p->end_ns - p->begin_ns) / 1e9);
	gauge(b, "replay_speed_ratio", "Recorded seconds a second that are wanted; +Inf: as many as can be.",
	      p->speed == 0 ? (double)INFINITY : p->speed);
	counter(b, "replay_seeks_total", "Jumps to another place of the recording.", p->seeks);
	gauge(b, "replay_failed", "Whether it ended early because something was wrong.", *s->replay_error != '\0');
}

void web_metrics_put(struct buffer *b, const struct control_status *s, const struct publisher_stats *p)
{
	put_daemon(b, s);
	put_rows(b, s);
	put_map(b, s);
	put_devices(b, s);
	put_recording(b, s);
	put_replay(b, s);
	put_clients(b, s);
	put_publisher(b, p);
}

/* The loop of the rig: the earliest of all that is due, over and over.
 *
 *   carriers    brains advance at their deadlines, and after whatever they were told; what left them arrives later
 *   supervisor  is told of readable and writable links while it watches them, and of its own deadlines
 *   feed        servo and localisation, where no simulated device stands; a tick every 100 ms */
#include <stdlib.h>
#include <string.h>

#include "tests/rig_parts.h"

#define TICK_NS (100 * RIG_MS)

enum fault { WALL_CLOCK, LATE_ANGLES, NO_ANGLES, NO_POSES };
static const char *const fault_names[] = {"wall clock", "late angles", "no angles", "no poses", NULL};

struct rig *the_rig;

_Noreturn void rig_give_up(const char *what)
{
	fprintf(stderr, "rig: %s\n", what);
	exit(1);
}

/* What comes out of the pipeline */

static bool take_row(void *ctx, struct row *row)
{
	struct rig *r = ctx;

	for (int i = 0; i < r->config.devices; i++)
		if (r->driver[i].role == ROLE_LASER && r->scanner[i].raster == row->raster)
			rig_compare(&r->scanner[i], row);
	if (r->keeper.row)
		r->keeper.row(r->keeper.ctx, row);
	else
		row_destroy(row);
	return true;
}

static void flush_rows(void *ctx)
{
	struct rig *r = ctx;

	if (r->keeper.flush)
		r->keeper.flush(r->keeper.ctx);
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	supervisor_reply(((struct rig *)ctx)->supervisor, device, reply);
}

static void on_data(void *ctx, int device, int64_t t_ns)
{
	struct rig *r = ctx;
	struct flow *f = &r->flow[device];

	if (f->last_ns >= 0 && t_ns - f->last_ns > f->longest_pause_ns)
		f->longest_pause_ns = t_ns - f->last_ns;
	f->last_ns = t_ns;
	f->decoded++;
	supervisor_data(r->supervisor, device, t_ns);
}

/* The supervisor's host */

static void on_watch(void *ctx, int device, int fd, bool readable, bool writable)
{
	struct link *l = &((struct rig *)ctx)->link[device];

	l->readable = fd >= 0 && readable;
	l->writable = fd >= 0 && writable;
}

void rig_handle(struct rig *r, const struct record *record)
{
	if (r->keeper.journal.begin)
		r->keeper.journal.record(r->keeper.journal.ctx, record);
	pipeline_handle(r->pipeline, record);
}

static void on_record(void *ctx, const struct record *record)
{
	rig_handle(ctx, record);
}

static void tick(struct rig *r)
{
	if (r->keeper.journal.begin)
		r->keeper.journal.tick(r->keeper.journal.ctx, r->now_ns);
	pipeline_tick(r->pipeline, r->now_ns);
	r->tick_ns += TICK_NS;
}

static void set_clock(struct rig *r, int64_t ahead_ns)
{
	r->ahead_ns = ahead_ns;
	if (r->keeper.journal.begin)
		r->keeper.journal.clock(r->keeper.journal.ctx, ahead_ns);
	pipeline_clock(r->pipeline, ahead_ns);
}

static void on_log(void *ctx, int device, int priority, const char *text)
{
	struct rig *r = ctx;
	struct rig_log *line = &r->log[r->logged++ % RIG_LOG_LINES];

	(void)priority;
	line->t_ns = r->now_ns - RIG_EPOCH_NS;
	line->device = device;
	snprintf(line->text, sizeof(line->text), "%s", text);
}

/* The loop */

static int64_t next_event(const struct rig *r)
{
	int64_t next_ns = rig_earlier(r->tick_ns, supervisor_deadline(r->supervisor));

	next_ns = rig_earlier(next_ns, rig_feed_due(r));
	for (int i = 0; i < r->config.devices; i++)
		if (r->link[i].carrier)
			next_ns = rig_earlier(next_ns, r->link[i].carrier->due(&r->link[i]));
	return next_ns > r->now_ns ? next_ns : r->now_ns;
}

static void serve(struct link *l)
{
	struct rig *r = l->rig;
	bool readable, writable;

	if (!l->carrier)
		return;
	l->carrier->serve(l);
	readable = l->readable && l->carrier->readable(l);
	writable = l->writable && l->carrier->writable(l);
	if (readable || writable)
		supervisor_ready(r->supervisor, l->device, readable, writable, r->now_ns);
}

void rig_run(struct rig *r, int64_t for_ns)
{
	int64_t until_ns = r->now_ns + for_ns, next_ns;
	int turns = 0;

	while ((next_ns = next_event(r)) <= until_ns) {
		turns = next_ns == r->now_ns ? turns + 1 : 0;
		if (turns > 100000)
			rig_give_up("the time stands still");
		r->now_ns = next_ns;
		for (int i = 0; i < r->config.devices; i++)
			serve(&r->link[i]);
		rig_feed(r);
		if (r->now_ns >= r->tick_ns)
			tick(r);
		if (supervisor_deadline(r->supervisor) <= r->now_ns)
			supervisor_timer(r->supervisor, r->now_ns);
	}
	r->now_ns = until_ns;
}

static void begin_list(struct rig *r)
{
	if (r->keeper.journal.begin && journal_begin(&r->keeper.journal, r->pipeline) < 0)
		rig_give_up("out of memory");
}

void rig_keep(struct rig *r, const struct rig_keeper *keeper)
{
	r->keeper = *keeper;
	begin_list(r);
}

void rig_new_map(struct rig *r)
{
	pipeline_reset(r->pipeline);
	begin_list(r);
}

void rig_start(struct rig *r)
{
	supervisor_start(r->supervisor, r->now_ns);
	r->started = true;
}

void rig_stop(struct rig *r)
{
	supervisor_stop(r->supervisor, r->now_ns);
	for (int i = 0; i < 2000 && !supervisor_stopped(r->supervisor); i++)
		rig_run(r, RIG_MS);
}

int64_t rig_now(const struct rig *r)
{
	return r->now_ns - RIG_EPOCH_NS;
}

int64_t rig_epoch_ns(const struct rig *r)
{
	return r->now_ns;
}

/* Faults */

static void world_fault(struct rig *r, enum fault kind, double value, bool on)
{
	switch (kind) {
	case WALL_CLOCK:
		set_clock(r, on ? (int64_t)(value * (double)RIG_SECOND) : 0);
		break;
	case LATE_ANGLES:
		r->tilt_late_ns = on ? (int64_t)(value * (double)RIG_MS) : 0;
		break;
	case NO_ANGLES:
		r->tilt_late_ns = on ? INT64_MAX : 0;
		break;
	case NO_POSES:
		r->no_poses = on;
		break;
	}
}

static bool order(struct rig *r, const char *device, const struct sim_fault *what, bool on)
{
	struct link *l = &r->link[rig_find(r, device)];
	const int kind = sim_fault_index(fault_names, what->kind);
	struct sim_fault fault = *what;

	snprintf(fault.device, sizeof(fault.device), "%s", device);
	if (kind >= 0)
		world_fault(r, (enum fault)kind, fault.value, on);
	else if (!l->carrier ||
	         (!l->carrier->fault(l, &fault, on) && !l->brain.fault(l->brain.ctx, &fault, on, r->now_ns)))
		return false;
	if (kind < 0)
		l->carrier->stir(l);
	return true;
}

bool rig_fault(struct rig *r, const char *device, const char *kind, double value, bool on)
{
	struct sim_fault fault = {.value = value, .for_ns = INT64_MAX};

	snprintf(fault.kind, sizeof(fault.kind), "%s", kind);
	return order(r, device, &fault, on);
}

bool rig_once(struct rig *r, const char *device, const char *kind, double value)
{
	struct sim_fault fault = {.value = value};

	snprintf(fault.kind, sizeof(fault.kind), "%s", kind);
	return order(r, device, &fault, true);
}

/* To be seen from outside */

int rig_find(const struct rig *r, const char *device)
{
	for (int i = 0; i < r->config.devices; i++)
		if (strcmp(r->config.device[i].name, device) == 0)
			return i;
	rig_give_up("a device of this name is not configured");
}

void rig_view(const struct rig *r, const char *device, struct rig_view *ret)
{
	int i = rig_find(r, device);
	const struct link *l = &r->link[i];
	const struct flow *f = &r->flow[i];

	memset(ret, 0, sizeof(*ret));
	ret->line = *supervisor_device(r->supervisor, i);
	ret->state = ret->line.state;
	if (l->carrier)
		l->brain.counts(l->brain.ctx, &ret->sent);
	if (l->carrier && l->carrier->lost_profiles)
		ret->lost_profiles = l->carrier->lost_profiles(l);
	ret->profiles = f->decoded;
	ret->last_data_ns = f->last_ns < 0 ? -1 : f->last_ns - RIG_EPOCH_NS;
	ret->longest_pause_ns = f->longest_pause_ns;
	if (f->last_ns >= 0 && r->now_ns - f->last_ns > ret->longest_pause_ns)
		ret->longest_pause_ns = r->now_ns - f->last_ns;
	ret->first_request_ns = l->first_request_ns < 0 ? -1 : l->first_request_ns - RIG_EPOCH_NS;
	ret->requests = l->requests;
	ret->heard_len = l->requests < sizeof(l->heard) ? (size_t)l->requests : sizeof(l->heard);
	memcpy(ret->heard, l->heard, ret->heard_len);
}

void rig_note_request(struct link *l, const uint8_t *bytes, size_t len)
{
	if (l->first_request_ns < 0)
		l->first_request_ns = l->rig->now_ns;
	for (size_t i = 0; i < len && l->requests + i < sizeof(l->heard); i++)
		l->heard[l->requests + i] = bytes[i];
	l->requests += len;
}

void rig_mark(struct rig *r, const char *device)
{
	int i = rig_find(r, device);

	r->link[i].first_request_ns = -1;
	r->link[i].requests = 0;
	r->flow[i].longest_pause_ns = 0;
}

void rig_counters(const struct rig *r, const char *device, struct decoder_counters *ret)
{
	pipeline_counters(r->pipeline, rig_find(r, device), ret);
}

int64_t rig_count(const struct rig *r, const char *device, const char *counter)
{
	struct decoder_counters counters;

	rig_counters(r, device, &counters);
	for (int i = 0; i < counters.n; i++)
		if (strcmp(counters.counter[i].name, counter) == 0)
			return (int64_t)counters.counter[i].count;
	return -1;
}

int64_t rig_wait_data(struct rig *r, const char *device, int64_t limit_ns)
{
	int64_t begin_ns = rig_now(r);
	struct rig_view view;

	while (rig_now(r) - begin_ns < limit_ns) {
		rig_run(r, RIG_MS);
		rig_view(r, device, &view);
		if (view.state == SUPERVISOR_STREAMING && view.last_data_ns > begin_ns)
			return view.last_data_ns - begin_ns;
	}
	return -1;
}

size_t rig_logged(const struct rig *r)
{
	return r->logged;
}

const struct rig_log *rig_log(const struct rig *r, size_t line)
{
	return line < r->logged && r->logged - line <= RIG_LOG_LINES ? &r->log[line % RIG_LOG_LINES] : NULL;
}

int rig_log_count(const struct rig *r, const char *device, size_t from, const char *begin)
{
	int n = 0, i = rig_find(r, device);

	for (size_t line = from; line < r->logged; line++) {
		const struct rig_log *log = rig_log(r, line);

		n += log && log->device == i && strncmp(log->text, begin, strlen(begin)) == 0;
	}
	return n;
}

static int compare_times(const void *a, const void *b)
{
	int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;

	return x < y ? -1 : x > y;
}

/* So large a share of the beams is off by less. */
static double angle_share(const struct scanner *s, double share)
{
	uint64_t sum = 0;

	for (int i = 0; i <= RIG_ANGLES; i++)
		if ((double)(sum += s->angle_off[i]) > share * (double)s->angles)
			return 0.001 * (i + 1);
	return 0;
}

void rig_points(const struct rig *r, const char *device, struct rig_points *ret)
{
	const struct scanner *s = &r->scanner[rig_find(r, device)];
	static int64_t sorted[RIG_TIMES];
	size_t n = s->times < RIG_TIMES ? (size_t)s->times : RIG_TIMES;

	*ret = s->points;
	ret->angle_p50_deg = angle_share(s, 0.5);
	ret->angle_p99_deg = angle_share(s, 0.99);
	memcpy(sorted, s->time_ns, n * sizeof(*sorted));
	qsort(sorted, n, sizeof(*sorted), compare_times);
	if (n == 0)
		return;
	ret->time_p50_ns = sorted[n / 2];
	ret->time_p99_ns = sorted[n * 99 / 100];
	ret->time_worst_ns = sorted[n - 1];
}

void rig_points_clear(struct rig *r, const char *device)
{
	struct scanner *s = &r->scanner[rig_find(r, device)];

	memset(&s->points, 0, sizeof(s->points));
	memset(s->angle_off, 0, sizeof(s->angle_off));
	s->times = s->angles = 0;
}

void rig_pipeline_stats(const struct rig *r, struct pipeline_stats *ret)
{
	pipeline_stats(r->pipeline, ret);
}

/* Life */

void rig_scene(struct rig *r, const char *device, struct scene *ret)
{
	*ret = (struct scene){.ctx = &r->scanner[rig_find(r, device)], .scan = rig_scan};
}

void rig_follow(struct rig *r, double (*angle)(void *ctx, int64_t t_ns), void *ctx)
{
	r->angle = angle;
	r->angle_ctx = ctx;
}

/* The driver's own parts; where nothing is attached it has neither dialogue nor link, and records are fed. */
static void join_driver(struct rig *r, int device)
{
	struct driver *driver = &r->driver[device];
	const struct driver *real = driver_find(r->config.device[device].driver);
	const struct rig_carrier *carrier = r->link[device].carrier;

	if (!real)
		rig_give_up("a driver is configured that does not exist");
	*driver = *real;
	if (!carrier && real->role != ROLE_LASER) {
		driver->dialogue_create = NULL;
		driver->link_open = NULL;
	}
	if (carrier && carrier != &rig_stream)
		return; /* what its link stands on is replaced */
	driver->link_open = carrier ? rig_stream_open : NULL;
	driver->link_fd = rig_stream_fd;
	driver->link_read = rig_stream_read;
	driver->link_write = rig_stream_write;
	driver->link_baud = real->link_baud ? rig_stream_baud : NULL;
	driver->link_flush = real->link_flush ? rig_stream_flush : NULL;
	driver->link_error = NULL;
	driver->link_note = NULL;
	driver->link_close = rig_stream_close;
}

static void make_supervisor(struct rig *r)
{
	const struct driver *drivers[CONFIG_DEVICES_MAX];
	struct supervisor_host host = {r, on_watch, on_record, on_log};

	for (int i = 0; i < r->config.devices; i++)
		drivers[i] = &r->driver[i];
	supervisor_destroy(r->supervisor);
	r->supervisor = supervisor_create(&r->config, drivers, &host);
	if (!r->supervisor)
		rig_give_up("out of memory");
}

static const struct rig_carrier *carrier_of(enum rig_transport transport)
{
	switch (transport) {
	case RIG_CAN:
		return &rig_can;
	case RIG_MODBUS:
		return &rig_modbus;
	default:
		return &rig_stream;
	}
}

void rig_attach(struct rig *r, const char *device, enum rig_transport transport, const struct sim_device *brain)
{
	const int i = rig_find(r, device);
	struct link *l = &r->link[i];

	if (r->started || l->carrier)
		rig_give_up("a device is attached too late, or twice");
	l->transport = transport;
	l->brain = *brain;
	l->carrier = carrier_of(transport);
	l->carrier->attach(l);
	if (r->servo == i)
		r->servo = -1;
	if (r->localisation == i)
		r->localisation = -1;
	join_driver(r, i);
	make_supervisor(r);
}

static void make_scanner(struct rig *r, int device)
{
	struct scanner *s = &r->scanner[device];
	struct sweep_params params;

	config_sweep_params(&r->config, device, &params);
	s->raster = params.raster;
	s->rig = r;
	s->device = device;
	s->base_tilt = r->config.mount.base_tilt;
	s->tilt_laser = r->config.mount.tilt_laser;
	s->tilts = r->config.device[device].tilt[0] != 0;
	s->truth = calloc(RIG_TRUTHS, sizeof(*s->truth));
	if (!s->truth)
		rig_give_up("out of memory");
}

static void make_device(struct rig *r, int i)
{
	join_driver(r, i);
	r->link[i] = (struct link){
	    .rig = r, .device = i, .first_request_ns = -1, .random = sim_mix(r->params.seed * 64 + (uint64_t)i)};
	r->flow[i].last_ns = -1;
	if (r->driver[i].role == ROLE_LASER)
		make_scanner(r, i);
	if (r->driver[i].role == ROLE_TILT && strcmp(r->config.device[i].driver, "modbus") == 0)
		r->servo = i;
	if (r->driver[i].role == ROLE_POSE && !r->config.device[i].fixed)
		r->localisation = i;
}

static void make_devices(struct rig *r)
{
	struct pipeline_sink sink = {
	    .ctx = r, .row = take_row, .flush = flush_rows, .reply = on_reply, .data = on_data};

	r->servo = r->localisation = -1;
	for (int i = 0; i < r->config.devices; i++)
		make_device(r, i);
	r->pipeline = pipeline_create(&r->config, &sink);
	if (!r->pipeline)
		rig_give_up("out of memory");
	make_supervisor(r);
}

struct rig *rig_create(const struct rig_params *params)
{
	struct rig *r = calloc(1, sizeof(*r));
	struct config_error why = {""};
	char error[160] = "";

	if (!r || the_rig)
		rig_give_up("there can be one rig at a time");
	the_rig = r;
	r->params = *params;
	if (config_read(params->yaml, strlen(params->yaml), "rig", &r->config, &why) < 0)
		rig_give_up(why.text);
	r->world = world_create(params->world ? params->world : "hall", error);
	if (!r->world)
		rig_give_up(error);
	r->now_ns = r->tilt_ns = r->pose_ns = r->tick_ns = RIG_EPOCH_NS;
	r->pose_period_ns = params->pose_ns > 0 ? params->pose_ns : RIG_POSE_NS;
	r->piece = -1;
	make_devices(r);
	return r;
}

void rig_destroy(struct rig *r)
{
	if (!r)
		return;
	supervisor_destroy(r->supervisor);
	pipeline_destroy(r->pipeline);
	for (int i = 0; i < r->config.devices; i++) {
		free(r->scanner[i].truth);
		if (!r->link[i].carrier)
			continue;
		r->link[i].carrier->detach(&r->link[i]);
		r->link[i].brain.destroy(r->link[i].brain.ctx);
	}
	world_destroy(r->world);
	the_rig = NULL;
	free(r);
}

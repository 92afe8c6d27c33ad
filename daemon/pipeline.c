/* The whole system on one screen: how a reading becomes rows of the map (design, section 1).
 *
 *   pipeline_handle              a record goes to its device's decoder;
 *   on_profile, on_tilt          what the decoder finds goes to the assemblers that need it: a profile to its scanner's,
 *                                an angle to those of the scanners which that device tilts;
 *   on_pose, on_motion           poses and motions go to the robot's track, and its poses to all assemblers;
 *   advance                      every assembler hands out the rows that are complete at this record's log time;
 *   hand_out                     a row gets its number and goes to the sink: the worker's queue, or a map.
 *
 * Nothing here looks at a clock. What changes the map hangs on records and ticks alone, so a kept list of them gives
 * the same rows again (law L7); the only thing a replay must be told besides is which rows the sink had refused. That
 * is why a refused row keeps its number. The second after which the look-ahead is folded is one without a row that was
 * taken, so that a map which takes no more of them (a pause) is complete a second later and then stands. A list that begins in
 * mid-session begins with a snapshot (pipeline_state.c). */
#include "daemon/pipeline.h"

#include <assert.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/pipeline_parts.h"

#define IDLE_NS 1000000000ll /* recorded time without a row after which nothing waits for its look-ahead any more */

/* What decoders find */

static void on_profile(void *ctx, int device, const struct profile *profile)
{
	struct pipeline *p = ctx;

	for (int i = 0; i < p->scanners; i++) {
		struct scanner *scanner = &p->scanner[i];

		if (scanner->device != device)
			continue;
		scanner->arrival[scanner->arrivals % ARRIVALS].t_ns = profile->t_ns;
		scanner->arrival[scanner->arrivals % ARRIVALS].log_ns = p->log_ns;
		scanner->arrivals++;
		sweep_profile(scanner->sweep, profile, p->log_ns);
	}
	if (p->sink.profile)
		p->sink.profile(p->sink.ctx, device, profile);
	if (p->sink.data)
		p->sink.data(p->sink.ctx, device, p->log_ns);
}

static void on_tilt(void *ctx, int device, const struct tilt *tilt)
{
	struct pipeline *p = ctx;

	for (int i = 0; i < p->scanners; i++)
		if (p->scanner[i].tilt_device == device)
			sweep_tilt(p->scanner[i].sweep, tilt);
	if (p->sink.tilt)
		p->sink.tilt(p->sink.ctx, device, tilt);
	if (p->sink.data && p->device[device].driver->role != ROLE_LASER) /* an encoder's ticks came with a profile */
		p->sink.data(p->sink.ctx, device, p->log_ns);
}

static void take_track(struct pipeline *p, int device, const struct pose_track_out *out)
{
	for (int i = 0; i < p->scanners && out->has_pose; i++)
		sweep_pose(p->scanner[i].sweep, &out->pose);
	if (p->sink.pose && out->has_pose)
		p->sink.pose(p->sink.ctx, &out->pose);
	if (out->has_jump) {
		p->jump.seen = true;
		p->jump.device = device;
		p->jump.jump = out->jump;
	}
	if (p->sink.data)
		p->sink.data(p->sink.ctx, device, p->log_ns);
}

static void on_pose(void *ctx, int device, const struct pose *pose)
{
	struct pipeline *p = ctx;
	struct pose_track_out out;

	pose_track_absolute(p->track, pose, &out);
	take_track(p, device, &out);
}

static void on_motion(void *ctx, int device, const struct motion *motion)
{
	struct pipeline *p = ctx;
	struct pose_track_out out;

	pose_track_motion(p->track, motion, &out);
	take_track(p, device, &out);
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	struct pipeline *p = ctx;

	if (p->sink.reply)
		p->sink.reply(p->sink.ctx, device, reply);
}

/* Rows */

static int compare_numbers(const void *a, const void *b)
{
	uint64_t x = *(const uint64_t *)a, y = *(const uint64_t *)b;

	return x < y ? -1 : x > y;
}

static bool skipped(const struct pipeline *p, uint64_t number)
{
	return p->skips > 0 && bsearch(&number, p->skip, p->skips, sizeof(number), compare_numbers) != NULL;
}

static void report_not_applied(struct pipeline *p, uint64_t number, const char *reason)
{
	p->not_applied++;
	if (p->sink.not_applied)
		p->sink.not_applied(p->sink.ctx, number, reason);
}

/* When the profile arrived that a row beginning at `t_ns` is made of: the newest that began no later. */
static int64_t arrival_of(const struct pipeline *p, const struct scanner *scanner, int64_t t_ns)
{
	unsigned known = scanner->arrivals < ARRIVALS ? scanner->arrivals : ARRIVALS;

	for (unsigned back = 1; back <= known; back++) {
		unsigned at = (scanner->arrivals - back) % ARRIVALS;

		if (scanner->arrival[at].t_ns <= t_ns)
			return scanner->arrival[at].log_ns;
	}
	return p->log_ns;
}

static void hand_out(struct pipeline *p, struct scanner *scanner, struct row *row)
{
	uint64_t number = p->next_number++;
	bool begins = row->starts_sweep || scanner->begins;

	row->number = number;
	row->starts_sweep = begins;
	scanner->begins = false;
	p->rows++;
	p->arrival_ns = arrival_of(p, scanner, row->t_ns);
	if (skipped(p, number)) {
		row_destroy(row);
		scanner->begins = begins;
		report_not_applied(p, number, "skipped");
	} else if (!p->sink.row(p->sink.ctx, row)) {
		row_destroy(row);
		scanner->begins = begins;
		report_not_applied(p, number, "queue full");
	} else {
		p->last_row_ns = p->log_ns;
		p->rows_since_flush = true;
	}
}

static void advance_scanner(struct pipeline *p, struct scanner *scanner, bool end)
{
	for (;;) {
		struct row *row = NULL;
		enum sweep_drop drop = SWEEP_DROPS;

		switch (sweep_next(scanner->sweep, p->log_ns, end, &row, &drop)) {
		case SWEEP_WAIT:
			return;
		case SWEEP_ROW:
			hand_out(p, scanner, row);
			break;
		case SWEEP_DROPPED:
			report_not_applied(p, p->next_number++, sweep_drop_name(drop));
			break;
		case SWEEP_NOMEM:
			report_not_applied(p, p->next_number++, "out of memory");
			break;
		}
	}
}

static void flush(struct pipeline *p)
{
	p->rows_since_flush = false;
	p->sink.flush(p->sink.ctx);
}

static void advance(struct pipeline *p, bool end)
{
	for (int i = 0; i < p->scanners; i++)
		advance_scanner(p, &p->scanner[i], end);
	if (p->rows_since_flush && (end || p->log_ns - p->last_row_ns >= IDLE_NS))
		flush(p);
}

/* What the jump in this record means to what comes. */
static void settle_jump(struct pipeline *p)
{
	if (!p->jump.seen)
		return;
	p->jump.seen = false;
	if (p->jump.jump.done == POSE_TRACK_NEW_MAP) {
		for (int i = 0; i < p->scanners; i++)
			sweep_new_map(p->scanner[i].sweep);
		flush(p); /* the old map lacks nothing of what was measured in it */
	}
	if (p->sink.jump)
		p->sink.jump(p->sink.ctx, p->jump.device, &p->jump.jump);
}

/* What the loop calls */

void pipeline_handle(struct pipeline *p, const struct record *record)
{
	const struct record_sink found = {p, on_profile, on_tilt, on_pose, on_reply, on_motion};
	struct device *device;

	assert(record->device >= 0 && record->device < p->config->devices);
	device = &p->device[record->device];
	p->log_ns = record->log_ns;
	device->driver->decode(device->decoder, record, &found);
	advance(p, false);
	settle_jump(p);
}

void pipeline_tick(struct pipeline *p, int64_t log_ns)
{
	p->log_ns = log_ns;
	advance(p, false);
}

/* Only what decoders read from now on is concerned; the tick that follows has the time. */
void pipeline_clock(struct pipeline *p, int64_t ahead_ns)
{
	for (int i = 0; i < p->config->devices; i++)
		if (p->device[i].driver->clock)
			p->device[i].driver->clock(p->device[i].decoder, ahead_ns);
}

void pipeline_end(struct pipeline *p)
{
	advance(p, true);
}

/* Numbers come ascending from a kept list, so the place is almost always the end. A failed allocation forgets the
 * number: the row is then applied, which the caller's comparison of hashes would show. */
void pipeline_skip(struct pipeline *p, uint64_t number)
{
	size_t at = p->skips;

	if (p->skips == p->skips_cap) {
		size_t cap = p->skips_cap ? p->skips_cap * 2 : 64;
		uint64_t *grown = realloc(p->skip, cap * sizeof(*grown));

		if (!grown)
			return;
		p->skip = grown;
		p->skips_cap = cap;
	}
	while (at > 0 && p->skip[at - 1] > number)
		at--;
	memmove(p->skip + at + 1, p->skip + at, (p->skips - at) * sizeof(*p->skip));
	p->skip[at] = number;
	p->skips++;
}

void pipeline_reset(struct pipeline *p)
{
	p->next_number = 0;
	p->skips = 0;
	p->rows_since_flush = false;
}

int64_t pipeline_arrival_ns(const struct pipeline *p)
{
	return p->arrival_ns;
}

/* Life */

static int find_device(const struct config *config, const char *name)
{
	for (int i = 0; i < config->devices; i++)
		if (*name && strcmp(config->device[i].name, name) == 0)
			return i;
	return -1;
}

static bool add_scanner(struct pipeline *p, int device)
{
	struct scanner *scanner = &p->scanner[p->scanners];
	struct sweep_params params;

	config_sweep_params(p->config, device, &params);
	scanner->device = device;
	scanner->tilt_device = find_device(p->config, p->config->device[device].tilt);
	scanner->sweep = sweep_create(&params);
	if (!scanner->sweep)
		return false;
	p->scanners++;
	return true;
}

static struct pose_track *create_track(const struct config *config)
{
	struct pose_track_params params = {0};

	for (int i = 0; i < config->devices; i++) {
		const struct config_device *device = &config->device[i];
		const enum device_role role = driver_find(device->driver)->role;

		if (role == ROLE_MOTION) {
			params.motion = true;
			params.drift = device->drift;
			params.turn_drift_rad = device->turn_drift_rad_m;
		} else if (role == ROLE_POSE && !device->fixed) {
			params.absolute = true;
			params.jump_m = device->jump_m;
			params.jump_rad = device->jump_rad;
			params.on_jump = device->on_jump == JUMP_IGNORE    ? POSE_TRACK_IGNORE
			                 : device->on_jump == JUMP_NEW_MAP ? POSE_TRACK_NEW_MAP
			                                                   : POSE_TRACK_KEEP;
		}
	}
	return pose_track_create(&params);
}

struct pipeline *pipeline_create(const struct config *config, const struct pipeline_sink *sink)
{
	struct pipeline *p = calloc(1, sizeof(*p));

	assert(sink->row && sink->flush);
	if (!p)
		return NULL;
	p->config = config;
	p->sink = *sink;
	for (int i = 0; i < config->devices; i++) {
		struct device *device = &p->device[i];

		device->driver = driver_find(config->device[i].driver);
		assert(device->driver); /* config_read knows the drivers */
		device->decoder = device->driver->decoder_create(&config->device[i], i);
		if (!device->decoder || (device->driver->role == ROLE_LASER && !add_scanner(p, i))) {
			pipeline_destroy(p);
			return NULL;
		}
	}
	p->track = create_track(config);
	if (p->track)
		return p;
	pipeline_destroy(p);
	return NULL;
}

void pipeline_destroy(struct pipeline *p)
{
	if (!p)
		return;
	for (int i = 0; i < p->scanners; i++)
		sweep_destroy(p->scanner[i].sweep);
	for (int i = 0; i < p->config->devices; i++)
		if (p->device[i].decoder)
			p->device[i].driver->decoder_destroy(p->device[i].decoder);
	pose_track_destroy(p->track);
	free(p->skip);
	free(p);
}

int64_t pipeline_log_ns(const struct pipeline *p)
{
	return p->log_ns;
}

void pipeline_stats(const struct pipeline *p, struct pipeline_stats *ret)
{
	memset(ret, 0, sizeof(*ret));
	ret->rows = p->rows;
	ret->not_applied = p->not_applied;
	ret->looks_ahead = p->rows_since_flush;
	for (int i = 0; i < p->scanners; i++) {
		struct sweep_stats one;

		sweep_stats(p->scanner[i].sweep, &one);
		ret->sweep.profiles += one.profiles;
		ret->sweep.rows += one.rows;
		ret->sweep.sweeps += one.sweeps;
		for (int k = 0; k < SWEEP_DROPS; k++)
			ret->sweep.dropped[k] += one.dropped[k];
		for (int k = 0; k < BEAM_STATES; k++)
			ret->sweep.beams[k] += one.beams[k];
	}
}

void pipeline_track(const struct pipeline *p, int device, struct pose_track_status *ret)
{
	const enum device_role role = p->device[device].driver->role;

	memset(ret, 0, sizeof(*ret));
	if ((role == ROLE_POSE && !p->config->device[device].fixed) || role == ROLE_MOTION)
		pose_track_status(p->track, ret);
}

int pipeline_devices(const struct pipeline *p)
{
	return p->config->devices;
}

void pipeline_counters(const struct pipeline *p, int device, struct decoder_counters *ret)
{
	assert(device >= 0 && device < p->config->devices);
	ret->n = 0;
	if (p->device[device].driver->counters)
		p->device[device].driver->counters(p->device[device].decoder, ret);
}

void pipeline_timing(const struct pipeline *p, int device, struct decoder_timing *ret)
{
	assert(device >= 0 && device < p->config->devices);
	memset(ret, 0, sizeof(*ret));
	if (p->device[device].driver->timing)
		p->device[device].driver->timing(p->device[device].decoder, ret);
}

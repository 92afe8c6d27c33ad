/* Law L7: the rows are a function of the records, ticks and refused numbers alone, so that a kept list gives them again;
 * rows are numbered over all scanners; a second of recorded time without a row folds what waits. */
#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cmocka.h>

#include "core/model.h"
#include "daemon/journal.h"
#include "daemon/pipeline.h"
#include "tests/scarce.h"

#define MS 1000000ll

/* Devices of the test: one byte says what it is, eight the time, eight a number. */
struct decoder {
	int device;
	uint64_t seen;
	int64_t ahead_ns;
};

static struct decoder *fake_create(const struct config_device *config, int device)
{
	struct decoder *decoder = calloc(1, sizeof(*decoder));

	(void)config;
	decoder->device = device;
	return decoder;
}

static void fake_destroy(struct decoder *decoder)
{
	free(decoder);
}

static void fake_decode(struct decoder *decoder, const struct record *record, const struct record_sink *sink)
{
	static struct profile profile;
	struct tilt tilt;
	struct pose pose = {.rotation = {1, 0, 0, 0}};
	struct reply reply = {.t_ns = record->t_ns, .kind = 42};
	int64_t t_ns;
	double value;

	if (record->direction == TO_DEVICE || record->len != 17)
		return;
	decoder->seen++;
	memcpy(&t_ns, record->bytes + 1, 8);
	memcpy(&value, record->bytes + 9, 8);
	switch (record->bytes[0]) {
	case 'L':
		profile =
		    (struct profile){.t_ns = t_ns, .beam_ns = 30000, .turn_ns = 13333333, .interlace = 1, .parts = 1};
		profile.n = 5;
		profile.first_rad = -0.2;
		profile.step_rad = 0.1;
		for (int i = 0; i < 5; i++)
			profile.range_m[i] = (float)(value + 0.01 * i);
		sink->profile(sink->ctx, decoder->device, &profile);
		break;
	case 'T':
		tilt = (struct tilt){t_ns, value};
		sink->tilt(sink->ctx, decoder->device, &tilt);
		break;
	case 'P':
		pose.t_ns = t_ns - decoder->ahead_ns;
		pose.position_m.x = value;
		sink->pose(sink->ctx, decoder->device, &pose);
		break;
	case 'R':
		sink->reply(sink->ctx, decoder->device, &reply);
		break;
	}
}

static void fake_clock(struct decoder *decoder, int64_t ahead_ns)
{
	decoder->ahead_ns = ahead_ns;
}

static void fake_state(struct decoder *decoder, struct state *s)
{
	struct decoder aside = *decoder;

	state_tag(s, "fake1");
	state_u64(s, &aside.seen);
	state_time(s, &aside.ahead_ns);
	*decoder = s->failed ? (struct decoder){.device = decoder->device} : aside;
}

static void fake_counters(const struct decoder *decoder, struct decoder_counters *ret)
{
	ret->n = 1;
	ret->counter[0].name = "seen";
	ret->counter[0].count = decoder->seen;
}

static const struct driver fakes[] = {
    {.name = "laser",
     .role = ROLE_LASER,
     .decoder_create = fake_create,
     .decoder_destroy = fake_destroy,
     .decode = fake_decode,
     .state = fake_state,
     .counters = fake_counters},
    {.name = "tilt",
     .role = ROLE_TILT,
     .decoder_create = fake_create,
     .decoder_destroy = fake_destroy,
     .decode = fake_decode,
     .state = fake_state,
     .counters = fake_counters},
    {.name = "pose",
     .role = ROLE_POSE,
     .decoder_create = fake_create,
     .decoder_destroy = fake_destroy,
     .decode = fake_decode,
     .state = fake_state,
     .counters = fake_counters,
     .clock = fake_clock},
};

const struct driver *const driver_table[] = {&fakes[0], &fakes[1], &fakes[2], NULL};

const struct driver *driver_find(const char *name)
{
	for (int i = 0; driver_table[i]; i++)
		if (strcmp(driver_table[i]->name, name) == 0)
			return driver_table[i];
	return NULL;
}

enum { LASER_A, LASER_B, TILT_A, TILT_B, POSE };

static struct config config;

static void add_device(const char *name, const char *driver, const char *tilt)
{
	struct config_device *device = &config.device[config.devices++];

	memset(device, 0, sizeof(*device));
	snprintf(device->name, sizeof(device->name), "%s", name);
	snprintf(device->driver, sizeof(device->driver), "%s", driver);
	snprintf(device->tilt, sizeof(device->tilt), "%s", tilt);
	device->range_max_m = 100;
}

static int set_up(void **state)
{
	(void)state;
	config_default(&config);
	config.devices = 0;
	add_device("a", "laser", "ta");
	add_device("b", "laser", "tb");
	add_device("ta", "tilt", "");
	add_device("tb", "tilt", "");
	add_device("pose", "pose", "");
	return 0;
}

/* What came out, in words: one line an event. */
struct outcome {
	struct pipeline *pipeline;
	struct journal_sink journal; /* empty: nothing is kept */
	struct buffer text;
	int refuse_from, refuse_to, rows, replies, datas; /* rows refused by their place in the list of all rows */
	int64_t arrival_ns;
	size_t split;     /* of the text, where the second list began */
	int64_t ahead_ns; /* the wall clock, by which poses are dated */
};

static bool on_row(void *ctx, struct row *row)
{
	struct outcome *o = ctx;
	int place = o->rows++;

	o->arrival_ns = pipeline_arrival_ns(o->pipeline);
	if (place >= o->refuse_from && place < o->refuse_to)
		return false;
	buffer_printf(&o->text, "row %llu raster %u%s t %lld", (unsigned long long)row->number, row->raster,
	              row->starts_sweep ? " starts" : "", (long long)row->t_ns);
	for (uint32_t i = 0; i < row->n; i++)
		buffer_printf(&o->text, " %.17g,%.17g,%.17g", row->beam[i].point.x, row->beam[i].point.y,
		              row->beam[i].point.z);
	buffer_printf(&o->text, "\n");
	row_destroy(row);
	return true;
}

static void on_not_applied(void *ctx, uint64_t number, const char *reason)
{
	struct outcome *o = ctx;

	if (o->journal.not_applied)
		o->journal.not_applied(o->journal.ctx, number);
	assert_true(strlen(reason) > 0);
}

static void on_flush(void *ctx)
{
	buffer_printf(&((struct outcome *)ctx)->text, "flush\n");
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	((struct outcome *)ctx)->replies += device == LASER_B && reply->kind == 42;
}

static void on_data(void *ctx, int device, int64_t t_ns)
{
	(void)device;
	(void)t_ns;
	((struct outcome *)ctx)->datas++;
}

/* As the daemon does it. */
static void on_jump(void *ctx, int device, const struct pose_jump *jump)
{
	struct outcome *o = ctx;

	assert_int_equal(device, POSE);
	buffer_printf(&o->text, "jump %s%.3f\n", jump->back ? "back " : "", jump->distance_m);
	if (jump->done != POSE_TRACK_NEW_MAP)
		return;
	pipeline_reset(o->pipeline);
	o->split = o->text.len;
	if (o->journal.begin)
		assert_int_equal(journal_begin(&o->journal, o->pipeline), 0);
}

static void open_outcome(struct outcome *o)
{
	struct pipeline_sink sink = {.ctx = o,
	                             .row = on_row,
	                             .not_applied = on_not_applied,
	                             .flush = on_flush,
	                             .reply = on_reply,
	                             .data = on_data,
	                             .jump = on_jump};

	memset(o, 0, sizeof(*o));
	o->pipeline = pipeline_create(&config, &sink);
	assert_non_null(o->pipeline);
}

static void close_outcome(struct outcome *o)
{
	pipeline_destroy(o->pipeline);
	buffer_finish(&o->text);
}

static void give(struct outcome *o, int device, char kind, int64_t log_ns, int64_t t_ns, double value)
{
	uint8_t bytes[17];
	struct record record = {
	    .log_ns = log_ns, .t_ns = log_ns, .device = device, .bytes = bytes, .len = sizeof(bytes)};

	bytes[0] = (uint8_t)kind;
	memcpy(bytes + 1, &t_ns, 8);
	memcpy(bytes + 9, &value, 8);
	if (o->journal.record)
		o->journal.record(o->journal.ctx, &record);
	pipeline_handle(o->pipeline, &record);
}

static void tick(struct outcome *o, int64_t log_ns)
{
	if (o->journal.tick)
		o->journal.tick(o->journal.ctx, log_ns);
	pipeline_tick(o->pipeline, log_ns);
}

static void set_clock(struct outcome *o, int64_t ahead_ns)
{
	o->ahead_ns = ahead_ns;
	if (o->journal.clock)
		o->journal.clock(o->journal.ctx, ahead_ns);
	pipeline_clock(o->pipeline, ahead_ns);
}

/* `n` turns of both lasers from t_ns on, with angles and poses around them. */
static void play(struct outcome *o, int64_t t_ns, int n)
{
	for (int i = 0; i < n; i++, t_ns += 13 * MS) {
		give(o, POSE, 'P', t_ns, t_ns + o->ahead_ns, 0.01 * i);
		give(o, TILT_A, 'T', t_ns, t_ns, 0.001 * i);
		give(o, TILT_B, 'T', t_ns, t_ns, -0.001 * i);
		give(o, LASER_A, 'L', t_ns + 3 * MS, t_ns, 2 + 0.1 * i);
		give(o, LASER_B, 'L', t_ns + 4 * MS, t_ns + MS, 3 + 0.1 * i);
	}
	give(o, POSE, 'P', t_ns, t_ns + o->ahead_ns, 0.01 * n);
	give(o, TILT_A, 'T', t_ns, t_ns, 0.001 * n);
	give(o, TILT_B, 'T', t_ns, t_ns, -0.001 * n);
}

static int count(const struct outcome *o, const char *word)
{
	int n = 0;
	const char *at = o->text.data ? (const char *)o->text.data : "";

	for (; (at = strstr(at, word)) != NULL; at++)
		n++;
	return n;
}

static void terminate(struct outcome *o)
{
	buffer_append(&o->text, "", 1);
	o->text.len--;
}

static void rows_are_numbered_over_all_scanners(void **state)
{
	struct outcome o;
	char begin[32];
	const char *at;

	(void)state;
	open_outcome(&o);
	play(&o, 1000 * MS, 10);
	terminate(&o);
	assert_int_equal(o.rows, 20);
	at = (const char *)o.text.data;
	for (int i = 0; i < 20; i++) {
		int n = snprintf(begin, sizeof(begin), "row %d raster ", i);

		assert_memory_equal(at, begin, (size_t)n);
		at = strchr(at, '\n') + 1;
	}
	assert_int_equal(count(&o, "raster 0"), 10);
	assert_int_equal(count(&o, "raster 1"), 10);
	assert_int_equal(o.datas, 53);
	close_outcome(&o);
}

/* The first rows of both scanners are not applied: by the sink's refusal, or told beforehand. */
static void the_beginning_of_a_sweep_outlives_the_row_that_carried_it(void **state)
{
	struct outcome live, again;

	(void)state;
	open_outcome(&live);
	live.refuse_to = 5;
	play(&live, 1000 * MS, 10);
	terminate(&live);
	assert_int_equal(count(&live, "row "), 15);
	assert_int_equal(count(&live, "starts"), 2);
	assert_int_equal(count(&live, "row 5 raster 1 starts"), 1);
	assert_int_equal(count(&live, "row 6 raster 0 starts"), 1);
	open_outcome(&again);
	for (uint64_t number = 0; number < 5; number++)
		pipeline_skip(again.pipeline, number);
	play(&again, 1000 * MS, 10);
	terminate(&again);
	assert_string_equal((char *)live.text.data, (char *)again.text.data);
	close_outcome(&live);
	close_outcome(&again);
}

/* A turn of both lasers that waits for later samples. */
static void begin_turn(struct outcome *o)
{
	give(o, POSE, 'P', 1000 * MS, 1000 * MS, 0);
	give(o, TILT_A, 'T', 990 * MS, 990 * MS, 0);
	give(o, TILT_B, 'T', 990 * MS, 990 * MS, 0);
	give(o, TILT_A, 'T', 1000 * MS, 1000 * MS, 0);
	give(o, TILT_B, 'T', 1000 * MS, 1000 * MS, 0);
	give(o, LASER_A, 'L', 1003 * MS, 1000 * MS, 2);
	give(o, LASER_B, 'L', 1004 * MS, 1000 * MS, 3);
}

static void a_row_lost_to_want_of_memory_costs_one_number_and_a_replay_keeps_step(void **state)
{
	struct outcome live, again;
	struct pipeline_stats stats;

	(void)state;
	if (!SCARCE_WORKS)
		skip();
	open_outcome(&live);
	begin_turn(&live);
	scarce_left = 0;
	pipeline_end(live.pipeline);
	assert_int_equal(scarce_left, -1);
	play(&live, 1500 * MS, 5);
	terminate(&live);
	pipeline_stats(live.pipeline, &stats);
	assert_int_equal(stats.not_applied, 1);
	assert_int_equal(count(&live, "row "), 11);
	open_outcome(&again);
	pipeline_skip(again.pipeline, 0);
	begin_turn(&again);
	pipeline_end(again.pipeline);
	play(&again, 1500 * MS, 5);
	terminate(&again);
	assert_string_equal((char *)live.text.data, (char *)again.text.data);
	close_outcome(&live);
	close_outcome(&again);
}

static void an_angle_reaches_only_the_scanner_on_that_servo(void **state)
{
	struct outcome o;
	struct pipeline_stats stats;

	(void)state;
	open_outcome(&o);
	for (int i = 0; i < 20; i++) {
		give(&o, POSE, 'P', i * 10 * MS, i * 10 * MS, 0);
		give(&o, TILT_B, 'T', i * 10 * MS, i * 10 * MS, 0);
	}
	give(&o, LASER_A, 'L', 190 * MS, 100 * MS, 2);
	give(&o, LASER_B, 'L', 190 * MS, 100 * MS, 2);
	tick(&o, 300 * MS);
	terminate(&o);
	assert_int_equal(count(&o, "row "), 1);
	assert_int_equal(count(&o, "raster 1"), 1);
	pipeline_stats(o.pipeline, &stats);
	assert_int_equal(stats.rows, 1);
	assert_int_equal(stats.not_applied, 1);
	assert_int_equal(stats.sweep.dropped[SWEEP_NO_TILT] + stats.sweep.dropped[SWEEP_STALE_TILT], 1);
	close_outcome(&o);
}

static void a_second_without_a_row_flushes_once(void **state)
{
	struct outcome o;

	(void)state;
	open_outcome(&o);
	tick(&o, 0);
	tick(&o, 5000 * MS);
	terminate(&o);
	assert_int_equal(count(&o, "flush"), 0); /* nothing waits */
	play(&o, 6000 * MS, 2);
	tick(&o, 7025 * MS);
	terminate(&o);
	assert_int_equal(count(&o, "flush"), 0);
	tick(&o, 7027 * MS);
	tick(&o, 9000 * MS);
	terminate(&o);
	assert_int_equal(count(&o, "flush"), 1);
	play(&o, 10000 * MS, 2);
	pipeline_end(o.pipeline);
	pipeline_end(o.pipeline);
	terminate(&o);
	assert_int_equal(count(&o, "flush"), 2);
	close_outcome(&o);
}

/* A map that takes no more rows is complete a second later, although the scanner goes on. */
static void rows_that_are_refused_do_not_put_the_flush_off(void **state)
{
	struct pipeline_stats stats;
	struct outcome o;

	(void)state;
	open_outcome(&o);
	play(&o, 6000 * MS, 2);
	pipeline_stats(o.pipeline, &stats);
	assert_true(stats.looks_ahead);
	o.refuse_from = o.rows;
	o.refuse_to = 1000;
	play(&o, 6500 * MS, 2);
	tick(&o, 7025 * MS);
	terminate(&o);
	assert_int_equal(count(&o, "flush"), 0);
	tick(&o, 7027 * MS);
	play(&o, 8500 * MS, 2);
	tick(&o, 9600 * MS);
	terminate(&o);
	assert_int_equal(count(&o, "flush"), 1);
	pipeline_stats(o.pipeline, &stats);
	assert_false(stats.looks_ahead);
	close_outcome(&o);
}

static void latency_counts_from_the_last_byte_of_the_rows_own_profile(void **state)
{
	struct outcome o;

	(void)state;
	open_outcome(&o);
	give(&o, POSE, 'P', 0, 0, 0);
	give(&o, TILT_A, 'T', 0, 0, 0);
	give(&o, LASER_A, 'L', 17 * MS, 5 * MS, 2);
	give(&o, LASER_A, 'L', 19 * MS, 18 * MS, 2);
	give(&o, TILT_A, 'T', 20 * MS, 10 * MS, 0);
	give(&o, POSE, 'P', 21 * MS, 10 * MS, 0);
	assert_int_equal(o.rows, 1);
	assert_int_equal(o.arrival_ns, 17 * MS);
	close_outcome(&o);
}

static void replies_and_counters_are_those_of_their_device(void **state)
{
	struct outcome o;
	struct decoder_counters counters;

	(void)state;
	open_outcome(&o);
	give(&o, LASER_B, 'R', 0, 0, 0);
	assert_int_equal(o.replies, 1);
	pipeline_counters(o.pipeline, LASER_B, &counters);
	assert_int_equal(counters.counter[0].count, 1);
	pipeline_counters(o.pipeline, LASER_A, &counters);
	assert_int_equal(counters.counter[0].count, 0);
	close_outcome(&o);
}

static void make_path(char path[64])
{
	int fd;

	snprintf(path, 64, "/tmp/facet-journal-XXXXXX");
	fd = mkstemp(path);
	assert_true(fd >= 0);
	close(fd);
}

static void begin_list(struct outcome *o)
{
	assert_int_equal(journal_begin(&o->journal, o->pipeline), 0);
}

/* A live run that refuses rows and begins a new map in mid-session: in the middle of a turn, while profiles wait. */
static void live_run(const char *path, struct outcome *o)
{
	char error[160] = "";
	struct journal *journal = journal_create(path, error);

	assert_non_null(journal);
	open_outcome(o);
	journal_sink(journal, &o->journal);
	begin_list(o);
	o->refuse_from = 5;
	o->refuse_to = 12;
	play(o, 1000 * MS, 20);
	tick(o, 3000 * MS);
	play(o, 3500 * MS, 10);
	give(o, LASER_A, 'L', 3633 * MS, 3631 * MS, 2);
	give(o, LASER_B, 'L', 3634 * MS, 3632 * MS, 3);
	pipeline_reset(o->pipeline);
	begin_list(o);
	o->split = o->text.len;
	o->refuse_from = 65;
	o->refuse_to = 66;
	play(o, 3643 * MS, 10);
	tick(o, 5000 * MS);
	assert_int_equal(journal_error(journal), 0);
	journal_destroy(journal);
	terminate(o);
}

static void second_list(const char *path, char ret[70])
{
	snprintf(ret, 70, "%s.2", path);
}

static void expect_fed(const char *path, const uint8_t *text, size_t len)
{
	struct outcome again;
	char error[160] = "";

	open_outcome(&again);
	if (journal_feed(path, again.pipeline, error) < 0)
		fail_msg("%s", error);
	assert_int_equal(again.text.len, len);
	assert_memory_equal(again.text.data, text, len);
	close_outcome(&again);
}

static void a_kept_list_gives_the_same_rows_again_also_from_mid_session_on(void **state)
{
	struct outcome live;
	char path[64], second[70];

	(void)state;
	make_path(path);
	second_list(path, second);
	live_run(path, &live);
	assert_int_equal(count(&live, "row "), 40 + 20 - 7 + 2 + 20 - 1);
	assert_int_equal(count(&live, "row 0 "), 2);
	assert_int_equal(count(&live, "flush"), 2);
	for (int round = 0; round < 2; round++) {
		expect_fed(path, live.text.data, live.split);
		expect_fed(second, live.text.data + live.split, live.text.len - live.split);
	}
	unlink(path);
	unlink(second);
	close_outcome(&live);
}

static size_t save_pipeline(struct pipeline *pipeline, uint8_t *bytes, size_t cap)
{
	char error[160] = "";
	struct state s;

	state_save(&s, bytes, cap);
	pipeline_state(pipeline, &s, error);
	assert_string_equal(error, "");
	return s.at;
}

/* The second list begins where the first one ends: its snapshot is what a replay of the first comes to, byte for byte. */
static void a_snapshot_is_the_state_that_a_replay_comes_to(void **state)
{
	static uint8_t kept[1 << 20], fed[1 << 20];
	struct outcome live, again;
	char path[64], second[70], error[160] = "";
	size_t len, kept_len;
	FILE *file;

	(void)state;
	make_path(path);
	second_list(path, second);
	live_run(path, &live);
	file = fopen(second, "r");
	kept_len = fread(kept, 1, sizeof(kept), file);
	fclose(file);
	open_outcome(&again);
	assert_int_equal(journal_feed(path, again.pipeline, error), 0);
	pipeline_reset(again.pipeline);
	len = save_pipeline(again.pipeline, fed, sizeof(fed));
	assert_in_range(len, 1000, kept_len - 13);
	assert_memory_equal(kept + 8 + 1 + 4, fed, len);
	close_outcome(&again);
	unlink(path);
	unlink(second);
	close_outcome(&live);
}

static void load_is_refused(struct pipeline *pipeline, const uint8_t *bytes, size_t len, const char *words)
{
	char error[160] = "";
	struct state s;

	state_load(&s, bytes, len);
	pipeline_state(pipeline, &s, error);
	assert_true(s.failed);
	if (!strstr(error, words))
		fail_msg("'%s' does not say '%s'", error, words);
}

static void a_refused_snapshot_leaves_the_pipeline_as_new(void **state)
{
	static uint8_t bytes[1 << 20], empty[1 << 20], after[1 << 20];
	struct outcome live, fresh;
	size_t len, empty_len;

	(void)state;
	open_outcome(&live);
	play(&live, 1000 * MS, 20);
	give(&live, LASER_A, 'L', 1300 * MS, 1300 * MS, 2);
	len = save_pipeline(live.pipeline, bytes, sizeof(bytes));
	open_outcome(&fresh);
	empty_len = save_pipeline(fresh.pipeline, empty, sizeof(empty));
	assert_true(empty_len < len);
	for (size_t cut = 0; cut < len; cut += cut < 400 ? 1 : 13) {
		load_is_refused(fresh.pipeline, bytes, cut, "damaged");
		assert_int_equal(save_pipeline(fresh.pipeline, after, sizeof(after)), empty_len);
		assert_memory_equal(after, empty, empty_len);
	}
	load_is_refused(fresh.pipeline, bytes, len + 1, "damaged");
	assert_int_equal(save_pipeline(fresh.pipeline, after, sizeof(after)), empty_len);
	close_outcome(&fresh);
	close_outcome(&live);
}

static void a_snapshot_of_other_devices_is_refused_by_their_names(void **state)
{
	static uint8_t bytes[1 << 20];
	struct outcome live, other;
	struct config kept = config;
	size_t len;

	(void)state;
	open_outcome(&live);
	play(&live, 1000 * MS, 5);
	len = save_pipeline(live.pipeline, bytes, sizeof(bytes));
	close_outcome(&live);
	strcpy(config.device[LASER_B].name, "front");
	open_outcome(&other);
	load_is_refused(other.pipeline, bytes, len,
	                "kept with a device `b` (laser) where the configuration has `front`");
	close_outcome(&other);
	config = kept;
	config.devices--;
	open_outcome(&other);
	load_is_refused(other.pipeline, bytes, len, "kept with 5 devices, the configuration has 4");
	close_outcome(&other);
	config = kept;
}

/* Three drives, the wall clock set before the second and the third. */
static void drive_through_steps(struct outcome *o, const int64_t ahead_ns[3])
{
	for (int i = 0; i < 3; i++) {
		if (o->ahead_ns != ahead_ns[i])
			set_clock(o, ahead_ns[i]);
		play(o, (1000 + 1000 * i) * MS, 10);
		tick(o, (1900 + 1000 * i) * MS);
	}
	terminate(o);
}

static void a_step_of_the_wall_clock_changes_no_row_live_or_kept(void **state)
{
	static const int64_t none[3] = {0}, steps[3] = {0, 3600000 * MS, -5 * MS};
	struct outcome steady, live, again;
	char path[64], error[160] = "";
	struct journal *journal;

	(void)state;
	make_path(path);
	open_outcome(&steady);
	drive_through_steps(&steady, none);
	assert_int_equal(count(&steady, "row "), 60);
	open_outcome(&live);
	journal = journal_create(path, error);
	assert_non_null(journal);
	journal_sink(journal, &live.journal);
	begin_list(&live);
	drive_through_steps(&live, steps);
	journal_destroy(journal);
	assert_string_equal((char *)steady.text.data, (char *)live.text.data);
	open_outcome(&again);
	assert_int_equal(journal_feed(path, again.pipeline, error), 0);
	terminate(&again);
	assert_string_equal((char *)live.text.data, (char *)again.text.data);
	unlink(path);
	close_outcome(&again);
	close_outcome(&live);
	close_outcome(&steady);
}

static void a_list_cut_anywhere_is_fed_up_to_its_last_whole_entry(void **state)
{
	struct outcome live, again;
	char path[64], second[70], error[160] = "";
	struct stat st;

	(void)state;
	make_path(path);
	second_list(path, second);
	live_run(path, &live);
	assert_int_equal(stat(second, &st), 0);
	for (long cut = st.st_size; cut >= 8; cut -= 31) {
		assert_int_equal(truncate(second, cut), 0);
		open_outcome(&again);
		assert_int_equal(journal_feed(second, again.pipeline, error), 0);
		/* Rows refused at the very end may come to light again; what is whole is the same. */
		assert_true(again.text.len <= live.text.len - live.split + 4000);
		close_outcome(&again);
	}
	assert_int_equal(truncate(second, 7), 0);
	open_outcome(&again);
	assert_int_equal(journal_feed(second, again.pipeline, error), -EINVAL);
	assert_non_null(strstr(error, second));
	close_outcome(&again);
	unlink(second);
	assert_int_equal(journal_feed(second, live.pipeline, error), -ENOENT);
	unlink(path);
	close_outcome(&live);
}

static void patch_file(const char *path, long at, const void *bytes, size_t len, struct outcome *ret_fed,
                       const char *words)
{
	uint8_t before[16];
	char error[160] = "";
	FILE *file = fopen(path, "r+");

	fseek(file, at, SEEK_SET);
	assert_int_equal(fread(before, 1, len, file), len);
	fseek(file, at, SEEK_SET);
	fwrite(bytes, 1, len, file);
	fflush(file);
	open_outcome(ret_fed);
	assert_int_equal(journal_feed(path, ret_fed->pipeline, error), -EINVAL);
	assert_non_null(strstr(error, path));
	if (!strstr(error, words))
		fail_msg("'%s' does not say '%s'", error, words);
	close_outcome(ret_fed);
	fseek(file, at, SEEK_SET);
	fwrite(before, 1, len, file);
	fclose(file);
}

static void a_damaged_list_is_refused_with_a_sentence(void **state)
{
	struct outcome live, fed;
	char path[64], second[70];
	uint32_t snapshot = 0;
	int64_t late_ns = INT64_MAX, early_ns = 5;
	FILE *file;
	long record;

	(void)state;
	make_path(path);
	second_list(path, second);
	live_run(path, &live);
	file = fopen(path, "r");
	fseek(file, 9, SEEK_SET);
	assert_int_equal(fread(&snapshot, 4, 1, file), 1);
	fclose(file);
	record = 8 + 5 + (long)snapshot;
	patch_file(path, 0, "FACETJ1\n", 8, &fed, "older facetd");
	patch_file(path, 0, "#!/bin/s", 8, &fed, "no journal");
	patch_file(path, 8, "\2", 1, &fed, "damaged");
	patch_file(path, 8 + 5, "pipeline9", 9, &fed, "another version");
	patch_file(path, record, "\x7f", 1, &fed, "unknown entry");
	patch_file(path, record, "\0", 1, &fed, "unknown entry");
	patch_file(path, record + 1 + 16, "\x63", 1, &fed, "not there"); /* the device */
	patch_file(path, record + 1 + 17, "\3", 1, &fed, "not there");   /* the direction */
	patch_file(path, record + 1, &late_ns, 8, &fed, "backwards");
	patch_file(path, record + 22 + 17 + 2, &early_ns, 8, &fed, "backwards"); /* of the record after it */
	unlink(path);
	unlink(second);
	close_outcome(&live);
}

/* A drive at 77 Hz and 0.77 m/s whose map is moved by 3 m with pose `at`, as `play`. */
static void play_jump(struct outcome *o, int64_t t_ns, int n, int at)
{
	for (int i = 0; i < n; i++, t_ns += 13 * MS) {
		give(o, POSE, 'P', t_ns, t_ns, 0.01 * i + (i >= at ? 3 : 0));
		give(o, TILT_A, 'T', t_ns, t_ns, 0.001 * i);
		give(o, LASER_A, 'L', t_ns + 3 * MS, t_ns + 12 * MS, 2 + 0.1 * i); /* across the next pose */
	}
}

static void order_jumps(int on_jump)
{
	config.device[POSE].jump_m = 0.3;
	config.device[POSE].jump_rad = 0.1;
	config.device[POSE].on_jump = on_jump;
}

static void a_jump_is_told_once_and_done_as_ordered(void **state)
{
	static const int modes[] = {JUMP_KEEP, JUMP_IGNORE, JUMP_NEW_MAP};
	struct pose_track_status status;
	struct outcome o;

	(void)state;
	for (int m = 0; m < 3; m++) {
		order_jumps(modes[m]);
		open_outcome(&o);
		play_jump(&o, 1000 * MS, 40, 20);
		terminate(&o);
		assert_int_equal(count(&o, "jump 3.0"), 1);
		assert_int_equal(count(&o, "jump"), 1);
		/* Where the raster is cut, and whether numbers begin anew. */
		assert_int_equal(count(&o, " starts"), modes[m] == JUMP_IGNORE ? 1 : 2);
		assert_int_equal(count(&o, "row 1 "), modes[m] == JUMP_NEW_MAP ? 2 : 1);
		assert_int_equal(count(&o, "flush"), modes[m] == JUMP_NEW_MAP);
		pipeline_track(o.pipeline, POSE, &status);
		assert_int_equal(status.jumps, 1);
		pipeline_track(o.pipeline, LASER_A, &status);
		assert_false(status.known);
		close_outcome(&o);
	}
}

/* The row that was measured across the jump belongs to neither map, and has a number in the new one. */
static void rows_of_the_old_map_end_with_the_record_that_jumped(void **state)
{
	struct pipeline_stats stats;
	struct outcome o;
	const char *old, *new;

	(void)state;
	order_jumps(JUMP_NEW_MAP);
	open_outcome(&o);
	play_jump(&o, 1000 * MS, 40, 20);
	terminate(&o);
	old = strstr((char *)o.text.data, "row 18 raster 0 t 1246000000"); /* complete with the pose that jumped */
	new = strstr((char *)o.text.data, "jump 3.0");
	assert_non_null(old);
	assert_true(old < new);
	pipeline_stats(o.pipeline, &stats);
	assert_int_equal(stats.sweep.dropped[SWEEP_BEFORE_JUMP], 1);
	assert_null(strstr(new, "row 0 raster")); /* the number of the row that was dropped */
	assert_non_null(strstr(new, "row 1 raster 0 starts t 1272000000"));
	close_outcome(&o);
}

static void a_map_that_ended_by_a_jump_is_replayed_from_its_own_list(void **state)
{
	char path[64], second[70], error[160] = "";
	struct journal *journal;
	struct outcome live, again;

	(void)state;
	for (int last = 0; last < 2; last++) {
		order_jumps(JUMP_NEW_MAP);
		make_path(path);
		second_list(path, second);
		journal = journal_create(path, error);
		assert_non_null(journal);
		open_outcome(&live);
		journal_sink(journal, &live.journal);
		assert_int_equal(journal_begin(&live.journal, live.pipeline), 0);
		live.refuse_from = 5;
		live.refuse_to = 8;
		play_jump(&live, 1000 * MS, 40, 20);
		journal_destroy(journal);
		terminate(&live);
		open_outcome(&again);
		assert_int_equal(journal_feed(last ? second : path, again.pipeline, error), 0);
		terminate(&again);
		if (last)
			assert_string_equal((char *)again.text.data, (char *)live.text.data + live.split);
		else
			assert_memory_equal(again.text.data, live.text.data, live.split);
		assert_int_equal(again.text.len, last ? live.text.len - live.split : live.split);
		close_outcome(&again);
		close_outcome(&live);
		unlink(path);
		unlink(second);
	}
}

static void a_journal_that_cannot_be_written_says_so(void **state)
{
	char error[160] = "";

	(void)state;
	assert_null(journal_create("/nonexistent/x", error));
	assert_non_null(strstr(error, "/nonexistent/x"));
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(rows_are_numbered_over_all_scanners),
	    cmocka_unit_test(the_beginning_of_a_sweep_outlives_the_row_that_carried_it),
	    cmocka_unit_test(a_row_lost_to_want_of_memory_costs_one_number_and_a_replay_keeps_step),
	    cmocka_unit_test(an_angle_reaches_only_the_scanner_on_that_servo),
	    cmocka_unit_test(a_second_without_a_row_flushes_once),
	    cmocka_unit_test(rows_that_are_refused_do_not_put_the_flush_off),
	    cmocka_unit_test(latency_counts_from_the_last_byte_of_the_rows_own_profile),
	    cmocka_unit_test(replies_and_counters_are_those_of_their_device),
	    cmocka_unit_test(a_kept_list_gives_the_same_rows_again_also_from_mid_session_on),
	    cmocka_unit_test(a_snapshot_is_the_state_that_a_replay_comes_to),
	    cmocka_unit_test(a_refused_snapshot_leaves_the_pipeline_as_new),
	    cmocka_unit_test(a_snapshot_of_other_devices_is_refused_by_their_names),
	    cmocka_unit_test(a_step_of_the_wall_clock_changes_no_row_live_or_kept),
	    cmocka_unit_test(a_list_cut_anywhere_is_fed_up_to_its_last_whole_entry),
	    cmocka_unit_test(a_damaged_list_is_refused_with_a_sentence),
	    cmocka_unit_test_setup(a_jump_is_told_once_and_done_as_ordered, set_up),
	    cmocka_unit_test_setup(rows_of_the_old_map_end_with_the_record_that_jumped, set_up),
	    cmocka_unit_test_setup(a_map_that_ended_by_a_jump_is_replayed_from_its_own_list, set_up),
	    cmocka_unit_test(a_journal_that_cannot_be_written_says_so),
	};

	return cmocka_run_group_tests(tests, set_up, NULL);
}

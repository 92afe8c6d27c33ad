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
     .counters = fake_counters},
    {.name = "tilt",
     .role = ROLE_TILT,
     .decoder_create = fake_create,
     .decoder_destroy = fake_destroy,
     .decode = fake_decode,
     .counters = fake_counters},
    {.name = "pose",
     .role = ROLE_POSE,
     .decoder_create = fake_create,
     .decoder_destroy = fake_destroy,
     .decode = fake_decode,
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

static void on_reset(void *ctx)
{
	buffer_printf(&((struct outcome *)ctx)->text, "reset\n");
}

static void open_outcome(struct outcome *o)
{
	struct pipeline_sink sink = {o, on_row, on_not_applied, on_flush, on_reply, on_data};

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

/* A live run that refuses rows and begins a new map in between. */
static void live_run(const char *path, struct outcome *o)
{
	char error[160] = "";
	struct journal *journal = journal_create(path, error);

	assert_non_null(journal);
	open_outcome(o);
	journal_sink(journal, &o->journal);
	o->refuse_from = 5;
	o->refuse_to = 12;
	play(o, 1000 * MS, 20);
	tick(o, 3000 * MS);
	o->journal.reset(o->journal.ctx);
	pipeline_reset(o->pipeline);
	on_reset(o);
	o->refuse_from = 45;
	o->refuse_to = 46;
	play(o, 4000 * MS, 10);
	tick(o, 5000 * MS);
	assert_int_equal(journal_error(journal), 0);
	journal_destroy(journal);
	terminate(o);
}

static void a_kept_list_gives_the_same_rows_again(void **state)
{
	struct outcome live, again;
	char path[64], error[160] = "";

	(void)state;
	make_path(path);
	live_run(path, &live);
	assert_int_equal(count(&live, "row "), 40 + 20 - 8);
	assert_int_equal(count(&live, "flush"), 1);
	for (int round = 0; round < 2; round++) {
		open_outcome(&again);
		assert_int_equal(journal_feed(path, again.pipeline, on_reset, &again, error), 0);
		terminate(&again);
		assert_string_equal((char *)live.text.data, (char *)again.text.data);
		close_outcome(&again);
	}
	unlink(path);
	close_outcome(&live);
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
	drive_through_steps(&live, steps);
	journal_destroy(journal);
	assert_string_equal((char *)steady.text.data, (char *)live.text.data);
	open_outcome(&again);
	assert_int_equal(journal_feed(path, again.pipeline, NULL, NULL, error), 0);
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
	char path[64], error[160] = "";
	FILE *file;
	long size;

	(void)state;
	make_path(path);
	live_run(path, &live);
	file = fopen(path, "r");
	fseek(file, 0, SEEK_END);
	size = ftell(file);
	fclose(file);
	for (long cut = size; cut >= 8; cut -= 7) {
		assert_int_equal(truncate(path, cut), 0);
		open_outcome(&again);
		assert_int_equal(journal_feed(path, again.pipeline, on_reset, &again, error), 0);
		/* Rows refused at the very end may come to light again; what is whole is the same. */
		assert_true(again.text.len <= live.text.len + 4000);
		close_outcome(&again);
	}
	assert_int_equal(truncate(path, 7), 0);
	open_outcome(&again);
	assert_int_equal(journal_feed(path, again.pipeline, NULL, NULL, error), -EINVAL);
	assert_non_null(strstr(error, path));
	close_outcome(&again);
	unlink(path);
	assert_int_equal(journal_feed(path, live.pipeline, NULL, NULL, error), -ENOENT);
	close_outcome(&live);
}

static void a_list_of_other_devices_is_refused(void **state)
{
	struct outcome o;
	char path[64], error[160] = "";
	FILE *file;

	(void)state;
	make_path(path);
	live_run(path, &o);
	file = fopen(path, "r+");
	fseek(file, 8 + 1 + 16, SEEK_SET);
	fputc(99, file); /* the device of the first record */
	fclose(file);
	assert_int_equal(journal_feed(path, o.pipeline, NULL, NULL, error), -EINVAL);
	unlink(path);
	close_outcome(&o);
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
	    cmocka_unit_test(latency_counts_from_the_last_byte_of_the_rows_own_profile),
	    cmocka_unit_test(replies_and_counters_are_those_of_their_device),
	    cmocka_unit_test(a_kept_list_gives_the_same_rows_again),
	    cmocka_unit_test(a_step_of_the_wall_clock_changes_no_row_live_or_kept),
	    cmocka_unit_test(a_list_cut_anywhere_is_fed_up_to_its_last_whole_entry),
	    cmocka_unit_test(a_list_of_other_devices_is_refused),
	    cmocka_unit_test(a_journal_that_cannot_be_written_says_so),
	};

	return cmocka_run_group_tests(tests, set_up, NULL);
}

/* Law L7 begins here: a recorded sweep gives the same rows at every run, because its playback waits for its reader. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <errno.h>
#include <math.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include "core/trig.h"
#include "daemon/pipeline.h"
#include "daemon/supervisor.h"
#include "tools/playback.h"

#define DEG TRIG_DEG

/* ---- files ---- */

static void a_line_is_a_tilt_and_ranges_and_codes_stay(void **state)
{
	static const char csv[] = "# comment\n-48.7000,101,32759,32763,32765,32767,30000\n12.5,0,1\n";
	struct playback_sweep sweep = {0};
	char error[SCENARIO_ERROR_MAX] = "";

	(void)state;
	assert_int_equal(playback_read_csv(csv, sizeof csv - 1, &sweep, error), 0);
	assert_int_equal(sweep.n, 2);
	assert_true(fabs(sweep.line[0].angle_rad + 48.7 * DEG) < 1e-12);
	assert_int_equal(sweep.line[0].word[0], 101);
	assert_int_equal(sweep.line[0].word[1], 32759);
	assert_int_equal(sweep.line[0].word[5], 30000);
	assert_int_equal(sweep.line[0].word[6], 32767); /* missing beams have no valid value */
	assert_int_equal(sweep.line[0].word[360], 32767);
	assert_int_equal(sweep.line[1].word[1], 1);
	free(sweep.line);
}

static void what_is_no_sweep_is_refused_with_its_line(void **state)
{
	static const struct {
		const char *csv, *says;
	} bad[] = {{"", "no line"},
	           {"# nothing\n", "no line"},
	           {"1,2,3\nx,1,2\n", "line 2: expected a tilt"},
	           {"1,2,3\n\n1,2,-3\n", "line 3: a range"},
	           {"1,2,32768\n", "line 1: a range"},
	           {"1,2,2.5\n", "line 1: a range"},
	           {"1,2,nan\n", "line 1: a range"},
	           {"999,2,3\n", "line 1: expected a tilt"},
	           {"1,2,3,oops\n", "line 1: expected 2 to 361"},
	           {"1\n", "line 1: expected 2 to 361"}};

	(void)state;
	for (size_t i = 0; i < sizeof bad / sizeof *bad; i++) {
		struct playback_sweep sweep = {0};
		char error[SCENARIO_ERROR_MAX] = "";

		assert_int_equal(playback_read_csv(bad[i].csv, strlen(bad[i].csv), &sweep, error), -EINVAL);
		if (!strstr(error, bad[i].says))
			fail_msg("%s: %s", bad[i].csv, error);
		free(sweep.line);
	}
}

static void a_missing_file_or_pose_is_named(void **state)
{
	struct playback_sweeps sweeps;
	char error[SCENARIO_ERROR_MAX] = "";

	(void)state;
	assert_true(playback_load("profiles:/nowhere/x_profiles.csv", NULL, 0, &sweeps, error) < 0);
	assert_non_null(strstr(error, "/nowhere/x_profiles.csv: No such file"));
	assert_true(playback_load("uos:/nowhere", NULL, 0, &sweeps, error) < 0);
	assert_non_null(strstr(error, "/nowhere"));
}

/* ---- pacing ---- */

static struct playback *two_sweeps(void)
{
	static const char *const csv[2] = {"1,1000,2000\n2,1001,2001\n", "-1,1100,2100\n"};
	struct playback_sweeps sweeps = {.n = 2, .lines = 3};
	char error[SCENARIO_ERROR_MAX];

	for (int i = 0; i < 2; i++) {
		assert_int_equal(playback_read_csv(csv[i], strlen(csv[i]), &sweeps.sweep[i], error), 0);
		sweeps.sweep[i].pose = (struct pose){.position_m.x = i, .rotation.w = 1.0};
	}
	return playback_create(&sweeps);
}

static struct profile fan(void)
{
	return (struct profile){.n = 361, .interlace = 2, .first_rad = -90.0 * DEG, .step_rad = 0.5 * DEG};
}

static void a_line_waits_for_answers_on_both_sides_and_a_sweep_for_poses(void **state)
{
	struct playback *p = two_sweeps();
	struct playback_seen seen = {.answers = 10, .poses = 4};
	struct profile profile = fan();

	(void)state;
	assert_false(playback_ready(p, seen));
	playback_placed(p, seen);
	seen.answers += 9;
	assert_false(playback_ready(p, seen)); /* the pose is new, too */
	seen.poses += 3;
	assert_true(playback_ready(p, seen));
	playback_scan(p, &profile);
	assert_int_equal(rint(profile.range_m[1] * 1000.0), 2000);
	assert_false(playback_ready(p, seen)); /* never twice ... */
	playback_lost(p, seen);
	assert_false(playback_ready(p, seen));
	seen.answers += 3;
	seen.poses += 3;
	assert_true(playback_ready(p, seen)); /* ... unless its reader could not read it: then it is measured again */
	playback_scan(p, &profile);
	assert_int_equal(rint(profile.range_m[1] * 1000.0), 2000);
	seen.answers += 9;
	assert_false(playback_advance(p, seen)); /* not yet taken */
	playback_taken(p, seen);
	seen.answers += 2;
	assert_false(playback_advance(p, seen));
	seen.answers += 1;
	assert_true(playback_advance(p, seen));
	assert_true(fabs(playback_angle(p) - 2.0 * DEG) < 1e-12);
	assert_false(playback_ready(p, seen)); /* not placed yet */
	playback_placed(p, seen);
	seen.answers += 3;
	assert_true(playback_ready(p, seen)); /* the same pose: no datagram is waited for */
	playback_scan(p, &profile);
	assert_int_equal(rint(profile.range_m[1] * 1000.0), 2001);
	playback_taken(p, seen);
	seen.answers += 3;
	assert_false(playback_advance(p, seen)); /* the old pose must be said after the last line */
	assert_true(playback_pose(p).position_m.x == 0.0);
	seen.poses += 3;
	assert_true(playback_advance(p, seen));
	assert_true(playback_pose(p).position_m.x == 1.0);
	playback_placed(p, seen);
	seen.answers += 3;
	assert_false(playback_ready(p, seen));
	seen.poses += 3;
	assert_true(playback_ready(p, seen));
	playback_scan(p, &profile);
	playback_taken(p, seen);
	seen.answers += 3;
	seen.poses += 3;
	assert_false(playback_ended(p));
	assert_false(playback_advance(p, seen));
	assert_true(playback_ended(p));
	assert_int_equal(playback_lines(p), 3);
	assert_true(fabs(playback_angle(p) + 1.0 * DEG) < 1e-12); /* and stands where it was */
	playback_destroy(p);
}

static void error_codes_become_states_and_nothing_else(void **state)
{
	static const char csv[] = "0,32767,32766,32765,32763,32762,32759,32764,32758\n";
	static const uint8_t expected[] = {BEAM_NO_ECHO,       BEAM_DAZZLED,    BEAM_OVERFLOW, BEAM_WEAK,
	                                   BEAM_CHANNEL_ERROR, BEAM_BEYOND_MAX, BEAM_RESERVED, BEAM_OK};
	struct playback_sweeps sweeps = {.n = 1, .lines = 1};
	char error[SCENARIO_ERROR_MAX];
	struct profile profile = fan();
	struct playback *p;

	(void)state;
	assert_int_equal(playback_read_csv(csv, sizeof csv - 1, &sweeps.sweep[0], error), 0);
	p = playback_create(&sweeps);
	playback_scan(p, &profile);
	assert_memory_equal(profile.state, expected, sizeof expected);
	playback_destroy(p);
}

/* ---- through the wire: `facet simulate` in a process of its own, the daemon's parts here ---- */

#define LINES 9

static char dir[64];
static const double tilt_deg[LINES] = {-20.0, -10.517, 0.0,  10.001, 20.25,
                                       30.0,  29.5,    29.0, -5.0}; /* three sweeps of 4, 4, 1 */
static const int sweep_begin[4] = {0, 4, 8, 9};

static int range_mm(int line, int beam)
{
	return beam % 50 == 7 ? 32759 + (beam / 50) % 2 * 4 : 1000 + 100 * line + (beam / 8) % 5;
}

static void write_sweeps(void)
{
	char path[128];

	for (int s = 0; s < 3; s++) {
		FILE *file;

		snprintf(path, sizeof path, "%s/s%d_profiles.csv", dir, s);
		file = fopen(path, "w");
		assert_non_null(file);
		for (int i = sweep_begin[s]; i < sweep_begin[s + 1]; i++) {
			fprintf(file, "%.4f", tilt_deg[i]);
			for (int k = 0; k < 360; k++)
				fprintf(file, ",%d", range_mm(i, k));
			fprintf(file, "\n");
		}
		fclose(file);
		snprintf(path, sizeof path, "%s/s%d.pose", dir, s);
		file = fopen(path, "w");
		assert_non_null(file);
		fprintf(file, "0 0 %d\n0 %d 0\n", 100 * s, 90 * s);
		fclose(file);
	}
}

static int make_dir(void **state)
{
	(void)state;
	strcpy(dir, "/tmp/test_playback.XXXXXX");
	if (!mkdtemp(dir))
		return -1;
	write_sweeps();
	return 0;
}

static int remove_dir(void **state)
{
	char command[128];

	(void)state;
	snprintf(command, sizeof command, "rm -r '%s'", dir);
	return system(command);
}

static pid_t simulate(const char *speed, const char *servo)
{
	const char *build = getenv("FACET_BUILD") ? getenv("FACET_BUILD") : "build";
	char facet[128], source[128], more[2][128];
	pid_t pid;

	snprintf(facet, sizeof facet, "%s/facet", build);
	snprintf(source, sizeof source, "profiles:%s/s0_profiles.csv", dir);
	snprintf(more[0], sizeof more[0], "%s/s1_profiles.csv", dir);
	snprintf(more[1], sizeof more[1], "%s/s2_profiles.csv", dir);
	pid = fork();
	if (pid == 0) {
		execl(facet, facet, "simulate", source, more[0], more[1], "--dir", dir, "--speed", speed, "--servo",
		      servo, NULL);
		_exit(127);
	}
	assert_true(pid > 0);
	return pid;
}

struct reader { /* what facetd does with records, without its sockets */
	struct config config;
	const struct driver *driver[CONFIG_DEVICES_MAX];
	struct supervisor *supervisor;
	struct pipeline *pipeline;
	struct pollfd p[CONFIG_DEVICES_MAX];
	int rows;
	uint64_t not_applied;
};

static int64_t realtime_ns(void)
{
	struct timespec ts;

	clock_gettime(CLOCK_REALTIME, &ts);
	return (int64_t)ts.tv_sec * 1000000000 + ts.tv_nsec;
}

static void on_watch(void *ctx, int device, int fd, bool readable, bool writable)
{
	struct reader *reader = ctx;

	reader->p[device] =
	    (struct pollfd){.fd = fd, .events = (short)((readable ? POLLIN : 0) | (writable ? POLLOUT : 0))};
}

static void on_record(void *ctx, const struct record *record)
{
	pipeline_handle(((struct reader *)ctx)->pipeline, record);
}

static void on_log(void *ctx, int device, int priority, const char *text)
{
	struct reader *reader = ctx;

	(void)priority;
	fprintf(stderr, "%s: %s\n", reader->config.device[device].name, text);
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	supervisor_reply(((struct reader *)ctx)->supervisor, device, reply);
}

static void on_data(void *ctx, int device, int64_t t_ns)
{
	supervisor_data(((struct reader *)ctx)->supervisor, device, t_ns);
}

/* Every row is its line: its tilt, its ranges, its codes, its pose, in order. */
static bool on_row(void *ctx, struct row *row)
{
	struct reader *reader = ctx;
	int i = reader->rows++, sweep = i >= sweep_begin[2] ? 2 : i >= sweep_begin[1] ? 1 : 0;

	assert_true(i < LINES);
	assert_int_equal(row->n, 361);
	assert_true(fabs(row->tilt_rad + tilt_deg[i] * DEG) < 0.0006 * DEG);
	for (int k = 0; k < 360; k++) {
		int mm = range_mm(i, k);

		if (mm >= 32759) {
			assert_int_equal(row->beam[k].state, mm == 32759 ? BEAM_BEYOND_MAX : BEAM_WEAK);
			continue;
		}
		assert_int_equal(row->beam[k].state, BEAM_OK);
		assert_int_equal(rint(row->beam[k].range_m * 1000.0), mm);
		assert_true(fabs(row->beam[k].origin.x - sweep) < 1e-6 && fabs(row->beam[k].origin.z) < 1e-6);
	}
	assert_int_equal(row->beam[360].state, BEAM_NO_ECHO);
	row_destroy(row);
	return true;
}

static void on_not_applied(void *ctx, uint64_t number, const char *reason)
{
	fprintf(stderr, "row %llu not applied: %s\n", (unsigned long long)number, reason);
	((struct reader *)ctx)->not_applied++;
}

static void on_flush(void *ctx)
{
	(void)ctx;
}

static void read_config(struct reader *reader)
{
	static char text[8192];
	struct config_error error = {""};
	char path[128];
	size_t len;
	FILE *file = NULL;

	snprintf(path, sizeof path, "%s/facetd.yaml", dir);
	for (int i = 0; i < 2000 && !file; i++) {
		file = fopen(path, "r");
		usleep(10000);
	}
	assert_non_null(file);
	len = fread(text, 1, sizeof text, file);
	fclose(file);
	config_read(text, len, path, &reader->config, &error);
	assert_string_equal(error.text, "");
}

/* Reads until the simulator ends; answers its exit status. */
static int read_until_end(struct reader *reader, pid_t pid)
{
	int64_t end_ns = realtime_ns() + INT64_C(120000000000);
	int status = -1;

	supervisor_start(reader->supervisor, realtime_ns());
	while (waitpid(pid, &status, WNOHANG) == 0 && realtime_ns() < end_ns) {
		poll(reader->p, (nfds_t)reader->config.devices, 1);
		for (int i = 0; i < reader->config.devices; i++)
			if (reader->p[i].fd >= 0 && reader->p[i].revents)
				supervisor_ready(reader->supervisor, i, reader->p[i].revents & ~POLLOUT,
				                 reader->p[i].revents & POLLOUT, realtime_ns());
		if (supervisor_deadline(reader->supervisor) <= realtime_ns())
			supervisor_timer(reader->supervisor, realtime_ns());
	}
	pipeline_end(reader->pipeline);
	return status;
}

static void play(const char *speed, const char *servo)
{
	struct reader reader = {0};
	struct pipeline_sink sink = {.ctx = &reader,
	                             .row = on_row,
	                             .not_applied = on_not_applied,
	                             .flush = on_flush,
	                             .reply = on_reply,
	                             .data = on_data};
	struct supervisor_host host = {.ctx = &reader, .watch = on_watch, .record = on_record, .log = on_log};
	struct pipeline_stats stats;
	char path[128];
	pid_t pid;

	snprintf(path, sizeof path, "%s/facetd.yaml", dir);
	unlink(path);
	pid = simulate(speed, servo);
	read_config(&reader);
	for (int i = 0; i < CONFIG_DEVICES_MAX; i++)
		reader.p[i].fd = -1;
	for (int i = 0; i < reader.config.devices; i++)
		reader.driver[i] = driver_find(reader.config.device[i].driver);
	reader.pipeline = pipeline_create(&reader.config, &sink);
	reader.supervisor = supervisor_create(&reader.config, reader.driver, &host);
	assert_int_equal(read_until_end(&reader, pid), 0);
	pipeline_stats(reader.pipeline, &stats);
	assert_int_equal(reader.rows, LINES);
	assert_int_equal(reader.not_applied, 0);
	supervisor_destroy(reader.supervisor);
	pipeline_destroy(reader.pipeline);
}

static void every_line_becomes_its_row_once_at_the_pace_of_the_wire(void **state)
{
	(void)state;
	play("1", "rtu");
}

static void every_line_becomes_its_row_once_as_fast_as_it_is_read(void **state)
{
	(void)state;
	play("max", "tcp");
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_line_is_a_tilt_and_ranges_and_codes_stay),
	    cmocka_unit_test(what_is_no_sweep_is_refused_with_its_line),
	    cmocka_unit_test(a_missing_file_or_pose_is_named),
	    cmocka_unit_test(a_line_waits_for_answers_on_both_sides_and_a_sweep_for_poses),
	    cmocka_unit_test(error_codes_become_states_and_nothing_else),
	    cmocka_unit_test(every_line_becomes_its_row_once_at_the_pace_of_the_wire),
	    cmocka_unit_test(every_line_becomes_its_row_once_as_fast_as_it_is_read),
	};

	return cmocka_run_group_tests(tests, make_dir, remove_dir);
}

/* Laws L7, L8: a recording begins with its snapshot in every file, stays within its limits, and whatever the disk or a reader does,
 * the loop is never held and what was written before can be read. */
#include <dirent.h>
#include <pthread.h>
#include <setjmp.h>
#include <signal.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include <cmocka.h>

#include "daemon/recorder.h"
#include "tools/mapped.h"

#define START_NS INT64_C(1700000000000000000)

static struct config config;
static char dir[64];
static int64_t log_ns;
static uint32_t seed;
static pthread_mutex_t gate =
    PTHREAD_MUTEX_INITIALIZER; /* held: the recorder's thread stands in its next call of `ready` */

static void on_ready(void *ctx)
{
	(void)ctx;
	pthread_mutex_lock(&gate);
	pthread_mutex_unlock(&gate);
}

static int set_up(void **state)
{
	(void)state;
	config_default(&config);
	config.devices = 1;
	snprintf(config.device[0].name, sizeof(config.device[0].name), "laser");
	snprintf(config.device[0].driver, sizeof(config.device[0].driver), "lms2xx");
	config.record.chunk_ns = 1000000000;
	strcpy(dir, "/tmp/facet-recorder-XXXXXX");
	log_ns = START_NS;
	seed = 1;
	return mkdtemp(dir) ? 0 : -1;
}

static int tear_down(void **state)
{
	char command[100];

	(void)state;
	snprintf(command, sizeof(command), "rm -rf %.63s", dir);
	return system(command);
}

static struct recorder *create(const char *where)
{
	struct recorder_params params = {
	    .config = &config, .config_text = "devices: []\n", .dir = where, .session = 5, .ready = on_ready};
	struct recorder *r = recorder_create(&params);

	assert_non_null(r);
	return r;
}

/* As the loop does: at a tick what wants to begin does, then the tick. */
static void tick(struct recorder *r)
{
	const struct recording_begin begin = {
	    .log_ns = log_ns, .map_id = "map", .generation = 1, .snapshot = "state", .len = 5};

	log_ns += 100000000;
	if (recorder_wants_begin(r, log_ns))
		recorder_begin(r, &begin);
	recorder_tick(r, log_ns);
}

/* A second of a device that sends `bytes` with each of ten records, which do not compress. */
static void second(struct recorder *r, size_t bytes)
{
	static uint8_t data[1 << 20];

	for (int i = 0; i < 10; i++) {
		struct record record = {log_ns, log_ns, 0, FROM_DEVICE, data, bytes};

		tick(r);
		record.log_ns = record.t_ns = log_ns;
		for (size_t k = 0; k < bytes; k += 4) {
			seed = seed * 1664525u + 1013904223u;
			memcpy(data + k, &seed, 4);
		}
		recorder_record(r, &record);
	}
}

/* Until the thread has done all that it was given. */
static void settle(struct recorder *r)
{
	struct recorder_status status = {.queued = 1};

	for (int i = 0; i < 4000 && status.queued > 0; i++) {
		nanosleep(&(struct timespec){.tv_nsec = 5000000}, NULL);
		if (i % 200 == 199)
			tick(r); /* a record alone wakes nobody */
		recorder_status(r, &status);
	}
	assert_int_equal(status.queued, 0);
	nanosleep(&(struct timespec){.tv_nsec = 50000000}, NULL);
	recorder_status(
	    r, &status); /* under its lock: what it did with a tick, which is not counted, was before what we do next */
}

struct told {
	unsigned records, begins, damages, skips;
	bool ended, whole;
	uint64_t session;
	uint32_t part;
};

static struct told hear(const uint8_t *data, size_t len)
{
	struct recording_reader *r;
	struct recording_event event;
	struct told told = {0};
	char error[160];

	if (recording_reader_create(data, len, &r, error) < 0)
		fail_msg("%s", error);
	recording_reader_use(r, &config);
	while (recording_reader_next(r, &event) == 1) {
		told.records += event.kind == RECORDING_RECORD;
		told.damages += event.kind == RECORDING_DAMAGED;
		told.skips += event.kind == RECORDING_SKIP;
		told.ended |= event.kind == RECORDING_END;
		if (event.kind == RECORDING_BEGIN && told.begins++ == 0) {
			told.session = event.begin.session;
			told.part = event.begin.part;
			assert_memory_equal(event.begin.snapshot, "state", 5);
		}
	}
	told.whole = mcap_reader_whole(recording_reader_mcap(r));
	recording_reader_destroy(r);
	return told;
}

static struct told hear_file(const char *name)
{
	char path[5000], error[400];
	struct mapped file;
	struct told told;

	snprintf(path, sizeof(path), "%s/%s", dir, name);
	assert_int_equal(mapped_open(path, &file, error), 0);
	told = hear(file.data, file.len);
	mapped_close(&file);
	return told;
}

static int by_name(const struct dirent **a, const struct dirent **b)
{
	return strcmp((*a)->d_name, (*b)->d_name);
}

static int is_recording(const struct dirent *entry)
{
	return strstr(entry->d_name, ".mcap") != NULL;
}

/* The recordings there are, by name; their bytes in all. */
static int list(char name[][64], int max, uint64_t *ret_bytes)
{
	struct dirent **entry;
	int n = scandir(dir, &entry, is_recording, by_name);

	*ret_bytes = 0;
	assert_true(n >= 0 && n <= max);
	for (int i = 0; i < n; i++) {
		char path[400];
		struct stat st;

		snprintf(name[i], 64, "%.63s", entry[i]->d_name);
		snprintf(path, sizeof(path), "%s/%s", dir, name[i]);
		assert_int_equal(stat(path, &st), 0);
		*ret_bytes += (uint64_t)st.st_size;
		free(entry[i]);
	}
	free(entry);
	return n;
}

static void files_of_a_rotation_stand_alone_and_join(void **state)
{
	char name[64][64];
	struct recorder *r;
	unsigned records = 0;
	uint64_t bytes;
	int n;

	(void)state;
	config.record.max_size = 100000;
	r = create(dir);
	for (int i = 0; i < 20; i++) {
		second(r, 4000);
		settle(r);
	}
	recorder_destroy(r);
	n = list(name, 64, &bytes);
	assert_true(n >= 5);
	for (int i = 0; i < n; i++) {
		struct told told = hear_file(name[i]);

		assert_true(told.ended && told.whole && told.damages == 0 && told.begins == 1);
		assert_int_equal(told.part, i);
		assert_int_equal(told.session, 6);
		records += told.records;
	}
	assert_int_equal(records, 200);
	printf("note: %d files of %llu bytes in all, limit 100000 each\n", n, (unsigned long long)bytes);
}

static void the_oldest_recordings_go_beyond_keep_and_nothing_else_does(void **state)
{
	char name[64][64], path[128];
	struct recorder *r;
	uint64_t bytes;
	FILE *other;
	int n;

	(void)state;
	snprintf(path, sizeof(path), "%s/precious.mcap", dir);
	other = fopen(path, "w");
	assert_non_null(other);
	fclose(other);
	config.record.max_size = 200000;
	config.record.keep = 1000000;
	r = create(dir);
	for (int i = 0; i < 60; i++) {
		second(r, 8000);
		settle(r);
	}
	recorder_destroy(r);
	n = list(name, 64, &bytes);
	assert_true(n >= 4 && n < 20);
	assert_true(bytes <= config.record.keep + config.record.max_size + 200000);
	assert_string_equal(name[n - 1], "precious.mcap");
	assert_true(hear_file(name[n - 2]).part > 10);
}

static bool expect_notice(struct recorder *r, const char *wanted, struct recorder_notice *ret)
{
	for (int i = 0; i < 12000; i++) {
		while (recorder_notice(r, ret))
			if (strcmp(ret->state, wanted) == 0)
				return true;
		nanosleep(&(struct timespec){.tv_nsec = 5000000}, NULL);
	}
	return false;
}

static void a_full_disk_is_told_once_and_left_once_there_is_room(void **state)
{
	const struct rlimit full = {120000, RLIM_INFINITY}, none = {100, RLIM_INFINITY},
	                    room = {RLIM_INFINITY, RLIM_INFINITY};
	struct recorder_notice notice = {.state = ""}, more;
	struct recorder_status status;
	char name[64][64];
	struct recorder *r = create(dir);
	struct told told;
	bool told_more;
	uint64_t bytes;

	(void)state;
	signal(SIGXFSZ, SIG_IGN);
	assert_int_equal(setrlimit(RLIMIT_FSIZE, &full), 0);
	for (int i = 0; i < 10 && strcmp(notice.state, "failed") != 0; i++) {
		second(r, 4000);
		settle(r);
		while (strcmp(notice.state, "failed") != 0 && recorder_notice(r, &notice))
			;
	}
	setrlimit(RLIMIT_FSIZE, &none); /* nothing is printed until there is room again */
	for (int i = 0; i < 5; i++) {
		second(r, 4000);
		settle(r);
	}
	told_more = recorder_notice(r, &more);
	recorder_status(r, &status);
	assert_int_equal(setrlimit(RLIMIT_FSIZE, &room), 0);
	assert_false(told_more);
	assert_non_null(strstr(notice.sentence, "File too large"));
	assert_true(!status.recording && status.error[0] && status.dropped > 0);
	for (int i = 0; i < 10; i++) {
		second(r, 4000);
		settle(r);
	}
	assert_true(expect_notice(r, "recording", &notice));
	assert_non_null(strstr(notice.sentence, "records again"));
	recorder_status(r, &status);
	assert_true(status.recording && !status.error[0]);
	recorder_destroy(r);
	assert_true(list(name, 64, &bytes) >= 2);
	told = hear_file(name[0]);
	assert_true(told.records > 10 && told.damages == 0 && !told.ended);
}

static void a_folder_that_cannot_be_is_told_once_and_holds_nobody(void **state)
{
	struct recorder_notice notice;
	struct recorder *r = create("/dev/null/recordings");

	(void)state;
	for (int i = 0; i < 10; i++) {
		second(r, 100);
		settle(r);
	}
	assert_true(expect_notice(r, "failed", &notice));
	assert_non_null(strstr(notice.sentence, "Not a directory"));
	assert_false(recorder_notice(r, &notice));
	recorder_destroy(r);
}

static void a_disk_that_stands_still_costs_a_gap_and_never_the_loop(void **state)
{
	struct recorder_notice notice;
	struct recorder_status status;
	struct recorder *r = create(dir);
	char name[64][64];
	struct told first, last;
	uint64_t bytes;
	int n;

	(void)state;
	second(r, 1000);
	settle(r);
	config.record.max_age_ns =
	    1; /* the thread wants another file, and speaks to us when it has one: then it stands */
	second(r, 1000);
	settle(r);
	config.record.max_age_ns = 0;
	pthread_mutex_lock(&gate);
	second(r, 1000);
	for (int i = 0; i < 3; i++)
		second(r, 1000000);
	recorder_status(r, &status);
	pthread_mutex_unlock(&gate);
	assert_true(status.dropped > 0 && status.gaps == 1 && status.queued <= RECORDER_QUEUE_BYTES);
	settle(r);
	assert_true(expect_notice(r, "failed", &notice));
	if (!strstr(notice.sentence, "gap"))
		fail_msg("%s", notice.sentence);
	for (int i = 0; i < 4; i++) {
		second(r, 1000);
		settle(r);
	}
	recorder_destroy(r);
	n = list(name, 64, &bytes);
	assert_true(n >= 2);
	first = hear_file(name[0]);
	last = hear_file(name[n - 1]);
	assert_true(first.ended && last.ended && last.part == 0 && last.session > first.session);
}

static void a_slow_reader_gets_a_whole_file_up_to_where_it_was_too_slow(void **state)
{
	struct recorder *r = create(NULL);
	struct buffer taken = {0};
	char reason[320] = "";
	struct told told;
	bool ended = false;

	(void)state;
	for (int i = 0; i < 15; i++) {
		second(r, 100000);
		settle(r);
	}
	for (int i = 0; i < 1000 && !ended; i++)
		ended = recorder_take(r, 100000, &taken, reason);
	assert_true(ended);
	assert_non_null(strstr(reason, "too slow"));
	assert_true(taken.len < RECORDER_STREAM_BYTES + 4 * RECORDER_CHUNK_BYTES);
	told = hear(taken.data, taken.len);
	assert_true(told.whole && told.ended && told.records > 50 && told.damages == 0);
	recorder_destroy(r);
	buffer_finish(&taken);
}

static void what_a_client_switches_off_and_on_is_two_whole_files(void **state)
{
	struct recorder *r = create(dir);
	char name[64][64];
	uint64_t bytes;

	(void)state;
	second(r, 100);
	recorder_skip(r, 3, "queue full");
	recorder_clock(r, 7);
	recorder_event(r, "{\"class\":\"DEVICE\"}", 18);
	recorder_control(r, "{\"command\":\"PAUSE\"}", 19);
	recorder_enable(r, false);
	second(r, 100);
	settle(r);
	recorder_enable(r, true);
	second(r, 100);
	recorder_destroy(r);
	assert_int_equal(list(name, 64, &bytes), 2);
	for (int i = 0; i < 2; i++) {
		struct told told = hear_file(name[i]);

		assert_true(told.whole && told.ended && told.damages == 0);
		assert_int_equal(told.records, 10);
		assert_int_equal(told.skips, i == 0);
	}
}

#define CLAIM(name) cmocka_unit_test_setup_teardown(name, set_up, tear_down)

int main(int argc, char **argv)
{
	const struct CMUnitTest tests[] = {
	    CLAIM(files_of_a_rotation_stand_alone_and_join),
	    CLAIM(the_oldest_recordings_go_beyond_keep_and_nothing_else_does),
	    CLAIM(a_full_disk_is_told_once_and_left_once_there_is_room),
	    CLAIM(a_folder_that_cannot_be_is_told_once_and_holds_nobody),
	    CLAIM(a_disk_that_stands_still_costs_a_gap_and_never_the_loop),
	    CLAIM(a_slow_reader_gets_a_whole_file_up_to_where_it_was_too_slow),
	    CLAIM(what_a_client_switches_off_and_on_is_two_whole_files),
	};

	if (argc > 1)
		cmocka_set_test_filter(argv[1]);
	return cmocka_run_group_tests(tests, NULL, NULL);
}

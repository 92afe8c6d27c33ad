/* Law L7, L2: the list of what a live daemon's loop saw, fed into the pipeline without sockets or threads, gives byte for
 * byte the map that its clients hold; as often as one likes, and also from the list alone that begins in mid-session.
 * Simulated devices drive through the building in real time.
 *
 *   test_replay                              the test
 *   test_replay CONFIG JOURNAL [OUT.ply]     for scripts: feeds a kept list, prints step, faces and hash of the map */
#include <errno.h>
#include <setjmp.h>
#include <signal.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include <cmocka.h>
#include <jansson.h>

#include "core/map.h"
#include "core/model.h"
#include "daemon/journal.h"
#include "tools/client.h"

/* A map that is fed without a thread. */
struct feed {
	struct config config;
	struct map *map;
	struct pipeline *pipeline;
	struct patch_store *patches;
	uint64_t not_applied;
};

static struct map *new_map(const struct config *config)
{
	struct map_params params = {.cell_m = config->map.cell_m,
	                            .tolerance = config->map.tolerance,
	                            .reduce = config->map.reduce,
	                            .lookahead = config->map.lookahead,
	                            .memory = config->map.memory};

	return map_create(&params);
}

static bool feed_row(void *ctx, struct row *row)
{
	map_row(((struct feed *)ctx)->map, row);
	return true;
}

static void feed_flush(void *ctx)
{
	map_flush(((struct feed *)ctx)->map);
}

static void feed_not_applied(void *ctx, uint64_t number, const char *reason)
{
	(void)number;
	(void)reason;
	((struct feed *)ctx)->not_applied++;
}

/* Meshes everything at the end: what was meshed in between must not matter. */
static void mesh_all(struct feed *feed)
{
	const struct patch_key *key;
	size_t n = map_take_dirty(feed->map, &key);
	struct mesher *mesher = mesher_create();

	for (size_t i = 0; i < n; i++)
		patch_store_put(feed->patches, map_mesh_patch(feed->map, mesher, key[i], NULL));
	mesher_destroy(mesher);
}

/* NULL with a sentence. */
static struct feed *feed_journal(const char *config_path, const char *journal_path, char error[512])
{
	static char text[1 << 20];
	struct feed *feed = calloc(1, sizeof(*feed));
	struct pipeline_sink sink = {
	    .ctx = feed, .row = feed_row, .not_applied = feed_not_applied, .flush = feed_flush};
	struct config_error config_error = {""};
	FILE *file = fopen(config_path, "r");
	size_t len = file ? fread(text, 1, sizeof(text), file) : 0;

	if (file)
		fclose(file);
	if (!file || config_read(text, len, config_path, &feed->config, &config_error) < 0) {
		snprintf(error, 512, "%s", config_error.text);
		return NULL;
	}
	feed->map = new_map(&feed->config);
	feed->patches = patch_store_create();
	feed->pipeline = pipeline_create(&feed->config, &sink);
	if (journal_feed(journal_path, feed->pipeline, error) < 0)
		return NULL;
	mesh_all(feed);
	return feed;
}

static void feed_destroy(struct feed *feed)
{
	pipeline_destroy(feed->pipeline);
	patch_store_destroy(feed->patches);
	map_destroy(feed->map);
	free(feed);
}

/* A live daemon among simulated devices */

static const char *build_directory(void)
{
	const char *build = getenv("FACET_BUILD");

	return build && *build ? build : "build";
}

enum { ARGUMENTS_MAX = 24, FIRST_MAP = 1 /* generation */, PATIENCE_MS = 120000 };

struct live {
	char dir[32], address[64], config[64], journal[64];
	pid_t pid;
	struct client *client;
};

/* `options`: of facet simulate, ending with NULL. */
static pid_t start_simulation(const struct live *live, const char *const *options)
{
	const char *argv[ARGUMENTS_MAX] = {"facet", "simulate", "building", "--endless", "--dir", live->dir};
	char facet[256], facetd[256];
	int n = 6;
	pid_t pid;

	snprintf(facet, sizeof(facet), "%s/facet", build_directory());
	snprintf(facetd, sizeof(facetd), "%s/facetd", build_directory());
	for (; *options; options++)
		argv[n++] = *options;
	argv[n++] = "--";
	argv[n++] = facetd;
	argv[n++] = "--journal";
	argv[n++] = live->journal;
	assert_true(n < ARGUMENTS_MAX);
	pid = fork();
	if (pid == 0) {
		prctl(PR_SET_PDEATHSIG, SIGTERM); /* a test that fails leaves nothing running */
		execv(facet, (char **)(uintptr_t)argv);
		_exit(127);
	}
	return pid;
}

static void nap(void)
{
	nanosleep(&(struct timespec){.tv_nsec = 100000000}, NULL);
}

static struct client *open_client(const char *address)
{
	char error[CLIENT_ERROR_MAX] = "";
	struct client *client = NULL;

	for (int i = 0; i < 1200 && !client; i++, nap())
		client = client_open(address, 2000, error);
	if (!client)
		fail_msg("%s", error);
	return client;
}

static void open_live(struct live *live, const char *const *options)
{
	char error[CLIENT_ERROR_MAX] = "";

	strcpy(live->dir, "/tmp/facet-replay-XXXXXX");
	assert_non_null(mkdtemp(live->dir));
	snprintf(live->address, sizeof(live->address), "unix:%s/facetd.sock", live->dir);
	snprintf(live->config, sizeof(live->config), "%s/facetd.yaml", live->dir);
	snprintf(live->journal, sizeof(live->journal), "%s/journal", live->dir);
	live->pid = start_simulation(live, options);
	live->client = open_client(live->address);
	assert_int_equal(client_want(live->client, &(struct native_want){0}, error), 0);
}

/* The configuration goes with the simulation, so it is kept first. */
static void stop_live(struct live *live)
{
	char command[200];

	client_close(live->client);
	snprintf(command, sizeof(command), "cp %.60s %.60s.kept", live->config, live->config);
	assert_int_equal(system(command), 0);
	strcat(live->config, ".kept");
	kill(live->pid, SIGTERM);
	waitpid(live->pid, NULL, 0);
}

static void remove_live(const struct live *live)
{
	char command[100];

	snprintf(command, sizeof(command), "rm -rf %.31s", live->dir);
	assert_int_equal(system(command), 0);
}

/* Says `command` on a connection of its own and waits for its OK. */
static void command(const struct live *live, const char *command)
{
	struct client *client = open_client(live->address);
	char error[CLIENT_ERROR_MAX] = "";
	const char *line = NULL;

	assert_int_equal(client_say(client, command, error), 0);
	while (client_line(client, PATIENCE_MS, &line, error) == 1 && !strstr(line, "\"OK\""))
		;
	assert_non_null(line);
	assert_non_null(strstr(line, "\"OK\""));
	client_close(client);
}

/* The step that the map stands at, or 0 where a row still waits or is being worked on. */
static uint64_t stands_at(const struct live *live)
{
	struct client *client = open_client(live->address);
	char error[CLIENT_ERROR_MAX] = "";
	const char *line = NULL;
	uint64_t step = 0;

	assert_int_equal(client_say(client, "?STATUS", error), 0);
	while (client_line(client, PATIENCE_MS, &line, error) == 1 && !strstr(line, "\"STATUS\""))
		;
	assert_non_null(line);
	json_t *status = json_loads(line, 0, NULL);
	assert_non_null(status);
	if (json_is_true(json_object_get(json_object_get(status, "queue"), "idle")))
		step = (uint64_t)json_integer_value(json_object_get(status, "step"));
	json_decref(status);
	client_close(client);
	return step;
}

static uint32_t generation(const struct live *live)
{
	const struct native_hello *hello = native_mirror_hello(client_mirror(live->client));

	return hello ? hello->generation : 0;
}

/* Follows the map until `rows` are in the one of this generation. */
static void follow(const struct live *live, uint32_t wanted, uint64_t rows)
{
	char error[CLIENT_ERROR_MAX] = "";
	uint64_t step = 0;

	for (int i = 0; i < 6000 && step < rows; i++) {
		int r = client_commit(live->client, 100, error);

		if (r < 0)
			fail_msg("%s", error);
		step = generation(live) == wanted ? native_mirror_step(client_mirror(live->client)) : 0;
	}
	assert_true(step >= rows);
}

/* No row is taken any more; the map stands once what waited in the queue is in it, and the client follows. */
static void pause_and_settle(const struct live *live)
{
	char error[CLIENT_ERROR_MAX] = "";
	uint64_t step = 0;

	command(live, "?PAUSE");
	for (int i = 0; i < PATIENCE_MS / 100 && step == 0; i++) {
		step = stands_at(live);
		assert_true(client_commit(live->client, 100, error) >= 0);
	}
	assert_true(step > 0);
	for (int i = 0; i < PATIENCE_MS / 100 && native_mirror_step(client_mirror(live->client)) != step; i++)
		assert_true(client_commit(live->client, 100, error) >= 0);
	assert_int_equal(native_mirror_step(client_mirror(live->client)), step);
}

/* A map, as a client holds it or a fed list gives it. */
struct state_of_map {
	uint64_t step;
	size_t patches;
	char hash[65];
};

static struct state_of_map held_by_client(const struct live *live)
{
	const struct native_mirror *mirror = client_mirror(live->client);
	struct state_of_map map = {native_mirror_step(mirror), patch_store_count(native_mirror_patches(mirror)), ""};

	patch_store_hash(native_mirror_patches(mirror), map.hash);
	assert_true(map.patches > 20);
	return map;
}

static void expect_fed(const char *config, const char *journal, const struct state_of_map *live)
{
	char error[512] = "", fed[65];
	struct feed *feed = feed_journal(config, journal, error);

	if (!feed)
		fail_msg("%s", error);
	patch_store_hash(feed->patches, fed);
	assert_int_equal(map_step(feed->map), live->step);
	assert_int_equal(patch_store_count(feed->patches), live->patches);
	assert_string_equal(live->hash, fed);
	printf("note: %s: %llu rows, %llu not applied, %zu patches, hash %.16s\n", strrchr(journal, '/') + 1,
	       (unsigned long long)live->step, (unsigned long long)feed->not_applied, live->patches, live->hash);
	feed_destroy(feed);
}

/* The list `next` begins with exactly the state that feeding the one before it comes to. */
static void expect_to_join(const char *config, const char *journal, const char *next)
{
	static uint8_t kept[1 << 22], fed[1 << 22];
	const size_t head = 8 + 1 + 4; /* of the file and its first entry */
	FILE *file = fopen(next, "r");
	size_t len = file ? fread(kept, 1, sizeof(kept), file) : 0;
	char error[512] = "";
	struct feed *feed = feed_journal(config, journal, error);
	struct state s;

	assert_non_null(file);
	fclose(file);
	assert_non_null(feed);
	pipeline_reset(feed->pipeline);
	state_save(&s, fed, sizeof(fed));
	pipeline_state(feed->pipeline, &s, error);
	assert_true(state_done(&s) && len > head + s.at);
	assert_memory_equal(kept + head, fed, s.at);
	printf("note: %s begins with a snapshot of %zu bytes\n", strrchr(next, '/') + 1, s.at);
	feed_destroy(feed);
}

/* The simulated devices are stopped for longer than a silent servo is borne: links are lost. The daemon goes on. */
static void lose_links(const struct live *live)
{
	assert_int_equal(kill(live->pid, SIGSTOP), 0);
	for (int i = 0; i < 45; i++)
		nap();
	assert_int_equal(kill(live->pid, SIGCONT), 0);
}

/* Three maps in one session. The first: rows refused for half a second, links lost, and the map stands at its end. The second
 * begins while it stands. The third begins while rows are under way, in the middle of a sweep. */
static void live_maps_and_their_kept_lists_are_the_same_bytes_also_from_mid_session_on(void **state)
{
	struct state_of_map first, third;
	char second[70], last[70];
	struct live live;
	(void)state;
	open_live(&live, (const char *const[]){NULL});
	follow(&live, FIRST_MAP, 100);
	command(&live, "?PAUSE");
	for (int i = 0; i < 5; i++)
		nap();
	command(&live, "?RESUME");
	follow(&live, FIRST_MAP, 200);
	lose_links(&live);
	follow(&live, FIRST_MAP, native_mirror_step(client_mirror(live.client)) + 150);
	pause_and_settle(&live);
	first = held_by_client(&live);
	command(&live, "?RESET");
	command(&live, "?RESUME");
	follow(&live, FIRST_MAP + 1, 120);
	command(&live, "?RESET");
	follow(&live, FIRST_MAP + 2, 200);
	pause_and_settle(&live);
	third = held_by_client(&live);
	stop_live(&live);
	snprintf(second, sizeof(second), "%s.2", live.journal);
	snprintf(last, sizeof(last), "%s.3", live.journal);
	for (int round = 0; round < 2; round++) {
		expect_fed(live.config, live.journal, &first);
		expect_fed(live.config, last, &third);
	}
	expect_to_join(live.config, live.journal, second);
	expect_to_join(live.config, second, last);
	remove_live(&live);
}

/* A map of this scanner: wrong bytes, telegrams that never come, the plug pulled. Then a reset in full flight, and a second map. */
static struct state_of_map drive_twice(struct live *live)
{
	follow(live, FIRST_MAP, 60);
	command(live, "?RESET");
	follow(live, FIRST_MAP + 1, 60);
	pause_and_settle(live);
	return held_by_client(live);
}

static void lists_with_faults_of_every_scanner_give_their_maps(void **state)
{
	static const char *const options[][ARGUMENTS_MAX] = {
	    {"--laser", "lms2xx", "--fault", "laser: corrupt 0.3 at 2s for 2s", "--fault",
	     "laser: unplug at 7s for 300ms", NULL},
	    {"--laser", "tim", "--fault", "laser: corrupt 0.3 at 1s for 1s", "--fault", "laser: unplug at 3s for 300ms",
	     "--fault", "laser: garbage at 6s for 300ms", NULL},
	    {"--laser", "lms1xx", "--fault", "laser: crc 0.3 at 1s for 1s", "--fault", "laser: power at 3s for 300ms",
	     NULL},
	    {"--laser", "lms5xx", "--encoder", "--fault", "laser: lost 0.3 at 1s for 1s", "--fault",
	     "laser: reset at 3s", "--fault", "pose: silence at 4s for 500ms", NULL},
	};
	enum { SCANNERS = sizeof(options) / sizeof(options[0]) };
	struct state_of_map map[SCANNERS];
	struct live live[SCANNERS];
	char second[70];

	(void)state;
	for (int i = 0; i < SCANNERS; i++)
		open_live(&live[i], options[i]);
	for (int i = 0; i < SCANNERS; i++) {
		map[i] = drive_twice(&live[i]);
		stop_live(&live[i]);
	}
	for (int i = 0; i < SCANNERS; i++) {
		snprintf(second, sizeof(second), "%s.2", live[i].journal);
		printf("note: %s\n", options[i][1]);
		expect_fed(live[i].config, second, &map[i]);
		expect_to_join(live[i].config, live[i].journal, second);
		remove_live(&live[i]);
	}
}

/* For scripts */

static int write_ply(const struct feed *feed, const char *path)
{
	struct model model;
	struct buffer b = {0};
	FILE *file = fopen(path, "w");
	bool good = file && model_weld(feed->patches, feed->config.map.cell_m, &model) == 0;

	if (good) {
		ply_write(&model, false, &b);
		model_finish(&model);
		good = b.error == 0 && fwrite(b.data, 1, b.len, file) == b.len;
	}
	if (file)
		good &= fclose(file) == 0;
	buffer_finish(&b);
	return good ? 0 : 1;
}

static int feed_for_script(int argc, char **argv)
{
	char error[512] = "", hash[65];
	struct feed *feed = feed_journal(argv[1], argv[2], error);
	int r = 0;

	if (!feed) {
		fprintf(stderr, "test_replay: %s\n", error);
		return 1;
	}
	patch_store_hash(feed->patches, hash);
	printf("step %llu patches %zu hash %s\n", (unsigned long long)map_step(feed->map),
	       patch_store_count(feed->patches), hash);
	if (argc > 3)
		r = write_ply(feed, argv[3]);
	feed_destroy(feed);
	return r;
}

int main(int argc, char **argv)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(live_maps_and_their_kept_lists_are_the_same_bytes_also_from_mid_session_on),
	    cmocka_unit_test(lists_with_faults_of_every_scanner_give_their_maps),
	};

	if (argc > 2)
		return feed_for_script(argc, argv);
	return cmocka_run_group_tests(tests, NULL, NULL);
}

/* Law L7, L2: the list of what a live daemon's loop saw, fed into the pipeline without sockets or threads, gives byte for
 * byte the map that its clients hold; as often as one likes. Simulated devices drive through the building in real time.
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
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include <cmocka.h>

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
	struct pipeline_sink sink = {.ctx = feed, .row = feed_row, .flush = feed_flush};
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

static pid_t start_simulation(const char *dir)
{
	char facet[256], facetd[256], journal[256];
	pid_t pid;

	snprintf(facet, sizeof(facet), "%s/facet", build_directory());
	snprintf(facetd, sizeof(facetd), "%s/facetd", build_directory());
	snprintf(journal, sizeof(journal), "%s/journal", dir);
	pid = fork();
	if (pid == 0) {
		execl(facet, facet, "simulate", "building", "--dir", dir, "--", facetd, "--journal", journal, NULL);
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

	for (int i = 0; i < 300 && !client; i++, nap())
		client = client_open(address, 2000, error);
	if (!client)
		fail_msg("%s", error);
	return client;
}

/* Follows the map until `rows` are in it. */
static void follow(struct client *client, uint64_t rows)
{
	char error[CLIENT_ERROR_MAX] = "";
	uint64_t step = 0;

	for (int i = 0; i < 1200 && step < rows; i++) {
		int r = client_commit(client, 100, error);

		if (r < 0)
			fail_msg("%s", error);
		step = native_mirror_step(client_mirror(client));
	}
	assert_true(step >= rows);
}

/* No row is taken any more; the map stands once what waited in the queue is in it. */
static void pause_and_settle(const char *address, struct client *follower)
{
	struct client *client = open_client(address);
	char error[CLIENT_ERROR_MAX] = "";
	const char *line = NULL;
	int quiet = 0;

	assert_int_equal(client_say(client, "?PAUSE", error), 0);
	while (client_line(client, 5000, &line, error) == 1 && !strstr(line, "\"PAUSE\""))
		;
	assert_non_null(line);
	for (int i = 0; i < 600 && quiet < 20; i++) {
		int r = client_commit(follower, 100, error);

		assert_true(r >= 0);
		quiet = r == 1 ? 0 : quiet + 1;
	}
	assert_int_equal(quiet, 20);
	client_close(client);
}

static void a_live_map_and_its_kept_list_fed_twice_are_the_same_bytes(void **state)
{
	char dir[64] = "/tmp/facet-replay-XXXXXX", address[128], config[128], journal[128], command[400],
	     error[512] = "";
	char live[65], fed[65];
	struct client *client;
	uint64_t step;
	size_t count;
	pid_t pid;

	(void)state;
	assert_non_null(mkdtemp(dir));
	snprintf(address, sizeof(address), "unix:%s/facetd.sock", dir);
	snprintf(config, sizeof(config), "%s/facetd.yaml", dir);
	snprintf(journal, sizeof(journal), "%s/journal", dir);
	pid = start_simulation(dir);
	client = open_client(address);
	assert_int_equal(client_want(client, &(struct native_want){0}, error), 0);
	follow(client, 300);
	pause_and_settle(address, client);
	patch_store_hash(native_mirror_patches(client_mirror(client)), live);
	count = patch_store_count(native_mirror_patches(client_mirror(client)));
	step = native_mirror_step(client_mirror(client));
	client_close(client);
	/* The configuration goes with the simulation. */
	snprintf(command, sizeof(command), "cp %s %s.kept", config, config);
	assert_int_equal(system(command), 0);
	strcat(config, ".kept");
	kill(pid, SIGTERM);
	waitpid(pid, NULL, 0);
	assert_true(count > 20);
	for (int round = 0; round < 2; round++) {
		struct feed *feed = feed_journal(config, journal, error);

		if (!feed)
			fail_msg("%s", error);
		assert_int_equal(map_step(feed->map), step);
		assert_int_equal(patch_store_count(feed->patches), count);
		patch_store_hash(feed->patches, fed);
		assert_string_equal(live, fed);
		feed_destroy(feed);
	}
	printf("note: %llu rows, %zu patches, hash %.16s\n", (unsigned long long)step, count, live);
	snprintf(command, sizeof(command), "rm -rf %s", dir);
	assert_int_equal(system(command), 0);
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
	    cmocka_unit_test(a_live_map_and_its_kept_list_fed_twice_are_the_same_bytes),
	};

	if (argc > 2)
		return feed_for_script(argc, argv);
	return cmocka_run_group_tests(tests, NULL, NULL);
}

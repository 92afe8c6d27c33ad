/* Law: a client holds what the daemon committed and nothing else; whatever the daemon does, the tool answers in its time
 * limit with one sentence. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>
#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include "tools/client.h"

/* A daemon of one connection: waits for the first bytes, sends `out` in pieces, then closes or stays silent. */
struct daemon {
	char dir[40], address[80];
	struct sockaddr_un un;
	int listener;
	struct buffer out;
	size_t piece;
	bool silent;
	char heard[256];
	pthread_t thread;
	int stop[2];
};

static void *serve(void *ctx)
{
	struct daemon *d = ctx;
	const int fd = accept(d->listener, NULL, NULL);
	ssize_t n = recv(fd, d->heard, sizeof(d->heard) - 1, 0);
	char byte;
	for (size_t at = 0; n > 0 && at < d->out.len;) {
		const size_t left = d->out.len - at, piece = left < d->piece ? left : d->piece;
		n = send(fd, d->out.data + at, piece, MSG_NOSIGNAL);
		at += n > 0 ? (size_t)n : 0;
	}
	if (d->silent)
		n = read(d->stop[0], &byte, 1);
	close(fd);
	return NULL;
}

static struct daemon *daemon_start(const struct buffer *out, size_t piece, bool silent)
{
	struct daemon *d = calloc(1, sizeof(*d));
	assert_non_null(d);
	strcpy(d->dir, "/tmp/client.XXXXXX");
	assert_non_null(mkdtemp(d->dir));
	d->un.sun_family = AF_UNIX;
	snprintf(d->un.sun_path, sizeof(d->un.sun_path), "%s/socket", d->dir);
	snprintf(d->address, sizeof(d->address), "unix:%s/socket", d->dir);
	d->listener = socket(AF_UNIX, SOCK_STREAM, 0);
	assert_int_equal(bind(d->listener, (struct sockaddr *)&d->un, sizeof(d->un)), 0);
	assert_int_equal(listen(d->listener, 4), 0);
	assert_int_equal(pipe(d->stop), 0);
	d->out = *out;
	d->piece = piece;
	d->silent = silent;
	assert_int_equal(pthread_create(&d->thread, NULL, serve, d), 0);
	return d;
}

static void daemon_stop(struct daemon *d)
{
	assert_int_equal(write(d->stop[1], "", 1), 1);
	pthread_join(d->thread, NULL);
	close(d->stop[0]);
	close(d->stop[1]);
	close(d->listener);
	unlink(d->un.sun_path);
	rmdir(d->dir);
	buffer_finish(&d->out);
	free(d);
}

static struct client *connect_to(const struct daemon *d)
{
	char error[CLIENT_ERROR_MAX];
	struct client *client = client_open(d->address, 5000, error);
	if (!client)
		fail_msg("%s", error);
	return client;
}

/* One triangle in the patch `x`,0,0. */
static void put_patch(struct buffer *b, int x, uint64_t version)
{
	struct patch *patch = patch_allocate((struct patch_key){x, 0, 0}, 3, 1, 1);
	assert_non_null(patch);
	patch->version = version;
	patch->vertex[1][0] = 256;
	patch->vertex[2][1] = 256;
	patch->triangle[0][1] = 1;
	patch->triangle[0][2] = 2;
	patch->run[0] = (struct patch_run){.plane = PLANE_NONE, .triangles = 1};
	native_put_patch(b, patch);
	patch_unref(patch);
}

static void put_hello(struct buffer *b)
{
	native_put_hello(b, &(struct native_hello){.major = NATIVE_MAJOR, .cell_m = 0.05, .generation = 1});
}

static void put_batch(struct buffer *b, uint64_t step, int patches, bool reset)
{
	native_put_begin(b, &(struct native_begin){.step = step, .patches = (uint32_t)patches, .reset = reset});
	for (int i = 0; i < patches; i++)
		put_patch(b, i, step);
	native_put_step(b, NATIVE_COMMIT, step);
}

static void batches_in_pieces_of_any_size_become_the_map(void **state)
{
	(void)state;
	static const size_t pieces[] = {1, 7, 100000};
	for (size_t i = 0; i < sizeof(pieces) / sizeof(pieces[0]); i++) {
		struct buffer out = {0};
		char error[CLIENT_ERROR_MAX];
		put_hello(&out);
		put_batch(&out, 5, 3, true);
		native_put_ping(&out);
		native_put_json(&out, "{\"class\":\"EVENT\"}", 17);
		put_batch(&out, 6, 4, false);
		struct daemon *d = daemon_start(&out, pieces[i], true);
		struct client *client = connect_to(d);
		assert_int_equal(client_want(client, &(struct native_want){0}, error), 0);
		assert_int_equal(client_commit(client, 10000, error), 1);
		assert_int_equal(native_mirror_step(client_mirror(client)), 5);
		assert_int_equal(patch_store_count(native_mirror_patches(client_mirror(client))), 3);
		assert_int_equal(client_commit(client, 10000, error), 1);
		assert_int_equal(patch_store_count(native_mirror_patches(client_mirror(client))), 4);
		assert_int_equal(client_commit(client, 20, error), 0);
		assert_int_equal(d->heard[4], NATIVE_WANT);
		client_close(client);
		daemon_stop(d);
	}
}

static void a_silent_daemon_is_left_at_the_time_limit(void **state)
{
	(void)state;
	struct buffer out = {0};
	char error[CLIENT_ERROR_MAX];
	struct daemon *d = daemon_start(&out, 1, true);
	struct client *client = connect_to(d);
	assert_int_equal(client_want(client, &(struct native_want){0}, error), 0);
	assert_int_equal(client_commit(client, 50, error), 0);
	assert_null(native_mirror_hello(client_mirror(client)));
	client_close(client);
	daemon_stop(d);
}

static void a_daemon_that_closes_is_quoted(void **state)
{
	(void)state;
	static const char reason[] = "{\"class\":\"ERROR\",\"error\":\"too slow\"}  ";
	struct buffer out = {0};
	char error[CLIENT_ERROR_MAX];
	put_hello(&out);
	native_put_json(&out, reason, sizeof(reason) - 1);
	struct daemon *d = daemon_start(&out, 4096, false);
	struct client *client = connect_to(d);
	assert_int_equal(client_want(client, &(struct native_want){0}, error), 0);
	assert_int_equal(client_commit(client, 10000, error), -ECONNRESET);
	assert_non_null(strstr(error, "too slow"));
	client_close(client);
	daemon_stop(d);
}

static void what_is_no_frame_is_refused_by_name(void **state)
{
	(void)state;
	struct buffer out = {0};
	char error[CLIENT_ERROR_MAX];
	buffer_append(&out, "HTTP/1.1 400 Bad Request\r\n", 26);
	struct daemon *d = daemon_start(&out, 4096, true);
	struct client *client = connect_to(d);
	assert_int_equal(client_want(client, &(struct native_want){0}, error), 0);
	assert_int_equal(client_commit(client, 10000, error), -EPROTO);
	assert_non_null(strstr(error, d->address));
	client_close(client);
	daemon_stop(d);
}

static void lines_come_one_by_one_however_they_are_cut(void **state)
{
	(void)state;
	static const char text[] = "{\"a\":1}\n\n{\"b\":2}\nrest";
	struct buffer out = {0};
	const char *line;
	char error[CLIENT_ERROR_MAX];
	buffer_append(&out, text, sizeof(text) - 1);
	struct daemon *d = daemon_start(&out, 3, false);
	struct client *client = connect_to(d);
	assert_int_equal(client_say(client, "?STATUS", error), 0);
	assert_int_equal(client_line(client, 10000, &line, error), 1);
	assert_string_equal(line, "{\"a\":1}");
	assert_int_equal(client_line(client, 10000, &line, error), 1);
	assert_string_equal(line, "");
	assert_int_equal(client_line(client, 10000, &line, error), 1);
	assert_string_equal(line, "{\"b\":2}");
	assert_int_equal(client_line(client, 10000, &line, error), -ECONNRESET);
	assert_memory_equal(d->heard, "?STATUS", 7);
	client_close(client);
	daemon_stop(d);
}

static void a_line_without_an_end_is_refused(void **state)
{
	(void)state;
	static char blanks[CLIENT_LINE_MAX + 400000];
	struct buffer out = {0};
	const char *line;
	char error[CLIENT_ERROR_MAX];
	memset(blanks, ' ', sizeof(blanks));
	buffer_append(&out, blanks, sizeof(blanks));
	struct daemon *d = daemon_start(&out, 100000, true);
	struct client *client = connect_to(d);
	assert_int_equal(client_say(client, "?STATUS", error), 0);
	assert_int_equal(client_line(client, 20000, &line, error), -EPROTO);
	client_close(client);
	daemon_stop(d);
}

static void where_no_daemon_is_the_sentence_names_the_address(void **state)
{
	(void)state;
	char error[CLIENT_ERROR_MAX];
	assert_null(client_open("unix:/nonexistent/socket", 100, error));
	assert_non_null(strstr(error, "unix:/nonexistent/socket"));
	assert_non_null(strstr(error, "start facetd"));
	assert_null(client_open("tcp:127.0.0.1:1", 1000, error));
	assert_non_null(strstr(error, "tcp:127.0.0.1:1"));
	assert_null(client_open("ws://127.0.0.1:1/?token=secret", 1000, error));
	assert_non_null(strstr(error, "ws://127.0.0.1:1/"));
	assert_null(strstr(error, "secret"));
	assert_null(client_open("wss://127.0.0.1:7880/", 100, error));
	assert_non_null(strstr(error, "ssh -L"));
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(batches_in_pieces_of_any_size_become_the_map),
	    cmocka_unit_test(a_silent_daemon_is_left_at_the_time_limit),
	    cmocka_unit_test(a_daemon_that_closes_is_quoted),
	    cmocka_unit_test(what_is_no_frame_is_refused_by_name),
	    cmocka_unit_test(lines_come_one_by_one_however_they_are_cut),
	    cmocka_unit_test(a_line_without_an_end_is_refused),
	    cmocka_unit_test(where_no_daemon_is_the_sentence_names_the_address),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

/* Laws L6, L8, D11: any number of clients of any behaviour neither stop the server nor cost it unbounded memory; each is
 * told why it is closed; what changes something is taken on the unix socket only; nothing listens beyond loopback. */
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include <cmocka.h>

#include "daemon/server.h"

#define SECOND 1000000000ll

static char directory[64];
static uv_loop_t loop;
static struct config config;
static struct publisher *publisher;
static struct server *server;
static int64_t virtual_ns;
static int pauses, resumes, resets, statuses;
static uint64_t step;

/* The host */

static int64_t host_now(void *ctx)
{
	(void)ctx;
	return virtual_ns;
}

static void host_status(void *ctx, struct buffer *ret)
{
	(void)ctx;
	statuses++;
	buffer_printf(ret, "{\"class\":\"STATUS\",\"filler\":\"%0900d\"}", 7);
}

static bool host_command(void *ctx, const struct control_command *command, char error[200])
{
	(void)ctx;
	(void)error;
	pauses += command->word == CONTROL_PAUSE;
	resumes += command->word == CONTROL_RESUME;
	resets += command->word == CONTROL_RESET;
	return true;
}

static void host_log(void *ctx, int priority, const char *text)
{
	(void)ctx;
	(void)priority;
	(void)text;
}

static const struct server_host host = {NULL, host_now, host_status, host_command, host_log, NULL, NULL, false};

static int set_up(void **state)
{
	struct publisher_params params = {.cell_m = 0.05};
	char error[320] = "";

	(void)state;
	snprintf(directory, sizeof(directory), "/tmp/facet-server-XXXXXX");
	assert_non_null(mkdtemp(directory));
	config_default(&config);
	config.listen.natives = 2;
	snprintf(config.listen.native[0], CONFIG_TEXT_MAX, "unix:%s/sock", directory);
	snprintf(config.listen.native[1], CONFIG_TEXT_MAX, "tcp:127.0.0.1:0");
	config.listen.send_buffer = 16 << 10;
	config.listen.clients = 4;
	uv_loop_init(&loop);
	virtual_ns = SECOND;
	pauses = resumes = resets = statuses = 0;
	step = 0;
	publisher = publisher_create(&params);
	server = server_create(&loop, &config, publisher, &host, error);
	if (!server)
		fail_msg("%s", error);
	return 0;
}

static int tear_down(void **state)
{
	char path[128];
	struct stat st;

	(void)state;
	server_stop(server);
	uv_run(&loop, UV_RUN_DEFAULT);
	server_destroy(server);
	publisher_destroy(publisher);
	assert_int_equal(uv_loop_close(&loop), 0);
	snprintf(path, sizeof(path), "%s/sock", directory);
	assert_int_equal(stat(path, &st), -1); /* removed */
	rmdir(directory);
	return 0;
}

/* The loop turns until `done` or for a minute of real time. */
static bool turn_until(bool (*done)(void *ctx), void *ctx)
{
	struct timespec pause = {.tv_nsec = 1000000};

	for (int i = 0; i < 60000; i++) {
		uv_run(&loop, UV_RUN_NOWAIT);
		if (done(ctx))
			return true;
		nanosleep(&pause, NULL);
	}
	return false;
}

static void turn(int n)
{
	while (n-- > 0)
		uv_run(&loop, UV_RUN_NOWAIT);
}

/* The other end */

struct peer {
	int fd;
	struct buffer in;
	size_t at; /* frames taken so far */
	bool closed;
	struct native_mirror *mirror;
	unsigned commits, aborts;
	char reason[300];
	size_t want_bytes; /* for has_bytes */
	uint64_t want_step;
};

static void peer_unix(struct peer *peer)
{
	struct sockaddr_un address = {.sun_family = AF_UNIX};

	memset(peer, 0, sizeof(*peer));
	snprintf(address.sun_path, sizeof(address.sun_path), "%s/sock", directory);
	peer->fd = socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK, 0);
	assert_int_equal(connect(peer->fd, (struct sockaddr *)&address, sizeof(address)), 0);
	peer->mirror = native_mirror_create();
}

static void peer_tcp(struct peer *peer, int receive_buffer)
{
	struct sockaddr_in address = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};

	memset(peer, 0, sizeof(*peer));
	address.sin_port = htons((uint16_t)atoi(strrchr(server_address(server, 1), ':') + 1));
	peer->fd = socket(AF_INET, SOCK_STREAM, 0);
	if (receive_buffer)
		setsockopt(peer->fd, SOL_SOCKET, SO_RCVBUF, &receive_buffer, sizeof(receive_buffer));
	assert_int_equal(connect(peer->fd, (struct sockaddr *)&address, sizeof(address)), 0);
	fcntl(peer->fd, F_SETFL, O_NONBLOCK);
	peer->mirror = native_mirror_create();
}

static void peer_close(struct peer *peer)
{
	close(peer->fd);
	native_mirror_destroy(peer->mirror);
	buffer_finish(&peer->in);
}

static void peer_say(struct peer *peer, const void *bytes, size_t n)
{
	assert_int_equal(send(peer->fd, bytes, n, MSG_NOSIGNAL), (ssize_t)n);
}

static void peer_line(struct peer *peer, const char *text)
{
	peer_say(peer, text, strlen(text));
}

static void peer_want(struct peer *peer)
{
	struct native_want want = {0};
	struct buffer b = {0};

	native_put_want(&b, &want);
	peer_say(peer, b.data, b.len);
	buffer_finish(&b);
}

static void peer_read(struct peer *peer)
{
	uint8_t bytes[4096];
	ssize_t n;

	while ((n = recv(peer->fd, bytes, sizeof(bytes), 0)) > 0)
		buffer_append(&peer->in, bytes, (size_t)n);
	peer->closed |= n == 0 || (n < 0 && errno != EAGAIN);
}

static void peer_frames(struct peer *peer)
{
	ssize_t n;

	peer_read(peer);
	while (peer->in.len > peer->at &&
	       (n = native_scan(peer->in.data + peer->at, peer->in.len - peer->at, NATIVE_TO_CLIENT_MAX)) != 0) {
		struct native_message message;
		char error[128] = "";
		int r;

		assert_true(n > 0);
		assert_int_equal(native_decode(peer->in.data + peer->at, (size_t)n, &message, error), 0);
		if (message.type == NATIVE_JSON)
			snprintf(peer->reason, sizeof(peer->reason), "%.*s", (int)message.json.len, message.json.text);
		peer->aborts += message.type == NATIVE_ABORT;
		r = native_mirror_apply(peer->mirror, &message, error);
		assert_true(r >= 0);
		peer->commits += r == 1;
		peer->at += (size_t)n;
	}
}

static bool is_closed(void *ctx)
{
	struct peer *peer = ctx;

	peer_read(peer);
	return peer->closed;
}

static bool is_native_closed(void *ctx)
{
	struct peer *peer = ctx;

	peer_frames(peer);
	return peer->closed;
}

static bool has_step(void *ctx)
{
	struct peer *peer = ctx;

	peer_frames(peer);
	return native_mirror_step(peer->mirror) == peer->want_step && peer->commits > 0;
}

static bool has_reason(void *ctx)
{
	struct peer *peer = ctx;

	peer_frames(peer);
	return peer->reason[0] != 0;
}

static bool has_bytes(void *ctx)
{
	struct peer *peer = ctx;

	peer_read(peer);
	return peer->in.len >= peer->want_bytes;
}

static bool hears(struct peer *peer, const char *text)
{
	buffer_append(&peer->in, "", 1);
	peer->in.len--;
	return peer->in.data && strstr((const char *)peer->in.data, text) != NULL;
}

struct expectation {
	struct peer *peer;
	const char *text;
};

static bool is_heard(void *ctx)
{
	struct expectation *e = ctx;

	peer_read(e->peer);
	return hears(e->peer, e->text);
}

static void expect_heard(struct peer *peer, const char *text)
{
	struct expectation e = {peer, text};

	if (!turn_until(is_heard, &e))
		fail_msg("not heard: %s in %.300s", text, peer->in.data ? (char *)peer->in.data : "");
}

/* A step of the map: `n` patches of about 4 KB change. */
static void publish_step(int n)
{
	static uint16_t vertex[400][3];
	static uint32_t triangle[398][3];
	struct surface surface = {.nv = 400, .nt = 398, .vertex = vertex, .triangle = triangle};
	struct patch *patch[16];

	step++;
	for (uint32_t i = 0; i < 398; i++)
		for (uint32_t k = 0; k < 3; k++)
			triangle[i][k] = i + k;
	for (int i = 0; i < n; i++) {
		vertex[0][0] = (uint16_t)((step * 7 + (uint64_t)i) % 4097);
		patch[i] = patch_create((struct patch_key){i, 0, 0}, &surface);
		patch[i]->version = step;
	}
	assert_int_equal(publisher_publish(publisher, step, patch, NULL, (size_t)n), 0);
	while (n > 0)
		patch_unref(patch[--n]);
	server_wake(server);
}

static void expect_whole_map(struct peer *peer)
{
	peer->want_step = step;
	assert_true(turn_until(has_step, peer));
	for (int i = 0; i < 16; i++) {
		struct patch *patch = patch_store_get(native_mirror_patches(peer->mirror), (struct patch_key){i, 0, 0});

		assert_non_null(patch);
		assert_int_equal(patch->vertex[0][0], (step * 7 + (uint64_t)i) % 4097);
	}
}

/* Claims */

static void the_first_byte_decides_the_language(void **state)
{
	struct peer lines, object, native;

	(void)state;
	publish_step(16);
	peer_unix(&lines);
	peer_unix(&object);
	peer_unix(&native);
	peer_line(&lines, "?STATUS\n");
	peer_line(&object, "{\"command\":\"STATUS\"}\n");
	peer_want(&native);
	expect_heard(&lines, "\"class\":\"VERSION\"");
	expect_heard(&lines, "\"class\":\"STATUS\"");
	expect_heard(&object, "\"class\":\"STATUS\"");
	expect_whole_map(&native);
	peer_close(&lines);
	peer_close(&object);
	peer_close(&native);
}

static void a_question_may_come_in_any_pieces(void **state)
{
	struct peer peer;
	static const char text[] = "?WATCH={\"enable\":false};\r\n\n  ?PAUSE\n";

	(void)state;
	peer_unix(&peer);
	for (size_t i = 0; i < sizeof(text) - 1; i++) {
		peer_say(&peer, text + i, 1);
		turn(2);
	}
	expect_heard(&peer, "\"class\":\"WATCH\",\"enable\":false");
	expect_heard(&peer, "\"command\":\"PAUSE\"");
	assert_int_equal(pauses, 1);
	peer_close(&peer);
}

static void what_changes_something_is_for_the_unix_socket(void **state)
{
	struct peer local, remote, native;
	struct buffer b = {0};

	(void)state;
	peer_unix(&local);
	peer_tcp(&remote, 0);
	peer_tcp(&native, 0);
	peer_line(&remote, "?RESET\n?PAUSE\n?STATUS\n");
	expect_heard(&remote, "unix socket only");
	expect_heard(&remote, "\"class\":\"STATUS\"");
	peer_want(&native);
	native_put_json(&b, "?RESET", 6);
	peer_say(&native, b.data, b.len);
	assert_true(turn_until(has_reason, &native));
	assert_non_null(strstr(native.reason, "unix socket only"));
	assert_int_equal(pauses + resets, 0);
	peer_line(&local, "?PAUSE\n?RESUME\n?RESET\n");
	expect_heard(&local, "\"command\":\"RESET\"");
	assert_true(pauses == 1 && resumes == 1 && resets == 1);
	peer_close(&local);
	peer_close(&remote);
	peer_close(&native);
	buffer_finish(&b);
}

static void what_comes_later_is_refused_by_name(void **state)
{
	struct peer peer;

	(void)state;
	peer_unix(&peer);
	peer_line(&peer, "?SAVE={}\n?SEEK={}\n?SWEEP={\n?NONE\n{}\n?WATCH=[]\n?WATCH={\"enable\":1}\n");
	expect_heard(&peer, "a name is needed");
	expect_heard(&peer, "say where to, or how fast");
	expect_heard(&peer, "?SWEEP comes");
	expect_heard(&peer, "not a command");
	expect_heard(&peer, "a JSON object with");
	expect_heard(&peer, "what follows `=` is a JSON object");
	expect_heard(&peer, "`enable` is true or false");
	assert_false(peer.closed);
	peer_close(&peer);
}

static void who_watches_hears_a_status_a_second_and_events(void **state)
{
	struct peer peer;

	(void)state;
	peer_unix(&peer);
	peer_line(&peer, "?WATCH={\"enable\":true}\n");
	expect_heard(&peer, "\"enable\":true");
	expect_heard(&peer, "\"class\":\"STATUS\"");
	server_event(server, "{\"class\":\"DEVICE\"}", 18);
	expect_heard(&peer, "{\"class\":\"DEVICE\"}\n");
	peer_close(&peer);
}

static void at_the_limit_each_is_told_so_in_its_language_and_closed(void **state)
{
	struct peer inside[4], native, lines;

	(void)state;
	for (int i = 0; i < 4; i++)
		peer_unix(&inside[i]);
	turn(3);
	peer_unix(&native);
	peer_tcp(&lines, 0);
	turn(3);
	peer_want(&native);
	peer_line(&lines, "?STATUS\n");
	assert_true(turn_until(is_native_closed, &native));
	assert_non_null(strstr(native.reason, "listen.clients"));
	assert_true(turn_until(is_closed, &lines));
	assert_true(hears(&lines, "listen.clients"));
	peer_line(&inside[0], "?STATUS\n");
	expect_heard(&inside[0], "STATUS");
	for (int i = 0; i < 4; i++)
		peer_close(&inside[i]);
	peer_close(&native);
	peer_close(&lines);
}

static void more_than_the_doorstep_holds_are_just_closed(void **state)
{
	struct peer peer[4 + SERVER_DOORSTEP_MAX + 3];
	int n = sizeof(peer) / sizeof(peer[0]), closed = 0;

	(void)state;
	for (int i = 0; i < n; i++) {
		peer_unix(&peer[i]);
		turn(3);
	}
	for (int i = 0; i < n; i++)
		closed += is_closed(&peer[i]);
	assert_int_equal(closed, 3);
	for (int i = 0; i < n; i++)
		peer_close(&peer[i]);
}

static void a_silent_connection_is_closed_after_ten_seconds(void **state)
{
	struct peer silent, speaking;

	(void)state;
	peer_unix(&silent);
	peer_unix(&speaking);
	peer_line(&speaking, "?STATUS\n");
	expect_heard(&speaking, "STATUS");
	virtual_ns += 9 * SECOND;
	turn(200);
	assert_false(is_closed(&silent));
	virtual_ns += 2 * SECOND;
	assert_true(turn_until(is_closed, &silent));
	assert_false(is_closed(&speaking));
	peer_close(&silent);
	peer_close(&speaking);
}

static void garbage_is_answered_by_a_reason_and_the_end(void **state)
{
	static const char *const garbage[] = {"GET / HTTP/1.1\r\n\r\n", "\x04\x00\x00\x00\x0b\x00\x00\x00",
	                                      "\x04\x00\x00\x00\x0b\x00\x01\x00",
	                                      "\x08\x00\x00\x00\x02\x00\x00\x00\x00\x00\x00\x00"};
	static const size_t len[] = {18, 8, 8, 12};

	(void)state;
	for (int i = 0; i < 4; i++) {
		struct peer peer;

		peer_tcp(&peer, 0);
		peer_say(&peer, garbage[i], len[i]);
		assert_true(turn_until(is_native_closed, &peer));
		assert_non_null(strstr(peer.reason, "\"error\""));
		peer_close(&peer);
	}
}

static void a_frame_only_a_server_sends_ends_the_connection(void **state)
{
	struct peer peer;
	struct buffer b = {0};

	(void)state;
	peer_unix(&peer);
	peer_want(&peer);
	native_put_step(&b, NATIVE_COMMIT, 3);
	native_put_ping(&b);
	peer_say(&peer, b.data, b.len);
	assert_true(turn_until(is_native_closed, &peer));
	assert_non_null(strstr(peer.reason, "only the server"));
	peer_close(&peer);
	buffer_finish(&b);
}

static void a_line_without_end_is_refused(void **state)
{
	struct peer peer;
	char text[8192];
	size_t sent = 0;

	(void)state;
	memset(text, 'x', sizeof(text));
	text[0] = '?';
	peer_unix(&peer);
	while (sent < CONTROL_LINE_MAX + 2 * sizeof(text) && !peer.closed) {
		ssize_t n = send(peer.fd, text, sizeof(text), MSG_NOSIGNAL);

		if (n < 0 && errno != EAGAIN)
			break;
		sent += n > 0 ? (size_t)n : 0;
		turn(2);
		peer_read(&peer);
	}
	assert_true(turn_until(is_closed, &peer));
	assert_true(hears(&peer, "more than 64 KB"));
	peer_close(&peer);
}

static void a_client_that_asks_and_does_not_read_blocks_only_itself(void **state)
{
	struct peer deaf, other;
	struct control_client client[8];
	size_t asked = 0, unsent = 0;

	(void)state;
	peer_unix(&deaf);
	while (unsent < 50) { /* until its questions are no longer taken */
		ssize_t n = send(deaf.fd, "?STATUS\n", 8, MSG_NOSIGNAL);

		asked += n == 8;
		unsent = n == 8 ? 0 : unsent + 1;
		turn(1);
	}
	assert_int_equal(server_clients(server, client, 8), 1);
	assert_true(client[0].queued < SERVER_LINES_MAX + 4096);
	peer_unix(&other);
	peer_line(&other, "?STATUS\n");
	expect_heard(&other, "STATUS");
	/* When it reads, every question is answered. */
	deaf.want_bytes = asked * 929;
	assert_true(turn_until(has_bytes, &deaf));
	peer_close(&deaf);
	peer_close(&other);
}

/* `n` times one text, as lines or as frames, in one piece. */
static void peer_flood(struct peer *peer, bool lines, const char *text, int n)
{
	struct buffer b = {0};

	for (int i = 0; i < n; i++)
		if (lines)
			buffer_printf(&b, "%s\n", text);
		else
			native_put_json(&b, text, strlen(text));
	peer_say(peer, b.data, b.len);
	buffer_finish(&b);
}

static void of_a_thousand_messages_a_turn_hears_a_few_and_later_turns_the_rest(void **state)
{
	(void)state;
	for (int lines = 0; lines < 2; lines++) {
		struct peer peer;
		int turns = 0, most = 0;

		pauses = 0;
		peer_unix(&peer);
		if (lines)
			peer_line(&peer, "?STATUS\n");
		else
			peer_want(&peer);
		turn(3);
		peer_flood(&peer, lines, "?PAUSE", 1000);
		for (; pauses < 1000 && turns < 1000; turns++) {
			int before = pauses;

			turn(1);
			most = pauses - before > most ? pauses - before : most;
			peer_read(&peer);
		}
		assert_int_equal(pauses, 1000);
		assert_in_range(most, 1, 16);
		peer_close(&peer);
		turn(3);
	}
}

static void a_status_is_built_ten_times_a_second_at_most(void **state)
{
	struct peer lines, native;

	(void)state;
	peer_unix(&lines);
	peer_unix(&native);
	peer_want(&native);
	peer_flood(&lines, true, "?STATUS", 500);
	peer_flood(&native, false, "?STATUS", 500);
	lines.want_bytes = 500 * 929;
	assert_true(turn_until(has_bytes, &lines));
	assert_true(turn_until(has_reason, &native));
	assert_int_equal(statuses, 1);
	virtual_ns += SECOND / 10;
	lines.want_bytes += 929;
	peer_line(&lines, "?STATUS\n");
	assert_true(turn_until(has_bytes, &lines));
	assert_int_equal(statuses, 2);
	peer_line(&lines, "?PAUSE\n?STATUS\n"); /* the change is seen at once */
	lines.want_bytes += 929;
	assert_true(turn_until(has_bytes, &lines));
	assert_int_equal(statuses, 3);
	peer_close(&lines);
	peer_close(&native);
}

static void no_status_is_built_for_a_client_that_has_no_room_for_it(void **state)
{
	struct peer deaf;
	int built = 0;

	(void)state;
	peer_unix(&deaf);
	peer_want(&deaf);
	for (int i = 0; i < 600; i++) {
		peer_flood(&deaf, false, "?STATUS", 1);
		virtual_ns += SECOND / 10;
		turn(1);
		if (i == 400)
			built = statuses;
	}
	assert_in_range(built, 70, 350);
	assert_int_equal(statuses, built);
	peer_close(&deaf);
}

static void a_client_that_ends_its_half_still_gets_its_answers(void **state)
{
	struct peer peer;

	(void)state;
	peer_unix(&peer);
	peer_line(&peer, "?STATUS\n?STATUS\n");
	shutdown(peer.fd, SHUT_WR);
	assert_true(turn_until(is_closed, &peer));
	peer.want_bytes = 2 * 929;
	assert_true(has_bytes(&peer));
	peer_close(&peer);
}

static void a_stalled_client_does_not_hold_the_others_and_converges_when_it_reads(void **state)
{
	struct peer stalled, narrow, quick, late;
	struct control_client client[8];
	uint64_t behind_peak = 0;
	size_t n, queued = 0;

	(void)state;
	publish_step(16);
	peer_unix(&stalled);
	peer_tcp(&narrow, 4096);
	peer_unix(&quick);
	peer_want(&stalled);
	peer_want(&narrow);
	peer_want(&quick);
	/* 16 KB of send buffer; 200 steps of 64 KB change: 800 buffers. */
	for (int i = 0; i < 200; i++) {
		publish_step(16);
		expect_whole_map(&quick);
	}
	n = server_clients(server, client, 8);
	assert_int_equal(n, 3);
	for (size_t i = 0; i < n; i++) {
		queued += client[i].queued;
		if (behind_peak < client[i].behind_peak)
			behind_peak = client[i].behind_peak;
	}
	assert_true(behind_peak >= 150);
	assert_true(queued < 1 << 20);
	peer_unix(&late);
	peer_want(&late);
	expect_whole_map(&late);
	expect_whole_map(&stalled);
	expect_whole_map(&narrow);
	assert_true(stalled.commits < 20);
	assert_true(quick.commits >= 200);
	peer_close(&stalled);
	peer_close(&narrow);
	peer_close(&quick);
	peer_close(&late);
}

/* A hundred and fifty whose sockets are full, and one that wanted few bytes a second and had them. */
static void news_go_past_those_who_cannot_take_any(void **state)
{
	static struct peer stalled[150];
	struct peer quick, paced;
	struct native_want few = {.bytes_per_s = 1000};
	struct buffer b = {0};
	uint64_t visits;

	(void)state;
	config.listen.clients = 152;
	publish_step(16);
	for (int i = 0; i < 150; i++) {
		peer_unix(&stalled[i]);
		peer_want(&stalled[i]);
		turn(3);
	}
	peer_unix(&quick);
	peer_want(&quick);
	peer_unix(&paced);
	native_put_want(&b, &few);
	peer_say(&paced, b.data, b.len);
	buffer_finish(&b);
	expect_whole_map(&quick);
	turn(10);
	visits = server_visits(server);
	for (int i = 0; i < 20; i++) {
		publish_step(16);
		expect_whole_map(&quick);
	}
	assert_int_equal(server_visits(server) - visits, 20);
	for (int i = 0; i < 150; i++) {
		expect_whole_map(&stalled[i]);
		peer_close(&stalled[i]);
	}
	for (int i = 0; i < 20; i++) {
		virtual_ns += 40 * SECOND; /* the timer comes back to it */
		turn_until(has_bytes, &paced);
		paced.want_bytes = paced.in.len + 100;
	}
	assert_true(paced.in.len > 2000);
	peer_close(&paced);
	peer_close(&quick);
}

static bool nobody_is_left(void *ctx)
{
	struct control_client client[8];

	(void)ctx;
	return server_clients(server, client, 8) == 0;
}

static void clients_that_vanish_in_a_batch_leave_nothing_behind(void **state)
{
	(void)state;
	publish_step(16);
	for (int i = 0; i < 30; i++) {
		struct peer peer;

		if (i % 2)
			peer_unix(&peer);
		else
			peer_tcp(&peer, 4096);
		peer_want(&peer);
		turn(i % 5);
		publish_step(16);
		peer_close(&peer);
		turn(3);
	}
	assert_true(turn_until(nobody_is_left, NULL));
}

/* Addresses */

static void expect_refused(const char *address, const char *because)
{
	struct config other = config;
	char error[320] = "";
	struct server *refused;

	other.listen.natives = 1;
	snprintf(other.listen.native[0], CONFIG_TEXT_MAX, "%s", address);
	refused = server_create(&loop, &other, publisher, &host, error);
	if (refused)
		fail_msg("accepted: %s", address);
	if (!strstr(error, because))
		fail_msg("%s: says '%s', not '%s'", address, error, because);
}

static void every_impossible_address_has_its_sentence(void **state)
{
	char text[256], path[128];

	(void)state;
	expect_refused("tcp:0.0.0.0:0", "loopback");
	expect_refused("tcp:192.168.0.1:7878", "loopback");
	expect_refused("tcp:[::]:7878", "loopback");
	expect_refused("unix:/nonexistent/sock", "does not exist");
	expect_refused(server_address(server, 1), "somebody listens");
	expect_refused(server_address(server, 0), "somebody listens");
	snprintf(text, sizeof(text), "unix:/tmp/%0120d", 1);
	expect_refused(text, "108");
	snprintf(path, sizeof(path), "%s/file", directory);
	close(open(path, O_CREAT | O_WRONLY, 0600));
	snprintf(text, sizeof(text), "unix:%s", path);
	expect_refused(text, "no socket");
	assert_int_equal(access(path, F_OK), 0);
	unlink(path);
}

static void a_dead_sockets_file_is_replaced_and_the_mode_is_0660(void **state)
{
	struct sockaddr_un address = {.sun_family = AF_UNIX};
	struct config other = config;
	struct server *second;
	char error[320] = "";
	struct stat st;
	int fd = socket(AF_UNIX, SOCK_STREAM, 0);

	(void)state;
	snprintf(address.sun_path, sizeof(address.sun_path), "%s/dead", directory);
	assert_int_equal(bind(fd, (struct sockaddr *)&address, sizeof(address)), 0);
	close(fd);
	other.listen.natives = 1;
	snprintf(other.listen.native[0], CONFIG_TEXT_MAX, "unix:%s", address.sun_path);
	second = server_create(&loop, &other, publisher, &host, error);
	assert_non_null(second);
	assert_int_equal(stat(address.sun_path, &st), 0);
	assert_int_equal(st.st_mode & 0777, 0660);
	server_stop(second);
	turn(3);
	server_destroy(second);
	assert_int_equal(stat(address.sun_path, &st), -1);
}

#define CLAIM(function) cmocka_unit_test_setup_teardown(function, set_up, tear_down)

int main(void)
{
	const struct CMUnitTest tests[] = {
	    CLAIM(the_first_byte_decides_the_language),
	    CLAIM(a_question_may_come_in_any_pieces),
	    CLAIM(what_changes_something_is_for_the_unix_socket),
	    CLAIM(what_comes_later_is_refused_by_name),
	    CLAIM(who_watches_hears_a_status_a_second_and_events),
	    CLAIM(at_the_limit_each_is_told_so_in_its_language_and_closed),
	    CLAIM(more_than_the_doorstep_holds_are_just_closed),
	    CLAIM(a_silent_connection_is_closed_after_ten_seconds),
	    CLAIM(garbage_is_answered_by_a_reason_and_the_end),
	    CLAIM(a_frame_only_a_server_sends_ends_the_connection),
	    CLAIM(a_line_without_end_is_refused),
	    CLAIM(a_client_that_asks_and_does_not_read_blocks_only_itself),
	    CLAIM(of_a_thousand_messages_a_turn_hears_a_few_and_later_turns_the_rest),
	    CLAIM(a_status_is_built_ten_times_a_second_at_most),
	    CLAIM(no_status_is_built_for_a_client_that_has_no_room_for_it),
	    CLAIM(a_client_that_ends_its_half_still_gets_its_answers),
	    CLAIM(a_stalled_client_does_not_hold_the_others_and_converges_when_it_reads),
	    CLAIM(news_go_past_those_who_cannot_take_any),
	    CLAIM(clients_that_vanish_in_a_batch_leave_nothing_behind),
	    CLAIM(every_impossible_address_has_its_sentence),
	    CLAIM(a_dead_sockets_file_is_replaced_and_the_mode_is_0660),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

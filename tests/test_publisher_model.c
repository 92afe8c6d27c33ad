/* Laws L4, L6 through real sockets: clients that stall, leave, come back and change their wishes at random hold at every
 * COMMIT, patch by patch and byte for byte, what they wanted of the map of that step; who stalls while twenty of its
 * buffers change is counted behind and skips; memory stays within the stated limits. */
#include "tests/publisher_bed.h"

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include "daemon/server.h"

#define PEERS        12
#define BUFFER_BYTES 16384
#define MISSED       (20 * BUFFER_BYTES)
#define STEP_NS      13333333 /* 75 rows a second */
#define PINNED_MAX   (96u << 10)

struct peer {
	struct reader reader;
	int fd; /* -1: not there */
	bool tcp;
	uint64_t id;         /* the server's name for it */
	bool stalls;         /* does not read */
	uint64_t stalled_at; /* bytes published when it stopped */
	uint64_t step_at;    /* its step then */
	unsigned commits_at;
};

struct crowd {
	char directory[64];
	uv_loop_t loop;
	struct config config;
	struct publisher *publisher;
	struct server *server;
	int64_t now_ns;
	struct history history;
	struct patch_key robot;
	double x_m;
	uint64_t published; /* bytes of patches */
	struct peer peer[PEERS];
	/* What was seen. */
	unsigned long_stalls, merged, aborted, commits, joined, closed, regions, coded, packed;
	size_t most_pinned, most_bytes;
};

static int64_t host_now(void *ctx)
{
	return ((struct crowd *)ctx)->now_ns;
}

static void host_status(void *ctx, struct buffer *ret)
{
	(void)ctx;
	buffer_printf(ret, "{}");
}

static bool host_command(void *ctx, const struct control_command *command, char error[200])
{
	(void)ctx;
	(void)command;
	(void)error;
	return true;
}

static void host_log(void *ctx, int priority, const char *text)
{
	(void)ctx;
	(void)priority;
	(void)text;
}

static void begin_crowd(struct crowd *m, uint64_t seed)
{
	struct publisher_params params = {.cell_m = CELL_M, .pinned_max = PINNED_MAX, .window = 1 + seed * 7 % 60};
	struct server_host host = {
	    .ctx = m, .now = host_now, .status = host_status, .command = host_command, .log = host_log};
	char error[320] = "";

	memset(m, 0, sizeof(*m));
	random_state = seed * 0x9e3779b97f4a7c15ull + 1;
	snprintf(m->directory, sizeof(m->directory), "/tmp/facet-model-XXXXXX");
	assert_non_null(mkdtemp(m->directory));
	config_default(&m->config);
	m->config.listen.natives = 2;
	snprintf(m->config.listen.native[0], CONFIG_TEXT_MAX, "unix:%s/sock", m->directory);
	snprintf(m->config.listen.native[1], CONFIG_TEXT_MAX, "tcp:127.0.0.1:0");
	m->config.listen.send_buffer = BUFFER_BYTES;
	m->config.listen.clients = 2 * PEERS;
	uv_loop_init(&m->loop);
	m->now_ns = 1000000000;
	m->history.side = 400;
	m->publisher = publisher_create(&params);
	m->server = server_create(&m->loop, &m->config, m->publisher, &host, error);
	if (!m->server)
		fail_msg("%s", error);
	for (int i = 0; i < PEERS; i++)
		m->peer[i].fd = -1;
}

static void end_crowd(struct crowd *m)
{
	struct publisher_stats stats;

	publisher_stats(m->publisher, &stats);
	m->most_bytes = stats.clients_peak_bytes;
	server_stop(m->server);
	uv_run(&m->loop, UV_RUN_DEFAULT);
	server_destroy(m->server);
	publisher_stats(m->publisher, &stats);
	assert_int_equal(stats.pinned, 0);
	publisher_destroy(m->publisher);
	assert_int_equal(uv_loop_close(&m->loop), 0);
	rmdir(m->directory);
}

static void turn(struct crowd *m)
{
	for (int i = 0; i < 4; i++)
		uv_run(&m->loop, UV_RUN_NOWAIT);
}

/* Peers */

static int connect_peer(struct crowd *m, bool tcp)
{
	struct sockaddr_un path = {.sun_family = AF_UNIX};
	struct sockaddr_in port = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
	int fd = socket(tcp ? AF_INET : AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0), size = BUFFER_BYTES, r;

	snprintf(path.sun_path, sizeof(path.sun_path), "%s/sock", m->directory);
	port.sin_port = htons((uint16_t)atoi(strrchr(server_address(m->server, 1), ':') + 1));
	setsockopt(fd, SOL_SOCKET, SO_RCVBUF, &size, sizeof(size));
	r = tcp ? connect(fd, (struct sockaddr *)&port, sizeof(port))
	        : connect(fd, (struct sockaddr *)&path, sizeof(path));
	assert_int_equal(r, 0);
	fcntl(fd, F_SETFL, O_NONBLOCK);
	return fd;
}

static struct native_want random_wish(void)
{
	struct native_want want = {.flags = (uint8_t)(pick(2) * NATIVE_WANT_CODED | pick(2) * NATIVE_WANT_ZSTD)};
	float low = (float)((pick(KEYS) - KEYS / 2.0) * PATCH_M), width = (float)(pick(KEYS) * PATCH_M / 2);
	uint32_t kind = pick(3);

	if (pick(4) == 0)
		want.bytes_per_s = 200000 + pick(2000000);
	if (kind == 1) {
		want.flags |= NATIVE_WANT_BOX;
		memcpy(want.region, (float[6]){low, -1, -100, low + width, 1, 100}, sizeof(want.region));
	} else if (kind == 2) {
		want.flags |= NATIVE_WANT_RADIUS;
		want.region[0] = 6 + width;
	}
	return want;
}

static void say_want(struct crowd *m, struct peer *peer, const struct native_want *want)
{
	struct buffer b = {0};
	ssize_t n;

	native_put_want(&b, want);
	n = send(peer->fd, b.data, b.len, MSG_NOSIGNAL);
	/* One that was too slow may have been closed before it has read so. */
	assert_true(n == (ssize_t)b.len || (n < 0 && (errno == EPIPE || errno == ECONNRESET)));
	buffer_finish(&b);
	peer->reader.want = *want;
	peer->reader.want.flags |= NATIVE_WANT_ZSTD; /* may be on its way from before */
	reader_wants(&peer->reader, m->robot);
}

static uint64_t newest_id(struct crowd *m)
{
	struct control_client client[4 * PEERS];
	size_t n = server_clients(m->server, client, 4 * PEERS);
	uint64_t id = 0;

	for (size_t i = 0; i < n; i++)
		id = client[i].id > id ? client[i].id : id;
	return id;
}

static void join(struct crowd *m, struct peer *peer)
{
	struct native_want want = random_wish();

	memset(peer, 0, sizeof(*peer));
	peer->tcp = pick(2);
	peer->fd = connect_peer(m, peer->tcp);
	peer->reader.region = calloc(REGIONS_MAX, sizeof(*peer->reader.region));
	peer->reader.mirror = native_mirror_create();
	assert_true(peer->reader.region && peer->reader.mirror);
	say_want(m, peer, &want);
	turn(m);
	peer->id = newest_id(m);
	m->joined++;
}

static void leave(struct crowd *m, struct peer *peer)
{
	close(peer->fd);
	peer->fd = -1;
	m->commits += peer->reader.commits;
	m->aborted += peer->reader.aborts;
	m->coded += peer->reader.coded;
	m->packed += peer->reader.packed;
	m->regions += (unsigned)peer->reader.regions;
	reader_close(&peer->reader);
	turn(m);
}

/* Reads at most `capacity` bytes; false: the server closed it. */
static bool read_some(struct crowd *m, struct peer *peer, size_t capacity)
{
	uint8_t bytes[8192];
	ssize_t n = 1;

	while (capacity > 0 && n > 0) {
		n = recv(peer->fd, bytes, capacity < sizeof(bytes) ? capacity : sizeof(bytes), 0);
		if (n > 0) {
			buffer_append(&peer->reader.in, bytes, (size_t)n);
			capacity -= (size_t)n;
		}
	}
	reader_frames(&peer->reader, &m->history);
	return n > 0 || (n < 0 && errno == EAGAIN);
}

static bool find_client(struct crowd *m, uint64_t id, struct control_client *ret)
{
	struct control_client client[4 * PEERS];
	size_t n = server_clients(m->server, client, 4 * PEERS);

	for (size_t i = 0; i < n; i++)
		if (client[i].id == id) {
			*ret = client[i];
			return true;
		}
	return false;
}

/* The stall of a peer ends once it has missed enough: the server's own counters say so. */
static void end_stall(struct crowd *m, struct peer *peer)
{
	struct control_client client;

	if (m->published - peer->stalled_at < MISSED)
		return;
	peer->stalls = false;
	if (!find_client(m, peer->id, &client))
		return; /* closed for being too slow */
	if (!(peer->reader.want.flags & (NATIVE_WANT_BOX | NATIVE_WANT_RADIUS | NATIVE_WANT_CODED)))
		assert_true(client.behind > 0);
	m->long_stalls += client.behind > 0; /* the sockets may have swallowed a small region's changes */
}

static void begin_stall(struct crowd *m, struct peer *peer)
{
	peer->stalls = true;
	peer->stalled_at = m->published;
	peer->step_at = m->history.step;
	peer->commits_at = peer->reader.commits;
}

static void act(struct crowd *m, struct peer *peer)
{
	if (peer->fd < 0) {
		if (pick(8) == 0)
			join(m, peer);
		return;
	}
	if (pick(60) == 0) {
		leave(m, peer);
		return;
	}
	if (peer->stalls) {
		end_stall(m, peer);
	} else if (pick(40) == 0) {
		begin_stall(m, peer);
	} else if (pick(30) == 0) {
		struct native_want want = random_wish();

		say_want(m, peer, &want);
		turn(m);
	}
	reader_wants(&peer->reader, m->robot);
	if (!peer->stalls && !read_some(m, peer, pick(4) == 0 ? pick(20000) : 1 << 20)) {
		m->closed++;
		leave(m, peer);
	}
}

/* A step of the map: what changed is published, the robot moves on. */
static void advance_crowd(struct crowd *m, uint32_t changes)
{
	struct publisher_stats stats;

	advance_history(&m->history, m->publisher, changes);
	for (uint32_t i = 0; i < KEYS; i++)
		if (m->history.version[m->history.step][i] == m->history.step)
			m->published += 50 + 9 * (3 + m->history.content[m->history.step][i] % m->history.side);
	m->now_ns += STEP_NS;
	m->x_m += (pick(41) - 20.0) * 0.02;
	publisher_robot(m->publisher, m->x_m, 0.4, 5.8);
	interest_follow(&m->robot, CELL_M, m->x_m, 0.4, 5.8);
	for (int i = 0; i < PEERS; i++)
		if (m->peer[i].fd >= 0)
			reader_wants(&m->peer[i].reader, m->robot);
	server_wake(m->server);
	turn(m);
	publisher_stats(m->publisher, &stats);
	m->most_pinned = stats.pinned > m->most_pinned ? stats.pinned : m->most_pinned;
	assert_true(stats.pinned <= PINNED_MAX + PEERS * 5000); /* beside the limit: frames half written */
	assert_true(stats.clients_peak_bytes <= PUBLISHER_CLIENT_MAX);
}

/* Everybody who is still there reads on: all arrive at the newest step. */
static void converge(struct crowd *m, struct peer *peer)
{
	const struct timespec pause = {.tv_nsec = 200000};

	while (native_mirror_step(peer->reader.mirror) != m->history.step || peer->reader.commits == 0 ||
	       !is_mirror_of(&m->history, peer->reader.mirror, &peer->reader.region[peer->reader.regions - 1])) {
		m->now_ns += 10000000;
		server_wake(m->server); /* a limited rate is asked again */
		turn(m);
		if (!read_some(m, peer, 1 << 20))
			return; /* it had been closed */
		nanosleep(&pause, NULL);
	}
	if (peer->reader.commits - peer->commits_at < m->history.step - peer->step_at)
		m->merged++;
}

static void run_crowd(struct crowd *m, uint64_t seed)
{
	begin_crowd(m, seed);
	while (m->history.step < STEPS) {
		advance_crowd(m, 5 + (uint32_t)(seed * 13 % 40));
		for (int i = 0; i < PEERS; i++)
			act(m, &m->peer[i]);
	}
	for (int i = 0; i < PEERS; i++)
		if (m->peer[i].fd >= 0) {
			converge(m, &m->peer[i]);
			leave(m, &m->peer[i]);
		}
	end_crowd(m);
}

static void clients_of_any_behaviour_hold_their_part_of_every_step(void **state)
{
	static struct crowd m;
	struct crowd sum = {0};

	(void)state;
	for (uint64_t seed = 1; seed <= 5; seed++) {
		run_crowd(&m, seed);
		sum.long_stalls += m.long_stalls;
		sum.merged += m.merged;
		sum.aborted += m.aborted;
		sum.commits += m.commits;
		sum.joined += m.joined;
		sum.closed += m.closed;
		sum.regions += m.regions;
		sum.coded += m.coded;
		sum.packed += m.packed;
		sum.most_pinned = m.most_pinned > sum.most_pinned ? m.most_pinned : sum.most_pinned;
		sum.most_bytes = m.most_bytes > sum.most_bytes ? m.most_bytes : sum.most_bytes;
	}
	printf("note: %u clients, %u commits judged patch by patch, %u regions, %u stalls of 20 buffers and more, %u "
	       "batches "
	       "aborted, %u closed\n",
	       sum.joined, sum.commits, sum.regions, sum.long_stalls, sum.aborted, sum.closed);
	printf("note: a client cost at most %zu of %u bytes, pins %zu of %u\n", sum.most_bytes, PUBLISHER_CLIENT_MAX,
	       sum.most_pinned, PINNED_MAX);
	assert_true(sum.long_stalls >= 20 && sum.merged + sum.aborted >= 10 && sum.aborted > 0 && sum.commits > 2000);
	assert_true(sum.coded > 100 && sum.packed > 100 && sum.regions > 500);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(clients_of_any_behaviour_hold_their_part_of_every_step),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

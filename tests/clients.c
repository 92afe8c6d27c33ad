/* Laws L4, L6 end to end: one client that reads everything, one that joins in the middle and two that stop reading for a
 * while (unix socket; TCP with a small receive buffer) hold whole meshes at every COMMIT and end with the same bytes.
 *
 *   clients UNIX_PATH TCP_PORT OUT_DIR JOIN_S STALL_FROM_S STALL_S
 *
 * Every mesh a client ever held is written to OUT_DIR/STEP.ply (once a step: two clients with different meshes of one
 * step are an error) and told on stdout; the server's status is kept from within the stall. */
#include <arpa/inet.h>
#include <errno.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include "core/native.h"

#define CLIENTS 4
#define QUIET_S 4   /* no new step for so long, and everyone at the same one: the end */
#define LIMIT_S 150 /* then it has failed */
#define MISSED \
	(20 * 16384) /* bytes that the stall lasts for at least: twenty send buffers of the daemon's configuration */
#define STEPS_MAX 100000

struct client {
	const char *name;
	bool tcp, stalls, late;
	int fd;
	struct native_mirror *mirror;
	uint8_t *buf;
	size_t len;
	unsigned commits;
};

struct test {
	const char *unix_path, *dir;
	int port;
	double join_s, stall_s, stall_for_s;
	size_t missed;      /* bytes that the first client got since the stall began */
	bool stalled, over; /* the stall began; it ended */
	struct client client[CLIENTS];
	char (*hash)[65]; /* [STEPS_MAX] of the mesh of each step, as first seen */
	uint64_t newest;
	double newest_at_s;
};

static double now_s(void)
{
	struct timespec t;
	clock_gettime(CLOCK_MONOTONIC, &t);
	return (double)t.tv_sec + (double)t.tv_nsec * 1e-9;
}

static void fail(const char *what, const char *why)
{
	printf("clients: %s: %s\n", what, why);
	exit(1);
}

static int connect_unix(const char *path)
{
	struct sockaddr_un a = {.sun_family = AF_UNIX};
	int fd = socket(AF_UNIX, SOCK_STREAM, 0);
	snprintf(a.sun_path, sizeof a.sun_path, "%s", path);
	if (connect(fd, (struct sockaddr *)&a, sizeof a) < 0)
		fail(path, strerror(errno));
	return fd;
}

static int connect_tcp(int port)
{
	struct sockaddr_in a = {
	    .sin_family = AF_INET, .sin_port = htons((uint16_t)port), .sin_addr = {htonl(INADDR_LOOPBACK)}};
	int fd = socket(AF_INET, SOCK_STREAM, 0), small = 4096;
	setsockopt(fd, SOL_SOCKET, SO_RCVBUF, &small, sizeof small);
	if (connect(fd, (struct sockaddr *)&a, sizeof a) < 0)
		fail("tcp", strerror(errno));
	return fd;
}

static void join(struct test *t, struct client *c)
{
	struct buffer b = {0};
	c->fd = c->tcp ? connect_tcp(t->port) : connect_unix(t->unix_path);
	c->mirror = native_mirror_create();
	c->buf = malloc(NATIVE_TO_CLIENT_MAX + NATIVE_HEAD);
	native_put_want(&b, &(struct native_want){0});
	if (write(c->fd, b.data, b.len) != (ssize_t)b.len)
		fail(c->name, "cannot ask for the map");
	buffer_finish(&b);
}

static void dump(struct test *t, struct client *c, uint64_t step)
{
	char path[512];
	struct model model;
	struct buffer b = {0};
	snprintf(path, sizeof path, "%s/%llu.ply", t->dir, (unsigned long long)step);
	if (model_weld(native_mirror_patches(c->mirror), native_mirror_hello(c->mirror)->cell_m, &model) < 0)
		fail(c->name, "out of memory");
	ply_write(&model, false, &b);
	FILE *f = fopen(path, "wb");
	if (!f || fwrite(b.data, 1, b.len, f) != b.len || fclose(f) != 0)
		fail(path, strerror(errno));
	buffer_finish(&b);
	model_finish(&model);
}

static void committed(struct test *t, struct client *c)
{
	char hash[65];
	uint64_t step = native_mirror_step(c->mirror);
	if (step >= STEPS_MAX)
		fail(c->name, "more steps than this test is for");
	c->commits++;
	patch_store_hash(native_mirror_patches(c->mirror), hash);
	if (!t->hash[step][0]) {
		memcpy(t->hash[step], hash, sizeof hash);
		dump(t, c, step);
	} else if (strcmp(hash, t->hash[step]) != 0) {
		fail(c->name, "holds another mesh of a step than the client that saw it first");
	}
	if (step > t->newest) {
		t->newest = step;
		t->newest_at_s = now_s();
	}
}

static void feed(struct test *t, struct client *c)
{
	size_t at = 0;
	for (;;) {
		ssize_t n = native_scan(c->buf + at, c->len - at, NATIVE_TO_CLIENT_MAX);
		struct native_message message;
		char error[128] = "";
		if (n < 0)
			fail(c->name, "the stream is not framed");
		if (n == 0)
			break;
		int r = native_decode(c->buf + at, (size_t)n, &message, error);
		if (r == 0)
			r = native_mirror_apply(c->mirror, &message, error);
		if (r < 0)
			fail(c->name, error);
		if (r == 1)
			committed(t, c);
		at += (size_t)n;
	}
	memmove(c->buf, c->buf + at, c->len - at);
	c->len -= at;
}

static void receive(struct test *t, struct client *c)
{
	ssize_t n = read(c->fd, c->buf + c->len, NATIVE_TO_CLIENT_MAX + NATIVE_HEAD - c->len);
	if (n <= 0)
		fail(c->name, n ? strerror(errno) : "closed by the server");
	c->len += (size_t)n;
	if (c == &t->client[0] && t->stalled)
		t->missed += (size_t)n;
	feed(t, c);
}

/* The server's own word that somebody is behind, just before the stall ends. */
static void keep_status(struct test *t)
{
	char path[512];
	static char text[65536];
	size_t len = 0;
	int fd = connect_unix(t->unix_path);
	if (write(fd, "?STATUS\n", 8) != 8)
		fail("status", strerror(errno));
	while (len + 1 < sizeof text && !(strstr(text, "\"STATUS\"") && text[len - 1] == '\n')) {
		ssize_t n = read(fd, text + len, sizeof text - 1 - len);
		if (n <= 0)
			fail("status", "no answer");
		len += (size_t)n;
		text[len] = 0;
	}
	close(fd);
	snprintf(path, sizeof path, "%s/status.json", t->dir);
	FILE *f = fopen(path, "w");
	if (!f || fwrite(text, 1, len, f) != len || fclose(f) != 0)
		fail(path, strerror(errno));
}

/* The stall lasts its time, and until so much has changed that it means something. */
static bool stalling(struct test *t, double s)
{
	if (s < t->stall_s || t->over)
		return false;
	t->stalled = true;
	if (s < t->stall_s + t->stall_for_s || t->missed < MISSED)
		return true;
	keep_status(t);
	t->over = true;
	return false;
}

static bool ended(const struct test *t)
{
	if (!t->over || now_s() - t->newest_at_s < QUIET_S)
		return false;
	for (int i = 0; i < CLIENTS; i++)
		if (!t->client[i].mirror || native_mirror_step(t->client[i].mirror) != t->newest)
			return false;
	return true;
}

static void run(struct test *t)
{
	double start = now_s();
	for (;;) {
		double s = now_s() - start;
		bool stall = stalling(t, s);
		struct pollfd p[CLIENTS];
		for (int i = 0; i < CLIENTS; i++) {
			struct client *c = &t->client[i];
			if (!c->mirror && (!c->late || s >= t->join_s))
				join(t, c);
			p[i] = (struct pollfd){c->mirror && !(stall && c->stalls) ? c->fd : -1, POLLIN, 0};
		}
		if (ended(t))
			return;
		if (s > LIMIT_S)
			fail("the end", "the clients did not all come to the same step");
		if (poll(p, CLIENTS, 100) > 0)
			for (int i = 0; i < CLIENTS; i++)
				if (p[i].fd >= 0 && p[i].revents)
					receive(t, &t->client[i]);
	}
}

int main(int argc, char **argv)
{
	if (argc != 7) {
		fprintf(stderr, "clients: UNIX_PATH TCP_PORT OUT_DIR JOIN_S STALL_FROM_S STALL_S\n");
		return 2;
	}
	struct test t = {.unix_path = argv[1],
	                 .port = atoi(argv[2]),
	                 .dir = argv[3],
	                 .join_s = atof(argv[4]),
	                 .stall_s = atof(argv[5]),
	                 .stall_for_s = atof(argv[6]),
	                 .client = {{.name = "reads everything"},
	                            {.name = "stalls, unix", .stalls = true},
	                            {.name = "stalls, tcp", .tcp = true, .stalls = true},
	                            {.name = "joins late", .late = true}}};
	t.hash = calloc(STEPS_MAX, sizeof *t.hash);
	run(&t);
	for (int i = 0; i < CLIENTS; i++) {
		char hash[65];
		patch_store_hash(native_mirror_patches(t.client[i].mirror), hash);
		printf("%s: %u commits, step %llu, %s\n", t.client[i].name, t.client[i].commits,
		       (unsigned long long)native_mirror_step(t.client[i].mirror), hash);
		if (strcmp(hash, t.hash[t.newest]) != 0)
			fail(t.client[i].name, "ends with other bytes");
	}
	if (t.client[1].commits >= t.client[0].commits || t.client[2].commits >= t.client[0].commits)
		fail("the stall", "a client that stopped reading saw every commit: it was never behind");
	return 0;
}

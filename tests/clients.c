/* Laws L4, L6 end to end: one client that reads everything, one that joins in the middle, two that stop reading for a
 * while (unix socket; TCP with a small receive buffer), and eight that stall, leave, come back and change their wishes
 * (coded, compressed, limited, a box, a radius) at random hold whole meshes at every COMMIT and end with the same bytes, or
 * their part of them.
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
#include "daemon/interest.h"

#define FIXED   4 /* clients with a part to play; the others act at random */
#define CLIENTS 12
/* No new step for so long, and everyone at the same one: the end. The look-ahead is folded a second after the last row. */
#define QUIET_S 8.0
#define LIMIT_S 900 /* then it has failed */
#define MISSED \
	(20 * 16384) /* bytes that the stall lasts for at least: twenty send buffers of the daemon's configuration */
#define STEPS_MAX 100000

struct client {
	const char *name;
	bool tcp, stalls, late, acts;
	int fd;
	struct native_mirror *mirror;
	uint8_t *buf;
	size_t len;
	unsigned commits;
	struct native_want want;
	double act_s; /* when a random one does something next */
	bool pauses;
	unsigned unanswered; /* wishes of this connection of which it is not known whether the server has read them */
	bool undecided;      /* the batch began before that was known of the last one: it may follow an earlier wish */
};

/* What some client held of a key at a version: the bytes of a version never differ. */
struct known {
	struct patch_key key;
	uint64_t version, hash;
	bool used;
};
#define KNOWN_MAX (1u << 18)

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
	struct known *known; /* [KNOWN_MAX] by key and version */
	size_t knowns;
	uint64_t random;
	unsigned joins, wishes, pauses, parts, wholes, undecided;
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

static uint32_t pick(struct test *t, uint32_t n) /* 0 .. n - 1; xorshift */
{
	t->random ^= t->random << 13;
	t->random ^= t->random >> 7;
	t->random ^= t->random << 17;
	return (uint32_t)(t->random >> 33) % n;
}

static void wish(struct test *t, struct client *c)
{
	float x = (float)pick(t, 100) / 10 - 5, y = (float)pick(t, 100) / 10 - 5;
	uint32_t kind = pick(t, 3);

	c->want =
	    (struct native_want){.flags = (uint8_t)(pick(t, 2) * NATIVE_WANT_CODED | pick(t, 2) * NATIVE_WANT_ZSTD),
	                         .bytes_per_s = pick(t, 3) == 0 ? 300000 + pick(t, 2000000) : 0};
	if (kind == 1) {
		c->want.flags |= NATIVE_WANT_BOX;
		memcpy(c->want.region, (float[6]){x - 3, y - 3, -1, x + 3, y + 3, 1.5f}, sizeof c->want.region);
	} else if (kind == 2) {
		c->want.flags |= NATIVE_WANT_RADIUS;
		c->want.region[0] = 1 + (float)pick(t, 50) / 10;
	}
	t->wishes++;
}

static void say(struct client *c, struct buffer *b)
{
	ssize_t n = send(c->fd, b->data, b->len, MSG_NOSIGNAL);
	if (n != (ssize_t)b->len && !(c->acts && n < 0 && (errno == EPIPE || errno == ECONNRESET)))
		fail(c->name, "cannot ask for the map");
	buffer_finish(b);
}

static void say_want(struct client *c)
{
	struct buffer b = {0};
	native_put_want(&b, &c->want);
	say(c, &b);
}

/* A wish holds from the next batch on (docs/protocol.md), and what is on its way may follow the wish before. What begins after
 * the answer to a question that was asked after the wish follows the wish. */
static void say_another_want(struct client *c)
{
	static const char question[] = "{\"command\":\"WATCH\",\"enable\":false}";
	struct buffer b = {0};
	native_put_want(&b, &c->want);
	native_put_json(&b, question, sizeof question - 1);
	say(c, &b);
	c->unanswered++;
}

static void note_wish(struct client *c, const struct native_message *message)
{
	static const char answer[] = "{\"class\":\"WATCH\"";
	if (message->type == NATIVE_BEGIN)
		c->undecided = c->unanswered > 0;
	else if (message->type == NATIVE_JSON && message->json.len >= sizeof answer - 1 &&
	         memcmp(message->json.text, answer, sizeof answer - 1) == 0 && c->unanswered > 0)
		c->unanswered--;
}

static void join(struct test *t, struct client *c)
{
	c->fd = c->tcp ? connect_tcp(t->port) : connect_unix(t->unix_path);
	c->mirror = native_mirror_create();
	c->len = 0;
	c->unanswered = 0;
	if (!c->buf)
		c->buf = malloc(NATIVE_TO_CLIENT_MAX + NATIVE_HEAD);
	say_want(c);
	t->joins++;
}

static void leave(struct client *c)
{
	close(c->fd);
	native_mirror_destroy(c->mirror);
	c->mirror = NULL;
}

static bool wants_part(const struct client *c)
{
	return c->want.flags & (NATIVE_WANT_BOX | NATIVE_WANT_RADIUS);
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

static uint64_t hash_patch(const struct patch *patch)
{
	struct buffer b = {0};
	uint64_t h = 14695981039346656037ull;
	native_put_patch(&b, patch);
	for (size_t i = 0; i < b.len; i++)
		h = (h ^ b.data[i]) * 1099511628211ull;
	buffer_finish(&b);
	return h;
}

/* The place of what is known of a key at a version; unused where nobody held it. */
static struct known *find_known(struct test *t, struct patch_key key, uint64_t version)
{
	uint64_t at = (uint32_t)key.x * 73856093ull ^ (uint32_t)key.y * 19349663ull ^ (uint32_t)key.z * 83492791ull;
	at = (at ^ version * 2654435761ull) % KNOWN_MAX;
	while (t->known[at].used && (t->known[at].version != version || patch_key_compare(t->known[at].key, key) != 0))
		at = (at + 1) % KNOWN_MAX;
	return &t->known[at];
}

/* Every patch is what everybody else had of that version. */
static void compare_patches(struct test *t, struct client *c)
{
	struct patch **patch;
	size_t n = patch_store_living(native_mirror_patches(c->mirror), &patch);
	for (size_t i = 0; i < n; i++) {
		struct known *known = find_known(t, patch[i]->key, patch[i]->version);
		uint64_t hash = hash_patch(patch[i]);
		if (known->used && known->hash != hash)
			fail(c->name, "holds other bytes of a version than another client");
		if (!known->used && t->knowns++ == KNOWN_MAX / 2)
			fail(c->name, "more versions than this test is for");
		*known = (struct known){patch[i]->key, patch[i]->version, hash, true};
	}
	free(patch);
}

static void committed(struct test *t, struct client *c)
{
	char hash[65];
	uint64_t step = native_mirror_step(c->mirror);
	if (step >= STEPS_MAX)
		fail(c->name, "more steps than this test is for");
	c->commits++;
	if (c - t->client >= FIXED || c->commits % 8 == 0)
		compare_patches(t, c);
	if (step > t->newest) {
		t->newest = step;
		t->newest_at_s = now_s();
	}
	if (c - t->client >= FIXED) {
		t->parts++;
		t->undecided += c->undecided;
		if (c->undecided || wants_part(c))
			return;
		t->wholes++;
	}
	patch_store_hash(native_mirror_patches(c->mirror), hash);
	if (!t->hash[step][0]) {
		memcpy(t->hash[step], hash, sizeof hash);
		dump(t, c, step);
	} else if (strcmp(hash, t->hash[step]) != 0) {
		fail(c->name, "holds another mesh of a step than the client that saw it first");
	}
}

/* What `c` holds is what of the whole map lies in the region. */
static bool is_part(const struct test *t, const struct client *c, const struct interest *region)
{
	struct patch **all;
	size_t n = patch_store_living(native_mirror_patches(t->client[0].mirror), &all), part = 0;
	bool same = true;
	for (size_t i = 0; i < n && same; i++) {
		const struct patch *held = patch_store_get(native_mirror_patches(c->mirror), all[i]->key);
		bool wanted = interest_has(region, all[i]->key);
		part += wanted;
		same = wanted ? held && held->nt > 0 && held->version == all[i]->version && patch_equal(held, all[i])
		              : !held || held->nt == 0;
	}
	free(all);
	return same && patch_store_count(native_mirror_patches(c->mirror)) == part;
}

/* The robot stands, near the origin: the radius is about one of the patches there. */
static bool holds_its_part(const struct test *t, const struct client *c)
{
	double cell_m = native_mirror_hello(c->mirror)->cell_m;
	struct interest region;
	for (int i = 0; i < 7 * 7 * 7; i++) {
		struct patch_key robot = {i % 7 - 3, i / 7 % 7 - 3, i / 49 - 3};
		if (interest_of(&c->want, cell_m, robot, &region) == 0 && is_part(t, c, &region))
			return true;
		if (!(c->want.flags & NATIVE_WANT_RADIUS))
			return false;
	}
	return false;
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
		struct buffer plain = {0};
		int r = 0;
		if (native_is_packed(c->buf + at))
			r = native_unpack(c->buf + at, (size_t)n, NATIVE_TO_CLIENT_MAX, &plain, error);
		if (r == 0)
			r = plain.len ? native_decode(plain.data, plain.len, &message, error)
			              : native_decode(c->buf + at, (size_t)n, &message, error);
		if (r == 0)
			note_wish(c, &message);
		if (r == 0)
			r = native_mirror_apply(c->mirror, &message, error);
		if (r < 0)
			fail(c->name, error);
		buffer_finish(&plain);
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
	if (n <= 0 && c - t->client >= FIXED) {
		leave(c); /* too slow: it was told, and joins again */
		return;
	}
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

/* A random client does something, until the stall is over: then all read on. */
static void act(struct test *t, struct client *c, double s)
{
	if (t->over)
		c->pauses = false;
	if (t->over && c->mirror)
		return;
	if (s < c->act_s && c->mirror)
		return;
	c->act_s = s + 0.1 + pick(t, 40) / 10.0;
	c->pauses = !t->over && pick(t, 3) == 0;
	t->pauses += c->pauses;
	if (c->mirror && pick(t, 5) == 0)
		leave(c);
	if (!c->mirror || pick(t, 4) == 0) {
		wish(t, c);
		if (c->mirror)
			say_another_want(c);
	}
	if (!c->mirror)
		join(t, c);
}

static bool ended(const struct test *t)
{
	if (!t->over || now_s() - t->newest_at_s < QUIET_S)
		return false;
	for (int i = 0; i < CLIENTS; i++)
		if (!t->client[i].mirror || native_mirror_step(t->client[i].mirror) != t->newest)
			return false;
	for (int i = FIXED; i < CLIENTS; i++)
		if (!holds_its_part(t, &t->client[i]))
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
			if (i >= FIXED)
				act(t, c, s);
			else if (!c->mirror && (!c->late || s >= t->join_s))
				join(t, c);
			p[i] =
			    (struct pollfd){c->mirror && !c->pauses && !(stall && c->stalls) ? c->fd : -1, POLLIN, 0};
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
	t.known = calloc(KNOWN_MAX, sizeof *t.known);
	t.random = 88172645463325252ull;
	for (int i = FIXED; i < CLIENTS; i++)
		t.client[i] = (struct client){.name = "acts at random", .tcp = i % 2, .acts = true};
	setvbuf(stdout, NULL, _IOLBF, 0);
	run(&t);
	printf("note: 8 clients at random joined %u times, wished %u times, paused %u times, %u of their commits "
	       "judged, %u as "
	       "whole meshes, %u between two wishes\n",
	       t.joins - FIXED, t.wishes, t.pauses, t.parts, t.wholes, t.undecided);
	if (t.wholes < 50 || t.undecided > t.parts / 4)
		fail("the clients at random", "too few of their commits say of which wish they are");
	for (int i = 0; i < FIXED; i++) {
		char hash[65];
		patch_store_hash(native_mirror_patches(t.client[i].mirror), hash);
		printf("%s: %u commits, step %llu, %s\n", t.client[i].name, t.client[i].commits,
		       (unsigned long long)native_mirror_step(t.client[i].mirror), hash);
		if (strcmp(hash, t.hash[t.newest]) != 0)
			fail(t.client[i].name, "ends with other bytes");
	}
	if (t.client[1].commits >= t.client[0].commits || t.client[2].commits >= t.client[0].commits)
		fail("the stall", "a client that stopped reading saw every commit: it was never behind");
	for (int i = 0; i < CLIENTS; i++) {
		if (t.client[i].mirror)
			leave(&t.client[i]);
		free(t.client[i].buf);
	}
	free(t.hash);
	free(t.known);
	return 0;
}

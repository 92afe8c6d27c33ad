/* Poses from somebody else's localisation: one JSON object per datagram (pose_line.h), over a unix socket or UDP.
 *
 * UDP is taken on loopback only: whoever may send a pose moves the map, and there is no password in the line. The unix
 * socket has mode 0660. A socket file that nobody listens to is left over from a program that died, and is replaced; one
 * that answers belongs to somebody and is refused; what is no socket is never removed.
 *
 * A device with `fixed` has no link: link_fd answers -1, nothing is ever read, and the assembler takes the pose from
 * config_sweep_params. The supervisor counts a link without a descriptor as streaming for ever. */
#include "drivers/pose_line.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include "config/address.h"
#include "drivers/driver.h"
#include "drivers/jitter.h"
#include "drivers/unix_socket.h"

struct decoder {
	int index;
	int64_t ahead_ns; /* the wall clock, of the times of records: 0 until somebody sets it */
	uint64_t count[POSE_LINE_VERDICTS];
	struct jitter jitter; /* of dated poses: for the status, not in the snapshot */
};

static struct decoder *decoder_create(const struct config_device *device, int index)
{
	struct decoder *d = calloc(1, sizeof *d);

	(void)device;
	if (d)
		d->index = index;
	return d;
}

static void decoder_destroy(struct decoder *d)
{
	free(d);
}

static void decode(struct decoder *d, const struct record *record, const struct record_sink *sink)
{
	enum pose_line_verdict verdict;
	struct pose pose;

	if (record->direction != FROM_DEVICE)
		return;
	verdict = pose_line_parse((const char *)record->bytes, record->len, record->t_ns + d->ahead_ns, &pose);
	d->count[verdict]++;
	if (verdict != POSE_LINE_OK)
		return;
	pose.t_ns -= d->ahead_ns;
	if (pose.t_ns != record->t_ns)
		jitter_note(&d->jitter, record->t_ns - pose.t_ns);
	sink->pose(sink->ctx, d->index, &pose);
}

/* Senders say the wall clock's time. */
static void follow_clock(struct decoder *d, int64_t ahead_ns)
{
	d->ahead_ns = ahead_ns;
}

static void counters(const struct decoder *d, struct decoder_counters *ret)
{
	ret->n = POSE_LINE_VERDICTS;
	for (int i = 0; i < POSE_LINE_VERDICTS; i++) {
		ret->counter[i].name = pose_line_name((enum pose_line_verdict)i);
		ret->counter[i].count = d->count[i];
	}
}

/* A pose without a time says nothing about how it was delayed. */
static void timing(const struct decoder *d, struct decoder_timing *ret)
{
	*ret = (struct decoder_timing){.known = d->jitter.n > 0};
	jitter_percentiles(&d->jitter, &ret->jitter_p50_ns, &ret->jitter_p99_ns);
}

static void state(struct decoder *d, struct state *s)
{
	struct decoder aside = *d;

	state_tag(s, "pose2");
	state_time(s, &aside.ahead_ns);
	for (int i = 0; i < POSE_LINE_VERDICTS; i++)
		state_u64(s, &aside.count[i]);
	if (s->loading)
		*d = s->failed ? (struct decoder){.index = d->index} : aside;
}

struct link {
	int fd;     /* -1: a fixed pose */
	bool bound; /* to a path, which is ours as long as it is this inode */
	char path[sizeof((struct sockaddr_un *)0)->sun_path];
	dev_t dev;
	ino_t ino;
};

static int open_unix(struct link *link, const char *path, char error[160])
{
	struct sockaddr_un address = {.sun_family = AF_UNIX};
	struct stat st;
	int r;

	strcpy(address.sun_path, path);
	link->fd = socket(AF_UNIX, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
	r = link->fd < 0 ? -errno : unix_socket_bind(link->fd, &address);
	if (r) {
		snprintf(error, 160, "unix:%.90s: %s", path,
		         r == -EADDRINUSE ? "somebody listens there already"
		         : r == -ENOTSOCK ? "a file that is no socket stands there"
		                          : strerror(-r));
		return -1;
	}
	strcpy(link->path, path);
	link->bound = lstat(path, &st) == 0;
	if (link->bound) {
		link->dev = st.st_dev;
		link->ino = st.st_ino;
	}
	return 0;
}

static int open_udp(struct link *link, const struct address *address, const char *text, char error[160])
{
	struct sockaddr_storage storage;
	socklen_t len;

	if (address_check_loopback(address, (char[ADDRESS_ERROR_MAX]){0}) < 0 ||
	    address_sockaddr(address, &storage, &len) < 0) {
		snprintf(error, 160, "%.40s: poses are taken on loopback only; use udp:127.0.0.1:PORT or unix:PATH",
		         text);
		return -1;
	}
	link->fd = socket(storage.ss_family, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
	if (link->fd < 0 || bind(link->fd, (struct sockaddr *)&storage, len) < 0) {
		snprintf(error, 160, "%.80s: %s", text, strerror(errno));
		return -1;
	}
	return 0;
}

static void link_close(struct link *link)
{
	struct stat st;

	if (!link)
		return;
	if (link->bound && lstat(link->path, &st) == 0 && st.st_dev == link->dev && st.st_ino == link->ino)
		unlink(link->path);
	if (link->fd >= 0)
		close(link->fd);
	free(link);
}

static struct link *link_open(const struct config_device *device, char error[160])
{
	struct link *link = calloc(1, sizeof *link);
	char why[ADDRESS_ERROR_MAX] = "";
	struct address address;
	int r;

	if (!link) {
		snprintf(error, 160, "out of memory");
		return NULL;
	}
	link->fd = -1;
	if (device->fixed)
		return link;
	r = address_parse(device->listen, ADDRESS_UNIX | ADDRESS_UDP, &address, why);
	if (r)
		snprintf(error, 160, "%.159s", why);
	else if (address.kind == ADDRESS_UNIX)
		r = open_unix(link, address.path, error);
	else
		r = open_udp(link, &address, device->listen, error);
	if (!r)
		return link;
	link_close(link);
	return NULL;
}

static int link_fd(const struct link *link)
{
	return link->fd;
}

/* One datagram; empty ones say nothing and are passed over. A longer one than `cap` arrives cut, and is refused as such. */
static ssize_t link_read(struct link *link, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	ssize_t n = 0;

	(void)t_ns;
	for (int i = 0; i < 16 && n == 0; i++) {
		n = recv(link->fd, buf, cap, 0);
		if (n < 0)
			return errno == EAGAIN || errno == EINTR ? 0 : -errno;
	}
	return n;
}

static ssize_t link_write(struct link *link, const uint8_t *bytes, size_t len)
{
	(void)link;
	(void)bytes;
	return (ssize_t)len; /* nobody to tell */
}

const struct driver driver_pose = {
    .name = "pose",
    .role = ROLE_POSE,
    .decoder_create = decoder_create,
    .decoder_destroy = decoder_destroy,
    .decode = decode,
    .counters = counters,
    .timing = timing,
    .state = state,
    .clock = follow_clock,
    .link_open = link_open,
    .link_fd = link_fd,
    .link_read = link_read,
    .link_write = link_write,
    .link_close = link_close,
};

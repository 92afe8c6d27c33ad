/* The link of all CAN drivers.
 *
 * Times. The kernel stamps a frame when its controller reports it (received, or sent: our own come back then), with the wall
 * clock; so do hubs behind `unix:`. A read takes all frames first and looks at the clocks after that, so that every stamp
 * is older than the look; loop_clock.h turns them into log time whatever was done to the wall clock.
 *
 * Losses. The kernel counts what had no room in our queue and says the count with the next frame. A frame that cannot be
 * sent because the interface's queue is full is dropped here: what is sent periodically is newer next time, and what is
 * asked is asked again by its own deadline. Both come out of the next read as one entry CAN_WIRE_LOST. Nothing is ever
 * kept for later, so nothing can pile up behind a bus that nobody acknowledges.
 *
 * Ends. A socket outlives `ip link set can0 down`, but not the interface. Both end the link: the supervisor opens anew, and
 * an opening of what is not there or down says so. It looks at the interface first, since the kernel would bind to one
 * that is down without a word. */
#include "drivers/can_link.h"

#include <errno.h>
#include <linux/can.h>
#include <linux/can/error.h>
#include <linux/can/raw.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include "drivers/can_bus.h"
#include "drivers/can_interface.h"
#include "drivers/can_words.h"
#include "drivers/loop_clock.h"

#define FRAMES_MAX 32 /* of one read */

/* Not the single bus errors (CAN_ERR_BUSERROR, _PROT, _ACK come with each of them): a line without a partner makes a
 * thousand a second. What they lead to is told by the controller's health. */
#define ERROR_CLASSES \
	(CAN_ERR_TX_TIMEOUT | CAN_ERR_CRTL | CAN_ERR_TRX | CAN_ERR_BUSOFF | CAN_ERR_RESTARTED | CAN_WIRE_ERROR_COUNTERS)
#define CAN_WIRE_ERROR_COUNTERS 0x200u /* too new for some headers */

struct link {
	int fd;
	bool entries; /* messages are entries, else the kernel's frames */
	char connect[CONFIG_TEXT_MAX];
	struct can_link_filter filter[CAN_LINK_FILTERS_MAX];
	int filters;
	struct can_link_calls call;
	struct loop_clock clock;
	uint32_t drops; /* the kernel's count of frames that had no room, as last said */
	uint32_t not_received, not_sent;
	bool health_told;
	int end; /* -errno, said by the next read; 0: it lives */
	struct can_interface interface;
};

static ssize_t kernel_recvmsg(int fd, struct msghdr *message, int flags)
{
	return recvmsg(fd, message, flags);
}

static ssize_t kernel_send(int fd, const void *bytes, size_t len, int flags)
{
	return send(fd, bytes, len, flags);
}

struct link *can_link_over(int fd, const char *connect, const struct can_link_filter *filters, int n,
                           const struct can_link_calls *calls)
{
	struct link *link = calloc(1, sizeof *link);

	if (!link) {
		close(fd);
		return NULL;
	}
	link->fd = fd;
	link->entries = can_words_hub(connect);
	snprintf(link->connect, sizeof link->connect, "%s", connect);
	link->filters = n < CAN_LINK_FILTERS_MAX ? n : CAN_LINK_FILTERS_MAX;
	for (int i = 0; i < link->filters; i++)
		link->filter[i] = filters[i];
	link->call = calls ? *calls : (struct can_link_calls){kernel_recvmsg, kernel_send};
	link->health_told = true;
	loop_clock_start(&link->clock);
	return link;
}

/* Opening */

/* Filters stand before the socket is bound: nothing else gets in between. */
static int set_up(int fd, const struct can_link_filter *filters, int n)
{
	struct can_filter filter[CAN_LINK_FILTERS_MAX];
	const can_err_mask_t errors = ERROR_CLASSES;
	const int on = 1;

	n = n < CAN_LINK_FILTERS_MAX ? n : CAN_LINK_FILTERS_MAX;
	for (int i = 0; i < n; i++)
		filter[i] = (struct can_filter){filters[i].id, filters[i].mask};
	if (setsockopt(fd, SOL_CAN_RAW, CAN_RAW_FILTER, n ? filter : NULL, (socklen_t)((size_t)n * sizeof *filter)) <
	        0 ||
	    setsockopt(fd, SOL_CAN_RAW, CAN_RAW_ERR_FILTER, &errors, sizeof errors) < 0 ||
	    setsockopt(fd, SOL_CAN_RAW, CAN_RAW_RECV_OWN_MSGS, &on, sizeof on) < 0)
		return -errno;
	/* Without these it works: classic frames, times of arrival, losses that nobody counts. */
	setsockopt(fd, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &on, sizeof on);
	setsockopt(fd, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on);
	setsockopt(fd, SOL_SOCKET, SO_RXQ_OVFL, &on, sizeof on);
	return 0;
}

static struct link *open_interface(const char *name, const struct can_link_filter *filters, int n, char error[160])
{
	const int fd = socket(PF_CAN, SOCK_RAW | SOCK_CLOEXEC | SOCK_NONBLOCK, CAN_RAW);
	struct sockaddr_can address = {.can_family = AF_CAN};
	struct link *link;
	int r;

	if (fd < 0) {
		snprintf(error, 160, "%.15s: no CAN sockets (%s): `modprobe can_raw`; a service: AF_CAN", name,
		         strerror(errno));
		return NULL;
	}
	r = can_interface_find(fd, name);
	if (r > 0) {
		address.can_ifindex = r;
		r = set_up(fd, filters, n);
	}
	if (!r && bind(fd, (struct sockaddr *)&address, sizeof address) < 0)
		r = -errno;
	if (r) {
		can_words_opening(name, -r, error);
		close(fd);
		return NULL;
	}
	link = can_link_over(fd, name, filters, n, NULL);
	if (!link) {
		snprintf(error, 160, "out of memory");
		return NULL;
	}
	can_interface_ask(address.can_ifindex, &link->interface);
	link->health_told = !link->interface.health_known || link->interface.health == CAN_BUS_ACTIVE;
	return link;
}

static struct link *open_hub(const char *connect_to, const struct can_link_filter *filters, int n, char error[160])
{
	const char *path = connect_to + 5;
	struct sockaddr_un address = {.sun_family = AF_UNIX};
	struct link *link;
	int fd;

	if (strlen(path) >= sizeof address.sun_path) {
		snprintf(error, 160, "unix:%.90s...: a socket's path is shorter than %zu bytes", path,
		         sizeof address.sun_path);
		return NULL;
	}
	strcpy(address.sun_path, path);
	fd = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
	if (fd < 0 || connect(fd, (struct sockaddr *)&address, sizeof address) < 0) {
		snprintf(error, 160, "unix:%.100s: %s", path,
		         errno == ENOENT || errno == ECONNREFUSED ? "nobody carries CAN frames there; is it started?"
		         : errno == EPROTOTYPE                    ? "it is no socket of sequenced packets"
		                                                  : strerror(errno));
		if (fd >= 0)
			close(fd);
		return NULL;
	}
	link = can_link_over(fd, connect_to, filters, n, NULL);
	if (!link)
		snprintf(error, 160, "out of memory");
	return link;
}

struct link *can_link_open(const char *connect_to, const struct can_link_filter *filters, int n, char error[160])
{
	return can_words_hub(connect_to) ? open_hub(connect_to, filters, n, error)
	                                 : open_interface(connect_to, filters, n, error);
}

int can_link_fd(const struct link *link)
{
	return link->fd;
}

/* Reading */

static bool passes(const struct link *link, uint32_t id)
{
	if (id & CAN_WIRE_ERROR)
		return true;
	for (int i = 0; i < link->filters; i++)
		if ((id & link->filter[i].mask) == (link->filter[i].id & link->filter[i].mask))
			return true;
	return false;
}

/* A frame as the kernel lays it out; its size says of which kind it is. */
static bool take_kernel_frame(const void *bytes, size_t len, struct can_frame_at *ret)
{
	struct canfd_frame f = {0};
	const size_t room = len == CANFD_MTU ? CANFD_MAX_DLEN : CAN_MAX_DLEN;

	if (len != CAN_MTU && len != CANFD_MTU)
		return false;
	memcpy(&f, bytes, len);
	if (f.len > room)
		return false;
	ret->id = f.can_id;
	ret->len = f.len;
	ret->flags = len == CANFD_MTU ? f.flags | CAN_WIRE_FD : 0;
	memcpy(ret->data, f.data, f.len);
	return true;
}

/* The stamp of CLOCK_REALTIME, 0: none; and how many frames had no room so far. */
static int64_t take_control(struct link *link, struct msghdr *message)
{
	int64_t stamp_ns = 0;

	for (struct cmsghdr *c = CMSG_FIRSTHDR(message); c; c = CMSG_NXTHDR(message, c)) {
		struct timespec ts;
		uint32_t drops;

		if (c->cmsg_level != SOL_SOCKET)
			continue;
		if (c->cmsg_type == SCM_TIMESTAMPNS && c->cmsg_len >= CMSG_LEN(sizeof ts)) {
			memcpy(&ts, CMSG_DATA(c), sizeof ts);
			stamp_ns = (int64_t)ts.tv_sec * 1000000000 + ts.tv_nsec;
		} else if (c->cmsg_type == SO_RXQ_OVFL && c->cmsg_len >= CMSG_LEN(sizeof drops)) {
			memcpy(&drops, CMSG_DATA(c), sizeof drops);
			link->not_received += drops - link->drops;
			link->drops = drops;
		}
	}
	return stamp_ns;
}

/* One message: 1 and the frame with its stamp (0: none), 0: one that is not for us, or -errno. */
static int receive(struct link *link, struct can_frame_at *ret)
{
	_Alignas(struct cmsghdr) uint8_t control[CMSG_SPACE(sizeof(struct timespec)) + CMSG_SPACE(sizeof(uint32_t))];
	uint8_t bytes[128];
	struct iovec part = {bytes, sizeof bytes};
	struct msghdr message = {
	    .msg_iov = &part, .msg_iovlen = 1, .msg_control = control, .msg_controllen = sizeof control};
	ssize_t n = link->call.recvmsg(link->fd, &message, MSG_DONTWAIT);

	if (n < 0)
		return -errno;
	if (n == 0)
		return -ECONNRESET; /* a hub that has gone; no interface sends this */
	memset(ret, 0, sizeof *ret);
	if (link->entries) {
		if (can_wire_get(bytes, (size_t)n, ret) != n)
			return 0;
	} else {
		if (!take_kernel_frame(bytes, (size_t)n, ret))
			return 0;
		ret->t_ns = take_control(link, &message);
	}
	return passes(link, ret->id);
}

/* What the interface was when it was opened is no event that an error frame tells: it is told by one of ours. */
static struct can_frame_at first_health(const struct link *link)
{
	struct can_frame_at f = {.id = CAN_WIRE_ERROR, .len = 8};

	f.id |= link->interface.health == CAN_BUS_OFF ? CAN_WIRE_ERROR_BUS_OFF : CAN_WIRE_ERROR_CONTROLLER;
	f.data[1] = link->interface.health == CAN_BUS_PASSIVE   ? CAN_ERR_CRTL_TX_PASSIVE
	            : link->interface.health == CAN_BUS_WARNING ? CAN_ERR_CRTL_TX_WARNING
	                                                        : 0;
	return f;
}

static struct can_frame_at lost_frames(struct link *link)
{
	struct can_frame_at f = {.id = CAN_WIRE_LOST, .len = 8};

	for (int i = 0; i < 4; i++) {
		f.data[i] = (uint8_t)(link->not_received >> 8 * i);
		f.data[4 + i] = (uint8_t)(link->not_sent >> 8 * i);
	}
	link->not_received = link->not_sent = 0;
	return f;
}

/* Log times into the frames, and all of it into `buf`. */
static ssize_t deliver(struct link *link, const struct can_frame_at *told, int tells, struct can_frame_at *frame, int n,
                       uint8_t *buf, int64_t *t_ns)
{
	const int64_t now_ns = loop_clock_look(&link->clock, *t_ns);
	size_t at = 0;

	for (int i = 0; i < n; i++)
		frame[i].t_ns = frame[i].t_ns ? loop_clock_of_wall(&link->clock, frame[i].t_ns) : now_ns;
	for (int i = 0; i < tells; i++) {
		struct can_frame_at f = told[i];

		f.t_ns = n ? frame[0].t_ns : now_ns;
		at += can_wire_put(&f, buf + at);
	}
	for (int i = 0; i < n; i++)
		at += can_wire_put(&frame[i], buf + at);
	*t_ns = n ? frame[n - 1].t_ns : now_ns;
	return (ssize_t)at;
}

/* An end that comes behind frames is said by the next read: the kernel says it once, so it is kept. */
ssize_t can_link_read(struct link *link, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	struct can_frame_at frame[FRAMES_MAX], told[2];
	const size_t room = cap / CAN_WIRE_ENTRY_FD;
	int n = 0, tells = 0, r = 0;
	ssize_t len;

	if (link->end)
		return link->end;
	if (room < 3)
		return -EMSGSIZE;
	if (!link->health_told)
		told[tells++] = first_health(link);
	link->health_told = true;
	for (int i = 0; i < FRAMES_MAX && (size_t)n + 2 < room; i++) {
		r = receive(link, &frame[n]);
		if (r < 0)
			break;
		n += r;
	}
	if (link->not_received || link->not_sent)
		told[tells++] = lost_frames(link);
	len = deliver(link, told, tells, frame, n, buf, t_ns);
	if (r == -EAGAIN)
		loop_clock_drained(&link->clock);
	else if (r < 0 && r != -EINTR)
		link->end = r;
	return len || !link->end ? len : link->end;
}

/* Writing */

static ssize_t send_frame(struct link *link, const struct can_frame_at *f, const uint8_t *entry, size_t len)
{
	struct canfd_frame out = {.can_id = f->id, .len = f->len};
	ssize_t n;

	memcpy(out.data, f->data, f->len);
	out.flags = f->flags & CAN_WIRE_FD ? f->flags : 0;
	do {
		if (link->entries)
			n = link->call.send(link->fd, entry, len, MSG_DONTWAIT | MSG_NOSIGNAL);
		else
			n = link->call.send(link->fd, &out, f->flags & CAN_WIRE_FD ? CANFD_MTU : CAN_MTU,
			                    MSG_DONTWAIT | MSG_NOSIGNAL);
	} while (n < 0 && errno == EINTR);
	return n < 0 ? -errno : n;
}

ssize_t can_link_write(struct link *link, const uint8_t *bytes, size_t len)
{
	struct can_frame_at f;

	for (size_t at = 0; at < len;) {
		uint8_t entry[CAN_WIRE_ENTRY_FD];
		const ssize_t n = can_wire_get(bytes + at, len - at, &f);
		ssize_t r;

		if (n <= 0)
			return -EINVAL;
		f.t_ns = 0; /* the hub stamps */
		r = send_frame(link, &f, entry, can_wire_put(&f, entry));
		if (r == -ENOBUFS || r == -EAGAIN)
			link->not_sent++;
		else if (r < 0)
			return r;
		at += (size_t)n;
	}
	return (ssize_t)len;
}

/* Words */

void can_link_error(const struct link *link, int error, char ret[160])
{
	can_words_end(link->connect, error, ret);
}

void can_link_note(const struct link *link, char ret[160])
{
	ret[0] = '\0';
	if (link->interface.controller && link->interface.restart_ms == 0)
		snprintf(
		    ret, 160,
		    "%.15s has restart-ms 0: after a bus-off it is silent until `ip link set %.15s type can restart`",
		    link->connect, link->connect);
}

void can_link_close(struct link *link)
{
	if (!link)
		return;
	close(link->fd);
	free(link);
}

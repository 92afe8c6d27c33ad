/* A scanner at the end of a TCP connection. Opening answers at once and the kernel goes on connecting: until it stands,
 * reading answers 0 and writing takes 0 bytes; a connect that fails is told by the next of the two. How long a connect
 * may take is the supervisor's business: it hands in the time, so that tests need not wait.
 *
 * A cable that is pulled tells nobody. While streaming the dialogue notices (no telegram for five scans); the kernel's own
 * patience is shortened as well, for what was written and not acknowledged and for a silent peer.
 *
 * On loopback, where simulated scanners live, a connect to a port nobody listens on can meet itself when the kernel picks
 * that same port as its own end; such a connection is refused. */
#include "drivers/cola.h"

#include <errno.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "config/address.h"

enum { KEEPALIVE_IDLE_S = 2, KEEPALIVE_EVERY_S = 1, KEEPALIVE_TRIES = 3, UNACKNOWLEDGED_MS = 5000 };

struct tcp {
	struct link link; /* first */
	int fd;
	bool stands; /* the connection does */
	char peer[ADDRESS_TEXT_MAX];
};

static void set_option(int fd, int level, int option, int value)
{
	setsockopt(fd, level, option, &value, sizeof value); /* where it fails the dialogue's patience remains */
}

static void set_options(int fd)
{
	set_option(fd, IPPROTO_TCP, TCP_NODELAY, 1);
	set_option(fd, SOL_SOCKET, SO_KEEPALIVE, 1);
	set_option(fd, IPPROTO_TCP, TCP_KEEPIDLE, KEEPALIVE_IDLE_S);
	set_option(fd, IPPROTO_TCP, TCP_KEEPINTVL, KEEPALIVE_EVERY_S);
	set_option(fd, IPPROTO_TCP, TCP_KEEPCNT, KEEPALIVE_TRIES);
	set_option(fd, IPPROTO_TCP, TCP_USER_TIMEOUT, UNACKNOWLEDGED_MS);
}

static void tell(const struct tcp *tcp, int error, char ret[160])
{
	const char *peer = tcp->peer;
	if (error == ECONNREFUSED)
		snprintf(ret, 160,
		         "%.60s refuses the connection: is this the scanner's address, and its port 2111 or 2112?",
		         peer);
	else if (error == EHOSTUNREACH || error == ENETUNREACH)
		snprintf(ret, 160,
		         "%.60s cannot be reached: check cable and power, and that this host is in its network", peer);
	else if (error == ETIMEDOUT)
		snprintf(ret, 160, "%.60s does not answer%s: check cable, power and address", peer,
		         tcp->stands ? " any more" : "");
	else if (error == ECONNRESET)
		snprintf(ret, 160, "%.60s broke the connection off: it was restarted, or serves too many clients",
		         peer);
	else if (error == EPIPE)
		snprintf(ret, 160, "%.60s closed the connection: it was restarted, or serves too many clients", peer);
	else
		snprintf(ret, 160, "the connection to %.60s failed (%s)", peer, strerror(error));
}

static void tcp_error(const struct link *link, int error, char ret[160])
{
	tell((const struct tcp *)link, error, ret);
}

static void tcp_close(struct link *link)
{
	struct tcp *tcp = (struct tcp *)link;
	if (tcp->fd >= 0)
		close(tcp->fd);
	free(tcp);
}

/* 0, or an errno. */
static int begin_connect(struct tcp *tcp, const struct address *address)
{
	struct sockaddr_storage to;
	socklen_t len;
	if (address_sockaddr(address, &to, &len) < 0)
		return EINVAL;
	tcp->fd = socket(to.ss_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
	if (tcp->fd < 0)
		return errno;
	set_options(tcp->fd);
	if (connect(tcp->fd, (struct sockaddr *)&to, len) < 0 && errno != EINPROGRESS)
		return errno;
	return 0;
}

static struct link *tcp_open(const struct config_device *config, char error[160])
{
	char why[ADDRESS_ERROR_MAX];
	struct address address;
	struct tcp *tcp = calloc(1, sizeof *tcp);
	if (!tcp) {
		snprintf(error, 160, "out of memory");
		return NULL;
	}
	tcp->link.stream = &cola_tcp;
	tcp->fd = -1;
	int r = address_parse_number(config->connect, COLA_PORT, &address, why);
	if (r) {
		snprintf(error, 160, "%.159s", why);
	} else {
		address_print(&address, tcp->peer);
		memmove(tcp->peer, tcp->peer + 4, strlen(tcp->peer + 4) + 1); /* without its `tcp:` */
		r = begin_connect(tcp, &address);
		if (r)
			tell(tcp, r, error);
	}
	if (!r)
		return &tcp->link;
	tcp_close(&tcp->link);
	return NULL;
}

static int tcp_fd(const struct link *link)
{
	return ((const struct tcp *)link)->fd;
}

/* 1: the connection stands, 0: not yet, -errno: it is itself at the other end. */
static int stands(struct tcp *tcp)
{
	struct sockaddr_storage mine, theirs;
	socklen_t mine_len = sizeof mine, theirs_len = sizeof theirs;
	if (tcp->stands)
		return 1;
	if (getpeername(tcp->fd, (struct sockaddr *)&theirs, &theirs_len) < 0 ||
	    getsockname(tcp->fd, (struct sockaddr *)&mine, &mine_len) < 0)
		return 0;
	if (mine_len == theirs_len && memcmp(&mine, &theirs, mine_len) == 0)
		return -ECONNREFUSED;
	tcp->stands = true;
	return 1;
}

/* While the kernel connects, recv and send answer EAGAIN; what a connect failed with is their errno, once. */
static ssize_t tcp_read(struct link *link, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	struct tcp *tcp = (struct tcp *)link;
	const int r = stands(tcp);
	(void)t_ns;
	if (r < 0 || cap == 0)
		return r < 0 ? r : 0;
	const ssize_t n = recv(tcp->fd, buf, cap, 0);
	if (n > 0)
		return n;
	if (n == 0)
		return -EPIPE; /* the scanner's end is closed */
	return errno == EAGAIN || errno == EINTR ? 0 : -errno;
}

static ssize_t tcp_write(struct link *link, const uint8_t *bytes, size_t len)
{
	struct tcp *tcp = (struct tcp *)link;
	const int r = stands(tcp);
	if (r < 0)
		return r;
	const ssize_t n = send(tcp->fd, bytes, len, MSG_NOSIGNAL);
	if (n >= 0)
		return n;
	return errno == EAGAIN || errno == EINTR ? 0 : -errno;
}

const struct cola_stream cola_tcp = {
    .open = tcp_open,
    .fd = tcp_fd,
    .read = tcp_read,
    .write = tcp_write,
    .error = tcp_error,
    .close = tcp_close,
};

/* Opening where clients connect: unix sockets for a group, TCP on loopback only.
 *
 * Socket activation: systemd may have opened some of them already (sd_listen_fds(3)) and keeps them open while the daemon
 * is restarted, so no client is refused. One that stands where the configuration says is taken as it is, with the rights
 * that its unit gave it, and its file is left alone. One that the configuration does not name is not served: what the daemon
 * listens to is said in one place. */
#include "daemon/listener.h"

#include <errno.h>
#include <fcntl.h>
#include <grp.h>
#include <netinet/in.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <systemd/sd-daemon.h>
#include <unistd.h>

#include "config/config.h"
#include "drivers/unix_socket.h"

#define BACKLOG      64
#define NOT_LOOPBACK "is not on loopback; use 127.0.0.1 here, and ssh -L to reach it from elsewhere"

static int refuse(const struct listener *l, int r, const char *why, char error[320])
{
	snprintf(error, 320, "%.120s: %s", l->name, why);
	return r;
}

static const char *explain_bind(int r)
{
	switch (r) {
	case -EADDRINUSE:
		return "somebody listens there already; stop that program or set another";
	case -ENOTSOCK:
		return "a file that is no socket stands there; remove it or set another";
	case -ENOENT:
	case -ENOTDIR:
		return "the socket's directory does not exist; create it or set another";
	case -EACCES:
	case -EPERM:
	case -EROFS:
		return "may not be bound (no permission); let this user write the directory, or set another";
	case -EADDRNOTAVAIL:
		return "this machine has no such address; set another";
	default:
		return NULL;
	}
}

static int refuse_bind(const struct listener *l, int r, char error[320])
{
	const char *why = explain_bind(r);

	if (why)
		snprintf(error, 320, "%.120s: %s %s", l->name, why, l->key);
	else
		snprintf(error, 320, "%.120s: %s", l->name, strerror(-r));
	return r;
}

static void give_to_group(const char *path, const char *name)
{
	struct group *group = name[0] ? getgrnam(name) : NULL;

	if (group && lchown(path, (uid_t)-1, group->gr_gid) < 0)
		return; /* not a member of it: the daemon's own stays, as documented */
}

int listener_passed(void)
{
	int n = sd_listen_fds(0);

	return n > 0 ? n : 0;
}

static bool stands_there(int fd, const struct address *address)
{
	struct sockaddr_storage where = {0};
	socklen_t len = 0;

	if (address->kind == ADDRESS_UNIX)
		return sd_is_socket_unix(fd, SOCK_STREAM, 1, address->path, 0) > 0;
	return address_sockaddr(address, &where, &len) == 0 && address->port != 0 &&
	       sd_is_socket_sockaddr(fd, SOCK_STREAM, (struct sockaddr *)&where, len, 1) > 0;
}

/* A copy of the descriptor: the one that was passed stays, so that asking again gives the same answer. */
static bool take_passed(struct listener *l)
{
	int n = listener_passed();

	for (int fd = SD_LISTEN_FDS_START; fd < SD_LISTEN_FDS_START + n && !l->passed; fd++) {
		if (!stands_there(fd, &l->address))
			continue;
		l->fd = fcntl(fd, F_DUPFD_CLOEXEC, 0);
		l->passed = l->fd >= 0 && fcntl(l->fd, F_SETFL, fcntl(l->fd, F_GETFL) | O_NONBLOCK) == 0;
	}
	return l->passed;
}

static int open_unix(struct listener *l, const char *group, char error[320])
{
	struct sockaddr_un address = {.sun_family = AF_UNIX};
	struct stat st;
	int r;

	_Static_assert(sizeof(l->address.path) <= sizeof(address.sun_path), "address_parse refuses what would be cut");
	snprintf(address.sun_path, sizeof(address.sun_path), "%s", l->address.path);
	l->fd = socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
	if (l->fd < 0)
		return refuse(l, -errno, strerror(errno), error);
	r = unix_socket_bind(l->fd, &address);
	if (r < 0)
		return refuse_bind(l, r, error);
	give_to_group(l->address.path, group);
	if (lstat(l->address.path, &st) == 0) {
		l->dev = st.st_dev;
		l->ino = st.st_ino;
	}
	return 0;
}

/* The port that port 0 became. */
static void name_port(struct listener *l)
{
	struct sockaddr_storage bound = {0};
	socklen_t len = sizeof(bound);

	if (getsockname(l->fd, (struct sockaddr *)&bound, &len) < 0)
		return;
	if (bound.ss_family == AF_INET)
		l->address.port = ntohs(((struct sockaddr_in *)&bound)->sin_port);
	if (bound.ss_family == AF_INET6)
		l->address.port = ntohs(((struct sockaddr_in6 *)&bound)->sin6_port);
	address_print(&l->address, l->name);
}

static int open_tcp(struct listener *l, char error[320])
{
	struct sockaddr_storage address = {0};
	socklen_t len = 0;
	int on = 1;

	if (address_sockaddr(&l->address, &address, &len) < 0)
		return refuse(l, -EINVAL, "is no address; names are not looked up, write a number like 127.0.0.1",
		              error);
	l->fd = socket(address.ss_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
	if (l->fd < 0)
		return refuse(l, -errno, strerror(errno), error);
	setsockopt(l->fd, SOL_SOCKET, SO_REUSEADDR, &on, sizeof(on));
	if (bind(l->fd, (struct sockaddr *)&address, len) < 0)
		return refuse_bind(l, -errno, error);
	name_port(l);
	return 0;
}

/* `text` is tcp:HOST:PORT or unix:PATH. */
static int open_at(struct listener *l, const char *text, unsigned kinds, const char *key, char error[320])
{
	char sentence[ADDRESS_ERROR_MAX];

	memset(l, 0, sizeof(*l));
	l->fd = -1;
	l->key = key;
	snprintf(l->name, sizeof(l->name), "%.*s", (int)sizeof(l->name) - 1, text);
	if (address_parse(text, kinds, &l->address, sentence) < 0) {
		snprintf(error, 320, "%s: %s", key, sentence);
		return -EINVAL;
	}
	l->local = l->address.kind == ADDRESS_UNIX;
	l->loopback = address_check_loopback(&l->address, sentence) == 0;
	return 0;
}

static int begin_listening(struct listener *l, const char *group, char error[320])
{
	int r;

	if (take_passed(l))
		return 0;
	r = l->local ? open_unix(l, group, error) : open_tcp(l, error);
	if (r == 0 && listen(l->fd, BACKLOG) < 0)
		r = refuse_bind(l, -errno, error);
	if (r < 0)
		listener_close(l);
	return r;
}

int listener_open(struct listener *l, const char *text, const char *group, char error[320])
{
	const int r = open_at(l, text, ADDRESS_UNIX | ADDRESS_TCP, "listen.native", error);

	if (r < 0)
		return r;
	if (!l->loopback)
		return refuse(l, -EINVAL, NOT_LOOPBACK, error);
	return begin_listening(l, group, error);
}

int listener_open_http(struct listener *l, const char *text, char error[320])
{
	char with_word[CONFIG_TEXT_MAX + 4];
	int r;

	snprintf(with_word, sizeof(with_word), "tcp:%s", text);
	r = open_at(l, with_word, ADDRESS_TCP, "listen.http", error);
	return r < 0 ? r : begin_listening(l, "", error);
}

void listener_close(struct listener *l)
{
	struct stat st;

	if (l->fd >= 0)
		close(l->fd);
	l->fd = -1;
	if (l->ino && lstat(l->address.path, &st) == 0 && st.st_dev == l->dev && st.st_ino == l->ino)
		unlink(l->address.path);
	l->ino = 0;
}

/* Listening sockets: those that systemd passes on are taken, the others opened; stale unix sockets are replaced, live ones
 * refused, TCP stays on loopback (decision D11). */
#ifndef FACET_DAEMON_LISTENER_H
#define FACET_DAEMON_LISTENER_H

#include <stdbool.h>
#include <sys/stat.h>

#include "config/address.h"

struct listener {
	int fd;
	bool local;                  /* a unix socket: its clients may change things */
	bool loopback;               /* nobody from another machine reaches it */
	bool passed;                 /* opened by systemd, whose it stays */
	const char *key;             /* of the configuration */
	char name[ADDRESS_TEXT_MAX]; /* as in the configuration, with the port it really has */
	struct address address;
	dev_t dev; /* of the socket's file: only our own is removed */
	ino_t ino;
};

/* `group` of a unix socket; where it does not exist or may not be given, the daemon's own stays. 0, or -errno with one
 * sentence that names the address and what to do. */
int listener_open(struct listener *, const char *text, const char *group, char error[320]);
/* The same for `HOST:PORT` of listen.http, on loopback or not. */
int listener_open_http(struct listener *, const char *text, char error[320]);
void listener_close(struct listener *); /* removes the file of a unix socket, unless systemd passed it on */

/* How many sockets systemd passed on to this process. */
int listener_passed(void);

#endif

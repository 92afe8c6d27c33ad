/* The server: sockets of clients on the loop. Unix sockets and loopback TCP; the first byte a client sends decides between
 * the native protocol and JSON lines. One thread. */
#ifndef FACET_DAEMON_SERVER_H
#define FACET_DAEMON_SERVER_H

#include <uv.h>

#include "config/config.h"
#include "daemon/control.h"
#include "daemon/publisher.h"

#define SERVER_DOORSTEP_MAX 8 /* connections beyond listen.clients that are told why; more are just closed */
#define SERVER_SILENCE_NS   10000000000ll /* a connection that has not spoken by then is closed */
#define SERVER_LINGER_NS    1000000000ll  /* for a client that is to be closed to take the reason */
#define SERVER_TURN_BYTES   (256u << 10)  /* written to one client in one turn of the loop */
#define SERVER_LINES_MAX    (256u << 10)  /* answers waiting for a client of JSON lines: then its questions wait */

struct server_host {
	void *ctx;
	int64_t (*now)(void *ctx);
	/* Appends one STATUS text. */
	void (*status)(void *ctx, struct buffer *ret);
	/* Does a command that changes something; false with a sentence when it cannot. */
	bool (*command)(void *ctx, const struct control_command *, char error[200]);
	void (*log)(void *ctx, int priority, const char *text);
	/* A recording whose bytes the client takes; NULL with a sentence. It ends with the connection, or before. */
	struct recorder *(*stream)(void *ctx, char error[200]);
	void (*stream_end)(void *ctx, struct recorder *);
	bool replays; /* playback may be commanded by everybody who gets in */
};

struct server;

/* Listens where the configuration says. NULL with one sentence that names the address and what to do. */
struct server *server_create(uv_loop_t *, const struct config *, struct publisher *, const struct server_host *,
                             char error[320]);
/* Closes everything; the loop must run until nothing is left of it, then destroy. Removes its unix sockets. */
void server_stop(struct server *);
void server_destroy(struct server *);

void server_wake(struct server *);    /* the publisher has news */
void server_streams(struct server *); /* recordings have bytes for who takes them */
/* The daemon ends: recordings that clients take are to end in order. How many of them are not written out yet. */
size_t server_end_streams(struct server *);
void server_event(struct server *, const char *text, size_t len); /* one JSON text, to all who watch */

/* Where listener `i` listens, e.g. for a port the system chose; NULL beyond the last. */
const char *server_address(const struct server *, int i);

/* How many of its sockets systemd had opened. */
int server_passed(const struct server *);

/* So often was a client looked at because there was news. */
uint64_t server_visits(const struct server *);

/* Fills at most `cap` clients; how many there are. */
size_t server_clients(const struct server *, struct control_client *ret, size_t cap);

#endif

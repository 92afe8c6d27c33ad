/* The web: HTTP and WebSocket on the daemon's loop, at listen.http (docs/protocol.md, section on the web). Plain requests are
 * answered by web_http; over a WebSocket a *language* speaks, chosen by the subprotocol. libwebsockets stays behind this
 * header; without it (no HAVE_WEB) web_create says that it was left out. One thread. */
#ifndef FACET_DAEMON_WEB_H
#define FACET_DAEMON_WEB_H

#include <uv.h>

#include "config/config.h"
#include "daemon/publisher.h"
#include "daemon/server.h"

#define WEB_HEARD_MAX (64u << 10) /* a client's message beyond it: closed, 1009 */
#define WEB_PIECE_MAX \
	(16u << 10) /* asked of a language at once: all that is ever held for a client that does not read */
#define WEB_TURN_BYTES    (256u << 10) /* written to one client in one turn of the loop */
#define WEB_LANGUAGES_MAX 4
#define WEB_REASON_MAX    123 /* bytes of a reason in a close frame (RFC 6455, 5.5) */

struct web;
struct web_connection;

/* What a connection may do. Everybody who got in may read. */
struct web_rights {
	bool may_change; /* every command: it showed the token */
	bool may_play;   /* pause, seek and pace of a replay: the same, or on loopback */
};

/* A piece of a message on its way out; messages go whole, one after the other, in as many pieces as it takes. */
struct web_piece {
	bool text;  /* else binary; what the first piece of a message says holds for all of it */
	bool final; /* the message ends with this piece */
};

/* One language. `ctx` is what web_speak was given, `state` what open returned. All but names, open, next and close may
 * be NULL. No function may close its connection other than by web_close, which only asks for it. */
struct web_language {
	const char *const *names; /* subprotocols, NULL behind the last */
	const char *kind;         /* in STATUS */
	/* Its clients may begin to listen only a moment after the handshake, and a loaded machine makes that moment long: it is
	 * first asked for bytes when the client has answered a ping, or has not within two seconds. */
	bool ping_first;
	/* Somebody connected and agreed on `name`, which stays. NULL when memory is out: closed, 1011. It is first asked for
	 * bytes in a later turn of the loop, some milliseconds after the handshake (some clients listen no sooner). */
	void *(*open)(void *ctx, struct web_connection *, const char *name);
	/* A whole message, at most WEB_HEARD_MAX. */
	void (*hear)(void *state, const uint8_t *data, size_t len, bool text);
	/* Fills at most `cap` bytes (>= 1024) of what is to be said now, which are then said; how many, 0: nothing now. Once
	 * a message is begun, 0 means that it goes on at the next web_wake_one or deadline. An empty message cannot be. */
	size_t (*next)(void *state, uint8_t *buf, size_t cap, int64_t t_ns, struct web_piece *ret);
	/* When to ask again unasked; INT64_MAX: at the next wake. */
	int64_t (*deadline)(const void *state);
	/* An event of the daemon (one JSON text without newline), for those who watch. */
	void (*event)(void *state, const char *text, size_t len);
	/* Fills what it knows; id, kind, address and sent are filled already. */
	void (*stats)(const void *state, struct control_client *ret);
	void (*close)(void *state); /* the connection is gone, whoever ended it */
};

struct snapshots;
struct web_host {
	struct server_host server;
	void (*metrics)(void *ctx, struct buffer *ret); /* the status as text for Prometheus */
	struct snapshots *snapshots;
	bool replays; /* playback may be commanded on loopback */
};

/* Listens where listen.http says. NULL with one sentence that names the address and what to do, and 0 or -errno of why:
 * -EADDRINUSE if somebody is there already, 0 and no sentence where listen.http is empty. */
struct web *web_create(uv_loop_t *, const struct config *, struct publisher *, const struct web_host *, int *ret_why,
                       char error[320]);
/* Adds a language; before web_start. */
void web_speak(struct web *, const struct web_language *, void *ctx);
/* Lets clients in. 0 or -errno with a sentence. */
int web_start(struct web *, char error[320]);
/* Closes everything; the loop must run until nothing is left of it, then destroy. */
void web_stop(struct web *);
void web_destroy(struct web *);

/* All of these take a NULL web, and do nothing then. */
void web_wake(struct web *);                                                    /* the publisher has news */
void web_event(struct web *, const char *text, size_t len);                     /* one JSON text, to all who watch */
size_t web_clients(const struct web *, struct control_client *ret, size_t cap); /* at most `cap`; how many there are */
const char *web_address(const struct web *);                                    /* e.g. http://127.0.0.1:7880/ */
bool web_loopback(const struct web *);
bool web_passed(const struct web *); /* systemd had opened its socket */

/* For languages. */
void web_wake_one(struct web_connection *); /* `next` has something, or soon may */
const struct web_rights *web_rights(const struct web_connection *);
/* Value of `name` in the query of the address, e.g. ?encoding=protobuf, copied to `ret` and cut to `cap` with its NUL; false
 * where it is not. While `open` runs only: the request is forgotten then. */
bool web_query(const struct web_connection *, const char *name, char *ret, size_t cap);
const struct server_host *web_server_host(const struct web_connection *);
const struct buffer *web_status(const struct web_connection *); /* the newest STATUS */
void web_forget_status(const struct web_connection *);          /* it was changed: the next one is built anew */
struct publisher *web_publisher(const struct web_connection *);
/* While on, nothing is heard of the client; its own sends then block, nobody else's. For one that does not read answers. */
void web_hold(struct web_connection *, bool on);
/* Closes with a code of RFC 6455, 7.4.1 and a reason, after the message that is being said; what is left then is not asked
 * for. Twice: the first counts. */
void web_close(struct web_connection *, int code, const char *reason);

#endif

/* The parts of the web among themselves: web.c has connections and what they say, web_requests.c hears requests and gives plain
 * answers, web_certificate.c judges what TLS is to be spoken with. */
#ifndef FACET_DAEMON_WEB_PARTS_H
#define FACET_DAEMON_WEB_PARTS_H

#include <libwebsockets.h>
#include <netinet/in.h>

#include "daemon/listener.h"
#include "daemon/web.h"
#include "daemon/web_http.h"

#define HEADER_S      10 /* for a request to come, and for an answer to go on */
#define PROTOCOLS_MAX 16

enum web_stage { STAGE_ARRIVED, STAGE_IDLE, STAGE_ANSWERED, STAGE_SPEAKS };

struct web_connection {
	struct web *web;
	struct web_connection *next;
	struct lws *wsi; /* NULL until it is libwebsockets' */
	bool owned;      /* ... which ends it */
	bool evicted;    /* to make room for others: on its way out */
	uint64_t id;
	struct sockaddr_storage from;
	char address[64];
	enum web_stage stage;
	int64_t since_ns; /* in this stage */
	struct web_rights rights;
	uint64_t sent;
	/* A plain request. */
	struct web_answer answer;
	bool answering, told; /* told: its header is out */
	size_t answer_at;
	/* A language. */
	const struct web_language *language;
	void *state;
	bool begun, begun_text; /* a message */
	bool asked;             /* to be called when there is room */
	int64_t settle_ns;
	bool pings, pinged; /* it is to be pinged; it was, and has not answered */
	struct buffer in;   /* a message that is coming */
	bool in_text;
	int close_code;
	bool said_close;
	char reason[WEB_REASON_MAX + 1];
};

struct web_speaker {
	const struct web_language *language;
	void *ctx;
};

struct web {
	uv_loop_t *loop;
	struct publisher *publisher;
	struct web_host host;
	struct web_site site;
	struct listener listener;
	char address[ADDRESS_TEXT_MAX + 16];
	struct lws_context *context;
	struct lws_vhost *vhost;
	struct lws_protocols protocol[PROTOCOLS_MAX + 1];
	struct web_speaker speaker[WEB_LANGUAGES_MAX];
	int speakers;
	int speaks[PROTOCOLS_MAX]; /* which of them, by protocol */
	uv_poll_t door;
	uv_timer_t timer, tick;
	int64_t armed_ns; /* when `timer` comes; INT64_MAX: it does not */
	bool open, polling, stopped;
	struct web_connection *connections;
	size_t count, clients; /* all; of those that speak */
	size_t evicted;        /* not gone yet */
	uint64_t next_id;
	struct web_connection *arriving; /* while it is handed over */
	uint8_t out[LWS_PRE + WEB_PIECE_MAX];
};

int64_t web_now(const struct web *);
void web_log(const struct web *, int priority, const char *text);
void web_enter(struct web_connection *, enum web_stage);

/* web_requests.c */
int web_request(struct web_connection *, const char *path, size_t len);
/* 0: it may become a WebSocket; 1: refused, and told why; -1: just closed. */
int web_upgrade(struct web_connection *, const char *to);
/* Goes on with an answer, as there is room. -1: the connection is to be closed. */
int web_write_answer(struct web_connection *);

/* web_certificate.c: can the configured ones be used? False with a sentence; one that soon expires is logged. */
bool web_check_tls(const struct web *, char error[320]);

#endif

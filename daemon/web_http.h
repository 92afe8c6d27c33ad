/* HTTP without sockets: a request in, an answer out. What is asked, by whom, and what is said to it is decided here; web.c carries
 * bytes. */
#ifndef FACET_DAEMON_WEB_HTTP_H
#define FACET_DAEMON_WEB_HTTP_H

#include "daemon/snapshot.h"
#include "daemon/web.h"
#include "daemon/web_guard.h"

/* What answers are made of. */
struct web_site {
	const struct config *config;
	const struct web_host *host;
	char secret[WEB_TOKEN_MAX]; /* empty: there is none */
	bool loopback;
	struct web_strangers strangers;
	struct buffer status; /* the last one built */
	int64_t status_ns;
};

/* As it came; texts are NULL where they were not sent. */
struct web_request {
	const char *method, *path; /* decoded, without the query */
	const char *host, *origin, *authorization, *token /* of the query */, *if_none_match;
	const struct sockaddr_storage *from;
	bool upgrade; /* to a WebSocket */
};

struct web_answer {
	int code;
	const char *type;
	char etag[SNAPSHOT_ETAG_MAX]; /* empty: none */
	bool gzip;                    /* the bytes are */
	const char *policy;           /* Content-Security-Policy */
	char file[32];                /* to be saved under this name; empty: to be shown */
	const char *allow_origin;     /* borrowed from the configuration; NULL: none */
	int retry_after_s;
	bool allow_methods, ask_token;
	bool head;         /* no body */
	const void *bytes; /* of a page: for ever; else of what follows. NULL while the snapshot is being made */
	size_t len;
	struct buffer text;
	struct snapshot *snapshot;
};

/* Whether the request may come in; else false, with the answer that says why. `log` (may be NULL) is set to a line worth
 * logging, or left empty. */
bool web_site_admit(struct web_site *, const struct web_request *, struct web_rights *ret_rights,
                    struct web_answer *ret, char ret_log[160]);

/* The answer to a plain request that was admitted. */
void web_site_answer(struct web_site *, const struct web_request *, struct web_answer *ret);

/* A snapshot may have been made: true once the answer is ready to be sent. */
bool web_answer_ready(struct web_answer *);
void web_answer_finish(struct web_answer *);

/* The newest STATUS, built if the last one is old. */
const struct buffer *web_site_status(struct web_site *);

#endif

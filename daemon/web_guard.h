/* Who gets in over HTTP, and what he may do there. Judged from what a request says and from a clock that the caller reads;
 * no sockets. */
#ifndef FACET_DAEMON_WEB_GUARD_H
#define FACET_DAEMON_WEB_GUARD_H

#include <stdbool.h>
#include <stdint.h>
#include <sys/socket.h>

#include "config/config.h"

#define WEB_TOKEN_MIN 16
#define WEB_TOKEN_MAX 256 /* bytes with the 0 */
#define WEB_WRONG_MAX \
	5 /* wrong or missing tokens of one address within WEB_WRONG_NS: then it is kept out for as long */
#define WEB_WRONG_NS  60000000000ll
#define WEB_STRANGERS 64 /* addresses remembered; beyond, the one that was quiet for longest is forgotten */

/* The first line of a file that not everybody may read. 0, or -errno with a sentence that names the file. */
int web_token_read(const char *path, char ret[WEB_TOKEN_MAX], char error[320]);

/* What a request shows: `authorization` is that header, `query` the value of ?token=; either may be NULL or empty. How long it takes
 * tells nothing about the token. `secret` empty: every token is wrong. */
enum web_shown { WEB_SHOWN_NONE, WEB_SHOWN_RIGHT, WEB_SHOWN_WRONG };
enum web_shown web_token_judge(const char *secret, const char *authorization, const char *query);

/* Whether a request may ask for this Host. A page elsewhere can have a name of its own point at 127.0.0.1, and its requests
 * then pass for the same origin; so on loopback only loopback's names, the one we listen by and those of listen.origins
 * are good. `host` NULL: there was none. */
bool web_host_good(const struct config *, const char *host);

/* Whether a page of this Origin may open a WebSocket: our own (as `host` says), or one of listen.origins. NULL: the client is no
 * browser. `ret_listed` (may be NULL) gets the entry of listen.origins, or NULL. */
bool web_origin_good(const struct config *, const char *origin, const char *host, const char **ret_listed);

/* Addresses that showed a wrong token, or none where one is needed. Zeroed: nobody did. An IPv6 address counts by its /64. */
struct web_strangers {
	struct {
		uint8_t address[16];
		int wrong;
		int64_t since_ns, last_ns; /* last_ns 0: free */
	} entry[WEB_STRANGERS];
};
/* Seconds for which the address is kept out from now on; 0: it may ask. */
int web_strangers_wait_s(const struct web_strangers *, const struct sockaddr_storage *, int64_t t_ns);
/* It showed a wrong token. True if that is worth a line in the log: the first of a row, and when it is kept out. */
bool web_strangers_note(struct web_strangers *, const struct sockaddr_storage *, int64_t t_ns);

#endif

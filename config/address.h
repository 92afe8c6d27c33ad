/* Addresses as people write them: unix:PATH, tcp:HOST:PORT, udp:HOST:PORT, ws://HOST:PORT/PATH (interfaces, section 1). */
#ifndef FACET_CONFIG_ADDRESS_H
#define FACET_CONFIG_ADDRESS_H

#include <stdbool.h>
#include <stdint.h>
#include <sys/socket.h>

#define ADDRESS_PATH_MAX   108 /* with the NUL; the kernel's sun_path. Longer ones would be cut silently */
#define ADDRESS_HOST_MAX   64
#define ADDRESS_TARGET_MAX 320 /* path and query of ws: */
#define ADDRESS_TEXT_MAX   512
#define ADDRESS_ERROR_MAX  200
#define ADDRESS_PORT       7878 /* of tcp: where none is written */
#define ADDRESS_PORT_HTTP  7880 /* of ws: */

enum address_kind { ADDRESS_UNIX = 1, ADDRESS_TCP = 2, ADDRESS_UDP = 4, ADDRESS_WS = 8 };

struct address {
	enum address_kind kind;
	char path[ADDRESS_PATH_MAX]; /* unix */
	char host[ADDRESS_HOST_MAX]; /* tcp, udp, ws: a name or number, without brackets */
	uint16_t port;
	char target[ADDRESS_TARGET_MAX]; /* ws: path and query, e.g. /?token=...; printable, without blanks */
};

/* `kinds`: bits of what is possible here. 0, or -EINVAL with one sentence. */
int address_parse(const char *text, unsigned kinds, struct address *ret, char error[ADDRESS_ERROR_MAX]);

/* HOST:PORT or [HOST]:PORT without a word before it; the port is needed. The kind is ADDRESS_TCP. */
int address_parse_host(const char *text, struct address *ret, char error[ADDRESS_ERROR_MAX]);

/* HOST or HOST:PORT, HOST a number or `localhost`: nobody asks a name server while devices run. `port`: where none is
 * written. The kind is ADDRESS_TCP. */
int address_parse_number(const char *text, uint16_t port, struct address *ret, char error[ADDRESS_ERROR_MAX]);

/* 0 where nobody from outside gets in: unix, 127.0.0.0/8, ::1, localhost; else -EINVAL with one sentence. */
int address_check_loopback(const struct address *, char error[ADDRESS_ERROR_MAX]);

/* Without asking a name server: numbers and `localhost` only, else -EINVAL. */
int address_sockaddr(const struct address *, struct sockaddr_storage *ret, socklen_t *ret_len);

/* As address_parse reads it, but for the query, which may hold a secret. */
void address_print(const struct address *, char ret[ADDRESS_TEXT_MAX]);

/* Where a daemon is looked for when nobody says: $FACETD, the user's socket if it is there, the system's. */
const char *address_default(char ret[ADDRESS_TEXT_MAX]);

#endif

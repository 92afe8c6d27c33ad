/* A connection to a running daemon, for tools: libfacet, blocking with a time limit. Speaks the native protocol or JSON lines,
 * whichever is asked first (interfaces, section 4). */
#ifndef FACET_TOOLS_CLIENT_H
#define FACET_TOOLS_CLIENT_H

#include "core/native.h"
#include "tools/libfacet.h"

#define CLIENT_ERROR_MAX FACET_ERROR_MAX
#define CLIENT_LINE_MAX  LIBFACET_LINE_MAX

struct client;

/* `address`: NULL or empty for the default one. NULL with one sentence, which names the address, in `error`. */
struct client *client_open(const char *address, int timeout_ms, char error[CLIENT_ERROR_MAX]);
void client_close(struct client *);
const char *client_address(const struct client *);

/* Native: asks for the map; the mirror follows. 0 or -errno with a sentence. */
int client_want(struct client *, const struct native_want *, char error[CLIENT_ERROR_MAX]);

/* Reads until the next COMMIT: 1, or 0 when `timeout_ms` is over (0: only what is there), or -errno with a sentence. */
int client_commit(struct client *, int timeout_ms, char error[CLIENT_ERROR_MAX]);
const struct native_mirror *client_mirror(const struct client *);

/* JSON lines: sends `line` (a newline is added). 0 or -errno with a sentence. */
int client_say(struct client *, const char *line, char error[CLIENT_ERROR_MAX]);

/* The next line: 1 with *ret_line (valid until the next call), 0 at the time limit, or -errno with a sentence. */
int client_line(struct client *, int timeout_ms, const char **ret_line, char error[CLIENT_ERROR_MAX]);

#endif

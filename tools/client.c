/* libfacet as the tools want it: one call until the next COMMIT or line, the error's sentence in the caller's buffer.
 * Nothing here retries: who wants to be connected again (facet watch) opens a new client. */
#include "tools/client.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "tools/libfacet.h"

struct client {
	struct facet *facet;
};

/* The sentence where there is one to give: `code`. */
static int tell(const struct client *client, int code, char error[CLIENT_ERROR_MAX])
{
	if (code < 0)
		snprintf(error, CLIENT_ERROR_MAX, "%s", facet_error(client->facet));
	return code;
}

struct client *client_open(const char *address, int timeout_ms, char error[CLIENT_ERROR_MAX])
{
	struct client *client = calloc(1, sizeof(*client));
	if (!client) {
		snprintf(error, CLIENT_ERROR_MAX, "memory is out");
		return NULL;
	}
	client->facet = facet_open(address, timeout_ms, error);
	if (client->facet)
		return client;
	free(client);
	return NULL;
}

void client_close(struct client *client)
{
	if (!client)
		return;
	facet_close(client->facet);
	free(client);
}

const char *client_address(const struct client *client)
{
	return facet_address(client->facet);
}

const struct native_mirror *client_mirror(const struct client *client)
{
	return libfacet_mirror(client->facet);
}

int client_want(struct client *client, const struct native_want *want, char error[CLIENT_ERROR_MAX])
{
	return tell(client, libfacet_want(client->facet, want), error);
}

/* The next event of a kind: 1, 0: time is over, -errno. */
static int wait_for(struct client *client, enum facet_kind kind, int timeout_ms, struct facet_event *ret)
{
	const int64_t until_ms = libfacet_now_ms() + timeout_ms;
	for (;;) {
		const int64_t left = until_ms - libfacet_now_ms();
		const int r = facet_wait(client->facet, left > 0 ? (int)left : 0, ret);
		if (r <= 0 || ret->kind == kind)
			return r;
	}
}

int client_commit(struct client *client, int timeout_ms, char error[CLIENT_ERROR_MAX])
{
	struct facet_event event;
	return tell(client, wait_for(client, FACET_COMMIT, timeout_ms, &event), error);
}

int client_say(struct client *client, const char *line, char error[CLIENT_ERROR_MAX])
{
	return tell(client, facet_say(client->facet, line), error);
}

int client_line(struct client *client, int timeout_ms, const char **ret_line, char error[CLIENT_ERROR_MAX])
{
	struct facet_event event;
	const int r = wait_for(client, FACET_JSON, timeout_ms, &event);
	if (r == 1)
		*ret_line = event.text;
	return tell(client, r, error);
}

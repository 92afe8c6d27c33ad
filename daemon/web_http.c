/* Routes
 *
 *   /                       the viewer's page and its files (daemon/page.h)
 *   /snapshot.ply .glb .obj .stl   the map of one step, as `facet save` writes it
 *   /status.json            what ?STATUS answers
 *   /planes.json            planes of the whole map
 *   /metrics                the same figures for Prometheus
 *
 * Everything is read only: GET and HEAD. What changes something is said over a WebSocket, with the token.
 *
 * An answer has all of its bytes in memory before its first goes out, so its length is told and a broken transfer is
 * seen as one. They are shared (page, snapshot) or small. */
#include "daemon/web_http.h"

#include <errno.h>
#include <netdb.h>
#include <stdio.h>
#include <string.h>

#include "daemon/page.h"

#define STATUS_NS   100000000ll /* a status is so old at most: building one walks the whole daemon */
#define RETRY_S     2           /* for a snapshot that had no room */
#define TEXT_POLICY "default-src 'none'; frame-ancestors 'none'"

static const char no_page[] =
    "<!doctype html><meta charset=utf-8><title>facetd</title><p>facetd runs, but this build has no viewer: node and "
    "npm "
    "were missing. Install them (<code>make deps</code>), build again, and it is here.<p>Still here: <a "
    "href=status.json>status.json</a>, <a href=metrics>metrics</a>, <a href=snapshot.ply>snapshot.ply</a>, <a "
    "href=snapshot.glb>snapshot.glb</a>, <a href=snapshot.obj>snapshot.obj</a>.\n";

/* Answers */

static void put_text(struct web_answer *answer, int code, const char *type, const char *text, size_t len)
{
	answer->code = code;
	answer->type = type;
	answer->policy = TEXT_POLICY;
	buffer_append(&answer->text, text, len);
	answer->bytes = answer->text.data;
	answer->len = answer->text.error ? 0 : answer->text.len;
}

static void put_sentence(struct web_answer *answer, int code, const char *sentence)
{
	struct buffer line = {0};

	buffer_printf(&line, "%s\n", sentence);
	put_text(answer, code, "text/plain; charset=utf-8", (const char *)line.data, line.error ? 0 : line.len);
	buffer_finish(&line);
}

bool web_answer_ready(struct web_answer *answer)
{
	const uint8_t *bytes;
	size_t len;
	int r;

	if (!answer->snapshot || answer->bytes || answer->head)
		return true;
	r = snapshot_bytes(answer->snapshot, &bytes, &len);
	if (r == 0)
		return false;
	if (r > 0) {
		answer->bytes = bytes;
		answer->len = len;
		return true;
	}
	answer->etag[0] = answer->file[0] = '\0';
	put_sentence(answer, 507, "the snapshot could not be made: the machine is out of memory");
	return true;
}

void web_answer_finish(struct web_answer *answer)
{
	snapshot_drop(answer->snapshot);
	buffer_finish(&answer->text);
	memset(answer, 0, sizeof(*answer));
}

const struct buffer *web_site_status(struct web_site *site)
{
	const struct server_host *host = &site->host->server;
	const int64_t t_ns = host->now(host->ctx);

	if (site->status.len == 0 || site->status.error || t_ns - site->status_ns >= STATUS_NS ||
	    t_ns < site->status_ns) {
		buffer_finish(&site->status);
		host->status(host->ctx, &site->status);
		site->status_ns = t_ns;
	}
	return &site->status;
}

/* Admission */

static void say_from(const struct sockaddr_storage *from, const char *what, char ret_log[160])
{
	char name[NI_MAXHOST] = "?";

	getnameinfo((const struct sockaddr *)from, sizeof(*from), name, sizeof(name), NULL, 0, NI_NUMERICHOST);
	snprintf(ret_log, 160, "%.60s: %s", name, what);
}

/* The page's files are the published program: they say nothing of this robot, and take the token from the address's fragment, which no
 * request and no log ever sees. */
static bool is_open(const struct web_request *request)
{
	return !request->upgrade && (strcmp(request->path, "/") == 0 || page_find(request->path));
}

/* False: the token is wrong, or one is needed. */
static bool admit_token(struct web_site *site, const struct web_request *request, enum web_shown shown,
                        struct web_answer *ret, char ret_log[160])
{
	const int64_t t_ns = site->host->server.now(site->host->server.ctx);
	const int wait_s = web_strangers_wait_s(&site->strangers, request->from, t_ns);
	char sentence[120];

	if (shown == WEB_SHOWN_NONE && (site->loopback || is_open(request)))
		return true; /* may read; and one guesser on this machine shuts nobody else out */
	if (wait_s > 0) {
		ret->retry_after_s = wait_s;
		snprintf(sentence, sizeof(sentence), "too many wrong tokens; try again in %d s", wait_s);
		put_sentence(ret, 429, sentence);
		return false;
	}
	if (shown == WEB_SHOWN_RIGHT)
		return true;
	if (web_strangers_note(&site->strangers, request->from, t_ns))
		say_from(request->from,
		         web_strangers_wait_s(&site->strangers, request->from, t_ns) > 0
		             ? "showed too many wrong tokens and is kept out for a minute"
		         : shown == WEB_SHOWN_WRONG ? "showed a wrong token"
		                                    : "showed no token",
		         ret_log);
	ret->ask_token = true;
	put_sentence(ret, 401,
	             site->secret[0] ? "a token is needed: Authorization: Bearer TOKEN, or ?token=TOKEN in the address"
	                             : "no token is good here: listen.token_file is not set");
	return false;
}

bool web_site_admit(struct web_site *site, const struct web_request *request, struct web_rights *ret_rights,
                    struct web_answer *ret, char ret_log[160])
{
	const enum web_shown shown = web_token_judge(site->secret, request->authorization, request->token);
	const char *listed;
	const bool own = web_origin_good(site->config, request->origin, request->host, &listed);
	const bool reads = strcmp(request->method, "GET") == 0 || strcmp(request->method, "HEAD") == 0;

	ret_log[0] = '\0';
	if (!web_host_good(site->config, request->host)) {
		put_sentence(ret, 403,
		             "this name is not facetd's: use localhost or 127.0.0.1, or name its origin in "
		             "listen.origins");
		return false;
	}
	if (!own && (request->upgrade || !reads)) {
		put_sentence(ret, 403, "pages of this origin may not do that; name it in listen.origins");
		return false;
	}
	if (!admit_token(site, request, shown, ret, ret_log))
		return false;
	ret->allow_origin = listed;
	ret_rights->may_change = shown == WEB_SHOWN_RIGHT;
	ret_rights->may_play = ret_rights->may_change || (site->loopback && site->host->replays);
	return true;
}

/* Routes */

static void answer_status(struct web_site *site, const struct web_request *request, struct web_answer *ret)
{
	const struct buffer *status = web_site_status(site);

	(void)request;
	put_text(ret, 200, "application/json", (const char *)status->data, status->len);
}

static void answer_planes(struct web_site *site, const struct web_request *request, struct web_answer *ret)
{
	(void)site;
	(void)request;
	put_text(ret, 200, "application/json", "[]\n", 3); /* until the map has planes of its own */
}

static void answer_metrics(struct web_site *site, const struct web_request *request, struct web_answer *ret)
{
	struct buffer text = {0};

	(void)request;
	site->host->metrics(site->host->server.ctx, &text);
	put_text(ret, 200, "text/plain; version=0.0.4; charset=utf-8", (const char *)text.data,
	         text.error ? 0 : text.len);
	buffer_finish(&text);
}

static void answer_snapshot(struct web_site *site, const struct web_request *request, enum snapshot_format format,
                            struct web_answer *ret)
{
	static const char *const type[SNAPSHOT_FORMATS] = {"application/octet-stream", "model/gltf-binary", "model/obj",
	                                                   "model/stl"};
	char error[SNAPSHOT_ERROR_MAX];

	snapshots_etag(site->host->snapshots, format, ret->etag);
	if (request->if_none_match && strstr(request->if_none_match, ret->etag)) {
		ret->code = 304;
		return;
	}
	ret->code = 200;
	ret->type = type[format];
	ret->policy = TEXT_POLICY;
	snprintf(ret->file, sizeof(ret->file), "map.%s", snapshot_ending(format));
	if (ret->head)
		return;
	ret->snapshot = snapshot_take(site->host->snapshots, format, error);
	if (ret->snapshot)
		return;
	ret->etag[0] = ret->file[0] = '\0';
	ret->retry_after_s = RETRY_S;
	put_sentence(ret, 503, error);
}

/* False: there is no such page. */
static bool answer_page(const struct web_request *request, struct web_answer *ret)
{
	const struct page *page = page_find(request->path);

	if (!page && strcmp(request->path, "/") == 0) {
		put_text(ret, 200, "text/html; charset=utf-8", no_page, sizeof(no_page) - 1);
		return true;
	}
	if (!page)
		return false;
	snprintf(ret->etag, sizeof(ret->etag), "%s", page->etag);
	ret->policy = PAGE_POLICY;
	ret->type = page->type;
	ret->code = 304;
	if (request->if_none_match && strstr(request->if_none_match, page->etag))
		return true;
	ret->code = 200;
	ret->gzip = true;
	ret->bytes = page->bytes;
	ret->len = page->len;
	return true;
}

static const struct {
	const char *path;
	void (*answer)(struct web_site *, const struct web_request *, struct web_answer *);
} routes[] = {
    {"/status.json", answer_status},
    {"/planes.json", answer_planes},
    {"/metrics", answer_metrics},
};

static bool answer_route(struct web_site *site, const struct web_request *request, struct web_answer *ret)
{
	char path[32];

	for (size_t i = 0; i < sizeof(routes) / sizeof(routes[0]); i++)
		if (strcmp(request->path, routes[i].path) == 0) {
			routes[i].answer(site, request, ret);
			return true;
		}
	for (int i = 0; i < SNAPSHOT_FORMATS; i++) {
		snprintf(path, sizeof(path), "/snapshot.%s", snapshot_ending((enum snapshot_format)i));
		if (strcmp(request->path, path) == 0) {
			answer_snapshot(site, request, (enum snapshot_format)i, ret);
			return true;
		}
	}
	return answer_page(request, ret);
}

void web_site_answer(struct web_site *site, const struct web_request *request, struct web_answer *ret)
{
	ret->head = strcmp(request->method, "HEAD") == 0;
	if (!ret->head && strcmp(request->method, "GET") != 0) {
		ret->allow_methods = true;
		put_sentence(ret, 405, "only GET and HEAD: what changes something is said over a WebSocket");
	} else if (!answer_route(site, request, ret)) {
		put_sentence(ret, 404,
		             "there is no such page; try /, /snapshot.ply, /snapshot.glb, /snapshot.obj, "
		             "/status.json, /planes.json or /metrics");
	}
}

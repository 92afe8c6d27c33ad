/* Requests: read from libwebsockets, judged and answered by web_http.c, and the answers given in pieces. */
#include "daemon/web.h"

#ifdef HAVE_WEB

#include <stdio.h>
#include <string.h>
#include <strings.h>
#include <syslog.h>

#include "daemon/web_parts.h"

#define SNAPSHOT_S 60 /* for a snapshot to be made */

/* Answers */

static bool put_header(struct lws *wsi, const char *name, const char *value, uint8_t **p, uint8_t *end)
{
	return lws_add_http_header_by_name(wsi, (const unsigned char *)name, (const unsigned char *)value,
	                                   (int)strlen(value), p, end) == 0;
}

static bool put_optional_headers(struct lws *wsi, const struct web_answer *a, uint8_t **p, uint8_t *end)
{
	char text[80];
	bool good = true;

	if (a->type)
		good &= put_header(wsi, "content-type:", a->type, p, end);
	if (a->policy)
		good &= put_header(wsi, "content-security-policy:", a->policy, p, end);
	if (a->etag[0])
		good &= put_header(wsi, "etag:", a->etag, p, end);
	if (a->gzip)
		good &= put_header(wsi, "content-encoding:", "gzip", p, end);
	if (a->allow_origin)
		good &= put_header(wsi, "access-control-allow-origin:", a->allow_origin, p, end);
	if (a->allow_methods)
		good &= put_header(wsi, "allow:", "GET, HEAD", p, end);
	if (a->ask_token)
		good &= put_header(wsi, "www-authenticate:", "Bearer", p, end);
	if (a->file[0]) {
		snprintf(text, sizeof(text), "attachment; filename=\"%s\"", a->file);
		good &= put_header(wsi, "content-disposition:", text, p, end);
	}
	if (a->retry_after_s > 0) {
		snprintf(text, sizeof(text), "%d", a->retry_after_s);
		good &= put_header(wsi, "retry-after:", text, p, end);
	}
	return good;
}

/* False: it cannot be said. */
static bool write_header(struct lws *wsi, const struct web_answer *a)
{
	uint8_t bytes[LWS_PRE + 2048], *start = bytes + LWS_PRE, *p = start, *end = bytes + sizeof(bytes);
	bool good = lws_add_http_header_status(wsi, (unsigned)a->code, &p, end) == 0;

	good &= put_header(wsi, "x-content-type-options:", "nosniff", &p, end);
	good &= put_header(wsi, "referrer-policy:", "no-referrer", &p, end); /* an address may carry the token */
	good &= put_header(wsi, "cache-control:", "no-cache", &p, end);      /* always ask; the etag saves the rest */
	good &= put_header(wsi, "vary:", "Origin", &p, end);
	good &= put_optional_headers(wsi, a, &p, end);
	if (!(a->head && !a->bytes) && a->code != 304)
		good &= lws_add_http_header_content_length(wsi, a->len, &p, end) == 0;
	return good && lws_finalize_write_http_header(wsi, start, &p, end) == 0;
}

/* The whole of a short answer, now: the connection is closed behind it. */
static void refuse(struct lws *wsi, struct web_answer *a)
{
	uint8_t bytes[LWS_PRE + 512];
	const size_t n = a->len < 512 ? a->len : 512;

	if (!write_header(wsi, a))
		return;
	memcpy(bytes + LWS_PRE, a->bytes, n);
	lws_write(wsi, bytes + LWS_PRE, n, LWS_WRITE_HTTP_FINAL);
}

static int end_answer(struct web_connection *c)
{
	web_answer_finish(&c->answer);
	c->answering = false;
	web_enter(c, STAGE_IDLE);
	return lws_http_transaction_completed(c->wsi) ? -1 : 0;
}

int web_write_answer(struct web_connection *c)
{
	struct web_answer *a = &c->answer;
	size_t total = 0;

	if (!c->answering || !web_answer_ready(a))
		return 0;
	if (!c->told && !write_header(c->wsi, a))
		return -1;
	c->told = true;
	if (a->head || a->code == 304 || a->len == 0)
		return end_answer(c);
	lws_set_timeout(c->wsi, PENDING_TIMEOUT_HTTP_CONTENT, HEADER_S);
	while (c->answer_at < a->len && total < WEB_TURN_BYTES && !lws_send_pipe_choked(c->wsi)) {
		const size_t left = a->len - c->answer_at, n = left < WEB_PIECE_MAX ? left : WEB_PIECE_MAX;

		memcpy(c->web->out + LWS_PRE, (const uint8_t *)a->bytes + c->answer_at, n);
		if (lws_write(c->wsi, c->web->out + LWS_PRE, n, n == left ? LWS_WRITE_HTTP_FINAL : LWS_WRITE_HTTP) <
		    (int)n)
			return -1;
		c->answer_at += n;
		c->sent += n;
		total += n;
	}
	if (c->answer_at == a->len)
		return end_answer(c);
	lws_callback_on_writable(c->wsi);
	return 0;
}

/* Requests */

/* The texts of a request, copied: libwebsockets' own go with the next one. */
struct texts {
	char host[300], origin[300], authorization[WEB_TOKEN_MAX + 16], token[WEB_TOKEN_MAX + 8], if_none_match[512];
};

/* NULL where it was not sent. One that is too long is not what we know, and is taken for an empty one. */
static const char *take_header(struct lws *wsi, enum lws_token_indexes which, char *text, size_t cap)
{
	text[0] = '\0';
	if (lws_hdr_total_length(wsi, which) == 0)
		return NULL;
	if (lws_hdr_copy(wsi, text, (int)cap, which) < 0)
		text[0] = '\0';
	return text;
}

static const char *take_token(struct lws *wsi, struct texts *texts)
{
	const char *value = lws_get_urlarg_by_name(wsi, "token=", texts->token, sizeof(texts->token));

	return value && *value ? value : NULL;
}

static const char *method_of(struct lws *wsi)
{
	if (lws_hdr_total_length(wsi, WSI_TOKEN_GET_URI) > 0)
		return "GET";
	return lws_hdr_total_length(wsi, WSI_TOKEN_HEAD_URI) > 0 ? "HEAD" : "POST"; /* or another one that we refuse */
}

static void read_request(struct web_connection *c, const char *path, bool upgrade, struct texts *texts,
                         struct web_request *ret)
{
	struct lws *wsi = c->wsi;

	*ret = (struct web_request){.method = method_of(wsi), .path = path, .from = &c->from, .upgrade = upgrade};
	ret->host = take_header(wsi, WSI_TOKEN_HOST, texts->host, sizeof(texts->host));
	ret->origin = take_header(wsi, WSI_TOKEN_ORIGIN, texts->origin, sizeof(texts->origin));
	ret->authorization =
	    take_header(wsi, WSI_TOKEN_HTTP_AUTHORIZATION, texts->authorization, sizeof(texts->authorization));
	ret->if_none_match =
	    take_header(wsi, WSI_TOKEN_HTTP_IF_NONE_MATCH, texts->if_none_match, sizeof(texts->if_none_match));
	ret->token = take_token(wsi, texts);
}

static bool admit(struct web_connection *c, const struct web_request *request)
{
	char line[160];
	const bool admitted = web_site_admit(&c->web->site, request, &c->rights, &c->answer, line);

	if (line[0])
		web_log(c->web, LOG_WARNING, line);
	return admitted;
}

int web_request(struct web_connection *c, const char *path, size_t len)
{
	struct web_request request;
	struct texts texts;
	char name[256] = "/?"; /* a longer one is none of ours */

	if (len < sizeof(name))
		snprintf(name, sizeof(name), "%.*s", (int)len, path);
	web_answer_finish(&c->answer);
	web_enter(c, STAGE_ANSWERED);
	c->answering = true;
	c->told = false;
	c->answer_at = 0;
	read_request(c, name, false, &texts, &request);
	if (admit(c, &request))
		web_site_answer(&c->web->site, &request, &c->answer);
	lws_set_timeout(c->wsi, PENDING_TIMEOUT_HTTP_CONTENT, c->answer.snapshot ? SNAPSHOT_S : HEADER_S);
	if (web_answer_ready(&c->answer))
		lws_callback_on_writable(c->wsi);
	return 0;
}

int web_upgrade(struct web_connection *c, const char *to)
{
	struct web_request request;
	struct texts texts;
	bool admitted;

	if (strcasecmp(to, "websocket") != 0)
		return -1; /* HTTP/2 without TLS: nobody needs it */
	read_request(c, "/", true, &texts, &request);
	admitted = admit(c, &request);
	if (!admitted)
		refuse(c->wsi, &c->answer);
	web_answer_finish(&c->answer);
	return admitted ? 0 : 1;
}

#endif

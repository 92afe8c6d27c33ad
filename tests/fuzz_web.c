/* Law: whatever a request says, it gets in by the right token, name and origin only, is answered with a code and a sentence,
 * and leaves nothing behind.
 *
 * Input: lines "field value"; fields are method, path, host, origin, authorization, token, match, upgrade, tls, beyond, secret, seconds. */
#include <netinet/in.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/web_http.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

#define SECRET "0123456789abcdef"

static int64_t clock_ns;

static void must(bool condition)
{
	if (!condition)
		abort();
}

static int64_t host_now(void *ctx)
{
	(void)ctx;
	return clock_ns;
}

static void host_text(void *ctx, struct buffer *ret)
{
	(void)ctx;
	buffer_printf(ret, "{}");
}

static struct config config;
static struct web_host host = {.server = {.now = host_now, .status = host_text}, .metrics = host_text, .replays = true};
static uv_loop_t loop;

static void check_answer(struct web_answer *answer)
{
	must(answer->code >= 200 && answer->code < 600);
	if (!web_answer_ready(answer))
		uv_run(&loop, UV_RUN_DEFAULT);
	must(web_answer_ready(answer) && (answer->len == 0 || answer->bytes));
	must(strlen(answer->etag) < sizeof(answer->etag) && strlen(answer->file) < sizeof(answer->file));
	if (answer->code >= 400)
		must(answer->len > 10 && ((const char *)answer->bytes)[answer->len - 1] == '\n');
}

static void have_no_map(void)
{
	static const struct publisher_params params = {.cell_m = 0.05};

	if (host.snapshots)
		return;
	uv_loop_init(&loop);
	host.snapshots = snapshots_create(&loop, publisher_create(&params), "", NULL, NULL);
}

static void ask(struct web_site *site, const struct web_request *request)
{
	struct web_answer answer = {0};
	struct web_rights rights = {0};
	char log[160];
	const bool admitted = web_site_admit(site, request, &rights, &answer, log);
	const bool shown = (request->token && strcmp(request->token, SECRET) == 0) ||
	                   (request->authorization && strstr(request->authorization, SECRET));

	must(strlen(log) < sizeof(log) && !strstr(log, SECRET));
	must(!rights.may_change || (admitted && shown && site->secret[0]));
	if (admitted) {
		must(request->host && request->host[0]);
		must(site->loopback || rights.may_change || !request->upgrade);
		web_site_answer(site, request, &answer);
	}
	check_answer(&answer);
	web_answer_finish(&answer);
}

static void take_line(char *line, struct web_site *site, struct web_request *r)
{
	char *value = strchr(line, ' ');

	if (!value)
		return;
	*value++ = '\0';
	if (!strcmp(line, "method"))
		r->method = value;
	else if (!strcmp(line, "path"))
		r->path = value;
	else if (!strcmp(line, "host"))
		r->host = value;
	else if (!strcmp(line, "origin"))
		r->origin = value;
	else if (!strcmp(line, "authorization"))
		r->authorization = value;
	else if (!strcmp(line, "token"))
		r->token = value;
	else if (!strcmp(line, "match"))
		r->if_none_match = value;
	else if (!strcmp(line, "upgrade"))
		r->upgrade = value[0] == '1';
	else if (!strcmp(line, "tls"))
		config.listen.has_tls = value[0] == '1';
	else if (!strcmp(line, "beyond"))
		site->loopback = value[0] != '1';
	else if (!strcmp(line, "secret"))
		site->secret[0] = value[0] == '1' ? SECRET[0] : '\0';
	else if (!strcmp(line, "seconds"))
		clock_ns += (int64_t)(strtoul(value, NULL, 10) % 1000) * 1000000000;
	else if (!strcmp(line, "ask"))
		ask(site, r);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct sockaddr_storage from = {.ss_family = AF_INET};
	struct web_site site = {.config = &config, .host = &host, .secret = SECRET, .loopback = true};
	struct web_request request = {.method = "GET", .path = "/", .from = &from};
	char *text = malloc(size + 1), *rest = text, *line;

	if (!text)
		return 0;
	have_no_map();
	config_default(&config);
	snprintf(config.listen.origin[0], CONFIG_TEXT_MAX, "https://app.example");
	config.listen.origins = 1;
	clock_ns = 1000000000;
	if (size > 0 && data[0] == '6')
		from.ss_family = AF_INET6;
	memcpy(text, data, size);
	text[size] = '\0';
	while ((line = strsep(&rest, "\n")))
		take_line(line, &site, &request);
	ask(&site, &request);
	buffer_finish(&site.status);
	free(text);
	return 0;
}

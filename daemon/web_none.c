/* The web of a build without libwebsockets: it says so where it was asked for, and is not there otherwise. */
#include "daemon/web.h"

#ifndef HAVE_WEB

#include <errno.h>
#include <stdio.h>

struct web *web_create(uv_loop_t *loop, const struct config *config, struct publisher *publisher,
                       const struct web_host *host, int *ret_why, char error[320])
{
	(void)loop;
	(void)publisher;
	(void)host;
	*ret_why = config->listen.http[0] ? -ENOTSUP : 0;
	error[0] = '\0';
	if (config->listen.http[0])
		snprintf(error, 320,
		         "listen.http: this build has no HTTP; install libwebsockets-dev and build again, or leave "
		         "listen.http empty");
	return NULL;
}

void web_speak(struct web *web, const struct web_language *language, void *ctx)
{
	(void)web;
	(void)language;
	(void)ctx;
}

int web_start(struct web *web, char error[320])
{
	(void)web;
	(void)error;
	return 0;
}

void web_stop(struct web *web)
{
	(void)web;
}

void web_destroy(struct web *web)
{
	(void)web;
}

void web_wake(struct web *web)
{
	(void)web;
}

void web_event(struct web *web, const char *text, size_t len)
{
	(void)web;
	(void)text;
	(void)len;
}

size_t web_clients(const struct web *web, struct control_client *ret, size_t cap)
{
	(void)web;
	(void)ret;
	(void)cap;
	return 0;
}

const char *web_address(const struct web *web)
{
	(void)web;
	return NULL;
}

bool web_passed(const struct web *web)
{
	(void)web;
	return false;
}

bool web_loopback(const struct web *web)
{
	(void)web;
	return true;
}

/* No language is ever opened. */

void web_wake_one(struct web_connection *c)
{
	(void)c;
}

const struct web_rights *web_rights(const struct web_connection *c)
{
	(void)c;
	return NULL;
}

const struct server_host *web_server_host(const struct web_connection *c)
{
	(void)c;
	return NULL;
}

const struct buffer *web_status(const struct web_connection *c)
{
	(void)c;
	return NULL;
}

void web_forget_status(const struct web_connection *c)
{
	(void)c;
}

struct publisher *web_publisher(const struct web_connection *c)
{
	(void)c;
	return NULL;
}

bool web_query(const struct web_connection *c, const char *name, char *ret, size_t cap)
{
	(void)c;
	(void)name;
	(void)ret;
	(void)cap;
	return false;
}

void web_hold(struct web_connection *c, bool on)
{
	(void)c;
	(void)on;
}

void web_close(struct web_connection *c, int code, const char *reason)
{
	(void)c;
	(void)code;
	(void)reason;
}

#endif

/* An address is a word, a colon and the rest. Everything is judged here, once, so that whoever binds or connects gets a
 * structure that fits the kernel's: a unix path of 108 bytes and more would be cut silently by others. */
#include "config/address.h"

#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/un.h>

static int refuse(char error[ADDRESS_ERROR_MAX], const char *format, ...) __attribute__((format(printf, 2, 3)));

static int refuse(char error[ADDRESS_ERROR_MAX], const char *format, ...)
{
	va_list args;
	va_start(args, format);
	vsnprintf(error, ADDRESS_ERROR_MAX, format, args);
	va_end(args);
	for (char *c = error; *c; c++)
		if ((unsigned char)*c < ' ' || *c == 127)
			*c = '?';
	return -EINVAL;
}

static int parse_path(const char *path, struct address *ret, char error[ADDRESS_ERROR_MAX])
{
	if (!path[0])
		return refuse(error, "unix: a path is missing behind it");
	if (strlen(path) >= ADDRESS_PATH_MAX)
		return refuse(error, "the path '%.40s...' has %zu bytes; a socket's path has less than %d", path,
		              strlen(path), ADDRESS_PATH_MAX);
	strcpy(ret->path, path);
	return 0;
}

static int parse_port(const char *text, const char *port, struct address *ret, char error[ADDRESS_ERROR_MAX])
{
	const size_t n = strspn(port, "0123456789");
	const long value = n >= 1 && n <= 5 && !port[n] ? strtol(port, NULL, 10) : -1;
	if (value < 0 || value > 65535)
		return refuse(error, "'%.60s': '%.20s' is not a port (0 .. 65535)", text, port);
	ret->port = (uint16_t)value;
	return 0;
}

/* `port`: what a missing port means, or -1 where it is needed. */
static int parse_host(const char *text, int port, struct address *ret, char error[ADDRESS_ERROR_MAX])
{
	const bool brackets = text[0] == '[';
	const char *host = text + brackets;
	const size_t len = brackets ? strcspn(host, "]") : strcspn(host, ":");
	if (brackets && host[len] != ']')
		return refuse(error, "'%.60s': the closing ] is missing", text);
	const char *rest = host + len + brackets;
	if (len == 0 || len >= ADDRESS_HOST_MAX)
		return refuse(error, "'%.60s': a host is needed before the port, like 127.0.0.1:%d", text,
		              ADDRESS_PORT);
	if (*rest && *rest != ':')
		return refuse(error, "'%.60s': a colon and a port are needed behind the ]", text);
	if (!*rest && port < 0)
		return refuse(error, "'%.60s': a port is missing; write HOST:PORT", text);
	ret->port = (uint16_t)port;
	if (*rest && parse_port(text, rest + 1, ret, error))
		return -EINVAL;
	memcpy(ret->host, host, len);
	ret->host[len] = '\0';
	return 0;
}

static const char *expected(unsigned kinds)
{
	if (kinds & ADDRESS_WS)
		return "unix:PATH, tcp:HOST:PORT or ws://HOST:PORT/";
	if (kinds == (ADDRESS_UNIX | ADDRESS_UDP))
		return "unix:PATH or udp:HOST:PORT";
	return "unix:PATH or tcp:HOST:PORT";
}

/* What a request's first line can hold: a blank or a line's end in it would make it another request. */
static int parse_target(const char *text, const char *target, struct address *ret, char error[ADDRESS_ERROR_MAX])
{
	const bool no_path = *target != '/';
	if (strlen(target) + no_path >= ADDRESS_TARGET_MAX)
		return refuse(error, "'%.60s...': path and query have less than %d bytes", text, ADDRESS_TARGET_MAX);
	for (const char *c = target; *c; c++)
		if (*c <= ' ' || *c > '~' || *c == '#')
			return refuse(error, "'%.60s': a path has neither blanks nor # in it", text);
	ret->target[0] = '/';
	strcpy(ret->target + no_path, target);
	return 0;
}

/* What stands behind ws:// */
static int parse_web(const char *text, struct address *ret, char error[ADDRESS_ERROR_MAX])
{
	char authority[ADDRESS_HOST_MAX + 8];
	const size_t len = strcspn(text, "/?#");
	if (len >= sizeof(authority))
		return refuse(error, "'%.60s...': no host has so long a name", text);
	memcpy(authority, text, len);
	authority[len] = '\0';
	const int status = parse_host(authority, ADDRESS_PORT_HTTP, ret, error);
	return status ? status : parse_target(text, text + len, ret, error);
}

int address_parse(const char *text, unsigned kinds, struct address *ret, char error[ADDRESS_ERROR_MAX])
{
	struct address address = {0};
	int status;
	if (strncmp(text, "unix:", 5) == 0 && (kinds & ADDRESS_UNIX)) {
		address.kind = ADDRESS_UNIX;
		status = parse_path(text + 5, &address, error);
	} else if (strncmp(text, "tcp:", 4) == 0 && (kinds & ADDRESS_TCP)) {
		address.kind = ADDRESS_TCP;
		status = parse_host(text + 4, ADDRESS_PORT, &address, error);
	} else if (strncmp(text, "udp:", 4) == 0 && (kinds & ADDRESS_UDP)) {
		address.kind = ADDRESS_UDP;
		status = parse_host(text + 4, -1, &address, error);
	} else if (strncmp(text, "ws://", 5) == 0 && (kinds & ADDRESS_WS)) {
		address.kind = ADDRESS_WS;
		status = parse_web(text + 5, &address, error);
	} else if (strncmp(text, "wss://", 6) == 0 && (kinds & ADDRESS_WS)) {
		return refuse(error,
		              "'%.40s': TLS is for browsers; use ssh -L %d:127.0.0.1:%d HOST and ws://127.0.0.1:%d/, "
		              "or unix:PATH on the robot",
		              text, ADDRESS_PORT_HTTP, ADDRESS_PORT_HTTP, ADDRESS_PORT_HTTP);
	} else {
		return refuse(error, "'%.60s' is not an address; write %s", text, expected(kinds));
	}
	if (!status)
		*ret = address;
	return status;
}

int address_parse_host(const char *text, struct address *ret, char error[ADDRESS_ERROR_MAX])
{
	struct address address = {.kind = ADDRESS_TCP};
	const int status = parse_host(text, -1, &address, error);
	if (!status)
		*ret = address;
	return status;
}

int address_parse_number(const char *text, uint16_t port, struct address *ret, char error[ADDRESS_ERROR_MAX])
{
	struct address address = {.kind = ADDRESS_TCP};
	struct sockaddr_storage storage;
	socklen_t len;
	const int status = parse_host(text, port, &address, error);
	if (status)
		return status;
	if (address_sockaddr(&address, &storage, &len))
		return refuse(error, "'%.60s' is no address; names are not looked up, write a number like 192.168.0.1",
		              address.host);
	if (address.port == 0)
		return refuse(error, "'%.60s': nobody listens on port 0", text);
	*ret = address;
	return 0;
}

int address_check_loopback(const struct address *address, char error[ADDRESS_ERROR_MAX])
{
	struct in_addr v4;
	struct in6_addr v6;
	if (address->kind == ADDRESS_UNIX || strcmp(address->host, "localhost") == 0)
		return 0;
	if (inet_pton(AF_INET, address->host, &v4) == 1 && ntohl(v4.s_addr) >> 24 == 127)
		return 0;
	if (inet_pton(AF_INET6, address->host, &v6) == 1 && IN6_IS_ADDR_LOOPBACK(&v6))
		return 0;
	return refuse(error, "'%s' is not on loopback; use 127.0.0.1 here, and ssh -L to reach it from elsewhere",
	              address->host);
}

static int unix_sockaddr(const struct address *address, struct sockaddr_storage *ret, socklen_t *ret_len)
{
	struct sockaddr_un un = {.sun_family = AF_UNIX};
	strcpy(un.sun_path, address->path);
	memcpy(ret, &un, sizeof(un));
	*ret_len = (socklen_t)(offsetof(struct sockaddr_un, sun_path) + strlen(un.sun_path) + 1);
	return 0;
}

int address_sockaddr(const struct address *address, struct sockaddr_storage *ret, socklen_t *ret_len)
{
	const char *host = strcmp(address->host, "localhost") == 0 ? "127.0.0.1" : address->host;
	struct sockaddr_in v4 = {.sin_family = AF_INET, .sin_port = htons(address->port)};
	struct sockaddr_in6 v6 = {.sin6_family = AF_INET6, .sin6_port = htons(address->port)};
	memset(ret, 0, sizeof(*ret));
	if (address->kind == ADDRESS_UNIX)
		return unix_sockaddr(address, ret, ret_len);
	if (inet_pton(AF_INET, host, &v4.sin_addr) == 1) {
		memcpy(ret, &v4, sizeof(v4));
		*ret_len = sizeof(v4);
		return 0;
	}
	if (inet_pton(AF_INET6, host, &v6.sin6_addr) == 1) {
		memcpy(ret, &v6, sizeof(v6));
		*ret_len = sizeof(v6);
		return 0;
	}
	return -EINVAL;
}

void address_print(const struct address *address, char ret[ADDRESS_TEXT_MAX])
{
	const char *word = address->kind == ADDRESS_UDP ? "udp:" : address->kind == ADDRESS_WS ? "ws://" : "tcp:";
	const int path = address->kind == ADDRESS_WS ? (int)strcspn(address->target, "?") : 0;
	const bool v6 = strchr(address->host, ':') != NULL;
	if (address->kind == ADDRESS_UNIX)
		snprintf(ret, ADDRESS_TEXT_MAX, "unix:%s", address->path);
	else
		snprintf(ret, ADDRESS_TEXT_MAX, "%s%s%s%s:%u%.*s", word, v6 ? "[" : "", address->host, v6 ? "]" : "",
		         address->port, path, address->target);
}

const char *address_default(char ret[ADDRESS_TEXT_MAX])
{
	const char *given = getenv("FACETD"), *run = getenv("XDG_RUNTIME_DIR");
	struct stat info;
	if (given && given[0]) {
		snprintf(ret, ADDRESS_TEXT_MAX, "%s", given);
		return ret;
	}
	if (run && run[0] && snprintf(ret, ADDRESS_TEXT_MAX, "unix:%s/facetd.sock", run) < ADDRESS_TEXT_MAX &&
	    stat(ret + 5, &info) == 0 && S_ISSOCK(info.st_mode))
		return ret;
	snprintf(ret, ADDRESS_TEXT_MAX, "unix:/run/facetd/facetd.sock");
	return ret;
}

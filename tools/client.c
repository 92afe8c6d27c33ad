/* One descriptor, one buffer of what was read, one deadline for each call. Frames go to the mirror as they become
 * whole; a JSON frame within them is kept as the reason why the daemon is about to close. Nothing here retries: who
 * wants to be connected again (facet watch) opens a new client. */
#include "tools/client.h"

#include <errno.h>
#include <fcntl.h>
#include <netdb.h>
#include <poll.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include <jansson.h>

#include "config/address.h"

#define READ_CHUNK (256u << 10)

struct client {
	int fd;
	char address[ADDRESS_TEXT_MAX];
	char reason[160]; /* what the daemon said last about an error */
	struct native_mirror *mirror;
	uint64_t bytes;
	uint8_t *data;
	size_t begin, end, cap; /* data[begin..end) is read, not yet handled */
};

static int64_t now_ms(void)
{
	struct timespec t;
	clock_gettime(CLOCK_MONOTONIC, &t);
	return (int64_t)t.tv_sec * 1000 + t.tv_nsec / 1000000;
}

static int fail(char error[CLIENT_ERROR_MAX], int code, const char *format, ...) __attribute__((format(printf, 3, 4)));

static int fail(char error[CLIENT_ERROR_MAX], int code, const char *format, ...)
{
	va_list args;
	va_start(args, format);
	vsnprintf(error, CLIENT_ERROR_MAX, format, args);
	va_end(args);
	return code;
}

/* Names outside loopback may need a name server: a tool may wait for one, the daemon never does. */
static int resolve(const struct address *address, struct sockaddr_storage *ret, socklen_t *ret_len)
{
	char port[8];
	struct addrinfo hints = {.ai_socktype = SOCK_STREAM}, *list;
	if (address_sockaddr(address, ret, ret_len) == 0)
		return 0;
	snprintf(port, sizeof(port), "%u", address->port);
	const int error = getaddrinfo(address->host, port, &hints, &list);
	if (error)
		return error == EAI_SYSTEM ? -errno : -EHOSTUNREACH;
	memcpy(ret, list->ai_addr, list->ai_addrlen);
	*ret_len = list->ai_addrlen;
	freeaddrinfo(list);
	return 0;
}

/* 1: ready, 0: time is over, -errno. */
static int wait_for(int fd, short events, int64_t until_ms)
{
	for (;;) {
		const int64_t left = until_ms - now_ms();
		struct pollfd poll_fd = {.fd = fd, .events = events};
		const int n = poll(&poll_fd, 1, left > 0 ? (int)left : 0);
		if (n >= 0)
			return n > 0;
		if (errno != EINTR)
			return -errno;
	}
}

static int connect_until(int fd, const struct sockaddr_storage *to, socklen_t len, int64_t until_ms)
{
	int error = 0;
	socklen_t size = sizeof(error);
	if (connect(fd, (const struct sockaddr *)to, len) == 0)
		return 0;
	if (errno != EINPROGRESS)
		return -errno;
	const int ready = wait_for(fd, POLLOUT, until_ms);
	if (ready <= 0)
		return ready ? ready : -ETIMEDOUT;
	getsockopt(fd, SOL_SOCKET, SO_ERROR, &error, &size);
	return -error;
}

static int open_socket(const struct address *address, int timeout_ms)
{
	struct sockaddr_storage to;
	socklen_t len;
	const int64_t until_ms = now_ms() + timeout_ms;
	int error = resolve(address, &to, &len);
	if (error)
		return error;
	const int fd = socket(to.ss_family, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
	if (fd < 0)
		return -errno;
	error = connect_until(fd, &to, len, until_ms);
	if (error) {
		close(fd);
		return error;
	}
	return fd;
}

static void say_why_not(const char *address, int code, char error[CLIENT_ERROR_MAX])
{
	const char *hint = code == -EACCES ? "join the group facetd, or ask its owner"
	                                   : "start facetd, or say where it is (ADDRESS or $FACETD)";
	fail(error, code, "no daemon answers at %s (%s); %s", address, strerror(-code), hint);
}

struct client *client_open(const char *text, int timeout_ms, char error[CLIENT_ERROR_MAX])
{
	char where[ADDRESS_TEXT_MAX], sentence[ADDRESS_ERROR_MAX];
	struct address address;
	if (!text || !text[0])
		text = address_default(where);
	if (address_parse(text, ADDRESS_UNIX | ADDRESS_TCP, &address, sentence)) {
		fail(error, -EINVAL, "%s", sentence);
		return NULL;
	}
	struct client *client = calloc(1, sizeof(*client));
	if (!client) {
		fail(error, -ENOMEM, "memory is out");
		return NULL;
	}
	address_print(&address, client->address);
	client->mirror = native_mirror_create();
	client->fd = client->mirror ? open_socket(&address, timeout_ms) : -ENOMEM;
	if (client->fd < 0) {
		say_why_not(client->address, client->fd, error);
		client_close(client);
		return NULL;
	}
	return client;
}

void client_close(struct client *client)
{
	if (!client)
		return;
	if (client->fd >= 0)
		close(client->fd);
	native_mirror_destroy(client->mirror);
	free(client->data);
	free(client);
}

const char *client_address(const struct client *client)
{
	return client->address;
}

int client_fd(const struct client *client)
{
	return client->fd;
}

const struct native_mirror *client_mirror(const struct client *client)
{
	return client->mirror;
}

uint64_t client_bytes(const struct client *client)
{
	return client->bytes;
}

static int lost(const struct client *client, int code, char error[CLIENT_ERROR_MAX])
{
	return fail(error, code, "%s: the connection is lost (%s)", client->address,
	            client->reason[0]     ? client->reason
	            : code == -ECONNRESET ? "the daemon closed it"
	                                  : strerror(-code));
}

static int send_all(struct client *client, const void *data, size_t len, char error[CLIENT_ERROR_MAX])
{
	const int64_t until_ms = now_ms() + 5000;
	const uint8_t *p = data;
	while (len > 0) {
		const ssize_t n = send(client->fd, p, len, MSG_NOSIGNAL);
		if (n > 0) {
			p += n;
			len -= (size_t)n;
			continue;
		}
		if (errno != EAGAIN && errno != EINTR)
			return lost(client, -errno, error);
		if (wait_for(client->fd, POLLOUT, until_ms) <= 0)
			return fail(error, -ETIMEDOUT, "%s: the daemon does not read", client->address);
	}
	return 0;
}

/* Room for one more chunk. What was handled is dropped first, so the buffer holds at most one frame and a chunk. */
static int make_room(struct client *client, char error[CLIENT_ERROR_MAX])
{
	if (client->begin > 0) {
		memmove(client->data, client->data + client->begin, client->end - client->begin);
		client->end -= client->begin;
		client->begin = 0;
	}
	if (client->cap - client->end >= READ_CHUNK)
		return 0;
	const size_t cap = 2 * client->cap > client->end + READ_CHUNK ? 2 * client->cap : client->end + READ_CHUNK;
	uint8_t *data = realloc(client->data, cap);
	if (!data)
		return fail(error, -ENOMEM, "memory is out");
	client->data = data;
	client->cap = cap;
	return 0;
}

/* 1: something was read, 0: time is over, -errno. */
static int read_more(struct client *client, int64_t until_ms, char error[CLIENT_ERROR_MAX])
{
	const int room = make_room(client, error);
	if (room)
		return room;
	for (;;) {
		const ssize_t n = recv(client->fd, client->data + client->end, client->cap - client->end, 0);
		if (n > 0) {
			client->end += (size_t)n;
			client->bytes += (uint64_t)n;
			return 1;
		}
		if (n == 0)
			return lost(client, -ECONNRESET, error);
		if (errno == EINTR)
			continue;
		if (errno != EAGAIN)
			return lost(client, -errno, error);
		const int ready = wait_for(client->fd, POLLIN, until_ms);
		if (ready <= 0)
			return ready;
	}
}

int client_want(struct client *client, const struct native_want *want, char error[CLIENT_ERROR_MAX])
{
	struct buffer bytes = {0};
	native_put_want(&bytes, want);
	const int status =
	    bytes.error ? fail(error, -ENOMEM, "memory is out") : send_all(client, bytes.data, bytes.len, error);
	buffer_finish(&bytes);
	return status;
}

/* The daemon says why before it closes: {"error": "..."}. */
static void keep_reason(struct client *client, const char *text, size_t len)
{
	json_t *json = json_loadb(text, len, JSON_DISABLE_EOF_CHECK, NULL);
	const char *reason = json_string_value(json_object_get(json, "error"));
	if (reason)
		snprintf(client->reason, sizeof(client->reason), "%s", reason);
	json_decref(json);
}

/* Handles the first whole frame: 1 after a COMMIT, 0, -EAGAIN: there is none, or another -errno with a sentence. */
static int take_frame(struct client *client, char error[CLIENT_ERROR_MAX])
{
	char sentence[128] = "the length of a frame is impossible";
	struct native_message message;
	if (client->begin == client->end)
		return -EAGAIN;
	const uint8_t *frame = client->data + client->begin;
	const ssize_t n = native_scan(frame, client->end - client->begin, NATIVE_TO_CLIENT_MAX);
	if (n == 0)
		return -EAGAIN;
	int status = n < 0 ? (int)n : native_decode(frame, (size_t)n, &message, sentence);
	if (n > 0)
		client->begin += (size_t)n;
	if (status == -ENOTSUP)
		return 0;
	if (status == 0 && message.type == NATIVE_JSON)
		keep_reason(client, message.json.text, message.json.len);
	if (status == 0)
		status = native_mirror_apply(client->mirror, &message, sentence);
	return status < 0 ? fail(error, status, "%s: %s", client->address, sentence) : status;
}

int client_commit(struct client *client, int timeout_ms, char error[CLIENT_ERROR_MAX])
{
	const int64_t until_ms = now_ms() + timeout_ms;
	for (;;) {
		int status = take_frame(client, error);
		if (status == -EAGAIN) {
			status = read_more(client, until_ms, error);
			if (status <= 0)
				return status;
		} else if (status != 0) {
			return status;
		}
	}
}

int client_say(struct client *client, const char *line, char error[CLIENT_ERROR_MAX])
{
	struct buffer bytes = {0};
	/* In one piece: who answers the line may close before a second one arrives. */
	buffer_printf(&bytes, "%s\n", line);
	const int status =
	    bytes.error ? fail(error, -ENOMEM, "memory is out") : send_all(client, bytes.data, bytes.len, error);
	buffer_finish(&bytes);
	return status;
}

int client_line(struct client *client, int timeout_ms, const char **ret_line, char error[CLIENT_ERROR_MAX])
{
	const int64_t until_ms = now_ms() + timeout_ms;
	for (;;) {
		const size_t len = client->end - client->begin;
		uint8_t *newline = len ? memchr(client->data + client->begin, '\n', len) : NULL;
		if (newline) {
			*newline = '\0';
			*ret_line = (const char *)client->data + client->begin;
			client->begin = (size_t)(newline - client->data) + 1;
			return 1;
		}
		if (len > CLIENT_LINE_MAX)
			return fail(error, -EPROTO, "%s: a line without an end", client->address);
		const int status = read_more(client, until_ms, error);
		if (status <= 0)
			return status;
	}
}

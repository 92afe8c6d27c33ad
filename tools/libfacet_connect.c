/* Connecting within a time limit. Names outside loopback may need a name server: a client may wait for one, the daemon
 * never does. */
#include <errno.h>
#include <netdb.h>
#include <poll.h>
#include <stdlib.h>
#include <sys/random.h>
#include <stdio.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "config/address.h"
#include "tools/libfacet.h"
#include "tools/libfacet_websocket.h"

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

static int wait_until_connected(int fd, int timeout_ms)
{
	int error = 0, n;
	socklen_t size = sizeof(error);
	struct pollfd poll_fd = {.fd = fd, .events = POLLOUT};
	do
		n = poll(&poll_fd, 1, timeout_ms);
	while (n < 0 && errno == EINTR);
	if (n <= 0)
		return n ? -errno : -ETIMEDOUT;
	getsockopt(fd, SOL_SOCKET, SO_ERROR, &error, &size);
	return -error;
}

int libfacet_connect(const struct address *address, int timeout_ms)
{
	struct sockaddr_storage to;
	socklen_t len;
	int error = resolve(address, &to, &len);
	if (error)
		return error;
	const int fd = socket(to.ss_family, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
	if (fd < 0)
		return -errno;
	if (connect(fd, (const struct sockaddr *)&to, len))
		error = errno == EINPROGRESS ? wait_until_connected(fd, timeout_ms) : -errno;
	if (error) {
		close(fd);
		return error;
	}
	return fd;
}

int64_t libfacet_now_ms(void)
{
	struct timespec t;
	clock_gettime(CLOCK_MONOTONIC, &t);
	return (int64_t)t.tv_sec * 1000 + t.tv_nsec / 1000000;
}

/* Waits for the rest of the answer until `until_ms`, bytes of `got` [0, *len) being there. Its length, or -errno. */
static ssize_t await_answer(int fd, const uint8_t key[16], int64_t until_ms, uint8_t got[WEBSOCKET_HEAD_MAX],
                            size_t *len, char error[WEBSOCKET_ERROR_MAX])
{
	for (;;) {
		const int64_t left = until_ms - libfacet_now_ms();
		struct pollfd poll_fd = {.fd = fd, .events = POLLIN};
		const int ready = poll(&poll_fd, 1, left > 0 ? (int)left : 0);
		if (ready == 0)
			snprintf(error, WEBSOCKET_ERROR_MAX, "it takes the connection and does not answer");
		if (ready == 0 || (ready < 0 && errno != EINTR))
			return ready ? -errno : -ETIMEDOUT;
		const ssize_t n = ready > 0 ? recv(fd, got + *len, WEBSOCKET_HEAD_MAX - *len, 0) : -1;
		if (n == 0)
			snprintf(error, WEBSOCKET_ERROR_MAX, "it closes the connection without an answer");
		if (n == 0 || (n < 0 && errno != EAGAIN && errno != EINTR))
			return n ? -errno : -ECONNRESET;
		*len += n > 0 ? (size_t)n : 0;
		const ssize_t head = websocket_judge(got, *len, key, error);
		if (head)
			return head;
	}
}

int libfacet_upgrade(int fd, const struct address *address, int timeout_ms, struct buffer *ret_rest,
                     char error[FACET_ERROR_MAX])
{
	const int64_t until_ms = libfacet_now_ms() + timeout_ms;
	char sentence[WEBSOCKET_ERROR_MAX] = "the request cannot be sent";
	uint8_t key[16], got[WEBSOCKET_HEAD_MAX];
	struct buffer request = {0};
	size_t len = 0;
	ssize_t head = getrandom(key, sizeof(key), 0) == sizeof(key) ? 0 : -EIO;
	websocket_put_request(&request, address, key);
	/* Less than a kilobyte, into an empty socket. */
	if (!head && (request.error || send(fd, request.data, request.len, MSG_NOSIGNAL) != (ssize_t)request.len))
		head = -EIO;
	buffer_finish(&request);
	head = head ? head : await_answer(fd, key, until_ms, got, &len, sentence);
	if (head < 0) {
		char where[ADDRESS_TEXT_MAX];
		address_print(address, where);
		snprintf(error, FACET_ERROR_MAX, "%.120s: %s", where, sentence);
		return (int)head;
	}
	buffer_append(ret_rest, got + head, len - (size_t)head);
	return ret_rest->error;
}

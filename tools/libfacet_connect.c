/* Connecting within a time limit. Names outside loopback may need a name server: a client may wait for one, the daemon
 * never does. */
#include <errno.h>
#include <netdb.h>
#include <poll.h>
#include <stdio.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "config/address.h"
#include "tools/libfacet.h"

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

/* A Modbus server of the test's own, independent of libmodbus: several units behind one pseudo-terminal or TCP port, that
 * can be mute or late. Register 0 of each unit says its number, register 1 counts its requests. */
#ifndef FACET_TESTS_MODBUS_PEER_H
#define FACET_TESTS_MODBUS_PEER_H

#include <fcntl.h>
#include <netinet/in.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <termios.h>
#include <unistd.h>

#define PEER_UNITS 4

struct peer {
	atomic_int fd; /* the pty's master, or the TCP connection (-1: none) */
	int slave, listener;
	char connect[64];
	pthread_t thread;
	atomic_bool stop;
	atomic_bool mute[PEER_UNITS];
	atomic_int late_ms[PEER_UNITS]; /* of its next answer */
	atomic_int requests[PEER_UNITS], connections;
	uint8_t buf[600];
	size_t len;
};

static inline uint16_t peer_crc(const uint8_t *p, size_t n)
{
	uint16_t crc = 0xffff;

	while (n--) {
		crc ^= *p++;
		for (int i = 0; i < 8; i++)
			crc = (uint16_t)(crc & 1 ? crc >> 1 ^ 0xa001 : crc >> 1);
	}
	return crc;
}

/* The answer to a request, function byte first: its length. */
static inline size_t peer_answer(const uint8_t *pdu, int unit, int count, uint8_t *ret)
{
	int n = pdu[3] << 8 | pdu[4];

	if (pdu[0] != 3 && pdu[0] != 4) {
		memcpy(ret, pdu, 5);
		return 5;
	}
	ret[0] = pdu[0];
	ret[1] = (uint8_t)(2 * n);
	memset(ret + 2, 0, 2 * (size_t)n);
	ret[3] = (uint8_t)unit;
	if (n > 1) {
		ret[4] = (uint8_t)(count >> 8);
		ret[5] = (uint8_t)count;
	}
	return 2 + 2 * (size_t)n;
}

/* One request of `unit`; the head (TCP) is sent before the answer, a check sum (RTU) after it. */
static inline void peer_serve(struct peer *p, const uint8_t *head, size_t head_len, int unit, const uint8_t *pdu)
{
	uint8_t out[300];
	size_t len;
	int late_ms;

	if (unit >= PEER_UNITS)
		return;
	memcpy(out, head, head_len);
	out[head_len] = (uint8_t)unit;
	len = 1 + peer_answer(pdu, unit, p->requests[unit]++, out + head_len + 1);
	if (head_len) {
		out[4] = (uint8_t)(len >> 8);
		out[5] = (uint8_t)len;
	} else {
		const uint16_t crc = peer_crc(out, len);

		out[len++] = (uint8_t)crc;
		out[len++] = (uint8_t)(crc >> 8);
	}
	if (p->mute[unit])
		return;
	late_ms = atomic_exchange(&p->late_ms[unit], 0);
	if (late_ms)
		usleep((useconds_t)late_ms * 1000);
	(void)!write(p->fd, out, head_len + len);
}

/* Serves what is whole in the buffer; a byte that begins no request is dropped. */
static inline void peer_parse(struct peer *p)
{
	const bool tcp = p->listener >= 0;

	while (p->len >= 8) {
		size_t n = tcp ? 6 + (size_t)(p->buf[4] << 8 | p->buf[5]) : p->buf[1] == 16 ? 9 + (size_t)p->buf[6] : 8;
		bool good = tcp || n > sizeof p->buf || p->len < n ||
		            peer_crc(p->buf, n - 2) == (p->buf[n - 2] | p->buf[n - 1] << 8);

		if (p->len < n)
			return;
		if (good && tcp)
			peer_serve(p, p->buf, 6, p->buf[6], p->buf + 7);
		else if (good)
			peer_serve(p, p->buf, 0, p->buf[0], p->buf + 1);
		n = good ? n : 1;
		p->len -= n;
		memmove(p->buf, p->buf + n, p->len);
	}
}

static inline void peer_accept(struct peer *p)
{
	struct pollfd in = {.fd = p->listener, .events = POLLIN};

	if (p->fd >= 0 || p->listener < 0 || poll(&in, 1, 20) <= 0)
		return;
	p->fd = accept(p->listener, NULL, NULL);
	p->len = 0;
	p->connections++;
}

static inline void *peer_thread(void *arg)
{
	struct peer *p = arg;

	while (!p->stop) {
		struct pollfd in = {.fd = p->fd, .events = POLLIN};
		ssize_t n;

		peer_accept(p);
		if (p->fd < 0 || poll(&in, 1, 20) <= 0)
			continue;
		n = read(p->fd, p->buf + p->len, sizeof p->buf - p->len);
		if (n > 0) {
			p->len += (size_t)n;
			peer_parse(p);
		} else if (p->listener >= 0) {
			close(p->fd);
			p->fd = -1;
		}
	}
	return NULL;
}

static inline void peer_start(struct peer *p, bool tcp)
{
	struct sockaddr_in address = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
	socklen_t len = sizeof address;
	struct termios raw;

	signal(SIGPIPE, SIG_IGN); /* whoever asked may have gone before it is answered */
	memset(p, 0, sizeof *p);
	p->fd = p->slave = p->listener = -1;
	if (tcp) {
		p->listener = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
		assert_int_equal(bind(p->listener, (struct sockaddr *)&address, len), 0);
		assert_int_equal(listen(p->listener, 4), 0);
		assert_int_equal(getsockname(p->listener, (struct sockaddr *)&address, &len), 0);
		snprintf(p->connect, sizeof p->connect, "127.0.0.1:%d", ntohs(address.sin_port));
	} else {
		p->fd = posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC);
		assert_int_equal(grantpt(p->fd) | unlockpt(p->fd) | ptsname_r(p->fd, p->connect, sizeof p->connect), 0);
		p->slave = open(p->connect, O_RDWR | O_NOCTTY | O_CLOEXEC);
		tcgetattr(p->slave, &raw);
		cfmakeraw(&raw);
		tcsetattr(p->slave, TCSANOW, &raw);
	}
	assert_int_equal(pthread_create(&p->thread, NULL, peer_thread, p), 0);
}

static inline void peer_end(struct peer *p)
{
	p->stop = true;
	pthread_join(p->thread, NULL);
	for (int i = 0; i < 3; i++) {
		const int fd = i == 0 ? p->fd : i == 1 ? p->slave : p->listener;

		if (fd >= 0)
			close(fd);
	}
}

#endif

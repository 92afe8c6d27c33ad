/* Law: a connection to a scanner never makes anybody wait, and whatever ends it is said with host, port and what to do. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "daemon/supervisor.h"
#include "drivers/cola.h"

#define SECOND     1000000000ll
#define PATIENCE_S 120 /* for what the kernel does at once on loopback */

static int64_t monotonic_ns(void)
{
	struct timespec t;
	clock_gettime(CLOCK_MONOTONIC, &t);
	return t.tv_sec * SECOND + t.tv_nsec;
}

/* A socket bound to a port of loopback; it listens where `backlog` is not negative. */
static int bound(int backlog, int *ret_port)
{
	struct sockaddr_in a = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
	socklen_t len = sizeof a;
	const int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
	assert_true(fd >= 0);
	assert_int_equal(bind(fd, (struct sockaddr *)&a, sizeof a), 0);
	assert_int_equal(getsockname(fd, (struct sockaddr *)&a, &len), 0);
	if (backlog >= 0)
		assert_int_equal(listen(fd, backlog), 0);
	*ret_port = ntohs(a.sin_port);
	return fd;
}

static struct config_device to_port(int port)
{
	struct config_device config = {.name = "s", .driver = "lms1xx"};
	snprintf(config.connect, sizeof config.connect, "127.0.0.1:%d", port);
	return config;
}

static struct link *opened(const struct config_device *config)
{
	char error[160] = "";
	struct link *link = cola_tcp.open(config, error);
	if (!link)
		fail_msg("%s", error);
	assert_true(link->stream == &cola_tcp);
	return link;
}

static void wait_for(const struct link *link, short events)
{
	struct pollfd p = {.fd = cola_tcp.fd(link), .events = events};
	assert_int_equal(poll(&p, 1, PATIENCE_S * 1000), 1);
}

static ssize_t read_now(struct link *link, uint8_t *buf, size_t cap)
{
	int64_t t_ns = 77;
	const ssize_t n = cola_tcp.read(link, buf, cap, &t_ns);
	assert_int_equal(t_ns, 77); /* the caller knows the time as well */
	return n;
}

static void assert_told(const struct link *link, int error, int port, const char *part)
{
	char sentence[160], peer[40];
	cola_tcp.error(link, error, sentence);
	snprintf(peer, sizeof peer, "127.0.0.1:%d", port);
	if (!strstr(sentence, peer) || !strstr(sentence, part))
		fail_msg("expected '%s ... %s', got '%s'", peer, part, sentence);
}

static void bytes_pass_both_ways_as_soon_as_it_stands(void **state)
{
	(void)state;
	int port, value;
	socklen_t len = sizeof value;
	uint8_t buf[16];
	const int listener = bound(4, &port);
	const struct config_device config = to_port(port);
	struct link *link = opened(&config);
	wait_for(link, POLLOUT);
	assert_int_equal(read_now(link, buf, sizeof buf), 0);
	assert_int_equal(cola_tcp.write(link, (const uint8_t *)"hello", 5), 5);
	const int peer = accept(listener, NULL, NULL);
	assert_int_equal(recv(peer, buf, sizeof buf, 0), 5);
	assert_memory_equal(buf, "hello", 5);
	assert_int_equal(send(peer, "good day", 8, 0), 8);
	wait_for(link, POLLIN);
	assert_int_equal(read_now(link, buf, 0), 0); /* no room is no end */
	assert_int_equal(read_now(link, buf, 4), 4);
	assert_int_equal(read_now(link, buf + 4, 12), 4);
	assert_memory_equal(buf, "good day", 8);
	assert_int_equal(read_now(link, buf, sizeof buf), 0);
	assert_int_equal(getsockopt(cola_tcp.fd(link), IPPROTO_TCP, TCP_NODELAY, &value, &len), 0);
	assert_int_equal(value, 1);
	assert_int_equal(getsockopt(cola_tcp.fd(link), SOL_SOCKET, SO_KEEPALIVE, &value, &len), 0);
	assert_int_equal(value, 1);
	assert_int_equal(getsockopt(cola_tcp.fd(link), IPPROTO_TCP, TCP_USER_TIMEOUT, &value, &len), 0);
	assert_int_equal(value, 5000);
	cola_tcp.close(link);
	close(peer);
	close(listener);
}

static void the_usual_port_is_2112(void **state)
{
	(void)state;
	struct config_device config = {.connect = "127.0.0.1"};
	char error[160] = "";
	struct link *link = cola_tcp.open(&config, error);
	char sentence[160];
	if (link) {
		cola_tcp.error(link, ECONNREFUSED, sentence);
		cola_tcp.close(link);
	} else {
		strcpy(sentence, error);
	}
	assert_non_null(strstr(sentence, "127.0.0.1:2112 refuses the connection"));
}

static void a_refused_connection_is_said(void **state)
{
	(void)state;
	int port;
	uint8_t buf[16];
	const int nobody = bound(-1, &port); /* the port is taken, and nobody listens */
	const struct config_device config = to_port(port);
	char error[160] = "";
	struct link *link = cola_tcp.open(&config, error);
	if (link) {
		wait_for(link, POLLIN);
		assert_int_equal(read_now(link, buf, sizeof buf), -ECONNREFUSED);
		assert_told(link, ECONNREFUSED, port, "refuses the connection: is this the scanner's address");
		cola_tcp.close(link);
		link = opened(&config);
		wait_for(link, POLLOUT);
		assert_int_equal(cola_tcp.write(link, buf, 1), -ECONNREFUSED);
		cola_tcp.close(link);
	} else {
		assert_non_null(strstr(error, "refuses the connection"));
	}
	close(nobody);
}

static void an_unreachable_host_is_said_at_once(void **state)
{
	(void)state;
	const struct config_device config = {.connect = "255.255.255.255:2112"}; /* no TCP goes to everybody */
	char error[160] = "";
	assert_null(cola_tcp.open(&config, error));
	assert_non_null(strstr(error, "255.255.255.255:2112 cannot be reached: check cable and power"));
}

static void an_address_that_is_none_is_said(void **state)
{
	(void)state;
	const struct config_device config = {.connect = "scanner.example"};
	char error[160] = "";
	assert_null(cola_tcp.open(&config, error));
	assert_non_null(strstr(error, "names are not looked up"));
}

/* A listener whose queue is full answers no SYN, like a host that is not there. */
static int full_listener(int *ret_port, int client[8])
{
	const int listener = bound(0, ret_port);
	for (int i = 0; i < 8; i++) {
		struct sockaddr_in a = {.sin_family = AF_INET,
		                        .sin_addr.s_addr = htonl(INADDR_LOOPBACK),
		                        .sin_port = htons((uint16_t)*ret_port)};
		client[i] = socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
		connect(client[i], (struct sockaddr *)&a, sizeof a);
	}
	return listener;
}

static void close_full(int listener, const int client[8])
{
	for (int i = 0; i < 8; i++)
		close(client[i]);
	close(listener);
}

static void a_connect_that_hangs_makes_nobody_wait(void **state)
{
	(void)state;
	int port, client[8];
	uint8_t buf[16];
	const int listener = full_listener(&port, client);
	const struct config_device config = to_port(port);
	const int64_t begin_ns = monotonic_ns();
	struct link *link = opened(&config);
	assert_int_equal(read_now(link, buf, sizeof buf), 0);
	assert_int_equal(cola_tcp.write(link, buf, 5), 0);
	assert_true(monotonic_ns() - begin_ns < SECOND);
	assert_told(link, ETIMEDOUT, port, "does not answer: check cable, power and address");
	cola_tcp.close(link);
	close_full(listener, client);
}

static void a_reset_is_said(void **state)
{
	(void)state;
	int port;
	uint8_t buf[16];
	const int listener = bound(4, &port);
	const struct config_device config = to_port(port);
	struct link *link = opened(&config);
	wait_for(link, POLLOUT);
	assert_int_equal(cola_tcp.write(link, (const uint8_t *)"hello", 5), 5);
	const int peer = accept(listener, NULL, NULL);
	const struct linger now = {.l_onoff = 1};
	setsockopt(peer, SOL_SOCKET, SO_LINGER, &now, sizeof now);
	close(peer);
	wait_for(link, POLLIN);
	assert_int_equal(read_now(link, buf, sizeof buf), -ECONNRESET);
	assert_told(link, ECONNRESET, port, "broke the connection off");
	assert_told(link, ETIMEDOUT, port, "does not answer any more"); /* it did before */
	cola_tcp.close(link);
	close(listener);
}

static void a_half_closed_connection_is_lost_after_its_last_byte(void **state)
{
	(void)state;
	int port;
	uint8_t buf[16];
	const int listener = bound(4, &port);
	const struct config_device config = to_port(port);
	struct link *link = opened(&config);
	wait_for(link, POLLOUT);
	const int peer = accept(listener, NULL, NULL);
	assert_int_equal(send(peer, "end", 3, 0), 3);
	shutdown(peer, SHUT_WR);
	wait_for(link, POLLIN);
	assert_int_equal(read_now(link, buf, sizeof buf), 3);
	wait_for(link, POLLIN);
	assert_int_equal(read_now(link, buf, sizeof buf), -EPIPE);
	assert_told(link, EPIPE, port, "closed the connection");
	cola_tcp.close(link);
	close(peer);
	close(listener);
}

/* Nobody listens, and the kernel may choose the port itself as its own end: then it would talk to itself. */
static void nobody_is_taken_for_itself(void **state)
{
	(void)state;
	int port, met = 0;
	uint8_t buf[4];
	close(bound(-1, &port));
	const struct config_device config =
	    to_port(port ^ 1); /* bind takes the odd ones first, connect the even ones */
	for (int i = 0; i < 60000 && !met; i++) {
		char error[160];
		struct link *link = cola_tcp.open(&config, error);
		if (!link)
			continue;
		struct sockaddr_in peer;
		socklen_t len = sizeof peer;
		met = getpeername(cola_tcp.fd(link), (struct sockaddr *)&peer, &len) == 0;
		assert_int_equal(cola_tcp.write(link, buf, 1), -ECONNREFUSED);
		assert_true(read_now(link, buf, 1) < 0);
		cola_tcp.close(link);
	}
	print_message("note: the port met itself: %s\n", met ? "yes" : "not in 60000 tries");
}

/* Under the supervisor, in virtual time ------------------------------------------------------------------------- */

static struct {
	int fd;
	char log[400];
	int records;
} host;

static void watch(void *ctx, int device, int fd, bool readable, bool writable)
{
	(void)ctx, (void)device, (void)readable, (void)writable;
	host.fd = fd;
}

static void keep(void *ctx, const struct record *record)
{
	(void)ctx;
	host.records += record->direction != LINK_OPENED;
}

static void tell(void *ctx, int device, int priority, const char *text)
{
	(void)ctx, (void)device, (void)priority;
	snprintf(host.log, sizeof host.log, "%s", text);
}

static struct supervisor *supervise(struct config *config, int port)
{
	static const struct driver *drivers[1];
	const struct supervisor_host calls = {.watch = watch, .record = keep, .log = tell};
	memset(&host, 0, sizeof host);
	memset(config, 0, sizeof *config);
	config->devices = 1;
	config->device[0] = to_port(port);
	drivers[0] = driver_find("lms1xx");
	assert_non_null(drivers[0]);
	struct supervisor *s = supervisor_create(config, drivers, &calls);
	assert_non_null(s);
	return s;
}

static void a_connect_that_hangs_is_given_up_by_the_time_handed_in(void **state)
{
	(void)state;
	static struct config config;
	int port, client[8];
	const int listener = full_listener(&port, client);
	struct supervisor *s = supervise(&config, port);
	supervisor_start(s, 100 * SECOND);
	assert_int_equal(supervisor_device(s, 0)->state, SUPERVISOR_CONFIGURING);
	const int64_t due_ns = supervisor_deadline(s);
	assert_true(due_ns > 100 * SECOND && due_ns <= 102 * SECOND);
	supervisor_timer(s, due_ns - 1);
	assert_int_equal(supervisor_device(s, 0)->state, SUPERVISOR_CONFIGURING);
	supervisor_timer(s, due_ns);
	assert_int_equal(supervisor_device(s, 0)->state, SUPERVISOR_BACKING_OFF);
	assert_non_null(strstr(host.log, "does not answer: check cable, power and address"));
	assert_int_equal(host.records, 0);
	supervisor_destroy(s);
	close_full(listener, client);
}

static void a_loss_is_logged_with_its_sentence(void **state)
{
	(void)state;
	static struct config config;
	int port;
	const int nobody = bound(-1, &port);
	struct supervisor *s = supervise(&config, port);
	supervisor_start(s, 100 * SECOND);
	if (supervisor_device(s, 0)->state == SUPERVISOR_CONFIGURING) {
		struct pollfd p = {.fd = host.fd, .events = POLLIN};
		assert_int_equal(poll(&p, 1, PATIENCE_S * 1000), 1);
		supervisor_ready(s, 0, true, false, 100 * SECOND);
	}
	assert_int_equal(supervisor_device(s, 0)->state, SUPERVISOR_BACKING_OFF);
	assert_non_null(strstr(host.log, "refuses the connection: is this the scanner's address"));
	supervisor_destroy(s);
	close(nobody);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(bytes_pass_both_ways_as_soon_as_it_stands),
	    cmocka_unit_test(the_usual_port_is_2112),
	    cmocka_unit_test(a_refused_connection_is_said),
	    cmocka_unit_test(an_unreachable_host_is_said_at_once),
	    cmocka_unit_test(an_address_that_is_none_is_said),
	    cmocka_unit_test(a_connect_that_hangs_makes_nobody_wait),
	    cmocka_unit_test(a_reset_is_said),
	    cmocka_unit_test(a_half_closed_connection_is_lost_after_its_last_byte),
	    cmocka_unit_test(nobody_is_taken_for_itself),
	    cmocka_unit_test(a_connect_that_hangs_is_given_up_by_the_time_handed_in),
	    cmocka_unit_test(a_loss_is_logged_with_its_sentence),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

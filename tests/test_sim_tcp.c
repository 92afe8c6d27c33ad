/* Law: behind TCP a simulated scanner serves several clients, and its connections are refused, reset, left half-open or
 * unanswered when that was ordered, as a client's own socket sees it. Only patience depends on the machine's speed. */
#include <errno.h>
#include <netinet/in.h>
#include <poll.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cmocka.h>

#include "tools/sim_device.h"

#define PATIENCE_NS 120000000000ll
#define QUIET_NS    400000000ll /* nothing happens for so long: then it does not happen */
#define S           1000000000ll

struct bench {
	uv_loop_t loop;
	struct sim_tcp *tcp;
	int fd[3];
};

static void scene_scan(void *ctx, struct profile *p)
{
	(void)ctx;
	for (int i = 0; i < p->n; i++) {
		p->state[i] = BEAM_OK;
		p->range_m[i] = 2.0f;
	}
}

static int setup(void **state)
{
	const struct scene scene = {.scan = scene_scan};
	const struct sim_cola_params params = {.model = SIM_TIM561, .segments = true};
	struct bench *b = calloc(1, sizeof *b);
	struct sim_device device;
	char error[160];
	*state = b;
	uv_loop_init(&b->loop);
	if (sim_cola_create(&params, &scene, (int64_t)uv_hrtime(), &device) < 0)
		return -1;
	b->tcp = sim_tcp_create(&b->loop, 0, &device, error);
	for (int i = 0; i < 3; i++)
		b->fd[i] = -1;
	return b->tcp != NULL ? 0 : -1;
}

static int teardown(void **state)
{
	struct bench *b = *state;
	sim_tcp_destroy(b->tcp);
	uv_run(&b->loop, UV_RUN_NOWAIT);
	uv_run(&b->loop, UV_RUN_NOWAIT);
	for (int i = 0; i < 3; i++)
		if (b->fd[i] >= 0)
			close(b->fd[i]);
	const int busy = uv_loop_close(&b->loop);
	free(b);
	return busy;
}

static void turn(struct bench *b)
{
	uv_run(&b->loop, UV_RUN_NOWAIT);
	usleep(300);
}

#define UNTIL(b, condition)                                                   \
	do {                                                                  \
		const int64_t end_ns = (int64_t)uv_hrtime() + PATIENCE_NS;    \
		bool met = false;                                             \
		while (!(met = (condition)) && (int64_t)uv_hrtime() < end_ns) \
			turn(b);                                              \
		if (!met)                                                     \
			fail_msg("never: %s", #condition);                    \
	} while (0)

static void open_client(struct bench *b, int i)
{
	const struct sockaddr_in address = {.sin_family = AF_INET,
	                                    .sin_port = htons((uint16_t)sim_tcp_port(b->tcp)),
	                                    .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
	if (b->fd[i] >= 0)
		close(b->fd[i]);
	b->fd[i] = socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
	assert_true(b->fd[i] >= 0);
	if (connect(b->fd[i], (const struct sockaddr *)&address, sizeof address) < 0)
		assert_int_equal(errno, EINPROGRESS);
}

/* 0: connected; EINPROGRESS; or why not. */
static int connected(struct bench *b, int i)
{
	struct pollfd line = {.fd = b->fd[i], .events = POLLOUT};
	int error = 0;
	socklen_t len = sizeof error;
	if (poll(&line, 1, 0) == 0)
		return EINPROGRESS;
	getsockopt(b->fd[i], SOL_SOCKET, SO_ERROR, &error, &len);
	return error;
}

/* Bytes that came, 0: closed, -errno. */
static ssize_t hear(struct bench *b, int i)
{
	static char bytes[65536];
	const ssize_t n = recv(b->fd[i], bytes, sizeof bytes, 0);
	return n < 0 ? -errno : n;
}

static void ask(struct bench *b, int i, const char *request)
{
	assert_int_equal(send(b->fd[i], request, strlen(request), MSG_NOSIGNAL), (ssize_t)strlen(request));
}

static void stream(struct bench *b, int i)
{
	open_client(b, i);
	UNTIL(b, connected(b, i) == 0);
	ask(b, i, "\x02sEN LMDscandata 1\x03");
	UNTIL(b, hear(b, i) > 1000);
}

/* All that is there is heard; what `hear` says after that, or -EAGAIN when nothing comes for long. */
static ssize_t after_quiet(struct bench *b, int i)
{
	int64_t end_ns = (int64_t)uv_hrtime() + QUIET_NS;
	ssize_t n = -EAGAIN;
	while ((int64_t)uv_hrtime() < end_ns && (n = hear(b, i)) != 0 && (n > 0 || n == -EAGAIN)) {
		if (n > 0)
			end_ns = (int64_t)uv_hrtime() + QUIET_NS;
		turn(b);
	}
	return n;
}

static void order(struct bench *b, const char *kind, int64_t for_ns, bool on)
{
	struct sim_fault fault = {.for_ns = for_ns};
	snprintf(fault.kind, sizeof fault.kind, "%s", kind);
	assert_true(sim_tcp_fault(b->tcp, &fault, on));
}

static void several_clients_stream_at_once(void **state)
{
	struct bench *b = *state;
	stream(b, 0);
	stream(b, 1);
	UNTIL(b, hear(b, 0) > 1000);
	close(b->fd[0]); /* whoever came first may go first */
	b->fd[0] = -1;
	for (int i = 0; i < 3; i++)
		UNTIL(b, hear(b, 1) > 1000);
	stream(b, 2);
	stream(b, 0);
	UNTIL(b, hear(b, 1) > 1000);
}

static void a_reset_is_seen_and_a_new_connection_serves(void **state)
{
	struct bench *b = *state;
	stream(b, 0);
	order(b, "reset", 0, true);
	UNTIL(b, hear(b, 0) == -ECONNRESET);
	stream(b, 0);
}

static void refused_connections_are_refused_as_long_as_ordered(void **state)
{
	struct bench *b = *state;
	const int port = sim_tcp_port(b->tcp);
	stream(b, 0);
	order(b, "refuse", S, true);
	UNTIL(b, hear(b, 0) == -ECONNRESET);
	open_client(b, 0);
	UNTIL(b, connected(b, 0) == ECONNREFUSED);
	order(b, "refuse", S, false);
	assert_int_equal(sim_tcp_port(b->tcp), port);
	stream(b, 0);
}

static void unanswered_connections_hang(void **state)
{
	struct bench *b = *state;
	stream(b, 0);
	order(b, "timeout", S, true);
	assert_int_equal(after_quiet(b, 0), -EAGAIN);
	open_client(b, 1);
	for (const int64_t end_ns = (int64_t)uv_hrtime() + QUIET_NS; (int64_t)uv_hrtime() < end_ns;)
		turn(b);
	assert_int_equal(connected(b, 1), EINPROGRESS);
	order(b, "timeout", S, false);
	stream(b, 1);
}

static void half_open_connections_stay_and_are_silent(void **state)
{
	struct bench *b = *state;
	stream(b, 0);
	order(b, "half-open", 0, true);
	assert_int_equal(after_quiet(b, 0), -EAGAIN);
	ask(b, 0, "\x02sRN SerialNumber\x03");
	assert_int_equal(after_quiet(b, 0), -EAGAIN);
	stream(b, 1);
	assert_int_equal(after_quiet(b, 0), -EAGAIN);
}

static void unplugged_it_is_silent_and_goes_on_when_it_is_back(void **state)
{
	struct bench *b = *state;
	stream(b, 0);
	order(b, "unplug", S, true);
	assert_int_equal(after_quiet(b, 0), -EAGAIN);
	open_client(b, 1);
	assert_int_equal(after_quiet(b, 0), -EAGAIN);
	assert_int_equal(connected(b, 1), EINPROGRESS);
	order(b, "unplug", S, false);
	UNTIL(b, hear(b, 0) > 1000);
	stream(b, 1);
}

static void after_power_is_back_it_knows_no_connection(void **state)
{
	struct bench *b = *state;
	stream(b, 0);
	order(b, "power", S, true);
	assert_int_equal(after_quiet(b, 0), -EAGAIN);
	open_client(b, 1);
	for (int i = 0; i < 100; i++)
		turn(b);
	assert_int_equal(connected(b, 1), EINPROGRESS);
	order(b, "power", S, false);
	UNTIL(b, hear(b, 0) == -ECONNRESET);
	stream(b, 0);
}

static void a_client_that_does_not_read_holds_nobody_up(void **state)
{
	struct bench *b = *state;
	const int small = 4096;
	stream(b, 0);
	setsockopt(b->fd[0], SOL_SOCKET, SO_RCVBUF, &small, sizeof small);
	order(b, "garbage", INT64_MAX, true); /* fills its buffers */
	stream(b, 1);
	for (int i = 0; i < 20; i++)
		UNTIL(b, hear(b, 1) > 1000);
	order(b, "garbage", INT64_MAX, false);
}

static void unknown_faults_are_refused(void **state)
{
	struct bench *b = *state;
	const struct sim_fault fault = {.kind = "smoke"};
	assert_false(sim_tcp_fault(b->tcp, &fault, true));
}

int main(void)
{
#define BENCHED(name) cmocka_unit_test_setup_teardown(name, setup, teardown)
	const struct CMUnitTest tests[] = {
	    BENCHED(several_clients_stream_at_once),
	    BENCHED(a_reset_is_seen_and_a_new_connection_serves),
	    BENCHED(refused_connections_are_refused_as_long_as_ordered),
	    BENCHED(unanswered_connections_hang),
	    BENCHED(half_open_connections_stay_and_are_silent),
	    BENCHED(unplugged_it_is_silent_and_goes_on_when_it_is_back),
	    BENCHED(after_power_is_back_it_knows_no_connection),
	    BENCHED(a_client_that_does_not_read_holds_nobody_up),
	    BENCHED(unknown_faults_are_refused),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

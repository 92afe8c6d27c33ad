/* Law: whoever orders faults at the socket gets one line for each of his, however they are cut or glued, and nobody who
 * says too much or too little holds anybody up. Only patience depends on the machine's speed. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include <cmocka.h>

#include "tools/sim_control.h"

#define PATIENCE_NS 120000000000ll

struct bench {
	uv_loop_t loop;
	char dir[32], path[64];
	struct sim_control *control;
	struct fault_target target;
	char done[8][80]; /* what was carried out, in order */
	int n;
};

static bool carry_out(void *ctx, const struct sim_fault *fault, bool on)
{
	struct bench *b = ctx;
	snprintf(b->done[b->n++ % 8], 80, "%s %g %s", fault->kind, fault->value, on ? "on" : "off");
	return true;
}

static void say_status(void *ctx, char ret[SIM_CONTROL_STATUS_MAX])
{
	(void)ctx;
	snprintf(ret, SIM_CONTROL_STATUS_MAX, "laser: well");
}

static struct sim_control *create(struct bench *b, char error[FAULT_ERROR_MAX])
{
	const struct sim_control_params params = {
	    .socket = b->path, .target = &b->target, .targets = 1, .ctx = b, .order = carry_out, .status = say_status};
	return sim_control_create(&b->loop, &params, error);
}

static int setup(void **state)
{
	static const char *const kinds[] = {"garbage", "nak", NULL};
	char error[FAULT_ERROR_MAX];
	struct bench *b = calloc(1, sizeof *b);
	*state = b;
	strcpy(b->dir, "/tmp/facet-control-XXXXXX");
	if (mkdtemp(b->dir) == NULL)
		return -1;
	snprintf(b->path, sizeof b->path, "%s/simulator.sock", b->dir);
	b->target = (struct fault_target){"laser", {kinds, NULL}};
	uv_loop_init(&b->loop);
	b->control = create(b, error);
	return b->control != NULL ? 0 : -1;
}

static int teardown(void **state)
{
	struct bench *b = *state;
	struct stat st;
	sim_control_destroy(b->control);
	uv_run(&b->loop, UV_RUN_DEFAULT);
	const int left = stat(b->path, &st) == 0, busy = uv_loop_close(&b->loop);
	rmdir(b->dir);
	free(b);
	return left || busy;
}

static int call(const struct bench *b)
{
	struct sockaddr_un address = {.sun_family = AF_UNIX};
	const int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
	strcpy(address.sun_path, b->path);
	assert_int_equal(connect(fd, (const struct sockaddr *)&address, sizeof address), 0);
	return fd;
}

/* What comes until `end` (or the connection's end, where it is NULL). */
static void hear(struct bench *b, int fd, const char *end, char ret[4096])
{
	const int64_t end_ns = (int64_t)uv_hrtime() + PATIENCE_NS;
	size_t len = 0;
	ret[0] = '\0';
	while ((int64_t)uv_hrtime() < end_ns && (end == NULL || strstr(ret, end) == NULL)) {
		uv_run(&b->loop, UV_RUN_NOWAIT);
		const ssize_t n = recv(fd, ret + len, 4095 - len, MSG_DONTWAIT);
		if (n == 0)
			break;
		len += n > 0 ? (size_t)n : 0;
		ret[len] = '\0';
		usleep(200);
	}
}

static void expect(struct bench *b, int fd, const char *said, const char *answer)
{
	char heard[4096];
	assert_int_equal(send(fd, said, strlen(said), MSG_NOSIGNAL), (ssize_t)strlen(said));
	hear(b, fd, answer, heard);
	assert_string_equal(heard, answer);
}

static void each_line_is_answered_by_one_line(void **state)
{
	struct bench *b = *state;
	const int fd = call(b);
	expect(b, fd, "status\n", "laser: well\n");
	expect(b, fd, "laser: nak 3\n", "ok\n");
	expect(b, fd, "laser: smoke\r\n", "error: 'smoke': laser has no such fault; it has garbage, nak\n");
	expect(b, fd, "{\"fault\": \"laser: nak\"}\n", "{\"ok\":true}\n");
	expect(b, fd, "{\"status\": true}\n", "{\"ok\":true,\"status\":\"laser: well\"}\n");
	expect(b, fd, "{\n", "{\"ok\":false,\"error\":\"this is no JSON object in one line\"}\n");
	expect(b, fd, "status\nlaser: nak\n\nstatus\n", "laser: well\nok\nlaser: well\n");
	expect(b, fd, "sta", "");
	close(fd);
	assert_int_equal(b->n, 3);
	assert_string_equal(b->done[0], "nak 3 on");
}

static void a_cut_line_is_one_line(void **state)
{
	struct bench *b = *state;
	const int fd = call(b);
	for (const char *c = "status"; *c; c++) {
		assert_int_equal(send(fd, c, 1, MSG_NOSIGNAL), 1);
		for (int i = 0; i < 5; i++)
			uv_run(&b->loop, UV_RUN_NOWAIT);
	}
	expect(b, fd, "\n", "laser: well\n");
	close(fd);
}

static void who_says_too_much_is_told_and_left(void **state)
{
	struct bench *b = *state;
	char line[2000], heard[4096];
	const int fd = call(b);
	memset(line, 'x', sizeof line);
	assert_int_equal(send(fd, line, sizeof line, MSG_NOSIGNAL), (ssize_t)sizeof line);
	hear(b, fd, "\n", heard);
	assert_string_equal(heard, "error: a line has at most 1023 characters\n");
	close(fd);
	const int other = call(b);
	expect(b, other, "status\n", "laser: well\n");
	close(other);
}

static void a_fifth_caller_is_let_go_and_the_others_stay(void **state)
{
	struct bench *b = *state;
	char heard[4096];
	int fd[5];
	for (int i = 0; i < 4; i++) {
		fd[i] = call(b);
		expect(b, fd[i], "status\n", "laser: well\n");
	}
	fd[4] = call(b);
	hear(b, fd[4], NULL, heard);
	assert_string_equal(heard, "");
	for (int i = 0; i < 5; i++) {
		if (i < 4)
			expect(b, fd[i], "status\n", "laser: well\n");
		close(fd[i]);
	}
}

static void a_fault_ends_after_its_time(void **state)
{
	struct bench *b = *state;
	char error[FAULT_ERROR_MAX];
	const int64_t end_ns = (int64_t)uv_hrtime() + PATIENCE_NS;
	assert_int_equal(sim_control_order(b->control, "laser: garbage at 10ms for 20ms", error), 0);
	while (b->n < 2 && (int64_t)uv_hrtime() < end_ns) {
		uv_run(&b->loop, UV_RUN_NOWAIT);
		usleep(500);
	}
	assert_string_equal(b->done[0], "garbage 0 on");
	assert_string_equal(b->done[1], "garbage 0 off");
}

static void a_second_one_in_the_same_place_is_refused(void **state)
{
	struct bench *b = *state;
	char error[FAULT_ERROR_MAX] = "";
	assert_null(create(b, error));
	assert_non_null(strstr(error, "does another simulator use this directory?"));
}

int main(void)
{
#define BENCHED(name) cmocka_unit_test_setup_teardown(name, setup, teardown)
	const struct CMUnitTest tests[] = {
	    BENCHED(each_line_is_answered_by_one_line),  BENCHED(a_cut_line_is_one_line),
	    BENCHED(who_says_too_much_is_told_and_left), BENCHED(a_fifth_caller_is_let_go_and_the_others_stay),
	    BENCHED(a_fault_ends_after_its_time),        BENCHED(a_second_one_in_the_same_place_is_refused),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

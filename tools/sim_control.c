/* The desk where faults are ordered (sim_control.h): a plan, a timer, and a socket. At most four clients; a line that is
 * too long is answered and its client closed. */
#include "tools/sim_control.h"

#include <errno.h>
#include <jansson.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "drivers/unix_socket.h"

enum { CLIENTS = 4, LINE_MAX_BYTES = 1024, ANSWER_MAX = SIM_CONTROL_STATUS_MAX + FAULT_ERROR_MAX + 64 };

struct sim_control {
	struct sim_control_params params;
	uv_loop_t *loop;
	struct fault_plan plan;
	int64_t begin_ns;
	uv_timer_t timer;
	uv_pipe_t server;
	bool listens;
	int handles; /* open ones of this struct */
	char *path;
	int clients;
	struct caller *caller[CLIENTS];
};

struct caller {
	uv_pipe_t pipe;
	struct sim_control *control; /* NULL: it is gone */
	char line[LINE_MAX_BYTES + 1];
	size_t len;
};

/* ---- the plan ---- */

static void on_timer(uv_timer_t *timer);

static void wake(struct sim_control *c)
{
	const int64_t now_ns = (int64_t)uv_hrtime(), deadline_ns = fault_plan_deadline(&c->plan);
	if (deadline_ns == INT64_MAX) {
		uv_timer_stop(&c->timer);
		return;
	}
	uv_update_time(c->loop);
	uv_timer_start(&c->timer, on_timer,
	               deadline_ns > now_ns ? (uint64_t)(deadline_ns - now_ns + 999999) / 1000000 : 0, 0);
}

static void carry_out(struct sim_control *c)
{
	struct sim_fault fault;
	bool on;
	while (fault_plan_next(&c->plan, (int64_t)uv_hrtime(), &fault, &on))
		c->params.order(c->params.ctx, &fault, on);
	wake(c);
}

static void on_timer(uv_timer_t *timer)
{
	carry_out(timer->data);
}

static int add(struct sim_control *c, const char *sentence, int64_t begin_ns, char error[FAULT_ERROR_MAX])
{
	struct sim_fault fault;
	int r = fault_parse(sentence, &fault, error);
	if (r == 0)
		r = fault_check(&fault, c->params.target, c->params.targets, error);
	if (r < 0)
		return r;
	r = fault_plan_add(&c->plan, &fault, begin_ns);
	if (r < 0)
		snprintf(error, FAULT_ERROR_MAX, "%d faults wait or last already", FAULT_ORDERS_MAX);
	return r;
}

int sim_control_order(struct sim_control *c, const char *sentence, char error[FAULT_ERROR_MAX])
{
	const int r = add(c, sentence, c->begin_ns, error);
	if (r == 0)
		wake(c);
	return r;
}

/* ---- one line ---- */

static void answer_sentence(struct sim_control *c, const char *line, char ret[ANSWER_MAX])
{
	char text[FAULT_ERROR_MAX] = "";
	if (strcmp(line, "status") == 0) {
		c->params.status(c->params.ctx, ret);
		return;
	}
	const int r = add(c, line, (int64_t)uv_hrtime(), text);
	snprintf(ret, ANSWER_MAX, r == 0 ? "ok" : "error: %s", text);
}

static json_t *answer_object(struct sim_control *c, const json_t *object)
{
	char text[ANSWER_MAX] = "";
	const char *sentence = json_string_value(json_object_get(object, "fault"));
	if (sentence != NULL) {
		const int r = add(c, sentence, (int64_t)uv_hrtime(), text);
		return r == 0 ? json_pack("{s:b}", "ok", 1) : json_pack("{s:b,s:s}", "ok", 0, "error", text);
	}
	if (!json_is_true(json_object_get(object, "status")))
		return json_pack("{s:b,s:s}", "ok", 0, "error",
		                 "neither \"fault\": \"DEVICE: KIND ...\" nor \"status\": true");
	c->params.status(c->params.ctx, text);
	return json_pack("{s:b,s:s}", "ok", 1, "status", text);
}

static void answer_json(struct sim_control *c, const char *line, char ret[ANSWER_MAX])
{
	json_error_t why;
	json_t *object = json_loads(line, 0, &why), *answer;
	answer = object != NULL ? answer_object(c, object)
	                        : json_pack("{s:b,s:s}", "ok", 0, "error", "this is no JSON object in one line");
	char *text = answer != NULL ? json_dumps(answer, JSON_COMPACT) : NULL;
	snprintf(ret, ANSWER_MAX, "%s", text != NULL ? text : "{\"ok\":false,\"error\":\"out of memory\"}");
	free(text);
	json_decref(answer);
	json_decref(object);
}

/* ---- callers ---- */

static void on_caller_closed(uv_handle_t *handle)
{
	free(handle->data);
}

static void hang_up(struct caller *caller)
{
	struct sim_control *c = caller->control;
	if (c == NULL)
		return;
	for (int i = 0; i < CLIENTS; i++)
		if (c->caller[i] == caller)
			c->caller[i] = NULL;
	caller->control = NULL;
	uv_close((uv_handle_t *)&caller->pipe, on_caller_closed);
}

/* An answer that does not fit into the socket's buffer has a caller that does not read: it is closed. */
static void say(struct caller *caller, char *text)
{
	const size_t len = strlen(text);
	text[len] = '\n';
	const uv_buf_t buf = uv_buf_init(text, (unsigned)len + 1);
	if (uv_try_write((uv_stream_t *)&caller->pipe, &buf, 1) != (int)len + 1)
		hang_up(caller);
}

static void take_line(struct caller *caller, char *line)
{
	char answer[ANSWER_MAX + 1];
	line[strcspn(line, "\r")] = '\0';
	if (*line == '\0')
		return;
	if (*line == '{')
		answer_json(caller->control, line, answer);
	else
		answer_sentence(caller->control, line, answer);
	say(caller, answer);
}

static void on_alloc(uv_handle_t *handle, size_t suggested, uv_buf_t *ret)
{
	struct caller *caller = handle->data;
	(void)suggested;
	*ret = uv_buf_init(caller->line + caller->len, (unsigned)(LINE_MAX_BYTES - caller->len));
}

static void on_read(uv_stream_t *stream, ssize_t n, const uv_buf_t *buf)
{
	static const char too_long[] = "error: a line has at most 1023 characters";
	struct caller *caller = stream->data;
	char answer[64], *end;
	(void)buf;
	if (n < 0) {
		hang_up(caller);
		return;
	}
	caller->len += (size_t)n;
	while (caller->control != NULL && (end = memchr(caller->line, '\n', caller->len)) != NULL) {
		struct sim_control *c = caller->control;
		const size_t used = (size_t)(end - caller->line) + 1;
		char line[LINE_MAX_BYTES];
		memcpy(line, caller->line, used - 1);
		line[used - 1] = '\0';
		memmove(caller->line, end + 1, caller->len - used);
		caller->len -= used;
		take_line(caller, line);
		carry_out(c);
	}
	if (caller->control != NULL && caller->len == LINE_MAX_BYTES) {
		memcpy(answer, too_long, sizeof too_long);
		say(caller, answer);
		hang_up(caller);
	}
}

static void on_connection(uv_stream_t *server, int status)
{
	struct sim_control *c = server->data;
	struct caller *caller = status < 0 ? NULL : calloc(1, sizeof *caller);
	int i = 0;
	if (caller == NULL)
		return;
	while (i < CLIENTS && c->caller[i] != NULL)
		i++;
	uv_pipe_init(c->loop, &caller->pipe, 0);
	caller->pipe.data = caller;
	const bool accepted = uv_accept(server, (uv_stream_t *)&caller->pipe) == 0;
	if (!accepted || i == CLIENTS) {
		uv_close((uv_handle_t *)&caller->pipe, on_caller_closed);
		return;
	}
	caller->control = c;
	c->caller[i] = caller;
	uv_read_start((uv_stream_t *)&caller->pipe, on_alloc, on_read);
}

/* ---- opening and closing ---- */

static int bind_socket(const char *path, char error[FAULT_ERROR_MAX])
{
	struct sockaddr_un address = {.sun_family = AF_UNIX};
	const int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
	int r = fd < 0 ? -errno : strlen(path) >= sizeof address.sun_path ? -ENAMETOOLONG : 0;
	snprintf(address.sun_path, sizeof address.sun_path, "%.107s", path);
	if (r == 0)
		r = unix_socket_bind(fd, &address);
	if (r == 0)
		return fd;
	if (fd >= 0)
		close(fd);
	snprintf(error, FAULT_ERROR_MAX,
	         "%.150s: no socket for orders (%s); does another simulator use this directory?", path, strerror(-r));
	return r;
}

static int start_listening(struct sim_control *c, char error[FAULT_ERROR_MAX])
{
	const int fd = bind_socket(c->path, error);
	if (fd < 0)
		return fd;
	uv_pipe_init(c->loop, &c->server, 0);
	c->server.data = c;
	c->handles++;
	c->listens = true;
	int r = uv_pipe_open(&c->server, fd);
	if (r < 0)
		close(fd);
	else
		r = uv_listen((uv_stream_t *)&c->server, CLIENTS, on_connection);
	if (r < 0)
		snprintf(error, FAULT_ERROR_MAX, "%.150s: %s", c->path, uv_strerror(r));
	return r;
}

struct sim_control *sim_control_create(uv_loop_t *loop, const struct sim_control_params *params,
                                       char error[FAULT_ERROR_MAX])
{
	struct sim_control *c = calloc(1, sizeof *c);
	if (c == NULL || (c->path = strdup(params->socket)) == NULL) {
		free(c);
		snprintf(error, FAULT_ERROR_MAX, "out of memory");
		return NULL;
	}
	c->params = *params;
	c->loop = loop;
	c->begin_ns = (int64_t)uv_hrtime();
	uv_timer_init(loop, &c->timer);
	c->timer.data = c;
	c->handles = 1;
	if (start_listening(c, error) == 0)
		return c;
	sim_control_destroy(c);
	return NULL;
}

static void on_closed(uv_handle_t *handle)
{
	struct sim_control *c = handle->data;
	if (--c->handles > 0)
		return;
	free(c->path);
	free(c);
}

void sim_control_destroy(struct sim_control *c)
{
	if (c == NULL)
		return;
	for (int i = 0; i < CLIENTS; i++)
		if (c->caller[i] != NULL)
			hang_up(c->caller[i]);
	uv_close((uv_handle_t *)&c->timer, on_closed);
	if (!c->listens)
		return;
	unlink(c->path);
	uv_close((uv_handle_t *)&c->server, on_closed);
}

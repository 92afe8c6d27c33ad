/* Clients on sockets.
 *
 *   listener ─► connection: unknown ─ first byte ─┬─ '?' '{' ─► JSON lines: answers in `out`
 *                                                 └─ else ────► native: a publisher_client
 *
 * Sockets are polled, not handed to uv_write: what a client is sent is decided by the publisher at the moment there is
 * room for it, and nothing queues here. Reads, messages and writes are bounded a turn, so that one client's appetite is
 * not another's latency; what is read and not yet heard waits for the next turn, and nothing more is read until then.
 * A client that is to be closed keeps its socket for a second at most, to take the reason.
 *
 * Whoever has been written all there is stands in a list: news go to those, and to nobody else. Who waits for room in his
 * socket comes back when there is some, who wanted a limited rate with the timer. So clients that do not read cost
 * publishing nothing.
 *
 * Questions of a client that does not read its answers wait in its socket: its own sends then block, nobody else's. */
#include "daemon/server.h"

#include <assert.h>
#include <errno.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <syslog.h>
#include <unistd.h>

#include "daemon/listener.h"

#define READ_BYTES   16384
#define ACCEPTS_MAX  16           /* in one turn */
#define MESSAGES_MAX 16           /* of one client, heard in one turn */
#define DRAINS_MAX   16           /* reads that are thrown away at the end */
#define TICK_MS      100          /* deadlines and limited rates */
#define TICKS_STATUS 10           /* a status a second, to those who watch */
#define STREAM_BYTES 65536        /* of a recording in one piece */
#define STREAM_NS    5000000000ll /* for a recording to end in order */
#define STATUS_NS    100000000ll  /* a status is so old at most: building one walks the whole daemon and reads /proc */

enum kind { KIND_UNKNOWN, KIND_NATIVE, KIND_LINES };

struct connection {
	struct server *server;
	struct connection *next;
	struct connection *next_ready, **ready_at; /* ready_at NULL: not in the list */
	uv_poll_t poll;
	int fd, events;
	enum kind kind;
	uint64_t id;
	bool local, excess, watches, closing;
	bool more;             /* `in` holds messages that this turn had no room for */
	bool ended;            /* the client sends no more */
	bool dismissed;        /* it is told why it is closed, and not heard any more */
	int64_t deadline_ns;   /* closed then, whatever is left; INT64_MAX: stays */
	const char *from;      /* the listener's name */
	struct buffer in, out; /* out: JSON lines only */
	size_t out_at;
	uint64_t sent;
	struct publisher_client *client; /* native only */
	bool takes;                      /* a recording, or what is left of it: not closed before it is written out */
	struct recorder *stream;         /* lines only: `out` is pieces of a recording from now on */
};

struct door {
	struct server *server;
	struct listener listener;
	uv_poll_t poll;
	bool polling;
};

struct server {
	uv_loop_t *loop;
	const struct config *config;
	struct publisher *publisher;
	struct server_host host;
	struct door door[CONFIG_LISTEN_MAX];
	int doors;
	uv_timer_t timer;
	uv_idle_t hearing; /* turns while somebody has more to say */
	unsigned ticks;
	struct buffer status; /* the last one built */
	int64_t status_ns;
	struct connection *connections, *ready;
	uint64_t visits; /* of those that were ready, for news */
	size_t count;    /* of connections, those that are told to go included */
	uint64_t next_id;
	bool stopped, ending;
};

/* The list of those that take news at once */

static void leave_ready(struct connection *c)
{
	if (!c->ready_at)
		return;
	*c->ready_at = c->next_ready;
	if (c->next_ready)
		c->next_ready->ready_at = c->ready_at;
	c->ready_at = NULL;
}

static void set_ready(struct connection *c, bool ready)
{
	struct server *s = c->server;

	if (ready == (c->ready_at != NULL))
		return;
	if (!ready) {
		leave_ready(c);
		return;
	}
	c->next_ready = s->ready;
	c->ready_at = &s->ready;
	if (s->ready)
		s->ready->ready_at = &c->next_ready;
	s->ready = c;
}

/* Closing */

static void on_connection_closed(uv_handle_t *handle)
{
	struct connection *c = handle->data;

	close(c->fd);
	buffer_finish(&c->in);
	buffer_finish(&c->out);
	free(c);
}

static void close_connection(struct connection *c)
{
	struct server *s = c->server;
	struct connection **at = &s->connections;
	uint8_t bytes[READ_BYTES];

	if (c->closing)
		return;
	c->closing = true;
	leave_ready(c);
	while (*at != c)
		at = &(*at)->next;
	*at = c->next;
	s->count--;
	if (c->client)
		publisher_leave(c->client);
	c->client = NULL;
	if (c->stream)
		s->host.stream_end(s->host.ctx, c->stream);
	c->stream = NULL;
	uv_poll_stop(&c->poll);
	/* Unread input would turn the end into a reset, which may overtake the reason. */
	for (int i = 0; i < DRAINS_MAX && recv(c->fd, bytes, sizeof(bytes), MSG_DONTWAIT) > 0; i++)
		;
	/* The peer sees the end now, not when the loop comes round; the descriptor itself goes with the handle. */
	shutdown(c->fd, SHUT_RDWR);
	uv_close((uv_handle_t *)&c->poll, on_connection_closed);
}

/* Writing */

static void end_stream(struct connection *c, const char *reason)
{
	struct server *s = c->server;
	struct buffer text = {0};

	s->host.stream_end(s->host.ctx, c->stream);
	c->stream = NULL;
	control_put_end(&text, s->ending ? "the daemon ends" : reason);
	buffer_append(&c->out, text.data, text.len);
	buffer_append(&c->out, "\n", 1);
	buffer_finish(&text);
	c->dismissed = true;
	c->deadline_ns = s->host.now(s->host.ctx) + STREAM_NS;
}

/* The next piece of a recording: u32 length, bytes; length 0: the end, then a line that says why. */
static void fill_stream(struct connection *c)
{
	uint32_t n = 0;
	char reason[320];
	bool ended;

	buffer_append(&c->out, &n, 4);
	ended = recorder_take(c->stream, STREAM_BYTES, &c->out, reason);
	if (c->out.error)
		return;
	n = (uint32_t)(c->out.len - 4);
	for (int i = 0; i < 4; i++)
		c->out.data[i] = (uint8_t)(n >> 8 * i);
	if (ended && n == 0)
		end_stream(c, reason);
	else if (n == 0)
		c->out.len = 0;
}

static size_t next_bytes(struct connection *c, int64_t t_ns, const uint8_t **ret)
{
	if (c->client)
		return publisher_peek(c->client, t_ns, ret);
	if (c->out.len == 0 && c->stream)
		fill_stream(c);
	if (c->out.len == 0)
		return 0;
	*ret = c->out.data + c->out_at;
	return c->out.len - c->out_at;
}

static void wrote(struct connection *c, size_t n, int64_t t_ns)
{
	c->sent += n;
	if (c->client) {
		publisher_wrote(c->client, n, t_ns);
		return;
	}
	c->out_at += n;
	if (c->out_at == c->out.len)
		c->out_at = c->out.len = 0;
}

static void on_connection(uv_poll_t *poll, int status, int events);
static void on_hearing(uv_idle_t *idle);

static void set_events(struct connection *c, int events)
{
	if (c->closing || events == c->events)
		return;
	c->events = events;
	if (events)
		uv_poll_start(&c->poll, events, on_connection);
	else
		uv_poll_stop(&c->poll);
}

/* To be closed, and nothing is owed any more. */
static bool is_done(const struct connection *c)
{
	bool unheard = c->in.len > 0 && memchr(c->in.data, '\n', c->in.len);

	if (c->client)
		return publisher_done(c->client);
	return c->out.error || (c->out.len == 0 && !c->stream && (c->dismissed || (c->ended && !unheard)));
}

/* It wanted a limited rate, and has had what is due: the timer comes back to it. */
static bool is_paced(const struct connection *c, int64_t t_ns)
{
	int64_t deadline_ns = publisher_deadline(c->client);

	return deadline_ns != INT64_MAX && deadline_ns > t_ns;
}

/* Its next message may be heard, if there is one: there is room for the answer. */
static bool can_hear(const struct connection *c)
{
	return c->kind != KIND_UNKNOWN && !c->closing && !c->dismissed && c->out.len <= SERVER_LINES_MAX;
}

/* Writes what there is until the socket is full or the turn is over, and polls for what is then to be waited for. */
static void pump(struct connection *c)
{
	int64_t t_ns = c->server->host.now(c->server->host.ctx);
	const uint8_t *bytes;
	size_t n, total = 0;
	bool full = false;

	if (c->closing)
		return;
	while (!full && total < SERVER_TURN_BYTES && (n = next_bytes(c, t_ns, &bytes)) > 0) {
		ssize_t sent = send(c->fd, bytes, n, MSG_NOSIGNAL | MSG_DONTWAIT);

		if (sent < 0 && errno != EAGAIN && errno != EINTR) {
			close_connection(c);
			return;
		}
		full = sent < 0 || (size_t)sent < n;
		if (sent > 0) {
			wrote(c, (size_t)sent, t_ns);
			total += (size_t)sent;
		}
	}
	if (is_done(c)) {
		close_connection(c);
		return;
	}
	if (c->client && publisher_reason(c->client) && c->deadline_ns == INT64_MAX)
		c->deadline_ns = t_ns + SERVER_LINGER_NS;
	if (c->more && can_hear(c))
		uv_idle_start(&c->server->hearing, on_hearing);
	full = full || total >= SERVER_TURN_BYTES;
	set_ready(c, c->client && !full && !is_paced(c, t_ns));
	set_events(c, (c->ended || c->dismissed || c->more || c->out.len > SERVER_LINES_MAX ? 0 : UV_READABLE) |
	                  (full ? UV_WRITABLE : 0));
}

/* Speaking */

static void put_line(struct connection *c, const struct buffer *text)
{
	buffer_append(&c->out, text->data, text->len);
	buffer_append(&c->out, "\n", 1);
}

/* In the client's own language. */
static void say(struct connection *c, const struct buffer *text)
{
	if (text->error || text->len == 0)
		return;
	if (c->client)
		publisher_json(c->client, (const char *)text->data, text->len);
	else
		put_line(c, text);
}

static void say_error(struct connection *c, const char *sentence)
{
	struct buffer text = {0};

	control_put_error(&text, sentence);
	say(c, &text);
	buffer_finish(&text);
}

/* The reason, then the end, at the latest after SERVER_LINGER_NS. */
static void dismiss(struct connection *c, const char *reason)
{
	if (c->client)
		publisher_dismiss(c->client, reason);
	else
		say_error(c, reason);
	c->dismissed = true;
	c->deadline_ns = c->server->host.now(c->server->host.ctx) + SERVER_LINGER_NS;
}

static const struct buffer *status_text(struct server *s)
{
	int64_t t_ns = s->host.now(s->host.ctx);

	if (s->status.len == 0 || s->status.error || t_ns - s->status_ns >= STATUS_NS || t_ns < s->status_ns) {
		buffer_finish(&s->status);
		s->host.status(s->host.ctx, &s->status);
		s->status_ns = t_ns;
	}
	return &s->status;
}

static void say_status(struct connection *c)
{
	struct server *s = c->server;

	/* One that has no room for the last status has none for a new one: dropped and counted, not built. */
	if (c->client && publisher_json_room(c->client) < s->status.len)
		say(c, &s->status);
	else
		say(c, status_text(s));
}

static void begin_stream(struct connection *c, const struct control_command *command)
{
	struct server *s = c->server;
	struct buffer text = {0};
	char error[200];

	if (c->kind != KIND_LINES) {
		say_error(c, "a recording goes to a client of JSON lines: run `facet record`");
		return;
	}
	c->stream = s->host.stream(s->host.ctx, error);
	if (!c->stream) {
		say_error(c, error);
		return;
	}
	c->takes = true;
	c->watches = false;
	control_put_answer(&text, command);
	put_line(c, &text);
	buffer_finish(&text);
}

static void do_command(struct connection *c, const struct control_command *command)
{
	struct server *s = c->server;
	struct buffer text = {0};
	char error[200];

	if (control_changes(command->word) && !c->local && !(s->host.replays && control_plays(command->word))) {
		say_error(c, "commands that change something are taken on the unix socket only");
		return;
	}
	if (command->stream) {
		begin_stream(c, command);
		return;
	}
	if (control_changes(command->word) && !s->host.command(s->host.ctx, command, error)) {
		say_error(c, error);
		return;
	}
	if (control_changes(command->word))
		s->status.len = 0; /* who changes something and asks sees the change */
	if (command->word == CONTROL_WATCH)
		c->watches = command->enable;
	if (command->word == CONTROL_STATUS) {
		say_status(c);
		return;
	}
	control_put_answer(&text, command);
	say(c, &text);
	buffer_finish(&text);
}

static void hear_command(struct connection *c, const char *text, size_t len)
{
	struct control_command command;
	char error[200];

	if (c->stream) /* whatever is said while a recording is taken: it is to end */
		recorder_enable(c->stream, false);
	else if (control_parse(text, len, &command, error) < 0)
		say_error(c, error);
	else
		do_command(c, &command);
}

/* Hearing: each takes one message from the front of `in`; bytes taken, 0: more is needed. */

static size_t hear_line(struct connection *c, const uint8_t *data, size_t len)
{
	const uint8_t *end = memchr(data, '\n', len);
	size_t n = end ? (size_t)(end - data) : len;

	if (n > CONTROL_LINE_MAX) {
		dismiss(c, "a line of more than 64 KB");
		return len;
	}
	if (!end)
		return 0;
	for (size_t i = 0; i < n; i++)
		if (data[i] != ' ' && data[i] != '\r' && data[i] != '\t') {
			hear_command(c, (const char *)data, n);
			break;
		}
	return n + 1;
}

static void hear_want(struct connection *c, const struct native_want *want)
{
	if (c->client)
		publisher_want(c->client, want);
}

static size_t hear_frame(struct connection *c, const uint8_t *data, size_t len)
{
	ssize_t n = native_scan(data, len, NATIVE_FROM_CLIENT_MAX);
	struct native_message message;
	char error[128];
	int r;

	if (n == 0)
		return 0;
	if (n < 0) {
		dismiss(
		    c,
		    "bytes that are no frame: a frame begins with its length, at most 64 KB, and JSON lines with `?`");
		return len;
	}
	r = native_decode(data, (size_t)n, &message, error);
	if (r == -ENOTSUP)
		return (size_t)n;
	if (r < 0) {
		dismiss(c, error);
		return len;
	}
	if (message.type == NATIVE_WANT)
		hear_want(c, &message.want);
	else if (message.type == NATIVE_JSON)
		hear_command(c, message.json.text, message.json.len);
	else if (message.type != NATIVE_PING)
		dismiss(c, "a message that only the server sends");
	native_message_finish(&message);
	return (size_t)n;
}

/* The first byte decides. A native client's first frame must be WANT. */
static void begin_lines(struct connection *c)
{
	struct buffer text = {0};

	c->kind = KIND_LINES;
	c->deadline_ns = INT64_MAX;
	control_put_version(&text);
	put_line(c, &text);
	buffer_finish(&text);
}

static void begin_native(struct connection *c)
{
	static const struct native_want none;
	struct native_message message;
	char error[128];
	ssize_t n = native_scan(c->in.data, c->in.len, NATIVE_FROM_CLIENT_MAX);
	bool wants = n > 0 && native_decode(c->in.data, (size_t)n, &message, error) == 0;

	if (n == 0)
		return;
	if (wants && message.type != NATIVE_WANT) {
		native_message_finish(&message);
		wants = false;
	}
	c->kind = KIND_NATIVE;
	c->deadline_ns = INT64_MAX;
	c->client = publisher_join(c->server->publisher, wants ? &message.want : &none);
	if (!c->client)
		c->dismissed = true; /* no memory to say so */
	else if (!wants)
		dismiss(c, "a client speaks first: WANT, or a line that begins with `?`");
	if (wants) {
		c->in.len -= (size_t)n;
		memmove(c->in.data, c->in.data + n, c->in.len);
	}
}

static void recognise(struct connection *c)
{
	if (c->in.data[0] == '?' || c->in.data[0] == '{')
		begin_lines(c);
	else
		begin_native(c);
	if (c->kind != KIND_UNKNOWN && c->excess)
		dismiss(c, "as many clients as listen.clients allows are connected; try later or allow more");
}

static void hear(struct connection *c)
{
	size_t at = 0, n = 1;

	c->more = false;
	if (c->in.len == 0)
		return;
	if (c->kind == KIND_UNKNOWN)
		recognise(c);
	for (int heard = 0; heard < MESSAGES_MAX && can_hear(c) && at < c->in.len && n > 0; heard++) {
		const uint8_t *data = c->in.data + at;

		n = c->kind == KIND_LINES ? hear_line(c, data, c->in.len - at) : hear_frame(c, data, c->in.len - at);
		at += n;
	}
	c->in.len -= at;
	memmove(c->in.data, c->in.data + at, c->in.len);
	c->more = c->kind != KIND_UNKNOWN && n > 0 && c->in.len > 0;
}

static void on_hearing(uv_idle_t *idle)
{
	struct server *s = idle->data;
	struct connection *next;

	uv_idle_stop(idle); /* pump starts it again for one that has still more */
	for (struct connection *c = s->connections; c; c = next) {
		next = c->next; /* stays valid for this turn, even if a command closes it */
		if (!c->more || !can_hear(c))
			continue;
		hear(c);
		pump(c);
	}
}

/* False: the connection is gone. */
static bool receive(struct connection *c)
{
	uint8_t bytes[READ_BYTES];
	ssize_t n = recv(c->fd, bytes, sizeof(bytes), MSG_DONTWAIT);

	if (n < 0 && (errno == EAGAIN || errno == EINTR))
		return true;
	if (n <= 0) {
		/* A client of JSON lines may have closed its half after its questions; it still gets the answers. */
		if (n < 0 || c->kind != KIND_LINES) {
			close_connection(c);
			return false;
		}
		c->ended = true;
		if (c->stream)
			recorder_enable(c->stream, false);
		c->deadline_ns = c->server->host.now(c->server->host.ctx) + (c->stream ? STREAM_NS : SERVER_LINGER_NS);
		return true;
	}
	buffer_append(&c->in, bytes, (size_t)n);
	if (c->in.error) {
		close_connection(c);
		return false;
	}
	return true;
}

static void on_connection(uv_poll_t *poll, int status, int events)
{
	struct connection *c = poll->data;

	if (status < 0) {
		close_connection(c);
		return;
	}
	if ((events & UV_READABLE) && !c->ended && !receive(c))
		return;
	if (!c->more) /* else on_hearing goes on, once there is room for answers */
		hear(c);
	pump(c);
}

/* Accepting */

static void welcome(struct door *door, int fd)
{
	struct server *s = door->server;
	struct connection *c = NULL;
	int size = s->config->listen.send_buffer, on = 1;

	if (s->count < (size_t)s->config->listen.clients + SERVER_DOORSTEP_MAX)
		c = calloc(1, sizeof(*c));
	if (!c || uv_poll_init(s->loop, &c->poll, fd) < 0) {
		free(c);
		close(fd);
		return;
	}
	if (size > 0)
		setsockopt(fd, SOL_SOCKET, SO_SNDBUF, &size, sizeof(size));
	setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on,
	           sizeof(on)); /* a COMMIT waits for nobody; unix sockets refuse it */
	c->server = s;
	c->poll.data = c;
	c->fd = fd;
	c->id = ++s->next_id;
	c->local = door->listener.local;
	c->from = door->listener.name;
	c->excess = s->count >= (size_t)s->config->listen.clients;
	c->deadline_ns = s->host.now(s->host.ctx) + SERVER_SILENCE_NS;
	c->next = s->connections;
	s->connections = c;
	s->count++;
	set_events(c, UV_READABLE);
}

static void on_door(uv_poll_t *poll, int status, int events)
{
	struct door *door = poll->data;

	(void)status;
	(void)events;
	for (int i = 0; i < ACCEPTS_MAX; i++) {
		int fd = accept4(door->listener.fd, NULL, NULL, SOCK_NONBLOCK | SOCK_CLOEXEC);

		if (fd >= 0) {
			welcome(door, fd);
			continue;
		}
		if (errno == EMFILE || errno == ENFILE || errno == ENOBUFS || errno == ENOMEM) {
			/* Level-triggered polling would spin: the door opens again at the next tick. */
			uv_poll_stop(&door->poll);
			door->polling = false;
		}
		if (errno != ECONNABORTED && errno != EINTR)
			return;
	}
}

/* Time */

static void open_doors(struct server *s)
{
	for (int i = 0; i < s->doors; i++)
		if (!s->door[i].polling) {
			s->door[i].polling = true;
			uv_poll_start(&s->door[i].poll, UV_READABLE, on_door);
		}
}

static void tell_watchers(struct server *s, const struct buffer *text)
{
	struct connection *next;

	for (struct connection *c = s->connections; c; c = next) {
		next = c->next;
		/* One that does not read misses messages, not memory. */
		if (!c->watches || c->dismissed || c->out.len > SERVER_LINES_MAX / 2)
			continue;
		say(c, text);
		pump(c);
	}
}

static void tell_status(struct server *s)
{
	bool anybody = false;

	for (struct connection *c = s->connections; c; c = c->next)
		anybody |= c->watches;
	if (!anybody)
		return;
	tell_watchers(s, status_text(s));
}

static void on_timer(uv_timer_t *timer)
{
	struct server *s = timer->data;
	int64_t t_ns = s->host.now(s->host.ctx);
	struct connection *next;

	open_doors(s);
	for (struct connection *c = s->connections; c; c = next) {
		next = c->next;
		if (t_ns >= c->deadline_ns)
			close_connection(c);
		else if (c->client && publisher_deadline(c->client) != INT64_MAX)
			pump(c);
	}
	if (++s->ticks % TICKS_STATUS == 0)
		tell_status(s);
}

void server_wake(struct server *s)
{
	struct connection *next;

	for (struct connection *c = s->ready; c; c = next) {
		next = c->next_ready;
		s->visits++;
		pump(c);
	}
}

uint64_t server_visits(const struct server *s)
{
	return s->visits;
}

void server_streams(struct server *s)
{
	struct connection *next;

	for (struct connection *c = s->connections; c; c = next) {
		next = c->next;
		if (c->stream && !(c->events & UV_WRITABLE))
			pump(c);
	}
}

size_t server_end_streams(struct server *s)
{
	size_t left = 0;

	s->ending = true;
	for (struct connection *c = s->connections; c; c = c->next) {
		if (c->stream)
			recorder_enable(c->stream, false);
		left += c->takes;
	}
	return left;
}

void server_event(struct server *s, const char *text, size_t len)
{
	struct buffer b = {0};

	buffer_append(&b, text, len);
	tell_watchers(s, &b);
	buffer_finish(&b);
}

const char *server_address(const struct server *s, int i)
{
	return i < s->doors ? s->door[i].listener.name : NULL;
}

size_t server_clients(const struct server *s, struct control_client *ret, size_t cap)
{
	size_t n = 0;

	for (const struct connection *c = s->connections; c; c = c->next, n++) {
		struct publisher_client_stats stats = {0};

		if (n >= cap)
			continue;
		memset(&ret[n], 0, sizeof(ret[n]));
		if (c->client)
			publisher_client_stats(c->client, &stats);
		ret[n].id = c->id;
		ret[n].kind = c->kind == KIND_NATIVE  ? "native"
		              : c->stream             ? "recording"
		              : c->kind == KIND_LINES ? "lines"
		                                      : "new";
		snprintf(ret[n].address, sizeof(ret[n].address), "%.60s", c->from);
		ret[n].sent = c->sent;
		ret[n].step = stats.step;
		ret[n].behind = stats.behind_steps;
		ret[n].behind_peak = stats.behind_peak;
		ret[n].queued = stats.queued + c->out.len - c->out_at;
		ret[n].batches = stats.batches;
		ret[n].aborts = stats.aborts;
	}
	return n;
}

/* Life */

static bool open_door(struct server *s, const char *text, char error[320])
{
	struct door *door = &s->door[s->doors];

	if (listener_open(&door->listener, text, s->config->listen.group, error) < 0)
		return false;
	door->server = s;
	door->poll.data = door;
	if (uv_poll_init(s->loop, &door->poll, door->listener.fd) < 0) {
		listener_close(&door->listener);
		snprintf(error, 320, "%.120s: cannot be polled", text);
		return false;
	}
	door->poll.data = door;
	s->doors++;
	return true;
}

struct server *server_create(uv_loop_t *loop, const struct config *config, struct publisher *publisher,
                             const struct server_host *host, char error[320])
{
	struct server *s = calloc(1, sizeof(*s));

	if (!s) {
		snprintf(error, 320, "no memory");
		return NULL;
	}
	s->loop = loop;
	s->config = config;
	s->publisher = publisher;
	s->host = *host;
	uv_timer_init(loop, &s->timer);
	s->timer.data = s;
	uv_idle_init(loop, &s->hearing);
	s->hearing.data = s;
	for (int i = 0; i < config->listen.natives; i++)
		if (!open_door(s, config->listen.native[i], error)) {
			server_stop(s);
			uv_run(loop, UV_RUN_NOWAIT); /* the handles' last turn */
			server_destroy(s);
			return NULL;
		}
	open_doors(s);
	uv_timer_start(&s->timer, on_timer, TICK_MS, TICK_MS);
	return s;
}

int server_passed(const struct server *s)
{
	int n = 0;

	for (int i = 0; i < s->doors; i++)
		n += s->door[i].listener.passed;
	return n;
}

void server_stop(struct server *s)
{
	if (s->stopped)
		return;
	s->stopped = true;
	while (s->connections)
		close_connection(s->connections);
	for (int i = 0; i < s->doors; i++) {
		uv_poll_stop(&s->door[i].poll);
		uv_close((uv_handle_t *)&s->door[i].poll, NULL);
	}
	uv_close((uv_handle_t *)&s->timer, NULL);
	uv_close((uv_handle_t *)&s->hearing, NULL);
}

void server_destroy(struct server *s)
{
	if (!s)
		return;
	assert(s->stopped && !s->connections);
	for (int i = 0; i < s->doors; i++)
		listener_close(&s->door[i].listener);
	buffer_finish(&s->status);
	free(s);
}

/* Connections of the web.
 *
 *   listener ─► connection: arrived ─ request ─┬─ plain ────► web_http's answer, in pieces ─► idle ─► next request
 *                                              └─ upgrade ──► a language: pieces as there is room
 *
 * libwebsockets frames, encrypts and times out, on our own loop; sockets are accepted here and handed to it, so that limits
 * are kept before it spends anything on a stranger. It takes a piece whole and holds what the kernel does not take, so at
 * most one piece (WEB_PIECE_MAX) is ever held for a client that does not read: the next is asked of its language when
 * that has gone out. Nothing queues.
 *
 * At the limit of connections the one that has waited longest for a request goes: who opens sockets and says nothing
 * shuts nobody out. What libwebsockets would log is not: strangers could fill the log with it.
 *
 * Traps of libwebsockets 4.1: the loop needs its plugin for libuv at run time; it speaks h2c and CONNECT unless they are
 * refused; a context on a foreign loop is destroyed twice, before and after the loop ran dry; it takes frames that are not masked. */
#include "daemon/web.h"

#ifdef HAVE_WEB

#include <assert.h>
#include <errno.h>
#include <fcntl.h>
#include <netdb.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <syslog.h>
#include <time.h>
#include <unistd.h>

#include "daemon/web_parts.h"

#define PLAIN_MAX    32 /* connections beyond listen.clients that may be open: requests, and clients that are told to go */
#define DOORSTEP_MAX 8  /* ... of the latter */
#define ACCEPTS_MAX  16 /* in one turn */
#define KEPT_S       15 /* an idle connection is kept open for another request */
#define CLOSE_S      2  /* for a client that is told to go */
#define HEADERS_MAX  4096
#define SETTLE_NS    10000000ll   /* after the handshake; see web_language.open */
#define PONG_NS      2000000000ll /* the longest a client is waited for that was pinged */
#define TICK_MS      1000         /* doors that were closed for want of descriptors */
#define RX_BYTES     4096

int64_t web_now(const struct web *web)
{
	return web->host.server.now(web->host.server.ctx);
}

void web_log(const struct web *web, int priority, const char *text)
{
	web->host.server.log(web->host.server.ctx, priority, text);
}

void web_enter(struct web_connection *c, enum web_stage stage)
{
	c->stage = stage;
	c->since_ns = web_now(c->web);
}

/* Ends */

static void leave_language(struct web_connection *c)
{
	if (!c->language)
		return;
	if (c->state)
		c->language->close(c->state);
	c->language = NULL;
	c->state = NULL;
	c->web->clients--;
}

static void on_door(uv_poll_t *door, int status, int events);

static void open_door(struct web *web)
{
	if (web->polling || !web->open || web->stopped)
		return;
	web->polling = true;
	uv_poll_start(&web->door, UV_READABLE, on_door);
}

/* Until a connection has gone, or the next tick: level-triggered polling would spin. */
static void shut_door(struct web *web)
{
	uv_poll_stop(&web->door);
	web->polling = false;
}

static void free_connection(struct web_connection *c)
{
	struct web *web = c->web;
	struct web_connection **at = &web->connections;

	leave_language(c);
	web_answer_finish(&c->answer);
	buffer_finish(&c->in);
	while (*at != c)
		at = &(*at)->next;
	*at = c->next;
	web->count--;
	web->evicted -= c->evicted;
	free(c);
	open_door(web);
}

/* Languages */

static void arm(struct web_connection *c);

static void ask_for_room(struct web_connection *c)
{
	if (c->language && !c->asked && c->wsi) {
		c->asked = true;
		lws_callback_on_writable(c->wsi);
	}
}

static int on_established(struct web_connection *c, const struct lws_protocols *protocol)
{
	struct web *web = c->web;
	const struct web_speaker *speaker = &web->speaker[web->speaks[protocol->id]];

	web_enter(c, STAGE_SPEAKS);
	lws_set_timeout(c->wsi, NO_PENDING_TIMEOUT, 0);
	c->language = speaker->language;
	c->pings = c->language->ping_first;
	c->settle_ns = web_now(web) + (c->pings ? PONG_NS : SETTLE_NS);
	if (++web->clients > (size_t)web->site.config->listen.clients + DOORSTEP_MAX)
		return -1;
	if (web->clients > (size_t)web->site.config->listen.clients) {
		web_close(c, 1013, "as many clients as listen.clients allows are connected; try later or allow more");
		return 0;
	}
	c->state = c->language->open(speaker->ctx, c, protocol->id == 0 ? speaker->language->names[0] : protocol->name);
	if (!c->state)
		web_close(c, 1011, "out of memory");
	if (c->pings)
		ask_for_room(c);
	arm(c);
	return 0;
}

static int ping(struct web_connection *c)
{
	c->pings = false;
	c->pinged = true;
	c->web->out[LWS_PRE] = '?'; /* of an empty one's answer libwebsockets says nothing */
	return lws_write(c->wsi, c->web->out + LWS_PRE, 1, LWS_WRITE_PING) < 0 ? -1 : 0;
}

static int on_pong(struct web_connection *c)
{
	if (c->pinged && c->settle_ns)
		c->settle_ns = web_now(c->web) + SETTLE_NS;
	c->pinged = false;
	arm(c);
	return 0;
}

/* The close frame is written here: left to libwebsockets, a build of it for debugging (Debian's is one) drops the
 * connection before the frame is out. The client closes then, or is closed. */
static int close_now(struct web_connection *c)
{
	uint8_t *to = c->web->out + LWS_PRE;
	const size_t len = strlen(c->reason);

	if (c->said_close)
		return 0;
	c->said_close = true;
	to[0] = 0x88;
	to[1] = (uint8_t)(len + 2);
	to[2] = (uint8_t)(c->close_code >> 8);
	to[3] = (uint8_t)c->close_code;
	memcpy(to + 4, c->reason, len);
	lws_set_timeout(c->wsi, PENDING_TIMEOUT_CLOSE_ACK, CLOSE_S);
	return lws_write(c->wsi, to, len + 4, LWS_WRITE_HTTP /* as it is */) < 0 ? -1 : 0;
}

/* One piece. Its bytes, 0: nothing to say, -1: the connection is to be closed. */
static int say_piece(struct web_connection *c, int64_t t_ns)
{
	struct web *web = c->web;
	struct web_piece piece = {0};
	int how;
	size_t n;

	if (c->close_code && !c->begun)
		return close_now(c);
	if (c->pings)
		return ping(c);
	if (!c->state || t_ns < c->settle_ns)
		return 0;
	n = c->language->next(c->state, web->out + LWS_PRE, WEB_PIECE_MAX, t_ns, &piece);
	assert(n <= WEB_PIECE_MAX);
	if (n == 0)
		return c->close_code && !c->begun ? close_now(c) : 0;
	how = c->begun ? LWS_WRITE_CONTINUATION : piece.text ? LWS_WRITE_TEXT : LWS_WRITE_BINARY;
	if (!piece.final)
		how |= LWS_WRITE_NO_FIN;
	c->begun = !piece.final;
	c->sent += n;
	return lws_write(c->wsi, web->out + LWS_PRE, n, (enum lws_write_protocol)how) < (int)n ? -1 : (int)n;
}

static int on_room(struct web_connection *c)
{
	const int64_t t_ns = web_now(c->web);
	size_t total = 0;
	int n = 1;

	c->asked = false;
	while (n > 0 && total < WEB_TURN_BYTES && !lws_send_pipe_choked(c->wsi)) {
		n = say_piece(c, t_ns);
		total += n > 0 ? (size_t)n : 0;
	}
	if (n < 0)
		return -1;
	if (n > 0)
		ask_for_room(c);
	arm(c);
	return 0;
}

static int on_heard(struct web_connection *c, const void *data, size_t len)
{
	const bool first = lws_is_first_fragment(c->wsi),
	           last = lws_is_final_fragment(c->wsi) && lws_remaining_packet_payload(c->wsi) == 0;

	if (!c->state || c->close_code)
		return 0;
	if (first)
		c->in_text = !lws_frame_is_binary(c->wsi);
	if (len > WEB_HEARD_MAX - c->in.len) {
		web_close(c, 1009, "a message of more than 64 KB");
		buffer_finish(&c->in);
		return 0;
	}
	if (first && last) {
		if (c->language->hear)
			c->language->hear(c->state, data, len, c->in_text);
	} else {
		buffer_append(&c->in, data, len);
		if (c->in.error)
			return -1;
		if (last && c->language->hear)
			c->language->hear(c->state, c->in.data, c->in.len, c->in_text);
		if (last)
			buffer_finish(&c->in);
	}
	arm(c);
	return 0;
}

void web_close(struct web_connection *c, int code, const char *reason)
{
	if (c->close_code)
		return;
	c->close_code = code;
	snprintf(c->reason, sizeof(c->reason), "%s", reason);
	ask_for_room(c);
}

/* libwebsockets */

static int on_lws(struct lws *wsi, enum lws_callback_reasons reason, void *user, void *in, size_t len)
{
	struct web *web = lws_context_user(lws_get_context(wsi));
	struct web_connection *c = NULL;

	(void)user;
	switch (reason) {
	case LWS_CALLBACK_WSI_CREATE:
		if (web && web->arriving) /* not the pipe of its own */
			web->arriving->owned = true;
		return 0;
	case LWS_CALLBACK_SERVER_NEW_CLIENT_INSTANTIATED:
	case LWS_CALLBACK_WSI_DESTROY:
	case LWS_CALLBACK_HTTP:
	case LWS_CALLBACK_HTTP_CONFIRM_UPGRADE:
	case LWS_CALLBACK_HTTP_WRITEABLE:
	case LWS_CALLBACK_ESTABLISHED:
	case LWS_CALLBACK_SERVER_WRITEABLE:
	case LWS_CALLBACK_RECEIVE:
	case LWS_CALLBACK_RECEIVE_PONG:
	case LWS_CALLBACK_CLOSED:
		c = lws_get_opaque_user_data(wsi);
		break;
	case LWS_CALLBACK_RAW_ADOPT: /* CONNECT is no way in */
	case LWS_CALLBACK_RAW_RX:
	case LWS_CALLBACK_RAW_WRITEABLE:
		return -1;
	default:
		return 0;
	}
	if (!c)
		return 0;
	switch (reason) {
	case LWS_CALLBACK_SERVER_NEW_CLIENT_INSTANTIATED:
		c->wsi = wsi;
		return 0;
	case LWS_CALLBACK_WSI_DESTROY:
		lws_set_opaque_user_data(wsi, NULL);
		free_connection(c);
		return 0;
	case LWS_CALLBACK_HTTP:
		return web_request(c, in, len);
	case LWS_CALLBACK_HTTP_CONFIRM_UPGRADE:
		return web_upgrade(c, in);
	case LWS_CALLBACK_HTTP_WRITEABLE:
		return web_write_answer(c);
	case LWS_CALLBACK_ESTABLISHED:
		return on_established(c, lws_get_protocol(wsi));
	case LWS_CALLBACK_SERVER_WRITEABLE:
		return on_room(c);
	case LWS_CALLBACK_RECEIVE:
		return on_heard(c, in, len);
	case LWS_CALLBACK_RECEIVE_PONG:
		return on_pong(c);
	default: /* CLOSED */
		leave_language(c);
		return 0;
	}
}

/* Arrivals */

static size_t limit(const struct web *web)
{
	return (size_t)web->site.config->listen.clients + PLAIN_MAX;
}

/* Makes room: the connection that has waited longest for a request. False: all of them are at work. */
static bool evict(struct web *web)
{
	struct web_connection *oldest = NULL;

	for (struct web_connection *c = web->connections; c; c = c->next)
		if (c->wsi && c->stage <= STAGE_IDLE && (!oldest || c->since_ns <= oldest->since_ns))
			oldest = c;
	if (!oldest)
		return false;
	oldest->stage = STAGE_ANSWERED; /* not twice */
	oldest->evicted = true;
	web->evicted++;
	lws_set_timeout(oldest->wsi, PENDING_TIMEOUT_USER_OK, LWS_TO_KILL_ASYNC);
	return true;
}

static void tune(const struct web *web, int fd)
{
	const int size = web->site.config->listen.send_buffer, on = 1, idle_s = 60, every_s = 15, probes = 4;

	if (size > 0)
		setsockopt(fd, SOL_SOCKET, SO_SNDBUF, &size, sizeof(size));
	setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof(on));
	setsockopt(fd, SOL_SOCKET, SO_KEEPALIVE, &on, sizeof(on)); /* one that is gone without a word ends by this */
	setsockopt(fd, IPPROTO_TCP, TCP_KEEPIDLE, &idle_s, sizeof(idle_s));
	setsockopt(fd, IPPROTO_TCP, TCP_KEEPINTVL, &every_s, sizeof(every_s));
	setsockopt(fd, IPPROTO_TCP, TCP_KEEPCNT, &probes, sizeof(probes));
}

static void welcome(struct web *web, int fd, const struct sockaddr_storage *from)
{
	lws_adopt_desc_t adopt = {
	    .vh = web->vhost, .type = LWS_ADOPT_SOCKET | LWS_ADOPT_HTTP | LWS_ADOPT_ALLOW_SSL, .fd.sockfd = fd};
	struct web_connection *c = NULL;
	char host[NI_MAXHOST] = "?", port[NI_MAXSERV] = "?";

	if (web->count < limit(web) || (web->count < limit(web) + PLAIN_MAX && evict(web)))
		c = calloc(1, sizeof(*c));
	if (!c) {
		close(fd);
		return;
	}
	tune(web, fd);
	getnameinfo((const struct sockaddr *)from, sizeof(*from), host, sizeof(host), port, sizeof(port),
	            NI_NUMERICHOST | NI_NUMERICSERV);
	*c = (struct web_connection){.web = web, .from = *from, .id = ++web->next_id, .next = web->connections};
	snprintf(c->address, sizeof(c->address), "ws:%.48s:%.6s", host, port);
	web_enter(c, STAGE_ARRIVED);
	web->connections = c;
	web->count++;
	adopt.opaque = c;
	web->arriving = c;
	if (!lws_adopt_descriptor_vhost_via_info(&adopt) && !c->owned)
		free_connection(c);
	web->arriving = NULL;
}

static void on_door(uv_poll_t *door, int status, int events)
{
	struct web *web = door->data;

	(void)status;
	(void)events;
	for (int i = 0; i < ACCEPTS_MAX; i++) {
		if (web->evicted > 0 && web->count >= limit(web) + PLAIN_MAX) {
			shut_door(web); /* who comes next waits until they are gone */
			return;
		}
		struct sockaddr_storage from = {0};
		socklen_t len = sizeof(from);
		const int fd = accept4(web->listener.fd, (struct sockaddr *)&from, &len, SOCK_NONBLOCK | SOCK_CLOEXEC);

		if (fd >= 0) {
			welcome(web, fd, &from);
			continue;
		}
		if (errno == EMFILE || errno == ENFILE || errno == ENOBUFS || errno == ENOMEM)
			shut_door(web);
		if (errno != ECONNABORTED && errno != EINTR)
			return;
	}
}

/* Time */

static void on_tick(uv_timer_t *tick)
{
	open_door(tick->data);
}

static int64_t deadline_of(const struct web_connection *c)
{
	if (c->asked || !c->state || !c->language->deadline)
		return INT64_MAX;
	return c->language->deadline(c->state);
}

static void on_timer(uv_timer_t *timer)
{
	struct web *web = timer->data;
	const int64_t t_ns = web_now(web);

	web->armed_ns = INT64_MAX;
	for (struct web_connection *c = web->connections; c; c = c->next) {
		if (!c->language)
			continue;
		if (c->settle_ns && t_ns >= c->settle_ns) {
			c->settle_ns = 0;
			ask_for_room(c);
		} else if (!c->settle_ns && deadline_of(c) <= t_ns) {
			ask_for_room(c);
		}
		arm(c);
	}
}

/* One timer for the nearest deadline of all languages; it may come too early, when who set it changed his mind. */
static void arm(struct web_connection *c)
{
	struct web *web = c->web;
	const int64_t deadline_ns = c->settle_ns ? c->settle_ns : deadline_of(c);
	int64_t wait_ns;

	if (web->stopped || deadline_ns >= web->armed_ns)
		return;
	web->armed_ns = deadline_ns;
	wait_ns = deadline_ns - web_now(web);
	uv_timer_start(&web->timer, on_timer, wait_ns <= 0 ? 1 : (uint64_t)((wait_ns + 999999) / 1000000), 0);
}

static void on_snapshot(void *ctx)
{
	struct web *web = ctx;

	for (struct web_connection *c = web->connections; c; c = c->next)
		if (c->answering && c->answer.snapshot)
			lws_callback_on_writable(c->wsi);
}

/* The daemon's side */

void web_wake(struct web *web)
{
	for (struct web_connection *c = web ? web->connections : NULL; c; c = c->next)
		ask_for_room(c);
}

void web_event(struct web *web, const char *text, size_t len)
{
	for (struct web_connection *c = web ? web->connections : NULL; c; c = c->next)
		if (c->state && c->language->event)
			c->language->event(c->state, text, len);
}

size_t web_clients(const struct web *web, struct control_client *ret, size_t cap)
{
	size_t n = 0;

	for (const struct web_connection *c = web ? web->connections : NULL; c; c = c->next) {
		if (!c->state)
			continue;
		if (n < cap) {
			memset(&ret[n], 0, sizeof(ret[n]));
			ret[n].id = c->id;
			ret[n].kind = c->language->kind;
			snprintf(ret[n].address, sizeof(ret[n].address), "%s", c->address);
			ret[n].sent = c->sent;
			if (c->language->stats)
				c->language->stats(c->state, &ret[n]);
		}
		n++;
	}
	return n;
}

const char *web_address(const struct web *web)
{
	return web ? web->address : NULL;
}

bool web_passed(const struct web *web)
{
	return web && web->listener.passed;
}

bool web_loopback(const struct web *web)
{
	return !web || web->site.loopback;
}

void web_wake_one(struct web_connection *c)
{
	ask_for_room(c);
}

const struct web_rights *web_rights(const struct web_connection *c)
{
	return &c->rights;
}

const struct server_host *web_server_host(const struct web_connection *c)
{
	return &c->web->host.server;
}

const struct buffer *web_status(const struct web_connection *c)
{
	return web_site_status(&c->web->site);
}

void web_forget_status(const struct web_connection *c)
{
	c->web->site.status.len = 0;
}

struct publisher *web_publisher(const struct web_connection *c)
{
	return c->web->publisher;
}

/* While a language is opened its request is still there. */
bool web_query(const struct web_connection *c, const char *name, char *ret, size_t cap)
{
	char with_equals[40], value[256];
	const char *found;

	snprintf(with_equals, sizeof(with_equals), "%s=", name);
	found = c->state ? NULL : lws_get_urlarg_by_name(c->wsi, with_equals, value, sizeof(value));
	if (!found)
		return false;
	snprintf(ret, cap, "%s", found);
	return true;
}

void web_hold(struct web_connection *c, bool on)
{
	lws_rx_flow_control(c->wsi, on ? 0 : 1);
}

/* Life */

struct web *web_create(uv_loop_t *loop, const struct config *config, struct publisher *publisher,
                       const struct web_host *host, int *ret_why, char error[320])
{
	struct web *web = config->listen.http[0] ? calloc(1, sizeof(*web)) : NULL;
	const char *scheme = config->listen.has_tls ? "https" : "http";
	int r = 0;

	error[0] = '\0';
	*ret_why = config->listen.http[0] ? -ENOMEM : 0;
	if (!config->listen.http[0])
		return NULL;
	snprintf(error, 320, "out of memory");
	if (!web)
		return NULL;
	error[0] = '\0';
	web->loop = loop;
	web->publisher = publisher;
	web->host = *host;
	web->site.config = config;
	web->site.host = &web->host;
	web->listener.fd = -1;
	web->armed_ns = INT64_MAX;
	if (config->listen.token_file[0])
		r = web_token_read(config->listen.token_file, web->site.secret, error);
	if (r == 0 && !web_check_tls(web, error))
		r = -EINVAL;
	if (r == 0)
		r = listener_open_http(&web->listener, config->listen.http, error);
	if (r < 0) {
		*ret_why = r;
		free(web);
		return NULL;
	}
	web->site.loopback = web->listener.loopback;
	snprintf(web->address, sizeof(web->address), "%s://%s/", scheme, web->listener.name + 4 /* tcp: */);
	return web;
}

void web_speak(struct web *web, const struct web_language *language, void *ctx)
{
	if (!web)
		return;
	assert(web->speakers < WEB_LANGUAGES_MAX && !web->context);
	web->speaker[web->speakers++] = (struct web_speaker){language, ctx};
}

/* Protocol 0 is plain HTTP, and what a client that names no subprotocol speaks: the first language. */
static void list_protocols(struct web *web)
{
	int n = 0;

	web->protocol[n++] = (struct lws_protocols){.name = "http", .callback = on_lws};
	for (int i = 0; i < web->speakers; i++)
		for (const char *const *name = web->speaker[i].language->names; *name && n < PROTOCOLS_MAX; name++) {
			web->speaks[n] = i;
			web->protocol[n++] = (struct lws_protocols){.name = *name, .callback = on_lws};
		}
	for (int i = 0; i < n; i++) {
		web->protocol[i].id = (unsigned)i;
		web->protocol[i].rx_buffer_size = RX_BYTES;
		web->protocol[i].tx_packet_size = WEB_PIECE_MAX + 64; /* and its frame's head */
	}
}

static bool create_context(struct web *web, char error[320])
{
	/* Nobody is closed for not answering pings: one that does not read cannot, and may read again. */
	static const lws_retry_bo_t patient = {0};
	const struct config *config = web->site.config;
	void *loops[] = {web->loop};
	struct lws_context_creation_info info = {.port = CONTEXT_PORT_NO_LISTEN_SERVER,
	                                         .protocols = web->protocol,
	                                         .options = LWS_SERVER_OPTION_LIBUV | LWS_SERVER_OPTION_EXPLICIT_VHOSTS,
	                                         .foreign_loops = loops,
	                                         .user = web,
	                                         .gid = (gid_t)-1,
	                                         .uid = (uid_t)-1,
	                                         .fd_limit_per_thread = (unsigned)(limit(web) + 2 * PLAIN_MAX),
	                                         .timeout_secs = HEADER_S,
	                                         .keepalive_timeout = KEPT_S,
	                                         .max_http_header_data = HEADERS_MAX,
	                                         .server_string = "facetd",
	                                         .vhost_name = "facetd",
	                                         .alpn = "http/1.1",
	                                         .retry_and_idle_policy = &patient};

	lws_set_log_level(0, NULL);
	if (config->listen.has_tls) {
		info.options |= LWS_SERVER_OPTION_DO_SSL_GLOBAL_INIT;
		info.ssl_cert_filepath = config->listen.certificate;
		info.ssl_private_key_filepath = config->listen.key;
		info.ssl_options_set = SSL_OP_NO_TLSv1 | SSL_OP_NO_TLSv1_1;
	}
	web->context = lws_create_context(&info);
	if (!web->context) {
		snprintf(error, 320,
		         "libwebsockets cannot use the loop; install libwebsockets-evlib-uv, or leave listen.http "
		         "empty");
		return false;
	}
	web->vhost = lws_create_vhost(web->context, &info);
	if (!web->vhost)
		snprintf(error, 320,
		         config->listen.has_tls ? "listen.tls: %.100s and %.100s do not belong together, or are no PEM"
		                                : "libwebsockets does not start",
		         config->listen.certificate, config->listen.key);
	return web->vhost != NULL;
}

int web_start(struct web *web, char error[320])
{
	if (!web)
		return 0;
	list_protocols(web);
	uv_timer_init(web->loop, &web->timer);
	uv_timer_init(web->loop, &web->tick);
	web->timer.data = web->tick.data = web->door.data = web;
	if (uv_poll_init(web->loop, &web->door, web->listener.fd) < 0) {
		uv_close((uv_handle_t *)&web->timer, NULL);
		uv_close((uv_handle_t *)&web->tick, NULL);
		snprintf(error, 320, "%.120s: cannot be polled", web->address);
		return -EINVAL;
	}
	web->open = true;
	if (!create_context(web, error))
		return -EINVAL;
	snapshots_watch(web->host.snapshots, on_snapshot, web);
	uv_timer_start(&web->tick, on_tick, 0, TICK_MS);
	return 0;
}

void web_stop(struct web *web)
{
	if (!web || web->stopped)
		return;
	web->stopped = true;
	for (struct web_connection *c = web->connections; c; c = c->next)
		leave_language(c);
	if (web->open) {
		uv_poll_stop(&web->door);
		uv_close((uv_handle_t *)&web->door, NULL);
		uv_close((uv_handle_t *)&web->timer, NULL);
		uv_close((uv_handle_t *)&web->tick, NULL);
	}
	if (web->context)
		lws_context_destroy(web->context); /* begins; the rest when the loop has run dry */
}

void web_destroy(struct web *web)
{
	if (!web)
		return;
	assert(web->stopped);
	if (web->context)
		lws_context_destroy(web->context);
	assert(!web->connections);
	listener_close(&web->listener);
	buffer_finish(&web->site.status);
	free(web);
}

#endif

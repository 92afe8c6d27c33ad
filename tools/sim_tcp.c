/* A simulated device behind a TCP port on loopback: one session of the device for each client.
 *
 * What a network does to connections is done here. Refused: a socket holds the port and does not listen. Timed out: it
 * listens for nobody and its queue is full, so the kernel drops further connects unheard. Half-open: the connection stays
 * and nothing goes through it any more. Unplugged: the same for all, and what waited goes on when the cable is back. A
 * device without power is like one unplugged, but when it is back it knows none of its connections and resets them.
 *
 * One write for each piece that leaves the device, without Nagle's delay: what was cut arrives cut. */
#include <errno.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "tools/sim_device.h"

enum { CLIENTS = 4, DRAIN = 64, IDLE_MS = 1000, BUSY_MS = 2, FILLERS = 2, SEND_BUFFER = 128 * 1024 };

static const char *const kinds[] = {"refuse", "timeout", "reset", "half-open", "unplug", NULL};
enum fault { REFUSE, TIMEOUT, RESET, HALF_OPEN, UNPLUG, FAULTS };

enum door { OPEN, REFUSING, DEAF }; /* how a connect is met */

struct client {
	struct sim_tcp *tcp;
	struct sim_device device; /* its session */
	bool used, first;         /* first: it has the device itself, not a further session */
	bool dead;                /* half-open */
	int fd;
	uv_poll_t *poll;
	uint8_t out[SIM_TRANSFER_MAX]; /* what the connection did not take yet */
	size_t out_len, out_sent;
};

struct sim_tcp {
	struct sim_device device;
	uv_loop_t *loop;
	uv_timer_t timer;
	int listener, port;
	uv_poll_t *poll; /* of the listener; NULL: not open */
	enum door door;
	int filler[FILLERS];
	bool was_alive;
	struct sim_fault_state fault[FAULTS];
	struct client client[CLIENTS];
};

static void serve(struct sim_tcp *tcp);

/* ---- handles ---- */

static void free_handle(uv_handle_t *handle)
{
	free(handle);
}

static void stop_poll(uv_poll_t **poll)
{
	if (*poll == NULL)
		return;
	uv_poll_stop(*poll);
	uv_close((uv_handle_t *)*poll, free_handle);
	*poll = NULL;
}

static int start_poll(struct sim_tcp *tcp, uv_poll_t **poll, int fd, uv_poll_cb callback, void *data)
{
	*poll = malloc(sizeof **poll);
	if (*poll == NULL)
		return UV_ENOMEM;
	const int r = uv_poll_init(tcp->loop, *poll, fd);
	if (r < 0) {
		free(*poll);
		*poll = NULL;
		return r;
	}
	(*poll)->data = data;
	return uv_poll_start(*poll, UV_READABLE, callback);
}

/* ---- clients ---- */

static void drop(struct client *c, bool reset)
{
	const struct linger at_once = {.l_onoff = 1};
	stop_poll(&c->poll);
	if (reset)
		setsockopt(c->fd, SOL_SOCKET, SO_LINGER, &at_once, sizeof at_once);
	close(c->fd);
	c->used = false;
	c->device.connected(c->device.ctx, false, (int64_t)uv_hrtime());
	if (!c->first)
		c->device.destroy(c->device.ctx);
}

static void drop_all(struct sim_tcp *tcp, bool reset)
{
	for (int i = 0; i < CLIENTS; i++)
		if (tcp->client[i].used)
			drop(&tcp->client[i], reset);
}

static bool silent(const struct client *c)
{
	return c->dead || c->tcp->fault[UNPLUG].on;
}

static void on_bytes(uv_poll_t *handle, int status, int events)
{
	struct client *c = handle->data;
	struct sim_tcp *tcp = c->tcp;
	uint8_t bytes[4096];
	(void)status;
	(void)events;
	const ssize_t n = recv(c->fd, bytes, sizeof bytes, MSG_DONTWAIT);
	if (n == 0 || (n < 0 && errno != EAGAIN && errno != EINTR))
		drop(c, false);
	else if (n > 0 && !silent(c))
		c->device.receive(c->device.ctx, bytes, (size_t)n, (int64_t)uv_hrtime());
	serve(tcp);
}

/* The device itself for the first client, a further session for others. False: it takes no more. */
static bool give_session(struct sim_tcp *tcp, struct client *c)
{
	bool taken = false;
	for (int i = 0; i < CLIENTS; i++)
		taken |= tcp->client[i].used && tcp->client[i].first;
	c->first = !taken;
	if (!taken)
		c->device = tcp->device;
	return !taken || (tcp->device.session != NULL && tcp->device.session(tcp->device.ctx, &c->device));
}

static bool adopt(struct sim_tcp *tcp, int fd)
{
	const int yes = 1, size = SEND_BUFFER;
	struct client *c = tcp->client;
	while (c < tcp->client + CLIENTS && c->used)
		c++;
	if (c == tcp->client + CLIENTS || sim_fault_due(&tcp->fault[RESET]) || !give_session(tcp, c))
		return false;
	setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
	setsockopt(fd, SOL_SOCKET, SO_SNDBUF, &size, sizeof size);
	c->tcp = tcp;
	c->fd = fd;
	c->used = true;
	c->dead = tcp->fault[HALF_OPEN].on;
	c->out_len = c->out_sent = 0;
	if (start_poll(tcp, &c->poll, fd, on_bytes, c) < 0) {
		c->used = false;
		if (!c->first)
			c->device.destroy(c->device.ctx);
		return false;
	}
	c->device.connected(c->device.ctx, true, (int64_t)uv_hrtime());
	return true;
}

static void on_connect(uv_poll_t *handle, int status, int events)
{
	const struct linger at_once = {.l_onoff = 1};
	struct sim_tcp *tcp = handle->data;
	(void)status;
	(void)events;
	const int fd = accept4(tcp->listener, NULL, NULL, SOCK_NONBLOCK | SOCK_CLOEXEC);
	if (fd >= 0 && !adopt(tcp, fd)) {
		setsockopt(fd, SOL_SOCKET, SO_LINGER, &at_once, sizeof at_once);
		close(fd);
	}
	serve(tcp);
}

/* ---- the door ---- */

static struct sockaddr_in address_of(int port)
{
	return (struct sockaddr_in){
	    .sin_family = AF_INET, .sin_port = htons((uint16_t)port), .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
}

static void fill_queue(struct sim_tcp *tcp)
{
	const struct sockaddr_in address = address_of(tcp->port);
	for (int i = 0; i < FILLERS; i++) {
		tcp->filler[i] = socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
		if (tcp->filler[i] >= 0 &&
		    connect(tcp->filler[i], (const struct sockaddr *)&address, sizeof address) < 0 &&
		    errno != EINPROGRESS)
			perror("simulated scanner: cannot fill its own queue");
	}
}

static void close_door(struct sim_tcp *tcp)
{
	stop_poll(&tcp->poll);
	for (int i = 0; i < FILLERS; i++) {
		if (tcp->filler[i] >= 0)
			close(tcp->filler[i]);
		tcp->filler[i] = -1;
	}
	if (tcp->listener >= 0)
		close(tcp->listener);
	tcp->listener = -1;
}

static int set_door(struct sim_tcp *tcp, enum door door)
{
	const int yes = 1;
	struct sockaddr_in address = address_of(tcp->port);
	socklen_t len = sizeof address;
	close_door(tcp);
	tcp->door = door;
	tcp->listener = socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
	if (tcp->listener < 0)
		return -errno;
	setsockopt(tcp->listener, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
	if (bind(tcp->listener, (struct sockaddr *)&address, sizeof address) < 0 ||
	    getsockname(tcp->listener, (struct sockaddr *)&address, &len) < 0)
		return -errno;
	tcp->port = ntohs(address.sin_port);
	if (door != REFUSING && listen(tcp->listener, door == DEAF ? 0 : 8) < 0)
		return -errno;
	if (door == DEAF)
		fill_queue(tcp);
	return door == OPEN ? start_poll(tcp, &tcp->poll, tcp->listener, on_connect, tcp) : 0;
}

static bool has_power(const struct sim_tcp *tcp)
{
	return tcp->device.alive == NULL || tcp->device.alive(tcp->device.ctx);
}

static void look_at_power(struct sim_tcp *tcp)
{
	const bool alive = has_power(tcp);
	if (alive && !tcp->was_alive)
		drop_all(tcp, true);
	for (int i = 0; i < CLIENTS && !alive; i++)
		tcp->client[i].dead = true;
	tcp->was_alive = alive;
}

static enum door wanted_door(const struct sim_tcp *tcp)
{
	if (tcp->fault[REFUSE].on)
		return REFUSING;
	return !has_power(tcp) || tcp->fault[TIMEOUT].on || tcp->fault[UNPLUG].on ? DEAF : OPEN;
}

/* ---- bytes ---- */

/* True: the connection takes more. */
static bool send_out(struct client *c)
{
	const ssize_t n = send(c->fd, c->out + c->out_sent, c->out_len - c->out_sent, MSG_DONTWAIT | MSG_NOSIGNAL);
	if (n > 0)
		c->out_sent += (size_t)n;
	if (c->out_sent < c->out_len)
		return false;
	c->out_len = c->out_sent = 0;
	return true;
}

static void pump(struct client *c)
{
	for (int i = 0; i < DRAIN; i++) {
		if (c->out_len > 0 && !c->dead && !send_out(c))
			return;
		c->out_len = c->device.transmit(c->device.ctx, c->out, sizeof c->out);
		c->out_sent = 0;
		if (c->out_len == 0)
			return;
	}
}

static void on_timer(uv_timer_t *timer)
{
	serve(timer->data);
}

static void wake(struct sim_tcp *tcp)
{
	const int64_t now_ns = (int64_t)uv_hrtime();
	int64_t deadline_ns = tcp->device.deadline(tcp->device.ctx), ms = IDLE_MS;
	bool busy = false;
	for (int i = 0; i < CLIENTS; i++) {
		const struct client *c = &tcp->client[i];
		if (!c->used)
			continue;
		busy |= c->out_len > 0;
		const int64_t own_ns = c->device.deadline(c->device.ctx);
		if (own_ns < deadline_ns)
			deadline_ns = own_ns;
	}
	if (deadline_ns - now_ns < IDLE_MS * 1000000ll)
		ms = deadline_ns > now_ns ? (deadline_ns - now_ns + 999999) / 1000000 : 0;
	if (busy || (ms < BUSY_MS && tcp->fault[UNPLUG].on))
		ms = BUSY_MS;
	uv_update_time(tcp->loop);
	uv_timer_start(&tcp->timer, on_timer, (uint64_t)ms, 0);
}

static void serve(struct sim_tcp *tcp)
{
	tcp->device.advance(tcp->device.ctx, (int64_t)uv_hrtime());
	look_at_power(tcp);
	if (wanted_door(tcp) != tcp->door)
		set_door(tcp, wanted_door(tcp));
	for (int i = 0; i < CLIENTS; i++)
		if (tcp->client[i].used && !tcp->fault[UNPLUG].on)
			pump(&tcp->client[i]);
	wake(tcp);
}

/* ---- opening, closing, faults ---- */

struct sim_tcp *sim_tcp_create(uv_loop_t *loop, int port, const struct sim_device *device, char error[160])
{
	struct sim_tcp *tcp = calloc(1, sizeof *tcp);
	if (tcp == NULL) {
		device->destroy(device->ctx);
		snprintf(error, 160, "out of memory");
		return NULL;
	}
	tcp->device = *device;
	tcp->loop = loop;
	tcp->port = port;
	tcp->listener = -1;
	tcp->was_alive = true;
	for (int i = 0; i < FILLERS; i++)
		tcp->filler[i] = -1;
	const int r = set_door(tcp, OPEN);
	if (r < 0) {
		snprintf(error, 160, "127.0.0.1:%d: no port for the simulated scanner (%s); choose another", port,
		         strerror(-r));
		close_door(tcp);
		device->destroy(device->ctx);
		free(tcp);
		return NULL;
	}
	uv_timer_init(loop, &tcp->timer);
	tcp->timer.data = tcp;
	uv_timer_start(&tcp->timer, on_timer, 0, 0);
	return tcp;
}

static void on_closed(uv_handle_t *handle)
{
	free(handle->data);
}

void sim_tcp_destroy(struct sim_tcp *tcp)
{
	drop_all(tcp, false);
	close_door(tcp);
	tcp->device.destroy(tcp->device.ctx);
	uv_close((uv_handle_t *)&tcp->timer, on_closed);
}

int sim_tcp_port(const struct sim_tcp *tcp)
{
	return tcp->port;
}

const char *const *sim_tcp_fault_kinds(void)
{
	return kinds;
}

/* Once, it befalls the connections there are; with a duration, those to come as well. */
static void befall(struct sim_tcp *tcp, enum fault kind)
{
	if (kind == RESET || kind == REFUSE)
		drop_all(tcp, true);
	for (int i = 0; i < CLIENTS && (kind == HALF_OPEN || kind == TIMEOUT); i++)
		tcp->client[i].dead = true;
}

bool sim_tcp_fault(struct sim_tcp *tcp, const struct sim_fault *fault, bool on)
{
	bool known = tcp->device.fault(tcp->device.ctx, fault, on, (int64_t)uv_hrtime());
	const int i = known ? -1 : sim_fault_index(kinds, fault->kind);
	if (i >= 0) {
		tcp->fault[i].on = on && fault->for_ns > 0;
		if (on)
			befall(tcp, (enum fault)i);
		known = true;
	}
	serve(tcp);
	return known;
}

/* The bus has two sides: its nodes, and what is outside, clients of the hub and a real interface. Frames among nodes
 * never fail; every fault befalls what crosses from one side to the other, which is where facetd's controller would be.
 *
 * A frame of a client is stamped when it is read, the nodes are brought to that time, then they get it: a node that
 * measures at SYNC measures at the very time that the client is told. What nodes send in answer is on the bus after it.
 *
 * Error frames are those of the kernel's controllers: class bits in the id, counters in data 6 and 7. Handles of libuv
 * outlive the close of what they watch, so each is memory of its own. */
#include "tools/sim_can_bus.h"

#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include "daemon/wall_clock.h"
#include "drivers/can_wire.h"
#include "drivers/unix_socket.h"

enum {
	DRAIN = 64,     /* messages of one client at a time */
	STORM = 256,    /* frames of nodes at a time: what they answer to each other without an end goes on later */
	DELAYED = 1024, /* frames that are late; one more is dropped */
	IDLE_MS = 1000,
	AGAIN_MS = 200, /* an interface that went is looked for so often */
	ERRORS_HZ = 1000,
	NO_ACK_HZ = 100,
	OUTSIDE = -1 /* a frame's sender that is no node */
};
#define PAST_NS                 INT64_C(200000000) /* a machine that stalled for longer has lost what was due */
#define CAN_WIRE_ERROR_PROTOCOL 0x008u
#define CAN_WIRE_ERROR_COUNTERS 0x200u

enum fault { BUS_OFF, WARNING, PASSIVE, ERRORS, NO_ACK, DROP, LATE, RTR, EXTENDED, FD, FULL, DOWN, DELETED, FAULTS };
static const char *const kinds[] = {"bus-off", "warning",  "passive", "errors", "no ack", "drop",    "late",
                                    "rtr",     "extended", "fd",      "full",   "down",   "deleted", NULL};
static const char *const interface_kinds[] = {"bus-off", "warning", "passive",  "errors", "no ack", "drop",
                                              "late",    "rtr",     "extended", "fd",     NULL};

struct client {
	struct sim_can_bus *bus;
	bool used;
	int fd;
	uv_poll_t *poll;
};

struct delayed {
	int64_t due_ns;
	struct can_frame_at frame;
};

struct sim_can_bus {
	uv_loop_t *loop;
	uv_timer_t *timer;
	char path[108], interface[IFNAMSIZ];
	int listener, socket; /* of the hub; of the interface */
	uv_poll_t *listening, *polling;
	struct client client[SIM_CAN_BUS_CLIENTS];
	struct sim_device node[SIM_CAN_BUS_NODES];
	int nodes;
	int64_t now_ns;      /* never goes back */
	int64_t realtime_ns; /* CLOCK_REALTIME - our clock */
	int64_t again_ns;    /* when the interface is looked for */
	struct sim_fault_state fault[FAULTS];
	int64_t error_ns;        /* error frames were made up to here */
	struct delayed *delayed; /* a ring */
	unsigned first_delayed, n_delayed;
	uint64_t random;
	struct sim_can_bus_counts counts;
};

static void serve(struct sim_can_bus *bus);

/* ---- handles ---- */

static void free_handle(uv_handle_t *handle)
{
	free(handle);
}

static void stop_poll(uv_poll_t **poll)
{
	if (!*poll)
		return;
	uv_poll_stop(*poll);
	uv_close((uv_handle_t *)*poll, free_handle);
	*poll = NULL;
}

static int start_poll(struct sim_can_bus *bus, uv_poll_t **poll, int fd, uv_poll_cb callback, void *data)
{
	int r;

	*poll = malloc(sizeof **poll);
	if (!*poll)
		return -ENOMEM;
	r = uv_poll_init(bus->loop, *poll, fd);
	if (r < 0) {
		free(*poll);
		*poll = NULL;
		return r;
	}
	(*poll)->data = data;
	return uv_poll_start(*poll, UV_READABLE, callback);
}

static int64_t clock_of(struct sim_can_bus *bus)
{
	int64_t offset_ns;

	if (wall_clock_offset(&offset_ns))
		bus->realtime_ns = offset_ns;
	return (int64_t)uv_hrtime();
}

/* ---- outside ---- */

static void hang_up(struct client *c)
{
	stop_poll(&c->poll);
	close(c->fd);
	c->used = false;
	c->bus->counts.clients--;
}

static void close_socket(struct sim_can_bus *bus)
{
	stop_poll(&bus->polling);
	if (bus->socket >= 0)
		close(bus->socket);
	bus->socket = -1;
	bus->again_ns = bus->now_ns + AGAIN_MS * INT64_C(1000000);
}

static void tell_client(struct client *c, const uint8_t *entry, size_t len)
{
	if (send(c->fd, entry, len, MSG_DONTWAIT | MSG_NOSIGNAL) == (ssize_t)len)
		return;
	if (errno == EAGAIN || errno == ENOBUFS || errno == EINTR)
		c->bus->counts.missed++;
	else
		hang_up(c);
}

static void tell_interface(struct sim_can_bus *bus, const struct can_frame_at *f)
{
	const bool fd = f->flags & CAN_WIRE_FD;
	struct canfd_frame out = {.can_id = f->id, .len = f->len, .flags = fd ? f->flags : 0};

	memcpy(out.data, f->data, f->len);
	if (bus->socket < 0 || send(bus->socket, &out, fd ? CANFD_MTU : CAN_MTU, MSG_DONTWAIT) < 0)
		bus->counts.dropped++;
}

/* The frame reaches everybody outside. `f->t_ns` is our clock's. */
static void tell_outside(struct sim_can_bus *bus, const struct can_frame_at *f)
{
	uint8_t entry[CAN_WIRE_ENTRY_FD];
	struct can_frame_at stamped = *f;
	size_t len;

	stamped.t_ns += bus->realtime_ns;
	len = can_wire_put(&stamped, entry);
	for (int i = 0; i < SIM_CAN_BUS_CLIENTS; i++)
		if (bus->client[i].used)
			tell_client(&bus->client[i], entry, len);
	if (*bus->interface)
		tell_interface(bus, f);
}

static void send_error(struct sim_can_bus *bus, uint32_t classes, int at, uint8_t value, uint8_t errors)
{
	struct can_frame_at f = {.id = CAN_WIRE_ERROR | classes, .len = 8, .t_ns = bus->now_ns};

	f.data[at] = value;
	f.data[6] = errors;
	bus->counts.errors++;
	tell_outside(bus, &f);
}

/* ---- crossing ---- */

static bool gets_lost(struct sim_can_bus *bus)
{
	struct sim_fault_state *drop = &bus->fault[DROP];
	bool lost = bus->fault[BUS_OFF].on || (drop->on && sim_random(&bus->random) < sim_fault_value(drop, 1.0)) ||
	            (!drop->on && sim_fault_due(drop));

	bus->counts.dropped += lost;
	return lost;
}

static void leave(struct sim_can_bus *bus, const struct can_frame_at *f)
{
	struct sim_fault_state *state = &bus->fault[LATE];
	bool late = sim_fault_due(state);
	struct delayed *d = &bus->delayed[(bus->first_delayed + bus->n_delayed) % DELAYED];

	if (!late && bus->n_delayed == 0) {
		tell_outside(bus, f);
		return;
	}
	if (bus->n_delayed == DELAYED) {
		bus->counts.dropped++;
		return;
	}
	*d = (struct delayed){.due_ns = f->t_ns, .frame = *f};
	if (late)
		d->due_ns += (int64_t)(sim_fault_value(state, 20.0) * 1e6);
	bus->n_delayed++;
}

static void leave_delayed(struct sim_can_bus *bus)
{
	while (bus->n_delayed > 0 && bus->delayed[bus->first_delayed].due_ns <= bus->now_ns) {
		tell_outside(bus, &bus->delayed[bus->first_delayed].frame);
		bus->first_delayed = (bus->first_delayed + 1) % DELAYED;
		bus->n_delayed--;
	}
}

static void leave_twins(struct sim_can_bus *bus, const struct can_frame_at *f)
{
	struct can_frame_at twin = {.id = f->id | CAN_WIRE_REMOTE, .len = f->len, .t_ns = f->t_ns};

	if (f->flags & CAN_WIRE_FD)
		return;
	if (sim_fault_due(&bus->fault[RTR]))
		leave(bus, &twin);
	twin = *f;
	twin.id ^= CAN_WIRE_EXTENDED;
	memset(twin.data, 0x55, twin.len);
	if ((f->id & ~CAN_WIRE_EXTENDED) < 0x800 && sim_fault_due(&bus->fault[EXTENDED]))
		leave(bus, &twin);
	twin = *f;
	twin.flags = CAN_WIRE_FD | CAN_WIRE_BRS;
	twin.len = 64;
	if (sim_fault_due(&bus->fault[FD]))
		leave(bus, &twin);
}

/* ---- nodes ---- */

static void tell_nodes(struct sim_can_bus *bus, int from, const struct can_frame_at *f)
{
	uint8_t entry[CAN_WIRE_ENTRY_FD];
	size_t len = can_wire_put(f, entry);

	for (int i = 0; i < bus->nodes; i++)
		if (i != from && (!bus->node[i].alive || bus->node[i].alive(bus->node[i].ctx)))
			bus->node[i].receive(bus->node[i].ctx, entry, len, bus->now_ns);
}

static void put(struct sim_can_bus *bus, int from, struct can_frame_at *f)
{
	f->t_ns = bus->now_ns;
	bus->counts.frames++;
	tell_nodes(bus, from, f);
	if (gets_lost(bus))
		return;
	leave(bus, f);
	leave_twins(bus, f);
}

/* A piece of a node: one entry or several. */
static int put_piece(struct sim_can_bus *bus, int from, const uint8_t *bytes, size_t len)
{
	struct can_frame_at f;
	ssize_t used;
	int n = 0;

	for (size_t at = 0; at < len && (used = can_wire_get(bytes + at, len - at, &f)) > 0; at += (size_t)used, n++)
		put(bus, from, &f);
	return n;
}

static void advance(struct sim_can_bus *bus)
{
	for (int i = 0; i < bus->nodes; i++)
		bus->node[i].advance(bus->node[i].ctx, bus->now_ns);
}

/* What the nodes have to say, also to each other. True: they are not done. */
static bool pump(struct sim_can_bus *bus)
{
	uint8_t piece[SIM_TRANSFER_MAX];
	int said = 0;

	for (bool more = true; more && said < STORM;) {
		more = false;
		for (int i = 0; i < bus->nodes; i++) {
			size_t len = bus->node[i].transmit(bus->node[i].ctx, piece, sizeof piece);

			if (len == 0)
				continue;
			said += 1 + put_piece(bus, i, piece, len);
			more = true;
		}
	}
	return said >= STORM;
}

static int64_t earlier(int64_t a_ns, int64_t b_ns)
{
	return a_ns < b_ns ? a_ns : b_ns;
}

static int64_t nodes_deadline(const struct sim_can_bus *bus)
{
	int64_t due_ns = INT64_MAX;

	for (int i = 0; i < bus->nodes; i++)
		due_ns = earlier(due_ns, bus->node[i].deadline(bus->node[i].ctx));
	return due_ns;
}

/* Brings the bus to t_ns. Behind the hub what was due before is done at its own time, and stamped with it, however late the
 * machine looks; what leaves by a real interface gets the kernel's stamp, so there it is done now. True: nodes are not done. */
static bool run(struct sim_can_bus *bus, int64_t t_ns)
{
	bool more = false;

	if (!*bus->interface && bus->now_ns < t_ns - PAST_NS)
		bus->now_ns = t_ns - PAST_NS;
	for (int i = 0; i < STORM && !*bus->interface && nodes_deadline(bus) < t_ns; i++) {
		const int64_t due_ns = nodes_deadline(bus);

		bus->now_ns = due_ns > bus->now_ns ? due_ns : bus->now_ns;
		advance(bus);
		pump(bus);
	}
	bus->now_ns = t_ns > bus->now_ns ? t_ns : bus->now_ns;
	advance(bus);
	more = pump(bus);
	return more;
}

/* A frame from outside, at `stamp_ns` on our clock. False: it never was on the bus. */
static bool take(struct sim_can_bus *bus, struct can_frame_at *f, int64_t stamp_ns)
{
	bus->counts.received++;
	f->t_ns = stamp_ns;
	if (f->id == CAN_WIRE_LOST) {
		bus->counts.refused++;
		return false;
	}
	if (gets_lost(bus))
		return false;
	if (!(f->id & CAN_WIRE_ERROR))
		tell_nodes(bus, OUTSIDE, f);
	return true;
}

/* ---- the hub ---- */

static void on_entries(uv_poll_t *handle, int status, int events)
{
	struct client *c = handle->data;
	struct sim_can_bus *bus = c->bus;
	uint8_t message[CAN_WIRE_ENTRY_FD + 1];
	struct can_frame_at f;
	ssize_t n = 0;

	(void)status;
	(void)events;
	for (int i = 0; i < DRAIN && c->used; i++) {
		n = recv(c->fd, message, sizeof message, MSG_DONTWAIT);
		if (n <= 0)
			break;
		if (can_wire_get(message, (size_t)n, &f) != n) {
			bus->counts.refused++;
			continue;
		}
		run(bus, clock_of(bus));
		if (!take(bus, &f, bus->now_ns))
			continue;
		tell_outside(bus, &f);
		pump(bus);
	}
	if (c->used && (n == 0 || (n < 0 && errno != EAGAIN && errno != EINTR)))
		hang_up(c);
	serve(bus);
}

static void on_connect(uv_poll_t *handle, int status, int events)
{
	struct sim_can_bus *bus = handle->data;
	int fd = accept4(bus->listener, NULL, NULL, SOCK_NONBLOCK | SOCK_CLOEXEC), i = 0;

	(void)status;
	(void)events;
	while (i < SIM_CAN_BUS_CLIENTS && bus->client[i].used)
		i++;
	if (fd < 0)
		return;
	if (i == SIM_CAN_BUS_CLIENTS) {
		close(fd);
		return;
	}
	bus->client[i] = (struct client){.bus = bus, .used = true, .fd = fd};
	bus->counts.clients++;
	bus->counts.connections++;
	if (start_poll(bus, &bus->client[i].poll, fd, on_entries, &bus->client[i]) < 0)
		hang_up(&bus->client[i]);
	else if (bus->fault[FULL].on)
		uv_poll_stop(bus->client[i].poll);
}

static void close_hub(struct sim_can_bus *bus, bool file_too)
{
	stop_poll(&bus->listening);
	if (bus->listener >= 0)
		close(bus->listener);
	bus->listener = -1;
	for (int i = 0; i < SIM_CAN_BUS_CLIENTS; i++)
		if (bus->client[i].used)
			hang_up(&bus->client[i]);
	if (file_too && *bus->path)
		unlink(bus->path);
}

static int open_hub(struct sim_can_bus *bus)
{
	struct sockaddr_un address = {.sun_family = AF_UNIX};
	int r;

	memcpy(address.sun_path, bus->path, sizeof bus->path);
	bus->listener = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
	if (bus->listener < 0)
		return -errno;
	r = unix_socket_bind(bus->listener, &address);
	if (!r && listen(bus->listener, SIM_CAN_BUS_CLIENTS) < 0)
		r = -errno;
	if (!r)
		r = start_poll(bus, &bus->listening, bus->listener, on_connect, bus);
	if (r < 0) {
		close(bus->listener);
		bus->listener = -1;
	}
	return r;
}

static void look_at_door(struct sim_can_bus *bus)
{
	bool shut = bus->fault[DOWN].on || bus->fault[DELETED].on;

	if (!*bus->path)
		return;
	if (shut)
		close_hub(bus, bus->fault[DELETED].on);
	else if (bus->listener < 0)
		open_hub(bus);
}

/* ---- a real interface ---- */

/* The kernel's stamp of a message on our clock; where there is none, now. */
static int64_t stamp_of(struct sim_can_bus *bus, struct msghdr *msg)
{
	for (struct cmsghdr *c = CMSG_FIRSTHDR(msg); c; c = CMSG_NXTHDR(msg, c)) {
		struct timespec ts;

		if (c->cmsg_level != SOL_SOCKET || c->cmsg_type != SCM_TIMESTAMPNS)
			continue;
		memcpy(&ts, CMSG_DATA(c), sizeof ts);
		return (int64_t)ts.tv_sec * 1000000000 + ts.tv_nsec - bus->realtime_ns;
	}
	return bus->now_ns;
}

static void on_frames(uv_poll_t *handle, int status, int events)
{
	struct sim_can_bus *bus = handle->data;
	struct canfd_frame in;
	ssize_t n = -1;

	(void)events;
	for (int i = 0; i < DRAIN && status >= 0; i++) {
		char control[128];
		struct iovec iov = {&in, sizeof in};
		struct msghdr msg = {
		    .msg_iov = &iov, .msg_iovlen = 1, .msg_control = control, .msg_controllen = sizeof control};
		struct can_frame_at f = {0};

		n = recvmsg(bus->socket, &msg, MSG_DONTWAIT);
		if (n < 0)
			break;
		f = (struct can_frame_at){
		    .id = in.can_id, .len = in.len, .flags = n == CANFD_MTU ? in.flags | CAN_WIRE_FD : 0};
		memcpy(f.data, in.data, in.len <= 64 ? in.len : 0);
		run(bus, clock_of(bus));
		take(bus, &f, stamp_of(bus, &msg));
		pump(bus);
	}
	if (status < 0 || (n < 0 && errno != EAGAIN && errno != EINTR))
		close_socket(bus);
	serve(bus);
}

static int open_socket(struct sim_can_bus *bus)
{
	struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(bus->interface)};
	const int yes = 1;

	if (address.can_ifindex == 0)
		return -ENODEV;
	bus->socket = socket(PF_CAN, SOCK_RAW | SOCK_NONBLOCK | SOCK_CLOEXEC, CAN_RAW);
	if (bus->socket < 0)
		return -errno;
	setsockopt(bus->socket, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &yes, sizeof yes);
	setsockopt(bus->socket, SOL_SOCKET, SO_TIMESTAMPNS, &yes, sizeof yes);
	if (bind(bus->socket, (const struct sockaddr *)&address, sizeof address) < 0)
		return -errno;
	return start_poll(bus, &bus->polling, bus->socket, on_frames, bus);
}

static void look_at_interface(struct sim_can_bus *bus)
{
	if (!*bus->interface || bus->socket >= 0 || bus->now_ns < bus->again_ns)
		return;
	if (open_socket(bus) < 0)
		close_socket(bus);
}

/* ---- serving ---- */

/* How often error frames come now; 0: never. */
static double error_hz(const struct sim_can_bus *bus)
{
	if (bus->fault[ERRORS].on)
		return sim_fault_value(&bus->fault[ERRORS], ERRORS_HZ);
	return bus->fault[NO_ACK].on ? NO_ACK_HZ : 0.0;
}

static void make_errors(struct sim_can_bus *bus)
{
	double hz = error_hz(bus);
	int n = 0;

	if (hz <= 0.0)
		return;
	for (int64_t step_ns = (int64_t)(1e9 / hz); bus->error_ns + step_ns <= bus->now_ns && n < DRAIN; n++) {
		bus->error_ns += step_ns;
		if (bus->fault[ERRORS].on)
			send_error(bus, CAN_WIRE_ERROR_PROTOCOL | CAN_WIRE_ERROR_BUS, 2, 0x04, 0);
		else
			send_error(bus, CAN_WIRE_ERROR_NO_ACK, 1, 0, 0);
	}
	if (n == DRAIN) /* the machine is behind: what was not made in time is not made */
		bus->error_ns = bus->now_ns;
}

static void on_timer(uv_timer_t *timer)
{
	serve(timer->data);
}

static void wake(struct sim_can_bus *bus, bool at_once)
{
	int64_t due_ns = bus->now_ns + IDLE_MS * INT64_C(1000000), wait_ns;
	double hz = error_hz(bus);

	due_ns = earlier(due_ns, nodes_deadline(bus));
	if (bus->n_delayed > 0)
		due_ns = earlier(due_ns, bus->delayed[bus->first_delayed].due_ns);
	if (hz > 0.0)
		due_ns = earlier(due_ns, bus->error_ns + (int64_t)(1e9 / hz));
	if (*bus->interface && bus->socket < 0)
		due_ns = earlier(due_ns, bus->again_ns);
	wait_ns = at_once ? 0 : due_ns - (int64_t)uv_hrtime();
	uv_update_time(bus->loop);
	uv_timer_start(bus->timer, on_timer, wait_ns > 0 ? (uint64_t)(wait_ns + 999999) / 1000000 : 0, 0);
}

static void serve(struct sim_can_bus *bus)
{
	bool more = run(bus, clock_of(bus));

	look_at_interface(bus);
	leave_delayed(bus);
	make_errors(bus);
	wake(bus, more);
}

/* ---- faults ---- */

static void begin_fault(struct sim_can_bus *bus, enum fault kind)
{
	const uint32_t controller = CAN_WIRE_ERROR_CONTROLLER | CAN_WIRE_ERROR_COUNTERS;

	bus->error_ns = bus->now_ns;
	switch (kind) {
	case BUS_OFF:
		send_error(bus, CAN_WIRE_ERROR_BUS_OFF, 1, 0, 0);
		break;
	case WARNING:
		send_error(bus, controller, 1, 0x08, 96);
		break;
	case PASSIVE:
		send_error(bus, controller, 1, 0x20, 128);
		break;
	case NO_ACK:
		send_error(bus, CAN_WIRE_ERROR_NO_ACK, 1, 0, 0);
		break;
	case ERRORS:
		send_error(bus, CAN_WIRE_ERROR_PROTOCOL | CAN_WIRE_ERROR_BUS, 2, 0x04, 0);
		break;
	default:
		break;
	}
}

static void end_fault(struct sim_can_bus *bus, enum fault kind)
{
	if (kind == BUS_OFF)
		send_error(bus, CAN_WIRE_ERROR_RESTARTED, 1, 0, 0);
	else if (kind == WARNING || kind == PASSIVE)
		send_error(bus, CAN_WIRE_ERROR_CONTROLLER | CAN_WIRE_ERROR_COUNTERS, 1, 0x40, 0);
}

static void hear_clients(struct sim_can_bus *bus, bool yes)
{
	for (int i = 0; i < SIM_CAN_BUS_CLIENTS; i++)
		if (bus->client[i].used && yes)
			uv_poll_start(bus->client[i].poll, UV_READABLE, on_entries);
		else if (bus->client[i].used)
			uv_poll_stop(bus->client[i].poll);
}

bool sim_can_bus_fault(struct sim_can_bus *bus, const struct sim_fault *fault, bool on)
{
	int i = sim_fault_index(sim_can_bus_fault_kinds(bus), fault->kind);

	if (i < 0)
		return false;
	run(bus, clock_of(bus));
	sim_fault_set(&bus->fault[i], fault, on);
	if (on)
		begin_fault(bus, (enum fault)i);
	else
		end_fault(bus, (enum fault)i);
	if (i == FULL)
		hear_clients(bus, !bus->fault[FULL].on);
	if (on && (i == DOWN || i == DELETED))
		close_hub(bus, i == DELETED); /* without a duration: once, and open again */
	look_at_door(bus);
	serve(bus);
	return true;
}

bool sim_can_bus_node_fault(struct sim_can_bus *bus, int node, const struct sim_fault *fault, bool on)
{
	bool known;

	run(bus, clock_of(bus));
	known = bus->node[node].fault(bus->node[node].ctx, fault, on, bus->now_ns);
	serve(bus);
	return known;
}

const char *const *sim_can_bus_fault_kinds(const struct sim_can_bus *bus)
{
	return *bus->path ? kinds : interface_kinds;
}

void sim_can_bus_counts(const struct sim_can_bus *bus, struct sim_can_bus_counts *ret)
{
	*ret = bus->counts;
}

/* ---- opening and closing ---- */

static int open_bus(struct sim_can_bus *bus, const struct sim_can_bus_params *params, char error[160])
{
	int r = 0;

	bus->delayed = calloc(DELAYED, sizeof *bus->delayed);
	bus->timer = calloc(1, sizeof *bus->timer);
	if (!bus->delayed || !bus->timer) {
		snprintf(error, 160, "out of memory");
		return -ENOMEM;
	}
	uv_timer_init(bus->loop, bus->timer);
	bus->timer->data = bus;
	if (params->path && strlen(params->path) >= sizeof bus->path)
		r = -ENAMETOOLONG;
	else if (params->path)
		snprintf(bus->path, sizeof bus->path, "%s", params->path);
	if (!r && params->path)
		r = open_hub(bus);
	if (r < 0) {
		snprintf(error, 160, "%.90s: no socket for the simulated CAN bus: %s", params->path, strerror(-r));
		*bus->path = '\0';
		return r;
	}
	snprintf(bus->interface, sizeof bus->interface, "%s", params->interface ? params->interface : "");
	r = *bus->interface ? open_socket(bus) : 0;
	if (r < 0)
		snprintf(error, 160, "%s: no CAN interface for the simulated nodes: %s", bus->interface,
		         r == -EAFNOSUPPORT ? "this kernel has no CAN (modprobe can_raw)" : strerror(-r));
	return r;
}

struct sim_can_bus *sim_can_bus_create(uv_loop_t *loop, const struct sim_can_bus_params *params, char error[160])
{
	struct sim_can_bus *bus = calloc(1, sizeof *bus);

	if (!bus) {
		snprintf(error, 160, "out of memory");
		return NULL;
	}
	bus->loop = loop;
	bus->listener = bus->socket = -1;
	bus->random = sim_mix(params->seed);
	bus->realtime_ns = wall_clock_first_offset();
	if (open_bus(bus, params, error) < 0) {
		sim_can_bus_destroy(bus);
		return NULL;
	}
	serve(bus);
	return bus;
}

void sim_can_bus_destroy(struct sim_can_bus *bus)
{
	if (!bus)
		return;
	close_hub(bus, true);
	close_socket(bus);
	for (int i = 0; i < bus->nodes; i++)
		bus->node[i].destroy(bus->node[i].ctx);
	if (bus->timer && bus->timer->data)
		uv_close((uv_handle_t *)bus->timer, free_handle);
	else
		free(bus->timer);
	free(bus->delayed);
	free(bus);
}

int sim_can_bus_attach(struct sim_can_bus *bus, const struct sim_device *device)
{
	if (bus->nodes == SIM_CAN_BUS_NODES) {
		device->destroy(device->ctx);
		return -ENOSPC;
	}
	bus->node[bus->nodes] = *device;
	if (device->connected)
		device->connected(device->ctx, true, clock_of(bus));
	bus->nodes++;
	serve(bus);
	return bus->nodes - 1;
}

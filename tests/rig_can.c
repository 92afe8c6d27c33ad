/* A CAN bus in virtual time, in the place of drivers/can_link.c: what a driver opens, with its filters, is a socket here.
 *
 *   brain ── queue ─┐                             ┌─► socket ── filters, room for 256 ──► driver
 *   brain ── queue ─┼─► one frame at a time, the ─┤
 *   host ─ queue 10 ┘   lowest id first, 500 kBd  └─► every brain but its sender
 *
 * A frame is stamped at its last bit, also the host's own ones, and read a little later. One that nobody acknowledges is
 * sent again and again: with all nodes off the host's queue fills, and what finds no room in it is lost and told, as the
 * kernel does it (ENOBUFS). Single bus errors cost time and are not told, as drivers/can_link.c asks it of the kernel. */
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "drivers/can_link.h"
#include "drivers/can_words.h"
#include "tests/rig_parts.h"

#define BIT_NS      2000 /* 500 kBd */
#define BIT_DATA_NS 500  /* of an FD frame's data */
#define HOST_QUEUE  10   /* txqueuelen */
#define NODE_QUEUE  64
#define SOCKET_ROOM 256
#define ERROR_BITS  23 /* a bus error and its end */

enum fault {
	BUS_OFF,
	WARNING,
	PASSIVE,
	ERRORS,
	NO_ACK,
	DROP,
	OVERRUN,
	LATE,
	RTR,
	EXTENDED,
	FD,
	AS_FD,
	FLOOD,
	FULL,
	DOWN,
	DELETED,
	FAULTS
};
static const char *const fault_names[] = {"bus-off", "warning",  "passive", "errors",   "no ack", "drop",
                                          "overrun", "bus late", "rtr",     "extended", "fd",     "as fd",
                                          "flood",   "full",     "down",    "deleted",  NULL};

struct waiting { /* a frame on its way to the bus */
	struct can_frame_at frame;
	int sent; /* profiles, angles or motions of its brain that it carries */
};

struct queue {
	struct waiting frame[NODE_QUEUE];
	unsigned first, n, cap;
};

struct bus {
	struct rig *rig;
	const char *name;
	struct link *node[CONFIG_DEVICES_MAX];
	int nodes;
	struct queue host;
	bool busy; /* `current` is on the wire until free_ns */
	struct waiting current;
	int sender; /* of it: a node, or -1: the host, -2: nobody here */
	int64_t free_ns;
	bool unheard; /* nobody acknowledges */
	bool on[FAULTS];
	double value[FAULTS];
	uint64_t random;
};

struct tap { /* a node and its driver's socket */
	struct bus *bus;
	struct queue queue; /* of the brain */
	bool open;
	int error; /* of a socket that lost its interface */
	struct can_link_filter filter[CAN_LINK_FILTERS_MAX];
	int filters;
	struct {
		struct can_frame_at frame;
		int64_t arrival_ns;
		int sent;
	} entry[SOCKET_ROOM]; /* a ring */
	unsigned first, entries;
	uint32_t not_received, not_sent; /* to be told */
	int64_t last_arrival_ns;
	uint64_t sent_seen, lost_profiles;
};

static void put(struct queue *q, const struct can_frame_at *frame, int sent)
{
	q->frame[(q->first + q->n++) % NODE_QUEUE] = (struct waiting){*frame, sent};
}

static struct waiting take(struct queue *q)
{
	const unsigned at = q->first;

	q->first = (q->first + 1) % NODE_QUEUE;
	q->n--;
	return q->frame[at];
}

/* To a driver's socket */

static bool passes(const struct tap *t, uint32_t id)
{
	if (id & CAN_WIRE_ERROR)
		return true;
	for (int i = 0; i < t->filters; i++)
		if ((id & t->filter[i].mask) == (t->filter[i].id & t->filter[i].mask))
			return true;
	return false;
}

/* Angles that are wanted late or never are those of servos. */
static int64_t late_ns(const struct link *l)
{
	const struct tap *t = l->own;
	double ms = t->bus->on[LATE] ? (t->bus->value[LATE] > 0 ? t->bus->value[LATE] : 20) : 0;

	if (l->rig->driver[l->device].role == ROLE_TILT && l->rig->tilt_late_ns > 0)
		return l->rig->tilt_late_ns;
	return (int64_t)(ms * (double)RIG_MS);
}

static bool befalls(struct bus *b, enum fault kind)
{
	return b->on[kind] && sim_random(&b->random) < (b->value[kind] > 0 ? b->value[kind] : 1.0);
}

static void hand_over(struct link *l, const struct can_frame_at *frame, int sent)
{
	struct tap *t = l->own;
	const int64_t delay_ns = l->rig->params.delay_ns ? l->rig->params.delay_ns : 300000, much_ns = late_ns(l);
	int64_t arrival_ns = l->rig->now_ns;

	if (!passes(t, frame->id) || !t->open || t->error) {
		t->lost_profiles += (uint64_t)sent;
		return;
	}
	if (t->entries == SOCKET_ROOM || (befalls(t->bus, OVERRUN) && !(frame->id & CAN_WIRE_ERROR))) {
		t->not_received++;
		t->lost_profiles += (uint64_t)sent;
		return;
	}
	if (much_ns == INT64_MAX) {
		t->lost_profiles += (uint64_t)sent;
		return;
	}
	arrival_ns += much_ns + (int64_t)((0.1 + 0.9 * sim_random(&l->random)) * (double)delay_ns);
	if (arrival_ns < t->last_arrival_ns)
		arrival_ns = t->last_arrival_ns;
	t->last_arrival_ns = arrival_ns;
	const unsigned at = (t->first + t->entries++) % SOCKET_ROOM;
	t->entry[at].frame = *frame;
	t->entry[at].arrival_ns = arrival_ns;
	t->entry[at].sent = sent;
}

/* `sent` belongs to the node that sent it. */
static void to_sockets(struct bus *b, const struct can_frame_at *frame, int sender, int sent)
{
	for (int i = 0; i < b->nodes; i++)
		hand_over(b->node[i], frame, i == sender ? sent : 0);
}

static void tell_error(struct bus *b, uint32_t classes, uint8_t controller)
{
	struct can_frame_at frame = {.id = CAN_WIRE_ERROR | classes, .len = 8, .t_ns = b->rig->now_ns};

	frame.data[1] = controller;
	to_sockets(b, &frame, -1, 0);
}

/* The bus */

static bool somebody_hears(const struct bus *b, int sender)
{
	if (sender != -1 && !b->on[BUS_OFF] && !b->on[DOWN] && !b->on[DELETED])
		return true;
	for (int i = 0; i < b->nodes && !b->on[NO_ACK]; i++)
		if (i != sender && rig_alive(b->node[i]))
			return true;
	return false;
}

static int place_of(const struct bus *b, const struct link *l)
{
	int i = 0;

	while (b->node[i] != l)
		i++;
	return i;
}

/* A number that nobody takes is overwritten by the next one: controllers of nodes have a mailbox for each. */
static void put_newest(struct tap *t, const struct can_frame_at *frame, int sent)
{
	for (unsigned i = 0; i < t->queue.n; i++) {
		struct waiting *w = &t->queue.frame[(t->queue.first + i) % NODE_QUEUE];

		if (w->frame.id != frame->id)
			continue;
		t->lost_profiles += (uint64_t)w->sent;
		*w = (struct waiting){*frame, sent};
		return;
	}
	put(&t->queue, frame, sent);
}

static void drain(struct link *l)
{
	struct tap *t = l->own;
	uint8_t bytes[CAN_WIRE_ENTRY_FD];
	struct can_frame_at frame;
	struct sim_counts counts;
	size_t n;

	while ((n = l->brain.transmit(l->brain.ctx, bytes, CAN_WIRE_ENTRY)) > 0 ||
	       (n = l->brain.transmit(l->brain.ctx, bytes, sizeof(bytes))) > 0) {
		if (can_wire_get(bytes, n, &frame) != (ssize_t)n)
			rig_give_up("a simulated node sends what is no entry");
		l->brain.counts(l->brain.ctx, &counts);
		const int sent = (int)(counts.sent - t->sent_seen);
		t->sent_seen = counts.sent;
		if (!somebody_hears(t->bus, place_of(t->bus, l)))
			put_newest(t, &frame, sent);
		else if (t->queue.n < NODE_QUEUE)
			put(&t->queue, &frame, sent);
		else
			t->lost_profiles += (uint64_t)sent;
	}
}

static void stir(struct link *l)
{
	l->brain.advance(l->brain.ctx, l->rig->now_ns);
	drain(l);
}

static int64_t duration_ns(const struct can_frame_at *f)
{
	const int head = f->id & CAN_WIRE_EXTENDED ? 67 : 47;
	const int bits = 8 * (f->id & CAN_WIRE_REMOTE ? 0 : f->len);

	/* A tenth is stuffed. */
	return (head * BIT_NS + bits * (f->flags & CAN_WIRE_FD ? BIT_DATA_NS : BIT_NS)) * 11 / 10;
}

/* Lower wins. */
static uint32_t priority(const struct can_frame_at *f)
{
	return f->id & CAN_WIRE_EXTENDED ? (f->id & 0x1fffffff) << 1 | 1 : (f->id & 0x7ff) << 19;
}

static bool host_sends(const struct bus *b)
{
	return b->host.n > 0 && !b->on[BUS_OFF] && !b->on[DOWN] && !b->on[DELETED];
}

static void say_unheard(struct bus *b, bool unheard)
{
	if (b->unheard == unheard)
		return;
	b->unheard = unheard;
	tell_error(b, CAN_WIRE_ERROR_CONTROLLER, unheard ? 0x20 : 0x40);
}

/* Whose frame is the next one: it begins now. */
static void arbitrate(struct bus *b)
{
	uint32_t best = UINT32_MAX;
	struct queue *of = NULL;

	if (host_sends(b) && !somebody_hears(b, -1)) {
		say_unheard(b, true);
	} else if (host_sends(b)) {
		of = &b->host;
		best = priority(&of->frame[of->first].frame);
		b->sender = -1;
	}
	for (int i = 0; i < b->nodes; i++) {
		struct queue *q = &((struct tap *)b->node[i]->own)->queue;

		if (q->n == 0 || !somebody_hears(b, i) || priority(&q->frame[q->first].frame) >= best)
			continue;
		best = priority(&q->frame[q->first].frame);
		of = q;
		b->sender = i;
	}
	if (of) {
		b->current = take(of);
	} else if (b->on[FLOOD]) {
		b->current = (struct waiting){.frame = can_wire_frame(0x7fe, "flooding", 8)};
		b->sender = -2;
	} else {
		return;
	}
	b->busy = true;
	b->free_ns = b->rig->now_ns + duration_ns(&b->current.frame);
	if (b->on[ERRORS])
		b->free_ns += ERROR_BITS * BIT_NS;
}

static void to_brains(struct bus *b, const struct can_frame_at *frame, int sender)
{
	uint8_t bytes[CAN_WIRE_ENTRY_FD];
	const size_t n = can_wire_put(frame, bytes);

	for (int i = 0; i < b->nodes; i++) {
		struct link *l = b->node[i];

		if (i == sender || !rig_alive(l))
			continue;
		l->brain.receive(l->brain.ctx, bytes, n, b->rig->now_ns);
		stir(l);
	}
}

static void make_fd(struct can_frame_at *frame)
{
	frame->flags |= CAN_WIRE_FD;
	memset(frame->data + frame->len, 0x55, sizeof(frame->data) - frame->len);
	frame->len = 64;
}

/* Frames of the same number that are none of the driver's. */
static void send_twin(struct bus *b, const struct can_frame_at *frame)
{
	struct can_frame_at twin = *frame;

	if (b->on[RTR]) {
		twin.id |= CAN_WIRE_REMOTE;
		memset(twin.data, 0, sizeof(twin.data));
	} else if (b->on[EXTENDED]) {
		twin.id |= CAN_WIRE_EXTENDED;
		for (int i = 0; i < twin.len; i++)
			twin.data[i] ^= 0x55;
	} else if (b->on[FD]) {
		make_fd(&twin);
	} else {
		return;
	}
	to_sockets(b, &twin, -2, 0);
}

static void end_frame(struct bus *b)
{
	struct can_frame_at frame = b->current.frame;
	const int sender = b->sender;
	const bool deaf = b->on[BUS_OFF] || b->on[DOWN] || b->on[DELETED];

	b->busy = false;
	frame.t_ns = b->rig->now_ns;
	if (b->on[AS_FD] && sender >= 0)
		make_fd(&frame);
	if (befalls(b, DROP)) {
		if (sender >= 0)
			((struct tap *)b->node[sender]->own)->lost_profiles += (uint64_t)b->current.sent;
		return;
	}
	if (deaf && sender >= 0)
		((struct tap *)b->node[sender]->own)->lost_profiles += (uint64_t)b->current.sent;
	if (!deaf)
		to_sockets(b, &frame, sender, b->current.sent);
	if (sender == -1) {
		uint8_t bytes[CAN_WIRE_ENTRY_FD];
		const size_t n = can_wire_put(&frame, bytes);

		say_unheard(b, false);
		for (int i = 0; i < b->nodes; i++)
			rig_note_request(b->node[i], bytes, n);
	}
	to_brains(b, &frame, sender);
	if (sender >= 0 && !deaf)
		send_twin(b, &frame);
}

static void serve_bus(struct bus *b)
{
	for (int i = 0; i < b->nodes; i++)
		if (b->node[i]->brain.deadline(b->node[i]->brain.ctx) <= b->rig->now_ns)
			stir(b->node[i]);
	if (b->busy && b->free_ns <= b->rig->now_ns)
		end_frame(b);
	if (!b->busy)
		arbitrate(b);
}

/* In the place of drivers/can_link.c */

static const struct bus *bus_of(const struct link *l)
{
	return ((const struct tap *)l->own)->bus;
}

struct link *can_link_open(const char *connect, const struct can_link_filter *filters, int n, char error[160])
{
	struct link *l = NULL;
	struct tap *t;

	/* Whose it is the text's own place tells. */
	for (int i = 0; i < the_rig->config.devices && !l; i++)
		if (the_rig->link[i].carrier == &rig_can && the_rig->config.device[i].connect == connect)
			l = &the_rig->link[i];
	if (!l)
		rig_give_up("an interface is opened that no device is attached to");
	t = l->own;
	if (t->bus->on[DELETED] || t->bus->on[DOWN]) {
		can_words_opening(t->bus->name, t->bus->on[DELETED] ? ENODEV : ENETDOWN, error);
		return NULL;
	}
	memcpy(t->filter, filters, (size_t)n * sizeof(*filters));
	t->filters = n;
	t->open = true;
	t->error = 0;
	t->first = t->entries = 0;
	t->not_received = t->not_sent = 0;
	return l;
}

int can_link_fd(const struct link *l)
{
	return RIG_DUMMY_FD + l->device;
}

static struct can_frame_at take_loss(struct tap *t, int64_t t_ns)
{
	struct can_frame_at frame = {.id = CAN_WIRE_LOST, .len = 8, .t_ns = t_ns};

	for (int i = 0; i < 4; i++) {
		frame.data[i] = (uint8_t)(t->not_received >> (8 * i));
		frame.data[4 + i] = (uint8_t)(t->not_sent >> (8 * i));
	}
	t->not_received = t->not_sent = 0;
	return frame;
}

ssize_t can_link_read(struct link *l, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	struct tap *t = l->own;
	size_t n = 0;

	if (t->error)
		return -t->error;
	if (t->not_received > 0 || t->not_sent > 0) {
		const struct can_frame_at loss = take_loss(t, *t_ns);

		n = can_wire_put(&loss, buf);
	}
	while (t->entries > 0 && t->entry[t->first].arrival_ns <= l->rig->now_ns && cap - n >= CAN_WIRE_ENTRY_FD) {
		n += can_wire_put(&t->entry[t->first].frame, buf + n);
		*t_ns = t->entry[t->first].frame.t_ns;
		t->first = (t->first + 1) % SOCKET_ROOM;
		t->entries--;
	}
	return (ssize_t)n;
}

ssize_t can_link_write(struct link *l, const uint8_t *bytes, size_t len)
{
	struct tap *t = l->own;
	struct bus *b = t->bus;
	struct can_frame_at frame;
	ssize_t n;

	if (t->error)
		return -t->error;
	for (size_t at = 0; at < len; at += (size_t)n) {
		n = can_wire_get(bytes + at, len - at, &frame);
		if (n <= 0)
			return -EINVAL;
		if (b->host.n < HOST_QUEUE && !b->on[FULL])
			put(&b->host, &frame, 0);
		else
			t->not_sent++;
	}
	serve_bus(b);
	return (ssize_t)len;
}

void can_link_error(const struct link *l, int error, char ret[160])
{
	can_words_end(bus_of(l)->name, error, ret);
}

void can_link_note(const struct link *l, char ret[160])
{
	(void)l;
	ret[0] = 0;
}

void can_link_close(struct link *l)
{
	struct tap *t = l->own;

	while (t->entries > 0) {
		t->lost_profiles += (uint64_t)t->entry[t->first].sent;
		t->first = (t->first + 1) % SOCKET_ROOM;
		t->entries--;
	}
	t->open = false;
	t->error = 0;
}

/* The carrier */

static struct bus *find_bus(struct rig *r, const char *name)
{
	struct bus *b;

	for (int i = 0; i < r->config.devices; i++)
		if (r->link[i].carrier == &rig_can && r->link[i].own && strcmp(bus_of(&r->link[i])->name, name) == 0)
			return ((struct tap *)r->link[i].own)->bus;
	b = calloc(1, sizeof(*b));
	if (!b)
		rig_give_up("out of memory");
	b->rig = r;
	b->name = name;
	b->random = sim_mix(r->params.seed + 77);
	return b;
}

static void attach(struct link *l)
{
	struct tap *t = calloc(1, sizeof(*t));

	if (!t)
		rig_give_up("out of memory");
	t->bus = find_bus(l->rig, l->rig->config.device[l->device].connect);
	t->bus->node[t->bus->nodes++] = l;
	l->own = t;
}

static void detach(struct link *l)
{
	struct tap *t = l->own;

	if (--t->bus->nodes == 0)
		free(t->bus);
	free(t);
}

static int64_t due(const struct link *l)
{
	const struct tap *t = l->own;
	const struct bus *b = t->bus;
	int64_t next_ns = l->brain.deadline(l->brain.ctx);

	if (b->busy)
		next_ns = rig_earlier(next_ns, b->free_ns);
	else if (b->on[FLOOD])
		next_ns = l->rig->now_ns;
	if (l->readable && t->entries > 0)
		next_ns = rig_earlier(next_ns, t->entry[t->first].arrival_ns);
	if (l->readable && (t->error || t->not_received || t->not_sent))
		next_ns = l->rig->now_ns;
	return next_ns;
}

static void serve(struct link *l)
{
	struct tap *t = l->own;

	serve_bus(t->bus);
}

static bool readable(const struct link *l)
{
	const struct tap *t = l->own;

	return t->error || t->not_received || t->not_sent ||
	       (t->entries > 0 && t->entry[t->first].arrival_ns <= l->rig->now_ns);
}

static bool writable(const struct link *l)
{
	(void)l;
	return true;
}

static void break_sockets(struct bus *b, int error)
{
	b->host.n = 0;
	for (int i = 0; i < b->nodes; i++) {
		struct tap *t = b->node[i]->own;

		if (t->open)
			t->error = error;
	}
}

static bool fault(struct link *l, const struct sim_fault *what, bool on)
{
	struct bus *b = ((struct tap *)l->own)->bus;
	const int kind = sim_fault_index(fault_names, what->kind);
	const bool once = what->for_ns == 0;

	if (kind < 0)
		return false;
	b->on[kind] = on && !once;
	b->value[kind] = what->value;
	switch (kind) {
	case BUS_OFF:
		tell_error(b, on ? CAN_WIRE_ERROR_BUS_OFF : CAN_WIRE_ERROR_RESTARTED, 0);
		break;
	case WARNING:
	case PASSIVE:
		tell_error(b, CAN_WIRE_ERROR_CONTROLLER, !on ? 0x40 : kind == WARNING ? 0x0c : 0x30);
		break;
	case DOWN:
	case DELETED:
		if (on)
			break_sockets(b, kind == DOWN ? ENETDOWN : ENODEV);
		break;
	default:
		break;
	}
	return true;
}

static uint64_t lost_profiles(const struct link *l)
{
	const struct tap *t = l->own;
	uint64_t lost = t->lost_profiles;

	for (unsigned i = 0; i < t->entries; i++)
		lost += (uint64_t)t->entry[(t->first + i) % SOCKET_ROOM].sent;
	for (unsigned i = 0; i < t->queue.n; i++)
		lost += (uint64_t)t->queue.frame[(t->queue.first + i) % NODE_QUEUE].sent;
	return lost + (t->bus->busy && t->bus->sender >= 0 && t->bus->node[t->bus->sender] == l
	                   ? (uint64_t)t->bus->current.sent
	                   : 0);
}

const struct rig_carrier rig_can = {attach, detach, due, serve, stir, readable, writable, fault, lost_profiles};

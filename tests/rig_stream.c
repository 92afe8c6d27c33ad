/* The carrier of bytes in order: serial lines, TCP, USB. Pieces that leave a device arrive later, by a delay drawn for
 * each, never one before its forerunner; the link at the end does to them what transports do. What is lost on the way is
 * counted by telegrams with a profile. */
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "tests/rig_parts.h"

#define CONNECT_NS    (RIG_MS / 2)
#define SYN_AGAIN_NS  RIG_SECOND  /* a connection that hangs is asked for again after 1 s, then 3 s */
#define WIRE_BYTES    (256 << 10) /* more waits in the device */
#define PIECES        8192
#define CONTIGUOUS_NS (20 * RIG_MS)

enum fault { UNPLUG, REFUSE, HANG, RESET, HALF_OPEN, BYTEWISE, HOLD, SLOW_WRITES, NO_BAUD, FAULTS };
static const char *const fault_names[] = {"unplug",   "refuse", "hang",        "reset",   "half-open",
                                          "bytewise", "hold",   "slow writes", "no baud", NULL};

struct piece {
	int64_t left_ns, arrival_ns;
	size_t len, read;
	int ends;     /* of telegrams with a profile, and of garbage */
	int profiles; /* those of them that left right */
};

struct stream {
	struct link *link;
	enum { CLOSED, CONNECTING, OPEN, DEAD } state;
	int error;                      /* of DEAD */
	int64_t connect_ns, connect_at; /* begun; to be looked at again */
	bool dumb;                      /* half open until it is closed */
	bool on[FAULTS];
	double value[FAULTS];
	int64_t write_ns;           /* slow writes: not before */
	struct piece piece[PIECES]; /* a ring */
	unsigned first, pieces;
	uint8_t bytes[WIRE_BYTES]; /* those of the pieces, a ring */
	size_t begin, len;
	int64_t last_arrival_ns;
	int64_t torn_ns; /* the beginning of the telegram that leaves now was lost then; -1: it was not */
	int64_t cut_ns;  /* likewise of the one that is read now */
	uint64_t sent_seen, ends_seen;
	uint64_t lost_profiles;
};

static struct piece *piece_at(struct stream *s, unsigned i)
{
	return &s->piece[(s->first + i) % PIECES];
}

static void forget_piece(struct stream *s)
{
	s->first = (s->first + 1) % PIECES;
	s->pieces--;
}

static void copy_out(const struct stream *s, uint8_t *ret, size_t n)
{
	size_t one = WIRE_BYTES - s->begin < n ? WIRE_BYTES - s->begin : n;

	memcpy(ret, s->bytes + s->begin, one);
	memcpy(ret + one, s->bytes, n - one);
}

static void copy_in(struct stream *s, const uint8_t *bytes, size_t n)
{
	size_t at = (s->begin + s->len) % WIRE_BYTES, one = WIRE_BYTES - at < n ? WIRE_BYTES - at : n;

	memcpy(s->bytes + at, bytes, one);
	memcpy(s->bytes, bytes + one, n - one);
	s->len += n;
}

/* What is lost between the device and its reader is counted by telegrams with a profile: where the end of one passes,
 * but its beginning was lost less than CONTIGUOUS_NS before, it is lost too. */
static bool is_rest(int64_t lost_ns, int64_t t_ns)
{
	return lost_ns >= 0 && t_ns - lost_ns <= CONTIGUOUS_NS;
}

static void lose_pieces(struct stream *s, unsigned n)
{
	for (unsigned i = 0; i < n; i++) {
		const struct piece *piece = piece_at(s, 0);
		size_t left = piece->len - piece->read;

		s->lost_profiles += (uint64_t)piece->profiles;
		s->cut_ns = piece->ends > 0 ? -1 : piece->left_ns;
		s->begin = (s->begin + left) % WIRE_BYTES;
		s->len -= left;
		forget_piece(s);
	}
}

static int64_t draw_arrival(struct stream *s)
{
	int64_t delay_ns = s->link->rig->params.delay_ns ? s->link->rig->params.delay_ns : 300000;
	int64_t arrival_ns =
	    s->link->rig->now_ns + (int64_t)((0.1 + 0.9 * sim_random(&s->link->random)) * (double)delay_ns);

	if (s->on[HOLD]) {
		int64_t hold_ns = (int64_t)((s->value[HOLD] > 0 ? s->value[HOLD] : 100) * (double)RIG_MS);

		arrival_ns += hold_ns - (arrival_ns - RIG_EPOCH_NS) % hold_ns;
	}
	if (arrival_ns < s->last_arrival_ns)
		arrival_ns = s->last_arrival_ns;
	return s->last_arrival_ns = arrival_ns;
}

static void carry(struct stream *s, const uint8_t *bytes, size_t n, int ends, int profiles)
{
	int64_t now_ns = s->link->rig->now_ns;
	bool rest = is_rest(s->torn_ns, now_ns);

	if (s->state != OPEN || s->dumb) {
		s->lost_profiles += (uint64_t)profiles;
		s->torn_ns = ends > 0 ? -1 : now_ns;
		return;
	}
	s->torn_ns = rest && ends == 0 ? now_ns : -1;
	if (rest && ends > 0 && profiles == ends) {
		s->lost_profiles++;
		profiles--;
	}
	copy_in(s, bytes, n);
	*piece_at(s, s->pieces++) = (struct piece){
	    .left_ns = now_ns, .arrival_ns = draw_arrival(s), .len = n, .ends = ends, .profiles = profiles};
}

/* What has left the device goes onto the wire. */
static void drain(struct stream *s)
{
	uint8_t bytes[SIM_TRANSFER_MAX];

	while (s->pieces < PIECES && WIRE_BYTES - s->len >= sizeof(bytes)) {
		size_t n = s->link->brain.transmit(s->link->brain.ctx, bytes, sizeof(bytes));
		struct sim_counts counts;

		if (n == 0)
			return;
		s->link->brain.counts(s->link->brain.ctx, &counts);
		/* Garbage ends whatever was begun. */
		carry(s, bytes, n, (int)(counts.sent + counts.corrupted + counts.garbage - s->ends_seen),
		      (int)(counts.sent - s->sent_seen));
		s->sent_seen = counts.sent;
		s->ends_seen = counts.sent + counts.corrupted + counts.garbage;
	}
}

static void stir(struct stream *s)
{
	s->link->brain.advance(s->link->brain.ctx, s->link->rig->now_ns);
	drain(s);
}

/* The virtual link */

static void say_connected(struct stream *s, bool yes)
{
	if (s->link->brain.connected)
		s->link->brain.connected(s->link->brain.ctx, yes, s->link->rig->now_ns);
	stir(s);
}

static void break_link(struct stream *s, int error)
{
	if (s->state == CLOSED || s->state == DEAD)
		return;
	if (s->state == OPEN)
		say_connected(s, false);
	lose_pieces(s, s->pieces);
	s->state = DEAD;
	s->error = error;
}

static void begin_connecting(struct stream *s)
{
	s->state = CONNECTING;
	s->connect_ns = s->link->rig->now_ns;
	s->connect_at = s->link->rig->now_ns + CONNECT_NS;
}

static void connect_now(struct stream *s)
{
	if (s->on[UNPLUG] || s->on[HANG] || !rig_alive(s->link)) {
		int64_t since_ns = s->link->rig->now_ns - s->connect_ns;

		s->connect_at = s->connect_ns + (since_ns < SYN_AGAIN_NS ? 1 : 3) * SYN_AGAIN_NS + CONNECT_NS;
	} else if (s->on[REFUSE]) {
		s->state = DEAD;
		s->error = ECONNREFUSED;
	} else {
		s->state = OPEN;
		say_connected(s, true);
	}
}

struct link *rig_stream_open(const struct config_device *device, char error[160])
{
	struct link *l = rig_link_of(device);
	struct stream *s = l->own;

	if (l->transport != RIG_TCP && (s->on[UNPLUG] || !rig_alive(l))) {
		snprintf(error, 160, "%.100s: there is no such device; plug it in, or correct `%s`",
		         l->transport == RIG_SERIAL ? device->port : device->connect,
		         l->transport == RIG_SERIAL ? "port" : "connect");
		return NULL;
	}
	s->dumb = false;
	s->first = s->pieces = 0;
	s->begin = s->len = 0;
	s->write_ns = 0;
	s->cut_ns = -1;
	if (l->transport == RIG_TCP) {
		begin_connecting(s);
	} else {
		s->state = OPEN;
		say_connected(s, true);
	}
	return l;
}

int rig_stream_fd(const struct link *l)
{
	return RIG_DUMMY_FD + l->device;
}

/* What has arrived, as much as there is room for: a stream has no pieces. */
ssize_t rig_stream_read(struct link *l, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	struct stream *s = l->own;
	size_t n = 0;

	(void)t_ns;
	if (s->state == DEAD)
		return -s->error;
	if (s->on[BYTEWISE])
		cap = 1;
	while (s->pieces > 0 && n < cap && piece_at(s, 0)->arrival_ns <= l->rig->now_ns) {
		struct piece *piece = piece_at(s, 0);
		size_t left = piece->len - piece->read, take = left < cap - n ? left : cap - n;

		copy_out(s, buf + n, take);
		s->begin = (s->begin + take) % WIRE_BYTES;
		s->len -= take;
		piece->read += take;
		n += take;
		if (piece->read == piece->len) {
			bool rest = is_rest(s->cut_ns, piece->left_ns);

			s->lost_profiles += rest && piece->ends > 0 && piece->profiles == piece->ends;
			s->cut_ns = rest && piece->ends == 0 ? piece->left_ns : -1;
			forget_piece(s);
		}
	}
	return (ssize_t)n;
}

ssize_t rig_stream_write(struct link *l, const uint8_t *bytes, size_t len)
{
	struct stream *s = l->own;
	struct rig *r = l->rig;

	if (s->state == DEAD)
		return -s->error;
	if (s->state == CONNECTING || r->now_ns < s->write_ns)
		return 0;
	if (s->on[SLOW_WRITES]) {
		len = 1;
		s->write_ns = r->now_ns + RIG_MS;
	}
	if (s->dumb)
		return (ssize_t)len;
	rig_note_request(l, bytes, len);
	l->brain.receive(l->brain.ctx, bytes, len, r->now_ns);
	stir(s);
	return (ssize_t)len;
}

int rig_stream_baud(struct link *l, uint32_t baud, char error[160])
{
	struct stream *s = l->own;

	if (s->on[NO_BAUD] && (s->value[NO_BAUD] <= 0 || (uint32_t)s->value[NO_BAUD] == baud)) {
		snprintf(error, 160, "%.80s does not do %u Bd; set `baud` to a rate that the adapter knows",
		         l->rig->config.device[l->device].port, (unsigned)baud);
		return -EINVAL;
	}
	if (l->brain.host_baud)
		l->brain.host_baud(l->brain.ctx, baud);
	return 0;
}

/* Only what has arrived: the rest is on its way. */
void rig_stream_flush(struct link *l)
{
	struct stream *s = l->own;
	unsigned arrived = 0;

	while (arrived < s->pieces && piece_at(s, arrived)->arrival_ns <= l->rig->now_ns)
		arrived++;
	lose_pieces(s, arrived);
}

void rig_stream_close(struct link *l)
{
	struct stream *s = l->own;

	if (s->state == OPEN)
		say_connected(s, false);
	lose_pieces(s, s->pieces);
	s->state = CLOSED;
}

/* The carrier */

static void attach(struct link *l)
{
	struct stream *s = calloc(1, sizeof(*s));

	if (!s)
		rig_give_up("out of memory");
	s->link = l;
	s->torn_ns = s->cut_ns = -1;
	l->own = s;
}

static void detach(struct link *l)
{
	free(l->own);
}

static int64_t due(const struct link *l)
{
	const struct stream *s = l->own;
	int64_t next_ns = l->brain.deadline(l->brain.ctx);

	if (s->pieces == PIECES || WIRE_BYTES - s->len < SIM_TRANSFER_MAX)
		next_ns = INT64_MAX; /* the wire is full: it waits for its reader */
	if (s->state == CONNECTING)
		next_ns = rig_earlier(next_ns, s->connect_at);
	if (l->readable && s->pieces > 0)
		next_ns = rig_earlier(next_ns, s->piece[s->first].arrival_ns);
	if (l->readable && s->state == DEAD)
		next_ns = l->rig->now_ns;
	if (l->writable && s->state == OPEN)
		next_ns = rig_earlier(next_ns, s->write_ns);
	return next_ns;
}

/* Nobody hears of it where the power goes: a connection is half open then, a USB device gone. */
static void see_power(struct stream *s)
{
	if (s->state != OPEN || rig_alive(s->link))
		return;
	if (s->link->transport == RIG_TCP)
		s->dumb = true;
	else
		break_link(s, ENODEV);
}

static void serve(struct link *l)
{
	struct stream *s = l->own;

	if (s->state == CONNECTING && s->connect_at <= l->rig->now_ns)
		connect_now(s);
	if (l->brain.deadline(l->brain.ctx) <= l->rig->now_ns)
		stir(s);
	see_power(s);
}

static void stir_link(struct link *l)
{
	stir(l->own);
}

static bool readable(const struct link *l)
{
	struct stream *s = l->own;

	return s->state == DEAD || (s->pieces > 0 && piece_at(s, 0)->arrival_ns <= l->rig->now_ns);
}

static bool writable(const struct link *l)
{
	const struct stream *s = l->own;

	return s->state == DEAD || (s->state == OPEN && s->write_ns <= l->rig->now_ns);
}

static void befall(struct stream *s, enum fault kind)
{
	const enum rig_transport transport = s->link->transport;

	switch (kind) {
	case UNPLUG:
		if (transport == RIG_TCP)
			s->dumb = true;
		else
			break_link(s, transport == RIG_SERIAL ? EIO : ENODEV);
		break;
	case REFUSE:
	case HANG:
	case RESET:
		break_link(s, transport == RIG_TCP ? ECONNRESET : EIO);
		break;
	case HALF_OPEN:
		s->dumb = true;
		break;
	default:
		break;
	}
	if (s->dumb)
		lose_pieces(s, s->pieces);
}

static bool fault(struct link *l, const struct sim_fault *what, bool on)
{
	struct stream *s = l->own;
	const int kind = sim_fault_index(fault_names, what->kind);

	if (kind < 0)
		return false;
	s->on[kind] = on && kind != RESET && kind != HALF_OPEN;
	s->value[kind] = what->value;
	if (on && s->state != CLOSED)
		befall(s, (enum fault)kind);
	return true;
}

static uint64_t lost_profiles(const struct link *l)
{
	struct stream *s = l->own;
	uint64_t lost = s->lost_profiles;

	for (unsigned k = 0; k < s->pieces; k++)
		lost += (uint64_t)piece_at(s, k)->profiles;
	return lost;
}

const struct rig_carrier rig_stream = {attach, detach, due, serve, stir_link, readable, writable, fault, lost_profiles};

/* pcap:   magic a1b2c3d4 (us) or a1b23c4d (ns), u16 version 2.4, 8 bytes, u32 snap length, u32 link type
 *         { u32 s, u32 us|ns, u32 captured, u32 on the wire, bytes } ...           all in the writer's byte order
 * pcapng: { u32 type, u32 length, body, u32 length } ...; 0A0D0D0A a section (1A2B3C4D tells its byte order), 1 an
 *         interface (u16 link, u16 0, u32 snap, options: 9 resolution, 14 offset), 6 a packet (u32 interface, u32 time high,
 *         u32 low, u32 captured, u32 on the wire, bytes), 2 the same of older writers; what else there is is passed over.
 *
 * Sequence numbers wrap; all comparisons are by the sign of their 32-bit difference. */
#include "core/pcap.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define BLOCK_MAX  (64u << 20)
#define PACKET_MAX (1u << 20)
#define TIME_MAX   INT64_C(4000000000) /* s */

enum { SECTION = 0x0A0D0D0A, INTERFACE = 1, OLD_PACKET = 2, PACKET = 6 };
enum {
	LINK_NULL = 0,
	LINK_ETHERNET = 1,
	LINK_RAW = 101,
	LINK_LOOP = 108,
	LINK_COOKED = 113,
	LINK_IPV4 = 228,
	LINK_IPV6 = 229,
	LINK_COOKED2 = 276
};

static uint32_t load32(const uint8_t *p, bool swapped)
{
	return swapped ? (uint32_t)p[0] << 24 | (uint32_t)p[1] << 16 | (uint32_t)p[2] << 8 | p[3]
	               : (uint32_t)p[3] << 24 | (uint32_t)p[2] << 16 | (uint32_t)p[1] << 8 | p[0];
}

static uint16_t load16(const uint8_t *p, bool swapped)
{
	return (uint16_t)(swapped ? p[0] << 8 | p[1] : p[1] << 8 | p[0]);
}

/* Network order. */
static uint16_t net16(const uint8_t *p)
{
	return load16(p, true);
}

static uint32_t net32(const uint8_t *p)
{
	return load32(p, true);
}

/* `swapped` means big-endian here: everything is read as little-endian otherwise. */
static bool classic(const uint8_t *data, bool *ret_swapped, bool *ret_ns)
{
	for (int swapped = 0; swapped < 2; swapped++) {
		const uint32_t magic = load32(data, swapped);

		if (magic != 0xa1b2c3d4 && magic != 0xa1b23c4d)
			continue;
		*ret_swapped = swapped;
		*ret_ns = magic == 0xa1b23c4d;
		return true;
	}
	return false;
}

bool pcap_is(const uint8_t *data, size_t len)
{
	bool swapped, ns;

	return len >= 12 && (classic(data, &swapped, &ns) || load32(data, false) == SECTION);
}

int pcap_open(struct pcap *p, const uint8_t *data, size_t len, char error[PCAP_SENTENCE_MAX])
{
	memset(p, 0, sizeof *p);
	p->data = data;
	p->len = len;
	if (!pcap_is(data, len)) {
		snprintf(error, PCAP_SENTENCE_MAX, "is no capture (pcap, pcapng)");
		return -EINVAL;
	}
	if (!classic(data, &p->swapped, &p->nanoseconds)) {
		p->ng = true;
		return 0;
	}
	if (len < 24) {
		snprintf(error, PCAP_SENTENCE_MAX, "is cut within its head");
		return -EINVAL;
	}
	p->link = load32(data + 20, p->swapped) & 0xffff;
	p->at = 24;
	return 0;
}

static int classic_next(struct pcap *p, struct pcap_packet *ret)
{
	const uint8_t *head = p->data + p->at;
	uint32_t s, part, len;

	if (p->len - p->at < 16)
		return 0;
	s = load32(head, p->swapped);
	part = load32(head + 4, p->swapped);
	len = load32(head + 8, p->swapped);
	if (len > PACKET_MAX || part >= 1000000000 || s > TIME_MAX)
		return -EINVAL;
	if (p->len - p->at - 16 < len)
		return 0;
	*ret = (struct pcap_packet){.t_ns = (int64_t)s * 1000000000 + (int64_t)part * (p->nanoseconds ? 1 : 1000),
	                            .link = p->link,
	                            .data = head + 16,
	                            .len = len,
	                            .cut = load32(head + 12, p->swapped) > len};
	p->at += 16 + len;
	return 1;
}

/* Time in units of the interface -> ns; false: of another age. */
static bool time_of(const struct pcap *p, uint32_t interface, uint64_t units, int64_t *ret_ns)
{
	const uint8_t resolution = p->interface[interface].resolution;
	uint64_t per_s = 1, s;
	double rest;

	if (resolution & 0x80) {
		if ((resolution & 0x7f) > 40)
			return false;
		per_s <<= resolution & 0x7f;
	} else {
		if (resolution > 12)
			return false;
		for (int i = 0; i < resolution; i++)
			per_s *= 10;
	}
	s = units / per_s;
	if (s > (uint64_t)TIME_MAX || p->interface[interface].offset_s < -TIME_MAX ||
	    p->interface[interface].offset_s > TIME_MAX)
		return false;
	if (per_s <= 1000000000 && 1000000000 % per_s == 0) {
		*ret_ns = (int64_t)((units % per_s) * (1000000000 / per_s));
	} else {
		rest = (double)(units % per_s) * (1e9 / (double)per_s);
		*ret_ns = (int64_t)rest;
	}
	*ret_ns += ((int64_t)s + p->interface[interface].offset_s) * 1000000000;
	return true;
}

static void add_interface(struct pcap *p, const uint8_t *body, size_t len)
{
	const int i = p->interfaces;

	if (len < 8 || i == PCAP_INTERFACES_MAX)
		return;
	p->interface[i].link = load16(body, p->swapped);
	p->interface[i].resolution = 6;
	p->interface[i].offset_s = 0;
	for (size_t at = 8; at + 4 <= len;) {
		const uint16_t code = load16(body + at, p->swapped), n = load16(body + at + 2, p->swapped);

		if (code == 0 || at + 4 + n > len)
			break;
		if (code == 9 && n == 1)
			p->interface[i].resolution = body[at + 4];
		if (code == 14 && n == 8) {
			const uint64_t a = load32(body + at + 4, p->swapped), b = load32(body + at + 8, p->swapped);

			p->interface[i].offset_s = (int64_t)(p->swapped ? a << 32 | b : b << 32 | a);
		}
		at += 4 + ((size_t)n + 3) / 4 * 4;
	}
	p->interfaces++;
}

/* A packet block's body; false: left out. */
static bool packet_of(struct pcap *p, uint32_t type, const uint8_t *body, size_t len, struct pcap_packet *ret)
{
	uint32_t interface, captured;
	int64_t t_ns;

	if (len < 20)
		return false;
	interface = type == PACKET ? load32(body, p->swapped) : load16(body, p->swapped);
	captured = load32(body + 12, p->swapped);
	if (interface >= (uint32_t)p->interfaces || captured > len - 20 || captured > PACKET_MAX)
		return false;
	if (!time_of(p, interface, (uint64_t)load32(body + 4, p->swapped) << 32 | load32(body + 8, p->swapped), &t_ns))
		return false;
	*ret = (struct pcap_packet){.t_ns = t_ns,
	                            .link = p->interface[interface].link,
	                            .data = body + 20,
	                            .len = captured,
	                            .cut = load32(body + 16, p->swapped) > captured};
	return true;
}

static int ng_next(struct pcap *p, struct pcap_packet *ret)
{
	while (p->len - p->at >= 12) {
		const uint8_t *block = p->data + p->at;
		uint32_t type = load32(block, p->swapped), len;

		if (load32(block, false) == SECTION) { /* the same in both orders */
			const uint32_t magic = load32(block + 8, false);

			if (magic != 0x1A2B3C4D && magic != 0x4D3C2B1A)
				return -EINVAL;
			p->swapped = magic == 0x4D3C2B1A;
			p->interfaces = 0;
			type = SECTION;
		}
		len = load32(block + 4, p->swapped);
		if (len < 12 || len > BLOCK_MAX || len % 4)
			return -EINVAL;
		if (len > p->len - p->at)
			return 0;
		p->at += len;
		if (type == INTERFACE)
			add_interface(p, block + 8, len - 12);
		else if ((type == PACKET || type == OLD_PACKET) && packet_of(p, type, block + 8, len - 12, ret))
			return 1;
	}
	return 0;
}

int pcap_next(struct pcap *p, struct pcap_packet *ret)
{
	return p->ng ? ng_next(p, ret) : classic_next(p, ret);
}

/* Packets */

/* Where the IP packet begins; -1: there is none. */
static int ethernet(const uint8_t *d, size_t len)
{
	size_t at = 12;

	while (at + 4 <= len && (net16(d + at) == 0x8100 || net16(d + at) == 0x88a8))
		at += 4;
	return at + 2 <= len && (net16(d + at) == 0x0800 || net16(d + at) == 0x86dd) ? (int)at + 2 : -1;
}

static int cooked(const uint8_t *d, size_t len, size_t type_at, size_t head)
{
	return len >= head && (net16(d + type_at) == 0x0800 || net16(d + type_at) == 0x86dd) ? (int)head : -1;
}

static int ip_at(const struct pcap_packet *packet)
{
	switch (packet->link) {
	case LINK_ETHERNET:
		return ethernet(packet->data, packet->len);
	case LINK_COOKED:
		return cooked(packet->data, packet->len, 14, 16);
	case LINK_COOKED2:
		return cooked(packet->data, packet->len, 0, 20);
	case LINK_NULL:
	case LINK_LOOP:
		return 4;
	case LINK_RAW:
	case LINK_IPV4:
	case LINK_IPV6:
		return 0;
	default:
		return -1;
	}
}

static bool tcp(const uint8_t *d, size_t len, struct pcap_segment *ret)
{
	size_t head;

	if (len < 20)
		return false;
	head = (size_t)(d[12] >> 4) * 4;
	if (head < 20 || head > len)
		return false;
	ret->from.port = net16(d);
	ret->to.port = net16(d + 2);
	ret->sequence = net32(d + 4);
	ret->flags = d[13];
	ret->data = d + head;
	ret->len = len - head;
	return true;
}

/* What lies behind the packet's own length is padding. A length of 0 is a packet that the card was to cut (offloading). */
static bool ip4(const uint8_t *d, size_t len, struct pcap_segment *ret)
{
	size_t head, total;

	if (len < 20)
		return false;
	head = (size_t)(d[0] & 15) * 4;
	total = net16(d + 2) ? net16(d + 2) : len;
	if (head < 20 || total < head || total > len || d[9] != 6 || (net16(d + 6) & 0x3fff))
		return false;
	memcpy(ret->from.bytes, d + 12, 4);
	memcpy(ret->to.bytes, d + 16, 4);
	return tcp(d + head, total - head, ret);
}

static bool ip6(const uint8_t *d, size_t len, struct pcap_segment *ret)
{
	size_t at = 40, total;
	uint8_t next;

	if (len < 40)
		return false;
	total = net16(d + 4) ? 40 + (size_t)net16(d + 4) : len;
	next = d[6];
	if (total > len)
		return false;
	while ((next == 0 || next == 43 || next == 60) && at + 8 <= total) { /* options and routes */
		next = d[at];
		at += 8 + (size_t)d[at + 1] * 8;
	}
	if (next != 6 || at > total)
		return false;
	ret->from.six = ret->to.six = true;
	memcpy(ret->from.bytes, d + 8, 16);
	memcpy(ret->to.bytes, d + 24, 16);
	return tcp(d + at, total - at, ret);
}

bool pcap_segment(const struct pcap_packet *packet, struct pcap_segment *ret)
{
	const int at = ip_at(packet);
	struct pcap_segment found = {.sequence = 0};
	const uint8_t *d = packet->data + at;
	bool good;

	if (at < 0 || (size_t)at >= packet->len || packet->cut)
		return false;
	good = *d >> 4 == 4 ? ip4(d, packet->len - (size_t)at, &found)
	                    : *d >> 4 == 6 && ip6(d, packet->len - (size_t)at, &found);
	if (good)
		*ret = found;
	return good;
}

/* Flows */

struct piece {
	uint32_t sequence;
	uint8_t *data;
	size_t len;
};

struct pcap_flow {
	bool begun, gap; /* gap: what comes next has nothing before it */
	uint32_t next;
	struct piece piece[PCAP_FLOW_HELD]; /* by sequence */
	int pieces;
	size_t bytes;
	uint8_t *out; /* what was taken last */
	uint64_t gaps;
};

struct pcap_flow *pcap_flow_create(void)
{
	return calloc(1, sizeof(struct pcap_flow));
}

void pcap_flow_reset(struct pcap_flow *f)
{
	for (int i = 0; i < f->pieces; i++)
		free(f->piece[i].data);
	free(f->out);
	f->out = NULL;
	f->pieces = 0;
	f->bytes = 0;
	f->begun = f->gap = false;
}

void pcap_flow_destroy(struct pcap_flow *f)
{
	if (!f)
		return;
	pcap_flow_reset(f);
	free(f);
}

static bool is_before(uint32_t a, uint32_t b)
{
	return (int32_t)(a - b) < 0;
}

int pcap_flow_put(struct pcap_flow *f, const struct pcap_segment *segment)
{
	uint32_t sequence = segment->sequence + (segment->flags & PCAP_SYN ? 1 : 0);
	size_t len = segment->len;
	struct piece piece;
	int at;

	if (segment->flags & PCAP_SYN) { /* another connection, or the same word said twice */
		if (f->begun && f->next != sequence)
			pcap_flow_reset(f);
	}
	if (!f->begun) {
		f->begun = true;
		f->next = sequence;
	}
	/* Wholly known: a retransmission. So is a byte or none: what keeps a connection alive repeats the last one. */
	if (len == 0 || !is_before(f->next, sequence + (uint32_t)len))
		return 0;
	if (f->pieces == PCAP_FLOW_HELD)
		return 0; /* lost: pcap_flow_take was to be called */
	piece = (struct piece){sequence, malloc(len), len};
	if (!piece.data)
		return -ENOMEM;
	memcpy(piece.data, segment->data, len);
	for (at = f->pieces; at > 0 && is_before(sequence, f->piece[at - 1].sequence);)
		at--;
	memmove(&f->piece[at + 1], &f->piece[at], (size_t)(f->pieces - at) * sizeof piece);
	f->piece[at] = piece;
	f->pieces++;
	f->bytes += len;
	return 0;
}

static void drop_first(struct pcap_flow *f)
{
	f->bytes -= f->piece[0].len;
	f->pieces--;
	memmove(&f->piece[0], &f->piece[1], (size_t)f->pieces * sizeof f->piece[0]);
}

/* Pieces may overlap: of each only what is new is handed out. */
bool pcap_flow_take(struct pcap_flow *f, const uint8_t **ret_data, size_t *ret_len, bool *ret_gap)
{
	while (f->pieces > 0) {
		const struct piece first = f->piece[0];
		const uint32_t end = first.sequence + (uint32_t)first.len;

		if (!is_before(f->next, end)) {
			free(first.data);
			drop_first(f);
			continue;
		}
		if (is_before(f->next, first.sequence)) { /* something is missing before it */
			if (f->pieces < PCAP_FLOW_HELD - 1 && f->bytes < PCAP_FLOW_BYTES)
				return false;
			f->next = first.sequence;
			f->gap = true;
			f->gaps++;
		}
		free(f->out);
		f->out = first.data;
		drop_first(f);
		*ret_data = first.data + (f->next - first.sequence);
		*ret_len = end - f->next;
		*ret_gap = f->gap;
		f->gap = false;
		f->next = end;
		return true;
	}
	return false;
}

uint64_t pcap_flow_gaps(const struct pcap_flow *f)
{
	return f->gaps;
}

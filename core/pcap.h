/* Captures of a network (pcap, pcapng) read for the bytes of TCP connections. Pure.
 *
 *   file ── pcap_next ──► packet ── pcap_segment ──► one direction's piece ── pcap_flow_put, pcap_flow_take ──► bytes in order
 *
 * Links: Ethernet (VLAN tags too), Linux cooked (1 and 2), loopback of BSD, raw IP; IPv4 and IPv6. Pieces of IP packets
 * that were split are left out, as are packets that the capture cut. Nothing in a file is trusted. */
#ifndef FACET_CORE_PCAP_H
#define FACET_CORE_PCAP_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define PCAP_INTERFACES_MAX 64 /* of a pcapng; packets of further ones are left out */
#define PCAP_SENTENCE_MAX   160

struct pcap {
	const uint8_t *data; /* borrowed */
	size_t len, at;
	bool ng, swapped;
	bool nanoseconds; /* of a pcap */
	uint32_t link;    /* of a pcap */
	int interfaces;   /* of a pcapng's section */
	struct {
		uint32_t link;
		uint8_t resolution; /* as if_tsresol */
		int64_t offset_s;
	} interface[PCAP_INTERFACES_MAX];
};

struct pcap_packet {
	int64_t t_ns; /* since 1970 */
	uint32_t link;
	const uint8_t *data; /* borrowed */
	size_t len;
	bool cut; /* there was more of it on the wire */
};

bool pcap_is(const uint8_t *data, size_t len);
/* 0, or -EINVAL with a sentence. */
int pcap_open(struct pcap *, const uint8_t *data, size_t len, char error[PCAP_SENTENCE_MAX]);
/* 1; 0 at the end, also where the file was cut; -EINVAL: a length that cannot be. */
int pcap_next(struct pcap *, struct pcap_packet *ret);

struct pcap_address {
	uint8_t bytes[16]; /* IPv4: the first 4, the rest 0 */
	bool six;
	uint16_t port;
};

#define PCAP_FIN 1
#define PCAP_SYN 2
#define PCAP_RST 4
#define PCAP_ACK 16

struct pcap_segment {
	struct pcap_address from, to;
	uint32_t sequence;
	uint8_t flags;
	const uint8_t *data; /* borrowed */
	size_t len;
};

/* False: the packet is no whole TCP segment. */
bool pcap_segment(const struct pcap_packet *, struct pcap_segment *ret);

/* One direction of a connection. What comes before something that is missing waits, up to a limit; then it is given up. */
#define PCAP_FLOW_HELD  64
#define PCAP_FLOW_BYTES (256u << 10)

struct pcap_flow;
struct pcap_flow *pcap_flow_create(void); /* NULL when memory is out */
void pcap_flow_destroy(struct pcap_flow *);
void pcap_flow_reset(struct pcap_flow *);
/* 0 or -ENOMEM. A capture may begin in the middle of a connection: the first segment is then the beginning. */
int pcap_flow_put(struct pcap_flow *, const struct pcap_segment *);
/* The next bytes in order, borrowed until the next put; call until false. *ret_gap: bytes before them are missing. */
bool pcap_flow_take(struct pcap_flow *, const uint8_t **ret_data, size_t *ret_len, bool *ret_gap);
uint64_t pcap_flow_gaps(const struct pcap_flow *);

#endif

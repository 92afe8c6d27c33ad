/* Law L8: no file crashes the reader of captures, and what its flows hand out was in the capture, in bounds. */
#include <stdlib.h>

#include "core/pcap.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void must(bool condition)
{
	if (!condition)
		abort();
}

static uint32_t sum; /* whatever is handed out is read */

static void drain(struct pcap_flow *flow, size_t *left)
{
	const uint8_t *bytes;
	size_t len;
	bool gap;

	while (pcap_flow_take(flow, &bytes, &len, &gap)) {
		must(len > 0 && len <= *left);
		*left -= len;
		for (size_t i = 0; i < len; i++)
			sum += bytes[i];
	}
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	char error[PCAP_SENTENCE_MAX] = "";
	struct pcap_packet packet;
	struct pcap_segment segment;
	struct pcap_flow *flow = pcap_flow_create();
	struct pcap pcap;
	size_t left = 0;

	if (flow && pcap_open(&pcap, data, size, error) < 0)
		must(*error != 0);
	else
		while (flow && pcap_next(&pcap, &packet) == 1) {
			must(packet.data >= data && packet.data + packet.len <= data + size);
			if (!pcap_segment(&packet, &segment))
				continue;
			must(segment.data >= packet.data && segment.data + segment.len <= packet.data + packet.len);
			left += segment.len;
			must(pcap_flow_put(flow, &segment) == 0);
			drain(flow, &left);
		}
	must(!flow || pcap_flow_gaps(flow) <= size);
	pcap_flow_destroy(flow);
	return 0;
}

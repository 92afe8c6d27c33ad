/* Captures (pcap, pcapng) of scanners that speak CoLa over TCP, as a source: the bytes of the connection whose server is where a
 * scanner's `connect` says, in both directions, as its reads would have delivered them. A connection that begins, or bytes that
 * are missing in the capture, are a link that was opened: the decoder begins anew. Where several programs talk to one
 * scanner, the first one that is heard is followed until it ends or is silent for five seconds. */
#include <errno.h>
#include <netinet/in.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "config/address.h"
#include "core/pcap.h"
#include "daemon/replay_source.h"

#define SILENCE_NS   5000000000ll
#define SCANNER_PORT 2112

struct scanner {
	int device;
	struct pcap_address at;
	struct pcap_flow *flow[2]; /* FROM_DEVICE, TO_DEVICE */
	struct pcap_address client;
	bool followed;
	int64_t heard_ns;
};

struct replay_source {
	struct replay_file file;
	struct pcap pcap;
	struct scanner scanner[CONFIG_DEVICES_MAX];
	int scanners;

	struct scanner *now; /* whose bytes are being told; NULL: the next packet */
	enum direction direction;
	bool opened; /* its LINK_OPENED is due */
	bool waits;  /* bytes behind a gap: told after the LINK_OPENED */
	const uint8_t *bytes;
	size_t len;
	int64_t t_ns;

	uint64_t packets, segments, followed, others;
	struct pcap_address seen; /* a server's, for the sentence */
	bool damaged;
};

static bool capture_found(const struct replay_file *file)
{
	return pcap_is(file->data, file->len);
}

static int capture_open(const struct replay_file *file, struct replay_source **ret, char error[REPLAY_SENTENCE_MAX])
{
	struct replay_source *s = calloc(1, sizeof(*s));
	int r = s ? pcap_open(&s->pcap, file->data, file->len, error) : -ENOMEM;

	if (r < 0) {
		free(s);
		return r;
	}
	s->file = *file;
	*ret = s;
	return 0;
}

static void capture_close(struct replay_source *s)
{
	for (int i = 0; i < s->scanners; i++)
		for (int k = 0; k < 2; k++)
			pcap_flow_destroy(s->scanner[i].flow[k]);
	free(s);
}

static void capture_rewind(struct replay_source *s)
{
	char error[PCAP_SENTENCE_MAX];

	pcap_open(&s->pcap, s->file.data, s->file.len, error);
	for (int i = 0; i < s->scanners; i++) {
		s->scanner[i].followed = false;
		for (int k = 0; k < 2; k++)
			pcap_flow_reset(s->scanner[i].flow[k]);
	}
	s->now = NULL;
	s->opened = s->waits = false;
	s->packets = s->segments = s->followed = s->others = 0;
}

static bool same(const struct pcap_address *a, const struct pcap_address *b)
{
	return a->six == b->six && a->port == b->port && memcmp(a->bytes, b->bytes, sizeof(a->bytes)) == 0;
}

/* Puts the segment's bytes into its flow and sets what is to be told. */
static int follow(struct replay_source *s, struct scanner *scanner, const struct pcap_segment *segment, bool from)
{
	const struct pcap_address *client = from ? &segment->to : &segment->from;
	const bool end = segment->flags & (PCAP_FIN | PCAP_RST);
	const bool mine = scanner->followed && same(client, &scanner->client);
	const bool begins = (segment->flags & PCAP_SYN) && !from;

	if (!mine && scanner->followed && s->t_ns - scanner->heard_ns < SILENCE_NS) {
		s->others++;
		return 0;
	}
	if (!mine || (begins && segment->len == 0)) {
		if (end)
			return 0;
		scanner->client = *client;
		scanner->followed = true;
		pcap_flow_reset(scanner->flow[0]);
		pcap_flow_reset(scanner->flow[1]);
		s->opened = true;
	}
	scanner->heard_ns = s->t_ns;
	s->now = scanner;
	s->direction = from ? FROM_DEVICE : TO_DEVICE;
	s->followed++;
	if (end && segment->len == 0)
		scanner->followed = false;
	return pcap_flow_put(scanner->flow[!from], segment);
}

/* The next packet that concerns somebody: 1, 0 at the end, -errno. */
static int read_packet(struct replay_source *s, char error[REPLAY_SENTENCE_MAX])
{
	struct pcap_packet packet;
	struct pcap_segment segment;
	int r = pcap_next(&s->pcap, &packet);

	if (r < 0) {
		snprintf(error, REPLAY_SENTENCE_MAX, "damaged behind %zu bytes: a length that cannot be", s->pcap.at);
		s->damaged = true;
		return r;
	}
	if (r == 0)
		return 0;
	s->packets++;
	s->t_ns = packet.t_ns;
	if (!pcap_segment(&packet, &segment))
		return 1;
	s->segments++;
	s->seen = segment.from.port < segment.to.port ? segment.from : segment.to;
	for (int i = 0; i < s->scanners && !s->now; i++) {
		if (same(&segment.from, &s->scanner[i].at))
			r = follow(s, &s->scanner[i], &segment, true);
		else if (same(&segment.to, &s->scanner[i].at))
			r = follow(s, &s->scanner[i], &segment, false);
	}
	return r < 0 ? r : 1;
}

static void tell(const struct replay_source *s, enum direction direction, const uint8_t *bytes, size_t len,
                 struct replay_event *ret)
{
	*ret = (struct replay_event){
	    .kind = REPLAY_RECORD,
	    .log_ns = s->t_ns,
	    .record = {s->t_ns, s->t_ns, s->now->device, direction, bytes, len},
	};
}

static int capture_next(struct replay_source *s, struct replay_event *ret, char error[REPLAY_SENTENCE_MAX])
{
	bool gap = false;

	for (;;) {
		while (!s->now) {
			int r = read_packet(s, error);

			if (r != 1)
				return r;
		}
		if (s->opened) {
			s->opened = false;
			tell(s, LINK_OPENED, NULL, 0, ret);
			return 1;
		}
		if (s->waits) {
			s->waits = false;
			tell(s, s->direction, s->bytes, s->len, ret);
			return 1;
		}
		if (!pcap_flow_take(s->now->flow[s->direction == TO_DEVICE], &s->bytes, &s->len, &gap)) {
			s->now = NULL;
			continue;
		}
		s->waits = true;
		s->opened = gap;
	}
}

static bool capture_span(struct replay_source *s, int64_t *ret_first_ns, int64_t *ret_last_ns)
{
	char error[REPLAY_SENTENCE_MAX];
	struct replay_event event;
	bool found = false;

	capture_rewind(s);
	while (capture_next(s, &event, error) == 1) {
		if (!found)
			*ret_first_ns = event.log_ns;
		if (!found || event.log_ns > *ret_last_ns)
			*ret_last_ns = event.log_ns;
		found = true;
	}
	return found;
}

static bool place(const struct config_device *device, struct pcap_address *ret)
{
	char sentence[ADDRESS_ERROR_MAX];
	struct sockaddr_storage storage;
	struct address address;
	socklen_t len;

	if (address_parse_number(device->connect, SCANNER_PORT, &address, sentence) < 0 ||
	    address_sockaddr(&address, &storage, &len) < 0)
		return false;
	memset(ret, 0, sizeof(*ret));
	ret->port = address.port;
	ret->six = storage.ss_family == AF_INET6;
	if (ret->six)
		memcpy(ret->bytes, &((struct sockaddr_in6 *)&storage)->sin6_addr, 16);
	else
		memcpy(ret->bytes, &((struct sockaddr_in *)&storage)->sin_addr, 4);
	return true;
}

static int add_scanner(struct replay_source *s, const struct config *config, int device)
{
	struct scanner *scanner = &s->scanner[s->scanners];

	if (!place(&config->device[device], &scanner->at))
		return 0;
	scanner->device = device;
	scanner->flow[0] = pcap_flow_create();
	scanner->flow[1] = pcap_flow_create();
	s->scanners++;
	return scanner->flow[0] && scanner->flow[1] ? 0 : -ENOMEM;
}

static void no_bytes(const struct replay_source *s, char error[REPLAY_SENTENCE_MAX])
{
	const uint8_t *b = s->seen.bytes;
	char hint[60] = "";

	if (s->segments && !s->seen.six)
		snprintf(hint, sizeof(hint), " (it has packets of %u.%u.%u.%u:%u)", b[0], b[1], b[2], b[3],
		         s->seen.port);
	snprintf(error, REPLAY_SENTENCE_MAX,
	         "no connection to a scanner of the configuration is in it%s: `connect` must say where it was", hint);
}

static int capture_use(struct replay_source *s, const struct config *config, char error[REPLAY_SENTENCE_MAX])
{
	static const char *const driver[] = {"tim", "lms1xx", "lms5xx"};
	int64_t first_ns, last_ns;
	int r = 0;

	for (int i = 0; i < config->devices && r == 0; i++)
		for (size_t k = 0; k < sizeof(driver) / sizeof(*driver); k++)
			if (r == 0 && strcmp(config->device[i].driver, driver[k]) == 0)
				r = add_scanner(s, config, i);
	if (r < 0)
		return r;
	if (s->scanners > 0 && capture_span(s, &first_ns, &last_ns))
		return 0;
	no_bytes(s, error);
	return -EINVAL;
}

static void capture_note(const struct replay_source *s, char ret[REPLAY_SENTENCE_MAX])
{
	uint64_t gaps = 0;

	*ret = 0;
	for (int i = 0; i < s->scanners; i++)
		gaps += pcap_flow_gaps(s->scanner[i].flow[0]);
	if (gaps)
		snprintf(ret, REPLAY_SENTENCE_MAX, "bytes are missing in it at %llu place%s", (unsigned long long)gaps,
		         gaps > 1 ? "s" : "");
	else if (s->others)
		snprintf(ret, REPLAY_SENTENCE_MAX, "%llu packets of other programs' connections were left out",
		         (unsigned long long)s->others);
}

const struct replay_format replay_capture = {.name = "a capture",
                                             .order = REPLAY_MERGED,
                                             .is = capture_found,
                                             .open = capture_open,
                                             .close = capture_close,
                                             .use = capture_use,
                                             .span = capture_span,
                                             .next = capture_next,
                                             .rewind = capture_rewind,
                                             .note = capture_note};

/* The SDO server of a simulated node (CiA 301): expedited and segmented in both directions, one transfer at a time.
 *
 *   request   byte 0: command, 1-2 index, 3 sub, 4-7 data or size     segments: byte 0: command, 1-7 data
 *
 *   001n nnes  write   e: the data are here, s: their length is said (4 - n), or the size of what follows
 *   000t nnnc  a segment of what is written, 7 - n bytes, c: the last
 *   010x       read    011t  the next segment of what is read    100  abort    the others: block transfer, refused
 *
 * An abort ends the transfer and is not answered. A new begin ends the old transfer silently. What does not fit is
 * refused with the reason that the standard has for it. */
#include "tools/sim_node.h"

#include <string.h>

/* So long a small controller needs, or up to three times as long. */
#define ANSWER_NS INT64_C(200000)

static void answer(struct sim_node *n, const uint8_t bytes[8], uint8_t len, int64_t t_ns)
{
	n->counts.replies++;
	sim_node_send(n, CANOPEN_SDO_ANSWER + (uint32_t)n->params.node, bytes, len,
	              t_ns + ANSWER_NS + (int64_t)(2.0 * (double)ANSWER_NS * sim_random(&n->random)));
}

static void put32(uint8_t *p, uint32_t v)
{
	for (int i = 0; i < 4; i++)
		p[i] = (uint8_t)(v >> (8 * i));
}

static uint32_t get32(const uint8_t *p)
{
	return p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
}

static void refuse(struct sim_node *n, uint16_t index, uint8_t sub, uint32_t reason, int64_t t_ns)
{
	uint8_t bytes[8] = {0x80, (uint8_t)index, (uint8_t)(index >> 8), sub};

	n->sdo.kind = SIM_SDO_IDLE;
	put32(bytes + 4, reason);
	answer(n, bytes, 8, t_ns);
}

static void confirm(struct sim_node *n, const uint8_t *request, int64_t t_ns)
{
	uint8_t bytes[8] = {0x60, request[1], request[2], request[3]};

	if (sim_fault_due(&n->fault[SIM_FAULT_SDO_ECHO]))
		memcpy(bytes + 4, request + 4, 4);
	answer(n, bytes, sim_fault_due(&n->fault[SIM_FAULT_SDO_SHORT]) ? 4 : 8, t_ns);
}

/* A number of its type, little-endian. */
static int64_t number(const struct sim_node_object *object, int len, const uint8_t *bytes)
{
	uint32_t v = 0;

	for (int i = 0; i < len; i++)
		v |= (uint32_t)bytes[i] << (8 * i);
	switch (object->type) {
	case SIM_I8:
		return (int8_t)v;
	case SIM_I16:
		return (int16_t)v;
	case SIM_I32:
		return (int32_t)v;
	default:
		return v;
	}
}

/* All data are there. */
static uint32_t store(struct sim_node *n, int object, const uint8_t *data, uint32_t len, int64_t t_ns)
{
	const struct sim_node_object *o = &n->object[object];
	uint32_t want = (uint32_t)sim_node_bytes(n, object);

	if (!(o->access & SIM_W))
		return CANOPEN_ABORT_READ_ONLY;
	if (o->type == SIM_TEXT) {
		if (len >= SIM_NODE_TEXT)
			return SIM_NODE_TOO_LONG;
		memcpy(n->text, data, len);
		n->text[len] = 0;
		return 0;
	}
	if (len != want)
		return len > want ? SIM_NODE_TOO_LONG : SIM_NODE_TOO_SHORT;
	return sim_node_write(n, object, number(o, (int)want, data), t_ns);
}

/* The object asked for, or -1: it was refused. */
static int object_of(struct sim_node *n, uint16_t index, uint8_t sub, int64_t t_ns)
{
	bool others;
	int object = sim_node_find(n, index, sub, &others);
	struct sim_fault_state *ordered = &n->fault[SIM_FAULT_SDO_ABORT];

	if ((ordered->value == 0 || ordered->value == index) && sim_fault_due(ordered)) {
		refuse(n, index, sub, CANOPEN_ABORT_STATE, t_ns);
		return -1;
	}
	if (object < 0)
		refuse(n, index, sub, others ? CANOPEN_ABORT_NO_SUB : CANOPEN_ABORT_NO_OBJECT, t_ns);
	return object;
}

static void begin_download(struct sim_node *n, const uint8_t *b, int64_t t_ns)
{
	uint16_t index = (uint16_t)(b[1] | b[2] << 8);
	int object = object_of(n, index, b[3], t_ns);
	uint32_t len, refused;

	if (object < 0)
		return;
	if (!(b[0] & 0x02)) {
		if (!(n->object[object].access & SIM_W)) {
			refuse(n, index, b[3], CANOPEN_ABORT_READ_ONLY, t_ns);
			return;
		}
		n->sdo = (struct sim_node_sdo){.kind = SIM_SDO_DOWNLOAD, .index = index, .sub = b[3]};
		n->sdo.size = b[0] & 0x01 ? get32(b + 4) : 0;
		confirm(n, b, t_ns);
		return;
	}
	n->sdo.kind = SIM_SDO_IDLE;
	len = b[0] & 0x01 ? 4u - (b[0] >> 2 & 3) : (uint32_t)sim_node_bytes(n, object);
	refused = store(n, object, b + 4, len, t_ns);
	if (refused)
		refuse(n, index, b[3], refused, t_ns);
	else
		confirm(n, b, t_ns);
}

static void download_segment(struct sim_node *n, const uint8_t *b, int64_t t_ns)
{
	struct sim_node_sdo *sdo = &n->sdo;
	uint32_t len = 7u - (b[0] >> 1 & 7), refused = 0;
	bool toggle = b[0] & 0x10, last = b[0] & 0x01;
	int object = sim_node_find(n, sdo->index, sdo->sub, NULL);

	if (sdo->kind != SIM_SDO_DOWNLOAD)
		refused = CANOPEN_ABORT_COMMAND;
	else if (toggle != sdo->toggle)
		refused = CANOPEN_ABORT_TOGGLE;
	else if (sdo->len + len > sizeof sdo->data)
		refused = SIM_NODE_TOO_LONG;
	if (!refused) {
		memcpy(sdo->data + sdo->len, b + 1, len);
		sdo->len += len;
		sdo->toggle = !toggle;
		if (last && sdo->size && sdo->size != sdo->len)
			refused = CANOPEN_ABORT_LENGTH;
		else if (last)
			refused = store(n, object, sdo->data, sdo->len, t_ns);
	}
	if (refused) {
		refuse(n, sdo->index, sdo->sub, refused, t_ns);
		return;
	}
	if (last)
		sdo->kind = SIM_SDO_IDLE;
	answer(n, (const uint8_t[8]){(uint8_t)(0x20 | (toggle ? 0x10 : 0))}, 8, t_ns);
}

static const char *text_of(const struct sim_node *n, int object)
{
	return n->object[object].text ? n->object[object].text : n->text;
}

static void begin_upload(struct sim_node *n, const uint8_t *b, int64_t t_ns)
{
	uint16_t index = (uint16_t)(b[1] | b[2] << 8);
	int object = object_of(n, index, b[3], t_ns), len;
	uint8_t bytes[8] = {0, b[1], b[2], b[3]};

	if (object < 0)
		return;
	len = sim_node_bytes(n, object);
	if (!(n->object[object].access & SIM_R)) {
		refuse(n, index, b[3], CANOPEN_ABORT_WRITE_ONLY, t_ns);
		return;
	}
	n->sdo = (struct sim_node_sdo){.index = index, .sub = b[3]};
	if (n->object[object].type == SIM_TEXT) {
		n->sdo.kind = SIM_SDO_UPLOAD;
		n->sdo.len = (uint32_t)strlen(text_of(n, object));
		memcpy(n->sdo.data, text_of(n, object), n->sdo.len);
		bytes[0] = 0x41;
		put32(bytes + 4, n->sdo.len);
		answer(n, bytes, 8, t_ns);
		return;
	}
	bytes[0] = (uint8_t)(0x43 | (4 - len) << 2);
	put32(bytes + 4, (uint32_t)sim_node_measure(n, object, t_ns));
	memset(bytes + 4 + len, 0, (size_t)(4 - len));
	answer(n, bytes, sim_fault_due(&n->fault[SIM_FAULT_SDO_SHORT]) ? (uint8_t)(4 + len) : 8, t_ns);
}

static void upload_segment(struct sim_node *n, const uint8_t *b, int64_t t_ns)
{
	struct sim_node_sdo *sdo = &n->sdo;
	uint32_t len = sdo->len - sdo->at < 7 ? sdo->len - sdo->at : 7;
	bool toggle = b[0] & 0x10, last = sdo->at + len == sdo->len;
	uint8_t bytes[8] = {(uint8_t)((toggle ? 0x10 : 0) | (7 - len) << 1 | last)};

	if (sdo->kind != SIM_SDO_UPLOAD || toggle != sdo->toggle) {
		refuse(n, sdo->index, sdo->sub,
		       sdo->kind != SIM_SDO_UPLOAD ? CANOPEN_ABORT_COMMAND : CANOPEN_ABORT_TOGGLE, t_ns);
		return;
	}
	memcpy(bytes + 1, sdo->data + sdo->at, len);
	sdo->at += len;
	sdo->toggle = !toggle;
	if (last)
		sdo->kind = SIM_SDO_IDLE;
	answer(n, bytes, 8, t_ns);
}

void sim_node_sdo_request(struct sim_node *n, const uint8_t *bytes, uint8_t len, int64_t t_ns)
{
	if (len < 8)
		return; /* no SDO */
	n->counts.requests++;
	if (sim_fault_due(&n->fault[SIM_FAULT_SDO_TIMEOUT]))
		return;
	switch (bytes[0] >> 5) {
	case 0:
		download_segment(n, bytes, t_ns);
		break;
	case 1:
		begin_download(n, bytes, t_ns);
		break;
	case 2:
		begin_upload(n, bytes, t_ns);
		break;
	case 3:
		upload_segment(n, bytes, t_ns);
		break;
	case 4:
		n->sdo.kind = SIM_SDO_IDLE;
		break;
	default:
		refuse(n, (uint16_t)(bytes[1] | bytes[2] << 8), bytes[3], CANOPEN_ABORT_COMMAND, t_ns);
		break;
	}
}

/* A node's object dictionary for tests: it answers SDO as the standard says and refuses what it forbids (a mapping that
 * is changed while its PDO exists or its count is not 0, a COB-id that is changed while the PDO exists). */
#ifndef FACET_TESTS_CANOPEN_NODE_H
#define FACET_TESTS_CANOPEN_NODE_H

#include <string.h>

#include "drivers/canopen_wire.h"

#define NODE_OBJECTS 256
#define NODE_WRITES  128

struct node_object {
	uint16_t index;
	uint8_t sub, size;
	bool read_only, write_only;
	uint32_t value;
	uint32_t refuse; /* writes: this abort */
};

struct node {
	int id;
	int objects;
	struct node_object object[NODE_OBJECTS];
	bool silent, echo, brief,
	    unsized;   /* how it answers: not at all, with data, no longer than needed, size not said */
	bool keep_rtr; /* refuses a COB-id whose bit 30 is not as it was */
	int reads, writes;
	struct can_frame_at write[NODE_WRITES]; /* as they came */
};

static inline struct node_object *node_find(struct node *n, uint16_t index, uint8_t sub)
{
	for (int i = 0; i < n->objects; i++)
		if (n->object[i].index == index && n->object[i].sub == sub)
			return &n->object[i];
	return NULL;
}

static inline struct node_object *node_put(struct node *n, uint16_t index, uint8_t sub, uint8_t size, uint32_t value)
{
	struct node_object *o = node_find(n, index, sub);

	if (!o)
		o = &n->object[n->objects++];
	*o = (struct node_object){.index = index, .sub = sub, .size = size, .value = value};
	return o;
}

static inline uint32_t node_value(struct node *n, uint16_t index, uint8_t sub)
{
	const struct node_object *o = node_find(n, index, sub);

	return o ? o->value : UINT32_MAX;
}

/* PDO at `index` (1400.., 1800..) with `count` entries and room for 8. */
static inline void node_pdo(struct node *n, uint16_t index, uint32_t cob, uint8_t type, int count,
                            const uint32_t *entry)
{
	node_put(n, index, 1, 4, cob);
	node_put(n, index, 2, 1, type);
	node_put(n, (uint16_t)(index + 0x200), 0, 1, (uint32_t)count);
	for (int i = 0; i < 8; i++)
		node_put(n, (uint16_t)(index + 0x200), (uint8_t)(i + 1), 4, i < count ? entry[i] : 0);
}

/* A drive as the two of the capture, mapped by its maker's whim. */
static inline void node_drive(struct node *n, int id)
{
	static const uint32_t status[] = {0x60410010}, control[] = {0x60400010};
	const uint32_t node = (uint32_t)id;

	*n = (struct node){.id = id};
	node_put(n, 0x1000, 0, 4, 0x00020192)->read_only = true;
	for (uint8_t sub = 1; sub <= 4; sub++)
		node_put(n, 0x1018, sub, 4, sub == 1 ? 0x300 : sub == 2 ? 0x4644 : sub)->read_only = true;
	node_put(n, 0x1016, 0, 1, 2)->read_only = true;
	node_put(n, 0x1016, 1, 4, 0);
	node_put(n, 0x1016, 2, 4, 0);
	node_put(n, 0x1017, 0, 2, 0);
	for (uint16_t i = 0; i < 4; i++) {
		node_pdo(n, (uint16_t)(0x1400 + i), 0x200u + 0x100u * i + node, 255, 1, control);
		node_pdo(n, (uint16_t)(0x1800 + i), 0x180u + 0x100u * i + node, 255, 1, status);
		node_put(n, (uint16_t)(0x1800 + i), 3, 2, 0);
		node_put(n, (uint16_t)(0x1800 + i), 5, 2, 0);
	}
	node_put(n, 0x6007, 0, 2, 0);
	node_put(n, 0x605a, 0, 2, 2);
	node_put(n, 0x605c, 0, 2, 0);
}

static inline uint32_t node_judge(struct node *n, const struct node_object *o, const struct canopen_wire_sdo *sdo)
{
	const uint16_t group = o->index & 0xfe00;
	const uint32_t value = canopen_wire_number(sdo->data, sdo->len);

	if (o->refuse)
		return o->refuse;
	if (o->read_only)
		return 0x06010002;
	if (!sdo->expedited || sdo->len != o->size)
		return 0x06070010;
	if (group == 0x1600 || group == 0x1a00) {
		if (!(node_value(n, (uint16_t)(o->index - 0x200), 1) & CANOPEN_COB_OFF))
			return 0x08000022;
		if (o->sub > 0 && node_value(n, o->index, 0) != 0)
			return 0x06010003;
	}
	if ((group == 0x1400 || group == 0x1800) && o->sub == 1) {
		if (!((o->value | value) & CANOPEN_COB_OFF) && (o->value ^ value) & CANOPEN_COB_ID)
			return 0x06090030;
		if (n->keep_rtr && (o->value ^ value) & CANOPEN_COB_NO_RTR)
			return 0x06090030;
	}
	return 0;
}

/* False: it does not answer. */
static inline bool node_answer(struct node *n, const struct can_frame_at *request, struct can_frame_at *ret)
{
	struct canopen_wire_sdo sdo, answer = {.kind = CANOPEN_SDO_ABORT};
	struct node_object *o;
	uint8_t bytes[8];

	if (n->silent || request->id != CANOPEN_SDO_REQUEST + (uint32_t)n->id ||
	    !canopen_wire_parse_request(request->data, request->len, &sdo) || sdo.kind == CANOPEN_SDO_ABORT)
		return false;
	if (sdo.kind == CANOPEN_SDO_DOWNLOAD && n->writes < NODE_WRITES)
		n->write[n->writes++] = *request;
	n->reads += sdo.kind == CANOPEN_SDO_UPLOAD;
	answer.index = sdo.index;
	answer.sub = sdo.sub;
	o = node_find(n, sdo.index, sdo.sub);
	if (!o)
		answer.abort = 0x06020000;
	else if (sdo.kind == CANOPEN_SDO_DOWNLOAD)
		answer.abort = node_judge(n, o, &sdo);
	else
		answer.abort = o->write_only ? 0x06010001 : 0;
	if (!answer.abort && sdo.kind == CANOPEN_SDO_DOWNLOAD)
		o->value = canopen_wire_number(sdo.data, sdo.len);
	if (!answer.abort) {
		answer.kind = sdo.kind;
		answer.expedited = true;
		answer.sized = !n->unsized;
		answer.len = n->unsized ? 4 : o->size;
		for (int i = 0; i < 4; i++)
			answer.data[i] = (uint8_t)(o->value >> 8 * i);
	}
	canopen_wire_put_answer(&answer, bytes);
	if (n->echo && answer.kind == CANOPEN_SDO_DOWNLOAD)
		memcpy(bytes + 4, request->data + 4, 4);
	*ret = can_wire_frame(CANOPEN_SDO_ANSWER + (uint32_t)n->id, bytes, 8);
	if (n->brief && answer.kind != CANOPEN_SDO_ABORT)
		ret->len = (uint8_t)(answer.kind == CANOPEN_SDO_UPLOAD ? 4 + answer.len : 4);
	return true;
}

#endif

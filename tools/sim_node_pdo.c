/* Process data of a simulated node (CiA 301): what may be mapped, and when it is sent or takes effect.
 *
 *   14xx, 18xx  1: COB-id, bit 31 off   2: type   3: inhibit time, 100 us   5: event timer, ms
 *   16xx, 1Axx  0: how many   1..8: index << 16 | sub << 8 | bits
 *
 *   type 0        at a SYNC, if something has changed       254, 255  when something has changed, and by the event timer
 *   type 1..240   at every n-th SYNC                        received: 0..240 at the next SYNC, 254, 255 at once
 *
 * A mapping can be written while its PDO is off and its count is 0, in this order and no other; the count is written
 * last and judges the whole. What a SYNC asks for is sampled at the time of the SYNC, and before what was received takes
 * effect at the same SYNC. Changes are looked for every few ms, as a node's cycle does, not at every instant. */
#include "tools/sim_node.h"

#include <string.h>

#define LOOK_NS   INT64_C(5000000)
#define SAMPLE_NS INT64_C(200000) /* from a SYNC to its first PDO, and from one to the next */
#define MS        INT64_C(1000000)

struct setting {
	uint32_t cob;
	uint8_t type, count;
	uint32_t entry[SIM_NODE_MAPPED];
	int64_t inhibit_ns, event_ns;
};

static struct setting setting_of(const struct sim_node *n, bool receive, int pdo)
{
	uint16_t how = (uint16_t)((receive ? 0x1400 : 0x1800) + pdo), what = (uint16_t)(how + 0x200);
	struct setting s = {.cob = (uint32_t)sim_node_value(n, how, 1),
	                    .type = (uint8_t)sim_node_value(n, how, 2),
	                    .count = (uint8_t)sim_node_value(n, what, 0),
	                    .inhibit_ns = sim_node_value(n, how, 3) * MS / 10,
	                    .event_ns = sim_node_value(n, how, 5) * MS};

	for (uint8_t i = 0; i < s.count; i++)
		s.entry[i] = (uint32_t)sim_node_value(n, what, (uint8_t)(i + 1));
	return s;
}

static bool in_use(const struct setting *s)
{
	return !(s->cob & CANOPEN_COB_OFF) && s->count > 0;
}

/* Types 1..7 stand for nothing, in received PDOs: room that is skipped. */
static uint32_t judge_entry(const struct sim_node *n, uint32_t entry, bool receive)
{
	uint16_t index = (uint16_t)(entry >> 16);
	uint8_t sub = (uint8_t)(entry >> 8), bits = (uint8_t)entry;
	bool others;
	int object = sim_node_find(n, index, sub, &others);

	if (receive && index >= 1 && index <= 7)
		return bits % 8 || bits > 64 ? CANOPEN_ABORT_NOT_MAPPABLE : 0;
	if (object < 0)
		return others ? CANOPEN_ABORT_NO_SUB : CANOPEN_ABORT_NO_OBJECT;
	if (!(n->object[object].access & (receive ? SIM_RX : SIM_TX)) || bits != 8 * sim_node_bytes(n, object))
		return CANOPEN_ABORT_NOT_MAPPABLE;
	return 0;
}

static uint32_t judge_count(const struct sim_node *n, uint16_t what, int64_t count, bool receive)
{
	uint32_t bits = 0;

	if (count > SIM_NODE_MAPPED)
		return CANOPEN_ABORT_PDO_LENGTH;
	for (uint8_t i = 1; i <= count; i++) {
		uint32_t entry = (uint32_t)sim_node_value(n, what, i), refused = judge_entry(n, entry, receive);

		if (refused)
			return refused;
		bits += entry & 0xff;
	}
	return bits > 64 ? CANOPEN_ABORT_PDO_LENGTH : 0;
}

/* Ids that belong to others by the standard. */
static bool reserved(uint32_t id)
{
	return id <= 0x7f || (id >= 0x101 && id <= 0x180) || (id >= 0x581 && id <= 0x5ff) ||
	       (id >= 0x601 && id <= 0x67f) || (id >= 0x6e0 && id <= 0x6ff) || id >= 0x701;
}

static uint32_t judge_cob(const struct sim_node *n, uint32_t before, uint32_t cob, bool receive)
{
	if (cob & CANOPEN_COB_EXTENDED || reserved(cob & CANOPEN_COB_ID))
		return CANOPEN_ABORT_RANGE;
	if (!receive && n->params.kind != SIM_CANOPEN_DRIVE && !(cob & CANOPEN_COB_NO_RTR))
		return CANOPEN_ABORT_RANGE;
	/* While it exists its id stands. */
	if (!((before | cob) & CANOPEN_COB_OFF) && (before ^ cob) & CANOPEN_COB_ID)
		return CANOPEN_ABORT_RANGE;
	return 0;
}

uint32_t sim_node_pdo_judge(const struct sim_node *n, const struct sim_node_object *o, int64_t value)
{
	bool receive = o->index < 0x1800, mapping = o->index & 0x200;
	uint16_t how = o->index & 0xfdff;
	uint32_t cob = (uint32_t)sim_node_value(n, how, 1);

	if (mapping) {
		if (!(cob & CANOPEN_COB_OFF))
			return CANOPEN_ABORT_ACCESS;
		if (o->sub == 0)
			return judge_count(n, o->index, value, receive);
		if (sim_node_value(n, o->index, 0) != 0)
			return CANOPEN_ABORT_ACCESS;
		return value ? judge_entry(n, (uint32_t)value, receive) : 0;
	}
	switch (o->sub) {
	case 1:
		return judge_cob(n, cob, (uint32_t)value, receive);
	case 2:
		return value > CANOPEN_TYPE_SYNC_MAX && value < CANOPEN_TYPE_EVENT ? CANOPEN_ABORT_RANGE : 0;
	case 3:
		return cob & CANOPEN_COB_OFF ? 0 : CANOPEN_ABORT_STATE;
	}
	return 0;
}

static uint8_t sample(const struct sim_node *n, const struct setting *s, int64_t t_ns, uint8_t ret[8])
{
	uint8_t len = 0;

	for (int i = 0; i < s->count; i++) {
		int object = sim_node_find(n, (uint16_t)(s->entry[i] >> 16), (uint8_t)(s->entry[i] >> 8), NULL);
		int64_t value = sim_node_measure(n, object, t_ns);

		for (uint8_t bit = 0; bit < (s->entry[i] & 0xff) && len < 8; bit += 8)
			ret[len++] = (uint8_t)((uint64_t)value >> bit);
	}
	return len;
}

static bool carries_position(const struct setting *s)
{
	for (int i = 0; i < s->count; i++)
		if (s->entry[i] >> 16 == 0x6064 || s->entry[i] >> 16 == 0x6004 || s->entry[i] >> 16 == 0x6010 ||
		    s->entry[i] >> 16 == 0x6110)
			return true;
	return false;
}

static void post(struct sim_node *n, int pdo, const struct setting *s, const uint8_t *bytes, uint8_t len, int64_t t_ns)
{
	struct sim_node_pdo *state = &n->tx[pdo];

	memcpy(state->last, bytes, len);
	state->last_len = len;
	state->sent_ns = t_ns;
	state->syncs = 0;
	if (s->event_ns)
		state->event_ns = t_ns + s->event_ns;
	n->counts.profiles += carries_position(s);
	if (sim_fault_due(&n->fault[SIM_FAULT_NO_PDO])) {
		n->counts.dropped += carries_position(s);
		return;
	}
	if (sim_fault_due(&n->fault[SIM_FAULT_LATE]))
		t_ns += (int64_t)(sim_fault_value(&n->fault[SIM_FAULT_LATE], 3.0) * (double)MS);
	const int queued = (int)n->queued;

	sim_node_send(n, s->cob & CANOPEN_COB_ID, bytes, len, t_ns);
	if (carries_position(s))
		*((int)n->queued > queued ? &n->counts.sent : &n->counts.dropped) += 1;
}

void sim_node_pdo_written(struct sim_node *n, const struct sim_node_object *o, int64_t t_ns)
{
	int pdo = o->index & 3;

	if (o->index >= 0x1800) {
		n->tx[pdo] = (struct sim_node_pdo){.event_ns = INT64_MAX, .sent_ns = INT64_MIN / 2};
		if (o->index < 0x1A00 && o->sub == 5 && sim_node_value(n, o->index, 5))
			n->tx[pdo].event_ns = t_ns + sim_node_value(n, o->index, 5) * MS;
	} else {
		n->rx[pdo].waits = false;
	}
	if (o->index < 0x1A00 && o->index >= 0x1800 && n->state == CANOPEN_OPERATIONAL)
		sim_node_pdo_events(n, t_ns);
}

void sim_node_pdo_start(struct sim_node *n, int64_t t_ns)
{
	for (int i = 0; i < SIM_NODE_PDOS; i++) {
		int64_t event_ns = sim_node_value(n, (uint16_t)(0x1800 + i), 5) * MS;

		n->tx[i] =
		    (struct sim_node_pdo){.event_ns = event_ns ? t_ns + event_ns : INT64_MAX, .sent_ns = INT64_MIN / 2};
		n->rx[i] = (struct sim_node_pdo){0};
	}
	n->event_look_ns = t_ns;
	sim_node_pdo_events(n, t_ns);
}

static void apply_entry(struct sim_node *n, int object, uint32_t v, int64_t t_ns)
{
	switch (n->object[object].type) {
	case SIM_I8:
		sim_node_write(n, object, (int8_t)v, t_ns);
		break;
	case SIM_I16:
		sim_node_write(n, object, (int16_t)v, t_ns);
		break;
	case SIM_I32:
		sim_node_write(n, object, (int32_t)v, t_ns);
		break;
	default:
		sim_node_write(n, object, v, t_ns);
		break;
	}
}

/* A control word acts last, whatever its place: with the target that came with it. */
static void apply(struct sim_node *n, const struct setting *s, const uint8_t *bytes, int64_t t_ns)
{
	for (int pass = 0; pass < 2; pass++) {
		int at = 0;

		for (int i = 0; i < s->count; i++) {
			uint16_t index = (uint16_t)(s->entry[i] >> 16);
			int object = sim_node_find(n, index, (uint8_t)(s->entry[i] >> 8), NULL);
			int width = (int)(s->entry[i] & 0xff) / 8;
			uint32_t v = 0;

			for (int k = 0; k < width && k < 4; k++)
				v |= (uint32_t)bytes[at + k] << (8 * k);
			at += width;
			if (object >= 0 && (index == 0x6040) == (pass == 1)) /* else room that is skipped */
				apply_entry(n, object, v, t_ns);
		}
	}
}

/* In the order of what the control word needs: targets that came with the same SYNC are there before it acts. */
static void apply_waiting(struct sim_node *n, int64_t t_ns)
{
	for (int i = SIM_NODE_PDOS - 1; i >= 0; i--) {
		struct setting s = setting_of(n, true, i);

		if (!n->rx[i].waits)
			continue;
		n->rx[i].waits = false;
		apply(n, &s, n->rx[i].last, t_ns);
	}
	if (n->params.kind == SIM_CANOPEN_DRIVE)
		sim_node_drive_cycle(n, t_ns);
}

void sim_node_pdo_sync(struct sim_node *n, int64_t sync_ns, int64_t t_ns)
{
	int64_t leaves_ns = t_ns;
	uint8_t bytes[8];

	if (n->state != CANOPEN_OPERATIONAL)
		return;
	for (int i = 0; i < SIM_NODE_PDOS; i++) {
		struct setting s = setting_of(n, false, i);
		uint8_t len;

		if (!in_use(&s) || s.type > CANOPEN_TYPE_SYNC_MAX || ++n->tx[i].syncs < s.type)
			continue;
		len = sample(n, &s, sync_ns, bytes);
		if (s.type == 0 && n->tx[i].last_len == len && memcmp(bytes, n->tx[i].last, len) == 0)
			continue;
		leaves_ns += SAMPLE_NS;
		post(n, i, &s, bytes, len, leaves_ns);
	}
	apply_waiting(n, t_ns);
}

void sim_node_pdo_received(struct sim_node *n, const struct can_frame_at *frame, int64_t t_ns)
{
	for (int i = 0; i < SIM_NODE_PDOS && n->params.kind == SIM_CANOPEN_DRIVE; i++) {
		struct setting s = setting_of(n, true, i);
		uint32_t bits = 0;

		if (!in_use(&s) || (s.cob & CANOPEN_COB_ID) != frame->id)
			continue;
		for (int k = 0; k < s.count; k++)
			bits += s.entry[k] & 0xff;
		if (frame->len * 8u < bits) {
			sim_node_emergency(n, 0x8210, 0x10);
			continue;
		}
		memcpy(n->rx[i].last, frame->data, 8);
		if (s.type <= CANOPEN_TYPE_SYNC_MAX) {
			n->rx[i].waits = true;
			continue;
		}
		apply(n, &s, frame->data, t_ns);
		sim_node_drive_cycle(n, t_ns);
	}
}

/* Sent for a change, or because its timer says so. */
void sim_node_pdo_events(struct sim_node *n, int64_t t_ns)
{
	uint8_t bytes[8];

	if (n->state != CANOPEN_OPERATIONAL)
		return;
	n->event_look_ns = t_ns + LOOK_NS;
	for (int i = 0; i < SIM_NODE_PDOS; i++) {
		struct setting s = setting_of(n, false, i);
		bool timer = n->tx[i].event_ns <= t_ns;
		uint8_t len;

		if (!in_use(&s) || s.type < CANOPEN_TYPE_EVENT || t_ns - n->tx[i].sent_ns < s.inhibit_ns)
			continue;
		len = sample(n, &s, t_ns, bytes);
		if (timer || len != n->tx[i].last_len || memcmp(bytes, n->tx[i].last, len) != 0)
			post(n, i, &s, bytes, len, t_ns);
	}
}

int64_t sim_node_pdo_deadline(const struct sim_node *n)
{
	int64_t deadline = INT64_MAX;

	if (n->state != CANOPEN_OPERATIONAL)
		return INT64_MAX;
	for (int i = 0; i < SIM_NODE_PDOS; i++) {
		struct setting s = setting_of(n, false, i);

		if (!in_use(&s) || s.type < CANOPEN_TYPE_EVENT)
			continue;
		if (n->event_look_ns < deadline)
			deadline = n->event_look_ns;
		if (n->tx[i].event_ns < deadline)
			deadline = n->tx[i].event_ns;
		if (deadline < n->tx[i].sent_ns + s.inhibit_ns)
			deadline = n->tx[i].sent_ns + s.inhibit_ns;
	}
	return deadline;
}

/* Simulated CANopen nodes as brains, see sim_canopen.h: what a node is from its power switch to its process data.
 *
 *   no power -> starting -boot-up message-> pre-operational <-> operational <-> stopped     (NMT, CiA 301)
 *
 * Time: the owner comes when something is due, or when frames are there, and may be late. What is due is done in order
 * and at its own time, before what came later. A SYNC is sampled at the time at which it was on the bus, even if the
 * node hears of it later: the axis answers for the past. Frames to be sent wait in a queue until they leave.
 *
 * The heartbeat consumer begins to watch with the first heartbeat that it hears. When one is missing: an emergency
 * (8130), what object 1029 says of the NMT state (0: pre-operational, so process data end), and what 6007 says of the
 * drive. */
#include "tools/sim_node.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"

#define SECOND     1e9
#define MS         INT64_C(1000000)
#define BOOT_NS    (20 * MS)
#define STEPS_MAX  1000000 /* of one advance: nothing that is due every few ms gets there */
#define HEARD_LATE 0x8130

static const char *const kinds[] = {"heartbeat", "silent",    "power cycle", "off",    "emcy",      "fault",
                                    "stuck",     "slow",      "homing",      "limit",  "sdo abort", "sdo timeout",
                                    "sdo echo",  "sdo short", "late",        "no pdo", "mapping",   NULL};
static const char *const sensor_kinds[] = {"heartbeat", "silent",    "power cycle", "off",      "emcy",
                                           "stuck",     "sdo abort", "sdo timeout", "sdo echo", "sdo short",
                                           "late",      "no pdo",    "mapping",     NULL};

void sim_node_send(struct sim_node *n, uint32_t id, const uint8_t *bytes, uint8_t len, int64_t t_ns)
{
	struct can_frame_at *frame;

	if (!n->powered || n->queued >= SIM_NODE_QUEUE || sim_fault_due(&n->fault[SIM_FAULT_SILENT]))
		return;
	frame = &n->queue[n->queued].frame;
	memset(frame, 0, sizeof *frame);
	frame->id = id;
	frame->len = len;
	frame->t_ns = t_ns;
	memcpy(frame->data, bytes, len);
	n->queue[n->queued++].order = n->ordered++;
}

void sim_node_emergency(struct sim_node *n, uint16_t code, uint8_t error_register)
{
	uint8_t bytes[8] = {(uint8_t)code, (uint8_t)(code >> 8), error_register};

	n->error_register = error_register;
	if (code) {
		sim_node_set(n, 0x1003, 0, 1);
		sim_node_set(n, 0x1003, 1, code | (int64_t)error_register << 16);
	}
	sim_node_send(n, CANOPEN_EMCY + (uint32_t)n->params.node, bytes, 8, n->now_ns);
}

static void heartbeat(struct sim_node *n, uint8_t state, int64_t t_ns)
{
	sim_node_send(n, CANOPEN_HEARTBEAT + (uint32_t)n->params.node, &state, 1, t_ns);
}

/* It starts, from the power switch or because NMT says so. */
static void start(struct sim_node *n, int64_t t_ns)
{
	n->state = CANOPEN_BOOT_UP;
	n->boot_ns = t_ns + BOOT_NS;
	n->heartbeat_ns = INT64_MAX;
	n->queued = 0;
	n->sdo.kind = SIM_SDO_IDLE;
	n->error_register = 0;
	for (int i = 0; i < SIM_NODE_CONSUMERS; i++)
		n->consumer_ns[i] = INT64_MAX;
}

static void power_on(struct sim_node *n, int64_t t_ns)
{
	n->powered = true;
	n->power_ns = INT64_MAX;
	if (!n->params.keeps)
		sim_node_objects_reset(n);
	if (n->params.kind == SIM_CANOPEN_DRIVE)
		sim_node_drive_boot(n, t_ns);
	else
		sim_node_sensor_boot(n, t_ns);
	start(n, t_ns);
}

static void power_off(struct sim_node *n, int64_t t_ns, int64_t until_ns)
{
	if (n->powered) {
		n->counts.power_cycles++;
		if (n->params.kind == SIM_CANOPEN_DRIVE)
			sim_node_drive_off(n, t_ns);
	}
	n->powered = false;
	n->queued = 0;
	n->power_ns = until_ns;
}

static void booted(struct sim_node *n, int64_t t_ns)
{
	int64_t period_ns = sim_node_value(n, 0x1017, 0) * MS;

	n->state = CANOPEN_PREOPERATIONAL;
	heartbeat(n, 0, t_ns);
	n->heartbeat_ns = period_ns ? t_ns + period_ns : INT64_MAX;
}

static void beat(struct sim_node *n, int64_t t_ns)
{
	int64_t period_ns = sim_node_value(n, 0x1017, 0) * MS;

	n->heartbeat_ns = period_ns ? t_ns + period_ns : INT64_MAX;
	if (!sim_fault_due(&n->fault[SIM_FAULT_HEARTBEAT]))
		heartbeat(n, (uint8_t)n->state, t_ns);
}

static int64_t watch_ns(const struct sim_node *n, int consumer)
{
	return (sim_node_value(n, 0x1016, (uint8_t)(consumer + 1)) & 0xffff) * MS;
}

/* Whom it watches is not heard any more. */
static void lost(struct sim_node *n, int consumer, int64_t t_ns)
{
	int64_t reaction = sim_node_value(n, 0x1029, 1);
	bool drive = n->params.kind == SIM_CANOPEN_DRIVE;

	n->consumer_ns[consumer] = INT64_MAX;
	n->missing = true;
	if (!drive || sim_node_value(n, 0x6007, 0) != 1)
		sim_node_emergency(n, HEARD_LATE, 0x11);
	if (drive)
		sim_node_drive_abandoned(n, t_ns);
	if (reaction == 2)
		n->state = CANOPEN_STOPPED;
	else if (reaction == 0 && n->state == CANOPEN_OPERATIONAL)
		n->state = CANOPEN_PREOPERATIONAL;
}

static void heard(struct sim_node *n, int node, int64_t t_ns)
{
	for (int i = 0; i < SIM_NODE_CONSUMERS; i++) {
		int64_t watched = sim_node_value(n, 0x1016, (uint8_t)(i + 1));

		if ((watched >> 16 & 0x7f) != node || !watch_ns(n, i))
			continue;
		n->consumer_ns[i] = t_ns + watch_ns(n, i);
		if (n->missing && n->error_register && !(n->params.kind == SIM_CANOPEN_DRIVE && n->drive.error))
			sim_node_emergency(n, 0, 0);
		n->missing = false;
	}
}

static void command(struct sim_node *n, uint8_t cmd, int64_t t_ns)
{
	bool drive = n->params.kind == SIM_CANOPEN_DRIVE;

	switch (cmd) {
	case CANOPEN_START:
		if (n->state == CANOPEN_OPERATIONAL)
			break;
		n->state = CANOPEN_OPERATIONAL;
		sim_node_pdo_start(n, t_ns);
		break;
	case CANOPEN_STOP:
		n->state = CANOPEN_STOPPED;
		if (drive)
			sim_node_drive_abandoned(n, t_ns);
		break;
	case CANOPEN_ENTER_PREOPERATIONAL:
		n->state = CANOPEN_PREOPERATIONAL;
		break;
	case CANOPEN_RESET_NODE:
		if (drive)
			sim_node_drive_off(n, t_ns);
		start(n, t_ns);
		break;
	case CANOPEN_RESET_COMMUNICATION:
		if (drive)
			sim_node_drive_abandoned(n, t_ns);
		start(n, t_ns);
		break;
	}
}

/* A frame of somebody else. */
static void hear(struct sim_node *n, const struct can_frame_at *frame, int64_t heard_ns, int64_t t_ns)
{
	bool talks = n->state == CANOPEN_PREOPERATIONAL || n->state == CANOPEN_OPERATIONAL;
	uint32_t node = (uint32_t)n->params.node;

	if (frame->id > 0x7ff || frame->flags & CAN_WIRE_FD || n->state == CANOPEN_BOOT_UP)
		return; /* extended, remote, an error */
	if (frame->id == CANOPEN_NMT) {
		if (frame->len >= 2 && (frame->data[1] == 0 || frame->data[1] == node))
			command(n, frame->data[0], t_ns);
	} else if (frame->id == (sim_node_value(n, 0x1005, 0) & 0x7ff)) {
		sim_node_pdo_sync(n, heard_ns, t_ns);
	} else if (frame->id == CANOPEN_SDO_REQUEST + node) {
		if (talks)
			sim_node_sdo_request(n, frame->data, frame->len, t_ns);
	} else if (frame->id > CANOPEN_HEARTBEAT && frame->len >= 1) {
		heard(n, (int)(frame->id - CANOPEN_HEARTBEAT), t_ns);
	} else if (n->state == CANOPEN_OPERATIONAL) {
		sim_node_pdo_received(n, frame, t_ns);
	}
}

static int64_t earlier(int64_t a, int64_t b)
{
	return a < b ? a : b;
}

/* When something is to be done, frames that leave apart. */
static int64_t due_ns(const struct sim_node *n)
{
	int64_t due = INT64_MAX;

	if (!n->powered)
		return n->power_ns;
	if (n->state == CANOPEN_BOOT_UP)
		return n->boot_ns;
	for (int i = 0; i < SIM_NODE_CONSUMERS; i++)
		due = earlier(due, n->consumer_ns[i]);
	due = earlier(due, n->heartbeat_ns);
	due = earlier(due, sim_node_pdo_deadline(n));
	return n->params.kind == SIM_CANOPEN_DRIVE ? earlier(due, sim_node_drive_deadline(n)) : due;
}

static void step(struct sim_node *n, int64_t t_ns)
{
	if (!n->powered) {
		if (n->power_ns <= t_ns)
			power_on(n, t_ns);
		return;
	}
	if (n->state == CANOPEN_BOOT_UP) {
		if (n->boot_ns <= t_ns)
			booted(n, t_ns);
		return;
	}
	for (int i = 0; i < SIM_NODE_CONSUMERS; i++)
		if (n->consumer_ns[i] <= t_ns)
			lost(n, i, t_ns);
	if (n->params.kind == SIM_CANOPEN_DRIVE)
		sim_node_drive_advance(n, t_ns);
	if (n->heartbeat_ns <= t_ns)
		beat(n, t_ns);
	if (sim_node_pdo_deadline(n) <= t_ns)
		sim_node_pdo_events(n, t_ns);
}

static void advance(void *ctx, int64_t t_ns)
{
	struct sim_node *n = ctx;

	for (int i = 0; i < STEPS_MAX && due_ns(n) <= t_ns; i++) {
		if (due_ns(n) > n->now_ns)
			n->now_ns = due_ns(n);
		step(n, n->now_ns);
	}
	if (t_ns > n->now_ns)
		n->now_ns = t_ns;
}

static void receive(void *ctx, const uint8_t *bytes, size_t len, int64_t t_ns)
{
	struct sim_node *n = ctx;
	struct can_frame_at frame;
	ssize_t used;

	for (; (used = can_wire_get(bytes, len, &frame)) > 0; bytes += used, len -= (size_t)used) {
		int64_t heard_ns = frame.t_ns && frame.t_ns < t_ns ? frame.t_ns : t_ns;

		advance(n, heard_ns);
		if (!n->powered)
			continue;
		hear(n, &frame, heard_ns, n->now_ns);
		step(n, n->now_ns);
	}
}

/* The frame that leaves first, -1: none waits. */
static int first(const struct sim_node *n)
{
	int best = -1;

	for (int i = 0; i < n->queued; i++)
		if (best < 0 || n->queue[i].frame.t_ns < n->queue[best].frame.t_ns ||
		    (n->queue[i].frame.t_ns == n->queue[best].frame.t_ns && n->queue[i].order < n->queue[best].order))
			best = i;
	return best;
}

static size_t transmit(void *ctx, uint8_t *buf, size_t cap)
{
	struct sim_node *n = ctx;
	size_t len = 0;

	for (int i; (i = first(n)) >= 0 && n->queue[i].frame.t_ns <= n->now_ns && cap - len >= CAN_WIRE_ENTRY;) {
		len += can_wire_put(&n->queue[i].frame, buf + len);
		n->queue[i] = n->queue[--n->queued];
	}
	return len;
}

static int64_t deadline(void *ctx)
{
	struct sim_node *n = ctx;
	int i = first(n);

	return i < 0 ? due_ns(n) : earlier(due_ns(n), n->queue[i].frame.t_ns);
}

static void connected(void *ctx, bool yes, int64_t t_ns)
{
	(void)ctx, (void)yes, (void)t_ns; /* a bus has no other end */
}

static bool alive(const void *ctx)
{
	return ((const struct sim_node *)ctx)->powered;
}

static void befall_drive(struct sim_node *n, int kind, bool on, int64_t t_ns)
{
	struct sim_fault_state *state = &n->fault[kind];

	if (kind == SIM_FAULT_FAULT && on)
		sim_node_drive_fail(n, (uint16_t)sim_fault_value(state, 0x4310), t_ns);
	else if (kind == SIM_FAULT_SLOW)
		sim_axis_slow(n->axis, on && state->value < 1.0 ? sim_fault_value(state, 0.5) : 1.0, t_ns);
	else if (kind == SIM_FAULT_LIMIT)
		sim_node_drive_limit(n, on, t_ns);
}

static void befall(struct sim_node *n, int kind, bool on, int64_t t_ns)
{
	struct sim_fault_state *state = &n->fault[kind];

	switch (kind) {
	case SIM_FAULT_POWER:
		if (on)
			power_off(n, t_ns, t_ns + (int64_t)(sim_fault_value(state, 1.0) * SECOND));
		break;
	case SIM_FAULT_OFF:
		if (on)
			power_off(n, t_ns, INT64_MAX);
		else if (!n->powered)
			power_on(n, t_ns);
		break;
	case SIM_FAULT_EMCY:
		if (on)
			sim_node_emergency(n, (uint16_t)sim_fault_value(state, 0x8110), 0x11);
		break;
	case SIM_FAULT_STUCK:
		sim_axis_stuck(n->axis, on, t_ns);
		break;
	case SIM_FAULT_MAPPING:
		if (!on)
			break;
		sim_node_mapping_reset(n);
		if (n->state == CANOPEN_OPERATIONAL)
			sim_node_pdo_start(n, t_ns);
		break;
	default:
		if (n->params.kind == SIM_CANOPEN_DRIVE && n->powered)
			befall_drive(n, kind, on, t_ns);
		break;
	}
}

static const char *const *kinds_of(const struct sim_node *n)
{
	return n->params.kind == SIM_CANOPEN_DRIVE ? kinds : sensor_kinds;
}

static bool fault(void *ctx, const struct sim_fault *ordered, bool on, int64_t t_ns)
{
	struct sim_node *n = ctx;
	int kind = sim_fault_index(kinds, ordered->kind);

	if (sim_fault_index(kinds_of(n), ordered->kind) < 0)
		return false;
	advance(n, t_ns);
	sim_fault_set(&n->fault[kind], ordered, on);
	befall(n, kind, on, n->now_ns);
	return true;
}

static void counts(const void *ctx, struct sim_counts *ret)
{
	*ret = ((const struct sim_node *)ctx)->counts;
}

static void destroy(void *ctx)
{
	free(ctx);
}

int sim_canopen_create(const struct sim_canopen_params *params, int64_t t_ns, struct sim_device *ret)
{
	struct sim_node *n;

	if (params->node < 1 || params->node > CANOPEN_NODE_MAX || params->kind > SIM_CANOPEN_INCLINOMETER)
		return -EINVAL;
	n = calloc(1, sizeof *n);
	if (!n)
		return -ENOMEM;
	n->params = *params;
	if (n->params.count_rad == 0.0)
		n->params.count_rad = 0.001 * TRIG_DEG;
	if (n->params.sign == 0)
		n->params.sign = 1;
	if (n->params.switch_rad[0] == n->params.switch_rad[1]) {
		n->params.switch_rad[0] = -90.0 * TRIG_DEG;
		n->params.switch_rad[1] = 90.0 * TRIG_DEG;
	}
	n->axis = params->axis ? params->axis : &n->own;
	if (!params->axis)
		sim_axis_init(&n->own, params->angle_rad, t_ns);
	n->now_ns = t_ns;
	n->random = params->seed;
	sim_node_objects_init(n);
	power_on(n, t_ns);
	*ret = (struct sim_device){.ctx = n,
	                           .receive = receive,
	                           .advance = advance,
	                           .transmit = transmit,
	                           .deadline = deadline,
	                           .connected = connected,
	                           .alive = alive,
	                           .fault = fault,
	                           .fault_kinds = kinds_of(n),
	                           .counts = counts,
	                           .destroy = destroy};
	return 0;
}

struct sim_axis *sim_canopen_axis(const struct sim_device *device)
{
	return ((struct sim_node *)device->ctx)->axis;
}

int sim_canopen_status_word(const struct sim_device *device)
{
	const struct sim_node *n = device->ctx;

	return n->params.kind == SIM_CANOPEN_DRIVE ? sim_node_drive_status(n, n->now_ns) : -1;
}

int sim_canopen_nmt_state(const struct sim_device *device)
{
	const struct sim_node *n = device->ctx;

	return n->powered ? (int)n->state : 0;
}

/* The object dictionary of a simulated node (CiA 301, 402, 406, 410).
 *
 * Tables say what there is: type, access, whether it can be mapped, the factory's value and the range. What is measured
 * is kept nowhere: reading asks the part of the node that knows. A write is judged in the order of the standard: does the
 * object exist (its caller knows), may it be written, does the value fit, does the node's state allow it. Then it is
 * kept and the part that it belongs to is told.
 *
 * From the factory a drive's process data are the profile's (statusword by event, position in a PDO of its own) and no
 * sensor sends its position, unless `factory` asks for the profile's mapping: so whoever sets it up has to write. */
#include "tools/sim_node.h"

#include <math.h>
#include <string.h>

#include "core/trig.h"

#define ANY 0, 0 /* range */

static const struct sim_node_object common[] = {
    {0x1000, 0, SIM_U32, SIM_R, 0, ANY, NULL}, /* by the kind */
    {0x1001, 0, SIM_U8, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x1003, 0, SIM_U8, SIM_RW, 0, ANY, NULL},
    {0x1003, 1, SIM_U32, SIM_R, 0, ANY, NULL},
    {0x1005, 0, SIM_U32, SIM_RW, CANOPEN_SYNC, ANY, NULL},
    {0x1006, 0, SIM_U32, SIM_RW, 0, ANY, NULL},
    {0x1008, 0, SIM_TEXT, SIM_R, 0, ANY, NULL},
    {0x1009, 0, SIM_TEXT, SIM_R, 0, ANY, "B2"},
    {0x100A, 0, SIM_TEXT, SIM_R, 0, ANY, "simulated 1.0"},
    {0x1014, 0, SIM_U32, SIM_R, 0, ANY, NULL}, /* 80 + node */
    {0x1016, 0, SIM_U8, SIM_R, SIM_NODE_CONSUMERS, ANY, NULL},
    {0x1016, 1, SIM_U32, SIM_RW, 0, 0, 0x7fffff, NULL},
    {0x1016, 2, SIM_U32, SIM_RW, 0, 0, 0x7fffff, NULL},
    {0x1017, 0, SIM_U16, SIM_RW, 0, ANY, NULL},
    {0x1018, 0, SIM_U8, SIM_R, 4, ANY, NULL},
    {0x1018, 1, SIM_U32, SIM_R, 0x7fe, ANY, NULL},
    {0x1018, 2, SIM_U32, SIM_R, 0, ANY, NULL}, /* the profile's number */
    {0x1018, 3, SIM_U32, SIM_R, 0x10000, ANY, NULL},
    {0x1018, 4, SIM_U32, SIM_R, 0, ANY, NULL}, /* the node's id */
    {0x1029, 0, SIM_U8, SIM_R, 1, ANY, NULL},
    {0x1029, 1, SIM_U8, SIM_RW, 0, 0, 2, NULL},
    {0x2000, 0, SIM_TEXT, SIM_RW, 0, ANY, NULL},
};

/* Speeds and accelerations are in counts (a thousandth of a degree, if nothing else was asked for) and seconds. */
static const struct sim_node_object drive[] = {
    {0x6007, 0, SIM_I16, SIM_RW, 0, 0, 3, NULL},
    {0x603F, 0, SIM_U16, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x6040, 0, SIM_U16, SIM_RW | SIM_RX, 0, ANY, NULL},
    {0x6041, 0, SIM_U16, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x605A, 0, SIM_I16, SIM_RW, 2, 0, 8, NULL},
    {0x605B, 0, SIM_I16, SIM_RW, 0, 0, 1, NULL},
    {0x605C, 0, SIM_I16, SIM_RW, 1, 0, 1, NULL},
    {0x605D, 0, SIM_I16, SIM_RW, 1, 1, 4, NULL},
    {0x605E, 0, SIM_I16, SIM_RW, 2, 0, 4, NULL},
    {0x6060, 0, SIM_I8, SIM_RW | SIM_RX, 0, ANY, NULL},
    {0x6061, 0, SIM_I8, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x6062, 0, SIM_I32, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x6063, 0, SIM_I32, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x6064, 0, SIM_I32, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x6065, 0, SIM_U32, SIM_RW, 5000, ANY, NULL},
    {0x6066, 0, SIM_U16, SIM_RW, 10, ANY, NULL},
    {0x6067, 0, SIM_U32, SIM_RW, 20, ANY, NULL},
    {0x6068, 0, SIM_U16, SIM_RW, 0, ANY, NULL},
    {0x606C, 0, SIM_I32, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x6072, 0, SIM_U16, SIM_R, 1000, ANY, NULL},
    {0x6077, 0, SIM_I16, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x6078, 0, SIM_I16, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x6079, 0, SIM_U32, SIM_R | SIM_TX, 48000, ANY, NULL},
    {0x607A, 0, SIM_I32, SIM_RW | SIM_RX, 0, ANY, NULL},
    {0x607C, 0, SIM_I32, SIM_RW, 0, ANY, NULL},
    {0x607D, 0, SIM_U8, SIM_R, 2, ANY, NULL},
    {0x607D, 1, SIM_I32, SIM_RW, INT32_MIN, ANY, NULL},
    {0x607D, 2, SIM_I32, SIM_RW, INT32_MAX, ANY, NULL},
    {0x607E, 0, SIM_U8, SIM_RW, 0, 0, 0, NULL},
    {0x607F, 0, SIM_U32, SIM_RW | SIM_RX, 90000, ANY, NULL},
    {0x6081, 0, SIM_U32, SIM_RW | SIM_RX, 5000, ANY, NULL},
    {0x6082, 0, SIM_U32, SIM_RW, 0, ANY, NULL},
    {0x6083, 0, SIM_U32, SIM_RW | SIM_RX, 100000, 1, UINT32_MAX, NULL},
    {0x6084, 0, SIM_U32, SIM_RW | SIM_RX, 100000, 1, UINT32_MAX, NULL},
    {0x6085, 0, SIM_U32, SIM_RW, 1000000, 1, UINT32_MAX, NULL},
    {0x6086, 0, SIM_I16, SIM_RW, 0, ANY, NULL},
    {0x608F, 0, SIM_U8, SIM_R, 2, ANY, NULL},
    {0x608F, 1, SIM_U32, SIM_R, 360000, ANY, NULL},
    {0x608F, 2, SIM_U32, SIM_R, 1, ANY, NULL},
    {0x6098, 0, SIM_I8, SIM_RW, 0, ANY, NULL},
    {0x6099, 0, SIM_U8, SIM_R, 2, ANY, NULL},
    {0x6099, 1, SIM_U32, SIM_RW, 5000, ANY, NULL},
    {0x6099, 2, SIM_U32, SIM_RW, 1000, ANY, NULL},
    {0x609A, 0, SIM_U32, SIM_RW, 100000, 1, UINT32_MAX, NULL},
    {0x60C2, 0, SIM_U8, SIM_R, 2, ANY, NULL},
    {0x60C2, 1, SIM_U8, SIM_RW, 1, 1, 255, NULL},
    {0x60C2, 2, SIM_I8, SIM_RW, -3, -6, 0, NULL},
    {0x60C5, 0, SIM_U32, SIM_RW, 10000000, 1, UINT32_MAX, NULL},
    {0x60F4, 0, SIM_I32, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x60FD, 0, SIM_U32, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x60FE, 0, SIM_U8, SIM_R, 2, ANY, NULL},
    {0x60FE, 1, SIM_U32, SIM_R, 0, ANY, NULL},
    {0x60FE, 2, SIM_U32, SIM_R, 0, ANY, NULL},
    {0x60FF, 0, SIM_I32, SIM_RW | SIM_RX, 0, ANY, NULL},
    {0x6502, 0, SIM_U32, SIM_R, 0xa5, ANY, NULL}, /* pp, pv, homing, csp */
};

static const struct sim_node_object encoder[] = {
    {0x6000, 0, SIM_U16, SIM_RW, 0, 0, 7, NULL},
    {0x6001, 0, SIM_U32, SIM_RW, 360000, 1, 0x7fffffff, NULL},
    {0x6002, 0, SIM_U32, SIM_RW, 360000LL * 4096, 1, UINT32_MAX, NULL},
    {0x6003, 0, SIM_U32, SIM_RW, 0, ANY, NULL},
    {0x6004, 0, SIM_U32, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x6030, 0, SIM_U8, SIM_R, 1, ANY, NULL},
    {0x6030, 1, SIM_I16, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x6200, 0, SIM_U16, SIM_RW, 0, ANY, NULL},
    {0x6500, 0, SIM_U16, SIM_R, 0, ANY, NULL},
    {0x6501, 0, SIM_U32, SIM_R, 360000, ANY, NULL},
    {0x6502, 0, SIM_U16, SIM_R, 4096, ANY, NULL},
    {0x6503, 0, SIM_U16, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x6505, 0, SIM_U16, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x650B, 0, SIM_U32, SIM_R, 0, ANY, NULL},
};

static const struct sim_node_object inclinometer[] = {
    {0x6000, 0, SIM_U16, SIM_RW, 10, 1, 1000, NULL},    {0x6010, 0, SIM_I16, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x6011, 0, SIM_U8, SIM_RW, 0, 0, 3, NULL},         {0x6012, 0, SIM_I16, SIM_RW, 0, ANY, NULL},
    {0x6013, 0, SIM_I16, SIM_R, 0, ANY, NULL},          {0x6014, 0, SIM_I16, SIM_RW, 0, ANY, NULL},
    {0x6020, 0, SIM_I16, SIM_R | SIM_TX, 0, ANY, NULL}, {0x6021, 0, SIM_U8, SIM_RW, 0, 0, 3, NULL},
    {0x6022, 0, SIM_I16, SIM_RW, 0, ANY, NULL},         {0x6023, 0, SIM_I16, SIM_R, 0, ANY, NULL},
    {0x6024, 0, SIM_I16, SIM_RW, 0, ANY, NULL},         {0x6110, 0, SIM_I32, SIM_R | SIM_TX, 0, ANY, NULL},
    {0x6120, 0, SIM_I32, SIM_R | SIM_TX, 0, ANY, NULL},
};

/* What a kind maps from the factory. */
struct mapping {
	bool receive, off;
	uint8_t pdo, type;
	uint32_t entry[2];
};
static const struct mapping drive_mapping[] = {
    {false, false, 0, 255, {0x60410010}},
    {false, false, 1, 255, {0x60410010, 0x60610008}},
    {false, true, 2, 255, {0x60410010, 0x60640020}},
    {false, true, 3, 255, {0x60410010, 0x606C0020}},
    {true, false, 0, 255, {0x60400010}},
    {true, false, 1, 255, {0x60400010, 0x60600008}},
    {true, true, 2, 255, {0x60400010, 0x607A0020}},
    {true, true, 3, 255, {0x60400010, 0x60FF0020}},
};
static const struct mapping encoder_mapping[] = {
    {false, false, 0, 254, {0x60040020}},
    {false, false, 1, 1, {0x60040020}},
};
static const struct mapping encoder_other[] = {
    {false, false, 0, 254, {0x65030010}},
    {false, true, 1, 1, {0x60300110}},
};
static const struct mapping inclinometer_mapping[] = {{false, false, 0, 1, {0x60100010, 0x60200010}}};
static const struct mapping inclinometer_other[] = {{false, false, 0, 255, {0x60200010}}};

static const uint8_t bytes[] = {1, 1, 2, 2, 4, 4, 0};

static void add(struct sim_node *n, const struct sim_node_object *object)
{
	int i = n->objects++;

	for (; i > 0 && (n->object[i - 1].index << 8 | n->object[i - 1].sub) > (object->index << 8 | object->sub); i--)
		n->object[i] = n->object[i - 1];
	n->object[i] = *object;
}

static void add_all(struct sim_node *n, const struct sim_node_object *table, size_t len)
{
	for (size_t i = 0; i < len; i++)
		add(n, &table[i]);
}

static void add_pdo(struct sim_node *n, bool receive, int pdo)
{
	uint16_t how = (uint16_t)((receive ? 0x1400 : 0x1800) + pdo), what = (uint16_t)(how + 0x200);
	uint32_t cob = (uint32_t)((receive ? CANOPEN_RPDO : CANOPEN_TPDO) + 0x100 * pdo + n->params.node);

	add(n, &(struct sim_node_object){how, 0, SIM_U8, SIM_R, receive ? 2 : 5, ANY, NULL});
	add(n, &(struct sim_node_object){how, 1, SIM_U32, SIM_RW, CANOPEN_COB_OFF | cob, ANY, NULL});
	add(n, &(struct sim_node_object){how, 2, SIM_U8, SIM_RW, 255, ANY, NULL});
	if (!receive) {
		add(n, &(struct sim_node_object){how, 3, SIM_U16, SIM_RW, 0, ANY, NULL});
		add(n, &(struct sim_node_object){how, 5, SIM_U16, SIM_RW, 0, ANY, NULL});
	}
	for (int i = 0; i <= SIM_NODE_MAPPED; i++)
		add(n, &(struct sim_node_object){what, (uint8_t)i, i ? SIM_U32 : SIM_U8, SIM_RW, 0, ANY, NULL});
}

static struct sim_node_object *object_of(struct sim_node *n, uint16_t index, uint8_t sub)
{
	return &n->object[sim_node_find(n, index, sub, NULL)];
}

/* Sensors have no remote requests: their COB-ids say so, and insist on it. */
static void map(struct sim_node *n, const struct mapping *m, size_t len)
{
	for (size_t i = 0; i < len; i++) {
		uint16_t how = (uint16_t)((m[i].receive ? 0x1400 : 0x1800) + m[i].pdo), what = (uint16_t)(how + 0x200);

		if (!m[i].off)
			object_of(n, how, 1)->value &= ~(int64_t)CANOPEN_COB_OFF;
		object_of(n, how, 2)->value = m[i].type;
		for (uint8_t k = 0; k < 2 && m[i].entry[k]; k++) {
			object_of(n, what, 0)->value = k + 1;
			object_of(n, what, (uint8_t)(k + 1))->value = m[i].entry[k];
		}
	}
	for (int i = 0; n->params.kind != SIM_CANOPEN_DRIVE && i < SIM_NODE_PDOS; i++)
		object_of(n, (uint16_t)(0x1800 + i), 1)->value |= CANOPEN_COB_NO_RTR;
}

#define COUNT(table) (sizeof(table) / sizeof *(table))

static void describe(struct sim_node *n, uint16_t profile, uint32_t type, const char *name)
{
	object_of(n, 0x1000, 0)->value = type;
	object_of(n, 0x1008, 0)->text = name;
	object_of(n, 0x1014, 0)->value = CANOPEN_EMCY + n->params.node;
	object_of(n, 0x1018, 2)->value = profile;
	object_of(n, 0x1018, 4)->value = n->params.node;
}

int sim_node_objects_init(struct sim_node *n)
{
	add_all(n, common, COUNT(common));
	for (int i = 0; i < SIM_NODE_PDOS; i++)
		add_pdo(n, false, i);
	switch (n->params.kind) {
	case SIM_CANOPEN_DRIVE:
		for (int i = 0; i < SIM_NODE_PDOS; i++)
			add_pdo(n, true, i);
		add_all(n, drive, COUNT(drive));
		map(n, drive_mapping, COUNT(drive_mapping));
		describe(n, 402, 0x00020192, "simulated servo drive");
		break;
	case SIM_CANOPEN_ENCODER:
		add_all(n, encoder, COUNT(encoder));
		map(n, n->params.factory ? encoder_mapping : encoder_other, 2);
		describe(n, 406, 0x00020196, "simulated encoder");
		object_of(n, 0x6001, 0)->value = llrint(2.0 * TRIG_PI / n->params.count_rad);
		break;
	case SIM_CANOPEN_INCLINOMETER:
		add_all(n, inclinometer, COUNT(inclinometer));
		map(n, n->params.factory ? inclinometer_mapping : inclinometer_other, 1);
		describe(n, 410, 0x0002019A, "simulated inclinometer");
		break;
	default:
		return -1;
	}
	sim_node_objects_reset(n);
	return 0;
}

void sim_node_objects_reset(struct sim_node *n)
{
	for (int i = 0; i < n->objects; i++)
		n->value[i] = n->object[i].value;
	strcpy(n->text, "no name");
}

void sim_node_mapping_reset(struct sim_node *n)
{
	for (int i = 0; i < n->objects; i++)
		if (n->object[i].index >= 0x1400 && n->object[i].index < 0x1C00)
			n->value[i] = n->object[i].value;
}

int sim_node_find(const struct sim_node *n, uint16_t index, uint8_t sub, bool *ret_index)
{
	int low = 0, high = n->objects, key = index << 8 | sub;

	while (low < high) {
		int middle = (low + high) / 2;

		if ((n->object[middle].index << 8 | n->object[middle].sub) < key)
			low = middle + 1;
		else
			high = middle;
	}
	if (ret_index)
		*ret_index = (low < n->objects && n->object[low].index == index) ||
		             (low > 0 && n->object[low - 1].index == index);
	return low < n->objects && n->object[low].index == index && n->object[low].sub == sub ? low : -1;
}

int sim_node_bytes(const struct sim_node *n, int object)
{
	return bytes[n->object[object].type];
}

int64_t sim_node_value(const struct sim_node *n, uint16_t index, uint8_t sub)
{
	int i = sim_node_find(n, index, sub, NULL);

	return i < 0 ? 0 : n->value[i];
}

void sim_node_set(struct sim_node *n, uint16_t index, uint8_t sub, int64_t value)
{
	int i = sim_node_find(n, index, sub, NULL);

	if (i >= 0)
		n->value[i] = value;
}

int64_t sim_node_measure(const struct sim_node *n, int object, int64_t t_ns)
{
	const struct sim_node_object *o = &n->object[object];

	if (o->index == 0x1001)
		return n->error_register;
	if (o->index < 0x6000 || (o->index == 0x6030 && o->sub == 0))
		return n->value[object];
	if (n->params.kind == SIM_CANOPEN_DRIVE)
		return sim_node_drive_measure(n, o->index, t_ns, n->value[object]);
	return sim_node_sensor_measure(n, o->index, t_ns, n->value[object]);
}

static uint32_t judge(const struct sim_node *n, const struct sim_node_object *o, int64_t value, int64_t t_ns)
{
	if (!(o->access & SIM_W))
		return CANOPEN_ABORT_READ_ONLY;
	if (o->low != o->high && value > o->high)
		return SIM_NODE_TOO_HIGH;
	if (o->low != o->high && value < o->low)
		return SIM_NODE_TOO_LOW;
	if (o->index == 0x1003 && value != 0)
		return CANOPEN_ABORT_RANGE;
	if (o->index >= 0x1400 && o->index < 0x1C00)
		return sim_node_pdo_judge(n, o, value);
	if (o->index < 0x6000)
		return 0;
	if (n->params.kind == SIM_CANOPEN_DRIVE)
		return sim_node_drive_judge(n, o, value);
	return sim_node_sensor_judge(n, o, value, t_ns);
}

uint32_t sim_node_write(struct sim_node *n, int object, int64_t value, int64_t t_ns)
{
	const struct sim_node_object *o = &n->object[object];
	uint32_t refused = judge(n, o, value, t_ns);

	if (refused)
		return refused;
	n->value[object] = value;
	if (o->index == 0x1003)
		sim_node_set(n, 0x1003, 1, 0);
	else if (o->index == 0x1016)
		n->consumer_ns[o->sub - 1] = INT64_MAX; /* it begins with the next heartbeat it hears */
	else if (o->index == 0x1017)
		n->heartbeat_ns = value ? t_ns : INT64_MAX;
	else if (o->index >= 0x1400 && o->index < 0x1C00)
		sim_node_pdo_written(n, o, t_ns);
	else if (o->index >= 0x6000 && n->params.kind == SIM_CANOPEN_DRIVE)
		sim_node_drive_written(n, o, t_ns);
	else if (o->index >= 0x6000)
		sim_node_sensor_written(n, o, t_ns);
	return 0;
}

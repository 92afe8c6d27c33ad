/* Simulated sensors: a multi-turn encoder (CiA 406) and an inclinometer of two axes (CiA 410).
 *
 * The encoder counts modulo its total range (6002), so below angle 0 it stands near the top. Bit 0 of 6000 turns its
 * direction round; writing 6003 makes that its position, only while it stands. Its cyclic timer (6200) is the event timer
 * of its first PDO. The inclinometer's slopes are in units of 6000 (a thousandth of a degree, times 1, 10, 100 or
 * 1000), and what does not fit into 16 bits stays at their end; a preset shows in the offset, which is subtracted. */
#include "tools/sim_node.h"

#include <math.h>

#include "core/trig.h"

#define LATERAL_RAD (1.2 * TRIG_DEG) /* how the axis that nothing moves hangs */

/* Counts without wrap and preset. */
static double counts(const struct sim_node *n, int64_t t_ns)
{
	double per_turn = (double)sim_node_value(n, 0x6001, 0), angle = sim_axis_angle(n->axis, t_ns) * n->params.sign;
	bool back = sim_node_value(n, 0x6000, 0) & 1;

	if (sim_node_value(n, 0x6000, 0) & 4)
		return (back ? -angle : angle) / (2.0 * TRIG_PI) * per_turn;
	return (back ? -angle : angle) / n->params.count_rad;
}

static int64_t encoder_position(const struct sim_node *n, int64_t t_ns)
{
	int64_t range = sim_node_value(n, 0x6002, 0), at = llrint(counts(n, t_ns) + n->preset) % range;

	return at < 0 ? at + range : at;
}

static double slope_deg(const struct sim_node *n, bool lateral, int64_t t_ns)
{
	double angle = lateral == n->params.lateral ? sim_axis_angle(n->axis, t_ns) * n->params.sign : LATERAL_RAD;

	if (sim_node_value(n, lateral ? 0x6021 : 0x6011, 0) & 1)
		angle = -angle;
	return angle / TRIG_DEG;
}

static double unit_deg(const struct sim_node *n)
{
	return (double)sim_node_value(n, 0x6000, 0) * 0.001;
}

/* Scaling (bit 1 of the operating parameters) is what applies the offsets. */
static int64_t slope(const struct sim_node *n, bool lateral, int64_t t_ns)
{
	uint16_t at = lateral ? 0x6021 : 0x6011;
	int64_t raw = llrint(slope_deg(n, lateral, t_ns) / unit_deg(n));

	if (!(sim_node_value(n, at, 0) & 2))
		return raw;
	return raw - sim_node_value(n, (uint16_t)(at + 2), 0) - sim_node_value(n, (uint16_t)(at + 3), 0);
}

void sim_node_sensor_boot(struct sim_node *n, int64_t t_ns)
{
	(void)t_ns;
	if (!n->params.keeps)
		n->preset = 0.0;
}

uint32_t sim_node_sensor_judge(const struct sim_node *n, const struct sim_node_object *o, int64_t value, int64_t t_ns)
{
	if (n->params.kind == SIM_CANOPEN_INCLINOMETER) {
		if (o->index == 0x6000 && value != 1 && value != 10 && value != 100 && value != 1000)
			return CANOPEN_ABORT_RANGE;
		return 0;
	}
	if (o->index == 0x6003 && sim_axis_speed(n->axis, t_ns) != 0.0)
		return CANOPEN_ABORT_STATE;
	if (o->index == 0x6003 && value >= sim_node_value(n, 0x6002, 0))
		return SIM_NODE_TOO_HIGH;
	return 0;
}

void sim_node_sensor_written(struct sim_node *n, const struct sim_node_object *o, int64_t t_ns)
{
	if (n->params.kind == SIM_CANOPEN_ENCODER && o->index == 0x6003) {
		n->preset = (double)sim_node_value(n, 0x6003, 0) - counts(n, t_ns);
	} else if (n->params.kind == SIM_CANOPEN_ENCODER && o->index == 0x6200) {
		int timer = sim_node_find(n, 0x1800, 5, NULL);

		sim_node_write(n, timer, sim_node_value(n, 0x6200, 0), t_ns);
	} else if (o->index == 0x6012 || o->index == 0x6022) {
		bool lateral = o->index == 0x6022;
		int64_t raw = llrint(slope_deg(n, lateral, t_ns) / unit_deg(n));

		sim_node_set(n, (uint16_t)(o->index + 1), 0, raw - sim_node_value(n, o->index, 0));
	}
}

static int64_t narrow(int64_t v)
{
	return v > INT16_MAX ? INT16_MAX : v < INT16_MIN ? INT16_MIN : v;
}

int64_t sim_node_sensor_measure(const struct sim_node *n, uint16_t index, int64_t t_ns, int64_t value)
{
	if (n->params.kind == SIM_CANOPEN_ENCODER) {
		if (index == 0x6004)
			return encoder_position(n, t_ns);
		if (index == 0x6030)
			return narrow(llrint(sim_axis_speed(n->axis, t_ns) * n->params.sign / n->params.count_rad));
		return value;
	}
	switch (index) {
	case 0x6010:
		return narrow(slope(n, false, t_ns));
	case 0x6020:
		return narrow(slope(n, true, t_ns));
	case 0x6110:
		return slope(n, false, t_ns);
	case 0x6120:
		return slope(n, true, t_ns);
	}
	return value;
}

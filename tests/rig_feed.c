/* What the rig feeds where no simulated device stands: the servo's angle every 5 ms, as a Modbus transaction of 2 ms, and
 * the pose, as a line. */
#include "drivers/modbus_wire.h"
#include "drivers/pose_line.h"
#include "tests/rig_parts.h"

#define TILT_NS     (5 * RIG_MS)
#define TILT_RTT_NS (2 * RIG_MS)

static void hand(struct rig *r, int device, const uint8_t *bytes, size_t len)
{
	struct record record = {.log_ns = r->now_ns, .t_ns = r->now_ns, .device = device, .bytes = bytes, .len = len};

	rig_handle(r, &record);
}

static void feed_tilt(struct rig *r)
{
	const struct config_device *servo = &r->config.device[r->servo];
	uint8_t bytes[MODBUS_WIRE_MAX];
	int64_t middle_ns;
	struct modbus_transaction t = {.t_answer_ns = r->now_ns, .unit = (uint8_t)servo->slave};

	if (r->tilt_late_ns == INT64_MAX)
		return;
	t.t_answer_ns -= r->tilt_late_ns;
	t.t_request_ns = t.t_answer_ns - TILT_RTT_NS;
	middle_ns = t.t_request_ns + TILT_RTT_NS / 2;
	t.function = modbus_wire_read_function(&servo->position);
	t.address = modbus_wire_address(servo, servo->position.address);
	t.n = (uint16_t)modbus_wire_registers(&servo->position);
	if (modbus_wire_encode(&servo->position, rig_tilt(r, middle_ns), t.value) < 0)
		rig_give_up("the servo's register cannot hold the angle");
	hand(r, r->servo, bytes, modbus_wire_put(&t, bytes));
}

static void feed_pose(struct rig *r)
{
	struct pose pose = rig_place(r, (r->now_ns - RIG_EPOCH_NS) / RIG_POSE_NS);
	char line[POSE_LINE_MAX];
	int n;

	pose.t_ns = r->now_ns + r->ahead_ns;
	n = pose_line_print(&pose, line, sizeof(line));
	hand(r, r->localisation, (const uint8_t *)line, (size_t)n);
}

void rig_feed(struct rig *r)
{
	if (r->servo >= 0 && r->now_ns >= r->tilt_ns) {
		feed_tilt(r);
		r->tilt_ns += TILT_NS;
	}
	if (r->localisation >= 0 && r->now_ns >= r->pose_ns) {
		if (!r->no_poses)
			feed_pose(r);
		r->pose_ns += r->pose_period_ns;
	}
}

int64_t rig_feed_due(const struct rig *r)
{
	int64_t next_ns = INT64_MAX;

	if (r->servo >= 0)
		next_ns = r->tilt_ns;
	if (r->localisation >= 0)
		next_ns = rig_earlier(next_ns, r->pose_ns);
	return next_ns;
}

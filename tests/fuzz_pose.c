/* Law L8: no datagram crashes the pose reader or gives a pose that is not sane; what it accepts can be said again. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>

#include "drivers/driver.h"
#include "drivers/pose_line.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

#define T0 INT64_C(1732200000500000000)

static void must(bool condition)
{
	if (!condition)
		abort();
}

static void judge(void *ctx, int device, const struct pose *pose)
{
	const struct quat *q = &pose->rotation;
	char line[POSE_LINE_MAX];
	struct pose back;
	int n = pose_line_print(pose, line, sizeof line);

	(void)ctx;
	(void)device;
	must(fabs(pose->position_m.x) <= POSE_LINE_FAR_M && fabs(pose->position_m.y) <= POSE_LINE_FAR_M &&
	     fabs(pose->position_m.z) <= POSE_LINE_FAR_M);
	must(fabs(q->w * q->w + q->x * q->x + q->y * q->y + q->z * q->z - 1.0) < 1e-12);
	must(llabs(pose->t_ns - T0) <= POSE_LINE_LATE_NS + 1000);
	must(pose->variance_m2 >= 0 && pose->variance_m2 <= 2.1e12 && pose->variance_rad2 >= 0 && !pose->jumped);
	must(n > 0);
	/* The larger axis of two that are just small enough need not be. */
	must(pose_line_parse(line, (size_t)n, pose->t_ns, &back) == POSE_LINE_OK || pose->variance_m2 > 1e12);
	if (pose->variance_m2 > 1e12)
		return;
	must(back.variance_m2 == pose->variance_m2 && back.variance_rad2 == pose->variance_rad2);
	must(back.position_m.x == pose->position_m.x && back.position_m.y == pose->position_m.y);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static struct decoder *decoder;
	struct config_device device = {.name = "pose"};
	struct record_sink sink = {.pose = judge};
	struct record record = {.t_ns = T0, .bytes = data, .len = size};
	struct decoder_counters counters;

	if (!decoder)
		decoder = driver_pose.decoder_create(&device, 0);
	driver_pose.decode(decoder, &record, &sink);
	driver_pose.counters(decoder, &counters);
	must(counters.n == POSE_LINE_VERDICTS);
	return 0;
}

/* A line a millisecond. Lines are a little late, because a servo in a thread of its own may still be told what was asked of
 * it a moment ago. A machine that stalled makes up for what it missed, as far as the axis remembers. */
#include "tools/scenario_truth.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"

#define STEP_NS INT64_C(1000000)
#define LATE_NS INT64_C(20000000)
#define PAST_NS INT64_C(5000000000) /* what is older is left out */

struct scenario_truth {
	FILE *file;
	int64_t next_ns;
};

struct scenario_truth *scenario_truth_create(const char *path, int64_t t_ns, char error[SCENARIO_ERROR_MAX])
{
	struct scenario_truth *truth = calloc(1, sizeof *truth);

	if (truth)
		truth->file = fopen(path, "we");
	if (truth && truth->file) {
		truth->next_ns = t_ns;
		return truth;
	}
	snprintf(error, SCENARIO_ERROR_MAX, "--truth %.200s: %s", path, strerror(truth ? errno : ENOMEM));
	free(truth);
	return NULL;
}

void scenario_truth_write(struct scenario_truth *truth, const struct stage_axis *axis, const struct stage *stage,
                          int64_t now_ns, int64_t realtime_ns)
{
	if (truth->next_ns < now_ns - PAST_NS)
		truth->next_ns = now_ns - PAST_NS;
	for (; truth->next_ns < now_ns - LATE_NS; truth->next_ns += STEP_NS) {
		const struct pose pose = stage->pose(stage->ctx, truth->next_ns);
		const struct quat q = pose.rotation;

		fprintf(truth->file, "%lld %.8f %.5f %.5f %.5f %.6f\n", (long long)(truth->next_ns + realtime_ns),
		        -axis->angle(axis->ctx, truth->next_ns), pose.position_m.x, pose.position_m.y,
		        pose.position_m.z,
		        trig_atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z)));
	}
}

void scenario_truth_destroy(struct scenario_truth *truth)
{
	if (!truth)
		return;
	fclose(truth->file);
	free(truth);
}

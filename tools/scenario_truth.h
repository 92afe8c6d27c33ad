/* Where a scenario's axis and robot truly were, as a file for comparison (its lines: scenario.h, `truth`). */
#ifndef FACET_TOOLS_SCENARIO_TRUTH_H
#define FACET_TOOLS_SCENARIO_TRUTH_H

#include "tools/scenario.h"

struct scenario_truth;
/* NULL with one sentence. */
struct scenario_truth *scenario_truth_create(const char *path, int64_t t_ns, char error[SCENARIO_ERROR_MAX]);
/* Everything up to a little before now. `realtime_ns`: CLOCK_REALTIME - our clock. */
void scenario_truth_write(struct scenario_truth *, const struct stage_axis *, const struct stage *, int64_t now_ns,
                          int64_t realtime_ns);
void scenario_truth_destroy(struct scenario_truth *);

#endif

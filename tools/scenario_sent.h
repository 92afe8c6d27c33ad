/* When profiles left the scanner, as a file for whoever measures latency: a line a profile,
 *
 *   SENT MEASURED
 *
 * ns of CLOCK_MONOTONIC: when the write of its telegram's last byte began, and the time of its first beam. */
#ifndef FACET_TOOLS_SCENARIO_SENT_H
#define FACET_TOOLS_SCENARIO_SENT_H

#include "tools/scenario.h"

struct scenario_sent;
/* The scene is listened to from now on: the device is made with it after that. NULL with one sentence. */
struct scenario_sent *scenario_sent_create(const char *path, struct scene *scene, char error[SCENARIO_ERROR_MAX]);
/* Of this device (borrowed), whose scene that is. The same for scenario_sent_note. */
struct scenario_sent *scenario_sent_of(struct scenario_sent *, const struct sim_device *);
void scenario_sent_note(void *sent, int64_t t_ns); /* bytes left it at t_ns */
void scenario_sent_destroy(struct scenario_sent *);

#endif

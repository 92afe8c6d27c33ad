/* What the devices of a replay did, as far as the recording tells: for the status, instead of the supervisor's. */
#ifndef FACET_DAEMON_REPLAY_LINES_H
#define FACET_DAEMON_REPLAY_LINES_H

#include "daemon/replay.h"
#include "daemon/supervisor.h"

struct replay_lines {
	struct supervisor_device line[CONFIG_DEVICES_MAX];
};

void replay_lines_reset(struct replay_lines *);
/* Before the event is fed; EVENTs that say {"class": "DEVICE", "name", "state", "message"} set a state. */
void replay_lines_event(struct replay_lines *, const struct config *, const struct replay_event *);
/* A profile, an angle or a pose was decoded. */
void replay_lines_data(struct replay_lines *, int device, int64_t t_ns);

#endif

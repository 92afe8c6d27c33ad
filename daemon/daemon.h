/* The daemon: one loop that owns devices, pipeline, clients and the worker's results. */
#ifndef FACET_DAEMON_DAEMON_H
#define FACET_DAEMON_DAEMON_H

#include "config/config.h"
#include "daemon/replay.h"

struct daemon_options {
	const char *config_text; /* what the configuration was read from; recordings carry it, without secrets */
	const char *journal;     /* keep what the loop hands to the pipeline in this file; NULL: nowhere */
	/* Play this instead of the devices, none of which is opened; borrowed, told to use the configuration. NULL: none. */
	struct replay *replay;
	double speed;    /* of the replay; 0: max */
	size_t rows_max; /* that may wait for the worker; 0: WORKER_ROWS_MAX */
};

/* Runs until SIGINT or SIGTERM (orderly, within 3 s). 0, or -errno with one sentence. */
int daemon_run(const struct config *, const struct daemon_options *, char error[320]);

#endif

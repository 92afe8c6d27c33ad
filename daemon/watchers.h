/* The descriptors of devices in the loop: who is readable or writable is told, until it is watched no more. */
#ifndef FACET_DAEMON_WATCHERS_H
#define FACET_DAEMON_WATCHERS_H

#include <stdbool.h>
#include <uv.h>

#include "config/config.h"

struct watchers {
	uv_loop_t *loop;
	/* An error on the descriptor counts as readable: reading finds it. */
	void (*ready)(void *ctx, int device, bool readable, bool writable);
	void *ctx;
	struct watcher *of[CONFIG_DEVICES_MAX];
};

/* False where the descriptor cannot be polled (or memory is out). */
bool watchers_watch(struct watchers *, int device, int fd, bool readable, bool writable);
void watchers_leave(struct watchers *, int device); /* before the descriptor is closed */

#endif

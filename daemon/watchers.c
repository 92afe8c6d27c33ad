#include "daemon/watchers.h"

#include <stdlib.h>

/* Freed by libuv's last call. */
struct watcher {
	uv_poll_t poll;
	struct watchers *all;
	int device;
};

static void on_ready(uv_poll_t *poll, int status, int events)
{
	struct watcher *watcher = poll->data;
	struct watchers *all = watcher->all;

	all->ready(all->ctx, watcher->device, status < 0 || (events & UV_READABLE), events & UV_WRITABLE);
	if (status < 0 && all->of[watcher->device] == watcher)
		uv_poll_start(&watcher->poll, UV_READABLE, on_ready);
}

static void on_closed(uv_handle_t *handle)
{
	free(handle->data);
}

void watchers_leave(struct watchers *all, int device)
{
	struct watcher *watcher = all->of[device];

	if (!watcher)
		return;
	all->of[device] = NULL;
	uv_poll_stop(&watcher->poll);
	uv_close((uv_handle_t *)&watcher->poll, on_closed);
}

static struct watcher *make_watcher(struct watchers *all, int device, int fd)
{
	struct watcher *watcher = calloc(1, sizeof(*watcher));

	if (!watcher || uv_poll_init(all->loop, &watcher->poll, fd) < 0) {
		free(watcher);
		return NULL;
	}
	watcher->poll.data = watcher;
	watcher->all = all;
	watcher->device = device;
	return watcher;
}

bool watchers_watch(struct watchers *all, int device, int fd, bool readable, bool writable)
{
	if (!all->of[device])
		all->of[device] = make_watcher(all, device, fd);
	if (!all->of[device])
		return false;
	uv_poll_start(&all->of[device]->poll, (readable ? UV_READABLE : 0) | (writable ? UV_WRITABLE : 0), on_ready);
	return true;
}

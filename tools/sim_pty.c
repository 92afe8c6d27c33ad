/* A simulated serial device behind a pseudo-terminal.
 *
 *   device.transmit -> master | slave -> reader          reader -> slave | master -> device.receive
 *
 * A pseudo-terminal has no rate: this end reads what the host has set (from the master, at every read and before every
 * chunk it writes) and tells the device, which garbles the bytes when it is not its own.
 *
 * The slave is held open here too. So the line outlives its reader (who may close and open it again), it stays raw, and
 * polling it tells whether the reader has taken everything. Unplugged, the line and the link to it are gone; the device
 * runs on, as a scanner does behind its adapter. */
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <termios.h>
#include <unistd.h>

#include "drivers/serial.h"
#include "tools/sim_device.h"

enum { TICK_MS = 1, IDLE_MS = 1000, DRAIN = 64 };

struct sim_pty {
	struct sim_device device;
	uv_loop_t *loop;
	uv_timer_t timer;
	uv_poll_t *poll; /* NULL: unplugged */
	int master, slave;
	char slave_path[64];
	char *link;
	uint8_t out[SIM_TRANSFER_MAX]; /* what the line did not take yet */
	size_t out_len, out_sent;
	void (*wrote)(void *ctx, int64_t t_ns); /* NULL: nobody asks */
	void *wrote_ctx;
};

static const char *const kinds[] = {"unplug", NULL};

/* poll waits for the kernel's thread that passes the bytes on (which a busy machine starves for seconds); FIONREAD does not, and
 * sees nothing directly after a write. */
static void watch_reader(struct sim_pty *pty, int64_t now_ns)
{
	struct pollfd line = {.fd = pty->slave, .events = POLLIN};
	const struct sim_device *device = &pty->device;
	if (device->awaits == NULL || pty->out_len > 0 || !device->awaits(device->ctx) || poll(&line, 1, 0) != 0)
		return;
	device->taken(device->ctx, now_ns);
}

static void tell_baud(struct sim_pty *pty)
{
	uint32_t baud = 0;
	if (pty->device.host_baud != NULL && serial_get_rate(pty->master, &baud) == 0)
		pty->device.host_baud(pty->device.ctx, baud);
}

/* True: the line takes more. */
static bool write_out(struct sim_pty *pty)
{
	const int64_t t_ns = (int64_t)uv_hrtime(); /* who reads may be awake before the write returns */
	const ssize_t n = write(pty->master, pty->out + pty->out_sent, pty->out_len - pty->out_sent);
	if (n > 0)
		pty->out_sent += (size_t)n;
	if (pty->out_sent < pty->out_len)
		return false;
	pty->out_len = pty->out_sent = 0;
	if (pty->wrote != NULL)
		pty->wrote(pty->wrote_ctx, t_ns);
	return true;
}

static void pump(struct sim_pty *pty)
{
	for (int i = 0; i < DRAIN; i++) {
		if (pty->out_len > 0 && !write_out(pty))
			return;
		tell_baud(pty);
		pty->out_len = pty->device.transmit(pty->device.ctx, pty->out, sizeof pty->out);
		if (pty->out_len == 0)
			return;
	}
}

/* Unplugged, what the device says goes nowhere. */
static void discard(struct sim_pty *pty)
{
	for (int i = 0; i < DRAIN && pty->device.transmit(pty->device.ctx, pty->out, sizeof pty->out) > 0; i++)
		;
}

static void on_timer(uv_timer_t *timer);

static void wake(struct sim_pty *pty, int64_t now_ns)
{
	const struct sim_device *device = &pty->device;
	const int64_t deadline_ns = device->deadline(device->ctx);
	int64_t ms = TICK_MS;
	if (pty->out_len == 0 && !(device->awaits != NULL && device->awaits(device->ctx)))
		ms = deadline_ns - now_ns > IDLE_MS * 1000000ll ? IDLE_MS : (deadline_ns - now_ns + 999999) / 1000000;
	uv_update_time(pty->loop);
	uv_timer_start(&pty->timer, on_timer, ms > 0 ? (uint64_t)ms : 0, 0);
}

static void serve(struct sim_pty *pty)
{
	const int64_t now_ns = (int64_t)uv_hrtime();
	pty->device.advance(pty->device.ctx, now_ns);
	if (pty->poll != NULL) {
		pump(pty);
		watch_reader(pty, now_ns);
	} else {
		discard(pty);
	}
	wake(pty, (int64_t)uv_hrtime());
}

static void on_timer(uv_timer_t *timer)
{
	serve(timer->data);
}

static void on_readable(uv_poll_t *handle, int status, int events)
{
	struct sim_pty *pty = handle->data;
	uint8_t bytes[1024];
	(void)status;
	(void)events;
	const ssize_t n = read(pty->master, bytes, sizeof bytes);
	if (n <= 0)
		return;
	tell_baud(pty);
	pty->device.receive(pty->device.ctx, bytes, (size_t)n, (int64_t)uv_hrtime());
	serve(pty);
}

/* Opening and closing */

static int open_pty(struct sim_pty *pty)
{
	struct termios t;
	pty->master = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
	if (pty->master < 0 || grantpt(pty->master) < 0 || unlockpt(pty->master) < 0)
		return -errno;
	if (ptsname_r(pty->master, pty->slave_path, sizeof pty->slave_path) != 0)
		return -errno;
	pty->slave = open(pty->slave_path, O_RDWR | O_NOCTTY | O_CLOEXEC);
	if (pty->slave < 0 || tcgetattr(pty->slave, &t) < 0)
		return -errno;
	cfmakeraw(&t); /* a fresh one echoes */
	return tcsetattr(pty->slave, TCSANOW, &t) < 0 ? -errno : 0;
}

static void close_pty(struct sim_pty *pty)
{
	if (pty->slave >= 0)
		close(pty->slave);
	if (pty->master >= 0)
		close(pty->master);
	pty->master = pty->slave = -1;
}

/* What stands at the path is replaced only if it is a link: an earlier simulator that was killed left it. */
static int make_link(const struct sim_pty *pty)
{
	struct stat st;
	if (lstat(pty->link, &st) == 0 && (!S_ISLNK(st.st_mode) || unlink(pty->link) < 0))
		return -EEXIST;
	return symlink(pty->slave_path, pty->link) < 0 ? -errno : 0;
}

static void remove_link(const struct sim_pty *pty)
{
	char target[sizeof pty->slave_path + 1];
	const ssize_t n = readlink(pty->link, target, sizeof target);
	if (n == (ssize_t)strlen(pty->slave_path) && memcmp(target, pty->slave_path, (size_t)n) == 0)
		unlink(pty->link);
}

static void free_handle(uv_handle_t *handle)
{
	free(handle);
}

static int watch(struct sim_pty *pty)
{
	pty->poll = malloc(sizeof *pty->poll);
	if (pty->poll == NULL)
		return UV_ENOMEM;
	const int r = uv_poll_init(pty->loop, pty->poll, pty->master);
	if (r < 0) {
		free(pty->poll);
		pty->poll = NULL;
		return r;
	}
	pty->poll->data = pty;
	uv_poll_start(pty->poll, UV_READABLE, on_readable);
	return 0;
}

static int plug(struct sim_pty *pty, char error[160])
{
	int r = open_pty(pty);
	if (r < 0) {
		snprintf(error, 160, "cannot make a pseudo-terminal (%s); is /dev/pts mounted?", strerror(-r));
		goto fail;
	}
	r = make_link(pty);
	if (r < 0) {
		snprintf(error, 160, "%.64s: cannot make the link to the simulated line (%s); choose another directory",
		         pty->link, strerror(-r));
		goto fail;
	}
	r = watch(pty);
	if (r < 0) {
		snprintf(error, 160, "cannot watch the simulated line (%s)", uv_strerror(r));
		remove_link(pty);
		goto fail;
	}
	pty->device.connected(pty->device.ctx, true, (int64_t)uv_hrtime());
	return 0;
fail:
	close_pty(pty);
	return r;
}

static void unplug(struct sim_pty *pty)
{
	if (pty->poll == NULL)
		return;
	uv_poll_stop(pty->poll);
	uv_close((uv_handle_t *)pty->poll, free_handle);
	pty->poll = NULL;
	remove_link(pty);
	close_pty(pty);
	pty->out_len = pty->out_sent = 0;
	pty->device.connected(pty->device.ctx, false, (int64_t)uv_hrtime());
}

struct sim_pty *sim_pty_create(uv_loop_t *loop, const char *link, const struct sim_device *device, char error[160])
{
	struct sim_pty *pty = calloc(1, sizeof *pty);
	if (pty == NULL || (pty->link = strdup(link)) == NULL) {
		snprintf(error, 160, "out of memory");
		goto fail;
	}
	pty->device = *device;
	pty->loop = loop;
	if (plug(pty, error) < 0)
		goto fail;
	uv_timer_init(loop, &pty->timer);
	pty->timer.data = pty;
	uv_timer_start(&pty->timer, on_timer, 0, 0);
	return pty;
fail:
	device->destroy(device->ctx);
	if (pty != NULL)
		free(pty->link);
	free(pty);
	return NULL;
}

static void on_closed(uv_handle_t *handle)
{
	struct sim_pty *pty = handle->data;
	free(pty->link);
	free(pty);
}

void sim_pty_destroy(struct sim_pty *pty)
{
	unplug(pty);
	pty->device.destroy(pty->device.ctx);
	uv_close((uv_handle_t *)&pty->timer, on_closed);
}

void sim_pty_watch(struct sim_pty *pty, void (*wrote)(void *ctx, int64_t t_ns), void *ctx)
{
	pty->wrote = wrote;
	pty->wrote_ctx = ctx;
}

const char *const *sim_pty_fault_kinds(void)
{
	return kinds;
}

bool sim_pty_fault(struct sim_pty *pty, const struct sim_fault *fault, bool on)
{
	char error[160];
	if (pty->device.fault(pty->device.ctx, fault, on, (int64_t)uv_hrtime())) {
		serve(pty);
		return true;
	}
	if (strcmp(fault->kind, "unplug") != 0)
		return false;
	if (on)
		unplug(pty);
	if (pty->poll == NULL && (!on || fault->for_ns == 0))
		plug(pty, error); /* fails only where the system has no pseudo-terminals left */
	serve(pty);
	return true;
}

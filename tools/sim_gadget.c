/* The shell of a USB scanner. The kernel hands its endpoints out as files whose reads and writes block, also those that were
 * opened O_NONBLOCK (that only keeps a disabled endpoint from waiting): transfers go through the kernel's own asynchronous
 * interface, whose ends arrive on an eventfd in the loop; no thread. Plugging in and out waits for the kernel's USB core,
 * so it is work for the loop's pool.
 *
 *   brain ─ transmit ─► IN 0x81, one transfer for each piece      host ─► OUT 0x02, 4 KB at a time ─► receive ─► brain
 *   ep0: ENABLE and DISABLE tell when the host has configured the device, and when it has gone
 *
 * A transfer ends with a short packet, as the scanner ends it; one that fills its last packet gets an empty one behind it,
 * else the host waits for more. An endpoint is halted by reading from the one that can only be written; it takes that only
 * while nothing is queued. */
#include "tools/sim_gadget.h"

#include <endian.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/aio_abi.h>
#include <linux/usb/functionfs.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/ioctl.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "tools/usb_gadget.h"

#define VENDOR    0x19a2
#define PRODUCT   0x5001
#define OUT_MAX   4096
#define REPLUG_MS 1000
#define NS_PER_MS 1000000
#define INTERFACE "laser scanner"

enum { FAULT_UNPLUG, FAULT_RESET, FAULT_HALT, FAULT_ZLP, FAULT_SHORT };
static const char *const kinds[] = {"unplug", "reset", "halt", "zlp", "short", NULL};

struct sim_gadget {
	struct sim_device device;
	struct usb_gadget usb;
	int ep0, in, out, done; /* done: eventfd of finished transfers */
	aio_context_t aio;
	uv_poll_t control, finished;
	uv_timer_t timer, replug;
	uv_work_t plug;
	int handles;           /* open */
	bool plugging, wanted; /* a plug is being done; whether somebody wants it in */
	int plug_result;
	bool plugged, again; /* as it stands; out, and in again at once */
	bool enabled, ending;
	bool in_busy, out_busy;
	bool halt, halted;         /* to be halted when idle; is */
	bool zlp, cut, empty_next; /* faults; the transfer on its way is followed by an empty one */
	size_t held, held_at;      /* the rest of a transfer that was cut: bytes, where */
	uint16_t packet;           /* bytes a packet has at most, at this speed */
	int64_t plugged_ns;
	struct sim_gadget_seen seen;
	struct iocb in_cb, out_cb;
	uint8_t in_buf[SIM_TRANSFER_MAX], out_buf[OUT_MAX];
};

static void pump(struct sim_gadget *);

/* ---- descriptors ---- */

struct speed_descriptors {
	struct usb_interface_descriptor interface;
	struct usb_endpoint_descriptor_no_audio in, out;
} __attribute__((packed));

static struct speed_descriptors at_speed(uint16_t packet)
{
	return (struct speed_descriptors){
	    .interface = {.bLength = sizeof(struct usb_interface_descriptor),
	                  .bDescriptorType = USB_DT_INTERFACE,
	                  .bNumEndpoints = 2,
	                  .bInterfaceClass = USB_CLASS_VENDOR_SPEC,
	                  .iInterface = 1},
	    .in = {.bLength = sizeof(struct usb_endpoint_descriptor_no_audio),
	           .bDescriptorType = USB_DT_ENDPOINT,
	           .bEndpointAddress = 1 | USB_DIR_IN,
	           .bmAttributes = USB_ENDPOINT_XFER_BULK,
	           .wMaxPacketSize = htole16(packet)},
	    .out = {.bLength = sizeof(struct usb_endpoint_descriptor_no_audio),
	            .bDescriptorType = USB_DT_ENDPOINT,
	            .bEndpointAddress = 2 | USB_DIR_OUT,
	            .bmAttributes = USB_ENDPOINT_XFER_BULK,
	            .wMaxPacketSize = htole16(packet)},
	};
}

static int write_descriptors(int ep0)
{
	const struct {
		struct usb_functionfs_descs_head_v2 head;
		uint32_t full_count, high_count;
		struct speed_descriptors full, high;
	} __attribute__((packed)) descriptors = {
	    .head = {.magic = htole32(FUNCTIONFS_DESCRIPTORS_MAGIC_V2),
	             .length = htole32(sizeof descriptors),
	             .flags = htole32(FUNCTIONFS_HAS_FS_DESC | FUNCTIONFS_HAS_HS_DESC)},
	    .full_count = htole32(3),
	    .high_count = htole32(3),
	    .full = at_speed(64),
	    .high = at_speed(512),
	};
	const struct {
		struct usb_functionfs_strings_head head;
		uint16_t language;
		char text[sizeof INTERFACE];
	} __attribute__((packed)) strings = {
	    .head = {.magic = htole32(FUNCTIONFS_STRINGS_MAGIC),
	             .length = htole32(sizeof strings),
	             .str_count = htole32(1),
	             .lang_count = htole32(1)},
	    .language = htole16(0x409),
	    .text = INTERFACE,
	};
	if (write(ep0, &descriptors, sizeof descriptors) < 0 || write(ep0, &strings, sizeof strings) < 0)
		return -errno;
	return 0;
}

static int open_endpoint(const struct usb_gadget *usb, const char *name)
{
	char path[USB_GADGET_PATH_MAX + 8];
	snprintf(path, sizeof path, "%s/%s", usb->mount, name);
	const int fd = open(path, O_RDWR | O_NONBLOCK | O_CLOEXEC);
	return fd < 0 ? -errno : fd;
}

/* ---- transfers ---- */

static int submit(struct sim_gadget *gadget, struct iocb *cb, int fd, int command, void *buf, size_t len)
{
	*cb = (struct iocb){
	    .aio_data = (uintptr_t)cb,
	    .aio_lio_opcode = (uint16_t)command,
	    .aio_fildes = (uint32_t)fd,
	    .aio_buf = (uintptr_t)buf,
	    .aio_nbytes = len,
	    .aio_flags = IOCB_FLAG_RESFD,
	    .aio_resfd = (uint32_t)gadget->done,
	};
	struct iocb *list[1] = {cb};
	return syscall(SYS_io_submit, gadget->aio, 1, list) == 1 ? 0 : -errno;
}

static void listen_to_host(struct sim_gadget *gadget)
{
	if (gadget->enabled && !gadget->out_busy)
		gadget->out_busy =
		    submit(gadget, &gadget->out_cb, gadget->out, IOCB_CMD_PREAD, gadget->out_buf, OUT_MAX) == 0;
}

static void start_transfer(struct sim_gadget *gadget, uint8_t *bytes, size_t len)
{
	gadget->in_busy = submit(gadget, &gadget->in_cb, gadget->in, IOCB_CMD_PWRITE, bytes, len) == 0;
}

/* Bytes of one piece of the device as a transfer. False: it has none. */
static bool send_next(struct sim_gadget *gadget)
{
	if (gadget->empty_next) {
		gadget->empty_next = false;
		start_transfer(gadget, gadget->in_buf, 0);
		return true;
	}
	size_t len = gadget->held, at = gadget->held_at;
	gadget->held = 0;
	if (len == 0) {
		at = 0;
		len = gadget->device.transmit(gadget->device.ctx, gadget->in_buf, sizeof gadget->in_buf);
		if (len == 0)
			return false;
		if (gadget->cut && len > 1) { /* never at a packet's end: that would be no short packet */
			const size_t half = len / 2 % gadget->packet == 0 ? len / 2 + 1 : len / 2;
			gadget->held = len - half;
			gadget->held_at = half;
			len = half;
		}
	}
	gadget->empty_next = gadget->zlp || len % gadget->packet == 0;
	start_transfer(gadget, gadget->in_buf + at, len);
	return true;
}

/* EBADMSG is the kernel's way to say that it did it. */
static void halt_now(struct sim_gadget *gadget)
{
	uint8_t byte;
	gadget->halt = false;
	if (read(gadget->in, &byte, 1) < 0 && errno == EBADMSG) {
		gadget->halted = true;
		gadget->seen.halts++;
	}
}

static void host_said(struct sim_gadget *gadget, int64_t len, int64_t t_ns)
{
	gadget->out_busy = false;
	if (len > 0 && gadget->seen.first_request_ns < 0)
		gadget->seen.first_request_ns = t_ns - gadget->plugged_ns;
	if (len > 0)
		gadget->device.receive(gadget->device.ctx, gadget->out_buf, (size_t)len, t_ns);
}

static void host_took(struct sim_gadget *gadget, int64_t len)
{
	gadget->in_busy = false;
	if (len < 0) { /* it went with the host */
		gadget->held = 0;
		gadget->empty_next = false;
	} else if (gadget->halted) {
		gadget->halted = false;
		gadget->seen.halts_cleared++;
	}
}

static void on_finished(uv_poll_t *handle, int status, int events)
{
	struct sim_gadget *gadget = handle->data;
	uint64_t n;
	struct io_event event[2];
	struct timespec none = {0, 0};
	(void)status, (void)events;
	if (read(gadget->done, &n, sizeof n) < 0)
		return;
	const long count = syscall(SYS_io_getevents, gadget->aio, 0, 2, event, &none);
	for (long i = 0; i < count; i++) {
		if (event[i].obj == (uintptr_t)&gadget->out_cb)
			host_said(gadget, event[i].res, (int64_t)uv_hrtime());
		else
			host_took(gadget, event[i].res);
	}
	pump(gadget);
}

static void on_timer(uv_timer_t *timer)
{
	pump(timer->data);
}

/* ---- the host comes and goes ---- */

static void set_enabled(struct sim_gadget *gadget, bool enabled)
{
	struct usb_endpoint_descriptor endpoint;
	const int64_t t_ns = (int64_t)uv_hrtime();
	if (enabled == gadget->enabled)
		return;
	gadget->enabled = enabled;
	gadget->halt = gadget->halted = false;
	gadget->held = 0;
	gadget->empty_next = false;
	gadget->seen.enabled += enabled;
	gadget->packet = 64;
	if (enabled && ioctl(gadget->in, FUNCTIONFS_ENDPOINT_DESC, &endpoint) == 0)
		gadget->packet = le16toh(endpoint.wMaxPacketSize);
	gadget->device.connected(gadget->device.ctx, enabled, t_ns);
}

/* Requests to the interface: a TiM knows none, they are refused by going on in the wrong direction. */
static void refuse(struct sim_gadget *gadget, const struct usb_ctrlrequest *setup)
{
	ssize_t ignored =
	    (setup->bRequestType & USB_DIR_IN) != 0 ? read(gadget->ep0, NULL, 0) : write(gadget->ep0, NULL, 0);
	(void)ignored;
}

static void on_control(uv_poll_t *handle, int status, int events)
{
	struct sim_gadget *gadget = handle->data;
	struct usb_functionfs_event event[4];
	(void)status, (void)events;
	const ssize_t n = read(gadget->ep0, event, sizeof event);
	for (ssize_t i = 0; i < n / (ssize_t)sizeof event[0]; i++) {
		switch (event[i].type) {
		case FUNCTIONFS_ENABLE:
			set_enabled(gadget, true);
			break;
		case FUNCTIONFS_DISABLE:
		case FUNCTIONFS_UNBIND:
			set_enabled(gadget, false);
			break;
		case FUNCTIONFS_SETUP:
			refuse(gadget, &event[i].u.setup);
			break;
		default:
			break;
		}
	}
	pump(gadget);
}

static void next_plug(struct sim_gadget *);

static void do_plug(uv_work_t *work)
{
	struct sim_gadget *gadget = work->data;
	gadget->plug_result = usb_gadget_plug(&gadget->usb, !gadget->plugged);
}

static void plug_done(uv_work_t *work, int status)
{
	struct sim_gadget *gadget = work->data;
	(void)status;
	gadget->plugging = false;
	if (gadget->plug_result < 0)
		gadget->wanted =
		    gadget->plugged; /* the controller is gone: it stays as it is until somebody wants it */
	else
		gadget->plugged = !gadget->plugged;
	if (gadget->again && !gadget->plugged)
		gadget->again = false;
	next_plug(gadget);
}

static void finish(struct sim_gadget *);

/* In, when somebody wants it in and it has power. */
static bool should_be_in(const struct sim_gadget *gadget)
{
	const struct sim_device *device = &gadget->device;
	return gadget->wanted && (device->alive == NULL || device->alive(device->ctx));
}

/* One change at a time; the next when it is done. */
static void next_plug(struct sim_gadget *gadget)
{
	if (gadget->plugging)
		return;
	if (gadget->ending) {
		finish(gadget);
		return;
	}
	if (should_be_in(gadget) == gadget->plugged && !gadget->again)
		return;
	if (!gadget->plugged) {
		gadget->plugged_ns = (int64_t)uv_hrtime();
		gadget->seen.plugged++;
		gadget->seen.first_request_ns = -1;
	}
	gadget->plugging = uv_queue_work(gadget->control.loop, &gadget->plug, do_plug, plug_done) == 0;
}

/* All that can go on goes on, and the timer is set to when it goes on next. */
static void pump(struct sim_gadget *gadget)
{
	const struct sim_device *device = &gadget->device;
	const int64_t t_ns = (int64_t)uv_hrtime();
	if (gadget->ending)
		return;
	device->advance(device->ctx, t_ns);
	next_plug(gadget); /* it may have lost its power, or got it back */
	if (gadget->enabled && !gadget->in_busy) {
		if (gadget->halt)
			halt_now(gadget);
		const bool sent = send_next(gadget);
		if (!sent && device->awaits != NULL && device->awaits(device->ctx))
			device->taken(device->ctx, t_ns);
	}
	listen_to_host(gadget);
	const int64_t deadline_ns = device->deadline(device->ctx);
	if (deadline_ns == INT64_MAX)
		uv_timer_stop(&gadget->timer);
	else
		uv_timer_start(&gadget->timer, on_timer,
		               deadline_ns > t_ns ? (uint64_t)(deadline_ns - t_ns + NS_PER_MS - 1) / NS_PER_MS : 1, 0);
}

static void want(struct sim_gadget *gadget, bool in)
{
	uv_timer_stop(&gadget->replug);
	gadget->wanted = in;
	next_plug(gadget);
}

static void on_replug(uv_timer_t *timer)
{
	want(timer->data, true);
}

/* ---- faults ---- */

const char *const *sim_gadget_fault_kinds(void)
{
	return kinds;
}

static void unplug(struct sim_gadget *gadget, bool out, bool once)
{
	want(gadget, !out);
	if (out && once)
		uv_timer_start(&gadget->replug, on_replug, REPLUG_MS, 0);
}

bool sim_gadget_fault(struct sim_gadget *gadget, const struct sim_fault *fault, bool on)
{
	if (gadget->device.fault(gadget->device.ctx, fault, on, (int64_t)uv_hrtime())) {
		pump(gadget);
		return true;
	}
	switch (sim_fault_index(kinds, fault->kind)) {
	case FAULT_UNPLUG:
		unplug(gadget, on, fault->for_ns == 0);
		break;
	case FAULT_RESET:
		gadget->again = on && gadget->plugged;
		next_plug(gadget);
		break;
	case FAULT_HALT:
		gadget->halt = on;
		break;
	case FAULT_ZLP:
		gadget->zlp = on;
		break;
	case FAULT_SHORT:
		gadget->cut = on;
		break;
	default:
		return false;
	}
	pump(gadget);
	return true;
}

void sim_gadget_seen(const struct sim_gadget *gadget, struct sim_gadget_seen *ret)
{
	*ret = gadget->seen;
}

/* ---- begin and end ---- */

static void close_files(struct sim_gadget *gadget)
{
	if (gadget->aio != 0)
		syscall(SYS_io_destroy, gadget->aio);
	const int fd[] = {gadget->in, gadget->out, gadget->ep0, gadget->done};
	for (size_t i = 0; i < sizeof fd / sizeof fd[0]; i++)
		if (fd[i] >= 0)
			close(fd[i]);
	if (gadget->usb.name[0] != '\0')
		usb_gadget_destroy(&gadget->usb);
	gadget->device.destroy(gadget->device.ctx);
}

static int open_files(struct sim_gadget *gadget, const struct sim_gadget_params *params, char error[160])
{
	const struct usb_gadget_params usb = {params->name,          params->controller, VENDOR,        PRODUCT,
	                                      "SICK AG (simulated)", params->title,      params->serial};
	int r = usb_gadget_create(&usb, &gadget->usb, error);
	if (r < 0)
		return r;
	gadget->ep0 = r = open_endpoint(&gadget->usb, "ep0");
	if (r >= 0)
		r = write_descriptors(gadget->ep0);
	if (r >= 0)
		gadget->in = r = open_endpoint(&gadget->usb, "ep1");
	if (r >= 0)
		gadget->out = r = open_endpoint(&gadget->usb, "ep2");
	if (r >= 0)
		gadget->done = r = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
	if (r >= 0 && (r = (int)syscall(SYS_io_setup, 4, &gadget->aio)) < 0)
		r = -errno;
	if (r < 0)
		snprintf(error, 160, "%.32s: the kernel refuses its endpoints (%s)", params->name, strerror(-r));
	return r < 0 ? r : 0;
}

static void start_handles(struct sim_gadget *gadget, uv_loop_t *loop)
{
	uv_poll_init(loop, &gadget->control, gadget->ep0);
	uv_poll_init(loop, &gadget->finished, gadget->done);
	uv_timer_init(loop, &gadget->timer);
	uv_timer_init(loop, &gadget->replug);
	gadget->handles = 4;
	gadget->control.data = gadget->finished.data = gadget->timer.data = gadget->replug.data = gadget;
	gadget->plug.data = gadget;
	uv_poll_start(&gadget->control, UV_READABLE, on_control);
	uv_poll_start(&gadget->finished, UV_READABLE, on_finished);
}

struct sim_gadget *sim_gadget_create(uv_loop_t *loop, const struct sim_device *device,
                                     const struct sim_gadget_params *params, char error[160])
{
	struct sim_gadget *gadget = calloc(1, sizeof *gadget);
	if (gadget == NULL) {
		snprintf(error, 160, "%.32s: out of memory", params->name);
		device->destroy(device->ctx);
		return NULL;
	}
	gadget->device = *device;
	gadget->ep0 = gadget->in = gadget->out = gadget->done = -1;
	gadget->packet = 64;
	gadget->seen.first_request_ns = -1;
	if (open_files(gadget, params, error) < 0) {
		close_files(gadget);
		free(gadget);
		return NULL;
	}
	start_handles(gadget, loop);
	want(gadget, true);
	pump(gadget);
	return gadget;
}

static void on_closed(uv_handle_t *handle)
{
	struct sim_gadget *gadget = handle->data;
	if (--gadget->handles > 0)
		return;
	close_files(gadget);
	free(gadget);
}

static void finish(struct sim_gadget *gadget)
{
	uv_close((uv_handle_t *)&gadget->control, on_closed);
	uv_close((uv_handle_t *)&gadget->finished, on_closed);
	uv_close((uv_handle_t *)&gadget->timer, on_closed);
	uv_close((uv_handle_t *)&gadget->replug, on_closed);
}

void sim_gadget_destroy(struct sim_gadget *gadget)
{
	gadget->ending = true;
	next_plug(gadget);
}

/* The kernel's side of USB, simulated: a scanner at a port of a umockdev test bed, whose usbfs answers real libusb's
 * ioctls. A program that runs under umockdev-wrapper sees it in /sys and /dev as it would the real one.
 *
 *   driver ─ libusb ─ SUBMITURB, REAPURB, DISCARDURB ... ─► here ◄─ usbfs_send, usbfs_stall, usbfs_unplug ─ the test
 *
 * usbfs tells by POLLOUT that something can be reaped. umockdev's node is a plain file, which epoll refuses; a FIFO takes its
 * place: full while there is nothing, empty when there is. Requests are answered in umockdev's own thread. */
#ifndef FACET_TESTS_USBFS_H
#define FACET_TESTS_USBFS_H

#include <assert.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/usbdevice_fs.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <umockdev.h>
#include <unistd.h>

#define USBFS_URBS 64

struct usbfs_urb {
	UMockdevIoctlData *data, *buffer; /* the client's memory, synchronised when it is reaped */
	unsigned long address;
};

struct usbfs_piece { /* what the device sends next */
	struct usbfs_piece *next;
	size_t len, sent;
	bool ends; /* with a short packet: the transfer ends here */
	uint8_t bytes[];
};

struct usbfs_counts {
	int clients, claims, detached, submitted, flying_peak, halts_cleared, cleared_in_flight, discarded, released,
	    empty_packets;
};

struct usbfs {
	UMockdevTestbed *bed;
	UMockdevIoctlBase *base;
	char syspath[128], node[64];
	unsigned bus, address;
	uint32_t caps;
	int fifo;
	pthread_mutex_t lock;
	struct usbfs_urb in[USBFS_URBS], done[USBFS_URBS], out; /* out: held when `deaf` */
	int ins, dones;
	struct usbfs_piece *first, *last;
	bool claimed, gone, halted, deaf, busy, hangs; /* hangs: keeps what it is asked to give back */
	int halt_on_clear;                             /* it halts again so often when it is cleared */
	char kernel_driver[32];                        /* bound to the interface; detached by who claims it */
	struct usbfs_counts count;
	void *ctx;
	void (*written)(void *ctx, const uint8_t *bytes, size_t len); /* in umockdev's thread */
};

static inline struct usbdevfs_urb *usbfs_of(struct usbfs_urb *urb)
{
	return (struct usbdevfs_urb *)urb->data->data;
}

/* Can be reaped: the FIFO has room. */
static inline void usbfs_signal(struct usbfs *u)
{
	static const uint8_t nothing[4096];
	uint8_t away[4096];

	if (u->dones > 0 || u->gone)
		while (read(u->fifo, away, sizeof(away)) > 0)
			;
	else
		while (write(u->fifo, nothing, sizeof(nothing)) > 0)
			;
}

static inline void usbfs_drop(struct usbfs_urb *urb)
{
	g_clear_object(&urb->buffer);
	g_clear_object(&urb->data);
}

static inline void usbfs_complete(struct usbfs *u, struct usbfs_urb urb, int status)
{
	usbfs_of(&urb)->status = status;
	assert(u->dones < USBFS_URBS);
	u->done[u->dones++] = urb;
}

static inline void usbfs_complete_in(struct usbfs *u, int at, int status)
{
	struct usbfs_urb urb = u->in[at];

	u->ins--;
	memmove(&u->in[at], &u->in[at + 1], (size_t)(u->ins - at) * sizeof(*u->in));
	usbfs_complete(u, urb, status);
}

/* A transfer that libusb split into several URBs: behind a short one the kernel gives the rest of it back. */
static inline void usbfs_complete_short(struct usbfs *u)
{
	bool split = usbfs_of(&u->in[0])->flags & USBDEVFS_URB_SHORT_NOT_OK;

	usbfs_complete_in(u, 0, split ? -EREMOTEIO : 0);
	while (u->ins > 0 && usbfs_of(&u->in[0])->flags & USBDEVFS_URB_BULK_CONTINUATION)
		usbfs_complete_in(u, 0, -ECONNRESET);
}

/* Moves bytes from the device into what waits for them. */
static inline void usbfs_move(struct usbfs *u)
{
	while (u->ins > 0 && u->first && !u->halted && !u->gone) {
		struct usbfs_piece *piece = u->first;
		struct usbdevfs_urb *urb = usbfs_of(&u->in[0]);
		size_t room = (size_t)(urb->buffer_length - urb->actual_length), rest = piece->len - piece->sent;
		size_t part = rest < room ? rest : room;

		memcpy((uint8_t *)u->in[0].buffer->data + urb->actual_length, piece->bytes + piece->sent, part);
		piece->sent += part;
		urb->actual_length += (int)part;
		if (piece->sent == piece->len) {
			u->first = piece->next;
			if (!u->first)
				u->last = NULL;
			if (piece->ends && urb->actual_length < urb->buffer_length)
				usbfs_complete_short(u);
			else if (urb->actual_length == urb->buffer_length)
				usbfs_complete_in(u, 0, 0);
			free(piece);
		} else {
			usbfs_complete_in(u, 0, 0);
		}
	}
	usbfs_signal(u);
}

/* Requests */

static inline int usbfs_submit(struct usbfs *u, UMockdevIoctlData *data)
{
	struct usbfs_urb urb = {.data = g_object_ref(data)};
	struct usbdevfs_urb *asked = (struct usbdevfs_urb *)data->data;

	urb.address = data->client_addr;
	asked->actual_length = 0;
	if (u->gone)
		goto refuse_gone;
	urb.buffer =
	    umockdev_ioctl_data_resolve(data, offsetof(struct usbdevfs_urb, buffer), (gsize)asked->buffer_length, NULL);
	assert(asked->type == USBDEVFS_URB_TYPE_BULK && urb.buffer);
	u->count.submitted++;
	if (asked->endpoint == 0x81) {
		assert(u->ins < USBFS_URBS);
		u->in[u->ins++] = urb;
		if (u->ins > u->count.flying_peak)
			u->count.flying_peak = u->ins;
		if (u->halted) /* the controller finds the endpoint halted */
			usbfs_complete_in(u, 0, -EPIPE);
	} else if (u->deaf) {
		assert(asked->endpoint == 0x02 && !u->out.data);
		u->out = urb;
	} else {
		assert(asked->endpoint == 0x02);
		if (u->written)
			u->written(u->ctx, urb.buffer->data, (size_t)asked->buffer_length);
		if (asked->flags & USBDEVFS_URB_ZERO_PACKET && asked->buffer_length % 512 == 0)
			u->count.empty_packets++;
		asked->actual_length = asked->buffer_length;
		usbfs_complete(u, urb, 0);
	}
	usbfs_move(u);
	return 0;
refuse_gone:
	usbfs_drop(&urb);
	return ENODEV;
}

static inline int usbfs_discard(struct usbfs *u, unsigned long address)
{
	u->count.discarded++;
	if (u->hangs)
		return 0;
	for (int i = 0; i < u->ins; i++)
		if (u->in[i].address == address) {
			usbfs_complete_in(u, i, -ENOENT);
			usbfs_signal(u);
			return 0;
		}
	if (u->out.data && u->out.address == address) {
		usbfs_complete(u, u->out, -ENOENT);
		memset(&u->out, 0, sizeof(u->out));
		usbfs_signal(u);
		return 0;
	}
	return EINVAL;
}

/* The client's memory is written when the request is completed, so what was reaped is let go of then. */
static inline int usbfs_reap(struct usbfs *u, UMockdevIoctlData *pointer, struct usbfs_urb *ret)
{
	if (u->dones == 0)
		return u->gone ? ENODEV : EAGAIN;
	*ret = u->done[0];
	u->dones--;
	memmove(&u->done[0], &u->done[1], (size_t)u->dones * sizeof(*u->done));
	umockdev_ioctl_data_set_ptr(pointer, 0, ret->data);
	usbfs_signal(u);
	return 0;
}

static inline int usbfs_claim(struct usbfs *u, bool detach)
{
	if (u->gone)
		return ENODEV;
	if (u->busy || (u->kernel_driver[0] && !detach))
		return EBUSY;
	if (u->kernel_driver[0])
		u->count.detached++;
	u->kernel_driver[0] = 0;
	u->count.claims++;
	u->claimed = true;
	return 0;
}

static inline int usbfs_clear_halt(struct usbfs *u)
{
	if (u->gone)
		return ENODEV;
	u->count.halts_cleared++;
	u->count.cleared_in_flight += u->ins; /* controllers do not agree about what becomes of those */
	u->halted = u->halt_on_clear > 0;
	u->halt_on_clear -= u->halted;
	return 0;
}

static inline gboolean usbfs_ioctl(UMockdevIoctlBase *base, UMockdevIoctlClient *client, gpointer ctx)
{
	struct usbfs *u = ctx;
	const gulong request = umockdev_ioctl_client_get_request(client);
	const gsize size = _IOC_SIZE(request);
	struct usbfs_urb reaped = {0};
	UMockdevIoctlData *data = NULL;
	int r = ENOTTY;

	(void)base;
	if (size > 0 && request != (gulong)USBDEVFS_DISCARDURB)
		data = umockdev_ioctl_data_resolve(umockdev_ioctl_client_get_arg(client), 0, size, NULL);
	pthread_mutex_lock(&u->lock);
	if (request == USBDEVFS_GET_CAPABILITIES) {
		*(uint32_t *)data->data = u->caps;
		r = 0;
	} else if (request == USBDEVFS_DISCONNECT_CLAIM || request == USBDEVFS_CLAIMINTERFACE) {
		r = usbfs_claim(u, request == USBDEVFS_DISCONNECT_CLAIM);
	} else if (request == USBDEVFS_RELEASEINTERFACE) {
		u->count.released++;
		u->claimed = false;
		r = 0;
	} else if (request == USBDEVFS_CLEAR_HALT) {
		r = usbfs_clear_halt(u);
	} else if (request == USBDEVFS_SUBMITURB) {
		r = usbfs_submit(u, data);
	} else if (request == USBDEVFS_REAPURBNDELAY || request == USBDEVFS_REAPURB) {
		r = usbfs_reap(u, data, &reaped);
	} else if (request == (gulong)USBDEVFS_DISCARDURB) {
		r = usbfs_discard(u, *(unsigned long *)umockdev_ioctl_client_get_arg(client)->data);
	} else if (request == USBDEVFS_IOCTL) { /* give the interface back to the kernel's driver */
		r = 0;
	}
	pthread_mutex_unlock(&u->lock);
	umockdev_ioctl_client_complete(client, r ? -1 : 0, r);
	usbfs_drop(&reaped);
	if (data)
		g_object_unref(data);
	return TRUE;
}

static inline void usbfs_forget(struct usbfs *u)
{
	for (int i = 0; i < u->ins; i++)
		usbfs_drop(&u->in[i]);
	for (int i = 0; i < u->dones; i++)
		usbfs_drop(&u->done[i]);
	usbfs_drop(&u->out);
	u->ins = u->dones = 0;
}

static inline void usbfs_connected(UMockdevIoctlBase *base, UMockdevIoctlClient *client, gpointer ctx)
{
	struct usbfs *u = ctx;

	(void)base, (void)client;
	pthread_mutex_lock(&u->lock);
	u->count.clients++;
	pthread_mutex_unlock(&u->lock);
}

static inline void usbfs_vanished(UMockdevIoctlBase *base, UMockdevIoctlClient *client, gpointer ctx)
{
	struct usbfs *u = ctx;

	(void)base, (void)client;
	pthread_mutex_lock(&u->lock);
	if (--u->count.clients == 0) {
		usbfs_forget(u);
		u->claimed = false;
	}
	usbfs_signal(u);
	pthread_mutex_unlock(&u->lock);
}

/* What the device does */

static inline void usbfs_send(struct usbfs *u, const void *bytes, size_t len, bool ends)
{
	struct usbfs_piece *piece = calloc(1, sizeof(*piece) + len);

	assert(piece);
	if (len > 0)
		memcpy(piece->bytes, bytes, len);
	piece->len = len;
	piece->ends = ends;
	pthread_mutex_lock(&u->lock);
	if (u->last)
		u->last->next = piece;
	else
		u->first = piece;
	u->last = piece;
	usbfs_move(u);
	pthread_mutex_unlock(&u->lock);
}

static inline void usbfs_halt(struct usbfs *u, int again)
{
	pthread_mutex_lock(&u->lock);
	u->halted = true;
	u->halt_on_clear = again;
	if (u->ins > 0)
		usbfs_complete_in(u, 0, -EPIPE);
	usbfs_signal(u);
	pthread_mutex_unlock(&u->lock);
}

/* All that is in flight ends with -`error`, then the device is no more: in sysfs neither. */
static inline void usbfs_unplug(struct usbfs *u, int error)
{
	char path[256];
	char *root = umockdev_testbed_get_root_dir(u->bed);

	pthread_mutex_lock(&u->lock);
	u->gone = true;
	while (u->ins > 0)
		usbfs_complete_in(u, 0, -error);
	usbfs_signal(u);
	pthread_mutex_unlock(&u->lock);
	snprintf(path, sizeof(path), "%s%s", root, u->node);
	umockdev_testbed_uevent(u->bed, u->syspath, "remove");
	umockdev_testbed_remove_device(u->bed, u->syspath);
	unlink(path);
	g_free(root);
}

static inline void usbfs_finish(struct usbfs *u)
{
	if (!u->gone)
		usbfs_unplug(u, ENODEV);
	umockdev_testbed_detach_ioctl(u->bed, u->node, NULL);
	pthread_mutex_lock(&u->lock);
	usbfs_forget(u);
	pthread_mutex_unlock(&u->lock);
	for (struct usbfs_piece *next; u->first; u->first = next) {
		next = u->first->next;
		free(u->first);
	}
	u->last = NULL;
	close(u->fifo);
	g_clear_object(&u->base);
	pthread_mutex_destroy(&u->lock);
}

/* The bus itself: libusb looks for every device's parent. */
static inline void usbfs_bus(UMockdevTestbed *bed)
{
	umockdev_testbed_add_from_string(
	    bed,
	    "P: /devices/usb1\nN: bus/usb/001/001\nE: DEVTYPE=usb_device\nE: SUBSYSTEM=usb\nE: BUSNUM=001\nE: "
	    "DEVNUM=001\n"
	    "E: DEVNAME=/dev/bus/usb/001/001\nA: busnum=1\\n\nA: devnum=1\\n\nA: speed=480\\n\nA: idVendor=1d6b\\n\n"
	    "A: idProduct=0002\\n\nA: bConfigurationValue=1\\n\n"
	    "H: descriptors=12010002090001406b1d020000020302010109021900010100e0000904000001090000000705810304000c\n",
	    NULL);
}

/* Plugs a scanner into bus 1, port `port` ("1-1"); `serial` NULL: it has none. `caps`: what the simulated kernel can. */
static inline void usbfs_plug(struct usbfs *u, UMockdevTestbed *bed, const char *port, unsigned address,
                              const char *serial, uint32_t caps)
{
	char text[1024], path[256];
	char *root = umockdev_testbed_get_root_dir(bed);
	int at;

	memset(u, 0, sizeof(*u));
	pthread_mutex_init(&u->lock, NULL);
	u->bed = bed;
	u->bus = 1;
	u->address = address;
	u->caps = caps;
	snprintf(u->syspath, sizeof(u->syspath), "/sys/devices/usb1/%s", port);
	snprintf(u->node, sizeof(u->node), "/dev/bus/usb/001/%03u", address);
	at = snprintf(
	    text, sizeof(text),
	    "P: /devices/usb1/%s\nN: bus/usb/001/%03u\nE: DEVTYPE=usb_device\nE: SUBSYSTEM=usb\nE: BUSNUM=001\n"
	    "E: DEVNUM=%03u\nE: DEVNAME=/dev/bus/usb/001/%03u\nA: busnum=1\\n\nA: devnum=%u\\n\nA: speed=480\\n\n"
	    "A: idVendor=19a2\\n\nA: idProduct=5001\\n\nA: product=TiM561\\n\nA: bConfigurationValue=1\\n\n"
	    "H: descriptors=1201000200000040a2190150000101020301"
	    "09022000010100c0320904000002ff0000000705810200020007050202000200\n",
	    port, address, address, address, address);
	if (serial)
		snprintf(text + at, sizeof(text) - (size_t)at, "A: serial=%s\\n\n", serial);
	if (!umockdev_testbed_add_from_string(bed, text, NULL))
		abort();
	snprintf(path, sizeof(path), "%s%s", root, u->node);
	unlink(path);
	if (mkfifo(path, 0600) < 0)
		abort();
	u->fifo = open(path, O_RDWR | O_NONBLOCK | O_CLOEXEC);
	if (u->fifo < 0 || fcntl(u->fifo, F_SETPIPE_SZ, 4096) < 0)
		abort();
	usbfs_signal(u);
	u->base = umockdev_ioctl_base_new();
	g_signal_connect(u->base, "handle-ioctl", G_CALLBACK(usbfs_ioctl), u);
	g_signal_connect(u->base, "client-connected", G_CALLBACK(usbfs_connected), u);
	g_signal_connect(u->base, "client-vanished", G_CALLBACK(usbfs_vanished), u);
	if (!umockdev_testbed_attach_ioctl(bed, u->node, u->base, NULL))
		abort();
	umockdev_testbed_uevent(bed, u->syspath, "add");
	g_free(root);
}

#endif

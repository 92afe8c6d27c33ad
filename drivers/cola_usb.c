/* A scanner on USB as a byte stream, by libusb's asynchronous interface.
 *
 *   device ─ 0x81 ─► [in 0][in 1][in 2][in 3] a ring of transfers, always in flight ─► read, in the order of submission
 *   write ─► [out] one transfer ─ 0x02 ─► device
 *
 * One descriptor for the loop: an epoll of libusb's own descriptors, a timer for its time-outs, and an event that says
 * that bytes are left from the last read. A transfer stays as it completed until its bytes are taken, then goes to the
 * end of the ring: a reader that is slow slows the device, and costs no memory.
 *
 * Odd things in the field, and what is done:
 *  - Several telegrams in a transfer, halves of one, packets without bytes: it is a byte stream, the framer splits it.
 *  - A telegram that fills its last packet may end without a packet of length 0, and the transfer then goes on: after
 *    IN_TIMEOUT_MS libusb takes it back, and what it brought by then is kept.
 *  - A buffer smaller than what the device sends is an overflow and loses it all: 64 KiB, a multiple of every packet size.
 *  - A halted endpoint (STALL): everything in flight is taken back, the halt is cleared, and it goes on; a halt that
 *    comes back without a byte between is a device that is lost.
 *  - Where no udevd runs, a libusb that was started before the device never sees it come: each open has a libusb context
 *    of its own, so that trying again is enough.
 *  - Unplugged, a transfer ends with NO_DEVICE or with an I/O error, whichever is first.
 *
 * Never waited for: connecting (there is none), answers, and writes. Clearing a halt and claiming are requests to the kernel
 * that a present device answers at once. */
#include "drivers/cola.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>

#ifdef HAVE_USB

#include <libusb.h>
#include <poll.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/timerfd.h>
#include <unistd.h>

#include "drivers/usb_list.h"

#define ENDPOINT_IN    0x81
#define ENDPOINT_OUT   0x02
#define INS            4
#define IN_BYTES       65536
#define OUT_BYTES      1024
#define IN_TIMEOUT_MS  400 /* below the patience of whoever waits for an answer, above four scans at 15 Hz */
#define OUT_TIMEOUT_MS 1000
#define HALTS_MAX      3 /* running, without a byte between */
#define CLOSE_TURNS    10
#define CLOSE_TURN_US  2000

struct inbound {
	struct usb *usb;
	struct libusb_transfer *transfer;
	enum { IDLE, FLYING, DONE } state;
	size_t taken; /* of the bytes it brought */
	uint8_t bytes[IN_BYTES];
};

struct usb {
	struct link link;
	struct usb_device device;
	libusb_context *context;
	libusb_device_handle *handle;
	int epoll, timer, left; /* left: readable while bytes wait for the next read */
	struct inbound in[INS];
	int head; /* the oldest submission; idle ones stand at the end of the ring */
	bool halted;
	int halts;
	struct libusb_transfer *out;
	bool out_flying;
	uint8_t out_bytes[OUT_BYTES];
	int lost; /* 0 or -errno */
};

static void lose(struct usb *usb, int error)
{
	if (!usb->lost)
		usb->lost = error;
}

/* Descriptors */

static void poll_added(int fd, short events, void *ctx)
{
	struct usb *usb = ctx;
	struct epoll_event event = {.events = 0, .data.fd = fd};

	if (events & POLLIN)
		event.events |= EPOLLIN;
	if (events & POLLOUT)
		event.events |= EPOLLOUT;
	if (epoll_ctl(usb->epoll, EPOLL_CTL_ADD, fd, &event) < 0)
		lose(usb, -errno);
}

static void poll_removed(int fd, void *ctx)
{
	struct usb *usb = ctx;

	epoll_ctl(usb->epoll, EPOLL_CTL_DEL, fd, NULL); /* it may be closed already, which removes it as well */
}

static void poll_all(struct usb *usb)
{
	const struct libusb_pollfd **fds = libusb_get_pollfds(usb->context);

	for (const struct libusb_pollfd **fd = fds; fd && *fd; fd++)
		poll_added((*fd)->fd, (*fd)->events, usb);
	libusb_free_pollfds(fds);
	libusb_set_pollfd_notifiers(usb->context, poll_added, poll_removed, usb);
}

static void arm_timer(struct usb *usb)
{
	struct timeval wait = {0};
	struct itimerspec at = {0};

	if (libusb_get_next_timeout(usb->context, &wait) == 1) {
		at.it_value.tv_sec = wait.tv_sec;
		at.it_value.tv_nsec = wait.tv_usec * 1000 + 1; /* 0 would disarm it */
	}
	timerfd_settime(usb->timer, 0, &at, NULL);
}

static void mark_left(struct usb *usb, bool left)
{
	eventfd_t value;

	if (left)
		eventfd_write(usb->left, 1);
	else
		eventfd_read(usb->left, &value);
}

/* Transfers */

static void on_in(struct libusb_transfer *transfer)
{
	struct inbound *in = transfer->user_data;
	struct usb *usb = in->usb;

	in->state = DONE;
	in->taken = 0;
	if (transfer->actual_length > 0)
		usb->halts = 0;
	switch (transfer->status) {
	case LIBUSB_TRANSFER_COMPLETED:
	case LIBUSB_TRANSFER_TIMED_OUT: /* with what it brought by then */
	case LIBUSB_TRANSFER_CANCELLED: /* by ourselves */
		break;
	case LIBUSB_TRANSFER_STALL:
		usb->halted = true;
		break;
	default:
		lose(usb, -ENODEV);
	}
}

static void on_out(struct libusb_transfer *transfer)
{
	struct usb *usb = transfer->user_data;

	usb->out_flying = false;
	if (transfer->status == LIBUSB_TRANSFER_TIMED_OUT)
		lose(usb, -ETIMEDOUT);
	else if (transfer->status != LIBUSB_TRANSFER_COMPLETED)
		lose(usb, -ENODEV);
}

static int flying(const struct usb *usb)
{
	int n = 0;

	for (int i = 0; i < INS; i++)
		n += usb->in[i].state == FLYING;
	return n;
}

static void cancel_in(struct usb *usb)
{
	for (int i = 0; i < INS; i++)
		if (usb->in[i].state == FLYING)
			libusb_cancel_transfer(usb->in[i].transfer); /* twice does no harm */
}

/* Sends the idle ones off again, in the ring's order. */
static void submit_in(struct usb *usb)
{
	for (int i = 0; i < INS && !usb->lost; i++) {
		struct inbound *in = &usb->in[(usb->head + i) % INS];

		if (in->state != IDLE)
			continue;
		if (libusb_submit_transfer(in->transfer) < 0)
			lose(usb, -ENODEV);
		else
			in->state = FLYING;
	}
}

/* A halt can be cleared when nothing is in flight any more. */
static void recover(struct usb *usb)
{
	if (!usb->halted || usb->lost)
		return;
	if (flying(usb) > 0) {
		cancel_in(usb);
		return;
	}
	usb->halted = false;
	if (++usb->halts > HALTS_MAX)
		lose(usb, -EPIPE);
	else if (libusb_clear_halt(usb->handle, ENDPOINT_IN) < 0)
		lose(usb, -ENODEV);
}

/* Takes bytes of what completed, in the order of submission. */
static size_t take(struct usb *usb, uint8_t *buf, size_t cap)
{
	size_t n = 0;

	while (usb->in[usb->head].state == DONE) {
		struct inbound *in = &usb->in[usb->head];
		size_t rest = (size_t)in->transfer->actual_length - in->taken;
		size_t part = rest < cap - n ? rest : cap - n;

		memcpy(buf + n, in->bytes + in->taken, part);
		in->taken += part;
		n += part;
		if (part < rest)
			break;
		in->state = IDLE;
		usb->head = (usb->head + 1) % INS;
	}
	return n;
}

static ssize_t usb_read(struct link *link, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	struct usb *usb = (struct usb *)link;
	struct timeval no_time = {0};
	size_t n;
	int r;

	(void)t_ns; /* libusb does not say when a transfer ended */
	r = libusb_handle_events_timeout_completed(usb->context, &no_time, NULL);
	if (r < 0 && r != LIBUSB_ERROR_INTERRUPTED)
		lose(usb, -ENODEV); /* else its descriptors would call again and again */
	n = take(usb, buf, cap);
	recover(usb);
	if (!usb->halted)
		submit_in(usb);
	mark_left(usb, usb->lost || usb->in[usb->head].state == DONE);
	arm_timer(usb);
	return n > 0 ? (ssize_t)n : usb->lost;
}

static ssize_t usb_write(struct link *link, const uint8_t *bytes, size_t len)
{
	struct usb *usb = (struct usb *)link;
	size_t n = len < OUT_BYTES ? len : OUT_BYTES;

	if (usb->lost)
		return usb->lost;
	if (usb->out_flying || n == 0)
		return 0;
	memcpy(usb->out_bytes, bytes, n);
	libusb_fill_bulk_transfer(usb->out, usb->handle, ENDPOINT_OUT, usb->out_bytes, (int)n, on_out, usb,
	                          OUT_TIMEOUT_MS);
	/* Who does not know a request's length sees its end by a packet that is not full. */
	usb->out->flags = LIBUSB_TRANSFER_ADD_ZERO_PACKET;
	int r = libusb_submit_transfer(usb->out);
	if (r == LIBUSB_ERROR_NOT_SUPPORTED) {
		usb->out->flags = 0;
		r = libusb_submit_transfer(usb->out);
	}
	if (r < 0) {
		lose(usb, -ENODEV);
		return usb->lost;
	}
	usb->out_flying = true;
	arm_timer(usb);
	return (ssize_t)n;
}

static int usb_fd(const struct link *link)
{
	return ((const struct usb *)link)->epoll;
}

static void usb_error(const struct link *link, int error, char ret[160])
{
	const char *port = ((const struct usb *)link)->device.port;

	if (error == ENODEV)
		snprintf(ret, 160, "the scanner at usb:%.24s is gone: unplugged, without power, or restarted", port);
	else if (error == ETIMEDOUT)
		snprintf(ret, 160, "the scanner at usb:%.24s takes no requests; if that stays, plug it in anew", port);
	else if (error == EPIPE)
		snprintf(ret, 160, "the scanner at usb:%.24s stalls again and again; if that stays, plug it in anew",
		         port);
	else
		snprintf(ret, 160, "usb:%.24s failed (%s)", port, strerror(error));
}

/* Closing: what is in flight is taken back; what a device that hangs keeps for longer than some milliseconds goes with
 * the handle, which libusb documents for closing, and the kernel does for the descriptor. */
static void bring_home(struct usb *usb)
{
	for (int i = 0; i < CLOSE_TURNS && (flying(usb) > 0 || usb->out_flying); i++) {
		struct timeval turn = {.tv_usec = CLOSE_TURN_US};

		cancel_in(usb);
		if (usb->out_flying)
			libusb_cancel_transfer(usb->out);
		libusb_handle_events_timeout_completed(usb->context, &turn, NULL);
	}
}

static void usb_close(struct link *link)
{
	struct usb *usb = (struct usb *)link;

	if (usb->handle) {
		bring_home(usb);
		libusb_release_interface(usb->handle, 0);
		libusb_close(usb->handle);
	}
	for (int i = 0; i < INS; i++)
		libusb_free_transfer(usb->in[i].transfer);
	libusb_free_transfer(usb->out);
	if (usb->context) {
		libusb_set_pollfd_notifiers(usb->context, NULL, NULL, NULL);
		libusb_exit(usb->context);
	}
	if (usb->left >= 0)
		close(usb->left);
	if (usb->timer >= 0)
		close(usb->timer);
	if (usb->epoll >= 0)
		close(usb->epoll);
	free(usb);
}

/* Opening */

static bool make_descriptors(struct usb *usb)
{
	struct epoll_event event = {.events = EPOLLIN};

	usb->epoll = epoll_create1(EPOLL_CLOEXEC);
	usb->timer = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC);
	usb->left = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
	return usb->epoll >= 0 && usb->timer >= 0 && usb->left >= 0 &&
	       epoll_ctl(usb->epoll, EPOLL_CTL_ADD, usb->timer, &event) == 0 &&
	       epoll_ctl(usb->epoll, EPOLL_CTL_ADD, usb->left, &event) == 0;
}

static bool make_transfers(struct usb *usb)
{
	usb->out = libusb_alloc_transfer(0);
	for (int i = 0; i < INS; i++) {
		usb->in[i].usb = usb;
		usb->in[i].transfer = libusb_alloc_transfer(0);
		if (!usb->in[i].transfer)
			return false;
		libusb_fill_bulk_transfer(usb->in[i].transfer, usb->handle, ENDPOINT_IN, usb->in[i].bytes, IN_BYTES,
		                          on_in, &usb->in[i], IN_TIMEOUT_MS);
	}
	return usb->out != NULL;
}

/* libusb's answer for the device at bus and address. */
static int open_handle(struct usb *usb)
{
	libusb_device **list = NULL;
	ssize_t n = libusb_get_device_list(usb->context, &list);
	int r = n < 0 ? (int)n : LIBUSB_ERROR_NO_DEVICE;

	for (ssize_t i = 0; i < n; i++)
		if (libusb_get_bus_number(list[i]) == usb->device.bus &&
		    libusb_get_device_address(list[i]) == usb->device.address)
			r = libusb_open(list[i], &usb->handle);
	if (list)
		libusb_free_device_list(list, 1);
	return r;
}

static int explain(const struct usb *usb, const char *doing, int r, char error[160])
{
	if (r == LIBUSB_ERROR_BUSY)
		snprintf(error, 160, "usb:%.24s: another program drives this scanner; stop that one", usb->device.port);
	else
		snprintf(error, 160, "usb:%.24s: %s failed (%s); it is tried again", usb->device.port, doing,
		         libusb_strerror(r));
	return r;
}

static int connect_device(struct usb *usb, char error[160])
{
	int r = libusb_init(&usb->context);

	if (r < 0) {
		usb->context = NULL;
		snprintf(error, 160, "libusb cannot start (%s); in a sandbox it needs AF_NETLINK (see the unit)",
		         libusb_strerror(r));
		return r;
	}
	poll_all(usb);
	r = open_handle(usb);
	if (r < 0)
		return usb_list_permitted(&usb->device, error) < 0 ? r : explain(usb, "opening it", r, error);
	libusb_set_auto_detach_kernel_driver(usb->handle, 1);
	r = libusb_claim_interface(usb->handle, 0);
	if (r < 0)
		return explain(usb, "claiming its interface", r, error);
	if (!make_transfers(usb)) {
		snprintf(error, 160, "no memory");
		return LIBUSB_ERROR_NO_MEM;
	}
	submit_in(usb);
	arm_timer(usb);
	if (usb->lost)
		return explain(usb, "reading", LIBUSB_ERROR_NO_DEVICE, error);
	return 0;
}

static struct link *usb_open(const struct config_device *config, char error[160])
{
	struct usb_device list[USB_LIST_MAX];
	int n = usb_list(COLA_USB_VENDOR, COLA_USB_PRODUCT, list);
	int at = usb_list_choose(list, n, config->connect, error);
	struct usb *usb;

	if (at < 0)
		return NULL;
	usb = calloc(1, sizeof(*usb));
	if (!usb) {
		snprintf(error, 160, "no memory");
		return NULL;
	}
	usb->link.stream = &cola_usb;
	usb->device = list[at];
	usb->epoll = usb->timer = usb->left = -1;
	if (!make_descriptors(usb))
		snprintf(error, 160, "no descriptors are left (%s)", strerror(errno));
	else if (connect_device(usb, error) == 0)
		return &usb->link;
	usb_close(&usb->link);
	return NULL;
}

#else

static void usb_error(const struct link *link, int error, char ret[160])
{
	(void)link;
	snprintf(ret, 160, "%s", strerror(error));
}

static struct link *usb_open(const struct config_device *config, char error[160])
{
	snprintf(error, 160, "%.60s: facetd was built without libusb; install libusb-1.0-0-dev and build it again",
	         config->connect);
	return NULL;
}

static int usb_fd(const struct link *link)
{
	(void)link;
	return -1;
}

static ssize_t usb_read(struct link *link, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	(void)link, (void)buf, (void)cap, (void)t_ns;
	return -ENODEV;
}

static ssize_t usb_write(struct link *link, const uint8_t *bytes, size_t len)
{
	(void)link, (void)bytes, (void)len;
	return -ENODEV;
}

static void usb_close(struct link *link)
{
	(void)link;
}

#endif

const struct cola_stream cola_usb = {usb_open, usb_fd, usb_read, usb_write, usb_close, usb_error};

/* A scanner on USB. Built without libusb for now: opening says so. */
#include "drivers/cola.h"

#include <errno.h>
#include <stdio.h>

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

const struct cola_stream cola_usb = {usb_open, usb_fd, usb_read, usb_write, usb_close};

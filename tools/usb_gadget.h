/* A USB device made of files: configfs describes it to the kernel, a FunctionFS folder carries its endpoints. Needs root and
 * a kernel with libcomposite, usb_f_fs and a device controller (dummy_hcd loops it back to the same machine). */
#ifndef FACET_TOOLS_USB_GADGET_H
#define FACET_TOOLS_USB_GADGET_H

#include <stdbool.h>
#include <stdint.h>

struct usb_gadget_params {
	const char *name;       /* of its folder below configfs, and of its function: unlike any other's */
	const char *controller; /* "dummy_udc.0"; NULL: the first that nobody uses */
	uint16_t vendor, product;
	const char *manufacturer, *title, *serial; /* texts of the device; serial NULL: none */
};

#define USB_GADGET_PATH_MAX 160

struct usb_gadget {
	char dir[USB_GADGET_PATH_MAX];   /* in configfs */
	char mount[USB_GADGET_PATH_MAX]; /* where its ep0, ep1, ep2 are */
	char controller[64];
	char name[32];
};

/* All but plugged in: who calls writes descriptors to ep0 first. 0, or -errno with one sentence in `error`; what was begun is
 * taken back. */
int usb_gadget_create(const struct usb_gadget_params *, struct usb_gadget *ret, char error[160]);
void usb_gadget_destroy(struct usb_gadget *); /* after its endpoints were closed */
/* Plugs it into the host or pulls it out; takes milliseconds: not for a loop's thread. 0 or -errno. */
int usb_gadget_plug(const struct usb_gadget *, bool in);

#endif

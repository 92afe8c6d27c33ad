/* What is plugged in on USB, read from sysfs: the kernel asked every device for its strings when it came, so nobody has
 * to be opened, waited for, or permitted, to be told from its twin. Used by the driver and by `facet devices`. */
#ifndef FACET_DRIVERS_USB_LIST_H
#define FACET_DRIVERS_USB_LIST_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define USB_LIST_MAX   16 /* scanners; more are not listed */
#define USB_STRING_MAX 64

struct usb_device {
	char port[32]; /* BUS-PORT[.PORT]: stays with the socket it is plugged into */
	char serial[USB_STRING_MAX], product[USB_STRING_MAX]; /* printable; empty: it has none */
	unsigned bus, address;
	char node[40]; /* /dev/bus/usb/001/002 */
};

/* Those of this vendor and product, ordered by bus and port; how many. */
int usb_list(uint16_t vendor, uint16_t product, struct usb_device ret[USB_LIST_MAX]);

/* Which of the `n` a `connect` of usb, usb:SERIAL or usb:PORT means; -1 with one sentence where that is none or several. */
int usb_list_choose(const struct usb_device *list, int n, const char *connect, char error[160]);

/* What to write after `usb:` for list[i]: the serial number where it is unique and reads as one, else the port. */
const char *usb_list_name(const struct usb_device *list, int n, int i);

/* The first line of the file `name` of a folder of sysfs, made printable: what a device says of itself is not to be
 * trusted. False, and empty: there is none. */
bool usb_list_value(const char *folder, const char *name, char *ret, size_t cap);

/* Cuts `folder`, somewhere below a USB device in sysfs, back to that device's own. False: it is below none. */
bool usb_list_above(char *folder);

/* Tries to open the device's node: 0, or -errno with why it cannot and what to do. */
int usb_list_permitted(const struct usb_device *, char why[160]);

/* Why opening any device's node failed with errno `error`; `rule`: what to do where no group has it. */
void usb_list_explain(const char *node, int error, const char *rule, char why[160]);

#endif

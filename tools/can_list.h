/* The CAN interfaces of this machine, read from sysfs; nothing is opened. */
#ifndef FACET_TOOLS_CAN_LIST_H
#define FACET_TOOLS_CAN_LIST_H

#include <stdbool.h>

#define CAN_LIST_MAX 16 /* interfaces; more are not listed */

struct can_interface {
	char name[16];
	char driver[32]; /* of the kernel: kvaser_pci, gs_usb; empty: a virtual one */
	enum {
		CAN_LIST_DOWN, /* nobody has brought it up */
		CAN_LIST_OFF,  /* up, but its controller takes no part: bus-off, or stopped */
		CAN_LIST_UP
	} state;
	bool fd; /* takes FD frames */
};

/* Ordered by name; how many. */
int can_list(struct can_interface ret[CAN_LIST_MAX]);

#endif

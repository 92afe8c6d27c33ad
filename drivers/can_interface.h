/* What the kernel knows of a CAN interface: asked, never set (that is the system's: systemd-networkd, ip). */
#ifndef FACET_DRIVERS_CAN_INTERFACE_H
#define FACET_DRIVERS_CAN_INTERFACE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "drivers/can_bus.h"

struct can_interface {
	bool controller; /* it said the rest: no vcan, no slcan */
	uint32_t bit_rate, restart_ms;
	bool health_known;
	enum can_bus_health health;
};

/* Its index; -ENODEV: there is none, -ENETDOWN: it is down, -EAFNOSUPPORT: it is no CAN interface, or -errno. `fd`: any
 * socket. */
int can_interface_find(int fd, const char *name);

/* Asks over netlink; nothing is known where that cannot be had. */
void can_interface_ask(int index, struct can_interface *ret);

/* The kernel's answer, one message: pure. False: it is of no CAN controller, or cut. */
bool can_interface_read(const void *message, size_t len, struct can_interface *ret);

#endif

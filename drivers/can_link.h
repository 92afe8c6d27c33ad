/* The link of every CAN driver: an interface of the kernel (`can0`, AF_CAN) or a socket that carries frames (`unix:PATH`,
 * SOCK_SEQPACKET, one entry a message: containers, simulators, tests). Each driver has a link of its own, with its own
 * filters; the functions are those of struct driver, which takes them as they are:
 *
 *   static struct link *link_open(const struct config_device *d, char error[160])
 *   {
 *           const struct can_link_filter filter[] = {{0x180 + node, CAN_LINK_EXACT}, {0x080, CAN_LINK_EXACT}};
 *
 *           return can_link_open(d->connect, filter, 2, error);
 *   }
 *   ... .link_fd = can_link_fd, .link_read = can_link_read, .link_write = can_link_write, .link_error = can_link_error,
 *       .link_note = can_link_note, .link_close = can_link_close
 *
 * Reading delivers one or more entries (can_wire.h), as many as have come and have room, with the time at which each was on
 * the bus, in log time. Frames of our own, and of other programs here, come too where a filter lets them: whoever waits
 * for its SYNC names 0x080. Error frames always come (all classes but the single bus errors, of which a bad cable makes
 * thousands), and so do entries CAN_WIRE_LOST. Writing takes whole entries, whose times say nothing. A frame for which the
 * interface has no room is dropped and told as CAN_WIRE_LOST: a set-point that waits is worse than none. */
#ifndef FACET_DRIVERS_CAN_LINK_H
#define FACET_DRIVERS_CAN_LINK_H

#include <sys/socket.h>

#include "drivers/can_wire.h"
#include "drivers/driver.h"

/* A frame passes if for any filter (frame id & mask) == (id & mask); the id with the flags of can_wire.h. */
struct can_link_filter {
	uint32_t id, mask;
};

/* Only this id, of this kind (11 or 29 bits), data or remote. */
#define CAN_LINK_EXACT 0x9FFFFFFFu

#define CAN_LINK_FILTERS_MAX 64

/* `n` up to CAN_LINK_FILTERS_MAX; 0: error frames only. Never configures an interface: one that is missing or down is an
 * error, whose sentence says what to do. */
struct link *can_link_open(const char *connect, const struct can_link_filter *filters, int n, char error[160]);
int can_link_fd(const struct link *);
ssize_t can_link_read(struct link *, uint8_t *buf, size_t cap, int64_t *t_ns);
ssize_t can_link_write(struct link *, const uint8_t *bytes, size_t len);
void can_link_error(const struct link *, int error, char ret[160]);
void can_link_note(const struct link *, char ret[160]);
void can_link_close(struct link *);

/* For tests: what the link asks of the kernel, and a link over any socket whose messages are the kernel's struct can_frame
 * or canfd_frame (`connect` an interface's name) or entries (`unix:...`). It owns the descriptor from then on. */
struct can_link_calls {
	ssize_t (*recvmsg)(int fd, struct msghdr *, int flags);
	ssize_t (*send)(int fd, const void *, size_t len, int flags);
};
struct link *can_link_over(int fd, const char *connect, const struct can_link_filter *filters, int n,
                           const struct can_link_calls *calls); /* calls NULL: the kernel's; NULL: out of memory */

#endif

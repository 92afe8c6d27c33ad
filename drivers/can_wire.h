/* CAN frames as bytes: pure (protocols C.6). What a link of a CAN driver reads and writes is a row of entries, each one
 * frame as the kernel lays it out and the time at which it was on the wire (the recording's `facetd.can.v1`):
 *
 *    0        4     5       6  7  8
 *    +--------+-----+-------+--+--+--------------------+----------+
 *    | u32 id | len | flags | 0| 0| data [8], FD: [64] | i64 t_ns |
 *    +--------+-----+-------+--+--+--------------------+----------+     little-endian, 24 or 80 bytes
 *
 *    id      11 or 29 bits | CAN_WIRE_EXTENDED | CAN_WIRE_REMOTE | CAN_WIRE_ERROR (the id is then classes of errors)
 *    flags   CAN_WIRE_FD: the entry has 80 bytes; the other bits as in the kernel's struct canfd_frame
 *    t_ns    log time: the kernel's stamp on the loop's clock; the time of arrival where there is none. 0: to be sent.
 *
 * Frames of our own come back with the time at which they left (a SYNC's time is the angle's time). Frames that were lost
 * on the way to us or could not be sent are told by an entry with the id CAN_WIRE_LOST. */
#ifndef FACET_DRIVERS_CAN_WIRE_H
#define FACET_DRIVERS_CAN_WIRE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <sys/types.h>

#define CAN_WIRE_EXTENDED 0x80000000u
#define CAN_WIRE_REMOTE   0x40000000u
#define CAN_WIRE_ERROR    0x20000000u
#define CAN_WIRE_LOST     0xE0000000u /* data: u32 frames not received, u32 frames not sent, since the last such entry */
#define CAN_WIRE_BRS      0x01u
#define CAN_WIRE_FD       0x04u

/* Classes of an error frame: bits of its id, and what its data say. */
#define CAN_WIRE_ERROR_CONTROLLER \
	0x004u /* data[1]: 1, 2 overflow; 4, 8 warning; 0x10, 0x20 passive; 0x40 active again */
#define CAN_WIRE_ERROR_NO_ACK    0x020u
#define CAN_WIRE_ERROR_BUS_OFF   0x040u
#define CAN_WIRE_ERROR_BUS       0x080u
#define CAN_WIRE_ERROR_RESTARTED 0x100u

#define CAN_WIRE_ENTRY    24 /* bytes of an entry */
#define CAN_WIRE_ENTRY_FD 80
#define CAN_WIRE_TIME_MAX (INT64_MAX / 4) /* of an entry, either side of 0 */

struct can_frame_at { /* a frame at its time */
	uint32_t id;  /* with its flags, as above */
	uint8_t len, flags;
	uint8_t data[64]; /* zero beyond len */
	int64_t t_ns;
};

/* Length of the entry written to `ret` (at least CAN_WIRE_ENTRY_FD bytes). */
size_t can_wire_put(const struct can_frame_at *, uint8_t *ret);

/* Length of the entry at the start of `bytes`; 0: cut off; -EINVAL: no such entry (a length that its kind
 * cannot have, or a time whose differences have no room). */
ssize_t can_wire_get(const uint8_t *bytes, size_t len, struct can_frame_at *ret);

/* A classic data frame to be sent; `len` at most 8. */
struct can_frame_at can_wire_frame(uint32_t id, const void *data, uint8_t len);

#endif

/* Entries of CAN frames; the layout is in the header. */
#include "drivers/can_wire.h"

#include <errno.h>
#include <string.h>

#define DATA 8 /* offset of the data */

static void put32(uint8_t *ret, uint32_t v)
{
	for (int i = 0; i < 4; i++)
		ret[i] = (uint8_t)(v >> 8 * i);
}

static uint32_t get32(const uint8_t *bytes)
{
	return (uint32_t)bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

size_t can_wire_put(const struct can_frame_at *f, uint8_t *ret)
{
	const size_t room = f->flags & CAN_WIRE_FD ? 64 : 8, at = DATA + room;

	put32(ret, f->id);
	ret[4] = f->len;
	ret[5] = f->flags;
	ret[6] = ret[7] = 0;
	memcpy(ret + DATA, f->data, room);
	put32(ret + at, (uint32_t)(uint64_t)f->t_ns);
	put32(ret + at + 4, (uint32_t)((uint64_t)f->t_ns >> 32));
	return at + 8;
}

ssize_t can_wire_get(const uint8_t *bytes, size_t len, struct can_frame_at *ret)
{
	size_t room, at;

	if (len < DATA)
		return 0;
	room = bytes[5] & CAN_WIRE_FD ? 64 : 8;
	at = DATA + room;
	if (bytes[4] > room)
		return -EINVAL;
	if (len < at + 8)
		return 0;
	memset(ret, 0, sizeof *ret);
	ret->id = get32(bytes);
	ret->len = bytes[4];
	ret->flags = bytes[5];
	memcpy(ret->data, bytes + DATA, ret->len);
	ret->t_ns = (int64_t)((uint64_t)get32(bytes + at) | (uint64_t)get32(bytes + at + 4) << 32);
	if (ret->t_ns <= -CAN_WIRE_TIME_MAX || ret->t_ns >= CAN_WIRE_TIME_MAX)
		return -EINVAL;
	return (ssize_t)(at + 8);
}

struct can_frame_at can_wire_frame(uint32_t id, const void *data, uint8_t len)
{
	struct can_frame_at f = {.id = id, .len = len};

	if (len)
		memcpy(f.data, data, len);
	return f;
}

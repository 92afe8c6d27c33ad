/* Law L8: no text crashes the reader of candump's lines, and a frame that it takes is one that can be on a bus. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "drivers/candump.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void must(bool condition)
{
	if (!condition)
		abort();
}

static void judge(const struct candump_line *line)
{
	const struct can_frame_at *f = &line->frame;
	uint8_t entry[CAN_WIRE_ENTRY_FD];
	struct can_frame_at back;

	must(memchr(line->interface, 0, sizeof line->interface) != NULL);
	must(f->len <= (f->flags & CAN_WIRE_FD ? 64 : 8));
	must(line->direction == 0 || line->direction == 'R' || line->direction == 'T');
	must(f->t_ns >= 0 && (line->timed || f->t_ns == 0));
	must(f->id & (CAN_WIRE_EXTENDED | CAN_WIRE_ERROR) || (f->id & ~CAN_WIRE_REMOTE) <= 0x7ff);
	must(can_wire_get(entry, can_wire_put(f, entry), &back) > 0);
	must(memcmp(&back, f, sizeof back) == 0);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct candump_line line;

	for (size_t at = 0; at < size;) {
		const uint8_t *end = memchr(data + at, '\n', size - at);
		const size_t len = end ? (size_t)(end - data) - at + 1 : size - at;

		if (candump_read((const char *)data + at, len, &line) == CANDUMP_FRAME)
			judge(&line);
		at += len;
	}
	return 0;
}

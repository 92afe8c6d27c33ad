/* Lines of candump: its log (-l, -L), and what it prints on a terminal. Pure. */
#ifndef FACET_DRIVERS_CANDUMP_H
#define FACET_DRIVERS_CANDUMP_H

#include "drivers/can_wire.h"

#define CANDUMP_INTERFACE_MAX 16

enum candump_kind {
	CANDUMP_FRAME,
	CANDUMP_DROPPED, /* candump says that it lost frames */
	CANDUMP_NOTHING, /* blank, a comment (#), the words under an error frame */
	CANDUMP_BAD      /* not a line of candump, or one that was cut */
};

struct candump_line {
	char interface[CANDUMP_INTERFACE_MAX];
	bool timed; /* the line says when: since 1970, or since the dump or the last frame began (its -t) */
	struct can_frame_at frame; /* t_ns: as said, a date taken as UTC; else 0 */
	char direction;            /* 'R', 'T', 0: not said */
	uint8_t raw_dlc;           /* 9..15 where it was said (_F), 0: as the length */
	uint64_t dropped;          /* frames, of CANDUMP_DROPPED */
};

/* One line, with or without its end. `ret` holds what the kind names, the rest is 0. */
enum candump_kind candump_read(const char *line, size_t len, struct candump_line *ret);

#endif

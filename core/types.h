/* The records that flow: one struct per arrow of the way of a datum (design, section 1).
 * Metres, radians, nanoseconds; frames after REP-103 (x forward, y left, z up). */
#ifndef FACET_CORE_TYPES_H
#define FACET_CORE_TYPES_H

#include <stdbool.h>
#include <stdint.h>

#include "core/vec.h"

/* Longest profile any device sends; a longer one is refused by its decoder. */
#define PROFILE_BEAMS_MAX 2048

/* Why a beam is no surface. The first group is said by the device, the second by the assembler. */
enum beam_state {
	BEAM_OK = 0,
	BEAM_NO_ECHO, /* no valid value */
	BEAM_DAZZLED,
	BEAM_OVERFLOW,      /* arithmetic overflow */
	BEAM_WEAK,          /* signal to noise too small */
	BEAM_CHANNEL_ERROR, /* error reading channel 1 */
	BEAM_BEYOND_MAX,    /* greater than the maximum range */
	BEAM_RESERVED,      /* another reserved error value of the device */
	BEAM_OUT_OF_RANGE,  /* outside the configured `range` */
	BEAM_MASKED,        /* in a configured `mask` */
	BEAM_SELF,          /* ends in `robot.box` */
	BEAM_MIXED,         /* jumps to both neighbours: half an edge, half what lies behind */
	BEAM_STATES
};

/* One reading of a 2D scanner: n ranges on a fan. Decoder -> assembler. */
struct profile {
	int64_t t_ns;    /* time of the first beam */
	int32_t beam_ns; /* between neighbouring beams of one turn of the mirror */
	int32_t turn_ns; /* one turn of the mirror */
	uint8_t
	    interlace; /* turns that make the profile (1, 2 or 4): beam k belongs to turn k % interlace, place k / interlace */
	uint8_t part;  /* a partial scan: its number 0..3 within the raster of `parts`; else 0 */
	uint8_t parts; /* 1, or how many partial scans make the full raster */
	uint16_t n;
	double first_rad, step_rad; /* bearing of beam 0 and from beam to beam; 0 is straight ahead, positive left */
	float range_m[PROFILE_BEAMS_MAX];
	uint8_t state[PROFILE_BEAMS_MAX]; /* enum beam_state */
	/* How much came back, as the device counts it. For those who look on: the map knows nothing of it, so the assembler
	 * neither keeps it nor has it in its snapshots. */
	bool has_remission;
	uint16_t remission[PROFILE_BEAMS_MAX];
};

/* The servo's angle at a time; right-handed about the tilt frame's y: positive looks down. Decoder -> assembler. */
struct tilt {
	int64_t t_ns;
	double angle_rad;
};

/* map <- base at a time. Decoder -> assembler. */
struct pose {
	int64_t t_ns;
	struct vec3 position_m;
	struct quat rotation;
	double variance_m2,
	    variance_rad2; /* of the position along any axis, of the direction; 0: not known, or exact */
	/* The map was moved under the robot (a loop was closed elsewhere): nothing lies between the pose before and this. */
	bool jumped;
};

/* A piece of the robot's way, as its wheels tell it: from `from_ns` to `t_ns`. Decoder -> the robot's track. */
struct motion {
	int64_t from_ns, t_ns;
	double ahead_m, turn_rad; /* in the base frame; positive to the left */
};

/* One beam of a row, in the map frame. */
struct row_beam {
	struct vec3 origin, point; /* m; `point` is meaningless unless state is BEAM_OK */
	float range_m;
	uint8_t state; /* enum beam_state */
};

/* One turn of the mirror, every beam at its own time and place. Assembler -> field.
 * Allocated in one piece with its beams (row_create), owned by whoever holds it last. */
struct row {
	uint64_t number;   /* assembled rows, from 0 per map, several devices sharing the numbering */
	uint32_t raster;   /* rows of one raster (one device) are neighbours of each other */
	bool starts_sweep; /* the servo turned before this row, or the raster was cut: no neighbour below */
	bool ends_sweep;   /* known only at the end of an input; a turn is seen by the next row's starts_sweep */
	int64_t t_ns;      /* of the first beam */
	double tilt_rad;   /* at the middle of the row; for display only */
	double first_rad, step_rad; /* bearings, as in struct profile: rows are aligned by bearing */
	uint32_t n;
	struct row_beam beam[];
};

/* NULL when memory is out. */
struct row *row_create(uint32_t n);
void row_destroy(struct row *);

#endif

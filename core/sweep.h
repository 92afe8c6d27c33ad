/* Sweep assembly: profiles + tilt samples + pose samples -> rows of beams in the map (design 1.2; protocols E).
 *
 * One assembler per scanner. A profile is held until tilt and pose samples newer than its last beam exist, at most
 * `hold` (in recorded time); then the tilt may be extrapolated by 1.5 sample periods and the pose by 50 ms; beyond that
 * the row is dropped and counted. Turns of an interlaced profile, and the partial scans of a raster, are rows of their own
 * unless the servo stood for all of them; while it stands, partial scans wait for each other, `hold` and the time of a
 * raster at most. Time is what the caller says (log time of the record being handled): no clock here. */
#ifndef FACET_CORE_SWEEP_H
#define FACET_CORE_SWEEP_H

#include "core/state.h"
#include "core/types.h"

#define SWEEP_MASKS_MAX            8
#define SWEEP_PROFILES_WAITING_MAX 64 /* at the limit the oldest profile is dropped and counted */

struct sweep_params {
	struct transform base_tilt, tilt_laser; /* base <- tilt axis, tilt <- laser */
	double range_min_m, range_max_m;
	struct {
		double from_rad, to_rad;
	} mask[SWEEP_MASKS_MAX]; /* bearings left out */
	int masks;
	bool has_box; /* robot.box in the base frame: beams that end in it are the robot */
	struct vec3 box_min, box_max;
	int64_t hold_ns;
	bool fixed_tilt; /* no servo: tilt_rad holds always */
	double tilt_rad;
	bool fixed_pose; /* no pose device: map <- base holds always */
	struct transform map_base;
	double trust_m; /* rows are dropped while the pose's sigma is larger; 0: never */
	bool step;      /* the servo stands for every profile: one during which it moved is dropped whole */
	uint32_t raster;
};

enum sweep_drop {
	SWEEP_NO_TILT,
	SWEEP_STALE_TILT,
	SWEEP_NO_POSE,
	SWEEP_STALE_POSE,
	SWEEP_OVERFLOW,
	SWEEP_MOVED,
	SWEEP_UNCERTAIN_POSE,
	SWEEP_BEFORE_JUMP, /* measured in the frame of a map that has ended */
	SWEEP_DROPS
};

enum sweep_verdict {
	SWEEP_WAIT,    /* nothing to hand out now */
	SWEEP_ROW,     /* *ret_row is a row, the caller's; number not yet set */
	SWEEP_DROPPED, /* a row's worth of beams was dropped; *ret_drop says why */
	SWEEP_NOMEM    /* a row is lost; the next call goes on behind it */
};

struct sweep;
struct sweep *sweep_create(const struct sweep_params *);
void sweep_destroy(struct sweep *);

/* `log_ns`: log time of the record that carried the profile's last byte; `hold` counts from it. The profile is copied. */
void sweep_profile(struct sweep *, const struct profile *, int64_t log_ns);
void sweep_tilt(struct sweep *, const struct tilt *);
void sweep_pose(struct sweep *, const struct pose *);
/* A new map begins with the newest pose, which jumped: what was measured before it is dropped from here on. */
void sweep_new_map(struct sweep *);

/* Call after every record (ticks too) with its log time until it answers SWEEP_WAIT. With `end` true nothing is waited
 * for any more (end of an input). */
enum sweep_verdict sweep_next(struct sweep *, int64_t log_ns, bool end, struct row **ret_row,
                              enum sweep_drop *ret_drop);

struct sweep_stats {
	uint64_t profiles, rows, sweeps;
	uint64_t dropped[SWEEP_DROPS];
	uint64_t beams[BEAM_STATES]; /* of assembled rows, by state */
};
void sweep_stats(const struct sweep *, struct sweep_stats *ret);
/* Snapshot of all that later rows depend on but the parameters. A load that failed leaves the sweep as new. */
void sweep_state(struct state *, struct sweep *);
const char *sweep_drop_name(enum sweep_drop);

#endif

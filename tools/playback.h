/* Recorded sweeps as a simulated scanner sends them: lines of ranges and error codes, each at one tilt. Pure but for the
 * reading of files (playback_load). */
#ifndef FACET_TOOLS_PLAYBACK_H
#define FACET_TOOLS_PLAYBACK_H

#include "core/types.h"
#include "tools/scenario.h"

#define PLAYBACK_BEAMS     361  /* 180 degrees by 0.5; the last of a recorded line is missing: 0x7FFF */
#define PLAYBACK_LINES_MAX 4096 /* of one sweep */
#define PLAYBACK_SWEEPS    64

struct playback_line {
	double angle_rad;              /* the servo's own sense: positive looks up */
	uint16_t word[PLAYBACK_BEAMS]; /* mm, or an error code of 15 bits (0x7FF7 and above) */
};

struct playback_sweep {
	struct pose pose; /* map <- base; t_ns is 0 */
	uint32_t n;
	struct playback_line *line;
};

struct playback_sweeps {
	int n;
	uint32_t lines;
	struct playback_sweep sweep[PLAYBACK_SWEEPS];
};

/* One sweep from text: `tilt_deg,range,range,...` a line, '#' begins a comment. 0, -EINVAL with "line N: ...", -ENOMEM.
 * On success the lines are added to the caller's sweep (free(ret->line)). */
int playback_read_csv(const char *text, size_t len, struct playback_sweep *ret, char error[SCENARIO_ERROR_MAX]);
/* The same from a uos .3d file whose raster is one of half degrees. */
int playback_read_uos(const char *data, size_t len, struct playback_sweep *ret, char error[SCENARIO_ERROR_MAX]);

int playback_load(const char *source, char *const *more, int n, struct playback_sweeps *ret,
                  char error[SCENARIO_ERROR_MAX]);
void playback_finish(struct playback_sweeps *);

/* What has been answered and sent, counted since the simulators' start. */
struct playback_seen {
	uint64_t answers; /* angle reads answered by the servo */
	uint64_t poses;   /* pose datagrams taken */
};

/* The pacing alone, in steps, without devices:
 *   playback_ready  after enough answers at the new angle and, where the pose changed, datagrams of the new pose
 *   playback_scan   measures the line; playback_taken: its reader has it; then enough answers again, and the next line.
 * playback_advance goes on to the next line when it may: true: the caller puts the servo to playback_angle, and from the
 * counts that it reads after that the new angle's answers are counted (playback_placed). */
struct playback;
struct playback *playback_create(struct playback_sweeps *); /* takes the sweeps over; NULL: out of memory */
void playback_destroy(struct playback *);
double playback_angle(const struct playback *);
struct pose playback_pose(const struct playback *);
bool playback_advance(struct playback *, struct playback_seen);
void playback_placed(struct playback *, struct playback_seen);
bool playback_ready(const struct playback *, struct playback_seen);
void playback_scan(struct playback *, struct profile *);
void playback_taken(struct playback *, struct playback_seen);
void playback_lost(struct playback *, struct playback_seen); /* its reader did not understand it: the same line again */
bool playback_ended(const struct playback *);
uint32_t playback_lines(const struct playback *); /* taken so far */

#endif

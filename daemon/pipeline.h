/* The pipeline: one reading's way from the wire to the map's rows. It alone joins decoders, assemblers and the row sink.
 *
 *   record -> decoder -> profile | tilt | pose -> assembler -> row, numbered -> row sink (the worker's queue, or a map)
 *                        pose | motion -> the robot's track -> pose
 *
 * Driven by records, ticks and steps of the wall clock only (law L7): the same list gives the same rows, live or kept. */
#ifndef FACET_DAEMON_PIPELINE_H
#define FACET_DAEMON_PIPELINE_H

#include "config/config.h"
#include "core/pose_track.h"
#include "core/sweep.h"
#include "drivers/driver.h"

struct pipeline;

struct pipeline_sink {
	void *ctx;
	/* Takes the row over. False: not applied (queue full); the pipeline counts it and reports it by `not_applied`. */
	bool (*row)(void *ctx, struct row *row);
	/* Row `number` will not be applied: an event for the recording. May be NULL. */
	void (*not_applied)(void *ctx, uint64_t number, const char *reason);
	/* A second of recorded time passed without a row that was taken: what waits for its look-ahead is folded now. */
	void (*flush)(void *ctx);
	/* Replies and signs of life for the devices' dialogues. May be NULL (replay). */
	void (*reply)(void *ctx, int device, const struct reply *);
	void (*data)(void *ctx, int device, int64_t t_ns);
	/* The pose of `device` jumped. Said once the record in which it did is handled whole: with `new_map` its rows were
	 * the old map's last ones, and what comes belongs to the new one (pipeline_reset). May be NULL. */
	void (*jump)(void *ctx, int device, const struct pose_jump *);
	/* For those who look on (daemon/live.h): what was measured, in the order of the records. Each may be NULL. */
	void (*profile)(void *ctx, int device, const struct profile *);
	void (*tilt)(void *ctx, int device, const struct tilt *);
	void (*pose)(void *ctx, const struct pose *); /* of the robot, as the assemblers are told it */
};

/* NULL when memory is out. The configuration is borrowed and must outlive the pipeline; its drivers are known ones. */
struct pipeline *pipeline_create(const struct config *, const struct pipeline_sink *);
void pipeline_destroy(struct pipeline *);

void pipeline_handle(struct pipeline *, const struct record *);
void pipeline_tick(struct pipeline *, int64_t log_ns);    /* the recorded 10 Hz tick */
void pipeline_clock(struct pipeline *, int64_t ahead_ns); /* the wall clock was set: so far ahead of log time now */
void pipeline_skip(struct pipeline *, uint64_t number);   /* replay: this row was not applied live */
void pipeline_end(struct pipeline *);                     /* end of the input: hand out what waits, then flush */
void pipeline_reset(
    struct pipeline *); /* a new map: rows are numbered from 0 again, the numbers to skip are forgotten */

/* Snapshot of all that the rows depend on (law L7): decoders, assemblers, numbers; not the configuration, not the numbers to
 * skip. A load that fails says why and leaves the pipeline as new; the map that belongs to it is the caller's. */
void pipeline_state(struct pipeline *, struct state *, char error[160]);

/* Log time of what was handled last; 0: nothing was. */
int64_t pipeline_log_ns(const struct pipeline *);

/* Within the sink's `row`: log time of the last byte of the profile that the row is made of. */
int64_t pipeline_arrival_ns(const struct pipeline *);

struct pipeline_stats {
	uint64_t rows, not_applied;
	bool looks_ahead;         /* rows may wait for their look-ahead: no flush since the last one that was taken */
	struct sweep_stats sweep; /* summed over the scanners */
};
void pipeline_stats(const struct pipeline *, struct pipeline_stats *ret);
/* Of a device that says where the robot is, or how it moves; all 0 for others. */
void pipeline_track(const struct pipeline *, int device, struct pose_track_status *ret);
int pipeline_devices(const struct pipeline *);
void pipeline_counters(const struct pipeline *, int device, struct decoder_counters *ret);
void pipeline_timing(const struct pipeline *, int device, struct decoder_timing *ret); /* all 0: nothing is known */

#endif

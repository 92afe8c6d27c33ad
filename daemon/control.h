/* JSON lines: what a client may ask and what it is told (interfaces, section 4; docs/protocol.md, section 3). Pure. */
#ifndef FACET_DAEMON_CONTROL_H
#define FACET_DAEMON_CONTROL_H

#include "core/model.h"
#include "core/native.h"
#include "core/pose_track.h"
#include "daemon/player.h"
#include "daemon/recorder.h"
#include "daemon/supervisor.h"
#include "daemon/worker.h"

#define CONTROL_LINE_MAX (64u << 10)
#define CONTROL_FILE_MAX 128

enum control_word {
	CONTROL_STATUS,
	CONTROL_WATCH,
	CONTROL_PAUSE,
	CONTROL_RESUME,
	CONTROL_RESET,
	CONTROL_SAVE,
	CONTROL_RECORD,
	CONTROL_SEEK
};

struct control_command {
	enum control_word word;
	bool enable;                 /* of WATCH, RECORD */
	bool stream;                 /* of RECORD: to this client */
	char file[CONTROL_FILE_MAX]; /* of SAVE; longer ones are refused */
	/* of SEEK */
	bool seek, pace;
	int64_t seek_ns;
	double speed; /* 0: max */
};

/* Parses `?WORD`, `?WORD={...}` or `{"command": "WORD", ...}`, with or without a `;` at the end. 0, -ENOTSUP where the
 * word is known but comes later, -EINVAL; then with one sentence. */
int control_parse(const char *text, size_t len, struct control_command *ret, char error[200]);

/* Commands that change something are for the unix socket only. */
bool control_changes(enum control_word);
/* ... and of these, those that only move the playback of a recording. */
bool control_plays(enum control_word);
const char *control_name(enum control_word);

struct control_client {
	uint64_t id;
	const char *kind; /* native, lines */
	char address[64];
	uint64_t step, behind, behind_peak, sent, queued, batches, aborts;
};

/* Everything a status message says. */
struct control_status {
	uint8_t map_id[16];
	uint32_t generation;
	double cell_m;
	int64_t t_ns, uptime_ns;
	uint64_t step;
	bool paused;
	struct {
		uint64_t assembled, applied, not_applied, queue_full, paused;
		double rate; /* 1/s */
		struct sweep_stats sweep;
	} rows;
	size_t patches, encoded_bytes, pinned_bytes;
	uint64_t faces, faces_raw, batches; /* sets of changed patches that were published */
	struct grid_stats grid;
	uint64_t memory_cap;
	size_t rss_bytes;
	struct worker_status worker;
	double latency_p50_ms, latency_p99_ms;
	uint64_t latencies;
	int devices;
	struct {
		const char *name, *driver;
		struct supervisor_device line;
		double rate; /* profiles, angles or poses a second */
		bool fixed;  /* nothing is ever to come from it */
		struct decoder_timing timing;
		struct pose_track_status track; /* of those that say where the robot is, or how it moves */
		struct decoder_counters counters;
	} device[CONFIG_DEVICES_MAX];
	struct recorder_status record;
	size_t streams; /* recordings that clients take */
	size_t clients;
	const struct control_client *client;
	bool replays; /* and how: */
	struct player_status replay;
	const char *replay_error, *replay_note; /* may be empty */
};

/* Each appends one JSON text without a newline. */
void control_put_status(struct buffer *, const struct control_status *);
void control_put_version(struct buffer *);
void control_put_answer(struct buffer *, const struct control_command *);
void control_put_error(struct buffer *, const char *sentence);
void control_put_device_event(struct buffer *, const char *device, const char *state, const char *text);
/* The pose of `device` jumped. */
void control_put_jump_event(struct buffer *, const char *device, const struct pose_jump *);
const char *control_beam_name(enum beam_state);
const char *control_on_jump(enum pose_track_on_jump); /* "keep", ... */
/* A map ended, another began. */
void control_put_map_event(struct buffer *, const uint8_t map_id[16], uint32_t generation, const uint8_t before[16]);
/* An ended map was saved as `file`; or (`file` NULL) was not, and why. */
void control_put_saved_event(struct buffer *, const char *map, const char *file, const char *error);
/* A recording began, ended or failed. */
void control_put_record_event(struct buffer *, const struct recorder_notice *);
/* The last line behind a recording that a client took. */
void control_put_end(struct buffer *, const char *reason);
/* The wall clock was set by `step_ns` and is now `ahead_ns` ahead of the times of the daemon. */
void control_put_clock_event(struct buffer *, int64_t step_ns, int64_t ahead_ns);

#endif

/* The parts of the daemon among themselves. daemon.c is its life and what the loop hands on; daemon_maps.c takes the worker's
 * results and knows which map they are of; daemon_replay.c stands where devices stand in a live one; daemon_commands.c does
 * what clients ask, recordings among it; daemon_status.c tells all of it. */
#ifndef FACET_DAEMON_DAEMON_PARTS_H
#define FACET_DAEMON_DAEMON_PARTS_H

#include <uv.h>

#include "daemon/archive.h"
#include "daemon/daemon.h"
#include "daemon/foxglove_web.h"
#include "daemon/journal.h"
#include "daemon/live.h"
#include "daemon/pipeline.h"
#include "daemon/player.h"
#include "daemon/publisher.h"
#include "daemon/recorders.h"
#include "daemon/replay_lines.h"
#include "daemon/server.h"
#include "daemon/snapshot.h"
#include "daemon/supervisor.h"
#include "daemon/watchers.h"
#include "daemon/web.h"
#include "daemon/worker.h"

#define LATENCIES    1024 /* the newest, for the percentiles */
#define RATE_SECONDS 4    /* rates are means over so long */

struct daemon {
	const struct config *config;
	const struct driver *driver[CONFIG_DEVICES_MAX];
	uv_loop_t loop;
	int64_t clock_offset_ns, started_ns; /* realtime - monotonic at the start */
	int64_t wall_offset_ns;              /* the same now */
	struct publisher *publisher;
	struct worker *worker;
	struct pipeline *pipeline;
	struct supervisor *supervisor;
	struct watchers watchers;
	struct replay *replay; /* NULL: live. Instead of devices, ticks and supervisor: */
	struct player *player;
	struct replay_lines lines;
	struct server *server;
	struct web *web; /* NULL: there is none */
	struct live *live;
	struct foxglove *foxglove;
	struct snapshots *snapshots;
	struct archive *archive;
	struct journal *journal;
	struct journal_sink keep; /* empty without a journal */
	bool journal_failed;
	struct recorders *recorders;
	uint8_t map_id[16]; /* of what the publisher has */
	uint8_t
	    list_map_id[16]; /* of the map that is recorded: after a jump it is ahead of map_id until the worker is */
	uint32_t list_generation;
	bool list_ahead;

	uv_async_t results;
	uv_timer_t devices, tick, second, watchdog, last;
	uv_signal_t interrupt, terminate;
	bool stopping, closed;
	int failure; /* what ended it, if not a signal */
	char *error;

	/* For the status. */
	bool paused;
	uint64_t queue_full, rows_paused;
	uint64_t overload_begin; /* queue_full when the worker fell behind; it still does while `overloaded` */
	uint64_t queue_full_seen;
	bool overloaded, memory_full;
	int64_t jump_told_ns; /* a line was logged of a jump */
	uint64_t jumps_untold;
	double latency_ms[LATENCIES];
	uint64_t latencies;
	uint64_t batches;
	struct grid_stats grid;
	struct field_stats field;
	uint64_t decoded[RATE_SECONDS + 1][CONFIG_DEVICES_MAX], rows[RATE_SECONDS + 1]; /* rings, a column a second */
	uint64_t seconds;
};

/* daemon.c */
int64_t daemon_now(void *d);                                    /* log time */
void daemon_fail(struct daemon *, int r, const char *sentence); /* ends it with a sentence */
void daemon_tell(struct daemon *, struct buffer *message);      /* one EVENT to all who watch; finishes it */
void daemon_wake_devices(struct daemon *, int64_t wait_ns);     /* their timer; in a replay the player's */
bool daemon_take_row(void *d, struct row *);                    /* false: it is not applied */

/* daemon_maps.c */
void daemon_make_map_id(struct daemon *, uint8_t ret[16]);
void daemon_begin_list(struct daemon *); /* what is kept and recorded from here on gives the map that begins here */
void daemon_jump(void *d, int device, const struct pose_jump *);
void daemon_archived(void *d, const struct archive_result *);
void daemon_saved(void *d, const char *path, const char *error); /* a snapshot */
void daemon_results(uv_async_t *);                               /* the worker has some */

/* daemon_replay.c */
bool daemon_begin_replay(struct daemon *, double speed);
void daemon_replay_foxglove(struct foxglove_host *); /* playback is offered to Foxglove's clients */
void daemon_play(struct daemon *);                   /* what is due */
void daemon_show_rush(struct daemon *);              /* once a second */
bool daemon_playback(struct daemon *, const struct control_command *, char error[200]);
int64_t daemon_data_time(void *d); /* log time; in a replay the recorded one */

/* daemon_commands.c */
bool daemon_begin_recorders(struct daemon *, const char *config_text);
bool daemon_command(void *d, const struct control_command *, char error[200]);
struct recorder *daemon_begin_stream(void *d, char error[200]);
void daemon_end_stream(void *d, struct recorder *);

/* daemon_status.c */
const struct supervisor_device *daemon_device(const struct daemon *, int device);
void daemon_note_latencies(struct daemon *, const struct worker_result *);
void daemon_note_second(struct daemon *); /* for the rates */
void daemon_put_status(void *d, struct buffer *ret);
void daemon_put_metrics(void *d, struct buffer *ret);

#endif

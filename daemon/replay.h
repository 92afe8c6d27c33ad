/* Replay: what a loop once handed to its pipeline, out of files, in the same order and with the recorded times (law L7).
 *
 *   FILE... ── recognised by content ──► source: events ──► replay_next: one event, and the rows that were refused with it
 *
 * Sources: recordings (MCAP) and kept journals, which say everything; and what people have, which says less and is merged
 * by time: candump logs, captures of TCP (pcap, pcapng), CARMEN logs, poses as JSON lines, folders of uos scans. Files of one
 * rotation follow one another. Nothing here looks at a clock or at a device. */
#ifndef FACET_DAEMON_REPLAY_H
#define FACET_DAEMON_REPLAY_H

#include "daemon/pipeline.h"

#define REPLAY_FILES_MAX 1024
#define REPLAY_ERROR_MAX 320

enum replay_kind {
	REPLAY_BEGIN, /* a file begins, or the map began anew: `bytes` is a snapshot (pipeline_state); empty: as new */
	REPLAY_RECORD,
	REPLAY_TICK,
	REPLAY_CLOCK,       /* the wall clock was set: ahead_ns */
	REPLAY_NOT_APPLIED, /* within sources only: replay_next says it in `skip` of the event before */
	REPLAY_ROW,         /* a row of a scan that was never bytes of a device: its pipeline has no part in it */
	REPLAY_END,         /* within sources only: the file was ended in order */
	REPLAY_EVENT /* `bytes` is a JSON text: a device's state, for who looks on; the map knows nothing of it */
};

struct replay_event {
	enum replay_kind kind;
	int64_t log_ns;
	struct record record; /* RECORD; its bytes are borrowed until the next call */
	int64_t ahead_ns;     /* CLOCK */
	bool goes_on;         /* BEGIN: of the same map (the next file of a rotation), if this is its state */
	uint64_t session;     /* BEGIN: of the recorder; 0: not known. `part` N + 1 goes on where part N was ended */
	uint32_t part;
	const uint8_t *bytes; /* BEGIN, EVENT; borrowed likewise */
	size_t len;
	uint64_t number;      /* NOT_APPLIED */
	struct row *row;      /* ROW: the caller's */
	const uint64_t *skip; /* numbers of rows that were not applied when this was handled; borrowed likewise */
	size_t skips;
};

struct replay;

/* Opens files (or one folder of scans). 0, or -errno with a sentence that names the file. Call replay_use before the first event. */
int replay_open(const char *const *files, int n, struct replay **ret, char error[REPLAY_ERROR_MAX]);
void replay_close(struct replay *);

/* The configuration that the recording carries, NULL where it has none: then one must be given. */
const char *replay_config(const struct replay *, size_t *ret_len);

/* The configuration to replay with, borrowed: it says which device a frame, a connection or a line belongs to. Reads the
 * imported files through once, so that their sentences come now. 0 or -errno with a sentence. */
int replay_use(struct replay *, const struct config *, char error[REPLAY_ERROR_MAX]);

/* Log times of the first and the last event; equal where nothing is in it. */
void replay_span(const struct replay *, int64_t *ret_begin_ns, int64_t *ret_end_ns);

/* The next event: 1; 0 at the end; -errno with a sentence where the file is damaged. */
int replay_next(struct replay *, struct replay_event *ret, char error[REPLAY_ERROR_MAX]);
/* Log time of the event that comes next; INT64_MAX at the end. */
int64_t replay_next_ns(const struct replay *);

/* Back to the last beginning of a map at or before `t_ns` that was met so far, or to the start. What comes next is its BEGIN. 0 or -errno. */
int replay_back(struct replay *, int64_t t_ns, char error[REPLAY_ERROR_MAX]);
/* Log time of that beginning. */
int64_t replay_back_ns(const struct replay *, int64_t t_ns);

/* Is the end of the files that of the input, so that what waits is handed out (pipeline_end)? Not of a recording: its end
 * is the moment at which nobody listened any more, and the map is the one that the daemon's clients held then. */
bool replay_ends(const struct replay *);

/* What an importer found and left, e.g. "12 of 4000 frames belong to no device"; empty: nothing. */
const char *replay_note(const struct replay *);

/* Hands an event to `pipeline`: the refused rows first, then the event. *ret_anew: the map is to begin anew, before the
 * rows of this event. ROW is the caller's own. 0, or -EINVAL with a sentence: the snapshot does not fit. */
int replay_feed(struct replay *, const struct replay_event *, struct pipeline *, bool *ret_anew,
                char error[REPLAY_ERROR_MAX]);
/* The pipeline has begun a new map by itself (a jump, pipeline_reset): the BEGIN that follows is that same one. */
void replay_began(struct replay *);

#endif

/* A recorder: one recording that is under way, into files of a folder or as a stream of bytes for a client. A thread of its own
 * maps, compresses and writes; the loop only copies what it handles into a bounded queue, and never waits.
 *
 *   loop ─► queue (bytes) ─► thread: recording ─► chunk ─► file: write, fdatasync │ stream: bytes that the client takes
 *
 * A chunk is closed and written when it is three quarters of `chunk_ns` old (ticks of 0.1 s decide, so what a kill can lose stays
 * below `chunk_ns`) or 1 MB long. What is written is whole chunks; write() alone makes it outlive the process, fdatasync after
 * each chunk a loss of power.
 *
 * Limits and what happens there: the queue is full (a disk that stands still): the file ends with the last event that fitted. The
 * disk is full, read-only or gone: likewise. Both are told once, and another file is begun after a pause that grows from 2 s to a
 * minute, once there is room. A stream's reader that is too slow: the stream ends in order, with the reason. */
#ifndef FACET_DAEMON_RECORDER_H
#define FACET_DAEMON_RECORDER_H

#include "daemon/recording.h"

#define RECORDER_QUEUE_BYTES  (16u << 20) /* that wait for the thread */
#define RECORDER_STREAM_BYTES (8u << 20)  /* that wait for the reader; a chunk and the summary come on top */
#define RECORDER_CHUNK_BYTES  (1u << 20)
#define RECORDER_CHUNKS       86400       /* of one file: then another is begun, as by max_size */
#define RECORDER_ROOM_BYTES   (16u << 20) /* free on the disk before a file is begun again */

struct recorder_params {
	const struct config *config; /* borrowed; `record` has the limits */
	const char *config_text;     /* attached to each file; copied */
	const char *dir;             /* copied; NULL: a stream */
	uint64_t session;            /* random; counted up at each gap */
	void (*ready)(void *ctx);    /* from the thread: a notice, or bytes of the stream, can be taken */
	void *ctx;
};

struct recorder;

/* NULL when memory or threads are out. Nothing is recorded before recorder_begin. */
struct recorder *recorder_create(const struct recorder_params *);
/* Ends what is under way in order, first; waits for the disk. */
void recorder_destroy(struct recorder *);

/* From here on the loop calls. A file (anew) is wanted: say recorder_begin before the next record or tick. */
bool recorder_wants_begin(struct recorder *, int64_t log_ns);
/* The state of the pipeline as it stands; session and part are the recorder's own to fill in. A file that is open ends here. A
 * stream goes on with the new map in it. */
void recorder_begin(struct recorder *, const struct recording_begin *);
/* Ends the recording in order, or (`true`) lets it begin: recorder_wants_begin. At first it is enabled. */
void recorder_enable(struct recorder *, bool);

void recorder_record(struct recorder *, const struct record *);
void recorder_tick(struct recorder *, int64_t log_ns);
void recorder_skip(struct recorder *, uint64_t number, const char *reason);
void recorder_clock(struct recorder *, int64_t ahead_ns);
void recorder_event(struct recorder *, const char *json, size_t len);
void recorder_control(struct recorder *, const char *json, size_t len);
void recorder_message(struct recorder *, enum foxglove_schema, const void *data, size_t len); /* protobuf */
/* A file was begun since the last call: what is published comes whole again. */
bool recorder_begun(struct recorder *);

/* What is worth a line of log and an event: a file began, ended, could not be written. False: nothing. */
struct recorder_notice {
	int priority;      /* syslog.h */
	const char *state; /* "recording", "ended", "failed" */
	char file[512];    /* empty: a stream */
	char sentence[320];
};
bool recorder_notice(struct recorder *, struct recorder_notice *ret);

struct recorder_status {
	bool enabled, recording;
	char file[512];    /* the newest; empty: none yet */
	char error[320];   /* why nothing is recorded; empty: nothing is wrong */
	uint64_t bytes;    /* of the newest file */
	uint64_t messages; /* in it */
	uint64_t files, gaps;
	uint64_t dropped; /* events that found no room, or no file */
	size_t queued, queued_peak;
};
void recorder_status(struct recorder *, struct recorder_status *ret);

/* Of a stream: moves what waits to the end of `ret`, at most `max` bytes. True: the stream has ended and nothing is left; `reason` says why. */
bool recorder_take(struct recorder *, size_t max, struct buffer *ret, char reason[320]);

#endif

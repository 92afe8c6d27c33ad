/* All recordings that are under way: the folder's, which the configuration or a client asks for, and those of clients that take
 * the bytes themselves. The loop hands everything it handles to all of them; it never waits for one. */
#ifndef FACET_DAEMON_RECORDERS_H
#define FACET_DAEMON_RECORDERS_H

#include <uv.h>

#include "daemon/recorded_messages.h"
#include "daemon/recorder.h"

#define RECORDERS_STREAMS 2 /* at once; a further client is refused */

struct recorders_host {
	void *ctx;
	/* The pipeline as it stands, and whose map that is (all but session and part). False: memory is out, try again. */
	bool (*snapshot)(void *ctx, struct recording_begin *ret, struct buffer *ret_bytes);
	/* For the log and for those who watch. */
	void (*say)(void *ctx, const struct recorder_notice *);
	/* Streams have bytes to be taken. */
	void (*streams)(void *ctx);
};

struct recorders;

/* The folder's begins at once where the configuration has one. `config_text` is copied. NULL when memory or threads are out. */
struct recorders *recorders_create(uv_loop_t *, const struct config *, const char *config_text,
                                   const struct recorders_host *);
/* With record.messages: what is published goes into the folder's recording. Both are borrowed till recorders_stop. */
void recorders_publish(struct recorders *, struct publisher *, const struct live *);
/* Ends them in order; the loop then still has a handle to close, after which destroy. */
void recorders_stop(struct recorders *);
void recorders_destroy(struct recorders *);

/* In the order of handling; each before the pipeline's own (daemon/journal.h). */
void recorders_map(struct recorders *); /* a map begins: the pipeline is as it goes on from */
void recorders_record(struct recorders *, const struct record *);
void recorders_tick(struct recorders *, int64_t log_ns);
void recorders_skip(struct recorders *, uint64_t number, const char *reason);
void recorders_clock(struct recorders *, int64_t ahead_ns);
void recorders_event(struct recorders *, const char *json, size_t len);
void recorders_control(struct recorders *, const char *json, size_t len);

/* ?RECORD={"enable":...}. False with a sentence. */
bool recorders_enable(struct recorders *, bool enable, char error[200]);
/* ?RECORD={"stream":true}: recorder_take gives its bytes. NULL with a sentence. */
struct recorder *recorders_stream(struct recorders *, char error[200]);
void recorders_stream_end(struct recorders *, struct recorder *);

/* Of the folder's. Streams that are under way: the result. */
size_t recorders_status(struct recorders *, struct recorder_status *ret);

#endif

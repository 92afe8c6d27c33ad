/* The Foxglove WebSocket protocol, version 1 (docs/foxglove.md), as a state machine: messages heard, pieces of messages to
 * say. The map as scenes, what is measured now, the log, and the controls of a replay, for programs that know nothing of
 * facetd. No sockets and no clock; one thread. */
#ifndef FACET_DAEMON_FOXGLOVE_H
#define FACET_DAEMON_FOXGLOVE_H

#include "core/scene.h"
#include "daemon/live.h"
#include "daemon/player.h"
#include "daemon/publisher.h"

/* Some clients listen only a moment after the handshake: what is said before is lost on them. */
#define FOXGLOVE_SETTLE_NS 5000000ll
/* One client is told no oftener; what came meanwhile is skipped to the newest. */
#define FOXGLOVE_MAP_NS    50000000ll
#define FOXGLOVE_SCAN_NS   33000000ll
#define FOXGLOVE_POSE_NS   40000000ll /* transforms, pose and time */
#define FOXGLOVE_STATUS_NS 1000000000ll
/* Of one client, answers that wait to be said; further ones are dropped and counted. */
#define FOXGLOVE_ANSWERS_MAX (16u << 10)
#define FOXGLOVE_REQUEST_MAX 256 /* bytes of the name of a playback request */

/* What somebody who looks at a replay asks for. */
struct foxglove_request {
	bool play;
	double speed;
	bool seek;
	int64_t seek_ns;
};

struct foxglove_host {
	void *ctx;
	int64_t (*now)(void *ctx);                     /* the clock of t_ns below */
	int64_t (*time)(void *ctx);                    /* of the data: log time, in a replay the recorded one */
	void (*status)(void *ctx, struct buffer *ret); /* appends one STATUS text */
	/* Of a replay; both NULL where there is none. False with a sentence where it cannot be. */
	void (*playback)(void *ctx, struct player_status *ret);
	bool (*play)(void *ctx, const struct foxglove_request *, char error[200]);
};

struct foxglove;
/* Publisher and live are borrowed; it listens to the latter. NULL when memory is out. */
struct foxglove *foxglove_create(struct publisher *, struct live *, const struct foxglove_host *);
void foxglove_destroy(struct foxglove *); /* clients leave first */

/* What the publisher makes entities of scenes with; `cell_m` is borrowed. */
void foxglove_encoders(struct publisher_params *, const double *cell_m);

struct foxglove_wire {
	void *ctx;
	void (*wake)(void *ctx); /* foxglove_next, or foxglove_deadline, has something new */
};

struct foxglove_client;
/* Somebody connected at `t_ns`. `may_play`: it may control a replay. NULL when memory is out. */
struct foxglove_client *foxglove_join(struct foxglove *, enum scene_encoding, bool may_play,
                                      const struct foxglove_wire *, int64_t t_ns);
void foxglove_leave(struct foxglove_client *);

/* A whole message came. */
void foxglove_hear(struct foxglove_client *, const uint8_t *data, size_t len, bool text);

/* Fills at most `cap` bytes of what is to be said now, which are then said; how many, 0: nothing now. *ret_text as of the
 * message's first piece; *ret_final: the message ends with this piece. */
size_t foxglove_next(struct foxglove_client *, uint8_t *buf, size_t cap, int64_t t_ns, bool *ret_text, bool *ret_final);
/* When to ask again; INT64_MAX: at the next wake. */
int64_t foxglove_deadline(const struct foxglove_client *);
/* Why it is to be closed; NULL: it is not. */
const char *foxglove_reason(const struct foxglove_client *);

struct foxglove_client_stats {
	struct publisher_client_stats map; /* all 0 while it does not ask for the map */
	size_t bytes;                      /* it costs, all told */
	uint64_t messages, dropped;        /* said; answers not said for want of room */
};
void foxglove_client_stats(const struct foxglove_client *, struct foxglove_client_stats *ret);

#endif

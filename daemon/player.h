/* The player: a replay with a pace. It stands where devices, ticks and the clock stand in a live daemon: what is due is
 * handed to its host; who looks on may stop it, seek in it and change its speed. Time is handed in, so tests play hours in
 * no time. Rows are never dropped by load: where the host has no room the player waits, and its clock with it. */
#ifndef FACET_DAEMON_PLAYER_H
#define FACET_DAEMON_PLAYER_H

#include "daemon/replay.h"

#define PLAYER_SPEED_MIN 0.1
#define PLAYER_SPEED_MAX 1000.0 /* beyond: as fast as the machine can ("max"), written as 0 */

enum player_state { PLAYER_PLAYING, PLAYER_PAUSED, PLAYER_SEEKING, PLAYER_ENDED }; /* numbered as Foxglove does */

/* What a client is told (STATUS `replay`, Foxglove's playback state, the viewer's transport). */
struct player_status {
	enum player_state state;
	int64_t begin_ns, end_ns, now_ns; /* recorded log time */
	double speed;                     /* of the recording's; 0: as fast as can be */
	uint64_t seeks;                   /* done so far */
};

struct player_host {
	void *ctx;
	/* May another event be handed over? False: player_turn again when it may. */
	bool (*room)(void *ctx);
	/* Handles one event. 0 or -errno with a sentence: the replay ends there. */
	int (*event)(void *ctx, const struct replay_event *, char error[REPLAY_ERROR_MAX]);
	/* While it seeks, and while it plays as fast as can be, nothing need be meshed or told; `on` false: the place is reached. */
	void (*rushing)(void *ctx, bool on);
	/* The map is void: the recording is gone through again from a beginning, as a new generation. */
	void (*again)(void *ctx);
	/* The end of the recording: what waits is handed out. */
	void (*ended)(void *ctx);
};

struct player;
/* Borrows the replay. NULL when memory is out. */
struct player *player_create(struct replay *, const struct player_host *, double speed);
void player_destroy(struct player *);

/* Hands over what is due at `mono_ns`, at most PLAYER_EVENTS_MAX events; the time at which to call again (INT64_MAX:
 * when there is room, or when somebody plays or seeks). */
#define PLAYER_EVENTS_MAX 256 /* in one turn */
int64_t player_turn(struct player *, int64_t mono_ns);

/* From clients. player_turn after each. False with a sentence where it cannot be. */
void player_play(struct player *, bool play, int64_t mono_ns); /* from the end: from the start again */
bool player_seek(struct player *, int64_t t_ns, int64_t mono_ns, char error[200]);
bool player_speed(struct player *, double speed, int64_t mono_ns, char error[200]); /* 0: max */
void player_status(const struct player *, int64_t mono_ns, struct player_status *ret);
const char *player_state_name(enum player_state);
/* What ended it early; empty: nothing did. */
const char *player_error(const struct player *);

#endif

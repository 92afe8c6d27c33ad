/* The recorded clock runs `speed` times as fast as the real one from an anchor: (real time, recorded time). Whatever changes the
 * pace (pausing, another speed, a seek, a host without room) sets the anchor anew where the player stands, so nothing is ever
 * caught up in a rush. */
#include "daemon/player.h"

#include <stdio.h>
#include <stdlib.h>

#define ROUNDED_NS 1000000
#define LATE_NS    200000000 /* of real time: farther behind, the recorded clock waits */

struct player {
	struct replay *replay;
	struct player_host host;
	enum player_state state;
	bool play; /* what it is to be after a seek */
	double speed;
	int64_t anchor_mono_ns, anchor_ns;
	int64_t begin_ns, end_ns, now_ns;
	int64_t target_ns; /* of a seek */
	uint64_t seeks;
	bool anchored, rushes;
	char error[REPLAY_ERROR_MAX];
};

struct player *player_create(struct replay *replay, const struct player_host *host, double speed)
{
	struct player *p = calloc(1, sizeof(*p));

	if (!p)
		return NULL;
	p->replay = replay;
	p->host = *host;
	p->speed = speed;
	p->play = true;
	replay_span(replay, &p->begin_ns, &p->end_ns);
	p->now_ns = p->begin_ns;
	return p;
}

void player_destroy(struct player *p)
{
	free(p);
}

/* Where it stands: between two events the recorded clock goes on, too, but never beyond what comes next. */
static int64_t position_ns(const struct player *p, int64_t mono_ns)
{
	const int64_t next_ns = replay_next_ns(p->replay);
	int64_t ran_ns;

	if (p->state != PLAYER_PLAYING || p->speed == 0 || !p->anchored || next_ns == INT64_MAX)
		return p->now_ns;
	ran_ns = p->anchor_ns + (int64_t)((double)(mono_ns - p->anchor_mono_ns) * p->speed);
	if (ran_ns > next_ns)
		ran_ns = next_ns;
	return ran_ns > p->now_ns ? ran_ns : p->now_ns;
}

static void anchor(struct player *p, int64_t mono_ns)
{
	p->anchored = true;
	p->anchor_mono_ns = mono_ns;
	p->anchor_ns = p->now_ns;
}

/* Real time at which an event of `log_ns` is due. */
static int64_t due_ns(const struct player *p, int64_t log_ns)
{
	if (p->speed == 0)
		return p->anchor_mono_ns;
	return p->anchor_mono_ns + (int64_t)((double)(log_ns - p->anchor_ns) / p->speed);
}

static void tell_rush(struct player *p)
{
	const bool rushes = p->state == PLAYER_SEEKING || (p->state == PLAYER_PLAYING && p->speed == 0);

	if (rushes == p->rushes)
		return;
	p->rushes = rushes;
	p->host.rushing(p->host.ctx, rushes);
}

static void end(struct player *p)
{
	p->state = PLAYER_ENDED;
	p->now_ns = p->end_ns;
	tell_rush(p);
	p->host.ended(p->host.ctx);
}

/* The place is reached. */
static void arrive(struct player *p, int64_t mono_ns)
{
	p->state = p->play ? PLAYER_PLAYING : PLAYER_PAUSED;
	p->now_ns = p->target_ns;
	anchor(p, mono_ns);
	tell_rush(p);
}

/* False: nothing follows. */
static bool hand_over(struct player *p)
{
	struct replay_event event;
	int r = replay_next(p->replay, &event, p->error);

	if (r == 1) {
		p->now_ns = event.log_ns > p->now_ns ? event.log_ns : p->now_ns;
		r = p->host.event(p->host.ctx, &event, p->error) < 0 ? -1 : 1;
	}
	if (r != 1)
		end(p);
	return r == 1;
}

int64_t player_turn(struct player *p, int64_t mono_ns)
{
	int64_t wait_ns;

	tell_rush(p);
	if (!p->anchored)
		anchor(p, mono_ns);
	for (int i = 0; i < PLAYER_EVENTS_MAX; i++) {
		const int64_t next_ns = replay_next_ns(p->replay);

		if (p->state == PLAYER_PAUSED || p->state == PLAYER_ENDED)
			return INT64_MAX;
		if (p->state == PLAYER_SEEKING && next_ns > p->target_ns && next_ns != INT64_MAX) {
			arrive(p, mono_ns);
			continue;
		}
		wait_ns = p->state == PLAYER_PLAYING && next_ns != INT64_MAX ? due_ns(p, next_ns) - mono_ns : 0;
		if (wait_ns > 0)
			return mono_ns + wait_ns;
		if (!p->host.room(p->host.ctx))
			return INT64_MAX;
		if (!hand_over(p))
			return INT64_MAX;
		if (wait_ns < -LATE_NS)
			anchor(p, mono_ns);
	}
	return mono_ns;
}

/* Everything before the place is gone through again. */
static bool begin_again(struct player *p, int64_t t_ns)
{
	const int64_t from_ns = replay_back_ns(p->replay, t_ns);

	if (replay_back(p->replay, t_ns, p->error) < 0) {
		end(p);
		return false;
	}
	*p->error = 0;
	p->now_ns = from_ns;
	p->host.again(p->host.ctx);
	return true;
}

static bool seek(struct player *p, int64_t t_ns, int64_t mono_ns)
{
	const bool back = t_ns < p->now_ns || p->state == PLAYER_ENDED;

	if (back && !begin_again(p, t_ns))
		return false;
	p->state = PLAYER_SEEKING;
	tell_rush(p);
	p->target_ns = t_ns;
	p->seeks++;
	anchor(p, mono_ns);
	return true;
}

void player_play(struct player *p, bool play, int64_t mono_ns)
{
	p->play = play;
	p->now_ns = position_ns(p, mono_ns);
	if (p->state == PLAYER_ENDED && play)
		seek(p, p->begin_ns, mono_ns);
	else if (p->state == PLAYER_PLAYING || p->state == PLAYER_PAUSED)
		p->state = play ? PLAYER_PLAYING : PLAYER_PAUSED;
	anchor(p, mono_ns);
	tell_rush(p);
}

bool player_seek(struct player *p, int64_t t_ns, int64_t mono_ns, char error[200])
{
	if (t_ns < p->begin_ns && t_ns > p->begin_ns - ROUNDED_NS) /* seconds as a double */
		t_ns = p->begin_ns;
	if (t_ns > p->end_ns && t_ns < p->end_ns + ROUNDED_NS)
		t_ns = p->end_ns;
	if (t_ns < p->begin_ns || t_ns > p->end_ns) {
		snprintf(error, 200, "the recording reaches from %.3f to %.3f: seek within it",
		         (double)p->begin_ns / 1e9, (double)p->end_ns / 1e9);
		return false;
	}
	if (!seek(p, t_ns, mono_ns)) {
		snprintf(error, 200, "%.199s", p->error);
		return false;
	}
	return true;
}

bool player_speed(struct player *p, double speed, int64_t mono_ns, char error[200])
{
	if (speed != 0 && !(speed >= PLAYER_SPEED_MIN && speed <= PLAYER_SPEED_MAX)) {
		snprintf(error, 200, "the speed is from %g to %g, or \"max\"", PLAYER_SPEED_MIN, PLAYER_SPEED_MAX);
		return false;
	}
	p->now_ns = position_ns(p, mono_ns);
	p->speed = speed;
	anchor(p, mono_ns);
	tell_rush(p);
	return true;
}

void player_status(const struct player *p, int64_t mono_ns, struct player_status *ret)
{
	*ret = (struct player_status){p->state, p->begin_ns, p->end_ns, position_ns(p, mono_ns), p->speed, p->seeks};
}

const char *player_state_name(enum player_state state)
{
	static const char *const name[] = {[PLAYER_PLAYING] = "playing",
	                                   [PLAYER_PAUSED] = "paused",
	                                   [PLAYER_SEEKING] = "seeking",
	                                   [PLAYER_ENDED] = "ended"};

	return name[state];
}

const char *player_error(const struct player *p)
{
	return p->error;
}

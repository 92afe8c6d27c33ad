/* When was a telegram measured? Its end lies on a grid, since the mirror turns evenly; its arrival lies a delay behind, and
 * delays are only ever positive. So the grid touches the least delayed arrivals from below: a lower envelope.
 *
 *   true ends     |----|----|----|----|----|----|----|       period 13.3 ms; delays: USB 16 ms, scheduling, a stall
 *   arrivals        x    x     x      .    .  xxx  x          three at once: a backlog
 *
 * Two kinds of streams ask for two rules, because a late telegram means two things:
 *  - A steady stream (a telegram each scan): a late one waited somewhere, and others wait behind it. It gets the time that
 *    was its turn, and so do those behind it, though they arrive at one instant. Only when the next is late too, and did not
 *    come at the heels of the first, was a telegram lost; then the missing periods are conceded (after more of them where
 *    arrivals are ragged; at once where the caller saw a telegram being lost). The phase is the least
 *    delay of the last runs of telegrams, so that a device that runs slow is followed; a quicker arrival moves it at once.
 *  - A stream with gaps (a slow line skips scans; a recording is played at its reader's pace): how many periods passed is
 *    told by the arrival alone, as the last grid point before it. Delays have to be below a period then, and the phase is
 *    known up to whole periods only: it is the one of the last arrivals' phases from which all of them are least delayed,
 *    in squares. The plain least would follow a single late arrival round the circle; a sum, the crowd and not the edge.
 *
 * A stamp later than its arrival would be impossible; one not later than the one before would turn time round. */
#include "drivers/clock_filter.h"

#include <assert.h>

#define GAP_NS          2000000000LL
#define WAIT_MAX_NS     250000000LL /* no line keeps more than this for a host that stalls */
#define STEADY          4           /* telegrams without a gap make a steady stream */
#define RUN             32          /* telegrams whose least delay is taken */
#define PATIENCE        2           /* late telegrams running: one was lost */
#define PATIENCE_RAGGED 16          /* ... where late ones were seen to be only late, */
#define CALM            128         /* so many telegrams ago or less */

void clock_filter_init(struct clock_filter *f, int64_t period_ns)
{
	assert(period_ns > 0);
	*f = (struct clock_filter){.period_ns = period_ns, .patience = PATIENCE};
}

static void phases_fill(struct clock_filter *f, int n)
{
	for (int i = 0; i < n; i++)
		f->phase_ns[i] = 0;
	f->phases = n;
	f->oldest = 0;
}

static int64_t start(struct clock_filter *f, int64_t arrival_ns)
{
	clock_filter_init(f, f->period_ns);
	f->started = true;
	f->last_ns = f->last_arrival_ns = arrival_ns;
	phases_fill(f, 1);
	return arrival_ns;
}

static int64_t modulo(int64_t value, int64_t period)
{
	int64_t rest = value % period;
	return rest < 0 ? rest + period : rest;
}

/* How far the grid has to move so that the arrivals kept are least behind it, in squares (of microseconds: no overflow). */
static int64_t best_phase(const struct clock_filter *f)
{
	int64_t best = 0, least = INT64_MAX;
	for (int i = 0; i < f->phases; i++) {
		int64_t sum = 0;
		for (int k = 0; k < f->phases; k++) {
			int64_t behind_us = modulo(f->phase_ns[k] - f->phase_ns[i], f->period_ns) / 1000;
			sum += behind_us * behind_us;
		}
		if (sum < least || (sum == least && f->phase_ns[i] < best)) {
			least = sum;
			best = f->phase_ns[i];
		}
	}
	return best;
}

/* `expected` is a point of the grid, the arrival less than a period behind it (or up to half a period before). */
static int64_t stamp_with_gaps(struct clock_filter *f, int64_t arrival_ns, int64_t expected)
{
	int64_t newest = modulo(arrival_ns - expected, f->period_ns);
	if (f->phases < CLOCK_FILTER_PHASES) {
		f->phase_ns[f->phases++] = newest;
	} else {
		f->phase_ns[f->oldest] = newest;
		f->oldest = (f->oldest + 1) % CLOCK_FILTER_PHASES;
	}
	int64_t shift = best_phase(f);
	for (int i = 0; i < f->phases; i++)
		f->phase_ns[i] = modulo(f->phase_ns[i] - shift, f->period_ns);
	return arrival_ns - modulo(newest - shift, f->period_ns);
}

static int64_t stamp_steady(struct clock_filter *f, int64_t arrival_ns, int64_t expected)
{
	int64_t delay = arrival_ns - expected;
	if (delay < 0) {
		f->least_ns[0] = 0;
		return arrival_ns;
	}
	f->least_ns[0] = delay < f->least_ns[0] ? delay : f->least_ns[0];
	if (++f->counted < RUN)
		return expected;
	int64_t least = f->least_ns[0] < f->least_ns[1] ? f->least_ns[0] : f->least_ns[1];
	f->least_ns[1] = f->least_ns[0] - least;
	f->least_ns[0] = INT64_MAX;
	f->counted = 0;
	return expected + least;
}

/* A late telegram and no other behind it: arrivals are ragged by more than a period, and lateness means less. */
static void note_raggedness(struct clock_filter *f, bool only_late)
{
	f->calm = only_late ? 0 : f->calm + (f->calm <= CALM);
	if (only_late)
		f->patience = PATIENCE_RAGGED;
	else if (f->calm > CALM)
		f->patience = PATIENCE;
}

/* Periods that passed without a telegram, when this one came `delay_ns` after the one that was next. */
static int64_t skipped_periods(struct clock_filter *f, int64_t delay_ns, bool at_heels)
{
	if (delay_ns < f->period_ns) {
		note_raggedness(f, f->late > 0 && !at_heels);
		f->late = 0;
		return 0;
	}
	bool steady = f->steady >= STEADY && delay_ns <= WAIT_MAX_NS;
	if (steady && (at_heels || (!f->lost && f->late + 1 < f->patience))) {
		f->late += !at_heels;
		return 0;
	}
	f->late = 0;
	return delay_ns / f->period_ns;
}

static void note_pace(struct clock_filter *f, int64_t skipped)
{
	if (skipped > 0) {
		if (f->steady >= STEADY)
			phases_fill(f, CLOCK_FILTER_PHASES);
		f->steady = 0;
	} else if (f->steady < STEADY && ++f->steady == STEADY) {
		f->least_ns[0] = f->least_ns[1] = INT64_MAX;
		f->counted = 0;
	}
}

int64_t clock_filter_stamp(struct clock_filter *f, int64_t arrival_ns, int turns)
{
	assert(turns > 0);
	if (!f->started || arrival_ns - f->last_arrival_ns > GAP_NS || f->last_ns - arrival_ns > GAP_NS)
		return start(f, arrival_ns);
	int64_t apart = turns * f->period_ns, expected = f->last_ns + apart;
	bool at_heels = arrival_ns - f->last_arrival_ns < apart / 2;
	int64_t skipped = skipped_periods(f, arrival_ns - expected, at_heels);
	bool was_steady = f->steady >= STEADY;
	note_pace(f, skipped);
	expected += skipped * f->period_ns;

	int64_t stamp;
	if (was_steady && skipped == 0)
		stamp = stamp_steady(f, arrival_ns, expected);
	else if (arrival_ns < expected - f->period_ns / 2)
		stamp = arrival_ns; /* much too early: those before it were late */
	else
		stamp = stamp_with_gaps(f, arrival_ns, expected);
	if (stamp <= f->last_ns + apart - f->period_ns)
		stamp = arrival_ns;
	if (stamp <= f->last_ns)
		stamp = f->last_ns + 1;
	f->last_ns = stamp;
	f->last_arrival_ns = arrival_ns;
	f->lost = false;
	return stamp;
}

void clock_filter_lost(struct clock_filter *f)
{
	f->lost = true;
}

/* Snapshots */

static void fields(struct state *s, struct clock_filter *f)
{
	state_tag(s, "filter1");
	state_i64(s, &f->period_ns);
	state_bool(s, &f->started);
	state_time(s, &f->last_ns);
	state_time(s, &f->last_arrival_ns);
	state_int(s, &f->steady, 0, STEADY);
	state_int(s, &f->late, 0, PATIENCE_RAGGED);
	state_int(s, &f->patience, 0, PATIENCE_RAGGED);
	state_int(s, &f->calm, 0, CALM + 1);
	state_bool(s, &f->lost);
	for (int i = 0; i < CLOCK_FILTER_PHASES; i++)
		state_i64(s, &f->phase_ns[i]);
	state_int(s, &f->phases, 0, CLOCK_FILTER_PHASES);
	state_int(s, &f->oldest, 0, CLOCK_FILTER_PHASES - 1);
	state_i64(s, &f->least_ns[0]);
	state_i64(s, &f->least_ns[1]);
	state_int(s, &f->counted, 0, RUN);
}

/* What arithmetic goes on from: phases are parts of a period, and a least delay is one, or not known yet. */
static bool sane(const struct clock_filter *f, int64_t period_ns)
{
	for (int i = 0; i < CLOCK_FILTER_PHASES; i++)
		if (f->phase_ns[i] < 0 || f->phase_ns[i] >= period_ns)
			return false;
	for (int i = 0; i < 2; i++)
		if (f->least_ns[i] < 0 || (f->least_ns[i] > GAP_NS && f->least_ns[i] < INT64_MAX - GAP_NS))
			return false;
	return f->period_ns == period_ns && (f->phases > 0 || !f->started);
}

void clock_filter_state(struct state *s, struct clock_filter *f)
{
	struct clock_filter aside = *f;

	fields(s, &aside);
	if (s->loading && !s->failed && !sane(&aside, f->period_ns))
		s->failed = true;
	if (s->loading && !s->failed)
		*f = aside;
}

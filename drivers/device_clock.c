/* The line that touches the least delayed arrivals from below, kept over a sliding window.
 *
 * Which line: of all that lie below the points, the one that is nearest to them on average. It is the edge of their lower
 * convex hull over the mean of their times (a linear programme in two unknowns, so two points decide), and it needs no
 * idea of how delays are distributed. The window is some thousand stamps long, but a late point can never belong to the
 * hull if an earlier and a later one lie below: one point an interval is kept, the least delayed, 64 intervals make the
 * window. Intervals begin short, so that a young clock has points too, and are joined in pairs until they are as long as
 * a window needs: a minute for a crystal, whose rate is steady, sixteen seconds for a motor, whose rate is less so.
 *
 * How often a counter came round is told by the arrival: the stamp lies at or before it, by less than three quarters of
 * a turn. Where the drift leaves that open (a mirror's 256 turns, nothing heard for 40 s), the clock begins anew.
 *
 * A stamp that does not fit the line (20 ms early, or late) is one of these:
 *   late, and those behind it less and less      a backlog: the line is right
 *   early or elsewhere, and those behind it fit it     the device was switched on again: another line
 *   alone                                         rubbish
 * so it is doubted, answered as what is likeliest, and the new time is believed when a run of stamps agrees on it. Late
 * ones need a longer run: a path that got slower looks the same.
 *
 * Arithmetic: times are integers, relative to a point of the envelope before they become double, in a fixed order. */
#include "drivers/device_clock.h"

#include <assert.h>
#include <math.h>
#include <string.h>

#define MS             1000000ll
#define WINDOW_NS      (64000 * MS) /* of a crystal */
#define WINDOW_MOTOR   (16000 * MS)
#define MOTOR          1e-3 /* drift of more than this is no crystal's */
#define FIRST_PART     16   /* the first intervals are so much shorter than the last */
#define SURPRISE_NS    (20 * MS)
#define YOUNG_NS       (5000 * MS)  /* so early, arrivals earlier than all before only say that those were late */
#define RUN_NS         (200 * MS)   /* stamps that agree for so long on another time are believed */
#define RUN_LATE_NS    (3000 * MS)  /* ... where they could as well have waited somewhere */
#define DOUBT_MAX_NS   (10000 * MS) /* nothing agrees on anything: begin anew */
#define BACKLOG_MAX_NS (10000 * MS)
#define WRAP_MAX_NS    1e18
#define TIME_MAX_NS    3000000000000000000ll /* decades: sums of three do not overflow */

static bool kind_sane(double tick_ns, uint64_t wrap, double drift_max)
{
	return tick_ns >= 1 && tick_ns <= 1e9 && wrap >= 2 && wrap <= 1ull << 32 &&
	       (double)wrap * tick_ns <= WRAP_MAX_NS && drift_max > 0 && drift_max <= 0.1;
}

void device_clock_init(struct device_clock *c, double tick_ns, uint64_t wrap, double drift_max)
{
	assert(kind_sane(tick_ns, wrap, drift_max));
	memset(c, 0, sizeof(*c));
	c->tick_ns = tick_ns;
	c->wrap = wrap;
	c->drift_max = drift_max;
}

void device_clock_restart(struct device_clock *c)
{
	device_clock_init(c, c->tick_ns, c->wrap, c->drift_max);
}

/* Device time ----------------------------------------------------------------------------------------------------- */

static int64_t clamp_time(int64_t t_ns)
{
	return t_ns < 0 ? 0 : t_ns > TIME_MAX_NS ? TIME_MAX_NS : t_ns;
}

static int64_t window_ns(const struct device_clock *c)
{
	return c->drift_max > MOTOR ? WINDOW_MOTOR : WINDOW_NS;
}

static int64_t ticks_to_ns(const struct device_clock *c, int64_t ticks)
{
	return (int64_t)rint((double)ticks * c->tick_ns);
}

static int64_t ns_to_ticks(const struct device_clock *c, int64_t ns)
{
	return (int64_t)rint((double)ns / c->tick_ns);
}

static int64_t modulo(int64_t value, int64_t period)
{
	const int64_t rest = value % period;

	return rest < 0 ? rest + period : rest;
}

/* The line's log time of `ticks`. */
static int64_t line_ns(const struct device_clock *c, int64_t ticks)
{
	const double since_ns = (double)ticks_to_ns(c, ticks - c->touches.ticks);

	return ticks_to_ns(c, ticks) + c->touches.delay_ns + (int64_t)rint(c->slope * since_ns);
}

/* Unwraps `tick`, which arrives at `arrival_ns`, by a moment (`ticks` was at `t_ns`) not long ago. */
static int64_t unwrap(const struct device_clock *c, uint32_t tick, int64_t arrival_ns, int64_t ticks, int64_t t_ns)
{
	const int64_t wrap = (int64_t)c->wrap;
	const int64_t now = ticks + ns_to_ticks(c, (int64_t)rint((double)(arrival_ns - t_ns) / (1 + c->slope)));
	int64_t behind = modulo(now - (int64_t)tick, wrap);

	if (behind >= wrap - wrap / 4)
		behind -= wrap;
	return now - behind;
}

/* The envelope ---------------------------------------------------------------------------------------------------- */

static int64_t interval_of(const struct device_clock *c, const struct device_clock_point *p)
{
	return (p->ticks - modulo(p->ticks, c->interval_tick)) / c->interval_tick;
}

/* Is `a` less delayed than `b`, as seen along the line? */
static bool lower(const struct device_clock *c, const struct device_clock_point *a, const struct device_clock_point *b)
{
	return (double)(a->delay_ns - b->delay_ns) < c->slope * (double)ticks_to_ns(c, a->ticks - b->ticks);
}

/* Intervals twice as long: of each pair of points the lower one stays. */
static void join_pairs(struct device_clock *c)
{
	int n = 0;

	c->interval_tick *= 2;
	for (int i = 0; i < c->points; i++) {
		if (n > 0 && interval_of(c, &c->point[n - 1]) == interval_of(c, &c->point[i])) {
			if (lower(c, &c->point[i], &c->point[n - 1]))
				c->point[n - 1] = c->point[i];
		} else {
			c->point[n++] = c->point[i];
		}
	}
	c->points = n;
}

static void drop_oldest(struct device_clock *c, int n)
{
	c->points -= n;
	memmove(c->point, c->point + n, (size_t)c->points * sizeof(c->point[0]));
}

/* Did it change the points? */
static bool add_point(struct device_clock *c, struct device_clock_point p)
{
	int old = 0;

	while (old < c->points && ticks_to_ns(c, p.ticks - c->point[old].ticks) > window_ns(c))
		old++;
	drop_oldest(c, old);
	if (c->points > 0 && interval_of(c, &c->point[c->points - 1]) == interval_of(c, &p)) {
		if (lower(c, &p, &c->point[c->points - 1]))
			c->point[c->points - 1] = p;
		else if (old == 0)
			return false;
		return true;
	}
	if (c->points == DEVICE_CLOCK_POINTS && ticks_to_ns(c, c->interval_tick) < window_ns(c) / DEVICE_CLOCK_POINTS)
		join_pairs(c);
	if (c->points == DEVICE_CLOCK_POINTS)
		drop_oldest(c, 1);
	c->point[c->points++] = p;
	return true;
}

/* Lower convex hull of the points: their indices, left to right. Returns how many. */
static int hull(const struct device_clock *c, int ret[DEVICE_CLOCK_POINTS])
{
	int n = 0;

	for (int i = 0; i < c->points; i++) {
		while (n >= 2) {
			const struct device_clock_point *a = &c->point[ret[n - 2]], *b = &c->point[ret[n - 1]];
			const double bx = (double)(b->ticks - a->ticks), by = (double)(b->delay_ns - a->delay_ns);
			const double px = (double)(c->point[i].ticks - a->ticks);
			const double py = (double)(c->point[i].delay_ns - a->delay_ns);

			if (bx * py > by * px) /* b lies below the line from a to the new point */
				break;
			n--;
		}
		ret[n++] = i;
	}
	return n;
}

/* Slope of the hull's edge over the mean of the points' times. */
static double edge_slope(const struct device_clock *c)
{
	int corner[DEVICE_CLOCK_POINTS], k = 1;
	const int n = hull(c, corner);
	int64_t mean = 0;

	for (int i = 0; i < c->points; i++)
		mean += c->point[i].ticks - c->point[0].ticks;
	mean = c->point[0].ticks + mean / c->points;
	while (k < n - 1 && c->point[corner[k]].ticks <= mean)
		k++;
	const struct device_clock_point *a = &c->point[corner[k - 1]], *b = &c->point[corner[k]];
	const double slope = (double)(b->delay_ns - a->delay_ns) / (double)ticks_to_ns(c, b->ticks - a->ticks);
	return slope > c->drift_max ? c->drift_max : slope < -c->drift_max ? -c->drift_max : slope;
}

/* A line is drawn through nothing shorter than an interval of a full window: a moment's jitter is no drift. */
static void fit(struct device_clock *c)
{
	const int64_t span_ns = ticks_to_ns(c, c->point[c->points - 1].ticks - c->point[0].ticks);
	int least = 0;

	if (c->points >= 2 && span_ns >= window_ns(c) / DEVICE_CLOCK_POINTS)
		c->slope = edge_slope(c);
	for (int i = 1; i < c->points; i++)
		if (lower(c, &c->point[i], &c->point[least]))
			least = i;
	c->touches = c->point[least];
	c->drift = -c->slope / (1 + c->slope);
}

/* Stamps ---------------------------------------------------------------------------------------------------------- */

/* A new line, through a single point. */
static void begin(struct device_clock *c, int64_t ticks, int64_t delay_ns, int64_t arrival_ns, double slope)
{
	const int64_t first_ns = window_ns(c) / DEVICE_CLOCK_POINTS / FIRST_PART;

	c->started = true;
	c->doubted = false;
	c->ticks = c->born_ticks = ticks;
	c->believed_ns = arrival_ns;
	c->interval_tick = ns_to_ticks(c, first_ns) > 0 ? ns_to_ticks(c, first_ns) : 1;
	c->points = 0;
	c->slope = slope;
	add_point(c, (struct device_clock_point){ticks, delay_ns});
	fit(c);
}

static bool too_long_ago(const struct device_clock *c, int64_t arrival_ns)
{
	const double gap_ns = (double)(arrival_ns - c->believed_ns);

	return gap_ns < 0 ? gap_ns < -2e9 : gap_ns * c->drift_max > (double)c->wrap * c->tick_ns / 8;
}

/* Another stamp that does not fit the line, `late_ns` behind it. Answers its log time; the line is another one where
 * these have said long enough that it has to be. */
static int64_t doubt(struct device_clock *c, uint32_t tick, int64_t ticks, int64_t late_ns, int64_t arrival_ns)
{
	const bool waited = late_ns > 0 && late_ns <= BACKLOG_MAX_NS && ticks > c->ticks;
	int64_t here = ticks, delay_ns;

	if (c->doubted)
		here = unwrap(c, tick, arrival_ns, c->doubt_ticks, c->doubt_ns);
	delay_ns = arrival_ns - ticks_to_ns(c, here);
	const int64_t least_ns = delay_ns < c->doubt_least_ns ? delay_ns : c->doubt_least_ns;
	const int64_t most_ns = delay_ns > c->doubt_most_ns ? delay_ns : c->doubt_most_ns;
	if (!c->doubted)
		c->doubt_since_ns = arrival_ns;
	if (!c->doubted || here <= c->doubt_ticks || most_ns - least_ns > SURPRISE_NS) {
		c->doubt_run_ns = arrival_ns;
		c->doubt_least_ns = c->doubt_most_ns = delay_ns;
	} else {
		c->doubt_least_ns = least_ns;
		c->doubt_most_ns = most_ns;
	}
	c->doubted = true;
	c->doubt_ticks = here;
	c->doubt_ns = arrival_ns;
	if (arrival_ns - c->doubt_run_ns >= (waited ? RUN_LATE_NS : RUN_NS) ||
	    arrival_ns - c->doubt_since_ns >= DOUBT_MAX_NS) {
		c->restarts += c->restarts < 1000000000;
		begin(c, tick, c->doubt_least_ns + ticks_to_ns(c, here) - ticks_to_ns(c, tick), arrival_ns, 0);
		return line_ns(c, tick);
	}
	return waited ? line_ns(c, ticks) : ticks_to_ns(c, here) + c->doubt_least_ns;
}

static int64_t believe(struct device_clock *c, int64_t ticks, int64_t arrival_ns)
{
	c->doubted = false;
	if (ticks > c->ticks) {
		c->ticks = ticks;
		c->believed_ns = arrival_ns;
		if (add_point(c, (struct device_clock_point){ticks, arrival_ns - ticks_to_ns(c, ticks)}))
			fit(c);
	}
	return line_ns(c, ticks);
}

static int64_t judge(struct device_clock *c, uint32_t tick, int64_t arrival_ns, bool *ret_again)
{
	const int64_t ticks = unwrap(c, tick, arrival_ns, c->ticks, line_ns(c, c->ticks));
	const int64_t late_ns = arrival_ns - line_ns(c, ticks);
	const int64_t gap_ns = arrival_ns > c->believed_ns ? arrival_ns - c->believed_ns : 0;
	const int64_t margin_ns = SURPRISE_NS + (int64_t)rint((double)gap_ns * c->drift_max);
	const bool young = ticks_to_ns(c, c->ticks - c->born_ticks) < YOUNG_NS;

	*ret_again = ticks == c->ticks;
	if (ticks < c->ticks || late_ns > margin_ns)
		return doubt(c, tick, ticks, late_ns, arrival_ns);
	if (late_ns < -margin_ns && !young)
		return doubt(c, tick, ticks, late_ns, arrival_ns);
	if (late_ns < -margin_ns || gap_ns > window_ns(c)) {
		/* After a gap the rate is still the same; where the line is, only what comes now can say. */
		begin(c, ticks, arrival_ns - ticks_to_ns(c, ticks), arrival_ns, gap_ns > window_ns(c) ? c->slope : 0);
		return arrival_ns;
	}
	return believe(c, ticks, arrival_ns);
}

int64_t device_clock_stamp(struct device_clock *c, uint32_t tick, int64_t arrival_ns)
{
	const int64_t arrived_ns = clamp_time(arrival_ns);
	bool again = false;
	int64_t t_ns;

	if ((uint64_t)tick >= c->wrap)
		tick = (uint32_t)(tick % c->wrap);
	if (!c->started || too_long_ago(c, arrived_ns) || c->ticks > ns_to_ticks(c, TIME_MAX_NS)) {
		begin(c, tick, arrived_ns - ticks_to_ns(c, tick), arrived_ns, 0);
		t_ns = arrived_ns;
	} else {
		t_ns = judge(c, tick, arrived_ns, &again);
	}
	if (again && tick == c->answered)
		return c->answered_ns;
	if (t_ns > arrived_ns)
		t_ns = arrived_ns;
	if (c->arrival_ns <= arrived_ns && t_ns <= c->answered_ns && c->answers)
		t_ns = c->answered_ns + 1;
	jitter_note(&c->jitter, arrived_ns - t_ns);
	c->answered = tick;
	c->answered_ns = t_ns;
	c->answers = true;
	c->arrival_ns = arrived_ns;
	c->offset_ns = t_ns - ticks_to_ns(c, c->doubted ? c->doubt_ticks : c->ticks);
	return t_ns;
}

int64_t device_clock_at(const struct device_clock *c, uint32_t tick)
{
	const int64_t wrap = (int64_t)c->wrap;
	int64_t ticks = modulo((int64_t)tick - (int64_t)c->answered, wrap);

	if (ticks >= wrap / 2)
		ticks -= wrap;
	const double since_ns = (double)ticks_to_ns(c, ticks);
	return c->answered_ns + (int64_t)rint(since_ns + c->slope * since_ns);
}

void device_clock_jitter(const struct device_clock *c, int64_t *ret_p50_ns, int64_t *ret_p99_ns)
{
	jitter_percentiles(&c->jitter, ret_p50_ns, ret_p99_ns);
}

/* Snapshots ------------------------------------------------------------------------------------------------------- */

static bool time_sane(int64_t t_ns)
{
	return t_ns >= 0 && t_ns <= TIME_MAX_NS + 1;
}

static bool ticks_sane(const struct device_clock *c, int64_t ticks)
{
	return fabs((double)ticks * c->tick_ns) <= TIME_MAX_NS + WRAP_MAX_NS;
}

static bool delay_sane(int64_t delay_ns)
{
	return delay_ns >= -TIME_MAX_NS - (int64_t)WRAP_MAX_NS && delay_ns <= TIME_MAX_NS + (int64_t)WRAP_MAX_NS;
}

static bool points_sane(const struct device_clock *c)
{
	if (c->points < 1)
		return false;
	const struct device_clock_point *first = &c->point[0], *last = &c->point[c->points - 1];

	for (int i = 0; i < c->points; i++)
		if (!ticks_sane(c, c->point[i].ticks) || !delay_sane(c->point[i].delay_ns) ||
		    (i > 0 && c->point[i].ticks <= c->point[i - 1].ticks))
			return false;
	return last->ticks <= c->ticks && ticks_to_ns(c, c->ticks - first->ticks) <= 2 * window_ns(c) &&
	       c->touches.ticks >= first->ticks && c->touches.ticks <= last->ticks && delay_sane(c->touches.delay_ns);
}

static bool doubt_sane(const struct device_clock *c)
{
	return !c->doubted ||
	       (time_sane(c->doubt_since_ns) && time_sane(c->doubt_run_ns) && time_sane(c->doubt_ns) &&
	        ticks_sane(c, c->doubt_ticks) && delay_sane(c->doubt_least_ns) && delay_sane(c->doubt_most_ns));
}

/* Everything that arithmetic goes on from. */
static bool sane(const struct device_clock *c)
{
	if (!kind_sane(c->tick_ns, c->wrap, c->drift_max) || !time_sane(c->arrival_ns) || !time_sane(c->answered_ns) ||
	    c->answered >= c->wrap || !(fabs(c->slope) <= c->drift_max) || !(fabs(c->drift) < 1))
		return false;
	if (!c->started)
		return true;
	return ticks_sane(c, c->ticks) && ticks_sane(c, c->born_ticks) && time_sane(c->believed_ns) &&
	       c->interval_tick > 0 && c->interval_tick <= ns_to_ticks(c, window_ns(c)) + 1 && points_sane(c) &&
	       doubt_sane(c) && time_sane(line_ns(c, c->ticks));
}

static void fields(struct state *s, struct device_clock *c)
{
	state_tag(s, "devclk1");
	state_double(s, &c->tick_ns);
	state_u64(s, &c->wrap);
	state_double(s, &c->drift_max);
	state_bool(s, &c->started);
	state_i64(s, &c->ticks);
	state_i64(s, &c->born_ticks);
	state_i64(s, &c->believed_ns);
	state_i64(s, &c->arrival_ns);
	state_u32(s, &c->answered);
	state_i64(s, &c->answered_ns);
	state_bool(s, &c->answers);
	state_i64(s, &c->interval_tick);
	state_int(s, &c->points, 0, DEVICE_CLOCK_POINTS);
	for (int i = 0; i < c->points; i++) {
		state_i64(s, &c->point[i].ticks);
		state_i64(s, &c->point[i].delay_ns);
	}
	state_double(s, &c->slope);
	state_i64(s, &c->touches.ticks);
	state_i64(s, &c->touches.delay_ns);
	state_bool(s, &c->doubted);
	state_i64(s, &c->doubt_since_ns);
	state_i64(s, &c->doubt_run_ns);
	state_i64(s, &c->doubt_ns);
	state_i64(s, &c->doubt_ticks);
	state_i64(s, &c->doubt_least_ns);
	state_i64(s, &c->doubt_most_ns);
	state_i64(s, &c->offset_ns);
	state_double(s, &c->drift);
	state_int(s, &c->restarts, 0, 1000000000);
}

void device_clock_state(struct state *s, struct device_clock *c)
{
	struct device_clock aside = *c;

	fields(s, &aside);
	if (s->loading && !s->failed && !sane(&aside))
		s->failed = true;
	if (s->loading && !s->failed)
		*c = aside;
}

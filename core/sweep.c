/* Sweep assembly (design 1.2; protocols A.9, E): profiles wait in a ring until samples of the tilt and of the pose frame them,
 * then become rows; every beam is placed with the tilt and the pose of its own time.
 *
 *   p_map = P(t) . B . Ry(theta(t)) . L . (r cos b, r sin b, 0)      P map <- base, B base <- tilt axis, L tilt <- laser
 *
 * Turns. A mirror turns at 75 Hz and measures a raster of 1 degree; finer ones take 2 or 4 turns, interlaced: beam k of the
 * profile belongs to turn k mod 2 (4). A servo that moves is at another angle in each turn, so each turn is a row of its own,
 * with its own first bearing. Where the servo stood they are one row again, since neighbours then are 0.5 degree apart,
 * not 1, and no two rows lie upon each other. Partial scans arrive a turn at a time and are rows as they are; where the servo
 * stood for all of a raster they are one row too, for which the first ones then wait.
 *
 * Waiting. `hold` is judged when the next record is handled, by its log time (law L7). When it is over, the tilt goes on in a
 * line for 1.5 of its periods, the pose for 50 ms with its last twist; a row with a beam beyond that is dropped whole:
 * half a row would look like free space next to a wall. Before the first sample there is nothing to go on from.
 *
 * Sweeps. Rows between two turns of the servo are one raster. Noise must not make turns: the angle has to come back by more
 * than TURN_RAD from its extreme. A jump (a fly-back, a robot that went on while rows were dropped, a map that was moved
 * under the robot, a servo that was not heard) also cuts the raster: no surface may be spanned between rows that were not
 * measured next to each other. After a cut the direction is unknown, so that a fly-back counts once.
 *
 * Jumps of the pose. Every jump begins a new frame, and nothing lies between poses of two frames: a row is placed in the
 * frame of its first beam, beyond whose last pose it goes on for 50 ms as beyond the newest.
 *
 * The samples live in rings of fixed size, old ones give way; a sample not newer than the last is ignored, unless it is
 * older by seconds: then the device's time was set back and its ring begins anew. */
#include "core/sweep.h"

#include <assert.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#include "core/mixed.h"
#include "core/trig.h"

#define FANS                4            /* partial scans of a raster */
#define SOURCES_MAX         4            /* turns of the mirror in a row */
#define RING                1024         /* samples, a power of two: 1 s at 1 kHz */
#define SET_BACK_NS         2000000000LL /* older by more than this: time was set back */
#define POSE_EXTRAPOLATE_NS 50000000LL
#define POSE_GAP_NS         500000000LL /* and `hold`: between poses that are interpolated */
#define POSE_STOOD_M        0.02
#define POSE_STOOD_TURN     1e-5         /* 1 - cosine of half the angle: half a degree */
#define TWIST_BASE_NS       5000000LL    /* the two poses of a twist are at least so far apart ... */
#define TWIST_OLDEST_NS     1000000000LL /* ... and no farther than this */
#define PERIODS             9            /* intervals whose median is the tilt's sample period */
#define STOOD_RAD           (0.02 * TRIG_DEG)
#define TURN_RAD            (0.1 * TRIG_DEG)
#define CUT_RAD             (5 * TRIG_DEG) /* between neighbouring rows of one raster */
#define CUT_M               0.5
#define NEAR_RAD            0.02
#define SWEEP_ROWS_MAX      2048
#define LOST_MAX            (1u << 20) /* in a snapshot: more would be said one by one for a while */

struct held {
	struct profile profile;
	int64_t log_ns;
};

/* Cosine and sine of the bearings of profiles. */
struct fan {
	double first_rad, step_rad;
	uint32_t n;
	double (*beam)[2];
};

/* A pose, and the frame it is in: nothing lies between poses of different frames. */
struct framed {
	struct pose pose;
	uint32_t frame;
};

/* Samples, each beginning with its time; number i lives at i % RING. Times rise strictly. */
struct ring {
	uint64_t begin, end;
	size_t size;           /* of a sample, bytes */
	unsigned char *sample; /* [RING], owned */
};

struct sweep {
	struct sweep_params params;
	struct held *held; /* ring of SWEEP_PROFILES_WAITING_MAX */
	uint32_t head, waiting;
	int turn, turns; /* of the profile at the head: next row, and how many; turns 0: not judged yet */
	uint64_t lost;   /* rows lost with profiles that found the ring full, not reported yet */

	struct ring tilt, pose;
	uint32_t frame;       /* of the newest pose: one more with every jump */
	uint32_t frame_first; /* what was measured in an earlier one is of another map */

	struct fan fan[FANS]; /* by the number of a partial scan */

	/* The raster so far. */
	bool started;
	bool torn; /* the tilt was lost for a while: the next row is no neighbour of the last one */
	uint32_t last_frame;
	int direction;
	double extreme_rad, last_rad;
	struct vec3 last_origin;
	uint32_t sweep_rows;

	struct sweep_stats stats;
};

static bool ring_init(struct ring *ring, size_t size)
{
	*ring = (struct ring){.size = size, .sample = calloc(RING, size)};
	return ring->sample != NULL;
}

static void *ring_at(const struct ring *ring, uint64_t i)
{
	return ring->sample + i % RING * ring->size;
}

static int64_t ring_time(const struct ring *ring, uint64_t i)
{
	int64_t t_ns;
	memcpy(&t_ns, ring_at(ring, i), sizeof t_ns);
	return t_ns;
}

static void ring_put(struct ring *ring, const void *sample, int64_t t_ns)
{
	if (ring->end > ring->begin && t_ns <= ring_time(ring, ring->end - 1)) {
		if (ring_time(ring, ring->end - 1) - t_ns < SET_BACK_NS)
			return;
		ring->begin = ring->end;
	}
	if (ring->end - ring->begin == RING)
		ring->begin++;
	memcpy(ring_at(ring, ring->end++), sample, ring->size);
}

/* The number of the first sample later than t_ns. */
static uint64_t ring_after(const struct ring *ring, int64_t t_ns)
{
	uint64_t low = ring->begin, high = ring->end;
	while (low < high) {
		uint64_t middle = low + (high - low) / 2;
		if (ring_time(ring, middle) > t_ns)
			high = middle;
		else
			low = middle + 1;
	}
	return low;
}

static const struct tilt *tilt_at(const struct sweep *s, uint64_t i)
{
	return ring_at(&s->tilt, i);
}

static const struct framed *framed_at(const struct sweep *s, uint64_t i)
{
	return ring_at(&s->pose, i);
}

static const struct pose *pose_at(const struct sweep *s, uint64_t i)
{
	return &framed_at(s, i)->pose;
}

struct sweep *sweep_create(const struct sweep_params *params)
{
	struct sweep *s = calloc(1, sizeof *s);
	if (!s)
		return NULL;
	s->params = *params;
	s->held = calloc(SWEEP_PROFILES_WAITING_MAX, sizeof *s->held);
	bool good = s->held && ring_init(&s->tilt, sizeof(struct tilt)) && ring_init(&s->pose, sizeof(struct framed));
	for (int i = 0; i < FANS; i++) {
		s->fan[i].beam = malloc(PROFILE_BEAMS_MAX * sizeof *s->fan[i].beam);
		good &= s->fan[i].beam != NULL;
	}
	if (!good) {
		sweep_destroy(s);
		return NULL;
	}
	return s;
}

void sweep_destroy(struct sweep *s)
{
	if (!s)
		return;
	free(s->held);
	free(s->tilt.sample);
	free(s->pose.sample);
	for (int i = 0; i < FANS; i++)
		free(s->fan[i].beam);
	free(s);
}

/* As it was when it was new. */
static void sweep_clear(struct sweep *s)
{
	const struct sweep empty = {.params = s->params,
	                            .held = s->held,
	                            .tilt = {.size = s->tilt.size, .sample = s->tilt.sample},
	                            .pose = {.size = s->pose.size, .sample = s->pose.sample}};
	struct fan fan[FANS];
	memcpy(fan, s->fan, sizeof fan);
	*s = empty;
	memcpy(s->fan, fan, sizeof fan);
}

void sweep_stats(const struct sweep *s, struct sweep_stats *ret)
{
	*ret = s->stats;
}

const char *sweep_drop_name(enum sweep_drop drop)
{
	static const char *const names[SWEEP_DROPS] = {
	    "no tilt", "stale tilt",     "no pose",        "stale pose", "too many profiles waiting",
	    "moved",   "uncertain pose", "before the jump"};
	return drop < SWEEP_DROPS ? names[drop] : "unknown";
}

static struct held *held_at(const struct sweep *s, uint32_t i)
{
	return &s->held[(s->head + i) % SWEEP_PROFILES_WAITING_MAX];
}

static void held_pop(struct sweep *s, int n)
{
	s->head += (uint32_t)n;
	s->waiting -= (uint32_t)n;
	s->turn = s->turns = 0;
}

static int interlace_of(const struct profile *p)
{
	return p->interlace > 1 && p->interlace <= SOURCES_MAX && p->interlace <= p->n ? p->interlace : 1;
}

void sweep_profile(struct sweep *s, const struct profile *p, int64_t log_ns)
{
	assert(p->n <= PROFILE_BEAMS_MAX);
	s->stats.profiles++;
	if (p->n == 0)
		return;
	if (s->waiting == SWEEP_PROFILES_WAITING_MAX) {
		int rows = s->turns ? s->turns : interlace_of(&held_at(s, 0)->profile);
		s->lost += (uint64_t)(rows - s->turn);
		held_pop(s, 1);
	}
	struct held *held = held_at(s, s->waiting++);
	size_t n = p->n;
	memcpy(&held->profile, p, offsetof(struct profile, range_m));
	memcpy(held->profile.range_m, p->range_m, n * sizeof *p->range_m);
	memcpy(held->profile.state, p->state, n * sizeof *p->state);
	held->log_ns = log_ns;
}

/* A servo that says more turns than sines are known for says nothing (a float register may hold any number). */
void sweep_tilt(struct sweep *s, const struct tilt *sample)
{
	if (fabs(sample->angle_rad) <= TRIG_ANGLE_MAX)
		ring_put(&s->tilt, sample, sample->t_ns);
}

void sweep_pose(struct sweep *s, const struct pose *sample)
{
	struct framed framed;

	s->frame += sample->jumped;
	memset(&framed, 0, sizeof framed);
	framed.pose = *sample;
	framed.frame = s->frame;
	ring_put(&s->pose, &framed, sample->t_ns);
}

void sweep_new_map(struct sweep *s)
{
	s->frame_first = s->frame;
}

/* Median of the newest intervals between tilt samples: neither a pause nor a burst moves it. */
static int64_t tilt_period_ns(const struct sweep *s)
{
	int64_t interval[PERIODS];
	int n = 0;
	for (uint64_t i = s->tilt.end; n < PERIODS && i > s->tilt.begin + 1; i--, n++) {
		int64_t value = tilt_at(s, i - 1)->t_ns - tilt_at(s, i - 2)->t_ns;
		int k = n;
		for (; k > 0 && interval[k - 1] > value; k--)
			interval[k] = interval[k - 1];
		interval[k] = value;
	}
	return n ? interval[n / 2] : 0;
}

/* What surrounds the beams of a row: a walk through the rings, times never decreasing. */
struct walk {
	const struct sweep *s;
	uint64_t tilt_next, pose_next;           /* first samples later than the time asked for last */
	uint64_t pose_end;                       /* poses from here on are of another frame than the row's first beam */
	int64_t pose_gap_ns;                     /* between two samples at most, unless the robot stood */
	int64_t tilt_limit_ns;                   /* beyond the last tilt sample up to here */
	int64_t tilt_gap_ns;                     /* between two samples at most, unless the servo stood */
	double angle_rad, sine, cosine;          /* at the beam placed last */
	double near_rad, near_sine, near_cosine; /* of an angle close by */
	bool has_angle;
	struct transform map_base;
};

/* Readers of files hold for ever. */
static int64_t held_ns(const struct sweep *s, int64_t ns)
{
	return s->params.hold_ns < INT64_MAX - ns ? s->params.hold_ns + ns : INT64_MAX;
}

/* The frame of the pose before t_ns, and where the poses of that frame end. */
static uint32_t frame_at(const struct sweep *s, int64_t t_ns, uint64_t *ret_end)
{
	uint64_t i = ring_after(&s->pose, t_ns);
	uint32_t frame = i > s->pose.begin ? framed_at(s, i - 1)->frame : s->frame;
	while (i < s->pose.end && framed_at(s, i)->frame == frame)
		i++;
	*ret_end = i;
	return frame;
}

/* A row lies in one frame, that of its first beam, at `row_ns`: half a row moved against the other half is no row. */
static void walk_init(struct walk *w, const struct sweep *s, int64_t row_ns, int64_t t_ns)
{
	*w = (struct walk){.s = s, .tilt_next = ring_after(&s->tilt, t_ns)};
	int64_t period_ns = tilt_period_ns(s);
	w->tilt_limit_ns = period_ns + period_ns / 2;
	w->tilt_gap_ns = held_ns(s, w->tilt_limit_ns);
	w->pose_gap_ns = held_ns(s, POSE_GAP_NS);
	frame_at(s, row_ns, &w->pose_end);
	w->pose_next = ring_after(&s->pose, t_ns);
	if (w->pose_next > w->pose_end)
		w->pose_next = w->pose_end;
	w->map_base = s->params.map_base;
}

/* 0, or 1 + enum sweep_drop. */
static int walk_tilt(struct walk *w, int64_t t_ns, double *ret_rad)
{
	const struct sweep *s = w->s;
	if (s->params.fixed_tilt) {
		*ret_rad = s->params.tilt_rad;
		return 0;
	}
	while (w->tilt_next < s->tilt.end && tilt_at(s, w->tilt_next)->t_ns <= t_ns)
		w->tilt_next++;
	if (w->tilt_next == s->tilt.begin)
		return 1 + SWEEP_NO_TILT;
	const struct tilt *before = tilt_at(s, w->tilt_next - 1), *after;
	if (before->t_ns == t_ns) {
		*ret_rad = before->angle_rad;
		return 0;
	}
	if (w->tilt_next == s->tilt.end) {
		if (t_ns - before->t_ns > w->tilt_limit_ns)
			return 1 + SWEEP_STALE_TILT;
		after = before; /* go on along the last interval; there is one, or the limit were 0 */
		before = tilt_at(s, w->tilt_next - 2);
	} else {
		after = tilt_at(s, w->tilt_next);
		/* In so long a silence the servo may have turned round. */
		if (after->t_ns - before->t_ns > w->tilt_gap_ns &&
		    fabs(after->angle_rad - before->angle_rad) > STOOD_RAD)
			return 1 + SWEEP_STALE_TILT;
	}
	double share = (double)(t_ns - before->t_ns) / (double)(after->t_ns - before->t_ns);
	*ret_rad = before->angle_rad + (after->angle_rad - before->angle_rad) * share;
	return 0;
}

static struct transform pose_between(const struct pose *a, const struct pose *b, int64_t t_ns)
{
	double share = (double)(t_ns - a->t_ns) / (double)(b->t_ns - a->t_ns);
	return transform_quat(vec3_lerp(a->position_m, b->position_m, share),
	                      quat_between(a->rotation, b->rotation, share));
}

static bool pose_equal(const struct pose *a, const struct pose *b)
{
	const struct quat *p = &a->rotation, *q = &b->rotation;
	return a->position_m.x == b->position_m.x && a->position_m.y == b->position_m.y &&
	       a->position_m.z == b->position_m.z && p->w == q->w && p->x == q->x && p->y == q->y && p->z == q->z;
}

static bool pose_stood(const struct pose *a, const struct pose *b)
{
	const struct quat *p = &a->rotation, *q = &b->rotation;
	double dot = fabs(p->w * q->w + p->x * q->x + p->y * q->y + p->z * q->z); /* cosine of half the angle */
	return vec3_norm(vec3_sub(a->position_m, b->position_m)) <= POSE_STOOD_M && dot >= 1 - POSE_STOOD_TURN;
}

/* The last pose before `end`, moved on with the twist from an earlier one of its frame. */
static struct transform pose_beyond(const struct sweep *s, uint64_t end, int64_t t_ns)
{
	const struct pose *last = pose_at(s, end - 1);
	for (uint64_t i = end - 1; i > s->pose.begin; i--) {
		const struct pose *earlier = pose_at(s, i - 1);
		int64_t apart_ns = last->t_ns - earlier->t_ns;
		if (apart_ns > TWIST_OLDEST_NS || framed_at(s, i - 1)->frame != framed_at(s, end - 1)->frame)
			break;
		if (apart_ns >= TWIST_BASE_NS)
			return pose_between(earlier, last, t_ns);
	}
	return transform_quat(last->position_m, last->rotation);
}

/* Sets w->map_base to the pose at t_ns. 0, or 1 + enum sweep_drop. */
static int walk_pose(struct walk *w, int64_t t_ns)
{
	const struct sweep *s = w->s;
	if (s->params.fixed_pose)
		return 0;
	while (w->pose_next < w->pose_end && pose_at(s, w->pose_next)->t_ns <= t_ns)
		w->pose_next++;
	if (w->pose_next == s->pose.begin)
		return 1 + SWEEP_NO_POSE;
	const struct pose *before = pose_at(s, w->pose_next - 1);
	if (s->params.trust_m > 0 && before->variance_m2 > s->params.trust_m * s->params.trust_m)
		return 1 + SWEEP_UNCERTAIN_POSE;
	if (w->pose_next == w->pose_end) {
		if (t_ns - before->t_ns > POSE_EXTRAPOLATE_NS)
			return 1 + SWEEP_STALE_POSE;
		w->map_base = pose_beyond(s, w->pose_end, t_ns);
		return 0;
	}
	const struct pose *after = pose_at(s, w->pose_next);
	/* In so long a silence the robot may have been anywhere. */
	if (after->t_ns - before->t_ns > w->pose_gap_ns && !pose_stood(before, after))
		return 1 + SWEEP_STALE_POSE;
	w->map_base = pose_equal(before, after) ? transform_quat(before->position_m, before->rotation)
	                                        : pose_between(before, after, t_ns);
	return 0;
}

/* Sine and cosine of the angle: from those of one close by, since a servo turns by a fraction of a degree within a row.
 * Up to NEAR_RAD what the two series leave out is below 1e-15. */
static void walk_turn_to(struct walk *w, double angle)
{
	if (w->has_angle && angle == w->angle_rad)
		return;
	double d = angle - w->near_rad, dd = d * d;
	if (!w->has_angle || fabs(d) > NEAR_RAD) {
		w->near_rad = angle;
		w->near_sine = trig_sin(angle);
		w->near_cosine = trig_cos(angle);
		d = dd = 0;
	}
	double sine = d * (1 - dd / 6 * (1 - dd / 20)), cosine = 1 - dd / 2 * (1 - dd / 12 * (1 - dd / 30));
	w->has_angle = true;
	w->angle_rad = angle;
	w->sine = w->near_sine * cosine + w->near_cosine * sine;
	w->cosine = w->near_cosine * cosine - w->near_sine * sine;
}

static struct vec3 turn_about_y(const struct walk *w, struct vec3 p)
{
	return (struct vec3){w->cosine * p.x + w->sine * p.z, p.y, w->cosine * p.z - w->sine * p.x};
}

static bool in_box(const struct sweep_params *params, struct vec3 p)
{
	const struct vec3 *a = &params->box_min, *b = &params->box_max;
	return p.x >= a->x && p.x <= b->x && p.y >= a->y && p.y <= b->y && p.z >= a->z && p.z <= b->z;
}

/* Places one beam of bearing (cosine, sine). 0, or 1 + enum sweep_drop. */
static int place_beam(struct walk *w, int64_t t_ns, const double bearing[2], struct row_beam *beam)
{
	const struct sweep_params *params = &w->s->params;
	double angle;
	int r = walk_tilt(w, t_ns, &angle);
	if (r == 0)
		r = walk_pose(w, t_ns);
	if (r)
		return r;
	walk_turn_to(w, angle);
	struct vec3 origin = transform_point(&params->base_tilt, turn_about_y(w, params->tilt_laser.t));
	beam->origin = transform_point(&w->map_base, origin);
	beam->point = beam->origin;
	if (beam->state != BEAM_OK)
		return 0;
	struct vec3 reach = {bearing[0] * (double)beam->range_m, bearing[1] * (double)beam->range_m, 0};
	struct vec3 tilted = turn_about_y(w, transform_point(&params->tilt_laser, reach));
	struct vec3 point = transform_point(&params->base_tilt, tilted);
	if (params->has_box && in_box(params, point))
		beam->state = BEAM_SELF;
	else
		beam->point = transform_point(&w->map_base, point);
	return 0;
}

static int64_t beam_time_ns(const struct profile *p, int interlace, uint32_t k)
{
	return p->t_ns + (int64_t)(k % (uint32_t)interlace) * p->turn_ns +
	       (int64_t)(k / (uint32_t)interlace) * p->beam_ns;
}

static int64_t last_beam_ns(const struct profile *p)
{
	int interlace = interlace_of(p);
	int64_t last = p->t_ns;
	for (int i = 0; i < interlace; i++) {
		int64_t t = beam_time_ns(p, interlace, (uint32_t)(p->n - 1 - i));
		last = t > last ? t : last;
	}
	return last;
}

static bool samples_reach(const struct sweep *s, int64_t t_ns)
{
	bool tilt = s->params.fixed_tilt || (s->tilt.end > s->tilt.begin && tilt_at(s, s->tilt.end - 1)->t_ns >= t_ns);
	bool pose = s->params.fixed_pose || (s->pose.end > s->pose.begin && pose_at(s, s->pose.end - 1)->t_ns >= t_ns);
	return tilt && pose;
}

/* From the last sample not after the first beam to the first not before the last beam. */
static bool servo_stood(const struct sweep *s, int64_t first_ns, int64_t last_ns)
{
	if (s->params.fixed_tilt)
		return true;
	uint64_t i = ring_after(&s->tilt, first_ns);
	if (i == s->tilt.begin)
		return false;
	double low = tilt_at(s, --i)->angle_rad, high = low;
	for (; i < s->tilt.end; i++) {
		double angle = tilt_at(s, i)->angle_rad;
		low = angle < low ? angle : low;
		high = angle > high ? angle : high;
		if (tilt_at(s, i)->t_ns >= last_ns)
			break;
	}
	return high - low <= STOOD_RAD;
}

static const struct fan *fan_of(struct sweep *s, const struct profile *p)
{
	struct fan *fan = &s->fan[p->part % FANS];
	if (fan->n >= p->n && fan->first_rad == p->first_rad && fan->step_rad == p->step_rad)
		return fan;
	for (uint32_t k = 0; k < p->n; k++) {
		double bearing = p->first_rad + k * p->step_rad;
		fan->beam[k][0] = trig_cos(bearing);
		fan->beam[k][1] = trig_sin(bearing);
	}
	fan->n = p->n;
	fan->first_rad = p->first_rad;
	fan->step_rad = p->step_rad;
	return fan;
}

static bool is_masked(const struct sweep_params *params, double bearing_rad)
{
	for (int i = 0; i < params->masks; i++)
		if (bearing_rad >= params->mask[i].from_rad - 1e-9 && bearing_rad <= params->mask[i].to_rad + 1e-9)
			return true;
	return false;
}

/* Judges the beams of a row by range, mask and neighbours; ranges and states first lie in `range_m`, `state`. */
static void judge_beams(const struct sweep_params *params, struct row *row, float *range_m, uint8_t *state)
{
	/* As floats: a reading of exactly the limit, rounded to a float, is within it. */
	float low = (float)params->range_min_m, high = (float)params->range_max_m;
	for (uint32_t i = 0; i < row->n; i++) {
		if (state[i] != BEAM_OK)
			continue;
		if (!(range_m[i] >= low && range_m[i] <= high))
			state[i] = BEAM_OUT_OF_RANGE;
		else if (params->masks && is_masked(params, row->first_rad + i * row->step_rad))
			state[i] = BEAM_MASKED;
	}
	mixed_mark(range_m, state, row->n, row->step_rad);
	for (uint32_t i = 0; i < row->n; i++) {
		row->beam[i].range_m = range_m[i];
		row->beam[i].state = state[i];
	}
}

/* What a row is made of: turns of the mirror. Beam i of this one is beam `first` + i * `stride` of the row. */
struct source {
	const struct profile *profile;
	int turn;
	uint32_t n, first, stride;
};

struct recipe {
	double first_rad, step_rad;
	int sources;
	struct source source[SOURCES_MAX];
};

static void add_source(struct recipe *recipe, const struct profile *p, int turn, int first, int stride)
{
	uint32_t interlace = (uint32_t)interlace_of(p), n = (p->n - (uint32_t)turn + interlace - 1) / interlace;
	recipe->source[recipe->sources++] = (struct source){p, turn, n, (uint32_t)first, (uint32_t)stride};
}

/* Row `turn` of the `turns` rows of a profile. Where it is the only one (the servo stood) it is placed turn by turn, so that
 * times only rise. */
static struct recipe recipe_of_turns(const struct profile *p, int turn, int turns)
{
	struct recipe recipe = {p->first_rad + turn * p->step_rad, p->step_rad * turns, 0, {{0}}};
	if (turns > 1)
		add_source(&recipe, p, turn, 0, 1);
	for (int i = 0; turns == 1 && i < interlace_of(p); i++)
		add_source(&recipe, p, i, i, interlace_of(p));
	return recipe;
}

/* The partial scans at the head as one row. */
static struct recipe recipe_of_parts(const struct sweep *s, int parts)
{
	const struct profile *p = &held_at(s, 0)->profile;
	struct recipe recipe = {p->first_rad, p->step_rad / parts, 0, {{0}}};
	for (int i = 0; i < parts; i++)
		add_source(&recipe, &held_at(s, (uint32_t)i)->profile, 0, i, parts);
	return recipe;
}

static uint32_t recipe_beams(const struct recipe *recipe)
{
	uint32_t n = 0;
	for (int i = 0; i < recipe->sources; i++) {
		const struct source *source = &recipe->source[i];
		uint32_t end = source->n ? source->first + (source->n - 1) * source->stride + 1 : 0;
		n = end > n ? end : n;
	}
	return n;
}

static void copy_beams(const struct sweep_params *params, const struct recipe *recipe, struct row *row)
{
	float range_m[PROFILE_BEAMS_MAX] = {0};
	uint8_t state[PROFILE_BEAMS_MAX];
	memset(state, BEAM_NO_ECHO, row->n);
	for (int k = 0; k < recipe->sources; k++) {
		const struct source *source = &recipe->source[k];
		const struct profile *p = source->profile;
		uint32_t interlace = (uint32_t)interlace_of(p), from = (uint32_t)source->turn;
		for (uint32_t i = 0, at = source->first; i < source->n; i++, from += interlace, at += source->stride) {
			range_m[at] = p->range_m[from];
			state[at] = p->state[from];
		}
	}
	judge_beams(params, row, range_m, state);
}

/* Places the beams of one turn of the mirror in the row. 0, or 1 + enum sweep_drop. */
static int place_turn(struct sweep *s, const struct source *source, struct row *row)
{
	const struct profile *p = source->profile;
	const struct fan *fan = fan_of(s, p);
	int interlace = interlace_of(p);
	uint32_t k = (uint32_t)source->turn, at = source->first;
	struct walk walk;
	walk_init(&walk, s, row->t_ns, beam_time_ns(p, interlace, k));
	for (uint32_t i = 0; i < source->n; i++, k += (uint32_t)interlace, at += source->stride) {
		int r = place_beam(&walk, beam_time_ns(p, interlace, k), fan->beam[k], &row->beam[at]);
		if (r)
			return r;
		if (at == row->n / 2)
			row->tilt_rad = walk.angle_rad;
	}
	return 0;
}

/* Does this row begin a sweep? Keeps the servo's direction. */
static bool turn_seen(struct sweep *s, const struct row *row, uint32_t frame)
{
	double angle = row->tilt_rad, back = s->direction * (s->extreme_rad - angle);
	struct vec3 moved = vec3_sub(row->beam[0].origin, s->last_origin);
	bool cut = !s->started || s->torn || frame != s->last_frame || fabs(angle - s->last_rad) > CUT_RAD ||
	           vec3_norm(moved) > CUT_M || s->sweep_rows >= SWEEP_ROWS_MAX || (s->direction && back > TURN_RAD);
	if (cut) {
		s->direction = 0;
		s->extreme_rad = angle;
		s->sweep_rows = 0;
	} else if (s->direction == 0) {
		if (fabs(angle - s->extreme_rad) > TURN_RAD) {
			s->direction = angle > s->extreme_rad ? 1 : -1;
			s->extreme_rad = angle;
		}
	} else if (back < 0) {
		s->extreme_rad = angle;
	}
	s->started = true;
	s->torn = false;
	s->last_frame = frame;
	s->last_rad = angle;
	s->last_origin = row->beam[0].origin;
	s->sweep_rows++;
	return cut;
}

static void count_row(struct sweep *s, const struct row *row)
{
	s->stats.rows++;
	s->stats.sweeps += row->starts_sweep;
	for (uint32_t i = 0; i < row->n; i++)
		s->stats.beams[row->beam[i].state]++;
}

/* 0, -1 without memory, or 1 + enum sweep_drop. */
static int make_row(struct sweep *s, const struct recipe *recipe, struct row **ret)
{
	const struct source *first = &recipe->source[0];
	const int64_t t_ns = beam_time_ns(first->profile, interlace_of(first->profile), (uint32_t)first->turn);
	uint64_t end;
	const uint32_t frame = s->params.fixed_pose ? 0 : frame_at(s, t_ns, &end);
	if (frame < s->frame_first)
		return 1 + SWEEP_BEFORE_JUMP;
	struct row *row = row_create(recipe_beams(recipe));
	int r = 0;
	if (!row)
		return -1;
	row->raster = s->params.raster;
	row->t_ns = t_ns;
	row->first_rad = recipe->first_rad;
	row->step_rad = recipe->step_rad;
	copy_beams(&s->params, recipe, row);
	for (int i = 0; r == 0 && i < recipe->sources; i++)
		r = place_turn(s, &recipe->source[i], row);
	if (r) {
		row_destroy(row);
		return r;
	}
	row->starts_sweep = turn_seen(s, row, frame);
	count_row(s, row);
	*ret = row;
	return 0;
}

/* Does `next` go on with the partial scans that `before` belongs to? */
static bool is_next_part(const struct profile *before, const struct profile *next)
{
	int64_t apart_ns = next->t_ns - before->t_ns;
	return next->part == before->part + 1 && next->parts == before->parts && next->step_rad == before->step_rad &&
	       interlace_of(next) == 1 && apart_ns > 0 && apart_ns <= 3 * (int64_t)before->turn_ns / 2;
}

/* How many profiles at the head are one row: the partial scans of a raster, if the servo stood from the first to the last;
 * else 1. 0: they may become one, wait. */
static int parts_together(const struct sweep *s, int64_t log_ns, bool end)
{
	const struct held *first = held_at(s, 0), *last = first;
	const struct profile *p = &first->profile;
	uint32_t longest = p->n;
	if (p->parts < 2 || p->parts > SOURCES_MAX || p->part != 0 || interlace_of(p) != 1)
		return 1;
	for (uint32_t i = 1; i < p->parts; i++) {
		if (i == s->waiting) {
			int64_t set_ns = (int64_t)p->parts * p->turn_ns;
			bool late = end || log_ns - first->log_ns >= s->params.hold_ns + set_ns;
			return late || !servo_stood(s, p->t_ns, last_beam_ns(p) + set_ns - p->turn_ns) ? 1 : 0;
		}
		if (!is_next_part(&last->profile, &held_at(s, i)->profile))
			return 1;
		last = held_at(s, i);
		longest = last->profile.n > longest ? last->profile.n : longest;
	}
	int64_t last_ns = last_beam_ns(&last->profile);
	if (longest * p->parts > PROFILE_BEAMS_MAX || !servo_stood(s, p->t_ns, last_ns))
		return 1;
	bool waits = !end && !samples_reach(s, last_ns) && log_ns - last->log_ns < s->params.hold_ns;
	return waits ? 0 : p->parts;
}

static enum sweep_verdict dropped(struct sweep *s, enum sweep_drop drop, enum sweep_drop *ret_drop)
{
	s->stats.dropped[drop]++;
	s->torn |= drop == SWEEP_NO_TILT || drop == SWEEP_STALE_TILT;
	*ret_drop = drop;
	return SWEEP_DROPPED;
}

enum sweep_verdict sweep_next(struct sweep *s, int64_t log_ns, bool end, struct row **ret_row,
                              enum sweep_drop *ret_drop)
{
	if (s->lost > 0) {
		s->lost--;
		return dropped(s, SWEEP_OVERFLOW, ret_drop);
	}
	if (s->waiting == 0)
		return SWEEP_WAIT;
	const struct held *held = held_at(s, 0);
	const struct profile *p = &held->profile;
	int parts = 1;
	if (s->turns == 0) {
		int64_t last_ns = last_beam_ns(p);
		if (!end && !samples_reach(s, last_ns) && log_ns - held->log_ns < s->params.hold_ns)
			return SWEEP_WAIT;
		if (s->params.step && !servo_stood(s, p->t_ns, last_ns)) {
			held_pop(s, 1);
			return dropped(s, SWEEP_MOVED, ret_drop);
		}
		parts = parts_together(s, log_ns, end);
		if (parts == 0)
			return SWEEP_WAIT;
		s->turns = servo_stood(s, p->t_ns, last_ns) ? 1 : interlace_of(p);
	}
	struct recipe recipe = parts > 1 ? recipe_of_parts(s, parts) : recipe_of_turns(p, s->turn, s->turns);
	struct row *row = NULL;
	int r = make_row(s, &recipe, &row);
	if (++s->turn == s->turns)
		held_pop(s, parts);
	if (r < 0)
		return SWEEP_NOMEM;
	if (r > 0)
		return dropped(s, (enum sweep_drop)(r - 1), ret_drop);
	row->ends_sweep = end && s->waiting == 0;
	*ret_row = row;
	return SWEEP_ROW;
}

/* Snapshot: what waits, the rings, the raster so far, the counters. Fans are computed again. */

static void vec3_state(struct state *st, struct vec3 *v)
{
	state_double(st, &v->x);
	state_double(st, &v->y);
	state_double(st, &v->z);
}

static void held_state(struct state *st, struct held *held)
{
	struct profile *p = &held->profile;
	state_time(st, &held->log_ns);
	state_time(st, &p->t_ns);
	state_int(st, &p->beam_ns, INT32_MIN, INT32_MAX);
	state_int(st, &p->turn_ns, INT32_MIN, INT32_MAX);
	state_u8(st, &p->interlace);
	state_u8(st, &p->part);
	state_u8(st, &p->parts);
	state_double(st, &p->first_rad);
	state_double(st, &p->step_rad);
	int n = p->n;
	state_int(st, &n, 1, PROFILE_BEAMS_MAX);
	p->n = (uint16_t)n;
	for (int i = 0; i < n && !st->failed; i++)
		state_float(st, &p->range_m[i]);
	state_bytes(st, p->state, st->failed ? 0 : (size_t)n);
	for (int i = 0; i < n && st->loading && !st->failed; i++)
		st->failed = p->state[i] >= BEAM_STATES;
}

/* Profiles are counted from the head on, samples from the oldest on: where they lie in their rings matters to nobody. */
static void waiting_state(struct state *st, struct sweep *s)
{
	int waiting = (int)s->waiting;
	state_int(st, &waiting, 0, SWEEP_PROFILES_WAITING_MAX);
	s->waiting = (uint32_t)waiting;
	for (uint32_t i = 0; i < s->waiting && !st->failed; i++)
		held_state(st, held_at(s, i));
	int turns_max = s->waiting > 0 && !st->failed ? interlace_of(&held_at(s, 0)->profile) : 0;
	state_int(st, &s->turns, 0, turns_max);
	st->failed |= st->loading && s->turns > 1 && s->turns < turns_max;
	state_int(st, &s->turn, 0, s->turns > 0 ? s->turns - 1 : 0);
	state_u64(st, &s->lost);
	st->failed |= st->loading && s->lost > LOST_MAX;
}

static void tilt_state(struct state *st, void *sample)
{
	struct tilt *tilt = sample;
	state_time(st, &tilt->t_ns);
	state_double(st, &tilt->angle_rad);
	st->failed |= st->loading && !(fabs(tilt->angle_rad) <= TRIG_ANGLE_MAX);
}

static void pose_state(struct state *st, void *sample)
{
	struct framed *framed = sample;
	struct pose *pose = &framed->pose;
	struct quat *q = &pose->rotation;
	state_time(st, &pose->t_ns);
	vec3_state(st, &pose->position_m);
	state_double(st, &q->w);
	state_double(st, &q->x);
	state_double(st, &q->y);
	state_double(st, &q->z);
	state_double(st, &pose->variance_m2);
	state_double(st, &pose->variance_rad2);
	state_bool(st, &pose->jumped);
	state_u32(st, &framed->frame);
}

static void ring_state(struct state *st, struct ring *ring, void (*sample_state)(struct state *, void *sample))
{
	size_t n = (size_t)(ring->end - ring->begin);
	state_size(st, &n, RING);
	if (st->loading)
		*ring = (struct ring){0, st->failed ? 0 : n, ring->size, ring->sample};
	for (uint64_t i = ring->begin; i < ring->end && !st->failed; i++) {
		sample_state(st, ring_at(ring, i));
		st->failed |= st->loading && i > ring->begin && ring_time(ring, i) <= ring_time(ring, i - 1);
	}
}

static void raster_state(struct state *st, struct sweep *s)
{
	int rows = (int)s->sweep_rows;
	state_u32(st, &s->frame);
	state_u32(st, &s->frame_first);
	state_u32(st, &s->last_frame);
	st->failed |= st->loading && (s->frame_first > s->frame || s->last_frame > s->frame);
	for (uint64_t i = s->pose.begin; i < s->pose.end && st->loading && !st->failed; i++)
		st->failed = framed_at(s, i)->frame > (i + 1 < s->pose.end ? framed_at(s, i + 1)->frame : s->frame);
	state_bool(st, &s->torn);
	state_bool(st, &s->started);
	state_int(st, &s->direction, -1, 1);
	state_double(st, &s->extreme_rad);
	state_double(st, &s->last_rad);
	vec3_state(st, &s->last_origin);
	state_int(st, &rows, 0, SWEEP_ROWS_MAX);
	s->sweep_rows = (uint32_t)rows;
}

static void stats_state(struct state *st, struct sweep_stats *stats)
{
	state_u64(st, &stats->profiles);
	state_u64(st, &stats->rows);
	state_u64(st, &stats->sweeps);
	for (int i = 0; i < SWEEP_DROPS; i++)
		state_u64(st, &stats->dropped[i]);
	for (int i = 0; i < BEAM_STATES; i++)
		state_u64(st, &stats->beams[i]);
}

static void fields_state(struct state *st, struct sweep *s)
{
	state_tag(st, "sweep2");
	waiting_state(st, s);
	ring_state(st, &s->tilt, tilt_state);
	ring_state(st, &s->pose, pose_state);
	raster_state(st, s);
	stats_state(st, &s->stats);
}

void sweep_state(struct state *st, struct sweep *s)
{
	struct sweep *aside;
	if (!st->loading) {
		fields_state(st, s);
		return;
	}
	aside = sweep_create(&s->params);
	if (!aside) {
		st->failed = true;
		sweep_clear(s);
		return;
	}
	fields_state(st, aside);
	if (st->failed)
		sweep_clear(aside);
	struct sweep before = *s;
	*s = *aside;
	*aside = before;
	sweep_destroy(aside);
}

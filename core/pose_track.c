/* Dead reckoning, corrected: a Kalman filter of x, y and heading over a ring of reckoned places.
 *
 * Motion. A piece of way ds with a turn of da is an arc: its chord lies at heading + da/2. The covariance goes on with the
 * Jacobian of that step, and grows by noise in proportion to the way and to the turn, so that it does not matter into
 * how many pieces a way was cut: after a straight way of d metres the variance along it is drift^2 d, that of the heading
 * turn^2 d, and across turn^2 d^3 / 3.
 *
 * Correction. An absolute pose is about a time that has passed: the place then is found in the ring, weighed against the
 * pose (Thrun, Burgard, Fox: Probabilistic Robotics, 3.3), and all places since are moved along by the same rigid motion,
 * their covariances reckoned anew. One that is ahead of the wheels by a fraction of a second moves the track on with its
 * last speed; the part of the next motion that lies before it is then left out.
 *
 * Jumps. Where the wheels lead is known with odometry. Without it (or while it is silent) a robot goes on as it did or
 * stands, and it may have changed its speed by SLACK since the last pose: the longer nothing was heard, the less can be
 * called a jump; what a silence hid holds for the poses after it until one of them has said where the robot is. History is
 * moved along with a jump, so that the twist goes on. The way back is recognised by the frame before: a single outlier is
 * one jump and one back, and ignoring both leaves no trace. */
#include "core/pose_track.h"

#include <stdlib.h>
#include <string.h>

#include "core/trig.h"

#define WAY           1024         /* reckoned places: 10 s at 100 Hz */
#define SEEN          256          /* poses handed out, for the twist */
#define WAIT_NS       2000000000LL /* for a first absolute pose, from the first motion on */
#define REACH_NS      100000000LL  /* so far an absolute pose may be ahead of the wheels */
#define SET_BACK_NS   2000000000LL /* older by more than this: time was set back */
#define TWIST_BASE_NS 5000000LL
#define TWIST_MAX_NS  1000000000LL
#define SLACK_M_S2    2.0 /* half of it times the time squared: what a change of speed may do */
#define SLACK_RAD_S2  4.0
#define FIRST_M_S     3.0 /* nothing is known of the speed yet */
#define FIRST_RAD_S   3.0
#define PIECE_NS_MAX  250000000LL /* of one motion that is interpolated */
#define PIECE_M_MAX   100.0       /* of one motion */
#define PIECE_RAD_MAX 100.0
#define FAR_M         1e7  /* the track is held within: a square of it loses no metre */
#define UNKNOWN_M2    1e6  /* of a place that nobody knows */
#define VARIANCE_MAX  1e12 /* likewise */
#define SIGMA_MIN_M   1e-4 /* an absolute pose is not better than this where it says how good it is */
#define SIGMA_MIN_RAD 1e-5
#define NOISE_SIGMAS  3  /* what is weighed may be off by so many of its own */
#define MEMORY        20 /* the track trusts itself no more than so many absolute poses */

struct place { /* rigid, in three dimensions */
	struct vec3 t;
	struct quat q;
};

struct mark { /* where the robot was */
	int64_t t_ns;
	double x_m, y_m, heading_rad;
	double p[6]; /* covariance: xx, xy, xh, yy, yh, hh */
};

struct seen {
	int64_t t_ns;
	struct place place;
};

/* What silences of the wheels may have hidden; no absolute pose has told it yet. `ns` is 0 where there was none. */
struct gap {
	int64_t begin_ns, ns;
	double m, rad;
	double after_m; /* driven since */
};

struct pose_track {
	struct pose_track_params params;
	bool begun;        /* with odometry: `way` has a mark */
	bool waiting;      /* for a first absolute pose, since ... */
	int64_t waited_ns; /* ... then */
	uint64_t way_begin, way_end;
	struct mark way[WAY];    /* ring, times rise strictly */
	bool moved;              /* the wheels spoke: the three below hold */
	int64_t moved_ns;        /* the end of the last motion */
	double speed_m_s, rad_s; /* in it */
	struct gap gap;
	double z_m;
	struct quat level;             /* roll and pitch of the last absolute pose */
	bool absolute_seen, corrected; /* `corrected`: by one before that which is being taken */
	int64_t absolute_ns;           /* the newest one taken */

	uint64_t seen_begin, seen_end;
	struct seen seen[SEEN]; /* ring, in the frame that is handed out */

	bool held;           /* IGNORE: `hold` is not the identity */
	bool before_held;    /* the same of `before` */
	bool jumped;         /* there was a jump: `before` holds */
	struct place hold;   /* frame handed out <- frame of the absolute poses */
	struct place before; /* IGNORE: `hold` before the last jump; else frame before it <- frame after it */

	double variance_m2, variance_rad2; /* of the last pose */
	bool known, sure;
	struct pose_track_status count;
};

/* Places */

static const struct quat NO_TURN = {.w = 1};

static struct quat quat_times(struct quat a, struct quat b)
{
	return (struct quat){.w = a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z,
	                     .x = a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
	                     .y = a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
	                     .z = a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
}

static struct quat quat_back(struct quat q)
{
	return (struct quat){.w = q.w, .x = -q.x, .y = -q.y, .z = -q.z};
}

static struct vec3 place_point(const struct place *a, struct vec3 p)
{
	const struct vec3 axis = {a->q.x, a->q.y, a->q.z};
	const struct vec3 u = vec3_scale(vec3_cross(axis, p), 2);

	return vec3_add(a->t, vec3_add(p, vec3_add(vec3_scale(u, a->q.w), vec3_cross(axis, u))));
}

static struct place place_times(const struct place *a, const struct place *b)
{
	return (struct place){place_point(a, b->t), quat_normalise(quat_times(a->q, b->q))};
}

static struct place place_back(const struct place *a)
{
	const struct place turned = {.q = quat_back(a->q)};

	return (struct place){vec3_scale(place_point(&turned, a->t), -1), turned.q};
}

static struct place place_of(const struct pose *pose)
{
	return (struct place){pose->position_m, pose->rotation};
}

static double wrapped(double rad)
{
	return rad - 2 * TRIG_PI * rint(rad / (2 * TRIG_PI));
}

static double heading_of(struct quat q)
{
	return trig_atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z));
}

static struct quat turn_of(double heading_rad)
{
	return (struct quat){.w = trig_cos(heading_rad / 2), .z = trig_sin(heading_rad / 2)};
}

/* How far two places are apart. Wheels know nothing of height, roll and pitch: with them only the plane is judged. */
static void place_apart(const struct pose_track *k, const struct place *a, const struct place *b, double *ret_m,
                        double *ret_rad)
{
	struct vec3 apart = vec3_sub(a->t, b->t);
	const struct quat q = quat_times(quat_back(a->q), b->q);
	const struct vec3 axis = {q.x, q.y, q.z};

	if (k->params.motion) {
		apart.z = 0;
		*ret_rad = fabs(wrapped(heading_of(a->q) - heading_of(b->q)));
	} else {
		*ret_rad = 2 * trig_atan2(vec3_norm(axis), fabs(q.w));
	}
	*ret_m = vec3_norm(apart);
}

/* What was handed out */

static struct seen *seen_at(struct pose_track *k, uint64_t i)
{
	return &k->seen[i % SEEN];
}

static void seen_put(struct pose_track *k, int64_t t_ns, struct place place)
{
	if (k->seen_end > k->seen_begin && t_ns <= seen_at(k, k->seen_end - 1)->t_ns)
		k->seen_begin = k->seen_end;
	if (k->seen_end - k->seen_begin == SEEN)
		k->seen_begin++;
	*seen_at(k, k->seen_end++) = (struct seen){t_ns, place};
}

static void hand_out(struct pose_track *k, const struct pose *pose, struct pose_track_out *ret)
{
	ret->has_pose = true;
	ret->pose = *pose;
	seen_put(k, pose->t_ns, place_of(pose));
	k->known = true;
	k->sure = k->params.motion || pose->variance_m2 > 0 || pose->variance_rad2 > 0;
	k->variance_m2 = pose->variance_m2;
	k->variance_rad2 = pose->variance_rad2;
}

/* Where a robot would be at t_ns that goes on as it did: `base_ns` is how long its twist was seen for; 0: not at all. */
static struct place going_on(struct pose_track *k, int64_t t_ns, int64_t *ret_base_ns)
{
	const struct seen *last = seen_at(k, k->seen_end - 1), *earlier = NULL;
	const int64_t ahead_ns = t_ns - last->t_ns;
	int64_t want_ns = ahead_ns < TWIST_MAX_NS ? ahead_ns : TWIST_MAX_NS, base_ns;
	double share;

	if (want_ns < TWIST_BASE_NS)
		want_ns = TWIST_BASE_NS;
	for (uint64_t i = k->seen_end - 1; i > k->seen_begin; i--) {
		const struct seen *one = seen_at(k, i - 1);

		if (last->t_ns - one->t_ns > 2 * TWIST_MAX_NS && earlier)
			break;
		earlier = one;
		if (last->t_ns - one->t_ns >= want_ns)
			break;
	}
	base_ns = earlier ? last->t_ns - earlier->t_ns : 0;
	*ret_base_ns = base_ns >= TWIST_BASE_NS ? base_ns : 0;
	if (*ret_base_ns == 0)
		return last->place;
	share = (double)(ahead_ns < base_ns ? ahead_ns : base_ns) / (double)base_ns;
	return (struct place){vec3_lerp(earlier->place.t, last->place.t, 1 + share),
	                      quat_between(earlier->place.q, last->place.q, 1 + share)};
}

/* How far a pose is from where it could be, and what is allowed. */
struct judgement {
	struct place expected;
	double slack_m, slack_rad;
};

static bool within(const struct pose_track *k, const struct judgement *j, const struct place *expected,
                   const struct place *place)
{
	double m, rad;

	if (k->params.jump_m <= 0)
		return true;
	place_apart(k, expected, place, &m, &rad);
	return m <= k->params.jump_m + j->slack_m && rad <= k->params.jump_rad + j->slack_rad;
}

static double change_m(double s)
{
	return SLACK_M_S2 / 2 * s * s;
}

static double change_rad(double s)
{
	return SLACK_RAD_S2 / 2 * s * s;
}

/* By the poses alone. */
static struct judgement judge_by_poses(struct pose_track *k, const struct place *place, int64_t t_ns)
{
	const struct seen *last = seen_at(k, k->seen_end - 1);
	const double s = (double)(t_ns - last->t_ns) * 1e-9;
	struct judgement j = {.slack_m = change_m(s), .slack_rad = change_rad(s)};
	int64_t base_ns;

	j.expected = going_on(k, t_ns, &base_ns);
	if (base_ns == 0) {
		j.slack_m += FIRST_M_S * s;
		j.slack_rad += FIRST_RAD_S * s;
	}
	if (!within(k, &j, &j.expected, place) && within(k, &j, &last->place, place))
		j.expected = last->place; /* it stopped */
	return j;
}

/* Jumps */

static void move_seen(struct pose_track *k, const struct place *by)
{
	for (uint64_t i = k->seen_begin; i < k->seen_end; i++)
		seen_at(k, i)->place = place_times(by, &seen_at(k, i)->place);
}

static void tell_jump(struct pose_track *k, const struct judgement *j, const struct place *place, int64_t t_ns,
                      bool back, struct pose_track_out *ret)
{
	ret->has_jump = true;
	ret->jump = (struct pose_jump){.t_ns = t_ns, .done = k->params.on_jump, .back = back};
	place_apart(k, &j->expected, place, &ret->jump.distance_m, &ret->jump.angle_rad);
	k->count.jumps++;
	k->jumped = true;
}

/* IGNORE: `place` is in the frame of the absolute poses; afterwards that frame lies so that it is where it was expected,
 * or where it lay before the last jump if that explains the pose. */
static void hold_frame(struct pose_track *k, const struct judgement *j, const struct place *place, int64_t t_ns,
                       struct pose_track_out *ret)
{
	const struct place back = place_back(place), shown = k->held ? place_times(&k->hold, place) : *place;
	const struct place before = k->before_held ? place_times(&k->before, place) : *place;
	const bool returns = k->jumped && within(k, j, &j->expected, &before);
	const struct place old = k->hold;
	const bool old_held = k->held;

	tell_jump(k, j, &shown, t_ns, returns, ret);
	k->hold = returns ? k->before : place_times(&j->expected, &back);
	k->held = returns ? k->before_held : true;
	k->before = old;
	k->before_held = old_held;
}

/* KEEP, NEW_MAP: the frame goes with the pose. */
static void move_frame(struct pose_track *k, const struct judgement *j, const struct place *place, int64_t t_ns,
                       struct pose_track_out *ret)
{
	const struct place back = place_back(&j->expected), by = place_times(place, &back);
	const struct place earlier = place_times(&k->before, &j->expected);
	const bool returns = k->jumped && within(k, j, &earlier, place);

	tell_jump(k, j, place, t_ns, returns, ret);
	k->before = place_back(&by);
	move_seen(k, &by);
}

static struct place shown_place(const struct pose_track *k, const struct pose *pose)
{
	const struct place place = place_of(pose);

	return k->held ? place_times(&k->hold, &place) : place;
}

static void place_pose(struct pose *pose, const struct place *place)
{
	pose->position_m = place->t;
	pose->rotation = place->q;
}

/* Without odometry */

static void pass(struct pose_track *k, const struct pose *pose, struct pose_track_out *ret)
{
	struct pose shown = *pose;
	struct place place = shown_place(k, pose);
	const int64_t newest_ns = k->seen_end > k->seen_begin ? seen_at(k, k->seen_end - 1)->t_ns : INT64_MIN;

	if (k->held)
		place_pose(&shown, &place);
	if (pose->t_ns <= newest_ns) { /* of no use, unless time was set back: whoever takes it judges that */
		if (newest_ns - pose->t_ns >= SET_BACK_NS) {
			hand_out(k, &shown, ret);
			return;
		}
		k->count.late++;
		ret->has_pose = true;
		ret->pose = shown;
		return;
	}
	if (k->seen_end > k->seen_begin) {
		const struct judgement j = judge_by_poses(k, &place, pose->t_ns);
		const bool far = !within(k, &j, &j.expected, &place);
		const struct place own = place_of(pose);

		if (far && k->params.on_jump == POSE_TRACK_IGNORE) {
			hold_frame(k, &j, &own, pose->t_ns, ret);
			place = shown_place(k, pose);
			place_pose(&shown, &place);
		} else if (far) {
			move_frame(k, &j, &place, pose->t_ns, ret);
			shown.jumped = true;
		}
	}
	hand_out(k, &shown, ret);
}

/* The reckoned way */

static struct mark *way_at(struct pose_track *k, uint64_t i)
{
	return &k->way[i % WAY];
}

static struct mark *way_head(struct pose_track *k)
{
	return way_at(k, k->way_end - 1);
}

static void way_put(struct pose_track *k, const struct mark *mark)
{
	if (k->way_end - k->way_begin == WAY)
		k->way_begin++;
	*way_at(k, k->way_end++) = *mark;
}

static double bounded(double value, double max)
{
	return value > max ? max : value < -max ? -max : value;
}

/* The covariance after a piece of way (dx, dy) with a turn. P' = F P F^T + Q; what the heading's noise does within the piece
 * is in Q, so that two halves of a piece are as good as the whole. */
static void grow(const struct pose_track *k, double p[6], double dx, double dy, double turn)
{
	const double way = sqrt(dx * dx + dy * dy);
	const double along = way > 0 ? k->params.drift * k->params.drift / way : 0; /* times dx dx: drift^2 way */
	const double heading = k->params.turn_drift_rad * k->params.turn_drift_rad * (way + fabs(turn));
	const double xh = p[2] - dy * p[5], yh = p[4] + dx * p[5];

	p[0] += -2 * dy * p[2] + dy * dy * p[5] + along * dx * dx + heading * dy * dy / 3;
	p[1] += dx * p[2] - dy * p[4] - dx * dy * p[5] + along * dx * dy - heading * dx * dy / 3;
	p[3] += 2 * dx * p[4] + dx * dx * p[5] + along * dy * dy + heading * dx * dx / 3;
	p[2] = xh - heading * dy / 2;
	p[4] = yh + heading * dx / 2;
	p[5] += heading;
	for (int i = 0; i < 6; i++)
		p[i] = bounded(p[i], VARIANCE_MAX);
}

/* A mark moved along an arc. */
static struct mark moved(const struct pose_track *k, const struct mark *from, int64_t t_ns, double ahead_m, double turn)
{
	struct mark to = *from;
	const double half = turn / 2, middle = from->heading_rad + half;
	const double chord = ahead_m * (fabs(half) < 1e-4 ? 1 - half * half / 6 : trig_sin(half) / half);
	const double dx = chord * trig_cos(middle), dy = chord * trig_sin(middle);

	to.t_ns = t_ns;
	to.x_m = bounded(from->x_m + dx, FAR_M);
	to.y_m = bounded(from->y_m + dy, FAR_M);
	to.heading_rad = wrapped(from->heading_rad + turn);
	grow(k, to.p, dx, dy, turn);
	return to;
}

static struct place mark_place(const struct pose_track *k, const struct mark *mark)
{
	return (struct place){{mark->x_m, mark->y_m, k->z_m},
	                      quat_normalise(quat_times(turn_of(mark->heading_rad), k->level))};
}

/* The largest variance of the position along any axis. */
static double position_variance(const double p[6])
{
	const double half = (p[0] - p[3]) / 2;

	return (p[0] + p[3]) / 2 + sqrt(half * half + p[1] * p[1]);
}

static void hand_out_mark(struct pose_track *k, const struct mark *mark, int64_t t_ns, bool jumped,
                          struct pose_track_out *ret)
{
	const struct place place = mark_place(k, mark);
	const struct pose pose = {.t_ns = t_ns,
	                          .position_m = place.t,
	                          .rotation = place.q,
	                          .variance_m2 = position_variance(mark->p),
	                          .variance_rad2 = mark->p[5],
	                          .jumped = jumped};

	hand_out(k, &pose, ret);
}

/* Height, roll and pitch, which only absolute poses tell. */
static void take_level(struct pose_track *k, const struct place *place)
{
	k->z_m = place->t.z;
	k->level = quat_normalise(quat_times(turn_of(-heading_of(place->q)), place->q));
}

static void mark_variance(const struct pose *pose, double p[6])
{
	memset(p, 0, 6 * sizeof(*p));
	p[0] = p[3] = bounded(pose->variance_m2, VARIANCE_MAX);
	p[5] = bounded(pose->variance_rad2, VARIANCE_MAX);
}

static struct mark mark_of(const struct pose *pose, const struct place *place)
{
	struct mark mark = {.t_ns = pose->t_ns,
	                    .x_m = bounded(place->t.x, FAR_M),
	                    .y_m = bounded(place->t.y, FAR_M),
	                    .heading_rad = heading_of(place->q)};

	mark_variance(pose, mark.p);
	return mark;
}

/* The way begins (anew) at a mark. */
static void begin_at(struct pose_track *k, const struct mark *mark)
{
	k->way_begin = k->way_end;
	way_put(k, mark);
	k->begun = true;
	k->waiting = false;
	k->gap = (struct gap){0};
}

/* The inverse of a symmetric, positive definite 3 x 3 matrix. */
static void invert(const double a[6], double ret[6])
{
	const double c0 = a[3] * a[5] - a[4] * a[4], c1 = a[2] * a[4] - a[1] * a[5], c2 = a[1] * a[4] - a[2] * a[3];
	const double scale = 1 / (a[0] * c0 + a[1] * c1 + a[2] * c2);

	ret[0] = c0 * scale;
	ret[1] = c1 * scale;
	ret[2] = c2 * scale;
	ret[3] = (a[0] * a[5] - a[2] * a[2]) * scale;
	ret[4] = (a[1] * a[2] - a[0] * a[4]) * scale;
	ret[5] = (a[0] * a[3] - a[1] * a[1]) * scale;
}

static double at(const double a[6], int i, int j)
{
	static const int place[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};

	return a[place[i][j]];
}

/* Weighs the absolute pose `seen`, a mark with its covariance, against the track's own. */
static struct mark weighed(const struct mark *own, const struct mark *seen)
{
	struct mark to = *own;
	double r[6], sum[6], inverse[6], p[6], gain[3][3];
	const double apart[3] = {seen->x_m - own->x_m, seen->y_m - own->y_m,
	                         wrapped(seen->heading_rad - own->heading_rad)};
	double step[3] = {0};

	memcpy(r, seen->p, sizeof(r));
	memcpy(p, own->p, sizeof(p));
	r[0] = r[3] = r[0] > SIGMA_MIN_M * SIGMA_MIN_M ? r[0] : SIGMA_MIN_M * SIGMA_MIN_M;
	r[5] = r[5] > SIGMA_MIN_RAD * SIGMA_MIN_RAD ? r[5] : SIGMA_MIN_RAD * SIGMA_MIN_RAD;
	for (int i = 0; i < 6; i++) {
		p[i] += r[i] / MEMORY;
		sum[i] = p[i] + r[i];
	}
	invert(sum, inverse);
	for (int i = 0; i < 3; i++)
		for (int j = 0; j < 3; j++) {
			gain[i][j] = at(p, i, 0) * at(inverse, 0, j) + at(p, i, 1) * at(inverse, 1, j) +
			             at(p, i, 2) * at(inverse, 2, j);
			step[i] += gain[i][j] * apart[j];
		}
	for (int i = 0, n = 0; i < 3; i++)
		for (int j = i; j < 3; j++, n++)
			to.p[n] = at(p, i, j) - gain[i][0] * at(p, 0, j) - gain[i][1] * at(p, 1, j) -
			          gain[i][2] * at(p, 2, j);
	to.x_m = bounded(own->x_m + step[0], FAR_M);
	to.y_m = bounded(own->y_m + step[1], FAR_M);
	to.heading_rad = wrapped(own->heading_rad + step[2]);
	return to;
}

/* The number of the newest mark not later than t_ns; there is one. */
static uint64_t way_before(struct pose_track *k, int64_t t_ns)
{
	uint64_t i = k->way_end - 1;

	while (way_at(k, i)->t_ns > t_ns)
		i--;
	return i;
}

/* Where the robot was at a time between marks i and i + 1, or at i. */
static struct mark way_between(struct pose_track *k, uint64_t i, int64_t t_ns)
{
	const struct mark *a = way_at(k, i), *b = way_at(k, i + 1);
	struct mark mark = *a;
	double share, dx, dy, turn;

	if (t_ns == a->t_ns)
		return mark;
	share = (double)(t_ns - a->t_ns) / (double)(b->t_ns - a->t_ns);
	dx = share * (b->x_m - a->x_m);
	dy = share * (b->y_m - a->y_m);
	turn = share * wrapped(b->heading_rad - a->heading_rad);
	mark.t_ns = t_ns;
	mark.x_m += dx;
	mark.y_m += dy;
	mark.heading_rad = wrapped(mark.heading_rad + turn);
	grow(k, mark.p, dx, dy, turn);
	return mark;
}

/* The track ran through `was` and is found to run through `is`: everything since, mark i included, is moved along. */
static void correct(struct pose_track *k, uint64_t i, const struct mark *was, const struct mark *is)
{
	const double turn = wrapped(is->heading_rad - was->heading_rad), c = trig_cos(turn), s = trig_sin(turn);
	const struct mark *last = is;

	for (; i < k->way_end; i++) {
		struct mark *mark = way_at(k, i);
		const double dx = mark->x_m - was->x_m, dy = mark->y_m - was->y_m;

		mark->x_m = bounded(is->x_m + c * dx - s * dy, FAR_M);
		mark->y_m = bounded(is->y_m + s * dx + c * dy, FAR_M);
		mark->heading_rad = wrapped(mark->heading_rad + turn);
		memcpy(mark->p, last->p, sizeof(mark->p));
		if (mark->t_ns <= is->t_ns)
			continue;
		grow(k, mark->p, mark->x_m - last->x_m, mark->y_m - last->y_m,
		     wrapped(mark->heading_rad - last->heading_rad));
		last = mark;
	}
}

/* Moves the track on to t_ns, ahead of the wheels, as they turned last; they may have changed their speed since. */
static void go_ahead(struct pose_track *k, int64_t t_ns)
{
	const double s = (double)(t_ns - way_head(k)->t_ns) * 1e-9;
	const double slack_m = change_m(s), slack_rad = change_rad(s);
	struct mark to = moved(k, way_head(k), t_ns, k->speed_m_s * s, k->rad_s * s);

	to.p[0] += slack_m * slack_m;
	to.p[3] += slack_m * slack_m;
	to.p[5] += slack_rad * slack_rad;
	way_put(k, &to);
}

/* The jump of a pose that the wheels, or the poses before it, do not explain. False: it is none, or was ignored; then the
 * track is right as it is. The first absolute pose of all is never ignored: before it there is no correction to be held,
 * only the origin where a track begins that had waited for it in vain. */
static bool jump(struct pose_track *k, const struct judgement *j, const struct pose *pose, const struct place *place,
                 struct pose_track_out *ret)
{
	const struct place own = place_of(pose);

	if (k->params.on_jump == POSE_TRACK_IGNORE && k->corrected) {
		hold_frame(k, j, &own, pose->t_ns, ret);
		return false;
	}
	move_frame(k, j, place, pose->t_ns, ret);
	if (k->params.on_jump == POSE_TRACK_IGNORE) {
		ret->jump.done = POSE_TRACK_KEEP;
		k->jumped = false; /* there is no way back */
		k->before = (struct place){.q = NO_TURN};
	}
	return true;
}

/* An absolute pose where the wheels have been silent for too long: it says where the robot is. */
static void find_again(struct pose_track *k, const struct pose *pose, struct pose_track_out *ret)
{
	struct place place = shown_place(k, pose);
	const struct judgement j = judge_by_poses(k, &place, pose->t_ns);
	bool jumped = false;
	struct mark mark;

	if (!within(k, &j, &j.expected, &place))
		jumped = jump(k, &j, pose, &place, ret);
	place = shown_place(k, pose);
	mark = mark_of(pose, &place);
	take_level(k, &place);
	begin_at(k, &mark);
	hand_out_mark(k, &mark, mark.t_ns, jumped, ret);
}

/* In a silence the robot may have gone on, stopped or turned: so far, and after a turn the way since lies elsewhere. */
static void allow_gap(const struct pose_track *k, int64_t t_ns, struct judgement *j)
{
	if (k->gap.ns == 0 || t_ns <= k->gap.begin_ns)
		return;
	j->slack_m += k->gap.m + (k->gap.rad < 2 ? k->gap.rad : 2) * k->gap.after_m;
	j->slack_rad += k->gap.rad;
}

/* Where the absolute pose lies within the track, or just ahead of it. */
static void adjust(struct pose_track *k, const struct pose *pose, struct pose_track_out *ret)
{
	const bool ahead = pose->t_ns > way_head(k)->t_ns, whole = !(pose->variance_m2 > 0 || pose->variance_rad2 > 0);
	struct place place = shown_place(k, pose);
	struct judgement j = {.slack_m = NOISE_SIGMAS * sqrt(pose->variance_m2),
	                      .slack_rad = NOISE_SIGMAS * sqrt(pose->variance_rad2)};
	bool ignored = false, jumped = false;
	struct mark was, is;
	uint64_t i;

	allow_gap(k, pose->t_ns, &j);
	if (ahead)
		go_ahead(k, pose->t_ns);
	i = way_before(k, pose->t_ns);
	was = way_between(k, i, pose->t_ns);
	j.expected = mark_place(k, &was);
	if (!within(k, &j, &j.expected, &place)) {
		jumped = jump(k, &j, pose, &place, ret);
		ignored = !jumped;
	}
	if (!ignored) {
		is = mark_of(pose, &place);
		if (!whole && !jumped)
			is = weighed(&was, &is);
		take_level(k, &place);
		correct(k, i, &was, &is);
		k->count.adjusted++;
	}
	if (pose->t_ns >= k->gap.begin_ns + k->gap.ns)
		k->gap = (struct gap){0};
	if (jumped && !ahead) { /* the frame ends where the track does now */
		struct mark head = *way_head(k);

		head.t_ns++;
		way_put(k, &head);
	}
	if (ahead || jumped)
		hand_out_mark(k, way_head(k), way_head(k)->t_ns, jumped, ret);
}

void pose_track_absolute(struct pose_track *k, const struct pose *pose, struct pose_track_out *ret)
{
	ret->has_pose = ret->has_jump = false;
	if (!k->params.motion) {
		pass(k, pose, ret);
		return;
	}
	if ((k->absolute_seen && pose->t_ns <= k->absolute_ns && k->absolute_ns - pose->t_ns < SET_BACK_NS) ||
	    (k->begun && pose->t_ns < way_at(k, k->way_begin)->t_ns)) {
		k->count.late++;
		return;
	}
	k->corrected = k->absolute_seen;
	k->absolute_seen = true;
	k->absolute_ns = pose->t_ns;
	if (!k->begun) {
		const struct place place = shown_place(k, pose);
		const struct mark mark = mark_of(pose, &place);

		take_level(k, &place);
		begin_at(k, &mark);
		hand_out_mark(k, &mark, mark.t_ns, false, ret);
	} else if (pose->t_ns > way_head(k)->t_ns && (!k->moved || pose->t_ns - k->moved_ns > REACH_NS)) {
		find_again(k, pose, ret);
	} else {
		adjust(k, pose, ret);
	}
}

/* The first motion begins the track, at the map's origin, unless an absolute pose is about to come. Where one should have
 * come and did not, nobody knows where that origin is: `trust` then holds the rows back until one does. */
static bool begin_with(struct pose_track *k, const struct motion *m)
{
	struct mark origin = {.t_ns = m->from_ns};

	if (k->params.absolute && (!k->waiting || m->from_ns < k->waited_ns)) {
		k->waiting = true;
		k->waited_ns = m->from_ns;
	}
	if (k->params.absolute && m->t_ns - k->waited_ns < WAIT_NS)
		return false;
	if (k->params.absolute)
		origin.p[0] = origin.p[3] = UNKNOWN_M2;
	begin_at(k, &origin);
	return true;
}

/* Nothing was heard of the wheels: they may have gone on, or stood. */
static void grow_over_gap(struct pose_track *k, struct mark *mark, int64_t gap_ns)
{
	const double s = (double)gap_ns * 1e-9, way = k->speed_m_s * s, turn = k->rad_s * s;

	mark->p[0] = bounded(mark->p[0] + way * way, VARIANCE_MAX);
	mark->p[3] = bounded(mark->p[3] + way * way, VARIANCE_MAX);
	mark->p[5] = bounded(mark->p[5] + turn * turn, VARIANCE_MAX);
	if (k->gap.ns == 0)
		k->gap.begin_ns = mark->t_ns;
	k->gap.ns = mark->t_ns + gap_ns - k->gap.begin_ns;
	k->gap.m = bounded(k->gap.m + fabs(way) + change_m(s), FAR_M);
	k->gap.rad = bounded(k->gap.rad + fabs(turn) + change_rad(s), FAR_M);
	k->count.gaps++;
}

void pose_track_motion(struct pose_track *k, const struct motion *m, struct pose_track_out *ret)
{
	double share = 1, s;
	struct mark head;
	bool gap;

	ret->has_pose = ret->has_jump = false;
	if (!k->params.motion || !(fabs(m->ahead_m) <= PIECE_M_MAX) || !(fabs(m->turn_rad) <= PIECE_RAD_MAX) ||
	    m->t_ns <= m->from_ns) {
		k->count.refused++;
		return;
	}
	if (!k->begun && !begin_with(k, m))
		return;
	head = *way_head(k);
	if (m->t_ns <= head.t_ns) {
		if (head.t_ns - m->t_ns < SET_BACK_NS)
			return;         /* an absolute pose was ahead of it */
		head.t_ns = m->from_ns; /* time was set back */
		begin_at(k, &head);
	}
	gap = m->from_ns > head.t_ns;
	if (gap)
		grow_over_gap(k, &head, m->from_ns - head.t_ns);
	else
		share = (double)(m->t_ns - head.t_ns) / (double)(m->t_ns - m->from_ns);
	if (k->gap.ns > 0)
		k->gap.after_m = bounded(k->gap.after_m + fabs(m->ahead_m * share), FAR_M);
	s = (double)(m->t_ns - m->from_ns) * 1e-9;
	k->speed_m_s = m->ahead_m / s;
	k->rad_s = m->turn_rad / s;
	k->moved = true;
	k->moved_ns = m->t_ns;
	head = moved(k, &head, m->t_ns, m->ahead_m * share, m->turn_rad * share);
	way_put(k, &head);
	hand_out_mark(k, &head, m->t_ns, gap || m->t_ns - m->from_ns > PIECE_NS_MAX, ret);
}

/* Life */

static void clear(struct pose_track *k)
{
	const struct pose_track_params params = k->params;

	memset(k, 0, sizeof(*k));
	k->params = params;
	k->level = k->hold.q = k->before.q = NO_TURN;
}

struct pose_track *pose_track_create(const struct pose_track_params *params)
{
	struct pose_track *k = malloc(sizeof(*k));

	if (!k)
		return NULL;
	k->params = *params;
	clear(k);
	return k;
}

void pose_track_destroy(struct pose_track *k)
{
	free(k);
}

void pose_track_status(const struct pose_track *k, struct pose_track_status *ret)
{
	*ret = k->count;
	ret->known = k->known;
	ret->sure = k->known && k->sure;
	ret->sigma_m = ret->sure ? sqrt(k->variance_m2) : 0;
	ret->sigma_rad = ret->sure ? sqrt(k->variance_rad2) : 0;
}

/* Snapshot. Numbers that no track has are refused: they would be carried on for ever. */

static void number_state(struct state *s, double *value, double max)
{
	state_double(s, value);
	s->failed |= s->loading && !(fabs(*value) <= max);
}

static void place_state(struct state *s, struct place *place)
{
	number_state(s, &place->t.x, 4 * FAR_M);
	number_state(s, &place->t.y, 4 * FAR_M);
	number_state(s, &place->t.z, 4 * FAR_M);
	number_state(s, &place->q.w, 2);
	number_state(s, &place->q.x, 2);
	number_state(s, &place->q.y, 2);
	number_state(s, &place->q.z, 2);
}

static void way_state(struct state *s, struct pose_track *k)
{
	size_t n = (size_t)(k->way_end - k->way_begin);

	state_size(s, &n, WAY);
	if (s->loading) {
		k->way_begin = 0;
		k->way_end = s->failed ? 0 : n;
	}
	for (uint64_t i = k->way_begin; i < k->way_end && !s->failed; i++) {
		struct mark *mark = way_at(k, i);

		state_time(s, &mark->t_ns);
		number_state(s, &mark->x_m, FAR_M);
		number_state(s, &mark->y_m, FAR_M);
		number_state(s, &mark->heading_rad, 4);
		for (int j = 0; j < 6; j++)
			number_state(s, &mark->p[j], VARIANCE_MAX);
		s->failed |= s->loading && (mark->p[0] < 0 || mark->p[3] < 0 || mark->p[5] < 0);
		s->failed |= s->loading && i > k->way_begin && mark->t_ns <= way_at(k, i - 1)->t_ns;
	}
	s->failed |= s->loading && k->begun != (k->way_end > k->way_begin);
}

static void seen_state(struct state *s, struct pose_track *k)
{
	size_t n = (size_t)(k->seen_end - k->seen_begin);

	state_size(s, &n, SEEN);
	if (s->loading) {
		k->seen_begin = 0;
		k->seen_end = s->failed ? 0 : n;
	}
	for (uint64_t i = k->seen_begin; i < k->seen_end && !s->failed; i++) {
		state_time(s, &seen_at(k, i)->t_ns);
		place_state(s, &seen_at(k, i)->place);
		s->failed |= s->loading && i > k->seen_begin && seen_at(k, i)->t_ns <= seen_at(k, i - 1)->t_ns;
	}
}

static void gap_state(struct state *s, struct gap *gap)
{
	state_time(s, &gap->begin_ns);
	state_time(s, &gap->ns);
	number_state(s, &gap->m, FAR_M);
	number_state(s, &gap->rad, FAR_M);
	number_state(s, &gap->after_m, FAR_M);
	s->failed |= s->loading && (gap->ns < 0 || gap->m < 0 || gap->rad < 0 || gap->after_m < 0);
}

static void fields_state(struct state *s, struct pose_track *k)
{
	struct place level = {{0, 0, k->z_m}, k->level};

	state_tag(s, "track2");
	state_bool(s, &k->begun);
	state_bool(s, &k->waiting);
	state_time(s, &k->waited_ns);
	way_state(s, k);
	state_bool(s, &k->moved);
	state_time(s, &k->moved_ns);
	number_state(s, &k->speed_m_s, 1e12);
	number_state(s, &k->rad_s, 1e12);
	gap_state(s, &k->gap);
	place_state(s, &level);
	k->z_m = level.t.z;
	k->level = level.q;
	state_bool(s, &k->absolute_seen);
	state_time(s, &k->absolute_ns);
	seen_state(s, k);
	state_bool(s, &k->held);
	state_bool(s, &k->before_held);
	state_bool(s, &k->jumped);
	place_state(s, &k->hold);
	place_state(s, &k->before);
	number_state(s, &k->variance_m2, 4 * VARIANCE_MAX);
	number_state(s, &k->variance_rad2, 4 * VARIANCE_MAX);
	s->failed |= s->loading && (k->variance_m2 < 0 || k->variance_rad2 < 0);
	state_bool(s, &k->known);
	state_bool(s, &k->sure);
	state_u64(s, &k->count.jumps);
	state_u64(s, &k->count.late);
	state_u64(s, &k->count.refused);
	state_u64(s, &k->count.gaps);
	state_u64(s, &k->count.adjusted);
}

void pose_track_state(struct state *s, struct pose_track *k)
{
	struct pose_track *aside;

	if (!s->loading) {
		fields_state(s, k);
		return;
	}
	aside = pose_track_create(&k->params);
	if (aside)
		fields_state(s, aside);
	s->failed |= !aside;
	if (s->failed)
		clear(k);
	else
		*k = *aside;
	pose_track_destroy(aside);
}

/* What is true in the rig: where the robot and its scanners are at any time, what each beam hit, and how far the rows of the
 * pipeline are from that.
 *
 * The robot moves in straight pieces between the places where it says where it is, so that the truth has no error of
 * interpolation. The servo is the simulated axis where there is one, else it goes up and down at a constant speed. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "tests/rig_parts.h"

#define REACH_M  30.0
#define KNOWN_NS (2 * RIG_SECOND)
#define COMPARED 8 /* every so manieth beam's angle is */

/* Forth and back along the drive, so that it never ends. */
struct pose rig_place(const struct rig *r, int64_t piece)
{
	double length_s = world_drive_seconds(r->world), t_s;

	if (r->params.stand)
		return world_drive(r->world, 0.0);
	t_s = fmod((double)piece * 1e-9 * (double)RIG_POSE_NS, 2 * length_s);
	return world_drive(r->world, t_s > length_s ? 2 * length_s - t_s : t_s);
}

struct pose rig_pose(struct rig *r, int64_t t_ns)
{
	int64_t since_ns = t_ns - RIG_EPOCH_NS, piece = since_ns / RIG_POSE_NS;
	double part = (double)(since_ns - piece * RIG_POSE_NS) / (double)RIG_POSE_NS;
	struct pose pose = {.t_ns = t_ns};

	if (r->piece != piece) {
		r->pose[0] = rig_place(r, piece);
		r->pose[1] = rig_place(r, piece + 1);
		r->piece = piece;
	}
	pose.position_m = vec3_lerp(r->pose[0].position_m, r->pose[1].position_m, part);
	pose.rotation = quat_between(r->pose[0].rotation, r->pose[1].rotation, part);
	return pose;
}

/* Up and down between the ends of the configured sweep; positive looks down. */
double rig_tilt(const struct rig *r, int64_t t_ns)
{
	double from = r->config.sweep.from_rad, to = r->config.sweep.to_rad, speed = r->config.sweep.speed_rad_s;
	double way, length = to - from;

	if (r->angle)
		return r->angle(r->angle_ctx, t_ns);
	if (!r->config.sweep.set || length <= 0 || speed <= 0)
		return 0.0;
	way = fmod((double)(t_ns - RIG_EPOCH_NS) * 1e-9 * speed, 2 * length);
	return from + (way > length ? 2 * length - way : way);
}

static struct transform laser_at(struct scanner *s, int64_t t_ns)
{
	const struct pose pose = rig_pose(s->rig, t_ns);
	struct transform base = transform_quat(pose.position_m, pose.rotation);
	struct transform tilt = transform_tilt(s->tilts ? rig_tilt(s->rig, t_ns) : 0.0), t;

	t = transform_compose(&base, &s->base_tilt);
	t = transform_compose(&t, &tilt);
	return transform_compose(&t, &s->tilt_laser);
}

static void set_truth(struct truth *truth, int k, double bearing, double range, const struct transform *laser)
{
	struct vec3 beam = {range * trig_cos(bearing), range * trig_sin(bearing), 0.0};
	struct vec3 point = transform_point(laser, beam);

	truth->range_m[k] = (float)range;
	truth->point_m[k][0] = (float)point.x;
	truth->point_m[k][1] = (float)point.y;
	truth->point_m[k][2] = (float)point.z;
}

/* Of each turn of the mirror every n-th beam is cast from where the scanner is then; those up to the next one of that turn
 * have its range and, for so short a time, its place. */
static void cast_beams(struct scanner *s, const struct profile *p, struct truth *truth)
{
	int thin = s->rig->params.thin > 1 ? s->rig->params.thin : 1;
	struct transform laser[4] = {0};
	double range[4] = {0};

	for (int k = 0; k < p->n; k++) {
		int turn = k % p->interlace & 3, at = k / p->interlace;
		double bearing = p->first_rad + k * p->step_rad;
		struct vec3 beam = {trig_cos(bearing), trig_sin(bearing), 0.0};

		if (at % thin == 0) {
			laser[turn] = laser_at(s, p->t_ns + (int64_t)turn * p->turn_ns + (int64_t)at * p->beam_ns);
			range[turn] =
			    world_cast(s->rig->world, laser[turn].t, transform_direction(&laser[turn], beam), REACH_M);
		}
		set_truth(truth, k, bearing, range[turn], &laser[turn]);
	}
}

void rig_scan(void *ctx, struct profile *p)
{
	struct scanner *s = ctx;
	struct truth *truth = &s->truth[s->truths++ % RIG_TRUTHS];

	truth->t_ns = p->t_ns;
	truth->turn_ns = p->turn_ns;
	truth->beam_ns = p->beam_ns;
	truth->interlace = p->interlace;
	truth->n = p->n;
	truth->first_rad = p->first_rad;
	truth->step_rad = p->step_rad;
	cast_beams(s, p, truth);
	for (int k = 0; k < p->n; k++) {
		p->state[k] = truth->range_m[k] > 0 ? BEAM_OK : BEAM_NO_ECHO;
		p->range_m[k] = truth->range_m[k] > 0 ? truth->range_m[k] : 0;
	}
}

/* Rows against the truth */

/* Index in the profile of the row's beam i; -1: it has none there. */
static int beam_of(const struct truth *truth, const struct row *row, uint32_t i)
{
	double k = (row->first_rad + i * row->step_rad - truth->first_rad) / truth->step_rad;
	int nearest = (int)floor(k + 0.5);

	return nearest >= 0 && nearest < truth->n && fabs(k - nearest) < 0.3 ? nearest : -1;
}

static bool same_ranges(const struct truth *truth, const struct row *row)
{
	uint32_t step = (row->n / 24 + 1) | 1, looked = 0, same = 0;

	for (uint32_t i = 0; i < row->n; i += step) {
		int k;

		if (row->beam[i].state != BEAM_OK || (k = beam_of(truth, row, i)) < 0)
			continue;
		looked++;
		same += fabsf(truth->range_m[k] - row->beam[i].range_m) < 0.012f;
	}
	return looked > 0 && same * 10 >= looked * 9;
}

/* True time of the row's first beam if it was made of this profile. */
static int64_t begin_of(const struct truth *truth, const struct row *row)
{
	int k = beam_of(truth, row, 0);

	return truth->t_ns + (k < 0 ? 0 : k % truth->interlace) * truth->turn_ns;
}

static const struct truth *recognise(const struct scanner *s, const struct row *row, int64_t *ret_off_ns)
{
	const struct truth *found = NULL;
	uint64_t known = s->truths < RIG_TRUTHS ? s->truths : RIG_TRUTHS;

	for (uint64_t i = 0; i < known; i++) {
		const struct truth *truth = &s->truth[i];
		int64_t off_ns = row->t_ns - begin_of(truth, row);

		if (llabs(off_ns) > KNOWN_NS || (found && llabs(off_ns) >= llabs(*ret_off_ns)))
			continue;
		if (!same_ranges(truth, row))
			continue;
		found = truth;
		*ret_off_ns = off_ns;
	}
	return found;
}

/* The tilt that its place in the map tells, against the true one of its own time. Beams along the axis tell nothing. */
static void compare_angle(struct scanner *s, const struct truth *truth, int k, const struct row_beam *b)
{
	const int64_t t_ns =
	    truth->t_ns + k % truth->interlace * truth->turn_ns + k / truth->interlace * truth->beam_ns;
	const struct pose pose = rig_pose(s->rig, t_ns);
	const struct transform base = transform_quat(pose.position_m, pose.rotation);
	const struct transform mounted = transform_compose(&base, &s->base_tilt), back = transform_inverse(&mounted);
	const struct vec3 way = {b->point.x - b->origin.x, b->point.y - b->origin.y, b->point.z - b->origin.z};
	const struct vec3 d = transform_direction(&back, way);
	double off;

	if (fabs(trig_cos(truth->first_rad + k * truth->step_rad)) < 0.3)
		return;
	off = fabs(trig_atan2(-d.z, d.x) - rig_tilt(s->rig, t_ns)) / TRIG_DEG;
	s->angles++;
	s->angle_off[off < 0.001 * RIG_ANGLES ? (int)(1000 * off) : RIG_ANGLES]++;
	if (off > s->points.angle_worst_deg)
		s->points.angle_worst_deg = off;
}

void rig_compare(struct scanner *s, const struct row *row)
{
	int64_t off_ns = 0;
	const struct truth *truth = recognise(s, row, &off_ns);
	bool any = false;

	for (uint32_t i = 0; i < row->n; i++) {
		const struct row_beam *b = &row->beam[i];
		int k = truth && b->state == BEAM_OK ? beam_of(truth, row, i) : -1;
		double off_m = 1e9;

		if (b->state != BEAM_OK)
			continue;
		any = true;
		if (k >= 0) {
			const float *p = truth->point_m[k];
			struct vec3 d = {b->point.x - (double)p[0], b->point.y - (double)p[1],
			                 b->point.z - (double)p[2]};

			off_m = sqrt(d.x * d.x + d.y * d.y + d.z * d.z);
			if (off_m > s->points.worst_m)
				s->points.worst_m = off_m;
			if (i % COMPARED == 0 && s->tilts)
				compare_angle(s, truth, k, b);
		}
		s->points.points++;
		s->points.near += off_m <= RIG_NEAR_M;
	}
	s->points.rows++;
	if (truth)
		s->time_ns[s->times++ % RIG_TIMES] = llabs(off_ns);
	else
		s->points.unknown_rows += any;
}

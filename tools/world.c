/* Built-in worlds: solids, a ray through them, and the robot's drive.
 *
 * A solid is an upright box (turned about z) or an upright cylinder. A ray meets them through a tree of bounding boxes,
 * halved at the median of the longer side; its nodes lie in one array, depth first, so that "not this one" is a jump
 * forward and the walk needs no stack. A beam through the building then costs well under a microsecond, and one turn of
 * a scanner is nothing beside the time it takes.
 *
 * A drive is a chain of pieces, straight or round, each with its speed, so position and heading are continuous and
 * where the robot is at a time is a search and one formula; nothing is integrated. Sine and arc tangent are the
 * project's own: the same world on every machine. */
#include "tools/world_parts.h"

#include <assert.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"

#define LEAF_SOLIDS 2
#define FAR         1e30

struct bounds {
	double lo[3], hi[3];
};

struct solid {
	bool round;
	struct vec3 middle, half; /* cylinder: half.x is its radius */
	double c, s;              /* of the box's yaw */
	struct bounds bounds;
};

struct node {
	struct bounds bounds;
	uint16_t first, n; /* solids of a leaf; n 0: the children follow */
	uint16_t skip;     /* the node to go on with when this one is missed or done */
};

struct piece {
	double t_s, speed, length; /* begins at t_s */
	double x, y, heading;      /* at its beginning */
	double curvature;          /* 1/m, positive left */
};

struct world {
	struct solid solid[WORLD_SOLIDS_MAX];
	int solids;
	struct node node[2 * WORLD_SOLIDS_MAX];
	int nodes;
	struct piece piece[2 * WORLD_PATH_MAX];
	int pieces;
	double seconds;
};

/* ---- solids ---- */

static void add(struct world *w, struct solid solid)
{
	double ex = solid.half.x, ey = solid.round ? solid.half.x : solid.half.y, ez = solid.half.z;
	const double *m = (const double[3]){solid.middle.x, solid.middle.y, solid.middle.z};

	if (!solid.round) {
		ex = fabs(solid.c) * solid.half.x + fabs(solid.s) * solid.half.y;
		ey = fabs(solid.s) * solid.half.x + fabs(solid.c) * solid.half.y;
	}
	for (int a = 0; a < 3; a++) {
		double e = a == 0 ? ex : a == 1 ? ey : ez;

		solid.bounds.lo[a] = m[a] - e;
		solid.bounds.hi[a] = m[a] + e;
	}
	assert(w->solids < WORLD_SOLIDS_MAX);
	w->solid[w->solids++] = solid;
}

void world_box(struct world *w, double x0, double y0, double z0, double x1, double y1, double z1)
{
	add(w, (struct solid){.middle = {0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * (z0 + z1)},
	                      .half = {0.5 * (x1 - x0), 0.5 * (y1 - y0), 0.5 * (z1 - z0)},
	                      .c = 1.0});
}

void world_turned_box(struct world *w, double x, double y, double length, double width, double z0, double z1,
                      double yaw_deg)
{
	add(w, (struct solid){.middle = {x, y, 0.5 * (z0 + z1)},
	                      .half = {0.5 * length, 0.5 * width, 0.5 * (z1 - z0)},
	                      .c = trig_cos(yaw_deg * TRIG_DEG),
	                      .s = trig_sin(yaw_deg * TRIG_DEG)});
}

void world_cylinder(struct world *w, double x, double y, double radius, double z0, double z1)
{
	add(w,
	    (struct solid){
	        .round = true, .middle = {x, y, 0.5 * (z0 + z1)}, .half = {radius, radius, 0.5 * (z1 - z0)}, .c = 1.0});
}

/* Along x when `along_x`: pieces beside, below and above each opening. */
static void wall(struct world *w, bool along_x, double at, double from, double to, double thickness, double height,
                 const struct world_opening *o, int openings)
{
	for (int i = 0; i <= openings; i++) {
		double end = i < openings ? o[i].from : to;
		double part[3][4] = {{from, end, 0.0, height}, {0}, {0}}; /* along from, to; z from, to */

		if (i < openings) {
			memcpy(part[1], (double[4]){o[i].from, o[i].to, 0.0, o[i].z0}, sizeof part[1]);
			memcpy(part[2], (double[4]){o[i].from, o[i].to, o[i].z1, height}, sizeof part[2]);
			from = o[i].to;
		}
		for (int k = 0; k < 3; k++) {
			const double *p = part[k];

			if (p[1] <= p[0] || p[3] <= p[2])
				continue;
			if (along_x)
				world_box(w, p[0], at, p[2], p[1], at + thickness, p[3]);
			else
				world_box(w, at, p[0], p[2], at + thickness, p[1], p[3]);
		}
	}
}

void world_wall_x(struct world *w, double y, double x0, double x1, double thickness, double height,
                  const struct world_opening *o, int openings)
{
	wall(w, true, y, x0, x1, thickness, height, o, openings);
}

void world_wall_y(struct world *w, double x, double y0, double y1, double thickness, double height,
                  const struct world_opening *o, int openings)
{
	wall(w, false, x, y0, y1, thickness, height, o, openings);
}

void world_table(struct world *w, double x, double y, double length, double width, double height, double yaw_deg)
{
	double c = trig_cos(yaw_deg * TRIG_DEG), s = trig_sin(yaw_deg * TRIG_DEG);

	world_turned_box(w, x, y, length, width, height - 0.04, height, yaw_deg);
	for (int i = 0; i < 4; i++) {
		double dx = (i & 1 ? 0.5 : -0.5) * (length - 0.12), dy = (i & 2 ? 0.5 : -0.5) * (width - 0.12);

		world_turned_box(w, x + c * dx - s * dy, y + s * dx + c * dy, 0.06, 0.06, 0.0, height - 0.04, yaw_deg);
	}
}

void world_round_table(struct world *w, double x, double y, double radius, double height)
{
	world_cylinder(w, x, y, radius, height - 0.04, height);
	world_cylinder(w, x, y, 0.05, 0.04, height - 0.04);
	world_cylinder(w, x, y, 0.5 * radius, 0.0, 0.04);
}

void world_chair(struct world *w, double x, double y, double yaw_deg)
{
	double c = trig_cos(yaw_deg * TRIG_DEG), s = trig_sin(yaw_deg * TRIG_DEG);

	world_turned_box(w, x, y, 0.42, 0.42, 0.40, 0.46, yaw_deg);
	world_turned_box(w, x - 0.19 * c, y - 0.19 * s, 0.04, 0.42, 0.46, 0.92, yaw_deg);
	world_cylinder(w, x, y, 0.04, 0.05, 0.40);
	world_cylinder(w, x, y, 0.26, 0.0, 0.05);
}

void world_stairs(struct world *w, double x0, double y0, double y1, int steps, double rise, double run)
{
	for (int i = 0; i < steps; i++)
		world_box(w, x0 + i * run, y0, 0.0, x0 + (i + 1) * run, y1, (i + 1) * rise);
}

/* ---- the tree ---- */

static struct bounds bounds_of(const struct world *w, int first, int n)
{
	struct bounds b = w->solid[first].bounds;

	for (int i = first + 1; i < first + n; i++)
		for (int a = 0; a < 3; a++) {
			b.lo[a] = w->solid[i].bounds.lo[a] < b.lo[a] ? w->solid[i].bounds.lo[a] : b.lo[a];
			b.hi[a] = w->solid[i].bounds.hi[a] > b.hi[a] ? w->solid[i].bounds.hi[a] : b.hi[a];
		}
	return b;
}

static double centre(const struct solid *s, int axis)
{
	return s->bounds.lo[axis] + s->bounds.hi[axis];
}

/* Insertion sort: a few hundred solids, once. Equal ones keep their order, so the tree is the same everywhere. */
static void sort_solids(struct solid *s, int n, int axis)
{
	for (int i = 1; i < n; i++) {
		struct solid moving = s[i];
		int at = i;

		for (; at > 0 && centre(&s[at - 1], axis) > centre(&moving, axis); at--)
			s[at] = s[at - 1];
		s[at] = moving;
	}
}

static void build_node(struct world *w, int first, int n)
{
	struct node *node = &w->node[w->nodes++];
	int axis = 0;

	node->bounds = bounds_of(w, first, n);
	if (n <= LEAF_SOLIDS) {
		node->first = (uint16_t)first;
		node->n = (uint16_t)n;
	} else {
		for (int a = 1; a < 3; a++)
			if (node->bounds.hi[a] - node->bounds.lo[a] > node->bounds.hi[axis] - node->bounds.lo[axis])
				axis = a;
		sort_solids(w->solid + first, n, axis);
		build_node(w, first, n / 2);
		build_node(w, first + n / 2, n - n / 2);
	}
	node->skip = (uint16_t)w->nodes;
}

/* ---- rays ---- */

struct ray {
	struct vec3 origin, direction;
	double o[3], inverse[3];
};

/* Where the ray enters the bounds, or FAR. */
static double enter(const struct ray *ray, const struct bounds *b, double limit)
{
	double near = 0.0, far = limit;

	for (int a = 0; a < 3; a++) {
		double t0 = (b->lo[a] - ray->o[a]) * ray->inverse[a], t1 = (b->hi[a] - ray->o[a]) * ray->inverse[a];
		double lo = t0 < t1 ? t0 : t1, hi = t0 < t1 ? t1 : t0;

		near = lo > near ? lo : near;
		far = hi < far ? hi : far;
	}
	return near <= far ? near : FAR;
}

static double inverse(double v)
{
	return fabs(v) > 1e-12 ? 1.0 / v : v < 0.0 ? -1e12 : 1e12;
}

static double hit_box(const struct solid *s, const struct ray *ray)
{
	struct vec3 o = vec3_sub(ray->origin, s->middle), d = ray->direction;
	double p[3] = {s->c * o.x + s->s * o.y, s->c * o.y - s->s * o.x, o.z};
	double q[3] = {s->c * d.x + s->s * d.y, s->c * d.y - s->s * d.x, d.z};
	double half[3] = {s->half.x, s->half.y, s->half.z}, near = -FAR, far = FAR;

	for (int a = 0; a < 3; a++) {
		double i = inverse(q[a]), t0 = (-half[a] - p[a]) * i, t1 = (half[a] - p[a]) * i;
		double lo = t0 < t1 ? t0 : t1, hi = t0 < t1 ? t1 : t0;

		near = lo > near ? lo : near;
		far = hi < far ? hi : far;
	}
	return near <= far && near > 0.0 ? near : FAR;
}

static double hit_cylinder(const struct solid *s, const struct ray *ray)
{
	struct vec3 o = vec3_sub(ray->origin, s->middle), d = ray->direction;
	double a = d.x * d.x + d.y * d.y, b = o.x * d.x + o.y * d.y, c = o.x * o.x + o.y * o.y - s->half.x * s->half.x;
	double root = b * b - a * c, i = inverse(d.z), near, far, z0 = (-s->half.z - o.z) * i,
	       z1 = (s->half.z - o.z) * i;

	near = z0 < z1 ? z0 : z1;
	far = z0 < z1 ? z1 : z0;
	if (root < 0.0 || (a < 1e-12 && c > 0.0))
		return FAR;
	if (a >= 1e-12) {
		double t0 = (-b - sqrt(root)) / a, t1 = (-b + sqrt(root)) / a;

		near = t0 > near ? t0 : near;
		far = t1 < far ? t1 : far;
	}
	return near <= far && near > 0.0 ? near : FAR;
}

double world_cast(const struct world *w, struct vec3 origin, struct vec3 direction, double max_m)
{
	struct ray ray = {origin,
	                  direction,
	                  {origin.x, origin.y, origin.z},
	                  {inverse(direction.x), inverse(direction.y), inverse(direction.z)}};
	double best = max_m;
	bool found = false;

	for (int i = 0; i < w->nodes;) {
		const struct node *node = &w->node[i];

		if (enter(&ray, &node->bounds, best) > best) {
			i = node->skip;
			continue;
		}
		for (int k = node->first; k < node->first + node->n; k++) {
			const struct solid *s = &w->solid[k];
			double t = s->round ? hit_cylinder(s, &ray) : hit_box(s, &ray);

			if (t <= best) {
				best = t;
				found = true;
			}
		}
		i = node->n ? node->skip : i + 1;
	}
	return found ? best : -1.0;
}

/* ---- the drive ---- */

static void add_piece(struct world *w, double length, double speed, double curvature, double x, double y,
                      double heading)
{
	assert(w->pieces < 2 * WORLD_PATH_MAX);
	w->piece[w->pieces++] = (struct piece){w->seconds, speed, length, x, y, heading, curvature};
	w->seconds += length / speed;
}

static double wrapped(double rad)
{
	return rad > TRIG_PI ? rad - 2.0 * TRIG_PI : rad < -TRIG_PI ? rad + 2.0 * TRIG_PI : rad;
}

/* A corner that turns by `turn` is cut `radius * tan(turn / 2)` before and after it. */
void world_path(struct world *w, const struct world_corner *p, int n, double radius, double speed, double turn_speed)
{
	double cut = 0.0;

	for (int i = 0; i + 1 < n; i++) {
		double dx = p[i + 1].x - p[i].x, dy = p[i + 1].y - p[i].y, length = sqrt(dx * dx + dy * dy);
		double heading = trig_atan2(dy, dx), begin = cut, turn = 0.0;

		if (i + 2 < n)
			turn = wrapped(trig_atan2(p[i + 2].y - p[i + 1].y, p[i + 2].x - p[i + 1].x) - heading);
		cut = radius * trig_sin(0.5 * fabs(turn)) / trig_cos(0.5 * turn);
		assert(begin + cut < length);
		add_piece(w, length - begin - cut, speed, 0.0, p[i].x + dx / length * begin,
		          p[i].y + dy / length * begin, heading);
		if (turn != 0.0)
			add_piece(w, radius * fabs(turn), turn_speed, (turn > 0.0 ? 1.0 : -1.0) / radius,
			          p[i + 1].x - dx / length * cut, p[i + 1].y - dy / length * cut, heading);
	}
}

struct pose world_drive(const struct world *w, double t_s)
{
	double t = t_s < 0.0 ? 0.0 : t_s > w->seconds ? w->seconds : t_s, way, heading, x, y;
	const struct piece *p;
	int i = 0;

	while (i + 1 < w->pieces && w->piece[i + 1].t_s <= t)
		i++;
	p = &w->piece[i];
	way = (t - p->t_s) * p->speed;
	heading = p->heading + p->curvature * way;
	if (p->curvature == 0.0) {
		x = p->x + way * trig_cos(heading);
		y = p->y + way * trig_sin(heading);
	} else {
		x = p->x + (trig_sin(heading) - trig_sin(p->heading)) / p->curvature;
		y = p->y - (trig_cos(heading) - trig_cos(p->heading)) / p->curvature;
	}
	return (struct pose){.t_ns = (int64_t)(t_s * 1e9),
	                     .position_m = {x, y, 0.0},
	                     .rotation = {.w = trig_cos(0.5 * heading), .z = trig_sin(0.5 * heading)}};
}

double world_drive_seconds(const struct world *w)
{
	return w->seconds;
}

/* ---- ---- */

struct world *world_create(const char *name, char error[160])
{
	bool hall = !strcmp(name, "hall");
	struct world *w = NULL;

	if (!hall && strcmp(name, "building")) {
		snprintf(error, 160, "there is no world \"%.60s\"; there are building and hall", name);
		return NULL;
	}
	w = calloc(1, sizeof *w);
	if (!w) {
		snprintf(error, 160, "out of memory");
		return NULL;
	}
	if (hall)
		world_build_hall(w);
	else
		world_build_building(w);
	build_node(w, 0, w->solids);
	return w;
}

void world_destroy(struct world *w)
{
	free(w);
}

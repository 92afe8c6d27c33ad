/* Half-edge collapses, cheapest first.
 *
 * A vertex waits in a tournament under the cost of its best target; when its turn comes its targets are tried from the
 * cheapest on, and one that the guards or the exact test refuse hands the turn back under the cost of the next. A
 * collapse gives the vertices around it a new turn. Ties go to the smaller index: the order is total. (A heap would
 * ask for a comparison nobody can foresee at each of its levels; a tournament asks for a minimum.)
 *
 * The cost of moving v into u is the mean squared distance of u to the planes both stand for, at most the tolerance
 * squared, plus a little of the length of the way, so that flat parts shrink evenly. The exact test of law L5 asks more:
 * each raw vertex in the lists of the triangles of v, and v itself, must lie within the tolerance of a triangle that
 * stays, and goes to the list of the nearest one.
 *
 * A vertex of an open rim moves along the rim only. What goes from a rim is kept in the list of the rim's half-edge: it
 * may lie half a cell from the new edge sideways, and the tolerance from the plane of the nearest triangle. No vertex of any
 * rim may come to lie on the new edge: that would be a crack of no width. */
#include "core/simplify.h"

#include <assert.h>
#include <errno.h>
#include <string.h>

#include "core/guard.h"
#include "core/predicates.h"

#define COSINE_TURN  0.30901699437494742 /* 72 degrees */
#define RIM_SIDEWAYS 0.5                 /* cells */
#define RIM_GAP      5                   /* lattice units a rim vertex keeps from other rim edges, 0.02 cell */
#define ERROR_SHARE  0.1                 /* of the sum of squared distances, in the cost */
#define WIDE         (1.2 * LATTICE)     /* a side beyond which the middle of a triangle is looked at */
#define LENGTH_SHARE 0.002               /* of the squared way */

struct target {
	double cost;
	uint32_t u, h;
};

/* What a cost reads of a vertex. */
struct spot {
	struct vec3 at;
	double own;    /* its quadric at its own place */
	double planes; /* weight of its quadric */
};

/* Where a vertex may go, side by side: what is asked of one is asked of all. A vertex with more has several rounds. */
#define WAYS_MAX 8
struct ways {
	uint32_t n, u[WAYS_MAX], h[WAYS_MAX];
	double x[WAYS_MAX], y[WAYS_MAX], z[WAYS_MAX], own[WAYS_MAX], planes[WAYS_MAX];
	double cost[WAYS_MAX];
};

struct pass {
	struct simplify *s;
	struct spot *spot;   /* [nv] */
	double *key;         /* [2 leaves] tournament: key[leaves + v] of vertex v, below them the lesser of two */
	uint32_t leaves;     /* a power of two, at least nv */
	struct target *best; /* [nv] */
	bool *stale;         /* [nv] `best` may have changed */
	bool *on_rim;        /* [nv] */
	bool *tried;         /* [nv] a cheaper target was refused since the last change around */
	uint32_t *rim, rims; /* vertices that were on a border at the start */
	struct ways ways;
	struct halfedge_ring ring; /* of the vertex whose turn it is */
	struct fan fan;            /* its triangles that stay, as they then lie */
	uint32_t fan_triangle[FAN_MAX];
	uint32_t *point, *point_triangle, points; /* where the exact test puts the points */
};

int simplify_init(struct simplify *s, const struct surface *raw, const struct border *border, double tolerance,
                  struct arena *arena)
{
	*s = (struct simplify){.border = *border};
	int r = halfedge_build(raw, border->members, arena, &s->mesh);
	if (r == -ENOMEM)
		return r;
	assert(r == 0); /* marching cubes gives no edge more than two faces */
	uint32_t cap_nt = s->mesh.cap_nt;
	s->origin = ARENA_NEW(arena, struct vec3, raw->nv);
	s->quadric = ARENA_NEW(arena, struct quadric, raw->nv);
	s->fixed = ARENA_NEW(arena, bool, raw->nv);
	s->next_point = ARENA_NEW(arena, uint32_t, raw->nv);
	s->points = ARENA_NEW(arena, uint32_t, cap_nt);
	s->plane = ARENA_NEW(arena, uint32_t, cap_nt);
	s->rim_points = ARENA_NEW(arena, uint32_t, 3 * (size_t)cap_nt);
	r = nearby_init(&s->nearby, raw, arena);
	if (r)
		return r;
	if (!s->origin || !s->quadric || !s->fixed || !s->next_point || !s->points || !s->plane || !s->rim_points)
		return -ENOMEM;
	memset(s->points, 0xff, cap_nt * sizeof *s->points);
	memset(s->plane, 0xff, cap_nt * sizeof *s->plane);
	memset(s->rim_points, 0xff, 3 * (size_t)cap_nt * sizeof *s->rim_points);
	s->tolerance_squared = tolerance * tolerance * LATTICE * LATTICE;
	s->rim_squared = RIM_SIDEWAYS * RIM_SIDEWAYS * LATTICE * LATTICE;
	for (uint32_t v = 0; v < raw->nv; v++)
		s->origin[v] = simplify_place(s, v);
	for (uint32_t t = 0; t < raw->nt; t++) {
		const uint32_t *corner = raw->triangle[t];
		struct vec3 a = s->origin[corner[0]], b = s->origin[corner[1]], c = s->origin[corner[2]];
		struct vec3 normal = vec3_cross(vec3_sub(b, a), vec3_sub(c, a));
		double length = vec3_norm(normal);
		if (length == 0)
			continue;
		double unit[3] = {normal.x / length, normal.y / length, normal.z / length}, at[3] = {a.x, a.y, a.z};
		for (int k = 0; k < 3; k++)
			quadric_add_plane(&s->quadric[corner[k]], unit, at, length / (LATTICE * LATTICE));
	}
	return 0;
}

void simplify_settle(struct simplify *s)
{
	for (uint32_t v = 0; v < s->mesh.nv; v++) {
		uint32_t borders = 0;
		HALFEDGE_EACH(&s->mesh, h, v)
		borders += s->mesh.twin[h] == HALFEDGE_NONE;
		uint8_t kind = s->border.kind[v];
		s->fixed[v] = kind == BORDER_CHAIN || kind == BORDER_PINNED || borders > 1;
	}
}

/* The tournament of vertices, by key, then by index. INFINITY: the vertex has no turn. */
static void set_key(struct pass *pass, uint32_t v, double key)
{
	double *at = pass->key;
	uint32_t k = pass->leaves + v;
	at[k] = key;
	for (; k > 1; k /= 2) {
		double other = at[k ^ 1];
		key = key < other ? key : other;
		at[k / 2] = key;
	}
}

static bool has_turn(const struct pass *pass, uint32_t v)
{
	return pass->key[pass->leaves + v] < INFINITY;
}

/* The vertex of the least key; HALFEDGE_NONE where nobody has a turn. */
static uint32_t first_turn(const struct pass *pass)
{
	uint32_t k = 1;
	if (pass->key[1] == INFINITY)
		return HALFEDGE_NONE;
	while (k < pass->leaves)
		k = 2 * k + (pass->key[2 * k] != pass->key[1]);
	return k - pass->leaves;
}

static void note_own(struct pass *pass, uint32_t u)
{
	const struct quadric *quadric = &pass->s->quadric[u];
	struct spot *spot = &pass->spot[u];
	const double at[3] = {spot->at.x, spot->at.y, spot->at.z};
	spot->own = quadric_at(quadric, at);
	spot->planes = quadric->planes;
}

static void add_way(const struct spot *spot, uint32_t u, uint32_t h, struct ways *ways)
{
	uint32_t k = ways->n++;
	ways->u[k] = u;
	ways->h[k] = h;
	ways->x[k] = spot[u].at.x;
	ways->y[k] = spot[u].at.y;
	ways->z[k] = spot[u].at.z;
	ways->own[k] = spot[u].own;
	ways->planes[k] = spot[u].planes;
}

/* Costs of moving v along each way; INFINITY where the mean quadric is beyond the tolerance. */
static void cost_ways(const struct pass *pass, uint32_t v, struct ways *ways)
{
	const struct quadric quadric = pass->s->quadric[v];
	const struct spot from = pass->spot[v];
	double tolerance_squared = pass->s->tolerance_squared;
	for (uint32_t k = 0; k < WAYS_MAX; k++) {
		const double at[3] = {ways->x[k], ways->y[k], ways->z[k]};
		double x = at[0] - from.at.x, y = at[1] - from.at.y, z = at[2] - from.at.z;
		double sum = quadric_at(&quadric, at) + ways->own[k];
		double cost = ERROR_SHARE * sum + LENGTH_SHARE * (x * x + y * y + z * z);
		cost = cost > 0 ? cost : 0;
		ways->cost[k] = sum > tolerance_squared * (from.planes + ways->planes[k]) ? INFINITY : cost;
	}
}

/* The cheapest way, of several that to the smallest vertex, if it comes before `best`. */
static void choose_way(const struct ways *ways, struct target *best)
{
	double least[WAYS_MAX / 2];
	uint32_t ties = 0;
	for (uint32_t k = 0; k < WAYS_MAX / 2; k++)
		least[k] = ways->cost[k] < ways->cost[k + WAYS_MAX / 2] ? ways->cost[k] : ways->cost[k + WAYS_MAX / 2];
	for (uint32_t k = 1; k < WAYS_MAX / 2; k++)
		least[0] = least[k] < least[0] ? least[k] : least[0];
	if (least[0] == INFINITY)
		return;
	for (uint32_t k = 0; k < WAYS_MAX; k++)
		ties |= (uint32_t)(ways->cost[k] == least[0]) << k;
	for (; ties; ties &= ties - 1) {
		uint32_t k = (uint32_t)__builtin_ctz(ties);
		if (least[0] < best->cost || (least[0] == best->cost && ways->u[k] < best->u))
			*best = (struct target){least[0], ways->u[k], ways->h[k]};
	}
}

/* The ways up to `floor` are out. */
static void rule_out(struct ways *ways, const struct target *floor)
{
	for (uint32_t k = 0; k < ways->n; k++)
		if (ways->cost[k] < floor->cost || (ways->cost[k] == floor->cost && ways->u[k] <= floor->u))
			ways->cost[k] = INFINITY;
}

/* The cheapest target of v, after `floor` unless that is NULL; its cost is INFINITY where there is none. */
static struct target best_target(struct pass *pass, uint32_t v, const struct target *floor)
{
	const struct halfedge_mesh *mesh = &pass->s->mesh;
	struct target best = {INFINITY, 0, HALFEDGE_NONE};
	struct ways *ways = &pass->ways;
	for (uint32_t h = mesh->first[v]; h != HALFEDGE_NONE;) {
		ways->n = 0;
		for (uint32_t k = 0; k < WAYS_MAX; k++)
			ways->planes[k] = -INFINITY; /* no way costs INFINITY */
		if (pass->on_rim[v]) {
			uint32_t from = halfedge_border_from(mesh, v), into = halfedge_border_into(mesh, v);
			add_way(pass->spot, halfedge_target(mesh, from), from, ways);
			add_way(pass->spot, mesh->origin[into], into, ways);
			h = HALFEDGE_NONE;
		}
		for (; h != HALFEDGE_NONE && ways->n < WAYS_MAX; h = mesh->next_leaving[h])
			add_way(pass->spot, halfedge_target(mesh, h), h, ways);
		cost_ways(pass, v, ways);
		if (floor)
			rule_out(ways, floor);
		choose_way(ways, &best);
	}
	return best;
}

/* What v would cost, as of now. */
static void give_turn(struct pass *pass, uint32_t v)
{
	pass->tried[v] = false;
	pass->stale[v] = false;
	pass->best[v] = best_target(pass, v, NULL);
	set_key(pass, v, pass->best[v].cost);
}

/* Something around v has changed. Costs hardly ever fall by that, so it is looked at when its turn comes; at once only
 * where it has none, or one that comes late because cheaper targets were refused. */
static void notice(struct pass *pass, uint32_t v)
{
	if (pass->s->fixed[v])
		return;
	pass->stale[v] = true;
	if (!has_turn(pass, v) || pass->tried[v])
		give_turn(pass, v);
}

/* Lays out the triangles that stay when v moves into u, as they then lie; false where one turns too far or gets thin. */
static bool lay_fan(struct pass *pass, uint32_t u)
{
	const struct halfedge_ring *ring = &pass->ring;
	struct fan *fan = &pass->fan;
	assert(ring->n <= FAN_MAX); /* with more, GUARD_VALENCE_MAX refuses it */
	fan_begin(fan, pass->spot[u].at);
	for (uint32_t k = 0; k < ring->n; k++) {
		pass->fan_triangle[fan->n] = ring->h[k] / 3;
		if (ring->x[k] != u && ring->y[k] != u)
			fan_add(fan, pass->spot[ring->x[k]].at, pass->spot[ring->y[k]].at);
	}
	fan_span(fan);
	return guard_fan(fan, pass->spot[ring->v].at, COSINE_TURN);
}

/* The rest of what distances need. Where no triangle stays, the fan is the one behind the tip of h. */
static void close_fan(struct pass *pass, uint32_t h)
{
	const struct halfedge_mesh *mesh = &pass->s->mesh;
	struct fan *fan = &pass->fan;
	if (!fan->n) {
		uint32_t next = mesh->twin[halfedge_next(h)], previous = mesh->twin[halfedge_previous(h)];
		uint32_t t = (next != HALFEDGE_NONE ? next : previous) / 3;
		const uint32_t *corner = &mesh->origin[3 * t];
		fan_begin(fan, pass->spot[corner[0]].at);
		fan_add(fan, pass->spot[corner[1]].at, pass->spot[corner[2]].at);
		fan_span(fan);
		pass->fan_triangle[0] = t;
	}
	fan_close(fan);
}

static bool place_point(struct pass *pass, uint32_t p)
{
	double squared;
	uint32_t f = fan_nearest(&pass->fan, pass->s->origin[p], &squared);
	if (squared > pass->s->tolerance_squared)
		return false;
	pass->point[pass->points] = p;
	pass->point_triangle[pass->points++] = pass->fan_triangle[f];
	return true;
}

/* Of what went from a rim: near a triangle sideways, within the tolerance of its plane. */
static bool rim_point_near(const struct pass *pass, uint32_t p)
{
	double squared;
	struct vec3 at = pass->s->origin[p];
	double height = fan_height(&pass->fan, fan_nearest(&pass->fan, at, &squared), at);
	return squared <= pass->s->rim_squared && height * height <= pass->s->tolerance_squared;
}

static bool points_stay_near(struct pass *pass, bool rim)
{
	const struct simplify *s = pass->s;
	const struct halfedge_ring *ring = &pass->ring;
	pass->points = 0;
	if (!rim && !place_point(pass, ring->v))
		return false;
	for (uint32_t k = 0; k < ring->n; k++) {
		uint32_t t = ring->h[k] / 3;
		for (uint32_t p = s->points[t]; p != UINT32_MAX; p = s->next_point[p])
			if (!place_point(pass, p))
				return false;
		for (uint32_t e = 3 * t; e < 3 * t + 3; e++)
			for (uint32_t p = s->rim_points[e]; p != UINT32_MAX; p = s->next_point[p])
				if (!rim_point_near(pass, p))
					return false;
	}
	return true;
}

/* The border half-edge at v other than h. */
static uint32_t other_rim_edge(const struct halfedge_mesh *mesh, uint32_t v, uint32_t h)
{
	uint32_t from = halfedge_border_from(mesh, v);
	return from != h ? from : halfedge_border_into(mesh, v);
}

/* Whether what went from the rim between w, v and u, and v itself, lies near the edge w-u. */
static bool rim_stays_near(const struct pass *pass, uint32_t v, uint32_t u, uint32_t h)
{
	const struct simplify *s = pass->s;
	uint32_t edge[2] = {h, other_rim_edge(&s->mesh, v, h)}, w = halfedge_other(&s->mesh, edge[1], v);
	struct vec3 a = simplify_place(s, w), b = simplify_place(s, u);
	if (segment_distance_squared(a, b, s->origin[v]) > s->rim_squared || !rim_point_near(pass, v))
		return false;
	for (int k = 0; k < 2; k++)
		for (uint32_t p = s->rim_points[edge[k]]; p != UINT32_MAX; p = s->next_point[p])
			if (segment_distance_squared(a, b, s->origin[p]) > s->rim_squared)
				return false;
	return true;
}

/* Whether no other border vertex lies on the edge a-b, or almost. */
static bool rim_clear(const struct pass *pass, uint32_t a, uint32_t b, uint32_t v)
{
	const struct halfedge_mesh *mesh = &pass->s->mesh;
	const int32_t *pa = mesh->position[a], *pb = mesh->position[b];
	int64_t length = distance_squared3(pa, pb);
	for (uint32_t k = 0; k < pass->rims; k++) {
		uint32_t c = pass->rim[k];
		const int32_t *pc = mesh->position[c];
		if (c == a || c == b || c == v || mesh->first[c] == HALFEDGE_NONE)
			continue;
		int64_t from_a = distance_squared3(pa, pc), from_b = distance_squared3(pb, pc), normal[3];
		if (from_a > length + from_b || from_b > length + from_a)
			continue;
		triangle_normal(pa, pb, pc, normal);
		if (normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2] <= RIM_GAP * RIM_GAP * length)
			return false;
	}
	return true;
}

/* Lists of border edges whose triangle goes while the edge stays: they follow the edge to the triangle behind it. */
static void follow_rims(struct simplify *s, uint32_t h)
{
	struct halfedge_mesh *mesh = &s->mesh;
	uint32_t edge[2] = {halfedge_next(h), halfedge_previous(h)};
	for (int k = 0; k < 2; k++) {
		uint32_t heir = mesh->twin[edge[1 - k]];
		if (mesh->twin[edge[k]] == HALFEDGE_NONE && heir != HALFEDGE_NONE)
			s->rim_points[heir] = s->rim_points[edge[k]];
		s->rim_points[edge[k]] = UINT32_MAX;
	}
}

/* Joins v and the lists of its two rim edges; returns the list. */
static uint32_t take_rim(struct simplify *s, uint32_t v, uint32_t h, uint32_t other)
{
	uint32_t list = v, edge[2] = {h, other};
	s->next_point[v] = UINT32_MAX;
	for (int k = 0; k < 2; k++) {
		for (uint32_t p = s->rim_points[edge[k]], next; p != UINT32_MAX; p = next) {
			next = s->next_point[p];
			s->next_point[p] = list;
			list = p;
		}
		s->rim_points[edge[k]] = UINT32_MAX;
	}
	return list;
}

/* A triangle that got a corner off its plane has none any more. */
static void leave_planes(const struct pass *pass, uint32_t u)
{
	const struct simplify *s = pass->s;
	for (uint32_t f = 0; f < pass->fan.n; f++) {
		uint32_t *number = &s->plane[pass->fan_triangle[f]];
		if (*number == UINT32_MAX)
			continue;
		const struct region_plane *plane = &s->region[*number];
		double height = vec3_dot(plane->normal, simplify_place(s, u)) + plane->offset;
		if (height * height > s->tolerance_squared)
			*number = UINT32_MAX;
	}
}

static void commit(struct pass *pass, uint32_t v, uint32_t u, uint32_t h, bool rim)
{
	struct simplify *s = pass->s;
	struct halfedge_mesh *mesh = &s->mesh;
	uint32_t list = UINT32_MAX, w = HALFEDGE_NONE, g = mesh->twin[h];
	if (rim) {
		uint32_t other = other_rim_edge(mesh, v, h);
		w = halfedge_other(mesh, other, v);
		list = take_rim(s, v, h, other);
	}
	for (uint32_t k = 0; k < pass->ring.n; k++)
		s->points[pass->ring.h[k] / 3] = UINT32_MAX;
	for (uint32_t k = 0; k < pass->points; k++) {
		uint32_t t = pass->point_triangle[k];
		s->next_point[pass->point[k]] = s->points[t];
		s->points[t] = pass->point[k];
	}
	follow_rims(s, h);
	if (g != HALFEDGE_NONE)
		follow_rims(s, g);
	leave_planes(pass, u);
	quadric_add(&s->quadric[u], &s->quadric[v]);
	note_own(pass, u);
	halfedge_collapse(mesh, h, v);
	if (rim) {
		uint32_t e = halfedge_find(mesh, w, u);
		s->rim_points[e != HALFEDGE_NONE ? e : halfedge_find(mesh, u, w)] = list;
	}
}

/* Whether the new edges of u, and the middles of new triangles that are wide, run where the raw surface was. Each new
 * edge is the first side of one of the triangles. */
static bool flats_stay_near(const struct pass *pass)
{
	const struct nearby *nearby = &pass->s->nearby;
	const struct fan *fan = &pass->fan;
	int edge[FAN_MAX], middle[FAN_MAX]; /* parts */
	for (uint32_t k = 0; k < fan->n; k++) {
		double squared = (fan->ab_ab[k] + fan->ac_ac[k] + 2 * fan->ab_ac[k]) / 4;
		edge[k] = nearby_parts(fan->ab_ab[k]);
		middle[k] = fan->bc_bc[k] > WIDE * WIDE ? nearby_parts(squared) : 1;
	}
	for (uint32_t k = 0; k < fan->n; k++) {
		struct vec3 ab = {fan->ab[0][k], fan->ab[1][k], fan->ab[2][k]};
		struct vec3 ac = {fan->ac[0][k], fan->ac[1][k], fan->ac[2][k]};
		if (!nearby_has_segment(nearby, fan->a, ab, edge[k]) ||
		    !nearby_has_segment(nearby, fan->a, vec3_scale(vec3_add(ab, ac), 0.5), middle[k]))
			return false;
	}
	return true;
}

static bool try_target(struct pass *pass, uint32_t v, const struct target *target)
{
	struct simplify *s = pass->s;
	struct halfedge_mesh *mesh = &s->mesh;
	uint32_t u = target->u, h = target->h;
	bool rim = mesh->twin[h] == HALFEDGE_NONE;
	struct halfedge_ring *ring = &pass->ring;
	uint32_t to = halfedge_mark_ring(mesh, u);
	if (!halfedge_gather(mesh, v, ring))
		return false;
	uint32_t after = ring->n + to - (rim ? 2 : 4);
	if ((after > GUARD_VALENCE_MAX && after > to) || !halfedge_may_collapse(mesh, ring, h) ||
	    !guard_patch_faces(mesh, s->border.faces, ring, u, HALFEDGE_NONE) || !lay_fan(pass, u))
		return false;
	close_fan(pass, h);
	if (rim && (!rim_stays_near(pass, v, u, h) ||
	            !rim_clear(pass, halfedge_other(mesh, other_rim_edge(mesh, v, h), v), u, v)))
		return false;
	if (!points_stay_near(pass, rim) || !flats_stay_near(pass))
		return false;
	commit(pass, v, u, h, rim);
	return true;
}

static void notice_around(struct pass *pass, uint32_t u)
{
	const struct halfedge_mesh *mesh = &pass->s->mesh;
	if (!pass->s->fixed[u])
		give_turn(pass, u);
	HALFEDGE_EACH(mesh, h, u)
	{
		notice(pass, halfedge_target(mesh, h));
		if (mesh->twin[halfedge_previous(h)] == HALFEDGE_NONE)
			notice(pass, mesh->origin[halfedge_previous(h)]);
	}
}

static void take_turn(struct pass *pass, uint32_t v)
{
	if (pass->stale[v]) {
		double before = pass->key[pass->leaves + v];
		give_turn(pass, v);
		if (pass->best[v].cost > before)
			return;
	}
	struct target target = pass->best[v];
	if (try_target(pass, v, &target)) {
		set_key(pass, v, INFINITY);
		notice_around(pass, target.u);
		return;
	}
	pass->tried[v] = true;
	pass->best[v] = best_target(pass, v, &target);
	set_key(pass, v, pass->best[v].cost);
}

static int reserve(struct pass *pass, uint32_t nv, struct arena *arena)
{
	for (pass->leaves = 1; pass->leaves < nv;)
		pass->leaves *= 2;
	pass->spot = ARENA_NEW(arena, struct spot, nv);
	pass->key = ARENA_NEW(arena, double, 2 * (size_t)pass->leaves);
	pass->best = ARENA_NEW(arena, struct target, nv);
	pass->stale = ARENA_NEW(arena, bool, nv);
	pass->on_rim = ARENA_NEW(arena, bool, nv);
	pass->tried = ARENA_NEW(arena, bool, nv);
	pass->rim = ARENA_NEW(arena, uint32_t, nv);
	pass->point = ARENA_NEW(arena, uint32_t, nv);
	pass->point_triangle = ARENA_NEW(arena, uint32_t, nv);
	if (!pass->spot || !pass->key || !pass->best || !pass->stale || !pass->on_rim || !pass->tried || !pass->rim ||
	    !pass->point || !pass->point_triangle)
		return -ENOMEM;
	for (uint32_t k = 0; k < 2 * pass->leaves; k++)
		pass->key[k] = INFINITY;
	return 0;
}

int simplify_collapse(struct simplify *s, struct arena *arena)
{
	uint32_t nv = s->mesh.nv;
	int r;
	struct pass *pass = ARENA_NEW(arena, struct pass, 1);
	if (!pass)
		return -ENOMEM;
	pass->s = s;
	r = reserve(pass, nv, arena);
	if (r)
		return r;
	for (uint32_t v = 0; v < nv; v++) {
		if (s->mesh.first[v] == HALFEDGE_NONE)
			continue;
		pass->spot[v].at = simplify_place(s, v);
		note_own(pass, v);
		pass->on_rim[v] = halfedge_border_from(&s->mesh, v) != HALFEDGE_NONE;
		if (pass->on_rim[v])
			pass->rim[pass->rims++] = v;
	}
	for (uint32_t v = 0; v < nv; v++)
		if (s->mesh.first[v] != HALFEDGE_NONE && !s->fixed[v])
			give_turn(pass, v);
	for (uint32_t v; (v = first_turn(pass)) != HALFEDGE_NONE;)
		take_turn(pass, v);
	return 0;
}

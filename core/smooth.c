/* Marching cubes leaves ripples of a few hundredths of a cell; without them fewer triangles describe the same wall. Borders
 * and rims do not move. All targets come from the places before the step; they are then taken one vertex after the
 * other, each only if its triangles keep their shape and the lattice point is free: two vertices at one point would be
 * welded by whoever reads the mesh. Errors are measured from the raw places ever after. */
#include "core/smooth.h"

#include <errno.h>
#include <string.h>

#include "core/guard.h"

#define STEP_SHARE  0.7                 /* of the way to the mean */
#define STEP_MAX    0.48                /* of the tolerance: 0.12 cell where that is a quarter */
#define COSINE_TURN 0.70710678118654752 /* 45 degrees, per step of one corner */
#define INSIDE_MIN  2                   /* lattice units an inner vertex keeps from the faces of the patch */

static double longer(double a, double b)
{
	return a > b ? a : b;
}

static bool turns_little(struct vec3 at, struct vec3 to, struct vec3 b, struct vec3 c)
{
	struct vec3 tb = vec3_sub(b, to), tc = vec3_sub(c, to), bc = vec3_sub(c, b);
	double longest = longer(longer(vec3_dot(tb, tb), vec3_dot(tc, tc)), vec3_dot(bc, bc));
	return guard_normals(vec3_cross(vec3_sub(b, at), vec3_sub(c, at)), vec3_cross(tb, tc), longest, COSINE_TURN);
}

/* Lattice points in use. */
struct places {
	uint64_t *slot; /* packed place + 1; 0 free */
	uint32_t mask;
};

static uint64_t pack(const int32_t p[3])
{
	return (((uint64_t)p[0] << 13 | (uint64_t)p[1]) << 13 | (uint64_t)p[2]) + 1;
}

/* Claims the place; false where it is taken already. */
static bool claim(struct places *places, const int32_t p[3])
{
	uint64_t key = pack(p);
	uint32_t at = (uint32_t)((key * 0x9e3779b97f4a7c15ull) >> 32) & places->mask;
	for (; places->slot[at]; at = (at + 1) & places->mask)
		if (places->slot[at] == key)
			return false;
	places->slot[at] = key;
	return true;
}

/* What one step is about: the vertices that may move, in order, with their fans. */
struct step {
	struct vec3 *place; /* [nv] as doubles; exact, as all that is made of lattice points below */
	uint32_t *vertex, n;
	uint32_t *fan_end;  /* [n] */
	uint32_t (*fan)[2]; /* of each triangle of a vertex the two other corners */
	int32_t (*to)[3];   /* [n] the lattice point a vertex would like to be at */
};

/* Adds the fan of v; false where v is on a border of the mesh. */
static bool add_fan(struct step *step, const struct halfedge_mesh *mesh, uint32_t v)
{
	uint32_t n = step->n ? step->fan_end[step->n - 1] : 0;
	HALFEDGE_EACH(mesh, h, v)
	{
		if (mesh->twin[h] == HALFEDGE_NONE)
			return false;
		step->fan[n][0] = halfedge_target(mesh, h);
		step->fan[n++][1] = mesh->origin[halfedge_previous(h)];
	}
	step->vertex[step->n] = v;
	step->fan_end[step->n++] = n;
	return true;
}

static uint32_t fan_start(const struct step *step, uint32_t k)
{
	return k ? step->fan_end[k - 1] : 0;
}

/* Where the vertex would like to be, at most `most` from where it is. */
static struct vec3 target_of(const struct step *step, uint32_t k, double most)
{
	const struct vec3 *place = step->place;
	struct vec3 at = place[step->vertex[k]], sum = {0, 0, 0}, normal = {0, 0, 0};
	uint32_t first = fan_start(step, k), end = step->fan_end[k];
	for (uint32_t i = first; i < end; i++) {
		struct vec3 b = vec3_sub(place[step->fan[i][0]], at), c = vec3_sub(place[step->fan[i][1]], at);
		sum = vec3_add(sum, b);
		normal = vec3_add(normal, vec3_cross(b, c));
	}
	double length = vec3_norm(normal);
	if (length == 0)
		return at;
	double way = STEP_SHARE * vec3_dot(sum, normal) / ((end - first) * length);
	way = way < most ? way : most;
	way = way > -most ? way : -most;
	return vec3_add(at, vec3_scale(normal, way / length));
}

static bool shape_kept(const struct step *step, uint32_t k, struct vec3 to)
{
	struct vec3 at = step->place[step->vertex[k]];
	for (uint32_t i = fan_start(step, k); i < step->fan_end[k]; i++)
		if (!turns_little(at, to, step->place[step->fan[i][0]], step->place[step->fan[i][1]]))
			return false;
	return true;
}

/* Without the call that floor is on old processors. */
static int32_t nearest_lattice(double x)
{
	int32_t i = (int32_t)(x + 0.5), most = PATCH_SIDE * LATTICE - INSIDE_MIN;
	i -= i > x + 0.5;
	return i < INSIDE_MIN ? INSIDE_MIN : i > most ? most : i;
}

static int prepare(struct step *step, struct places *places, const struct simplify *s, struct arena *arena)
{
	const struct halfedge_mesh *mesh = &s->mesh;
	uint32_t slots = 64;
	while (slots < 3 * mesh->nv)
		slots *= 2;
	*places = (struct places){ARENA_NEW(arena, uint64_t, slots), slots - 1};
	*step = (struct step){.place = ARENA_TAKE(arena, struct vec3, mesh->nv)};
	step->vertex = ARENA_TAKE(arena, uint32_t, mesh->nv);
	step->fan_end = ARENA_TAKE(arena, uint32_t, mesh->nv);
	step->fan = arena_take(arena, 3 * (size_t)mesh->nt, sizeof *step->fan);
	step->to = arena_take(arena, mesh->nv, sizeof *step->to);
	if (!places->slot || !step->place || !step->vertex || !step->fan_end || !step->fan || !step->to)
		return -ENOMEM;
	for (uint32_t v = 0; v < mesh->nv; v++) {
		step->place[v] = simplify_place(s, v);
		if (mesh->first[v] == HALFEDGE_NONE)
			continue;
		claim(places, mesh->position[v]);
		if (!s->fixed[v] && !s->border.faces[v])
			add_fan(step, mesh, v);
	}
	return 0;
}

int smooth_step(struct simplify *s, struct arena *arena)
{
	struct step step;
	struct places places;
	int r = prepare(&step, &places, s, arena);
	if (r)
		return r;
	double most = STEP_MAX * sqrt(s->tolerance_squared);
	for (uint32_t k = 0; k < step.n; k++) {
		struct vec3 target = target_of(&step, k, most);
		step.to[k][0] = nearest_lattice(target.x);
		step.to[k][1] = nearest_lattice(target.y);
		step.to[k][2] = nearest_lattice(target.z);
	}
	for (uint32_t k = 0; k < step.n; k++) {
		const int32_t *to = step.to[k];
		struct vec3 place = {to[0], to[1], to[2]};
		if (!shape_kept(&step, k, place) || !claim(&places, to))
			continue;
		step.place[step.vertex[k]] = place;
		memcpy(s->mesh.position[step.vertex[k]], to, sizeof step.to[k]);
	}
	return 0;
}

/* Marching cubes leaves ripples of a few hundredths of a cell; without them fewer triangles describe the same wall. Borders
 * and rims do not move. All targets come from the places before the step; they are then taken one vertex after the
 * other, each only if its triangles keep their shape and the lattice point is free: two vertices at one point would be
 * welded by whoever reads the mesh. Errors are measured from the raw places ever after. */
#include "core/smooth.h"

#include <errno.h>

#include "core/guard.h"
#include "core/predicates.h"

#define STEP_SHARE  0.7                 /* of the way to the mean */
#define STEP_MAX    0.48                /* of the tolerance: 0.12 cell where that is a quarter */
#define COSINE_TURN 0.70710678118654752 /* 45 degrees, per step of one corner */
#define INSIDE_MIN  2                   /* lattice units an inner vertex keeps from the faces of the patch */

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

static bool movable(const struct simplify *s, uint32_t v)
{
	return s->mesh.first[v] != HALFEDGE_NONE && !s->fixed[v] && !s->border.faces[v] &&
	       halfedge_border_from(&s->mesh, v) == HALFEDGE_NONE;
}

/* Where v would like to be. */
static struct vec3 target_of(const struct simplify *s, uint32_t v)
{
	const struct halfedge_mesh *mesh = &s->mesh;
	struct vec3 at = simplify_place(s, v), sum = {0, 0, 0}, normal = {0, 0, 0};
	uint32_t n = 0;
	HALFEDGE_EACH(mesh, h, v)
	{
		struct vec3 b = vec3_sub(simplify_place(s, halfedge_target(mesh, h)), at);
		struct vec3 c = vec3_sub(simplify_place(s, mesh->origin[halfedge_previous(h)]), at);
		sum = vec3_add(sum, b);
		normal = vec3_add(normal, vec3_cross(b, c));
		n++;
	}
	double length = vec3_norm(normal);
	if (length == 0)
		return at;
	double most = STEP_MAX * sqrt(s->tolerance_squared);
	double step = STEP_SHARE * vec3_dot(sum, normal) / (n * length);
	step = step > most ? most : step < -most ? -most : step;
	return vec3_add(at, vec3_scale(normal, step / length));
}

static bool shape_kept(const struct simplify *s, uint32_t v, const int32_t to[3])
{
	const struct halfedge_mesh *mesh = &s->mesh;
	HALFEDGE_EACH(mesh, h, v)
	{
		const int32_t *b = mesh->position[halfedge_target(mesh, h)];
		const int32_t *c = mesh->position[mesh->origin[halfedge_previous(h)]];
		if (!guard_turn(mesh->position[v], to, b, c, COSINE_TURN))
			return false;
	}
	return true;
}

static int32_t nearest_lattice(double x)
{
	int32_t i = (int32_t)floor(x + 0.5), most = PATCH_SIDE * LATTICE - INSIDE_MIN;
	return i < INSIDE_MIN ? INSIDE_MIN : i > most ? most : i;
}

int smooth_step(struct simplify *s, struct arena *arena)
{
	uint32_t nv = s->mesh.nv, slots = 64;
	while (slots < 3 * nv)
		slots *= 2;
	struct places places = {ARENA_NEW(arena, uint64_t, slots), slots - 1};
	struct vec3 *target = ARENA_NEW(arena, struct vec3, nv);
	if (!places.slot || !target)
		return -ENOMEM;
	for (uint32_t v = 0; v < nv; v++) {
		if (s->mesh.first[v] == HALFEDGE_NONE)
			continue;
		claim(&places, s->mesh.position[v]);
		if (movable(s, v))
			target[v] = target_of(s, v);
	}
	for (uint32_t v = 0; v < nv; v++) {
		if (!movable(s, v))
			continue;
		const int32_t to[3] = {nearest_lattice(target[v].x), nearest_lattice(target[v].y),
		                       nearest_lattice(target[v].z)};
		if (!shape_kept(s, v, to) || !claim(&places, to))
			continue;
		for (int axis = 0; axis < 3; axis++)
			s->mesh.position[v][axis] = to[axis];
	}
	return 0;
}

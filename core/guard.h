/* What every step of the reduction must respect, whatever it gains (internal to the reduction). */
#ifndef FACET_CORE_GUARD_H
#define FACET_CORE_GUARD_H

#include "core/halfedge.h"
#include "core/vec.h"

/* Whether moving the vertex of `ring` into u makes no edge within a patch face (but one to `allowed`, or HALFEDGE_NONE:
 * none) and no triangle within one. The neighbours of u must be marked. `faces` [nv]: the patch faces of a vertex, one bit
 * each. */
bool guard_patch_faces(const struct halfedge_mesh *mesh, const uint8_t *faces, const struct halfedge_ring *ring,
                       uint32_t u, uint32_t allowed);

/* Whether no triangle that stays turns by more than the angle of cosine `cosine` and none gets thin. */
bool guard_shape(const struct halfedge_mesh *mesh, const struct halfedge_ring *ring, uint32_t u, double cosine);

/* Whether the triangle v, b, c turns by less than the angle of cosine `cosine` and does not get thin when v goes to `to`. */
bool guard_turn(const int32_t v[3], const int32_t to[3], const int32_t b[3], const int32_t c[3], double cosine);

#define GUARD_ALTITUDE_MIN (0.01 * LATTICE) /* of a triangle, lattice units */

/* The same of its normals (as long as twice the area) and the square of its longest side afterwards. */
static inline bool guard_normals(struct vec3 before, struct vec3 after, double longest_squared, double cosine)
{
	double squared = vec3_dot(after, after), dot = vec3_dot(before, after);
	if (squared <= GUARD_ALTITUDE_MIN * GUARD_ALTITUDE_MIN * longest_squared)
		return false;
	double bound = cosine * cosine * vec3_dot(before, before) * squared;
	return cosine >= 0 ? dot > 0 && dot * dot > bound : dot >= 0 || dot * dot < bound;
}

#endif

/* What every step of the reduction must respect, whatever it gains (internal to the reduction). */
#ifndef FACET_CORE_GUARD_H
#define FACET_CORE_GUARD_H

#include "core/distance.h"
#include "core/halfedge.h"

/* Whether moving the vertex of `ring` into u makes no edge within a patch face (but one to `allowed`, or HALFEDGE_NONE:
 * none) and no triangle within one. The neighbours of u must be marked. `faces` [nv]: the patch faces of a vertex, one bit
 * each. */
bool guard_patch_faces(const struct halfedge_mesh *mesh, const uint8_t *faces, const struct halfedge_ring *ring,
                       uint32_t u, uint32_t allowed);

/* Whether no triangle that stays turns by more than the angle of cosine `cosine` and none gets thin. */
bool guard_shape(const struct halfedge_mesh *mesh, const struct halfedge_ring *ring, uint32_t u, double cosine);

/* Whether the triangle v, b, c turns by less than the angle of cosine `cosine` and does not get thin when v goes to `to`. */
bool guard_turn(const int32_t v[3], const int32_t to[3], const int32_t b[3], const int32_t c[3], double cosine);

#define GUARD_VALENCE_MAX 24 /* triangles at a vertex that others move into */

#define GUARD_ALTITUDE_MIN (0.01 * LATTICE) /* of a triangle, lattice units */

/* The same of the squared lengths of its normals (as long as twice the area) and their product, and of the square of its
 * longest side afterwards. */
static inline bool guard_lengths(double before, double after, double dot, double longest_squared, double cosine)
{
	double bound = cosine * cosine * before * after;
	bool turned = cosine >= 0 ? (dot > 0) & (dot * dot > bound) : (dot >= 0) | (dot * dot < bound);
	return turned & (after > GUARD_ALTITUDE_MIN * GUARD_ALTITUDE_MIN * longest_squared);
}

static inline bool guard_normals(struct vec3 before, struct vec3 after, double longest_squared, double cosine)
{
	return guard_lengths(vec3_dot(before, before), vec3_dot(after, after), vec3_dot(before, after), longest_squared,
	                     cosine);
}

/* The same of all triangles of a spanned fan, whose first corner comes from `v`. */
bool guard_fan(const struct fan *fan, struct vec3 v, double cosine);

#endif

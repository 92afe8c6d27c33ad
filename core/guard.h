/* What every step of the reduction must respect, whatever it gains (internal to the reduction). */
#ifndef FACET_CORE_GUARD_H
#define FACET_CORE_GUARD_H

#include "core/halfedge.h"

/* Whether moving v along h makes no edge within a patch face (but one to `allowed`, or HALFEDGE_NONE: none) and no
 * triangle within one. `faces` [nv]: the patch faces of a vertex, one bit each. */
bool guard_patch_faces(struct halfedge_mesh *mesh, const uint8_t *faces, uint32_t h, uint32_t v, uint32_t allowed);

/* Whether no triangle of v turns by more than the angle of cosine `cosine` and none gets thin. */
bool guard_shape(const struct halfedge_mesh *mesh, uint32_t h, uint32_t v, double cosine);

/* Whether the triangle v, b, c turns by less than the angle of cosine `cosine` and does not get thin when v goes to `to`. */
bool guard_turn(const int32_t v[3], const int32_t to[3], const int32_t b[3], const int32_t c[3], double cosine);

#endif

/* Outlines of a set of triangles of a mesh, with holes (thesis 4.3). */
#ifndef FACET_CORE_CONTOUR_H
#define FACET_CORE_CONTOUR_H

#include "core/halfedge.h"

/* Loops of vertices, the triangles to the left; a vertex where the set touches itself occurs more than once. */
struct contour {
	uint32_t *vertex, *loop_end; /* loop after loop; [loops] index behind the last vertex of each */
	uint32_t n, loops;
};

/* The outline of the `n` triangles in `triangle`, which are those whose `region` [mesh->nt] is `number`. 0 or -ENOMEM. */
int contour_find(const struct halfedge_mesh *mesh, const uint32_t *triangle, uint32_t n, const uint32_t *region,
                 uint32_t number, struct arena *arena, struct contour *ret);

#endif

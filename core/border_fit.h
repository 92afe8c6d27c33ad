/* Makes the border of a mesh what border_find decided (law L4), whatever it takes. */
#ifndef FACET_CORE_BORDER_FIT_H
#define FACET_CORE_BORDER_FIT_H

#include "core/border.h"
#include "core/halfedge.h"
#include "core/reduce.h"

/* Takes the vertices that are not kept out of the mesh's border. One that cannot be collapsed becomes an inner vertex, a
 * little inside, behind a new triangle (an ear): its border->kind and faces then say so. The mesh needs room for as
 * many triangles as the border has members. */
void border_fit(struct halfedge_mesh *mesh, struct border *border, struct reduce_stats *stats);

#endif

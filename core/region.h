/* Planar regions of a patch, and few triangles for each (thesis 4.2). */
#ifndef FACET_CORE_REGION_H
#define FACET_CORE_REGION_H

#include "core/reduce.h"
#include "core/simplify.h"

/* Finds the planar regions and numbers their triangles in s->plane, their planes in s->region; what lies within a region
 * goes (core/slab.h), its outline stays; where that cannot be it stays as it is. 0 or -ENOMEM. */
int region_flatten(struct simplify *s, struct arena *arena, struct reduce_stats *stats);

/* The plane through `n` points nearest to them in the mean square, and that mean square. */
struct region_plane region_fit(const struct vec3 *point, uint32_t n, double *ret_variance);

#endif

/* One bounded smoothing step, before regions and collapses. */
#ifndef FACET_CORE_SMOOTH_H
#define FACET_CORE_SMOOTH_H

#include "core/simplify.h"

/* Moves inner vertices along their normals towards the mean of their neighbours, at most half the tolerance, to lattice
 * points that no other vertex has. 0 or -ENOMEM. */
int smooth_step(struct simplify *s, struct arena *arena);

#endif

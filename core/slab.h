/* The triangles of a mesh that lie in a slab about a plane, none turned against it, made fewer (thesis 4.2). */
#ifndef FACET_CORE_SLAB_H
#define FACET_CORE_SLAB_H

#include "core/simplify.h"

struct slab {
	struct simplify *s;
	struct arena *arena;
	struct vec3 *place;      /* [nv] */
	uint32_t *region;        /* [cap_nt] number of the slab a triangle belongs to, or UINT32_MAX */
	uint32_t number;         /* of this one */
	uint32_t *taken, n;      /* its triangles, connected */
	uint32_t standing;       /* slab_thin leaves so many of them, the first */
	uint32_t *vertex, nv;    /* their corners */
	int32_t (*projected)[2]; /* [nv] corners as they lie in the plane; slab_thin makes them */
	bool *settled;           /* [3 nt] half-edges that Delaunay keeps */
	struct region_plane plane;
	int axis; /* the plane's dominant one, left out in the projection */
	bool mirrored;
};

/* Takes out what lies inside: the outline stays as it is, and some of the corners inside it, so that every one that goes lies
 * within the tolerance of a triangle, in whose list of points it then is. The triangles are Delaunay's as far as diagonals are
 * allowed, in slots of `taken`. 0; -EDOM where that cannot be, the mesh is then as before; -ENOMEM. */
int slab_thin(struct slab *);

#endif

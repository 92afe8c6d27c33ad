/* An outline edge is a half-edge of the set whose twin is not in it. The next one is found by turning about its target,
 * from triangle to triangle of the set, until an edge has no neighbour in the set. Where the set touches itself in a
 * vertex this stays in one fan, so that the loops never cross there. */
#include "core/contour.h"

#include <errno.h>

struct walker {
	const struct halfedge_mesh *mesh;
	const uint32_t *region;
	uint32_t number;
};

static bool on_outline(const struct walker *walker, uint32_t h)
{
	uint32_t twin = walker->mesh->twin[h];
	return twin == HALFEDGE_NONE || walker->region[twin / 3] != walker->number;
}

static uint32_t following(const struct walker *walker, uint32_t h)
{
	uint32_t e = halfedge_next(h);
	while (!on_outline(walker, e))
		e = halfedge_next(walker->mesh->twin[e]);
	return e;
}

int contour_find(const struct halfedge_mesh *mesh, const uint32_t *triangle, uint32_t n, const uint32_t *region,
                 uint32_t number, struct arena *arena, struct contour *ret)
{
	const struct walker walker = {mesh, region, number};
	struct contour contour = {0};
	contour.vertex = ARENA_TAKE(arena, uint32_t, 3 * (size_t)n);
	contour.loop_end = ARENA_TAKE(arena, uint32_t, (size_t)n + 1);
	bool *seen = ARENA_NEW(arena, bool, 3 * (size_t)mesh->nt);
	if (!contour.vertex || !contour.loop_end || !seen)
		return -ENOMEM;
	for (uint32_t k = 0; k < n; k++)
		for (uint32_t h = 3 * triangle[k]; h < 3 * triangle[k] + 3; h++) {
			if (seen[h] || !on_outline(&walker, h))
				continue;
			for (uint32_t e = h; !seen[e]; e = following(&walker, e)) {
				seen[e] = true;
				contour.vertex[contour.n++] = mesh->origin[e];
			}
			contour.loop_end[contour.loops++] = contour.n;
		}
	*ret = contour;
	return 0;
}

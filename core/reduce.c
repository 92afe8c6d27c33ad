/* One patch, reduced: the border first, since the neighbours must find it as they make it themselves; then the inside with
 * that border fixed. */
#include "core/reduce.h"

#include <assert.h>
#include <errno.h>

#include "core/border_fit.h"
#include "core/region.h"
#include "core/simplify.h"
#include "core/smooth.h"

/* What is left of the mesh, vertices and triangles in their old order. */
static int gather(const struct simplify *s, struct arena *arena, struct surface *ret)
{
	const struct halfedge_mesh *mesh = &s->mesh;
	struct surface surface = {0};
	uint32_t *index = ARENA_NEW(arena, uint32_t, mesh->nv);
	surface.vertex = arena_alloc(arena, mesh->nv, sizeof *surface.vertex);
	surface.triangle = arena_alloc(arena, mesh->nt, sizeof *surface.triangle);
	surface.plane = ARENA_NEW(arena, uint32_t, mesh->nt);
	if (!index || !surface.vertex || !surface.triangle || !surface.plane)
		return -ENOMEM;
	for (uint32_t v = 0; v < mesh->nv; v++) {
		if (mesh->first[v] == HALFEDGE_NONE)
			continue;
		index[v] = surface.nv;
		for (int axis = 0; axis < 3; axis++)
			surface.vertex[surface.nv][axis] = (uint16_t)mesh->position[v][axis];
		surface.nv++;
	}
	for (uint32_t t = 0; t < mesh->nt; t++) {
		if (!halfedge_alive(mesh, t))
			continue;
		for (int k = 0; k < 3; k++)
			surface.triangle[surface.nt][k] = index[mesh->origin[3 * t + k]];
		surface.plane[surface.nt++] = s->plane[t];
	}
	*ret = surface;
	return 0;
}

int reduce_border(const struct window *window, const struct surface *raw, const struct reduce_params *params,
                  struct arena *arena, struct border *ret)
{
	assert(params->tolerance >= 0 && params->tolerance <= 1);
	return border_find(window, raw, (int64_t)(params->tolerance * LATTICE), arena, ret);
}

int reduce_within(const struct border *border, const struct surface *raw, const struct reduce_params *params,
                  struct arena *arena, struct reduce_stats *stats, struct surface *ret)
{
	struct simplify s;
	int r = simplify_init(&s, raw, border, params->tolerance, arena);
	if (r)
		return r;
	border_fit(&s.mesh, &s.border, stats);
	simplify_settle(&s);
	r = smooth_step(&s, arena);
	if (!r)
		r = region_flatten(&s, arena, stats);
	if (!r)
		r = simplify_collapse(&s, arena);
	return r ? r : gather(&s, arena, ret);
}

int reduce_surface(const struct window *window, const struct surface *raw, const struct reduce_params *params,
                   struct arena *arena, struct reduce_stats *stats, struct surface *ret)
{
	assert(window && raw && params && arena && stats && ret);
	if (!raw->nt) {
		*ret = (struct surface){0};
		return 0;
	}
	struct border border;
	int r = reduce_border(window, raw, params, arena, &border);
	return r ? r : reduce_within(&border, raw, params, arena, stats, ret);
}

/* The planar reduction of one patch: borders by the rule of law L4, planar regions of few triangles,
 * bounded-error collapse for the rest (design 3 L4, L5; thesis chapter 4).
 *
 * A pure function of the window: both sides of a patch face see the same voxels, so both make the same border. */
#ifndef FACET_CORE_REDUCE_H
#define FACET_CORE_REDUCE_H

#include "core/arena.h"
#include "core/border.h"
#include "core/cubes.h"

struct reduce_params {
	double tolerance; /* cells: reduced and snapped mesh stay this close, both ways */
};

struct reduce_stats {
	uint64_t regions, regions_kept; /* planar regions, and those left as they were */
	uint64_t border_collapsed, border_relaxed, border_ears, border_merged; /* how border vertices went */
	double dropped_area;                                                   /* of specks, in square cells */
};

/* The two steps of reduce_surface, for surfaces with triangles: the second one reads nothing of the window. */
int reduce_border(const struct window *window, const struct surface *raw, const struct reduce_params *,
                  struct arena *arena, struct border *ret);
int reduce_within(const struct border *border, const struct surface *raw, const struct reduce_params *,
                  struct arena *arena, struct reduce_stats *stats, struct surface *ret);

/* `raw` is the surface of `window` (unchanged); all memory comes from `arena`. 0, or -ENOMEM. `stats` is added to. */
int reduce_surface(const struct window *window, const struct surface *raw, const struct reduce_params *,
                   struct arena *arena, struct reduce_stats *stats, struct surface *ret);

#endif

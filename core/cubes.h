/* Marching cubes on one patch (decision D6; thesis 3.2, lecture 004 E.5.3.6).
 *
 * gather  finds the cells with a surface among the published values of a patch, and fills unknown corners;
 * extract turns the cells [0, 16) into triangles on the lattice of 1/256 cell.
 * A vertex is named by (voxel, axis); its place depends on that voxel and its neighbour along the axis only. */
#ifndef FACET_CORE_CUBES_H
#define FACET_CORE_CUBES_H

#include "core/arena.h"
#include "core/digest.h"
#include "core/grid.h"

#define WINDOW_LOW    2                /* corners below the patch */
#define WINDOW_SIDE   (PATCH_SIDE + 5) /* corners -2 .. 18 */
#define WINDOW_ROWS   (WINDOW_SIDE * WINDOW_SIDE)
#define WINDOW_VOXELS (WINDOW_SIDE * WINDOW_SIDE * WINDOW_SIDE)

/* What the surface of a patch and its border are made of. A cell is complete when its 8 corners are known; it has a
 * surface when it is complete and its corners differ in sign. Rows: bit i + 2 of row (k + 2) * 21 + j + 2 is the corner,
 * or the cell, i, j, k in patch coordinates.
 *
 * Fill: an unknown corner of -1 .. 17 with known neighbours on two or more axes, all of one sign, takes the value of the
 * largest magnitude among them (from unfilled values only). */
struct window {
	struct patch_key key;
	bool empty;           /* no cell of the patch has a surface: nothing to extract, and the rest means nothing */
	struct digest digest; /* equal: the surface and the border are the same, see cubes.c */
	uint32_t active[WINDOW_ROWS]; /* cells with a surface: the patch's own, and those that share a face with it */
	uint32_t inside[WINDOW_ROWS]; /* of the corners of these cells: behind a surface */
	int16_t
	    value[WINDOW_VOXELS]; /* 1/256 cell; only where an edge crosses the surface, elsewhere it means nothing */
};

static inline int window_at(int i, int j, int k) /* patch coordinates, -2 .. 18 */
{
	return ((k + WINDOW_LOW) * WINDOW_SIDE + (j + WINDOW_LOW)) * WINDOW_SIDE + (i + WINDOW_LOW);
}

/* Inside (behind a surface) is negative; zero counts as outside. */
static inline bool corner_inside(int16_t value)
{
	return value < 0;
}

static inline int window_row(int j, int k)
{
	return (k + WINDOW_LOW) * WINDOW_SIDE + j + WINDOW_LOW;
}

/* A cell of the patch (0 .. 15), or one that shares a face with it (-1 or 16 in one coordinate). */
static inline bool window_active(const struct window *window, int i, int j, int k)
{
	return window->active[window_row(j, k)] >> (i + WINDOW_LOW) & 1;
}

#define PARAMETER_MIN 4 /* 1/64 of an edge */

/* Where the surface crosses the edge between two corners of different sign, in lattice units from the first. */
static inline int cubes_edge_parameter(int a, int b)
{
	uint32_t near = (uint32_t)(a < 0 ? -a : a), far = (uint32_t)(b < 0 ? -b : b), sum = near + far;
	int t = (int)((near * LATTICE + sum / 2) / sum);
	return t < PARAMETER_MIN ? PARAMETER_MIN : t > LATTICE - PARAMETER_MIN ? LATTICE - PARAMETER_MIN : t;
}

/* Name of a vertex in its patch: the lower corner (0..16 each) and the axis of the grid edge. */
static inline uint32_t vertex_name(int i, int j, int k, int axis)
{
	return (uint32_t)(((k * (PATCH_SIDE + 1) + j) * (PATCH_SIDE + 1) + i) * 3 + axis);
}

/* Triangles of a patch. Positions are lattice integers 0..4096 within the patch. Counter-clockwise seen from outside
 * (free space). All arrays live in the arena they were made in. */
struct surface {
	uint32_t nv, nt;
	uint16_t (*vertex)[3];
	uint32_t *name; /* [nv] vertex_name, raw meshes only; NULL after the reduction */
	uint32_t (*triangle)[3];
	uint32_t *plane; /* [nt] id of the planar region, local to the patch, or UINT32_MAX; NULL: none */
};

void cubes_gather(const struct grid *, struct patch_key, struct window *ret);

/* 0, or -ENOMEM. Vertices and triangles come in a canonical order (by cell, then by the table). */
int cubes_extract(const struct window *, struct arena *, struct surface *ret);

/* The table: triangles of a case as triples of cube edges, ended by -1 (cubes_table.c). Edge e of a cube: see there. */
extern const int8_t cubes_triangles[256][16];

#endif

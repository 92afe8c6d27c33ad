/* Every point of a raw triangle lies within 0.82 cell of one of its corners (the largest triangle a cell cuts out has
 * sides of 1.41), and a reduced surface within a quarter cell of that; so a place without any raw vertex within 0.95
 * cell is not on the surface. The tests of removed vertices cannot see this: they ask whether the old surface is near the
 * new one, not whether the new one is near the old. */
#include "core/nearby.h"

#include <errno.h>
#include <string.h>

#define SIDE  PATCH_SIDE
#define CELLS (SIDE * SIDE * SIDE)
#define STEP  (1.2 * LATTICE)

static int cell_of(double coordinate)
{
	int cell = (int)(coordinate / LATTICE); /* rounding up below zero ends at the same cell */
	return cell < 0 ? 0 : cell >= SIDE ? SIDE - 1 : cell;
}

int nearby_init(struct nearby *nearby, const struct surface *raw, struct arena *arena)
{
	*nearby = (struct nearby){ARENA_NEW(arena, uint32_t, CELLS), ARENA_NEW(arena, uint32_t, raw->nv),
	                          (const uint16_t(*)[3])raw->vertex};
	if (!nearby->first || !nearby->next)
		return -ENOMEM;
	memset(nearby->first, 0xff, CELLS * sizeof *nearby->first);
	for (uint32_t v = 0; v < raw->nv; v++) {
		const uint16_t *p = raw->vertex[v];
		int cell = (cell_of(p[2]) * SIDE + cell_of(p[1])) * SIDE + cell_of(p[0]);
		nearby->next[v] = nearby->first[cell];
		nearby->first[cell] = v;
	}
	return 0;
}

static bool in_cell(const struct nearby *nearby, int cell, struct vec3 p)
{
	for (uint32_t v = nearby->first[cell]; v != UINT32_MAX; v = nearby->next[v]) {
		const uint16_t *at = nearby->vertex[v];
		double x = at[0] - p.x, y = at[1] - p.y, z = at[2] - p.z;
		if (x * x + y * y + z * z <= NEARBY_REACH * NEARBY_REACH)
			return true;
	}
	return false;
}

/* The cells from `low` to `high`, both among the cells of the patch. */
static bool in_cells(const struct nearby *nearby, const int low[3], const int high[3], struct vec3 p)
{
	for (int z = low[2]; z <= high[2]; z++)
		for (int y = low[1]; y <= high[1]; y++)
			for (int x = low[0]; x <= high[0]; x++)
				if (in_cell(nearby, (z * SIDE + y) * SIDE + x, p))
					return true;
	return false;
}

/* A vertex on an edge of the cell of p is listed there or in a cell above it: these answer nearly always. */
bool nearby_has(const struct nearby *nearby, struct vec3 p)
{
	int at[3] = {cell_of(p.x), cell_of(p.y), cell_of(p.z)}, low[3], high[3];
	for (int axis = 0; axis < 3; axis++) {
		low[axis] = at[axis] ? at[axis] - 1 : 0;
		high[axis] = at[axis] < SIDE - 1 ? at[axis] + 1 : at[axis];
	}
	return in_cells(nearby, at, high, p) || in_cells(nearby, low, high, p);
}

bool nearby_has_segment(const struct nearby *nearby, struct vec3 a, struct vec3 b)
{
	struct vec3 along = vec3_sub(b, a);
	double squared = vec3_dot(along, along);
	if (squared <= 4 * NEARBY_REACH * NEARBY_REACH)
		return true;
	int steps = (int)(sqrt(squared) / STEP) + 1;
	for (int k = 1; k < steps; k++)
		if (!nearby_has(nearby, vec3_add(a, vec3_scale(along, (double)k / steps))))
			return false;
	return true;
}

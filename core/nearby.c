/* Every point of a raw triangle lies within 0.82 cell of one of its corners (the largest triangle a cell cuts out has
 * sides of 1.41), and a reduced surface within a quarter cell of that; so a place without any raw vertex within 0.95
 * cell is not on the surface. The tests of removed vertices cannot see this: they ask whether the old surface is near the
 * new one, not whether the new one is near the old. */
#include "core/nearby.h"

#include <errno.h>
#include <string.h>

#define SIDE       (PATCH_SIDE + 1) /* 4096 is a place, too */
#define CELLS      (SIDE * SIDE * SIDE)
#define SURE_REACH 241 /* of a point that was rounded towards zero */
#define STEP       (1.2 * LATTICE)

static uint32_t cell_of(double coordinate)
{
	int cell = (int)(coordinate / LATTICE); /* rounding up below zero ends at the same cell */
	return cell < 0 ? 0 : cell >= SIDE ? SIDE - 1 : (uint32_t)cell;
}

static uint32_t cell_at(uint32_t x, uint32_t y, uint32_t z)
{
	return (z * SIDE + y) * SIDE + x;
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
		uint32_t cell = cell_at(p[0] / LATTICE, p[1] / LATTICE, p[2] / LATTICE);
		nearby->next[v] = nearby->first[cell];
		nearby->first[cell] = v;
	}
	return 0;
}

static bool in_cell(const struct nearby *nearby, uint32_t cell, struct vec3 p)
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
static bool in_cells(const struct nearby *nearby, const uint32_t low[3], const uint32_t high[3], struct vec3 p)
{
	for (uint32_t z = low[2]; z <= high[2]; z++)
		for (uint32_t y = low[1]; y <= high[1]; y++)
			for (uint32_t x = low[0]; x <= high[0]; x++)
				if (in_cell(nearby, cell_at(x, y, z), p))
					return true;
	return false;
}

bool nearby_has(const struct nearby *nearby, struct vec3 p)
{
	uint32_t at[3] = {cell_of(p.x), cell_of(p.y), cell_of(p.z)}, low[3], high[3];
	for (int axis = 0; axis < 3; axis++) {
		low[axis] = at[axis] ? at[axis] - 1 : 0;
		high[axis] = at[axis] < SIDE - 1 ? at[axis] + 1 : at[axis];
	}
	return in_cells(nearby, low, high, p);
}

/* One vertex of a cell, or just any vertex: what is within reach is within reach. */
static unsigned first_reaches(const struct nearby *nearby, uint32_t cell, const uint32_t p[3])
{
	uint32_t v = nearby->first[cell];
	const uint16_t *at = nearby->vertex[v != UINT32_MAX ? v : 0];
	uint32_t x = at[0] - p[0], y = at[1] - p[1], z = at[2] - p[2]; /* below zero, too, their squares are right */
	return x * x + y * y + z * z <= SURE_REACH * SURE_REACH;
}

/* Raw vertices lie on the edges between cells. Where p is on the surface, one of the three nearest edges, one an axis,
 * nearly always has one, listed in the cell above it. True is sure, false is not; there is no branch to guess. */
static bool on_nearest_edges(const struct nearby *nearby, struct vec3 p)
{
	const uint32_t at[3] = {(uint32_t)(int)p.x, (uint32_t)(int)p.y, (uint32_t)(int)p.z};
	uint32_t x = at[0] / LATTICE, y = at[1] / LATTICE, z = at[2] / LATTICE;
	uint32_t i = (at[0] + LATTICE / 2) / LATTICE, j = (at[1] + LATTICE / 2) / LATTICE;
	uint32_t k = (at[2] + LATTICE / 2) / LATTICE;
	return (first_reaches(nearby, cell_at(x, j, k), at) | first_reaches(nearby, cell_at(i, y, k), at) |
	        first_reaches(nearby, cell_at(i, j, z), at)) != 0;
}

int nearby_parts(double length_squared)
{
	int parts = (int)(sqrt(length_squared) / STEP) + 1;
	return length_squared <= 4 * NEARBY_REACH * NEARBY_REACH ? 1 : parts;
}

bool nearby_has_segment(const struct nearby *nearby, struct vec3 a, struct vec3 along, int parts)
{
	bool all = true;
	for (int k = 1; k < parts; k++)
		all &= on_nearest_edges(nearby, vec3_add(a, vec3_scale(along, (double)k / parts)));
	for (int k = 1; k < parts && !all; k++)
		if (!nearby_has(nearby, vec3_add(a, vec3_scale(along, (double)k / parts))))
			return false;
	return true;
}

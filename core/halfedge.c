/* The half-edge mesh. Invariants, all asserted by halfedge_check:
 *
 *   - a triangle is whole or removed; its three corners differ;
 *   - each half-edge of a whole triangle is in the list of its origin exactly once, no other is in a list;
 *   - no two half-edges have the same origin and target;
 *   - twins point at each other and run in opposite directions;
 *   - a half-edge without a twin has no opposite half-edge anywhere.
 *
 * So an edge never has more than two faces. A vertex may have several fans; the list holds all of them. */
#include "core/halfedge.h"

#include <assert.h>
#include <errno.h>
#include <string.h>

static void unlist(struct halfedge_mesh *mesh, uint32_t h)
{
	uint32_t *at = &mesh->first[mesh->origin[h]];
	while (*at != h)
		at = &mesh->next_leaving[*at];
	*at = mesh->next_leaving[h];
}

static void enlist(struct halfedge_mesh *mesh, uint32_t h)
{
	uint32_t v = mesh->origin[h];
	mesh->next_leaving[h] = mesh->first[v];
	mesh->first[v] = h;
}

static void join(struct halfedge_mesh *mesh, uint32_t g, uint32_t h)
{
	if (g != HALFEDGE_NONE)
		mesh->twin[g] = h;
	if (h != HALFEDGE_NONE)
		mesh->twin[h] = g;
}

uint32_t halfedge_find(const struct halfedge_mesh *mesh, uint32_t a, uint32_t b)
{
	HALFEDGE_EACH(mesh, h, a)
	{
		if (halfedge_target(mesh, h) == b)
			return h;
	}
	return HALFEDGE_NONE;
}

bool halfedge_joined(const struct halfedge_mesh *mesh, uint32_t a, uint32_t b)
{
	HALFEDGE_EACH(mesh, h, a)
	{
		if (halfedge_target(mesh, h) == b || mesh->origin[halfedge_previous(h)] == b)
			return true;
	}
	return false;
}

uint32_t halfedge_border_from(const struct halfedge_mesh *mesh, uint32_t v)
{
	HALFEDGE_EACH(mesh, h, v)
	{
		if (mesh->twin[h] == HALFEDGE_NONE)
			return h;
	}
	return HALFEDGE_NONE;
}

uint32_t halfedge_border_into(const struct halfedge_mesh *mesh, uint32_t v)
{
	HALFEDGE_EACH(mesh, h, v)
	{
		if (mesh->twin[halfedge_previous(h)] == HALFEDGE_NONE)
			return halfedge_previous(h);
	}
	return HALFEDGE_NONE;
}

uint32_t halfedge_valence(const struct halfedge_mesh *mesh, uint32_t v)
{
	uint32_t n = 0;
	HALFEDGE_EACH(mesh, h, v)
	n++;
	return n;
}

void halfedge_add(struct halfedge_mesh *mesh, uint32_t slot, uint32_t a, uint32_t b, uint32_t c)
{
	assert(slot <= mesh->nt && slot < mesh->cap_nt);
	if (slot == mesh->nt)
		mesh->nt++;
	uint32_t corner[3] = {a, b, c};
	for (uint32_t k = 0; k < 3; k++) {
		mesh->origin[3 * slot + k] = corner[k];
		enlist(mesh, 3 * slot + k);
	}
	for (uint32_t k = 0; k < 3; k++)
		join(mesh, 3 * slot + k, halfedge_find(mesh, corner[(k + 1) % 3], corner[k]));
}

void halfedge_remove(struct halfedge_mesh *mesh, uint32_t triangle)
{
	for (uint32_t h = 3 * triangle; h < 3 * triangle + 3; h++) {
		if (mesh->twin[h] != HALFEDGE_NONE)
			mesh->twin[mesh->twin[h]] = HALFEDGE_NONE;
		unlist(mesh, h);
	}
	for (uint32_t h = 3 * triangle; h < 3 * triangle + 3; h++)
		mesh->origin[h] = mesh->twin[h] = HALFEDGE_NONE;
}

void halfedge_flip(struct halfedge_mesh *mesh, uint32_t h)
{
	uint32_t g = mesh->twin[h], h_next = halfedge_next(h), h_last = halfedge_previous(h);
	assert(g != HALFEDGE_NONE);
	uint32_t g_next = halfedge_next(g), g_last = halfedge_previous(g), first = h - h % 3, second = g - g % 3;
	uint32_t tip = mesh->origin[h_last], far = mesh->origin[g_last];
	const uint32_t was[6] = {h, h_next, h_last, g, g_next, g_last};
	const uint32_t is[6] = {first, first + 1, first + 2, second, second + 1, second + 2};
	const uint32_t corner[6] = {tip, mesh->origin[h], far, far, mesh->origin[g], tip};
	const uint32_t twin[6] = {mesh->twin[h_last], mesh->twin[g_next], second + 2,
	                          mesh->twin[g_last], mesh->twin[h_next], first + 2};
	for (int k = 0; k < 6; k++)
		unlist(mesh, was[k]);
	for (int k = 0; k < 6; k++) {
		mesh->origin[is[k]] = corner[k];
		enlist(mesh, is[k]);
		join(mesh, is[k], twin[k]);
	}
}

static int reserve(const struct surface *surface, uint32_t spare, struct arena *arena, struct halfedge_mesh *ret)
{
	uint32_t cap_nt = surface->nt + spare;
	*ret = (struct halfedge_mesh){.nv = surface->nv, .cap_nt = cap_nt};
	ret->position = arena_take(arena, surface->nv, sizeof *ret->position);
	ret->first = ARENA_TAKE(arena, uint32_t, surface->nv);
	ret->mark = ARENA_NEW(arena, uint32_t, surface->nv);
	ret->origin = ARENA_TAKE(arena, uint32_t, 3 * (size_t)cap_nt);
	ret->twin = ARENA_TAKE(arena, uint32_t, 3 * (size_t)cap_nt);
	ret->next_leaving = ARENA_TAKE(arena, uint32_t, 3 * (size_t)cap_nt);
	return ret->position && ret->first && ret->mark && ret->origin && ret->twin && ret->next_leaving ? 0 : -ENOMEM;
}

/* Edges while a mesh is built: under the lower end of each the half-edge that brought it. */
struct edges {
	uint32_t *first; /* [nv] half-edge */
	uint32_t *chain; /* [3 nt] next one with the same lower end */
	uint32_t *upper; /* [3 nt] */
};

static int edges_make(const struct surface *surface, struct arena *arena, struct edges *ret)
{
	ret->first = ARENA_TAKE(arena, uint32_t, surface->nv);
	ret->chain = ARENA_TAKE(arena, uint32_t, 3 * (size_t)surface->nt);
	ret->upper = ARENA_TAKE(arena, uint32_t, 3 * (size_t)surface->nt);
	if (!ret->first || !ret->chain || !ret->upper)
		return -ENOMEM;
	memset(ret->first, 0xff, surface->nv * sizeof *ret->first);
	return 0;
}

/* Pairs h, which runs from a to b, with its twin if that came before. */
static int pair(struct halfedge_mesh *mesh, struct edges *edges, uint32_t h, uint32_t a, uint32_t b)
{
	uint32_t lower = a < b ? a : b, upper = a < b ? b : a, e = edges->first[lower];
	while (e != HALFEDGE_NONE && edges->upper[e] != upper)
		e = edges->chain[e];
	if (e != HALFEDGE_NONE && (mesh->origin[e] == a || mesh->twin[e] != HALFEDGE_NONE))
		return -EINVAL;
	join(mesh, h, e);
	if (e == HALFEDGE_NONE) {
		edges->upper[h] = upper;
		edges->chain[h] = edges->first[lower];
		edges->first[lower] = h;
	}
	return 0;
}

int halfedge_build(const struct surface *surface, uint32_t spare, struct arena *arena, struct halfedge_mesh *ret)
{
	struct halfedge_mesh mesh;
	struct edges edges;
	int r = reserve(surface, spare, arena, &mesh);
	if (!r)
		r = edges_make(surface, arena, &edges);
	if (r)
		return r;
	for (uint32_t v = 0; v < mesh.nv; v++) {
		mesh.first[v] = HALFEDGE_NONE;
		for (int axis = 0; axis < 3; axis++)
			mesh.position[v][axis] = surface->vertex[v][axis];
	}
	mesh.nt = surface->nt;
	for (uint32_t t = 0; t < surface->nt; t++) {
		const uint32_t *corner = surface->triangle[t];
		for (uint32_t k = 0; k < 3; k++) {
			uint32_t a = corner[k], b = corner[k == 2 ? 0 : k + 1];
			if (a == b || a >= mesh.nv || b >= mesh.nv)
				return -EINVAL;
			mesh.origin[3 * t + k] = a;
			enlist(&mesh, 3 * t + k);
			if (pair(&mesh, &edges, 3 * t + k, a, b))
				return -EINVAL;
		}
	}
	*ret = mesh;
	return 0;
}

uint32_t halfedge_mark_ring(struct halfedge_mesh *mesh, uint32_t v)
{
	uint32_t n = 0, stamp = ++mesh->stamp;
	HALFEDGE_EACH(mesh, h, v)
	{
		mesh->mark[halfedge_target(mesh, h)] = stamp;
		mesh->mark[mesh->origin[halfedge_previous(h)]] = stamp;
		n++;
	}
	return n;
}

bool halfedge_gather(const struct halfedge_mesh *mesh, uint32_t v, struct halfedge_ring *ret)
{
	uint32_t n = 0;
	ret->v = v;
	ret->tail = HALFEDGE_NONE;
	HALFEDGE_EACH(mesh, h, v)
	{
		if (n == HALFEDGE_RING_MAX)
			return false;
		uint32_t previous = halfedge_previous(h);
		ret->h[n] = h;
		ret->x[n] = halfedge_target(mesh, h);
		ret->y[n] = mesh->origin[previous];
		if (mesh->twin[previous] == HALFEDGE_NONE)
			ret->tail = ret->y[n];
		n++;
	}
	ret->n = n;
	return true;
}

/* Marked neighbours. */
static uint32_t count_marked(const struct halfedge_mesh *mesh, const struct halfedge_ring *ring)
{
	uint32_t n = ring->tail != HALFEDGE_NONE && halfedge_marked(mesh, ring->tail);
	for (uint32_t k = 0; k < ring->n; k++)
		n += halfedge_marked(mesh, ring->x[k]);
	return n;
}

/* The triangle of h would go; its two other edges become one, which must not be left without any face. */
static bool leaves_neighbour(const struct halfedge_mesh *mesh, uint32_t h)
{
	return mesh->twin[halfedge_next(h)] != HALFEDGE_NONE || mesh->twin[halfedge_previous(h)] != HALFEDGE_NONE;
}

bool halfedge_may_collapse(const struct halfedge_mesh *mesh, const struct halfedge_ring *ring, uint32_t h)
{
	uint32_t u = halfedge_other(mesh, h, ring->v), g = mesh->twin[h];
	bool border = ring->tail != HALFEDGE_NONE;
	if (border && g != HALFEDGE_NONE)
		return false;
	if (count_marked(mesh, ring) != (g == HALFEDGE_NONE ? 1u : 2u))
		return false;
	if (!leaves_neighbour(mesh, h) || (g != HALFEDGE_NONE && !leaves_neighbour(mesh, g)))
		return false;
	if (border || ring->n != 3)
		return true;
	/* The three triangles become one, which must not be there already. */
	uint32_t x = mesh->origin[halfedge_previous(h)], y = mesh->origin[halfedge_previous(g)];
	uint32_t e = halfedge_find(mesh, u, x), f = halfedge_find(mesh, x, u);
	return (e == HALFEDGE_NONE || mesh->origin[halfedge_previous(e)] != y) &&
	       (f == HALFEDGE_NONE || mesh->origin[halfedge_previous(f)] != y);
}

/* The triangle of h goes; its half-edge that leaves v stays in the list of v, which is about to go itself. */
static void drop(struct halfedge_mesh *mesh, uint32_t h, uint32_t v)
{
	uint32_t edge[3] = {h, halfedge_next(h), halfedge_previous(h)};
	join(mesh, mesh->twin[edge[1]], mesh->twin[edge[2]]);
	for (int k = 0; k < 3; k++) {
		if (mesh->origin[edge[k]] != v)
			unlist(mesh, edge[k]);
		mesh->origin[edge[k]] = mesh->twin[edge[k]] = HALFEDGE_NONE;
	}
}

void halfedge_collapse(struct halfedge_mesh *mesh, uint32_t h, uint32_t v)
{
	uint32_t u = halfedge_other(mesh, h, v), g = mesh->twin[h];
	drop(mesh, h, v);
	if (g != HALFEDGE_NONE)
		drop(mesh, g, v);
	for (uint32_t e = mesh->first[v], next; e != HALFEDGE_NONE; e = next) {
		next = mesh->next_leaving[e];
		if (mesh->origin[e] == HALFEDGE_NONE)
			continue;
		mesh->origin[e] = u;
		enlist(mesh, e);
	}
	mesh->first[v] = HALFEDGE_NONE;
}

static const char *check_triangle(const struct halfedge_mesh *mesh, uint32_t t)
{
	for (uint32_t h = 3 * t; h < 3 * t + 3; h++) {
		uint32_t a = mesh->origin[h], b = halfedge_target(mesh, h), listed = 0;
		if (a >= mesh->nv || b >= mesh->nv || a == b)
			return "a corner is out of range or repeated";
		HALFEDGE_EACH(mesh, e, a)
		{
			listed += e == h;
			if (e != h && halfedge_target(mesh, e) == b)
				return "two half-edges run the same way";
		}
		if (listed != 1)
			return "a half-edge is not once in the list of its origin";
		uint32_t g = mesh->twin[h];
		if (g != halfedge_find(mesh, b, a))
			return "a twin is not the opposite half-edge";
		if (g != HALFEDGE_NONE && mesh->twin[g] != h)
			return "twins do not point at each other";
	}
	return NULL;
}

const char *halfedge_check(const struct halfedge_mesh *mesh)
{
	uint32_t listed = 0, whole = 0;
	for (uint32_t t = 0; t < mesh->nt; t++) {
		if (!halfedge_alive(mesh, t))
			continue;
		const char *wrong = check_triangle(mesh, t);
		if (wrong)
			return wrong;
		whole++;
	}
	for (uint32_t v = 0; v < mesh->nv; v++)
		HALFEDGE_EACH(mesh, h, v)
		{
			if (mesh->origin[h] != v || listed > 3 * whole)
				return "a list holds a half-edge of another vertex";
			listed++;
		}
	return listed == 3 * whole ? NULL : "a list holds a half-edge of a removed triangle";
}

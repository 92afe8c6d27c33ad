/* Triangles of several patches, welded by lattice point and judged: every directed edge at most once (so that an edge
 * has at most two faces, which agree in their orientation), no face without area, and at a point one fan of faces. */
#ifndef FACET_TESTS_SOUP_H
#define FACET_TESTS_SOUP_H

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "core/grid.h"

struct soup_point {
	int64_t at[3]; /* of the whole map's lattice */
};

struct soup {
	struct soup_point *point;
	uint32_t (*triangle)[3];
	uint32_t nv, nt, nv_cap, nt_cap;
};

struct soup_faults {
	uint32_t repeated_edges; /* directed edges met more than once */
	uint32_t open_edges;     /* without their reverse */
	uint32_t flat;           /* faces without area */
	uint32_t split_points;   /* with more than one fan, or an open one */
};

struct soup_edge {
	uint32_t from, to, apex;
	uint32_t used;
};

static inline void soup_add(struct soup *soup, struct patch_key key, uint32_t nv, const uint16_t (*vertex)[3],
                            uint32_t nt, const uint32_t (*triangle)[3])
{
	const int64_t origin[3] = {key.x, key.y, key.z};
	while (soup->nv + nv > soup->nv_cap)
		soup->point = realloc(soup->point, (soup->nv_cap = soup->nv_cap * 2 + 64) * sizeof *soup->point);
	while (soup->nt + nt > soup->nt_cap)
		soup->triangle =
		    realloc(soup->triangle, (soup->nt_cap = soup->nt_cap * 2 + 64) * sizeof *soup->triangle);
	for (uint32_t v = 0; v < nv; v++)
		for (int a = 0; a < 3; a++)
			soup->point[soup->nv + v].at[a] = origin[a] * PATCH_SIDE * LATTICE + vertex[v][a];
	for (uint32_t t = 0; t < nt; t++)
		for (int c = 0; c < 3; c++)
			soup->triangle[soup->nt + t][c] = soup->nv + triangle[t][c];
	soup->nv += nv;
	soup->nt += nt;
}

static inline void soup_finish(struct soup *soup)
{
	free(soup->point);
	free(soup->triangle);
	*soup = (struct soup){0};
}

static inline uint64_t soup_mix(uint64_t x)
{
	x = (x ^ x >> 31) * 0x9e3779b97f4a7c15ull;
	return x ^ x >> 29;
}

/* Gives equal points one number. */
static inline void soup_weld(struct soup *soup)
{
	size_t slots = 64;
	while (slots < (size_t)soup->nv * 2)
		slots *= 2;
	uint32_t *slot = calloc(slots, sizeof *slot), *number = calloc(soup->nv + 1, sizeof *number), n = 0;
	for (uint32_t v = 0; v < soup->nv; v++) {
		struct soup_point p = soup->point[v];
		size_t at = soup_mix(soup_mix(soup_mix((uint64_t)p.at[0]) + (uint64_t)p.at[1]) + (uint64_t)p.at[2]) &
		            (slots - 1);
		while (slot[at] && memcmp(&soup->point[slot[at] - 1], &p, sizeof p))
			at = (at + 1) & (slots - 1);
		if (!slot[at]) {
			soup->point[n] = p;
			slot[at] = ++n;
		}
		number[v] = slot[at] - 1;
	}
	for (uint32_t t = 0; t < soup->nt; t++)
		for (int c = 0; c < 3; c++)
			soup->triangle[t][c] = number[soup->triangle[t][c]];
	soup->nv = n;
	free(slot);
	free(number);
}

static inline struct soup_edge *soup_edge(struct soup_edge *edges, size_t slots, uint32_t from, uint32_t to)
{
	size_t at = soup_mix((uint64_t)from << 32 | to) & (slots - 1);
	while (edges[at].used && (edges[at].from != from || edges[at].to != to))
		at = (at + 1) & (slots - 1);
	return &edges[at];
}

static inline bool soup_flat(const struct soup *soup, const uint32_t t[3])
{
	int64_t u[3], v[3];
	for (int a = 0; a < 3; a++) {
		u[a] = soup->point[t[1]].at[a] - soup->point[t[0]].at[a];
		v[a] = soup->point[t[2]].at[a] - soup->point[t[0]].at[a];
	}
	return u[1] * v[2] == u[2] * v[1] && u[2] * v[0] == u[0] * v[2] && u[0] * v[1] == u[1] * v[0];
}

/* Faces met by walking around `v` from its neighbour `first`; 0 where the fan is open. */
static inline uint32_t soup_fan(struct soup_edge *edges, size_t slots, uint32_t v, uint32_t first)
{
	uint32_t n = 0, at = first;
	do {
		const struct soup_edge *edge = soup_edge(edges, slots, v, at);
		if (!edge->used || n > 1000)
			return 0;
		at = edge->apex;
		n++;
	} while (at != first);
	return n;
}

/* Welds and judges. */
static inline struct soup_faults soup_judge(struct soup *soup)
{
	struct soup_faults faults = {0};
	size_t slots = 64;
	soup_weld(soup);
	while (slots < (size_t)soup->nt * 6)
		slots *= 2;
	struct soup_edge *edges = calloc(slots, sizeof *edges);
	uint32_t *valence = calloc(soup->nv + 1, sizeof *valence), *start = calloc(soup->nv + 1, sizeof *start);
	for (uint32_t t = 0; t < soup->nt; t++) {
		const uint32_t *v = soup->triangle[t];
		faults.flat += soup_flat(soup, v);
		for (int c = 0; c < 3; c++) {
			struct soup_edge *edge = soup_edge(edges, slots, v[c], v[(c + 1) % 3]);
			faults.repeated_edges += edge->used;
			*edge = (struct soup_edge){v[c], v[(c + 1) % 3], v[(c + 2) % 3], 1};
			valence[v[c]]++;
			start[v[c]] = v[(c + 1) % 3];
		}
	}
	for (size_t i = 0; i < slots; i++)
		faults.open_edges += edges[i].used && !soup_edge(edges, slots, edges[i].to, edges[i].from)->used;
	for (uint32_t v = 0; v < soup->nv; v++)
		faults.split_points += valence[v] && soup_fan(edges, slots, v, start[v]) != valence[v];
	free(edges);
	free(valence);
	free(start);
	return faults;
}

#endif

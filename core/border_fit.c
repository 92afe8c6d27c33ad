/* From the raw border to the simplified one, by a ladder: each border vertex that is to go is
 *
 *   1. moved into the previous or the next one of its chain, triangles turning by less than 78 degrees;
 *   2. the same with 100 degrees;
 *   3. made an inner vertex: drawn 0.06 cell into the patch, with the triangle (previous, vertex, next) before it.
 *
 * The third always works unless previous and next are joined already, and the border rule excludes that: an edge
 * between two points of one face exists only as a segment or a step of that face, steps touch nothing, and the chains
 * of two faces that end at the same two points keep a point in between. So both neighbours end with exactly the
 * simplified polyline; what could not be done is counted as border_merged, and the tests demand that it is zero.
 *
 * Every second vertex of a chain is taken per round, so that the triangles along the border grow evenly. */
#include "core/border_fit.h"

#include <assert.h>

#include "core/guard.h"
#include "core/predicates.h"

#define COSINE_STRICT  0.20791169081775934  /* 78 degrees */
#define COSINE_RELAXED -0.17364817766693033 /* 100 degrees */
#define VALENCE_MAX    64
#define EAR_DEPTH      15 /* lattice units */

struct fit {
	struct halfedge_mesh *mesh;
	struct border *border;
	struct reduce_stats *stats;
	const struct border_chain *chain;
};

/* The half-edge of the border between v and u, whichever way it runs. */
static uint32_t border_edge(const struct halfedge_mesh *mesh, uint32_t v, uint32_t u)
{
	uint32_t h = halfedge_find(mesh, v, u);
	return h != HALFEDGE_NONE ? h : halfedge_find(mesh, u, v);
}

static bool collapse_to(struct fit *fit, uint32_t v, uint32_t u, uint32_t other, double cosine)
{
	struct halfedge_mesh *mesh = fit->mesh;
	uint32_t h = border_edge(mesh, v, u);
	assert(h != HALFEDGE_NONE && mesh->twin[h] == HALFEDGE_NONE);
	struct halfedge_ring ring;
	if (!halfedge_gather(mesh, v, &ring) || ring.n + halfedge_mark_ring(mesh, u) > VALENCE_MAX ||
	    !halfedge_may_collapse(mesh, &ring, h) || !guard_patch_faces(mesh, fit->border->faces, &ring, u, other) ||
	    !guard_shape(mesh, &ring, u, cosine))
		return false;
	halfedge_collapse(mesh, h, v);
	return true;
}

/* Into the nearer of its two neighbours, or else into the other. */
static bool collapse(struct fit *fit, uint32_t before, uint32_t v, uint32_t after, double cosine)
{
	int32_t(*at)[3] = fit->mesh->position;
	bool back = distance_squared3(at[before], at[v]) <= distance_squared3(at[after], at[v]);
	uint32_t near = back ? before : after, far = back ? after : before;
	return collapse_to(fit, v, near, far, cosine) || collapse_to(fit, v, far, near, cosine);
}

/* Whether the triangles of v all have an area when it lies at `place`. */
static bool sound_at(const struct halfedge_mesh *mesh, uint32_t v, const int32_t place[3])
{
	HALFEDGE_EACH(mesh, h, v)
	{
		int64_t normal[3];
		triangle_normal(place, mesh->position[halfedge_target(mesh, h)],
		                mesh->position[mesh->origin[halfedge_previous(h)]], normal);
		if (!normal[0] && !normal[1] && !normal[2])
			return false;
	}
	return true;
}

static bool cut_ear(struct fit *fit, uint32_t before, uint32_t v, uint32_t after)
{
	struct halfedge_mesh *mesh = fit->mesh;
	if (halfedge_joined(mesh, before, after))
		return false;
	int axis = fit->chain->axis;
	for (int32_t depth = EAR_DEPTH; depth < 2 * EAR_DEPTH; depth++) {
		int32_t place[3] = {mesh->position[v][0], mesh->position[v][1], mesh->position[v][2]};
		place[axis] += fit->chain->high ? -depth : depth;
		if (!sound_at(mesh, v, place))
			continue;
		mesh->position[v][axis] = place[axis];
		bool forward = halfedge_find(mesh, before, v) != HALFEDGE_NONE;
		halfedge_add(mesh, mesh->nt, forward ? before : after, forward ? after : before, v);
		fit->border->kind[v] = BORDER_INSIDE;
		fit->border->faces[v] = 0;
		return true;
	}
	return false;
}

static bool take_out(struct fit *fit, int rung, uint32_t before, uint32_t v, uint32_t after)
{
	uint64_t *count[3] = {&fit->stats->border_collapsed, &fit->stats->border_relaxed, &fit->stats->border_ears};
	bool done = rung == 2 ? cut_ear(fit, before, v, after)
	                      : collapse(fit, before, v, after, rung ? COSINE_RELAXED : COSINE_STRICT);
	*count[rung] += done;
	return done;
}

/* Members of the chain still in the border. */
struct rest {
	uint32_t *member; /* index of border->member */
	uint32_t n;
};

/* One round over a chain: of the members that are to go, no two neighbours. How many went. */
static uint32_t round_over(struct fit *fit, struct rest *rest, int rung)
{
	const struct border *border = fit->border;
	uint32_t gone = 0, n = 0, last = rest->n - 1;
	bool skip = false;
	for (uint32_t k = 0; k < rest->n; k++) {
		uint32_t m = rest->member[k];
		if (!border->kept[m] && !skip) {
			/* The start of a chain is kept, and so is the end of an open one. */
			uint32_t next = rest->member[k == last ? 0 : k + 1];
			if (take_out(fit, rung, border->member[rest->member[n - 1]], border->member[m],
			             border->member[next])) {
				gone++;
				skip = true;
				continue;
			}
		}
		skip = false;
		rest->member[n++] = m;
	}
	rest->n = n;
	return gone;
}

void border_fit(struct halfedge_mesh *mesh, struct border *border, struct reduce_stats *stats)
{
	struct fit fit = {mesh, border, stats, NULL};
	uint32_t member[2 * PATCH_SIDE * PATCH_SIDE + 1];
	for (uint32_t c = 0; c < border->chains; c++) {
		struct rest rest = {member, border->chain[c].n};
		fit.chain = &border->chain[c];
		uint32_t left = 0;
		for (uint32_t k = 0; k < rest.n; k++) {
			member[k] = fit.chain->first + k;
			left += !border->kept[member[k]];
		}
		for (int rung = 0; rung < 3 && left; rung++)
			for (uint32_t gone = 1; gone && left; left -= gone)
				gone = round_over(&fit, &rest, rung);
		stats->border_merged += left;
	}
}

/* The border of a patch (law L4): what its surface looks like on the six faces of the patch, and which of these points
 * stay. A pure function of the window that both neighbours of a face evaluate alike. */
#ifndef FACET_CORE_BORDER_H
#define FACET_CORE_BORDER_H

#include "core/arena.h"
#include "core/cubes.h"

enum border_kind {
	BORDER_INSIDE, /* on no face of the patch */
	BORDER_FREE,   /* on a face, but only this patch has it: a plain open rim */
	BORDER_CHAIN,  /* between two shared segments: border_chain says whether it stays */
	BORDER_PINNED  /* stays: on an edge of the patch, at the end of a chain, or on a rim of the neighbour */
};

/* A polyline of shared segments on one face, in canonical order. */
struct border_chain {
	uint32_t first, n; /* of border.member; a closed one does not repeat its start */
	bool closed;
	uint8_t axis, high; /* the face: axis 0..2, high 1 at 4096 */
};

struct border {
	uint8_t *kind;  /* [nv] enum border_kind */
	uint8_t *faces; /* [nv] bit 2 axis + high: the faces a vertex lies on */
	struct border_chain *chain;
	uint32_t chains, members;
	uint32_t *member; /* vertex */
	bool *kept;       /* per member; the rest is to go */
};

/* `raw` is the surface of `window`, with names. `tolerance` is in lattice units. 0 or -ENOMEM. */
int border_find(const struct window *window, const struct surface *raw, int64_t tolerance, struct arena *arena,
                struct border *ret);

#endif

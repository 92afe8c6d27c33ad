/* What the last meshes were made of, so that a patch that would come out as before is not made again.
 *
 * Most of a row's dirty patches read a changed voxel without drawing other triangles. Two digests tell: that of the window
 * (cubes.c), known before anything is extracted, and one of the raw mesh and its border, all that the reduction reads; the
 * second finds what the first, which is one of values, takes for changed. So a remembered patch is what would be made
 * again: the mesh stays a pure function of the voxels (law L2). A key has one slot of MEMO_SLOTS; patches beyond
 * MEMO_BYTES_MAX are not kept: at most 16 MB, 2 MB in a hall. */
#ifndef FACET_CORE_MEMO_H
#define FACET_CORE_MEMO_H

#include "core/border.h"
#include "core/patch.h"

#define MEMO_SLOTS     4096
#define MEMO_BYTES_MAX 4096

struct memo_source {
	struct digest window, surface;
	uint32_t faces_raw;
};

struct memo {
	uint64_t batch;
	struct memo_slot {
		struct patch_key key;
		uint64_t batch; /* of the dirty set that took the slot last, 0: nobody */
		struct memo_source source;
		struct patch *patch; /* or NULL */
	} slot[MEMO_SLOTS];
};

struct digest memo_digest(const struct surface *raw, const struct border *border);

/* Gives the keys of a dirty set their slots; a slot two of them want goes to the first. Only this changes whose slot is
 * whose, so that threads may then ask and keep for different keys. */
void memo_expect(struct memo *, const struct patch_key *keys, size_t n);

/* The patch made of the same window before, borrowed until the next memo_keep of the key; or NULL. */
const struct patch *memo_recall(const struct memo *, struct patch_key, struct digest window, uint32_t *ret_faces_raw);

/* The patch made of the same surface before, as above; from now on it is recalled by the new window too. */
const struct patch *memo_find(struct memo *, struct patch_key, const struct memo_source *);

/* Remembers it, by a reference of its own, if the key has a slot. */
void memo_keep(struct memo *, const struct memo_source *, struct patch *);
void memo_finish(struct memo *);

#endif

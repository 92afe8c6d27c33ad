/* What the last meshes were made of, so that a patch whose raw mesh and border are as before is not reduced again.
 *
 * Most of a row's dirty patches read a changed voxel without drawing other triangles. The digest is one of all that the
 * reduction reads, so a remembered patch is what it would give again: the mesh stays a pure function of the voxels (law
 * L2). A key has one slot of MEMO_SLOTS; patches beyond MEMO_BYTES_MAX are not kept: at most 8 MB. */
#ifndef FACET_CORE_MEMO_H
#define FACET_CORE_MEMO_H

#include "core/border.h"
#include "core/patch.h"

#define MEMO_SLOTS     1024
#define MEMO_BYTES_MAX 8192

struct digest {
	uint64_t a, b;
};

struct memo {
	uint64_t batch;
	struct memo_slot {
		struct patch_key key;
		uint64_t batch; /* of the dirty set that took the slot last, 0: nobody */
		struct digest digest;
		struct patch *patch; /* or NULL */
	} slot[MEMO_SLOTS];
};

struct digest memo_digest(const struct surface *raw, const struct border *border);

/* Gives the keys of a dirty set their slots; a slot two of them want goes to the first. Only this changes whose slot is
 * whose, so that threads may then ask and keep for different keys. */
void memo_expect(struct memo *, const struct patch_key *keys, size_t n);

/* The patch made of the same before, borrowed until the next memo_keep of the key; or NULL. */
const struct patch *memo_find(const struct memo *, struct patch_key, struct digest);

/* Remembers it, by a reference of its own, if the key has a slot. */
void memo_keep(struct memo *, struct digest, struct patch *);
void memo_finish(struct memo *);

#endif

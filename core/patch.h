/* The mesh of one patch, immutable once made, and the store of the newest mesh of every patch, ordered by version. */
#ifndef FACET_CORE_PATCH_H
#define FACET_CORE_PATCH_H

#include <stdatomic.h>

#include "core/cubes.h"

/* Triangles of one plane and class, in a row. */
struct patch_run {
	uint32_t plane; /* local id, or PLANE_NONE */
	uint8_t class;  /* 0 unknown */
	uint16_t triangles;
};

#define PLANE_NONE         UINT32_MAX
#define PATCH_VERTICES_MAX 65535 /* fits u16 on the wire: a patch of 16^3 cells has at most 3 * 17^3 vertices */

/* One piece of memory; reference-counted, so that results cross threads without copies. */
struct patch {
	atomic_uint references;
	struct patch_key key;
	uint64_t version;              /* the step that made it */
	int64_t t_first_ns, t_last_ns; /* of the rows that made it */
	uint32_t nv, nt, nruns;        /* nt == 0: the patch is gone */
	uint16_t (*vertex)[3];         /* lattice */
	uint32_t (*triangle)[3];       /* ordered by run, each rotated to begin with its smallest index */
	struct patch_run *run;
};

/* A copy of `surface`, its triangles sorted into runs. References: 1. NULL when memory is out. */
struct patch *patch_create(struct patch_key, const struct surface *);
/* Zeroed, for a reader that fills it. References: 1. NULL when memory is out. */
struct patch *patch_allocate(struct patch_key, uint32_t nv, uint32_t nt, uint32_t nruns);
/* Geometry and runs of another one; version and times zero. References: 1. NULL when memory is out. */
struct patch *patch_copy(const struct patch *);
size_t patch_bytes(const struct patch *);
struct patch *patch_ref(struct patch *);
void patch_unref(struct patch *);
bool patch_equal(const struct patch *a, const struct patch *b); /* geometry and runs; not version and times */

struct patch_store;
struct patch_store *patch_store_create(void);
void patch_store_destroy(struct patch_store *);

/* Takes the reference over. A patch with nt == 0 stays as a tombstone, so that clients learn of the removal. 0, or
 * -ENOMEM: then the reference stays with the caller. Any order of versions will do; a put takes O(log n). */
int patch_store_put(struct patch_store *, struct patch *);

/* NULL where none was ever put; a tombstone where it is gone. Borrowed. */
struct patch *patch_store_get(const struct patch_store *, struct patch_key);

/* All patches (tombstones too) with version > `version`, ascending by (version, key); call with the last one returned
 * (or NULL to begin). Borrowed; NULL at the end. */
struct patch *patch_store_after(const struct patch_store *, uint64_t version, const struct patch *last);
size_t patch_store_count(const struct patch_store *); /* without tombstones */
size_t patch_store_bytes(const struct patch_store *); /* of patches, tombstones and the store itself */

/* The living patches in key order, borrowed; the array is the caller's to free. NULL in *ret_patches: memory is out. */
size_t patch_store_living(const struct patch_store *, struct patch ***ret_patches);

/* SHA-256 over the living patches in key order, as `--stats` prints it (interfaces, section 1): 64 hex digits and a NUL;
 * an empty string when memory is out. Bytes of a patch, all integers little-endian:
 *   i32 key x, y, z; u32 vertices; u32 triangles;
 *   u16 x, y, z of every vertex (lattice); u32 a, b, c of every triangle (rotated to begin with its smallest index);
 *   for every run: u32 plane, u32 triangles.
 * Planes are numbered by first use within the patch, from 0; PLANE_NONE stays 0xffffffff. Versions, times and classes
 * do not enter. */
void patch_store_hash(const struct patch_store *, char ret_hex[65]);

#endif

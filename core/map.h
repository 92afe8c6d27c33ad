/* The map: the whole way of a row, field -> dirty patches -> surfaces -> reduced patches, as calls without threads.
 * The daemon's worker and `facet reconstruct` both stand on it; several threads may call map_mesh_patch at once for
 * different patches, as long as no row is applied meanwhile. */
#ifndef FACET_CORE_MAP_H
#define FACET_CORE_MAP_H

#include "core/field.h"
#include "core/patch.h"
#include "core/reduce.h"

struct map_params {
	double cell_m;
	double tolerance; /* cells */
	bool reduce;
	int lookahead; /* rows */
	size_t memory; /* bytes */
};

struct map;
struct map *map_create(const struct map_params *);
void map_destroy(struct map *);

struct field *map_field(struct map *);
struct grid *map_grid(struct map *);

/* Takes `row` over; how many rows were folded. */
int map_row(struct map *, struct row *row);
int map_flush(struct map *);
uint64_t map_step(const struct map *);   /* applied rows */
int64_t map_time_ns(const struct map *); /* time of the newest applied row */

/* The patches to be meshed since the last call, in key order; borrowed until the next row. */
size_t map_take_dirty(struct map *, const struct patch_key **ret_keys);

/* Scratch of one meshing thread. */
struct mesher;
struct mesher *mesher_create(void);
void mesher_destroy(struct mesher *);
const struct reduce_stats *mesher_stats(const struct mesher *);
uint64_t mesher_faces_raw(const struct mesher *); /* faces extracted, summed over calls */

/* The patch as of now (nt == 0 where it has no surface), version map_step; reference 1. NULL when memory is out.
 * `ret_raw_faces` (may be NULL): faces before the reduction. */
struct patch *map_mesh_patch(const struct map *, struct mesher *, struct patch_key, uint32_t *ret_raw_faces);

/* The two steps of map_mesh_patch, for whoever measures them: the raw surface into the mesher (0 or -ENOMEM), then the
 * patch of the mesher's surface. */
int map_extract(const struct map *, struct mesher *, struct patch_key);
struct patch *map_reduce(const struct map *, struct mesher *);

#endif

/* The way of a row through the map: field -> dirty patches -> windows -> surfaces -> reduced patches.
 *
 * A patch is a pure function of the voxels (law L2), and what is remembered changes none: times, which
 * no hash contains, of rows that the field still holds back and of when a patch was dirty for the first time; and the last
 * meshes, each with a digest of what it was made of. map_mesh_patch writes to the slot of its own key only, so that
 * several threads may call it for different patches. */
#include "core/map.h"

#include <assert.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "core/arena.h"
#include "core/memo.h"

#define WAITING_MAX 64 /* rows held back whose times are kept; beyond, the oldest time is forgotten */

/* When a patch was first taken as dirty. */
struct birth {
	struct patch_key key;
	bool used;
	int64_t t_ns;
};

struct map {
	struct map_params params;
	struct grid *grid;
	struct field *field;
	int64_t t_ns;
	int64_t waiting[WAITING_MAX]; /* a ring */
	uint32_t waiting_first, waiting_count;
	struct birth *birth; /* open addressing; births_cap is a power of two, at most half full */
	size_t births, births_cap;
	struct memo *memo;
};

struct mesher {
	struct arena arena;
	struct window window;
	const struct patch *before; /* the memo's, made of the same window; or NULL */
	struct surface raw;         /* where there is none; in the arena */
	uint32_t faces;             /* of the window's surface, before the reduction */
	struct reduce_stats stats;
	uint64_t faces_raw;
};

struct map *map_create(const struct map_params *params)
{
	assert(params && params->cell_m > 0);
	struct map *map = calloc(1, sizeof *map);
	if (!map)
		return NULL;
	map->params = *params;
	map->births_cap = 256;
	map->birth = calloc(map->births_cap, sizeof *map->birth);
	map->memo = calloc(1, sizeof *map->memo);
	map->grid = grid_create(params->memory);
	struct field_params field = {.cell_m = params->cell_m, .lookahead = params->lookahead};
	map->field = map->grid ? field_create(&field, map->grid) : NULL;
	if (!map->birth || !map->memo || !map->field) {
		map_destroy(map);
		return NULL;
	}
	return map;
}

void map_destroy(struct map *map)
{
	if (!map)
		return;
	if (map->field)
		field_destroy(map->field);
	if (map->grid)
		grid_destroy(map->grid);
	free(map->birth);
	if (map->memo)
		memo_finish(map->memo);
	free(map->memo);
	free(map);
}

struct field *map_field(struct map *map)
{
	return map->field;
}

struct grid *map_grid(struct map *map)
{
	return map->grid;
}

/* The oldest `n` waiting rows were applied; rows are applied in the order of their number. */
static void note_applied(struct map *map, int n)
{
	for (; n > 0 && map->waiting_count; n--, map->waiting_count--) {
		map->t_ns = map->waiting[map->waiting_first];
		map->waiting_first = (map->waiting_first + 1) % WAITING_MAX;
	}
}

int map_row(struct map *map, struct row *row)
{
	assert(map && row);
	if (map->waiting_count == WAITING_MAX) {
		map->waiting_first = (map->waiting_first + 1) % WAITING_MAX;
		map->waiting_count--;
	}
	map->waiting[(map->waiting_first + map->waiting_count++) % WAITING_MAX] = row->t_ns;
	int folded = field_row(map->field, row);
	note_applied(map, folded);
	return folded;
}

int map_flush(struct map *map)
{
	int folded = field_flush(map->field);
	note_applied(map, folded);
	map->waiting_count = 0;
	return folded;
}

uint64_t map_step(const struct map *map)
{
	struct field_stats stats;
	field_stats(map->field, &stats);
	return stats.step;
}

int64_t map_time_ns(const struct map *map)
{
	return map->t_ns;
}

/* The place of a key: its own, or the free one where it belongs. */
static struct birth *find_birth(struct birth *births, size_t cap, struct patch_key key)
{
	uint64_t h = (uint32_t)key.x * 0x9e3779b97f4a7c15ull;
	h = ((h ^ h >> 32) + (uint32_t)key.y) * 0x9e3779b97f4a7c15ull;
	h = ((h ^ h >> 32) + (uint32_t)key.z) * 0x9e3779b97f4a7c15ull;
	size_t at = (h ^ h >> 32) & (cap - 1);
	while (births[at].used && patch_key_compare(births[at].key, key))
		at = (at + 1) & (cap - 1);
	return &births[at];
}

static bool grow_births(struct map *map)
{
	size_t cap = map->births_cap * 2;
	struct birth *births = calloc(cap, sizeof *births);
	if (!births)
		return false;
	for (size_t i = 0; i < map->births_cap; i++)
		if (map->birth[i].used)
			*find_birth(births, cap, map->birth[i].key) = map->birth[i];
	free(map->birth);
	map->birth = births;
	map->births_cap = cap;
	return true;
}

/* Without memory a patch is born anew at every mesh: only its displayed age suffers. */
static void note_birth(struct map *map, struct patch_key key)
{
	struct birth *birth = find_birth(map->birth, map->births_cap, key);
	if (birth->used || (map->births * 2 >= map->births_cap && !grow_births(map)))
		return;
	*find_birth(map->birth, map->births_cap, key) = (struct birth){key, true, map->t_ns};
	map->births++;
}

size_t map_take_dirty(struct map *map, const struct patch_key **ret_keys)
{
	size_t n = grid_take_dirty(map->grid, ret_keys);
	for (size_t i = 0; i < n; i++)
		note_birth(map, (*ret_keys)[i]);
	memo_expect(map->memo, *ret_keys, n);
	return n;
}

struct mesher *mesher_create(void)
{
	struct mesher *mesher = calloc(1, sizeof *mesher);
	if (mesher)
		arena_init(&mesher->arena);
	return mesher;
}

void mesher_destroy(struct mesher *mesher)
{
	if (!mesher)
		return;
	arena_finish(&mesher->arena);
	free(mesher);
}

const struct reduce_stats *mesher_stats(const struct mesher *mesher)
{
	return &mesher->stats;
}

uint64_t mesher_faces_raw(const struct mesher *mesher)
{
	return mesher->faces_raw;
}

int map_extract(const struct map *map, struct mesher *mesher, struct patch_key key)
{
	assert(map && mesher);
	arena_reset(&mesher->arena);
	cubes_gather(map->grid, key, &mesher->window);
	mesher->before = NULL;
	if (map->params.reduce && !mesher->window.empty)
		mesher->before = memo_recall(map->memo, key, mesher->window.digest, &mesher->faces);
	if (!mesher->before) {
		if (cubes_extract(&mesher->window, &mesher->arena, &mesher->raw))
			return -ENOMEM;
		mesher->faces = mesher->raw.nt;
	}
	mesher->faces_raw += mesher->faces;
	return 0;
}

/* The patch of the mesher's surface, without version and times: remembered, or made and then remembered. */
static struct patch *reduce_or_recall(const struct map *map, struct mesher *mesher)
{
	const struct reduce_params params = {.tolerance = map->params.tolerance};
	struct patch_key key = mesher->window.key;
	struct border border;
	struct surface surface;
	if (reduce_border(&mesher->window, &mesher->raw, &params, &mesher->arena, &border))
		return NULL;
	const struct memo_source source = {mesher->window.digest, memo_digest(&mesher->raw, &border), mesher->raw.nt};
	const struct patch *before = memo_find(map->memo, key, &source);
	if (before)
		return patch_copy(before);
	if (reduce_within(&border, &mesher->raw, &params, &mesher->arena, &mesher->stats, &surface))
		return NULL;
	struct patch *patch = patch_create(key, &surface);
	if (patch)
		memo_keep(map->memo, &source, patch);
	return patch;
}

static struct patch *make_patch(const struct map *map, struct mesher *mesher)
{
	if (mesher->before)
		return patch_copy(mesher->before);
	if (map->params.reduce && mesher->raw.nt)
		return reduce_or_recall(map, mesher);
	return patch_create(mesher->window.key, &mesher->raw);
}

struct patch *map_reduce(const struct map *map, struct mesher *mesher)
{
	assert(map && mesher);
	struct patch *patch = make_patch(map, mesher);
	if (!patch)
		return NULL;
	const struct birth *birth = find_birth(map->birth, map->births_cap, patch->key);
	patch->version = map_step(map);
	patch->t_first_ns = birth->used ? birth->t_ns : map->t_ns;
	patch->t_last_ns = map->t_ns;
	return patch;
}

struct patch *map_mesh_patch(const struct map *map, struct mesher *mesher, struct patch_key key,
                             uint32_t *ret_raw_faces)
{
	if (map_extract(map, mesher, key))
		return NULL;
	if (ret_raw_faces)
		*ret_raw_faces = mesher->faces;
	return map_reduce(map, mesher);
}

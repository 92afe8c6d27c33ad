/* Patches and their store.
 *
 * The store answers two questions: which is the newest mesh of this key (a hash table), and what came after that
 * version (a skip list in the order of version, then key). A client that copies a running map asks the second one again
 * and again between changes, from wherever it stood, so neither a list that is sorted on demand nor one that is entered
 * at its end serves; in the skip list every put, and every step to the next patch, costs the logarithm of the map.
 * Heights are taken from a hash of key and version: no random numbers, the same store from the same puts.
 *
 * Keys never leave the table: a patch that is gone stays as a tombstone, so that a client that slept learns of it. */
#include "core/patch.h"

#include <assert.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "core/model.h"

#define LEVELS 12 /* one node in four reaches the next level: enough for 4^12 patches */

struct order {
	uint32_t plane, at;
};

static int order_compare(const void *a, const void *b)
{
	const struct order *x = a, *y = b;
	if (x->plane != y->plane)
		return x->plane < y->plane ? -1 : 1;
	return x->at < y->at ? -1 : x->at > y->at;
}

/* The triangles of a surface in the order of their plane (none comes last), else as they were. */
static void sort_triangles(const struct surface *surface, struct order *order)
{
	for (uint32_t t = 0; t < surface->nt; t++)
		order[t] = (struct order){surface->plane ? surface->plane[t] : PLANE_NONE, t};
	if (surface->plane)
		qsort(order, surface->nt, sizeof *order, order_compare);
}

static uint32_t count_runs(const struct order *order, uint32_t nt)
{
	uint32_t n = 0;
	for (uint32_t t = 0; t < nt; t++)
		n += t == 0 || order[t].plane != order[t - 1].plane;
	return n;
}

static void rotate_triangle(const uint32_t from[3], uint32_t to[3])
{
	int first = from[1] < from[0] ? 1 : 0;
	if (from[2] < from[first])
		first = 2;
	for (int c = 0; c < 3; c++)
		to[c] = from[(first + c) % 3];
}

int patch_key_compare(struct patch_key a, struct patch_key b)
{
	if (a.z != b.z)
		return a.z < b.z ? -1 : 1;
	if (a.y != b.y)
		return a.y < b.y ? -1 : 1;
	if (a.x != b.x)
		return a.x < b.x ? -1 : 1;
	return 0;
}

size_t patch_bytes(const struct patch *patch)
{
	return sizeof *patch + patch->nt * sizeof *patch->triangle + patch->nruns * sizeof *patch->run +
	       patch->nv * sizeof *patch->vertex;
}

struct patch *patch_allocate(struct patch_key key, uint32_t nv, uint32_t nt, uint32_t nruns)
{
	struct patch sizes = {.nv = nv, .nt = nt, .nruns = nruns};
	struct patch *patch = calloc(1, patch_bytes(&sizes));
	if (!patch)
		return NULL;
	atomic_init(&patch->references, 1);
	patch->key = key;
	patch->nv = nv;
	patch->nt = nt;
	patch->nruns = nruns;
	patch->triangle = (void *)(patch + 1);
	patch->run = (void *)(patch->triangle + nt);
	patch->vertex = (void *)(patch->run + nruns);
	return patch;
}

static void copy_triangles(struct patch *patch, const struct surface *surface, const struct order *order)
{
	struct patch_run *run = patch->run - 1;
	for (uint32_t t = 0; t < patch->nt; t++) {
		if (t == 0 || order[t].plane != order[t - 1].plane)
			*++run = (struct patch_run){.plane = order[t].plane};
		run->triangles++;
		rotate_triangle(surface->triangle[order[t].at], patch->triangle[t]);
	}
}

struct patch *patch_create(struct patch_key key, const struct surface *surface)
{
	assert(surface && surface->nv <= PATCH_VERTICES_MAX && surface->nt <= UINT16_MAX);
	if (!surface->nt)
		return patch_allocate(key, 0, 0, 0);
	struct order *order = malloc((surface->nt + 1) * sizeof *order);
	if (!order)
		return NULL;
	sort_triangles(surface, order);
	struct patch *patch = patch_allocate(key, surface->nv, surface->nt, count_runs(order, surface->nt));
	if (patch) {
		copy_triangles(patch, surface, order);
		memcpy(patch->vertex, surface->vertex, surface->nv * sizeof *patch->vertex);
	}
	free(order);
	return patch;
}

struct patch *patch_copy(const struct patch *from)
{
	struct patch *patch = patch_allocate(from->key, from->nv, from->nt, from->nruns);
	if (patch) /* triangles, runs and vertices lie in a row */
		memcpy(patch + 1, from + 1, patch_bytes(from) - sizeof *from);
	return patch;
}

struct patch *patch_ref(struct patch *patch)
{
	atomic_fetch_add_explicit(&patch->references, 1, memory_order_relaxed);
	return patch;
}

void patch_unref(struct patch *patch)
{
	if (patch && atomic_fetch_sub_explicit(&patch->references, 1, memory_order_acq_rel) == 1)
		free(patch);
}

bool patch_equal(const struct patch *a, const struct patch *b)
{
	if (patch_key_compare(a->key, b->key) || a->nv != b->nv || a->nt != b->nt || a->nruns != b->nruns)
		return false;
	for (uint32_t i = 0; i < a->nruns; i++)
		if (a->run[i].plane != b->run[i].plane || a->run[i].class != b->run[i].class ||
		    a->run[i].triangles != b->run[i].triangles)
			return false;
	return !memcmp(a->vertex, b->vertex, a->nv * sizeof *a->vertex) &&
	       !memcmp(a->triangle, b->triangle, a->nt * sizeof *a->triangle);
}

struct node {
	struct patch *patch;
	int levels;
	struct node *next[];
};

struct patch_store {
	struct node *head;  /* LEVELS high, no patch: before all others */
	struct node **slot; /* open addressing by key; a power of two, at most half full */
	size_t slots, keys, living, bytes;
};

static uint64_t mix(uint64_t x)
{
	x = (x ^ x >> 32) * 0xd6e8feb86659fd93ull;
	x = (x ^ x >> 32) * 0xd6e8feb86659fd93ull;
	return x ^ x >> 32;
}

static uint64_t key_hash(struct patch_key key)
{
	return mix(mix(mix((uint32_t)key.x) + (uint32_t)key.y) + (uint32_t)key.z);
}

/* The total order of the skip list. */
static bool comes_before(const struct patch *a, uint64_t version, struct patch_key key)
{
	return a->version != version ? a->version < version : patch_key_compare(a->key, key) < 0;
}

/* The last node of every level that comes before (version, key). */
static void find_before(const struct patch_store *store, uint64_t version, struct patch_key key,
                        struct node *ret_before[LEVELS])
{
	struct node *node = store->head;
	for (int level = LEVELS - 1; level >= 0; level--) {
		while (node->next[level] && comes_before(node->next[level]->patch, version, key))
			node = node->next[level];
		ret_before[level] = node;
	}
}

static size_t node_bytes(int levels)
{
	return sizeof(struct node) + (size_t)levels * sizeof(struct node *);
}

static struct node *node_create(struct patch *patch)
{
	uint64_t h = mix(key_hash(patch->key) + patch->version);
	int levels = 1 + __builtin_ctzll(h | 1ull << 2 * (LEVELS - 1)) / 2;
	struct node *node = calloc(1, node_bytes(levels));
	if (!node)
		return NULL;
	node->patch = patch;
	node->levels = levels;
	return node;
}

static void link_node(struct patch_store *store, struct node *node)
{
	struct node *before[LEVELS];
	find_before(store, node->patch->version, node->patch->key, before);
	for (int level = 0; level < node->levels; level++) {
		node->next[level] = before[level]->next[level];
		before[level]->next[level] = node;
	}
	store->bytes += patch_bytes(node->patch) + node_bytes(node->levels);
	store->living += node->patch->nt > 0;
}

/* Takes a node out of the list and gives it and its patch up. */
static void drop_node(struct patch_store *store, struct node *node)
{
	struct node *before[LEVELS];
	find_before(store, node->patch->version, node->patch->key, before);
	for (int level = 0; level < node->levels; level++)
		before[level]->next[level] = node->next[level];
	store->bytes -= patch_bytes(node->patch) + node_bytes(node->levels);
	store->living -= node->patch->nt > 0;
	patch_unref(node->patch);
	free(node);
}

/* The slot of a key: its own, or the free one where it belongs. */
static struct node **find_slot(struct node **slot, size_t slots, struct patch_key key)
{
	size_t at = key_hash(key) & (slots - 1);
	while (slot[at] && patch_key_compare(slot[at]->patch->key, key))
		at = (at + 1) & (slots - 1);
	return &slot[at];
}

static int grow(struct patch_store *store)
{
	size_t slots = store->slots * 2;
	struct node **slot = calloc(slots, sizeof *slot);
	if (!slot)
		return -ENOMEM;
	for (size_t i = 0; i < store->slots; i++)
		if (store->slot[i])
			*find_slot(slot, slots, store->slot[i]->patch->key) = store->slot[i];
	free(store->slot);
	store->slot = slot;
	store->bytes += (slots - store->slots) * sizeof *slot;
	store->slots = slots;
	return 0;
}

struct patch_store *patch_store_create(void)
{
	struct patch_store *store = calloc(1, sizeof *store);
	if (!store)
		return NULL;
	store->slots = 64;
	store->slot = calloc(store->slots, sizeof *store->slot);
	store->head = calloc(1, node_bytes(LEVELS));
	if (!store->slot || !store->head) {
		patch_store_destroy(store);
		return NULL;
	}
	store->head->levels = LEVELS;
	store->bytes = sizeof *store + store->slots * sizeof *store->slot + node_bytes(LEVELS);
	return store;
}

void patch_store_destroy(struct patch_store *store)
{
	if (!store)
		return;
	for (struct node *node = store->head ? store->head->next[0] : NULL, *next; node; node = next) {
		next = node->next[0];
		patch_unref(node->patch);
		free(node);
	}
	free(store->head);
	free(store->slot);
	free(store);
}

int patch_store_put(struct patch_store *store, struct patch *patch)
{
	assert(store && patch);
	if (store->keys * 2 >= store->slots && grow(store))
		return -ENOMEM;
	struct node *node = node_create(patch);
	if (!node)
		return -ENOMEM;
	struct node **slot = find_slot(store->slot, store->slots, patch->key);
	if (*slot)
		drop_node(store, *slot);
	else
		store->keys++;
	*slot = node;
	link_node(store, node);
	return 0;
}

struct patch *patch_store_get(const struct patch_store *store, struct patch_key key)
{
	struct node *node = *find_slot(store->slot, store->slots, key);
	return node ? node->patch : NULL;
}

struct patch *patch_store_after(const struct patch_store *store, uint64_t version, const struct patch *last)
{
	struct node *before[LEVELS];
	if (!last && version == UINT64_MAX)
		return NULL;
	if (last)
		find_before(store, last->version, last->key, before);
	else
		find_before(store, version + 1, (struct patch_key){INT32_MIN, INT32_MIN, INT32_MIN}, before);
	struct node *node = before[0]->next[0];
	if (node && last && !comes_before(last, node->patch->version, node->patch->key))
		node = node->next[0]; /* `last` itself */
	return node ? node->patch : NULL;
}

size_t patch_store_count(const struct patch_store *store)
{
	return store->living;
}

size_t patch_store_bytes(const struct patch_store *store)
{
	return store->bytes;
}

static int key_compare(const void *a, const void *b)
{
	return patch_key_compare((*(struct patch *const *)a)->key, (*(struct patch *const *)b)->key);
}

size_t patch_store_living(const struct patch_store *store, struct patch ***ret_patches)
{
	struct patch **patches = malloc((store->living + 1) * sizeof *patches);
	size_t n = 0;
	*ret_patches = patches;
	if (!patches)
		return 0;
	for (size_t i = 0; i < store->slots; i++)
		if (store->slot[i] && store->slot[i]->patch->nt)
			patches[n++] = store->slot[i]->patch;
	qsort(patches, n, sizeof(struct patch *), key_compare);
	return n;
}

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "vertices and triangles are hashed as they lie in memory");

static void hash_u32(struct sha256 *sha, uint32_t value)
{
	uint8_t bytes[4] = {(uint8_t)value, (uint8_t)(value >> 8), (uint8_t)(value >> 16), (uint8_t)(value >> 24)};
	sha256_add(sha, bytes, sizeof bytes);
}

/* Runs of one plane stand together, so a plane is met for the first time when it differs from the run before. */
static void hash_patch(struct sha256 *sha, const struct patch *patch)
{
	uint32_t planes = 0;
	hash_u32(sha, (uint32_t)patch->key.x);
	hash_u32(sha, (uint32_t)patch->key.y);
	hash_u32(sha, (uint32_t)patch->key.z);
	hash_u32(sha, patch->nv);
	hash_u32(sha, patch->nt);
	sha256_add(sha, patch->vertex, patch->nv * sizeof *patch->vertex);
	sha256_add(sha, patch->triangle, patch->nt * sizeof *patch->triangle);
	for (uint32_t i = 0; i < patch->nruns; i++) {
		const struct patch_run *run = &patch->run[i];
		if (run->plane != PLANE_NONE)
			planes += i == 0 || run->plane != run[-1].plane;
		hash_u32(sha, run->plane == PLANE_NONE ? PLANE_NONE : planes - 1);
		hash_u32(sha, run->triangles);
	}
}

void patch_store_hash(const struct patch_store *store, char ret_hex[65])
{
	struct patch **patches;
	size_t n = patch_store_living(store, &patches);
	ret_hex[0] = 0;
	if (!patches)
		return;
	struct sha256 sha;
	sha256_init(&sha);
	for (size_t i = 0; i < n; i++)
		hash_patch(&sha, patches[i]);
	sha256_hex(&sha, ret_hex);
	free(patches);
}

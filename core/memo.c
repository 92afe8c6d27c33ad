#include "core/memo.h"

#include <string.h>

static void digest_bytes(struct digest *d, const void *bytes, size_t n)
{
	const uint8_t *at = bytes;
	uint64_t word;
	for (; n >= sizeof word; at += sizeof word, n -= sizeof word) {
		memcpy(&word, at, sizeof word);
		digest_word(d, word);
	}
	word = 0;
	if (n)
		memcpy(&word, at, n);
	digest_word(d, word);
}

struct digest memo_digest(const struct surface *raw, const struct border *border)
{
	struct digest d = {raw->nv, raw->nt};
	digest_word(&d, (uint64_t)border->members << 32 | border->chains);
	digest_bytes(&d, raw->vertex, raw->nv * sizeof *raw->vertex);
	digest_bytes(&d, raw->triangle, raw->nt * sizeof *raw->triangle);
	digest_bytes(&d, border->kind, raw->nv);
	digest_bytes(&d, border->faces, raw->nv);
	digest_bytes(&d, border->member, border->members * sizeof *border->member);
	digest_bytes(&d, border->kept, border->members * sizeof *border->kept);
	for (uint32_t c = 0; c < border->chains; c++) {
		const struct border_chain *chain = &border->chain[c];
		digest_word(&d, (uint64_t)chain->first << 32 | chain->n);
		digest_word(&d, (uint64_t)chain->closed << 16 | (uint64_t)chain->axis << 8 | chain->high);
	}
	return d;
}

static size_t slot_of(struct patch_key key)
{
	uint64_t h = (uint32_t)key.x * 0x9e3779b97f4a7c15ull;
	h = ((h ^ h >> 32) + (uint32_t)key.y) * 0x9e3779b97f4a7c15ull;
	h = ((h ^ h >> 32) + (uint32_t)key.z) * 0x9e3779b97f4a7c15ull;
	return (h ^ h >> 32) % MEMO_SLOTS;
}

static bool owns(const struct memo_slot *slot, struct patch_key key)
{
	return slot->batch && !patch_key_compare(slot->key, key);
}

void memo_expect(struct memo *memo, const struct patch_key *keys, size_t n)
{
	memo->batch++;
	for (size_t i = 0; i < n; i++) {
		struct memo_slot *slot = &memo->slot[slot_of(keys[i])];
		if (slot->batch == memo->batch)
			continue;
		slot->batch = memo->batch;
		if (!patch_key_compare(slot->key, keys[i]))
			continue;
		patch_unref(slot->patch);
		slot->patch = NULL;
		slot->key = keys[i];
	}
}

static bool equal(struct digest x, struct digest y)
{
	return x.a == y.a && x.b == y.b;
}

const struct patch *memo_recall(const struct memo *memo, struct patch_key key, struct digest window,
                                uint32_t *ret_faces_raw)
{
	const struct memo_slot *slot = &memo->slot[slot_of(key)];
	if (!owns(slot, key) || !slot->patch || !equal(slot->source.window, window))
		return NULL;
	*ret_faces_raw = slot->source.faces_raw;
	return slot->patch;
}

const struct patch *memo_find(struct memo *memo, struct patch_key key, const struct memo_source *source)
{
	struct memo_slot *slot = &memo->slot[slot_of(key)];
	if (!owns(slot, key) || !slot->patch || !equal(slot->source.surface, source->surface))
		return NULL;
	slot->source.window = source->window;
	return slot->patch;
}

void memo_keep(struct memo *memo, const struct memo_source *source, struct patch *patch)
{
	struct memo_slot *slot = &memo->slot[slot_of(patch->key)];
	if (!owns(slot, patch->key))
		return;
	patch_unref(slot->patch);
	slot->patch = patch_bytes(patch) <= MEMO_BYTES_MAX ? patch_ref(patch) : NULL;
	slot->source = *source;
}

void memo_finish(struct memo *memo)
{
	for (size_t i = 0; i < MEMO_SLOTS; i++)
		patch_unref(memo->slot[i].patch);
}

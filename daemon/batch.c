/* A batch is the map as of the step at which it began, and nothing is copied for it. What it will send follows from the
 * store as it was then (sheets_as_of): an entry is in it if it had changed after what the client committed (begin), or if it
 * comes into the region or leaves it. How far it is follows from the last one sent: everything up to there in the order is
 * sent, everything behind is not.
 *
 *     order:   removals, nearest first | patches, nearest first
 *              sent ... sent | window: the nearest unsent | not looked at yet
 *                     rank, key ─┘
 *
 * Only the window is held. When it is used up, the store is looked through for the next ones: through the end of the list
 * of changes, or, where the region moved or the client holds nothing, through all of it. The cost of a batch therefore
 * follows what changed, as long as the region stays; the memory is the same whatever there is. What the store keeps of an
 * entry that changed meanwhile is kept until the batch has passed it: what has been sent is no longer looked for. */
#include "daemon/batch.h"

#include <assert.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#define RANK_PATCH (1ull << 62) /* beyond every distance: patches come after removals */

enum part { PART_NONE, PART_REMOVAL, PART_PATCH };

/* What an entry, as it was, is to this batch. One that is gone is removed even where the client may never have had it: the
 * store does not know what it was at `begin`. */
static enum part part_of(const struct batch *batch, const struct entry *entry)
{
	struct sheet *sheet;
	uint64_t sequence;

	if (!sheets_as_of(entry, batch->end, &sequence, &sheet))
		return PART_NONE;

	bool changed = sequence > batch->begin;
	bool had = !batch->whole && interest_has(&batch->from, entry->key);
	bool has = sheet && interest_has(&batch->to, entry->key);

	if (has)
		return changed || !had ? PART_PATCH : PART_NONE;
	return had && (changed || sheet) ? PART_REMOVAL : PART_NONE;
}

/* Order */

static uint64_t rank_of(const struct batch *batch, struct patch_key key, enum part part)
{
	int64_t x = (int64_t)key.x - batch->origin.x, y = (int64_t)key.y - batch->origin.y;
	int64_t z = (int64_t)key.z - batch->origin.z;

	return (uint64_t)(x * x + y * y + z * z) + (part == PART_PATCH ? RANK_PATCH : 0);
}

static int compare(uint64_t a_rank, struct patch_key a, uint64_t b_rank, struct patch_key b)
{
	return a_rank != b_rank ? (a_rank < b_rank ? -1 : 1) : patch_key_compare(a, b);
}

static int compare_waiting(const void *a, const void *b)
{
	const struct batch_waiting *x = a, *y = b;

	return compare(x->rank, x->entry->key, y->rank, y->entry->key);
}

static bool is_sent(const struct batch *batch, uint64_t rank, struct patch_key key)
{
	return batch->started && compare(rank, key, batch->rank, batch->key) <= 0;
}

bool batch_needs(const struct batch *batch, const struct entry *entry)
{
	enum part part = part_of(batch, entry);

	return part != PART_NONE && !is_sent(batch, rank_of(batch, entry->key, part), entry->key);
}

/* The window */

static void sift_down(struct batch_waiting *heap, size_t n, size_t at)
{
	for (size_t child; (child = 2 * at + 1) < n; at = child) {
		struct batch_waiting swap = heap[at];

		if (child + 1 < n && compare_waiting(&heap[child + 1], &heap[child]) > 0)
			child++;
		if (compare_waiting(&heap[child], &swap) <= 0)
			return;
		heap[at] = heap[child];
		heap[child] = swap;
	}
}

/* Keeps the nearest of all it is given, `window` at most: a heap, the farthest on top, once it is full. */
static size_t keep_nearest(struct batch_scratch *scratch, size_t n, struct batch_waiting waiting)
{
	struct batch_waiting *heap = scratch->nearest;

	if (n < scratch->window) {
		heap[n++] = waiting;
		for (size_t i = n / 2; n == scratch->window && i > 0; i--)
			sift_down(heap, n, i - 1);
	} else if (compare_waiting(&waiting, &heap[0]) < 0) {
		heap[0] = waiting;
		sift_down(heap, n, 0);
	}
	return n;
}

/* What may be in the batch, one after the other; NULL at the end. `i` begins at 0. */
static struct entry *candidate(const struct batch *batch, const struct sheets *sheets, struct entry *last, size_t *i)
{
	struct entry *entry;

	if (batch->whole || !interest_equal(&batch->from, &batch->to))
		return *i < sheets->entries ? sheets_entry(sheets, (*i)++) : NULL;
	entry = last ? last->older : sheets->newest;
	return entry && entry->sequence > batch->begin ? entry : NULL;
}

/* `ret_parts` (may be NULL): how many of each part are still to be sent. */
static int fill_window(struct batch *batch, const struct sheets *sheets, struct batch_scratch *scratch,
                       uint32_t *ret_parts)
{
	struct entry *entry = NULL;
	size_t n = 0, i = 0;

	while ((entry = candidate(batch, sheets, entry, &i)) != NULL) {
		enum part part = part_of(batch, entry);
		struct batch_waiting waiting = {.entry = entry};

		if (part == PART_NONE)
			continue;
		waiting.rank = rank_of(batch, entry->key, part);
		if (is_sent(batch, waiting.rank, entry->key))
			continue;
		n = keep_nearest(scratch, n, waiting);
		if (ret_parts)
			ret_parts[part]++;
	}
	if (n > batch->window_cap) {
		free(batch->window);
		batch->window_n = batch->window_at = batch->window_cap = 0;
		batch->window = malloc(n * sizeof(*batch->window));
		if (!batch->window)
			return -ENOMEM;
		batch->window_cap = n;
	}
	batch->window_at = 0;
	batch->window_n = n;
	if (n == 0)
		return 0;
	qsort(scratch->nearest, n, sizeof(*scratch->nearest), compare_waiting);
	memcpy(batch->window, scratch->nearest, n * sizeof(*batch->window));
	return 0;
}

int batch_begin(struct batch *batch, const struct sheets *sheets, struct batch_scratch *scratch, uint32_t *ret_patches,
                uint32_t *ret_removals)
{
	uint32_t parts[3] = {0};
	int r;

	batch->end = sheets->sequence;
	r = fill_window(batch, sheets, scratch, parts);
	if (r < 0)
		return r;
	batch->left = (size_t)parts[PART_PATCH] + parts[PART_REMOVAL];
	*ret_patches = parts[PART_PATCH];
	*ret_removals = parts[PART_REMOVAL];
	return 0;
}

/* Sending */

int batch_next(struct batch *batch, const struct sheets *sheets, struct batch_scratch *scratch,
               struct entry **ret_entry, struct sheet **ret_sheet)
{
	const struct batch_waiting *waiting;
	struct sheet *sheet = NULL;
	uint64_t sequence;
	int r;

	if (batch->left == 0)
		return 0;
	if (batch->window_at == batch->window_n) {
		r = fill_window(batch, sheets, scratch, NULL);
		if (r < 0)
			return r;
	}
	assert(batch->window_at < batch->window_n);
	waiting = &batch->window[batch->window_at++];
	if (waiting->rank >= RANK_PATCH) {
		sheets_as_of(waiting->entry, batch->end, &sequence, &sheet);
		sheet->references++;
	}
	batch->started = true;
	batch->rank = waiting->rank;
	batch->key = waiting->entry->key;
	batch->left--;
	*ret_entry = waiting->entry;
	*ret_sheet = sheet;
	return 1;
}

void batch_finish(struct batch *batch)
{
	assert(!batch->past);
	free(batch->window);
	*batch = (struct batch){0};
}

size_t batch_bytes(const struct batch *batch)
{
	return batch->window_cap * sizeof(*batch->window);
}

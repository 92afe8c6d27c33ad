/* A batch is the map as of the step at which it began, and nothing is copied for it. What it will send follows from the
 * store: an entry is in it if it changed after what the client committed (begin) and not after the batch began (end), or
 * if it comes into the region or leaves it. How far it is follows from the last one sent: everything up to there in the
 * order is sent, everything behind is not.
 *
 *     order:   removals, nearest first | patches, nearest first
 *              sent ... sent | window: the nearest unsent | not looked at yet
 *                     rank, key ─┘
 *
 * Only the window is held. When it is used up, the store is looked through for the next ones: through the end of the list
 * of changes, or, where the region moved or the client holds nothing, through all of it. The cost of a batch therefore
 * follows what changed, as long as the region stays; the memory is the same whatever there is.
 *
 * When an entry changes that is still unsent, its sheet is pinned, in a list that has the same order; the next to be sent
 * is the first of window and pins. Entries of the window that changed are passed over: they have their pin. So what is
 * behind the window in the store is always either behind it in the order too, or pinned. */
#include "daemon/batch.h"

#include <assert.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#define RANK_PATCH (1ull << 62) /* beyond every distance: patches come after removals */

enum part { PART_NONE, PART_REMOVAL, PART_PATCH };

/* What an entry, as it is, is to this batch. One that is gone is removed even where the client may never have had it: the
 * store does not know what it was at `begin`. */
static enum part part_of(const struct batch *batch, const struct entry *entry)
{
	bool changed = entry->sequence > batch->begin;
	bool had = !batch->whole && interest_has(&batch->from, entry->key);
	bool has = entry->sheet && interest_has(&batch->to, entry->key);

	if (entry->sequence > batch->end)
		return PART_NONE;
	if (has)
		return changed || !had ? PART_PATCH : PART_NONE;
	return had && (changed || entry->sheet) ? PART_REMOVAL : PART_NONE;
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

/* Pins */

static uint64_t pin_rank(const struct batch *batch, const struct batch_pin *pin)
{
	return rank_of(batch, pin->entry->key, pin->sheet ? PART_PATCH : PART_REMOVAL);
}

/* Room for one more. Those that were sent make room first. */
static int reserve_pin(struct batch *batch, struct sheets *sheets)
{
	size_t cap = batch->pins_cap ? batch->pins_cap * 2 : 64;
	struct batch_pin *grown;

	if (batch->pins < batch->pins_cap)
		return 0;
	if (batch->pin_at > 0) {
		sheets->stats.pinned -= batch->pin_at * sizeof(*batch->pin);
		batch->pins -= batch->pin_at;
		memmove(batch->pin, batch->pin + batch->pin_at, batch->pins * sizeof(*batch->pin));
		batch->pin_at = 0;
		return 0;
	}
	if (batch->pins == BATCH_PINS_MAX)
		return -ENOBUFS;
	cap = cap > BATCH_PINS_MAX ? BATCH_PINS_MAX : cap;
	grown = realloc(batch->pin, cap * sizeof(*grown));
	if (!grown)
		return -ENOMEM;
	batch->pin = grown;
	batch->pins_cap = cap;
	return 0;
}

/* Where it belongs among those not yet sent. */
static size_t pin_place(const struct batch *batch, uint64_t rank, struct patch_key key)
{
	size_t low = batch->pin_at, high = batch->pins;

	while (low < high) {
		size_t middle = low + (high - low) / 2;
		const struct batch_pin *pin = &batch->pin[middle];

		if (compare(pin_rank(batch, pin), pin->entry->key, rank, key) < 0)
			low = middle + 1;
		else
			high = middle;
	}
	return low;
}

int batch_before_change(struct batch *batch, struct sheets *sheets, struct entry *entry)
{
	enum part part = part_of(batch, entry);
	uint64_t rank = rank_of(batch, entry->key, part);
	struct sheet *sheet = part == PART_PATCH ? entry->sheet : NULL;
	size_t at;
	int r;

	if (part == PART_NONE || is_sent(batch, rank, entry->key))
		return 0;
	r = reserve_pin(batch, sheets);
	if (r < 0)
		return r;
	at = pin_place(batch, rank, entry->key);
	memmove(batch->pin + at + 1, batch->pin + at, (batch->pins - at) * sizeof(*batch->pin));
	batch->pin[at] = (struct batch_pin){entry, sheet};
	batch->pins++;
	batch->pinned += sizeof(*batch->pin);
	sheets->stats.pinned += sizeof(*batch->pin);
	if (sheet) {
		sheet->references++;
		batch->pinned += sheet->len;
	}
	return 0;
}

/* Sending */

static void take_pin(struct batch *batch, struct entry **ret_entry, struct sheet **ret_sheet)
{
	struct batch_pin *pin = &batch->pin[batch->pin_at++];

	batch->rank = pin_rank(batch, pin);
	batch->pinned -= sizeof(*pin) + (pin->sheet ? pin->sheet->len : 0);
	*ret_entry = pin->entry;
	*ret_sheet = pin->sheet; /* with its reference */
}

static void take_waiting(struct batch *batch, struct entry **ret_entry, struct sheet **ret_sheet)
{
	const struct batch_waiting *waiting = &batch->window[batch->window_at++];

	batch->rank = waiting->rank;
	*ret_entry = waiting->entry;
	*ret_sheet = waiting->rank >= RANK_PATCH ? waiting->entry->sheet : NULL;
	if (*ret_sheet)
		(*ret_sheet)->references++;
}

int batch_next(struct batch *batch, struct sheets *sheets, struct batch_scratch *scratch, struct entry **ret_entry,
               struct sheet **ret_sheet)
{
	const struct batch_pin *pin;
	const struct batch_waiting *waiting;
	int r;

	if (batch->left == 0)
		return 0;
	while (batch->window_at < batch->window_n && batch->window[batch->window_at].entry->sequence > batch->end)
		batch->window_at++; /* it has its pin */
	if (batch->window_at == batch->window_n && batch->left > batch->pins - batch->pin_at) {
		r = fill_window(batch, sheets, scratch, NULL);
		if (r < 0)
			return r;
	}
	pin = batch->pin_at < batch->pins ? &batch->pin[batch->pin_at] : NULL;
	waiting = batch->window_at < batch->window_n ? &batch->window[batch->window_at] : NULL;
	assert(pin || waiting);
	if (!waiting || (pin && compare(pin_rank(batch, pin), pin->entry->key, waiting->rank, waiting->entry->key) < 0))
		take_pin(batch, ret_entry, ret_sheet);
	else
		take_waiting(batch, ret_entry, ret_sheet);
	batch->started = true;
	batch->key = (*ret_entry)->key;
	batch->left--;
	return 1;
}

void batch_finish(struct batch *batch, struct sheets *sheets)
{
	while (batch->pin_at < batch->pins)
		sheet_unref(sheets, batch->pin[batch->pin_at++].sheet);
	sheets->stats.pinned -= batch->pins * sizeof(*batch->pin);
	free(batch->pin);
	free(batch->window);
	*batch = (struct batch){0};
}

size_t batch_bytes(const struct batch *batch)
{
	return batch->pins_cap * sizeof(*batch->pin) + batch->window_cap * sizeof(*batch->window);
}

/* Clients and batches.
 *
 * The store keeps of every patch its newest *sheet*: the PATCH frame as it goes over the wire, encoded once for all
 * clients. Entries stand in one list in the order of their last change; a change moves its entry to the end and gives it
 * the next sequence number. So "what a client misses" is the end of the list behind the number it last committed,
 * and costs what changed, not what there is.
 *
 *     oldest  e4  e1  e7 | e2  e9  e3  newest            a batch: ( begin .. end ], a cursor in the list, a list of pins
 *                 begin ─┘  ▲       └─ end
 *                           cursor
 *
 * A batch is the map as of the step at which it began. When an entry changes that the batch has not sent yet, its old
 * sheet is pinned: the batch sends pins after its cursor has come to the end. Nothing is copied for a client, and a
 * client that keeps up pins nothing. A batch that pins too many bytes or entries is aborted; the next one begins at the
 * newest step: a slow client skips what lies between and costs no memory (law L6).
 *
 * Entries of patches that are gone stay, as the memory of their removal: there can be no more of them than the map,
 * which has a cap, ever had patches. Sequence numbers serve where steps would not: two sets may have one step. */
#include "daemon/publisher.h"

#include <assert.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define PUBLISHER_PINS_MAX PUBLISHER_CLIENT_MAX
#define OUT_BYTES (32u << 10)                               /* gathered for one write */
#define PINS_MAX  (PUBLISHER_PINS_MAX / sizeof(struct pin)) /* in the list of one batch */

struct sheet {
	unsigned references; /* of the store, pins and frames being written */
	bool orphan;         /* the store has a newer one: it lives only because it is pinned */
	uint32_t faces, faces_raw;
	size_t len;
	uint8_t bytes[];
};

struct entry {
	struct patch_key key;
	uint64_t sequence;
	struct sheet *sheet; /* NULL: the patch is gone */
	struct entry *older, *newer;
};

struct pin {
	struct patch_key key;
	struct sheet *sheet; /* NULL: a removal */
};

struct batch {
	bool active, aborting, reset;
	uint64_t begin, end, step; /* sequence numbers (begin, end] */
	struct entry *cursor;      /* next to be sent; NULL: only pins are left */
	struct pin *pin;
	size_t pins, pins_sent, pins_cap;
	size_t pinned; /* bytes of orphans among the pins not yet sent, and of the list */
};

struct publisher_client {
	struct publisher *publisher;
	struct publisher_client *next;
	bool greeted; /* HELLO of this generation was sent */
	bool whole;   /* the next batch is the whole map */
	uint64_t committed, committed_step;
	struct batch batch;
	int aborts_running;
	/* The frame being taken over into `out`: of a sheet, or of `small`. */
	const uint8_t *source;
	size_t source_left;
	struct sheet *source_sheet;
	struct buffer small, json; /* one small frame; JSON messages that wait for their turn */
	uint8_t out[OUT_BYTES];
	size_t out_at, out_len;
	uint32_t bytes_per_s;                /* 0: all */
	int64_t next_ns;                     /* not before then, by that rate */
	bool dismissed, reason_sent, broken; /* broken: no memory even for a small frame */
	char reason[160];
	struct publisher_client_stats stats;
};

struct publisher {
	struct publisher_params params;
	uint32_t generation;
	uint64_t step, sequence;
	struct entry **slot; /* open addressing by key, a power of two, at most half full */
	size_t slots, entries;
	struct entry *oldest, *newest;
	struct publisher_client *clients;
	struct buffer encoded; /* scratch */
	struct publisher_stats stats;
};

/* Sheets */

static void sheet_unref(struct publisher *p, struct sheet *sheet)
{
	if (!sheet || --sheet->references > 0)
		return;
	if (sheet->orphan)
		p->stats.pinned -= sheet->len;
	free(sheet);
}

/* NULL when memory is out. */
static struct sheet *sheet_create(struct publisher *p, const struct patch *patch, uint32_t faces_raw)
{
	struct sheet *sheet = NULL;

	p->encoded.len = 0;
	native_put_patch(&p->encoded, patch);
	if (p->encoded.error == 0)
		sheet = malloc(sizeof(*sheet) + p->encoded.len);
	if (sheet) {
		*sheet = (struct sheet){.references = 1, .faces = patch->nt, .faces_raw = faces_raw};
		sheet->len = p->encoded.len;
		memcpy(sheet->bytes, p->encoded.data, p->encoded.len);
	}
	return sheet;
}

/* Entries */

static size_t key_hash(struct patch_key key)
{
	uint64_t h = (uint32_t)key.x;

	h = (h * 0x9e3779b97f4a7c15ull) ^ (uint32_t)key.y;
	h = (h * 0x9e3779b97f4a7c15ull) ^ (uint32_t)key.z;
	h *= 0x9e3779b97f4a7c15ull;
	return (size_t)(h ^ h >> 32);
}

static struct entry **find_slot(struct entry **slot, size_t slots, struct patch_key key)
{
	size_t at = key_hash(key) & (slots - 1);

	while (slot[at] && patch_key_compare(slot[at]->key, key) != 0)
		at = (at + 1) & (slots - 1);
	return &slot[at];
}

static int grow(struct publisher *p)
{
	size_t slots = p->slots ? p->slots * 2 : 256;
	struct entry **slot = calloc(slots, sizeof(*slot));

	if (!slot)
		return -ENOMEM;
	for (struct entry *entry = p->oldest; entry; entry = entry->newer)
		*find_slot(slot, slots, entry->key) = entry;
	free(p->slot);
	p->slot = slot;
	p->slots = slots;
	return 0;
}

static void link_newest(struct publisher *p, struct entry *entry)
{
	entry->sequence = ++p->sequence;
	entry->newer = NULL;
	entry->older = p->newest;
	*(p->newest ? &p->newest->newer : &p->oldest) = entry;
	p->newest = entry;
}

static void unlink_entry(struct publisher *p, struct entry *entry)
{
	*(entry->older ? &entry->older->newer : &p->oldest) = entry->newer;
	*(entry->newer ? &entry->newer->older : &p->newest) = entry->older;
}

/* The entry of a key, made (as gone, not linked) if there is none. NULL when memory is out. */
static struct entry *touch_entry(struct publisher *p, struct patch_key key, bool *ret_is_new)
{
	struct entry **slot;

	if (2 * p->entries >= p->slots && grow(p) < 0)
		return NULL;
	slot = find_slot(p->slot, p->slots, key);
	*ret_is_new = !*slot;
	if (!*slot) {
		*slot = calloc(1, sizeof(**slot));
		if (!*slot)
			return NULL;
		(*slot)->key = key;
		p->entries++;
	}
	return *slot;
}

/* Batches */

static void pins_release(struct publisher *p, struct batch *batch)
{
	while (batch->pins_sent < batch->pins)
		sheet_unref(p, batch->pin[batch->pins_sent++].sheet);
	p->stats.pinned -= batch->pins * sizeof(*batch->pin);
	free(batch->pin);
	batch->pin = NULL;
	batch->pins = batch->pins_sent = batch->pins_cap = batch->pinned = 0;
}

/* The client hears ABORT once the frame at hand is through. */
static void batch_abort(struct publisher_client *client)
{
	pins_release(client->publisher, &client->batch);
	client->batch.cursor = NULL;
	client->batch.aborting = client->batch.active;
}

/* It is for the client to be slow, not for the server to remember: the next batch begins at the newest step. */
static void batch_abort_slow(struct publisher_client *client)
{
	batch_abort(client);
	client->stats.aborts++;
	if (++client->aborts_running == PUBLISHER_ABORTS_MAX)
		publisher_dismiss(client, "too slow: three batches running had to be aborted; read faster or "
		                          "connect again");
}

/* False when memory is out. The list has room. */
static bool batch_pin(struct publisher *p, struct batch *batch, const struct entry *entry)
{
	if (batch->pins == batch->pins_cap) {
		size_t cap = batch->pins_cap ? batch->pins_cap * 2 : 64;
		struct pin *grown;

		cap = cap > PINS_MAX ? PINS_MAX : cap;
		grown = realloc(batch->pin, cap * sizeof(*grown));
		if (!grown)
			return false;
		batch->pin = grown;
		batch->pins_cap = cap;
	}
	batch->pin[batch->pins++] = (struct pin){entry->key, entry->sheet};
	batch->pinned += sizeof(*batch->pin);
	p->stats.pinned += sizeof(*batch->pin);
	if (entry->sheet) {
		entry->sheet->references++;
		batch->pinned += entry->sheet->len;
	}
	return true;
}

/* `entry` is about to change: batches that still need it as it is pin it, cursors step off it. */
static void before_change(struct publisher *p, struct entry *entry)
{
	for (struct publisher_client *client = p->clients; client; client = client->next) {
		struct batch *batch = &client->batch;
		bool unsent = batch->active && !batch->aborting && batch->cursor &&
		              entry->sequence >= batch->cursor->sequence && entry->sequence <= batch->end;
		bool needed = unsent && (entry->sheet || !batch->reset);

		if (batch->cursor == entry)
			batch->cursor = entry->newer;
		if (batch->cursor && batch->cursor->sequence > batch->end)
			batch->cursor = NULL;
		if (needed && batch->pins == PINS_MAX)
			batch_abort_slow(client);
		else if (needed && !batch_pin(p, batch, entry))
			batch_abort(client);
	}
}

/* The newest sheet of an entry takes its place. */
static void change_entry(struct publisher *p, struct entry *entry, struct sheet *sheet)
{
	struct sheet *old = entry->sheet;

	if (old) {
		p->stats.patches--;
		p->stats.bytes -= old->len;
		p->stats.faces -= old->faces;
		p->stats.faces_raw -= old->faces_raw;
		old->orphan = true;
		p->stats.pinned += old->len;
		sheet_unref(p, old);
	}
	entry->sheet = sheet;
	if (sheet) {
		p->stats.patches++;
		p->stats.bytes += sheet->len;
		p->stats.faces += sheet->faces;
		p->stats.faces_raw += sheet->faces_raw;
	}
}

static int publish_patch(struct publisher *p, const struct patch *patch, uint32_t faces_raw)
{
	struct sheet *sheet = NULL;
	bool is_new = false;
	struct entry *entry = touch_entry(p, patch->key, &is_new);

	if (!entry)
		return -ENOMEM;
	if (patch->nt > 0) {
		sheet = sheet_create(p, patch, faces_raw);
		if (!sheet)
			return -ENOMEM;
	}
	if (!is_new) {
		before_change(p, entry);
		unlink_entry(p, entry);
	}
	change_entry(p, entry, sheet);
	link_newest(p, entry);
	return 0;
}

/* Aborts the batches that pin most until what lives for pins alone is within its limit. */
static void limit_pins(struct publisher *p)
{
	size_t max = p->params.pinned_max ? p->params.pinned_max : PUBLISHER_PINNED_MAX;

	while (p->stats.pinned > max) {
		struct publisher_client *most = NULL;

		for (struct publisher_client *client = p->clients; client; client = client->next)
			if (client->batch.pinned > 0 && (!most || client->batch.pinned > most->batch.pinned))
				most = client;
		if (!most)
			return; /* what is left are frames half written, one a client */
		batch_abort_slow(most);
	}
}

static uint64_t behind(const struct publisher_client *client)
{
	uint64_t step = client->publisher->step;

	return step > client->committed_step ? step - client->committed_step : 0;
}

int publisher_publish(struct publisher *p, uint64_t step, struct patch *const *patches, const uint32_t *faces_raw,
                      size_t n)
{
	int r = 0;

	assert(step >= p->step);
	for (size_t i = 0; i < n && r == 0; i++)
		r = publish_patch(p, patches[i], faces_raw ? faces_raw[i] : 0);
	p->step = step;
	limit_pins(p);
	for (struct publisher_client *client = p->clients; client; client = client->next)
		if (client->stats.behind_peak < behind(client))
			client->stats.behind_peak = behind(client);
	return r;
}

static void drop_entries(struct publisher *p)
{
	struct entry *entry;

	while ((entry = p->oldest) != NULL) {
		p->oldest = entry->newer;
		change_entry(p, entry, NULL);
		free(entry);
	}
	p->newest = NULL;
	p->entries = 0;
	if (p->slots)
		memset(p->slot, 0, p->slots * sizeof(*p->slot));
}

static void abort_batches(struct publisher *p)
{
	for (struct publisher_client *client = p->clients; client; client = client->next) {
		batch_abort(client);
		client->greeted = false;
	}
}

void publisher_reset(struct publisher *p)
{
	abort_batches(p);
	drop_entries(p);
	p->generation++;
	p->step = 0;
}

/* A map that has ended */

struct publisher_old {
	size_t n;
	struct sheet *sheet[];
};

/* The sheet of an entry, whose only owner is then the caller; one that a client is being sent is copied, since references
 * are counted by the loop alone. NULL when memory is out. */
static struct sheet *detach_sheet(struct publisher *p, struct entry *entry)
{
	struct sheet *sheet = entry->sheet, *copy;

	if (sheet->references > 1) {
		copy = malloc(sizeof(*copy) + sheet->len);
		if (copy)
			memcpy(copy, sheet, sizeof(*copy) + sheet->len);
		return copy;
	}
	sheet->references++;
	change_entry(p, entry, NULL);
	p->stats.pinned -= sheet->len; /* it lives, but not here */
	return sheet;
}

struct publisher_old *publisher_begin_map(struct publisher *p, const uint8_t map_id[16])
{
	struct publisher_old *old = malloc(sizeof(*old) + p->stats.patches * sizeof(struct sheet *));

	abort_batches(p);
	if (old)
		old->n = 0;
	for (struct entry *entry = p->oldest; entry && old; entry = entry->newer) {
		struct sheet *sheet = entry->sheet ? detach_sheet(p, entry) : NULL;

		if (sheet)
			old->sheet[old->n++] = sheet;
		else if (entry->sheet) { /* half a map is none */
			publisher_old_destroy(old);
			old = NULL;
		}
	}
	publisher_reset(p);
	memcpy(p->params.map_id, map_id, sizeof(p->params.map_id));
	return old;
}

size_t publisher_old_count(const struct publisher_old *old)
{
	return old->n;
}

const uint8_t *publisher_old_frame(const struct publisher_old *old, size_t i, size_t *ret_len)
{
	*ret_len = old->sheet[i]->len;
	return old->sheet[i]->bytes;
}

void publisher_old_destroy(struct publisher_old *old)
{
	for (size_t i = 0; old && i < old->n; i++)
		free(old->sheet[i]);
	free(old);
}

/* What a client is sent */

static void send_small(struct publisher_client *client)
{
	client->source = client->small.data;
	client->source_left = client->small.len;
	if (client->small.error) {
		client->source_left = 0;
		client->broken = true;
	}
}

static void send_sheet(struct publisher_client *client, struct sheet *sheet)
{
	sheet->references++;
	client->source_sheet = sheet;
	client->source = sheet->bytes;
	client->source_left = sheet->len;
}

static void send_hello(struct publisher_client *client, int64_t t_ns)
{
	const struct publisher *p = client->publisher;
	struct native_hello hello = {.major = NATIVE_MAJOR,
	                             .minor = NATIVE_MINOR,
	                             .generation = p->generation,
	                             .cell_m = p->params.cell_m,
	                             .step = p->step,
	                             .t_ns = t_ns};

	memcpy(hello.map_id, p->params.map_id, sizeof(hello.map_id));
	native_put_hello(&client->small, &hello);
	send_small(client);
	client->greeted = client->whole = true;
	client->aborts_running = 0;
}

/* Everything behind what the client committed, as of now. */
static void send_begin(struct publisher_client *client)
{
	const struct publisher *p = client->publisher;
	struct native_begin begin = {.step = p->step, .reset = client->whole};
	struct batch *batch = &client->batch;
	uint64_t from = client->whole ? 0 : client->committed;

	batch->active = true;
	batch->aborting = false;
	batch->reset = client->whole;
	batch->begin = from;
	batch->end = p->sequence;
	batch->step = p->step;
	batch->cursor = NULL;
	for (struct entry *entry = p->newest; entry && entry->sequence > from; entry = entry->older) {
		batch->cursor = entry;
		begin.patches += entry->sheet != NULL;
		begin.removals += !entry->sheet && !client->whole;
	}
	native_put_begin(&client->small, &begin);
	send_small(client);
}

static void send_removal(struct publisher_client *client, struct patch_key key)
{
	native_put_remove(&client->small, key);
	send_small(client);
}

/* Sends the entry at the cursor and steps on; a removal means nothing to one who begins anew. */
static void send_entry(struct publisher_client *client)
{
	struct batch *batch = &client->batch;
	struct entry *entry = batch->cursor;

	batch->cursor = entry->newer && entry->newer->sequence <= batch->end ? entry->newer : NULL;
	if (entry->sheet)
		send_sheet(client, entry->sheet);
	else if (!batch->reset)
		send_removal(client, entry->key);
}

static void send_pin(struct publisher_client *client)
{
	struct batch *batch = &client->batch;
	struct pin *pin = &batch->pin[batch->pins_sent++];

	if (!pin->sheet) {
		send_removal(client, pin->key);
		return;
	}
	batch->pinned -= pin->sheet->len;
	send_sheet(client, pin->sheet);
	sheet_unref(client->publisher, pin->sheet);
}

static void send_end(struct publisher_client *client)
{
	struct batch *batch = &client->batch;

	native_put_step(&client->small, batch->aborting ? NATIVE_ABORT : NATIVE_COMMIT, batch->step);
	send_small(client);
	pins_release(client->publisher, batch);
	batch->active = false;
	if (batch->aborting)
		return;
	client->committed = batch->end;
	client->committed_step = batch->step;
	client->whole = false;
	client->aborts_running = 0;
	client->stats.batches++;
}

static void send_reason(struct publisher_client *client)
{
	char text[256];
	int n = snprintf(text, sizeof(text), "{\"class\":\"ERROR\",\"error\":\"%s\"}", client->reason);

	if (!client->greeted)
		client->json.len = 0; /* answers come after HELLO, which it will not get */
	native_put_json(&client->small, text, (size_t)n);
	send_small(client);
	client->reason_sent = true;
}

static void send_json(struct publisher_client *client)
{
	struct buffer empty = client->small;

	client->small = client->json;
	client->json = empty;
	client->json.len = 0;
	send_small(client);
}

/* Chooses the next frame; false: nothing is to be sent now. */
static bool send_next(struct publisher_client *client, int64_t t_ns)
{
	const struct publisher *p = client->publisher;
	struct batch *batch = &client->batch;

	client->small.len = 0;
	if (client->broken)
		return false;
	if (client->json.len > 0 && client->greeted)
		send_json(client);
	else if (client->reason_sent)
		return false;
	else if (batch->active && batch->aborting)
		send_end(client);
	else if (client->dismissed)
		send_reason(client);
	else if (batch->active && batch->cursor)
		send_entry(client);
	else if (batch->active && batch->pins_sent < batch->pins)
		send_pin(client);
	else if (batch->active)
		send_end(client);
	else if (!client->greeted)
		send_hello(client, t_ns);
	else if (client->whole || client->committed != p->sequence || client->committed_step != p->step)
		send_begin(client);
	else
		return false;
	return true;
}

static void fill(struct publisher_client *client, int64_t t_ns)
{
	client->out_at = client->out_len = 0;
	while (client->out_len < OUT_BYTES) {
		size_t n = OUT_BYTES - client->out_len;

		if (client->source_left == 0 && !send_next(client, t_ns))
			return;
		if (n > client->source_left)
			n = client->source_left;
		memcpy(client->out + client->out_len, client->source, n);
		client->out_len += n;
		client->source += n;
		client->source_left -= n;
		if (client->source_left == 0 && client->source_sheet) {
			sheet_unref(client->publisher, client->source_sheet);
			client->source_sheet = NULL;
		}
	}
}

size_t publisher_peek(struct publisher_client *client, int64_t t_ns, const uint8_t **ret)
{
	size_t n, burst = client->bytes_per_s / 10 + 64;

	if (client->bytes_per_s && t_ns < client->next_ns)
		return 0;
	if (client->out_at == client->out_len)
		fill(client, t_ns);
	n = client->out_len - client->out_at;
	*ret = client->out + client->out_at;
	return client->bytes_per_s && n > burst ? burst : n;
}

void publisher_wrote(struct publisher_client *client, size_t n, int64_t t_ns)
{
	assert(n <= client->out_len - client->out_at);
	client->out_at += n;
	client->stats.sent += n;
	if (client->bytes_per_s) {
		int64_t from = client->next_ns > t_ns ? client->next_ns : t_ns;

		client->next_ns = from + (int64_t)(n * 1000000000ull / client->bytes_per_s);
	}
}

int64_t publisher_deadline(const struct publisher_client *client)
{
	return client->bytes_per_s ? client->next_ns : INT64_MAX;
}

size_t publisher_json_room(const struct publisher_client *client)
{
	size_t used = client->json.len + NATIVE_HEAD + 1;

	return used > PUBLISHER_JSON_MAX || client->dismissed ? 0 : PUBLISHER_JSON_MAX - used;
}

bool publisher_json(struct publisher_client *client, const char *text, size_t len)
{
	if (client->dismissed || len > publisher_json_room(client)) {
		client->stats.skipped_json++;
		return false;
	}
	native_put_json(&client->json, text, len);
	return true;
}

void publisher_ping(struct publisher_client *client)
{
	if (client->json.len + NATIVE_HEAD <= PUBLISHER_JSON_MAX)
		native_put_ping(&client->json);
}

/* Clients */

void publisher_dismiss(struct publisher_client *client, const char *reason)
{
	if (client->dismissed)
		return;
	client->dismissed = true;
	snprintf(client->reason, sizeof(client->reason), "%s", reason);
	batch_abort(client);
}

const char *publisher_reason(const struct publisher_client *client)
{
	return client->dismissed ? client->reason : client->broken ? "no memory for a message" : NULL;
}

bool publisher_done(const struct publisher_client *client)
{
	return client->broken || (client->reason_sent && client->source_left == 0 &&
	                          client->out_at == client->out_len && client->json.len == 0);
}

void publisher_want(struct publisher_client *client, const struct native_want *want)
{
	static const char text[] =
	    "{\"class\":\"NOTICE\",\"message\":\"this version serves planes, coded patches, boxes and radii "
	    "not yet: the whole map comes as plain patches\"}";

	client->bytes_per_s = want->bytes_per_s;
	if (want->flags & (1 | 2 | 4 | 8))
		publisher_json(client, text, sizeof(text) - 1);
}

struct publisher_client *publisher_join(struct publisher *p, const struct native_want *want)
{
	struct publisher_client *client = calloc(1, sizeof(*client));

	if (!client)
		return NULL;
	client->publisher = p;
	client->next = p->clients;
	p->clients = client;
	p->stats.clients++;
	publisher_want(client, want);
	return client;
}

void publisher_leave(struct publisher_client *client)
{
	struct publisher *p = client->publisher;
	struct publisher_client **at = &p->clients;

	while (*at != client)
		at = &(*at)->next;
	*at = client->next;
	p->stats.clients--;
	pins_release(p, &client->batch);
	sheet_unref(p, client->source_sheet);
	buffer_finish(&client->small);
	buffer_finish(&client->json);
	free(client);
}

void publisher_client_stats(const struct publisher_client *client, struct publisher_client_stats *ret)
{
	*ret = client->stats;
	ret->step = client->committed_step;
	ret->behind_steps = behind(client);
	ret->queued = client->out_len - client->out_at + client->source_left + client->json.len + client->batch.pinned;
}

struct publisher *publisher_create(const struct publisher_params *params)
{
	struct publisher *p = calloc(1, sizeof(*p));

	if (!p)
		return NULL;
	p->params = *params;
	p->generation = 1;
	return p;
}

void publisher_destroy(struct publisher *p)
{
	if (!p)
		return;
	assert(!p->clients);
	drop_entries(p);
	buffer_finish(&p->encoded);
	free(p->slot);
	free(p);
}

void publisher_stats(const struct publisher *p, struct publisher_stats *ret)
{
	*ret = p->stats;
	ret->step = p->step;
	ret->generation = p->generation;
}

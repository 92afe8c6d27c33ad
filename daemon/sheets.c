/* The store keeps of every patch its newest *sheet*: the PATCH frame as it goes over the wire, encoded once for all
 * clients. Entries stand in one list in the order of their last change; a change moves its entry to the end and gives it
 * the next sequence number. So "what a client misses" is the end of the list behind the number it last committed,
 * and costs what changed, not what there is. They also stand in chunks in the order in which they came, for whoever must
 * see all of them: that runs through memory, the list would jump about in it.
 *
 * Entries of patches that are gone stay, as the memory of their removal: there can be no more of them than the map,
 * which has a cap, ever had patches. Sequence numbers serve where steps would not: two sets may have one step.
 *
 * Other *forms* of a sheet are made from its frame when somebody first asks, and kept up to a limit; beyond, the one used
 * longest ago goes, and is made again if somebody asks again. A sheet that was replaced keeps its forms while it is
 * held: all clients in the middle of a batch will ask for them.
 *
 * A batch sends the map as it was when it began. So what an entry was is kept when it changes (a *past*) as long as a batch
 * that began before has still to send it: once for all of them. As of a batch, an entry is its newest state that is not
 * newer than the batch. */
#include "daemon/sheets.h"

#include <assert.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>

/* Forms */

void form_unref(struct form *form)
{
	if (form && --form->references == 0)
		free(form);
}

static void form_link(struct sheets *s, struct form *form)
{
	form->newer = NULL;
	form->older = s->form_newest;
	*(s->form_newest ? &s->form_newest->newer : &s->form_oldest) = form;
	s->form_newest = form;
}

static void form_unlink(struct sheets *s, struct form *form)
{
	*(form->older ? &form->older->newer : &s->form_oldest) = form->newer;
	*(form->newer ? &form->newer->older : &s->form_newest) = form->older;
}

/* The store keeps it no more; who sends it still does. */
static void form_drop(struct sheets *s, struct form *form)
{
	form_unlink(s, form);
	form->sheet->form[form->kind] = NULL;
	form->sheet = NULL;
	s->stats.forms_bytes -= form->len;
	form_unref(form);
}

struct native_packer *sheets_packer(struct sheets *s)
{
	if (!s->packer)
		s->packer = native_packer_create();
	return s->packer;
}

static void pack(struct sheets *s, const struct sheet *sheet)
{
	if (sheets_packer(s))
		native_put_packed(s->packer, &s->scratch, sheet->bytes, sheet->len);
	else
		s->scratch.error = -ENOMEM;
}

/* Its own frame is valid: only memory can fail. */
static void encode(struct sheets *s, const struct sheet *sheet, enum publisher_form kind)
{
	struct native_message message;
	char error[128];

	if (native_decode(sheet->bytes, sheet->len, &message, error) < 0) {
		s->scratch.error = -ENOMEM;
		return;
	}
	s->encoder[kind].encode(s->encoder[kind].ctx, &s->scratch, message.patch);
	native_message_finish(&message);
}

/* Into the scratch buffer; false when memory is out. */
static bool make_form(struct sheets *s, const struct sheet *sheet, enum publisher_form kind)
{
	s->scratch.len = 0;
	s->stats.encodes[kind]++;
	if (kind == PUBLISHER_PACKED)
		pack(s, sheet);
	else
		encode(s, sheet, kind);
	if (!s->scratch.error)
		return true;
	buffer_finish(&s->scratch);
	s->scratch = (struct buffer){0};
	return false;
}

static struct form *form_create(struct sheets *s, struct sheet *sheet, enum publisher_form kind)
{
	struct form *form = NULL;

	if (make_form(s, sheet, kind))
		form = malloc(sizeof(*form) + s->scratch.len);
	if (!form)
		return NULL;
	*form = (struct form){.references = 1, .kind = kind, .sheet = sheet, .len = s->scratch.len};
	if (form->len > 0)
		memcpy(form->bytes, s->scratch.data, form->len);
	sheet->form[kind] = form;
	s->stats.forms_bytes += form->len;
	form_link(s, form);
	while (s->stats.forms_bytes > s->forms_max && s->form_oldest != form)
		form_drop(s, s->form_oldest);
	return form;
}

struct form *sheets_form(struct sheets *s, struct sheet *sheet, enum publisher_form kind)
{
	struct form *form = sheet->form[kind];

	assert(kind == PUBLISHER_PACKED || s->encoder[kind].encode);
	if (!form) {
		form = form_create(s, sheet, kind);
	} else if (form->newer) {
		form_unlink(s, form);
		form_link(s, form);
	}
	if (form)
		form->references++;
	return form;
}

/* Sheets */

static void drop_forms(struct sheets *s, struct sheet *sheet)
{
	for (int i = 0; i < PUBLISHER_FORMS; i++)
		if (sheet->form[i])
			form_drop(s, sheet->form[i]);
}

void sheet_unref(struct sheets *s, struct sheet *sheet)
{
	if (!sheet || --sheet->references > 0)
		return;
	if (sheet->orphan)
		s->stats.pinned -= sheet->len;
	drop_forms(s, sheet);
	free(sheet);
}

struct sheet *sheet_create(struct sheets *s, const struct patch *patch, uint32_t faces_raw)
{
	struct sheet *sheet = NULL;

	s->scratch.len = 0;
	native_put_patch(&s->scratch, patch);
	if (!s->scratch.error)
		sheet = malloc(sizeof(*sheet) + s->scratch.len);
	if (sheet) {
		*sheet = (struct sheet){.references = 1,
		                        .faces = patch->nt,
		                        .faces_raw = faces_raw,
		                        .version = patch->version,
		                        .t_last_ns = patch->t_last_ns,
		                        .len = s->scratch.len};
		memcpy(sheet->bytes, s->scratch.data, s->scratch.len);
		s->stats.encodes[PUBLISHER_NATIVE]++;
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

static int grow_slots(struct sheets *s)
{
	size_t slots = s->slots ? s->slots * 2 : 256;
	struct entry **slot = calloc(slots, sizeof(*slot));

	if (!slot)
		return -ENOMEM;
	for (size_t i = 0; i < s->entries; i++)
		*find_slot(slot, slots, sheets_entry(s, i)->key) = sheets_entry(s, i);
	free(s->slot);
	s->slot = slot;
	s->slots = slots;
	return 0;
}

static int grow_chunks(struct sheets *s)
{
	struct entry **chunk = s->chunk;

	if ((s->chunks & (s->chunks - 1)) == 0) { /* 0 or a power of two: the array is full */
		chunk = realloc(s->chunk, (s->chunks ? s->chunks * 2 : 1) * sizeof(struct entry *));
		if (!chunk)
			return -ENOMEM;
		s->chunk = chunk;
	}
	chunk[s->chunks] = malloc(SHEETS_CHUNK * sizeof(struct entry));
	if (!chunk[s->chunks])
		return -ENOMEM;
	s->chunks++;
	return 0;
}

struct entry *sheets_touch(struct sheets *s, struct patch_key key)
{
	struct entry **slot;

	if (2 * s->entries >= s->slots && grow_slots(s) < 0)
		return NULL;
	slot = find_slot(s->slot, s->slots, key);
	if (!*slot) {
		if (s->entries == s->chunks * SHEETS_CHUNK && grow_chunks(s) < 0)
			return NULL;
		*slot = sheets_entry(s, s->entries++);
		**slot = (struct entry){.key = key};
	}
	return *slot;
}

/* What was */

int sheets_keep(struct sheets *s, struct entry *entry, struct past **list)
{
	struct past *past = malloc(sizeof(*past));

	if (!past)
		return -ENOMEM;
	*past = (struct past){.entry = entry,
	                      .sequence = entry->sequence,
	                      .until = s->sequence + 1,
	                      .sheet = entry->sheet,
	                      .older = entry->past,
	                      .next = *list};
	if (past->sheet)
		past->sheet->references++;
	if (past->older)
		past->older->newer = past;
	entry->past = *list = past;
	s->pasts++;
	s->stats.pinned += sizeof(*past);
	return 0;
}

void sheets_let_go(struct sheets *s, struct past *past)
{
	*(past->newer ? &past->newer->older : &past->entry->past) = past->older;
	if (past->older)
		past->older->newer = past->newer;
	s->pasts--;
	s->stats.pinned -= sizeof(*past);
	sheet_unref(s, past->sheet);
	free(past);
}

bool sheets_as_of(const struct entry *entry, uint64_t sequence, uint64_t *ret_changed, struct sheet **ret_sheet)
{
	const struct past *past = entry->past;

	if (entry->sequence <= sequence) {
		*ret_changed = entry->sequence;
		*ret_sheet = entry->sheet;
		return true;
	}
	while (past && past->sequence > sequence)
		past = past->older;
	if (!past || past->until <= sequence)
		return false;
	*ret_changed = past->sequence;
	*ret_sheet = past->sheet;
	return true;
}

/* The store's own reference moves from the old sheet to the new one. */
static void replace_sheet(struct sheets *s, struct entry *entry, struct sheet *sheet)
{
	struct sheet *old = entry->sheet;

	if (old) {
		s->stats.patches--;
		s->stats.bytes -= old->len;
		s->stats.faces -= old->faces;
		s->stats.faces_raw -= old->faces_raw;
		old->orphan = true;
		s->stats.pinned += old->len;
		sheet_unref(s, old);
	}
	entry->sheet = sheet;
	if (sheet) {
		s->stats.patches++;
		s->stats.bytes += sheet->len;
		s->stats.faces += sheet->faces;
		s->stats.faces_raw += sheet->faces_raw;
	}
}

void sheets_change(struct sheets *s, struct entry *entry, struct sheet *sheet)
{
	replace_sheet(s, entry, sheet);
	if (entry->sequence > 0) {
		*(entry->older ? &entry->older->newer : &s->oldest) = entry->newer;
		*(entry->newer ? &entry->newer->older : &s->newest) = entry->older;
	}
	entry->sequence = ++s->sequence;
	entry->newer = NULL;
	entry->older = s->newest;
	*(s->newest ? &s->newest->newer : &s->oldest) = entry;
	s->newest = entry;
}

struct sheet *sheets_detach(struct sheets *s, struct entry *entry)
{
	struct sheet *sheet = entry->sheet, *copy;

	if (sheet->references > 1) {
		copy = malloc(sizeof(*copy) + sheet->len);
		if (!copy)
			return NULL;
		memcpy(copy, sheet, sizeof(*copy) + sheet->len);
		memset(copy->form, 0, sizeof(copy->form));
		copy->references = 1;
		return copy;
	}
	drop_forms(s, sheet);
	sheet->references++;
	replace_sheet(s, entry, NULL);
	s->stats.pinned -= sheet->len; /* it lives, but not here */
	return sheet;
}

void sheets_clear(struct sheets *s)
{
	assert(s->pasts == 0);
	for (size_t i = 0; i < s->entries; i++)
		replace_sheet(s, sheets_entry(s, i), NULL);
	while (s->chunks > 0)
		free(s->chunk[--s->chunks]);
	free(s->chunk);
	s->chunk = NULL;
	s->entries = 0;
	s->oldest = s->newest = NULL;
	if (s->slots)
		memset(s->slot, 0, s->slots * sizeof(*s->slot));
}

void sheets_finish(struct sheets *s)
{
	sheets_clear(s);
	buffer_finish(&s->scratch);
	native_packer_destroy(s->packer);
	free(s->slot);
}

/* The newest state of every patch, as it goes over the wires, in the order of the last change. */
#ifndef FACET_DAEMON_SHEETS_H
#define FACET_DAEMON_SHEETS_H

#include "daemon/publisher.h"

struct sheet;

/* A sheet made into another form. Counted: one reference by the store while it keeps it, one by each that sends it. */
struct form {
	unsigned references;
	enum publisher_form kind;
	struct sheet *sheet; /* NULL: the store keeps it no more */
	struct form *older, *newer;
	size_t len;
	uint8_t bytes[];
};

/* One patch at one version. Counted: by the store, by pins and by those that send it. */
struct sheet {
	unsigned references;
	bool orphan; /* the store has a newer one: it lives only because it is pinned */
	uint32_t faces, faces_raw;
	uint64_t version;
	int64_t t_last_ns;
	struct form *form[PUBLISHER_FORMS]; /* that of NATIVE is always NULL: it is `bytes` */
	size_t len;
	uint8_t bytes[]; /* a PATCH frame */
};

/* What an entry was before a change, kept while a batch that began earlier has still to send it: once for all such batches,
 * in the list of one of them. */
struct past {
	struct entry *entry;
	uint64_t sequence, until;   /* of the change that made it, of the one that ended it */
	struct sheet *sheet;        /* counted; NULL: the patch was gone */
	struct past *older, *newer; /* of the entry */
	struct past *next;          /* of the list */
};

/* What became of a key. Entries stay where they are, and when their patch is gone, until the map ends. */
struct entry {
	struct patch_key key;
	uint64_t sequence;   /* of its last change */
	struct sheet *sheet; /* NULL: the patch is gone */
	struct entry *older, *newer;
	struct past *past; /* the newest */
};

struct sheets {
	struct entry **slot; /* open addressing by key, a power of two, at most half full */
	size_t slots;
	struct entry **chunk; /* entries in the order in which their keys came, SHEETS_CHUNK each */
	size_t chunks, entries;
	struct entry *oldest, *newest;
	uint64_t sequence;                      /* of the newest change */
	size_t pasts;                           /* kept ones */
	struct form *form_oldest, *form_newest; /* kept ones, by their last use */
	size_t forms_max;
	struct publisher_encoder encoder[PUBLISHER_FORMS];
	struct native_packer *packer; /* of PUBLISHER_PACKED; NULL: not needed so far */
	struct buffer scratch;
	struct publisher_stats stats; /* patches, bytes, faces, pinned, encodes, forms */
};

#define SHEETS_CHUNK 256

void sheets_clear(struct sheets *);  /* forgets every entry */
void sheets_finish(struct sheets *); /* and the memory */

struct native_packer *sheets_packer(struct sheets *); /* made when it is first asked for; NULL: memory is out */

/* NULL when memory is out. References: 1. */
struct sheet *sheet_create(struct sheets *, const struct patch *, uint32_t faces_raw);
void sheet_unref(struct sheets *, struct sheet *); /* of NULL: nothing */

/* The entry of a key, made (as gone, not linked, sequence 0) if there is none. NULL when memory is out. */
struct entry *sheets_touch(struct sheets *, struct patch_key);
/* `sheet` (or NULL: gone), taken over, takes the place of what the entry holds, as the newest change. */
void sheets_change(struct sheets *, struct entry *, struct sheet *);
/* Keeps what the entry is, which is about to change, at the front of `list`. 0 or -ENOMEM. */
int sheets_keep(struct sheets *, struct entry *, struct past **list);
void sheets_let_go(struct sheets *, struct past *); /* it is in no list */
/* What the entry was when `sequence` was the newest change: its last change up to then, and its sheet (borrowed; NULL:
 * gone). False: it had not come yet, or that was not kept. */
bool sheets_as_of(const struct entry *, uint64_t sequence, uint64_t *ret_changed, struct sheet **ret_sheet);
/* The entry's sheet, to another owner, who frees it; the entry is as if gone. One that somebody else holds is copied.
 * NULL when memory is out. */
struct sheet *sheets_detach(struct sheets *, struct entry *);

static inline struct entry *sheets_entry(const struct sheets *s, size_t i)
{
	return &s->chunk[i / SHEETS_CHUNK][i % SHEETS_CHUNK];
}

/* A sheet in another form than NATIVE, made unless it is kept; a reference for the caller. NULL when memory is out. */
struct form *sheets_form(struct sheets *, struct sheet *, enum publisher_form);
void form_unref(struct form *); /* of NULL: nothing */

#endif

/* The writer of MCAP (core/mcap.h).
 *
 * The open chunk is kept uncompressed, with one list of (log time, offset) per channel in it; closing it compresses it and
 * appends it with those lists as MessageIndex records. What the summary needs is kept as the very records that it consists
 * of: schemas and channels (also repeated in each chunk that uses them), and one ChunkIndex, AttachmentIndex or MetadataIndex each.
 * So memory is one chunk, and about a hundred bytes for each chunk before it.
 *
 * An error (memory) is kept: nothing after it is written, every call answers with it. */
#include "core/mcap.h"

#include <assert.h>
#include <errno.h>
#include <stdlib.h>
#include <zlib.h>
#include <zstd.h>

#include "core/mcap_parts.h"

struct definition { /* a schema or channel as its record */
	struct buffer record;
	uint16_t schema;     /* of a channel */
	bool in_chunk;       /* the open one */
	struct buffer index; /* of a channel: (u64 log time, u64 offset) in the open chunk */
	uint64_t messages;
	uint32_t sequence;
};

struct definitions {
	struct definition *at;
	size_t n, cap;
};

struct mcap_writer {
	struct buffer *out;
	int level, error;
	uint64_t offset;   /* of what comes next */
	uint32_t data_crc; /* of all so far */
	ZSTD_CCtx *zstd;
	struct definitions schemas, channels; /* ids are places, from 1 */
	struct buffer chunk;                  /* the open one, uncompressed */
	uint64_t chunk_start_ns, chunk_end_ns;
	struct buffer chunk_indexes, attachment_indexes, metadata_indexes; /* records of the summary */
	uint32_t chunks, attachments, metadatas;
	uint64_t messages, start_ns, end_ns;
};

/* Numbers and records */

static void put_int(struct buffer *b, uint64_t value, int bytes)
{
	uint8_t le[8];

	for (int i = 0; i < bytes; i++)
		le[i] = (uint8_t)(value >> 8 * i);
	buffer_append(b, le, (size_t)bytes);
}

static void put_text(struct buffer *b, const char *text)
{
	size_t len = strlen(text);

	put_int(b, len, 4);
	buffer_append(b, text, len);
}

/* Overwrites what put_int had left room for. */
static void set_int(struct buffer *b, size_t at, uint64_t value, int bytes)
{
	for (int i = 0; i < bytes && !b->error; i++)
		b->data[at + (size_t)i] = (uint8_t)(value >> 8 * i);
}

static size_t begin_record(struct buffer *b, enum mcap_opcode op)
{
	put_int(b, op, 1);
	put_int(b, 0, 8);
	return b->len;
}

static void end_record(struct buffer *b, size_t begun)
{
	set_int(b, begun - 8, b->len - begun, 8);
}

static void put_pairs(struct buffer *b, const struct mcap_pair *pair, size_t pairs)
{
	size_t at = b->len;

	put_int(b, 0, 4);
	for (size_t i = 0; i < pairs; i++) {
		put_text(b, pair[i].key);
		put_text(b, pair[i].value);
	}
	set_int(b, at, b->len - at - 4, 4);
}

static uint64_t wire_time(int64_t t_ns)
{
	return t_ns > 0 ? (uint64_t)t_ns : 0;
}

/* What was appended to `out` from `from` on is counted. The writer's error, if any buffer had one. */
static int account(struct mcap_writer *w, size_t from)
{
	const struct buffer *all[] = {w->out, &w->chunk, &w->chunk_indexes, &w->attachment_indexes,
	                              &w->metadata_indexes};

	for (size_t i = 0; i < sizeof(all) / sizeof(all[0]) && w->error == 0; i++)
		w->error = all[i]->error;
	if (w->error == 0 && w->out->len > from) {
		w->data_crc = (uint32_t)crc32_z(w->data_crc, w->out->data + from, w->out->len - from);
		w->offset += w->out->len - from;
	}
	return w->error;
}

/* Life */

struct mcap_writer *mcap_writer_create(const struct mcap_params *params, struct buffer *out)
{
	struct mcap_writer *w = calloc(1, sizeof(*w));
	size_t from = out->len, record;

	if (!w)
		return NULL;
	w->out = out;
	w->level = params->level;
	w->start_ns = UINT64_MAX;
	if (w->level != 0)
		w->zstd = ZSTD_createCCtx();
	buffer_append(out, mcap_magic, MCAP_MAGIC);
	record = begin_record(out, OP_HEADER);
	put_text(out, "");
	put_text(out, params->library);
	end_record(out, record);
	if ((w->level == 0 || w->zstd) && account(w, from) == 0)
		return w;
	mcap_writer_destroy(w);
	return NULL;
}

static void definitions_finish(struct definitions *list)
{
	for (size_t i = 0; i < list->n; i++) {
		buffer_finish(&list->at[i].record);
		buffer_finish(&list->at[i].index);
	}
	free(list->at);
}

void mcap_writer_destroy(struct mcap_writer *w)
{
	if (!w)
		return;
	definitions_finish(&w->schemas);
	definitions_finish(&w->channels);
	buffer_finish(&w->chunk);
	buffer_finish(&w->chunk_indexes);
	buffer_finish(&w->attachment_indexes);
	buffer_finish(&w->metadata_indexes);
	ZSTD_freeCCtx(w->zstd);
	free(w);
}

/* Schemas and channels */

/* NULL with w->error, or where there are too many. */
static struct definition *define(struct mcap_writer *w, struct definitions *list)
{
	if (w->error || list->n == MCAP_CHANNELS_MAX)
		return NULL;
	if (list->n == list->cap) {
		size_t cap = list->cap ? list->cap * 2 : 16;
		struct definition *grown = realloc(list->at, cap * sizeof(*grown));

		if (!grown) {
			w->error = -ENOMEM;
			return NULL;
		}
		list->at = grown;
		list->cap = cap;
	}
	list->at[list->n] = (struct definition){.record = {0}};
	return &list->at[list->n++];
}

/* The id of what was just defined. */
static int defined(struct mcap_writer *w, const struct definitions *list, size_t record)
{
	struct definition *definition = &list->at[list->n - 1];

	end_record(&definition->record, record);
	if (definition->record.error)
		w->error = definition->record.error;
	return w->error ? w->error : (int)list->n;
}

int mcap_writer_schema(struct mcap_writer *w, const char *name, const char *encoding, const void *data, size_t len)
{
	struct definition *schema = define(w, &w->schemas);
	size_t record;

	if (!schema)
		return w->error ? w->error : -EMFILE;
	record = begin_record(&schema->record, OP_SCHEMA);
	put_int(&schema->record, w->schemas.n, 2);
	put_text(&schema->record, name);
	put_text(&schema->record, encoding);
	put_int(&schema->record, len, 4);
	buffer_append(&schema->record, data, len);
	return defined(w, &w->schemas, record);
}

int mcap_writer_channel(struct mcap_writer *w, int schema, const char *topic, const char *encoding,
                        const struct mcap_pair *pair, size_t pairs)
{
	struct definition *channel = define(w, &w->channels);
	size_t record;

	assert(schema >= 0 && (size_t)schema <= w->schemas.n);
	if (!channel)
		return w->error ? w->error : -EMFILE;
	channel->schema = (uint16_t)schema;
	record = begin_record(&channel->record, OP_CHANNEL);
	put_int(&channel->record, w->channels.n, 2);
	put_int(&channel->record, (uint64_t)schema, 2);
	put_text(&channel->record, topic);
	put_text(&channel->record, encoding);
	put_pairs(&channel->record, pair, pairs);
	return defined(w, &w->channels, record);
}

/* Chunks */

static void repeat(struct mcap_writer *w, struct definition *definition)
{
	if (!definition->in_chunk)
		buffer_append(&w->chunk, definition->record.data, definition->record.len);
	definition->in_chunk = true;
}

int mcap_writer_message(struct mcap_writer *w, const struct mcap_message *m)
{
	struct definition *channel = &w->channels.at[m->channel - 1];
	uint64_t log_ns = wire_time(m->log_ns);
	size_t record;

	assert(m->channel >= 1 && m->channel <= w->channels.n);
	if (m->head_len > MCAP_RECORD_MAX / 2 || m->len > MCAP_RECORD_MAX / 2)
		return -EMSGSIZE;
	if (w->error)
		return w->error;
	if (w->chunk.len == 0)
		w->chunk_start_ns = w->chunk_end_ns = log_ns;
	if (channel->schema > 0)
		repeat(w, &w->schemas.at[channel->schema - 1]);
	repeat(w, channel);
	put_int(&channel->index, log_ns, 8);
	put_int(&channel->index, w->chunk.len, 8);
	record = begin_record(&w->chunk, OP_MESSAGE);
	put_int(&w->chunk, m->channel, 2);
	put_int(&w->chunk, channel->sequence++, 4);
	put_int(&w->chunk, log_ns, 8);
	put_int(&w->chunk, wire_time(m->publish_ns), 8);
	buffer_append(&w->chunk, m->head, m->head_len);
	buffer_append(&w->chunk, m->data, m->len);
	end_record(&w->chunk, record);
	w->chunk_start_ns = log_ns < w->chunk_start_ns ? log_ns : w->chunk_start_ns;
	w->chunk_end_ns = log_ns > w->chunk_end_ns ? log_ns : w->chunk_end_ns;
	channel->messages++;
	w->messages++;
	if (channel->index.error || w->chunk.error)
		w->error = -ENOMEM;
	return w->error;
}

size_t mcap_writer_open_bytes(const struct mcap_writer *w)
{
	return w->chunk.len;
}

int64_t mcap_writer_open_ns(const struct mcap_writer *w)
{
	return (int64_t)w->chunk_start_ns;
}

/* Appends the chunk's records; how many bytes they took. */
static size_t put_compressed(struct mcap_writer *w)
{
	struct buffer *out = w->out;
	size_t at = out->len + 8, n, bound = ZSTD_compressBound(w->chunk.len);

	put_int(out, w->chunk.len, 8);
	if (w->level == 0) {
		buffer_append(out, w->chunk.data, w->chunk.len);
		return w->chunk.len;
	}
	if (!buffer_reserve(out, bound))
		return 0;
	n = ZSTD_compressCCtx(w->zstd, out->data + at, bound, w->chunk.data, w->chunk.len, w->level);
	if (ZSTD_isError(n)) {
		w->error = -ENOMEM; /* the only thing that can go wrong with this much room */
		return 0;
	}
	out->len = at + n;
	set_int(out, at - 8, n, 8);
	return n;
}

/* The channels' lists, each noted in the chunk's index. */
static void put_message_indexes(struct mcap_writer *w, size_t from)
{
	struct buffer *out = w->out, *index = &w->chunk_indexes;
	size_t map = index->len;

	put_int(index, 0, 4);
	for (size_t i = 0; i < w->channels.n; i++) {
		struct definition *channel = &w->channels.at[i];
		size_t record;

		if (!channel->in_chunk)
			continue;
		put_int(index, i + 1, 2);
		put_int(index, w->offset + (out->len - from), 8);
		record = begin_record(out, OP_MESSAGE_INDEX);
		put_int(out, i + 1, 2);
		put_int(out, channel->index.len, 4);
		buffer_append(out, channel->index.data, channel->index.len);
		end_record(out, record);
	}
	set_int(index, map, index->len - map - 4, 4);
}

static void forget_chunk(struct mcap_writer *w)
{
	for (size_t i = 0; i < w->schemas.n; i++)
		w->schemas.at[i].in_chunk = false;
	for (size_t i = 0; i < w->channels.n; i++) {
		w->channels.at[i].in_chunk = false;
		w->channels.at[i].index.len = 0;
	}
	w->start_ns = w->chunk_start_ns < w->start_ns ? w->chunk_start_ns : w->start_ns;
	w->end_ns = w->chunk_end_ns > w->end_ns ? w->chunk_end_ns : w->end_ns;
	w->chunk.len = 0;
	w->chunks++;
}

int mcap_writer_close_chunk(struct mcap_writer *w)
{
	static const char *const compression[] = {"", "zstd"};
	const char *name = compression[w->level != 0];
	struct buffer *out = w->out, *index = &w->chunk_indexes;
	size_t from = out->len, record, entry, compressed, chunk_len;

	if (w->error || w->chunk.len == 0)
		return w->error;
	if (w->chunks == MCAP_CHUNKS_MAX)
		return -EFBIG;
	record = begin_record(out, OP_CHUNK);
	put_int(out, w->chunk_start_ns, 8);
	put_int(out, w->chunk_end_ns, 8);
	put_int(out, w->chunk.len, 8);
	put_int(out, crc32_z(0, w->chunk.data, w->chunk.len), 4);
	put_text(out, name);
	compressed = put_compressed(w);
	end_record(out, record);
	chunk_len = out->len - from;
	entry = begin_record(index, OP_CHUNK_INDEX);
	put_int(index, w->chunk_start_ns, 8);
	put_int(index, w->chunk_end_ns, 8);
	put_int(index, w->offset, 8);
	put_int(index, chunk_len, 8);
	put_message_indexes(w, from);
	put_int(index, out->len - from - chunk_len, 8);
	put_text(index, name);
	put_int(index, compressed, 8);
	put_int(index, w->chunk.len, 8);
	end_record(index, entry);
	forget_chunk(w);
	return account(w, from);
}

/* What is beside the chunks */

int mcap_writer_attach(struct mcap_writer *w, int64_t log_ns, const char *name, const char *media_type,
                       const void *data, size_t len)
{
	struct buffer *out = w->out, *index = &w->attachment_indexes;
	size_t from, record, entry;
	int r = mcap_writer_close_chunk(w);

	if (r < 0)
		return r;
	from = out->len;
	record = begin_record(out, OP_ATTACHMENT);
	put_int(out, wire_time(log_ns), 8);
	put_int(out, wire_time(log_ns), 8);
	put_text(out, name);
	put_text(out, media_type);
	put_int(out, len, 8);
	buffer_append(out, data, len);
	if (!out->error)
		put_int(out, crc32_z(0, out->data + record, out->len - record), 4);
	end_record(out, record);
	entry = begin_record(index, OP_ATTACHMENT_INDEX);
	put_int(index, w->offset, 8);
	put_int(index, out->len - from, 8);
	put_int(index, wire_time(log_ns), 8);
	put_int(index, wire_time(log_ns), 8);
	put_int(index, len, 8);
	put_text(index, name);
	put_text(index, media_type);
	end_record(index, entry);
	w->attachments++;
	return account(w, from);
}

int mcap_writer_metadata(struct mcap_writer *w, const char *name, const struct mcap_pair *pair, size_t pairs)
{
	struct buffer *out = w->out, *index = &w->metadata_indexes;
	size_t from, record, entry;
	int r = mcap_writer_close_chunk(w);

	if (r < 0)
		return r;
	from = out->len;
	record = begin_record(out, OP_METADATA);
	put_text(out, name);
	put_pairs(out, pair, pairs);
	end_record(out, record);
	entry = begin_record(index, OP_METADATA_INDEX);
	put_int(index, w->offset, 8);
	put_int(index, out->len - from, 8);
	put_text(index, name);
	end_record(index, entry);
	w->metadatas++;
	return account(w, from);
}

/* The end */

static void put_statistics(const struct mcap_writer *w, struct buffer *out)
{
	size_t record = begin_record(out, OP_STATISTICS), map;

	put_int(out, w->messages, 8);
	put_int(out, w->schemas.n, 2);
	put_int(out, w->channels.n, 4);
	put_int(out, w->attachments, 4);
	put_int(out, w->metadatas, 4);
	put_int(out, w->chunks, 4);
	put_int(out, w->messages ? w->start_ns : 0, 8);
	put_int(out, w->end_ns, 8);
	map = out->len;
	put_int(out, 0, 4);
	for (size_t i = 0; i < w->channels.n; i++)
		if (w->channels.at[i].messages > 0) {
			put_int(out, i + 1, 2);
			put_int(out, w->channels.at[i].messages, 8);
		}
	set_int(out, map, out->len - map - 4, 4);
	end_record(out, record);
}

static void put_definitions(const struct definitions *list, struct buffer *out)
{
	for (size_t i = 0; i < list->n; i++)
		buffer_append(out, list->at[i].record.data, list->at[i].record.len);
}

/* Where the group that was just written begins and how long it is. */
static void put_offset(struct buffer *offsets, enum mcap_opcode op, uint64_t at, size_t len)
{
	size_t record;

	if (len == 0)
		return;
	record = begin_record(offsets, OP_SUMMARY_OFFSET);
	put_int(offsets, op, 1);
	put_int(offsets, at, 8);
	put_int(offsets, len, 8);
	end_record(offsets, record);
}

/* The groups of the summary into `out`, what says where they are into `offsets`; `start` is where the first begins. */
static void put_summary(const struct mcap_writer *w, struct buffer *out, uint64_t start, struct buffer *offsets)
{
	static const enum mcap_opcode group[] = {OP_SCHEMA,      OP_CHANNEL,          OP_STATISTICS,
	                                         OP_CHUNK_INDEX, OP_ATTACHMENT_INDEX, OP_METADATA_INDEX};
	const struct buffer *kept[] = {&w->chunk_indexes, &w->attachment_indexes, &w->metadata_indexes};
	const size_t begun = out->len;

	for (size_t i = 0; i < sizeof(group) / sizeof(group[0]); i++) {
		size_t at = out->len;

		if (group[i] == OP_SCHEMA)
			put_definitions(&w->schemas, out);
		else if (group[i] == OP_CHANNEL)
			put_definitions(&w->channels, out);
		else if (group[i] == OP_STATISTICS)
			put_statistics(w, out);
		else
			buffer_append(out, kept[i - 3]->data, kept[i - 3]->len);
		put_offset(offsets, group[i], start + (at - begun), out->len - at);
	}
}

int mcap_writer_end(struct mcap_writer *w)
{
	struct buffer *out = w->out, offsets = {0};
	uint64_t start;
	size_t from, summary, record, offsets_at;
	int r = mcap_writer_close_chunk(w);

	if (r < 0)
		return r;
	from = out->len;
	record = begin_record(out, OP_DATA_END);
	put_int(out, w->data_crc, 4);
	end_record(out, record);
	summary = out->len;
	start = w->offset + (summary - from);
	put_summary(w, out, start, &offsets);
	offsets_at = out->len;
	buffer_append(out, offsets.data, offsets.len);
	record = begin_record(out, OP_FOOTER);
	put_int(out, start, 8);
	put_int(out, start + (offsets_at - summary), 8);
	set_int(out, record - 8, MCAP_FOOTER_LEN, 8); /* the CRC covers the footer's head, too */
	if (!out->error)
		put_int(out, crc32_z(0, out->data + summary, out->len - summary), 4);
	buffer_append(out, mcap_magic, MCAP_MAGIC);
	if (offsets.error)
		w->error = offsets.error;
	buffer_finish(&offsets);
	return account(w, from);
}

uint64_t mcap_writer_bytes(const struct mcap_writer *w)
{
	return w->offset;
}

uint64_t mcap_writer_messages(const struct mcap_writer *w)
{
	return w->messages;
}

/* The reader of MCAP (core/mcap.h): whole files, cut ones, damaged ones.
 *
 * Top-level records are walked one after the other; a chunk is decompressed as a whole, its CRC compared, and walked in turn.
 * What cannot be read is passed over and told once, as one item, with the bytes it took:
 *
 *   the record's frame is plausible, its content is not   on behind it, if a record is there
 *   no plausible frame                                    on at the next thing that looks like a chunk: its opcode, and a head
 *                                                         whose lengths, times and compression fit each other
 *   nothing more like that                                the end: the file was cut
 *
 * Searching looks at bytes that are hostile, so all decompressing and summing up that came to nothing is counted, and stops
 * the search beyond WASTE_MAX times the file: reading stays linear in the file. Memory is one chunk and the definitions, each
 * bounded. */
#include "core/mcap.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <zlib.h>
#include <zstd.h>

#include "core/mcap_parts.h"

#define NAMES_BYTES_MAX (32u << 20) /* of all schemas and channels; further ones are damage */
#define TRAILING_MAX    64          /* bytes of a chunk behind its last field */
#define WASTE_MAX       8
#define WASTE_FREE      (4u << 20) /* bytes */

struct mcap_reader {
	const uint8_t *data;
	size_t len, at; /* at: of the next top-level record */
	ZSTD_DCtx *zstd;
	uint8_t *chunk; /* the memory for decompressed ones */
	size_t chunk_cap;
	const uint8_t *open; /* the open chunk's records; NULL: none */
	size_t open_len, open_at;
	uint64_t open_offset, open_end; /* of the chunk in the file */
	struct mcap_channel **channel;  /* by id */
	struct mcap_schema **schema;
	size_t channels, channels_cap, schemas, schemas_cap, names_bytes;
	uint64_t waste;
	bool nomem, summary;
	const char *why; /* the damage at hand */
};

/* A cursor over borrowed bytes; what does not fit makes it bad, and everything after it 0. */
struct cursor {
	const uint8_t *at, *end;
	bool bad;
};

static const uint8_t *take(struct cursor *c, uint64_t n)
{
	const uint8_t *at = c->at;

	if (c->bad || n > (uint64_t)(c->end - c->at)) {
		c->bad = true;
		return NULL;
	}
	c->at += n;
	return at;
}

static uint64_t take_int(struct cursor *c, int bytes)
{
	const uint8_t *at = take(c, (uint64_t)bytes);
	uint64_t value = 0;

	for (int i = 0; at && i < bytes; i++)
		value |= (uint64_t)at[i] << 8 * i;
	return value;
}

static struct mcap_text take_text(struct cursor *c)
{
	size_t len = (size_t)take_int(c, 4);
	const char *at = (const char *)take(c, len);

	return (struct mcap_text){at ? at : "", at ? len : 0};
}

static void take_map(struct cursor *c, struct mcap_map *ret)
{
	size_t len = (size_t)take_int(c, 4);
	const uint8_t *at = take(c, len);
	struct cursor map = {at, at ? at + len : at, false};

	ret->n = 0;
	while (!c->bad && !map.bad && map.at < map.end) {
		struct mcap_text key = take_text(&map), value = take_text(&map);

		if (!map.bad && ret->n < MCAP_PAIRS_MAX) {
			ret->pair[ret->n].key = key;
			ret->pair[ret->n++].value = value;
		}
	}
	c->bad |= map.bad;
}

bool mcap_text_is(struct mcap_text text, const char *word)
{
	return strlen(word) == text.len && memcmp(text.at, word, text.len) == 0;
}

/* Definitions */

/* The place of `id` among n pointers to things that begin with their id, or where it belongs. */
static size_t place(void *const *list, size_t n, uint16_t id)
{
	size_t low = 0;

	while (n > 0) {
		size_t half = n / 2;

		if (*(const uint16_t *)list[low + half] < id) {
			low += half + 1;
			n -= half + 1;
		} else {
			n = half;
		}
	}
	return low;
}

/* `content` is copied behind the new thing. NULL: damage, or memory is out. */
static void *insert(struct mcap_reader *r, void ***list, size_t *n, size_t *cap, size_t at, size_t size,
                    const struct cursor *content)
{
	size_t len = (size_t)(content->end - content->at);
	uint8_t *thing;

	if (*n == MCAP_CHANNELS_MAX || len > NAMES_BYTES_MAX - r->names_bytes) {
		r->why = "too many schemas or channels";
		return NULL;
	}
	if (*n == *cap) {
		size_t more = *cap ? *cap * 2 : 32;
		void **grown = realloc(*list, more * sizeof(*grown));

		r->nomem |= !grown;
		if (!grown)
			return NULL;
		*list = grown;
		*cap = more;
	}
	thing = calloc(1, size + len);
	r->nomem |= !thing;
	if (!thing)
		return NULL;
	memcpy(thing + size, content->at, len);
	memmove(*list + at + 1, *list + at, (*n - at) * sizeof(**list));
	(*list)[at] = thing;
	(*n)++;
	r->names_bytes += len;
	return thing;
}

static bool parse_schema(struct cursor c, struct mcap_schema *ret)
{
	ret->id = (uint16_t)take_int(&c, 2);
	ret->name = take_text(&c);
	ret->encoding = take_text(&c);
	ret->len = (size_t)take_int(&c, 4);
	ret->data = take(&c, ret->len);
	return !c.bad && ret->id != 0;
}

/* False: damage or no memory. Said again, the first one counts. */
static bool define_schema(struct mcap_reader *r, struct cursor content)
{
	const size_t len = (size_t)(content.end - content.at);
	struct mcap_schema schema, *made;
	size_t at;

	if (!parse_schema(content, &schema)) {
		r->why = "a schema that is none";
		return false;
	}
	at = place((void **)r->schema, r->schemas, schema.id);
	if (at < r->schemas && r->schema[at]->id == schema.id)
		return true;
	made = insert(r, (void ***)&r->schema, &r->schemas, &r->schemas_cap, at, sizeof(*made), &content);
	if (!made)
		return false;
	return parse_schema((struct cursor){(uint8_t *)(made + 1), (uint8_t *)(made + 1) + len, false}, made);
}

static bool parse_channel(struct cursor c, struct mcap_channel *ret, uint16_t *ret_schema)
{
	ret->id = (uint16_t)take_int(&c, 2);
	*ret_schema = (uint16_t)take_int(&c, 2);
	ret->topic = take_text(&c);
	ret->encoding = take_text(&c);
	take_map(&c, &ret->metadata);
	return !c.bad;
}

static bool define_channel(struct mcap_reader *r, struct cursor content)
{
	const size_t len = (size_t)(content.end - content.at);
	struct mcap_channel channel, *made;
	uint16_t schema_id = 0;
	size_t at, schema;

	if (!parse_channel(content, &channel, &schema_id)) {
		r->why = "a channel that is none";
		return false;
	}
	at = place((void **)r->channel, r->channels, channel.id);
	if (at < r->channels && r->channel[at]->id == channel.id)
		return true;
	schema = place((void **)r->schema, r->schemas, schema_id);
	if (schema_id != 0 && (schema == r->schemas || r->schema[schema]->id != schema_id)) {
		r->why = "a channel whose schema is not there";
		return false;
	}
	made = insert(r, (void ***)&r->channel, &r->channels, &r->channels_cap, at, sizeof(*made), &content);
	if (!made)
		return false;
	made->schema = schema_id ? r->schema[schema] : NULL;
	return parse_channel((struct cursor){(uint8_t *)(made + 1), (uint8_t *)(made + 1) + len, false}, made,
	                     &schema_id);
}

static bool read_message(struct mcap_reader *r, struct cursor c, struct mcap_item *ret)
{
	uint16_t id = (uint16_t)take_int(&c, 2);
	size_t at = place((void **)r->channel, r->channels, id);

	ret->kind = MCAP_MESSAGE;
	ret->message.sequence = (uint32_t)take_int(&c, 4);
	ret->message.log_ns = take_int(&c, 8);
	ret->message.publish_ns = take_int(&c, 8);
	if (c.bad || at == r->channels || r->channel[at]->id != id) {
		r->why = c.bad ? "a message that is none" : "a message of a channel that is not there";
		return false;
	}
	ret->message.channel = r->channel[at];
	ret->message.channel->messages++;
	ret->message.data = c.at;
	ret->message.len = (size_t)(c.end - c.at);
	return true;
}

/* Frames */

struct frame {
	uint8_t op;
	struct cursor content;
	size_t end; /* in the file, or the chunk */
};

/* False: no whole record is there. */
static bool frame_at(const uint8_t *data, size_t len, size_t at, struct frame *ret)
{
	struct cursor c = {data + at, data + len, false};
	uint64_t n;

	ret->op = (uint8_t)take_int(&c, 1);
	n = take_int(&c, 8);
	if (c.bad || n > (uint64_t)(c.end - c.at) || ret->op == 0 || (ret->op > OP_DATA_END && ret->op < OP_PRIVATE))
		return false;
	ret->content = (struct cursor){c.at, c.at + n, false};
	ret->end = at + MCAP_RECORD_HEAD + (size_t)n;
	return true;
}

struct chunk_head {
	uint64_t start_ns, end_ns, uncompressed;
	uint32_t crc;
	struct mcap_text compression;
	const uint8_t *records;
	size_t len;
};

static bool read_chunk_head(struct cursor c, struct chunk_head *ret)
{
	ret->start_ns = take_int(&c, 8);
	ret->end_ns = take_int(&c, 8);
	ret->uncompressed = take_int(&c, 8);
	ret->crc = (uint32_t)take_int(&c, 4);
	ret->compression = take_text(&c);
	ret->len = (size_t)take_int(&c, 8);
	ret->records = take(&c, ret->len);
	/* What may follow in later versions is little: a damaged length would swallow the chunks behind. */
	return !c.bad && c.end - c.at <= TRAILING_MAX && ret->start_ns <= ret->end_ns &&
	       ret->uncompressed <= MCAP_CHUNK_MAX && ret->compression.len <= 4;
}

static bool is_end(const struct mcap_reader *r, size_t at)
{
	return at == r->len || (r->len - at == MCAP_MAGIC && memcmp(r->data + at, mcap_magic, MCAP_MAGIC) == 0);
}

/* Something that the file may go on with is at `at`. */
static bool plausible(const struct mcap_reader *r, size_t at)
{
	struct chunk_head head;
	struct frame frame;

	if (is_end(r, at))
		return true;
	return frame_at(r->data, r->len, at, &frame) && (frame.op != OP_CHUNK || read_chunk_head(frame.content, &head));
}

/* The next place from `at` on where a chunk seems to begin, with something behind it; the file's end where there is none. */
static size_t find_chunk(const struct mcap_reader *r, size_t at)
{
	struct chunk_head head;
	struct frame frame;

	while (at < r->len) {
		const uint8_t *found = memchr(r->data + at, OP_CHUNK, r->len - at);

		if (!found)
			return r->len;
		at = (size_t)(found - r->data);
		if (frame_at(r->data, r->len, at, &frame) && read_chunk_head(frame.content, &head) &&
		    plausible(r, frame.end))
			return at;
		at++;
	}
	return r->len;
}

/* Damage at `from`, whose record seems to end at `end` (0: it has none): goes on at the next thing that makes sense. */
static void pass_over(struct mcap_reader *r, size_t from, size_t end, struct mcap_item *ret)
{
	if (end > from)
		r->waste += end - from;
	if (end > from && plausible(r, end))
		r->at = end;
	else if (r->waste > (uint64_t)r->len * WASTE_MAX + WASTE_FREE)
		r->at = r->len;
	else
		r->at = find_chunk(r, from + 1);
	*ret = (struct mcap_item){.kind = MCAP_DAMAGED, .offset = from, .end = r->at};
	ret->damage = r->why;
}

/* Chunks */

static bool reserve_chunk(struct mcap_reader *r, size_t len)
{
	uint8_t *grown;

	if (len <= r->chunk_cap)
		return true;
	grown = realloc(r->chunk, len);
	if (!grown) {
		r->nomem = true;
		return false;
	}
	r->chunk = grown;
	r->chunk_cap = len;
	return true;
}

static const uint8_t *decompress(struct mcap_reader *r, const struct chunk_head *head)
{
	const size_t len = (size_t)head->uncompressed;
	unsigned long long said;
	size_t n;

	if (head->compression.len == 0) {
		r->why = "a chunk whose lengths disagree";
		return head->len == len ? head->records : NULL;
	}
	if (!mcap_text_is(head->compression, "zstd")) {
		r->why = "a chunk that is not compressed with zstd";
		return NULL;
	}
	r->why = "a chunk that does not decompress";
	/* What the frame says of its own size is compared before memory is taken for it. */
	said = ZSTD_getFrameContentSize(head->records, head->len);
	if ((said != len && said != ZSTD_CONTENTSIZE_UNKNOWN) || !reserve_chunk(r, len ? len : 1))
		return NULL;
	n = ZSTD_decompressDCtx(r->zstd, r->chunk, len, head->records, head->len);
	return ZSTD_isError(n) || n != len ? NULL : r->chunk;
}

/* Opens the chunk of this frame. False: damage or no memory. */
static bool open_chunk(struct mcap_reader *r, const struct frame *frame, struct mcap_item *ret)
{
	struct chunk_head head;
	const uint8_t *records;

	r->why = "a chunk whose head is wrong";
	if (!read_chunk_head(frame->content, &head))
		return false;
	records = decompress(r, &head);
	if (records && head.crc != 0 && crc32_z(0, records, (size_t)head.uncompressed) != head.crc) {
		r->why = "a chunk with a wrong CRC";
		records = NULL;
	}
	if (!records) {
		r->waste += head.uncompressed;
		return false;
	}
	r->open = records;
	r->open_len = (size_t)head.uncompressed;
	r->open_at = 0;
	ret->kind = MCAP_CHUNK;
	ret->chunk.start_ns = head.start_ns;
	ret->chunk.end_ns = head.end_ns;
	ret->chunk.uncompressed = head.uncompressed;
	r->open_offset = ret->offset;
	r->open_end = ret->end;
	return true;
}

/* 1; 0: the chunk has no more; -ENOMEM. */
static int next_in_chunk(struct mcap_reader *r, struct mcap_item *ret)
{
	struct frame frame;

	while (r->open_at < r->open_len) {
		bool good = frame_at(r->open, r->open_len, r->open_at, &frame);

		*ret = (struct mcap_item){.offset = r->open_offset, .end = r->open_end};
		r->why = "a chunk with something that is no record";
		if (good)
			r->open_at = frame.end;
		if (good && frame.op == OP_MESSAGE) {
			good = read_message(r, frame.content, ret);
			if (good)
				return 1;
		} else if (good && (frame.op == OP_SCHEMA || frame.op == OP_CHANNEL)) {
			good =
			    frame.op == OP_SCHEMA ? define_schema(r, frame.content) : define_channel(r, frame.content);
		} else if (good) {
			good = frame.op >= OP_PRIVATE;
		}
		if (r->nomem)
			return -ENOMEM;
		if (!good) {
			r->open_at = r->open_len; /* its rest is lost; its CRC says that it was written so */
			ret->kind = MCAP_DAMAGED;
			ret->damage = r->why;
			return 1;
		}
	}
	return 0;
}

/* What stands beside chunks */

static bool read_attachment(struct mcap_reader *r, struct cursor c, struct mcap_item *ret)
{
	const uint8_t *begin = c.at;
	uint32_t crc;

	ret->kind = MCAP_ATTACHMENT;
	ret->attachment.log_ns = take_int(&c, 8);
	ret->attachment.create_ns = take_int(&c, 8);
	ret->attachment.name = take_text(&c);
	ret->attachment.media_type = take_text(&c);
	ret->attachment.len = (size_t)take_int(&c, 8);
	ret->attachment.data = take(&c, ret->attachment.len);
	const size_t len = c.bad ? 0 : (size_t)(c.at - begin);
	crc = (uint32_t)take_int(&c, 4);
	r->why = c.bad ? "an attachment that is none" : "an attachment with a wrong CRC";
	return !c.bad && (crc == 0 || crc32_z(0, begin, len) == crc);
}

static bool read_metadata(struct mcap_reader *r, struct cursor c, struct mcap_item *ret)
{
	ret->kind = MCAP_METADATA;
	ret->metadata.name = take_text(&c);
	take_map(&c, &ret->metadata.map);
	r->why = "metadata that are none";
	return !c.bad;
}

static bool read_header(struct mcap_reader *r, struct cursor c, struct mcap_item *ret)
{
	ret->kind = MCAP_HEADER;
	ret->header.profile = take_text(&c);
	ret->header.library = take_text(&c);
	r->why = "a header that is none";
	return !c.bad;
}

static bool read_statistics(struct mcap_reader *r, struct cursor c, struct mcap_item *ret)
{
	ret->kind = MCAP_STATISTICS;
	ret->statistics.messages = take_int(&c, 8);
	ret->statistics.schemas = (uint16_t)take_int(&c, 2);
	ret->statistics.channels = (uint32_t)take_int(&c, 4);
	ret->statistics.attachments = (uint32_t)take_int(&c, 4);
	ret->statistics.metadata = (uint32_t)take_int(&c, 4);
	ret->statistics.chunks = (uint32_t)take_int(&c, 4);
	ret->statistics.start_ns = take_int(&c, 8);
	ret->statistics.end_ns = take_int(&c, 8);
	r->why = "statistics that are none";
	return !c.bad;
}

/* The summary's CRC and the magic at the end. */
static bool footer_holds(const struct mcap_reader *r)
{
	const size_t tail = MCAP_RECORD_HEAD + MCAP_FOOTER_LEN + MCAP_MAGIC;
	struct frame frame;
	uint64_t summary;
	uint32_t crc;

	if (r->len < MCAP_MAGIC + tail || memcmp(r->data + r->len - MCAP_MAGIC, mcap_magic, MCAP_MAGIC) != 0 ||
	    !frame_at(r->data, r->len - MCAP_MAGIC, r->len - tail, &frame) || frame.op != OP_FOOTER ||
	    frame.end != r->len - MCAP_MAGIC)
		return false;
	summary = take_int(&frame.content, 8);
	take_int(&frame.content, 8);
	crc = (uint32_t)take_int(&frame.content, 4);
	if (summary == 0)
		summary = r->len - tail;
	return summary <= r->len - tail &&
	       (crc == 0 || crc32_z(0, r->data + summary, r->len - MCAP_MAGIC - 4 - (size_t)summary) == crc);
}

static bool read_footer(struct mcap_reader *r, const struct frame *frame, struct mcap_item *ret)
{
	ret->kind = MCAP_FOOTER;
	r->why = "a summary with a wrong CRC, or a footer before the end";
	if (frame->end != r->len - MCAP_MAGIC || !footer_holds(r))
		return false;
	r->at = r->len;
	return true;
}

/* The definitions that the summary repeats, for files whose chunks do not. */
static void read_summary(struct mcap_reader *r)
{
	const size_t tail = r->len - MCAP_MAGIC - MCAP_FOOTER_LEN;
	struct cursor c = {r->data + tail, r->data + r->len, false};
	uint64_t at = take_int(&c, 8);
	struct frame frame;
	bool good = at != 0;

	while (good && !r->nomem && frame_at(r->data, tail - MCAP_RECORD_HEAD, (size_t)at, &frame)) {
		if (frame.op == OP_SCHEMA)
			good = define_schema(r, frame.content);
		else if (frame.op == OP_CHANNEL)
			good = define_channel(r, frame.content);
		at = frame.end;
	}
}

/* Walking */

/* An opcode has no CRC: a chunk with a damaged one would be passed over as somebody's private record, silently. */
static bool is_chunk(const struct frame *frame)
{
	struct chunk_head head;

	return frame->op == OP_CHUNK ||
	       (read_chunk_head(frame->content, &head) && mcap_text_is(head.compression, "zstd") &&
	        head.records + head.len == frame->content.end);
}

/* 1: an item; 0: nothing for the caller; -EINVAL: damage; -ENOMEM. */
static int read_frame(struct mcap_reader *r, const struct frame *frame, struct mcap_item *ret)
{
	struct cursor content = frame->content;
	int got = 1;
	bool good;

	switch (is_chunk(frame) ? OP_CHUNK : frame->op) {
	case OP_HEADER:
		good = read_header(r, frame->content, ret);
		break;
	case OP_SCHEMA:
		got = 0;
		good = define_schema(r, frame->content);
		break;
	case OP_CHANNEL:
		got = 0;
		good = define_channel(r, frame->content);
		break;
	case OP_MESSAGE:
		good = read_message(r, frame->content, ret);
		break;
	case OP_CHUNK:
		good = open_chunk(r, frame, ret);
		break;
	case OP_ATTACHMENT:
		good = read_attachment(r, frame->content, ret);
		break;
	case OP_METADATA:
		good = read_metadata(r, frame->content, ret);
		break;
	case OP_STATISTICS:
		good = read_statistics(r, frame->content, ret);
		break;
	case OP_FOOTER:
		good = read_footer(r, frame, ret);
		break;
	case OP_MESSAGE_INDEX: /* nobody needs it who has all bytes; a damaged length would jump over chunks */
		r->why = "an index that is none";
		take_int(&content, 2);
		return take_int(&content, 4) == (uint64_t)(content.end - content.at) ? 0 : -EINVAL;
	default: /* other indexes, and what others wrote */
		return 0;
	}
	return r->nomem ? -ENOMEM : good ? got : -EINVAL;
}

int mcap_reader_next(struct mcap_reader *r, struct mcap_item *ret)
{
	int got = r->open ? next_in_chunk(r, ret) : 0;

	while (got == 0) {
		const size_t at = r->at;
		struct frame frame = {.end = 0};

		r->open = NULL;
		if (is_end(r, at))
			return 0;
		*ret = (struct mcap_item){.offset = at};
		r->why = "the file ends within a record, or bytes are missing or changed";
		if (frame_at(r->data, r->len, at, &frame)) {
			r->at = frame.end;
			ret->end = frame.end;
			got = read_frame(r, &frame, ret);
		} else {
			got = -EINVAL;
		}
		if (got == -EINVAL) {
			pass_over(r, at, frame.end, ret);
			return 1;
		}
	}
	return got;
}

int mcap_reader_next_in_chunk(struct mcap_reader *r, struct mcap_item *ret)
{
	return r->open ? next_in_chunk(r, ret) : 0;
}

size_t mcap_reader_tell(const struct mcap_reader *r)
{
	return r->open_at;
}

void mcap_reader_return(struct mcap_reader *r, size_t told)
{
	if (r->open && told <= r->open_len)
		r->open_at = told;
}

void mcap_reader_rewind(struct mcap_reader *r)
{
	r->at = MCAP_MAGIC;
	r->open = NULL;
	r->waste = 0;
	for (size_t i = 0; i < r->channels; i++)
		r->channel[i]->messages = 0;
}

/* The next chunk by its head alone, definitions beside chunks taken along; r->at is where it begins. False: there is none. */
static bool next_head(struct mcap_reader *r, struct chunk_head *ret, size_t *ret_end)
{
	struct frame frame = {.end = 0};

	while (r->at < r->len && !r->nomem) {
		bool good = frame_at(r->data, r->len, r->at, &frame);

		if (good && frame.op == OP_CHUNK)
			good = read_chunk_head(frame.content, ret);
		*ret_end = frame.end;
		if (good && frame.op == OP_CHUNK)
			return true;
		if (good && (frame.op == OP_SCHEMA || frame.op == OP_CHANNEL))
			good =
			    frame.op == OP_SCHEMA ? define_schema(r, frame.content) : define_channel(r, frame.content);
		r->at = good ? frame.end : find_chunk(r, r->at + 1);
	}
	return false;
}

int mcap_reader_seek(struct mcap_reader *r, int64_t log_ns)
{
	const uint64_t wanted_ns = log_ns > 0 ? (uint64_t)log_ns : 0;
	struct chunk_head head;
	size_t end;

	mcap_reader_rewind(r);
	while (next_head(r, &head, &end)) {
		if (head.end_ns >= wanted_ns)
			return 0;
		r->at = end;
	}
	return r->nomem ? -ENOMEM : 0;
}

size_t mcap_reader_span(struct mcap_reader *r, uint64_t *ret_start_ns, uint64_t *ret_end_ns)
{
	const size_t at = r->at;
	struct chunk_head head;
	size_t chunks = 0, end;

	*ret_start_ns = *ret_end_ns = 0;
	r->at = MCAP_MAGIC;
	while (next_head(r, &head, &end)) {
		*ret_start_ns = chunks == 0 || head.start_ns < *ret_start_ns ? head.start_ns : *ret_start_ns;
		*ret_end_ns = head.end_ns > *ret_end_ns ? head.end_ns : *ret_end_ns;
		chunks++;
		r->at = end;
	}
	r->at = at;
	return chunks;
}

bool mcap_reader_whole(const struct mcap_reader *r)
{
	return r->summary;
}

struct mcap_channel *mcap_reader_channel(const struct mcap_reader *r, uint32_t id)
{
	size_t at = id > UINT16_MAX ? r->channels : place((void **)r->channel, r->channels, (uint16_t)id);

	return at < r->channels ? r->channel[at] : NULL;
}

/* Life */

int mcap_reader_create(const uint8_t *data, size_t len, struct mcap_reader **ret, char error[160])
{
	struct mcap_reader *r;

	if (len < MCAP_MAGIC || memcmp(data, mcap_magic, MCAP_MAGIC) != 0) {
		snprintf(error, 160, "%s",
		         len == 0 ? "is empty: nothing was recorded"
		                  : "is no MCAP file: it does not begin as one does");
		return -EINVAL;
	}
	r = calloc(1, sizeof(*r));
	if (r)
		r->zstd = ZSTD_createDCtx();
	if (!r || !r->zstd) {
		mcap_reader_destroy(r);
		snprintf(error, 160, "out of memory");
		return -ENOMEM;
	}
	r->data = data;
	r->len = len;
	r->at = MCAP_MAGIC;
	r->summary = footer_holds(r);
	if (r->summary)
		read_summary(r);
	if (r->nomem) {
		mcap_reader_destroy(r);
		snprintf(error, 160, "out of memory");
		return -ENOMEM;
	}
	*ret = r;
	return 0;
}

void mcap_reader_destroy(struct mcap_reader *r)
{
	if (!r)
		return;
	for (size_t i = 0; i < r->channels; i++)
		free(r->channel[i]);
	for (size_t i = 0; i < r->schemas; i++)
		free(r->schema[i]);
	free(r->channel);
	free(r->schema);
	free(r->chunk);
	ZSTD_freeDCtx(r->zstd);
	free(r);
}

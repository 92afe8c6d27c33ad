/* MCAP, the container of recordings (https://mcap.dev/spec): a file is
 *
 *   magic, Header, { Chunk, its MessageIndexes | Attachment | Metadata } ..., DataEnd, summary, Footer, magic
 *
 * and a record is u8 opcode, u64 length, content; little-endian. Chunks hold schemas, channels and messages, here always
 * compressed with zstd and with a CRC. What is written here repeats the schemas and channels a chunk uses within that
 * chunk, so every whole chunk can be read without all others: a cut or damaged file loses no more than what is damaged.
 *
 * The writer appends to a buffer that its caller empties; the reader walks over bytes that are all in memory (a mapped file).
 * Neither touches a file (law L1). Nothing that is read is trusted: every length is judged before it is used. */
#ifndef FACET_CORE_MCAP_H
#define FACET_CORE_MCAP_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "core/model.h"

#define MCAP_RECORD_MAX   (64u << 20) /* bytes of one record; larger ones are damage, or -EMSGSIZE to the writer */
#define MCAP_CHUNK_MAX    (64u << 20) /* bytes of a chunk once decompressed; a larger one is damage */
#define MCAP_CHANNELS_MAX 4096        /* of a file, and schemas; further ones are damage, or -EMFILE to the writer */
#define MCAP_CHUNKS_MAX   (1u << 20)  /* of a file that is written: then -EFBIG, begin another */
#define MCAP_PAIRS_MAX    64          /* of one map of metadata; further ones are left out */
#define MCAP_MAGIC        8

/* Writing */

struct mcap_pair {
	const char *key, *value; /* borrowed */
};

struct mcap_params {
	const char *library; /* who writes; borrowed for the call */
	int level;           /* of zstd; 0: chunks are not compressed */
};

struct mcap_message {
	uint16_t channel;
	int64_t log_ns, publish_ns; /* from 1970; earlier is taken as 0 */
	const void *head;           /* the payload in two pieces, so that nobody has to join them */
	size_t head_len;
	const void *data;
	size_t len;
};

struct mcap_writer;

/* All that is written is appended to `out` (borrowed), whose owner takes it from there and may set out->len to 0 between any two
 * calls. The file's head is there at once. NULL when memory is out. */
struct mcap_writer *mcap_writer_create(const struct mcap_params *, struct buffer *out);
void mcap_writer_destroy(struct mcap_writer *);

/* An id from 1, or -errno. A channel is written when it is first used in a chunk, with its schema (0: none). */
int mcap_writer_schema(struct mcap_writer *, const char *name, const char *encoding, const void *data, size_t len);
int mcap_writer_channel(struct mcap_writer *, int schema, const char *topic, const char *encoding,
                        const struct mcap_pair *, size_t pairs);

/* Into the open chunk. 0 or -errno; -EMSGSIZE: too long, and nothing was written. */
int mcap_writer_message(struct mcap_writer *, const struct mcap_message *);
size_t mcap_writer_open_bytes(const struct mcap_writer *); /* in the open chunk; 0: none is open */
int64_t mcap_writer_open_ns(const struct mcap_writer *);   /* log time of its first message */
/* Puts the open chunk and its indexes into `out`. What is there now survives whatever comes. 0 or -errno. */
int mcap_writer_close_chunk(struct mcap_writer *);

/* These close the open chunk first. */
int mcap_writer_attach(struct mcap_writer *, int64_t log_ns, const char *name, const char *media_type, const void *data,
                       size_t len);
int mcap_writer_metadata(struct mcap_writer *, const char *name, const struct mcap_pair *, size_t pairs);
/* The summary and the footer: the file is whole. Nothing may follow. */
int mcap_writer_end(struct mcap_writer *);

uint64_t mcap_writer_bytes(const struct mcap_writer *); /* put into `out` so far */
uint64_t mcap_writer_messages(const struct mcap_writer *);

/* Reading */

struct mcap_text { /* not ended by a 0; borrowed from the reader's bytes or its open chunk */
	const char *at;
	size_t len;
};
bool mcap_text_is(struct mcap_text, const char *);

enum mcap_kind {
	MCAP_HEADER,
	MCAP_MESSAGE,
	MCAP_ATTACHMENT,
	MCAP_METADATA,
	MCAP_CHUNK,      /* one begins; its messages follow */
	MCAP_STATISTICS, /* of the summary: what the file says of itself */
	MCAP_FOOTER,     /* the file is whole up to here */
	MCAP_DAMAGED     /* bytes that cannot be read were passed over; what is whole behind them follows */
};

struct mcap_schema {
	uint16_t id;
	struct mcap_text name, encoding; /* the reader's; till mcap_reader_destroy */
	const uint8_t *data;
	size_t len;
};

struct mcap_map {
	size_t n;
	struct {
		struct mcap_text key, value;
	} pair[MCAP_PAIRS_MAX];
};

struct mcap_channel { /* the reader's; till mcap_reader_destroy */
	uint16_t id;
	const struct mcap_schema *schema; /* NULL: none */
	struct mcap_text topic, encoding;
	struct mcap_map metadata;
	void *user;        /* the caller's, NULL at first */
	uint64_t messages; /* seen so far */
};

struct mcap_item {
	enum mcap_kind kind;
	uint64_t offset, end; /* in the file: of the record, for a message of its chunk */
	union {
		struct {
			struct mcap_text profile, library;
		} header;
		struct {
			struct mcap_channel *channel;
			uint32_t sequence;
			uint64_t log_ns, publish_ns;
			const uint8_t *data; /* till the next chunk is opened */
			size_t len;
		} message;
		struct {
			uint64_t log_ns, create_ns;
			struct mcap_text name, media_type;
			const uint8_t *data;
			size_t len;
		} attachment;
		struct {
			struct mcap_text name;
			struct mcap_map map;
		} metadata;
		struct {
			uint64_t start_ns, end_ns, uncompressed;
		} chunk;
		struct {
			uint64_t messages, start_ns, end_ns;
			uint32_t channels, attachments, metadata, chunks;
			uint16_t schemas;
		} statistics;
		const char *damage; /* one sentence */
	};
};

struct mcap_reader;

/* Reads the file from its beginning. `data` is borrowed for the reader's life. 0, -EINVAL with a sentence (no MCAP), -ENOMEM. */
int mcap_reader_create(const uint8_t *data, size_t len, struct mcap_reader **ret, char error[160]);
void mcap_reader_destroy(struct mcap_reader *);

/* The next item. 1; 0: the end, be it the footer's or a cut's; -ENOMEM. */
int mcap_reader_next(struct mcap_reader *, struct mcap_item *ret);
/* As above, but 0 also where the open chunk has no further message, which is then still open. */
int mcap_reader_next_in_chunk(struct mcap_reader *, struct mcap_item *ret);
/* Within an open chunk: where the next message is, and back there; nothing happens where none is open. */
size_t mcap_reader_tell(const struct mcap_reader *);
void mcap_reader_return(struct mcap_reader *, size_t told);

void mcap_reader_rewind(struct mcap_reader *);
/* To the first chunk in the file that holds a message of `log_ns` or later, by the heads of chunks alone; channels of files that
 * do not repeat them are taken from the summary. Where there is none: to the end of the data. 0 or -ENOMEM. */
int mcap_reader_seek(struct mcap_reader *, int64_t log_ns);
/* First and last log time by the heads of the chunks, nothing decompressed; how many chunks. */
size_t mcap_reader_span(struct mcap_reader *, uint64_t *ret_start_ns, uint64_t *ret_end_ns);
/* True where a footer ends the file and its summary is undamaged: nothing is missing. */
bool mcap_reader_whole(const struct mcap_reader *);
/* Channels seen so far, by id: the first at or after `id`; NULL: none. */
struct mcap_channel *mcap_reader_channel(const struct mcap_reader *, uint32_t id);

#endif

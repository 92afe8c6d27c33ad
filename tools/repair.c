/* `facet repair`: a clean recording out of a cut or damaged one. Every message of every whole chunk is written anew, in its order
 * and in chunks as they were, with attachments, metadata, new indexes and a summary. Where something was passed over, an event
 * says so, since records that no longer follow one another are not what the decoders heard. Any MCAP file will do: what it is
 * of is nobody's business here. */
#include <argp.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "core/mcap.h"
#include "tools/commands.h"
#include "tools/mapped.h"

#define LEVEL 3 /* of zstd: nobody waits */

struct job {
	const char *input, *output;
};

struct repair {
	struct mcap_reader *reader;
	struct mcap_writer *writer;
	struct buffer out;
	int file;
	int64_t log_ns; /* of the newest message */
	uint64_t lost;  /* bytes */
	unsigned places, chunks;
	bool gap; /* since the last message */
};

static const struct argp_option options[] = {{"output", 'o', "OUT.mcap", 0, "the clean recording", 0}, {0}};

static error_t parse_option(int key, char *arg, struct argp_state *state)
{
	struct job *job = state->input;

	switch (key) {
	case 'o':
		job->output = arg;
		return 0;
	case ARGP_KEY_ARG:
		if (job->input)
			argp_error(state, "one file is repaired at a time; '%s' is the second", arg);
		job->input = arg;
		return 0;
	case ARGP_KEY_END:
		if (!job->output || !job->input)
			argp_error(state, "FILE.mcap and -o OUT.mcap are needed");
		return 0;
	default:
		return ARGP_ERR_UNKNOWN;
	}
}

static int flush(struct repair *r)
{
	for (size_t at = 0; at < r->out.len;) {
		ssize_t n = write(r->file, r->out.data + at, r->out.len - at);

		if (n < 0 && errno != EINTR)
			return -errno;
		at += n > 0 ? (size_t)n : 0;
	}
	r->out.len = 0;
	return r->out.error;
}

/* A text of the reader as one of C. */
static const char *text(struct mcap_text from, char ret[1024])
{
	snprintf(ret, 1024, "%.*s", from.len < 1023 ? (int)from.len : 1023, from.at);
	return ret;
}

static size_t take_pairs(const struct mcap_map *map, struct mcap_pair *ret, char (*texts)[1024])
{
	for (size_t i = 0; i < map->n; i++) {
		ret[i].key = text(map->pair[i].key, texts[2 * i]);
		ret[i].value = text(map->pair[i].value, texts[2 * i + 1]);
	}
	return map->n;
}

static char texts[2 * MCAP_PAIRS_MAX][1024];
static uint16_t schema_ids[UINT16_MAX + 1]; /* new ones, by the old; 0: none yet */

/* A schema, a channel of the old file in the new one: its id, or -errno. */
static int schema_of(struct repair *r, const struct mcap_schema *from)
{
	char name[1024], encoding[1024];
	int id;

	if (!from || schema_ids[from->id] > 0)
		return from ? schema_ids[from->id] : 0;
	id = mcap_writer_schema(r->writer, text(from->name, name), text(from->encoding, encoding), from->data,
	                        from->len);
	if (id > 0)
		schema_ids[from->id] = (uint16_t)id;
	return id;
}

static int channel_of(struct repair *r, struct mcap_channel *from)
{
	struct mcap_pair pair[MCAP_PAIRS_MAX];
	char topic[1024], encoding[1024];
	size_t pairs;
	int schema, id;

	if (from->user)
		return (int)(uintptr_t)from->user;
	schema = schema_of(r, from->schema);
	if (schema < 0)
		return schema;
	pairs = take_pairs(&from->metadata, pair, texts);
	id = mcap_writer_channel(r->writer, schema, text(from->topic, topic), text(from->encoding, encoding), pair,
	                         pairs);
	if (id > 0)
		from->user = (void *)(uintptr_t)id;
	return id;
}

static struct mcap_channel *find_events(const struct repair *r)
{
	struct mcap_channel *c = mcap_reader_channel(r->reader, 0);

	while (c && !mcap_text_is(c->topic, "/event"))
		c = mcap_reader_channel(r->reader, c->id + 1u);
	return c;
}

static int put(struct repair *r, struct mcap_channel *from, int64_t log_ns, int64_t publish_ns, const void *data,
               size_t len)
{
	int id = channel_of(r, from);
	const struct mcap_message message = {(uint16_t)id, log_ns, publish_ns, NULL, 0, data, len};

	return id < 0 ? id : mcap_writer_message(r->writer, &message);
}

/* Said in front of what follows the damage; at the end of a cut file nothing does. */
static int put_gap(struct repair *r)
{
	static const char gap[] = "{\"class\":\"GAP\",\"message\":\"a damaged part was left out by facet repair\"}";
	struct mcap_channel *events = r->gap ? find_events(r) : NULL;

	r->gap = false;
	return events ? put(r, events, r->log_ns, r->log_ns, gap, sizeof(gap) - 1) : 0;
}

static int put_message(struct repair *r, const struct mcap_item *item)
{
	int got = put_gap(r);

	r->log_ns = (int64_t)item->message.log_ns;
	return got < 0 ? got
	               : put(r, item->message.channel, r->log_ns, (int64_t)item->message.publish_ns, item->message.data,
	                     item->message.len);
}

static int put_beside(struct repair *r, const struct mcap_item *item)
{
	struct mcap_pair pair[MCAP_PAIRS_MAX];
	char name[1024], media_type[1024];

	if (item->kind == MCAP_ATTACHMENT)
		return mcap_writer_attach(
		    r->writer, (int64_t)item->attachment.log_ns, text(item->attachment.name, name),
		    text(item->attachment.media_type, media_type), item->attachment.data, item->attachment.len);
	return mcap_writer_metadata(r->writer, text(item->metadata.name, name), pair,
	                            take_pairs(&item->metadata.map, pair, texts));
}

static int put_item(struct repair *r, const struct mcap_item *item)
{
	int got = 0;

	switch (item->kind) {
	case MCAP_MESSAGE:
		return put_message(r, item);
	case MCAP_CHUNK:
		r->chunks++;
		got = mcap_writer_close_chunk(r->writer);
		return got < 0 ? got : flush(r);
	case MCAP_ATTACHMENT:
	case MCAP_METADATA:
		return put_beside(r, item);
	case MCAP_DAMAGED:
		r->places++;
		r->lost += item->end - item->offset;
		r->gap = true;
		return 0;
	default:
		return 0;
	}
}

static int copy(struct repair *r)
{
	const struct mcap_params params = {"facet " FACET_VERSION, LEVEL};
	struct mcap_item item;
	int got;

	r->writer = mcap_writer_create(&params, &r->out);
	got = r->writer ? 1 : -ENOMEM;
	while (got > 0 && (got = mcap_reader_next(r->reader, &item)) == 1) {
		got = put_item(r, &item);
		got = got == 0 || got == -EMSGSIZE ? 1 : got;
	}
	if (got == 0)
		got = mcap_writer_end(r->writer);
	if (got == 0)
		got = flush(r);
	mcap_writer_destroy(r->writer);
	buffer_finish(&r->out);
	return got;
}

/* Into a file beside OUT, renamed when it is whole. */
static int write_out(struct repair *r, const char *path)
{
	char beside[PATH_MAX];
	int got;

	if (snprintf(beside, sizeof(beside), "%s.%ld.part", path, (long)getpid()) >= (int)sizeof(beside))
		return -ENAMETOOLONG;
	r->file = open(beside, O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
	if (r->file < 0)
		return -errno;
	got = copy(r);
	if (close(r->file) < 0 && got == 0)
		got = -errno;
	if (got == 0 && rename(beside, path) < 0)
		got = -errno;
	if (got < 0)
		unlink(beside);
	return got;
}

static int repair(const struct job *job)
{
	struct repair r = {.file = -1};
	struct mapped file;
	char error[400], sentence[160];
	uint64_t messages = 0;
	int got = mapped_open(job->input, &file, error);

	if (got < 0) {
		fprintf(stderr, "facet: %s\n", error);
		return 1;
	}
	got = mcap_reader_create(file.data, file.len, &r.reader, sentence);
	if (got < 0) {
		fprintf(stderr, "facet: %s: %s\n", job->input, sentence);
	} else {
		got = write_out(&r, job->output);
		if (got < 0)
			fprintf(stderr, "facet: %s: cannot be written (%s)\n", job->output, strerror(-got));
		for (struct mcap_channel *c = mcap_reader_channel(r.reader, 0); c;
		     c = mcap_reader_channel(r.reader, c->id + 1u))
			messages += c->messages;
	}
	if (got == 0)
		printf("%s: %llu messages in %u chunks; %llu bytes at %u place%s could not be read and are left out\n",
		       job->output, (unsigned long long)messages, r.chunks, (unsigned long long)r.lost, r.places,
		       r.places == 1 ? "" : "s");
	mcap_reader_destroy(r.reader);
	mapped_close(&file);
	return got < 0;
}

int repair_main(int argc, char **argv)
{
	static const struct argp argp = {
	    options,
	    parse_option,
	    "FILE.mcap -o OUT.mcap",
	    "Writes a clean recording out of a cut or damaged one: all that is whole, also behind "
	    "damage, with new indexes.",
	    NULL,
	    NULL,
	    NULL};
	struct job job = {0};

	argp_parse(&argp, argc, argv, 0, NULL, &job);
	return repair(&job);
}

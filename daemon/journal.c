/* A kept list of what the loop handed to the pipeline, as plain bytes, little-endian:
 *
 *   "FACETJ2\n"
 *   1  u32 n, n bytes                                                    what the pipeline went on from
 *   2  i64 log_ns, i64 t_ns, u8 device, u8 direction, u32 n, n bytes     a record; direction 2: the link was opened
 *   3  i64 log_ns                                                        a tick
 *   4  u64 number                                                        this row was not applied
 *   5  i64 ahead_ns                                                      the wall clock is now so far ahead of log time
 *
 * One list is one map. When a client says ?RESET the map begins anew, in mid-session: the list ends, and the next one,
 * in a file of its own, begins with a snapshot of decoders, rings and numbers as they stand, so that it gives the new map
 * alone, without the list before. The first list begins with a snapshot too, that of a new pipeline: there is one way to
 * begin. This is also how a recording will go on in its next file.
 *
 * A row that was not applied is written after the record that completed it, but must be known before that record is
 * fed: journal_feed therefore looks ahead. The file is mapped, not read: a long list costs no memory. A list that ends
 * within an entry (power loss) is fed up to the last whole one. Nothing in it is trusted: times that run backwards,
 * devices that are not there and damaged snapshots end the feeding with a sentence.
 *
 * A recording file for users is MCAP on the same seam; this one serves tests and the search for faults. */
#include "daemon/journal.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

static const char MAGIC[8] = "FACETJ2\n", OLDER[8] = "FACETJ1\n";

enum { RECORD_HEAD = 8 + 8 + 1 + 1 + 4, RECORD_BYTES_MAX = 1 << 20, SNAPSHOT_BYTES_MAX = 1 << 26 };

struct journal {
	char *path; /* of the first list */
	int lists;
	FILE *file;
	int error; /* of the first write that failed */
};

/* Keeping */

static void put(struct journal *journal, const void *data, size_t len)
{
	if (journal->error == 0 && len > 0 && fwrite(data, 1, len, journal->file) != len)
		journal->error = errno ? -errno : -EIO;
}

static void put_entry(struct journal *journal, uint8_t kind, const void *data, size_t len)
{
	put(journal, &kind, 1);
	put(journal, data, len);
}

static void keep_record(void *ctx, const struct record *record)
{
	uint8_t head[RECORD_HEAD];
	uint32_t n = (uint32_t)record->len;

	memcpy(head, &record->log_ns, 8);
	memcpy(head + 8, &record->t_ns, 8);
	head[16] = (uint8_t)record->device;
	head[17] = (uint8_t)record->direction;
	memcpy(head + 18, &n, 4);
	put_entry(ctx, JOURNAL_RECORD, head, sizeof(head));
	put(ctx, record->bytes, record->len);
}

static void keep_tick(void *ctx, int64_t log_ns)
{
	put_entry(ctx, JOURNAL_TICK, &log_ns, 8);
}

static void keep_not_applied(void *ctx, uint64_t number)
{
	put_entry(ctx, JOURNAL_NOT_APPLIED, &number, 8);
}

static void keep_clock(void *ctx, int64_t ahead_ns)
{
	put_entry(ctx, JOURNAL_CLOCK, &ahead_ns, 8);
}

/* 0, or -errno: there is no file then. */
static int open_list(struct journal *journal, int number)
{
	char *path = NULL;
	int r = 0;

	if ((number == 1 ? asprintf(&path, "%s", journal->path) : asprintf(&path, "%s.%d", journal->path, number)) < 0)
		return -ENOMEM;
	journal->file = fopen(path, "wbe");
	if (!journal->file)
		r = -errno;
	free(path);
	return r;
}

static void close_list(struct journal *journal)
{
	if (journal->file && fclose(journal->file) != 0 && journal->error == 0)
		journal->error = errno ? -errno : -EIO;
	journal->file = NULL;
}

static void keep_begin(void *ctx, const void *snapshot, size_t len)
{
	struct journal *journal = ctx;
	uint32_t n = (uint32_t)len;

	if (journal->lists > 0)
		close_list(journal);
	journal->lists++;
	if (journal->error == 0 && !journal->file)
		journal->error = journal->lists > JOURNAL_FILES_MAX ? -EMFILE : open_list(journal, journal->lists);
	put(journal, MAGIC, sizeof(MAGIC));
	put_entry(journal, JOURNAL_SNAPSHOT, &n, 4);
	put(journal, snapshot, len);
}

struct journal *journal_create(const char *path, char error[160])
{
	struct journal *journal = calloc(1, sizeof(*journal));
	int r = -ENOMEM;

	if (journal)
		journal->path = strdup(path);
	if (journal && journal->path)
		r = open_list(journal, 1);
	if (r == 0)
		return journal;
	snprintf(error, 160, "%.100s: cannot be written (%s)", path, strerror(-r));
	journal_destroy(journal);
	return NULL;
}

void journal_destroy(struct journal *journal)
{
	if (!journal)
		return;
	close_list(journal);
	free(journal->path);
	free(journal);
}

void journal_sink(struct journal *journal, struct journal_sink *ret)
{
	*ret = (struct journal_sink){journal, keep_begin, keep_record, keep_tick, keep_not_applied, keep_clock};
}

int journal_snapshot(struct pipeline *pipeline, struct buffer *ret)
{
	char error[160];
	struct state s;
	size_t len;

	state_save(&s, NULL, 0);
	pipeline_state(pipeline, &s, error);
	len = s.at;
	if (!buffer_reserve(ret, len))
		return -ENOMEM;
	state_save(&s, ret->data + ret->len, len);
	pipeline_state(pipeline, &s, error);
	ret->len += len;
	return 0;
}

int journal_begin(const struct journal_sink *sink, struct pipeline *pipeline)
{
	struct buffer bytes = {0};
	int r = journal_snapshot(pipeline, &bytes);

	if (r == 0)
		sink->begin(sink->ctx, bytes.data, bytes.len);
	buffer_finish(&bytes);
	return r;
}

int journal_error(const struct journal *journal)
{
	return journal->error;
}

/* Feeding */

int journal_is(const uint8_t *data, size_t len)
{
	if (len < sizeof(MAGIC))
		return -EINVAL;
	if (memcmp(data, MAGIC, sizeof(MAGIC)) == 0)
		return 0;
	return memcmp(data, OLDER, sizeof(OLDER)) == 0 ? -ENOTSUP : -EINVAL;
}

int journal_entry_at(const uint8_t *data, size_t len, struct journal_entry *ret)
{
	static const struct {
		size_t fixed, max; /* what ends with a count has so many bytes behind it at most */
	} kind[] = {[JOURNAL_SNAPSHOT] = {4, SNAPSHOT_BYTES_MAX},
	            [JOURNAL_RECORD] = {RECORD_HEAD, RECORD_BYTES_MAX},
	            [JOURNAL_TICK] = {8, 0},
	            [JOURNAL_NOT_APPLIED] = {8, 0},
	            [JOURNAL_CLOCK] = {8, 0}};
	uint32_t n = 0;

	if (len == 0)
		return 0;
	if (data[0] < JOURNAL_SNAPSHOT || data[0] > JOURNAL_CLOCK)
		return -EINVAL;
	if (len < 1 + kind[data[0]].fixed)
		return 0;
	if (kind[data[0]].max > 0)
		memcpy(&n, data + 1 + kind[data[0]].fixed - 4, 4);
	if (n > kind[data[0]].max)
		return -EINVAL;
	if (len < 1 + kind[data[0]].fixed + n)
		return 0;
	*ret = (struct journal_entry){data[0], data + 1, 1 + kind[data[0]].fixed + n};
	return 1;
}

struct feed {
	struct pipeline *pipeline;
	int devices;
	int64_t log_ns; /* of the last record or tick */
	char *error;    /* [160] */
};

static int damaged(const struct feed *feed, const char *what)
{
	snprintf(feed->error, 160, "%s", what);
	return -EINVAL;
}

/* Tells the pipeline the rows not applied. */
static void feed_skips(const uint8_t *data, size_t len, struct pipeline *pipeline)
{
	struct journal_entry entry;

	while (journal_entry_at(data, len, &entry) == 1) {
		if (entry.kind == JOURNAL_NOT_APPLIED) {
			uint64_t number;

			memcpy(&number, entry.data, 8);
			pipeline_skip(pipeline, number);
		}
		data += entry.len;
		len -= entry.len;
	}
}

static int feed_snapshot(struct feed *feed, const struct journal_entry *entry)
{
	struct state s;

	state_load(&s, entry->data + 4, entry->len - 1 - 4);
	pipeline_state(feed->pipeline, &s, feed->error);
	return s.failed ? -EINVAL : 0;
}

static bool is_time(int64_t t_ns)
{
	return t_ns >= STATE_TIME_MIN && t_ns <= STATE_TIME_MAX;
}

/* The eight bytes at the beginning of an entry as its log time. */
static int take_log_time(struct feed *feed, const uint8_t *data)
{
	int64_t log_ns;

	memcpy(&log_ns, data, 8);
	if (!is_time(log_ns) || log_ns < feed->log_ns)
		return damaged(feed, "a time that runs backwards; the list is damaged");
	feed->log_ns = log_ns;
	return 0;
}

void journal_record(const struct journal_entry *entry, struct record *ret)
{
	memcpy(&ret->log_ns, entry->data, 8);
	memcpy(&ret->t_ns, entry->data + 8, 8);
	ret->device = entry->data[16];
	ret->direction = (enum direction)entry->data[17];
	ret->bytes = entry->data + RECORD_HEAD;
	ret->len = entry->len - 1 - RECORD_HEAD;
}

static int feed_record(struct feed *feed, const struct journal_entry *entry)
{
	struct record record;
	int r = take_log_time(feed, entry->data);

	if (r < 0)
		return r;
	journal_record(entry, &record);
	if (record.device >= feed->devices || record.direction > LINK_OPENED || !is_time(record.t_ns))
		return damaged(feed, "a record of a device that is not there; the list is damaged");
	pipeline_handle(feed->pipeline, &record);
	return 0;
}

static int feed_tick(struct feed *feed, const struct journal_entry *entry)
{
	int r = take_log_time(feed, entry->data);

	if (r == 0)
		pipeline_tick(feed->pipeline, feed->log_ns);
	return r;
}

static int feed_clock(struct feed *feed, const struct journal_entry *entry)
{
	int64_t ahead_ns;

	memcpy(&ahead_ns, entry->data, 8);
	if (!is_time(ahead_ns))
		return damaged(feed, "a wall clock of another age; the list is damaged");
	pipeline_clock(feed->pipeline, ahead_ns);
	return 0;
}

static int feed_entry(struct feed *feed, const struct journal_entry *entry)
{
	switch (entry->kind) {
	case JOURNAL_RECORD:
		return feed_record(feed, entry);
	case JOURNAL_TICK:
		return feed_tick(feed, entry);
	case JOURNAL_CLOCK:
		return feed_clock(feed, entry);
	case JOURNAL_SNAPSHOT:
		return damaged(feed, "a second beginning; the list is damaged");
	default: /* rows not applied are known already */
		return 0;
	}
}

/* A list cut within its snapshot is one of nothing: 0, as every other cut. */
static int feed_all(struct feed *feed, const uint8_t *data, size_t len)
{
	struct journal_entry entry;
	int r = journal_entry_at(data, len, &entry);

	if (r == 1 && entry.kind != JOURNAL_SNAPSHOT)
		return damaged(feed, "no snapshot at the beginning; the list is damaged");
	if (r == 1)
		r = feed_snapshot(feed, &entry);
	else
		return r < 0 ? damaged(feed, "an unknown entry; the list is damaged") : 0;
	feed_skips(data, len, feed->pipeline);
	while (r == 0) {
		data += entry.len;
		len -= entry.len;
		r = journal_entry_at(data, len, &entry);
		if (r < 0)
			return damaged(feed, "an unknown entry; the list is damaged");
		if (r == 0)
			return 0;
		r = feed_entry(feed, &entry);
	}
	return r;
}

/* The file in memory; NULL and *ret 0 or -errno. */
static const uint8_t *map_file(const char *path, size_t *ret_len, int *ret)
{
	int fd = open(path, O_RDONLY | O_CLOEXEC);
	const uint8_t *data = MAP_FAILED;
	struct stat st = {0};

	if (fd >= 0 && fstat(fd, &st) == 0 && st.st_size > 0)
		data = mmap(NULL, (size_t)st.st_size, PROT_READ, MAP_PRIVATE, fd, 0);
	*ret = data == MAP_FAILED && (fd < 0 || st.st_size > 0) ? -errno : 0;
	if (fd >= 0)
		close(fd);
	*ret_len = (size_t)st.st_size;
	return data == MAP_FAILED ? NULL : data;
}

int journal_feed(const char *path, struct pipeline *pipeline, char error[160])
{
	char what[160] = "is no journal; give a file that facetd --journal wrote";
	struct feed feed = {pipeline, pipeline_devices(pipeline), STATE_TIME_MIN, what};
	size_t len;
	int r;
	const uint8_t *data = map_file(path, &len, &r);

	if (r < 0) {
		snprintf(error, 160, "%.100s: cannot be read (%s)", path, strerror(-r));
		return r;
	}
	r = journal_is(data, len);
	if (r == 0)
		r = feed_all(&feed, data + sizeof(MAGIC), len - sizeof(MAGIC));
	else if (r == -ENOTSUP)
		snprintf(what, sizeof(what), "was written by an older facetd and cannot be read; keep it anew");
	if (r == -ENOTSUP)
		r = -EINVAL;
	if (r < 0)
		snprintf(error, 160, "%.60s: %.97s", path, what);
	if (data)
		munmap((void *)(uintptr_t)data, len);
	return r;
}

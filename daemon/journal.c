/* A kept list of what the loop handed to the pipeline, as plain bytes, little-endian:
 *
 *   "FACETJ1\n"
 *   1  i64 log_ns, i64 t_ns, u8 device, u8 direction, u32 n, n bytes     a record
 *   2  i64 log_ns                                                        a tick
 *   3  u64 number                                                        this row was not applied
 *   4                                                                    the map began anew
 *   5  i64 ahead_ns                                                      the wall clock is now so far ahead of log time
 *
 * A row that was not applied is written after the record that completed it, but must be known before that record is
 * fed: journal_feed therefore looks ahead, up to the next reset, as numbers begin anew there. The file is mapped, not
 * read: a long list costs no memory. A list that ends within an entry (power loss) is fed up to the last whole one.
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

static const char MAGIC[8] = "FACETJ1\n";

enum { ENTRY_RECORD = 1, ENTRY_TICK, ENTRY_NOT_APPLIED, ENTRY_RESET, ENTRY_CLOCK };
enum { RECORD_HEAD = 8 + 8 + 1 + 1 + 4, ENTRY_BYTES_MAX = 1 << 20 };

struct journal {
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
	put_entry(ctx, ENTRY_RECORD, head, sizeof(head));
	put(ctx, record->bytes, record->len);
}

static void keep_tick(void *ctx, int64_t log_ns)
{
	put_entry(ctx, ENTRY_TICK, &log_ns, 8);
}

static void keep_not_applied(void *ctx, uint64_t number)
{
	put_entry(ctx, ENTRY_NOT_APPLIED, &number, 8);
}

static void keep_reset(void *ctx)
{
	put_entry(ctx, ENTRY_RESET, NULL, 0);
}

static void keep_clock(void *ctx, int64_t ahead_ns)
{
	put_entry(ctx, ENTRY_CLOCK, &ahead_ns, 8);
}

struct journal *journal_create(const char *path, char error[160])
{
	struct journal *journal = calloc(1, sizeof(*journal));

	if (!journal) {
		snprintf(error, 160, "no memory for the journal");
		return NULL;
	}
	journal->file = fopen(path, "wbe");
	if (!journal->file) {
		snprintf(error, 160, "%.100s: cannot be written (%s)", path, strerror(errno));
		free(journal);
		return NULL;
	}
	put(journal, MAGIC, sizeof(MAGIC));
	return journal;
}

void journal_destroy(struct journal *journal)
{
	if (!journal)
		return;
	fclose(journal->file);
	free(journal);
}

void journal_sink(struct journal *journal, struct journal_sink *ret)
{
	*ret = (struct journal_sink){journal, keep_record, keep_tick, keep_not_applied, keep_reset, keep_clock};
}

int journal_error(const struct journal *journal)
{
	return journal->error;
}

/* Feeding */

struct entry {
	uint8_t kind;
	const uint8_t *data; /* after the kind */
	size_t len;          /* with the kind */
};

/* 1; 0 at the end (also within an entry); -EINVAL: no such entry. */
static int entry_at(const uint8_t *data, size_t len, struct entry *ret)
{
	static const size_t fixed[] = {[ENTRY_RECORD] = RECORD_HEAD,
	                               [ENTRY_TICK] = 8,
	                               [ENTRY_NOT_APPLIED] = 8,
	                               [ENTRY_RESET] = 0,
	                               [ENTRY_CLOCK] = 8};
	uint32_t n = 0;

	if (len == 0)
		return 0;
	if (data[0] < ENTRY_RECORD || data[0] > ENTRY_CLOCK)
		return -EINVAL;
	if (len < 1 + fixed[data[0]])
		return 0;
	if (data[0] == ENTRY_RECORD) {
		memcpy(&n, data + 1 + 18, 4);
		if (n > ENTRY_BYTES_MAX)
			return -EINVAL;
	}
	if (len < 1 + fixed[data[0]] + n)
		return 0;
	*ret = (struct entry){data[0], data + 1, 1 + fixed[data[0]] + n};
	return 1;
}

/* Tells the pipeline the rows not applied from here to the next reset. */
static void feed_skips(const uint8_t *data, size_t len, struct pipeline *pipeline)
{
	struct entry entry;

	while (entry_at(data, len, &entry) == 1 && entry.kind != ENTRY_RESET) {
		if (entry.kind == ENTRY_NOT_APPLIED) {
			uint64_t number;

			memcpy(&number, entry.data, 8);
			pipeline_skip(pipeline, number);
		}
		data += entry.len;
		len -= entry.len;
	}
}

static int feed_record(const struct entry *entry, int devices, struct pipeline *pipeline)
{
	struct record record = {.device = entry->data[16], .direction = entry->data[17] ? TO_DEVICE : FROM_DEVICE};

	if (record.device >= devices)
		return -EINVAL;
	memcpy(&record.log_ns, entry->data, 8);
	memcpy(&record.t_ns, entry->data + 8, 8);
	record.bytes = entry->data + RECORD_HEAD;
	record.len = entry->len - 1 - RECORD_HEAD;
	pipeline_handle(pipeline, &record);
	return 0;
}

static int feed_all(const uint8_t *data, size_t len, struct pipeline *pipeline, void (*reset)(void *ctx), void *ctx)
{
	int devices = pipeline_devices(pipeline);
	struct entry entry;
	int64_t ns;
	int r;

	feed_skips(data, len, pipeline);
	while ((r = entry_at(data, len, &entry)) == 1) {
		data += entry.len;
		len -= entry.len;
		if (entry.kind == ENTRY_RECORD && feed_record(&entry, devices, pipeline) < 0)
			return -EINVAL;
		if (entry.kind == ENTRY_TICK) {
			memcpy(&ns, entry.data, 8);
			pipeline_tick(pipeline, ns);
		}
		if (entry.kind == ENTRY_CLOCK) {
			memcpy(&ns, entry.data, 8);
			pipeline_clock(pipeline, ns);
		}
		if (entry.kind == ENTRY_RESET) {
			pipeline_reset(pipeline);
			if (reset)
				reset(ctx);
			feed_skips(data, len, pipeline);
		}
	}
	return r;
}

int journal_feed(const char *path, struct pipeline *pipeline, void (*reset)(void *ctx), void *ctx, char error[160])
{
	int fd = open(path, O_RDONLY | O_CLOEXEC), r = -EINVAL;
	struct stat st;
	uint8_t *data;

	if (fd < 0 || fstat(fd, &st) < 0) {
		r = -errno;
		snprintf(error, 160, "%.100s: cannot be read (%s)", path, strerror(errno));
		goto close_fd;
	}
	if ((size_t)st.st_size < sizeof(MAGIC)) {
		snprintf(error, 160, "%.100s: is no journal; give a file that facetd --journal wrote", path);
		goto close_fd;
	}
	data = mmap(NULL, (size_t)st.st_size, PROT_READ, MAP_PRIVATE, fd, 0);
	if (data == MAP_FAILED) {
		r = -errno;
		snprintf(error, 160, "%.100s: cannot be mapped (%s)", path, strerror(errno));
		goto close_fd;
	}
	if (memcmp(data, MAGIC, sizeof(MAGIC)) == 0)
		r = feed_all(data + sizeof(MAGIC), (size_t)st.st_size - sizeof(MAGIC), pipeline, reset, ctx);
	if (r < 0)
		snprintf(error, 160, "%.100s: is no journal, or one of other devices", path);
	munmap(data, (size_t)st.st_size);
close_fd:
	if (fd >= 0)
		close(fd);
	return r;
}

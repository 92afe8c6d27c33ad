/* Kept lists (daemon/journal.h) as a source. Steps of the wall clock have no time of their own in a list: they take that of
 * the entry before. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/journal.h"
#include "daemon/replay_source.h"

struct replay_source {
	const uint8_t *data;
	size_t len, at;
	int devices;
	int64_t log_ns;
};

static bool journal_found(const struct replay_file *file)
{
	return journal_is(file->data, file->len) != -EINVAL;
}

static int journal_open(const struct replay_file *file, struct replay_source **ret, char error[REPLAY_SENTENCE_MAX])
{
	struct replay_source *s;

	if (journal_is(file->data, file->len) < 0) {
		snprintf(error, REPLAY_SENTENCE_MAX, "was written by an older facetd and cannot be read; keep it anew");
		return -EINVAL;
	}
	s = calloc(1, sizeof(*s));
	if (!s)
		return -ENOMEM;
	s->data = file->data;
	s->len = file->len;
	s->at = JOURNAL_MAGIC;
	s->devices = CONFIG_DEVICES_MAX;
	*ret = s;
	return 0;
}

static void journal_close(struct replay_source *s)
{
	free(s);
}

static int journal_use(struct replay_source *s, const struct config *config, char error[REPLAY_SENTENCE_MAX])
{
	(void)error;
	s->devices = config->devices;
	return 0;
}

static void journal_rewind(struct replay_source *s)
{
	s->at = JOURNAL_MAGIC;
	s->log_ns = 0;
}

static int damaged(char error[REPLAY_SENTENCE_MAX], const char *sentence)
{
	snprintf(error, REPLAY_SENTENCE_MAX, "%s; the list is damaged", sentence);
	return -EINVAL;
}

static int timed(struct replay_source *s, int64_t log_ns, char error[REPLAY_SENTENCE_MAX])
{
	if (log_ns < STATE_TIME_MIN || log_ns > STATE_TIME_MAX || (s->log_ns && log_ns < s->log_ns))
		return damaged(error, "a time that runs backwards");
	s->log_ns = log_ns;
	return 1;
}

static int record_event(struct replay_source *s, const struct journal_entry *entry, struct replay_event *ret,
                        char error[REPLAY_SENTENCE_MAX])
{
	ret->kind = REPLAY_RECORD;
	journal_record(entry, &ret->record);
	if (ret->record.device >= s->devices || ret->record.direction > LINK_OPENED ||
	    ret->record.t_ns < STATE_TIME_MIN || ret->record.t_ns > STATE_TIME_MAX)
		return damaged(error, "a record of a device that is not there");
	return timed(s, ret->record.log_ns, error);
}

static int event_of(struct replay_source *s, const struct journal_entry *entry, struct replay_event *ret,
                    char error[REPLAY_SENTENCE_MAX])
{
	int64_t value;

	memcpy(&value, entry->data, entry->kind == JOURNAL_SNAPSHOT ? 4 : 8);
	switch (entry->kind) {
	case JOURNAL_SNAPSHOT:
		if (entry->data != s->data + JOURNAL_MAGIC + 1)
			return damaged(error, "a second beginning");
		ret->kind = REPLAY_BEGIN;
		ret->bytes = entry->data + 4;
		ret->len = entry->len - 1 - 4;
		return 1;
	case JOURNAL_RECORD:
		return record_event(s, entry, ret, error);
	case JOURNAL_TICK:
		ret->kind = REPLAY_TICK;
		return timed(s, value, error);
	case JOURNAL_NOT_APPLIED:
		ret->kind = REPLAY_NOT_APPLIED;
		ret->number = (uint64_t)value;
		return 1;
	default:
		ret->kind = REPLAY_CLOCK;
		ret->ahead_ns = value;
		return value >= STATE_TIME_MIN && value <= STATE_TIME_MAX
		           ? 1
		           : damaged(error, "a wall clock of another age");
	}
}

static int journal_next(struct replay_source *s, struct replay_event *ret, char error[REPLAY_SENTENCE_MAX])
{
	struct replay_event event = {0};
	struct journal_entry entry;
	int r = journal_entry_at(s->data + s->at, s->len - s->at, &entry);

	if (r < 0)
		return damaged(error, "an unknown entry");
	if (r == 0)
		return 0;
	if (s->at == JOURNAL_MAGIC && entry.kind != JOURNAL_SNAPSHOT)
		return damaged(error, "no snapshot at the beginning");
	r = event_of(s, &entry, &event, error);
	if (r < 0)
		return r;
	s->at += entry.len;
	event.log_ns = s->log_ns;
	*ret = event;
	return 1;
}

static bool journal_span(struct replay_source *s, int64_t *ret_first_ns, int64_t *ret_last_ns)
{
	char error[REPLAY_SENTENCE_MAX];
	struct replay_event event;
	int64_t first_ns = 0;

	journal_rewind(s);
	while (journal_next(s, &event, error) == 1)
		if (!first_ns)
			first_ns = s->log_ns;
	*ret_first_ns = first_ns;
	*ret_last_ns = s->log_ns;
	journal_rewind(s);
	return first_ns != 0;
}

const struct replay_format replay_journal = {.name = "a kept journal",
                                             .order = REPLAY_CHAINED,
                                             .is = journal_found,
                                             .open = journal_open,
                                             .close = journal_close,
                                             .use = journal_use,
                                             .span = journal_span,
                                             .next = journal_next,
                                             .rewind = journal_rewind};

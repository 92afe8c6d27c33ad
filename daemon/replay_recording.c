/* Recordings (MCAP, daemon/recording.h) as a source. Damage is told and passed over: what is whole behind it is replayed, and
 * records of devices that the configuration does not have are left out and counted. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/recording.h"
#include "daemon/replay_source.h"

struct replay_source {
	struct recording_reader *reader;
	uint64_t strangers; /* records of devices that are not configured */
	uint64_t damages;
	char damage[120]; /* the first */
};

static bool recording_found(const struct replay_file *file)
{
	return file->len >= MCAP_MAGIC && memcmp(file->data, "\x89MCAP0\r\n", MCAP_MAGIC) == 0;
}

static int recording_open(const struct replay_file *file, struct replay_source **ret, char error[REPLAY_SENTENCE_MAX])
{
	struct replay_source *s = calloc(1, sizeof(*s));
	int r = -ENOMEM;

	if (s)
		r = recording_reader_create(file->data, file->len, &s->reader, error);
	if (r < 0)
		free(s);
	else
		*ret = s;
	return r;
}

static void recording_close(struct replay_source *s)
{
	recording_reader_destroy(s->reader);
	free(s);
}

static const char *recording_config(const struct replay_source *s, size_t *ret_len)
{
	return recording_reader_config(s->reader, ret_len);
}

static int recording_use(struct replay_source *s, const struct config *config, char error[REPLAY_SENTENCE_MAX])
{
	(void)error;
	recording_reader_use(s->reader, config);
	return 0;
}

static bool recording_span(struct replay_source *s, int64_t *ret_first_ns, int64_t *ret_last_ns)
{
	recording_reader_span(s->reader, ret_first_ns, ret_last_ns);
	return *ret_last_ns != 0;
}

static void begin_event(const struct recording_begin *begin, struct replay_event *ret)
{
	ret->kind = REPLAY_BEGIN;
	ret->bytes = begin->snapshot;
	ret->len = begin->len;
	ret->session = begin->session;
	ret->part = begin->part;
}

/* False: nothing that a replay needs. */
static bool take(struct replay_source *s, const struct recording_event *event, struct replay_event *ret)
{
	switch (event->kind) {
	case RECORDING_BEGIN:
		begin_event(&event->begin, ret);
		return true;
	case RECORDING_SKIP:
		ret->kind = REPLAY_NOT_APPLIED;
		ret->number = event->skip;
		return true;
	case RECORDING_RECORD:
		ret->kind = REPLAY_RECORD;
		ret->record = event->record;
		s->strangers += event->record.device < 0;
		return event->record.device >= 0;
	case RECORDING_TICK:
		ret->kind = REPLAY_TICK;
		return true;
	case RECORDING_CLOCK:
		ret->kind = REPLAY_CLOCK;
		ret->ahead_ns = event->ahead_ns;
		return true;
	case RECORDING_EVENT:
		ret->kind = REPLAY_EVENT;
		ret->bytes = (const uint8_t *)event->json.text;
		ret->len = event->json.len;
		return true;
	case RECORDING_END:
		ret->kind = REPLAY_END;
		return true;
	case RECORDING_DAMAGED:
		if (s->damages++ == 0)
			snprintf(s->damage, sizeof(s->damage), "%s", event->damage);
		return false;
	case RECORDING_CONTROL:
		return false;
	}
	return false;
}

static int recording_next(struct replay_source *s, struct replay_event *ret, char error[REPLAY_SENTENCE_MAX])
{
	struct recording_event event;
	int r;

	(void)error;
	while ((r = recording_reader_next(s->reader, &event)) == 1) {
		struct replay_event found = {.log_ns = event.log_ns};

		if (!take(s, &event, &found))
			continue;
		*ret = found;
		return 1;
	}
	return r;
}

static void recording_rewind(struct replay_source *s)
{
	recording_reader_rewind(s->reader);
	s->strangers = s->damages = 0;
}

static void recording_note(const struct replay_source *s, char ret[REPLAY_SENTENCE_MAX])
{
	*ret = 0;
	if (s->damages)
		snprintf(ret, REPLAY_SENTENCE_MAX, "damaged at %llu place%s (%s); what is whole was replayed",
		         (unsigned long long)s->damages, s->damages > 1 ? "s" : "", s->damage);
	else if (s->strangers)
		snprintf(ret, REPLAY_SENTENCE_MAX, "%llu records of devices that the configuration does not have",
		         (unsigned long long)s->strangers);
}

const struct replay_format replay_recording = {.name = "a recording",
                                               .order = REPLAY_CHAINED,
                                               .is = recording_found,
                                               .open = recording_open,
                                               .close = recording_close,
                                               .config = recording_config,
                                               .use = recording_use,
                                               .span = recording_span,
                                               .next = recording_next,
                                               .rewind = recording_rewind,
                                               .note = recording_note};

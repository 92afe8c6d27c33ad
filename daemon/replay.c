/* Sources joined to one sequence of events.
 *
 *   chained   recordings and journals, one file after the other by their first time. The next file of a rotation begins
 *             with the state that the one before it came to: replay_feed compares, and goes on where it is the same. Where
 *             it is not (a file is missing between), or where a file is alone, the map begins empty with the snapshot.
 *   merged    imports, by time; equal times in the order of the files. They know no ticks, so these are made up, 10 a
 *             second from the first event on: deadlines that change the map are judged by them as live (law L7).
 *
 * A row that was not applied must be known before the event that completes it. Journals tell it behind that event and recordings
 * before it, so one event is held back: whatever is told between two events belongs to the one held, and telling a number
 * too early does no harm. Its bytes are copied, since its source moves on.
 *
 * To go back means to begin again, at the latest beginning of a map that was met on the way here (each has its snapshot). */
#include "daemon/replay.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/replay_source.h"

#define TICK_NS    100000000
#define SILENCE_NS 3000000000ll /* a longer one has ticks at its beginning only: nothing waits any more after it */
#define BEGINS_MAX 65536
#define SKIPS_MAX  (1u << 20)
#define NOTE_MAX   400
#define NO_TIME    INT64_MAX

static const struct replay_format *const formats[] = {
    &replay_recording, &replay_journal, &replay_candump, &replay_poses, &replay_carmen, &replay_capture, &replay_scan};

struct source {
	char *path;
	struct replay_file file;
	const struct replay_format *format;
	struct replay_source *state; /* NULL: not open now */
	int64_t first_ns, last_ns, shift_ns;
	bool has_next; /* merged: `next` waits */
	struct replay_event next;
};

struct held {
	struct replay_event event;
	uint8_t *bytes;
	size_t cap;
	int file;     /* chained */
	uint64_t nth; /* BEGIN: of its file */
};

struct replay {
	struct source *source;
	int n;
	bool merged;
	const struct config *config;
	char *text; /* of the configuration that came with it */
	size_t text_len;
	int64_t first_ns, last_ns;

	/* Where it is */
	int current;         /* chained: the file that is read */
	uint64_t begins_met; /* in that file */
	bool begun;          /* merged: its BEGIN was told */
	int64_t tick_ns;     /* merged: the next; NO_TIME: none yet */
	int64_t log_ns;      /* of the last event */
	uint64_t rows;       /* of scans */
	uint64_t session;    /* of the file before */
	uint32_t part;
	bool ended;
	struct held held[2];
	int ahead; /* which of them comes next */
	bool has_ahead;
	int failure; /* of what comes after it */
	char sentence[REPLAY_ERROR_MAX];
	uint64_t *skip;
	size_t skips, skips_cap;

	/* What the pipeline made of it */
	bool started, fresh;
	struct beginning {
		int64_t log_ns;
		int file;
		uint64_t nth;
	} * begin;
	size_t begins;
	int begin_file;
	uint64_t begin_nth;
	uint8_t *snapshot;
	size_t snapshot_cap;
	char note[NOTE_MAX];
};

static int refuse(char error[REPLAY_ERROR_MAX], const char *path, const char *sentence, int r)
{
	snprintf(error, REPLAY_ERROR_MAX, "%.110s: %s", path, r == -ENOMEM ? "out of memory" : sentence);
	return r;
}

/* Files */

static int map_file(struct source *s, char error[REPLAY_ERROR_MAX])
{
	char sentence[REPLAY_SENTENCE_MAX];
	int fd = open(s->path, O_RDONLY | O_CLOEXEC | O_NONBLOCK), r = fd < 0 ? -errno : 0;
	struct stat st = {0};
	void *data;

	if (r == 0 && fstat(fd, &st) < 0)
		r = -errno;
	if (r == 0 && !S_ISREG(st.st_mode))
		r = -EINVAL;
	if (r == 0 && st.st_size > 0) {
		data = mmap(NULL, (size_t)st.st_size, PROT_READ, MAP_PRIVATE, fd, 0);
		if (data == MAP_FAILED)
			r = -errno;
		else
			s->file = (struct replay_file){s->path, data, (size_t)st.st_size};
	}
	if (fd >= 0)
		close(fd);
	if (r == -EINVAL)
		return refuse(error, s->path, "is no ordinary file; save it to one first", r);
	snprintf(sentence, sizeof(sentence), "cannot be read (%s)", strerror(-r));
	return r < 0 ? refuse(error, s->path, sentence, r) : 0;
}

static int recognise(struct source *s, char error[REPLAY_ERROR_MAX])
{
	for (size_t i = 0; i < sizeof(formats) / sizeof(*formats); i++)
		if (formats[i]->is(&s->file)) {
			s->format = formats[i];
			return 0;
		}
	return refuse(error, s->path,
	              "is no recording that can be replayed; give a recording (.mcap), a candump log, a pcap or pcapng "
	              "of a scanner's TCP, a CARMEN log, poses as JSON lines or a folder of uos scans",
	              -EINVAL);
}

static int open_state(struct replay *p, struct source *s, char error[REPLAY_ERROR_MAX])
{
	char sentence[REPLAY_SENTENCE_MAX] = "";
	int r;

	if (s->state)
		return 0;
	r = s->format->open(&s->file, &s->state, sentence);
	if (r == 0 && p->config && s->format->use) {
		r = s->format->use(s->state, p->config, sentence);
		if (r < 0) {
			s->format->close(s->state);
			s->state = NULL;
		}
	}
	return r < 0 ? refuse(error, s->path, sentence, r) : 0;
}

static void close_state(struct replay *p, struct source *s)
{
	char sentence[REPLAY_SENTENCE_MAX] = "";

	if (!s->state)
		return;
	if (s->format->note)
		s->format->note(s->state, sentence);
	if (*sentence && strlen(p->note) + strlen(s->path) + strlen(sentence) + 4 < sizeof(p->note)) {
		snprintf(p->note + strlen(p->note), sizeof(p->note) - strlen(p->note), "%s%s: %s", *p->note ? "; " : "",
		         s->path, sentence);
	}
	s->format->close(s->state);
	s->state = NULL;
}

static int add_file(struct replay *p, const char *path, char error[REPLAY_ERROR_MAX])
{
	struct source *s = &p->source[p->n];
	int r;

	if (p->n == REPLAY_FILES_MAX)
		return refuse(error, path, "too many files; 1024 are possible", -E2BIG);
	*s = (struct source){.path = strdup(path)};
	if (!s->path)
		return refuse(error, path, "", -ENOMEM);
	p->n++;
	r = map_file(s, error);
	return r < 0 ? r : recognise(s, error);
}

static int by_name(const struct dirent **a, const struct dirent **b)
{
	return strcmp((*a)->d_name, (*b)->d_name);
}

static bool ends_with(const char *name, const char *ending)
{
	size_t n = strlen(name), len = strlen(ending);

	return n > len && strcmp(name + n - len, ending) == 0;
}

/* Scans where there are any, else recordings. */
static int add_folder(struct replay *p, const char *path, char error[REPLAY_ERROR_MAX])
{
	struct dirent **entry = NULL;
	int n = scandir(path, &entry, NULL, by_name), r = 0, before = p->n;
	const char *const ending[] = {".3d", ".mcap"};
	char *name;

	for (int k = 0; k < 2 && p->n == before; k++)
		for (int i = 0; i < n && r == 0; i++) {
			if (!ends_with(entry[i]->d_name, ending[k]))
				continue;
			if (asprintf(&name, "%s/%s", path, entry[i]->d_name) < 0) {
				r = refuse(error, path, "", -ENOMEM);
				break;
			}
			r = add_file(p, name, error);
			free(name);
		}
	for (int i = 0; i < n; i++)
		free(entry[i]);
	free(entry);
	if (r == 0 && p->n == before)
		return refuse(error, path, "no scans (.3d) and no recordings (.mcap) are in this folder", -ENOENT);
	return r;
}

static int add_files(struct replay *p, const char *const *files, int n, char error[REPLAY_ERROR_MAX])
{
	struct stat st;
	int r = 0;

	for (int i = 0; i < n && r == 0; i++)
		r = stat(files[i], &st) == 0 && S_ISDIR(st.st_mode) ? add_folder(p, files[i], error)
		                                                    : add_file(p, files[i], error);
	for (int i = 1; i < p->n && r == 0; i++)
		if (p->source[i].format->order != p->source[0].format->order) {
			snprintf(error, REPLAY_ERROR_MAX,
			         "%.100s is %s and %.100s %s: they cannot be replayed together", p->source[0].path,
			         p->source[0].format->name, p->source[i].path, p->source[i].format->name);
			r = -EINVAL;
		}
	p->merged = r == 0 && p->n > 0 && p->source[0].format->order == REPLAY_MERGED;
	return r;
}

/* Insertion keeps the order of those without a time behind the one they were named after. */
static void sort_files(struct replay *p)
{
	for (int i = 1; i < p->n; i++)
		for (int k = i; k > 0 && p->source[k].first_ns < p->source[k - 1].first_ns; k--) {
			struct source swap = p->source[k];

			p->source[k] = p->source[k - 1];
			p->source[k - 1] = swap;
		}
}

static void note_span(struct replay *p, struct source *s, int i)
{
	if (s->format->order == REPLAY_TIMELESS) {
		s->shift_ns = i * REPLAY_SCAN_NS;
		s->first_ns = s->shift_ns;
		s->last_ns = s->shift_ns + REPLAY_SCAN_NS;
	} else if (!s->format->span(s->state, &s->first_ns, &s->last_ns)) {
		s->first_ns = i > 0 ? p->source[i - 1].first_ns : 0;
		s->last_ns = s->first_ns;
		return;
	}
	if (p->first_ns == NO_TIME || s->first_ns < p->first_ns)
		p->first_ns = s->first_ns;
	if (s->last_ns > p->last_ns)
		p->last_ns = s->last_ns;
}

static int keep_config(struct replay *p, const struct source *s)
{
	size_t len = 0;
	const char *text = s->format->config ? s->format->config(s->state, &len) : NULL;

	if (!text || p->text)
		return 0;
	p->text = malloc(len + 1);
	if (!p->text)
		return -ENOMEM;
	memcpy(p->text, text, len);
	p->text[len] = 0;
	p->text_len = len;
	return 0;
}

/* Chained files are looked at one after the other, so a long rotation costs no memory. */
static int look(struct replay *p, char error[REPLAY_ERROR_MAX])
{
	int r = 0;

	for (int i = 0; i < p->n && r == 0; i++) {
		struct source *s = &p->source[i];

		r = open_state(p, s, error);
		if (r == 0 && keep_config(p, s) < 0)
			r = refuse(error, s->path, "", -ENOMEM);
		if (r == 0 && !p->merged) {
			note_span(p, s, i);
			s->format->close(s->state);
			s->state = NULL;
		}
	}
	if (r == 0 && !p->merged)
		sort_files(p);
	return r;
}

int replay_open(const char *const *files, int n, struct replay **ret, char error[REPLAY_ERROR_MAX])
{
	struct replay *p = calloc(1, sizeof(*p));
	int r = -ENOMEM;

	snprintf(error, REPLAY_ERROR_MAX, "out of memory");
	if (p) {
		p->first_ns = NO_TIME;
		p->last_ns = INT64_MIN;
		p->tick_ns = NO_TIME;
		p->source = calloc(REPLAY_FILES_MAX, sizeof(*p->source));
	}
	if (p && p->source)
		r = add_files(p, files, n, error);
	if (r == 0)
		r = look(p, error);
	if (r < 0) {
		replay_close(p);
		return r;
	}
	*ret = p;
	return 0;
}

void replay_close(struct replay *p)
{
	if (!p)
		return;
	for (int i = 0; i < p->n; i++) {
		struct source *s = &p->source[i];

		if (s->state)
			s->format->close(s->state);
		if (s->file.data)
			munmap((void *)(uintptr_t)s->file.data, s->file.len);
		free(s->path);
	}
	for (int i = 0; i < 2; i++) {
		if (p->held[i].event.kind == REPLAY_ROW && p->held[i].event.row)
			row_destroy(p->held[i].event.row);
		free(p->held[i].bytes);
	}
	free(p->source);
	free(p->text);
	free(p->skip);
	free(p->begin);
	free(p->snapshot);
	free(p);
}

const char *replay_config(const struct replay *p, size_t *ret_len)
{
	*ret_len = p->text_len;
	return p->text;
}

void replay_span(const struct replay *p, int64_t *ret_begin_ns, int64_t *ret_end_ns)
{
	const bool empty = p->first_ns == NO_TIME;

	*ret_begin_ns = empty ? 0 : p->first_ns;
	*ret_end_ns = empty ? 0 : p->last_ns;
}

bool replay_ends(const struct replay *p)
{
	return p->n > 0 && p->source[0].format->order != REPLAY_CHAINED;
}

const char *replay_note(const struct replay *p)
{
	return p->note;
}

/* Events one by one */

static int chained_next(struct replay *p, struct replay_event *ret, char error[REPLAY_ERROR_MAX])
{
	char sentence[REPLAY_SENTENCE_MAX] = "is damaged";
	struct source *s;
	int r;

	for (;; p->current++) {
		if (p->current == p->n)
			return 0;
		s = &p->source[p->current];
		if (!s->state)
			p->begins_met = 0;
		r = open_state(p, s, error);
		if (r < 0)
			return r;
		r = s->format->next(s->state, ret, sentence);
		if (r < 0)
			return refuse(error, s->path, sentence, r);
		if (r == 1)
			break;
		close_state(p, s);
	}
	ret->log_ns += s->shift_ns;
	if (ret->kind == REPLAY_BEGIN) {
		p->begins_met++;
		ret->goes_on = p->begins_met == 1 && p->ended && ret->session && ret->session == p->session &&
		               ret->part == p->part + 1;
		p->session = ret->session;
		p->part = ret->part;
	}
	p->ended = ret->kind == REPLAY_END;
	if (ret->kind == REPLAY_ROW)
		ret->row->number = p->rows++;
	return 1;
}

/* The source whose next event is the earliest; -1: all are at their ends. */
static int earliest(struct replay *p, char error[REPLAY_ERROR_MAX], int *ret)
{
	char sentence[REPLAY_SENTENCE_MAX] = "is damaged";
	int best = -1;

	for (int i = 0; i < p->n; i++) {
		struct source *s = &p->source[i];

		if (!s->has_next) {
			int r = s->format->next(s->state, &s->next, sentence);

			if (r < 0)
				return refuse(error, s->path, sentence, r);
			s->has_next = r == 1;
			if (r == 0)
				s->next.log_ns = NO_TIME;
		}
		if (s->next.log_ns != NO_TIME && (best < 0 || s->next.log_ns < p->source[best].next.log_ns))
			best = i;
	}
	*ret = best;
	return 0;
}

static int tick(struct replay *p, int64_t next_ns, struct replay_event *ret)
{
	*ret = (struct replay_event){.kind = REPLAY_TICK, .log_ns = p->tick_ns};
	p->tick_ns += TICK_NS;
	if (next_ns - p->tick_ns > SILENCE_NS && p->tick_ns - p->log_ns > SILENCE_NS)
		p->tick_ns = next_ns;
	return 1;
}

static int merged_next(struct replay *p, struct replay_event *ret, char error[REPLAY_ERROR_MAX])
{
	struct source *s;
	int best, r = earliest(p, error, &best);

	if (r < 0 || best < 0)
		return r;
	s = &p->source[best];
	if (!p->begun) {
		p->begun = true;
		p->log_ns = s->next.log_ns;
		p->tick_ns = s->next.log_ns + TICK_NS;
		*ret = (struct replay_event){.kind = REPLAY_BEGIN, .log_ns = s->next.log_ns};
		return 1;
	}
	if (p->tick_ns <= s->next.log_ns)
		return tick(p, s->next.log_ns, ret);
	*ret = s->next;
	s->has_next = false;
	if (ret->log_ns < p->log_ns) /* a file whose times run backwards: handled now, whatever it says */
		ret->log_ns = p->log_ns;
	p->log_ns = ret->log_ns;
	ret->record.log_ns = ret->log_ns;
	return 1;
}

static bool add_skip(struct replay *p, uint64_t number)
{
	if (p->skips == p->skips_cap) {
		size_t cap = p->skips_cap ? 2 * p->skips_cap : 64;
		uint64_t *grown = cap > SKIPS_MAX ? NULL : realloc(p->skip, cap * sizeof(*grown));

		if (!grown)
			return false;
		p->skip = grown;
		p->skips_cap = cap;
	}
	p->skip[p->skips++] = number;
	return true;
}

/* Copies what the source will not keep. */
static int hold(struct replay *p, struct held *h, const struct replay_event *event)
{
	const bool record = event->kind == REPLAY_RECORD;
	const size_t len = record ? event->record.len : event->len;
	const uint8_t *bytes = record ? event->record.bytes : event->bytes;

	if (h->cap < len) {
		uint8_t *grown = realloc(h->bytes, len);

		if (!grown)
			return -ENOMEM;
		h->bytes = grown;
		h->cap = len;
	}
	if (len > 0)
		memcpy(h->bytes, bytes, len);
	h->event = *event;
	if (record)
		h->event.record.bytes = h->bytes;
	else
		h->event.bytes = h->bytes;
	h->file = p->current;
	h->nth = p->begins_met;
	return 0;
}

/* Into the slot that is not `ahead`; gathers the numbers told before it. 1, 0, -errno. */
static int fetch(struct replay *p, struct held *h, char error[REPLAY_ERROR_MAX])
{
	struct replay_event event;
	int r;

	while ((r = p->merged ? merged_next(p, &event, error) : chained_next(p, &event, error)) == 1) {
		if (event.kind == REPLAY_END)
			continue;
		if (event.kind != REPLAY_NOT_APPLIED)
			break;
		if (!add_skip(p, event.number))
			return refuse(error, p->source[p->current].path, "", -ENOMEM);
	}
	if (r != 1)
		return r;
	r = hold(p, h, &event);
	return r < 0 ? refuse(error, p->source[p->current].path, "", r) : 1;
}

int replay_next(struct replay *p, struct replay_event *ret, char error[REPLAY_ERROR_MAX])
{
	struct held *h;
	int r = 1;

	p->skips = 0;
	if (p->failure < 0) {
		snprintf(error, REPLAY_ERROR_MAX, "%s", p->sentence);
		return p->failure;
	}
	if (!p->has_ahead)
		r = fetch(p, &p->held[p->ahead], error);
	if (r != 1)
		return r;
	h = &p->held[p->ahead];
	p->ahead = !p->ahead;
	r = fetch(p, &p->held[p->ahead], error);
	p->has_ahead = r == 1;
	p->failure = r < 0 ? r : 0;
	if (r < 0)
		snprintf(p->sentence, sizeof(p->sentence), "%s", error);
	*ret = h->event;
	if (h->event.kind == REPLAY_ROW)
		h->event.row = NULL;
	/* A beginning without a time of its own has that of what follows. */
	if (ret->kind == REPLAY_BEGIN && ret->log_ns == 0 && p->has_ahead)
		ret->log_ns = p->held[p->ahead].event.log_ns;
	if (ret->kind == REPLAY_BEGIN) {
		p->begin_file = h->file;
		p->begin_nth = h->nth;
	}
	ret->skip = p->skip;
	ret->skips = p->skips;
	return 1;
}

int64_t replay_next_ns(const struct replay *p)
{
	if (!p->has_ahead)
		return p->started ? NO_TIME : p->first_ns;
	return p->held[p->ahead].event.log_ns;
}

/* Back */

static const struct beginning *beginning_at(const struct replay *p, int64_t t_ns)
{
	const struct beginning *best = NULL;

	for (size_t i = 0; i < p->begins && p->begin[i].log_ns <= t_ns; i++)
		best = &p->begin[i];
	return best;
}

int64_t replay_back_ns(const struct replay *p, int64_t t_ns)
{
	const struct beginning *begin = beginning_at(p, t_ns);

	return begin ? begin->log_ns : p->first_ns;
}

static void rewind_all(struct replay *p, int current)
{
	if (p->has_ahead && p->held[p->ahead].event.kind == REPLAY_ROW)
		row_destroy(p->held[p->ahead].event.row);
	p->held[0].event.row = p->held[1].event.row = NULL;
	p->has_ahead = p->begun = p->started = p->fresh = p->ended = false;
	p->skips = 0;
	p->rows = 0;
	p->session = 0;
	p->current = current;
	p->begins_met = 0;
	p->log_ns = 0;
	p->failure = 0;
	p->tick_ns = NO_TIME;
	*p->note = 0;
	for (int i = 0; i < p->n; i++) {
		struct source *s = &p->source[i];

		if (s->state)
			s->format->rewind(s->state);
		s->has_next = false;
	}
}

int replay_back(struct replay *p, int64_t t_ns, char error[REPLAY_ERROR_MAX])
{
	const struct beginning *begin = beginning_at(p, t_ns);
	const uint64_t nth = begin ? begin->nth : 1;
	int r;

	rewind_all(p, begin ? begin->file : 0);
	if (nth <= 1)
		return 0;
	while (p->begins_met < nth) { /* only read, not handed to anybody */
		r = fetch(p, &p->held[p->ahead], error);
		p->has_ahead = r == 1;
		if (r != 1)
			return r < 0 ? r
			             : refuse(error, p->source[0].path, "has changed while it was replayed", -EINVAL);
	}
	p->skips = 0;
	return 0;
}

/* Feeding */

static void note_beginning(struct replay *p, int64_t log_ns)
{
	struct beginning *grown;

	if (p->merged || p->begins == BEGINS_MAX || (p->begins > 0 && p->begin[p->begins - 1].log_ns >= log_ns))
		return;
	grown = realloc(p->begin, (p->begins + 1) * sizeof(*grown));
	if (!grown) /* going back then takes longer */
		return;
	p->begin = grown;
	p->begin[p->begins++] = (struct beginning){log_ns, p->begin_file, p->begin_nth};
}

/* Does the pipeline stand where the snapshot says? */
static bool same_state(struct replay *p, const struct replay_event *event, struct pipeline *pipeline)
{
	char error[160];
	struct state s;

	state_save(&s, NULL, 0);
	pipeline_state(pipeline, &s, error);
	if (s.at != event->len)
		return false;
	if (p->snapshot_cap < s.at) {
		uint8_t *grown = realloc(p->snapshot, s.at);

		if (!grown)
			return false;
		p->snapshot = grown;
		p->snapshot_cap = s.at;
	}
	state_save(&s, p->snapshot, p->snapshot_cap);
	pipeline_state(pipeline, &s, error);
	return memcmp(p->snapshot, event->bytes, event->len) == 0;
}

static int load(const struct replay_event *event, struct pipeline *pipeline, char error[160])
{
	struct state s;

	pipeline_reset(pipeline);
	state_load(&s, event->bytes, event->len);
	pipeline_state(pipeline, &s, error);
	return s.failed && event->len > 0 ? -EINVAL : 0; /* nothing to load leaves it as new */
}

static int begin(struct replay *p, const struct replay_event *event, struct pipeline *pipeline, bool *ret_anew,
                 char error[REPLAY_ERROR_MAX])
{
	const bool fresh = p->fresh, first = !p->started;
	char sentence[160];

	p->fresh = false;
	p->started = true;
	if (!first && event->goes_on && same_state(p, event, pipeline))
		return 0;
	note_beginning(p, event->log_ns);
	if (!first && fresh && same_state(p, event, pipeline))
		return 0;
	*ret_anew = !first && !fresh;
	if (load(event, pipeline, sentence) < 0)
		return refuse(error, p->source[p->begin_file].path, sentence, -EINVAL);
	return 0;
}

int replay_feed(struct replay *p, const struct replay_event *event, struct pipeline *pipeline, bool *ret_anew,
                char error[REPLAY_ERROR_MAX])
{
	int r = 0;

	*ret_anew = false;
	if (event->kind == REPLAY_BEGIN)
		r = begin(p, event, pipeline, ret_anew, error);
	else if (event->kind != REPLAY_EVENT)
		p->fresh = false;
	for (size_t i = 0; i < event->skips; i++)
		pipeline_skip(pipeline, event->skip[i]);
	if (event->kind == REPLAY_RECORD)
		pipeline_handle(pipeline, &event->record);
	else if (event->kind == REPLAY_TICK)
		pipeline_tick(pipeline, event->log_ns);
	else if (event->kind == REPLAY_CLOCK)
		pipeline_clock(pipeline, event->ahead_ns);
	return r;
}

void replay_began(struct replay *p)
{
	p->fresh = true;
}

/* Imports are gone through once: what is wrong with them is said before the map begins. */
int replay_use(struct replay *p, const struct config *config, char error[REPLAY_ERROR_MAX])
{
	int r = 0;

	p->config = config;
	for (int i = 0; i < p->n && p->merged && r == 0; i++) {
		struct source *s = &p->source[i];
		char sentence[REPLAY_SENTENCE_MAX] = "";

		r = s->format->use ? s->format->use(s->state, config, sentence) : 0;
		if (r < 0)
			return refuse(error, s->path, sentence, r);
		note_span(p, s, i);
		s->format->rewind(s->state);
	}
	return r;
}

/* See recorder.h. The queue is two buffers of plain items: the loop fills one, the thread works through the other, and they
 * change places. Everything the loop and the thread share is behind one lock, held for the copy of an item or the exchange, never
 * while something is compressed or written.
 *
 * The thread knows a file only between a BEGIN and what ends it; items outside are dropped and counted. Files are written in place
 * under their final name: a recording that was cut is a recording. A file that could not take its first chunk is removed. */
#include "daemon/recorder.h"

#include <errno.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <syslog.h>
#include <time.h>
#include <unistd.h>

#include "daemon/recording_folder.h"

#define NOTICES_MAX   4 /* not yet taken; further ones are dropped */
#define WAKE_BYTES    (256u << 10)
#define RETRY_MIN_NS  INT64_C(2000000000)
#define RETRY_MAX_NS  INT64_C(60000000000)
#define AGE_MIN_NS    INT64_C(1000000000) /* of a file that is ended because of its size */
#define KEEP_CHECK    (1u << 20)          /* bytes written between two looks at the folder */
#define LEVEL         1                   /* of zstd */
#define KEEP_PARTS    4                   /* files that `keep` holds where max_size says nothing */
#define RECORDER_NAME "facetd-recorder"

enum item_kind {
	ITEM_BEGIN,
	ITEM_RECORD,
	ITEM_TICK,
	ITEM_SKIP,
	ITEM_CLOCK,
	ITEM_EVENT,
	ITEM_CONTROL,
	ITEM_MESSAGE,
	ITEM_END
};

struct item {
	enum item_kind kind;
	struct record record; /* RECORD; its bytes follow */
	int64_t value;        /* log_ns, number, ahead_ns */
	struct recording_begin begin;
	size_t len; /* of what follows */
};

/* What the thread writes to. */
struct place {
	struct recording_writer *writer;
	struct buffer out; /* not yet written */
	int fd;            /* -1: none, or a stream */
	uint64_t bytes;    /* that are on the disk */
	uint64_t checked;  /* bytes at the last look at the folder */
	int64_t begun_ns;
	uint32_t chunks;
	bool begun; /* a whole chunk is there */
	char path[RECORDING_PATH_MAX];
};

struct recorder {
	struct recorder_params params;
	char *config_text, *dir;
	pthread_t thread;
	struct place place; /* the thread's */
	int64_t log_ns;     /* of the item at hand */
	int64_t pause_ns;   /* before the next try */

	pthread_mutex_t lock; /* of all that follows */
	pthread_cond_t wake;
	struct buffer queue, work; /* `work` is the thread's */
	struct buffer stream;
	size_t stream_at;
	char stream_reason[320];
	bool stop, stream_ended;
	bool active;     /* the queue goes to a file: a BEGIN is in it or was */
	bool overflown;  /* ... until here: the file is to end */
	bool rotate;     /* the file is long or old enough */
	bool begun;      /* once at least */
	unsigned begins; /* in the queue */
	bool fresh;      /* ... or was since recorder_begun */
	int64_t retry_ns;
	uint64_t session;
	uint32_t part;
	struct recorder_notice notice[NOTICES_MAX];
	int notices;
	struct recorder_status status;
};

/* The loop's side */

/* Under the lock: room for an item. */
static bool fits(struct recorder *r, size_t len)
{
	if (!r->active) {
		r->status.dropped += r->status.enabled;
		return false;
	}
	if (r->queue.len + len <= RECORDER_QUEUE_BYTES && buffer_reserve(&r->queue, len))
		return true;
	r->queue.error = 0;
	r->overflown = true;
	r->active = false;
	r->status.dropped++;
	r->status.gaps++;
	return false;
}

/* The item and what follows it. */
static void push(struct recorder *r, struct item item, const void *data, size_t len)
{
	bool wakes;

	item.len = len;
	pthread_mutex_lock(&r->lock);
	if (fits(r, sizeof(item) + len)) {
		buffer_append(&r->queue, &item, sizeof(item));
		buffer_append(&r->queue, data, len);
		r->begins += item.kind == ITEM_BEGIN;
		r->fresh |= item.kind == ITEM_BEGIN;
	}
	if (r->queue.len > r->status.queued_peak)
		r->status.queued_peak = r->queue.len;
	wakes = r->overflown || item.kind == ITEM_BEGIN || item.kind == ITEM_TICK || item.kind == ITEM_END ||
	        r->queue.len > WAKE_BYTES;
	if (wakes)
		pthread_cond_signal(&r->wake);
	pthread_mutex_unlock(&r->lock);
}

bool recorder_wants_begin(struct recorder *r, int64_t log_ns)
{
	bool wants;

	pthread_mutex_lock(&r->lock);
	wants = r->status.enabled && (r->active ? r->rotate : !r->overflown && log_ns >= r->retry_ns);
	if (!r->dir)
		wants = wants && !r->begun;
	pthread_mutex_unlock(&r->lock);
	return wants;
}

void recorder_begin(struct recorder *r, const struct recording_begin *begin)
{
	struct item item = {.kind = ITEM_BEGIN, .begin = *begin};
	bool enabled;

	pthread_mutex_lock(&r->lock);
	enabled = r->status.enabled && !r->overflown;
	if (enabled && !r->active) {
		r->active = true;
		r->session++;
		r->part = 0;
	} else {
		r->part++;
	}
	r->rotate = false;
	r->begun = true;
	item.begin.session = r->session;
	item.begin.part = r->part;
	pthread_mutex_unlock(&r->lock);
	if (enabled)
		push(r, item, begin->snapshot, begin->len);
}

void recorder_enable(struct recorder *r, bool enable)
{
	bool ends;

	pthread_mutex_lock(&r->lock);
	ends = r->active && !enable;
	r->status.enabled = enable;
	r->retry_ns = INT64_MIN;
	pthread_mutex_unlock(&r->lock);
	if (!ends)
		return;
	push(r, (struct item){.kind = ITEM_END}, NULL, 0);
	pthread_mutex_lock(&r->lock);
	r->active = false;
	pthread_mutex_unlock(&r->lock);
}

void recorder_record(struct recorder *r, const struct record *record)
{
	push(r, (struct item){.kind = ITEM_RECORD, .record = *record}, record->bytes, record->len);
}

void recorder_tick(struct recorder *r, int64_t log_ns)
{
	push(r, (struct item){.kind = ITEM_TICK, .value = log_ns}, NULL, 0);
}

void recorder_skip(struct recorder *r, uint64_t number, const char *reason)
{
	push(r, (struct item){.kind = ITEM_SKIP, .value = (int64_t)number}, reason, strlen(reason) + 1);
}

void recorder_clock(struct recorder *r, int64_t ahead_ns)
{
	push(r, (struct item){.kind = ITEM_CLOCK, .value = ahead_ns}, NULL, 0);
}

void recorder_event(struct recorder *r, const char *json, size_t len)
{
	push(r, (struct item){.kind = ITEM_EVENT}, json, len);
}

void recorder_control(struct recorder *r, const char *json, size_t len)
{
	push(r, (struct item){.kind = ITEM_CONTROL}, json, len);
}

void recorder_message(struct recorder *r, enum foxglove_schema schema, const void *data, size_t len)
{
	push(r, (struct item){.kind = ITEM_MESSAGE, .value = schema}, data, len);
}

bool recorder_begun(struct recorder *r)
{
	bool begun;

	pthread_mutex_lock(&r->lock);
	begun = r->fresh;
	r->fresh = false;
	pthread_mutex_unlock(&r->lock);
	return begun;
}

bool recorder_notice(struct recorder *r, struct recorder_notice *ret)
{
	bool any;

	pthread_mutex_lock(&r->lock);
	any = r->notices > 0;
	if (any) {
		*ret = r->notice[0];
		memmove(r->notice, r->notice + 1, (size_t)--r->notices * sizeof(r->notice[0]));
	}
	pthread_mutex_unlock(&r->lock);
	return any;
}

void recorder_status(struct recorder *r, struct recorder_status *ret)
{
	pthread_mutex_lock(&r->lock);
	*ret = r->status;
	ret->queued = r->queue.len;
	pthread_mutex_unlock(&r->lock);
}

bool recorder_take(struct recorder *r, size_t max, struct buffer *ret, char reason[320])
{
	size_t left;
	bool ended;

	pthread_mutex_lock(&r->lock);
	left = r->stream.len - r->stream_at;
	left = left < max ? left : max;
	if (left > 0)
		buffer_append(ret, r->stream.data + r->stream_at, left);
	if (!ret->error)
		r->stream_at += left;
	if (r->stream_at == r->stream.len)
		r->stream.len = r->stream_at = 0;
	ended = r->stream_ended && r->stream.len == 0;
	if (ended)
		snprintf(reason, 320, "%s", r->stream_reason);
	pthread_mutex_unlock(&r->lock);
	return ended;
}

/* The thread's side */

static void say(struct recorder *r, int priority, const char *state, const char *file, const char *sentence)
{
	pthread_mutex_lock(&r->lock);
	if (r->notices < NOTICES_MAX) {
		struct recorder_notice *notice = &r->notice[r->notices++];

		notice->priority = priority;
		notice->state = state;
		snprintf(notice->file, sizeof(notice->file), "%s", file);
		snprintf(notice->sentence, sizeof(notice->sentence), "%s", sentence);
	}
	pthread_mutex_unlock(&r->lock);
	r->params.ready(r->params.ctx);
}

static void count(struct recorder *r)
{
	const struct place *p = &r->place;

	pthread_mutex_lock(&r->lock);
	r->status.recording = p->writer != NULL;
	r->status.bytes = p->bytes;
	if (p->writer)
		r->status.messages = mcap_writer_messages(recording_writer_mcap(p->writer));
	pthread_mutex_unlock(&r->lock);
}

static int write_all(int fd, const struct buffer *out)
{
	size_t at = 0;

	if (out->error)
		return out->error;
	while (at < out->len) {
		ssize_t n = write(fd, out->data + at, out->len - at);

		if (n < 0 && errno != EINTR)
			return -errno;
		at += n > 0 ? (size_t)n : 0;
	}
	return 0;
}

static bool stream_append(struct recorder *r, const struct buffer *out)
{
	bool room;

	pthread_mutex_lock(&r->lock);
	if (r->stream_at > RECORDER_STREAM_BYTES / 4) { /* seldom, so that little is moved */
		r->stream.len -= r->stream_at;
		memmove(r->stream.data, r->stream.data + r->stream_at, r->stream.len);
		r->stream_at = 0;
	}
	buffer_append(&r->stream, out->data, out->len);
	room = !r->stream.error && r->stream.len - r->stream_at < RECORDER_STREAM_BYTES;
	pthread_mutex_unlock(&r->lock);
	r->params.ready(r->params.ctx);
	return room;
}

/* What waits in `out` goes where it belongs. 0; -errno; -ENOBUFS: it is there, but the reader is too slow for more. */
static int flush(struct recorder *r)
{
	struct place *p = &r->place;
	int result = 0;

	if (p->out.error)
		return p->out.error;
	if (p->out.len == 0)
		return 0;
	if (!r->dir)
		result = stream_append(r, &p->out) ? 0 : -ENOBUFS;
	else
		result = write_all(p->fd, &p->out);
	if (result == 0 && r->dir && fdatasync(p->fd) < 0)
		result = -errno;
	if (result == 0 || !r->dir) {
		p->bytes += p->out.len;
		p->out.len = 0;
		p->begun = true;
	}
	return result;
}

static void close_place(struct recorder *r)
{
	struct place *p = &r->place;

	recording_writer_destroy(p->writer);
	p->writer = NULL;
	buffer_finish(&p->out);
	if (p->fd >= 0)
		close(p->fd);
	p->fd = -1;
	count(r);
}

/* Whatever cannot go on: what is on the disk stays, up to the last whole chunk; a file without one goes. */
static void fail(struct recorder *r, int error)
{
	struct place *p = &r->place;
	char sentence[320];

	if (p->fd >= 0 && p->begun && ftruncate(p->fd, (off_t)p->bytes) < 0) { /* half a chunk harms nobody */
	}
	if (p->fd >= 0 && !p->begun)
		unlink(p->path);
	snprintf(sentence, sizeof(sentence), "recording stops: %.200s: %s; it begins again when that is over",
	         r->dir ? p->path : "the stream", strerror(-error));
	close_place(r);
	r->pause_ns = r->pause_ns ? r->pause_ns * 2 : RETRY_MIN_NS;
	r->pause_ns = r->pause_ns < RETRY_MAX_NS ? r->pause_ns : RETRY_MAX_NS;
	pthread_mutex_lock(&r->lock);
	r->active = false;
	r->retry_ns = r->log_ns + r->pause_ns;
	if (!r->status.error[0])
		r->status.gaps++;
	const bool first = !r->status.error[0];
	snprintf(r->status.error, sizeof(r->status.error), "%s", sentence);
	if (!r->dir) {
		r->stream_ended = true;
		snprintf(r->stream_reason, sizeof(r->stream_reason), "%s", sentence);
	}
	pthread_mutex_unlock(&r->lock);
	if (first)
		say(r, LOG_ERR, "failed", r->dir ? p->path : "", sentence);
}

static void end_stream(struct recorder *r, const char *reason)
{
	pthread_mutex_lock(&r->lock);
	r->active = false;
	r->stream_ended = true;
	snprintf(r->stream_reason, sizeof(r->stream_reason), "%s", reason);
	pthread_mutex_unlock(&r->lock);
	r->params.ready(r->params.ctx);
}

/* An orderly end. */
static void end_place(struct recorder *r, const char *reason)
{
	struct place *p = &r->place;
	int result;

	if (!p->writer)
		return;
	result = recording_end(p->writer, reason);
	if (result == 0)
		result = flush(r);
	if (result == -ENOBUFS)
		result = 0;
	count(r);
	if (result < 0) {
		fail(r, result);
		return;
	}
	close_place(r);
	if (!r->dir)
		end_stream(r, reason);
}

static void keep_limit(struct recorder *r)
{
	r->place.checked = r->place.bytes;
	recording_folder_keep(r->dir, r->params.config->record.keep, r->place.path);
}

static void began(struct recorder *r)
{
	struct place *p = &r->place;
	char sentence[320];
	bool again;

	pthread_mutex_lock(&r->lock);
	again = r->status.error[0];
	r->status.error[0] = 0;
	r->status.files++;
	snprintf(r->status.file, sizeof(r->status.file), "%s", p->path);
	pthread_mutex_unlock(&r->lock);
	snprintf(sentence, sizeof(sentence), "records%s into %.280s", again ? " again" : "", p->path);
	if (r->dir)
		say(r, LOG_INFO, "recording", p->path, sentence);
}

static void begin_place(struct recorder *r, const struct recording_begin *begin)
{
	const struct recording_params params = {r->params.config, r->config_text, FACET_VERSION, LEVEL};
	struct place *p = &r->place;
	int result = 0;

	p->fd = -1;
	p->bytes = p->checked = 0;
	p->chunks = 0;
	p->begun = false;
	p->begun_ns = begin->log_ns;
	p->out = (struct buffer){0};
	p->path[0] = 0;
	if (r->dir)
		result = recording_folder_open(r->dir, begin, p->path);
	if (r->dir && result >= 0) {
		p->fd = result;
		result = 0;
	}
	if (result == 0)
		p->writer = recording_writer_create(&params, begin, &p->out);
	if (result == 0 && !p->writer)
		result = -ENOMEM;
	if (result == 0)
		result = mcap_writer_close_chunk(recording_writer_mcap(p->writer));
	if (result == 0)
		result = flush(r);
	if (result < 0 && result != -ENOBUFS) {
		fail(r, result);
		return;
	}
	began(r);
	if (r->dir && r->params.config->record.keep > 0)
		keep_limit(r);
	count(r);
}

/* Closes the chunk where it is due: only ever before what moves the pipeline, so that the rows a record led to are with it. */
static int close_chunk(struct recorder *r, int64_t log_ns)
{
	struct mcap_writer *mcap = recording_writer_mcap(r->place.writer);
	const int64_t age_ns = r->params.config->record.chunk_ns / 4 * 3;
	int result;

	if (mcap_writer_open_bytes(mcap) == 0 ||
	    (mcap_writer_open_bytes(mcap) < RECORDER_CHUNK_BYTES && log_ns - mcap_writer_open_ns(mcap) < age_ns))
		return 0;
	result = mcap_writer_close_chunk(mcap);
	if (result == 0)
		result = flush(r);
	r->place.chunks++;
	r->pause_ns = 0;
	count(r);
	return result;
}

/* The file is long or old enough: the loop is asked for the state that the next one begins with. */
static void look_for_limits(struct recorder *r, int64_t log_ns)
{
	const struct config *c = r->params.config;
	const struct place *p = &r->place;
	const int64_t age_ns = log_ns - p->begun_ns;
	uint64_t size = c->record.max_size;

	if (!r->dir)
		return;
	if (size == 0 && c->record.keep > 0)
		size = c->record.keep / KEEP_PARTS;
	if (c->record.keep > 0 && p->bytes - p->checked > KEEP_CHECK)
		keep_limit(r);
	if ((c->record.max_age_ns == 0 || age_ns < c->record.max_age_ns) && p->chunks < RECORDER_CHUNKS &&
	    (size == 0 || age_ns < AGE_MIN_NS ||
	     p->bytes + mcap_writer_open_bytes(recording_writer_mcap(p->writer)) < size))
		return;
	pthread_mutex_lock(&r->lock);
	r->rotate = r->active && r->begins == 0;
	pthread_mutex_unlock(&r->lock);
}

static int put(struct recorder *r, const struct item *item, const char *data)
{
	struct recording_writer *w = r->place.writer;
	struct record record = item->record;

	switch (item->kind) {
	case ITEM_RECORD:
		record.bytes = (const uint8_t *)data;
		return recording_put_record(w, &record);
	case ITEM_TICK:
		return recording_put_tick(w, item->value);
	case ITEM_SKIP:
		return recording_put_skip(w, (uint64_t)item->value, data);
	case ITEM_CLOCK:
		return recording_put_clock(w, item->value);
	case ITEM_EVENT:
		return recording_put_event(w, data, item->len);
	case ITEM_MESSAGE:
		return recording_put_message(w, (enum foxglove_schema)item->value, data, item->len);
	default:
		return recording_put_control(w, data, item->len);
	}
}

static void do_begin(struct recorder *r, const struct item *item, const char *data)
{
	struct recording_begin begin = item->begin;
	int result;

	begin.snapshot = data;
	begin.len = item->len;
	r->log_ns = begin.log_ns;
	pthread_mutex_lock(&r->lock);
	r->begins--;
	pthread_mutex_unlock(&r->lock);
	if (!r->dir && r->place.writer) {
		result = recording_put_begin(r->place.writer, &begin);
		if (result < 0)
			fail(r, result);
		return;
	}
	end_place(r, begin.whole ? "the map ended" : "goes on in the next file");
	begin_place(r, &begin);
}

static void do_item(struct recorder *r, const struct item *item, const char *data)
{
	const bool moves = item->kind == ITEM_RECORD || item->kind == ITEM_TICK;
	int result = 0;

	if (item->kind == ITEM_BEGIN) {
		do_begin(r, item, data);
		return;
	}
	if (!r->place.writer)
		return;
	if (item->kind == ITEM_END) {
		end_place(r, "asked to end");
		if (r->dir)
			say(r, LOG_INFO, "ended", r->place.path, "recording ends, as a client asked");
		return;
	}
	if (moves) {
		r->log_ns = item->kind == ITEM_RECORD ? item->record.log_ns : item->value;
		result = close_chunk(r, r->log_ns);
		look_for_limits(r, r->log_ns);
	}
	if (result == 0)
		result = put(r, item, data);
	if (result == -ENOBUFS)
		end_place(r, "the reader was too slow; record to a faster disk, or nearer to the daemon");
	else if (result < 0)
		fail(r, result);
}

static void do_overflow(struct recorder *r)
{
	static const char sentence[] =
	    "recording has a gap: the disk takes no more as fast as it comes; another file begins";
	const char *path = r->place.path;

	end_place(r, "the disk was too slow");
	pthread_mutex_lock(&r->lock);
	r->overflown = false;
	r->retry_ns = r->log_ns + RETRY_MIN_NS;
	pthread_mutex_unlock(&r->lock);
	say(r, LOG_ERR, "failed", path, sentence);
}

static void do_work(struct recorder *r)
{
	struct item item;

	for (size_t at = 0; at < r->work.len; at += sizeof(item) + item.len) {
		memcpy(&item, r->work.data + at, sizeof(item));
		do_item(r, &item, (const char *)r->work.data + at + sizeof(item));
	}
	r->work.len = 0;
}

static void *run(void *ctx)
{
	struct recorder *r = ctx;
	bool stop = false, overflown = false;

	pthread_setname_np(pthread_self(), RECORDER_NAME);
	while (!stop) {
		struct buffer work;

		pthread_mutex_lock(&r->lock);
		while (r->queue.len == 0 && !r->stop && !r->overflown)
			pthread_cond_wait(&r->wake, &r->lock);
		work = r->queue;
		r->queue = r->work;
		r->work = work;
		stop = r->stop;
		overflown = r->overflown;
		pthread_mutex_unlock(&r->lock);
		do_work(r);
		if (overflown)
			do_overflow(r);
	}
	end_place(r, "facetd ended");
	return NULL;
}

/* Life */

struct recorder *recorder_create(const struct recorder_params *params)
{
	struct recorder *r = calloc(1, sizeof(*r));

	if (!r)
		return NULL;
	r->params = *params;
	r->session = params->session;
	r->status.enabled = true;
	r->retry_ns = INT64_MIN;
	r->place.fd = -1;
	r->config_text = strdup(params->config_text);
	r->dir = params->dir ? strdup(params->dir) : NULL;
	pthread_mutex_init(&r->lock, NULL);
	pthread_cond_init(&r->wake, NULL);
	if (r->config_text && (r->dir || !params->dir) && pthread_create(&r->thread, NULL, run, r) == 0)
		return r;
	pthread_cond_destroy(&r->wake);
	pthread_mutex_destroy(&r->lock);
	free(r->config_text);
	free(r->dir);
	free(r);
	return NULL;
}

void recorder_destroy(struct recorder *r)
{
	if (!r)
		return;
	pthread_mutex_lock(&r->lock);
	r->stop = true;
	r->active = false;
	pthread_cond_signal(&r->wake);
	pthread_mutex_unlock(&r->lock);
	pthread_join(r->thread, NULL);
	pthread_cond_destroy(&r->wake);
	pthread_mutex_destroy(&r->lock);
	buffer_finish(&r->queue);
	buffer_finish(&r->work);
	buffer_finish(&r->stream);
	free(r->config_text);
	free(r->dir);
	free(r);
}

/* Devices and their four states.
 *
 *             open                     dialogue says so
 *   closed ─────────► configuring ─────────────────────► streaming        no dialogue: streaming at once
 *     ▲                 │   ▲                              │   │
 *     │  open failed,   │   └──────────────────────────────┘   │ read or write failed, dialogue gave up,
 *     │  ...            ▼     dialogue begins anew             ▼ no telegram in all that it sends
 *     └────────── backing off ◄────────────────────────────────┘
 *       back-off is over
 *
 * Nothing here waits, and no device can hold up another: one that sends without pause gets a bounded number of reads a
 * turn, and a bounded number of bytes a second, beyond which its descriptor is not watched for a while; one that takes no
 * bytes keeps what it was to be sent, and nothing else is written to it meanwhile. What a dialogue asks for is done in
 * the order write, line rate, flush; the rate waits until all bytes of the write are with the kernel.
 *
 * Only transitions are logged, and a failure that repeats itself word by word only once until the device has streamed
 * again: an unplugged scanner costs two lines, not two a second. A device that comes and goes within SUPERVISOR_STEADY_NS
 * again and again is said to stream only when it has done so for that long. */
#include "daemon/supervisor.h"

#include <assert.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <syslog.h>

#define READ_BYTES 4096
#define STEPS_MAX  16            /* of a dialogue in one turn */
#define FLAPS_TOLD 3             /* short streams that are told; who goes on so is told when it lasts */
#define BLOCKED_NS 2000000000ll  /* a device that takes no bytes for so long is lost */
#define NOTES_MAX  6             /* changes of a note that are told within ... */
#define NOTES_NS   60000000000ll /* ... a minute; the status has them all */

struct line {
	const struct driver *driver;
	const struct config_device *config;
	struct dialogue *dialogue; /* NULL: none is needed */
	struct link *link;
	struct supervisor_device status;
	int64_t deadline_ns, backoff_ns;
	int64_t blocked_ns; /* since when bytes wait to be taken */
	int64_t opened_ns;
	bool taken; /* a byte was, since it was opened */
	/* What it may still send, and when that was reckoned; reading waits until then while `paused`. */
	int64_t budget_bytes, budget_ns, resume_ns;
	bool paused;
	size_t noise_bytes; /* since the last telegram */
	/* What the last step still owes. */
	uint8_t unwritten[sizeof(((struct dialogue_step *)0)->write)];
	size_t unwritten_len;
	uint32_t baud;
	bool flush, watching_writable, stopping;
	int flaps;        /* short streams in a row */
	bool untold;      /* it streams, and nobody was told */
	char logged[160]; /* the failure that was logged last; empty since it streamed */
	char noted[328];  /* the note that was logged last */
	char remark[160]; /* of the link: a part of every note while it is open */
	int notes;        /* logged within this minute, begun at `notes_ns` */
	int64_t notes_ns;
};

struct supervisor {
	const struct config *config;
	struct supervisor_host host;
	struct line line[CONFIG_DEVICES_MAX];
	bool stopping;
	int64_t stop_ns; /* the end of patience */
};

const char *supervisor_state_name(enum supervisor_state state)
{
	static const char *const name[] = {"closed", "configuring", "streaming", "backing off"};

	return name[state];
}

static int index_of(const struct supervisor *s, const struct line *line)
{
	return (int)(line - s->line);
}

static void set_state(struct line *line, enum supervisor_state state, int64_t t_ns)
{
	line->status.state = state;
	line->status.since_ns = t_ns;
}

/* Closing and opening */

static void log_device(struct supervisor *s, struct line *line, int priority, const char *text)
{
	s->host.log(s->host.ctx, index_of(s, line), priority, text);
}

static void close_line(struct supervisor *s, struct line *line, enum supervisor_state state, int64_t t_ns)
{
	if (line->link) {
		s->host.watch(s->host.ctx, index_of(s, line), -1, false, false);
		line->driver->link_close(line->link);
		line->link = NULL;
	}
	line->unwritten_len = 0;
	line->baud = 0;
	line->flush = line->watching_writable = line->paused = false;
	line->deadline_ns = INT64_MAX;
	set_state(line, state, t_ns);
}

/* A device in trouble may change its note many times a second; the one that lasts is told when the minute is over. */
static void tell_note(struct supervisor *s, struct line *line, bool at_begin, int64_t t_ns)
{
	const char *note = line->status.note;

	if (strcmp(line->noted, note) == 0)
		return;
	if (t_ns - line->notes_ns >= NOTES_NS) {
		line->notes_ns = t_ns;
		line->notes = 0;
	}
	if (!at_begin && ++line->notes > NOTES_MAX)
		return;
	if (note[0])
		log_device(s, line, LOG_NOTICE, note);
	else if (!at_begin)
		log_device(s, line, LOG_INFO, "in order again");
	snprintf(line->noted, sizeof(line->noted), "%s", note);
}

static void tell_streaming(struct supervisor *s, struct line *line, int64_t t_ns)
{
	line->untold = false;
	line->logged[0] = 0;
	log_device(s, line, LOG_INFO, "streaming");
	tell_note(s, line, true, t_ns);
}

/* `note`: of the dialogue, what is not as it was wanted; the link may have something to say, too. The dialogue's may change
 * while it streams. */
static void begin_streaming(struct supervisor *s, struct line *line, const char *note, int64_t t_ns)
{
	const bool begins = line->status.state != SUPERVISOR_STREAMING;

	if (begins) {
		set_state(line, SUPERVISOR_STREAMING, t_ns);
		line->status.error[0] = line->remark[0] = 0;
		if (line->link && line->driver->link_note)
			line->driver->link_note(line->link, line->remark);
		line->untold = line->flaps >= FLAPS_TOLD;
	}
	snprintf(line->status.note, sizeof(line->status.note), "%s%s%s", note, note[0] && line->remark[0] ? "; " : "",
	         line->remark);
	if (begins && !line->untold)
		tell_streaming(s, line, t_ns);
	else if (!line->untold)
		tell_note(s, line, false, t_ns);
}

/* The stream, if there was one, is over; what comes next is said, unless that was said already. */
static void leave(struct supervisor *s, struct line *line, const char *why, const char *next, int64_t t_ns)
{
	bool streamed = line->status.state == SUPERVISOR_STREAMING, told;
	bool steady = streamed && t_ns - line->status.since_ns >= SUPERVISOR_STEADY_NS;

	if (steady && line->untold)
		tell_streaming(s, line, t_ns);
	told = streamed && !line->untold;
	if (streamed)
		line->flaps = steady ? 0 : line->flaps + 1;
	if (steady || line->backoff_ns == 0)
		line->backoff_ns = SUPERVISOR_BACKOFF_MIN_NS;
	line->untold = false;
	line->status.note[0] = 0;
	line->status.losses++;
	snprintf(line->status.error, sizeof(line->status.error), "%s", why);
	/* The end of a stream that nobody was told of is not told either, or each new figure in its sentence costs a line. */
	if (told || (!streamed && strcmp(line->logged, line->status.error) != 0)) {
		char text[220];

		snprintf(text, sizeof(text), "%s: %s; %s", told ? "lost" : "not ready", line->status.error, next);
		log_device(s, line, LOG_WARNING, text);
		snprintf(line->logged, sizeof(line->logged), "%s", line->status.error);
	}
}

static void lose(struct supervisor *s, struct line *line, const char *why, int64_t t_ns)
{
	if (line->stopping) {
		close_line(s, line, SUPERVISOR_CLOSED, t_ns);
		return;
	}
	const bool hung = line->unwritten_len > 0 && !line->taken;

	leave(s, line, why, "trying again", t_ns);
	close_line(s, line, SUPERVISOR_BACKING_OFF, t_ns);
	/* An opening that hung has waited already. */
	line->deadline_ns = (hung ? line->opened_ns : t_ns) + line->backoff_ns;
	if (line->deadline_ns < t_ns)
		line->deadline_ns = t_ns;
	line->backoff_ns *= 2;
	if (line->backoff_ns > SUPERVISOR_BACKOFF_MAX_NS)
		line->backoff_ns = SUPERVISOR_BACKOFF_MAX_NS;
}

static void lose_errno(struct supervisor *s, struct line *line, const char *doing, int error, int64_t t_ns)
{
	char text[160] = "";

	if (line->driver->link_error)
		line->driver->link_error(line->link, error, text);
	else
		snprintf(text, sizeof(text), "%s failed (%s)", doing, strerror(error));
	lose(s, line, text, t_ns);
}

/* The link stands, and the device is set up anew. */
static void reconfigure(struct supervisor *s, struct line *line, const char *why, int64_t t_ns)
{
	leave(s, line, why[0] ? why : "it stopped", "setting it up again", t_ns);
	set_state(line, SUPERVISOR_CONFIGURING, t_ns);
}

/* Writing */

static void watch(struct supervisor *s, struct line *line)
{
	line->watching_writable = line->unwritten_len > 0;
	s->host.watch(s->host.ctx, index_of(s, line), line->driver->link_fd(line->link), !line->paused,
	              line->watching_writable);
}

/* Room for bytes is waited for up to here. */
static int64_t patience_ns(const struct line *line)
{
	return line->blocked_ns + (line->taken ? BLOCKED_NS : SUPERVISOR_OPEN_NS);
}

/* Writes what is owed, as far as the device takes it; what was taken is recorded. False: the device was lost. */
static bool write_owed(struct supervisor *s, struct line *line, int64_t t_ns)
{
	ssize_t n;
	struct record record = {.log_ns = t_ns, .t_ns = t_ns, .device = index_of(s, line), .direction = TO_DEVICE};

	n = line->driver->link_write(line->link, line->unwritten, line->unwritten_len);
	if (n < 0) {
		lose_errno(s, line, "writing", (int)-n, t_ns);
		return false;
	}
	if (n > 0) {
		uint8_t written[sizeof(line->unwritten)];

		assert((size_t)n <= line->unwritten_len);
		line->taken = true;
		memcpy(written, line->unwritten, (size_t)n);
		line->unwritten_len -= (size_t)n;
		memmove(line->unwritten, line->unwritten + n, line->unwritten_len);
		line->status.bytes_out += (uint64_t)n;
		record.bytes = written;
		record.len = (size_t)n;
		s->host.record(s->host.ctx, &record);
	}
	if ((line->unwritten_len > 0) != line->watching_writable)
		watch(s, line);
	return true;
}

/* Does what the last step asked for, in order; false: not all of it is done yet, or the device was lost. */
static bool settle(struct supervisor *s, struct line *line, int64_t t_ns)
{
	char error[160] = "";

	if (line->unwritten_len > 0 && (!write_owed(s, line, t_ns) || line->unwritten_len > 0)) {
		if (line->link && t_ns >= patience_ns(line) && !line->taken && line->driver->link_error)
			lose_errno(s, line, "connecting", ETIMEDOUT, t_ns);
		else if (line->link && t_ns >= patience_ns(line))
			lose(s, line,
			     line->taken ? "the device takes no bytes"
			                 : "the device takes no bytes: is it there, and switched on?",
			     t_ns);
		return false;
	}
	if (line->baud && line->driver->link_baud) {
		if (line->driver->link_baud(line->link, line->baud, error) < 0) {
			lose(s, line, error, t_ns);
			return false;
		}
	}
	line->baud = 0;
	if (line->flush && line->driver->link_flush)
		line->driver->link_flush(line->link);
	line->flush = false;
	return true;
}

/* The dialogue's turn */

static void take_step(struct line *line, const struct dialogue_step *step, int64_t t_ns)
{
	size_t n = step->write_len < sizeof(line->unwritten) ? step->write_len : sizeof(line->unwritten);

	memcpy(line->unwritten, step->write, n);
	line->unwritten_len = n;
	line->baud = step->baud;
	line->flush = step->flush;
	line->deadline_ns = step->deadline_ns;
	line->blocked_ns = t_ns;
}

/* Steps until the dialogue has nothing more to do now. */
static void converse(struct supervisor *s, struct line *line, int64_t t_ns)
{
	for (int i = 0; i < STEPS_MAX && line->link && line->dialogue; i++) {
		struct dialogue_step step = {.deadline_ns = INT64_MAX};
		bool asked;

		if (!settle(s, line, t_ns))
			return;
		line->driver->dialogue_step(line->dialogue, t_ns, &step);
		if (step.state == DIALOGUE_FAILED) {
			lose(s, line, step.error[0] ? step.error : "the device was given up", t_ns);
			return;
		}
		if (step.state == DIALOGUE_STREAMING)
			begin_streaming(s, line, step.error, t_ns);
		else if (line->status.state == SUPERVISOR_STREAMING && !line->stopping)
			reconfigure(s, line, step.error, t_ns);
		take_step(line, &step, t_ns);
		asked = step.write_len > 0 || step.baud || step.flush;
		if (asked && !settle(s, line, t_ns))
			return;
		if (!asked && step.deadline_ns > t_ns)
			return;
	}
	/* It asks without end: the others come first. */
	if (line->link && line->dialogue && line->deadline_ns <= t_ns)
		line->deadline_ns = t_ns + 1000000;
}

static void record_opened(struct supervisor *s, struct line *line, int64_t t_ns)
{
	static const uint8_t nothing;
	struct record record = {
	    .log_ns = t_ns, .t_ns = t_ns, .device = index_of(s, line), .direction = LINK_OPENED, .bytes = &nothing};

	s->host.record(s->host.ctx, &record);
}

static void open_line(struct supervisor *s, struct line *line, int64_t t_ns)
{
	char error[160] = "";

	line->status.opens++;
	line->deadline_ns = INT64_MAX;
	line->opened_ns = t_ns;
	line->taken = false;
	line->noise_bytes = 0;
	if (line->driver->link_open) {
		line->link = line->driver->link_open(line->config, error);
		if (!line->link) {
			lose(s, line, error, t_ns);
			return;
		}
		record_opened(s, line, t_ns);
	}
	if (line->link && line->driver->link_fd(line->link) >= 0)
		watch(s, line);
	if (line->link && line->dialogue) {
		set_state(line, SUPERVISOR_CONFIGURING, t_ns);
		line->driver->dialogue_reset(line->dialogue, t_ns);
		converse(s, line, t_ns);
	} else {
		begin_streaming(s, line, "", t_ns);
	}
}

/* Reading */

/* Has it sent what it may for now? Then reading waits. */
static bool overspent(struct supervisor *s, struct line *line, int64_t t_ns)
{
	int64_t since_ns = t_ns - line->budget_ns;

	line->budget_ns = t_ns;
	if (since_ns >= 1000000000)
		line->budget_bytes = SUPERVISOR_BURST_BYTES;
	else
		line->budget_bytes += since_ns * SUPERVISOR_BYTES_PER_S / 1000000000;
	if (line->budget_bytes > SUPERVISOR_BURST_BYTES)
		line->budget_bytes = SUPERVISOR_BURST_BYTES;
	if (line->budget_bytes > 0)
		return false;
	line->paused = true;
	line->resume_ns = t_ns + SUPERVISOR_SLICE_NS;
	watch(s, line);
	return true;
}

static void resume(struct supervisor *s, struct line *line)
{
	line->paused = false;
	watch(s, line);
}

static void take_bytes(struct supervisor *s, struct line *line, const struct record *record, int64_t t_ns)
{
	char text[160];

	line->status.records++;
	line->status.bytes_in += record->len;
	line->budget_bytes -= (int64_t)record->len;
	line->noise_bytes += record->len;
	s->host.record(s->host.ctx, record);
	if (line->noise_bytes < SUPERVISOR_NOISE_BYTES)
		return;
	snprintf(text, sizeof(text), "it sends what is no telegram of driver %s; is it another device?",
	         line->driver->name);
	lose(s, line, text, t_ns);
}

/* What the loop calls */

/* Reads with a bound; false: the device was lost. */
static bool read_line(struct supervisor *s, struct line *line, int64_t t_ns)
{
	uint8_t bytes[READ_BYTES];

	for (int i = 0; i < SUPERVISOR_READS_MAX && line->link && !overspent(s, line, t_ns); i++) {
		struct record record = {.log_ns = t_ns, .t_ns = t_ns, .device = index_of(s, line), .bytes = bytes};
		ssize_t n = line->driver->link_read(line->link, bytes, sizeof(bytes), &record.t_ns);

		if (n == 0)
			return true;
		if (n < 0) {
			lose_errno(s, line, "reading", (int)-n, t_ns);
			return false;
		}
		record.direction = FROM_DEVICE;
		record.len = (size_t)n;
		take_bytes(s, line, &record, t_ns);
	}
	return line->link != NULL;
}

void supervisor_ready(struct supervisor *s, int device, bool readable, bool writable, int64_t t_ns)
{
	struct line *line;

	assert(device >= 0 && device < s->config->devices);
	line = &s->line[device];
	if (!line->link)
		return;
	if (writable && line->unwritten_len > 0 && !write_owed(s, line, t_ns))
		return;
	if (readable && !line->paused && !read_line(s, line, t_ns))
		return;
	converse(s, line, t_ns);
}

/* While bytes wait to be taken the dialogue's own deadline does not count. */
static int64_t due_ns(const struct line *line)
{
	int64_t due_ns = line->link && line->unwritten_len > 0 ? patience_ns(line) : line->deadline_ns;

	if (line->paused && line->resume_ns < due_ns)
		due_ns = line->resume_ns;
	if (line->untold && line->status.since_ns + SUPERVISOR_STEADY_NS < due_ns)
		due_ns = line->status.since_ns + SUPERVISOR_STEADY_NS;
	return due_ns;
}

/* A host that slept, or was busy, finds deadlines that passed and bytes that came in time: the bytes are heard first, else a
 * device that answered is given up. */
static void keep_deadline(struct supervisor *s, struct line *line, int64_t t_ns)
{
	bool reads = line->dialogue && !line->paused && line->driver->link_fd(line->link) >= 0;

	if (!reads || read_line(s, line, t_ns))
		converse(s, line, t_ns);
}

void supervisor_timer(struct supervisor *s, int64_t t_ns)
{
	for (int i = 0; i < s->config->devices; i++) {
		struct line *line = &s->line[i];

		if (s->stopping && t_ns >= s->stop_ns && line->status.state != SUPERVISOR_CLOSED)
			close_line(s, line, SUPERVISOR_CLOSED, t_ns);
		if (due_ns(line) > t_ns)
			continue;
		if (line->paused && t_ns >= line->resume_ns)
			resume(s, line);
		if (line->untold && t_ns - line->status.since_ns >= SUPERVISOR_STEADY_NS)
			tell_streaming(s, line, t_ns);
		if (line->status.state == SUPERVISOR_BACKING_OFF)
			open_line(s, line, t_ns);
		else if (line->link)
			keep_deadline(s, line, t_ns);
	}
}

int64_t supervisor_deadline(const struct supervisor *s)
{
	int64_t deadline_ns = INT64_MAX;

	for (int i = 0; i < s->config->devices; i++)
		if (due_ns(&s->line[i]) < deadline_ns)
			deadline_ns = due_ns(&s->line[i]);
	if (s->stopping && !supervisor_stopped(s) && s->stop_ns < deadline_ns)
		deadline_ns = s->stop_ns;
	return deadline_ns;
}

void supervisor_reply(struct supervisor *s, int device, const struct reply *reply)
{
	struct line *line = &s->line[device];

	line->noise_bytes = 0;
	if (line->link && line->dialogue)
		line->driver->dialogue_reply(line->dialogue, reply);
}

void supervisor_data(struct supervisor *s, int device, int64_t t_ns)
{
	struct line *line = &s->line[device];

	line->status.decoded++;
	line->status.decoded_ns = t_ns;
	line->noise_bytes = 0;
	if (line->link && line->dialogue)
		line->driver->dialogue_data(line->dialogue, t_ns);
}

void supervisor_start(struct supervisor *s, int64_t t_ns)
{
	for (int i = 0; i < s->config->devices; i++)
		open_line(s, &s->line[i], t_ns);
}

int64_t supervisor_stop_ns(const struct config *config)
{
	bool takes_long = config->sweep.set && config->sweep.has_rest;

	for (int i = 0; i < config->devices; i++)
		takes_long |= config->device[i].stop.n > 0; /* steps may wait for the drive */
	return takes_long ? SUPERVISOR_REST_NS : SUPERVISOR_STOP_NS;
}

void supervisor_stop(struct supervisor *s, int64_t t_ns)
{
	s->stopping = true;
	s->stop_ns = t_ns + supervisor_stop_ns(s->config);
	for (int i = 0; i < s->config->devices; i++) {
		struct line *line = &s->line[i];

		line->stopping = true;
		if (line->link && line->dialogue && line->driver->dialogue_stop) {
			line->driver->dialogue_stop(line->dialogue, t_ns);
			converse(s, line, t_ns);
		} else {
			close_line(s, line, SUPERVISOR_CLOSED, t_ns);
		}
	}
}

bool supervisor_stopped(const struct supervisor *s)
{
	for (int i = 0; i < s->config->devices; i++)
		if (s->line[i].status.state != SUPERVISOR_CLOSED)
			return false;
	return true;
}

const struct supervisor_device *supervisor_device(const struct supervisor *s, int device)
{
	return &s->line[device].status;
}

struct supervisor *supervisor_create(const struct config *config, const struct driver *const *drivers,
                                     const struct supervisor_host *host)
{
	struct supervisor *s = calloc(1, sizeof(*s));

	if (!s)
		return NULL;
	s->config = config;
	s->host = *host;
	for (int i = 0; i < config->devices; i++) {
		struct line *line = &s->line[i];

		line->driver = drivers[i];
		line->config = &config->device[i];
		line->deadline_ns = INT64_MAX;
		line->budget_bytes = SUPERVISOR_BURST_BYTES;
		if (!line->driver->dialogue_create)
			continue;
		line->dialogue = line->driver->dialogue_create(config, i);
		if (!line->dialogue) {
			supervisor_destroy(s);
			return NULL;
		}
	}
	return s;
}

void supervisor_destroy(struct supervisor *s)
{
	if (!s)
		return;
	for (int i = 0; i < s->config->devices; i++) {
		struct line *line = &s->line[i];

		close_line(s, line, SUPERVISOR_CLOSED, 0);
		if (line->dialogue)
			line->driver->dialogue_destroy(line->dialogue);
	}
	free(s);
}

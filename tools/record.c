/* `facet record`: a running daemon's recording, taken over its unix socket. The daemon makes the file's bytes, this writes them, so
 * the file lies where its user may write, not the daemon.
 *
 *   ?RECORD={"stream":true} ─► one line of JSON; then pieces: u32 length, bytes ...; length 0, and a line that says why it ended
 *
 * The file is written in place, under its name: what has been recorded must outlive the tool, so nothing is renamed at the end. An
 * older file of that name is never overwritten. Ctrl-C asks the daemon for an orderly end and takes the rest: summary and footer. */
#include <argp.h>
#include <errno.h>
#include <fcntl.h>
#include <jansson.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "config/address.h"
#include "config/units.h"
#include "tools/commands.h"
#include "tools/libfacet.h"

#define PIECE_MAX  (1u << 20)
#define ANSWER_MAX (64u << 10)
#define END_MS     10000 /* for the rest, once the end was asked for */
#define SILENT_MS  10000 /* a daemon that records has a tick ten times a second: it hangs, or is gone */

struct job {
	const char *address, *output;
	double seconds; /* 0: until it is interrupted */
};

struct recording {
	const struct job *job;
	int socket, file;
	uint8_t in[PIECE_MAX + 4];
	size_t len;
	uint64_t bytes;
	bool asked, ended;
	char error[400], reason[400];
};

static volatile sig_atomic_t interrupted;

static void on_signal(int number)
{
	(void)number;
	interrupted = 1;
}

static const struct argp_option options[] = {
    {"output", 'o', "FILE", 0, "the recording, .mcap; it must not be there yet", 0},
    {"duration", 'd', "TIME", 0, "so long, then it ends (default: until Ctrl-C)", 0},
    {0}};

static error_t parse_option(int key, char *arg, struct argp_state *state)
{
	struct job *job = state->input;

	switch (key) {
	case 'o':
		job->output = arg;
		return 0;
	case 'd':
		if (units_parse(arg, DIMENSION_TIME, &job->seconds) || job->seconds <= 0 || job->seconds > 1e7)
			argp_error(state, "--duration: '%s' is not a time in seconds", arg);
		return 0;
	case ARGP_KEY_ARG:
		if (job->address)
			argp_error(state, "one daemon is recorded at a time; '%s' is the second", arg);
		job->address = arg;
		return 0;
	case ARGP_KEY_END:
		if (!job->output)
			argp_error(state, "-o FILE.mcap is needed");
		return 0;
	default:
		return ARGP_ERR_UNKNOWN;
	}
}

static int fail(struct recording *r, const char *who, const char *what)
{
	snprintf(r->error, sizeof(r->error), "%.200s: %.180s", who, what);
	return -1;
}

static int open_socket(struct recording *r)
{
	char where[ADDRESS_TEXT_MAX], sentence[ADDRESS_ERROR_MAX];
	const char *text = r->job->address ? r->job->address : address_default(where);
	struct sockaddr_storage to;
	struct address address;
	socklen_t len;

	if (address_parse(text, ADDRESS_UNIX, &address, sentence) < 0)
		return fail(
		    r, text,
		    "a recording is taken over a unix socket: unix:PATH; from elsewhere: ssh HOST facet record");
	address_sockaddr(&address, &to, &len);
	r->socket = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
	if (r->socket >= 0 && connect(r->socket, (struct sockaddr *)&to, len) == 0)
		return 0;
	snprintf(sentence, sizeof(sentence),
	         "no daemon answers (%s); start facetd, or say where it is (ADDRESS or $FACETD)", strerror(errno));
	return fail(r, text, sentence);
}

static int say(struct recording *r, const char *line)
{
	return send(r->socket, line, strlen(line), MSG_NOSIGNAL) == (ssize_t)strlen(line)
	           ? 0
	           : fail(r, "the daemon", "does not listen any more");
}

static void take(struct recording *r, size_t n)
{
	r->len -= n;
	memmove(r->in, r->in + n, r->len);
}

/* 1; 0: the time is over, or a signal came; -1. */
static int receive(struct recording *r, int64_t until_ms)
{
	struct pollfd fd = {.fd = r->socket, .events = POLLIN};
	int64_t left_ms = until_ms - libfacet_now_ms();
	ssize_t n;

	if (poll(&fd, 1, left_ms > 0 ? (int)left_ms : 0) <= 0)
		return 0;
	n = recv(r->socket, r->in + r->len, sizeof(r->in) - r->len, 0);
	if (n < 0 && errno == EINTR)
		return 0;
	if (n <= 0)
		return fail(r, r->job->output,
		            "the daemon ended; the file holds what came until then (facet repair gives it an index)");
	r->len += (size_t)n;
	return 1;
}

static int write_all(struct recording *r, const uint8_t *data, size_t len)
{
	while (len > 0) {
		ssize_t n = write(r->file, data, len);

		if (n < 0 && errno != EINTR) {
			char sentence[200];

			snprintf(sentence, sizeof(sentence), "cannot be written (%s); what is there can be replayed",
			         strerror(errno));
			return fail(r, r->job->output, sentence);
		}
		data += n > 0 ? n : 0;
		len -= n > 0 ? (size_t)n : 0;
		r->bytes += n > 0 ? (uint64_t)n : 0;
	}
	return 0;
}

/* The first line ends at `end`: the version is one, the answer another. 1: it begins; 0: another line; -1: refused. */
static int judge_line(struct recording *r, size_t end)
{
	json_t *json = json_loadb((const char *)r->in, end, 0, NULL);
	const char *class = json_string_value(json_object_get(json, "class"));
	int got = 0;

	if (class && strcmp(class, "ERROR") == 0)
		got = fail(r, "the daemon", json_string_value(json_object_get(json, "error")));
	else if (class && strcmp(class, "RECORD") == 0)
		got = 1;
	json_decref(json);
	take(r, end + 1);
	return got;
}

static int await_answer(struct recording *r)
{
	const int64_t until_ms = libfacet_now_ms() + SILENT_MS;
	int got = 0;

	while (got == 0 && libfacet_now_ms() < until_ms && !interrupted) {
		uint8_t *end = memchr(r->in, '\n', r->len);

		if (end)
			got = judge_line(r, (size_t)(end - r->in));
		else if (r->len > ANSWER_MAX)
			got = fail(r, "the daemon", "says something that is no answer");
		else
			got = receive(r, until_ms) < 0 ? -1 : 0;
	}
	return got != 0 ? got : fail(r, "the daemon", "does not answer");
}

static void read_reason(struct recording *r, const uint8_t *text, size_t len)
{
	json_t *json = json_loadb((const char *)text, len, 0, NULL);
	const char *reason = json_string_value(json_object_get(json, "message"));

	snprintf(r->reason, sizeof(r->reason), "%s", reason ? reason : "ended");
	json_decref(json);
	r->ended = true;
}

/* All whole pieces that were received. 0 or -1. */
static int write_pieces(struct recording *r)
{
	size_t at = 0;

	while (!r->ended && r->len - at >= 4) {
		const uint8_t *in = r->in + at;
		const uint32_t n =
		    (uint32_t)in[0] | (uint32_t)in[1] << 8 | (uint32_t)in[2] << 16 | (uint32_t)in[3] << 24;
		const uint8_t *end = n == 0 ? memchr(in + 4, '\n', r->len - at - 4) : NULL;

		if (n > PIECE_MAX)
			return fail(r, "the daemon", "sends a piece of more than 1 MB");
		if ((n > 0 && r->len - at - 4 < n) || (n == 0 && !end))
			break;
		if (n == 0)
			read_reason(r, in + 4, (size_t)(end - in - 4));
		else if (write_all(r, in + 4, n) < 0)
			return -1;
		at += n + 4;
	}
	if (!r->ended)
		take(r, at);
	return 0;
}

static int run(struct recording *r)
{
	const int64_t end_ms = r->job->seconds > 0 ? libfacet_now_ms() + (int64_t)(r->job->seconds * 1000) : INT64_MAX;
	int64_t until_ms = libfacet_now_ms() + SILENT_MS;

	while (!r->ended) {
		int got;

		if (!r->asked && (interrupted || libfacet_now_ms() >= end_ms)) {
			r->asked = true;
			until_ms = libfacet_now_ms() + END_MS;
			if (say(r, "?RECORD={\"enable\":false}\n") < 0)
				return -1;
		}
		got = receive(r, r->asked || end_ms > until_ms ? until_ms : end_ms);
		if (got < 0 || write_pieces(r) < 0)
			return -1;
		if (got == 0 && libfacet_now_ms() >= until_ms)
			return fail(r, "the daemon", "has sent nothing for 10 s; what came is in the file");
		if (got == 1 && !r->asked)
			until_ms = libfacet_now_ms() + SILENT_MS;
	}
	return 0;
}

static int record(struct recording *r)
{
	int got;

	r->file = open(r->job->output, O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
	if (r->file < 0)
		return fail(r, r->job->output,
		            errno == EEXIST ? "is there already; choose another name" : strerror(errno));
	got = open_socket(r);
	if (got == 0)
		got = say(r, "?RECORD={\"stream\":true}\n");
	if (got == 0)
		got = await_answer(r) < 0 ? -1 : run(r);
	if (r->bytes == 0)
		unlink(r->job->output);
	if (close(r->file) < 0 && got == 0)
		got = fail(r, r->job->output, strerror(errno));
	return got;
}

int record_main(int argc, char **argv)
{
	static const struct argp argp = {
	    options,
	    parse_option,
	    "[ADDRESS] -o FILE.mcap",
	    "Records a running daemon until Ctrl-C.\v"
	    "ADDRESS is unix:PATH; default: $FACETD, the user's own socket, the system's. FILE is "
	    "written as it comes and can be replayed whatever happens to this program.",
	    NULL,
	    NULL,
	    NULL};
	struct sigaction action = {.sa_handler = on_signal};
	static struct recording recording;
	struct job job = {0};
	int got;

	argp_parse(&argp, argc, argv, 0, NULL, &job);
	recording.job = &job;
	recording.socket = -1;
	sigaction(SIGINT, &action, NULL);
	sigaction(SIGTERM, &action, NULL);
	got = record(&recording);
	if (recording.socket >= 0)
		close(recording.socket);
	if (got < 0) {
		fprintf(stderr, "facet: %s\n", recording.error);
		return 1;
	}
	if (!recording.asked)
		fprintf(stderr, "facet: %s: the recording ended: %s; the file is whole up to there\n", job.output,
		        recording.reason);
	printf("%s: %llu bytes\n", job.output, (unsigned long long)recording.bytes);
	return recording.asked ? 0 : 1;
}

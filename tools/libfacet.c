/* One descriptor, one buffer of what was read and one of what is still to be sent. Frames go to the mirror as they become
 * whole; what a client may want to know of them becomes an event. Nothing here waits but facet_wait, which polls around
 * facet_next, and facet_follow, which connects again around facet_wait.
 *
 * A connection speaks frames once it has wanted a map, lines if it has said something before. Over a WebSocket it is the same:
 * binary messages are the stream of frames, texts are lines (libfacet_websocket.h). It is `broken` after an
 * error: its bytes can no longer be told apart, so nothing more is read, and the first sentence stays. */
#include "tools/facet.h"

#include <errno.h>
#include <poll.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <sys/socket.h>
#include <unistd.h>

#include "config/address.h"
#include "tools/libfacet.h"
#include "tools/libfacet_websocket.h"

enum { READ_CHUNK = 256 << 10, READS_MAX = 64, RETRY_MS = 1000, ANSWER_MS = 5000 };

enum language { SILENT, FRAMES, LINES };

struct facet {
	int fd;
	enum language language;
	struct address address;
	char where[ADDRESS_TEXT_MAX];
	char error[FACET_ERROR_MAX];
	char reason[160]; /* what the daemon said last about an error */
	int broken;       /* -errno */
	int64_t retry_ms; /* when facet_follow tries again */
	bool wants;
	struct native_want want;
	struct native_mirror *mirror;
	struct buffer out;      /* to be sent from out_at on */
	struct buffer unpacked; /* the frame that was compressed */
	struct buffer text;     /* of the last event */
	struct patch **list;    /* of facet_patches */
	size_t out_at;
	struct websocket ws; /* of ws: addresses */
	struct buffer plain; /* a message before it becomes a frame of it */
	uint8_t *data;
	size_t begin, end, cap; /* data[begin..end) is read, not yet handled */
};

static int fail(struct facet *facet, int code, const char *format, ...) __attribute__((format(printf, 3, 4)));

static int fail(struct facet *facet, int code, const char *format, ...)
{
	va_list args;
	va_start(args, format);
	vsnprintf(facet->error, sizeof(facet->error), format, args);
	va_end(args);
	return code;
}

/* Connections --------------------------------------------------------------------------------------------------------- */

static bool is_web(const struct facet *facet)
{
	return facet->address.kind == ADDRESS_WS;
}

static int make_room(struct facet *facet);
static int hear_web(struct facet *facet, size_t n);

/* What came right behind the server's answer is heard as what is read later. */
static int open_websocket(struct facet *facet, int timeout_ms)
{
	struct buffer rest = {0};
	int r = make_room(facet);
	memset(&facet->ws, 0, sizeof(facet->ws));
	r = r ? r : libfacet_upgrade(facet->fd, &facet->address, timeout_ms, &rest, facet->error);
	if (r == 0 && rest.len > 0) {
		memcpy(facet->data + 1, rest.data, rest.len);
		r = hear_web(facet, rest.len);
	}
	buffer_finish(&rest);
	if (r >= 0)
		return 0;
	close(facet->fd);
	facet->fd = -1;
	return r;
}

static int connect_now(struct facet *facet, int timeout_ms)
{
	const int fd = libfacet_connect(&facet->address, timeout_ms);
	if (fd < 0)
		return fail(facet, fd, "no daemon answers at %s (%s); %s", facet->where, strerror(-fd),
		            fd == -EACCES ? "join the group facetd, or ask its owner"
		                          : "start facetd, or say where it is (ADDRESS or $FACETD)");
	facet->fd = fd;
	return is_web(facet) ? open_websocket(facet, timeout_ms) : 0;
}

static int parse_address(const char *text, struct address *ret, char *error)
{
	char where[ADDRESS_TEXT_MAX], sentence[ADDRESS_ERROR_MAX];
	if (!text || !text[0])
		text = address_default(where);
	const int r = address_parse(text, ADDRESS_UNIX | ADDRESS_TCP | ADDRESS_WS, ret, sentence);
	if (r && error)
		snprintf(error, FACET_ERROR_MAX, "%s", sentence);
	return r;
}

struct facet *facet_open(const char *address, int timeout_ms, char error[FACET_ERROR_MAX])
{
	struct address where;
	if (parse_address(address, &where, error))
		return NULL;
	struct facet *facet = calloc(1, sizeof(*facet));
	if (facet) {
		facet->fd = -1;
		facet->address = where;
		address_print(&where, facet->where);
		facet->mirror = native_mirror_create();
	}
	if (facet && facet->mirror && !connect_now(facet, timeout_ms))
		return facet;
	if (error)
		snprintf(error, FACET_ERROR_MAX, "%s", facet && facet->mirror ? facet->error : "memory is out");
	facet_close(facet);
	return NULL;
}

/* Best effort: who goes says so, if nothing of his is half said. */
static void say_goodbye(struct facet *facet)
{
	struct buffer frame = {0};
	websocket_put(&frame, WEBSOCKET_CLOSE, (const uint8_t[4]){0}, "\x03\xe8", 2); /* 1000 */
	if (!frame.error && facet->out.len == facet->out_at && !facet->ws.closed)
		send(facet->fd, frame.data, frame.len, MSG_NOSIGNAL);
	buffer_finish(&frame);
}

static void hang_up(struct facet *facet)
{
	if (is_web(facet) && facet->fd >= 0)
		say_goodbye(facet);
	if (facet->fd >= 0)
		close(facet->fd);
	facet->fd = -1;
	facet->begin = facet->end = 0;
	facet->out.len = facet->out_at = 0;
	facet->out.error = 0;
	facet->reason[0] = '\0';
	facet->language = SILENT;
	facet->broken = 0;
}

void facet_close(struct facet *facet)
{
	if (!facet)
		return;
	hang_up(facet);
	native_mirror_destroy(facet->mirror);
	buffer_finish(&facet->out);
	buffer_finish(&facet->plain);
	buffer_finish(&facet->unpacked);
	buffer_finish(&facet->text);
	free(facet->list);
	free(facet->data);
	free(facet);
}

int facet_reopen(struct facet *facet, int timeout_ms)
{
	hang_up(facet);
	native_mirror_lost(facet->mirror);
	int r = connect_now(facet, timeout_ms);
	if (r == 0 && facet->wants)
		r = libfacet_want(facet, &facet->want);
	if (r)
		facet->broken = r;
	return r;
}

const char *facet_address(const struct facet *facet)
{
	return facet->where;
}

const char *facet_error(const struct facet *facet)
{
	return facet->error;
}

int facet_fd(const struct facet *facet)
{
	return facet->fd;
}

short facet_poll_events(const struct facet *facet)
{
	return (short)(POLLIN | (facet->out_at < facet->out.len ? POLLOUT : 0));
}

static int lose(struct facet *facet, int code)
{
	facet->broken = code;
	return fail(facet, code, "%s: the connection is lost (%s)", facet->where,
	            facet->reason[0]      ? facet->reason
	            : code == -ECONNRESET ? "the daemon closed it"
	                                  : strerror(-code));
}

/* Sending ------------------------------------------------------------------------------------------------------------- */

/* As much as the socket takes. A peer that closed is found out by reading, which may still find its reason. */
static void flush(struct facet *facet)
{
	while (facet->out_at < facet->out.len) {
		const ssize_t n =
		    send(facet->fd, facet->out.data + facet->out_at, facet->out.len - facet->out_at, MSG_NOSIGNAL);
		if (n < 0 && errno == EINTR)
			continue;
		if (n < 0 && errno != EAGAIN)
			facet->out_at = facet->out.len;
		if (n <= 0)
			break;
		facet->out_at += (size_t)n;
	}
	if (facet->out_at == facet->out.len)
		facet->out.len = facet->out_at = 0;
}

static int send_out(struct facet *facet)
{
	if (facet->out.error)
		return fail(facet, -ENOMEM, "memory is out");
	flush(facet);
	return 0;
}

static void draw_mask(uint8_t mask[4])
{
	if (getrandom(mask, 4, GRND_NONBLOCK) != 4)
		memset(mask, 0x5a, 4); /* early at boot; it hides nothing, it keeps proxies from being confused */
}

/* Where a message is put together; end_message sends it. */
static struct buffer *begin_message(struct facet *facet)
{
	facet->plain.len = 0;
	return is_web(facet) ? &facet->plain : &facet->out;
}

static int end_message(struct facet *facet, enum websocket_opcode kind)
{
	uint8_t mask[4];
	draw_mask(mask);
	if (is_web(facet) && facet->plain.error)
		return fail(facet, -ENOMEM, "memory is out");
	if (is_web(facet))
		websocket_put(&facet->out, kind, mask, facet->plain.data, facet->plain.len);
	return send_out(facet);
}

int libfacet_want(struct facet *facet, const struct native_want *want)
{
	facet->wants = true;
	facet->want = *want;
	if (facet->fd < 0 || facet->broken)
		return fail(facet, -ENOTCONN, "%s: there is no connection", facet->where);
	if (facet->language == LINES)
		return fail(facet, -EINVAL, "%s: this connection speaks lines; open another one for the map",
		            facet->where);
	facet->language = FRAMES;
	native_put_want(begin_message(facet), want);
	return end_message(facet, WEBSOCKET_BINARY);
}

static int wish(struct facet *facet, const struct facet_want *want, struct native_want *ret)
{
	const bool coded = want->flags & FACET_WANT_CODED ||
	                   (facet->address.kind != ADDRESS_UNIX && !(want->flags & FACET_WANT_PLAIN));
	*ret = (struct native_want){.bytes_per_s = want->bytes_per_s};
	if ((want->flags & FACET_WANT_BOX) && (want->flags & FACET_WANT_RADIUS))
		return fail(facet, -EINVAL, "a box and a radius at once cannot be wanted; choose one");
	if (want->flags & FACET_WANT_BOX) {
		ret->flags |= NATIVE_WANT_BOX;
		memcpy(ret->region, want->box, sizeof(want->box));
	} else if (want->flags & FACET_WANT_RADIUS) {
		ret->flags |= NATIVE_WANT_RADIUS;
		ret->region[0] = want->radius_m;
	}
	if (coded)
		ret->flags |= NATIVE_WANT_CODED | NATIVE_WANT_ZSTD;
	return 0;
}

int facet_want(struct facet *facet, const struct facet_want *want)
{
	static const struct facet_want everything;
	struct native_want native;
	const int r = wish(facet, want ? want : &everything, &native);
	return r ? r : libfacet_want(facet, &native);
}

int facet_say(struct facet *facet, const char *line)
{
	if (facet->fd < 0 || facet->broken)
		return fail(facet, -ENOTCONN, "%s: there is no connection", facet->where);
	if (strlen(line) > NATIVE_FROM_CLIENT_MAX / 2 || strchr(line, '\n'))
		return fail(facet, -EINVAL, "a command is one line of at most %u bytes", NATIVE_FROM_CLIENT_MAX / 2);
	if (facet->language == SILENT)
		facet->language = LINES;
	struct buffer *message = begin_message(facet);
	if (facet->language == FRAMES) {
		native_put_json(message, line, strlen(line));
		return end_message(facet, WEBSOCKET_BINARY);
	}
	/* In one piece: who answers the line may close before a second one arrives. */
	buffer_append(message, line, strlen(line));
	if (!is_web(facet))
		buffer_append(message, "\n", 1);
	return end_message(facet, WEBSOCKET_TEXT);
}

/* Reading ------------------------------------------------------------------------------------------------------------- */

/* Room for one more chunk. What was handled is dropped first, so the buffer holds at most one frame and a chunk. */
static int make_room(struct facet *facet)
{
	if (facet->begin > 0) {
		memmove(facet->data, facet->data + facet->begin, facet->end - facet->begin);
		facet->end -= facet->begin;
		facet->begin = 0;
	}
	if (facet->cap - facet->end >= READ_CHUNK)
		return 0;
	const size_t least = facet->end + READ_CHUNK, cap = 2 * facet->cap > least ? 2 * facet->cap : least;
	uint8_t *data = realloc(facet->data, cap);
	if (!data)
		return fail(facet, -ENOMEM, "memory is out");
	facet->data = data;
	facet->cap = cap;
	return 0;
}

/* `n` bytes of a WebSocket stand one byte behind the end of what is read. 1: they are heard, -errno. */
static int hear_web(struct facet *facet, size_t n)
{
	char sentence[WEBSOCKET_ERROR_MAX];
	uint8_t mask[4];
	draw_mask(mask);
	const ssize_t kept = websocket_hear(&facet->ws, facet->data + facet->end, n, mask, &facet->out, sentence);
	flush(facet);
	if (facet->ws.closed && facet->ws.reason[0])
		snprintf(facet->reason, sizeof(facet->reason), "%s", facet->ws.reason);
	if (kept == -ECONNRESET)
		return lose(facet, -ECONNRESET);
	if (kept < 0)
		return fail(facet, (int)kept, "%s: %s", facet->where, sentence);
	facet->end += (size_t)kept;
	return 1;
}

/* 1: something was read, 0: there is nothing, -errno. */
static int read_more(struct facet *facet)
{
	const int room = make_room(facet);
	if (room)
		return room;
	for (;;) {
		const size_t spare = is_web(facet); /* websocket_hear wants a byte before them */
		const ssize_t n = recv(facet->fd, facet->data + facet->end + spare, facet->cap - facet->end - spare, 0);
		if (n > 0 && is_web(facet))
			return hear_web(facet, (size_t)n);
		if (n > 0) {
			facet->end += (size_t)n;
			return 1;
		}
		if (n == 0)
			return lose(facet, -ECONNRESET);
		if (errno == EAGAIN)
			return 0;
		if (errno != EINTR)
			return lose(facet, -errno);
	}
}

/* The daemon says why before it closes: {"error": "..."}. Only for a sentence: what is escaped stays so. */
static void keep_reason(struct facet *facet, const char *text, size_t len)
{
	static const char member[] = "\"error\":";
	const char *at = memmem(text, len, member, sizeof(member) - 1), *end = text + len;
	size_t n = 0;
	if (!at)
		return;
	for (at += sizeof(member) - 1; at < end && *at == ' '; at++)
		;
	if (at == end || *at++ != '"')
		return;
	for (; at < end && *at != '"' && n + 2 < sizeof(facet->reason); at++) {
		if (*at == '\\' && at + 1 < end)
			facet->reason[n++] = *at++;
		facet->reason[n++] = *at;
	}
	facet->reason[n] = '\0';
}

/* 1, or -ENOMEM. */
static int tell_text(struct facet *facet, const char *text, size_t len, struct facet_event *ret)
{
	facet->text.len = 0;
	buffer_append(&facet->text, text, len);
	buffer_append(&facet->text, "", 1);
	if (facet->text.error)
		return fail(facet, -ENOMEM, "memory is out");
	*ret = (struct facet_event){.kind = FACET_JSON, .text = (const char *)facet->text.data, .len = len};
	return 1;
}

static void tell_commit(struct facet *facet, struct facet_event *ret)
{
	*ret = (struct facet_event){.kind = FACET_COMMIT,
	                            .step = native_mirror_step(facet->mirror),
	                            .reset = native_mirror_was_reset(facet->mirror)};
	native_mirror_changed(facet->mirror, &ret->changed);
	native_mirror_removed(facet->mirror, &ret->removed);
}

/* 1: an event, 0: none of this frame, -errno with a sentence. */
static int apply(struct facet *facet, struct native_message *message, struct facet_event *ret)
{
	const enum native_type type = message->type;
	char sentence[128];
	if (type == NATIVE_JSON) {
		keep_reason(facet, message->json.text, message->json.len);
		return tell_text(facet, message->json.text, message->json.len, ret);
	}
	const int r = native_mirror_apply(facet->mirror, message, sentence);
	if (r < 0)
		return fail(facet, r, "%s: %s", facet->where, sentence);
	if (type == NATIVE_HELLO)
		*ret = (struct facet_event){.kind = FACET_HELLO};
	else if (r == 1)
		tell_commit(facet, ret);
	return type == NATIVE_HELLO || r == 1;
}

/* The first frame that is whole: 1 an event, 0 none of it, -EAGAIN there is none, another -errno with a sentence. */
static int take_frame(struct facet *facet, struct facet_event *ret)
{
	char sentence[128] = "the length of a frame is impossible";
	struct native_message message;
	if (facet->begin == facet->end)
		return -EAGAIN;
	const uint8_t *frame = facet->data + facet->begin;
	const ssize_t n = native_scan(frame, facet->end - facet->begin, NATIVE_TO_CLIENT_MAX);
	if (n == 0)
		return -EAGAIN;
	int r = n < 0 ? (int)n : 0;
	if (n > 0) {
		size_t len = (size_t)n;
		facet->begin += len;
		if (native_is_packed(frame)) {
			facet->unpacked.len = 0;
			r = native_unpack(frame, len, NATIVE_TO_CLIENT_MAX, &facet->unpacked, sentence);
			frame = facet->unpacked.data;
			len = facet->unpacked.len;
		}
		r = r ? r : native_decode(frame, len, &message, sentence);
	}
	if (r == -ENOTSUP)
		return 0;
	return r < 0 ? fail(facet, r, "%s: %s", facet->where, sentence) : apply(facet, &message, ret);
}

static int take_line(struct facet *facet, struct facet_event *ret)
{
	const size_t len = facet->end - facet->begin;
	const char *line = len ? (const char *)facet->data + facet->begin : NULL;
	const char *newline = len ? memchr(line, '\n', len) : NULL;
	if (!newline && len > LIBFACET_LINE_MAX)
		return fail(facet, -EPROTO, "%s: a line without an end", facet->where);
	if (!newline)
		return -EAGAIN;
	facet->begin += (size_t)(newline - line) + 1;
	return tell_text(facet, line, (size_t)(newline - line), ret);
}

int facet_next(struct facet *facet, struct facet_event *ret)
{
	if (facet->broken)
		return facet->broken;
	if (facet->fd < 0)
		return fail(facet, -ENOTCONN, "%s: there is no connection", facet->where);
	flush(facet);
	for (int reads = 0; reads < READS_MAX;) {
		int r = facet->language == LINES ? take_line(facet, ret) : take_frame(facet, ret);
		if (r == -EAGAIN) {
			r = read_more(facet);
			reads++;
			if (r == 0)
				return 0;
			r = r < 0 ? r : 0;
		}
		if (r < 0 && !facet->broken)
			facet->broken = r;
		if (r)
			return r;
	}
	return 0;
}

/* Waiting ------------------------------------------------------------------------------------------------------------- */

static int left_ms(int64_t until_ms)
{
	const int64_t left = until_ms - libfacet_now_ms();
	return until_ms == INT64_MAX ? -1 : left > 0 ? (int)left : 0;
}

static int64_t deadline_ms(int timeout_ms)
{
	return timeout_ms < 0 ? INT64_MAX : libfacet_now_ms() + timeout_ms;
}

int facet_wait(struct facet *facet, int timeout_ms, struct facet_event *ret)
{
	const int64_t until_ms = deadline_ms(timeout_ms);
	for (;;) {
		const int r = facet_next(facet, ret);
		if (r)
			return r;
		struct pollfd poll_fd = {.fd = facet->fd, .events = facet_poll_events(facet)};
		const int n = poll(&poll_fd, 1, left_ms(until_ms));
		if (n == 0)
			return 0;
		if (n < 0)
			return errno == EINTR ? 0 : fail(facet, -errno, "%s: %s", facet->where, strerror(errno));
	}
}

int facet_follow(struct facet *facet, int timeout_ms, struct facet_event *ret)
{
	const int64_t until_ms = deadline_ms(timeout_ms);
	for (;;) {
		if (facet->fd >= 0 && !facet->broken) {
			const int r = facet_wait(facet, left_ms(until_ms), ret);
			if (r >= 0)
				return r;
			hang_up(facet);
			facet->retry_ms = libfacet_now_ms() + RETRY_MS;
			*ret = (struct facet_event){.kind = FACET_LOST};
			return 1;
		}
		const int64_t next = facet->retry_ms < until_ms ? facet->retry_ms : until_ms;
		if (poll(NULL, 0, left_ms(next)) < 0 || (next == until_ms && left_ms(until_ms) == 0))
			return 0;
		if (facet_reopen(facet, ANSWER_MS))
			facet->retry_ms = libfacet_now_ms() + RETRY_MS;
	}
}

/* The map ------------------------------------------------------------------------------------------------------------- */

const struct native_mirror *libfacet_mirror(const struct facet *facet)
{
	return facet->mirror;
}

int facet_patches(struct facet *facet, const struct facet_patch *const **ret, size_t *ret_n)
{
	struct patch **list;
	const size_t n = patch_store_living(native_mirror_patches(facet->mirror), &list);
	if (!list)
		return fail(facet, -ENOMEM, "memory is out");
	free(facet->list);
	facet->list = list;
	*ret = (const struct facet_patch *const *)list;
	*ret_n = n;
	return 0;
}

/* WebSockets as a client speaks them (RFC 6455): the handshake's two texts, and frames. Pure: bytes in, bytes out; keys and
 * masks are handed in. No extensions: none is offered, so none may be used. */
#ifndef FACET_TOOLS_LIBFACET_WEBSOCKET_H
#define FACET_TOOLS_LIBFACET_WEBSOCKET_H

#include <stdbool.h>
#include <stdint.h>
#include <sys/types.h>

#include "config/address.h"
#include "core/native.h"

#define WEBSOCKET_HEAD_MAX   (8u << 10) /* bytes of the server's answer to the handshake */
#define WEBSOCKET_REASON_MAX 124        /* with the NUL */
#define WEBSOCKET_ERROR_MAX  160

enum websocket_opcode {
	WEBSOCKET_MORE = 0,
	WEBSOCKET_TEXT = 1,
	WEBSOCKET_BINARY = 2,
	WEBSOCKET_CLOSE = 8,
	WEBSOCKET_PING = 9,
	WEBSOCKET_PONG = 10
};

/* Appends the request that opens one; `key` is random. */
void websocket_put_request(struct buffer *, const struct address *, const uint8_t key[16]);
/* Judges the answer to it. Its length when it is whole and good; 0: more of it is needed; -errno with a sentence, which does not
 * name the server: -EACCES where a token is missing or wrong. */
ssize_t websocket_judge(const uint8_t *answer, size_t len, const uint8_t key[16], char error[WEBSOCKET_ERROR_MAX]);

/* Appends one frame, a whole message. */
void websocket_put(struct buffer *, enum websocket_opcode, const uint8_t mask[4], const void *data, size_t len);

/* A reader of frames; zeroed it begins. */
struct websocket {
	uint8_t head[10];
	uint8_t head_len; /* read of the frame's head; payload follows once it is whole */
	bool in_payload, in_message, is_text, final;
	enum websocket_opcode opcode;
	uint64_t left; /* of the payload */
	uint8_t control[125];
	uint8_t control_len;
	bool closed;   /* it said goodbye: */
	uint16_t code; /* 0: none was told */
	char reason[WEBSOCKET_REASON_MAX];
};

/* Hears the `n` bytes from place + 1 on and leaves what they bring from `place` on: the payloads of binary messages as one
 * stream, texts as lines (a newline behind each, for which the first byte is spared). Answers to pings and to a close are appended to
 * `ret_answers`, masked with `mask`. How many bytes are left there; -ECONNRESET after a close; -EPROTO with a sentence:
 * nothing more can be told apart. */
ssize_t websocket_hear(struct websocket *, uint8_t *place, size_t n, const uint8_t mask[4], struct buffer *ret_answers,
                       char error[WEBSOCKET_ERROR_MAX]);

#endif

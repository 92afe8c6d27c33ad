/* A frame: fin 1 bit, reserved 3, opcode 4 │ masked 1, length 7 │ length 16 or 64 if those are 126, 127 │ payload. Numbers are
 * big-endian. What a client sends is masked, what a server sends is not.
 *
 * Payloads are handed on as they come, never gathered: a length is judged for its form and then only counts down, so a server
 * that promises 2^62 bytes costs nothing. Only the 125 bytes that a control frame may have are kept.
 *
 * A head takes two bytes at least and a text's newline one, so what a call leaves never overtakes what it still has to read by
 * more than one byte: the newline of a text whose head came before. */
#include "tools/libfacet_websocket.h"

#include <assert.h>
#include <ctype.h>
#include <errno.h>
#include <stdio.h>
#include <string.h>
#include <strings.h>

/* The handshake ------------------------------------------------------------------------------------------------------- */

static uint32_t rotate(uint32_t x, int by)
{
	return x << by | x >> (32 - by);
}

/* FIPS 180-4, one block. Here it guards nothing: the handshake wants it as a sign that the other side speaks WebSocket. */
static void sha1_block(uint32_t h[5], const uint8_t block[64])
{
	static const uint32_t constant[4] = {0x5a827999, 0x6ed9eba1, 0x8f1bbcdc, 0xca62c1d6};
	uint32_t w[80], a = h[0], b = h[1], c = h[2], d = h[3], e = h[4];
	for (int i = 0; i < 16; i++)
		w[i] = (uint32_t)block[4 * i] << 24 | (uint32_t)block[4 * i + 1] << 16 |
		       (uint32_t)block[4 * i + 2] << 8 | block[4 * i + 3];
	for (int i = 16; i < 80; i++)
		w[i] = rotate(w[i - 3] ^ w[i - 8] ^ w[i - 14] ^ w[i - 16], 1);
	for (int i = 0; i < 80; i++) {
		const uint32_t f = i < 20              ? (b & c) | (~b & d)
		                   : i < 40 || i >= 60 ? b ^ c ^ d
		                                       : (b & c) | (b & d) | (c & d);
		const uint32_t next = rotate(a, 5) + f + e + constant[i / 20] + w[i];
		e = d;
		d = c;
		c = rotate(b, 30);
		b = a;
		a = next;
	}
	h[0] += a;
	h[1] += b;
	h[2] += c;
	h[3] += d;
	h[4] += e;
}

/* Of 60 bytes, which is all that the handshake hashes. */
static void sha1_of_60(const uint8_t text[60], uint8_t ret[20])
{
	uint32_t h[5] = {0x67452301, 0xefcdab89, 0x98badcfe, 0x10325476, 0xc3d2e1f0};
	uint8_t block[128] = {0};
	memcpy(block, text, 60);
	block[60] = 0x80;
	block[126] = 480 >> 8; /* bits */
	block[127] = 480 & 255;
	sha1_block(h, block);
	sha1_block(h, block + 64);
	for (int i = 0; i < 20; i++)
		ret[i] = (uint8_t)(h[i / 4] >> (24 - 8 * (i % 4)));
}

static void base64(const uint8_t *bytes, size_t n, char *ret)
{
	static const char letters[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
	for (size_t i = 0; i < n; i += 3) {
		const uint32_t three = (uint32_t)bytes[i] << 16 | (i + 1 < n ? (uint32_t)bytes[i + 1] << 8 : 0) |
		                       (i + 2 < n ? bytes[i + 2] : 0);
		*ret++ = letters[three >> 18];
		*ret++ = letters[three >> 12 & 63];
		*ret++ = i + 1 < n ? letters[three >> 6 & 63] : '=';
		*ret++ = i + 2 < n ? letters[three & 63] : '=';
	}
	*ret = '\0';
}

void websocket_put_request(struct buffer *b, const struct address *address, const uint8_t key[16])
{
	const bool v6 = strchr(address->host, ':') != NULL;
	char text[25];
	base64(key, 16, text);
	buffer_printf(b,
	              "GET %s HTTP/1.1\r\nHost: %s%s%s:%u\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
	              "Sec-WebSocket-Key: %s\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: facetd.v1\r\n\r\n",
	              address->target, v6 ? "[" : "", address->host, v6 ? "]" : "", address->port, text);
}

/* Does the header `name` stand in the answer, and is `value` what it says (any, where NULL)? */
static bool has_header(const char *at, const char *end, const char *name, const char *value)
{
	const size_t len = strlen(name);
	for (const char *line = at; line < end;) {
		const char *stop = memmem(line, (size_t)(end - line), "\r\n", 2);
		stop = stop ? stop : end;
		if ((size_t)(stop - line) > len && strncasecmp(line, name, len) == 0 && line[len] == ':') {
			const char *from = line + len + 1, *to = stop;
			while (from < to && (*from == ' ' || *from == '\t'))
				from++;
			while (to > from && (to[-1] == ' ' || to[-1] == '\t'))
				to--;
			if (!value || ((size_t)(to - from) == strlen(value) && memcmp(from, value, strlen(value)) == 0))
				return true;
		}
		line = stop + 2;
	}
	return false;
}

static int refuse(char error[WEBSOCKET_ERROR_MAX], int code, const char *sentence)
{
	snprintf(error, WEBSOCKET_ERROR_MAX, "%s", sentence);
	return code;
}

static int judge_code(int code, char error[WEBSOCKET_ERROR_MAX])
{
	if (code == 401 || code == 403)
		return refuse(error, -EACCES, "it wants another token; write ws://HOST:PORT/?token=TOKEN");
	if (code == 429 || code == 503)
		return refuse(error, -EAGAIN, "it lets nobody in at the moment; try again in a minute");
	snprintf(error, WEBSOCKET_ERROR_MAX,
	         "it answers %d instead of opening a WebSocket; is listen.http of facetd there?", code);
	return -EPROTO;
}

ssize_t websocket_judge(const uint8_t *answer, size_t len, const uint8_t key[16], char error[WEBSOCKET_ERROR_MAX])
{
	static const char guid[] = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11";
	const char *text = (const char *)answer, *end = memmem(answer, len, "\r\n\r\n", 4);
	char joined[61], accept[29];
	uint8_t digest[20];
	if ((len >= 9 && (memcmp(text, "HTTP/1.", 7) != 0 || !isdigit(answer[7]) || text[8] != ' ')) ||
	    (!end && len >= WEBSOCKET_HEAD_MAX))
		return refuse(error, -EPROTO, "it does not speak HTTP; is listen.http of facetd there?");
	if (!end)
		return 0;
	if (end - text < 12 || !isdigit(answer[9]) || !isdigit(answer[10]) || !isdigit(answer[11]))
		return refuse(error, -EPROTO, "its answer has no status; is listen.http of facetd there?");
	if (memcmp(text + 9, "101", 3) != 0)
		return judge_code((answer[9] - '0') * 100 + (answer[10] - '0') * 10 + answer[11] - '0', error);
	base64(key, 16, joined);
	memcpy(joined + 24, guid, sizeof(guid));
	sha1_of_60((const uint8_t *)joined, digest);
	base64(digest, sizeof(digest), accept);
	if (!has_header(text, end, "Sec-WebSocket-Accept", accept) ||
	    has_header(text, end, "Sec-WebSocket-Extensions", NULL))
		return refuse(error, -EPROTO, "it opens a WebSocket that was not asked for");
	if (!has_header(text, end, "Sec-WebSocket-Protocol", "facetd.v1"))
		return refuse(error, -EPROTO, "it does not speak facetd.v1; is listen.http of facetd there?");
	return end + 4 - text;
}

/* Frames -------------------------------------------------------------------------------------------------------------- */

void websocket_put(struct buffer *b, enum websocket_opcode opcode, const uint8_t mask[4], const void *data, size_t len)
{
	uint8_t head[14] = {(uint8_t)(0x80 | opcode), (uint8_t)(0x80 | (len < 126     ? len
	                                                                : len < 65536 ? 126
	                                                                              : 127))},
	        n = 2;
	const int wide = len < 126 ? 0 : len < 65536 ? 2 : 8;
	for (int i = wide - 1; i >= 0; i--)
		head[n++] = (uint8_t)((uint64_t)len >> (8 * i));
	memcpy(head + n, mask, 4);
	buffer_append(b, head, n + 4u);
	const size_t at = b->len;
	buffer_append(b, data, len);
	for (size_t i = 0; !b->error && i < len; i++)
		b->data[at + i] ^= mask[i % 4];
}

/* Bytes that a head has, as far as its first two tell. */
static size_t head_size(const struct websocket *ws)
{
	return ws->head_len < 2 ? 2 : (ws->head[1] & 127) == 126 ? 4 : (ws->head[1] & 127) == 127 ? 10 : 2;
}

static const char *judge_head(const struct websocket *ws, uint64_t length)
{
	const uint8_t opcode = ws->head[0] & 15;
	const bool control = opcode >= WEBSOCKET_CLOSE;
	if (ws->head[0] & 0x70)
		return "a WebSocket frame with reserved bits";
	if (ws->head[1] & 0x80)
		return "a WebSocket frame that is masked, as only a client's are";
	if (opcode > WEBSOCKET_PONG || (opcode > WEBSOCKET_BINARY && !control))
		return "a WebSocket frame of no known kind";
	if (control && (length > sizeof(ws->control) || !(ws->head[0] & 0x80)))
		return "a WebSocket control frame that is too long, or in pieces";
	if (!control && (opcode == WEBSOCKET_MORE) != ws->in_message)
		return "a WebSocket message inside another, or without a beginning";
	if (length >> 63 || (head_size(ws) == 4 && length < 126) || (head_size(ws) == 10 && length < 65536))
		return "a WebSocket frame with an impossible length";
	return NULL;
}

/* The head is whole. */
static const char *begin_frame(struct websocket *ws)
{
	uint64_t length = ws->head[1] & 127;
	if (length >= 126) {
		length = 0;
		for (size_t i = 2; i < ws->head_len; i++)
			length = length << 8 | ws->head[i];
	}
	const char *wrong = judge_head(ws, length);
	ws->opcode = ws->head[0] & 15;
	ws->final = ws->head[0] & 0x80;
	ws->left = length;
	ws->in_payload = true;
	ws->control_len = 0;
	if (ws->opcode == WEBSOCKET_TEXT || ws->opcode == WEBSOCKET_BINARY)
		ws->is_text = ws->opcode == WEBSOCKET_TEXT;
	return wrong;
}

static void end_control(struct websocket *ws, const uint8_t mask[4], struct buffer *answers)
{
	if (ws->opcode == WEBSOCKET_PING)
		websocket_put(answers, WEBSOCKET_PONG, mask, ws->control, ws->control_len);
	if (ws->opcode != WEBSOCKET_CLOSE)
		return;
	ws->closed = true;
	if (ws->control_len >= 2) {
		ws->code = (uint16_t)(ws->control[0] << 8 | ws->control[1]);
		for (int i = 2; i < ws->control_len; i++) /* it may go to a terminal */
			ws->reason[i - 2] = ws->control[i] < ' ' || ws->control[i] == 127 ? '?' : (char)ws->control[i];
	}
	websocket_put(answers, WEBSOCKET_CLOSE, mask, ws->control, ws->control_len >= 2 ? 2 : 0);
}

/* The payload is whole. What a text's end leaves: 1, its newline. */
static size_t end_frame(struct websocket *ws, const uint8_t mask[4], struct buffer *answers, uint8_t *to)
{
	const bool text_ends = ws->opcode < WEBSOCKET_CLOSE && ws->final && ws->is_text;
	ws->head_len = 0;
	ws->in_payload = false;
	if (ws->opcode >= WEBSOCKET_CLOSE)
		end_control(ws, mask, answers);
	else
		ws->in_message = !ws->final;
	if (text_ends)
		*to = '\n';
	return text_ends;
}

ssize_t websocket_hear(struct websocket *ws, uint8_t *place, size_t n, const uint8_t mask[4],
                       struct buffer *ret_answers, char error[WEBSOCKET_ERROR_MAX])
{
	const uint8_t *bytes = place + 1;
	size_t at = 0, kept = 0;
	while (!ws->closed && (at < n || (ws->in_payload && ws->left == 0))) {
		if (!ws->in_payload) {
			ws->head[ws->head_len++] = bytes[at++];
			const char *wrong = ws->head_len == head_size(ws) ? begin_frame(ws) : NULL;
			if (wrong)
				return refuse(error, -EPROTO, wrong);
			continue;
		}
		const size_t piece = ws->left < n - at ? (size_t)ws->left : n - at;
		if (ws->opcode >= WEBSOCKET_CLOSE) {
			memcpy(ws->control + ws->control_len, bytes + at, piece);
			ws->control_len = (uint8_t)(ws->control_len + piece);
		} else {
			memmove(place + kept, bytes + at, piece);
			kept += piece;
		}
		at += piece;
		ws->left -= piece;
		if (ws->left == 0)
			kept += end_frame(ws, mask, ret_answers, place + kept);
		assert(kept <= at + 1);
	}
	if (ws->closed && kept == 0)
		return refuse(error, -ECONNRESET, ws->reason[0] ? ws->reason : "the daemon closed it");
	return (ssize_t)kept;
}

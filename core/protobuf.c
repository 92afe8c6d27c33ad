/* Protocol Buffers, the writing half (the encoding chapter of its documentation):
 *
 *   field   = varint (number << 3 | wire type), value
 *   varint  = 7 bits a byte, low ones first, bit 7: more follow
 *   type    0 varint, 1 eight bytes, 2 varint length and so many bytes, 5 four bytes; all little-endian
 *
 * A handful of messages of fixed shape needs neither a run-time library nor generated code. */
#include "core/protobuf.h"

#include <string.h>

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "numbers go to the wire as they are in memory");

enum wire_type { VARINT = 0, EIGHT_BYTES = 1, LENGTH = 2, FOUR_BYTES = 5 };

#define VARINT_MAX 10

static size_t varint(uint8_t ret[VARINT_MAX], uint64_t value)
{
	size_t n = 0;

	while (value >= 0x80) {
		ret[n++] = (uint8_t)(value | 0x80);
		value >>= 7;
	}
	ret[n++] = (uint8_t)value;
	return n;
}

void protobuf_varint(struct buffer *b, uint64_t value)
{
	uint8_t bytes[VARINT_MAX];

	buffer_append(b, bytes, varint(bytes, value));
}

static void tag(struct buffer *b, unsigned field, enum wire_type type)
{
	protobuf_varint(b, (uint64_t)field << 3 | type);
}

void protobuf_uint(struct buffer *b, unsigned field, uint64_t value)
{
	tag(b, field, VARINT);
	protobuf_varint(b, value);
}

void protobuf_double(struct buffer *b, unsigned field, double value)
{
	tag(b, field, EIGHT_BYTES);
	buffer_append(b, &value, 8);
}

void protobuf_fixed32(struct buffer *b, unsigned field, uint32_t value)
{
	tag(b, field, FOUR_BYTES);
	buffer_append(b, &value, 4);
}

void protobuf_head(struct buffer *b, unsigned field, size_t len)
{
	tag(b, field, LENGTH);
	protobuf_varint(b, len);
}

void protobuf_bytes(struct buffer *b, unsigned field, const void *data, size_t len)
{
	protobuf_head(b, field, len);
	buffer_append(b, data, len);
}

void protobuf_string(struct buffer *b, unsigned field, const char *text)
{
	protobuf_bytes(b, field, text, strlen(text));
}

size_t protobuf_begin(struct buffer *b, unsigned field)
{
	tag(b, field, LENGTH);
	return b->len;
}

void protobuf_end(struct buffer *b, size_t begun)
{
	const size_t len = b->len - begun;
	uint8_t bytes[VARINT_MAX];
	const size_t n = varint(bytes, len);

	buffer_append(b, bytes, n); /* makes the room */
	if (b->error)
		return;
	memmove(b->data + begun + n, b->data + begun, len);
	memcpy(b->data + begun, bytes, n);
}

void protobuf_time(struct buffer *b, unsigned field, int64_t t_ns)
{
	const int64_t second_ns = 1000000000, seconds = t_ns / second_ns - (t_ns % second_ns < 0);
	const size_t begun = protobuf_begin(b, field);

	protobuf_uint(b, 1, (uint64_t)seconds);
	protobuf_uint(b, 2, (uint64_t)(t_ns - seconds * second_ns));
	protobuf_end(b, begun);
}

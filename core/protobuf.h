/* Protocol Buffers' wire format, writing only: fields appended to a buffer, messages within messages by begin and end.
 * Source: the encoding chapter of the Protocol Buffers documentation (varints, wire types 0, 1, 2 and 5). */
#ifndef FACET_CORE_PROTOBUF_H
#define FACET_CORE_PROTOBUF_H

#include "core/model.h"

/* Fields that are 0 may be left out by proto3; these write what they are given. */
void protobuf_varint(struct buffer *, uint64_t value);               /* bare, no tag */
void protobuf_uint(struct buffer *, unsigned field, uint64_t value); /* int32, int64, bool, enum */
void protobuf_double(struct buffer *, unsigned field, double value);
void protobuf_fixed32(struct buffer *, unsigned field, uint32_t value);
void protobuf_bytes(struct buffer *, unsigned field, const void *data, size_t len);
void protobuf_string(struct buffer *, unsigned field, const char *text);

/* A field whose length is known at its end only: a message, or packed numbers. What comes between is moved by the length
 * of the length. */
size_t protobuf_begin(struct buffer *, unsigned field); /* what protobuf_end is to be given */
void protobuf_end(struct buffer *, size_t begun);

/* The same for a length that is known: the content follows. */
void protobuf_head(struct buffer *, unsigned field, size_t len);

/* google.protobuf.Timestamp. */
void protobuf_time(struct buffer *, unsigned field, int64_t t_ns);

#endif

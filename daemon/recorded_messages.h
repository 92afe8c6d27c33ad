/* What is published, in Foxglove's schemas, for recordings that others are to open (`record.messages`): the scans, transforms and
 * pose as they are at each tick, and the map's patches as they change. Protobuf. The loop's thread. */
#ifndef FACET_DAEMON_RECORDED_MESSAGES_H
#define FACET_DAEMON_RECORDED_MESSAGES_H

#include "daemon/foxglove_schema.h"
#include "daemon/live.h"
#include "daemon/publisher.h"

#define RECORDED_MESSAGES_TICK \
	(256u << 10) /* bytes of the map in one tick; the rest of a batch comes with the next ones */

struct recorded_messages;

/* Both are borrowed. NULL when memory is out. */
struct recorded_messages *recorded_messages_create(struct publisher *, const struct live *);
void recorded_messages_destroy(struct recorded_messages *); /* before the publisher */

/* A file begins: the whole map again. */
void recorded_messages_again(struct recorded_messages *);

/* What is new since the last tick. */
void recorded_messages_tick(struct recorded_messages *, int64_t t_ns,
                            void (*put)(void *ctx, enum foxglove_schema, const struct buffer *), void *ctx);

#endif

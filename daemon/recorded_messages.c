/* See recorded_messages.h. A client of the publisher like any other: it walks batches, so it holds no map of its own, and one
 * that is too far behind is told so by a batch that begins again. One SceneUpdate of at most RECORDED_MESSAGES_TICK per tick. */
#include "daemon/recorded_messages.h"

#include <errno.h>
#include <stdlib.h>

#include "daemon/foxglove_messages.h"

struct recorded_messages {
	struct publisher *publisher;
	const struct live *live;
	struct publisher_client *walk;
	bool walking; /* in the middle of a batch */
	bool reset;   /* ... that is the whole map; what was before it is to go */
	uint64_t scan[CONFIG_DEVICES_MAX], transforms, pose; /* sequences that were told */
};

struct recorded_messages *recorded_messages_create(struct publisher *publisher, const struct live *live)
{
	struct recorded_messages *m = calloc(1, sizeof(*m));

	if (!m)
		return NULL;
	m->publisher = publisher;
	m->live = live;
	return m;
}

void recorded_messages_destroy(struct recorded_messages *m)
{
	if (m && m->walk)
		publisher_leave(m->walk);
	free(m);
}

void recorded_messages_again(struct recorded_messages *m)
{
	static const struct native_want all;

	if (m->walk)
		publisher_leave(m->walk);
	m->walk = publisher_join_walk(m->publisher, &all, PUBLISHER_SCENE_PROTOBUF);
	m->walking = false;
	m->transforms = m->pose = 0;
}

static void put_deletion(struct buffer *b, int64_t t_ns, bool all, struct patch_key key)
{
	const struct scene_deletion deletion = {.t_ns = t_ns, .all = all, .key = key};

	scene_put_deletion(b, SCENE_AS_PROTOBUF, &deletion);
}

/* As much of a batch as a tick takes, into one update. */
static void walk(struct recorded_messages *m, int64_t t_ns, struct buffer *ret)
{
	struct publisher_item item;
	struct native_begin begin;
	int r = 1;

	if (!m->walking) {
		if (publisher_walk_begin(m->walk, &begin) != 1)
			return;
		m->walking = true;
		if (begin.reset)
			put_deletion(ret, t_ns, true, (struct patch_key){0});
	}
	while (ret->len < RECORDED_MESSAGES_TICK && (r = publisher_walk_next(m->walk, &item)) == 1) {
		if (item.removed)
			put_deletion(ret, t_ns, false, item.key);
		else
			buffer_append(ret, item.bytes, item.len);
	}
	if (r == 0)
		publisher_walk_commit(m->walk);
	m->walking = r == 1;
}

static void tell_live(struct recorded_messages *m, int64_t t_ns,
                      void (*put)(void *ctx, enum foxglove_schema, const struct buffer *), void *ctx, struct buffer *b)
{
	struct live_transform transform[LIVE_TRANSFORMS_MAX];
	struct pose pose;
	uint64_t sequence;

	for (int i = 0; i < live_scanners(m->live); i++) {
		const struct live_scanner *scanner = live_scanner(m->live, i);

		if (scanner->sequence == m->scan[i] || scanner->sequence == 0)
			continue;
		m->scan[i] = scanner->sequence;
		b->len = 0;
		foxglove_put_scan(b, SCENE_AS_PROTOBUF, &scanner->profile, scanner->laser_frame);
		put(ctx, FOXGLOVE_LASER_SCAN, b);
	}
	if (live_transforms_sequence(m->live) != m->transforms) {
		m->transforms = live_transforms_sequence(m->live);
		b->len = 0;
		foxglove_put_transforms(b, SCENE_AS_PROTOBUF, transform, live_transforms(m->live, transform), t_ns);
		put(ctx, FOXGLOVE_FRAME_TRANSFORMS, b);
	}
	if (live_pose_now(m->live, &pose, &sequence) && sequence != m->pose) {
		m->pose = sequence;
		b->len = 0;
		foxglove_put_pose(b, SCENE_AS_PROTOBUF, &pose);
		put(ctx, FOXGLOVE_POSE_IN_FRAME, b);
	}
}

void recorded_messages_tick(struct recorded_messages *m, int64_t t_ns,
                            void (*put)(void *ctx, enum foxglove_schema, const struct buffer *), void *ctx)
{
	struct buffer b = {0};

	tell_live(m, t_ns, put, ctx, &b);
	b.len = 0;
	if (m->walk)
		walk(m, t_ns, &b);
	if (b.len > 0 && !b.error)
		put(ctx, FOXGLOVE_SCENE_UPDATE, &b);
	buffer_finish(&b);
}

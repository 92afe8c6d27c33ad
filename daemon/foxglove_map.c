/* The map, as SceneUpdates: a batch of the publisher is walked while it is said, a piece at a time, so no client's message exists
 * whole, however large the map. */
#include "daemon/foxglove_parts.h"

#include <assert.h>
#include <errno.h>

void foxglove_map_leave(struct foxglove_client *client)
{
	if (client->scene.walk)
		publisher_leave(client->scene.walk);
	client->scene.walk = NULL;
}

static void put_deletion(struct foxglove_client *client, bool all, struct patch_key key)
{
	struct scene *scene = &client->scene;
	const struct scene_deletion deletion = {.t_ns = scene->newest_ns + 1, .all = all, .key = key};

	if (!scene->first && client->encoding == SCENE_AS_JSON)
		put_text(&client->out, ",");
	scene->first = false;
	scene_put_deletion(&client->out, client->encoding, &deletion);
}

static void begin_scene(struct foxglove_client *client)
{
	const struct foxglove_host *host = &client->foxglove->host;
	struct scene *scene = &client->scene;
	const int64_t time_ns = host->time(host->ctx);

	scene->newest_ns = time_ns > scene->newest_ns ? time_ns : scene->newest_ns;
	scene->begun = scene->first = true;
	foxglove_begin_message(client, scene->subscription, time_ns);
	if (client->encoding == SCENE_AS_JSON)
		put_text(&client->out, SCENE_JSON_BEGIN);
	if (scene->reset)
		put_deletion(client, true, (struct patch_key){0});
}

static void put_entity(struct foxglove_client *client, const struct publisher_item *item)
{
	struct scene *scene = &client->scene;

	if (client->encoding == SCENE_AS_JSON)
		put_text(&client->out, scene->entities ? "," : SCENE_JSON_MIDDLE);
	scene->entities = true;
	scene->item = item->bytes;
	scene->item_left = item->len;
	if (item->t_last_ns > scene->newest_ns)
		scene->newest_ns = item->t_last_ns;
}

static void end_scene(struct foxglove_client *client)
{
	struct scene *scene = &client->scene;

	scene->ended = true;
	if (client->encoding == SCENE_AS_JSON) {
		if (!scene->entities)
			put_text(&client->out, SCENE_JSON_MIDDLE);
		put_text(&client->out, SCENE_JSON_END);
	}
}

/* A little more of the message: into `out`, or as an item. */
static void scene_step(struct foxglove_client *client)
{
	struct scene *scene = &client->scene;
	struct publisher_item item;
	int r;

	client->out.len = client->out_at = 0;
	if (!scene->begun) {
		begin_scene(client);
		return;
	}
	r = scene->dismissed ? -ECANCELED : publisher_walk_next(scene->walk, &item);
	if (r == 1 && item.removed) {
		assert(!scene->entities);
		put_deletion(client, false, item.key);
	} else if (r == 1) {
		put_entity(client, &item);
	} else {
		scene->whole = r == 0;
		end_scene(client);
	}
}

static bool scene_pends(const struct foxglove_client *client)
{
	return client->out_at < client->out.len || client->scene.item_left > 0;
}

static size_t scene_copy(struct foxglove_client *client, uint8_t *buf, size_t cap)
{
	struct scene *scene = &client->scene;
	const size_t left = client->out.len - client->out_at;
	size_t n;

	if (left > 0) {
		n = left < cap ? left : cap;
		memcpy(buf, client->out.data + client->out_at, n);
		client->out_at += n;
		return n;
	}
	n = scene->item_left < cap ? scene->item_left : cap;
	memcpy(buf, scene->item, n);
	scene->item += n;
	scene->item_left -= n;
	return n;
}

/* The message was said to its end. */
static void scene_said(struct foxglove_client *client, int64_t t_ns)
{
	struct scene *scene = &client->scene;
	const bool broken = client->out.error != 0;

	scene->talking = false;
	if (broken)
		buffer_finish(&client->out);
	if (scene->whole && !broken)
		publisher_walk_commit(scene->walk);
	client->messages++;
	client->stream[CHANNEL_MAP].next_ns = t_ns + (broken ? RETRY_NS : FOXGLOVE_MAP_NS);
	if (scene->dismissed)
		foxglove_map_leave(client);
	scene->dismissed = false;
}

size_t foxglove_map_next(struct foxglove_client *client, uint8_t *buf, size_t cap, int64_t t_ns, bool *ret_final)
{
	size_t n = 0;

	for (;;) {
		while (!scene_pends(client) && !client->scene.ended)
			scene_step(client);
		if (!scene_pends(client) || n == cap)
			break;
		n += scene_copy(client, buf + n, cap - n);
	}
	*ret_final = !scene_pends(client);
	if (*ret_final)
		scene_said(client, t_ns);
	return n;
}

/* True: a message is begun. */
bool foxglove_map_begin(struct foxglove_client *client)
{
	struct scene *scene = &client->scene;
	struct native_want want = {0};
	struct native_begin begin;

	if (!scene->walk)
		scene->walk = publisher_join_walk(client->foxglove->publisher, &want,
		                                  client->encoding == SCENE_AS_JSON ? PUBLISHER_SCENE_JSON
		                                                                    : PUBLISHER_SCENE_PROTOBUF);
	scene->quiet = !scene->walk || publisher_walk_begin(scene->walk, &begin) != 1;
	if (scene->quiet)
		return false;
	scene->talking = true;
	scene->reset = begin.reset;
	scene->begun = scene->ended = scene->whole = scene->entities = false;
	scene->subscription = client->stream[CHANNEL_MAP].subscription;
	scene->item_left = 0;
	return true;
}

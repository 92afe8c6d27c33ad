/* Clients and their walks.
 *
 * A client is what it last committed: a place in the order of changes, a step and a region (law L6). What it misses
 * follows from these and the store (sheets.h), and is walked as a batch (batch.h). What the map was when batches began is
 * kept for all of them in common; when that is too much, the batch that began first is given up: the next one begins at
 * the newest step. So a slow client skips what lies between and costs no memory.
 *
 *      idle ── walk_begin ──► walking ── walk_commit ──► idle
 *                                │
 *                                └─ too much kept,   map begun anew, dismissed ──► cancelled ── told once ──► idle
 *
 * Walking clients stand in the order in which they began. A change asks them from the last one on, until one needs what is
 * about to change, which is then kept for all, or has begun before the entry's last change, as all before it have. The
 * first one who stalls needs nearly everything, so however many there are, one is asked. Who ends a batch hands on what it
 * held to the next one who needs it. */
#include "daemon/publisher_client.h"

#include <assert.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/coded.h"

/* Clients */

static uint64_t behind(const struct publisher_client *client)
{
	uint64_t step = client->publisher->step;

	return step > client->committed_step ? step - client->committed_step : 0;
}

/* It only grows between two commits, so it need not be looked at with every step. */
static void note_behind(struct publisher_client *client)
{
	if (client->stats.behind_peak < behind(client))
		client->stats.behind_peak = behind(client);
}

static size_t client_bytes(const struct publisher_client *client)
{
	return sizeof(*client) + (client->stream ? sizeof(*client->stream) : 0) + batch_bytes(&client->batch);
}

static void note_bytes(struct publisher_client *client)
{
	size_t bytes = client_bytes(client);

	if (client->publisher->clients_peak_bytes < bytes)
		client->publisher->clients_peak_bytes = bytes;
}

/* The next one, from `client` on to those that began earlier, who needs what the entry was from `sequence` on. */
static struct publisher_client *who_needs(struct publisher_client *client, const struct entry *entry, uint64_t sequence)
{
	for (; client && client->batch.end >= sequence; client = client->earlier) {
		client->publisher->sheets.stats.asked++;
		if (batch_needs(&client->batch, entry))
			return client;
	}
	return NULL;
}

static void hand_on(struct publisher_client *client)
{
	struct past *past;

	while ((past = client->batch.past) != NULL) {
		struct publisher_client *to = who_needs(client->earlier, past->entry, past->sequence);

		client->batch.past = past->next;
		if (to) {
			past->next = to->batch.past;
			to->batch.past = past;
		} else {
			sheets_let_go(&client->publisher->sheets, past);
		}
	}
}

/* Ends a walk; what was handed out last stays with the client. */
static void stop_walking(struct publisher_client *client)
{
	struct publisher *p = client->publisher;

	if (client->state != CLIENT_WALKING)
		return;
	hand_on(client);
	*(client->later ? &client->later->earlier : &p->latest) = client->earlier;
	*(client->earlier ? &client->earlier->later : &p->oldest) = client->later;
	client->earlier = client->later = NULL;
	note_bytes(client);
	batch_finish(&client->batch);
	client->state = CLIENT_IDLE;
}

static void cancel(struct publisher_client *client)
{
	if (client->state != CLIENT_WALKING)
		return;
	stop_walking(client);
	client->state = CLIENT_CANCELLED;
}

/* It is for the client to be slow, not for the server to remember: the next batch begins at the newest step. */
static void cancel_slow(struct publisher_client *client)
{
	cancel(client);
	client->stats.aborts++;
	if (++client->aborts_running == PUBLISHER_ABORTS_MAX)
		publisher_dismiss(client, "too slow: three batches running had to be aborted; read faster or "
		                          "connect again");
}

void publisher_client_let_go(struct publisher_client *client)
{
	form_unref(client->sent_form);
	sheet_unref(&client->publisher->sheets, client->sent);
	client->sent_form = NULL;
	client->sent = NULL;
}

void publisher_dismiss(struct publisher_client *client, const char *reason)
{
	if (client->dismissed)
		return;
	client->dismissed = true;
	snprintf(client->reason, sizeof(client->reason), "%s", reason);
	cancel(client);
}

/* Publishing */

static void before_change(struct publisher *p, struct entry *entry)
{
	struct publisher_client *client = who_needs(p->latest, entry, entry->sequence);

	if (client && sheets_keep(&p->sheets, entry, &client->batch.past) < 0)
		for (; client; client = who_needs(p->latest, entry, entry->sequence))
			cancel(client);
}

static int publish_patch(struct publisher *p, const struct patch *patch, uint32_t faces_raw)
{
	struct entry *entry = sheets_touch(&p->sheets, patch->key);
	struct sheet *sheet = NULL;

	if (!entry)
		return -ENOMEM;
	if (patch->nt > 0) {
		sheet = sheet_create(&p->sheets, patch, faces_raw);
		if (!sheet)
			return -ENOMEM;
	}
	if (entry->sequence > 0)
		before_change(p, entry);
	sheets_change(&p->sheets, entry, sheet);
	return 0;
}

/* Aborts the batches that began first until what lives for batches alone is within its limit. What snapshots hold is limited
 * by their number; what is left when nothing is kept are frames half written, one a client. */
static void limit_pins(struct publisher *p)
{
	size_t max = p->params.pinned_max + p->snapshot_bytes;

	while (p->sheets.stats.pinned > max && p->sheets.pasts > 0)
		cancel_slow(p->oldest);
}

int publisher_publish(struct publisher *p, uint64_t step, struct patch *const *patches, const uint32_t *faces_raw,
                      size_t n)
{
	int r = 0;

	assert(step >= p->step);
	for (size_t i = 0; i < n && r == 0; i++)
		r = publish_patch(p, patches[i], faces_raw ? faces_raw[i] : 0);
	p->step = step;
	limit_pins(p);
	return r;
}

void publisher_abort_batches(struct publisher *p)
{
	while (p->latest)
		cancel(p->latest);
}

void publisher_reset(struct publisher *p)
{
	publisher_abort_batches(p);
	for (struct publisher_client *client = p->clients; client; client = client->next) {
		note_behind(client);
		client->whole = true;
		client->committed_step = 0;
		client->aborts_running = 0;
	}
	sheets_clear(&p->sheets);
	p->generation++;
	p->step = 0;
}

/* Regions */

/* A radius goes with the robot. */
static struct interest wanted_now(const struct publisher_client *client)
{
	struct interest wanted = client->wanted;

	if (wanted.kind == INTEREST_RADIUS)
		wanted.low = client->publisher->robot;
	return wanted;
}

bool publisher_robot(struct publisher *p, double x_m, double y_m, double z_m)
{
	if (!interest_follow(&p->robot, p->params.cell_m, x_m, y_m, z_m))
		return false;
	for (const struct publisher_client *client = p->clients; client; client = client->next)
		if (client->wanted.kind == INTEREST_RADIUS)
			return true;
	return false;
}

bool publisher_client_has_news(const struct publisher_client *client)
{
	const struct publisher *p = client->publisher;
	struct interest wanted = wanted_now(client);

	return client->whole || client->committed != p->sheets.sequence || client->committed_step != p->step ||
	       !interest_equal(&client->held, &wanted);
}

void publisher_want(struct publisher_client *client, const struct native_want *want)
{
	const struct publisher *p = client->publisher;

	if (client->stream)
		native_stream_want(client, want);
	if (interest_of(want, p->params.cell_m, p->robot, &client->wanted) < 0)
		publisher_dismiss(client, "a WANT with a region that is none: a box is min x y z, max x y z, a radius "
		                          "at least 0, and only one of them");
}

/* Walks */

int publisher_walk_begin(struct publisher_client *client, struct native_begin *ret)
{
	struct publisher *p = client->publisher;
	struct native_begin begin = {.step = p->step, .reset = client->whole};
	struct batch *batch = &client->batch;
	int r;

	publisher_client_let_go(client);
	stop_walking(client);
	client->state = CLIENT_IDLE;
	if (client->dismissed || !publisher_client_has_news(client))
		return 0;
	*batch = (struct batch){.whole = client->whole,
	                        .begin = client->whole ? 0 : client->committed,
	                        .step = p->step,
	                        .from = client->held,
	                        .to = wanted_now(client),
	                        .origin = p->robot};
	r = batch_begin(batch, &p->sheets, &p->scratch, &begin.patches, &begin.removals);
	if (r < 0) {
		batch_finish(batch);
		return r;
	}
	client->state = CLIENT_WALKING;
	client->batch_step = p->step;
	client->later = NULL;
	client->earlier = p->latest;
	*(p->latest ? &p->latest->later : &p->oldest) = client;
	p->latest = client;
	*ret = begin;
	return 1;
}

/* The bytes of the item that was handed out last. */
static int give_bytes(struct publisher_client *client, struct publisher_item *item)
{
	struct sheets *sheets = &client->publisher->sheets;

	item->version = client->sent->version;
	item->t_last_ns = client->sent->t_last_ns;
	item->bytes = client->sent->bytes;
	item->len = client->sent->len;
	if (client->form == PUBLISHER_NATIVE)
		return 0;
	client->sent_form = sheets_form(sheets, client->sent, client->form);
	if (!client->sent_form)
		return -ENOMEM;
	item->bytes = client->sent_form->bytes;
	item->len = client->sent_form->len;
	return 0;
}

int publisher_walk_next(struct publisher_client *client, struct publisher_item *ret)
{
	struct publisher *p = client->publisher;
	struct publisher_item item = {0};
	struct entry *entry;
	int r;

	assert(client->state != CLIENT_IDLE);
	publisher_client_let_go(client);
	if (client->state == CLIENT_CANCELLED) {
		client->state = CLIENT_IDLE;
		return -ECANCELED;
	}
	r = batch_next(&client->batch, &p->sheets, &p->scratch, &entry, &client->sent);
	if (r == 0)
		return 0;
	if (r > 0) {
		item.key = entry->key;
		item.removed = !client->sent;
		if (client->sent && give_bytes(client, &item) < 0)
			r = -ENOMEM;
	}
	if (r < 0) {
		stop_walking(client);
		return r;
	}
	*ret = item;
	return 1;
}

int publisher_walk_commit(struct publisher_client *client)
{
	struct batch *batch = &client->batch;

	assert(client->state != CLIENT_IDLE);
	publisher_client_let_go(client);
	if (client->state == CLIENT_CANCELLED) {
		client->state = CLIENT_IDLE;
		return -ECANCELED;
	}
	assert(batch->left == 0);
	note_behind(client);
	client->committed = batch->end;
	client->committed_step = batch->step;
	client->held = batch->to;
	client->whole = false;
	client->aborts_running = 0;
	client->stats.batches++;
	stop_walking(client);
	return 0;
}

/* Coming and going */

static struct publisher_client *join(struct publisher *p, struct native_stream *stream, const struct native_want *want,
                                     enum publisher_form form)
{
	struct publisher_client *client = calloc(1, sizeof(*client));

	if (!client)
		return NULL;
	client->publisher = p;
	client->stream = stream;
	client->form = form;
	client->whole = true;
	client->next = p->clients;
	p->clients = client;
	p->clients_n++;
	publisher_want(client, want);
	return client;
}

struct publisher_client *publisher_join(struct publisher *p, const struct native_want *want)
{
	struct native_stream *stream = native_stream_create();
	struct publisher_client *client = stream ? join(p, stream, want, PUBLISHER_NATIVE) : NULL;

	if (!client)
		native_stream_destroy(stream);
	return client;
}

struct publisher_client *publisher_join_walk(struct publisher *p, const struct native_want *want,
                                             enum publisher_form form)
{
	assert(form <= PUBLISHER_PACKED || p->params.encoder[form].encode);
	return join(p, NULL, want, form);
}

void publisher_leave(struct publisher_client *client)
{
	struct publisher *p = client->publisher;
	struct publisher_client **at = &p->clients;

	while (*at != client)
		at = &(*at)->next;
	*at = client->next;
	p->clients_n--;
	stop_walking(client);
	note_bytes(client);
	publisher_client_let_go(client);
	native_stream_destroy(client->stream);
	free(client);
}

void publisher_client_stats(const struct publisher_client *client, struct publisher_client_stats *ret)
{
	const struct native_stream *stream = client->stream;

	*ret = client->stats;
	ret->step = client->committed_step;
	ret->behind_steps = behind(client);
	if (ret->behind_peak < ret->behind_steps)
		ret->behind_peak = ret->behind_steps;
	ret->bytes = client_bytes(client);
	if (stream) {
		ret->queued += native_stream_queued(stream);
		ret->bytes += stream->json.cap + stream->small.cap;
	}
}

static void encode_coded(void *ctx, struct buffer *ret, const struct patch *patch)
{
	(void)ctx;
	coded_put_patch(ret, patch);
}

struct publisher *publisher_create(const struct publisher_params *params)
{
	struct publisher *p = calloc(1, sizeof(*p));

	if (!p)
		return NULL;
	p->params = *params;
	if (p->params.pinned_max == 0)
		p->params.pinned_max = PUBLISHER_PINNED_MAX;
	p->sheets.forms_max = params->forms_bytes ? params->forms_bytes : PUBLISHER_FORMS_BYTES;
	memcpy(p->sheets.encoder, params->encoder, sizeof(params->encoder));
	p->sheets.encoder[PUBLISHER_CODED].encode = encode_coded;
	p->scratch.window = params->window ? params->window : BATCH_WINDOW;
	p->generation = 1;
	return p;
}

void publisher_destroy(struct publisher *p)
{
	if (!p)
		return;
	assert(!p->clients && p->snapshots == 0);
	sheets_finish(&p->sheets);
	free(p);
}

void publisher_stats(const struct publisher *p, struct publisher_stats *ret)
{
	*ret = p->sheets.stats;
	ret->step = p->step;
	ret->generation = p->generation;
	ret->clients = p->clients_n;
	ret->clients_peak_bytes = p->clients_peak_bytes;
	for (const struct publisher_client *client = p->clients; client; client = client->next)
		if (ret->clients_peak_bytes < client_bytes(client))
			ret->clients_peak_bytes = client_bytes(client);
}

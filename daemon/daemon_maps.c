/* The maps of a run: which one the publisher has, which one is being recorded, and how one ends.
 *
 * Two ids are kept, since the two ends of the worker's queue may be in different maps: `list_map_id` is that of the records
 * being handled, `map_id` that of the patches being published. They differ from a jump of the pose on until the worker has
 * come to it. */
#include "daemon/daemon_parts.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>
#include <sys/random.h>

#include "daemon/log.h"

#define JUMP_LOG_NS 1000000000

void daemon_make_map_id(struct daemon *d, uint8_t ret[16])
{
	const int64_t t_ns = daemon_now(d);

	memset(ret, 0, 16);
	if (getrandom(ret, 16, GRND_NONBLOCK) < 0)
		memcpy(ret, &t_ns, sizeof(t_ns)); /* early at boot: the time will do */
}

/* What is kept and recorded from here on gives the map that begins here. */
void daemon_begin_list(struct daemon *d)
{
	d->list_generation++;
	recorders_map(d->recorders);
	if (!d->keep.begin || journal_begin(&d->keep, d->pipeline) == 0)
		return;
	log_line(LOG_ERR, "out of memory: the journal ends here");
	memset(&d->keep, 0, sizeof(d->keep));
}

/* One line a second at most: a localisation that cannot decide jumps with every pose. */
static void log_jump(struct daemon *d, int device, const struct pose_jump *jump)
{
	static const char *const what[] = {[POSE_TRACK_KEEP] = "the map goes on",
	                                   [POSE_TRACK_IGNORE] = "ignored: the old correction is held",
	                                   [POSE_TRACK_NEW_MAP] = "a new map begins"};
	const int64_t t_ns = daemon_now(d);
	char more[60] = "";

	if (d->jump_told_ns && t_ns - d->jump_told_ns < JUMP_LOG_NS) {
		d->jumps_untold++;
		return;
	}
	if (d->jumps_untold)
		snprintf(more, sizeof(more), " (and %llu jumps before it)", (unsigned long long)d->jumps_untold);
	log_line(LOG_WARNING, "%s: the pose jumped%s by %.2f m, %.1f degrees: %s%s", d->config->device[device].name,
	         jump->back ? " back" : "", jump->distance_m, jump->angle_rad * 57.29577951308232, what[jump->done],
	         more);
	d->jump_told_ns = t_ns;
	d->jumps_untold = 0;
}

void daemon_jump(void *ctx, int device, const struct pose_jump *jump)
{
	struct daemon *d = ctx;
	struct buffer message = {0};

	log_jump(d, device, jump);
	control_put_jump_event(&message, d->config->device[device].name, jump);
	daemon_tell(d, &message);
	if (jump->done != POSE_TRACK_NEW_MAP)
		return;
	pipeline_reset(d->pipeline);
	if (d->replay) { /* what was saved live is not saved again */
		worker_reset(d->worker);
		replay_began(d->replay);
		return;
	}
	worker_end(d->worker);
	daemon_make_map_id(d, d->list_map_id);
	d->list_ahead = true;
	daemon_begin_list(d);
}

void daemon_archived(void *ctx, const struct archive_result *result)
{
	struct daemon *d = ctx;
	struct buffer message = {0};

	if (result->file)
		log_line(LOG_INFO, "the map that ended was saved as %s, %u triangles", result->file, result->triangles);
	else
		log_line(LOG_ERR, "the map that ended was not saved: %s", result->error);
	control_put_saved_event(&message, result->map, result->file, result->error);
	daemon_tell(d, &message);
}

void daemon_saved(void *ctx, const char *path, const char *error)
{
	struct daemon *d = ctx;
	struct buffer message = {0};
	char map[33];

	for (int i = 0; i < 16; i++)
		snprintf(map + 2 * i, 3, "%02x", d->map_id[i]);
	log_line(path ? LOG_INFO : LOG_ERR, "%s %s",
	         path ? "the map was saved as" : "the map was not saved:", path ? path : error);
	control_put_saved_event(&message, map, path, path ? NULL : error);
	daemon_tell(d, &message);
}

/* Everything of the old map is with the publisher. */
static void end_map(struct daemon *d)
{
	struct archive_result result = {0};
	struct publisher_stats stats;
	struct publisher_old *old;
	struct buffer message = {0};
	char map[33], error[200] = "out of memory";
	uint8_t before[16];

	memcpy(before, d->map_id, sizeof(before));
	for (int i = 0; i < 16; i++)
		snprintf(map + 2 * i, 3, "%02x", before[i]);
	if (!d->list_ahead)
		daemon_make_map_id(d, d->list_map_id);
	d->list_ahead = false;
	memcpy(d->map_id, d->list_map_id, sizeof(d->map_id));
	old = publisher_begin_map(d->publisher, d->map_id);
	publisher_stats(d->publisher, &stats);
	control_put_map_event(&message, d->map_id, stats.generation, before);
	daemon_tell(d, &message);
	if (old && publisher_old_count(old) == 0) {
		publisher_old_destroy(old);
		snprintf(error, sizeof(error), "nothing was in it");
	} else if (old && archive_save(d->archive, before, old, error)) {
		return;
	}
	result.map = map;
	result.error = error;
	daemon_archived(d, &result);
}

static int publish(struct daemon *d, const struct worker_result *result)
{
	if (result->ended)
		end_map(d);
	else if (result->reset)
		publisher_reset(d->publisher);
	d->batches++;
	d->grid = result->grid;
	d->field = result->field;
	return publisher_publish(d->publisher, result->step, result->patch, result->faces_raw, result->patches);
}

void daemon_results(uv_async_t *async)
{
	struct daemon *d = async->data;
	struct worker_status status;
	struct worker_result *result;
	int r = 0;

	worker_status(d->worker, &status);
	while (r == 0 && (result = worker_take(d->worker)) != NULL) {
		r = publish(d, result);
		server_wake(d->server);
		web_wake(d->web);
		daemon_note_latencies(d, result);
		worker_result_destroy(result);
	}
	if (d->player && r == 0)
		daemon_play(d); /* there may be room again */
	if (r < 0 || status.failed)
		daemon_fail(d, -ENOMEM, "out of memory; give the machine more, or set a smaller map.memory");
}

/* From pins to a file.
 *
 *   loop: publisher_pin ─► pool's thread: decode, weld, write into a buffer (and to disk) ─► loop: release, tell
 *
 * The map goes on meanwhile; what it replaces stays as long as it is pinned. A snapshot is named by map, generation, step
 * and format, and lives as long as somebody holds it: ten browsers that ask at once are served from one. Nothing is kept
 * for later: a cache would be a second map in memory, and a browser that asks again shows the name of what it has.
 *
 * A name from outside is a name and nothing else: no folder, no dot at its front, one of our endings; it replaces no
 * file. So whoever may save can fill the configured folder at most, and only with meshes. */
#include "daemon/snapshot.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "config/config.h"
#include "core/native.h"
#include "daemon/archive.h"

static const char *const endings[SNAPSHOT_FORMATS] = {"ply", "glb", "obj", "stl"};

struct snapshot {
	struct snapshots *owner;
	struct snapshot *next;
	uv_work_t work;
	int references;
	enum snapshot_format format;
	struct publisher_snapshot *pinned; /* while it is being made */
	bool made;
	int error;
	struct buffer bytes;
	char etag[SNAPSHOT_ETAG_MAX];
	char path[CONFIG_TEXT_MAX + SNAPSHOT_NAME_MAX]; /* of ?SAVE */
	char sentence[SNAPSHOT_ERROR_MAX];
};

struct snapshots {
	uv_loop_t *loop;
	struct publisher *publisher;
	char folder[CONFIG_TEXT_MAX];
	snapshot_saved saved;
	void *ctx;
	void (*watch)(void *ctx);
	void *watch_ctx;
	struct snapshot *list;
	uint64_t born; /* tells the daemon's runs apart */
	bool stopped, saving;
};

const char *snapshot_ending(enum snapshot_format format)
{
	return endings[format];
}

struct snapshots *snapshots_create(uv_loop_t *loop, struct publisher *publisher, const char *folder,
                                   snapshot_saved saved, void *ctx)
{
	struct snapshots *s = calloc(1, sizeof(*s));

	if (!s)
		return NULL;
	*s = (struct snapshots){.loop = loop, .publisher = publisher, .saved = saved, .ctx = ctx, .born = uv_hrtime()};
	snprintf(s->folder, sizeof(s->folder), "%s", *folder ? folder : ".");
	return s;
}

void snapshots_stop(struct snapshots *s)
{
	if (s)
		s->stopped = true;
}

void snapshots_destroy(struct snapshots *s)
{
	free(s);
}

void snapshots_watch(struct snapshots *s, void (*made)(void *ctx), void *ctx)
{
	s->watch = made;
	s->watch_ctx = ctx;
}

/* The thread */

/* NULL when memory is out. */
static struct patch_store *decode(const struct publisher_snapshot *pinned)
{
	struct patch_store *store = patch_store_create();
	char error[128];

	for (size_t i = 0; store && i < pinned->patches; i++) {
		struct native_message message;
		size_t len;
		const uint8_t *frame = publisher_snapshot_frame(pinned, i, &len);

		if (native_decode(frame, len, &message, error) == 0 && patch_store_put(store, message.patch) == 0)
			continue;
		patch_store_destroy(store);
		return NULL;
	}
	return store;
}

static int make(struct snapshot *snapshot)
{
	struct patch_store *store = decode(snapshot->pinned);
	struct model model;
	int r = store ? model_weld(store, snapshot->pinned->cell_m, &model) : -ENOMEM;

	patch_store_destroy(store);
	if (r < 0)
		return r;
	switch (snapshot->format) {
	case SNAPSHOT_GLB:
		gltf_write(&model, &snapshot->bytes);
		break;
	case SNAPSHOT_OBJ:
		obj_write(&model, &snapshot->bytes);
		break;
	case SNAPSHOT_STL:
		stl_write(&model, &snapshot->bytes);
		break;
	default:
		ply_write(&model, false, &snapshot->bytes);
	}
	model_finish(&model);
	return snapshot->bytes.error;
}

static void on_work(uv_work_t *work)
{
	struct snapshot *snapshot = work->data;

	snapshot->error = make(snapshot);
	if (!snapshot->path[0])
		return;
	if (snapshot->error == 0 && access(snapshot->path, F_OK) == 0)
		snapshot->error = -EEXIST;
	if (snapshot->error == 0)
		snapshot->error = archive_write_file(snapshot->path, &snapshot->bytes);
	if (snapshot->error == -EEXIST)
		snprintf(snapshot->sentence, sizeof(snapshot->sentence), "%s is there already; choose another name",
		         snapshot->path);
	else if (snapshot->error < 0)
		snprintf(snapshot->sentence, sizeof(snapshot->sentence),
		         "%s cannot be written (%s); see to the folder map.archive", snapshot->path,
		         strerror(-snapshot->error));
}

/* The loop */

void snapshot_drop(struct snapshot *snapshot)
{
	struct snapshot **at;

	if (!snapshot || --snapshot->references > 0)
		return;
	for (at = &snapshot->owner->list; *at != snapshot; at = &(*at)->next)
		;
	*at = snapshot->next;
	buffer_finish(&snapshot->bytes);
	free(snapshot);
}

static void on_worked(uv_work_t *work, int status)
{
	struct snapshot *snapshot = work->data;
	struct snapshots *s = snapshot->owner;

	if (status < 0)
		snapshot->error = status; /* never began */
	publisher_release(s->publisher, snapshot->pinned);
	snapshot->pinned = NULL;
	snapshot->made = true;
	if (snapshot->path[0]) {
		s->saving = false;
		if (!s->stopped)
			s->saved(s->ctx, snapshot->error ? NULL : snapshot->path, snapshot->sentence);
	} else if (!s->stopped && s->watch) {
		s->watch(s->watch_ctx);
	}
	snapshot_drop(snapshot);
}

void snapshots_etag(const struct snapshots *s, enum snapshot_format format, char ret[SNAPSHOT_ETAG_MAX])
{
	struct publisher_stats stats;

	publisher_stats(s->publisher, &stats);
	/* Two sets may have one step; but every new patch is encoded, and every removed one missing. */
	snprintf(ret, SNAPSHOT_ETAG_MAX, "\"%s-%llx-%u-%llu-%llu-%zu\"", endings[format], (unsigned long long)s->born,
	         stats.generation, (unsigned long long)stats.step, (unsigned long long)stats.encodes[PUBLISHER_NATIVE],
	         stats.patches);
}

/* Begins to make one; the thread holds a reference of its own. */
static struct snapshot *begin(struct snapshots *s, enum snapshot_format format, const char *path,
                              char error[SNAPSHOT_ERROR_MAX])
{
	struct snapshot *snapshot = calloc(1, sizeof(*snapshot));
	struct publisher_stats stats;

	publisher_stats(s->publisher, &stats);
	if (stats.faces > SNAPSHOT_FACES_MAX)
		snprintf(error, SNAPSHOT_ERROR_MAX,
		         "the map has %llu triangles, and a snapshot at most %u; use `facet save`",
		         (unsigned long long)stats.faces, SNAPSHOT_FACES_MAX);
	else
		snprintf(error, SNAPSHOT_ERROR_MAX, "too many snapshots at once, or out of memory; try again");
	if (!snapshot || stats.faces > SNAPSHOT_FACES_MAX || !(snapshot->pinned = publisher_pin(s->publisher))) {
		free(snapshot);
		return NULL;
	}
	snapshot->owner = s;
	snapshot->format = format;
	snapshot->references = 1;
	snapshots_etag(s, format, snapshot->etag);
	snprintf(snapshot->path, sizeof(snapshot->path), "%s", path);
	snapshot->next = s->list;
	s->list = snapshot;
	snapshot->work.data = snapshot;
	uv_queue_work(s->loop, &snapshot->work, on_work, on_worked);
	return snapshot;
}

struct snapshot *snapshot_take(struct snapshots *s, enum snapshot_format format, char error[SNAPSHOT_ERROR_MAX])
{
	struct snapshot *snapshot;
	char etag[SNAPSHOT_ETAG_MAX];
	int n = 0;

	snapshots_etag(s, format, etag);
	for (snapshot = s->list; snapshot; snapshot = snapshot->next) {
		n += !snapshot->path[0];
		if (!snapshot->path[0] && strcmp(snapshot->etag, etag) == 0) {
			snapshot->references++;
			return snapshot;
		}
	}
	if (n >= SNAPSHOTS_MAX) {
		snprintf(error, SNAPSHOT_ERROR_MAX, "%d snapshots are being sent already; try again", SNAPSHOTS_MAX);
		return NULL;
	}
	snapshot = begin(s, format, "", error);
	if (snapshot)
		snapshot->references++;
	return snapshot;
}

int snapshot_bytes(const struct snapshot *snapshot, const uint8_t **ret, size_t *ret_len)
{
	if (!snapshot->made)
		return 0;
	if (snapshot->error < 0)
		return snapshot->error;
	*ret = snapshot->bytes.data;
	*ret_len = snapshot->bytes.len;
	return 1;
}

/* -1: it is not a name that may be written. */
static int judge_name(const char *name)
{
	const size_t len = strlen(name),
	             plain = strspn(name, "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789._-");

	if (len < 5 || len >= SNAPSHOT_NAME_MAX || plain != len || name[0] == '.' || name[0] == '-' ||
	    name[len - 4] != '.')
		return -1;
	for (int i = 0; i < SNAPSHOT_FORMATS; i++)
		if (strcmp(name + len - 3, endings[i]) == 0)
			return i;
	return -1;
}

bool snapshot_save(struct snapshots *s, const char *name, char error[SNAPSHOT_ERROR_MAX])
{
	char path[CONFIG_TEXT_MAX + SNAPSHOT_NAME_MAX];
	const int format = judge_name(name);

	if (format < 0)
		snprintf(error, SNAPSHOT_ERROR_MAX,
		         "`file` is a name of letters, digits, . _ and - that ends in .ply .glb .obj or .stl; it "
		         "goes into map.archive");
	else if (s->saving)
		snprintf(error, SNAPSHOT_ERROR_MAX, "another file is being written; wait for its SAVED");
	if (format < 0 || s->saving)
		return false;
	snprintf(path, sizeof(path), "%s/%s", s->folder, name);
	s->saving = begin(s, (enum snapshot_format)format, path, error) != NULL;
	return s->saving;
}

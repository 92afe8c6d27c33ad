/* What clients had of a map is kept by the publisher as encoded patches; when the map ends they are handed over, without a
 * copy, to a thread of libuv's pool, which decodes and welds them and writes ID.ply. The loop and the worker go on with
 * the next map meanwhile. A folder that is missing or a disk that is full costs the file, never more. */
#include "daemon/archive.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "core/native.h"

struct archive {
	uv_loop_t *loop;
	char folder[CONFIG_TEXT_MAX];
	double cell_m;
	archive_done done;
	void *ctx;
	int working;
	bool stopped;
};

struct job {
	uv_work_t work;
	struct archive *archive;
	struct publisher_old *old;
	char map[33];
	char path[CONFIG_TEXT_MAX + 64];
	char error[CONFIG_TEXT_MAX + 200];
	uint32_t triangles;
};

struct archive *archive_create(uv_loop_t *loop, const char *folder, double cell_m, archive_done done, void *ctx)
{
	struct archive *archive = calloc(1, sizeof(*archive));

	if (!archive)
		return NULL;
	*archive = (struct archive){.loop = loop, .cell_m = cell_m, .done = done, .ctx = ctx};
	snprintf(archive->folder, sizeof(archive->folder), "%s", *folder ? folder : ".");
	return archive;
}

void archive_stop(struct archive *archive)
{
	if (archive)
		archive->stopped = true;
}

void archive_destroy(struct archive *archive)
{
	free(archive);
}

/* The thread */

static int write_all(int fd, const uint8_t *data, size_t len)
{
	while (len > 0) {
		const ssize_t n = write(fd, data, len);

		if (n < 0 && errno != EINTR)
			return -errno;
		data += n > 0 ? n : 0;
		len -= n > 0 ? (size_t)n : 0;
	}
	return 0;
}

/* The name after the rename outlives a power loss only if the bytes were on the disk before it. */
int archive_write_file(const char *path, const struct buffer *bytes)
{
	char beside[CONFIG_TEXT_MAX + 160];
	int fd, r;

	snprintf(beside, sizeof(beside), "%s.part", path);
	fd = open(beside, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0666);
	if (fd < 0)
		return -errno;
	r = write_all(fd, bytes->data, bytes->len);
	if (r == 0 && fsync(fd) < 0)
		r = -errno;
	if (close(fd) < 0 && r == 0)
		r = -errno;
	if (r == 0 && rename(beside, path) < 0)
		r = -errno;
	if (r < 0)
		unlink(beside);
	return r;
}

/* NULL when memory is out. */
static struct patch_store *decode(const struct publisher_old *old)
{
	struct patch_store *store = patch_store_create();
	char error[128];

	for (size_t i = 0; store && i < publisher_old_count(old); i++) {
		struct native_message message;
		size_t len;
		const uint8_t *frame = publisher_old_frame(old, i, &len);

		if (native_decode(frame, len, &message, error) == 0 && patch_store_put(store, message.patch) == 0)
			continue;
		patch_store_destroy(store);
		return NULL;
	}
	return store;
}

/* 0 or -errno. */
static int save(struct job *job)
{
	struct patch_store *store = decode(job->old);
	struct buffer bytes = {0};
	struct model model;
	int r = store ? model_weld(store, job->archive->cell_m, &model) : -ENOMEM;

	patch_store_destroy(store);
	if (r < 0)
		return r;
	job->triangles = model.nt;
	ply_write(&model, false, &bytes);
	model_finish(&model);
	r = bytes.error ? bytes.error : archive_write_file(job->path, &bytes);
	buffer_finish(&bytes);
	return r;
}

/* Files named as this one is: 32 hex digits and .ply. A folder that cannot be read has none, and writing says why. */
static int maps_in(const char *folder)
{
	DIR *dir = opendir(folder);
	int n = 0;

	for (const struct dirent *entry; dir && (entry = readdir(dir)) != NULL;)
		n += strspn(entry->d_name, "0123456789abcdef") == 32 && strcmp(entry->d_name + 32, ".ply") == 0;
	if (dir)
		closedir(dir);
	return n;
}

static void on_work(uv_work_t *work)
{
	struct job *job = work->data;
	const bool full = maps_in(job->archive->folder) >= ARCHIVE_FILES_MAX;
	const int r = full ? 0 : save(job);

	publisher_old_destroy(job->old);
	if (full)
		snprintf(job->error, sizeof(job->error), "%s holds %d maps already, and gets no more; move them away",
		         job->archive->folder, ARCHIVE_FILES_MAX);
	if (r < 0)
		snprintf(job->error, sizeof(job->error), "%s cannot be written (%s); see to the folder map.archive",
		         job->path, strerror(-r));
}

static void on_worked(uv_work_t *work, int status)
{
	struct job *job = work->data;
	struct archive *archive = job->archive;
	const struct archive_result result = {.map = job->map,
	                                      .file = job->error[0] ? NULL : job->path,
	                                      .error = job->error[0] ? job->error : NULL,
	                                      .triangles = job->triangles};

	(void)status;
	archive->working--;
	if (!archive->stopped)
		archive->done(archive->ctx, &result);
	free(job);
}

/* The loop */

bool archive_save(struct archive *archive, const uint8_t map_id[16], struct publisher_old *old, char error[200])
{
	struct job *job = NULL;

	if (archive->working == ARCHIVE_MAX)
		snprintf(error, 200, "%d older maps are being written: the disk is too slow for so many jumps",
		         ARCHIVE_MAX);
	else if (!(job = calloc(1, sizeof(*job))))
		snprintf(error, 200, "out of memory");
	if (!job) {
		publisher_old_destroy(old);
		return false;
	}
	job->work.data = job;
	job->archive = archive;
	job->old = old;
	for (int i = 0; i < 16; i++)
		snprintf(job->map + 2 * i, 3, "%02x", map_id[i]);
	snprintf(job->path, sizeof(job->path), "%s/%s.ply", archive->folder, job->map);
	archive->working++;
	uv_queue_work(archive->loop, &job->work, on_work, on_worked);
	return true;
}

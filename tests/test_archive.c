/* Laws L8, L9: a map that ended is in its file whole or not at all; a folder that is missing, a disk that is full or too many at
 * once cost the file and a sentence, never the loop. */
#include <dirent.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cmocka.h>

#include "daemon/archive.h"

static struct {
	int done, saved;
	char file[300], error[600], map[33];
	uint32_t triangles;
} seen;

static void on_done(void *ctx, const struct archive_result *result)
{
	assert_ptr_equal(ctx, &seen);
	assert_true(!result->file != !result->error);
	seen.done++;
	seen.saved += result->file != NULL;
	snprintf(seen.map, sizeof(seen.map), "%s", result->map);
	snprintf(seen.file, sizeof(seen.file), "%s", result->file ? result->file : "");
	snprintf(seen.error, sizeof(seen.error), "%s", result->error ? result->error : "");
	seen.triangles = result->triangles;
}

/* A map of `n` patches with a triangle each. */
static struct publisher_old *make_old(int n)
{
	static uint16_t vertex[3][3] = {{0, 0, 0}, {256, 0, 0}, {0, 256, 0}};
	static uint32_t triangle[1][3] = {{0, 1, 2}};
	const struct surface surface = {.nv = 3, .nt = 1, .vertex = vertex, .triangle = triangle};
	const struct publisher_params params = {.cell_m = 0.05};
	struct publisher *p = publisher_create(&params);
	struct publisher_old *old;

	for (int i = 0; i < n; i++) {
		struct patch *patch = patch_create((struct patch_key){i, 0, 0}, &surface);

		assert_int_equal(publisher_publish(p, 1, &patch, NULL, 1), 0);
		patch_unref(patch);
	}
	old = publisher_begin_map(p, (const uint8_t[16]){1});
	publisher_destroy(p); /* the old map does not need it */
	return old;
}

static const uint8_t ID[16] = {0xab, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xcd};
#define ID_TEXT "ab0000000000000000000000000000cd"

static int files_in(const char *folder)
{
	DIR *dir = opendir(folder);
	int n = 0;

	for (struct dirent *entry; (entry = readdir(dir)) != NULL;)
		n += entry->d_name[0] != '.';
	closedir(dir);
	return n;
}

static void a_saved_map_is_a_whole_file_of_its_id(void **state)
{
	char folder[] = "/tmp/test_archive.XXXXXX", path[100], head[3], error[200];
	struct archive *archive;
	uv_loop_t loop;
	FILE *file;

	(void)state;
	memset(&seen, 0, sizeof(seen));
	assert_non_null(mkdtemp(folder));
	uv_loop_init(&loop);
	archive = archive_create(&loop, folder, 0.05, on_done, &seen);
	assert_true(archive_save(archive, ID, make_old(5), error));
	assert_int_equal(seen.done, 0);
	uv_run(&loop, UV_RUN_DEFAULT);
	assert_int_equal(seen.saved, 1);
	assert_int_equal(seen.triangles, 5);
	assert_string_equal(seen.map, ID_TEXT);
	snprintf(path, sizeof(path), "%s/" ID_TEXT ".ply", folder);
	assert_string_equal(seen.file, path);
	file = fopen(path, "r");
	assert_non_null(file);
	assert_int_equal(fread(head, 1, 3, file), 3);
	assert_memory_equal(head, "ply", 3);
	fclose(file);
	assert_int_equal(files_in(folder), 1);
	unlink(path);
	rmdir(folder);
	archive_destroy(archive);
	assert_int_equal(uv_loop_close(&loop), 0);
}

static void what_cannot_be_written_is_said(void **state)
{
	char folder[] = "/tmp/test_archive.XXXXXX", path[100], error[200];
	struct archive *archive;
	uv_loop_t loop;

	(void)state;
	uv_loop_init(&loop);
	for (int full = 0; full < 2; full++) {
		memset(&seen, 0, sizeof(seen));
		strcpy(folder, "/tmp/test_archive.XXXXXX");
		assert_non_null(mkdtemp(folder));
		snprintf(path, sizeof(path), "%s/" ID_TEXT ".ply.part", folder);
		if (full) /* every write to it says that the disk is full */
			assert_int_equal(symlink("/dev/full", path), 0);
		archive = archive_create(&loop, full ? folder : "/nowhere/at/all", 0.05, on_done, &seen);
		assert_true(archive_save(archive, ID, make_old(3), error));
		uv_run(&loop, UV_RUN_DEFAULT);
		assert_int_equal(seen.done, 1);
		assert_int_equal(seen.saved, 0);
		assert_non_null(strstr(seen.error, full ? "No space left" : "/nowhere/at/all/" ID_TEXT ".ply"));
		assert_non_null(strstr(seen.error, "map.archive"));
		assert_int_equal(files_in(folder), 0);
		rmdir(folder);
		archive_destroy(archive);
	}
	assert_int_equal(uv_loop_close(&loop), 0);
}

static void too_many_at_once_are_refused_with_a_sentence(void **state)
{
	char folder[] = "/tmp/test_archive.XXXXXX", path[100], error[200] = "";
	struct archive *archive;
	uv_loop_t loop;

	(void)state;
	memset(&seen, 0, sizeof(seen));
	assert_non_null(mkdtemp(folder));
	uv_loop_init(&loop);
	archive = archive_create(&loop, folder, 0.05, on_done, &seen);
	for (uint8_t i = 0; i < ARCHIVE_MAX; i++)
		assert_true(archive_save(archive, (const uint8_t[16]){i}, make_old(2), error));
	assert_false(archive_save(archive, ID, make_old(2), error));
	assert_non_null(strstr(error, "too slow"));
	uv_run(&loop, UV_RUN_DEFAULT);
	assert_int_equal(seen.saved, ARCHIVE_MAX);
	assert_true(archive_save(archive, ID, make_old(2), error));
	archive_stop(archive); /* what is at work goes on, and nobody is told */
	uv_run(&loop, UV_RUN_DEFAULT);
	assert_int_equal(seen.saved, ARCHIVE_MAX);
	assert_int_equal(files_in(folder), ARCHIVE_MAX + 1);
	for (int i = 0; i <= ARCHIVE_MAX; i++) {
		snprintf(path, sizeof(path),
		         i < ARCHIVE_MAX ? "%s/%02x000000000000000000000000000000.ply" : "%s/" ID_TEXT ".ply", folder,
		         i);
		assert_int_equal(unlink(path), 0);
	}
	rmdir(folder);
	archive_destroy(archive);
	assert_int_equal(uv_loop_close(&loop), 0);
}

static void a_folder_full_of_maps_gets_no_more(void **state)
{
	char folder[] = "/tmp/test_archive.XXXXXX", path[100], error[200] = "";
	struct archive *archive;
	uv_loop_t loop;

	(void)state;
	memset(&seen, 0, sizeof(seen));
	assert_non_null(mkdtemp(folder));
	uv_loop_init(&loop);
	archive = archive_create(&loop, folder, 0.05, on_done, &seen);
	for (int i = 0; i < ARCHIVE_FILES_MAX; i++) {
		snprintf(path, sizeof(path), "%s/%032x.ply", folder, (unsigned)i);
		fclose(fopen(path, "w"));
	}
	for (int room = 0; room < 2; room++) {
		assert_true(archive_save(archive, ID, make_old(2), error));
		uv_run(&loop, UV_RUN_DEFAULT);
		assert_int_equal(seen.saved, room);
		assert_true(room || strstr(seen.error, "move them away"));
		unlink(path); /* one was taken away */
	}
	assert_int_equal(files_in(folder), ARCHIVE_FILES_MAX);
	for (int i = 0; i < ARCHIVE_FILES_MAX - 1; i++) {
		snprintf(path, sizeof(path), "%s/%032x.ply", folder, (unsigned)i);
		assert_int_equal(unlink(path), 0);
	}
	snprintf(path, sizeof(path), "%s/" ID_TEXT ".ply", folder);
	assert_int_equal(unlink(path), 0);
	rmdir(folder);
	archive_destroy(archive);
	assert_int_equal(uv_loop_close(&loop), 0);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_saved_map_is_a_whole_file_of_its_id),
	    cmocka_unit_test(what_cannot_be_written_is_said),
	    cmocka_unit_test(too_many_at_once_are_refused_with_a_sentence),
	    cmocka_unit_test(a_folder_full_of_maps_gets_no_more),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

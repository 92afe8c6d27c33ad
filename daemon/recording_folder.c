#include "daemon/recording_folder.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/statvfs.h>
#include <time.h>
#include <unistd.h>

#include "daemon/recorder.h"

#define NAMES_MAX 10000 /* files looked at in the folder */

struct names {
	char name[NAMES_MAX][48];
	size_t n;
};

/* 20261123T001530Z-0123abcd.mcap, perhaps with -2 before the dot: ours. */
static bool is_ours(const char *name)
{
	static const char pattern[] = "########T######Z-";
	size_t len = strlen(name);

	if (len < 30 || len >= sizeof(((struct names *)0)->name[0]) || strcmp(name + len - 5, ".mcap") != 0)
		return false;
	for (size_t i = 0; pattern[i]; i++)
		if (pattern[i] == '#' ? name[i] < '0' || name[i] > '9' : name[i] != pattern[i])
			return false;
	return strspn(name + 17, "0123456789abcdef") >= 8;
}

static int compare_names(const void *a, const void *b)
{
	return strcmp(a, b);
}

static uint64_t file_size(int folder, const char *name)
{
	struct stat st;

	return fstatat(folder, name, &st, AT_SYMLINK_NOFOLLOW) == 0 && S_ISREG(st.st_mode) ? (uint64_t)st.st_size : 0;
}

static void list_names(DIR *folder, struct names *ret)
{
	struct dirent *entry;

	ret->n = 0;
	while (ret->n < NAMES_MAX && (entry = readdir(folder)) != NULL)
		if (is_ours(entry->d_name))
			snprintf(ret->name[ret->n++], sizeof(ret->name[0]), "%.47s", entry->d_name);
	qsort(ret->name, ret->n, sizeof(ret->name[0]), compare_names);
}

void recording_folder_keep(const char *dir, uint64_t keep, const char *path)
{
	struct names *names = malloc(sizeof(*names));
	DIR *folder = opendir(dir);
	const char *current = strrchr(path, '/') + 1;
	uint64_t total = 0;

	if (names && folder) {
		list_names(folder, names);
		for (size_t i = 0; i < names->n; i++)
			total += file_size(dirfd(folder), names->name[i]);
		for (size_t i = 0; i < names->n && total > keep; i++) {
			uint64_t size = file_size(dirfd(folder), names->name[i]);

			if (strcmp(names->name[i], current) != 0 && unlinkat(dirfd(folder), names->name[i], 0) == 0)
				total -= size;
		}
	}
	if (folder)
		closedir(folder);
	free(names);
}

/* -errno: there is no room, or no folder. */
static int look_for_room(const char *dir)
{
	struct statvfs fs;

	if (mkdir(dir, 0755) < 0 && errno != EEXIST)
		return -errno;
	if (statvfs(dir, &fs) < 0)
		return -errno;
	if (fs.f_flag & ST_RDONLY)
		return -EROFS;
	return (uint64_t)fs.f_bavail * fs.f_frsize < RECORDER_ROOM_BYTES ? -ENOSPC : 0;
}

int recording_folder_open(const char *dir, const struct recording_begin *begin, char ret_path[RECORDING_PATH_MAX])
{
	const time_t seconds = (time_t)(begin->log_ns / 1000000000);
	char stamp[32], more[16] = "";
	struct tm tm;
	int r = look_for_room(dir), fd;

	strftime(stamp, sizeof(stamp), "%Y%m%dT%H%M%SZ", gmtime_r(&seconds, &tm));
	for (int i = 2; i < 100; i++) {
		snprintf(ret_path, RECORDING_PATH_MAX, "%.400s/%s-%02x%02x%02x%02x%s.mcap", dir, stamp,
		         begin->map_id[0], begin->map_id[1], begin->map_id[2], begin->map_id[3], more);
		snprintf(more, sizeof(more), "-%d", i);
		if (r < 0)
			return r;
		fd = open(ret_path, O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0640);
		if (fd >= 0 || errno != EEXIST)
			return fd >= 0 ? fd : -errno;
	}
	return -EEXIST;
}

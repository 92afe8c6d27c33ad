/* A reader of OUT sees the old file or the whole new one: the bytes go to a file of another name in the same folder, which
 * is renamed over OUT when it is complete. The same folder, because a rename does not cross file systems. */
#include "tools/output.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>
#include <unistd.h>

enum output_format output_format(const char *path)
{
	static const char *const endings[] = {".ply", ".obj", ".stl", ".glb"};
	size_t len = strlen(path);
	for (int i = 0; i < OUTPUT_UNKNOWN; i++)
		if (len > 4 && strcasecmp(path + len - 4, endings[i]) == 0)
			return (enum output_format)i;
	return OUTPUT_UNKNOWN;
}

static int fail(struct output_error *error, const char *path, int code, const char *what)
{
	const char *hint = code == ENOENT                    ? "; make its folder first"
	                   : code == EACCES || code == EROFS ? "; choose a folder you may write to"
	                   : code == ENOSPC                  ? "; make room or choose another folder"
	                                                     : "";
	snprintf(error->text, sizeof error->text, "%s: %s: %s%s", path, what, strerror(code), hint);
	return -code;
}

/* A new file beside `path`; its name in `beside`. A descriptor or -errno. */
static int open_beside(const char *path, char beside[PATH_MAX])
{
	for (int i = 0; i < 100; i++) {
		if (snprintf(beside, PATH_MAX, "%s.%ld.%d.part", path, (long)getpid(), i) >= PATH_MAX)
			return -ENAMETOOLONG;
		int fd = open(beside, O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
		if (fd >= 0 || errno != EEXIST)
			return fd >= 0 ? fd : -errno;
	}
	return -EEXIST;
}

int output_check(const char *path, struct output_error *error)
{
	struct stat info;
	if (stat(path, &info) == 0 && !S_ISREG(info.st_mode))
		return fail(error, path, S_ISDIR(info.st_mode) ? EISDIR : EINVAL, "cannot be replaced by a file");
	char beside[PATH_MAX];
	int fd = open_beside(path, beside);
	if (fd < 0)
		return fail(error, path, -fd, "cannot be written");
	close(fd);
	unlink(beside);
	return 0;
}

static int write_all(int fd, const char *data, size_t len)
{
	while (len > 0) {
		ssize_t n = write(fd, data, len);
		if (n < 0 && errno == EINTR)
			continue;
		if (n < 0)
			return -errno;
		data += n;
		len -= (size_t)n;
	}
	return 0;
}

int output_write(const char *path, const void *data, size_t len, struct output_error *error)
{
	char beside[PATH_MAX];
	int fd = open_beside(path, beside);
	if (fd < 0)
		return fail(error, path, -fd, "cannot be written");
	int r = write_all(fd, data, len);
	if (close(fd) < 0 && r == 0)
		r = -errno;
	if (r == 0 && rename(beside, path) < 0)
		r = -errno;
	if (r < 0) {
		unlink(beside);
		return fail(error, path, -r, "cannot be written");
	}
	return 0;
}

int output_mesh(const char *path, const struct model *model, bool ascii, struct output_error *error)
{
	struct buffer bytes = {0};
	switch (output_format(path)) {
	case OUTPUT_PLY:
		ply_write(model, ascii, &bytes);
		break;
	case OUTPUT_OBJ:
		obj_write(model, &bytes);
		break;
	case OUTPUT_STL:
		stl_write(model, &bytes);
		break;
	case OUTPUT_GLB:
		gltf_write(model, &bytes);
		break;
	case OUTPUT_UNKNOWN:
		snprintf(error->text, sizeof error->text,
		         "%s: the ending names no mesh format; use .ply, .obj, .stl or .glb", path);
		return -EINVAL;
	}
	int r = bytes.error ? fail(error, path, ENOMEM, "cannot be made")
	                    : output_write(path, bytes.data, bytes.len, error);
	buffer_finish(&bytes);
	return r;
}

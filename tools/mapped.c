/* See mapped.h. A file that shrinks meanwhile ends the tool (SIGBUS); recordings only grow. */
#include "tools/mapped.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

int mapped_open(const char *path, struct mapped *ret, char error[400])
{
	int fd = open(path, O_RDONLY | O_CLOEXEC), r = fd < 0 ? -errno : 0;
	struct stat st = {0};
	void *data = MAP_FAILED;

	if (r == 0 && fstat(fd, &st) < 0)
		r = -errno;
	if (r == 0 && !S_ISREG(st.st_mode))
		r = S_ISDIR(st.st_mode) ? -EISDIR : -EINVAL;
	if (r == 0 && st.st_size > 0)
		data = mmap(NULL, (size_t)st.st_size, PROT_READ, MAP_PRIVATE, fd, 0);
	if (r == 0 && st.st_size > 0 && data == MAP_FAILED)
		r = -errno;
	if (fd >= 0)
		close(fd);
	if (r < 0) {
		snprintf(error, 400, "%.300s: cannot be read (%s)", path, strerror(-r));
		return r;
	}
	ret->data = data == MAP_FAILED ? (const uint8_t *)"" : data;
	ret->len = (size_t)st.st_size;
	return 0;
}

void mapped_close(struct mapped *file)
{
	if (file->len > 0)
		munmap((void *)(uintptr_t)file->data, file->len);
	file->len = 0;
}

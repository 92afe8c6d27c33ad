/* Whether somebody lives behind a socket's file is asked by connecting: who refuses is dead. The umask is set around bind,
 * because between bind and a chmod anybody could connect. */
#include "drivers/unix_socket.h"

#include <errno.h>
#include <stdbool.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <unistd.h>

/* One that takes datagrams answers that it is of another type, which is a sign of life too. */
static bool answers(const struct sockaddr_un *address)
{
	int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
	bool alive =
	    fd < 0 || connect(fd, (const struct sockaddr *)address, sizeof(*address)) == 0 || errno != ECONNREFUSED;

	if (fd >= 0)
		close(fd);
	return alive;
}

static int bind_0660(int fd, const struct sockaddr_un *address)
{
	mode_t before = umask(0117);
	int r = bind(fd, (const struct sockaddr *)address, sizeof(*address)) < 0 ? -errno : 0;

	umask(before);
	return r;
}

int unix_socket_bind(int fd, const struct sockaddr_un *address)
{
	int r = bind_0660(fd, address);
	struct stat st;

	if (r != -EADDRINUSE)
		return r;
	if (lstat(address->sun_path, &st) < 0 || !S_ISSOCK(st.st_mode))
		return -ENOTSOCK;
	if (answers(address))
		return -EADDRINUSE;
	return unlink(address->sun_path) < 0 ? -errno : bind_0660(fd, address);
}

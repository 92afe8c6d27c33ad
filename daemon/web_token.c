/* The file of the token: a secret that everybody on this machine can read is none, so it is refused. */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/web_guard.h"

static int refuse_file(const char *path, int r, const char *why, char error[320])
{
	snprintf(error, 320, "listen.token_file: %.120s %s", path, why);
	return r;
}

static int take_line(const char *path, const char *text, size_t len, char ret[WEB_TOKEN_MAX], char error[320])
{
	size_t n = strcspn(text, "\r\n");

	while (n > 0 && (text[n - 1] == ' ' || text[n - 1] == '\t'))
		n--;
	if (n < WEB_TOKEN_MIN || n >= WEB_TOKEN_MAX || strlen(text) != len)
		return refuse_file(path, -EINVAL,
		                   "has no token of 16 to 255 letters in its first line; make one with "
		                   "`openssl rand -hex 24`",
		                   error);
	for (size_t i = 0; i < n; i++)
		if (text[i] <= ' ' || text[i] > '~')
			return refuse_file(path, -EINVAL, "has a token with blanks or letters beyond ASCII", error);
	memcpy(ret, text, n);
	ret[n] = '\0';
	return 0;
}

int web_token_read(const char *path, char ret[WEB_TOKEN_MAX], char error[320])
{
	char text[WEB_TOKEN_MAX + 2] = "", why[120];
	const int fd = open(path, O_RDONLY | O_CLOEXEC | O_NONBLOCK);
	struct stat st;
	ssize_t n = -1;
	int r = 0;

	if (fd < 0 || fstat(fd, &st) < 0 || (n = read(fd, text, sizeof(text) - 1)) < 0) {
		r = -errno;
		snprintf(why, sizeof(why), "cannot be read (%s); make it readable for facetd's user", strerror(-r));
		refuse_file(path, r, why, error);
	} else if (st.st_mode & S_IROTH) {
		r = refuse_file(path, -EPERM, "can be read by everybody; chmod o-rwx it, and make a new token", error);
	} else {
		r = take_line(path, text, (size_t)n, ret, error);
	}
	if (fd >= 0)
		close(fd);
	return r;
}

/* Opening a serial line. Three traps are met here:
 *  - what a scanner sent while nobody listened is delivered to whoever opens the line next: it is discarded;
 *  - a line that is exclusive stays so while anybody holds it open, so the claim is given back before closing, and a
 *    pseudo-terminal (whose simulator holds it open) is never claimed;
 *  - a driver may keep its old rate and say that all went well: only reading back shows it. */
#include "drivers/serial.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <sys/sysmacros.h>
#include <termios.h>
#include <unistd.h>

bool serial_is_pty(int fd)
{
	struct stat st;
	return fstat(fd, &st) == 0 && major(st.st_rdev) >= 136 && major(st.st_rdev) <= 143;
}

static int open_failed(const char *path, int r, char error[160])
{
	switch (r) {
	case -EACCES:
		snprintf(error, 160,
		         "%.64s: permission denied; join the group dialout (usermod -aG dialout USER) and log in anew",
		         path);
		break;
	case -ENOENT:
	case -ENODEV:
	case -ENXIO:
		snprintf(error, 160, "%.64s: there is no such device; plug it in, or correct `port`", path);
		break;
	case -EBUSY:
		snprintf(error, 160, "%.64s: another program has it open; end that program first", path);
		break;
	case -ENOTTY:
		snprintf(error, 160, "%.64s: this is no serial line; correct `port`", path);
		break;
	default:
		snprintf(error, 160, "%.64s: cannot be opened (%s)", path, strerror(-r));
		break;
	}
	return r;
}

static int make_raw(int fd)
{
	struct termios t;
	if (tcgetattr(fd, &t) < 0)
		return errno == EINVAL ? -ENOTTY : -errno;
	cfmakeraw(&t);
	t.c_cflag &= ~(tcflag_t)(CSTOPB | CRTSCTS | PARENB);
	t.c_cflag |= CS8 | CLOCAL | CREAD;
	t.c_cc[VMIN] = 1; /* a read of 0 bytes then means that the line is gone, never "nothing yet" */
	t.c_cc[VTIME] = 0;
	return tcsetattr(fd, TCSANOW, &t) < 0 ? -errno : 0;
}

int serial_open(const char *path, char error[160])
{
	const int fd = open(path, O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
	if (fd < 0)
		return open_failed(path, -errno, error);
	int r = make_raw(fd);
	if (r == 0 && !serial_is_pty(fd) && ioctl(fd, TIOCEXCL) < 0)
		r = -errno;
	if (r == 0 && tcflush(fd, TCIOFLUSH) < 0)
		r = -errno;
	if (r < 0) {
		close(fd);
		return open_failed(path, r, error);
	}
	return fd;
}

void serial_close(int fd)
{
	if (!serial_is_pty(fd))
		ioctl(fd, TIOCNXCL);
	close(fd);
}

int serial_set_baud(int fd, const char *path, uint32_t baud, char error[160])
{
	uint32_t got = 0;
	int r = serial_set_rate(fd, baud);
	if (r == 0)
		r = serial_get_rate(fd, &got);
	if (r < 0) {
		snprintf(error, 160, "%.64s: cannot set %u Bd (%s)", path, (unsigned)baud, strerror(-r));
		return r;
	}
	/* The divisor may not hit it: 2 % is what a byte of ten bits stands. */
	if (got > baud + baud / 50 || got < baud - baud / 50) {
		snprintf(error, 160,
		         "%.64s: refuses %u Bd (stays at %u); use an adapter that knows it, or another `baud`", path,
		         (unsigned)baud, (unsigned)got);
		return -EINVAL;
	}
	return 0;
}

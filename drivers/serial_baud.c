/* Rates that have no B constant (500000 has one, others do not), by termios2. Its header and <termios.h> define the
 * same names differently, so this file has it alone. */
#include "drivers/serial.h"

#include <asm/ioctls.h>
#include <asm/termbits.h>
#include <errno.h>
#include <sys/ioctl.h>

int serial_get_rate(int fd, uint32_t *ret_baud)
{
	struct termios2 t;
	if (ioctl(fd, TCGETS2, &t) < 0)
		return -errno;
	*ret_baud = t.c_ospeed;
	return 0;
}

int serial_set_rate(int fd, uint32_t baud)
{
	struct termios2 t;
	if (ioctl(fd, TCGETS2, &t) < 0)
		return -errno;
	t.c_cflag &= ~(tcflag_t)(CBAUD | CBAUD << IBSHIFT);
	t.c_cflag |= BOTHER | BOTHER << IBSHIFT;
	t.c_ispeed = t.c_ospeed = baud;
	return ioctl(fd, TCSETS2, &t) < 0 ? -errno : 0;
}

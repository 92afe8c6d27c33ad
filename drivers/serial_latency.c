/* Adapters gather bytes before they hand them over: FTDI for 16 ms, longer than a turn of the mirror. Two ways lead to less:
 * the flag ASYNC_LOW_LATENCY of the line (FTDI's driver then asks its chip for 1 ms; most others have nothing to set and
 * say so, or do nothing), and the file latency_timer beside it. Pseudo-terminals have no such thing. */
#include "drivers/serial.h"

#include <limits.h>
#include <linux/serial.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>

/* The timer of the line in ms, -1: it has none. */
static int read_timer(const char *file)
{
	int ms = -1;
	FILE *timer = fopen(file, "re");
	if (timer == NULL)
		return -1;
	if (fscanf(timer, "%d", &ms) != 1)
		ms = -1;
	fclose(timer);
	return ms;
}

static void write_timer(const char *file)
{
	FILE *timer = fopen(file, "we");
	if (timer == NULL)
		return; /* it is root's, mostly */
	fputs("1\n", timer);
	fclose(timer);
}

static bool set_flag(int fd)
{
	struct serial_struct line;
	memset(&line, 0, sizeof line);
	if (ioctl(fd, TIOCGSERIAL, &line) < 0)
		return false;
	if (line.flags & ASYNC_LOW_LATENCY)
		return true;
	line.flags |= ASYNC_LOW_LATENCY;
	if (ioctl(fd, TIOCSSERIAL, &line) < 0 || ioctl(fd, TIOCGSERIAL, &line) < 0)
		return false;
	return (line.flags & ASYNC_LOW_LATENCY) != 0;
}

void serial_low_latency(int fd, const char *sys, const char *path, char note[160])
{
	char real[PATH_MAX], file[PATH_MAX + 64];
	note[0] = 0;
	if (serial_is_pty(fd) || realpath(path, real) == NULL)
		return;
	const char *name = strrchr(real, '/') + 1;
	snprintf(file, sizeof file, "%s/bus/usb-serial/devices/%s/latency_timer", sys, name);
	const bool flagged = set_flag(fd);
	int ms = read_timer(file);
	if (ms > 1) {
		write_timer(file);
		ms = read_timer(file);
	}
	if (ms > 1)
		snprintf(note, 160,
		         "%.40s gathers bytes for %d ms; a udev rule that writes 1 to its latency_timer mends it", path,
		         ms);
	else if (ms < 0 && !flagged)
		snprintf(note, 160, "the driver of %.64s has no low latency to set; arrivals may be some ms late",
		         path);
}

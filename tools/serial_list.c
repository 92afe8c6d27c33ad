/* /sys/class/tty has every terminal there is; a serial line is one with hardware below it. Where that hardware is on USB,
 * one of the folders above carries its vendor, product and serial number:
 *
 *   /sys/class/tty/ttyUSB0/device ─► /sys/devices/.../usb1/1-1/1-1:1.0/ttyUSB0
 *                                                          └── idVendor idProduct manufacturer product serial */
#include "tools/serial_list.h"

#include <dirent.h>
#include <limits.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "drivers/usb_list.h"

#define TTYS  "/sys/class/tty"
#define BY_ID "/dev/serial/by-id"

static const char *last_part(const char *path)
{
	const char *slash = strrchr(path, '/');

	return slash ? slash + 1 : path;
}

/* What the symbolic link `name` in `dir` ends in. */
static void read_link(const char *dir, const char *name, char *ret, size_t cap)
{
	char path[PATH_MAX], target[PATH_MAX];
	ssize_t n = -1;

	if (snprintf(path, sizeof(path), "%s/%s", dir, name) < (int)sizeof(path))
		n = readlink(path, target, sizeof(target) - 1);
	target[n > 0 ? n : 0] = 0;
	snprintf(ret, cap, "%.*s", (int)cap - 1, last_part(target));
}

/* The driver of the hardware. Newer kernels put two devices of their own ("ctrl" and "port") between it and the line. */
static void read_driver(const char *device, char *ret, size_t cap)
{
	char dir[PATH_MAX];

	snprintf(dir, sizeof(dir), "%.*s", (int)sizeof(dir) - 1, device);
	do {
		read_link(dir, "driver", ret, cap);
		*strrchr(dir, '/') = 0;
	} while (strchr(dir + 1, '/') && (strcmp(ret, "port") == 0 || strcmp(ret, "ctrl") == 0));
}

/* What the adapter says of itself, if there is one; `dir` is cut. */
static void read_usb(char *dir, struct serial_line *line)
{
	char vendor[8], product[8], maker[24], title[40];

	if (!usb_list_above(dir))
		return;
	usb_list_value(dir, "idVendor", vendor, sizeof(vendor));
	usb_list_value(dir, "idProduct", product, sizeof(product));
	usb_list_value(dir, "manufacturer", maker, sizeof(maker));
	usb_list_value(dir, "product", title, sizeof(title));
	usb_list_value(dir, "serial", line->serial, sizeof(line->serial));
	line->vendor = (uint16_t)strtoul(vendor, NULL, 16);
	line->product = (uint16_t)strtoul(product, NULL, 16);
	snprintf(line->name, sizeof(line->name), "%s%s%s", maker, maker[0] && title[0] ? " " : "", title);
	snprintf(line->port, sizeof(line->port), "%.31s", last_part(dir));
}

/* False: a terminal without hardware, or a port of a PC that is not there (type 0). */
static bool describe(const char *tty, struct serial_line *ret)
{
	char dir[PATH_MAX], device[PATH_MAX], text[16];

	memset(ret, 0, sizeof(*ret));
	snprintf(dir, sizeof(dir), TTYS "/%s/device", tty);
	if (!realpath(dir, device) || strncmp(device, "/sys/", 5) != 0)
		return false;
	snprintf(dir, sizeof(dir), TTYS "/%s", tty);
	if (usb_list_value(dir, "type", text, sizeof(text)) && strcmp(text, "0") == 0)
		return false;
	snprintf(ret->node, sizeof(ret->node), "/dev/%.50s", tty);
	read_driver(device, ret->driver, sizeof(ret->driver));
	ret->latency_ms = usb_list_value(device, "latency_timer", text, sizeof(text)) ? atoi(text) : -1;
	read_usb(device, ret);
	return true;
}

static int compare(const void *a, const void *b)
{
	return strverscmp(((const struct serial_line *)a)->node, ((const struct serial_line *)b)->node);
}

/* Gives each line the name that stays with its adapter. */
static void read_by_id(struct serial_line *list, int n)
{
	DIR *dir = opendir(BY_ID);
	const struct dirent *entry;
	char target[64];

	while (dir && (entry = readdir(dir))) {
		if (entry->d_name[0] == '.' || strcspn(entry->d_name, "'\"\\") < strlen(entry->d_name))
			continue;
		read_link(BY_ID, entry->d_name, target, sizeof(target));
		for (int i = 0; i < n; i++)
			if (strcmp(last_part(list[i].node), target) == 0 &&
			    strlen(entry->d_name) + sizeof(BY_ID) < sizeof(list[i].by_id))
				snprintf(list[i].by_id, sizeof(list[i].by_id), BY_ID "/%.200s", entry->d_name);
	}
	if (dir)
		closedir(dir);
}

int serial_list(struct serial_line ret[SERIAL_LIST_MAX])
{
	DIR *dir = opendir(TTYS);
	const struct dirent *entry;
	int n = 0;

	if (!dir)
		return 0;
	while (n < SERIAL_LIST_MAX && (entry = readdir(dir)))
		if (entry->d_name[0] != '.' && strlen(entry->d_name) < 32)
			n += describe(entry->d_name, &ret[n]);
	closedir(dir);
	qsort(ret, (size_t)n, sizeof(*ret), compare);
	read_by_id(ret, n);
	return n;
}

/* /sys/class/net has every interface; those of CAN have ARPHRD type 280. `flags` has IFF_UP once somebody brought it up;
 * `operstate` is then "up" while the controller takes part, "down" while it is off; virtual ones say "unknown". The bit
 * rate is not in sysfs. */
#include "tools/can_list.h"

#include <dirent.h>
#include <limits.h>
#include <net/if.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "drivers/usb_list.h"

#define NETS     "/sys/class/net"
#define TYPE_CAN "280"
#define MTU_FD   72

static void read_driver(const char *dir, char ret[32])
{
	char path[PATH_MAX], target[PATH_MAX];
	const char *slash;
	ssize_t n;

	snprintf(path, sizeof(path), "%.200s/device/driver", dir);
	n = readlink(path, target, sizeof(target) - 1);
	target[n > 0 ? n : 0] = 0;
	slash = strrchr(target, '/');
	snprintf(ret, 32, "%.31s", slash ? slash + 1 : target);
}

/* False: it is not CAN. */
static bool describe(const char *name, struct can_interface *ret)
{
	char dir[PATH_MAX], text[24];

	snprintf(dir, sizeof(dir), NETS "/%.15s", name);
	if (strlen(name) >= sizeof(ret->name) || !usb_list_value(dir, "type", text, sizeof(text)) ||
	    strcmp(text, TYPE_CAN) != 0)
		return false;
	memset(ret, 0, sizeof(*ret));
	snprintf(ret->name, sizeof(ret->name), "%s", name);
	read_driver(dir, ret->driver);
	usb_list_value(dir, "mtu", text, sizeof(text));
	ret->fd = atoi(text) >= MTU_FD;
	usb_list_value(dir, "flags", text, sizeof(text));
	if (!(strtoul(text, NULL, 16) & IFF_UP))
		return true;
	usb_list_value(dir, "operstate", text, sizeof(text));
	ret->state = strcmp(text, "down") == 0 ? CAN_LIST_OFF : CAN_LIST_UP;
	return true;
}

static int by_name(const void *a, const void *b)
{
	return strcmp(((const struct can_interface *)a)->name, ((const struct can_interface *)b)->name);
}

int can_list(struct can_interface ret[CAN_LIST_MAX])
{
	const struct dirent *entry;
	DIR *dir = opendir(NETS);
	int n = 0;

	while (dir && n < CAN_LIST_MAX && (entry = readdir(dir)))
		if (entry->d_name[0] != '.' && describe(entry->d_name, &ret[n]))
			n++;
	if (dir)
		closedir(dir);
	qsort(ret, (size_t)n, sizeof(*ret), by_name);
	return n;
}

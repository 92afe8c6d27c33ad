/* The list of USB devices out of /sys/bus/usb/devices: one directory each, named BUS-PORT[.PORT], with a file a value.
 *
 * Rejected: asking by libusb_get_string_descriptor, a control transfer that blocks the loop for up to a second and needs the
 * permission to open the device, which is just what a message about a missing permission does not have. */
#include "drivers/usb_list.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <grp.h>
#include <limits.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#define DEVICES "/sys/bus/usb/devices"

bool usb_list_value(const char *folder, const char *name, char *ret, size_t cap)
{
	char path[PATH_MAX];
	ssize_t n;
	int fd = -1;

	ret[0] = 0;
	if (snprintf(path, sizeof(path), "%s/%s", folder, name) < (int)sizeof(path))
		fd = open(path, O_RDONLY | O_CLOEXEC);
	if (fd < 0)
		return false;
	n = read(fd, ret, cap - 1);
	close(fd);
	ret[n > 0 ? n : 0] = 0;
	ret[strcspn(ret, "\n")] = 0;
	for (char *c = ret; *c; c++)
		if (*c < ' ' || *c > '~' || *c == '"' || *c == '\\')
			*c = '?';
	return true;
}

bool usb_list_above(char *folder)
{
	char vendor[8];

	while (!usb_list_value(folder, "idVendor", vendor, sizeof(vendor))) {
		char *slash = strrchr(folder, '/');

		if (!slash || slash == folder)
			return false;
		*slash = 0;
	}
	return true;
}

static unsigned long read_number(const char *folder, const char *name, int base)
{
	char text[16];

	usb_list_value(folder, name, text, sizeof(text));
	return strtoul(text, NULL, base);
}

/* By bus, then by each port on the way: 1-2 before 1-10. */
static int compare(const void *a, const void *b)
{
	const char *p = ((const struct usb_device *)a)->port, *q = ((const struct usb_device *)b)->port;

	while (*p && *q) {
		char *p_end, *q_end;
		unsigned long i = strtoul(p, &p_end, 10), j = strtoul(q, &q_end, 10);

		if (i != j)
			return i < j ? -1 : 1;
		if (p_end == p || q_end == q)
			break;
		p = p_end + (*p_end != 0);
		q = q_end + (*q_end != 0);
	}
	return (*p != 0) - (*q != 0);
}

static bool describe(const char *port, uint16_t vendor, uint16_t product, struct usb_device *ret)
{
	char folder[sizeof(DEVICES) + sizeof(ret->port)];

	snprintf(folder, sizeof(folder), DEVICES "/%s", port);
	if (read_number(folder, "idVendor", 16) != vendor || read_number(folder, "idProduct", 16) != product)
		return false;
	memset(ret, 0, sizeof(*ret));
	snprintf(ret->port, sizeof(ret->port), "%s", port);
	ret->bus = (unsigned)read_number(folder, "busnum", 10) % 1000;
	ret->address = (unsigned)read_number(folder, "devnum", 10) % 1000;
	usb_list_value(folder, "serial", ret->serial, sizeof(ret->serial));
	usb_list_value(folder, "product", ret->product, sizeof(ret->product));
	snprintf(ret->node, sizeof(ret->node), "/dev/bus/usb/%03u/%03u", ret->bus, ret->address);
	return true;
}

int usb_list(uint16_t vendor, uint16_t product, struct usb_device ret[USB_LIST_MAX])
{
	DIR *dir = opendir(DEVICES);
	const struct dirent *entry;
	int n = 0;

	if (!dir)
		return 0;
	while (n < USB_LIST_MAX && (entry = readdir(dir)))
		if (strlen(entry->d_name) < sizeof(ret->port) && strchr(entry->d_name, '-') &&
		    !strchr(entry->d_name, ':')) /* 1-1:1.0 is an interface */
			n += describe(entry->d_name, vendor, product, &ret[n]);
	closedir(dir);
	qsort(ret, (size_t)n, sizeof(*ret), compare);
	return n;
}

/* Choosing */

static int count_serial(const struct usb_device *list, int n, const char *serial)
{
	int same = 0;

	for (int i = 0; i < n; i++)
		same += strcmp(list[i].serial, serial) == 0;
	return same;
}

const char *usb_list_name(const struct usb_device *list, int n, int i)
{
	const char *serial = list[i].serial;
	bool plain = serial[0] && strcspn(serial, " ?#,'{}[]:&*!|>%@`") == strlen(serial);

	return plain && count_serial(list, n, serial) == 1 ? serial : list[i].port;
}

static int say_several(const struct usb_device *list, int n, const char *serial, char error[160])
{
	size_t at = (size_t)snprintf(error, 160, "%d scanners %s; write one of these as `connect`:", n,
	                             serial ? "have this serial number" : "are plugged in");

	for (int i = 0; i < n && at < 120; i++)
		at += (size_t)snprintf(error + at, 160 - at, "%s usb:%.24s", i ? "," : "",
		                       serial ? list[i].port : usb_list_name(list, n, i));
	return -1;
}

static int say_missing(const struct usb_device *list, int n, const char *connect, char error[160])
{
	if (n == 0)
		snprintf(error, 160, "%.40s: no scanner is plugged in on USB; plug it in and switch it on", connect);
	else
		snprintf(error, 160,
		         "%.40s: this scanner is not plugged in (usb:%.24s is%s); `facet devices` lists them", connect,
		         usb_list_name(list, n, 0), n > 1 ? ", and others" : "");
	return -1;
}

int usb_list_choose(const struct usb_device *list, int n, const char *connect, char error[160])
{
	const char *wanted = strchr(connect, ':');
	struct usb_device same[USB_LIST_MAX];
	int found = -1, matches = 0;

	if (!wanted) {
		if (n == 1)
			return 0;
		return n ? say_several(list, n, NULL, error) : say_missing(list, n, connect, error);
	}
	wanted++;
	for (int i = 0; i < n; i++)
		if (strcmp(list[i].port, wanted) == 0)
			return i;
	for (int i = 0; i < n; i++)
		if (list[i].serial[0] && strcmp(list[i].serial, wanted) == 0) {
			found = i;
			same[matches++] = list[i];
		}
	if (matches > 1)
		return say_several(same, matches, wanted, error);
	return matches ? found : say_missing(list, n, connect, error);
}

/* Permissions */

static bool is_member(gid_t gid)
{
	gid_t groups[256];
	int n = getgroups((int)(sizeof(groups) / sizeof(*groups)), groups);

	for (int i = 0; i < n; i++)
		if (groups[i] == gid)
			return true;
	return getegid() == gid;
}

static void explain_denied(const char *node, const char *rule, char why[160])
{
	struct stat st;
	const struct group *group;

	if (stat(node, &st) < 0 || st.st_gid == 0 || (st.st_mode & 060) != 060) {
		snprintf(why, 160, "%.60s: no permission, and no group has it; %s", node, rule);
		return;
	}
	group = getgrgid(st.st_gid);
	if (!group)
		snprintf(why, 160, "%.60s: no permission; it belongs to group %u, which has no name here", node,
		         (unsigned)st.st_gid);
	else if (is_member(st.st_gid))
		snprintf(why, 160, "%.60s: no permission, though group %.20s has it: is it an access list?", node,
		         group->gr_name);
	else
		snprintf(why, 160,
		         "%.40s: no permission; group %.16s has it: sudo usermod -aG %.16s $USER, then log in again",
		         node, group->gr_name, group->gr_name);
}

void usb_list_explain(const char *node, int error, const char *rule, char why[160])
{
	switch (error) {
	case EACCES:
		explain_denied(node, rule, why);
		break;
	case EPERM:
		snprintf(why, 160, "%.60s: the service's sandbox denies it; add a DeviceAllow= for it to the unit",
		         node);
		break;
	case EBUSY:
		snprintf(why, 160, "%.60s: another program has it open; stop that one", node);
		break;
	case ENOENT:
		snprintf(why, 160, "%.60s: there is no such device node; is udevd (or devtmpfs) at work here?", node);
		break;
	default:
		snprintf(why, 160, "%.60s: cannot be opened (%s)", node, strerror(error));
	}
}

int usb_list_permitted(const struct usb_device *device, char why[160])
{
	int fd = open(device->node, O_RDWR | O_NONBLOCK | O_CLOEXEC);
	int r = fd < 0 ? -errno : 0;

	why[0] = 0;
	if (r < 0)
		usb_list_explain(device->node, -r, "install the udev rule 70-facetd.rules and plug it in again", why);
	else
		close(fd);
	return r;
}

/* Which device file is the adapter that the configuration means? Names like ttyUSB0 go by the order of plugging; what an
 * adapter says of itself stays. sysfs has it a few folders above the line:
 *
 *   class/tty/ttyUSB0/device ->  .../1-1/1-1:1.0/ttyUSB0      (usb-serial)
 *   class/tty/ttyACM0/device ->  .../1-2/1-2:1.0              (cdc-acm)
 *                                    1-1/idVendor, idProduct, serial
 *
 * It is asked anew at every opening, since the name changes on the way. Two of a kind are never guessed between; two lines
 * of one adapter cannot be told by its serial number either, then only a path under /dev/serial/by-id does. */
#include "drivers/serial.h"

#include <dirent.h>
#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

#include "drivers/usb_list.h"

#define PREFIX    "usb:"
#define LINE_MAX_ 64

struct adapter {
	char line[LINE_MAX_]; /* one of its lines */
	char vendor[8], product[8], serial[80];
};

/* What the adapter of a line says of itself; false: it has none. */
static bool adapter_of(const char *sys, const char *line, struct adapter *ret)
{
	char link[PATH_MAX], folder[PATH_MAX];
	if (snprintf(link, sizeof link, "%s/class/tty/%s/device", sys, line) >= (int)sizeof link ||
	    realpath(link, folder) == NULL)
		return false;
	if (!usb_list_above(folder))
		return false;
	usb_list_value(folder, "idVendor", ret->vendor, sizeof ret->vendor);
	usb_list_value(folder, "serial", ret->serial, sizeof ret->serial);
	return usb_list_value(folder, "idProduct", ret->product, sizeof ret->product);
}

/* usb:VENDOR:PRODUCT[:SERIAL] in its parts. */
static bool parse(const char *port, struct adapter *ret)
{
	char rest[160], *serial;
	*ret = (struct adapter){.serial = ""};
	snprintf(rest, sizeof rest, "%s", port + sizeof PREFIX - 1);
	char *product = strchr(rest, ':');
	if (product == NULL)
		return false;
	*product++ = 0;
	serial = strchr(product, ':');
	if (serial != NULL)
		*serial++ = 0;
	static const char hex[] = "0123456789abcdefABCDEF";
	if (strlen(rest) != 4 || strlen(product) != 4 || strspn(rest, hex) != 4 || strspn(product, hex) != 4 ||
	    (serial != NULL && (serial[0] == 0 || strlen(serial) >= sizeof ret->serial)))
		return false;
	memcpy(ret->vendor, rest, 5);
	memcpy(ret->product, product, 5);
	if (serial != NULL)
		memcpy(ret->serial, serial, strlen(serial) + 1);
	return true;
}

static bool matches(const struct adapter *wanted, const struct adapter *found)
{
	return strcasecmp(wanted->vendor, found->vendor) == 0 && strcasecmp(wanted->product, found->product) == 0 &&
	       (wanted->serial[0] == 0 || strcmp(wanted->serial, found->serial) == 0);
}

/* Lines whose adapter is the wanted one: how many, and the first two by name. */
static int look(const char *sys, const struct adapter *wanted, struct adapter ret[2])
{
	char folder[PATH_MAX];
	int n = 0;
	snprintf(folder, sizeof folder, "%s/class/tty", sys);
	DIR *lines = opendir(folder);
	if (lines == NULL)
		return 0;
	for (const struct dirent *entry; (entry = readdir(lines)) != NULL;) {
		struct adapter found;
		if (entry->d_name[0] == '.' || strlen(entry->d_name) >= sizeof found.line ||
		    !adapter_of(sys, entry->d_name, &found) || !matches(wanted, &found))
			continue;
		strcpy(found.line, entry->d_name);
		const bool first = n == 0 || strcmp(found.line, ret[0].line) < 0;
		if (first && n > 0)
			ret[1] = ret[0];
		if (first)
			ret[0] = found;
		else if (n == 1 || strcmp(found.line, ret[1].line) < 0)
			ret[1] = found;
		n++;
	}
	closedir(lines);
	return n;
}

int serial_find(const char *sys, const char *port, char *ret_path, size_t cap, char error[160])
{
	struct adapter wanted, found[2];
	if (strncmp(port, PREFIX, sizeof PREFIX - 1) != 0) {
		if ((size_t)snprintf(ret_path, cap, "%s", port) < cap)
			return 0;
		snprintf(error, 160, "%.64s...: this path is too long", port);
		return -ENAMETOOLONG;
	}
	if (!parse(port, &wanted)) {
		snprintf(error, 160,
		         "%.48s: this names no adapter; write usb:VENDOR:PRODUCT[:SERIAL], like usb:0403:6001", port);
		return -EINVAL;
	}
	const int n = look(sys, &wanted, found);
	if (n == 0) {
		snprintf(error, 160, "%.64s: no such adapter is plugged in; `facet devices` lists those that are",
		         port);
		return -ENODEV;
	}
	if (n > 1 && found[0].serial[0] != 0 && strcmp(found[0].serial, found[1].serial) != 0) {
		snprintf(error, 160,
		         "%.24s: %.12s and %.12s are such adapters; add the serial number, :%.20s or :%.20s", port,
		         found[0].line, found[1].line, found[0].serial, found[1].serial);
		return -ENOTUNIQ;
	}
	if (n > 1) {
		snprintf(error, 160,
		         "%.40s: %.12s and %.12s are such lines alike; write a path under /dev/serial/by-id or by-path",
		         port, found[0].line, found[1].line);
		return -ENOTUNIQ;
	}
	snprintf(ret_path, cap, "/dev/%s", found[0].line);
	return 0;
}

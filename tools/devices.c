/* `facet devices`: what is plugged in that facetd could drive, a line of configuration to paste for each, and why one of
 * them cannot be opened. It reads what the kernel knows already; nothing is opened but the nodes of USB scanners, and
 * nothing is sent. Scanners on Ethernet are not looked for: their address is known to whoever set them up. */
#include <argp.h>
#include <ctype.h>
#include <dirent.h>
#include <errno.h>
#include <limits.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include <jansson.h>

#include "drivers/cola.h"
#include "drivers/usb_list.h"
#include "tools/can_list.h"
#include "tools/commands.h"
#include "tools/serial_list.h"

#define NOTES_MAX 4
#define YAML_MAX  480

struct found {
	const char *kind; /* "usb", "serial", "can" */
	char title[320], yaml[YAML_MAX];
	char note[NOTES_MAX][200]; /* what stands in the way, or will */
	int notes;
	bool usable; /* by this user, now */
	const char *node, *port, *serial, *by_id, *driver;
	uint16_t vendor, product;
};

static const struct argp_option options[] = {{"json", 'j', NULL, 0, "one JSON object instead of text", 0}, {0}};

static error_t parse_option(int key, char *arg, struct argp_state *state)
{
	(void)arg;
	if (key != 'j')
		return key == ARGP_KEY_ARG ? (argp_error(state, "takes no arguments"), 0) : ARGP_ERR_UNKNOWN;
	*(bool *)state->input = true;
	return 0;
}

static void note(struct found *found, const char *format, ...) __attribute__((format(printf, 2, 3)));

static void note(struct found *found, const char *format, ...)
{
	va_list args;

	if (found->notes == NOTES_MAX)
		return;
	va_start(args, format);
	vsnprintf(found->note[found->notes++], sizeof(found->note[0]), format, args);
	va_end(args);
}

/* Who holds a node: seen of one's own programs only, or by root of all. */

static bool process_holds(const char *pid, const struct stat *node)
{
	char path[PATH_MAX], target[16];
	const struct dirent *entry;
	struct stat st;
	bool holds = false;

	snprintf(path, sizeof(path), "/proc/%.20s/fd", pid);
	DIR *dir = opendir(path);
	while (dir && !holds && (entry = readdir(dir))) {
		/* Only what lies in /dev is looked at: a file on a dead network drive would keep us waiting. */
		if (readlinkat(dirfd(dir), entry->d_name, target, sizeof(target)) < 5 ||
		    strncmp(target, "/dev/", 5) != 0)
			continue;
		holds = fstatat(dirfd(dir), entry->d_name, &st, 0) == 0 && st.st_ino == node->st_ino &&
		        st.st_dev == node->st_dev;
	}
	if (dir)
		closedir(dir);
	return holds;
}

static bool find_holder(const char *name, struct found *found)
{
	const struct dirent *entry;
	struct stat node;
	bool holds = false;
	DIR *dir = stat(name, &node) == 0 ? opendir("/proc") : NULL;

	while (dir && !holds && (entry = readdir(dir))) {
		char path[PATH_MAX], comm[32] = "a program";

		holds = isdigit((unsigned char)entry->d_name[0]) && process_holds(entry->d_name, &node);
		if (!holds)
			continue;
		snprintf(path, sizeof(path), "/proc/%.20s/comm", entry->d_name);
		FILE *file = fopen(path, "re");
		if (file && fgets(comm, sizeof(comm), file))
			comm[strcspn(comm, "\n")] = 0;
		if (file)
			fclose(file);
		note(found, "in use by %s (process %.20s)", comm, entry->d_name);
	}
	if (dir)
		closedir(dir);
	return holds;
}

/* The kernel's driver at interface 0 of a USB device; "usbfs" stands for a program. Empty: none. */
static void interface_driver(const char *port, char ret[32])
{
	char path[128], target[PATH_MAX];
	ssize_t n;

	snprintf(path, sizeof(path), "/sys/bus/usb/devices/%.31s:1.0/driver", port);
	n = readlink(path, target, sizeof(target) - 1);
	target[n > 0 ? n : 0] = 0;
	snprintf(ret, 32, "%.31s", strrchr(target, '/') ? strrchr(target, '/') + 1 : target);
}

/* Finding */

static void name_device(int number, char ret[24])
{
	if (number == 0)
		snprintf(ret, 24, "laser");
	else
		snprintf(ret, 24, "laser%d", number + 1);
}

static void describe_usb(const struct usb_device *list, int n, int i, int number, struct found *ret)
{
	const struct usb_device *device = &list[i];
	char name[24], driver[32], why[160];

	memset(ret, 0, sizeof(*ret));
	*ret = (struct found){.kind = "usb",
	                      .node = device->node,
	                      .port = device->port,
	                      .serial = device->serial,
	                      .by_id = "",
	                      .driver = "",
	                      .vendor = COLA_USB_VENDOR,
	                      .product = COLA_USB_PRODUCT};
	snprintf(ret->title, sizeof(ret->title), "SICK %.63s, %s%.63s, port %.31s, %.39s",
	         device->product[0] ? device->product : "scanner",
	         device->serial[0] ? "serial number " : "no serial number", device->serial, device->port, device->node);
	name_device(number, name);
	snprintf(ret->yaml, sizeof(ret->yaml), "- {name: %s, driver: tim, connect: \"usb:%s\"}", name,
	         usb_list_name(list, n, i));
	ret->usable = usb_list_permitted(device, why) == 0;
	if (!ret->usable)
		note(ret, "%s", why);
	interface_driver(device->port, driver);
	if (strcmp(driver, "usbfs") == 0) {
		ret->usable = false;
		if (!find_holder(device->node, ret))
			note(ret, "in use by another program (as root, `facet devices` says by which)");
	} else if (driver[0]) {
		note(ret, "the kernel's driver %s has it; facetd takes it from there while it runs", driver);
	}
}

/* The rate to begin with: ports of a PC divide 115200 and cannot do 500000. */
static int usual_baud(const struct serial_line *line)
{
	return line->vendor ? 500000 : 38400;
}

/* What stays with the adapter: udev's name for it, else its make and number where they are unique, else the node. */
static void name_port(const struct serial_line *list, int n, const struct serial_line *line, char ret[256])
{
	const char *digits = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ-_.";
	int same = 0, twins = 0;

	for (int i = 0; i < n; i++) {
		bool make = list[i].vendor == line->vendor && list[i].product == line->product;

		same += make;
		twins += make && strcmp(list[i].serial, line->serial) == 0;
	}
	if (line->by_id[0])
		snprintf(ret, 256, "%s", line->by_id);
	else if (line->vendor && same == 1)
		snprintf(ret, 256, "usb:%04x:%04x", line->vendor, line->product);
	else if (line->vendor && twins == 1 && line->serial[0] && strspn(line->serial, digits) == strlen(line->serial))
		snprintf(ret, 256, "usb:%04x:%04x:%s", line->vendor, line->product, line->serial);
	else
		snprintf(ret, 256, "%s", line->node);
}

static void describe_serial(const struct serial_line *list, int n, int i, int number, struct found *ret)
{
	const struct serial_line *line = &list[i];
	char name[24], port[256], why[160];

	*ret = (struct found){.kind = "serial",
	                      .node = line->node,
	                      .port = line->port,
	                      .serial = line->serial,
	                      .by_id = line->by_id,
	                      .driver = line->driver,
	                      .vendor = line->vendor,
	                      .product = line->product};
	if (line->vendor)
		snprintf(ret->title, sizeof(ret->title), "%.63s, %.63s, %04x:%04x, %s%.63s, port %.31s, driver %.31s",
		         line->node, line->name[0] ? line->name : "USB adapter", line->vendor, line->product,
		         line->serial[0] ? "serial number " : "no serial number", line->serial, line->port,
		         line->driver);
	else
		snprintf(ret->title, sizeof(ret->title), "%s, driver %s", line->node, line->driver);
	name_device(number, name);
	name_port(list, n, line, port);
	snprintf(ret->yaml, sizeof(ret->yaml), "- {name: %s, driver: lms2xx, port: '%s', baud: %d}", name, port,
	         usual_baud(line));
	ret->usable = true;
	if (access(line->node, R_OK | W_OK) < 0) {
		usb_list_explain(line->node, errno, "a udev rule has to give it to one, like dialout", why);
		note(ret, "%s", why);
		ret->usable = false;
	}
	if (find_holder(line->node, ret))
		ret->usable = false;
	if (line->latency_ms > 1)
		note(ret, "the adapter holds bytes back for %d ms; facetd asks for 1 ms when it opens the line",
		     line->latency_ms);
	if (line->vendor && strcmp(port, line->node) == 0)
		note(ret, "it has no name of its own: after the next plugging its twin may be %s", line->node);
}

/* Node id and count are its handbook's; the line is one that can be pasted and then says what is missing. */
static void describe_can(const struct can_interface *can, int number, struct found *ret)
{
	char name[24] = "servo";

	*ret = (struct found){.kind = "can",
	                      .node = can->name,
	                      .port = "",
	                      .serial = "",
	                      .by_id = "",
	                      .driver = can->driver,
	                      .usable = can->state == CAN_LIST_UP};
	snprintf(ret->title, sizeof(ret->title), "%s, %s%s, %s%s", can->name, can->driver[0] ? "driver " : "virtual",
	         can->driver,
	         can->state == CAN_LIST_UP    ? "up"
	         : can->state == CAN_LIST_OFF ? "up, its controller is off"
	                                      : "down",
	         can->fd ? ", FD" : "");
	if (number > 0)
		snprintf(name, sizeof(name), "servo%d", number + 1);
	snprintf(ret->yaml, sizeof(ret->yaml), "- {name: %s, driver: canopen, connect: %s, node: 1}", name, can->name);
	if (can->state == CAN_LIST_DOWN && can->driver[0])
		note(
		    ret,
		    "`ip link set %s up type can bitrate 500000 restart-ms 100` brings it up, with the rate of the bus",
		    can->name);
	else if (can->state == CAN_LIST_DOWN)
		note(ret, "`ip link set %s up` brings it up", can->name);
	else if (can->state == CAN_LIST_OFF)
		note(
		    ret,
		    "bus-off: check cable, terminators and bit rate; `ip link set %s type can restart` starts it again",
		    can->name);
}

/* Saying */

static const char *heading(const char *kind)
{
	if (strcmp(kind, "usb") == 0)
		return "Scanners on USB:";
	if (strcmp(kind, "serial") == 0)
		return "Serial lines (who is at their other end they do not say; a servo is driver: modbus, connect: "
		       "PATH):";
	return "CAN interfaces (what is on the bus they do not say; an angle in any frame is driver: can, the wheels "
	       "are "
	       "driver: odometry):";
}

static void print_found(const struct found *found)
{
	printf("  %s\n    %s\n", found->title, found->yaml);
	for (int i = 0; i < found->notes; i++)
		printf("    ! %s\n", found->note[i]);
}

static void print_text(const struct found *found, int n)
{
	const char *kind = "";

	for (int i = 0; i < n; i++) {
		if (strcmp(kind, found[i].kind) != 0)
			printf("%s%s\n", i ? "\n" : "", heading(found[i].kind));
		kind = found[i].kind;
		print_found(&found[i]);
	}
	if (n)
		printf("\nThe lines with a dash belong below `devices:` in the configuration. Scanners on Ethernet are "
		       "not\n"
		       "looked for: - {name: laser, driver: lms1xx, connect: 192.168.0.1}\n");
	else
		printf("nothing found: no scanner on USB (%04x:%04x), no serial line, no CAN interface. Is it plugged "
		       "in and switched "
		       "on? `lsusb` "
		       "lists\nwhat the machine sees. Scanners on Ethernet are not looked for: - {name: laser, driver: "
		       "tim, "
		       "connect: 192.168.0.1}\n",
		       COLA_USB_VENDOR, COLA_USB_PRODUCT);
}

static int print_json(const struct found *found, int n)
{
	json_t *list = json_array();

	for (int i = 0; i < n; i++) {
		const struct found *f = &found[i];
		json_t *notes = json_array(), *one;
		char ids[16] = "";

		if (f->vendor)
			snprintf(ids, sizeof(ids), "%04x:%04x", f->vendor, f->product);
		for (int k = 0; k < f->notes; k++)
			json_array_append_new(notes, json_string(f->note[k]));
		one = json_pack("{ss ss ss ss ss ss ss ss sb so}", "kind", f->kind, "node", f->node, "port", f->port,
		                "id", ids, "serial", f->serial, "by_id", f->by_id, "driver", f->driver, "yaml", f->yaml,
		                "usable", f->usable, "notes", notes);
		json_array_append_new(list, one);
	}
	json_t *root = json_pack("{so}", "devices", list);
	int r = root ? json_dumpf(root, stdout, JSON_INDENT(1)) : -1;
	json_decref(root);
	putchar('\n');
	return r;
}

int devices_main(int argc, char **argv)
{
	static const struct argp argp = {options,
	                                 parse_option,
	                                 NULL,
	                                 "Lists what is plugged in that facetd could drive, with the line of "
	                                 "configuration for each, and says why one "
	                                 "of them cannot be opened.",
	                                 NULL,
	                                 NULL,
	                                 NULL};
	static struct found found[USB_LIST_MAX + SERIAL_LIST_MAX + CAN_LIST_MAX];
	static struct can_interface can[CAN_LIST_MAX];
	static struct usb_device usb[USB_LIST_MAX];
	static struct serial_line serial[SERIAL_LIST_MAX];
	bool json = false;
	int n = 0;

	argp_parse(&argp, argc, argv, 0, NULL, &json);
	int usbs = usb_list(COLA_USB_VENDOR, COLA_USB_PRODUCT, usb), serials = serial_list(serial),
	    cans = can_list(can);
	for (int i = 0; i < usbs; i++, n++)
		describe_usb(usb, usbs, i, n, &found[n]);
	for (int i = 0; i < serials; i++, n++)
		describe_serial(serial, serials, i, n, &found[n]);
	for (int i = 0; i < cans; i++, n++)
		describe_can(&can[i], i, &found[n]);
	if (json)
		return print_json(found, n) ? 1 : fflush(stdout) != 0;
	print_text(found, n);
	return fflush(stdout) != 0;
}

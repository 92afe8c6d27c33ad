/* A machine with simulated USB: a umockdev test bed with scanners (usbfs.h) and serial adapters, in which a command runs.
 *   usb_bed [--scanner PORT[=SERIAL]]... [--adapter TTY=SERIAL]... [--locked] -- COMMAND...
 * An adapter is an FTDI one with a latency timer of 16 ms and, where it has a SERIAL, a name in /dev/serial/by-id.
 * --locked: nobody but root may open what is plugged in. Ends as COMMAND does. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#ifdef HAVE_UMOCKDEV

#include "tests/usbfs.h"

#define SCANNERS_MAX 8
#define CAPS                                                                                             \
	(USBDEVFS_CAP_ZERO_PACKET | USBDEVFS_CAP_NO_PACKET_SIZE_LIM | USBDEVFS_CAP_BULK_SCATTER_GATHER | \
	 USBDEVFS_CAP_REAP_AFTER_DISCONNECT)

static struct usbfs scanner[SCANNERS_MAX];
static int scanners, adapters;

static void set_mode(UMockdevTestbed *bed, const char *path, mode_t mode)
{
	char whole[256], *root = umockdev_testbed_get_root_dir(bed);

	snprintf(whole, sizeof(whole), "%s%s", root, path);
	if (chmod(whole, mode) < 0)
		abort();
	g_free(root);
}

/* The preload connects to the ioctl's socket even where opening failed, and gives up where it may not. */
static void lock_node(UMockdevTestbed *bed, const char *node)
{
	char emulation[128];

	snprintf(emulation, sizeof(emulation), "/ioctl%s", node);
	set_mode(bed, node, 0600);
	set_mode(bed, emulation, 0777);
	set_mode(bed, "", 0755);
}

/* PORT[=SERIAL] */
static void add_scanner(UMockdevTestbed *bed, char *text)
{
	char *serial = strchr(text, '=');

	if (serial)
		*serial++ = 0;
	usbfs_plug(&scanner[scanners], bed, text, 10 + (unsigned)scanners, serial, CAPS);
	scanners++;
}

static void add_by_id(UMockdevTestbed *bed, const char *tty, const char *serial)
{
	char path[256], target[64], *root = umockdev_testbed_get_root_dir(bed);

	snprintf(path, sizeof(path), "%s/dev/serial", root);
	mkdir(path, 0755);
	snprintf(path, sizeof(path), "%s/dev/serial/by-id", root);
	mkdir(path, 0755);
	snprintf(path, sizeof(path), "%s/dev/serial/by-id/usb-FTDI_FT232R_USB_UART_%s-if00-port0", root, serial);
	snprintf(target, sizeof(target), "../../%s", tty);
	if (symlink(target, path) < 0)
		abort();
	g_free(root);
}

/* TTY=SERIAL */
static void add_adapter(UMockdevTestbed *bed, char *text)
{
	char add[1024], port[16], *serial = strchr(text, '=');

	if (!serial)
		abort();
	*serial++ = 0;
	snprintf(port, sizeof(port), "1-%d", 20 + adapters++);
	snprintf(add, sizeof(add),
	         "P: /devices/usb1/%s/%s:1.0/%s/tty/%s\nN: %s\nE: DEVNAME=/dev/%s\nE: SUBSYSTEM=tty\nL: "
	         "device=../../../%s\n\n"
	         "P: /devices/usb1/%s/%s:1.0/%s\nE: SUBSYSTEM=usb-serial\nE: DRIVER=ftdi_sio\n"
	         "L: driver=../../../../../bus/usb-serial/drivers/ftdi_sio\nA: latency_timer=16\\n\n\n"
	         "P: /devices/usb1/%s\nE: DEVTYPE=usb_device\nE: SUBSYSTEM=usb\nA: busnum=1\\n\nA: devnum=99\\n\nA: "
	         "speed=12\\n\n"
	         "A: idVendor=0403\\n\nA: idProduct=6001\\n\nA: manufacturer=FTDI\\n\nA: product=FT232R USB UART\\n\n"
	         "A: serial=%s\\n\n",
	         port, port, text, text, text, text, text, port, port, text, port, serial);
	if (!umockdev_testbed_add_from_string(bed, add, NULL))
		abort();
	if (serial[0])
		add_by_id(bed, text, serial);
}

static int run(char **command)
{
	int status = 0;
	pid_t pid = fork();

	if (pid == 0) {
		execvp(command[0], command);
		perror(command[0]);
		_exit(127);
	}
	waitpid(pid, &status, 0);
	return WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
}

int main(int argc, char **argv)
{
	const char *preloaded = getenv("LD_PRELOAD");
	bool locked = false;
	int at = 1;

	if (!preloaded || !strstr(preloaded, "umockdev")) {
		char *again[64] = {"umockdev-wrapper"};

		for (int i = 0; i < argc && i < 62; i++)
			again[i + 1] = argv[i];
		execvp(again[0], again);
		printf("umockdev-wrapper is not here: install the package umockdev (make deps)\n");
		return 77;
	}
	UMockdevTestbed *bed = umockdev_testbed_new();
	usbfs_bus(bed);
	for (; at < argc && strcmp(argv[at], "--") != 0; at++) {
		if (strcmp(argv[at], "--locked") == 0)
			locked = true;
		else if (strcmp(argv[at], "--scanner") == 0 && at + 1 < argc && scanners < SCANNERS_MAX)
			add_scanner(bed, argv[++at]);
		else if (strcmp(argv[at], "--adapter") == 0 && at + 1 < argc)
			add_adapter(bed, argv[++at]);
		else
			return 2;
	}
	for (int i = 0; locked && i < scanners; i++)
		lock_node(bed, scanner[i].node);
	int status = at + 1 < argc ? run(argv + at + 1) : 2;
	for (int i = 0; i < scanners; i++)
		usbfs_finish(&scanner[i]);
	g_object_unref(bed);
	return status;
}

#else

int main(void)
{
	printf("built without libumockdev: install libumockdev-dev (make deps)\n");
	return 77;
}

#endif

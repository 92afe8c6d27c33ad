/* A machine with simulated USB: a umockdev test bed with scanners and serial adapters, in which a command runs.
 *   usb_bed [--scanner PORT[=SERIAL]]... [--adapter TTY=SERIAL]... [--can NAME=FLAGS,STATE,MTU]... [--locked]
 *           [--unplug AT,FOR] [--halt AT] -- COMMAND...
 * A scanner is a simulated usbfs (usbfs.h) before the simulated TiM561's brain (sim_cola.c), which stands in a room. An
 * adapter is an FTDI one with a latency timer of 16 ms and, where it has a SERIAL, a name in /dev/serial/by-id. --locked:
 * nobody but root may open what is plugged in. --unplug, --halt: the first scanner, seconds after COMMAND began; back it
 * comes with another address. Says `bed: WHAT at SECONDS` of what it did. Ends as COMMAND does. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#ifdef HAVE_UMOCKDEV

#include <signal.h>
#include <sys/prctl.h>
#include <time.h>

#include "tests/usbfs.h"
#include "tools/sim_device.h"

#define SCANNERS_MAX 8
#define PIECES_MAX   4 /* that wait for somebody to read them; more are dropped, as the scanner does */
#define CAPS                                                                                             \
	(USBDEVFS_CAP_ZERO_PACKET | USBDEVFS_CAP_NO_PACKET_SIZE_LIM | USBDEVFS_CAP_BULK_SCATTER_GATHER | \
	 USBDEVFS_CAP_REAP_AFTER_DISCONNECT)

/* The port and the brain behind it. The brain is entered by two threads: ours, and umockdev's with what was written. */
struct scanner {
	struct usbfs usb;
	char port[32], serial[32];
	struct sim_device brain;
	pthread_mutex_t lock;
	bool connected, asked;
	double plugged_s;
};

static struct scanner scanner[SCANNERS_MAX];
static int scanners, adapters;
static int64_t begin_ns;

static int64_t now_ns(void)
{
	struct timespec now;

	clock_gettime(CLOCK_MONOTONIC, &now);
	return now.tv_sec * 1000000000ll + now.tv_nsec;
}

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

/* A room of 8 m by 6 m, the scanner in its middle. */
static void scan_room(void *ctx, struct profile *profile)
{
	(void)ctx;
	for (int i = 0; i < profile->n; i++) {
		double bearing = profile->first_rad + i * profile->step_rad;
		double x = 4 / fmax(fabs(cos(bearing)), 1e-9), y = 3 / fmax(fabs(sin(bearing)), 1e-9);

		profile->range_m[i] = (float)fmin(x, y);
		profile->state[i] = BEAM_OK;
	}
}

static double now_s(void)
{
	return (double)(now_ns() - begin_ns) / 1e9;
}

static void hear(void *ctx, const uint8_t *bytes, size_t len)
{
	struct scanner *s = ctx;

	if (!s->asked)
		printf("bed: first request of %s after %.3f\n", s->port, now_s() - s->plugged_s);
	s->asked = true;

	pthread_mutex_lock(&s->lock);
	s->brain.receive(s->brain.ctx, bytes, len, now_ns());
	pthread_mutex_unlock(&s->lock);
}

static void plug(struct scanner *s, UMockdevTestbed *bed)
{
	static unsigned address = 10;

	usbfs_plug(&s->usb, bed, s->port, address++, s->serial[0] ? s->serial : NULL, CAPS);
	s->usb.ctx = s;
	s->usb.written = hear;
	s->asked = false;
	s->plugged_s = now_s();
}

/* PORT[=SERIAL] */
static void add_scanner(UMockdevTestbed *bed, const char *text)
{
	struct scanner *s = &scanner[scanners++];
	const struct scene room = {.scan = scan_room};

	if (sscanf(text, "%31[^=]=%31s", s->port, s->serial) < 1)
		abort();
	struct sim_cola_params params = {.model = SIM_TIM561, .serial = (uint32_t)strtoul(s->serial, NULL, 10)};
	pthread_mutex_init(&s->lock, NULL);
	if (sim_cola_create(&params, &room, now_ns(), &s->brain) < 0)
		abort();
	plug(s, bed);
}

static bool is_claimed(struct usbfs *usb, bool *ret_full)
{
	int waiting = 0;

	pthread_mutex_lock(&usb->lock);
	for (struct usbfs_piece *piece = usb->first; piece; piece = piece->next)
		waiting++;
	*ret_full = waiting >= PIECES_MAX;
	bool claimed = usb->claimed && !usb->gone;
	pthread_mutex_unlock(&usb->lock);
	return claimed;
}

/* What is due by now: time for the brain, its bytes to the port. */
static void serve(struct scanner *s)
{
	static uint8_t bytes[65536];
	bool full = false, claimed = is_claimed(&s->usb, &full);
	size_t n;

	pthread_mutex_lock(&s->lock);
	if (claimed != s->connected)
		s->brain.connected(s->brain.ctx, claimed, now_ns());
	s->connected = claimed;
	s->brain.advance(s->brain.ctx, now_ns());
	while ((n = s->brain.transmit(s->brain.ctx, bytes, sizeof(bytes))) > 0)
		if (claimed && !full)
			usbfs_send(&s->usb, bytes, n, true);
	pthread_mutex_unlock(&s->lock);
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

/* NAME=FLAGS,STATE,MTU as in sysfs; one whose name begins with v is virtual. */
static void add_can(UMockdevTestbed *bed, const char *text)
{
	char add[512], name[16], state[16];
	unsigned flags;
	int mtu;

	if (sscanf(text, "%15[^=]=%x,%15[^,],%d", name, &flags, state, &mtu) != 4)
		abort();
	snprintf(add, sizeof(add),
	         "P: /devices/%s/net/%s\nE: SUBSYSTEM=net\nA: type=280\\n\nA: flags=0x%x\\n\nA: operstate=%s\\n\nA: "
	         "mtu=%d\\n\n%s\n",
	         *name == 'v' ? "virtual" : "pci0000:00/0000:00:03.0", name, flags, state, mtu,
	         *name == 'v' ? "" : "L: device=../../../0000:00:03.0\n");
	if (!umockdev_testbed_add_from_string(bed, add, NULL))
		abort();
	if (*name != 'v' &&
	    !umockdev_testbed_add_from_string(bed,
	                                      "P: /devices/pci0000:00/0000:00:03.0\nE: SUBSYSTEM=pci\n"
	                                      "E: DRIVER=kvaser_pci\nL: driver=../../../bus/pci/drivers/kvaser_pci\n",
	                                      NULL))
		abort();
}

struct orders {
	double unplug_s, away_s, halt_s; /* -1: not ordered, or done */
};

static void obey(struct orders *orders, UMockdevTestbed *bed, double t_s)
{
	if (orders->halt_s >= 0 && t_s >= orders->halt_s) {
		usbfs_halt(&scanner[0].usb, 0);
		orders->halt_s = -1;
		printf("bed: halted at %.3f\n", t_s);
	}
	if (orders->unplug_s >= 0 && t_s >= orders->unplug_s && !scanner[0].usb.gone) {
		usbfs_unplug(&scanner[0].usb, ENODEV);
		printf("bed: unplugged at %.3f\n", t_s);
	}
	if (orders->unplug_s >= 0 && t_s >= orders->unplug_s + orders->away_s) {
		usbfs_finish(&scanner[0].usb);
		plug(&scanner[0], bed);
		orders->unplug_s = -1;
		printf("bed: plugged in at %.3f\n", t_s);
	}
}

static int run(char **command, UMockdevTestbed *bed, struct orders *orders)
{
	const struct timespec turn = {.tv_nsec = 1000000};
	int status = 0;
	pid_t pid = fork();

	if (pid == 0) {
		prctl(PR_SET_PDEATHSIG, SIGKILL);
		execvp(command[0], command);
		perror(command[0]);
		_exit(127);
	}
	while (waitpid(pid, &status, WNOHANG) == 0) {
		for (int i = 0; i < scanners; i++)
			serve(&scanner[i]);
		if (scanners)
			obey(orders, bed, now_s());
		nanosleep(&turn, NULL);
	}
	return WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
}

static void run_again_wrapped(int argc, char **argv)
{
	static char wrapper[] = "umockdev-wrapper";
	char *again[64] = {wrapper};

	for (int i = 0; i < argc && i < 62; i++)
		again[i + 1] = argv[i];
	execvp(again[0], again);
	printf("umockdev-wrapper is not here: install the package umockdev (make deps)\n");
	exit(77);
}

static void finish(UMockdevTestbed *bed)
{
	for (int i = 0; i < scanners; i++) {
		usbfs_finish(&scanner[i].usb);
		scanner[i].brain.destroy(scanner[i].brain.ctx);
	}
	g_object_unref(bed);
}

int main(int argc, char **argv)
{
	struct orders orders = {-1, 0, -1};
	const char *preloaded = getenv("LD_PRELOAD");
	bool locked = false;
	int at = 1;

	setlinebuf(stdout);
	begin_ns = now_ns();
	if (!preloaded || !strstr(preloaded, "umockdev"))
		run_again_wrapped(argc, argv);
	UMockdevTestbed *bed = umockdev_testbed_new();
	usbfs_bus(bed);
	for (; at < argc && strcmp(argv[at], "--") != 0; at++) {
		if (strcmp(argv[at], "--locked") == 0)
			locked = true;
		else if (strcmp(argv[at], "--scanner") == 0 && at + 1 < argc && scanners < SCANNERS_MAX)
			add_scanner(bed, argv[++at]);
		else if (strcmp(argv[at], "--adapter") == 0 && at + 1 < argc)
			add_adapter(bed, argv[++at]);
		else if (strcmp(argv[at], "--can") == 0 && at + 1 < argc)
			add_can(bed, argv[++at]);
		else if (strcmp(argv[at], "--halt") == 0 && at + 1 < argc)
			orders.halt_s = atof(argv[++at]);
		else if (strcmp(argv[at], "--unplug") != 0 || at + 1 >= argc ||
		         sscanf(argv[++at], "%lf,%lf", &orders.unplug_s, &orders.away_s) != 2)
			return 2;
	}
	for (int i = 0; locked && i < scanners; i++)
		lock_node(bed, scanner[i].usb.node);
	int status = at + 1 < argc ? run(argv + at + 1, bed, &orders) : 2;
	finish(bed);
	return status;
}

#else

int main(void)
{
	printf("built without libumockdev: install libumockdev-dev (make deps)\n");
	return 77;
}

#endif

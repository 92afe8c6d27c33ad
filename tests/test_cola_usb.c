/* Law: a scanner on USB is a byte stream that loses, doubles and swaps nothing, never makes the loop wait, and says in one
 * sentence why it is not there. Real libusb against a simulated usbfs (usbfs.h), under umockdev-wrapper. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include <cmocka.h>

#if defined(HAVE_USB) && defined(HAVE_UMOCKDEV)

#include <grp.h>
#include <poll.h>
#include <sys/wait.h>
#include <time.h>

#include "drivers/cola.h"
#include "drivers/usb_list.h"
#include "tests/usbfs.h"

#define CAPS_MODERN                                                                                      \
	(USBDEVFS_CAP_ZERO_PACKET | USBDEVFS_CAP_NO_PACKET_SIZE_LIM | USBDEVFS_CAP_BULK_SCATTER_GATHER | \
	 USBDEVFS_CAP_REAP_AFTER_DISCONNECT)
#define CAPS_SPLIT  (USBDEVFS_CAP_ZERO_PACKET | USBDEVFS_CAP_BULK_CONTINUATION) /* URBs of 16 KB */
#define PATIENCE_MS 120000

static UMockdevTestbed *bed;
static struct usbfs scanner, twin;

static int plug_one(void **state)
{
	(void)state;
	bed = umockdev_testbed_new();
	usbfs_bus(bed);
	usbfs_plug(&scanner, bed, "1-1", 2, "16160456", CAPS_MODERN);
	return 0;
}

static int plug_split(void **state)
{
	plug_one(state);
	scanner.caps = CAPS_SPLIT;
	return 0;
}

static int plug_twins(void **state)
{
	plug_one(state);
	usbfs_plug(&twin, bed, "1-2.10", 3, "18220118", CAPS_MODERN);
	return 0;
}

static int unplug(void **state)
{
	(void)state;
	usbfs_finish(&scanner);
	if (twin.bed)
		usbfs_finish(&twin);
	memset(&twin, 0, sizeof(twin));
	g_clear_object(&bed);
	return 0;
}

static struct link *open_scanner(const char *connect, char error[160])
{
	struct config_device device = {.name = "laser", .driver = "tim"};

	snprintf(device.connect, sizeof(device.connect), "%s", connect);
	error[0] = 0;
	return cola_usb.open(&device, error);
}

static struct link *open_or_fail(const char *connect)
{
	char error[160];
	struct link *link = open_scanner(connect, error);

	if (!link)
		fail_msg("%s", error);
	return link;
}

static int64_t now_ms(void)
{
	struct timespec now;

	clock_gettime(CLOCK_MONOTONIC, &now);
	return now.tv_sec * 1000 + now.tv_nsec / 1000000;
}

/* Reads as the loop does: only when the descriptor says so. The bytes, fewer at the end of patience, or -errno. */
static ssize_t read_bytes(struct link *link, uint8_t *buf, size_t wanted, size_t chunk)
{
	int64_t until = now_ms() + PATIENCE_MS, t_ns = 0;
	size_t n = 0;

	while (n < wanted && now_ms() < until) {
		struct pollfd ready = {.fd = cola_usb.fd(link), .events = POLLIN};

		if (poll(&ready, 1, 100) <= 0)
			continue;
		ssize_t got = cola_usb.read(link, buf + n, wanted - n < chunk ? wanted - n : chunk, &t_ns);
		if (got < 0)
			return n > 0 ? (ssize_t)n : got;
		n += (size_t)got;
	}
	return (ssize_t)n;
}

/* Reads until the device is lost: -errno, or 0 at the end of patience. */
static ssize_t read_loss(struct link *link)
{
	uint8_t byte[64];
	ssize_t n;

	do
		n = read_bytes(link, byte, 1, 1);
	while (n > 0);
	return n;
}

static void fill(uint8_t *bytes, size_t len, uint32_t seed)
{
	for (size_t i = 0; i < len; i++) {
		seed = seed * 1664525u + 1013904223u;
		bytes[i] = (uint8_t)(seed >> 24);
	}
}

/* What was written */

static uint8_t heard[4096];
static size_t heard_len;

static void hear(void *ctx, const uint8_t *bytes, size_t len)
{
	(void)ctx;
	assert(heard_len + len <= sizeof(heard));
	memcpy(heard + heard_len, bytes, len);
	heard_len += len;
}

static size_t write_all(struct link *link, const void *bytes, size_t len)
{
	int64_t until = now_ms() + PATIENCE_MS, t_ns;
	size_t n = 0;

	while (n < len && now_ms() < until) {
		uint8_t buf[64];
		ssize_t taken = cola_usb.write(link, (const uint8_t *)bytes + n, len - n);

		assert_true(taken >= 0);
		n += (size_t)taken;
		assert_true(cola_usb.read(link, buf, sizeof(buf), &t_ns) >= 0);
	}
	return n;
}

static void requests_arrive_as_they_were_written(void **state)
{
	static const char request[] = "\x02sEN LMDscandata 1\x03";
	struct link *link = open_or_fail("usb");
	uint8_t long_request[512];

	(void)state;
	heard_len = 0;
	scanner.written = hear;
	assert_int_equal(write_all(link, request, sizeof(request) - 1), sizeof(request) - 1);
	assert_int_equal(write_all(link, "\x02sRN DeviceIdent\x03", 17), 17);
	fill(long_request, sizeof(long_request), 1);
	assert_int_equal(write_all(link, long_request, sizeof(long_request)), sizeof(long_request));
	cola_usb.close(link);
	assert_int_equal(heard_len, sizeof(request) - 1 + 17 + sizeof(long_request));
	assert_memory_equal(heard, request, sizeof(request) - 1);
	assert_memory_equal(heard + sizeof(request) - 1, "\x02sRN DeviceIdent\x03", 17);
	assert_memory_equal(heard + sizeof(request) - 1 + 17, long_request, sizeof(long_request));
	/* The last filled its packets: its end is told by an empty one. */
	assert_int_equal(scanner.count.empty_packets, 1);
}

/* What is read */

static void a_telegram_arrives_whole_whatever_the_transfers(void **state)
{
	static const size_t sizes[] = {1,    63,    64,    65,    511,   512,   513,   1119,
	                               3250, 16384, 20000, 65535, 65536, 65537, 150000};
	static uint8_t sent[150000], got[150000];

	(void)state;
	struct link *link = open_or_fail("usb");
	for (size_t i = 0; i < sizeof(sizes) / sizeof(*sizes); i++) {
		fill(sent, sizes[i], (uint32_t)i);
		usbfs_send(&scanner, sent, sizes[i], true);
		assert_int_equal(read_bytes(link, got, sizes[i], sizeof(got)), sizes[i]);
		assert_memory_equal(got, sent, sizes[i]);
	}
	cola_usb.close(link);
}

/* Cut anywhere, glued, packets without bytes between; read in turns of 4096 as the supervisor does, or of 7. */
static void stream_in_pieces(size_t chunk, size_t total)
{
	uint8_t *sent = malloc(total), *got = calloc(1, total);
	struct link *link = open_or_fail("usb");
	uint32_t seed = 4711;
	ssize_t n;

	assert_true(sent && got);
	fill(sent, total, 3);
	for (size_t at = 0; at < total;) {
		seed = seed * 1664525u + 1013904223u;
		size_t piece = seed >> 28 == 0 ? 0 : (seed >> 8) % 5000 + 1;
		if (piece > total - at)
			piece = total - at;
		usbfs_send(&scanner, sent + at, piece, (seed & 0x700) != 0 || at + piece == total);
		at += piece;
	}
	n = read_bytes(link, got, total, chunk);
	assert_int_equal(n, total);
	assert_memory_equal(got, sent, total);
	cola_usb.close(link);
	free(sent);
	free(got);
}

static void pieces_are_one_stream(void **state)
{
	(void)state;
	stream_in_pieces(4096, 600000);
}

static void a_small_buffer_gets_everything(void **state)
{
	(void)state;
	stream_in_pieces(7, 20000);
}

static void transfers_are_always_in_flight(void **state)
{
	struct link *link = open_or_fail("usb");
	uint8_t byte[16];

	(void)state;
	for (int i = 0; i < 20; i++) {
		usbfs_send(&scanner, "telegram", 8, true);
		assert_int_equal(read_bytes(link, byte, 8, sizeof(byte)), 8);
		pthread_mutex_lock(&scanner.lock);
		assert_int_equal(scanner.ins, 4);
		pthread_mutex_unlock(&scanner.lock);
	}
	assert_int_equal(scanner.count.flying_peak, 4);
	cola_usb.close(link);
	assert_int_equal(scanner.count.released, 1);
}

/* A telegram that fills its last packet and gets no empty one behind it: the transfer never ends by itself. */
static void what_a_timed_out_transfer_brought_is_kept(void **state)
{
	uint8_t sent[1024], got[1024];
	struct link *link = open_or_fail("usb");

	(void)state;
	fill(sent, sizeof(sent), 5);
	usbfs_send(&scanner, sent, sizeof(sent), false);
	assert_int_equal(read_bytes(link, got, sizeof(got), sizeof(got)), sizeof(got));
	assert_memory_equal(got, sent, sizeof(sent));
	assert_true(scanner.count.discarded > 0);
	cola_usb.close(link);
}

static void a_slow_reader_costs_no_memory(void **state)
{
	static uint8_t sent[1 << 20], got[1 << 20];
	struct link *link = open_or_fail("usb");
	int64_t t_ns;

	(void)state;
	fill(sent, sizeof(sent), 6);
	for (size_t at = 0; at < sizeof(sent); at += 4096)
		usbfs_send(&scanner, sent + at, 4096, true);
	/* One read handles what is there, and takes 1 byte; nothing more is asked of the device. */
	for (int i = 0; i < 3; i++)
		assert_int_equal(cola_usb.read(link, got + i, 1, &t_ns), 1);
	pthread_mutex_lock(&scanner.lock);
	assert_true(scanner.count.submitted <= 5);
	pthread_mutex_unlock(&scanner.lock);
	assert_int_equal(read_bytes(link, got + 3, sizeof(got) - 3, 4096), sizeof(got) - 3);
	assert_memory_equal(got, sent, sizeof(sent));
	cola_usb.close(link);
}

/* Faults */

static void a_halt_is_cleared_and_the_stream_goes_on(void **state)
{
	uint8_t got[32];
	struct link *link = open_or_fail("usb");

	(void)state;
	for (int i = 0; i < 10; i++) {
		usbfs_send(&scanner, "before", 6, true);
		usbfs_halt(&scanner, 0);
		usbfs_send(&scanner, "behind", 6, true);
		assert_int_equal(read_bytes(link, got, 12, sizeof(got)), 12);
		assert_memory_equal(got, "beforebehind", 12);
	}
	assert_int_equal(scanner.count.halts_cleared, 10);
	assert_int_equal(scanner.count.cleared_in_flight, 0);
	cola_usb.close(link);
}

static void a_halt_that_stays_is_a_lost_device(void **state)
{
	struct link *link = open_or_fail("usb");
	char error[160];

	(void)state;
	usbfs_halt(&scanner, 1000);
	assert_int_equal(read_loss(link), -EPIPE);
	assert_int_equal(cola_usb.write(link, (const uint8_t *)"x", 1), -EPIPE);
	assert_true(scanner.count.halts_cleared < 10);
	cola_usb.error(link, EPIPE, error);
	assert_non_null(strstr(error, "usb:1-1"));
	cola_usb.close(link);
}

static void pull_and_plug(int ends_with)
{
	uint8_t got[64];
	char error[160];
	struct link *link = open_or_fail("usb:16160456");

	usbfs_send(&scanner, "last words", 10, true);
	usbfs_unplug(&scanner, ends_with);
	assert_int_equal(read_bytes(link, got, sizeof(got), sizeof(got)), 10);
	assert_memory_equal(got, "last words", 10);
	assert_int_equal(read_loss(link), -ENODEV);
	cola_usb.error(link, ENODEV, error);
	assert_string_equal(error, "the scanner at usb:1-1 is gone: unplugged, without power, or restarted");
	cola_usb.close(link);
	assert_null(open_scanner("usb:16160456", error));
	assert_string_equal(error, "usb:16160456: no scanner is plugged in on USB; plug it in and switch it on");
	usbfs_finish(&scanner);

	usbfs_plug(&scanner, bed, "1-4", 9, "16160456", CAPS_MODERN); /* another port, another address */
	link = open_or_fail("usb:16160456");
	usbfs_send(&scanner, "back", 4, true);
	assert_int_equal(read_bytes(link, got, 4, sizeof(got)), 4);
	cola_usb.close(link);
}

static void a_pulled_scanner_is_lost_and_comes_back(void **state)
{
	(void)state;
	pull_and_plug(ENODEV);
}

static void an_io_error_is_a_pulled_scanner(void **state)
{
	(void)state;
	pull_and_plug(EPROTO);
}

static void a_scanner_that_takes_no_requests_is_lost(void **state)
{
	struct link *link = open_or_fail("usb");
	char error[160];

	(void)state;
	scanner.deaf = true;
	assert_int_equal(cola_usb.write(link, (const uint8_t *)"hello", 5), 5);
	assert_int_equal(cola_usb.write(link, (const uint8_t *)"again", 5), 0); /* never waits */
	assert_int_equal(read_loss(link), -ETIMEDOUT);
	cola_usb.error(link, ETIMEDOUT, error);
	assert_non_null(strstr(error, "takes no requests"));
	cola_usb.close(link);
}

/* The kernel does not give the transfers back: the loop goes on all the same. */
static void closing_waits_for_nobody(void **state)
{
	struct link *link = open_or_fail("usb");

	(void)state;
	scanner.hangs = true;
	int64_t begin_ms = now_ms();
	cola_usb.close(link);
	int64_t took_ms = now_ms() - begin_ms;
	printf("note: closing a scanner that hangs took %d ms\n", (int)took_ms);
	assert_true(took_ms < 1000);
}

static void a_kernel_driver_is_detached(void **state)
{
	(void)state;
	strcpy(scanner.kernel_driver, "usbserial_generic");
	struct link *link = open_or_fail("usb");
	assert_int_equal(scanner.count.detached, 1);
	cola_usb.close(link);
}

static void who_drives_it_already_is_not_pushed_aside(void **state)
{
	char error[160];

	(void)state;
	scanner.busy = true;
	assert_null(open_scanner("usb", error));
	assert_string_equal(error, "usb:1-1: another program drives this scanner; stop that one");
	scanner.busy = false;
	cola_usb.close(open_or_fail("usb"));
}

/* Opening and closing without end leaves nothing behind. */
static void descriptors_are_given_back(void **state)
{
	int before, after;

	(void)state;
	cola_usb.close(open_or_fail("usb"));
	before = dup(0);
	close(before);
	for (int i = 0; i < 20; i++)
		cola_usb.close(open_or_fail("usb"));
	after = dup(0);
	close(after);
	assert_int_equal(before, after);
}

/* Which one */

static void twins_are_told_apart(void **state)
{
	uint8_t got[16];
	char error[160];

	(void)state;
	assert_null(open_scanner("usb", error));
	assert_string_equal(error,
	                    "2 scanners are plugged in; write one of these as `connect`: usb:16160456, usb:18220118");
	assert_null(open_scanner("usb:4711", error));
	assert_string_equal(
	    error,
	    "usb:4711: this scanner is not plugged in (usb:16160456 is, and others); `facet devices` lists them");
	usbfs_send(&scanner, "one", 3, true);
	usbfs_send(&twin, "two", 3, true);
	for (int i = 0; i < 2; i++) {
		struct link *second = open_or_fail(i ? "usb:18220118" : "usb:1-2.10");
		struct link *first = open_or_fail(i ? "usb:16160456" : "usb:1-1");

		if (i == 0) {
			assert_int_equal(read_bytes(second, got, 3, sizeof(got)), 3);
			assert_memory_equal(got, "two", 3);
			assert_int_equal(read_bytes(first, got, 3, sizeof(got)), 3);
			assert_memory_equal(got, "one", 3);
		}
		cola_usb.close(first);
		cola_usb.close(second);
	}
}

static void the_list_reads_what_the_kernel_read(void **state)
{
	struct usb_device list[USB_LIST_MAX];

	(void)state;
	assert_int_equal(usb_list(0x19a2, 0x5001, list), 2);
	assert_string_equal(list[0].port, "1-1");
	assert_string_equal(list[0].serial, "16160456");
	assert_string_equal(list[0].product, "TiM561");
	assert_string_equal(list[0].node, "/dev/bus/usb/001/002");
	assert_string_equal(list[1].port, "1-2.10");
	assert_int_equal(list[1].address, 3);
	assert_int_equal(usb_list(0x19a2, 0x5002, list), 0);
}

static struct usb_device device(const char *port, const char *serial)
{
	struct usb_device ret = {.bus = 1};

	snprintf(ret.port, sizeof(ret.port), "%s", port);
	snprintf(ret.serial, sizeof(ret.serial), "%s", serial);
	return ret;
}

static void a_serial_number_of_several_is_no_name(void **state)
{
	const struct usb_device list[] = {device("1-1", "0000"), device("1-2", "0000"), device("2-1", ""),
	                                  device("2-2", "x: y")};
	char error[160];

	(void)state;
	assert_int_equal(usb_list_choose(list, 4, "usb:0000", error), -1);
	assert_string_equal(error,
	                    "2 scanners have this serial number; write one of these as `connect`: usb:1-1, usb:1-2");
	assert_int_equal(usb_list_choose(list, 4, "usb:1-2", error), 1);
	assert_string_equal(usb_list_name(list, 4, 0), "1-1");
	assert_string_equal(usb_list_name(list, 4, 2), "2-1");
	assert_string_equal(usb_list_name(list, 4, 3), "2-2"); /* would not be one word of YAML */
	assert_int_equal(usb_list_choose(list, 4, "usb:", error), -1);
	assert_int_equal(usb_list_choose(list + 2, 1, "usb", error), 0);
}

/* usb_list_explain as an ordinary user whose group is `gid`, whoever runs the test. */
static void explain_as_nobody(const char *node, gid_t gid, char why[160])
{
	int ends[2];

	assert_int_equal(pipe(ends), 0);
	pid_t pid = fork();
	if (pid == 0) {
		char text[160] = "";

		if (setgroups(0, NULL) == 0 && setgid(gid) == 0 && setuid(65534) == 0)
			usb_list_explain(node, EACCES, "install the rule", text);
		_exit(write(ends[1], text, sizeof(text)) != sizeof(text));
	}
	assert_int_equal(read(ends[0], why, 160), 160);
	waitpid(pid, NULL, 0);
	close(ends[0]);
	close(ends[1]);
}

static void a_missing_permission_says_what_to_do(void **state)
{
	char node[] = "/tmp/facet_node_XXXXXX", why[160], wanted[160];
	int fd = mkstemp(node);

	(void)state;
	if (geteuid() != 0) {
		close(fd);
		unlink(node);
		print_message("not root: a missing permission is not tried\n");
		return;
	}
	assert_true(fd >= 0 && fchmod(fd, 0660) == 0 && fchown(fd, 0, 20) == 0);
	explain_as_nobody(node, 65534, why);
	snprintf(wanted, sizeof(wanted),
	         "%s: no permission; group dialout has it: sudo usermod -aG dialout $USER, then log in again", node);
	assert_string_equal(why, wanted);
	explain_as_nobody(node, 20, why);
	assert_non_null(strstr(why, "though group dialout has it"));
	assert_int_equal(fchown(fd, 0, 0), 0);
	explain_as_nobody(node, 65534, why);
	snprintf(wanted, sizeof(wanted), "%s: no permission, and no group has it; install the rule", node);
	assert_string_equal(why, wanted);
	close(fd);
	unlink(node);
}

#define ON(SETUP, TEST) cmocka_unit_test_setup_teardown(TEST, SETUP, unplug)

int main(int argc, char **argv)
{
	const struct CMUnitTest tests[] = {
	    ON(plug_one, requests_arrive_as_they_were_written),
	    ON(plug_one, a_telegram_arrives_whole_whatever_the_transfers),
	    ON(plug_split, a_telegram_arrives_whole_whatever_the_transfers),
	    ON(plug_one, pieces_are_one_stream),
	    ON(plug_split, pieces_are_one_stream),
	    ON(plug_one, a_small_buffer_gets_everything),
	    ON(plug_one, transfers_are_always_in_flight),
	    ON(plug_one, what_a_timed_out_transfer_brought_is_kept),
	    ON(plug_split, what_a_timed_out_transfer_brought_is_kept),
	    ON(plug_one, a_slow_reader_costs_no_memory),
	    ON(plug_one, a_halt_is_cleared_and_the_stream_goes_on),
	    ON(plug_one, a_halt_that_stays_is_a_lost_device),
	    ON(plug_one, a_pulled_scanner_is_lost_and_comes_back),
	    ON(plug_one, an_io_error_is_a_pulled_scanner),
	    ON(plug_one, a_scanner_that_takes_no_requests_is_lost),
	    ON(plug_one, closing_waits_for_nobody),
	    ON(plug_one, a_kernel_driver_is_detached),
	    ON(plug_one, who_drives_it_already_is_not_pushed_aside),
	    ON(plug_one, descriptors_are_given_back),
	    ON(plug_twins, twins_are_told_apart),
	    ON(plug_twins, the_list_reads_what_the_kernel_read),
	    cmocka_unit_test(a_serial_number_of_several_is_no_name),
	    cmocka_unit_test(a_missing_permission_says_what_to_do),
	};

	(void)argc;
	const char *preloaded = getenv("LD_PRELOAD");
	if (!preloaded || !strstr(preloaded, "umockdev")) {
		static char wrapper[] = "umockdev-wrapper";
		execvp(wrapper, (char *[]){wrapper, argv[0], NULL});
		printf("umockdev-wrapper is not here: install the package umockdev (make deps)\n");
		return 77;
	}
	return cmocka_run_group_tests(tests, NULL, NULL);
}

#else

int main(void)
{
	printf("built without libusb or umockdev: install libusb-1.0-0-dev and libumockdev-dev (make deps)\n");
	return 77;
}

#endif

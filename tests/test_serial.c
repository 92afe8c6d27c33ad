/* Law: what is wrong with a port is one sentence that names it and says what to do; a line is raw, and its rate is read back. */
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <termios.h>
#include <unistd.h>

#include <cmocka.h>

#include "drivers/serial.h"

static int make_pty(char path[64])
{
	const int master = posix_openpt(O_RDWR | O_NOCTTY);
	assert_true(master >= 0 && grantpt(master) == 0 && unlockpt(master) == 0);
	assert_int_equal(ptsname_r(master, path, 64), 0);
	return master;
}

/* serial_open as an ordinary user, whoever runs the test. The error and the sentence. */
static int open_as_nobody(const char *path, char error[160])
{
	int ends[2];
	struct {
		int r;
		char error[160];
	} got = {.r = 1};
	assert_int_equal(pipe(ends), 0);
	const pid_t pid = fork();
	if (pid == 0) {
		if (geteuid() != 0 || setuid(65534) == 0)
			got.r = serial_open(path, got.error);
		_exit(write(ends[1], &got, sizeof got) != sizeof got);
	}
	assert_int_equal(read(ends[0], &got, sizeof got), sizeof got);
	waitpid(pid, NULL, 0);
	close(ends[0]);
	close(ends[1]);
	strcpy(error, got.error);
	return got.r;
}

static void a_missing_port_is_named(void **state)
{
	(void)state;
	char error[160] = "";
	assert_int_equal(serial_open("/dev/facet-no-such", error), -ENOENT);
	assert_string_equal(error, "/dev/facet-no-such: there is no such device; plug it in, or correct `port`");
}

static void what_is_no_serial_line_is_refused(void **state)
{
	(void)state;
	char error[160] = "";
	assert_int_equal(serial_open("/dev/null", error), -ENOTTY);
	assert_string_equal(error, "/dev/null: this is no serial line; correct `port`");
}

static void a_forbidden_port_names_the_group(void **state)
{
	(void)state;
	char path[64], error[160];
	const int master = make_pty(path);
	assert_int_equal(chmod(path, 0), 0);
	assert_int_equal(open_as_nobody(path, error), -EACCES);
	assert_non_null(strstr(error, "group dialout"));
	close(master);
}

static void a_port_in_use_is_said_to_be(void **state)
{
	(void)state;
	char path[64], error[160];
	const int master = make_pty(path);
	const int other = open(path, O_RDWR | O_NOCTTY);
	assert_true(other >= 0 && chmod(path, 0666) == 0 && ioctl(other, TIOCEXCL) == 0);
	assert_int_equal(open_as_nobody(path, error), -EBUSY);
	assert_non_null(strstr(error, "another program"));
	close(other);
	close(master);
}

static void a_line_is_raw_empty_and_has_the_rate_asked_for(void **state)
{
	(void)state;
	static const uint32_t bauds[] = {9600, 19200, 38400, 500000, 123456};
	char path[64], error[160] = "", byte;
	const int master = make_pty(path);
	const int early = open(path, O_RDWR | O_NOCTTY);
	struct termios t;
	assert_int_equal(tcgetattr(early, &t), 0);
	cfmakeraw(&t); /* as a simulator does: a fresh one echoes */
	assert_int_equal(tcsetattr(early, TCSANOW, &t), 0);
	assert_int_equal(write(master, "left over\n", 10), 10);
	assert_int_equal(poll(&(struct pollfd){.fd = early, .events = POLLIN}, 1, 120000), 1);
	const int fd = serial_open(path, error);
	assert_true(fd >= 0);
	assert_int_equal(read(fd, &byte, 1), -1);
	assert_int_equal(errno, EAGAIN);
	for (int i = 0; i < 5; i++) {
		uint32_t got = 0;
		assert_int_equal(serial_set_baud(fd, path, bauds[i], error), 0);
		assert_int_equal(serial_get_rate(master, &got), 0); /* as the simulator sees it */
		assert_int_equal(got, bauds[i]);
	}
	static const uint8_t bytes[] = {0x03, 0x04, 0x0D, 0x11, 0x13, 0x1A, 0x7F, 0xFF, 0x00, 0x0A};
	uint8_t got[sizeof bytes];
	assert_int_equal(write(fd, bytes, sizeof bytes), sizeof bytes);
	assert_int_equal(read(master, got, sizeof got), sizeof got);
	assert_memory_equal(got, bytes, sizeof bytes);
	serial_close(fd);
	close(early);
	close(master);
}

static void a_rate_on_what_is_no_line_is_an_error(void **state)
{
	(void)state;
	char error[160] = "";
	uint32_t baud;
	const int fd = open("/dev/null", O_RDWR);
	assert_true(serial_set_baud(fd, "/dev/null", 9600, error) < 0);
	assert_non_null(strstr(error, "/dev/null: cannot set 9600 Bd"));
	assert_true(serial_get_rate(fd, &baud) < 0);
	close(fd);
}

/* A /sys with adapters in it. */
static char sys[64];

static void put(const char *folder, const char *name, const char *text)
{
	char path[512];
	snprintf(path, sizeof path, "mkdir -p %s/%s", sys, folder);
	assert_int_equal(system(path), 0);
	snprintf(path, sizeof path, "%s/%s/%s", sys, folder, name);
	FILE *file = fopen(path, "w");
	assert_non_null(file);
	fputs(text, file);
	fclose(file);
}

/* The line `name` of the adapter at `place`; usb-serial has one folder more than cdc-acm. */
static void plug(const char *place, const char *vendor, const char *product, const char *serial, const char *name)
{
	char folder[128], path[512];
	snprintf(folder, sizeof folder, "devices/usb1/%s", place);
	put(folder, "idVendor", vendor);
	put(folder, "idProduct", product);
	if (serial != NULL)
		put(folder, "serial", serial);
	snprintf(path, sizeof path,
	         "cd %s && mkdir -p %s/%s:1.0/%s class/tty/%s && ln -s ../../../%s/%s:1.0/%s class/tty/%s/device", sys,
	         folder, place, name, name, folder, place, strstr(name, "ACM") ? "." : name, name);
	assert_int_equal(system(path), 0);
}

static int make_sys(void **state)
{
	(void)state;
	strcpy(sys, "/tmp/facet_sys_XXXXXX");
	assert_non_null(mkdtemp(sys));
	plug("1-1", "0403\n", "6001\n", "A10X\n", "ttyUSB0");
	plug("1-2", "0403\n", "6001\n", "B20Y\n", "ttyUSB1");
	plug("1-3", "10c4\n", "ea60\n", NULL, "ttyUSB2");
	plug("1-4", "067b\n", "2303\n", NULL, "ttyUSB3");
	plug("1-5", "067B\n", "2303\n", NULL, "ttyUSB10");
	plug("1-6", "2341\n", "0043\n", "9553\n", "ttyACM0");
	put("class/tty/ttyS0", "uevent", "");
	return 0;
}

static int remove_sys(void **state)
{
	char command[128];
	(void)state;
	snprintf(command, sizeof command, "rm -rf %s", sys);
	return system(command);
}

static void an_adapter_is_found_by_what_it_says_of_itself(void **state)
{
	static const char *const found[][2] = {
	    {"/dev/ttyS4", "/dev/ttyS4"},           {"/dev/serial/by-id/x", "/dev/serial/by-id/x"},
	    {"usb:0403:6001:A10X", "/dev/ttyUSB0"}, {"usb:0403:6001:B20Y", "/dev/ttyUSB1"},
	    {"usb:10C4:EA60", "/dev/ttyUSB2"},      {"usb:2341:0043", "/dev/ttyACM0"}};
	char path[64], error[160];
	(void)state;
	for (int i = 0; i < 6; i++) {
		assert_int_equal(serial_find(sys, found[i][0], path, sizeof path, error), 0);
		assert_string_equal(path, found[i][1]);
	}
}

static void adapters_that_are_not_one_are_said_to_be(void **state)
{
	static const struct {
		const char *port;
		int r;
		const char *says;
	} wrong[] = {
	    {"usb:0403:6001", -ENOTUNIQ,
	     "ttyUSB0 and ttyUSB1 are such adapters; add the serial number, :A10X or :B20Y"},
	    {"usb:067b:2303", -ENOTUNIQ,
	     "ttyUSB10 and ttyUSB3 are such lines alike; write a path under /dev/serial/by-id"},
	    {"usb:0403:6001:C30Z", -ENODEV, "no such adapter is plugged in; `facet devices`"},
	    {"usb:0403:6002", -ENODEV, "no such adapter is plugged in"},
	    {"usb:", -EINVAL, "write usb:VENDOR:PRODUCT[:SERIAL]"},
	    {"usb:0403", -EINVAL, "names no adapter"},
	    {"usb:403:6001", -EINVAL, "names no adapter"},
	    {"usb:0403:60g1", -EINVAL, "names no adapter"},
	    {"usb:0403:6001:", -EINVAL, "names no adapter"},
	};
	char path[64], error[160];
	(void)state;
	for (size_t i = 0; i < sizeof wrong / sizeof wrong[0]; i++) {
		assert_int_equal(serial_find(sys, wrong[i].port, path, sizeof path, error), wrong[i].r);
		assert_non_null(strstr(error, wrong[i].says));
		assert_memory_equal(error, wrong[i].port, strlen(wrong[i].port));
	}
	assert_int_equal(serial_find("/nowhere", "usb:0403:6001", path, sizeof path, error), -ENODEV);
	assert_int_equal(serial_find(sys, "/dev/serial/by-id/x", path, 8, error), -ENAMETOOLONG);
}

static void a_timer_of_an_adapter_is_set_or_told(void **state)
{
	char path[128], file[160], note[160], text[8] = "";
	(void)state;
	const int line = open("/dev/null", O_RDWR); /* knows no flag */
	snprintf(path, sizeof path, "%s/ttyUSB0", sys);
	put(".", "ttyUSB0", "");
	put("bus/usb-serial/devices/ttyUSB0", "latency_timer", "16\n");
	serial_low_latency(line, sys, path, note);
	assert_string_equal(note, "");
	snprintf(file, sizeof file, "%s/bus/usb-serial/devices/ttyUSB0/latency_timer", sys);
	FILE *timer = fopen(file, "r");
	assert_non_null(fgets(text, sizeof text, timer));
	fclose(timer);
	assert_string_equal(text, "1\n");
	assert_int_equal(unlink(file), 0);
	serial_low_latency(line, sys, path, note);
	assert_non_null(strstr(note, "has no low latency to set"));
	/* Only root may write it. */
	put("bus/usb-serial/devices/ttyUSB0", "latency_timer", "16\n");
	const pid_t pid = fork();
	if (pid == 0) {
		if (chmod(sys, 0755) || chmod(file, 0444) || (geteuid() == 0 && setuid(65534)))
			_exit(1);
		serial_low_latency(line, sys, path, note);
		_exit(strstr(note, "gathers bytes for 16 ms; a udev rule") == NULL);
	}
	int status = 0;
	waitpid(pid, &status, 0);
	assert_int_equal(status, 0);
	close(line);
}

static void a_terminal_has_no_latency_to_tell_of(void **state)
{
	char path[64], note[160] = "x";
	(void)state;
	const int master = make_pty(path);
	const int fd = open(path, O_RDWR | O_NOCTTY);
	serial_low_latency(fd, sys, path, note);
	assert_string_equal(note, "");
	close(fd);
	close(master);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_missing_port_is_named),
	    cmocka_unit_test(what_is_no_serial_line_is_refused),
	    cmocka_unit_test(a_forbidden_port_names_the_group),
	    cmocka_unit_test(a_port_in_use_is_said_to_be),
	    cmocka_unit_test(a_line_is_raw_empty_and_has_the_rate_asked_for),
	    cmocka_unit_test(a_rate_on_what_is_no_line_is_an_error),
	    cmocka_unit_test(an_adapter_is_found_by_what_it_says_of_itself),
	    cmocka_unit_test(adapters_that_are_not_one_are_said_to_be),
	    cmocka_unit_test(a_timer_of_an_adapter_is_set_or_told),
	    cmocka_unit_test(a_terminal_has_no_latency_to_tell_of),
	};
	return cmocka_run_group_tests(tests, make_sys, remove_sys);
}

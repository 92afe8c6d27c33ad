/* Law: what is wrong with a port is one sentence that names it and says what to do; a line is raw, and its rate is read back. */
#include <errno.h>
#include <fcntl.h>
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
	usleep(20000);
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

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_missing_port_is_named),
	    cmocka_unit_test(what_is_no_serial_line_is_refused),
	    cmocka_unit_test(a_forbidden_port_names_the_group),
	    cmocka_unit_test(a_port_in_use_is_said_to_be),
	    cmocka_unit_test(a_line_is_raw_empty_and_has_the_rate_asked_for),
	    cmocka_unit_test(a_rate_on_what_is_no_line_is_an_error),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

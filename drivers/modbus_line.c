/* One Modbus line or connection, as a thread of its own uses it: libmodbus blocks.
 *
 * An answer that comes after its time-out must never be taken for the answer to the next request. TCP numbers its
 * answers, yet libmodbus only notices a wrong number: the connection has to be given up. A serial line has no numbers:
 * whoever asks the same unit again listens first until the line was silent (modbus_line_drain). A lock on a serial line
 * keeps a second program from talking in between. */
#include <errno.h>
#include <fcntl.h>
#include <modbus.h>
#include <poll.h>
#include <string.h>
#include <sys/file.h>
#include <sys/select.h>
#include <time.h>
#include <unistd.h>

#include "drivers/modbus_parts.h"

#define BYTE_US        100000
#define CONNECT_S      1
#define SILENCE_MIN_NS 1750000 /* between frames above 19200 Bd */
#define BAUD_DEFAULT   115200

int64_t modbus_line_now(void)
{
	struct timespec ts;

	clock_gettime(CLOCK_MONOTONIC, &ts);
	return (int64_t)ts.tv_sec * 1000000000 + ts.tv_nsec;
}

bool modbus_line_is_serial(const char *connect)
{
	return strchr(connect, '/') != NULL;
}

bool modbus_line_split(const char *connect, char ret_host[CONFIG_TEXT_MAX], char ret_port[8])
{
	const char *colon = strrchr(connect, ':');
	size_t len;

	if (!colon || colon == connect || strlen(colon + 1) < 1 || strlen(colon + 1) > 5)
		return false;
	strcpy(ret_port, colon + 1);
	len = (size_t)(colon - connect);
	if (connect[0] == '[' && connect[len - 1] == ']' && len > 2) {
		connect++;
		len -= 2;
	}
	memcpy(ret_host, connect, len);
	ret_host[len] = '\0';
	return true;
}

static int errno_of_modbus(void)
{
	if (errno >= MODBUS_ENOBASE)
		return EPROTO;
	return errno ? errno : EIO;
}

static void sleep_until(int64_t t_ns)
{
	struct timespec ts = {.tv_sec = t_ns / 1000000000, .tv_nsec = t_ns % 1000000000};

	while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &ts, NULL) == EINTR)
		continue;
}

/* What another program holds is not ours; the thread of a link just closed may need a moment to let go. */
static int lock_line(int fd)
{
	for (int i = 0; i < 100; i++) {
		if (flock(fd, LOCK_EX | LOCK_NB) == 0)
			return 0;
		sleep_until(modbus_line_now() + 10000000);
	}
	return -EBUSY;
}

/* A descriptor beyond FD_SETSIZE would be written outside the set that libmodbus gives to select(). */
static int claim(struct modbus_line *line)
{
	int fd = modbus_get_socket(line->modbus);
	int r;

	if (fd < 0 || fd >= FD_SETSIZE)
		return -EMFILE;
	fcntl(fd, F_SETFD, FD_CLOEXEC);
	if (!line->serial)
		return 0;
	r = lock_line(fd);
	if (!r)
		modbus_flush(line->modbus); /* bytes from before are nobody's answer */
	return r;
}

int modbus_line_open(struct modbus_line *line, const struct config_device *d)
{
	uint32_t baud = d->baud ? d->baud : BAUD_DEFAULT;
	char host[CONFIG_TEXT_MAX], port[8];

	*line = (struct modbus_line){.serial = modbus_line_is_serial(d->connect)};
	if (line->serial)
		line->modbus = modbus_new_rtu(d->connect, (int)baud, d->parity ? d->parity : 'N', 8, 1);
	else if (modbus_line_split(d->connect, host, port))
		line->modbus = modbus_new_tcp_pi(host, port);
	if (!line->modbus)
		return -errno_of_modbus();
	line->silence_ns = line->serial ? INT64_C(35000000000) / baud : 0;
	if (line->serial && line->silence_ns < SILENCE_MIN_NS)
		line->silence_ns = SILENCE_MIN_NS;
	modbus_set_slave(line->modbus, d->slave);
	modbus_set_response_timeout(line->modbus, CONNECT_S, 0);
	if (modbus_connect(line->modbus) < 0)
		return -errno_of_modbus();
	modbus_set_byte_timeout(line->modbus, 0, BYTE_US);
	return claim(line);
}

void modbus_line_close(struct modbus_line *line)
{
	if (!line->modbus)
		return;
	modbus_close(line->modbus);
	modbus_free(line->modbus);
	line->modbus = NULL;
}

void modbus_line_drain(struct modbus_line *line, int silence_us)
{
	struct pollfd p = {.fd = modbus_get_socket(line->modbus), .events = POLLIN};
	uint8_t waste[256];
	int64_t end_ns = modbus_line_now() + INT64_C(4) * silence_us * 1000;

	while (modbus_line_now() < end_ns && poll(&p, 1, silence_us / 1000) > 0)
		if (read(p.fd, waste, sizeof waste) <= 0)
			break;
	modbus_flush(line->modbus);
}

static int request(struct modbus_line *line, struct modbus_transaction *t)
{
	int n = t->n, address = t->address;
	int r;

	switch (t->function) {
	case 3:
		r = modbus_read_registers(line->modbus, address, n, t->value);
		break;
	case 4:
		r = modbus_read_input_registers(line->modbus, address, n, t->value);
		break;
	case 6:
		r = modbus_write_register(line->modbus, address, t->value[0]);
		break;
	default:
		r = modbus_write_registers(line->modbus, address, n, t->value);
		break;
	}
	return r < 0 ? errno : 0;
}

static void refuse(struct modbus_transaction *t, int code)
{
	t->function |= MODBUS_WIRE_REFUSED;
	t->n = 1;
	t->value[0] = (uint16_t)code;
}

int modbus_line_ask(struct modbus_line *line, int timeout_us, struct modbus_transaction *t)
{
	int error, code;

	sleep_until(line->free_ns);
	modbus_set_slave(line->modbus, t->unit);
	modbus_set_response_timeout(line->modbus, 0, (uint32_t)timeout_us);
	t->t_request_ns = modbus_line_now();
	error = request(line, t);
	t->t_answer_ns = modbus_line_now();
	line->free_ns = t->t_answer_ns + line->silence_ns;
	code = error - MODBUS_ENOBASE;
	if (!error)
		return 0;
	if (code >= MODBUS_EXCEPTION_ILLEGAL_FUNCTION && code < MODBUS_EXCEPTION_MAX) {
		refuse(t, code);
		return 0;
	}
	refuse(t, 0);
	return error >= MODBUS_ENOBASE ? -EPROTO : -error;
}

/* The bus: libmodbus blocks, so each bus has one thread that waits for it, and the loop never does (design D3).
 *
 *   loop  --- wishes to write --->  thread  --- requests --->  device
 *         <-- completed records --          <--- answers ----
 *
 * The two speak over a pair of sequenced-packet sockets: one message is one record (modbus_wire.h), and closing the
 * loop's end is the message that ends the thread; nobody joins it. It connects by itself, so a host that does not answer
 * costs the loop nothing. When the bus is lost it closes the device first and then says so with a message of four bytes,
 * a negative errno; whoever opens anew (the supervisor, with its back-off) therefore finds the line free. A lock on a
 * serial line keeps a second program from talking in between.
 *
 * An answer that comes after its time-out must never be taken for the answer to the next request. TCP numbers its
 * answers, yet libmodbus only notices a wrong number: the connection is given up. A serial line has no numbers: the
 * thread listens until the line was silent for a whole response time, and gives up after three failures in a row.
 *
 * The thread stamps with CLOCK_MONOTONIC. The loop's clock is that plus a constant, learned at each read as the largest
 * difference seen: the loop took its time before the read, so the difference is never too large. */
#include "drivers/modbus_parts.h"

#include <errno.h>
#include <fcntl.h>
#include <modbus.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#define RESPONSE_US    500000 /* busy machines were seen to sleep for 0.4 s */
#define BYTE_US        100000
#define CONNECT_S      1
#define FAILURES_MAX   3
#define SILENCE_MIN_NS 1750000 /* between frames above 19200 Bd */
#define BAUD_DEFAULT   115200

struct link {
	int fd;
	char connect[CONFIG_TEXT_MAX];
	int unit;
	bool offset_known;
	int64_t offset_ns; /* the loop's clock minus CLOCK_MONOTONIC */
};

struct bus { /* the thread's own; it frees it */
	int fd;
	int crowd; /* its place among those of its device */
	struct config_device device;
	modbus_t *modbus;
	bool serial;
	int64_t silence_ns, free_ns; /* the line may be used from then on */
	int failures;
};

/* Threads of each device that have not ended. One that is closed ends within seconds, unless a name server never answers:
 * nothing can wake it there, and each new try would leave one more. */
static struct {
	char device[CONFIG_NAME_MAX];
	int threads; /* 0: the place is free */
} crowd[CONFIG_DEVICES_MAX];
static pthread_mutex_t crowd_lock = PTHREAD_MUTEX_INITIALIZER;

/* Its place, or -EBUSY: too many of them wait already. */
static int crowd_join(const char *device)
{
	int place = -1;

	pthread_mutex_lock(&crowd_lock);
	for (int i = 0; i < CONFIG_DEVICES_MAX; i++)
		if (crowd[i].threads > 0 && strcmp(crowd[i].device, device) == 0)
			place = i;
	for (int i = 0; i < CONFIG_DEVICES_MAX && place < 0; i++)
		if (crowd[i].threads == 0)
			place = i;
	if (place >= 0 && crowd[place].threads < MODBUS_THREADS_MAX) {
		snprintf(crowd[place].device, sizeof crowd[place].device, "%s", device);
		crowd[place].threads++;
	} else {
		place = -EBUSY;
	}
	pthread_mutex_unlock(&crowd_lock);
	return place;
}

static void crowd_leave(int place)
{
	pthread_mutex_lock(&crowd_lock);
	crowd[place].threads--;
	pthread_mutex_unlock(&crowd_lock);
}

static int64_t monotonic_ns(void)
{
	struct timespec ts;

	clock_gettime(CLOCK_MONOTONIC, &ts);
	return (int64_t)ts.tv_sec * 1000000000 + ts.tv_nsec;
}

static bool is_serial(const char *connect)
{
	return strchr(connect, '/') != NULL;
}

/* "host:port" or "[v6]:port" in two parts; false where it is neither. */
static bool split_address(const char *connect, char host[CONFIG_TEXT_MAX], char port[8])
{
	const char *colon = strrchr(connect, ':');
	size_t len;

	if (!colon || colon == connect || strlen(colon + 1) < 1 || strlen(colon + 1) > 5)
		return false;
	strcpy(port, colon + 1);
	len = (size_t)(colon - connect);
	if (connect[0] == '[' && connect[len - 1] == ']' && len > 2) {
		connect++;
		len -= 2;
	}
	memcpy(host, connect, len);
	host[len] = '\0';
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
		sleep_until(monotonic_ns() + 10000000);
	}
	return -EBUSY;
}

/* A descriptor beyond FD_SETSIZE would be written outside the set that libmodbus gives to select(). */
static int claim(struct bus *bus)
{
	int fd = modbus_get_socket(bus->modbus);
	int r;

	if (fd < 0 || fd >= FD_SETSIZE)
		return -EMFILE;
	fcntl(fd, F_SETFD, FD_CLOEXEC);
	if (!bus->serial)
		return 0;
	r = lock_line(fd);
	if (!r)
		modbus_flush(bus->modbus); /* bytes from before are nobody's answer */
	return r;
}

static int bus_connect(struct bus *bus)
{
	const struct config_device *d = &bus->device;
	uint32_t baud = d->baud ? d->baud : BAUD_DEFAULT;
	char host[CONFIG_TEXT_MAX], port[8];

	if (bus->serial)
		bus->modbus = modbus_new_rtu(d->connect, (int)baud, d->parity ? d->parity : 'N', 8, 1);
	else if (split_address(d->connect, host, port))
		bus->modbus = modbus_new_tcp_pi(host, port);
	if (!bus->modbus)
		return -errno_of_modbus();
	bus->silence_ns = bus->serial ? INT64_C(35000000000) / baud : 0;
	if (bus->serial && bus->silence_ns < SILENCE_MIN_NS)
		bus->silence_ns = SILENCE_MIN_NS;
	modbus_set_slave(bus->modbus, d->slave);
	modbus_set_response_timeout(bus->modbus, CONNECT_S, 0);
	if (modbus_connect(bus->modbus) < 0)
		return -errno_of_modbus();
	modbus_set_response_timeout(bus->modbus, 0, RESPONSE_US);
	modbus_set_byte_timeout(bus->modbus, 0, BYTE_US);
	return claim(bus);
}

static void bus_disconnect(struct bus *bus)
{
	if (!bus->modbus)
		return;
	modbus_close(bus->modbus);
	modbus_free(bus->modbus);
	bus->modbus = NULL;
}

/* Reads away what still comes, until the line was silent for a response time; at most four of them. */
static void drain(struct bus *bus)
{
	struct pollfd p = {.fd = modbus_get_socket(bus->modbus), .events = POLLIN};
	uint8_t waste[256];
	int64_t end_ns = monotonic_ns() + INT64_C(4) * RESPONSE_US * 1000;

	while (monotonic_ns() < end_ns && poll(&p, 1, RESPONSE_US / 1000) > 0)
		if (read(p.fd, waste, sizeof waste) <= 0)
			break;
	modbus_flush(bus->modbus);
}

static int request(struct bus *bus, struct modbus_transaction *t)
{
	int n = t->n, address = t->address;
	int r;

	switch (t->function) {
	case 3:
		r = modbus_read_registers(bus->modbus, address, n, t->value);
		break;
	case 4:
		r = modbus_read_input_registers(bus->modbus, address, n, t->value);
		break;
	case 6:
		r = modbus_write_register(bus->modbus, address, t->value[0]);
		break;
	default:
		r = modbus_write_registers(bus->modbus, address, n, t->value);
		break;
	}
	return r < 0 ? -errno : 0;
}

static void refuse(struct modbus_transaction *t, int code)
{
	t->function |= MODBUS_WIRE_REFUSED;
	t->n = 1;
	t->value[0] = (uint16_t)code;
}

/* 0: go on; -errno: the bus is lost. The transaction says what became of it. */
static int judge(struct bus *bus, int error, struct modbus_transaction *t)
{
	int code = error - MODBUS_ENOBASE;

	if (!error) {
		bus->failures = 0;
		return 0;
	}
	if (code >= MODBUS_EXCEPTION_ILLEGAL_FUNCTION && code < MODBUS_EXCEPTION_MAX) {
		bus->failures = 0;
		refuse(t, code);
		return 0;
	}
	refuse(t, 0);
	if (error != ETIMEDOUT && error < MODBUS_ENOBASE)
		return -error;
	if (!bus->serial || ++bus->failures >= FAILURES_MAX)
		return error == ETIMEDOUT ? -ETIMEDOUT : -EPROTO;
	drain(bus);
	return 0;
}

/* A loop that reads no more (or is gone) loses records; it notices the end of the bus by the closed socket. */
static void send_record(struct bus *bus, const struct modbus_transaction *t)
{
	uint8_t bytes[MODBUS_WIRE_MAX];

	(void)!send(bus->fd, bytes, modbus_wire_put(t, bytes), MSG_DONTWAIT | MSG_NOSIGNAL);
}

static int transact(struct bus *bus, struct modbus_transaction *t)
{
	int r;

	sleep_until(bus->free_ns);
	t->unit = (uint8_t)bus->device.slave;
	t->t_request_ns = monotonic_ns();
	r = request(bus, t);
	t->t_answer_ns = monotonic_ns();
	r = judge(bus, -r, t);
	bus->free_ns = monotonic_ns() + bus->silence_ns;
	send_record(bus, t);
	return r;
}

/* One wish of the loop, to write or to read: 0; -ECONNRESET: the loop closed its end; -errno: the bus is lost. */
static int serve_wish(struct bus *bus)
{
	uint8_t bytes[MODBUS_WIRE_MAX];
	struct modbus_transaction t;
	ssize_t n = recv(bus->fd, bytes, sizeof bytes, MSG_DONTWAIT);

	if (n < 0)
		return errno == EAGAIN || errno == EINTR ? 0 : -errno;
	if (n == 0)
		return -ECONNRESET;
	if (modbus_wire_get(bytes, (size_t)n, &t) <= 0 || t.function & MODBUS_WIRE_REFUSED ||
	    t.n > MODBUS_MAX_WRITE_REGISTERS)
		return 0;
	return transact(bus, &t);
}

static int poll_position(struct bus *bus)
{
	const struct config_register *position = &bus->device.position;
	struct modbus_transaction t = {.function = modbus_wire_read_function(position),
	                               .address = modbus_wire_address(&bus->device, position->address),
	                               .n = (uint16_t)modbus_wire_registers(position)};

	return transact(bus, &t);
}

/* Until the bus is lost or the loop has gone. A poll that is late is not made up for: the queue never builds up. */
static int bus_run(struct bus *bus)
{
	int64_t period_ns = bus->device.period_ns > MODBUS_PERIOD_MIN_NS ? bus->device.period_ns : MODBUS_PERIOD_MIN_NS;
	int64_t next_ns = monotonic_ns();

	for (;;) {
		struct pollfd p = {.fd = bus->fd, .events = POLLIN};
		int64_t wait_ns = next_ns - monotonic_ns();
		struct timespec ts = {.tv_sec = wait_ns / 1000000000, .tv_nsec = wait_ns % 1000000000};
		int r = 0;

		if (wait_ns > 0)
			ppoll(&p, 1, &ts, NULL);
		else
			poll(&p, 1, 0);
		if (p.revents)
			r = serve_wish(bus);
		if (!r && monotonic_ns() >= next_ns) {
			r = poll_position(bus);
			next_ns += period_ns;
			if (next_ns < monotonic_ns())
				next_ns = monotonic_ns();
		}
		if (r)
			return r;
	}
}

static void *bus_thread(void *arg)
{
	struct bus *bus = arg;
	int32_t lost = bus_connect(bus);

	if (!lost)
		lost = bus_run(bus);
	bus_disconnect(bus);
	(void)!send(bus->fd, &lost, sizeof lost, MSG_DONTWAIT | MSG_NOSIGNAL);
	close(bus->fd);
	crowd_leave(bus->crowd);
	free(bus);
	return NULL;
}

/* Signals are the loop's. */
static int start_thread(struct bus *bus)
{
	pthread_attr_t attr;
	pthread_t thread;
	sigset_t all, before;
	int r;

	sigfillset(&all);
	pthread_attr_init(&attr);
	pthread_attr_setdetachstate(&attr, PTHREAD_CREATE_DETACHED);
	pthread_sigmask(SIG_SETMASK, &all, &before);
	r = pthread_create(&thread, &attr, bus_thread, bus);
	pthread_sigmask(SIG_SETMASK, &before, NULL);
	pthread_attr_destroy(&attr);
	return -r;
}

static bool address_is_good(const struct config_device *device, char error[160])
{
	char host[CONFIG_TEXT_MAX], port[8];

	if (!is_serial(device->connect)) {
		if (split_address(device->connect, host, port))
			return true;
		snprintf(error, 160, "%.80s is neither a path of a serial line nor HOST:PORT", device->connect);
		return false;
	}
	if (access(device->connect, R_OK | W_OK) == 0)
		return true;
	if (errno == ENOENT)
		snprintf(error, 160, "%.80s: there is no such device; plug it in, or correct `connect`",
		         device->connect);
	else
		snprintf(error, 160, "%.80s: %s%s", device->connect, strerror(errno),
		         errno == EACCES ? "; is the user in the group dialout?" : "");
	return false;
}

struct link *modbus_bus_open(const struct config_device *device, char error[160])
{
	struct link *link = calloc(1, sizeof *link);
	struct bus *bus = calloc(1, sizeof *bus);
	int pair[2], r = -ENOMEM;

	if (!link || !bus)
		goto fail;
	r = 0;
	if (!address_is_good(device, error))
		goto fail_said;
	if (socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, pair) < 0) {
		r = -errno;
		goto fail;
	}
	link->fd = pair[0];
	snprintf(link->connect, sizeof link->connect, "%s", device->connect);
	link->unit = device->slave;
	bus->fd = pair[1];
	bus->device = *device;
	bus->serial = is_serial(device->connect);
	bus->crowd = crowd_join(device->name);
	if (bus->crowd < 0) {
		snprintf(
		    error, 160,
		    "%.50s: %d earlier tries have not ended; does the name server answer? A numeric address needs none",
		    device->connect, MODBUS_THREADS_MAX);
		close(pair[0]);
		close(pair[1]);
		goto fail_said;
	}
	r = start_thread(bus);
	if (!r)
		return link;
	crowd_leave(bus->crowd);
	close(pair[0]);
	close(pair[1]);
fail:
	snprintf(error, 160, "%.80s: %s", device->connect, strerror(-r));
fail_said:
	free(bus);
	free(link);
	return NULL;
}

int modbus_bus_fd(const struct link *link)
{
	return link->fd;
}

/* From the thread's clock to the loop's. */
static size_t restamp(struct link *link, uint8_t *bytes, size_t len, int64_t *t_ns)
{
	int64_t offset_ns = *t_ns - monotonic_ns();
	struct modbus_transaction t;

	if (!link->offset_known || offset_ns > link->offset_ns)
		link->offset_ns = offset_ns;
	link->offset_known = true;
	if (modbus_wire_get(bytes, len, &t) <= 0)
		return len;
	t.t_request_ns += link->offset_ns;
	t.t_answer_ns += link->offset_ns;
	*t_ns = t.t_answer_ns;
	return modbus_wire_put(&t, bytes);
}

ssize_t modbus_bus_read(struct link *link, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	uint8_t bytes[MODBUS_WIRE_MAX];
	int32_t lost;
	ssize_t n = recv(link->fd, bytes, sizeof bytes, MSG_DONTWAIT);

	if (n < 0)
		return errno == EAGAIN || errno == EINTR ? 0 : -errno;
	if (n == sizeof lost) {
		memcpy(&lost, bytes, sizeof lost);
		return lost < 0 ? lost : -EIO;
	}
	if (n == 0 || (size_t)n > cap)
		return -EIO;
	n = (ssize_t)restamp(link, bytes, (size_t)n, t_ns);
	memcpy(buf, bytes, (size_t)n);
	return n;
}

ssize_t modbus_bus_write(struct link *link, const uint8_t *bytes, size_t len)
{
	ssize_t n = send(link->fd, bytes, len, MSG_DONTWAIT | MSG_NOSIGNAL);

	if (n < 0)
		return errno == EAGAIN || errno == EINTR ? 0 : -errno;
	return n;
}

static void tell_serial(const struct link *link, int error, char ret[160])
{
	const char *line = link->connect;

	if (error == ETIMEDOUT)
		snprintf(ret, 160, "%.50s: unit %d does not answer: check power, cable, `baud`, `parity` and `unit`",
		         line, link->unit);
	else if (error == EPROTO)
		snprintf(ret, 160, "%.50s: what comes is no answer of unit %d: check `baud`, `parity` and the cable",
		         line, link->unit);
	else if (error == EBUSY)
		snprintf(ret, 160, "%.50s: another program uses this line; end that one, or correct `connect`", line);
	else if (error == EIO || error == ECONNRESET)
		snprintf(ret, 160, "%.50s: the line hung up: is the adapter plugged in?", line);
	else if (error == ENOTTY)
		snprintf(ret, 160, "%.50s: this is no serial line; correct `connect`", line);
	else
		snprintf(ret, 160, "%.50s: the line failed (%s)", line, strerror(error));
}

/* libmodbus says of a name that nobody knows that it refused. */
static void tell_tcp(const struct link *link, int error, char ret[160])
{
	const char *peer = link->connect;

	if (error == ECONNREFUSED)
		snprintf(ret, 160,
		         "%.60s refuses the connection, or nobody knows the name: check address and port in `connect`",
		         peer);
	else if (error == EHOSTUNREACH || error == ENETUNREACH)
		snprintf(ret, 160,
		         "%.60s cannot be reached: check cable and power, and that this host is in its network", peer);
	else if (error == ETIMEDOUT)
		snprintf(ret, 160, "%.60s: unit %d does not answer: check cable, power, address and `unit`", peer,
		         link->unit);
	else if (error == ECONNRESET || error == EPIPE)
		snprintf(ret, 160, "%.60s broke the connection off: it was restarted, or serves too many clients",
		         peer);
	else if (error == EPROTO)
		snprintf(ret, 160, "%.60s: what comes is no answer of unit %d: is this the servo's address?", peer,
		         link->unit);
	else
		snprintf(ret, 160, "the connection to %.60s failed (%s)", peer, strerror(error));
}

void modbus_bus_error(const struct link *link, int error, char ret[160])
{
	if (is_serial(link->connect))
		tell_serial(link, error, ret);
	else
		tell_tcp(link, error, ret);
}

void modbus_bus_close(struct link *link)
{
	if (!link)
		return;
	close(link->fd);
	free(link);
}

/* The bus: libmodbus blocks, so each line or connection has one thread that waits for it, and the loop never does
 * (design D3). Devices with the same `connect` share it.
 *
 *   loop  --- wishes ----------------->  thread  --- requests --->  device
 *         <-- completed records -------          <--- answers ----
 *
 * The loop's end of each device and the thread speak over a pair of sequenced-packet sockets: one message is one record
 * (modbus_wire.h). Closing the loop's end is the message that the device leaves the bus; with the last one the thread
 * ends, nobody joins it. It connects by itself, so a host that does not answer costs the loop nothing. When the bus is
 * lost it closes the line first and then says so to all with a message of four bytes, a negative errno; whoever opens
 * anew (the supervisor, with its back-off) therefore finds the line free.
 *
 * Fairness. In each round every device may have one wish and one poll of its angle; the next round begins with the next
 * device. A device that does not answer would hold up the others for its time-out: on a shared bus that is shorter, and
 * shorter still for one that never answered; after a failure it is left alone until its answer can no more come, and
 * after the third in a row (the first, if it never answered) it alone is told that it is lost. So an absent device costs
 * the others PROBE_US each time that it is tried again, which is once a second. Its late answer carries its own unit,
 * and is refused by whoever waits for another's; what is still to come then is listened away.
 *
 * The thread stamps with CLOCK_MONOTONIC. The loop's clock is that plus a constant, learned at each read as the largest
 * difference seen: the loop took its time before the read, so the difference is never too large. */
#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include "drivers/modbus_parts.h"
#include "drivers/modbus_words.h"

#define RESPONSE_US  500000 /* busy machines were seen to sleep for 0.4 s */
#define SHARED_US    200000 /* of a device that is not alone: shorter than others' watchdogs */
#define PROBE_US     100000 /* ... and never answered */
#define FAILURES_MAX 3
#define PATIENCE_NS  INT64_C(5000000000) /* a line that opens for longer hangs */
#define WRITE_MAX    123                 /* registers, the standard's limit */

struct link {
	int fd;
	char connect[CONFIG_TEXT_MAX];
	int unit;
	uint64_t bus; /* its number */
	bool offset_known;
	int64_t offset_ns; /* the loop's clock minus CLOCK_MONOTONIC */
};

struct member { /* a device on a bus */
	int fd;
	struct config_device device;
	int64_t poll_ns, quiet_ns; /* its next poll; it is asked nothing before quiet_ns */
	int failures;              /* in a row */
	bool answered, ready, hung, gone;
};

struct bus {
	int wake; /* eventfd: somebody joins */
	struct modbus_line line;
	struct member member[CONFIG_DEVICES_MAX]; /* the thread's own */
	int members, turn;
	/* Under the lock. */
	uint64_t number;
	int links; /* of the loop that were not closed */
	char connect[CONFIG_TEXT_MAX];
	struct member joiner[CONFIG_DEVICES_MAX];
	int joiners;
	bool opening;
	int64_t since_ns;
};

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static struct bus *buses[CONFIG_DEVICES_MAX]; /* that can be joined; one for each `connect` */
static uint64_t buses_begun;

/* ---- the thread ---- */

/* A loop that reads no more (or is gone) loses records; it notices the end of the bus by the closed socket. */
static void send_record(const struct member *m, const struct modbus_transaction *t)
{
	uint8_t bytes[MODBUS_WIRE_MAX];

	(void)!send(m->fd, bytes, modbus_wire_put(t, bytes), MSG_DONTWAIT | MSG_NOSIGNAL);
}

/* Says that it is lost, `error` < 0, or just lets go of it. */
static void dismiss(struct member *m, int32_t error)
{
	if (m->gone)
		return;
	if (error)
		(void)!send(m->fd, &error, sizeof error, MSG_DONTWAIT | MSG_NOSIGNAL);
	close(m->fd);
	m->gone = true;
}

static int timeout_us(const struct bus *bus, const struct member *m)
{
	if (bus->members == 1)
		return RESPONSE_US;
	return m->answered ? SHARED_US : PROBE_US;
}

/* Nothing, or no valid answer, came. Who is alone is the bus. 0: the bus goes on. */
static int failed(struct bus *bus, struct member *m, int error)
{
	const bool alone = bus->members == 1, out = ++m->failures >= FAILURES_MAX || (!alone && !m->answered);
	int r = 0;

	if (alone && (!bus->line.serial || out))
		return error;
	if (!bus->line.serial) {
		modbus_line_close(&bus->line);
		r = modbus_line_open(&bus->line, &m->device);
	} else if (alone || error == -EPROTO) {
		modbus_line_drain(&bus->line, alone ? RESPONSE_US : SHARED_US);
	}
	m->quiet_ns = alone ? 0 : modbus_line_now() + INT64_C(1000) * RESPONSE_US;
	if (out)
		dismiss(m, error);
	return r;
}

/* 0: go on; -errno: the bus is lost. */
static int transact(struct bus *bus, struct member *m, struct modbus_transaction *t)
{
	int r;

	t->unit = (uint8_t)m->device.slave;
	r = modbus_line_ask(&bus->line, timeout_us(bus, m), t);
	send_record(m, t);
	if (r == -ETIMEDOUT || r == -EPROTO)
		return failed(bus, m, r);
	if (!r) {
		m->failures = 0;
		m->answered = true;
	}
	return r;
}

/* One wish of the loop, to write or to read. 0, or -errno: the bus is lost. */
static int serve_wish(struct bus *bus, struct member *m)
{
	uint8_t bytes[MODBUS_WIRE_MAX];
	struct modbus_transaction t;
	ssize_t n = recv(m->fd, bytes, sizeof bytes, MSG_DONTWAIT);

	if (n == 0 || (n < 0 && errno != EAGAIN && errno != EINTR))
		dismiss(m, 0); /* the loop closed its end */
	if (n <= 0)
		return 0;
	if (modbus_wire_get(bytes, (size_t)n, &t) <= 0 || t.function & MODBUS_WIRE_REFUSED || t.n > WRITE_MAX)
		return 0;
	return transact(bus, m, &t);
}

/* A poll that is late is not made up for: the queue never builds up. */
static int poll_position(struct bus *bus, struct member *m)
{
	const struct config_register *position = &m->device.position;
	struct modbus_transaction t = {.function = modbus_wire_read_function(position),
	                               .address = modbus_wire_address(&m->device, position->address),
	                               .n = (uint16_t)modbus_wire_registers(position)};
	int64_t period_ns = m->device.period_ns > MODBUS_PERIOD_MIN_NS ? m->device.period_ns : MODBUS_PERIOD_MIN_NS;
	int r = transact(bus, m, &t);

	m->poll_ns += period_ns;
	if (m->poll_ns < modbus_line_now())
		m->poll_ns = modbus_line_now();
	return r;
}

static void take_joiners(struct bus *bus)
{
	uint64_t count;

	(void)!read(bus->wake, &count, sizeof count);
	pthread_mutex_lock(&lock);
	for (int i = 0; i < bus->joiners; i++)
		bus->joiner[i].poll_ns = modbus_line_now();
	while (bus->joiners > 0 && bus->members < CONFIG_DEVICES_MAX)
		bus->member[bus->members++] = bus->joiner[--bus->joiners];
	pthread_mutex_unlock(&lock);
}

static void forget_gone(struct bus *bus)
{
	int kept = 0;

	for (int i = 0; i < bus->members; i++)
		if (!bus->member[i].gone)
			bus->member[kept++] = bus->member[i];
	bus->members = kept;
}

/* Until somebody has a wish, joins, leaves, or is to be polled. */
static void await_work(struct bus *bus)
{
	struct pollfd p[CONFIG_DEVICES_MAX + 1] = {{.fd = bus->wake, .events = POLLIN}};
	int64_t now_ns = modbus_line_now(), next_ns = INT64_MAX, wait_ns;
	struct timespec ts;

	for (int i = 0; i < bus->members; i++) {
		const struct member *m = &bus->member[i];
		int64_t due_ns = m->poll_ns > m->quiet_ns ? m->poll_ns : m->quiet_ns;

		next_ns = due_ns < next_ns ? due_ns : next_ns;
		p[i + 1] = (struct pollfd){.fd = m->fd, .events = m->quiet_ns > now_ns ? 0 : POLLIN};
	}
	wait_ns = next_ns > now_ns ? next_ns - now_ns : 0;
	ts = (struct timespec){.tv_sec = wait_ns / 1000000000, .tv_nsec = wait_ns % 1000000000};
	ppoll(p, (nfds_t)bus->members + 1, &ts, NULL);
	for (int i = 0; i < bus->members; i++)
		bus->member[i].ready = p[i + 1].revents & POLLIN && p[i + 1].events;
	for (int i = 0; i < bus->members; i++)
		bus->member[i].hung = p[i + 1].revents & (POLLHUP | POLLERR);
}

static int serve_member(struct bus *bus, struct member *m)
{
	int r = 0;

	if (m->ready)
		r = serve_wish(bus, m);
	else if (m->hung)
		dismiss(m, 0);
	if (!r && !m->gone && m->poll_ns <= modbus_line_now() && m->quiet_ns <= modbus_line_now())
		r = poll_position(bus, m);
	return r;
}

/* Nobody uses it and nobody can join any more. */
static bool is_left(struct bus *bus)
{
	bool left;

	pthread_mutex_lock(&lock);
	left = bus->members == 0 && bus->joiners == 0;
	for (int i = 0; left && i < CONFIG_DEVICES_MAX; i++)
		if (buses[i] == bus)
			buses[i] = NULL;
	pthread_mutex_unlock(&lock);
	return left;
}

/* Until the bus is lost (-errno) or left (0). */
static int bus_run(struct bus *bus)
{
	for (;;) {
		take_joiners(bus);
		forget_gone(bus);
		if (is_left(bus))
			return 0;
		await_work(bus);
		bus->turn++;
		for (int i = 0; i < bus->members; i++) {
			int r = serve_member(bus, &bus->member[(bus->turn + i) % bus->members]);

			if (r)
				return r;
		}
	}
}

/* The line is closed: nobody joins any more, and all hear why. */
static void bus_end(struct bus *bus, int error)
{
	pthread_mutex_lock(&lock);
	for (int i = 0; i < CONFIG_DEVICES_MAX; i++)
		if (buses[i] == bus)
			buses[i] = NULL;
	pthread_mutex_unlock(&lock);
	for (int i = 0; i < bus->members; i++)
		dismiss(&bus->member[i], error);
	for (int i = 0; i < bus->joiners; i++)
		dismiss(&bus->joiner[i], error);
	close(bus->wake);
	free(bus);
}

static void *bus_thread(void *arg)
{
	struct bus *bus = arg;
	int lost;

	lost = modbus_line_open(&bus->line, &bus->joiner[0].device); /* the first one stays where it is */
	pthread_mutex_lock(&lock);
	bus->opening = false;
	pthread_mutex_unlock(&lock);
	if (!lost)
		lost = bus_run(bus);
	modbus_line_close(&bus->line);
	bus_end(bus, lost);
	return NULL;
}

/* ---- the loop's end ---- */

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

/* A bus of its own, in its place. Under the lock. */
static int begin_bus(struct bus **place, const struct member *m)
{
	struct bus *bus = calloc(1, sizeof *bus);
	int r = -ENOMEM;

	if (!bus)
		return r;
	bus->wake = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
	if (bus->wake < 0) {
		r = -errno;
		free(bus);
		return r;
	}
	snprintf(bus->connect, sizeof bus->connect, "%s", m->device.connect);
	bus->joiner[bus->joiners++] = *m;
	bus->number = ++buses_begun;
	bus->opening = true;
	bus->since_ns = modbus_line_now();
	r = start_thread(bus);
	if (r) {
		close(bus->wake);
		free(bus);
		return r;
	}
	*place = bus;
	return 0;
}

/* While the line opens its thread takes nobody: whoever closed and comes again takes the place that he had. */
static int join_bus(struct bus *bus, const struct member *m)
{
	const uint64_t one = 1;

	if (bus->opening && modbus_line_now() - bus->since_ns > PATIENCE_NS)
		return -EALREADY;
	for (int i = 0; i < bus->joiners; i++)
		if (bus->joiner[i].device.slave == m->device.slave) {
			close(bus->joiner[i].fd);
			bus->joiner[i].fd = m->fd;
			return 0;
		}
	if (bus->joiners == CONFIG_DEVICES_MAX)
		return -EUSERS;
	bus->joiner[bus->joiners++] = *m;
	(void)!write(bus->wake, &one, sizeof one);
	return 0;
}

/* 0 with the number of the bus, or -errno. */
static int enter_bus(const struct member *m, uint64_t *ret_number)
{
	struct bus **place = NULL;
	int r = -EUSERS;

	pthread_mutex_lock(&lock);
	for (int i = 0; i < CONFIG_DEVICES_MAX; i++)
		if (buses[i] ? !strcmp(buses[i]->connect, m->device.connect) : !place)
			place = &buses[i];
	if (place)
		r = *place ? join_bus(*place, m) : begin_bus(place, m);
	if (!r) {
		(*place)->links++;
		*ret_number = (*place)->number;
	}
	pthread_mutex_unlock(&lock);
	return r;
}

/* Whoever comes after the last one has closed its link begins anew; but no second thread for a line that still opens. */
static void leave_bus(uint64_t number)
{
	pthread_mutex_lock(&lock);
	for (int i = 0; i < CONFIG_DEVICES_MAX; i++)
		if (buses[i] && buses[i]->number == number && --buses[i]->links == 0 && !buses[i]->opening)
			buses[i] = NULL;
	pthread_mutex_unlock(&lock);
}

static bool address_is_good(const struct config_device *device, char error[160])
{
	char host[CONFIG_TEXT_MAX], port[8];

	if (!modbus_line_is_serial(device->connect)) {
		if (modbus_line_split(device->connect, host, port))
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
	struct member *m = calloc(1, sizeof *m);
	int pair[2], r = -ENOMEM;

	if (!link || !m)
		goto fail;
	if (!address_is_good(device, error))
		goto fail_said;
	if (socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, pair) < 0) {
		r = -errno;
		goto fail;
	}
	link->fd = pair[0];
	snprintf(link->connect, sizeof link->connect, "%s", device->connect);
	link->unit = device->slave;
	m->fd = pair[1];
	m->device = *device;
	r = enter_bus(m, &link->bus);
	free(m);
	m = NULL;
	if (!r)
		return link;
	close(pair[0]);
	close(pair[1]);
fail:
	if (r == -EALREADY)
		snprintf(
		    error, 160,
		    "%.50s: an earlier try has not ended; does the name server answer? A numeric address needs none",
		    device->connect);
	else
		snprintf(error, 160, "%.80s: %s", device->connect, strerror(-r));
fail_said:
	free(m);
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
	int64_t offset_ns = *t_ns - modbus_line_now();
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

void modbus_bus_error(const struct link *link, int error, char ret[160])
{
	modbus_words_end(link->connect, link->unit, error, ret);
}

void modbus_bus_close(struct link *link)
{
	if (!link)
		return;
	close(link->fd);
	leave_bus(link->bus);
	free(link);
}

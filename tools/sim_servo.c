/* A servo behind Modbus: a register map (sim_drive.h) behind a libmodbus server in a thread of its own, on a
 * pseudo-terminal or on TCP.
 *
 * A pseudo-terminal has no parity and takes every rate: the line is 8N1 and its rate means nothing. The slave is made
 * raw before anybody opens it (a fresh one echoes), and kept open here, so that a driver that comes and goes does not
 * end the line. libmodbus is given the master's descriptor and never opens anything itself. It cuts requests out of the
 * line and judges them; answers are put together here, because some have to be wrong.
 *
 * Who plays a recording through it wants to know which answers its reader took: an answer that came after the reader's
 * time-out was thrown away, and one that was slow on its way is refused by a careful reader. The servo sees neither, but
 * it sees when the next request comes. An answer counts when the pause before its request and the pause after it are
 * both as short as such pauses usually are (the median of the last ones, and a millisecond).
 *
 * Times are CLOCK_MONOTONIC in ns, as uv_hrtime says them. */
#include "tools/sim_drive.h"

#include <errno.h>
#include <fcntl.h>
#include <modbus.h>
#include <netinet/in.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#define CLIENTS_MAX   4      /* one more is closed at once */
#define REQUEST_US    500000 /* a frame that began is whole by then, or dropped */
#define PAUSES        31
#define PAUSE_MORE_NS 1000000
#define PAUSE_MAX_NS  200000000 /* shorter than any reader's time-out and recovery */

struct sim_servo {
	int slave;
	char link[108]; /* empty: TCP */
	int master, slave_fd, listener, stop[2];
	int port;
	int client[CLIENTS_MAX];
	modbus_t *modbus;
	pthread_t thread;
	bool running;

	pthread_mutex_t lock; /* of what follows */
	struct sim_drive *drive;
	uint64_t answers;
	int64_t pause_ns[PAUSES]; /* between an answer and the next request */
	uint32_t pauses;
	int64_t answered_ns; /* the last answer, of whatever */
	bool prompt;         /* the request before it came in good time */
	bool pending;        /* it carried the angle, and is to be counted when the next request comes */
};

static int64_t now_ns(void)
{
	struct timespec ts;

	clock_gettime(CLOCK_MONOTONIC, &ts);
	return (int64_t)ts.tv_sec * 1000000000 + ts.tv_nsec;
}

static bool reads_position(const struct modbus_transaction *t)
{
	return (t->function == 3 || t->function == 4) && t->address <= SIM_SERVO_POSITION &&
	       t->address + t->n >= SIM_SERVO_POSITION + 2;
}

static int speak_rtu(struct sim_servo *s)
{
	if (s->modbus)
		modbus_free(s->modbus);
	s->modbus = modbus_new_rtu("pty", 115200, 'N', 8, 1); /* the name is never opened */
	if (!s->modbus || modbus_set_slave(s->modbus, s->slave) < 0 || modbus_set_socket(s->modbus, s->master) < 0)
		return -errno;
	modbus_set_byte_timeout(s->modbus, 0, REQUEST_US);
	return 0;
}

static int64_t usual_pause(const struct sim_servo *s)
{
	int64_t sorted[PAUSES];
	int n = s->pauses < PAUSES ? (int)s->pauses : PAUSES;

	for (int i = 0; i < n; i++) {
		int at = i;

		for (; at > 0 && sorted[at - 1] > s->pause_ns[i]; at--)
			sorted[at] = sorted[at - 1];
		sorted[at] = s->pause_ns[i];
	}
	return n ? sorted[n / 2] : 0;
}

/* A request has come: what does that say about the answer before it? */
static void judge_last_answer(struct sim_servo *s, int64_t t_ns)
{
	int64_t pause_ns = t_ns - s->answered_ns;
	bool prompt = pause_ns <= PAUSE_MAX_NS && pause_ns <= usual_pause(s) + PAUSE_MORE_NS;

	s->pause_ns[s->pauses++ % PAUSES] = pause_ns;
	if (s->pending && s->prompt && prompt)
		s->answers++;
	s->prompt = prompt;
	s->pending = false;
}

/* A frame that libmodbus found whole, `header` bytes of it before the function. */
static void understand(const uint8_t *frame, int len, int header, struct modbus_transaction *ret)
{
	const uint8_t *pdu = frame + header;
	int n = len - header;

	memset(ret, 0, sizeof *ret);
	ret->unit = frame[header - 1];
	ret->function = pdu[0];
	if (n < 5)
		return; /* a function of which we know nothing */
	ret->address = (uint16_t)(pdu[1] << 8 | pdu[2]);
	ret->n = (uint16_t)(pdu[3] << 8 | pdu[4]);
	if (ret->function == 6) {
		ret->value[0] = ret->n;
		ret->n = 1;
	}
	for (int i = 0; ret->function == 16 && i < ret->n && i < MODBUS_WIRE_VALUES_MAX && 7 + 2 * i < n; i++)
		ret->value[i] = (uint16_t)(pdu[6 + 2 * i] << 8 | pdu[7 + 2 * i]);
}

static size_t put_pdu(const struct modbus_transaction *t, uint8_t *ret)
{
	size_t n = 0;

	ret[n++] = t->function;
	if (t->function & MODBUS_WIRE_REFUSED) {
		ret[n++] = (uint8_t)t->value[0];
		return n;
	}
	if (t->function == 6 || t->function == 16) {
		uint16_t last = t->function == 6 ? t->value[0] : t->n;

		ret[n++] = (uint8_t)(t->address >> 8);
		ret[n++] = (uint8_t)t->address;
		ret[n++] = (uint8_t)(last >> 8);
		ret[n++] = (uint8_t)last;
		return n;
	}
	ret[n++] = (uint8_t)(2 * t->n);
	for (int i = 0; i < t->n; i++) {
		ret[n++] = (uint8_t)(t->value[i] >> 8);
		ret[n++] = (uint8_t)t->value[i];
	}
	return n;
}

static uint16_t crc16(const uint8_t *bytes, size_t len)
{
	uint16_t crc = 0xffff;

	for (size_t i = 0; i < len; i++) {
		crc ^= bytes[i];
		for (int bit = 0; bit < 8; bit++)
			crc = (uint16_t)(crc & 1 ? crc >> 1 ^ 0xa001 : crc >> 1);
	}
	return crc;
}

/* TCP has no check sum of its own: a corrupt answer there is one to another request. */
static size_t put_answer(const struct sim_servo *s, const uint8_t *request, const struct sim_drive_answer *answer,
                         uint8_t *ret)
{
	bool corrupt = answer->verdict == SIM_DRIVE_CORRUPT;
	size_t n, at = s->port ? 7 : 1;
	uint16_t crc;

	ret[at - 1] = answer->transaction.unit;
	n = at + put_pdu(&answer->transaction, ret + at);
	if (s->port) {
		memcpy(ret, request, 2);
		ret[1] ^= corrupt ? 0x55 : 0;
		ret[2] = ret[3] = 0;
		ret[4] = (uint8_t)((n - 6) >> 8);
		ret[5] = (uint8_t)(n - 6);
		return n;
	}
	crc = (uint16_t)(crc16(ret, n) ^ (corrupt ? 0x5500 : 0));
	ret[n++] = (uint8_t)crc;
	ret[n++] = (uint8_t)(crc >> 8);
	return n;
}

/* The answer leaves, late if that was ordered: the lock is let go of meanwhile; who ends the thread ends the wait. */
static bool reply(struct sim_servo *s, const uint8_t *request, const struct sim_drive_answer *answer)
{
	struct pollfd stop = {.fd = s->stop[0], .events = POLLIN};
	uint8_t bytes[MODBUS_TCP_MAX_ADU_LENGTH];
	size_t len;

	if (answer->verdict == SIM_DRIVE_SILENT)
		return true;
	if (answer->verdict == SIM_DRIVE_DROPPED)
		return !s->port;
	if (answer->delay_ns > 0) {
		pthread_mutex_unlock(&s->lock);
		poll(&stop, 1, (int)(answer->delay_ns / 1000000));
		pthread_mutex_lock(&s->lock);
	}
	len = put_answer(s, request, answer, bytes);
	return write(modbus_get_socket(s->modbus), bytes, len) == (ssize_t)len;
}

/* One request of the current line. False: the line is lost. An answer counts with the angle it carries. */
static bool serve(struct sim_servo *s)
{
	uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
	int n = modbus_receive(s->modbus, request), header = modbus_get_header_length(s->modbus);
	struct modbus_transaction asked;
	struct sim_drive_answer answer;
	int64_t t_ns;
	bool alive;

	if (n < 0)
		return errno == EMBBADCRC || errno == ETIMEDOUT || errno == EMBBADDATA;
	/* For another unit: libmodbus would take the next request for that unit's answer, but nobody else is on this line. */
	if (n == 0)
		return s->port || speak_rtu(s) == 0;
	understand(request, s->port ? n : n - 2, header, &asked);
	if (s->port && asked.unit == MODBUS_TCP_SLAVE)
		asked.unit = (uint8_t)s->slave;
	pthread_mutex_lock(&s->lock);
	t_ns = now_ns(); /* what a write asks for begins before its answer is seen */
	judge_last_answer(s, t_ns);
	sim_drive_transact(s->drive, &asked, t_ns, &answer);
	if (s->port && answer.verdict == SIM_DRIVE_ANSWERED)
		answer.transaction.unit = request[header - 1];
	alive = reply(s, request, &answer);
	s->pending = alive && answer.verdict == SIM_DRIVE_ANSWERED && reads_position(&answer.transaction);
	s->answered_ns = now_ns();
	pthread_mutex_unlock(&s->lock);
	return alive;
}

static void accept_client(struct sim_servo *s)
{
	int fd = accept4(s->listener, NULL, NULL, SOCK_CLOEXEC | SOCK_NONBLOCK);

	for (int i = 0; fd >= 0 && i < CLIENTS_MAX; i++) {
		if (s->client[i] >= 0)
			continue;
		s->client[i] = fd;
		return;
	}
	if (fd >= 0)
		close(fd);
}

static void serve_client(struct sim_servo *s, int i)
{
	modbus_set_socket(s->modbus, s->client[i]);
	if (serve(s))
		return;
	close(s->client[i]);
	s->client[i] = -1;
}

/* The drive stops by itself when its time has come. Until then, in ms. */
static int advance(struct sim_servo *s)
{
	int64_t t_ns = now_ns(), deadline;

	pthread_mutex_lock(&s->lock);
	sim_drive_advance(s->drive, t_ns);
	deadline = sim_drive_deadline(s->drive);
	pthread_mutex_unlock(&s->lock);
	return deadline - t_ns > 1000000000 ? 1000 : deadline > t_ns ? (int)((deadline - t_ns) / 1000000) + 1 : 0;
}

static void *servo_thread(void *arg)
{
	struct sim_servo *s = arg;
	struct pollfd p[2 + CLIENTS_MAX];

	for (;;) {
		p[0] = (struct pollfd){.fd = s->stop[0], .events = POLLIN};
		p[1] = (struct pollfd){.fd = s->port ? s->listener : s->master, .events = POLLIN};
		for (int i = 0; i < CLIENTS_MAX; i++)
			p[2 + i] = (struct pollfd){.fd = s->client[i], .events = POLLIN};
		if (poll(p, 2 + CLIENTS_MAX, advance(s)) < 0 && errno != EINTR)
			return NULL;
		if (p[0].revents)
			return NULL;
		if (p[1].revents && s->port)
			accept_client(s);
		else if (p[1].revents && !serve(s) && !s->modbus)
			return NULL;
		for (int i = 0; i < CLIENTS_MAX; i++)
			if (p[2 + i].revents && s->client[i] >= 0)
				serve_client(s, i);
	}
}

/* A pseudo-terminal whose slave is raw and stays open, and the link to it. */
static int open_pty(struct sim_servo *s, const char *link)
{
	struct termios raw;
	char name[64];

	if (strlen(link) >= sizeof s->link)
		return -ENAMETOOLONG;
	s->master = posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC | O_NONBLOCK);
	if (s->master < 0 || grantpt(s->master) < 0 || unlockpt(s->master) < 0 ||
	    ptsname_r(s->master, name, sizeof name))
		return -errno;
	s->slave_fd = open(name, O_RDWR | O_NOCTTY | O_CLOEXEC);
	if (s->slave_fd < 0 || tcgetattr(s->slave_fd, &raw) < 0)
		return -errno;
	cfmakeraw(&raw);
	if (tcsetattr(s->slave_fd, TCSANOW, &raw) < 0)
		return -errno;
	unlink(link);
	if (symlink(name, link) < 0)
		return -errno;
	strcpy(s->link, link);
	return speak_rtu(s);
}

static int open_tcp(struct sim_servo *s, const char *address)
{
	const char *colon = strrchr(address, ':');
	struct sockaddr_storage bound;
	socklen_t len = sizeof bound;
	char host[64];

	if (!colon || (size_t)(colon - address) >= sizeof host)
		return -EINVAL;
	snprintf(host, sizeof host, "%.*s", (int)(colon - address), address);
	s->modbus = modbus_new_tcp_pi(host, colon + 1);
	if (!s->modbus)
		return -errno;
	s->listener = modbus_tcp_pi_listen(s->modbus, CLIENTS_MAX);
	if (s->listener < 0 || getsockname(s->listener, (struct sockaddr *)&bound, &len) < 0)
		return -errno;
	fcntl(s->listener, F_SETFD, FD_CLOEXEC);
	modbus_set_byte_timeout(s->modbus, 0, REQUEST_US);
	s->port = ntohs(bound.ss_family == AF_INET6 ? ((struct sockaddr_in6 *)&bound)->sin6_port
	                                            : ((struct sockaddr_in *)&bound)->sin_port);
	return 0;
}

static int start(struct sim_servo *s)
{
	sigset_t all, before;
	int r;

	if (pipe2(s->stop, O_CLOEXEC) < 0)
		return -errno;
	sigfillset(&all);
	pthread_sigmask(SIG_SETMASK, &all, &before); /* signals are the loop's */
	r = pthread_create(&s->thread, NULL, servo_thread, s);
	pthread_sigmask(SIG_SETMASK, &before, NULL);
	s->running = !r;
	return -r;
}

struct sim_servo *sim_servo_create(const struct sim_servo_params *params, char error[160])
{
	struct sim_servo *s = calloc(1, sizeof *s);
	const char *where = params->rtu ? params->rtu : params->tcp;
	struct sim_drive_params drive = {.unit = params->slave, .angle_rad = params->angle_rad};
	int r;

	if (params->drive)
		drive = *params->drive;
	drive.unit = params->slave;
	drive.angle_rad = params->angle_rad;
	drive.axis = NULL;
	if (s)
		s->drive = sim_drive_create(&drive, now_ns());
	if (!s || !s->drive) {
		free(s);
		snprintf(error, 160, "out of memory");
		return NULL;
	}
	s->slave = params->slave;
	s->master = s->slave_fd = s->listener = s->stop[0] = s->stop[1] = -1;
	for (int i = 0; i < CLIENTS_MAX; i++)
		s->client[i] = -1;
	pthread_mutex_init(&s->lock, NULL);
	r = params->rtu ? open_pty(s, params->rtu) : open_tcp(s, params->tcp);
	if (!r)
		r = start(s);
	if (!r)
		return s;
	snprintf(error, 160, "%.80s: the simulated servo cannot stand there: %s", where, modbus_strerror(-r));
	sim_servo_destroy(s);
	return NULL;
}

static void close_if(int fd)
{
	if (fd >= 0)
		close(fd);
}

void sim_servo_destroy(struct sim_servo *s)
{
	if (!s)
		return;
	if (s->running) {
		(void)!write(s->stop[1], "", 1);
		pthread_join(s->thread, NULL);
	}
	if (*s->link)
		unlink(s->link);
	for (int i = 0; i < CLIENTS_MAX; i++)
		close_if(s->client[i]);
	close_if(s->master);
	close_if(s->slave_fd);
	close_if(s->listener);
	close_if(s->stop[0]);
	close_if(s->stop[1]);
	if (s->modbus)
		modbus_free(s->modbus);
	sim_drive_destroy(s->drive);
	pthread_mutex_destroy(&s->lock);
	free(s);
}

int sim_servo_port(const struct sim_servo *s)
{
	return s->port;
}

double sim_servo_angle(struct sim_servo *s, int64_t t_ns)
{
	double angle_rad;

	pthread_mutex_lock(&s->lock);
	sim_drive_advance(s->drive, now_ns());
	angle_rad = sim_axis_angle(sim_drive_axis(s->drive), t_ns);
	pthread_mutex_unlock(&s->lock);
	return angle_rad;
}

void sim_servo_place(struct sim_servo *s, double angle_rad)
{
	pthread_mutex_lock(&s->lock);
	sim_drive_place(s->drive, angle_rad, now_ns());
	s->pending = false; /* it carried the angle of before */
	pthread_mutex_unlock(&s->lock);
}

uint64_t sim_servo_answers(struct sim_servo *s)
{
	uint64_t answers;

	pthread_mutex_lock(&s->lock);
	answers = s->answers;
	pthread_mutex_unlock(&s->lock);
	return answers;
}

const char *const *sim_servo_fault_kinds(void)
{
	return sim_drive_fault_kinds();
}

bool sim_servo_fault(struct sim_servo *s, const struct sim_fault *fault, bool on)
{
	bool known;

	pthread_mutex_lock(&s->lock);
	known = sim_drive_fault(s->drive, fault, on, now_ns());
	pthread_mutex_unlock(&s->lock);
	return known;
}

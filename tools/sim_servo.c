/* A servo behind Modbus: a libmodbus server in a thread of its own, on a pseudo-terminal or on TCP.
 *
 * The servo moves with its speed towards its target, in a straight line of angle over time; each change of target,
 * speed or place begins a new *leg*, and the last legs are kept, so that the angle at any time of the last seconds can
 * be computed, which is what the simulated scanner asks for beam by beam. Nothing is advanced by a timer: where it
 * stands is a function of time.
 *
 * A pseudo-terminal has no parity and takes every rate: the line is 8N1 and its rate means nothing. The slave is made
 * raw before anybody opens it (a fresh one echoes), and kept open here, so that a driver that comes and goes does not
 * end the line. libmodbus is given the master's descriptor and never opens anything itself.
 *
 * Who plays a recording through it wants to know which answers its reader took: an answer that came after the reader's
 * time-out was thrown away, and one that was slow on its way is refused by a careful reader. The servo sees neither, but
 * it sees when the next request comes. An answer counts when the pause before its request and the pause after it are
 * both as short as such pauses usually are (the median of the last ones, and a millisecond).
 *
 * Times are CLOCK_MONOTONIC in ns, as uv_hrtime says them. */
#include "tools/sim_device.h"

#include <errno.h>
#include <fcntl.h>
#include <math.h>
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

#include "core/trig.h"

#define LEGS          64      /* a power of two; older movement is forgotten */
#define CLIENTS_MAX   4       /* one more is closed at once */
#define SPEED_DEFAULT 30000.0 /* 0.001 degree/s */
#define COUNT_RAD     (0.001 * TRIG_DEG)
#define REQUEST_US    500000 /* a frame that began is whole by then, or dropped */
#define PAUSES        31
#define PAUSE_MORE_NS 1000000
#define PAUSE_MAX_NS  200000000 /* shorter than any reader's time-out and recovery */

struct leg { /* from t_ns on; counts of 0.001 degree */
	int64_t t_ns;
	double from, to, speed;
};

static const char *const kinds[] = {"silence", "lost", "busy", "late", NULL};
enum fault { SILENCE, LOST, BUSY, LATE, FAULTS };

struct sim_servo {
	int slave;
	char link[108]; /* empty: TCP */
	int master, slave_fd, listener, stop[2];
	int port;
	int client[CLIENTS_MAX];
	modbus_t *modbus;
	modbus_mapping_t *map;
	pthread_t thread;
	bool running;

	pthread_mutex_t lock; /* of what follows */
	struct leg leg[LEGS];
	uint32_t legs; /* ever begun; the newest is (legs - 1) % LEGS */
	uint64_t answers;
	int64_t pause_ns[PAUSES]; /* between an answer and the next request */
	uint32_t pauses;
	int64_t answered_ns; /* the last answer, of whatever */
	bool prompt;         /* the request before it came in good time */
	struct sim_fault_state fault[FAULTS];
	uint64_t random;
	bool pending; /* it carried the angle, and is to be counted when the next request comes */
};

static int64_t now_ns(void)
{
	struct timespec ts;

	clock_gettime(CLOCK_MONOTONIC, &ts);
	return (int64_t)ts.tv_sec * 1000000000 + ts.tv_nsec;
}

static double leg_position(const struct leg *leg, int64_t t_ns)
{
	double way = leg->speed * (double)(t_ns - leg->t_ns) * 1e-9, whole = leg->to - leg->from;

	if (t_ns <= leg->t_ns)
		return leg->from;
	if (way >= fabs(whole))
		return leg->to;
	return leg->from + (whole < 0.0 ? -way : way);
}

static const struct leg *leg_at(const struct sim_servo *s, int64_t t_ns)
{
	uint32_t oldest = s->legs > LEGS ? s->legs - LEGS : 0, i = s->legs - 1;

	while (i > oldest && s->leg[i % LEGS].t_ns > t_ns)
		i--;
	return &s->leg[i % LEGS];
}

static double position(const struct sim_servo *s, int64_t t_ns)
{
	return leg_position(leg_at(s, t_ns), t_ns);
}

static void begin_leg(struct sim_servo *s, int64_t t_ns, double from, double to, double speed)
{
	s->leg[s->legs++ % LEGS] = (struct leg){t_ns, from, to, speed};
}

static void put32(uint16_t *registers, int at, int32_t value)
{
	registers[at] = (uint16_t)((uint32_t)value >> 16);
	registers[at + 1] = (uint16_t)value;
}

static int32_t get32(const uint16_t *registers, int at)
{
	return (int32_t)((uint32_t)registers[at] << 16 | registers[at + 1]);
}

/* The registers as they are now; both register kinds show the same. */
static void fill_registers(struct sim_servo *s, int64_t t_ns)
{
	const struct leg *leg = leg_at(s, t_ns);
	double at = leg_position(leg, t_ns);
	uint16_t *r = s->map->tab_registers;

	put32(r, SIM_SERVO_POSITION, (int32_t)rint(at));
	put32(r, SIM_SERVO_TARGET, (int32_t)rint(leg->to));
	put32(r, SIM_SERVO_SPEED, (int32_t)(uint32_t)rint(leg->speed));
	r[SIM_SERVO_MOVING] = at != leg->to;
	memcpy(s->map->tab_input_registers, r, SIM_SERVO_REGISTERS * sizeof *r);
}

/* A write may have changed target or speed: then it goes on from where it is. */
static void take_registers(struct sim_servo *s, int64_t t_ns)
{
	const struct leg *leg = leg_at(s, t_ns);
	const uint16_t *r = s->map->tab_registers;
	double to = get32(r, SIM_SERVO_TARGET), speed = (uint32_t)get32(r, SIM_SERVO_SPEED);

	if (to != rint(leg->to) || speed != rint(leg->speed))
		begin_leg(s, t_ns, leg_position(leg, t_ns), to, speed);
}

static bool reads_position(const uint8_t *pdu)
{
	int address = pdu[1] << 8 | pdu[2], n = pdu[3] << 8 | pdu[4];

	return (pdu[0] == 3 || pdu[0] == 4) && address <= SIM_SERVO_POSITION && address + n >= SIM_SERVO_POSITION + 2;
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

/* The registers are filled. False: this request is not answered, or by an exception. Late, the answer carries the angle of
 * before. The lock is let go of meanwhile; who ends the thread ends the wait. */
static bool befalls(struct sim_servo *s, const uint8_t *request)
{
	struct pollfd stop = {.fd = s->stop[0], .events = POLLIN};

	if (s->fault[SILENCE].on || (s->fault[LOST].on && sim_random(&s->random) < s->fault[LOST].value) ||
	    (!s->fault[LOST].on && sim_fault_due(&s->fault[LOST])))
		return false;
	if (sim_fault_due(&s->fault[BUSY])) {
		modbus_reply_exception(s->modbus, request, MODBUS_EXCEPTION_SLAVE_OR_SERVER_BUSY);
		return false;
	}
	if (sim_fault_due(&s->fault[LATE])) {
		int ms = (int)sim_fault_value(&s->fault[LATE], 20.0);

		pthread_mutex_unlock(&s->lock);
		poll(&stop, 1, ms);
		pthread_mutex_lock(&s->lock);
	}
	return true;
}

/* One request of the current line. False: the line is lost. An answer counts with the angle it carries. */
static bool serve(struct sim_servo *s)
{
	uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
	int n = modbus_receive(s->modbus, request), header = modbus_get_header_length(s->modbus);
	int64_t t_ns;

	if (n < 0)
		return errno == EMBBADCRC || errno == ETIMEDOUT || errno == EMBBADDATA;
	/* For another unit: libmodbus would take the next request for that unit's answer, but nobody else is on this line. */
	if (n == 0)
		return s->port || speak_rtu(s) == 0;
	if (s->port && request[header - 1] != s->slave && request[header - 1] != MODBUS_TCP_SLAVE)
		return true;
	pthread_mutex_lock(&s->lock);
	t_ns = now_ns(); /* what a write asks for begins before its answer is seen */
	judge_last_answer(s, t_ns);
	fill_registers(s, t_ns);
	if (!befalls(s, request)) {
		pthread_mutex_unlock(&s->lock);
		return true;
	}
	n = modbus_reply(s->modbus, request, n, s->map);
	take_registers(s, t_ns);
	s->pending = n >= 0 && reads_position(request + header);
	s->answered_ns = now_ns();
	pthread_mutex_unlock(&s->lock);
	return n >= 0;
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

static void *servo_thread(void *arg)
{
	struct sim_servo *s = arg;
	struct pollfd p[2 + CLIENTS_MAX];

	for (;;) {
		p[0] = (struct pollfd){.fd = s->stop[0], .events = POLLIN};
		p[1] = (struct pollfd){.fd = s->port ? s->listener : s->master, .events = POLLIN};
		for (int i = 0; i < CLIENTS_MAX; i++)
			p[2 + i] = (struct pollfd){.fd = s->client[i], .events = POLLIN};
		if (poll(p, 2 + CLIENTS_MAX, -1) < 0 && errno != EINTR)
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

	s->map = modbus_mapping_new(0, 0, SIM_SERVO_REGISTERS, SIM_SERVO_REGISTERS);
	if (!s->map || pipe2(s->stop, O_CLOEXEC) < 0)
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
	double at = params->angle_rad / COUNT_RAD;
	int r;

	if (!s) {
		snprintf(error, 160, "out of memory");
		return NULL;
	}
	s->slave = params->slave;
	s->master = s->slave_fd = s->listener = s->stop[0] = s->stop[1] = -1;
	for (int i = 0; i < CLIENTS_MAX; i++)
		s->client[i] = -1;
	pthread_mutex_init(&s->lock, NULL);
	begin_leg(s, now_ns(), at, at, SPEED_DEFAULT);
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
	if (s->map)
		modbus_mapping_free(s->map);
	pthread_mutex_destroy(&s->lock);
	free(s);
}

int sim_servo_port(const struct sim_servo *s)
{
	return s->port;
}

double sim_servo_angle(struct sim_servo *s, int64_t t_ns)
{
	double at;

	pthread_mutex_lock(&s->lock);
	at = position(s, t_ns);
	pthread_mutex_unlock(&s->lock);
	return at * COUNT_RAD;
}

void sim_servo_place(struct sim_servo *s, double angle_rad)
{
	double at = angle_rad / COUNT_RAD;

	pthread_mutex_lock(&s->lock);
	begin_leg(s, now_ns(), at, at, leg_at(s, now_ns())->speed);
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
	return kinds;
}

bool sim_servo_fault(struct sim_servo *s, const struct sim_fault *fault, bool on)
{
	int i = sim_fault_index(kinds, fault->kind);

	if (i < 0)
		return false;
	pthread_mutex_lock(&s->lock);
	sim_fault_set(&s->fault[i], fault, on);
	if (i == LOST && s->fault[i].value == 0.0)
		s->fault[i].value = 1.0;
	pthread_mutex_unlock(&s->lock);
	return true;
}

/* Law L8: whatever the bus does, the loop goes on: late, lost, refused, hung. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <netdb.h>
#include <netinet/in.h>
#include <poll.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/file.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "tests/modbus_peer.h"
#include "tests/modbus_servo.h"

static int64_t now_ns(void)
{
	struct timespec ts;

	clock_gettime(CLOCK_MONOTONIC, &ts);
	return (int64_t)ts.tv_sec * 1000000000 + ts.tv_nsec;
}

/* ---- the bus ---- */

static char dir[64], rtu[96];

static int make_dir(void **state)
{
	(void)state;
	strcpy(dir, "/tmp/test_modbus.XXXXXX");
	if (!mkdtemp(dir))
		return -1;
	snprintf(rtu, sizeof rtu, "%s/servo", dir);
	return 0;
}

static int remove_dir(void **state)
{
	(void)state;
	return rmdir(dir);
}

/* Waits at most two minutes for what the link says next: bytes, or -errno. */
static ssize_t await(struct link *link, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	struct pollfd p = {.fd = driver_modbus.link_fd(link), .events = POLLIN};

	assert_int_equal(poll(&p, 1, 120000), 1);
	*t_ns = now_ns();
	return driver_modbus.link_read(link, buf, cap, t_ns);
}

static void read_angles(const struct config_device *device, struct sim_servo *servo, int n)
{
	struct decoder *decoder = driver_modbus.decoder_create(device, 0);
	struct seen seen = {0};
	struct record_sink sink = sink_of(&seen);
	char error[160] = "";
	struct link *link = driver_modbus.link_open(device, error);
	uint8_t buf[MODBUS_WIRE_MAX];

	assert_string_equal(error, "");
	while (seen.tilts < n) {
		struct record record = {.bytes = buf};
		ssize_t len = await(link, buf, sizeof buf, &record.t_ns);

		assert_true(len > 0);
		record.len = (size_t)len;
		driver_modbus.decode(decoder, &record, &sink);
		assert_true(fabs(seen.tilt.angle_rad + sim_servo_angle(servo, seen.tilt.t_ns)) < 0.0006 * DEG);
	}
	driver_modbus.link_close(link);
	driver_modbus.decoder_destroy(decoder);
}

static void angles_come_over_a_serial_line(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 1, .angle_rad = 12.345 * DEG};
	struct config config = servo_config();
	char error[160] = "";
	struct sim_servo *servo = sim_servo_create(&params, error);

	(void)state;
	assert_string_equal(error, "");
	strcpy(config.device[0].connect, rtu);
	read_angles(&config.device[0], servo, 50);
	read_angles(&config.device[0], servo, 5); /* the line can be opened again */
	sim_servo_destroy(servo);
}

static void angles_come_over_tcp_and_from_input_registers(void **state)
{
	struct sim_servo_params params = {.tcp = "127.0.0.1:0", .slave = 1, .angle_rad = -0.5};
	struct config config = servo_config();
	char error[160] = "";
	struct sim_servo *servo = sim_servo_create(&params, error);

	(void)state;
	assert_string_equal(error, "");
	snprintf(config.device[0].connect, sizeof config.device[0].connect, "a.servo:%d", sim_servo_port(servo));
	config.device[0].position.function = 4;
	config.device[0].position.address = 1;
	config.device[0].address_base = 1;
	read_angles(&config.device[0], servo, 50);
	sim_servo_destroy(servo);
}

static void a_wish_is_written_and_its_answer_comes_back(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 1};
	struct modbus_transaction wish = {.unit = 1,
	                                  .function = 16,
	                                  .address = SIM_SERVO_TARGET,
	                                  .n = 2,
	                                  .value = {0, 5000}},
	                          t = {0};
	struct config config = servo_config();
	uint8_t buf[MODBUS_WIRE_MAX];
	char error[160] = "";
	struct sim_servo *servo = sim_servo_create(&params, error);
	struct link *link;
	int64_t t_ns;

	(void)state;
	strcpy(config.device[0].connect, rtu);
	link = driver_modbus.link_open(&config.device[0], error);
	assert_non_null(link);
	assert_true(driver_modbus.link_write(link, buf, modbus_wire_put(&wish, buf)) > 0);
	for (int i = 0; i < 1000 && t.function != 16; i++) {
		ssize_t len = await(link, buf, sizeof buf, &t_ns);

		assert_true(len > 0);
		assert_int_equal(modbus_wire_get(buf, (size_t)len, &t), len);
		assert_true(t.t_answer_ns >= t.t_request_ns && t.t_answer_ns <= now_ns());
	}
	assert_int_equal(t.function, 16);
	assert_true(fabs(sim_servo_angle(servo, now_ns() + INT64_C(1000000000)) - 5.0 * DEG) < 1e-9);
	driver_modbus.link_close(link);
	sim_servo_destroy(servo);
}

static void a_register_that_is_not_there_is_a_refusal_not_a_lost_bus(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 1};
	struct config config = servo_config();
	struct modbus_transaction t;
	uint8_t buf[MODBUS_WIRE_MAX];
	char error[160] = "";
	struct sim_servo *servo = sim_servo_create(&params, error);
	struct link *link;
	int64_t t_ns;

	(void)state;
	strcpy(config.device[0].connect, rtu);
	config.device[0].position.address = 400;
	link = driver_modbus.link_open(&config.device[0], error);
	for (int i = 0; i < 5; i++) {
		ssize_t len = await(link, buf, sizeof buf, &t_ns);

		assert_true(len > 0);
		assert_int_equal(modbus_wire_get(buf, (size_t)len, &t), len);
		assert_int_equal(t.function, 3 | MODBUS_WIRE_REFUSED);
		assert_int_equal(t.value[0], 2);
	}
	driver_modbus.link_close(link);
	sim_servo_destroy(servo);
}

/* Reads until the bus is lost and answers why. */
static ssize_t until_lost(struct link *link)
{
	uint8_t buf[MODBUS_WIRE_MAX];
	ssize_t n;
	int64_t t_ns;

	do
		n = await(link, buf, sizeof buf, &t_ns);
	while (n > 0);
	return n;
}

static void a_lost_bus_is_reported_and_can_be_opened_again(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 1};
	struct config config = servo_config();
	uint8_t buf[MODBUS_WIRE_MAX];
	char error[160] = "";
	struct link *link;
	int64_t t_ns;

	(void)state;
	strcpy(config.device[0].connect, rtu);
	for (int i = 0; i < 3; i++) {
		struct sim_servo *servo = sim_servo_create(&params, error);

		link = driver_modbus.link_open(&config.device[0], error);
		assert_non_null(link);
		assert_true(await(link, buf, sizeof buf, &t_ns) > 0);
		sim_servo_destroy(servo);
		assert_true(until_lost(link) < 0);
		driver_modbus.link_close(link);
	}
	assert_null(driver_modbus.link_open(&config.device[0], error));
	assert_non_null(strstr(error, "plug it in, or correct `connect`"));
}

static void a_host_that_refuses_costs_the_loop_nothing(void **state)
{
	struct sockaddr_in address = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
	struct config config = servo_config();
	int fd = socket(AF_INET, SOCK_STREAM, 0);
	socklen_t len = sizeof address;
	char error[160] = "";
	struct link *link;

	(void)state;
	assert_int_equal(bind(fd, (struct sockaddr *)&address, len), 0); /* bound, and nobody listens */
	assert_int_equal(getsockname(fd, (struct sockaddr *)&address, &len), 0);
	snprintf(config.device[0].connect, sizeof config.device[0].connect, "127.0.0.1:%d", ntohs(address.sin_port));
	link = driver_modbus.link_open(&config.device[0], error);
	assert_non_null(link);
	assert_true(until_lost(link) == -ECONNREFUSED);
	driver_modbus.link_error(link, ECONNREFUSED, error);
	assert_non_null(strstr(error, config.device[0].connect));
	assert_non_null(strstr(error, "check address and port"));
	driver_modbus.link_close(link);
	close(fd);
}

static void a_line_in_use_is_left_alone(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 1};
	struct config config = servo_config();
	uint8_t buf[MODBUS_WIRE_MAX];
	char error[160] = "";
	struct sim_servo *servo = sim_servo_create(&params, error);
	struct link *link;
	int64_t t_ns;
	int other;

	(void)state;
	strcpy(config.device[0].connect, rtu);
	other = open(rtu, O_RDWR | O_NOCTTY); /* another program */
	assert_int_equal(flock(other, LOCK_EX | LOCK_NB), 0);
	link = driver_modbus.link_open(&config.device[0], error);
	assert_true(until_lost(link) == -EBUSY);
	driver_modbus.link_close(link);
	close(other);
	link = driver_modbus.link_open(&config.device[0], error);
	assert_true(await(link, buf, sizeof buf, &t_ns) > 0);
	driver_modbus.link_close(link);
	sim_servo_destroy(servo);
}

/* A resolver that knows a servo, wherever this runs, and for another name does not answer until it is let go. */
static pthread_mutex_t resolver_lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t resolver_changed = PTHREAD_COND_INITIALIZER;
static bool resolver_answers;
static int resolver_waiting;

int getaddrinfo(const char *node, const char *service, const struct addrinfo *hints, struct addrinfo **ret)
{
	int (*real)(const char *, const char *, const struct addrinfo *, struct addrinfo **);

	if (node && !strcmp(node, "never.answers")) {
		pthread_mutex_lock(&resolver_lock);
		resolver_waiting++;
		pthread_cond_broadcast(&resolver_changed);
		while (!resolver_answers)
			pthread_cond_wait(&resolver_changed, &resolver_lock);
		resolver_waiting--;
		pthread_cond_broadcast(&resolver_changed);
		pthread_mutex_unlock(&resolver_lock);
		return EAI_FAIL;
	}
	*(void **)&real = dlsym(RTLD_NEXT, "getaddrinfo");
	return real(node && !strcmp(node, "a.servo") ? "127.0.0.1" : node, service, hints, ret);
}

static void await_resolver(int waiting)
{
	pthread_mutex_lock(&resolver_lock);
	while (resolver_waiting != waiting)
		pthread_cond_wait(&resolver_changed, &resolver_lock);
	pthread_mutex_unlock(&resolver_lock);
}

static void a_resolver_that_hangs_costs_one_thread(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 1};
	struct config config = servo_config(), other = servo_config();
	uint8_t buf[MODBUS_WIRE_MAX];
	char error[160] = "";
	struct sim_servo *servo = sim_servo_create(&params, error);
	struct link *link = NULL;
	int64_t t_ns;

	(void)state;
	strcpy(config.device[0].name, "distant");
	strcpy(config.device[0].connect, "never.answers:502");
	for (int i = 0; i < 100; i++) {
		link = driver_modbus.link_open(&config.device[0], error);
		assert_non_null(link);
		driver_modbus.link_close(link);
	}
	await_resolver(1);
	/* After a while it is said. */
	for (int i = 0; i < 2000 && link; i++, usleep(10000)) {
		link = driver_modbus.link_open(&config.device[0], error);
		if (link)
			driver_modbus.link_close(link);
	}
	assert_null(link);
	assert_non_null(strstr(error, "does the name server answer?"));
	/* Another device is not concerned. */
	strcpy(other.device[0].connect, rtu);
	link = driver_modbus.link_open(&other.device[0], error);
	assert_non_null(link);
	assert_true(await(link, buf, sizeof buf, &t_ns) > 0);
	driver_modbus.link_close(link);
	await_resolver(1);
	pthread_mutex_lock(&resolver_lock);
	resolver_answers = true;
	pthread_cond_broadcast(&resolver_changed);
	pthread_mutex_unlock(&resolver_lock);
	/* It ends, and the device can be opened again. */
	link = NULL;
	for (int i = 0; i < 2000 && !link; i++, usleep(10000))
		link = driver_modbus.link_open(&config.device[0], error);
	assert_non_null(link);
	assert_true(until_lost(link) < 0);
	driver_modbus.link_close(link);
	sim_servo_destroy(servo);
}

/* ---- late answers ---- */

static struct config_device unit_of(const struct peer *peer, int unit)
{
	struct config_device device = servo_config().device[0];

	snprintf(device.name, sizeof device.name, "unit%d", unit);
	strcpy(device.connect, peer->connect);
	device.slave = unit;
	device.period_ns = 5 * MS;
	return device;
}

/* The next record, and that it is the unit's own. 0, or why the bus was lost. */
static int next_answer(struct link *link, int unit, struct modbus_transaction *ret)
{
	uint8_t buf[MODBUS_WIRE_MAX];
	int64_t t_ns;
	ssize_t len = await(link, buf, sizeof buf, &t_ns);

	if (len < 0)
		return (int)len;
	assert_int_equal(modbus_wire_get(buf, (size_t)len, ret), len);
	assert_int_equal(ret->unit, unit);
	if (ret->function == 3)
		assert_int_equal(ret->value[0], unit);
	return 0;
}

/* Five answers; each was made after the late one and after the one before. A machine that is busy elsewhere may make more
 * of them late, and whoever is lost is opened again, as the supervisor does. */
static void take_later_answers(struct link **link, const struct config_device *device, int late)
{
	struct modbus_transaction t;
	char error[160];
	int last = late;

	for (int good = 0; good < 5;) {
		if (next_answer(*link, device->slave, &t) < 0) {
			driver_modbus.link_close(*link);
			*link = driver_modbus.link_open(device, error);
			assert_non_null(*link);
		} else if (t.function == 3) {
			assert_true(t.value[1] > last);
			last = t.value[1];
			good++;
		}
	}
}

static void a_late_answer_is_never_taken_for_the_next_one(void **state)
{
	static struct peer peer; /* outlives a failed test */
	struct modbus_transaction t;
	struct config_device device;
	struct link *link;
	char error[160];

	(void)state;
	for (int tcp = 0; tcp < 2; tcp++) {
		peer_start(&peer, tcp);
		device = unit_of(&peer, 1);
		for (int i = 0; i < 3; i++) {
			peer.late_ms[1] = 700; /* later than the driver's 500 ms */
			const int late = peer.requests[1];

			link = driver_modbus.link_open(&device, error);
			assert_non_null(link);
			assert_int_equal(next_answer(link, 1, &t), 0);
			assert_int_equal(t.function, 3 | MODBUS_WIRE_REFUSED);
			assert_int_equal(t.value[0], 0);
			if (tcp) /* its numbers could be mixed up no more, but libmodbus cannot go on */
				assert_int_equal(next_answer(link, 1, &t), -ETIMEDOUT);
			take_later_answers(&link, &device, late);
			driver_modbus.link_close(link);
			/* It may have been asked once more; that answer is nobody's. */
			for (int seen = -1; seen != peer.requests[1]; usleep(100000))
				seen = peer.requests[1];
		}
		peer_end(&peer);
	}
}

/* ---- several devices on one bus ---- */

struct shared {
	struct peer peer;
	struct config_device device[3];
	struct link *link[3]; /* of units 1 and 2 */
	int answers[3], lost[3];
	int64_t answered_ns[3], gap_ns[3], lost_ns[3];
};

static void share_bus(struct shared *s, bool tcp)
{
	char error[160];

	memset(s, 0, sizeof *s);
	peer_start(&s->peer, tcp);
	for (int unit = 1; unit <= 2; unit++) {
		s->device[unit] = unit_of(&s->peer, unit);
		s->link[unit] = driver_modbus.link_open(&s->device[unit], error);
		assert_non_null(s->link[unit]);
	}
}

static void part_bus(struct shared *s)
{
	for (int unit = 1; unit <= 2; unit++)
		driver_modbus.link_close(s->link[unit]); /* NULL, if it was lost just now */
	peer_end(&s->peer);
}

static void count_answer(struct shared *s, int unit)
{
	struct modbus_transaction t;
	int r = next_answer(s->link[unit], unit, &t);
	int64_t t_ns = now_ns();

	if (r < 0) {
		s->lost[unit]++;
		s->lost_ns[unit] = t_ns;
		driver_modbus.link_close(s->link[unit]);
		s->link[unit] = NULL;
		return;
	}
	if (t.function & MODBUS_WIRE_REFUSED)
		return;
	s->answers[unit]++;
	if (s->answered_ns[unit] && t_ns - s->answered_ns[unit] > s->gap_ns[unit])
		s->gap_ns[unit] = t_ns - s->answered_ns[unit];
	s->answered_ns[unit] = t_ns;
}

/* Reads both until unit 1 has so many more answers; whoever is lost is opened again a second later. */
static void read_both(struct shared *s, int answers)
{
	const int until = s->answers[1] + answers;
	char error[160];

	while (s->answers[1] < until) {
		struct pollfd p[3] = {{.fd = -1}, {.fd = -1}, {.fd = -1}};

		for (int unit = 1; unit <= 2; unit++) {
			if (!s->link[unit] && now_ns() - s->lost_ns[unit] > 1000 * MS)
				s->link[unit] = driver_modbus.link_open(&s->device[unit], error);
			if (s->link[unit])
				p[unit] = (struct pollfd){.fd = driver_modbus.link_fd(s->link[unit]), .events = POLLIN};
		}
		assert_true(poll(p, 3, 1000) >= 0);
		for (int unit = 1; unit <= 2; unit++)
			if (p[unit].revents)
				count_answer(s, unit);
	}
}

/* A machine that is busy elsewhere may make this test's units late: then it is tried again. */
static void two_devices_share_a_bus_and_are_polled_alike(void **state)
{
	(void)state;
	for (int tcp = 0; tcp < 2; tcp++) {
		bool undisturbed = false;

		for (int tries = 0; tries < 20 && !undisturbed; tries++) {
			static struct shared s; /* outlives a failed test */

			share_bus(&s, tcp);
			read_both(&s, 100);
			undisturbed = s.lost[1] + s.lost[2] == 0;
			assert_true(!undisturbed || abs(s.answers[2] - 100) < 20);
			assert_true(!undisturbed || s.peer.connections == tcp);
			part_bus(&s);
		}
		assert_true(undisturbed);
	}
}

static void an_absent_device_costs_the_other_a_tenth_of_a_second_each_second(void **state)
{
	(void)state;
	for (int tcp = 0; tcp < 2; tcp++) {
		static struct shared s;
		int64_t begun_ns;

		share_bus(&s, tcp);
		s.peer.mute[2] = true;
		while (s.lost[2] == 0)
			read_both(&s, 10);
		s.gap_ns[1] = 0;
		begun_ns = now_ns();
		read_both(&s, 400);
		print_message(
		    "note: %s, beside a unit that does not answer: %.0f answers/s of 200, longest gap %.0f ms\n",
		    tcp ? "TCP" : "RTU", 400e9 / (double)(now_ns() - begun_ns), (double)s.gap_ns[1] * 1e-6);
		assert_int_equal(s.answers[2], 0);
		s.peer.mute[2] = false;
		while (s.answers[2] == 0) /* it is back */
			read_both(&s, 10);
		part_bus(&s);
	}
}

static void closing_one_device_leaves_the_other(void **state)
{
	(void)state;
	for (int tcp = 0; tcp < 2; tcp++)
		for (int gone = 1; gone <= 2; gone++) {
			const int other = 3 - gone;
			static struct shared s; /* outlives a failed test */
			char error[160];

			share_bus(&s, tcp);
			while (s.answers[2] < 20)
				read_both(&s, 10);
			driver_modbus.link_close(s.link[gone]);
			s.link[gone] = NULL;
			s.lost_ns[gone] = INT64_MAX; /* not to be opened again */
			s.answers[gone] = s.answers[other] = 0;
			while (s.answers[other] < 50) {
				if (s.link[other])
					count_answer(&s, other);
				else
					s.link[other] = driver_modbus.link_open(&s.device[other], error);
			}
			s.lost_ns[gone] = 0;
			while (s.answers[gone] < 20)
				read_both(&s, gone == 1 ? 10 : 1);
			part_bus(&s);
		}
}

/* next_answer looks whose value it is. */
static void a_late_answer_on_a_shared_line_is_nobody_elses(void **state)
{
	static struct shared s;

	(void)state;
	share_bus(&s, false);
	read_both(&s, 20);
	for (int i = 0; i < 5; i++) {
		s.peer.late_ms[2] = 300; /* later than the 200 ms of a shared bus */
		read_both(&s, 50);
	}
	part_bus(&s);
}

static void a_bus_that_is_lost_is_lost_for_all_and_comes_back_for_all(void **state)
{
	static struct shared s;

	(void)state;
	share_bus(&s, true);
	read_both(&s, 20);
	shutdown(s.peer.fd, SHUT_RDWR);
	read_both(&s, 200);
	assert_true(s.lost[1] >= 1 && s.lost[2] >= 1);
	while (s.answers[2] < 50)
		read_both(&s, 10);
	part_bus(&s);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(angles_come_over_a_serial_line),
	    cmocka_unit_test(angles_come_over_tcp_and_from_input_registers),
	    cmocka_unit_test(a_wish_is_written_and_its_answer_comes_back),
	    cmocka_unit_test(a_register_that_is_not_there_is_a_refusal_not_a_lost_bus),
	    cmocka_unit_test(a_lost_bus_is_reported_and_can_be_opened_again),
	    cmocka_unit_test(a_host_that_refuses_costs_the_loop_nothing),
	    cmocka_unit_test(a_line_in_use_is_left_alone),
	    cmocka_unit_test(a_resolver_that_hangs_costs_one_thread),
	    cmocka_unit_test(a_late_answer_is_never_taken_for_the_next_one),
	    cmocka_unit_test(two_devices_share_a_bus_and_are_polled_alike),
	    cmocka_unit_test(an_absent_device_costs_the_other_a_tenth_of_a_second_each_second),
	    cmocka_unit_test(closing_one_device_leaves_the_other),
	    cmocka_unit_test(a_late_answer_on_a_shared_line_is_nobody_elses),
	    cmocka_unit_test(a_bus_that_is_lost_is_lost_for_all_and_comes_back_for_all),
	};

	return cmocka_run_group_tests(tests, make_dir, remove_dir);
}

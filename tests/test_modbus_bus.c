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
#include <modbus.h>
#include <netdb.h>
#include <netinet/in.h>
#include <poll.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

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

/* Waits at most 20 s for what the link says next: bytes, or -errno. */
static ssize_t await(struct link *link, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	struct pollfd p = {.fd = driver_modbus.link_fd(link), .events = POLLIN};

	assert_int_equal(poll(&p, 1, 20000), 1);
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
	struct link *first, *second;
	int64_t t_ns;

	(void)state;
	strcpy(config.device[0].connect, rtu);
	first = driver_modbus.link_open(&config.device[0], error);
	assert_true(await(first, buf, sizeof buf, &t_ns) > 0);
	second = driver_modbus.link_open(&config.device[0], error);
	assert_true(until_lost(second) == -EBUSY);
	assert_true(await(first, buf, sizeof buf, &t_ns) > 0);
	driver_modbus.link_close(second);
	driver_modbus.link_close(first);
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

static void a_resolver_that_hangs_costs_a_bounded_number_of_threads(void **state)
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
	for (int i = 0; i < MODBUS_THREADS_MAX; i++) {
		link = driver_modbus.link_open(&config.device[0], error);
		assert_non_null(link);
		driver_modbus.link_close(link);
	}
	await_resolver(MODBUS_THREADS_MAX);
	for (int i = 0; i < 100; i++)
		assert_null(driver_modbus.link_open(&config.device[0], error));
	assert_non_null(strstr(error, "4 earlier tries"));
	/* Another device is not concerned. */
	strcpy(other.device[0].connect, rtu);
	link = driver_modbus.link_open(&other.device[0], error);
	assert_non_null(link);
	assert_true(await(link, buf, sizeof buf, &t_ns) > 0);
	driver_modbus.link_close(link);
	pthread_mutex_lock(&resolver_lock);
	resolver_answers = true;
	pthread_cond_broadcast(&resolver_changed);
	pthread_mutex_unlock(&resolver_lock);
	/* They end, and the device can be opened again. */
	link = NULL;
	for (int i = 0; i < 2000 && !link; i++, usleep(10000))
		link = driver_modbus.link_open(&config.device[0], error);
	assert_non_null(link);
	assert_true(until_lost(link) < 0);
	driver_modbus.link_close(link);
	sim_servo_destroy(servo);
}

/* A peer that answers the first request only after its time-out, and each answer carries its number. */
struct late_peer {
	int master;
	modbus_t *modbus;
	atomic_bool stop;
};

static void *late_peer_thread(void *arg)
{
	struct late_peer *peer = arg;
	modbus_mapping_t *map = modbus_mapping_new(0, 0, 4, 4);
	uint8_t request[MODBUS_RTU_MAX_ADU_LENGTH];
	int served = 0;

	while (!peer->stop) {
		struct pollfd p = {.fd = peer->master, .events = POLLIN};

		if (poll(&p, 1, 20) <= 0)
			continue;
		int n = modbus_receive(peer->modbus, request);

		if (n <= 0)
			continue;
		map->tab_registers[1] = (uint16_t)served;
		if (served++ == 0)
			usleep(700000); /* later than the driver's 500 ms */
		modbus_reply(peer->modbus, request, n, map);
	}
	modbus_mapping_free(map);
	return NULL;
}

static void a_late_answer_is_never_taken_for_the_next_one(void **state)
{
	struct config config = servo_config();
	struct late_peer peer = {.master = posix_openpt(O_RDWR | O_NOCTTY)};
	struct modbus_transaction t;
	struct termios raw;
	uint8_t buf[MODBUS_WIRE_MAX];
	char error[160] = "", name[64];
	struct link *link;
	pthread_t thread;
	int64_t t_ns;
	ssize_t len;
	int slave;

	(void)state;
	assert_int_equal(grantpt(peer.master) | unlockpt(peer.master) | ptsname_r(peer.master, name, sizeof name), 0);
	slave = open(name, O_RDWR | O_NOCTTY);
	tcgetattr(slave, &raw);
	cfmakeraw(&raw);
	tcsetattr(slave, TCSANOW, &raw);
	peer.modbus = modbus_new_rtu(name, 115200, 'N', 8, 1);
	modbus_set_slave(peer.modbus, 1);
	modbus_set_socket(peer.modbus, peer.master);
	pthread_create(&thread, NULL, late_peer_thread, &peer);
	snprintf(config.device[0].connect, sizeof config.device[0].connect, "%s", name);
	link = driver_modbus.link_open(&config.device[0], error);
	assert_non_null(link);
	len = await(link, buf, sizeof buf, &t_ns);
	assert_int_equal(modbus_wire_get(buf, (size_t)len, &t), len);
	assert_int_equal(t.function, 3 | MODBUS_WIRE_REFUSED);
	assert_int_equal(t.value[0], 0);
	for (int i = 1; i < 5; i++) { /* the answer numbered 0 is never seen */
		len = await(link, buf, sizeof buf, &t_ns);
		assert_int_equal(modbus_wire_get(buf, (size_t)len, &t), len);
		assert_int_equal(t.function, 3);
		assert_int_equal(t.value[1], i);
	}
	driver_modbus.link_close(link);
	peer.stop = true;
	pthread_join(thread, NULL);
	modbus_free(peer.modbus);
	close(slave);
	close(peer.master);
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
	    cmocka_unit_test(a_resolver_that_hangs_costs_a_bounded_number_of_threads),
	    cmocka_unit_test(a_late_answer_is_never_taken_for_the_next_one),
	};

	return cmocka_run_group_tests(tests, make_dir, remove_dir);
}

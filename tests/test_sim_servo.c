/* The simulated servo is a device: it moves with its speed, and independent Modbus clients can read and write it. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <errno.h>
#include <math.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "core/trig.h"
#include "tools/sim_device.h"

#define DEG    TRIG_DEG
#define SECOND INT64_C(1000000000)

static char dir[64], rtu[96];

static int make_dir(void **state)
{
	(void)state;
	strcpy(dir, "/tmp/test_sim_servo.XXXXXX");
	if (!mkdtemp(dir))
		return -1;
	snprintf(rtu, sizeof rtu, "%s/servo", dir);
	return 0;
}

static int remove_dir(void **state)
{
	(void)state;
	return rmdir(dir); /* fails where a link was left */
}

static int64_t now_ns(void)
{
	struct timespec ts;

	clock_gettime(CLOCK_MONOTONIC, &ts);
	return (int64_t)ts.tv_sec * SECOND + ts.tv_nsec;
}

static struct sim_servo *create(const struct sim_servo_params *params)
{
	char error[160] = "";
	struct sim_servo *servo = sim_servo_create(params, error);

	assert_string_equal(error, "");
	return servo;
}

static modbus_t *client(const char *path)
{
	modbus_t *modbus = modbus_new_rtu(path, 115200, 'N', 8, 1);

	modbus_set_slave(modbus, 3);
	modbus_set_response_timeout(modbus, 60, 0);
	assert_int_equal(modbus_connect(modbus), 0);
	return modbus;
}

static int32_t position_of(modbus_t *modbus)
{
	uint16_t r[2];

	assert_int_equal(modbus_read_registers(modbus, SIM_SERVO_POSITION, 2, r), 2);
	return (int32_t)((uint32_t)r[0] << 16 | r[1]);
}

static void it_moves_with_its_speed_and_stops_at_its_target(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 3, .angle_rad = -10.0 * DEG};
	struct sim_servo *servo = create(&params);
	modbus_t *modbus = client(rtu);
	uint16_t speed[2] = {0, 20000}, target[2] = {0, 30000}; /* 20 degrees a second, to 30 degrees: two seconds */
	int64_t before, after;

	(void)state;
	assert_int_equal(position_of(modbus), -10000);
	assert_int_equal(modbus_write_registers(modbus, SIM_SERVO_SPEED, 2, speed), 2);
	before = now_ns();
	assert_int_equal(modbus_write_registers(modbus, SIM_SERVO_TARGET, 2, target), 2);
	after = now_ns();
	/* Where it is at a time to come is a function of time: it began between before and after. */
	assert_true(sim_servo_angle(servo, before + SECOND) <= 10.0 * DEG + 1e-9);
	assert_true(sim_servo_angle(servo, after + SECOND) >= 10.0 * DEG - 1e-9);
	assert_true(fabs(sim_servo_angle(servo, after + 2 * SECOND) - 30.0 * DEG) < 1e-12);
	assert_true(fabs(sim_servo_angle(servo, after + 9 * SECOND) - 30.0 * DEG) < 1e-12);
	assert_true(fabs(sim_servo_angle(servo, before - SECOND / 1000) + 10.0 * DEG) < 1e-12);
	modbus_close(modbus);
	modbus_free(modbus);
	sim_servo_destroy(servo);
}

static void a_new_target_on_the_way_turns_it_where_it_is(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 3};
	struct sim_servo *servo = create(&params);
	modbus_t *modbus = client(rtu);
	uint16_t up[2] = {0, 40000}, down[2] = {0xffff, 0x63c0}; /* 40 and -40 degrees at 30 degrees a second */
	double there;
	int64_t begin_ns = now_ns(), t_ns;

	(void)state;
	modbus_write_registers(modbus, SIM_SERVO_TARGET, 2, up);
	usleep(50000);
	modbus_write_registers(modbus, SIM_SERVO_TARGET, 2, down);
	t_ns = now_ns();
	there = sim_servo_angle(servo, t_ns);
	assert_true(there <= 40.0 * DEG);
	/* the past stays as it was: it was never higher than where it could have come, and it did rise */
	double peak = 0.0, last = 0.0;

	for (int64_t t = begin_ns; t <= t_ns; t += 100000) {
		double angle = sim_servo_angle(servo, t);

		assert_true(fabs(angle - last) < 30.0 * DEG * 1e-4 + 1e-12);
		peak = fmax(peak, angle);
		last = angle;
	}
	assert_true(peak >= 30.0 * 0.05 * DEG - 1e-9);
	assert_true(fabs(sim_servo_angle(servo, t_ns + SECOND) - fmax(there - 30.0 * DEG, -40.0 * DEG)) < 1e-9);
	assert_true(fabs(sim_servo_angle(servo, t_ns + 20 * SECOND) + 40.0 * DEG) < 1e-9);
	modbus_close(modbus);
	modbus_free(modbus);
	sim_servo_destroy(servo);
}

/* An answer is known to be taken when the next request comes as soon as requests usually do. */
static void answers_after_a_step_carry_the_new_angle_and_count_when_they_were_taken(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 3};
	struct sim_servo *servo = create(&params);
	modbus_t *modbus = client(rtu);
	uint64_t before, counted = 0;
	uint16_t moving[1];

	(void)state;
	for (int i = 0; i < 50; i++) {
		sim_servo_place(servo, i * 0.25 * DEG);
		before = sim_servo_answers(servo);
		assert_int_equal(position_of(modbus), i * 250);
		assert_int_equal(sim_servo_answers(servo), before); /* nobody knows yet */
		for (int k = 0; k < 5; k++)
			assert_int_equal(position_of(modbus), i * 250);
		assert_in_range(sim_servo_answers(servo) - before, 0, 5);
		counted += sim_servo_answers(servo) - before;
	}
	assert_in_range(counted, 50, 250); /* half of all pauses are not longer than the median */
	/* an answer after which the reader fell silent was lost; reading something else is no answer of the angle */
	position_of(modbus);
	before = sim_servo_answers(servo);
	usleep(250000);
	for (int i = 0; i < 3; i++)
		assert_int_equal(modbus_read_input_registers(modbus, SIM_SERVO_MOVING, 1, moving), 1);
	assert_int_equal(moving[0], 0);
	assert_int_equal(sim_servo_answers(servo), before);
	modbus_close(modbus);
	modbus_free(modbus);
	sim_servo_destroy(servo);
}

static void requests_for_others_and_garbage_get_no_answer_and_do_no_harm(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 3};
	struct sim_servo *servo = create(&params);
	modbus_t *modbus = client(rtu);
	static const uint8_t garbage[] = {3, 3, 0, 0, 0, 2, 0xde, 0xad};
	uint16_t r[2];

	(void)state;
	modbus_set_slave(modbus, 9);
	modbus_set_response_timeout(modbus, 0, 100000);
	assert_int_equal(modbus_read_registers(modbus, 0, 2, r), -1);
	assert_int_equal(errno, ETIMEDOUT);
	assert_int_equal(write(modbus_get_socket(modbus), garbage, sizeof garbage), sizeof garbage);
	/* Where nobody took the garbage so far, the next request is a part of it. */
	usleep(50000);
	modbus_set_slave(modbus, 3);
	modbus_set_response_timeout(modbus, 1, 0);
	for (int i = 0; i < 60 && (errno = 0, modbus_read_registers(modbus, 100, 2, r)) == -1 && errno == ETIMEDOUT;)
		i++;
	assert_int_equal(errno, EMBXILADD);
	modbus_set_response_timeout(modbus, 60, 0);
	assert_int_equal(position_of(modbus), 0);
	modbus_close(modbus);
	modbus_free(modbus);
	sim_servo_destroy(servo);
}

static void several_clients_are_served_over_tcp(void **state)
{
	struct sim_servo_params params = {.tcp = "127.0.0.1:0", .slave = 3, .angle_rad = 5.0 * DEG};
	struct sim_servo *servo = create(&params);
	modbus_t *modbus[6];
	uint16_t r[2];
	int served = 0;

	(void)state;
	for (int i = 0; i < 6; i++) {
		modbus[i] = modbus_new_tcp("127.0.0.1", sim_servo_port(servo));
		modbus_set_slave(modbus[i], 3);
		modbus_set_response_timeout(modbus[i], 60, 0);
		assert_int_equal(modbus_connect(modbus[i]), 0);
	}
	for (int i = 0; i < 6; i++)
		served += modbus_read_registers(modbus[i], SIM_SERVO_POSITION, 2, r) == 2 && r[1] == 5000;
	assert_int_equal(served, 4); /* the others were closed at once */
	for (int i = 0; i < 6; i++) {
		modbus_close(modbus[i]);
		modbus_free(modbus[i]);
	}
	sim_servo_destroy(servo);
}

static void a_place_that_cannot_be_had_is_said(void **state)
{
	struct sim_servo_params params = {.rtu = "/nowhere/servo", .slave = 3};
	char error[160] = "";

	(void)state;
	assert_null(sim_servo_create(&params, error));
	assert_non_null(strstr(error, "/nowhere/servo"));
	params = (struct sim_servo_params){.tcp = "127.0.0.1:none", .slave = 3};
	assert_null(sim_servo_create(&params, error));
}

/* mbpoll is somebody else's master: it must read what was written. */
static void an_independent_master_reads_it(void **state)
{
	struct sim_servo_params params = {.tcp = "127.0.0.1:0", .slave = 3, .angle_rad = -12.345 * DEG};
	struct sim_servo *servo;
	char command[160], line[200], found[200] = "";
	FILE *pipe;

	(void)state;
	if (system("command -v mbpoll >/dev/null 2>&1") != 0) {
		printf("note: mbpoll is not installed: no independent master\n");
		skip();
	}
	servo = create(&params);
	snprintf(command, sizeof command,
	         "timeout 120 mbpoll -o 10 -q -1 -B -0 -a 3 -r 0 -c 1 -t 4:int -p %d 127.0.0.1 2>&1",
	         sim_servo_port(servo));
	pipe = popen(command, "r");
	assert_non_null(pipe);
	while (fgets(line, sizeof line, pipe))
		if (strstr(line, "[0]"))
			strcpy(found, line);
	assert_int_equal(pclose(pipe), 0);
	assert_non_null(strstr(found, "-12345"));
	sim_servo_destroy(servo);
}

static void order(struct sim_servo *servo, const char *kind, double value, int64_t for_ns, bool on)
{
	struct sim_fault fault = {.value = value, .for_ns = for_ns};

	snprintf(fault.kind, sizeof fault.kind, "%s", kind);
	assert_true(sim_servo_fault(servo, &fault, on));
}

static void it_is_silent_busy_and_late_when_that_was_ordered(void **state)
{
	struct sim_servo_params params = {.rtu = rtu, .slave = 3, .angle_rad = 0.0};
	struct sim_servo *servo = create(&params);
	modbus_t *modbus = client(rtu);
	uint16_t r[2];
	int64_t begin_ns;

	(void)state;
	assert_int_equal(position_of(modbus), 0);
	order(servo, "busy", 0, 0, true);
	assert_int_equal(modbus_read_registers(modbus, 0, 2, r), -1);
	assert_int_equal(errno, EMBXSBUSY);
	assert_int_equal(position_of(modbus), 0);
	begin_ns = now_ns();
	order(servo, "late", 150, 0, true);
	assert_int_equal(position_of(modbus), 0);
	assert_true(now_ns() - begin_ns >= 150000000);
	order(servo, "silence", 0, SECOND, true);
	modbus_set_response_timeout(modbus, 0, 200000);
	assert_int_equal(modbus_read_registers(modbus, 0, 2, r), -1);
	assert_int_equal(errno, ETIMEDOUT);
	order(servo, "silence", 0, SECOND, false);
	modbus_set_response_timeout(modbus, 60, 0);
	assert_int_equal(position_of(modbus), 0);
	modbus_close(modbus);
	modbus_free(modbus);
	sim_servo_destroy(servo);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(it_moves_with_its_speed_and_stops_at_its_target),
	    cmocka_unit_test(a_new_target_on_the_way_turns_it_where_it_is),
	    cmocka_unit_test(answers_after_a_step_carry_the_new_angle_and_count_when_they_were_taken),
	    cmocka_unit_test(requests_for_others_and_garbage_get_no_answer_and_do_no_harm),
	    cmocka_unit_test(several_clients_are_served_over_tcp),
	    cmocka_unit_test(a_place_that_cannot_be_had_is_said),
	    cmocka_unit_test(an_independent_master_reads_it),
	    cmocka_unit_test(it_is_silent_busy_and_late_when_that_was_ordered),
	};

	return cmocka_run_group_tests(tests, make_dir, remove_dir);
}

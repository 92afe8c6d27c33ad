/* The simulated Modbus drive is what its registers say: orders, edges, watchdog, faults, at any time and without threads. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <math.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "core/trig.h"
#include "tools/sim_drive.h"

#define DEG    TRIG_DEG
#define MS     INT64_C(1000000)
#define SECOND INT64_C(1000000000)
#define UNIT   3

static struct sim_drive *drive;
static int64_t t_ns;

static void end(void)
{
	sim_drive_destroy(drive);
	drive = NULL;
}

static void begin(struct sim_drive_params params)
{
	end();
	params.unit = UNIT;
	t_ns = SECOND;
	drive = sim_drive_create(&params, t_ns);
	assert_non_null(drive);
}

static void begin_strict(void)
{
	begin((struct sim_drive_params){.strict = true, .acceleration = 300 * DEG});
}

/* As an owner does: comes when something is due. */
static void run(int64_t for_ns)
{
	int64_t end_ns = t_ns + for_ns;

	while (sim_drive_deadline(drive) <= end_ns) {
		assert_true(sim_drive_deadline(drive) >= t_ns);
		t_ns = sim_drive_deadline(drive);
		sim_drive_advance(drive, t_ns);
	}
	t_ns = end_ns;
	sim_drive_advance(drive, t_ns);
}

static void put(uint16_t address, uint16_t value)
{
	assert_int_equal(sim_drive_write(drive, address, 1, &value, t_ns), 0);
}

static void put32(uint16_t address, int32_t value)
{
	uint16_t r[2] = {(uint16_t)((uint32_t)value >> 16), (uint16_t)value};

	assert_int_equal(sim_drive_write(drive, address, 2, r, t_ns), 0);
}

static uint16_t get(uint16_t address)
{
	uint16_t r;

	assert_int_equal(sim_drive_read(drive, address, 1, t_ns, &r), 0);
	return r;
}

static int32_t get32(uint16_t address)
{
	uint16_t r[2];

	assert_int_equal(sim_drive_read(drive, address, 2, t_ns, r), 0);
	return (int32_t)((uint32_t)r[0] << 16 | r[1]);
}

static float as_float(uint32_t bits)
{
	float f;

	memcpy(&f, &bits, sizeof f);
	return f;
}

static double degrees(void)
{
	return sim_axis_angle(sim_drive_axis(drive), t_ns) / DEG;
}

static void order(const char *kind, double value, int64_t for_ns, bool on)
{
	struct sim_fault fault = {.value = value, .for_ns = for_ns};

	snprintf(fault.kind, sizeof fault.kind, "%s", kind);
	assert_true(sim_drive_fault(drive, &fault, on, t_ns));
}

static struct sim_drive_answer transact(uint8_t unit, uint8_t function, uint16_t address, uint16_t n, uint16_t value)
{
	struct modbus_transaction request = {
	    .unit = unit, .function = function, .address = address, .n = n, .value = {value}};
	struct sim_drive_answer answer;

	sim_drive_transact(drive, &request, t_ns, &answer);
	return answer;
}

static struct sim_drive_answer ask(void)
{
	return transact(UNIT, 3, SIM_DRIVE_POSITION, 2, 0);
}

static void the_simple_drive_goes_as_soon_as_its_target_is_written(void **state)
{
	(void)state;
	begin((struct sim_drive_params){.angle_rad = -10 * DEG});
	assert_int_equal(get32(SIM_DRIVE_POSITION), -10000);
	assert_int_equal(get32(SIM_DRIVE_TARGET), -10000);
	put32(SIM_DRIVE_SPEED, 20000);
	put32(SIM_DRIVE_TARGET, 30000);
	run(SECOND);
	assert_int_equal(get32(SIM_DRIVE_POSITION), 10000);
	assert_int_equal(get(SIM_DRIVE_MOVING), 1);
	assert_int_equal((int16_t)get(SIM_DRIVE_POSITION_I16), 1000);
	assert_true(as_float((uint32_t)get32(SIM_DRIVE_POSITION_F32)) == 10.0f);
	assert_true(fabsf(as_float((uint32_t)get32(SIM_DRIVE_SPEED_F32)) - 20.0f) < 1e-5f);
	run(SECOND);
	assert_int_equal(get32(SIM_DRIVE_POSITION), 30000);
	assert_int_equal(get(SIM_DRIVE_MOVING), 0);
	assert_int_equal(get(SIM_DRIVE_STATUS), SIM_DRIVE_IS_ENABLED | SIM_DRIVE_IN_POSITION | SIM_DRIVE_IS_HOMED);
	/* with an acceleration it takes longer: a ramp at either end */
	put32(SIM_DRIVE_ACCELERATION, 100000);
	put32(SIM_DRIVE_TARGET, 10000);
	run(SECOND);
	assert_int_equal(get(SIM_DRIVE_MOVING), 1);
	run(200 * MS);
	assert_int_equal(get32(SIM_DRIVE_POSITION), 10000);
	/* a new speed on the way */
	put32(SIM_DRIVE_ACCELERATION, 0);
	put32(SIM_DRIVE_TARGET, 50000);
	run(SECOND);
	put32(SIM_DRIVE_SPEED, 5000);
	run(SECOND);
	assert_int_equal(get32(SIM_DRIVE_POSITION), 35000);
}

static void every_order_of_32_bits_is_spoken_in_both_directions(void **state)
{
	static const uint16_t want[4][2] = {{0x1122, 0x3344}, {0x3344, 0x1122}, {0x2211, 0x4433}, {0x4433, 0x2211}};
	uint16_t r[2];

	(void)state;
	for (int i = SIM_DRIVE_ABCD; i <= SIM_DRIVE_DCBA; i++) {
		begin((struct sim_drive_params){0});
		sim_drive_place(drive, 0x11223344 * 0.001 * DEG, t_ns);
		end();
		struct sim_drive_params params = {.angle_rad = 0x11223344 * 0.001 * DEG};

		params.order = i;
		begin(params);
		assert_int_equal(sim_drive_read(drive, SIM_DRIVE_POSITION, 2, t_ns, r), 0);
		assert_memory_equal(r, want[i], sizeof r);
		memcpy(r, ((const uint16_t[4][2]){{0, 30000}, {30000, 0}, {0, 0x3075}, {0x3075, 0}})[i], sizeof r);
		assert_int_equal(sim_drive_write(drive, SIM_DRIVE_TARGET, 2, r, t_ns), 0);
		put(SIM_DRIVE_CONTROL, 0x100); /* halt: it need not go all that way */
		memcpy(r, ((const uint16_t[4][2]){{0x41c8, 0}, {0, 0x41c8}, {0xc841, 0}, {0, 0xc841}})[i], sizeof r);
		assert_int_equal(sim_drive_write(drive, SIM_DRIVE_TARGET_F32, 2, r, t_ns), 0); /* 25.0f */
		assert_int_equal(sim_drive_read(drive, SIM_DRIVE_TARGET, 2, t_ns, r), 0);
		assert_memory_equal(r, ((const uint16_t[4][2]){{0, 25000}, {25000, 0}, {0, 0xa861}, {0xa861, 0}})[i],
		                    sizeof r);
	}
}

static void what_cannot_be_read_or_written_is_refused_whole(void **state)
{
	uint16_t many[64] = {0};

	(void)state;
	begin((struct sim_drive_params){0});
	assert_int_equal(sim_drive_read(drive, 100, 1, t_ns, many), 2);
	assert_int_equal(sim_drive_read(drive, SIM_DRIVE_REGISTERS - 1, 2, t_ns, many), 2);
	assert_int_equal(sim_drive_read(drive, 65535, 1, t_ns, many), 2);
	assert_int_equal(sim_drive_read(drive, 0, 0, t_ns, many), 3);
	assert_int_equal(sim_drive_read(drive, 0, 126, t_ns, many), 3);
	assert_int_equal(sim_drive_read(drive, 0, SIM_DRIVE_REGISTERS, t_ns, many), 0);
	assert_int_equal(sim_drive_write(drive, SIM_DRIVE_POSITION, 2, many, t_ns), 2);
	many[1] = 5000;
	assert_int_equal(sim_drive_write(drive, SIM_DRIVE_TARGET, 5, many, t_ns), 2); /* the last one is read-only */
	assert_int_equal(get32(SIM_DRIVE_TARGET), 0);
	many[0] = 0x7fc0; /* not a number */
	assert_int_equal(sim_drive_write(drive, SIM_DRIVE_TARGET_F32, 2, many, t_ns), 3);
	assert_int_equal(get32(SIM_DRIVE_TARGET), 0);
	assert_int_equal(get(SIM_DRIVE_MOVING), 0);
}

static void the_strict_drive_wants_to_be_enabled_and_started_by_an_edge(void **state)
{
	(void)state;
	begin_strict();
	put32(SIM_DRIVE_TARGET, 10000);
	put(SIM_DRIVE_CONTROL, 0x1f); /* enabled and started in one: the edge counts */
	run(SECOND);
	assert_true(fabs(degrees() - 10.0) < 1e-9);
	put32(SIM_DRIVE_TARGET, 20000);
	run(SECOND);
	assert_true(fabs(degrees() - 10.0) < 1e-9);
	put(SIM_DRIVE_CONTROL, 0x1f); /* no edge */
	run(SECOND);
	assert_true(fabs(degrees() - 10.0) < 1e-9);
	put(SIM_DRIVE_CONTROL, 0x0f);
	put(SIM_DRIVE_CONTROL, 0x1f);
	run(100 * MS);
	assert_int_equal(get(SIM_DRIVE_MOVING) & 7, 7); /* strict: the status is there too */
	put(SIM_DRIVE_CONTROL, 0x10f);                  /* halt, and on */
	run(SECOND);
	assert_true(degrees() < 19.0);
	put(SIM_DRIVE_CONTROL, 0x0f);
	run(SECOND);
	assert_true(fabs(degrees() - 20.0) < 1e-9);
	assert_true(get(SIM_DRIVE_STATUS) & SIM_DRIVE_IN_POSITION);
	put32(SIM_DRIVE_TARGET, 0);
	put(SIM_DRIVE_CONTROL, 0x06); /* disabled: nothing starts it */
	put(SIM_DRIVE_CONTROL, 0x16);
	run(SECOND);
	assert_true(fabs(degrees() - 20.0) < 1e-9);
	assert_int_equal(get(SIM_DRIVE_STATUS) & 7, SIM_DRIVE_IS_READY);
}

static void an_unhomed_drive_is_homed_first(void **state)
{
	(void)state;
	begin((struct sim_drive_params){.strict = true, .unhomed = true, .angle_rad = 7 * DEG});
	put32(SIM_DRIVE_TARGET, 10000);
	put(SIM_DRIVE_CONTROL, 0x0f);
	put(SIM_DRIVE_CONTROL, 0x1f);
	run(SECOND);
	assert_true(fabs(degrees() - 7.0) < 1e-9);
	assert_int_equal(get(SIM_DRIVE_STATUS) & SIM_DRIVE_IS_HOMED, 0);
	put(SIM_DRIVE_CONTROL, 0x2f);
	run(100 * MS);
	assert_int_equal(get(SIM_DRIVE_STATUS) & SIM_DRIVE_IS_HOMED, 0); /* it takes its time */
	run(200 * MS);
	assert_int_equal(get(SIM_DRIVE_STATUS) & SIM_DRIVE_IS_HOMED, SIM_DRIVE_IS_HOMED);
	assert_int_equal(get32(SIM_DRIVE_POSITION), 0);
	put32(SIM_DRIVE_TARGET, 10000);
	put(SIM_DRIVE_CONTROL, 0x0f);
	put(SIM_DRIVE_CONTROL, 0x1f);
	run(2 * SECOND);
	assert_true(fabs(degrees() - 17.0) < 1e-9);
}

static void unwatched_it_stands_within_its_time_and_its_ramp(void **state)
{
	(void)state;
	for (int strict = 0; strict < 2; strict++) {
		int64_t written_ns;

		begin((struct sim_drive_params){.strict = strict, .acceleration = 300 * DEG});
		put(SIM_DRIVE_CONTROL, 0x0f);
		put(SIM_DRIVE_WATCHDOG, 1);
		put32(SIM_DRIVE_SPEED, 30000);
		put32(SIM_DRIVE_TARGET, 80000);
		put(SIM_DRIVE_CONTROL, 0x1f);
		for (int i = 0; i < 10; i++) {
			run(100 * MS);
			put(SIM_DRIVE_WATCHDOG, 1);
		}
		written_ns = t_ns;
		assert_true(degrees() > 25.0);
		t_ns += 2 * SECOND; /* nobody looks for two seconds: it stood in time nevertheless */
		sim_drive_advance(drive, t_ns);
		assert_in_range(sim_axis_arrival_ns(sim_drive_axis(drive)) - written_ns, 400 * MS - MS, 400 * MS + MS);
		assert_true(get(SIM_DRIVE_STATUS) & SIM_DRIVE_UNWATCHED);
		double there = degrees();

		put32(SIM_DRIVE_TARGET, 0); /* it takes none */
		put(SIM_DRIVE_CONTROL, 0x0f);
		put(SIM_DRIVE_CONTROL, 0x1f);
		run(SECOND);
		assert_true(degrees() == there);
		put(SIM_DRIVE_WATCHDOG, 1);
		assert_int_equal(get(SIM_DRIVE_STATUS) & SIM_DRIVE_UNWATCHED, 0);
		run(100 * MS);
		assert_true(degrees() == there); /* not by itself */
		put(SIM_DRIVE_WATCHDOG, 1);
		put32(SIM_DRIVE_TARGET, 0);
		put(SIM_DRIVE_CONTROL, 0x0f);
		put(SIM_DRIVE_CONTROL, 0x1f);
		run(200 * MS);
		assert_true(degrees() < there);
	}
	/* one that wants another value every time */
	begin((struct sim_drive_params){.toggles = true});
	put(SIM_DRIVE_WATCHDOG, 1);
	for (int i = 0; i < 4; i++) {
		run(100 * MS);
		put(SIM_DRIVE_WATCHDOG, 1);
	}
	assert_true(get(SIM_DRIVE_STATUS) & SIM_DRIVE_UNWATCHED);
	put(SIM_DRIVE_WATCHDOG, 0);
	assert_int_equal(get(SIM_DRIVE_STATUS) & SIM_DRIVE_UNWATCHED, 0);
	put(SIM_DRIVE_WATCHDOG_TIME, 1000);
	run(900 * MS);
	assert_int_equal(get(SIM_DRIVE_STATUS) & SIM_DRIVE_UNWATCHED, 0);
}

static void a_fault_stops_it_and_is_left_by_the_edge_of_reset(void **state)
{
	(void)state;
	begin_strict();
	put32(SIM_DRIVE_TARGET, 60000);
	put(SIM_DRIVE_CONTROL, 0x1f);
	run(SECOND);
	order("fault", 0, 0, true);
	run(SECOND);
	assert_int_equal(get(SIM_DRIVE_STATUS) & (SIM_DRIVE_HAS_FAULT | SIM_DRIVE_IS_ENABLED | SIM_DRIVE_IS_MOVING),
	                 SIM_DRIVE_HAS_FAULT);
	assert_int_equal(get(SIM_DRIVE_ERROR), 0x4310);
	put(SIM_DRIVE_CONTROL, 0x0f);
	put(SIM_DRIVE_CONTROL, 0x1f);
	assert_int_equal(get(SIM_DRIVE_STATUS) & SIM_DRIVE_IS_ENABLED, 0);
	put(SIM_DRIVE_CONTROL, 0x80);
	assert_int_equal(get(SIM_DRIVE_ERROR), 0);
	order("fault", 0x2310, SECOND, true);
	put(SIM_DRIVE_CONTROL, 0);
	put(SIM_DRIVE_CONTROL, 0x80);
	assert_int_equal(get(SIM_DRIVE_ERROR), 0x2310); /* it stays */
	order("fault", 0, SECOND, false);
	put(SIM_DRIVE_CONTROL, 0);
	put(SIM_DRIVE_CONTROL, 0x80);
	put(SIM_DRIVE_CONTROL, 0x0f);
	put(SIM_DRIVE_CONTROL, 0x1f);
	run(3 * SECOND);
	assert_true(fabs(degrees() - 60.0) < 1e-9);
	/* an axis that does not follow */
	order("stuck", 0, SECOND, true);
	put32(SIM_DRIVE_TARGET, 0);
	put(SIM_DRIVE_CONTROL, 0x0f);
	put(SIM_DRIVE_CONTROL, 0x1f);
	run(SECOND);
	assert_int_equal(get(SIM_DRIVE_ERROR), 0x8611);
	order("stuck", 0, SECOND, false);
	run(SECOND);
	assert_true(fabs(degrees() - 60.0) < 1e-9);
	/* the simple one stands, and knows nothing */
	begin((struct sim_drive_params){0});
	order("stuck", 0, SECOND, true);
	put32(SIM_DRIVE_TARGET, 30000);
	run(SECOND);
	assert_int_equal(get32(SIM_DRIVE_POSITION), 0);
	assert_int_equal(get(SIM_DRIVE_ERROR), 0);
	order("stuck", 0, SECOND, false);
	run(SECOND);
	assert_int_equal(get32(SIM_DRIVE_POSITION), 30000);
	order("slow", 0.1, SECOND, true);
	put32(SIM_DRIVE_TARGET, 0);
	run(SECOND);
	assert_int_equal(get32(SIM_DRIVE_POSITION), 27000);
	order("restart", 0, 0, true);
	assert_int_equal(get32(SIM_DRIVE_TARGET), 27000);
}

static void answers_are_lost_late_wrong_and_refused_when_that_was_ordered(void **state)
{
	struct sim_drive_answer a;
	int lost = 0;

	(void)state;
	begin((struct sim_drive_params){.angle_rad = 5 * DEG, .seed = 1});
	a = ask();
	assert_int_equal(a.verdict, SIM_DRIVE_ANSWERED);
	assert_int_equal(a.delay_ns, 0);
	assert_int_equal(a.transaction.value[1], 5000);
	assert_int_equal(transact(UNIT + 1, 3, 0, 2, 0).verdict, SIM_DRIVE_SILENT);
	assert_int_equal(transact(0, 6, SIM_DRIVE_WATCHDOG_TIME, 1, 777).verdict, SIM_DRIVE_SILENT); /* to all */
	assert_int_equal(get(SIM_DRIVE_WATCHDOG_TIME), 777);
	a = transact(UNIT, 43, 0, 1, 0);
	assert_int_equal(a.transaction.function, 43 | MODBUS_WIRE_REFUSED);
	assert_int_equal(a.transaction.value[0], 1);
	a = transact(UNIT, 16, SIM_DRIVE_POSITION, 1, 0);
	assert_int_equal(a.transaction.function, 16 | MODBUS_WIRE_REFUSED);
	assert_int_equal(a.transaction.value[0], 2);
	order("busy", 0, 0, true);
	assert_int_equal(ask().transaction.value[0], 6);
	assert_int_equal(ask().transaction.function, 3);
	order("silence", 0, SECOND, true);
	assert_int_equal(transact(UNIT, 6, SIM_DRIVE_WATCHDOG_TIME, 1, 300).verdict, SIM_DRIVE_SILENT);
	order("silence", 0, SECOND, false);
	assert_int_equal(get(SIM_DRIVE_WATCHDOG_TIME), 777); /* it did not hear */
	order("lost", 0, 0, true);
	assert_int_equal(transact(UNIT, 6, SIM_DRIVE_WATCHDOG_TIME, 1, 300).verdict, SIM_DRIVE_SILENT);
	assert_int_equal(get(SIM_DRIVE_WATCHDOG_TIME), 300); /* it did, and nobody knows */
	order("lost", 0.25, SECOND, true);
	for (int i = 0; i < 1000; i++)
		lost += ask().verdict == SIM_DRIVE_SILENT;
	assert_in_range(lost, 200, 300);
	order("lost", 0, SECOND, false);
	order("late", 150, 0, true);
	assert_int_equal(ask().delay_ns, 150 * MS);
	order("jitter", 8, SECOND, true);
	for (int i = 0; i < 100; i++)
		assert_in_range(ask().delay_ns, 0, 8 * MS);
	order("jitter", 0, SECOND, false);
	order("crc", 0, 0, true);
	assert_int_equal(ask().verdict, SIM_DRIVE_CORRUPT);
	order("wrong unit", 0, 0, true);
	a = ask();
	assert_int_equal(a.verdict, SIM_DRIVE_WRONG_UNIT);
	assert_int_not_equal(a.transaction.unit, UNIT);
	order("drop", 0, 0, true);
	assert_int_equal(ask().verdict, SIM_DRIVE_DROPPED);
	assert_int_equal(ask().verdict, SIM_DRIVE_ANSWERED);
	assert_false(sim_drive_fault(drive, &(struct sim_fault){.kind = "nonsense"}, true, t_ns));
}

/* -0.010 and 0.010 degrees: their high words are FFFF and 0. */
static void halves_read_apart_tear_and_when_ordered_in_one_request_too(void **state)
{
	uint16_t r[2];

	(void)state;
	begin((struct sim_drive_params){.angle_rad = -0.010 * DEG});
	put32(SIM_DRIVE_SPEED, 10000);
	put32(SIM_DRIVE_TARGET, 10000);
	r[0] = get(SIM_DRIVE_POSITION);
	run(2 * MS);
	r[1] = get(SIM_DRIVE_POSITION + 1);
	assert_int_equal((int32_t)((uint32_t)r[0] << 16 | r[1]), -65536 + 10);
	sim_drive_place(drive, -0.010 * DEG, t_ns);
	put32(SIM_DRIVE_TARGET, 10000);
	assert_int_equal(get32(SIM_DRIVE_POSITION), -10);
	order("torn", 2, 0, true);
	assert_int_equal(get32(SIM_DRIVE_POSITION), -65536 + 10);
	assert_int_equal(get32(SIM_DRIVE_POSITION), -10);
}

static void whatever_is_asked_it_lives(void **state)
{
	static const uint8_t functions[] = {3, 4, 6, 16, 16, 6, 0, 23};
	struct modbus_transaction request;
	struct sim_drive_answer answer;
	uint64_t random = 9;

	(void)state;
	for (int strict = 0; strict < 2; strict++) {
		begin((struct sim_drive_params){.strict = strict, .unhomed = strict, .acceleration = 100 * DEG});
		for (int i = 0; i < 100000; i++) {
			request.unit = UNIT;
			request.function = functions[(int)(sim_random(&random) * 8)];
			request.address = (uint16_t)(sim_random(&random) * 40);
			request.n = (uint16_t)(sim_random(&random) < 0.9 ? 1 + sim_random(&random) * 4
			                                                 : sim_random(&random) * 65536);
			for (int k = 0; k < MODBUS_WIRE_VALUES_MAX; k++)
				request.value[k] = (uint16_t)(sim_random(&random) * 65536);
			sim_drive_transact(drive, &request, t_ns, &answer);
			assert_in_range(answer.verdict, SIM_DRIVE_ANSWERED, SIM_DRIVE_DROPPED);
			assert_in_range(answer.transaction.n, 1, MODBUS_WIRE_VALUES_MAX);
			assert_true(isfinite(degrees()));
			run((int64_t)(sim_random(&random) * 20e6));
		}
	}
}

static int64_t now_ns(void)
{
	struct timespec ts;

	clock_gettime(CLOCK_MONOTONIC, &ts);
	return (int64_t)ts.tv_sec * SECOND + ts.tv_nsec;
}

/* Behind libmodbus: what the transport makes of the verdicts, and a watchdog that nobody looks at. */
static void behind_a_line_its_faults_are_what_a_master_sees(void **state)
{
	struct sim_drive_params strict = {.strict = true, .order = SIM_DRIVE_CDAB};
	struct sim_servo_params params = {.tcp = "127.0.0.1:0", .slave = UNIT, .drive = &strict};
	char error[160] = "";
	struct sim_servo *servo = sim_servo_create(&params, error);
	struct sim_fault crc = {.kind = "crc"}, drop = {.kind = "drop"};
	modbus_t *modbus;
	uint16_t target[2] = {50000, 0}, r[2];
	int64_t written_ns;

	(void)state;
	assert_string_equal(error, "");
	modbus = modbus_new_tcp("127.0.0.1", sim_servo_port(servo));
	modbus_set_slave(modbus, UNIT);
	modbus_set_response_timeout(modbus, 60, 0);
	assert_int_equal(modbus_connect(modbus), 0);
	assert_int_equal(modbus_write_register(modbus, SIM_DRIVE_CONTROL, 0x0f), 1);
	assert_int_equal(modbus_write_registers(modbus, SIM_DRIVE_TARGET, 2, target), 2);
	assert_int_equal(modbus_write_register(modbus, SIM_DRIVE_WATCHDOG, 1), 1);
	assert_int_equal(modbus_write_register(modbus, SIM_DRIVE_CONTROL, 0x1f), 1);
	written_ns = now_ns();
	while (now_ns() - written_ns < 600 * MS)
		usleep(20000);
	/* 30 degrees/s without a ramp: at the latest 300 ms after the watchdog's write */
	assert_true(sim_servo_angle(servo, now_ns()) > 1 * DEG);
	assert_true(sim_servo_angle(servo, now_ns()) == sim_servo_angle(servo, now_ns() - 50 * MS));
	assert_int_equal(modbus_read_registers(modbus, SIM_DRIVE_POSITION, 2, r), 2);
	assert_true(r[1] == 0 && r[0] > 1000); /* low word first */
	assert_true(sim_servo_fault(servo, &crc, true));
	assert_int_equal(modbus_read_registers(modbus, SIM_DRIVE_POSITION, 2, r), -1);
	modbus_close(modbus);
	assert_int_equal(modbus_connect(modbus), 0);
	assert_true(sim_servo_fault(servo, &drop, true));
	assert_int_equal(modbus_read_registers(modbus, SIM_DRIVE_POSITION, 2, r), -1);
	modbus_close(modbus);
	assert_int_equal(modbus_connect(modbus), 0);
	assert_int_equal(modbus_read_registers(modbus, SIM_DRIVE_POSITION, 2, r), 2);
	modbus_close(modbus);
	modbus_free(modbus);
	sim_servo_destroy(servo);
}

static int finish(void **state)
{
	(void)state;
	end();
	return 0;
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(the_simple_drive_goes_as_soon_as_its_target_is_written),
	    cmocka_unit_test(every_order_of_32_bits_is_spoken_in_both_directions),
	    cmocka_unit_test(what_cannot_be_read_or_written_is_refused_whole),
	    cmocka_unit_test(the_strict_drive_wants_to_be_enabled_and_started_by_an_edge),
	    cmocka_unit_test(an_unhomed_drive_is_homed_first),
	    cmocka_unit_test(unwatched_it_stands_within_its_time_and_its_ramp),
	    cmocka_unit_test(a_fault_stops_it_and_is_left_by_the_edge_of_reset),
	    cmocka_unit_test(answers_are_lost_late_wrong_and_refused_when_that_was_ordered),
	    cmocka_unit_test(halves_read_apart_tear_and_when_ordered_in_one_request_too),
	    cmocka_unit_test(whatever_is_asked_it_lives),
	    cmocka_unit_test(behind_a_line_its_faults_are_what_a_master_sees),
	};

	return cmocka_run_group_tests(tests, NULL, finish);
}

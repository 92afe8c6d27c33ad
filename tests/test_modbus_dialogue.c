/* Laws L1 and L9: a drive is set up, watched, swept and left in order, and one that is not well is halted, once, with a
 * sentence, while its angle is still read; against the simulated drive, in virtual time. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <math.h>
#include <stdio.h>

#include "tests/modbus_servo.h"
#include "tools/sim_drive.h"

#define TICK_NS   (5 * MS) /* an angle so often */
#define ANSWER_NS (2 * MS)
#define FAULT_BIT SIM_DRIVE_HAS_FAULT

/* The driver's decoder and dialogue at one end, a drive at the other. */
static struct bed {
	struct config config;
	struct sim_drive *drive;
	struct decoder *decoder;
	struct dialogue *dialogue;
	struct dialogue_step step;
	int64_t t_ns;
	bool dead;       /* facetd is: nobody steps the dialogue */
	bool lossy;      /* what was not answered is said again */
	bool unanswered; /* the answers to wishes are lost */
	int writes, targets, starts, resets, enables, watchdogs, reads;
	uint16_t control, watchdog;      /* as written last */
	int64_t watchdog_ns, longest_ns; /* between two of them */
	double low, high;                /* of the targets */
	double angle_low, angle_high;    /* of the angle as decoded */
	char said[8][160];               /* notes, as they change */
	int notes, angles;
} bed;

static struct config_write *then(struct config_writes *list, uint16_t address, uint16_t value)
{
	struct config_write *w = &list->item[list->n++];

	w->address = address;
	w->value = value;
	return w;
}

static void until(struct config_write *w, uint16_t mask, uint16_t value)
{
	w->until.set = true;
	w->until.address = SIM_DRIVE_STATUS;
	w->until.mask = mask;
	w->until.value = value;
	w->until.within_ns = 2000 * MS;
}

/* A drive as its handbook wants it: ready, enabled, a target at an edge, a fault, a watchdog. */
static struct config strict_config(void)
{
	struct config config = servo_config();
	struct config_device *d = &config.device[0];

	then(&d->write, SIM_DRIVE_CONTROL, 6);
	until(then(&d->write, SIM_DRIVE_CONTROL, 15), SIM_DRIVE_IS_ENABLED, SIM_DRIVE_IS_ENABLED);
	d->strobe.set = true;
	d->strobe.address = SIM_DRIVE_CONTROL;
	d->strobe.on = 0x1f;
	d->strobe.off = 0x0f;
	d->watchdog.set = true;
	d->watchdog.address = SIM_DRIVE_WATCHDOG;
	d->watchdog.value = 4;
	d->watchdog.toggle = 1;
	d->watchdog.period_ns = 100 * MS;
	d->status.set = true;
	d->status.function = 3;
	d->status.address = SIM_DRIVE_STATUS;
	d->status.fault = FAULT_BIT;
	then(&d->reset, SIM_DRIVE_CONTROL, 0x80);
	then(&d->reset, SIM_DRIVE_CONTROL, 0);
	then(&d->stop, SIM_DRIVE_CONTROL, 0);
	d->following_rad = 10.0 * DEG;
	return config;
}

static void set_up(const struct config *config, const struct sim_drive_params *params)
{
	struct sim_drive_params drive = *params;

	memset(&bed, 0, sizeof bed);
	drive.unit = 1;
	bed.config = *config;
	bed.t_ns = 5000 * MS;
	bed.drive = sim_drive_create(&drive, bed.t_ns);
	bed.decoder = driver_modbus.decoder_create(&bed.config.device[0], 0);
	bed.dialogue = driver_modbus.dialogue_create(&bed.config, 0);
	bed.low = bed.angle_low = 1e9;
	bed.high = bed.angle_high = -1e9;
	driver_modbus.dialogue_reset(bed.dialogue, bed.t_ns);
}

static void tear_down(void)
{
	driver_modbus.dialogue_destroy(bed.dialogue);
	driver_modbus.decoder_destroy(bed.decoder);
	sim_drive_destroy(bed.drive);
}

static void on_tilt(void *ctx, int device, const struct tilt *tilt)
{
	(void)ctx;
	(void)device;
	bed.angles++;
	bed.angle_low = fmin(bed.angle_low, tilt->angle_rad);
	bed.angle_high = fmax(bed.angle_high, tilt->angle_rad);
	driver_modbus.dialogue_data(bed.dialogue, tilt->t_ns);
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	(void)ctx;
	(void)device;
	driver_modbus.dialogue_reply(bed.dialogue, reply);
}

static void decode(const struct modbus_transaction *t)
{
	struct record_sink sink = {.tilt = on_tilt, .reply = on_reply};
	uint8_t bytes[MODBUS_WIRE_MAX];
	struct record record = {.bytes = bytes, .len = modbus_wire_put(t, bytes), .t_ns = t->t_answer_ns};

	driver_modbus.decode(bed.decoder, &record, &sink);
}

/* One request and its answer, as the bus makes records of them. */
static void transact(struct modbus_transaction t)
{
	struct sim_drive_answer answer;

	sim_drive_transact(bed.drive, &t, bed.t_ns, &answer);
	if (answer.verdict == SIM_DRIVE_ANSWERED)
		t = answer.transaction;
	if (answer.verdict != SIM_DRIVE_ANSWERED || bed.unanswered) {
		t.function |= MODBUS_WIRE_REFUSED;
		t.n = 1;
		t.value[0] = 0;
	}
	t.unit = 1;
	t.t_request_ns = bed.t_ns;
	t.t_answer_ns = bed.t_ns + ANSWER_NS;
	decode(&t);
}

static void count_control(uint16_t value)
{
	bed.starts += (value & 0x10) && !(bed.control & 0x10);
	bed.resets += (value & 0x80) && !(bed.control & 0x80);
	bed.enables += (value & 15) == 15 && (bed.control & 15) != 15;
	bed.control = value;
}

static void count_watchdog(uint16_t value)
{
	if (bed.watchdogs++) {
		assert_true(bed.lossy || (value ^ bed.watchdog) == bed.config.device[0].watchdog.toggle);
		if (bed.t_ns - bed.watchdog_ns > bed.longest_ns)
			bed.longest_ns = bed.t_ns - bed.watchdog_ns;
	}
	bed.watchdog = value;
	bed.watchdog_ns = bed.t_ns;
}

/* What the dialogue sends is what it was configured to send. */
static void count_wish(const struct modbus_transaction *t)
{
	const struct config_register *target = &bed.config.device[0].target;
	double v;

	bed.writes += t->function == 6 || t->function == 16;
	bed.reads += t->function == 3 || t->function == 4;
	if (t->function == 3 || t->function == 4)
		return;
	if (t->address == SIM_DRIVE_TARGET) {
		assert_int_equal(modbus_wire_decode(target, t->value, &v), 0);
		bed.low = fmin(bed.low, v);
		bed.high = fmax(bed.high, v);
		bed.targets++;
	}
	if (t->address == SIM_DRIVE_CONTROL)
		count_control(t->value[0]);
	if (t->address == SIM_DRIVE_WATCHDOG)
		count_watchdog(t->value[0]);
}

static void step_dialogue(void)
{
	struct modbus_transaction t;

	for (int i = 0; i < 8; i++) {
		driver_modbus.dialogue_step(bed.dialogue, bed.t_ns, &bed.step);
		assert_true(bed.step.state == DIALOGUE_FAILED || bed.step.deadline_ns > bed.t_ns);
		if (bed.step.state == DIALOGUE_STREAMING && bed.notes < 8 &&
		    strcmp(bed.step.error, bed.notes ? bed.said[bed.notes - 1] : "") != 0)
			strcpy(bed.said[bed.notes++], bed.step.error);
		if (bed.step.state == DIALOGUE_FAILED || !bed.step.write_len)
			return;
		assert_int_equal(modbus_wire_get(bed.step.write, bed.step.write_len, &t), bed.step.write_len);
		count_wish(&t);
		transact(t);
	}
}

/* An angle every tick. Ends early when the dialogue does. */
static enum dialogue_state run(double seconds)
{
	const int64_t end_ns = bed.t_ns + (int64_t)(seconds * 1e9);
	const struct config_register *position = &bed.config.device[0].position;

	for (; bed.t_ns < end_ns; bed.t_ns += TICK_NS) {
		sim_drive_advance(bed.drive, bed.t_ns);
		if (bed.dead)
			continue;
		transact((struct modbus_transaction){.unit = 1,
		                                     .function = modbus_wire_read_function(position),
		                                     .address = position->address,
		                                     .n = (uint16_t)modbus_wire_registers(position)});
		step_dialogue();
		if (bed.step.state == DIALOGUE_FAILED)
			return bed.step.state;
	}
	return bed.step.state;
}

static double angle_now(void)
{
	return -sim_axis_angle(sim_drive_axis(bed.drive), bed.t_ns); /* it counts up */
}

static void order(const char *kind, double value, bool on)
{
	struct sim_fault fault = {.value = value, .for_ns = INT64_MAX};

	strcpy(fault.kind, kind);
	assert_true(sim_drive_fault(bed.drive, &fault, on, bed.t_ns));
}

static void clear_at_the_drive(void)
{
	static const uint16_t edge[] = {0, 0x80};

	for (int i = 0; i < 2; i++)
		assert_int_equal(sim_drive_write(bed.drive, SIM_DRIVE_CONTROL, 1, &edge[i], bed.t_ns), 0);
}

/* So many more turns than one sweep would make. */
static void assert_sweeps(double seconds)
{
	bed.angle_low = 1e9;
	bed.angle_high = -1e9;
	bed.targets = 0;
	assert_int_equal(run(seconds), DIALOGUE_STREAMING);
	assert_true(bed.angle_low < -19.5 * DEG && bed.angle_high > 29.5 * DEG);
	assert_true(bed.targets >= (int)(seconds / 2.5));
	assert_true(bed.low > -20.001 * DEG && bed.high < 30.001 * DEG);
}

static void assert_stands(double seconds)
{
	const double at = angle_now();
	const int angles = bed.angles;

	assert_int_equal(run(seconds), DIALOGUE_STREAMING);
	assert_true(fabs(angle_now() - at) < 1e-9);
	assert_in_range(bed.angles - angles, (int)(seconds * 190), (int)(seconds * 210)); /* they are read on */
}

static const struct sim_drive_params simple, strict = {.strict = true};

/* ---- set-up and sweeping ---- */

static void a_servo_that_never_answered_does_not_stream(void **state)
{
	struct config config = servo_config();

	(void)state;
	set_up(&config, &simple);
	for (int life = 0; life < 2; life++) { /* a link that is lost and opened anew begins again */
		driver_modbus.dialogue_reset(bed.dialogue, bed.t_ns);
		driver_modbus.dialogue_step(bed.dialogue, bed.t_ns, &bed.step);
		assert_int_equal(bed.step.state, DIALOGUE_CONFIGURING);
		assert_int_equal(run(1.0), DIALOGUE_STREAMING);
	}
	tear_down();
}

static void a_simple_servo_sweeps_between_its_ends(void **state)
{
	struct config config = servo_config();

	(void)state;
	for (config.sweep.profile = SWEEP_TRIANGLE; config.sweep.profile <= SWEEP_STEP; config.sweep.profile++) {
		config.sweep.step_rad = 7.0 * DEG;
		config.sweep.settle_ns = 100 * MS;
		set_up(&config, &simple);
		run(3.0);
		assert_sweeps(20.0);
		assert_int_equal(bed.notes, 0);
		tear_down();
	}
}

static void a_strict_drive_is_enabled_and_takes_each_target_at_an_edge(void **state)
{
	struct config config = strict_config();

	(void)state;
	set_up(&config, &strict);
	assert_int_equal(run(1.0), DIALOGUE_STREAMING);
	assert_int_equal(bed.enables, 1);
	assert_sweeps(60.0);
	assert_in_range(bed.starts, bed.targets, bed.targets + 2);
	assert_int_equal(bed.enables, 1);
	assert_int_equal(bed.notes, 0);
	tear_down();
}

static void a_drive_that_must_be_homed_is_homed_first(void **state)
{
	const struct sim_drive_params params = {.strict = true, .unhomed = true};
	struct config config = strict_config();

	(void)state;
	until(then(&config.device[0].write, SIM_DRIVE_CONTROL, 0x2f), SIM_DRIVE_IS_HOMED, SIM_DRIVE_IS_HOMED);
	then(&config.device[0].write, SIM_DRIVE_CONTROL, 0x0f);
	set_up(&config, &params);
	run(2.0);
	assert_sweeps(20.0);
	assert_int_equal(bed.notes, 0);
	tear_down();
}

static void all_orders_and_floats_sweep(void **state)
{
	(void)state;
	for (int order = ORDER_ABCD; order <= ORDER_DCBA; order++)
		for (int floats = 0; floats < 2; floats++) {
			const struct sim_drive_params params = {.order = (int)order};
			struct config config = servo_config();
			struct config_device *d = &config.device[0];

			if (floats) {
				d->position.type = d->target.type = REGISTER_F32;
				d->position.scale = d->target.scale = DEG;
				d->position.address = SIM_DRIVE_POSITION_F32;
				d->target.address = SIM_DRIVE_TARGET_F32;
			}
			d->position.order = d->target.order = d->speed.order = order;
			set_up(&config, &params);
			assert_int_equal(run(5.0), DIALOGUE_STREAMING);
			assert_true(bed.angle_low < -19.5 * DEG && bed.angle_high > 29.5 * DEG);
			tear_down();
		}
}

static void the_sequence_waits_as_it_is_told_and_is_written_again_after_a_reset(void **state)
{
	struct config config = servo_config();

	(void)state;
	then(&config.device[0].write, SIM_DRIVE_CONTROL, 6)->delay_ns = 700 * MS;
	then(&config.device[0].write, SIM_DRIVE_CONTROL, 15);
	set_up(&config, &simple);
	for (int life = 1; life <= 2; life++) {
		run(0.6);
		assert_int_equal(bed.step.state, DIALOGUE_CONFIGURING);
		assert_int_equal(bed.control, 6);
		assert_int_equal(run(0.4), DIALOGUE_STREAMING);
		assert_int_equal(bed.control, 15);
		assert_int_equal(bed.enables, life);
		driver_modbus.dialogue_reset(bed.dialogue, bed.t_ns);
		bed.control = 0;
	}
	tear_down();
}

static void a_servo_without_a_sweep_is_read_and_never_told_anything(void **state)
{
	struct config config = servo_config();

	(void)state;
	strcpy(config.sweep.device, "other");
	set_up(&config, &simple);
	assert_int_equal(run(10.0), DIALOGUE_STREAMING);
	assert_int_equal(bed.writes + bed.reads, 0);
	/* A program that slept itself has not listened; one that looked and heard nothing for three seconds has. */
	bed.t_ns += 60000 * MS;
	step_dialogue();
	assert_int_equal(bed.step.state, DIALOGUE_STREAMING);
	for (int i = 0; i < 100 && bed.step.state != DIALOGUE_FAILED; i++) {
		bed.t_ns = bed.step.deadline_ns;
		step_dialogue();
	}
	assert_int_equal(bed.step.state, DIALOGUE_FAILED);
	assert_non_null(strstr(bed.step.error, "no angle"));
	tear_down();
}

static void what_the_sweep_needs_and_nobody_gave_is_said_before_anything_moves(void **state)
{
	struct config config = servo_config();

	(void)state;
	config.sweep.profile = SWEEP_SINUS;
	config.device[0].speed.set = false;
	set_up(&config, &simple);
	assert_int_equal(run(1.0), DIALOGUE_FAILED);
	assert_non_null(strstr(bed.step.error, "triangle"));
	tear_down();
	config.device[0].target.set = false;
	set_up(&config, &simple);
	assert_int_equal(run(1.0), DIALOGUE_FAILED);
	assert_non_null(strstr(bed.step.error, "`target`"));
	tear_down();
}

/* ---- the watchdog ---- */

static void the_watchdog_is_written_in_time_whatever_else_is_done(void **state)
{
	struct config config = strict_config();

	(void)state;
	config.sweep.profile = SWEEP_STEP; /* many targets */
	config.sweep.step_rad = 0.5 * DEG;
	set_up(&config, &strict);
	run(60.0);
	assert_in_range(bed.watchdogs, 560, 610);
	assert_true(bed.longest_ns <= 110 * MS);
	order("late", 5.0, true);
	run(60.0);
	assert_true(bed.longest_ns <= 110 * MS);
	tear_down();
}

static void a_drive_stands_within_its_time_when_facetd_dies(void **state)
{
	struct config config = strict_config();
	double at;

	(void)state;
	for (int i = 0; i < 50; i++) {
		set_up(&config, i % 2 ? &strict : &simple);
		run(2.0 + 0.03 * i);
		bed.dead = true;
		at = angle_now();
		run(0.3);
		assert_true(i % 2 == 0 || bed.starts > 0);
		at = angle_now();
		run(2.0);
		assert_true(fabs(angle_now() - at) < 1e-9);
		tear_down();
	}
}

static void a_drive_that_its_watchdog_stopped_sweeps_again_when_facetd_is_back(void **state)
{
	struct config config = strict_config();

	(void)state;
	for (int kind = 0; kind < 2; kind++) {
		set_up(&config, kind ? &strict : &simple);
		run(3.3);
		for (int i = 0; i < 10; i++) { /* it was stopped, not killed: nobody opened the link anew */
			bed.dead = true;
			run(0.5 + 0.4 * i);
			bed.dead = false;
			bed.longest_ns = 0;
			assert_sweeps(6.0);
		}
		assert_int_equal(bed.notes, 0);
		tear_down();
	}
}

/* ---- faults ---- */

static void a_fault_is_reset_once_and_the_second_one_halts(void **state)
{
	struct config config = strict_config();

	(void)state;
	set_up(&config, &strict);
	run(3.0);
	order("fault", 0.0, true);
	order("fault", 0.0, false); /* it is there, and may be reset */
	run(1.0);
	assert_int_equal(bed.resets, 1);
	assert_int_equal(bed.notes, 2);
	assert_non_null(strstr(bed.said[0], "has a fault: register 17 is 0x"));
	assert_non_null(strstr(bed.said[0], "reset, once"));
	assert_string_equal(bed.said[1], "");
	assert_sweeps(10.0);
	order("fault", 0.0, true);
	order("fault", 0.0, false);
	run(1.0);
	assert_int_equal(bed.notes, 3);
	assert_non_null(strstr(bed.said[2], "has a fault again"));
	bed.targets = bed.starts = bed.enables = 0;
	assert_stands(600.0);
	assert_int_equal(bed.resets, 1);
	assert_int_equal(bed.targets + bed.starts + bed.enables, 0);
	assert_int_equal(bed.notes, 3);
	/* Somebody clears it at the drive: the sweep goes on. */
	clear_at_the_drive();
	run(2.0);
	assert_sweeps(10.0);
	assert_string_equal(bed.said[bed.notes - 1], "");
	tear_down();
}

static void a_drive_that_ran_well_for_ten_minutes_may_be_reset_again(void **state)
{
	struct config config = strict_config();

	(void)state;
	set_up(&config, &strict);
	run(3.0);
	for (int i = 1; i <= 3; i++) {
		order("fault", 0.0, true);
		order("fault", 0.0, false);
		run(2.0);
		assert_int_equal(bed.resets, i);
		assert_sweeps(620.0);
	}
	tear_down();
}

static void a_fault_that_stays_is_reported_once_and_never_reset_again(void **state)
{
	struct config config = strict_config();

	(void)state;
	set_up(&config, &strict);
	run(3.0);
	order("fault", 0.0, true);
	run(2.0);
	assert_int_equal(bed.resets, 1);
	assert_int_equal(bed.notes, 2);
	assert_non_null(strstr(bed.said[1], "has a fault that its reset did not clear"));
	bed.targets = bed.starts = bed.enables = 0;
	assert_stands(600.0);
	assert_int_equal(bed.resets, 1);
	assert_int_equal(bed.targets + bed.starts + bed.enables, 0);
	assert_int_equal(bed.notes, 2);
	tear_down();
}

static void a_fault_without_a_reset_halts_until_it_is_cleared(void **state)
{
	struct config config = strict_config();

	(void)state;
	config.device[0].reset.n = 0;
	set_up(&config, &strict);
	run(3.0);
	order("fault", 0.0, true);
	run(0.3);
	assert_int_equal(bed.notes, 1);
	assert_non_null(strstr(bed.said[0], "until it is cleared"));
	assert_stands(100.0);
	order("fault", 0.0, false);
	clear_at_the_drive();
	run(2.0);
	assert_sweeps(10.0);
	tear_down();
}

/* A fault that comes and goes by itself must not make facetd enable the drive at its pace. */
static void a_fault_that_flickers_is_answered_rarely(void **state)
{
	struct config config = strict_config();

	(void)state;
	config.device[0].reset.n = 0;
	set_up(&config, &strict);
	run(3.0);
	bed.enables = 0;
	for (int i = 0; i < 1000; i++) {
		order("fault", 0.0, true);
		run(0.15);
		order("fault", 0.0, false);
		clear_at_the_drive();
		bed.control = 0;
		run(0.15);
	}
	assert_in_range(bed.enables, 0, 12);
	run(32.0);
	assert_sweeps(10.0);
	tear_down();
}

static void a_servo_that_is_stuck_is_halted_and_reported_once(void **state)
{
	struct config config = servo_config();

	(void)state;
	config.device[0].following_rad = 10.0 * DEG;
	set_up(&config, &simple);
	run(3.0);
	order("stuck", 0.0, true);
	run(5.0);
	assert_int_equal(bed.notes, 1);
	assert_non_null(strstr(bed.said[0], "the sweep stopped: servo stands still"));
	bed.targets = 0;
	assert_stands(600.0);
	assert_int_equal(bed.targets, 0);
	assert_int_equal(bed.notes, 1);
	tear_down();
}

static void a_sequence_that_comes_to_no_end_halts_and_the_angle_is_read(void **state)
{
	const struct sim_drive_params params = {.strict = true, .unhomed = true};
	struct config config = strict_config();

	(void)state;
	until(then(&config.device[0].write, SIM_DRIVE_CONTROL, 0x0f), SIM_DRIVE_IS_HOMED, SIM_DRIVE_IS_HOMED);
	set_up(&config, &params);
	assert_int_equal(run(5.0), DIALOGUE_STREAMING);
	assert_int_equal(bed.notes, 1);
	assert_non_null(strstr(bed.said[0], "step 3 of `write`"));
	assert_stands(100.0);
	assert_int_equal(bed.targets, 0);
	assert_int_equal(bed.notes, 1);
	tear_down();
}

/* ---- answers that are none ---- */

static void a_write_without_an_answer_is_said_three_times_then_given_up(void **state)
{
	struct config config = servo_config();

	(void)state;
	set_up(&config, &simple);
	bed.unanswered = true;
	for (int i = 0; i < 100 && bed.step.state != DIALOGUE_FAILED; i++) {
		double angle = 0.1;
		struct reply known = {
		    .t_ns = bed.t_ns, .kind = MODBUS_ANGLE, .len = sizeof angle, .payload = (const uint8_t *)&angle};

		driver_modbus.dialogue_reply(bed.dialogue, &known);
		driver_modbus.dialogue_step(bed.dialogue, bed.t_ns, &bed.step);
		bed.writes += bed.step.write_len > 0;
		bed.t_ns = bed.step.deadline_ns;
	}
	assert_int_equal(bed.writes, 3);
	assert_non_null(strstr(bed.step.error, "does not answer"));
	tear_down();
}

static void lost_and_busy_answers_are_asked_for_again(void **state)
{
	struct config config = strict_config();

	(void)state;
	set_up(&config, &strict);
	bed.lossy = true;
	run(3.0);
	for (int i = 0; i < 50; i++) {
		struct sim_fault lost = {.kind = "lost"}; /* once */

		sim_drive_fault(bed.drive, &lost, true, bed.t_ns);
		assert_int_equal(run(0.013), DIALOGUE_STREAMING);
		order("busy", 0.0, true);
		assert_int_equal(run(0.2), DIALOGUE_STREAMING);
		order("busy", 0.0, false);
		assert_int_equal(run(0.3), DIALOGUE_STREAMING);
	}
	assert_sweeps(10.0);
	assert_int_equal(bed.notes, 0);
	tear_down();
}

static void a_register_that_is_refused_halts_with_its_address(void **state)
{
	for (int which = 0; which < 5; which++) {
		struct config config = strict_config();
		struct config_device *d = &config.device[0];
		uint16_t *const address[] = {&d->target.address, &d->strobe.address, &d->watchdog.address,
		                             &d->status.address, &d->write.item[1].until.address};

		(void)state;
		*address[which] = 400;
		set_up(&config, &strict);
		assert_int_equal(run(5.0), DIALOGUE_STREAMING);
		assert_int_equal(bed.notes, 1);
		assert_non_null(strstr(bed.said[0], "at address 400 with exception 2"));
		bed.targets = 0;
		assert_stands(60.0);
		assert_int_equal(bed.targets, 0);
		tear_down();
	}
}

static void a_position_that_is_refused_is_given_up(void **state)
{
	struct config config = servo_config();
	struct modbus_transaction t = {.unit = 1, .function = 0x83, .n = 1, .value = {11}, .t_answer_ns = 1};

	(void)state;
	config.device[0].position.address = 400;
	set_up(&config, &simple);
	assert_int_equal(run(5.0), DIALOGUE_FAILED);
	assert_non_null(strstr(bed.step.error, "check `position`"));
	tear_down();
	set_up(&config, &simple);
	decode(&t);
	step_dialogue();
	assert_int_equal(bed.step.state, DIALOGUE_FAILED);
	assert_non_null(strstr(bed.step.error, "gateway"));
	tear_down();
}

static void a_target_that_its_register_cannot_hold_is_never_sent(void **state)
{
	struct config config = servo_config();

	(void)state;
	config.device[0].target.type = REGISTER_U16;
	config.sweep.from_rad = 10.0 * DEG; /* it counts up: below 0 there */
	set_up(&config, &simple);
	assert_int_equal(run(5.0), DIALOGUE_STREAMING);
	assert_int_equal(bed.targets, 0);
	assert_int_equal(bed.notes, 1);
	assert_non_null(strstr(bed.said[0], "do not hold it"));
	tear_down();
}

/* ---- the end ---- */

static void stopping_goes_to_the_rest_angle_then_disables(void **state)
{
	struct config config = strict_config();

	(void)state;
	config.sweep.has_rest = true;
	config.sweep.rest_rad = -35.0 * DEG; /* outside from..to: only the rest may be */
	set_up(&config, &strict);
	run(3.3);
	assert_true(bed.low > -20.001 * DEG);
	driver_modbus.dialogue_stop(bed.dialogue, bed.t_ns);
	assert_int_equal(run(10.0), DIALOGUE_FAILED);
	assert_string_equal(bed.step.error, "");
	assert_true(fabs(angle_now() + 35.0 * DEG) < 0.11 * DEG);
	assert_int_equal(bed.control, 0);
	tear_down();
}

static void stopping_disables_at_whatever_time(void **state)
{
	struct config config = strict_config();

	(void)state;
	for (int i = 0; i < 200; i++) {
		set_up(&config, &strict);
		run(0.005 * i);
		if (i % 7 == 3)
			order("fault", 0.0, true);
		driver_modbus.dialogue_stop(bed.dialogue, bed.t_ns);
		assert_int_equal(run(3.0), DIALOGUE_FAILED);
		assert_string_equal(bed.step.error, "");
		assert_true((bed.control & 15) != 15 || i % 7 == 3);
		tear_down();
	}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_servo_that_never_answered_does_not_stream),
	    cmocka_unit_test(a_simple_servo_sweeps_between_its_ends),
	    cmocka_unit_test(a_strict_drive_is_enabled_and_takes_each_target_at_an_edge),
	    cmocka_unit_test(a_drive_that_must_be_homed_is_homed_first),
	    cmocka_unit_test(all_orders_and_floats_sweep),
	    cmocka_unit_test(the_sequence_waits_as_it_is_told_and_is_written_again_after_a_reset),
	    cmocka_unit_test(a_servo_without_a_sweep_is_read_and_never_told_anything),
	    cmocka_unit_test(what_the_sweep_needs_and_nobody_gave_is_said_before_anything_moves),
	    cmocka_unit_test(the_watchdog_is_written_in_time_whatever_else_is_done),
	    cmocka_unit_test(a_drive_stands_within_its_time_when_facetd_dies),
	    cmocka_unit_test(a_drive_that_its_watchdog_stopped_sweeps_again_when_facetd_is_back),
	    cmocka_unit_test(a_fault_is_reset_once_and_the_second_one_halts),
	    cmocka_unit_test(a_drive_that_ran_well_for_ten_minutes_may_be_reset_again),
	    cmocka_unit_test(a_fault_that_stays_is_reported_once_and_never_reset_again),
	    cmocka_unit_test(a_fault_without_a_reset_halts_until_it_is_cleared),
	    cmocka_unit_test(a_fault_that_flickers_is_answered_rarely),
	    cmocka_unit_test(a_servo_that_is_stuck_is_halted_and_reported_once),
	    cmocka_unit_test(a_sequence_that_comes_to_no_end_halts_and_the_angle_is_read),
	    cmocka_unit_test(a_write_without_an_answer_is_said_three_times_then_given_up),
	    cmocka_unit_test(lost_and_busy_answers_are_asked_for_again),
	    cmocka_unit_test(a_register_that_is_refused_halts_with_its_address),
	    cmocka_unit_test(a_position_that_is_refused_is_given_up),
	    cmocka_unit_test(a_target_that_its_register_cannot_hold_is_never_sent),
	    cmocka_unit_test(stopping_goes_to_the_rest_angle_then_disables),
	    cmocka_unit_test(stopping_disables_at_whatever_time),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

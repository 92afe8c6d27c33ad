/* Laws L1 and L9: a servo sweeps between its ends for hours, and one that does not is given up with a sentence; in virtual time. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <math.h>

#include "tests/modbus_servo.h"

/* ---- the dialogue, against a servo in virtual time ---- */

struct virtual_servo {
	double angle, target, speed; /* rad, positive down, as the configuration says */
	bool deaf;                   /* answers writes, moves nowhere */
	int writes, initial, targets;
	double low, high; /* of the targets */
};

static void virtual_write(struct virtual_servo *servo, const struct config *config, const struct dialogue_step *step)
{
	const struct config_device *d = &config->device[0];
	struct modbus_transaction t;
	double v;

	assert_int_equal(modbus_wire_get(step->write, step->write_len, &t), (ssize_t)step->write_len);
	servo->writes++;
	if (t.address == d->target.address) {
		assert_int_equal(modbus_wire_decode(&d->target, t.value, &v), 0);
		servo->target = v;
		servo->low = servo->targets ? fmin(servo->low, v) : v;
		servo->high = servo->targets ? fmax(servo->high, v) : v;
		servo->targets++;
	} else if (t.address == d->speed.address) {
		assert_int_equal(modbus_wire_decode(&d->speed, t.value, &servo->speed), 0);
	} else {
		servo->initial++;
	}
}

static void virtual_move(struct virtual_servo *servo, double seconds)
{
	double way = servo->speed * seconds, whole = servo->target - servo->angle;

	if (servo->deaf)
		return;
	servo->angle = fabs(whole) <= way ? servo->target : servo->angle + (whole > 0.0 ? way : -way);
}

/* Runs `seconds`, an angle each 10 ms; calls `look` with every angle. Answers the last step's state. */
static enum dialogue_state virtual_run(struct dialogue *d, struct virtual_servo *servo, const struct config *config,
                                       int64_t *t_ns, double seconds, struct dialogue_step *ret,
                                       void (*look)(void *, double), void *ctx)
{
	int64_t end_ns = *t_ns + (int64_t)(seconds * 1e9);

	for (; *t_ns < end_ns; *t_ns += 10 * MS) {
		struct reply angle = {
		    .t_ns = *t_ns, .kind = MODBUS_ANGLE, .len = sizeof(double), .payload = (uint8_t *)&servo->angle};
		uint16_t address = 0;
		struct reply written = {
		    .t_ns = *t_ns, .kind = MODBUS_WRITTEN, .len = 2, .payload = (uint8_t *)&address};

		virtual_move(servo, 0.01);
		driver_modbus.dialogue_reply(d, &angle);
		driver_modbus.dialogue_data(d, *t_ns);
		driver_modbus.dialogue_step(d, *t_ns, ret);
		if (ret->state == DIALOGUE_FAILED)
			return ret->state;
		if (ret->write_len) {
			virtual_write(servo, config, ret);
			driver_modbus.dialogue_reply(d, &written);
		}
		if (look)
			look(ctx, servo->angle);
	}
	return ret->state;
}

struct turns {
	int n, direction;
	double last, low, high;
};

static void count_turns(void *ctx, double angle)
{
	struct turns *turns = ctx;
	int direction = angle > turns->last ? 1 : angle < turns->last ? -1 : turns->direction;

	if (turns->direction && direction != turns->direction)
		turns->n++;
	turns->direction = direction;
	turns->last = angle;
	turns->low = fmin(turns->low, angle);
	turns->high = fmax(turns->high, angle);
}

static void a_servo_that_never_answered_does_not_stream(void **state)
{
	struct config config = servo_config();
	struct dialogue *d = driver_modbus.dialogue_create(&config, 0);
	struct virtual_servo servo = {.angle = 0};
	struct dialogue_step step;
	int64_t t_ns = 5000000000;

	(void)state;
	for (int life = 0; life < 2; life++) { /* a link that is lost and opened anew begins again */
		driver_modbus.dialogue_reset(d, t_ns);
		driver_modbus.dialogue_step(d, t_ns, &step);
		assert_int_equal(step.state, DIALOGUE_CONFIGURING);
		virtual_run(d, &servo, &config, &t_ns, 1.0, &step, NULL, NULL);
		assert_int_equal(step.state, DIALOGUE_STREAMING);
	}
	driver_modbus.dialogue_destroy(d);
}

static void a_triangle_sweeps_between_its_ends_for_hours(void **state)
{
	struct config config = servo_config();
	struct dialogue *d = driver_modbus.dialogue_create(&config, 0);
	struct virtual_servo servo = {.angle = 3.0 * DEG};
	struct dialogue_step step;
	struct turns turns = {0};
	int64_t t_ns = 5000000000;

	(void)state;
	driver_modbus.dialogue_reset(d, t_ns);
	assert_int_equal(virtual_run(d, &servo, &config, &t_ns, 3600.0, &step, count_turns, &turns),
	                 DIALOGUE_STREAMING);
	assert_true(fabs(servo.speed - 40.0 * DEG) < 1e-6);
	/* 50 degrees at 40 degrees a second: 1.25 s each way */
	assert_in_range(turns.n, 2700, 2900);
	assert_true(turns.low > -20.0001 * DEG && turns.low < -19.0 * DEG);
	assert_true(turns.high < 30.0001 * DEG && turns.high > 29.0 * DEG);
	assert_true(servo.low > -20.001 * DEG && servo.high < 30.001 * DEG);
	driver_modbus.dialogue_destroy(d);
}

static void a_sinus_slows_down_towards_its_ends(void **state)
{
	struct config config = servo_config();
	struct virtual_servo servo = {.angle = -20.0 * DEG};
	struct dialogue_step step;
	struct turns turns = {0};
	struct dialogue *d;
	int64_t t_ns = 0;

	(void)state;
	config.sweep.profile = SWEEP_SINUS;
	d = driver_modbus.dialogue_create(&config, 0);
	driver_modbus.dialogue_reset(d, t_ns);
	assert_int_equal(virtual_run(d, &servo, &config, &t_ns, 120.0, &step, count_turns, &turns), DIALOGUE_STREAMING);
	/* Half a period is pi A / peak = 1.96 s, less 6 % for turning a tenth of a degree early at each end, where it is
	 * slowest; a triangle would take 1.25 s, a speed that never rises again 50 s. */
	assert_in_range(turns.n, 55, 72);
	assert_true(turns.low < -19.0 * DEG && turns.high > 29.0 * DEG);
	driver_modbus.dialogue_destroy(d);
}

static void steps_are_settled_and_stay_within_the_ends(void **state)
{
	struct config config = servo_config();
	struct virtual_servo servo = {0};
	struct dialogue_step step;
	struct dialogue *d;
	int64_t t_ns = 0;

	(void)state;
	config.sweep.profile = SWEEP_STEP;
	config.sweep.step_rad = 7.0 * DEG; /* 50 degrees: seven steps and a short one */
	config.sweep.settle_ns = 300 * MS;
	d = driver_modbus.dialogue_create(&config, 0);
	driver_modbus.dialogue_reset(d, t_ns);
	assert_int_equal(virtual_run(d, &servo, &config, &t_ns, 60.0, &step, NULL, NULL), DIALOGUE_STREAMING);
	/* a step takes 0.175 s and 0.3 s of settling */
	assert_in_range(servo.targets, 100, 130);
	assert_true(servo.low > -20.001 * DEG && servo.high < 30.001 * DEG && servo.high > 29.9 * DEG);
	driver_modbus.dialogue_destroy(d);
}

static void initial_writes_come_first_and_again_after_a_reset(void **state)
{
	struct config config = servo_config();
	struct virtual_servo servo = {0};
	struct dialogue_step step;
	struct dialogue *d;
	int64_t t_ns = 0;

	(void)state;
	config.device[0].write.n = 2;
	config.device[0].write.item[0].address = 10;
	config.device[0].write.item[1].address = 11;
	d = driver_modbus.dialogue_create(&config, 0);
	driver_modbus.dialogue_reset(d, t_ns);
	driver_modbus.dialogue_step(d, t_ns, &step);
	assert_int_equal(step.state, DIALOGUE_CONFIGURING);
	driver_modbus.dialogue_reset(d, t_ns);
	assert_int_equal(virtual_run(d, &servo, &config, &t_ns, 1.0, &step, NULL, NULL), DIALOGUE_STREAMING);
	assert_int_equal(servo.initial, 2);
	driver_modbus.dialogue_reset(d, t_ns);
	virtual_run(d, &servo, &config, &t_ns, 1.0, &step, NULL, NULL);
	assert_int_equal(servo.initial, 4);
	driver_modbus.dialogue_destroy(d);
}

static void a_write_without_an_answer_is_said_three_times_then_given_up(void **state)
{
	struct config config = servo_config();
	struct dialogue *d = driver_modbus.dialogue_create(&config, 0);
	struct dialogue_step step = {0};
	int writes = 0;
	int64_t t_ns = 0;

	(void)state;
	driver_modbus.dialogue_reset(d, t_ns);
	for (int i = 0; i < 100 && step.state != DIALOGUE_FAILED; i++) {
		driver_modbus.dialogue_data(d, t_ns);
		driver_modbus.dialogue_step(d, t_ns, &step);
		writes += step.write_len > 0;
		assert_true(step.state == DIALOGUE_FAILED || step.deadline_ns > t_ns);
		t_ns = step.deadline_ns;
	}
	assert_int_equal(writes, 3);
	assert_non_null(strstr(step.error, "does not answer"));
	driver_modbus.dialogue_destroy(d);
}

static void a_servo_that_stands_still_is_given_up_with_a_sentence(void **state)
{
	struct config config = servo_config();
	struct dialogue *d = driver_modbus.dialogue_create(&config, 0);
	struct virtual_servo servo = {.deaf = true};
	struct dialogue_step step;
	int64_t t_ns = 0;

	(void)state;
	driver_modbus.dialogue_reset(d, t_ns);
	assert_int_equal(virtual_run(d, &servo, &config, &t_ns, 30.0, &step, NULL, NULL), DIALOGUE_FAILED);
	assert_int_equal(servo.targets, 6);
	assert_non_null(strstr(step.error, "stands still"));
	driver_modbus.dialogue_destroy(d);
}

static void a_servo_without_a_sweep_is_read_and_never_told_anything(void **state)
{
	struct config config = servo_config();
	struct virtual_servo servo = {0};
	struct dialogue_step step;
	struct dialogue *d;
	int64_t t_ns = 0;

	(void)state;
	strcpy(config.sweep.device, "other");
	d = driver_modbus.dialogue_create(&config, 0);
	driver_modbus.dialogue_reset(d, t_ns);
	assert_int_equal(virtual_run(d, &servo, &config, &t_ns, 10.0, &step, NULL, NULL), DIALOGUE_STREAMING);
	assert_int_equal(servo.writes, 0);
	/* A program that slept itself has not listened; one that looked and heard nothing for three seconds has. */
	t_ns += 60000 * MS;
	driver_modbus.dialogue_step(d, t_ns, &step);
	assert_int_equal(step.state, DIALOGUE_STREAMING);
	for (int i = 0; i < 100 && step.state != DIALOGUE_FAILED; i++) {
		t_ns = step.deadline_ns;
		driver_modbus.dialogue_step(d, t_ns, &step);
	}
	assert_int_equal(step.state, DIALOGUE_FAILED);
	assert_non_null(strstr(step.error, "no angle"));
	driver_modbus.dialogue_destroy(d);
}

static void stopping_goes_to_the_rest_angle_and_is_done(void **state)
{
	struct config config = servo_config();
	struct virtual_servo servo = {0};
	struct dialogue_step step;
	struct dialogue *d;
	int64_t t_ns = 0;

	(void)state;
	config.sweep.has_rest = true;
	config.sweep.rest_rad = -35.0 * DEG; /* outside from..to: only the rest may be */
	d = driver_modbus.dialogue_create(&config, 0);
	driver_modbus.dialogue_reset(d, t_ns);
	virtual_run(d, &servo, &config, &t_ns, 3.0, &step, NULL, NULL);
	assert_true(servo.low > -20.001 * DEG);
	driver_modbus.dialogue_stop(d, t_ns);
	assert_int_equal(virtual_run(d, &servo, &config, &t_ns, 10.0, &step, NULL, NULL), DIALOGUE_FAILED);
	assert_string_equal(step.error, "");
	assert_true(fabs(servo.angle + 35.0 * DEG) < 0.11 * DEG);
	driver_modbus.dialogue_destroy(d);
}

static void a_sinus_without_a_speed_register_is_refused(void **state)
{
	struct config config = servo_config();
	struct dialogue_step step;
	struct dialogue *d;

	(void)state;
	config.sweep.profile = SWEEP_SINUS;
	config.device[0].speed.set = false;
	d = driver_modbus.dialogue_create(&config, 0);
	driver_modbus.dialogue_reset(d, 0);
	driver_modbus.dialogue_step(d, 0, &step);
	assert_int_equal(step.state, DIALOGUE_FAILED);
	assert_non_null(strstr(step.error, "triangle"));
	driver_modbus.dialogue_destroy(d);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_servo_that_never_answered_does_not_stream),
	    cmocka_unit_test(a_triangle_sweeps_between_its_ends_for_hours),
	    cmocka_unit_test(a_sinus_slows_down_towards_its_ends),
	    cmocka_unit_test(steps_are_settled_and_stay_within_the_ends),
	    cmocka_unit_test(initial_writes_come_first_and_again_after_a_reset),
	    cmocka_unit_test(a_write_without_an_answer_is_said_three_times_then_given_up),
	    cmocka_unit_test(a_servo_that_stands_still_is_given_up_with_a_sentence),
	    cmocka_unit_test(a_servo_without_a_sweep_is_read_and_never_told_anything),
	    cmocka_unit_test(stopping_goes_to_the_rest_angle_and_is_done),
	    cmocka_unit_test(a_sinus_without_a_speed_register_is_refused),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

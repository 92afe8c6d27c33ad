/* Law L7 needs times that are true: a device's stamps become log time within 0.3 ms, however it drifts, wraps, stalls or is
 * switched off, never after the arrival, in order, and the same from a snapshot on. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "drivers/device_clock.h"

#define MS     1000000ll
#define SECOND 1000000000ll
#define START  (1700000000 * SECOND)
#define LEAST  (2.0 * 1e6) /* the constant part of every delay, which nobody can see */

/* How late arrivals are, beside LEAST. */
enum delays { NONE, TIM, LMS111, LMS511, ADAPTER, DELAYS };
static const char *const delay_names[DELAYS] = {"none", "TiM", "LMS111", "LMS511", "16 ms timer"};

/* A device whose clock is off by `ppm`, and the filter that hears it. */
struct device {
	struct device_clock clock;
	double ppm, tick_ns;
	uint64_t wrap;
	double now_ns;   /* host's time of the newest stamp */
	double ticks;    /* the device's, not wrapped */
	int64_t last_ns; /* arrival of the newest */
	int64_t answer_ns;
	uint64_t seed;
	double *error; /* since they were cleared */
	int errors, cap;
};

static double uniform(struct device *d)
{
	d->seed = d->seed * 6364136223846793005u + 1442695040888963407u;
	return (double)(d->seed >> 11) * 0x1p-53;
}

/* Median and largest of the measured ones (TiM 0.28/0.86, LMS111 0.08/3.0, LMS511 0.1/1.4), or a latency timer. */
static double draw_ns(struct device *d, enum delays delays)
{
	const double u = uniform(d);

	switch (delays) {
	case TIM:
		return 1e6 * 0.86 * pow(u, 1.62);
	case LMS111:
		return 1e6 * (u < 0.97 ? 0.16 * u : 3.0 * uniform(d));
	case LMS511:
		return 1e6 * (u < 0.95 ? 0.2 * u : 1.4 * uniform(d));
	case ADAPTER: /* its timer runs out every 16 ms of the host's clock */
		return 16e6 - fmod(d->now_ns - (double)START, 16e6) + 0.1e6 * u;
	default:
		return 0;
	}
}

static struct device make(double ppm, double tick_ns, uint64_t wrap, double drift_max, double ticks)
{
	struct device d = {
	    .ppm = ppm, .tick_ns = tick_ns, .wrap = wrap, .now_ns = (double)START, .ticks = ticks, .seed = 7};

	device_clock_init(&d.clock, tick_ns, wrap, drift_max);
	d.cap = 400000;
	d.error = calloc((size_t)d.cap, sizeof(*d.error));
	assert_non_null(d.error);
	return d;
}

static struct device micros(double ppm)
{
	return make(ppm, 1000, 1ull << 32, 500e-6, 4294967295.0 - 3e6); /* wraps after three seconds */
}

static void done(struct device *d)
{
	free(d->error);
}

/* Time goes on; the device counts. Stamps are whole ticks, so the moment of a stamp is when it began. */
static void pass(struct device *d, double host_ns)
{
	const double ticks = d->ticks + host_ns * (1 + 1e-6 * d->ppm) / d->tick_ns;
	const double whole = floor(ticks);

	d->now_ns += (whole - d->ticks) * d->tick_ns / (1 + 1e-6 * d->ppm);
	d->ticks = whole;
}

/* The stamp of now arrives so late (or with the one before it). The error of the answer, ns. */
static double hear(struct device *d, double delay_ns)
{
	const uint32_t tick = (uint32_t)((uint64_t)d->ticks % d->wrap);
	const int64_t arrival_ns = (int64_t)(d->now_ns + LEAST + delay_ns);

	d->last_ns = arrival_ns > d->last_ns ? arrival_ns : d->last_ns;
	const int64_t got_ns = device_clock_stamp(&d->clock, tick, d->last_ns);
	assert_true(got_ns <= d->last_ns + 100); /* some ns: several at once */
	assert_true(got_ns > d->answer_ns);
	assert_int_equal(device_clock_at(&d->clock, tick), got_ns);
	d->answer_ns = got_ns;
	const double error_ns = (double)got_ns - d->now_ns - LEAST;
	if (d->errors < d->cap)
		d->error[d->errors++] = fabs(error_ns);
	return error_ns;
}

static int compare(const void *a, const void *b)
{
	const double x = *(const double *)a, y = *(const double *)b;

	return x < y ? -1 : x > y;
}

static double p99_ms(struct device *d)
{
	qsort(d->error, (size_t)d->errors, sizeof(*d->error), compare);
	return d->errors ? d->error[d->errors * 99 / 100] / 1e6 : 0;
}

static void run(struct device *d, double period_ns, double seconds, enum delays delays)
{
	const double end_ns = d->now_ns + seconds * 1e9;

	while (d->now_ns < end_ns) {
		pass(d, period_ns);
		hear(d, draw_ns(d, delays));
	}
}

static void after_5_s_stamps_are_true_within_300_us(void **state)
{
	static const double rates[] = {15, 25, 50, 75};
	(void)state;
	for (enum delays delays = NONE; delays <= LMS511; delays++) {
		double worst = 0;
		for (int rate = 0; rate < 4; rate++)
			for (double ppm = -200; ppm <= 200; ppm += 100) {
				struct device d = micros(ppm);
				run(&d, 1e9 / rates[rate], 5, delays);
				d.errors = 0;
				run(&d, 1e9 / rates[rate], 10, delays);
				worst = fmax(worst, p99_ms(&d));
				d.errors = 0;
				run(&d, 1e9 / rates[rate], 300, delays);
				worst = fmax(worst, p99_ms(&d));
				done(&d);
			}
		printf("note: delays of %s: p99 %.3f ms\n", delay_names[delays], worst);
		assert_true(worst < 0.3);
	}
}

static void the_drift_is_found(void **state)
{
	(void)state;
	for (double ppm = -200; ppm <= 200; ppm += 50) {
		struct device d = micros(ppm);
		run(&d, 1e9 / 15, 120, TIM);
		assert_true(fabs(d.clock.drift * 1e6 - ppm) < 5);
		done(&d);
	}
}

/* An adapter's timer beats with the scan: the least delay comes round only every some seconds. */
static void an_adapter_with_a_timer_is_true_within_a_minute(void **state)
{
	(void)state;
	double worst = 0, early = 0;
	for (double period_ns = 1e9 / 75 * 2; period_ns < 8e7; period_ns += 2.0e7)
		for (double ppm = -200; ppm <= 200; ppm += 50) {
			struct device d = micros(ppm);
			run(&d, period_ns + 123456, 5, ADAPTER);
			d.errors = 0;
			run(&d, period_ns + 123456, 55, ADAPTER);
			early = fmax(early, p99_ms(&d));
			d.errors = 0;
			run(&d, period_ns + 123456, 600, ADAPTER);
			worst = fmax(worst, p99_ms(&d));
			done(&d);
		}
	printf("note: delays of a 16 ms timer: p99 %.2f ms in the first minute, %.2f ms after it\n", early, worst);
	assert_true(early < 4);
	assert_true(worst < 0.5);
}

static void hours_with_wraps_stay_true(void **state)
{
	struct device d = micros(137);
	(void)state;
	run(&d, 1e9 / 15, 5, TIM);
	d.errors = 0;
	run(&d, 1e9 / 15, 5 * 3600, TIM); /* four wraps of 71.6 minutes */
	assert_true(p99_ms(&d) < 0.3);
	assert_true(d.error[d.errors - 1] < 1e6);
	assert_int_equal(d.clock.restarts, 0);
	done(&d);
}

/* A crystal that warms up: 20 ppm in ten minutes. */
static void a_drift_that_drifts_is_followed(void **state)
{
	struct device d = micros(-60);
	(void)state;
	run(&d, 1e9 / 25, 5, LMS511);
	d.errors = 0;
	for (int i = 0; i < 600; i++) {
		d.ppm += 20.0 / 600;
		run(&d, 1e9 / 25, 1, LMS511);
	}
	printf("note: 20 ppm in ten minutes: p99 %.3f ms\n", p99_ms(&d));
	assert_true(p99_ms(&d) < 0.3);
	done(&d);
}

static void a_power_cycle_begins_anew(void **state)
{
	(void)state;
	for (double up_s = 1; up_s < 20000; up_s *= 3)
		for (double off_s = 0.3; off_s < 100; off_s *= 4) {
			struct device d = micros(80);
			run(&d, 1e9 / 15, up_s, TIM);
			d.now_ns += off_s * 1e9;
			d.ticks = 2e6; /* two seconds after its start */
			d.errors = 0;
			run(&d, 1e9 / 15, 5, TIM);
			p99_ms(&d);
			/* Doubted stamps are answered with their arrival: no worse than the largest delay. */
			if (up_s > 10)
				assert_true(d.error[d.errors - 1] < 1e6);
			d.errors = 0;
			run(&d, 1e9 / 15, 20, TIM);
			assert_true(p99_ms(&d) < 0.3);
			done(&d);
		}
}

static void a_step_of_either_sign_is_another_time(void **state)
{
	static const double steps_s[] = {-3000, -600, -11, -0.5, -0.05, 0.05, 0.5, 11, 600, 2000};
	(void)state;
	for (int i = 0; i < 10; i++) {
		struct device d = make(-120, 1000, 1ull << 32, 500e-6, 3.9e9);
		run(&d, 1e9 / 50, 30, LMS111);
		d.ticks += steps_s[i] * 1e6;
		run(&d, 1e9 / 50, 5, LMS111);
		assert_int_equal(d.clock.restarts, 1);
		d.errors = 0;
		run(&d, 1e9 / 50, 20, LMS111);
		assert_true(p99_ms(&d) < 0.3);
		assert_int_equal(d.clock.restarts, 1);
		done(&d);
	}
}

static void rubbish_now_and_then_is_not_believed(void **state)
{
	struct device d = micros(33);
	(void)state;
	run(&d, 1e9 / 15, 30, TIM);
	d.errors = 0;
	for (int i = 0; i < 200; i++) {
		const double ticks = d.ticks;
		run(&d, 1e9 / 15, 0.3 + uniform(&d), TIM);
		pass(&d, 1e9 / 15);
		const double true_ticks = d.ticks;
		const int errors = d.errors;
		d.ticks = floor(uniform(&d) * 4294967296.0);
		hear(&d, 0);
		d.errors = errors;
		d.ticks = true_ticks;
		assert_true(d.ticks > ticks);
	}
	assert_int_equal(d.clock.restarts, 0);
	assert_true(p99_ms(&d) < 0.3);
	done(&d);
}

static void gaps_of_any_length_are_judged_by_the_arrival(void **state)
{
	static const double gaps_s[] = {0.5, 3, 20, 63, 70, 300, 4294, 4296, 8000, 20000, 100000};
	(void)state;
	for (int i = 0; i < 11; i++)
		for (double ppm = -200; ppm <= 200; ppm += 200) {
			struct device d = micros(ppm);
			run(&d, 1e9 / 15, 90, TIM);
			pass(&d, gaps_s[i] * 1e9);
			assert_true(fabs(hear(&d, draw_ns(&d, TIM))) < 1e6); /* the first one too */
			assert_int_equal(d.clock.restarts, 0);
			run(&d, 1e9 / 15, 5, TIM);
			d.errors = 0;
			run(&d, 1e9 / 15, 30, TIM);
			assert_true(p99_ms(&d) < 0.3);
			done(&d);
		}
}

static void a_backlog_gets_the_times_it_was_measured(void **state)
{
	(void)state;
	for (double wait_s = 0.1; wait_s < 9; wait_s *= 1.7) {
		struct device d = micros(-90);
		run(&d, 1e9 / 15, 30, TIM);
		d.errors = 0;
		const double end_ns = d.now_ns + wait_s * 1e9;
		while (d.now_ns < end_ns) { /* all arrive at its end */
			pass(&d, 1e9 / 15);
			hear(&d, end_ns + 1e8 - d.now_ns);
		}
		run(&d, 1e9 / 15, 10, TIM);
		assert_true(p99_ms(&d) < 0.3);
		assert_int_equal(d.clock.restarts, 0);
		done(&d);
	}
}

static void a_backlog_at_the_start_is_mended_by_the_first_quick_one(void **state)
{
	struct device d = micros(50);
	(void)state;
	for (int i = 0; i < 8; i++) {
		pass(&d, 1e9 / 15);
		hear(&d, (8 - i) * 66.7e6);
	}
	pass(&d, 1e9 / 15);
	hear(&d, 0.1e6);
	d.errors = 0;
	run(&d, 1e9 / 15, 3, TIM);
	p99_ms(&d);
	assert_true(d.error[d.errors - 1] < 1e6);
	assert_int_equal(d.clock.restarts, 0);
	done(&d);
}

/* The mirror of a LMS2xx counts scans of 13.3 or 26.7 ms from 0 to 255; a slow line skips some. */
static void turn(struct device *d, int scans)
{
	for (int i = 0; i < scans; i++) {
		const double n = 1 + floor(20 * uniform(d) * uniform(d));

		d->ticks += n;
		d->now_ns += n * d->tick_ns / (1 + 1e-6 * d->ppm);
		hear(d, draw_ns(d, LMS511));
	}
}

static void a_mirror_that_counts_to_256_is_followed(void **state)
{
	double worst = 0;
	(void)state;
	for (double ppm = -4000; ppm <= 4000; ppm += 2000)
		for (int turns = 1; turns <= 4; turns *= 2) {
			struct device d = make(ppm, turns * 40e6 / 3, 256, 0.02, 17);
			turn(&d, 100);
			d.errors = 0;
			turn(&d, 20000);
			worst = fmax(worst, p99_ms(&d));
			assert_int_equal(d.clock.restarts, 0);
			done(&d);
		}
	printf("note: a mirror's count, 4000 ppm: p99 %.3f ms\n", worst);
	assert_true(worst < 0.3);
}

static void jitter_is_what_arrivals_were_late(void **state)
{
	struct device d = micros(10);
	int64_t p50, p99;
	(void)state;
	device_clock_jitter(&d.clock, &p50, &p99);
	assert_true(p50 == 0 && p99 == 0);
	run(&d, 1e9 / 15, 120, TIM);
	device_clock_jitter(&d.clock, &p50, &p99);
	assert_in_range(p50, 230000, 330000);
	assert_in_range(p99, 800000, 900000);
	done(&d);
}

static size_t save(struct device_clock *clock, uint8_t *ret, size_t cap)
{
	struct state s;
	state_save(&s, ret, cap);
	device_clock_state(&s, clock);
	assert_true(state_done(&s));
	return s.at;
}

static void a_snapshot_goes_on_with_the_same_bits(void **state)
{
	static uint8_t bytes[1 << 14];
	(void)state;
	for (int when = 0; when < 40; when++) {
		struct device d = micros(100), e;
		struct state s;
		run(&d, 1e9 / 50, 0.06 * when * when, LMS111);
		if (when % 3 == 1) { /* while it doubts */
			d.ticks += 5e6;
			run(&d, 1e9 / 50, 0.1, LMS111);
		}
		const size_t len = save(&d.clock, bytes, sizeof(bytes));
		e = micros(100);
		free(e.error);
		const struct device_clock empty = e.clock;
		e = d;
		e.error = calloc((size_t)e.cap, sizeof(*e.error));
		e.clock = empty;
		state_load(&s, bytes, len);
		device_clock_state(&s, &e.clock);
		assert_true(state_done(&s));
		for (int i = 0; i < 2000; i++) {
			pass(&d, 2e7), pass(&e, 2e7);
			hear(&d, draw_ns(&d, LMS111)), hear(&e, draw_ns(&e, LMS111));
			assert_int_equal(d.answer_ns, e.answer_ns);
		}
		assert_memory_equal(&d.clock, &e.clock, offsetof(struct device_clock, jitter));
		done(&d);
		done(&e);
	}
}

static void a_corrupt_snapshot_is_refused_and_changes_nothing(void **state)
{
	static uint8_t bytes[1 << 14], broken[1 << 14];
	struct device d = micros(100);
	struct state s;
	int refused = 0;
	(void)state;
	run(&d, 1e9 / 50, 100, LMS111);
	const size_t len = save(&d.clock, bytes, sizeof(bytes));
	for (size_t cut = 0; cut < len; cut += 7) {
		struct device_clock clock = d.clock;
		state_load(&s, bytes, cut);
		device_clock_state(&s, &clock);
		assert_true(s.failed);
		assert_memory_equal(&clock, &d.clock, sizeof(clock));
	}
	for (size_t at = 0; at < 1500; at++)
		for (int bit = 0; bit < 8; bit++) {
			struct device_clock clock = d.clock;
			memcpy(broken, bytes, len);
			broken[at] ^= (uint8_t)(1 << bit);
			state_load(&s, broken, len);
			device_clock_state(&s, &clock);
			refused += s.failed;
			if (s.failed)
				assert_memory_equal(&clock, &d.clock, sizeof(clock));
			for (int i = 0; i < 20; i++) /* what was taken bears anything, too */
				device_clock_stamp(&clock, (uint32_t)(i * 12345678), d.last_ns + i * SECOND);
		}
	assert_in_range(refused, 3000, 12000);
	done(&d);
}

/* Whatever comes: order and the arrival are kept. */
static void any_stamps_and_arrivals_keep_their_order(void **state)
{
	static const uint64_t wraps[] = {2, 256, 65536, 1ull << 32};
	(void)state;
	for (int kind = 0; kind < 4; kind++) {
		struct device d = make(0, kind ? 1e6 : 1, wraps[kind], kind % 2 ? 0.02 : 1e-4, 0);
		int64_t arrival_ns = START;
		for (int i = 0; i < 100000; i++) {
			const double u = uniform(&d);
			arrival_ns += u < 0.3 ? 0 : (int64_t)(uniform(&d) * (u < 0.9 ? 1e8 : u < 0.999 ? 1e10 : 1e15));
			const uint32_t tick = (uint32_t)(uniform(&d) * (double)wraps[kind]);
			const int64_t t_ns = device_clock_stamp(&d.clock, tick, arrival_ns);
			assert_true(t_ns >= d.answer_ns &&
			            t_ns <= (arrival_ns > d.answer_ns ? arrival_ns : d.answer_ns + 1));
			d.answer_ns = t_ns;
		}
		device_clock_stamp(&d.clock, 1, INT64_MIN);
		device_clock_stamp(&d.clock, 1, INT64_MAX);
		device_clock_stamp(&d.clock, UINT32_MAX, 0);
		done(&d);
	}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(after_5_s_stamps_are_true_within_300_us),
	    cmocka_unit_test(the_drift_is_found),
	    cmocka_unit_test(an_adapter_with_a_timer_is_true_within_a_minute),
	    cmocka_unit_test(hours_with_wraps_stay_true),
	    cmocka_unit_test(a_drift_that_drifts_is_followed),
	    cmocka_unit_test(a_power_cycle_begins_anew),
	    cmocka_unit_test(a_step_of_either_sign_is_another_time),
	    cmocka_unit_test(rubbish_now_and_then_is_not_believed),
	    cmocka_unit_test(gaps_of_any_length_are_judged_by_the_arrival),
	    cmocka_unit_test(a_backlog_gets_the_times_it_was_measured),
	    cmocka_unit_test(a_backlog_at_the_start_is_mended_by_the_first_quick_one),
	    cmocka_unit_test(a_mirror_that_counts_to_256_is_followed),
	    cmocka_unit_test(jitter_is_what_arrivals_were_late),
	    cmocka_unit_test(a_snapshot_goes_on_with_the_same_bits),
	    cmocka_unit_test(a_corrupt_snapshot_is_refused_and_changes_nothing),
	    cmocka_unit_test(any_stamps_and_arrivals_keep_their_order),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

/* Law L7 needs times that are true: stamps lie on the mirror's grid, never after the arrival, whatever the host did meanwhile. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "drivers/clock_filter.h"

#define MS        1000000LL
#define PERIOD_NS 13333333LL

/* A scanner whose period is off by `drift_ppm` to the host's clock, and the filter that hears it. */
struct line {
	struct clock_filter filter;
	double true_ns; /* end of the last telegram, host's clock */
	double drift_ppm;
	int64_t arrival_ns, stamp_ns;
	uint64_t seed;
	double worst_ms, sum_ms; /* errors since they were last cleared */
	int n;
};

static double uniform(struct line *line)
{
	line->seed = line->seed * 6364136223846793005u + 1442695040888963407u;
	return (double)(line->seed >> 11) * 0x1p-53;
}

static struct line start(double drift_ppm)
{
	struct line line = {.true_ns = 5e9, .drift_ppm = drift_ppm, .seed = 7};
	clock_filter_init(&line.filter, PERIOD_NS);
	return line;
}

static void clear(struct line *line)
{
	line->worst_ms = line->sum_ms = 0;
	line->n = 0;
}

static void expect_sane(const struct line *line, int64_t stamp_ns)
{
	assert_true(stamp_ns <= line->arrival_ns + 1);
	assert_true(line->stamp_ns == 0 || stamp_ns > line->stamp_ns);
}

/* The next telegram ends `periods` after the last and arrives `delay_ms` later, or with the one before it. */
static double hear(struct line *line, int turns, int periods, double delay_ms)
{
	line->true_ns += periods * (double)PERIOD_NS * (1 + 1e-6 * line->drift_ppm);
	int64_t arrival = (int64_t)(line->true_ns + delay_ms * 1e6);
	line->arrival_ns = arrival > line->arrival_ns ? arrival : line->arrival_ns;
	int64_t stamp = clock_filter_stamp(&line->filter, line->arrival_ns, turns);
	expect_sane(line, stamp);
	line->stamp_ns = stamp;
	double error_ms = ((double)stamp - line->true_ns) / 1e6;
	line->worst_ms = fmax(line->worst_ms, fabs(error_ms));
	line->sum_ms += fabs(error_ms);
	line->n++;
	return error_ms;
}

static void a_steady_stream_is_stamped_within_a_millisecond(void **state)
{
	(void)state;
	for (int turns = 1; turns <= 4; turns *= 2)
		for (int drift = -200; drift <= 200; drift += 100) {
			struct line line = start(drift);
			for (int i = 0; i < 20000; i++) {
				hear(&line, turns, turns,
				     0.1 + 0.4 * uniform(&line) + (uniform(&line) < 0.05 ? 11 : 0));
				if (i == 100)
					clear(&line);
			}
			assert_true(line.worst_ms < 1);
		}
}

static void delays_of_tens_of_ms_leave_the_least_of_them(void **state)
{
	(void)state;
	for (int turns = 1; turns <= 2; turns++)
		for (int drift = -200; drift <= 200; drift += 200) {
			struct line line = start(drift);
			for (int i = 0; i < 20000; i++) {
				hear(&line, turns, turns, 20 * uniform(&line));
				if (i == 200)
					clear(&line);
			}
			printf("note: delays 0 .. 20 ms, %d turns, %+d ppm: worst %.2f ms, mean %.2f ms\n", turns,
			       drift, line.worst_ms, line.sum_ms / line.n);
			assert_true(line.worst_ms < 3);
			assert_true(line.sum_ms / line.n < 0.8);
		}
}

static void a_backlog_read_at_once_gets_the_times_of_its_turns(void **state)
{
	(void)state;
	for (int turns = 1; turns <= 4; turns *= 2)
		for (int waiting = 2; waiting * turns * PERIOD_NS < 240 * MS; waiting++) {
			struct line line = start(50);
			for (int i = 0; i < 300; i++)
				hear(&line, turns, turns, 0.5 * uniform(&line));
			for (int round = 0; round < 20; round++) {
				clear(&line);
				for (int i = 0; i < waiting; i++) /* all arrive with the last of them */
					hear(&line, turns, turns, (waiting - 1 - i) * turns * 13.333333 + 0.3);
				for (int i = 0; i < 40; i++)
					hear(&line, turns, turns, 0.5 * uniform(&line));
				assert_true(line.worst_ms < 1);
			}
		}
}

/* Between two telegrams pass any number of periods; the first may be late, now and then one is. */
static void a_stream_with_gaps_stays_within_a_millisecond(void **state)
{
	(void)state;
	for (int turns = 1; turns <= 4; turns *= 2)
		for (int drift = -200; drift <= 200; drift += 100) {
			struct line line = start(drift);
			hear(&line, turns, turns, 5);
			for (int i = 0; i < 5000; i++) {
				int skipped = 1 + (int)(20 * uniform(&line));
				hear(&line, turns, turns + skipped,
				     0.1 + 0.4 * uniform(&line) + (uniform(&line) < 0.1 ? 6 : 0));
				if (i == 4)
					clear(&line);
			}
			assert_true(line.worst_ms < 1);
		}
}

static void a_slow_line_that_skips_scans_stays_within_a_millisecond(void **state)
{
	struct line line = start(-120);
	(void)state;
	/* 38400 Bd: a telegram of 190 ms each 14 or 16 periods of two turns. */
	for (int i = 0; i < 2000; i++) {
		hear(&line, 2, uniform(&line) < 0.7 ? 14 : 16, 0.2 + 2 * uniform(&line) * uniform(&line));
		if (i == 20)
			clear(&line);
	}
	assert_true(line.worst_ms < 1);
}

static void a_lost_telegram_costs_one_stamp(void **state)
{
	struct line line = start(30);
	(void)state;
	for (int i = 0; i < 200; i++)
		hear(&line, 2, 2, 0.5 * uniform(&line));
	for (int round = 0; round < 10; round++) {
		hear(&line, 2, 4, 0.2); /* one was lost: it could as well be a late one */
		assert_true(hear(&line, 2, 2, 0.2) > -1);
		clear(&line);
		for (int i = 0; i < 150; i++)
			hear(&line, 2, 2, 0.5 * uniform(&line));
		assert_true(line.worst_ms < 1);
	}
}

/* Its bytes were refused: whoever saw that says so, and the next late telegram is not taken for one that waited. */
static void a_telegram_that_was_seen_to_be_lost_costs_none(void **state)
{
	(void)state;
	for (int turns = 1; turns <= 4; turns *= 2) {
		struct line line = start(100);
		for (int i = 0; i < 200; i++)
			hear(&line, turns, turns, 0.2);
		clear(&line);
		clock_filter_lost(&line.filter);
		hear(&line, turns, 2 * turns, 0.2);
		/* It was only noise: nothing was lost. */
		clock_filter_lost(&line.filter);
		hear(&line, turns, turns, 0.2);
		for (int i = 0; i < 200; i++)
			hear(&line, turns, turns, 0.2);
		assert_true(line.worst_ms < 1);
	}
}

static void a_late_start_is_mended_by_the_first_quicker_telegram(void **state)
{
	struct line line = start(0);
	(void)state;
	assert_true(fabs(hear(&line, 2, 2, 12) - 12) < 1e-3); /* nothing is known yet */
	hear(&line, 2, 2, 0.1);
	for (int i = 0; i < 50; i++)
		assert_true(fabs(hear(&line, 2, 2, 3 * uniform(&line))) < 1);
}

static void a_gap_of_two_seconds_begins_anew(void **state)
{
	struct line line = start(0);
	(void)state;
	for (int i = 0; i < 100; i++)
		hear(&line, 1, 1, 0.2);
	line.true_ns += 2.1e9 + 5.1e6; /* switched off and on: another phase */
	assert_true(fabs(hear(&line, 1, 1, 0.2) - 0.2) < 1e-3);
	assert_true(fabs(hear(&line, 1, 1, 0.2) - 0.2) < 1e-3);
}

static void a_clock_that_was_set_back_begins_anew(void **state)
{
	struct clock_filter filter;
	(void)state;
	clock_filter_init(&filter, PERIOD_NS);
	clock_filter_stamp(&filter, 90000 * MS, 1);
	assert_int_equal(clock_filter_stamp(&filter, 50000 * MS, 1), 50000 * MS);
}

/* Whatever arrives: order and the arrival are kept. */
static void any_arrivals_keep_their_order(void **state)
{
	struct line line = start(0);
	(void)state;
	for (int i = 0; i < 200000; i++) {
		double r = uniform(&line);
		line.arrival_ns += r < 0.3 ? 0 : (int64_t)(uniform(&line) * (r < 0.9 ? 2e7 : 4e8));
		int64_t stamp = clock_filter_stamp(&line.filter, line.arrival_ns, 1 << (int)(3 * uniform(&line)));
		assert_true(line.stamp_ns == 0 || stamp > line.stamp_ns);
		assert_true(stamp <= line.arrival_ns || stamp == line.stamp_ns + 1);
		line.stamp_ns = stamp;
	}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_steady_stream_is_stamped_within_a_millisecond),
	    cmocka_unit_test(delays_of_tens_of_ms_leave_the_least_of_them),
	    cmocka_unit_test(a_backlog_read_at_once_gets_the_times_of_its_turns),
	    cmocka_unit_test(a_stream_with_gaps_stays_within_a_millisecond),
	    cmocka_unit_test(a_slow_line_that_skips_scans_stays_within_a_millisecond),
	    cmocka_unit_test(a_lost_telegram_costs_one_stamp),
	    cmocka_unit_test(a_telegram_that_was_seen_to_be_lost_costs_none),
	    cmocka_unit_test(a_late_start_is_mended_by_the_first_quicker_telegram),
	    cmocka_unit_test(a_gap_of_two_seconds_begins_anew),
	    cmocka_unit_test(a_clock_that_was_set_back_begins_anew),
	    cmocka_unit_test(any_arrivals_keep_their_order),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

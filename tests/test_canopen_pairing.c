/* Law: an angle has the time of its own SYNC or is not used; answers that never come cost no others, late ones few. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include <cmocka.h>

#include "drivers/canopen_pairing.h"

/* What happens on the bus: S a SYNC, every 10 ms, a digit the answer to the SYNC of that number (counted from 1, modulo 10),
 * 0.5 ms after the SYNC before it, and a space lets 4 ms pass. */
struct run {
	struct canopen_pairing p;
	int syncs;
	int used, wrong, unused;
};

static void play(struct run *r, uint8_t every, const char *what)
{
	int64_t delay_ns = 500000;

	for (; *what; what++) {
		if (*what == ' ') {
			delay_ns += 4000000;
		} else if (*what == 'S') {
			delay_ns = 500000;
			canopen_pairing_sync(&r->p);
			r->syncs++;
		} else if (canopen_pairing_take(&r->p, every, delay_ns, 10000000)) {
			r->used++;
			r->wrong += *what - '0' != r->syncs % 10;
		} else {
			r->unused++;
		}
	}
}

static void prompt_answers_are_all_used(void **state)
{
	struct run r = {0};

	(void)state;
	play(&r, 1, "S1S2S3S4S5S6S7S8S9S0S1");
	assert_int_equal(r.used, 11);
	assert_int_equal(r.wrong + r.unused, 0);
	r = (struct run){0};
	play(&r, 3, "SSS3SSS6SSS9");
	assert_int_equal(r.used, 3);
	assert_int_equal(r.unused, 0);
	/* The node counts from another SYNC on than we do. */
	r = (struct run){0};
	play(&r, 3, "S1SSS4SSS7");
	assert_int_equal(r.used, 3);
}

static void a_late_answer_is_not_taken_for_the_next_one(void **state)
{
	struct run r = {0};

	(void)state;
	play(&r, 1, "S1S2SSS 345S6S7");
	assert_int_equal(r.wrong, 0);
	assert_int_equal(r.unused, 2);
	assert_int_equal(r.used, 5); /* the last of those three is the newest SYNC's */
	r = (struct run){0};
	play(&r, 1, "S1S2SS 3S 4S 56S7S8");
	assert_int_equal(r.wrong, 0);
	assert_int_equal(r.unused, 3);
}

static void a_lost_answer_costs_nothing_more(void **state)
{
	struct run r = {0};

	(void)state;
	play(&r, 1, "S1S2SS4S5SSS8S9S0");
	assert_int_equal(r.wrong + r.unused, 0);
	assert_int_equal(r.used, 7);
}

static void a_node_that_became_slower_when_one_was_lost_costs_a_few(void **state)
{
	struct run r = {0};

	(void)state;
	play(&r, 1, "S1S2SS 4S 5S 6S 7S 8S 9S 0");
	assert_int_equal(r.wrong, 0);
	assert_int_equal(r.unused, CANOPEN_PAIRING_STEADY);
	assert_int_equal(r.used, 9 - CANOPEN_PAIRING_STEADY);
}

static void a_node_that_comes_back_is_believed_at_once(void **state)
{
	struct run r = {0};

	(void)state;
	play(&r, 1, "S1");
	for (int i = 0; i < 399; i++)
		play(&r, 1, "S");
	play(&r, 1, "S1S2S3S4S5S6S7S8");
	assert_int_equal(r.wrong + r.unused, 0);
}

/* A SYNC that we did not see: its answer comes when none is awaited, and is not refused. */
static void an_answer_without_a_sync_is_not_refused(void **state)
{
	struct canopen_pairing p = {0};

	(void)state;
	canopen_pairing_sync(&p);
	assert_true(canopen_pairing_take(&p, 1, 500, 1000));
	assert_true(canopen_pairing_take(&p, 1, 1500, 1000));
	canopen_pairing_sync(&p);
	assert_false(canopen_pairing_take(&p, 1, 1500, 1000)); /* this SYNC's, or one's that was lost after it */
}

static void a_snapshot_goes_on_alike(void **state)
{
	struct run r = {0}, again = {0};
	uint8_t bytes[80];
	struct state s;

	(void)state;
	play(&r, 1, "S1S2SS 3S");
	state_save(&s, bytes, sizeof bytes);
	canopen_pairing_state(&s, &r.p);
	state_load(&s, bytes, s.at);
	canopen_pairing_state(&s, &again.p);
	assert_true(state_done(&s));
	assert_memory_equal(&r.p, &again.p, sizeof r.p);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(prompt_answers_are_all_used),
	    cmocka_unit_test(a_late_answer_is_not_taken_for_the_next_one),
	    cmocka_unit_test(a_lost_answer_costs_nothing_more),
	    cmocka_unit_test(a_node_that_became_slower_when_one_was_lost_costs_a_few),
	    cmocka_unit_test(a_node_that_comes_back_is_believed_at_once),
	    cmocka_unit_test(an_answer_without_a_sync_is_not_refused),
	    cmocka_unit_test(a_snapshot_goes_on_alike),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

/* Law L8: a node ends up as it is wanted and nothing is written that it holds already; or one sentence says why not. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <stdio.h>
#include <string.h>

#include "drivers/canopen_setup.h"
#include "tests/canopen_node.h"

#define ID     2
#define MASTER 127

/* Until it has ended. */
static void run(struct canopen_setup *s, struct node *node)
{
	struct can_frame_at f, answer;
	int64_t t_ns = 0;

	canopen_setup_begin(s);
	for (int i = 0; i < 10000 && s->state == CANOPEN_SETUP_BUSY; i++) {
		if (!canopen_setup_step(s, t_ns, &f)) {
			assert_true(canopen_setup_deadline(s) > t_ns);
			t_ns = canopen_setup_deadline(s);
		} else if (node_answer(node, &f, &answer)) {
			canopen_setup_answer(s, answer.data, answer.len);
		}
	}
	assert_int_not_equal(s->state, CANOPEN_SETUP_BUSY);
	while (canopen_setup_step(s, t_ns, &f))
		node_answer(node, &f, &answer);
}

static void run_well(struct canopen_setup *s, struct node *node)
{
	run(s, node);
	if (s->state != CANOPEN_SETUP_DONE)
		fail_msg("%s", s->error);
}

/* TPDO1: statusword, position; at every SYNC. */
static struct canopen_pdo wanted_pdo(void)
{
	return (struct canopen_pdo){.index = 0x1800,
	                            .cob = 0x180 + ID,
	                            .type = 1,
	                            .inhibit = 0,
	                            .timer = 0,
	                            .n = 2,
	                            .entry = {CANOPEN_MAP(0x6041, 0, 16), CANOPEN_MAP(0x6064, 0, 32)}};
}

static void wish(struct canopen_setup *s)
{
	const struct canopen_pdo pdo = wanted_pdo();

	canopen_setup_init(s, ID);
	canopen_setup_identify(s);
	canopen_setup_heartbeat(s, 200, MASTER, 600);
	canopen_setup_object(s, &(struct canopen_object){.index = 0x6007, .size = 2, .how = CANOPEN_KEEP, .value = 3});
	canopen_setup_pdo(s, &pdo);
}

static void a_node_is_set_as_wanted(void **state)
{
	struct canopen_setup s;
	struct node node;
	uint32_t v;

	(void)state;
	node_drive(&node, ID);
	wish(&s);
	run_well(&s, &node);
	assert_int_equal(node_value(&node, 0x1017, 0), 200);
	assert_int_equal(node_value(&node, 0x1016, 1), MASTER << 16 | 600);
	assert_int_equal(node_value(&node, 0x6007, 0), 3);
	assert_int_equal(node_value(&node, 0x1800, 1), 0x180 + ID);
	assert_int_equal(node_value(&node, 0x1800, 2), 1);
	assert_int_equal(node_value(&node, 0x1a00, 0), 2);
	assert_int_equal(node_value(&node, 0x1a00, 1), 0x60410010);
	assert_int_equal(node_value(&node, 0x1a00, 2), 0x60640020);
	assert_int_equal(s.written, node.writes);
	assert_true(canopen_setup_value(&s, 0x1000, 0, &v) && v == 0x00020192);
	assert_true(canopen_setup_value(&s, 0x1018, 1, &v) && v == 0x300);
	assert_true(canopen_setup_value(&s, 0x6007, 0, &v) && v == 3);
	assert_true(canopen_setup_value(&s, 0x1016, 0, &v) && v == (MASTER << 16 | 600));
	assert_false(canopen_setup_value(&s, 0x6041, 0, &v));
}

static void a_second_time_nothing_is_written(void **state)
{
	struct canopen_setup s;
	struct node node;

	(void)state;
	for (int how = 0; how < 16; how++) {
		node_drive(&node, ID);
		node.echo = how & 1;
		node.brief = how & 2;
		node.unsized = how & 4;
		node.keep_rtr = how & 8;
		if (node.keep_rtr)
			node_find(&node, 0x1800, 1)->value |= CANOPEN_COB_NO_RTR;
		wish(&s);
		run_well(&s, &node);
		assert_true(node.writes > 0);
		node.writes = 0;
		run_well(&s, &node);
		assert_int_equal(node.writes, 0);
		assert_int_equal(s.written, 0);
		wish(&s); /* by another run of the program */
		run_well(&s, &node);
		assert_int_equal(node.writes, 0);
	}
}

/* Whatever one part of a PDO is, the whole is set right, in the standard's order (the node refuses any other), and what
 * is not about the part is left alone. */
static void each_part_of_a_pdo_that_differs_is_set_right(void **state)
{
	static const struct {
		uint16_t index;
		uint8_t sub;
		uint32_t value;
		int writes;
	} of[] = {
	    {0x1800, 1, 0x80000182, 1},                                                /* it is off: on */
	    {0x1800, 1, 0x00000399, 2},                                                /* another id: off, on */
	    {0x1800, 1, 0xC0000182, 1},                                                /* its bit 30 is kept */
	    {0x1800, 2, 254, 3},                                                       /* off, type, on */
	    {0x1800, 3, 100, 3},        {0x1800, 5, 10, 3},         {0x1a00, 0, 1, 6}, /* off, 0, two entries, 2, on */
	    {0x1a00, 0, 3, 6},          {0x1a00, 0, 0, 6},          {0x1a00, 0, 254, 6}, {0x1a00, 1, 0x60410020, 6},
	    {0x1a00, 2, 0x606c0020, 6}, {0x1a00, 3, 0x606c0020, 0}, /* beyond the count: not part of it */
	};

	(void)state;
	for (size_t i = 0; i < sizeof of / sizeof of[0]; i++) {
		struct canopen_setup s;
		struct node node;

		node_drive(&node, ID);
		wish(&s);
		run_well(&s, &node);
		node.writes = 0;
		node_find(&node, of[i].index, of[i].sub)->value = of[i].value;
		run_well(&s, &node);
		if (node.writes != of[i].writes)
			fail_msg("%04X:%02X = %X took %d writes", of[i].index, of[i].sub, of[i].value, node.writes);
		assert_int_equal(node_value(&node, 0x1800, 1) & ~CANOPEN_COB_NO_RTR, 0x180 + ID);
		assert_int_equal(node_value(&node, 0x1800, 1) & CANOPEN_COB_NO_RTR,
		                 of[i].index == 0x1800 && of[i].sub == 1 ? of[i].value & CANOPEN_COB_NO_RTR : 0);
		assert_int_equal(node_value(&node, 0x1800, 2), 1);
		assert_int_equal(node_value(&node, 0x1800, 3), 0);
		assert_int_equal(node_value(&node, 0x1800, 5), 0);
		assert_int_equal(node_value(&node, 0x1a00, 0), 2);
		assert_int_equal(node_value(&node, 0x1a00, 1), 0x60410010);
		assert_int_equal(node_value(&node, 0x1a00, 2), 0x60640020);
	}
}

static void a_pdo_that_is_not_wanted_is_switched_off(void **state)
{
	const struct canopen_pdo off[] = {{.index = 0x1801, .off = true}, {.index = 0x1807, .off = true}};
	struct canopen_setup s;
	struct node node;

	(void)state;
	node_drive(&node, ID);
	canopen_setup_init(&s, ID);
	canopen_setup_pdo(&s, &off[0]);
	canopen_setup_pdo(&s, &off[1]); /* the node has none of this number */
	run_well(&s, &node);
	assert_int_equal(node.writes, 1);
	assert_int_equal(node_value(&node, 0x1801, 1), 0x80000282);
	run_well(&s, &node);
	assert_int_equal(node.writes, 1);
}

static void what_is_left_open_stays_as_it_is(void **state)
{
	const struct canopen_pdo pdo = {.index = 0x1800, .type = 1, .inhibit = -1, .timer = -1, .n = -1};
	struct canopen_setup s;
	struct node node;

	(void)state;
	node_drive(&node, ID);
	node_find(&node, 0x1800, 1)->value = 0x2a5;
	node_find(&node, 0x1800, 5)->value = 7;
	canopen_setup_init(&s, ID);
	canopen_setup_pdo(&s, &pdo);
	run_well(&s, &node);
	assert_int_equal(node_value(&node, 0x1800, 1), 0x2a5);
	assert_int_equal(node_value(&node, 0x1800, 2), 1);
	assert_int_equal(node_value(&node, 0x1800, 5), 7);
	assert_int_equal(node_value(&node, 0x1a00, 0), 1);
	assert_int_equal(node.writes, 3);
}

static void a_node_without_timers_is_taken_as_it_is(void **state)
{
	struct canopen_setup s;
	struct node node;

	(void)state;
	node_drive(&node, ID);
	node_find(&node, 0x1800, 3)->index = 0x5000;
	node_find(&node, 0x1800, 5)->index = 0x5001;
	wish(&s);
	run_well(&s, &node);
	assert_int_equal(node_value(&node, 0x1a00, 2), 0x60640020);
}

static void an_entry_of_another_master_is_left_alone(void **state)
{
	struct canopen_setup s;
	struct node node;

	(void)state;
	node_drive(&node, ID);
	node_find(&node, 0x1016, 1)->value = 100 << 16 | 500;
	wish(&s);
	run_well(&s, &node);
	assert_int_equal(node_value(&node, 0x1016, 1), 100 << 16 | 500);
	assert_int_equal(node_value(&node, 0x1016, 2), MASTER << 16 | 600);

	/* Ours, with another time, wherever it is. */
	node_find(&node, 0x1016, 1)->value = 0;
	node_find(&node, 0x1016, 2)->value = MASTER << 16 | 100;
	node.writes = 0;
	run_well(&s, &node);
	assert_int_equal(node_value(&node, 0x1016, 1), 0);
	assert_int_equal(node_value(&node, 0x1016, 2), MASTER << 16 | 600);
	assert_int_equal(node.writes, 1);

	node_find(&node, 0x1016, 1)->value = 100 << 16 | 500;
	node_find(&node, 0x1016, 2)->value = 101 << 16 | 500;
	run(&s, &node);
	assert_int_equal(s.state, CANOPEN_SETUP_FAILED);
	assert_non_null(strstr(s.error, "node 2 already watches"));
	assert_non_null(strstr(s.error, "1016"));
}

static void what_is_optional_is_passed_over(void **state)
{
	struct canopen_setup s;
	struct node node;

	(void)state;
	node_drive(&node, ID);
	node_find(&node, 0x605a, 0)->read_only = true;
	canopen_setup_init(&s, ID);
	canopen_setup_object(
	    &s, &(struct canopen_object){.index = 0x60c2, .sub = 1, .size = 1, .how = CANOPEN_KEEP, .optional = true});
	canopen_setup_object(&s, &(struct canopen_object){
	                             .index = 0x605a, .size = 2, .how = CANOPEN_KEEP, .optional = true, .value = 6});
	canopen_setup_object(&s, &(struct canopen_object){.index = 0x6007, .size = 2, .how = CANOPEN_KEEP, .value = 3});
	canopen_setup_pdo(&s, &(struct canopen_pdo){.index = 0x1808, .type = 1, .optional = true});
	run_well(&s, &node);
	assert_int_equal(s.object[0].abort, 0x06020000);
	assert_int_equal(s.object[1].abort, 0x06010002);
	assert_int_equal(s.object[2].abort, 0);
	assert_int_equal(node_value(&node, 0x6007, 0), 3);
}

/* It need not be read, or cannot. */
static void what_cannot_be_read_is_written(void **state)
{
	struct canopen_setup s;
	struct node node;

	(void)state;
	node_drive(&node, ID);
	node_find(&node, 0x6007, 0)->write_only = true;
	canopen_setup_init(&s, ID);
	canopen_setup_object(&s, &(struct canopen_object){.index = 0x6007, .size = 2, .how = CANOPEN_KEEP, .value = 3});
	canopen_setup_object(&s,
	                     &(struct canopen_object){.index = 0x605a, .size = 2, .how = CANOPEN_WRITE, .value = 2});
	run_well(&s, &node);
	assert_int_equal(node.writes, 2); /* the second though it was 2 already */
	assert_int_equal(node_value(&node, 0x6007, 0), 3);
}

static void a_refusal_is_one_sentence(void **state)
{
	struct canopen_setup s;
	struct node node;

	(void)state;
	node_drive(&node, ID);
	node_find(&node, 0x1a00, 2)->refuse = 0x06040041;
	wish(&s);
	run(&s, &node);
	assert_int_equal(s.state, CANOPEN_SETUP_FAILED);
	assert_int_equal(s.abort, 0x06040041);
	assert_string_equal(s.error,
	                    "object 1A00:02 of node 2 cannot be set to 0x60640020: object cannot be mapped to a "
	                    "PDO (06040041)");

	node_drive(&node, ID);
	node_find(&node, 0x6007, 0)->index = 0x5000;
	wish(&s);
	run(&s, &node);
	assert_int_equal(s.state, CANOPEN_SETUP_FAILED);
	assert_string_equal(s.error, "object 6007:00 of node 2 cannot be read: object does not exist (06020000)");

	node.silent = true;
	run(&s, &node);
	assert_int_equal(s.state, CANOPEN_SETUP_FAILED);
	assert_string_equal(s.error,
	                    "node 2 does not answer (object 1000:00); is it on, and its id and bit rate right?");
}

/* No answer in the midst of it: the same sentence, not a passed-over object. */
static void a_node_that_falls_silent_lacks_no_object(void **state)
{
	(void)state;
	for (int after = 0; after < 40; after++) {
		struct canopen_setup s;
		struct can_frame_at f, answer;
		struct node node;
		int64_t t_ns = 0;
		int answers = 0;

		node_drive(&node, ID);
		wish(&s);
		canopen_setup_begin(&s);
		for (int i = 0; i < 10000 && s.state == CANOPEN_SETUP_BUSY; i++) {
			if (!canopen_setup_step(&s, t_ns, &f))
				t_ns = s.state == CANOPEN_SETUP_BUSY ? canopen_setup_deadline(&s) : t_ns;
			else if (answers < after && node_answer(&node, &f, &answer) && ++answers)
				canopen_setup_answer(&s, answer.data, answer.len);
		}
		if (s.state == CANOPEN_SETUP_DONE) {
			assert_true(after > 10); /* it needed no more */
			return;
		}
		assert_int_equal(s.state, CANOPEN_SETUP_FAILED);
		assert_non_null(strstr(s.error, "node 2 does not answer"));
		assert_true(t_ns <= CANOPEN_SDO_TRIES * CANOPEN_SDO_TIMEOUT_NS);
	}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_node_is_set_as_wanted),
	    cmocka_unit_test(a_second_time_nothing_is_written),
	    cmocka_unit_test(each_part_of_a_pdo_that_differs_is_set_right),
	    cmocka_unit_test(a_pdo_that_is_not_wanted_is_switched_off),
	    cmocka_unit_test(what_is_left_open_stays_as_it_is),
	    cmocka_unit_test(a_node_without_timers_is_taken_as_it_is),
	    cmocka_unit_test(an_entry_of_another_master_is_left_alone),
	    cmocka_unit_test(what_is_optional_is_passed_over),
	    cmocka_unit_test(what_cannot_be_read_is_written),
	    cmocka_unit_test(a_refusal_is_one_sentence),
	    cmocka_unit_test(a_node_that_falls_silent_lacks_no_object),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

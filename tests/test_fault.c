/* Law: a fault is ordered by a sentence, or refused by one that says what there is; and it begins and ends at its times. */
#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include <cmocka.h>

#include "tools/fault.h"

#define S 1000000000ll

static struct sim_fault parsed(const char *text)
{
	struct sim_fault fault;
	char error[FAULT_ERROR_MAX] = "";
	if (fault_parse(text, &fault, error) < 0)
		fail_msg("%s", error);
	return fault;
}

static void check(const char *text, const char *kind, double value, int64_t at_ns, int64_t for_ns)
{
	const struct sim_fault fault = parsed(text);
	assert_string_equal(fault.device, "laser");
	assert_string_equal(fault.kind, kind);
	assert_true(fault.value == value);
	assert_int_equal(fault.at_ns, at_ns);
	assert_int_equal(fault.for_ns, for_ns);
}

static void sentences_say_what_when_and_how_long(void **state)
{
	(void)state;
	check("laser: garbage at 3s for 2s", "garbage", 0, 3 * S, 2 * S);
	check("laser: garbage for 2s at 3s", "garbage", 0, 3 * S, 2 * S);
	check("laser:nak", "nak", 0, 0, 0);
	check("laser: ack lost", "ack lost", 0, 0, 0);
	check("laser: sfa 3 at 500ms", "sfa", 3, S / 2, 0);
	check("laser: clock step -0.5", "clock step", -0.5, 0, 0);
	check("laser: lost 0.1 for ever", "lost", 0.1, 0, INT64_MAX);
}

static void what_needs_a_duration_has_one(void **state)
{
	(void)state;
	check("laser: unplug", "unplug", 0, 0, S);
	check("laser: drift 200", "drift", 200, 0, INT64_MAX);
	check("laser: unplug for 0s", "unplug", 0, 0, 0);
}

static void malformed_sentences_are_refused_by_one_that_says_the_form(void **state)
{
	static const char *const bad[] = {"",
	                                  "garbage",
	                                  ": garbage",
	                                  "laser:",
	                                  "laser: for 2s",
	                                  "laser: garbage for",
	                                  "laser: garbage at",
	                                  "laser: garbage for 2 s",
	                                  "laser: garbage at soon",
	                                  "laser: garbage at -1s",
	                                  "laser: garbage at ever",
	                                  "laser: a b c d e f g h i j k l m n o p q r s t",
	                                  "a-device-with-a-name-that-is-much-too-long: garbage"};
	char error[FAULT_ERROR_MAX];
	struct sim_fault fault;
	(void)state;
	for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
		error[0] = '\0';
		assert_int_equal(fault_parse(bad[i], &fault, error), -EINVAL);
		assert_non_null(strstr(error, "DEVICE: KIND [VALUE] [at TIME] [for TIME|ever]"));
	}
}

static void unknown_devices_and_kinds_are_named_with_what_there_is(void **state)
{
	static const char *const own[] = {"garbage", "nak", NULL}, *const line[] = {"unplug", NULL};
	const struct fault_target targets[] = {{"laser", {own, line}}, {"pose", {own, NULL}}};
	char error[FAULT_ERROR_MAX] = "";
	struct sim_fault fault = parsed("laser: unplug");
	(void)state;
	assert_int_equal(fault_check(&fault, targets, 2, error), 0);
	fault = parsed("pose: unplug");
	assert_int_equal(fault_check(&fault, targets, 2, error), -EINVAL);
	assert_string_equal(error, "'unplug': pose has no such fault; it has garbage, nak");
	fault = parsed("radar: unplug");
	assert_int_equal(fault_check(&fault, targets, 2, error), -EINVAL);
	assert_string_equal(error, "'radar': no such device; there is laser, pose");
}

static void a_value_out_of_bounds_is_refused_by_them(void **state)
{
	static const char *const own[] = {"sfa", "lost", "scale", "drift", NULL};
	static const char *const good[] = {"laser: sfa", "laser: sfa 26", "laser: lost 0.1", "laser: drift -200"};
	static const char *const bad[] = {"laser: sfa 27", "laser: sfa -1", "laser: lost 2", "laser: scale -1"};
	const struct fault_target target = {"laser", {own, NULL}};
	char error[FAULT_ERROR_MAX] = "";
	(void)state;
	for (size_t i = 0; i < sizeof good / sizeof good[0]; i++) {
		const struct sim_fault fault = parsed(good[i]);
		assert_int_equal(fault_check(&fault, &target, 1, error), 0);
	}
	for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
		const struct sim_fault fault = parsed(bad[i]);
		assert_int_equal(fault_check(&fault, &target, 1, error), -EINVAL);
	}
	assert_string_equal(error, "'scale -1': its value is 0.001 .. 1000");
}

static void check_next(struct fault_plan *plan, int64_t t_ns, const char *kind, bool on)
{
	struct sim_fault fault;
	bool is_on = !on;
	assert_int_equal(fault_plan_deadline(plan), t_ns);
	assert_false(fault_plan_next(plan, t_ns - 1, &fault, &is_on));
	assert_true(fault_plan_next(plan, t_ns, &fault, &is_on));
	assert_string_equal(fault.kind, kind);
	assert_int_equal(is_on, on);
}

static void faults_begin_and_end_in_the_order_of_their_times(void **state)
{
	static const char *const orders[] = {"laser: garbage at 3s for 2s", "laser: nak at 4s",
	                                     "laser: drift 200 at 1s", "laser: silence at 3s for 1s"};
	struct fault_plan plan = {0};
	(void)state;
	for (int i = 0; i < 4; i++) {
		const struct sim_fault fault = parsed(orders[i]);
		assert_int_equal(fault_plan_add(&plan, &fault, 100 * S), 0);
	}
	check_next(&plan, 101 * S, "drift", true);
	check_next(&plan, 103 * S, "garbage", true);
	check_next(&plan, 103 * S, "silence", true);
	check_next(&plan, 104 * S, "nak", true);
	check_next(&plan, 104 * S, "silence", false);
	check_next(&plan, 105 * S, "garbage", false);
	assert_int_equal(fault_plan_deadline(&plan), INT64_MAX);
}

static void a_full_plan_says_so(void **state)
{
	const struct sim_fault fault = parsed("laser: nak");
	struct fault_plan plan = {0};
	(void)state;
	for (int i = 0; i < FAULT_ORDERS_MAX; i++)
		assert_int_equal(fault_plan_add(&plan, &fault, 0), 0);
	assert_int_equal(fault_plan_add(&plan, &fault, 0), -ENOSPC);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(sentences_say_what_when_and_how_long),
	    cmocka_unit_test(what_needs_a_duration_has_one),
	    cmocka_unit_test(malformed_sentences_are_refused_by_one_that_says_the_form),
	    cmocka_unit_test(unknown_devices_and_kinds_are_named_with_what_there_is),
	    cmocka_unit_test(a_value_out_of_bounds_is_refused_by_them),
	    cmocka_unit_test(faults_begin_and_end_in_the_order_of_their_times),
	    cmocka_unit_test(a_full_plan_says_so),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

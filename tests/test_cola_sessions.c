/* Law: the dialogue and the simulated scanners, written apart from one sheet of facts, understand each other: every model streams
 * in either dialect as it was configured to, and a refusal is told. In virtual time, through supervisor and decoder. */
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include <cmocka.h>

#include "tests/rig.h"

struct plan {
	enum sim_cola_model_id model;
	int dialect; /* SIM_COLA_FACTORY, _A, _B */
	const char *keys;
	double hz; /* profiles a second */
};

static struct rig *turned; /* the one whose encoder turns */

static double turning(void *ctx, int64_t t_ns)
{
	(void)ctx;
	return rig_tilt(turned, t_ns);
}

static struct rig *make(const struct plan *plan)
{
	char yaml[1000];
	struct sim_cola_params params = {
	    .model = plan->model, .segments = true, .ticks_per_rad = 20000, .angle = turning};
	struct sim_device brain;
	struct scene scene;
	const bool usb = strcmp(sim_cola_model_driver(plan->model), "tim") == 0;
	params.dialect = plan->dialect;
	snprintf(yaml, sizeof yaml,
	         "devices:\n"
	         "  - {name: laser, driver: %s, connect: %s%s%s}\n"
	         "  - {name: pose, driver: pose, listen: \"unix:/run/pose.sock\"}\n"
	         "  - {name: servo, driver: modbus, connect: /dev/servo, position: {address: 0, scale: 0.01deg},\n"
	         "     target: {address: 1, scale: 0.01deg}}\n"
	         "mount: {base_tilt: {xyz: [0.2, 0, 0.4]}, tilt_laser: {xyz: [0, 0, 0.05]}}\n"
	         "sweep: {device: servo, from: -40deg, to: 40deg, speed: 37.5deg}\n",
	         sim_cola_model_driver(plan->model), usb ? "usb" : "10.0.0.1", plan->keys ? ", " : "",
	         plan->keys ? plan->keys : "");
	struct rig *rig = rig_create(&(struct rig_params){.yaml = yaml, .seed = 3, .thin = 40, .stand = true});
	turned = rig;
	rig_scene(rig, "laser", &scene);
	assert_int_equal(sim_cola_create(&params, &scene, rig_epoch_ns(rig), &brain), 0);
	rig_attach(rig, "laser", usb ? RIG_USB : RIG_TCP, &brain);
	return rig;
}

static void print_log(const struct rig *rig)
{
	for (size_t i = 0; i < rig_logged(rig); i++)
		print_error("  %8.3f s %s\n", (double)rig_log(rig, i)->t_ns * 1e-9, rig_log(rig, i)->text);
}

/* How long it took until data came. */
static int64_t assert_data(struct rig *rig, int64_t limit_ns)
{
	const int64_t took_ns = rig_wait_data(rig, "laser", limit_ns);
	if (took_ns < 0) {
		print_log(rig);
		fail_msg("no data within %.1f s", (double)limit_ns * 1e-9);
	}
	return took_ns;
}

static void assert_rate(struct rig *rig, double hz)
{
	struct rig_view before, after;
	rig_view(rig, "laser", &before);
	rig_run(rig, 4 * RIG_SECOND);
	rig_view(rig, "laser", &after);
	const double got = (double)(after.sent.sent - before.sent.sent) / 4;
	const double decoded = (double)(after.line.decoded - before.line.decoded) / 4; /* what `rate` shows */
	assert_true(after.profiles - before.profiles + 1 >= after.sent.sent - before.sent.sent);
	if (fabs(got - hz) > 0.5 || fabs(decoded - hz) > 0.5 || after.state != SUPERVISOR_STREAMING ||
	    after.line.losses != before.line.losses) {
		print_log(rig);
		fail_msg("%.2f profiles a second (decoded %.2f) instead of %.2f, %d losses", got, decoded, hz,
		         (int)(after.line.losses - before.line.losses));
	}
}

static void assert_logged(struct rig *rig, const char *part)
{
	for (size_t i = 0; i < rig_logged(rig); i++)
		if (strstr(rig_log(rig, i)->text, part))
			return;
	print_log(rig);
	fail_msg("nobody said '%s'", part);
}

static void every_model_streams_as_it_is_set_in_either_dialect(void **state)
{
	static const struct {
		enum sim_cola_model_id model;
		double hz;
	} model[] = {{SIM_TIM561, 15}, {SIM_TIM571, 15}, {SIM_TIM781S, 15}, {SIM_LMS111, 50}, {SIM_LMS511, 25}};
	(void)state;
	for (size_t i = 0; i < sizeof model / sizeof model[0]; i++)
		for (int dialect = SIM_COLA_FACTORY; dialect <= SIM_COLA_B; dialect++) {
			const struct plan plan = {.model = model[i].model, .dialect = dialect};
			struct rig *rig = make(&plan);
			rig_start(rig);
			assert_true(assert_data(rig, 5 * RIG_SECOND) < RIG_SECOND);
			assert_rate(rig, model[i].hz);
			rig_stop(rig);
			rig_destroy(rig);
		}
}

static void what_is_configured_is_what_is_sent(void **state)
{
	static const struct plan plans[] = {
	    {SIM_LMS111, SIM_COLA_A, "frequency: 25Hz, resolution: 0.25deg", 25},
	    {SIM_LMS111, SIM_COLA_B, "frequency: 25Hz, resolution: 0.25deg, angles: [-90deg, 90deg], every: 5", 5},
	    {SIM_LMS111, SIM_COLA_B, "remission: 16, every: 2", 25},
	    {SIM_LMS111, SIM_COLA_A, "remission: 8, encoder: {scale: 0.02deg}, tilt: laser", 50},
	    {SIM_LMS511, SIM_COLA_A, "frequency: 50Hz, resolution: 0.5deg, remission: 8", 50},
	    {SIM_LMS511, SIM_COLA_B, "frequency: 100Hz, resolution: 0.6667deg, angles: [-90deg, 90deg]", 100},
	    {SIM_LMS511, SIM_COLA_B, "encoder: {scale: 0.02deg}, tilt: laser, every: 50", 0.5},
	    {SIM_TIM561, SIM_COLA_A, "angles: [-45deg, 45deg], remission: 16", 15},
	    {SIM_TIM571, SIM_COLA_B, "every: 3, remission: 8, protocol: b", 5},
	    {SIM_TIM781S, SIM_COLA_B, "every: 3", 5},
	};
	(void)state;
	for (size_t i = 0; i < sizeof plans / sizeof plans[0]; i++) {
		struct rig *rig = make(&plans[i]);
		rig_start(rig);
		assert_data(rig, 8 * RIG_SECOND);
		assert_rate(rig, plans[i].hz);
		rig_fault(rig, "laser", "reset", 0, true); /* set already: faster now, and the same */
		assert_data(rig, 4 * RIG_SECOND);
		assert_rate(rig, plans[i].hz);
		rig_destroy(rig);
	}
}

/* The scanner tilts at 37.5 degrees a second, and nothing but its own encoder says where it is. */
static void an_encoder_in_the_telegrams_tilts(void **state)
{
	static const struct plan plans[] = {
	    {.model = SIM_LMS111, .keys = "encoder: {scale: 0.05mrad}, tilt: laser"},
	    {.model = SIM_LMS511,
	     .keys = "encoder: {scale: 0.05mrad}, tilt: laser, frequency: 50Hz, resolution: 0.5deg"},
	};
	(void)state;
	for (size_t i = 0; i < sizeof plans / sizeof plans[0]; i++) {
		struct rig *rig = make(&plans[i]);
		struct rig_points points;
		rig_start(rig);
		assert_data(rig, 5 * RIG_SECOND);
		rig_run(rig, 5 * RIG_SECOND); /* the clock has settled */
		rig_points_clear(rig, "laser");
		rig_run(rig, 10 * RIG_SECOND);
		rig_points(rig, "laser", &points);
		print_message("note: %llu rows, %llu points, %llu near, worst %.3f m\n",
		              (unsigned long long)points.rows, (unsigned long long)points.points,
		              (unsigned long long)points.near, points.worst_m);
		assert_true(points.rows > 450);
		assert_true(points.near * 1000 >= points.points * 995);
		rig_destroy(rig);
	}
}

static void what_a_scanner_cannot_do_is_told_with_its_reason(void **state)
{
	static const struct {
		struct plan plan;
		const char *sentence;
	} refused[] = {
	    {{SIM_LMS111, SIM_COLA_A, "frequency: 35Hz", 0}, "refuses mLMPsetscancfg: it knows no such frequency"},
	    {{SIM_LMS111, SIM_COLA_B, "frequency: 25Hz, resolution: 0.5deg", 0}, "it knows no such resolution"},
	    {{SIM_LMS511, SIM_COLA_B, "angles: [-120deg, 120deg]", 0},
	     "refuses LMPoutputRange: a value is out of its limits; change `angles`"},
	    {{SIM_TIM561, SIM_COLA_A, "frequency: 25Hz", 0}, "remove both from the configuration"},
	    {{SIM_TIM310, SIM_COLA_A, NULL, 0},
	     "this is a TiM310-1030000 with firmware V2.50-16.02.15, which sends no ranges"},
	    {{SIM_TIM571, SIM_COLA_B, "protocol: a", 0}, "no scanner answers in CoLa-A: set `protocol: auto`"},
	};
	(void)state;
	for (size_t i = 0; i < sizeof refused / sizeof refused[0]; i++) {
		struct rig *rig = make(&refused[i].plan);
		struct rig_view view;
		rig_start(rig);
		assert_int_equal(rig_wait_data(rig, "laser", 30 * RIG_SECOND), -1);
		assert_logged(rig, refused[i].sentence);
		rig_view(rig, "laser", &view);
		assert_true(view.line.opens <= 20);
		assert_int_equal(rig_log_count(rig, "laser", 0, "not ready"), 1); /* told once */
		rig_destroy(rig);
	}
}

static void states_a_scanner_may_be_found_in_are_left_behind(void **state)
{
	static const struct {
		enum sim_cola_model_id model;
		const char *kind;
		int64_t most_ns;
	} found[] = {
	    {SIM_LMS111, "idle", 5 * RIG_SECOND},      {SIM_LMS511, "idle", 10 * RIG_SECOND},
	    {SIM_TIM561, "streaming", 2 * RIG_SECOND}, {SIM_LMS111, "streaming", 2 * RIG_SECOND},
	    {SIM_TIM561, "error", 2 * RIG_SECOND},     {SIM_LMS511, "busy", 2 * RIG_SECOND},
	    {SIM_TIM571, "monitored", 2 * RIG_SECOND},
	};
	(void)state;
	for (size_t i = 0; i < sizeof found / sizeof found[0]; i++) {
		const struct plan plan = {.model = found[i].model};
		struct rig *rig = make(&plan);
		assert_true(rig_fault(rig, "laser", found[i].kind, 0, true));
		rig_start(rig);
		assert_data(rig, found[i].most_ns);
		rig_destroy(rig);
	}
}

static void a_scanner_that_gets_ready_late_is_waited_for(void **state)
{
	static const struct plan plan = {.model = SIM_LMS111};
	(void)state;
	struct rig *rig = make(&plan);
	rig_fault(rig, "laser", "busy", 0, true); /* STlms 5 */
	rig_start(rig);
	rig_run(rig, 30 * RIG_SECOND);
	struct rig_view view;
	rig_view(rig, "laser", &view);
	assert_int_equal(view.state, SUPERVISOR_CONFIGURING);
	assert_int_equal(view.line.opens, 1);
	rig_fault(rig, "laser", "busy", 0, false);
	assert_true(assert_data(rig, 2 * RIG_SECOND) < RIG_SECOND);
	rig_destroy(rig);
}

/* Each trouble for two seconds while it is set up, then away: it streams soon after. */
static void trouble_while_it_is_set_up_passes(void **state)
{
	(void)state;
	for (int code = -1; code <= 0x1a; code++) {
		if (code == 0)
			continue;
		const struct plan plan = {.model = SIM_LMS111, .keys = "every: 2"};
		struct rig *rig = make(&plan);
		rig_fault(rig, "laser", code < 0 ? "no answer" : "sfa", code < 0 ? 0 : code, true);
		rig_start(rig);
		rig_run(rig, 2 * RIG_SECOND);
		rig_fault(rig, "laser", code < 0 ? "no answer" : "sfa", 0, false);
		assert_true(assert_data(rig, 10 * RIG_SECOND) < 4 * RIG_SECOND);
		assert_rate(rig, 25);
		rig_destroy(rig);
	}
}

static void a_stream_that_breaks_is_found_within_five_scans(void **state)
{
	static const struct {
		struct plan plan;
		const char *kind;
		int64_t most_ms;
	} broken[] = {
	    {{SIM_TIM561, SIM_COLA_A, NULL, 15}, "half-open", 360},
	    {{SIM_LMS111, SIM_COLA_B, NULL, 50}, "half-open", 280},
	    {{SIM_LMS511, SIM_COLA_B, "every: 5", 5}, "half-open", 1030},
	    {{SIM_TIM571, SIM_COLA_B, NULL, 15}, "silence", 360},
	    {{SIM_LMS111, SIM_COLA_A, NULL, 50}, "idle", 280},
	};
	(void)state;
	for (size_t i = 0; i < sizeof broken / sizeof broken[0]; i++) {
		struct rig *rig = make(&broken[i].plan);
		struct rig_view view;
		rig_start(rig);
		assert_data(rig, 5 * RIG_SECOND);
		rig_run(rig, 3 * RIG_SECOND);
		const int64_t begin_ns = rig_now(rig);
		const size_t lines = rig_logged(rig);
		assert_true(rig_fault(rig, "laser", broken[i].kind, 0, true));
		for (int ms = 0; ms < 5000; ms++) {
			rig_view(rig, "laser", &view);
			if (view.state != SUPERVISOR_STREAMING)
				break;
			rig_run(rig, RIG_MS);
		}
		if (rig_now(rig) - begin_ns > broken[i].most_ms * RIG_MS)
			fail_msg("%s was found after %lld ms", broken[i].kind,
			         (long long)((rig_now(rig) - begin_ns) / RIG_MS));
		assert_int_equal(rig_log_count(rig, "laser", lines, "lost: no scan for"), 1);
		rig_fault(rig, "laser", broken[i].kind, 0, false);
		assert_data(rig, 10 * RIG_SECOND);
		rig_destroy(rig);
	}
}

static void a_dialect_that_was_changed_by_somebody_else_is_found_again(void **state)
{
	static const struct plan plan = {.model = SIM_LMS511};
	(void)state;
	struct rig *rig = make(&plan);
	rig_start(rig);
	assert_data(rig, 5 * RIG_SECOND);
	for (int i = 0; i < 4; i++) {
		rig_fault(rig, "laser", "wrong dialect", 0, true);
		rig_run(rig, RIG_SECOND);
		rig_fault(rig, "laser", "reset", 0, true);
		assert_true(assert_data(rig, 10 * RIG_SECOND) < 3 * RIG_SECOND);
	}
	rig_destroy(rig);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(every_model_streams_as_it_is_set_in_either_dialect),
	    cmocka_unit_test(what_is_configured_is_what_is_sent),
	    cmocka_unit_test(an_encoder_in_the_telegrams_tilts),
	    cmocka_unit_test(what_a_scanner_cannot_do_is_told_with_its_reason),
	    cmocka_unit_test(states_a_scanner_may_be_found_in_are_left_behind),
	    cmocka_unit_test(a_scanner_that_gets_ready_late_is_waited_for),
	    cmocka_unit_test(trouble_while_it_is_set_up_passes),
	    cmocka_unit_test(a_stream_that_breaks_is_found_within_five_scans),
	    cmocka_unit_test(a_dialect_that_was_changed_by_somebody_else_is_found_again),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

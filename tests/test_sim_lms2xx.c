/* Law: through a real pseudo-terminal the driver reaches the stream from whatever state the scanner is in, and gets exactly
 * the ranges that were measured. No assertion depends on how fast the machine is; only patience has an end. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cmocka.h>

#include "core/trig.h"
#include "drivers/driver.h"
#include "drivers/lms2xx_wire.h"
#include "drivers/serial.h"
#include "tools/sim_device.h"

#define PATIENCE_NS 240000000000ll

struct rig {
	char dir[32], port[64];
	uv_loop_t loop;
	struct scene scene;
	struct sim_lms2xx_params params;
	struct sim_pty *sim;
	/* the scene */
	bool paced, may;
	int scans, taken;
	int64_t ready_since_ns, scan_begin_ns;
	/* the driver's side, as the supervisor treats it */
	struct config *config;
	struct decoder *decoder;
	struct dialogue *dialogue;
	struct link *link;
	int64_t deadline_ns;
	struct dialogue_step step;
	int profiles, parts_seen, lost;
	struct profile last;
	char error[160];
};

/* Range of a beam by its bearing: any function that tells beams apart and is a whole number of centimetres. */
static double true_range_m(double bearing_rad)
{
	const double cdeg = rint((bearing_rad / TRIG_DEG + 90) * 100);
	return 1 + rint(cdeg / 25) * 0.01;
}

static void scene_scan(void *ctx, struct profile *p)
{
	struct rig *rig = ctx;
	rig->scans++;
	rig->may = false;
	rig->scan_begin_ns = p->t_ns;
	for (int i = 0; i < p->n; i++) {
		p->state[i] = BEAM_OK;
		p->range_m[i] = (float)true_range_m(p->first_rad + i * p->step_rad);
	}
	p->state[7] = BEAM_NO_ECHO;
	p->state[8] = BEAM_DAZZLED;
	p->state[9] = BEAM_WEAK;
	p->state[10] = BEAM_BEYOND_MAX;
}

static bool scene_ready(void *ctx, int64_t t_ns)
{
	struct rig *rig = ctx;
	if (rig->may && rig->ready_since_ns == 0)
		rig->ready_since_ns = t_ns;
	return rig->may;
}

static void scene_taken(void *ctx, int64_t t_ns)
{
	struct rig *rig = ctx;
	(void)t_ns;
	rig->taken++;
}

static void on_profile(void *ctx, int device, const struct profile *p)
{
	struct rig *rig = ctx;
	assert_int_equal(device, 0);
	rig->profiles++;
	if (p->parts == 4)
		rig->parts_seen |= 1 << p->part;
	rig->last = *p;
	driver_lms2xx.dialogue_data(rig->dialogue, (int64_t)uv_hrtime());
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	struct rig *rig = ctx;
	(void)device;
	driver_lms2xx.dialogue_reply(rig->dialogue, reply);
}

static void decode(struct rig *rig, enum direction direction, const uint8_t *bytes, size_t len)
{
	const struct record_sink sink = {.ctx = rig, .profile = on_profile, .reply = on_reply};
	const int64_t t_ns = (int64_t)uv_hrtime();
	const struct record record = {.log_ns = t_ns, .t_ns = t_ns, .direction = direction, .bytes = bytes, .len = len};
	driver_lms2xx.decode(rig->decoder, &record, &sink);
}

static void close_link(struct rig *rig)
{
	if (rig->link != NULL)
		driver_lms2xx.link_close(rig->link);
	rig->link = NULL;
}

static bool open_link(struct rig *rig)
{
	rig->link = driver_lms2xx.link_open(&rig->config->device[0], rig->error);
	driver_lms2xx.dialogue_reset(rig->dialogue, (int64_t)uv_hrtime());
	rig->deadline_ns = 0;
	return rig->link != NULL;
}

static void talk(struct rig *rig)
{
	uint8_t bytes[4096];
	const ssize_t n = driver_lms2xx.link_read(rig->link, bytes, sizeof bytes, &(int64_t){0});
	if (n < 0) {
		rig->lost++;
		close_link(rig);
		return;
	}
	if (n > 0)
		decode(rig, FROM_DEVICE, bytes, (size_t)n);
	const int64_t now_ns = (int64_t)uv_hrtime();
	if (n == 0 && now_ns < rig->deadline_ns)
		return;
	driver_lms2xx.dialogue_step(rig->dialogue, now_ns, &rig->step);
	rig->deadline_ns = rig->step.deadline_ns;
	if (rig->step.write_len > 0) {
		assert_int_equal(driver_lms2xx.link_write(rig->link, rig->step.write, rig->step.write_len),
		                 rig->step.write_len);
		decode(rig, TO_DEVICE, rig->step.write, rig->step.write_len);
	}
	if (rig->step.baud != 0)
		assert_int_equal(driver_lms2xx.link_baud(rig->link, rig->step.baud, rig->error), 0);
	if (rig->step.flush)
		driver_lms2xx.link_flush(rig->link);
}

static void turn(struct rig *rig)
{
	uv_run(&rig->loop, UV_RUN_NOWAIT);
	if (rig->link != NULL)
		talk(rig);
	usleep(300);
}

#define UNTIL(rig, condition)                                                      \
	do {                                                                       \
		const int64_t end_ns = (int64_t)uv_hrtime() + PATIENCE_NS;         \
		while (!(condition) && (int64_t)uv_hrtime() < end_ns)              \
			turn(rig);                                                 \
		if (!(condition))                                                  \
			fail_msg("never: %s (%s)", #condition, (rig)->step.error); \
	} while (0)

static struct sim_pty *create_sim(struct rig *rig, char error[160])
{
	struct sim_device device;
	assert_int_equal(sim_lms2xx_create(&rig->params, &rig->scene, (int64_t)uv_hrtime(), &device), 0);
	return sim_pty_create(&rig->loop, rig->port, &device, error);
}

static void order(struct rig *rig, const char *kind, double value, int64_t for_ns)
{
	struct sim_fault fault = {.value = value, .for_ns = for_ns};
	snprintf(fault.kind, sizeof fault.kind, "%s", kind);
	assert_true(sim_pty_fault(rig->sim, &fault, true));
}

static void start_sim(struct rig *rig)
{
	char error[160] = "";
	rig->scene = (struct scene){.ctx = rig, .scan = scene_scan};
	if (rig->paced) {
		rig->scene.ready = scene_ready;
		rig->scene.taken = scene_taken;
	}
	rig->sim = create_sim(rig, error);
	if (rig->sim == NULL)
		fail_msg("%s", error);
}

static void stop_sim(struct rig *rig)
{
	sim_pty_destroy(rig->sim);
	rig->sim = NULL;
	uv_run(&rig->loop, UV_RUN_NOWAIT);
}

static int setup(void **state)
{
	struct rig *rig = calloc(1, sizeof *rig);
	*state = rig;
	strcpy(rig->dir, "/tmp/facet-sim-XXXXXX");
	if (mkdtemp(rig->dir) == NULL)
		return -1;
	snprintf(rig->port, sizeof rig->port, "%s/laser", rig->dir);
	uv_loop_init(&rig->loop);
	rig->params = (struct sim_lms2xx_params){.fast = true, .baud = 9600, .mode = 0x05, .millimetres = true};
	rig->config = calloc(1, sizeof *rig->config);
	struct config_device *device = &rig->config->device[0];
	*device = (struct config_device){.baud = 500000, .fov_deg = 180, .resolution_cdeg = 50, .mode = -1};
	snprintf(device->port, sizeof device->port, "%s", rig->port);
	rig->config->devices = 1;
	return 0;
}

static void begin(struct rig *rig)
{
	rig->decoder = driver_lms2xx.decoder_create(&rig->config->device[0], 0);
	rig->dialogue = driver_lms2xx.dialogue_create(rig->config, 0);
	if (rig->sim == NULL)
		start_sim(rig);
	if (!open_link(rig))
		fail_msg("%s", rig->error);
}

static int teardown(void **state)
{
	struct rig *rig = *state;
	close_link(rig);
	if (rig->sim != NULL)
		stop_sim(rig);
	driver_lms2xx.decoder_destroy(rig->decoder);
	driver_lms2xx.dialogue_destroy(rig->dialogue);
	struct stat st;
	const int link_left = lstat(rig->port, &st) == 0;
	rmdir(rig->dir);
	const int busy = uv_loop_close(&rig->loop);
	free(rig->config);
	free(rig);
	return link_left || busy ? -1 : 0;
}

static void check_profile(const struct rig *rig, int n, double unit_m)
{
	const struct profile *p = &rig->last;
	assert_int_equal(p->n, n);
	for (int i = 0; i < n; i++) {
		static const uint8_t odd[] = {BEAM_NO_ECHO, BEAM_DAZZLED, BEAM_WEAK, BEAM_BEYOND_MAX};
		assert_int_equal(p->state[i], i >= 7 && i <= 10 ? odd[i - 7] : BEAM_OK);
		if (p->state[i] == BEAM_OK)
			assert_float_equal(p->range_m[i], true_range_m(p->first_rad + i * p->step_rad), unit_m / 2);
	}
}

static void a_factory_fresh_scanner_is_found_set_up_and_streams(void **state)
{
	struct rig *rig = *state;
	rig->config->device[0].range_unit = UNIT_MM;
	rig->config->device[0].mode = 0x05;
	rig->params.mode = 0x00;
	rig->params.millimetres = false;
	begin(rig);
	UNTIL(rig, rig->profiles >= 5);
	assert_int_equal(rig->step.state, DIALOGUE_STREAMING);
	check_profile(rig, 361, 0.001);
	assert_int_equal(rig->last.interlace, 2);
}

static void at_the_pace_of_the_wire_it_streams_too(void **state)
{
	struct rig *rig = *state;
	rig->params.fast = false;
	rig->params.baud = 38400;
	rig->config->device[0].baud = 38400;
	begin(rig);
	UNTIL(rig, rig->profiles >= 3);
	check_profile(rig, 361, 0.001);
}

static void the_modes_of_the_device_are_respected(void **state)
{
	struct rig *rig = *state;
	rig->params.mode = 0x03;
	rig->params.millimetres = false;
	begin(rig);
	UNTIL(rig, rig->profiles >= 2);
	check_profile(rig, 361, 0.01);
}

static void variants_are_switched_to(void **state)
{
	struct rig *rig = *state;
	rig->config->device[0].fov_deg = 100;
	rig->config->device[0].resolution_cdeg = 25;
	begin(rig);
	UNTIL(rig, rig->profiles >= 2);
	check_profile(rig, 401, 0.001);
	assert_int_equal(rig->last.interlace, 4);
	assert_float_equal(rig->last.first_rad, -50 * TRIG_DEG, 1e-12);
}

static void a_quarter_degree_over_180_comes_as_four_partial_scans(void **state)
{
	struct rig *rig = *state;
	rig->config->device[0].resolution_cdeg = 25;
	begin(rig);
	UNTIL(rig, rig->profiles >= 8);
	assert_int_equal(rig->parts_seen, 15);
	check_profile(rig, rig->last.part == 0 ? 181 : 180, 0.001);
	assert_float_equal(rig->last.first_rad, (-90 + 0.25 * rig->last.part) * TRIG_DEG, 1e-12);
}

static void unplugged_and_plugged_in_again_it_streams_again(void **state)
{
	struct rig *rig = *state;
	begin(rig);
	UNTIL(rig, rig->profiles >= 2);
	stop_sim(rig);
	UNTIL(rig, rig->lost == 1);
	assert_false(open_link(rig));
	assert_non_null(strstr(rig->error, "no such device"));
	start_sim(rig);
	assert_true(open_link(rig));
	const int before = rig->profiles;
	UNTIL(rig, rig->profiles >= before + 2);
}

static void a_line_that_the_reader_closed_can_be_opened_again(void **state)
{
	struct rig *rig = *state;
	begin(rig);
	UNTIL(rig, rig->profiles >= 2);
	close_link(rig);
	for (int i = 0; i < 300; i++)
		turn(rig); /* the scanner streams on, to nobody */
	assert_true(open_link(rig));
	const int before = rig->profiles;
	UNTIL(rig, rig->step.state == DIALOGUE_STREAMING && rig->profiles >= before + 2);
}

static void after_a_power_cycle_it_is_set_up_anew(void **state)
{
	struct rig *rig = *state;
	rig->config->device[0].fov_deg = 100;
	begin(rig);
	UNTIL(rig, rig->profiles >= 2);
	order(rig, "power", 0, 0);
	UNTIL(rig, rig->step.state == DIALOGUE_CONFIGURING);
	const int before = rig->profiles;
	UNTIL(rig, rig->profiles >= before + 2);
	check_profile(rig, 201, 0.001);
}

static void at_a_wrong_rate_there_is_only_garbage(void **state)
{
	struct rig *rig = *state;
	struct decoder_counters counters;
	rig->params.baud = 19200;
	begin(rig);
	UNTIL(rig, rig->step.state == DIALOGUE_STREAMING);
	assert_int_equal(driver_lms2xx.link_baud(rig->link, 38400, rig->error), 0);
	const int before = rig->profiles;
	for (int i = 0; i < 3; i++)
		turn(rig);
	driver_lms2xx.counters(rig->decoder, &counters);
	UNTIL(rig, rig->step.state == DIALOGUE_CONFIGURING);
	UNTIL(rig, rig->profiles >= before + 3);
	driver_lms2xx.counters(rig->decoder, &counters);
	for (int i = 0; i < counters.n; i++)
		if (strcmp(counters.counter[i].name, "garbage bytes") == 0)
			assert_true(counters.counter[i].count > 0);
}

static void it_stops_when_it_is_told_to(void **state)
{
	struct rig *rig = *state;
	begin(rig);
	UNTIL(rig, rig->profiles >= 2);
	driver_lms2xx.dialogue_stop(rig->dialogue, (int64_t)uv_hrtime());
	rig->deadline_ns = 0;
	UNTIL(rig, rig->step.state == DIALOGUE_FAILED);
	assert_string_equal(rig->step.error, "");
	for (int i = 0; i < 100; i++)
		turn(rig);
	const int scans = rig->scans;
	for (int i = 0; i < 300; i++)
		turn(rig);
	assert_int_equal(rig->scans, scans);
}

static void a_paced_scene_is_measured_when_ready_and_told_when_taken(void **state)
{
	struct rig *rig = *state;
	rig->paced = true;
	begin(rig);
	UNTIL(rig, rig->step.state == DIALOGUE_STREAMING);
	for (int line = 1; line <= 10; line++) {
		for (int i = 0; i < 60; i++)
			turn(rig);
		assert_int_equal(rig->scans, line - 1);
		assert_int_equal(rig->taken, line - 1);
		rig->ready_since_ns = 0;
		rig->may = true;
		UNTIL(rig, rig->scans == line);
		assert_true(rig->scan_begin_ns >= rig->ready_since_ns);
		UNTIL(rig, rig->taken == line);
		UNTIL(rig, rig->profiles == line);
		/* What the host believes is a time at which the scene was ready. */
		assert_true(rig->last.t_ns >= rig->ready_since_ns);
	}
}

static void nobody_reads_and_nothing_is_taken(void **state)
{
	struct rig *rig = *state;
	rig->paced = true;
	begin(rig);
	UNTIL(rig, rig->step.state == DIALOGUE_STREAMING);
	struct link *link = rig->link;
	rig->link = NULL; /* open, but not read */
	rig->may = true;
	UNTIL(rig, rig->scans == 1);
	for (int i = 0; i < 300; i++)
		turn(rig);
	assert_int_equal(rig->taken, 0);
	rig->link = link;
	UNTIL(rig, rig->taken == 1);
	UNTIL(rig, rig->profiles == 1);
}

static void the_link_is_not_made_over_a_file(void **state)
{
	struct rig *rig = *state;
	char error[160] = "";
	FILE *file = fopen(rig->port, "w");
	assert_non_null(file);
	fclose(file);
	rig->scene = (struct scene){.ctx = rig, .scan = scene_scan};
	assert_null(create_sim(rig, error));
	assert_non_null(strstr(error, "cannot make the link"));
	assert_int_equal(unlink(rig->port), 0);
}

int main(void)
{
#define RIGGED(name) cmocka_unit_test_setup_teardown(name, setup, teardown)
	const struct CMUnitTest tests[] = {
	    RIGGED(a_factory_fresh_scanner_is_found_set_up_and_streams),
	    RIGGED(at_the_pace_of_the_wire_it_streams_too),
	    RIGGED(the_modes_of_the_device_are_respected),
	    RIGGED(variants_are_switched_to),
	    RIGGED(a_quarter_degree_over_180_comes_as_four_partial_scans),
	    RIGGED(unplugged_and_plugged_in_again_it_streams_again),
	    RIGGED(a_line_that_the_reader_closed_can_be_opened_again),
	    RIGGED(after_a_power_cycle_it_is_set_up_anew),
	    RIGGED(at_a_wrong_rate_there_is_only_garbage),
	    RIGGED(it_stops_when_it_is_told_to),
	    RIGGED(a_paced_scene_is_measured_when_ready_and_told_when_taken),
	    RIGGED(nobody_reads_and_nothing_is_taken),
	    RIGGED(the_link_is_not_made_over_a_file),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

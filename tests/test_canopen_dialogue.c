/* Laws L7 to L9: a CANopen node is set up, started, swept and given back, whatever becomes of it, and no set-point ever
 * lies outside the sweep; against simulated nodes, in virtual time. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "drivers/canopen_parts.h"
#include "tools/sim_canopen.h"

#define MS       INT64_C(1000000)
#define START_NS INT64_C(1732300000000000000)
#define DEG      TRIG_DEG
#define SLACK    (0.01 * DEG) /* of a count, and of rounding */

/* ---- a bus of one node, its dialogue and its decoder ---- */

struct bed {
	struct config config;
	const struct driver *driver;
	struct decoder *decoder;
	struct dialogue *dialogue;
	struct sim_device brain;
	int64_t t_ns, open_ns; /* the link is opened anew then */
	struct dialogue_step step;
	bool deaf;                          /* frames get lost, both ways */
	int64_t foreign_ns, foreign_due_ns; /* somebody else sends SYNC so often; 0: nobody */

	/* What was seen. */
	int streams, losses, failures, notes;
	char lost[160], failed[160], note[160];
	int syncs, beats, rpdos, downloads, commands[256], nmt_all;
	int64_t synced_ns, closest_sync_ns;
	uint16_t control;
	int resets;
	double lowest, highest; /* of what was demanded, rad */
	int angles;
	double error_max, between_max; /* rad: of an angle at its time; of the line between two */
	struct tilt last;
	double angle_low, angle_high;
	int turns, direction;
	int64_t stopped_ns;
};

static void on_tilt(void *ctx, int device, const struct tilt *tilt)
{
	struct bed *b = ctx;
	struct sim_axis *axis = sim_canopen_axis(&b->brain);
	const double sense = b->config.device[0].count.sign < 0 ? -1.0 : 1.0;
	const double error = fabs(tilt->angle_rad - sense * sim_axis_angle(axis, tilt->t_ns));
	const int64_t gap_ns = tilt->t_ns - b->last.t_ns;

	(void)device;
	b->error_max = fmax(b->error_max, error);
	for (int i = 1; b->angles > 0 && i < 8 && gap_ns < 30 * MS; i++) {
		const double share = i / 8.0;
		const double line = b->last.angle_rad + share * (tilt->angle_rad - b->last.angle_rad);
		const double truth = sense * sim_axis_angle(axis, b->last.t_ns + (int64_t)(share * (double)gap_ns));

		b->between_max = fmax(b->between_max, fabs(line - truth));
	}
	const double moved = tilt->angle_rad - b->last.angle_rad;
	const int direction = moved > SLACK ? 1 : moved < -SLACK ? -1 : b->direction;

	b->turns += b->direction && direction != b->direction;
	b->direction = direction;
	b->last = *tilt;
	b->angles++;
	b->angle_low = fmin(b->angle_low, tilt->angle_rad);
	b->angle_high = fmax(b->angle_high, tilt->angle_rad);
	b->driver->dialogue_data(b->dialogue, b->t_ns);
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	struct bed *b = ctx;

	(void)device;
	b->driver->dialogue_reply(b->dialogue, reply);
}

static void decode(struct bed *b, enum direction direction, const uint8_t *bytes, size_t len)
{
	const struct record_sink sink = {.ctx = b, .tilt = on_tilt, .reply = on_reply};
	const struct record record = {
	    .log_ns = b->t_ns, .t_ns = b->t_ns, .direction = direction, .bytes = bytes, .len = len};

	b->driver->decode(b->decoder, &record, &sink);
}

/* A frame of facetd's: what it says is judged here. */
static void judge(struct bed *b, const struct can_frame_at *f)
{
	const struct config_device *d = &b->config.device[0];

	if (f->id == CANOPEN_SYNC) {
		if (b->syncs++ && b->t_ns - b->synced_ns < b->closest_sync_ns)
			b->closest_sync_ns = b->t_ns - b->synced_ns;
		b->synced_ns = b->t_ns;
	} else if (f->id == (uint32_t)(CANOPEN_HEARTBEAT + d->master)) {
		b->beats++;
	} else if (f->id == CANOPEN_NMT) {
		b->commands[f->data[0]]++;
		b->nmt_all += f->data[1] != d->node;
	} else if (f->id == (uint32_t)(CANOPEN_SDO_REQUEST + d->node)) {
		b->downloads += (f->data[0] & 0xe0) == 0x20;
	} else if (f->id == (uint32_t)(CANOPEN_RPDO + d->node)) {
		const uint16_t control = (uint16_t)(f->data[0] | f->data[1] << 8);
		const int32_t demand = (int32_t)canopen_wire_number(f->data + 2, 4);
		const bool goes = d->drive_mode == CANOPEN_CYCLIC ? (control & 0x10f) == 0x0f : (control & 0x10) != 0;

		b->rpdos++;
		b->resets += (control & 0x80) && !(b->control & 0x80);
		b->control = control;
		if (goes && d->drive_mode != CANOPEN_VELOCITY) {
			const double rad = canopen_angle_rad(d, d->count.scale, demand);

			b->lowest = fmin(b->lowest, rad);
			b->highest = fmax(b->highest, rad);
		}
	}
}

static void take_writes(struct bed *b)
{
	struct can_frame_at f;
	uint8_t entry[CAN_WIRE_ENTRY_FD];

	decode(b, TO_DEVICE, b->step.write, b->step.write_len);
	for (size_t at = 0; at < b->step.write_len;) {
		const ssize_t n = can_wire_get(b->step.write + at, b->step.write_len - at, &f);

		assert_true(n > 0);
		judge(b, &f);
		f.t_ns = b->t_ns;
		can_wire_put(&f, entry);
		if (!b->deaf) {
			b->brain.receive(b->brain.ctx, entry, (size_t)n, b->t_ns);
			decode(b, FROM_DEVICE, entry, (size_t)n); /* our own come back */
		}
		at += (size_t)n;
	}
}

static bool take_frames(struct bed *b)
{
	uint8_t bytes[4096];
	bool any = false;
	size_t n;

	b->brain.advance(b->brain.ctx, b->t_ns);
	while ((n = b->brain.transmit(b->brain.ctx, bytes, sizeof bytes)) > 0) {
		if (!b->deaf)
			decode(b, FROM_DEVICE, bytes, n);
		any = true;
	}
	return any;
}

/* As the supervisor does. */
static void take_state(struct bed *b, enum dialogue_state before)
{
	if (b->step.state == DIALOGUE_STREAMING && before != DIALOGUE_STREAMING)
		b->streams++;
	if (b->step.state == DIALOGUE_CONFIGURING && before == DIALOGUE_STREAMING) {
		b->losses++;
		snprintf(b->lost, sizeof b->lost, "%s", b->step.error);
	}
	if (b->step.state == DIALOGUE_STREAMING && strcmp(b->note, b->step.error) != 0) {
		b->notes++;
		snprintf(b->note, sizeof b->note, "%s", b->step.error);
	}
	if (b->step.state == DIALOGUE_FAILED) {
		b->failures++;
		snprintf(b->failed, sizeof b->failed, "%s", b->step.error);
		b->open_ns = b->t_ns + 250 * MS;
		b->stopped_ns = b->t_ns;
	}
}

static void open_link(struct bed *b)
{
	b->open_ns = INT64_MAX;
	decode(b, LINK_OPENED, (const uint8_t *)"", 0);
	b->driver->dialogue_reset(b->dialogue, b->t_ns);
	b->step.state = DIALOGUE_CONFIGURING;
}

static void converse(struct bed *b)
{
	for (int i = 0; i < 16; i++) {
		const enum dialogue_state before = b->step.state;
		const bool came = take_frames(b);

		if (b->open_ns != INT64_MAX && b->t_ns < b->open_ns)
			return;
		if (b->open_ns != INT64_MAX)
			open_link(b);
		b->driver->dialogue_step(b->dialogue, b->t_ns, &b->step);
		take_state(b, before);
		if (b->step.write_len)
			take_writes(b);
		else if (!came && (b->step.deadline_ns > b->t_ns || b->step.state == DIALOGUE_FAILED))
			return;
	}
}

static int64_t earlier(int64_t a, int64_t b)
{
	return a < b ? a : b;
}

static void pass(struct bed *b, const struct can_frame_at *frame)
{
	struct can_frame_at f = *frame;
	uint8_t entry[CAN_WIRE_ENTRY_FD];

	f.t_ns = b->t_ns;
	const size_t n = can_wire_put(&f, entry);

	b->brain.receive(b->brain.ctx, entry, n, b->t_ns);
	decode(b, FROM_DEVICE, entry, n);
}

static void foreign(struct bed *b)
{
	const struct can_frame_at frame = canopen_wire_sync();

	if (b->foreign_ns == 0 || b->t_ns < b->foreign_due_ns)
		return;
	pass(b, &frame);
	b->foreign_due_ns = b->t_ns + b->foreign_ns;
}

static void run(struct bed *b, double seconds)
{
	const int64_t end_ns = b->t_ns + (int64_t)(seconds * 1e9);

	while (b->t_ns < end_ns) {
		foreign(b);
		converse(b);
		int64_t next_ns = earlier(b->brain.deadline(b->brain.ctx), end_ns);

		if (b->foreign_ns)
			next_ns = earlier(next_ns, b->foreign_due_ns);

		next_ns = earlier(next_ns, b->open_ns != INT64_MAX ? b->open_ns : b->step.deadline_ns);
		b->t_ns = next_ns > b->t_ns ? next_ns : b->t_ns + 100000;
	}
}

static void lay(struct bed *b, const struct sim_canopen_params *params, const char *yaml)
{
	struct config_error error = {""};

	memset(b, 0, sizeof *b);
	if (config_read(yaml, strlen(yaml), "test", &b->config, &error))
		fail_msg("%s", error.text);
	b->driver = driver_find("canopen");
	b->t_ns = START_NS;
	b->open_ns = START_NS;
	b->closest_sync_ns = INT64_MAX;
	b->lowest = b->angle_low = 1e9;
	b->highest = b->angle_high = -1e9;
	assert_int_equal(sim_canopen_create(params, b->t_ns, &b->brain), 0);
	b->decoder = b->driver->decoder_create(&b->config.device[0], 0);
	b->dialogue = b->driver->dialogue_create(&b->config, 0);
	assert_non_null(b->decoder);
	assert_non_null(b->dialogue);
}

static void clear(struct bed *b)
{
	b->driver->dialogue_destroy(b->dialogue);
	b->driver->decoder_destroy(b->decoder);
	b->brain.destroy(b->brain.ctx);
}

static void fault(struct bed *b, const char *kind, double value, bool on)
{
	struct sim_fault f = {.device = "servo", .value = value, .for_ns = on ? INT64_MAX : 0};

	snprintf(f.kind, sizeof f.kind, "%s", kind);
	assert_true(b->brain.fault(b->brain.ctx, &f, on, b->t_ns));
}

/* It befalls once. */
static void befall(struct bed *b, const char *kind, double value)
{
	struct sim_fault f = {.device = "servo", .value = value};

	snprintf(f.kind, sizeof f.kind, "%s", kind);
	assert_true(b->brain.fault(b->brain.ctx, &f, true, b->t_ns));
}

static const struct sim_canopen_params servo = {.kind = SIM_CANOPEN_DRIVE, .node = 5, .seed = 1};

#define SERVO "{name: servo, driver: canopen, connect: can0, node: 5, scale: 0.001deg"
#define SWEEP "sweep: {device: servo, from: -20deg, to: 30deg, speed: 37.5deg"

static void lay_servo(struct bed *b, const char *keys, const char *sweep)
{
	char yaml[600];

	snprintf(yaml, sizeof yaml, "devices:\n  - " SERVO "%s}\n" SWEEP "%s}\n", keys, sweep);
	lay(b, &servo, yaml);
}

static const char *const mode[] = {", mode: position", ", mode: velocity", ", mode: cyclic"};

static void expect_sweeping(struct bed *b)
{
	const int turns = b->turns;

	run(b, 6.0);
	assert_int_equal(b->step.state, DIALOGUE_STREAMING);
	assert_true(b->turns >= turns + 2);
	assert_string_equal(b->step.error, "");
}

static void expect_within(const struct bed *b, double low, double high)
{
	assert_true(b->angle_low >= low * DEG - SLACK);
	assert_true(b->angle_high <= high * DEG + SLACK);
	if (b->config.device[0].drive_mode == CANOPEN_VELOCITY)
		return;
	assert_true(b->lowest >= low * DEG - SLACK);
	assert_true(b->highest <= high * DEG + SLACK);
}

/* ---- sweeping ---- */

static void every_mode_sweeps_every_profile_within_its_ends(void **state)
{
	static const char *const profile[] = {", profile: triangle", ", profile: sinus", ", profile: step, step: 5deg"};

	(void)state;
	for (int m = 0; m < 3; m++)
		for (int p = 0; p < 3; p++) {
			struct bed b;

			lay_servo(&b, mode[m], profile[p]);
			run(&b, 60.0);
			assert_int_equal(b.step.state, DIALOGUE_STREAMING);
			assert_string_equal(b.step.error, "");
			assert_int_equal(b.streams, 1);
			expect_within(&b, m == 1 ? -20.5 : -20.0, m == 1 ? 30.5 : 30.0);
			assert_true(b.angle_low < -19.8 * DEG && b.angle_high > 29.8 * DEG);
			assert_true(b.turns > (p == 2 ? 8 : p == 1 ? 20 : 35));
			assert_int_equal(b.nmt_all, 0);
			assert_int_equal(b.resets, 0);
			print_message("note: %s%s: %d turns a minute, angle exact to %.4f degree, between two %.4f\n",
			              mode[m] + 8, profile[p] + 10, b.turns, b.error_max / DEG, b.between_max / DEG);
			/* At its time the angle is as good as its counts; between two, as the acceleration allows. */
			assert_true(b.error_max <= 0.0011 * DEG);
			assert_true(b.between_max <= 0.01 * DEG);
			clear(&b);
		}
}

static void minutes_go_by_without_a_word(void **state)
{
	struct bed b;

	(void)state;
	lay_servo(&b, ", mode: position", "");
	run(&b, 600.0);
	assert_int_equal(b.streams, 1);
	assert_int_equal(b.failures, 0);
	assert_true(b.turns > 350);
	expect_within(&b, -20, 30);
	clear(&b);
}

static void sync_and_heartbeat_keep_their_periods(void **state)
{
	struct bed b;

	(void)state;
	lay_servo(&b, ", mode: cyclic", "");
	run(&b, 10.0);
	assert_in_range(b.syncs, 999, 1001);
	assert_in_range(b.beats, 50, 51);
	assert_int_equal(b.closest_sync_ns, 10 * MS);
	/* The program slept: one SYNC, never those that were missed. */
	const int syncs = b.syncs;

	b.t_ns += 3000 * MS;
	converse(&b);
	assert_int_equal(b.syncs, syncs + 1);
	run(&b, 1.0);
	assert_in_range(b.syncs, syncs + 99, syncs + 102);
	assert_true(b.closest_sync_ns >= 10 * MS);
	clear(&b);
}

static void it_begins_wherever_the_servo_stands(void **state)
{
	(void)state;
	for (int m = 0; m < 3; m++)
		for (double at = -60.0; at <= 60.0; at += 30.0) {
			struct sim_canopen_params params = servo;
			struct bed b;
			char yaml[400];

			params.angle_rad = at * DEG;
			snprintf(yaml, sizeof yaml, "devices:\n  - " SERVO "%s}\n" SWEEP "}\n", mode[m]);
			lay(&b, &params, yaml);
			run(&b, 6.0);
			b.angle_low = 1e9;
			b.angle_high = -1e9;
			expect_sweeping(&b);
			assert_true(b.angle_low > -20.6 * DEG && b.angle_high < 30.6 * DEG);
			clear(&b);
		}
}

static void a_servo_that_counts_the_other_way_sweeps_too(void **state)
{
	(void)state;
	for (int m = 0; m < 3; m++) {
		struct bed b;
		char keys[80];

		snprintf(keys, sizeof keys, "%s, sign: -1", mode[m]);
		lay_servo(&b, keys, "");
		expect_sweeping(&b);
		expect_within(&b, -20.6, 30.6);
		clear(&b);
	}
}

/* ---- setting up ---- */

static void what_is_as_wanted_is_not_written_again(void **state)
{
	struct bed b;

	(void)state;
	lay_servo(&b, ", mode: position", "");
	run(&b, 3.0);
	assert_int_equal(b.streams, 1);
	assert_true(b.downloads > 10);
	assert_int_equal(b.commands[CANOPEN_RESET_NODE] + b.commands[CANOPEN_RESET_COMMUNICATION], 0);
	/* The link is opened anew: objects of the drive itself are written, of the communication none. */
	b.open_ns = b.t_ns;
	b.downloads = 0;
	run(&b, 3.0);
	assert_int_equal(b.streams, 2);
	assert_true(b.downloads < 8);
	clear(&b);
}

static bool moves_in_the_middle(const struct sim_axis *axis, int64_t t_ns)
{
	const double at = sim_axis_angle(axis, t_ns), moved = at - sim_axis_angle(axis, t_ns - 10 * MS);

	return fabs(moved) > 0.3 * DEG && fabs(at - 5.0 * DEG) < 5.0 * DEG;
}

static void the_drive_is_told_to_stop_by_itself(void **state)
{
	(void)state;
	for (int m = 0; m < 3; m++) {
		struct bed b;

		lay_servo(&b, mode[m], "");
		struct sim_axis *axis = sim_canopen_axis(&b.brain);

		run(&b, 4.0);
		while (!moves_in_the_middle(axis, b.t_ns))
			run(&b, 0.01);
		/* facetd dies: three of its heartbeats later the drive brakes. */
		int64_t stood_ns = b.t_ns;

		for (int64_t t_ns = b.t_ns; t_ns < b.t_ns + 2000 * MS; t_ns += MS) {
			uint8_t bytes[4096];

			b.brain.advance(b.brain.ctx, t_ns);
			while (b.brain.transmit(b.brain.ctx, bytes, sizeof bytes) > 0)
				continue;
			if (fabs(sim_axis_speed(axis, t_ns)) > 0.01 * DEG)
				stood_ns = t_ns;
		}
		print_message("note: %s: facetd dies, the drive stands after %.2f s\n", mode[m] + 8,
		              (double)(stood_ns - b.t_ns) * 1e-9);
		assert_true(stood_ns - b.t_ns <= 1000 * MS);
		clear(&b);
	}
}

static void a_node_that_is_another_kind_is_said(void **state)
{
	static const struct {
		enum sim_canopen_kind is;
		const char *yaml, *says;
	} row[] = {
	    {SIM_CANOPEN_ENCODER, "devices:\n  - " SERVO "}\n" SWEEP "}\n", "is an encoder and cannot be commanded"},
	    {SIM_CANOPEN_INCLINOMETER, "devices:\n  - " SERVO ", kind: drive}\n",
	     "is an inclinometer (its object 1000"},
	    {SIM_CANOPEN_DRIVE, "devices:\n  - " SERVO ", kind: encoder}\n", "is a drive (its object 1000"},
	    {SIM_CANOPEN_ENCODER, "devices:\n  - {name: servo, driver: canopen, connect: can0, node: 5}\n",
	     "give it a `scale`"},
	};

	(void)state;
	for (size_t i = 0; i < sizeof row / sizeof row[0]; i++) {
		struct sim_canopen_params params = servo;
		struct bed b;

		params.kind = row[i].is;
		lay(&b, &params, row[i].yaml);
		run(&b, 5.0);
		assert_int_equal(b.streams, 0);
		assert_int_equal(b.failures, 1); /* told once a minute, and SYNC goes on */
		assert_true(b.syncs > 450);
		assert_non_null(strstr(b.failed, row[i].says));
		assert_int_equal(b.downloads, 0);
		clear(&b);
	}
}

static void a_node_that_is_not_there_is_said_and_found_later(void **state)
{
	struct bed b;

	(void)state;
	lay_servo(&b, "", "");
	fault(&b, "off", 0, true);
	run(&b, 20.0);
	assert_int_equal(b.streams, 0);
	assert_int_equal(b.failures, 1);
	assert_non_null(strstr(b.failed, "node 5 does not answer"));
	fault(&b, "off", 0, false);
	const int64_t back_ns = b.t_ns;

	while (b.streams == 0 && b.t_ns - back_ns < 5000 * MS)
		run(&b, 0.01);
	print_message("note: a node that is switched on streams after %.2f s\n", (double)(b.t_ns - back_ns) * 1e-9);
	assert_true(b.t_ns - back_ns <= 2000 * MS);
	expect_sweeping(&b);
	clear(&b);
}

static void a_link_that_hears_nothing_is_a_sentence(void **state)
{
	struct bed b;

	(void)state;
	lay_servo(&b, "", "");
	run(&b, 3.0);
	b.deaf = true;
	run(&b, 10.0);
	assert_int_equal(b.losses, 1);
	assert_true(strstr(b.lost, "no angle for 500 ms") || strstr(b.lost, "heartbeat was lost"));
	b.deaf = false;
	run(&b, 5.0);
	expect_sweeping(&b);
	clear(&b);
}

/* ---- what befalls a drive in mid-sweep ---- */

static void every_mode_outlives_a_power_cycle(void **state)
{
	(void)state;
	for (int m = 0; m < 3; m++) {
		struct bed b;

		lay_servo(&b, mode[m], "");
		run(&b, 4.0);
		befall(&b, "power cycle", 1.0);
		const int64_t off_ns = b.t_ns;

		run(&b, 0.5);
		while (b.step.state != DIALOGUE_STREAMING && b.t_ns - off_ns < 10000 * MS)
			run(&b, 0.01);
		print_message("note: %s: off for 1 s, its angle is back after %.2f s\n", mode[m] + 8,
		              (double)(b.t_ns - off_ns) * 1e-9);
		assert_true(b.losses >= 1);
		run(&b, 3.0);
		expect_sweeping(&b);
		clear(&b);
	}
}

static void a_boot_up_in_mid_run_is_noticed_at_once(void **state)
{
	struct bed b;

	(void)state;
	lay_servo(&b, ", mode: cyclic", "");
	run(&b, 4.0);
	befall(&b, "power cycle", 0.01);
	run(&b, 0.4);
	assert_int_equal(b.losses, 1);
	assert_non_null(strstr(b.lost, "switched off and on"));
	run(&b, 3.0);
	expect_sweeping(&b);
	clear(&b);
}

static void its_heartbeat_lost_it_begins_anew(void **state)
{
	(void)state;
	for (int m = 0; m < 3; m++) {
		struct bed b;

		lay_servo(&b, mode[m], "");
		run(&b, 4.0);
		fault(&b, "heartbeat", 0, true);
		run(&b, 1.0);
		assert_int_equal(b.losses, 1);
		assert_non_null(strstr(b.lost, "its heartbeat was lost (3 of 200 ms)"));
		fault(&b, "heartbeat", 0, false);
		run(&b, 2.0);
		expect_sweeping(&b);
		clear(&b);
	}
}

static void our_heartbeat_lost_it_stops_and_is_taken_up_again(void **state)
{
	(void)state;
	for (int m = 0; m < 3; m++) {
		struct bed b;

		lay_servo(&b, mode[m], "");
		run(&b, 4.0);
		/* facetd was itself stopped for two seconds. */
		for (int i = 0; i < 2000; i++) {
			uint8_t bytes[4096];

			b.t_ns += MS;
			b.brain.advance(b.brain.ctx, b.t_ns);
			while (b.brain.transmit(b.brain.ctx, bytes, sizeof bytes) > 0)
				continue;
		}
		assert_true(fabs(sim_axis_speed(sim_canopen_axis(&b.brain), b.t_ns)) < 0.01 * DEG);
		run(&b, 4.0);
		expect_sweeping(&b);
		assert_true(b.resets <= 1);
		clear(&b);
	}
}

static void a_fault_is_reset_once_and_then_a_note(void **state)
{
	(void)state;
	for (int m = 0; m < 3; m++) {
		struct bed b;

		lay_servo(&b, mode[m], "");
		run(&b, 4.0);
		befall(&b, "fault", 0x4310);
		run(&b, 3.0);
		assert_int_equal(b.resets, 1);
		assert_int_equal(b.losses, 0); /* its angle goes on */
		befall(&b, "fault", 0x4310);
		run(&b, 60.0);
		assert_int_equal(b.resets, 1);
		assert_int_equal(b.step.state, DIALOGUE_STREAMING);
		assert_non_null(strstr(b.step.error, "4310"));
		const int turns = b.turns, notes = b.notes;

		run(&b, 60.0);
		assert_true(b.turns <= turns + 1);
		assert_int_equal(b.notes, notes); /* said once */
		befall(&b, "power cycle", 1.0);
		run(&b, 6.0);
		expect_sweeping(&b);
		clear(&b);
	}
}

static void a_blocked_servo_is_said_and_stands(void **state)
{
	(void)state;
	for (int m = 0; m < 3; m++) {
		struct bed b;

		lay_servo(&b, mode[m], "");
		run(&b, 4.0);
		fault(&b, "stuck", 0, true);
		run(&b, 60.0);
		assert_int_equal(b.step.state, DIALOGUE_STREAMING);
		assert_non_null(strstr(b.step.error, "the sweep stands"));
		assert_true(b.resets <= 1);
		fault(&b, "stuck", 0, false);
		befall(&b, "power cycle", 0.5);
		run(&b, 8.0);
		expect_sweeping(&b);
		clear(&b);
	}
}

static void a_slow_servo_is_a_following_error(void **state)
{
	struct bed b;

	(void)state;
	lay_servo(&b, ", mode: cyclic, following: 5deg", "");
	run(&b, 4.0);
	fault(&b, "slow", 0.3, true);
	run(&b, 20.0);
	assert_int_equal(b.step.state, DIALOGUE_STREAMING);
	assert_non_null(strstr(b.step.error, "the sweep stands"));
	clear(&b);
}

static void a_limit_of_its_own_stops_the_sweep(void **state)
{
	struct bed b;

	(void)state;
	lay_servo(&b, ", mode: position", "");
	run(&b, 4.0);
	fault(&b, "limit", 0, true);
	run(&b, 10.0);
	assert_int_equal(b.step.state, DIALOGUE_STREAMING);
	assert_non_null(strstr(b.step.error, "the sweep stands"));
	clear(&b);
}

static void an_emergency_is_a_note_and_no_more(void **state)
{
	struct bed b;

	(void)state;
	lay_servo(&b, ", mode: position", "");
	run(&b, 4.0);
	befall(&b, "emcy", 0x4210);
	run(&b, 1.0);
	assert_int_equal(b.losses, 0);
	assert_non_null(strstr(b.step.error, "it reports 4210"));
	run(&b, 61.0);
	expect_sweeping(&b);
	clear(&b);
}

static void answers_that_are_strange_or_missing_are_lived_with(void **state)
{
	static const char *const kind[] = {"sdo echo", "sdo short", "late"};

	(void)state;
	for (int i = 0; i < 3; i++) {
		struct bed b;

		lay_servo(&b, ", mode: position", "");
		fault(&b, kind[i], 0, true);
		run(&b, 3.0);
		expect_sweeping(&b);
		assert_true(b.error_max <= 0.0011 * DEG);
		clear(&b);
	}
	struct bed b;

	lay_servo(&b, ", mode: position", ", profile: sinus"); /* its speed goes by SDO */
	run(&b, 4.0);
	fault(&b, "sdo timeout", 0, true);
	run(&b, 3.0);
	assert_int_equal(b.losses, 1);
	assert_non_null(strstr(b.lost, "SDO 6081:00 timed out"));
	fault(&b, "sdo timeout", 0, false);
	run(&b, 6.0);
	expect_sweeping(&b);
	clear(&b);
}

static void what_it_refuses_to_be_set_is_said(void **state)
{
	static const struct {
		int object;
		const char *note, *failure;
	} row[] = {{0x6007, "it has no object 6007", NULL},
	           {0x605a, "", NULL},
	           {0x6083, "object 6083:00 cannot be set", NULL},
	           {0x6060, "refuses the mode", NULL},
	           {0x1a00, NULL, "1A00"},
	           {0x1000, NULL, "1000"}};

	(void)state;
	for (size_t i = 0; i < sizeof row / sizeof row[0]; i++) {
		struct bed b;

		lay_servo(&b, ", mode: position", "");
		fault(&b, "sdo abort", row[i].object, true);
		run(&b, 5.0);
		assert_int_equal(b.step.state == DIALOGUE_STREAMING, row[i].note != NULL);
		assert_non_null(
		    strstr(row[i].note ? b.step.error : b.failed, row[i].note ? row[i].note : row[i].failure));
		clear(&b);
	}
}

static void the_limits_of_the_drive_are_honoured_before_anything_is_sent(void **state)
{
	(void)state;
	for (int m = 0; m < 3; m++) {
		struct bed b;
		const uint8_t low[] = {0x23, 0x7d, 0x60, 1, 0xf0, 0xd8, 0xff, 0xff},
		              high[] = {0x23, 0x7d, 0x60, 2, 0x10, 0x27, 0, 0};

		lay_servo(&b, mode[m], "");
		run(&b, 0.05);
		for (int i = 0; i < 2; i++) { /* -10 and 10 degrees */
			const struct can_frame_at f = can_wire_frame(CANOPEN_SDO_REQUEST + 5, i ? high : low, 8);

			pass(&b, &f);
			run(&b, 0.01);
		}
		b.open_ns = b.t_ns;
		run(&b, 10.0);
		assert_int_equal(b.step.state, DIALOGUE_STREAMING);
		assert_non_null(strstr(b.step.error, "its limits are -10.0 and 10.0"));
		assert_true(b.highest < -1e8 || (b.lowest >= -10.001 * DEG && b.highest <= 10.001 * DEG));
		assert_true(b.angle_low > -10.001 * DEG && b.angle_high < 10.001 * DEG);
		clear(&b);
	}
}

static void limits_of_the_configuration_hold_in_every_mode(void **state)
{
	(void)state;
	for (int m = 0; m < 3; m++) {
		struct bed b;
		char keys[120];

		snprintf(keys, sizeof keys, "%s, limits: [-20deg, 30deg]", mode[m]);
		lay_servo(&b, keys, "");
		expect_sweeping(&b);
		clear(&b);
	}
}

static void a_mapping_that_is_lost_is_set_again(void **state)
{
	(void)state;
	for (int m = 0; m < 3; m++) {
		struct bed b;

		lay_servo(&b, mode[m], "");
		run(&b, 4.0);
		befall(&b, "mapping", 0);
		run(&b, 10.0);
		expect_sweeping(&b);
		assert_true(b.losses >= 1);
		clear(&b);
	}
}

static void a_fault_before_the_first_sweep_is_reset(void **state)
{
	(void)state;
	for (int m = 0; m < 3; m++) {
		struct bed b;

		lay_servo(&b, mode[m], "");
		run(&b, 0.03);
		befall(&b, "fault", 0x3210);
		run(&b, 2.0);
		expect_sweeping(&b);
		assert_int_equal(b.resets, 1);
		clear(&b);
	}
}

static void it_is_taken_up_in_mid_sweep(void **state)
{
	(void)state;
	for (int ms = 0; ms < 3000; ms += 170) {
		struct bed b;

		lay_servo(&b, mode[ms / 10 % 3], "");
		run(&b, 2.0 + ms * 1e-3);
		/* A new life of the program; the drive is as the old one left it. */
		b.driver->dialogue_destroy(b.dialogue);
		b.driver->decoder_destroy(b.decoder);
		b.decoder = b.driver->decoder_create(&b.config.device[0], 0);
		b.dialogue = b.driver->dialogue_create(&b.config, 0);
		b.open_ns = b.t_ns;
		run(&b, 2.0);
		expect_sweeping(&b);
		/* Told a speed, it goes on with it until it is taken up. */
		const double on = ms / 10 % 3 == 1 ? 5.0 : 0.0;

		expect_within(&b, -20.0 - on, 30.0 + on);
		assert_int_equal(b.resets, 0);
		clear(&b);
	}
}

static void somebody_elses_sync_leads_as_well(void **state)
{
	static const int64_t period_ms[] = {5, 10, 20};

	(void)state;
	for (int m = 0; m < 3; m++)
		for (int i = 0; i < 3; i++) {
			struct bed b;
			char keys[80];

			snprintf(keys, sizeof keys, "%s, sync: 0", mode[m]);
			lay_servo(&b, keys, "");
			b.foreign_ns = period_ms[i] * MS;
			run(&b, 1.0);
			expect_sweeping(&b);
			assert_true(b.error_max <= 0.0011 * DEG);
			expect_within(&b, -20.6, 30.6);
			clear(&b);
		}
	struct bed b;

	lay_servo(&b, ", mode: cyclic, sync: 0", "");
	run(&b, 5.0);
	assert_int_equal(b.streams, 0);
	assert_non_null(strstr(b.failed, "nobody sends it"));
	clear(&b);
	lay_servo(&b, ", mode: velocity, sync: 0", ""); /* the others can do without */
	run(&b, 1.0);
	expect_sweeping(&b);
	clear(&b);
}

/* ---- homing ---- */

static void an_unhomed_drive_is_homed_first(void **state)
{
	static const int method[] = {17, 18, 35, 37};

	(void)state;
	for (int i = 0; i < 4; i++)
		for (int m = 0; m < 3; m++) {
			struct sim_canopen_params params = servo;
			struct bed b;
			char yaml[400];

			params.unhomed = true;
			params.angle_rad = i < 2 ? 10.0 * DEG : 0.0;
			params.switch_rad[0] = -40.0 * DEG;
			params.switch_rad[1] = 50.0 * DEG;
			snprintf(yaml, sizeof yaml,
			         "devices:\n  - " SERVO "%s, homing: {method: %d, speed: 20deg, offset: %s}}\n" SWEEP
			         "}\n",
			         mode[m], method[i],
			         i == 0   ? "-40deg"
			         : i == 1 ? "50deg"
			                  : "0deg");
			lay(&b, &params, yaml);
			run(&b, 12.0);
			b.error_max = 0.0;
			expect_sweeping(&b);
			assert_true(b.error_max <= 0.5 * DEG);
			clear(&b);
		}
}

static void here_is_home_only_once(void **state)
{
	(void)state;
	for (int off = 0; off < 2; off++) {
		struct sim_canopen_params params = servo;
		struct bed b;

		params.unhomed = true;
		lay(&b, &params, "devices:\n  - " SERVO ", homing: {method: 35}}\n" SWEEP "}\n");
		run(&b, 5.3);
		assert_true(b.error_max <= 0.0011 * DEG);
		assert_true(fabs(b.last.angle_rad) > 1.0 * DEG);
		if (off)
			befall(&b, "power cycle", 1.0); /* where it stands then, it was told, is home */
		b.driver->dialogue_destroy(b.dialogue);
		b.driver->decoder_destroy(b.decoder);
		b.decoder = b.driver->decoder_create(&b.config.device[0], 0);
		b.dialogue = b.driver->dialogue_create(&b.config, 0);
		b.open_ns = b.t_ns;
		run(&b, 4.0);
		b.error_max = 0.0;
		expect_sweeping(&b);
		assert_int_equal(b.error_max > 0.5 * DEG, off);
		clear(&b);
	}
}

static void homing_that_fails_is_a_note(void **state)
{
	struct bed b;

	(void)state;
	lay_servo(&b, ", homing: {method: 17, speed: 20deg}", "");
	fault(&b, "homing", 0, true);
	run(&b, 30.0);
	assert_int_equal(b.step.state, DIALOGUE_STREAMING);
	assert_non_null(strstr(b.step.error, "could not be homed by method 17"));
	clear(&b);
}

/* ---- who is only listened to ---- */

static void a_drive_without_a_sweep_is_only_listened_to(void **state)
{
	struct bed b;

	(void)state;
	lay(&b, &servo, "devices:\n  - " SERVO "}\n");
	run(&b, 10.0);
	assert_int_equal(b.step.state, DIALOGUE_STREAMING);
	assert_int_equal(b.rpdos, 0);
	assert_int_equal(b.beats, 0);
	assert_true(b.angles > 900);
	assert_string_equal(b.step.error, "");
	b.driver->dialogue_stop(b.dialogue, b.t_ns);
	run(&b, 0.1);
	assert_int_equal(b.step.state, DIALOGUE_FAILED);
	assert_string_equal(b.failed, "");
	assert_int_equal(b.rpdos, 0);
	clear(&b);
}

static void sensors_are_read(void **state)
{
	static const char *const yaml[] = {
	    "devices:\n  - {name: servo, driver: canopen, connect: can0, node: 5, scale: 0.001deg, wrap: 1474560000}\n",
	    "devices:\n  - {name: servo, driver: canopen, connect: can0, node: 5, kind: inclinometer}\n",
	};

	(void)state;
	for (int i = 0; i < 2; i++)
		for (int factory = 0; factory < 2; factory++)
			for (int nobody = 0; nobody < 2; nobody++) {
				struct sim_canopen_params params = {.kind = i ? SIM_CANOPEN_INCLINOMETER
				                                              : SIM_CANOPEN_ENCODER,
				                                    .node = 5,
				                                    .factory = factory};
				char text[300];
				struct bed b;

				snprintf(text, sizeof text, "%s", yaml[i]);
				if (nobody)
					snprintf(strrchr(text, '}'), 20, ", sync: 0}\n");
				lay(&b, &params, text);
				run(&b, 1.0);
				sim_axis_triangle(sim_canopen_axis(&b.brain), -20 * DEG, 30 * DEG, 37.5 * DEG,
				                  300 * DEG, b.t_ns);
				run(&b, 0.1);
				b.error_max = 0.0;
				run(&b, 10.0);
				assert_int_equal(b.step.state, DIALOGUE_STREAMING);
				assert_int_equal(b.streams, 1);
				assert_true(b.angles > 900);
				print_message("note: %s, %s, %s SYNC: angle exact to %.4f degree\n",
				              i ? "inclinometer" : "encoder",
				              factory ? "as delivered" : "mapped otherwise", nobody ? "no" : "our",
				              b.error_max / DEG);
				assert_true(b.error_max <= (nobody ? 0.05 : 0.011) * DEG);
				clear(&b);
			}
}

/* ---- the end ---- */

static void it_ends_at_rest_and_without_power(void **state)
{
	(void)state;
	for (int m = 0; m < 3; m++)
		for (int rests = 0; rests < 2; rests++) {
			struct bed b;

			lay_servo(&b, mode[m], rests ? ", rest: 10deg" : "");
			run(&b, 4.3);
			b.driver->dialogue_stop(b.dialogue, b.t_ns);
			const int64_t stop_ns = b.t_ns;

			run(&b, 6.0);
			assert_int_equal(b.failures, 1);
			assert_string_equal(b.failed, "");
			assert_true(b.stopped_ns - stop_ns < 4000 * MS);
			struct sim_axis *axis = sim_canopen_axis(&b.brain);

			assert_true(fabs(sim_axis_speed(axis, b.stopped_ns)) < 0.1 * DEG);
			if (rests)
				assert_true(fabs(sim_axis_angle(axis, b.stopped_ns) - 10.0 * DEG) < 0.2 * DEG);
			expect_within(&b, m == 1 ? -20.6 : -20.0, m == 1 ? 30.6 : 30.0);
			clear(&b);
		}
}

static void the_end_may_come_at_any_time(void **state)
{
	(void)state;
	for (int ms = 1; ms < 1200; ms += 7) {
		struct bed b;

		lay_servo(&b, mode[ms % 3], "");
		run(&b, ms * 1e-3);
		b.driver->dialogue_stop(b.dialogue, b.t_ns);
		b.failures = 0;
		for (int i = 0; i < 400 && b.failures == 0; i++)
			run(&b, 0.01);
		assert_int_equal(b.failures, 1);
		assert_string_equal(b.failed, "");
		b.open_ns = INT64_MAX;
		clear(&b);
	}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(every_mode_sweeps_every_profile_within_its_ends),
	    cmocka_unit_test(minutes_go_by_without_a_word),
	    cmocka_unit_test(sync_and_heartbeat_keep_their_periods),
	    cmocka_unit_test(it_begins_wherever_the_servo_stands),
	    cmocka_unit_test(a_servo_that_counts_the_other_way_sweeps_too),
	    cmocka_unit_test(what_is_as_wanted_is_not_written_again),
	    cmocka_unit_test(the_drive_is_told_to_stop_by_itself),
	    cmocka_unit_test(a_node_that_is_another_kind_is_said),
	    cmocka_unit_test(a_node_that_is_not_there_is_said_and_found_later),
	    cmocka_unit_test(a_link_that_hears_nothing_is_a_sentence),
	    cmocka_unit_test(every_mode_outlives_a_power_cycle),
	    cmocka_unit_test(a_boot_up_in_mid_run_is_noticed_at_once),
	    cmocka_unit_test(its_heartbeat_lost_it_begins_anew),
	    cmocka_unit_test(our_heartbeat_lost_it_stops_and_is_taken_up_again),
	    cmocka_unit_test(a_fault_is_reset_once_and_then_a_note),
	    cmocka_unit_test(a_blocked_servo_is_said_and_stands),
	    cmocka_unit_test(a_slow_servo_is_a_following_error),
	    cmocka_unit_test(a_limit_of_its_own_stops_the_sweep),
	    cmocka_unit_test(an_emergency_is_a_note_and_no_more),
	    cmocka_unit_test(answers_that_are_strange_or_missing_are_lived_with),
	    cmocka_unit_test(what_it_refuses_to_be_set_is_said),
	    cmocka_unit_test(the_limits_of_the_drive_are_honoured_before_anything_is_sent),
	    cmocka_unit_test(limits_of_the_configuration_hold_in_every_mode),
	    cmocka_unit_test(a_mapping_that_is_lost_is_set_again),
	    cmocka_unit_test(a_fault_before_the_first_sweep_is_reset),
	    cmocka_unit_test(it_is_taken_up_in_mid_sweep),
	    cmocka_unit_test(somebody_elses_sync_leads_as_well),
	    cmocka_unit_test(an_unhomed_drive_is_homed_first),
	    cmocka_unit_test(here_is_home_only_once),
	    cmocka_unit_test(homing_that_fails_is_a_note),
	    cmocka_unit_test(a_drive_without_a_sweep_is_only_listened_to),
	    cmocka_unit_test(sensors_are_read),
	    cmocka_unit_test(it_ends_at_rest_and_without_power),
	    cmocka_unit_test(the_end_may_come_at_any_time),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

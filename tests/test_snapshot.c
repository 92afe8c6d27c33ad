/* Law L7: a session cut anywhere goes on from its snapshot as if it had not been cut: the same rows, bit for bit, and the same
 * snapshots later on, whichever scanner it has. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include "drivers/clock_filter.h"
#include "drivers/device_clock.h"
#include "tests/fuzz_state.h"
#include "tests/rig_robot.h"

enum { SNAPSHOT_MAX = 4 << 20, ROWS_MAX = 1 << 16, EVERY = 3, SELDOM = 11 };

/* What came out of a pipeline: a hash for each row, and for what else happened between them. */
struct seen {
	uint64_t hash[ROWS_MAX];
	size_t n;
};

static void mix(uint64_t *hash, const void *data, size_t len)
{
	for (size_t i = 0; i < len; i++)
		*hash = (*hash ^ ((const uint8_t *)data)[i]) * 0x100000001b3u;
}

static void see(struct seen *seen, uint64_t hash)
{
	assert_true(seen->n < ROWS_MAX);
	seen->hash[seen->n++] = hash;
}

static bool see_row(void *ctx, struct row *row)
{
	uint64_t hash = row->raster * 2 + row->starts_sweep;

	mix(&hash, &row->number, sizeof row->number);
	mix(&hash, &row->t_ns, sizeof row->t_ns);
	mix(&hash, &row->tilt_rad, sizeof row->tilt_rad);
	mix(&hash, &row->first_rad, 2 * sizeof row->first_rad);
	for (uint32_t i = 0; i < row->n; i++) {
		mix(&hash, &row->beam[i].origin, 2 * sizeof row->beam[i].origin);
		mix(&hash, &row->beam[i].range_m, sizeof row->beam[i].range_m);
		mix(&hash, &row->beam[i].state, 1);
	}
	see(ctx, hash);
	row_destroy(row);
	return true;
}

static void see_not_applied(void *ctx, uint64_t number, const char *reason)
{
	uint64_t hash = number;

	mix(&hash, reason, strlen(reason));
	see(ctx, hash);
}

static void see_flush(void *ctx)
{
	see(ctx, 1);
}

static struct pipeline *open_pipeline(const struct session *s, struct seen *seen)
{
	const struct pipeline_sink sink = {
	    .ctx = seen, .row = see_row, .not_applied = see_not_applied, .flush = see_flush};
	struct pipeline *pipeline = pipeline_create(&s->config, &sink);

	assert_non_null(pipeline);
	seen->n = 0;
	return pipeline;
}

static size_t save(struct pipeline *pipeline, uint8_t *bytes)
{
	char error[160];
	struct state s;

	state_save(&s, bytes, SNAPSHOT_MAX);
	pipeline_state(pipeline, &s, error);
	assert_true(state_done(&s));
	return s.at;
}

static void load(struct pipeline *pipeline, const uint8_t *bytes, size_t len)
{
	char error[160] = "";
	struct state s;

	state_load(&s, bytes, len);
	pipeline_state(pipeline, &s, error);
	if (!state_done(&s))
		fail_msg("a snapshot of %zu bytes is refused: %s", len, error);
}

/* Each stretch between two cuts is fed twice: to a pipeline that saw all before it, and to one that saw its snapshot only. Rows
 * and the snapshots at the end of the stretch have to agree; so, by induction, every later one does. */
static void goes_on_from_every_cut(const struct session *s, const char *name, size_t every)
{
	static uint8_t before[SNAPSHOT_MAX], after[SNAPSHOT_MAX], again[SNAPSHOT_MAX];
	static struct seen whole, part;
	struct pipeline *pipeline = open_pipeline(s, &whole);
	size_t len = save(pipeline, before), most = 0, cuts = 0, rows = 0;

	for (size_t from = 0; from < s->entries; from += every, cuts++) {
		const size_t to = from + every < s->entries ? from + every : s->entries;
		struct pipeline *fresh = open_pipeline(s, &part);

		load(fresh, before, len);
		assert_int_equal(save(fresh, again), len);
		assert_memory_equal(again, before, len);
		whole.n = 0;
		for (size_t i = from; i < to; i++) {
			session_feed(&s->entry[i], pipeline);
			session_feed(&s->entry[i], fresh);
		}
		assert_int_equal(part.n, whole.n);
		assert_memory_equal(part.hash, whole.hash, whole.n * sizeof *whole.hash);
		len = save(pipeline, after);
		assert_int_equal(save(fresh, again), len);
		assert_memory_equal(again, after, len);
		memcpy(before, after, len);
		pipeline_destroy(fresh);
		rows += whole.n;
		most = len > most ? len : most;
	}
	assert_true(rows > 100);
	printf("note: %s: %zu cuts, %zu rows, snapshots of %zu bytes at most\n", name, cuts, rows, most);
	pipeline_destroy(pipeline);
}

/* From a few cuts on to the very end: no stretch is too short to show what was forgotten. */
static void goes_on_to_the_end(const struct session *s)
{
	static uint8_t bytes[SNAPSHOT_MAX];
	static struct seen whole, part;

	for (size_t cut = s->entries / 7; cut < s->entries; cut += s->entries / 7) {
		struct pipeline *pipeline = open_pipeline(s, &whole), *fresh = open_pipeline(s, &part);

		for (size_t i = 0; i < cut; i++)
			session_feed(&s->entry[i], pipeline);
		load(fresh, bytes, save(pipeline, bytes));
		whole.n = 0;
		for (size_t i = cut; i < s->entries; i++) {
			session_feed(&s->entry[i], pipeline);
			session_feed(&s->entry[i], fresh);
		}
		pipeline_end(pipeline);
		pipeline_end(fresh);
		assert_int_equal(part.n, whole.n);
		assert_memory_equal(part.hash, whole.hash, whole.n * sizeof *whole.hash);
		pipeline_destroy(fresh);
		pipeline_destroy(pipeline);
	}
}

static void check(struct session *s, const char *name)
{
	goes_on_from_every_cut(s, name, EVERY);
	goes_on_to_the_end(s);
	session_finish(s);
}

static void keep_lms2xx(struct session *s, const char *laser, uint64_t seed, bool indices, double seconds)
{
	const struct scene scene = {.ctx = s, .scan = session_scan};
	const struct sim_lms2xx_params params = {.baud = 38400, .mode = 0x05, .millimetres = true, .indices = indices};
	struct sim_device brain;

	*s = (struct session){.random = seed};
	session_configure(s, laser);
	assert_int_equal(sim_lms2xx_create(&params, &scene, SESSION_START_NS, &brain), 0);
	session_run(s, brain, seconds);
}

static void lms2xx_session(const char *laser, uint64_t seed)
{
	struct session s;

	keep_lms2xx(&s, laser, seed, seed == 2, 20);
	assert_true(s.streams >= 3); /* it streamed, was cut off, and streamed again */
	check(&s, laser);
}

static void an_lms2xx_session_goes_on_from_any_snapshot(void **state)
{
	(void)state;
	lms2xx_session("driver: lms2xx, port: /dev/null, baud: 500000, variant: 180/0.5, tilt: servo", 1);
	lms2xx_session("driver: lms2xx, port: /dev/null, baud: 500000, variant: 180/0.25, tilt: servo", 2);
}

static double encoder_angle(void *ctx, int64_t t_ns)
{
	(void)ctx;
	return session_angle(t_ns);
}

/* Its clock runs 150 ppm fast and is about to wrap; telegrams are cut as TCP was seen to cut them. */
static void keep_cola(struct session *s, const char *laser, enum sim_cola_model_id model, double seconds)
{
	const struct sim_cola_params params = {.model = model,
	                                       .segments = true,
	                                       .start_us = UINT32_MAX - 3000000,
	                                       .drift_ppm = 150,
	                                       .ticks_per_rad = 10000,
	                                       .angle = encoder_angle};
	const struct scene scene = {.ctx = s, .scan = session_scan};
	struct sim_device brain;

	*s = (struct session){.random = (uint64_t)model + 7};
	session_configure(s, laser);
	assert_int_equal(sim_cola_create(&params, &scene, SESSION_START_NS, &brain), 0);
	session_run(s, brain, seconds);
}

static void cola_session(const char *laser, enum sim_cola_model_id model)
{
	struct session s;

	keep_cola(&s, laser, model, 12);
	assert_true(s.streams >= 3);
	check(&s, laser);
}

static void a_cola_session_goes_on_from_any_snapshot(void **state)
{
	(void)state;
	cola_session("driver: tim, connect: 192.168.0.1, tilt: servo", SIM_TIM571);
	cola_session("driver: lms1xx, connect: 192.168.0.1, tilt: servo", SIM_LMS111);
	cola_session("driver: lms5xx, connect: 192.168.0.1, tilt: laser, encoder: {scale: 0.0001}", SIM_LMS511);
}

/* Robots: the list is kept in the rig, where drivers command servos and read wheels themselves. */

static void append(struct session *s, struct session_entry entry)
{
	if (s->entries == s->cap) {
		s->cap = s->cap ? 2 * s->cap : 1024;
		s->entry = realloc(s->entry, s->cap * sizeof *s->entry);
		assert_non_null(s->entry);
	}
	s->entry[s->entries++] = entry;
}

static void ignore_begin(void *ctx, const void *snapshot, size_t len)
{
	(void)ctx;
	(void)snapshot;
	(void)len;
}

static void keep_record(void *ctx, const struct record *record)
{
	struct session_entry entry = {.kind = ENTRY_RECORD, .record = *record};
	uint8_t *own = malloc(record->len ? record->len : 1);

	assert_non_null(own);
	if (record->len > 0)
		memcpy(own, record->bytes, record->len);
	entry.record.bytes = own;
	append(ctx, entry);
}

static void keep_tick(void *ctx, int64_t log_ns)
{
	append(ctx, (struct session_entry){.kind = ENTRY_TICK, .ns = log_ns});
}

static void keep_clock(void *ctx, int64_t ahead_ns)
{
	append(ctx, (struct session_entry){.kind = ENTRY_CLOCK, .ns = ahead_ns});
}

static void trouble(struct rig *rig, const char *device, const char *kind, double value)
{
	if (!rig_fault(rig, device, kind, value, true))
		fail_msg("nobody knows the fault \"%s\"", kind);
	rig_run(rig, 400 * RIG_MS);
	rig_fault(rig, device, kind, value, false);
	rig_run(rig, 1100 * RIG_MS);
}

/* Set up, swept, in trouble, the wall clock set, and back. */
static void keep_robot(struct session *s, const struct robot_params *params)
{
	struct rig *rig = robot_create(params);
	struct config_error error;
	const bool modbus = params->servo == ROBOT_RTU || params->servo == ROBOT_TCP;
	const struct rig_keeper keeper = {
	    .journal = {
	        .ctx = s, .begin = ignore_begin, .record = keep_record, .tick = keep_tick, .clock = keep_clock}};

	*s = (struct session){0};
	assert_int_equal(config_read(robot_yaml(), strlen(robot_yaml()), "robot", &s->config, &error), 0);
	rig_keep(rig, &keeper);
	rig_start(rig);
	rig_run(rig, 2500 * RIG_MS);
	trouble(rig, "servo", modbus ? params->servo == ROBOT_RTU ? "crc" : "refuse" : "bus-off", 0);
	trouble(rig, "servo", modbus ? "jitter" : "overrun", modbus ? 20 : 0.2);
	trouble(rig, "wheels", "short", 0);
	trouble(rig, "wheels", "no poses", 0);
	trouble(rig, "servo", "wall clock", 3600);
	rig_destroy(rig);
}

static void a_robot_s_session_goes_on_from_any_snapshot(void **state)
{
	static const enum robot_servo servos[] = {ROBOT_CAN, ROBOT_CYCLIC, ROBOT_INCLINOMETER, ROBOT_RTU};

	(void)state;
	for (size_t i = 0; i < sizeof(servos) / sizeof(servos[0]); i++) {
		struct session s;

		keep_robot(
		    &s, &(struct robot_params){.servo = servos[i], .odometry = true, .rig = {.seed = 3, .thin = 40}});
		goes_on_from_every_cut(&s, robot_servo_name(servos[i]), SELDOM);
		goes_on_to_the_end(&s);
		session_finish(&s);
	}
}

/* Seeds for fuzz_state: small snapshots, and what comes after them. */

static void write_seed(const char *dir, const char *name, int which, const struct state *s, const void *rest,
                       size_t len)
{
	const uint8_t head[3] = {(uint8_t)which, (uint8_t)s->at, (uint8_t)(s->at >> 8)};
	char path[512];
	FILE *file;

	assert_true(state_done(s) && s->at < 65536);
	snprintf(path, sizeof path, "%s/%s", dir, name);
	file = fopen(path, "wb");
	assert_non_null(file);
	fwrite(head, 1, sizeof head, file);
	fwrite(s->bytes, 1, s->at, file);
	fwrite(rest, 1, len, file);
	fclose(file);
}

static void ignore_profile(void *ctx, int device, const struct profile *profile)
{
	(void)ctx;
	(void)device;
	(void)profile;
}

static void ignore_tilt(void *ctx, int device, const struct tilt *tilt)
{
	(void)ctx;
	(void)device;
	(void)tilt;
}

static void ignore_pose(void *ctx, int device, const struct pose *pose)
{
	(void)ctx;
	(void)device;
	(void)pose;
}

static void seed_of_device(const char *dir, const struct session *s, int from, int which, size_t cut)
{
	const struct driver *driver = driver_find(s->config.device[from].driver);
	struct decoder *decoder = driver->decoder_create(&s->config.device[from], from);
	const struct record_sink sink = {.profile = ignore_profile, .tilt = ignore_tilt, .pose = ignore_pose};
	static uint8_t bytes[SNAPSHOT_MAX], rest[4096];
	size_t at = 0, len = 0;
	struct state state;
	char name[64];

	for (; at < cut; at++)
		if (s->entry[at].kind == ENTRY_RECORD && s->entry[at].record.device == from)
			driver->decode(decoder, &s->entry[at].record, &sink);
	state_save(&state, bytes, sizeof bytes);
	driver->state(decoder, &state);
	for (; at < s->entries && len < 1500; at++) {
		const struct record *record = &s->entry[at].record;
		const size_t pieces = (record->len + 15) / 16;

		if (s->entry[at].kind != ENTRY_RECORD || record->device != from || pieces > 63)
			continue;
		rest[len++] = (uint8_t)(pieces | (size_t)record->direction << 6);
		memset(rest + len, 0, 16 * pieces);
		memcpy(rest + len, record->bytes, record->len);
		len += 16 * pieces;
	}
	snprintf(name, sizeof name, "%s-%zu", s->config.device[from].driver, cut);
	write_seed(dir, name, which, &state, rest, len);
	driver->decoder_destroy(decoder);
}

static void seeds_of_sweep(const char *dir, bool fixed)
{
	static const uint8_t rest[] = {0x40, 0x41, 0x82, 0x44, 0x45, 0x06, 0x48, 0x49, 0x0e, 0x16, 0x1e, 0x4c,
	                               0x4d, 0x02, 0x12, 0x50, 0x51, 0x54, 0x55, 0xf2, 0xf6, 0x58, 0x59};
	static struct profile profile;
	static uint8_t bytes[SNAPSHOT_MAX];

	for (int n = 0; n < 12; n += 3) {
		struct sweep *sweep = sweep_create(fuzz_state_params(fixed));
		const int64_t t_ns = FUZZ_STATE_T_NS - 50 * SESSION_STEP_NS;
		struct row *row = NULL;
		enum sweep_drop drop;
		struct state state;
		char name[64];

		for (int i = 0; i < n; i++) {
			sweep_tilt(sweep, &(struct tilt){t_ns + i * SESSION_STEP_NS, 0.01 * i});
			sweep_pose(sweep, &(struct pose){
			                      t_ns + i * SESSION_STEP_NS, {0.01 * i, 0, 0}, {1, 0, 0, 0}, 0, 0, false});
		}
		for (int i = 0; i < n; i++)
			sweep_profile(sweep,
			              fuzz_state_profile(&profile, t_ns + (3 + i) * SESSION_STEP_NS, (uint8_t)(4 + i)),
			              t_ns + 20 * SESSION_STEP_NS);
		if (n > 0 && sweep_next(sweep, t_ns + 60 * SESSION_STEP_NS, false, &row, &drop) == SWEEP_ROW)
			row_destroy(row);
		state_save(&state, bytes, sizeof bytes);
		sweep_state(&state, sweep);
		snprintf(name, sizeof name, "sweep-%d-%d", fixed, n);
		write_seed(dir, name, fixed ? FUZZ_STATE_SWEEP_FIXED : FUZZ_STATE_SWEEP, &state, rest, sizeof rest);
		sweep_destroy(sweep);
	}
}

static void seeds_of_clocks(const char *dir)
{
	static const uint8_t rest[] = {66, 66, 67, 66, 65, 66, 133, 66, 66, 0, 66, 255, 255, 66, 66, 3, 66, 66, 66};
	static uint8_t bytes[SNAPSHOT_MAX];
	struct clock_filter filter;
	struct device_clock clock;
	struct state state;

	clock_filter_init(&filter, FUZZ_STATE_TURN_NS);
	device_clock_init(&clock, 1000, INT64_C(1) << 32, 500e-6);
	for (int i = 0; i < 20; i++) {
		const int64_t t_ns = FUZZ_STATE_T_NS - (40 - i) * FUZZ_STATE_TURN_NS;

		clock_filter_stamp(&filter, t_ns + i % 3 * 1000000, 1);
		device_clock_stamp(&clock, (uint32_t)(i * 13333), t_ns + i % 3 * 1000000);
		if (i % 10 != 9)
			continue;
		state_save(&state, bytes, sizeof bytes);
		clock_filter_state(&state, &filter);
		write_seed(dir, i < 10 ? "filter-10" : "filter-20", FUZZ_STATE_FILTER, &state, rest, sizeof rest);
		state_save(&state, bytes, sizeof bytes);
		device_clock_state(&state, &clock);
		write_seed(dir, i < 10 ? "clock-10" : "clock-20", FUZZ_STATE_CLOCK, &state, rest, sizeof rest);
	}
}

static int write_seeds(const char *dir)
{
	struct session s;

	keep_lms2xx(&s, "driver: lms2xx, port: /dev/null, baud: 500000, variant: 180/0.5, tilt: servo", 1, true, 6);
	for (size_t cut = 0; cut < s.entries; cut += s.entries / 4) {
		seed_of_device(dir, &s, SESSION_LASER, FUZZ_STATE_LASER, cut);
		seed_of_device(dir, &s, SESSION_SERVO, FUZZ_STATE_SERVO, cut);
		seed_of_device(dir, &s, SESSION_POSE, FUZZ_STATE_POSE, cut);
	}
	session_finish(&s);
	keep_cola(&s, "driver: tim, connect: 192.168.0.1, tilt: servo", SIM_TIM561, 4);
	for (size_t cut = 0; cut < s.entries; cut += s.entries / 4)
		seed_of_device(dir, &s, SESSION_LASER, FUZZ_STATE_TIM, cut);
	session_finish(&s);
	keep_cola(&s, "driver: lms5xx, connect: 192.168.0.1, tilt: laser, encoder: {scale: 0.0001}", SIM_LMS511, 4);
	for (size_t cut = 0; cut < s.entries; cut += s.entries / 4)
		seed_of_device(dir, &s, SESSION_LASER, FUZZ_STATE_LMS5XX, cut);
	session_finish(&s);
	seeds_of_sweep(dir, false);
	seeds_of_sweep(dir, true);
	seeds_of_clocks(dir);
	return 0;
}

int main(int argc, char **argv)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(an_lms2xx_session_goes_on_from_any_snapshot),
	    cmocka_unit_test(a_cola_session_goes_on_from_any_snapshot),
	    cmocka_unit_test(a_robot_s_session_goes_on_from_any_snapshot),
	};

	if (argc == 3 && strcmp(argv[1], "seeds") == 0)
		return write_seeds(argv[2]);
	return cmocka_run_group_tests(tests, NULL, NULL);
}

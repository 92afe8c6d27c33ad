/* Law L7: a session cut anywhere goes on from its snapshot as if it had not been cut: the same rows, bit for bit, and the same
 * snapshots later on, whichever scanner it has. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include "tests/cola_telegrams.h"
#include "tests/session.h"

enum { SNAPSHOT_MAX = 4 << 20, ROWS_MAX = 1 << 16, EVERY = 3 };

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
static void goes_on_from_every_cut(const struct session *s, const char *name)
{
	static uint8_t before[SNAPSHOT_MAX], after[SNAPSHOT_MAX], again[SNAPSHOT_MAX];
	static struct seen whole, part;
	struct pipeline *pipeline = open_pipeline(s, &whole);
	size_t len = save(pipeline, before), most = 0, cuts = 0, rows = 0;

	for (size_t from = 0; from < s->entries; from += EVERY, cuts++) {
		const size_t to = from + EVERY < s->entries ? from + EVERY : s->entries;
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
	assert_true(rows > 300);
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
	goes_on_from_every_cut(s, name);
	goes_on_to_the_end(s);
	session_finish(s);
}

static void lms2xx_session(const char *laser, uint64_t seed, bool indices, double seconds)
{
	struct session s = {.random = seed};
	const struct scene scene = {.ctx = &s, .scan = session_scan};
	const struct sim_lms2xx_params params = {.baud = 38400, .mode = 0x05, .millimetres = true, .indices = indices};
	struct sim_device brain;

	session_configure(&s, laser);
	assert_int_equal(sim_lms2xx_create(&params, &scene, SESSION_START_NS, &brain), 0);
	session_run(&s, brain, seconds);
	assert_true(s.streams >= 3); /* it streamed, was cut off, and streamed again */
	check(&s, laser);
}

static void an_lms2xx_session_goes_on_from_any_snapshot(void **state)
{
	(void)state;
	lms2xx_session("driver: lms2xx, port: /dev/null, baud: 500000, variant: 180/0.5, tilt: servo", 1, false, 14);
	lms2xx_session("driver: lms2xx, port: /dev/null, baud: 500000, variant: 180/0.25, tilt: servo", 2, false, 14);
}

/* A scanner that sends and never answers: its telegrams are all that its decoder remembers. Scans are lost now and then, its
 * clock runs 150 ppm fast and wraps, and it is switched off and on in the middle. */
struct talker {
	struct session *s;
	enum cola_dialect dialect;
	struct cola_scan scan;
	int64_t period_ns, next_ns, on_ns;
	uint32_t start_us;
	bool due;
};

static void talker_receive(void *ctx, const uint8_t *bytes, size_t len, int64_t t_ns)
{
	(void)ctx;
	(void)bytes;
	(void)len;
	(void)t_ns;
}

static void talker_connected(void *ctx, bool yes, int64_t t_ns)
{
	struct talker *talker = ctx;

	if (!yes)
		return;
	talker->on_ns = t_ns;
	talker->next_ns = t_ns + talker->period_ns;
	talker->start_us += 0x40000000;
}

static void talker_advance(void *ctx, int64_t t_ns)
{
	struct talker *talker = ctx;
	struct cola_scan *scan = &talker->scan;

	if (t_ns < talker->next_ns)
		return;
	scan->t_startup_us = talker->start_us + (uint32_t)((talker->next_ns - talker->on_ns) / 1000 * 100015 / 100000);
	scan->t_transmit_us = scan->t_startup_us + 4000;
	scan->scan_counter++;
	scan->telegram_counter++;
	scan->encoder[0].ticks = (uint32_t)(1000000 + session_angle(t_ns) * 1000);
	talker->due = session_random(talker->s, 30) != 0;
	talker->next_ns += talker->period_ns;
}

static size_t talker_transmit(void *ctx, uint8_t *bytes, size_t cap)
{
	struct talker *talker = ctx;

	if (!talker->due)
		return 0;
	talker->due = false;
	return telegram_scan(talker->dialect, "sSN LMDscandata", &talker->scan, 2000, 3, bytes, cap);
}

static void talker_destroy(void *ctx)
{
	(void)ctx;
}

static void cola_session(const char *laser, enum cola_dialect dialect, int encoders, double seconds)
{
	struct session s = {.random = (uint64_t)dialect + 7};
	struct talker talker = {.s = &s, .dialect = dialect, .scan = telegram_tim(), .period_ns = 20000000};
	const struct sim_device brain = {.ctx = &talker,
	                                 .receive = talker_receive,
	                                 .advance = talker_advance,
	                                 .transmit = talker_transmit,
	                                 .connected = talker_connected,
	                                 .destroy = talker_destroy};

	talker.start_us = UINT32_MAX - 3000000 - 0x40000000;
	talker.scan.frequency_chz = 5000;
	talker.scan.encoders = encoders;
	session_configure(&s, laser);
	session_run(&s, brain, seconds);
	check(&s, laser);
}

static void a_cola_session_goes_on_from_any_snapshot(void **state)
{
	(void)state;
	cola_session("driver: tim, connect: 192.168.0.1, tilt: servo", COLA_A, 0, 9);
	cola_session("driver: lms1xx, connect: 192.168.0.1, tilt: servo", COLA_B, 0, 9);
	cola_session("driver: lms5xx, connect: 192.168.0.1, tilt: laser, encoder: {scale: 0.001}", COLA_B, 1, 9);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(an_lms2xx_session_goes_on_from_any_snapshot),
	    cmocka_unit_test(a_cola_session_goes_on_from_any_snapshot),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

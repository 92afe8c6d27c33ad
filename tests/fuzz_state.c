/* Law L8: whatever stands in a snapshot, neither loading it nor going on from it crashes, hangs or writes outside; what was
 * taken is saved the same again, and what was refused left its module as new.
 *
 * Input: a byte (which module), two bytes (length, little-endian), so many bytes of snapshot; the rest is read as what
 * comes then: records for a decoder (each a byte of length and direction, then its bytes), samples and profiles for the
 * assembler, arrivals for the clocks. Seeds: build/tests/test_snapshot seeds DIR. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "drivers/clock_filter.h"
#include "drivers/device_clock.h"
#include "tests/fuzz_state.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

enum { SNAPSHOT_MAX = 1 << 22, MS = 1000000 };

static void must(bool condition)
{
	if (!condition)
		abort();
}

/* A module under test: loads or saves, and is fed. */
struct subject {
	void *module;
	void (*state)(void *module, struct state *);
	void (*feed)(void *module, const uint8_t *data, size_t size);
};

static size_t save(const struct subject *subject, uint8_t *bytes)
{
	struct state s;

	state_save(&s, bytes, SNAPSHOT_MAX);
	subject->state(subject->module, &s);
	must(state_done(&s));
	return s.at;
}

/* What stands behind a good snapshot is the caller's business. */
static bool load(const struct subject *subject, const uint8_t *bytes, size_t len)
{
	struct state s;

	state_load(&s, bytes, len);
	subject->state(subject->module, &s);
	return !s.failed;
}

static void try_snapshot(const struct subject *subject, const uint8_t *data, size_t len, const uint8_t *rest,
                         size_t size)
{
	static uint8_t fresh[SNAPSHOT_MAX], once[SNAPSHOT_MAX], twice[SNAPSHOT_MAX];
	const size_t fresh_len = save(subject, fresh);
	const bool taken = load(subject, data, len);
	const size_t once_len = save(subject, once);

	if (taken) {
		must(load(subject, once, once_len));
		must(save(subject, twice) == once_len && memcmp(once, twice, once_len) == 0);
	} else {
		must(once_len == fresh_len && memcmp(once, fresh, fresh_len) == 0);
	}
	subject->feed(subject->module, rest, size);
}

/* Decoders */

static struct {
	const struct driver *driver;
	struct decoder *decoder;
} device;

static void take_profile(void *ctx, int index, const struct profile *p)
{
	(void)ctx;
	(void)index;
	must(p->n <= PROFILE_BEAMS_MAX);
	for (int i = 0; i < p->n; i++)
		must(p->state[i] < BEAM_STATES);
}

static void take_tilt(void *ctx, int index, const struct tilt *tilt)
{
	(void)ctx;
	(void)index;
	must(tilt->angle_rad - tilt->angle_rad == 0);
}

static void take_pose(void *ctx, int index, const struct pose *pose)
{
	(void)ctx;
	(void)index;
	must(pose->position_m.x - pose->position_m.x == 0);
}

static void decoder_state(void *module, struct state *s)
{
	(void)module;
	device.driver->state(device.decoder, s);
}

static void decoder_feed(void *module, const uint8_t *data, size_t size)
{
	const struct record_sink sink = {.profile = take_profile, .tilt = take_tilt, .pose = take_pose};
	int64_t t_ns = FUZZ_STATE_T_NS;
	struct decoder_counters counters;
	struct decoder_timing timing;

	(void)module;
	for (size_t at = 0; at < size;) {
		const uint8_t head = data[at++];
		const size_t want = (size_t)(head & 63) * 16, len = want < size - at ? want : size - at;
		const struct record record = {.log_ns = t_ns,
		                              .t_ns = t_ns,
		                              .direction = (enum direction)((head >> 6) % 3),
		                              .bytes = data + at,
		                              .len = len};

		device.driver->decode(device.decoder, &record, &sink);
		at += len;
		t_ns += 13 * MS;
	}
	device.driver->counters(device.decoder, &counters);
	if (device.driver->timing)
		device.driver->timing(device.decoder, &timing);
}

/* The assembler */

static void assembler_state(void *module, struct state *s)
{
	sweep_state(s, module);
}

static void drain(struct sweep *sweep, int64_t log_ns, bool end)
{
	struct row *row = NULL;
	enum sweep_drop drop;

	for (uint32_t i = 0;; i++) {
		enum sweep_verdict verdict = sweep_next(sweep, log_ns, end, &row, &drop);

		must(i < (1u << 21));
		if (verdict == SWEEP_WAIT)
			return;
		if (verdict == SWEEP_ROW)
			row_destroy(row);
	}
}

static void assembler_feed(void *module, const uint8_t *data, size_t size)
{
	static struct profile profile;
	int64_t t_ns = FUZZ_STATE_T_NS;

	for (size_t i = 0; i < size; i++, t_ns += 3 * MS) {
		const uint8_t kind = data[i] & 3, value = data[i] >> 2;

		if (kind == 0)
			sweep_tilt(module, &(struct tilt){t_ns, value * 0.01});
		else if (kind == 1)
			sweep_pose(module, &(struct pose){t_ns, {value * 0.02, 0, 0}, {1, 0, 0, 0}, 0, 0, value == 60});
		else
			sweep_profile(module, fuzz_state_profile(&profile, t_ns, value), t_ns);
		drain(module, t_ns, false);
	}
	drain(module, t_ns, true);
}

/* Clocks */

static void filter_state(void *module, struct state *s)
{
	clock_filter_state(s, module);
}

static void filter_feed(void *module, const uint8_t *data, size_t size)
{
	int64_t t_ns = FUZZ_STATE_T_NS;

	for (size_t i = 0; i < size; i++) {
		t_ns += data[i] * INT64_C(200000);
		clock_filter_stamp(module, t_ns, 1 + data[i] % 4);
	}
}

static void clock_state(void *module, struct state *s)
{
	device_clock_state(s, module);
}

static void clock_feed(void *module, const uint8_t *data, size_t size)
{
	int64_t t_ns = FUZZ_STATE_T_NS, p50_ns, p99_ns;
	uint32_t tick = 12345;

	for (size_t i = 0; i < size; i++) {
		t_ns += data[i] * INT64_C(200000);
		tick += (uint32_t)data[i] * (data[i] == 255 ? 100000 : 200);
		device_clock_stamp(module, tick, t_ns);
		device_clock_at(module, tick + 1000);
	}
	device_clock_jitter(module, &p50_ns, &p99_ns);
}

static void try_decoder(uint8_t which, const uint8_t *data, size_t len, const uint8_t *rest, size_t size)
{
	static struct session session;
	const struct subject subject = {NULL, decoder_state, decoder_feed};

	fuzz_state_configure(&session);
	device.driver = driver_find(session.config.device[which].driver);
	device.decoder = device.driver->decoder_create(&session.config.device[which], which);
	must(device.decoder != NULL && device.driver->state != NULL);
	try_snapshot(&subject, data, len, rest, size);
	device.driver->decoder_destroy(device.decoder);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	if (size < 3)
		return 0;
	const size_t want = (size_t)(data[1] | data[2] << 8), len = want < size - 3 ? want : size - 3;
	const uint8_t which = data[0] % FUZZ_STATE_KINDS, *snapshot = data + 3, *rest = snapshot + len;
	const size_t rest_len = size - 3 - len;

	if (which < FUZZ_STATE_SWEEP) {
		try_decoder(which, snapshot, len, rest, rest_len);
	} else if (which == FUZZ_STATE_SWEEP || which == FUZZ_STATE_SWEEP_FIXED) {
		struct sweep *sweep = sweep_create(fuzz_state_params(which == FUZZ_STATE_SWEEP_FIXED));

		must(sweep != NULL);
		try_snapshot(&(struct subject){sweep, assembler_state, assembler_feed}, snapshot, len, rest, rest_len);
		sweep_destroy(sweep);
	} else if (which == FUZZ_STATE_FILTER) {
		struct clock_filter filter;

		clock_filter_init(&filter, FUZZ_STATE_TURN_NS);
		try_snapshot(&(struct subject){&filter, filter_state, filter_feed}, snapshot, len, rest, rest_len);
	} else {
		struct device_clock clock;

		device_clock_init(&clock, 1000, INT64_C(1) << 32, 500e-6);
		try_snapshot(&(struct subject){&clock, clock_state, clock_feed}, snapshot, len, rest, rest_len);
	}
	return 0;
}

/* Law L7: what the loop handled is in a recording, byte for byte and in its order, and comes back as a pipeline wants it; of a
 * file that is cut or damaged anywhere, every whole chunk. */
#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "daemon/recording.h"
#include "tests/scarce.h"

#define START_NS INT64_C(1700000000000000000)

static const char config_text[] =
    "devices:\n"
    "  - {name: laser, driver: lms2xx, port: /dev/null, tilt: servo}\n"
    "  - {name: servo, driver: modbus, connect: \"127.0.0.1:502\", position: {function: 3, "
    "address: 1, type: i16, scale: 0.01deg}}\n"
    "  - {name: axis, driver: can, connect: can0, angle: {id: 0x100, start: 0, length: 16, "
    "scale: 0.01deg}}\n"
    "  - {name: pose, driver: pose, listen: \"unix:/tmp/none\"}\n";

static struct config config;

static int read_config(void **state)
{
	struct config_error error;

	(void)state;
	if (config_read(config_text, strlen(config_text), "test", &config, &error) < 0)
		fail_msg("%s", error.text);
	return 0;
}

/* A session, the same every time: what is written is what must come back. */

enum { EVENTS_MAX = 4096, BYTES_MAX = 1 << 20 };

struct session {
	struct recording_event event[EVENTS_MAX]; /* as they must come back: skips before their record */
	size_t n;
	uint8_t bytes[BYTES_MAX]; /* what records point to */
	size_t used;
};

static struct session session;

static uint32_t seed;

static uint32_t roll(void)
{
	seed = seed * 1664525u + 1013904223u;
	return seed >> 8;
}

static const uint8_t *some_bytes(size_t len)
{
	uint8_t *at = session.bytes + session.used;

	assert_true(session.used + len <= sizeof(session.bytes));
	for (size_t i = 0; i < len; i++)
		at[i] = (uint8_t)roll();
	session.used += len;
	return at;
}

static void expect(struct recording_event event)
{
	assert_true(session.n < EVENTS_MAX);
	session.event[session.n++] = event;
}

static int must(int r)
{
	if (r < 0)
		fail_msg("%s", strerror(-r));
	return r;
}

static struct record some_record(int64_t log_ns)
{
	static const char *const poses[] = {"{\"position\":[1,2,3],\"orientation\":[0,0,0,1]}", "no JSON \x01\xff", ""};
	struct record record = {
	    log_ns, log_ns - roll() % 1000000, (int)(roll() % 4), (enum direction)(roll() % 3), NULL, 0};

	record.len = record.direction == LINK_OPENED ? 0 : roll() % 400;
	record.bytes = some_bytes(record.len);
	if (record.device == 3 && record.direction == FROM_DEVICE) {
		record.bytes = (const uint8_t *)poses[roll() % 3];
		record.len = strlen((const char *)record.bytes);
	}
	return record;
}

/* A record, tick or step of the clock, and perhaps rows that it completed and nobody applied. */
static void put_one(struct recording_writer *w, int64_t *log_ns, uint64_t *row)
{
	static const char event[] = "{\"class\":\"DEVICE\",\"name\":\"laser\",\"state\":\"streaming\"}";
	const unsigned skips = roll() % 8 == 0 ? 1 + roll() % 3 : 0;
	const bool tick = roll() % 8 == 0, tells = roll() % 16 == 0;
	struct record record;

	*log_ns += roll() % 3 * 1000000;
	record = some_record(*log_ns);
	for (unsigned i = 0; i < skips; i++)
		expect((struct recording_event){.kind = RECORDING_SKIP, .log_ns = *log_ns, .skip = *row + i});
	if (tick)
		must(recording_put_tick(w, *log_ns));
	else
		must(recording_put_record(w, &record));
	if (tick)
		expect((struct recording_event){.kind = RECORDING_TICK, .log_ns = *log_ns});
	else
		expect((struct recording_event){.kind = RECORDING_RECORD, .log_ns = *log_ns, .record = record});
	if (tells) {
		must(recording_put_event(w, event, strlen(event)));
		expect((struct recording_event){
		    .kind = RECORDING_EVENT, .log_ns = *log_ns, .json = {event, strlen(event)}});
	}
	for (unsigned i = 0; i < skips; i++)
		must(recording_put_skip(w, (*row)++, "queue full"));
	if (roll() % 64 == 0) {
		must(recording_put_clock(w, *log_ns - START_NS));
		expect((struct recording_event){
		    .kind = RECORDING_CLOCK, .log_ns = *log_ns, .ahead_ns = *log_ns - START_NS});
	}
}

static struct recording_begin some_begin(int64_t log_ns)
{
	struct recording_begin begin = {log_ns, "0123456789abcde", 3, true, 0xfedcba9876543210u, 7, NULL, 300};

	begin.snapshot = some_bytes(begin.len);
	return begin;
}

/* `records` of them in chunks of `chunk` bytes, two maps; without an end where `ends` is false. Empty when memory was out. */
static void write_session(unsigned records, size_t chunk, int level, bool ends, struct buffer *out)
{
	const struct recording_params params = {&config, config_text, "1.2", level};
	struct recording_begin begin;
	struct recording_writer *w;
	int64_t log_ns = START_NS;
	uint64_t row = 0;

	seed = 1;
	session.n = session.used = 0;
	begin = some_begin(log_ns);
	w = recording_writer_create(&params, &begin, out);
	assert_non_null(w);
	expect((struct recording_event){.kind = RECORDING_BEGIN, .log_ns = log_ns, .begin = begin});
	for (unsigned i = 0; i < records; i++) {
		if (mcap_writer_open_bytes(recording_writer_mcap(w)) > chunk)
			must(mcap_writer_close_chunk(recording_writer_mcap(w)));
		if (i == records / 2) {
			begin = some_begin(log_ns);
			begin.generation++;
			must(recording_put_begin(w, &begin));
			expect((struct recording_event){.kind = RECORDING_BEGIN, .log_ns = log_ns, .begin = begin});
		}
		put_one(w, &log_ns, &row);
	}
	if (ends)
		must(recording_end(w, "ended"));
	else
		must(mcap_writer_close_chunk(recording_writer_mcap(w)));
	recording_writer_destroy(w);
	assert_int_equal(out->error, 0);
}

static bool same_begin(const struct recording_begin *a, const struct recording_begin *b)
{
	return a->log_ns == b->log_ns && memcmp(a->map_id, b->map_id, 16) == 0 && a->generation == b->generation &&
	       a->whole == b->whole && a->session == b->session && a->part == b->part && a->len == b->len &&
	       memcmp(a->snapshot, b->snapshot, a->len) == 0;
}

static bool same_record(const struct record *a, const struct record *b)
{
	return a->log_ns == b->log_ns && a->t_ns == b->t_ns && a->device == b->device && a->direction == b->direction &&
	       a->len == b->len && (a->len == 0 || memcmp(a->bytes, b->bytes, a->len) == 0);
}

static bool same(const struct recording_event *a, const struct recording_event *b)
{
	if (a->kind != b->kind || a->log_ns != b->log_ns)
		return false;
	switch (a->kind) {
	case RECORDING_BEGIN:
		return same_begin(&a->begin, &b->begin);
	case RECORDING_SKIP:
		return a->skip == b->skip;
	case RECORDING_RECORD:
		return same_record(&a->record, &b->record);
	case RECORDING_CLOCK:
		return a->ahead_ns == b->ahead_ns;
	case RECORDING_EVENT:
		return a->json.len == b->json.len && memcmp(a->json.text, b->json.text, a->json.len) == 0;
	default:
		return true;
	}
}

static struct recording_reader *open_reader(const struct buffer *file)
{
	struct recording_reader *r = NULL;
	char error[160] = "";

	if (recording_reader_create(file->data, file->len, &r, error) < 0)
		fail_msg("%s", error);
	recording_reader_use(r, &config);
	return r;
}

static void what_was_handled_comes_back_byte_for_byte_with_skips_ahead_of_their_record(void **state)
{
	static const size_t chunks[] = {1, 3000, 1 << 20};

	(void)state;
	for (size_t k = 0; k < 3; k++)
		for (int level = 0; level < 2; level++) {
			struct buffer file = {0};
			struct recording_reader *r;
			struct recording_event event;
			size_t len;

			write_session(1000, chunks[k], level, true, &file);
			r = open_reader(&file);
			assert_memory_equal(recording_reader_config(r, &len), config_text, strlen(config_text));
			assert_int_equal(len, strlen(config_text));
			for (size_t i = 0; i < session.n; i++) {
				assert_int_equal(recording_reader_next(r, &event), 1);
				assert_true(same(&event, &session.event[i]));
				if (event.kind == RECORDING_RECORD)
					assert_string_equal(event.device, config.device[event.record.device].name);
			}
			assert_int_equal(recording_reader_next(r, &event), 1);
			assert_int_equal(event.kind, RECORDING_END);
			assert_int_equal(recording_reader_next(r, &event), 0);
			assert_true(mcap_reader_whole(recording_reader_mcap(r)));
			recording_reader_destroy(r);
			buffer_finish(&file);
		}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(what_was_handled_comes_back_byte_for_byte_with_skips_ahead_of_their_record),
	};

	return cmocka_run_group_tests(tests, read_config, NULL);
}

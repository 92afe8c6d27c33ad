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

/* How far the file was gone through, whatever is wrong with it: events must be those that were written, in order, with some
 * left out only where damage was told. How many came, and how many damages. */
static size_t expect_part(const struct buffer *file, unsigned *ret_damages)
{
	struct recording_reader *r = NULL;
	struct recording_event event;
	size_t at = 0, came = 0;
	char error[160];
	int got;

	*ret_damages = 0;
	got = recording_reader_create(file->data, file->len, &r, error);
	if (got == -EINVAL)
		return 0;
	assert_int_equal(got, 0);
	recording_reader_use(r, &config);
	while ((got = recording_reader_next(r, &event)) == 1) {
		if (event.kind == RECORDING_DAMAGED) {
			(*ret_damages)++;
			continue;
		}
		if (event.kind == RECORDING_END)
			continue;
		while (at < session.n && !same(&event, &session.event[at])) {
			assert_true(*ret_damages > 0);
			at++;
		}
		assert_true(at < session.n);
		at++;
		came++;
	}
	assert_int_equal(got, 0);
	recording_reader_destroy(r);
	return came;
}

static struct buffer copy_of(const struct buffer *file, size_t len)
{
	struct buffer copy = {0};

	buffer_append(&copy, file->data, len);
	return copy;
}

/* The ends of the chunks, where a kill leaves a file. */
static size_t chunk_ends(const struct buffer *file, size_t *ret_end, size_t *ret_events, size_t max)
{
	struct mcap_reader *r;
	struct mcap_item item;
	char error[160];
	size_t n = 0;

	assert_int_equal(mcap_reader_create(file->data, file->len, &r, error), 0);
	while (mcap_reader_next(r, &item) == 1)
		if (item.kind == MCAP_CHUNK && n < max) {
			ret_end[n] = item.end;
			ret_events[n++] = 0;
		}
	mcap_reader_destroy(r);
	for (size_t i = 0; i < n; i++) {
		struct buffer part = copy_of(file, ret_end[i]);
		unsigned damages;

		ret_events[i] = expect_part(&part, &damages);
		assert_int_equal(damages, 0);
		buffer_finish(&part);
	}
	return n;
}

static void a_file_cut_at_any_byte_gives_every_whole_chunk(void **state)
{
	struct buffer file = {0};
	size_t end[64], events[64], n;

	(void)state;
	write_session(40, 1000, 1, true, &file);
	n = chunk_ends(&file, end, events, 64);
	assert_true(n > 5);
	for (size_t len = 0; len < file.len; len++) {
		struct buffer part = copy_of(&file, len);
		size_t whole = 0, came;
		unsigned damages;

		while (whole < n && end[whole] <= len)
			whole++;
		came = expect_part(&part, &damages);
		assert_true(damages <= 2);
		assert_int_equal(came, whole == 0 ? 0 : events[whole - 1]);
		buffer_finish(&part);
	}
	assert_int_equal(events[n - 1], session.n);
	buffer_finish(&file);
}

static void a_changed_byte_costs_no_more_than_its_chunk(void **state)
{
	struct buffer file = {0};
	size_t most = 0, worst = 0;

	(void)state;
	write_session(80, 800, 1, true, &file);
	for (size_t at = MCAP_MAGIC; at < file.len; at += 3) {
		struct buffer part = copy_of(&file, file.len);
		unsigned damages;
		size_t came;

		part.data[at] ^= (uint8_t)(1 + at % 255);
		came = expect_part(&part, &damages);
		if (session.n - came > most) {
			most = session.n - came;
			worst = at;
		}
		buffer_finish(&part);
	}
	if (most == 0 || most >= session.n / 3)
		fail_msg("byte %zu of %zu costs %zu of %zu events", worst, file.len, most, session.n);
	printf("note: of %zu events at most %zu are lost with a byte of a file of %zu\n", session.n, most, file.len);
	buffer_finish(&file);
}

static void bytes_cut_out_or_put_in_cost_no_more_than_the_chunks_they_touch(void **state)
{
	struct buffer file = {0};

	(void)state;
	write_session(600, 2000, 1, true, &file);
	for (unsigned trial = 0; trial < 100; trial++) {
		const size_t at = 4000 + roll() % (file.len - 8000), n = 1 + roll() % 2000;
		struct buffer part = copy_of(&file, at);
		unsigned damages;

		if (trial % 2) { /* a hole */
			buffer_append(&part, file.data + at + n, file.len - at - n);
		} else {
			for (size_t i = 0; i < n; i++)
				buffer_append(&part, &(uint8_t){(uint8_t)roll()}, 1);
			buffer_append(&part, file.data + at, file.len - at);
		}
		assert_true(expect_part(&part, &damages) > session.n / 2);
		buffer_finish(&part);
	}
	buffer_finish(&file);
}

static void seeking_finds_the_first_chunk_that_reaches_the_time(void **state)
{
	struct buffer file = {0};
	struct mcap_reader *r, *walk;
	struct mcap_item item, chunk;
	char error[160];
	uint64_t first_ns, last_ns;

	(void)state;
	write_session(600, 2000, 1, true, &file);
	assert_int_equal(mcap_reader_create(file.data, file.len, &r, error), 0);
	assert_int_equal(mcap_reader_create(file.data, file.len, &walk, error), 0);
	assert_true(mcap_reader_span(r, &first_ns, &last_ns) > 10);
	assert_int_equal(first_ns, START_NS);
	for (uint64_t t_ns = first_ns; t_ns <= last_ns; t_ns += 7000000) {
		assert_int_equal(mcap_reader_seek(r, (int64_t)t_ns), 0);
		assert_int_equal(mcap_reader_next(r, &item), 1);
		assert_int_equal(item.kind, MCAP_CHUNK);
		mcap_reader_rewind(walk);
		do
			assert_int_equal(mcap_reader_next(walk, &chunk), 1);
		while (chunk.kind != MCAP_CHUNK || chunk.chunk.end_ns < t_ns);
		assert_int_equal(item.offset, chunk.offset);
		assert_int_equal(mcap_reader_next(r, &item), 1);
		assert_int_equal(item.kind, MCAP_MESSAGE);
	}
	assert_int_equal(mcap_reader_seek(r, (int64_t)last_ns + 1), 0);
	while (mcap_reader_next(r, &item) == 1)
		assert_true(item.kind != MCAP_MESSAGE);
	mcap_reader_destroy(walk);
	mcap_reader_destroy(r);
	buffer_finish(&file);
}

static void a_chunk_that_grows_beyond_its_word_is_refused_without_memory_for_it(void **state)
{
	struct buffer file = {0};
	unsigned damages;
	size_t end[64], events[64], n;
	uint64_t huge = UINT64_C(1) << 40;

	(void)state;
	write_session(120, 2000, 1, true, &file);
	n = chunk_ends(&file, end, events, 64);
	assert_true(n > 4);
	for (size_t at = 0; at + 32 < file.len; at++) /* the heads of all chunks lie */
		if (file.data[at] == 6 && memcmp(file.data + at + 9 + 28, "\4\0\0\0zstd", 8) == 0)
			memcpy(file.data + at + 9 + 16, &huge, 8);
	assert_int_equal(expect_part(&file, &damages), 0);
	buffer_finish(&file);
}

/* One call of an allocator after the other fails: no crash and no leak. (The JSON library may tell such an event as damaged.) */
static void memory_that_runs_out_anywhere_is_an_error_and_no_leak(void **state)
{
	const struct recording_params params = {&config, config_text, "1.2", 1};
	const struct recording_begin begin = {START_NS, "0123456789abcde", 3, true, 1, 0, "state", 5};
	struct record record = {START_NS, START_NS, 0, FROM_DEVICE, (const uint8_t *)"abc", 3};
	bool done = false;
	long n;

	(void)state;
	if (!SCARCE_WORKS)
		skip();
	for (n = 0; !done && n < 2000; n++) {
		const long before = scarce_live;
		struct buffer file = {0};
		struct recording_writer *w;
		struct recording_reader *r = NULL;
		struct recording_event event;
		char error[160];
		int got = -ENOMEM;

		scarce_left = n;
		w = recording_writer_create(&params, &begin, &file);
		if (w)
			got = recording_put_record(w, &record);
		if (got == 0)
			got = recording_put_skip(w, 1, "queue full");
		if (got == 0)
			got = recording_end(w, "ended");
		recording_writer_destroy(w);
		if (got == 0)
			got = recording_reader_create(file.data, file.len, &r, error);
		for (int i = 0; got >= 0 && i < 4; i++)
			got = recording_reader_next(r, &event);
		done = got == 1 && scarce_left > 0;
		scarce_left = -1;
		recording_reader_destroy(r);
		buffer_finish(&file);
		assert_int_equal(scarce_live, before);
	}
	assert_true(done && n > 20);
	printf("note: %ld allocations failed, each alone\n", n - 1);
}

static void what_is_no_recording_is_refused_with_a_sentence(void **state)
{
	struct recording_reader *r;
	struct buffer out = {0};
	struct mcap_writer *w;
	char error[160] = "";

	(void)state;
	assert_int_equal(recording_reader_create((const uint8_t *)"", 0, &r, error), -EINVAL);
	assert_non_null(strstr(error, "is empty"));
	assert_int_equal(recording_reader_create((const uint8_t *)"not a recording", 15, &r, error), -EINVAL);
	assert_non_null(strstr(error, "no MCAP"));
	w = mcap_writer_create(&(struct mcap_params){"other", 0}, &out);
	assert_int_equal(mcap_writer_channel(w, 0, "/other", "json", NULL, 0), 1);
	must(mcap_writer_message(w, &(struct mcap_message){1, 5, 5, "{}", 2, NULL, 0}));
	must(mcap_writer_end(w));
	mcap_writer_destroy(w);
	assert_int_equal(recording_reader_create(out.data, out.len, &r, error), -EINVAL);
	assert_non_null(strstr(error, "no recording of facetd"));
	buffer_finish(&out);
}

int main(int argc, char **argv)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(what_was_handled_comes_back_byte_for_byte_with_skips_ahead_of_their_record),
	    cmocka_unit_test(a_file_cut_at_any_byte_gives_every_whole_chunk),
	    cmocka_unit_test(a_changed_byte_costs_no_more_than_its_chunk),
	    cmocka_unit_test(bytes_cut_out_or_put_in_cost_no_more_than_the_chunks_they_touch),
	    cmocka_unit_test(seeking_finds_the_first_chunk_that_reaches_the_time),
	    cmocka_unit_test(a_chunk_that_grows_beyond_its_word_is_refused_without_memory_for_it),
	    cmocka_unit_test(memory_that_runs_out_anywhere_is_an_error_and_no_leak),
	    cmocka_unit_test(what_is_no_recording_is_refused_with_a_sentence),
	};

	if (argc > 1)
		cmocka_set_test_filter(argv[1]);
	return cmocka_run_group_tests(tests, read_config, NULL);
}

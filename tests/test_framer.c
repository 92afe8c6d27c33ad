/* Law: a telegram is found wherever it begins; what is no telegram costs one byte at a time and is counted by reason. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include <cmocka.h>

#include "drivers/framer.h"

#define LINE_BYTES 4096
static uint8_t line[LINE_BYTES];

enum { BAD_SUM = FRAMER_OWN };

/* A toy protocol: '<', length, that many bytes, their sum. '!' stands alone, at a boundary only. */
static int scan_toy(void *ctx, const uint8_t *buf, size_t len, bool boundary)
{
	(void)ctx;
	if (boundary && buf[0] == '!')
		return 1;
	if (buf[0] != '<')
		return -FRAMER_NO_START;
	if (len < 2 || len < (size_t)buf[1] + 3)
		return FRAMER_MORE;
	uint8_t sum = 0;
	for (unsigned i = 0; i < buf[1]; i++)
		sum = (uint8_t)(sum + buf[2 + i]);
	return sum == buf[2 + buf[1]] ? buf[1] + 3 : -BAD_SUM;
}

static int scan_greedy(void *ctx, const uint8_t *buf, size_t len, bool boundary)
{
	(void)ctx;
	(void)buf;
	(void)len;
	(void)boundary;
	return FRAMER_MORE;
}

/* All that comes out of `bytes`, pushed in pieces of `piece`, one after another with a '|' behind each. */
static size_t collect(struct framer *f, const uint8_t *bytes, size_t len, size_t piece, char *ret)
{
	size_t n = 0;
	for (size_t i = 0; i < len;) {
		const size_t want = len - i < piece ? len - i : piece;
		i += framer_push(f, bytes + i, want);
		const uint8_t *telegram;
		size_t k;
		while ((k = framer_take(f, &telegram)) > 0) {
			memcpy(ret + n, telegram, k);
			n += k;
			ret[n++] = '|';
		}
	}
	ret[n] = 0;
	return n;
}

static void telegrams_come_out_the_same_however_they_are_cut(void **state)
{
	(void)state;
	static const uint8_t bytes[] = "<\1aa!<\2ab\303!";
	char out[64];
	for (size_t piece = 1; piece < sizeof bytes; piece++) {
		struct framer f;
		framer_init(&f, scan_toy, NULL, line, sizeof line);
		collect(&f, bytes, sizeof bytes - 1, piece, out);
		assert_string_equal(out, "<\1aa|!|<\2ab\303|!|");
		assert_int_equal(f.skipped, 0);
	}
}

static void garbage_costs_a_byte_each_and_is_counted(void **state)
{
	(void)state;
	struct framer f;
	char out[64];
	framer_init(&f, scan_toy, NULL, line, sizeof line);
	collect(&f, (const uint8_t *)"xyz<\1aa", 7, 7, out);
	assert_string_equal(out, "<\1aa|");
	assert_int_equal(f.skipped, 3);
	assert_int_equal(f.refused[FRAMER_NO_START], 3);
}

static void a_telegram_inside_a_false_start_is_found(void **state)
{
	(void)state;
	struct framer f;
	char out[64];
	framer_init(&f, scan_toy, NULL, line, sizeof line);
	collect(&f, (const uint8_t *)"<\4<\1aa<\1bb", 10, 10, out);
	assert_string_equal(out, "<\1aa|<\1bb|");
	assert_int_equal(f.refused[BAD_SUM], 1);
	assert_int_equal(f.skipped, 2);
}

static void a_bare_byte_counts_at_a_boundary_only(void **state)
{
	(void)state;
	struct framer f;
	char out[64];
	framer_init(&f, scan_toy, NULL, line, sizeof line);
	collect(&f, (const uint8_t *)"x!<\1!!!", 7, 7, out);
	assert_string_equal(out, "<\1!!|!|");
	assert_int_equal(f.skipped, 2);
}

static void silence_ends_what_was_begun_and_is_a_boundary(void **state)
{
	(void)state;
	struct framer f;
	char out[64];
	framer_init(&f, scan_toy, NULL, line, sizeof line);
	collect(&f, (const uint8_t *)"<\11<\1aa", 6, 6, out);
	assert_string_equal(out, "");
	framer_silence(&f);
	collect(&f, (const uint8_t *)"!<\3", 3, 3, out);
	assert_string_equal(out, "<\1aa|!|");
	assert_int_equal(f.refused[FRAMER_CUT], 1);
	collect(&f, (const uint8_t *)"abc\46x", 5, 1, out);
	assert_string_equal(out, "<\3abc\46|");
	framer_silence(&f);
	collect(&f, (const uint8_t *)"!", 1, 1, out);
	assert_string_equal(out, "!|");
	assert_int_equal(f.skipped, 3);
}

static void a_telegram_that_the_host_slept_in_is_taken(void **state)
{
	(void)state;
	char out[64];
	for (size_t cut = 1; cut < 6; cut++) {
		struct framer f;
		framer_init(&f, scan_toy, NULL, line, sizeof line);
		collect(&f, (const uint8_t *)"!<\2ab\303", cut, cut, out);
		framer_silence(&f);
		collect(&f, (const uint8_t *)"!<\2ab\303" + cut, 6 - cut, 6, out);
		assert_string_equal(out, "<\2ab\303|");
		assert_int_equal(f.skipped, 0);
		framer_silence(&f);
		collect(&f, (const uint8_t *)"<\1aa", 4, 1, out); /* a silence with nothing before it cuts nothing */
		assert_string_equal(out, "<\1aa|");
	}
}

static void a_scan_that_never_has_enough_does_not_fill_memory(void **state)
{
	(void)state;
	struct framer f;
	const uint8_t *telegram;
	static const uint8_t zeros[3 * LINE_BYTES];
	framer_init(&f, scan_greedy, NULL, line, sizeof line);
	for (size_t i = 0; i < sizeof zeros;) {
		const size_t n = framer_push(&f, zeros + i, sizeof zeros - i);
		assert_true(n > 0);
		i += n;
		assert_int_equal(framer_take(&f, &telegram), 0);
	}
	assert_int_equal(f.skipped, f.refused[FRAMER_CUT]);
	assert_int_equal(f.skipped, 2 * LINE_BYTES + 1);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(telegrams_come_out_the_same_however_they_are_cut),
	    cmocka_unit_test(garbage_costs_a_byte_each_and_is_counted),
	    cmocka_unit_test(a_telegram_inside_a_false_start_is_found),
	    cmocka_unit_test(a_bare_byte_counts_at_a_boundary_only),
	    cmocka_unit_test(silence_ends_what_was_begun_and_is_a_boundary),
	    cmocka_unit_test(a_telegram_that_the_host_slept_in_is_taken),
	    cmocka_unit_test(a_scan_that_never_has_enough_does_not_fill_memory),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

/* Law: the wire protocol's bytes are the documented ones, both ways, and nothing that is not whole and right is a telegram. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include <cmocka.h>

#include "drivers/lms2xx_wire.h"

struct vector {
	const char *name, *hex; /* the whole telegram, as documented */
	bool to_device;
};

static const struct vector vectors[] = {
    {"status request", "02 00 01 00 31 15 12", true},
    {"type request", "02 00 01 00 3A 1E 12", true},
    {"read config", "02 00 01 00 74 50 12", true},
    {"error memory", "02 00 01 00 32 16 12", true},
    {"reset", "02 00 01 00 10 34 12", true},
    {"one measurement", "02 00 02 00 30 01 31 18", true},
    {"stop", "02 00 02 00 20 25 35 08", true},
    {"continuous", "02 00 02 00 20 24 34 08", true},
    {"partial scans", "02 00 02 00 20 2A 3A 08", true},
    {"9600 Bd", "02 00 02 00 20 42 52 08", true},
    {"19200 Bd", "02 00 02 00 20 41 51 08", true},
    {"38400 Bd", "02 00 02 00 20 40 50 08", true},
    {"500000 Bd", "02 00 02 00 20 48 58 08", true},
    {"installation mode", "02 00 0A 00 20 00 53 49 43 4B 5F 4C 4D 53 BE C5", true},
    {"variant 180/1", "02 00 05 00 3B B4 00 64 00 97 49", true},
    {"variant 180/0.5", "02 00 05 00 3B B4 00 32 00 3B 1F", true},
    {"variant 100/1", "02 00 05 00 3B 64 00 64 00 1D 0F", true},
    {"variant 100/0.5", "02 00 05 00 3B 64 00 32 00 B1 59", true},
    {"variant 100/0.25", "02 00 05 00 3B 64 00 19 00 E7 72", true},
    {"sub-range", "02 00 06 00 20 27 01 00 69 01 AB D4", true},
    {"range and reflectivity", "02 00 06 00 20 50 01 00 B5 00 68 B6", true},
    {"config write",
     "02 00 23 00 77 00 00 46 00 02 02 00 00 00 02 02 02 00 00 0A 0A 50 64 00 0A 0A 50 64 00 0A 0A 50 64 00 00 00 00 "
     "02 00 9F 11",
     true},
    {"mode reply", "02 80 03 00 A0 00 10 16 0A", false},
    {"mode reply of address 1", "02 81 03 00 A0 00 10 36 1A", false},
    {"variant reply", "02 81 07 00 BB 01 64 00 64 00 10 4A 3F", false},
    {"reset reply", "02 80 02 00 91 10 79 30", false},
    {"power on", "02 81 17 00 90 4C 4D 53 32 30 30 3B 33 30 31 30 36 33 3B 56 30 32 2E 30 36 20 13 64 5A", false},
    {"reject", "02 81 03 00 92 00 10 FE 7E", false},
};
enum { VECTORS = sizeof vectors / sizeof vectors[0] };

static size_t from_hex(const char *hex, uint8_t *ret)
{
	size_t n = 0;
	unsigned byte;
	for (int used; sscanf(hex, "%x%n", &byte, &used) == 1; hex += used)
		ret[n++] = (uint8_t)byte;
	return n;
}

static int judge(const struct vector *v, const uint8_t *buf, size_t len)
{
	return v->to_device ? lms2xx_scan_host(NULL, buf, len, true) : lms2xx_scan_device(NULL, buf, len, true);
}

static void documented_telegrams_are_encoded_byte_by_byte(void **state)
{
	(void)state;
	for (int i = 0; i < VECTORS; i++) {
		uint8_t want[64], got[64 + 6];
		const size_t len = from_hex(vectors[i].hex, want);
		assert_int_equal(lms2xx_encode(want[1], want + 4, len - 6, got), len);
		assert_memory_equal(got, want, len);
		assert_int_equal(lms2xx_crc(want, len - 2), want[len - 2] | want[len - 1] << 8);
	}
}

static void documented_telegrams_are_found_whole_and_no_shorter(void **state)
{
	(void)state;
	for (int i = 0; i < VECTORS; i++) {
		uint8_t bytes[64];
		const size_t len = from_hex(vectors[i].hex, bytes);
		assert_int_equal(judge(&vectors[i], bytes, len), len);
		for (size_t cut = 1; cut < len; cut++)
			assert_int_equal(judge(&vectors[i], bytes, cut), FRAMER_MORE);
	}
}

static void a_telegram_with_any_byte_changed_is_none(void **state)
{
	(void)state;
	for (int i = 0; i < VECTORS; i++) {
		uint8_t bytes[64];
		const size_t len = from_hex(vectors[i].hex, bytes);
		for (size_t at = 0; at < len; at++) {
			for (unsigned change = 1; change < 256; change++) {
				if (at == 0 && ((bytes[0] ^ change) == LMS2XX_ACK || (bytes[0] ^ change) == LMS2XX_NAK))
					continue; /* is one, at a boundary */
				bytes[at] ^= (uint8_t)change;
				assert_true(judge(&vectors[i], bytes, len) <= 0);
				bytes[at] ^= (uint8_t)change;
			}
		}
	}
}

static void acknowledgements_count_at_a_boundary_only(void **state)
{
	(void)state;
	for (unsigned byte = 0; byte < 256; byte++) {
		const uint8_t b = (uint8_t)byte;
		const bool bare = byte == 0x06 || byte == 0x15;
		const int otherwise = byte == 2 ? FRAMER_MORE : -FRAMER_NO_START;
		assert_int_equal(lms2xx_scan_device(NULL, &b, 1, true), bare ? 1 : otherwise);
		assert_int_equal(lms2xx_scan_device(NULL, &b, 1, false), otherwise);
		assert_int_equal(lms2xx_scan_host(NULL, &b, 1, true), otherwise);
	}
}

static void lengths_are_judged_before_they_are_waited_for(void **state)
{
	(void)state;
	const uint8_t endless[] = {0x02, 0x80, 0xDD, 0x05}, empty[] = {0x02, 0x80, 0, 0};
	assert_int_equal(lms2xx_scan_device(NULL, endless, 4, true), -LMS2XX_TOO_LONG);
	assert_int_equal(lms2xx_scan_device(NULL, empty, 4, true), -LMS2XX_BAD_SIZE);
	const uint8_t long_request[] = {0x02, 0x00, 0x41, 0x00}, no_request[] = {0x02, 0x00, 0, 0};
	assert_int_equal(lms2xx_scan_host(NULL, long_request, 4, true), -LMS2XX_TOO_LONG);
	assert_int_equal(lms2xx_scan_host(NULL, no_request, 4, true), -LMS2XX_BAD_SIZE);
	/* A mode reply has three bytes; a measurement what its count says; a C4 at most so much reflectivity. */
	const uint8_t mode[] = {0x02, 0x80, 0x04, 0x00, 0xA0}, scan[] = {0x02, 0x80, 0xD7, 0x02, 0xB0, 0x69, 0x41};
	assert_int_equal(lms2xx_scan_device(NULL, mode, 5, true), -LMS2XX_BAD_SIZE);
	assert_int_equal(lms2xx_scan_device(NULL, scan, 6, true), FRAMER_MORE);
	assert_int_equal(lms2xx_scan_device(NULL, scan, 7, true), -LMS2XX_BAD_SIZE);
	const uint8_t tiny[] = {0x02, 0x80, 0x03, 0x00, 0xB0}, c4[] = {0x02, 0x80, 0xDC, 0x05, 0xC4, 0x05, 0x40};
	assert_int_equal(lms2xx_scan_device(NULL, tiny, 5, true), -LMS2XX_BAD_SIZE);
	assert_int_equal(lms2xx_scan_device(NULL, c4, 7, true), -LMS2XX_BAD_SIZE);
}

static struct lms2xx_scan example(uint8_t *words, unsigned n)
{
	for (unsigned i = 0; i < n; i++) {
		words[2 * i] = (uint8_t)(i * 7);
		words[2 * i + 1] = (uint8_t)(i / 5);
	}
	return (struct lms2xx_scan){
	    .command = LMS2XX_SCAN, .unit = LMS2XX_MM, .n = (uint16_t)n, .stride = 2, .value = words, .status = 0x10};
}

static void measurements_survive_encoding_and_decoding(void **state)
{
	(void)state;
	static const struct {
		unsigned n, length;
	} sizes[] = {{101, 212}, {181, 372}, {201, 412}, {361, 732}, {401, 812}};
	for (size_t i = 0; i < 5; i++) {
		for (unsigned form = 0; form < 8; form++) {
			uint8_t words[2 * LMS2XX_BEAMS_MAX], bytes[LMS2XX_TELEGRAM_MAX];
			struct lms2xx_scan scan = example(words, sizes[i].n), got;
			scan.indexed = form & 1;
			scan.scan_index = scan.indexed ? 200 : 0;
			scan.telegram_index = scan.indexed ? 33 : 0;
			scan.partial = form & 2;
			scan.part = scan.partial ? 3 : 0;
			if (form & 4) {
				scan.command = LMS2XX_SCAN_RANGE;
				scan.start = 5;
				scan.stop = (uint16_t)(4 + scan.n);
			}
			const size_t len = lms2xx_encode_scan(&scan, bytes);
			assert_int_equal(len, sizes[i].length + (form & 1) * 2 + (form & 4));
			assert_int_equal(lms2xx_scan_device(NULL, bytes, len, true), len);
			assert_true(lms2xx_decode_scan(bytes + 4, len - 6, &got));
			assert_memory_equal(got.value, words, 2 * scan.n);
			uint8_t again[LMS2XX_TELEGRAM_MAX];
			assert_int_equal(lms2xx_encode_scan(&got, again), len);
			assert_memory_equal(again, bytes, len);
			assert_true(got.command == scan.command && got.n == scan.n && got.unit == scan.unit);
			assert_true(got.partial == scan.partial && got.part == scan.part && got.start == scan.start);
			assert_true(got.stop == scan.stop && got.indexed == scan.indexed && got.status == 0x10);
			assert_true(got.scan_index == scan.scan_index && got.telegram_index == scan.telegram_index);
			for (size_t cut = 1; cut < len - 6; cut++) /* (less two it is one without indices) */
				assert_int_equal(lms2xx_decode_scan(bytes + 4, cut, &got),
				                 scan.indexed && cut == len - 8);
		}
	}
}

static void rarer_measurements_are_taken_apart(void **state)
{
	(void)state;
	struct lms2xx_scan got;
	const uint8_t mean[] = {0xB6, 9, 2, 0x40, 1, 0, 2, 0, 0x10};
	assert_true(lms2xx_decode_scan(mean, sizeof mean, &got));
	assert_int_equal(got.samples, 9);
	assert_int_equal(got.n, 2);
	assert_int_equal(got.unit, LMS2XX_MM);
	const uint8_t mean_range[] = {0xBF, 9, 3, 0, 3, 0, 1, 0x00, 77, 0, 0x10};
	assert_true(lms2xx_decode_scan(mean_range, sizeof mean_range, &got));
	assert_int_equal(got.start, 3);
	assert_int_equal(got.value[0], 77);
	const uint8_t reflectivity[] = {0xC4, 2, 0x40, 1, 0, 2, 0, 3, 0, 1, 0, 3, 0, 50, 51, 52, 7, 8, 0x10};
	assert_true(lms2xx_decode_scan(reflectivity, sizeof reflectivity, &got));
	assert_true(got.indexed);
	assert_int_equal(got.scan_index, 7);
	assert_int_equal(got.stop, 3);
	assert_false(lms2xx_decode_scan(reflectivity, sizeof reflectivity - 1, &got));
	const uint8_t parts[] = {0xF5, 1, 0, 1, 0, 2, 0, 2, 0x40, 1, 0, 9, 9, 2, 0, 9, 9, 0x10};
	assert_true(lms2xx_decode_scan(parts, sizeof parts, &got));
	assert_int_equal(got.stride, 4);
	assert_int_equal(got.stop, 2);
	assert_false(lms2xx_decode_scan(parts, 0, &got));
	assert_false(lms2xx_decode_scan((const uint8_t[]){0xA0, 0, 0x10}, 3, &got));
	assert_true(lms2xx_is_scan(0xB7));
	assert_false(lms2xx_is_scan(0xB1));
}

static void every_error_code_is_told_in_every_width(void **state)
{
	(void)state;
	static const struct {
		int mode, bits;
	} modes[] = {{0x00, 13}, {0x01, 13}, {0x02, 13}, {0x03, 14}, {0x04, 14}, {0x05, 15}, {0x06, 15}, {0x0F, 16}};
	static const struct {
		unsigned below;
		enum beam_state state;
	} codes[] = {
	    {0, BEAM_NO_ECHO},       {1, BEAM_DAZZLED},  {2, BEAM_OVERFLOW}, {3, BEAM_RESERVED},   {4, BEAM_WEAK},
	    {5, BEAM_CHANNEL_ERROR}, {6, BEAM_RESERVED}, {7, BEAM_RESERVED}, {8, BEAM_BEYOND_MAX}, {9, BEAM_OK}};
	for (size_t m = 0; m < 8; m++) {
		const unsigned max = (1u << modes[m].bits) - 1;
		assert_int_equal(lms2xx_range_bits(modes[m].mode), modes[m].bits);
		for (size_t c = 0; c < 10; c++) {
			for (unsigned flags = 0; flags < 8; flags++) { /* whatever the other bits say */
				const unsigned word = (max - codes[c].below) | (flags << 13 & ~max & 0xFFFF);
				uint16_t range = 0;
				const enum beam_state got = lms2xx_range((uint16_t)word, modes[m].mode, &range);
				if (modes[m].mode == 0 && (word & 0x8000))
					assert_int_equal(got, BEAM_DAZZLED);
				else
					assert_int_equal(got, codes[c].state);
				if (got == BEAM_OK)
					assert_int_equal(range, max - 9);
			}
			if (codes[c].state != BEAM_RESERVED && codes[c].state != BEAM_OK)
				assert_int_equal(lms2xx_word(codes[c].state, 0, modes[m].mode), max - codes[c].below);
		}
		uint16_t range;
		assert_int_equal(lms2xx_range(lms2xx_word(BEAM_RESERVED, 0, modes[m].mode), modes[m].mode, &range),
		                 BEAM_RESERVED);
		assert_int_equal(lms2xx_word(BEAM_OK, 1234.4, modes[m].mode), 1234);
		assert_int_equal(lms2xx_word(BEAM_OK, max - 9, modes[m].mode), max - 9);
		assert_int_equal(lms2xx_word(BEAM_OK, max - 8, modes[m].mode), max - 8);
		assert_int_equal(lms2xx_word(BEAM_OK, 1e9, modes[m].mode), max - 8);
		assert_int_equal(lms2xx_word(BEAM_OK, -1, modes[m].mode), max - 8);
	}
	for (int mode = 0x07; mode < 0x100; mode++)
		if (mode != 0x0F)
			assert_int_equal(lms2xx_range_bits(mode), 0);
}

static void units_and_rates_are_the_documented_ones(void **state)
{
	(void)state;
	assert_float_equal(lms2xx_unit_m(LMS2XX_CM), 0.01, 0);
	assert_float_equal(lms2xx_unit_m(LMS2XX_MM), 0.001, 0);
	assert_float_equal(lms2xx_unit_m(LMS2XX_DM), 0.1, 0);
	assert_float_equal(lms2xx_unit_m(3), 0, 0);
	assert_float_equal(lms2xx_unit_m(9), 0, 0);
	static const uint32_t bauds[] = {9600, 19200, 38400, 500000};
	for (int i = 0; i < 4; i++)
		assert_int_equal(lms2xx_mode_baud(lms2xx_baud_mode(bauds[i])), bauds[i]);
	assert_int_equal(lms2xx_baud_mode(57600), 0);
	assert_int_equal(lms2xx_mode_baud(LMS2XX_MODE_STREAM), 0);
}

static void configurations_of_both_lengths_are_read(void **state)
{
	(void)state;
	for (size_t n = 30; n <= 36; n++) {
		uint8_t p[64] = {LMS2XX_CONFIG_REPLY};
		struct lms2xx_config config = {.len = 1};
		p[1 + LMS2XX_CONFIG_MODE] = 5;
		p[1 + LMS2XX_CONFIG_UNIT] = 1;
		assert_int_equal(lms2xx_decode_config(p, n + 2, &config), n == 32 || n == 34);
		assert_int_equal(config.len, n == 32 || n == 34 ? n : 1);
		assert_int_equal(config.bytes[LMS2XX_CONFIG_MODE], n == 32 || n == 34 ? 5 : 0);
	}
	uint8_t p[64] = {LMS2XX_CONFIG_WRITTEN, 1};
	struct lms2xx_config config;
	p[2 + LMS2XX_CONFIG_MODE] = 3;
	assert_true(lms2xx_decode_config(p, 37, &config));
	assert_int_equal(config.bytes[LMS2XX_CONFIG_MODE], 3);
	p[1] = 0;
	assert_false(lms2xx_decode_config(p, 37, &config));
	assert_false(lms2xx_decode_config(p, 1, &config));
	assert_false(lms2xx_decode_config(p, 0, &config));
	p[0] = LMS2XX_MODE_REPLY;
	assert_false(lms2xx_decode_config(p, 36, &config));
}

static void status_replies_of_both_layouts_tell_the_variant(void **state)
{
	(void)state;
	for (size_t len = 130; len <= 170; len++) {
		uint8_t p[170] = {LMS2XX_STATUS_REPLY};
		struct lms2xx_status status;
		const size_t shift = len == 148 ? 6 : 0;
		p[8] = 0x25;
		p[107 - shift] = 180;
		p[109 - shift] = 50;
		assert_int_equal(lms2xx_decode_status(p, len, &status), len >= 140);
		if (len < 140)
			continue;
		const bool known = len == 148 || len == 154;
		assert_int_equal(status.mode, 0x25);
		assert_int_equal(status.fov_deg, known ? 180 : 0);
		assert_int_equal(status.resolution_cdeg, known ? 50 : 0);
	}
	bool taken;
	int fov, resolution;
	const uint8_t variant[] = {LMS2XX_VARIANT_REPLY, 1, 100, 0, 25, 0, 0x10};
	assert_true(lms2xx_decode_variant(variant, 7, &taken, &fov, &resolution));
	assert_true(taken && fov == 100 && resolution == 25);
	assert_false(lms2xx_decode_variant(variant, 6, &taken, &fov, &resolution));
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(documented_telegrams_are_encoded_byte_by_byte),
	    cmocka_unit_test(documented_telegrams_are_found_whole_and_no_shorter),
	    cmocka_unit_test(a_telegram_with_any_byte_changed_is_none),
	    cmocka_unit_test(acknowledgements_count_at_a_boundary_only),
	    cmocka_unit_test(lengths_are_judged_before_they_are_waited_for),
	    cmocka_unit_test(measurements_survive_encoding_and_decoding),
	    cmocka_unit_test(rarer_measurements_are_taken_apart),
	    cmocka_unit_test(every_error_code_is_told_in_every_width),
	    cmocka_unit_test(units_and_rates_are_the_documented_ones),
	    cmocka_unit_test(configurations_of_both_lengths_are_read),
	    cmocka_unit_test(status_replies_of_both_layouts_tell_the_variant),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

/* Law: CoLa's bytes are the documented ones in both dialects and both ways, nothing that is not whole and right is a
 * telegram, and what is none is refused as early as its bytes allow. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include <cmocka.h>

#include "drivers/cola_wire.h"

static size_t from_hex(const char *hex, uint8_t *ret)
{
	size_t n = 0;
	unsigned byte;

	for (int used; sscanf(hex, " %2x%n", &byte, &used) == 1; hex += used)
		ret[n++] = (uint8_t)byte;
	return n;
}

/* Real CoLa-B frames. */
static const struct {
	const char *name, *hex;
} frames_b[] = {
    {"login", "02020202 00000017 734D4E20 5365744163636573734D6F6465 20 03 F4724744 B3"},
    {"login answered", "02020202 00000013 73414E20 5365744163636573734D6F6465 20 01 38"},
    {"choose CoLa-B", "02020202 0000000F 73574E20 4549487374436F6C61 20 01 09"},
    {"read output range", "02020202 00000012 73524E20 4C4D506F757470757452616E6765 5E"},
    {"output range", "02020202 00000021 73524120 4C4D506F757470757452616E6765 20 0001 00001388 FFF92233 0022550D 86"},
    {"write output range",
     "02020202 00000021 73574E20 4C4D506F757470757452616E6765 20 0001 00001388 FFF92233 0022550D 8C"},
    {"output range written", "02020202 00000013 73574120 4C4D506F757470757452616E6765 20 74"},
    {"scan data config",
     "02020202 00000020 73574E20 4C4D447363616E6461746163666720 0100 00 00 00 0000 00 00 00 01 0001 43"},
    {"start measurement", "02020202 00000010 734D4E20 4C4D4373746172746D656173 68"},
    {"run", "02020202 00000007 734D4E20 52756E 19"},
    {"runs", "02020202 00000009 73414E20 52756E 20 01 34"},
    {"stream on", "02020202 00000011 73454E20 4C4D447363616E64617461 20 01 33"},
    {"streams", "02020202 00000011 73454120 4C4D447363616E64617461 20 01 3C"},
    {"variable unknown", "02020202 00000005 734641 0003 77"},
    {"out of limits", "02020202 00000005 734641 0004 70"},
    {"event unknown", "02020202 00000005 734641 000F 7B"},
};
enum { FRAMES_B = sizeof(frames_b) / sizeof(frames_b[0]) };

static const char *const frames_a[] = {"\x02sMN SetAccessMode 03 F4724744\x03",
                                       "\x02sAN SetAccessMode 1\x03",
                                       "\x02sEN LMDscandata 1\x03",
                                       "\x02sRN LMDscandata\x03",
                                       "\x02sWN EIHstCola 0\x03",
                                       "\x02sFA 1\x03",
                                       "\x02sRA 0 6 TiM561 E V2.51-21.08.15\x03",
                                       "\x02sMN Run\x03"};
enum { FRAMES_A = sizeof(frames_a) / sizeof(frames_a[0]) };

static size_t frame(int i, uint8_t *ret)
{
	if (i < FRAMES_B)
		return from_hex(frames_b[i].hex, ret);
	memcpy(ret, frames_a[i - FRAMES_B], strlen(frames_a[i - FRAMES_B]));
	return strlen(frames_a[i - FRAMES_B]);
}

static int judge(const uint8_t *buf, size_t len)
{
	return cola_scan_frame(NULL, buf, len, true);
}

static void known_frames_are_found_whole_and_no_shorter(void **state)
{
	(void)state;
	for (int i = 0; i < FRAMES_B + FRAMES_A; i++) {
		uint8_t bytes[80];
		const size_t len = frame(i, bytes);
		bytes[len] = 0x02;
		assert_int_equal(judge(bytes, len), len);
		assert_int_equal(judge(bytes, len + 1), len);
		for (size_t cut = 1; cut < len; cut++)
			assert_int_equal(judge(bytes, cut), FRAMER_MORE);
	}
}

static void a_cola_b_frame_with_any_bit_changed_is_none(void **state)
{
	(void)state;
	for (int i = 0; i < FRAMES_B; i++) {
		uint8_t bytes[80];
		const size_t len = frame(i, bytes);
		for (size_t bit = 0; bit < 8 * len; bit++) {
			bytes[bit / 8] ^= (uint8_t)(1 << bit % 8);
			assert_true(judge(bytes, len) <= 0);
			bytes[bit / 8] ^= (uint8_t)(1 << bit % 8);
		}
		assert_int_equal(judge(bytes, len), len);
	}
}

static void what_is_no_frame_is_refused_by_its_first_bytes(void **state)
{
	static const struct {
		const char *hex;
		int answer;
	} cases[] = {
	    {"03", -FRAMER_NO_START},
	    {"73", -FRAMER_NO_START},
	    {"02 03", -COLA_BAD_BYTE},
	    {"02 53", -COLA_BAD_BYTE},                /* S */
	    {"02 73 58", -COLA_BAD_BYTE},             /* sX */
	    {"02 73 52 52", -COLA_BAD_BYTE},          /* sRR */
	    {"02 73 52 4E 4C", -COLA_BAD_BYTE},       /* sRNL */
	    {"02 73 52 4E 20 03", -COLA_BAD_BYTE},    /* no name */
	    {"02 73 52 4E 20 41 1F", -COLA_BAD_BYTE}, /* a control character */
	    {"02 73 52 4E 20 41 02", -COLA_BAD_BYTE}, /* the next start before the end */
	    {"02 73 52 4E 20 FC 42", FRAMER_MORE},    /* a name may have an umlaut */
	    {"02 02 03", -COLA_BAD_BYTE},
	    {"02 02 02 73", -COLA_BAD_BYTE},
	    {"02 02 02 02 02", -COLA_TOO_LONG},
	    {"02 02 02 02 00 01 00 00", -COLA_TOO_LONG},
	    {"02 02 02 02 00 00 FF F8", -COLA_TOO_LONG},
	    {"02 02 02 02 00 00 FF F7", FRAMER_MORE},
	    {"02 02 02 02 00 00 00 04", -COLA_BAD_BYTE},
	    {"02 02 02 02 00 00 FF 00 53", -COLA_BAD_BYTE},
	    {"02 02 02 02 00 00 FF 00 73 52 4E 00", -COLA_BAD_BYTE},
	    {"02 02 02 02 00 00 00 05 73 46 41 00", FRAMER_MORE},
	    {"02 02 02 02 00 00 00 05 73 46 41 00 03 76", -COLA_BAD_SUM},
	};

	(void)state;
	for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
		uint8_t bytes[32];
		const size_t len = from_hex(cases[i].hex, bytes);
		assert_int_equal(judge(bytes, len), cases[i].answer);
	}
}

static void a_text_without_end_is_given_up_at_the_limit(void **state)
{
	static uint8_t bytes[COLA_TELEGRAM_MAX + 1];

	(void)state;
	memset(bytes, 'A', sizeof(bytes));
	memcpy(bytes, "\x02sRA X", 6);
	assert_int_equal(judge(bytes, COLA_TELEGRAM_MAX - 1), FRAMER_MORE);
	assert_int_equal(judge(bytes, COLA_TELEGRAM_MAX), -COLA_TOO_LONG);
	bytes[COLA_TELEGRAM_MAX - 1] = 0x03;
	assert_int_equal(judge(bytes, COLA_TELEGRAM_MAX), COLA_TELEGRAM_MAX);
}

/* Counts what a scan is asked: how often, and how many bytes it may have to look at. */
struct cost {
	size_t asked, looked;
};

static int counting_scan(void *ctx, const uint8_t *buf, size_t len, bool boundary)
{
	struct cost *cost = ctx;
	const int r = cola_scan_frame(NULL, buf, len, boundary);
	size_t looked = 1;

	/* Whatever it answers, it cannot depend on bytes behind the first ones that settle it. */
	while (looked < len && cola_scan_frame(NULL, buf, looked, boundary) == FRAMER_MORE)
		looked++;
	cost->asked++;
	cost->looked += looked;
	return r;
}

static void rubbish_is_read_about_once(void **state)
{
	static const uint8_t starts[] = {0x02, 's', 'R', 'A', ' ', 'X'}, heads[] = {2, 2, 2, 2, 0, 0, 0xFF, 0xF0};
	static uint8_t buf[4096], rubbish[20000];
	uint32_t random = 1;

	(void)state;
	for (int kind = 0; kind < 3; kind++) {
		struct cost cost = {0};
		struct framer f;
		const uint8_t *telegram;
		framer_init(&f, counting_scan, &cost, buf, sizeof(buf));
		for (size_t i = 0; i < sizeof(rubbish); i++) {
			random = random * 1664525 + 1013904223;
			rubbish[i] = kind == 0   ? (uint8_t)(random >> 24)
			             : kind == 1 ? starts[i % sizeof(starts)]
			                         : heads[i % sizeof(heads)];
		}
		for (size_t done = 0; done < sizeof(rubbish);) {
			done += framer_push(&f, rubbish + done, sizeof(rubbish) - done);
			assert_int_equal(framer_take(&f, &telegram), 0);
		}
		assert_true(cost.asked < 2 * sizeof(rubbish));
		assert_true(cost.looked < 4 * sizeof(rubbish));
	}
}

static void frames_give_their_payload_and_kind(void **state)
{
	static const struct {
		const char *word;
		int kind;
	} kinds[] = {{"sRA X", COLA_READ},  {"sWA X", COLA_WRITTEN}, {"sAN X", COLA_METHOD}, {"sAI 1", COLA_METHOD},
	             {"sMA X", COLA_LATER}, {"sEA X", COLA_EVENT},   {"sSN X", COLA_DATA},   {"sSI 1", COLA_DATA},
	             {"sFA 3", COLA_ERROR}, {"sRN X", COLA_OTHER},   {"sMN X", COLA_OTHER},  {"sEN X", COLA_OTHER},
	             {"s", COLA_OTHER}};
	uint8_t bytes[80];
	const uint8_t *payload;
	size_t len;

	(void)state;
	for (size_t i = 0; i < sizeof(kinds) / sizeof(kinds[0]); i++) {
		const uint8_t *word = (const uint8_t *)kinds[i].word;
		assert_int_equal(cola_reply_kind(COLA_A, word, strlen(kinds[i].word)), kinds[i].kind);
		assert_int_equal(cola_reply_kind(COLA_B, word, strlen(kinds[i].word)), kinds[i].kind + COLA_B_FLAG);
	}
	assert_int_equal(cola_payload(bytes, frame(0, bytes), &payload, &len), COLA_B);
	assert_int_equal(len, 0x17);
	assert_memory_equal(payload, "sMN SetAccessMode \x03\xF4\x72\x47\x44", len);
	assert_int_equal(cola_payload(bytes, frame(FRAMES_B + 5, bytes), &payload, &len), COLA_A);
	assert_int_equal(len, 5);
	assert_memory_equal(payload, "sFA 1", len);
}

static void check_written(struct cola_writer *w, const char *hex)
{
	uint8_t want[80];
	const size_t len = from_hex(hex, want);

	assert_int_equal(cola_writer_end(w), len);
	assert_memory_equal(w->bytes, want, len);
}

static void known_requests_are_written_byte_by_byte_in_cola_b(void **state)
{
	uint8_t bytes[80];
	struct cola_writer w;

	(void)state;
	cola_writer_init(&w, COLA_B, bytes, sizeof(bytes), "sMN SetAccessMode");
	cola_write_digits(&w, 3, 1);
	cola_write_digits(&w, 0xF4724744, 4);
	check_written(&w, frames_b[0].hex);
	cola_writer_init(&w, COLA_B, bytes, sizeof(bytes), "sRN LMPoutputRange");
	check_written(&w, frames_b[3].hex);
	cola_writer_init(&w, COLA_B, bytes, sizeof(bytes), "sWN LMPoutputRange");
	cola_write_u(&w, 1, 2);
	cola_write_u(&w, 5000, 4);
	cola_write_i(&w, -449997, 4);
	cola_write_decimal(&w, 2249997, 4);
	check_written(&w, frames_b[5].hex);
	cola_writer_init(&w, COLA_B, bytes, sizeof(bytes), "sWA LMPoutputRange "); /* as TiM and LMS do */
	check_written(&w, frames_b[6].hex);
	cola_writer_init(&w, COLA_B, bytes, sizeof(bytes), "sAN Run ");
	cola_write_u(&w, 1, 1);
	check_written(&w, frames_b[10].hex);
	cola_writer_init(&w, COLA_B, bytes, sizeof(bytes), "sFA");
	cola_write_u(&w, 15, 2);
	check_written(&w, frames_b[15].hex);
}

static void check_text(struct cola_writer *w, const char *want)
{
	assert_int_equal(cola_writer_end(w), strlen(want) + 2);
	assert_int_equal(w->bytes[0], 0x02);
	assert_int_equal(w->bytes[w->len - 1], 0x03);
	assert_memory_equal(w->bytes + 1, want, strlen(want));
}

static void known_requests_are_written_letter_by_letter_in_cola_a(void **state)
{
	uint8_t bytes[80];
	struct cola_writer w;

	(void)state;
	cola_writer_init(&w, COLA_A, bytes, sizeof(bytes), "sMN SetAccessMode");
	cola_write_digits(&w, 3, 1);
	cola_write_digits(&w, 0xF4724744, 4);
	check_text(&w, "sMN SetAccessMode 03 F4724744");
	cola_writer_init(&w, COLA_A, bytes, sizeof(bytes), "sMN mLMPsetscancfg");
	cola_write_decimal(&w, 5000, 4);
	cola_write_decimal(&w, 1, 2);
	cola_write_u(&w, 5000, 4);
	cola_write_i(&w, -450000, 4);
	cola_write_decimal(&w, -450000, 4);
	cola_write_decimal(&w, 0, 4);
	cola_write_decimal(&w, INT32_MIN, 4);
	check_text(&w, "sMN mLMPsetscancfg +5000 +1 1388 FFF92230 -450000 +0 -2147483648");
	cola_writer_init(&w, COLA_A, bytes, sizeof(bytes), "sRA X ");
	cola_write_float(&w, 1.0f);
	cola_write_float(&w, 0.1f);
	cola_write_float(&w, 0);
	cola_write_i(&w, -2, 2);
	check_text(&w, "sRA X 3F800000 3DCCCCCD 00000000 FFFE");
	cola_writer_init(&w, COLA_A, bytes, sizeof(bytes), "sRA LocationName");
	cola_write_string(&w, "not defined", 11, 2);
	cola_write_string(&w, "", 0, 1);
	cola_write_chars(&w, "DIST1", 5);
	check_text(&w, "sRA LocationName B not defined 0 DIST1");
	cola_writer_init(&w, COLA_A, bytes, sizeof(bytes), "sFA");
	cola_write_u(&w, 0x1A, 2);
	check_text(&w, "sFA 1A");
}

static void a_writer_without_room_says_so_and_writes_not_beyond(void **state)
{
	uint8_t bytes[80];

	(void)state;
	for (int dialect = COLA_A; dialect <= COLA_B; dialect++) {
		size_t whole = 0;
		for (size_t cap = sizeof(bytes); cap-- > 0;) {
			struct cola_writer w;
			memset(bytes, 0xEE, sizeof(bytes));
			cola_writer_init(&w, (enum cola_dialect)dialect, bytes, cap, "sRA X");
			cola_write_u(&w, 1, 4);
			cola_write_decimal(&w, -17, 4);
			cola_write_string(&w, "a b", 3, 1);
			const size_t len = cola_writer_end(&w);
			whole = cap == sizeof(bytes) - 1 ? len : whole;
			assert_int_equal(len, cap >= whole ? whole : 0);
			assert_int_equal(bytes[cap], 0xEE);
		}
		assert_true(whole > 15);
	}
	struct cola_writer w;
	cola_writer_init(&w, COLA_B, bytes, sizeof(bytes), "sRA X");
	cola_write_string(&w, "", 256, 1); /* a length its field cannot hold */
	assert_int_equal(cola_writer_end(&w), 0);
}

static struct cola_reader read_a(const char *payload, const char *name)
{
	struct cola_reader r;

	assert_true(cola_reader_init(&r, COLA_A, (const uint8_t *)payload, strlen(payload), name));
	return r;
}

static void numbers_are_read_by_their_sign_and_width(void **state)
{
	static const struct {
		const char *token;
		int bytes;
		bool good_u;
		uint32_t u;
		bool good_i;
		int32_t i;
	} cases[] = {
	    {"sRA X 0", 1, true, 0, true, 0},
	    {"sRA X 1388", 2, true, 5000, true, 5000},
	    {"sRA X FFF92230", 4, true, 0xFFF92230, true, -450000},
	    {"sRA X 22550D", 4, true, 2249997, true, 2249997},
	    {"sRA X +225", 1, true, 225, false, 0},
	    {"sRA X +127", 1, true, 127, true, 127},
	    {"sRA X -128", 1, false, 0, true, -128},
	    {"sRA X -129", 1, false, 0, false, 0},
	    {"sRA X -450000", 4, false, 0, true, -450000},
	    {"sRA X -2147483648", 4, false, 0, true, INT32_MIN},
	    {"sRA X -2147483649", 4, false, 0, false, 0},
	    {"sRA X +4294967295", 4, true, UINT32_MAX, false, 0},
	    {"sRA X +4294967296", 4, false, 0, false, 0},
	    {"sRA X -0", 2, true, 0, true, 0},
	    {"sRA X FFFF", 2, true, 65535, true, -1},
	    {"sRA X 10000", 2, false, 0, false, 0},
	    {"sRA X 100", 1, false, 0, false, 0},
	    {"sRA X 0001", 1, true, 1, true, 1},
	    {"sRA X 100000000", 4, false, 0, false, 0},
	    {"sRA X 00000000001", 4, false, 0, false, 0},
	    {"sRA X G", 1, false, 0, false, 0},
	    {"sRA X +A", 1, false, 0, false, 0},
	    {"sRA X +", 1, false, 0, false, 0},
	    {"sRA X 1.5", 2, false, 0, false, 0},
	    {"sRA X ", 1, false, 0, false, 0},
	    {"sRA X", 1, false, 0, false, 0},
	    {"sRA X  1", 1, false, 0, false, 0},
	};

	(void)state;
	for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
		struct cola_reader r = read_a(cases[i].token, "X");
		assert_int_equal(cola_read_u(&r, cases[i].bytes), cases[i].u);
		assert_int_equal(r.failed, !cases[i].good_u);
		assert_int_equal(cola_reader_done(&r), cases[i].good_u);
		r = read_a(cases[i].token, "X");
		assert_int_equal(cola_read_i(&r, cases[i].bytes), cases[i].i);
		assert_int_equal(r.failed, !cases[i].good_i);
	}
}

static void floats_are_read_by_their_bits_and_only_real_ones(void **state)
{
	static const uint8_t infinite[] = "sRA X \x7F\x80\x00\x00";
	struct cola_reader r = read_a("sRA X 3F800000 40000000 3DCCCCCD 0 BF800000", "X");

	(void)state;
	assert_true(cola_read_float(&r) == 1.0f);
	assert_true(cola_read_float(&r) == 2.0f);
	assert_true(cola_read_float(&r) == 0.1f);
	assert_true(cola_read_float(&r) == 0.0f);
	assert_true(cola_read_float(&r) == -1.0f);
	assert_true(cola_reader_done(&r));
	static const char *const bad[] = {"sRA X 7F800000", "sRA X FFC00000", "sRA X +1", "sRA X 1.0", "sRA X"};
	for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
		r = read_a(bad[i], "X");
		assert_true(cola_read_float(&r) == 0.0f && r.failed);
	}
	assert_true(cola_reader_init(&r, COLA_B, infinite, sizeof(infinite) - 1, "X"));
	assert_true(cola_read_float(&r) == 0.0f && r.failed);
}

static void strings_are_as_long_as_they_say_blanks_included(void **state)
{
	static const struct {
		const char *payload;
		size_t len;
		const char *text; /* NULL: refused */
	} cases[] = {
	    {"sRA X B not defined 5", 11, "not defined"},
	    {"sRA X 3 a b 5", 3, "a b"},
	    {"sRA X 2 a  5", 2, "a "},
	    {"sRA X 0 5", 0, ""},
	    {"sRA X 0  5", 0, ""},
	    {"sRA X 4 abc 5", 0, NULL}, /* ends inside a token */
	    {"sRA X 2 abc 5", 0, NULL},
	    {"sRA X FF abc 5", 0, NULL},
	    {"sRA X 100 abc 5", 0, NULL},
	    {"sRA X 3", 0, NULL},
	};

	(void)state;
	for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
		struct cola_reader r = read_a(cases[i].payload, "X");
		const char *text;
		size_t len;
		cola_read_string(&r, 1, &text, &len);
		assert_int_equal(len, cases[i].len);
		const bool good = cases[i].text != NULL;
		assert_int_equal(cola_read_u(&r, 1), good ? 5 : 0);
		assert_int_equal(cola_reader_done(&r), good);
		if (good)
			assert_memory_equal(text, cases[i].text, len);
		else
			assert_null(text);
	}
}

static void strings_have_their_length_before_them_in_cola_b(void **state)
{
	static const uint8_t payload[] = "sRA LocationName \x00\x0Bnot defined\x00\x00\x02x y";
	struct cola_reader r;
	const char *text;
	size_t len;

	(void)state;
	assert_true(cola_reader_init(&r, COLA_B, payload, sizeof(payload) - 2, "LocationName"));
	cola_read_string(&r, 2, &text, &len);
	assert_int_equal(len, 11);
	assert_memory_equal(text, "not defined", 11);
	cola_read_string(&r, 2, &text, &len);
	assert_int_equal(len, 0);
	assert_non_null(text);
	cola_read_string(&r, 1, &text, &len);
	assert_int_equal(len, 2);
	assert_memory_equal(text, "x ", 2);
	assert_true(cola_reader_done(&r));
	assert_true(cola_reader_init(&r, COLA_B, payload, 17 + 2 + 10, "LocationName"));
	cola_read_string(&r, 2, &text, &len);
	assert_true(r.failed && text == NULL && len == 0);
}

static void a_blank_behind_the_name_is_there_or_not(void **state)
{
	struct cola_reader r;

	(void)state;
	for (int dialect = COLA_A; dialect <= COLA_B; dialect++) {
		static const uint8_t payload[] = "sWA FREchoFilter ";
		for (size_t n = sizeof(payload) - 2; n < sizeof(payload); n++) {
			assert_true(cola_reader_init(&r, (enum cola_dialect)dialect, payload, n, "FREchoFilter"));
			assert_true(cola_reader_done(&r));
		}
		assert_false(cola_reader_init(&r, (enum cola_dialect)dialect, payload, sizeof(payload) - 1, "FREcho"));
		assert_false(cola_reader_init(&r, (enum cola_dialect)dialect, payload, 10, "FREchoFilter"));
		assert_true(r.at == r.end); /* and nothing is read from another one */
		assert_int_equal(cola_read_u(&r, 1), 0);
		assert_true(r.failed);
	}
}

static void an_error_code_is_read_with_and_without_its_blank(void **state)
{
	static const uint8_t bare[] = {'s', 'F', 'A', 0, 0x0F}, blank[] = {'s', 'F', 'A', ' ', 0, 0x0F};
	struct cola_reader r = read_a("sFA F", "");

	(void)state;
	assert_int_equal(cola_read_u(&r, 2), 15);
	assert_true(cola_reader_done(&r));
	assert_true(cola_reader_init(&r, COLA_B, bare, sizeof(bare), ""));
	assert_int_equal(cola_read_u(&r, 2), 15);
	assert_true(cola_reader_done(&r));
	assert_true(cola_reader_init(&r, COLA_B, blank, sizeof(blank), ""));
	assert_int_equal(cola_read_u(&r, 2), 15);
	assert_true(cola_reader_done(&r));
}

static void a_failed_reader_reads_nothing_any_more(void **state)
{
	struct cola_reader r = read_a("sRA X Z 1 2", "X");
	const char *text;

	(void)state;
	cola_read_u(&r, 1);
	assert_int_equal(cola_read_u(&r, 1), 0);
	assert_int_equal(cola_read_i(&r, 1), 0);
	cola_read_chars(&r, 0, &text);
	assert_null(text);
	assert_true(r.failed);
	assert_false(cola_reader_done(&r));
}

static void cola_b_values_of_every_width_are_big_endian(void **state)
{
	static const uint8_t payload[] = "sRA X \xFE\xFE\xDC\xFE\xDC\xBA\x98";
	struct cola_reader r;

	(void)state;
	assert_true(cola_reader_init(&r, COLA_B, payload, sizeof(payload) - 1, "X"));
	assert_int_equal(cola_read_u(&r, 1), 0xFE);
	assert_int_equal(cola_read_u(&r, 2), 0xFEDC);
	assert_int_equal(cola_read_u(&r, 4), 0xFEDCBA98);
	assert_true(cola_reader_done(&r));
	cola_reader_init(&r, COLA_B, payload, sizeof(payload) - 1, "X");
	assert_int_equal(cola_read_i(&r, 1), -2);
	assert_int_equal(cola_read_i(&r, 2), -0x124);
	assert_int_equal(cola_read_i(&r, 4), -0x1234568);
	for (size_t cut = 6; cut < sizeof(payload) - 1; cut++) {
		cola_reader_init(&r, COLA_B, payload, cut, "X");
		cola_read_u(&r, 1), cola_read_u(&r, 2), cola_read_u(&r, 4);
		assert_true(r.failed);
	}
}

static void every_error_code_has_its_own_words(void **state)
{
	(void)state;
	for (uint32_t code = 0; code <= 0x1B; code++) {
		assert_true(strlen(cola_error_text(code)) > 5);
		for (uint32_t other = 0; other < code; other++)
			assert_string_not_equal(cola_error_text(code), cola_error_text(other));
	}
	assert_string_equal(cola_error_text(3), "variable unknown");
	assert_string_equal(cola_error_text(UINT32_MAX), cola_error_text(0x1B));
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(known_frames_are_found_whole_and_no_shorter),
	    cmocka_unit_test(a_cola_b_frame_with_any_bit_changed_is_none),
	    cmocka_unit_test(what_is_no_frame_is_refused_by_its_first_bytes),
	    cmocka_unit_test(a_text_without_end_is_given_up_at_the_limit),
	    cmocka_unit_test(rubbish_is_read_about_once),
	    cmocka_unit_test(frames_give_their_payload_and_kind),
	    cmocka_unit_test(known_requests_are_written_byte_by_byte_in_cola_b),
	    cmocka_unit_test(known_requests_are_written_letter_by_letter_in_cola_a),
	    cmocka_unit_test(a_writer_without_room_says_so_and_writes_not_beyond),
	    cmocka_unit_test(numbers_are_read_by_their_sign_and_width),
	    cmocka_unit_test(floats_are_read_by_their_bits_and_only_real_ones),
	    cmocka_unit_test(strings_are_as_long_as_they_say_blanks_included),
	    cmocka_unit_test(strings_have_their_length_before_them_in_cola_b),
	    cmocka_unit_test(a_blank_behind_the_name_is_there_or_not),
	    cmocka_unit_test(an_error_code_is_read_with_and_without_its_blank),
	    cmocka_unit_test(a_failed_reader_reads_nothing_any_more),
	    cmocka_unit_test(cola_b_values_of_every_width_are_big_endian),
	    cmocka_unit_test(every_error_code_has_its_own_words),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

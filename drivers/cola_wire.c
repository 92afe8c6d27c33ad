/* SICK CoLa: frames, and the numbers in them (see cola_wire.h).
 *
 *   CoLa-A   02 | s R N | 20 | L M P s c a n c f g | { 20 token } | 03                              no check sum
 *   CoLa-B   02 02 02 02 | L L L L | s R N | 20 | L M P s c a n c f g | [ 20 value value ... ] | X
 *            L: length of what stands between it and X, big-endian; X: XOR of those bytes
 *
 *   value    CoLa-A: after one blank each; -450000 and +1 are decimal, anything without a sign is hexadecimal
 *            (FFF92230 is the same -450000), floats are the eight digits of their bits (3F800000 is 1.0)
 *            CoLa-B: big-endian, 1, 2 or 4 bytes, nothing between them
 *   string   its length as a value, then so many characters, which may be blanks: "B not defined"
 *
 * Oddities of devices in the field: an answer without values ends in a blank or does not, by the model; an error is
 * "sFA" and two bytes without a blank between them in CoLa-B, though a manual prints one; an empty string leaves one
 * blank or two in CoLa-A.
 *
 * Cost. A scan is asked again about a begun telegram with every push, and about every byte of rubbish. Whatever is no
 * telegram is therefore refused by its first letters or by its length, before it is waited for; and a CoLa-A telegram
 * ends at the first control character, good or bad, so that rubbish full of starts is read once and not once for each
 * of them. */
#include "drivers/cola_wire.h"

#include <assert.h>
#include <math.h>
#include <string.h>

#define START     0x02
#define END       0x03
#define HEAD_B    8 /* four times 02, and the length */
#define FRAME_B   9 /* what a CoLa-B frame adds to its payload */
#define PAYLOAD_B 5 /* the shortest: "sFA" and its code, "sRN X" */

static uint32_t big_endian(const uint8_t *at, int bytes)
{
	uint32_t value = 0;

	for (int i = 0; i < bytes; i++)
		value = value << 8 | at[i];
	return value;
}

static bool one_of(uint8_t letter, const char *letters)
{
	return letter != 0 && strchr(letters, letter) != NULL;
}

/* The first letters of a payload, as far as they are there: "sRN ", "sFA". */
static bool begins_well(const uint8_t *payload, size_t len)
{
	if (len > 0 && payload[0] != 's')
		return false;
	if (len > 1 && !one_of(payload[1], "RWMEASF"))
		return false;
	if (len > 2 && !one_of(payload[2], "NAI"))
		return false;
	return len < 4 || payload[3] == ' ' || payload[1] == 'F';
}

static int scan_a(const uint8_t *buf, size_t len)
{
	if (!begins_well(buf + 1, len - 1 < 3 ? len - 1 : 3))
		return -COLA_BAD_BYTE;
	for (size_t i = 4; i < len; i++) {
		if (buf[i] == END)
			return i > PAYLOAD_B ? (int)i + 1 : -COLA_BAD_BYTE;
		if (buf[i] < ' ' || (i == 4 && buf[i] != ' '))
			return -COLA_BAD_BYTE;
		if (i == COLA_TELEGRAM_MAX - 1)
			return -COLA_TOO_LONG;
	}
	return FRAMER_MORE;
}

static uint8_t sum_of(const uint8_t *bytes, size_t len)
{
	uint8_t sum = 0;

	for (size_t i = 0; i < len; i++)
		sum ^= bytes[i];
	return sum;
}

static int scan_b(const uint8_t *buf, size_t len)
{
	for (size_t i = 2; i < 4 && i < len; i++) {
		if (buf[i] != START)
			return -COLA_BAD_BYTE;
	}
	if (len < HEAD_B) /* a length is below 64 Ki: its first byte tells five times 02 from four */
		return len > 4 && buf[4] != 0 ? -COLA_TOO_LONG : FRAMER_MORE;
	const uint32_t payload = big_endian(buf + 4, 4);
	if (payload > COLA_TELEGRAM_MAX - FRAME_B)
		return -COLA_TOO_LONG;
	if (payload < PAYLOAD_B || !begins_well(buf + HEAD_B, len - HEAD_B < 4 ? len - HEAD_B : 4))
		return -COLA_BAD_BYTE;
	if (len < payload + FRAME_B)
		return FRAMER_MORE;
	if (sum_of(buf + HEAD_B, payload) != buf[HEAD_B + payload])
		return -COLA_BAD_SUM;
	return (int)payload + FRAME_B;
}

int cola_scan_frame(void *ctx, const uint8_t *buf, size_t len, bool boundary)
{
	(void)ctx;
	(void)boundary;
	if (buf[0] != START)
		return -FRAMER_NO_START;
	if (len < 2)
		return FRAMER_MORE;
	return buf[1] == START ? scan_b(buf, len) : scan_a(buf, len);
}

enum cola_dialect cola_payload(const uint8_t *frame, size_t len, const uint8_t **ret_payload, size_t *ret_len)
{
	if (frame[1] == START) {
		assert(len > FRAME_B);
		*ret_payload = frame + HEAD_B;
		*ret_len = len - FRAME_B;
		return COLA_B;
	}
	assert(len > 2);
	*ret_payload = frame + 1;
	*ret_len = len - 2;
	return COLA_A;
}

int cola_reply_kind(enum cola_dialect dialect, const uint8_t *payload, size_t len)
{
	static const struct {
		char word[4];
		enum cola_reply kind;
	} known[] = {{"sRA", COLA_READ},   {"sWA", COLA_WRITTEN}, {"sAN", COLA_METHOD},
	             {"sAI", COLA_METHOD}, {"sMA", COLA_LATER},   {"sEA", COLA_EVENT},
	             {"sSN", COLA_DATA},   {"sSI", COLA_DATA},    {"sFA", COLA_ERROR}};
	int kind = COLA_OTHER;

	for (size_t i = 0; i < sizeof(known) / sizeof(known[0]); i++) {
		if (len >= 3 && memcmp(payload, known[i].word, 3) == 0)
			kind = known[i].kind;
	}
	return dialect == COLA_B ? kind + COLA_B_FLAG : kind;
}

/* Reading. In CoLa-A `at` stands on the blank before the next value, in CoLa-B on its first byte. */

static void fail(struct cola_reader *r)
{
	r->failed = true;
	r->at = r->end;
}

bool cola_reader_init(struct cola_reader *r, enum cola_dialect dialect, const uint8_t *payload, size_t len,
                      const char *name)
{
	const size_t name_len = strlen(name);
	const size_t words = name_len > 0 ? 4 + name_len : 3;

	*r = (struct cola_reader){.dialect = dialect, .at = payload, .end = payload};
	if (len < words || (name_len > 0 && (payload[3] != ' ' || memcmp(payload + 4, name, name_len) != 0)))
		return false;
	if (name_len > 0 && len > words && payload[words] != ' ')
		return false;
	r->at = payload + words;
	r->end = payload + len;
	/* Behind a name stands a blank; an error code follows its word directly, or after the blank of the manual. */
	if (dialect == COLA_B && r->at < r->end && (name_len > 0 || (len == words + 3 && *r->at == ' ')))
		r->at++;
	return true;
}

/* A CoLa-A token: what stands behind one blank. Its length, 0: there is none, and that is a failure. */
static size_t token(struct cola_reader *r, const uint8_t **ret)
{
	if (r->failed || r->at >= r->end || *r->at != ' ') {
		fail(r);
		return 0;
	}
	const uint8_t *begin = r->at + 1, *end = begin;
	while (end < r->end && *end != ' ')
		end++;
	if (end == begin)
		fail(r);
	else
		r->at = end;
	*ret = begin;
	return (size_t)(end - begin);
}

/* Digits in a base, at most 32 bits; false: none, too many, or something else. */
static bool digits(const uint8_t *at, size_t len, unsigned base, uint32_t *ret)
{
	uint64_t value = 0;

	if (len == 0 || len > 10)
		return false;
	for (size_t i = 0; i < len; i++) {
		unsigned digit = 99;
		if (at[i] >= '0' && at[i] <= '9')
			digit = at[i] - '0';
		else if (at[i] >= 'A' && at[i] <= 'F')
			digit = at[i] - 'A' + 10;
		if (digit >= base)
			return false;
		value = value * base + digit;
		if (value > UINT32_MAX)
			return false;
	}
	*ret = (uint32_t)value;
	return true;
}

/* A CoLa-A number: its magnitude and its sign, 0 where it had none (hexadecimal). */
static uint32_t number(struct cola_reader *r, int *ret_sign)
{
	const uint8_t *at = NULL;
	const size_t len = token(r, &at);
	uint32_t value = 0;

	*ret_sign = 0;
	if (len == 0)
		return 0;
	if (*at == '+' || *at == '-')
		*ret_sign = *at == '-' ? -1 : 1;
	const bool is_signed = *ret_sign != 0;
	if (!digits(at + is_signed, len - is_signed, is_signed ? 10 : 16, &value)) {
		fail(r);
		return 0;
	}
	return value;
}

static const uint8_t *take(struct cola_reader *r, size_t n)
{
	const uint8_t *at = r->at;

	if (r->failed || (size_t)(r->end - r->at) < n) {
		fail(r);
		return NULL;
	}
	r->at += n;
	return at;
}

static uint32_t width_max(int bytes)
{
	return bytes >= 4 ? UINT32_MAX : (1u << 8 * bytes) - 1;
}

uint32_t cola_read_u(struct cola_reader *r, int bytes)
{
	if (r->dialect == COLA_B) {
		const uint8_t *at = take(r, (size_t)bytes);
		return at != NULL ? big_endian(at, bytes) : 0;
	}
	int sign;
	const uint32_t value = number(r, &sign);
	if (value > width_max(bytes) || (sign < 0 && value != 0)) {
		fail(r);
		return 0;
	}
	return value;
}

/* The bits of a two's complement number of some bytes. */
static int32_t extend(uint32_t value, int bytes)
{
	const uint32_t top = 1u << (8 * bytes - 1);

	return (int32_t)(int64_t)((value ^ top) - (int64_t)top);
}

int32_t cola_read_i(struct cola_reader *r, int bytes)
{
	if (r->dialect == COLA_B)
		return extend(cola_read_u(r, bytes), bytes);
	int sign;
	const uint32_t value = number(r, &sign), half = 1u << (8 * bytes - 1);
	const bool fits = sign == 0 ? value <= width_max(bytes) : value < half || (sign < 0 && value == half);
	if (!fits) {
		fail(r);
		return 0;
	}
	if (sign == 0)
		return extend(value, bytes);
	return (int32_t)(sign * (int64_t)value);
}

float cola_read_float(struct cola_reader *r)
{
	int sign = 0;
	const uint32_t bits = r->dialect == COLA_B ? cola_read_u(r, 4) : number(r, &sign);
	float value;

	memcpy(&value, &bits, sizeof(value));
	if (!isfinite(value) || sign != 0) {
		fail(r);
		return 0;
	}
	return value;
}

void cola_read_chars(struct cola_reader *r, size_t n, const char **ret)
{
	if (r->dialect == COLA_A) {
		const uint8_t *blank = take(r, 1);
		if (blank != NULL && *blank != ' ')
			fail(r);
	}
	*ret = (const char *)take(r, n);
	if (r->dialect == COLA_A && r->at < r->end && *r->at != ' ')
		fail(r);
	if (r->failed)
		*ret = NULL;
}

void cola_read_string(struct cola_reader *r, int bytes, const char **ret, size_t *ret_len)
{
	const size_t len = cola_read_u(r, bytes);

	*ret = NULL;
	*ret_len = 0;
	if (len == 0 && r->dialect == COLA_A) { /* nothing, or the blank before nothing */
		if (r->end - r->at > 1 && r->at[0] == ' ' && r->at[1] == ' ')
			r->at++;
		*ret = r->failed ? NULL : (const char *)r->at;
		return;
	}
	cola_read_chars(r, len, ret);
	*ret_len = r->failed ? 0 : len;
}

bool cola_reader_done(const struct cola_reader *r)
{
	const bool blank = r->dialect == COLA_A && r->end - r->at == 1 && *r->at == ' ';

	return !r->failed && (r->at == r->end || blank);
}

/* Writing. */

static void put(struct cola_writer *w, const void *bytes, size_t n)
{
	if (w->failed || n > w->cap - w->len) {
		w->failed = true;
		return;
	}
	if (n > 0)
		memcpy(w->bytes + w->len, bytes, n);
	w->len += n;
}

void cola_writer_init(struct cola_writer *w, enum cola_dialect dialect, uint8_t *bytes, size_t cap, const char *words)
{
	static const uint8_t head[HEAD_B] = {START, START, START, START};

	*w = (struct cola_writer){.dialect = dialect, .bytes = bytes, .cap = cap};
	put(w, head, dialect == COLA_B ? HEAD_B : 1);
	put(w, words, strlen(words));
}

/* The blank before a value: each one in CoLa-A, the first one in CoLa-B. The bytes themselves tell whether it is the
 * first: a name has no blank, so no second one stands behind it yet, or `words` brought it. */
static void separate(struct cola_writer *w)
{
	const size_t words = w->dialect == COLA_B ? HEAD_B : 1;

	if (w->failed)
		return;
	const bool is_error = w->len >= words + 3 && memcmp(w->bytes + words, "sFA", 3) == 0;
	const uint8_t *blank = NULL;
	if (w->len > words + 4)
		blank = memchr(w->bytes + words + 4, ' ', w->len - words - 4);
	const bool brought = blank != NULL && blank == w->bytes + w->len - 1;
	const bool first = blank == NULL && !is_error;
	if (w->dialect == COLA_A ? !brought : first)
		put(w, " ", 1);
}

static void put_number(struct cola_writer *w, uint32_t value, unsigned base, int least)
{
	char text[12];
	int at = sizeof(text);

	do {
		text[--at] = "0123456789ABCDEF"[value % base];
		value /= base;
	} while (value > 0 || (int)sizeof(text) - at < least);
	put(w, text + at, sizeof(text) - (size_t)at);
}

static void put_binary(struct cola_writer *w, uint32_t value, int bytes)
{
	const uint8_t big[4] = {(uint8_t)(value >> 24), (uint8_t)(value >> 16), (uint8_t)(value >> 8), (uint8_t)value};

	put(w, big + 4 - bytes, (size_t)bytes);
}

static void write_hex(struct cola_writer *w, uint32_t value, int bytes, int least)
{
	assert(bytes == 1 || bytes == 2 || bytes == 4);
	separate(w);
	if (w->dialect == COLA_A)
		put_number(w, value & width_max(bytes), 16, least);
	else
		put_binary(w, value, bytes);
}

void cola_write_u(struct cola_writer *w, uint32_t value, int bytes)
{
	write_hex(w, value, bytes, 1);
}

void cola_write_i(struct cola_writer *w, int32_t value, int bytes)
{
	write_hex(w, (uint32_t)value, bytes, 1);
}

void cola_write_digits(struct cola_writer *w, uint32_t value, int bytes)
{
	write_hex(w, value, bytes, 2 * bytes);
}

void cola_write_decimal(struct cola_writer *w, int32_t value, int bytes)
{
	if (w->dialect == COLA_B) {
		write_hex(w, (uint32_t)value, bytes, 1);
		return;
	}
	separate(w);
	put(w, value < 0 ? "-" : "+", 1);
	put_number(w, value < 0 ? 0u - (uint32_t)value : (uint32_t)value, 10, 1);
}

void cola_write_float(struct cola_writer *w, float value)
{
	uint32_t bits;

	memcpy(&bits, &value, sizeof(bits));
	cola_write_digits(w, bits, 4);
}

void cola_write_chars(struct cola_writer *w, const char *chars, size_t n)
{
	separate(w);
	put(w, chars, n);
}

void cola_write_string(struct cola_writer *w, const char *chars, size_t n, int bytes)
{
	if (n > width_max(bytes)) {
		w->failed = true;
		return;
	}
	cola_write_u(w, (uint32_t)n, bytes);
	if (n > 0)
		cola_write_chars(w, chars, n);
}

size_t cola_writer_end(struct cola_writer *w)
{
	const uint8_t end = END;

	if (w->dialect == COLA_A) {
		put(w, &end, 1);
	} else if (!w->failed) {
		const uint32_t payload = (uint32_t)w->len - HEAD_B;
		const uint8_t sum = sum_of(w->bytes + HEAD_B, payload);
		for (int i = 0; i < 4; i++)
			w->bytes[4 + i] = (uint8_t)(payload >> (24 - 8 * i));
		put(w, &sum, 1);
	}
	return w->failed || w->len > COLA_TELEGRAM_MAX ? 0 : w->len;
}

const char *cola_error_text(uint32_t code)
{
	static const char *const texts[] = {
	    "no error",
	    "access denied: the user level is too low for this method",
	    "method unknown (by its index)",
	    "variable unknown",
	    "a value is out of its limits",
	    "data invalid",
	    "an error the device has no word for",
	    "its buffer is too small for the request",
	    "too few values in the request",
	    "a value of unknown type",
	    "access denied: the variable cannot be written, or the user level is too low",
	    "command unknown to its name server",
	    "command unknown in this protocol",
	    "busy with another method",
	    "an array is longer than allowed",
	    "event unknown: the device has no such data to send",
	    "a value in the text is too long",
	    "a character in the text is not allowed",
	    "no message from its inner bus",
	    "no answer from its inner bus",
	    "internal error",
	    "address of a hub is damaged",
	    "address of a hub cannot be read",
	    "address of a hub is too long",
	    "a blank is missing in the address of a hub",
	    "asynchronous methods are suppressed",
	    "arrays this complex are not supported",
	};

	return code < sizeof(texts) / sizeof(texts[0]) ? texts[code] : "an error code that no manual explains";
}

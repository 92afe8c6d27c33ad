/* Lines of candump:
 *
 *    (1604665855.310219) can0 181#A8000001              a log; 6 or 9 decimals
 *    (1604665855.310219) can0 18FF0102#R5 R             remote, of 5 bytes; received (-x: R, T)
 *    (1604665855.310219) can0 181##1A800000102030405    FD: its flags, one digit, then the data
 *    (1604665855.310219) can0 181#1122334455667788_C    8 bytes under the length code 12
 *      can0  181   [8]  38 42 00 00 00 00 00 00         a terminal; FD frames with two digits [12]
 *     (000.304418)  can0  RX - -  181   [2]  38 42      with -t and -x
 *     (2020-11-06 13:10:55.310219)  can0  181   [5]  remote request
 *    DROPCOUNT: dropped 5 CAN frames on 'can0' socket (total drops 5)
 *
 * An id of 3 digits is standard, of 8 extended, or an error frame where it has that flag: the number of digits alone
 * tells 001 from 00000001. */
#include "drivers/candump.h"

#include <string.h>

#define ERROR_CLASSES 0x1fffffffu
#define SECONDS_MAX   (CAN_WIRE_TIME_MAX / 1000000000 - 1) /* until 2043: what an entry may say */

struct cursor {
	const char *at, *end;
};

static int peek(const struct cursor *c)
{
	return c->at < c->end ? (unsigned char)*c->at : -1;
}

static bool take(struct cursor *c, char wanted)
{
	if (peek(c) != (unsigned char)wanted)
		return false;
	c->at++;
	return true;
}

static bool take_word(struct cursor *c, const char *word)
{
	const size_t n = strlen(word);

	if ((size_t)(c->end - c->at) < n || memcmp(c->at, word, n) != 0)
		return false;
	c->at += n;
	return true;
}

static bool blanks(struct cursor *c)
{
	const char *from = c->at;

	while (peek(c) == ' ' || peek(c) == '\t')
		c->at++;
	return c->at > from;
}

static int hex(int letter)
{
	if (letter >= '0' && letter <= '9')
		return letter - '0';
	if (letter >= 'A' && letter <= 'F')
		return letter - 'A' + 10;
	return letter >= 'a' && letter <= 'f' ? letter - 'a' + 10 : -1;
}

/* Digits taken; 0: none, or more than `most`. */
static int number(struct cursor *c, int base, int most, uint64_t *ret)
{
	uint64_t v = 0;
	int n = 0;

	for (int digit; n <= most && (digit = hex(peek(c))) >= 0 && digit < base; n++, c->at++)
		v = v * (uint64_t)base + (uint64_t)digit;
	if (n == 0 || n > most)
		return 0;
	*ret = v;
	return n;
}

/* Days from 1970-01-01, Gregorian: years begin in March, so that leap days are last. */
static int64_t days_of(int64_t year, int64_t month, int64_t day)
{
	const int64_t y = month <= 2 ? year - 1 : year;
	const int64_t m = month <= 2 ? month + 9 : month - 3;

	return 365 * y + y / 4 - y / 100 + y / 400 + (153 * m + 2) / 5 + day - 1 - 719468;
}

/* The rest of a date after its year. */
static bool date(struct cursor *c, uint64_t year, int64_t *ret_s)
{
	uint64_t month, day, hour, minute, second;

	if (!number(c, 10, 2, &month) || !take(c, '-') || !number(c, 10, 2, &day) || !blanks(c) ||
	    !number(c, 10, 2, &hour) || !take(c, ':') || !number(c, 10, 2, &minute) || !take(c, ':') ||
	    !number(c, 10, 2, &second))
		return false;
	if (month < 1 || month > 12 || day < 1 || day > 31 || hour > 23 || minute > 59 || second > 60 || year < 1970 ||
	    year > 2200)
		return false;
	*ret_s =
	    ((days_of((int64_t)year, (int64_t)month, (int64_t)day) * 24 + (int64_t)hour) * 60 + (int64_t)minute) * 60 +
	    (int64_t)second;
	return true;
}

static bool time_of(struct cursor *c, int64_t *ret_ns)
{
	uint64_t whole, part;
	int64_t s;
	int digits;

	if (!take(c, '(') || !number(c, 10, 19, &whole) || whole > (uint64_t)SECONDS_MAX)
		return false;
	s = (int64_t)whole;
	if (take(c, '-') && (!date(c, whole, &s) || s > SECONDS_MAX))
		return false;
	if (!take(c, '.') || !(digits = number(c, 10, 9, &part)) || !take(c, ')'))
		return false;
	for (; digits < 9; digits++)
		part *= 10;
	*ret_ns = s * 1000000000 + (int64_t)part;
	return blanks(c);
}

static bool interface(struct cursor *c, char ret[CANDUMP_INTERFACE_MAX])
{
	size_t n = 0;

	for (int letter; (letter = peek(c)) > ' ' && letter < 127 && letter != '#'; c->at++) {
		if (n + 1 >= CANDUMP_INTERFACE_MAX)
			return false;
		ret[n++] = (char)letter;
	}
	return n > 0 && blanks(c);
}

static bool id_of(struct cursor *c, uint32_t *ret)
{
	uint64_t v;
	const int digits = number(c, 16, 8, &v);

	if (digits == 3 && v <= 0x7ff)
		*ret = (uint32_t)v;
	else if (digits == 8 && v & CAN_WIRE_ERROR)
		*ret = ((uint32_t)v & ERROR_CLASSES) | CAN_WIRE_ERROR;
	else if (digits == 8 && v <= 0x1fffffff)
		*ret = (uint32_t)v | CAN_WIRE_EXTENDED;
	else
		return false;
	return true;
}

/* Pairs of digits, one blank or dot between them or none; false: half a byte, or more than `most`. */
static bool bytes_of(struct cursor *c, size_t most, struct can_frame_at *f)
{
	while (hex(peek(c)) >= 0) {
		const int high = hex(peek(c)), low = c->at + 1 < c->end ? hex((unsigned char)c->at[1]) : -1;

		if (low < 0 || f->len >= most)
			return false;
		f->data[f->len++] = (uint8_t)(high << 4 | low);
		c->at += 2;
		if (peek(c) == '.' || (peek(c) == ' ' && c->at + 2 < c->end && hex((unsigned char)c->at[1]) >= 0 &&
		                       hex((unsigned char)c->at[2]) >= 0))
			c->at++;
	}
	return true;
}

static bool is_fd_length(size_t len)
{
	return len <= 8 || (len <= 24 && len % 4 == 0) || len == 32 || len == 48 || len == 64;
}

/* What stands behind '#' in a log. */
static bool log_data(struct cursor *c, struct candump_line *ret)
{
	struct can_frame_at *f = &ret->frame;
	uint64_t v;

	if (take(c, '#')) {
		const int flags = hex(peek(c));

		if (flags < 0)
			return false;
		c->at++;
		f->flags = (uint8_t)(flags | CAN_WIRE_FD);
		if (!bytes_of(c, 64, f))
			return false;
		return is_fd_length(f->len);
	}
	if (take(c, 'R')) {
		f->id |= CAN_WIRE_REMOTE;
		if (number(c, 10, 1, &v))
			f->len = (uint8_t)v;
		if (f->len > 8)
			return false;
	} else if (!bytes_of(c, 8, f)) {
		return false;
	}
	if (take(c, '_')) {
		if (f->len != 8 || !number(c, 16, 1, &v) || v < 9)
			return false;
		ret->raw_dlc = (uint8_t)v;
	}
	return true;
}

static bool log_end(struct cursor *c, struct candump_line *ret)
{
	if (blanks(c) && (peek(c) == 'R' || peek(c) == 'T'))
		ret->direction = *c->at++;
	blanks(c);
	return c->at == c->end;
}

/* "RX - -  ": the way, and two flags that say whose frame it was. */
static void terminal_direction(struct cursor *c, struct candump_line *ret)
{
	if ((peek(c) != 'R' && peek(c) != 'T') || c->at + 2 > c->end || c->at[1] != 'X')
		return;
	ret->direction = *c->at;
	c->at += 2;
	while (peek(c) == ' ' || peek(c) == '-' || (c->at + 1 < c->end && c->at[1] == ' '))
		c->at++;
}

/* "[8]  38 42 ..", "{C}  ..", "[4]  remote request". */
static bool terminal_data(struct cursor *c, struct candump_line *ret)
{
	struct can_frame_at *f = &ret->frame;
	uint64_t len;
	int digits;

	if (take(c, '{')) {
		if (!number(c, 16, 1, &len) || len < 9 || !take(c, '}'))
			return false;
		ret->raw_dlc = (uint8_t)len;
		len = 8;
	} else {
		if (!take(c, '[') || !(digits = number(c, 10, 2, &len)) || !take(c, ']') || !is_fd_length(len) ||
		    (digits == 1 && len > 8))
			return false;
		f->flags = digits == 2 ? CAN_WIRE_FD : 0;
	}
	blanks(c);
	if (take_word(c, "remote request")) {
		f->id |= CAN_WIRE_REMOTE;
		f->len = (uint8_t)len;
		return len <= 8;
	}
	return bytes_of(c, len, f) && f->len == len && (c->at == c->end || blanks(c));
}

static enum candump_kind dropped(struct cursor *c, struct candump_line *ret)
{
	size_t n = 0;

	if (!take_word(c, " dropped ") || !number(c, 10, 19, &ret->dropped) || !take_word(c, " CAN frame"))
		return CANDUMP_BAD;
	take(c, 's');
	if (!take_word(c, " on '"))
		return CANDUMP_BAD;
	for (; peek(c) >= 0 && peek(c) != '\'' && n + 1 < CANDUMP_INTERFACE_MAX; c->at++)
		ret->interface[n++] = *c->at;
	return take(c, '\'') ? CANDUMP_DROPPED : CANDUMP_BAD;
}

static bool frame(struct cursor *c, struct candump_line *ret)
{
	ret->timed = peek(c) == '(';
	if (ret->timed && !time_of(c, &ret->frame.t_ns))
		return false;
	if (!interface(c, ret->interface))
		return false;
	terminal_direction(c, ret);
	if (!id_of(c, &ret->frame.id))
		return false;
	if (take(c, '#'))
		return log_data(c, ret) && log_end(c, ret);
	return blanks(c) && terminal_data(c, ret);
}

enum candump_kind candump_read(const char *line, size_t len, struct candump_line *ret)
{
	struct cursor c = {line, line + len};
	struct candump_line found = {.timed = false};
	enum candump_kind kind = CANDUMP_BAD;

	*ret = found;
	while (c.end > c.at && (c.end[-1] == '\n' || c.end[-1] == '\r'))
		c.end--;
	if (peek(&c) == '\t' || peek(&c) == '#') /* words under an error frame; a comment */
		return CANDUMP_NOTHING;
	blanks(&c);
	if (c.at == c.end)
		return CANDUMP_NOTHING;
	if (take_word(&c, "DROPCOUNT:"))
		kind = dropped(&c, &found);
	else if (frame(&c, &found))
		kind = CANDUMP_FRAME;
	if (kind != CANDUMP_BAD)
		*ret = found;
	return kind;
}

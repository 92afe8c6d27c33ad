/* A number is digits, a point and an exponent, then at most one suffix of its dimension. strtod alone would also take
 * hexadecimal floats, `inf`, `nan` and leading blanks, none of which means anything in a configuration: the shape is
 * judged first and strtod only converts. Factors are written once, below; the first suffix of a dimension whose factor
 * is at most the value is the one that messages use. */
#include "config/units.h"

#include <errno.h>
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define NUMBER_MAX 64 /* characters of a number: longer ones are no numbers */
#define HEX        "0123456789abcdefABCDEF"
#define DEGREE     0.017453292519943295

struct suffix {
	const char *text;
	double factor;
};

static const struct suffix suffixes[DIMENSIONS][12] = {
    [DIMENSION_NONE] = {{"G", 1e9}, {"M", 1e6}, {"k", 1e3}, {"", 1}},
    [DIMENSION_LENGTH] = {{"m", 1}, {"cm", 0.01}, {"mm", 0.001}, {"", 1}},
    [DIMENSION_ANGLE] = {{"deg", DEGREE}, {"rad", 1}, {"mrad", 0.001}, {"", 1}},
    [DIMENSION_TIME] = {{"h", 3600}, {"min", 60}, {"s", 1}, {"ms", 1e-3}, {"us", 1e-6}, {"ns", 1e-9}, {"", 1}},
    [DIMENSION_RATE] = {{"deg/s", DEGREE}, {"rad/s", 1}, {"deg", DEGREE}, {"rad", 1}, {"", 1}},
    [DIMENSION_SIGNAL] = {{"deg", DEGREE},
                          {"m", 1},
                          {"deg/s", DEGREE},
                          {"m/s", 1},
                          {"cm", 0.01},
                          {"mm", 0.001},
                          {"mm/s", 0.001},
                          {"rad", 1},
                          {"mrad", 0.001},
                          {"rad/s", 1},
                          {"", 1}},
    [DIMENSION_FREQUENCY] = {{"Hz", 1}, {"", 1}},
    [DIMENSION_BYTES] = {{"G", 1073741824.0}, {"M", 1048576.0}, {"k", 1024.0}, {"", 1}},
};

static const char *const lists[DIMENSIONS] = {
    [DIMENSION_NONE] = "k, M, G",         [DIMENSION_LENGTH] = "m, cm, mm",
    [DIMENSION_ANGLE] = "deg, rad, mrad", [DIMENSION_TIME] = "h, min, s, ms, us, ns",
    [DIMENSION_RATE] = "deg/s, rad/s",    [DIMENSION_BYTES] = "k, M, G",
    [DIMENSION_FREQUENCY] = "Hz",         [DIMENSION_SIGNAL] = "deg, deg/s, rad, rad/s, m, m/s, mm, mm/s",
};

static size_t digits(const char *text)
{
	return strspn(text, "0123456789");
}

/* Characters of the decimal number that `text` begins with; 0: none. */
static size_t number_length(const char *text)
{
	size_t n = text[0] == '-' || text[0] == '+';
	const size_t whole = digits(text + n);
	n += whole;
	size_t fraction = 0;
	if (text[n] == '.') {
		fraction = digits(text + n + 1);
		n += 1 + fraction;
	}
	if (whole + fraction == 0)
		return 0;
	if (text[n] == 'e' || text[n] == 'E') {
		const size_t sign = text[n + 1] == '-' || text[n + 1] == '+';
		const size_t exponent = digits(text + n + 1 + sign);
		if (exponent)
			n += 1 + sign + exponent;
	}
	return n;
}

static const struct suffix *find_suffix(const char *text, enum dimension dimension)
{
	for (const struct suffix *s = suffixes[dimension]; s->text; s++)
		if (strcmp(s->text, text) == 0)
			return s;
	return NULL;
}

/* Registers, masks and identifiers are written as their handbooks do: 0x181. */
static bool parse_hex(const char *text, double *ret)
{
	const size_t n = text[0] == '0' && (text[1] == 'x' || text[1] == 'X') ? strspn(text + 2, HEX) : 0;

	if (n == 0 || n > 8 || text[2 + n])
		return false;
	*ret = (double)strtoul(text + 2, NULL, 16);
	return true;
}

int units_parse(const char *text, enum dimension dimension, double *ret)
{
	char copy[NUMBER_MAX];
	size_t n = number_length(text);
	if (dimension == DIMENSION_NONE && parse_hex(text, ret))
		return 0;
	if (n == 0 || n >= sizeof(copy))
		return -EINVAL;
	memcpy(copy, text, n);
	copy[n] = '\0';
	if (text[n] == ' ')
		n++;
	const struct suffix *suffix = find_suffix(text + n, dimension);
	if (!suffix)
		return -ENOTSUP;
	const double value = strtod(copy, NULL) * suffix->factor;
	if (!isfinite(value))
		return -EINVAL;
	*ret = value;
	return 0;
}

const char *units_suffixes(enum dimension dimension)
{
	return lists[dimension];
}

void units_print(double value, enum dimension dimension, char *ret, size_t cap)
{
	if (dimension == DIMENSION_NONE) { /* an address of 65.535k helps nobody */
		snprintf(ret, cap, "%.10g", value);
		return;
	}
	const struct suffix *best = suffixes[dimension];
	const double size = fabs(value) * (1 + 1e-12); /* 60 s are 1min, whatever the last bit of 60 says */
	while (best->text[0] && best[1].text && (size < best->factor || size == 0) && dimension != DIMENSION_ANGLE &&
	       dimension != DIMENSION_RATE)
		best++;
	snprintf(ret, cap, "%.7g%s", value / best->factor, best->text);
}

/* Numbers with units, as people write them: `0.05`, `30deg`, `5 min`, `256M`. A number without a suffix is SI. */
#ifndef FACET_CONFIG_UNITS_H
#define FACET_CONFIG_UNITS_H

#include <stddef.h>

enum dimension {
	DIMENSION_NONE, /* k, M, G are powers of 1000; also 0x1F */
	DIMENSION_LENGTH,
	DIMENSION_ANGLE,
	DIMENSION_TIME,
	DIMENSION_RATE, /* rad/s; `30deg` is read as 30deg/s */
	DIMENSION_FREQUENCY,
	DIMENSION_SIGNAL, /* of a CAN signal: angle, way, or either per second */
	DIMENSION_BYTES,  /* k, M, G are powers of 1024 */
	DIMENSIONS
};

/* 0 with the value in SI; -EINVAL: not a number; -ENOTSUP: a number with a suffix that this dimension does not have. */
int units_parse(const char *text, enum dimension, double *ret);

/* The suffixes of a dimension, as a list for messages. */
const char *units_suffixes(enum dimension);

/* A value in the suffix people would use: `15deg`, `30ms`, `256M`. */
void units_print(double value, enum dimension, char *ret, size_t cap);

#endif

/* What the readers of clouds share: points that grow, fields of files by name and type. */
#ifndef FACET_CORE_CLOUD_H
#define FACET_CORE_CLOUD_H

#include <stdbool.h>

#include "core/model.h"

struct cloud_builder {
	struct cloud cloud;
	size_t cap;
	size_t left_out;
};

/* Points that are no numbers or farther than 1000 km are left out (drivers write NaN where nothing was seen).
 * 0 or -ENOMEM. */
int cloud_add(struct cloud_builder *, double x, double y, double z);

/* Hands the points out, or refuses a file that had none: 0, -EINVAL with a sentence. Frees them where `r` < 0. */
int cloud_take(struct cloud_builder *, int r, struct cloud *ret, struct parse_error *error);

/* Sets the sentence; -EINVAL. */
int cloud_refuse(struct parse_error *error, uint32_t line, const char *sentence);

enum number_type {
	NUMBER_NONE,
	NUMBER_I8,
	NUMBER_U8,
	NUMBER_I16,
	NUMBER_U16,
	NUMBER_I32,
	NUMBER_U32,
	NUMBER_I64,
	NUMBER_U64,
	NUMBER_F32,
	NUMBER_F64
};

int number_size(enum number_type);
double number_load(const uint8_t *bytes, enum number_type, bool big_endian);

#endif

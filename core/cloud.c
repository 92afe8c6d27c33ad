/* See cloud.h. */
#include "core/cloud.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define FAR_M 1e6

int cloud_add(struct cloud_builder *b, double x, double y, double z)
{
	if (!(fabs(x) <= FAR_M && fabs(y) <= FAR_M && fabs(z) <= FAR_M)) {
		b->left_out++;
		return 0;
	}
	if (b->cloud.n == b->cap) {
		size_t cap = b->cap ? b->cap * 2 : 1024;
		struct vec3 *grown = realloc(b->cloud.point, cap * sizeof *grown);
		if (!grown)
			return -ENOMEM;
		b->cloud.point = grown;
		b->cap = cap;
	}
	b->cloud.point[b->cloud.n++] = (struct vec3){x, y, z};
	return 0;
}

int cloud_refuse(struct parse_error *error, uint32_t line, const char *sentence)
{
	error->line = line;
	snprintf(error->text, sizeof error->text, "%s", sentence);
	return -EINVAL;
}

int cloud_take(struct cloud_builder *b, int r, struct cloud *ret, struct parse_error *error)
{
	if (r == 0 && b->cloud.n == 0)
		r = cloud_refuse(error, 0,
		                 b->left_out ? "no points within 1000 km of its origin; shift the cloud there first"
		                             : "no points in it");
	if (r < 0)
		cloud_finish(&b->cloud);
	else
		*ret = b->cloud;
	return r;
}

void cloud_finish(struct cloud *cloud)
{
	free(cloud->point);
	*cloud = (struct cloud){0};
}

int number_size(enum number_type type)
{
	static const uint8_t size[] = {0, 1, 1, 2, 2, 4, 4, 8, 8, 4, 8};
	return size[type];
}

double number_load(const uint8_t *bytes, enum number_type type, bool big_endian)
{
	uint64_t bits = 0;
	int size = number_size(type);
	for (int i = 0; i < size; i++)
		bits |= (uint64_t)bytes[big_endian ? size - 1 - i : i] << (8 * i);
	switch (type) {
	case NUMBER_I8:
		return (int8_t)bits;
	case NUMBER_I16:
		return (int16_t)bits;
	case NUMBER_I32:
		return (int32_t)bits;
	case NUMBER_I64:
		return (double)(int64_t)bits;
	case NUMBER_F32: {
		uint32_t word = (uint32_t)bits;
		float value;
		memcpy(&value, &word, sizeof value);
		return (double)value;
	}
	case NUMBER_F64: {
		double value;
		memcpy(&value, &bits, sizeof value);
		return value;
	}
	case NUMBER_NONE:
	case NUMBER_U8:
	case NUMBER_U16:
	case NUMBER_U32:
	case NUMBER_U64:
		break;
	}
	return (double)bits;
}

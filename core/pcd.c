/* PCD, the Point Cloud Library's files: a header of text lines, then points.
 *
 *   # .PCD v0.7                           comments
 *   VERSION 0.7
 *   FIELDS x y z intensity                names,
 *   SIZE 4 4 4 4                          bytes of each,
 *   TYPE F F F U                          F float, I signed, U unsigned,
 *   COUNT 1 1 1 1                         how many of each (absent: 1)
 *   WIDTH 640 / HEIGHT 480 / VIEWPOINT ... / POINTS 307200
 *   DATA ascii | binary | binary_compressed
 *
 * binary: points one after the other, little-endian. binary_compressed: u32 compressed size, u32 size, then an LZF stream of
 * all x, all y, all z, ...: field after field. What nothing was seen at is NaN. VIEWPOINT is not applied: writers disagree
 * on whether the points are already in its frame; where the scanner was is the caller's to say. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/cloud.h"
#include "core/text.h"

#define FIELDS_MAX    64
#define COUNT_MAX     65536
#define LZF_RATIO_MAX 100 /* 264 bytes from 3 are the most that LZF makes */

struct field_of_point {
	enum number_type type;
	char kind; /* F, I, U */
	int size, count;
	size_t offset; /* within a point */
	size_t column; /* numbers of the fields before, for ascii */
};

struct header {
	struct field_of_point field[FIELDS_MAX];
	int fields, sizes, kinds;
	int axis[3]; /* the fields x, y, z; -1 */
	double points, width, height;
	size_t stride, columns;
	enum { DATA_NONE, DATA_ASCII, DATA_BINARY, DATA_COMPRESSED } data;
};

static bool is_word(const char *word, size_t len, const char *expected)
{
	return len == strlen(expected) && memcmp(word, expected, len) == 0;
}

/* Cuts the next word off a line; 0 at its end. */
static size_t take_word(const char **line, const char *end, const char **ret)
{
	while (*line < end && (**line == ' ' || **line == '\t'))
		++*line;
	*ret = *line;
	while (*line < end && **line != ' ' && **line != '\t')
		++*line;
	return (size_t)(*line - *ret);
}

static double word_number(const char *word, size_t len)
{
	struct text text;
	double value;
	text_init(&text, word, len);
	return text_number(&text, &value) && text_ended(&text) ? value : -1;
}

static bool read_fields(struct header *h, const char *line, const char *end)
{
	const char *word;
	size_t len;
	for (h->fields = 0; (len = take_word(&line, end, &word)) > 0; h->fields++) {
		if (h->fields == FIELDS_MAX)
			return false;
		h->field[h->fields] = (struct field_of_point){.size = 4, .kind = 'F', .count = 1};
		for (int i = 0; i < 3; i++)
			if (len == 1 && word[0] == "xyz"[i])
				h->axis[i] = h->fields;
	}
	return true;
}

/* SIZE, TYPE or COUNT: one word for each field. */
static bool read_property(struct header *h, char which, const char *line, const char *end)
{
	const char *word;
	size_t len;
	int i = 0;
	for (; (len = take_word(&line, end, &word)) > 0; i++) {
		if (i == h->fields)
			return false;
		double value = word_number(word, len);
		if (which == 'T' && len == 1 && strchr("FIU", word[0]))
			h->field[i].kind = word[0];
		else if (which == 'S' && (value == 1 || value == 2 || value == 4 || value == 8))
			h->field[i].size = (int)value;
		else if (which == 'C' && value >= 0 && value <= COUNT_MAX)
			h->field[i].count = (int)value;
		else
			return false;
	}
	return i == h->fields;
}

static bool read_data(struct header *h, const char *line, const char *end)
{
	const char *word;
	size_t len = take_word(&line, end, &word);
	h->data = is_word(word, len, "ascii")               ? DATA_ASCII
	          : is_word(word, len, "binary")            ? DATA_BINARY
	          : is_word(word, len, "binary_compressed") ? DATA_COMPRESSED
	                                                    : DATA_NONE;
	return h->data != DATA_NONE;
}

static bool read_line(struct header *h, const char *line, const char *end)
{
	const char *key, *word;
	size_t len = take_word(&line, end, &key);
	if (is_word(key, len, "FIELDS") || is_word(key, len, "COLUMNS"))
		return read_fields(h, line, end);
	if (is_word(key, len, "SIZE") || is_word(key, len, "TYPE") || is_word(key, len, "COUNT"))
		return read_property(h, key[0], line, end);
	if (is_word(key, len, "DATA"))
		return read_data(h, line, end);
	double *number = is_word(key, len, "POINTS")   ? &h->points
	                 : is_word(key, len, "WIDTH")  ? &h->width
	                 : is_word(key, len, "HEIGHT") ? &h->height
	                                               : NULL;
	if (!number)
		return is_word(key, len, "VERSION") || is_word(key, len, "VIEWPOINT");
	len = take_word(&line, end, &word);
	*number = word_number(word, len);
	return *number >= 0 && *number <= 1e12;
}

static enum number_type field_type(const struct field_of_point *f)
{
	if (f->kind == 'F')
		return f->size == 4 ? NUMBER_F32 : f->size == 8 ? NUMBER_F64 : NUMBER_NONE;
	enum number_type first = f->size == 1   ? NUMBER_I8
	                         : f->size == 2 ? NUMBER_I16
	                         : f->size == 4 ? NUMBER_I32
	                                        : NUMBER_I64;
	return f->kind == 'I' ? first : first + 1;
}

/* What follows from the lines together. */
static int finish_header(struct header *h, uint32_t line, struct parse_error *error)
{
	for (int i = 0; i < h->fields; i++) {
		struct field_of_point *f = &h->field[i];
		f->type = field_type(f);
		f->offset = h->stride;
		f->column = h->columns;
		h->stride += (size_t)f->size * (size_t)f->count;
		h->columns += (size_t)f->count;
	}
	for (int i = 0; i < 3; i++) {
		if (h->axis[i] < 0)
			return cloud_refuse(error, line, "the header names no fields x y z");
		if (h->field[h->axis[i]].type == NUMBER_NONE || h->field[h->axis[i]].count != 1)
			return cloud_refuse(error, line, "x, y or z has a size that is no number's");
	}
	if (h->points < 0)
		h->points = h->width >= 0 && h->height >= 0 ? h->width * h->height : -1;
	if (h->points < 0)
		return cloud_refuse(error, line, "the header does not say how many POINTS there are");
	return 0;
}

static int read_header(struct text *text, struct header *h, struct parse_error *error)
{
	*h = (struct header){.axis = {-1, -1, -1}, .points = -1, .width = -1, .height = -1};
	while (h->data == DATA_NONE && text_skip_empty(text)) {
		const char *line;
		uint32_t number = text->line;
		size_t len = text_take_line(text, &line);
		if (!read_line(h, line, line + len))
			return cloud_refuse(error, number, "this is no line of a PCD header; is this a PCD file?");
	}
	if (h->data == DATA_NONE)
		return cloud_refuse(error, text->line, "the header has no DATA line; the file is cut or no PCD file");
	return finish_header(h, text->line, error);
}

static int read_ascii(struct text *text, const struct header *h, struct cloud_builder *builder,
                      struct parse_error *error)
{
	for (double i = 0; i < h->points; i++) {
		if (!text_skip_empty(text))
			return cloud_refuse(error, text->line, "the file ends before its last point; it was cut");
		double p[3] = {0}, value;
		for (size_t k = 0; k < h->columns; k++) {
			if (!text_number(text, &value))
				return cloud_refuse(error, text->line,
				                    "a point has fewer numbers than the header's fields");
			for (int axis = 0; axis < 3; axis++)
				if (h->field[h->axis[axis]].column == k)
					p[axis] = value;
		}
		int r = cloud_add(builder, p[0], p[1], p[2]);
		if (r < 0)
			return r;
		text_next_line(text);
	}
	return 0;
}

/* Points as records (`by_field` false) or as one array for each field. */
static int read_numbers(const uint8_t *data, size_t n, const struct header *h, bool by_field,
                        struct cloud_builder *builder)
{
	for (size_t i = 0; i < n; i++) {
		double p[3];
		for (int axis = 0; axis < 3; axis++) {
			const struct field_of_point *f = &h->field[h->axis[axis]];
			size_t at = by_field ? f->offset * n + i * (size_t)f->size : i * h->stride + f->offset;
			p[axis] = number_load(data + at, f->type, false);
		}
		int r = cloud_add(builder, p[0], p[1], p[2]);
		if (r < 0)
			return r;
	}
	return 0;
}

/* LZF: a control byte below 32 begins a run of literals; else its upper three bits (7: plus the next byte) are a length less
 * two, its lower five and the byte behind a distance back less one. True when exactly `size` bytes came out. */
static bool lzf_expand(const uint8_t *in, size_t len, uint8_t *out, size_t size)
{
	size_t i = 0, o = 0;
	while (i < len) {
		size_t control = in[i++];
		if (control < 32) {
			size_t run = control + 1;
			if (run > len - i || run > size - o)
				return false;
			memcpy(out + o, in + i, run);
			i += run;
			o += run;
			continue;
		}
		size_t run = control >> 5;
		if (run == 7) {
			if (i == len)
				return false;
			run += in[i++];
		}
		run += 2;
		if (i == len)
			return false;
		size_t back = ((control & 31) << 8) + in[i++] + 1;
		if (back > o || run > size - o)
			return false;
		for (; run > 0; run--, o++)
			out[o] = out[o - back];
	}
	return o == size;
}

static int read_compressed(const uint8_t *data, size_t len, const struct header *h, struct cloud_builder *builder,
                           struct parse_error *error)
{
	if (len < 8)
		return cloud_refuse(error, 0, "the file ends before its points; it was cut");
	size_t packed = (size_t)number_load(data, NUMBER_U32, false),
	       size = (size_t)number_load(data + 4, NUMBER_U32, false);
	if (packed > len - 8)
		return cloud_refuse(error, 0, "the file ends before its last point; it was cut");
	if ((double)size != h->points * (double)h->stride || size / LZF_RATIO_MAX > packed)
		return cloud_refuse(error, 0, "the size of the compressed points does not fit the header");
	uint8_t *plain = malloc(size + 1);
	if (!plain)
		return -ENOMEM;
	int r = lzf_expand(data + 8, packed, plain, size)
	            ? read_numbers(plain, (size_t)h->points, h, true, builder)
	            : cloud_refuse(error, 0, "the compressed points cannot be expanded; the file is damaged");
	free(plain);
	return r;
}

int pcd_read(const uint8_t *data, size_t len, struct cloud *ret, struct parse_error *error)
{
	struct cloud_builder builder = {0};
	struct header header;
	struct text text;
	text_init(&text, data, len);
	int r = read_header(&text, &header, error);
	size_t left = (size_t)(text.end - text.at);
	const uint8_t *rest = (const uint8_t *)text.at;
	if (r == 0 && header.data == DATA_ASCII)
		r = read_ascii(&text, &header, &builder, error);
	else if (r == 0 && header.data == DATA_COMPRESSED)
		r = read_compressed(rest, left, &header, &builder, error);
	else if (r == 0 && header.points * (double)header.stride > (double)left)
		r = cloud_refuse(error, 0, "the file ends before its last point; it was cut");
	else if (r == 0)
		r = read_numbers(rest, (size_t)header.points, &header, false, &builder);
	return cloud_take(&builder, r, ret, error);
}

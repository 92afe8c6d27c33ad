/* PLY as a cloud: the x y z of its vertices.
 *
 *   ply
 *   format ascii 1.0                 or binary_little_endian, binary_big_endian
 *   comment ...                      obj_info ...
 *   element vertex 1000              elements come in this order behind the header
 *   property float x                 numbers ...
 *   property list uchar int indices  ... or a count and so many of them
 *   end_header
 *
 * Elements before the vertices are walked over; what comes after them is not looked at. A count from the header is judged
 * against what is left of the file before it is used. */
#include <errno.h>
#include <stdio.h>
#include <string.h>

#include "core/cloud.h"
#include "core/text.h"

#define ELEMENTS_MAX   16
#define PROPERTIES_MAX 64

struct property {
	enum number_type type, count; /* count: of a list, else NUMBER_NONE */
	int axis;                     /* 0, 1, 2 for x, y, z; -1 */
};

struct element {
	bool vertices;
	double n;
	int properties;
	struct property property[PROPERTIES_MAX];
};

struct header {
	enum { FORMAT_NONE, FORMAT_ASCII, FORMAT_LITTLE, FORMAT_BIG } format;
	int elements;
	struct element element[ELEMENTS_MAX];
};

struct words {
	int n;
	char word[6][24]; /* longer ones are cut: none that matters is */
};

static void split(const char *line, size_t len, struct words *ret)
{
	ret->n = 0;
	for (size_t i = 0; i < len && ret->n < 6;) {
		size_t n = 0;
		while (i < len && (line[i] == ' ' || line[i] == '\t'))
			i++;
		for (; i < len && line[i] != ' ' && line[i] != '\t'; i++)
			if (n + 1 < sizeof ret->word[0])
				ret->word[ret->n][n++] = line[i];
		ret->word[ret->n][n] = 0;
		ret->n += n > 0;
	}
}

static bool is(const struct words *w, int i, const char *expected)
{
	return i < w->n && strcmp(w->word[i], expected) == 0;
}

static enum number_type type_of(const char *name)
{
	static const char *const names[][2] = {{"", ""},
	                                       {"char", "int8"},
	                                       {"uchar", "uint8"},
	                                       {"short", "int16"},
	                                       {"ushort", "uint16"},
	                                       {"int", "int32"},
	                                       {"uint", "uint32"},
	                                       {"int64", "int64"},
	                                       {"uint64", "uint64"},
	                                       {"float", "float32"},
	                                       {"double", "float64"}};
	for (int i = 1; i <= NUMBER_F64; i++)
		if (strcmp(name, names[i][0]) == 0 || strcmp(name, names[i][1]) == 0)
			return (enum number_type)i;
	return NUMBER_NONE;
}

static bool read_format(const struct words *w, struct header *h)
{
	h->format = is(w, 1, "ascii")                  ? FORMAT_ASCII
	            : is(w, 1, "binary_little_endian") ? FORMAT_LITTLE
	            : is(w, 1, "binary_big_endian")    ? FORMAT_BIG
	                                               : FORMAT_NONE;
	return h->format != FORMAT_NONE;
}

static bool read_element(const struct words *w, struct header *h)
{
	struct text text;
	if (w->n < 3 || h->elements == ELEMENTS_MAX)
		return false;
	struct element *e = &h->element[h->elements++];
	text_init(&text, w->word[2], strlen(w->word[2]));
	e->vertices = is(w, 1, "vertex");
	return text_number(&text, &e->n) && e->n >= 0 && e->n <= 1e12;
}

static bool read_property(const struct words *w, struct header *h)
{
	struct element *e = h->elements ? &h->element[h->elements - 1] : NULL;
	bool list = is(w, 1, "list");
	if (!e || e->properties == PROPERTIES_MAX || w->n < (list ? 5 : 3))
		return false;
	struct property *p = &e->property[e->properties++];
	const char *name = w->word[list ? 4 : 2];
	p->type = type_of(w->word[list ? 3 : 1]);
	p->count = list ? type_of(w->word[2]) : NUMBER_NONE;
	p->axis = -1;
	for (int i = 0; i < 3 && !list; i++)
		if (name[0] == "xyz"[i] && !name[1])
			p->axis = i;
	return p->type != NUMBER_NONE && (!list || (p->count != NUMBER_NONE && p->count < NUMBER_F32));
}

static bool read_line(const struct words *w, struct header *h)
{
	if (is(w, 0, "format"))
		return read_format(w, h);
	if (is(w, 0, "element"))
		return read_element(w, h);
	if (is(w, 0, "property"))
		return read_property(w, h);
	return w->n == 0 || is(w, 0, "comment") || is(w, 0, "obj_info");
}

static int check_header(const struct header *h, uint32_t line, struct parse_error *error)
{
	if (h->format == FORMAT_NONE)
		return cloud_refuse(error, line, "the header has no format line");
	for (int i = 0; i < h->elements; i++) {
		int axes = 0;
		if (!h->element[i].vertices)
			continue;
		for (int k = 0; k < h->element[i].properties; k++)
			axes |= h->element[i].property[k].axis < 0 ? 0 : 1 << h->element[i].property[k].axis;
		return axes == 7 ? 0 : cloud_refuse(error, line, "the vertices have no x y z");
	}
	return cloud_refuse(error, line, "the header names no vertices");
}

static int read_header(struct text *text, struct header *h, struct parse_error *error)
{
	const char *line;
	struct words words;
	memset(h, 0, sizeof *h);
	size_t len = text_take_line(text, &line);
	if (len != 3 || memcmp(line, "ply", 3) != 0)
		return cloud_refuse(error, 1, "does not begin with `ply`; is this a PLY file?");
	while (!text_ended(text)) {
		uint32_t number = text->line;
		len = text_take_line(text, &line);
		split(line, len, &words);
		if (is(&words, 0, "end_header"))
			return check_header(h, number, error);
		if (!read_line(&words, h))
			return cloud_refuse(error, number, "this is no line of a PLY header, or more than is read");
	}
	return cloud_refuse(error, text->line, "the header has no end; the file was cut");
}

/* Where numbers come from: text or bytes. */
struct source {
	struct text *text;
	const uint8_t *at, *end;
	bool ascii, big_endian;
};

static bool next_number(struct source *s, enum number_type type, double *ret)
{
	if (s->ascii) {
		while (text_line_ended(s->text) && !text_ended(s->text))
			text_next_line(s->text);
		return text_number(s->text, ret);
	}
	if (s->end - s->at < number_size(type))
		return false;
	*ret = number_load(s->at, type, s->big_endian);
	s->at += number_size(type);
	return true;
}

/* Reads one of an element; x y z go to `p`. False where the file ends or a number does not parse. */
static bool next_item(struct source *s, const struct element *e, double p[3])
{
	for (int k = 0; k < e->properties; k++) {
		const struct property *property = &e->property[k];
		double value, n = 1;
		if (property->count != NUMBER_NONE && !next_number(s, property->count, &n))
			return false;
		for (; n >= 1; n--) {
			if (!next_number(s, property->type, &value))
				return false;
			if (property->axis >= 0)
				p[property->axis] = value;
		}
	}
	return true;
}

static int read_items(struct source *s, const struct element *e, struct cloud_builder *builder,
                      struct parse_error *error)
{
	if (e->properties == 0)
		return 0;
	for (double i = 0; i < e->n; i++) {
		double p[3] = {0};
		if (!next_item(s, e, p))
			return cloud_refuse(
			    error, s->ascii ? s->text->line : 0,
			    "ends before its last vertex, or a number is none; the file was cut or damaged");
		int r = e->vertices ? cloud_add(builder, p[0], p[1], p[2]) : 0;
		if (r < 0)
			return r;
	}
	return 0;
}

int ply_read_cloud(const uint8_t *data, size_t len, struct cloud *ret, struct parse_error *error)
{
	struct cloud_builder builder = {0};
	struct header header;
	struct text text;
	text_init(&text, data, len);
	int r = read_header(&text, &header, error);
	struct source source = {
	    .text = &text,
	    .at = (const uint8_t *)text.at,
	    .end = data + len,
	    .ascii = header.format == FORMAT_ASCII,
	    .big_endian = header.format == FORMAT_BIG,
	};
	for (int i = 0; r == 0 && i < header.elements; i++) {
		r = read_items(&source, &header.element[i], &builder, error);
		if (header.element[i].vertices)
			break;
	}
	return cloud_take(&builder, r, ret, error);
}

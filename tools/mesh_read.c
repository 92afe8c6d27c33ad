/* A PLY file is a header of elements with their properties, then rows of values. The header is turned into a small
 * description; every row is read by it, whatever else the file carries beside x, y, z and the list of indices. Counts
 * come from the file, so they are judged by the bytes that are left: a vertex needs at least one byte for each of its
 * properties, a face one for its list's count; memory is asked for only what can be there. */
#include "tools/mesh_read.h"

#include <ctype.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define ELEMENTS_MAX   8
#define PROPERTIES_MAX 32
#define POLYGON_MAX    4096

enum scalar { I8, U8, I16, U16, I32, U32, F32, F64, SCALARS };

static const struct {
	const char *name, *alias;
	int bytes;
} scalars[SCALARS] = {
    [I8] = {"char", "int8", 1},      [U8] = {"uchar", "uint8", 1},     [I16] = {"short", "int16", 2},
    [U16] = {"ushort", "uint16", 2}, [I32] = {"int", "int32", 4},      [U32] = {"uint", "uint32", 4},
    [F32] = {"float", "float32", 4}, [F64] = {"double", "float64", 8},
};

enum role { ROLE_NONE, ROLE_X, ROLE_Y, ROLE_Z, ROLE_INDICES, ROLE_CLASS };

struct property {
	enum scalar type, count_type;
	bool list;
	enum role role;
};

struct element {
	enum { ELEMENT_OTHER, ELEMENT_VERTEX, ELEMENT_FACE } kind;
	uint32_t count;
	int properties;
	struct property property[PROPERTIES_MAX];
};

struct ply {
	const uint8_t *data;
	size_t len, at;
	uint32_t line;
	bool ascii, swap;
	int elements;
	struct element element[ELEMENTS_MAX];
	struct mesh mesh;
	uint32_t nt_cap;
	struct parse_error *error;
};

static int refuse(struct ply *ply, const char *sentence)
{
	ply->error->line = ply->line;
	snprintf(ply->error->text, sizeof(ply->error->text), "%s", sentence);
	return -EINVAL;
}

/* The header ------------------------------------------------------------------------------------------------------ */

/* The next line of the header, without its end; false: there is none, or it is longer than any header's. */
static bool header_line(struct ply *ply, char line[200])
{
	size_t n = 0;
	while (ply->at + n < ply->len && ply->data[ply->at + n] != '\n')
		if (++n >= 199)
			return false;
	if (ply->at + n == ply->len)
		return false;
	memcpy(line, ply->data + ply->at, n);
	line[n] = '\0';
	if (n && line[n - 1] == '\r')
		line[n - 1] = '\0';
	ply->at += n + 1;
	ply->line++;
	return true;
}

static bool find_scalar(const char *name, enum scalar *ret)
{
	for (int i = 0; i < SCALARS; i++)
		if (strcmp(name, scalars[i].name) == 0 || strcmp(name, scalars[i].alias) == 0) {
			*ret = (enum scalar)i;
			return true;
		}
	return false;
}

static enum role find_role(const struct element *element, const char *name, bool list)
{
	if (element->kind == ELEMENT_VERTEX && !list && name[0] >= 'x' && name[0] <= 'z' && !name[1])
		return (enum role)(ROLE_X + name[0] - 'x');
	if (element->kind == ELEMENT_FACE && list && strncmp(name, "vertex_ind", 10) == 0)
		return ROLE_INDICES;
	if (element->kind == ELEMENT_FACE && !list && strcmp(name, "class") == 0)
		return ROLE_CLASS;
	return ROLE_NONE;
}

static int take_property(struct ply *ply, const char *line)
{
	char a[32], b[32], c[64];
	if (!ply->elements)
		return refuse(ply, "a property stands before any element");
	struct element *element = &ply->element[ply->elements - 1];
	struct property property = {.list = false};
	if (element->properties == PROPERTIES_MAX)
		return refuse(ply, "an element has more properties than are read");
	if (sscanf(line, "property list %31s %31s %63s", a, b, c) == 3) {
		property.list = true;
		if (!find_scalar(a, &property.count_type) || !find_scalar(b, &property.type))
			return refuse(ply, "the type of a list is not known");
	} else if (sscanf(line, "property %31s %63s", b, c) != 2 || !find_scalar(b, &property.type)) {
		return refuse(ply, "the type of a property is not known");
	}
	property.role = find_role(element, c, property.list);
	element->property[element->properties++] = property;
	return 0;
}

static int take_element(struct ply *ply, const char *line)
{
	char name[32];
	unsigned long long count;
	if (ply->elements == ELEMENTS_MAX)
		return refuse(ply, "there are more elements than are read");
	if (sscanf(line, "element %31s %llu", name, &count) != 2 || count > UINT32_MAX / 4 || strchr(line, '-'))
		return refuse(ply, "an element needs a name and a count");
	struct element *element = &ply->element[ply->elements++];
	element->kind = strcmp(name, "vertex") == 0 ? ELEMENT_VERTEX
	                : strcmp(name, "face") == 0 ? ELEMENT_FACE
	                                            : ELEMENT_OTHER;
	element->count = (uint32_t)count;
	return 0;
}

static int take_format(struct ply *ply, const char *line)
{
	if (strcmp(line, "format ascii 1.0") == 0)
		ply->ascii = true;
	else if (strcmp(line, "format binary_big_endian 1.0") == 0)
		ply->swap = true;
	else if (strcmp(line, "format binary_little_endian 1.0") != 0)
		return refuse(ply, "the format is not known; ascii and binary 1.0 are read");
	return 0;
}

static int read_header(struct ply *ply)
{
	char line[200];
	bool format = false;
	if (!header_line(ply, line) || strcmp(line, "ply") != 0)
		return refuse(ply, "this is not a PLY file (it does not begin with 'ply'); only .ply is read here");
	for (;;) {
		int error = 0;
		if (!header_line(ply, line))
			return refuse(ply, "the header does not end");
		if (strcmp(line, "end_header") == 0)
			return format ? 0 : refuse(ply, "the header names no format");
		if (strncmp(line, "format ", 7) == 0) {
			error = take_format(ply, line);
			format = true;
		} else if (strncmp(line, "element ", 8) == 0) {
			error = take_element(ply, line);
		} else if (strncmp(line, "property ", 9) == 0) {
			error = take_property(ply, line);
		} else if (strncmp(line, "comment", 7) != 0 && strncmp(line, "obj_info", 8) != 0) {
			error = refuse(ply, "a line of the header is not understood");
		}
		if (error)
			return error;
	}
}

/* Values ---------------------------------------------------------------------------------------------------------- */

static int ascii_value(struct ply *ply, double *ret)
{
	char word[64];
	size_t n = 0;
	while (ply->at < ply->len && isspace(ply->data[ply->at]))
		ply->line += ply->data[ply->at++] == '\n';
	while (ply->at < ply->len && !isspace(ply->data[ply->at]) && n < sizeof(word) - 1)
		word[n++] = (char)ply->data[ply->at++];
	word[n] = '\0';
	char *end;
	*ret = strtod(word, &end);
	return n && !*end ? 0 : refuse(ply, n ? "a word stands where a number should" : "the file ends too early");
}

static int binary_value(struct ply *ply, enum scalar type, double *ret)
{
	uint8_t bytes[8];
	const size_t n = (size_t)scalars[type].bytes;
	if (ply->len - ply->at < n)
		return refuse(ply, "the file ends too early");
	for (size_t i = 0; i < n; i++)
		bytes[i] = ply->data[ply->at + (ply->swap ? n - 1 - i : i)];
	ply->at += n;
	union {
		int8_t i8;
		int16_t i16;
		int32_t i32;
		uint16_t u16;
		uint32_t u32;
		float f32;
		double f64;
	} v;
	memcpy(&v, bytes, sizeof(bytes));
	const double values[SCALARS] = {
	    [I8] = v.i8,
	    [U8] = bytes[0],
	    [I16] = v.i16,
	    [U16] = v.u16,
	    [I32] = v.i32,
	    [U32] = v.u32,
	    [F32] = type == F32 ? v.f32 : 0,
	    [F64] = type == F64 ? v.f64 : 0,
	};
	*ret = values[type];
	return 0;
}

static int read_scalar(struct ply *ply, enum scalar type, double *ret)
{
	return ply->ascii ? ascii_value(ply, ret) : binary_value(ply, type, ret);
}

/* A count or index: a whole number within 0 .. max. */
static int read_whole(struct ply *ply, enum scalar type, uint32_t max, uint32_t *ret, const char *sentence)
{
	double value;
	const int error = read_scalar(ply, type, &value);
	if (error)
		return error;
	if (!(value >= 0 && value <= max) || value != floor(value))
		return refuse(ply, sentence);
	*ret = (uint32_t)value;
	return 0;
}

static int skip_list(struct ply *ply, const struct property *property)
{
	uint32_t count;
	double ignored;
	int error = read_whole(ply, property->count_type, 1u << 24, &count, "the length of a list is impossible");
	for (uint32_t i = 0; i < count && !error; i++)
		error = read_scalar(ply, property->type, &ignored);
	return error;
}

static int add_triangle(struct ply *ply, uint32_t a, uint32_t b, uint32_t c)
{
	struct mesh *mesh = &ply->mesh;
	if (mesh->nt == ply->nt_cap) {
		const uint32_t cap = ply->nt_cap ? 2 * ply->nt_cap : 1024;
		void *triangle = realloc(mesh->triangle, cap * sizeof(*mesh->triangle));
		if (triangle)
			mesh->triangle = triangle;
		void *class = realloc(mesh->class, cap);
		if (class)
			mesh->class = class;
		if (!triangle || !class)
			return -ENOMEM;
		ply->nt_cap = cap;
	}
	mesh->class[mesh->nt] = 0;
	memcpy(mesh->triangle[mesh->nt++], (uint32_t[3]){a, b, c}, 3 * sizeof(uint32_t));
	return 0;
}

static int read_polygon(struct ply *ply, const struct property *property)
{
	uint32_t count, index, first = 0, last = 0;
	int error =
	    read_whole(ply, property->count_type, POLYGON_MAX, &count, "a face has an impossible number of corners");
	for (uint32_t i = 0; i < count && !error; i++) {
		error = read_whole(ply, property->type, UINT32_MAX, &index, "an index is not a number of a vertex");
		if (!error && index >= ply->mesh.nv)
			error = refuse(ply, "a face names a vertex that does not exist");
		if (!error && i >= 2)
			error = add_triangle(ply, first, last, index);
		if (i == 0)
			first = index;
		last = index;
	}
	return error;
}

static int read_row(struct ply *ply, const struct element *element, uint32_t row)
{
	const uint32_t first_triangle = ply->mesh.nt;
	uint32_t class = 0;
	int error = 0;
	for (int i = 0; i < element->properties && !error; i++) {
		const struct property *property = &element->property[i];
		double value;
		if (property->role == ROLE_INDICES) {
			error = read_polygon(ply, property);
		} else if (property->list) {
			error = skip_list(ply, property);
		} else if (property->role == ROLE_CLASS) {
			error = read_whole(ply, property->type, 255, &class, "a class is not within 0 .. 255");
		} else {
			error = read_scalar(ply, property->type, &value);
			if (!error && property->role >= ROLE_X && property->role <= ROLE_Z) {
				if (!isfinite(value) || fabs(value) > 1e9)
					return refuse(ply, "a vertex is not within a million kilometres");
				ply->mesh.vertex[row][property->role - ROLE_X] = (float)value;
			}
		}
	}
	for (uint32_t t = first_triangle; t < ply->mesh.nt; t++)
		ply->mesh.class[t] = (uint8_t) class;
	return error;
}

/* The least number of bytes that the rows of an element can have. */
static size_t least_bytes(const struct ply *ply, const struct element *element)
{
	size_t bytes = 0;
	for (int i = 0; i < element->properties; i++)
		bytes += ply->ascii                  ? 2
		         : element->property[i].list ? (size_t)scalars[element->property[i].count_type].bytes
		                                     : (size_t)scalars[element->property[i].type].bytes;
	return bytes;
}

static bool has_role(const struct element *element, enum role role)
{
	for (int i = 0; i < element->properties; i++)
		if (element->property[i].role == role)
			return true;
	return false;
}

static int read_element(struct ply *ply, const struct element *element)
{
	const size_t least = least_bytes(ply, element);
	if (least == 0 || (ply->len - ply->at + 1) / least < element->count)
		return element->count ? refuse(ply, "the file is too short for its counts") : 0;
	if (element->kind == ELEMENT_VERTEX) {
		if (ply->mesh.vertex)
			return refuse(ply, "there are two lists of vertices");
		if (!has_role(element, ROLE_X) || !has_role(element, ROLE_Y) || !has_role(element, ROLE_Z))
			return refuse(ply, "the vertices have no x, y and z");
		ply->mesh.vertex = calloc((size_t)element->count + 1, sizeof(*ply->mesh.vertex));
		if (!ply->mesh.vertex)
			return -ENOMEM;
		ply->mesh.nv = element->count;
	}
	int error = 0;
	for (uint32_t row = 0; row < element->count && !error; row++)
		error = read_row(ply, element, row);
	return error;
}

int mesh_read_ply(const uint8_t *data, size_t len, struct mesh *ret, struct parse_error *error)
{
	struct ply ply = {.data = data, .len = len, .error = error};
	int status = read_header(&ply);
	for (int i = 0; i < ply.elements && !status; i++)
		status = read_element(&ply, &ply.element[i]);
	if (!status && !ply.mesh.vertex)
		status = refuse(&ply, "there are no vertices");
	if (status)
		mesh_finish(&ply.mesh);
	else
		*ret = ply.mesh;
	return status;
}

void mesh_finish(struct mesh *mesh)
{
	free(mesh->vertex);
	free(mesh->triangle);
	free(mesh->class);
	*mesh = (struct mesh){0};
}

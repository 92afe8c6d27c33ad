/* PLY, binary little-endian and ascii (G. Turk, The PLY Polygon File Format, 1994).
 *
 * Coordinates are doubles, exact multiples of cell / 256, so that equal lattice points stay equal in the file; ascii
 * prints the 17 digits that bring the same double back. */
#include "core/model.h"

#include <string.h>

#define FACE_BYTES   (1 + 3 * 4 + 4 + 1)
#define VERTEX_BYTES (3 * 8 + 3 * 4)

static void header(const struct model *model, bool ascii, struct buffer *ret)
{
	buffer_printf(ret, "ply\nformat %s 1.0\ncomment facetd: metres, map frame, z up\n",
	              ascii ? "ascii" : "binary_little_endian");
	buffer_printf(ret, "element vertex %u\nproperty double x\nproperty double y\nproperty double z\n", model->nv);
	buffer_printf(ret, "property float nx\nproperty float ny\nproperty float nz\n");
	buffer_printf(ret, "element face %u\nproperty list uchar int vertex_indices\n", model->nt);
	buffer_printf(ret, "property int plane\nproperty uchar class\nend_header\n");
}

static void write_ascii(const struct model *model, struct buffer *ret)
{
	for (uint32_t v = 0; v < model->nv; v++) {
		const double *p = model->vertex[v];
		const float *n = model->normal[v];
		buffer_printf(ret, "%.17g %.17g %.17g %.9g %.9g %.9g\n", p[0], p[1], p[2], (double)n[0], (double)n[1],
		              (double)n[2]);
	}
	for (uint32_t t = 0; t < model->nt; t++) {
		const uint32_t *v = model->triangle[t];
		buffer_printf(ret, "3 %u %u %u %d %u\n", v[0], v[1], v[2], (int)model->plane[t], model->class[t]);
	}
}

static void write_binary(const struct model *model, struct buffer *ret)
{
	for (uint32_t v = 0; v < model->nv; v++) {
		uint8_t bytes[VERTEX_BYTES];
		memcpy(bytes, model->vertex[v], 24);
		memcpy(bytes + 24, model->normal[v], 12);
		buffer_append(ret, bytes, sizeof bytes);
	}
	for (uint32_t t = 0; t < model->nt; t++) {
		uint8_t bytes[FACE_BYTES] = {3};
		memcpy(bytes + 1, model->triangle[t], 12);
		memcpy(bytes + 13, &model->plane[t], 4);
		bytes[17] = model->class[t];
		buffer_append(ret, bytes, sizeof bytes);
	}
}

void ply_write(const struct model *model, bool ascii, struct buffer *ret)
{
	header(model, ascii, ret);
	if (ascii)
		write_ascii(model, ret);
	else
		write_binary(model, ret);
}

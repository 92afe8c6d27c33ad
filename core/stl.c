/* Binary STL: 80 bytes of text, u32 count, and for every face its normal, three corners (floats) and u16 0.
 *
 * The text must not begin with "solid": readers take that for the ascii form. The format has no shared vertices, so what
 * was one lattice point is one again only because all its floats are equal. */
#include "core/model.h"

#include <math.h>
#include <string.h>

#define FACE_BYTES (12 * 4 + 2)

/* (0, 0, 0) for a face without area, as the format asks for. */
static void face_normal(const struct model *model, const uint32_t v[3], float ret[3])
{
	const double *a = model->vertex[v[0]], *b = model->vertex[v[1]], *c = model->vertex[v[2]];
	struct vec3 u = {b[0] - a[0], b[1] - a[1], b[2] - a[2]}, w = {c[0] - a[0], c[1] - a[1], c[2] - a[2]};
	struct vec3 n = vec3_cross(u, w);
	double length = vec3_norm(n), scale = length > 0 ? 1 / length : 0;
	ret[0] = (float)(n.x * scale);
	ret[1] = (float)(n.y * scale);
	ret[2] = (float)(n.z * scale);
}

void stl_write(const struct model *model, struct buffer *ret)
{
	char text[80] = "facetd: metres, map frame, z up";
	buffer_append(ret, text, sizeof text);
	buffer_append(ret, &model->nt, 4);
	for (uint32_t t = 0; t < model->nt; t++) {
		float number[12];
		uint8_t bytes[FACE_BYTES] = {0};
		face_normal(model, model->triangle[t], number);
		for (int c = 0; c < 3; c++)
			for (int a = 0; a < 3; a++)
				number[3 + 3 * c + a] = (float)model->vertex[model->triangle[t][c]][a];
		memcpy(bytes, number, sizeof number);
		buffer_append(ret, bytes, sizeof bytes);
	}
}

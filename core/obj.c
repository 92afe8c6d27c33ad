/* Wavefront OBJ: v, vn and f lines, indices from 1. Ten digits keep lattice points apart up to a hundred kilometres. */
#include "core/model.h"

void obj_write(const struct model *model, struct buffer *ret)
{
	buffer_printf(ret, "# facetd: metres, map frame, z up; %u vertices, %u faces\n", model->nv, model->nt);
	for (uint32_t v = 0; v < model->nv; v++)
		buffer_printf(ret, "v %.10g %.10g %.10g\n", model->vertex[v][0], model->vertex[v][1],
		              model->vertex[v][2]);
	for (uint32_t v = 0; v < model->nv; v++)
		buffer_printf(ret, "vn %.6g %.6g %.6g\n", (double)model->normal[v][0], (double)model->normal[v][1],
		              (double)model->normal[v][2]);
	for (uint32_t t = 0; t < model->nt; t++) {
		const uint32_t *f = model->triangle[t];
		buffer_printf(ret, "f %u//%u %u//%u %u//%u\n", f[0] + 1, f[0] + 1, f[1] + 1, f[1] + 1, f[2] + 1,
		              f[2] + 1);
	}
}

/* Reads a triangle mesh from a PLY file: our own files and the common ones (ascii, both byte orders, any scalar types,
 * polygons split into fans). Parses a whole file in memory. */
#ifndef FACET_TOOLS_MESH_READ_H
#define FACET_TOOLS_MESH_READ_H

#include "core/model.h"

struct mesh {
	uint32_t nv, nt;
	float (*vertex)[3]; /* m */
	uint32_t (*triangle)[3];
	uint8_t *class; /* [nt]; 0 where the file has none */
};

/* 0, -ENOMEM or -EINVAL with one sentence. */
int mesh_read_ply(const uint8_t *data, size_t len, struct mesh *ret, struct parse_error *error);
void mesh_finish(struct mesh *);

#endif

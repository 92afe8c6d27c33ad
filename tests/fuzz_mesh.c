/* Law: no bytes of a PLY file crash the reader of meshes or make it allocate more than they could hold; every triangle it
 * hands out names vertices that exist. */
#include <stdint.h>
#include <stdlib.h>

#include "tools/mesh_read.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct mesh mesh;
	struct parse_error error;
	const int status = mesh_read_ply(data, size, &mesh, &error);
	if (status) {
		if (!error.text[0])
			abort();
		return 0;
	}
	for (uint32_t t = 0; t < mesh.nt; t++)
		for (int i = 0; i < 3; i++)
			if (mesh.triangle[t][i] >= mesh.nv)
				abort();
	mesh_finish(&mesh);
	return 0;
}

/* Law: no file makes the reader of PLY clouds crash, read beyond it or allocate without bound; what it accepts is numbers. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>

#include "core/model.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct cloud cloud;
	struct parse_error error = {0};
	int r = ply_read_cloud(data, size, &cloud, &error);
	if (r < 0) {
		if (!error.text[0])
			abort();
		return 0;
	}
	if (cloud.n == 0 || !cloud.point)
		abort();
	for (size_t i = 0; i < cloud.n; i++)
		if (!(vec3_norm(cloud.point[i]) < 2e6))
			abort();
	cloud_finish(&cloud);
	return 0;
}

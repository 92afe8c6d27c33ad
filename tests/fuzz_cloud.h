/* What every reader of clouds owes to any file: a refusal with a sentence, or numbers. Shared by its fuzz targets. */
#ifndef FACET_TESTS_FUZZ_CLOUD_H
#define FACET_TESTS_FUZZ_CLOUD_H

#include <math.h>
#include <stdint.h>
#include <stdlib.h>

#include "core/model.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static inline void fuzz_cloud(int (*read)(const uint8_t *, size_t, struct cloud *, struct parse_error *),
                              const uint8_t *data, size_t size)
{
	struct cloud cloud;
	struct parse_error error = {0};
	int r = read(data, size, &cloud, &error);
	if (r < 0) {
		if (!error.text[0])
			abort();
		return;
	}
	if (cloud.n == 0 || !cloud.point)
		abort();
	for (size_t i = 0; i < cloud.n; i++)
		if (!(vec3_norm(cloud.point[i]) < 2e6))
			abort();
	cloud_finish(&cloud);
}

#endif

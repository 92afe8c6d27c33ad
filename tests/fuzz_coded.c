/* Law: no bytes crash a reader of coded patches, make it read beyond them or allocate without bound; what it accepts may
 * be drawn, and comes back the same from its own bytes. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "core/coded.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void must(bool condition)
{
	if (!condition)
		abort();
}

static void check_drawable(const struct patch *patch)
{
	uint32_t sum = 0;

	must(patch->nt > 0 && patch->nv >= 3);
	for (uint32_t i = 0; i < patch->nruns; i++)
		sum += patch->run[i].triangles;
	must(sum == patch->nt);
	for (uint32_t i = 0; i < patch->nt; i++)
		for (int c = 0; c < 3; c++)
			must(patch->triangle[i][c] < patch->nv);
	for (uint32_t i = 0; i < patch->nv; i++)
		for (int axis = 0; axis < 3; axis++)
			must(patch->vertex[i][axis] <= PATCH_SIDE * LATTICE);
}

static void check(const struct patch *patch)
{
	struct buffer b = {0};
	struct patch *back;
	char error[128];

	check_drawable(patch);
	coded_put_patch(&b, patch);
	must(coded_get_patch(b.data, b.len, &back, error) == 0);
	must(patch_equal(patch, back) && patch->version == back->version);
	patch_unref(back);
	buffer_finish(&b);
}

/* As it is; and, so that a mutation reaches the body, with the length that it should have. */
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct patch *patch;
	char error[128] = "";
	const ssize_t n = coded_scan(data, size);
	uint8_t *fitted;

	must(n <= (ssize_t)size);
	if (n > 0 && coded_get_patch(data, (size_t)n, &patch, error) == 0) {
		check(patch);
		patch_unref(patch);
	}
	must(strlen(error) < sizeof(error));
	if (size < 3 || size > 16000)
		return 0;
	fitted = malloc(size);
	must(fitted != NULL);
	memcpy(fitted, data, size);
	fitted[0] = (uint8_t)((size - 2) & 0x7f) | 0x80;
	fitted[1] = (uint8_t)((size - 2) >> 7);
	if (coded_get_patch(fitted, size, &patch, error) == 0) {
		check(patch);
		patch_unref(patch);
	}
	free(fitted);
	return 0;
}

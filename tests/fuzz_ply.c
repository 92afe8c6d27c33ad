/* Law: no file makes the reader of PLY clouds crash, read beyond it or allocate without bound; what it accepts is numbers. */
#include "tests/fuzz_cloud.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	fuzz_cloud(ply_read_cloud, data, size);
	return 0;
}

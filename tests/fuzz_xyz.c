/* Law: no file makes the reader of clouds as text crash, read beyond it or allocate without bound; what it accepts is numbers. */
#include "tests/fuzz_cloud.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	fuzz_cloud(xyz_read, data, size);
	return 0;
}

/* CoLa-A: see fuzz_cola.h. */
#include "tests/fuzz_cola.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	fuzz_cola(COLA_A, data, size);
	return 0;
}

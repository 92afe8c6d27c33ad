/* See jitter.h. Sorted when asked, about once a second: keeping them sorted would cost every reading. */
#include "drivers/jitter.h"

#include <stdlib.h>
#include <string.h>

#define DELAY_MAX_US INT64_C(1800000000)

void jitter_note(struct jitter *j, int64_t delay_ns)
{
	int64_t us = delay_ns / 1000;

	if (us > DELAY_MAX_US)
		us = DELAY_MAX_US;
	if (us < -DELAY_MAX_US)
		us = -DELAY_MAX_US;
	j->delay_us[j->n++ % JITTER_KEPT] = (int32_t)us;
}

static int compare(const void *a, const void *b)
{
	const int32_t x = *(const int32_t *)a, y = *(const int32_t *)b;

	return x < y ? -1 : x > y;
}

void jitter_percentiles(const struct jitter *j, int64_t *ret_p50_ns, int64_t *ret_p99_ns)
{
	const size_t n = j->n < JITTER_KEPT ? (size_t)j->n : JITTER_KEPT;
	int32_t sorted[JITTER_KEPT];

	*ret_p50_ns = *ret_p99_ns = 0;
	if (n == 0)
		return;
	memcpy(sorted, j->delay_us, n * sizeof(*sorted));
	qsort(sorted, n, sizeof(*sorted), compare);
	*ret_p50_ns = ((int64_t)sorted[n / 2] - sorted[0]) * 1000;
	*ret_p99_ns = ((int64_t)sorted[n * 99 / 100] - sorted[0]) * 1000;
}

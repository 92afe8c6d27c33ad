/* See wall_clock.h. Two clocks cannot be read at once: the monotonic one is read before and after, and where these are far
 * apart the middle says nothing. */
#include "daemon/wall_clock.h"

#define LOOK_NS   200000 /* clocks that were read within so long belong together */
#define LOOKS_MAX 100

int64_t wall_clock_read(clockid_t clock)
{
	struct timespec ts;

	clock_gettime(clock, &ts);
	return (int64_t)ts.tv_sec * 1000000000 + ts.tv_nsec;
}

bool wall_clock_offset(int64_t *ret_ns)
{
	int64_t before_ns = wall_clock_read(CLOCK_MONOTONIC), wall_ns = wall_clock_read(CLOCK_REALTIME);
	int64_t after_ns = wall_clock_read(CLOCK_MONOTONIC);

	*ret_ns = wall_ns - before_ns - (after_ns - before_ns) / 2;
	return after_ns - before_ns <= LOOK_NS;
}

int64_t wall_clock_first_offset(void)
{
	int64_t offset_ns;

	for (int i = 0; !wall_clock_offset(&offset_ns) && i < LOOKS_MAX; i++)
		;
	return offset_ns;
}

/* See loop_clock.h. */
#include "drivers/loop_clock.h"

#include <time.h>

#define LOOK_NS   50000 /* two clocks read within so long belong together */
#define LOOKS_MAX 5
#define FUTURE_NS 1000000 /* by so much the learned constant may be too small at first */

/* A new distance is believed when the old one is not within what both looks can be off. */
static void take_wall(struct loop_clock *c, const struct loop_clock_look *look)
{
	const int64_t wall_ns = look->wall_ns - look->monotonic_ns;
	const int64_t apart_ns = wall_ns > c->wall_ns ? wall_ns - c->wall_ns : c->wall_ns - wall_ns;

	if (!c->wall_known) {
		c->wall_ns = c->wall_before_ns = wall_ns;
		c->within_ns = look->within_ns;
		c->wall_known = true;
	} else if (apart_ns > c->within_ns + look->within_ns) {
		c->wall_before_ns = c->wall_ns;
		c->wall_ns = wall_ns;
		c->within_ns = look->within_ns;
	} else if (look->within_ns < c->within_ns) {
		c->wall_ns = wall_ns;
		c->within_ns = look->within_ns;
	}
}

void loop_clock_take(struct loop_clock *c, const struct loop_clock_look *look)
{
	const int64_t offset_ns = look->loop_ns - look->monotonic_ns;

	if (!c->known || offset_ns > c->offset_ns)
		c->offset_ns = offset_ns;
	c->known = true;
	c->monotonic_ns = look->monotonic_ns;
	take_wall(c, look);
}

int64_t loop_clock_of_monotonic(const struct loop_clock *c, int64_t monotonic_ns)
{
	return monotonic_ns + c->offset_ns;
}

static bool makes_sense(const struct loop_clock *c, int64_t monotonic_ns)
{
	return monotonic_ns >= c->drained_ns - LOOP_CLOCK_EARLY_NS && monotonic_ns <= c->monotonic_ns + FUTURE_NS;
}

int64_t loop_clock_of_wall(const struct loop_clock *c, int64_t wall_ns)
{
	int64_t t_ns, before_ns;

	/* Whatever a peer writes into its stamps: differences of these have room. */
	if (wall_ns < 0 || wall_ns > INT64_MAX / 2)
		return loop_clock_of_monotonic(c, c->monotonic_ns);
	t_ns = wall_ns - c->wall_ns;
	before_ns = wall_ns - c->wall_before_ns;
	if (!makes_sense(c, t_ns) && makes_sense(c, before_ns))
		t_ns = before_ns;
	if (t_ns < c->drained_ns - LOOP_CLOCK_EARLY_NS)
		t_ns = c->drained_ns;
	if (t_ns > c->monotonic_ns)
		t_ns = c->monotonic_ns;
	return loop_clock_of_monotonic(c, t_ns);
}

void loop_clock_drained(struct loop_clock *c)
{
	c->drained_ns = c->monotonic_ns;
}

static int64_t clock_ns(clockid_t clock)
{
	struct timespec ts;

	clock_gettime(clock, &ts);
	return (int64_t)ts.tv_sec * 1000000000 + ts.tv_nsec;
}

void loop_clock_start(struct loop_clock *c)
{
	*c = (struct loop_clock){.drained_ns = clock_ns(CLOCK_MONOTONIC)};
}

int64_t loop_clock_look(struct loop_clock *c, int64_t loop_ns)
{
	struct loop_clock_look look = {.loop_ns = loop_ns, .within_ns = LOOK_NS + 1};

	for (int i = 0; i < LOOKS_MAX && look.within_ns > LOOK_NS; i++) {
		const int64_t before_ns = clock_ns(CLOCK_MONOTONIC);

		look.wall_ns = clock_ns(CLOCK_REALTIME);
		look.monotonic_ns = clock_ns(CLOCK_MONOTONIC);
		look.within_ns = look.monotonic_ns - before_ns;
	}
	loop_clock_take(c, &look);
	return loop_clock_of_monotonic(c, look.monotonic_ns);
}

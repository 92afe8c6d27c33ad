/* Mixed beams (interfaces, section 3): where half a beam meets an edge and half what lies behind, the device tells a range
 * at which there is nothing. Such a beam jumps to both its neighbours; but so do the beams on a wall seen at a slant, which
 * are told apart by a fourth neighbour on the same line. A missing neighbour is no evidence. */
#include "core/mixed.h"

#include <math.h>
#include <stdbool.h>

#include "core/trig.h"
#include "core/types.h"

#define JUMP_M    0.2f
#define LINE_M    0.02
#define RUN_SHARE 0.25f

static bool is_valid(uint8_t state)
{
	return state == BEAM_OK || state == BEAM_MIXED; /* BEAM_MIXED here: was BEAM_OK before this pass */
}

/* Do beams first .. first + 3 lie within 2 cm of the line through the outer two? Place of a beam in the plane of the fan. */
static bool on_line(const float *range_m, uint32_t first, double step_rad)
{
	double x[4], y[4];
	for (uint32_t i = 0; i < 4; i++) {
		double bearing = i * step_rad; /* where the fan begins does not matter to a line */
		x[i] = (double)range_m[first + i] * trig_cos(bearing);
		y[i] = (double)range_m[first + i] * trig_sin(bearing);
	}
	double dx = x[3] - x[0], dy = y[3] - y[0], length = sqrt(dx * dx + dy * dy);
	for (int i = 1; i < 3; i++)
		if (fabs(dx * (y[i] - y[0]) - dy * (x[i] - x[0])) > LINE_M * length)
			return false;
	return true;
}

/* Does the range run on from `a` over `b` to the fourth, `c`, as it does along a wall? A step of next to nothing before a
 * jump is the edge of something near: close to the scanner beams lie within 2 cm of each other, and of any radial line. */
static bool runs_on(float a, float b, float c)
{
	return (b - a) * (c - b) > 0 && fabsf(c - b) >= RUN_SHARE * fabsf(b - a);
}

/* One surface, seen at a slant: the range runs one way through i, and a fourth neighbour is on the line too. */
static bool is_slanted(const float *r, const uint8_t *state, uint32_t n, uint32_t i, double step_rad)
{
	if ((r[i] - r[i - 1]) * (r[i + 1] - r[i]) <= 0)
		return false;
	return (i >= 2 && is_valid(state[i - 2]) && runs_on(r[i], r[i - 1], r[i - 2]) && on_line(r, i - 2, step_rad)) ||
	       (i + 2 < n && is_valid(state[i + 2]) && runs_on(r[i], r[i + 1], r[i + 2]) &&
	        on_line(r, i - 1, step_rad));
}

void mixed_mark(const float *range_m, uint8_t *state, uint32_t n, double step_rad)
{
	for (uint32_t i = 1; i + 1 < n; i++) {
		if (state[i] != BEAM_OK || !is_valid(state[i - 1]) || !is_valid(state[i + 1]))
			continue;
		bool jumps = fabsf(range_m[i] - range_m[i - 1]) > JUMP_M && fabsf(range_m[i] - range_m[i + 1]) > JUMP_M;
		if (jumps && !is_slanted(range_m, state, n, i, step_rad))
			state[i] = BEAM_MIXED;
	}
}

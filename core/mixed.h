/* Mixed beams of a row of ranges: pure, shared with readers of files. */
#ifndef FACET_CORE_MIXED_H
#define FACET_CORE_MIXED_H

#include <stdint.h>

/* Marks them in place (interfaces, section 3): a BEAM_OK beam that jumps by more than 20 cm to both its valid neighbours
 * becomes BEAM_MIXED unless the range runs one way through it and these three with one further neighbour, in which the run
 * goes on, lie within 2 cm of a line. `step_rad`: from beam to beam. */
void mixed_mark(const float *range_m, uint8_t *state, uint32_t n, double step_rad);

#endif

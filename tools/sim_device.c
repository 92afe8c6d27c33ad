/* What brains of simulated devices share: faults as they stand, and random numbers that are the same everywhere. */
#include "tools/sim_device.h"

#include <string.h>

int sim_fault_index(const char *const *kinds, const char *kind)
{
	for (int i = 0; kinds[i] != NULL; i++)
		if (strcmp(kinds[i], kind) == 0)
			return i;
	return -1;
}

void sim_fault_set(struct sim_fault_state *state, const struct sim_fault *fault, bool on)
{
	state->value = fault->value;
	state->on = on && fault->for_ns > 0;
	state->owed = on && fault->for_ns == 0 ? state->owed + 1 : on ? state->owed : 0;
}

bool sim_fault_due(struct sim_fault_state *state)
{
	if (state->on)
		return true;
	if (state->owed == 0)
		return false;
	state->owed--;
	return true;
}

double sim_fault_value(const struct sim_fault_state *state, double otherwise)
{
	return state->value != 0 ? state->value : otherwise;
}

uint64_t sim_mix(uint64_t v)
{
	v += 0x9e3779b97f4a7c15u;
	v = (v ^ v >> 30) * 0xbf58476d1ce4e5b9u;
	v = (v ^ v >> 27) * 0x94d049bb133111ebu;
	return v ^ v >> 31;
}

double sim_random(uint64_t *state)
{
	*state += 1;
	return (double)(sim_mix(*state) >> 11) / 9007199254740992.0;
}

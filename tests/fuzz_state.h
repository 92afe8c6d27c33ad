/* What the fuzz target of snapshots and the maker of its seeds have in common. */
#ifndef FACET_TESTS_FUZZ_STATE_H
#define FACET_TESTS_FUZZ_STATE_H

#include "tests/session.h"

#define FUZZ_STATE_T_NS    (SESSION_START_NS + 400 * SESSION_STEP_NS) /* what comes after a snapshot begins here */
#define FUZZ_STATE_TURN_NS 13333333

/* The first byte of an input: a device of the configuration, or what follows. */
enum {
	FUZZ_STATE_LASER,
	FUZZ_STATE_SERVO,
	FUZZ_STATE_POSE,
	FUZZ_STATE_TIM,
	FUZZ_STATE_LMS5XX,
	FUZZ_STATE_SWEEP,
	FUZZ_STATE_SWEEP_FIXED,
	FUZZ_STATE_FILTER,
	FUZZ_STATE_CLOCK,
	FUZZ_STATE_KINDS
};

static inline void fuzz_state_configure(struct session *s)
{
	session_configure(s, "driver: lms2xx, port: /dev/null, baud: 500000, variant: 180/0.5, tilt: servo");
	if (s->config.devices == 3) {
		struct session others = {0};

		session_configure(&others, "driver: tim, connect: 192.168.0.1, tilt: servo");
		s->config.device[FUZZ_STATE_TIM] = others.config.device[0];
		session_configure(&others,
		                  "driver: lms5xx, connect: 192.168.0.1, tilt: laser, encoder: {scale: 0.0001}");
		s->config.device[FUZZ_STATE_LMS5XX] = others.config.device[0];
		s->config.devices = FUZZ_STATE_SWEEP;
	}
}

static inline const struct sweep_params *fuzz_state_params(bool fixed)
{
	static struct sweep_params params;

	params = (struct sweep_params){.base_tilt = transform_identity(),
	                               .tilt_laser = transform_identity(),
	                               .range_min_m = 0.3,
	                               .range_max_m = 30,
	                               .masks = fixed,
	                               .mask = {{0.1, 0.2}},
	                               .has_box = fixed,
	                               .box_max = {1, 1, 1},
	                               .hold_ns = 30 * SESSION_STEP_NS,
	                               .fixed_tilt = fixed,
	                               .fixed_pose = fixed,
	                               .map_base = transform_identity()};
	return &params;
}

/* One of several kinds by `value` (0 .. 63): turns, partial scans, few and many beams. */
static inline const struct profile *fuzz_state_profile(struct profile *p, int64_t t_ns, uint8_t value)
{
	const bool part = value & 1;

	*p = (struct profile){.t_ns = t_ns,
	                      .beam_ns = 37037,
	                      .turn_ns = FUZZ_STATE_TURN_NS,
	                      .interlace = (uint8_t)(part ? 1 : 1 << (value >> 1 & 3) % 3),
	                      .part = (uint8_t)(part ? value >> 1 & 3 : 0),
	                      .parts = part ? 4 : 1,
	                      .n = (uint16_t)(value >= 60 ? 721 : 3 + (value >> 3)),
	                      .first_rad = -0.2,
	                      .step_rad = 0.02};
	for (int i = 0; i < p->n; i++) {
		p->range_m[i] = 2.0f + 0.3f * (float)(i * value % 7);
		p->state[i] = i % 5 == 4 ? BEAM_WEAK : BEAM_OK;
	}
	return p;
}

#endif

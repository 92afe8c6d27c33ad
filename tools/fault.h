/* Faults to order, as sentences: DEVICE: KIND [VALUE] [at TIME] [for TIME|ever]
 *
 *   laser: garbage at 3s for 2s        laser: sfa 3        laser: drift 200        laser: unplug for 500ms
 *
 * and the plan in which they wait for their times. Pure: the caller has the clock and the devices. */
#ifndef FACET_TOOLS_FAULT_H
#define FACET_TOOLS_FAULT_H

#include "tools/sim_device.h"

#define FAULT_ERROR_MAX  1000
#define FAULT_ORDERS_MAX 128 /* that wait or last; one more is refused */

/* 0, or -EINVAL with one sentence. Only the form is judged. Kinds that mean nothing without a duration get theirs: a second,
 * or for ever. */
int fault_parse(const char *text, struct sim_fault *ret, char error[FAULT_ERROR_MAX]);

/* Whoever takes faults: all kinds are in the lists; NULL ends each. */
struct fault_target {
	const char *device;
	const char *const *kinds[2]; /* the second may be NULL */
};
/* Does one of them know it, and is its value possible? Else one sentence that says what there is. */
int fault_check(const struct sim_fault *, const struct fault_target *, int targets, char error[FAULT_ERROR_MAX]);

struct fault_plan {
	int n;
	struct fault_order {
		struct sim_fault fault;
		int64_t at_ns; /* of its next change */
		bool on;       /* it lasts; the change ends it */
	} order[FAULT_ORDERS_MAX];
};

/* `begin_ns`: what its `at` counts from. -ENOSPC: the plan is full. */
int fault_plan_add(struct fault_plan *, const struct sim_fault *, int64_t begin_ns);
/* The change that is due by t_ns, earliest first; false: none is. */
bool fault_plan_next(struct fault_plan *, int64_t t_ns, struct sim_fault *ret, bool *ret_on);
int64_t fault_plan_deadline(const struct fault_plan *); /* INT64_MAX: nothing waits */

/* "profiles 120, sent 117, ..." */
void fault_print_counts(const struct sim_counts *, char *ret, size_t cap);

#endif

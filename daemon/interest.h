/* Which patches a client wants: all, those that meet a box, or those within a radius about the robot. Pure. */
#ifndef FACET_DAEMON_INTEREST_H
#define FACET_DAEMON_INTEREST_H

#include "core/native.h"

enum interest_kind { INTEREST_ALL, INTEREST_BOX, INTEREST_RADIUS };

struct interest {
	enum interest_kind kind;
	struct patch_key low, high; /* BOX: first and last patch; RADIUS: `low` is the robot's patch */
	int64_t reach2;             /* RADIUS: square of the widest gap between the robot's patch and one that counts */
};

/* -EINVAL: box and radius at once, a box inside out, a radius below 0, or what is no number. Infinite ones are allowed. */
int interest_of(const struct native_want *, double cell_m, struct patch_key robot, struct interest *ret);

bool interest_has(const struct interest *, struct patch_key);
bool interest_equal(const struct interest *, const struct interest *);

/* The robot is at (x, y, z), m: `robot` becomes its patch once it has left the old one by a quarter of a patch. True: it
 * did. What is no number, or beyond the map, changes nothing. */
bool interest_follow(struct patch_key *robot, double cell_m, double x_m, double y_m, double z_m);

#endif

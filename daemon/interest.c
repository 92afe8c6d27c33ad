/* Regions are judged in whole patches: a client gets every patch that meets its box or sphere, and perhaps a few more.
 *
 * The sphere is about the robot's *patch*, grown by the quarter of a patch that the robot may stray from it: so it holds
 * everything within the radius of any place the robot can be at until its patch changes, and a robot that stands on the
 * border of two patches, or trembles there, changes nothing. The gap between two patches counts the patches between
 * them; neighbours have none. */
#include "daemon/interest.h"

#include <errno.h>
#include <math.h>

#define STRAY 0.25                           /* patches beyond the robot's own, until it has another */
#define FAR   (4.0 * GRID_PATCH_LIMIT)       /* patches: beyond every gap there can be */
#define REACH ((int64_t)(FAR * FAR))         /* everything */
#define EDGE  ((double)GRID_PATCH_LIMIT + 1) /* a coordinate beyond the map */

static int32_t patch_of(double at_m, double patch_m)
{
	double at = floor(at_m / patch_m);

	return (int32_t)(at < -EDGE ? -EDGE : at > EDGE ? EDGE : at);
}

static int box_of(const float region[6], double patch_m, struct interest *ret)
{
	for (int i = 0; i < 3; i++)
		if (!(region[i] <= region[i + 3])) /* what is no number fails too */
			return -EINVAL;
	ret->kind = INTEREST_BOX;
	ret->low = (struct patch_key){patch_of(region[0], patch_m), patch_of(region[1], patch_m),
	                              patch_of(region[2], patch_m)};
	ret->high = (struct patch_key){patch_of(region[3], patch_m), patch_of(region[4], patch_m),
	                               patch_of(region[5], patch_m)};
	return 0;
}

static int radius_of(double radius_m, double patch_m, struct patch_key robot, struct interest *ret)
{
	double reach = radius_m / patch_m + STRAY;

	if (!(radius_m >= 0))
		return -EINVAL;
	ret->kind = INTEREST_RADIUS;
	ret->low = robot;
	ret->reach2 = reach < FAR ? (int64_t)floor(reach * reach) : REACH;
	return 0;
}

int interest_of(const struct native_want *want, double cell_m, struct patch_key robot, struct interest *ret)
{
	struct interest interest = {0};
	int r = 0;

	if ((want->flags & NATIVE_WANT_BOX) && (want->flags & NATIVE_WANT_RADIUS))
		r = -EINVAL;
	else if (want->flags & NATIVE_WANT_BOX)
		r = box_of(want->region, cell_m * PATCH_SIDE, &interest);
	else if (want->flags & NATIVE_WANT_RADIUS)
		r = radius_of((double)want->region[0], cell_m * PATCH_SIDE, robot, &interest);
	if (r == 0)
		*ret = interest;
	return r;
}

static int64_t gap(int32_t a, int32_t b)
{
	int64_t d = a < b ? (int64_t)b - a : (int64_t)a - b;

	return d > 0 ? d - 1 : 0;
}

bool interest_has(const struct interest *interest, struct patch_key key)
{
	const struct patch_key *low = &interest->low, *high = &interest->high;

	if (interest->kind == INTEREST_BOX)
		return key.x >= low->x && key.x <= high->x && key.y >= low->y && key.y <= high->y && key.z >= low->z &&
		       key.z <= high->z;
	if (interest->kind == INTEREST_RADIUS) {
		int64_t x = gap(key.x, low->x), y = gap(key.y, low->y), z = gap(key.z, low->z);

		return x * x + y * y + z * z <= interest->reach2;
	}
	return true;
}

bool interest_equal(const struct interest *a, const struct interest *b)
{
	return a->kind == b->kind && a->reach2 == b->reach2 && patch_key_compare(a->low, b->low) == 0 &&
	       patch_key_compare(a->high, b->high) == 0;
}

bool interest_follow(struct patch_key *robot, double cell_m, double x_m, double y_m, double z_m)
{
	double at[3] = {x_m / (cell_m * PATCH_SIDE), y_m / (cell_m * PATCH_SIDE), z_m / (cell_m * PATCH_SIDE)};
	int32_t old[3] = {robot->x, robot->y, robot->z};
	bool left = false;

	for (int i = 0; i < 3; i++) {
		if (!(at[i] > -EDGE && at[i] < EDGE))
			return false;
		left |= at[i] < old[i] - STRAY || at[i] > old[i] + 1 + STRAY;
	}
	if (left)
		*robot = (struct patch_key){(int32_t)floor(at[0]), (int32_t)floor(at[1]), (int32_t)floor(at[2])};
	return left;
}

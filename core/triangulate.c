/* Holes are joined to the outer loop by bridges, then ears are cut.
 *
 * The ring is a doubly linked list of places; a place names a point. A hole is joined at its leftmost point, holes
 * from left to right: where the ring has a place at the same coordinates the two loops are spliced there; else by
 * a bridge to the nearest place that sees it, which doubles both ends. So the ring is a polygon that may touch itself.
 *
 * An ear is a place with a left turn whose diagonal lies strictly inside the angles at both its ends and whose closed
 * triangle holds no other place, places at its own three corners excepted. The angles decide what places with equal
 * coordinates cannot: on which side of a touching corner the diagonal runs. Only places without a left turn need be looked at: of the
 * places inside, the nearest to the tip is one. They lie in a grid of buckets, so that an ear looks at those near it and the
 * whole takes about linear time.
 *
 * Degenerate input: straight corners are never cut off, only into; slivers are as good as any. A ring without ears (a
 * diagonal forbidden, loops that cross) is refused. */
#include "core/triangulate.h"

#include <assert.h>
#include <errno.h>
#include <string.h>

#include "core/predicates.h"

#define NONE         UINT32_MAX
#define BUCKETS_SIDE 64 /* at most, a side */
#define BRIDGE_TRIES 16 /* points of a hole; one that finds no bridge is rare */

struct ring {
	const int32_t (*point)[2];
	uint32_t *at, *next, *previous; /* per place; `at` is its point */
	uint32_t places;
	triangulate_allows *allows;
	const void *ctx;
	uint32_t *bucket, *chain; /* places without a left turn: first of a bucket, next in it */
	int32_t low[2], side;     /* of the buckets */
	uint32_t columns, rows;
};

static const int32_t *where(const struct ring *ring, uint32_t place)
{
	return ring->point[ring->at[place]];
}

static bool same(const int32_t a[2], const int32_t b[2])
{
	return a[0] == b[0] && a[1] == b[1];
}

/* Whether the direction from `place` to p lies strictly inside its angle. */
static bool in_angle(const struct ring *ring, uint32_t place, const int32_t p[2])
{
	const int32_t *before = where(ring, ring->previous[place]), *at = where(ring, place);
	const int32_t *after = where(ring, ring->next[place]);
	int64_t turn = orientation(before, at, after), in = orientation(before, at, p), out = orientation(at, after, p);
	return turn > 0 ? in > 0 && out > 0 : in > 0 || out > 0;
}

/* Whether segment a-b has more in common with segment c-d than an end of both. */
static bool blocks(const int32_t a[2], const int32_t b[2], const int32_t c[2], const int32_t d[2])
{
	if (same(a, c) || same(a, d)) {
		const int32_t *far = same(a, c) ? d : c;
		return !orientation(a, b, far) && (between(a, b, far) || between(a, far, b));
	}
	if (same(b, c) || same(b, d)) {
		const int32_t *far = same(b, c) ? d : c;
		return !orientation(a, b, far) && (between(a, b, far) || between(b, far, a));
	}
	return segments_touch(a, b, c, d);
}

static void link(struct ring *ring, uint32_t a, uint32_t b)
{
	ring->next[a] = b;
	ring->previous[b] = a;
}

/* Every loop as a ring of its own; place and point have the same number. */
static void lay_loops(const struct polygon *polygon, struct ring *ring)
{
	for (uint32_t l = 0, first = 0; l < polygon->loops; first = polygon->loop_end[l++])
		for (uint32_t p = first; p < polygon->loop_end[l]; p++) {
			ring->at[p] = p;
			link(ring, p, p + 1 < polygon->loop_end[l] ? p + 1 : first);
		}
	ring->places = polygon->n;
}

static bool bridge_clear(const struct ring *ring, uint32_t from, uint32_t to, uint32_t places)
{
	const int32_t *a = where(ring, from), *b = where(ring, to);
	if (!in_angle(ring, from, b) || !in_angle(ring, to, a))
		return false;
	if (ring->allows && !ring->allows(ring->ctx, ring->at[from], ring->at[to]))
		return false;
	for (uint32_t p = 0; p < places; p++)
		if (blocks(a, b, where(ring, p), where(ring, ring->next[p])))
			return false;
	return true;
}

/* Where the ring through `outer` touches the hole at `hole`, or NONE. */
static uint32_t touching_place(const struct ring *ring, uint32_t outer, uint32_t hole)
{
	uint32_t p = outer;
	do {
		if (same(where(ring, p), where(ring, hole)) && in_angle(ring, p, where(ring, ring->next[hole])))
			return p;
		p = ring->next[p];
	} while (p != outer);
	return NONE;
}

static void splice(struct ring *ring, uint32_t outer, uint32_t hole)
{
	uint32_t outer_next = ring->next[outer], hole_next = ring->next[hole];
	link(ring, outer, hole_next);
	link(ring, hole, outer_next);
}

static void bridge(struct ring *ring, uint32_t outer, uint32_t hole)
{
	uint32_t outer_again = ring->places++, hole_again = ring->places++;
	ring->at[outer_again] = ring->at[outer];
	ring->at[hole_again] = ring->at[hole];
	link(ring, outer_again, ring->next[outer]);
	link(ring, hole_again, ring->next[hole]);
	link(ring, outer, hole_again);
	link(ring, hole, outer_again);
}

/* The place of the ring through `outer` nearest to `hole` beyond (distance, place); NONE at the end. */
static uint32_t next_nearest(const struct ring *ring, uint32_t outer, uint32_t hole, int64_t distance, uint32_t place,
                             int64_t *ret_distance)
{
	uint32_t best = NONE, p = outer;
	*ret_distance = INT64_MAX;
	do {
		int64_t d = distance_squared2(where(ring, p), where(ring, hole));
		bool beyond = d > distance || (d == distance && p > place);
		if (beyond && (d < *ret_distance || (d == *ret_distance && p < best))) {
			*ret_distance = d;
			best = p;
		}
		p = ring->next[p];
	} while (p != outer);
	return best;
}

static bool join_hole(struct ring *ring, uint32_t outer, uint32_t first)
{
	uint32_t hole = first, p = first;
	do { /* a loop that touches the ring is spliced there */
		uint32_t touching = touching_place(ring, outer, p);
		if (touching != NONE) {
			splice(ring, touching, p);
			return true;
		}
		p = ring->next[p];
	} while (p != first);
	uint32_t tries = 0;
	do { /* from one of its points, the leftmost first */
		int64_t distance = 0, next_distance;
		for (uint32_t to = next_nearest(ring, outer, hole, 0, NONE, &next_distance); to != NONE;
		     to = next_nearest(ring, outer, hole, distance, to, &next_distance)) {
			distance = next_distance;
			if (bridge_clear(ring, to, hole, ring->places)) {
				bridge(ring, to, hole);
				return true;
			}
		}
		hole = ring->next[hole];
	} while (hole != first && ++tries < BRIDGE_TRIES);
	return false;
}

static bool left_of(const int32_t a[2], const int32_t b[2])
{
	return a[0] < b[0] || (a[0] == b[0] && a[1] < b[1]);
}

/* Joins the holes, from left to right. */
static int join_holes(const struct polygon *polygon, struct ring *ring, struct arena *arena)
{
	uint32_t holes = polygon->loops - 1;
	uint32_t *hole = ARENA_NEW(arena, uint32_t, holes + 1);
	if (!hole)
		return -ENOMEM;
	for (uint32_t l = 1; l < polygon->loops; l++) {
		uint32_t best = polygon->loop_end[l - 1];
		for (uint32_t p = best; p < polygon->loop_end[l]; p++)
			if (left_of(polygon->point[p], polygon->point[best]))
				best = p;
		uint32_t k = l - 1;
		for (; k && left_of(polygon->point[best], polygon->point[hole[k - 1]]); k--)
			hole[k] = hole[k - 1];
		hole[k] = best;
	}
	for (uint32_t k = 0; k < holes; k++)
		if (!join_hole(ring, 0, hole[k]))
			return -EDOM;
	return 0;
}

static bool turns_left(const struct ring *ring, uint32_t place)
{
	return orientation(where(ring, ring->previous[place]), where(ring, place), where(ring, ring->next[place])) > 0;
}

static uint32_t bucket_of(const struct ring *ring, int axis, int32_t coordinate)
{
	return (uint32_t)((coordinate - ring->low[axis]) / ring->side);
}

static int fill_buckets(struct ring *ring, struct arena *arena)
{
	int32_t high[2];
	for (int axis = 0; axis < 2; axis++) {
		ring->low[axis] = high[axis] = where(ring, 0)[axis];
		for (uint32_t p = 1; p < ring->places; p++) {
			int32_t c = where(ring, p)[axis];
			ring->low[axis] = c < ring->low[axis] ? c : ring->low[axis];
			high[axis] = c > high[axis] ? c : high[axis];
		}
	}
	int32_t width = high[0] - ring->low[0], height = high[1] - ring->low[1], sides = 1;
	while (sides < BUCKETS_SIDE && (uint32_t)(sides * sides) < ring->places / 2)
		sides++;
	ring->side = (width > height ? width : height) / sides + 1;
	ring->columns = bucket_of(ring, 0, high[0]) + 1;
	ring->rows = bucket_of(ring, 1, high[1]) + 1;
	ring->bucket = ARENA_NEW(arena, uint32_t, ring->columns * ring->rows);
	ring->chain = ARENA_NEW(arena, uint32_t, ring->places);
	if (!ring->bucket || !ring->chain)
		return -ENOMEM;
	memset(ring->bucket, 0xff, ring->columns * ring->rows * sizeof *ring->bucket);
	for (uint32_t p = 0; p < ring->places; p++) {
		if (turns_left(ring, p))
			continue;
		uint32_t b =
		    bucket_of(ring, 1, where(ring, p)[1]) * ring->columns + bucket_of(ring, 0, where(ring, p)[0]);
		ring->chain[p] = ring->bucket[b];
		ring->bucket[b] = p;
	}
	return 0;
}

/* Whether the closed triangle holds a place without a left turn in this bucket; forgets those that have gone or turned. */
static bool bucket_blocks(struct ring *ring, uint32_t b, const int32_t a[2], const int32_t t[2], const int32_t c[2])
{
	for (uint32_t *slot = &ring->bucket[b]; *slot != NONE;) {
		uint32_t p = *slot;
		if (ring->next[p] == NONE || turns_left(ring, p)) {
			*slot = ring->chain[p];
			continue;
		}
		const int32_t *at = where(ring, p);
		if (orientation(a, t, at) >= 0 && orientation(t, c, at) >= 0 && orientation(c, a, at) >= 0 &&
		    !same(at, a) && !same(at, t) && !same(at, c))
			return true;
		slot = &ring->chain[p];
	}
	return false;
}

static int32_t least(int32_t a, int32_t b, int32_t c)
{
	int32_t m = a < b ? a : b;
	return m < c ? m : c;
}

static int32_t most(int32_t a, int32_t b, int32_t c)
{
	int32_t m = a > b ? a : b;
	return m > c ? m : c;
}

static bool triangle_blocked(struct ring *ring, const int32_t a[2], const int32_t t[2], const int32_t c[2])
{
	uint32_t left = bucket_of(ring, 0, least(a[0], t[0], c[0])), right = bucket_of(ring, 0, most(a[0], t[0], c[0]));
	uint32_t low = bucket_of(ring, 1, least(a[1], t[1], c[1])), high = bucket_of(ring, 1, most(a[1], t[1], c[1]));
	for (uint32_t row = low; row <= high; row++)
		for (uint32_t column = left; column <= right; column++)
			if (bucket_blocks(ring, row * ring->columns + column, a, t, c))
				return true;
	return false;
}

static bool is_ear(struct ring *ring, uint32_t tip)
{
	uint32_t before = ring->previous[tip], after = ring->next[tip];
	const int32_t *a = where(ring, before), *t = where(ring, tip), *c = where(ring, after);
	if (orientation(a, t, c) <= 0 || !in_angle(ring, before, c) || !in_angle(ring, after, a))
		return false;
	if (triangle_blocked(ring, a, t, c))
		return false;
	return !ring->allows || ring->allows(ring->ctx, ring->at[before], ring->at[after]);
}

static int cut_ears(struct ring *ring, uint32_t (*triangle)[3], uint32_t *ret_n)
{
	uint32_t n = 0, left = 1, since = 0, tip = 0;
	for (uint32_t p = ring->next[0]; p != 0; p = ring->next[p])
		left++;
	while (left > 3) {
		uint32_t before = ring->previous[tip], after = ring->next[tip];
		if (!is_ear(ring, tip)) {
			tip = after;
			if (++since > left)
				return -EDOM;
			continue;
		}
		triangle[n][0] = ring->at[before];
		triangle[n][1] = ring->at[tip];
		triangle[n++][2] = ring->at[after];
		link(ring, before, after);
		ring->next[tip] = NONE;
		tip = ring->next[after]; /* not the next one: fans make slivers */
		since = 0;
		left--;
	}
	if (!turns_left(ring, tip))
		return -EDOM;
	triangle[n][0] = ring->at[ring->previous[tip]];
	triangle[n][1] = ring->at[tip];
	triangle[n++][2] = ring->at[ring->next[tip]];
	*ret_n = n;
	return 0;
}

int triangulate(const struct polygon *polygon, triangulate_allows *allows, const void *ctx, struct arena *arena,
                uint32_t (**ret_triangle)[3], uint32_t *ret_n)
{
	assert(polygon->loops > 0 && polygon->loop_end[polygon->loops - 1] == polygon->n);
	struct ring ring = {.point = polygon->point, .allows = allows, .ctx = ctx};
	uint32_t places = polygon->n + 2 * (polygon->loops - 1);
	if (polygon->n < 3)
		return -EDOM;
	ring.at = ARENA_NEW(arena, uint32_t, places);
	ring.next = ARENA_NEW(arena, uint32_t, places);
	ring.previous = ARENA_NEW(arena, uint32_t, places);
	uint32_t(*triangle)[3] = arena_alloc(arena, places, sizeof *triangle);
	if (!ring.at || !ring.next || !ring.previous || !triangle)
		return -ENOMEM;
	lay_loops(polygon, &ring);
	int r = join_holes(polygon, &ring, arena);
	if (!r)
		r = fill_buckets(&ring, arena);
	if (!r)
		r = cut_ears(&ring, triangle, ret_n);
	if (!r)
		*ret_triangle = triangle;
	return r;
}

int64_t polygon_area(const struct polygon *polygon)
{
	int64_t sum = 0;
	for (uint32_t l = 0, first = 0; l < polygon->loops; first = polygon->loop_end[l++])
		for (uint32_t p = first; p < polygon->loop_end[l]; p++) {
			const int32_t *a = polygon->point[p];
			const int32_t *b = polygon->point[p + 1 < polygon->loop_end[l] ? p + 1 : first];
			sum += (int64_t)a[0] * b[1] - (int64_t)b[0] * a[1];
		}
	return sum;
}

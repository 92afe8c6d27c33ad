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

#define NONE          UINT32_MAX
#define BUCKETS_SIDE  64 /* at most, a side */
#define OCCUPIED_BITS 1024
#define BRIDGE_TRIES  16 /* points of a hole; one that finds no bridge is rare */

struct place {
	int32_t where[2];
	uint32_t point, next, previous; /* next: NONE once it was cut off */
	uint32_t chain;                 /* next in its bucket */
	uint8_t column, row;            /* its bucket */
	bool left;                      /* it turns left; known once the buckets are filled */
};

struct ring {
	struct place *place;
	uint32_t places;
	triangulate_allows *allows;
	const void *ctx;
	uint64_t occupied[OCCUPIED_BITS /
	                  64]; /* a bit per hash of the coordinates that the outer loop and what was joined have */
	uint32_t *bucket;      /* places without a left turn: first of a bucket */
	uint32_t columns;
};

static const int32_t *where(const struct ring *ring, uint32_t place)
{
	return ring->place[place].where;
}

static uint32_t occupied_bit(const int32_t p[2])
{
	return ((uint32_t)p[0] * 0x9e3779b1u + (uint32_t)p[1] * 0x85ebca6bu) >> 22; /* of OCCUPIED_BITS */
}

static bool same(const int32_t a[2], const int32_t b[2])
{
	return a[0] == b[0] && a[1] == b[1];
}

/* Whether the direction from `place` to p lies strictly inside its angle. */
static bool in_angle(const struct ring *ring, uint32_t place, const int32_t p[2])
{
	const int32_t *before = where(ring, ring->place[place].previous), *at = where(ring, place);
	const int32_t *after = where(ring, ring->place[place].next);
	int64_t turn = orientation(before, at, after), in = orientation(before, at, p), out = orientation(at, after, p);
	return turn > 0 ? in > 0 && out > 0 : in > 0 || out > 0;
}

/* Whether the boxes about two segments have nothing in common along an axis. */
static bool apart(int32_t a, int32_t b, int32_t c, int32_t d)
{
	return (c > a) & (c > b) & (d > a) & (d > b) || (c < a) & (c < b) & (d < a) & (d < b);
}

/* Whether segment a-b has more in common with segment c-d than an end of both. */
static bool blocks(const int32_t a[2], const int32_t b[2], const int32_t c[2], const int32_t d[2])
{
	if (apart(a[0], b[0], c[0], d[0]) || apart(a[1], b[1], c[1], d[1]))
		return false;
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
	ring->place[a].next = b;
	ring->place[b].previous = a;
}

/* Every loop as a ring of its own; place and point have the same number. */
static void lay_loops(const struct polygon *polygon, struct ring *ring)
{
	for (uint32_t l = 0, first = 0; l < polygon->loops; first = polygon->loop_end[l++])
		for (uint32_t p = first; p < polygon->loop_end[l]; p++) {
			ring->place[p].point = p;
			ring->place[p].where[0] = polygon->point[p][0];
			ring->place[p].where[1] = polygon->point[p][1];
			link(ring, p, p + 1 < polygon->loop_end[l] ? p + 1 : first);
		}
	ring->places = polygon->n;
}

static bool bridge_clear(const struct ring *ring, uint32_t from, uint32_t to, uint32_t places)
{
	const int32_t *a = where(ring, from), *b = where(ring, to);
	if (!in_angle(ring, from, b) || !in_angle(ring, to, a))
		return false;
	if (ring->allows && !ring->allows(ring->ctx, ring->place[from].point, ring->place[to].point))
		return false;
	for (uint32_t p = 0; p < places; p++)
		if (blocks(a, b, where(ring, p), where(ring, ring->place[p].next)))
			return false;
	return true;
}

/* Where the ring through `outer` touches the hole at `hole`, or NONE. */
static uint32_t touching_place(const struct ring *ring, uint32_t outer, uint32_t hole)
{
	uint32_t p = outer;
	do {
		if (same(where(ring, p), where(ring, hole)) && in_angle(ring, p, where(ring, ring->place[hole].next)))
			return p;
		p = ring->place[p].next;
	} while (p != outer);
	return NONE;
}

static void splice(struct ring *ring, uint32_t outer, uint32_t hole)
{
	uint32_t outer_next = ring->place[outer].next, hole_next = ring->place[hole].next;
	link(ring, outer, hole_next);
	link(ring, hole, outer_next);
}

static void bridge(struct ring *ring, uint32_t outer, uint32_t hole)
{
	uint32_t outer_again = ring->places++, hole_again = ring->places++;
	ring->place[outer_again] = ring->place[outer];
	ring->place[hole_again] = ring->place[hole];
	link(ring, outer_again, ring->place[outer].next);
	link(ring, hole_again, ring->place[hole].next);
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
		p = ring->place[p].next;
	} while (p != outer);
	return best;
}

/* Notes where the loop through `first` has places. */
static void occupy(struct ring *ring, uint32_t first)
{
	uint32_t p = first;
	do {
		uint32_t bit = occupied_bit(where(ring, p));
		ring->occupied[bit / 64] |= (uint64_t)1 << bit % 64;
		p = ring->place[p].next;
	} while (p != first);
}

/* Splices a loop that touches the ring there. */
static bool join_touching(struct ring *ring, uint32_t outer, uint32_t first)
{
	uint32_t p = first;
	do {
		uint32_t bit = occupied_bit(where(ring, p)), touching = NONE;
		if (ring->occupied[bit / 64] >> bit % 64 & 1)
			touching = touching_place(ring, outer, p);
		if (touching != NONE) {
			splice(ring, touching, p);
			return true;
		}
		p = ring->place[p].next;
	} while (p != first);
	return false;
}

static bool join_hole(struct ring *ring, uint32_t outer, uint32_t first)
{
	if (join_touching(ring, outer, first))
		return true;
	uint32_t hole = first, tries = 0;
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
		hole = ring->place[hole].next;
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
	uint32_t *hole = ARENA_TAKE(arena, uint32_t, holes + 1);
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
	occupy(ring, 0);
	for (uint32_t k = 0; k < holes; k++) {
		if (!join_hole(ring, 0, hole[k]))
			return -EDOM;
		if (k + 1 < holes)
			occupy(ring, hole[k]); /* which goes once around the whole ring now */
	}
	return 0;
}

static bool turns_left(const struct ring *ring, uint32_t place)
{
	return orientation(where(ring, ring->place[place].previous), where(ring, place),
	                   where(ring, ring->place[place].next)) > 0;
}

/* The lowest of both coordinates, and the larger of the two extents. */
static int32_t extent(const struct ring *ring, int32_t ret_low[2])
{
	int32_t most = 0;
	for (int axis = 0; axis < 2; axis++) {
		int32_t low = where(ring, 0)[axis], high = low;
		for (uint32_t p = 1; p < ring->places; p++) {
			int32_t c = where(ring, p)[axis];
			low = c < low ? c : low;
			high = c > high ? c : high;
		}
		ret_low[axis] = low;
		most = high - low > most ? high - low : most;
	}
	return most;
}

/* Buckets have a power of two as their side: every place is given its own once, by shifts. */
static int fill_buckets(struct ring *ring, struct arena *arena)
{
	int32_t low[2], most = extent(ring, low), sides = 1, shift = 0;
	while (sides < BUCKETS_SIDE && (uint32_t)(sides * sides) < ring->places / 2)
		sides++;
	while (most >> shift >= sides)
		shift++;
	ring->columns = (uint32_t)(most >> shift) + 1;
	ring->bucket = ARENA_TAKE(arena, uint32_t, ring->columns * ring->columns);
	if (!ring->bucket)
		return -ENOMEM;
	memset(ring->bucket, 0xff, ring->columns * ring->columns * sizeof *ring->bucket);
	for (uint32_t p = 0; p < ring->places; p++) {
		struct place *place = &ring->place[p];
		place->column = (uint8_t)((place->where[0] - low[0]) >> shift);
		place->row = (uint8_t)((place->where[1] - low[1]) >> shift);
		place->left = turns_left(ring, p);
		if (place->left)
			continue;
		uint32_t b = place->row * ring->columns + place->column;
		place->chain = ring->bucket[b];
		ring->bucket[b] = p;
	}
	return 0;
}

/* Whether the closed triangle holds a place without a left turn in this bucket; forgets those that have gone or turned. */
static bool bucket_blocks(struct ring *ring, uint32_t b, const int32_t a[2], const int32_t t[2], const int32_t c[2])
{
	for (uint32_t *slot = &ring->bucket[b]; *slot != NONE;) {
		struct place *place = &ring->place[*slot];
		const int32_t *at = place->where;
		if (place->next == NONE || place->left) {
			*slot = place->chain;
			continue;
		}
		if (orientation(a, t, at) >= 0 && orientation(t, c, at) >= 0 && orientation(c, a, at) >= 0 &&
		    !same(at, a) && !same(at, t) && !same(at, c))
			return true;
		slot = &place->chain;
	}
	return false;
}

static uint8_t least(uint8_t a, uint8_t b, uint8_t c)
{
	uint8_t m = a < b ? a : b;
	return m < c ? m : c;
}

static uint8_t most(uint8_t a, uint8_t b, uint8_t c)
{
	uint8_t m = a > b ? a : b;
	return m > c ? m : c;
}

static bool triangle_blocked(struct ring *ring, const struct place *a, const struct place *t, const struct place *c)
{
	uint32_t left = least(a->column, t->column, c->column), right = most(a->column, t->column, c->column);
	uint32_t low = least(a->row, t->row, c->row), high = most(a->row, t->row, c->row);
	for (uint32_t row = low; row <= high; row++)
		for (uint32_t column = left; column <= right; column++)
			if (bucket_blocks(ring, row * ring->columns + column, a->where, t->where, c->where))
				return true;
	return false;
}

/* The tip turns left, so the diagonal lies to the inner side of it at both ends; what remains of their angles is the other
 * side, and none of that at an end without a left turn. */
static bool is_ear(struct ring *ring, uint32_t tip)
{
	const struct place *t = &ring->place[tip], *a = &ring->place[t->previous], *c = &ring->place[t->next];
	if (!t->left || (a->left && orientation(where(ring, a->previous), a->where, c->where) <= 0) ||
	    (c->left && orientation(c->where, where(ring, c->next), a->where) <= 0))
		return false;
	if (triangle_blocked(ring, a, t, c))
		return false;
	return !ring->allows || ring->allows(ring->ctx, a->point, c->point);
}

static int cut_ears(struct ring *ring, uint32_t (*triangle)[3], uint32_t *ret_n)
{
	uint32_t n = 0, left = 1, since = 0, tip = 0;
	for (uint32_t p = ring->place[0].next; p != 0; p = ring->place[p].next)
		left++;
	while (left > 3) {
		uint32_t before = ring->place[tip].previous, after = ring->place[tip].next;
		if (!is_ear(ring, tip)) {
			tip = after;
			if (++since > left)
				return -EDOM;
			continue;
		}
		triangle[n][0] = ring->place[before].point;
		triangle[n][1] = ring->place[tip].point;
		triangle[n++][2] = ring->place[after].point;
		link(ring, before, after);
		ring->place[tip].next = NONE;
		ring->place[before].left = turns_left(ring, before);
		ring->place[after].left = turns_left(ring, after);
		tip = ring->place[after].next; /* not the next one: fans make slivers */
		since = 0;
		left--;
	}
	if (!turns_left(ring, tip))
		return -EDOM;
	triangle[n][0] = ring->place[ring->place[tip].previous].point;
	triangle[n][1] = ring->place[tip].point;
	triangle[n++][2] = ring->place[ring->place[tip].next].point;
	*ret_n = n;
	return 0;
}

int triangulate(const struct polygon *polygon, triangulate_allows *allows, const void *ctx, struct arena *arena,
                uint32_t (**ret_triangle)[3], uint32_t *ret_n)
{
	assert(polygon->loops > 0 && polygon->loop_end[polygon->loops - 1] == polygon->n);
	struct ring ring = {.allows = allows, .ctx = ctx};
	uint32_t places = polygon->n + 2 * (polygon->loops - 1);
	if (polygon->n < 3)
		return -EDOM;
	ring.place = ARENA_TAKE(arena, struct place, places);
	uint32_t(*triangle)[3] = arena_take(arena, places, sizeof *triangle);
	if (!ring.place || !triangle)
		return -ENOMEM;
	lay_loops(polygon, &ring);
	int r = polygon->loops > 1 ? join_holes(polygon, &ring, arena) : 0;
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

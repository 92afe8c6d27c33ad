/* The polylines on the faces of a patch, and their simplification.
 *
 * A face is 16 x 16 squares. A square whose corners differ in sign carries one segment, or two that cut off its
 * negative corners: what marching cubes draws there from either side. A segment is *shared* when the cells on both
 * sides are complete; where only one side is, that patch alone has it, as a rim. Everything here is computed from
 * the signs, completeness and values at the face, in its two coordinates, and treats both sides alike: this is why
 * the two neighbours end with the same polyline without knowing of each other.
 *
 * A point between two shared segments belongs to a chain and may go; all others stay, but for rims that only this patch
 * has. Chains are simplified after Douglas and Peucker, from the end with the smaller name, closed ones from their
 * smallest name towards the smaller neighbour, distances to the segment compared as exact integers. Three additions
 * keep the steps from ever meeting:
 *   - a step touches no segment of the face but those it replaces, one-sided ones included;
 *   - a closed chain keeps three points;
 *   - a chain keeps its farthest point when both its ends touch one square or lie on one edge of the patch (there the
 *     chain of another face may join the same ends).
 * So an edge between two points of a face exists only as a segment or as a step, and never twice. */
#include "core/border.h"

#include <assert.h>
#include <errno.h>
#include <string.h>

#include "core/predicates.h"

#define SIDE       PATCH_SIDE
#define NODES_LOW  (SIDE * (SIDE + 1)) /* grid edges along the first axis; those along the second follow */
#define NODES      (2 * NODES_LOW)
#define SEGMENTS   (2 * SIDE * SIDE)
#define NO_SEGMENT UINT16_MAX
#define NO_CHAIN   UINT32_MAX

/* A node is a grid edge of the face that the surface crosses. */
struct node {
	uint32_t vertex; /* of this patch's surface */
	int32_t place[2];
	uint16_t link[2]; /* shared segments */
	uint8_t shared;   /* how many */
	bool foreign;     /* a segment here is complete on the other side */
};

struct segment {
	uint16_t node[2];
	bool shared;
	uint32_t chain, order; /* where it lies in its chain */
};

/* A vertex of the patch's surface on a face. */
struct entry {
	uint32_t vertex;
	uint16_t node;
};

#define NODE_WORDS ((NODES + 63) / 64)

struct face {
	const struct window *window;
	int axis, high, in[2];     /* the axes within the face, ascending */
	uint32_t inside[SIDE + 1]; /* bit p of row q: the corner is */
	uint32_t own[SIDE],
	    foreign[SIDE]; /* the same for squares: the cell of this patch, and that behind it, has a surface */
	uint64_t crossed[NODE_WORDS]; /* nodes in use; the others hold nothing */
	struct node node[NODES];
	struct segment segment[SEGMENTS];
	uint32_t segments;
	int64_t tolerance_squared;
};

/* A chain while it is made: its nodes; a closed one repeats the first. */
struct run {
	uint16_t node[SEGMENTS + 1];
	bool kept[SEGMENTS + 1];
	uint32_t n, chain;
};

static int node_at(int direction, int p, int q)
{
	return direction ? NODES_LOW + q * (SIDE + 1) + p : q * SIDE + p;
}

static void node_where(int node, int *ret_direction, int *ret_p, int *ret_q)
{
	*ret_direction = node >= NODES_LOW;
	int width = *ret_direction ? SIDE + 1 : SIDE, index = *ret_direction ? node - NODES_LOW : node;
	*ret_p = index % width;
	*ret_q = index / width;
}

/* The signs at the face, and the cells on its two sides. */
static void look_at(struct face *face)
{
	const uint32_t *inside = face->window->inside, *active = face->window->active;
	const int corner = face->high ? SIDE : 0, own = face->high ? SIDE - 1 : 0, foreign = face->high ? SIDE : -1;
	memset(face->inside, 0, sizeof face->inside);
	memset(face->own, 0, sizeof face->own);
	memset(face->foreign, 0, sizeof face->foreign);
	for (int q = 0; q <= SIDE; q++) {
		if (face->axis) {
			const bool z = face->axis == 2;
			face->inside[q] = inside[z ? window_row(q, corner) : window_row(corner, q)] >> WINDOW_LOW;
			if (q == SIDE)
				continue;
			face->own[q] = active[z ? window_row(q, own) : window_row(own, q)] >> WINDOW_LOW;
			face->foreign[q] = active[z ? window_row(q, foreign) : window_row(foreign, q)] >> WINDOW_LOW;
			continue;
		}
		for (int p = 0; p <= SIDE; p++)
			face->inside[q] |= (inside[window_row(p, q)] >> (corner + WINDOW_LOW) & 1) << p;
		for (int p = 0; p < SIDE && q < SIDE; p++) {
			const uint32_t cells = active[window_row(p, q)];
			face->own[q] |= (cells >> (own + WINDOW_LOW) & 1) << p;
			face->foreign[q] |= (cells >> (foreign + WINDOW_LOW) & 1) << p;
		}
	}
}

/* Where the surface crosses a grid edge of the face. */
static void place_node(struct face *face, int node)
{
	static const int stride[3] = {1, WINDOW_SIDE, WINDOW_SIDE * WINDOW_SIDE};
	int direction, p, q, at[3];
	node_where(node, &direction, &p, &q);
	at[face->axis] = face->high ? SIDE : 0;
	at[face->in[0]] = p;
	at[face->in[1]] = q;
	const int16_t *value = &face->window->value[window_at(at[0], at[1], at[2])];
	int32_t *place = face->node[node].place;
	place[0] = p * LATTICE;
	place[1] = q * LATTICE;
	place[direction] += cubes_edge_parameter(value[0], value[stride[face->in[direction]]]);
}

static struct node *use_node(struct face *face, int node, uint32_t vertex)
{
	uint64_t *word = &face->crossed[node >> 6], bit = 1ull << (node & 63);
	if (!(*word & bit)) {
		*word |= bit;
		face->node[node] = (struct node){.vertex = vertex, .link = {NO_SEGMENT, NO_SEGMENT}};
		place_node(face, node);
	}
	return &face->node[node];
}

static void add_segment(struct face *face, int a, int b, bool shared, bool foreign)
{
	uint16_t s = (uint16_t)face->segments++;
	face->segment[s] = (struct segment){{(uint16_t)a, (uint16_t)b}, shared, NO_CHAIN, 0};
	for (int k = 0; k < 2; k++) {
		struct node *node = use_node(face, k ? b : a, UINT32_MAX);
		node->foreign |= foreign;
		if (shared)
			node->link[node->shared++] = s;
	}
}

/* The segments of one square whose corners differ: two crossed edges joined, or the negative corners cut off. */
static void draw_square(struct face *face, int p, int q)
{
	bool s00 = face->inside[q] >> p & 1, s10 = face->inside[q] >> (p + 1) & 1;
	bool s01 = face->inside[q + 1] >> p & 1, s11 = face->inside[q + 1] >> (p + 1) & 1;
	bool foreign = face->foreign[q] >> p & 1, shared = foreign && face->own[q] >> p & 1;
	int bottom = node_at(0, p, q), top = node_at(0, p, q + 1), left = node_at(1, p, q),
	    right = node_at(1, p + 1, q);
	if (s00 == s11 && s10 == s01) {
		add_segment(face, bottom, s00 ? left : right, shared, foreign);
		add_segment(face, top, s00 ? right : left, shared, foreign);
		return;
	}
	int crossed[4], n = 0;
	if (s00 != s10)
		crossed[n++] = bottom;
	if (s00 != s01)
		crossed[n++] = left;
	if (s10 != s11)
		crossed[n++] = right;
	if (s01 != s11)
		crossed[n++] = top;
	add_segment(face, crossed[0], crossed[1], shared, foreign);
}

/* `entry` are the vertices on this face. A cell beside a square whose corners differ is complete if it has a surface. */
static void draw_face(struct face *face, const struct entry *entry, uint32_t entries)
{
	face->segments = 0;
	memset(face->crossed, 0, sizeof face->crossed);
	look_at(face);
	for (uint32_t e = 0; e < entries; e++)
		use_node(face, entry[e].node, entry[e].vertex);
	for (int q = 0; q < SIDE; q++) {
		uint32_t a = face->inside[q], b = face->inside[q + 1];
		uint32_t differ = (a | a >> 1 | b | b >> 1) & ~(a & a >> 1 & b & b >> 1);
		uint32_t squares = differ & (face->own[q] | face->foreign[q]) & ((1u << SIDE) - 1);
		for (; squares; squares &= squares - 1)
			draw_square(face, __builtin_ctz(squares), q);
	}
}

static uint16_t other_end(const struct face *face, uint16_t segment, uint16_t node)
{
	const struct segment *s = &face->segment[segment];
	return s->node[0] == node ? s->node[1] : s->node[0];
}

/* Follows shared segments from `start`, over `segment` first. */
static void follow(struct face *face, uint16_t start, uint16_t segment, struct run *run)
{
	uint16_t node = start;
	run->n = 0;
	run->node[run->n++] = node;
	for (;;) {
		face->segment[segment].chain = run->chain;
		face->segment[segment].order = run->n - 1;
		node = other_end(face, segment, node);
		run->node[run->n++] = node;
		const struct node *at = &face->node[node];
		if (node == start || at->shared < 2)
			break;
		segment = at->link[0] == segment ? at->link[1] : at->link[0];
	}
	memset(run->kept, 0, run->n);
}

/* Whether the step between two nodes touches `segment` elsewhere than in a common end. */
static bool step_touches(const struct face *face, uint16_t a, uint16_t b, const struct segment *segment)
{
	uint16_t c = segment->node[0], d = segment->node[1];
	if ((a == c && b == d) || (a == d && b == c))
		return true;
	if (b == c || b == d) {
		uint16_t swap = a;
		a = b;
		b = swap;
	}
	const int32_t *pa = face->node[a].place, *pb = face->node[b].place;
	if (a == c || a == d) {
		const int32_t *far = face->node[a == c ? d : c].place;
		return !orientation(pa, pb, far) && (between(pa, pb, far) || between(pa, far, pb));
	}
	return segments_touch(pa, pb, face->node[c].place, face->node[d].place);
}

/* Whether the boxes of a-b and c-d have no point in common; then nor do the segments. */
static bool apart(const int32_t a[2], const int32_t b[2], const int32_t c[2], const int32_t d[2])
{
	bool beyond = false;
	for (int k = 0; k < 2; k++) {
		const int32_t low = a[k] < b[k] ? a[k] : b[k], high = a[k] < b[k] ? b[k] : a[k];
		beyond |= ((c[k] < low) & (d[k] < low)) | ((c[k] > high) & (d[k] > high));
	}
	return beyond;
}

static bool step_blocked(const struct face *face, const struct run *run, uint32_t i, uint32_t j)
{
	const int32_t *a = face->node[run->node[i]].place, *b = face->node[run->node[j]].place;
	for (uint32_t s = 0; s < face->segments; s++) {
		const struct segment *segment = &face->segment[s];
		if (segment->chain == run->chain && segment->order >= i && segment->order < j)
			continue;
		if (apart(a, b, face->node[segment->node[0]].place, face->node[segment->node[1]].place))
			continue;
		if (step_touches(face, run->node[i], run->node[j], segment))
			return true;
	}
	return false;
}

/* Squared distance of p to the segment a-b, times the squared length of the latter. */
static int64_t scaled_distance(const int32_t a[2], const int32_t b[2], const int32_t p[2])
{
	int64_t length = distance_squared2(a, b);
	int64_t along = (int64_t)(p[0] - a[0]) * (b[0] - a[0]) + (int64_t)(p[1] - a[1]) * (b[1] - a[1]);
	if (along <= 0)
		return distance_squared2(a, p) * length;
	if (along >= length)
		return distance_squared2(b, p) * length;
	int64_t across = orientation(a, b, p);
	return across * across;
}

/* The point between i and j farthest from the step, the first of several. */
static uint32_t farthest(const struct face *face, const struct run *run, uint32_t i, uint32_t j, int64_t *ret_distance)
{
	const int32_t *a = face->node[run->node[i]].place, *b = face->node[run->node[j]].place;
	uint32_t best = i;
	*ret_distance = -1;
	for (uint32_t k = i + 1; k < j; k++) {
		int64_t distance = scaled_distance(a, b, face->node[run->node[k]].place);
		if (distance > *ret_distance) {
			*ret_distance = distance;
			best = k;
		}
	}
	return best;
}

static void divide(const struct face *face, struct run *run, uint32_t i, uint32_t j)
{
	run->kept[i] = run->kept[j] = true;
	if (j - i < 2)
		return;
	int64_t distance;
	uint32_t k = farthest(face, run, i, j, &distance);
	int64_t length = distance_squared2(face->node[run->node[i]].place, face->node[run->node[j]].place);
	if (distance <= face->tolerance_squared * length && !step_blocked(face, run, i, j))
		return;
	divide(face, run, i, k);
	divide(face, run, k, j);
}

/* The point farthest from the start; the first of several. */
static uint32_t opposite(const struct face *face, const struct run *run)
{
	uint32_t best = 1;
	int64_t most = -1;
	for (uint32_t k = 1; k + 1 < run->n; k++) {
		int64_t distance = distance_squared2(face->node[run->node[0]].place, face->node[run->node[k]].place);
		if (distance > most) {
			most = distance;
			best = k;
		}
	}
	return best;
}

static void divide_closed(const struct face *face, struct run *run)
{
	uint32_t last = run->n - 1, half = opposite(face, run), kept = 0;
	divide(face, run, 0, half);
	divide(face, run, half, last);
	for (uint32_t k = 0; k < last; k++)
		kept += run->kept[k];
	if (kept > 2)
		return;
	int64_t before, after;
	uint32_t low = farthest(face, run, 0, half, &before), high = farthest(face, run, half, last, &after);
	uint32_t third = before >= after ? low : high;
	divide(face, run, third == low ? 0 : half, third);
	divide(face, run, third, third == low ? half : last);
}

static bool node_in_square(int node, int p, int q)
{
	if (p < 0 || q < 0 || p >= SIDE || q >= SIDE)
		return false;
	return node == node_at(0, p, q) || node == node_at(0, p, q + 1) || node == node_at(1, p, q) ||
	       node == node_at(1, p + 1, q);
}

static bool ends_close(int a, int b)
{
	int direction, p, q, direction_b, p_b, q_b;
	node_where(a, &direction, &p, &q);
	node_where(b, &direction_b, &p_b, &q_b);
	if (direction == 0 && direction_b == 0 && q == q_b && (q == 0 || q == SIDE))
		return true;
	if (direction == 1 && direction_b == 1 && p == p_b && (p == 0 || p == SIDE))
		return true;
	return node_in_square(b, p, q) || node_in_square(b, direction ? p - 1 : p, direction ? q : q - 1);
}

static void divide_open(const struct face *face, struct run *run)
{
	uint32_t last = run->n - 1;
	int64_t distance;
	if (last > 1 && ends_close(run->node[0], run->node[last])) {
		uint32_t middle = farthest(face, run, 0, last, &distance);
		divide(face, run, 0, middle);
		divide(face, run, middle, last);
	} else {
		divide(face, run, 0, last);
	}
}

static void add_chain(const struct face *face, const struct run *run, bool closed, struct border *border)
{
	struct border_chain *chain = &border->chain[border->chains++];
	*chain =
	    (struct border_chain){border->members, run->n - closed, closed, (uint8_t)face->axis, (uint8_t)face->high};
	for (uint32_t k = 0; k < chain->n; k++) {
		border->member[border->members] = face->node[run->node[k]].vertex;
		border->kept[border->members++] = run->kept[k];
	}
}

static void trace_chain(struct face *face, uint16_t n, bool closed, struct border *border)
{
	struct run run;
	const struct node *node = &face->node[n];
	uint16_t first = node->link[0];
	if (closed && other_end(face, node->link[1], n) < other_end(face, first, n))
		first = node->link[1];
	run.chain = border->chains;
	follow(face, n, first, &run);
	if (closed)
		divide_closed(face, &run);
	else
		divide_open(face, &run);
	add_chain(face, &run, closed, border);
}

/* From the ends of open chains first, then from what is left, in the order of nodes. */
static void trace_chains(struct face *face, struct border *border)
{
	for (int closed = 0; closed < 2; closed++)
		for (int w = 0; w < NODE_WORDS; w++)
			for (uint64_t bits = face->crossed[w]; bits; bits &= bits - 1) {
				int n = 64 * w + __builtin_ctzll(bits);
				const struct node *node = &face->node[n];
				if (node->shared == 1 + closed && face->segment[node->link[0]].chain == NO_CHAIN)
					trace_chain(face, (uint16_t)n, closed, border);
			}
}

static void judge_vertices(const struct face *face, const struct entry *entry, uint32_t entries, struct border *border)
{
	for (uint32_t e = 0; e < entries; e++) {
		const struct node *node = &face->node[entry[e].node];
		uint8_t bits = border->faces[entry[e].vertex], *kind = &border->kind[entry[e].vertex];
		if (bits & (bits - 1))
			*kind = BORDER_PINNED;
		else if (node->shared == 2)
			*kind = BORDER_CHAIN;
		else
			*kind = node->shared || node->foreign ? BORDER_PINNED : BORDER_FREE;
	}
}

/* The faces a vertex lies on. Along its own axis it never lies on one. */
static uint8_t faces_of(const uint16_t vertex[3])
{
	uint8_t faces = 0;
	for (int axis = 0; axis < 3; axis++)
		faces |=
		    (uint8_t)((vertex[axis] == 0) << 2 * axis | (vertex[axis] == SIDE * LATTICE) << (2 * axis + 1));
	return faces;
}

static uint16_t node_of(uint32_t name, int axis)
{
	const int corners = SIDE + 1, along = (int)(name % 3), index = (int)(name / 3);
	const int at[3] = {index % corners, index / corners % corners, index / corners / corners};
	const int in0 = axis == 0, in1 = axis == 2 ? 1 : 2;
	return (uint16_t)node_at(along == in1, at[in0], at[in1]);
}

/* Lists the vertices of each face, one face after the other; `ret_entry` has room for two each. */
static void enter_vertices(const struct surface *raw, const uint8_t *faces, const uint32_t first[6],
                           struct entry *ret_entry)
{
	uint32_t at[6];
	memcpy(at, first, sizeof at);
	for (uint32_t v = 0; v < raw->nv; v++)
		for (uint32_t bits = faces[v]; bits; bits &= bits - 1) {
			int f = __builtin_ctz(bits);
			ret_entry[at[f]++] = (struct entry){v, node_of(raw->name[v], f >> 1)};
		}
}

/* Where each face's vertices begin in the list of all, and the end. */
static void count_vertices(const struct surface *raw, uint8_t *ret_faces, uint32_t ret_first[7])
{
	uint32_t count[6] = {0};
	for (uint32_t v = 0; v < raw->nv; v++) {
		ret_faces[v] = faces_of(raw->vertex[v]);
		for (uint32_t bits = ret_faces[v]; bits; bits &= bits - 1)
			count[__builtin_ctz(bits)]++;
	}
	ret_first[0] = 0;
	for (int f = 0; f < 6; f++)
		ret_first[f + 1] = ret_first[f] + count[f];
}

int border_find(const struct window *window, const struct surface *raw, int64_t tolerance, struct arena *arena,
                struct border *ret)
{
	assert((raw->name || !raw->nv) && tolerance >= 0);
	struct border border = {0};
	uint32_t first[7];
	struct face *face = ARENA_TAKE(arena, struct face, 1);
	border.kind = ARENA_NEW(arena, uint8_t, raw->nv);
	border.faces = ARENA_TAKE(arena, uint8_t, raw->nv);
	if (!face || !border.kind || !border.faces)
		return -ENOMEM;
	count_vertices(raw, border.faces, first);
	const uint32_t nodes = first[6];
	struct entry *entry = ARENA_TAKE(arena, struct entry, nodes);
	border.member = ARENA_TAKE(arena, uint32_t, nodes + 1);
	border.kept = ARENA_TAKE(arena, bool, nodes + 1);
	border.chain = ARENA_TAKE(arena, struct border_chain, nodes + 1);
	if (!entry || !border.member || !border.kept || !border.chain)
		return -ENOMEM;
	enter_vertices(raw, border.faces, first, entry);
	face->window = window;
	face->tolerance_squared = tolerance * tolerance;
	for (int f = 0; f < 6; f++) {
		const uint32_t entries = first[f + 1] - first[f];
		if (!entries)
			continue;
		face->axis = f >> 1;
		face->high = f & 1;
		face->in[0] = face->axis == 0;
		face->in[1] = face->axis == 2 ? 1 : 2;
		draw_face(face, entry + first[f], entries);
		trace_chains(face, &border);
		judge_vertices(face, entry + first[f], entries, &border);
	}
	*ret = border;
	return 0;
}

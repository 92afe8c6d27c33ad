/* One patch in few bytes.
 *
 *   | varint n | key x y z | version | i64 t_last | i64 t_first | body ... |      n counts everything after itself
 *
 * The body is one number in [0, 1), narrowed by binary decisions (a range coder: Martin 1979), each with a probability that
 * its context has learnt so far. Contexts begin anew with every patch, from a table of what patches are like, so that none
 * needs another one to be read. Encoder and decoder are one walk over the patch: every step calls code_*(value), which in
 * the one direction writes the value and in the other ignores it and returns what was read; so neither drifts from the
 * other. Times stay whole bytes beside the body: they are those of rows, the same in many patches, which zstd finds.
 *
 * What is exploited: most vertices of marching cubes lie on an edge of the grid, so two coordinates are multiples of 256,
 * near those of the vertex before; the third is near that of the last vertex of its kind, on the same wall. A triangle
 * mostly shares an edge with a recent one. Its third corner then closes a gap between two open edges, or is one of the
 * vertices nearest to that edge, and whether it was used before is told first. Tried without gain: several walls
 * remembered at once; a place pushed away from the neighbour instead of the middle of the edge. */
#include "core/coded.h"
#include "core/coded_table.h"

#include <assert.h>
#include <errno.h>
#include <stdio.h>
#include <string.h>

enum {
	EDGES = 24,   /* open edges that are remembered */
	NEAR = 16,    /* vertices near a place that have a rank */
	WINDOW = 256, /* vertices that are looked at for them */
	CERTAIN = 12, /* so many decisions the table counts for */
	SLOWEST = 40, /* so many decisions at most a context counts */
	PROBABLE_MIN = 64,
};

/* Contexts of a number below 2^bits - 1, and of one with a sign. */
#define NUMBER(bits) (2 * (bits))
#define SIGNED(bits) (2 * (bits) + 1)
enum { COUNT_BITS = 17, CLASS_BITS = 9, KIND_BITS = 2, STEP_BITS = 5, REST_BITS = 13, RANK_BITS = 5 };

/* How likely the next decision is a zero, in 1/65536, and after how many it was learnt. */
struct context {
	uint16_t p;
	uint8_t n;
};

/* In the order of the table. First index or indices: what the decision depends on. */
struct contexts {
	struct context rotated[1], rotation[4];
	struct context triangles[NUMBER(COUNT_BITS)], vertices[SIGNED(COUNT_BITS)], runs[NUMBER(COUNT_BITS)];
	struct context plane[NUMBER(KIND_BITS)], class[NUMBER(CLASS_BITS)], share[NUMBER(COUNT_BITS)];
	struct context mask[8][8];                                /* mask before */
	struct context step[3][2][5][SIGNED(STEP_BITS)];          /* axis; moved; what is known of the surface */
	struct context rest[2][3][SIGNED(REST_BITS)], low[3][8];  /* free on one axis only; axis */
	struct context edge[6][32], corner[4][4];                 /* edge before; open ends */
	struct context fresh[2][2], first[2][SIGNED(COUNT_BITS)]; /* the first of a run; corner */
	struct context rank[3][2][NUMBER(RANK_BITS)], far[2][SIGNED(COUNT_BITS)]; /* corner; used */
};

_Static_assert(sizeof(struct contexts) == CODED_CONTEXTS * sizeof(struct context), "the table has every context once");

struct coder {
	struct buffer *out; /* NULL: this one reads */
	const uint8_t *in, *end;
	uint32_t low, range, code;
	struct contexts contexts;
};

/* The range coder */

static void carry(struct coder *coder)
{
	uint8_t *p = coder->out->data + coder->out->len;
	if (coder->out->error)
		return;
	while (++*--p == 0)
		;
}

static void next_byte(struct coder *coder)
{
	if (coder->out) {
		const uint8_t top = (uint8_t)(coder->low >> 24);
		buffer_append(coder->out, &top, 1);
		coder->low <<= 8;
	} else {
		coder->code = coder->code << 8 | (coder->in < coder->end ? *coder->in++ : 0);
	}
}

static bool narrow(struct coder *coder, uint32_t zero, bool bit)
{
	if (!coder->out)
		bit = coder->code >= zero;
	if (!bit) {
		coder->range = zero;
	} else {
		coder->range -= zero;
		coder->code -= zero;
		if (coder->out && coder->low + zero < zero)
			carry(coder);
		coder->low += zero;
	}
	while (coder->range < 1u << 24) {
		coder->range <<= 8;
		next_byte(coder);
	}
	return bit;
}

static bool code_bit(struct coder *coder, struct context *context, bool bit)
{
	const uint32_t rate = 65536u / (context->n + 2u);
	bit = narrow(coder, (coder->range >> 16) * context->p, bit);
	if (bit)
		context->p = (uint16_t)(context->p - (context->p * rate >> 16));
	else
		context->p = (uint16_t)(context->p + ((65536u - context->p) * rate >> 16));
	if (context->p < PROBABLE_MIN)
		context->p = PROBABLE_MIN;
	if (context->p > 65536 - PROBABLE_MIN)
		context->p = 65536 - PROBABLE_MIN;
	if (context->n < SLOWEST)
		context->n++;
	return bit;
}

static uint32_t code_raw(struct coder *coder, int bits, uint32_t value)
{
	uint32_t got = 0;
	while (bits-- > 0)
		got = got << 1 | narrow(coder, coder->range >> 1, value >> bits & 1);
	return got;
}

static uint32_t code_tree(struct coder *coder, struct context *tree, int bits, uint32_t value)
{
	uint32_t node = 1;
	for (int i = bits; i-- > 0;)
		node = node << 1 | code_bit(coder, &tree[node], value >> i & 1);
	return node - (1u << bits);
}

/* 0 .. 2^max - 2: how many bits value + 1 has, one by one, then those after its first; the second of them is learnt. */
static uint32_t code_number(struct coder *coder, struct context *context, int max, uint32_t value)
{
	int bits = 0;
	value++;
	while (bits < max - 1 && code_bit(coder, &context[bits], value >> (bits + 1) > 0))
		bits++;
	uint32_t got = 1;
	if (bits > 0)
		got = 2 | code_bit(coder, &context[max + bits], value >> (bits - 1) & 1);
	if (bits > 1)
		got = got << (bits - 1) | code_raw(coder, bits - 1, value & ((1u << (bits - 1)) - 1));
	return got - 1;
}

static int32_t code_signed(struct coder *coder, struct context *context, int max, int32_t value)
{
	const int32_t size = (int32_t)code_number(coder, context, max, (uint32_t)(value < 0 ? -value : value));
	return size && code_bit(coder, &context[NUMBER(max)], value < 0) ? -size : size;
}

/* The walk over a patch */

static int refuse(char error[128], const char *text)
{
	snprintf(error, 128, "%s", text);
	return -EPROTO;
}

enum { PLANE_OF_NONE, PLANE_NEXT, PLANE_OTHER };

static uint32_t code_plane(struct coder *coder, uint32_t next, uint32_t plane)
{
	const uint32_t kind = plane == PLANE_NONE ? PLANE_OF_NONE : plane == next ? PLANE_NEXT : PLANE_OTHER;
	switch (code_number(coder, coder->contexts.plane, KIND_BITS, kind)) {
	case PLANE_OF_NONE:
		return PLANE_NONE;
	case PLANE_NEXT:
		return next;
	default:
		return code_raw(coder, 32, plane);
	}
}

static int code_runs(struct coder *coder, struct patch *patch, char error[128])
{
	uint32_t left = patch->nt, next = 0;
	for (uint32_t i = 0; i < patch->nruns; i++) {
		struct patch_run run = patch->run[i];
		run.plane = code_plane(coder, next, run.plane);
		run.class = (uint8_t)code_number(coder, coder->contexts.class, CLASS_BITS, run.class);
		if (i + 1 == patch->nruns)
			run.triangles = (uint16_t)left;
		else
			run.triangles =
			    (uint16_t)(1 + code_number(coder, coder->contexts.share, COUNT_BITS, run.triangles - 1u));
		if (run.triangles == 0 || run.triangles > left)
			return refuse(error, "a CODED patch whose runs do not add up to its triangles");
		left -= run.triangles;
		if (run.plane != PLANE_NONE)
			next = run.plane + 1;
		patch->run[i] = run;
	}
	return 0;
}

/* What the vertices before tell of the next one. */
struct trail {
	int last[3];    /* the vertex before */
	int like[8][3]; /* the last one that lies free on the same axes */
	uint32_t mask;  /* axes on which the vertex before lies free */
	uint32_t seen;  /* bit per mask: `like` is there */
};

static int code_coordinate(struct coder *coder, const struct trail *trail, uint32_t mask, int axis, int moved,
                           int value)
{
	struct contexts *contexts = &coder->contexts;
	const bool is_free = mask >> axis & 1, alone = (mask & (mask - 1)) == 0, seen = trail->seen >> mask & 1;
	const int from = trail->last[axis] / LATTICE, like = trail->like[mask][axis], stood = like / LATTICE;
	const int kind = !is_free ? 0 : !seen ? 1 : stood < from ? 2 : stood == from ? 3 : 4;
	const int cell =
	    from + code_signed(coder, contexts->step[axis][moved][kind], STEP_BITS, value / LATTICE - from);
	if (!is_free)
		return cell * LATTICE;
	if (seen && stood == cell)
		return like + code_signed(coder, contexts->rest[alone][axis], REST_BITS, value - like);
	const int d = seen ? cell - stood : 0;
	struct context *tree = contexts->low[d == 1 ? 1 : d == -1 ? 2 : 0];
	const uint32_t high = code_tree(coder, tree, 3, (uint32_t)value % LATTICE >> 5);
	return cell * LATTICE + (int)(high << 5 | code_raw(coder, 5, value & 31));
}

static int code_vertices(struct coder *coder, struct patch *patch, char error[128])
{
	struct trail trail = {0};
	for (uint32_t i = 0; i < patch->nv; i++) {
		uint16_t *vertex = patch->vertex[i];
		uint32_t mask = 0;
		int at[3], moved = 0;
		for (int axis = 0; axis < 3; axis++)
			mask |= (uint32_t)(vertex[axis] % LATTICE != 0) << axis;
		mask = code_tree(coder, coder->contexts.mask[trail.mask], 3, mask);
		for (int axis = 2; axis >= 0; axis--) {
			at[axis] = code_coordinate(coder, &trail, mask, axis, moved, vertex[axis]);
			if (at[axis] < 0 || at[axis] > PATCH_SIDE * LATTICE)
				return refuse(error, "a CODED patch with a vertex outside of it");
			moved |= at[axis] / LATTICE != trail.last[axis] / LATTICE;
		}
		for (int axis = 0; axis < 3; axis++) {
			vertex[axis] = (uint16_t)at[axis];
			trail.last[axis] = trail.like[mask][axis] = at[axis];
		}
		trail.mask = mask;
		trail.seen |= 1u << mask;
	}
	return 0;
}

/* What the triangles before tell of the next one: edges that one of them has and no other one yet, newest first, each with
 * the corner beside it, and which vertices they have used. */
struct trace {
	const struct patch *patch;
	uint32_t n, edge[EDGES][3];
	uint8_t used[(PATCH_VERTICES_MAX + 8) / 8];
};

static bool is_used(const struct trace *trace, uint32_t i)
{
	return trace->used[i / 8] >> i % 8 & 1;
}

static void close_edge(struct trace *trace, uint32_t at)
{
	trace->n--;
	memmove(trace->edge + at, trace->edge + at + 1, (trace->n - at) * sizeof(*trace->edge));
}

/* The edge from a to b of a triangle: it closes the one from b to a, or stands open itself. */
static void add_edge(struct trace *trace, uint32_t a, uint32_t b, uint32_t beside)
{
	for (uint32_t i = 0; i < trace->n; i++)
		if (trace->edge[i][0] == b && trace->edge[i][1] == a) {
			close_edge(trace, i);
			return;
		}
	if (trace->n == EDGES)
		trace->n--;
	memmove(trace->edge + 1, trace->edge, trace->n * sizeof(*trace->edge));
	trace->edge[0][0] = a;
	trace->edge[0][1] = b;
	trace->edge[0][2] = beside;
	trace->n++;
}

/* The newest open edge that the triangle closes, and the corner that follows it in the triangle; trace->n: none. */
static uint32_t find_edge(const struct trace *trace, const uint32_t t[3], int *ret_corner)
{
	for (uint32_t i = 0; i < trace->n; i++)
		for (int c = 0; c < 3; c++)
			if (trace->edge[i][0] == t[(c + 1) % 3] && trace->edge[i][1] == t[c]) {
				*ret_corner = (c + 2) % 3;
				return i;
			}
	*ret_corner = 0;
	return trace->n;
}

/* The vertices, used or not, that are nearest to a place (in half units), in that order, but for three. */
static uint32_t find_nearest(const struct trace *trace, bool used, const int32_t place[3], const uint32_t but[3],
                             uint32_t about, uint32_t ret[NEAR])
{
	const struct patch *patch = trace->patch;
	uint32_t distance[NEAR], n = 0, end = patch->nv;
	uint32_t i = 0;

	if (patch->nv > WINDOW) {
		i = about < WINDOW / 2 ? 0 : about - WINDOW / 2;
		end = i + WINDOW < end ? i + WINDOW : end;
	}
	for (; i < end; i++) {
		if (is_used(trace, i) != used || i == but[0] || i == but[1] || i == but[2])
			continue;
		uint32_t far = 0, at;
		for (int axis = 0; axis < 3; axis++) {
			const int32_t d = 2 * patch->vertex[i][axis] - place[axis];
			far += (uint32_t)(d * d);
		}
		if (n == NEAR && far >= distance[NEAR - 1])
			continue;
		n += n < NEAR;
		for (at = n - 1; at > 0 && distance[at - 1] > far; at--) {
			distance[at] = distance[at - 1];
			ret[at] = ret[at - 1];
		}
		distance[at] = far;
		ret[at] = i;
	}
	return n;
}

/* A vertex by its rank among those near a place; one that is not is told by its distance from `about` in their order. */
static uint32_t code_near(struct coder *coder, const struct trace *trace, int kind, bool used, const int32_t place[3],
                          const uint32_t but[3], uint32_t about, uint32_t value)
{
	uint32_t near[NEAR], rank = 0;
	const uint32_t n = find_nearest(trace, used, place, but, about, near);
	while (rank < n && near[rank] != value)
		rank++;
	rank = code_number(coder, coder->contexts.rank[kind][used], RANK_BITS, rank);
	if (rank < n)
		return near[rank];
	return about + (uint32_t)code_signed(coder, coder->contexts.far[used], COUNT_BITS, (int32_t)(value - about));
}

enum { CORNER_UNUSED, CORNER_USED, CORNER_AFTER, CORNER_BEFORE };

/* The corner beside an edge a -> b that is closed: at the end of an open edge of a or b, or near by. */
static uint32_t code_corner(struct coder *coder, const struct trace *trace, uint32_t edge, uint32_t value)
{
	const uint32_t a = trace->edge[edge][0], b = trace->edge[edge][1], d = trace->edge[edge][2];
	uint32_t after = UINT32_MAX, before = UINT32_MAX, kind;
	for (uint32_t i = trace->n; i-- > 0;) {
		if (trace->edge[i][0] == b && trace->edge[i][1] != a)
			after = trace->edge[i][1];
		if (trace->edge[i][1] == a && trace->edge[i][0] != b)
			before = trace->edge[i][0];
	}
	kind = value == after                                      ? CORNER_AFTER
	       : value == before                                   ? CORNER_BEFORE
	       : value < trace->patch->nv && is_used(trace, value) ? CORNER_USED
	                                                           : CORNER_UNUSED;
	const int ends = (after != UINT32_MAX) + 2 * (before != UINT32_MAX);
	kind = code_tree(coder, coder->contexts.corner[ends], 2, kind);
	if (kind == CORNER_AFTER)
		return after;
	if (kind == CORNER_BEFORE)
		return before;
	int32_t place[3];
	const uint32_t but[3] = {a, b, d};
	for (int axis = 0; axis < 3; axis++) {
		const uint16_t(*v)[3] = (const uint16_t(*)[3])trace->patch->vertex;
		place[axis] = v[a][axis] + v[b][axis];
	}
	return code_near(coder, trace, 0, kind == CORNER_USED, place, but, a > b ? a : b, value);
}

static bool code_used(struct coder *coder, const struct trace *trace, bool begins, int corner, uint32_t value)
{
	return code_bit(coder, &coder->contexts.fresh[begins][corner],
	                value < trace->patch->nv && is_used(trace, value));
}

/* A triangle that closes no edge: each corner near the one before. False: there is no such vertex. */
static bool code_alone(struct coder *coder, const struct trace *trace, bool begins, const uint32_t last[3],
                       uint32_t t[3])
{
	uint32_t got[3] = {UINT32_MAX, UINT32_MAX, UINT32_MAX};
	uint32_t about = last[0] + (uint32_t)code_signed(coder, coder->contexts.first[begins], COUNT_BITS,
	                                                 (int32_t)(t[0] - last[0]));
	if (about >= trace->patch->nv)
		return false;
	got[0] = about;
	const uint16_t(*v)[3] = (const uint16_t(*)[3])trace->patch->vertex;
	for (int c = 1; c < 3; c++) {
		int32_t place[3];
		for (int axis = 0; axis < 3; axis++)
			place[axis] = c < 2 ? 2 * v[about][axis] : v[got[0]][axis] + v[got[1]][axis];
		const bool used = code_used(coder, trace, begins, c - 1, t[c]);
		got[c] = code_near(coder, trace, c, used, place, got, about, t[c]);
		if (got[c] >= trace->patch->nv)
			return false;
		about = got[c];
	}
	memcpy(t, got, sizeof(got));
	return true;
}

/* To begin with the smallest index, as all our meshes do. */
static int smallest(const uint32_t t[3])
{
	const int first = t[1] < t[0] ? 1 : 0;
	return t[2] < t[first] ? 2 : first;
}

static int judge_triangle(const struct patch *patch, const uint32_t t[3], char error[128])
{
	if (t[0] >= patch->nv || t[1] >= patch->nv || t[2] >= patch->nv)
		return refuse(error, "a CODED patch with an index beyond its vertices");
	if (t[0] == t[1] || t[1] == t[2] || t[2] == t[0])
		return refuse(error, "a CODED patch with a triangle that uses a vertex twice");
	return 0;
}

static int code_triangles(struct coder *coder, struct patch *patch, bool rotated, char error[128])
{
	struct trace trace = {.patch = patch};
	uint32_t last[3] = {0}, context = 0, run = 0, left = 0;
	for (uint32_t i = 0; i < patch->nt; i++) {
		const bool begins = left == 0;
		if (begins)
			left = patch->run[run++].triangles;
		left--;
		uint32_t t[3], got[3];

		memcpy(t, patch->triangle[i], sizeof(t));
		int corner = 0, turn = 0;
		uint32_t edge = find_edge(&trace, t, &corner);
		edge = edge == trace.n ? 0 : edge + 1;
		edge = code_tree(coder, coder->contexts.edge[begins ? 5 : context], 5, edge);
		context = edge < 3 ? edge : edge < 8 ? 3 : 4;
		if (edge > trace.n)
			return refuse(error, "a CODED patch with a triangle at an edge that is not there");
		if (edge > 0) {
			got[0] = trace.edge[edge - 1][1];
			got[1] = trace.edge[edge - 1][0];
			got[2] = code_corner(coder, &trace, edge - 1, t[corner]);
		} else {
			memcpy(got, t, sizeof(got));
			if (!code_alone(coder, &trace, begins, last, got))
				return refuse(error, "a CODED patch with an index beyond its vertices");
		}
		if (judge_triangle(patch, got, error) < 0)
			return -EPROTO;
		const int first = smallest(got);
		if (rotated) {
			turn = smallest(t);
			turn = (int)code_tree(coder, coder->contexts.rotation, 2, (uint32_t)turn) % 3;
		}
		for (int c = 0; c < 3; c++) {
			last[c] = got[(first + c) % 3];
			patch->triangle[i][(c + turn) % 3] = last[c];
		}
		for (int c = 0; c < 3; c++) {
			trace.used[last[c] / 8] |= (uint8_t)(1 << last[c] % 8);
			add_edge(&trace, last[c], last[(c + 1) % 3], last[(c + 2) % 3]);
		}
	}
	return 0;
}

/* False: there is no such patch. */
static bool code_counts(struct coder *coder, uint32_t *nv, uint32_t *nt, uint32_t *nruns)
{
	struct contexts *contexts = &coder->contexts;
	*nt = 1 + code_number(coder, contexts->triangles, COUNT_BITS, *nt - 1);
	*nv = *nt + (uint32_t)code_signed(coder, contexts->vertices, COUNT_BITS, (int32_t)(*nv - *nt));
	*nruns = 1 + code_number(coder, contexts->runs, COUNT_BITS, *nruns - 1);
	return *nt <= UINT16_MAX && *nv >= 3 && *nv <= PATCH_VERTICES_MAX && *nruns <= *nt;
}

static int code_body(struct coder *coder, struct patch *patch, char error[128])
{
	bool rotated = false;
	for (uint32_t i = 0; coder->out && i < patch->nt; i++)
		rotated |= smallest(patch->triangle[i]) != 0;
	rotated = code_bit(coder, coder->contexts.rotated, rotated);
	int r = code_runs(coder, patch, error);
	if (r == 0)
		r = code_vertices(coder, patch, error);
	return r ? r : code_triangles(coder, patch, rotated, error);
}

static void start(struct coder *coder)
{
	struct context *context = (struct context *)&coder->contexts;
	for (size_t i = 0; i < sizeof(coder->contexts) / sizeof(*context); i++)
		context[i] = (struct context){.p = (uint16_t)(coded_table[i] << 8), .n = CERTAIN};
	coder->range = UINT32_MAX;
	for (int i = 0; !coder->out && i < 4; i++)
		next_byte(coder);
}

/* Whole patches: a head of varints, then the body */

enum { HEAD_MAX = 3 * 5 + 10 + 16 + 3 * 3, VARINT_MAX = 10 };

static uint8_t *put_varint(uint8_t *p, uint64_t value)
{
	for (; value >= 0x80; value >>= 7)
		*p++ = (uint8_t)value | 0x80;
	*p++ = (uint8_t)value;
	return p;
}

static uint64_t zigzag(int64_t value)
{
	return (uint64_t)value << 1 ^ (value < 0 ? UINT64_MAX : 0);
}

static int64_t unzigzag(uint64_t value)
{
	return (int64_t)(value >> 1 ^ (value & 1 ? UINT64_MAX : 0));
}

/* False when it is not whole, or longer than it need be: a number has one form. */
static bool get_varint(const uint8_t **p, const uint8_t *end, uint64_t *ret)
{
	uint64_t value = 0;
	for (int i = 0; i < VARINT_MAX && *p + i < end; i++) {
		const uint8_t byte = (*p)[i];
		value |= (uint64_t)(byte & 0x7f) << 7 * i;
		if (byte & 0x80)
			continue;
		if ((i > 0 && byte == 0) || (i == VARINT_MAX - 1 && byte > 1))
			return false;
		*p += i + 1;
		*ret = value;
		return true;
	}
	return false;
}

static size_t put_head(uint8_t head[HEAD_MAX], const struct patch *patch)
{
	uint8_t *p = head;
	p = put_varint(p, zigzag(patch->key.x));
	p = put_varint(p, zigzag(patch->key.y));
	p = put_varint(p, zigzag(patch->key.z));
	p = put_varint(p, patch->version);
	memcpy(p, &patch->t_last_ns, 8); /* version and last time are those of one row: zstd finds them together */
	memcpy(p + 8, &patch->t_first_ns, 8);
	return (size_t)(p + 16 - head);
}

void coded_put_patch(struct buffer *out, const struct patch *patch)
{
	assert(patch->nt > 0 && patch->nt <= UINT16_MAX && patch->nv <= PATCH_VERTICES_MAX &&
	       patch->nruns <= UINT16_MAX);
	uint8_t head[HEAD_MAX], size[VARINT_MAX];
	char error[128];
	struct buffer body = {0};
	struct coder coder = {.out = &body};
	struct patch *copy = patch_copy(patch); /* the walk is one for both directions: it writes what it reads */
	if (!copy) {
		out->error = out->error ? out->error : -ENOMEM;
		return;
	}
	start(&coder);
	const bool counted = code_counts(&coder, &copy->nv, &copy->nt, &copy->nruns);
	const int r = code_body(&coder, copy, error);
	assert(counted && r == 0);
	(void)counted;
	(void)r;
	/* The shortest number within what is left; the reader goes on with zeros. */
	const uint32_t last = (uint32_t)(coder.low + 0xffffff);
	if (last < coder.low)
		carry(&coder);
	coder.low = last;
	next_byte(&coder);
	while (!body.error && body.len > 0 && body.data[body.len - 1] == 0)
		body.len--;
	const uint8_t zero = 0;
	while (!body.error && body.len * CODED_SHARE < patch->nv + patch->nt)
		buffer_append(&body, &zero, 1);
	const size_t head_len = put_head(head, patch);
	buffer_append(out, size, (size_t)(put_varint(size, head_len + body.len) - size));
	buffer_append(out, head, head_len);
	buffer_append(out, body.data, body.len);
	out->error = out->error ? out->error : body.error;
	buffer_finish(&body);
	patch_unref(copy);
}

ssize_t coded_scan(const uint8_t *data, size_t len)
{
	const uint8_t *p = data;
	uint64_t n;
	if (!get_varint(&p, data + len, &n) || n > len - (size_t)(p - data))
		return -EPROTO;
	return (ssize_t)(p - data) + (ssize_t)n;
}

static bool get_key(const uint8_t **p, const uint8_t *end, struct patch_key *ret)
{
	int64_t xyz[3];
	for (int axis = 0; axis < 3; axis++) {
		uint64_t value;
		if (!get_varint(p, end, &value))
			return false;
		xyz[axis] = unzigzag(value);
		if (xyz[axis] < -GRID_PATCH_LIMIT || xyz[axis] > GRID_PATCH_LIMIT)
			return false;
	}
	*ret = (struct patch_key){(int32_t)xyz[0], (int32_t)xyz[1], (int32_t)xyz[2]};
	return true;
}

/* All but the counts, which the body begins with. */
static int get_head(const uint8_t **p, const uint8_t *end, struct patch *ret, char error[128])
{
	if (!get_key(p, end, &ret->key))
		return refuse(error, "a CODED patch without a key, or beyond the limits of the map");
	if (!get_varint(p, end, &ret->version) || end - *p < 16)
		return refuse(error, "a CODED patch that is too short");
	memcpy(&ret->t_last_ns, *p, 8);
	memcpy(&ret->t_first_ns, *p + 8, 8);
	*p += 16;
	return 0;
}

int coded_get_patch(const uint8_t *data, size_t len, struct patch **ret, char error[128])
{
	const uint8_t *p = data, *end = data + len;
	struct patch head = {.nt = 1}, *patch;
	uint64_t n;
	if (!get_varint(&p, end, &n) || n != (uint64_t)(end - p))
		return refuse(error, "a CODED patch of the wrong length");
	if (get_head(&p, end, &head, error) < 0)
		return -EPROTO;
	struct coder coder = {.in = p, .end = end};
	start(&coder);
	if (!code_counts(&coder, &head.nv, &head.nt, &head.nruns) ||
	    head.nv + head.nt > (size_t)(end - p) * CODED_SHARE)
		return refuse(error, "a CODED patch with impossible counts");
	patch = patch_allocate(head.key, head.nv, head.nt, head.nruns);
	if (!patch) {
		refuse(error, "no memory for a CODED patch");
		return -ENOMEM;
	}
	patch->version = head.version;
	patch->t_first_ns = head.t_first_ns;
	patch->t_last_ns = head.t_last_ns;
	const int r = code_body(&coder, patch, error);
	if (r < 0)
		patch_unref(patch);
	else
		*ret = patch;
	return r;
}

/* One patch in few bytes.
 *
 *   | varint n | key x y z | version | t_first | t_last | n bytes of range-coded body |
 *
 * The body is one number in [0, 1), narrowed by binary decisions (a range coder, as in Martin 1979), each with a
 * probability that its context has learnt so far. Contexts are born anew with every patch, from a table of what such
 * patches are like, so that a patch needs no other one to be read. Encoder and decoder are one walk over the patch: every
 * step calls code_*(value), which in the one direction writes the value and in the other ignores it and returns what was
 * read; neither can drift from the other.
 *
 * What is exploited: a vertex of marching cubes lies on an edge of the grid, so two of its coordinates are multiples of
 * 256 and near those of the vertex before; the third is near that of the last vertex of its kind, on the same wall. A
 * triangle most often shares an edge with a recent one, and its third corner is then new, or closes a gap between two
 * open edges, or stands near by in the order of the vertices, which is one of space. */
#include "core/coded.h"

#include <assert.h>
#include <errno.h>
#include <stdio.h>
#include <string.h>

enum { BITS = 17, NUMBER = 2 * BITS, SIGNED = NUMBER + 1, EDGES = 24 };

/* How likely the next decision is a zero, in 1/65536, and after how many it was learnt. */
struct context {
	uint16_t p;
	uint8_t n;
};

struct contexts {
	struct context count[3][NUMBER];
	struct context plane[SIGNED], class[SIGNED], share[NUMBER];
	struct context rotated[1], rotation[4];
	struct context mask[8][8], step[6][SIGNED], rest[9][SIGNED];
	struct context edge[3][32], corner[3][4], near[4][SIGNED], first[3][SIGNED];
};

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
	if (context->p < 64)
		context->p = 64;
	if (context->p > 65536 - 64)
		context->p = 65536 - 64;
	if (context->n < 30)
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
	while (bits-- > 0)
		node = node << 1 | code_bit(coder, &tree[node], value >> bits & 1);
	return node;
}

/* 0 .. 2^BITS - 2: how many bits value + 1 has, one by one, then all but the first of them; the second is learnt. */
static uint32_t code_number(struct coder *coder, struct context context[NUMBER], uint32_t value)
{
	int bits = 0;
	while (bits < BITS - 1 && code_bit(coder, &context[bits], (value + 1) >> (bits + 1) > 0))
		bits++;
	uint32_t got = 1;
	if (bits > 0)
		got = got << 1 | code_bit(coder, &context[BITS + bits], (value + 1) >> (bits - 1) & 1);
	if (bits > 1)
		got = got << (bits - 1) | code_raw(coder, bits - 1, (value + 1) & ((1u << (bits - 1)) - 1));
	return got - 1;
}

static int32_t code_signed(struct coder *coder, struct context context[SIGNED], int32_t value)
{
	const int32_t size = (int32_t)code_number(coder, context, (uint32_t)(value < 0 ? -value : value));
	return size && code_bit(coder, &context[NUMBER], value < 0) ? -size : size;
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
	switch (code_number(coder, coder->contexts.plane, kind)) {
	case PLANE_OF_NONE:
		return PLANE_NONE;
	case PLANE_NEXT:
		return next;
	default:
		return code_raw(coder, 16, plane >> 16) << 16 | code_raw(coder, 16, plane & 0xffff);
	}
}

static int code_runs(struct coder *coder, struct patch *patch, char error[128])
{
	uint32_t left = patch->nt, next = 0;
	for (uint32_t i = 0; i < patch->nruns; i++) {
		struct patch_run run = patch->run[i];
		run.plane = code_plane(coder, next, run.plane);
		run.class = (uint8_t)code_number(coder, coder->contexts.class, run.class);
		if (i + 1 == patch->nruns)
			run.triangles = (uint16_t)left;
		else
			run.triangles = (uint16_t)(1 + code_number(coder, coder->contexts.share, run.triangles - 1u));
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
	if (mask >> axis & 1) {
		const bool alone = (mask & (mask - 1)) == 0, seen = trail->seen >> mask & 1;
		const int from = seen ? trail->like[mask][axis] : trail->last[axis];
		return from + code_signed(coder, contexts->rest[(seen ? alone ? 0 : 3 : 6) + axis], value - from);
	}
	const int from = trail->last[axis] / LATTICE;
	return (from + code_signed(coder, contexts->step[2 * axis + moved], value / LATTICE - from)) * LATTICE;
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
		mask = code_tree(coder, coder->contexts.mask[trail.mask], 3, mask) & 7;
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

/* Edges that one triangle has and no other one yet, newest first. */
struct open_edges {
	uint32_t n;
	uint32_t edge[EDGES][2];
};

static void close_edge(struct open_edges *open, uint32_t at)
{
	open->n--;
	memmove(open->edge + at, open->edge + at + 1, (open->n - at) * sizeof(*open->edge));
}

/* The triangle's edge from a to b: it closes the one from b to a, or stands open itself. */
static void add_edge(struct open_edges *open, uint32_t a, uint32_t b)
{
	for (uint32_t i = 0; i < open->n; i++)
		if (open->edge[i][0] == b && open->edge[i][1] == a) {
			close_edge(open, i);
			return;
		}
	if (open->n == EDGES)
		open->n--;
	memmove(open->edge + 1, open->edge, open->n * sizeof(*open->edge));
	open->edge[0][0] = a;
	open->edge[0][1] = b;
	open->n++;
}

/* The newest open edge that the triangle closes, and the corner that follows it in the triangle; open->n: none. */
static uint32_t find_edge(const struct open_edges *open, const uint32_t t[3], int *ret_corner)
{
	for (uint32_t i = 0; i < open->n; i++)
		for (int c = 0; c < 3; c++)
			if (open->edge[i][0] == t[(c + 1) % 3] && open->edge[i][1] == t[c]) {
				*ret_corner = (c + 2) % 3;
				return i;
			}
	*ret_corner = 0;
	return open->n;
}

enum { CORNER_NEW, CORNER_AFTER, CORNER_BEFORE, CORNER_OTHER };

/* The corner beside an edge a -> b that is closed: the next new vertex, one at the end of an open edge of a or b, or any. */
static uint32_t code_corner(struct coder *coder, const struct open_edges *open, uint32_t edge, uint32_t fresh,
                            uint32_t value)
{
	const uint32_t a = open->edge[edge][0], b = open->edge[edge][1];
	uint32_t after = UINT32_MAX, before = UINT32_MAX, kind = CORNER_OTHER;
	for (uint32_t i = open->n; i-- > 0;) {
		if (i != edge && open->edge[i][0] == b && open->edge[i][1] != a)
			after = open->edge[i][1];
		if (i != edge && open->edge[i][1] == a && open->edge[i][0] != b)
			before = open->edge[i][0];
	}
	kind = value == fresh    ? CORNER_NEW
	       : value == after  ? CORNER_AFTER
	       : value == before ? CORNER_BEFORE
	                         : CORNER_OTHER;
	struct context *tree = coder->contexts.corner[(after != UINT32_MAX) + (before != UINT32_MAX)];
	kind = code_tree(coder, tree, 2, kind) & 3;
	if (kind == CORNER_NEW)
		return fresh;
	if (kind == CORNER_AFTER)
		return after;
	if (kind == CORNER_BEFORE)
		return before;
	const int64_t from = a > b ? a : b;
	return (uint32_t)(from + code_signed(coder, coder->contexts.near[0], (int32_t)(value - from)));
}

static void code_alone(struct coder *coder, uint32_t fresh, const uint32_t last[3], uint32_t t[3])
{
	struct contexts *contexts = &coder->contexts;
	(void)fresh;
	t[0] = last[0] + (uint32_t)code_signed(coder, contexts->first[0], (int32_t)(t[0] - last[0]));
	t[1] = t[0] + (uint32_t)code_signed(coder, contexts->first[1], (int32_t)(t[1] - t[0]));
	t[2] = t[1] + (uint32_t)code_signed(coder, contexts->first[2], (int32_t)(t[2] - t[1]));
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
	struct open_edges open = {0};
	uint32_t last[3] = {0}, fresh = 0, context = 0;
	for (uint32_t i = 0; i < patch->nt; i++) {
		uint32_t t[3], got[3];
		memcpy(t, patch->triangle[i], sizeof(t));
		int corner = 0, turn = 0;
		uint32_t edge = find_edge(&open, t, &corner);
		edge = edge == open.n ? 0 : edge + 1;
		edge = code_tree(coder, coder->contexts.edge[context], 5, edge) & 31;
		context = edge == 0 ? 0 : edge == 1 ? 1 : 2;
		if (edge > open.n)
			return refuse(error, "a CODED patch with a triangle at an edge that is not there");
		if (edge > 0) {
			got[0] = open.edge[edge - 1][1];
			got[1] = open.edge[edge - 1][0];
			got[2] = code_corner(coder, &open, edge - 1, fresh, t[corner]);
		} else {
			memcpy(got, t, sizeof(got));
			code_alone(coder, fresh, last, got);
		}
		if (judge_triangle(patch, got, error) < 0)
			return -EPROTO;
		const int first = smallest(got);
		if (rotated) {
			turn = (smallest(t) - 0 + 3) % 3;
			turn = (int)(code_tree(coder, coder->contexts.rotation, 2, (uint32_t)turn) & 3) % 3;
		}
		for (int c = 0; c < 3; c++) {
			last[c] = got[(first + c) % 3];
			patch->triangle[i][(c + turn) % 3] = last[c];
		}
		for (int c = 0; c < 3; c++) {
			fresh = last[c] >= fresh ? last[c] + 1 : fresh;
			add_edge(&open, last[c], last[(c + 1) % 3]);
		}
	}
	return 0;
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
		context[i] = (struct context){.p = 1u << 15};
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
	memcpy(p, &patch->t_first_ns, 8);
	memcpy(p + 8, &patch->t_last_ns, 8);
	p = put_varint(p + 16, patch->nv);
	p = put_varint(p, patch->nt);
	p = put_varint(p, patch->nruns);
	return (size_t)(p - head);
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
	const int r = code_body(&coder, copy, error);
	assert(r == 0);
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

/* A zeroed patch of the size that the head announces; NULL with a sentence. */
static struct patch *get_head(const uint8_t **p, const uint8_t *end, char error[128])
{
	struct patch_key key;
	uint64_t version, nv, nt, nruns;
	const uint8_t *times;
	if (!get_key(p, end, &key)) {
		refuse(error, "a CODED patch without a key, or beyond the limits of the map");
		return NULL;
	}
	if (!get_varint(p, end, &version) || end - *p < 16) {
		refuse(error, "a CODED patch that is too short");
		return NULL;
	}
	times = *p;
	*p += 16;
	if (!get_varint(p, end, &nv) || !get_varint(p, end, &nt) || !get_varint(p, end, &nruns) || nv < 3 ||
	    nv > PATCH_VERTICES_MAX || nt < 1 || nt > UINT16_MAX || nruns < 1 || nruns > nt ||
	    nv + nt > (uint64_t)(end - *p) * CODED_SHARE) {
		refuse(error, "a CODED patch with impossible counts");
		return NULL;
	}
	struct patch *patch = patch_allocate(key, (uint32_t)nv, (uint32_t)nt, (uint32_t)nruns);
	if (!patch) {
		refuse(error, "no memory for a CODED patch");
		return NULL;
	}
	patch->version = version;
	memcpy(&patch->t_first_ns, times, 8);
	memcpy(&patch->t_last_ns, times + 8, 8);
	return patch;
}

int coded_get_patch(const uint8_t *data, size_t len, struct patch **ret, char error[128])
{
	const uint8_t *p = data, *end = data + len;
	uint64_t n;
	if (!get_varint(&p, end, &n) || n != (uint64_t)(end - p))
		return refuse(error, "a CODED patch of the wrong length");
	struct patch *patch = get_head(&p, end, error);
	if (!patch)
		return -EPROTO;
	struct coder coder = {.in = p, .end = end};
	start(&coder);
	const int r = code_body(&coder, patch, error);
	if (r < 0)
		patch_unref(patch);
	else
		*ret = patch;
	return r;
}

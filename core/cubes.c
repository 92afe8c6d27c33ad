/* Marching cubes on one patch: gather, fill, extract.
 *
 * What costs is not the cells but getting at them: 21^3 values lie in up to 64 blocks. So everything that asks for signs
 * or completeness works on rows of bits, one bit a corner, 21 corners a row, put together from the bits that blocks keep.
 * Only the cells that hold surface are ever visited one by one, and only values beside the surface are ever read.
 *
 * Filling closes the slit along concave and convex edges, where the corner behind both surfaces was never seen. It
 * reads unfilled values only, so one pass gives the same whatever the order.
 *
 * A vertex lies on the edge from a voxel along an axis, at |a| / (|a| + |b|) of it in 1/256, halves rounded away from
 * the voxel, clamped to [4, 252]: integers only, and no two vertices of a cell ever coincide. It depends on these two
 * values alone, so the neighbouring patch computes the same point.
 *
 * The digest is one of all that extraction and border.c read, so equal digests mean equal surfaces and borders:
 *   - which cells have a surface: the patch's own and, for the border, those behind its faces. A border segment is drawn
 *     in a square whose corners differ; there `complete` and `has a surface` are the same;
 *   - which corners are the end of an edge that crosses the surface in one of these cells, for a cell behind a face only
 *     of edges in that face;
 *   - the values of these ends: a vertex reads no others. Their signs are those of all corners that are asked for: from one
 *     that is no such end, edges of its cell (or square) lead over corners of the same sign to one that is, since
 *     it has both signs.
 * What the fill read is not in it, only what it gave. */
#include "core/cubes.h"

#include <assert.h>
#include <errno.h>
#include <string.h>

/* Bits of a row: corner, or cell, i is bit i + WINDOW_LOW. */
#define CORNERS_OWN    (((1u << (PATCH_SIDE + 1)) - 1) << WINDOW_LOW)       /* 0 .. 16 */
#define CORNERS_FILLED (((1u << (PATCH_SIDE + 3)) - 1) << (WINDOW_LOW - 1)) /* -1 .. 17 */
#define CELLS_OWN      (((1u << PATCH_SIDE) - 1) << WINDOW_LOW)             /* 0 .. 15 */
#define CELLS_HALO     (((1u << (PATCH_SIDE + 2)) - 1) << (WINDOW_LOW - 1)) /* -1 .. 16 */

/* Rows are judged four at a time. */
typedef uint32_t rows4 __attribute__((vector_size(16)));
#define ROWS_PADDED (WINDOW_ROWS + 4)

/* The rows of a window, before and after the fill. Rows of corners outside -1 .. 17 hold nothing of meaning behind `filled`. */
struct rows {
	uint32_t known[ROWS_PADDED], inside[ROWS_PADDED];
	uint32_t filled[ROWS_PADDED]; /* corners the fill makes known */
	uint32_t known_after[ROWS_PADDED], inside_after[ROWS_PADDED];
	uint32_t active[ROWS_PADDED];                            /* cells with a surface */
	uint32_t crossed_y[ROWS_PADDED], crossed_z[ROWS_PADDED]; /* edges that cross it, from their lower corner */
	uint32_t ends[ROWS_PADDED];                              /* of edges that cross it */
};

/* How the layers of block `b` (-1 .. 2 from the patch's own first) lie in the window along one axis. */
static void block_layers(int b, int *ret_first, int *ret_count, int *ret_place)
{
	*ret_first = b < 0 ? BLOCK_SIDE - WINDOW_LOW : 0;
	*ret_count = b < 0 ? WINDOW_LOW : b < 2 ? BLOCK_SIDE : WINDOW_SIDE - WINDOW_LOW - PATCH_SIDE;
	*ret_place = b < 0 ? 0 : WINDOW_LOW + b * BLOCK_SIDE;
}

static void copy_block(const struct block *block, const int at[3], struct rows *rows)
{
	int first[3], count[3], place[3];
	for (int axis = 0; axis < 3; axis++)
		block_layers(at[axis], &first[axis], &count[axis], &place[axis]);
	const uint32_t mask = (1u << count[0]) - 1;
	for (int z = 0; z < count[2]; z++) {
		uint64_t known = block->known[z + first[2]], inside = block->inside[z + first[2]];
		if (!known)
			continue;
		known >>= first[1] * BLOCK_SIDE + first[0];
		inside >>= first[1] * BLOCK_SIDE + first[0];
		int row = (z + place[2]) * WINDOW_SIDE + place[1];
		for (int y = 0; y < count[1]; y++, row++, known >>= BLOCK_SIDE, inside >>= BLOCK_SIDE) {
			rows->known[row] |= ((uint32_t)known & mask) << place[0];
			rows->inside[row] |= ((uint32_t)inside & mask) << place[0];
		}
	}
}

#define BLOCKS (GRID_BOX_SIDE * GRID_BOX_SIDE * GRID_BOX_SIDE)

/* Block (x, y, z) of the 4^3 that a window reads; the patch's own are 1 and 2 on each axis. */
static int block_at(int x, int y, int z)
{
	return (z * GRID_BOX_SIDE + y) * GRID_BOX_SIDE + x;
}

static bool own_block(int b)
{
	return b == 1 || b == 2;
}

/* A cell of the patch has a corner in one of the patch's own blocks. Where there is none of them, that corner must be a
 * filled one, so there are neighbours on two axes: most of the patches around a surface are told apart by this alone. */
static bool may_have_cells(const struct block *const *blocks)
{
	int axes = 0;
	for (int z = 0; z < GRID_BOX_SIDE; z++)
		for (int y = 0; y < GRID_BOX_SIDE; y++)
			for (int x = 0; x < GRID_BOX_SIDE; x++) {
				int outside = !own_block(x) + 2 * !own_block(y) + 4 * !own_block(z);
				bool near = outside == 0 || (outside & (outside - 1)) == 0;
				if (near && blocks[block_at(x, y, z)])
					axes |= outside ? outside : 8;
			}
	return axes >= 8 || (axes & (axes - 1)) != 0;
}

static void copy_blocks(const struct block *const *blocks, struct rows *rows)
{
	int at[3];
	memset(rows->known, 0, sizeof rows->known);
	memset(rows->inside, 0, sizeof rows->inside);
	for (at[2] = -1; at[2] < 3; at[2]++)
		for (at[1] = -1; at[1] < 3; at[1]++)
			for (at[0] = -1; at[0] < 3; at[0]++) {
				const struct block *block = blocks[block_at(at[0] + 1, at[1] + 1, at[2] + 1)];
				if (block)
					copy_block(block, at, rows);
			}
}

/* Whether both signs occur. */
static bool both_signs(const struct rows *rows)
{
	uint32_t inside = 0, outside = 0;
	for (int r = 0; r < WINDOW_ROWS; r++) {
		inside |= rows->inside[r];
		outside |= rows->known[r] & ~rows->inside[r];
	}
	return inside && outside;
}

static inline rows4 load_rows(const uint32_t *row)
{
	rows4 rows;
	memcpy(&rows, row, sizeof rows);
	return rows;
}

static inline void store_rows(uint32_t *row, rows4 rows)
{
	memcpy(row, &rows, sizeof rows);
}

/* The corners that the fill makes known in four rows from `r` on, and all that are known and inside then. */
static inline void fill_rows(struct rows *rows, int r)
{
	const int y = 1, z = WINDOW_SIDE;
	const uint32_t *known = &rows->known[r], *inside = &rows->inside[r];
	rows4 own = load_rows(known), own_in = load_rows(inside), own_out = own & ~own_in;
	rows4 near_y[2] = {load_rows(known - y), load_rows(known + y)};
	rows4 near_z[2] = {load_rows(known - z), load_rows(known + z)};
	rows4 in_y[2] = {load_rows(inside - y), load_rows(inside + y)};
	rows4 in_z[2] = {load_rows(inside - z), load_rows(inside + z)};
	rows4 along_x = own << 1 | own >> 1, along_y = near_y[0] | near_y[1], along_z = near_z[0] | near_z[1];
	rows4 two = (along_x & along_y) | (along_x & along_z) | (along_y & along_z);
	rows4 negative = own_in << 1 | own_in >> 1 | in_y[0] | in_y[1] | in_z[0] | in_z[1];
	rows4 positive = own_out << 1 | own_out >> 1 | (near_y[0] & ~in_y[0]) | (near_y[1] & ~in_y[1]) |
	                 (near_z[0] & ~in_z[0]) | (near_z[1] & ~in_z[1]);
	rows4 filled = two & ~own & CORNERS_FILLED & (negative ^ positive);
	store_rows(&rows->filled[r], filled);
	store_rows(&rows->known_after[r], own | filled);
	store_rows(&rows->inside_after[r], own_in | (filled & negative));
}

/* Cells with a surface (complete, of both signs) in four rows from `r` on. */
static inline void find_active(struct rows *rows, int r)
{
	const uint32_t *known = &rows->known_after[r], *inside = &rows->inside_after[r];
	const int y = 1, z = WINDOW_SIDE;
	rows4 all = load_rows(known) & load_rows(known + y) & load_rows(known + z) & load_rows(known + y + z);
	rows4 in[4] = {load_rows(inside), load_rows(inside + y), load_rows(inside + z), load_rows(inside + y + z)};
	rows4 any = in[0] | in[1] | in[2] | in[3], every = in[0] & in[1] & in[2] & in[3];
	store_rows(&rows->active[r], all & all >> 1 & (any | any >> 1) & ~(every & every >> 1) & CELLS_HALO);
}

/* Cells that share no face with the patch are nobody's business here. */
static void drop_far_cells(struct rows *rows)
{
	for (int n = -1; n <= PATCH_SIDE; n++) {
		const uint32_t cells = n < 0 || n == PATCH_SIDE ? 0 : CELLS_OWN;
		rows->active[window_row(-1, n)] &= cells;
		rows->active[window_row(PATCH_SIDE, n)] &= cells;
		rows->active[window_row(n, -1)] &= cells;
		rows->active[window_row(n, PATCH_SIDE)] &= cells;
	}
}

static bool own_cells(const struct rows *rows)
{
	uint32_t any = 0;
	for (int k = 0; k < PATCH_SIDE; k++)
		for (int j = 0; j < PATCH_SIDE; j++)
			any |= rows->active[window_row(j, k)];
	return any & CELLS_OWN;
}

/* The edges along y and z that cross the surface in a cell beside them, in four rows from `r` on. */
static inline void cross_y(struct rows *rows, int r)
{
	const uint32_t *active = &rows->active[r], *inside = &rows->inside_after[r];
	rows4 cells = load_rows(active) | load_rows(active - WINDOW_SIDE);
	store_rows(&rows->crossed_y[r],
	           (load_rows(inside) ^ load_rows(inside + 1)) & (cells | cells << 1) & CORNERS_OWN);
}

static inline void cross_z(struct rows *rows, int r)
{
	const uint32_t *active = &rows->active[r], *inside = &rows->inside_after[r];
	rows4 cells = load_rows(active) | load_rows(active - 1);
	store_rows(&rows->crossed_z[r],
	           (load_rows(inside) ^ load_rows(inside + WINDOW_SIDE)) & (cells | cells << 1) & CORNERS_OWN);
}

/* The same along x, and the ends of all three. */
static inline void find_ends(struct rows *rows, int r)
{
	const uint32_t *active = &rows->active[r], *y = &rows->crossed_y[r], *z = &rows->crossed_z[r];
	rows4 cells = load_rows(active) | load_rows(active - 1) | load_rows(active - WINDOW_SIDE) |
	              load_rows(active - WINDOW_SIDE - 1);
	rows4 inside = load_rows(&rows->inside_after[r]), x = (inside ^ inside >> 1) & cells & CELLS_OWN;
	store_rows(&rows->ends[r],
	           x | x << 1 | load_rows(y) | load_rows(y - 1) | load_rows(z) | load_rows(z - WINDOW_SIDE));
}

/* Edges between corners 0 .. 16. Four rows at a time make 20 for 17: what rows 17 .. 19 get is never read. */
static void cross_edges(struct rows *rows)
{
	memset(rows->crossed_y, 0, sizeof rows->crossed_y);
	memset(rows->crossed_z, 0, sizeof rows->crossed_z);
	memset(rows->ends, 0, sizeof rows->ends);
	for (int k = 0; k <= PATCH_SIDE; k++)
		for (int j = 0; j < PATCH_SIDE; j += 4)
			cross_y(rows, window_row(j, k));
	for (int k = 0; k < PATCH_SIDE; k++)
		for (int j = 0; j <= PATCH_SIDE; j += 4)
			cross_z(rows, window_row(j, k));
	for (int k = 0; k <= PATCH_SIDE; k++)
		for (int j = 0; j <= PATCH_SIDE; j += 4)
			find_ends(rows, window_row(j, k));
}

/* Of a known corner -1 .. 17. */
static int16_t published(const struct block *const *blocks, int i, int j, int k)
{
	const int in = BLOCK_SIDE - 1;
	const struct block *block =
	    blocks[block_at((i >> BLOCK_SHIFT) + 1, (j >> BLOCK_SHIFT) + 1, (k >> BLOCK_SHIFT) + 1)];
	return block->voxel[((k & in) * BLOCK_SIDE + (j & in)) * BLOCK_SIDE + (i & in)].published;
}

/* The known neighbour of largest magnitude; all have one sign, so equal magnitudes are equal values. */
static int16_t strongest_neighbour(const struct block *const *blocks, const struct rows *rows, int i, int j, int k)
{
	static const int8_t step[6][3] = {{-1, 0, 0}, {1, 0, 0}, {0, -1, 0}, {0, 1, 0}, {0, 0, -1}, {0, 0, 1}};
	int16_t best = 0;
	for (int s = 0; s < 6; s++) {
		int x = i + step[s][0], y = j + step[s][1], z = k + step[s][2];
		if (!(rows->known[window_row(y, z)] >> (x + WINDOW_LOW) & 1))
			continue;
		int16_t v = published(blocks, x, y, z);
		if (v < 0 ? v < best : v > best)
			best = v;
	}
	return best;
}

/* Asks for the rows of voxels that copy_values will read, so that they come together. */
static void fetch_values(const struct block *const *blocks, const struct rows *rows)
{
	const int in = BLOCK_SIDE - 1;
	for (int k = 0; k <= PATCH_SIDE; k++)
		for (int j = 0; j <= PATCH_SIDE; j++) {
			uint32_t ends = rows->ends[window_row(j, k)] >> WINDOW_LOW;
			int b = block_at(1, (j >> BLOCK_SHIFT) + 1, (k >> BLOCK_SHIFT) + 1);
			for (; ends; ends >>= BLOCK_SIDE, b++)
				if (ends & 0xff && blocks[b])
					__builtin_prefetch(
					    &blocks[b]->voxel[((k & in) * BLOCK_SIDE + (j & in)) * BLOCK_SIDE]);
		}
}

/* The values at the ends of crossing edges, into the window and, four in a word, into its digest. */
static void copy_values(const struct block *const *blocks, const struct rows *rows, struct window *window)
{
	struct digest digest = window->digest;
	uint64_t word = 0;
	uint32_t n = 0;
	for (int k = 0; k <= PATCH_SIDE; k++)
		for (int j = 0; j <= PATCH_SIDE; j++) {
			int r = window_row(j, k);
			for (uint32_t ends = rows->ends[r]; ends; ends &= ends - 1) {
				int b = __builtin_ctz(ends), i = b - WINDOW_LOW;
				int16_t value = rows->known[r] >> b & 1 ? published(blocks, i, j, k)
				                                        : strongest_neighbour(blocks, rows, i, j, k);
				window->value[r * WINDOW_SIDE + b] = value;
				word = word << 16 | (uint16_t)value;
				if ((++n & 3) == 0)
					digest_word(&digest, word);
			}
		}
	digest_word(&digest, word);
	digest_word(&digest, n);
	window->digest = digest;
}

/* Cells and ends of crossing edges: 18 + 17 bits of a row, and its number. */
static struct digest digest_rows(const struct rows *rows)
{
	struct digest digest = {0, 0};
	for (int k = -1; k <= PATCH_SIDE; k++)
		for (int j = -1; j <= PATCH_SIDE; j++) {
			int r = window_row(j, k);
			uint64_t cells = rows->active[r], ends = rows->ends[r];
			if (cells | ends)
				digest_word(&digest,
				            (uint64_t)r << 40 | cells >> (WINDOW_LOW - 1) << 20 | ends >> WINDOW_LOW);
		}
	return digest;
}

void cubes_gather(const struct grid *grid, struct patch_key key, struct window *ret)
{
	assert(grid && ret);
	const struct block *blocks[BLOCKS];
	struct rows rows;
	ret->key = key;
	ret->empty = true;
	grid_find_box(grid, (struct block_key){key.x * 2 - 1, key.y * 2 - 1, key.z * 2 - 1}, blocks);
	if (!may_have_cells(blocks))
		return;
	copy_blocks(blocks, &rows);
	if (!both_signs(&rows))
		return;
	for (int r = window_row(-1, -1); r <= window_row(PATCH_SIDE + 1, PATCH_SIDE + 1); r += 4)
		fill_rows(&rows, r);
	for (int r = window_row(-1, -1); r <= window_row(PATCH_SIDE, PATCH_SIDE); r += 4)
		find_active(&rows, r);
	if (!own_cells(&rows))
		return;
	ret->empty = false;
	drop_far_cells(&rows);
	cross_edges(&rows);
	fetch_values(blocks, &rows);
	memcpy(ret->active, rows.active, sizeof ret->active);
	memcpy(ret->inside, rows.inside_after, sizeof ret->inside);
	ret->digest = digest_rows(&rows);
	copy_values(blocks, &rows, ret);
}

/* Extraction. */
#define CORNERS      (PATCH_SIDE + 1)
#define VERTEX_NAMES (CORNERS * CORNERS * CORNERS * 3)
#define ROW_NAMES    (CORNERS * 3)

static_assert(VERTEX_NAMES < UINT16_MAX, "a vertex index of a raw patch fits 16 bits");

struct extraction {
	const struct window *window;
	uint16_t *index; /* [VERTEX_NAMES] vertex of a name + 1, or 0: none so far; rows without cells are not set */
};

static uint32_t own_active(const struct window *window, int j, int k)
{
	return (window->active[window_row(j, k)] & CELLS_OWN) >> WINDOW_LOW;
}

static uint32_t count_cells(const struct window *window)
{
	uint32_t n = 0;
	for (int k = 0; k < PATCH_SIDE; k++)
		for (int j = 0; j < PATCH_SIDE; j++)
			n += (uint32_t)__builtin_popcount(own_active(window, j, k));
	return n;
}

/* No vertex has a name yet: of each layer from the first row that a cell will look at to the last. */
static void forget_names(const struct window *window, uint16_t *index)
{
	for (int k = 0; k <= PATCH_SIDE; k++) {
		int first = PATCH_SIDE + 1, end = 0;
		for (int j = 0; j <= PATCH_SIDE; j++) {
			const uint32_t *active = &window->active[window_row(j, k)];
			if (active[0] | active[-1] | active[-WINDOW_SIDE] | active[-WINDOW_SIDE - 1]) {
				first = j < first ? j : first;
				end = j + 1;
			}
		}
		if (end > first)
			memset(&index[vertex_name(0, first, k, 0)], 0,
			       (size_t)(end - first) * ROW_NAMES * sizeof *index);
	}
}

/* Edge e of a cube: the lower corner's offset and the axis (cubes_table.c). */
static const uint8_t edge_corner[12][3] = {{0, 0, 0}, {0, 1, 0}, {0, 0, 1}, {0, 1, 1}, {0, 0, 0}, {1, 0, 0},
                                           {0, 0, 1}, {1, 0, 1}, {0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {1, 1, 0}};

/* The name of edge e less that of the cell's own corner. */
#define NAME(i, j, k, axis) ((((k)*CORNERS + (j)) * CORNERS + (i)) * 3 + (axis))
static const uint16_t edge_name[12] = {NAME(0, 0, 0, 0), NAME(0, 1, 0, 0), NAME(0, 0, 1, 0), NAME(0, 1, 1, 0),
                                       NAME(0, 0, 0, 1), NAME(1, 0, 0, 1), NAME(0, 0, 1, 1), NAME(1, 0, 1, 1),
                                       NAME(0, 0, 0, 2), NAME(1, 0, 0, 2), NAME(0, 1, 0, 2), NAME(1, 1, 0, 2)};

static uint32_t make_vertex(struct extraction *x, struct surface *surface, const int cell[3], int e, uint32_t name)
{
	static const int step[3] = {1, WINDOW_SIDE, WINDOW_SIDE * WINDOW_SIDE};
	const int at[3] = {cell[0] + edge_corner[e][0], cell[1] + edge_corner[e][1], cell[2] + edge_corner[e][2]};
	const int axis = e >> 2;
	const int16_t *value = &x->window->value[window_at(at[0], at[1], at[2])];
	uint32_t v = surface->nv++;
	for (int a = 0; a < 3; a++)
		surface->vertex[v][a] = (uint16_t)(at[a] * LATTICE);
	surface->vertex[v][axis] += (uint16_t)cubes_edge_parameter(value[0], value[step[axis]]);
	surface->name[v] = name;
	x->index[name] = (uint16_t)(v + 1);
	return v;
}

static void extract_cell(struct extraction *x, struct surface *surface, const int cell[3], uint8_t code)
{
	const int8_t *edge = cubes_triangles[code];
	const uint32_t own = vertex_name(cell[0], cell[1], cell[2], 0);
	for (; *edge >= 0; edge += 3, surface->nt++)
		for (int c = 0; c < 3; c++) {
			uint32_t name = own + edge_name[edge[c]], v = x->index[name];
			surface->triangle[surface->nt][c] = v ? v - 1 : make_vertex(x, surface, cell, edge[c], name);
		}
}

static void extract_row(struct extraction *x, struct surface *surface, int j, int k)
{
	const uint32_t *in = &x->window->inside[window_row(j, k)];
	const uint32_t rows[4] = {in[0], in[1], in[WINDOW_SIDE], in[WINDOW_SIDE + 1]};
	for (uint32_t active = own_active(x->window, j, k); active; active &= active - 1) {
		int i = __builtin_ctz(active), b = i + WINDOW_LOW;
		uint8_t code = (uint8_t)((rows[0] >> b & 3) | (rows[1] >> b & 3) << 2 | (rows[2] >> b & 3) << 4 |
		                         (rows[3] >> b & 3) << 6);
		extract_cell(x, surface, (const int[3]){i, j, k}, code);
	}
}

/* Memory for the most that so many cells give: no case has more than five triangles, and a vertex is a crossed edge. */
static int reserve(struct extraction *x, uint32_t cells, struct arena *arena, struct surface *ret)
{
	const uint32_t vertices = cells * 12 < VERTEX_NAMES ? cells * 12 : VERTEX_NAMES;
	*ret = (struct surface){0};
	ret->vertex = arena_take(arena, vertices, sizeof *ret->vertex);
	ret->name = ARENA_TAKE(arena, uint32_t, vertices);
	ret->triangle = arena_take(arena, cells * 5, sizeof *ret->triangle);
	x->index = ARENA_TAKE(arena, uint16_t, VERTEX_NAMES);
	if (!ret->vertex || !ret->name || !ret->triangle || !x->index)
		return -ENOMEM;
	return 0;
}

/* Cells in canonical order: z, then y, then x. */
int cubes_extract(const struct window *window, struct arena *arena, struct surface *ret)
{
	assert(window && arena && ret);
	struct extraction x = {.window = window};
	struct surface surface = {0};
	if (window->empty) {
		*ret = surface;
		return 0;
	}
	int r = reserve(&x, count_cells(window), arena, &surface);
	if (r)
		return r;
	forget_names(window, x.index);
	for (int k = 0; k < PATCH_SIDE; k++)
		for (int j = 0; j < PATCH_SIDE; j++)
			extract_row(&x, &surface, j, k);
	*ret = surface;
	return 0;
}

/* Marching cubes on one patch: gather, fill, extract.
 *
 * What costs is not the cells but getting at them: 21^3 values lie in up to 64 blocks. So a block is looked up once
 * and its part copied row by row, and everything that asks for signs or completeness works on rows of bits, one bit a
 * corner, 21 corners a row. An empty cell then costs a fraction of an instruction, and only the cells that hold
 * surface are ever visited one by one.
 *
 * Filling closes the slit along concave and convex edges, where the corner behind both surfaces was never seen. It
 * reads unfilled values only, so one pass gives the same whatever the order. A filled corner is given its value only
 * where a cell with a surface reads it: elsewhere (the outer rim of every known band) it would change nothing and cost
 * more than all the rest.
 *
 * A vertex lies on the edge from a voxel along an axis, at |a| / (|a| + |b|) of it in 1/256, halves rounded away from
 * the voxel, clamped to [4, 252]: integers only, and no two vertices of a cell ever coincide. It depends on these two
 * values alone, so the neighbouring patch computes the same point. */
#include "core/cubes.h"

#include <assert.h>
#include <errno.h>
#include <string.h>

#define ROWS (WINDOW_SIDE * WINDOW_SIDE)

/* Bits of a row: corner i is bit i + WINDOW_LOW. */
#define CORNERS_FILLED (((1u << (PATCH_SIDE + 3)) - 1) << (WINDOW_LOW - 1)) /* -1 .. 17 */
#define CELLS_HALO     (((1u << (PATCH_SIDE + 2)) - 1) << (WINDOW_LOW - 1)) /* -1 .. 16 */

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "four values are judged in one little-endian word");

/* Rows are judged four at a time. */
typedef uint32_t rows4 __attribute__((vector_size(16)));
#define ROWS_PADDED (ROWS + 4)

/* Known and inside bits of the rows of a window, before and after the fill. Rows of corners outside -1 .. 17 hold
 * nothing of meaning in the last five. */
struct rows {
	uint32_t known[ROWS_PADDED], inside[ROWS_PADDED];
	uint32_t filled[ROWS_PADDED]; /* corners the fill makes known */
	uint32_t known_after[ROWS_PADDED], inside_after[ROWS_PADDED];
	uint32_t active[ROWS_PADDED]; /* cells with a surface */
	uint32_t needed[ROWS_PADDED]; /* corners of cells with a surface */
};

static int row_at(int j, int k)
{
	return (k + WINDOW_LOW) * WINDOW_SIDE + j + WINDOW_LOW;
}

/* The published values of four voxels in one word. */
static inline uint64_t pack4(const struct voxel *v)
{
	return (uint64_t)(uint16_t)v[0].published | (uint64_t)(uint16_t)v[1].published << 16 |
	       (uint64_t)(uint16_t)v[2].published << 32 | (uint64_t)(uint16_t)v[3].published << 48;
}

/* The upper bits of the eight quarters of two words, as bits 0 .. 7. The factor moves bit 16 m (and 16 m + 4, which the
 * second word is shifted to) to 48 + m (52 + m); no other product reaches bit 48 without leaving the word. */
static inline uint32_t top_bits(uint64_t low, uint64_t high)
{
	const uint64_t each = 0x0001000100010001ull;
	return ((low >> 15 & each) | (high >> 11 & each << 4)) * 0x0001000200040008ull >> 48 & 0xff;
}

/* The upper bit of every quarter that is not zero. */
static inline uint64_t not_zero(uint64_t word)
{
	const uint64_t low = 0x7fff7fff7fff7fffull;
	return ((word & low) + low) | word;
}

/* How the layers of block `b` (-1 .. 2 from the patch's own first) lie in the window along one axis. */
static void block_layers(int b, int *ret_first, int *ret_count, int *ret_place)
{
	*ret_first = b < 0 ? BLOCK_SIDE - WINDOW_LOW : 0;
	*ret_count = b < 0 ? WINDOW_LOW : b < 2 ? BLOCK_SIDE : WINDOW_SIDE - WINDOW_LOW - PATCH_SIDE;
	*ret_place = b < 0 ? 0 : WINDOW_LOW + b * BLOCK_SIDE;
}

/* Eight voxels to eight values and their bits. */
static inline void copy_eight(const struct voxel *from, int16_t *to, uint32_t *ret_known, uint32_t *ret_inside)
{
	const uint64_t unknown = 0x8000800080008000ull;
	uint64_t words[2] = {pack4(from), pack4(from + 4)};
	memcpy(to, words, sizeof words);
	*ret_known = top_bits(not_zero(words[0] ^ unknown), not_zero(words[1] ^ unknown));
	*ret_inside = top_bits(words[0], words[1]) & *ret_known;
}

static inline void copy_few(const struct voxel *from, int n, int16_t *to, uint32_t *ret_known, uint32_t *ret_inside)
{
	*ret_known = *ret_inside = 0;
	for (int x = 0; x < n; x++) {
		int16_t value = to[x] = from[x].published;
		*ret_known |= (uint32_t)(value != VOXEL_UNKNOWN) << x;
		*ret_inside |= (uint32_t)(value != VOXEL_UNKNOWN && value < 0) << x;
	}
}

static void copy_block(const struct block *block, const int at[3], int16_t *value, struct rows *rows)
{
	int first[3], count[3], place[3];
	for (int axis = 0; axis < 3; axis++)
		block_layers(at[axis], &first[axis], &count[axis], &place[axis]);
	for (int z = 0; z < count[2]; z++)
		for (int y = 0; y < count[1]; y++) {
			const struct voxel *from =
			    &block->voxel[((z + first[2]) * BLOCK_SIDE + y + first[1]) * BLOCK_SIDE + first[0]];
			int row = (z + place[2]) * WINDOW_SIDE + y + place[1];
			int16_t *to = &value[row * WINDOW_SIDE + place[0]];
			uint32_t known, inside;
			if (count[0] == BLOCK_SIDE)
				copy_eight(from, to, &known, &inside);
			else
				copy_few(from, count[0], to, &known, &inside);
			rows->known[row] |= known << place[0];
			rows->inside[row] |= inside << place[0];
		}
}

/* All unknown: from one value by doubling, at the speed of memcpy. */
static void forget_values(int16_t *value)
{
	size_t n = 1;
	value[0] = VOXEL_UNKNOWN;
	for (; n * 2 <= WINDOW_VOXELS; n *= 2)
		memcpy(value + n, value, n * sizeof *value);
	memcpy(value + n, value, (WINDOW_VOXELS - n) * sizeof *value);
}

#define BLOCKS_A_SIDE 4

/* Block (x, y, z) of the 4^3 that a window reads; the patch's own are 1 and 2 on each axis. */
static int block_at(int x, int y, int z)
{
	return (z * BLOCKS_A_SIDE + y) * BLOCKS_A_SIDE + x;
}

static bool own_block(int b)
{
	return b == 1 || b == 2;
}

/* Looks the blocks up that share a face with the patch or belong to it, or all others. The bits of *ret_axes: 1, 2, 4 a
 * neighbour exists along x, y, z; 8 one of the patch's own. */
static void find_blocks(const struct grid *grid, struct patch_key key, bool others, const struct block **ret_blocks,
                        int *ret_axes)
{
	for (int z = 0; z < BLOCKS_A_SIDE; z++)
		for (int y = 0; y < BLOCKS_A_SIDE; y++)
			for (int x = 0; x < BLOCKS_A_SIDE; x++) {
				int outside = !own_block(x) + 2 * !own_block(y) + 4 * !own_block(z);
				bool near = outside == 0 || (outside & (outside - 1)) == 0;
				struct block_key name = {key.x * 2 + x - 1, key.y * 2 + y - 1, key.z * 2 + z - 1};
				if (near == others)
					continue;
				ret_blocks[block_at(x, y, z)] = grid_find(grid, name);
				if (near && ret_blocks[block_at(x, y, z)])
					*ret_axes |= outside ? outside : 8;
			}
}

/* A cell of the patch has a corner in one of the patch's own blocks. Where there is none of them, that corner must be a
 * filled one, so there are neighbours on two axes: most of the patches around a surface are told apart by this alone. */
static bool may_have_cells(int axes)
{
	return axes >= 8 || (axes & (axes - 1)) != 0;
}

/* False where no cell of the patch can be complete; then nothing was copied. */
static bool copy_blocks(const struct grid *grid, struct patch_key key, int16_t *value, struct rows *rows)
{
	const struct block *blocks[BLOCKS_A_SIDE * BLOCKS_A_SIDE * BLOCKS_A_SIDE];
	int axes = 0, at[3];
	find_blocks(grid, key, false, blocks, &axes);
	if (!may_have_cells(axes))
		return false;
	find_blocks(grid, key, true, blocks, &axes);
	forget_values(value);
	memset(rows->known, 0, sizeof rows->known);
	memset(rows->inside, 0, sizeof rows->inside);
	for (at[2] = -1; at[2] < 3; at[2]++)
		for (at[1] = -1; at[1] < 3; at[1]++)
			for (at[0] = -1; at[0] < 3; at[0]++) {
				const struct block *block = blocks[block_at(at[0] + 1, at[1] + 1, at[2] + 1)];
				if (block)
					copy_block(block, at, value, rows);
			}
	return true;
}

/* Whether both signs occur. */
static bool both_signs(const struct rows *rows)
{
	uint32_t inside = 0, outside = 0;
	for (int r = 0; r < ROWS; r++) {
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

/* Finds the filled corners, the cells with a surface and the corners these need. */
static void find_cells(struct rows *rows)
{
	for (int r = row_at(-1, -1); r <= row_at(PATCH_SIDE + 1, PATCH_SIDE + 1); r += 4)
		fill_rows(rows, r);
	for (int r = row_at(-1, -1); r <= row_at(PATCH_SIDE, PATCH_SIDE); r += 4)
		find_active(rows, r);
	memset(rows->needed, 0, sizeof rows->needed);
	for (int k = -1; k <= PATCH_SIDE; k++)
		for (int j = -1; j <= PATCH_SIDE; j++) {
			int r = row_at(j, k);
			uint32_t corners = rows->active[r] | rows->active[r] << 1;
			if (!corners)
				continue;
			rows->needed[r] |= corners;
			rows->needed[r + 1] |= corners;
			rows->needed[r + WINDOW_SIDE] |= corners;
			rows->needed[r + WINDOW_SIDE + 1] |= corners;
		}
}

/* Hands the patch's own cells with a surface, and the corners around them, to the extraction; false where there are none. */
static bool keep_cells(const struct rows *rows, struct window *window)
{
	uint32_t any = 0;
	for (int k = 0; k < PATCH_SIDE; k++)
		for (int j = 0; j < PATCH_SIDE; j++) {
			uint32_t own = rows->active[row_at(j, k)] >> WINDOW_LOW & ((1u << PATCH_SIDE) - 1);
			window->active[k * PATCH_SIDE + j] = (uint16_t)own;
			any |= own;
		}
	memcpy(window->inside, rows->inside_after, sizeof window->inside);
	return any;
}

/* The known neighbour of largest magnitude; all have one sign, so equal magnitudes are equal values. */
static int16_t strongest_neighbour(const int16_t *value, const struct rows *rows, int r, int b)
{
	static const int step_row[6] = {0, 0, -1, 1, -WINDOW_SIDE, WINDOW_SIDE}, step_bit[6] = {-1, 1, 0, 0, 0, 0};
	int16_t best = 0;
	for (int s = 0; s < 6; s++) {
		int row = r + step_row[s], bit = b + step_bit[s];
		if (!(rows->known[row] >> bit & 1))
			continue;
		int16_t v = value[row * WINDOW_SIDE + bit];
		if (v < 0 ? v < best : v > best)
			best = v;
	}
	return best;
}

static void fill_values(const struct rows *rows, int16_t *value)
{
	for (int k = -1; k <= PATCH_SIDE + 1; k++)
		for (int j = -1; j <= PATCH_SIDE + 1; j++) {
			int r = row_at(j, k);
			for (uint32_t bits = rows->filled[r] & rows->needed[r]; bits; bits &= bits - 1) {
				int b = __builtin_ctz(bits);
				value[r * WINDOW_SIDE + b] = strongest_neighbour(value, rows, r, b);
			}
		}
}

void cubes_gather(const struct grid *grid, struct patch_key key, struct window *ret)
{
	assert(grid && ret);
	ret->key = key;
	ret->empty = true;
	struct rows rows;
	if (!copy_blocks(grid, key, ret->value, &rows))
		return;
	if (!both_signs(&rows))
		return;
	find_cells(&rows);
	ret->empty = !keep_cells(&rows, ret);
	if (!ret->empty)
		fill_values(&rows, ret->value);
}

bool window_cell_complete(const struct window *window, int i, int j, int k)
{
	assert(i >= -1 && i <= PATCH_SIDE && j >= -1 && j <= PATCH_SIDE && k >= -1 && k <= PATCH_SIDE);
	const int16_t *low = &window->value[window_at(i, j, k)], *high = low + WINDOW_SIDE * WINDOW_SIDE;
	return low[0] != VOXEL_UNKNOWN && low[1] != VOXEL_UNKNOWN && low[WINDOW_SIDE] != VOXEL_UNKNOWN &&
	       low[WINDOW_SIDE + 1] != VOXEL_UNKNOWN && high[0] != VOXEL_UNKNOWN && high[1] != VOXEL_UNKNOWN &&
	       high[WINDOW_SIDE] != VOXEL_UNKNOWN && high[WINDOW_SIDE + 1] != VOXEL_UNKNOWN;
}

/* Extraction. */
#define CORNERS      (PATCH_SIDE + 1)
#define VERTEX_NAMES (CORNERS * CORNERS * CORNERS * 3)

static_assert(VERTEX_NAMES < UINT16_MAX, "a vertex index of a raw patch fits 16 bits");

struct active_cell {
	uint8_t i, j, k, code;
};

struct extraction {
	const struct window *window;
	struct active_cell *cell;
	uint32_t cells, triangles;
	uint16_t *index; /* [VERTEX_NAMES] vertex of a name + 1, or 0: none so far */
};

static uint8_t case_triangles(uint8_t code)
{
	uint8_t n = 0;
	while (n < 15 && cubes_triangles[code][n] >= 0)
		n += 3;
	return n / 3;
}

/* Lists the cells with a surface in canonical order (z, then y, then x). */
static void list_cells(struct extraction *x)
{
	for (int k = 0; k < PATCH_SIDE; k++)
		for (int j = 0; j < PATCH_SIDE; j++) {
			const uint32_t *in = &x->window->inside[row_at(j, k)];
			const uint32_t rows[4] = {in[0], in[1], in[WINDOW_SIDE], in[WINDOW_SIDE + 1]};
			for (uint32_t active = x->window->active[k * PATCH_SIDE + j]; active; active &= active - 1) {
				int i = __builtin_ctz(active), b = i + WINDOW_LOW;
				uint8_t code = (uint8_t)((rows[0] >> b & 3) | (rows[1] >> b & 3) << 2 |
				                         (rows[2] >> b & 3) << 4 | (rows[3] >> b & 3) << 6);
				x->cell[x->cells++] = (struct active_cell){(uint8_t)i, (uint8_t)j, (uint8_t)k, code};
				x->triangles += case_triangles(code);
			}
		}
}

/* Edge e of a cube: the lower corner's offset and the axis (cubes_table.c). */
static const uint8_t edge_corner[12][3] = {{0, 0, 0}, {0, 1, 0}, {0, 0, 1}, {0, 1, 1}, {0, 0, 0}, {1, 0, 0},
                                           {0, 0, 1}, {1, 0, 1}, {0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {1, 1, 0}};

static uint32_t make_vertex(struct extraction *x, struct surface *surface, const int at[3], int axis, uint32_t name)
{
	static const int step[3] = {1, WINDOW_SIDE, WINDOW_SIDE * WINDOW_SIDE};
	const int16_t *value = &x->window->value[window_at(at[0], at[1], at[2])];
	uint32_t v = surface->nv++;
	for (int a = 0; a < 3; a++)
		surface->vertex[v][a] = (uint16_t)(at[a] * LATTICE);
	surface->vertex[v][axis] += (uint16_t)cubes_edge_parameter(value[0], value[step[axis]]);
	surface->name[v] = name;
	x->index[name] = (uint16_t)(v + 1);
	return v;
}

static void extract_cell(struct extraction *x, struct surface *surface, struct active_cell cell)
{
	const int8_t *edge = cubes_triangles[cell.code];
	for (; *edge >= 0; edge += 3, surface->nt++)
		for (int c = 0; c < 3; c++) {
			int e = edge[c], axis = e >> 2;
			int at[3] = {cell.i + edge_corner[e][0], cell.j + edge_corner[e][1],
			             cell.k + edge_corner[e][2]};
			uint32_t name = vertex_name(at[0], at[1], at[2], axis);
			uint32_t v = x->index[name];
			surface->triangle[surface->nt][c] = v ? v - 1 : make_vertex(x, surface, at, axis, name);
		}
}

/* Memory for what the listed cells give: a triangle makes at most three vertices. */
static int reserve(struct extraction *x, struct arena *arena, struct surface *ret)
{
	uint32_t vertices = x->triangles * 3 < VERTEX_NAMES ? x->triangles * 3 : VERTEX_NAMES;
	*ret = (struct surface){0};
	ret->vertex = arena_alloc(arena, vertices, sizeof *ret->vertex);
	ret->name = ARENA_NEW(arena, uint32_t, vertices);
	ret->triangle = arena_alloc(arena, x->triangles, sizeof *ret->triangle);
	x->index = ARENA_NEW(arena, uint16_t, VERTEX_NAMES);
	if (!ret->vertex || !ret->name || !ret->triangle || !x->index)
		return -ENOMEM;
	return 0;
}

int cubes_extract(const struct window *window, struct arena *arena, struct surface *ret)
{
	assert(window && arena && ret);
	struct extraction x = {.window = window};
	struct surface surface = {0};
	if (!window->empty) {
		x.cell = ARENA_NEW(arena, struct active_cell, PATCH_SIDE * PATCH_SIDE * PATCH_SIDE);
		if (!x.cell)
			return -ENOMEM;
		list_cells(&x);
	}
	if (x.cells) {
		int r = reserve(&x, arena, &surface);
		if (r)
			return r;
	}
	for (uint32_t c = 0; c < x.cells; c++)
		extract_cell(&x, &surface, x.cell[c]);
	*ret = surface;
	return 0;
}

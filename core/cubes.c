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
#define CELLS_OWN      (((1u << PATCH_SIDE) - 1) << WINDOW_LOW)             /* 0 .. 15 */

static_assert(sizeof(struct voxel) == 8, "a voxel is read as one word, its published value in the upper quarter");
static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "four values are judged in one little-endian word");

/* Known and inside bits of the rows of a window, before and after the fill. */
struct rows {
	uint32_t known[ROWS], inside[ROWS];
	uint32_t filled[ROWS]; /* corners the fill makes known */
	uint32_t needed[ROWS]; /* corners of cells with a surface */
	uint32_t known_after[ROWS], inside_after[ROWS];
};

static int row_at(int j, int k)
{
	return (k + WINDOW_LOW) * WINDOW_SIDE + j + WINDOW_LOW;
}

static uint64_t load64(const void *from)
{
	uint64_t word;
	memcpy(&word, from, sizeof word);
	return word;
}

/* The published values of four voxels in one word. */
static uint64_t pack4(const struct voxel *v)
{
	const uint64_t top = 0xffffull << 48;
	return load64(&v[0]) >> 48 | (load64(&v[1]) & top) >> 32 | (load64(&v[2]) & top) >> 16 | (load64(&v[3]) & top);
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

/* `n` values from `value` on: bit b of the results belongs to value b. */
static inline void judge_row(const int16_t *value, int n, uint32_t *ret_known, uint32_t *ret_inside)
{
	const uint64_t unknown = 0x8000800080008000ull;
	uint32_t known = 0, negative = 0;
	int b = 0;
	for (; b + 8 <= n; b += 8) {
		uint64_t low = load64(value + b), high = load64(value + b + 4);
		known |= top_bits(not_zero(low ^ unknown), not_zero(high ^ unknown)) << b;
		negative |= top_bits(low, high) << b;
	}
	for (; b + 4 <= n; b += 4) {
		uint64_t low = load64(value + b);
		known |= top_bits(not_zero(low ^ unknown), 0) << b;
		negative |= top_bits(low, 0) << b;
	}
	for (; b < n; b++) {
		known |= (uint32_t)(value[b] != VOXEL_UNKNOWN) << b;
		negative |= (uint32_t)(value[b] < 0) << b;
	}
	*ret_known = known;
	*ret_inside = negative & known;
}

/* How the layers of block `b` (-1 .. 2 from the patch's own first) lie in the window along one axis. */
static void block_layers(int b, int *ret_first, int *ret_count, int *ret_place)
{
	*ret_first = b < 0 ? BLOCK_SIDE - WINDOW_LOW : 0;
	*ret_count = b < 0 ? WINDOW_LOW : b < 2 ? BLOCK_SIDE : WINDOW_SIDE - WINDOW_LOW - PATCH_SIDE;
	*ret_place = b < 0 ? 0 : WINDOW_LOW + b * BLOCK_SIDE;
}

static void copy_block(const struct block *block, const int at[3], int16_t *value)
{
	int first[3], count[3], place[3];
	for (int axis = 0; axis < 3; axis++)
		block_layers(at[axis], &first[axis], &count[axis], &place[axis]);
	for (int z = 0; z < count[2]; z++)
		for (int y = 0; y < count[1]; y++) {
			const struct voxel *from =
			    &block->voxel[((z + first[2]) * BLOCK_SIDE + y + first[1]) * BLOCK_SIDE + first[0]];
			int16_t *to = &value[((z + place[2]) * WINDOW_SIDE + y + place[1]) * WINDOW_SIDE + place[0]];
			if (count[0] == BLOCK_SIDE) {
				uint64_t words[2] = {pack4(from), pack4(from + 4)};
				memcpy(to, words, sizeof words);
			} else {
				for (int x = 0; x < count[0]; x++)
					to[x] = from[x].published;
			}
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
static bool copy_blocks(const struct grid *grid, struct patch_key key, int16_t *value)
{
	const struct block *blocks[BLOCKS_A_SIDE * BLOCKS_A_SIDE * BLOCKS_A_SIDE];
	int axes = 0, at[3];
	find_blocks(grid, key, false, blocks, &axes);
	if (!may_have_cells(axes))
		return false;
	find_blocks(grid, key, true, blocks, &axes);
	forget_values(value);
	for (at[2] = -1; at[2] < 3; at[2]++)
		for (at[1] = -1; at[1] < 3; at[1]++)
			for (at[0] = -1; at[0] < 3; at[0]++) {
				const struct block *block = blocks[block_at(at[0] + 1, at[1] + 1, at[2] + 1)];
				if (block)
					copy_block(block, at, value);
			}
	return true;
}

/* Whether both signs occur. */
static bool judge_window(const int16_t *value, struct rows *rows)
{
	uint32_t inside = 0, outside = 0;
	for (int r = 0; r < ROWS; r++) {
		judge_row(value + r * WINDOW_SIDE, WINDOW_SIDE, &rows->known[r], &rows->inside[r]);
		inside |= rows->inside[r];
		outside |= rows->known[r] & ~rows->inside[r];
	}
	return inside && outside;
}

/* The corners of one row that the fill makes known, and which of them inside. */
static void fill_row(const uint32_t *known, const uint32_t *inside, uint32_t *ret_filled, uint32_t *ret_inside)
{
	const int y = 1, z = WINDOW_SIDE;
	uint32_t along[3] = {known[0] << 1 | known[0] >> 1, known[-y] | known[y], known[-z] | known[z]};
	uint32_t two = (along[0] & along[1]) | (along[0] & along[2]) | (along[1] & along[2]);
	uint32_t candidates = two & ~known[0] & CORNERS_FILLED;
	*ret_filled = *ret_inside = 0;
	if (!candidates)
		return;
	uint32_t own = known[0] & ~inside[0];
	uint32_t negative = inside[0] << 1 | inside[0] >> 1 | inside[-y] | inside[y] | inside[-z] | inside[z];
	uint32_t positive = own << 1 | own >> 1 | (known[-y] & ~inside[-y]) | (known[y] & ~inside[y]) |
	                    (known[-z] & ~inside[-z]) | (known[z] & ~inside[z]);
	*ret_filled = candidates & (negative ^ positive);
	*ret_inside = *ret_filled & negative;
}

/* Cells of a row with a surface: complete, of both signs. The rows are those of the corners after the fill. */
static inline uint32_t active_cells(const uint32_t *known, const uint32_t *inside, int y, int z)
{
	uint32_t all = known[0] & known[y] & known[z] & known[y + z];
	uint32_t any = inside[0] | inside[y] | inside[z] | inside[y + z];
	uint32_t every = inside[0] & inside[y] & inside[z] & inside[y + z];
	return all & all >> 1 & (any | any >> 1) & ~(every & every >> 1);
}

/* Finds the filled corners and those that cells with a surface need; true when a cell of the patch itself has one. */
static bool find_filled(struct rows *rows)
{
	bool own = false;
	for (int k = -1; k <= PATCH_SIDE + 1; k++)
		for (int j = -1; j <= PATCH_SIDE + 1; j++) {
			int r = row_at(j, k);
			uint32_t inside;
			fill_row(&rows->known[r], &rows->inside[r], &rows->filled[r], &inside);
			rows->known_after[r] = rows->known[r] | rows->filled[r];
			rows->inside_after[r] = rows->inside[r] | inside;
			rows->needed[r] = 0;
		}
	for (int k = -1; k <= PATCH_SIDE; k++)
		for (int j = -1; j <= PATCH_SIDE; j++) {
			int r = row_at(j, k);
			uint32_t active =
			    CELLS_HALO & active_cells(&rows->known_after[r], &rows->inside_after[r], 1, WINDOW_SIDE);
			if (!active)
				continue;
			uint32_t corners = active | active << 1;
			rows->needed[r] |= corners;
			rows->needed[r + 1] |= corners;
			rows->needed[r + WINDOW_SIDE] |= corners;
			rows->needed[r + WINDOW_SIDE + 1] |= corners;
			if ((active & CELLS_OWN) && j >= 0 && k >= 0 && j < PATCH_SIDE && k < PATCH_SIDE)
				own = true;
		}
	return own;
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
	if (!copy_blocks(grid, key, ret->value))
		return;
	struct rows rows;
	if (!judge_window(ret->value, &rows))
		return;
	ret->empty = !find_filled(&rows);
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

/* Extraction. Rows of corners 0 .. 16 of the patch, bit i for corner i. */
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

static void sign_rows(const struct window *window, uint32_t *ret_known, uint32_t *ret_inside)
{
	for (int k = 0; k < CORNERS; k++)
		for (int j = 0; j < CORNERS; j++)
			judge_row(&window->value[window_at(0, j, k)], CORNERS, &ret_known[k * CORNERS + j],
			          &ret_inside[k * CORNERS + j]);
}

static uint8_t case_triangles(uint8_t code)
{
	uint8_t n = 0;
	while (n < 15 && cubes_triangles[code][n] >= 0)
		n += 3;
	return n / 3;
}

/* Lists the cells with a surface in canonical order (z, then y, then x). */
static void list_cells(struct extraction *x, const uint32_t *known, const uint32_t *inside)
{
	for (int k = 0; k < PATCH_SIDE; k++)
		for (int j = 0; j < PATCH_SIDE; j++) {
			const uint32_t *in = &inside[k * CORNERS + j];
			uint32_t active =
			    active_cells(&known[k * CORNERS + j], in, 1, CORNERS) & ((1u << PATCH_SIDE) - 1);
			for (; active; active &= active - 1) {
				int i = __builtin_ctz(active);
				uint8_t code = (uint8_t)((in[0] >> i & 3) | (in[1] >> i & 3) << 2 |
				                         (in[CORNERS] >> i & 3) << 4 | (in[CORNERS + 1] >> i & 3) << 6);
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
		uint32_t known[CORNERS * CORNERS], inside[CORNERS * CORNERS];
		sign_rows(window, known, inside);
		x.cell = ARENA_NEW(arena, struct active_cell, PATCH_SIDE * PATCH_SIDE * PATCH_SIDE);
		if (!x.cell)
			return -ENOMEM;
		list_cells(&x, known, inside);
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

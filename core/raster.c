/* Neighbours. Two beams are joined where they are no farther apart than a surface seen at a slant would leave them:
 * 0.085 of the range and a centimetre, and never 60 cm. Four joined edges make a quad, the small piece of surface that
 * a tilting scanner gives away for nothing. A quad seen flatter than 4 degrees says more about the range noise than
 * about the surface; its beams count as single points.
 *
 * Along with each line goes its row of the integral image of the points' moments. It is made of integers: exact, and
 * the same whatever the sweep's length. */
#include "core/raster.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

#define JOIN_SLOPE     0.085
#define JOIN_FLOOR_M   0.01
#define JOIN_MAX_M     0.6
#define FLAT_SINE2     0.004866 /* sin(4 degrees)^2 */
#define RUN_MAX        15
#define MARGIN         8          /* columns kept free on either side for rows that begin earlier or end later */
#define COLUMN_SLACK   (1.0 / 64) /* of a step: rounding of a bearing must not move its column */
#define MOMENT_UNITS_M 8000.0

void raster_init(struct raster *raster, double cell_m)
{
	*raster = (struct raster){.cell_m = cell_m};
}

static void lines_drop(struct raster *raster)
{
	for (int i = 0; i < RASTER_LINES; i++) {
		row_destroy(raster->line[i].row);
		raster->line[i].row = NULL;
	}
	raster->lines = 0;
}

void raster_finish(struct raster *raster)
{
	lines_drop(raster);
	free(raster->memory);
	raster_init(raster, raster->cell_m);
}

static uint32_t beams_of(const struct row *row)
{
	return row->n < RASTER_BEAMS_MAX ? row->n : RASTER_BEAMS_MAX;
}

/* floor(bearing / step) of beam 0; 0 where that means nothing. */
static double column_of(const struct row *row)
{
	double c = row->step_rad != 0 ? floor(row->first_rad / row->step_rad + COLUMN_SLACK) : 0;

	return fabs(c) < 1e9 ? c : 0; /* false for not-a-number too */
}

bool raster_accepts(const struct raster *raster, const struct row *row)
{
	double first = column_of(row) - raster->column0;

	return raster->width && fabs(row->step_rad - raster->step_rad) <= 1e-6 * fabs(raster->step_rad) && first >= 0 &&
	       first + beams_of(row) <= raster->width;
}

/* Cuts one piece of memory into the arrays of all lines, the widest elements first. */
static void lines_place(struct raster *raster, uint8_t *at, size_t width)
{
	raster->zero = (struct raster_sums *)at;
	at += (width + 1) * sizeof(struct raster_sums);
	for (int i = 0; i < RASTER_LINES; i++) {
		raster->line[i].sum = (struct raster_sums *)at;
		at += (width + 1) * sizeof(struct raster_sums);
	}
	for (int i = 0; i < RASTER_LINES; i++) {
		struct raster_line *line = &raster->line[i];

		line->point = (struct vec3 *)at;
		line->normal = (float(*)[3])(line->point + width);
		line->right_m2 = (float *)(line->normal + width);
		line->up_m2 = line->right_m2 + width;
		line->flags = (uint8_t *)(line->up_m2 + width);
		line->left = line->flags + width;
		line->right = line->left + width;
		line->up = line->right + width;
		at = line->up + width;
	}
}

int raster_begin(struct raster *raster, const struct row *row)
{
	size_t width = (beams_of(row) + 2 * MARGIN + 7) & ~(size_t)7; /* keeps every array aligned to 8 */
	size_t line = sizeof(struct vec3) + 5 * sizeof(float) + 4;

	lines_drop(raster);
	if ((int32_t)width > raster->width_cap) {
		size_t bytes =
		    (width + 1) * (RASTER_LINES + 1) * sizeof(struct raster_sums) + RASTER_LINES * width * line;
		void *memory = aligned_alloc(64, (bytes + 63) & ~(size_t)63);

		if (!memory)
			return -ENOMEM;
		free(raster->memory);
		raster->memory = memory;
		raster->width_cap = (int32_t)width;
	}
	raster->width = (int32_t)width;
	raster->step_rad = row->step_rad;
	raster->column0 = column_of(row) - MARGIN;
	lines_place(raster, raster->memory, width);
	memset(raster->zero, 0, (width + 1) * sizeof(struct raster_sums));
	return 0;
}

struct raster_line *raster_line(struct raster *raster, uint64_t number)
{
	return &raster->line[number % RASTER_LINES];
}

static void points_place(const struct raster *raster, struct raster_line *line)
{
	const struct row *row = line->row;
	double scale = 1 / raster->cell_m;

	memset(line->flags, 0, (size_t)raster->width);
	for (uint32_t k = 0; k < beams_of(row); k++) {
		const struct row_beam *beam = &row->beam[k];
		struct vec3 p = vec3_scale(beam->point, scale);
		int32_t c = line->first + (int32_t)k;

		if (beam->state != BEAM_OK || !raster_within_map(p) ||
		    !raster_within_map(vec3_scale(beam->origin, scale)))
			continue;
		line->point[c] = p;
		line->flags[c] = RASTER_POINT;
	}
}

/* Squared distance of two neighbours in m2 where they are joined, else -1. */
static float join(double cell_m, struct vec3 p, struct vec3 q, float range_p, float range_q)
{
	struct vec3 d = vec3_scale(vec3_sub(p, q), cell_m);
	double limit = JOIN_SLOPE * (double)(range_p < range_q ? range_p : range_q) + JOIN_FLOOR_M;
	double m2 = vec3_dot(d, d);

	return m2 < JOIN_MAX_M * JOIN_MAX_M && m2 <= limit * limit ? (float)m2 : -1.0f;
}

static void lines_join(const struct raster *raster, const struct raster_line *above, struct raster_line *line)
{
	int32_t end = line->first + (int32_t)beams_of(line->row);

	for (int32_t c = line->first; c < end; c++) {
		float range, m2;

		if (!line->flags[c])
			continue;
		range = raster_beam(line, c)->range_m;
		if (c + 1 < end && line->flags[c + 1]) {
			m2 = join(raster->cell_m, line->point[c], line->point[c + 1], range,
			          raster_beam(line, c + 1)->range_m);
			line->right_m2[c] = m2;
			line->flags[c] |= m2 >= 0 ? RASTER_RIGHT : 0;
		}
		if (above && above->flags[c] & RASTER_POINT) {
			m2 = join(raster->cell_m, line->point[c], above->point[c], range,
			          raster_beam(above, c)->range_m);
			line->up_m2[c] = m2;
			line->flags[c] |= m2 >= 0 ? RASTER_UP : 0;
		}
	}
}

static void runs_count(const struct raster *raster, const struct raster_line *above, struct raster_line *line)
{
	int run = 0;

	for (int32_t c = 0; c < raster->width; c++) {
		line->left[c] = (uint8_t)run;
		run = !(line->flags[c] & RASTER_RIGHT) ? 0 : run < RUN_MAX ? run + 1 : RUN_MAX;
	}
	run = 0;
	for (int32_t c = raster->width; c-- > 0;) {
		run = !(line->flags[c] & RASTER_RIGHT) ? 0 : run < RUN_MAX ? run + 1 : RUN_MAX;
		line->right[c] = (uint8_t)run;
	}
	for (int32_t c = 0; c < raster->width; c++) {
		run = line->flags[c] & RASTER_UP ? above->up[c] + 1 : 0;
		line->up[c] = (uint8_t)(run < RUN_MAX ? run : RUN_MAX);
	}
}

/* Four joined edges, and the plane through the diagonals not seen flatter than 4 degrees. */
static void quads_judge(const struct raster *raster, const struct raster_line *above, struct raster_line *line)
{
	for (int32_t c = 0; c + 1 < raster->width; c++) {
		if ((line->flags[c] & (RASTER_RIGHT | RASTER_UP)) != (RASTER_RIGHT | RASTER_UP) ||
		    !(line->flags[c + 1] & RASTER_UP) || !(above->flags[c] & RASTER_RIGHT))
			continue;
		struct vec3 a = vec3_sub(line->point[c + 1], above->point[c]);
		struct vec3 b = vec3_sub(line->point[c], above->point[c + 1]);
		struct vec3 n = vec3_cross(a, b);
		struct vec3 middle = vec3_scale(vec3_add(line->point[c + 1], above->point[c]), 0.5);
		struct vec3 view = vec3_sub(vec3_scale(raster_beam(line, c)->origin, 1 / raster->cell_m), middle);
		double along = vec3_dot(n, view);

		if (along * along > FLAT_SINE2 * vec3_dot(n, n) * vec3_dot(view, view))
			line->flags[c] |= RASTER_QUAD;
	}
}

static void sums_add(const struct raster *raster, const struct raster_sums *above, struct raster_line *line)
{
	double scale = raster->cell_m * MOMENT_UNITS_M;
	struct raster_sums run = {0};

	line->sum[0] = run;
	for (int32_t c = 0; c < raster->width; c++) {
		struct raster_sums *sum = &line->sum[c + 1];

		if (line->flags[c]) {
			uint32_t x = (uint32_t)(int64_t)(line->point[c].x * scale);
			uint32_t y = (uint32_t)(int64_t)(line->point[c].y * scale);
			uint32_t z = (uint32_t)(int64_t)(line->point[c].z * scale);
			uint64_t wx = (uint64_t)(int32_t)x, wy = (uint64_t)(int32_t)y, wz = (uint64_t)(int32_t)z;

			run.n++;
			run.s[0] += x;
			run.s[1] += y;
			run.s[2] += z;
			run.q[0] += wx * wx;
			run.q[1] += wx * wy;
			run.q[2] += wx * wz;
			run.q[3] += wy * wy;
			run.q[4] += wy * wz;
			run.q[5] += wz * wz;
		}
		sum->n = run.n + above[c + 1].n;
		for (int i = 0; i < 3; i++)
			sum->s[i] = run.s[i] + above[c + 1].s[i];
		for (int i = 0; i < 6; i++)
			sum->q[i] = run.q[i] + above[c + 1].q[i];
	}
}

void raster_push(struct raster *raster, struct row *row)
{
	struct raster_line *line = raster_line(raster, raster->lines);
	struct raster_line *above = raster->lines ? raster_line(raster, raster->lines - 1) : NULL;

	row_destroy(line->row);
	line->row = row;
	line->first = (int32_t)(column_of(row) - raster->column0);
	points_place(raster, line);
	lines_join(raster, above, line);
	runs_count(raster, above, line);
	if (above)
		quads_judge(raster, above, line);
	sums_add(raster, above ? above->sum : raster->zero, line);
	raster->lines++;
}

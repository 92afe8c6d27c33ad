/* uos / 3DTK scans: scanNNN.3d holds `x y z` a line in centimetres, LEFT-handed (x right, y up, z forward), origin at the
 * scanner; scanNNN.pose beside it `x y z` in centimetres and three Euler angles in degrees, R = Rx Ry Rz, in that frame.
 *
 *            bearing 0 along +x (right), to the left:   p = r (cos b, sin b sin t, sin b cos t),  t the servo's angle, up positive
 *   our frame (x forward, y left, z up) = (z, -x, y) / 100, tilt = -t (positive looks down), bearing = b - 90 degrees
 *
 * A scan of a tilted 2D scanner is a raster in file order, one profile after the other; knowing it is worth a lot, because
 * neighbours in the raster tell the surface between them. It is recovered rather than believed:
 *  - a new row begins where the bearing runs back;
 *  - its tilt is the direction of the sum of its points in the y-z plane, where every point of a row lies on one ray from the
 *    origin: far points weigh more, as their digits say more, and 360 roundings average out (to 1e-6 rad on real scans);
 *  - bearings are judged on a raster of 0.25 degree and the step is the coarsest of 1, 0.5, 0.25 that nearly all points fit.
 * Where points do not fit (another scanner, a filtered or registered cloud) the file is a cloud.
 *
 * Ranges are rounded to whole millimetres when nearly all of them are whole within what the file's digits can say. Old
 * converters wrote SICK's error codes as ranges (3276.7 cm is 0x7FFF, "no valid value"): they become beam states again.
 * Ranges below 0.30 m (the robot) or beyond 30 m keep their value and are marked out of range. */
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/model.h"
#include "core/text.h"
#include "core/trig.h"

#define COORDINATE_MAX_CM 1e7
#define RASTER_RAD        (0.25 * TRIG_DEG)
#define RASTER_COLUMNS    721               /* 0..180 degrees */
#define FIT_RAD           (0.06 * TRIG_DEG) /* how far a bearing may lie off the raster */
#define RUN_BACK_RAD      (0.1 * TRIG_DEG)  /* a bearing that falls by more begins a row */
#define FIT_SHARE         0.98              /* of the points must fit, or the file is a cloud */
#define FILL_SHARE        0.125             /* of the raster's cells must hold a point (bounds memory too) */
#define CODE_FIRST_MM     32759             /* 15-bit error codes: M - 8 .. M, M = 32767 */
#define CODE_LAST_MM      32767

struct points {
	size_t n, cap;
	struct vec3 *cm; /* as in the file */
	double *bearing; /* rad, 0..pi, from +x */
};

static int fail(struct parse_error *error, uint32_t line, const char *sentence)
{
	error->line = line;
	snprintf(error->text, sizeof error->text, "%s", sentence);
	return -EINVAL;
}

static int points_add(struct points *p, struct vec3 cm)
{
	if (p->n == p->cap) {
		size_t cap = p->cap ? p->cap * 2 : 4096;
		struct vec3 *grown = realloc(p->cm, cap * sizeof *grown);
		if (!grown)
			return -ENOMEM;
		p->cm = grown;
		p->cap = cap;
	}
	p->cm[p->n++] = cm;
	return 0;
}

static int read_points(struct text *t, struct points *p, struct parse_error *error)
{
	bool header = true;
	while (text_skip_empty(t)) {
		double v[3];
		int n = text_numbers(t, 3, v);
		if (n < 3 && !header)
			return fail(error, t->line, "expected x y z in centimetres; is this a uos .3d file?");
		header = false;
		if (n == 3) {
			for (int i = 0; i < 3; i++)
				if (!(fabs(v[i]) <= COORDINATE_MAX_CM))
					return fail(error, t->line, "a coordinate is no number or beyond 100 km");
			int r = points_add(p, (struct vec3){v[0], v[1], v[2]});
			if (r < 0)
				return r;
		}
		text_next_line(t);
	}
	return p->n ? 0 : fail(error, 0, "no points in it; is this a uos .3d file?");
}

static int find_bearings(struct points *p)
{
	p->bearing = malloc(p->n * sizeof *p->bearing);
	if (!p->bearing)
		return -ENOMEM;
	for (size_t i = 0; i < p->n; i++) {
		struct vec3 c = p->cm[i];
		bool at_origin =
		    vec3_dot(c, c) == 0 && i > 0; /* a reading that is missing: it has no bearing of its own */
		p->bearing[i] = at_origin ? p->bearing[i - 1] : trig_atan2(sqrt(c.y * c.y + c.z * c.z), c.x);
	}
	return 0;
}

/* +1 where bearings rise along a row, -1 where they fall. */
static int find_direction(const struct points *p)
{
	size_t up = 0, down = 0;
	for (size_t i = 1; i < p->n; i++) {
		up += p->bearing[i] > p->bearing[i - 1];
		down += p->bearing[i] < p->bearing[i - 1];
	}
	return up >= down ? 1 : -1;
}

static size_t row_end(const struct points *p, size_t begin, int direction)
{
	size_t i = begin + 1;
	while (i < p->n && direction * (p->bearing[i] - p->bearing[i - 1]) > -RUN_BACK_RAD)
		i++;
	return i;
}

struct raster {
	int direction;
	uint32_t rows;
	int step;        /* quarter degrees: 4, 2 or 1 */
	int first, last; /* columns of 0.25 degree */
};

static bool on_raster(double bearing, int *ret_column)
{
	double at = rint(bearing / RASTER_RAD);
	*ret_column = (int)at;
	return fabs(bearing - at * RASTER_RAD) <= FIT_RAD;
}

/* Sees whether the points are a raster, and which. */
static bool find_raster(const struct points *p, struct raster *ret)
{
	struct raster raster = {.direction = find_direction(p)};
	size_t columns[RASTER_COLUMNS + 1] = {0}, residue[4] = {0}, fit = 0;
	for (size_t i = 0; i < p->n; i++) {
		int column;
		if (on_raster(p->bearing[i], &column)) {
			columns[column]++;
			residue[column & 3]++;
			fit++;
		}
	}
	for (size_t i = 0; i < p->n; i = row_end(p, i, raster.direction))
		raster.rows++;
	double enough = FIT_SHARE * (double)p->n;
	if ((double)fit < enough || raster.rows < 2)
		return false;
	int phase = 0;
	for (int i = 1; i < 4; i++)
		phase = residue[i] > residue[phase] ? i : phase;
	raster.step = (double)residue[phase] >= enough                          ? 4
	              : (double)(residue[phase] + residue[phase ^ 2]) >= enough ? 2
	                                                                        : 1;
	raster.first = RASTER_COLUMNS;
	for (int i = 0; i < RASTER_COLUMNS; i++) {
		if (!columns[i] || (i - phase) % raster.step)
			continue;
		raster.first = i < raster.first ? i : raster.first;
		raster.last = i;
	}
	double cells = (double)raster.rows * ((raster.last - raster.first) / raster.step + 1);
	*ret = raster;
	return (double)p->n >= FILL_SHARE * cells;
}

/* Whole millimetres, as far as the file's digits (about six) can tell? */
static bool is_millimetres(const struct points *p)
{
	size_t whole = 0;
	for (size_t i = 0; i < p->n; i++) {
		double mm = vec3_norm(p->cm[i]) * 10;
		whole += fabs(mm - rint(mm)) <= 0.06 + 1e-5 * mm;
	}
	return (double)whole >= FIT_SHARE * (double)p->n;
}

static uint8_t code_state(double mm)
{
	switch ((int)mm) {
	case 32767:
		return BEAM_NO_ECHO;
	case 32766:
		return BEAM_DAZZLED;
	case 32765:
		return BEAM_OVERFLOW;
	case 32763:
		return BEAM_WEAK;
	case 32762:
		return BEAM_CHANNEL_ERROR;
	case 32759:
		return BEAM_BEYOND_MAX;
	default:
		return BEAM_RESERVED;
	}
}

static bool is_code(double mm)
{
	double whole = rint(mm);
	return whole >= CODE_FIRST_MM && whole <= CODE_LAST_MM && fabs(mm - whole) < 0.35;
}

/* Of the number as it stands in the file: 29.9999 cm is too short, though its millimetres round to 300. */
static bool in_range(double mm)
{
	return mm >= UOS_RANGE_MIN_M * 1000 && mm <= UOS_RANGE_MAX_M * 1000;
}

static void row_init(struct uos_row *row, const struct raster *raster)
{
	row->first_rad = raster->first * RASTER_RAD - TRIG_PI / 2;
	row->step_rad = raster->step * RASTER_RAD;
	row->n = (uint32_t)((raster->last - raster->first) / raster->step + 1);
	row->range_m = calloc(row->n, sizeof *row->range_m);
	row->state = malloc(row->n);
	if (row->state)
		memset(row->state, BEAM_NO_ECHO, row->n);
}

/* Places points [begin, end) into `row`; how many did not fit. */
static size_t fill_row(const struct points *p, size_t begin, size_t end, const struct raster *raster, bool millimetres,
                       struct uos_row *row)
{
	double up = 0, forward = 0;
	for (size_t i = begin; i < end; i++) {
		up += p->cm[i].y;
		forward += p->cm[i].z;
	}
	row->tilt_rad = -trig_atan2(up, forward);
	double s = trig_sin(-row->tilt_rad), c = trig_cos(-row->tilt_rad);
	size_t misfits = 0;
	for (size_t i = begin; i < end; i++) {
		double mm = vec3_norm(p->cm[i]) * 10;
		double off_cm = fabs(p->cm[i].y * c - p->cm[i].z * s);
		int column, cell;
		if (mm == 0)
			continue;
		bool fits = on_raster(p->bearing[i], &column) && (column - raster->first) % raster->step == 0 &&
		            off_cm <= 0.02 + 2e-4 * mm;
		cell = (column - raster->first) / raster->step;
		if (!fits || column < raster->first || column > raster->last || row->range_m[cell] > 0) {
			misfits++;
			continue;
		}
		row->range_m[cell] = (float)((millimetres ? rint(mm) : mm) / 1000);
		row->state[cell] = is_code(mm) ? code_state(rint(mm)) : in_range(mm) ? BEAM_OK : BEAM_OUT_OF_RANGE;
	}
	return misfits;
}

/* 0; -EAGAIN where too many points lie off their row: no raster after all. */
static int fill_raster(const struct points *p, const struct raster *raster, struct uos_scan *scan)
{
	bool millimetres = is_millimetres(p);
	size_t misfits = 0, end;
	scan->row = calloc(raster->rows, sizeof *scan->row);
	if (!scan->row)
		return -ENOMEM;
	for (size_t i = 0; i < p->n; i = end) {
		struct uos_row *row = &scan->row[scan->rows++];
		end = row_end(p, i, raster->direction);
		row_init(row, raster);
		if (!row->range_m || !row->state)
			return -ENOMEM;
		misfits += fill_row(p, i, end, raster, millimetres, row);
	}
	return (double)misfits > (1 - FIT_SHARE) * (double)p->n ? -EAGAIN : 0;
}

/* Error codes are no points here either. */
static int fill_cloud(const struct points *p, struct cloud *cloud)
{
	cloud->point = malloc(p->n * sizeof *cloud->point);
	if (!cloud->point)
		return -ENOMEM;
	for (size_t i = 0; i < p->n; i++) {
		struct vec3 c = p->cm[i];
		if (!is_code(vec3_norm(c) * 10))
			cloud->point[cloud->n++] = (struct vec3){c.z / 100, -c.x / 100, c.y / 100};
	}
	return 0;
}

int uos_read(const uint8_t *data, size_t len, struct uos_scan *ret, struct parse_error *error)
{
	struct uos_scan scan = {0};
	struct points points = {0};
	struct raster raster;
	struct text text;
	text_init(&text, data, len);
	int r = read_points(&text, &points, error);
	if (r == 0)
		r = find_bearings(&points);
	if (r == 0)
		r = find_raster(&points, &raster) ? fill_raster(&points, &raster, &scan) : -EAGAIN;
	if (r == -EAGAIN) {
		uos_finish(&scan);
		r = fill_cloud(&points, &scan.cloud);
	}
	free(points.cm);
	free(points.bearing);
	if (r < 0)
		uos_finish(&scan);
	else
		*ret = scan;
	return r;
}

void uos_finish(struct uos_scan *scan)
{
	for (uint32_t i = 0; i < scan->rows; i++) {
		free(scan->row[i].range_m);
		free(scan->row[i].state);
	}
	free(scan->row);
	cloud_finish(&scan->cloud);
	*scan = (struct uos_scan){0};
}

/* Rx Ry Rz of the file's frame, row-major. */
static void euler_matrix(const double angle[3], double m[3][3])
{
	double sx = trig_sin(angle[0]), cx = trig_cos(angle[0]);
	double sy = trig_sin(angle[1]), cy = trig_cos(angle[1]);
	double sz = trig_sin(angle[2]), cz = trig_cos(angle[2]);
	const double rotation[3][3] = {
	    {cy * cz, -cy * sz, sy},
	    {sx * sy * cz + cx * sz, cx * cz - sx * sy * sz, -sx * cy},
	    {sx * sz - cx * sy * cz, cx * sy * sz + sx * cz, cx * cy},
	};
	memcpy(m, rotation, sizeof rotation);
}

int uos_read_pose(const char *data, size_t len, struct transform *ret, struct parse_error *error)
{
	double v[6];
	int n = 0;
	struct text text;
	text_init(&text, data, len);
	while (n < 6 && text_skip_empty(&text)) {
		int more = text_numbers(&text, 6 - n, v + n);
		if (more == 0)
			break;
		n += more;
	}
	if (n < 6)
		return fail(error, text.line,
		            "expected six numbers: x y z in centimetres, then three angles in degrees");
	for (int i = 0; i < 6; i++)
		if (!(fabs(v[i]) <= (i < 3 ? COORDINATE_MAX_CM : 3600)))
			return fail(error, text.line, "a position beyond 100 km or an angle beyond ten turns");
	const double angle[3] = {v[3] * TRIG_DEG, v[4] * TRIG_DEG, v[5] * TRIG_DEG};
	double m[3][3];
	euler_matrix(angle, m);
	/* Ours from theirs: axis i of ours is sign[i] times axis[i] of theirs; a change of basis on both sides. */
	static const int axis[3] = {2, 0, 1};
	static const double sign[3] = {1, -1, 1};
	for (int i = 0; i < 3; i++)
		for (int k = 0; k < 3; k++)
			ret->r[i * 3 + k] = sign[i] * sign[k] * m[axis[i]][axis[k]];
	ret->t = (struct vec3){v[2] / 100, -v[0] / 100, v[1] / 100};
	return 0;
}

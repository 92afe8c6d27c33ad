#include "daemon/scan_rows.h"

#include <errno.h>
#include <string.h>

#define BEAM_NS 37037

int scan_rows_begin(struct scan_rows *rows, const struct uos_scan *scan, const struct transform *pose, int64_t begin_ns)
{
	const struct sweep_params params = {
	    .base_tilt = transform_identity(),
	    .tilt_laser = transform_identity(),
	    .range_min_m = UOS_RANGE_MIN_M,
	    .range_max_m = UOS_RANGE_MAX_M,
	    .hold_ns = INT64_MAX,
	    .fixed_pose = true,
	    .map_base = *pose,
	};

	*rows = (struct scan_rows){.scan = scan, .sweep = sweep_create(&params), .begin_ns = begin_ns};
	return rows->sweep ? 0 : -ENOMEM;
}

static void make_profile(const struct uos_row *row, int64_t t_ns, struct profile *ret)
{
	ret->t_ns = t_ns;
	ret->beam_ns = BEAM_NS;
	ret->turn_ns = 0;
	ret->interlace = 1;
	ret->part = 0;
	ret->parts = 1;
	ret->n = (uint16_t)row->n;
	ret->first_rad = row->first_rad;
	ret->step_rad = row->step_rad;
	memcpy(ret->range_m, row->range_m, row->n * sizeof *row->range_m);
	memcpy(ret->state, row->state, row->n);
}

static void feed(struct scan_rows *rows)
{
	const struct uos_row *row = &rows->scan->row[rows->fed];
	const struct tilt before = {rows->begin_ns + rows->fed * SCAN_ROW_NS, row->tilt_rad};
	const struct tilt after = {before.t_ns + row->n * BEAM_NS, before.angle_rad};
	struct profile profile;

	make_profile(row, before.t_ns, &profile);
	sweep_tilt(rows->sweep, &before);
	sweep_profile(rows->sweep, &profile, 0);
	sweep_tilt(rows->sweep, &after);
	rows->fed++;
}

int scan_rows_next(struct scan_rows *rows, struct row **ret)
{
	enum sweep_drop drop;

	for (;;) {
		const bool end = rows->fed == rows->scan->rows;

		switch (sweep_next(rows->sweep, 0, end && rows->fed > 0, ret, &drop)) {
		case SWEEP_ROW:
			rows->given++;
			return 1;
		case SWEEP_NOMEM:
			return -ENOMEM;
		case SWEEP_DROPPED:
			continue;
		case SWEEP_WAIT:
			break;
		}
		if (end)
			return 0;
		feed(rows);
	}
}

void scan_rows_stats(const struct scan_rows *rows, struct sweep_stats *ret)
{
	sweep_stats(rows->sweep, ret);
}

void scan_rows_finish(struct scan_rows *rows)
{
	sweep_destroy(rows->sweep);
	rows->sweep = NULL;
}

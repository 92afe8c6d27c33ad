/* Law: no file makes the reader of uos scans crash, read beyond it or make a raster much larger than the file; what it
 * accepts is a raster or a cloud of numbers. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>

#include "core/model.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void must(bool condition)
{
	if (!condition)
		abort();
}

static void check_scan(const struct uos_scan *scan, size_t size)
{
	uint64_t cells = 0;
	must((scan->rows == 0) != (scan->cloud.n == 0 && scan->cloud.point == NULL));
	for (uint32_t i = 0; i < scan->rows; i++) {
		const struct uos_row *row = &scan->row[i];
		must(row->n == scan->row[0].n && row->step_rad > 0 && fabs(row->tilt_rad) < 3.2);
		for (uint32_t k = 0; k < row->n; k++)
			must(row->state[k] < BEAM_MASKED && row->range_m[k] >= 0);
		cells += row->n;
	}
	must(cells <= 8 * (uint64_t)size); /* a point is at least 6 bytes, an eighth of the cells hold one */
	for (size_t i = 0; i < scan->cloud.n; i++)
		must(vec3_norm(scan->cloud.point[i]) < 1e6);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct uos_scan scan;
	struct transform pose;
	struct parse_error error;
	if (uos_read(data, size, &scan, &error) == 0) {
		check_scan(&scan, size);
		uos_finish(&scan);
	}
	if (uos_read_pose((const char *)data, size, &pose, &error) == 0)
		for (int i = 0; i < 9; i++)
			must(fabs(pose.r[i]) < 1.0001);
	return 0;
}

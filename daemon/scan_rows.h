/* Rows of a uos scan, made by the assembler of live profiles: tilt samples stand before and after each profile as a servo that
 * steps would give them, so that the same profiles make the same surface, live or from files. */
#ifndef FACET_DAEMON_SCAN_ROWS_H
#define FACET_DAEMON_SCAN_ROWS_H

#include "core/model.h"
#include "core/sweep.h"

#define SCAN_ROW_NS 100000000LL /* between the profiles of a scan; its servo stands while one is measured */

struct scan_rows {
	const struct uos_scan *scan; /* borrowed */
	struct sweep *sweep;
	int64_t begin_ns;
	uint32_t fed;
	uint64_t given;
};

/* `pose`: map <- scanner. 0 or -ENOMEM. */
int scan_rows_begin(struct scan_rows *, const struct uos_scan *scan, const struct transform *pose, int64_t begin_ns);
/* 1 a row, the caller's, its number not yet set; 0 the end; -ENOMEM. */
int scan_rows_next(struct scan_rows *, struct row **ret);
void scan_rows_stats(const struct scan_rows *, struct sweep_stats *ret);
void scan_rows_finish(struct scan_rows *);

#endif

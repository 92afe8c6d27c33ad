#include "tools/figures.h"

#include <errno.h>
#include <stdio.h>
#include <sys/resource.h>

#include "core/grid.h"

double figures_cpu(clockid_t clock)
{
	struct timespec t;
	clock_gettime(clock, &t);
	return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

void figures_patch(struct figures *f, const struct patch *patch)
{
	uint32_t last = PLANE_NONE;
	f->patches++;
	f->faces += patch->nt;
	for (uint32_t i = 0; i < patch->nruns; i++) {
		f->planes += patch->run[i].plane != PLANE_NONE && patch->run[i].plane != last;
		last = patch->run[i].plane;
	}
}

double figures_reduction(const struct figures *f)
{
	return f->faces_raw ? 1 - (double)f->faces / (double)f->faces_raw : 0;
}

static void put_counts(struct buffer *b, const struct figures *f)
{
	buffer_printf(b, "{\"points\": %llu, \"rows\": %llu, \"sweeps\": %llu, \"blocks\": %llu, \"patches\": %llu, ",
	              (unsigned long long)f->points, (unsigned long long)f->rows, (unsigned long long)f->sweeps,
	              (unsigned long long)f->blocks, (unsigned long long)f->patches);
	buffer_printf(b,
	              "\"cells\": %llu, \"faces_raw\": %llu, \"faces\": %llu, \"planes\": %llu, \"reduction\": %.6f, ",
	              (unsigned long long)f->blocks * BLOCK_VOXELS, (unsigned long long)f->faces_raw,
	              (unsigned long long)f->faces, (unsigned long long)f->planes, figures_reduction(f));
	buffer_printf(b, "\"batches\": %llu, ", (unsigned long long)f->batches);
	if (f->replay)
		buffer_printf(b,
		              "\"not_applied\": %llu, \"maps\": %llu, \"events\": %llu, \"batch_patches\": %llu, "
		              "\"recorded_seconds\": %.6f, ",
		              (unsigned long long)f->not_applied, (unsigned long long)f->maps,
		              (unsigned long long)f->events, (unsigned long long)f->batch_patches, f->recorded_s);
}

int figures_write(const struct figures *f, const char *path, struct output_error *error)
{
	struct rusage usage;
	struct buffer b = {0};
	int r;

	getrusage(RUSAGE_SELF, &usage);
	put_counts(&b, f);
	buffer_printf(&b, "\"seconds\": {\"read\": %.6f, \"assemble\": %.6f, \"integrate\": %.6f, ", f->seconds[READ],
	              f->seconds[ASSEMBLE], f->seconds[INTEGRATE]);
	buffer_printf(&b, "\"extract\": %.6f, \"reduce\": %.6f, \"write\": %.6f, \"total\": %.6f}, ",
	              f->seconds[EXTRACT], f->seconds[REDUCE], f->seconds[WRITE],
	              figures_cpu(CLOCK_PROCESS_CPUTIME_ID));
	buffer_printf(&b, "\"peak_rss_bytes\": %llu, \"hash\": \"%s\"}\n", (unsigned long long)usage.ru_maxrss * 1024,
	              f->hash);
	if (b.error)
		snprintf(error->text, sizeof error->text, "%.400s: out of memory", path);
	r = b.error ? -ENOMEM : output_write(path, b.data, b.len, error);
	buffer_finish(&b);
	return r;
}

/* What a command that makes a mesh measures of itself, and how it says so (`--stats`, interfaces, section 1). */
#ifndef FACET_TOOLS_FIGURES_H
#define FACET_TOOLS_FIGURES_H

#include <time.h>

#include "core/patch.h"
#include "tools/output.h"

enum stage { READ, ASSEMBLE, INTEGRATE, EXTRACT, REDUCE, WRITE, STAGES };

struct figures {
	uint64_t points, rows, sweeps, blocks, patches, faces_raw, faces, planes, batches;
	double seconds[STAGES]; /* CPU */
	char hash[65];
	/* Of a replay; `replay` false: they are left out. */
	bool replay;
	uint64_t not_applied, maps, events, batch_patches; /* maps: begun one after the other, the last is the mesh */
	double recorded_s;
};

double figures_cpu(clockid_t);                              /* seconds */
void figures_patch(struct figures *, const struct patch *); /* counts it */
double figures_reduction(const struct figures *);
/* The JSON object, to a file. 0 or -errno with a sentence. */
int figures_write(const struct figures *, const char *path, struct output_error *error);

#endif

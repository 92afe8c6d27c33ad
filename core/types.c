/* Rows are allocated in one piece with their beams and handed from stage to stage. */
#include "core/types.h"

#include <stdlib.h>

struct row *row_create(uint32_t n)
{
	struct row *row = calloc(1, sizeof(*row) + (size_t)n * sizeof(row->beam[0]));

	if (row)
		row->n = n;
	return row;
}

void row_destroy(struct row *row)
{
	free(row);
}

/* Files that are never half written: written beside under another name, then renamed. */
#ifndef FACET_TOOLS_OUTPUT_H
#define FACET_TOOLS_OUTPUT_H

#include <stdbool.h>
#include <stddef.h>

#include "core/model.h"

struct output_error {
	char text[512]; /* one sentence that begins with the file's name */
};

enum output_format { OUTPUT_PLY, OUTPUT_OBJ, OUTPUT_STL, OUTPUT_GLB, OUTPUT_UNKNOWN };

/* By the file's ending, in any case. */
enum output_format output_format(const char *path);

/* Can `path` be written? Asked before the work, by writing a file beside it and removing it. 0 or -errno. */
int output_check(const char *path, struct output_error *error);

/* 0 or -errno; on failure nothing is left and an older file stays as it was. */
int output_write(const char *path, const void *data, size_t len, struct output_error *error);

/* The mesh in the format of the file's ending; `ascii` only means something to PLY. 0 or -errno. */
int output_mesh(const char *path, const struct model *, bool ascii, struct output_error *error);

#endif

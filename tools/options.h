/* Options of the commands that turn files into a mesh. */
#ifndef FACET_TOOLS_OPTIONS_H
#define FACET_TOOLS_OPTIONS_H

#include <argp.h>
#include <stdbool.h>

#include "core/map.h"

struct options {
	struct map_params map;
	double snap; /* cells; means something once planes are on */
	enum { POSE_BESIDE, POSE_FILE, POSE_NONE, POSE_LIST } pose;
	const char *pose_path; /* of POSE_FILE, POSE_LIST */
	int threads;
	const char *stats; /* NULL: none asked for */
	const char *output;
	bool ascii;
	int inputs;
	char **input; /* borrowed from argv */
};

/* Reads the command line. Bad usage ends the program with a sentence and status 2, `--help` with status 0 (argp's way). */
void options_parse(int argc, char **argv, const char *doc, struct options *ret);

#endif

/* Options of the commands that turn files into a mesh. */
#ifndef FACET_TOOLS_OPTIONS_H
#define FACET_TOOLS_OPTIONS_H

#include <argp.h>
#include <stdbool.h>

#include "core/map.h"

struct options {
	struct map_params map;
	unsigned given; /* what of it was said: */
#define OPTION_CELL      1u
#define OPTION_TOLERANCE 2u
#define OPTION_REDUCE    4u
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

/* For commands with options of their own besides: a child parser (argp's way), whose input is a struct options that
 * options_default filled; options_check at the end. */
extern const struct argp options_argp;
void options_default(struct options *);
void options_check(const struct options *, const char *command);
/* "--NAME WORD: give a number from ..." and out. */
double options_number(const char *name, const char *word, double min, double max);
/* A sentence about bad input; 1, the status that goes with it. */
int __attribute__((format(printf, 1, 2))) options_complain(const char *format, ...);
/* A sentence about bad usage, and out with status 2. */
void __attribute__((noreturn, format(printf, 1, 2))) options_refuse(const char *format, ...);

/* Reads the command line. Bad usage ends the program with a sentence and status 2, `--help` with status 0 (argp's way). */
void options_parse(int argc, char **argv, const char *doc, struct options *ret);

#endif

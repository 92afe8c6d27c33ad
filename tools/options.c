/* What is known but comes later is refused by name, so that nobody gets another mesh than the one asked for. */
#include "tools/options.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/text.h"
#include "tools/output.h"

#define THREADS_MAX 64
#define MEMORY_MAX  ((size_t)2 << 30)

enum {
	KEY_CELL = 256,
	KEY_FIELD,
	KEY_PLANES,
	KEY_REDUCE,
	KEY_TOLERANCE,
	KEY_SNAP,
	KEY_POSE,
	KEY_NO_POSE,
	KEY_POSES,
	KEY_THREADS,
	KEY_STATS,
	KEY_ASCII
};

static const struct argp_option table[] = {
    {"output", 'o', "OUT", 0, "the mesh; .ply, .obj, .stl or .glb", 0},
    {"cell", KEY_CELL, "M", 0, "side of a cell in metres (0.05)", 0},
    {"tolerance", KEY_TOLERANCE, "CELLS", 0, "how far the reduced surface may lie from the full one, in cells (0.25)",
     0},
    {"reduce", KEY_REDUCE, "on|off", 0, "fewer faces where the surface is flat (on)", 0},
    {"field", KEY_FIELD, "NAME", 0, "how the surface is found: distance; hoppe and direct come later", 0},
    {"planes", KEY_PLANES, "on|off", 0, "put the surface onto the planes of the map (off; on comes later)", 0},
    {"snap", KEY_SNAP, "CELLS", 0, "how far planes may move the surface, in cells (0.15)", 0},
    {"pose", KEY_POSE, "FILE", 0, "where the scanner was, for every input: a uos .pose file", 0},
    {"no-pose", KEY_NO_POSE, 0, 0, "the scanner stood at the origin of the map, for every input", 0},
    {"poses", KEY_POSES, "FILE", 0, "one line `t x y z qx qy qz qw` (TUM; metres) for each input, in their order", 0},
    {"threads", KEY_THREADS, "N", 0, "threads that make meshes (1); the mesh does not depend on it", 0},
    {"stats", KEY_STATS, "FILE", 0, "figures of the run as JSON", 0},
    {"ascii", KEY_ASCII, 0, 0, "PLY as text", 0},
    {0},
};

static void say(const char *format, va_list args)
{
	fputs("facet: ", stderr);
	vfprintf(stderr, format, args);
	fputc('\n', stderr);
}

int options_complain(const char *format, ...)
{
	va_list args;
	va_start(args, format);
	say(format, args);
	va_end(args);
	return 1;
}

void options_refuse(const char *format, ...)
{
	va_list args;
	va_start(args, format);
	say(format, args);
	va_end(args);
	exit(2);
}

double options_number(const char *option, const char *word, double min, double max)
{
	struct text text;
	double value;
	text_init(&text, word, strlen(word));
	if (!text_number(&text, &value) || !text_ended(&text) || !(value >= min && value <= max))
		options_refuse("--%s %s: give a number from %g to %g", option, word, min, max);
	return value;
}

static int whole(const char *option, const char *word, int min, int max)
{
	double value = options_number(option, word, min, max);
	if (value != (int)value)
		options_refuse("--%s %s: give a whole number from %d to %d", option, word, min, max);
	return (int)value;
}

static bool on_off(const char *option, const char *word)
{
	if (strcmp(word, "on") != 0 && strcmp(word, "off") != 0)
		options_refuse("--%s %s: give on or off", option, word);
	return strcmp(word, "on") == 0;
}

static void field(const char *word)
{
	if (strcmp(word, "hoppe") == 0 || strcmp(word, "direct") == 0)
		options_refuse("--field %s: comes in a later version, use --field distance", word);
	if (strcmp(word, "distance") != 0)
		options_refuse("--field %s: there is no such field, use --field distance", word);
}

static void pose(struct options *options, int kind, const char *path)
{
	if (options->pose != POSE_BESIDE)
		options_refuse("--pose, --no-pose and --poses exclude each other: give one of them, once");
	options->pose = kind;
	options->pose_path = path;
}

static error_t parse(int key, char *word, struct argp_state *state)
{
	struct options *options = state->input;
	switch (key) {
	case KEY_CELL:
		options->given |= OPTION_CELL;
		options->map.cell_m = options_number("cell", word, 0.005, 2);
		return 0;
	case KEY_TOLERANCE:
		options->given |= OPTION_TOLERANCE;
		options->map.tolerance = options_number("tolerance", word, 0.01, 1);
		return 0;
	case KEY_SNAP:
		options->snap = options_number("snap", word, 0, 0.5);
		return 0;
	case KEY_REDUCE:
		options->given |= OPTION_REDUCE;
		options->map.reduce = on_off("reduce", word);
		return 0;
	case KEY_PLANES:
		if (on_off("planes", word))
			options_refuse(
			    "--planes on: the planes of the whole map come in a later version, use --planes off");
		return 0;
	case KEY_FIELD:
		field(word);
		return 0;
	case KEY_POSE:
		pose(options, POSE_FILE, word);
		return 0;
	case KEY_NO_POSE:
		pose(options, POSE_NONE, NULL);
		return 0;
	case KEY_POSES:
		pose(options, POSE_LIST, word);
		return 0;
	case KEY_THREADS:
		options->threads = whole("threads", word, 1, THREADS_MAX);
		return 0;
	case KEY_STATS:
		options->stats = word;
		return 0;
	case KEY_ASCII:
		options->ascii = true;
		return 0;
	case 'o':
		options->output = word;
		return 0;
	case ARGP_KEY_ARGS:
		options->input = state->argv + state->next;
		options->inputs = state->argc - state->next;
		return 0;
	default:
		return ARGP_ERR_UNKNOWN;
	}
}

const struct argp options_argp = {.options = table, .parser = parse};

void options_default(struct options *ret)
{
	*ret = (struct options){
	    .map = {.cell_m = 0.05, .tolerance = 0.25, .reduce = true, .lookahead = 2, .memory = MEMORY_MAX},
	    .snap = 0.15,
	    .threads = 1,
	};
}

void options_check(const struct options *options, const char *command)
{
	if (options->inputs == 0)
		options_refuse("no input: see facet %s --help", command);
	if (!options->output)
		options_refuse("no output: say where the mesh goes with -o OUT.ply (or .obj, .stl, .glb)");
	if (output_format(options->output) == OUTPUT_UNKNOWN)
		options_refuse("%s: the ending names no mesh format; use .ply, .obj, .stl or .glb", options->output);
}

void options_parse(int argc, char **argv, const char *doc, struct options *ret)
{
	const struct argp argp = {.options = table, .parser = parse, .args_doc = "-o OUT INPUT...", .doc = doc};
	options_default(ret);
	argp_parse(&argp, argc, argv, 0, NULL, ret);
	if (ret->inputs == 0)
		options_refuse("no input: name scans or clouds, see facet reconstruct --help");
	options_check(ret, "reconstruct");
}

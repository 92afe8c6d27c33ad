/* `facet`: one program, a command each for what is done with maps from the command line. */
#include <argp.h>
#include <stdio.h>
#include <string.h>

#include "tools/commands.h"

struct command {
	const char *name, *help;
	int (*main)(int argc, char **argv); /* NULL: comes later, refused by name */
};

static const struct command commands[] = {
    {"reconstruct", "files of points or scans into a mesh", reconstruct_main},
    {"watch", "what a running daemon does, live, in the terminal", watch_main},
    {"save", "a consistent snapshot of a running daemon's map", save_main},
    {"picture", "a mesh as a picture, from above with the ceiling cut off", picture_main},
    {"simulate", "simulated devices, and what to try on them", simulate_main},
    {"record", "record a running daemon", record_main},
    {"replay", "a recording into a mesh", replay_main},
    {"info", "what is in a recording, scan or mesh", info_main},
    {"repair", "a clean file of what is whole in a cut or damaged recording", repair_main},
    {"devices", "what is plugged in, with the configuration for each", devices_main},
    {"calibrate", "offsets of tilt and mount from a recording", NULL},
    {"bench", "how fast and how true this machine makes maps", NULL},
    {"decimate", "fewer faces for a mesh", NULL},
};
#define COMMANDS (sizeof commands / sizeof *commands)

static void print_help(FILE *out)
{
	fprintf(out, "Usage: facet COMMAND [OPTION...]\n\n");
	for (size_t i = 0; i < COMMANDS; i++)
		if (commands[i].main)
			fprintf(out, "  %-12s %s\n", commands[i].name, commands[i].help);
	fprintf(
	    out,
	    "\n  facet COMMAND --help tells the options of a command; facet --version says which version this is.\n");
}

static int run(const struct command *command, int argc, char **argv)
{
	if (!command->main) {
		fprintf(stderr, "facet: %s: this command comes in a later version; facet --help lists what there is\n",
		        command->name);
		return 2;
	}
	char name[64];
	snprintf(name, sizeof name, "facet %s", command->name);
	argv[0] = name;
	argp_err_exit_status = 2;
	return command->main(argc, argv);
}

int main(int argc, char **argv)
{
	if (argc < 2) {
		print_help(stderr);
		return 2;
	}
	const char *word = argv[1];
	if (strcmp(word, "--help") == 0 || strcmp(word, "-?") == 0 || strcmp(word, "-h") == 0 ||
	    strcmp(word, "help") == 0) {
		print_help(stdout);
		return 0;
	}
	if (strcmp(word, "--version") == 0 || strcmp(word, "-V") == 0) {
		puts("facet " FACET_VERSION);
		return 0;
	}
	for (size_t i = 0; i < COMMANDS; i++)
		if (strcmp(word, commands[i].name) == 0)
			return run(&commands[i], argc - 1, argv + 1);
	fprintf(stderr, "facet: %s: there is no such command; facet --help lists what there is\n", word);
	return 2;
}

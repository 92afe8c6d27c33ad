/* facetd: reads its configuration and runs the daemon. Exit 0, 1 (bad input, or it could not run), 2 (bad usage). */
#include <argp.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "config/keys.h"
#include "daemon/daemon.h"

#define CONFIG_BYTES_MAX (1u << 20)
#define CONFIG_DEFAULT   "/etc/facetd/facetd.yaml"

enum { OPTION_CHECK = 256, OPTION_JOURNAL, OPTION_REPLAY, OPTION_MANUAL };

struct arguments {
	const char *config, *journal;
	bool check;
};

static const struct argp_option options[] = {
    {"config", 'c', "FILE", 0, "configuration (default: $FACETD_CONFIG, then " CONFIG_DEFAULT ")", 0},
    {"check-config", OPTION_CHECK, NULL, 0, "say whether the configuration is right, and end", 0},
    {"journal", OPTION_JOURNAL, "FILE", 0,
     "keep what the devices sent in FILE, after each ?RESET in FILE.2 and so on, for tests and the search for faults",
     0},
    {"manual", OPTION_MANUAL, NULL, 0, "print the manual of the configuration, itself a configuration with every key",
     0},
    {"replay", OPTION_REPLAY, "FILE", 0, "not yet: recordings come in a later version", 0},
    {0},
};

static error_t parse(int key, char *value, struct argp_state *state)
{
	struct arguments *arguments = state->input;

	switch (key) {
	case 'c':
		arguments->config = value;
		return 0;
	case OPTION_CHECK:
		arguments->check = true;
		return 0;
	case OPTION_JOURNAL:
		arguments->journal = value;
		return 0;
	case OPTION_MANUAL:
		keys_write_manual(stdout);
		exit(fflush(stdout) ? 1 : 0);
	case OPTION_REPLAY:
		argp_failure(state, 2, 0,
		             "--replay: recordings come in a later version; run devices, or facet simulate");
		return EINVAL;
	case ARGP_KEY_ARG:
		argp_failure(state, 2, 0,
		             "%s: takes no arguments, only options; a configuration is given with --config", value);
		return EINVAL;
	default:
		return ARGP_ERR_UNKNOWN;
	}
}

/* The whole file, with a NUL; NULL with the sentence printed. */
static char *read_file(const char *path, size_t *ret_len)
{
	FILE *file = fopen(path, "re");
	char *text = malloc(CONFIG_BYTES_MAX + 1);
	size_t n = 0;

	errno = file ? 0 : errno;
	if (file && text)
		n = fread(text, 1, CONFIG_BYTES_MAX + 1, file);
	if (!file || !text || ferror(file)) {
		fprintf(stderr,
		        "facetd: %s: cannot be read (%s); give a configuration with --config; facetd --manual prints "
		        "one with comments\n",
		        path, strerror(errno ? errno : EIO));
		free(text);
		text = NULL;
	} else if (n > CONFIG_BYTES_MAX) {
		fprintf(stderr, "facetd: %s: more than 1 MB; is it a configuration?\n", path);
		free(text);
		text = NULL;
	} else {
		text[n] = 0;
		*ret_len = n;
	}
	if (file)
		fclose(file);
	return text;
}

static const char *config_path(const struct arguments *arguments)
{
	const char *environment = getenv("FACETD_CONFIG");

	if (arguments->config)
		return arguments->config;
	return environment && *environment ? environment : CONFIG_DEFAULT;
}

/* The text is the caller's. */
static bool load(const char *path, struct config *ret, char **ret_text)
{
	struct config_error error = {0};
	size_t len = 0;
	char *text = read_file(path, &len);
	int r;

	if (!text)
		return false;
	r = config_read(text, len, path, ret, &error);
	*ret_text = text;
	if (r < 0)
		fprintf(stderr, "facetd: %s\n", r == -ENOMEM ? "out of memory" : error.text);
	return r == 0;
}

int main(int argc, char **argv)
{
	static const struct argp argp = {
	    options,
	    parse,
	    NULL,
	    "Builds a map from a tilting laser scanner and sends its changes to whoever listens.\v"
	    "SIGINT or SIGTERM end it. How clients talk to it: docs/protocol.md; `facet watch` shows what it does.",
	    NULL,
	    NULL,
	    NULL};
	static struct config config;
	struct arguments arguments = {0};
	struct daemon_options run = {0};
	char error[320] = "", *text = NULL;
	int r;

	argp_program_version = "facetd " FACET_VERSION;
	argp_err_exit_status = 2;
	argp_parse(&argp, argc, argv, 0, NULL, &arguments);
	if (!load(config_path(&arguments), &config, &text)) {
		free(text);
		return 1;
	}
	if (arguments.check) {
		printf("%s: the configuration is right\n", config_path(&arguments));
		free(text);
		return 0;
	}
	run.journal = arguments.journal;
	run.config_text = text;
	r = daemon_run(&config, &run, error);
	free(text);
	if (r < 0)
		fprintf(stderr, "facetd: %s\n", error);
	return r < 0;
}

/* facetd: reads its configuration and runs the daemon. Exit 0, 1 (bad input, or it could not run), 2 (bad usage). */
#include <argp.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "config/keys.h"
#include "daemon/daemon.h"
#include "daemon/player.h"
#include "daemon/worker.h"

#define CONFIG_BYTES_MAX (1u << 20)
#define CONFIG_DEFAULT   "/etc/facetd/facetd.yaml"

enum { OPTION_CHECK = 256, OPTION_JOURNAL, OPTION_QUEUE, OPTION_REPLAY, OPTION_SPEED, OPTION_MANUAL };

struct arguments {
	const char *config, *journal;
	const char *replay[REPLAY_FILES_MAX];
	int replays;
	double speed;
	int queue; /* 0: as many as can be */
	bool check;
};

static const struct argp_option options[] = {
    {"config", 'c', "FILE", 0, "configuration (default: $FACETD_CONFIG, then " CONFIG_DEFAULT ")", 0},
    {"check-config", OPTION_CHECK, NULL, 0, "say whether the configuration is right, and end", 0},
    {"journal", OPTION_JOURNAL, "FILE", 0,
     "keep what the devices sent in FILE, after each ?RESET in FILE.2 and so on, for tests and the search for faults",
     0},
    {"queue", OPTION_QUEUE, "ROWS", 0,
     "let so few rows wait for the map, so that some are dropped, for tests and the search for faults", 0},
    {"manual", OPTION_MANUAL, NULL, 0, "print the manual of the configuration, itself a configuration with every key",
     0},
    {"replay", OPTION_REPLAY, "FILE...", 0,
     "play recordings instead of devices, with the configuration that is in them if no --config is given; what is "
     "played, "
     "and what a candump log, a capture or a CARMEN log needs: docs/replay.md",
     0},
    {"speed", OPTION_SPEED, "X|max", 0, "of the replay (1)", 0},
    {0},
};

static error_t add_replay(struct arguments *arguments, const char *value, const struct argp_state *state)
{
	if (arguments->replays == REPLAY_FILES_MAX) {
		argp_failure(state, 2, 0, "--replay: too many files; %d are possible", REPLAY_FILES_MAX);
		return EINVAL;
	}
	arguments->replay[arguments->replays++] = value;
	return 0;
}

static error_t read_speed(struct arguments *arguments, const char *value, const struct argp_state *state)
{
	char *end;

	arguments->speed = strtod(value, &end);
	if (strcmp(value, "max") == 0) {
		arguments->speed = 0;
	} else if (*end || end == value ||
	           !(arguments->speed >= PLAYER_SPEED_MIN && arguments->speed <= PLAYER_SPEED_MAX)) {
		argp_failure(state, 2, 0, "--speed %s: give a number from %g to %g, or max", value, PLAYER_SPEED_MIN,
		             PLAYER_SPEED_MAX);
		return EINVAL;
	}
	return 0;
}

static error_t read_queue(struct arguments *arguments, const char *value, const struct argp_state *state)
{
	char *end;
	const long rows = strtol(value, &end, 10);

	if (*end || end == value || rows < 1 || rows > WORKER_ROWS_MAX) {
		argp_failure(state, 2, 0, "--queue %s: give a number of rows from 1 to %d", value, WORKER_ROWS_MAX);
		return EINVAL;
	}
	arguments->queue = (int)rows;
	return 0;
}

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
	case OPTION_QUEUE:
		return read_queue(arguments, value, state);
	case OPTION_MANUAL:
		keys_write_manual(stdout);
		exit(fflush(stdout) ? 1 : 0);
	case OPTION_REPLAY:
		return add_replay(arguments, value, state);
	case OPTION_SPEED:
		return read_speed(arguments, value, state);
	case ARGP_KEY_ARG:
		if (arguments->replays > 0) /* --replay takes all that follows */
			return add_replay(arguments, value, state);
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

static bool parse_config(const char *text, size_t len, const char *name, struct config *ret)
{
	struct config_error error = {0};
	int r = config_read(text, len, name, ret, &error);

	if (r < 0)
		fprintf(stderr, "facetd: %s\n", r == -ENOMEM ? "out of memory" : error.text);
	return r == 0;
}

/* The text is the caller's. */
static bool load(const char *path, struct config *ret, char **ret_text)
{
	size_t len = 0;
	char *text = read_file(path, &len);

	*ret_text = text;
	return text && parse_config(text, len, path, ret);
}

/* Of a replay: what the command line or the environment names, else what was recorded. */
static bool load_for_replay(const struct arguments *arguments, const struct replay *replay, struct config *ret)
{
	const char *environment = getenv("FACETD_CONFIG");
	size_t len;
	const char *text = replay_config(replay, &len);
	char *named = NULL;
	bool good;

	if (arguments->config || (environment && *environment)) {
		good = load(config_path(arguments), ret, &named);
		free(named);
		return good;
	}
	if (text)
		return parse_config(text, len, "facetd.yaml of the recording", ret);
	fprintf(stderr,
	        "facetd: %s: says nothing of the configuration it was recorded with; give it with --config FILE\n",
	        arguments->replay[0]);
	return false;
}

static int run_replay(const struct arguments *arguments, struct config *config)
{
	struct daemon_options run = {.speed = arguments->speed};
	char error[REPLAY_ERROR_MAX] = "";
	int r = 1;

	if (replay_open(arguments->replay, arguments->replays, &run.replay, error) < 0) {
		fprintf(stderr, "facetd: %s\n", error);
		return 1;
	}
	if (load_for_replay(arguments, run.replay, config)) {
		config->record.dir[0] = 0; /* what is recorded is not recorded again */
		r = replay_use(run.replay, config, error) < 0 || daemon_run(config, &run, error) < 0;
		if (r)
			fprintf(stderr, "facetd: %s\n", error);
	}
	replay_close(run.replay);
	return r;
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
	static struct arguments arguments = {.speed = 1};
	struct daemon_options run = {0};
	char error[320] = "", *text = NULL;
	int r;

	argp_program_version = "facetd " FACET_VERSION;
	argp_err_exit_status = 2;
	argp_parse(&argp, argc, argv, 0, NULL, &arguments);
	if (arguments.replays > 0 && !arguments.check)
		return run_replay(&arguments, &config);
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
	run.rows_max = (size_t)arguments.queue;
	run.config_text = text;
	r = daemon_run(&config, &run, error);
	free(text);
	if (r < 0)
		fprintf(stderr, "facetd: %s\n", error);
	return r < 0;
}

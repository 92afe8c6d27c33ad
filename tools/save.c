/* `facet save`: the map of a running daemon as a file. The first batch after joining is the whole map as of its step, so
 * what is written is a snapshot that the daemon held at one moment, whatever it does meanwhile. */
#include <argp.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <time.h>

#include "config/address.h"
#include "config/units.h"
#include "tools/client.h"
#include "tools/commands.h"
#include "tools/output.h"

enum { OPTION_ASCII = 256, OPTION_WAIT, OPTION_TIMEOUT };

struct job {
	const char *address, *output;
	bool ascii;
	uint64_t wait_steps;
	double timeout_s;
};

static const struct argp_option options[] = {
    {"output", 'o', "OUT", 0, "where it goes: .ply .obj .stl .glb a mesh, .json the planes", 0},
    {"ascii", OPTION_ASCII, NULL, 0, "PLY as text", 0},
    {"wait-steps", OPTION_WAIT, "N", 0, "wait until the map is at step N or later", 0},
    {"timeout", OPTION_TIMEOUT, "SECONDS", 0, "how long to wait at most; 30", 0},
    {0}};

static error_t parse_option(int key, char *arg, struct argp_state *state)
{
	struct job *job = state->input;
	char *end;
	switch (key) {
	case 'o':
		job->output = arg;
		return 0;
	case OPTION_ASCII:
		job->ascii = true;
		return 0;
	case OPTION_WAIT:
		job->wait_steps = strtoull(arg, &end, 10);
		if (end == arg || *end || arg[0] == '-')
			argp_error(state, "--wait-steps: '%s' is not a number of steps", arg);
		return 0;
	case OPTION_TIMEOUT:
		if (units_parse(arg, DIMENSION_TIME, &job->timeout_s) || job->timeout_s < 0 || job->timeout_s > 1e6)
			argp_error(state, "--timeout: '%s' is not a time in seconds", arg);
		return 0;
	case ARGP_KEY_ARG:
		if (job->address)
			argp_error(state, "one daemon is saved at a time; '%s' is the second", arg);
		job->address = arg;
		return 0;
	case ARGP_KEY_END:
		if (!job->output)
			argp_error(state, "-o OUT is needed");
		return 0;
	default:
		return ARGP_ERR_UNKNOWN;
	}
}

static bool is_json(const char *path)
{
	const size_t len = strlen(path);
	return len > 5 && strcasecmp(path + len - 5, ".json") == 0;
}

static double now_s(void)
{
	struct timespec t;
	clock_gettime(CLOCK_MONOTONIC, &t);
	return (double)t.tv_sec + (double)t.tv_nsec * 1e-9;
}

/* Follows until a COMMIT at or beyond the wanted step. */
static int follow(struct client *client, const struct job *job, char error[CLIENT_ERROR_MAX])
{
	const struct native_want want = {0};
	const double until_s = now_s() + job->timeout_s;
	int status = client_want(client, &want, error);
	while (!status) {
		const double left_s = until_s - now_s();
		const int commit = client_commit(client, left_s > 0 ? (int)(left_s * 1000) : 0, error);
		if (commit < 0)
			return commit;
		const uint64_t step = native_mirror_step(client_mirror(client));
		if (commit && step >= job->wait_steps)
			return 0;
		if (!commit) {
			snprintf(error, CLIENT_ERROR_MAX,
			         "%s: no whole map of step %llu or later came within %g s (it is at %llu); give it "
			         "more --timeout",
			         client_address(client), (unsigned long long)job->wait_steps, job->timeout_s,
			         (unsigned long long)step);
			return -ETIMEDOUT;
		}
	}
	return status;
}

static int write_map(const struct native_mirror *mirror, const struct job *job)
{
	struct output_error error;
	struct model model;
	int status;
	if (is_json(job->output)) {
		status =
		    output_write(job->output, "[]\n", 3, &error); /* planes of the whole map come with its registry */
		if (!status)
			printf("%s: no planes: those of the whole map come in a later version\n", job->output);
	} else {
		if (model_weld(native_mirror_patches(mirror), native_mirror_hello(mirror)->cell_m, &model)) {
			fprintf(stderr, "facet: %s: not enough memory for this map\n", job->output);
			return 1;
		}
		status = output_mesh(job->output, &model, job->ascii, &error);
		if (!status)
			printf("%s: step %llu, %u vertices, %u faces\n", job->output,
			       (unsigned long long)native_mirror_step(mirror), model.nv, model.nt);
		model_finish(&model);
	}
	if (status)
		fprintf(stderr, "facet: %s\n", error.text);
	return status ? 1 : 0;
}

/* What can be known before the daemon is asked. */
static int judge_job(const struct job *job)
{
	struct output_error error;
	struct address address;
	char sentence[ADDRESS_ERROR_MAX];
	if (job->address && address_parse(job->address, ADDRESS_UNIX | ADDRESS_TCP | ADDRESS_WS, &address, sentence)) {
		fprintf(stderr, "facet: %s\n", sentence);
		return 2;
	}
	if (!is_json(job->output) && output_format(job->output) == OUTPUT_UNKNOWN) {
		fprintf(stderr, "facet: %s: the ending names no format; use .ply, .obj, .stl, .glb or .json\n",
		        job->output);
		return 2;
	}
	if (output_check(job->output, &error) == 0)
		return 0;
	fprintf(stderr, "facet: %s\n", error.text);
	return 1;
}

int save_main(int argc, char **argv)
{
	static const struct argp argp = {
	    options,
	    parse_option,
	    "[ADDRESS] -o OUT",
	    "A consistent snapshot of a running daemon's map.\v"
	    "ADDRESS is unix:PATH, tcp:HOST:PORT or ws://HOST:PORT/; default: $FACETD, the user's own socket, the "
	    "system's.",
	    NULL,
	    NULL,
	    NULL};
	struct job job = {.timeout_s = 30};
	char error[CLIENT_ERROR_MAX];
	argp_parse(&argp, argc, argv, 0, NULL, &job);
	int status = judge_job(&job);
	if (status)
		return status;
	struct client *client = client_open(job.address, 5000, error);
	if (!client || follow(client, &job, error)) {
		fprintf(stderr, "facet: %s\n", error);
		status = 1;
	} else {
		status = write_map(client_mirror(client), &job);
	}
	client_close(client);
	return status;
}

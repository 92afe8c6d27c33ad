/* `facet picture`: a mesh file as a picture, for READMEs, reports and a first look where no viewer is at hand. */
#include <argp.h>
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "config/units.h"
#include "tools/commands.h"
#include "tools/mesh_read.h"
#include "tools/output.h"
#include "tools/render.h"

#define DEG      0.017453292519943295
#define FILE_MAX ((off_t)4 << 30)

enum { OPTION_VIEW = 256, OPTION_CUT, OPTION_SIZE, OPTION_EDGES };

struct job {
	const char *input, *output;
	struct render_view view;
	bool auto_cut;
};

static const struct argp_option options[] = {
    {"output", 'o', "OUT.png", 0, "where the picture goes", 0},
    {"view", OPTION_VIEW, "YAW,PITCH", 0,
     "degrees: where it looks to (0 along x) and how far down (90 is a plan); 60,55", 0},
    {"cut", OPTION_CUT, "Z", 0, "height in metres above which everything is cut off, or none; found by itself", 0},
    {"edges", OPTION_EDGES, NULL, 0, "draw the edges of the triangles", 0},
    {"size", OPTION_SIZE, "WxH", 0, "pixels; 1600x1000", 0},
    {0}};

static void parse_view(const char *arg, struct render_view *view, struct argp_state *state)
{
	char *end;
	const double yaw = strtod(arg, &end);
	const double pitch = *end == ',' ? strtod(end + 1, &end) : NAN;
	if (*end || !(fabs(yaw) <= 360) || !(pitch > 0 && pitch <= 90))
		argp_error(state, "--view: '%s' is not YAW,PITCH in degrees, with a pitch above 0 and up to 90", arg);
	view->yaw_rad = yaw * DEG;
	view->pitch_rad = pitch * DEG;
}

static void parse_size(const char *arg, struct render_view *view, struct argp_state *state)
{
	char *end;
	const long width = strtol(arg, &end, 10);
	const long height = *end == 'x' ? strtol(end + 1, &end, 10) : 0;
	if (*end || width < 16 || height < 16 || width > RENDER_SIDE_MAX || height > RENDER_SIDE_MAX)
		argp_error(state, "--size: '%s' is not WIDTHxHEIGHT within 16 .. %d", arg, RENDER_SIDE_MAX);
	view->width = (int)width;
	view->height = (int)height;
}

static void parse_cut(const char *arg, struct job *job, struct argp_state *state)
{
	job->auto_cut = false;
	job->view.cut_m = INFINITY;
	if (strcmp(arg, "none") != 0 && units_parse(arg, DIMENSION_LENGTH, &job->view.cut_m) != 0)
		argp_error(state, "--cut: '%s' is not a height in metres, and not none", arg);
}

static error_t parse_option(int key, char *arg, struct argp_state *state)
{
	struct job *job = state->input;
	switch (key) {
	case 'o':
		job->output = arg;
		return 0;
	case OPTION_VIEW:
		parse_view(arg, &job->view, state);
		return 0;
	case OPTION_CUT:
		parse_cut(arg, job, state);
		return 0;
	case OPTION_SIZE:
		parse_size(arg, &job->view, state);
		return 0;
	case OPTION_EDGES:
		job->view.edges = true;
		return 0;
	case ARGP_KEY_ARG:
		if (job->input)
			argp_error(state, "one mesh makes one picture; '%s' is the second", arg);
		job->input = arg;
		return 0;
	case ARGP_KEY_END:
		if (!job->input || !job->output)
			argp_error(state, "a mesh and -o OUT.png are needed");
		return 0;
	default:
		return ARGP_ERR_UNKNOWN;
	}
}

static int complain(const char *path, const char *sentence)
{
	fprintf(stderr, "facet: %s: %s\n", path, sentence);
	return 1;
}

/* The whole file; NULL with errno set. */
static uint8_t *read_file(const char *path, size_t *ret_len)
{
	struct stat info;
	const int fd = open(path, O_RDONLY | O_CLOEXEC);
	if (fd < 0)
		return NULL;
	uint8_t *data = NULL;
	size_t len = 0;
	if (fstat(fd, &info) == 0 && (S_ISREG(info.st_mode) ? info.st_size <= FILE_MAX : (errno = EISDIR, false)))
		data = malloc((size_t)info.st_size + 1);
	while (data && len < (size_t)info.st_size) {
		const ssize_t n = read(fd, data + len, (size_t)info.st_size - len);
		if (n <= 0)
			break;
		len += (size_t)n;
	}
	close(fd);
	*ret_len = len;
	return data;
}

static int load(const char *path, struct mesh *mesh)
{
	struct parse_error error = {0};
	char sentence[256];
	size_t len;
	uint8_t *data = read_file(path, &len);
	if (!data) {
		snprintf(sentence, sizeof(sentence), "cannot be read: %s", strerror(errno));
		return complain(path, sentence);
	}
	const int status = mesh_read_ply(data, len, mesh, &error);
	free(data);
	if (status == 0 && mesh->nt > 0)
		return 0;
	if (status == 0) {
		mesh_finish(mesh);
		return complain(path, "has points, but no faces; make a mesh of it with facet reconstruct");
	}
	if (status == -ENOMEM)
		return complain(path, "not enough memory for this mesh");
	if (error.line == 0)
		return complain(path, error.text);
	fprintf(stderr, "facet: %s:%u: %s\n", path, error.line, error.text);
	return 1;
}

static int draw(const struct job *job, const struct mesh *mesh)
{
	struct render_view view = job->view;
	struct picture picture;
	struct buffer png = {0};
	struct output_error error;
	if (job->auto_cut)
		view.cut_m = render_cut_height(mesh);
	int status = render_mesh(mesh, &view, &picture);
	if (status)
		return complain(job->input, status == -ENOMEM
		                                ? "not enough memory for this picture; choose a smaller --size"
		                                : "nothing lies below the cut; choose a higher --cut, or none");
	status = render_png(&picture, &png);
	picture_finish(&picture);
	if (status)
		complain(job->output, "not enough memory for this picture; choose a smaller --size");
	else if ((status = output_write(job->output, png.data, png.len, &error)) != 0)
		fprintf(stderr, "facet: %s\n", error.text);
	buffer_finish(&png);
	return status ? 1 : 0;
}

int picture_main(int argc, char **argv)
{
	static const struct argp argp = {options,
	                                 parse_option,
	                                 "MESH.ply -o OUT.png",
	                                 "A picture of a mesh, seen from above with the ceiling cut off.\v"
	                                 "Sides that no beam has seen are drawn as a thin veil.",
	                                 NULL,
	                                 NULL,
	                                 NULL};
	struct job job = {.view = {.width = 1600, .height = 1000, .yaw_rad = 60 * DEG, .pitch_rad = 55 * DEG},
	                  .auto_cut = true};
	struct output_error error;
	struct mesh mesh;
	argp_parse(&argp, argc, argv, 0, NULL, &job);
	if (output_check(job.output, &error)) {
		fprintf(stderr, "facet: %s\n", error.text);
		return 1;
	}
	if (load(job.input, &mesh))
		return 1;
	const int status = draw(&job, &mesh);
	mesh_finish(&mesh);
	return status;
}

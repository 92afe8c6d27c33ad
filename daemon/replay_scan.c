/* Scans of uos (scanNNN.3d with scanNNN.pose beside it) as a source of rows: no device's bytes are in them, so what comes out is
 * what `facet reconstruct` gives to its map, row by row, as a servo that steps would have measured it. */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>
#include <unistd.h>

#include "core/model.h"
#include "daemon/replay_source.h"
#include "daemon/scan_rows.h"

#define POSE_BYTES_MAX 4096

struct replay_source {
	const struct replay_file *file;
	struct uos_scan scan;
	struct scan_rows rows;
	bool begun;
};

static bool scan_found(const struct replay_file *file)
{
	const size_t n = strlen(file->path);

	return n > 3 && strcasecmp(file->path + n - 3, ".3d") == 0;
}

static int read_pose(const char *path, struct transform *ret, char error[REPLAY_SENTENCE_MAX])
{
	char beside[4096], text[POSE_BYTES_MAX];
	struct parse_error parse = {0};
	FILE *file;
	size_t n;

	snprintf(beside, sizeof(beside), "%.*s.pose", (int)(strlen(path) - 3), path);
	file = fopen(beside, "re");
	if (!file) {
		snprintf(error, REPLAY_SENTENCE_MAX, "there is no .pose beside it that says where it was measured");
		return -ENOENT;
	}
	n = fread(text, 1, sizeof(text), file);
	fclose(file);
	if (uos_read_pose(text, n, ret, &parse) == 0)
		return 0;
	snprintf(error, REPLAY_SENTENCE_MAX, "its .pose, line %u: %.150s", parse.line, parse.text);
	return -EINVAL;
}

static int scan_open(const struct replay_file *file, struct replay_source **ret, char error[REPLAY_SENTENCE_MAX])
{
	struct replay_source *s = calloc(1, sizeof(*s));

	(void)error;
	if (!s)
		return -ENOMEM;
	s->file = file;
	*ret = s;
	return 0;
}

static void scan_rewind(struct replay_source *s)
{
	scan_rows_finish(&s->rows);
	uos_finish(&s->scan);
	memset(&s->scan, 0, sizeof(s->scan));
	s->begun = false;
}

static void scan_close(struct replay_source *s)
{
	scan_rewind(s);
	free(s);
}

/* All defaults: it names no device, and the poses are in its files. */
static const char *scan_config(const struct replay_source *s, size_t *ret_len)
{
	static const char text[] = "map: {cell: 0.05}\n";

	(void)s;
	*ret_len = sizeof(text) - 1;
	return text;
}

/* Read when its turn comes: a folder may hold thousands. */
static int begin(struct replay_source *s, char error[REPLAY_SENTENCE_MAX])
{
	struct parse_error parse = {0};
	struct transform pose;
	int r = uos_read(s->file->data, s->file->len, &s->scan, &parse);

	s->begun = true;
	if (r < 0) {
		snprintf(error, REPLAY_SENTENCE_MAX, "line %u: %.150s", parse.line, parse.text);
		return r;
	}
	if (s->scan.rows == 0) {
		snprintf(error, REPLAY_SENTENCE_MAX,
		         "is a cloud without rows, not the raster of a tilted scanner: use facet reconstruct");
		return -EINVAL;
	}
	r = read_pose(s->file->path, &pose, error);
	return r < 0 ? r : scan_rows_begin(&s->rows, &s->scan, &pose, 0);
}

static int scan_next(struct replay_source *s, struct replay_event *ret, char error[REPLAY_SENTENCE_MAX])
{
	struct row *row;
	int r = s->begun ? 0 : begin(s, error);

	if (r < 0)
		return r;
	r = scan_rows_next(&s->rows, &row);
	if (r == 1)
		*ret = (struct replay_event){.kind = REPLAY_ROW,
		                             .log_ns = REPLAY_SCAN_NS / s->scan.rows * (int64_t)(s->rows.given - 1),
		                             .row = row};
	return r;
}

const struct replay_format replay_scan = {.name = "a scan",
                                          .order = REPLAY_TIMELESS,
                                          .is = scan_found,
                                          .open = scan_open,
                                          .close = scan_close,
                                          .config = scan_config,
                                          .next = scan_next,
                                          .rewind = scan_rewind};

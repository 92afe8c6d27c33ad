/* Plays recorded sweeps through the simulated devices, paced by their reader:
 *
 *   step; three answers at the new angle; measure one profile; send; wait until it is taken; three more answers; next
 *
 * so the servo stands while a profile is measured, whatever the reader's load, and every run gives the same rows. Three
 * answers where two would do in a quiet machine: a reader refuses an angle whose round trip was much slower than others,
 * and one of each side must be left. A sweep that begins with another pose first waits for as many of its datagrams, and
 * the sweep before it for as many of the old one. Nothing is skipped and nothing is played before streaming is asked for,
 * because only then is the scene asked whether it is ready. After the last line everything stands still.
 *
 * The recordings count up where the scanner looks up, as the servo does. A line has 360 ranges of a 361-beam raster: the
 * last beam is sent as "no valid value". Error codes are sent as they were. */
#include "tools/playback.h"

#include <dirent.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/model.h"
#include "core/text.h"
#include "core/trig.h"

#define SAMPLES    3 /* answers and pose datagrams that are waited for */
#define STEP_RAD   (0.5 * TRIG_DEG)
#define NO_VALUE   0x7FFF
#define FIRST_CODE 0x7FF7
#define FILE_MAX   (64 << 20)

enum phase { MOVED, STANDING, MEASURED, TAKEN, ENDED };

struct playback {
	struct playback_sweeps sweeps;
	int sweep;
	uint32_t line, taken;
	enum phase phase;
	bool pose_is_new;
	struct playback_seen since;
};

/* ---- words and beams ---- */

static const struct {
	uint16_t code;
	uint8_t state;
} code_state[] = {{0x7FFF, BEAM_NO_ECHO}, {0x7FFE, BEAM_DAZZLED},       {0x7FFD, BEAM_OVERFLOW},
                  {0x7FFB, BEAM_WEAK},    {0x7FFA, BEAM_CHANNEL_ERROR}, {0x7FF7, BEAM_BEYOND_MAX}};

static uint8_t state_of(uint16_t word)
{
	if (word < FIRST_CODE)
		return BEAM_OK;
	for (size_t i = 0; i < sizeof code_state / sizeof *code_state; i++)
		if (code_state[i].code == word)
			return code_state[i].state;
	return BEAM_RESERVED;
}

static uint16_t word_of(float range_m, uint8_t state)
{
	double mm = rint((double)range_m * 1000.0);

	for (size_t i = 0; i < sizeof code_state / sizeof *code_state; i++)
		if (code_state[i].state == state)
			return code_state[i].code;
	return (state == BEAM_OK || state == BEAM_OUT_OF_RANGE) && mm >= 0.0 && mm < FIRST_CODE ? (uint16_t)mm
	                                                                                        : NO_VALUE;
}

/* ---- files ---- */

static int refuse(char error[SCENARIO_ERROR_MAX], uint32_t line, const char *what)
{
	if (line)
		snprintf(error, SCENARIO_ERROR_MAX, "line %u: %s", line, what);
	else
		snprintf(error, SCENARIO_ERROR_MAX, "%s", what);
	return -EINVAL;
}

static struct playback_line *add_line(struct playback_sweep *sweep, double angle_rad)
{
	struct playback_line *line;

	if (sweep->n % 64 == 0) {
		line = realloc(sweep->line, (sweep->n + 64) * sizeof *line);
		if (!line)
			return NULL;
		sweep->line = line;
	}
	line = &sweep->line[sweep->n++];
	line->angle_rad = angle_rad;
	for (int k = 0; k < PLAYBACK_BEAMS; k++)
		line->word[k] = NO_VALUE;
	return line;
}

static int read_line(struct text *text, struct playback_sweep *sweep, char error[SCENARIO_ERROR_MAX])
{
	double tilt_deg, value[PLAYBACK_BEAMS + 1];
	struct playback_line *line;
	int n;

	if (!text_number(text, &tilt_deg) || !(fabs(tilt_deg) <= 180.0))
		return refuse(error, text->line, "expected a tilt in degrees, then ranges in millimetres");
	n = text_numbers(text, PLAYBACK_BEAMS + 1, value);
	if (!text_line_ended(text) || n < 2 || n > PLAYBACK_BEAMS)
		return refuse(error, text->line, "expected 2 to 361 ranges, 0.5 degree apart");
	if (sweep->n == PLAYBACK_LINES_MAX)
		return refuse(error, text->line, "a sweep has at most 4096 lines");
	line = add_line(sweep, tilt_deg * TRIG_DEG);
	if (!line)
		return -ENOMEM;
	for (int k = 0; k < n; k++) {
		if (!(value[k] >= 0.0 && value[k] <= NO_VALUE) || value[k] != floor(value[k]))
			return refuse(error, text->line, "a range is a whole number from 0 to 32767");
		line->word[k] = (uint16_t)value[k];
	}
	return 0;
}

int playback_read_csv(const char *data, size_t len, struct playback_sweep *ret, char error[SCENARIO_ERROR_MAX])
{
	struct text text;
	int r = 0;

	text_init(&text, data, len);
	while (!r && text_skip_empty(&text)) {
		r = read_line(&text, ret, error);
		text_next_line(&text);
	}
	if (!r && ret->n == 0)
		r = refuse(error, 0, "there is no line in it");
	return r;
}

static int take_row(const struct uos_row *row, struct playback_sweep *sweep)
{
	struct playback_line *line = add_line(sweep, -row->tilt_rad);

	if (!line)
		return -ENOMEM;
	for (uint32_t k = 0; k < row->n; k++) {
		double place = (row->first_rad + k * row->step_rad + 90.0 * TRIG_DEG) / STEP_RAD, nearest = rint(place);

		if (fabs(place - nearest) > 0.1 || nearest < 0.0 || nearest >= PLAYBACK_BEAMS)
			return -EINVAL;
		line->word[(int)nearest] = word_of(row->range_m[k], row->state[k]);
	}
	return 0;
}

int playback_read_uos(const char *data, size_t len, struct playback_sweep *ret, char error[SCENARIO_ERROR_MAX])
{
	struct parse_error why = {0};
	struct uos_scan scan = {0};
	int r = uos_read((const uint8_t *)data, len, &scan, &why);

	if (r)
		return refuse(error, why.line, why.text);
	if (scan.rows == 0 || scan.rows > PLAYBACK_LINES_MAX)
		r = refuse(error, 0, "it has no raster of profiles that a scanner could send");
	for (uint32_t i = 0; !r && i < scan.rows; i++) {
		r = take_row(&scan.row[i], ret);
		if (r == -EINVAL)
			refuse(error, 0, "its raster is not one of half degrees over 180 degrees");
	}
	uos_finish(&scan);
	return r;
}

/* The whole file, with a 0 behind it. */
static int slurp(const char *path, char **ret, size_t *ret_len)
{
	FILE *file = fopen(path, "rb");
	char *data = NULL;
	long size;
	int r = file ? 0 : -errno;

	if (!r && (fseek(file, 0, SEEK_END) < 0 || (size = ftell(file)) < 0 || size > FILE_MAX))
		r = -EFBIG;
	if (!r) {
		rewind(file);
		data = malloc((size_t)size + 1);
		r = !data ? -ENOMEM : fread(data, 1, (size_t)size, file) != (size_t)size ? -EIO : 0;
	}
	if (!r) {
		data[size] = '\0';
		*ret = data;
		*ret_len = (size_t)size;
	} else {
		free(data);
	}
	if (file)
		fclose(file);
	return r;
}

/* A rotation matrix as a quaternion; the branch with the largest part keeps the digits. */
static struct quat quat_of(const double r[9])
{
	double trace = r[0] + r[4] + r[8];
	struct quat q;

	if (trace > 0.0)
		q = (struct quat){trace + 1.0, r[7] - r[5], r[2] - r[6], r[3] - r[1]};
	else if (r[0] >= r[4] && r[0] >= r[8])
		q = (struct quat){r[7] - r[5], 1.0 + r[0] - r[4] - r[8], r[1] + r[3], r[2] + r[6]};
	else if (r[4] >= r[8])
		q = (struct quat){r[2] - r[6], r[1] + r[3], 1.0 - r[0] + r[4] - r[8], r[5] + r[7]};
	else
		q = (struct quat){r[3] - r[1], r[2] + r[6], r[5] + r[7], 1.0 - r[0] - r[4] + r[8]};
	return quat_normalise(q);
}

static int read_pose(const char *path, struct pose *ret, char error[SCENARIO_ERROR_MAX])
{
	struct parse_error why = {0};
	struct transform map_base;
	char *data;
	size_t len;
	int r = slurp(path, &data, &len);

	if (r) {
		snprintf(error, SCENARIO_ERROR_MAX, "%.200s: %s; a sweep needs its pose beside it", path, strerror(-r));
		return r;
	}
	r = uos_read_pose(data, len, &map_base, &why);
	free(data);
	if (r) {
		snprintf(error, SCENARIO_ERROR_MAX, "%.150s: line %u: %.120s", path, why.line, why.text);
		return r;
	}
	*ret = (struct pose){.position_m = map_base.t, .rotation = quat_of(map_base.r)};
	return 0;
}

/* `path` without `ending`, then ".pose". */
static int read_pose_beside(const char *path, const char *ending, struct pose *ret, char error[SCENARIO_ERROR_MAX])
{
	size_t len = strlen(path), cut = strlen(ending);
	char pose[4096];

	if (len < cut || strcmp(path + len - cut, ending) != 0)
		cut = strrchr(path, '.') ? strlen(strrchr(path, '.')) : 0;
	snprintf(pose, sizeof pose, "%.*s.pose", (int)(len - cut), path);
	return read_pose(pose, ret, error);
}

typedef int sweep_reader(const char *, size_t, struct playback_sweep *, char[SCENARIO_ERROR_MAX]);

static int load_sweep(const char *path, sweep_reader *read, const char *ending, struct playback_sweeps *ret,
                      char error[SCENARIO_ERROR_MAX])
{
	struct playback_sweep *sweep = &ret->sweep[ret->n];
	char why[SCENARIO_ERROR_MAX] = "";
	char *data;
	size_t len;
	int r;

	if (ret->n == PLAYBACK_SWEEPS) {
		snprintf(error, SCENARIO_ERROR_MAX, "at most %d sweeps are played at a time", PLAYBACK_SWEEPS);
		return -EINVAL;
	}
	r = slurp(path, &data, &len);
	if (r) {
		snprintf(error, SCENARIO_ERROR_MAX, "%.200s: %s", path, strerror(-r));
		return r;
	}
	ret->n++;
	r = read(data, len, sweep, why);
	free(data);
	if (r) {
		snprintf(error, SCENARIO_ERROR_MAX, "%.150s: %.140s", path, r == -ENOMEM ? "out of memory" : why);
		return r;
	}
	ret->lines += sweep->n;
	return read_pose_beside(path, ending, &sweep->pose, error);
}

static int is_scan(const struct dirent *entry)
{
	size_t len = strlen(entry->d_name);

	return len > 7 && !strncmp(entry->d_name, "scan", 4) && !strcmp(entry->d_name + len - 3, ".3d");
}

static int load_uos(const char *dir, struct playback_sweeps *ret, char error[SCENARIO_ERROR_MAX])
{
	struct dirent **entry;
	int n = scandir(dir, &entry, is_scan, alphasort), r = 0;

	if (n <= 0) {
		snprintf(error, SCENARIO_ERROR_MAX, "%.200s: %s", dir,
		         n < 0 ? strerror(errno) : "there is no scanNNN.3d in it");
		if (n == 0)
			free(entry);
		return -EINVAL;
	}
	for (int i = 0; i < n; i++) {
		char path[4096];

		snprintf(path, sizeof path, "%.3000s/%s", dir, entry[i]->d_name);
		if (!r)
			r = load_sweep(path, playback_read_uos, ".3d", ret, error);
		free(entry[i]);
	}
	free(entry);
	return r;
}

int playback_load(const char *source, char *const *more, int n, struct playback_sweeps *ret,
                  char error[SCENARIO_ERROR_MAX])
{
	int r;

	memset(ret, 0, sizeof *ret);
	if (!strncmp(source, "uos:", 4)) {
		r = load_uos(source + 4, ret, error);
	} else {
		r = load_sweep(source + strlen("profiles:"), playback_read_csv, "_profiles.csv", ret, error);
		for (int i = 0; !r && i < n; i++)
			r = load_sweep(more[i], playback_read_csv, "_profiles.csv", ret, error);
	}
	if (r)
		playback_finish(ret);
	return r;
}

void playback_finish(struct playback_sweeps *sweeps)
{
	for (int i = 0; i < sweeps->n; i++)
		free(sweeps->sweep[i].line);
	memset(sweeps, 0, sizeof *sweeps);
}

/* ---- pacing ---- */

struct playback *playback_create(struct playback_sweeps *sweeps)
{
	struct playback *p = calloc(1, sizeof *p);

	if (!p)
		return NULL;
	p->sweeps = *sweeps;
	memset(sweeps, 0, sizeof *sweeps);
	p->pose_is_new = true;
	p->phase = MOVED;
	return p;
}

void playback_destroy(struct playback *p)
{
	if (p)
		playback_finish(&p->sweeps);
	free(p);
}

static const struct playback_line *line_of(const struct playback *p)
{
	return &p->sweeps.sweep[p->sweep].line[p->line];
}

double playback_angle(const struct playback *p)
{
	return line_of(p)->angle_rad;
}

struct pose playback_pose(const struct playback *p)
{
	return p->sweeps.sweep[p->sweep].pose;
}

static bool is_last_of_sweep(const struct playback *p)
{
	return p->line + 1 == p->sweeps.sweep[p->sweep].n;
}

static bool seen_enough(const struct playback *p, struct playback_seen seen, bool poses)
{
	return seen.answers - p->since.answers >= SAMPLES && (!poses || seen.poses - p->since.poses >= SAMPLES);
}

bool playback_advance(struct playback *p, struct playback_seen seen)
{
	if (p->phase != TAKEN || !seen_enough(p, seen, is_last_of_sweep(p)))
		return false;
	p->pose_is_new = is_last_of_sweep(p);
	if (!p->pose_is_new) {
		p->line++;
	} else if (p->sweep + 1 < p->sweeps.n) {
		p->sweep++;
		p->line = 0;
	} else {
		p->phase = ENDED;
		return false;
	}
	p->phase = MOVED;
	return true;
}

void playback_placed(struct playback *p, struct playback_seen seen)
{
	if (p->phase != MOVED)
		return;
	p->since = seen;
	p->phase = STANDING;
}

bool playback_ready(const struct playback *p, struct playback_seen seen)
{
	return p->phase == STANDING && seen_enough(p, seen, p->pose_is_new);
}

void playback_scan(struct playback *p, struct profile *profile)
{
	const struct playback_line *line = line_of(p);

	for (int k = 0; k < profile->n; k++) {
		double place = (profile->first_rad + k * profile->step_rad + 90.0 * TRIG_DEG) / STEP_RAD,
		       nearest = rint(place);
		bool there = fabs(place - nearest) < 0.1 && nearest >= 0.0 && nearest < PLAYBACK_BEAMS;
		uint16_t word = there ? line->word[(int)nearest] : NO_VALUE;

		profile->state[k] = state_of(word);
		profile->range_m[k] = profile->state[k] == BEAM_OK ? (float)word / 1000.0f : 0.0f;
	}
	if (p->phase == STANDING)
		p->phase = MEASURED;
}

void playback_taken(struct playback *p, struct playback_seen seen)
{
	if (p->phase != MEASURED)
		return;
	p->taken++;
	p->since = seen;
	p->phase = TAKEN;
}

void playback_lost(struct playback *p, struct playback_seen seen)
{
	if (p->phase != MEASURED)
		return;
	p->since = seen;
	p->phase = STANDING;
}

bool playback_ended(const struct playback *p)
{
	return p->phase == ENDED;
}

uint32_t playback_lines(const struct playback *p)
{
	return p->taken;
}

/* ---- the stage ---- */

struct theatre {
	struct playback *playback;
	struct sim_servo *servo;
	uint64_t poses;
};

static struct playback_seen seen_by(const struct theatre *t)
{
	return (struct playback_seen){.answers = sim_servo_answers(t->servo), .poses = t->poses};
}

static void go_on(struct theatre *t)
{
	if (!playback_advance(t->playback, seen_by(t)))
		return;
	sim_servo_place(t->servo, playback_angle(t->playback));
	playback_placed(t->playback, seen_by(t));
}

static bool stage_ready(void *ctx, int64_t t_ns)
{
	struct theatre *t = ctx;

	(void)t_ns;
	go_on(t);
	return playback_ready(t->playback, seen_by(t));
}

static void stage_scan(void *ctx, struct profile *profile)
{
	playback_scan(((struct theatre *)ctx)->playback, profile);
}

static void stage_taken(void *ctx, int64_t t_ns)
{
	struct theatre *t = ctx;

	(void)t_ns;
	playback_taken(t->playback, seen_by(t));
}

static void stage_lost(void *ctx, int64_t t_ns)
{
	struct theatre *t = ctx;

	(void)t_ns;
	playback_lost(t->playback, seen_by(t));
}

static struct pose stage_pose(void *ctx, int64_t t_ns)
{
	struct theatre *t = ctx;

	(void)t_ns;
	go_on(t);
	return playback_pose(t->playback);
}

static void stage_pose_sent(void *ctx)
{
	((struct theatre *)ctx)->poses++;
}

static bool stage_ended(void *ctx, int64_t t_ns, char said[80])
{
	struct theatre *t = ctx;

	(void)t_ns;
	go_on(t);
	if (!playback_ended(t->playback))
		return false;
	snprintf(said, 80, "played %u lines", playback_lines(t->playback));
	return true;
}

static void stage_join(void *ctx, const struct stage_axis *axis, struct sim_servo *servo)
{
	struct theatre *t = ctx;

	(void)axis;
	t->servo = servo;
	playback_placed(t->playback, seen_by(t));
}

static void stage_destroy(void *ctx)
{
	struct theatre *t = ctx;

	playback_destroy(t->playback);
	free(t);
}

int playback_stage(const char *source, char *const *more, int n, struct stage *ret, char error[SCENARIO_ERROR_MAX])
{
	struct theatre *t = calloc(1, sizeof *t);
	struct playback_sweeps sweeps;
	int r;

	snprintf(error, SCENARIO_ERROR_MAX, "out of memory");
	if (!t)
		return -ENOMEM;
	r = playback_load(source, more, n, &sweeps, error);
	if (!r) {
		t->playback = playback_create(&sweeps);
		r = t->playback ? 0 : -ENOMEM;
	}
	if (r) {
		free(t);
		return r;
	}
	*ret = (struct stage){
	    .ctx = t,
	    .scene = {.ctx = t, .scan = stage_scan, .ready = stage_ready, .taken = stage_taken, .lost = stage_lost},
	    .angle_rad = playback_angle(t->playback),
	    .join = stage_join,
	    .pose = stage_pose,
	    .pose_sent = stage_pose_sent,
	    .ended = stage_ended,
	    .destroy = stage_destroy};
	return 0;
}

/* Counts are judged before anything is read by them. Where the old form of ROBOTLASER leaves the remissions out, the number of
 * numbers up to the host's name tells. */
#include "core/carmen_lines.h"

#include <math.h>
#include <string.h>

#include "core/text.h"
#include "core/trig.h"

#define PI          3.14159265358979323846
#define NUMBERS_MAX (2 * PROFILE_BEAMS_MAX + 32)
#define FAR_M       1e6
#define ROBOT_TAIL  11 /* laser pose, robot pose, tv, rv, safety distances, turn axis */
#define SECONDS_MAX 4e9

struct row_of_numbers {
	struct text text;
	int left;
};

static bool is_name(const char *name, const char *const *names)
{
	for (; *names; names++)
		if (strcmp(name, *names) == 0)
			return true;
	return false;
}

/* The first word; false where there is none, or a comment. */
static bool take_name(struct text *text, char ret[CARMEN_NAME_MAX])
{
	size_t n = 0;

	while (text->at < text->end && (*text->at == ' ' || *text->at == '\t'))
		text->at++;
	while (text->at + n < text->end && (unsigned char)text->at[n] > ' ')
		n++;
	if (n == 0 || n >= CARMEN_NAME_MAX || *text->at == '#')
		return false;
	memcpy(ret, text->at, n);
	ret[n] = 0;
	text->at += n;
	return true;
}

static int count_numbers(struct text text)
{
	double value;
	int n = 0;

	while (n < NUMBERS_MAX && text_number(&text, &value))
		n++;
	return n;
}

static bool take(struct row_of_numbers *row, double *ret)
{
	if (row->left == 0 || !text_number(&row->text, ret) || !isfinite(*ret))
		return false;
	row->left--;
	return true;
}

static bool take_all(struct row_of_numbers *row, int n, double *ret)
{
	for (int i = 0; i < n; i++)
		if (!take(row, &ret[i]))
			return false;
	return true;
}

/* A count of as many numbers as are there, with `more` behind them. */
static bool take_count(struct row_of_numbers *row, int most, int more, uint32_t *ret)
{
	double n;

	if (!take(row, &n) || !(n >= 0 && n <= most) || n != floor(n) || (int)n + more > row->left)
		return false;
	*ret = (uint32_t)n;
	return true;
}

static bool take_ranges(struct row_of_numbers *row, struct carmen_line *ret)
{
	double range;

	for (uint32_t i = 0; i < ret->n; i++) {
		if (!take(row, &range) || !(range >= 0 && range < FAR_M))
			return false;
		ret->range_m[i] = (float)range;
	}
	return ret->n > 0;
}

static bool take_pose(struct row_of_numbers *row, struct carmen_line *ret)
{
	double v[3];

	if (!take_all(row, 3, v) || fabs(v[0]) > FAR_M || fabs(v[1]) > FAR_M || fabs(v[2]) > 1e3)
		return false;
	ret->has_pose = true;
	ret->x_m = v[0];
	ret->y_m = v[1];
	ret->theta_rad = v[2];
	return true;
}

static bool old_laser(struct row_of_numbers *row, struct carmen_line *ret)
{
	double odometry[3];

	if (!take_count(row, PROFILE_BEAMS_MAX, 6, &ret->n) || !take_ranges(row, ret) || !take_pose(row, ret) ||
	    !take_all(row, 3, odometry))
		return false;
	/* Half a circle; 180 and 360 values lack the last one of 181 and 361. */
	ret->step_rad = ret->n > 1 ? PI / (double)(ret->n % 2 ? ret->n - 1 : ret->n) : PI;
	ret->first_rad = -PI / 2;
	ret->max_range_m = 0;
	return true;
}

static bool laser_head(struct row_of_numbers *row, struct carmen_line *ret)
{
	double v[7]; /* type, start, field of view, step, maximum, accuracy, mode of remission */

	if (!take_all(row, 7, v) || !(fabs(v[1]) <= 4 * PI) || !(v[3] > 0 && v[3] <= PI) || !(v[4] >= 0))
		return false;
	ret->first_rad = v[1];
	ret->step_rad = v[3];
	ret->max_range_m = v[4];
	return take_count(row, PROFILE_BEAMS_MAX, 0, &ret->n) && take_ranges(row, ret);
}

/* `tail`: numbers that follow them, the time not counted. */
static bool skip_remissions(struct row_of_numbers *row, int tail)
{
	struct row_of_numbers ahead = *row;
	double value;
	uint32_t m;

	if (!take_count(&ahead, PROFILE_BEAMS_MAX, tail, &m) || ahead.left - (int)m != tail + 1)
		return row->left == tail + 1;
	for (uint32_t i = 0; i < m; i++)
		if (!take(&ahead, &value))
			return false;
	*row = ahead;
	return true;
}

static bool robot_laser(struct row_of_numbers *row, struct carmen_line *ret)
{
	double v[5];

	return laser_head(row, ret) && skip_remissions(row, ROBOT_TAIL) && take_all(row, 3, v) && take_pose(row, ret) &&
	       take_all(row, 5, v);
}

static bool raw_laser(struct row_of_numbers *row, struct carmen_line *ret)
{
	return laser_head(row, ret) && skip_remissions(row, 0);
}

static bool odometry(struct row_of_numbers *row, struct carmen_line *ret)
{
	double v[3];

	return take_pose(row, ret) && take_all(row, 3, v);
}

static bool pan_tilt(struct row_of_numbers *row, struct carmen_line *ret)
{
	double v[2];

	if (!take_all(row, 2, v) || fabs(v[0]) > 1e3 || fabs(v[1]) > 1e3)
		return false;
	ret->pan_rad = v[0];
	ret->tilt_rad = v[1];
	return true;
}

/* T host t: what ends every line. */
static bool take_times(struct row_of_numbers *row, struct carmen_line *ret)
{
	struct text *text = &row->text;
	const char *from;

	while (text->at < text->end && (*text->at == ' ' || *text->at == '\t'))
		text->at++;
	from = text->at;
	if (!take(row, &ret->time_s) || !(ret->time_s >= 0 && ret->time_s < SECONDS_MAX))
		return false;
	ret->coarse = memchr(from, 'e', (size_t)(text->at - from)) || memchr(from, 'E', (size_t)(text->at - from));
	while (text->at < text->end && (*text->at == ' ' || *text->at == '\t'))
		text->at++;
	while (text->at < text->end && (unsigned char)*text->at > ' ')
		text->at++;
	if (!text_number(text, &ret->logger_s) || !(ret->logger_s >= 0 && ret->logger_s < SECONDS_MAX))
		ret->logger_s = -1; /* a log that another program wrote */
	return true;
}

enum carmen_kind carmen_read(const char *line, size_t len, struct carmen_line *ret)
{
	static const char *const old[] = {"FLASER", "RLASER", NULL};
	static const char *const robot[] = {"ROBOTLASER1", "ROBOTLASER2", NULL};
	static const char *const raw[] = {"RAWLASER1", "RAWLASER2", "RAWLASER3", "RAWLASER4", NULL};
	enum carmen_kind kind = CARMEN_LASER;
	struct row_of_numbers row;
	bool good;

	text_init(&row.text, line, len);
	ret->has_pose = false;
	ret->name[0] = 0;
	if (!take_name(&row.text, ret->name))
		return CARMEN_OTHER;
	row.left = count_numbers(row.text);
	if (is_name(ret->name, old)) {
		good = old_laser(&row, ret);
	} else if (is_name(ret->name, robot)) {
		good = robot_laser(&row, ret);
	} else if (is_name(ret->name, raw)) {
		good = raw_laser(&row, ret);
	} else if (strcmp(ret->name, "ODOM") == 0) {
		kind = CARMEN_ODOM;
		good = odometry(&row, ret);
	} else if (strcmp(ret->name, "PANTILT") == 0) {
		kind = CARMEN_PANTILT;
		good = pan_tilt(&row, ret);
	} else {
		return CARMEN_OTHER;
	}
	return good && take_times(&row, ret) ? kind : CARMEN_BAD;
}

/* The pose line: see pose_line.h. jansson parses (its depth and the datagram's length are bounded); what the numbers
 * may be is judged here, because a JSON parser takes any. */
#include "drivers/pose_line.h"

#include <errno.h>
#include <jansson.h>
#include <math.h>
#include <stdio.h>

#define UNIT_TOLERANCE 1e-3

static bool numbers(const json_t *array, size_t n, double *ret)
{
	if (json_array_size(array) != n) /* 0 for what is no array */
		return false;
	for (size_t i = 0; i < n; i++) {
		const json_t *item = json_array_get(array, i);

		if (!json_is_number(item))
			return false;
		ret[i] = json_number_value(item);
	}
	return true;
}

static bool near_enough(double v)
{
	return fabs(v) <= POSE_LINE_FAR_M; /* false for NaN */
}

static enum pose_line_verdict judge_time(const json_t *root, int64_t t_ns, int64_t *ret_ns)
{
	const json_t *t = json_object_get(root, "t");
	double t_s, late_s;

	*ret_ns = t_ns;
	if (!t)
		return POSE_LINE_OK;
	if (!json_is_number(t))
		return POSE_LINE_MALFORMED;
	t_s = json_number_value(t);
	late_s = (double)t_ns * 1e-9 - t_s;
	if (!(fabs(late_s) <= POSE_LINE_LATE_NS * 1e-9))
		return POSE_LINE_TIME;
	/* Whole seconds apart: their product with 1e9 has more bits than a double. */
	*ret_ns = (int64_t)floor(t_s) * 1000000000 + (int64_t)rint((t_s - floor(t_s)) * 1e9);
	return POSE_LINE_OK;
}

#define SQUARE_MAX 1e12 /* m2, rad2: nobody who knows so little says a pose */

/* The largest variance along any axis of the plane, and that of the heading. */
static enum pose_line_verdict judge_covariance(const json_t *root, struct pose *ret)
{
	const json_t *covariance = json_object_get(root, "covariance");
	const size_t n = json_array_size(covariance);
	double c[36], xx, xy, yy, turn, half;

	if (!covariance)
		return POSE_LINE_OK;
	if ((n != 36 && n != 6) || !numbers(covariance, n, c))
		return POSE_LINE_COVARIANCE;
	if (c[0] == -1)
		return POSE_LINE_OK;
	xx = c[0];
	xy = n == 36 ? c[1] : 0;
	yy = n == 36 ? c[7] : c[1];
	turn = n == 36 ? c[35] : c[5];
	if (!(xx >= 0 && xx <= SQUARE_MAX && yy >= 0 && yy <= SQUARE_MAX && turn >= 0 && turn <= SQUARE_MAX &&
	      fabs(xy) <= SQUARE_MAX))
		return POSE_LINE_COVARIANCE;
	half = (xx - yy) / 2;
	ret->variance_m2 = (xx + yy) / 2 + sqrt(half * half + xy * xy);
	ret->variance_rad2 = turn;
	return POSE_LINE_OK;
}

static enum pose_line_verdict judge(const json_t *root, int64_t t_ns, struct pose *ret)
{
	enum pose_line_verdict verdict;
	double p[3], q[4], length;
	struct pose pose = {0};

	if (!json_is_object(root) || !numbers(json_object_get(root, "position"), 3, p) ||
	    !numbers(json_object_get(root, "orientation"), 4, q))
		return POSE_LINE_MALFORMED;
	if (!near_enough(p[0]) || !near_enough(p[1]) || !near_enough(p[2]))
		return POSE_LINE_FAR;
	length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
	if (!(fabs(length - 1.0) <= UNIT_TOLERANCE))
		return POSE_LINE_NOT_UNIT;
	verdict = judge_time(root, t_ns, &pose.t_ns);
	if (verdict == POSE_LINE_OK)
		verdict = judge_covariance(root, &pose);
	if (verdict != POSE_LINE_OK)
		return verdict;
	pose.position_m = (struct vec3){p[0], p[1], p[2]};
	pose.rotation = (struct quat){.w = q[3] / length, .x = q[0] / length, .y = q[1] / length, .z = q[2] / length};
	*ret = pose;
	return POSE_LINE_OK;
}

enum pose_line_verdict pose_line_parse(const char *text, size_t len, int64_t t_ns, struct pose *ret)
{
	enum pose_line_verdict verdict = POSE_LINE_MALFORMED;
	json_t *root;

	if (len > POSE_LINE_MAX)
		return POSE_LINE_LONG;
	root = json_loadb(text, len, JSON_REJECT_DUPLICATES, NULL);
	if (root)
		verdict = judge(root, t_ns, ret);
	json_decref(root);
	return verdict;
}

int pose_line_print(const struct pose *pose, char *ret, size_t cap)
{
	const struct vec3 *p = &pose->position_m;
	const struct quat *q = &pose->rotation;
	int64_t s = pose->t_ns / 1000000000, ns = pose->t_ns % 1000000000;
	char covariance[120] = "";
	int n;

	if (pose->variance_m2 > 0 || pose->variance_rad2 > 0)
		snprintf(covariance, sizeof(covariance), ", \"covariance\": [%.17g, %.17g, 0, 0, 0, %.17g]",
		         pose->variance_m2, pose->variance_m2, pose->variance_rad2);
	n = snprintf(ret, cap,
	             "{\"t\": %lld.%09lld, \"position\": [%.17g, %.17g, %.17g], "
	             "\"orientation\": [%.17g, %.17g, %.17g, %.17g]%s}\n",
	             (long long)s, (long long)ns, p->x, p->y, p->z, q->x, q->y, q->z, q->w, covariance);

	return n < 0 || (size_t)n >= cap ? -ENOSPC : n;
}

const char *pose_line_name(enum pose_line_verdict verdict)
{
	static const char *const name[POSE_LINE_VERDICTS] = {"poses",    "too long", "malformed", "far",
	                                                     "not unit", "time",     "covariance"};

	return name[verdict];
}

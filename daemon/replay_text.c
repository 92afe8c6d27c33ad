/* Logs that are text, as sources: candump logs, CARMEN logs, poses as JSON lines. Each line becomes the bytes that its device's
 * decoder knows: a frame an entry of can_wire.h, for every device on that interface; a CARMEN line itself; a pose the
 * datagram of pose_line.h. A line that is none of its kind is counted and left out. */
#include <errno.h>
#include <jansson.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/carmen_lines.h"
#include "core/trig.h"
#include "daemon/replay_source.h"
#include "drivers/candump.h"
#include "drivers/pose_line.h"

#define LINE_MAX_BYTES (1u << 20)
#define LOOKED_AT      20 /* lines by which a file is recognised */

struct replay_source {
	struct replay_file file;
	size_t at;
	const struct config *config;

	/* Records of the line at hand that are still to be told. */
	struct record due[CONFIG_DEVICES_MAX + 1];
	int first, n;
	uint8_t bytes[CAN_WIRE_ENTRY_FD];
	char pose[POSE_LINE_MAX];

	uint64_t lines, bad, strangers, told;
	bool by_logger; /* CARMEN: the times of messages are of no use */
	bool odometry;  /* CARMEN: poses are ODOM's */
	bool single;    /* candump: one interface only */
	struct carmen_line carmen;
	char interface[CANDUMP_INTERFACE_MAX];
};

bool replay_line(const struct replay_file *file, size_t *at, const char **ret_line, size_t *ret_len)
{
	const char *line = (const char *)file->data + *at, *end;
	size_t left = file->len - *at;

	if (left == 0)
		return false;
	end = memchr(line, '\n', left);
	*ret_line = line;
	*ret_len = end ? (size_t)(end - line) : left;
	*at += *ret_len + (end != NULL);
	if (*ret_len > LINE_MAX_BYTES)
		*ret_len = LINE_MAX_BYTES;
	return true;
}

int replay_pose_device(const struct config *config)
{
	for (int i = 0; i < config->devices; i++)
		if (strcmp(config->device[i].driver, "pose") == 0 && !config->device[i].fixed)
			return i;
	return -1;
}

static int text_open(const struct replay_file *file, struct replay_source **ret, char error[REPLAY_SENTENCE_MAX])
{
	struct replay_source *s = calloc(1, sizeof(*s));

	(void)error;
	if (!s)
		return -ENOMEM;
	s->file = *file;
	*ret = s;
	return 0;
}

static void text_close(struct replay_source *s)
{
	free(s);
}

static void text_rewind(struct replay_source *s)
{
	s->at = 0;
	s->n = s->first = 0;
	s->lines = s->bad = s->strangers = s->told = 0;
}

static void due(struct replay_source *s, int device, int64_t t_ns, const void *bytes, size_t len)
{
	if (s->n <= CONFIG_DEVICES_MAX)
		s->due[s->n++] = (struct record){t_ns, t_ns, device, FROM_DEVICE, bytes, len};
}

/* Puts what one line says into `due`. */
typedef void line_reader(struct replay_source *, const char *line, size_t len);

static int text_next(struct replay_source *s, line_reader *reader, struct replay_event *ret)
{
	const char *line;
	size_t len;

	while (s->first == s->n) {
		s->first = s->n = 0;
		if (!replay_line(&s->file, &s->at, &line, &len))
			return 0;
		s->lines++;
		reader(s, line, len);
	}
	*ret = (struct replay_event){.kind = REPLAY_RECORD, .record = s->due[s->first++]};
	ret->log_ns = ret->record.log_ns;
	s->told++;
	return 1;
}

static bool text_span(struct replay_source *s, line_reader *reader, int64_t *ret_first_ns, int64_t *ret_last_ns)
{
	struct replay_event event;
	bool found = false;

	text_rewind(s);
	while (text_next(s, reader, &event) == 1) {
		if (!found || event.log_ns < *ret_first_ns)
			*ret_first_ns = event.log_ns;
		if (!found || event.log_ns > *ret_last_ns)
			*ret_last_ns = event.log_ns;
		found = true;
	}
	return found;
}

static int refuse(char error[REPLAY_SENTENCE_MAX], const char *sentence)
{
	snprintf(error, REPLAY_SENTENCE_MAX, "%s", sentence);
	return -EINVAL;
}

static void text_note(const struct replay_source *s, char ret[REPLAY_SENTENCE_MAX])
{
	*ret = 0;
	if (s->bad)
		snprintf(ret, REPLAY_SENTENCE_MAX, "%llu of %llu lines are damaged and were left out",
		         (unsigned long long)s->bad, (unsigned long long)s->lines);
}

/* candump */

static bool candump_found(const struct replay_file *file)
{
	struct candump_line found;
	const char *line;
	size_t at = 0, len;

	for (int i = 0; i < LOOKED_AT && replay_line(file, &at, &line, &len); i++)
		if (candump_read(line, len, &found) == CANDUMP_FRAME)
			return true;
	return false;
}

/* Sockets that carry frames have no interface's name: such a device hears a log of one interface. */
static bool hears(const struct replay_source *s, const struct config_device *device, const char *interface)
{
	static const char *const driver[] = {"can", "canopen", "odometry"};

	for (size_t i = 0; i < sizeof(driver) / sizeof(*driver); i++)
		if (strcmp(device->driver, driver[i]) == 0)
			return strcmp(device->connect, interface) == 0 ||
			       (s->single && strncmp(device->connect, "unix:", 5) == 0);
	return false;
}

static void candump_line(struct replay_source *s, const char *line, size_t len)
{
	struct candump_line found;
	const enum candump_kind kind = candump_read(line, len, &found);
	size_t n;

	s->bad += kind == CANDUMP_BAD || (kind == CANDUMP_FRAME && !found.timed);
	if (kind != CANDUMP_FRAME || !found.timed)
		return;
	n = can_wire_put(&found.frame, s->bytes);
	for (int i = 0; i < s->config->devices; i++)
		if (hears(s, &s->config->device[i], found.interface))
			due(s, i, found.frame.t_ns, s->bytes, n);
	s->strangers += s->n == 0;
}

static int candump_next(struct replay_source *s, struct replay_event *ret, char error[REPLAY_SENTENCE_MAX])
{
	(void)error;
	return text_next(s, candump_line, ret);
}

static bool candump_span(struct replay_source *s, int64_t *ret_first_ns, int64_t *ret_last_ns)
{
	return text_span(s, candump_line, ret_first_ns, ret_last_ns);
}

static int candump_use(struct replay_source *s, const struct config *config, char error[REPLAY_SENTENCE_MAX])
{
	struct candump_line found;
	const char *line;
	size_t at = 0, len;
	int64_t first_ns = 0, last_ns = 0;
	bool timed = false;

	s->config = config;
	s->single = true;
	while (replay_line(&s->file, &at, &line, &len))
		if (candump_read(line, len, &found) == CANDUMP_FRAME) {
			timed |= found.timed;
			if (!*s->interface)
				memcpy(s->interface, found.interface, sizeof(s->interface));
			s->single &= strcmp(s->interface, found.interface) == 0;
		}
	if (!timed)
		return refuse(error, "its lines have no times: record with candump -L (or -l, -ta)");
	if (candump_span(s, &first_ns, &last_ns))
		return 0;
	snprintf(error, REPLAY_SENTENCE_MAX,
	         "no device of the configuration is on %s: give a can, canopen or odometry device `connect: %s`",
	         s->interface, s->interface);
	return -EINVAL;
}

static void candump_note(const struct replay_source *s, char ret[REPLAY_SENTENCE_MAX])
{
	text_note(s, ret);
	if (!s->bad && s->strangers)
		snprintf(ret, REPLAY_SENTENCE_MAX, "%llu of %llu frames are on interfaces of no device",
		         (unsigned long long)s->strangers, (unsigned long long)s->lines);
}

const struct replay_format replay_candump = {.name = "a candump log",
                                             .order = REPLAY_MERGED,
                                             .is = candump_found,
                                             .open = text_open,
                                             .close = text_close,
                                             .use = candump_use,
                                             .span = candump_span,
                                             .next = candump_next,
                                             .rewind = text_rewind,
                                             .note = candump_note};

/* CARMEN */

static bool carmen_found(const struct replay_file *file)
{
	static struct carmen_line found;
	const char *line;
	size_t at = 0, len;

	for (int i = 0; i < LOOKED_AT * 10 && replay_line(file, &at, &line, &len); i++)
		if (carmen_read(line, len, &found) <= CARMEN_PANTILT)
			return true;
	return false;
}

static void carmen_pose(struct replay_source *s, int64_t t_ns)
{
	const int device = replay_pose_device(s->config);
	const double half = s->carmen.theta_rad / 2;
	const struct pose pose = {.t_ns = t_ns,
	                          .position_m = {s->carmen.x_m, s->carmen.y_m, 0},
	                          .rotation = {trig_cos(half), 0, 0, trig_sin(half)}};
	int n = device < 0 ? 0 : pose_line_print(&pose, s->pose, sizeof(s->pose));

	if (n > 0)
		due(s, device, t_ns, s->pose, (size_t)n);
}

static void carmen_line(struct replay_source *s, const char *line, size_t len)
{
	const enum carmen_kind kind = carmen_read(line, len, &s->carmen);
	int64_t t_ns;

	s->bad += kind == CARMEN_BAD;
	if (kind > CARMEN_PANTILT || (s->by_logger && s->carmen.logger_s < 0))
		return;
	t_ns = (int64_t)((s->by_logger ? s->carmen.logger_s : s->carmen.time_s) * 1e9);
	if (s->carmen.has_pose && s->odometry == (kind == CARMEN_ODOM))
		carmen_pose(s, t_ns);
	if (kind == CARMEN_ODOM)
		return;
	for (int i = 0; i < s->config->devices; i++)
		if (strcmp(s->config->device[i].driver, "carmen") == 0)
			due(s, i, t_ns, line, len);
}

static int carmen_next(struct replay_source *s, struct replay_event *ret, char error[REPLAY_SENTENCE_MAX])
{
	(void)error;
	return text_next(s, carmen_line, ret);
}

static bool carmen_span(struct replay_source *s, int64_t *ret_first_ns, int64_t *ret_last_ns)
{
	return text_span(s, carmen_line, ret_first_ns, ret_last_ns);
}

/* Which times and which poses it has is seen by its lasers. */
static int carmen_use(struct replay_source *s, const struct config *config, char error[REPLAY_SENTENCE_MAX])
{
	const char *line;
	size_t at = 0, len;
	uint64_t lasers = 0, coarse = 0, logged = 0, placed = 0;
	bool any = false;

	s->config = config;
	for (int i = 0; i < config->devices; i++)
		any |= strcmp(config->device[i].driver, "carmen") == 0;
	if (!any)
		return refuse(error,
		              "the configuration has no device for it: add {name: laser, driver: carmen, tilt: laser}");
	while (replay_line(&s->file, &at, &line, &len))
		if (carmen_read(line, len, &s->carmen) == CARMEN_LASER) {
			lasers++;
			coarse += s->carmen.coarse;
			logged += s->carmen.logger_s >= 0;
			placed += s->carmen.has_pose;
		}
	if (lasers == 0)
		return refuse(error, "no laser's messages are in it (FLASER, ROBOTLASER1, RAWLASER1)");
	s->by_logger = coarse > 0;
	s->odometry = placed == 0;
	if (s->by_logger && logged < lasers)
		return refuse(error, "its times were printed with 6 digits and are of no use, and the logger's own are "
		                     "missing at the ends of its lines: log it anew");
	return 0;
}

const struct replay_format replay_carmen = {.name = "a CARMEN log",
                                            .order = REPLAY_MERGED,
                                            .is = carmen_found,
                                            .open = text_open,
                                            .close = text_close,
                                            .use = carmen_use,
                                            .span = carmen_span,
                                            .next = carmen_next,
                                            .rewind = text_rewind,
                                            .note = text_note};

/* Poses */

/* `t` of a pose; negative: none is said. */
static bool pose_time(const char *line, size_t len, int64_t *ret_ns)
{
	json_t *json = len <= POSE_LINE_MAX ? json_loadb(line, len, JSON_REJECT_DUPLICATES, NULL) : NULL;
	const json_t *t = json_object_get(json, "t");
	const double seconds = json_number_value(t);
	const bool good = json_is_number(t) && json_object_get(json, "position") && seconds >= 0 && seconds < 4e9;

	if (good)
		*ret_ns = (int64_t)(seconds * 1e9);
	json_decref(json);
	return good;
}

static bool poses_found(const struct replay_file *file)
{
	const char *line;
	size_t at = 0, len;
	int64_t t_ns;

	for (int i = 0; i < LOOKED_AT && replay_line(file, &at, &line, &len); i++)
		if (len > 0 && *line == '{' && pose_time(line, len, &t_ns))
			return true;
	return false;
}

static void poses_line(struct replay_source *s, const char *line, size_t len)
{
	int64_t t_ns;

	if (len == 0)
		return;
	if (pose_time(line, len, &t_ns))
		due(s, replay_pose_device(s->config), t_ns, line, len);
	else
		s->bad++;
}

static int poses_next(struct replay_source *s, struct replay_event *ret, char error[REPLAY_SENTENCE_MAX])
{
	(void)error;
	return text_next(s, poses_line, ret);
}

static bool poses_span(struct replay_source *s, int64_t *ret_first_ns, int64_t *ret_last_ns)
{
	return text_span(s, poses_line, ret_first_ns, ret_last_ns);
}

static int poses_use(struct replay_source *s, const struct config *config, char error[REPLAY_SENTENCE_MAX])
{
	s->config = config;
	if (replay_pose_device(config) < 0)
		return refuse(error, "the configuration has no device for its poses: add {name: pose, driver: pose, "
		                     "listen: unix:/run/facetd/pose.sock}");
	return 0;
}

const struct replay_format replay_poses = {.name = "a list of poses",
                                           .order = REPLAY_MERGED,
                                           .is = poses_found,
                                           .open = text_open,
                                           .close = text_close,
                                           .use = poses_use,
                                           .span = poses_span,
                                           .next = poses_next,
                                           .rewind = text_rewind,
                                           .note = text_note};

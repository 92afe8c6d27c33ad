/* What the robot measures now.
 *
 * Everything here is the newest of its kind, with a number that says how often it changed; a reader compares numbers and takes
 * what it has not shown. So the cost is one copy a measurement, whoever looks on and however slowly. Only the log is a
 * ring of lines: the newest line is not all of the news.
 *
 * Frames: map <- base <- tilt <- laser. The angle of the servo is in base <- tilt, as in the assembler (core/sweep.c). */
#include "daemon/live.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "drivers/driver.h"

struct scanner {
	struct live_scanner shown;
	struct transform base_tilt, tilt_laser;
	int tilt_device; /* -1: the angle is fixed */
	bool tilt_known;
	struct tilt tilt;
};

struct line {
	int64_t t_ns;
	int priority;
	char text[LIVE_LINE_MAX];
};

struct live {
	void (*changed)(void *ctx);
	void *ctx;
	struct scanner *scanner;
	int scanners;
	bool pose_fixed, pose_known;
	struct pose pose, pose_first; /* the latter: before anything came */
	uint64_t pose_sequence, transforms_sequence;
	uint64_t lines;
	struct line line[LIVE_LINES]; /* ring: line n at (n - 1) % LIVE_LINES */
};

static int find_device(const struct config *config, const char *name)
{
	for (int i = 0; i < config->devices; i++)
		if (*name && strcmp(config->device[i].name, name) == 0)
			return i;
	return -1;
}

/* The quaternion of a rotation: from the largest of its components, so that nothing is divided by next to nothing
 * (Shepperd, Quaternion from rotation matrix, 1978). */
static struct quat quat_of(const double r[9])
{
	const double w = 1 + r[0] + r[4] + r[8], x = 1 + r[0] - r[4] - r[8];
	const double y = 1 - r[0] + r[4] - r[8], z = 1 - r[0] - r[4] + r[8];
	struct quat q;

	if (w >= x && w >= y && w >= z)
		q = (struct quat){w, r[7] - r[5], r[2] - r[6], r[3] - r[1]};
	else if (x >= y && x >= z)
		q = (struct quat){r[7] - r[5], x, r[3] + r[1], r[2] + r[6]};
	else if (y >= z)
		q = (struct quat){r[2] - r[6], r[3] + r[1], y, r[7] + r[5]};
	else
		q = (struct quat){r[3] - r[1], r[2] + r[6], r[7] + r[5], z};
	return quat_normalise(q);
}

static bool is_scanner(const struct config_device *device)
{
	const struct driver *driver = driver_find(device->driver);

	return driver && driver->role == ROLE_LASER;
}

static void init_scanner(struct scanner *scanner, const struct config *config, int device, bool alone)
{
	struct sweep_params params;
	const char *name = config->device[device].name;

	config_sweep_params(config, device, &params);
	scanner->shown.device = device;
	scanner->shown.name = name;
	scanner->base_tilt = params.base_tilt;
	scanner->tilt_laser = params.tilt_laser;
	scanner->tilt_device = params.fixed_tilt ? -1 : find_device(config, config->device[device].tilt);
	scanner->tilt_known = params.fixed_tilt;
	scanner->tilt.angle_rad = params.tilt_rad;
	snprintf(scanner->shown.tilt_frame, LIVE_FRAME_MAX, alone ? "tilt" : "tilt_%s", name);
	snprintf(scanner->shown.laser_frame, LIVE_FRAME_MAX, alone ? "laser" : "laser_%s", name);
}

struct live *live_create(const struct config *config)
{
	struct live *live = calloc(1, sizeof(*live));
	struct sweep_params params = {.fixed_pose = false};
	int scanners = 0;

	if (!live)
		return NULL;
	for (int i = 0; i < config->devices; i++)
		scanners += is_scanner(&config->device[i]);
	live->scanner = calloc((size_t)scanners + 1, sizeof(*live->scanner));
	if (!live->scanner) {
		free(live);
		return NULL;
	}
	for (int i = 0; i < config->devices; i++)
		if (is_scanner(&config->device[i])) {
			init_scanner(&live->scanner[live->scanners++], config, i, scanners == 1);
			config_sweep_params(config, i, &params);
		}
	live->pose_fixed = params.fixed_pose;
	if (live->pose_fixed) {
		live->pose_first.position_m = params.map_base.t;
		live->pose_first.rotation = quat_of(params.map_base.r);
		live->pose_sequence = 1;
	}
	live->transforms_sequence = 1;
	live->pose = live->pose_first;
	live->pose_known = live->pose_fixed;
	return live;
}

void live_destroy(struct live *live)
{
	if (!live)
		return;
	free(live->scanner);
	free(live);
}

void live_listen(struct live *live, void (*changed)(void *ctx), void *ctx)
{
	live->changed = changed;
	live->ctx = ctx;
}

static void tell(struct live *live)
{
	if (live->changed)
		live->changed(live->ctx);
}

/* Taps */

void live_profile(struct live *live, int device, const struct profile *profile)
{
	for (int i = 0; i < live->scanners; i++) {
		struct live_scanner *shown = &live->scanner[i].shown;
		const size_t n = profile->n;

		if (shown->device != device)
			continue;
		memcpy(&shown->profile, profile, offsetof(struct profile, range_m));
		memcpy(shown->profile.range_m, profile->range_m, n * sizeof(*profile->range_m));
		memcpy(shown->profile.state, profile->state, n * sizeof(*profile->state));
		shown->profile.has_remission = profile->has_remission;
		if (profile->has_remission)
			memcpy(shown->profile.remission, profile->remission, n * sizeof(*profile->remission));
		shown->sequence++;
	}
	tell(live);
}

void live_tilt(struct live *live, int device, const struct tilt *tilt)
{
	for (int i = 0; i < live->scanners; i++) {
		if (live->scanner[i].tilt_device != device)
			continue;
		live->scanner[i].tilt = *tilt;
		live->scanner[i].tilt_known = true;
		live->transforms_sequence++;
	}
	tell(live);
}

void live_pose(struct live *live, const struct pose *pose)
{
	live->pose = *pose;
	live->pose_known = true;
	live->pose_sequence++;
	live->transforms_sequence++;
	tell(live);
}

/* Bytes of the UTF-8 character at `text`, of which `len` are left; 0: it is none (RFC 3629: no surrogates, nothing longer
 * than need be, nothing beyond 0x10FFFF). */
static size_t character(const uint8_t *text, size_t len)
{
	static const uint32_t least[] = {0, 0, 0x80, 0x800, 0x10000};
	const size_t n = text[0] < 0x80       ? 1
	                 : text[0] >> 5 == 6  ? 2
	                 : text[0] >> 4 == 14 ? 3
	                 : text[0] >> 3 == 30 ? 4
	                                      : 0;
	uint32_t code = n > 1 ? text[0] & (0x7fu >> n) : text[0];

	if (n == 0 || n > len)
		return 0;
	for (size_t i = 1; i < n; i++) {
		if (text[i] >> 6 != 2)
			return 0;
		code = code << 6 | (text[i] & 0x3f);
	}
	return code >= least[n] && code <= 0x10ffff && code >> 11 != 0x1b ? n : 0;
}

void live_log(struct live *live, int64_t t_ns, int priority, const char *text)
{
	struct line *line = &live->line[live->lines++ % LIVE_LINES];
	size_t n, len = strnlen(text, LIVE_LINE_MAX - 1);

	line->t_ns = t_ns;
	line->priority = priority;
	memcpy(line->text, text, len);
	line->text[len] = 0;
	for (size_t i = 0; i < len; i += n) {
		n = character((const uint8_t *)line->text + i, len - i);
		if (n == 0 || (n == 1 && (unsigned char)line->text[i] < ' ')) {
			line->text[i] = '?';
			n = 1;
		}
	}
	tell(live);
}

void live_reset(struct live *live)
{
	for (int i = 0; i < live->scanners; i++) {
		live->scanner[i].tilt_known = live->scanner[i].tilt_device < 0;
		live->scanner[i].shown.profile.n = 0;
	}
	live->pose = live->pose_first;
	live->pose_known = live->pose_fixed;
	live->transforms_sequence++;
	tell(live);
}

/* What readers ask */

int live_scanners(const struct live *live)
{
	return live->scanners;
}

const struct live_scanner *live_scanner(const struct live *live, int i)
{
	return &live->scanner[i].shown;
}

bool live_pose_now(const struct live *live, struct pose *ret, uint64_t *ret_sequence)
{
	if (!live->pose_known)
		return false;
	*ret = live->pose;
	*ret_sequence = live->pose_sequence;
	return true;
}

static void put_transform(struct live_transform *ret, const char *parent, const char *child,
                          const struct transform *transform, int64_t t_ns)
{
	snprintf(ret->parent, LIVE_FRAME_MAX, "%s", parent);
	snprintf(ret->child, LIVE_FRAME_MAX, "%s", child);
	ret->translation_m = transform->t;
	ret->rotation = quat_of(transform->r);
	ret->t_ns = t_ns;
}

int live_transforms(const struct live *live, struct live_transform ret[LIVE_TRANSFORMS_MAX])
{
	int n = 0;

	if (live->pose_known) {
		const struct transform map_base = transform_quat(live->pose.position_m, live->pose.rotation);

		put_transform(&ret[n++], "map", "base", &map_base, live->pose.t_ns);
	}
	for (int i = 0; i < live->scanners; i++) {
		const struct scanner *scanner = &live->scanner[i];
		const struct transform tilt = transform_tilt(scanner->tilt.angle_rad);
		const struct transform base_tilt = transform_compose(&scanner->base_tilt, &tilt);

		if (scanner->tilt_known)
			put_transform(&ret[n++], "base", scanner->shown.tilt_frame, &base_tilt, scanner->tilt.t_ns);
		put_transform(&ret[n++], scanner->shown.tilt_frame, scanner->shown.laser_frame, &scanner->tilt_laser,
		              0);
	}
	return n;
}

uint64_t live_transforms_sequence(const struct live *live)
{
	return live->transforms_sequence;
}

uint64_t live_lines(const struct live *live)
{
	return live->lines;
}

bool live_line(const struct live *live, uint64_t number, struct live_line *ret)
{
	const struct line *line = &live->line[(number - 1) % LIVE_LINES];

	if (number == 0 || number > live->lines || live->lines - number >= LIVE_LINES)
		return false;
	*ret = (struct live_line){line->t_ns, line->priority, line->text};
	return true;
}

/* Law L8: no frame and no pose, at whatever time, crashes the odometry or the robot's track, or makes a pose that is no place; times
 * rise unless they were set back, and a snapshot taken anywhere is saved the same again.
 *
 * Input: a byte (which model; what a jump does), then steps: a byte of kind, a byte of time, and what the kind needs. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/pose_track.h"
#include "drivers/can_bus.h"
#include "drivers/driver.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

enum { MS = 1000000, SNAPSHOT_MAX = 1 << 18 };

static const char *const models[] = {
    "speed: {id: 0x200, start: 0, length: 16, scale: 1mm/s, counter: {start: 32, length: 8}}, "
    "turn: {id: 0x200, start: 16, length: 16, scale: 0.1deg/s, valid: {bit: 40}}",
    "left: {id: 0x201, start: 7, length: 16, order: motorola, scale: 0.1mm}, "
    "right: {id: 0x202, start: 7, length: 16, order: motorola, scale: -0.1mm, wrap: 50000}, track: 0.5",
    "speed: {id: 0x201, length: 32, type: float, scale: 1}, turn: {id: 0x202, length: 32, type: float, scale: 1}",
    "left: {id: 0x200, length: 32, type: float, scale: 1mm}, "
    "right: {id: 0x200, start: 32, length: 32, type: float, scale: 1mm}, track: 0.3",
};

struct subject {
	struct config config;
	struct decoder *decoder;
	struct dialogue *dialogue;
	struct pose_track *track;
	int64_t now_ns, pose_ns;
};

static void must(bool condition)
{
	if (!condition)
		abort();
}

static void judge(struct subject *s, const struct pose_track_out *out)
{
	const struct pose *p = &out->pose;
	const struct quat *q = &p->rotation;

	if (out->has_jump)
		must(out->jump.distance_m >= 0 && out->jump.angle_rad >= 0 && isfinite(out->jump.distance_m));
	if (!out->has_pose)
		return;
	must(fabs(p->position_m.x) <= 4e7 && fabs(p->position_m.y) <= 4e7 && fabs(p->position_m.z) <= 4e7);
	must(fabs(q->w * q->w + q->x * q->x + q->y * q->y + q->z * q->z - 1) < 1e-9);
	must(p->variance_m2 >= -1e-3 && p->variance_rad2 >= -1e-3 && isfinite(p->variance_m2));
	s->pose_ns = p->t_ns;
}

static void take_motion(void *ctx, int device, const struct motion *motion)
{
	struct subject *s = ctx;
	struct pose_track_out out;

	(void)device;
	must(motion->t_ns > motion->from_ns && isfinite(motion->ahead_m) && isfinite(motion->turn_rad));
	pose_track_motion(s->track, motion, &out);
	judge(s, &out);
	driver_odometry.dialogue_data(s->dialogue, s->now_ns);
}

static void take_reply(void *ctx, int device, const struct reply *reply)
{
	(void)device;
	driver_odometry.dialogue_reply(((struct subject *)ctx)->dialogue, reply);
}

static bool open_subject(struct subject *s, uint8_t which)
{
	static struct config configs[4];
	const struct pose_track_params params = {.motion = which & 4 ? false : true,
	                                         .absolute = which & 8 ? true : false,
	                                         .drift = 0.02,
	                                         .turn_drift_rad = 0.02,
	                                         .jump_m = 0.3,
	                                         .jump_rad = 0.1,
	                                         .on_jump = (enum pose_track_on_jump)((which >> 4) % 3)};
	struct config *config = &configs[which % 4];
	struct config_error error;
	char text[512];

	if (!config->devices) {
		const int n =
		    snprintf(text, sizeof(text), "devices: [{name: w, driver: odometry, connect: nowhere0, %s}]",
		             models[which % 4]);
		must(config_read(text, (size_t)n, "fuzz", config, &error) == 0);
	}
	*s = (struct subject){.config = *config, .now_ns = INT64_C(1700000000000) * MS};
	s->decoder = driver_odometry.decoder_create(&s->config.device[0], 0);
	s->dialogue = driver_odometry.dialogue_create(&s->config, 0);
	s->track = pose_track_create(&params);
	must(s->decoder && s->dialogue && s->track);
	driver_odometry.dialogue_reset(s->dialogue, s->now_ns);
	return true;
}

static void close_subject(struct subject *s)
{
	driver_odometry.decoder_destroy(s->decoder);
	driver_odometry.dialogue_destroy(s->dialogue);
	pose_track_destroy(s->track);
}

/* Saved, loaded and saved again; then `cut` bytes of it (damaged at `at`) are tried, and the good ones once more. */
static void try_snapshots(struct subject *s, uint16_t cut, uint8_t damage)
{
	static uint8_t once[SNAPSHOT_MAX], twice[SNAPSHOT_MAX], bad[SNAPSHOT_MAX];
	struct state state;
	size_t len;

	for (int module = 0; module < 2; module++) {
		state_save(&state, once, sizeof(once));
		module ? pose_track_state(&state, s->track) : driver_odometry.state(s->decoder, &state);
		must(state_done(&state));
		len = state.at;
		memcpy(bad, once, len);
		bad[cut % len] ^= damage;
		state_load(&state, bad, cut % 3 ? len : cut % len);
		module ? pose_track_state(&state, s->track) : driver_odometry.state(s->decoder, &state);
		state_load(&state, once, len);
		module ? pose_track_state(&state, s->track) : driver_odometry.state(s->decoder, &state);
		must(state_done(&state));
		state_save(&state, twice, sizeof(twice));
		module ? pose_track_state(&state, s->track) : driver_odometry.state(s->decoder, &state);
		must(state.at == len && memcmp(once, twice, len) == 0);
	}
}

static void give(struct subject *s, enum direction direction, const uint8_t *bytes, size_t len)
{
	const struct record_sink sink = {.ctx = s, .motion = take_motion, .reply = take_reply};
	const struct record record = {
	    .log_ns = s->now_ns, .t_ns = s->now_ns, .direction = direction, .bytes = bytes, .len = len};

	driver_odometry.decode(s->decoder, &record, &sink);
}

static void give_frame(struct subject *s, uint32_t id, const uint8_t *data, uint8_t len)
{
	struct can_frame_at f = can_wire_frame(id, data, len);
	uint8_t bytes[CAN_WIRE_ENTRY_FD];

	f.t_ns = s->now_ns;
	give(s, FROM_DEVICE, bytes, can_wire_put(&f, bytes));
}

static void give_pose(struct subject *s, const uint8_t *data)
{
	const double angle = data[2] * 0.05;
	const struct pose pose = {.t_ns = s->now_ns - (int64_t)(int8_t)data[5] * 5 * MS,
	                          .position_m = {(int8_t)data[0] * 0.05, (int8_t)data[1] * 0.05, data[3] * 0.01},
	                          .rotation = {.w = cos(angle), .z = sin(angle)},
	                          .variance_m2 = data[4] & 1 ? data[4] * data[4] * 1e-4 : 0,
	                          .variance_rad2 = data[4] & 2 ? data[4] * 1e-4 : 0};
	struct pose_track_out out;

	pose_track_absolute(s->track, &pose, &out);
	judge(s, &out);
}

static void ask(struct subject *s, uint8_t what)
{
	struct decoder_counters counters;
	struct decoder_timing timing;
	struct pose_track_status status;
	struct dialogue_step step;

	driver_odometry.counters(s->decoder, &counters);
	must(counters.n <= DECODER_COUNTERS_MAX);
	driver_odometry.timing(s->decoder, &timing);
	pose_track_status(s->track, &status);
	must(isfinite(status.sigma_m) && isfinite(status.sigma_rad));
	if (what % 16 == 7)
		driver_odometry.dialogue_stop(s->dialogue, s->now_ns);
	if (what % 16 == 9)
		driver_odometry.dialogue_reset(s->dialogue, s->now_ns);
	driver_odometry.dialogue_step(s->dialogue, s->now_ns, &step);
	must(step.write_len == 0 && strnlen(step.error, sizeof(step.error)) < sizeof(step.error));
	if (what % 16 == 11) {
		char error[160] = "";

		must(driver_odometry.link_open(&s->config.device[0], error) == NULL && error[0]);
	}
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static const uint32_t ids[] = {0x200,
	                               0x201,
	                               0x202,
	                               0x200 | CAN_WIRE_EXTENDED,
	                               0x201 | CAN_WIRE_REMOTE,
	                               CAN_WIRE_ERROR | CAN_WIRE_ERROR_BUS_OFF,
	                               CAN_WIRE_ERROR | CAN_WIRE_ERROR_CONTROLLER,
	                               CAN_WIRE_LOST};
	struct subject s;
	int snapshots = 0;

	if (size < 1 || !open_subject(&s, data[0]))
		return 0;
	for (size_t at = 1; at + 10 <= size; at += 10) {
		const uint8_t kind = data[at], time = data[at + 1], *what = data + at + 2;

		s.now_ns += time < 200   ? time * (int64_t)MS
		            : time < 250 ? (time - 199) * 100 * (int64_t)MS
		                         : -3000 * (int64_t)MS;
		if (kind < 128)
			give_frame(&s, ids[kind % 8], what, kind / 8 % 9);
		else if (kind < 200)
			give_pose(&s, what);
		else if (kind < 220)
			ask(&s, what[0]);
		else if (kind < 225)
			give(&s, LINK_OPENED, what, 0);
		else if (kind < 240)
			give(&s, FROM_DEVICE, what, 8);
		else if (snapshots++ < 4)
			try_snapshots(&s, (uint16_t)(what[0] | what[1] << 8), what[2]);
	}
	ask(&s, 0);
	close_subject(&s);
	return 0;
}

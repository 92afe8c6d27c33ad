/* Setting up, starting and commanding a CANopen node: pure, in the caller's time.
 *
 *   opening ─► learning ─► setting ─► starting ─► running ─► stopping ─► ending ─► stopped
 *      ▲  (1000: what is it)   (objects, PDOs)  (NMT, first angle)
 *      └──── boot-up, heartbeat or angle lost, no longer operational: it begins anew, and says why
 *
 * A node is disturbed as little as possible: it is asked first, woken by NMT only when it does not answer, written only
 * where it differs, and made pre-operational only when it refuses to be written otherwise. One that is merely listened to
 * keeps whatever PDO it has that tells its angle; a drive without `sweep` is never commanded, whoever moves it.
 *
 * A drive that is swept stops by itself when this program dies: its heartbeat consumer (1016) misses three of ours, and
 * 6007 makes that a quick stop, after which 605A lets it hold. Whatever it refuses of that is said.
 *
 * SYNC is the finest clock here. It is sent as long as the link is open, whatever becomes of this node, because others
 * may live by it; a call that comes late sends one SYNC, never those that were missed. Set-points leave just before it.
 *
 * What makes a sweep stand (a fault that stays, a following error, a limit) is a note of a node that goes on streaming:
 * its angle is as good as before. The drive says when it may go on (canopen_drive.h); so does a boot-up. */
#include "drivers/canopen_parts.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "drivers/can_bus.h"
#include "drivers/canopen_drive.h"
#include "drivers/canopen_setup.h"
#include "drivers/sweeper.h"

#define MS             INT64_C(1000000)
#define LOOK_NS        (50 * MS)    /* at least so often */
#define GAP_NS         (100 * MS)   /* what one pause between two looks counts at most: this program may have slept */
#define SYNC_HEARD_NS  (300 * MS)   /* somebody else's SYNC is waited for */
#define SYNC_MAX_NS    (1100 * MS)  /* two of them that lie farther apart are none of a row */
#define EVENT_NS       (10 * MS)    /* angles and set-points where there is no SYNC */
#define START_NS       (500 * MS)   /* NMT start is said again */
#define STARTING_NS    (3000 * MS)  /* an angle has come by then */
#define BOOT_NS        (2000 * MS)  /* the boot-up after a reset */
#define AGAIN_NS       (500 * MS)   /* between two tries that are not told */
#define BEATS          3            /* heartbeats that may be missing, on either side */
#define SAID_NS        (60000 * MS) /* the same failure is told by leaving the link no sooner */
#define EMCY_NS        (60000 * MS) /* an emergency that is never taken back is forgotten */
#define BRAKE_NS       (1000 * MS)  /* a halted sweep brakes along its set-points for so long at most */
#define VELOCITY_GAIN  5.0          /* 1/s: of the way that it is behind, in mode velocity */
#define VELOCITY_EXTRA 1.25         /* ... and no faster than this, times the peak */
#define ENTRIES        (DIALOGUE_WRITE_MAX / CAN_WIRE_ENTRY)
#define TPDOS          4
#define LEDS           16

#define TYPE_EVENT 255 /* what CiA 402 calls its own events */

#define CONTROL_HALT 0x010f /* 6040: enabled, halt */

#define ABORT_CONNECTION_QUICK_STOP 3 /* 6007 */
#define QUICK_STOP_AND_HOLD         6 /* 605A */

enum stage { OPENING, RESETTING, LEARNING, SETTING, STARTING, RUNNING, STOPPING, ENDING, STOPPED, FAILED };

struct dialogue {
	struct config_device device;
	bool commands; /* it is the servo of `sweep` */

	enum stage stage;
	int kind; /* as found */
	int64_t stage_ns, looked_ns, opened_ns;
	struct canopen_setup setup;
	int wakes;         /* what was tried to make it answer */
	bool asleep;       /* it was made pre-operational, to be written */
	int nmt;           /* its state by its heartbeat; -1: not known */
	uint32_t beat_ms;  /* it produces one so often; 0: none */
	int64_t quiet_ns;  /* without an angle, as far as it was looked */
	int64_t unbeat_ns; /* ... without a heartbeat */
	bool angle_known, beat_known, started;
	int64_t start_due_ns;

	int64_t sync_due_ns, beat_due_ns;
	bool sync_heard;
	int64_t sync_heard_ns, sync_period_ns; /* somebody else's */
	bool tick;                             /* a set-point is due */
	int64_t tick_ns;

	/* The drive. */
	struct canopen_drive drive;
	struct sweeper sweeper;
	struct canopen_sdo sdo;
	bool asked, begun, halting, release;
	uint16_t asked_index;
	uint8_t asked_sub;
	bool asked_download;
	int64_t halting_ns;
	struct led { /* set-points of mode velocity that may still be compared with an angle */
		int64_t t_ns;
		double rad;
	} led[LEDS];
	unsigned leds;
	bool speed_sent, target_sent;
	double sent_rad_s, sent_rad;
	uint32_t speeds, taken;
	bool booted; /* since it was last homed */

	struct canopen_wire_emcy emcy;
	int64_t emcy_ns;
	enum can_bus_health health;
	char why[160];  /* it began anew, or was given up */
	char said[160]; /* the failure that was told last */
	int64_t said_ns;
	char lacks[120]; /* what it refused of its supervision */
};

/* Any scale is a user's right; what has no room is as far as there is. */
static int32_t whole_of(double counts)
{
	const double whole = rint(counts);

	return whole >= INT32_MAX ? INT32_MAX : whole <= INT32_MIN ? INT32_MIN : (int32_t)whole;
}

static int32_t count_of(const struct dialogue *d, double rad)
{
	return whole_of(canopen_angle_count(&d->device, d->device.count.scale, rad));
}

static uint32_t rate_of(const struct dialogue *d, double rad)
{
	const double rate = rint(rad / d->device.count.scale);

	return rate >= UINT32_MAX ? UINT32_MAX : rate < 1.0 ? 1 : (uint32_t)rate;
}

static int64_t period_ns(const struct dialogue *d)
{
	return d->device.sync_ns > 0 ? d->device.sync_ns : d->sync_period_ns > 0 ? d->sync_period_ns : EVENT_NS;
}

static bool has_sync(const struct dialogue *d)
{
	return d->device.sync_ns > 0 || d->sync_heard;
}

static void set_up_drive(struct dialogue *d)
{
	struct canopen_drive_setup setup = {.mode = (int)d->device.drive_mode, .period_ns = period_ns(d)};

	if (d->device.count.scale > 0.0) {
		setup.acceleration = rate_of(d, d->device.acceleration_rad_s2);
		setup.homes = d->device.homing.set;
		setup.method = d->device.homing.method;
		setup.homing_speed = rate_of(d, d->device.homing.speed_rad_s);
		setup.home_count = count_of(d, d->device.homing.offset_rad);
		setup.homing_ns = d->device.homing.within_ns;
	}
	d->drive.setup = setup;
}

struct dialogue *canopen_dialogue_create(const struct config *config, int device)
{
	struct dialogue *d = calloc(1, sizeof *d);
	const struct canopen_drive_setup none = {0};

	if (!d)
		return NULL;
	d->device = config->device[device];
	sweeper_init(&d->sweeper, config, device, d->device.drive_mode != CANOPEN_POSITION, true);
	d->commands = sweeper_sweeps(&d->sweeper);
	canopen_drive_init(&d->drive, &none);
	return d;
}

void canopen_dialogue_destroy(struct dialogue *d)
{
	free(d);
}

/* Stages */

static void enter(struct dialogue *d, enum stage stage, int64_t t_ns)
{
	d->stage = stage;
	d->stage_ns = t_ns;
}

static void identify(struct dialogue *d, int64_t t_ns)
{
	canopen_setup_init(&d->setup, d->device.node);
	canopen_setup_identify(&d->setup);
	canopen_setup_begin(&d->setup);
	enter(d, OPENING, t_ns);
}

static void begin(struct dialogue *d, int64_t t_ns)
{
	d->wakes = 0;
	d->asleep = d->asked = d->begun = d->halting = false;
	d->angle_known = d->beat_known = false;
	d->quiet_ns = d->unbeat_ns = 0;
	d->lacks[0] = 0;
	d->drive.phase = CANOPEN_DRIVE_IDLE;
	canopen_sdo_init(&d->sdo, d->device.node);
	identify(d, t_ns);
}

/* What it was doing is over: the drive is to stand, whatever it still hears. */
static void let_go(struct dialogue *d)
{
	sweeper_halt(&d->sweeper, "");
	d->begun = false;
	d->release |= d->drive.phase > CANOPEN_DRIVE_CALMING && d->drive.phase < CANOPEN_DRIVE_ENDING;
	d->drive.phase = CANOPEN_DRIVE_IDLE;
}

void canopen_dialogue_reset(struct dialogue *d, int64_t t_ns)
{
	d->looked_ns = d->opened_ns = d->sync_due_ns = d->beat_due_ns = d->tick_ns = t_ns;
	d->nmt = -1;
	d->sync_heard = false;
	d->sync_period_ns = 0;
	d->started = false;
	d->why[0] = 0;
	memset(&d->emcy, 0, sizeof d->emcy);
	d->health = CAN_BUS_ACTIVE;
	let_go(d);
	begin(d, t_ns);
}

static void again(struct dialogue *d, const char *why, int64_t t_ns)
{
	snprintf(d->why, sizeof d->why, "%s", why);
	let_go(d);
	if (d->stage == STOPPING || d->stage == ENDING)
		enter(d, STOPPED, t_ns);
	else
		begin(d, t_ns);
}

/* Told by leaving the link, but not for ever: others on this bus may live by our SYNC. */
static void give_up(struct dialogue *d, const char *why, int64_t t_ns)
{
	const bool told = strcmp(why, d->said) == 0 && t_ns - d->said_ns < SAID_NS;

	if (told && d->device.sync_ns > 0) {
		again(d, why, t_ns);
		enter(d, RESETTING, t_ns);
		d->stage_ns = t_ns + AGAIN_NS - BOOT_NS; /* sooner */
		return;
	}
	snprintf(d->why, sizeof d->why, "%s", why);
	snprintf(d->said, sizeof d->said, "%s", why);
	d->said_ns = t_ns;
	let_go(d);
	enter(d, FAILED, t_ns);
}

/* What came */

static void take_nmt(struct dialogue *d, uint8_t state, int64_t t_ns)
{
	d->nmt = state;
	d->beat_known = state != CANOPEN_BOOT_UP;
	d->unbeat_ns = 0;
	if (state == CANOPEN_BOOT_UP) {
		d->nmt = CANOPEN_PREOPERATIONAL;
		canopen_drive_booted(&d->drive);
		d->booted = true;
		memset(&d->emcy, 0, sizeof d->emcy);
		if (d->stage == RESETTING)
			begin(d, t_ns);
		else
			again(d, "it was switched off and on, or has reset itself", t_ns);
	} else if (d->stage == RUNNING && state != CANOPEN_OPERATIONAL) {
		char text[160];

		snprintf(text, sizeof text, "it is %s, and not by us", canopen_wire_nmt_text(state));
		again(d, text, t_ns);
	}
}

static void take_emcy(struct dialogue *d, const struct canopen_wire_emcy *emcy, int64_t t_ns)
{
	d->emcy = *emcy;
	d->emcy_ns = t_ns;
	canopen_drive_emergency(&d->drive, emcy->code);
}

static void take_sync(struct dialogue *d, int64_t t_ns)
{
	const int64_t gap_ns = t_ns - d->sync_heard_ns;

	if (d->device.sync_ns > 0)
		return; /* ours, when it left */
	if (d->sync_heard && gap_ns > 0 && gap_ns < SYNC_MAX_NS)
		d->sync_period_ns += d->sync_period_ns > 0 ? (gap_ns - d->sync_period_ns) / 8 : gap_ns;
	d->sync_heard = d->tick = true;
	d->sync_heard_ns = t_ns;
}

static void take_angle(struct dialogue *d, const struct canopen_angle *angle)
{
	d->angle_known = true;
	d->quiet_ns = 0;
	if (angle->count >= INT32_MIN && angle->count <= INT32_MAX)
		canopen_drive_position(&d->drive, (int32_t)angle->count);
	if (d->begun)
		sweeper_angle(&d->sweeper, angle->rad, angle->t_ns);
}

static void take_sdo(struct dialogue *d, const uint8_t *bytes, size_t len)
{
	if (d->stage < STARTING)
		canopen_setup_answer(&d->setup, bytes, len);
	else if (d->asked)
		canopen_sdo_answer(&d->sdo, bytes, len);
}

void canopen_dialogue_reply(struct dialogue *d, const struct reply *reply)
{
	struct canopen_wire_emcy emcy;
	struct canopen_angle angle;
	uint16_t status;

	if (d->stage >= STOPPED)
		return;
	switch (reply->kind) {
	case CANOPEN_REPLY_SDO:
		take_sdo(d, reply->payload, reply->len);
		break;
	case CANOPEN_REPLY_NMT:
		if (reply->len == 1)
			take_nmt(d, reply->payload[0], reply->t_ns);
		break;
	case CANOPEN_REPLY_EMCY:
		if (reply->len == sizeof emcy) {
			memcpy(&emcy, reply->payload, sizeof emcy);
			take_emcy(d, &emcy, reply->t_ns);
		}
		break;
	case CANOPEN_REPLY_SYNC:
		take_sync(d, reply->t_ns);
		break;
	case CANOPEN_REPLY_STATUS:
		if (reply->len == sizeof status) {
			memcpy(&status, reply->payload, sizeof status);
			canopen_drive_status(&d->drive, status, reply->t_ns);
		}
		break;
	case CANOPEN_REPLY_ANGLE:
		if (reply->len == sizeof angle) {
			memcpy(&angle, reply->payload, sizeof angle);
			take_angle(d, &angle);
		}
		break;
	case CANOPEN_REPLY_BUS:
		if (reply->len == 1 && reply->payload[0] < CAN_BUS_HEALTHS)
			d->health = (enum can_bus_health)reply->payload[0];
		break;
	default:
		break;
	}
}

void canopen_dialogue_data(struct dialogue *d, int64_t t_ns)
{
	(void)t_ns;
	d->quiet_ns = 0;
}

/* Writing */

static bool room(const struct dialogue_step *ret)
{
	return ret->write_len + CAN_WIRE_ENTRY <= DIALOGUE_WRITE_MAX;
}

static void put(struct dialogue_step *ret, const struct can_frame_at *frame)
{
	uint8_t entry[CAN_WIRE_ENTRY_FD];

	if (!room(ret))
		return;
	const size_t n = can_wire_put(frame, entry);

	memcpy(ret->write + ret->write_len, entry, n);
	ret->write_len += n;
}

static void put_nmt(struct dialogue *d, enum canopen_command command, struct dialogue_step *ret)
{
	const struct can_frame_at frame = canopen_wire_nmt(command, d->device.node);

	put(ret, &frame);
}

static void put_rpdo(struct dialogue *d, uint16_t control, int32_t demand, struct dialogue_step *ret)
{
	const uint32_t value = (uint32_t)demand;
	const uint8_t data[6] = {(uint8_t)control,      (uint8_t)(control >> 8), (uint8_t)value,
	                         (uint8_t)(value >> 8), (uint8_t)(value >> 16),  (uint8_t)(value >> 24)};
	const struct can_frame_at frame = can_wire_frame(CANOPEN_RPDO + (uint32_t)d->device.node, data, sizeof data);

	put(ret, &frame);
}

/* Opening: is it there, and what is it? */

static void unanswered(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	char text[160] = "";

	/* Through a bus that is known to be broken nobody is woken. */
	if (d->health >= CAN_BUS_PASSIVE) {
		can_bus_sentence(d->health, d->device.connect, text);
		give_up(d, text, t_ns);
		return;
	}
	/* A drive that only somebody else commands, and one that says it is operational, are not woken. */
	if (d->wakes == 0 && d->nmt != CANOPEN_OPERATIONAL && (d->commands || d->device.kind != CANOPEN_DRIVE)) {
		put_nmt(d, CANOPEN_ENTER_PREOPERATIONAL, ret);
		d->wakes = 1;
		identify(d, t_ns);
		return;
	}
	if (d->wakes == 1 &&
	    (d->commands || d->device.kind == CANOPEN_ENCODER || d->device.kind == CANOPEN_INCLINOMETER)) {
		put_nmt(d, CANOPEN_RESET_COMMUNICATION, ret);
		d->wakes = 2;
		enter(d, RESETTING, t_ns);
		return;
	}
	can_bus_sentence(d->health, d->device.connect, text);
	if (!text[0])
		snprintf(text, sizeof text,
		         "node %d does not answer; is it switched on, are `node` and the bit rate right?",
		         d->device.node);
	give_up(d, text, t_ns);
}

static int kind_of(uint32_t type)
{
	const uint16_t profile = (uint16_t)type;

	return profile == 402   ? CANOPEN_DRIVE
	       : profile == 406 ? CANOPEN_ENCODER
	       : profile == 410 ? CANOPEN_INCLINOMETER
	                        : CANOPEN_AUTO;
}

/* False: it is not what was wanted, and was given up. */
static bool judge_kind(struct dialogue *d, int64_t t_ns)
{
	static const char *const name[] = {"something unknown", "a drive", "an encoder", "an inclinometer"};
	char text[160] = "";
	uint32_t type = 0;

	canopen_setup_value(&d->setup, 0x1000, 0, &type);
	d->kind = kind_of(type);
	/* A maker's own profile is believed to be what the configuration says. */
	if (d->kind == CANOPEN_AUTO && (uint16_t)type == 0)
		d->kind = (int)d->device.kind;
	if (d->kind == CANOPEN_AUTO || (d->device.kind != CANOPEN_AUTO && d->kind != (int)d->device.kind))
		snprintf(text, sizeof text, "node %d is %s (its object 1000 is %08X); correct `node` or `kind`",
		         d->device.node, name[d->kind], type);
	else if (d->commands && d->kind != CANOPEN_DRIVE)
		snprintf(text, sizeof text, "node %d is %s and cannot be commanded; take it out of `sweep`",
		         d->device.node, name[d->kind]);
	else if (!(d->device.count.scale > 0.0) && d->kind != CANOPEN_INCLINOMETER)
		snprintf(text, sizeof text, "node %d is %s, whose angle of one count is needed; give it a `scale`",
		         d->device.node, name[d->kind]);
	if (text[0])
		give_up(d, text, t_ns);
	return !text[0];
}

/* Learning: what it sends already */

static void learn_object(struct dialogue *d, uint16_t index, uint8_t sub, uint8_t size)
{
	const struct canopen_object object = {
	    .index = index, .sub = sub, .size = size, .how = CANOPEN_LEARN, .optional = true};

	canopen_setup_object(&d->setup, &object);
}

static void learn(struct dialogue *d, int64_t t_ns)
{
	canopen_setup_init(&d->setup, d->device.node);
	learn_object(d, 0x1017, 0, 2);
	if (d->kind == CANOPEN_INCLINOMETER) {
		learn_object(d, 0x6000, 0, 2);
		learn_object(d, d->device.axis == CANOPEN_LATERAL ? 0x6120 : 0x6110, 0, 4);
	}
	for (uint16_t i = 0; i < TPDOS && !d->commands; i++) {
		learn_object(d, 0x1800 + i, 1, 4);
		learn_object(d, 0x1800 + i, 2, 1);
		learn_object(d, 0x1a00 + i, 0, 1);
		for (uint8_t sub = 1; sub <= CANOPEN_PDO_ENTRIES; sub++)
			learn_object(d, 0x1a00 + i, sub, 4);
	}
	canopen_setup_begin(&d->setup);
	enter(d, LEARNING, t_ns);
}

/* The object that holds the angle, as it is to be mapped. */
static uint32_t angle_entry(const struct dialogue *d)
{
	const bool lateral = d->device.axis == CANOPEN_LATERAL;
	uint32_t value;

	if (d->kind == CANOPEN_DRIVE)
		return CANOPEN_MAP(0x6064, 0, 32);
	if (d->kind == CANOPEN_ENCODER)
		return CANOPEN_MAP(0x6004, 0, 32);
	if (canopen_setup_value(&d->setup, lateral ? 0x6120 : 0x6110, 0, &value))
		return CANOPEN_MAP(lateral ? 0x6120 : 0x6110, 0, 32);
	return CANOPEN_MAP(lateral ? 0x6020 : 0x6010, 0, 16);
}

static bool is_angle(const struct dialogue *d, uint32_t entry)
{
	const uint32_t index = entry >> 16;
	const bool lateral = d->device.axis == CANOPEN_LATERAL;

	if (d->kind == CANOPEN_INCLINOMETER)
		return index == (lateral ? 0x6020 : 0x6010) || index == (lateral ? 0x6120 : 0x6110);
	return index == (d->kind == CANOPEN_DRIVE ? 0x6064 : 0x6004);
}

struct found { /* a transmit PDO as it was found */
	bool there, on, holds, in_time, empty;
};

static struct found look_at(const struct dialogue *d, int pdo)
{
	const uint16_t index = (uint16_t)(0x1800 + pdo);
	struct found f = {0};
	uint32_t cob, type, n, entry;

	if (!canopen_setup_value(&d->setup, index, 1, &cob) || !canopen_setup_value(&d->setup, index, 2, &type) ||
	    !canopen_setup_value(&d->setup, index + 0x200, 0, &n))
		return f;
	f.there = true;
	/* The link listens to the predefined ids. */
	f.on = !(cob & CANOPEN_COB_OFF) &&
	       (cob & CANOPEN_COB_ID) == CANOPEN_TPDO + 0x100u * (uint32_t)pdo + (uint32_t)d->device.node;
	f.in_time = has_sync(d) ? type <= CANOPEN_TYPE_SYNC_MAX : type >= CANOPEN_TYPE_EVENT;
	f.empty = n == 0;
	for (uint8_t sub = 1; sub <= CANOPEN_PDO_ENTRIES && sub <= n; sub++)
		if (canopen_setup_value(&d->setup, index + 0x200, sub, &entry) && is_angle(d, entry))
			f.holds = true;
	return f;
}

/* The PDO to be used: best one that is as wanted, then one with the angle, then one that nobody uses, then the first. */
static int choose(const struct dialogue *d, bool *ret_ready)
{
	int best = 0, score = -1;

	for (int i = 0; i < TPDOS; i++) {
		const struct found f = look_at(d, i);
		const int worth = !f.there                       ? -1
		                  : f.holds && f.on && f.in_time ? 4
		                  : f.holds                      ? 3
		                  : !f.on || f.empty             ? 2
		                                                 : 0;

		if (worth > score) {
			score = worth;
			best = i;
		}
	}
	*ret_ready = score == 4;
	return best;
}

static void add_pdo(struct dialogue *d, uint16_t index, uint32_t cob, uint8_t type, uint32_t first, uint32_t second)
{
	const struct canopen_pdo pdo = {.index = index,
	                                .cob = cob + (uint32_t)d->device.node,
	                                .type = type,
	                                .inhibit = -1,
	                                .timer =
	                                    index >= 0x1800 && type > CANOPEN_TYPE_SYNC_MAX ? (int)(EVENT_NS / MS) : -1,
	                                .n = second ? 2 : 1,
	                                .entry = {first, second}};

	canopen_setup_pdo(&d->setup, &pdo);
}

/* One that is only listened to. */
static void list_listening(struct dialogue *d)
{
	bool ready, twice[TPDOS] = {false};
	const int pdo = choose(d, &ready);
	const uint32_t entry = angle_entry(d);
	uint32_t beat_ms = 0;

	for (int i = 0; i < TPDOS; i++) {
		const struct found f = look_at(d, i);

		/* The same angle at other times would be in each other's way; a drive's are somebody else's. */
		twice[i] = i != pdo && f.holds && f.on && d->kind != CANOPEN_DRIVE;
	}
	canopen_setup_value(&d->setup, 0x1017, 0, &beat_ms);
	canopen_setup_init(&d->setup, d->device.node);
	if (d->kind != CANOPEN_DRIVE && !beat_ms && d->device.heartbeat_ns > 0) {
		beat_ms = (uint32_t)(d->device.heartbeat_ns / MS);
		canopen_setup_heartbeat(&d->setup, (uint16_t)beat_ms, 0, 0);
	}
	d->beat_ms = beat_ms;
	for (int i = 0; i < TPDOS; i++)
		if (twice[i]) {
			const struct canopen_pdo off = {
			    .index = (uint16_t)(0x1800 + i), .optional = true, .off = true, .n = -1};

			canopen_setup_pdo(&d->setup, &off);
		}
	if (!ready)
		add_pdo(d, (uint16_t)(0x1800 + pdo), CANOPEN_TPDO + 0x100u * (uint32_t)pdo,
		        has_sync(d) ? 1 : TYPE_EVENT, entry, 0);
}

/* 1016: an eighth of a period beyond, or a beat that is a little late after two that were lost would be the third. */
static uint32_t missing_ms(const struct dialogue *d)
{
	return BEATS * d->beat_ms + d->beat_ms / 8;
}

/* One that is commanded. */
static void list_commanding(struct dialogue *d)
{
	const bool cyclic = d->device.drive_mode == CANOPEN_CYCLIC;
	const struct canopen_object stop[] = {
	    {.index = 0x6007, .size = 2, .how = CANOPEN_KEEP, .optional = true, .value = ABORT_CONNECTION_QUICK_STOP},
	    {.index = 0x605a, .size = 2, .how = CANOPEN_KEEP, .optional = true, .value = QUICK_STOP_AND_HOLD}};

	d->beat_ms = (uint32_t)(d->device.heartbeat_ns / MS);
	canopen_setup_init(&d->setup, d->device.node);
	canopen_setup_heartbeat(&d->setup, (uint16_t)d->beat_ms, d->device.master, (uint16_t)missing_ms(d));
	canopen_setup_object(&d->setup, &stop[0]);
	canopen_setup_object(&d->setup, &stop[1]);
	if (d->device.homing.set) {
		learn_object(d, 0x6098, 0, 1);
		learn_object(d, 0x607c, 0, 4);
	}
	add_pdo(d, 0x1800, CANOPEN_TPDO, has_sync(d) ? 1 : TYPE_EVENT, CANOPEN_MAP(0x6041, 0, 16),
	        CANOPEN_MAP(0x6064, 0, 32));
	add_pdo(d, 0x1400, CANOPEN_RPDO, cyclic ? 1 : TYPE_EVENT, CANOPEN_MAP(0x6040, 0, 16),
	        d->device.drive_mode == CANOPEN_VELOCITY ? CANOPEN_MAP(0x60ff, 0, 32) : CANOPEN_MAP(0x607a, 0, 32));
}

static void set(struct dialogue *d, int64_t t_ns)
{
	if (d->commands)
		list_commanding(d);
	else
		list_listening(d);
	canopen_setup_begin(&d->setup);
	enter(d, SETTING, t_ns);
}

/* Somebody else's SYNC may still come: without it a drive cannot be led, and angles have worse times. */
static void learned(struct dialogue *d, int64_t t_ns)
{
	const bool waits = d->device.sync_ns == 0 && (!d->sync_heard || d->sync_period_ns == 0);

	if (waits && t_ns - d->opened_ns < SYNC_HEARD_NS)
		return;
	if (waits && d->commands && d->device.drive_mode == CANOPEN_CYCLIC) {
		give_up(d, "mode cyclic needs SYNC, and nobody sends it; give `sync` a period, like 10ms", t_ns);
		return;
	}
	set(d, t_ns);
}

static void refused(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	if (d->setup.abort == CANOPEN_ABORT_TIMEOUT && d->stage == OPENING) {
		unanswered(d, t_ns, ret);
	} else if (d->setup.abort == CANOPEN_ABORT_TIMEOUT) {
		char text[160];

		snprintf(text, sizeof text, "node %d stopped answering while it was set up", d->device.node);
		give_up(d, text, t_ns);
	} else if (d->stage == SETTING && !d->asleep) {
		/* Many a node lets its PDOs be changed only in this state. */
		put_nmt(d, CANOPEN_ENTER_PREOPERATIONAL, ret);
		d->asleep = true;
		d->nmt = CANOPEN_PREOPERATIONAL;
		canopen_setup_begin(&d->setup);
	} else {
		give_up(d, d->setup.error, t_ns);
	}
}

/* What it lacks of the supervision is said: it would go on if this program died. */
static void note_lacks(struct dialogue *d)
{
	uint32_t value;

	if (!d->commands)
		return;
	if (d->device.heartbeat_ns == 0)
		snprintf(d->lacks, sizeof d->lacks, "`heartbeat` is 0: it goes on if facetd dies");
	else if (!canopen_setup_value(&d->setup, 0x6007, 0, &value) || value != ABORT_CONNECTION_QUICK_STOP)
		snprintf(d->lacks, sizeof d->lacks,
		         "it has no object 6007: see its handbook for what it does when heartbeats are missing");
}

/* Homing anew costs a way and is always right, but 35 and 37 call home wherever it stands. Then it counts that nothing had
 * to be written: a drive that still has all it was told (by an earlier life of this program, perhaps) was not switched off
 * since, and knows where it is. */
static bool is_homed(const struct dialogue *d)
{
	const struct canopen_drive_setup *wanted = &d->drive.setup;
	uint32_t method, offset;

	if (!wanted->homes || (wanted->method != 35 && wanted->method != 37) || d->booted || d->setup.written > 0)
		return false;
	return canopen_setup_value(&d->setup, 0x6098, 0, &method) && (int8_t)method == wanted->method &&
	       canopen_setup_value(&d->setup, 0x607c, 0, &offset) && (int32_t)offset == wanted->home_count;
}

static void set_done(struct dialogue *d, int64_t t_ns)
{
	note_lacks(d);
	set_up_drive(d);
	d->drive.homed = is_homed(d);
	d->start_due_ns = t_ns;
	d->angle_known = false;
	enter(d, STARTING, t_ns);
}

/* Carries the set-up on and sends what it wants sent. */
static void carry_on(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	struct can_frame_at frame;

	while (room(ret) && canopen_setup_step(&d->setup, t_ns, &frame))
		put(ret, &frame);
	if (d->setup.state == CANOPEN_SETUP_FAILED) {
		refused(d, t_ns, ret);
	} else if (d->setup.state == CANOPEN_SETUP_DONE) {
		if (d->stage == SETTING)
			set_done(d, t_ns);
		else if (d->stage == LEARNING)
			learned(d, t_ns);
		else if (judge_kind(d, t_ns))
			learn(d, t_ns);
	}
}

/* Starting */

static void start(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	const bool beats = d->beat_ms == 0 || (d->beat_known && d->nmt == CANOPEN_OPERATIONAL);
	char text[160] = "";

	if (d->angle_known && beats) {
		enter(d, RUNNING, t_ns);
		d->quiet_ns = d->unbeat_ns = 0;
		if (d->commands)
			canopen_drive_begin(&d->drive, t_ns);
		return;
	}
	if (t_ns >= d->start_due_ns && (d->nmt != CANOPEN_OPERATIONAL || !d->beat_known)) {
		put_nmt(d, CANOPEN_START, ret);
		d->started = true;
		d->start_due_ns = t_ns + START_NS;
	}
	if (t_ns - d->stage_ns < STARTING_NS)
		return;
	can_bus_sentence(d->health, d->device.connect, text);
	if (!text[0])
		snprintf(text, sizeof text, "node %d %s", d->device.node,
		         d->angle_known ? "sends no heartbeat, although it was told to"
		         : has_sync(d)
		             ? "answers, but sends no angle; was its mapping changed by somebody else?"
		             : "answers, but sends no angle; does anybody send SYNC? If not, give `sync` a period");
	give_up(d, text, t_ns);
}

/* Running: what is missing? */

static void watch(struct dialogue *d, int64_t t_ns)
{
	const int64_t gap_ns = t_ns - d->looked_ns, counted_ns = gap_ns < GAP_NS ? gap_ns : GAP_NS;
	char text[160] = "";

	d->looked_ns = t_ns;
	d->quiet_ns += counted_ns;
	d->unbeat_ns += counted_ns;
	if (d->stage != RUNNING && d->stage != STOPPING)
		return;
	can_bus_sentence(d->health, d->device.connect, text);
	if (d->beat_ms && d->unbeat_ns > BEATS * (int64_t)d->beat_ms * MS + LOOK_NS) {
		if (!text[0])
			snprintf(text, sizeof text, "its heartbeat was lost (%d of %u ms)", BEATS, d->beat_ms);
	} else if (d->quiet_ns > d->device.timeout_ns) {
		if (!text[0])
			snprintf(text, sizeof text, "it sent no angle for %lld ms",
			         (long long)(d->device.timeout_ns / MS));
	} else {
		return;
	}
	d->nmt = -1;
	again(d, text, t_ns);
}

/* The drive */

/* Its one transfer: begun when it is asked for, given up when something else is. */
static void transfer(struct dialogue *d, const struct canopen_drive_wish *wish, int64_t t_ns, struct dialogue_step *ret)
{
	const bool same = d->asked && wish->asks && wish->ask.index == d->asked_index &&
	                  wish->ask.sub == d->asked_sub && wish->ask.download == d->asked_download;
	struct can_frame_at frame;

	if (wish->asks && !same) {
		d->asked = true;
		d->asked_index = wish->ask.index;
		d->asked_sub = wish->ask.sub;
		d->asked_download = wish->ask.download;
		if (wish->ask.download)
			canopen_sdo_write(&d->sdo, wish->ask.index, wish->ask.sub, wish->ask.size, wish->ask.value);
		else
			canopen_sdo_upload(&d->sdo, wish->ask.index, wish->ask.sub);
	}
	while (d->asked && room(ret) && canopen_sdo_step(&d->sdo, t_ns, &frame))
		put(ret, &frame);
}

/* An answer goes to the drive only while it still waits for it. */
static void answer(struct dialogue *d, const struct canopen_drive_wish *wish, int64_t t_ns)
{
	const bool good = d->sdo.state == CANOPEN_SDO_DONE;

	if (!d->asked || (!good && d->sdo.state != CANOPEN_SDO_FAILED))
		return;
	d->asked = false;
	if (!good && !d->sdo.refused && d->sdo.abort == CANOPEN_ABORT_TIMEOUT) {
		char text[160];

		snprintf(text, sizeof text, "it does not answer (SDO %04X:%02X timed out)", d->asked_index,
		         d->asked_sub);
		again(d, text, t_ns);
		return;
	}
	if (wish->asks && wish->ask.index == d->asked_index && wish->ask.sub == d->asked_sub &&
	    wish->ask.download == d->asked_download)
		canopen_drive_answer(&d->drive, good, good ? canopen_sdo_number(&d->sdo, wish->ask.size) : d->sdo.abort,
		                     t_ns);
}

static void begin_sweep(struct dialogue *d, int64_t t_ns)
{
	double a, b;

	sweeper_begin(&d->sweeper, t_ns);
	if (d->drive.limited) {
		a = canopen_angle_rad(&d->device, d->device.count.scale, d->drive.limit[0]);
		b = canopen_angle_rad(&d->device, d->device.count.scale, d->drive.limit[1]);
		sweeper_limits(&d->sweeper, a < b ? a : b, a < b ? b : a);
	}
	d->begun = true;
	d->leds = 0;
	d->halting = d->speed_sent = d->target_sent = false;
	d->speeds = d->drive.speeds;
	d->taken = d->drive.taken;
}

/* Mode position: the sweeper's wishes, told one after the other. */
static void tell_target(struct dialogue *d, const struct sweeper_wish *wish, int64_t t_ns)
{
	if (d->speed_sent && d->drive.speeds != d->speeds) {
		d->speed_sent = false;
		sweeper_speed_taken(&d->sweeper, d->sent_rad_s, t_ns);
	}
	if (d->target_sent && d->drive.taken != d->taken) {
		d->target_sent = false;
		if (d->drive.taken_count == count_of(d, d->sent_rad))
			sweeper_target_taken(&d->sweeper, d->sent_rad, t_ns);
	}
	if (wish->speed && !d->speed_sent) {
		d->speed_sent = true;
		d->speeds = d->drive.speeds;
		d->sent_rad_s = wish->speed_rad_s;
		canopen_drive_speed(&d->drive, rate_of(d, wish->speed_rad_s));
	}
	if (wish->target && (!d->target_sent || wish->target_rad != d->sent_rad)) {
		d->target_sent = true;
		d->taken = d->drive.taken;
		d->sent_rad = wish->target_rad;
		if (!canopen_drive_goto(&d->drive, count_of(d, wish->target_rad)))
			sweeper_halt(&d->sweeper, "was to go beyond its own limits; correct `sweep`");
	}
}

static void sweep(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	const bool position = d->device.drive_mode == CANOPEN_POSITION;
	struct sweeper_wish wish;

	if (d->drive.phase != CANOPEN_DRIVE_RUNNING) {
		if (d->begun)
			sweeper_halt(&d->sweeper, d->drive.why);
		d->begun = false;
		return;
	}
	if (!d->begun)
		begin_sweep(d, t_ns);
	sweeper_look(&d->sweeper, t_ns, &wish);
	if (position)
		tell_target(d, &wish, t_ns);
	if (wish.deadline_ns < ret->deadline_ns)
		ret->deadline_ns = wish.deadline_ns;
	if (wish.state == SWEEPER_DONE && d->stage == STOPPING) {
		canopen_drive_end(&d->drive, t_ns);
		enter(d, ENDING, t_ns);
	} else if (wish.state == SWEEPER_HALTED && !d->halting) {
		d->halting = true;
		d->halting_ns = t_ns;
	}
	/* A led drive is braked along its set-points first. */
	if (d->halting && (position || t_ns - d->halting_ns >= BRAKE_NS))
		canopen_drive_halt(&d->drive, wish.why, t_ns);
}

/* How far the newest angle is behind the set-point of its own time. */
static double behind(const struct dialogue *d)
{
	const int64_t t_ns = d->sweeper.angle_ns;

	for (unsigned i = 2; i <= LEDS && i <= d->leds; i++) {
		const struct led *a = &d->led[(d->leds - i) % LEDS], *b = &d->led[(d->leds - i + 1) % LEDS];

		if (a->t_ns <= t_ns && t_ns < b->t_ns)
			return a->rad + (b->rad - a->rad) * (double)(t_ns - a->t_ns) / (double)(b->t_ns - a->t_ns) -
			       d->sweeper.angle_rad;
	}
	return 0.0;
}

/* A set-point, where one is due. */
static void lead(struct dialogue *d, int64_t t_ns)
{
	const double peak = d->sweeper.peak_rad_s * VELOCITY_EXTRA;
	double rad, rad_s;

	if (d->device.drive_mode == CANOPEN_POSITION || !d->tick)
		return;
	d->tick = false;
	if (!d->begun || d->drive.phase != CANOPEN_DRIVE_RUNNING ||
	    !sweeper_setpoint(&d->sweeper, t_ns + period_ns(d), &rad, &rad_s)) {
		canopen_drive_follow(&d->drive, d->drive.demand);
		return;
	}
	if (d->device.drive_mode == CANOPEN_CYCLIC) {
		canopen_drive_follow(&d->drive, count_of(d, rad));
		return;
	}
	if (!d->halting)
		rad_s += VELOCITY_GAIN * behind(d);
	d->led[d->leds++ % LEDS].t_ns = t_ns + period_ns(d);
	d->led[(d->leds - 1) % LEDS].rad = rad;
	rad_s = rad_s > peak ? peak : rad_s < -peak ? -peak : rad_s;
	canopen_drive_follow(&d->drive, whole_of(d->device.count.sign * rad_s / d->device.count.scale));
}

static void command(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	struct canopen_drive_wish wish;

	if (!d->commands || d->stage < RUNNING || d->stage > ENDING)
		return;
	canopen_drive_step(&d->drive, t_ns, &wish);
	for (int round = 0; round < 2; round++) { /* what was answered may lead to the next question at once */
		for (int i = 0; i < wish.frames; i++)
			put_rpdo(d, wish.frame[i].control, wish.frame[i].demand, ret);
		transfer(d, &wish, t_ns, ret);
		answer(d, &wish, t_ns);
		if (d->stage < RUNNING)
			return;
		if (round == 0) {
			sweep(d, t_ns, ret);
			lead(d, t_ns);
			canopen_drive_step(&d->drive, t_ns, &wish);
		}
	}
	d->booted &= !d->drive.homed;
	if (wish.deadline_ns < ret->deadline_ns)
		ret->deadline_ns = wish.deadline_ns;
	if (d->stage == STOPPING && d->drive.phase != CANOPEN_DRIVE_RUNNING) {
		canopen_drive_end(&d->drive, t_ns);
		enter(d, ENDING, t_ns);
	}
}

/* What goes out by the clock */

static int64_t after(int64_t due_ns, int64_t step_ns, int64_t t_ns)
{
	return t_ns - due_ns < step_ns ? due_ns + step_ns : t_ns + step_ns;
}

/* A drive that was let go in mid-sweep is told to stand, should it still hear: in mode velocity it would go on for ever. */
static void release(struct dialogue *d, struct dialogue_step *ret)
{
	if (d->release)
		put_rpdo(d, CONTROL_HALT, d->device.drive_mode == CANOPEN_VELOCITY ? 0 : d->drive.demand, ret);
	d->release = false;
}

static void beat(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	if (!d->commands || d->device.heartbeat_ns == 0 || t_ns < d->beat_due_ns)
		return;
	const struct can_frame_at frame = canopen_wire_heartbeat(d->device.master, CANOPEN_OPERATIONAL);

	put(ret, &frame);
	d->beat_due_ns = after(d->beat_due_ns, d->device.heartbeat_ns, t_ns);
}

/* True: SYNC is to leave in this step, after all else. */
static bool sync_is_due(struct dialogue *d, int64_t t_ns)
{
	if (d->device.sync_ns > 0 && t_ns >= d->sync_due_ns) {
		d->sync_due_ns = after(d->sync_due_ns, d->device.sync_ns, t_ns);
		d->tick = true;
		return true;
	}
	if (!has_sync(d) && t_ns >= d->tick_ns) {
		d->tick_ns = after(d->tick_ns, EVENT_NS, t_ns);
		d->tick = true;
	}
	return false;
}

/* The end */

static void end(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	const bool drives = d->commands && d->drive.phase != CANOPEN_DRIVE_IDLE;

	if (drives && d->drive.phase != CANOPEN_DRIVE_ENDED)
		return;
	/* Others find it as we did. */
	if (d->started)
		put_nmt(d, CANOPEN_ENTER_PREOPERATIONAL, ret);
	d->started = false;
	enter(d, STOPPED, t_ns);
}

void canopen_dialogue_stop(struct dialogue *d, int64_t t_ns)
{
	if (d->stage >= STOPPING)
		return;
	if (d->stage == RUNNING && d->begun && d->drive.phase == CANOPEN_DRIVE_RUNNING) {
		sweeper_stop(&d->sweeper, t_ns);
		enter(d, STOPPING, t_ns);
		return;
	}
	canopen_drive_end(&d->drive, t_ns);
	enter(d, ENDING, t_ns);
}

/* What it says of itself while it streams. */
static void note(struct dialogue *d, int64_t t_ns, char ret[160])
{
	char bus[160] = "";

	can_bus_sentence(d->health, d->device.connect, bus);
	if (d->emcy.code && t_ns - d->emcy_ns >= EMCY_NS)
		d->emcy.code = 0;
	if (d->drive.phase == CANOPEN_DRIVE_STANDING)
		snprintf(ret, 160, "the sweep stands: it %s", d->drive.why);
	else if (d->emcy.code)
		snprintf(ret, 160, "it reports %04X: %s", d->emcy.code, canopen_wire_emcy_text(d->emcy.code));
	else if (bus[0])
		snprintf(ret, 160, "%s", bus);
	else if (d->drive.phase == CANOPEN_DRIVE_RUNNING && d->drive.note[0])
		snprintf(ret, 160, "%s", d->drive.note);
	else
		snprintf(ret, 160, "%s", d->lacks);
}

static void sooner(struct dialogue_step *ret, int64_t at_ns)
{
	if (at_ns < ret->deadline_ns)
		ret->deadline_ns = at_ns;
}

static void tell(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	if (d->stage == STOPPED || d->stage == FAILED) {
		/* What is still to be written leaves first. */
		ret->state = ret->write_len ? DIALOGUE_CONFIGURING : DIALOGUE_FAILED;
		ret->deadline_ns = ret->write_len ? t_ns : INT64_MAX;
		snprintf(ret->error, sizeof ret->error, "%s", d->stage == FAILED ? d->why : "");
		return;
	}
	ret->state = d->stage >= RUNNING ? DIALOGUE_STREAMING : DIALOGUE_CONFIGURING;
	if (ret->state == DIALOGUE_STREAMING)
		note(d, t_ns, ret->error);
	else
		snprintf(ret->error, sizeof ret->error, "%s", d->why);
	sooner(ret, t_ns + LOOK_NS);
	if (d->device.sync_ns > 0)
		sooner(ret, d->sync_due_ns);
	else if (!has_sync(d))
		sooner(ret, d->tick_ns);
	if (d->commands && d->device.heartbeat_ns > 0)
		sooner(ret, d->beat_due_ns);
	if (d->stage < STARTING && d->stage != RESETTING)
		sooner(ret, canopen_setup_deadline(&d->setup));
	else if (d->asked)
		sooner(ret, canopen_sdo_deadline(&d->sdo));
}

void canopen_dialogue_step(struct dialogue *d, int64_t t_ns, struct dialogue_step *ret)
{
	bool sync;

	memset(ret, 0, sizeof *ret);
	ret->deadline_ns = INT64_MAX;
	if (d->stage < STOPPED) {
		watch(d, t_ns);
		sync = sync_is_due(d, t_ns);
		beat(d, t_ns, ret);
		release(d, ret);
		if (d->stage == RESETTING && t_ns - d->stage_ns >= BOOT_NS)
			identify(d, t_ns);
		if (d->stage == OPENING || d->stage == LEARNING || d->stage == SETTING)
			carry_on(d, t_ns, ret);
		if (d->stage == STARTING)
			start(d, t_ns, ret);
		command(d, t_ns, ret);
		if (d->stage == ENDING)
			end(d, t_ns, ret);
		if (sync) {
			const struct can_frame_at frame = canopen_wire_sync();

			put(ret, &frame);
		}
	}
	tell(d, t_ns, ret);
}

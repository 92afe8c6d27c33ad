/* CANopen node: frames of everybody on the bus in, angles and replies out. Passive (law L7).
 *
 * What a PDO carries is not said in it. It is learned from SDO traffic, whoever's: a value read is learned from the
 * answer, a value written from the request (a log may have lost the answers), and taken back if the node refuses it. A
 * node that boots has forgotten what it was told, so it is forgotten here too; a mapping is read anew before the node
 * is started. Before anything is known, an encoder and an inclinometer are taken to be mapped as their profiles say; a
 * drive is not, since makers do as they like there.
 *
 * Which time. The link delivers our own frames as they leave, so both directions come in the order of the bus. A TPDO
 * of transmission type 0..240 was sampled at the SYNC, and its angle has that SYNC's time; where that one was missed,
 * the TPDO's own time is the better one, as it is for all others; where it may be one of several, the angle is not used
 * (canopen_pairing.h). Frames written (TO_DEVICE) teach too, for records of a link that does not echo: whatever is
 * learned twice is learned once. */
#include "drivers/canopen_parts.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "drivers/canopen_pairing.h"
#include "drivers/jitter.h"

#define PDOS            8 /* of either way: more are not looked at */
#define PDO_ENTRIES     8
#define SYNC_DEFAULT_NS INT64_C(100000000) /* before two were seen of somebody who says nothing of his period */
#define SYNC_MAX_NS     INT64_C(2000000000)
#define BACK_NS         INT64_C(1000000000) /* so far back an angle is no straggler, time itself was another */
#define ANGLE_MAX_RAD   (TRIG_ANGLE_MAX / 4)

enum {
	ANGLES,
	STATUSWORDS,
	HEARTBEATS,
	BOOT_UPS,
	EMERGENCIES,
	SDO,
	ABORTS,
	SYNCS,
	SYNC_MISSED,
	UNMAPPED,
	SHORT,
	NO_SCALE,
	UNDATED, /* a second angle of the same SYNC, or one of nobody knows which */
	FOREIGN,
	MALFORMED,
	COUNTERS
};
static const char *const counter_name[COUNTERS] = {"angles", "statuswords", "heartbeats", "boot-ups",    "emergencies",
                                                   "sdo",    "aborts",      "syncs",      "sync missed", "not mapped",
                                                   "short",  "no scale",    "undated",    "foreign",     "malformed"};
_Static_assert(COUNTERS + CAN_BUS_COUNTERS <= DECODER_COUNTERS_MAX, "the counters of a decoder have a limit");

struct value { /* of an object, as far as it is known */
	bool known;
	uint32_t v;
};
struct pdo {
	struct value cob, type, count, entry[PDO_ENTRIES];
	struct canopen_pairing pairing; /* of one that the node transmits */
};

struct decoder {
	struct config_device device;
	int index;
	struct pdo pdo[2][PDOS]; /* received, transmitted by the node */
	struct value type;       /* 1000 */
	struct value resolution; /* 6000 of an inclinometer: 0.001 degree */
	struct {                 /* the download that waits for its answer */
		bool set;
		uint16_t index;
		uint8_t sub;
		struct value wanted, before;
	} written;
	bool synced, echoed;          /* a SYNC is known; one came by the bus since the link was opened */
	int64_t sync_ns, sync_gap_ns; /* the last SYNC; between the last two, 0: not known */
	bool turned;
	int64_t angle_ns; /* of the last angle */
	struct can_bus bus;
	uint64_t count[COUNTERS];
	uint32_t every;       /* SYNCs an angle; 0: it comes by itself. For the status, as the next */
	struct jitter jitter; /* TPDO after SYNC; neither is in the snapshot */
};

/* A frame and where it goes. */
struct context {
	const struct record *record;
	const struct record_sink *sink; /* NULL: frames that were written, which teach only */
	struct can_frame_at f;
};

struct decoder *canopen_decoder_create(const struct config_device *config, int device)
{
	struct decoder *d = calloc(1, sizeof *d);

	if (d) {
		d->device = *config;
		d->index = device;
	}
	return d;
}

void canopen_decoder_destroy(struct decoder *d)
{
	free(d);
}

static void say(const struct decoder *d, const struct context *c, int kind, const void *payload, size_t len)
{
	const struct reply reply = {.t_ns = c->f.t_ns, .kind = kind, .payload = payload, .len = len};

	if (c->sink && c->sink->reply)
		c->sink->reply(c->sink->ctx, d->index, &reply);
}

double canopen_angle_rad(const struct config_device *device, double scale_rad, int64_t count)
{
	const double scale = device->count.scale > 0 ? device->count.scale : scale_rad;
	const double wrap = device->count.wrap;
	double counts = (double)count - device->count.zero;

	if (wrap > 0)
		counts -= wrap * floor(counts / wrap + 0.5);
	return (device->count.sign < 0 ? -scale : scale) * counts;
}

double canopen_angle_count(const struct config_device *device, double scale_rad, double rad)
{
	const double scale = device->count.scale > 0 ? device->count.scale : scale_rad;

	return rad / (device->count.sign < 0 ? -scale : scale) + device->count.zero;
}

static int kind_of(const struct decoder *d)
{
	static const struct {
		uint16_t profile;
		int kind;
	} known[] = {{402, CANOPEN_DRIVE}, {406, CANOPEN_ENCODER}, {410, CANOPEN_INCLINOMETER}};

	for (size_t i = 0; d->device.kind == CANOPEN_AUTO && d->type.known && i < sizeof known / sizeof known[0]; i++)
		if (known[i].profile == (d->type.v & 0xffff))
			return known[i].kind;
	return d->device.kind;
}

/* The object of the angle, by kind and axis. */
static bool is_angle(const struct decoder *d, uint16_t index)
{
	const bool lateral = d->device.axis == CANOPEN_LATERAL;
	const int kind = kind_of(d);
	const bool any = kind == CANOPEN_AUTO;

	switch (index) {
	case 0x6064:
		return any || kind == CANOPEN_DRIVE;
	case 0x6004:
		return any || kind == CANOPEN_ENCODER;
	case 0x6010:
	case 0x6110:
		return (any || kind == CANOPEN_INCLINOMETER) && !lateral;
	case 0x6020:
	case 0x6120:
		return (any || kind == CANOPEN_INCLINOMETER) && lateral;
	default:
		return false;
	}
}

/* Where the value of an object is kept, and its bytes; NULL: it is not. */
static struct value *value_of(struct decoder *d, uint16_t index, uint8_t sub, size_t *ret_size)
{
	const int group = index & 0xfe00, number = index & 0x1ff;
	struct pdo *pdo;

	*ret_size = 4;
	if (index == 0x1000 && sub == 0)
		return &d->type;
	if (index == 0x6000 && sub == 0) {
		*ret_size = 2;
		return &d->resolution;
	}
	if (group < 0x1400 || group > 0x1a00 || number >= PDOS)
		return NULL;
	pdo = &d->pdo[group >= 0x1800][number];
	if (group == 0x1400 || group == 0x1800) {
		*ret_size = sub == 1 ? 4 : 1;
		return sub == 1 ? &pdo->cob : sub == 2 ? &pdo->type : NULL;
	}
	*ret_size = sub == 0 ? 1 : 4;
	return sub == 0 ? &pdo->count : sub <= PDO_ENTRIES ? &pdo->entry[sub - 1] : NULL;
}

/* The defaults of C.5's profiles, for what is not known. */
static void profile_mapping(const struct decoder *d, int number, struct canopen_learned *ret)
{
	const int kind = kind_of(d);

	if (kind == CANOPEN_ENCODER && number < 2) {
		*ret = (struct canopen_learned){
		    .known = true, .type = number == 0 ? CANOPEN_TYPE_EVENT : 1, .n = 1, .entry = {0x60040020}};
	} else if (kind == CANOPEN_INCLINOMETER && number == 0) {
		*ret = (struct canopen_learned){.known = true, .type = 1, .n = 2, .entry = {0x60100010, 0x60200010}};
	}
}

static void pdo_of(const struct decoder *d, bool transmit, int number, struct canopen_learned *ret)
{
	const struct pdo *pdo = &d->pdo[transmit][number];
	const uint32_t first = transmit ? CANOPEN_TPDO : CANOPEN_RPDO;
	bool any = pdo->count.known;

	*ret = (struct canopen_learned){.type = CANOPEN_TYPE_EVENT};
	for (int i = 0; i < PDO_ENTRIES; i++)
		any |= pdo->entry[i].known;
	if (transmit && !any)
		profile_mapping(d, number, ret);
	if (pdo->count.known && pdo->count.v <= PDO_ENTRIES) {
		ret->known = true;
		ret->n = (int)pdo->count.v;
		for (int i = 0; i < ret->n; i++) {
			ret->known &= pdo->entry[i].known;
			ret->entry[i] = pdo->entry[i].v;
		}
	}
	ret->number = number;
	ret->type = pdo->type.known ? (uint8_t)pdo->type.v : ret->type;
	if (pdo->cob.known)
		ret->cob = pdo->cob.v;
	else
		ret->cob = number < 4 ? first + 0x100 * (uint32_t)number + (uint32_t)d->device.node : CANOPEN_COB_OFF;
}

void canopen_decoder_pdo(const struct decoder *d, bool transmit, int pdo, struct canopen_learned *ret)
{
	*ret = (struct canopen_learned){.cob = CANOPEN_COB_OFF};
	if (pdo >= 1 && pdo <= PDOS)
		pdo_of(d, transmit, pdo - 1, ret);
}

uint32_t canopen_decoder_type(const struct decoder *d)
{
	return d->type.known ? d->type.v : 0;
}

/* A request seen twice (as it was written and as it left, or repeated) is one. */
static void learn_request(struct decoder *d, const struct canopen_wire_sdo *sdo)
{
	struct value wanted = {.known = true}, *value;
	size_t size;

	if (sdo->kind == CANOPEN_SDO_ABORT && sdo->index == d->written.index && sdo->sub == d->written.sub)
		d->written.set = false; /* nobody knows what has become of it: as when answers are missing */
	if (sdo->kind != CANOPEN_SDO_DOWNLOAD || !sdo->expedited)
		return;
	value = value_of(d, sdo->index, sdo->sub, &size);
	if (!value) {
		d->written.set = false;
		return;
	}
	wanted.v = canopen_wire_number(sdo->data, sdo->len < size ? sdo->len : size);
	if (d->written.set && d->written.index == sdo->index && d->written.sub == sdo->sub &&
	    d->written.wanted.v == wanted.v)
		return;
	d->written.set = true;
	d->written.index = sdo->index;
	d->written.sub = sdo->sub;
	d->written.before = *value;
	d->written.wanted = *value = wanted;
}

static void learn_answer(struct decoder *d, const struct canopen_wire_sdo *sdo)
{
	const bool answers = d->written.set && d->written.index == sdo->index && d->written.sub == sdo->sub;
	struct value *value;
	size_t size;

	if (sdo->kind != CANOPEN_SDO_UPLOAD && sdo->kind != CANOPEN_SDO_DOWNLOAD && sdo->kind != CANOPEN_SDO_ABORT)
		return;
	value = value_of(d, sdo->index, sdo->sub, &size);
	if (value && sdo->kind == CANOPEN_SDO_UPLOAD && sdo->expedited)
		*value = (struct value){true, canopen_wire_number(sdo->data, sdo->len < size ? sdo->len : size)};
	if (value && sdo->kind == CANOPEN_SDO_ABORT && answers)
		*value = d->written.before;
	if (answers)
		d->written.set = false;
}

/* What the node was told is gone; what it is, it remains. */
static void forget(struct decoder *d)
{
	memset(d->pdo, 0, sizeof d->pdo);
	d->resolution = (struct value){0};
	d->written.set = false;
}

static void take_sync(struct decoder *d, const struct context *c)
{
	const int64_t gap_ns = c->f.t_ns - d->sync_ns;

	/* Where our frames come back, one that was only written has not left yet. */
	if (!c->sink && d->echoed)
		return;
	if (c->sink) {
		d->count[SYNCS]++;
		d->echoed = true;
		if (d->synced)
			d->sync_gap_ns = gap_ns > 0 && gap_ns < SYNC_MAX_NS ? gap_ns : 0;
	}
	d->synced = true;
	d->sync_ns = c->f.t_ns;
	for (int i = 0; i < PDOS; i++)
		canopen_pairing_sync(&d->pdo[1][i].pairing);
	say(d, c, CANOPEN_REPLY_SYNC, NULL, 0);
}

/* When the values of a TPDO were sampled; false: at one of several SYNCs. */
static bool sampled_ns(struct decoder *d, const struct context *c, const struct canopen_learned *pdo, int64_t *ret_ns)
{
	const int64_t gap_ns = d->sync_gap_ns > 0 ? d->sync_gap_ns : SYNC_DEFAULT_NS;
	const int64_t period_ns = d->device.sync_ns > 0 ? d->device.sync_ns : gap_ns;
	const int64_t late_ns = c->f.t_ns - d->sync_ns;
	const bool missed = !d->synced || late_ns < 0 || late_ns > period_ns;

	d->every = 0;
	*ret_ns = c->f.t_ns;
	if (pdo->type > CANOPEN_TYPE_SYNC_MAX)
		return true;
	d->every = pdo->type ? pdo->type : 1;
	/* Type 0 answers when something has changed, which need not be. */
	if (pdo->type && d->synced &&
	    !canopen_pairing_take(&d->pdo[1][pdo->number].pairing, pdo->type, late_ns, period_ns)) {
		d->count[UNDATED]++;
		return false;
	}
	if (missed) {
		d->count[SYNC_MISSED]++;
		return true;
	}
	jitter_note(&d->jitter, late_ns);
	*ret_ns = d->sync_ns;
	return true;
}

static bool scale_of(const struct decoder *d, double *ret_rad)
{
	const bool says = kind_of(d) == CANOPEN_INCLINOMETER && d->resolution.known && d->resolution.v > 0;

	*ret_rad = says ? (double)d->resolution.v * 0.001 * TRIG_DEG : 0;
	return says || d->device.count.scale > 0;
}

static void take_angle(struct decoder *d, const struct context *c, int64_t t_ns, int64_t count)
{
	struct canopen_angle angle = {.t_ns = t_ns, .count = count};
	double scale_rad;

	if (!scale_of(d, &scale_rad)) {
		d->count[NO_SCALE]++;
		return;
	}
	if (d->turned && t_ns <= d->angle_ns && t_ns > d->angle_ns - BACK_NS) {
		d->count[UNDATED]++;
		return;
	}
	angle.rad = canopen_angle_rad(&d->device, scale_rad, count);
	if (!(fabs(angle.rad) <= ANGLE_MAX_RAD)) {
		d->count[MALFORMED]++;
		return;
	}
	d->turned = true;
	d->angle_ns = t_ns;
	d->count[ANGLES]++;
	c->sink->tilt(c->sink->ctx, d->index, &(struct tilt){.t_ns = t_ns, .angle_rad = angle.rad});
	say(d, c, CANOPEN_REPLY_ANGLE, &angle, sizeof angle);
}

/* `bits` (1..64) from bit `at` of the data. */
static uint64_t bits_at(const uint8_t *data, unsigned at, unsigned bits)
{
	uint64_t v = 0;

	for (unsigned i = 0; i < bits; i++)
		v |= (uint64_t)(data[(at + i) / 8] >> (at + i) % 8 & 1) << i;
	return v;
}

static int64_t signed_of(uint64_t raw, unsigned bits)
{
	const uint64_t sign = UINT64_C(1) << (bits - 1);

	return (int64_t)((raw ^ sign) - sign);
}

/* `t_ns`: when it was sampled; NULL: nobody knows. */
static void take_value(struct decoder *d, const struct context *c, uint32_t entry, uint64_t raw, const int64_t *t_ns)
{
	struct canopen_value value = {.index = (uint16_t)(entry >> 16),
	                              .sub = (uint8_t)(entry >> 8),
	                              .bits = (uint8_t)entry,
	                              .value = (uint32_t)raw};
	/* Positions of encoders are unsigned; of 32 bits those below a preset are negative all the same. */
	const bool is_signed = value.index != 0x6004 || value.bits == 32;

	if (is_angle(d, value.index) && value.sub == 0) {
		if (t_ns)
			take_angle(d, c, *t_ns, is_signed ? signed_of(raw, value.bits) : (int64_t)raw);
	} else if (value.index == 0x6041 && value.bits == 16) {
		const uint16_t statusword = (uint16_t)raw;

		d->count[STATUSWORDS]++;
		say(d, c, CANOPEN_REPLY_STATUS, &statusword, sizeof statusword);
	} else if (value.index >= 0x1000) { /* below: dummies that fill a gap */
		say(d, c, CANOPEN_REPLY_VALUE, &value, sizeof value);
	}
}

static void take_pdo(struct decoder *d, const struct context *c, const struct canopen_learned *pdo)
{
	unsigned bits = 0, at = 0;
	int64_t t_ns;
	bool dated;

	for (int i = 0; i < pdo->n; i++)
		bits += pdo->entry[i] & 0xff;
	if (!pdo->known || pdo->n == 0) {
		d->count[UNMAPPED]++;
		return;
	}
	if (bits > c->f.len * 8u) {
		d->count[SHORT]++;
		return;
	}
	dated = sampled_ns(d, c, pdo, &t_ns);
	for (int i = 0; i < pdo->n; i++) {
		const unsigned n = pdo->entry[i] & 0xff;

		if (n >= 1 && n <= 64)
			take_value(d, c, pdo->entry[i], bits_at(c->f.data, at, n), dated ? &t_ns : NULL);
		at += n;
	}
}

/* A profile's second, lateral value may be missing: half a default is what some inclinometers send. */
static void shorten(const struct decoder *d, const struct context *c, int number, struct canopen_learned *pdo)
{
	if (!d->pdo[1][number].count.known && kind_of(d) == CANOPEN_INCLINOMETER && c->f.len < 4 && pdo->n == 2)
		pdo->n = 1;
}

static bool find_pdo(struct decoder *d, const struct context *c, bool transmit, struct canopen_learned *ret)
{
	for (int i = 0; i < PDOS; i++) {
		uint32_t id;

		pdo_of(d, transmit, i, ret);
		id = ret->cob & (ret->cob & CANOPEN_COB_EXTENDED ? CANOPEN_COB_ID : 0x7ffu);
		id |= ret->cob & CANOPEN_COB_EXTENDED ? CAN_WIRE_EXTENDED : 0;
		if (!(ret->cob & CANOPEN_COB_OFF) && id == c->f.id) {
			if (transmit)
				shorten(d, c, i, ret);
			return true;
		}
	}
	return false;
}

static void take_heartbeat(struct decoder *d, const struct context *c)
{
	const uint8_t state = c->f.data[0] & 0x7f;

	if (c->f.len < 1) {
		d->count[SHORT]++;
		return;
	}
	d->count[state == CANOPEN_BOOT_UP ? BOOT_UPS : HEARTBEATS]++;
	if (state == CANOPEN_BOOT_UP)
		forget(d);
	say(d, c, CANOPEN_REPLY_NMT, &state, sizeof state);
}

static void take_emcy(struct decoder *d, const struct context *c)
{
	struct canopen_wire_emcy emcy;

	if (!canopen_wire_parse_emcy(c->f.data, c->f.len, &emcy)) {
		d->count[SHORT]++;
		return;
	}
	d->count[EMERGENCIES]++;
	say(d, c, CANOPEN_REPLY_EMCY, &emcy, sizeof emcy);
}

static void take_answer(struct decoder *d, const struct context *c)
{
	struct canopen_wire_sdo sdo;

	if (!canopen_wire_parse_answer(c->f.data, c->f.len, &sdo)) {
		d->count[SHORT]++;
		return;
	}
	d->count[sdo.kind == CANOPEN_SDO_ABORT ? ABORTS : SDO]++;
	learn_answer(d, &sdo);
	say(d, c, CANOPEN_REPLY_SDO, c->f.data, c->f.len < 8 ? c->f.len : 8);
}

/* What facetd or another master says. */
static bool take_masters(struct decoder *d, const struct context *c)
{
	const uint32_t id = c->f.id;
	struct canopen_wire_sdo sdo;
	struct canopen_learned pdo;

	if (id == CANOPEN_SYNC) {
		take_sync(d, c);
	} else if (id == CANOPEN_SDO_REQUEST + (uint32_t)d->device.node) {
		if (canopen_wire_parse_request(c->f.data, c->f.len, &sdo))
			learn_request(d, &sdo);
	} else {
		return id == CANOPEN_NMT || id == CANOPEN_HEARTBEAT + (uint32_t)d->device.master ||
		       find_pdo(d, c, false, &pdo);
	}
	return true;
}

static void take_frame(struct decoder *d, const struct context *c)
{
	const uint32_t id = c->f.id, node = (uint32_t)d->device.node;
	struct canopen_learned pdo;

	if (c->f.id & CAN_WIRE_REMOTE || c->f.flags & CAN_WIRE_FD)
		d->count[FOREIGN]++;
	else if (id == CANOPEN_SDO_ANSWER + node)
		take_answer(d, c);
	else if (id == CANOPEN_HEARTBEAT + node)
		take_heartbeat(d, c);
	else if (id == CANOPEN_EMCY + node)
		take_emcy(d, c);
	else if (find_pdo(d, c, true, &pdo))
		take_pdo(d, c, &pdo);
	else if (!take_masters(d, c))
		d->count[FOREIGN]++;
}

static void take_entry(struct decoder *d, struct context *c)
{
	if (!c->sink) {
		c->f.t_ns = c->record->t_ns;
		take_masters(d, c);
		return;
	}
	if (c->f.t_ns == 0)
		c->f.t_ns = c->record->t_ns;
	if (c->f.t_ns < STATE_TIME_MIN || c->f.t_ns > STATE_TIME_MAX) {
		d->count[MALFORMED]++;
		return;
	}
	if (can_bus_take(&d->bus, &c->f)) {
		const uint8_t health = (uint8_t)d->bus.health;

		say(d, c, CANOPEN_REPLY_BUS, &health, sizeof health);
	}
	if (!(c->f.id & CAN_WIRE_ERROR))
		take_frame(d, c);
}

void canopen_decode(struct decoder *d, const struct record *record, const struct record_sink *sink)
{
	struct context c = {.record = record, .sink = record->direction == FROM_DEVICE ? sink : NULL};
	size_t at = 0;

	if (record->direction == LINK_OPENED) {
		can_bus_opened(&d->bus);
		d->synced = d->echoed = d->written.set = false;
		d->sync_gap_ns = 0;
		for (int i = 0; i < PDOS; i++)
			d->pdo[1][i].pairing = (struct canopen_pairing){0};
		return;
	}
	if (record->t_ns < STATE_TIME_MIN || record->t_ns > STATE_TIME_MAX) {
		d->count[MALFORMED]++;
		return;
	}
	while (at < record->len) {
		const ssize_t n = can_wire_get(record->bytes + at, record->len - at, &c.f);

		if (n <= 0) {
			d->count[MALFORMED]++;
			return;
		}
		take_entry(d, &c);
		at += (size_t)n;
	}
}

void canopen_counters(const struct decoder *d, struct decoder_counters *ret)
{
	ret->n = COUNTERS;
	for (int i = 0; i < COUNTERS; i++) {
		ret->counter[i].name = counter_name[i];
		ret->counter[i].count = d->count[i];
	}
	can_bus_counters(&d->bus, ret);
}

void canopen_timing(const struct decoder *d, struct decoder_timing *ret)
{
	const int64_t period_ns = d->device.sync_ns > 0 ? d->device.sync_ns : d->sync_gap_ns;

	*ret = (struct decoder_timing){.known = d->jitter.n > 0};
	if (d->every > 0 && period_ns > 0)
		ret->expected_hz = 1e9 / ((double)period_ns * (double)d->every);
	jitter_percentiles(&d->jitter, &ret->jitter_p50_ns, &ret->jitter_p99_ns);
}

static void value_state(struct state *s, struct value *value)
{
	state_bool(s, &value->known);
	state_u32(s, &value->v);
}

static void pdo_state(struct state *s, struct pdo *pdo)
{
	value_state(s, &pdo->cob);
	value_state(s, &pdo->type);
	value_state(s, &pdo->count);
	for (int i = 0; i < PDO_ENTRIES; i++)
		value_state(s, &pdo->entry[i]);
	canopen_pairing_state(s, &pdo->pairing);
}

static void fields_state(struct decoder *d, struct state *s)
{
	state_tag(s, "canopen1");
	for (int i = 0; i < 2 * PDOS; i++)
		pdo_state(s, &d->pdo[i / PDOS][i % PDOS]);
	value_state(s, &d->type);
	value_state(s, &d->resolution);
	state_bool(s, &d->written.set);
	state_u16(s, &d->written.index);
	state_u8(s, &d->written.sub);
	value_state(s, &d->written.wanted);
	value_state(s, &d->written.before);
	state_bool(s, &d->synced);
	state_bool(s, &d->echoed);
	state_time(s, &d->sync_ns);
	state_time(s, &d->sync_gap_ns);
	state_bool(s, &d->turned);
	state_time(s, &d->angle_ns);
	can_bus_state(s, &d->bus);
	for (int i = 0; i < COUNTERS; i++)
		state_u64(s, &d->count[i]);
}

void canopen_decoder_state(struct decoder *d, struct state *s)
{
	struct decoder *aside;

	if (!s->loading) {
		fields_state(d, s);
		return;
	}
	aside = canopen_decoder_create(&d->device, d->index);
	if (!aside) {
		s->failed = true;
		return;
	}
	fields_state(aside, s);
	if (s->failed) {
		const struct decoder fresh = {.device = d->device, .index = d->index};

		*d = fresh;
	} else {
		*d = *aside;
	}
	canopen_decoder_destroy(aside);
}

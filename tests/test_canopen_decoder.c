/* Law L7: angles, their times and replies of a CANopen node are a pure function of the recorded frames, whoever sent
 * them and whatever they hold. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "drivers/canopen_parts.h"

#define NODE  5
#define T0    INT64_C(1732200000000000000)
#define MS    INT64_C(1000000)
#define MILLI (0.001 * TRIG_DEG)

struct bed {
	struct config_device device;
	struct decoder *decoder;
	int64_t t_ns;
	int tilts, replies[8], bus;
	struct tilt tilt;
	struct canopen_angle angle;
	struct canopen_value value;
	struct canopen_wire_emcy emcy;
	uint8_t nmt, health;
	uint16_t statusword;
	int64_t sync_ns;
	size_t sdo_len;
};

static void take_tilt(void *ctx, int device, const struct tilt *tilt)
{
	struct bed *b = ctx;

	assert_int_equal(device, 7);
	b->tilt = *tilt;
	b->tilts++;
}

static void take_reply(void *ctx, int device, const struct reply *reply)
{
	struct bed *b = ctx;

	assert_int_equal(device, 7);
	if (reply->kind == CANOPEN_REPLY_BUS) {
		b->bus++;
		b->health = reply->payload[0];
		return;
	}
	assert_true(reply->kind >= 0 && reply->kind < 8);
	b->replies[reply->kind]++;
	switch (reply->kind) {
	case CANOPEN_REPLY_SDO:
		b->sdo_len = reply->len;
		break;
	case CANOPEN_REPLY_NMT:
		memcpy(&b->nmt, reply->payload, sizeof b->nmt);
		break;
	case CANOPEN_REPLY_EMCY:
		memcpy(&b->emcy, reply->payload, sizeof b->emcy);
		break;
	case CANOPEN_REPLY_SYNC:
		b->sync_ns = reply->t_ns;
		break;
	case CANOPEN_REPLY_STATUS:
		memcpy(&b->statusword, reply->payload, sizeof b->statusword);
		break;
	case CANOPEN_REPLY_ANGLE:
		memcpy(&b->angle, reply->payload, sizeof b->angle);
		break;
	default:
		memcpy(&b->value, reply->payload, sizeof b->value);
		break;
	}
}

static struct bed bed_of(int kind)
{
	struct bed b = {.device = {.name = "servo",
	                           .node = NODE,
	                           .master = 127,
	                           .kind = kind,
	                           .sync_ns = 10 * MS,
	                           .count = {.set = true, .scale = MILLI, .sign = 1}},
	                .t_ns = T0};

	b.decoder = canopen_decoder_create(&b.device, 7);
	assert_non_null(b.decoder);
	return b;
}

static void again(struct bed *b)
{
	canopen_decoder_destroy(b->decoder);
	b->decoder = canopen_decoder_create(&b->device, 7);
	assert_non_null(b->decoder);
}

static void feed(struct bed *b, enum direction direction, const struct can_frame_at *f)
{
	const struct record_sink sink = {.ctx = b, .tilt = take_tilt, .reply = take_reply};
	uint8_t entry[CAN_WIRE_ENTRY_FD];
	struct record record = {
	    .log_ns = b->t_ns, .t_ns = b->t_ns, .device = 7, .direction = direction, .bytes = entry};

	record.len = can_wire_put(f, entry);
	canopen_decode(b->decoder, &record, &sink);
}

/* On the bus `ms` after T0. */
static void bus(struct bed *b, double ms, uint32_t id, const char *bytes, int len)
{
	struct can_frame_at f = can_wire_frame(id, bytes, (uint8_t)len);

	f.t_ns = b->t_ns = T0 + (int64_t)(ms * 1e6);
	feed(b, FROM_DEVICE, &f);
}

static void written(struct bed *b, double ms, uint32_t id, const char *bytes, int len)
{
	const struct can_frame_at f = can_wire_frame(id, bytes, (uint8_t)len);

	b->t_ns = T0 + (int64_t)(ms * 1e6);
	feed(b, TO_DEVICE, &f);
}

static uint64_t counted(const struct bed *b, const char *name)
{
	struct decoder_counters counters;

	canopen_counters(b->decoder, &counters);
	for (int i = 0; i < counters.n; i++)
		if (strcmp(counters.counter[i].name, name) == 0)
			return counters.counter[i].count;
	fail_msg("no counter %s", name);
	return 0;
}

/* As read by somebody: object and value. */
static void told(struct bed *b, uint16_t index, uint8_t sub, uint8_t size, uint32_t value)
{
	struct canopen_wire_sdo sdo = {
	    .kind = CANOPEN_SDO_UPLOAD, .index = index, .sub = sub, .expedited = true, .sized = true, .len = size};
	uint8_t bytes[8];

	for (int i = 0; i < 4; i++)
		sdo.data[i] = (uint8_t)(value >> 8 * i);
	canopen_wire_put_answer(&sdo, bytes);
	bus(b, (double)(b->t_ns - T0) / 1e6, CANOPEN_SDO_ANSWER + NODE, (const char *)bytes, 8);
}

static void told_pdo(struct bed *b, int pdo, uint32_t cob, uint8_t type, int n, const uint32_t *entry)
{
	told(b, (uint16_t)(0x1800 + pdo), 1, 4, cob);
	told(b, (uint16_t)(0x1800 + pdo), 2, 1, type);
	told(b, (uint16_t)(0x1a00 + pdo), 0, 1, (uint32_t)n);
	for (int i = 0; i < n; i++)
		told(b, (uint16_t)(0x1a00 + pdo), (uint8_t)(i + 1), 4, entry[i]);
}

static const uint32_t status_position[] = {0x60410010, 0x60640020};

static void assert_angle(const struct bed *b, double rad)
{
	assert_true(fabs(b->tilt.angle_rad - rad) < 1e-12);
	assert_true(b->angle.rad == b->tilt.angle_rad);
	assert_int_equal(b->angle.t_ns, b->tilt.t_ns);
}

static void an_angle_sampled_at_sync_has_its_time(void **state)
{
	struct bed b = bed_of(CANOPEN_DRIVE);

	(void)state;
	told_pdo(&b, 0, 0x185, 1, 2, status_position);
	bus(&b, 10, 0x080, "", 0);
	bus(&b, 13, 0x185, "\x37\x16\xe8\x03\x00\x00", 6);
	assert_int_equal(b.tilts, 1);
	assert_int_equal(b.tilt.t_ns, T0 + 10 * MS);
	assert_angle(&b, 1000 * MILLI);
	assert_int_equal(b.angle.count, 1000);
	assert_int_equal(b.statusword, 0x1637);
	assert_int_equal(b.sync_ns, T0 + 10 * MS);

	/* A counter in the SYNC matters not. */
	bus(&b, 20, 0x080, "\x07", 1);
	bus(&b, 20.4, 0x185, "\x37\x16\x18\xfc\xff\xff", 6);
	assert_int_equal(b.tilt.t_ns, T0 + 20 * MS);
	assert_angle(&b, -1000 * MILLI);
	assert_int_equal(counted(&b, "angles"), 2);
	assert_int_equal(counted(&b, "statuswords"), 2);
	assert_int_equal(counted(&b, "sync missed"), 0);
	canopen_decoder_destroy(b.decoder);
}

/* Types 0 and 240 are sampled at it too, 254 is not. */
static void only_synchronous_types_take_the_time_of_sync(void **state)
{
	static const struct {
		int type;
		int64_t t_ns;
	} of[] = {{0, 10 * MS},   {1, 10 * MS},   {3, 10 * MS},  {240, 10 * MS},
	          {252, 12 * MS}, {254, 12 * MS}, {255, 12 * MS}};

	(void)state;
	for (size_t i = 0; i < sizeof of / sizeof of[0]; i++) {
		struct bed b = bed_of(CANOPEN_DRIVE);

		told_pdo(&b, 0, 0x185, (uint8_t)of[i].type, 2, status_position);
		bus(&b, 10, 0x080, "", 0);
		bus(&b, 12, 0x185, "\x37\x16\xe8\x03\x00\x00", 6);
		assert_int_equal(b.tilt.t_ns, T0 + of[i].t_ns);
		canopen_decoder_destroy(b.decoder);
	}
}

/* The SYNC before was lost on the way to us: the time of an older one would be wrong by a period. */
static void a_sync_that_is_too_old_is_not_the_angles(void **state)
{
	(void)state;
	for (int ours = 0; ours < 2; ours++) {
		struct bed b = bed_of(CANOPEN_DRIVE);

		b.device.sync_ns = ours ? 10 * MS : 0;
		again(&b);
		told_pdo(&b, 0, 0x185, 1, 2, status_position);
		bus(&b, 5, 0x185, "\x37\x16\x01\x00\x00\x00", 6); /* no SYNC was ever seen */
		assert_int_equal(b.tilt.t_ns, T0 + 5 * MS);
		for (int i = 1; i <= 3; i++) {
			bus(&b, 10 * i, 0x080, "", 0);
			bus(&b, 10 * i + 0.5, 0x185, "\x37\x16\x02\x00\x00\x00", 6);
			assert_int_equal(b.tilt.t_ns, T0 + 10 * i * MS);
		}
		bus(&b, 40.5, 0x185, "\x37\x16\x03\x00\x00\x00", 6);
		assert_int_equal(b.tilt.t_ns, T0 + 40 * MS + MS / 2);
		assert_int_equal(counted(&b, "sync missed"), 2);
		canopen_decoder_destroy(b.decoder);
	}
}

/* With an echo, the SYNC is where it comes by on the bus: one that was only written is not on it yet. Without, its
 * writing is all that is known. */
static void a_written_sync_counts_only_where_nothing_comes_back(void **state)
{
	struct bed b = bed_of(CANOPEN_DRIVE);

	(void)state;
	told_pdo(&b, 0, 0x185, 1, 2, status_position);
	written(&b, 10, 0x080, "", 0);
	bus(&b, 11, 0x185, "\x37\x16\x01\x00\x00\x00", 6);
	assert_int_equal(b.tilt.t_ns, T0 + 10 * MS);
	assert_int_equal(b.replies[CANOPEN_REPLY_SYNC], 0);

	bus(&b, 20.2, 0x080, "", 0);
	written(&b, 30, 0x080, "", 0); /* an answer to the one before is read before the echo */
	bus(&b, 29.9, 0x185, "\x37\x16\x02\x00\x00\x00", 6);
	assert_int_equal(b.tilt.t_ns, T0 + 20 * MS + MS / 5);
	bus(&b, 30.3, 0x080, "", 0);
	bus(&b, 30.9, 0x185, "\x37\x16\x03\x00\x00\x00", 6);
	assert_int_equal(b.tilt.t_ns, T0 + 30 * MS + 3 * MS / 10);
	assert_int_equal(counted(&b, "syncs"), 2);
	assert_int_equal(counted(&b, "sync missed"), 0);
	canopen_decoder_destroy(b.decoder);
}

/* Two angles of the same SYNC, and one that overtakes: the first of a time is the one. */
static void no_angle_goes_back_in_time(void **state)
{
	struct bed b = bed_of(CANOPEN_DRIVE);

	(void)state;
	told_pdo(&b, 0, 0x185, 1, 2, status_position);
	bus(&b, 10, 0x080, "", 0);
	bus(&b, 11, 0x185, "\x37\x16\x01\x00\x00\x00", 6);
	bus(&b, 12, 0x185, "\x37\x16\x02\x00\x00\x00", 6);
	assert_int_equal(b.tilts, 1);
	assert_int_equal(counted(&b, "undated"), 1);
	assert_int_equal(b.replies[CANOPEN_REPLY_STATUS], 2); /* the rest of it is news */
	bus(&b, -5000, 0x080, "", 0);                         /* another time base */
	bus(&b, -4999, 0x185, "\x37\x16\x02\x00\x00\x00", 6);
	assert_int_equal(b.tilts, 2);
	canopen_decoder_destroy(b.decoder);
}

static void a_mapping_is_learned_from_either_direction(void **state)
{
	static const char *const request[] = {"\x23\x00\x18\x01\x85\x01\x00\x80", "\x2f\x00\x18\x02\x01\x00\x00\x00",
	                                      "\x2f\x00\x1a\x00\x00\x00\x00\x00", "\x23\x00\x1a\x01\x10\x00\x41\x60",
	                                      "\x23\x00\x1a\x02\x20\x00\x64\x60", "\x2f\x00\x1a\x00\x02\x00\x00\x00",
	                                      "\x23\x00\x18\x01\x85\x01\x00\x00"};

	(void)state;
	for (int how = 1; how < 8; how++) { /* written, echoed, answered */
		struct bed b = bed_of(CANOPEN_DRIVE);
		struct canopen_learned learned;

		for (int i = 0; i < 7; i++) {
			char answer[8] = "\x60";

			memcpy(answer + 1, request[i] + 1, 3);
			if (how & 1)
				written(&b, i, 0x605, request[i], 8);
			if (how & 2)
				bus(&b, i, 0x605, request[i], 8);
			if (how & 4)
				bus(&b, i + 0.5, 0x585, answer, 8);
			if (i < 6) { /* off, or not mapped yet */
				bus(&b, i + 0.6, 0x185, "\x37\x16\xe8\x03\x00\x00", 6);
				assert_int_equal(b.tilts, 0);
			}
		}
		bus(&b, 10, 0x080, "", 0);
		bus(&b, 11, 0x185, "\x37\x16\xe8\x03\x00\x00", 6);
		assert_int_equal(b.tilts, how & 3 ? 1 : 0);
		canopen_decoder_pdo(b.decoder, true, 1, &learned);
		assert_int_equal(learned.known, (how & 3) != 0);
		canopen_decoder_destroy(b.decoder);
	}
}

static void what_the_node_refuses_is_not_learned(void **state)
{
	(void)state;
	for (int echo = 0; echo < 2; echo++) {
		struct bed b = bed_of(CANOPEN_DRIVE);
		struct canopen_learned learned;

		told_pdo(&b, 0, 0x185, 1, 2, status_position);
		written(&b, 1, 0x605, "\x23\x00\x1a\x02\x20\x00\x6c\x60", 8);
		if (echo)
			bus(&b, 1, 0x605, "\x23\x00\x1a\x02\x20\x00\x6c\x60", 8);
		canopen_decoder_pdo(b.decoder, true, 1, &learned);
		assert_int_equal(learned.entry[1], 0x606c0020);
		bus(&b, 2, 0x585, "\x80\x00\x1a\x03\x22\x00\x00\x08", 8); /* of another */
		canopen_decoder_pdo(b.decoder, true, 1, &learned);
		assert_int_equal(learned.entry[1], 0x606c0020);
		bus(&b, 2, 0x585, "\x80\x00\x1a\x02\x22\x00\x00\x08", 8);
		canopen_decoder_pdo(b.decoder, true, 1, &learned);
		assert_int_equal(learned.entry[1], 0x60640020);
		assert_int_equal(counted(&b, "aborts"), 2);
		bus(&b, 3, 0x605, "\x2f\x00\x18\x02\xfe\x00\x00\x00", 8); /* the next is its own */
		bus(&b, 3, 0x585, "\x60\x00\x18\x02\x00\x00\x00\x00", 8);
		bus(&b, 4, 0x585, "\x80\x00\x18\x02\x22\x00\x00\x08", 8); /* not about it any more */
		canopen_decoder_pdo(b.decoder, true, 1, &learned);
		assert_int_equal(learned.type, 254);
		canopen_decoder_destroy(b.decoder);
	}
}

/* A mapping whose size is not said, in short answers. */
static void odd_answers_teach_too(void **state)
{
	struct bed b = bed_of(CANOPEN_DRIVE);
	struct canopen_learned learned;

	(void)state;
	bus(&b, 0, 0x585, "\x42\x00\x1a\x00\x01\xaa\xbb\xcc", 8);
	bus(&b, 0, 0x585, "\x43\x00\x1a\x01\x20\x00\x64\x60", 8);
	bus(&b, 0, 0x585, "\x4f\x00\x18\x02\x05", 5);
	assert_int_equal(b.sdo_len, 5);
	canopen_decoder_pdo(b.decoder, true, 1, &learned);
	assert_true(learned.known);
	assert_int_equal(learned.n, 1);
	assert_int_equal(learned.entry[0], 0x60640020);
	assert_int_equal(learned.type, 5);
	assert_int_equal(learned.cob, 0x185); /* by the standard, as long as nobody says otherwise */
	bus(&b, 0, 0x585, "\x4f\x00\x18", 3);
	assert_int_equal(counted(&b, "short"), 1);
	canopen_decoder_pdo(b.decoder, true, 0, &learned);
	assert_false(learned.known);
	canopen_decoder_pdo(b.decoder, true, 9, &learned);
	assert_int_equal(learned.cob, CANOPEN_COB_OFF);
	canopen_decoder_destroy(b.decoder);
}

static void a_node_that_boots_has_forgotten_its_mapping(void **state)
{
	struct bed b = bed_of(CANOPEN_DRIVE);

	(void)state;
	told(&b, 0x1000, 0, 4, 0x00020192);
	told_pdo(&b, 0, 0x185, 254, 2, status_position);
	bus(&b, 1, 0x185, "\x37\x16\xe8\x03\x00\x00", 6);
	assert_int_equal(b.tilts, 1);
	bus(&b, 2, 0x705, "\x00", 1);
	assert_int_equal(b.nmt, CANOPEN_BOOT_UP);
	bus(&b, 3, 0x185, "\x37\x16\xe8\x03\x00\x00", 6);
	assert_int_equal(b.tilts, 1);
	assert_int_equal(counted(&b, "not mapped"), 1);
	assert_int_equal(canopen_decoder_type(b.decoder), 0x00020192);
	canopen_decoder_destroy(b.decoder);
}

static void a_pdo_is_found_wherever_its_id_was_moved(void **state)
{
	static const uint32_t entry[] = {0x60640020};
	struct bed b = bed_of(CANOPEN_DRIVE);

	(void)state;
	told_pdo(&b, 1, 0x2aa, 254, 1, entry);
	bus(&b, 1, 0x285, "\xe8\x03\x00\x00", 4);
	assert_int_equal(b.tilts, 0);
	bus(&b, 2, 0x2aa, "\xe8\x03\x00\x00", 4);
	assert_int_equal(b.tilts, 1);
	told(&b, 0x1801, 1, 4, 0x2aa | CANOPEN_COB_EXTENDED | CANOPEN_COB_NO_RTR);
	bus(&b, 3, 0x2aa, "\xe8\x03\x00\x00", 4);
	assert_int_equal(b.tilts, 1);
	bus(&b, 4, 0x2aa | CAN_WIRE_EXTENDED, "\xe8\x03\x00\x00", 4);
	assert_int_equal(b.tilts, 2);
	told(&b, 0x1801, 1, 4, 0x2aa | CANOPEN_COB_OFF);
	bus(&b, 5, 0x2aa, "\xe8\x03\x00\x00", 4);
	assert_int_equal(b.tilts, 2);
	assert_int_equal(counted(&b, "foreign"), 3);
	canopen_decoder_destroy(b.decoder);
}

static void encoders_and_inclinometers_are_known_by_their_profile(void **state)
{
	struct bed b = bed_of(CANOPEN_ENCODER);

	(void)state;
	bus(&b, 10, 0x080, "", 0);
	bus(&b, 11, 0x185, "\x10\x27\x00\x00", 4); /* TPDO1: when it likes */
	assert_int_equal(b.tilt.t_ns, T0 + 11 * MS);
	assert_angle(&b, 10000 * MILLI);
	bus(&b, 20, 0x080, "", 0);
	bus(&b, 21, 0x285, "\xf0\xd8\xff\xff", 4); /* TPDO2: at SYNC */
	assert_int_equal(b.tilt.t_ns, T0 + 20 * MS);
	assert_angle(&b, -10000 * MILLI);
	canopen_decoder_destroy(b.decoder);

	b = bed_of(CANOPEN_AUTO); /* by its object 1000 */
	b.device.count.scale = 0;
	again(&b);
	bus(&b, 5, 0x185, "\xe8\x03\x0c\xfe", 4);
	assert_int_equal(counted(&b, "not mapped"), 1);
	told(&b, 0x1000, 0, 4, 0x0002019a);
	bus(&b, 10, 0x080, "", 0);
	bus(&b, 11, 0x185, "\xe8\x03\x0c\xfe", 4);
	assert_int_equal(counted(&b, "no scale"), 1);
	told(&b, 0x6000, 0, 2, 10);
	bus(&b, 20, 0x080, "", 0);
	bus(&b, 21, 0x185, "\xe8\x03\x0c\xfe", 4);
	assert_angle(&b, 10 * TRIG_DEG);
	assert_int_equal(b.tilt.t_ns, T0 + 20 * MS);
	bus(&b, 30, 0x080, "", 0);
	bus(&b, 31, 0x185, "\xd0\x07", 2); /* without the second axis */
	assert_angle(&b, 20 * TRIG_DEG);
	b.device.axis = CANOPEN_LATERAL;
	again(&b);
	told(&b, 0x1000, 0, 4, 0x0002019a);
	told(&b, 0x6000, 0, 2, 100);
	bus(&b, 40, 0x185, "\xe8\x03\x0c\xfe", 4);
	assert_angle(&b, -50 * TRIG_DEG);
	canopen_decoder_destroy(b.decoder);
}

/* 32-bit slopes, in a mapping of their own. */
static void fine_slopes_are_read(void **state)
{
	static const uint32_t entry[] = {0x61200020, 0x61100020};
	struct bed b = bed_of(CANOPEN_INCLINOMETER);

	(void)state;
	b.device.count.scale = 0;
	again(&b);
	told(&b, 0x6000, 0, 2, 1);
	told_pdo(&b, 0, 0x185, 254, 2, entry);
	bus(&b, 1, 0x185, "\x00\x00\x00\x00\x60\x79\xfe\xff", 8);
	assert_angle(&b, -100000 * MILLI);
	assert_int_equal(b.value.index, 0x6120);
	canopen_decoder_destroy(b.decoder);
}

/* Of a drive only 6064 is the angle, whatever else is mapped. */
static void only_the_object_of_the_kind_is_the_angle(void **state)
{
	static const uint32_t entry[] = {0x60040020, 0x60640020};
	struct bed b = bed_of(CANOPEN_DRIVE);

	(void)state;
	told_pdo(&b, 0, 0x185, 254, 2, entry);
	bus(&b, 1, 0x185, "\x01\x00\x00\x00\x02\x00\x00\x00", 8);
	assert_int_equal(b.tilts, 1);
	assert_int_equal(b.angle.count, 2);
	assert_int_equal(b.value.index, 0x6004);
	assert_int_equal(b.value.value, 1);
	canopen_decoder_destroy(b.decoder);
}

/* Objects of a few bits, and gaps. */
static void bits_are_taken_where_they_lie(void **state)
{
	static const uint32_t entry[] = {0x00050004, 0x60640014, 0x20000101, 0x00010007, 0x60410010};
	struct bed b = bed_of(CANOPEN_DRIVE);

	(void)state;
	told_pdo(&b, 0, 0x185, 254, 5, entry);
	bus(&b, 1, 0x185, "\x8f\xff\xff\x01\x31\x02", 6);
	assert_int_equal(b.angle.count, -8);
	assert_int_equal(b.value.index, 0x2000);
	assert_int_equal(b.value.sub, 1);
	assert_int_equal(b.value.value, 1);
	assert_int_equal(b.statusword, 0x0231);
	assert_int_equal(b.replies[CANOPEN_REPLY_VALUE], 1);
	bus(&b, 2, 0x185, "\x8f\xff\xff\x01\x31", 5);
	assert_int_equal(counted(&b, "short"), 1);
	assert_int_equal(b.tilts, 1);
	canopen_decoder_destroy(b.decoder);
}

static void counts_wrap_and_turn_by_the_configuration(void **state)
{
	static const struct {
		double zero, wrap, rad;
		int sign;
		int64_t count;
	} of[] = {
	    {0, 0, 1000 * MILLI, 1, 1000},
	    {0, 0, -1000 * MILLI, -1, 1000},
	    {400, 0, 600 * MILLI, 1, 1000},
	    {0, 4096, -96 * MILLI, 1, 4000},
	    {4000, 4096, 196 * MILLI, 1, 100},
	    {0, 4096, -2048 * MILLI, 1, 2048},
	    {0, 4294967296.0, -1 * MILLI, 1, 4294967295},
	};

	(void)state;
	for (size_t i = 0; i < sizeof of / sizeof of[0]; i++) {
		struct config_device device = {
		    .count = {.zero = of[i].zero, .wrap = of[i].wrap, .sign = of[i].sign, .scale = MILLI}};

		assert_true(fabs(canopen_angle_rad(&device, 0, of[i].count) - of[i].rad) < 1e-12);
		device.count.wrap = 0;
		assert_true(fabs(canopen_angle_count(&device, 0, canopen_angle_rad(&device, 0, of[i].count)) -
		                 (double)of[i].count) < 1e-5);
		device.count.scale = 0;
		assert_true(fabs(canopen_angle_count(&device, MILLI, MILLI) - of[i].sign - of[i].zero) < 1e-9);
	}
}

static void heartbeats_and_emergencies_are_told(void **state)
{
	struct bed b = bed_of(CANOPEN_DRIVE);

	(void)state;
	bus(&b, 1, 0x705, "\x7f", 1);
	assert_int_equal(b.nmt, CANOPEN_PREOPERATIONAL);
	bus(&b, 2, 0x705, "\x85", 1); /* node guarding toggles */
	assert_int_equal(b.nmt, CANOPEN_OPERATIONAL);
	bus(&b, 3, 0x705, "", 0);
	assert_int_equal(counted(&b, "heartbeats"), 2);
	bus(&b, 4, 0x085, "\x30\x81\x11\x01\x02\x03\x04\x05", 8);
	assert_int_equal(b.emcy.code, 0x8130);
	assert_int_equal(b.emcy.error_register, 0x11);
	assert_memory_equal(b.emcy.vendor, "\1\2\3\4\5", 5);
	bus(&b, 5, 0x085, "\x00\x00\x00", 3);
	assert_int_equal(b.emcy.code, 0);
	bus(&b, 6, 0x085, "\x00\x00", 2);
	assert_int_equal(counted(&b, "emergencies"), 2);
	assert_int_equal(counted(&b, "short"), 2);
	canopen_decoder_destroy(b.decoder);
}

static void other_nodes_and_other_frames_are_counted_and_left(void **state)
{
	static const uint32_t foreign[] = {
	    0x186, 0x706, 0x086, 0x586, 0x185 | CAN_WIRE_EXTENDED, 0x185 | CAN_WIRE_REMOTE, 0x7ff};
	static const uint32_t masters[] = {0x000, 0x605, 0x77f, 0x205, 0x305};
	struct bed b = bed_of(CANOPEN_DRIVE);
	struct can_frame_at fd = {.id = 0x185, .len = 12, .flags = CAN_WIRE_FD, .t_ns = T0};

	(void)state;
	told_pdo(&b, 0, 0x185, 254, 2, status_position);
	for (size_t i = 0; i < sizeof foreign / sizeof foreign[0]; i++)
		bus(&b, 1, foreign[i], "\x00\x01\x02\x03\x04\x05\x06\x07", 8);
	feed(&b, FROM_DEVICE, &fd);
	for (size_t i = 0; i < sizeof masters / sizeof masters[0]; i++)
		bus(&b, 1, masters[i], "\x40\x01\x02\x03\x04\x05\x06\x07", 8);
	assert_int_equal(counted(&b, "foreign"), sizeof foreign / sizeof foreign[0] + 1);
	assert_int_equal(b.tilts, 0);
	assert_int_equal(b.replies[CANOPEN_REPLY_NMT] + b.replies[CANOPEN_REPLY_EMCY], 0);
	canopen_decoder_destroy(b.decoder);
}

static void changes_of_the_bus_are_told(void **state)
{
	struct bed b = bed_of(CANOPEN_DRIVE);

	(void)state;
	bus(&b, 1, CAN_WIRE_ERROR | CAN_WIRE_ERROR_BUS_OFF, "\0\0\0\0\0\0\0\0", 8);
	assert_int_equal(b.bus, 1);
	assert_int_equal(b.health, CAN_BUS_OFF);
	bus(&b, 2, CAN_WIRE_ERROR | CAN_WIRE_ERROR_BUS_OFF, "\0\0\0\0\0\0\0\0", 8);
	assert_int_equal(b.bus, 1);
	bus(&b, 3, CAN_WIRE_LOST, "\3\0\0\0\1\0\0\0", 8);
	bus(&b, 4, 0x705, "\x05", 1);
	assert_int_equal(b.bus, 2);
	assert_int_equal(b.health, CAN_BUS_ACTIVE);
	canopen_decoder_destroy(b.decoder);
}

static void what_is_no_entry_is_counted(void **state)
{
	struct bed b = bed_of(CANOPEN_DRIVE);
	const struct record_sink sink = {.ctx = &b, .tilt = take_tilt, .reply = take_reply};
	uint8_t bytes[CAN_WIRE_ENTRY] = {0};
	struct record record = {.t_ns = T0, .bytes = bytes};

	(void)state;
	for (record.len = 1; record.len < sizeof bytes; record.len++)
		canopen_decode(b.decoder, &record, &sink);
	bytes[4] = 9;
	canopen_decode(b.decoder, &record, &sink);
	bytes[4] = 0;
	bytes[23] = 0x80; /* a time long ago */
	canopen_decode(b.decoder, &record, &sink);
	record.t_ns = INT64_MIN;
	canopen_decode(b.decoder, &record, &sink);
	assert_int_equal(counted(&b, "malformed"), sizeof bytes - 1 + 3);

	/* An angle that nothing can look at. */
	b.device.count.scale = 6;
	again(&b);
	told_pdo(&b, 0, 0x185, 254, 2, status_position);
	bus(&b, 1, 0x185, "\x37\x16\xff\xff\xff\x7f", 6);
	assert_int_equal(b.tilts, 0);
	assert_int_equal(counted(&b, "malformed"), 1);
	canopen_decoder_destroy(b.decoder);
}

/* A mapping of more than is kept, of more bits than a frame has, of nothing. */
static void no_mapping_reads_beyond_the_frame(void **state)
{
	static const uint32_t wide[] = {0x606400ff, 0x60640041, 0x60640040, 0x60640000};

	(void)state;
	for (int n = 0; n < 256; n += n < 10 ? 1 : 49)
		for (size_t i = 0; i < 4; i++) {
			struct bed b = bed_of(CANOPEN_DRIVE);

			told_pdo(&b, 0, 0x185, 254, 0, wide);
			told(&b, 0x1a00, 0, 1, (uint32_t)n);
			for (int k = 0; k < n && k < 16; k++)
				told(&b, 0x1a00, (uint8_t)(k + 1), 4, wide[i]);
			for (int len = 0; len <= 8; len++)
				bus(&b, 1 + len, 0x185, "\1\2\3\4\5\6\7\10", len);
			assert_int_equal(b.tilts, 0);
			assert_int_equal(counted(&b, "not mapped") + counted(&b, "short") + counted(&b, "malformed"),
			                 n >= 1 && n <= 8 && i == 3 ? 0 : 9);
			canopen_decoder_destroy(b.decoder);
		}
}

/* A session with everything, cut at any place: from a snapshot it goes on alike. */
static void play(struct bed *b, int from, int to)
{
	for (int i = from; i < to; i++) {
		switch (i) {
		case 0:
			told(b, 0x1000, 0, 4, 0x00020192);
			break;
		case 1:
			told_pdo(b, 0, 0x185, 1, 2, status_position);
			break;
		case 2:
			written(b, 2, 0x605, "\x2f\x00\x18\x02\x02\x00\x00\x00", 8);
			break;
		case 3:
			bus(b, 3, 0x605, "\x2f\x00\x18\x02\x02\x00\x00\x00", 8);
			break;
		case 4:
			bus(b, 4, 0x585, "\x80\x00\x18\x02\x22\x00\x00\x08", 8);
			break;
		case 5:
			bus(b, 5, CAN_WIRE_ERROR | CAN_WIRE_ERROR_BUS_OFF, "\0\0\0\0\0\0\0\0", 8);
			break;
		default:
			if (i % 2)
				bus(b, i, 0x185, "\x37\x16\xe8\x03\x00\x00", 6);
			else
				bus(b, i, 0x080, "", 0);
			break;
		}
	}
}

static void from_a_snapshot_it_goes_on_alike(void **state)
{
	(void)state;
	for (int cut = 0; cut <= 12; cut++) {
		struct bed whole = bed_of(CANOPEN_AUTO), first = bed_of(CANOPEN_AUTO), rest = bed_of(CANOPEN_AUTO);
		uint8_t bytes[4096], other[4096];
		struct state s;

		play(&whole, 0, 14);
		play(&first, 0, cut);
		state_save(&s, bytes, sizeof bytes);
		canopen_decoder_state(first.decoder, &s);
		assert_true(state_done(&s));
		const size_t len = s.at;

		for (size_t less = 0; less < len; less += 7) { /* one that is cut leaves it as new */
			state_load(&s, bytes, less);
			canopen_decoder_state(rest.decoder, &s);
			assert_true(s.failed);
			assert_int_equal(canopen_decoder_type(rest.decoder), 0);
		}
		state_load(&s, bytes, len);
		canopen_decoder_state(rest.decoder, &s);
		assert_true(state_done(&s));
		rest.t_ns = first.t_ns;
		play(&rest, cut, 14);
		assert_int_equal(rest.tilts + first.tilts, whole.tilts);
		assert_true(whole.tilts > 2);
		assert_int_equal(rest.tilt.t_ns, whole.tilt.t_ns);
		state_save(&s, bytes, sizeof bytes);
		canopen_decoder_state(whole.decoder, &s);
		state_save(&s, other, sizeof other);
		canopen_decoder_state(rest.decoder, &s);
		assert_int_equal(s.at, len);
		assert_memory_equal(bytes, other, len);
		canopen_decoder_destroy(whole.decoder);
		canopen_decoder_destroy(first.decoder);
		canopen_decoder_destroy(rest.decoder);
	}
}

static void the_status_says_how_it_keeps_time(void **state)
{
	static const struct record opened = {.direction = LINK_OPENED, .t_ns = T0};
	struct bed b = bed_of(CANOPEN_DRIVE);
	struct decoder_timing timing;

	(void)state;
	canopen_timing(b.decoder, &timing);
	assert_false(timing.known);
	told_pdo(&b, 0, 0x185, 2, 2, status_position);
	for (int i = 1; i < 20; i++) {
		bus(&b, 10 * i, 0x080, "", 0);
		if (i % 2)
			bus(&b, 10 * i + (i % 4 == 1 ? 3 : 4), 0x185, "\x37\x16\xe8\x03\x00\x00", 6);
	}
	canopen_timing(b.decoder, &timing);
	assert_true(timing.known);
	assert_true(fabs(timing.expected_hz - 50) < 1e-9);
	assert_int_equal(timing.jitter_p99_ns, MS); /* behind the least delayed */
	canopen_decode(b.decoder, &opened, &(struct record_sink){.ctx = &b});
	bus(&b, 203, 0x185, "\x37\x16\xe8\x03\x00\x00", 6); /* what came before is no SYNC of this link */
	assert_int_equal(counted(&b, "sync missed"), 1);
	canopen_decoder_destroy(b.decoder);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(an_angle_sampled_at_sync_has_its_time),
	    cmocka_unit_test(only_synchronous_types_take_the_time_of_sync),
	    cmocka_unit_test(a_sync_that_is_too_old_is_not_the_angles),
	    cmocka_unit_test(a_written_sync_counts_only_where_nothing_comes_back),
	    cmocka_unit_test(no_angle_goes_back_in_time),
	    cmocka_unit_test(a_mapping_is_learned_from_either_direction),
	    cmocka_unit_test(what_the_node_refuses_is_not_learned),
	    cmocka_unit_test(odd_answers_teach_too),
	    cmocka_unit_test(a_node_that_boots_has_forgotten_its_mapping),
	    cmocka_unit_test(a_pdo_is_found_wherever_its_id_was_moved),
	    cmocka_unit_test(encoders_and_inclinometers_are_known_by_their_profile),
	    cmocka_unit_test(fine_slopes_are_read),
	    cmocka_unit_test(only_the_object_of_the_kind_is_the_angle),
	    cmocka_unit_test(bits_are_taken_where_they_lie),
	    cmocka_unit_test(counts_wrap_and_turn_by_the_configuration),
	    cmocka_unit_test(heartbeats_and_emergencies_are_told),
	    cmocka_unit_test(other_nodes_and_other_frames_are_counted_and_left),
	    cmocka_unit_test(changes_of_the_bus_are_told),
	    cmocka_unit_test(what_is_no_entry_is_counted),
	    cmocka_unit_test(no_mapping_reads_beyond_the_frame),
	    cmocka_unit_test(from_a_snapshot_it_goes_on_alike),
	    cmocka_unit_test(the_status_says_how_it_keeps_time),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

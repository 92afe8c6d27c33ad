/* Laws L7 and L8: no frames crash the decoder of CANopen nodes, its SDO client, its set-up or its dialogue, or give an
 * angle that is no number; a snapshot says all that it goes on from. The first two bytes choose device and transfer;
 * what follows are whole entries of frames, or short ones: a byte of who, which way and when, a length, the data; or
 * an answer, good in form, to what was asked last, so that inputs come far. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "drivers/canopen_parts.h"
#include "drivers/canopen_setup.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

#define NODE   5
#define T0     INT64_C(1732200000000000000)
#define STATE  8192
#define ANSWER 0x123 /* this side makes it */

struct bed {
	struct decoder *decoder;
	struct dialogue *dialogue;
	struct canopen_sdo sdo;
	struct canopen_setup setup;
	int64_t t_ns;
	struct can_frame_at asked[3]; /* last request of the dialogue, of `sdo`, of `setup` */
};

static void must(bool condition)
{
	if (!condition)
		abort();
}

static void take_tilt(void *ctx, int device, const struct tilt *tilt)
{
	struct bed *b = ctx;

	(void)device;
	must(fabs(tilt->angle_rad) <= TRIG_ANGLE_MAX);
	driver_canopen.dialogue_data(b->dialogue, b->t_ns);
}

/* Where the length is not said, as many come back as have room. */
static void must_be_alike(const struct canopen_wire_sdo *a, const struct canopen_wire_sdo *b)
{
	must(a->kind == b->kind && a->index == b->index && a->sub == b->sub && a->abort == b->abort);
	must(a->toggle == b->toggle && a->last == b->last && a->size == b->size);
	must(a->len == b->len || (a->expedited && !a->sized));
	must(memcmp(a->data, b->data, sizeof a->data) == 0);
}

/* What is parsed can be put again, and everything has a name. */
static void try_words(const uint8_t *data, size_t len)
{
	struct canopen_wire_sdo sdo, back;
	uint8_t bytes[8];

	if (canopen_wire_parse_request(data, len, &sdo) && sdo.kind < CANOPEN_SDO_OTHER) {
		canopen_wire_put_request(&sdo, bytes);
		must(canopen_wire_parse_request(bytes, sizeof bytes, &back));
		must_be_alike(&sdo, &back);
	}
	if (canopen_wire_parse_answer(data, len, &sdo) && sdo.kind < CANOPEN_SDO_OTHER) {
		canopen_wire_put_answer(&sdo, bytes);
		must(canopen_wire_parse_answer(bytes, sizeof bytes, &back));
		must_be_alike(&sdo, &back);
		must(canopen_wire_abort_text(sdo.abort)[0] != 0);
	}
	if (len < 2)
		return;
	must(canopen_wire_emcy_text((uint16_t)canopen_wire_number(data, 2))[0] != 0);
	must(canopen_wire_nmt_text(data[0])[0] != 0);
	must(canopen_wire_drive_text(canopen_wire_drive_state((uint16_t)canopen_wire_number(data, 2)))[0] != 0);
}

static void take_reply(void *ctx, int device, const struct reply *reply)
{
	struct bed *b = ctx;

	(void)device;
	must(reply->len <= REPLY_MAX);
	driver_canopen.dialogue_reply(b->dialogue, reply);
	try_words(reply->payload, reply->len);
	if (reply->kind == CANOPEN_REPLY_EMCY) {
		struct canopen_wire_emcy emcy;

		memcpy(&emcy, reply->payload, sizeof emcy);
		must(canopen_wire_emcy(NODE, &emcy).len == 8);
	}
	if (reply->kind == CANOPEN_REPLY_SDO) {
		canopen_sdo_answer(&b->sdo, reply->payload, reply->len);
		canopen_setup_answer(&b->setup, reply->payload, reply->len);
	}
}

static void decode(struct bed *b, enum direction direction, const uint8_t *bytes, size_t len)
{
	const struct record_sink sink = {.ctx = b, .tilt = take_tilt, .reply = take_reply};
	const struct record record = {
	    .log_ns = b->t_ns, .t_ns = b->t_ns, .direction = direction, .bytes = bytes, .len = len};

	driver_canopen.decode(b->decoder, &record, &sink);
}

/* What they want to send comes to an end. */
static void step(struct bed *b)
{
	struct dialogue_step wish;
	struct can_frame_at f;
	int frames = 0;

	driver_canopen.dialogue_step(b->dialogue, b->t_ns, &wish);
	must(wish.write_len <= sizeof wish.write && wish.write_len % CAN_WIRE_ENTRY == 0);
	must(strlen(wish.error) < sizeof wish.error);
	decode(b, TO_DEVICE, wish.write, wish.write_len);
	for (size_t at = 0; at < wish.write_len; at += CAN_WIRE_ENTRY) {
		must(can_wire_get(wish.write + at, CAN_WIRE_ENTRY, &f) == CAN_WIRE_ENTRY);
		if (f.id == CANOPEN_SDO_REQUEST + NODE)
			b->asked[0] = f;
	}
	while (canopen_sdo_step(&b->sdo, b->t_ns, &b->asked[1]))
		must(++frames < 4);
	must(b->sdo.len <= CANOPEN_SDO_MAX);
	must(canopen_sdo_deadline(&b->sdo) > b->t_ns);
	while (canopen_setup_step(&b->setup, b->t_ns, &b->asked[2]))
		must(++frames < 8);
	must(strlen(b->setup.error) < sizeof b->setup.error);
}

/* To the request of one of the three: its object with `len` bytes of data. */
static struct can_frame_at answer_of(const struct can_frame_at *asked, const uint8_t *data, size_t len)
{
	struct canopen_wire_sdo sdo;
	uint8_t bytes[8] = {0};

	if (canopen_wire_parse_request(asked->data, asked->len, &sdo) && sdo.kind < CANOPEN_SDO_ABORT) {
		sdo.expedited = sdo.sized = true;
		sdo.len = (uint8_t)(len < 1 ? 1 : len < 4 ? len : 4);
		memset(sdo.data, 0, sizeof sdo.data);
		memcpy(sdo.data, data, len < 4 ? len : 4);
		sdo.last = true;
		canopen_wire_put_answer(&sdo, bytes);
	}
	return can_wire_frame(CANOPEN_SDO_ANSWER + NODE, bytes, sizeof bytes);
}

static void feed(struct bed *b, enum direction direction, const uint8_t *bytes, size_t len)
{
	decode(b, direction, bytes, len);
	step(b);
}

static size_t feed_short(struct bed *b, const uint8_t *data, size_t size)
{
	static const uint32_t id[16] = {CANOPEN_NMT,
	                                CANOPEN_SYNC,
	                                CANOPEN_EMCY + NODE,
	                                CANOPEN_TPDO + NODE,
	                                CANOPEN_TPDO + 0x100 + NODE,
	                                CANOPEN_TPDO + 0x200 + NODE,
	                                CANOPEN_TPDO + 0x300 + NODE,
	                                CANOPEN_SDO_ANSWER + NODE,
	                                CANOPEN_SDO_REQUEST + NODE,
	                                CANOPEN_HEARTBEAT + NODE,
	                                CANOPEN_RPDO + NODE,
	                                CAN_WIRE_ERROR | CAN_WIRE_ERROR_CONTROLLER,
	                                CAN_WIRE_ERROR | CAN_WIRE_ERROR_BUS_OFF,
	                                CAN_WIRE_LOST,
	                                ANSWER,
	                                0x123 | CAN_WIRE_EXTENDED};
	size_t len = data[1] % 9;
	uint8_t entry[CAN_WIRE_ENTRY_FD];
	struct can_frame_at f;

	len = len < size - 2 ? len : size - 2;
	f = can_wire_frame(id[data[0] & 15], data + 2, (uint8_t)len);
	if (f.id == ANSWER)
		f = answer_of(&b->asked[data[1] / 9 % 3], data + 2, len);
	b->t_ns += (data[0] >> 5) * INT64_C(3100000);
	f.t_ns = data[0] & 16 ? 0 : b->t_ns;
	if (data[1] >= 250)
		b->t_ns += INT64_C(600000000);
	feed(b, data[1] == 249 ? LINK_OPENED : data[0] & 16 ? TO_DEVICE : FROM_DEVICE, entry, can_wire_put(&f, entry));
	return 2 + len;
}

static struct config config_of(uint8_t how)
{
	struct config config = {.devices = 1};
	struct config_device *d = &config.device[0];

	strcpy(d->name, "servo");
	strcpy(d->driver, "canopen");
	d->node = NODE;
	d->master = 127;
	d->kind = how & 3;
	d->drive_mode = (how >> 2 & 3) % 3;
	d->axis = how & 16 ? CANOPEN_LATERAL : CANOPEN_LONGITUDINAL;
	d->sync_ns = how & 32 ? 10000000 : 0;
	d->heartbeat_ns = 200000000;
	d->timeout_ns = 1000000000;
	d->count.scale = how & 64 ? 0 : 1e-5;
	d->count.wrap = how & 128 ? 65536 : 0;
	d->count.sign = how & 16 ? -1 : 1;
	d->acceleration_rad_s2 = 5;
	d->homing.set = how & 128;
	d->homing.method = 35;
	d->homing.within_ns = 1000000000;
	config.sweep.set = true;
	strcpy(config.sweep.device, "servo");
	config.sweep.from_rad = -0.2;
	config.sweep.to_rad = 0.1;
	config.sweep.speed_rad_s = 0.05;
	return config;
}

static void begin(struct bed *b, uint8_t how)
{
	static const uint8_t bytes[CANOPEN_SDO_MAX] = {1, 2, 3};

	canopen_sdo_init(&b->sdo, NODE);
	if (how & 1)
		canopen_sdo_download(&b->sdo, 0x1008, 0, bytes, how);
	else
		canopen_sdo_upload(&b->sdo, 0x1008, 0);
	canopen_setup_init(&b->setup, NODE);
	if (how & 2)
		canopen_setup_identify(&b->setup);
	canopen_setup_heartbeat(&b->setup, 100, 127, 300);
	canopen_setup_pdo(&b->setup, &(struct canopen_pdo){.index = 0x1800,
	                                                   .cob = how & 4 ? 0x185 : 0,
	                                                   .off = how & 8,
	                                                   .type = 1,
	                                                   .inhibit = how & 16 ? 0 : -1,
	                                                   .timer = how & 32 ? 0 : -1,
	                                                   .n = how & 64 ? 1 : -1,
	                                                   .entry = {0x60640020}});
	canopen_setup_begin(&b->setup);
}

/* All of it is in the snapshot, and what is in it can be loaded. */
static void must_say_the_same(struct decoder *decoder, const struct config_device *device)
{
	static uint8_t bytes[STATE], again[STATE];
	struct decoder *other = driver_canopen.decoder_create(device, 0);
	struct state s;
	size_t len;

	must(other != NULL);
	state_save(&s, bytes, sizeof bytes);
	driver_canopen.state(decoder, &s);
	must(state_done(&s));
	len = s.at;
	state_load(&s, bytes, len);
	driver_canopen.state(other, &s);
	must(state_done(&s));
	state_save(&s, again, sizeof again);
	driver_canopen.state(other, &s);
	must(s.at == len && memcmp(bytes, again, len) == 0);
	driver_canopen.decoder_destroy(other);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct decoder_counters counters;
	struct decoder_timing timing;
	struct config config;
	struct bed b = {.t_ns = T0};

	if (size < 2)
		return 0;
	config = config_of(data[0]);
	b.decoder = driver_canopen.decoder_create(&config.device[0], 0);
	b.dialogue = driver_canopen.dialogue_create(&config, 0);
	must(b.decoder && b.dialogue);
	driver_canopen.dialogue_reset(b.dialogue, b.t_ns);
	begin(&b, data[1]);
	step(&b);
	if (data[1] & 128)
		feed(&b, FROM_DEVICE, data + 2, size - 2);
	else
		for (size_t at = 2; at + 2 <= size;)
			at += feed_short(&b, data + at, size - at);
	driver_canopen.dialogue_stop(b.dialogue, b.t_ns);
	step(&b);
	driver_canopen.counters(b.decoder, &counters);
	driver_canopen.timing(b.decoder, &timing);
	must(counters.n <= DECODER_COUNTERS_MAX);
	must_say_the_same(b.decoder, &config.device[0]);
	driver_canopen.dialogue_destroy(b.dialogue);
	driver_canopen.decoder_destroy(b.decoder);
	return 0;
}

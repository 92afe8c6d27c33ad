/* What the files of the CANopen driver share: canopen_decoder.c (frames in, angles and replies out), canopen_dialogue.c
 * (set-up and commands), canopen.c (the table). Nobody else includes it, tests apart. */
#ifndef FACET_DRIVERS_CANOPEN_PARTS_H
#define FACET_DRIVERS_CANOPEN_PARTS_H

#include "drivers/can_bus.h"
#include "drivers/canopen_wire.h"
#include "drivers/driver.h"

/* Kinds of `struct reply`; its time is the frame's. Payloads are structs as they are in memory: memcpy them. */
enum canopen_reply {
	CANOPEN_REPLY_SDO,    /* data of the node's SDO answer, as long as the frame's (up to 8 bytes) */
	CANOPEN_REPLY_NMT,    /* uint8_t: enum canopen_nmt, CANOPEN_BOOT_UP is the boot-up message; toggle masked */
	CANOPEN_REPLY_EMCY,   /* struct canopen_wire_emcy */
	CANOPEN_REPLY_SYNC,   /* nothing; also our own, when it left */
	CANOPEN_REPLY_STATUS, /* uint16_t: statusword from a TPDO */
	CANOPEN_REPLY_ANGLE,  /* struct canopen_angle: as the tilt that was decoded */
	CANOPEN_REPLY_VALUE,  /* struct canopen_value: any other mapped object */
	CANOPEN_REPLY_BUS = CAN_BUS_REPLY /* uint8_t: enum can_bus_health, where it changed */
};
struct canopen_angle {
	int64_t t_ns; /* of sampling: of the SYNC where there was one */
	double rad;
	int64_t count; /* raw */
};
struct canopen_value {
	uint16_t index;
	uint8_t sub, bits;
	uint32_t value; /* the lowest 32 bits, not sign-extended */
};

/* Angle of a raw count by the configuration: sign * scale * (count - zero), wrapped to half a `wrap` on either side;
 * `scale_rad` where the configuration has none. */
double canopen_angle_rad(const struct config_device *, double scale_rad, int64_t count);
/* The count (not rounded) of an angle, without wrap; `scale_rad` as above, not 0. */
double canopen_angle_count(const struct config_device *, double scale_rad, double rad);

/* The decoder of canopen_decoder.c. */
struct decoder *canopen_decoder_create(const struct config_device *, int device);
void canopen_decoder_destroy(struct decoder *);
void canopen_decode(struct decoder *, const struct record *, const struct record_sink *);
void canopen_counters(const struct decoder *, struct decoder_counters *ret);
void canopen_timing(const struct decoder *, struct decoder_timing *ret);
void canopen_decoder_state(struct decoder *, struct state *);

/* What the decoder learned, for tests and messages: PDO n (1..8) of the node. */
struct canopen_learned {
	bool known; /* the mapping is complete */
	int number; /* from 0 */
	uint32_t cob;
	uint8_t type;
	int n;
	uint32_t entry[8]; /* index << 16 | sub << 8 | bits */
};
void canopen_decoder_pdo(const struct decoder *, bool transmit, int pdo, struct canopen_learned *ret);
uint32_t canopen_decoder_type(const struct decoder *); /* object 1000; 0: not known */

/* The dialogue of canopen_dialogue.c. */
struct dialogue *canopen_dialogue_create(const struct config *, int device);
void canopen_dialogue_destroy(struct dialogue *);
void canopen_dialogue_reset(struct dialogue *, int64_t t_ns);
void canopen_dialogue_reply(struct dialogue *, const struct reply *);
void canopen_dialogue_data(struct dialogue *, int64_t t_ns);
void canopen_dialogue_step(struct dialogue *, int64_t t_ns, struct dialogue_step *ret);
void canopen_dialogue_stop(struct dialogue *, int64_t t_ns);

#endif

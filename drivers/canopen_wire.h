/* CANopen's frames and words: pure, over frames at their time (CiA 301; 402 for the states of drives). Used by decoder,
 * dialogue, simulated nodes and tests alike; layouts are drawn in canopen_wire.c. */
#ifndef FACET_DRIVERS_CANOPEN_WIRE_H
#define FACET_DRIVERS_CANOPEN_WIRE_H

#include "drivers/can_wire.h"

#define CANOPEN_NODE_MAX 127

/* COB-ids of the predefined connection set; but for NMT and SYNC plus the node. */
enum {
	CANOPEN_NMT = 0x000,
	CANOPEN_SYNC = 0x080,
	CANOPEN_EMCY = 0x080,
	CANOPEN_TIME = 0x100,
	CANOPEN_TPDO = 0x180, /* of PDO 1; each further one of four 0x100 higher */
	CANOPEN_RPDO = 0x200,
	CANOPEN_SDO_ANSWER = 0x580,
	CANOPEN_SDO_REQUEST = 0x600,
	CANOPEN_HEARTBEAT = 0x700
};

/* Bits of a COB-id as objects 14xx:01 and 18xx:01 hold it. */
#define CANOPEN_COB_OFF      0x80000000u /* the PDO does not exist */
#define CANOPEN_COB_NO_RTR   0x40000000u
#define CANOPEN_COB_EXTENDED 0x20000000u
#define CANOPEN_COB_ID       0x1fffffffu

/* Transmission types: up to 240 the value was sampled at a SYNC; 0 and 1..240 alike. */
#define CANOPEN_TYPE_SYNC_MAX 240
#define CANOPEN_TYPE_EVENT    254

/* Network management. */
enum canopen_command {
	CANOPEN_START = 0x01,
	CANOPEN_STOP = 0x02,
	CANOPEN_ENTER_PREOPERATIONAL = 0x80,
	CANOPEN_RESET_NODE = 0x81,
	CANOPEN_RESET_COMMUNICATION = 0x82
};
enum canopen_nmt {
	CANOPEN_BOOT_UP = 0x00,
	CANOPEN_STOPPED = 0x04,
	CANOPEN_OPERATIONAL = 0x05,
	CANOPEN_PREOPERATIONAL = 0x7f
};

struct can_frame_at canopen_wire_nmt(enum canopen_command, int node); /* node 0: all */
struct can_frame_at canopen_wire_heartbeat(int node, uint8_t state);  /* CANOPEN_BOOT_UP: the boot-up message */
struct can_frame_at canopen_wire_sync(void);

struct canopen_wire_emcy {
	uint16_t code;          /* 0: an error has gone */
	uint8_t error_register; /* object 1001 */
	uint8_t vendor[5];
};
struct can_frame_at canopen_wire_emcy(int node, const struct canopen_wire_emcy *);
bool canopen_wire_parse_emcy(const uint8_t *bytes, size_t len, struct canopen_wire_emcy *ret); /* false: too short */

/* One SDO telegram, of either side. */
struct canopen_wire_sdo {
	enum canopen_sdo_kind {
		CANOPEN_SDO_DOWNLOAD, /* begin: write an object */
		CANOPEN_SDO_DOWNLOAD_SEGMENT,
		CANOPEN_SDO_UPLOAD, /* begin: read an object */
		CANOPEN_SDO_UPLOAD_SEGMENT,
		CANOPEN_SDO_ABORT,
		CANOPEN_SDO_OTHER /* block transfers, and what nobody defined: `command` tells */
	} kind;
	uint8_t command; /* the first byte, as parsed */
	uint16_t index;  /* of begins and aborts */
	uint8_t sub;
	bool expedited; /* a begin that carries the data; else segments follow */
	bool sized;     /* expedited: `len` was said; else `size` is what follows */
	bool toggle;    /* segments */
	bool last;      /* segments with data: none follows */
	uint32_t size;
	uint32_t abort;
	uint8_t len; /* data carried here: expedited up to 4, segments up to 7 */
	uint8_t data[7];
};

/* What carries data: download requests (begin and segment) and upload answers. 8 bytes each, unused ones 0. */
void canopen_wire_put_request(const struct canopen_wire_sdo *, uint8_t ret[8]);
void canopen_wire_put_answer(const struct canopen_wire_sdo *, uint8_t ret[8]);
/* False: too short for what it claims to be. Short frames are taken where what they lack is not used: an answer ends
 * with its data, a code that an abort does not hold is 0x08000000. Data echoed in an answer to a download are ignored.
 * */
bool canopen_wire_parse_request(const uint8_t *bytes, size_t len, struct canopen_wire_sdo *ret);
bool canopen_wire_parse_answer(const uint8_t *bytes, size_t len, struct canopen_wire_sdo *ret);
/* Data of up to 4 bytes as a number, little-endian. */
uint32_t canopen_wire_number(const uint8_t *bytes, size_t len);

/* Reasons of an abort that this side gives or tells apart. */
enum {
	CANOPEN_ABORT_TOGGLE = 0x05030000,
	CANOPEN_ABORT_TIMEOUT = 0x05040000,
	CANOPEN_ABORT_COMMAND = 0x05040001,
	CANOPEN_ABORT_MEMORY = 0x05040005,
	CANOPEN_ABORT_ACCESS = 0x06010000,
	CANOPEN_ABORT_WRITE_ONLY = 0x06010001,
	CANOPEN_ABORT_READ_ONLY = 0x06010002,
	CANOPEN_ABORT_NO_OBJECT = 0x06020000,
	CANOPEN_ABORT_NOT_MAPPABLE = 0x06040041,
	CANOPEN_ABORT_PDO_LENGTH = 0x06040042,
	CANOPEN_ABORT_LENGTH = 0x06070010,
	CANOPEN_ABORT_NO_SUB = 0x06090011,
	CANOPEN_ABORT_RANGE = 0x06090030,
	CANOPEN_ABORT_GENERAL = 0x08000000,
	CANOPEN_ABORT_STATE = 0x08000022
};

/* In words, never NULL, without capital or full stop: "object does not exist". */
const char *canopen_wire_abort_text(uint32_t code);
const char *canopen_wire_emcy_text(uint16_t code); /* error codes of EMCY and of object 603F */
const char *canopen_wire_nmt_text(uint8_t state);

/* States of a drive by its statusword, object 6041. */
enum canopen_drive_state {
	CANOPEN_NOT_READY,
	CANOPEN_SWITCH_ON_DISABLED,
	CANOPEN_READY_TO_SWITCH_ON,
	CANOPEN_SWITCHED_ON,
	CANOPEN_ENABLED,
	CANOPEN_QUICK_STOP,
	CANOPEN_FAULT_REACTION,
	CANOPEN_FAULT,
	CANOPEN_DRIVE_UNKNOWN /* bits that no state has */
};
enum canopen_drive_state canopen_wire_drive_state(uint16_t statusword);
const char *canopen_wire_drive_text(enum canopen_drive_state);

#endif

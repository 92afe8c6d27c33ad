/* CANopen's frames. An SDO telegram is 8 bytes; the upper three bits of the first say what it is:
 *
 *    0         1   2   3    4   5   6   7
 *    +---------+---+---+----+---+---+---+---+
 *    | command | index | sub| data, or size |     begin, abort (code)
 *    +---------+---+---+----+---+---+---+---+
 *    | command |            data            |     segment
 *    +---------+----------------------------+
 *
 *                     client                                  server
 *    write, begin     001 0 nn e s  data or size              011 0 0000
 *    write, segment   000 t nnn  c  data                      001 t 0000
 *    read, begin      010 0 0000                              010 0 nn e s  data or size
 *    read, segment    011 t 0000                              000 t nnn  c  data
 *    abort            100 0 0000    code                      the same
 *
 *    n  bytes at the end that hold no data       e  expedited: the data are here        s  n (or the size) is said
 *    t  toggles from segment to segment          c  no more segments
 *
 * Seen in the field: answers that end with their data, or with the sub-index; answers to writes that echo the data;
 * reads of short objects whose length is not said, so that only the object's type tells it. */
#include "drivers/canopen_wire.h"

#include <assert.h>
#include <string.h>

#define SPECIFIER 0xe0u
#define TOGGLE    0x10u
#define EXPEDITED 0x02u
#define SIZED     0x01u
#define LAST      0x01u

/* By kind. */
static const uint8_t request_command[] = {0x20, 0x00, 0x40, 0x60, 0x80};
static const uint8_t answer_command[] = {0x60, 0x20, 0x40, 0x00, 0x80};

struct can_frame_at canopen_wire_nmt(enum canopen_command command, int node)
{
	const uint8_t data[2] = {(uint8_t)command, (uint8_t)node};

	return can_wire_frame(CANOPEN_NMT, data, sizeof data);
}

struct can_frame_at canopen_wire_heartbeat(int node, uint8_t state)
{
	return can_wire_frame(CANOPEN_HEARTBEAT + (uint32_t)node, &state, 1);
}

struct can_frame_at canopen_wire_sync(void)
{
	return can_wire_frame(CANOPEN_SYNC, NULL, 0);
}

struct can_frame_at canopen_wire_emcy(int node, const struct canopen_wire_emcy *emcy)
{
	uint8_t data[8] = {(uint8_t)emcy->code, (uint8_t)(emcy->code >> 8), emcy->error_register};

	memcpy(data + 3, emcy->vendor, sizeof emcy->vendor);
	return can_wire_frame(CANOPEN_EMCY + (uint32_t)node, data, sizeof data);
}

bool canopen_wire_parse_emcy(const uint8_t *bytes, size_t len, struct canopen_wire_emcy *ret)
{
	if (len < 3)
		return false;
	*ret = (struct canopen_wire_emcy){.code = (uint16_t)canopen_wire_number(bytes, 2), .error_register = bytes[2]};
	memcpy(ret->vendor, bytes + 3, len < 8 ? len - 3 : 5);
	return true;
}

uint32_t canopen_wire_number(const uint8_t *bytes, size_t len)
{
	uint32_t v = 0;

	for (size_t i = 0; i < len && i < 4; i++)
		v |= (uint32_t)bytes[i] << 8 * i;
	return v;
}

static void put_number(uint8_t *ret, uint32_t v)
{
	for (int i = 0; i < 4; i++)
		ret[i] = (uint8_t)(v >> 8 * i);
}

static void put_begin(const struct canopen_wire_sdo *sdo, bool carries, uint8_t *ret)
{
	ret[1] = (uint8_t)sdo->index;
	ret[2] = (uint8_t)(sdo->index >> 8);
	ret[3] = sdo->sub;
	if (sdo->kind == CANOPEN_SDO_ABORT) {
		put_number(ret + 4, sdo->abort);
	} else if (carries && sdo->expedited) {
		assert(sdo->len >= 1 && sdo->len <= 4);
		ret[0] |= (uint8_t)(EXPEDITED | (sdo->sized ? SIZED | (4u - sdo->len) << 2 : 0));
		memcpy(ret + 4, sdo->data, sdo->len);
	} else if (carries && sdo->sized) {
		ret[0] |= SIZED;
		put_number(ret + 4, sdo->size);
	}
}

static void put(const struct canopen_wire_sdo *sdo, const uint8_t *command, enum canopen_sdo_kind begin,
                enum canopen_sdo_kind segment, uint8_t *ret)
{
	assert(sdo->kind < CANOPEN_SDO_OTHER);
	memset(ret, 0, 8);
	ret[0] = command[sdo->kind];
	if (sdo->kind != CANOPEN_SDO_DOWNLOAD_SEGMENT && sdo->kind != CANOPEN_SDO_UPLOAD_SEGMENT) {
		put_begin(sdo, sdo->kind == begin, ret);
		return;
	}
	ret[0] |= (uint8_t)(sdo->toggle ? TOGGLE : 0);
	if (sdo->kind == segment) {
		assert(sdo->len <= 7);
		ret[0] |= (uint8_t)((7u - sdo->len) << 1 | (sdo->last ? LAST : 0));
		memcpy(ret + 1, sdo->data, sdo->len);
	}
}

void canopen_wire_put_request(const struct canopen_wire_sdo *sdo, uint8_t ret[8])
{
	put(sdo, request_command, CANOPEN_SDO_DOWNLOAD, CANOPEN_SDO_DOWNLOAD_SEGMENT, ret);
}

void canopen_wire_put_answer(const struct canopen_wire_sdo *sdo, uint8_t ret[8])
{
	put(sdo, answer_command, CANOPEN_SDO_UPLOAD, CANOPEN_SDO_UPLOAD_SEGMENT, ret);
}

/* The part of a begin after the sub-index. */
static bool parse_begin_data(const uint8_t *bytes, size_t len, struct canopen_wire_sdo *ret)
{
	ret->expedited = bytes[0] & EXPEDITED;
	ret->sized = bytes[0] & SIZED;
	if (!ret->expedited) {
		ret->size = ret->sized ? canopen_wire_number(bytes + 4, len - 4) : 0;
		return !ret->sized || len > 4;
	}
	ret->len = ret->sized ? (uint8_t)(4 - (bytes[0] >> 2 & 3)) : (uint8_t)(len - 4);
	if (ret->len == 0 || len < 4u + ret->len)
		return false;
	memcpy(ret->data, bytes + 4, ret->len);
	return true;
}

static bool parse_segment_data(const uint8_t *bytes, size_t len, struct canopen_wire_sdo *ret)
{
	ret->last = bytes[0] & LAST;
	ret->len = (uint8_t)(7 - (bytes[0] >> 1 & 7));
	if (len < 1u + ret->len)
		return false;
	memcpy(ret->data, bytes + 1, ret->len);
	return true;
}

static bool parse(const uint8_t *bytes, size_t len, const uint8_t *command, enum canopen_sdo_kind begin,
                  enum canopen_sdo_kind segment, struct canopen_wire_sdo *ret)
{
	struct canopen_wire_sdo sdo = {.kind = 0};
	bool good;

	if (len == 0)
		return false;
	len = len < 8 ? len : 8;
	sdo.command = bytes[0];
	while (sdo.kind < CANOPEN_SDO_OTHER && command[sdo.kind] != (bytes[0] & SPECIFIER))
		sdo.kind++;
	sdo.toggle = bytes[0] & TOGGLE;
	if (sdo.kind == CANOPEN_SDO_OTHER) {
		good = true;
	} else if (sdo.kind == CANOPEN_SDO_DOWNLOAD_SEGMENT || sdo.kind == CANOPEN_SDO_UPLOAD_SEGMENT) {
		good = sdo.kind != segment || parse_segment_data(bytes, len, &sdo);
	} else {
		good = len >= 4;
		if (good) {
			sdo.index = (uint16_t)canopen_wire_number(bytes + 1, 2);
			sdo.sub = bytes[3];
			sdo.abort = len < 8 ? CANOPEN_ABORT_GENERAL : canopen_wire_number(bytes + 4, 4);
			good = sdo.kind != begin || parse_begin_data(bytes, len, &sdo);
		}
	}
	sdo.abort = sdo.kind == CANOPEN_SDO_ABORT ? sdo.abort : 0;
	sdo.toggle &= sdo.kind == CANOPEN_SDO_DOWNLOAD_SEGMENT || sdo.kind == CANOPEN_SDO_UPLOAD_SEGMENT;
	if (good)
		*ret = sdo;
	return good;
}

bool canopen_wire_parse_request(const uint8_t *bytes, size_t len, struct canopen_wire_sdo *ret)
{
	return parse(bytes, len, request_command, CANOPEN_SDO_DOWNLOAD, CANOPEN_SDO_DOWNLOAD_SEGMENT, ret);
}

bool canopen_wire_parse_answer(const uint8_t *bytes, size_t len, struct canopen_wire_sdo *ret)
{
	return parse(bytes, len, answer_command, CANOPEN_SDO_UPLOAD, CANOPEN_SDO_UPLOAD_SEGMENT, ret);
}

const char *canopen_wire_abort_text(uint32_t code)
{
	static const struct {
		uint32_t code;
		const char *text;
	} known[] = {
	    {0x05030000, "toggle bit not alternated"},
	    {0x05040000, "no answer in time"},
	    {0x05040001, "command not valid or unknown"},
	    {0x05040002, "block size not valid"},
	    {0x05040003, "sequence number not valid"},
	    {0x05040004, "checksum wrong"},
	    {0x05040005, "out of memory"},
	    {0x06010000, "access not supported"},
	    {0x06010001, "object can only be written"},
	    {0x06010002, "object can only be read"},
	    {0x06010003, "entry cannot be written, sub-index 0 must be 0 for that"},
	    {0x06010004, "object too long to be read in pieces"},
	    {0x06010005, "object is mapped to an RPDO, writing is blocked"},
	    {0x06010006, "object is mapped to a TPDO, reading is blocked"},
	    {0x06020000, "object does not exist"},
	    {0x06040041, "object cannot be mapped to a PDO"},
	    {0x06040042, "mapped objects are longer than a PDO"},
	    {0x06040043, "parameters do not fit each other"},
	    {0x06040047, "the device's own parts do not fit each other"},
	    {0x06060000, "access failed, hardware error"},
	    {0x06070010, "length of the value does not fit its type"},
	    {0x06070012, "value too long"},
	    {0x06070013, "value too short"},
	    {0x06090011, "sub-index does not exist"},
	    {0x06090030, "value out of range"},
	    {0x06090031, "value too high"},
	    {0x06090032, "value too low"},
	    {0x06090036, "maximum is below minimum"},
	    {0x060a0023, "resource not available"},
	    {0x08000000, "general error"},
	    {0x08000020, "value cannot be stored or transferred"},
	    {0x08000021, "value cannot be stored, the device is controlled locally"},
	    {0x08000022, "not possible in the present state of the device"},
	    {0x08000023, "no object dictionary is there"},
	    {0x08000024, "no data are there"},
	};

	for (size_t i = 0; i < sizeof known / sizeof known[0]; i++)
		if (known[i].code == code)
			return known[i].text;
	return "reason that no standard names";
}

/* Codes go from the general to the special: what is not named itself is named by its hundred, then by its thousand. */
const char *canopen_wire_emcy_text(uint16_t code)
{
	static const struct {
		uint16_t code, mask;
		const char *text;
	} known[] = {
	    {0x0000, 0xffff, "no error"},
	    {0x2310, 0xffff, "overcurrent"},
	    {0x2320, 0xffff, "short circuit or earth leakage"},
	    {0x3110, 0xffff, "supply voltage too high"},
	    {0x3120, 0xffff, "supply voltage too low"},
	    {0x3210, 0xffff, "DC link voltage too high"},
	    {0x3220, 0xffff, "DC link voltage too low"},
	    {0x4210, 0xffff, "device too hot"},
	    {0x4310, 0xffff, "drive too hot"},
	    {0x7121, 0xffff, "motor blocked"},
	    {0x7305, 0xffff, "incremental sensor fault"},
	    {0x8110, 0xffff, "CAN overrun, frames were lost"},
	    {0x8120, 0xffff, "CAN controller in error passive"},
	    {0x8130, 0xffff, "heartbeat or node guarding lost"},
	    {0x8140, 0xffff, "recovered from bus-off"},
	    {0x8150, 0xffff, "another node sends with its COB-id"},
	    {0x8210, 0xffff, "PDO not processed, wrong length"},
	    {0x8220, 0xffff, "PDO too long"},
	    {0x8250, 0xffff, "RPDO did not come in time"},
	    {0x8611, 0xffff, "following error"},
	    {0x8612, 0xffff, "position limit reached"},
	    {0x2100, 0xff00, "current at the input"},
	    {0x2200, 0xff00, "current inside the device"},
	    {0x2300, 0xff00, "current at the output"},
	    {0x3100, 0xff00, "supply voltage"},
	    {0x3200, 0xff00, "voltage inside the device"},
	    {0x3300, 0xff00, "output voltage"},
	    {0x4100, 0xff00, "ambient temperature"},
	    {0x4200, 0xff00, "device temperature"},
	    {0x4300, 0xff00, "drive temperature"},
	    {0x6100, 0xff00, "firmware"},
	    {0x6200, 0xff00, "software"},
	    {0x6300, 0xff00, "data set"},
	    {0x7100, 0xff00, "power stage or motor"},
	    {0x7300, 0xff00, "sensor"},
	    {0x8100, 0xff00, "communication"},
	    {0x8200, 0xff00, "protocol"},
	    {0x8300, 0xff00, "torque control"},
	    {0x8400, 0xff00, "velocity control"},
	    {0x8500, 0xff00, "position control"},
	    {0x8600, 0xff00, "positioning control"},
	    {0xf000, 0xff00, "additional function"},
	    {0xff00, 0xff00, "device specific"},
	    {0x0000, 0xf000, "no error, or reset"},
	    {0x1000, 0xf000, "generic error"},
	    {0x2000, 0xf000, "current"},
	    {0x3000, 0xf000, "voltage"},
	    {0x4000, 0xf000, "temperature"},
	    {0x5000, 0xf000, "device hardware"},
	    {0x6000, 0xf000, "device software"},
	    {0x7000, 0xf000, "additional module"},
	    {0x8000, 0xf000, "monitoring"},
	    {0x9000, 0xf000, "external error"},
	    {0xf000, 0xf000, "device specific"},
	};

	for (size_t i = 0; i < sizeof known / sizeof known[0]; i++)
		if ((code & known[i].mask) == known[i].code)
			return known[i].text;
	return "error that no standard names";
}

const char *canopen_wire_nmt_text(uint8_t state)
{
	switch (state & 0x7f) {
	case CANOPEN_BOOT_UP:
		return "booting";
	case CANOPEN_STOPPED:
		return "stopped";
	case CANOPEN_OPERATIONAL:
		return "operational";
	case CANOPEN_PREOPERATIONAL:
		return "pre-operational";
	default:
		return "in no known state";
	}
}

enum canopen_drive_state canopen_wire_drive_state(uint16_t statusword)
{
	static const struct {
		uint8_t mask, value;
		enum canopen_drive_state state;
	} known[] = {
	    {0x4f, 0x00, CANOPEN_NOT_READY},
	    {0x4f, 0x40, CANOPEN_SWITCH_ON_DISABLED},
	    {0x6f, 0x21, CANOPEN_READY_TO_SWITCH_ON},
	    {0x6f, 0x23, CANOPEN_SWITCHED_ON},
	    {0x6f, 0x27, CANOPEN_ENABLED},
	    {0x6f, 0x07, CANOPEN_QUICK_STOP},
	    {0x4f, 0x0f, CANOPEN_FAULT_REACTION},
	    {0x4f, 0x08, CANOPEN_FAULT},
	};

	for (size_t i = 0; i < sizeof known / sizeof known[0]; i++)
		if ((statusword & known[i].mask) == known[i].value)
			return known[i].state;
	return CANOPEN_DRIVE_UNKNOWN;
}

const char *canopen_wire_drive_text(enum canopen_drive_state state)
{
	static const char *const text[] = {
	    [CANOPEN_NOT_READY] = "not ready to switch on",
	    [CANOPEN_SWITCH_ON_DISABLED] = "switch on disabled",
	    [CANOPEN_READY_TO_SWITCH_ON] = "ready to switch on",
	    [CANOPEN_SWITCHED_ON] = "switched on",
	    [CANOPEN_ENABLED] = "operation enabled",
	    [CANOPEN_QUICK_STOP] = "quick stop active",
	    [CANOPEN_FAULT_REACTION] = "fault reaction active",
	    [CANOPEN_FAULT] = "fault",
	    [CANOPEN_DRIVE_UNKNOWN] = "in no known state",
	};

	return text[state];
}

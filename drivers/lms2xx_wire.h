/* Telegrams of the SICK LMS2xx: check, encode, decode. Pure; both directions, so that the simulator and the decoder
 * stand on the same few functions and are held to the documented bytes by the same tests. The layouts are drawn in
 * lms2xx_wire.c. */
#ifndef FACET_DRIVERS_LMS2XX_WIRE_H
#define FACET_DRIVERS_LMS2XX_WIRE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "core/types.h"
#include "drivers/framer.h"

#define LMS2XX_PAYLOAD_MAX  1500 /* command and data; a longer length field is a false start */
#define LMS2XX_TELEGRAM_MAX (LMS2XX_PAYLOAD_MAX + 6)
#define LMS2XX_REQUEST_MAX  64 /* payload of the longest request, with room */
#define LMS2XX_BEAMS_MAX    401
#define LMS2XX_CONFIG_MAX   34
#define LMS2XX_PASSWORD     "SICK_LMS"

/* The mirror turns 75 times a second, a beam for each degree. */
#define LMS2XX_TURN_NS 13333333
#define LMS2XX_BEAM_NS 37037

enum lms2xx_request {
	LMS2XX_RESET = 0x10,
	LMS2XX_MODE = 0x20,
	LMS2XX_MEASURE = 0x30,
	LMS2XX_STATUS = 0x31,
	LMS2XX_ERRORS = 0x32,
	LMS2XX_TYPE = 0x3A,
	LMS2XX_VARIANT = 0x3B,
	LMS2XX_KEEP_BAUD = 0x66,
	LMS2XX_CONFIG_READ = 0x74,
	LMS2XX_CONFIG_WRITE = 0x77
};

/* What comes back; also the kinds of struct reply. ACK and NAK are bare bytes at a telegram's boundary. */
enum lms2xx_reply {
	LMS2XX_ACK = 0x06,
	LMS2XX_NAK = 0x15,
	LMS2XX_POWER_ON = 0x90,
	LMS2XX_RESET_DONE = 0x91,
	LMS2XX_REJECTED = 0x92,
	LMS2XX_MODE_REPLY = 0xA0,
	LMS2XX_SCAN = 0xB0,
	LMS2XX_STATUS_REPLY = 0xB1,
	LMS2XX_ERRORS_REPLY = 0xB2,
	LMS2XX_SCAN_MEAN = 0xB6,
	LMS2XX_SCAN_RANGE = 0xB7,
	LMS2XX_TYPE_REPLY = 0xBA,
	LMS2XX_VARIANT_REPLY = 0xBB,
	LMS2XX_SCAN_RANGE_MEAN = 0xBF,
	LMS2XX_SCAN_REFLECTIVITY = 0xC4,
	LMS2XX_KEEP_BAUD_REPLY = 0xE6,
	LMS2XX_CONFIG_REPLY = 0xF4,
	LMS2XX_PARTS_REFLECTIVITY = 0xF5,
	LMS2XX_CONFIG_WRITTEN = 0xF7
};

/* Second byte of LMS2XX_MODE. */
enum lms2xx_mode {
	LMS2XX_MODE_INSTALL = 0x00,
	LMS2XX_MODE_STREAM = 0x24,
	LMS2XX_MODE_IDLE = 0x25,
	LMS2XX_MODE_PARTS = 0x2A,
	LMS2XX_MODE_38400 = 0x40,
	LMS2XX_MODE_19200 = 0x41,
	LMS2XX_MODE_9600 = 0x42,
	LMS2XX_MODE_500000 = 0x48
};

enum lms2xx_unit { LMS2XX_CM = 0, LMS2XX_MM = 1, LMS2XX_DM = 2 };

/* Reasons of refusal, beside the framer's own. */
enum lms2xx_refusal {
	LMS2XX_BAD_CRC = FRAMER_OWN,
	LMS2XX_TOO_LONG,
	LMS2XX_BAD_SIZE /* the length does not fit the command or the count of values */
};

uint16_t lms2xx_crc(const uint8_t *bytes, size_t len);

/* framer_scan of either direction. A telegram of an unknown command with a good check sum is a telegram. */
int lms2xx_scan_device(void *ctx, const uint8_t *buf, size_t len, bool boundary);
int lms2xx_scan_host(void *ctx, const uint8_t *buf, size_t len, bool boundary);

/* A whole telegram around `payload` (command and data; replies with their status byte), 1..LMS2XX_PAYLOAD_MAX bytes.
 * ret has room for len + 6. Returns the telegram's length. Hosts send to address 0, scanners answer with 0x80. */
size_t lms2xx_encode(uint8_t address, const uint8_t *payload, size_t len, uint8_t *ret);

/* A measurement, whichever telegram carried it. */
struct lms2xx_scan {
	uint8_t command;      /* LMS2XX_SCAN, ... */
	uint8_t unit;         /* enum lms2xx_unit */
	bool partial;         /* one turn of the mirror out of a finer raster */
	uint8_t part;         /* its first beam stands part * 0.25 degree from the first of the raster */
	uint16_t n;           /* values */
	uint16_t start, stop; /* 1-based first and last beam of a sub-range; 0 in others */
	uint8_t samples;      /* of a mean; else 0 */
	uint8_t stride;       /* bytes from value to value */
	const uint8_t *value; /* borrowed: n LE16 words */
	uint16_t amplitudes;  /* of the echoes of beams start .. stop, which LMS2XX_SCAN_REFLECTIVITY adds */
	const uint8_t *amplitude;
	bool indexed; /* real-time indices follow the values */
	uint8_t scan_index, telegram_index;
	uint8_t status;
};

bool lms2xx_is_scan(uint8_t command);
/* false: the payload is not what its counts say. Nothing of ret is touched then. */
bool lms2xx_decode_scan(const uint8_t *payload, size_t len, struct lms2xx_scan *ret);
/* LMS2XX_SCAN and LMS2XX_SCAN_RANGE as a telegram of address 0x80; ret has room for LMS2XX_TELEGRAM_MAX. */
size_t lms2xx_encode_scan(const struct lms2xx_scan *, uint8_t *ret);

/* Bits of a word that are range, 13..16 by measuring mode; 0: the mode is none of ranges, or not known. */
int lms2xx_range_bits(int mode);
/* A word by the measuring mode (whose range bits are not 0). *ret_range is in the scan's unit, meaningless unless
 * BEAM_OK. */
enum beam_state lms2xx_range(uint16_t word, int mode, uint16_t *ret_range);
/* The other way: ranges that do not fit are said to be beyond the maximum. */
uint16_t lms2xx_word(enum beam_state, double range, int mode);
double lms2xx_unit_m(uint8_t unit); /* 0: reserved */

/* What the configuration says (F4, F7), and the bytes to write it back. */
struct lms2xx_config {
	size_t len; /* 32 or 34: never write more than was read */
	uint8_t bytes[LMS2XX_CONFIG_MAX];
};
enum { LMS2XX_CONFIG_AVAILABILITY = 4, LMS2XX_CONFIG_MODE = 5, LMS2XX_CONFIG_UNIT = 6 }; /* offsets into bytes */
#define LMS2XX_AVAILABILITY_INDICES 0x02

/* F4, or F7 that says the configuration was taken. */
bool lms2xx_decode_config(const uint8_t *payload, size_t len, struct lms2xx_config *ret);

/* B1: what is certain of it. The variant is 0, 0 where the layout is not one of the two known ones. */
struct lms2xx_status {
	uint8_t mode;   /* operating mode, enum lms2xx_mode */
	uint8_t device; /* 0: ok */
	int fov_deg, resolution_cdeg;
	uint32_t baud; /* at which it says this; 0: no rate that is known */
};
bool lms2xx_decode_status(const uint8_t *payload, size_t len, struct lms2xx_status *ret);

/* BB: false where it is malformed; *ret_taken: the variant was switched to. */
bool lms2xx_decode_variant(const uint8_t *payload, size_t len, bool *ret_taken, int *ret_fov_deg,
                           int *ret_resolution_cdeg);

/* Rate <-> byte of LMS2XX_MODE; 0: none. */
uint8_t lms2xx_baud_mode(uint32_t baud);
uint32_t lms2xx_mode_baud(uint8_t mode);

#endif

/* The body of LMDscandata and LMDscandatamon, whatever it holds: any number of encoders and channels, 8 and 16 bit,
 * position, names, comment, time, event. Read field by field in either dialect, never by counting tokens. Pure. */
#ifndef FACET_DRIVERS_COLA_SCAN_H
#define FACET_DRIVERS_COLA_SCAN_H

#include "drivers/cola_wire.h"

#define COLA_CHANNELS_MAX 16 /* five echoes, their remission, and more; a telegram with more is refused */
#define COLA_ENCODERS_MAX 4

struct cola_channel {
	char name[6]; /* DIST1, RSSI1, ANGL1, VANG1 ... */
	float scale, offset;
	int32_t start_tdeg; /* 1/10000 degree, SICK's frame: 900000 is straight ahead */
	int32_t step_tdeg;
	uint16_t n;
	int bytes;                 /* of a value: 2 or 1 */
	struct cola_reader values; /* stands at the first one */
};

struct cola_scan {
	bool monitored; /* LMDscandatamon of the safety variants */
	uint16_t version, device;
	uint32_t serial;
	uint8_t status[2];
	uint16_t telegram_counter, scan_counter;
	uint32_t t_startup_us; /* reference by the model: start or end of the scan */
	uint32_t t_transmit_us;
	uint8_t inputs[2], outputs[2];
	int16_t layer;            /* angle of the layer; 0 on TiM and LMS */
	uint32_t frequency_chz;   /* of the mirror, 1/100 Hz */
	uint32_t measurement_hhz; /* 100 Hz; unreliable */
	int encoders;
	struct {
		uint32_t ticks;
		uint16_t speed;
	} encoder[COLA_ENCODERS_MAX];
	int channels; /* 16-bit ones first */
	struct cola_channel channel[COLA_CHANNELS_MAX];
	bool has_position;
	float position[6];
	uint8_t position_type;
	const char *name, *comment; /* borrowed, not terminated; NULL: not there (a length of 0 is there) */
	size_t name_len, comment_len;
	bool has_time;
	uint16_t year;
	uint8_t month, day, hour, minute, second;
	uint32_t microsecond;
	bool has_event;
	char event[5];
	uint32_t event_encoder, event_us;
	int32_t event_angle;
};

/* 0, or -EINVAL (nothing of ret is meaningful): cut, too many, or not this telegram. Every byte is accounted for. */
int cola_scan_read(enum cola_dialect, const uint8_t *payload, size_t len, struct cola_scan *ret);
const struct cola_channel *cola_scan_channel(const struct cola_scan *, const char *name); /* NULL: not there */
/* Raw values of a channel; they were checked when the scan was read. `ret` has room for n. */
void cola_channel_values(const struct cola_channel *, uint16_t *ret);

#endif

/* What a scanner with CoLa can be set to, read from its answers, changed to what is wanted, written back. Pure; used by
 * the dialogue. Nothing that was not asked for changes, so that what is equal is never written. */
#ifndef FACET_DRIVERS_COLA_SETTINGS_H
#define FACET_DRIVERS_COLA_SETTINGS_H

#include "config/config.h"
#include "drivers/cola_wire.h"

/* LMPscancfg, mLMPsetscancfg. Angles in SICK's frame: 900000 is straight ahead. */
struct cola_scan_setup {
	bool known; /* the scanner said so */
	uint32_t frequency_chz;
	int16_t sectors;
	uint32_t resolution_tdeg; /* 1/10000 degree */
	int32_t from_tdeg, to_tdeg;
};

/* LMPoutputRange: the part that is sent. */
struct cola_range_setup {
	bool known;
	uint16_t sectors;
	uint32_t resolution_tdeg;
	int32_t from_tdeg, to_tdeg;
};

/* LMDscandatacfg: what a telegram holds. */
struct cola_data_setup {
	bool known;
	uint8_t channel[2], remission, wide, unit, encoder[2], position, name, comment, time;
	uint16_t every;
};

/* One of the variables of an encoder, whose width differs between models: it is written as it was read. */
struct cola_number {
	bool known;
	int bytes; /* in CoLa-B */
	bool real; /* of its four bytes a float may be made */
	uint32_t value;
};

/* The values behind the name. False: cut, and nothing is filled. */
bool cola_scan_setup_read(struct cola_reader *, struct cola_scan_setup *ret);
bool cola_range_setup_read(struct cola_reader *, struct cola_range_setup *ret);
bool cola_data_setup_read(struct cola_reader *, struct cola_data_setup *ret);
bool cola_number_read(struct cola_reader *, struct cola_number *ret);

void cola_scan_setup_write(struct cola_writer *, const struct cola_scan_setup *);
void cola_range_setup_write(struct cola_writer *, const struct cola_range_setup *);
void cola_data_setup_write(struct cola_writer *, const struct cola_data_setup *);
void cola_number_write(struct cola_writer *, const struct cola_number *);

/* Changes what was read to what is wanted. True: it differed, and is to be written. A setup that is not known differs
 * where anything is wanted of it. */
bool cola_scan_setup_want(struct cola_scan_setup *, const struct config_device *);
bool cola_range_setup_want(struct cola_range_setup *, const struct config_device *);
bool cola_data_setup_want(struct cola_data_setup *, const struct config_device *);

#define COLA_ENCODER_VARIABLES 4
const char *cola_encoder_variable(int i, const char *driver); /* its name; NULL: this family has it not */
bool cola_encoder_want(int i, struct cola_number *);

#endif

/* The settings of a scanner with CoLa (see cola_settings.h).
 *
 *   LMPscancfg       u32 frequency 1/100 Hz | i16 sectors | u32 step | i32 from | i32 to         1/10000 degree
 *   LMPoutputRange   u16 sectors | u32 step | i32 from | i32 to
 *   LMDscandatacfg   2 u8 channels | u8 remission | u8 16 bit | u8 unit | 2 u8 encoder | u8 position | u8 name
 *                    | u8 comment | u8 time | u16 every n-th scan
 *   LICsrc ...       one number, 1, 2 or 4 bytes by the model
 *
 * What a scanner reports is rounded: a range of -45 degrees was written and -44.9997 is read. So angles that differ by
 * less than a hundredth of a degree are equal, else it would be written anew at every start. */
#include "drivers/cola_settings.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define TDEG_PER_RAD  (10000 * 57.295779513082321)
#define STRAIGHT_TDEG 900000
#define EQUAL_TDEG    100
#define EQUAL_STEP    1 /* a step has less room: 0.1666 and 0.1667 are one */
#define EQUAL_CHZ     1

bool cola_scan_setup_read(struct cola_reader *r, struct cola_scan_setup *ret)
{
	struct cola_scan_setup setup = {.known = true};
	setup.frequency_chz = cola_read_u(r, 4);
	setup.sectors = (int16_t)cola_read_i(r, 2);
	setup.resolution_tdeg = cola_read_u(r, 4);
	setup.from_tdeg = cola_read_i(r, 4);
	setup.to_tdeg = cola_read_i(r, 4);
	if (r->failed)
		return false;
	*ret = setup;
	return true;
}

bool cola_range_setup_read(struct cola_reader *r, struct cola_range_setup *ret)
{
	struct cola_range_setup setup = {.known = true};
	setup.sectors = (uint16_t)cola_read_u(r, 2);
	setup.resolution_tdeg = cola_read_u(r, 4);
	setup.from_tdeg = cola_read_i(r, 4);
	setup.to_tdeg = cola_read_i(r, 4);
	if (r->failed)
		return false;
	*ret = setup;
	return true;
}

bool cola_data_setup_read(struct cola_reader *r, struct cola_data_setup *ret)
{
	struct cola_data_setup setup = {.known = true};
	uint8_t *const bytes[] = {&setup.channel[0], &setup.channel[1], &setup.remission,  &setup.wide,
	                          &setup.unit,       &setup.encoder[0], &setup.encoder[1], &setup.position,
	                          &setup.name,       &setup.comment,    &setup.time};
	for (size_t i = 0; i < sizeof bytes / sizeof bytes[0]; i++)
		*bytes[i] = (uint8_t)cola_read_u(r, 1);
	setup.every = (uint16_t)cola_read_u(r, 2);
	if (r->failed)
		return false;
	*ret = setup;
	return true;
}

bool cola_number_read(struct cola_reader *r, struct cola_number *ret)
{
	const long left = (long)(r->end - r->at);
	struct cola_number number = {.known = true, .bytes = 4};
	if (r->dialect == COLA_B)
		number.bytes = left == 1 || left == 2 ? (int)left : 4;
	number.real = r->dialect == COLA_B && left == 4;
	number.value = cola_read_u(r, number.bytes);
	if (r->failed)
		return false;
	*ret = number;
	return true;
}

void cola_scan_setup_write(struct cola_writer *w, const struct cola_scan_setup *setup)
{
	cola_write_u(w, setup->frequency_chz, 4);
	cola_write_decimal(w, setup->sectors, 2);
	cola_write_u(w, setup->resolution_tdeg, 4);
	cola_write_i(w, setup->from_tdeg, 4);
	cola_write_i(w, setup->to_tdeg, 4);
}

void cola_range_setup_write(struct cola_writer *w, const struct cola_range_setup *setup)
{
	cola_write_u(w, setup->sectors, 2);
	cola_write_u(w, setup->resolution_tdeg, 4);
	cola_write_i(w, setup->from_tdeg, 4);
	cola_write_i(w, setup->to_tdeg, 4);
}

void cola_data_setup_write(struct cola_writer *w, const struct cola_data_setup *setup)
{
	cola_write_digits(w, setup->channel[0], 1);
	cola_write_digits(w, setup->channel[1], 1);
	cola_write_u(w, setup->remission, 1);
	cola_write_u(w, setup->wide, 1);
	cola_write_u(w, setup->unit, 1);
	cola_write_digits(w, setup->encoder[0], 1);
	cola_write_digits(w, setup->encoder[1], 1);
	cola_write_u(w, setup->position, 1);
	cola_write_u(w, setup->name, 1);
	cola_write_u(w, setup->comment, 1);
	cola_write_u(w, setup->time, 1);
	cola_write_decimal(w, setup->every, 2);
}

void cola_number_write(struct cola_writer *w, const struct cola_number *number)
{
	cola_write_u(w, number->value, number->bytes);
}

static bool is_far(int64_t a, int64_t b, int64_t tolerance)
{
	return a - b > tolerance || b - a > tolerance;
}

bool cola_scan_setup_want(struct cola_scan_setup *setup, const struct config_device *config)
{
	const uint32_t frequency_chz = (uint32_t)rint(config->frequency_hz * 100);
	const uint32_t resolution_tdeg = (uint32_t)rint(config->resolution_rad * TDEG_PER_RAD);
	bool differs = false;
	if (frequency_chz && is_far(setup->frequency_chz, frequency_chz, EQUAL_CHZ)) {
		setup->frequency_chz = frequency_chz;
		differs = true;
	}
	if (resolution_tdeg && is_far(setup->resolution_tdeg, resolution_tdeg, EQUAL_STEP)) {
		setup->resolution_tdeg = resolution_tdeg;
		differs = true;
	}
	return differs;
}

bool cola_range_setup_want(struct cola_range_setup *setup, const struct config_device *config)
{
	const uint32_t resolution_tdeg = (uint32_t)rint(config->resolution_rad * TDEG_PER_RAD);
	const int32_t from_tdeg = (int32_t)rint(config->angles_from_rad * TDEG_PER_RAD) + STRAIGHT_TDEG;
	const int32_t to_tdeg = (int32_t)rint(config->angles_to_rad * TDEG_PER_RAD) + STRAIGHT_TDEG;
	const bool angles = config->angles_from_rad != config->angles_to_rad;
	bool differs = false;
	/* The output keeps its old step when the scan gets another one, and is then refused or thinned. */
	if (setup->known && resolution_tdeg && is_far(setup->resolution_tdeg, resolution_tdeg, EQUAL_STEP)) {
		setup->resolution_tdeg = resolution_tdeg;
		differs = true;
	}
	if (angles && (is_far(setup->from_tdeg, from_tdeg, EQUAL_TDEG) || is_far(setup->to_tdeg, to_tdeg, EQUAL_TDEG) ||
	               !setup->known)) {
		setup->from_tdeg = from_tdeg;
		setup->to_tdeg = to_tdeg;
		differs = true;
	}
	return differs;
}

bool cola_data_setup_want(struct cola_data_setup *setup, const struct config_device *config)
{
	const struct cola_data_setup was = *setup;
	if (!setup->known)
		*setup = (struct cola_data_setup){.channel = {1, 0}, .every = 1};
	if (config->remission != REMISSION_KEEP) {
		setup->remission = config->remission != REMISSION_OFF;
		if (setup->remission)
			setup->wide = config->remission == REMISSION_16;
	}
	if (config->encoder.set && setup->encoder[0] == 0 && setup->encoder[1] == 0)
		setup->encoder[0] = 1;
	if (setup->channel[0] == 0 && setup->channel[1] == 0)
		setup->channel[0] = 1; /* no echo at all: there would be no ranges */
	if (config->every)
		setup->every = (uint16_t)config->every;
	if (!was.known)
		return config->remission != REMISSION_KEEP || config->encoder.set || config->every;
	return memcmp(&was, setup, sizeof was) != 0;
}

/* What the variables of an encoder have to be, and what is written where they are not. A wiring that was chosen (1 one
 * track, 2 direction and phase, 3 direction and level) and a resolution stay. */
static const struct {
	const char *name;
	uint32_t least, most, written, written_real;
	bool lms5xx_only;
} encoder_variables[COLA_ENCODER_VARIABLES] = {
    {"LICencset", 1, 3, 2, 2, false},
    {"LICsrc", 1, 1, 1, 1, false},
    {"LICencres", 1, UINT32_MAX, 1, 0x3f800000, false},
    {"DO3And4Fnc", 1, 1, 1, 1, true}, /* its pins are outputs otherwise */
};

const char *cola_encoder_variable(int i, const char *driver)
{
	return encoder_variables[i].lms5xx_only && strcmp(driver, "lms5xx") != 0 ? NULL : encoder_variables[i].name;
}

bool cola_encoder_want(int i, struct cola_number *number)
{
	if (number->known && number->value >= encoder_variables[i].least && number->value <= encoder_variables[i].most)
		return false;
	if (!number->known)
		number->bytes = 1;
	number->value = number->real ? encoder_variables[i].written_real : encoder_variables[i].written;
	return true;
}

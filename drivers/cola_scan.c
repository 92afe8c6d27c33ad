/* The body of LMDscandata and LMDscandatamon (see cola_scan.h), in the order of the bytes. In CoLa-A each number is a
 * token (cola_wire.c), in CoLa-B it has these bytes:
 *
 *   version 2 | device 2 | serial 4 | status 1 1 | telegram counter 2 | scan counter 2 | since start-up, us 4 |
 *   transmitted, us 4 | inputs 1 1 | outputs 1 1 | layer 2 | scans, 1/100 Hz 4 | measurements, 100 Hz 4 |
 *   encoders 2 | { ticks 4 | speed 2 }
 *   16-bit channels 2 | { name 5 | scale f4 | offset f4 | start 4 | step 2 | count 2 | { value 2 } }
 *    8-bit channels 2 | { the same | { value 1 } }
 *   position 2 | [ x y z rx ry rz, f4 each | kind 1 ]        each of these: a flag, 0 or 1, and what follows it
 *   name 2     | [ length 1 | characters ]
 *   comment 2  | [ length 1 | characters ]
 *   time 2     | [ year 2 | month 1 | day 1 | hour 1 | minute 1 | second 1 | us 4 ]
 *   event 2    | [ "FDIN" | encoder 4 | us 4 | angle 4 ]
 *
 * The count of tokens means nothing: it changes with the name, with what is switched on and with the remission's width.
 * The layout is the same in every capture of six families, to the last byte; so a telegram with bytes left over is not
 * understood, and refused. */
#include "drivers/cola_scan.h"

#include <errno.h>
#include <string.h>

static void read_head(struct cola_reader *r, struct cola_scan *s)
{
	s->version = (uint16_t)cola_read_u(r, 2);
	s->device = (uint16_t)cola_read_u(r, 2);
	s->serial = cola_read_u(r, 4);
	s->status[0] = (uint8_t)cola_read_u(r, 1);
	s->status[1] = (uint8_t)cola_read_u(r, 1);
	s->telegram_counter = (uint16_t)cola_read_u(r, 2);
	s->scan_counter = (uint16_t)cola_read_u(r, 2);
	s->t_startup_us = cola_read_u(r, 4);
	s->t_transmit_us = cola_read_u(r, 4);
	s->inputs[0] = (uint8_t)cola_read_u(r, 1);
	s->inputs[1] = (uint8_t)cola_read_u(r, 1);
	s->outputs[0] = (uint8_t)cola_read_u(r, 1);
	s->outputs[1] = (uint8_t)cola_read_u(r, 1);
	s->layer = (int16_t)cola_read_i(r, 2);
	s->frequency_chz = cola_read_u(r, 4);
	s->measurement_hhz = cola_read_u(r, 4);
}

static void read_encoders(struct cola_reader *r, struct cola_scan *s)
{
	const uint32_t n = cola_read_u(r, 2);

	if (n > COLA_ENCODERS_MAX)
		r->failed = true;
	for (uint32_t i = 0; i < n && !r->failed; i++) {
		s->encoder[i].ticks = cola_read_u(r, 4);
		s->encoder[i].speed = (uint16_t)cola_read_u(r, 2);
	}
	s->encoders = (int)n;
}

static void skip_values(struct cola_reader *r, unsigned n, int bytes)
{
	const char *ignored;

	if (r->dialect == COLA_B) {
		cola_read_chars(r, (size_t)n * (size_t)bytes, &ignored);
		return;
	}
	for (unsigned i = 0; i < n && !r->failed; i++)
		cola_read_u(r, bytes);
}

static void read_channel(struct cola_reader *r, struct cola_channel *c, int bytes)
{
	const char *name;

	cola_read_chars(r, 5, &name);
	if (name != NULL)
		memcpy(c->name, name, 5);
	c->scale = cola_read_float(r);
	c->offset = cola_read_float(r);
	c->start_tdeg = cola_read_i(r, 4);
	c->step_tdeg = (int32_t)cola_read_u(r, 2);
	c->n = (uint16_t)cola_read_u(r, 2);
	c->bytes = bytes;
	c->values = *r;
	skip_values(r, c->n, bytes);
}

static void read_channels(struct cola_reader *r, struct cola_scan *s, int bytes)
{
	const uint32_t n = cola_read_u(r, 2);

	if (n > (uint32_t)(COLA_CHANNELS_MAX - s->channels))
		r->failed = true;
	for (uint32_t i = 0; i < n && !r->failed; i++)
		read_channel(r, &s->channel[s->channels++], bytes);
}

static bool read_flag(struct cola_reader *r)
{
	const uint32_t flag = cola_read_u(r, 2);

	if (flag > 1)
		r->failed = true;
	return flag == 1;
}

static void read_position(struct cola_reader *r, struct cola_scan *s)
{
	s->has_position = read_flag(r);
	if (!s->has_position)
		return;
	for (int i = 0; i < 6; i++)
		s->position[i] = cola_read_float(r);
	s->position_type = (uint8_t)cola_read_u(r, 1);
}

static void read_time(struct cola_reader *r, struct cola_scan *s)
{
	s->has_time = read_flag(r);
	if (!s->has_time)
		return;
	s->year = (uint16_t)cola_read_u(r, 2);
	s->month = (uint8_t)cola_read_u(r, 1);
	s->day = (uint8_t)cola_read_u(r, 1);
	s->hour = (uint8_t)cola_read_u(r, 1);
	s->minute = (uint8_t)cola_read_u(r, 1);
	s->second = (uint8_t)cola_read_u(r, 1);
	s->microsecond = cola_read_u(r, 4);
}

static void read_event(struct cola_reader *r, struct cola_scan *s)
{
	const char *name;

	s->has_event = read_flag(r);
	if (!s->has_event)
		return;
	cola_read_chars(r, 4, &name);
	if (name != NULL)
		memcpy(s->event, name, 4);
	s->event_encoder = cola_read_u(r, 4);
	s->event_us = cola_read_u(r, 4);
	s->event_angle = cola_read_i(r, 4);
}

int cola_scan_read(enum cola_dialect dialect, const uint8_t *payload, size_t len, struct cola_scan *ret)
{
	struct cola_reader r;

	memset(ret, 0, sizeof(*ret));
	if (!cola_reader_init(&r, dialect, payload, len, "LMDscandata")) {
		ret->monitored = true;
		if (!cola_reader_init(&r, dialect, payload, len, "LMDscandatamon"))
			return -EINVAL;
	}
	read_head(&r, ret);
	read_encoders(&r, ret);
	read_channels(&r, ret, 2);
	read_channels(&r, ret, 1);
	read_position(&r, ret);
	if (read_flag(&r))
		cola_read_string(&r, 1, &ret->name, &ret->name_len);
	if (read_flag(&r))
		cola_read_string(&r, 1, &ret->comment, &ret->comment_len);
	read_time(&r, ret);
	read_event(&r, ret);
	return cola_reader_done(&r) ? 0 : -EINVAL;
}

const struct cola_channel *cola_scan_channel(const struct cola_scan *s, const char *name)
{
	for (int i = 0; i < s->channels; i++) {
		if (strcmp(s->channel[i].name, name) == 0)
			return &s->channel[i];
	}
	return NULL;
}

void cola_channel_values(const struct cola_channel *c, uint16_t *ret)
{
	struct cola_reader r = c->values;

	for (unsigned i = 0; i < c->n; i++)
		ret[i] = (uint16_t)cola_read_u(&r, c->bytes);
}

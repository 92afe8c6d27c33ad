/* Scan telegrams made for tests: the mirror of cola_scan_read, so that what is read can be compared with what was meant. */
#ifndef FACET_TESTS_COLA_TELEGRAMS_H
#define FACET_TESTS_COLA_TELEGRAMS_H

#include <string.h>

#include "drivers/cola_scan.h"

/* The values of a channel are those it stands at, or count up from `base` in steps of `rise`, in its width. */
static inline void telegram_channel(struct cola_writer *w, const struct cola_channel *c, unsigned base, unsigned rise)
{
	cola_write_chars(w, c->name, 5);
	cola_write_float(w, c->scale);
	cola_write_float(w, c->offset);
	cola_write_i(w, c->start_tdeg, 4);
	cola_write_u(w, (uint32_t)c->step_tdeg, 2);
	cola_write_u(w, c->n, 2);
	struct cola_reader values = c->values;
	for (unsigned i = 0; i < c->n; i++)
		cola_write_u(w, values.at != NULL ? cola_read_u(&values, c->bytes) : base + rise * i, c->bytes);
}

static inline void telegram_channels(struct cola_writer *w, const struct cola_scan *s, int bytes, unsigned base,
                                     unsigned rise)
{
	int n = 0;

	for (int i = 0; i < s->channels; i++)
		n += s->channel[i].bytes == bytes;
	cola_write_u(w, (uint32_t)n, 2);
	for (int i = 0; i < s->channels; i++) {
		if (s->channel[i].bytes == bytes)
			telegram_channel(w, &s->channel[i], base, rise);
	}
}

static inline void telegram_head(struct cola_writer *w, const struct cola_scan *s)
{
	cola_write_u(w, s->version, 2);
	cola_write_u(w, s->device, 2);
	cola_write_u(w, s->serial, 4);
	cola_write_u(w, s->status[0], 1);
	cola_write_u(w, s->status[1], 1);
	cola_write_u(w, s->telegram_counter, 2);
	cola_write_u(w, s->scan_counter, 2);
	cola_write_u(w, s->t_startup_us, 4);
	cola_write_u(w, s->t_transmit_us, 4);
	for (int i = 0; i < 2; i++)
		cola_write_u(w, s->inputs[i], 1);
	for (int i = 0; i < 2; i++)
		cola_write_u(w, s->outputs[i], 1);
	cola_write_i(w, s->layer, 2);
	cola_write_u(w, s->frequency_chz, 4);
	cola_write_u(w, s->measurement_hhz, 4);
	cola_write_u(w, (uint32_t)s->encoders, 2);
	for (int i = 0; i < s->encoders; i++) {
		cola_write_u(w, s->encoder[i < COLA_ENCODERS_MAX ? i : 0].ticks, 4);
		cola_write_u(w, s->encoder[i < COLA_ENCODERS_MAX ? i : 0].speed, 2);
	}
}

static inline void telegram_text(struct cola_writer *w, const char *text, size_t len)
{
	cola_write_u(w, text != NULL, 2);
	if (text != NULL)
		cola_write_string(w, text, len, 1);
}

static inline void telegram_tail(struct cola_writer *w, const struct cola_scan *s)
{
	cola_write_u(w, s->has_position, 2);
	for (int i = 0; s->has_position && i < 6; i++)
		cola_write_float(w, s->position[i]);
	if (s->has_position)
		cola_write_u(w, s->position_type, 1);
	telegram_text(w, s->name, s->name_len);
	telegram_text(w, s->comment, s->comment_len);
	cola_write_u(w, s->has_time, 2);
	if (s->has_time) {
		const uint8_t parts[] = {s->month, s->day, s->hour, s->minute, s->second};
		cola_write_u(w, s->year, 2);
		for (size_t i = 0; i < sizeof(parts); i++)
			cola_write_u(w, parts[i], 1);
		cola_write_u(w, s->microsecond, 4);
	}
	cola_write_u(w, s->has_event, 2);
	if (s->has_event) {
		cola_write_chars(w, s->event, 4);
		cola_write_u(w, s->event_encoder, 4);
		cola_write_u(w, s->event_us, 4);
		cola_write_i(w, s->event_angle, 4);
	}
}

/* The whole frame; 0: no room. `words`: "sSN LMDscandata". */
static inline size_t telegram_scan(enum cola_dialect dialect, const char *words, const struct cola_scan *s,
                                   unsigned base, unsigned rise, uint8_t *bytes, size_t cap)
{
	struct cola_writer w;

	cola_writer_init(&w, dialect, bytes, cap, words);
	telegram_head(&w, s);
	telegram_channels(&w, s, 2, base, rise);
	telegram_channels(&w, s, 1, base, rise);
	telegram_tail(&w, s);
	return cola_writer_end(&w);
}

/* A TiM's plain telegram: 270 degrees at one, distances only. */
static inline struct cola_scan telegram_tim(void)
{
	return (struct cola_scan){
	    .version = 1,
	    .device = 1,
	    .serial = 0x1234567,
	    .telegram_counter = 100,
	    .scan_counter = 200,
	    .t_startup_us = 1000000,
	    .t_transmit_us = 1004000,
	    .frequency_chz = 1500,
	    .measurement_hhz = 54,
	    .channels = 1,
	    .channel = {
	        {.name = "DIST1", .scale = 1, .start_tdeg = -450000, .step_tdeg = 10000, .n = 271, .bytes = 2}}};
}

#endif

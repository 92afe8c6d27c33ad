/* What both CoLa targets do. Law: no bytes on either wire crash decoder or dialogue; what comes out does not depend on how
 * the bytes were cut into reads, nor on a snapshot between them; a snapshot from outside is taken whole or not at all.
 *
 * Input: a byte for the configuration, then chunks, each a byte (5-7: what it is, 0-4: length / 160 - 1) and its bytes. */
#ifndef FACET_TESTS_FUZZ_COLA_H
#define FACET_TESTS_FUZZ_COLA_H

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "drivers/cola.h"

enum chunk_kind {
	RAW,     /* from the device */
	FRAMED,  /* the same, as a payload that gets its frame and check sum here, which nobody guesses */
	TO,      /* to the device */
	OPENED,  /* no bytes: the link was opened anew */
	FOREIGN, /* a snapshot from outside, loaded into another decoder */
	TAKEN,   /* no bytes: a snapshot of the decoder, which goes on in another one */
	WAIT,    /* no bytes: time passes */
	LATE     /* like FRAMED, much later */
};

#define SNAPSHOT_MAX (COLA_TELEGRAM_MAX + 65536)

struct reader {
	struct decoder *decoder;
	struct dialogue *dialogue; /* NULL: this one listens only */
	uint64_t seen;             /* hash of what came out */
	int64_t t_ns;
};

static void must(bool condition)
{
	if (!condition)
		abort();
}

static void see(struct reader *reader, const void *bytes, size_t len)
{
	for (size_t i = 0; i < len; i++)
		reader->seen = (reader->seen ^ ((const uint8_t *)bytes)[i]) * 0x100000001B3u;
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	struct reader *reader = ctx;

	(void)device;
	must(reply->len <= REPLY_MAX);
	see(reader, &reply->kind, sizeof(reply->kind));
	see(reader, reply->payload, reply->len);
	if (reader->dialogue != NULL)
		cola_dialogue_reply(reader->dialogue, reply);
}

static void on_profile(void *ctx, int device, const struct profile *p)
{
	struct reader *reader = ctx;

	(void)device;
	must(p->n > 0 && p->n <= PROFILE_BEAMS_MAX && p->interlace == 1 && p->parts == 1 && p->part == 0);
	must(p->turn_ns > 0 && p->beam_ns >= 0 && p->beam_ns <= p->turn_ns);
	must(p->first_rad > -20 && p->first_rad < 20 && p->step_rad > 0 && p->step_rad < 7);
	for (int i = 0; i < p->n; i++)
		must(p->state[i] < BEAM_STATES && p->range_m[i] >= 0 && p->range_m[i] < 8000);
	see(reader, &p->t_ns, sizeof(p->t_ns));
	see(reader, p->range_m, sizeof(p->range_m[0]) * p->n);
	see(reader, p->state, p->n);
	if (reader->dialogue != NULL)
		cola_dialogue_data(reader->dialogue, reader->t_ns);
}

static void on_tilt(void *ctx, int device, const struct tilt *tilt)
{
	struct reader *reader = ctx;

	(void)device;
	see(reader, &tilt->t_ns, sizeof(tilt->t_ns));
	must(tilt->angle_rad > -1e10 && tilt->angle_rad < 1e10);
	see(reader, &tilt->angle_rad, sizeof(tilt->angle_rad));
}

static void feed(struct reader *reader, enum direction direction, const uint8_t *bytes, size_t len)
{
	const struct record_sink sink = {.ctx = reader, .profile = on_profile, .tilt = on_tilt, .reply = on_reply};
	const struct record record = {
	    .log_ns = reader->t_ns, .t_ns = reader->t_ns, .direction = direction, .bytes = bytes, .len = len};

	cola_decode(reader->decoder, &record, &sink);
}

static void step(struct reader *reader)
{
	struct dialogue_step got;

	cola_dialogue_step(reader->dialogue, reader->t_ns, &got);
	must(got.write_len <= sizeof(got.write) && memchr(got.error, 0, sizeof(got.error)) != NULL);
	if (got.state == DIALOGUE_FAILED)
		cola_dialogue_reset(reader->dialogue, reader->t_ns);
}

static void check_words(const struct decoder *d)
{
	struct decoder_counters counters;
	struct decoder_timing timing;

	cola_counters(d, &counters);
	must(counters.n > 0 && counters.n <= DECODER_COUNTERS_MAX);
	cola_timing(d, &timing);
	must(timing.known && timing.expected_hz >= 0 && timing.expected_hz <= 600);
}

/* The decoder is replaced by one that was filled from its snapshot. */
static void take_over(struct reader *reader, const struct config_device *config)
{
	static uint8_t bytes[SNAPSHOT_MAX];
	struct state s;

	state_save(&s, bytes, sizeof(bytes));
	cola_decoder_state(reader->decoder, &s);
	must(state_done(&s));
	const size_t len = s.at;
	struct decoder *other = cola_decoder_create(config, 0);
	must(other != NULL);
	state_load(&s, bytes, len);
	cola_decoder_state(other, &s);
	must(state_done(&s));
	cola_decoder_destroy(reader->decoder);
	reader->decoder = other;
}

static void load_foreign(const struct config_device *config, const uint8_t *bytes, size_t len, int64_t t_ns)
{
	static const char telegram[] =
	    "\x02sRA DeviceIdent 3 TiM 1 1\x03"
	    "\x02sSN LMDscandata 1 1 5 0 0 1 9 1 FFF 0 0 0 0 0 5DC 36 0 1 DIST1 3F800000 0 0 "
	    "1388 2 100 101 0 0 0 0 0 0\x03";
	struct reader reader = {.decoder = cola_decoder_create(config, 0), .t_ns = t_ns};
	struct state s;

	must(reader.decoder != NULL);
	state_load(&s, bytes, len);
	cola_decoder_state(reader.decoder, &s);
	for (int i = 0; i < 3; i++) {
		feed(&reader, FROM_DEVICE, (const uint8_t *)telegram, sizeof(telegram) - 1);
		check_words(reader.decoder);
		feed(&reader, LINK_OPENED, NULL, 0);
		reader.t_ns += 100000000;
	}
	cola_decoder_destroy(reader.decoder);
}

static size_t frame(enum cola_dialect dialect, const uint8_t *payload, size_t len, uint8_t *ret)
{
	size_t at = 0;

	for (int i = 0; i < (dialect == COLA_B ? 4 : 1); i++)
		ret[at++] = 2;
	for (int i = 24; dialect == COLA_B && i >= 0; i -= 8)
		ret[at++] = (uint8_t)(len >> i);
	memcpy(ret + at, payload, len);
	at += len;
	uint8_t sum = 0;
	for (size_t i = 0; i < len; i++)
		sum ^= payload[i];
	ret[at++] = dialect == COLA_B ? sum : 3;
	return at;
}

static void configure(uint8_t byte, struct config_device *ret)
{
	static const char *const drivers[] = {"tim", "lms1xx", "lms5xx", "tim"};

	*ret = (struct config_device){.every = byte >> 6 & 1, .latency_ns = byte};
	snprintf(ret->driver, sizeof(ret->driver), "%s", drivers[byte & 3]);
	ret->stamp = (byte >> 2 & 3) % 3 == 0 ? STAMP_AUTO : (byte & 4) != 0 ? STAMP_START : STAMP_END;
	ret->encoder.set = (byte & 16) != 0;
	ret->encoder.scale = 0.001;
	ret->encoder.zero = 100;
	ret->encoder.sign = (byte & 32) != 0 ? -1 : 1;
	ret->encoder.wrap = (byte & 32) != 0 ? 4096 : 0;
	ret->protocol = (byte & 128) != 0 ? PROTOCOL_COLA_B : PROTOCOL_AUTO;
}

static void fuzz_cola(enum cola_dialect dialect, const uint8_t *data, size_t size)
{
	static struct config config;
	struct config_device *device = &config.device[0];
	uint8_t telegram[32 * 160 + 16];

	if (size < 1)
		return;
	configure(data[0], device);
	struct reader whole = {.decoder = cola_decoder_create(device, 0), .dialogue = cola_dialogue_create(&config, 0)};
	struct reader bytewise = {.decoder = cola_decoder_create(device, 0)};
	must(whole.decoder != NULL && whole.dialogue != NULL && bytewise.decoder != NULL);
	cola_dialogue_reset(whole.dialogue, 0);
	for (size_t at = 1; at < size;) {
		const uint8_t head = data[at++];
		const enum chunk_kind kind = (enum chunk_kind)(head >> 5);
		const size_t want = ((size_t)(head & 31) + 1) * 160;
		const bool bytes_follow = kind != OPENED && kind != TAKEN && kind != WAIT;
		size_t len = !bytes_follow ? 0 : want < size - at ? want : size - at;
		const uint8_t *bytes = data + at;
		at += len;
		whole.t_ns = bytewise.t_ns = whole.t_ns + (kind == LATE   ? 2000000000
		                                           : kind == WAIT ? 300000000
		                                                          : 20000000);
		if (kind == FOREIGN) {
			load_foreign(device, bytes, len, whole.t_ns);
			continue;
		}
		if (kind == FRAMED || kind == LATE) {
			len = frame(dialect, bytes, len, telegram);
			bytes = telegram;
		}
		if (kind == TAKEN)
			take_over(&bytewise, device);
		const enum direction direction = kind == TO ? TO_DEVICE : kind == OPENED ? LINK_OPENED : FROM_DEVICE;
		if (len > 0 || kind == OPENED)
			feed(&whole, direction, bytes, len);
		if (kind == OPENED)
			feed(&bytewise, direction, bytes, 0);
		/* Bytewise where the decisions are; a begun CoLa-A telegram is read anew with every piece. */
		for (size_t i = 0, piece; i < len; i += piece) {
			piece = i < 100 ? 1 : len - i < 61 ? len - i : 61;
			feed(&bytewise, direction, bytes + i, piece);
		}
		step(&whole);
		must(whole.seen == bytewise.seen);
	}
	check_words(whole.decoder);
	cola_decoder_destroy(whole.decoder);
	cola_dialogue_destroy(whole.dialogue);
	cola_decoder_destroy(bytewise.decoder);
}

#endif

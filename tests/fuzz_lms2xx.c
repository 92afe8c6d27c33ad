/* Law: no bytes on either wire crash the LMS2xx framer, decoder or dialogue, and what comes out does not depend on how the
 * bytes were cut into reads; what is decoded as a measurement encodes to the same values again; a snapshot goes on the same,
 * and a broken one is refused or bears what comes.
 *
 * Input: chunks, each a byte (6-7: what it is, 0-5: length / 16 - 1), then its bytes: raw from the device, the same 300 ms later,
 * raw to the device, or a payload from the device that gets its frame and check sum here (which nobody guesses). */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "drivers/driver.h"
#include "drivers/lms2xx_wire.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

enum { RAW, LATE, TO, FRAMED };

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

static void check_scan(const struct lms2xx_scan *scan)
{
	uint8_t bytes[LMS2XX_TELEGRAM_MAX];
	struct lms2xx_scan again;
	if ((scan->command != LMS2XX_SCAN && scan->command != LMS2XX_SCAN_RANGE) || scan->n > LMS2XX_BEAMS_MAX)
		return;
	const size_t len = lms2xx_encode_scan(scan, bytes);
	must(lms2xx_scan_device(NULL, bytes, len, false) == (int)len);
	must(lms2xx_decode_scan(bytes + 4, len - 6, &again));
	must(again.n == scan->n && again.unit == scan->unit && again.part == scan->part && again.start == scan->start);
	must(memcmp(again.value, scan->value, 2 * (size_t)scan->n) == 0);
	for (unsigned i = 0; i < scan->n; i++) {
		static const int modes[] = {0x01, 0x03, 0x05, 0x0F};
		const int mode = modes[i & 3];
		uint16_t range = 0;
		const enum beam_state state =
		    lms2xx_range((uint16_t)(scan->value[2 * i] | scan->value[2 * i + 1] << 8), mode, &range);
		uint16_t same = 0;
		must(lms2xx_range(lms2xx_word(state, range, mode), mode, &same) == state && same == range);
	}
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	struct reader *reader = ctx;
	struct lms2xx_scan scan;
	(void)device;
	must(reply->len <= REPLY_MAX);
	see(reader, &reply->kind, sizeof reply->kind);
	see(reader, reply->payload, reply->len);
	if (reply->len > 0 && lms2xx_decode_scan(reply->payload, reply->len, &scan))
		check_scan(&scan);
	if (reader->dialogue != NULL)
		driver_lms2xx.dialogue_reply(reader->dialogue, reply);
}

static void on_profile(void *ctx, int device, const struct profile *p)
{
	struct reader *reader = ctx;
	(void)device;
	must(p->n <= PROFILE_BEAMS_MAX && p->interlace >= 1 && p->part < p->parts);
	for (int i = 0; i < p->n; i++)
		must(p->state[i] < BEAM_STATES && p->range_m[i] >= 0 && p->range_m[i] < 7000);
	see(reader, &p->t_ns, sizeof p->t_ns);
	see(reader, p->range_m, sizeof p->range_m[0] * p->n);
	if (reader->dialogue != NULL)
		driver_lms2xx.dialogue_data(reader->dialogue, reader->t_ns);
}

static void feed(struct reader *reader, enum direction direction, const uint8_t *bytes, size_t len)
{
	const struct record_sink sink = {.ctx = reader, .profile = on_profile, .reply = on_reply};
	const struct record record = {
	    .log_ns = reader->t_ns, .t_ns = reader->t_ns, .direction = direction, .bytes = bytes, .len = len};
	driver_lms2xx.decode(reader->decoder, &record, &sink);
}

/* The decoder is replaced by one that its snapshot was loaded into; another one gets the snapshot with a byte changed. */
static void change_decoder(struct reader *reader, const struct config_device *config, const uint8_t *bytes, size_t len)
{
	static uint8_t snapshot[1 << 15];
	struct reader broken = {.decoder = driver_lms2xx.decoder_create(config, 0), .t_ns = reader->t_ns};
	struct decoder *fresh = driver_lms2xx.decoder_create(config, 0);
	struct state s;
	must(fresh != NULL && broken.decoder != NULL);
	state_save(&s, snapshot, sizeof snapshot);
	driver_lms2xx.state(reader->decoder, &s);
	must(state_done(&s));
	const size_t size = s.at;
	state_load(&s, snapshot, size);
	driver_lms2xx.state(fresh, &s);
	must(state_done(&s));
	driver_lms2xx.decoder_destroy(reader->decoder);
	reader->decoder = fresh;
	for (size_t i = 0; i + 2 < len; i += 3)
		snapshot[(size_t)(bytes[i] << 8 | bytes[i + 1]) % size] ^= bytes[i + 2];
	state_load(&s, snapshot, size);
	driver_lms2xx.state(broken.decoder, &s);
	for (int i = 0; i < 4; i++) {
		feed(&broken, FROM_DEVICE, bytes, len);
		broken.t_ns += 20000000;
	}
	driver_lms2xx.decoder_destroy(broken.decoder);
}

static void step(struct reader *reader)
{
	struct dialogue_step got;
	driver_lms2xx.dialogue_step(reader->dialogue, reader->t_ns, &got);
	must(got.write_len <= sizeof got.write);
	if (got.state == DIALOGUE_FAILED)
		driver_lms2xx.dialogue_reset(reader->dialogue, reader->t_ns);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static struct config config;
	config.device[0] = (struct config_device){.baud = 38400, .fov_deg = 180, .resolution_cdeg = 50, .mode = 0x05};
	struct reader whole = {.decoder = driver_lms2xx.decoder_create(&config.device[0], 0),
	                       .dialogue = driver_lms2xx.dialogue_create(&config, 0)};
	struct reader bytewise = {.decoder = driver_lms2xx.decoder_create(&config.device[0], 0)};
	must(whole.decoder != NULL && whole.dialogue != NULL && bytewise.decoder != NULL);
	driver_lms2xx.dialogue_reset(whole.dialogue, 0);
	for (size_t at = 0; at < size;) {
		const uint8_t head = data[at++];
		const size_t want = ((size_t)(head & 63) + 1) * 16;
		size_t len = want < size - at ? want : size - at;
		const int kind = head >> 6;
		const enum direction direction = kind == TO ? TO_DEVICE : FROM_DEVICE;
		uint8_t telegram[LMS2XX_TELEGRAM_MAX];
		const uint8_t *bytes = data + at;
		at += len;
		if (kind == FRAMED && len > 0) {
			len = lms2xx_encode(0x80, bytes, len, telegram);
			bytes = telegram;
		}
		whole.t_ns = bytewise.t_ns = whole.t_ns + (kind == LATE ? 300000000 : 20000000);
		feed(&whole, direction, bytes, len);
		const size_t piece =
		    kind == LATE ? len : 1; /* what the first read after a silence delivers is judged as one */
		for (size_t i = 0; i < len; i += piece)
			feed(&bytewise, direction, bytes + i, piece);
		step(&whole);
		if (kind == LATE || (kind == FRAMED && len % 4 == 1))
			change_decoder(&whole, &config.device[0], bytes, len < 6 ? len : 6);
		must(whole.seen == bytewise.seen);
	}
	struct decoder_counters counters;
	driver_lms2xx.counters(whole.decoder, &counters);
	must(counters.n <= DECODER_COUNTERS_MAX);
	driver_lms2xx.decoder_destroy(whole.decoder);
	driver_lms2xx.dialogue_destroy(whole.dialogue);
	driver_lms2xx.decoder_destroy(bytewise.decoder);
	return 0;
}

/* A simulated LMS2xx: the device's end of the wire, byte for byte; a brain, without descriptor and clock (sim_device.h).
 *
 *   host -> framer -> answer: ACK, reply            (or NAK; or nothing it can read, at another rate)
 *   mirror: turn k begins at turn0 + k * 13.3 ms, always
 *      begin a scan at a turn -> its last beam passes: scene->scan, telegram -> line at the wire's pace -> host
 *
 * Where the host's end stands at another rate the bytes of both directions are garbled. A slow host is not forgiven by a
 * UART, but it is by the kernel's buffer: bytes wait here then, and scans that end while the wire is busy are skipped,
 * as the scanner does.
 *
 * A paced scene that became ready at t must be ready, too, at the time to which its reader dates the profile. The reader may
 * err by a turn of the mirror (arrivals tell it the mirror's phase, and a busy host delays them all), and without the
 * wire's pace by the transfer it still reckons with: the profile begins at the first turn after t and both of these. */
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "drivers/lms2xx_wire.h"
#include "tools/sim_line.h"

enum { STATUS_OK = 0x10, QUEUE = 8192, STALE_NS = 20000000, ASK_NS = 1000000 };

/* Its own faults, behind those of any line. Settings ("baud 38400", "mode 3") are taken on at once and stay. */
static const char *const kinds[] = {
    SIM_LINE_KINDS,   "ack lost",  "nak",  "reject", "no answer", "false stx", "false start", "codes", "power", "baud",
    "permanent baud", "streaming", "mode", "cm",     "mm",        "indices",   "no indices",  "parts", "drift", NULL};
enum fault {
	ACK_LOST = SIM_LINE_FAULTS, /* a reply comes without it */
	NAK,                        /* a request is not understood */
	REJECT,                     /* ... or not wanted */
	NO_ANSWER,
	FALSE_STX,   /* what looks like a telegram's begin stands among the ranges */
	FALSE_START, /* ... or before the telegram */
	CODES,       /* beams carry every error code of their width */
	POWER,       /* off so long, then says 90 at its power-on rate */
	BAUD,
	PERMANENT_BAUD, /* the rate now set outlives power cycles; or this one */
	STREAMING,      /* it streams, as from another program that was killed */
	MODE,
	CM,
	MM,
	INDICES,
	NO_INDICES,
	PARTS, /* streams partial scans */
	DRIFT, /* the mirror turns so many ppm too fast */
	FAULTS
};

struct lms {
	bool fast;
	uint32_t power_on_baud, host_baud; /* host 0: not known, or no matter */
	struct scene scene;
	int64_t now_ns;
	struct sim_fault_state fault[FAULTS - SIM_LINE_FAULTS];
	uint64_t random;
	struct sim_counts counts; /* beside the line's */
	bool off;

	/* the device */
	uint32_t baud;
	uint32_t next_baud; /* taken on when the line is empty; 0: none */
	bool resetting;     /* likewise a power cycle */
	uint8_t mode;       /* enum lms2xx_mode */
	int fov_deg, resolution_cdeg;
	uint8_t config[LMS2XX_CONFIG_MAX];
	uint8_t scan_index, telegram_index, part;
	struct framer framer;
	uint8_t heard[4096];
	int64_t heard_ns;

	/* the mirror */
	int64_t turn0_ns;
	int64_t turns3_ns; /* three turns take */
	bool once;         /* one scan was asked for */
	bool measuring;
	int64_t begin_ns; /* of the scan being measured */
	int64_t free_ns;  /* the next scan begins at the first turn from here on */
	int64_t ready_ns; /* the paced scene is ready since then; 0: it is not */
	struct profile profile;

	/* the wire */
	struct sim_line line;
	uint8_t garble;
	bool awaited; /* a profile is on its way to the reader */
	bool spoiled; /* and some of it went out at a rate that the reader does not have */
};

/* The wire */

static bool due(struct lms *sim, enum fault kind)
{
	return sim_fault_due(&sim->fault[kind - SIM_LINE_FAULTS]);
}

static int64_t transfer_ns(const struct lms *sim, size_t bytes)
{
	return (int64_t)bytes * 10 * 1000000000 / sim->baud;
}

static void set_baud(struct lms *sim, uint32_t baud)
{
	sim->baud = baud;
	sim->line.byte_ns = sim->fast ? 0 : 1e10 / baud;
}

static bool rates_differ(const struct lms *sim)
{
	return sim->host_baud != 0 && sim->host_baud != sim->baud;
}

/* What the other rate makes of the bytes: never the same ones twice. */
static void garble(struct lms *sim, uint8_t *bytes, size_t len)
{
	for (size_t i = 0; i < len; i++)
		bytes[i] = (uint8_t)((bytes[i] ^ 0xA5) * 3 + (sim->garble += 29));
}

/* Full: the bytes are lost; a reader that stopped reading asks again. */
static bool enqueue(struct lms *sim, const uint8_t *bytes, size_t len, int64_t from_ns, bool profile)
{
	return sim_line_put(&sim->line, bytes, len, from_ns, profile);
}

/* The mirror: 75 turns a second are three in 40 ms. */

static int64_t turn_from(const struct lms *sim, int64_t t_ns)
{
	const int64_t since = t_ns > sim->turn0_ns ? t_ns - sim->turn0_ns : 0;
	const int64_t k = (since * 3 + sim->turns3_ns - 1) / sim->turns3_ns;
	return sim->turn0_ns + k * sim->turns3_ns / 3;
}

static int turns(const struct lms *sim)
{
	return sim->mode == LMS2XX_MODE_PARTS ? 1 : 100 / sim->resolution_cdeg;
}

/* From the begin of the first turn to the last beam: a narrower fan stands in the middle of the half turn. */
static int64_t last_beam_ns(const struct lms *sim)
{
	const int last_deg = 90 + sim->fov_deg / 2;
	return sim->begin_ns + (turns(sim) - 1) * (int64_t)LMS2XX_TURN_NS + last_deg * LMS2XX_BEAM_NS;
}

static void fill_raster(struct lms *sim)
{
	struct profile *p = &sim->profile;
	const bool parts = sim->mode == LMS2XX_MODE_PARTS;
	const int step_cdeg = parts ? 100 : sim->resolution_cdeg;
	p->t_ns = sim->begin_ns + (90 - sim->fov_deg / 2) * LMS2XX_BEAM_NS;
	p->beam_ns = LMS2XX_BEAM_NS;
	p->turn_ns = LMS2XX_TURN_NS;
	p->interlace = (uint8_t)turns(sim);
	p->part = parts ? sim->part : 0;
	p->parts = parts ? 4 : 1;
	p->n = (uint16_t)(sim->fov_deg * 100 / step_cdeg + (p->part == 0 ? 1 : 0));
	p->step_rad = step_cdeg / 100.0 * TRIG_DEG;
	p->first_rad = (sim->fov_deg * -50 + 25 * p->part) / 100.0 * TRIG_DEG;
}

/* Every code of the width, over and over, but at every eighth beam: what is reserved among them too. */
static void put_codes(uint8_t *words, unsigned n, int bits)
{
	const unsigned greatest = bits > 0 ? (1u << bits) - 1 : 0;
	for (unsigned i = 0, k = 0; i < n && greatest > 0; i += 8, k = (k + 1) % 9) {
		words[2 * i] = (uint8_t)(greatest - k);
		words[2 * i + 1] = (uint8_t)((greatest - k) >> 8);
	}
}

/* A begin that promises a telegram of 361 values. */
static void put_start(uint8_t *bytes)
{
	memcpy(bytes, (const uint8_t[]){0x02, 0x80, 0xD6, 0x02}, 4);
}

static size_t encode_profile(struct lms *sim, uint8_t *ret)
{
	const struct profile *p = &sim->profile;
	const uint8_t unit = sim->config[LMS2XX_CONFIG_UNIT];
	const int mode = sim->config[LMS2XX_CONFIG_MODE];
	uint8_t words[2 * LMS2XX_BEAMS_MAX] = {0};
	struct lms2xx_scan scan = {.command = LMS2XX_SCAN,
	                           .unit = unit,
	                           .n = p->n,
	                           .stride = 2,
	                           .value = words,
	                           .partial = p->parts > 1,
	                           .part = p->part,
	                           .status = STATUS_OK,
	                           .indexed =
	                               (sim->config[LMS2XX_CONFIG_AVAILABILITY] & LMS2XX_AVAILABILITY_INDICES) != 0,
	                           .scan_index = sim->scan_index,
	                           .telegram_index = sim->telegram_index};
	for (unsigned i = 0; i < p->n && lms2xx_range_bits(mode) > 0; i++) {
		const uint16_t word =
		    lms2xx_word((enum beam_state)p->state[i], (double)p->range_m[i] / lms2xx_unit_m(unit), mode);
		words[2 * i] = (uint8_t)word;
		words[2 * i + 1] = (uint8_t)(word >> 8);
	}
	if (due(sim, CODES))
		put_codes(words, p->n, lms2xx_range_bits(mode));
	if (due(sim, FALSE_STX))
		put_start(words + 2 * (size_t)(sim_random(&sim->random) * (p->n - 3)));
	return lms2xx_encode_scan(&scan, ret);
}

static void send_profile(struct lms *sim, int64_t end_ns)
{
	uint8_t telegram[LMS2XX_TELEGRAM_MAX + 4];
	const bool started = due(sim, FALSE_START);
	if (started)
		put_start(telegram);
	const size_t len = encode_profile(sim, telegram + (started ? 4 : 0)) + (started ? 4 : 0);
	sim->awaited = enqueue(sim, telegram, len, end_ns, true) && sim->scene.taken != NULL;
	sim->spoiled = false;
}

/* The last beam has passed. While the wire is busy the scan is skipped; a paced scene never outruns it. */
static void end_scan(struct lms *sim)
{
	const int64_t end_ns = last_beam_ns(sim);
	sim->measuring = false;
	sim->free_ns = sim->begin_ns + turns(sim) * (int64_t)LMS2XX_TURN_NS - LMS2XX_TURN_NS / 2;
	sim->scan_index++;
	sim->counts.profiles++;
	if (sim->scene.ready == NULL && !sim->once && (!sim_line_idle(&sim->line) || sim->line.end_ns > end_ns)) {
		sim->counts.dropped++;
		return;
	}
	sim->once = false;
	fill_raster(sim);
	sim->scene.scan(sim->scene.ctx, &sim->profile);
	send_profile(sim, end_ns);
	sim->telegram_index++;
	sim->part = (sim->part + 1) & 3;
}

static bool wants_scan(const struct lms *sim)
{
	return !sim->off && (sim->once || sim->mode == LMS2XX_MODE_STREAM || sim->mode == LMS2XX_MODE_PARTS);
}

/* Earliest time at which the next scan may begin; INT64_MAX: not known yet. */
static int64_t may_begin(struct lms *sim, int64_t now_ns)
{
	if (sim->scene.ready == NULL)
		return sim->free_ns;
	if (sim->ready_ns == 0) {
		if (!sim->scene.ready(sim->scene.ctx, now_ns))
			return INT64_MAX;
		sim->ready_ns = now_ns;
	}
	const size_t bytes = 2 * (size_t)(sim->fov_deg * 100 / sim->resolution_cdeg) + 14;
	const int64_t from_ns = sim->ready_ns + LMS2XX_TURN_NS + (sim->fast ? transfer_ns(sim, bytes) : 0);
	return from_ns > sim->free_ns ? from_ns : sim->free_ns;
}

static void turn_mirror(struct lms *sim, int64_t now_ns)
{
	while (wants_scan(sim)) {
		if (!sim->measuring) {
			const int64_t from_ns = may_begin(sim, now_ns);
			if (from_ns > now_ns || turn_from(sim, from_ns) > now_ns)
				return;
			sim->begin_ns = turn_from(sim, from_ns);
			sim->ready_ns = 0;
			sim->measuring = true;
		}
		if (last_beam_ns(sim) > now_ns)
			return;
		end_scan(sim);
	}
	sim->measuring = false;
	sim->ready_ns = 0;
}

/* Answers */

static void reply(struct lms *sim, const uint8_t *payload, size_t len)
{
	uint8_t telegram[LMS2XX_TELEGRAM_MAX];
	const size_t n = lms2xx_encode(0x80, payload, len, telegram);
	sim->counts.replies++;
	enqueue(sim, telegram, n, sim->now_ns, false);
}

static void reply_rejected(struct lms *sim)
{
	reply(sim, (const uint8_t[]){LMS2XX_REJECTED, STATUS_OK}, 2);
}

static void reply_text(struct lms *sim, uint8_t command, uint8_t status)
{
	static const char text[] = "LMS200;301063;V02.06 ";
	uint8_t p[1 + sizeof text];
	p[0] = command;
	memcpy(p + 1, text, sizeof text - 1);
	p[sizeof text] = status;
	reply(sim, p, sizeof p);
}

static void reply_status(struct lms *sim)
{
	uint8_t p[154] = {LMS2XX_STATUS_REPLY, 'V', '0', '2', '.', '0', '6', ' ', sim->mode};
	const uint16_t baud_word = sim->baud == 9600    ? 0x8067
	                           : sim->baud == 19200 ? 0x8033
	                           : sim->baud == 38400 ? 0x8019
	                                                : 0x8001;
	p[67] = 4500 & 0xFF; /* motor revolutions per minute */
	p[68] = 4500 >> 8;
	p[102] = sim->config[LMS2XX_CONFIG_MODE];
	p[107] = (uint8_t)sim->fov_deg;
	p[109] = (uint8_t)sim->resolution_cdeg;
	p[116] = (uint8_t)baud_word;
	p[117] = (uint8_t)(baud_word >> 8);
	p[122] = sim->config[LMS2XX_CONFIG_UNIT];
	p[153] = STATUS_OK;
	reply(sim, p, sizeof p);
}

static void reply_config(struct lms *sim, const uint8_t *front, size_t n)
{
	uint8_t p[3 + LMS2XX_CONFIG_MAX];
	memcpy(p, front, n);
	memcpy(p + n, sim->config, sizeof sim->config);
	p[n + sizeof sim->config] = STATUS_OK;
	reply(sim, p, n + sizeof sim->config + 1);
}

static void power_up(struct lms *sim)
{
	set_baud(sim, sim->power_on_baud);
	sim->next_baud = 0;
	sim->resetting = false;
	sim->mode = LMS2XX_MODE_IDLE;
	sim->fov_deg = 180;
	sim->resolution_cdeg = 50;
	sim->scan_index = sim->telegram_index = sim->part = 0;
	sim->once = sim->measuring = sim->awaited = false;
	sim->ready_ns = 0;
	sim_line_clear(&sim->line);
	framer_init(&sim->framer, lms2xx_scan_host, NULL, sim->heard, sizeof sim->heard);
}

static void power_cycle(struct lms *sim)
{
	enum { POWER_ON_STATUS = 0x13 };
	sim->counts.power_cycles++;
	power_up(sim);
	reply_text(sim, LMS2XX_POWER_ON, POWER_ON_STATUS);
}

static void begin_stream(struct lms *sim, uint8_t mode)
{
	sim->mode = mode;
	sim->measuring = false;
	sim->ready_ns = 0;
	sim->free_ns = sim->now_ns;
}

static void change_mode(struct lms *sim, const uint8_t *p, size_t len)
{
	enum { OK = 0, WRONG_PASSWORD = 1, UNKNOWN = 3 };
	uint8_t result = OK;
	switch (p[1]) {
	case LMS2XX_MODE_INSTALL:
		if (len != 10 || memcmp(p + 2, LMS2XX_PASSWORD, 8) != 0)
			result = WRONG_PASSWORD;
		else
			sim->mode = LMS2XX_MODE_INSTALL;
		break;
	case LMS2XX_MODE_IDLE:
		sim->mode = LMS2XX_MODE_IDLE;
		break;
	case LMS2XX_MODE_STREAM:
	case LMS2XX_MODE_PARTS:
		begin_stream(sim, p[1]);
		break;
	default:
		if (lms2xx_mode_baud(p[1]) == 0)
			result = UNKNOWN;
		break;
	}
	reply(sim, (const uint8_t[]){LMS2XX_MODE_REPLY, result, STATUS_OK}, 3);
	sim->next_baud = lms2xx_mode_baud(p[1]); /* once this reply has left */
}

static void change_variant(struct lms *sim, const uint8_t *p, size_t len)
{
	if (len != 5 || (sim->mode != LMS2XX_MODE_IDLE && sim->mode != LMS2XX_MODE_INSTALL)) {
		reply_rejected(sim);
		return;
	}
	const int fov_deg = p[1] | p[2] << 8, resolution_cdeg = p[3] | p[4] << 8;
	const bool known = (fov_deg == 100 || fov_deg == 180) && (resolution_cdeg == 100 || resolution_cdeg == 50 ||
	                                                          (resolution_cdeg == 25 && fov_deg == 100));
	if (known) {
		sim->fov_deg = fov_deg;
		sim->resolution_cdeg = resolution_cdeg;
	}
	reply(sim,
	      (const uint8_t[]){LMS2XX_VARIANT_REPLY, known, (uint8_t)sim->fov_deg, 0, (uint8_t)sim->resolution_cdeg, 0,
	                        STATUS_OK},
	      7);
}

static void change_config(struct lms *sim, const uint8_t *p, size_t len)
{
	if (sim->mode != LMS2XX_MODE_INSTALL) {
		reply_rejected(sim);
		return;
	}
	const bool sane = len == 1 + sizeof sim->config && p[1 + LMS2XX_CONFIG_UNIT] <= LMS2XX_DM;
	if (sane)
		memcpy(sim->config, p + 1, sizeof sim->config);
	reply_config(sim, (const uint8_t[]){LMS2XX_CONFIG_WRITTEN, sane}, 2);
}

static void keep_baud(struct lms *sim, const uint8_t *p, size_t len)
{
	if (len != 2 || sim->mode != LMS2XX_MODE_INSTALL) {
		reply_rejected(sim);
		return;
	}
	sim->power_on_baud = p[1] != 0 ? sim->baud : 9600;
	reply(sim, (const uint8_t[]){LMS2XX_KEEP_BAUD_REPLY, 1, STATUS_OK}, 3);
}

static void obey(struct lms *sim, const uint8_t *p, size_t len)
{
	switch (p[0]) {
	case LMS2XX_RESET:
		reply(sim, (const uint8_t[]){LMS2XX_RESET_DONE, STATUS_OK}, 2);
		sim->mode = LMS2XX_MODE_IDLE;
		sim->resetting = true; /* once this reply has left */
		break;
	case LMS2XX_MODE:
		if (len >= 2)
			change_mode(sim, p, len);
		else
			reply_rejected(sim);
		break;
	case LMS2XX_MEASURE:
		if (sim->mode == LMS2XX_MODE_IDLE) {
			begin_stream(sim, LMS2XX_MODE_IDLE);
			sim->once = true;
		} else {
			reply_rejected(sim);
		}
		break;
	case LMS2XX_STATUS:
		reply_status(sim);
		break;
	case LMS2XX_ERRORS:
		reply(sim, (const uint8_t[]){LMS2XX_ERRORS_REPLY, STATUS_OK}, 2);
		break;
	case LMS2XX_TYPE:
		reply_text(sim, LMS2XX_TYPE_REPLY, STATUS_OK);
		break;
	case LMS2XX_VARIANT:
		change_variant(sim, p, len);
		break;
	case LMS2XX_CONFIG_READ:
		reply_config(sim, (const uint8_t[]){LMS2XX_CONFIG_REPLY}, 1);
		break;
	case LMS2XX_CONFIG_WRITE:
		change_config(sim, p, len);
		break;
	case LMS2XX_KEEP_BAUD:
		keep_baud(sim, p, len);
		break;
	default:
		reply_rejected(sim);
		break;
	}
}

static void answer(struct lms *sim, const uint8_t *p, size_t len)
{
	sim->counts.requests++;
	if (due(sim, NO_ANSWER))
		return;
	if (due(sim, NAK)) {
		enqueue(sim, (const uint8_t[]){LMS2XX_NAK}, 1, sim->now_ns, false);
		return;
	}
	if (!due(sim, ACK_LOST))
		enqueue(sim, (const uint8_t[]){LMS2XX_ACK}, 1, sim->now_ns, false);
	if (due(sim, REJECT))
		reply_rejected(sim);
	else
		obey(sim, p, len);
}

static void listen_to(struct lms *sim, const uint8_t *bytes, size_t len, int64_t now_ns)
{
	const uint8_t *telegram;
	size_t n;
	if (now_ns - sim->heard_ns > STALE_NS)
		framer_silence(&sim->framer);
	sim->heard_ns = now_ns;
	const uint64_t bad = sim->framer.refused[LMS2XX_BAD_CRC];
	for (size_t done = 0; done < len;) {
		done += framer_push(&sim->framer, bytes + done, len - done);
		while ((n = framer_take(&sim->framer, &telegram)) > 0)
			answer(sim, telegram + 4, n - 6);
	}
	if (sim->framer.refused[LMS2XX_BAD_CRC] > bad)
		enqueue(sim, (const uint8_t[]){LMS2XX_NAK}, 1, now_ns, false);
}

/* The device's other end (sim_device.h) */

static void device_receive(void *ctx, const uint8_t *bytes, size_t len, int64_t t_ns)
{
	struct lms *sim = ctx;
	uint8_t heard[1024];
	sim->now_ns = t_ns;
	if (sim->off)
		return;
	for (size_t done = 0, n; done < len; done += n) {
		n = len - done < sizeof heard ? len - done : sizeof heard;
		memcpy(heard, bytes + done, n);
		if (rates_differ(sim))
			garble(sim, heard, n);
		listen_to(sim, heard, n, t_ns);
	}
}

static void device_advance(void *ctx, int64_t t_ns)
{
	struct lms *sim = ctx;
	sim->now_ns = t_ns;
	turn_mirror(sim, t_ns);
}

/* What waits for the last byte of a reply happens when it has left. */
static void after_replies(struct lms *sim)
{
	if (sim->next_baud != 0)
		set_baud(sim, sim->next_baud);
	sim->next_baud = 0;
	if (sim->resetting)
		power_cycle(sim);
}

static size_t device_transmit(void *ctx, uint8_t *buf, size_t cap)
{
	struct lms *sim = ctx;
	const bool spoil = rates_differ(sim);
	const size_t n = sim_line_take(&sim->line, buf, cap, sim->now_ns, spoil);
	if (n > 0 && spoil) {
		garble(sim, buf, n);
		sim->spoiled = true;
	}
	if (sim_line_idle(&sim->line))
		after_replies(sim);
	return n;
}

static int64_t device_deadline(void *ctx)
{
	struct lms *sim = ctx;
	const int64_t line_ns = sim_line_deadline(&sim->line, sim->now_ns);
	int64_t mirror_ns = INT64_MAX;
	if (wants_scan(sim))
		mirror_ns = sim->measuring             ? last_beam_ns(sim)
		            : sim->scene.ready != NULL ? sim->now_ns + ASK_NS
		                                       : turn_from(sim, sim->free_ns);
	return line_ns < mirror_ns ? line_ns : mirror_ns;
}

/* A line without its reader: what is on it is lost, the scanner goes on. */
static void device_connected(void *ctx, bool yes, int64_t t_ns)
{
	struct lms *sim = ctx;
	sim->now_ns = t_ns;
	if (yes)
		sim->counts.reconnects++;
	else
		sim_line_clear(&sim->line);
	framer_restart(&sim->framer);
}

static void device_host_baud(void *ctx, uint32_t baud)
{
	((struct lms *)ctx)->host_baud = baud;
}

static bool device_awaits(const void *ctx)
{
	const struct lms *sim = ctx;
	return sim->awaited && sim_line_idle(&sim->line);
}

static void device_taken(void *ctx, int64_t t_ns)
{
	struct lms *sim = ctx;
	sim->awaited = false;
	if (sim->spoiled && sim->scene.lost != NULL)
		sim->scene.lost(sim->scene.ctx, t_ns);
	else
		sim->scene.taken(sim->scene.ctx, t_ns);
}

static void set_drift(struct lms *sim, double ppm)
{
	sim->turn0_ns = turn_from(sim, sim->now_ns);
	sim->turns3_ns = 40000000 - (int64_t)(40.0 * ppm);
}

static void set_power(struct lms *sim, bool on)
{
	if (!on)
		power_up(sim);
	sim->off = !on;
	if (on)
		power_cycle(sim);
}

/* Settings are taken on at once, and stay. False: `kind` is none. */
static bool set(struct lms *sim, enum fault kind, double value)
{
	uint8_t *config = sim->config;
	switch (kind) {
	case BAUD:
		set_baud(sim, value > 0 ? (uint32_t)value : 38400);
		return true;
	case PERMANENT_BAUD:
		sim->power_on_baud = value > 0 ? (uint32_t)value : sim->baud;
		return true;
	case STREAMING:
	case PARTS:
		begin_stream(sim, kind == PARTS ? LMS2XX_MODE_PARTS : LMS2XX_MODE_STREAM);
		return true;
	case MODE:
		config[LMS2XX_CONFIG_MODE] = (uint8_t)value;
		return true;
	case CM:
	case MM:
		config[LMS2XX_CONFIG_UNIT] = kind == CM ? LMS2XX_CM : LMS2XX_MM;
		return true;
	case INDICES:
		config[LMS2XX_CONFIG_AVAILABILITY] |= LMS2XX_AVAILABILITY_INDICES;
		return true;
	case NO_INDICES:
		config[LMS2XX_CONFIG_AVAILABILITY] &= (uint8_t)~LMS2XX_AVAILABILITY_INDICES;
		return true;
	default:
		return false;
	}
}

static bool device_fault(void *ctx, const struct sim_fault *fault, bool on, int64_t t_ns)
{
	struct lms *sim = ctx;
	sim->now_ns = t_ns;
	if (sim_line_order(&sim->line, fault, on, t_ns))
		return true;
	const int i = sim_fault_index(kinds, fault->kind);
	if (i < 0)
		return false;
	if (i == POWER) {
		set_power(sim, !on);
		if (on && fault->for_ns == 0)
			set_power(sim, true);
	} else if (i == DRIFT) {
		set_drift(sim, !on ? 0 : fault->value != 0 ? fault->value : 200);
	} else if (!on || !set(sim, (enum fault)i, fault->value)) {
		sim_fault_set(&sim->fault[i - SIM_LINE_FAULTS], fault, on);
	}
	return true;
}

static void device_counts(const void *ctx, struct sim_counts *ret)
{
	const struct lms *sim = ctx;
	*ret = sim->counts;
	ret->sent = sim->line.counts.sent;
	ret->corrupted = sim->line.counts.corrupted;
	ret->dropped += sim->line.counts.dropped;
	ret->garbage = sim->line.counts.garbage;
}

static void device_destroy(void *ctx)
{
	struct lms *sim = ctx;
	sim_line_finish(&sim->line);
	free(sim);
}

static const struct sim_device device = {.receive = device_receive,
                                         .advance = device_advance,
                                         .transmit = device_transmit,
                                         .deadline = device_deadline,
                                         .connected = device_connected,
                                         .host_baud = device_host_baud,
                                         .awaits = device_awaits,
                                         .taken = device_taken,
                                         .fault = device_fault,
                                         .fault_kinds = kinds,
                                         .counts = device_counts,
                                         .destroy = device_destroy};

int sim_lms2xx_create(const struct sim_lms2xx_params *params, const struct scene *scene, int64_t t_ns,
                      struct sim_device *ret)
{
	static const uint8_t factory[LMS2XX_CONFIG_MAX] = {0, 0, 70, 0, 0, 0, 0, 0, 0, 2, 2, 2, 0, 10, 10, 80, 100};
	struct lms *sim = calloc(1, sizeof *sim);
	if (sim == NULL || sim_line_init(&sim->line, QUEUE, 1) < 0) {
		free(sim);
		return -ENOMEM;
	}
	sim->fast = params->fast;
	sim->power_on_baud = params->baud != 0 ? params->baud : 9600;
	sim->scene = *scene;
	sim->now_ns = sim->turn0_ns = t_ns;
	sim->turns3_ns = 40000000;
	memcpy(sim->config, factory, sizeof factory);
	sim->config[LMS2XX_CONFIG_MODE] = (uint8_t)params->mode;
	sim->config[LMS2XX_CONFIG_UNIT] = params->millimetres ? LMS2XX_MM : LMS2XX_CM;
	if (params->indices)
		sim->config[LMS2XX_CONFIG_AVAILABILITY] |= LMS2XX_AVAILABILITY_INDICES;
	power_up(sim);
	*ret = device;
	ret->ctx = sim;
	return 0;
}

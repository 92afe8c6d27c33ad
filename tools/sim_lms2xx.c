/* A simulated LMS2xx on a pseudo-terminal: the device's end of the wire, byte for byte.
 *
 *   host -> pty -> framer -> answer: ACK, reply            (or NAK; or nothing it can read, at another rate)
 *   mirror: turn k begins at turn0 + k * 13.3 ms, always
 *      begin a scan at a turn -> its last beam passes: scene->scan, telegram -> queue -> wire's pace -> pty -> host
 *
 * A pseudo-terminal has no rate. This end reads what the host has set (from the master, at every read and before every
 * chunk it writes) and garbles the bytes when that is not the scanner's rate. The pace of the wire is kept by time: so many bytes
 * may have left by now. A slow host is not forgiven by a UART, but it is by the kernel's buffer: bytes wait here then,
 * and scans that end while the wire is busy are skipped, as the scanner does.
 *
 * The slave is held open here too. So the line outlives its reader (who may close and open it again), it stays raw, and
 * polling it tells whether the reader has taken everything.
 *
 * A paced scene that became ready at t must be ready, too, at the time to which its reader dates the profile. The reader may
 * err by a turn of the mirror (arrivals tell it the mirror's phase, and a busy host delays them all), and without the
 * wire's pace by the transfer it still reckons with: the profile begins at the first turn after t and both of these. */
#include "tools/simulator.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <termios.h>
#include <unistd.h>

#include "core/trig.h"
#include "drivers/lms2xx_wire.h"
#include "drivers/serial.h"

enum { STATUS_OK = 0x10, QUEUE = 8192, STALE_NS = 20000000, TICK_MS = 1 };

struct sim_lms2xx {
	uv_poll_t poll;
	uv_timer_t timer;
	int open_handles;
	int master, slave;
	char slave_path[64];
	char *link;
	bool fast;
	uint32_t power_on_baud;
	struct scene scene;

	/* the device */
	uint32_t baud;
	uint32_t next_baud; /* taken on when the queue is empty; 0: none */
	uint8_t mode;       /* enum lms2xx_mode */
	int fov_deg, resolution_cdeg;
	uint8_t config[LMS2XX_CONFIG_MAX];
	uint8_t scan_index, telegram_index, part;
	struct framer framer;
	uint8_t heard[4096];
	int64_t heard_ns;

	/* the mirror */
	int64_t turn0_ns;
	bool once; /* one scan was asked for */
	bool measuring;
	int64_t begin_ns; /* of the scan being measured */
	int64_t free_ns;  /* the next scan begins at the first turn from here on */
	int64_t ready_ns; /* the paced scene is ready since then; 0: it is not */
	struct profile profile;

	/* the wire */
	uint8_t queue[QUEUE];
	size_t len, sent;
	int64_t wire_end_ns; /* when its last byte has left at the wire's pace */
	uint8_t garble;
	bool awaited; /* a profile is on its way to the reader */
	bool spoiled; /* and some of it went out at a rate that the reader does not have */
};

/* The wire */

static int64_t transfer_ns(const struct sim_lms2xx *sim, size_t bytes)
{
	return (int64_t)bytes * 10 * 1000000000 / sim->baud;
}

static bool rates_differ(const struct sim_lms2xx *sim)
{
	uint32_t host = 0;
	return serial_get_rate(sim->master, &host) < 0 || host != sim->baud;
}

/* What the other rate makes of the bytes: never the same ones twice. */
static void garble(struct sim_lms2xx *sim, uint8_t *bytes, size_t len)
{
	for (size_t i = 0; i < len; i++)
		bytes[i] = (uint8_t)((bytes[i] ^ 0xA5) * 3 + (sim->garble += 29));
}

/* Full: the bytes are lost; a reader that stopped reading asks again. */
static void enqueue(struct sim_lms2xx *sim, const uint8_t *bytes, size_t len, int64_t from_ns)
{
	if (sim->len + len > sizeof sim->queue)
		return;
	memcpy(sim->queue + sim->len, bytes, len);
	sim->len += len;
	const int64_t begin_ns = sim->wire_end_ns > from_ns ? sim->wire_end_ns : from_ns;
	sim->wire_end_ns = sim->fast ? from_ns : begin_ns + transfer_ns(sim, len);
	if (!uv_is_active((uv_handle_t *)&sim->timer))
		uv_timer_again(&sim->timer);
}

static void pump(struct sim_lms2xx *sim, int64_t now_ns)
{
	size_t due = sim->len;
	if (sim->wire_end_ns > now_ns) {
		const size_t ahead = (size_t)((sim->wire_end_ns - now_ns) * sim->baud / 10 / 1000000000) + 1;
		due = ahead < sim->len ? sim->len - ahead : 0;
	}
	if (due > sim->sent) {
		uint8_t chunk[QUEUE];
		const size_t n = due - sim->sent;
		memcpy(chunk, sim->queue + sim->sent, n);
		if (rates_differ(sim)) {
			garble(sim, chunk, n);
			sim->spoiled = true;
		}
		const ssize_t wrote = write(sim->master, chunk, n);
		if (wrote > 0)
			sim->sent += (size_t)wrote;
	}
	if (sim->sent == sim->len) {
		sim->sent = sim->len = 0;
		if (sim->next_baud != 0)
			sim->baud = sim->next_baud;
		sim->next_baud = 0;
	}
}

/* poll waits for the kernel's thread that passes the bytes on (which a busy machine starves for seconds); FIONREAD does not, and
 * sees nothing directly after a write. */
static void watch_reader(struct sim_lms2xx *sim, int64_t now_ns)
{
	struct pollfd line = {.fd = sim->slave, .events = POLLIN};
	if (!sim->awaited || sim->len > 0 || poll(&line, 1, 0) != 0)
		return;
	sim->awaited = false;
	if (sim->spoiled && sim->scene.lost != NULL)
		sim->scene.lost(sim->scene.ctx, now_ns);
	else
		sim->scene.taken(sim->scene.ctx, now_ns);
}

/* The mirror: 75 turns a second are one in 40/3 ms. */

static int64_t turn_from(const struct sim_lms2xx *sim, int64_t t_ns)
{
	const int64_t since = t_ns > sim->turn0_ns ? t_ns - sim->turn0_ns : 0;
	const int64_t k = (since * 3 + 39999999) / 40000000;
	return sim->turn0_ns + k * 40000000 / 3;
}

static int turns(const struct sim_lms2xx *sim)
{
	return sim->mode == LMS2XX_MODE_PARTS ? 1 : 100 / sim->resolution_cdeg;
}

/* From the begin of the first turn to the last beam: a narrower fan stands in the middle of the half turn. */
static int64_t last_beam_ns(const struct sim_lms2xx *sim)
{
	const int last_deg = 90 + sim->fov_deg / 2;
	return sim->begin_ns + (turns(sim) - 1) * (int64_t)LMS2XX_TURN_NS + last_deg * LMS2XX_BEAM_NS;
}

static void fill_raster(struct sim_lms2xx *sim)
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

static size_t encode_profile(const struct sim_lms2xx *sim, uint8_t *ret)
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
	return lms2xx_encode_scan(&scan, ret);
}

/* The last beam has passed. While the wire is busy the scan is skipped; a paced scene never outruns it. */
static void end_scan(struct sim_lms2xx *sim)
{
	uint8_t telegram[LMS2XX_TELEGRAM_MAX];
	const int64_t end_ns = last_beam_ns(sim);
	sim->measuring = false;
	sim->free_ns = sim->begin_ns + turns(sim) * (int64_t)LMS2XX_TURN_NS - LMS2XX_TURN_NS / 2;
	sim->scan_index++;
	if (sim->scene.ready == NULL && !sim->once && (sim->len > 0 || sim->wire_end_ns > end_ns))
		return;
	sim->once = false;
	fill_raster(sim);
	sim->scene.scan(sim->scene.ctx, &sim->profile);
	const size_t len = encode_profile(sim, telegram);
	sim->telegram_index++;
	sim->part = (sim->part + 1) & 3;
	enqueue(sim, telegram, len, end_ns);
	sim->awaited = sim->scene.taken != NULL;
	sim->spoiled = false;
}

static bool wants_scan(const struct sim_lms2xx *sim)
{
	return sim->once || sim->mode == LMS2XX_MODE_STREAM || sim->mode == LMS2XX_MODE_PARTS;
}

/* Earliest time at which the next scan may begin; INT64_MAX: not known yet. */
static int64_t may_begin(struct sim_lms2xx *sim, int64_t now_ns)
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

static void turn_mirror(struct sim_lms2xx *sim, int64_t now_ns)
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

static void reply(struct sim_lms2xx *sim, const uint8_t *payload, size_t len)
{
	uint8_t telegram[LMS2XX_TELEGRAM_MAX];
	const size_t n = lms2xx_encode(0x80, payload, len, telegram);
	enqueue(sim, telegram, n, (int64_t)uv_hrtime());
}

static void reply_rejected(struct sim_lms2xx *sim)
{
	reply(sim, (const uint8_t[]){LMS2XX_REJECTED, STATUS_OK}, 2);
}

static void reply_text(struct sim_lms2xx *sim, uint8_t command, uint8_t status)
{
	static const char text[] = "LMS200;301063;V02.06 ";
	uint8_t p[1 + sizeof text];
	p[0] = command;
	memcpy(p + 1, text, sizeof text - 1);
	p[sizeof text] = status;
	reply(sim, p, sizeof p);
}

static void reply_status(struct sim_lms2xx *sim)
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

static void reply_config(struct sim_lms2xx *sim, const uint8_t *front, size_t n)
{
	uint8_t p[3 + LMS2XX_CONFIG_MAX];
	memcpy(p, front, n);
	memcpy(p + n, sim->config, sizeof sim->config);
	p[n + sizeof sim->config] = STATUS_OK;
	reply(sim, p, n + sizeof sim->config + 1);
}

static void power_up(struct sim_lms2xx *sim)
{
	sim->baud = sim->power_on_baud;
	sim->next_baud = 0;
	sim->mode = LMS2XX_MODE_IDLE;
	sim->fov_deg = 180;
	sim->resolution_cdeg = 50;
	sim->scan_index = sim->telegram_index = sim->part = 0;
	sim->once = sim->measuring = sim->awaited = false;
	sim->ready_ns = 0;
	sim->len = sim->sent = 0;
	sim->wire_end_ns = 0;
	framer_init(&sim->framer, lms2xx_scan_host, NULL, sim->heard, sizeof sim->heard);
}

static void begin_stream(struct sim_lms2xx *sim, uint8_t mode)
{
	sim->mode = mode;
	sim->measuring = false;
	sim->ready_ns = 0;
	sim->free_ns = (int64_t)uv_hrtime();
	uv_timer_again(&sim->timer);
}

static void change_mode(struct sim_lms2xx *sim, const uint8_t *p, size_t len)
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

static void change_variant(struct sim_lms2xx *sim, const uint8_t *p, size_t len)
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

static void change_config(struct sim_lms2xx *sim, const uint8_t *p, size_t len)
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

static void answer(struct sim_lms2xx *sim, const uint8_t *p, size_t len)
{
	enqueue(sim, (const uint8_t[]){LMS2XX_ACK}, 1, (int64_t)uv_hrtime());
	switch (p[0]) {
	case LMS2XX_RESET:
		reply(sim, (const uint8_t[]){LMS2XX_RESET_DONE, STATUS_OK}, 2);
		sim->wire_end_ns = 0;
		pump(sim, (int64_t)uv_hrtime());
		sim_lms2xx_power_cycle(sim);
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
	default:
		reply_rejected(sim);
		break;
	}
}

static void listen_to(struct sim_lms2xx *sim, const uint8_t *bytes, size_t len, int64_t now_ns)
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
		enqueue(sim, (const uint8_t[]){LMS2XX_NAK}, 1, now_ns);
}

/* The loop */

static void on_readable(uv_poll_t *handle, int status, int events)
{
	struct sim_lms2xx *sim = handle->data;
	uint8_t bytes[1024];
	(void)status;
	(void)events;
	const ssize_t n = read(sim->master, bytes, sizeof bytes);
	if (n <= 0)
		return;
	if (rates_differ(sim))
		garble(sim, bytes, (size_t)n);
	listen_to(sim, bytes, (size_t)n, (int64_t)uv_hrtime());
}

static void on_tick(uv_timer_t *handle)
{
	struct sim_lms2xx *sim = handle->data;
	const int64_t now_ns = (int64_t)uv_hrtime();
	pump(sim, now_ns);
	turn_mirror(sim, now_ns);
	pump(sim, now_ns);
	watch_reader(sim, now_ns);
	if (sim->len == 0 && !wants_scan(sim) && !sim->awaited)
		uv_timer_stop(handle);
}

void sim_lms2xx_power_cycle(struct sim_lms2xx *sim)
{
	enum { POWER_ON_STATUS = 0x13 };
	power_up(sim);
	reply_text(sim, LMS2XX_POWER_ON, POWER_ON_STATUS);
}

/* Opening and closing */

static int open_pty(struct sim_lms2xx *sim)
{
	struct termios t;
	sim->master = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
	if (sim->master < 0 || grantpt(sim->master) < 0 || unlockpt(sim->master) < 0)
		return -errno;
	if (ptsname_r(sim->master, sim->slave_path, sizeof sim->slave_path) != 0)
		return -errno;
	sim->slave = open(sim->slave_path, O_RDWR | O_NOCTTY | O_CLOEXEC);
	if (sim->slave < 0 || tcgetattr(sim->slave, &t) < 0)
		return -errno;
	cfmakeraw(&t); /* a fresh one echoes */
	return tcsetattr(sim->slave, TCSANOW, &t) < 0 ? -errno : 0;
}

/* What stands at the path is replaced only if it is a link: an earlier simulator that was killed left it. */
static int make_link(const struct sim_lms2xx *sim)
{
	struct stat st;
	if (lstat(sim->link, &st) == 0 && (!S_ISLNK(st.st_mode) || unlink(sim->link) < 0))
		return -EEXIST;
	return symlink(sim->slave_path, sim->link) < 0 ? -errno : 0;
}

static void remove_link(const struct sim_lms2xx *sim)
{
	char target[sizeof sim->slave_path + 1];
	const ssize_t n = readlink(sim->link, target, sizeof target);
	if (n == (ssize_t)strlen(sim->slave_path) && memcmp(target, sim->slave_path, (size_t)n) == 0)
		unlink(sim->link);
}

static void set_up(struct sim_lms2xx *sim, const struct sim_lms2xx_params *params, const struct scene *scene)
{
	static const uint8_t factory[LMS2XX_CONFIG_MAX] = {0, 0, 70, 0, 0, 0, 0, 0, 0, 2, 2, 2, 0, 10, 10, 80, 100};
	sim->fast = params->fast;
	sim->power_on_baud = params->baud != 0 ? params->baud : 9600;
	sim->scene = *scene;
	sim->turn0_ns = (int64_t)uv_hrtime();
	memcpy(sim->config, factory, sizeof factory);
	sim->config[LMS2XX_CONFIG_MODE] = (uint8_t)params->mode;
	sim->config[LMS2XX_CONFIG_UNIT] = params->millimetres ? LMS2XX_MM : LMS2XX_CM;
	power_up(sim);
}

static void free_unopened(struct sim_lms2xx *sim)
{
	if (sim->slave >= 0)
		close(sim->slave);
	if (sim->master >= 0)
		close(sim->master);
	free(sim->link);
	free(sim);
}

struct sim_lms2xx *sim_lms2xx_create(uv_loop_t *loop, const struct sim_lms2xx_params *params, const struct scene *scene,
                                     char error[160])
{
	struct sim_lms2xx *sim = calloc(1, sizeof *sim);
	if (sim == NULL || (sim->link = strdup(params->link)) == NULL) {
		free(sim);
		snprintf(error, 160, "out of memory");
		return NULL;
	}
	sim->master = sim->slave = -1;
	int r = open_pty(sim);
	if (r < 0) {
		snprintf(error, 160, "cannot make a pseudo-terminal (%s); is /dev/pts mounted?", strerror(-r));
		goto fail;
	}
	r = make_link(sim);
	if (r < 0) {
		snprintf(error, 160, "%.64s: cannot make the link to the simulated line (%s); choose another directory",
		         sim->link, strerror(-r));
		goto fail;
	}
	set_up(sim, params, scene);
	r = uv_poll_init(loop, &sim->poll, sim->master);
	if (r < 0) {
		snprintf(error, 160, "cannot watch the simulated line (%s)", uv_strerror(r));
		remove_link(sim);
		goto fail;
	}
	uv_timer_init(loop, &sim->timer);
	sim->open_handles = 2;
	sim->timer.data = sim->poll.data = sim;
	uv_timer_start(&sim->timer, on_tick, TICK_MS, TICK_MS);
	uv_poll_start(&sim->poll, UV_READABLE, on_readable);
	return sim;
fail:
	free_unopened(sim);
	return NULL;
}

static void on_closed(uv_handle_t *handle)
{
	struct sim_lms2xx *sim = handle->data;
	if (--sim->open_handles > 0)
		return;
	free(sim->link);
	free(sim);
}

void sim_lms2xx_destroy(struct sim_lms2xx *sim)
{
	uv_poll_stop(&sim->poll);
	uv_close((uv_handle_t *)&sim->poll, on_closed);
	uv_close((uv_handle_t *)&sim->timer, on_closed);
	remove_link(sim);
	close(sim->slave);
	close(sim->master);
}

/* Models, mirror, clock and telegrams of the simulated CoLa scanners.
 *
 *   |begin ... beams ... end|        mirror's turn          |begin ...
 *   first                last  stamp + delay: sent
 *
 * TiM and LMS1xx stamp the end of a scan and send some ms later; LMS5xx stamp the begin and send a turn later (measured
 * on captures). The stamp belongs to the first or the last beam that is sent. Steps are said rounded to 1/10000 degree
 * (0.3333), but the beams really stand at thirds, as in the devices: 811 of them cover 270 degrees. */
#include <math.h>
#include <string.h>

#include "core/trig.h"
#include "tools/sim_cola.h"

#define LATENCY_NS 80000 /* from the stamp of transmission to the reader */

static const struct cola_model models[SIM_COLA_MODELS] = {
    [SIM_TIM561] = {.name = "TiM561",
                    .version = "V2.51-21.08.15",
                    .driver = "tim",
                    .serial = 15050157,
                    .wire_version = 1,
                    .dialect = COLA_A,
                    .ranging = true,
                    .small = true,
                    .hash = 0xF4724744,
                    .frequency_chz = 1500,
                    .step_tdeg = 3333,
                    .measurement_hhz = 0x12,
                    .start_tdeg = -450000,
                    .stop_tdeg = 2250000,
                    .range = {1, 3333, (uint32_t)-450000, 2250000},
                    .stamps_end = true,
                    .transmit_us = 4352,
                    .boot_ns = 10000000000},
    [SIM_TIM571] = {.name = "TiM571",
                    .version = "V2.60-20.01.17",
                    .driver = "tim",
                    .serial = 17461662,
                    .wire_version = 1,
                    .dialect = COLA_A,
                    .ranging = true,
                    .small = true,
                    .hash = 0xF4724744,
                    .frequency_chz = 1500,
                    .step_tdeg = 3333,
                    .measurement_hhz = 0xA2,
                    .start_tdeg = -450000,
                    .stop_tdeg = 2250000,
                    .range = {1, 3333, (uint32_t)-450000, 2250000},
                    .stamps_end = true,
                    .transmit_us = 7079,
                    .boot_ns = 10000000000},
    [SIM_TIM310] = {.name = "TiM310-1030000",
                    .version = "V2.50-16.02.15",
                    .driver = "tim",
                    .serial = 13110045,
                    .wire_version = 1,
                    .dialect = COLA_A,
                    .small = true,
                    .hash = 0xF4724744,
                    .frequency_chz = 1500,
                    .step_tdeg = 10000,
                    .measurement_hhz = 0x36,
                    .start_tdeg = -450000,
                    .stop_tdeg = 2250000,
                    .range = {1, 10000, (uint32_t)-450000, 2250000},
                    .stamps_end = true,
                    .transmit_us = 3850,
                    .boot_ns = 10000000000},
    [SIM_TIM781S] = {.name = "TiM781S",
                     .version = "V1.10-05.12.19",
                     .driver = "tim",
                     .serial = 20140034,
                     .wire_version = 1,
                     .dialect = COLA_B,
                     .monitored = true,
                     .ranging = true,
                     .small = true,
                     .hash = 0x6FD62C05,
                     .frequency_chz = 1500,
                     .step_tdeg = 3333,
                     .measurement_hhz = 0xA2,
                     .start_tdeg = -450000,
                     .stop_tdeg = 2250000,
                     .range = {1, 3333, 0xFFF92230, 0x225510},
                     .stamps_end = true,
                     .transmit_us = 6900,
                     .boot_ns = 10000000000},
    [SIM_LMS111] = {.name = "LMS10x_FieldEval",
                    .version = "V1.80.2  ",
                    .driver = "lms1xx",
                    .serial = 18090362,
                    .wire_version = 1,
                    .dialect = COLA_B,
                    .ranging = true,
                    .lms = true,
                    .hash = 0xF4724744,
                    .frequency_chz = 5000,
                    .step_tdeg = 5000,
                    .measurement_hhz = 0x168,
                    .start_tdeg = -450000,
                    .stop_tdeg = 2250000,
                    .range = {1, 5000, 0xFFF92233, 0x22550D},
                    .stamps_end = true,
                    .transmit_us = 3170,
                    .boot_ns = 20000000000},
    [SIM_LMS511] = {.name = "LMS511-10100",
                    .version = "V1.80    ",
                    .driver = "lms5xx",
                    .serial = 18110550,
                    .wire_version = 0,
                    .dialect = COLA_B,
                    .ranging = true,
                    .lms = true,
                    .hash = 0xF4724744,
                    .frequency_chz = 2500,
                    .step_tdeg = 1667,
                    .measurement_hhz = 0x21C,
                    .start_tdeg = -50000,
                    .stop_tdeg = 1850000,
                    .range = {1, 1667, 0xFFFF3CB0, 0x1C3A90},
                    .boot_ns = 20000000000},
};

const struct cola_model *sim_cola_model(enum sim_cola_model_id id)
{
	return &models[id];
}

const char *sim_cola_model_name(enum sim_cola_model_id id)
{
	return models[id].name;
}

const char *sim_cola_model_driver(enum sim_cola_model_id id)
{
	return models[id].driver;
}

/* The clock */

static double clock_at(const struct cola *d, int64_t t_ns)
{
	return d->anchor_us + (double)(t_ns - d->anchor_ns) / 1000.0 * (1.0 + d->drift);
}

uint32_t sim_cola_clock_us(const struct cola *d, int64_t t_ns)
{
	return (uint32_t)(int64_t)floor(clock_at(d, t_ns));
}

void sim_cola_set_clock(struct cola *d, double us, double drift_ppm)
{
	d->anchor_us = us;
	d->anchor_ns = d->now_ns;
	d->drift = drift_ppm * 1e-6;
}

/* The mirror */

/* Thirds and sixths of a degree are said with four digits. */
static double true_step_deg(uint32_t step_tdeg)
{
	static const int parts[] = {3, 6};
	for (int i = 0; i < 2; i++)
		for (int k = 1; k < parts[i]; k++)
			if (fabs((double)step_tdeg - 10000.0 * k / parts[i]) < 0.51)
				return (double)k / parts[i];
	return step_tdeg / 10000.0;
}

struct fan { /* what is sent of a turn */
	double step_deg;
	int first, n;   /* beams of the full raster */
	double beam_ns; /* between beams */
	int64_t first_ns, last_ns, stamp_ns, transmit_ns;
};

/* A limit that lies beside its beam by the rounding of the firmware still means that beam. */
static int beam_near(const struct cola *d, double step_deg, uint32_t limit_tdeg, bool up)
{
	const double at = ((double)(int32_t)limit_tdeg - d->model->start_tdeg) / 10000.0 / step_deg;
	return (int)(up ? ceil(at - 0.05) : floor(at + 0.05));
}

static struct fan fan_of(const struct cola *d)
{
	const struct cola_model *m = d->model;
	struct fan fan = {.step_deg = true_step_deg(d->value[SCAN_CONFIG][SCAN_STEP])};
	const int all = (int)floor((m->stop_tdeg - m->start_tdeg) / 10000.0 / fan.step_deg + 0.05) + 1;
	const int first = beam_near(d, fan.step_deg, d->value[OUTPUT_RANGE][RANGE_START], true);
	const int last = beam_near(d, fan.step_deg, d->value[OUTPUT_RANGE][RANGE_STOP], false);
	fan.first = first > 0 ? first : 0;
	fan.n = (last < all ? last + 1 : all) - fan.first;
	if (fan.n < 0)
		fan.n = 0;
	fan.beam_ns = (double)d->turn_ns * fan.step_deg / 360.0;
	fan.first_ns = d->begin_ns + (int64_t)(fan.first * fan.beam_ns);
	fan.last_ns = fan.first_ns + (int64_t)((fan.n - 1) * fan.beam_ns);
	fan.stamp_ns = m->stamps_end ? fan.last_ns : fan.first_ns;
	fan.transmit_ns = fan.stamp_ns + (m->transmit_us > 0 ? m->transmit_us * 1000ll : d->turn_ns + d->turn_ns / 60);
	return fan;
}

static int64_t next_turn_ns(struct cola *d)
{
	const struct sim_fault_state *wander = cola_fault(d, SIM_COLA_WANDER);
	const double turn_ns = 1e11 / d->value[SCAN_CONFIG][SCAN_FREQUENCY] / (1.0 + d->drift);
	if (!wander->on)
		return (int64_t)turn_ns;
	return (int64_t)(turn_ns + (2.0 * sim_random(&d->random) - 1.0) * sim_fault_value(wander, 2.4) * 1e6);
}

void sim_cola_start_mirror(struct cola *d)
{
	d->begin_ns = d->now_ns > d->ready_ns ? d->now_ns : d->ready_ns;
	d->turn_ns = next_turn_ns(d);
}

int64_t sim_cola_next(const struct cola *d)
{
	if (d->off || !d->measuring)
		return INT64_MAX;
	return fan_of(d).transmit_ns + LATENCY_NS;
}

/* Telegrams */

struct body { /* of one scan: what its telegram says, in whichever dialect */
	struct cola *d;
	const struct fan *fan;
	struct cola_writer w;
};

static void write_counters(struct body *b)
{
	struct cola *d = b->d;
	cola_write_u(&b->w, d->model->wire_version, 2);
	cola_write_u(&b->w, 1, 2);
	cola_write_u(&b->w, d->params.serial, 4);
	cola_write_u(&b->w, 0, 1);
	cola_write_u(&b->w, cola_fault(d, SIM_COLA_ERROR_STATE)->on, 1);
	cola_write_u(&b->w, d->telegram_counter, 2);
	cola_write_u(&b->w, d->scan_counter, 2);
	cola_write_u(&b->w, sim_cola_clock_us(d, b->fan->stamp_ns), 4);
	cola_write_u(&b->w, sim_cola_clock_us(d, b->fan->transmit_ns), 4);
	for (int i = 0; i < 4; i++) /* inputs, outputs */
		cola_write_u(&b->w, i == 2 && !d->model->lms, 1);
	cola_write_u(&b->w, 0, 2);
	cola_write_u(&b->w, d->value[SCAN_CONFIG][SCAN_FREQUENCY], 4);
	cola_write_u(&b->w, d->model->measurement_hhz, 4);
}

static void write_encoders(struct body *b)
{
	struct cola *d = b->d;
	const struct sim_fault_state *more = cola_fault(d, SIM_COLA_ENCODERS);
	const bool asked = d->value[DATA_CONFIG][CONFIG_ENCODER] != 0 && d->params.angle != NULL;
	const int n = more->on ? (int)sim_fault_value(more, 2.0) : asked;
	const double angle_rad = d->params.angle ? d->params.angle(d->params.ctx, b->fan->stamp_ns) : 0.0;
	cola_write_u(&b->w, (uint32_t)n, 2);
	for (int i = 0; i < n; i++) {
		cola_write_u(&b->w, (uint32_t)(int32_t)rint(angle_rad * d->params.ticks_per_rad) + (uint32_t)i * 1000,
		             4);
		cola_write_u(&b->w, 0, 2);
	}
}

static void write_channel_head(struct body *b, const char *name, double scale)
{
	const int32_t start_tdeg = b->d->model->start_tdeg + (int32_t)rint(b->fan->first * b->fan->step_deg * 10000.0);
	cola_write_chars(&b->w, name, 5);
	cola_write_float(&b->w, (float)scale);
	cola_write_float(&b->w, 0.0f);
	cola_write_i(&b->w, start_tdeg, 4);
	cola_write_u(&b->w, b->d->value[SCAN_CONFIG][SCAN_STEP], 2);
	cola_write_u(&b->w, (uint32_t)b->fan->n, 2);
}

static uint32_t range_word(struct cola *d, int k, double scale)
{
	const struct profile *p = &d->profile;
	if (cola_fault(d, SIM_COLA_CODES)->on && k % 8 == 0)
		return d->model->small ? (uint32_t)k / 8 % 16 : 0;
	if (p->state[k] != BEAM_OK)
		return !d->model->small ? 0 : p->state[k] == BEAM_DAZZLED ? 1 : 2;
	const double raw = rint((double)p->range_m[k] * 1000.0 / scale);
	return raw > 65535.0 ? 0 : (uint32_t)raw;
}

/* The nearer, the brighter. */
static uint32_t remission(const struct cola *d, int k, int bytes)
{
	const struct profile *p = &d->profile;
	if (p->state[k] != BEAM_OK)
		return 0;
	const double bright = 1.0 / (1.0 + (double)p->range_m[k] * 0.2);
	return (uint32_t)(bright * (bytes == 1 ? 254.0 : 65280.0));
}

static void write_ranges(struct body *b, int echo)
{
	const struct sim_fault_state *fault = cola_fault(b->d, SIM_COLA_SCALE);
	const double scale = fault->on ? sim_fault_value(fault, 2.0) : 1.0;
	const char name[] = {'D', 'I', 'S', 'T', (char)('0' + echo), '\0'};
	write_channel_head(b, name, scale);
	for (int k = 0; k < b->fan->n; k++)
		cola_write_u(&b->w, echo == 1 ? range_word(b->d, k, scale) : 0, 2);
}

static void write_remission(struct body *b, int echo, int bytes)
{
	const char name[] = {'R', 'S', 'S', 'I', (char)('0' + echo), '\0'};
	write_channel_head(b, name, 1.0);
	for (int k = 0; k < b->fan->n; k++)
		cola_write_u(&b->w, echo == 1 ? remission(b->d, k, bytes) : 0, bytes);
}

static void write_channels(struct body *b)
{
	struct cola *d = b->d;
	const struct sim_fault_state *more = cola_fault(d, SIM_COLA_ECHOES);
	const int echoes = more->on ? (int)sim_fault_value(more, 5.0) : 1;
	const bool rssi = d->value[DATA_CONFIG][CONFIG_REMISSION], wide = d->value[DATA_CONFIG][CONFIG_WIDE];
	const bool angles = cola_fault(d, SIM_COLA_ANGLES)->on;
	cola_write_u(&b->w, (uint32_t)(echoes * (1 + (rssi && wide)) + angles), 2);
	for (int i = 1; i <= echoes; i++)
		write_ranges(b, i);
	for (int i = 1; i <= echoes && rssi && wide; i++)
		write_remission(b, i, 2);
	if (angles) {
		write_channel_head(b, "ANGL1", 1.0);
		for (int k = 0; k < b->fan->n; k++)
			cola_write_u(&b->w, 0, 2);
	}
	cola_write_u(&b->w, (uint32_t)(rssi && !wide ? echoes : 0), 2);
	for (int i = 1; i <= echoes && rssi && !wide; i++)
		write_remission(b, i, 1);
}

static void write_text(struct body *b, bool there, const char *text)
{
	cola_write_u(&b->w, there, 2);
	if (there)
		cola_write_string(&b->w, text, strlen(text), 1);
}

/* The clock that nobody set: it began with 1970 when power came. */
static void write_time(struct body *b)
{
	const uint64_t us = (uint64_t)((b->fan->transmit_ns - b->d->on_ns) / 1000), s = us / 1000000;
	cola_write_u(&b->w, 1970, 2);
	cola_write_u(&b->w, 1, 1);
	cola_write_u(&b->w, 1 + (uint32_t)(s / 86400) % 31, 1);
	cola_write_u(&b->w, (uint32_t)(s / 3600 % 24), 1);
	cola_write_u(&b->w, (uint32_t)(s / 60 % 60), 1);
	cola_write_u(&b->w, (uint32_t)(s % 60), 1);
	cola_write_u(&b->w, (uint32_t)(us % 1000000), 4);
}

static void write_tail(struct body *b)
{
	struct cola *d = b->d;
	const uint32_t *config = d->value[DATA_CONFIG];
	const bool position = config[CONFIG_POSITION] || cola_fault(d, SIM_COLA_POSITION)->on;
	const bool empty = cola_fault(d, SIM_COLA_NAME_EMPTY)->on, blanks = cola_fault(d, SIM_COLA_NAME_BLANKS)->on;
	const bool comment = config[CONFIG_COMMENT] || cola_fault(d, SIM_COLA_COMMENT)->on;
	const bool time = config[CONFIG_TIME] || cola_fault(d, SIM_COLA_TIME)->on;
	const bool event = cola_fault(d, SIM_COLA_EVENT)->on;
	cola_write_u(&b->w, position, 2);
	for (int i = 0; position && i < 6; i++)
		cola_write_float(&b->w, (float)i * 0.5f);
	if (position)
		cola_write_u(&b->w, 1, 1);
	write_text(b, config[CONFIG_NAME] || empty || blanks, empty ? "" : blanks ? " a name  0 1 " : d->name);
	write_text(b, comment, "no comment");
	cola_write_u(&b->w, time, 2);
	if (time)
		write_time(b);
	cola_write_u(&b->w, event, 2);
	if (event) {
		cola_write_chars(&b->w, "FDIN", 4);
		cola_write_u(&b->w, 0, 4);
		cola_write_u(&b->w, sim_cola_clock_us(d, b->fan->first_ns), 4);
		cola_write_i(&b->w, -10000, 4);
	}
}

static size_t write_telegram(struct cola *d, const struct fan *fan, bool single)
{
	struct body b = {.d = d, .fan = fan};
	const bool monitored = d->model->monitored || cola_fault(d, SIM_COLA_MONITORED)->on;
	cola_writer_init(&b.w, d->dialect, d->telegram, sizeof d->telegram,
	                 single      ? "sRA LMDscandata"
	                 : monitored ? "sSN LMDscandatamon"
	                             : "sSN LMDscandata");
	write_counters(&b);
	write_encoders(&b);
	write_channels(&b);
	write_tail(&b);
	return cola_writer_end(&b.w);
}

static void cast(struct cola *d, const struct fan *fan)
{
	struct profile *p = &d->profile;
	p->t_ns = fan->first_ns;
	p->beam_ns = (int32_t)rint(fan->beam_ns);
	p->turn_ns = (int32_t)d->turn_ns;
	p->interlace = p->parts = 1;
	p->part = 0;
	p->n = (uint16_t)fan->n;
	p->step_rad = fan->step_deg * TRIG_DEG;
	p->first_rad = (d->model->start_tdeg / 10000.0 - 90.0) * TRIG_DEG + fan->first * p->step_rad;
	d->scene.scan(d->scene.ctx, p);
}

static void send_scan(struct cola *d, const struct fan *fan, bool streams)
{
	const int64_t leaves_ns = fan->transmit_ns + LATENCY_NS;
	cast(d, fan);
	size_t len = streams ? write_telegram(d, fan, false) : 0;
	for (int i = 0; i < SIM_COLA_SESSIONS; i++)
		d->session[i].line.text = d->dialect == COLA_A;
	for (int i = 0; len > 0 && i < SIM_COLA_SESSIONS; i++)
		if (d->session[i].used && d->session[i].streaming)
			sim_line_put(&d->session[i].line, d->telegram, len, leaves_ns, true);
	for (int i = 0; i < SIM_COLA_SESSIONS; i++) {
		if (!d->session[i].used || !d->session[i].single)
			continue;
		len = write_telegram(d, fan, true);
		sim_line_put(&d->session[i].line, d->telegram, len, leaves_ns, false);
		d->session[i].single = false;
	}
	d->telegram_counter++;
}

static void measure(struct cola *d)
{
	const struct fan fan = fan_of(d);
	bool streams = false, single = false;
	for (int i = 0; i < SIM_COLA_SESSIONS; i++) {
		streams |= d->session[i].used && d->session[i].streaming;
		single |= d->session[i].used && d->session[i].single;
	}
	d->scan_counter++;
	streams &= d->scan_counter % d->value[DATA_CONFIG][CONFIG_EVERY] == 0;
	d->counts.profiles += streams;
	if (streams || single)
		send_scan(d, &fan, streams);
	d->begin_ns += d->turn_ns;
	d->turn_ns = next_turn_ns(d);
}

void sim_cola_turn(struct cola *d)
{
	while (sim_cola_next(d) <= d->now_ns)
		measure(d);
}

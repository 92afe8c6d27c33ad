/* A Modbus drive as a map of registers, see sim_drive.h.
 *
 * What is written is kept as the registers hold it; after every request the values are taken out of them again and what
 * changed is done. So a 32-bit value that comes in two requests is half of each for a while, as in a real drive. What is
 * read is put together at the time of the request, and nothing latches the halves of a value either.
 *
 * The watchdog trips between requests, when nobody comes any more: the stop is then ordered at the time at which it was
 * due, however late the owner looks, and the axis' past shows it there. */
#include "tools/sim_drive.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"

#define COUNT_RAD       (0.001 * TRIG_DEG)
#define SPEED_DEFAULT   30000 /* 0.001 degree/s */
#define WATCHDOG_MS     300
#define HOMING_NS       INT64_C(200000000)
#define FOLLOWING_RAD   (5.0 * TRIG_DEG)  /* strict: further behind is a fault */
#define FOLLOWING_NS    INT64_C(10000000) /* how often that is looked at while it may be */
#define ERROR_FOLLOWING 0x8611
#define ERROR_DEFAULT   0x4310
#define MS              1e6

enum control { ENABLE = 15, READY = 6, START = 0x10, HOME = 0x20, RESET = 0x80, HALT = 0x100 };

static const char *const kinds[] = {"silence", "lost", "busy",  "late",  "jitter", "wrong unit", "crc",
                                    "drop",    "torn", "fault", "stuck", "slow",   "restart",    NULL};
enum fault { SILENCE, LOST, BUSY, LATE, JITTER, WRONG_UNIT, CRC, DROP, TORN, FAULT, STUCK, SLOW, RESTART, FAULTS };

struct sim_drive {
	struct sim_drive_params params;
	struct sim_axis *axis, own;
	uint16_t held[SIM_DRIVE_REGISTERS]; /* as written; what is only read is not in here */
	int32_t target;                     /* counts, as taken out of them */
	uint32_t speed, acceleration;
	double zero_rad; /* where it counts 0 */
	bool enabled, going, halted, homed;
	int64_t homing_ns; /* done then; INT64_MAX: it is not homing */
	uint16_t error;
	bool watched, unwatched; /* the watchdog was ever written; it has tripped */
	int64_t watchdog_ns;     /* when it will */
	int64_t look_ns;         /* whether it follows is judged again then */
	struct sim_fault_state fault[FAULTS];
	uint64_t random;
};

/* A 32-bit value as two registers, and back: each order is its own inverse. */
static void put32(const struct sim_drive *d, uint32_t v, uint16_t *ret)
{
	uint16_t high = (uint16_t)(v >> 16), low = (uint16_t)v;

	if (d->params.order == SIM_DRIVE_BADC || d->params.order == SIM_DRIVE_DCBA) {
		high = (uint16_t)(high << 8 | high >> 8);
		low = (uint16_t)(low << 8 | low >> 8);
	}
	if (d->params.order == SIM_DRIVE_CDAB || d->params.order == SIM_DRIVE_DCBA) {
		ret[0] = low;
		ret[1] = high;
	} else {
		ret[0] = high;
		ret[1] = low;
	}
}

static uint32_t get32(const struct sim_drive *d, const uint16_t *r)
{
	uint16_t v[2];

	put32(d, (uint32_t)r[0] << 16 | r[1], v);
	return (uint32_t)v[0] << 16 | v[1];
}

static uint32_t bits_of(float f)
{
	uint32_t v;

	memcpy(&v, &f, sizeof v);
	return v;
}

static void put_held(struct sim_drive *d)
{
	put32(d, (uint32_t)d->target, d->held + SIM_DRIVE_TARGET);
	put32(d, d->speed, d->held + SIM_DRIVE_SPEED);
	put32(d, d->acceleration, d->held + SIM_DRIVE_ACCELERATION);
	put32(d, bits_of((float)(d->target * 0.001)), d->held + SIM_DRIVE_TARGET_F32);
}

static double within(double v, double low, double high)
{
	return v < low ? low : v > high ? high : v;
}

static int32_t counts(const struct sim_drive *d, double angle_rad)
{
	return (int32_t)rint(within((angle_rad - d->zero_rad) / COUNT_RAD, INT32_MIN, INT32_MAX));
}

/* As from its power switch; the axis stands where it stands. */
static void boot(struct sim_drive *d, int64_t t_ns)
{
	memset(d->held, 0, sizeof d->held);
	d->zero_rad = d->params.unhomed ? sim_axis_angle(d->axis, t_ns) : 0.0;
	d->target = counts(d, sim_axis_angle(d->axis, t_ns));
	d->speed = SPEED_DEFAULT;
	d->acceleration = (uint32_t)rint(d->params.acceleration / COUNT_RAD);
	d->held[SIM_DRIVE_WATCHDOG_TIME] = WATCHDOG_MS;
	d->enabled = d->going = d->halted = d->watched = d->unwatched = false;
	d->homed = !d->params.unhomed;
	d->homing_ns = INT64_MAX;
	d->error = 0;
	put_held(d);
}

struct sim_drive *sim_drive_create(const struct sim_drive_params *params, int64_t t_ns)
{
	struct sim_drive *d = calloc(1, sizeof *d);

	if (!d)
		return NULL;
	d->params = *params;
	d->axis = params->axis ? params->axis : &d->own;
	if (!params->axis)
		sim_axis_init(&d->own, params->angle_rad, t_ns);
	d->random = params->seed;
	boot(d, t_ns);
	return d;
}

void sim_drive_destroy(struct sim_drive *d)
{
	free(d);
}

struct sim_axis *sim_drive_axis(struct sim_drive *d)
{
	return d->axis;
}

static void stop(struct sim_drive *d, int64_t t_ns)
{
	sim_axis_stop(d->axis, d->acceleration * COUNT_RAD, t_ns);
	d->going = false;
}

static void go(struct sim_drive *d, int64_t t_ns)
{
	d->going = true;
	sim_axis_goto(d->axis, d->zero_rad + d->target * COUNT_RAD, d->speed * COUNT_RAD, d->acceleration * COUNT_RAD,
	              t_ns);
}

static void fail(struct sim_drive *d, uint16_t error, int64_t t_ns)
{
	stop(d, t_ns);
	d->error = error;
	d->enabled = d->halted = false;
}

static double behind(const struct sim_drive *d, int64_t t_ns)
{
	return fabs(sim_axis_demand(d->axis, t_ns) - sim_axis_angle(d->axis, t_ns));
}

void sim_drive_advance(struct sim_drive *d, int64_t t_ns)
{
	if (d->watched && !d->unwatched && t_ns >= d->watchdog_ns) {
		d->unwatched = true;
		d->halted = false;
		stop(d, d->watchdog_ns);
	}
	if (d->homing_ns <= t_ns) {
		d->homing_ns = INT64_MAX;
		d->homed = true;
		d->zero_rad = sim_axis_angle(d->axis, t_ns);
		d->target = 0;
		put_held(d);
	}
	if (d->params.strict && d->going && behind(d, t_ns) > FOLLOWING_RAD)
		fail(d, ERROR_FOLLOWING, t_ns);
	d->look_ns = t_ns + FOLLOWING_NS;
}

int64_t sim_drive_deadline(const struct sim_drive *d)
{
	int64_t deadline = d->homing_ns;

	if (d->watched && !d->unwatched && d->watchdog_ns < deadline)
		deadline = d->watchdog_ns;
	if (d->params.strict && d->going && !sim_axis_follows(d->axis) && d->look_ns < deadline)
		deadline = d->look_ns;
	return deadline;
}

static uint16_t status(const struct sim_drive *d, int64_t t_ns)
{
	bool moving = !sim_axis_arrived(d->axis, t_ns) || sim_axis_speed(d->axis, t_ns) != 0.0;
	double off = sim_axis_angle(d->axis, t_ns) - d->zero_rad - d->target * COUNT_RAD;
	bool enabled = d->enabled || (!d->params.strict && !d->error);

	return (uint16_t)((moving ? SIM_DRIVE_IS_MOVING : 0) |
	                  ((d->held[SIM_DRIVE_CONTROL] & READY) == READY && !d->error ? SIM_DRIVE_IS_READY : 0) |
	                  (enabled ? SIM_DRIVE_IS_ENABLED : 0) | (d->error ? SIM_DRIVE_HAS_FAULT : 0) |
	                  (!moving && fabs(off) <= COUNT_RAD ? SIM_DRIVE_IN_POSITION : 0) |
	                  (d->homed ? SIM_DRIVE_IS_HOMED : 0) | (d->unwatched ? SIM_DRIVE_UNWATCHED : 0));
}

/* The registers as they are at one time. */
static void fill(const struct sim_drive *d, int64_t t_ns, uint16_t *ret)
{
	double at = (sim_axis_angle(d->axis, t_ns) - d->zero_rad) / COUNT_RAD;

	memcpy(ret, d->held, sizeof d->held);
	put32(d, (uint32_t)counts(d, sim_axis_angle(d->axis, t_ns)), ret + SIM_DRIVE_POSITION);
	ret[SIM_DRIVE_POSITION_I16] = (uint16_t)(int16_t)rint(within(at / 10.0, INT16_MIN, INT16_MAX));
	put32(d, bits_of((float)(at * 0.001)), ret + SIM_DRIVE_POSITION_F32);
	put32(d, bits_of((float)(sim_axis_speed(d->axis, t_ns) / TRIG_DEG)), ret + SIM_DRIVE_SPEED_F32);
	ret[SIM_DRIVE_STATUS] = status(d, t_ns);
	ret[SIM_DRIVE_MOVING] = d->params.strict ? ret[SIM_DRIVE_STATUS] : ret[SIM_DRIVE_STATUS] & SIM_DRIVE_IS_MOVING;
	ret[SIM_DRIVE_ERROR] = d->error;
}

int sim_drive_read(struct sim_drive *d, uint16_t address, uint16_t n, int64_t t_ns, uint16_t *ret_values)
{
	uint16_t all[SIM_DRIVE_REGISTERS];
	int64_t lag_ns = 0;

	if (n < 1 || n > MODBUS_WIRE_VALUES_MAX)
		return 3;
	if (address + n > SIM_DRIVE_REGISTERS)
		return 2;
	sim_drive_advance(d, t_ns);
	if (sim_fault_due(&d->fault[TORN]))
		lag_ns = (int64_t)(sim_fault_value(&d->fault[TORN], 2.0) * MS);
	for (int i = 0; i < n; i++) {
		if (i == 0 || lag_ns)
			fill(d, t_ns + i * lag_ns, all);
		ret_values[i] = all[address + i];
	}
	return 0;
}

static bool writable(int address)
{
	return (address >= SIM_DRIVE_TARGET && address < SIM_DRIVE_MOVING) ||
	       (address >= SIM_DRIVE_ACCELERATION && address <= SIM_DRIVE_CONTROL) || address == SIM_DRIVE_WATCHDOG ||
	       address == SIM_DRIVE_WATCHDOG_TIME;
}

static bool touches(uint16_t address, uint16_t n, int reg, int width)
{
	return address < reg + width && address + n > reg;
}

/* The edges and levels of the control word. */
static void control(struct sim_drive *d, uint16_t before, int64_t t_ns)
{
	uint16_t now = d->held[SIM_DRIVE_CONTROL], up = now & (uint16_t)~before;

	if (up & RESET && d->error && !d->fault[FAULT].on)
		d->error = 0;
	if (d->params.strict) {
		if (d->enabled && (now & ENABLE) != ENABLE)
			stop(d, t_ns);
		d->enabled = !d->error && (now & ENABLE) == ENABLE;
	}
	if (now & HALT && d->going) {
		stop(d, t_ns);
		d->halted = true;
	} else if (!(now & HALT) && d->halted) {
		d->halted = false;
		go(d, t_ns);
	}
	if (up & HOME && !d->error && (d->enabled || !d->params.strict) && sim_axis_arrived(d->axis, t_ns))
		d->homing_ns = t_ns + HOMING_NS;
	if (d->params.strict && up & START && d->enabled && !d->unwatched && d->homed && d->homing_ns == INT64_MAX)
		go(d, t_ns);
}

/* A target that came as a float counts as one in counts. 0, or exception 3. */
static int take_float(struct sim_drive *d, uint16_t address, uint16_t n)
{
	uint32_t bits = get32(d, d->held + SIM_DRIVE_TARGET_F32);
	float degrees;

	if (!touches(address, n, SIM_DRIVE_TARGET_F32, 2))
		return 0;
	memcpy(&degrees, &bits, sizeof degrees);
	if (!isfinite(degrees) || fabsf(degrees) > 360000.0f)
		return 3;
	put32(d, (uint32_t)(int32_t)rint(degrees * 1000.0), d->held + SIM_DRIVE_TARGET);
	return 0;
}

/* What was written, done. */
static void act(struct sim_drive *d, uint16_t address, uint16_t n, uint16_t control_before, bool alive, int64_t t_ns)
{
	bool targeted = touches(address, n, SIM_DRIVE_TARGET, 2) || touches(address, n, SIM_DRIVE_TARGET_F32, 2);

	d->target = (int32_t)get32(d, d->held + SIM_DRIVE_TARGET);
	d->speed = get32(d, d->held + SIM_DRIVE_SPEED);
	d->acceleration = get32(d, d->held + SIM_DRIVE_ACCELERATION);
	put_held(d);
	if (alive) {
		d->watched = true;
		d->unwatched = false;
	}
	if (alive || touches(address, n, SIM_DRIVE_WATCHDOG_TIME, 1))
		d->watchdog_ns = t_ns + (int64_t)(d->held[SIM_DRIVE_WATCHDOG_TIME] * MS);
	if (touches(address, n, SIM_DRIVE_CONTROL, 1))
		control(d, control_before, t_ns);
	if (d->params.strict || d->error || d->unwatched || d->held[SIM_DRIVE_CONTROL] & HALT)
		return;
	if (targeted || (d->going && touches(address, n, SIM_DRIVE_SPEED, 2)))
		go(d, t_ns);
}

int sim_drive_write(struct sim_drive *d, uint16_t address, uint16_t n, const uint16_t *values, int64_t t_ns)
{
	uint16_t before[SIM_DRIVE_REGISTERS];
	bool alive = false;

	if (n < 1 || n > 123)
		return 3;
	if (address + n > SIM_DRIVE_REGISTERS)
		return 2;
	for (int i = 0; i < n; i++)
		if (!writable(address + i))
			return 2;
	sim_drive_advance(d, t_ns);
	memcpy(before, d->held, sizeof before);
	memcpy(d->held + address, values, n * sizeof *values);
	if (take_float(d, address, n)) {
		memcpy(d->held, before, sizeof before);
		return 3;
	}
	if (touches(address, n, SIM_DRIVE_WATCHDOG, 1))
		alive = !d->watched || !d->params.toggles || d->held[SIM_DRIVE_WATCHDOG] != before[SIM_DRIVE_WATCHDOG];
	act(d, address, n, before[SIM_DRIVE_CONTROL], alive, t_ns);
	return 0;
}

static int perform(struct sim_drive *d, const struct modbus_transaction *request, int64_t t_ns, uint16_t *ret_values)
{
	switch (request->function) {
	case 3:
	case 4:
		return sim_drive_read(d, request->address, request->n, t_ns, ret_values);
	case 6:
		return sim_drive_write(d, request->address, 1, request->value, t_ns);
	case 16:
		return sim_drive_write(d, request->address, request->n, request->value, t_ns);
	}
	return 1;
}

/* The answer is there and right: what becomes of it. */
static void spoil(struct sim_drive *d, struct sim_drive_answer *answer)
{
	if (d->fault[LOST].on ? sim_random(&d->random) < sim_fault_value(&d->fault[LOST], 1.0)
	                      : sim_fault_due(&d->fault[LOST]))
		answer->verdict = SIM_DRIVE_SILENT;
	else if (sim_fault_due(&d->fault[CRC]))
		answer->verdict = SIM_DRIVE_CORRUPT;
	else if (sim_fault_due(&d->fault[WRONG_UNIT])) {
		answer->verdict = SIM_DRIVE_WRONG_UNIT;
		answer->transaction.unit = (uint8_t)(answer->transaction.unit % 247 + 1);
	}
	if (sim_fault_due(&d->fault[LATE]))
		answer->delay_ns += (int64_t)(sim_fault_value(&d->fault[LATE], 20.0) * MS);
	if (sim_fault_due(&d->fault[JITTER]))
		answer->delay_ns += (int64_t)(sim_fault_value(&d->fault[JITTER], 20.0) * MS * sim_random(&d->random));
}

void sim_drive_transact(struct sim_drive *d, const struct modbus_transaction *request, int64_t t_ns,
                        struct sim_drive_answer *ret)
{
	int exception = 6;

	memset(ret, 0, sizeof *ret);
	sim_drive_advance(d, t_ns);
	ret->verdict = SIM_DRIVE_SILENT;
	if ((request->unit != d->params.unit && request->unit != 0) || d->fault[SILENCE].on ||
	    sim_fault_due(&d->fault[SILENCE]))
		return;
	ret->transaction = *request;
	if (request->function == 6)
		ret->transaction.n = 1;
	if (request->unit == 0) {
		perform(d, request, t_ns, ret->transaction.value);
		return;
	}
	if (sim_fault_due(&d->fault[DROP])) {
		ret->verdict = SIM_DRIVE_DROPPED;
		return;
	}
	ret->verdict = SIM_DRIVE_ANSWERED;
	if (!sim_fault_due(&d->fault[BUSY]))
		exception = perform(d, request, t_ns, ret->transaction.value);
	if (exception) {
		ret->transaction.function |= MODBUS_WIRE_REFUSED;
		ret->transaction.n = 1;
		ret->transaction.value[0] = (uint16_t)exception;
	}
	spoil(d, ret);
}

void sim_drive_place(struct sim_drive *d, double angle_rad, int64_t t_ns)
{
	sim_drive_advance(d, t_ns);
	sim_axis_place(d->axis, angle_rad, t_ns);
	d->going = d->halted = false;
	d->target = counts(d, angle_rad);
	put_held(d);
}

const char *const *sim_drive_fault_kinds(void)
{
	return kinds;
}

bool sim_drive_fault(struct sim_drive *d, const struct sim_fault *fault, bool on, int64_t t_ns)
{
	int i = sim_fault_index(kinds, fault->kind);

	if (i < 0)
		return false;
	sim_drive_advance(d, t_ns);
	sim_fault_set(&d->fault[i], fault, on);
	if (i == FAULT && on)
		fail(d, (uint16_t)sim_fault_value(&d->fault[i], ERROR_DEFAULT), t_ns);
	else if (i == STUCK)
		sim_axis_stuck(d->axis, on, t_ns);
	else if (i == SLOW)
		sim_axis_slow(d->axis, on ? fmin(fmax(sim_fault_value(&d->fault[i], 0.5), 0.01), 1.0) : 1.0, t_ns);
	else if (i == RESTART && on) {
		stop(d, t_ns);
		boot(d, t_ns);
	}
	return true;
}

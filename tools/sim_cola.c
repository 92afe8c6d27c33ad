/* A simulated TiM or LMS, the device's other end (sim_device.h): any number of readers, each with its own session, power,
 * and faults to order. Requests are answered in sim_cola_answers.c, scans made in sim_cola_scan.c. */
#include "tools/sim_cola.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

#define LINE_CAP (256 * 1024) /* of a session: what a scanner can hold back */

static const char *const kinds[] = {SIM_LINE_KINDS, SIM_COLA_KINDS, NULL};
static const struct sim_device end;

static void open_session(struct cola_session *s)
{
	framer_init(&s->framer, cola_scan_frame, NULL, s->heard, sizeof s->heard);
	s->streaming = s->single = false;
	s->level = 0;
	sim_line_clear(&s->line);
}

static void power(struct cola *d, bool on)
{
	d->off = !on;
	for (int i = 0; i < SIM_COLA_SESSIONS; i++)
		if (d->session[i].used)
			open_session(&d->session[i]);
	if (!on)
		return;
	d->on_ns = d->ready_ns = d->now_ns;
	d->measuring = true;
	d->telegram_counter = d->scan_counter = 0;
	d->counts.power_cycles++;
	sim_cola_set_clock(d, 0, d->drift * 1e6);
	sim_cola_start_mirror(d);
}

static void receive(void *ctx, const uint8_t *bytes, size_t len, int64_t t_ns)
{
	struct cola_session *s = ctx;
	const uint8_t *frame;
	size_t n;
	s->device->now_ns = t_ns;
	if (s->device->off)
		return;
	for (size_t done = 0; done < len;) {
		done += framer_push(&s->framer, bytes + done, len - done);
		while ((n = framer_take(&s->framer, &frame)) > 0)
			sim_cola_answer(s, frame, n);
	}
}

static void advance(void *ctx, int64_t t_ns)
{
	struct cola *d = ((struct cola_session *)ctx)->device;
	d->now_ns = t_ns;
	if (d->off && d->ready_ns != INT64_MAX && t_ns >= d->ready_ns)
		power(d, true);
	sim_cola_turn(d);
}

static size_t transmit(void *ctx, uint8_t *buf, size_t cap)
{
	struct cola_session *s = ctx;
	return sim_line_take(&s->line, buf, cap, s->device->now_ns, false);
}

static int64_t deadline(void *ctx)
{
	const struct cola_session *s = ctx;
	const struct cola *d = s->device;
	const int64_t line_ns = sim_line_deadline(&s->line, d->now_ns);
	const int64_t mirror_ns = d->off ? d->ready_ns : sim_cola_next(d);
	return line_ns < mirror_ns ? line_ns : mirror_ns;
}

static void connected(void *ctx, bool yes, int64_t t_ns)
{
	struct cola_session *s = ctx;
	s->device->now_ns = t_ns;
	s->device->counts.reconnects += yes;
	s->connected = yes;
	if (!(yes && s->streaming)) /* ordered: it streams to whoever comes first */
		open_session(s);
}

static bool alive(const void *ctx)
{
	return !((const struct cola_session *)ctx)->device->off;
}

static int start_session(struct cola *d, struct cola_session *s)
{
	const int r = sim_line_init(&s->line, LINE_CAP, d->params.serial);
	if (r < 0)
		return r;
	s->device = d;
	s->used = true;
	s->line.segment = d->params.segments ? 1448 : 0;
	memcpy(s->line.fault, d->line_fault, sizeof s->line.fault);
	open_session(s);
	return 0;
}

static bool session(void *ctx, struct sim_device *ret)
{
	struct cola *d = ((struct cola_session *)ctx)->device;
	for (int i = 0; i < SIM_COLA_SESSIONS; i++) {
		if (d->session[i].used || start_session(d, &d->session[i]) < 0)
			continue;
		*ret = end;
		ret->ctx = &d->session[i];
		return true;
	}
	return false;
}

/* Faults */

/* Without a duration it is off as long as it takes to boot. */
static void set_power(struct cola *d, const struct sim_fault *fault, bool on)
{
	power(d, !on);
	if (on)
		d->ready_ns = fault->for_ns > 0 ? INT64_MAX : d->now_ns + d->model->boot_ns;
}

static double or_else(double value, double otherwise)
{
	return value != 0 ? value : otherwise;
}

/* What happens once, or is set. False: `kind` is a state to look up. */
static bool happen(struct cola *d, enum sim_cola_fault kind, const struct sim_fault *fault, bool on)
{
	const double us = sim_cola_clock_us(d, d->now_ns);
	switch (kind) {
	case SIM_COLA_POWER:
		set_power(d, fault, on);
		return true;
	case SIM_COLA_DRIFT:
		sim_cola_set_clock(d, us, on ? or_else(fault->value, 200) : d->params.drift_ppm);
		return true;
	case SIM_COLA_CLOCK_STEP:
		if (on)
			sim_cola_set_clock(d, us + or_else(fault->value, 1) * 1e6, d->drift * 1e6);
		return true;
	case SIM_COLA_CLOCK_WRAP:
		if (on)
			sim_cola_set_clock(d, 4294967296.0 - or_else(fault->value, 2) * 1e6, d->drift * 1e6);
		return true;
	case SIM_COLA_COUNTER_WRAP:
		if (on)
			d->telegram_counter = d->scan_counter = (uint16_t)(65536 - or_else(fault->value, 10));
		return true;
	case SIM_COLA_WRONG_DIALECT:
		d->dialect = d->dialect == COLA_A ? COLA_B : COLA_A;
		return true;
	case SIM_COLA_IDLE:
		d->measuring = !on;
		if (!on)
			sim_cola_start_mirror(d);
		return true;
	case SIM_COLA_STREAMING:
		for (int i = 0; i < SIM_COLA_SESSIONS; i++)
			d->session[i].streaming = on && d->session[i].used;
		return true;
	default:
		return false;
	}
}

static bool order(void *ctx, const struct sim_fault *fault, bool on, int64_t t_ns)
{
	struct cola *d = ((struct cola_session *)ctx)->device;
	const int i = sim_fault_index(kinds, fault->kind);
	d->now_ns = t_ns;
	if (i < 0)
		return false;
	if (i < SIM_LINE_FAULTS) {
		sim_fault_set(&d->line_fault[i], fault, on);
		for (int k = 0; k < SIM_COLA_SESSIONS; k++)
			if (d->session[k].used)
				sim_line_order(&d->session[k].line, fault, on, t_ns);
	} else if (!happen(d, (enum sim_cola_fault)i, fault, on)) {
		struct sim_fault_state *state = cola_fault(d, (enum sim_cola_fault)i);
		sim_fault_set(state, fault, on);
		/* Settings without a duration stay. */
		if (on && fault->for_ns == 0 && i != SIM_COLA_NO_ANSWER && i != SIM_COLA_SFA)
			state->on = true;
	}
	return true;
}

static void add_counts(struct sim_counts *sum, const struct sim_counts *more)
{
	sum->sent += more->sent;
	sum->corrupted += more->corrupted;
	sum->dropped += more->dropped;
	sum->garbage += more->garbage;
}

static void counts(const void *ctx, struct sim_counts *ret)
{
	const struct cola *d = ((const struct cola_session *)ctx)->device;
	*ret = d->counts;
	for (int i = 0; i < SIM_COLA_SESSIONS; i++)
		if (d->session[i].used)
			add_counts(ret, &d->session[i].line.counts);
}

static void destroy(void *ctx)
{
	struct cola_session *s = ctx;
	struct cola *d = s->device;
	add_counts(&d->counts, &s->line.counts);
	sim_line_finish(&s->line);
	s->used = false;
	if (s == &d->session[0])
		free(d);
}

static const struct sim_device end = {.receive = receive,
                                      .advance = advance,
                                      .transmit = transmit,
                                      .deadline = deadline,
                                      .connected = connected,
                                      .alive = alive,
                                      .session = session,
                                      .fault = order,
                                      .fault_kinds = kinds,
                                      .counts = counts,
                                      .destroy = destroy};

int sim_cola_create(const struct sim_cola_params *params, const struct scene *scene, int64_t t_ns,
                    struct sim_device *ret)
{
	struct cola *d = calloc(1, sizeof *d);
	if (d == NULL)
		return -ENOMEM;
	d->model = sim_cola_model(params->model);
	d->params = *params;
	if (d->params.serial == 0)
		d->params.serial = d->model->serial;
	d->scene = *scene;
	d->dialect = params->dialect == SIM_COLA_FACTORY ? d->model->dialect
	             : params->dialect == SIM_COLA_A     ? COLA_A
	                                                 : COLA_B;
	d->now_ns = d->on_ns = d->ready_ns = t_ns;
	d->measuring = true;
	sim_cola_set_factory(d);
	sim_cola_set_clock(d, params->start_us, params->drift_ppm);
	sim_cola_start_mirror(d);
	if (start_session(d, &d->session[0]) < 0) {
		free(d);
		return -ENOMEM;
	}
	*ret = end;
	ret->ctx = &d->session[0];
	return 0;
}

/* Nodes that send described numbers every so often: an angle, and how the wheels of the robot turn.
 *
 * A number is measured at the `advance` in which its frame is made, whatever the period says: the frame is on the bus at
 * that time, and its stamp is the number's. The wheels measure what lies between two frames: the way along the heading
 * in the middle, and the turn. As counts these ways are summed up before they are rounded, so that nothing is lost. */
#include "tools/sim_can.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "drivers/can_signal.h"

#define FRAMES 8 /* that wait to leave; one more is dropped */

/* Faults of any frame first. */
#define FRAME_KINDS "silence", "gap", "invalid", "short", "wrong id", "jitter"
enum fault {
	SILENCE,
	GAP,
	INVALID,
	SHORT,
	WRONG_ID,
	JITTER,
	FRAME_FAULTS,
	FROZEN = FRAME_FAULTS,
	SLIP = FRAME_FAULTS,
	BLOCKED,
	POWER,
	FAULTS
};
static const char *const angle_kinds[] = {FRAME_KINDS, "frozen", NULL};
static const char *const wheels_kinds[] = {FRAME_KINDS, "slip", "blocked", "power", NULL};

/* What leaves, when, and what befalls it. */
struct sender {
	const char *const *kinds;
	struct sim_fault_state fault[FAULTS];
	int64_t period_ns, next_ns, now_ns;
	struct {
		struct can_frame_at frame;
		int64_t due_ns;
	} waiting[FRAMES];
	int n;
	uint64_t random;
	struct sim_counts counts;
};

struct angle {
	struct sender sender;
	struct sim_can_angle_params params;
	uint32_t counter;
	double frozen;
};

struct wheels {
	struct sender sender;
	struct sim_can_wheels_params params;
	struct pose before;
	int64_t before_ns;
	uint32_t counter;
	double left_m, right_m; /* ways since it has power */
};

/* ---- sending ---- */

static void init(struct sender *s, const char *const *kinds, int64_t period_ns, uint64_t seed, int64_t t_ns)
{
	s->kinds = kinds;
	s->period_ns = period_ns;
	s->next_ns = s->now_ns = t_ns;
	s->random = sim_mix(seed);
}

/* The frame of a good number becomes what the faults make of it, and waits to leave. */
static void send_frame(struct sender *s, const struct config_signal *signal, struct can_frame_at *f)
{
	int64_t late_ns = 0;

	if (s->fault[SILENCE].on || s->n == FRAMES) {
		s->counts.dropped++;
		return;
	}
	if (signal->valid.set && sim_fault_due(&s->fault[INVALID]))
		f->data[signal->valid.bit / 8] ^= (uint8_t)(1u << signal->valid.bit % 8);
	if (f->len > 0 && sim_fault_due(&s->fault[SHORT]))
		f->len = (uint8_t)(can_signal_needs(signal) - 1);
	if (sim_fault_due(&s->fault[WRONG_ID]))
		f->id++;
	if (s->fault[JITTER].on)
		late_ns = (int64_t)(sim_random(&s->random) * sim_fault_value(&s->fault[JITTER], 5.0) * 1e6);
	s->waiting[s->n].frame = *f;
	s->waiting[s->n++].due_ns = s->now_ns + late_ns;
}

/* The next value of a counter. */
static uint32_t count(struct sender *s, uint32_t counter)
{
	struct sim_fault_state *gap = &s->fault[GAP];
	uint32_t step = 1;

	if (sim_fault_due(gap))
		step += (uint32_t)sim_fault_value(gap, 5.0);
	return counter + step;
}

/* Is it time? The rhythm is kept, but what a slow machine missed is not made up for. */
static bool begins(struct sender *s, int64_t t_ns)
{
	s->now_ns = t_ns;
	if (t_ns < s->next_ns)
		return false;
	s->next_ns += s->period_ns;
	if (s->next_ns <= t_ns)
		s->next_ns = t_ns + s->period_ns;
	return true;
}

static size_t transmit(void *ctx, uint8_t *buf, size_t cap)
{
	struct sender *s = ctx;
	size_t len = 0;

	for (int i = 0; i < s->n;) {
		if (s->waiting[i].due_ns > s->now_ns || cap - len < CAN_WIRE_ENTRY_FD) {
			i++;
			continue;
		}
		s->waiting[i].frame.t_ns = s->now_ns;
		len += can_wire_put(&s->waiting[i].frame, buf + len);
		s->counts.sent++;
		memmove(&s->waiting[i], &s->waiting[i + 1], (size_t)(--s->n - i) * sizeof s->waiting[0]);
	}
	return len;
}

static int64_t deadline(void *ctx)
{
	const struct sender *s = ctx;
	int64_t due_ns = s->next_ns;

	for (int i = 0; i < s->n; i++)
		due_ns = s->waiting[i].due_ns < due_ns ? s->waiting[i].due_ns : due_ns;
	return due_ns;
}

static void receive(void *ctx, const uint8_t *bytes, size_t len, int64_t t_ns)
{
	(void)ctx;
	(void)bytes;
	(void)len;
	(void)t_ns;
}

static void connected(void *ctx, bool yes, int64_t t_ns)
{
	(void)ctx;
	(void)yes;
	(void)t_ns;
}

static bool order(struct sender *s, const struct sim_fault *fault, bool on)
{
	int i = sim_fault_index(s->kinds, fault->kind);

	if (i >= 0)
		sim_fault_set(&s->fault[i], fault, on);
	return i >= 0;
}

static void counts(const void *ctx, struct sim_counts *ret)
{
	*ret = ((const struct sender *)ctx)->counts;
}

/* Brains begin with their sender: it is their context, too. */
static struct sim_device device_of(void *brain, const char *const *kinds)
{
	return (struct sim_device){.ctx = brain,
	                           .receive = receive,
	                           .transmit = transmit,
	                           .deadline = deadline,
	                           .connected = connected,
	                           .fault_kinds = kinds,
	                           .counts = counts,
	                           .destroy = free};
}

/* ---- an angle ---- */

static void angle_advance(void *ctx, int64_t t_ns)
{
	struct angle *a = ctx;
	const struct config_signal *signal = &a->params.signal;
	struct can_frame_at f;

	if (!begins(&a->sender, t_ns))
		return;
	if (!a->sender.fault[FROZEN].on)
		a->frozen = a->params.angle(a->params.ctx, t_ns);
	a->counter = count(&a->sender, a->counter);
	f = can_signal_frame(signal);
	can_signal_put(signal, a->frozen + (a->sender.fault[INVALID].on && signal->valid.set ? 1.0 : 0.0), &f);
	can_signal_put_counter(signal, a->counter, &f);
	a->sender.counts.profiles++;
	send_frame(&a->sender, signal, &f);
}

static bool angle_fault(void *ctx, const struct sim_fault *fault, bool on, int64_t t_ns)
{
	(void)t_ns;
	return order(&((struct angle *)ctx)->sender, fault, on);
}

int sim_can_angle_create(const struct sim_can_angle_params *params, int64_t t_ns, struct sim_device *ret)
{
	struct angle *a = calloc(1, sizeof *a);

	if (!a)
		return -ENOMEM;
	a->params = *params;
	init(&a->sender, angle_kinds, params->period_ns, params->seed, t_ns);
	*ret = device_of(a, angle_kinds);
	ret->advance = angle_advance;
	ret->fault = angle_fault;
	return 0;
}

/* ---- wheels ---- */

static double yaw_of(struct quat q)
{
	return trig_atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
}

static double half_turn(double rad)
{
	return rad - 2.0 * TRIG_PI * rint(rad / (2.0 * TRIG_PI));
}

/* Since the last look: the way ahead and the turn, as the wheels make them. */
static void look(struct wheels *w, int64_t t_ns, double *ret_ahead, double *ret_turn)
{
	struct pose pose = w->params.pose(w->params.ctx, t_ns);
	double yaw = yaw_of(w->before.rotation), turn = half_turn(yaw_of(pose.rotation) - yaw),
	       middle = yaw + turn / 2.0;
	double dx = pose.position_m.x - w->before.position_m.x, dy = pose.position_m.y - w->before.position_m.y;
	double slip = w->sender.fault[SLIP].on ? 1.0 + sim_fault_value(&w->sender.fault[SLIP], 0.2) : 1.0;

	*ret_ahead = (dx * trig_cos(middle) + dy * trig_sin(middle)) * slip;
	*ret_turn = turn * slip;
	w->before = pose;
}

static uint64_t counts_of(const struct config_signal *signal, double way_m)
{
	double cycle = signal->wrap > 0.0 ? signal->wrap : ldexp(1.0, signal->length), raw;

	raw = floor((way_m - signal->offset) / signal->scale);
	raw -= cycle * floor(raw / cycle);
	return (uint64_t)raw;
}

/* Two numbers, in one frame where they have one id. `counted`: they are counts of ways. */
static void send_pair(struct wheels *w, const struct config_signal *const signal[2], const double value[2],
                      bool counted)
{
	struct can_frame_at f[2] = {can_signal_frame(signal[0]), can_signal_frame(signal[1])};
	bool one = signal[0]->id == signal[1]->id && signal[0]->extended == signal[1]->extended;

	if (one) {
		f[0].len = f[1].len > f[0].len ? f[1].len : f[0].len;
		f[0].flags |= f[1].flags;
	}
	for (int i = 0; i < 2; i++) {
		struct can_frame_at *to = &f[one ? 0 : i];

		if (counted)
			can_signal_put_bits(signal[i], counts_of(signal[i], value[i]), to);
		else
			can_signal_put(signal[i], value[i], to);
		can_signal_put_counter(signal[i], w->counter, to);
	}
	send_frame(&w->sender, signal[0], &f[0]);
	if (!one)
		send_frame(&w->sender, signal[1], &f[1]);
}

static void wheels_advance(void *ctx, int64_t t_ns)
{
	struct wheels *w = ctx;
	const struct sim_can_wheels_params *p = &w->params;
	double ahead, turn, seconds = (double)(t_ns - w->before_ns) * 1e-9, left, right;

	if (!begins(&w->sender, t_ns) || t_ns == w->before_ns)
		return;
	w->before_ns = t_ns;
	look(w, t_ns, &ahead, &turn);
	if (w->sender.fault[POWER].on)
		return;
	left = w->sender.fault[BLOCKED].on ? 0.0 : ahead - turn * p->track_m / 2.0;
	right = ahead + turn * p->track_m / 2.0;
	w->left_m += left;
	w->right_m += right;
	w->counter = count(&w->sender, w->counter);
	w->sender.counts.profiles++;
	if (p->left.set)
		send_pair(w, (const struct config_signal *const[2]){&p->left, &p->right},
		          (double[2]){w->left_m, w->right_m}, true);
	else
		send_pair(w, (const struct config_signal *const[2]){&p->ahead, &p->turn},
		          (double[2]){(left + right) / 2.0 / seconds, (right - left) / p->track_m / seconds}, false);
}

static bool wheels_fault(void *ctx, const struct sim_fault *fault, bool on, int64_t t_ns)
{
	struct wheels *w = ctx;

	(void)t_ns;
	if (!order(&w->sender, fault, on))
		return false;
	if (on && sim_fault_index(wheels_kinds, fault->kind) == POWER) {
		w->left_m = w->right_m = 0.0;
		w->sender.fault[POWER].owed = 0;
		w->counter = 0;
		w->sender.counts.power_cycles++;
	}
	return true;
}

int sim_can_wheels_create(const struct sim_can_wheels_params *params, int64_t t_ns, struct sim_device *ret)
{
	struct wheels *w = calloc(1, sizeof *w);

	if (!w)
		return -ENOMEM;
	w->params = *params;
	w->before = params->pose(params->ctx, t_ns);
	w->before_ns = t_ns;
	init(&w->sender, wheels_kinds, params->period_ns, params->seed, t_ns);
	*ret = device_of(w, wheels_kinds);
	ret->advance = wheels_advance;
	ret->fault = wheels_fault;
	return 0;
}

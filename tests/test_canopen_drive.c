/* Law L8: a drive comes from any state to what it is told, never jumps, and a fault of it is reset once; in virtual time. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <stdlib.h>
#include <string.h>

#include "drivers/canopen_drive.h"

#define MS INT64_C(1000000)

/* ---- a drive by the book, with the ways in which real ones differ ---- */

struct plant {
	enum canopen_drive_state state;
	uint16_t control;
	int mode;
	int32_t target, position, homed_at;
	uint32_t speed;
	bool ack, homing, attained, reached;

	/* How it differs. */
	enum canopen_drive_state stays; /* does not leave this state by command */
	uint16_t extra;                 /* bits of its statusword: following error, limit ... */
	uint16_t lacks;                 /* bits that are missing: voltage, remote */
	int stale;                      /* statuswords that still tell of the homing before */
	bool incurable, homing_fails, homing_hangs, mode_hangs, other_sign, no_ack, keeps_ack;
	uint16_t refuses; /* this object */
	uint32_t modes;   /* 6502 */
	bool limited;
	int32_t limit[2];
	uint16_t code;
	int lose; /* frames that get lost */

	/* What it saw. */
	int resets, set_points, quick_stops, jumps, control_frames;
	int hasty;     /* set-points before the acknowledgement of the last one was taken back */
	int at_once;   /* ... told to be done at once */
	int32_t taken; /* the target as it was known when bit 4 rose */
};

static struct plant plant(enum canopen_drive_state state)
{
	return (struct plant){.state = state,
	                      .position = 1000,
	                      .target = 77777,
	                      .stays = CANOPEN_DRIVE_UNKNOWN,
	                      .modes = 0xa5,
	                      .code = 0x4310,
	                      .reached = true};
}

static uint16_t statusword(const struct plant *p)
{
	static const uint16_t of[] = {0x00, 0x40, 0x21, 0x23, 0x27, 0x07, 0x0f, 0x08};
	uint16_t status = of[p->state] | 0x0210 | p->extra;

	if (p->mode == 6)
		status |= p->attained ? 0x1400 : p->homing && p->homing_fails ? 0x2000 : 0;
	else if (p->mode == 1)
		status |= (p->ack ? 0x1000 : 0) | (p->reached ? 0x0400 : 0);
	return status & (uint16_t)~p->lacks;
}

static enum canopen_drive_state commanded(const struct plant *p, uint16_t control, bool reset)
{
	const enum canopen_drive_state s = p->state;

	if (s == CANOPEN_FAULT)
		return reset && !p->incurable ? CANOPEN_SWITCH_ON_DISABLED : s;
	if (s == p->stays || s == CANOPEN_NOT_READY || s == CANOPEN_FAULT_REACTION)
		return s;
	if (!(control & 2))
		return CANOPEN_SWITCH_ON_DISABLED;
	if (!(control & 4))
		return s == CANOPEN_ENABLED || s == CANOPEN_QUICK_STOP ? CANOPEN_QUICK_STOP
		                                                       : CANOPEN_SWITCH_ON_DISABLED;
	switch (control & 0xf) {
	case 0x6:
		return s == CANOPEN_QUICK_STOP ? s : CANOPEN_READY_TO_SWITCH_ON;
	case 0x7:
		return s == CANOPEN_READY_TO_SWITCH_ON || s == CANOPEN_ENABLED ? CANOPEN_SWITCHED_ON : s;
	case 0xf:
		return s == CANOPEN_SWITCHED_ON ? CANOPEN_ENABLED : s;
	default:
		return s;
	}
}

static void take_set_point(struct plant *p, bool rises)
{
	p->hasty += rises && p->ack;
	if (rises && !p->no_ack && !p->ack) {
		p->set_points++;
		p->at_once += (p->control & 0x20) != 0;
		p->taken = p->target; /* objects are applied in their order: 6040 comes before 607A */
		p->ack = true;
		p->reached = false;
	}
	if (!(p->control & 0x10) && !p->keeps_ack)
		p->ack = false;
}

static void take_frame(struct plant *p, uint16_t control, int32_t demand)
{
	const bool rises = (control & 0x10) && !(p->control & 0x10);
	const bool reset = (control & 0x80) && !(p->control & 0x80);
	const enum canopen_drive_state before = p->state;

	p->control_frames++;
	if (p->lose > 0) {
		p->lose--;
		return;
	}
	p->resets += reset;
	p->state = commanded(p, control, reset);
	p->quick_stops += before == CANOPEN_ENABLED && p->state == CANOPEN_QUICK_STOP;
	p->control = control;
	if (p->mode == 1)
		take_set_point(p, rises && p->state == CANOPEN_ENABLED);
	p->target = demand;
	if (p->mode == 8 && p->state == CANOPEN_ENABLED) {
		p->jumps += abs(demand - p->position) > 50;
		p->position = demand;
	}
	if (p->mode == 3 && p->state == CANOPEN_ENABLED && before != CANOPEN_ENABLED)
		p->jumps += demand != 0;
	if (p->mode == 6 && rises && p->state == CANOPEN_ENABLED && !p->homing_hangs) {
		p->homing = true;
		p->attained = !p->homing_fails && p->stale == 0;
		if (p->stale == 0 && !p->homing_fails)
			p->position = p->other_sign ? -p->homed_at : p->homed_at;
	}
}

/* Answers a transfer: the value, or the abort. */
static bool serve(struct plant *p, const struct canopen_drive_wish *w, uint32_t *ret)
{
	*ret = 0x06020000;
	if (w->ask.index == p->refuses)
		return false;
	switch (w->ask.index) {
	case 0x6060:
		p->mode = p->mode_hangs ? p->mode : (int)w->ask.value;
		p->attained = p->stale > 0;
		p->homing = false;
		break;
	case 0x6061:
		*ret = (uint32_t)p->mode;
		break;
	case 0x6502:
		*ret = p->modes;
		break;
	case 0x607d:
		*ret = (uint32_t)p->limit[w->ask.sub - 1];
		return p->limited;
	case 0x603f:
		*ret = p->code;
		break;
	case 0x607c:
		p->homed_at = (int32_t)w->ask.value;
		break;
	case 0x6081:
		p->speed = w->ask.value;
		break;
	default:
		break;
	}
	return true;
}

/* A homing that begins late: bits of the one before stand for a while, then it is under way, then it is done. */
static void be_slow(struct plant *p)
{
	if (!p->homing || p->stale == 0)
		return;
	p->stale--;
	p->attained = p->stale > 4;
	if (p->stale == 0) {
		p->attained = true;
		p->position = p->homed_at;
	}
}

/* A status every 10 ms, an answer in the next step: so long. */
static void run(struct canopen_drive *d, struct plant *p, int64_t *t_ns, int64_t ms)
{
	struct canopen_drive_wish w;
	uint32_t value;

	for (int64_t end_ns = *t_ns + ms * MS; *t_ns < end_ns; *t_ns += 5 * MS) {
		if (*t_ns / MS % 10 == 0) {
			be_slow(p);
			canopen_drive_status(d, statusword(p), *t_ns);
			canopen_drive_position(d, p->position);
			canopen_drive_follow(d, d->setup.mode == CANOPEN_VELOCITY ? 0 : d->demand);
		}
		canopen_drive_step(d, *t_ns, &w);
		for (int i = 0; i < w.frames; i++)
			take_frame(p, w.frame[i].control, w.frame[i].demand);
		if (w.asks) {
			const bool good = serve(p, &w, &value);

			canopen_drive_answer(d, good, value, *t_ns);
		}
		assert_true(w.deadline_ns > *t_ns || w.deadline_ns == INT64_MAX);
	}
}

static struct canopen_drive drive(int mode)
{
	const struct canopen_drive_setup setup = {
	    .mode = mode, .acceleration = 300000, .period_ns = 10 * MS, .homing_speed = 5000, .homing_ns = 3000 * MS};
	struct canopen_drive d;

	canopen_drive_init(&d, &setup);
	return d;
}

static struct canopen_drive homing_drive(int mode, int32_t home_count)
{
	struct canopen_drive d = drive(mode);

	d.setup.homes = true;
	d.setup.method = 17;
	d.setup.home_count = home_count;
	return d;
}

static const int modes[] = {CANOPEN_POSITION, CANOPEN_VELOCITY, CANOPEN_CYCLIC};

/* ---- the way up ---- */

static void from_every_state_it_comes_to_what_it_is_told(void **state)
{
	static const int shown[] = {1, 3, 8};

	(void)state;
	for (int mode = 0; mode < 3; mode++)
		for (int s = CANOPEN_SWITCH_ON_DISABLED; s <= CANOPEN_FAULT; s++) {
			struct plant p = plant((enum canopen_drive_state)s);
			struct canopen_drive d = drive(modes[mode]);
			int64_t t_ns = 0;

			p.mode = 7; /* what somebody else used it for */
			canopen_drive_begin(&d, t_ns);
			run(&d, &p, &t_ns, 300);
			if (s == CANOPEN_FAULT_REACTION) {
				assert_int_equal(d.phase, CANOPEN_DRIVE_RESETTING);
				p.state = CANOPEN_FAULT;
			}
			run(&d, &p, &t_ns, 700);
			assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
			assert_int_equal(p.state, CANOPEN_ENABLED);
			assert_int_equal(p.mode, shown[mode]);
			assert_int_equal(p.jumps, 0);
			assert_int_equal(p.set_points, 0);
			assert_int_equal(p.resets, s == CANOPEN_FAULT || s == CANOPEN_FAULT_REACTION);
		}
}

static void one_that_tests_itself_is_waited_for(void **state)
{
	struct plant p = plant(CANOPEN_NOT_READY);
	struct canopen_drive d = drive(CANOPEN_POSITION);
	int64_t t_ns = 0;

	(void)state;
	canopen_drive_begin(&d, t_ns);
	run(&d, &p, &t_ns, 8000);
	assert_int_equal(d.phase, CANOPEN_DRIVE_WAITING);
	assert_int_equal(p.control_frames, 0);
	p.state = CANOPEN_SWITCH_ON_DISABLED;
	run(&d, &p, &t_ns, 500);
	assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
}

static void who_is_listened_to_is_told_nothing(void **state)
{
	struct plant p = plant(CANOPEN_FAULT);
	struct canopen_drive d = drive(CANOPEN_CYCLIC);
	int64_t t_ns = 0;

	(void)state;
	run(&d, &p, &t_ns, 2000);
	assert_int_equal(p.control_frames, 0);
	assert_int_equal(d.phase, CANOPEN_DRIVE_IDLE);
}

static void frames_that_get_lost_are_said_again(void **state)
{
	(void)state;
	for (int lose = 1; lose < 12; lose++) {
		struct plant p = plant(CANOPEN_FAULT);
		struct canopen_drive d = drive(CANOPEN_POSITION);
		int64_t t_ns = 0;

		p.lose = lose;
		canopen_drive_begin(&d, t_ns);
		run(&d, &p, &t_ns, 3500);
		if (d.phase == CANOPEN_DRIVE_STANDING) /* all of a second's were lost */
			assert_true(lose > 8);
		else
			assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
		assert_true(p.resets <= 1);
	}
}

static void a_step_that_is_not_taken_has_its_sentence(void **state)
{
	static const struct {
		enum canopen_drive_state stays;
		uint16_t lacks;
		const char *says;
	} row[] = {{CANOPEN_SWITCH_ON_DISABLED, 0x0000, "switch on disabled"},
	           {CANOPEN_READY_TO_SWITCH_ON, 0x0010, "has no voltage"},
	           {CANOPEN_READY_TO_SWITCH_ON, 0x0200, "not controlled by CAN"},
	           {CANOPEN_SWITCHED_ON, 0x0000, "enable input"}};

	(void)state;
	for (size_t i = 0; i < sizeof row / sizeof row[0]; i++) {
		struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
		struct canopen_drive d = drive(CANOPEN_POSITION);
		int64_t t_ns = 0;

		p.stays = row[i].stays;
		p.lacks = row[i].lacks;
		canopen_drive_begin(&d, t_ns);
		run(&d, &p, &t_ns, 4500);
		assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
		assert_non_null(strstr(d.why, row[i].says));
		run(&d, &p, &t_ns, 60000);
		assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
		/* Its power comes: it goes on. */
		p.stays = CANOPEN_DRIVE_UNKNOWN;
		p.lacks = 0;
		run(&d, &p, &t_ns, 1000);
		assert_int_equal(d.phase == CANOPEN_DRIVE_RUNNING, row[i].lacks != 0);
	}
}

/* Whoever holds it enabled: it is said, and not tried for ever. */
static void a_drive_that_stays_enabled_is_named_and_left(void **state)
{
	(void)state;
	for (int mode = 0; mode < 3; mode++) {
		struct plant p = plant(CANOPEN_ENABLED);
		struct canopen_drive d = drive(modes[mode]);
		int64_t t_ns = 0;

		p.stays = CANOPEN_ENABLED;
		canopen_drive_begin(&d, t_ns);
		run(&d, &p, &t_ns, 2500);
		assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
		assert_non_null(strstr(d.why, "does not leave the state operation enabled"));
		run(&d, &p, &t_ns, 60000);
		assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
	}
}

static void a_drive_without_a_statusword_is_named(void **state)
{
	struct canopen_drive d = drive(CANOPEN_POSITION);
	struct canopen_drive_wish w;

	(void)state;
	canopen_drive_begin(&d, 0);
	canopen_drive_step(&d, 2000 * MS, &w);
	assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
	assert_string_equal(d.why, "tells no statusword");
}

/* ---- faults ---- */

static void a_fault_is_reset_by_one_edge_and_then_reported(void **state)
{
	struct plant p = plant(CANOPEN_FAULT);
	struct canopen_drive d = drive(CANOPEN_POSITION);
	int64_t t_ns = 0;

	(void)state;
	canopen_drive_begin(&d, t_ns);
	run(&d, &p, &t_ns, 1000);
	assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
	assert_int_equal(p.resets, 1);
	p.state = CANOPEN_FAULT_REACTION;
	run(&d, &p, &t_ns, 100);
	p.state = CANOPEN_FAULT;
	p.code = 0x8611;
	run(&d, &p, &t_ns, 3600 * 1000);
	assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
	assert_int_equal(p.resets, 1);
	assert_non_null(strstr(d.why, "8611"));
	assert_non_null(strstr(d.why, "again"));
	/* Beginning anew (a link that was lost) is no new right. */
	canopen_drive_begin(&d, t_ns);
	run(&d, &p, &t_ns, 5000);
	assert_int_equal(p.resets, 1);
	assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
	/* Somebody clears it: it goes on, and may be reset once more. */
	p.state = CANOPEN_SWITCH_ON_DISABLED;
	run(&d, &p, &t_ns, 1000);
	assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
	p.state = CANOPEN_FAULT;
	run(&d, &p, &t_ns, 1000);
	assert_int_equal(p.resets, 2);
	assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
}

static void bit_7_is_low_before_it_rises(void **state)
{
	struct plant p = plant(CANOPEN_FAULT);
	struct canopen_drive d = drive(CANOPEN_POSITION);
	int64_t t_ns = 0;

	(void)state;
	p.control = 0x80; /* somebody left it so */
	canopen_drive_begin(&d, t_ns);
	run(&d, &p, &t_ns, 1000);
	assert_int_equal(p.resets, 1);
	assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
}

static void a_fault_while_it_stands_and_its_cure_let_it_go_on(void **state)
{
	struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
	struct canopen_drive d = drive(CANOPEN_POSITION);
	int64_t t_ns = 0;

	(void)state;
	canopen_drive_begin(&d, t_ns);
	run(&d, &p, &t_ns, 500);
	canopen_drive_halt(&d, "is 12 degrees off", t_ns);
	run(&d, &p, &t_ns, 1000);
	assert_string_equal(d.why, "is 12 degrees off");
	p.state = CANOPEN_FAULT;
	run(&d, &p, &t_ns, 5000);
	assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
	assert_int_equal(p.resets, 0); /* whoever stands does not need it */
	p.state = CANOPEN_SWITCH_ON_DISABLED;
	run(&d, &p, &t_ns, 1000);
	assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
}

static void a_fault_that_does_not_clear_is_reported(void **state)
{
	struct plant p = plant(CANOPEN_FAULT);
	struct canopen_drive d = drive(CANOPEN_CYCLIC);
	int64_t t_ns = 0;

	(void)state;
	p.incurable = true;
	p.refuses = 0x603f;
	canopen_drive_emergency(&d, 0x3210);
	canopen_drive_emergency(&d, 0); /* "gone" says nothing of the state */
	canopen_drive_begin(&d, t_ns);
	run(&d, &p, &t_ns, 60000);
	assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
	assert_int_equal(p.resets, 1);
	assert_non_null(strstr(d.why, "3210"));
	/* Switched off and on. */
	p.state = CANOPEN_SWITCH_ON_DISABLED;
	canopen_drive_booted(&d);
	canopen_drive_begin(&d, t_ns);
	run(&d, &p, &t_ns, 1000);
	assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
}

static void ten_minutes_without_a_fault_earn_another_reset(void **state)
{
	struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
	struct canopen_drive d = drive(CANOPEN_POSITION);
	int64_t t_ns = 0;

	(void)state;
	canopen_drive_begin(&d, t_ns);
	for (int i = 0; i < 3; i++) {
		run(&d, &p, &t_ns, 601 * 1000);
		assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
		p.state = CANOPEN_FAULT;
	}
	run(&d, &p, &t_ns, 599 * 1000);
	p.state = CANOPEN_FAULT;
	run(&d, &p, &t_ns, 1000);
	assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
	assert_int_equal(p.resets, 3);
}

static void what_was_our_own_silence_is_reset_at_once_but_not_for_ever(void **state)
{
	struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
	struct canopen_drive d = drive(CANOPEN_POSITION);
	int64_t t_ns = 0;

	(void)state;
	p.code = 0x8130;
	canopen_drive_begin(&d, t_ns);
	for (int i = 0; i < 20; i++) { /* each after some running */
		run(&d, &p, &t_ns, 3000);
		assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
		p.state = CANOPEN_FAULT;
	}
	assert_int_equal(p.resets, 19);
	for (int i = 0; i < 20; i++) { /* a heartbeat that never reaches it */
		run(&d, &p, &t_ns, 1000);
		p.state = CANOPEN_FAULT;
	}
	assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
	assert_true(p.resets <= 19 + CANOPEN_DRIVE_UNHEARD);
}

static void one_that_is_disabled_from_elsewhere_is_enabled_three_times(void **state)
{
	struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
	struct canopen_drive d = drive(CANOPEN_POSITION);
	int64_t t_ns = 0;

	(void)state;
	canopen_drive_begin(&d, t_ns);
	for (int i = 0; i < 4; i++) {
		run(&d, &p, &t_ns, 1000);
		assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
		p.state = i & 1 ? CANOPEN_QUICK_STOP : CANOPEN_SWITCH_ON_DISABLED;
	}
	run(&d, &p, &t_ns, 60000);
	assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
	assert_non_null(strstr(d.why, "disabled by something else"));
}

/* 6007 made it stop, without a fault, and it stays operational. */
static void one_that_missed_our_heartbeat_is_enabled_again_but_not_for_ever(void **state)
{
	struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
	struct canopen_drive d = drive(CANOPEN_POSITION);
	int64_t t_ns = 0;

	(void)state;
	canopen_drive_begin(&d, t_ns);
	for (int i = 0; i < 20; i++) { /* each after some running */
		run(&d, &p, &t_ns, 3000);
		assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
		canopen_drive_emergency(&d, 0x8130);
		canopen_drive_emergency(&d, 0);
		p.state = CANOPEN_QUICK_STOP;
	}
	run(&d, &p, &t_ns, 3000);
	for (int i = 0; i < CANOPEN_DRIVE_UNHEARD + 1; i++) { /* a heartbeat that never reaches it */
		assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
		canopen_drive_emergency(&d, 0x8130);
		p.state = CANOPEN_QUICK_STOP;
		run(&d, &p, &t_ns, 1000);
	}
	assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
	assert_non_null(strstr(d.why, "misses facetd's heartbeat"));
}

/* What it lost by our silence says nothing of what somebody else does to it. */
static void an_emergency_long_past_excuses_no_one(void **state)
{
	struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
	struct canopen_drive d = drive(CANOPEN_POSITION);
	int64_t t_ns = 0;

	(void)state;
	canopen_drive_begin(&d, t_ns);
	run(&d, &p, &t_ns, 3000);
	canopen_drive_emergency(&d, 0x8130);
	for (int i = 0; i < 5; i++) { /* the first of them is the emergency's */
		p.state = CANOPEN_SWITCH_ON_DISABLED;
		run(&d, &p, &t_ns, 3000);
		assert_int_equal(d.phase == CANOPEN_DRIVE_STANDING, i == 4);
	}
	assert_non_null(strstr(d.why, "disabled by something else"));
}

/* ---- commands ---- */

static void a_target_goes_by_its_handshake(void **state)
{
	struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
	struct canopen_drive d = drive(CANOPEN_POSITION);
	int64_t t_ns = 0;

	(void)state;
	canopen_drive_begin(&d, t_ns);
	run(&d, &p, &t_ns, 500);
	for (int i = 0; i < 10; i++) {
		canopen_drive_speed(&d, 1000 + (uint32_t)i);
		assert_true(canopen_drive_goto(&d, i * 1000));
		p.lose = i % 3 * 2; /* both frames: they leave together */
		run(&d, &p, &t_ns, 600);
		assert_int_equal(p.set_points, i + 1);
		assert_int_equal(d.taken, i + 1);
		assert_int_equal(d.taken_count, i * 1000);
		assert_int_equal(p.taken, i * 1000);
		assert_int_equal(p.hasty, 0);
		assert_int_equal(p.at_once, 0); /* it had reached the last one */
		assert_int_equal(p.speed, 1000 + i);
		assert_false(p.ack);
		assert_int_equal(p.control, 0x0f);
		p.reached = true;
	}
}

static void a_target_that_changes_at_once_is_taken_at_once(void **state)
{
	struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
	struct canopen_drive d = drive(CANOPEN_POSITION);
	int64_t t_ns = 0;

	(void)state;
	canopen_drive_begin(&d, t_ns);
	run(&d, &p, &t_ns, 500);
	canopen_drive_goto(&d, 1);
	run(&d, &p, &t_ns, 5);
	canopen_drive_goto(&d, 2); /* the first is still shaking hands */
	run(&d, &p, &t_ns, 200);
	assert_int_equal(p.set_points, 2);
	assert_int_equal(p.taken, 2);
	assert_int_equal(p.hasty, 0);
	assert_int_equal(p.at_once, 1);
	/* A new speed reaches a drive that is on its way. */
	canopen_drive_speed(&d, 500);
	run(&d, &p, &t_ns, 200);
	assert_int_equal(p.set_points, 3);
	assert_int_equal(p.taken, 2);
	assert_int_equal(p.at_once, 2);
}

static void a_handshake_that_fails_has_its_sentence(void **state)
{
	(void)state;
	for (int keeps = 0; keeps < 2; keeps++) {
		struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
		struct canopen_drive d = drive(CANOPEN_POSITION);
		int64_t t_ns = 0;

		p.no_ack = !keeps;
		p.keeps_ack = keeps;
		canopen_drive_begin(&d, t_ns);
		run(&d, &p, &t_ns, 500);
		canopen_drive_goto(&d, 5);
		run(&d, &p, &t_ns, 1500);
		assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
		assert_non_null(strstr(d.why, "bit 12"));
		assert_int_equal(p.control, 0x10f);
	}
}

/* Bit 12 is set before anything was told: another's set-point, or what another mode made of it. */
static void an_acknowledgement_of_nothing_has_to_go_first(void **state)
{
	(void)state;
	for (int goes = 0; goes < 2; goes++) {
		struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
		struct canopen_drive d = drive(CANOPEN_POSITION);
		int64_t t_ns = 0;

		canopen_drive_begin(&d, t_ns);
		run(&d, &p, &t_ns, 500);
		p.extra = 0x1000;
		run(&d, &p, &t_ns, 100);
		canopen_drive_goto(&d, 5);
		run(&d, &p, &t_ns, 100);
		assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
		assert_int_equal(p.set_points, 0);
		p.extra = goes ? 0 : 0x1000;
		run(&d, &p, &t_ns, 1500);
		assert_int_equal(p.set_points, goes);
		assert_int_equal(d.phase, goes ? CANOPEN_DRIVE_RUNNING : CANOPEN_DRIVE_STANDING);
		if (!goes)
			assert_non_null(strstr(d.why, "does not take its acknowledgement back"));
	}
}

/* The machine stood still: what the drive answered meanwhile has not been read yet. */
static void a_stall_in_mid_handshake_halts_nothing(void **state)
{
	(void)state;
	struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
	struct canopen_drive d = drive(CANOPEN_POSITION);
	struct canopen_drive_wish wish;
	int64_t t_ns = 0;

	canopen_drive_begin(&d, t_ns);
	run(&d, &p, &t_ns, 500);
	p.extra = 0x1000;
	run(&d, &p, &t_ns, 100);
	canopen_drive_goto(&d, 5);
	run(&d, &p, &t_ns, 20);
	for (int stall = 0; stall < 3; stall++) {
		t_ns += 3 * CANOPEN_DRIVE_STEP_NS;
		canopen_drive_step(&d, t_ns, &wish);
		assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
		assert_true(wish.frames > 0); /* it is said again */
	}
	p.extra = 0;
	run(&d, &p, &t_ns, 500);
	assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
	assert_int_equal(p.set_points, 1);
}

static void nothing_beyond_its_own_limits_is_sent(void **state)
{
	(void)state;
	for (int mode = 0; mode < 3; mode += 2) {
		struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
		struct canopen_drive d = drive(modes[mode]);
		int64_t t_ns = 0;

		p.limited = true;
		p.limit[0] = -500;
		p.limit[1] = 1040;
		canopen_drive_begin(&d, t_ns);
		run(&d, &p, &t_ns, 500);
		assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
		assert_true(d.limited);
		assert_true(mode ? canopen_drive_follow(&d, 1040) : canopen_drive_goto(&d, 1040));
		run(&d, &p, &t_ns, 100);
		assert_int_equal(p.target, 1040);
		assert_false(mode ? canopen_drive_follow(&d, 1041) : canopen_drive_goto(&d, 1041));
		assert_false(mode ? canopen_drive_follow(&d, -501) : canopen_drive_goto(&d, -501));
		run(&d, &p, &t_ns, 500);
		assert_int_equal(p.target, 1040);
	}
}

static void limits_that_are_none_are_none(void **state)
{
	(void)state;
	for (int i = 0; i < 2; i++) {
		struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
		struct canopen_drive d = drive(CANOPEN_POSITION);
		int64_t t_ns = 0;

		p.limited = i; /* 0 and 0, or no object at all */
		canopen_drive_begin(&d, t_ns);
		run(&d, &p, &t_ns, 500);
		assert_false(d.limited);
		assert_true(canopen_drive_goto(&d, INT32_MAX));
	}
}

/* ---- what the drive sees going wrong ---- */

static void a_following_error_or_a_limit_stops_the_sweep(void **state)
{
	(void)state;
	for (int bit = 11; bit <= 13; bit += 2)
		for (int mode = 0; mode < 3; mode += 2) {
			struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
			struct canopen_drive d = drive(modes[mode]);
			int64_t t_ns = 0;

			canopen_drive_begin(&d, t_ns);
			run(&d, &p, &t_ns, 500);
			canopen_drive_goto(&d, 5000);
			p.extra = (uint16_t)(1u << bit);
			run(&d, &p, &t_ns, 200);
			assert_int_equal(d.phase == CANOPEN_DRIVE_STANDING, bit == 13); /* a limit may be passing */
			run(&d, &p, &t_ns, 600);
			assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
			assert_int_equal(p.control, 0x10f);
			assert_non_null(strstr(d.why, bit == 13 ? "following error" : "limit"));
			const int set_points = p.set_points;

			p.extra = 0;
			run(&d, &p, &t_ns, 60000);
			assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
			assert_int_equal(p.set_points, set_points);
			assert_true(canopen_drive_goto(&d, 1)); /* ignored */
			run(&d, &p, &t_ns, 1000);
			assert_int_equal(p.set_points, set_points);
		}
}

/* ---- homing ---- */

static void homing_ends_in_the_mode_that_was_wanted(void **state)
{
	(void)state;
	for (int mode = 0; mode < 3; mode++) {
		struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
		struct canopen_drive d = homing_drive(modes[mode], 250);
		int64_t t_ns = 0;

		canopen_drive_begin(&d, t_ns);
		run(&d, &p, &t_ns, 1000);
		assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
		assert_true(d.homed);
		assert_int_equal(p.position, 250);
		assert_int_equal(p.jumps, 0);
		/* A fault later costs no second homing. */
		p.position = 400;
		p.state = CANOPEN_FAULT;
		run(&d, &p, &t_ns, 1000);
		assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
		assert_int_equal(p.position, 400);
	}
}

static void bits_of_the_homing_before_count_for_nothing(void **state)
{
	(void)state;
	for (int stale = 5; stale <= 8; stale++) { /* the old bits for up to 40 ms */
		struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
		struct canopen_drive d = homing_drive(CANOPEN_POSITION, 250);
		int64_t t_ns = 0;

		p.stale = stale;
		canopen_drive_begin(&d, t_ns);
		run(&d, &p, &t_ns, 1000);
		assert_int_equal(d.phase, CANOPEN_DRIVE_RUNNING);
		assert_int_equal(p.position, 250);
	}
}

static void homing_that_fails_is_said_and_not_repeated(void **state)
{
	(void)state;
	for (int hangs = 0; hangs < 2; hangs++) {
		struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
		struct canopen_drive d = homing_drive(CANOPEN_POSITION, 0);
		int64_t t_ns = 0;

		p.homing_fails = !hangs;
		p.homing_hangs = hangs;
		canopen_drive_begin(&d, t_ns);
		run(&d, &p, &t_ns, 3500);
		assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
		assert_non_null(strstr(d.why, hangs ? "not home within" : "could not be homed by method 17"));
		p.homing_fails = p.homing_hangs = false;
		run(&d, &p, &t_ns, 60000);
		assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
		assert_false(d.homed);
	}
}

static void a_home_offset_of_the_other_sign_is_noticed(void **state)
{
	struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
	struct canopen_drive d = homing_drive(CANOPEN_POSITION, 250);
	int64_t t_ns = 0;

	(void)state;
	p.other_sign = true;
	canopen_drive_begin(&d, t_ns);
	run(&d, &p, &t_ns, 2000);
	assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
	assert_non_null(strstr(d.why, "the other way"));
}

/* ---- objects ---- */

static void what_it_refuses_is_said_in_words(void **state)
{
	static const struct {
		uint16_t object;
		bool runs;
		const char *says;
	} row[] = {{0x6083, true, "6083"},  {0x60c2, true, "60C2"}, {0x6502, true, ""},     {0x607d, true, ""},
	           {0x6060, false, "mode"}, {0x6061, true, ""},     {0x6098, false, "6098"}};

	(void)state;
	for (size_t i = 0; i < sizeof row / sizeof row[0]; i++) {
		struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
		const int mode = row[i].object == 0x60c2 ? CANOPEN_CYCLIC : CANOPEN_POSITION;
		struct canopen_drive d = row[i].object == 0x6098 ? homing_drive(mode, 0) : drive(mode);
		int64_t t_ns = 0;

		p.refuses = row[i].object;
		canopen_drive_begin(&d, t_ns);
		run(&d, &p, &t_ns, 1000);
		assert_int_equal(d.phase, row[i].runs ? CANOPEN_DRIVE_RUNNING : CANOPEN_DRIVE_STANDING);
		assert_non_null(strstr(row[i].runs ? d.note : d.why, row[i].says));
		assert_int_equal(row[i].runs && d.note[0] != 0, row[i].runs && row[i].says[0] != 0);
	}
}

static void a_mode_it_lacks_is_said_before_anything_moves(void **state)
{
	struct plant p = plant(CANOPEN_SWITCH_ON_DISABLED);
	struct canopen_drive d = drive(CANOPEN_CYCLIC);
	int64_t t_ns = 0;

	(void)state;
	p.modes = 0x25;
	canopen_drive_begin(&d, t_ns);
	run(&d, &p, &t_ns, 1000);
	assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
	assert_non_null(strstr(d.why, "has no mode cyclic position"));
	assert_int_not_equal(p.state, CANOPEN_ENABLED);
	p = plant(CANOPEN_SWITCH_ON_DISABLED);
	d = drive(CANOPEN_CYCLIC);
	p.mode_hangs = true;
	canopen_drive_begin(&d, t_ns);
	run(&d, &p, &t_ns, 3000);
	assert_int_equal(d.phase, CANOPEN_DRIVE_STANDING);
	assert_non_null(strstr(d.why, "does not change"));
}

/* ---- the end ---- */

static void it_is_left_without_power_whenever_it_ends(void **state)
{
	(void)state;
	for (int mode = 0; mode < 3; mode++)
		for (int ms = 0; ms < 700; ms += 15) {
			struct plant p = plant(CANOPEN_ENABLED);
			struct canopen_drive d = homing_drive(modes[mode], 0);
			int64_t t_ns = 0;

			canopen_drive_begin(&d, t_ns);
			run(&d, &p, &t_ns, ms);
			canopen_drive_end(&d, t_ns);
			run(&d, &p, &t_ns, 1500);
			assert_int_equal(d.phase, CANOPEN_DRIVE_ENDED);
			if (ms > 0)
				assert_int_equal(p.state, CANOPEN_SWITCH_ON_DISABLED);
			if (ms > 600)
				assert_int_equal(p.quick_stops, 1);
		}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(from_every_state_it_comes_to_what_it_is_told),
	    cmocka_unit_test(one_that_tests_itself_is_waited_for),
	    cmocka_unit_test(who_is_listened_to_is_told_nothing),
	    cmocka_unit_test(frames_that_get_lost_are_said_again),
	    cmocka_unit_test(a_step_that_is_not_taken_has_its_sentence),
	    cmocka_unit_test(a_drive_that_stays_enabled_is_named_and_left),
	    cmocka_unit_test(a_drive_without_a_statusword_is_named),
	    cmocka_unit_test(a_fault_is_reset_by_one_edge_and_then_reported),
	    cmocka_unit_test(bit_7_is_low_before_it_rises),
	    cmocka_unit_test(a_fault_while_it_stands_and_its_cure_let_it_go_on),
	    cmocka_unit_test(a_fault_that_does_not_clear_is_reported),
	    cmocka_unit_test(ten_minutes_without_a_fault_earn_another_reset),
	    cmocka_unit_test(what_was_our_own_silence_is_reset_at_once_but_not_for_ever),
	    cmocka_unit_test(one_that_is_disabled_from_elsewhere_is_enabled_three_times),
	    cmocka_unit_test(one_that_missed_our_heartbeat_is_enabled_again_but_not_for_ever),
	    cmocka_unit_test(an_emergency_long_past_excuses_no_one),
	    cmocka_unit_test(a_target_goes_by_its_handshake),
	    cmocka_unit_test(a_target_that_changes_at_once_is_taken_at_once),
	    cmocka_unit_test(a_handshake_that_fails_has_its_sentence),
	    cmocka_unit_test(an_acknowledgement_of_nothing_has_to_go_first),
	    cmocka_unit_test(a_stall_in_mid_handshake_halts_nothing),
	    cmocka_unit_test(nothing_beyond_its_own_limits_is_sent),
	    cmocka_unit_test(limits_that_are_none_are_none),
	    cmocka_unit_test(a_following_error_or_a_limit_stops_the_sweep),
	    cmocka_unit_test(homing_ends_in_the_mode_that_was_wanted),
	    cmocka_unit_test(bits_of_the_homing_before_count_for_nothing),
	    cmocka_unit_test(homing_that_fails_is_said_and_not_repeated),
	    cmocka_unit_test(a_home_offset_of_the_other_sign_is_noticed),
	    cmocka_unit_test(what_it_refuses_is_said_in_words),
	    cmocka_unit_test(a_mode_it_lacks_is_said_before_anything_moves),
	    cmocka_unit_test(it_is_left_without_power_whenever_it_ends),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

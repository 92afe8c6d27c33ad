/* See canopen_pairing.h. */
#include "drivers/canopen_pairing.h"

#define NEAR_NS 200000 /* delays differ by so much, and half of what they are */

void canopen_pairing_sync(struct canopen_pairing *p)
{
	p->steady = p->came == 1 && p->doubted ? (uint8_t)(p->steady + 1) : 0;
	if (p->steady >= CANOPEN_PAIRING_STEADY)
		p->unanswered = p->steady = 0;
	p->came = 0;
	p->doubted = false;
	if (p->unanswered < UINT8_MAX)
		p->unanswered++;
}

static bool fits(const struct canopen_pairing *p, int64_t delay_ns)
{
	const int64_t off_ns = delay_ns > p->delay_ns ? delay_ns - p->delay_ns : p->delay_ns - delay_ns;

	return off_ns <= p->delay_ns / 2 + NEAR_NS;
}

bool canopen_pairing_take(struct canopen_pairing *p, uint8_t every, int64_t delay_ns, int64_t period_ns)
{
	const bool overdue = delay_ns > period_ns, too_many = p->unanswered > every;
	const bool doubted = (too_many && !fits(p, delay_ns)) || (overdue && p->unanswered > 0);

	if (delay_ns < 0 || delay_ns > STATE_TIME_MAX / 4)
		return true; /* time itself went back: the caller judges that */
	if (p->came < UINT8_MAX)
		p->came++;
	if (!p->heard) {
		p->heard = true;
		p->unanswered = 0;
		p->delay_ns = delay_ns;
		return !overdue;
	}
	p->unanswered = doubted && too_many ? (uint8_t)(p->unanswered - every) : 0;
	p->doubted = doubted;
	if (!doubted && !overdue && p->came == 1)
		p->delay_ns += (delay_ns - p->delay_ns) / 8;
	return !doubted;
}

void canopen_pairing_state(struct state *s, struct canopen_pairing *p)
{
	state_bool(s, &p->heard);
	state_u8(s, &p->unanswered);
	state_u8(s, &p->came);
	state_u8(s, &p->steady);
	state_bool(s, &p->doubted);
	state_time(s, &p->delay_ns);
	s->failed |= s->loading && (p->delay_ns < 0 || p->delay_ns > STATE_TIME_MAX / 4);
}

/* A ring of reads, each with the count of bytes up to its end; reads of the same time are one. */
#include "drivers/arrivals.h"

static struct arrivals_read *read_at(struct arrivals *a, int i)
{
	return &a->read[(a->first + i) % ARRIVALS_MAX];
}

void arrivals_note(struct arrivals *a, size_t len, int64_t t_ns)
{
	a->bytes += len;
	if (a->n > 0 && read_at(a, a->n - 1)->t_ns == t_ns) {
		read_at(a, a->n - 1)->end = a->bytes;
		return;
	}
	if (a->n == ARRIVALS_MAX) {
		a->first = (a->first + 1) % ARRIVALS_MAX;
		a->n--;
	}
	*read_at(a, a->n++) = (struct arrivals_read){t_ns, a->bytes};
}

int64_t arrivals_at(const struct arrivals *a, uint64_t back)
{
	for (int i = 0; i < a->n; i++) {
		const struct arrivals_read *read = &a->read[(a->first + i) % ARRIVALS_MAX];

		if (a->bytes < back || read->end > a->bytes - back)
			return read->t_ns;
	}
	return 0;
}

void arrivals_state(struct state *s, struct arrivals *a)
{
	state_tag(s, "arrivals1");
	state_u64(s, &a->bytes);
	state_int(s, &a->first, 0, ARRIVALS_MAX - 1);
	state_int(s, &a->n, 0, ARRIVALS_MAX);
	for (int i = 0; i < ARRIVALS_MAX; i++) {
		state_time(s, &a->read[i].t_ns);
		state_u64(s, &a->read[i].end);
	}
}

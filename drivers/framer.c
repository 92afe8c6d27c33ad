/* Buffering and resync (see framer.h). The buffer is the parser's state: nothing is remembered about a telegram that
 * is not in its bytes, so a scan may be asked again about the same bytes and answers the same.
 *
 * A begun telegram is judged anew with every push. That is quadratic in the number of pushes of one telegram, but scans
 * look at the header first and check sums only when the end is there, so a push of a byte costs a few comparisons. */
#include "drivers/framer.h"

#include <assert.h>
#include <string.h>

void framer_init(struct framer *f, framer_scan *scan, void *ctx, uint8_t *buf, size_t cap)
{
	assert(buf != NULL && cap > 0);
	*f = (struct framer){.scan = scan, .ctx = ctx, .boundary = true, .buf = buf, .cap = cap};
}

size_t framer_push(struct framer *f, const uint8_t *bytes, size_t len)
{
	if (f->begin > 0) {
		memmove(f->buf, f->buf + f->begin, f->end - f->begin);
		f->end -= f->begin;
		f->silence -= f->silence < f->begin ? f->silence : f->begin;
		f->begin = 0;
	}
	const size_t room = f->cap - f->end;
	const size_t n = len < room ? len : room;
	if (n > 0)
		memcpy(f->buf + f->end, bytes, n);
	f->end += n;
	return n;
}

/* The false start costs one byte. */
static void framer_refuse(struct framer *f, int reason)
{
	assert(reason > 0 && reason < FRAMER_REASONS);
	f->refused[reason]++;
	f->skipped++;
	f->begin++;
	f->boundary = f->begin == f->silence;
}

size_t framer_take(struct framer *f, const uint8_t **ret_telegram)
{
	while (f->begin < f->end) {
		const size_t len = f->end - f->begin;
		const int r = f->scan(f->ctx, f->buf + f->begin, len, f->boundary);
		if (r > 0) {
			assert((size_t)r <= len);
			*ret_telegram = f->buf + f->begin;
			f->begin += (size_t)r;
			f->boundary = true;
			return (size_t)r;
		}
		const bool hopeless = f->begin < f->silence || len == f->cap;
		if (r == FRAMER_MORE && !hopeless)
			return 0;
		framer_refuse(f, r == FRAMER_MORE ? FRAMER_CUT : -r);
	}
	return 0;
}

void framer_silence(struct framer *f)
{
	f->silence = f->end;
	if (f->begin == f->end)
		f->boundary = true;
}

void framer_restart(struct framer *f)
{
	if (f->begin < f->end) {
		f->refused[FRAMER_CUT]++;
		f->skipped += f->end - f->begin;
	}
	f->begin = f->end = f->silence = 0;
	f->boundary = true;
}

void framer_state(struct state *s, struct framer *f)
{
	state_tag(s, "framer1");
	for (int i = 0; i < FRAMER_REASONS; i++)
		state_u64(s, &f->refused[i]);
	state_u64(s, &f->skipped);
	state_size(s, &f->end, f->cap);
	state_size(s, &f->begin, f->end);
	state_size(s, &f->silence, f->end);
	state_bool(s, &f->boundary);
	state_bytes(s, f->buf, s->failed ? 0 : f->end);
}

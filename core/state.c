/* See state.h. Every field is bytes in the end; integers go by eight of them whatever their width, for simplicity: a
 * snapshot is a few kilobytes a device and is written once a file. */
#include "core/state.h"

#include <assert.h>
#include <math.h>
#include <string.h>

#define TAG_MAX 16 /* with the closing 0 */

void state_save(struct state *s, void *bytes, size_t cap)
{
	*s = (struct state){.bytes = bytes, .cap = cap};
}

void state_load(struct state *s, const void *bytes, size_t len)
{
	*s = (struct state){.loading = true, .bytes = (uint8_t *)(uintptr_t)bytes, .cap = len};
}

bool state_done(const struct state *s)
{
	return s->loading ? !s->failed && s->at == s->cap : s->at <= s->cap;
}

void state_bytes(struct state *s, void *field, size_t len)
{
	const bool fits = s->at <= s->cap && len <= s->cap - s->at;

	if (s->loading && !fits)
		s->failed = true;
	if (s->failed)
		return;
	if (fits && len > 0 && s->loading)
		memcpy(field, s->bytes + s->at, len);
	else if (fits && len > 0)
		memcpy(s->bytes + s->at, field, len);
	s->at += len;
}

/* Both ways at once: saving writes `value`, loading answers what was there, or `value` where it failed. */
static uint64_t exchange(struct state *s, uint64_t value)
{
	uint8_t raw[8];

	for (int i = 0; i < 8; i++)
		raw[i] = (uint8_t)(value >> 8 * i);
	state_bytes(s, raw, sizeof(raw));
	if (!s->loading || s->failed)
		return value;
	value = 0;
	for (int i = 0; i < 8; i++)
		value |= (uint64_t)raw[i] << 8 * i;
	return value;
}

static uint64_t exchange_max(struct state *s, uint64_t field, uint64_t max)
{
	const uint64_t value = exchange(s, field);

	if (s->loading && value > max)
		s->failed = true;
	return s->failed ? field : value;
}

void state_u8(struct state *s, uint8_t *field)
{
	*field = (uint8_t)exchange_max(s, *field, UINT8_MAX);
}

void state_u16(struct state *s, uint16_t *field)
{
	*field = (uint16_t)exchange_max(s, *field, UINT16_MAX);
}

void state_u32(struct state *s, uint32_t *field)
{
	*field = (uint32_t)exchange_max(s, *field, UINT32_MAX);
}

void state_u64(struct state *s, uint64_t *field)
{
	*field = exchange(s, *field);
}

void state_i64(struct state *s, int64_t *field)
{
	*field = (int64_t)exchange(s, (uint64_t)*field);
}

void state_bool(struct state *s, bool *field)
{
	*field = exchange_max(s, *field, 1) != 0;
}

void state_int(struct state *s, int *field, int min, int max)
{
	const int64_t value = (int64_t)exchange(s, (uint64_t)(int64_t)*field);

	if (s->loading && (value < min || value > max))
		s->failed = true;
	if (!s->failed)
		*field = (int)value;
}

void state_size(struct state *s, size_t *field, size_t max)
{
	*field = (size_t)exchange_max(s, *field, max);
}

void state_time(struct state *s, int64_t *field)
{
	const int64_t value = (int64_t)exchange(s, (uint64_t)*field);

	if (s->loading && (value < STATE_TIME_MIN || value > STATE_TIME_MAX))
		s->failed = true;
	if (!s->failed)
		*field = value;
}

void state_float(struct state *s, float *field)
{
	uint32_t bits;
	uint8_t raw[4];

	memcpy(&bits, field, sizeof(bits));
	for (int i = 0; i < 4; i++)
		raw[i] = (uint8_t)(bits >> 8 * i);
	state_bytes(s, raw, sizeof(raw));
	bits = 0;
	for (int i = 0; i < 4; i++)
		bits |= (uint32_t)raw[i] << 8 * i;
	memcpy(field, &bits, sizeof(bits));
}

void state_double(struct state *s, double *field)
{
	uint64_t bits;
	double value;

	memcpy(&bits, field, sizeof(bits));
	bits = exchange(s, bits);
	memcpy(&value, &bits, sizeof(value));
	if (s->loading && !isfinite(value))
		s->failed = true;
	if (!s->failed)
		*field = value;
}

/* The closing 0 is part of it, so that "clock1" is no beginning of "clock10". */
void state_tag(struct state *s, const char *word)
{
	char found[TAG_MAX] = "";
	const size_t len = strlen(word) + 1;

	assert(len <= TAG_MAX);
	memcpy(found, word, len);
	state_bytes(s, found, len);
	if (s->loading && memcmp(found, word, len) != 0)
		s->failed = true;
}

/* Numbers in CAN frames; the numbering of bits is in the header. Bits are taken one by one: at some hundred frames a second
 * nothing is gained by taking bytes, and one loop serves both orders, every start and every length. */
#include "drivers/can_signal.h"

#include <math.h>
#include <string.h>

#define BYTES_MAX 64

const char *can_signal_name(enum can_signal_verdict verdict)
{
	static const char *const name[CAN_SIGNAL_VERDICTS] = {"good",  "foreign",   "errors",  "remote",
	                                                      "short", "other mux", "invalid", "no number"};

	return name[verdict];
}

/* The bit that has the weight below (motorola) or above (intel) the one at `bit`. */
static int next_bit(int order, int bit)
{
	if (order == SIGNAL_INTEL)
		return bit + 1;
	return bit % 8 ? bit - 1 : bit + 15;
}

/* Bytes that a field needs. */
static int bytes_of(int order, int start, int length)
{
	int to_end; /* bits from the first one to the end of its byte, in the direction of the field */

	if (order == SIGNAL_INTEL)
		return (start + length + 7) / 8;
	to_end = start % 8 + 1;
	return start / 8 + 1 + (length > to_end ? (length - to_end + 7) / 8 : 0);
}

static uint64_t take(const uint8_t *data, int order, int start, int length)
{
	uint64_t bits = 0;

	for (int i = 0, at = start; i < length; i++, at = next_bit(order, at)) {
		const uint64_t bit = data[at / 8] >> at % 8 & 1;

		bits |= bit << (order == SIGNAL_INTEL ? i : length - 1 - i);
	}
	return bits;
}

static void put(uint8_t *data, int order, int start, int length, uint64_t bits)
{
	for (int i = 0, at = start; i < length; i++, at = next_bit(order, at)) {
		const uint64_t bit = bits >> (order == SIGNAL_INTEL ? i : length - 1 - i) & 1;

		data[at / 8] = (uint8_t)((data[at / 8] & ~(1u << at % 8)) | (unsigned)bit << at % 8);
	}
}

static int larger(int a, int b)
{
	return a > b ? a : b;
}

int can_signal_needs(const struct config_signal *s)
{
	int bytes = larger(s->min_dlc, bytes_of((int)s->order, s->start, s->length));

	if (s->counter.set)
		bytes = larger(bytes, bytes_of((int)s->order, s->counter.start, s->counter.length));
	if (s->valid.set)
		bytes = larger(bytes, s->valid.bit / 8 + 1);
	if (s->mux.set)
		bytes = larger(bytes, bytes_of((int)s->order, s->mux.start, s->mux.length));
	return bytes;
}

/* NaN where the bits are no number. */
static double number_of(const struct config_signal *s, uint64_t bits)
{
	const uint64_t sign = UINT64_C(1) << (s->length - 1);
	const uint32_t low = (uint32_t)bits;
	double wide;
	float narrow;

	if (s->type == SIGNAL_UNSIGNED)
		return (double)bits;
	if (s->type == SIGNAL_SIGNED)
		return bits & sign ? -(double)((~bits & (sign - 1)) + 1) : (double)bits;
	if (s->length == 64) {
		memcpy(&wide, &bits, sizeof wide);
		return wide;
	}
	memcpy(&narrow, &low, sizeof narrow);
	return s->length == 32 ? (double)narrow : NAN;
}

/* Of this very frame: a number of 11 bits says nothing about the same number of 29. */
static enum can_signal_verdict judge(const struct config_signal *s, const struct can_frame_at *f)
{
	const uint32_t wanted = s->id | (s->extended ? CAN_WIRE_EXTENDED : 0);
	int needs;

	if (f->id == CAN_WIRE_LOST)
		return CAN_SIGNAL_FOREIGN;
	if (f->id & CAN_WIRE_ERROR)
		return CAN_SIGNAL_ERROR;
	if ((f->id & ~CAN_WIRE_REMOTE) != wanted)
		return CAN_SIGNAL_FOREIGN;
	if (f->id & CAN_WIRE_REMOTE)
		return CAN_SIGNAL_REMOTE;
	needs = can_signal_needs(s);
	return needs > BYTES_MAX || f->len < needs ? CAN_SIGNAL_SHORT : CAN_SIGNAL_GOOD;
}

enum can_signal_verdict can_signal_get(const struct config_signal *s, const struct can_frame_at *f,
                                       struct can_signal_value *ret)
{
	const int order = (int)s->order;
	const enum can_signal_verdict verdict = judge(s, f);
	struct can_signal_value v = {0};

	if (verdict != CAN_SIGNAL_GOOD)
		return verdict;
	if (s->mux.set && take(f->data, order, s->mux.start, s->mux.length) != (uint64_t)s->mux.value)
		return CAN_SIGNAL_OTHER_MUX;
	if (s->counter.set)
		v.counter = (uint32_t)take(f->data, order, s->counter.start, s->counter.length);
	v.bits = take(f->data, order, s->start, s->length);
	v.raw = number_of(s, v.bits);
	v.value = v.raw * s->scale + s->offset;
	if (s->valid.set && (f->data[s->valid.bit / 8] >> s->valid.bit % 8 & 1) != s->valid.value) {
		ret->counter = v.counter; /* it counts on */
		return CAN_SIGNAL_INVALID;
	}
	if (!isfinite(v.value)) {
		ret->counter = v.counter;
		return CAN_SIGNAL_NO_NUMBER;
	}
	*ret = v;
	return CAN_SIGNAL_GOOD;
}

void can_signal_follow(const struct config_signal *s, struct can_signal_counter *c, uint32_t counter)
{
	const uint32_t mask = s->counter.length < 32 ? (UINT32_C(1) << s->counter.length) - 1 : UINT32_MAX;

	if (!s->counter.set)
		return;
	if (c->known && counter == c->last)
		c->stuck++;
	else if (c->known)
		c->lost += (counter - c->last - 1) & mask;
	c->known = true;
	c->last = counter;
}

void can_signal_state(struct state *s, struct can_signal_counter *c)
{
	state_bool(s, &c->known);
	state_u32(s, &c->last);
	state_u64(s, &c->lost);
	state_u64(s, &c->stuck);
}

struct can_frame_at can_signal_frame(const struct config_signal *s)
{
	static const uint8_t fd_length[] = {8, 12, 16, 20, 24, 32, 48, 64};
	struct can_frame_at f = {.id = s->id | (s->extended ? CAN_WIRE_EXTENDED : 0)};
	const int needs = can_signal_needs(s);

	f.len = (uint8_t)(needs < BYTES_MAX ? needs : BYTES_MAX);
	if (f.len <= 8)
		return f;
	f.flags = CAN_WIRE_FD;
	for (size_t i = 0; i < sizeof fd_length; i++)
		if (fd_length[i] >= f.len) {
			f.len = fd_length[i];
			break;
		}
	return f;
}

/* The nearest number that the bits can say. */
static uint64_t bits_of(const struct config_signal *s, double raw)
{
	const double half = ldexp(1, s->length - 1), whole = ldexp(1, s->length);
	const float narrow = (float)raw;
	uint64_t bits = 0;
	uint32_t low;

	if (s->type == SIGNAL_FLOAT && s->length == 64) {
		memcpy(&bits, &raw, sizeof bits);
		return bits;
	}
	if (s->type == SIGNAL_FLOAT) {
		memcpy(&low, &narrow, sizeof low);
		return low;
	}
	raw = rint(raw);
	if (s->type == SIGNAL_UNSIGNED)
		return !(raw > 0) ? 0 : raw >= whole ? UINT64_MAX >> (64 - s->length) : (uint64_t)raw;
	if (!(raw >= -half))
		return UINT64_C(1) << (s->length - 1);
	return raw >= half ? (UINT64_C(1) << (s->length - 1)) - 1 : (uint64_t)(int64_t)raw;
}

void can_signal_put_bits(const struct config_signal *s, uint64_t bits, struct can_frame_at *f)
{
	const int order = (int)s->order;

	if (can_signal_needs(s) > f->len)
		return;
	put(f->data, order, s->start, s->length, bits);
	if (s->mux.set)
		put(f->data, order, s->mux.start, s->mux.length, (uint64_t)s->mux.value);
	if (s->valid.set)
		put(f->data, SIGNAL_INTEL, s->valid.bit, 1, (uint64_t)s->valid.value);
}

void can_signal_put(const struct config_signal *s, double value, struct can_frame_at *f)
{
	can_signal_put_bits(s, bits_of(s, (value - s->offset) / s->scale), f);
}

void can_signal_put_counter(const struct config_signal *s, uint32_t counter, struct can_frame_at *f)
{
	if (s->counter.set && can_signal_needs(s) <= f->len)
		put(f->data, (int)s->order, s->counter.start, s->counter.length, counter);
}

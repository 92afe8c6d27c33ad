/* Modbus transactions as bytes, and registers as angles: see modbus_wire.h for the layout.
 *
 * Four letters name the order in which the bytes of a 32-bit value lie in its two registers, A being the most
 * significant: ABCD (as the standard would have it), CDAB (halves swapped, very common), BADC (bytes swapped within the
 * halves), DCBA (both). Floats are put together here, because the helpers of libmodbus were wrong for three releases. */
#include "drivers/modbus_wire.h"

#include <errno.h>
#include <math.h>
#include <stdbool.h>
#include <string.h>

static void put16(uint8_t *p, uint16_t v)
{
	p[0] = (uint8_t)v;
	p[1] = (uint8_t)(v >> 8);
}

static void put64(uint8_t *p, int64_t v)
{
	for (int i = 0; i < 8; i++)
		p[i] = (uint8_t)((uint64_t)v >> (8 * i));
}

static uint16_t get16(const uint8_t *p)
{
	return (uint16_t)(p[0] | p[1] << 8);
}

static int64_t get64(const uint8_t *p)
{
	uint64_t v = 0;

	for (int i = 0; i < 8; i++)
		v |= (uint64_t)p[i] << (8 * i);
	return (int64_t)v;
}

size_t modbus_wire_put(const struct modbus_transaction *t, uint8_t *ret)
{
	put64(ret, t->t_request_ns);
	put64(ret + 8, t->t_answer_ns);
	ret[16] = t->unit;
	ret[17] = t->function;
	put16(ret + 18, t->address);
	put16(ret + 20, t->n);
	for (int i = 0; i < t->n; i++)
		put16(ret + MODBUS_WIRE_HEADER + 2 * i, t->value[i]);
	return MODBUS_WIRE_HEADER + 2 * (size_t)t->n;
}

static bool function_known(uint8_t function)
{
	switch (function & ~MODBUS_WIRE_REFUSED) {
	case 3:
	case 4:
	case 6:
	case 16:
		return true;
	}
	return false;
}

ssize_t modbus_wire_get(const uint8_t *bytes, size_t len, struct modbus_transaction *ret)
{
	struct modbus_transaction t;

	if (len < MODBUS_WIRE_HEADER)
		return 0;
	t.t_request_ns = get64(bytes);
	t.t_answer_ns = get64(bytes + 8);
	t.unit = bytes[16];
	t.function = bytes[17];
	t.address = get16(bytes + 18);
	t.n = get16(bytes + 20);
	if (t.unit < 1 || t.unit > 247 || !function_known(t.function) || t.n < 1 || t.n > MODBUS_WIRE_VALUES_MAX)
		return -EINVAL;
	if ((t.function & MODBUS_WIRE_REFUSED || t.function == 6) && t.n != 1)
		return -EINVAL;
	if (len < MODBUS_WIRE_HEADER + 2 * (size_t)t.n)
		return 0;
	for (int i = 0; i < t.n; i++)
		t.value[i] = get16(bytes + MODBUS_WIRE_HEADER + 2 * i);
	memcpy(ret, &t, offsetof(struct modbus_transaction, value) + sizeof t.value[0] * t.n);
	return MODBUS_WIRE_HEADER + 2 * (ssize_t)t.n;
}

static bool is_wide(const struct config_register *r)
{
	return r->type == REGISTER_I32 || r->type == REGISTER_U32 || r->type == REGISTER_F32;
}

int modbus_wire_registers(const struct config_register *r)
{
	return is_wide(r) ? 2 : 1;
}

static uint16_t swap_bytes(uint16_t v)
{
	return (uint16_t)(v << 8 | v >> 8);
}

/* One 16-bit value has bytes AB or BA; the orders that swap bytes within the halves hold for it too. */
static bool bytes_swapped(const struct config_register *r)
{
	return r->order == ORDER_BADC || r->order == ORDER_DCBA;
}

static uint32_t join(const struct config_register *r, const uint16_t *value)
{
	bool low_first = r->order == ORDER_CDAB || r->order == ORDER_DCBA;
	uint16_t high = value[low_first ? 1 : 0], low = value[low_first ? 0 : 1];

	if (bytes_swapped(r)) {
		high = swap_bytes(high);
		low = swap_bytes(low);
	}
	return (uint32_t)high << 16 | low;
}

static void split(const struct config_register *r, uint32_t raw, uint16_t ret_value[2])
{
	bool low_first = r->order == ORDER_CDAB || r->order == ORDER_DCBA;
	uint16_t high = (uint16_t)(raw >> 16), low = (uint16_t)raw;

	if (bytes_swapped(r)) {
		high = swap_bytes(high);
		low = swap_bytes(low);
	}
	ret_value[low_first ? 1 : 0] = high;
	ret_value[low_first ? 0 : 1] = low;
}

static double raw_float(uint32_t bits)
{
	float f;

	memcpy(&f, &bits, sizeof f);
	return f;
}

int modbus_wire_decode(const struct config_register *r, const uint16_t *value, double *ret)
{
	uint16_t narrow = bytes_swapped(r) ? swap_bytes(value[0]) : value[0];
	double raw = 0.0;

	switch (r->type) {
	case REGISTER_I16:
		raw = (int16_t)narrow;
		break;
	case REGISTER_U16:
		raw = narrow;
		break;
	case REGISTER_I32:
		raw = (int32_t)join(r, value);
		break;
	case REGISTER_U32:
		raw = join(r, value);
		break;
	case REGISTER_F32:
		raw = raw_float(join(r, value));
		break;
	}
	if (!isfinite(raw))
		return -ERANGE;
	*ret = r->sign * r->scale * (raw - r->zero);
	return 0;
}

static int encode_narrow(const struct config_register *r, double raw, uint16_t *ret)
{
	bool is_signed = r->type == REGISTER_I16;
	uint16_t v;

	if (raw < (is_signed ? INT16_MIN : 0) || raw > (is_signed ? INT16_MAX : UINT16_MAX))
		return -ERANGE;
	v = (uint16_t)(int32_t)raw;
	*ret = bytes_swapped(r) ? swap_bytes(v) : v;
	return 0;
}

int modbus_wire_encode(const struct config_register *r, double quantity, uint16_t ret_value[2])
{
	double raw = r->zero + quantity / (r->sign * r->scale);
	uint32_t bits;
	float f;

	if (!isfinite(raw))
		return -ERANGE;
	if (r->type == REGISTER_F32) {
		f = (float)raw;
		if (!isfinite(f))
			return -ERANGE;
		memcpy(&bits, &f, sizeof bits);
		split(r, bits, ret_value);
		return 0;
	}
	raw = rint(raw);
	if (!is_wide(r))
		return encode_narrow(r, raw, ret_value);
	if (raw < (r->type == REGISTER_I32 ? INT32_MIN : 0.0) ||
	    raw > (r->type == REGISTER_I32 ? INT32_MAX : UINT32_MAX))
		return -ERANGE;
	split(r, (uint32_t)(int64_t)raw, ret_value);
	return 0;
}

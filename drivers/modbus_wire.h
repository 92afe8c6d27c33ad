/* Modbus transactions as bytes, and registers as angles: pure (protocols D).
 *
 * One completed transaction is one record, in the layout of the recording channel `facetd.modbus.v1`, little-endian:
 *
 *    0      8        16    17        18       20  22
 *    +------+--------+-----+---------+--------+---+--------------+
 *    | i64  | i64    | u8  | u8      | u16    |u16| u16 [n]      |
 *    | t_req| t_answ | unit| function| address| n | registers    |
 *    +------+--------+-----+---------+--------+---+--------------+
 *
 *    t_req, t_answ   ns, before the request was sent and after the whole answer was there; 0 in a wish (TO_DEVICE)
 *    unit            Modbus unit, 1..247
 *    function        3, 4 read; 6, 16 write; + 0x80: the device refused, n = 1 and the register is its exception code
 *    address         as on the wire, counted from 0
 *    registers       what was read or written, each in the machine's sense (the wire's big-endian order is undone)
 *
 * A wish to write travels TO_DEVICE in the same layout; its answer comes back as a record FROM_DEVICE.
 *
 * Odd things in the field: 32-bit values come in all four orders of their bytes; both halves must be read in one request
 * or they tear; manuals count addresses from 1 (`address_base`); a late answer carries no number on a serial line. */
#ifndef FACET_DRIVERS_MODBUS_WIRE_H
#define FACET_DRIVERS_MODBUS_WIRE_H

#include <stddef.h>
#include <stdint.h>
#include <sys/types.h>

#include "config/config.h"

#define MODBUS_WIRE_HEADER     22
#define MODBUS_WIRE_VALUES_MAX 125 /* registers of one request, the standard's limit */
#define MODBUS_WIRE_MAX        (MODBUS_WIRE_HEADER + 2 * MODBUS_WIRE_VALUES_MAX)
#define MODBUS_WIRE_REFUSED    0x80 /* in `function` */

struct modbus_transaction {
	int64_t t_request_ns, t_answer_ns;
	uint8_t unit, function;
	uint16_t address, n;
	uint16_t value[MODBUS_WIRE_VALUES_MAX];
};

/* Length of the record that was written to `ret` (at least MODBUS_WIRE_MAX bytes). */
size_t modbus_wire_put(const struct modbus_transaction *, uint8_t *ret);

/* Length of the record at the start of `bytes`; 0: cut off; -EINVAL: no such transaction (function, unit, count). */
ssize_t modbus_wire_get(const uint8_t *bytes, size_t len, struct modbus_transaction *ret);

/* Function that reads this value: 3 unless 4 is asked for. */
static inline uint8_t modbus_wire_read_function(const struct config_register *r)
{
	return r->function == 4 ? 4 : 3;
}

/* Registers that a value of this kind takes: 1 or 2. */
int modbus_wire_registers(const struct config_register *);

/* Registers -> radians (or rad/s): sign * scale * (raw - zero). 0, or -ERANGE where a float register is not finite. */
int modbus_wire_decode(const struct config_register *, const uint16_t *value, double *ret);

/* Radians (or rad/s) -> registers, rounded to the nearest count. 0, or -ERANGE: the type cannot hold it; never clipped. */
int modbus_wire_encode(const struct config_register *, double quantity, uint16_t ret_value[2]);

/* Address as it goes over the wire. */
static inline uint16_t modbus_wire_address(const struct config_device *device, uint16_t address)
{
	return (uint16_t)(address - device->address_base);
}

#endif

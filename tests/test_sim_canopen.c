/* The simulated CANopen nodes answer as the standards say, byte for byte, and every fault that can be ordered befalls. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "drivers/can_wire.h"
#include "tests/captures.h"
#include "tools/sim_canopen.h"

#define DEG     TRIG_DEG
#define MS      INT64_C(1000000)
#define SECOND  INT64_C(1000000000)
#define NODE    2
#define HEARD   4096
#define NO_CODE 0xffffffffu

static struct {
	struct sim_device device;
	struct sim_axis *axis;
	int64_t t_ns;
	struct can_frame_at heard[HEARD]; /* what it sent */
	int n;
} bed;

static void collect(void)
{
	uint8_t buf[4096];
	size_t len;

	while ((len = bed.device.transmit(bed.device.ctx, buf, sizeof buf)) > 0)
		for (size_t at = 0; at < len; at += CAN_WIRE_ENTRY) {
			assert_true(bed.n < HEARD);
			assert_int_equal(can_wire_get(buf + at, len - at, &bed.heard[bed.n]), CAN_WIRE_ENTRY);
			bed.n++;
		}
}

static void run(int64_t for_ns)
{
	int64_t end_ns = bed.t_ns + for_ns;

	for (;;) {
		int64_t next_ns = bed.device.deadline(bed.device.ctx);

		if (next_ns > end_ns)
			break;
		assert_true(next_ns >= bed.t_ns);
		bed.t_ns = next_ns;
		bed.device.advance(bed.device.ctx, bed.t_ns);
		collect();
	}
	bed.t_ns = end_ns;
	bed.device.advance(bed.device.ctx, bed.t_ns);
	collect();
}

static void say(uint32_t id, const void *bytes, uint8_t len)
{
	struct can_frame_at frame = can_wire_frame(id, bytes, len);
	uint8_t entry[CAN_WIRE_ENTRY_FD];

	frame.t_ns = bed.t_ns;
	bed.device.receive(bed.device.ctx, entry, can_wire_put(&frame, entry), bed.t_ns);
	collect();
}

static void end(void)
{
	if (bed.device.destroy)
		bed.device.destroy(bed.device.ctx);
	memset(&bed, 0, sizeof bed);
}

static void begin_with(const struct sim_canopen_params *params)
{
	end();
	bed.t_ns = SECOND;
	assert_int_equal(sim_canopen_create(params, bed.t_ns, &bed.device), 0);
	bed.axis = sim_canopen_axis(&bed.device);
	run(50 * MS); /* it has booted */
}

static void begin(enum sim_canopen_kind kind)
{
	begin_with(&(struct sim_canopen_params){.kind = kind, .node = NODE, .factory = true});
}

/* The last frame of this id, NULL: none since mark `from`. */
static const struct can_frame_at *last(uint32_t id, int from)
{
	for (int i = bed.n - 1; i >= from; i--)
		if (bed.heard[i].id == id)
			return &bed.heard[i];
	return NULL;
}

static int count(uint32_t id, int from)
{
	int n = 0;

	for (int i = from; i < bed.n; i++)
		n += bed.heard[i].id == id;
	return n;
}

static int hex(const char *text, uint8_t *ret)
{
	int n = 0;
	unsigned byte;

	for (; sscanf(text, "%2x", &byte) == 1; text += 2)
		ret[n++] = (uint8_t)byte;
	return n;
}

/* "602#40..." is answered by "582#43...". */
static void exchange(const char *request, const char *answer)
{
	uint8_t bytes[8], want[8];
	int len = hex(request + 4, bytes), want_len = hex(answer + 4, want), from = bed.n;
	const struct can_frame_at *frame;

	say((uint32_t)strtoul(request, NULL, 16), bytes, (uint8_t)len);
	run(2 * MS);
	frame = last((uint32_t)strtoul(answer, NULL, 16), from);
	assert_non_null(frame);
	assert_int_equal(count(frame->id, from), 1);
	assert_int_equal(frame->len, want_len);
	assert_memory_equal(frame->data, want, (size_t)want_len);
}

static uint32_t number(const uint8_t *p)
{
	return p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
}

/* The abort code of an answer, 0: done, NO_CODE: no answer. */
static uint32_t ask(const uint8_t bytes[8], uint32_t *ret_value)
{
	int from = bed.n;
	const struct can_frame_at *frame;

	say(0x600 + NODE, bytes, 8);
	run(2 * MS);
	frame = last(0x580 + NODE, from);
	if (!frame)
		return NO_CODE;
	if (ret_value)
		*ret_value = number(frame->data + 4);
	return frame->data[0] == 0x80 ? number(frame->data + 4) : 0;
}

static uint32_t sdo_write(uint16_t index, uint8_t sub, uint32_t value, int width)
{
	uint8_t bytes[8] = {(uint8_t)(0x23 | (4 - width) << 2), (uint8_t)index, (uint8_t)(index >> 8), sub};

	for (int i = 0; i < width; i++)
		bytes[4 + i] = (uint8_t)(value >> (8 * i));
	return ask(bytes, NULL);
}

static uint32_t sdo_read(uint16_t index, uint8_t sub)
{
	uint8_t bytes[8] = {0x40, (uint8_t)index, (uint8_t)(index >> 8), sub};
	uint32_t value = 0;

	assert_int_equal(ask(bytes, &value), 0);
	return value;
}

static void nmt(uint8_t command)
{
	say(0, (const uint8_t[]){command, NODE}, 2);
	run(MS);
}

static void control(uint16_t word)
{
	assert_int_equal(sdo_write(0x6040, 0, word, 2), 0);
}

static uint16_t status(void)
{
	return (uint16_t)sdo_read(0x6041, 0);
}

static void assert_state(uint16_t mask, uint16_t bits)
{
	uint16_t word = status();

	if ((word & mask) != bits)
		fail_msg("statusword %04x, expected %04x under %04x", word, bits, mask);
}

static void enable(int8_t mode)
{
	assert_int_equal(sdo_write(0x6060, 0, (uint8_t)mode, 1), 0);
	control(0x06);
	control(0x07);
	control(0x0f);
	run(20 * MS);
	assert_state(0x6f, 0x27);
	assert_int_equal((int8_t)sdo_read(0x6061, 0), mode);
}

static void order(const char *kind, double value, int64_t for_ns, bool on)
{
	struct sim_fault fault = {.value = value, .for_ns = for_ns};

	snprintf(fault.kind, sizeof fault.kind, "%s", kind);
	assert_true(bed.device.fault(bed.device.ctx, &fault, on, bed.t_ns));
}

static double degrees(void)
{
	return sim_axis_angle(bed.axis, bed.t_ns) / DEG;
}

static void it_boots_and_obeys_nmt(void **state)
{
	int from;

	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	assert_int_equal(bed.n, 1);
	assert_int_equal(bed.heard[0].id, 0x702);
	assert_int_equal(bed.heard[0].len, 1);
	assert_int_equal(bed.heard[0].data[0], 0);
	assert_int_equal(sim_canopen_nmt_state(&bed.device), 0x7f);
	nmt(0x01);
	assert_int_equal(sim_canopen_nmt_state(&bed.device), 0x05);
	nmt(0x02);
	assert_int_equal(sim_canopen_nmt_state(&bed.device), 0x04);
	assert_int_equal(ask((const uint8_t[8]){0x40, 0x00, 0x10}, NULL), NO_CODE); /* stopped: no SDO */
	nmt(0x80);
	assert_int_equal(sdo_read(0x1000, 0), 0x00020192);
	say(0, (const uint8_t[]){0x01, NODE + 1}, 2); /* to another */
	say(0, (const uint8_t[]){0x01}, 1);           /* cut off */
	say(0x80000000u, (const uint8_t[]){0x01, NODE}, 2);
	assert_int_equal(sim_canopen_nmt_state(&bed.device), 0x7f);
	say(0, (const uint8_t[]){0x01, 0}, 2); /* to all */
	assert_int_equal(sim_canopen_nmt_state(&bed.device), 0x05);
	for (uint8_t reset = 0x81; reset <= 0x82; reset++) {
		from = bed.n;
		nmt(reset);
		run(50 * MS);
		assert_int_equal(count(0x702, from), 1);
		assert_int_equal(last(0x702, from)->data[0], 0);
		assert_int_equal(sim_canopen_nmt_state(&bed.device), 0x7f);
	}
}

/* The published examples, on objects that this node has (protocols C.3). */
static void sdo_examples_are_answered_byte_for_byte(void **state)
{
	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	exchange("602#4018100400000000", "582#4318100402000000");
	exchange("602#4000140200000000", "582#4F001402FF000000");
	exchange("602#2B171000A00F0000", "582#6017100000000000");
	exchange("602#4017100000000000", "582#4B171000A00F0000");
	exchange("602#23FE600100008001", "582#80FE600102000106");
	exchange("602#2B72600010270000", "582#8072600002000106");
	exchange("602#4002200000000000", "582#8002200000000206");
	exchange("602#4018100900000000", "582#8018100911000906");
	exchange("602#2F17100001000000", "582#8017100013000706"); /* too short */
	exchange("602#2317100001000000", "582#8017100012000706"); /* too long */
	exchange("602#2B60600001000000", "582#8060600012000706");
	exchange("602#2F60600005000000", "582#8060600030000906"); /* no such mode */
	exchange("602#2260600001000000", "582#6060600000000000"); /* size not said */
	exchange("602#A018100400000000", "582#8018100401000405"); /* block transfer */
	/* 26 bytes written and read in segments */
	exchange("602#210020001A000000", "582#6000200000000000");
	exchange("602#0054696E79204E6F", "582#2000000000000000");
	exchange("602#106465202D204D65", "582#3000000000000000");
	exchange("602#00676120446F6D61", "582#2000000000000000");
	exchange("602#15696E7320210000", "582#3000000000000000");
	exchange("602#4000200000000000", "582#410020001A000000");
	exchange("602#6000000000000000", "582#0054696E79204E6F");
	exchange("602#7000000000000000", "582#106465202D204D65");
	exchange("602#6000000000000000", "582#00676120446F6D61");
	exchange("602#7000000000000000", "582#15696E7320210000");
	exchange("602#6000000000000000", "582#8000200001000405"); /* there are no more */
	exchange("602#4008100000000000", "582#4108100015000000");
	exchange("602#7000000000000000", "582#8008100000000305"); /* toggle */
	exchange("602#210020000D000000", "582#6000200000000000");
	exchange("602#0041206C6F6E6720", "582#2000000000000000");
	exchange("602#13737472696E6700", "582#3000000000000000");
	exchange("602#210020000E000000", "582#6000200000000000"); /* 13 of 14 bytes */
	exchange("602#0041206C6F6E6720", "582#2000000000000000");
	exchange("602#13737472696E6700", "582#8000200010000706");
}

static void what_is_too_short_for_a_request_gets_no_answer(void **state)
{
	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	for (uint8_t len = 0; len < 8; len++)
		say(0x600 + NODE, (const uint8_t[8]){0x40, 0x00, 0x10}, len);
	run(10 * MS);
	assert_int_equal(bed.n, 1); /* the boot-up message */
	say(0x600 + NODE, (const uint8_t[8]){0x80, 0x00, 0x10}, 8);
	run(10 * MS);
	assert_int_equal(bed.n, 1);
}

/* The procedure of protocols C.2 and every wrong order of it. */
static void a_mapping_is_written_in_its_order_and_in_no_other(void **state)
{
	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	exchange("602#2F001A0000000000", "582#80001A0000000106"); /* while it exists */
	exchange("602#23001A0120006460", "582#80001A0100000106");
	exchange("602#2300180182010080", "582#6000180100000000");
	exchange("602#23001A0120006460", "582#80001A0100000106"); /* while its count is not 0 */
	exchange("602#2F001A0000000000", "582#60001A0000000000");
	exchange("602#23001A0120009962", "582#80001A0100000206"); /* no such object */
	exchange("602#23001A0120036460", "582#80001A0111000906"); /* no such sub-index */
	exchange("602#23001A0110006460", "582#80001A0141000406"); /* it has 32 bits */
	exchange("602#23001A0120007A60", "582#80001A0141000406"); /* cannot be sent */
	exchange("602#23001A0110004160", "582#60001A0100000000");
	exchange("602#23001A0220006460", "582#60001A0200000000");
	exchange("602#23001A0320006C60", "582#60001A0300000000");
	exchange("602#2F001A0003000000", "582#80001A0042000406"); /* 80 bits */
	exchange("602#2F001A0009000000", "582#80001A0042000406");
	exchange("602#2F001A0002000000", "582#60001A0000000000");
	exchange("602#2F001802FC000000", "582#8000180230000906"); /* types of remote requests */
	exchange("602#2F00180201000000", "582#6000180200000000");
	exchange("602#2300180102070000", "582#8000180130000906"); /* heartbeats live there */
	exchange("602#2300180182010020", "582#8000180130000906"); /* 29 bits */
	exchange("602#2300180182010000", "582#6000180100000000");
	exchange("602#2300180183010000", "582#8000180130000906"); /* it exists: its id stands */
	exchange("602#2B00180364000000", "582#8000180322000008");
	exchange("602#2B00180514000000", "582#6000180500000000");
	/* kept over NMT resets, lost with the power */
	nmt(0x81);
	run(50 * MS);
	assert_int_equal(sdo_read(0x1A00, 2), 0x60640020);
	order("power cycle", 0.2, 0, true);
	assert_false(bed.device.alive(bed.device.ctx));
	run(SECOND);
	assert_true(bed.device.alive(bed.device.ctx));
	assert_int_equal(sdo_read(0x1A00, 0), 1);
	begin_with(&(struct sim_canopen_params){.kind = SIM_CANOPEN_DRIVE, .node = NODE, .keeps = true});
	assert_int_equal(sdo_write(0x1800, 1, 0x80000182, 4), 0);
	order("power cycle", 0, 0, true);
	run(2 * SECOND);
	assert_int_equal(sdo_read(0x1800, 1), 0x80000182);
}

/* Statusword and position in PDO `pdo`, type as given; the target in RPDO 1, at the SYNC. */
static void map_cyclic(uint8_t type)
{
	assert_int_equal(sdo_write(0x1800, 1, 0x80000182, 4), 0);
	assert_int_equal(sdo_write(0x1800, 2, type, 1), 0);
	assert_int_equal(sdo_write(0x1A00, 0, 0, 1), 0);
	assert_int_equal(sdo_write(0x1A00, 1, 0x60410010, 4), 0);
	assert_int_equal(sdo_write(0x1A00, 2, 0x60640020, 4), 0);
	assert_int_equal(sdo_write(0x1A00, 0, 2, 1), 0);
	assert_int_equal(sdo_write(0x1800, 1, 0x182, 4), 0);
	assert_int_equal(sdo_write(0x1400, 1, 0x80000202, 4), 0);
	assert_int_equal(sdo_write(0x1400, 2, 1, 1), 0);
	assert_int_equal(sdo_write(0x1600, 0, 0, 1), 0);
	assert_int_equal(sdo_write(0x1600, 1, 0x60400010, 4), 0);
	assert_int_equal(sdo_write(0x1600, 2, 0x607A0020, 4), 0);
	assert_int_equal(sdo_write(0x1600, 0, 2, 1), 0);
	assert_int_equal(sdo_write(0x1400, 1, 0x202, 4), 0);
	assert_int_equal(sdo_write(0x1801, 1, 0x80000282, 4), 0); /* its factory's is of no use */
}

static void say_sync(void)
{
	say(0x80, NULL, 0);
}

static int32_t position_in(const struct can_frame_at *frame)
{
	assert_non_null(frame);
	assert_int_equal(frame->len, 6);
	return (int32_t)number(frame->data + 2);
}

static void a_sync_samples_at_its_own_time_even_when_it_is_heard_late(void **state)
{
	struct can_frame_at frame = can_wire_frame(0x80, NULL, 0);
	uint8_t entry[CAN_WIRE_ENTRY];
	int from;

	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	map_cyclic(2);
	nmt(0x01);
	sim_axis_velocity(bed.axis, 30 * DEG, 0, bed.t_ns);
	run(100 * MS);
	from = bed.n;
	frame.t_ns = bed.t_ns - 7 * MS;
	can_wire_put(&frame, entry);
	bed.device.receive(bed.device.ctx, entry, sizeof entry, bed.t_ns);
	run(5 * MS);
	assert_int_equal(bed.n, from); /* every second one */
	frame.t_ns = bed.t_ns - 4 * MS;
	can_wire_put(&frame, entry);
	bed.device.receive(bed.device.ctx, entry, sizeof entry, bed.t_ns);
	run(5 * MS);
	assert_int_equal(count(0x182, from), 1);
	assert_int_equal(position_in(last(0x182, from)),
	                 (int32_t)rint(sim_axis_angle(bed.axis, frame.t_ns) / DEG * 1000));
	assert_true(last(0x182, from)->t_ns > frame.t_ns + 4 * MS);
	nmt(0x80); /* pre-operational: no process data */
	from = bed.n;
	say_sync();
	say_sync();
	run(10 * MS);
	assert_int_equal(bed.n, from);
}

static void process_data_by_event_come_when_something_changes_and_by_their_timer(void **state)
{
	int from;

	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	from = bed.n;
	nmt(0x01);
	assert_int_equal(count(0x182, from), 1); /* once at the start */
	assert_int_equal(last(0x182, from)->data[0] & 0x4f, 0x40);
	run(SECOND);
	assert_int_equal(count(0x182, from), 1);
	control(0x06);
	run(10 * MS);
	assert_int_equal(count(0x182, from), 2);
	assert_int_equal(last(0x182, from)->data[0] & 0x6f, 0x21);
	assert_int_equal(sdo_write(0x1800, 5, 100, 2), 0);
	from = bed.n;
	run(SECOND);
	assert_in_range(count(0x182, from), 9, 11);
	assert_int_equal(sdo_write(0x1800, 1, 0x80000182, 4), 0);
	assert_int_equal(sdo_write(0x1800, 3, 5000, 2), 0); /* half a second between two */
	assert_int_equal(sdo_write(0x1800, 1, 0x182, 4), 0);
	from = bed.n;
	run(2 * SECOND);
	assert_in_range(count(0x182, from), 3, 5);
}

/* Every state and every command: CiA 402's table. D: switch on disabled, R: ready, S: switched on, E: enabled, Q. */
static void the_state_machine_is_the_standards(void **state)
{
	static const struct {
		char from;
		uint16_t word;
		uint16_t mask, bits;
	} row[] = {
	    {'D', 0x00, 0x4f, 0x40}, {'D', 0x06, 0x6f, 0x21}, {'D', 0x07, 0x4f, 0x40}, {'D', 0x0f, 0x4f, 0x40},
	    {'D', 0x02, 0x4f, 0x40}, {'R', 0x00, 0x4f, 0x40}, {'R', 0x06, 0x6f, 0x21}, {'R', 0x07, 0x6f, 0x23},
	    {'R', 0x0f, 0x6f, 0x27}, {'R', 0x02, 0x4f, 0x40}, {'S', 0x00, 0x4f, 0x40}, {'S', 0x06, 0x6f, 0x21},
	    {'S', 0x07, 0x6f, 0x23}, {'S', 0x0f, 0x6f, 0x27}, {'S', 0x02, 0x4f, 0x40}, {'E', 0x00, 0x4f, 0x40},
	    {'E', 0x06, 0x6f, 0x21}, {'E', 0x07, 0x6f, 0x23}, {'E', 0x0f, 0x6f, 0x27}, {'E', 0x02, 0x6f, 0x07},
	    {'Q', 0x00, 0x4f, 0x40}, {'Q', 0x0f, 0x6f, 0x27}, {'Q', 0x06, 0x6f, 0x07}, {'Q', 0x07, 0x6f, 0x07},
	};

	(void)state;
	for (size_t i = 0; i < sizeof row / sizeof *row; i++) {
		begin(SIM_CANOPEN_DRIVE);
		assert_int_equal(sdo_write(0x605A, 0, 6, 2), 0); /* it stays in quick stop */
		assert_int_equal(sdo_write(0x6060, 0, 1, 1), 0);
		if (row[i].from != 'D')
			control(0x06);
		if (row[i].from != 'D' && row[i].from != 'R')
			control(0x07);
		if (row[i].from == 'E' || row[i].from == 'Q')
			control(0x0f);
		run(20 * MS);
		if (row[i].from == 'Q')
			control(0x02);
		control(row[i].word);
		run(20 * MS);
		assert_state(row[i].mask, row[i].bits);
	}
}

static void a_fault_is_left_by_a_rising_edge_only_and_not_while_it_lasts(void **state)
{
	int from;

	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	enable(1);
	from = bed.n;
	order("fault", 0, 0, true);
	run(10 * MS);
	assert_state(0x4f, 0x08);
	assert_int_equal(sdo_read(0x603F, 0) & 0xffff, 0x4310);
	assert_int_equal(count(0x082, from), 1);
	assert_memory_equal(last(0x082, from)->data, ((const uint8_t[8]){0x10, 0x43, 0x01}), 8);
	control(0x0f);
	assert_state(0x4f, 0x08);
	control(0x80);
	assert_state(0x4f, 0x40);
	assert_memory_equal(last(0x082, from)->data, ((const uint8_t[8]){0}), 8);
	assert_int_equal(sdo_read(0x603F, 0) & 0xffff, 0);
	control(0x80); /* no edge */
	order("fault", 0x5530, SECOND, true);
	run(MS);
	control(0x80);
	assert_state(0x4f, 0x08);
	control(0x00);
	control(0x80);
	assert_state(0x4f, 0x08); /* it stays */
	order("fault", 0, SECOND, false);
	control(0x80);
	assert_state(0x4f, 0x08);
	control(0x00);
	control(0x80);
	assert_state(0x4f, 0x40);
}

static void profile_position_goes_where_it_is_sent_and_shakes_hands(void **state)
{
	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	assert_int_equal(sdo_write(0x6081, 0, 30000, 4), 0);
	assert_int_equal(sdo_write(0x6083, 0, 300000, 4), 0);
	assert_int_equal(sdo_write(0x6084, 0, 300000, 4), 0);
	enable(1);
	assert_int_equal(sdo_write(0x607A, 0, (uint32_t)-20000, 4), 0);
	assert_state(0x1400, 0x0400); /* it stands where it was enabled */
	control(0x1f);
	assert_state(0x1400, 0x1000);
	control(0x0f);
	assert_state(0x1400, 0x0000);
	run(SECOND);
	assert_state(0x1400, 0x0400);
	assert_true(fabs(degrees() + 20.0) < 1e-9);
	assert_int_equal((int32_t)sdo_read(0x6064, 0), -20000);
	/* relative, and a second one that waits */
	assert_int_equal(sdo_write(0x607A, 0, 5000, 4), 0);
	control(0x5f);
	control(0x0f);
	assert_int_equal(sdo_write(0x607A, 0, 10000, 4), 0);
	control(0x1f);
	control(0x0f);
	assert_state(0x1400, 0x1000); /* not taken yet */
	run(300 * MS);
	assert_state(0x1000, 0x0000);
	run(2 * SECOND);
	assert_true(fabs(degrees() - 10.0) < 1e-9);
	/* at once */
	assert_int_equal(sdo_write(0x607A, 0, 50000, 4), 0);
	control(0x1f);
	control(0x0f);
	run(300 * MS);
	assert_int_equal(sdo_write(0x607A, 0, 0, 4), 0);
	control(0x3f);
	control(0x0f);
	run(2 * SECOND);
	assert_true(fabs(degrees()) < 1e-9);
	/* halt, and on */
	assert_int_equal(sdo_write(0x607A, 0, 60000, 4), 0);
	control(0x1f);
	run(500 * MS);
	control(0x11f);
	run(500 * MS);
	assert_state(0x0400, 0x0400);
	double there = degrees();

	assert_true(there > 5.0 && there < 40.0);
	control(0x0f);
	run(4 * SECOND);
	assert_true(fabs(degrees() - 60.0) < 1e-9);
}

static void set_point(int32_t target)
{
	assert_int_equal(sdo_write(0x607A, 0, (uint32_t)target, 4), 0);
	control(0x1f);
	control(0x0f);
}

static void a_third_set_point_is_not_taken_while_the_second_waits(void **state)
{
	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	enable(1);
	set_point(5000);
	set_point(7000);
	set_point(9000);
	run(5 * SECOND);
	assert_true(fabs(degrees() - 7.0) < 1e-9);
}

static void no_speed_is_above_that_of_607F(void **state)
{
	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	assert_int_equal(sdo_write(0x6081, 0, 80000, 4), 0);
	assert_int_equal(sdo_write(0x607F, 0, 20000, 4), 0);
	enable(1);
	set_point(60000);
	run(SECOND);
	assert_true(fabs(sim_axis_speed(bed.axis, bed.t_ns) / DEG - 20.0) < 1e-9);
	assert_int_equal(sdo_write(0x6060, 0, 3, 1), 0);
	assert_int_equal(sdo_write(0x60FF, 0, (uint32_t)-80000, 4), 0);
	run(SECOND);
	assert_true(fabs(sim_axis_speed(bed.axis, bed.t_ns) / DEG + 20.0) < 1e-9);
}

/* Word and target in one frame, in that order: the target is the one that came with the edge. */
static void a_control_word_acts_with_the_target_that_came_with_it(void **state)
{
	static const uint16_t words[] = {0x0f, 0x1f, 0x0f, 0x1f};
	static const int32_t targets[] = {3000, 4000, 9000, 8000};

	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	map_cyclic(1);
	assert_int_equal(sdo_write(0x1400, 2, 255, 1), 0);
	nmt(0x01);
	enable(1);
	for (int i = 0; i < 4; i++) {
		uint8_t bytes[6] = {(uint8_t)words[i], 0, (uint8_t)targets[i], (uint8_t)(targets[i] >> 8)};

		say(0x202, bytes, sizeof bytes);
		run(2 * SECOND);
		if (i % 2)
			assert_true(fabs(degrees() * 1000 - targets[i]) < 1e-6);
	}
}

static void soft_limits_clip_targets_and_say_so(void **state)
{
	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	assert_int_equal(sdo_write(0x607D, 1, (uint32_t)-30000, 4), 0);
	assert_int_equal(sdo_write(0x607D, 2, 40000, 4), 0);
	assert_int_equal(sdo_write(0x6081, 0, 60000, 4), 0);
	enable(1);
	assert_int_equal(sdo_write(0x607A, 0, 50000, 4), 0);
	control(0x1f);
	run(3 * SECOND);
	assert_true(fabs(degrees() - 40.0) < 1e-9);
	assert_state(0x0800, 0x0800);
	control(0x0f);
	assert_int_equal(sdo_write(0x607A, 0, 0, 4), 0);
	control(0x1f);
	run(3 * SECOND);
	assert_state(0x0800, 0x0000);
	assert_int_equal(sdo_write(0x6060, 0, 3, 1), 0);
	assert_int_equal(sdo_write(0x60FF, 0, (uint32_t)-20000, 4), 0);
	run(500 * MS);
	assert_true(fabs(sim_axis_speed(bed.axis, bed.t_ns) / DEG + 20.0) < 1e-9);
	assert_state(0x0c00, 0x0400);
	run(3 * SECOND);
	assert_true(fabs(degrees() + 30.0) < 1e-9); /* a velocity ends at the limit */
	assert_state(0x0800, 0x0800);
	assert_int_equal(sdo_write(0x60FF, 0, 0, 4), 0);
	run(SECOND);
	assert_state(0x1400, 0x1400);
}

/* One cycle: the target for it, then its SYNC. */
static void cycle(uint16_t word, int32_t target)
{
	uint8_t bytes[6] = {(uint8_t)word, (uint8_t)(word >> 8)};

	for (int i = 0; i < 4; i++)
		bytes[2 + i] = (uint8_t)((uint32_t)target >> (8 * i));
	say(0x202, bytes, sizeof bytes);
	run(MS);
	say_sync();
	run(9 * MS);
}

static void begin_cyclic(void)
{
	begin(SIM_CANOPEN_DRIVE);
	map_cyclic(1);
	assert_int_equal(sdo_write(0x60C2, 1, 10, 1), 0);
	assert_int_equal(sdo_write(0x6060, 0, 8, 1), 0);
	nmt(0x01);
	cycle(0x06, 0);
	cycle(0x07, 0);
	for (int i = 0; i < 5; i++)
		cycle(0x0f, 0);
	assert_int_equal(sim_canopen_status_word(&bed.device) & 0x106f, 0x1027);
}

static void cyclic_positions_are_reached_a_cycle_after_their_sync(void **state)
{
	double worst = 0;

	(void)state;
	begin_cyclic();
	for (int i = 1; i <= 300; i++) { /* 37.5 degrees/s */
		cycle(0x0f, 375 * i);
		worst = fmax(worst, fabs(sim_axis_angle(bed.axis, bed.t_ns + MS) / DEG - 0.375 * i));
		if (i > 1)
			assert_int_equal(position_in(last(0x182, 0)), 375 * (i - 1)); /* as it was at the SYNC */
	}
	assert_true(worst < 1e-6);
	for (int i = 0; i < 3; i++)
		say_sync(), run(10 * MS); /* no targets: it stands */
	assert_true(sim_axis_speed(bed.axis, bed.t_ns) == 0.0);
	assert_int_equal(sim_canopen_status_word(&bed.device) & 0x6f, 0x27);
	cycle(0x0f, 0); /* over 100 degrees in a cycle */
	for (int i = 0; i < 5; i++)
		cycle(0x0f, 0);
	run(200 * MS); /* from 90 degrees/s to rest */
	assert_int_equal(sim_canopen_status_word(&bed.device) & 0x4f, 0x08);
	assert_int_equal(sdo_read(0x603F, 0) & 0xffff, 0x8611);
	assert_true(degrees() > 100.0);
}

static void an_axis_that_does_not_follow_is_a_fault_in_every_mode(void **state)
{
	int from;

	(void)state;
	for (int slow = 0; slow < 2; slow++) {
		begin(SIM_CANOPEN_DRIVE);
		assert_int_equal(sdo_write(0x6081, 0, 30000, 4), 0);
		enable(1);
		from = bed.n;
		assert_int_equal(sdo_write(0x607A, 0, 60000, 4), 0);
		order(slow ? "slow" : "stuck", 0, SECOND, true);
		control(0x1f);
		run(100 * MS);
		assert_state(0x4f | 0x2000, 0x07);
		run(SECOND);
		assert_state(0x4f, 0x08);
		assert_int_equal(number(last(0x082, from)->data) & 0xffff, 0x8611);
		order(slow ? "slow" : "stuck", 0, SECOND, false);
		run(SECOND);
		double there = degrees();

		assert_true(there < 15.0); /* it does not catch up */
		control(0x00);
		control(0x80);
		enable(1);
		assert_true(degrees() == there);
	}
	begin_cyclic();
	order("stuck", 0, SECOND, true);
	for (int i = 1; i < 40; i++)
		cycle(0x0f, 375 * i);
	assert_int_equal(sim_canopen_status_word(&bed.device) & 0x4f, 0x08);
	begin(SIM_CANOPEN_DRIVE);
	enable(3);
	order("stuck", 0, SECOND, true);
	assert_int_equal(sdo_write(0x60FF, 0, 30000, 4), 0);
	run(SECOND);
	assert_state(0x4f, 0x08);
}

static void homing_ends_at_home_or_with_an_error(void **state)
{
	(void)state;
	for (uint8_t method = 35; method <= 37; method += 2) {
		begin_with(&(struct sim_canopen_params){
		    .kind = SIM_CANOPEN_DRIVE, .node = NODE, .angle_rad = 12 * DEG, .unhomed = true});
		assert_int_equal((int32_t)sdo_read(0x6064, 0), 0); /* it counts from where it was switched on */
		assert_int_equal(sdo_write(0x6098, 0, method, 1), 0);
		assert_int_equal(sdo_write(0x607C, 0, 5000, 4), 0);
		enable(6);
		assert_state(0x3400, 0x0400);
		control(0x1f);
		assert_state(0x3400, 0x0000);
		run(100 * MS);
		assert_state(0x3400, 0x1400);
		assert_int_equal((int32_t)sdo_read(0x6064, 0), 5000);
		assert_true(fabs(degrees() - 12.0) < 1e-9);
	}
	assert_int_equal(sdo_write(0x6098, 0, 3, 1), 0x06090030);
	control(0x0f);
	order("homing", 0, 0, true);
	control(0x1f);
	run(100 * MS);
	assert_state(0x3400, 0x2400);
	control(0x0f);
	control(0x1f);
	run(100 * MS);
	assert_state(0x3400, 0x1400); /* it was ordered once */
}

static void homing_at_a_limit_switch_goes_there_and_a_little_back(void **state)
{
	(void)state;
	for (int sign = -1; sign <= 1; sign += 2)
		for (uint8_t method = 17; method <= 18; method++) {
			double edge = (method == 18) == (sign > 0) ? 60.0 : -70.0;

			begin_with(&(struct sim_canopen_params){.kind = SIM_CANOPEN_DRIVE,
			                                        .node = NODE,
			                                        .sign = sign,
			                                        .unhomed = true,
			                                        .switch_rad = {-70 * DEG, 60 * DEG}});
			assert_int_equal(sdo_write(0x6098, 0, method, 1), 0);
			assert_int_equal(sdo_write(0x6099, 1, 20000, 4), 0);
			assert_int_equal(sdo_write(0x607C, 0, 1000, 4), 0);
			enable(6);
			control(0x1f);
			run(SECOND);
			assert_state(0x3400, 0x0000);
			run(8 * SECOND);
			assert_state(0x3400, 0x1400);
			assert_true(fabs(fabs(degrees() - edge) - 1.0) < 1e-6 && fabs(degrees()) < fabs(edge));
			assert_int_equal((int32_t)sdo_read(0x6064, 0),
			                 (int32_t)rint((degrees() - edge) * sign * 1000) + 1000);
		}
	/* broken off */
	control(0x0f);
	control(0x1f);
	run(100 * MS);
	control(0x0f);
	run(SECOND);
	assert_state(0x3400, 0x0400);
}

static void heartbeat_of(uint8_t node)
{
	say(0x700u + node, (const uint8_t[]){5}, 1);
}

/* The documented time: that of 1016, and the ramp of 6085. */
static void without_its_masters_heartbeat_the_drive_stops_by_itself(void **state)
{
	static const struct {
		uint16_t option;
		uint16_t mask, bits;
	} row[] = {{1, 0x4f, 0x08}, {2, 0x4f, 0x40}, {3, 0x4f, 0x40}};

	(void)state;
	for (int i = -1; i < 3; i++) {
		int from;
		int64_t lost_ns, stop_ns;

		begin(SIM_CANOPEN_DRIVE);
		assert_int_equal(sdo_write(0x1016, 1, 0x7f0000 | 600, 4), 0);
		assert_int_equal(sdo_write(0x6085, 0, 300000, 4), 0);
		if (i >= 0)
			assert_int_equal(sdo_write(0x6007, 0, row[i].option, 2), 0);
		nmt(0x01);
		enable(3);
		assert_int_equal(sdo_write(0x60FF, 0, 30000, 4), 0);
		for (int k = 0; k < 10; k++) {
			heartbeat_of(0x7f);
			heartbeat_of(0x05); /* somebody else's counts for nothing */
			run(200 * MS);
		}
		lost_ns = bed.t_ns - 200 * MS;
		from = bed.n;
		assert_true(sim_axis_speed(bed.axis, bed.t_ns) > 29 * DEG);
		run(2 * SECOND);
		assert_memory_equal(last(0x082, from)->data, ((const uint8_t[2]){0x30, 0x81}), 2);
		assert_int_equal(sim_canopen_nmt_state(&bed.device), 0x7f); /* 1029 */
		if (i < 0) {
			assert_true(sim_axis_speed(bed.axis, bed.t_ns) > 29 * DEG); /* nobody told it to stop */
			continue;
		}
		stop_ns = sim_axis_arrival_ns(bed.axis);
		assert_in_range(stop_ns - lost_ns, 700 * MS - MS, 700 * MS + MS);
		assert_state(row[i].mask, row[i].bits);
		from = bed.n;
		heartbeat_of(0x7f);
		run(100 * MS);
		assert_int_equal(count(0x082, from), row[i].option != 1); /* back; a fault stays */
	}
}

static void its_heartbeat_comes_every_period_with_its_state(void **state)
{
	int from;

	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	assert_int_equal(sdo_write(0x1017, 0, 100, 2), 0);
	from = bed.n;
	run(SECOND);
	assert_int_equal(count(0x702, from), 10);
	assert_int_equal(last(0x702, from)->data[0], 0x7f);
	nmt(0x01);
	run(200 * MS);
	assert_int_equal(last(0x702, from)->data[0], 0x05);
	order("heartbeat", 0, SECOND, true);
	from = bed.n;
	run(SECOND);
	assert_int_equal(count(0x702, from), 0);
	assert_int_equal(sdo_read(0x1017, 0) & 0xffff, 100); /* it lives */
	order("heartbeat", 0, SECOND, false);
	run(SECOND);
	assert_in_range(count(0x702, from), 9, 11);
	assert_int_equal(sdo_write(0x1017, 0, 0, 2), 0);
	from = bed.n;
	run(SECOND);
	assert_int_equal(bed.n, from);
}

static void faults_of_the_sdo_server_befall_when_ordered(void **state)
{
	static const uint8_t read[8] = {0x40, 0x17, 0x10};
	int from;

	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	order("sdo timeout", 0, 0, true);
	assert_int_equal(ask(read, NULL), NO_CODE);
	assert_int_equal(ask(read, NULL), 0);
	order("sdo abort", 0x1A00, SECOND, true);
	assert_int_equal(ask(read, NULL), 0);
	assert_int_equal(sdo_write(0x1A00, 0, 0, 1), 0x08000022);
	order("sdo abort", 0, SECOND, false);
	order("sdo abort", 0, 0, true);
	assert_int_equal(ask(read, NULL), 0x08000022);
	assert_int_equal(ask(read, NULL), 0);
	order("sdo echo", 0, 0, true);
	exchange("602#2B171000A00F0000", "582#60171000A00F0000");
	order("sdo short", 0, SECOND, true);
	exchange("602#2B171000A00F0000", "582#60171000");
	exchange("602#4000140200000000", "582#4F001402FF");
	order("sdo short", 0, SECOND, false);
	order("silent", 0, SECOND, true);
	from = bed.n;
	assert_int_equal(ask(read, NULL), NO_CODE);
	order("silent", 0, SECOND, false);
	assert_int_equal(bed.n, from);
	order("emcy", 0x3210, 0, true);
	run(MS);
	assert_memory_equal(last(0x082, from)->data, ((const uint8_t[2]){0x10, 0x32}), 2);
}

static void faults_of_process_data_befall_when_ordered(void **state)
{
	int from;
	int64_t sync_ns;

	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	map_cyclic(1);
	nmt(0x01);
	from = bed.n;
	order("no pdo", 0, SECOND, true);
	say_sync();
	run(10 * MS);
	assert_int_equal(count(0x182, from), 0);
	order("no pdo", 0, SECOND, false);
	order("late", 7, 0, true);
	sync_ns = bed.t_ns;
	say_sync();
	run(20 * MS);
	assert_int_equal(count(0x182, from), 1);
	assert_true(last(0x182, from)->t_ns >= sync_ns + 7 * MS);
	say(0x202, (const uint8_t[]){6, 0}, 2); /* shorter than what is mapped */
	run(MS);
	assert_memory_equal(last(0x082, from)->data, ((const uint8_t[2]){0x10, 0x82}), 2);
	order("mapping", 0, 0, true);
	from = bed.n;
	for (int i = 0; i < 10; i++)
		say_sync(), run(10 * MS);
	assert_int_equal(position_in(&(struct can_frame_at){.len = 6}), 0);
	for (int i = from; i < bed.n; i++)
		assert_int_not_equal(bed.heard[i].len, 6);
}

static void without_power_nothing_is_heard_of_it_and_it_boots_when_it_is_back(void **state)
{
	int from;

	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	assert_int_equal(sdo_write(0x1017, 0, 100, 2), 0);
	enable(3);
	assert_int_equal(sdo_write(0x60FF, 0, 30000, 4), 0);
	run(SECOND);
	from = bed.n;
	order("off", 0, SECOND, true);
	assert_int_equal(sim_canopen_nmt_state(&bed.device), 0);
	run(3 * SECOND);
	assert_int_equal(bed.n, from);
	assert_true(sim_axis_speed(bed.axis, bed.t_ns) == 0.0);
	order("off", 0, SECOND, false);
	run(100 * MS);
	assert_int_equal(bed.n, from + 1);
	assert_int_equal(bed.heard[from].id, 0x702);
	assert_state(0x4f, 0x40);
	assert_int_equal(sdo_read(0x1017, 0) & 0xffff, 0);
}

static void an_encoder_counts_modulo_its_range(void **state)
{
	int from;

	(void)state;
	begin(SIM_CANOPEN_ENCODER);
	assert_int_equal(sdo_read(0x1000, 0) & 0xffff, 0x0196);
	assert_int_equal(sdo_read(0x6001, 0), 360000);
	sim_axis_place(bed.axis, -10 * DEG, bed.t_ns);
	assert_int_equal(sdo_read(0x6004, 0), 360000u * 4096 - 10000);
	assert_int_equal(sdo_write(0x6002, 0, 360000, 4), 0);
	assert_int_equal(sdo_read(0x6004, 0), 350000);
	assert_int_equal(sdo_write(0x6000, 0, 1, 2), 0);
	assert_int_equal(sdo_read(0x6004, 0), 10000);
	assert_int_equal(sdo_write(0x6003, 0, 100000, 4), 0);
	assert_int_equal(sdo_read(0x6004, 0), 100000);
	sim_axis_velocity(bed.axis, 10 * DEG, 0, bed.t_ns);
	assert_int_equal(sdo_write(0x6003, 0, 0, 4), 0x08000022);
	from = bed.n;
	nmt(0x01);
	assert_int_equal(sdo_write(0x6200, 0, 20, 2), 0);
	assert_int_equal(sdo_read(0x1800, 5) & 0xffff, 20);
	for (int i = 0; i < 10; i++)
		say_sync(), run(10 * MS);
	assert_in_range(count(0x182, from), 10, 30); /* it moves: by event; and by the timer */
	assert_int_equal(count(0x282, from), 10);    /* by SYNC */
	assert_int_equal(last(0x282, from)->len, 4);
	assert_int_equal(sdo_write(0x1800, 1, 0x80000182, 4), 0x06090030); /* no remote requests: bit 30 */
	assert_int_equal(sdo_write(0x1800, 1, 0xC0000182, 4), 0);
}

static void an_inclinometer_measures_in_its_resolution(void **state)
{
	int from;

	(void)state;
	begin(SIM_CANOPEN_INCLINOMETER);
	assert_int_equal(sdo_read(0x1000, 0) & 0xffff, 0x019A);
	sim_axis_place(bed.axis, -45.678 * DEG, bed.t_ns);
	assert_int_equal((int16_t)sdo_read(0x6010, 0), -4568);
	assert_int_equal(sdo_write(0x6000, 0, 1, 2), 0);
	assert_int_equal((int16_t)sdo_read(0x6010, 0), INT16_MIN); /* it does not fit */
	assert_int_equal((int32_t)sdo_read(0x6110, 0), -45678);
	assert_int_equal(sdo_write(0x6000, 0, 50, 2), 0x06090030);
	assert_int_equal(sdo_write(0x6000, 0, 100, 2), 0);
	assert_int_equal(sdo_write(0x6011, 0, 1, 1), 0);
	assert_int_equal((int16_t)sdo_read(0x6010, 0), 457);
	assert_int_equal((int16_t)sdo_read(0x6020, 0), 12);
	nmt(0x01);
	from = bed.n;
	say_sync();
	run(MS);
	assert_int_equal(count(0x182, from), 1);
	assert_memory_equal(last(0x182, from)->data, ((const uint8_t[4]){0xc9, 0x01, 12, 0}), 4);
	/* out of the box, unless that was asked for, the angle is not mapped */
	begin_with(&(struct sim_canopen_params){.kind = SIM_CANOPEN_INCLINOMETER, .node = NODE});
	assert_int_equal(sdo_read(0x1A00, 1), 0x60200010);
	begin_with(&(struct sim_canopen_params){.kind = SIM_CANOPEN_ENCODER, .node = NODE});
	assert_int_equal(sdo_read(0x1A00, 1), 0x65030010);
}

static void two_nodes_stand_on_one_axis(void **state)
{
	struct sim_device encoder;
	struct sim_canopen_params params = {.kind = SIM_CANOPEN_ENCODER, .node = 9};

	(void)state;
	begin(SIM_CANOPEN_DRIVE);
	params.axis = bed.axis;
	assert_int_equal(sim_canopen_create(&params, bed.t_ns, &encoder), 0);
	assert_ptr_equal(sim_canopen_axis(&encoder), bed.axis);
	assert_int_equal(sim_canopen_status_word(&encoder), -1);
	assert_false(encoder.fault(encoder.ctx, &(struct sim_fault){.kind = "homing"}, true, bed.t_ns));
	encoder.destroy(encoder.ctx);
	params.node = 0;
	assert_int_equal(sim_canopen_create(&params, bed.t_ns, &encoder), -EINVAL);
}

/* ... in every state, and is alive when all is taken back. */
static void every_fault_that_it_lists_it_takes(void **state)
{
	(void)state;
	for (int kind = SIM_CANOPEN_DRIVE; kind <= SIM_CANOPEN_INCLINOMETER; kind++) {
		begin((enum sim_canopen_kind)kind);
		for (int i = 0; bed.device.fault_kinds[i]; i++) {
			nmt(0x01);
			order(bed.device.fault_kinds[i], 0, SECOND, true);
			say_sync();
			run(3 * SECOND);
			order(bed.device.fault_kinds[i], 0, SECOND, false);
			run(SECOND);
			assert_true(bed.device.alive(bed.device.ctx));
			assert_int_equal(sdo_read(0x1018, 4), NODE);
			bed.n = 0;
		}
		assert_false(bed.device.fault(bed.device.ctx, &(struct sim_fault){.kind = "nonsense"}, true, bed.t_ns));
	}
}

/* Any frame, any bytes, cut anywhere: it lives, and what it sends is whole. */
static void whatever_is_on_the_bus_it_lives(void **state)
{
	static const uint32_t ids[] = {0x000, 0x080, 0x082, 0x202, 0x302, 0x602, 0x602, 0x602, 0x702, 0x77f};
	uint64_t random = 5;
	uint8_t entry[CAN_WIRE_ENTRY_FD];

	(void)state;
	for (int kind = SIM_CANOPEN_DRIVE; kind <= SIM_CANOPEN_INCLINOMETER; kind++) {
		begin((enum sim_canopen_kind)kind);
		for (int i = 0; i < 30000; i++) {
			struct can_frame_at frame = {.id = ids[(int)(sim_random(&random) * 10)],
			                             .len = (uint8_t)(sim_random(&random) * 9),
			                             .t_ns = bed.t_ns};

			for (int k = 0; k < frame.len; k++)
				frame.data[k] = (uint8_t)(sim_random(&random) * (k == 0 || k > 3 ? 256 : 4));
			if (frame.id == 0x602 && frame.len > 3)
				frame.data[2] = (uint8_t)((const uint8_t[]){0x10, 0x60, 0x18, 0x1A, 0x14, 0x16, 0x20,
				                                            0x60}[(int)(sim_random(&random) * 8)]);
			if (frame.id == 0x602)
				frame.len = 8;
			if (sim_random(&random) < 0.02)
				frame.id |= 0x80000000u >> (int)(sim_random(&random) * 3);
			bed.device.receive(bed.device.ctx, entry, can_wire_put(&frame, entry), bed.t_ns);
			bed.t_ns += MS;
			bed.device.advance(bed.device.ctx, bed.t_ns);
			collect();
			bed.n = 0;
			assert_true(isfinite(sim_axis_angle(bed.axis, bed.t_ns)));
		}
		bed.device.receive(bed.device.ctx, entry, 7, bed.t_ns);
	}
}

static void a_run_is_the_same_every_time(void **state)
{
	static struct can_frame_at first[HEARD];
	int n = 0;

	(void)state;
	for (int i = 0; i < 2; i++) {
		begin_cyclic();
		for (int k = 1; k < 100; k++)
			cycle(0x0f, 375 * k);
		if (i == 0) {
			n = bed.n;
			memcpy(first, bed.heard, sizeof first);
		}
		assert_int_equal(bed.n, n);
		assert_memory_equal(first, bed.heard, (size_t)n * sizeof *first);
	}
}

/* One line of a capture, "(0.004000) can0 602#40..." or "  can0  602   [8]  40 ...". */
static bool captured(const char *line, struct can_frame_at *ret)
{
	const char *at = strchr(line, '#');
	char data[20] = "";
	unsigned id;
	int n = 0;

	if (at && sscanf(line, "(%*f) can0 %x", &id) == 1) {
		snprintf(data, sizeof data, "%.16s", at + 1);
	} else if ((at = strstr(line, "can0")) && sscanf(at, "can0 %x [%*d] %n", &id, &n) == 1 && n > 0) {
		int len = 0;

		for (const char *c = at + n; *c && len < 16; c++)
			if (*c != ' ')
				data[len++] = *c;
		data[len] = 0;
	} else {
		return false;
	}
	*ret = (struct can_frame_at){.id = id};
	ret->len = (uint8_t)hex(data, ret->data);
	return true;
}

/* Requests of the capture to node `node` are made to ours, which must take each of them, and answer as the real drive did
 * where its answer was captured: command, index and sub, device type, abort codes. Returns how many were made. */
static int replay(const char *name, uint32_t node, int *ret_compared, int *ret_refused)
{
	struct can_frame_at pending[64], frame;
	size_t len;
	char *text = (char *)capture_file(name, &len), *save = NULL;
	int waiting = 0, asked = 0;

	for (char *line = strtok_r(text, "\n", &save); line; line = strtok_r(NULL, "\n", &save)) {
		if (!captured(line, &frame))
			continue;
		if (frame.id == 0x600 + node) {
			int from = bed.n;
			const struct can_frame_at *answer;

			say(frame.id, frame.data, frame.len);
			run(2 * MS);
			answer = last(0x580 + node, from);
			assert_non_null(answer);
			assert_memory_equal(answer->data + 1, frame.data + 1, 3);
			*ret_refused += answer->data[0] == 0x80;
			if (waiting < 64)
				pending[waiting++] = *answer;
			asked++;
		} else if (frame.id == 0x580 + node) {
			for (int i = 0; i < waiting; i++) {
				if (memcmp(pending[i].data + 1, frame.data + 1, 3) != 0)
					continue;
				assert_int_equal(pending[i].data[0], frame.data[0]);
				if (frame.data[0] == 0x80 || number(frame.data) >> 8 == 0x1000)
					assert_int_equal(number(pending[i].data + 4), number(frame.data + 4));
				pending[i].data[1] = pending[i].data[2] = 0xff;
				(*ret_compared)++;
				break;
			}
		} else if (frame.id == 0 || (frame.id & 0x780) == 0x200 || (frame.id & 0x780) == 0x300) {
			say(frame.id, frame.data, frame.len);
			run(100 * MS);
		}
	}
	free(text);
	return asked;
}

static void the_start_up_of_two_real_drives_goes_the_same_way_with_simulated_ones(void **state)
{
	static const char log[] = "can/canopen_cia402_two_drives_startup.log";
	static const char aborts[] = "can/oriental_motor_simulator_sdo_aborts.candump.txt";
	size_t len;
	uint8_t *text = capture_file(log, &len);
	int asked = 0, compared = 0, refused = 0;

	(void)state;
	if (!text) {
		printf("note: no captures: the start-up of real drives was not compared\n");
		skip();
	}
	free(text);
	for (int node = 1; node <= 2; node++) {
		int from;

		begin_with(&(struct sim_canopen_params){.kind = SIM_CANOPEN_DRIVE, .node = node});
		asked += replay(log, (uint32_t)node, &compared, &refused);
		assert_int_equal(refused, 0);
		assert_int_equal(sim_canopen_nmt_state(&bed.device), 0x05);
		from = bed.n;
		say_sync();
		run(5 * MS);
		/* the process data that it was told to send: as long as the real drives' */
		assert_int_equal(last(0x180u + (uint32_t)node, from)->len, 3);
		assert_int_equal(last(0x280u + (uint32_t)node, from)->len, 8);
		assert_int_equal(last(0x380u + (uint32_t)node, from)->len, 8);
		/* a fault, and its statusword is the real one's but for the maker's bit 14 */
		order("fault", 0x8100, 0, true);
		from = bed.n;
		say_sync();
		run(5 * MS);
		assert_int_equal(last(0x180u + (uint32_t)node, from)->data[0], 0x38);
		assert_int_equal(last(0x180u + (uint32_t)node, from)->data[1] & 0xbf, 0x02);
		assert_int_equal(number(last(0x380u + (uint32_t)node, from)->data + 4) >> 16, 0x8100);
	}
	begin_with(&(struct sim_canopen_params){.kind = SIM_CANOPEN_DRIVE, .node = 1});
	asked += replay(aborts, 1, &compared, &refused);
	assert_int_equal(refused, 2);
	assert_true(asked > 80 && compared >= 10);
	printf("note: start-up of two real drives: %d requests taken, %d answers alike;\n", asked, compared);
}

static int finish(void **state)
{
	(void)state;
	end();
	return 0;
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(it_boots_and_obeys_nmt),
	    cmocka_unit_test(sdo_examples_are_answered_byte_for_byte),
	    cmocka_unit_test(what_is_too_short_for_a_request_gets_no_answer),
	    cmocka_unit_test(a_mapping_is_written_in_its_order_and_in_no_other),
	    cmocka_unit_test(a_sync_samples_at_its_own_time_even_when_it_is_heard_late),
	    cmocka_unit_test(process_data_by_event_come_when_something_changes_and_by_their_timer),
	    cmocka_unit_test(the_state_machine_is_the_standards),
	    cmocka_unit_test(a_fault_is_left_by_a_rising_edge_only_and_not_while_it_lasts),
	    cmocka_unit_test(profile_position_goes_where_it_is_sent_and_shakes_hands),
	    cmocka_unit_test(a_third_set_point_is_not_taken_while_the_second_waits),
	    cmocka_unit_test(no_speed_is_above_that_of_607F),
	    cmocka_unit_test(a_control_word_acts_with_the_target_that_came_with_it),
	    cmocka_unit_test(soft_limits_clip_targets_and_say_so),
	    cmocka_unit_test(cyclic_positions_are_reached_a_cycle_after_their_sync),
	    cmocka_unit_test(an_axis_that_does_not_follow_is_a_fault_in_every_mode),
	    cmocka_unit_test(homing_ends_at_home_or_with_an_error),
	    cmocka_unit_test(homing_at_a_limit_switch_goes_there_and_a_little_back),
	    cmocka_unit_test(without_its_masters_heartbeat_the_drive_stops_by_itself),
	    cmocka_unit_test(its_heartbeat_comes_every_period_with_its_state),
	    cmocka_unit_test(faults_of_the_sdo_server_befall_when_ordered),
	    cmocka_unit_test(faults_of_process_data_befall_when_ordered),
	    cmocka_unit_test(without_power_nothing_is_heard_of_it_and_it_boots_when_it_is_back),
	    cmocka_unit_test(an_encoder_counts_modulo_its_range),
	    cmocka_unit_test(an_inclinometer_measures_in_its_resolution),
	    cmocka_unit_test(two_nodes_stand_on_one_axis),
	    cmocka_unit_test(every_fault_that_it_lists_it_takes),
	    cmocka_unit_test(whatever_is_on_the_bus_it_lives),
	    cmocka_unit_test(a_run_is_the_same_every_time),
	    cmocka_unit_test(the_start_up_of_two_real_drives_goes_the_same_way_with_simulated_ones),
	};

	return cmocka_run_group_tests(tests, NULL, finish);
}

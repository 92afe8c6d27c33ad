/* A list of registers to write, one after the other: pure, in the caller's time.
 *
 *   write ─ answered ─► delay ─► until: read, again and again, as long as `within` ─► next
 *
 * The dialogue sends and hears; here is only what comes next. */
#include "drivers/modbus_parts.h"

#define READ_AGAIN_NS 50000000

static const struct config_write *item(const struct modbus_sequence *s)
{
	return &s->list->item[s->at];
}

void modbus_sequence_begin(struct modbus_sequence *s, const struct config_writes *list)
{
	*s = (struct modbus_sequence){.list = list, .state = list->n ? MODBUS_SEQUENCE_WRITE : MODBUS_SEQUENCE_DONE};
}

static void next_item(struct modbus_sequence *s)
{
	s->state = ++s->at < s->list->n ? MODBUS_SEQUENCE_WRITE : MODBUS_SEQUENCE_DONE;
}

enum modbus_sequence_state modbus_sequence_look(struct modbus_sequence *s, int64_t t_ns)
{
	if (s->state != MODBUS_SEQUENCE_WAIT || t_ns < s->due_ns)
		return s->state;
	if (item(s)->until.set)
		s->state = MODBUS_SEQUENCE_READ;
	else
		next_item(s);
	return s->state;
}

void modbus_sequence_written(struct modbus_sequence *s, int64_t t_ns)
{
	if (s->state != MODBUS_SEQUENCE_WRITE)
		return;
	s->state = MODBUS_SEQUENCE_WAIT;
	s->due_ns = t_ns + item(s)->delay_ns;
	s->by_ns = s->due_ns + item(s)->until.within_ns;
}

void modbus_sequence_read(struct modbus_sequence *s, uint16_t value, int64_t t_ns)
{
	if (s->state != MODBUS_SEQUENCE_READ)
		return;
	s->seen = value;
	if ((value & item(s)->until.mask) == (item(s)->until.value & item(s)->until.mask)) {
		next_item(s);
	} else if (t_ns >= s->by_ns) {
		s->state = MODBUS_SEQUENCE_FAILED;
	} else {
		s->state = MODBUS_SEQUENCE_WAIT;
		s->due_ns = t_ns + READ_AGAIN_NS;
	}
}

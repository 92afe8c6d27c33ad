/* Error frames. Several classes may be told by one frame; the worst counts. A warning and a passive controller still carry
 * frames, so these do not end them; only the controller's own word does ("active again", or "restarted" after a bus-off).
 * Some controllers never say that word after a bus-off: there the first data frame does. An error frame of the controller
 * that names no level (an overflow) leaves the health as it is. */
#include "drivers/can_bus.h"

#include <stdio.h>
#include <string.h>

#define OVERFLOWS 0x03
#define WARNINGS  0x0C
#define PASSIVES  0x30
#define ACTIVE    0x40

/* `data` of a class that is told in it. */
static enum can_bus_health health_of(struct can_bus *bus, uint32_t classes, const uint8_t *data)
{
	if (classes & CAN_WIRE_ERROR_BUS_OFF)
		return CAN_BUS_OFF;
	if (classes & CAN_WIRE_ERROR_CONTROLLER) {
		bus->overflows += (data[1] & OVERFLOWS) != 0;
		if (data[1] & PASSIVES)
			return CAN_BUS_PASSIVE;
		if (data[1] & WARNINGS)
			return CAN_BUS_WARNING;
		if (data[1] & ACTIVE)
			return CAN_BUS_ACTIVE;
	}
	return classes & CAN_WIRE_ERROR_RESTARTED ? CAN_BUS_ACTIVE : bus->health;
}

static uint32_t get32(const uint8_t *b)
{
	return (uint32_t)b[0] | (uint32_t)b[1] << 8 | (uint32_t)b[2] << 16 | (uint32_t)b[3] << 24;
}

static bool become(struct can_bus *bus, enum can_bus_health health)
{
	if (health == bus->health)
		return false;
	bus->warnings += health == CAN_BUS_WARNING;
	bus->passives += health == CAN_BUS_PASSIVE;
	bus->offs += health == CAN_BUS_OFF;
	bus->health = health;
	return true;
}

void can_bus_opened(struct can_bus *bus)
{
	bus->health = CAN_BUS_ACTIVE;
}

bool can_bus_take(struct can_bus *bus, const struct can_frame_at *f)
{
	if (f->id == CAN_WIRE_LOST) {
		bus->not_received += get32(f->data);
		bus->not_sent += get32(f->data + 4);
		return false;
	}
	if (!(f->id & CAN_WIRE_ERROR))
		return bus->health == CAN_BUS_OFF && become(bus, CAN_BUS_ACTIVE);
	bus->errors++;
	bus->restarts += (f->id & CAN_WIRE_ERROR_RESTARTED) != 0;
	return become(bus, health_of(bus, f->id, f->data));
}

const char *can_bus_name(enum can_bus_health health)
{
	static const char *const name[CAN_BUS_HEALTHS] = {"active", "warning", "passive", "off"};

	return name[health];
}

void can_bus_sentence(enum can_bus_health health, const char *interface, char ret[160])
{
	static const char check[] = "check cable, terminators (120 ohms at both ends) and bit rate";

	ret[0] = '\0';
	if (health == CAN_BUS_WARNING)
		snprintf(ret, 160, "%.30s: the controller warns of many errors: %s", interface, check);
	else if (health == CAN_BUS_PASSIVE)
		snprintf(ret, 160, "%.30s: error passive, frames fail; is anybody else there? If so, %s", interface,
		         check);
	else if (health == CAN_BUS_OFF && strncmp(interface, "unix:", 5) == 0) /* no interface of this machine */
		snprintf(ret, 160, "%.60s: bus-off: %s", interface, check);
	else if (health == CAN_BUS_OFF)
		snprintf(ret, 160, "%.15s: bus-off: %s; `ip link set %.15s type can restart` starts it again",
		         interface, check, interface);
}

void can_bus_counters(const struct can_bus *bus, struct decoder_counters *ret)
{
	const struct {
		const char *name;
		uint64_t count;
	} counter[CAN_BUS_COUNTERS] = {{"error frames", bus->errors},
	                               {"bus off", bus->offs},
	                               {"overflows", bus->overflows},
	                               {"not received", bus->not_received},
	                               {"not sent", bus->not_sent}};

	for (int i = 0; i < CAN_BUS_COUNTERS && ret->n < DECODER_COUNTERS_MAX; i++, ret->n++) {
		ret->counter[ret->n].name = counter[i].name;
		ret->counter[ret->n].count = counter[i].count;
	}
}

void can_bus_state(struct state *s, struct can_bus *bus)
{
	int health = (int)bus->health;

	state_int(s, &health, 0, CAN_BUS_HEALTHS - 1);
	bus->health = (enum can_bus_health)health;
	state_u64(s, &bus->errors);
	state_u64(s, &bus->warnings);
	state_u64(s, &bus->passives);
	state_u64(s, &bus->offs);
	state_u64(s, &bus->restarts);
	state_u64(s, &bus->overflows);
	state_u64(s, &bus->not_received);
	state_u64(s, &bus->not_sent);
}

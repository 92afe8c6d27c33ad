/* What error frames say of a bus, for the decoders of all CAN drivers: pure. The controller's health comes as transitions
 * (warning, passive, bus-off, active again, restarted), each once; frames that were lost come as CAN_WIRE_LOST. A decoder
 * hands over every frame, and tells its dialogue of each change (reply CAN_BUS_REPLY); the dialogue makes a note of it. */
#ifndef FACET_DRIVERS_CAN_BUS_H
#define FACET_DRIVERS_CAN_BUS_H

#include "core/state.h"
#include "drivers/can_wire.h"
#include "drivers/driver.h"

/* By the larger of its two counters of errors: below 96, below 128, below 256, beyond. */
enum can_bus_health { CAN_BUS_ACTIVE, CAN_BUS_WARNING, CAN_BUS_PASSIVE, CAN_BUS_OFF, CAN_BUS_HEALTHS };

struct can_bus {
	enum can_bus_health health;
	uint64_t errors, warnings, passives, offs, restarts, overflows; /* error frames, and what they told */
	uint64_t not_received, not_sent;                                /* frames: CAN_WIRE_LOST */
};

/* Kind of the reply that a decoder sends when can_bus_take said true; payload: one byte, enum can_bus_health. */
#define CAN_BUS_REPLY 1000

void can_bus_opened(struct can_bus *); /* LINK_OPENED: nothing is known against it */

/* Every frame, data frames too: the first one after a bus-off says that it is over. True: the health changed. */
bool can_bus_take(struct can_bus *, const struct can_frame_at *);

/* What is wrong and what to do, one sentence; empty while active. `interface`: the device's `connect`. */
void can_bus_sentence(enum can_bus_health, const char *interface, char ret[160]);
const char *can_bus_name(enum can_bus_health); /* "active", "warning", "passive", "off" */

#define CAN_BUS_COUNTERS 5
void can_bus_counters(const struct can_bus *, struct decoder_counters *ret); /* appends CAN_BUS_COUNTERS of them */
void can_bus_state(struct state *, struct can_bus *);

#endif

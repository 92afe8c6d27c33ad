/* CANopen nodes: drives (CiA 402), encoders (CiA 406), inclinometers (CiA 410). The table and the link; what they say is
 * read in canopen_decoder.c, what they are told in canopen_dialogue.c.
 *
 * The link lets through what this node sends by the predefined connection set, all SDO, RPDO and heartbeats that are sent
 * to it, also by other masters (the decoder learns the mapping from whoever sets it), SYNC and NMT. A node whose COB-ids
 * were moved elsewhere is not heard until the dialogue has set the one that it needs. */
#include "drivers/can_link.h"
#include "drivers/canopen_parts.h"

static struct link *link_open(const struct config_device *device, char error[160])
{
	const uint32_t node = (uint32_t)device->node;
	const struct can_link_filter filter[] = {
	    {CANOPEN_NMT, CAN_LINK_EXACT},
	    {CANOPEN_SYNC, CAN_LINK_EXACT},
	    {CANOPEN_EMCY + node, CAN_LINK_EXACT},
	    {CANOPEN_TPDO + node, CAN_LINK_EXACT},
	    {CANOPEN_TPDO + 0x100 + node, CAN_LINK_EXACT},
	    {CANOPEN_TPDO + 0x200 + node, CAN_LINK_EXACT},
	    {CANOPEN_TPDO + 0x300 + node, CAN_LINK_EXACT},
	    {CANOPEN_SDO_ANSWER + node, CAN_LINK_EXACT},
	    {CANOPEN_SDO_REQUEST + node, CAN_LINK_EXACT},
	    {CANOPEN_HEARTBEAT + node, CAN_LINK_EXACT},
	};

	return can_link_open(device->connect, filter, (int)(sizeof filter / sizeof filter[0]), error);
}

const struct driver driver_canopen = {
    .name = "canopen",
    .role = ROLE_TILT,
    .decoder_create = canopen_decoder_create,
    .decoder_destroy = canopen_decoder_destroy,
    .decode = canopen_decode,
    .counters = canopen_counters,
    .timing = canopen_timing,
    .state = canopen_decoder_state,
    .dialogue_create = canopen_dialogue_create,
    .dialogue_destroy = canopen_dialogue_destroy,
    .dialogue_reset = canopen_dialogue_reset,
    .dialogue_reply = canopen_dialogue_reply,
    .dialogue_data = canopen_dialogue_data,
    .dialogue_step = canopen_dialogue_step,
    .dialogue_stop = canopen_dialogue_stop,
    .link_open = link_open,
    .link_fd = can_link_fd,
    .link_read = can_link_read,
    .link_write = can_link_write,
    .link_error = can_link_error,
    .link_note = can_link_note,
    .link_close = can_link_close,
};

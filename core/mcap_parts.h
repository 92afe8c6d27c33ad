/* What writer and reader of MCAP share: opcodes, and numbers of the wire. */
#ifndef FACET_CORE_MCAP_PARTS_H
#define FACET_CORE_MCAP_PARTS_H

#include <string.h>

#include "core/mcap.h"

enum mcap_opcode {
	OP_HEADER = 1,
	OP_FOOTER,
	OP_SCHEMA,
	OP_CHANNEL,
	OP_MESSAGE,
	OP_CHUNK,
	OP_MESSAGE_INDEX,
	OP_CHUNK_INDEX,
	OP_ATTACHMENT,
	OP_ATTACHMENT_INDEX,
	OP_STATISTICS,
	OP_METADATA,
	OP_METADATA_INDEX,
	OP_SUMMARY_OFFSET,
	OP_DATA_END,
	OP_PRIVATE = 0x80 /* from here on: others', passed over */
};

#define MCAP_RECORD_HEAD 9  /* u8 opcode, u64 length */
#define MCAP_FOOTER_LEN  20 /* content: u64 summary_start, u64 summary_offset_start, u32 summary_crc */

static const uint8_t mcap_magic[MCAP_MAGIC] = {0x89, 'M', 'C', 'A', 'P', '0', '\r', '\n'};

#endif

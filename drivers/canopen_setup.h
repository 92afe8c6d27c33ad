/* Set-up of a node by a list of what its objects should hold: pure, over the SDO client. What differs is written, what
 * is as wanted is left alone (many nodes keep their set-up, and their memory wears). Objects first, in order, then
 * PDOs.
 *
 * A PDO is set as CiA 301 demands: switched off, type and timers, mapping emptied, entries, count, switched on. Where
 * the mapping is as wanted it is not touched; where all is, nothing is written. The COB-id is switched off as it was
 * read, and its bit 30 (no RTR) kept: some nodes insist on both. */
#ifndef FACET_DRIVERS_CANOPEN_SETUP_H
#define FACET_DRIVERS_CANOPEN_SETUP_H

#include "drivers/canopen_sdo.h"

#define CANOPEN_SETUP_OBJECTS 64
#define CANOPEN_SETUP_PDOS    8
#define CANOPEN_PDO_ENTRIES   8 /* of 8 bits at least in 8 bytes */

struct canopen_object {
	uint16_t index;
	uint8_t sub;
	uint8_t size; /* bytes, 1..4 */
	enum {
		CANOPEN_LEARN, /* only read */
		CANOPEN_KEEP,  /* written if it differs */
		CANOPEN_WRITE, /* written without a look: what cannot be read, or acts when written */
		CANOPEN_WATCH /* 1016: `value` is (node << 16 | ms); an entry with that node, else a free one, is set */
	} how;
	bool optional; /* a node that lacks it, or refuses it, is passed over */
	uint32_t value;
	bool known;     /* result: `read` holds what the node holds now */
	uint32_t read;  /* result: the value last read or written */
	uint32_t abort; /* result: why an optional one was passed over; 0: it was not */
};

struct canopen_pdo {
	uint16_t index;                      /* 1400.. or 1800..: the mapping is at index + 0x200 */
	bool optional;                       /* a node that lacks this PDO is passed over */
	bool off;                            /* is not to exist; the rest does not matter then */
	uint32_t cob;                        /* id, and CANOPEN_COB_EXTENDED; 0: as the node has it */
	uint8_t type;                        /* transmission type */
	int inhibit;                         /* 100 us, sub 3; -1: as it is */
	int timer;                           /* ms, sub 5; -1: as it is */
	int n;                               /* entries wanted; -1: mapping as it is */
	uint32_t entry[CANOPEN_PDO_ENTRIES]; /* index << 16 | sub << 8 | bits */
};
#define CANOPEN_MAP(index, sub, bits) ((uint32_t)(index) << 16 | (uint32_t)(sub) << 8 | (uint32_t)(bits))

struct canopen_setup {
	enum { CANOPEN_SETUP_IDLE, CANOPEN_SETUP_BUSY, CANOPEN_SETUP_DONE, CANOPEN_SETUP_FAILED } state;
	char error[160]; /* FAILED: "object 1A00:01 of node 5 cannot be set to 0x60640020: ... (06040041)" */
	uint32_t abort;  /* FAILED: the code */
	int written;     /* downloads that were answered */
	int objects, pdos;
	struct canopen_object object[CANOPEN_SETUP_OBJECTS];
	struct canopen_pdo pdo[CANOPEN_SETUP_PDOS];

	/* Its own. */
	struct canopen_sdo sdo;
	int at;              /* which object, then which PDO */
	int step;            /* within it */
	uint32_t cob, count; /* of the PDO at hand, as read; of 1016: entries */
	bool differs, parameter_differs[3], mapping_differs;
	int free_sub; /* of 1016; 0: none */
};

/* Nothing is in the lists. */
void canopen_setup_init(struct canopen_setup *, int node);
/* At the limit of a list: asserts; lists are made by this program. */
void canopen_setup_object(struct canopen_setup *, const struct canopen_object *);
void canopen_setup_pdo(struct canopen_setup *, const struct canopen_pdo *);
/* Begins at the beginning. */
void canopen_setup_begin(struct canopen_setup *);
void canopen_setup_answer(struct canopen_setup *, const uint8_t *bytes, size_t len);
/* True: `ret` is to be sent now, and this called again. */
bool canopen_setup_step(struct canopen_setup *, int64_t t_ns, struct can_frame_at *ret);
int64_t canopen_setup_deadline(const struct canopen_setup *);
/* Value of an object of the list as the node holds it now; false: not known. */
bool canopen_setup_value(const struct canopen_setup *, uint16_t index, uint8_t sub, uint32_t *ret);

/* Lists that every node needs. */
void canopen_setup_identify(struct canopen_setup *); /* 1000, 1018 */
/* Producer: its heartbeat so often; consumer: `master`'s missing for `consumer_ms`. 0: none, what is there is left. */
void canopen_setup_heartbeat(struct canopen_setup *, uint16_t producer_ms, int master, uint16_t consumer_ms);

#endif

/* Inside the simulated CANopen nodes: the node, and what its files share.
 *
 *   sim_canopen.c        the brain: NMT, heartbeats, emergencies, power, faults, what leaves when
 *   sim_node_objects.c   the object dictionary: tables, access, ranges
 *   sim_node_sdo.c       the SDO server
 *   sim_node_pdo.c       process data: mapping, SYNC, events
 *   sim_node_drive.c     CiA 402: states, modes, homing
 *   sim_node_sensor.c    CiA 406 and 410 */
#ifndef FACET_TOOLS_SIM_NODE_H
#define FACET_TOOLS_SIM_NODE_H

#include "drivers/canopen_wire.h"
#include "tools/sim_canopen.h"

#define SIM_NODE_OBJECTS   256
#define SIM_NODE_PDOS      4
#define SIM_NODE_MAPPED    8
#define SIM_NODE_QUEUE     256 /* frames that wait to leave; one more is not sent */
#define SIM_NODE_TEXT      64
#define SIM_NODE_CONSUMERS 2

/* Reasons to refuse beyond those of canopen_wire.h. */
enum {
	SIM_NODE_TOO_LONG = 0x06070012,
	SIM_NODE_TOO_SHORT = 0x06070013,
	SIM_NODE_TOO_HIGH = 0x06090031,
	SIM_NODE_TOO_LOW = 0x06090032
};

enum sim_node_type { SIM_U8, SIM_I8, SIM_U16, SIM_I16, SIM_U32, SIM_I32, SIM_TEXT };
enum sim_node_access { SIM_R = 1, SIM_W = 2, SIM_RW = 3, SIM_TX = 4, SIM_RX = 8 }; /* TX, RX: may be mapped there */

struct sim_node_object {
	uint16_t index;
	uint8_t sub, type, access;
	int64_t value, low, high; /* low == high: all that its type holds */
	const char *text;
};

enum sim_node_fault {
	SIM_FAULT_HEARTBEAT,
	SIM_FAULT_SILENT,
	SIM_FAULT_POWER,
	SIM_FAULT_OFF,
	SIM_FAULT_EMCY,
	SIM_FAULT_FAULT,
	SIM_FAULT_STUCK,
	SIM_FAULT_SLOW,
	SIM_FAULT_HOMING,
	SIM_FAULT_LIMIT,
	SIM_FAULT_SDO_ABORT,
	SIM_FAULT_SDO_TIMEOUT,
	SIM_FAULT_SDO_ECHO,
	SIM_FAULT_SDO_SHORT,
	SIM_FAULT_LATE,
	SIM_FAULT_NO_PDO,
	SIM_FAULT_MAPPING,
	SIM_NODE_FAULTS
};

struct sim_node_pdo {
	int syncs;        /* since it was sent */
	int64_t event_ns; /* the event timer's next; INT64_MAX: none */
	int64_t sent_ns;  /* for the inhibit time */
	uint8_t last[8];  /* as sent */
	uint8_t last_len; /* 0: never */
	bool waits;       /* RPDO: `last` takes effect at the next SYNC */
};

struct sim_node {
	struct sim_canopen_params params;
	struct sim_axis *axis, own;
	int64_t now_ns;
	uint64_t random;

	struct sim_node_object object[SIM_NODE_OBJECTS]; /* sorted; `value` is the factory's */
	int64_t value[SIM_NODE_OBJECTS];
	int objects;
	char text[SIM_NODE_TEXT]; /* object 2000 */

	bool powered;
	int64_t power_ns;                        /* it comes back then; INT64_MAX: not by itself */
	enum canopen_nmt state;                  /* CANOPEN_BOOT_UP: starting */
	int64_t boot_ns;                         /* its boot-up message leaves then */
	int64_t heartbeat_ns;                    /* the next one; INT64_MAX: none */
	int64_t consumer_ns[SIM_NODE_CONSUMERS]; /* whom it watches is lost then; INT64_MAX: not heard yet, or lost */
	bool missing;                            /* one was lost and is not back */
	uint8_t error_register;

	struct sim_node_sdo {
		enum { SIM_SDO_IDLE, SIM_SDO_UPLOAD, SIM_SDO_DOWNLOAD } kind;
		bool toggle;
		uint16_t index;
		uint8_t sub, data[SIM_NODE_TEXT];
		uint32_t len, at, size;
	} sdo;

	struct sim_node_pdo tx[SIM_NODE_PDOS], rx[SIM_NODE_PDOS];
	int64_t event_look_ns; /* changes of what is sent by event are looked for then */

	struct sim_node_drive {
		enum canopen_drive_state state;
		uint16_t control, error;
		int64_t enable_ns;   /* operation is enabled then; INT64_MAX: not wanted */
		int8_t mode;         /* displayed */
		int64_t mode_ns;     /* the wanted one is taken then */
		double zero_rad;     /* axis at count 0 */
		bool acknowledged;   /* bit 12 of profile position */
		bool queued;         /* the next set-point waits until this one is reached */
		bool limited;        /* bit 11 */
		bool fresh;          /* a cyclic set-point that has not taken effect yet */
		double target, next; /* counts: of the motion in progress; of what is queued */
		int64_t cycle_ns;    /* the cyclic set-point is reached then */
		enum {
			SIM_HOMING_NONE,
			SIM_HOMING_STARTED,
			SIM_HOMING_SEEK,
			SIM_HOMING_BACK,
			SIM_HOMING_DONE,
			SIM_HOMING_FAILED
		} homing;
		int64_t homing_ns;
		int64_t behind_ns; /* since when it is behind by more than the window; INT64_MAX: it is not */
		int64_t look_ns;
	} drive;
	double preset; /* encoder, inclinometer: added to counts */

	struct {
		struct can_frame_at frame; /* t_ns: it leaves then */
		uint64_t order;
	} queue[SIM_NODE_QUEUE];
	int queued;
	uint64_t ordered;

	struct sim_fault_state fault[SIM_NODE_FAULTS];
	struct sim_counts counts;
};

/* sim_canopen.c: a frame that leaves at t_ns (lost where the fault says so, or the queue is full); an emergency. */
void sim_node_send(struct sim_node *, uint32_t id, const uint8_t *bytes, uint8_t len, int64_t t_ns);
void sim_node_emergency(struct sim_node *, uint16_t code, uint8_t error_register);

/* sim_node_objects.c: the dictionary as from the factory; only the mapping anew. */
int sim_node_objects_init(struct sim_node *);
void sim_node_objects_reset(struct sim_node *);
void sim_node_mapping_reset(struct sim_node *);
/* Place of an object, -1: none. `ret_index`: are there others of this index? May be NULL. */
int sim_node_find(const struct sim_node *, uint16_t index, uint8_t sub, bool *ret_index);
int sim_node_bytes(const struct sim_node *, int object);                      /* of its type; texts: 0 */
int64_t sim_node_value(const struct sim_node *, uint16_t index, uint8_t sub); /* as kept; 0: no such object */
void sim_node_set(struct sim_node *, uint16_t index, uint8_t sub, int64_t value);
/* As it is at t_ns, what is measured included. */
int64_t sim_node_measure(const struct sim_node *, int object, int64_t t_ns);
/* What SDO and PDO write: 0 or the reason to refuse. Written, it acts. */
uint32_t sim_node_write(struct sim_node *, int object, int64_t value, int64_t t_ns);

/* sim_node_sdo.c */
void sim_node_sdo_request(struct sim_node *, const uint8_t *bytes, uint8_t len, int64_t t_ns);

/* sim_node_pdo.c */
uint32_t sim_node_pdo_judge(const struct sim_node *, const struct sim_node_object *, int64_t value);
void sim_node_pdo_written(struct sim_node *, const struct sim_node_object *, int64_t t_ns);
void sim_node_pdo_start(struct sim_node *, int64_t t_ns); /* operational */
void sim_node_pdo_sync(struct sim_node *, int64_t sync_ns, int64_t t_ns);
void sim_node_pdo_received(struct sim_node *, const struct can_frame_at *, int64_t t_ns);
void sim_node_pdo_events(struct sim_node *, int64_t t_ns);
int64_t sim_node_pdo_deadline(const struct sim_node *);

/* sim_node_drive.c */
void sim_node_drive_boot(struct sim_node *, int64_t t_ns);
void sim_node_drive_off(struct sim_node *, int64_t t_ns);
uint32_t sim_node_drive_judge(const struct sim_node *, const struct sim_node_object *, int64_t value);
void sim_node_drive_written(struct sim_node *, const struct sim_node_object *, int64_t t_ns);
void sim_node_drive_advance(struct sim_node *, int64_t t_ns);
int64_t sim_node_drive_deadline(const struct sim_node *);
void sim_node_drive_fail(struct sim_node *, uint16_t code, int64_t t_ns);
void sim_node_drive_abandoned(struct sim_node *, int64_t t_ns); /* the master is lost: 6007 */
void sim_node_drive_limit(struct sim_node *, bool on, int64_t t_ns);
void sim_node_drive_cycle(struct sim_node *, int64_t t_ns); /* a set-point of a cyclic mode takes effect */
uint16_t sim_node_drive_status(const struct sim_node *, int64_t t_ns);
int64_t sim_node_drive_measure(const struct sim_node *, uint16_t index, int64_t t_ns, int64_t value);

/* sim_node_sensor.c */
void sim_node_sensor_boot(struct sim_node *, int64_t t_ns);
uint32_t sim_node_sensor_judge(const struct sim_node *, const struct sim_node_object *, int64_t value, int64_t t_ns);
void sim_node_sensor_written(struct sim_node *, const struct sim_node_object *, int64_t t_ns);
int64_t sim_node_sensor_measure(const struct sim_node *, uint16_t index, int64_t t_ns, int64_t value);

#endif

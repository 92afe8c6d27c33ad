/* The whole program in virtual time: simulated devices, the real dialogues, the real decoders, the real supervisor and the
 * real pipeline, joined at the seam on one thread, with the time handed in.
 *
 *   brain (sim_device) -- pieces, later by the line's delay --> virtual link --> supervisor --> pipeline --> rows
 *     ^ scene: a world, a robot that drives in it, a servo that tilts the scanners                             |
 *     |                                                                                                        v
 *     +------------------------ what every beam truly hit -----------------------------------------------> compared
 *
 * Only link_* of a driver is replaced (for CAN and Modbus can_link.c and modbus_bus.c, behind the driver's own functions).
 * A virtual link does to bytes what transports do: it is pulled out and put back, refuses, hangs, is reset, is half open,
 * splits, joins, and takes what it is given a byte at a time; a virtual bus lets frames wait for each other, stamps them,
 * loses them. Servos and poses behind which no simulated device stands are fed as the records that their own drivers
 * decode. Runs are the same bytes every time. Times in the interface are ns since the start. Everything that goes wrong in
 * making a rig ends the program with a sentence: it serves tests. */
#ifndef FACET_TESTS_RIG_H
#define FACET_TESTS_RIG_H

#include "daemon/journal.h"
#include "daemon/supervisor.h"
#include "tools/sim_device.h"
#include "tools/sim_drive.h"

#define RIG_MS     INT64_C(1000000)
#define RIG_SECOND INT64_C(1000000000)
#define RIG_NEAR_M 0.05

/* RIG_CAN: bytes of the brain are entries of can_wire.h, both ways; devices with one `connect` share a bus.
 * RIG_MODBUS: a line where `connect` is a path, else TCP; the bus asks as modbus_bus.c does. */
enum rig_transport { RIG_SERIAL, RIG_TCP, RIG_USB, RIG_CAN, RIG_MODBUS };

/* Faults of a link, beside those of the brain behind it:
 *   "unplug"       SERIAL, USB: lost, and cannot be opened; TCP: no byte passes, the connection is dead when it is back
 *   "refuse"       TCP: lost, and connections are refused
 *   "hang"         TCP: lost, and connections neither stand nor fail until it is over
 *   "reset"        TCP, USB: lost, once
 *   "half-open"    no byte passes in either direction, and nobody is told, until the link is closed
 *   "bytewise"     a read delivers a byte
 *   "hold"         bytes wait for so many ms (value, default 100) and are read as one
 *   "slow writes"  a write takes a byte, the next one 1 ms later
 *   "no baud"      SERIAL: the line refuses this rate (value)
 *
 * of a CAN bus: those of tools/sim_can_bus.h, and
 *   "bus late"     there called "late"
 *   "overrun"      so large a share of the frames finds no room in the driver's socket, which is told
 *   "as fd"        frames of the device come as FD frames of 64 bytes
 *   "flood"        somebody fills the bus with frames of the lowest priority
 *
 * and of the world around, whatever the device:
 *   "wall clock"   it is now so many seconds ahead of log time, for those who send it
 *   "late angles"  samples of the servo come so many ms late
 *   "no angles"    they do not come at all
 *   "no poses"     nobody says where the robot is */

struct rig_params {
	const char *yaml;  /* the devices; a modbus device is the servo, a pose device the localisation */
	const char *world; /* of tools/simulator.h; NULL: "hall" */
	uint64_t seed;
	int thin;         /* every n-th beam is cast, those behind it repeat it; 0, 1: every one */
	int64_t delay_ns; /* of the lines: every piece of bytes is late by a tenth of it up to all of it; 0: 300 us */
	bool stand;       /* the robot does not drive */
	int64_t pose_ns;  /* between poses that are fed; 0: 10 ms */
};

struct rig;
struct rig *rig_create(const struct rig_params *);
void rig_destroy(struct rig *);
int rig_find(const struct rig *, const char *device); /* its index */

/* What the device sees: for its brain. */
void rig_scene(struct rig *, const char *device, struct scene *ret);
int64_t rig_epoch_ns(const struct rig *);          /* brains are made with this time */
double rig_tilt(const struct rig *, int64_t t_ns); /* the true angle of the servo, at a brain's time */
/* True place of the robot at a brain's time, for its wheels. */
struct pose rig_pose(struct rig *, int64_t t_ns);
/* The scanners tilt with a simulated axis from now on, whose angle in the sense of the tilt frame `angle` tells. */
void rig_follow(struct rig *, double (*angle)(void *ctx, int64_t t_ns), void *ctx);
/* The device's other end; the brain is the rig's from now on. */
void rig_attach(struct rig *, const char *device, enum rig_transport, const struct sim_device *brain);
void rig_attach_drive(struct rig *, const char *device, struct sim_drive *); /* RIG_MODBUS: it speaks in transactions */

/* Whoever wants what comes of it, from the start on. Rows are taken over by `row` after they were compared. */
struct rig_keeper {
	void *ctx;
	void (*row)(void *ctx, struct row *row);                             /* may be NULL */
	void (*flush)(void *ctx);                                            /* may be NULL */
	void (*tilt)(void *ctx, int device, double angle_rad, int64_t t_ns); /* an angle as decoded; may be NULL */
	struct journal_sink journal;                                         /* `begin` NULL: no list is kept */
};
void rig_keep(struct rig *, const struct rig_keeper *);
void rig_new_map(struct rig *); /* rows are numbered anew, and so is the list */

void rig_start(struct rig *);
void rig_run(struct rig *, int64_t for_ns);
void rig_stop(struct rig *); /* the orderly end, until every device is closed */
int64_t rig_now(const struct rig *);

/* Orders a fault of the device or of its link, until it is taken back. False: nobody knows this kind. */
bool rig_fault(struct rig *, const char *device, const char *kind, double value, bool on);
bool rig_once(struct rig *, const char *device, const char *kind, double value); /* the next time it can befall */
/* What is to be seen from outside. */
struct rig_view {
	enum supervisor_state state;
	struct supervisor_device line;
	struct sim_counts sent;   /* by the brain */
	uint64_t lost_profiles;   /* whole telegrams that left the device and fell under the line */
	uint64_t profiles;        /* decoded */
	int64_t last_data_ns;     /* of the newest profile; -1: none yet */
	int64_t longest_pause_ns; /* between two profiles, since rig_mark; the one that runs now counts */
	int64_t first_request_ns; /* when the device heard its first byte since rig_mark; -1: none yet */
	uint64_t requests;        /* bytes that the device was sent since rig_mark */
	size_t heard_len;         /* the first of them */
	uint8_t heard[512];
};
void rig_view(const struct rig *, const char *device, struct rig_view *ret);
void rig_mark(struct rig *, const char *device);
void rig_counters(const struct rig *, const char *device, struct decoder_counters *ret);
/* A counter of its decoder; -1: it has none of this name. */
int64_t rig_count(const struct rig *, const char *device, const char *counter);
/* Runs until the device streams and a profile came that is newer than now: how long that took, or -1. */
int64_t rig_wait_data(struct rig *, const char *device, int64_t limit_ns);

/* Lines of the log, oldest first, from line `from` on; NULL: there is none. The newest RIG_LOG_LINES are kept. */
#define RIG_LOG_LINES 512
struct rig_log {
	int64_t t_ns;
	int device;
	char text[200];
};
size_t rig_logged(const struct rig *); /* lines so far */
const struct rig_log *rig_log(const struct rig *, size_t line);
/* How many lines of the device since line `from` begin with `begin`. */
int rig_log_count(const struct rig *, const char *device, size_t from, const char *begin);

/* Rows against the truth. A row is recognised by its ranges, whatever its time. */
struct rig_points {
	uint64_t rows, unknown_rows; /* of no profile that this scanner measured within two seconds */
	uint64_t points, near;       /* within RIG_NEAR_M of where the beam truly ended */
	double worst_m;
	int64_t time_p50_ns, time_p99_ns, time_worst_ns; /* of rows: |time said - time true|, over the newest 4096 */
	double angle_p50_deg, angle_p99_deg,
	    angle_worst_deg; /* of beams: |tilt as placed - true tilt when it was measured| */
};
void rig_points(const struct rig *, const char *device, struct rig_points *ret);
void rig_points_clear(struct rig *, const char *device);
void rig_pipeline_stats(const struct rig *, struct pipeline_stats *ret);

#endif

/* The supervisor: keeps the devices alive. Every device is closed, configuring, streaming or backing off.
 * It is handed the time and answers with a deadline; descriptors are watched by its host. One thread. */
#ifndef FACET_DAEMON_SUPERVISOR_H
#define FACET_DAEMON_SUPERVISOR_H

#include "drivers/driver.h"

#define SUPERVISOR_BACKOFF_MIN_NS 250000000ll  /* before the first new try; doubled with every failure ... */
#define SUPERVISOR_BACKOFF_MAX_NS 1000000000ll /* ... up to here: who is back is asked within 2 s */
#define SUPERVISOR_OPEN_NS        1500000000ll /* whoever takes no byte for so long after it was opened is not there */
#define SUPERVISOR_STEADY_NS      2000000000ll /* who streamed so long begins with the first back-off again */
#define SUPERVISOR_STOP_NS        1000000000ll /* an orderly end takes no longer ... */
#define SUPERVISOR_REST_NS \
	8000000000ll /* ... or so long where a servo goes to its rest angle or has a `stop` (systemd kills after 10 s) */
#define SUPERVISOR_READS_MAX 16 /* of one device in one turn of the loop */
/* What one device may cost: beyond it reading waits, and the kernel holds the rest. Five echoes of an LMS5xx in CoLa-A,
 * the most that any device has to say, are 1 MB/s. */
#define SUPERVISOR_BYTES_PER_S 2000000
#define SUPERVISOR_BURST_BYTES 262144
#define SUPERVISOR_SLICE_NS    20000000ll /* reading waits for so long then */
/* Whoever sends so much without one telegram is another device: four of the longest telegrams. */
#define SUPERVISOR_NOISE_BYTES 262144

struct supervisor_host {
	void *ctx;
	/* Watch `fd` for bytes to read, for room to write, for both or neither; -1: it is closed, forget it. */
	void (*watch)(void *ctx, int device, int fd, bool readable, bool writable);
	/* A record was read or written, or the link was opened: into the journal and the pipeline, which may call supervisor_reply and _data. */
	void (*record)(void *ctx, const struct record *);
	/* A transition; `priority` as in syslog.h. */
	void (*log)(void *ctx, int device, int priority, const char *text);
};

enum supervisor_state { SUPERVISOR_CLOSED, SUPERVISOR_CONFIGURING, SUPERVISOR_STREAMING, SUPERVISOR_BACKING_OFF };

struct supervisor_device {
	enum supervisor_state state;
	int64_t since_ns;
	char error[160]; /* of the last failure; empty since it streams */
	char note[328];  /* while it streams: what is not as it was wanted; else empty */
	uint64_t records, bytes_in, bytes_out, opens;
	uint64_t losses;    /* tries that failed, and streams that ended */
	uint64_t decoded;   /* profiles, angles or poses */
	int64_t decoded_ns; /* the newest of them; 0: none yet */
};

struct supervisor;

/* `drivers`: of each device. The configuration is borrowed. NULL when memory is out. */
struct supervisor *supervisor_create(const struct config *, const struct driver *const *drivers,
                                     const struct supervisor_host *);
void supervisor_destroy(struct supervisor *); /* closes what is open */

void supervisor_start(struct supervisor *, int64_t t_ns);
void supervisor_ready(struct supervisor *, int device, bool readable, bool writable, int64_t t_ns);
void supervisor_timer(struct supervisor *, int64_t t_ns);
int64_t supervisor_deadline(const struct supervisor *); /* call supervisor_timer then; INT64_MAX: nothing is due */

/* From the pipeline, within host.record. */
void supervisor_reply(struct supervisor *, int device, const struct reply *);
void supervisor_data(struct supervisor *, int device, int64_t t_ns);

/* The orderly end: devices are stopped, at most so long. */
int64_t supervisor_stop_ns(const struct config *);
void supervisor_stop(struct supervisor *, int64_t t_ns);
bool supervisor_stopped(const struct supervisor *);

const struct supervisor_device *supervisor_device(const struct supervisor *, int device);
const char *supervisor_state_name(enum supervisor_state);

#endif

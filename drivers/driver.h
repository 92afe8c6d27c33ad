/* The seam between devices and the program (style, rule 5).
 *
 *   device --read--> record (bytes, time) --decode--> profile | tilt | pose | reply
 *
 * Recording, replay, simulation, fuzzing and tests all sit here. A driver has three parts:
 *   decoder  pure and passive: bytes of BOTH directions in, records out; learns modes from what it sees, never writes;
 *   dialogue pure: replies and time in, bytes to write, line settings and a deadline out; runs in virtual time;
 *   link     the descriptor: open, read, write, close. The only part that touches a device.
 * Adding a device: one file of each kind and one line in drivers/table.c. */
#ifndef FACET_DRIVERS_DRIVER_H
#define FACET_DRIVERS_DRIVER_H

#include <sys/types.h>

#include "config/config.h"
#include "core/state.h"
#include "core/types.h"

/* LINK_OPENED carries no bytes: the link was opened (anew), and what was begun before is lost. */
enum direction { FROM_DEVICE, TO_DEVICE, LINK_OPENED };

/* What the loop hands to a decoder, in the order in which it does (law L7). */
struct record {
	int64_t log_ns; /* never decreases */
	int64_t t_ns;   /* when the read delivered it; kernel or library stamps where there are any */
	int device;     /* index into config->device */
	enum direction direction;
	const uint8_t *bytes; /* borrowed */
	size_t len;
};

#define REPLY_MAX 1600

/* What a decoder saw that the dialogue may wait for: an ACK, a NAK, a telegram. Nothing is decoded twice. */
struct reply {
	int64_t t_ns;
	int kind; /* of the protocol: see its header */
	size_t len;
	const uint8_t *payload; /* borrowed: command byte and data, checked */
};

/* Where decoders put what they found; calls come in the order of the bytes. */
struct record_sink {
	void *ctx;
	void (*profile)(void *ctx, int device, const struct profile *);
	void (*tilt)(void *ctx, int device, const struct tilt *);
	void (*pose)(void *ctx, int device, const struct pose *);
	void (*reply)(void *ctx, int device, const struct reply *);   /* may be NULL (replay) */
	void (*motion)(void *ctx, int device, const struct motion *); /* may be NULL */
};

/* Verdicts of a decoder, by reason: counted, never logged per event. Names say the reason. */
#define DECODER_COUNTERS_MAX 20
struct decoder_counters {
	int n;
	struct {
		const char *name;
		uint64_t count;
	} counter[DECODER_COUNTERS_MAX];
};

/* How well a device keeps time: for the status. */
struct decoder_timing {
	bool known;            /* anything below is */
	double expected_hz;    /* profiles (angles, poses) a second by what the device says; 0: not known */
	int64_t jitter_p50_ns; /* how far arrivals are behind the least delayed ones, over the last thousand */
	int64_t jitter_p99_ns;
	uint64_t lost;     /* profiles that the device measured and nobody received, by its own counters */
	bool stamps;       /* it stamps (or counts): the two below hold */
	int64_t offset_ns; /* log time - device time, now */
	double drift_ppm;  /* of the device's clock against the host's: positive runs fast */
};

enum device_role { ROLE_LASER, ROLE_TILT, ROLE_POSE, ROLE_MOTION };

#define DIALOGUE_WRITE_MAX 256

/* What a dialogue wants done now. */
struct dialogue_step {
	size_t write_len; /* bytes to write now (recorded as TO_DEVICE when written) */
	uint8_t write[DIALOGUE_WRITE_MAX];
	uint32_t baud;       /* 0, or: set the line to this rate now, after what was written has drained */
	bool flush;          /* discard what the line holds */
	int64_t deadline_ns; /* call again at the latest then; INT64_MAX: only on a reply */
	enum dialogue_state { DIALOGUE_CONFIGURING, DIALOGUE_STREAMING, DIALOGUE_FAILED } state;
	/* DIALOGUE_FAILED: one sentence, what is wrong and what to do. CONFIGURING after STREAMING: why it begins anew.
	 * STREAMING: what is not as it was wanted, if anything; each change is told. */
	char error[160];
};

struct decoder;
struct dialogue;
struct link;

struct driver {
	const char *name; /* the word after `driver:` */
	enum device_role role;

	struct decoder *(*decoder_create)(const struct config_device *, int device);
	void (*decoder_destroy)(struct decoder *);
	void (*decode)(struct decoder *, const struct record *, const struct record_sink *);
	void (*counters)(const struct decoder *, struct decoder_counters *ret);
	void (*timing)(const struct decoder *, struct decoder_timing *ret); /* may be NULL */
	/* Snapshot of all that decoding goes on from, clock filter included (core/state.h). A load that failed leaves the
	 * decoder as new. */
	void (*state)(struct decoder *, struct state *);
	/* The wall clock was set: it is now `ahead_ns` ahead of the times of records. NULL: it matters not. */
	void (*clock)(struct decoder *, int64_t ahead_ns);

	/* NULL for devices that need no dialogue. `config` (all of it) because a servo needs the sweep. */
	struct dialogue *(*dialogue_create)(const struct config *, int device);
	void (*dialogue_destroy)(struct dialogue *);
	void (*dialogue_reset)(struct dialogue *, int64_t t_ns); /* the link was opened (anew) */
	void (*dialogue_reply)(struct dialogue *, const struct reply *);
	void (*dialogue_data)(struct dialogue *, int64_t t_ns); /* a profile, tilt or pose was decoded: it lives */
	void (*dialogue_step)(struct dialogue *, int64_t t_ns, struct dialogue_step *ret);
	/* The wish for an orderly end: later steps stop the device; state FAILED with an empty error: done. May be NULL. */
	void (*dialogue_stop)(struct dialogue *, int64_t t_ns);

	/* open answers at once (a slow connect goes on behind the descriptor); NULL with one sentence in `error`. */
	struct link *(*link_open)(const struct config_device *, char error[160]);
	int (*link_fd)(
	    const struct link
	        *); /* pollable for reading; -1: nothing to poll or read, it streams for ever (a fixed pose) */
	ssize_t (*link_read)(
	    struct link *, uint8_t *buf, size_t cap,
	    int64_t *
	        t_ns); /* bytes, 0: nothing now, -errno: lost. *t_ns is changed where the link knows better than the caller */
	ssize_t (*link_write)(struct link *, const uint8_t *bytes,
	                      size_t len);                               /* bytes taken (0: would block) or -errno */
	int (*link_baud)(struct link *, uint32_t baud, char error[160]); /* NULL where there is none */
	void (*link_flush)(struct link *);                               /* may be NULL */
	/* What -`error` of read or write means here, and what to do: one sentence. May be NULL: strerror. */
	void (*link_error)(const struct link *, int error, char ret[160]);
	/* What is worth knowing of the line that was opened, one sentence or empty: said once. May be NULL. */
	void (*link_note)(const struct link *, char ret[160]);
	void (*link_close)(struct link *);
};

/* Ends with NULL. */
extern const struct driver *const driver_table[];
const struct driver *driver_find(const char *name); /* NULL: unknown */

extern const struct driver driver_lms2xx, driver_modbus, driver_pose, driver_tim, driver_lms1xx, driver_lms5xx,
    driver_can, driver_canopen, driver_odometry, driver_carmen;

#endif

/* What the files of the rig share: the rig itself, a device's link, and the carriers behind it. A carrier is the way
 * between a simulated device and its driver: bytes in order (rig_stream.c), frames on a bus (rig_can.c), transactions
 * (rig_modbus.c). Times in here are log times. */
#ifndef FACET_TESTS_RIG_PARTS_H
#define FACET_TESTS_RIG_PARTS_H

#include <stdio.h>

#include "tests/rig.h"

#define RIG_EPOCH_NS INT64_C(1000000000000000000) /* log time is about that of the wall clock: digits are lost there */
#define RIG_POSE_NS  (10 * RIG_MS)
#define RIG_DUMMY_FD 1000
#define RIG_TRUTHS   160 /* profiles remembered: a second and more at 75 Hz and 2 turns */
#define RIG_TIMES    4096
#define RIG_ANGLES   2000

struct rig_carrier {
	void (*attach)(struct link *); /* its brain has come */
	void (*detach)(struct link *);
	/* The next thing that happens by itself, or because the supervisor watches; INT64_MAX: none. */
	int64_t (*due)(const struct link *);
	void (*serve)(struct link *); /* all that is due now */
	void (*stir)(struct link *);  /* its brain was told something: what has it to say? */
	bool (*readable)(const struct link *);
	bool (*writable)(const struct link *);
	/* False: it knows no such fault. */
	bool (*fault)(struct link *, const struct sim_fault *, bool on);
	uint64_t (*lost_profiles)(const struct link *); /* fell under the line; NULL: there are none */
};
extern const struct rig_carrier rig_stream, rig_can, rig_modbus;

/* A driver's link, whatever is behind it. */
struct link {
	struct rig *rig;
	int device;
	enum rig_transport transport;
	const struct rig_carrier *carrier; /* NULL: nothing is attached */
	struct sim_device brain;
	bool readable, writable; /* what the supervisor watches */
	uint64_t random;
	void *own; /* the carrier's */
	/* for the view */
	int64_t first_request_ns;
	uint64_t requests;
	uint8_t heard[sizeof(((struct rig_view *)0)->heard)];
};

/* What a scanner measured: where each beam ended. */
struct truth {
	int64_t t_ns, turn_ns, beam_ns;
	int interlace, n;
	double first_rad, step_rad;
	float range_m[PROFILE_BEAMS_MAX]; /* < 0: nothing */
	float point_m[PROFILE_BEAMS_MAX][3];
};

struct scanner {
	struct rig *rig;
	int device;
	uint32_t raster;
	struct transform tilt_laser, base_tilt;
	bool tilts;
	struct truth *truth; /* RIG_TRUTHS, a ring */
	uint64_t truths;
	struct rig_points points;
	int64_t time_ns[RIG_TIMES];
	uint64_t times;
	uint64_t angles, angle_off[RIG_ANGLES + 1]; /* how many are off by so many thousandths of a degree; or more */
};

/* What was decoded of a device, and when. */
struct flow {
	uint64_t decoded;
	int64_t last_ns, longest_pause_ns; /* -1: nothing yet */
};

struct rig {
	struct rig_params params;
	struct config config;
	struct world *world;
	struct pipeline *pipeline;
	struct supervisor *supervisor;
	struct driver driver[CONFIG_DEVICES_MAX];
	struct link link[CONFIG_DEVICES_MAX];
	struct scanner scanner[CONFIG_DEVICES_MAX];
	struct flow flow[CONFIG_DEVICES_MAX];
	int servo, localisation;             /* whose records are fed; -1: nobody's */
	double (*angle)(void *ctx, int64_t); /* of the tilt frame, where a simulated axis moves it */
	void *angle_ctx;
	struct rig_keeper keeper;
	int64_t now_ns, tilt_ns, pose_ns, tick_ns, ahead_ns, tilt_late_ns, pose_period_ns;
	bool started, no_poses;
	struct pose pose[2]; /* where the robot is at both ends of the piece that was asked for last */
	int64_t piece;
	struct rig_log log[RIG_LOG_LINES];
	size_t logged;
};

/* The driver's seam knows no context: one rig at a time. */
extern struct rig *the_rig;

static inline struct link *rig_link_of(const struct config_device *device)
{
	return &the_rig->link[device - the_rig->config.device];
}

static inline bool rig_alive(const struct link *l)
{
	return !l->brain.alive || l->brain.alive(l->brain.ctx);
}

static inline int64_t rig_earlier(int64_t a, int64_t b)
{
	return a < b ? a : b;
}

_Noreturn void rig_give_up(const char *what);
/* The device heard these bytes. */
void rig_note_request(struct link *, const uint8_t *bytes, size_t len);

/* rig_stream.c: the driver's link functions, but open. */
struct link *rig_stream_open(const struct config_device *, char error[160]);
int rig_stream_fd(const struct link *);
ssize_t rig_stream_read(struct link *, uint8_t *buf, size_t cap, int64_t *t_ns);
ssize_t rig_stream_write(struct link *, const uint8_t *bytes, size_t len);
int rig_stream_baud(struct link *, uint32_t baud, char error[160]);
void rig_stream_flush(struct link *);
void rig_stream_close(struct link *);

/* rig_truth.c */
struct pose rig_place(const struct rig *, int64_t piece); /* at the beginning of a RIG_POSE_NS */
void rig_scan(void *scanner, struct profile *);           /* of struct scene */
void rig_compare(struct scanner *, const struct row *);

/* rig_feed.c: the records of servo and localisation that no simulated device sends. */
int64_t rig_feed_due(const struct rig *);
void rig_feed(struct rig *);
void rig_handle(struct rig *, const struct record *); /* into the pipeline, and the list that is kept */

#endif

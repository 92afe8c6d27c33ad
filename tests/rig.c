/* The loop of the rig: the earliest of all that is due, over and over.
 *
 *   brains      advance at their deadlines, and after whatever they were told; what left them goes to the wire
 *   wires       pieces arrive later than they left, by a delay drawn for each; never one before its forerunner
 *   supervisor  is told of readable and writable links while it watches them, and of its own deadlines
 *   servo       an angle every 5 ms, as a Modbus transaction of 2 ms; the pose every 10 ms, as a line; a tick every 100 ms
 *
 * The robot moves in straight pieces between the places where it says where it is, so that the truth has no error of
 * interpolation; the servo goes up and down at a constant speed. */
#include "tests/rig.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "drivers/modbus_wire.h"
#include "drivers/pose_line.h"

#define EPOCH_NS      INT64_C(1000000000000000000) /* log time is about that of the wall clock: digits are lost there */
#define TILT_NS       (5 * RIG_MS)
#define TILT_RTT_NS   (2 * RIG_MS)
#define POSE_NS       (10 * RIG_MS)
#define TICK_NS       (100 * RIG_MS)
#define CONNECT_NS    (RIG_MS / 2)
#define SYN_AGAIN_NS  RIG_SECOND /* a connection that hangs is asked for again after 1 s, then 3 s */
#define REACH_M       30.0
#define WIRE_BYTES    (256 << 10) /* more waits in the device */
#define PIECES        8192
#define TRUTHS        160 /* profiles remembered: a second and more at 75 Hz and 2 turns */
#define KNOWN_NS      (2 * RIG_SECOND)
#define TIMES         4096
#define CONTIGUOUS_NS (20 * RIG_MS)
#define DUMMY_FD      1000

enum fault {
	UNPLUG,
	REFUSE,
	HANG,
	RESET,
	HALF_OPEN,
	BYTEWISE,
	HOLD,
	SLOW_WRITES,
	NO_BAUD,
	FAULTS,
	/* of the world around */
	WALL_CLOCK = FAULTS,
	LATE_ANGLES,
	NO_ANGLES,
	ALL_FAULTS
};
static const char *const fault_names[ALL_FAULTS] = {"unplug",    "refuse",     "hang",        "reset",
                                                    "half-open", "bytewise",   "hold",        "slow writes",
                                                    "no baud",   "wall clock", "late angles", "no angles"};

/* What a scanner measured: where each beam ended. */
struct truth {
	int64_t t_ns, turn_ns;
	int interlace, n;
	double first_rad, step_rad;
	float range_m[PROFILE_BEAMS_MAX]; /* < 0: nothing */
	float point_m[PROFILE_BEAMS_MAX][3];
};

struct piece {
	int64_t left_ns, arrival_ns;
	size_t len, read;
	int ends;     /* of telegrams with a profile, and of garbage */
	int profiles; /* those of them that left right */
};

/* The way from a device to the host, and the link at its end. */
struct link {
	struct rig *rig;
	int device;
	enum rig_transport transport;
	struct sim_device brain;
	bool attached;
	enum { CLOSED, CONNECTING, OPEN, DEAD } state;
	int error;                      /* of DEAD */
	int64_t connect_ns, connect_at; /* begun; to be looked at again */
	bool dumb;                      /* half open until it is closed */
	bool on[FAULTS];
	double value[FAULTS];
	int64_t write_ns;        /* slow writes: not before */
	bool readable, writable; /* what the supervisor watches */
	uint64_t random;
	struct piece piece[PIECES]; /* a ring */
	unsigned first, pieces;
	uint8_t *bytes; /* those of the pieces, a ring */
	size_t begin, len;
	int64_t last_arrival_ns;
	int64_t torn_ns; /* the beginning of the telegram that leaves now was lost then; -1: it was not */
	int64_t cut_ns;  /* likewise of the one that is read now */
	uint64_t sent_seen, ends_seen;
	/* for the view */
	uint64_t lost_profiles;
	int64_t first_request_ns;
	uint64_t requests;
	uint8_t heard[sizeof(((struct rig_view *)0)->heard)];
};

struct scanner {
	struct rig *rig;
	int device;
	uint32_t raster;
	struct transform tilt_laser, base_tilt;
	bool tilts;
	struct truth *truth; /* TRUTHS, a ring */
	uint64_t truths;
	struct rig_points points;
	int64_t time_ns[TIMES];
	uint64_t times;
	uint64_t profiles;
	int64_t last_data_ns, longest_pause_ns;
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
	int servo, localisation; /* indices, -1: none */
	int64_t now_ns, tilt_ns, pose_ns, tick_ns, ahead_ns, tilt_late_ns;
	bool started;
	struct pose pose[2]; /* where the robot is at both ends of the piece that was asked for last */
	int64_t piece;
	struct rig_log log[RIG_LOG_LINES];
	size_t logged;
};

/* The driver's seam knows no context: one rig at a time. */
static struct rig *the_rig;

static _Noreturn void give_up(const char *what)
{
	fprintf(stderr, "rig: %s\n", what);
	exit(1);
}

static double draw(uint64_t *random)
{
	return sim_random(random);
}

/* What moves */

/* Forth and back along the drive, so that it never ends. */
static struct pose place(const struct rig *r, int64_t piece)
{
	double length_s = world_drive_seconds(r->world), t_s;

	if (r->params.stand)
		return world_drive(r->world, 0.0);
	t_s = fmod((double)piece * 1e-9 * (double)POSE_NS, 2 * length_s);
	return world_drive(r->world, t_s > length_s ? 2 * length_s - t_s : t_s);
}

static struct transform base_at(struct rig *r, int64_t t_ns)
{
	int64_t since_ns = t_ns - EPOCH_NS, piece = since_ns / POSE_NS;
	double part = (double)(since_ns - piece * POSE_NS) / (double)POSE_NS;
	struct vec3 p;
	struct quat q;

	if (r->piece != piece) {
		r->pose[0] = place(r, piece);
		r->pose[1] = place(r, piece + 1);
		r->piece = piece;
	}
	p = vec3_lerp(r->pose[0].position_m, r->pose[1].position_m, part);
	q = quat_between(r->pose[0].rotation, r->pose[1].rotation, part);
	return transform_quat(p, q);
}

/* Up and down between the ends of the configured sweep; positive looks down. */
static double tilt_at(const struct rig *r, int64_t t_ns)
{
	double from = r->config.sweep.from_rad, to = r->config.sweep.to_rad, speed = r->config.sweep.speed_rad_s;
	double way, length = to - from;

	if (!r->config.sweep.set || length <= 0 || speed <= 0)
		return 0.0;
	way = fmod((double)(t_ns - EPOCH_NS) * 1e-9 * speed, 2 * length);
	return from + (way > length ? 2 * length - way : way);
}

double rig_tilt(const struct rig *r, int64_t t_ns)
{
	return tilt_at(r, t_ns);
}

static struct transform laser_at(struct scanner *s, int64_t t_ns)
{
	struct transform base = base_at(s->rig, t_ns);
	struct transform tilt = transform_tilt(s->tilts ? tilt_at(s->rig, t_ns) : 0.0), t;

	t = transform_compose(&base, &s->base_tilt);
	t = transform_compose(&t, &tilt);
	return transform_compose(&t, &s->tilt_laser);
}

static void set_truth(struct truth *truth, int k, double bearing, double range, const struct transform *laser)
{
	struct vec3 beam = {range * trig_cos(bearing), range * trig_sin(bearing), 0.0};
	struct vec3 point = transform_point(laser, beam);

	truth->range_m[k] = (float)range;
	truth->point_m[k][0] = (float)point.x;
	truth->point_m[k][1] = (float)point.y;
	truth->point_m[k][2] = (float)point.z;
}

/* Of each turn of the mirror every n-th beam is cast from where the scanner is then; those up to the next one of that turn
 * have its range and, for so short a time, its place. */
static void cast_beams(struct scanner *s, const struct profile *p, struct truth *truth)
{
	int thin = s->rig->params.thin > 1 ? s->rig->params.thin : 1;
	struct transform laser[4] = {0};
	double range[4] = {0};

	for (int k = 0; k < p->n; k++) {
		int turn = k % p->interlace & 3, at = k / p->interlace;
		double bearing = p->first_rad + k * p->step_rad;
		struct vec3 beam = {trig_cos(bearing), trig_sin(bearing), 0.0};

		if (at % thin == 0) {
			laser[turn] = laser_at(s, p->t_ns + (int64_t)turn * p->turn_ns + (int64_t)at * p->beam_ns);
			range[turn] =
			    world_cast(s->rig->world, laser[turn].t, transform_direction(&laser[turn], beam), REACH_M);
		}
		set_truth(truth, k, bearing, range[turn], &laser[turn]);
	}
}

static void scan(void *ctx, struct profile *p)
{
	struct scanner *s = ctx;
	struct truth *truth = &s->truth[s->truths++ % TRUTHS];

	truth->t_ns = p->t_ns;
	truth->turn_ns = p->turn_ns;
	truth->interlace = p->interlace;
	truth->n = p->n;
	truth->first_rad = p->first_rad;
	truth->step_rad = p->step_rad;
	cast_beams(s, p, truth);
	for (int k = 0; k < p->n; k++) {
		p->state[k] = truth->range_m[k] > 0 ? BEAM_OK : BEAM_NO_ECHO;
		p->range_m[k] = truth->range_m[k] > 0 ? truth->range_m[k] : 0;
	}
}

/* Rows against the truth */

/* Index in the profile of the row's beam i; -1: it has none there. */
static int beam_of(const struct truth *truth, const struct row *row, uint32_t i)
{
	double k = (row->first_rad + i * row->step_rad - truth->first_rad) / truth->step_rad;
	int nearest = (int)floor(k + 0.5);

	return nearest >= 0 && nearest < truth->n && fabs(k - nearest) < 0.3 ? nearest : -1;
}

static bool same_ranges(const struct truth *truth, const struct row *row)
{
	uint32_t step = (row->n / 24 + 1) | 1, looked = 0, same = 0;

	for (uint32_t i = 0; i < row->n; i += step) {
		int k;

		if (row->beam[i].state != BEAM_OK || (k = beam_of(truth, row, i)) < 0)
			continue;
		looked++;
		same += fabsf(truth->range_m[k] - row->beam[i].range_m) < 0.012f;
	}
	return looked > 0 && same * 10 >= looked * 9;
}

/* True time of the row's first beam if it was made of this profile. */
static int64_t begin_of(const struct truth *truth, const struct row *row)
{
	int k = beam_of(truth, row, 0);

	return truth->t_ns + (k < 0 ? 0 : k % truth->interlace) * truth->turn_ns;
}

static const struct truth *recognise(const struct scanner *s, const struct row *row, int64_t *ret_off_ns)
{
	const struct truth *found = NULL;
	uint64_t known = s->truths < TRUTHS ? s->truths : TRUTHS;

	for (uint64_t i = 0; i < known; i++) {
		const struct truth *truth = &s->truth[i];
		int64_t off_ns = row->t_ns - begin_of(truth, row);

		if (llabs(off_ns) > KNOWN_NS || (found && llabs(off_ns) >= llabs(*ret_off_ns)))
			continue;
		if (!same_ranges(truth, row))
			continue;
		found = truth;
		*ret_off_ns = off_ns;
	}
	return found;
}

static void compare(struct scanner *s, const struct row *row)
{
	int64_t off_ns = 0;
	const struct truth *truth = recognise(s, row, &off_ns);
	bool any = false;

	for (uint32_t i = 0; i < row->n; i++) {
		const struct row_beam *b = &row->beam[i];
		int k = truth && b->state == BEAM_OK ? beam_of(truth, row, i) : -1;
		double off_m = 1e9;

		if (b->state != BEAM_OK)
			continue;
		any = true;
		if (k >= 0) {
			const float *p = truth->point_m[k];
			struct vec3 d = {b->point.x - (double)p[0], b->point.y - (double)p[1],
			                 b->point.z - (double)p[2]};

			off_m = sqrt(d.x * d.x + d.y * d.y + d.z * d.z);
			if (off_m > s->points.worst_m)
				s->points.worst_m = off_m;
		}
		s->points.points++;
		s->points.near += off_m <= RIG_NEAR_M;
	}
	s->points.rows++;
	if (truth)
		s->time_ns[s->times++ % TIMES] = llabs(off_ns);
	else
		s->points.unknown_rows += any;
}

static bool take_row(void *ctx, struct row *row)
{
	struct rig *r = ctx;

	for (int i = 0; i < r->config.devices; i++)
		if (r->driver[i].role == ROLE_LASER && r->scanner[i].raster == row->raster)
			compare(&r->scanner[i], row);
	row_destroy(row);
	return true;
}

static void flush_rows(void *ctx)
{
	(void)ctx;
}

static void on_reply(void *ctx, int device, const struct reply *reply)
{
	supervisor_reply(((struct rig *)ctx)->supervisor, device, reply);
}

static void on_data(void *ctx, int device, int64_t t_ns)
{
	struct rig *r = ctx;
	struct scanner *s = &r->scanner[device];

	if (s->last_data_ns >= 0 && t_ns - s->last_data_ns > s->longest_pause_ns)
		s->longest_pause_ns = t_ns - s->last_data_ns;
	s->last_data_ns = t_ns;
	s->profiles++;
	supervisor_data(r->supervisor, device, t_ns);
}

/* The wire */

static struct piece *piece_at(struct link *l, unsigned i)
{
	return &l->piece[(l->first + i) % PIECES];
}

static void forget_piece(struct link *l)
{
	l->first = (l->first + 1) % PIECES;
	l->pieces--;
}

static void copy_out(const struct link *l, uint8_t *ret, size_t n)
{
	size_t one = WIRE_BYTES - l->begin < n ? WIRE_BYTES - l->begin : n;

	memcpy(ret, l->bytes + l->begin, one);
	memcpy(ret + one, l->bytes, n - one);
}

static void copy_in(struct link *l, const uint8_t *bytes, size_t n)
{
	size_t at = (l->begin + l->len) % WIRE_BYTES, one = WIRE_BYTES - at < n ? WIRE_BYTES - at : n;

	memcpy(l->bytes + at, bytes, one);
	memcpy(l->bytes, bytes + one, n - one);
	l->len += n;
}

/* What is lost between the device and its reader is counted by telegrams with a profile: where the end of one passes,
 * but its beginning was lost less than CONTIGUOUS_NS before, it is lost too. */
static bool is_rest(int64_t lost_ns, int64_t t_ns)
{
	return lost_ns >= 0 && t_ns - lost_ns <= CONTIGUOUS_NS;
}

static void lose_pieces(struct link *l, unsigned n)
{
	for (unsigned i = 0; i < n; i++) {
		const struct piece *piece = piece_at(l, 0);
		size_t left = piece->len - piece->read;

		l->lost_profiles += (uint64_t)piece->profiles;
		l->cut_ns = piece->ends > 0 ? -1 : piece->left_ns;
		l->begin = (l->begin + left) % WIRE_BYTES;
		l->len -= left;
		forget_piece(l);
	}
}

static int64_t draw_arrival(struct link *l)
{
	int64_t delay_ns = l->rig->params.delay_ns ? l->rig->params.delay_ns : 300000;
	int64_t arrival_ns = l->rig->now_ns + (int64_t)((0.1 + 0.9 * draw(&l->random)) * (double)delay_ns);

	if (l->on[HOLD]) {
		int64_t hold_ns = (int64_t)((l->value[HOLD] > 0 ? l->value[HOLD] : 100) * (double)RIG_MS);

		arrival_ns += hold_ns - (arrival_ns - EPOCH_NS) % hold_ns;
	}
	if (arrival_ns < l->last_arrival_ns)
		arrival_ns = l->last_arrival_ns;
	return l->last_arrival_ns = arrival_ns;
}

static void carry(struct link *l, const uint8_t *bytes, size_t n, int ends, int profiles)
{
	int64_t now_ns = l->rig->now_ns;
	bool rest = is_rest(l->torn_ns, now_ns);

	if (l->state != OPEN || l->dumb) {
		l->lost_profiles += (uint64_t)profiles;
		l->torn_ns = ends > 0 ? -1 : now_ns;
		return;
	}
	l->torn_ns = rest && ends == 0 ? now_ns : -1;
	if (rest && ends > 0 && profiles == ends) {
		l->lost_profiles++;
		profiles--;
	}
	copy_in(l, bytes, n);
	*piece_at(l, l->pieces++) = (struct piece){
	    .left_ns = now_ns, .arrival_ns = draw_arrival(l), .len = n, .ends = ends, .profiles = profiles};
}

/* What has left the device goes onto the wire. */
static void drain(struct link *l)
{
	uint8_t bytes[SIM_TRANSFER_MAX];

	while (l->pieces < PIECES && WIRE_BYTES - l->len >= sizeof(bytes)) {
		size_t n = l->brain.transmit(l->brain.ctx, bytes, sizeof(bytes));
		struct sim_counts counts;

		if (n == 0)
			return;
		l->brain.counts(l->brain.ctx, &counts);
		/* Garbage ends whatever was begun. */
		carry(l, bytes, n, (int)(counts.sent + counts.corrupted + counts.garbage - l->ends_seen),
		      (int)(counts.sent - l->sent_seen));
		l->sent_seen = counts.sent;
		l->ends_seen = counts.sent + counts.corrupted + counts.garbage;
	}
}

static void stir(struct link *l)
{
	l->brain.advance(l->brain.ctx, l->rig->now_ns);
	drain(l);
}

/* The virtual link */

static bool alive(const struct link *l)
{
	return !l->brain.alive || l->brain.alive(l->brain.ctx);
}

static void say_connected(struct link *l, bool yes)
{
	if (l->brain.connected)
		l->brain.connected(l->brain.ctx, yes, l->rig->now_ns);
	stir(l);
}

static void break_link(struct link *l, int error)
{
	if (l->state == CLOSED || l->state == DEAD)
		return;
	if (l->state == OPEN)
		say_connected(l, false);
	lose_pieces(l, l->pieces);
	l->state = DEAD;
	l->error = error;
}

static void begin_connecting(struct link *l)
{
	l->state = CONNECTING;
	l->connect_ns = l->rig->now_ns;
	l->connect_at = l->rig->now_ns + CONNECT_NS;
}

static void connect_now(struct link *l)
{
	if (l->on[UNPLUG] || l->on[HANG] || !alive(l)) {
		int64_t since_ns = l->rig->now_ns - l->connect_ns;

		l->connect_at = l->connect_ns + (since_ns < SYN_AGAIN_NS ? 1 : 3) * SYN_AGAIN_NS + CONNECT_NS;
	} else if (l->on[REFUSE]) {
		l->state = DEAD;
		l->error = ECONNREFUSED;
	} else {
		l->state = OPEN;
		say_connected(l, true);
	}
}

static struct link *link_of(const struct config_device *device)
{
	return &the_rig->link[device - the_rig->config.device];
}

static struct link *link_open(const struct config_device *device, char error[160])
{
	struct link *l = link_of(device);

	if (l->transport != RIG_TCP && (l->on[UNPLUG] || !alive(l))) {
		snprintf(error, 160, "%.100s: there is no such device; plug it in, or correct `%s`",
		         l->transport == RIG_SERIAL ? device->port : device->connect,
		         l->transport == RIG_SERIAL ? "port" : "connect");
		return NULL;
	}
	l->dumb = false;
	l->first = l->pieces = 0;
	l->begin = l->len = 0;
	l->write_ns = 0;
	l->cut_ns = -1;
	if (l->transport == RIG_TCP) {
		begin_connecting(l);
	} else {
		l->state = OPEN;
		say_connected(l, true);
	}
	return l;
}

static int link_fd(const struct link *l)
{
	return DUMMY_FD + l->device;
}

/* What has arrived, as much as there is room for: a stream has no pieces. */
static ssize_t link_read(struct link *l, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	size_t n = 0;

	(void)t_ns;
	if (l->state == DEAD)
		return -l->error;
	if (l->on[BYTEWISE])
		cap = 1;
	while (l->pieces > 0 && n < cap && piece_at(l, 0)->arrival_ns <= l->rig->now_ns) {
		struct piece *piece = piece_at(l, 0);
		size_t left = piece->len - piece->read, take = left < cap - n ? left : cap - n;

		copy_out(l, buf + n, take);
		l->begin = (l->begin + take) % WIRE_BYTES;
		l->len -= take;
		piece->read += take;
		n += take;
		if (piece->read == piece->len) {
			bool rest = is_rest(l->cut_ns, piece->left_ns);

			l->lost_profiles += rest && piece->ends > 0 && piece->profiles == piece->ends;
			l->cut_ns = rest && piece->ends == 0 ? piece->left_ns : -1;
			forget_piece(l);
		}
	}
	return (ssize_t)n;
}

static ssize_t link_write(struct link *l, const uint8_t *bytes, size_t len)
{
	struct rig *r = l->rig;

	if (l->state == DEAD)
		return -l->error;
	if (l->state == CONNECTING || r->now_ns < l->write_ns)
		return 0;
	if (l->on[SLOW_WRITES]) {
		len = 1;
		l->write_ns = r->now_ns + RIG_MS;
	}
	if (l->dumb)
		return (ssize_t)len;
	if (l->first_request_ns < 0)
		l->first_request_ns = r->now_ns;
	for (size_t i = 0; i < len && l->requests + i < sizeof(l->heard); i++)
		l->heard[l->requests + i] = bytes[i];
	l->requests += len;
	l->brain.receive(l->brain.ctx, bytes, len, r->now_ns);
	stir(l);
	return (ssize_t)len;
}

static int link_baud(struct link *l, uint32_t baud, char error[160])
{
	if (l->on[NO_BAUD] && (l->value[NO_BAUD] <= 0 || (uint32_t)l->value[NO_BAUD] == baud)) {
		snprintf(error, 160, "%.80s does not do %u Bd; set `baud` to a rate that the adapter knows",
		         l->rig->config.device[l->device].port, (unsigned)baud);
		return -EINVAL;
	}
	if (l->brain.host_baud)
		l->brain.host_baud(l->brain.ctx, baud);
	return 0;
}

/* Only what has arrived: the rest is on its way. */
static void link_flush(struct link *l)
{
	unsigned arrived = 0;

	while (arrived < l->pieces && piece_at(l, arrived)->arrival_ns <= l->rig->now_ns)
		arrived++;
	lose_pieces(l, arrived);
}

static void link_close(struct link *l)
{
	if (l->state == OPEN)
		say_connected(l, false);
	lose_pieces(l, l->pieces);
	l->state = CLOSED;
}

/* The supervisor's host */

static void on_watch(void *ctx, int device, int fd, bool readable, bool writable)
{
	struct link *l = &((struct rig *)ctx)->link[device];

	l->readable = fd >= 0 && readable;
	l->writable = fd >= 0 && writable;
}

static void on_record(void *ctx, const struct record *record)
{
	pipeline_handle(((struct rig *)ctx)->pipeline, record);
}

static void on_log(void *ctx, int device, int priority, const char *text)
{
	struct rig *r = ctx;
	struct rig_log *line = &r->log[r->logged++ % RIG_LOG_LINES];

	(void)priority;
	line->t_ns = r->now_ns - EPOCH_NS;
	line->device = device;
	snprintf(line->text, sizeof(line->text), "%s", text);
}

/* What is fed */

static void feed(struct rig *r, int device, const uint8_t *bytes, size_t len)
{
	struct record record = {.log_ns = r->now_ns, .t_ns = r->now_ns, .device = device, .bytes = bytes, .len = len};

	pipeline_handle(r->pipeline, &record);
}

static void feed_tilt(struct rig *r)
{
	const struct config_device *servo = &r->config.device[r->servo];
	uint8_t bytes[MODBUS_WIRE_MAX];
	int64_t middle_ns;
	struct modbus_transaction t = {.t_answer_ns = r->now_ns, .unit = (uint8_t)servo->slave};

	if (r->tilt_late_ns == INT64_MAX)
		return;
	t.t_answer_ns -= r->tilt_late_ns;
	t.t_request_ns = t.t_answer_ns - TILT_RTT_NS;
	middle_ns = t.t_request_ns + TILT_RTT_NS / 2;
	t.function = modbus_wire_read_function(&servo->position);
	t.address = modbus_wire_address(servo, servo->position.address);
	t.n = (uint16_t)modbus_wire_registers(&servo->position);
	if (modbus_wire_encode(&servo->position, tilt_at(r, middle_ns), t.value) < 0)
		give_up("the servo's register cannot hold the angle");
	feed(r, r->servo, bytes, modbus_wire_put(&t, bytes));
}

static void feed_pose(struct rig *r)
{
	struct pose pose = place(r, (r->now_ns - EPOCH_NS) / POSE_NS);
	char line[POSE_LINE_MAX];
	int n;

	pose.t_ns = r->now_ns + r->ahead_ns;
	n = pose_line_print(&pose, line, sizeof(line));
	feed(r, r->localisation, (const uint8_t *)line, (size_t)n);
}

static void feed_due(struct rig *r)
{
	if (r->servo >= 0 && r->now_ns >= r->tilt_ns) {
		feed_tilt(r);
		r->tilt_ns += TILT_NS;
	}
	if (r->localisation >= 0 && r->now_ns >= r->pose_ns) {
		feed_pose(r);
		r->pose_ns += POSE_NS;
	}
	if (r->now_ns >= r->tick_ns) {
		pipeline_tick(r->pipeline, r->now_ns);
		r->tick_ns += TICK_NS;
	}
}

/* The loop */

static int64_t earlier(int64_t a, int64_t b)
{
	return a < b ? a : b;
}

static int64_t next_of_link(const struct link *l)
{
	int64_t next_ns;

	if (!l->attached)
		return INT64_MAX;
	next_ns = l->brain.deadline(l->brain.ctx);
	if (l->pieces == PIECES || WIRE_BYTES - l->len < SIM_TRANSFER_MAX)
		next_ns = INT64_MAX; /* the wire is full: it waits for its reader */
	if (l->state == CONNECTING)
		next_ns = earlier(next_ns, l->connect_at);
	if (l->readable && l->pieces > 0)
		next_ns = earlier(next_ns, l->piece[l->first].arrival_ns);
	if (l->readable && l->state == DEAD)
		next_ns = l->rig->now_ns;
	if (l->writable && l->state == OPEN)
		next_ns = earlier(next_ns, l->write_ns);
	return next_ns;
}

static int64_t next_event(const struct rig *r)
{
	int64_t next_ns = earlier(r->tick_ns, supervisor_deadline(r->supervisor));

	if (r->servo >= 0)
		next_ns = earlier(next_ns, r->tilt_ns);
	if (r->localisation >= 0)
		next_ns = earlier(next_ns, r->pose_ns);
	for (int i = 0; i < r->config.devices; i++)
		next_ns = earlier(next_ns, next_of_link(&r->link[i]));
	return next_ns > r->now_ns ? next_ns : r->now_ns;
}

/* Nobody hears of it where the power goes: a connection is half open then, a USB device gone. */
static void see_power(struct link *l)
{
	if (l->state != OPEN || alive(l))
		return;
	if (l->transport == RIG_TCP)
		l->dumb = true;
	else
		break_link(l, ENODEV);
}

static void serve(struct link *l)
{
	struct rig *r = l->rig;
	bool readable, writable;

	if (!l->attached)
		return;
	if (l->state == CONNECTING && l->connect_at <= r->now_ns)
		connect_now(l);
	if (l->brain.deadline(l->brain.ctx) <= r->now_ns)
		stir(l);
	see_power(l);
	readable = l->readable && (l->state == DEAD || (l->pieces > 0 && piece_at(l, 0)->arrival_ns <= r->now_ns));
	writable = l->writable && (l->state == DEAD || (l->state == OPEN && l->write_ns <= r->now_ns));
	if (readable || writable)
		supervisor_ready(r->supervisor, l->device, readable, writable, r->now_ns);
}

void rig_run(struct rig *r, int64_t for_ns)
{
	int64_t until_ns = r->now_ns + for_ns, next_ns;
	int turns = 0;

	while ((next_ns = next_event(r)) <= until_ns) {
		turns = next_ns == r->now_ns ? turns + 1 : 0;
		if (turns > 100000)
			give_up("the time stands still");
		r->now_ns = next_ns;
		for (int i = 0; i < r->config.devices; i++)
			serve(&r->link[i]);
		feed_due(r);
		if (supervisor_deadline(r->supervisor) <= r->now_ns)
			supervisor_timer(r->supervisor, r->now_ns);
	}
	r->now_ns = until_ns;
}

void rig_start(struct rig *r)
{
	supervisor_start(r->supervisor, r->now_ns);
	r->started = true;
}

void rig_stop(struct rig *r)
{
	supervisor_stop(r->supervisor, r->now_ns);
	for (int i = 0; i < 2000 && !supervisor_stopped(r->supervisor); i++)
		rig_run(r, RIG_MS);
}

int64_t rig_now(const struct rig *r)
{
	return r->now_ns - EPOCH_NS;
}

int64_t rig_epoch_ns(const struct rig *r)
{
	return r->now_ns;
}

/* Faults */

static bool link_fault(struct link *l, enum fault kind, double value, bool on)
{
	l->on[kind] = on && kind != RESET && kind != HALF_OPEN;
	l->value[kind] = value;
	if (!on || l->state == CLOSED)
		return true;
	switch (kind) {
	case UNPLUG:
		if (l->transport == RIG_TCP)
			l->dumb = true;
		else
			break_link(l, l->transport == RIG_SERIAL ? EIO : ENODEV);
		break;
	case REFUSE:
	case HANG:
	case RESET:
		break_link(l, l->transport == RIG_TCP ? ECONNRESET : EIO);
		break;
	case HALF_OPEN:
		l->dumb = true;
		break;
	default:
		break;
	}
	if (l->dumb)
		lose_pieces(l, l->pieces);
	return true;
}

static bool world_fault(struct rig *r, enum fault kind, double value, bool on)
{
	switch (kind) {
	case WALL_CLOCK:
		r->ahead_ns = on ? (int64_t)(value * (double)RIG_SECOND) : 0;
		pipeline_clock(r->pipeline, r->ahead_ns);
		break;
	case LATE_ANGLES:
		r->tilt_late_ns = on ? (int64_t)(value * (double)RIG_MS) : 0;
		break;
	default:
		r->tilt_late_ns = on ? INT64_MAX : 0;
		break;
	}
	return true;
}

static bool order(struct rig *r, const char *device, const struct sim_fault *what, bool on)
{
	struct link *l = &r->link[rig_find(r, device)];
	struct sim_fault fault = *what;

	for (int i = 0; i < ALL_FAULTS; i++)
		if (strcmp(fault.kind, fault_names[i]) == 0)
			return i < FAULTS ? link_fault(l, (enum fault)i, fault.value, on)
			                  : world_fault(r, (enum fault)i, fault.value, on);
	snprintf(fault.device, sizeof(fault.device), "%s", device);
	if (!l->brain.fault(l->brain.ctx, &fault, on, r->now_ns))
		return false;
	stir(l);
	return true;
}

bool rig_fault(struct rig *r, const char *device, const char *kind, double value, bool on)
{
	struct sim_fault fault = {.value = value, .for_ns = INT64_MAX};

	snprintf(fault.kind, sizeof(fault.kind), "%s", kind);
	return order(r, device, &fault, on);
}

bool rig_once(struct rig *r, const char *device, const char *kind, double value)
{
	struct sim_fault fault = {.value = value};

	snprintf(fault.kind, sizeof(fault.kind), "%s", kind);
	return order(r, device, &fault, true);
}

/* To be seen from outside */

int rig_find(const struct rig *r, const char *device)
{
	for (int i = 0; i < r->config.devices; i++)
		if (strcmp(r->config.device[i].name, device) == 0)
			return i;
	give_up("a device of this name is not configured");
}

void rig_view(const struct rig *r, const char *device, struct rig_view *ret)
{
	int i = rig_find(r, device);
	const struct link *l = &r->link[i];
	const struct scanner *s = &r->scanner[i];

	memset(ret, 0, sizeof(*ret));
	ret->line = *supervisor_device(r->supervisor, i);
	ret->state = ret->line.state;
	l->brain.counts(l->brain.ctx, &ret->sent);
	ret->lost_profiles = l->lost_profiles;
	for (unsigned k = 0; k < l->pieces; k++)
		ret->lost_profiles += (uint64_t)l->piece[(l->first + k) % PIECES].profiles;
	ret->profiles = s->profiles;
	ret->last_data_ns = s->last_data_ns < 0 ? -1 : s->last_data_ns - EPOCH_NS;
	ret->longest_pause_ns = s->longest_pause_ns;
	if (s->last_data_ns >= 0 && r->now_ns - s->last_data_ns > ret->longest_pause_ns)
		ret->longest_pause_ns = r->now_ns - s->last_data_ns;
	ret->first_request_ns = l->first_request_ns < 0 ? -1 : l->first_request_ns - EPOCH_NS;
	ret->requests = l->requests;
	ret->heard_len = l->requests < sizeof(l->heard) ? (size_t)l->requests : sizeof(l->heard);
	memcpy(ret->heard, l->heard, ret->heard_len);
}

void rig_mark(struct rig *r, const char *device)
{
	int i = rig_find(r, device);

	r->link[i].first_request_ns = -1;
	r->link[i].requests = 0;
	r->scanner[i].longest_pause_ns = 0;
}

void rig_counters(const struct rig *r, const char *device, struct decoder_counters *ret)
{
	pipeline_counters(r->pipeline, rig_find(r, device), ret);
}

int64_t rig_count(const struct rig *r, const char *device, const char *counter)
{
	struct decoder_counters counters;

	rig_counters(r, device, &counters);
	for (int i = 0; i < counters.n; i++)
		if (strcmp(counters.counter[i].name, counter) == 0)
			return (int64_t)counters.counter[i].count;
	return -1;
}

int64_t rig_wait_data(struct rig *r, const char *device, int64_t limit_ns)
{
	int64_t begin_ns = rig_now(r);
	struct rig_view view;

	while (rig_now(r) - begin_ns < limit_ns) {
		rig_run(r, RIG_MS);
		rig_view(r, device, &view);
		if (view.state == SUPERVISOR_STREAMING && view.last_data_ns > begin_ns)
			return view.last_data_ns - begin_ns;
	}
	return -1;
}

size_t rig_logged(const struct rig *r)
{
	return r->logged;
}

const struct rig_log *rig_log(const struct rig *r, size_t line)
{
	return line < r->logged && r->logged - line <= RIG_LOG_LINES ? &r->log[line % RIG_LOG_LINES] : NULL;
}

int rig_log_count(const struct rig *r, const char *device, size_t from, const char *begin)
{
	int n = 0, i = rig_find(r, device);

	for (size_t line = from; line < r->logged; line++) {
		const struct rig_log *log = rig_log(r, line);

		n += log && log->device == i && strncmp(log->text, begin, strlen(begin)) == 0;
	}
	return n;
}

static int compare_times(const void *a, const void *b)
{
	int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;

	return x < y ? -1 : x > y;
}

void rig_points(const struct rig *r, const char *device, struct rig_points *ret)
{
	const struct scanner *s = &r->scanner[rig_find(r, device)];
	static int64_t sorted[TIMES];
	size_t n = s->times < TIMES ? (size_t)s->times : TIMES;

	*ret = s->points;
	memcpy(sorted, s->time_ns, n * sizeof(*sorted));
	qsort(sorted, n, sizeof(*sorted), compare_times);
	if (n == 0)
		return;
	ret->time_p50_ns = sorted[n / 2];
	ret->time_p99_ns = sorted[n * 99 / 100];
	ret->time_worst_ns = sorted[n - 1];
}

void rig_points_clear(struct rig *r, const char *device)
{
	struct scanner *s = &r->scanner[rig_find(r, device)];

	memset(&s->points, 0, sizeof(s->points));
	s->times = 0;
}

void rig_pipeline_stats(const struct rig *r, struct pipeline_stats *ret)
{
	pipeline_stats(r->pipeline, ret);
}

/* Life */

void rig_scene(struct rig *r, const char *device, struct scene *ret)
{
	*ret = (struct scene){.ctx = &r->scanner[rig_find(r, device)], .scan = scan};
}

void rig_attach(struct rig *r, const char *device, enum rig_transport transport, const struct sim_device *brain)
{
	struct link *l = &r->link[rig_find(r, device)];

	l->transport = transport;
	l->brain = *brain;
	l->attached = true;
	l->bytes = malloc(WIRE_BYTES);
	if (!l->bytes)
		give_up("out of memory");
}

/* The driver's own parts, with the virtual link; servo and localisation have none, their records are fed. */
static void join_driver(struct rig *r, int device)
{
	struct driver *driver = &r->driver[device];
	const struct driver *real = driver_find(r->config.device[device].driver);

	if (!real)
		give_up("a driver is configured that does not exist");
	*driver = *real;
	if (driver->role != ROLE_LASER) {
		driver->dialogue_create = NULL;
		driver->link_open = NULL;
		return;
	}
	driver->link_open = link_open;
	driver->link_fd = link_fd;
	driver->link_read = link_read;
	driver->link_write = link_write;
	driver->link_baud = real->link_baud ? link_baud : NULL;
	driver->link_flush = real->link_flush ? link_flush : NULL;
	driver->link_error = NULL;
	driver->link_note = NULL;
	driver->link_close = link_close;
}

static void make_scanner(struct rig *r, int device)
{
	struct scanner *s = &r->scanner[device];
	struct sweep_params params;

	config_sweep_params(&r->config, device, &params);
	s->raster = params.raster;
	s->rig = r;
	s->device = device;
	s->base_tilt = r->config.mount.base_tilt;
	s->tilt_laser = r->config.mount.tilt_laser;
	s->tilts = r->config.device[device].tilt[0] != 0;
	s->last_data_ns = -1;
	s->truth = calloc(TRUTHS, sizeof(*s->truth));
	if (!s->truth)
		give_up("out of memory");
}

static void make_devices(struct rig *r)
{
	const struct driver *drivers[CONFIG_DEVICES_MAX];
	struct supervisor_host host = {r, on_watch, on_record, on_log};
	struct pipeline_sink sink = {
	    .ctx = r, .row = take_row, .flush = flush_rows, .reply = on_reply, .data = on_data};

	r->servo = r->localisation = -1;
	for (int i = 0; i < r->config.devices; i++) {
		join_driver(r, i);
		drivers[i] = &r->driver[i];
		r->link[i] = (struct link){.rig = r,
		                           .device = i,
		                           .first_request_ns = -1,
		                           .torn_ns = -1,
		                           .cut_ns = -1,
		                           .random = sim_mix(r->params.seed * 64 + (uint64_t)i)};
		if (r->driver[i].role == ROLE_LASER)
			make_scanner(r, i);
		if (r->driver[i].role == ROLE_TILT)
			r->servo = i;
		if (r->driver[i].role == ROLE_POSE && !r->config.device[i].fixed)
			r->localisation = i;
	}
	r->pipeline = pipeline_create(&r->config, &sink);
	r->supervisor = supervisor_create(&r->config, drivers, &host);
	if (!r->pipeline || !r->supervisor)
		give_up("out of memory");
}

struct rig *rig_create(const struct rig_params *params)
{
	struct rig *r = calloc(1, sizeof(*r));
	struct config_error why = {""};
	char error[160] = "";

	if (!r || the_rig)
		give_up("there can be one rig at a time");
	the_rig = r;
	r->params = *params;
	if (config_read(params->yaml, strlen(params->yaml), "rig", &r->config, &why) < 0)
		give_up(why.text);
	r->world = world_create(params->world ? params->world : "hall", error);
	if (!r->world)
		give_up(error);
	r->now_ns = r->tilt_ns = r->pose_ns = r->tick_ns = EPOCH_NS;
	r->piece = -1;
	make_devices(r);
	return r;
}

void rig_destroy(struct rig *r)
{
	if (!r)
		return;
	supervisor_destroy(r->supervisor);
	pipeline_destroy(r->pipeline);
	for (int i = 0; i < r->config.devices; i++) {
		free(r->scanner[i].truth);
		free(r->link[i].bytes);
		if (r->link[i].attached)
			r->link[i].brain.destroy(r->link[i].brain.ctx);
	}
	world_destroy(r->world);
	the_rig = NULL;
	free(r);
}

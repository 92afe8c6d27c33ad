/* A Modbus bus in virtual time, in the place of drivers/modbus_bus.c: its thread, libmodbus and the line, as one machine
 * that asks for the position every period and writes what it is wished to write, one request at a time.
 *
 *   serial  a byte takes its time at the line's rate, frames are 3.5 bytes apart; after an answer that was no good the
 *           line is listened to until it was silent for a response time; three failures in a row are the end
 *   TCP     a network of half a millisecond; whatever is wrong is the end of the connection
 *
 * Registers, delays and broken answers are those of the simulated drive (tools/sim_drive.h), which hears a request when
 * its last byte has come. Devices of one line wait for each other. */
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "drivers/modbus_parts.h"
#include "drivers/modbus_words.h"
#include "tests/rig_parts.h"

#define RESPONSE_NS    (500 * RIG_MS)
#define CONNECT_NS     RIG_MS
#define PATIENCE_NS    RIG_SECOND
#define NETWORK_NS     250000 /* each way */
#define THINKING_NS    300000 /* of the drive, between request and answer */
#define SILENCE_MIN_NS 1750000
#define FAILURES_MAX   3
#define BAUD_DEFAULT   115200
#define WISHES         64
#define RECORDS        64

enum fault { UNPLUG, REFUSE, HANG, RESET, FAULTS };
static const char *const fault_names[] = {"unplug", "refuse", "hang", "reset", NULL};

struct line { /* a device on a bus */
	struct link *link;
	const struct config_device *device;
	struct sim_drive *drive;
	bool serial;
	enum { CLOSED, CONNECTING, IDLE, ASKING, LISTENING, ENDED } state;
	int64_t until_ns; /* of CONNECTING, ASKING, LISTENING */
	int end;          /* of ENDED: errno, told behind the records */
	struct modbus_transaction asked;
	int verdict;     /* of it: 0 or an errno; EPROTO: no valid answer */
	bool right;      /* an angle that its drive sent and that can be read */
	int64_t late_ns; /* an answer that nobody waits for any more comes then */
	struct modbus_transaction wish[WISHES];
	unsigned first_wish, wishes;
	int64_t poll_ns, free_ns;
	int failures;
	struct {
		struct modbus_transaction transaction;
		int64_t arrival_ns;
		bool right;
	} record[RECORDS];
	unsigned first, records;
	bool on[FAULTS];
	uint64_t polls, answers, lost; /* of positions: asked for, sent by the drive, not read by the driver */
};

static int64_t byte_ns(const struct line *m)
{
	const uint32_t baud = m->device->baud ? m->device->baud : BAUD_DEFAULT;

	return (m->device->parity && m->device->parity != 'N' ? 11 : 10) * RIG_SECOND / baud;
}

static int64_t silence_ns(const struct line *m)
{
	const int64_t ns = byte_ns(m) * 7 / 2;

	return !m->serial ? 0 : ns > SILENCE_MIN_NS ? ns : SILENCE_MIN_NS;
}

static int64_t request_ns(const struct line *m, const struct modbus_transaction *t)
{
	return m->serial ? byte_ns(m) * (t->function == 16 ? 9 + 2 * t->n : 8) : NETWORK_NS;
}

static int64_t answer_ns(const struct line *m, const struct modbus_transaction *t)
{
	const bool reads = t->function == 3 || t->function == 4;

	if (!m->serial)
		return NETWORK_NS;
	return byte_ns(m) * (t->function & MODBUS_WIRE_REFUSED ? 5 : reads ? 5 + 2 * t->n : 8);
}

/* Some other device's request is on this line. */
static bool line_is_taken(const struct line *m)
{
	for (int i = 0; i < m->link->rig->config.devices; i++) {
		const struct link *l = &m->link->rig->link[i];
		const struct line *other = l->own;

		if (l->carrier == &rig_modbus && other != m && m->serial &&
		    strcmp(other->device->connect, m->device->connect) == 0 &&
		    (other->state == ASKING || other->state == LISTENING || other->free_ns > m->link->rig->now_ns))
			return true;
	}
	return false;
}

/* A transaction */

static bool asks_position(const struct line *m, const struct modbus_transaction *t)
{
	const struct config_register *p = &m->device->position;

	return t->function == modbus_wire_read_function(p) &&
	       t->address == modbus_wire_address(m->device, p->address) && t->n == modbus_wire_registers(p);
}

static void refuse(struct modbus_transaction *t, int code)
{
	t->function |= MODBUS_WIRE_REFUSED;
	t->n = 1;
	t->value[0] = (uint16_t)code;
}

/* The drive is asked as it is when the request has come; what comes of it is known at until_ns. */
static void ask(struct line *m, const struct modbus_transaction *request)
{
	const int64_t now_ns = m->link->rig->now_ns, heard_ns = now_ns + request_ns(m, request);
	struct sim_drive_answer a = {.verdict = SIM_DRIVE_SILENT};
	uint8_t bytes[MODBUS_WIRE_MAX];

	m->asked = *request;
	m->asked.unit = (uint8_t)m->device->slave;
	m->asked.t_request_ns = now_ns;
	m->state = ASKING;
	m->right = false;
	if (!m->on[UNPLUG])
		rig_note_request(m->link, bytes, modbus_wire_put(&m->asked, bytes));
	if (!m->on[UNPLUG])
		sim_drive_transact(m->drive, &m->asked, heard_ns, &a);
	m->polls += asks_position(m, request);
	m->until_ns = heard_ns + THINKING_NS + a.delay_ns + answer_ns(m, &a.transaction);
	m->verdict = 0;
	if (a.verdict == SIM_DRIVE_ANSWERED) {
		m->right = asks_position(m, &a.transaction);
		m->answers += m->right;
	}
	if (a.verdict == SIM_DRIVE_DROPPED && !m->serial)
		m->verdict = ECONNRESET;
	else if (a.verdict == SIM_DRIVE_SILENT || a.verdict == SIM_DRIVE_DROPPED || m->until_ns > now_ns + RESPONSE_NS)
		m->verdict = ETIMEDOUT;
	else if (a.verdict != SIM_DRIVE_ANSWERED)
		m->verdict = EPROTO;
	m->late_ns = a.verdict == SIM_DRIVE_SILENT ? 0 : m->until_ns;
	if (m->verdict == ETIMEDOUT)
		m->until_ns = now_ns + RESPONSE_NS;
	if (m->verdict) {
		m->lost += m->right;
		m->right = false;
		refuse(&m->asked, 0);
		return;
	}
	a.transaction.t_request_ns = now_ns;
	m->asked = a.transaction;
}

static void hand_over(struct line *m)
{
	const int64_t delay_ns = 100000, now_ns = m->link->rig->now_ns;
	int64_t late_ns = m->link->rig->driver[m->link->device].role == ROLE_TILT ? m->link->rig->tilt_late_ns : 0;
	const unsigned at = (m->first + m->records) % RECORDS;

	if (m->records == RECORDS || late_ns == INT64_MAX) {
		m->lost += m->right;
		return;
	}
	m->record[at].transaction = m->asked;
	m->record[at].arrival_ns = now_ns + late_ns + (int64_t)(sim_random(&m->link->random) * (double)delay_ns);
	m->record[at].right = m->right;
	m->records++;
}

static void end(struct line *m, int error)
{
	m->state = ENDED;
	m->end = error;
}

static void finish(struct line *m)
{
	m->asked.t_answer_ns = m->link->rig->now_ns;
	m->free_ns = m->link->rig->now_ns + silence_ns(m);
	m->state = IDLE;
	hand_over(m);
	m->right = false;
	if (!m->verdict) {
		m->failures = 0;
		return;
	}
	if (!m->serial || ++m->failures >= FAILURES_MAX) {
		end(m, m->verdict);
		return;
	}
	m->state = LISTENING;
	m->until_ns = m->link->rig->now_ns + RESPONSE_NS;
	if (m->late_ns > m->link->rig->now_ns && m->late_ns < m->until_ns)
		m->until_ns = m->late_ns + RESPONSE_NS;
}

/* The machine */

static void connect_now(struct line *m)
{
	const int64_t now_ns = m->link->rig->now_ns;

	if (!m->serial && m->on[REFUSE]) {
		end(m, ECONNREFUSED);
	} else if (!m->serial && (m->on[HANG] || m->on[UNPLUG])) {
		end(m, ETIMEDOUT);
	} else {
		m->state = IDLE;
		m->poll_ns = m->free_ns = now_ns;
		m->failures = 0;
	}
}

/* A poll that is late is not made up for. */
static void begin_next(struct line *m)
{
	const struct config_register *p = &m->device->position;
	const int64_t now_ns = m->link->rig->now_ns;
	int64_t period_ns = m->device->period_ns > MODBUS_PERIOD_MIN_NS ? m->device->period_ns : MODBUS_PERIOD_MIN_NS;

	if (m->wishes > 0) {
		const struct modbus_transaction wish = m->wish[m->first_wish];

		m->first_wish = (m->first_wish + 1) % WISHES;
		m->wishes--;
		ask(m, &wish);
	} else if (m->poll_ns <= now_ns) {
		ask(m, &(struct modbus_transaction){.function = modbus_wire_read_function(p),
		                                    .address = modbus_wire_address(m->device, p->address),
		                                    .n = (uint16_t)modbus_wire_registers(p)});
		m->poll_ns = m->poll_ns + period_ns < now_ns ? now_ns : m->poll_ns + period_ns;
	}
}

static int64_t next_ns(const struct line *m)
{
	switch (m->state) {
	case CONNECTING:
	case ASKING:
	case LISTENING:
		return m->until_ns;
	case IDLE:
		if (line_is_taken(m))
			return m->link->rig->now_ns + 100000;
		return m->wishes > 0 || m->poll_ns < m->free_ns ? m->free_ns : m->poll_ns;
	default:
		return INT64_MAX;
	}
}

static void serve(struct link *l)
{
	struct line *m = l->own;

	sim_drive_advance(m->drive, l->rig->now_ns);
	for (int i = 0; i < 8 && m->state != ENDED && next_ns(m) <= l->rig->now_ns; i++)
		switch (m->state) {
		case CONNECTING:
			connect_now(m);
			break;
		case ASKING:
			finish(m);
			break;
		case LISTENING:
			m->state = IDLE;
			break;
		default:
			begin_next(m);
		}
}

/* In the place of drivers/modbus_bus.c */

static void forget(struct line *m)
{
	for (; m->records > 0; m->records--, m->first = (m->first + 1) % RECORDS)
		m->lost += m->record[m->first].right;
	if (m->state == ASKING)
		m->lost += m->right;
	m->wishes = 0;
}

struct link *modbus_bus_open(const struct config_device *device, char error[160])
{
	struct link *l = rig_link_of(device);
	struct line *m = l->own;

	if (m->serial && m->on[UNPLUG]) {
		snprintf(error, 160, "%.80s: there is no such device; plug it in, or correct `connect`",
		         device->connect);
		return NULL;
	}
	m->state = CONNECTING;
	m->until_ns = l->rig->now_ns + (m->serial ? 0 : m->on[HANG] || m->on[UNPLUG] ? PATIENCE_NS : CONNECT_NS);
	return l;
}

int modbus_bus_fd(const struct link *l)
{
	return RIG_DUMMY_FD + l->device;
}

static bool record_is_there(const struct line *m)
{
	return m->records > 0 && m->record[m->first].arrival_ns <= m->link->rig->now_ns;
}

ssize_t modbus_bus_read(struct link *l, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	struct line *m = l->own;
	const struct modbus_transaction *t = &m->record[m->first].transaction;
	size_t n;

	if (!record_is_there(m))
		return m->state == ENDED && m->records == 0 ? -m->end : 0;
	if (cap < MODBUS_WIRE_MAX)
		return -EIO;
	*t_ns = t->t_answer_ns;
	n = modbus_wire_put(t, buf);
	m->first = (m->first + 1) % RECORDS;
	m->records--;
	return (ssize_t)n;
}

ssize_t modbus_bus_write(struct link *l, const uint8_t *bytes, size_t len)
{
	struct line *m = l->own;
	struct modbus_transaction t;
	ssize_t n;

	if (m->wishes == WISHES)
		return 0;
	n = modbus_wire_get(bytes, len, &t);
	if (n <= 0)
		return (ssize_t)len;
	m->wish[(m->first_wish + m->wishes++) % WISHES] = t;
	return n;
}

void modbus_bus_error(const struct link *l, int error, char ret[160])
{
	const struct line *m = l->own;

	modbus_words_end(m->device->connect, m->device->slave, error, ret);
}

void modbus_bus_close(struct link *l)
{
	struct line *m = l->own;

	forget(m);
	m->state = CLOSED;
}

/* The carrier */

static void attach(struct link *l)
{
	struct line *m = calloc(1, sizeof(*m));

	if (!m)
		rig_give_up("out of memory");
	m->link = l;
	m->device = &l->rig->config.device[l->device];
	m->drive = l->brain.ctx;
	m->serial = strchr(m->device->connect, '/') != NULL;
	l->own = m;
}

static void detach(struct link *l)
{
	free(l->own);
}

static int64_t due(const struct link *l)
{
	const struct line *m = l->own;
	int64_t at_ns = rig_earlier(next_ns(m), sim_drive_deadline(m->drive));

	if (l->readable && m->records > 0)
		at_ns = rig_earlier(at_ns, m->record[m->first].arrival_ns);
	if (l->readable && m->state == ENDED && m->records == 0)
		at_ns = l->rig->now_ns;
	return at_ns;
}

static bool readable(const struct link *l)
{
	const struct line *m = l->own;

	return record_is_there(m) || (m->state == ENDED && m->records == 0);
}

static bool writable(const struct link *l)
{
	return ((const struct line *)l->own)->wishes < WISHES;
}

static bool fault(struct link *l, const struct sim_fault *what, bool on)
{
	struct line *m = l->own;
	const int kind = sim_fault_index(fault_names, what->kind);

	if (kind < 0)
		return false;
	m->on[kind] = on && kind != RESET;
	if (!on || m->state == CLOSED || m->state == ENDED)
		return true;
	if (m->serial && kind == UNPLUG)
		end(m, EIO);
	if (!m->serial && kind != UNPLUG)
		end(m, ECONNRESET);
	if (m->state == ENDED) {
		m->lost += m->right;
		m->right = false;
	}
	return true;
}

static uint64_t lost_profiles(const struct link *l)
{
	const struct line *m = l->own;
	uint64_t lost = m->lost + (m->state == ASKING && m->right);

	for (unsigned i = 0; i < m->records; i++)
		lost += m->record[(m->first + i) % RECORDS].right;
	return lost;
}

const struct rig_carrier rig_modbus = {attach, detach, due, serve, serve, readable, writable, fault, lost_profiles};

/* A drive as a brain: it speaks in transactions, not in bytes. */

static struct rig *rig_of_drive(const void *drive, const struct line **ret)
{
	for (int i = 0; i < the_rig->config.devices; i++)
		if (the_rig->link[i].carrier == &rig_modbus && the_rig->link[i].brain.ctx == drive)
			*ret = the_rig->link[i].own;
	return the_rig;
}

static bool drive_fault(void *ctx, const struct sim_fault *what, bool on, int64_t t_ns)
{
	return sim_drive_fault(ctx, what, on, t_ns);
}

static void drive_counts(const void *ctx, struct sim_counts *ret)
{
	const struct line *m = NULL;

	rig_of_drive(ctx, &m);
	*ret = (struct sim_counts){.profiles = m->polls, .sent = m->answers};
}

static int64_t drive_deadline(void *ctx)
{
	return sim_drive_deadline(ctx);
}

static void drive_destroy(void *ctx)
{
	sim_drive_destroy(ctx);
}

void rig_attach_drive(struct rig *r, const char *device, struct sim_drive *drive)
{
	const struct sim_device brain = {.ctx = drive,
	                                 .deadline = drive_deadline,
	                                 .fault = drive_fault,
	                                 .fault_kinds = sim_drive_fault_kinds(),
	                                 .counts = drive_counts,
	                                 .destroy = drive_destroy};

	rig_attach(r, device, RIG_MODBUS, &brain);
}

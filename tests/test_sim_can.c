/* Law: a simulated CAN bus is one: what one node sends reaches all others, and its clients, each frame with the time at
 * which it was on the bus; nobody on it can block it; and what can go wrong with a bus does, when it was ordered. */
#include <errno.h>
#include <math.h>
#include <poll.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <cmocka.h>

#include "core/trig.h"
#include "daemon/wall_clock.h"
#include "drivers/can_signal.h"
#include "tools/sim_can.h"
#include "tools/sim_can_bus.h"

#define PATIENCE_NS 120000000000ll
#define MS          1000000ll
#define DEG         TRIG_DEG

/* A node that remembers what it hears and says what it is told to. */
struct node {
	struct can_frame_at heard, said;
	int64_t heard_ns;
	int n;
	bool speaks, answers;
};

struct bed {
	uv_loop_t loop;
	uv_timer_t tick;
	struct sim_can_bus *bus;
	struct node node[2];
	char dir[64], path[80];
	int client[2];
};

static void node_receive(void *ctx, const uint8_t *bytes, size_t len, int64_t t_ns)
{
	struct node *n = ctx;

	assert_int_equal(can_wire_get(bytes, len, &n->heard), len);
	n->heard_ns = t_ns;
	n->n++;
	n->speaks |= n->answers;
}

static void node_advance(void *ctx, int64_t t_ns)
{
	(void)ctx;
	(void)t_ns;
}

static size_t node_transmit(void *ctx, uint8_t *buf, size_t cap)
{
	struct node *n = ctx;

	if (!n->speaks)
		return 0;
	assert_true(cap >= CAN_WIRE_ENTRY_FD);
	n->speaks = false;
	return can_wire_put(&n->said, buf);
}

static int64_t node_deadline(void *ctx)
{
	return ((struct node *)ctx)->speaks ? 0 : INT64_MAX;
}

static bool node_fault(void *ctx, const struct sim_fault *fault, bool on, int64_t t_ns)
{
	(void)ctx;
	(void)fault;
	(void)on;
	(void)t_ns;
	return false;
}

static void node_destroy(void *ctx)
{
	(void)ctx;
}

static void on_tick(uv_timer_t *timer)
{
	(void)timer;
}

static int join(const struct bed *b)
{
	struct sockaddr_un address = {.sun_family = AF_UNIX};
	int fd = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);

	snprintf(address.sun_path, sizeof address.sun_path, "%s", b->path);
	if (connect(fd, (const struct sockaddr *)&address, sizeof address) < 0) {
		close(fd);
		return -errno;
	}
	return fd;
}

static struct sim_can_bus_counts counts(const struct bed *b)
{
	struct sim_can_bus_counts ret;

	sim_can_bus_counts(b->bus, &ret);
	return ret;
}

static int setup(void **state)
{
	struct bed *b = calloc(1, sizeof *b);
	struct sim_can_bus_params params = {.path = b->path, .seed = 1};
	char error[160] = "";

	*state = b;
	strcpy(b->dir, "/tmp/test_sim_can.XXXXXX");
	if (!mkdtemp(b->dir))
		return -1;
	snprintf(b->path, sizeof b->path, "%s/can.sock", b->dir);
	uv_loop_init(&b->loop);
	uv_timer_init(&b->loop, &b->tick);
	uv_timer_start(&b->tick, on_tick, 1, 1);
	b->bus = sim_can_bus_create(&b->loop, &params, error);
	assert_string_equal(error, "");
	for (int i = 0; i < 2; i++) {
		const struct sim_device device = {.ctx = &b->node[i],
		                                  .receive = node_receive,
		                                  .advance = node_advance,
		                                  .transmit = node_transmit,
		                                  .deadline = node_deadline,
		                                  .fault = node_fault,
		                                  .destroy = node_destroy};

		assert_int_equal(sim_can_bus_attach(b->bus, &device), i);
	}
	for (int i = 0; i < 2; i++)
		b->client[i] = join(b);
	while (counts(b).clients < 2)
		uv_run(&b->loop, UV_RUN_ONCE);
	return 0;
}

static int teardown(void **state)
{
	struct bed *b = *state;

	sim_can_bus_destroy(b->bus);
	for (int i = 0; i < 2; i++)
		close(b->client[i]);
	uv_close((uv_handle_t *)&b->tick, NULL);
	uv_run(&b->loop, UV_RUN_DEFAULT);
	uv_loop_close(&b->loop);
	assert_int_equal(rmdir(b->dir), 0); /* fails where the socket was left */
	free(b);
	return 0;
}

static void say(struct bed *b, int node, uint32_t id, uint8_t first)
{
	b->node[node].said = can_wire_frame(id, (uint8_t[]){first, 2, 3, 4}, 4);
	b->node[node].speaks = true;
	sim_can_bus_node_fault(b->bus, node, &(struct sim_fault){.kind = "none"}, true); /* it looks */
}

static void send_frame(int fd, uint32_t id, uint8_t first)
{
	struct can_frame_at f = can_wire_frame(id, &first, 1);
	uint8_t entry[CAN_WIRE_ENTRY_FD];
	size_t len = can_wire_put(&f, entry);

	assert_int_equal(send(fd, entry, len, 0), len);
}

/* The next message. False: none came, however long one waits (`now`: none is there). */
static bool hear(struct bed *b, int fd, struct can_frame_at *ret, bool now)
{
	uint8_t bytes[128];
	int64_t end_ns = (int64_t)uv_hrtime() + PATIENCE_NS;
	ssize_t n;

	while ((n = recv(fd, bytes, sizeof bytes, MSG_DONTWAIT)) < 0 && !now && (int64_t)uv_hrtime() < end_ns)
		uv_run(&b->loop, UV_RUN_ONCE);
	if (n < 0)
		return false;
	assert_int_equal(can_wire_get(bytes, (size_t)n, ret), n); /* one entry a message */
	return true;
}

static void order(struct bed *b, const char *kind, double value, bool on)
{
	struct sim_fault fault = {.value = value, .for_ns = INT64_MAX};

	snprintf(fault.kind, sizeof fault.kind, "%s", kind);
	assert_true(sim_can_bus_fault(b->bus, &fault, on));
}

/* ---- the bus ---- */

static void a_frame_of_a_node_reaches_the_other_nodes_and_every_client(void **state)
{
	struct bed *b = *state;
	struct can_frame_at f;
	int64_t before_ns = wall_clock_read(CLOCK_REALTIME);

	say(b, 0, 0x181, 7);
	assert_int_equal(b->node[1].n, 1);
	assert_int_equal(b->node[1].heard.id, 0x181);
	assert_int_equal(b->node[0].n, 0);
	for (int i = 0; i < 2; i++) {
		assert_true(hear(b, b->client[i], &f, false));
		assert_int_equal(f.id, 0x181);
		assert_int_equal(f.len, 4);
		assert_int_equal(f.data[0], 7);
		assert_true(f.t_ns >= before_ns - 50 * MS && f.t_ns <= wall_clock_read(CLOCK_REALTIME) + 50 * MS);
	}
}

static void a_client_gets_its_own_frame_back_with_the_time_that_the_nodes_know(void **state)
{
	struct bed *b = *state;
	struct can_frame_at f[2];

	send_frame(b->client[0], 0x080, 1);
	for (int i = 0; i < 2; i++) {
		assert_true(hear(b, b->client[i], &f[i], false));
		assert_int_equal(f[i].id, 0x080);
		assert_int_equal(b->node[i].n, 1);
		assert_true(b->node[i].heard.t_ns == b->node[i].heard_ns);
	}
	assert_true(f[0].t_ns == f[1].t_ns);
	/* The two clocks are looked at one after the other: a millisecond where the machine is busy. */
	assert_true(llabs(f[0].t_ns - b->node[0].heard_ns - wall_clock_first_offset()) < 5 * MS);
}

static void what_a_node_answers_is_on_the_bus_after_the_question(void **state)
{
	struct bed *b = *state;
	struct can_frame_at f[2];

	b->node[1].answers = true;
	b->node[1].said = can_wire_frame(0x585, "\x60", 1);
	send_frame(b->client[0], 0x605, 0x2f);
	assert_true(hear(b, b->client[1], &f[0], false) && hear(b, b->client[1], &f[1], false));
	assert_int_equal(f[0].id, 0x605);
	assert_int_equal(f[1].id, 0x585);
	assert_true(f[0].t_ns <= f[1].t_ns);
}

static void a_client_that_does_not_read_misses_frames_and_holds_nobody_up(void **state)
{
	struct bed *b = *state;
	struct can_frame_at f;
	int n = 0;

	for (int i = 0; i < 5000; i++) {
		say(b, 0, 0x100, (uint8_t)i);
		if (hear(b, b->client[0], &f, true))
			n++;
	}
	assert_int_equal(n, 5000);
	assert_true(counts(b).missed > 1000);
	assert_int_equal(counts(b).clients, 2);
}

static void what_is_no_entry_is_refused(void **state)
{
	static const uint8_t wrong[] = {1, 0, 0, 0, 9, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 0, 0, 0, 0, 0, 0, 0, 0};
	struct bed *b = *state;
	struct can_frame_at f;

	assert_int_equal(send(b->client[0], wrong, sizeof wrong, 0), sizeof wrong); /* 9 bytes of data */
	assert_int_equal(send(b->client[0], wrong, 5, 0), 5);
	send_frame(b->client[0], CAN_WIRE_LOST, 0);
	send_frame(b->client[0], 0x123, 0);
	assert_true(hear(b, b->client[1], &f, false));
	assert_int_equal(f.id, 0x123);
	assert_int_equal(counts(b).refused, 3);
	assert_int_equal(b->node[0].n, 1);
}

static void error_frames_do_not_reach_nodes(void **state)
{
	struct bed *b = *state;
	struct can_frame_at f;

	send_frame(b->client[0], CAN_WIRE_ERROR | CAN_WIRE_ERROR_BUS_OFF, 0);
	assert_true(hear(b, b->client[1], &f, false));
	assert_int_equal(f.id, CAN_WIRE_ERROR | CAN_WIRE_ERROR_BUS_OFF);
	assert_int_equal(b->node[0].n, 0);
}

static void one_client_too_many_is_closed(void **state)
{
	struct bed *b = *state;
	int fd[SIM_CAN_BUS_CLIENTS], n = SIM_CAN_BUS_CLIENTS - 2;
	char byte;

	for (int i = 0; i <= n; i++) {
		fd[i] = join(b);
		assert_true(fd[i] >= 0);
		for (int64_t begin_ns = (int64_t)uv_hrtime(); i < n && counts(b).clients < i + 3;) {
			uv_run(&b->loop, UV_RUN_ONCE);
			assert_true((int64_t)uv_hrtime() - begin_ns < PATIENCE_NS);
		}
	}
	while (recv(fd[n], &byte, 1, MSG_DONTWAIT) < 0 && errno == EAGAIN)
		uv_run(&b->loop, UV_RUN_ONCE);
	assert_int_equal(counts(b).clients, SIM_CAN_BUS_CLIENTS);
	for (int i = 0; i <= n; i++)
		close(fd[i]);
}

/* ---- its faults ---- */

static void a_bus_that_is_off_says_so_carries_nothing_and_says_when_it_is_back(void **state)
{
	struct bed *b = *state;
	struct can_frame_at f;

	order(b, "bus-off", 0, true);
	assert_true(hear(b, b->client[0], &f, false));
	assert_int_equal(f.id, CAN_WIRE_ERROR | CAN_WIRE_ERROR_BUS_OFF);
	assert_int_equal(f.len, 8);
	say(b, 0, 0x181, 1);
	assert_int_equal(b->node[1].n, 1); /* nodes are elsewhere on the wire */
	send_frame(b->client[0], 0x080, 0);
	while (counts(b).received == 0)
		uv_run(&b->loop, UV_RUN_ONCE);
	assert_int_equal(b->node[0].n, 0);
	assert_false(hear(b, b->client[0], &f, true));
	order(b, "bus-off", 0, false);
	assert_true(hear(b, b->client[0], &f, false));
	assert_int_equal(f.id, CAN_WIRE_ERROR | CAN_WIRE_ERROR_RESTARTED);
	say(b, 0, 0x181, 2);
	assert_true(hear(b, b->client[0], &f, false));
	assert_int_equal(f.id, 0x181);
}

static void a_controller_warns_is_passive_and_is_active_again(void **state)
{
	static const struct {
		const char *kind;
		uint8_t state;
	} cases[] = {{"warning", 0x08}, {"passive", 0x20}};
	struct bed *b = *state;
	struct can_frame_at f;

	for (int i = 0; i < 2; i++) {
		order(b, cases[i].kind, 0, true);
		assert_true(hear(b, b->client[0], &f, false));
		assert_true(f.id & CAN_WIRE_ERROR && f.id & CAN_WIRE_ERROR_CONTROLLER);
		assert_int_equal(f.data[1], cases[i].state);
		order(b, cases[i].kind, 0, false);
		assert_true(hear(b, b->client[0], &f, false));
		assert_int_equal(f.data[1], 0x40);
	}
}

static void errors_come_at_their_rate(void **state)
{
	struct bed *b = *state;
	struct can_frame_at f;
	int64_t begin_ns = wall_clock_read(CLOCK_REALTIME);

	order(b, "errors", 500, true);
	for (int i = 0; i < 20; i++) {
		assert_true(hear(b, b->client[0], &f, false));
		assert_true(f.id & CAN_WIRE_ERROR && f.id & CAN_WIRE_ERROR_BUS);
	}
	/* None comes before its time; where the machine is late, several come at once. */
	assert_true(f.t_ns - begin_ns >= 19 * 2 * MS - 3 * MS);
	order(b, "errors", 0, false);
}

static void an_interface_that_is_down_closes_and_refuses_one_that_is_deleted_is_not_there(void **state)
{
	static const struct {
		const char *kind;
		int error;
	} cases[] = {{"down", -ECONNREFUSED}, {"deleted", -ENOENT}};
	struct bed *b = *state;
	struct can_frame_at f;
	char byte;

	for (int i = 0; i < 2; i++) {
		order(b, cases[i].kind, 0, true);
		assert_int_equal(recv(b->client[0], &byte, 1, MSG_DONTWAIT), 0);
		assert_int_equal(join(b), cases[i].error);
		order(b, cases[i].kind, 0, false);
		close(b->client[0]);
		b->client[0] = join(b);
		assert_true(b->client[0] >= 0);
		while (counts(b).clients < 1)
			uv_run(&b->loop, UV_RUN_ONCE);
		say(b, 0, 0x181, 2);
		assert_true(hear(b, b->client[0], &f, false));
	}
}

static void twins_follow_every_frame_and_differ_from_it(void **state)
{
	static const char *const kind[] = {"rtr", "extended", "fd"};
	static const uint32_t id[] = {0x181 | CAN_WIRE_REMOTE, 0x181 | CAN_WIRE_EXTENDED, 0x181};
	struct bed *b = *state;
	struct can_frame_at f;

	for (int i = 0; i < 3; i++)
		order(b, kind[i], 0, true);
	say(b, 0, 0x181, 9);
	assert_true(hear(b, b->client[0], &f, false));
	assert_int_equal(f.id, 0x181);
	for (int i = 0; i < 3; i++) {
		assert_true(hear(b, b->client[0], &f, false));
		assert_int_equal(f.id, id[i]);
		assert_int_equal(f.len, i == 2 ? 64 : 4);
		assert_int_equal(f.data[0], i == 0 ? 0 : i == 1 ? 0x55 : 9);
	}
	assert_int_equal(b->node[1].n, 1);
}

static void late_frames_keep_their_stamp_and_their_order(void **state)
{
	struct bed *b = *state;
	struct can_frame_at f;
	int64_t before_ns = (int64_t)uv_hrtime();

	order(b, "late", 30, true);
	say(b, 0, 0x181, 1);
	order(b, "late", 30, false);
	say(b, 0, 0x182, 2);
	assert_true(hear(b, b->client[0], &f, false));
	assert_true((int64_t)uv_hrtime() - before_ns >= 30 * MS);
	assert_int_equal(f.id, 0x181);
	assert_true(f.t_ns < wall_clock_read(CLOCK_REALTIME) - 29 * MS);
	assert_true(hear(b, b->client[0], &f, false));
	assert_int_equal(f.id, 0x182);
}

static void a_full_bus_takes_nothing_until_there_is_room_again(void **state)
{
	struct bed *b = *state;
	struct can_frame_at f = can_wire_frame(0x100, "", 0);
	uint8_t entry[CAN_WIRE_ENTRY_FD];
	size_t len = can_wire_put(&f, entry);
	uint64_t n = 0;

	order(b, "full", 0, true);
	while (send(b->client[0], entry, len, MSG_DONTWAIT) == (ssize_t)len)
		n++;
	assert_true(errno == EAGAIN && n > 0);
	uv_run(&b->loop, UV_RUN_ONCE);
	assert_int_equal(counts(b).received, 0);
	order(b, "full", 0, false);
	while (counts(b).received < n)
		uv_run(&b->loop, UV_RUN_ONCE);
}

static void a_share_of_the_frames_gets_lost(void **state)
{
	struct bed *b = *state;

	order(b, "drop", 0.25, true);
	for (int i = 0; i < 1000; i++)
		say(b, 0, 0x100, (uint8_t)i);
	assert_true(counts(b).dropped > 180 && counts(b).dropped < 320);
	assert_int_equal(b->node[1].n, 1000);
}

/* ---- nodes, in a time of their own ---- */

static double slope(void *ctx, int64_t t_ns)
{
	(void)ctx;
	return 0.1 * (double)t_ns * 1e-9;
}

static struct config_signal angle_signal(void)
{
	return (struct config_signal){.set = true,
	                              .id = 0x123,
	                              .length = 24,
	                              .type = SIGNAL_SIGNED,
	                              .scale = -0.001 * DEG,
	                              .counter = {.set = true, .start = 24, .length = 8},
	                              .valid = {.set = true, .bit = 32, .value = 1}};
}

/* Its next frame: the time is moved to its deadline. */
static bool next(const struct sim_device *d, int64_t *t_ns, struct can_frame_at *ret)
{
	uint8_t bytes[SIM_TRANSFER_MAX];

	for (int i = 0; i < 10; i++) {
		size_t len;

		*t_ns = d->deadline(d->ctx) > *t_ns ? d->deadline(d->ctx) : *t_ns;
		d->advance(d->ctx, *t_ns);
		len = d->transmit(d->ctx, bytes, sizeof bytes);
		if (len > 0)
			return can_wire_get(bytes, len, ret) == (ssize_t)len;
	}
	return false;
}

static void befall(const struct sim_device *d, const char *kind, double value, bool on, int64_t t_ns)
{
	struct sim_fault fault = {.value = value, .for_ns = INT64_MAX};

	snprintf(fault.kind, sizeof fault.kind, "%s", kind);
	assert_true(d->fault(d->ctx, &fault, on, t_ns));
}

static void an_angle_is_sent_as_it_was_when_its_frame_left(void **state)
{
	const struct sim_can_angle_params params = {.signal = angle_signal(), .period_ns = 5 * MS, .angle = slope};
	struct sim_device d;
	struct can_signal_value v;
	struct can_frame_at f;
	int64_t t_ns = 1000 * MS;
	uint32_t counter = 0;

	(void)state;
	assert_int_equal(sim_can_angle_create(&params, t_ns, &d), 0);
	for (int i = 0; i < 600; i++) {
		assert_true(next(&d, &t_ns, &f));
		assert_int_equal(can_signal_get(&params.signal, &f, &v), CAN_SIGNAL_GOOD);
		assert_true(fabs(v.value - slope(NULL, t_ns)) < 0.00051 * DEG);
		assert_true(f.t_ns == t_ns);
		if (i > 0)
			assert_int_equal(v.counter, (counter + 1) & 0xff);
		counter = v.counter;
	}
	assert_true(t_ns == 1000 * MS + 599 * 5 * MS);
	d.destroy(d.ctx);
}

static void faults_of_an_angle_are_what_a_reader_must_see(void **state)
{
	static const struct {
		const char *kind;
		enum can_signal_verdict verdict;
	} cases[] = {{"invalid", CAN_SIGNAL_INVALID}, {"short", CAN_SIGNAL_SHORT}, {"wrong id", CAN_SIGNAL_FOREIGN}};
	const struct sim_can_angle_params params = {.signal = angle_signal(), .period_ns = 5 * MS, .angle = slope};
	struct sim_device d;
	struct can_signal_value v, before;
	struct can_frame_at f;
	int64_t t_ns = 0;

	(void)state;
	assert_int_equal(sim_can_angle_create(&params, t_ns, &d), 0);
	for (int i = 0; i < 3; i++) {
		befall(&d, cases[i].kind, 0, true, t_ns);
		assert_true(next(&d, &t_ns, &f));
		assert_int_equal(can_signal_get(&params.signal, &f, &v), cases[i].verdict);
		befall(&d, cases[i].kind, 0, false, t_ns);
	}
	assert_true(next(&d, &t_ns, &f));
	assert_int_equal(can_signal_get(&params.signal, &f, &before), CAN_SIGNAL_GOOD);
	befall(&d, "gap", 7, true, t_ns);
	assert_true(next(&d, &t_ns, &f));
	assert_int_equal(can_signal_get(&params.signal, &f, &v), CAN_SIGNAL_GOOD);
	assert_int_equal((v.counter - before.counter) & 0xff, 8);
	befall(&d, "gap", 7, false, t_ns);
	befall(&d, "silence", 0, true, t_ns);
	assert_false(next(&d, &t_ns, &f));
	befall(&d, "silence", 0, false, t_ns);
	befall(&d, "frozen", 0, true, t_ns);
	assert_true(next(&d, &t_ns, &f));
	can_signal_get(&params.signal, &f, &before);
	assert_true(next(&d, &t_ns, &f));
	can_signal_get(&params.signal, &f, &v);
	assert_true(v.value == before.value && fabs(v.value - slope(NULL, t_ns)) > 0.005 * DEG);
	d.destroy(d.ctx);
}

/* A circle of 2 m radius, once in 20 s, to the left. */
static struct pose circle(void *ctx, int64_t t_ns)
{
	double a = 2.0 * TRIG_PI * (double)t_ns * 1e-9 / 20.0;

	(void)ctx;
	return (struct pose){.position_m = {2.0 * trig_sin(a), 2.0 - 2.0 * trig_cos(a), 0.0},
	                     .rotation = {trig_cos(a / 2.0), 0.0, 0.0, trig_sin(a / 2.0)}};
}

/* What its wheels counted in a whole turn: the ways of the left and of the right one. */
static void drive_a_circle(const char *fault, double ret_m[2])
{
	const struct sim_can_wheels_params params = {
	    .left = {.set = true, .id = 0x201, .length = 16, .type = SIGNAL_UNSIGNED, .scale = 1e-4, .wrap = 65536},
	    .right = {.set = true,
	              .id = 0x201,
	              .start = 16,
	              .length = 16,
	              .type = SIGNAL_UNSIGNED,
	              .scale = 1e-4,
	              .wrap = 65536},
	    .track_m = 0.5,
	    .period_ns = 20 * MS,
	    .pose = circle};
	const struct config_signal *signal[2] = {&params.left, &params.right};
	struct can_signal_value v;
	double before[2] = {0, 0};
	struct sim_device d;
	struct can_frame_at f;
	int64_t t_ns = 0;

	assert_int_equal(sim_can_wheels_create(&params, t_ns, &d), 0);
	if (fault)
		befall(&d, fault, 0, true, t_ns);
	ret_m[0] = ret_m[1] = 0.0;
	while (t_ns < 20000 * MS) {
		assert_true(next(&d, &t_ns, &f));
		for (int i = 0; i < 2; i++) {
			double step;

			assert_int_equal(can_signal_get(signal[i], &f, &v), CAN_SIGNAL_GOOD);
			step = v.raw - before[i];
			ret_m[i] += (step - 65536.0 * rint(step / 65536.0)) * 1e-4;
			before[i] = v.raw;
		}
	}
	d.destroy(d.ctx);
}

static void wheels_count_the_way_that_the_robot_drove(void **state)
{
	double way_m[2];

	(void)state;
	drive_a_circle(NULL, way_m);
	assert_true(fabs(way_m[0] - 2.0 * TRIG_PI * 1.75) < 0.002);
	assert_true(fabs(way_m[1] - 2.0 * TRIG_PI * 2.25) < 0.002);
	drive_a_circle("slip", way_m);
	assert_true(fabs(way_m[1] - 1.2 * 2.0 * TRIG_PI * 2.25) < 0.002);
	drive_a_circle("blocked", way_m);
	assert_true(way_m[0] == 0.0);
	assert_true(fabs(way_m[1] - 2.0 * TRIG_PI * 2.25) < 0.002);
}

static void speed_and_turn_are_those_of_the_robot(void **state)
{
	const struct sim_can_wheels_params params = {
	    .ahead = {.set = true, .id = 0x200, .length = 16, .type = SIGNAL_SIGNED, .scale = 1e-4},
	    .turn = {.set = true, .id = 0x200, .start = 16, .length = 24, .type = SIGNAL_SIGNED, .scale = 1e-4 * DEG},
	    .track_m = 0.5,
	    .period_ns = 20 * MS,
	    .pose = circle};
	struct can_signal_value ahead, turn;
	struct sim_device d;
	struct can_frame_at f;
	int64_t t_ns = 0;

	(void)state;
	assert_int_equal(sim_can_wheels_create(&params, t_ns, &d), 0);
	for (int i = 0; i < 10; i++) {
		assert_true(next(&d, &t_ns, &f));
		assert_int_equal(can_signal_get(&params.ahead, &f, &ahead), CAN_SIGNAL_GOOD);
		assert_int_equal(can_signal_get(&params.turn, &f, &turn), CAN_SIGNAL_GOOD);
		assert_true(fabs(ahead.value - 2.0 * TRIG_PI * 2.0 / 20.0) < 0.001);
		assert_true(fabs(turn.value - 2.0 * TRIG_PI / 20.0) < 0.001);
	}
	d.destroy(d.ctx);
}

int main(void)
{
#define ON_A_BED(test) cmocka_unit_test_setup_teardown(test, setup, teardown)
	const struct CMUnitTest tests[] = {
	    ON_A_BED(a_frame_of_a_node_reaches_the_other_nodes_and_every_client),
	    ON_A_BED(a_client_gets_its_own_frame_back_with_the_time_that_the_nodes_know),
	    ON_A_BED(what_a_node_answers_is_on_the_bus_after_the_question),
	    ON_A_BED(a_client_that_does_not_read_misses_frames_and_holds_nobody_up),
	    ON_A_BED(what_is_no_entry_is_refused),
	    ON_A_BED(error_frames_do_not_reach_nodes),
	    ON_A_BED(one_client_too_many_is_closed),
	    ON_A_BED(a_bus_that_is_off_says_so_carries_nothing_and_says_when_it_is_back),
	    ON_A_BED(a_controller_warns_is_passive_and_is_active_again),
	    ON_A_BED(errors_come_at_their_rate),
	    ON_A_BED(an_interface_that_is_down_closes_and_refuses_one_that_is_deleted_is_not_there),
	    ON_A_BED(twins_follow_every_frame_and_differ_from_it),
	    ON_A_BED(late_frames_keep_their_stamp_and_their_order),
	    ON_A_BED(a_full_bus_takes_nothing_until_there_is_room_again),
	    ON_A_BED(a_share_of_the_frames_gets_lost),
	    cmocka_unit_test(an_angle_is_sent_as_it_was_when_its_frame_left),
	    cmocka_unit_test(faults_of_an_angle_are_what_a_reader_must_see),
	    cmocka_unit_test(wheels_count_the_way_that_the_robot_drove),
	    cmocka_unit_test(speed_and_turn_are_those_of_the_robot),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

/* Law: whatever happens to scanners, servos and wheels, in whatever order, they stream again by themselves; what was measured
 * is in the map where it was, or nowhere; every telegram is accounted for; memory does not grow. An LMS2xx, two TiM, an
 * LMS1xx and an LMS5xx at once, tilted by a servo that the program commands (or reads), on a robot with odometry, each
 * befallen by a fault every few seconds, drawn by a seed; five virtual minutes, a quarter of them with each of four servos.
 *
 *   test_chaos [SECONDS [SEED]]     an hour: 3600 (make soak)
 *
 * Every fourth beam is cast, those between repeat it: the rays are most of the time this takes. */
#include <malloc.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "tests/rig_robot.h"

#define MS       RIG_MS
#define SECOND   RIG_SECOND
#define VICTIMS  7
#define GROWS_KB 64

static int64_t seconds = 300;
static uint64_t seed = 1;

static const char scanners[] =
    "  - {name: tim-a, driver: tim, connect: usb, range: [0.1, 20], tilt: servo}\n"
    "  - {name: tim-b, driver: tim, connect: 192.168.0.1, range: [0.1, 20], tilt: servo}\n"
    "  - {name: lms1xx, driver: lms1xx, connect: 192.168.0.2, range: [0.1, 20], tilt: servo}\n"
    "  - {name: lms5xx, driver: lms5xx, connect: 192.168.0.3, range: [0.1, 30], tilt: servo}\n";

/* A Modbus drive with all that one may have. */
#define STRICT_KEYS                                                                                              \
	", write: [{address: 16, value: 6}, {address: 16, value: 15, until: {address: 17, mask: 4, value: 4}}]," \
	" strobe: {address: 16, on: 31, off: 15}, watchdog: {address: 20, toggle: 1, period: 100ms},"            \
	" status: {address: 17, fault: 8}, reset: [{address: 16, value: 0}, {address: 16, value: 128}]"

/* What may befall: a share or size, and how long in ms; most 0: once. */
struct misfortune {
	const char *kind;
	double value;
	int least_ms, most_ms;
};
#define OF_ANY                                                                                                       \
	{"lost", 0.1, 1000, 5000}, {"silence", 0, 100, 6000}, {"stall", 0, 100, 1500}, {"garbage", 0, 100, 2000},    \
	    {"crc", 0.1, 500, 4000}, {"split", 0, 500, 2000}, {"jitter", 5, 500, 4000}, {"bytewise", 0, 300, 1000},  \
	    {"hold", 40, 300, 2000}, {"no answer", 0, 100, 5000}, {"unplug", 0, 100, 6000}, {"power", 0, 500, 6000}, \
	    {"drift", 200, 2000, 9000},                                                                              \
	{                                                                                                            \
		"drift", -200, 2000, 9000                                                                            \
	}
#define OF_COLA                                                                                              \
	{"duplicate", 0.2, 1000, 4000}, {"merge", 3, 1000, 4000}, {"sfa", 3, 0, 0}, {"clock wrap", 1, 0, 0}, \
	    {"counter wrap", 7, 0, 0}, {"clock step", 10, 0, 0}, {"name blanks", 0, 500, 3000},              \
	    {"time", 0, 500, 3000}, {"reset", 0, 0, 0},                                                      \
	{                                                                                                    \
		"half-open", 0, 0, 0                                                                         \
	}
#define OF_TCP                       \
	{"refuse", 0, 100, 6000},    \
	{                            \
		"hang", 0, 100, 6000 \
	}

static const struct misfortune of_lms2xx[] = {OF_ANY,
                                              {"corrupt", 0.1, 500, 4000},
                                              {"gap", 14, 0, 0},
                                              {"false stx", 0, 500, 3000},
                                              {"false start", 0, 500, 3000},
                                              {"ack lost", 0, 0, 0},
                                              {"nak", 0, 0, 0},
                                              {"reject", 0, 0, 0}};
static const struct misfortune of_tim_a[] = {OF_ANY, OF_COLA};
static const struct misfortune of_tcp[] = {OF_ANY, OF_COLA, OF_TCP, {"corrupt", 0.1, 500, 4000}};

/* What makes a sweep stand for good is in the matrix; here it has to go on. */
#define OF_BUS                                                                                                         \
	{"bus-off", 0, 100, 3000}, {"warning", 0, 100, 2000}, {"passive", 0, 100, 2000}, {"errors", 0, 500, 3000},     \
	    {"drop", 0.1, 500, 3000}, {"overrun", 0.1, 500, 3000}, {"bus late", 15, 500, 3000}, {"rtr", 0, 500, 3000}, \
	    {"extended", 0, 500, 3000}, {"flood", 0, 300, 1500}, {"down", 0, 100, 4000},                               \
	{                                                                                                              \
		"deleted", 0, 100, 4000                                                                                \
	}
static const struct misfortune of_node[] = {OF_BUS,
                                            {"full", 0, 100, 3000},
                                            {"no ack", 0, 100, 3000},
                                            {"fd", 0, 500, 3000},
                                            {"heartbeat", 0, 500, 3000},
                                            {"silent", 0, 100, 4000},
                                            {"power cycle", 0.3, 0, 0},
                                            {"off", 0, 500, 4000},
                                            {"emcy", 0, 0, 0},
                                            {"fault", 0, 0, 0},
                                            {"sdo abort", 0, 0, 0},
                                            {"sdo timeout", 0, 100, 2000},
                                            {"late", 3, 500, 3000},
                                            {"no pdo", 0, 100, 2000},
                                            {"mapping", 0, 0, 0}};
static const struct misfortune of_signal[] = {OF_BUS,
                                              {"as fd", 0, 500, 3000},
                                              {"silence", 0, 100, 4000},
                                              {"gap", 5, 0, 0},
                                              {"invalid", 0, 100, 2000},
                                              {"short", 0, 100, 2000},
                                              {"wrong id", 0, 100, 2000}};
static const struct misfortune of_modbus[] = {
    {"unplug", 0, 100, 4000}, {"silence", 0, 100, 3000}, {"lost", 0.02, 500, 3000},    {"busy", 0, 100, 2000},
    {"late", 700, 0, 0},      {"late", 60, 0, 0},        {"wrong unit", 0, 100, 2000}, {"crc", 0, 100, 2000},
    {"torn", 2, 500, 3000},   {"fault", 0, 0, 0}};
static const struct misfortune of_wheels[] = {OF_BUS,
                                              {"silence", 0, 100, 4000},
                                              {"short", 0, 100, 2000},
                                              {"wrong id", 0, 100, 2000},
                                              {"power", 0, 500, 2000},
                                              {"no poses", 0, 100, 2000}};

struct victim {
	const char *name;
	const struct misfortune *of;
	size_t kinds;
	const struct misfortune *now; /* NULL: it is well */
	int64_t next_ns;              /* of its fortune: taken back, or the next one */
	uint64_t befallen, random;
};
#define KINDS(table) table, sizeof(table) / sizeof(table[0])

static void attach_cola(struct rig *rig, const char *name, enum rig_transport transport, enum sim_cola_model_id model,
                        bool binary)
{
	struct sim_cola_params params = {.model = model, .dialect = binary ? SIM_COLA_B : SIM_COLA_A, .segments = true};
	struct sim_device brain;
	struct scene scene;

	rig_scene(rig, name, &scene);
	assert_int_equal(sim_cola_create(&params, &scene, rig_epoch_ns(rig), &brain), 0);
	rig_attach(rig, name, transport, &brain);
}

static struct rig *begin(enum robot_servo servo)
{
	struct rig *rig = robot_create(&(struct robot_params){.servo = servo,
	                                                      .keys = servo == ROBOT_RTU ? STRICT_KEYS : NULL,
	                                                      .strict = servo == ROBOT_RTU,
	                                                      .devices = scanners,
	                                                      .odometry = true,
	                                                      .speed_deg = 20,
	                                                      .rig = {.seed = seed, .thin = 4}});

	attach_cola(rig, "tim-a", RIG_USB, SIM_TIM571, false);
	attach_cola(rig, "tim-b", RIG_TCP, SIM_TIM561, true);
	attach_cola(rig, "lms1xx", RIG_TCP, SIM_LMS111, true);
	attach_cola(rig, "lms5xx", RIG_TCP, SIM_LMS511, true);
	rig_start(rig);
	return rig;
}

/* Its fortune turns. */
static void turn(struct rig *rig, struct victim *v)
{
	int64_t for_ns;

	if (v->now && v->now->most_ms > 0)
		assert_true(rig_fault(rig, v->name, v->now->kind, v->now->value, false));
	if (v->now) {
		v->now = NULL;
		v->next_ns = rig_now(rig) + (int64_t)((1 + 9 * sim_random(&v->random)) * (double)SECOND);
		return;
	}
	v->now = &v->of[(size_t)(sim_random(&v->random) * (double)v->kinds)];
	v->befallen++;
	for_ns =
	    (int64_t)((v->now->least_ms + sim_random(&v->random) * (v->now->most_ms - v->now->least_ms)) * (double)MS);
	v->next_ns = rig_now(rig) + for_ns;
	if (v->now->most_ms == 0 ? !rig_once(rig, v->name, v->now->kind, v->now->value)
	                         : !rig_fault(rig, v->name, v->now->kind, v->now->value, true))
		fail_msg("%s: no such misfortune: %s", v->name, v->now->kind);
}

static void make_mischief(struct rig *rig, struct victim *victims, int64_t until_ns)
{
	while (rig_now(rig) < until_ns) {
		int64_t next_ns = until_ns;

		for (int i = 0; i < VICTIMS; i++) {
			if (victims[i].next_ns <= rig_now(rig))
				turn(rig, &victims[i]);
			if (victims[i].next_ns < next_ns)
				next_ns = victims[i].next_ns;
		}
		rig_run(rig, next_ns > rig_now(rig) ? next_ns - rig_now(rig) : 1);
	}
	for (int i = 0; i < VICTIMS; i++)
		if (victims[i].now)
			turn(rig, &victims[i]);
}

/* What has to be true of a device in the end. */
static void judge(struct rig *rig, const struct victim *v)
{
	static const char *const left_out[] = {"mode unknown",   "mode without ranges",
	                                       "raster unknown", "malformed",
	                                       "without ranges", "too many beams",
	                                       "implausible",    "short",
	                                       "invalid",        "slow",
	                                       "torn",           "undated"};
	const bool scans = strcmp(v->name, "servo") != 0 && strcmp(v->name, "wheels") != 0;
	struct rig_points points;
	struct rig_view view;
	int64_t out = 0, missing;

	rig_view(rig, v->name, &view);
	memset(&points, 0, sizeof(points));
	if (scans)
		rig_points(rig, v->name, &points);
	for (size_t i = 0; i < sizeof(left_out) / sizeof(left_out[0]); i++)
		/* A CANopen node whose mapping was lost sends short frames, and no angle in them. */
		if (rig_count(rig, v->name, left_out[i]) > 0 &&
		    (strcmp(left_out[i], "short") != 0 || rig_count(rig, v->name, "statuswords") < 0))
			out += rig_count(rig, v->name, left_out[i]);
	printf("%s%s: %llu faults, %llu losses; %llu telegrams sent, %llu decoded, %llu fell under the line, %lld "
	       "left out, "
	       "%llu left wrong, %llu never left; %.4f %% of %llu points within 5 cm (%llu rows unknown), rows within "
	       "%.2f ms (p99)\n",
	       v->befallen ? "note: " : "", v->name, (unsigned long long)v->befallen,
	       (unsigned long long)view.line.losses, (unsigned long long)view.sent.sent,
	       (unsigned long long)view.profiles, (unsigned long long)view.lost_profiles, (long long)out,
	       (unsigned long long)view.sent.corrupted, (unsigned long long)view.sent.dropped,
	       100.0 * (double)points.near / (double)(points.points ? points.points : 1),
	       (unsigned long long)points.points, (unsigned long long)points.unknown_rows,
	       (double)points.time_p99_ns / 1e6);
	if (view.state != SUPERVISOR_STREAMING)
		fail_msg("%s does not stream: %s", v->name, view.line.error);
	assert_true(rig_now(rig) - view.last_data_ns < SECOND);
	assert_true(!scans || (points.points > 0 && points.near * 1000 >= points.points * 999));
	if (strcmp(v->name, "wheels") == 0) { /* motions lie between frames, which hold two values each */
		view.profiles = (uint64_t)(rig_count(rig, "wheels", "values") + rig_count(rig, "wheels", "short")) / 2;
		out = 0;
	}
	/* What a node sends before its mapping was read again is counted as not mapped, among PDOs that hold no angle: at most
	 * one for each time that it was lost. */
	missing = (int64_t)view.sent.sent - (int64_t)(view.profiles + view.lost_profiles) - out;
	assert_true(missing >= 0 &&
	            missing <= (rig_count(rig, v->name, "statuswords") < 0 ? 0 : (int64_t)view.line.losses));
	assert_true(view.profiles > 0);
}

static const enum robot_servo servos[] = {ROBOT_RTU, ROBOT_POSITION, ROBOT_CAN, ROBOT_CYCLIC};
enum { QUARTERS = sizeof(servos) / sizeof(servos[0]) };

static void without_faults_the_points_are_where_they_were(void **state)
{
	static const char *const names[VICTIMS] = {"laser", "tim-a", "tim-b", "lms1xx", "lms5xx", "servo", "wheels"};
	struct rig *rig = begin(ROBOT_POSITION);

	(void)state;
	rig_run(rig, 30 * SECOND);
	for (int i = 0; i < VICTIMS; i++)
		judge(rig, &(struct victim){.name = names[i]});
	rig_destroy(rig);
}

static void survive(int quarter)
{
	struct victim victims[VICTIMS] = {
	    {"laser", KINDS(of_lms2xx), NULL, 0, 0, 0}, {"tim-a", KINDS(of_tim_a), NULL, 0, 0, 0},
	    {"tim-b", KINDS(of_tcp), NULL, 0, 0, 0},    {"lms1xx", KINDS(of_tcp), NULL, 0, 0, 0},
	    {"lms5xx", KINDS(of_tcp), NULL, 0, 0, 0},   {"servo", KINDS(of_node), NULL, 0, 0, 0},
	    {"wheels", KINDS(of_wheels), NULL, 0, 0, 0}};
	struct rig *rig = begin(servos[quarter]);
	const int64_t last_ns = seconds * SECOND / QUARTERS;
	size_t before, after;

	if (servos[quarter] == ROBOT_RTU)
		victims[5] = (struct victim){"servo", KINDS(of_modbus), NULL, 0, 0, 0};
	if (servos[quarter] == ROBOT_CAN)
		victims[5] = (struct victim){"servo", KINDS(of_signal), NULL, 0, 0, 0};
	for (int i = 0; i < VICTIMS; i++) {
		victims[i].random = sim_mix(seed * 100 + (uint64_t)(quarter * VICTIMS + i));
		victims[i].next_ns = (5 + i) * SECOND;
	}
	make_mischief(rig, victims, last_ns / 3);
	before = mallinfo2().uordblks;
	make_mischief(rig, victims, last_ns);
	after = mallinfo2().uordblks;
	rig_run(rig, 45 * SECOND); /* an LMS1xx boots for 20 s, a refusal is held for up to 30 s */
	printf("note: %lld virtual s with %s, seed %llu: %zu log lines, memory %zu KB, then %zu KB\n",
	       (long long)(last_ns / SECOND), robot_servo_name(servos[quarter]), (unsigned long long)seed,
	       rig_logged(rig), before / 1024, after / 1024);
	for (int i = 0; i < VICTIMS; i++)
		judge(rig, &victims[i]);
	assert_true(after < before + GROWS_KB * 1024);
	rig_destroy(rig);
}

static void all_survive_whatever_befalls_them(void **state)
{
	(void)state;
	for (int quarter = 0; quarter < QUARTERS; quarter++)
		survive(quarter);
}

int main(int argc, char **argv)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(without_faults_the_points_are_where_they_were),
	    cmocka_unit_test(all_survive_whatever_befalls_them),
	};

	if (argc > 1)
		seconds = atoll(argv[1]);
	if (argc > 2)
		seed = (uint64_t)atoll(argv[2]);
	return cmocka_run_group_tests(tests, NULL, NULL);
}

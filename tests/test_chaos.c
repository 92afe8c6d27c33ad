/* Law: whatever happens to scanners, in whatever order, they stream again by themselves; what they measured is in the map
 * where it was, or nowhere; every telegram is accounted for; memory does not grow. An LMS2xx, two TiM, an LMS1xx and an
 * LMS5xx at once, each befallen by a fault every few seconds, drawn by a seed; five virtual minutes.
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

#include "tests/rig.h"

#define MS       RIG_MS
#define SECOND   RIG_SECOND
#define VICTIMS  5
#define GROWS_KB 64

static int64_t seconds = 300;
static uint64_t seed = 1;

static const char yaml[] = "mount: {base_tilt: {xyz: [0.2, 0, 0.4]}, tilt_laser: {xyz: [0, 0, 0.05]}}\n"
                           "devices:\n"
                           "  - {name: lms2xx, driver: lms2xx, port: /dev/lms, baud: 500000, variant: 180/0.5, range: "
                           "[0.1, 30], tilt: servo}\n"
                           "  - {name: tim-a, driver: tim, connect: usb, range: [0.1, 20], tilt: servo}\n"
                           "  - {name: tim-b, driver: tim, connect: 192.168.0.1, range: [0.1, 20], tilt: servo}\n"
                           "  - {name: lms1xx, driver: lms1xx, connect: 192.168.0.2, range: [0.1, 20], tilt: servo}\n"
                           "  - {name: lms5xx, driver: lms5xx, connect: 192.168.0.3, range: [0.1, 30], tilt: servo}\n"
                           "  - {name: servo, driver: modbus, connect: /dev/servo, unit: 1,\n"
                           "     position: {function: 3, address: 0, type: i32, scale: 0.001deg, sign: -1},\n"
                           "     target: {function: 16, address: 2, type: i32, scale: 0.001deg, sign: -1},\n"
                           "     speed: {function: 16, address: 4, type: u32, scale: 0.001deg}}\n"
                           "  - {name: pose, driver: pose, listen: \"unix:/run/pose.sock\"}\n"
                           "sweep: {device: servo, from: -65deg, to: 45deg, speed: 20deg, profile: triangle}\n";

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

static struct rig *begin(void)
{
	struct rig *rig = rig_create(&(struct rig_params){.yaml = yaml, .seed = seed, .thin = 4});
	struct sim_lms2xx_params params = {.mode = 0x05, .millimetres = true};
	struct sim_device brain;
	struct scene scene;

	rig_scene(rig, "lms2xx", &scene);
	assert_int_equal(sim_lms2xx_create(&params, &scene, rig_epoch_ns(rig), &brain), 0);
	rig_attach(rig, "lms2xx", RIG_SERIAL, &brain);
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
	static const char *const left_out[] = {"mode unknown",   "mode without ranges", "raster unknown", "malformed",
	                                       "without ranges", "too many beams",      "implausible"};
	struct rig_points points;
	struct rig_view view;
	int64_t out = 0;

	rig_view(rig, v->name, &view);
	rig_points(rig, v->name, &points);
	for (size_t i = 0; i < sizeof(left_out) / sizeof(left_out[0]); i++)
		if (rig_count(rig, v->name, left_out[i]) > 0)
			out += rig_count(rig, v->name, left_out[i]);
	printf("%s%s: %llu faults, %llu losses; %llu telegrams sent, %llu decoded, %llu fell under the line, %lld "
	       "left out, "
	       "%llu left wrong, %llu never left; %.4f %% of %llu points within 5 cm (%llu rows unknown), rows within "
	       "%.2f ms (p99)\n",
	       v->befallen ? "note: " : "", v->name, (unsigned long long)v->befallen,
	       (unsigned long long)view.line.losses, (unsigned long long)view.sent.sent,
	       (unsigned long long)view.profiles, (unsigned long long)view.lost_profiles, (long long)out,
	       (unsigned long long)view.sent.corrupted, (unsigned long long)view.sent.dropped,
	       100.0 * (double)points.near / (double)points.points, (unsigned long long)points.points,
	       (unsigned long long)points.unknown_rows, (double)points.time_p99_ns / 1e6);
	if (view.state != SUPERVISOR_STREAMING)
		fail_msg("%s does not stream: %s", v->name, view.line.error);
	assert_true(rig_now(rig) - view.last_data_ns < SECOND);
	assert_true(points.points > 0 && points.near * 1000 >= points.points * 999);
	assert_int_equal(view.sent.sent, view.profiles + view.lost_profiles + (uint64_t)out);
	assert_true(view.profiles > 0);
}

static void without_faults_the_points_are_where_they_were(void **state)
{
	static const char *const names[VICTIMS] = {"lms2xx", "tim-a", "tim-b", "lms1xx", "lms5xx"};
	struct rig *rig = begin();

	(void)state;
	rig_run(rig, 30 * SECOND);
	for (int i = 0; i < VICTIMS; i++)
		judge(rig, &(struct victim){.name = names[i]});
	rig_destroy(rig);
}

static void all_scanners_survive_whatever_befalls_them(void **state)
{
	struct victim victims[VICTIMS] = {{"lms2xx", KINDS(of_lms2xx), NULL, 0, 0, 0},
	                                  {"tim-a", KINDS(of_tim_a), NULL, 0, 0, 0},
	                                  {"tim-b", KINDS(of_tcp), NULL, 0, 0, 0},
	                                  {"lms1xx", KINDS(of_tcp), NULL, 0, 0, 0},
	                                  {"lms5xx", KINDS(of_tcp), NULL, 0, 0, 0}};
	struct rig *rig = begin();
	size_t before, after;

	(void)state;
	for (int i = 0; i < VICTIMS; i++) {
		victims[i].random = sim_mix(seed * 100 + (uint64_t)i);
		victims[i].next_ns = (5 + i) * SECOND;
	}
	make_mischief(rig, victims, seconds / 3 * SECOND);
	before = mallinfo2().uordblks;
	make_mischief(rig, victims, seconds * SECOND);
	after = mallinfo2().uordblks;
	rig_run(rig, 60 * SECOND); /* an LMS1xx boots for 20 s, a refusal is held for up to 30 s */
	for (int i = 0; i < VICTIMS; i++)
		judge(rig, &victims[i]);
	printf("note: %lld virtual s, seed %llu: %zu log lines, memory %zu KB, then %zu KB\n", (long long)seconds,
	       (unsigned long long)seed, rig_logged(rig), before / 1024, after / 1024);
	assert_true(after < before + GROWS_KB * 1024);
	rig_destroy(rig);
}

int main(int argc, char **argv)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(without_faults_the_points_are_where_they_were),
	    cmocka_unit_test(all_scanners_survive_whatever_befalls_them),
	};

	if (argc > 1)
		seconds = atoll(argv[1]);
	if (argc > 2)
		seed = (uint64_t)atoll(argv[2]);
	return cmocka_run_group_tests(tests, NULL, NULL);
}

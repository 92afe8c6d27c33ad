/* Law: whatever the matrix of faults has for an LMS2xx, the driver does what its row says, counts it, says it once, and data
 * flow again within the row's time; nothing that was not measured gets into a row of points. Rows LMS2xx and Time of the
 * table in docs/devices.md. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include <cmocka.h>

#include "core/trig.h"
#include "tests/matrix.h"

#define MS     RIG_MS
#define SECOND RIG_SECOND
#define EVER   INT64_MAX
#define MANY   1000000

/* Meanings of matrix_row.variant: what kind of scanner stands there. */
enum { USUAL, MODE_13 = 0x10, MODE_14 = 0x13, MODE_15 = 0x15, MODE_16 = 0x1f };

static struct rig *make(const struct matrix_row *row)
{
	char yaml[2000];
	struct sim_lms2xx_params params = {.mode = row->variant ? row->variant & 15 : 5, .millimetres = true};
	struct sim_device brain;
	struct scene scene;
	struct rig *rig;
	const char *keys = row->keys ? row->keys : "";

	snprintf(yaml, sizeof(yaml),
	         "mount: {base_tilt: {xyz: [0.2, 0, 0.4]}, tilt_laser: {xyz: [0, 0, 0.05]}}\n"
	         "devices:\n"
	         "  - {name: laser, driver: lms2xx, port: /dev/lms, range: [0.1, 30], tilt: servo%s%s%s}\n"
	         "  - {name: servo, driver: modbus, connect: /dev/servo, unit: 1,\n"
	         "     position: {function: 3, address: 0, type: i32, scale: 0.001deg, sign: -1},\n"
	         "     target: {function: 16, address: 2, type: i32, scale: 0.001deg, sign: -1},\n"
	         "     speed: {function: 16, address: 4, type: u32, scale: 0.001deg}}\n"
	         "  - {name: pose, driver: pose, listen: \"unix:/run/pose.sock\"}\n"
	         "sweep: {device: servo, from: -65deg, to: 45deg, speed: 30deg, profile: triangle}\n",
	         strstr(keys, "baud:") ? "" : ", baud: 500000", strstr(keys, "variant:") ? "" : ", variant: 180/0.5",
	         keys);
	rig = rig_create(&(struct rig_params){.yaml = yaml, .seed = 7});
	rig_scene(rig, "laser", &scene);
	assert_int_equal(sim_lms2xx_create(&params, &scene, rig_epoch_ns(rig), &brain), 0);
	rig_attach(rig, "laser", RIG_SERIAL, &brain);
	return rig;
}

static const char *const left_out[] = {"mode unknown", "mode without ranges", "raster unknown", NULL};
static const char *const quiet[] = {"telegrams", "profiles", NULL};
static const struct matrix_bench bench = {
    .title = "LMS2xx", .device = "laser", .make = make, .left_out = left_out, .quiet = quiet, .setup_ns = 30 * SECOND};

#define SETS_UP "tries the rates until it answers, reads its set-up, writes what differs, starts it"

/* Within the row's time the servo turned round. */
static void went_both_ways(struct rig *rig, const struct matrix_row *row)
{
	const int64_t now_ns = rig_epoch_ns(rig) + rig_now(rig);
	bool up = false, down = false;

	for (int64_t back_ns = 0; back_ns < 5 * SECOND; back_ns += 100 * MS) {
		const double moved = rig_tilt(rig, now_ns - back_ns) - rig_tilt(rig, now_ns - back_ns - 100 * MS);

		up |= moved < 0;
		down |= moved > 0;
	}
	if (!up || !down)
		fail_msg("%s: the servo went one way only", row->name);
}

static const struct matrix_row rows[] = {
    {.name = "factory state (9600 Bd, 180/0.5)",
     .does = "finds 9600 Bd, changes to the configured rate, starts",
     .from_start = true,
     .pause_ns = 100 * MS,
     .again_ns = 3 * SECOND},
    {.name = "baud mismatch (38400)",
     .does = "takes what it hears for garbage, finds the rate by trying",
     .fault = {{"baud", 38400, 0}},
     .from_start = true,
     .pause_ns = 100 * MS,
     .again_ns = 6 * SECOND},
    {.name = "baud mismatch (19200)",
     .does = "the same",
     .fault = {{"baud", 19200, 0}},
     .from_start = true,
     .pause_ns = 100 * MS,
     .again_ns = 10 * SECOND},
    {.name = "permanent baud 38400",
     .does = "finds the rate again after a power cycle",
     .fault = {{"permanent baud", 38400, 0}, {"power", 0, 0}},
     .losses = 1,
     .log = "lost: it stopped sending; setting it up again",
     .counted = {{"garbage bytes", 0, 200}, {"too long", 0, 2}, {"cut", 0, 2}},
     .pause_ns = 8 * SECOND},
    {.name = "streaming during connect",
     .does = "stops it at a telegram's boundary, sets it up, starts it",
     .fault = {{"baud", 500000, 0}, {"streaming", 0, 0}},
     .from_start = true,
     .counted = {{"mode unknown", 0, 3}},
     .pause_ns = 100 * MS,
     .again_ns = 3 * SECOND},
    {.name = "streaming during connect, another rate",
     .does = "finds the rate among the garbage, stops it",
     .fault = {{"baud", 38400, 0}, {"streaming", 0, 0}},
     .from_start = true,
     .counted =
         {{"crc", 0, 50}, {"garbage bytes", 1000, 40000}, {"too long", 0, 500}, {"bad size", 0, 50}, {"cut", 0, 9}},
     .pause_ns = 100 * MS,
     .again_ns = 8 * SECOND},
    {.name = "no answer",
     .does = "tries all rates, gives up with a sentence, tries again with back-off",
     .fault = {{"no answer", 0, 20 * SECOND}},
     .from_start = true,
     .losses = -1,
     .log = "no scanner answers at",
     .pause_ns = 100 * MS,
     .again_ns = 40 * SECOND},
    {.name = "ACK lost",
     .does = "goes on with the reply, which says more",
     .fault = {{"ack lost", 0, EVER}},
     .from_start = true,
     .pause_ns = 100 * MS,
     .again_ns = 3 * SECOND},
    {.name = "NAK once",
     .does = "waits 30 ms, repeats the request",
     .fault = {{"nak", 0, 0}},
     .from_start = true,
     .counted = {{"nak", 1, 1}},
     .pause_ns = 100 * MS,
     .again_ns = 4 * SECOND},
    {.name = "92 once",
     .does = "repeats the request",
     .fault = {{"reject", 0, 0}},
     .from_start = true,
     .counted = {{"rejected", 1, 1}},
     .pause_ns = 100 * MS,
     .again_ns = 4 * SECOND},
    {.name = "92 for ever",
     .does = "gives up with a sentence, tries again with back-off",
     .fault = {{"reject", 0, EVER}},
     .from_start = true,
     .counted = {{"rejected", 3, MANY}},
     .losses = -1,
     .log = "not ready"},
    {.name = "reply split at every byte",
     .does = "joins the pieces",
     .fault = {{"split", 0, EVER}},
     .from_start = true,
     .pause_ns = 100 * MS,
     .again_ns = 3 * SECOND},
    {.name = "measurements split at every byte",
     .does = "joins the pieces",
     .fault = {{"bytewise", 0, 5 * SECOND}},
     .pause_ns = 100 * MS,
     .again_ns = 100 * MS},
    {.name = "requests taken byte by byte",
     .does = "waits for room, in order",
     .fault = {{"slow writes", 0, EVER}},
     .from_start = true,
     .pause_ns = 100 * MS,
     .again_ns = 3 * SECOND},
    {.name = "false STX in data",
     .does = "reads the telegram by its length and check sum",
     .fault = {{"false stx", 0, 5 * SECOND}},
     .pause_ns = 100 * MS,
     .again_ns = 100 * MS},
    {.name = "false start before a telegram",
     .does = "gives up the false start, finds the telegram within its bytes",
     .fault = {{"false start", 0, 5 * SECOND}},
     .counted = {{"crc", 1, MANY}, {"garbage bytes", 4, MANY}, {"cut", 0, MANY}},
     .pause_ns = 200 * MS,
     .again_ns = 300 * MS},
    {.name = "CRC error",
     .does = "refuses the telegram: one scan is lost",
     .fault = {{"crc", 0, 0}},
     .counted = {{"crc", 1, 3}, {"garbage bytes", 700, 800}, {"bad size", 0, 9}, {"too long", 0, 9}, {"cut", 0, 1}},
     .pause_ns = 70 * MS,
     .losses = 0},
    {.name = "one byte in a hundred telegrams wrong",
     .does = "refuses those",
     .fault = {{"corrupt", 0.01, 20 * SECOND}},
     .counted =
         {{"crc", 1, 30}, {"garbage bytes", 700, 20000}, {"bad size", 0, 99}, {"too long", 0, 99}, {"cut", 0, 9}},
     .pause_ns = 150 * MS,
     .again_ns = 100 * MS},
    {.name = "gaps of 14 ms within telegrams",
     .does = "waits for the rest",
     .fault = {{"gap", 14, 5 * SECOND}},
     .pause_ns = 100 * MS,
     .again_ns = 100 * MS},
    {.name = "silence for 1 s",
     .does = "waits",
     .fault = {{"silence", 0, SECOND}},
     .counted = {{"garbage bytes", 0, 800}, {"too long", 0, 2}, {"cut", 0, 1}},
     .pause_ns = 1200 * MS,
     .again_ns = 100 * MS},
    {.name = "silence for 5 s",
     .does = "sets it up again after 2 s without a telegram",
     .fault = {{"silence", 0, 5 * SECOND}},
     .losses = -1,
     .log = "lost: it stopped sending; setting it up again",
     .counted = {{"garbage bytes", 0, 800}, {"too long", 0, 2}, {"cut", 0, 1}},
     .pause_ns = 15 * SECOND,
     .again_ns = 10 * SECOND},
    {.name = "garbage at full rate for 1 s",
     .does = "finds the first whole telegram behind it",
     .fault = {{"garbage", 0, SECOND}},
     .counted =
         {{"garbage bytes", 40000, 60000}, {"crc", 0, 99}, {"bad size", 0, 999}, {"too long", 0, 999}, {"cut", 0, 9}},
     .pause_ns = 1300 * MS,
     .again_ns = 300 * MS},
    {.name = "garbage at full rate for 10 s",
     .does = "sets it up again after 2 s without a telegram",
     .fault = {{"garbage", 0, 10 * SECOND}},
     .losses = -1,
     .log = "lost: it stopped sending; setting it up again",
     .counted = {{"garbage bytes", 40000, 600000},
                 {"crc", 0, 999},
                 {"bad size", 0, 9999},
                 {"too long", 0, 9999},
                 {"cut", 0, 99},
                 {"nak", 0, 999}},
     .pause_ns = 20 * SECOND,
     .again_ns = 10 * SECOND},
    {.name = "power cycle",
     .does = "knows it by the 90 telegram, sets it up anew",
     .fault = {{"power", 0, 5 * SECOND}},
     .losses = -1,
     .log = "lost",
     .counted = {{"garbage bytes", 0, 800}, {"too long", 0, 2}, {"cut", 0, 1}},
     .pause_ns = 20 * SECOND,
     .again_ns = 10 * SECOND},
    {.name = "power cycle, back at once",
     .does = "hears nothing at its rate for 2 s, sets it up anew",
     .fault = {{"power", 0, 0}},
     .losses = 1,
     .log = "lost: it stopped sending; setting it up again",
     .counted = {{"garbage bytes", 0, 900}, {"too long", 0, 2}, {"cut", 0, 1}},
     .pause_ns = 6 * SECOND},
    {.name = "adapter unplugged for 5 s",
     .does = "tries to open it at least once a second",
     .fault = {{"unplug", 0, 5 * SECOND}},
     .losses = -1,
     .log = "there is no such device",
     .counted = {{"cut", 0, 1}, {"garbage bytes", 0, 800}},
     .pause_ns = 12 * SECOND,
     .again_ns = 6 * SECOND},
    {.name = "500 kBd refused by the adapter",
     .does = "streams at the next lower rate, and says so",
     .fault = {{"no baud", 500000, EVER}},
     .from_start = true,
     .losses = -1,
     .log = "streams at 38400 Bd",
     .pause_ns = 300 * MS,
     .again_ns = 8 * SECOND},
    {.name = "codes of A.8, 13 bit (mode 00)",
     .does = "reads every code as what it says, never as a range",
     .fault = {{"codes", 0, 5 * SECOND}},
     .variant = MODE_13,
     .pause_ns = 100 * MS,
     .again_ns = 100 * MS},
    {.name = "codes of A.8, 14 bit (mode 03)",
     .does = "the same",
     .fault = {{"codes", 0, 5 * SECOND}},
     .variant = MODE_14,
     .pause_ns = 100 * MS,
     .again_ns = 100 * MS},
    {.name = "codes of A.8, 15 bit (mode 05)",
     .does = "the same",
     .fault = {{"codes", 0, 5 * SECOND}},
     .variant = MODE_15,
     .pause_ns = 100 * MS,
     .again_ns = 100 * MS},
    {.name = "codes of A.8, 16 bit (mode 0F)",
     .does = "the same",
     .fault = {{"codes", 0, 5 * SECOND}},
     .variant = MODE_16,
     .pause_ns = 100 * MS,
     .again_ns = 100 * MS},
    {.name = "real-time indices on",
     .does = "dates scans by the index",
     .fault = {{"indices", 0, 0}},
     .from_start = true,
     .pause_ns = 100 * MS,
     .again_ns = 3 * SECOND},
    {.name = "real-time indices wanted, off in the scanner",
     .does = "writes its configuration once",
     .keys = ", indices: on",
     .from_start = true,
     .pause_ns = 100 * MS,
     .again_ns = 5 * SECOND},
    {.name = "partial scans 0..3",
     .does = "asks for partial scans; each turn is a row of its own",
     .keys = ", variant: 180/0.25",
     .from_start = true,
     .pause_ns = 100 * MS,
     .again_ns = 5 * SECOND},
    {.name = "100/0.25 (four turns)",
     .does = "gives every beam the time of its turn",
     .keys = ", variant: 100/0.25",
     .from_start = true,
     .pause_ns = 200 * MS,
     .again_ns = 5 * SECOND},
    {.name = "180/1 (75 Hz)",
     .does = "one turn a row",
     .keys = ", variant: 180/1",
     .from_start = true,
     .pause_ns = 100 * MS,
     .again_ns = 5 * SECOND},
    {.name = "centimetres",
     .does = "reads the unit from every telegram",
     .fault = {{"cm", 0, 0}},
     .from_start = true,
     .pause_ns = 100 * MS,
     .again_ns = 3 * SECOND},
    {.name = "millimetres wanted, centimetres in the scanner",
     .does = "enters installation mode, writes unit once",
     .fault = {{"cm", 0, 0}},
     .keys = ", unit: mm",
     .from_start = true,
     .pause_ns = 100 * MS,
     .again_ns = 5 * SECOND},
    {.name = "slow baud with skipped scans (38400)",
     .does = "streams what the line can carry",
     .keys = ", baud: 38400",
     .from_start = true,
     .pause_ns = 300 * MS,
     .again_ns = 4 * SECOND},
    {.name = "slow baud with skipped scans and indices (38400)",
     .does = "counts the scans skipped, dates by the index",
     .fault = {{"indices", 0, 0}},
     .keys = ", baud: 38400",
     .counted = {{"scans skipped", 1, MANY}},
     .from_start = true,
     .pause_ns = 300 * MS,
     .again_ns = 4 * SECOND},
    {.name = "mirror 200 ppm fast",
     .does = "follows it",
     .fault = {{"drift", 200, 60 * SECOND}},
     .pause_ns = 100 * MS,
     .again_ns = 100 * MS},
    {.name = "mirror 200 ppm slow, indices on",
     .does = "follows it",
     .fault = {{"indices", 0, 0}, {"drift", -200, 60 * SECOND}},
     .pause_ns = 100 * MS,
     .again_ns = 100 * MS},
    {.name = "arrivals late by up to 10 ms",
     .does = "dates by the least delayed",
     .fault = {{"jitter", 10, 20 * SECOND}},
     .pause_ns = 100 * MS,
     .again_ns = 100 * MS},
    {.name = "host asleep, 100 ms at a time",
     .does = "gives what it reads at once the times of its turns",
     .fault = {{"hold", 100, 10 * SECOND}},
     .pause_ns = 300 * MS,
     .again_ns = 300 * MS},
    {.name = "step of CLOCK_REALTIME by an hour",
     .does = "nothing: log time has no steps",
     .fault = {{"wall clock", 3600, 5 * SECOND}},
     .pause_ns = 100 * MS,
     .again_ns = 100 * MS},
    {.name = "angles late by 20 ms",
     .does = "profiles wait for them",
     .fault = {{"late angles", 20, 5 * SECOND}},
     .pause_ns = 100 * MS,
     .again_ns = 100 * MS},
    {.name = "angles missing for 5 s",
     .does = "rows without an angle are dropped and counted",
     .fault = {{"no angles", 0, 5 * SECOND}},
     .pause_ns = 100 * MS,
     .again_ns = 100 * MS},
    {.name = "reversed sweep (the servo turns round)",
     .does = "goes on; points of both ways lie where their beams ended",
     .pause_ns = 100 * MS,
     .again_ns = 100 * MS,
     .check = went_both_ways},
};

int main(void)
{
	return matrix_run(&bench, rows, sizeof(rows) / sizeof(rows[0]));
}

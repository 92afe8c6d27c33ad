/* Law: virtual time is the real program. A scanner in the rig is found, set up and read by the driver itself, its rows lie
 * where its beams ended, the same run is the same run again, and a link that breaks does to it what a cable does. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include <cmocka.h>

#include "tests/rig_robot.h"

#define LMS2XX                                                                                                       \
	"mount: {base_tilt: {xyz: [0.2, 0, 0.4]}, tilt_laser: {xyz: [0, 0, 0.05]}}\n"                                \
	"devices:\n"                                                                                                 \
	"  - {name: laser, driver: lms2xx, port: /dev/lms, baud: 500000, variant: 180/0.5, range: [0.1, 30], tilt: " \
	"servo}\n"                                                                                                   \
	"  - {name: servo, driver: modbus, connect: /dev/servo, unit: 1,\n"                                          \
	"     position: {function: 3, address: 0, type: i32, scale: 0.001deg, sign: -1},\n"                          \
	"     target: {function: 16, address: 2, type: i32, scale: 0.001deg, sign: -1},\n"                           \
	"     speed: {function: 16, address: 4, type: u32, scale: 0.001deg}}\n"                                      \
	"  - {name: pose, driver: pose, listen: \"unix:/run/pose.sock\"}\n"                                          \
	"sweep: {device: servo, from: -65deg, to: 45deg, speed: 30deg, profile: triangle}\n"

static struct rig *make(uint64_t seed)
{
	struct rig *rig = rig_create(&(struct rig_params){.yaml = LMS2XX, .seed = seed});
	struct sim_lms2xx_params params = {.mode = 0x05, .millimetres = true};
	struct sim_device brain;
	struct scene scene;

	rig_scene(rig, "laser", &scene);
	assert_int_equal(sim_lms2xx_create(&params, &scene, rig_epoch_ns(rig), &brain), 0);
	rig_attach(rig, "laser", RIG_SERIAL, &brain);
	rig_start(rig);
	return rig;
}

static void print_log(const struct rig *rig)
{
	for (size_t i = 0; i < rig_logged(rig); i++)
		printf("  %8.3f s %d %s\n", (double)rig_log(rig, i)->t_ns * 1e-9, rig_log(rig, i)->device,
		       rig_log(rig, i)->text);
}

static void a_scanner_streams_and_its_rows_lie_where_its_beams_ended(void **state)
{
	struct rig *rig = make(1);
	struct rig_points points;
	struct rig_view view;

	(void)state;
	assert_true(rig_wait_data(rig, "laser", 20 * RIG_SECOND) > 0);
	rig_run(rig, 20 * RIG_SECOND);
	print_log(rig);
	rig_view(rig, "laser", &view);
	rig_points(rig, "laser", &points);
	printf("note: %llu profiles of %llu sent, %llu rows (%llu unknown), %llu points, %llu near, worst %.3f m, time "
	       "%.3f / "
	       "%.3f / %.3f ms\n",
	       (unsigned long long)view.profiles, (unsigned long long)view.sent.sent, (unsigned long long)points.rows,
	       (unsigned long long)points.unknown_rows, (unsigned long long)points.points,
	       (unsigned long long)points.near, points.worst_m, (double)points.time_p50_ns / 1e6,
	       (double)points.time_p99_ns / 1e6, (double)points.time_worst_ns / 1e6);
	assert_int_equal(view.state, SUPERVISOR_STREAMING);
	assert_int_equal(view.profiles + view.lost_profiles, view.sent.sent);
	assert_true(points.unknown_rows == 0);
	assert_true(points.near * 1000 >= points.points * 999);
	rig_destroy(rig);
}

static void a_line_that_is_pulled_out_is_lost_and_comes_back(void **state)
{
	struct rig *rig = make(2);
	struct rig_view view;
	int64_t back_ns;

	(void)state;
	assert_true(rig_wait_data(rig, "laser", 20 * RIG_SECOND) > 0);
	rig_run(rig, 5 * RIG_SECOND);
	rig_mark(rig, "laser");
	assert_true(rig_fault(rig, "laser", "unplug", 0, true));
	rig_run(rig, 7 * RIG_SECOND);
	rig_view(rig, "laser", &view);
	assert_int_equal(view.state, SUPERVISOR_BACKING_OFF);
	assert_int_equal(view.first_request_ns, -1);
	back_ns = rig_now(rig);
	assert_true(rig_fault(rig, "laser", "unplug", 0, false));
	assert_true(rig_wait_data(rig, "laser", 20 * RIG_SECOND) > 0);
	rig_view(rig, "laser", &view);
	print_log(rig);
	assert_true(view.first_request_ns >= back_ns && view.first_request_ns <= back_ns + 2 * RIG_SECOND);
	assert_int_equal(rig_log_count(rig, "laser", 0, "lost"), 1);
	assert_int_equal(rig_log_count(rig, "laser", 0, "not ready"), 1);
	assert_int_equal(rig_log_count(rig, "laser", 0, "streaming"), 2);
	rig_destroy(rig);
}

static void the_same_run_is_the_same_again(void **state)
{
	struct rig_view view[2];
	struct rig_points points[2];

	(void)state;
	for (int i = 0; i < 2; i++) {
		struct rig *rig = make(3);

		rig_run(rig, 5 * RIG_SECOND);
		assert_true(rig_fault(rig, "laser", "garbage", 0, true));
		rig_run(rig, RIG_SECOND);
		assert_true(rig_fault(rig, "laser", "garbage", 0, false));
		rig_run(rig, 5 * RIG_SECOND);
		rig_view(rig, "laser", &view[i]);
		rig_points(rig, "laser", &points[i]);
		rig_destroy(rig);
	}
	assert_memory_equal(&view[0], &view[1], sizeof(view[0]));
	assert_memory_equal(&points[0], &points[1], sizeof(points[0]));
	assert_true(points[0].points > 0);
}

static void swept_by_the_driver(enum robot_servo servo)
{
	struct rig *rig =
	    robot_create(&(struct robot_params){.servo = servo, .speed_deg = 37.5, .rig = {.seed = 5, .thin = 4}});
	struct rig_points points;
	struct rig_view view;

	rig_start(rig);
	if (rig_wait_data(rig, "laser", 20 * RIG_SECOND) <= 0)
		fail_msg("%s: the scanner does not stream", robot_servo_name(servo));
	rig_run(rig, 20 * RIG_SECOND);
	print_log(rig);
	rig_view(rig, "servo", &view);
	rig_points(rig, "laser", &points);
	printf("note: %s: %llu angles of %llu sent, %llu lost, %llu rows (%llu unknown), %llu points, %llu near, worst "
	       "%.3f m, angle %.3f / %.3f / %.3f deg\n",
	       robot_servo_name(servo), (unsigned long long)view.profiles, (unsigned long long)view.sent.sent,
	       (unsigned long long)view.lost_profiles, (unsigned long long)points.rows,
	       (unsigned long long)points.unknown_rows, (unsigned long long)points.points,
	       (unsigned long long)points.near, points.worst_m, points.angle_p50_deg, points.angle_p99_deg,
	       points.angle_worst_deg);
	if (view.state != SUPERVISOR_STREAMING)
		fail_msg("%s does not stream", robot_servo_name(servo));
	assert_true(points.unknown_rows == 0 && points.points > 0);
	assert_true(points.near * 1000 >= points.points * 999);
	rig_destroy(rig);
}

static void a_servo_on_any_bus_is_swept_and_its_points_lie_where_the_beams_ended(void **state)
{
	(void)state;
	for (int servo = 0; servo < ROBOT_SERVOS; servo++)
		swept_by_the_driver((enum robot_servo)servo);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_servo_on_any_bus_is_swept_and_its_points_lie_where_the_beams_ended),
	    cmocka_unit_test(a_scanner_streams_and_its_rows_lie_where_its_beams_ended),
	    cmocka_unit_test(a_line_that_is_pulled_out_is_lost_and_comes_back),
	    cmocka_unit_test(the_same_run_is_the_same_again),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

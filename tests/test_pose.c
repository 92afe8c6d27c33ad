/* Law L8: nothing that is sent to the pose socket can do more than move the map by a sane pose or be counted. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <arpa/inet.h>
#include <errno.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include "drivers/driver.h"
#include "drivers/pose_line.h"

#define T0 INT64_C(1732200000500000000)

static enum pose_line_verdict parse(const char *text, struct pose *ret)
{
	return pose_line_parse(text, strlen(text), T0, ret);
}

static void a_pose_line_is_read_with_its_time(void **state)
{
	struct pose pose;

	(void)state;
	assert_int_equal(
	    parse("{\"t\": 1732200000.25, \"position\": [1, -2.5, 0.125], \"orientation\": [0, 0, 0.6, 0.8]}", &pose),
	    POSE_LINE_OK);
	assert_int_equal(pose.t_ns, INT64_C(1732200000250000000));
	assert_true(pose.position_m.x == 1.0 && pose.position_m.y == -2.5 && pose.position_m.z == 0.125);
	assert_true(pose.rotation.z == 0.6 && pose.rotation.w == 0.8 && pose.rotation.x == 0.0 &&
	            pose.rotation.y == 0.0);
}

static void without_a_time_the_arrival_counts(void **state)
{
	struct pose pose;

	(void)state;
	assert_int_equal(parse("{\"position\": [0,0,0], \"orientation\": [0,0,0,1], \"frame\": \"map\"}\n", &pose),
	                 POSE_LINE_OK);
	assert_int_equal(pose.t_ns, T0);
}

static void a_quaternion_is_made_exactly_unit_or_refused(void **state)
{
	struct pose pose;
	double n;

	(void)state;
	assert_int_equal(parse("{\"position\": [0,0,0], \"orientation\": [0,0,0.7071,0.7071]}", &pose), POSE_LINE_OK);
	n = pose.rotation.z * pose.rotation.z + pose.rotation.w * pose.rotation.w;
	assert_true(n > 1.0 - 1e-14 && n < 1.0 + 1e-14);
	assert_int_equal(parse("{\"position\": [0,0,0], \"orientation\": [0,0,0,0]}", &pose), POSE_LINE_NOT_UNIT);
	assert_int_equal(parse("{\"position\": [0,0,0], \"orientation\": [0,0,0,1.01]}", &pose), POSE_LINE_NOT_UNIT);
	assert_int_equal(parse("{\"position\": [0,0,0], \"orientation\": [1e300,0,0,1e300]}", &pose),
	                 POSE_LINE_NOT_UNIT);
}

static void what_is_no_pose_is_refused_for_its_reason(void **state)
{
	static const struct {
		const char *text;
		enum pose_line_verdict verdict;
	} bad[] = {
	    {"", POSE_LINE_MALFORMED},
	    {"[]", POSE_LINE_MALFORMED},
	    {"{}", POSE_LINE_MALFORMED},
	    {"{\"position\": [0,0], \"orientation\": [0,0,0,1]}", POSE_LINE_MALFORMED},
	    {"{\"position\": [0,0,\"0\"], \"orientation\": [0,0,0,1]}", POSE_LINE_MALFORMED},
	    {"{\"position\": [0,0,0], \"orientation\": [0,0,0,1], \"t\": \"now\"}", POSE_LINE_MALFORMED},
	    {"{\"position\": [0,0,0], \"orientation\": [0,0,0,1]} {}", POSE_LINE_MALFORMED},
	    {"{\"position\": [0,0,0], \"position\": [0,0,0], \"orientation\": [0,0,0,1]}", POSE_LINE_MALFORMED},
	    {"{\"position\": [NaN,0,0], \"orientation\": [0,0,0,1]}", POSE_LINE_MALFORMED},
	    {"{\"position\": [0,0,1e999], \"orientation\": [0,0,0,1]}", POSE_LINE_MALFORMED},
	    {"{\"position\": [0,1e6,0], \"orientation\": [0,0,0,1]}", POSE_LINE_FAR},
	    {"{\"position\": [0,0,0], \"orientation\": [0,0,0,1], \"t\": 0}", POSE_LINE_TIME},
	    {"{\"position\": [0,0,0], \"orientation\": [0,0,0,1], \"t\": 1e300}", POSE_LINE_TIME},
	    {"{\"position\": [0,0,0], \"orientation\": [0,0,0,1], \"t\": 1732200001.75}", POSE_LINE_TIME},
	};
	struct pose pose = {.t_ns = 7};

	(void)state;
	for (size_t i = 0; i < sizeof bad / sizeof *bad; i++) {
		if (parse(bad[i].text, &pose) != bad[i].verdict)
			fail_msg("%s: %s", bad[i].text, pose_line_name(parse(bad[i].text, &pose)));
		assert_int_equal(pose.t_ns, 7); /* untouched */
	}
}

static void every_cut_of_a_line_is_refused(void **state)
{
	static const char line[] = "{\"t\": 1732200000.5, \"position\": [1, 2, 3], \"orientation\": [0, 0, 0, 1]}";
	struct pose pose;

	(void)state;
	for (size_t len = 0; len + 1 < sizeof line - 1; len++) {
		char *cut = malloc(len ? len : 1);

		memcpy(cut, line, len);
		assert_int_equal(pose_line_parse(cut, len, T0, &pose), POSE_LINE_MALFORMED);
		free(cut);
	}
}

static void a_long_or_deep_line_is_refused_before_it_costs_anything(void **state)
{
	char *text = malloc(POSE_LINE_MAX + 1);
	struct pose pose;

	(void)state;
	memset(text, '[', POSE_LINE_MAX + 1);
	assert_int_equal(pose_line_parse(text, POSE_LINE_MAX + 1, T0, &pose), POSE_LINE_LONG);
	assert_int_equal(pose_line_parse(text, POSE_LINE_MAX, T0, &pose), POSE_LINE_MALFORMED);
	free(text);
}

static void what_is_printed_is_read_back_to_the_bit(void **state)
{
	struct pose pose = {.t_ns = T0 + 1000, .position_m = {0.1, -1e-9, 12345.678}, .rotation = {.w = 0.8, .z = 0.6}},
	            back;
	char line[512];
	int n = pose_line_print(&pose, line, sizeof line);

	(void)state;
	assert_true(n > 0);
	assert_int_equal(pose_line_parse(line, (size_t)n, T0, &back), POSE_LINE_OK);
	assert_true(llabs(back.t_ns - pose.t_ns) < 300); /* a double of seconds */
	assert_memory_equal(&back.position_m, &pose.position_m, sizeof pose.position_m);
	assert_int_equal(pose_line_print(&pose, line, 20), -ENOSPC);
}

/* ---- the sockets ---- */

static char dir[64];

static int make_dir(void **state)
{
	(void)state;
	strcpy(dir, "/tmp/test_pose.XXXXXX");
	return mkdtemp(dir) ? 0 : -1;
}

static int remove_dir(void **state)
{
	char path[128];

	(void)state;
	snprintf(path, sizeof path, "%s/pose.sock", dir);
	unlink(path);
	return rmdir(dir);
}

static struct config_device device_at(const char *listen)
{
	struct config_device device = {.name = "pose", .driver = "pose"};

	snprintf(device.listen, sizeof device.listen, "%s", listen);
	return device;
}

static struct config_device device_in_dir(struct sockaddr_un *ret)
{
	char listen[96];

	snprintf(listen, sizeof listen, "unix:%s/pose.sock", dir);
	*ret = (struct sockaddr_un){.sun_family = AF_UNIX};
	strcpy(ret->sun_path, listen + 5);
	return device_at(listen);
}

static void a_datagram_arrives_whole_and_the_socket_is_the_groups(void **state)
{
	struct sockaddr_un address;
	struct config_device device = device_in_dir(&address);
	int fd = socket(AF_UNIX, SOCK_DGRAM, 0);
	char error[160] = "", buf[256];
	struct stat st;
	mode_t before = umask(077);
	struct link *link = driver_pose.link_open(&device, error);
	int64_t t_ns = 5;

	(void)state;
	umask(before);
	assert_non_null(link);
	assert_int_equal(stat(address.sun_path, &st), 0);
	assert_int_equal(st.st_mode & 0777, 0660);
	assert_int_equal(driver_pose.link_read(link, (uint8_t *)buf, sizeof buf, &t_ns), 0);
	assert_int_equal(sendto(fd, "", 0, 0, (struct sockaddr *)&address, sizeof address), 0);
	assert_int_equal(sendto(fd, "{}", 2, 0, (struct sockaddr *)&address, sizeof address), 2);
	assert_int_equal(driver_pose.link_read(link, (uint8_t *)buf, sizeof buf, &t_ns), 2);
	assert_memory_equal(buf, "{}", 2);
	driver_pose.link_close(link);
	assert_int_equal(access(address.sun_path, F_OK), -1);
	close(fd);
}

static void a_stale_socket_is_replaced_and_a_living_one_is_not(void **state)
{
	struct sockaddr_un address;
	struct config_device device = device_in_dir(&address);
	int fd = socket(AF_UNIX, SOCK_DGRAM, 0);
	char error[160] = "";
	struct link *link;

	(void)state;
	assert_int_equal(bind(fd, (struct sockaddr *)&address, sizeof address), 0);
	assert_null(driver_pose.link_open(&device, error));
	assert_non_null(strstr(error, "somebody listens there already"));
	close(fd);
	link = driver_pose.link_open(&device, error);
	assert_non_null(link);
	driver_pose.link_close(link);
}

static void a_file_that_is_no_socket_is_never_removed(void **state)
{
	struct sockaddr_un address;
	struct config_device device = device_in_dir(&address);
	char error[160] = "";
	FILE *file = fopen(address.sun_path, "w");

	(void)state;
	assert_non_null(file);
	fclose(file);
	assert_null(driver_pose.link_open(&device, error));
	assert_non_null(strstr(error, "no socket"));
	assert_int_equal(access(address.sun_path, F_OK), 0);
	unlink(address.sun_path);
}

static void udp_beyond_loopback_is_refused_with_a_sentence(void **state)
{
	static const char *const bad[] = {"udp:0.0.0.0:9000",
	                                  "udp:192.168.1.2:9000",
	                                  "udp:[::]:9000",
	                                  "udp:example.org:1",
	                                  "udp:127.0.0.1",
	                                  "udp:127.0.0.1:99999",
	                                  "udp:",
	                                  "tcp:127.0.0.1:5",
	                                  "unix:"};

	(void)state;
	for (size_t i = 0; i < sizeof bad / sizeof *bad; i++) {
		struct config_device device = device_at(bad[i]);
		char error[160] = "";

		assert_null(driver_pose.link_open(&device, error));
		assert_true(strlen(error) > 10);
	}
}

static void udp_on_loopback_carries_poses(void **state)
{
	struct sockaddr_in from = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
	socklen_t len = sizeof from;
	int probe = socket(AF_INET, SOCK_DGRAM, 0), fd = socket(AF_INET, SOCK_DGRAM, 0);
	char error[160] = "", listen[64];
	struct config_device device;
	struct link *link;
	struct pollfd p;
	uint8_t buf[64];
	int64_t t_ns = 0;

	(void)state;
	assert_int_equal(bind(probe, (struct sockaddr *)&from, sizeof from), 0);
	assert_int_equal(getsockname(probe, (struct sockaddr *)&from, &len), 0);
	close(probe);
	snprintf(listen, sizeof listen, "udp:localhost:%d", ntohs(from.sin_port));
	device = device_at(listen);
	link = driver_pose.link_open(&device, error);
	assert_non_null(link);
	assert_int_equal(sendto(fd, "{}", 2, 0, (struct sockaddr *)&from, sizeof from), 2);
	p = (struct pollfd){.fd = driver_pose.link_fd(link), .events = POLLIN};
	assert_int_equal(poll(&p, 1, 5000), 1);
	assert_int_equal(driver_pose.link_read(link, buf, sizeof buf, &t_ns), 2);
	driver_pose.link_close(link);
	close(fd);
}

static void a_path_too_long_for_a_socket_is_refused_not_cut(void **state)
{
	struct config_device device = {.name = "pose"};
	char error[160] = "";

	(void)state;
	memset(device.listen, 'a', 5 + 108);
	memcpy(device.listen, "unix:", 5);
	assert_null(driver_pose.link_open(&device, error));
	assert_non_null(strstr(error, "108"));
}

static void a_fixed_pose_needs_no_descriptor(void **state)
{
	struct config_device device = {.name = "pose", .fixed = true};
	char error[160];
	struct link *link = driver_pose.link_open(&device, error);

	(void)state;
	assert_non_null(link);
	assert_int_equal(driver_pose.link_fd(link), -1);
	driver_pose.link_close(link);
}

static void take_pose(void *ctx, int device, const struct pose *pose)
{
	(void)device;
	*(struct pose *)ctx = *pose;
}

static void verdicts_are_counted_by_reason(void **state)
{
	static const char good[] = "{\"position\": [4,0,0], \"orientation\": [0,0,0,1]}", bad[] = "{";
	struct config_device device = {.name = "pose"};
	struct decoder *decoder = driver_pose.decoder_create(&device, 3);
	struct pose pose = {0};
	struct record_sink sink = {.ctx = &pose, .pose = take_pose};
	struct record record = {.t_ns = T0, .bytes = (const uint8_t *)good, .len = sizeof good - 1};
	struct decoder_counters counters;

	(void)state;
	driver_pose.decode(decoder, &record, &sink);
	record.bytes = (const uint8_t *)bad;
	record.len = 1;
	driver_pose.decode(decoder, &record, &sink);
	driver_pose.counters(decoder, &counters);
	assert_true(pose.position_m.x == 4.0);
	assert_int_equal(counters.counter[POSE_LINE_OK].count, 1);
	assert_int_equal(counters.counter[POSE_LINE_MALFORMED].count, 1);
	driver_pose.decoder_destroy(decoder);
}

/* The pose that a line of this time gives, which arrives at T0; 0: it is refused. */
static int64_t dated(struct decoder *decoder, const char *t)
{
	struct pose pose = {0};
	struct record_sink sink = {.ctx = &pose, .pose = take_pose};
	char line[128];
	int n = snprintf(line, sizeof line, "{%s\"position\": [4,0,0], \"orientation\": [0,0,0,1]}", t);
	struct record record = {.t_ns = T0, .bytes = (const uint8_t *)line, .len = (size_t)n};

	driver_pose.decode(decoder, &record, &sink);
	return pose.t_ns;
}

static void times_follow_the_wall_clock_when_it_is_set(void **state)
{
	struct config_device device = {.name = "pose"};
	struct decoder *decoder = driver_pose.decoder_create(&device, 3);
	struct decoder_counters counters;

	(void)state;
	assert_int_equal(dated(decoder, "\"t\": 1732200000.25, "), T0 - 250000000);
	assert_int_equal(dated(decoder, "\"t\": 1732203600.25, "), 0);
	driver_pose.clock(decoder, INT64_C(3600000000000)); /* an hour forward */
	assert_int_equal(dated(decoder, "\"t\": 1732203600.25, "), T0 - 250000000);
	assert_int_equal(dated(decoder, "\"t\": 1732200000.25, "), 0);
	assert_int_equal(dated(decoder, ""), T0);        /* the arrival has nothing to do with it */
	driver_pose.clock(decoder, -INT64_C(500000000)); /* and back beyond the first */
	assert_int_equal(dated(decoder, "\"t\": 1732199999.75, "), T0 - 250000000);
	driver_pose.clock(decoder, 0);
	assert_int_equal(dated(decoder, "\"t\": 1732200000.25, "), T0 - 250000000);
	driver_pose.counters(decoder, &counters);
	assert_int_equal(counters.counter[POSE_LINE_OK].count, 5);
	assert_int_equal(counters.counter[POSE_LINE_TIME].count, 2);
	driver_pose.decoder_destroy(decoder);
}

static void dated_poses_tell_the_jitter_and_others_do_not(void **state)
{
	struct config_device device = {.name = "pose"};
	struct decoder *decoder = driver_pose.decoder_create(&device, 3);
	struct decoder_timing timing;

	(void)state;
	dated(decoder, "");
	driver_pose.timing(decoder, &timing);
	assert_false(timing.known);
	for (int i = 0; i < 99; i++)
		dated(decoder, "\"t\": 1732200000.490, ");
	dated(decoder, "\"t\": 1732200000.460, ");
	driver_pose.timing(decoder, &timing);
	assert_true(timing.known && timing.expected_hz == 0);
	assert_in_range(timing.jitter_p50_ns, 0, 1000);
	assert_in_range(timing.jitter_p99_ns, 29999000, 30001000);
	driver_pose.decoder_destroy(decoder);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_pose_line_is_read_with_its_time),
	    cmocka_unit_test(without_a_time_the_arrival_counts),
	    cmocka_unit_test(a_quaternion_is_made_exactly_unit_or_refused),
	    cmocka_unit_test(what_is_no_pose_is_refused_for_its_reason),
	    cmocka_unit_test(every_cut_of_a_line_is_refused),
	    cmocka_unit_test(a_long_or_deep_line_is_refused_before_it_costs_anything),
	    cmocka_unit_test(what_is_printed_is_read_back_to_the_bit),
	    cmocka_unit_test(a_datagram_arrives_whole_and_the_socket_is_the_groups),
	    cmocka_unit_test(a_stale_socket_is_replaced_and_a_living_one_is_not),
	    cmocka_unit_test(a_file_that_is_no_socket_is_never_removed),
	    cmocka_unit_test(udp_beyond_loopback_is_refused_with_a_sentence),
	    cmocka_unit_test(udp_on_loopback_carries_poses),
	    cmocka_unit_test(a_path_too_long_for_a_socket_is_refused_not_cut),
	    cmocka_unit_test(a_fixed_pose_needs_no_descriptor),
	    cmocka_unit_test(verdicts_are_counted_by_reason),
	    cmocka_unit_test(times_follow_the_wall_clock_when_it_is_set),
	    cmocka_unit_test(dated_poses_tell_the_jitter_and_others_do_not),
	};

	return cmocka_run_group_tests(tests, make_dir, remove_dir);
}

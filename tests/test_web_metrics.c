/* Law: /metrics says of recordings and replays what the status says, and nothing of what there is not. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>
#include <string.h>

#include "daemon/web_metrics.h"

static struct control_status status;
static struct buffer text;

static int begin(void **state)
{
	(void)state;
	memset(&status, 0, sizeof(status));
	status.replay_error = status.replay_note = "";
	return 0;
}

static int end(void **state)
{
	(void)state;
	buffer_finish(&text);
	return 0;
}

static void put(void)
{
	struct publisher_stats map = {0};

	buffer_finish(&text);
	web_metrics_put(&text, &status, &map);
	buffer_append(&text, "", 1);
	assert_int_equal(text.error, 0);
}

/* A whole line. */
static bool says(const char *line)
{
	const char *at = strstr((const char *)text.data, line);

	return at && (at == (const char *)text.data || at[-1] == '\n') && at[strlen(line)] == '\n';
}

static void a_recording_has_one_state_at_a_time(void **state)
{
	(void)state;
	put();
	assert_true(says("facetd_recording{state=\"off\"} 1"));
	assert_true(says("facetd_recording{state=\"waiting\"} 0"));
	assert_true(says("facetd_recording{state=\"recording\"} 0"));
	status.record.enabled = true; /* and the disk is full */
	put();
	assert_true(says("facetd_recording{state=\"off\"} 0"));
	assert_true(says("facetd_recording{state=\"waiting\"} 1"));
	status.record.recording = true;
	put();
	assert_true(says("facetd_recording{state=\"waiting\"} 0"));
	assert_true(says("facetd_recording{state=\"recording\"} 1"));
}

static void a_recording_is_told_in_bytes_files_and_losses(void **state)
{
	(void)state;
	status.record = (struct recorder_status){.bytes = 12345678901,
	                                         .messages = 17,
	                                         .files = 3,
	                                         .gaps = 2,
	                                         .dropped = 41,
	                                         .queued = 1000,
	                                         .queued_peak = 2000};
	status.streams = 1;
	put();
	assert_true(says("facetd_recording_file_bytes 12345678901"));
	assert_true(says("facetd_recording_file_messages 17"));
	assert_true(says("facetd_recording_files_total 3"));
	assert_true(says("facetd_recording_gaps_total 2"));
	assert_true(says("facetd_recording_dropped_total 41"));
	assert_true(says("facetd_recording_queued_bytes 1000"));
	assert_true(says("facetd_recording_queued_bytes_peak 2000"));
	assert_true(says("facetd_recording_streams 1"));
}

static void a_replay_is_told_with_place_pace_and_state(void **state)
{
	(void)state;
	status.replays = true;
	status.batches = 5;
	status.replay = (struct player_status){.state = PLAYER_PAUSED,
	                                       .begin_ns = 1000000000000,
	                                       .now_ns = 1002500000000,
	                                       .end_ns = 1060000000000,
	                                       .speed = 2.5,
	                                       .seeks = 4};
	put();
	assert_true(says("facetd_replay{state=\"paused\"} 1"));
	assert_true(says("facetd_replay{state=\"playing\"} 0"));
	assert_true(says("facetd_replay{state=\"seeking\"} 0"));
	assert_true(says("facetd_replay{state=\"ended\"} 0"));
	assert_true(says("facetd_replay_position_seconds 2.5"));
	assert_true(says("facetd_replay_length_seconds 60"));
	assert_true(says("facetd_replay_speed_ratio 2.5"));
	assert_true(says("facetd_replay_seeks_total 4"));
	assert_true(says("facetd_replay_failed 0"));
	assert_true(says("facetd_batches_total 5"));
	status.replay.speed = 0;
	status.replay_error = "cut short";
	put();
	assert_true(says("facetd_replay_speed_ratio +Inf"));
	assert_true(says("facetd_replay_failed 1"));
}

static void what_is_live_has_no_figures_of_a_replay(void **state)
{
	(void)state;
	put();
	assert_null(strstr((const char *)text.data, "facetd_replay"));
}

int main(void)
{
#define TEST(name) cmocka_unit_test_setup_teardown(name, begin, end)
	const struct CMUnitTest tests[] = {
	    TEST(a_recording_has_one_state_at_a_time),
	    TEST(a_recording_is_told_in_bytes_files_and_losses),
	    TEST(a_replay_is_told_with_place_pace_and_state),
	    TEST(what_is_live_has_no_figures_of_a_replay),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

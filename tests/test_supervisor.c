/* Law: every device is kept alive by itself. A lost one comes back with bounded back-off, its transitions are told once,
 * none can stall another, what is written is recorded, and an orderly end takes at most a second. All in virtual time. */
#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "daemon/supervisor.h"

#define MS      1000000ll
#define SECOND  1000000000ll
#define DEVICES 3

/* A device of the test: it greets with "hi", must be answered "go", and then sends "d" for data. */
struct link {
	int device;
};

struct dialogue {
	int device;
	enum { GREETING, ASKED, LIVE, ENDING, ENDED, GIVEN_UP } phase;
	int64_t deadline_ns;
};

static struct world {
	bool absent, dead_read, dead_write, full, endless, never_ends, asks_without_end, begins_anew;
	int read_error;   /* errno that a read fails with, 0: none */
	size_t at_once;   /* a read delivers so many of its first byte */
	char pending[64]; /* what the device has to say */
	char heard[64];   /* what it was told */
	char note[160];   /* of the dialogue, while it streams */
	int opens, closes, bauds, flushes, resets;
	uint32_t baud;
	struct dialogue *dialogue;
} world[DEVICES];

static struct log_line {
	int device;
	char text[200];
} log_lines[100];
static int logs;
static struct supervisor *supervisor;
static char records[2000];
static int watched[DEVICES];
static bool watched_readable[DEVICES], watched_writable[DEVICES];

static struct link *fake_open(const struct config_device *config, char error[160])
{
	int device = config->line;
	struct link *link;

	world[device].opens++;
	if (world[device].absent) {
		snprintf(error, 160, "/dev/fake%d is not there; plug it in", device);
		return NULL;
	}
	link = calloc(1, sizeof(*link));
	link->device = device;
	return link;
}

static int fake_fd(const struct link *link)
{
	return 100 + link->device;
}

static ssize_t fake_read(struct link *link, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	struct world *w = &world[link->device];
	size_t n = strlen(w->pending);

	(void)t_ns;
	if (w->dead_read)
		return -EIO;
	if (w->read_error)
		return -w->read_error;
	if (w->at_once) {
		assert_true(w->at_once <= cap);
		memset(buf, w->pending[0], w->at_once);
		return (ssize_t)w->at_once;
	}
	memcpy(buf, w->pending, n);
	if (!w->endless)
		w->pending[0] = 0;
	return (ssize_t)n;
}

static ssize_t fake_write(struct link *link, const uint8_t *bytes, size_t len)
{
	struct world *w = &world[link->device];

	if (w->dead_write)
		return -EIO;
	if (w->full)
		return 0;
	assert_true(len > 0);
	strncat(w->heard, (const char *)bytes, 1); /* a byte at a time */
	return 1;
}

static int fake_baud(struct link *link, uint32_t baud, char error[160])
{
	world[link->device].bauds++;
	world[link->device].baud = baud;
	if (baud == 12345) {
		snprintf(error, 160, "the line refuses 12345 Bd");
		return -EINVAL;
	}
	return 0;
}

static void fake_flush(struct link *link)
{
	world[link->device].flushes++;
}

static void fake_close(struct link *link)
{
	world[link->device].closes++;
	free(link);
}

static struct dialogue *fake_dialogue(const struct config *config, int device)
{
	struct dialogue *dialogue = calloc(1, sizeof(*dialogue));

	(void)config;
	dialogue->device = device;
	world[device].dialogue = dialogue;
	return dialogue;
}

static void fake_dialogue_destroy(struct dialogue *dialogue)
{
	free(dialogue);
}

static void fake_reset(struct dialogue *dialogue, int64_t t_ns)
{
	world[dialogue->device].resets++;
	dialogue->phase = GREETING;
	dialogue->deadline_ns = t_ns + SECOND;
}

static void fake_reply(struct dialogue *dialogue, const struct reply *reply)
{
	if (reply->kind == 'h' && dialogue->phase == GREETING)
		dialogue->phase = ASKED;
}

static void fake_data(struct dialogue *dialogue, int64_t t_ns)
{
	dialogue->deadline_ns = t_ns + SECOND;
}

static void fake_step(struct dialogue *dialogue, int64_t t_ns, struct dialogue_step *ret)
{
	ret->state = dialogue->phase >= LIVE ? DIALOGUE_STREAMING : DIALOGUE_CONFIGURING;
	if (ret->state == DIALOGUE_STREAMING)
		memcpy(ret->error, world[dialogue->device].note, sizeof(ret->error));
	if (world[dialogue->device].asks_without_end) {
		ret->flush = true;
		ret->deadline_ns = t_ns;
		return;
	}
	if (world[dialogue->device].begins_anew) {
		world[dialogue->device].begins_anew = false;
		dialogue->phase = GREETING;
		dialogue->deadline_ns = t_ns + SECOND;
		ret->state = DIALOGUE_CONFIGURING;
		snprintf(ret->error, sizeof(ret->error), "it was switched off and on");
	}
	if (dialogue->phase == ENDING) {
		ret->deadline_ns = INT64_MAX;
		if (!world[dialogue->device].never_ends)
			ret->state = DIALOGUE_FAILED;
		return;
	}
	if (t_ns >= dialogue->deadline_ns) {
		ret->state = DIALOGUE_FAILED;
		snprintf(ret->error, sizeof(ret->error), "it says nothing; check its plug");
		return;
	}
	if (dialogue->phase == ASKED) {
		memcpy(ret->write, "go", 2);
		ret->write_len = 2;
		ret->baud = 38400;
		ret->flush = true;
		dialogue->phase = LIVE;
	}
	ret->deadline_ns = dialogue->deadline_ns;
}

static void fake_stop(struct dialogue *dialogue, int64_t t_ns)
{
	(void)t_ns;
	dialogue->phase = ENDING;
}

static const struct driver fake = {.name = "fake",
                                   .dialogue_create = fake_dialogue,
                                   .dialogue_destroy = fake_dialogue_destroy,
                                   .dialogue_reset = fake_reset,
                                   .dialogue_reply = fake_reply,
                                   .dialogue_data = fake_data,
                                   .dialogue_step = fake_step,
                                   .dialogue_stop = fake_stop,
                                   .link_open = fake_open,
                                   .link_fd = fake_fd,
                                   .link_read = fake_read,
                                   .link_write = fake_write,
                                   .link_baud = fake_baud,
                                   .link_flush = fake_flush,
                                   .link_close = fake_close};
static const struct driver silent = {.name = "silent",
                                     .link_open = fake_open,
                                     .link_fd = fake_fd,
                                     .link_read = fake_read,
                                     .link_write = fake_write,
                                     .link_close = fake_close};
static const struct driver linkless = {.name = "linkless"};

/* The host: what a pipeline does with the bytes. */
static void host_watch(void *ctx, int device, int fd, bool readable, bool writable)
{
	(void)ctx;
	watched[device] = fd;
	watched_readable[device] = readable;
	watched_writable[device] = writable;
}

static void host_record(void *ctx, const struct record *record)
{
	struct reply reply = {.t_ns = record->t_ns};
	char text[80];

	(void)ctx;
	snprintf(text, sizeof(text), "%d%c%.*s ", record->device,
	         record->direction == LINK_OPENED ? '='
	         : record->direction == TO_DEVICE ? '<'
	                                          : '>',
	         (int)record->len, (const char *)record->bytes);
	if (strlen(records) + strlen(text) < sizeof(records))
		strcat(records, text);
	if (record->direction != FROM_DEVICE)
		return;
	reply.kind = record->bytes[0];
	if (reply.kind == '?')
		return; /* no telegram */
	if (record->bytes[0] == 'd')
		supervisor_data(supervisor, record->device, record->log_ns);
	else
		supervisor_reply(supervisor, record->device, &reply);
}

static void host_log(void *ctx, int device, int priority, const char *text)
{
	(void)ctx;
	(void)priority;
	assert_true(logs < 100);
	log_lines[logs].device = device;
	snprintf(log_lines[logs++].text, sizeof(log_lines[0].text), "%s", text);
}

static struct config config;

static void start(const struct driver *a, const struct driver *b, const struct driver *c)
{
	const struct driver *drivers[DEVICES] = {a, b, c};
	struct supervisor_host host = {NULL, host_watch, host_record, host_log};

	memset(&config, 0, sizeof(config));
	for (int i = 0; i < DEVICES && drivers[i]; i++, config.devices++)
		config.device[i].line = i;
	logs = 0;
	records[0] = 0;
	memset(watched, 0xff, sizeof(watched));
	supervisor = supervisor_create(&config, drivers, &host);
	assert_non_null(supervisor);
}

static void begin(const struct driver *a, const struct driver *b, const struct driver *c)
{
	memset(world, 0, sizeof(world));
	start(a, b, c);
	supervisor_start(supervisor, 0);
}

static void end(void)
{
	supervisor_destroy(supervisor);
	for (int i = 0; i < DEVICES; i++)
		assert_int_equal(watched[i], -1);
}

static void say(int device, const char *text, int64_t t_ns)
{
	snprintf(world[device].pending, sizeof(world[device].pending), "%s", text);
	supervisor_ready(supervisor, device, true, false, t_ns);
}

static void expect_state(int device, enum supervisor_state state)
{
	assert_string_equal(supervisor_state_name(supervisor_device(supervisor, device)->state),
	                    supervisor_state_name(state));
}

static void a_device_is_configured_then_streams(void **state)
{
	(void)state;
	begin(&fake, NULL, NULL);
	expect_state(0, SUPERVISOR_CONFIGURING);
	assert_int_equal(watched[0], 100);
	assert_int_equal(supervisor_deadline(supervisor), SECOND);
	say(0, "hi", 10 * MS);
	while (watched_writable[0])
		supervisor_ready(supervisor, 0, false, true, 11 * MS);
	expect_state(0, SUPERVISOR_STREAMING);
	assert_string_equal(world[0].heard, "go");
	assert_int_equal(world[0].baud, 38400);
	assert_int_equal(world[0].flushes, 1);
	assert_string_equal(records, "0= 0>hi 0<g 0<o ");
	assert_int_equal(logs, 1);
	assert_string_equal(log_lines[0].text, "streaming");
	say(0, "d", 900 * MS);
	assert_int_equal(supervisor_device(supervisor, 0)->decoded, 1);
	assert_int_equal(supervisor_deadline(supervisor), 1900 * MS);
	end();
	assert_int_equal(world[0].closes, 1);
}

static void the_rate_is_set_only_after_every_byte_is_written(void **state)
{
	(void)state;
	begin(&fake, NULL, NULL);
	world[0].full = true;
	say(0, "hi", 10 * MS);
	assert_true(watched_writable[0]);
	assert_int_equal(world[0].bauds, 0);
	world[0].full = false;
	supervisor_ready(supervisor, 0, false, true, 20 * MS);
	while (watched_writable[0])
		supervisor_ready(supervisor, 0, false, true, 20 * MS);
	assert_int_equal(world[0].bauds, 1);
	assert_string_equal(world[0].heard, "go");
	end();
}

static void a_device_that_takes_no_bytes_is_lost_after_a_while(void **state)
{
	(void)state;
	begin(&fake, NULL, NULL);
	say(0, "hi", 0); /* it takes a byte of two */
	world[0].full = true;
	assert_int_equal(supervisor_deadline(supervisor), 2 * SECOND);
	supervisor_timer(supervisor, 1900 * MS);
	assert_int_equal(world[0].closes, 0);
	supervisor_timer(supervisor, 2 * SECOND);
	expect_state(0, SUPERVISOR_BACKING_OFF);
	assert_int_equal(world[0].closes, 1);
	end();
}

static void an_absent_device_is_tried_again_ever_more_slowly_and_told_once(void **state)
{
	static const int64_t pause[] = {250, 500, 1000, 1000, 1000, 1000};
	int64_t t_ns = 0;

	(void)state;
	memset(world, 0, sizeof(world));
	world[0].absent = true;
	start(&fake, NULL, NULL);
	supervisor_start(supervisor, 0);
	for (int i = 0; i < 6; i++) {
		expect_state(0, SUPERVISOR_BACKING_OFF);
		assert_int_equal(supervisor_deadline(supervisor), t_ns + pause[i] * MS);
		t_ns = supervisor_deadline(supervisor);
		supervisor_timer(supervisor, t_ns);
	}
	assert_int_equal(world[0].opens, 7);
	assert_int_equal(logs, 1);
	assert_non_null(strstr(log_lines[0].text, "/dev/fake0"));
	world[0].absent = false;
	supervisor_timer(supervisor, supervisor_deadline(supervisor));
	expect_state(0, SUPERVISOR_CONFIGURING);
	end();
}

static void a_lost_device_comes_back_and_both_are_told(void **state)
{
	(void)state;
	begin(&silent, NULL, NULL);
	expect_state(0, SUPERVISOR_STREAMING);
	for (int round = 0; round < 3; round++) {
		int64_t t_ns = (10 + 10 * round) * SECOND;

		world[0].dead_read = true;
		supervisor_ready(supervisor, 0, true, false, t_ns);
		expect_state(0, SUPERVISOR_BACKING_OFF);
		assert_int_equal(watched[0], -1);
		world[0].dead_read = false;
		/* It had streamed steadily: the back-off begins with its first again. */
		assert_int_equal(supervisor_deadline(supervisor), t_ns + 250 * MS);
		supervisor_timer(supervisor, t_ns + 250 * MS);
		expect_state(0, SUPERVISOR_STREAMING);
	}
	assert_int_equal(logs, 7);
	assert_int_equal(supervisor_device(supervisor, 0)->losses, 3);
	end();
}

static void a_device_that_fails_right_after_it_streams_backs_off_further(void **state)
{
	int64_t t_ns = 0;

	(void)state;
	begin(&silent, NULL, NULL);
	world[0].dead_read = true;
	for (int i = 0; i < 5; i++) {
		supervisor_ready(supervisor, 0, true, false, t_ns);
		t_ns = supervisor_deadline(supervisor);
		supervisor_timer(supervisor, t_ns);
	}
	assert_int_equal(t_ns, (250 + 500 + 1000 + 1000 + 1000) * MS);
	end();
}

static void a_silent_device_is_given_up_with_its_sentence(void **state)
{
	(void)state;
	begin(&fake, NULL, NULL);
	supervisor_timer(supervisor, SECOND);
	expect_state(0, SUPERVISOR_BACKING_OFF);
	assert_string_equal(supervisor_device(supervisor, 0)->error, "it says nothing; check its plug");
	assert_int_equal(logs, 1);
	supervisor_timer(supervisor, supervisor_deadline(supervisor));
	assert_int_equal(world[0].resets, 2);
	end();
}

static void a_host_that_slept_hears_what_came_meanwhile_before_it_judges(void **state)
{
	(void)state;
	begin(&fake, NULL, NULL);
	say(0, "hi", 10 * MS);
	while (watched_writable[0])
		supervisor_ready(supervisor, 0, false, true, 11 * MS);
	expect_state(0, SUPERVISOR_STREAMING);
	strcpy(world[0].pending, "d");
	supervisor_timer(supervisor, 5 * SECOND); /* the loop calls timers before it looks at descriptors */
	expect_state(0, SUPERVISOR_STREAMING);
	assert_int_equal(supervisor_device(supervisor, 0)->decoded, 1);
	supervisor_timer(supervisor, 6 * SECOND);
	expect_state(0, SUPERVISOR_BACKING_OFF);
	end();
}

static void a_failed_write_loses_the_device(void **state)
{
	(void)state;
	begin(&fake, NULL, NULL);
	world[0].dead_write = true;
	say(0, "hi", 10 * MS);
	expect_state(0, SUPERVISOR_BACKING_OFF);
	assert_non_null(strstr(supervisor_device(supervisor, 0)->error, "writing"));
	end();
}

static void no_device_stalls_another(void **state)
{
	(void)state;
	begin(&silent, &fake, &silent);
	world[0].endless = true;
	world[1].asks_without_end = true;
	say(0, "d", 10 * MS);
	assert_int_equal(supervisor_device(supervisor, 0)->records, SUPERVISOR_READS_MAX);
	supervisor_ready(supervisor, 1, true, false, 10 * MS);
	assert_true(world[1].flushes > 0 && world[1].flushes < 200);
	assert_true(supervisor_deadline(supervisor) > 10 * MS);
	say(2, "d", 10 * MS);
	assert_int_equal(supervisor_device(supervisor, 2)->decoded, 1);
	end();
}

static void a_device_without_a_link_just_streams(void **state)
{
	(void)state;
	begin(&linkless, NULL, NULL);
	expect_state(0, SUPERVISOR_STREAMING);
	assert_true(supervisor_deadline(supervisor) == INT64_MAX);
	supervisor_stop(supervisor, 5);
	assert_true(supervisor_stopped(supervisor));
	end();
}

static void an_orderly_end_asks_every_device_and_waits_at_most_a_second(void **state)
{
	(void)state;
	begin(&fake, &fake, &silent);
	world[1].never_ends = true;
	supervisor_stop(supervisor, 5 * MS);
	expect_state(0, SUPERVISOR_CLOSED);
	expect_state(2, SUPERVISOR_CLOSED);
	assert_false(supervisor_stopped(supervisor));
	assert_int_equal(supervisor_deadline(supervisor), 5 * MS + SECOND);
	supervisor_timer(supervisor, 5 * MS + SECOND);
	assert_true(supervisor_stopped(supervisor));
	assert_true(supervisor_deadline(supervisor) == INT64_MAX);
	end();
}

static void a_servo_has_the_time_to_go_to_its_rest_angle(void **state)
{
	(void)state;
	begin(&fake, NULL, NULL);
	config.sweep.set = config.sweep.has_rest = true;
	world[0].never_ends = true;
	say(0, "h", 1);
	supervisor_stop(supervisor, 5 * MS);
	supervisor_timer(supervisor, 5 * MS + SUPERVISOR_REST_NS - 1);
	assert_false(supervisor_stopped(supervisor));
	supervisor_timer(supervisor, supervisor_deadline(supervisor));
	assert_true(supervisor_stopped(supervisor));
	end();
}

/* Cut off in the middle of its `stop`, a drive would be left enabled. */
static void a_drive_has_the_time_to_be_switched_off(void **state)
{
	(void)state;
	begin(&fake, NULL, NULL);
	config.device[0].stop.n = 2;
	world[0].never_ends = true;
	say(0, "h", 1);
	supervisor_stop(supervisor, 5 * MS);
	supervisor_timer(supervisor, 5 * MS + SUPERVISOR_REST_NS - 1);
	assert_false(supervisor_stopped(supervisor));
	supervisor_timer(supervisor, supervisor_deadline(supervisor));
	assert_true(supervisor_stopped(supervisor));
	end();
}

static void a_device_that_backs_off_ends_at_once(void **state)
{
	(void)state;
	memset(world, 0, sizeof(world));
	world[0].absent = true;
	start(&fake, NULL, NULL);
	supervisor_start(supervisor, 0);
	supervisor_stop(supervisor, 1);
	assert_true(supervisor_stopped(supervisor));
	supervisor_timer(supervisor, 10 * SECOND);
	assert_int_equal(world[0].opens, 1);
	end();
}

static void greet(int64_t t_ns)
{
	say(0, "hi", t_ns);
	while (watched_writable[0])
		supervisor_ready(supervisor, 0, false, true, t_ns);
}

/* What comes after an opening must not be joined to what came before it: decoders are told, before anything is written. */
static void every_opening_is_recorded_before_the_first_write(void **state)
{
	(void)state;
	begin(&fake, NULL, NULL);
	greet(10 * MS);
	world[0].dead_read = true;
	say(0, "d", 20 * MS);
	world[0].dead_read = false;
	world[0].pending[0] = 0;
	supervisor_timer(supervisor, supervisor_deadline(supervisor));
	greet(500 * MS);
	assert_string_equal(records, "0= 0>hi 0<g 0<o 0= 0>hi 0<g 0<o ");
	end();
	begin(&linkless, NULL, NULL);
	assert_string_equal(records, "");
	end();
}

/* Whenever it comes back: it is opened within a second of that, and its first request goes out with the opening. */
static void a_device_that_is_back_is_opened_within_a_second(void **state)
{
	(void)state;
	for (int64_t back_ns = 10 * SECOND; back_ns < 12 * SECOND; back_ns += 70 * MS) {
		int opens;

		memset(world, 0, sizeof(world));
		world[0].absent = true;
		start(&fake, NULL, NULL);
		supervisor_start(supervisor, 0);
		while (supervisor_deadline(supervisor) < back_ns)
			supervisor_timer(supervisor, supervisor_deadline(supervisor));
		world[0].absent = false;
		opens = world[0].opens;
		assert_true(supervisor_deadline(supervisor) - back_ns <= SECOND);
		supervisor_timer(supervisor, supervisor_deadline(supervisor));
		assert_int_equal(world[0].opens, opens + 1);
		expect_state(0, SUPERVISOR_CONFIGURING);
		end();
	}
}

/* A connection that neither stands nor fails: the next try is begun soon enough for somebody who came meanwhile. */
static void an_opening_that_hangs_is_given_up_after_a_second_and_a_half(void **state)
{
	(void)state;
	begin(&fake, NULL, NULL);
	world[0].full = true;
	world[0].dialogue->phase = ASKED;
	supervisor_ready(supervisor, 0, true, false, 0);
	assert_int_equal(supervisor_deadline(supervisor), SUPERVISOR_OPEN_NS);
	supervisor_timer(supervisor, SUPERVISOR_OPEN_NS);
	expect_state(0, SUPERVISOR_BACKING_OFF);
	assert_non_null(strstr(supervisor_device(supervisor, 0)->error, "switched on"));
	assert_int_equal(supervisor_deadline(supervisor), SUPERVISOR_OPEN_NS); /* it has waited enough */
	end();
}

/* Sends without pause what makes telegrams: it costs its budget and no more, and stays. */
static void a_device_at_full_rate_is_read_within_its_budget(void **state)
{
	const int64_t seconds = 10;
	uint64_t bytes;

	(void)state;
	begin(&silent, &silent, NULL);
	strcpy(world[0].pending, "d");
	world[0].at_once = 4096;
	strcpy(world[1].pending, "d");
	world[1].endless = true;
	for (int64_t t_ns = 0; t_ns < seconds * SECOND; t_ns += MS) {
		if (supervisor_deadline(supervisor) <= t_ns)
			supervisor_timer(supervisor, t_ns);
		if (watched_readable[0])
			supervisor_ready(supervisor, 0, true, false, t_ns);
		assert_true(watched_readable[1]);
		supervisor_ready(supervisor, 1, true, false, t_ns);
	}
	bytes = supervisor_device(supervisor, 0)->bytes_in;
	assert_true(bytes <= SUPERVISOR_BURST_BYTES + 4096 + seconds * SUPERVISOR_BYTES_PER_S);
	assert_true(bytes >= (uint64_t)seconds * SUPERVISOR_BYTES_PER_S * 9 / 10);
	assert_int_equal(supervisor_device(supervisor, 1)->decoded, seconds * 1000 * SUPERVISOR_READS_MAX);
	assert_int_equal(supervisor_device(supervisor, 0)->losses, 0);
	assert_int_equal(logs, 2);
	end();
}

/* Sends without pause what makes none: it is lost again and again, told once, and costs little. */
static void a_device_of_another_kind_is_lost_with_a_sentence_and_few_lines(void **state)
{
	const int64_t seconds = 60;

	(void)state;
	begin(&silent, NULL, NULL);
	strcpy(world[0].pending, "?");
	world[0].at_once = 4096;
	for (int64_t t_ns = 0; t_ns < seconds * SECOND; t_ns += MS) {
		if (supervisor_deadline(supervisor) <= t_ns)
			supervisor_timer(supervisor, t_ns);
		if (watched[0] >= 0 && watched_readable[0])
			supervisor_ready(supervisor, 0, true, false, t_ns);
	}
	assert_int_equal(logs, 6);
	assert_string_equal(log_lines[0].text, "streaming");
	assert_string_equal(log_lines[1].text,
	                    "lost: it sends what is no telegram of driver silent; is it another device?; trying again");
	assert_true(supervisor_device(supervisor, 0)->losses >= (uint64_t)seconds - 2);
	assert_true(supervisor_device(supervisor, 0)->bytes_in <=
	            (uint64_t)(seconds + 4) * (SUPERVISOR_NOISE_BYTES + 4096));
	world[0].at_once = 0;
	strcpy(world[0].pending, "d");
	supervisor_timer(supervisor, seconds * SECOND + SECOND);
	expect_state(0, SUPERVISOR_STREAMING);
	assert_int_equal(logs, 6); /* it must last first */
	assert_int_equal(supervisor_deadline(supervisor),
	                 supervisor_device(supervisor, 0)->since_ns + SUPERVISOR_STEADY_NS);
	supervisor_timer(supervisor, supervisor_deadline(supervisor));
	assert_int_equal(logs, 7);
	assert_string_equal(log_lines[6].text, "streaming");
	end();
}

/* Sentences with a figure in them are never the same twice. */
static void a_device_that_comes_and_goes_for_ever_new_reasons_costs_few_lines(void **state)
{
	int64_t t_ns = 0;

	(void)state;
	begin(&silent, NULL, NULL);
	for (int i = 0; i < 60; i++) {
		world[0].read_error = i % 2 ? EIO : ENXIO;
		supervisor_ready(supervisor, 0, true, false, t_ns + SECOND);
		t_ns = supervisor_deadline(supervisor);
		supervisor_timer(supervisor, t_ns);
		expect_state(0, SUPERVISOR_STREAMING);
	}
	assert_int_equal(logs, 6);
	assert_string_equal(log_lines[5].text, "lost: reading failed (No such device or address); trying again");
	world[0].absent = true;
	supervisor_ready(supervisor, 0, true, false, t_ns);
	supervisor_timer(supervisor, supervisor_deadline(supervisor));
	assert_int_equal(logs, 7); /* another state is told */
	assert_string_equal(log_lines[6].text, "not ready: /dev/fake0 is not there; plug it in; trying again");
	end();
}

static void a_telegram_now_and_then_forgives_the_noise_between(void **state)
{
	(void)state;
	begin(&silent, NULL, NULL);
	for (int64_t t_ns = 0; t_ns < 60 * SECOND; t_ns += 100 * MS) {
		world[0].at_once = 4096;
		strcpy(world[0].pending, "?");
		supervisor_timer(supervisor, t_ns);
		supervisor_ready(supervisor, 0, true, false, t_ns);
		world[0].at_once = 0;
		if (t_ns % (300 * MS) == 0)
			say(0, "d", t_ns);
	}
	assert_int_equal(supervisor_device(supervisor, 0)->losses, 0);
	end();
}

/* The dialogue begins anew on a link that stands: both changes are told, and the state says what it does. */
static void a_device_that_is_set_up_again_is_lost_and_back(void **state)
{
	(void)state;
	begin(&fake, NULL, NULL);
	greet(10 * MS);
	expect_state(0, SUPERVISOR_STREAMING);
	world[0].begins_anew = true;
	say(0, "d", 5 * SECOND);
	expect_state(0, SUPERVISOR_CONFIGURING);
	assert_int_equal(world[0].closes, 0);
	assert_int_equal(supervisor_device(supervisor, 0)->losses, 1);
	greet(5 * SECOND + 10 * MS);
	expect_state(0, SUPERVISOR_STREAMING);
	assert_int_equal(logs, 3);
	assert_string_equal(log_lines[1].text, "lost: it was switched off and on; setting it up again");
	assert_string_equal(log_lines[2].text, "streaming");
	end();
}

/* A servo that was halted by its limit goes on telling its angle, so the stream stands. */
static void a_note_that_changes_while_it_streams_is_told_each_time(void **state)
{
	(void)state;
	begin(&fake, NULL, NULL);
	greet(10 * MS);
	strcpy(world[0].note, "the sweep stopped at a limit");
	for (int i = 1; i < 20; i++)
		say(0, "d", i * 100 * MS);
	assert_string_equal(supervisor_device(supervisor, 0)->note, "the sweep stopped at a limit");
	assert_int_equal(logs, 2);
	assert_string_equal(log_lines[1].text, "the sweep stopped at a limit");
	world[0].note[0] = 0;
	say(0, "d", 2 * SECOND);
	say(0, "d", 2 * SECOND + MS);
	assert_string_equal(supervisor_device(supervisor, 0)->note, "");
	assert_int_equal(logs, 3);
	assert_string_equal(log_lines[2].text, "in order again");
	assert_int_equal(supervisor_device(supervisor, 0)->losses, 0);
	end();
}

/* A bus between warning and passive: a minute of it costs few lines, and how it ended is told. */
static void a_note_that_changes_without_end_costs_few_lines(void **state)
{
	(void)state;
	begin(&fake, NULL, NULL);
	greet(10 * MS);
	for (int i = 1; i < 590; i++) {
		snprintf(world[0].note, sizeof(world[0].note), "state %d", i);
		say(0, "d", i * 100 * MS);
	}
	assert_in_range(logs, 3, 8);
	assert_string_equal(supervisor_device(supervisor, 0)->note, "state 589");
	for (int i = 590; i < 700; i++)
		say(0, "d", i * 100 * MS);
	assert_in_range(logs, 4, 9);
	assert_string_equal(log_lines[logs - 1].text, "state 589");
	end();
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_device_is_configured_then_streams),
	    cmocka_unit_test(the_rate_is_set_only_after_every_byte_is_written),
	    cmocka_unit_test(a_device_that_takes_no_bytes_is_lost_after_a_while),
	    cmocka_unit_test(an_absent_device_is_tried_again_ever_more_slowly_and_told_once),
	    cmocka_unit_test(a_lost_device_comes_back_and_both_are_told),
	    cmocka_unit_test(a_device_that_fails_right_after_it_streams_backs_off_further),
	    cmocka_unit_test(a_silent_device_is_given_up_with_its_sentence),
	    cmocka_unit_test(a_host_that_slept_hears_what_came_meanwhile_before_it_judges),
	    cmocka_unit_test(a_failed_write_loses_the_device),
	    cmocka_unit_test(no_device_stalls_another),
	    cmocka_unit_test(a_device_without_a_link_just_streams),
	    cmocka_unit_test(an_orderly_end_asks_every_device_and_waits_at_most_a_second),
	    cmocka_unit_test(a_servo_has_the_time_to_go_to_its_rest_angle),
	    cmocka_unit_test(a_drive_has_the_time_to_be_switched_off),
	    cmocka_unit_test(a_device_that_backs_off_ends_at_once),
	    cmocka_unit_test(every_opening_is_recorded_before_the_first_write),
	    cmocka_unit_test(a_device_that_is_back_is_opened_within_a_second),
	    cmocka_unit_test(an_opening_that_hangs_is_given_up_after_a_second_and_a_half),
	    cmocka_unit_test(a_device_at_full_rate_is_read_within_its_budget),
	    cmocka_unit_test(a_device_of_another_kind_is_lost_with_a_sentence_and_few_lines),
	    cmocka_unit_test(a_device_that_comes_and_goes_for_ever_new_reasons_costs_few_lines),
	    cmocka_unit_test(a_telegram_now_and_then_forgives_the_noise_between),
	    cmocka_unit_test(a_device_that_is_set_up_again_is_lost_and_back),
	    cmocka_unit_test(a_note_that_changes_while_it_streams_is_told_each_time),
	    cmocka_unit_test(a_note_that_changes_without_end_costs_few_lines),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

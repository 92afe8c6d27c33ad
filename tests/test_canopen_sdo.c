/* Law L8: an SDO transfer ends with the object or with the reason, whatever comes back, when, and in which order. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <string.h>

#include "drivers/canopen_sdo.h"

#define NODE 5

/* A server of one object, written by the standard's text and not by the client: answers[] are what it says next. */
struct server {
	uint8_t object[CANOPEN_SDO_MAX + 64];
	size_t len, at;
	bool segments, toggle, announce, sized; /* how it answers */
	uint8_t answer[8];
	size_t answer_len;
	int requests, aborts, writes;
	uint32_t abort;
};

static void say(struct server *s, uint8_t command, const uint8_t *request)
{
	memset(s->answer, 0, 8);
	s->answer[0] = command;
	memcpy(s->answer + 1, request + 1, 3);
	s->answer_len = 8;
}

static void begin_upload(struct server *s, const uint8_t *request)
{
	s->at = 0;
	s->toggle = false;
	if (s->len >= 1 && s->len <= 4 && !s->segments) {
		say(s, s->sized ? (uint8_t)(0x43 | (4 - s->len) << 2) : 0x42, request);
		memcpy(s->answer + 4, s->object, s->len);
		return;
	}
	say(s, s->announce ? 0x41 : 0x40, request);
	if (s->announce) {
		s->answer[4] = (uint8_t)s->len;
		s->answer[5] = (uint8_t)(s->len >> 8);
	}
}

static void upload_segment(struct server *s, const uint8_t *request)
{
	const size_t n = s->len - s->at < 7 ? s->len - s->at : 7;

	assert_int_equal(request[0], 0x60 | s->toggle << 4);
	memset(s->answer, 0, 8);
	memcpy(s->answer + 1, s->object + s->at, n);
	s->at += n;
	s->answer[0] = (uint8_t)(s->toggle << 4 | (7 - n) << 1 | (s->at == s->len));
	s->answer_len = 8;
	s->toggle = !s->toggle;
}

static void begin_download(struct server *s, const uint8_t *request)
{
	s->len = s->at = 0;
	s->toggle = false;
	if (request[0] & 2) {
		s->len = request[0] & 1 ? 4 - (request[0] >> 2 & 3) : 4;
		memcpy(s->object, request + 4, s->len);
		s->writes++;
	} else {
		assert_int_equal(request[0], 0x21);
		s->at = (size_t)request[4] | (size_t)request[5] << 8;
	}
	say(s, 0x60, request);
}

static void download_segment(struct server *s, const uint8_t *request)
{
	const size_t n = 7u - (request[0] >> 1 & 7);

	assert_int_equal(request[0] >> 4 & 1, s->toggle);
	memcpy(s->object + s->len, request + 1, n);
	s->len += n;
	if (request[0] & 1) {
		assert_int_equal(s->len, s->at); /* as announced */
		s->writes++;
	}
	memset(s->answer, 0, 8);
	s->answer[0] = (uint8_t)(0x20 | s->toggle << 4);
	s->answer_len = 8;
	s->toggle = !s->toggle;
}

static void serve(struct server *s, const struct can_frame_at *f)
{
	assert_int_equal(f->id, 0x600 + NODE);
	assert_int_equal(f->len, 8);
	s->answer_len = 0;
	s->requests++;
	switch (f->data[0] >> 5) {
	case 0:
		download_segment(s, f->data);
		break;
	case 1:
		begin_download(s, f->data);
		break;
	case 2:
		begin_upload(s, f->data);
		break;
	case 3:
		upload_segment(s, f->data);
		break;
	default:
		assert_int_equal(f->data[0], 0x80);
		s->aborts++;
		s->abort = canopen_wire_number(f->data + 4, 4);
		break;
	}
}

/* Until the transfer ends or nobody says anything any more; every answer comes 1 ms later. */
static void run(struct canopen_sdo *c, struct server *s, int64_t *t_ns)
{
	struct can_frame_at f;

	for (int i = 0; i < 1000; i++) {
		while (canopen_sdo_step(c, *t_ns, &f))
			serve(s, &f);
		if (s->answer_len == 0)
			return;
		*t_ns += 1000000;
		canopen_sdo_answer(c, s->answer, s->answer_len);
		s->answer_len = 0;
	}
	fail_msg("the transfer does not end");
}

static struct canopen_sdo client(void)
{
	struct canopen_sdo c;

	canopen_sdo_init(&c, NODE);
	return c;
}

static void fill(uint8_t *bytes, size_t len)
{
	for (size_t i = 0; i < len; i++)
		bytes[i] = (uint8_t)(i * 37 + len);
}

static void objects_of_every_size_are_read(void **state)
{
	(void)state;
	for (size_t len = 0; len <= 100; len++)
		for (int how = 0; how < 4; how++) {
			struct server s = {.len = len, .announce = how & 1, .sized = how & 1, .segments = how & 2};
			struct canopen_sdo c = client();
			int64_t t_ns = 0;

			fill(s.object, len);
			canopen_sdo_upload(&c, 0x1008, 0);
			assert_true(canopen_sdo_deadline(&c) == INT64_MIN);
			run(&c, &s, &t_ns);
			assert_int_equal(c.state, CANOPEN_SDO_DONE);
			if (len >= 1 && len <= 4 && how == 0) { /* the size is not said: as many as came */
				assert_int_equal(c.len, 4);
				assert_false(c.sized);
			} else {
				assert_int_equal(c.len, len);
				assert_true(c.sized);
			}
			assert_memory_equal(c.data, s.object, len);
			assert_int_equal(s.aborts, 0);
			assert_true(canopen_sdo_deadline(&c) == INT64_MAX);
		}
}

static void objects_of_every_size_are_written(void **state)
{
	uint8_t data[CANOPEN_SDO_MAX];

	(void)state;
	for (size_t len = 0; len <= sizeof data; len += len < 100 ? 1 : 13) {
		struct server s = {.len = 0};
		struct canopen_sdo c = client();
		int64_t t_ns = 0;

		fill(data, len);
		canopen_sdo_download(&c, 0x2000, 3, data, len);
		run(&c, &s, &t_ns);
		assert_int_equal(c.state, CANOPEN_SDO_DONE);
		assert_int_equal(s.writes, 1);
		assert_int_equal(s.len, len);
		assert_memory_equal(s.object, data, len);
		assert_int_equal(s.requests, len >= 1 && len <= 4 ? 1 : 1 + (len ? (int)(len + 6) / 7 : 1));
	}
}

static void numbers_are_written_little_endian(void **state)
{
	struct server s = {.len = 0};
	struct canopen_sdo c = client();
	int64_t t_ns = 0;

	(void)state;
	canopen_sdo_write(&c, 0x1017, 0, 2, 4000);
	run(&c, &s, &t_ns);
	assert_int_equal(s.len, 2);
	assert_memory_equal(s.object, "\xA0\x0F", 2);
	assert_int_equal(canopen_sdo_number(&c, 2), 4000);
	assert_int_equal(canopen_sdo_number(&c, 1), 0xA0);
}

/* A node that answers nothing gets an abort after each try, and is left after the third. */
static void silence_ends_with_an_abort_and_a_reason(void **state)
{
	struct canopen_sdo c = client();
	struct can_frame_at f;
	int64_t t_ns = 1000;
	int tries = 0, aborts = 0;

	(void)state;
	canopen_sdo_upload(&c, 0x6041, 0);
	while (c.state == CANOPEN_SDO_BUSY) {
		while (canopen_sdo_step(&c, t_ns, &f)) {
			if (f.data[0] == 0x40) {
				tries++;
				assert_int_equal(canopen_sdo_deadline(&c), t_ns + CANOPEN_SDO_TIMEOUT_NS);
				assert_false(canopen_sdo_step(&c, t_ns + CANOPEN_SDO_TIMEOUT_NS - 1, &f));
			} else {
				aborts++;
				assert_memory_equal(f.data, "\x80\x41\x60\x00\x00\x00\x04\x05", 8);
			}
		}
		t_ns = canopen_sdo_deadline(&c);
	}
	assert_int_equal(tries, CANOPEN_SDO_TRIES);
	assert_int_equal(aborts, CANOPEN_SDO_TRIES);
	assert_int_equal(c.state, CANOPEN_SDO_FAILED);
	assert_int_equal(c.abort, CANOPEN_ABORT_TIMEOUT);
	assert_false(c.refused);
	assert_true(t_ns == INT64_MAX);
}

/* Any one answer lost, in whichever phase: the next try gets through. */
static void a_lost_answer_costs_one_try(void **state)
{
	uint8_t data[40];

	(void)state;
	fill(data, sizeof data);
	for (int download = 0; download < 2; download++)
		for (int lost = 0; lost < 7; lost++) {
			struct server s = {.len = sizeof data, .announce = true};
			struct canopen_sdo c = client();
			struct can_frame_at f;
			int64_t t_ns = 0;
			int answers = 0;

			fill(s.object, sizeof data);
			if (download)
				canopen_sdo_download(&c, 0x2000, 0, data, sizeof data);
			else
				canopen_sdo_upload(&c, 0x2000, 0);
			for (int i = 0; i < 100 && c.state == CANOPEN_SDO_BUSY; i++) {
				while (canopen_sdo_step(&c, t_ns, &f))
					serve(&s, &f);
				if (s.answer_len && answers++ != lost)
					canopen_sdo_answer(&c, s.answer, s.answer_len);
				else
					t_ns = canopen_sdo_deadline(&c);
				s.answer_len = 0;
			}
			assert_int_equal(c.state, CANOPEN_SDO_DONE);
			assert_int_equal(s.aborts, 1);
			assert_int_equal(s.abort, CANOPEN_ABORT_TIMEOUT);
			assert_int_equal(c.len, sizeof data);
			assert_memory_equal(download ? s.object : c.data, data, sizeof data);
			assert_int_equal(c.tries, 1);
		}
}

static void an_answer_of_another_object_is_never_taken(void **state)
{
	static const uint8_t stray[][8] = {
	    {0x43, 0x40, 0x60, 0x00, 1, 2, 3, 4}, /* another index */
	    {0x43, 0x41, 0x60, 0x01, 1, 2, 3, 4}, /* another sub-index */
	    {0x60, 0x41, 0x60, 0x00},             /* of a write */
	    {0x80, 0x40, 0x60, 0x00, 0, 0, 2, 6}, /* another's abort */
	    {0x00, 1, 2, 3, 4, 5, 6, 7},          /* segments */
	    {0x10, 1, 2, 3, 4, 5, 6, 7},
	    {0x20},
	    {0x30},
	    {0xa4, 0x41, 0x60, 0x00}, /* block transfers */
	    {0xc2, 0x41, 0x60, 0x00},
	    {0xff, 0x41, 0x60, 0x00},
	};
	struct canopen_sdo c = client();
	struct can_frame_at f;

	(void)state;
	canopen_sdo_upload(&c, 0x6041, 0);
	assert_false(
	    canopen_sdo_answer(&c, (const uint8_t *)"\x4b\x41\x60\x00\x27\x02\x00\x00", 8)); /* not asked yet */
	assert_true(canopen_sdo_step(&c, 0, &f));
	for (size_t i = 0; i < sizeof stray / sizeof stray[0]; i++) {
		assert_false(canopen_sdo_answer(&c, stray[i], 8));
		assert_int_equal(c.state, CANOPEN_SDO_BUSY);
		assert_false(canopen_sdo_step(&c, 0, &f));
	}
	assert_true(canopen_sdo_answer(&c, (const uint8_t *)"\x4b\x41\x60\x00\x27\x02\x00\x00", 8));
	assert_int_equal(canopen_sdo_number(&c, 2), 0x0227);
	assert_false(canopen_sdo_answer(&c, (const uint8_t *)"\x4b\x41\x60\x00\x08\x00\x00\x00", 8)); /* and again */
	assert_int_equal(canopen_sdo_number(&c, 2), 0x0227);
	assert_int_equal(c.ignored, sizeof stray / sizeof stray[0] + 2);
}

/* The answer comes after the transfer was given up for another: it is not the other's. */
static void a_late_answer_is_not_the_next_ones(void **state)
{
	struct canopen_sdo c = client();
	struct can_frame_at f;

	(void)state;
	canopen_sdo_upload(&c, 0x6041, 0);
	assert_true(canopen_sdo_step(&c, 0, &f));
	canopen_sdo_upload(&c, 0x6064, 0);
	assert_true(canopen_sdo_step(&c, 1, &f)); /* the node is told first */
	assert_memory_equal(f.data, "\x80\x41\x60\x00\x00\x00\x00\x08", 8);
	assert_true(canopen_sdo_step(&c, 1, &f));
	assert_memory_equal(f.data, "\x40\x64\x60\x00\x00\x00\x00\x00", 8);
	assert_false(canopen_sdo_answer(&c, (const uint8_t *)"\x4b\x41\x60\x00\x27\x02\x00\x00", 8));
	assert_true(canopen_sdo_answer(&c, (const uint8_t *)"\x43\x64\x60\x00\x01\x00\x00\x00", 8));
	assert_int_equal(canopen_sdo_number(&c, 4), 1);
}

static void an_abort_tells_its_code_in_any_phase(void **state)
{
	static const uint8_t refusal[8] = {0x80, 0x00, 0x20, 0x00, 0x22, 0x00, 0x00, 0x08};

	(void)state;
	for (int download = 0; download < 2; download++)
		for (int phase = 0; phase < 4; phase++) {
			struct server s = {.len = 60, .announce = true};
			struct canopen_sdo c = client();
			struct can_frame_at f;
			uint8_t data[60] = {0};

			if (download)
				canopen_sdo_download(&c, 0x2000, 0, data, sizeof data);
			else
				canopen_sdo_upload(&c, 0x2000, 0);
			for (int i = 0; i < phase; i++) {
				assert_true(canopen_sdo_step(&c, 0, &f));
				serve(&s, &f);
				assert_true(canopen_sdo_answer(&c, s.answer, s.answer_len));
			}
			assert_true(canopen_sdo_step(&c, 0, &f));
			assert_true(canopen_sdo_answer(&c, refusal, 8));
			assert_int_equal(c.state, CANOPEN_SDO_FAILED);
			assert_true(c.refused);
			assert_int_equal(c.abort, CANOPEN_ABORT_STATE);
			assert_false(canopen_sdo_step(&c, INT64_MAX, &f)); /* nothing is said to that */
		}
}

static void what_is_longer_than_there_is_room_is_aborted(void **state)
{
	(void)state;
	for (int announce = 0; announce < 2; announce++) {
		struct server s = {.len = CANOPEN_SDO_MAX + 1, .announce = announce};
		struct canopen_sdo c = client();
		int64_t t_ns = 0;

		canopen_sdo_upload(&c, 0x1021, 0);
		run(&c, &s, &t_ns);
		assert_int_equal(c.state, CANOPEN_SDO_FAILED);
		assert_int_equal(c.abort, CANOPEN_ABORT_MEMORY);
		assert_int_equal(s.abort, CANOPEN_ABORT_MEMORY);
		assert_int_equal(s.aborts, 1);
	}
	struct server s = {.len = CANOPEN_SDO_MAX};
	struct canopen_sdo c = client();
	int64_t t_ns = 0;

	canopen_sdo_upload(&c, 0x1021, 0);
	run(&c, &s, &t_ns);
	assert_int_equal(c.state, CANOPEN_SDO_DONE);
	assert_int_equal(c.len, CANOPEN_SDO_MAX);
}

/* What it says and what it sends differ. */
static void a_length_that_was_a_lie_is_aborted(void **state)
{
	static const uint8_t begin[8] = {0x41, 0x08, 0x10, 0x00, 10};
	static const uint8_t few[8] = {0x01, 1, 2, 3, 4, 5, 6, 7};  /* the last, 7 of 10 */
	static const uint8_t more[8] = {0x10, 1, 2, 3, 4, 5, 6, 7}; /* 14 of 10 */
	static const uint8_t none[8] = {0x0e};                      /* nothing, and not the last */
	static const uint8_t full[8] = {0x00, 1, 2, 3, 4, 5, 6, 7};

	(void)state;
	for (int how = 0; how < 3; how++) {
		struct canopen_sdo c = client();
		struct can_frame_at f;

		canopen_sdo_upload(&c, 0x1008, 0);
		assert_true(canopen_sdo_step(&c, 0, &f));
		assert_true(canopen_sdo_answer(&c, begin, 8));
		assert_true(canopen_sdo_step(&c, 0, &f));
		assert_true(canopen_sdo_answer(&c, how == 0 ? few : how == 1 ? full : none, 8));
		if (how == 1) {
			assert_true(canopen_sdo_step(&c, 0, &f));
			assert_true(canopen_sdo_answer(&c, more, 8));
		}
		assert_int_equal(c.state, CANOPEN_SDO_FAILED);
		assert_true(canopen_sdo_step(&c, 0, &f));
		assert_memory_equal(f.data, "\x80\x08\x10\x00\x10\x00\x07\x06", 8);
		assert_false(canopen_sdo_step(&c, 0, &f));
	}
}

/* A frame that came twice: the bit did not toggle. The transfer is begun anew, three times at most. */
static void a_segment_that_comes_twice_begins_anew(void **state)
{
	(void)state;
	for (int download = 0; download < 2; download++)
		for (int always = 0; always < 2; always++) {
			struct server s = {.len = 30, .announce = true};
			struct canopen_sdo c = client();
			struct can_frame_at f;
			uint8_t data[30] = {0};
			int doubles = 0;

			fill(s.object, 30);
			if (download)
				canopen_sdo_download(&c, 0x2000, 0, data, sizeof data);
			else
				canopen_sdo_upload(&c, 0x2000, 0);
			for (int i = 0; i < 100 && c.state == CANOPEN_SDO_BUSY; i++) {
				while (canopen_sdo_step(&c, 0, &f))
					serve(&s, &f);
				if (!canopen_sdo_answer(&c, s.answer, s.answer_len) || s.answer[0] & 0x50 ||
				    (doubles > 0 && !always))
					continue;
				if (canopen_sdo_step(&c, 0, &f)) { /* the next request is out when it comes again */
					doubles++;
					canopen_sdo_answer(&c, s.answer, s.answer_len);
				}
			}
			assert_int_equal(c.state, always ? CANOPEN_SDO_FAILED : CANOPEN_SDO_DONE);
			if (always)
				assert_int_equal(c.abort, CANOPEN_ABORT_TOGGLE);
			while (canopen_sdo_step(&c, 0, &f))
				serve(&s, &f);
			assert_int_equal(s.abort, CANOPEN_ABORT_TOGGLE);
			assert_int_equal(s.aborts, always ? CANOPEN_SDO_TRIES : 1);
		}
}

/* Real devices end an answer with its data, and echo what was written. */
static void short_answers_and_echoes_are_taken(void **state)
{
	struct canopen_sdo c = client();
	struct can_frame_at f;

	(void)state;
	canopen_sdo_upload(&c, 0x1400, 2);
	assert_true(canopen_sdo_step(&c, 0, &f));
	for (size_t len = 0; len < 5; len++)
		assert_false(canopen_sdo_answer(&c, (const uint8_t *)"\x4f\x00\x14\x02\xfe", len));
	assert_true(canopen_sdo_answer(&c, (const uint8_t *)"\x4f\x00\x14\x02\xfe", 5));
	assert_int_equal(canopen_sdo_number(&c, 1), 0xfe);
	assert_int_equal(c.len, 1);

	canopen_sdo_write(&c, 0x1016, 1, 4, 0x00640258);
	assert_true(canopen_sdo_step(&c, 0, &f));
	assert_true(canopen_sdo_answer(&c, (const uint8_t *)"\x60\x16\x10\x01\x58\x02\x64\x00", 8));
	assert_int_equal(c.state, CANOPEN_SDO_DONE);

	canopen_sdo_write(&c, 0x1017, 0, 2, 100);
	assert_true(canopen_sdo_step(&c, 0, &f));
	assert_true(canopen_sdo_answer(&c, (const uint8_t *)"\x60\x17\x10\x00", 4));
	assert_int_equal(c.state, CANOPEN_SDO_DONE);

	canopen_sdo_write(&c, 0x1017, 0, 2, 100);
	assert_true(canopen_sdo_step(&c, 0, &f));
	assert_true(canopen_sdo_answer(&c, (const uint8_t *)"\x80\x17\x10\x00", 4)); /* without a code */
	assert_int_equal(c.abort, CANOPEN_ABORT_GENERAL);
}

/* Answers of a whole transfer in every order of three, with every cut: it ends, and well only with the right data. */
static void no_order_of_answers_gives_wrong_data(void **state)
{
	static const uint8_t answer[4][8] = {{0x41, 0x08, 0x10, 0x00, 14},
	                                     {0x00, 'a', 'b', 'c', 'd', 'e', 'f', 'g'},
	                                     {0x11, 'h', 'i', 'j', 'k', 'l', 'm', 'n'},
	                                     {0x80, 0x08, 0x10, 0x00, 0, 0, 0, 8}};

	(void)state;
	for (int order = 0; order < 4 * 4 * 4 * 4; order++)
		for (size_t len = 0; len <= 8; len++) {
			struct canopen_sdo c = client();
			struct can_frame_at f;

			canopen_sdo_upload(&c, 0x1008, 0);
			for (int i = 0; i < 4; i++) {
				while (canopen_sdo_step(&c, 0, &f)) {
				}
				canopen_sdo_answer(&c, answer[order >> 2 * i & 3], i == 3 ? len : 8);
			}
			if (c.state == CANOPEN_SDO_DONE) {
				assert_int_equal(c.len, 14);
				assert_memory_equal(c.data, "abcdefghijklmn", 14);
			}
			for (int i = 0; i < 20 && c.state == CANOPEN_SDO_BUSY; i++) {
				while (canopen_sdo_step(&c, INT64_MAX / 2 + i, &f)) {
				}
				canopen_sdo_step(&c, INT64_MAX, &f);
			}
			assert_int_not_equal(c.state, CANOPEN_SDO_BUSY);
		}
}

/* What is put is parsed the same, requests and answers. */
static void telegrams_go_there_and_back(void **state)
{
	struct canopen_wire_sdo sdo, back;
	uint8_t bytes[8];

	(void)state;
	for (int kind = 0; kind < CANOPEN_SDO_OTHER; kind++)
		for (int bits = 0; bits < 64; bits++) {
			const bool segment = kind == CANOPEN_SDO_DOWNLOAD_SEGMENT || kind == CANOPEN_SDO_UPLOAD_SEGMENT;
			const int answer = bits >> 5;
			const bool carries =
			    kind == (answer ? CANOPEN_SDO_UPLOAD : CANOPEN_SDO_DOWNLOAD) ||
			    kind == (answer ? CANOPEN_SDO_UPLOAD_SEGMENT : CANOPEN_SDO_DOWNLOAD_SEGMENT);

			sdo = (struct canopen_wire_sdo){.kind = kind};
			if (segment) {
				sdo.toggle = bits & 1;
				sdo.last = carries && bits & 2;
				sdo.len = carries ? (uint8_t)(bits >> 2 & 7) : 0;
			} else {
				sdo.index = 0x1a03;
				sdo.sub = 7;
				sdo.abort = kind == CANOPEN_SDO_ABORT ? 0x06040041 : 0;
				sdo.expedited = carries && bits & 1;
				sdo.sized = carries && bits & 2;
				sdo.len = sdo.expedited ? (uint8_t)(sdo.sized ? 1 + (bits >> 2 & 3) : 4) : 0;
				sdo.size = carries && !sdo.expedited && sdo.sized ? 0x01020304 : 0;
			}
			memcpy(sdo.data, "\1\2\3\4\5\6\7", sdo.len);
			if (answer)
				canopen_wire_put_answer(&sdo, bytes);
			else
				canopen_wire_put_request(&sdo, bytes);
			assert_true(answer ? canopen_wire_parse_answer(bytes, 8, &back)
			                   : canopen_wire_parse_request(bytes, 8, &back));
			sdo.command = bytes[0];
			assert_int_equal(back.kind, sdo.kind);
			assert_int_equal(back.index, sdo.index);
			assert_int_equal(back.sub, sdo.sub);
			assert_int_equal(back.expedited, sdo.expedited);
			assert_int_equal(back.sized, sdo.sized);
			assert_int_equal(back.toggle, sdo.toggle);
			assert_int_equal(back.last, sdo.last);
			assert_int_equal(back.size, sdo.size);
			assert_int_equal(back.abort, sdo.abort);
			assert_int_equal(back.len, sdo.len);
			assert_memory_equal(back.data, sdo.data, 7);
		}
}

static void codes_are_told_in_words(void **state)
{
	(void)state;
	assert_string_equal(canopen_wire_abort_text(0x06010002), "object can only be read");
	assert_string_equal(canopen_wire_abort_text(0x05040000), "no answer in time");
	assert_string_equal(canopen_wire_abort_text(0x12345678), "reason that no standard names");
	assert_string_equal(canopen_wire_emcy_text(0x8130), "heartbeat or node guarding lost"); /* itself */
	assert_string_equal(canopen_wire_emcy_text(0x8199), "communication");                   /* its hundred */
	assert_string_equal(canopen_wire_emcy_text(0x5043), "device hardware");                 /* its thousand */
	assert_string_equal(canopen_wire_emcy_text(0x0000), "no error");
	assert_string_equal(canopen_wire_emcy_text(0xa000), "error that no standard names");
	assert_string_equal(canopen_wire_nmt_text(0x85), "operational"); /* toggle bit of a guarded node */
	assert_string_equal(canopen_wire_nmt_text(0x7f), "pre-operational");
	assert_string_equal(canopen_wire_nmt_text(0x04), "stopped");
	assert_string_equal(canopen_wire_nmt_text(0x00), "booting");
	assert_string_equal(canopen_wire_nmt_text(0x33), "in no known state");
}

/* All 65,536 statuswords: the masks of the standard, and nothing twice. */
static void statuswords_name_the_states_of_the_standard(void **state)
{
	static const struct {
		uint16_t word;
		const char *text;
	} of[] = {{0x0000, "not ready to switch on"}, {0x0240, "switch on disabled"},
	          {0x0231, "ready to switch on"},     {0x0233, "switched on"},
	          {0x1637, "operation enabled"},      {0x0617, "quick stop active"},
	          {0x023f, "fault reaction active"},  {0x4238, "fault"},
	          {0x0003, "in no known state"}};

	(void)state;
	for (size_t i = 0; i < sizeof of / sizeof of[0]; i++)
		assert_string_equal(canopen_wire_drive_text(canopen_wire_drive_state(of[i].word)), of[i].text);
	for (unsigned w = 0; w <= UINT16_MAX; w++) {
		const enum canopen_drive_state s = canopen_wire_drive_state((uint16_t)w);

		assert_int_equal(s == CANOPEN_FAULT, (w & 0x4f) == 0x08);
		assert_int_equal(s == CANOPEN_ENABLED, (w & 0x6f) == 0x27);
	}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(objects_of_every_size_are_read),
	    cmocka_unit_test(objects_of_every_size_are_written),
	    cmocka_unit_test(numbers_are_written_little_endian),
	    cmocka_unit_test(silence_ends_with_an_abort_and_a_reason),
	    cmocka_unit_test(a_lost_answer_costs_one_try),
	    cmocka_unit_test(an_answer_of_another_object_is_never_taken),
	    cmocka_unit_test(a_late_answer_is_not_the_next_ones),
	    cmocka_unit_test(an_abort_tells_its_code_in_any_phase),
	    cmocka_unit_test(what_is_longer_than_there_is_room_is_aborted),
	    cmocka_unit_test(a_length_that_was_a_lie_is_aborted),
	    cmocka_unit_test(a_segment_that_comes_twice_begins_anew),
	    cmocka_unit_test(short_answers_and_echoes_are_taken),
	    cmocka_unit_test(no_order_of_answers_gives_wrong_data),
	    cmocka_unit_test(telegrams_go_there_and_back),
	    cmocka_unit_test(codes_are_told_in_words),
	    cmocka_unit_test(statuswords_name_the_states_of_the_standard),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

/* Law: what two real drives, a maker's simulator and published examples put on the bus is read as it was meant, and our
 * own requests are theirs byte for byte. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#include <math.h>

#include "core/trig.h"
#include "drivers/canopen_parts.h"
#include "drivers/canopen_setup.h"
#include "tests/canopen_node.h"
#include "tests/captures.h"
#include "drivers/candump.h"

#define STARTUP_LOG  "can/canopen_cia402_two_drives_startup.log"
#define STARTUP_TEXT "can/canopen_cia402_two_drives_startup.candump.txt"
#define ABORTS       "can/oriental_motor_simulator_sdo_aborts.candump.txt"
#define EXAMPLES     "can/sdo_examples_python_canopen_tests.txt"

#define FRAMES_MAX 256

struct frames {
	int n;
	struct can_frame_at frame[FRAMES_MAX];
};

static void load(const char *name, struct frames *ret)
{
	struct candump_line line;
	size_t len;
	char *text = (char *)capture_file(name, &len);

	ret->n = 0;
	assert_non_null(text);
	for (char *at = strtok(text, "\n"); at; at = strtok(NULL, "\n")) {
		assert_int_equal(candump_read(at, strlen(at), &line), CANDUMP_FRAME);
		assert_string_equal(line.interface, "can0");
		assert_true(ret->n < FRAMES_MAX);
		ret->frame[ret->n++] = line.frame;
	}
	free(text);
}

/* What a decoder said of it. */
struct heard {
	int boots, answers, aborts, statuswords, values, angles;
	uint32_t abort[4];
	uint16_t statusword;
	struct canopen_value value[8];
	struct canopen_angle angle;
	struct tilt tilt;
	int tilts;
};

static void hear(void *ctx, int device, const struct reply *reply)
{
	struct heard *h = ctx;
	struct canopen_wire_sdo sdo;

	assert_int_equal(device, 3);
	switch (reply->kind) {
	case CANOPEN_REPLY_NMT:
		assert_int_equal(reply->payload[0], CANOPEN_BOOT_UP);
		h->boots++;
		break;
	case CANOPEN_REPLY_SDO:
		h->answers++;
		assert_true(canopen_wire_parse_answer(reply->payload, reply->len, &sdo));
		if (sdo.kind == CANOPEN_SDO_ABORT)
			h->abort[h->aborts++] = sdo.abort;
		break;
	case CANOPEN_REPLY_STATUS:
		memcpy(&h->statusword, reply->payload, sizeof h->statusword);
		h->statuswords++;
		break;
	case CANOPEN_REPLY_VALUE:
		assert_true(h->values < 8);
		memcpy(&h->value[h->values++], reply->payload, sizeof h->value[0]);
		break;
	case CANOPEN_REPLY_ANGLE:
		memcpy(&h->angle, reply->payload, sizeof h->angle);
		h->angles++;
		break;
	default:
		fail_msg("a reply of kind %d", reply->kind);
	}
}

static void tilted(void *ctx, int device, const struct tilt *tilt)
{
	struct heard *h = ctx;

	(void)device;
	h->tilt = *tilt;
	h->tilts++;
}

static struct decoder *decode(int node, const struct frames *frames, struct heard *ret)
{
	struct config_device device = {
	    .node = node, .master = 127, .count = {.set = true, .scale = 0.001 * TRIG_DEG, .sign = 1}};
	struct decoder *d = canopen_decoder_create(&device, 3);
	struct record_sink sink = {.ctx = ret, .tilt = tilted, .reply = hear};

	assert_non_null(d);
	memset(ret, 0, sizeof *ret);
	for (int i = 0; i < frames->n; i++) {
		uint8_t entry[CAN_WIRE_ENTRY_FD];
		struct can_frame_at f = frames->frame[i];
		struct record record = {.bytes = entry};

		f.t_ns += 1000000000;
		record.len = can_wire_put(&f, entry);
		record.log_ns = record.t_ns = f.t_ns;
		canopen_decode(d, &record, &sink);
	}
	return d;
}

static uint64_t counted(const struct decoder *d, const char *name)
{
	struct decoder_counters counters;

	canopen_counters(d, &counters);
	for (int i = 0; i < counters.n; i++)
		if (strcmp(counters.counter[i].name, name) == 0)
			return counters.counter[i].count;
	fail_msg("no counter %s", name);
	return 0;
}

static void both_forms_of_the_start_up_hold_the_same_frames(void **state)
{
	struct frames log, text;

	(void)state;
	load(STARTUP_LOG, &log);
	load(STARTUP_TEXT, &text);
	assert_int_equal(log.n, 110);
	assert_int_equal(text.n, log.n);
	for (int i = 0; i < log.n; i++) {
		assert_int_equal(log.frame[i].t_ns, (int64_t)i * 1000000);
		assert_int_equal(text.frame[i].id, log.frame[i].id);
		assert_int_equal(text.frame[i].len, log.frame[i].len);
		assert_memory_equal(text.frame[i].data, log.frame[i].data, 8);
	}
}

static void assert_pdo(const struct decoder *d, bool transmit, int pdo, uint32_t cob, int n, const uint32_t *entry)
{
	struct canopen_learned learned;

	canopen_decoder_pdo(d, transmit, pdo, &learned);
	assert_true(learned.known);
	assert_int_equal(learned.cob, cob);
	assert_int_equal(learned.type, 1);
	assert_int_equal(learned.n, n);
	for (int i = 0; i < n; i++)
		assert_int_equal(learned.entry[i], entry[i]);
}

/* The two drives' documented start-up. */
static void the_two_drives_start_as_documented(void **state)
{
	static const uint32_t t1[] = {0x60410010, 0x60610008}, t2[] = {0x606c0020, 0x60640020},
	                      t3[] = {0x60790020, 0x60780010, 0x603f0010}, r1[] = {0x60400010, 0x60600008},
	                      r2[] = {0x60ff0020, 0x607a0020};
	static const uint32_t link_mv[] = {0, 0xbb5c, 0xbb22}, current[] = {0, 1, 0};
	static const int64_t position[] = {0, -2, 1};
	struct frames frames;
	struct heard h;

	(void)state;
	load(STARTUP_LOG, &frames);
	for (int node = 1; node <= 2; node++) {
		struct decoder *d = decode(node, &frames, &h);
		const uint32_t id = (uint32_t)node;

		assert_int_equal(h.boots, 1);
		assert_int_equal(canopen_decoder_type(d), 0x00020192); /* a servo by CiA 402 */
		assert_int_equal(h.answers, 4);                        /* type, vendor, product, 1016 with an echo */
		assert_int_equal(h.aborts, 0);
		assert_pdo(d, false, 1, 0x200 + id, 2, r1);
		assert_pdo(d, false, 2, 0x300 + id, 2, r2);
		assert_pdo(d, true, 1, 0x180 + id, 2, t1);
		assert_pdo(d, true, 2, 0x280 + id, 2, t2);
		assert_pdo(d, true, 3, 0x380 + id, 3, t3);

		assert_int_equal(h.statuswords, 1);
		assert_int_equal(h.statusword, 0x4238);
		assert_string_equal(canopen_wire_drive_text(canopen_wire_drive_state(h.statusword)), "fault");
		assert_int_equal(h.values, 5); /* mode, link voltage, current, error, velocity */
		assert_int_equal(h.value[0].index, 0x6061);
		assert_int_equal(h.value[0].value, 0);
		assert_int_equal(h.value[1].index, 0x6079);
		assert_int_equal(h.value[1].value, link_mv[node]);
		assert_int_equal(h.value[2].index, 0x6078);
		assert_int_equal(h.value[2].value, current[node]);
		assert_int_equal(h.value[3].index, 0x603f);
		assert_int_equal(h.value[3].value, 0x8100);
		assert_string_equal(canopen_wire_emcy_text((uint16_t)h.value[3].value), "communication");
		assert_int_equal(h.value[4].index, 0x606c);
		assert_int_equal(h.value[4].value, 0);
		assert_int_equal(h.angles, 1);
		assert_int_equal(h.tilts, 1);
		assert_int_equal(h.angle.count, position[node]);
		assert_true(fabs(h.tilt.angle_rad - (double)position[node] * 0.001 * TRIG_DEG) < 1e-15);
		/* No SYNC is in the log, so the frame's own time is the angle's. */
		assert_int_equal(h.tilt.t_ns, 1000000000 + (node == 1 ? 104 : 105) * 1000000);
		assert_int_equal(counted(d, "sync missed"), 3);
		assert_int_equal(counted(d, "boot-ups"), 1);
		/* The other drive's frames, and the boot-up of a third node; our NMT commands are nobody's. */
		assert_int_equal(counted(d, "foreign"), (frames.n - 1 - 3) / 2 + 1);
		canopen_decoder_destroy(d);
	}
}

/* The same objects through our set-up, on a drive that is mapped otherwise: the frames of the log. */
static void our_mapping_is_written_as_in_the_start_up(void **state)
{
	static const struct canopen_pdo pdo[] = {
	    {.index = 0x1400,
	     .cob = 0x202,
	     .type = 1,
	     .inhibit = -1,
	     .timer = -1,
	     .n = 2,
	     .entry = {0x60400010, 0x60600008}},
	    {.index = 0x1401,
	     .cob = 0x302,
	     .type = 1,
	     .inhibit = -1,
	     .timer = -1,
	     .n = 2,
	     .entry = {0x60ff0020, 0x607a0020}},
	    {.index = 0x1800,
	     .cob = 0x182,
	     .type = 1,
	     .inhibit = -1,
	     .timer = -1,
	     .n = 2,
	     .entry = {0x60410010, 0x60610008}},
	    {.index = 0x1801,
	     .cob = 0x282,
	     .type = 1,
	     .inhibit = -1,
	     .timer = -1,
	     .n = 2,
	     .entry = {0x606c0020, 0x60640020}},
	    {.index = 0x1802,
	     .cob = 0x382,
	     .type = 1,
	     .inhibit = -1,
	     .timer = -1,
	     .n = 3,
	     .entry = {0x60790020, 0x60780010, 0x603f0010}},
	};
	struct can_frame_at f, answer;
	struct canopen_setup s;
	struct frames frames;
	struct node node;
	int written = 0;

	(void)state;
	load(STARTUP_LOG, &frames);
	node_drive(&node, 2);
	canopen_setup_init(&s, 2);
	for (size_t i = 0; i < sizeof pdo / sizeof pdo[0]; i++)
		canopen_setup_pdo(&s, &pdo[i]);
	canopen_setup_begin(&s);
	while (canopen_setup_step(&s, 0, &f))
		if (node_answer(&node, &f, &answer))
			canopen_setup_answer(&s, answer.data, answer.len);
	assert_int_equal(s.state, CANOPEN_SETUP_DONE);
	for (int i = 0; i < frames.n; i++) {
		const struct can_frame_at *was = &frames.frame[i];

		if (was->id != 0x602 || was->data[0] >> 5 != 1 || was->data[2] < 0x14 || was->data[2] > 0x1a)
			continue;
		assert_true(written < node.writes);
		assert_memory_equal(node.write[written].data, was->data, 8);
		written++;
	}
	assert_int_equal(written, 4 * 7 + 8);
	assert_int_equal(node.writes, written);
}

static void aborts_are_told_with_object_and_reason(void **state)
{
	static const struct {
		uint16_t index;
		uint8_t sub, size;
		uint32_t value;
		const char *error;
	} of[] = {
	    {0x60fe, 1, 4, 0x01800000,
	     "object 60FE:01 of node 1 cannot be set to 0x01800000: object can only be read (06010002)"},
	    {0x6072, 0, 2, 10000,
	     "object 6072:00 of node 1 cannot be set to 0x2710: object can only be read (06010002)"},
	};
	struct frames frames;
	struct heard h;

	(void)state;
	load(ABORTS, &frames);
	assert_int_equal(frames.n, 4);
	struct decoder *d = decode(1, &frames, &h);

	assert_int_equal(h.aborts, 2);
	assert_int_equal(counted(d, "aborts"), 2);
	assert_int_equal(counted(d, "sdo"), 0);
	canopen_decoder_destroy(d);
	for (int i = 0; i < 2; i++) {
		const struct can_frame_at *request = &frames.frame[2 * i], *answer = &frames.frame[2 * i + 1];
		struct canopen_setup s;
		struct can_frame_at f;

		assert_int_equal(h.abort[i], CANOPEN_ABORT_READ_ONLY);
		canopen_setup_init(&s, 1);
		canopen_setup_object(&s, &(struct canopen_object){.index = of[i].index,
		                                                  .sub = of[i].sub,
		                                                  .size = of[i].size,
		                                                  .how = CANOPEN_WRITE,
		                                                  .value = of[i].value});
		canopen_setup_begin(&s);
		assert_true(canopen_setup_step(&s, 0, &f));
		assert_int_equal(f.id, request->id);
		assert_memory_equal(f.data, request->data, 8);
		canopen_setup_answer(&s, answer->data, answer->len);
		assert_false(canopen_setup_step(&s, 0, &f));
		assert_int_equal(s.state, CANOPEN_SETUP_FAILED);
		assert_string_equal(s.error, of[i].error);
	}
}

/* "602#4018100100000000  582#4318100104000000  words": false where it is no such line. */
static bool example(const char *text, struct can_frame_at *ret_request, struct can_frame_at *ret_answer)
{
	struct candump_line line;
	char request[32] = "x ", answer[32] = "x ";

	ret_answer->id = 0;
	if (sscanf(text, "%28s %28s", request + 2, answer + 2) < 1 ||
	    candump_read(request, strlen(request), &line) != CANDUMP_FRAME)
		return false;
	*ret_request = line.frame;
	if (candump_read(answer, strlen(answer), &line) == CANDUMP_FRAME)
		*ret_answer = line.frame;
	return true;
}

static void begin_as(struct canopen_sdo *c, const uint8_t *request)
{
	const uint16_t index = (uint16_t)(request[1] | request[2] << 8);

	if (request[0] == 0x40)
		canopen_sdo_upload(c, index, request[3]);
	else if (request[0] == 0x2b)
		canopen_sdo_write(c, index, request[3], 2, canopen_wire_number(request + 4, 2));
	else
		canopen_sdo_download(c, index, request[3], "A long string", 13);
}

static void the_published_examples_are_ours_byte_for_byte(void **state)
{
	struct can_frame_at request, answer, f;
	struct canopen_sdo c;
	size_t len;
	char *text = (char *)capture_file(EXAMPLES, &len);
	int transfers = 0, requests = 0;

	(void)state;
	canopen_sdo_init(&c, 2);
	for (char *at = strtok(text, "\n"); at; at = strtok(NULL, "\n")) {
		if (*at == '#' || !example(at, &request, &answer))
			continue;
		if (c.state != CANOPEN_SDO_BUSY) {
			begin_as(&c, request.data);
			transfers++;
		}
		assert_true(canopen_sdo_step(&c, 0, &f));
		requests++;
		assert_int_equal(f.id, request.id);
		assert_int_equal(f.len, request.len);
		assert_memory_equal(f.data, request.data, 8);
		if (!answer.id) /* the last one's is not printed */
			answer = can_wire_frame(0x582, "\x30\0\0\0\0\0\0", 8);
		assert_true(canopen_sdo_answer(&c, answer.data, answer.len));
		if (c.index == 0x1018)
			assert_int_equal(canopen_sdo_number(&c, 4), 4);
		if (c.index == 0x1400)
			assert_int_equal(canopen_sdo_number(&c, 1), 0xfe);
		if (c.index == 0x1008 && c.state == CANOPEN_SDO_DONE) {
			assert_int_equal(c.len, 26);
			assert_memory_equal(c.data, "Tiny Node - Mega Domains !", 26);
		}
	}
	assert_int_equal(c.state, CANOPEN_SDO_DONE);
	assert_int_equal(transfers, 6);
	assert_int_equal(requests, 12);
	free(text);
}

int main(void)
{
	static const char *const names[] = {STARTUP_LOG, STARTUP_TEXT, ABORTS, EXAMPLES};

	for (size_t i = 0; i < sizeof names / sizeof names[0]; i++) {
		size_t len;
		uint8_t *bytes = capture_file(names[i], &len);

		if (!bytes) {
			printf("the captures are not here: " CAPTURES "%s\n", names[i]);
			return 77;
		}
		free(bytes);
	}
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(both_forms_of_the_start_up_hold_the_same_frames),
	    cmocka_unit_test(the_two_drives_start_as_documented),
	    cmocka_unit_test(our_mapping_is_written_as_in_the_start_up),
	    cmocka_unit_test(aborts_are_told_with_object_and_reason),
	    cmocka_unit_test(the_published_examples_are_ours_byte_for_byte),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}

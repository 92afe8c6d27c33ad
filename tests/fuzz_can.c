/* Laws L7 and L8: no recorded bytes crash the decoder of an angle in CAN frames or its dialogue, or give an angle that is no
 * number or out of range; a frame that is read is written again byte for byte, a field that is put is read again; a decoder
 * that goes on from its snapshot says what the first one says. The first twelve bytes choose the signal. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "drivers/can_bus.h"
#include "drivers/can_signal.h"
#include "drivers/driver.h"

#define HEAD 12

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void must(bool condition)
{
	if (!condition)
		abort();
}

struct seen {
	struct dialogue *dialogue;
	double sum_rad;
	int tilts;
};

static void take_tilt(void *ctx, int device, const struct tilt *tilt)
{
	struct seen *seen = ctx;

	(void)device;
	must(fabs(tilt->angle_rad) <= TRIG_ANGLE_MAX);
	seen->sum_rad += tilt->angle_rad;
	seen->tilts++;
	if (seen->dialogue)
		driver_can.dialogue_data(seen->dialogue, 0);
}

static void take_reply(void *ctx, int device, const struct reply *reply)
{
	struct seen *seen = ctx;
	struct dialogue_step step;

	(void)device;
	driver_can.dialogue_reply(seen->dialogue, reply);
	for (int64_t t_ns = 0; t_ns < 4000000000; t_ns += 1000000000) {
		driver_can.dialogue_step(seen->dialogue, t_ns, &step);
		must(step.write_len == 0);
		must(memchr(step.error, 0, sizeof step.error) != NULL);
	}
}

static struct config_signal signal_of(const uint8_t *head)
{
	struct config_signal s = {.set = true, .id = head[0] & 15, .extended = head[0] & 16};

	s.order = head[0] & 32 ? SIGNAL_MOTOROLA : SIGNAL_INTEL;
	s.type = (head[0] >> 6) % 3;
	s.start = head[1] * 2 + (head[2] & 1);
	s.length = s.type == SIGNAL_FLOAT ? (head[3] & 1 ? 32 : 64) : head[3] % 64 + 1;
	s.scale = head[2] & 2 ? 1e-3 : -1e300;
	s.offset = head[2] & 4 ? 0.5 : 0;
	s.wrap = head[2] & 8 ? 1000 : 0;
	s.min_dlc = head[2] & 16 ? head[4] % 65 : 0;
	s.counter.set = head[2] & 32;
	s.counter.start = head[5] * 2;
	s.counter.length = head[6] % 32 + 1;
	s.valid.set = head[2] & 64;
	s.valid.bit = head[7] * 2;
	s.valid.value = head[7] & 1;
	s.mux.set = head[2] & 128;
	s.mux.start = head[8] * 2;
	s.mux.length = head[9] % 32 + 1;
	s.mux.value = head[10];
	return s;
}

static void must_write_the_same(const struct config_signal *s, const uint8_t *data, size_t size)
{
	struct can_frame_at f, made = can_signal_frame(s);
	struct can_signal_value v, again;
	uint8_t back[CAN_WIRE_ENTRY_FD];
	ssize_t n = can_wire_get(data, size, &f);

	if (n <= 0)
		return;
	must((size_t)n <= size);
	must((size_t)n == can_wire_put(&f, back));
	must(memcmp(back, data, 6) == 0 && memcmp(back + 8, data + 8, f.len) == 0);
	must(memcmp(back + n - 8, data + n - 8, 8) == 0);
	if (f.len <= 8 && f.flags == 0) {
		const struct can_frame_at same = can_wire_frame(f.id, f.data, f.len);

		must(same.id == f.id && same.len == f.len && memcmp(same.data, f.data, sizeof f.data) == 0);
	}
	if (s->counter.set || s->valid.set || s->mux.set || can_signal_get(s, &f, &v) != CAN_SIGNAL_GOOD)
		return; /* fields may lie over each other */
	can_signal_put_bits(s, v.bits, &made);
	can_signal_put_counter(s, 1, &made);
	must(can_signal_get(s, &made, &again) == CAN_SIGNAL_GOOD && again.bits == v.bits);
	can_signal_put(s, v.value, &made);
}

static void must_go_on_alike(struct decoder *first, const struct config_device *device, const struct record *record)
{
	struct decoder *second = driver_can.decoder_create(device, 0);
	struct seen a = {0}, b = {0};
	uint8_t bytes[1024];
	struct state s;

	must(second != NULL);
	state_save(&s, bytes, sizeof bytes);
	driver_can.state(first, &s);
	must(state_done(&s));
	state_load(&s, bytes, s.at);
	driver_can.state(second, &s);
	must(state_done(&s));
	driver_can.decode(first, record, &(struct record_sink){.ctx = &a, .tilt = take_tilt});
	driver_can.decode(second, record, &(struct record_sink){.ctx = &b, .tilt = take_tilt});
	must(a.tilts == b.tilts && memcmp(&a.sum_rad, &b.sum_rad, sizeof a.sum_rad) == 0);
	driver_can.decoder_destroy(second);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct config config = {.devices = 1};
	struct record record = {.log_ns = 1, .t_ns = 1, .direction = LINK_OPENED, .bytes = data + HEAD};
	struct decoder_counters counters;
	struct decoder_timing timing;
	struct decoder *decoder;
	struct seen seen = {0};
	struct dialogue_step step;

	if (size < HEAD)
		return 0;
	strcpy(config.device[0].name, "servo");
	strcpy(config.device[0].connect, "can0");
	config.device[0].timeout_ns = 500000000;
	config.device[0].angle = signal_of(data);
	decoder = driver_can.decoder_create(&config.device[0], 0);
	seen.dialogue = driver_can.dialogue_create(&config, 0);
	must(decoder && seen.dialogue);
	const struct record_sink sink = {.ctx = &seen, .tilt = take_tilt, .reply = take_reply};

	driver_can.dialogue_reset(seen.dialogue, 0);
	driver_can.decode(decoder, &record, &sink);
	record.direction = FROM_DEVICE;
	record.len = size - HEAD;
	must_write_the_same(&config.device[0].angle, record.bytes, record.len);
	driver_can.decode(decoder, &record, &sink);
	driver_can.counters(decoder, &counters);
	must(counters.n > 0 && counters.n <= DECODER_COUNTERS_MAX);
	driver_can.timing(decoder, &timing);
	must_go_on_alike(decoder, &config.device[0], &record);
	driver_can.dialogue_stop(seen.dialogue, 1);
	driver_can.dialogue_step(seen.dialogue, 1, &step);
	must(step.state == DIALOGUE_FAILED);
	driver_can.dialogue_destroy(seen.dialogue);
	driver_can.decoder_destroy(decoder);
	return 0;
}

/* Laws L7 and L8: no recorded bytes crash the servo's decoder or its dialogue, or give an angle that is no number; a
 * record that is taken is written again byte for byte, and a snapshot goes on as what it was taken of. The first two bytes
 * choose how the registers are read, the last one what else the drive has: sequences, strobe, watchdog, status. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "drivers/modbus_parts.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void must(bool condition)
{
	if (!condition)
		abort();
}

static void take_tilt(void *ctx, int device, const struct tilt *tilt)
{
	(void)ctx;
	(void)device;
	must(isfinite(tilt->angle_rad));
}

static void take_reply(void *ctx, int device, const struct reply *reply)
{
	struct dialogue_step step;

	(void)device;
	driver_modbus.dialogue_reply(ctx, reply);
	driver_modbus.dialogue_step(ctx, reply->t_ns, &step);
	must(step.write_len <= sizeof step.write);
	must(strlen(step.error) < sizeof step.error);
}

static struct config config_of(uint8_t how, uint8_t sweep)
{
	struct config config = {.devices = 1};
	struct config_device *d = &config.device[0];
	struct config_register r = {.set = true,
	                            .function = how & 64 ? 4 : 3,
	                            .type = (how & 7) % 5,
	                            .order = how >> 3 & 3,
	                            .scale = 1e-5,
	                            .zero = how & 128 ? 1000.0 : 0.0,
	                            .sign = how & 32 ? -1 : 1};

	strcpy(d->name, "servo");
	d->slave = 1;
	d->position = d->target = d->speed = r;
	d->target.address = 2;
	d->speed.address = 4;
	config.sweep.set = sweep & 1;
	strcpy(config.sweep.device, "servo");
	config.sweep.from_rad = -0.2;
	config.sweep.to_rad = 0.1;
	config.sweep.speed_rad_s = 0.05;
	config.sweep.profile = (sweep >> 1 & 3) % 3;
	config.sweep.step_rad = sweep & 8 ? 0.0 : 0.03;
	d->write.n = sweep & 16 ? 2 : 0;
	d->target.set = !(sweep & 32);
	d->speed.set = !(sweep & 64);
	config.sweep.has_rest = sweep & 128;
	config.sweep.rest_rad = 0.01;
	return config;
}

/* Registers 6 (status), 16 (control), 20 (watchdog). */
static void equip(struct config_device *d, uint8_t more)
{
	struct config_write wait = {.address = 16, .value = 15};

	wait.until.set = true;
	wait.until.address = 6;
	wait.until.mask = 4;
	wait.until.value = 4;
	wait.until.within_ns = 1000;
	if (more & 1)
		d->write.item[d->write.n++] = wait;
	if (more & 2)
		d->reset.item[d->reset.n++] = wait;
	if (more & 4)
		d->stop.item[d->stop.n++] = wait;
	d->strobe.set = more & 8;
	d->strobe.address = 16;
	d->strobe.on = 31;
	d->watchdog.set = more & 16;
	d->watchdog.address = 20;
	d->watchdog.toggle = 1;
	d->watchdog.period_ns = 100;
	d->status.set = more & 32;
	d->status.function = more & 64 ? 4 : 3;
	d->status.address = 6;
	d->status.fault = 8;
	d->following_rad = more & 128 ? 0.1 : 0.0;
}

/* What is saved is loaded and saved the same; what is hostile is refused. */
static void must_go_on_from_a_snapshot(struct decoder *decoder, const struct config_device *device, const uint8_t *data,
                                       size_t size)
{
	static uint8_t once[1 << 16], twice[1 << 16];
	struct decoder *other = driver_modbus.decoder_create(device, 0);
	struct decoder_counters counters;
	struct decoder_timing timing;
	struct state s;
	size_t len;

	must(other != NULL);
	driver_modbus.counters(decoder, &counters);
	driver_modbus.timing(decoder, &timing);
	state_load(&s, data, size);
	driver_modbus.state(other, &s);
	state_save(&s, once, sizeof once);
	driver_modbus.state(decoder, &s);
	len = s.at;
	must(state_done(&s));
	state_load(&s, once, len);
	driver_modbus.state(other, &s);
	must(state_done(&s));
	state_save(&s, twice, sizeof twice);
	driver_modbus.state(other, &s);
	must(s.at == len && memcmp(once, twice, len) == 0);
	driver_modbus.decoder_destroy(other);
}

static void must_write_the_same(const uint8_t *data, size_t size)
{
	struct modbus_transaction t;
	uint8_t back[MODBUS_WIRE_MAX];
	ssize_t n = modbus_wire_get(data, size, &t);

	if (n <= 0)
		return;
	must((size_t)n <= size);
	must(modbus_wire_put(&t, back) == (size_t)n);
	must(memcmp(back, data, (size_t)n) == 0);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct config config;
	struct decoder *decoder;
	struct dialogue *dialogue;
	struct record record = {.bytes = data + 2};

	if (size < 2)
		return 0;
	config = config_of(data[0], data[1]);
	equip(&config.device[0], data[size - 1]);
	decoder = driver_modbus.decoder_create(&config.device[0], 0);
	dialogue = driver_modbus.dialogue_create(&config, 0);
	must(decoder && dialogue);
	struct record_sink sink = {.ctx = dialogue, .tilt = take_tilt, .reply = take_reply};

	driver_modbus.dialogue_reset(dialogue, 0);
	record.len = size - 2;
	must_write_the_same(record.bytes, record.len);
	driver_modbus.decode(decoder, &record, &sink);
	record.direction = TO_DEVICE;
	driver_modbus.decode(decoder, &record, &sink);
	must_go_on_from_a_snapshot(decoder, &config.device[0], record.bytes, record.len);
	driver_modbus.dialogue_stop(dialogue, 1);
	driver_modbus.dialogue_destroy(dialogue);
	driver_modbus.decoder_destroy(decoder);
	return 0;
}

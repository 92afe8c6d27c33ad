/* The servo of the simulator as a configuration, and what its decoder finds: for the tests of the Modbus driver. */
#ifndef FACET_TESTS_MODBUS_SERVO_H
#define FACET_TESTS_MODBUS_SERVO_H

#include <string.h>

#include "core/trig.h"
#include "drivers/modbus_parts.h"
#include "tools/simulator.h"

#define DEG TRIG_DEG
#define MS  INT64_C(1000000)

static inline struct config_register milli(uint16_t address)
{
	return (struct config_register){.set = true,
	                                .function = 3,
	                                .address = address,
	                                .type = REGISTER_I32,
	                                .order = ORDER_ABCD,
	                                .scale = 0.001 * DEG,
	                                .sign = 1};
}

/* The servo of the simulator: angles count up there, so its sign is -1. */
static inline struct config servo_config(void)
{
	struct config config = {.devices = 1};
	struct config_device *d = &config.device[0];

	strcpy(d->name, "servo");
	strcpy(d->driver, "modbus");
	d->slave = 1;
	d->parity = 'N';
	d->baud = 115200;
	d->period_ns = 2 * MS;
	d->position = milli(SIM_SERVO_POSITION);
	d->target = milli(SIM_SERVO_TARGET);
	d->speed = milli(SIM_SERVO_SPEED);
	d->position.sign = d->target.sign = -1;
	config.sweep.set = true;
	strcpy(config.sweep.device, "servo");
	config.sweep.from_rad = -20.0 * DEG;
	config.sweep.to_rad = 30.0 * DEG;
	config.sweep.speed_rad_s = 40.0 * DEG;
	return config;
}

struct seen {
	int tilts, replies, kind;
	struct tilt tilt;
};

static inline void see_tilt(void *ctx, int device, const struct tilt *tilt)
{
	struct seen *seen = ctx;

	(void)device;
	seen->tilts++;
	seen->tilt = *tilt;
}

static inline void see_reply(void *ctx, int device, const struct reply *reply)
{
	struct seen *seen = ctx;

	(void)device;
	seen->replies++;
	seen->kind = reply->kind;
}

static inline struct record_sink sink_of(struct seen *seen)
{
	return (struct record_sink){.ctx = seen, .tilt = see_tilt, .reply = see_reply};
}

#endif

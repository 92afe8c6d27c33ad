/* A simulated device's brain: bytes and time in, bytes and a deadline out; no descriptor, no clock, no thread. So the
 * same device stands behind a pseudo-terminal, a TCP port, a USB gadget, or a driver's seam in virtual time.
 *
 *   host ─ bytes ─► receive ─► [device, mirror, scene] ─► transmit ─ bytes ─► host
 *
 * The owner calls `advance` with the time, then takes what has left the device with `transmit` until it answers 0, and
 * comes back at `deadline`. Times are the owner's, they never go back. */
#ifndef FACET_TOOLS_SIM_DEVICE_H
#define FACET_TOOLS_SIM_DEVICE_H

#include "tools/simulator.h"

#define SIM_FAULT_TEXT_MAX 48

/* A fault to order: "laser: garbage at 3s for 2s" is {device "laser", kind "garbage", at 3 s, for 2 s}. `value`: kinds
 * that take one, "sfa 3", "drift 200". Kinds are listed by the device. */
struct sim_fault {
	char device[32], kind[SIM_FAULT_TEXT_MAX];
	double value;
	int64_t at_ns, for_ns; /* since the scenario's start; for_ns 0: once, for events; INT64_MAX: for ever */
};

/* What a device did, for comparison with what its reader counted. */
struct sim_counts {
	uint64_t profiles;  /* measured while streaming was on */
	uint64_t sent;      /* telegrams with a profile that left whole and right */
	uint64_t corrupted; /* ... that left with a wrong byte */
	uint64_t dropped;   /* ... that never left: a fault, or a busy line */
	uint64_t garbage;   /* bytes that belong to no telegram */
	uint64_t requests, replies;
	uint64_t power_cycles, reconnects;
};

struct sim_device {
	void *ctx;
	void (*receive)(void *ctx, const uint8_t *bytes, size_t len, int64_t t_ns);
	void (*advance)(void *ctx, int64_t t_ns);
	/* Up to `cap` bytes that have left the device by the time of the last call; never more than one USB transfer's worth. */
	size_t (*transmit)(void *ctx, uint8_t *buf, size_t cap);
	int64_t (*deadline)(void *ctx); /* of the next advance; INT64_MAX: none */
	/* The other end (a TCP client, a USB host, whoever opened the line) came or went. */
	void (*connected)(void *ctx, bool yes, int64_t t_ns);
	/* Serial lines: the rate at which the host's end stands now. NULL where there is none. */
	void (*host_baud)(void *ctx, uint32_t baud);
	/* False: this device has no such kind; the owner then offers it to the transport, last it is an error. */
	bool (*fault)(void *ctx, const struct sim_fault *, bool on, int64_t t_ns);
	const char *const *fault_kinds; /* ends with NULL */
	void (*counts)(const void *ctx, struct sim_counts *ret);
	void (*destroy)(void *ctx);
};

#endif

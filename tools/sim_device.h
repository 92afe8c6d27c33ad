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
#define SIM_TRANSFER_MAX   16384 /* what one transmit gives at most */

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
	/* Up to `cap` bytes that have left the device by the time of the last call, of one piece: as the device gave them to
	 * its stack or its line. Pieces begin and end where telegrams do, unless a telegram was segmented. */
	size_t (*transmit)(void *ctx, uint8_t *buf, size_t cap);
	int64_t (*deadline)(void *ctx); /* of the next advance; INT64_MAX: none */
	/* The other end (a TCP client, a USB host, whoever opened the line) came or went. */
	void (*connected)(void *ctx, bool yes, int64_t t_ns);
	/* False: it has no power; nobody finds it then. NULL: it always has. */
	bool (*alive)(const void *ctx);
	/* Serial lines: the rate at which the host's end stands now. NULL where there is none. */
	void (*host_baud)(void *ctx, uint32_t baud);
	/* Played recordings are paced by their reader. Does it wait to hear that all it sent was taken by its reader? Then the
	 * owner says so once. NULL: never. */
	bool (*awaits)(const void *ctx);
	void (*taken)(void *ctx, int64_t t_ns);
	/* One more reader of the same device, who has to come before it gets anything (several TCP clients). False, or NULL:
	 * there can be no more. It is destroyed before the device. */
	bool (*session)(void *ctx, struct sim_device *ret);
	/* False: this device has no such kind; the owner then offers it to the transport, last it is an error. */
	bool (*fault)(void *ctx, const struct sim_fault *, bool on, int64_t t_ns);
	const char *const *fault_kinds; /* ends with NULL */
	void (*counts)(const void *ctx, struct sim_counts *ret);
	void (*destroy)(void *ctx);
};

/* The brains. The scene is copied, what it points to is borrowed. 0 or -ENOMEM; ret->destroy frees. */
int sim_lms2xx_create(const struct sim_lms2xx_params *, const struct scene *, int64_t t_ns, struct sim_device *ret);

int sim_cola_create(const struct sim_cola_params *, const struct scene *, int64_t t_ns, struct sim_device *ret);

/* One of a brain's faults, as it stands: on until it is taken back, or owed so many times. */
struct sim_fault_state {
	bool on;
	int owed;
	double value; /* 0: the kind's default */
};
/* Index of `kind` among names that end with NULL, or -1. */
int sim_fault_index(const char *const *kinds, const char *kind);
/* Orders it or takes it back. */
void sim_fault_set(struct sim_fault_state *, const struct sim_fault *, bool on);
/* Is it due now? What is owed is paid by asking. */
bool sim_fault_due(struct sim_fault_state *);
double sim_fault_value(const struct sim_fault_state *, double otherwise);

/* The same numbers for the same seed, on any machine (splitmix64); 0 <= sim_random < 1. */
uint64_t sim_mix(uint64_t);
double sim_random(uint64_t *state);

#endif

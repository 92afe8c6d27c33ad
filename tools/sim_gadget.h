/* A simulated scanner on USB: a FunctionFS shell around a device's brain (sim_device.h). A real kernel enumerates it. */
#ifndef FACET_TOOLS_SIM_GADGET_H
#define FACET_TOOLS_SIM_GADGET_H

#include "tools/sim_device.h"

struct sim_gadget_params {
	const char *name;       /* unlike any other gadget's on this machine, e.g. "laser" */
	const char *serial;     /* serial number in its descriptor; NULL: none */
	const char *title;      /* product, e.g. "TiM561" */
	const char *controller; /* "dummy_udc.0"; NULL: the first free one */
};

/* What the shell saw of its host. */
struct sim_gadget_seen {
	uint64_t plugged;         /* how often it was plugged in */
	uint64_t enabled;         /* how often the host configured it */
	int64_t first_request_ns; /* from the last plugging to the first bytes from the host; -1: none so far */
	uint64_t halts;           /* endpoint halted (STALL) ... */
	uint64_t halts_cleared;   /* ... and data taken again afterwards */
};

struct sim_gadget;
/* Plugged in. Takes the device over, also when it fails: NULL with one sentence in `error`. */
struct sim_gadget *sim_gadget_create(uv_loop_t *, const struct sim_device *, const struct sim_gadget_params *,
                                     char error[160]);
void sim_gadget_destroy(struct sim_gadget *); /* pulled out; the loop must run once more */
/* The device's faults and the shell's own: "unplug" (without a duration: back after a second), "reset" (away and back at
 * once), "halt" (STALL of the IN endpoint until the host clears it), "zlp" (a packet without bytes after every transfer),
 * "short" (every transfer cut in two). False: no such kind. */
bool sim_gadget_fault(struct sim_gadget *, const struct sim_fault *, bool on);
const char *const *sim_gadget_fault_kinds(void); /* the shell's own; ends with NULL */
void sim_gadget_seen(const struct sim_gadget *, struct sim_gadget_seen *ret);

#endif

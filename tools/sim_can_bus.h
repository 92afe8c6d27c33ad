/* A CAN bus of simulated nodes (brains, struct sim_device, whose pieces are rows of can_wire entries in both directions),
 * and its other end: a unix socket for programs that know can_wire, a real interface, or both.
 *
 *   brain ─┐                         ┌─ hub: SOCK_SEQPACKET at a path, one entry a message, CLOCK_REALTIME stamps
 *   brain ─┼── frames, each to all ──┤
 *   brain ─┘   others                └─ AF_CAN: the nodes sit on `can1`, with the kernel's stamps
 *
 * A client of the hub gets every frame of the brains and of the other clients, and its own ones back with the time at which
 * they were on the bus. One that does not read loses frames and is told by nothing; the bus never waits for it.
 *
 * What a brain receives comes with its time on the bus as `t_ns` (the owner's clock, uv_hrtime) of both the call and the
 * entry; on a real interface the entry has the kernel's stamp, which is a little older than the call. The times in what a
 * brain transmits say nothing: a frame is on the bus at the time of the `advance` before. */
#ifndef FACET_TOOLS_SIM_CAN_BUS_H
#define FACET_TOOLS_SIM_CAN_BUS_H

#include "tools/sim_device.h"

#define SIM_CAN_BUS_NODES   8
#define SIM_CAN_BUS_CLIENTS 16 /* one more is closed at once */

/* Faults:
 *   "bus-off"    the controller of the other end is off: it is told so, nothing passes, and at the end "restarted"
 *   "warning", "passive"   it is told that its controller warns, is passive; at the end, active again
 *   "errors"     so many bus errors a second (1000), each an error frame
 *   "no ack"     error frames without an acknowledgement, once or a hundred a second
 *   "drop"       share of the frames that get lost, each way (1)
 *   "late"       what nodes send arrives so many ms after it was on the bus (20)
 *   "rtr", "extended", "fd"   every frame of a brain is followed by a twin: a request for it; the same number as an id of
 *                29 bits, with other data; the same as an FD frame of 64 bytes
 *   "full"       hub: what clients send is not taken, until their sockets have no more room
 *   "down", "deleted"   hub: clients are closed and refused; the socket's file is gone as well */
struct sim_can_bus_params {
	const char *path;      /* of the hub's socket; replaced when nobody listens on it. NULL: ... */
	const char *interface; /* ... nodes on this one; it is never configured here */
	uint64_t seed;
};

struct sim_can_bus;
/* NULL with one sentence. */
struct sim_can_bus *sim_can_bus_create(uv_loop_t *, const struct sim_can_bus_params *, char error[160]);
void sim_can_bus_destroy(struct sim_can_bus *); /* and its nodes; the loop must run once more */
/* Takes the brain over, also when it fails: the node's number, or -ENOSPC. */
int sim_can_bus_attach(struct sim_can_bus *, const struct sim_device *);
/* One of the bus's faults, or of a node's. False: no such kind. */
bool sim_can_bus_fault(struct sim_can_bus *, const struct sim_fault *, bool on);
bool sim_can_bus_node_fault(struct sim_can_bus *, int node, const struct sim_fault *, bool on);
const char *const *sim_can_bus_fault_kinds(const struct sim_can_bus *); /* of the bus; a real interface has fewer */

struct sim_can_bus_counts {
	uint64_t frames;   /* of brains that were on the bus */
	uint64_t received; /* from clients or the interface */
	uint64_t refused;  /* of those, what is no entry or may not be sent */
	uint64_t dropped;  /* by a fault, or because the interface had no room */
	uint64_t missed;   /* by clients that did not read */
	uint64_t errors;   /* error frames */
	int clients;
	uint64_t connections;
};
void sim_can_bus_counts(const struct sim_can_bus *, struct sim_can_bus_counts *ret);

#endif

/* The serial lines of this machine, read from sysfs and /dev/serial/by-id; no line is opened (that would move DTR). */
#ifndef FACET_TOOLS_SERIAL_LIST_H
#define FACET_TOOLS_SERIAL_LIST_H

#include <stdint.h>

#define SERIAL_LIST_MAX   32 /* lines; more are not listed */
#define SERIAL_STRING_MAX 64

struct serial_line {
	char node[64];            /* /dev/ttyUSB0: may be another one after it was plugged in again */
	char by_id[256];          /* /dev/serial/by-id/...: stays with the adapter; empty: udev has made none */
	char driver[32];          /* of the kernel: ftdi_sio, cdc_acm, serial8250 */
	uint16_t vendor, product; /* 0: not on USB */
	char name[SERIAL_STRING_MAX], serial[SERIAL_STRING_MAX]; /* as the adapter says; printable */
	char port[32];                                           /* of USB, BUS-PORT; empty: not on USB */
	int latency_ms; /* how long the adapter holds bytes back; -1: its driver does not say */
};

/* Ordered by node; how many. */
int serial_list(struct serial_line ret[SERIAL_LIST_MAX]);

#endif

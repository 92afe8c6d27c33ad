/* A simulated CANopen drive on standard input and output, for masters of other people: a line is a frame, "602#40..." as
 * candump writes it; "!KIND" orders a fault once. It ends with its input. Prints "angle DEGREES" for the line "?". */
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "core/trig.h"
#include "drivers/can_wire.h"
#include "tools/sim_canopen.h"

static struct sim_device device;

static int64_t now_ns(void)
{
	struct timespec ts;

	clock_gettime(CLOCK_MONOTONIC, &ts);
	return (int64_t)ts.tv_sec * 1000000000 + ts.tv_nsec;
}

static void say(void)
{
	uint8_t buf[4096];
	struct can_frame_at frame;
	size_t len;

	while ((len = device.transmit(device.ctx, buf, sizeof buf)) > 0)
		for (size_t at = 0; at < len; at += CAN_WIRE_ENTRY) {
			can_wire_get(buf + at, len - at, &frame);
			printf("%03X#", frame.id);
			for (int i = 0; i < frame.len; i++)
				printf("%02X", frame.data[i]);
			printf("\n");
		}
	fflush(stdout);
}

static void hear(const char *line)
{
	struct can_frame_at frame = {0};
	struct sim_fault fault = {0};
	uint8_t entry[CAN_WIRE_ENTRY_FD];
	unsigned id, byte;
	int at = 0;

	if (line[0] == '!') {
		snprintf(fault.kind, sizeof fault.kind, "%.*s", (int)strcspn(line + 1, "\n"), line + 1);
		if (!device.fault(device.ctx, &fault, true, now_ns()))
			fprintf(stderr, "canopen_node: no such fault: %s\n", fault.kind);
	} else if (line[0] == '?') {
		printf("angle %.6f\n", sim_axis_angle(sim_canopen_axis(&device), now_ns()) / TRIG_DEG);
	} else if (sscanf(line, "%x#%n", &id, &at) == 1 && at) {
		frame.id = id;
		for (const char *hex = line + at; frame.len < 8 && sscanf(hex, "%2x", &byte) == 1; hex += 2)
			frame.data[frame.len++] = (uint8_t)byte;
		device.receive(device.ctx, entry, can_wire_put(&frame, entry), now_ns());
	}
}

int main(void)
{
	const struct sim_canopen_params params = {.kind = SIM_CANOPEN_DRIVE, .node = 2};
	struct pollfd in = {.fd = STDIN_FILENO, .events = POLLIN};
	char line[128];

	if (sim_canopen_create(&params, now_ns(), &device) != 0)
		return 1;
	setvbuf(stdin, NULL, _IONBF, 0); /* poll sees what is not read yet */
	for (;;) {
		int64_t t_ns = now_ns(), due_ns = device.deadline(device.ctx);

		if (due_ns > t_ns + 1000000000)
			due_ns = t_ns + 1000000000;
		if (poll(&in, 1, due_ns > t_ns ? (int)((due_ns - t_ns) / 1000000) + 1 : 0) < 0)
			return 1;
		device.advance(device.ctx, now_ns());
		if (in.revents && !fgets(line, sizeof line, stdin))
			break;
		if (in.revents)
			hear(line);
		device.advance(device.ctx, now_ns());
		say();
	}
	device.destroy(device.ctx);
	return 0;
}

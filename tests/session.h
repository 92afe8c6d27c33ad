/* A session of a whole robot in virtual time, kept as the list that the loop would hand to the pipeline: a simulated scanner
 * (its brain alone) in dialogue with its driver, a servo's answers, poses, ticks. Reads are cut at random places, bytes
 * are damaged, links lost, the wall clock is set: the same for the same seed, on any machine. */
#ifndef FACET_TESTS_SESSION_H
#define FACET_TESTS_SESSION_H

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/trig.h"
#include "daemon/pipeline.h"
#include "drivers/modbus_wire.h"
#include "drivers/pose_line.h"
#include "tools/sim_device.h"

#define SESSION_START_NS INT64_C(1732200000000000000)
#define SESSION_STEP_NS  INT64_C(1000000)

enum { SESSION_LASER, SESSION_SERVO, SESSION_POSE };

struct session_entry {
	enum { ENTRY_RECORD, ENTRY_TICK, ENTRY_CLOCK } kind;
	struct record record; /* its bytes are owned */
	int64_t ns;           /* log time of a tick, or how far the wall clock is ahead */
};

struct session {
	struct config config;
	struct session_entry *entry;
	size_t entries, cap;
	uint64_t random;

	/* While it is kept. */
	struct sim_device brain;
	const struct driver *driver;
	struct dialogue *dialogue;
	struct pipeline *pipeline;
	int64_t t_ns, ahead_ns;
	int streams; /* the dialogue came to a stream, and lost it, so often */
	bool streaming;
	uint64_t rows;
};

static inline uint32_t session_random(struct session *s, uint32_t below)
{
	s->random = s->random * 6364136223846793005u + 1442695040888963407u;
	return (uint32_t)((s->random >> 33) % below);
}

static inline void session_feed(const struct session_entry *entry, struct pipeline *pipeline)
{
	if (entry->kind == ENTRY_RECORD)
		pipeline_handle(pipeline, &entry->record);
	else if (entry->kind == ENTRY_TICK)
		pipeline_tick(pipeline, entry->ns);
	else
		pipeline_clock(pipeline, entry->ns);
}

static inline void session_keep(struct session *s, struct session_entry entry)
{
	if (s->entries == s->cap) {
		s->cap = s->cap ? 2 * s->cap : 1024;
		s->entry = realloc(s->entry, s->cap * sizeof *s->entry);
		if (!s->entry)
			abort();
	}
	s->entry[s->entries++] = entry;
	session_feed(&entry, s->pipeline);
}

static inline void session_record(struct session *s, int device, enum direction direction, const void *bytes,
                                  size_t len)
{
	uint8_t *own = malloc(len ? len : 1);

	if (!own)
		abort();
	if (len > 0)
		memcpy(own, bytes, len);
	session_keep(s, (struct session_entry){.kind = ENTRY_RECORD,
	                                       .record = {.log_ns = s->t_ns,
	                                                  .t_ns = s->t_ns,
	                                                  .device = device,
	                                                  .direction = direction,
	                                                  .bytes = own,
	                                                  .len = len}});
}

/* The robot */

static inline void session_scan(void *ctx, struct profile *p)
{
	struct session *s = ctx;

	for (int i = 0; i < p->n; i++) {
		p->range_m[i] = 2.0f + 0.001f * (float)session_random(s, 900);
		p->state[i] = i % 97 == 96 ? BEAM_NO_ECHO : BEAM_OK;
	}
}

/* 30 degrees a second, up and down, and half a second of rest at either end. */
static inline double session_angle(int64_t t_ns)
{
	double t_s = fmod((double)(t_ns - SESSION_START_NS) * 1e-9, 5.0);
	double up = t_s < 2.5 ? t_s : 5.0 - t_s;

	return (up > 2.0 ? 2.0 : up) * 30 * TRIG_DEG - 30 * TRIG_DEG;
}

static inline void session_servo(struct session *s)
{
	int32_t counts = (int32_t)(session_angle(s->t_ns) / (0.001 * TRIG_DEG));
	int64_t rtt_ns = session_random(s, 50) == 0 ? 9 * SESSION_STEP_NS : 800000 + session_random(s, 1500000);
	struct modbus_transaction t = {.t_request_ns = s->t_ns - rtt_ns,
	                               .t_answer_ns = s->t_ns,
	                               .unit = session_random(s, 200) == 0 ? 9 : 1,
	                               .function = 3,
	                               .n = 2,
	                               .value = {(uint16_t)((uint32_t)counts >> 16), (uint16_t)counts}};
	uint8_t bytes[MODBUS_WIRE_MAX];

	session_record(s, SESSION_SERVO, FROM_DEVICE, bytes, modbus_wire_put(&t, bytes));
}

static inline void session_pose(struct session *s)
{
	double t_s = (double)(s->t_ns - SESSION_START_NS) * 1e-9;
	struct pose pose = {.t_ns = s->t_ns + s->ahead_ns - session_random(s, 3000000),
	                    .position_m = {0.4 * t_s, 0.1 * trig_sin(t_s), 0},
	                    .rotation = quat_normalise((struct quat){1, 0, 0, 0.1 * t_s})};
	char line[POSE_LINE_MAX];
	int n = pose_line_print(&pose, line, sizeof line);

	session_record(s, SESSION_POSE, FROM_DEVICE, line, session_random(s, 100) == 0 ? 5 : (size_t)n);
}

/* What the scanner sent, cut like reads are; a byte is damaged now and then. */
static inline void session_laser(struct session *s)
{
	uint8_t bytes[SIM_TRANSFER_MAX];
	size_t len;

	s->brain.advance(s->brain.ctx, s->t_ns);
	while ((len = s->brain.transmit(s->brain.ctx, bytes, sizeof bytes)) > 0)
		for (size_t at = 0; at < len;) {
			size_t n = 1 + session_random(s, 900);

			n = n < len - at ? n : len - at;
			if (session_random(s, 150) == 0)
				bytes[at + session_random(s, (uint32_t)n)] ^= 0x41;
			session_record(s, SESSION_LASER, FROM_DEVICE, bytes + at, n);
			at += n;
		}
}

static inline void session_converse(struct session *s)
{
	struct dialogue_step step = {.deadline_ns = INT64_MAX};

	for (int i = 0; i < 8; i++) {
		s->driver->dialogue_step(s->dialogue, s->t_ns, &step);
		if (step.state == DIALOGUE_FAILED)
			s->driver->dialogue_reset(s->dialogue, s->t_ns);
		s->streams += s->streaming != (step.state == DIALOGUE_STREAMING);
		s->streaming = step.state == DIALOGUE_STREAMING;
		if (step.write_len > 0) {
			session_record(s, SESSION_LASER, TO_DEVICE, step.write, step.write_len);
			s->brain.receive(s->brain.ctx, step.write, step.write_len, s->t_ns);
		}
		if (step.baud && s->brain.host_baud)
			s->brain.host_baud(s->brain.ctx, step.baud);
		if (step.write_len == 0 && !step.baud)
			return;
	}
}

static inline void session_open(struct session *s, int device)
{
	if (device == SESSION_LASER) {
		s->brain.connected(s->brain.ctx, false, s->t_ns);
		s->brain.connected(s->brain.ctx, true, s->t_ns);
		s->driver->dialogue_reset(s->dialogue, s->t_ns);
	}
	session_record(s, device, LINK_OPENED, NULL, 0);
}

static inline void session_fault(struct session *s, const char *kind, double value, bool on)
{
	struct sim_fault fault = {.value = value, .for_ns = INT64_MAX};

	snprintf(fault.kind, sizeof fault.kind, "%s", kind);
	if (!s->brain.fault(s->brain.ctx, &fault, on, s->t_ns))
		abort();
}

/* Ragged arrivals, a backlog, telegrams that never come, a power cycle. */
static inline void session_trouble(struct session *s, int64_t step, int64_t steps)
{
	if (step == steps / 5 || step == steps * 2 / 5)
		session_fault(s, "jitter", 8, step == steps / 5);
	if (step == steps * 2 / 5 || step == steps * 2 / 5 + 150)
		session_fault(s, "stall", 0, step == steps * 2 / 5);
	if (step == steps * 9 / 20 || step == steps * 9 / 20 + 60)
		session_fault(s, "silence", 0, step == steps * 9 / 20);
	if (step == steps * 4 / 5 || step == steps * 4 / 5 + 300)
		session_fault(s, "power", 0, step == steps * 4 / 5);
}

static inline void session_step(struct session *s, int64_t step, int64_t steps)
{
	if (step == 0 || step == steps / 2)
		session_open(s, SESSION_LASER);
	if (step == 0 || step == steps * 3 / 4)
		session_open(s, SESSION_SERVO);
	session_trouble(s, step, steps);
	if (step == steps * 5 / 8) {
		s->ahead_ns = 3600 * INT64_C(1000000000);
		session_keep(s, (struct session_entry){.kind = ENTRY_CLOCK, .ns = s->ahead_ns});
	}
	if (step % 7 == 0)
		session_servo(s);
	if (step % 13 == 0)
		session_pose(s);
	session_laser(s);
	session_converse(s);
	if (step % 100 == 0)
		session_keep(s, (struct session_entry){.kind = ENTRY_TICK, .ns = s->t_ns});
}

static inline bool session_row(void *ctx, struct row *row)
{
	((struct session *)ctx)->rows++;
	row_destroy(row);
	return true;
}

static inline void session_flush(void *ctx)
{
	(void)ctx;
}

static inline void session_reply(void *ctx, int device, const struct reply *reply)
{
	struct session *s = ctx;

	if (device == SESSION_LASER)
		s->driver->dialogue_reply(s->dialogue, reply);
}

static inline void session_data(void *ctx, int device, int64_t t_ns)
{
	struct session *s = ctx;

	if (device == SESSION_LASER)
		s->driver->dialogue_data(s->dialogue, t_ns);
}

/* `laser`: the first device as YAML, without its name. The others are servo and pose. */
static inline void session_configure(struct session *s, const char *laser)
{
	char text[2048];
	struct config_error error;
	int n = snprintf(text, sizeof text,
	                 "devices:\n"
	                 "  - {name: laser, %s, range: [0.3, 30]}\n"
	                 "  - {name: servo, driver: modbus, connect: \"127.0.0.1:502\", unit: 1, period: 7ms,\n"
	                 "     position: {function: 3, address: 0, type: i32, scale: 0.001deg}}\n"
	                 "  - {name: pose, driver: pose, listen: \"unix:/tmp/nowhere\"}\n",
	                 laser);

	if (config_read(text, (size_t)n, "session", &s->config, &error) < 0) {
		fprintf(stderr, "%s\n", error.text);
		abort();
	}
}

/* Keeps a session of so many seconds. The brain is taken over; its scene was to call session_scan with `s`. */
static inline void session_run(struct session *s, struct sim_device brain, double seconds)
{
	const struct pipeline_sink sink = {
	    .ctx = s, .row = session_row, .flush = session_flush, .reply = session_reply, .data = session_data};
	const int64_t steps = (int64_t)(seconds * 1e9) / SESSION_STEP_NS;

	s->brain = brain;
	s->driver = driver_find(s->config.device[SESSION_LASER].driver);
	s->dialogue = s->driver->dialogue_create(&s->config, SESSION_LASER);
	s->pipeline = pipeline_create(&s->config, &sink);
	if (!s->dialogue || !s->pipeline)
		abort();
	for (int64_t step = 0; step < steps; step++) {
		s->t_ns = SESSION_START_NS + step * SESSION_STEP_NS;
		session_step(s, step, steps);
	}
	s->driver->dialogue_destroy(s->dialogue);
	s->brain.destroy(s->brain.ctx);
}

static inline void session_finish(struct session *s)
{
	pipeline_destroy(s->pipeline);
	for (size_t i = 0; i < s->entries; i++)
		if (s->entry[i].kind == ENTRY_RECORD)
			free((void *)(uintptr_t)s->entry[i].record.bytes);
	free(s->entry);
}

#endif

/* The parts of the pipeline among themselves: pipeline.c moves what is here, pipeline_state.c keeps and restores it. */
#ifndef FACET_DAEMON_PIPELINE_PARTS_H
#define FACET_DAEMON_PIPELINE_PARTS_H

#include "daemon/pipeline.h"

#define ARRIVALS 64 /* profiles whose arrival is remembered: as many as an assembler lets wait */

struct device {
	const struct driver *driver;
	struct decoder *decoder;
};

struct scanner {
	int device, tilt_device; /* the latter -1: fixed */
	struct sweep *sweep;
	struct {
		int64_t t_ns, log_ns;
	} arrival[ARRIVALS]; /* ring: first beam -> log time of the last byte */
	unsigned arrivals;
	bool begins; /* the row that began a sweep was not applied: the next one does */
};

struct pipeline {
	const struct config *config;
	struct pipeline_sink sink;
	struct pose_track *track;
	struct {
		bool seen;
		int device;
		struct pose_jump jump;
	} jump; /* in the record being handled: the last one of it */
	struct device device[CONFIG_DEVICES_MAX];
	struct scanner scanner[CONFIG_DEVICES_MAX];
	int scanners;
	int64_t log_ns;     /* of the record or tick being handled */
	int64_t arrival_ns; /* of the row being handed out */
	int64_t last_row_ns;
	bool rows_since_flush;
	uint64_t next_number;
	uint64_t *skip; /* ascending */
	size_t skips, skips_cap;
	uint64_t rows, not_applied;
};

#endif

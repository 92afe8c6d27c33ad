/* A row of the matrix of faults, played in the rig: what is ordered, what it must come to, and one line of the table of
 * docs/devices.md, made from what was seen. */
#ifndef FACET_TESTS_MATRIX_H
#define FACET_TESTS_MATRIX_H

#include "tests/rig.h"

#define MATRIX_FAULTS   5
#define MATRIX_COUNTERS 13

struct matrix_fault {
	const char *kind;
	double value;
	int64_t for_ns; /* 0: once; INT64_MAX: for ever */
};

struct matrix_row {
	const char *name;
	const char *does; /* what the driver does, in words */
	struct matrix_fault fault[MATRIX_FAULTS];
	bool from_start;  /* it is so when the device is opened; else it befalls a stream */
	const char *keys; /* further keys of the device, ", baud: 38400" */
	int variant;      /* of the bench: its own meaning */
	/* Counters that move, beside telegrams and profiles; all others must not. */
	struct {
		const char *name;
		int64_t least, most;
	} counted[MATRIX_COUNTERS];
	const char *log;  /* stands in a line of the log since; NULL: there is no line at all */
	int losses;       /* exactly; -1: any number */
	int64_t pause_ns; /* without a profile at most, while it lasts included; 0: it never streams */
	int64_t again_ns; /* a profile at most so long after its end; from_start: after the start */
	bool unlisted;    /* left out of the table: one of many alike */
	double astray;    /* share of the points that may lie elsewhere; 0: one in a thousand */
	/* Of a bench with a drive: what its axis does. */
	enum {
		DRIVE_GOES_ON, /* it never stands, but at its turns */
		DRIVE_RESUMES, /* it stands, and sweeps again at the end */
		DRIVE_HALTS,   /* it stands from then on */
		DRIVE_ANYHOW   /* whatever it does meanwhile, it sweeps at the end */
	} drive;
	int64_t stands_ns;                                      /* at most so long after it began; 0: not judged */
	int64_t sweeps_ns;                                      /* again at most so long after its end; 0: not judged */
	void (*check)(struct rig *, const struct matrix_row *); /* more, may be NULL */
};

struct matrix_bench {
	const char *title, *device;
	struct rig *(*make)(const struct matrix_row *); /* with devices attached, not started */
	/* Counters of whole telegrams with a profile that were left out on purpose; NULL ends. */
	const char *const *left_out;
	const char *const *quiet;            /* counters that move without a fault, not shown; NULL ends */
	const char *const *tolerated;        /* may move a little in any row, shown; NULL ends */
	int64_t setup_ns;                    /* patience with a start without faults */
	const char *points;                  /* whose points are compared; NULL: the device's own */
	double (*speed)(const struct rig *); /* of the drive's axis, now; NULL: there is none */
};

#define MATRIX_ROWS_MAX 100

/* Plays the rows, a test each: what main returns. */
int matrix_run(const struct matrix_bench *, const struct matrix_row *, size_t n);

#endif

/* Inside the simulated CoLa scanners: the device, its sessions, and what its three files share.
 *
 *   sim_cola.c          the device's other end: sessions, power, faults
 *   sim_cola_answers.c  requests in, answers out; what is written changes what is sent
 *   sim_cola_scan.c     models, mirror, clock, telegrams */
#ifndef FACET_TOOLS_SIM_COLA_H
#define FACET_TOOLS_SIM_COLA_H

#include "drivers/cola_wire.h"
#include "tools/sim_line.h"

#define SIM_COLA_SESSIONS 4
#define SIM_COLA_VALUES   12 /* of a variable at most */

struct cola_model {
	const char *name, *version, *driver;
	uint32_t serial;
	uint16_t wire_version; /* of the telegram */
	enum cola_dialect dialect;
	bool monitored; /* LMDscandatamon */
	bool ranging;   /* sends ranges at all */
	bool lms;       /* scan configuration, start and stop of measuring, encoders */
	bool small;     /* 2: no echo, 1: dazzled; else 0 */
	uint32_t hash;  /* of the password of level 3 */
	uint32_t frequency_chz, step_tdeg, measurement_hhz;
	int32_t start_tdeg, stop_tdeg;
	uint32_t range[4]; /* LMPoutputRange as its firmware says it */
	bool stamps_end;
	uint32_t transmit_us; /* after the stamp; 0: a turn of the mirror */
	int64_t boot_ns;
};
const struct cola_model *sim_cola_model(enum sim_cola_model_id);

/* Variables that are kept as they are written. */
enum cola_variable {
	DATA_CONFIG,
	OUTPUT_RANGE,
	SCAN_CONFIG,
	ENCODER_SET,
	ENCODER_SOURCE,
	ENCODER_STEPS,
	OUTPUTS_34,
	CLOCK_ROLE,
	CLOCK_PORT,
	CLOCK_SERVER,
	VARIABLES
};
/* Places in DATA_CONFIG, OUTPUT_RANGE and SCAN_CONFIG. */
enum {
	CONFIG_CHANNEL,
	CONFIG_REMISSION = 2,
	CONFIG_WIDE,
	CONFIG_UNIT,
	CONFIG_ENCODER,
	CONFIG_POSITION = 7,
	CONFIG_NAME,
	CONFIG_COMMENT,
	CONFIG_TIME,
	CONFIG_EVERY
};
enum { RANGE_STEP = 1, RANGE_START, RANGE_STOP };
enum { SCAN_FREQUENCY, SCAN_SECTORS, SCAN_STEP, SCAN_START, SCAN_STOP };

/* Faults of the device, behind those of any line. Settings stay, until taken back where they have a duration. */
#define SIM_COLA_KINDS                                                                                               \
	"no answer", "sfa", "wrong dialect", "power", "drift", "clock step", "clock wrap", "counter wrap", "wander", \
	    "monitored", "name empty", "name blanks", "position", "comment", "time", "event", "encoders", "scale",   \
	    "echoes", "angles", "codes", "busy", "error", "idle", "streaming"
enum sim_cola_fault {
	SIM_COLA_NO_ANSWER = SIM_LINE_FAULTS,
	SIM_COLA_SFA,           /* code; 3 */
	SIM_COLA_WRONG_DIALECT, /* it was set to the other one, by somebody else */
	SIM_COLA_POWER,         /* off so long, then it boots */
	SIM_COLA_DRIFT,         /* ppm; 200 */
	SIM_COLA_CLOCK_STEP,    /* s; 1 */
	SIM_COLA_CLOCK_WRAP,    /* its microseconds wrap so many s from now; 2 */
	SIM_COLA_COUNTER_WRAP,  /* telegram and scan counter wrap after so many telegrams; 10 */
	SIM_COLA_WANDER,        /* turns of the mirror take up to so many ms more or less; 2.4 */
	SIM_COLA_MONITORED,
	SIM_COLA_NAME_EMPTY,
	SIM_COLA_NAME_BLANKS,
	SIM_COLA_POSITION,
	SIM_COLA_COMMENT,
	SIM_COLA_TIME,
	SIM_COLA_EVENT,
	SIM_COLA_ENCODERS, /* so many; 2 */
	SIM_COLA_SCALE,    /* 2 */
	SIM_COLA_ECHOES,   /* so many; 5 */
	SIM_COLA_ANGLES,   /* a channel ANGL1 */
	SIM_COLA_CODES,    /* beams carry the small codes */
	SIM_COLA_BUSY,     /* SCdevicestate 0, STlms 5 */
	SIM_COLA_ERROR_STATE,
	SIM_COLA_IDLE,      /* it does not measure until told to */
	SIM_COLA_STREAMING, /* as to a client that was killed */
	SIM_COLA_FAULTS
};

/* One reader's connection. */
struct cola_session {
	struct cola *device;
	bool used, connected;
	bool streaming, single; /* all scans; the next one, as an answer */
	int level;              /* of access */
	struct framer framer;
	uint8_t heard[4096];
	struct sim_line line;
};

struct cola {
	const struct cola_model *model;
	struct sim_cola_params params;
	struct scene scene;
	struct sim_fault_state fault[SIM_COLA_FAULTS - SIM_LINE_FAULTS];
	struct sim_fault_state line_fault[SIM_LINE_FAULTS]; /* as every session's line has it */
	struct sim_counts counts;
	uint64_t random;
	int64_t now_ns;
	bool off;
	int64_t ready_ns; /* booted then */

	/* settings */
	enum cola_dialect dialect;
	uint32_t value[VARIABLES][SIM_COLA_VALUES];
	char name[64];

	/* clock: at anchor_ns it stood at anchor_us, and runs fast by drift */
	int64_t anchor_ns;
	double anchor_us, drift;
	int64_t on_ns; /* power came */

	/* mirror */
	bool measuring;
	int64_t begin_ns; /* of the full fan's first beam, of the next scan */
	int64_t turn_ns;  /* the next scan's turn takes */
	uint16_t telegram_counter, scan_counter;
	struct profile profile;

	struct cola_session session[SIM_COLA_SESSIONS];
	uint8_t telegram[COLA_TELEGRAM_MAX];
};

static inline struct sim_fault_state *cola_fault(struct cola *d, enum sim_cola_fault kind)
{
	return &d->fault[kind - SIM_LINE_FAULTS];
}

/* sim_cola_answers.c: a whole telegram of a client. */
void sim_cola_answer(struct cola_session *, const uint8_t *frame, size_t len);
void sim_cola_set_factory(struct cola *);

/* sim_cola_scan.c */
uint32_t sim_cola_clock_us(const struct cola *, int64_t t_ns);
void sim_cola_set_clock(struct cola *, double us, double drift_ppm); /* from now on */
void sim_cola_start_mirror(struct cola *);
void sim_cola_turn(struct cola *);          /* measures and sends what is due by now */
int64_t sim_cola_next(const struct cola *); /* when the next scan is sent */

#endif

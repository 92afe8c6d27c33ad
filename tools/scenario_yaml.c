/* The configuration that reaches a scenario's devices. It is also where the simulated nodes of a CAN bus learn what to
 * send: the scenario reads it back (config_read), so that what a frame holds is said once.
 *
 * Simulated servos count up where the scanner looks up, so every sign is -1. */
#include <errno.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#include "tools/scenario.h"
#include "tools/sim_drive.h"

#define YAML_SWEEP "sweep: {device: servo, from: -65deg, to: 45deg, speed: 30deg, profile: triangle}\n"
#define LIMITS     "limits: [-70deg, 50deg]"

static const struct {
	const char *driver;
	int range_m;
} lasers[SCENARIO_LASERS] = {[SCENARIO_LMS2XX] = {"lms2xx", 30},
                             [SCENARIO_TIM] = {"tim", 25},
                             [SCENARIO_LMS1XX] = {"lms1xx", 20},
                             [SCENARIO_LMS5XX] = {"lms5xx", 30}};

static const struct {
	const char *word;
	bool commanded, on_can;
} servos[SCENARIO_SERVOS] = {[SCENARIO_MODBUS] = {"modbus", true, false},
                             [SCENARIO_MODBUS_TCP] = {"modbus-tcp", true, false},
                             [SCENARIO_CAN] = {"can", false, true},
                             [SCENARIO_CANOPEN] = {"canopen", true, true},
                             [SCENARIO_CANOPEN_CYCLIC] = {"canopen-cyclic", true, true},
                             [SCENARIO_CANOPEN_VELOCITY] = {"canopen-velocity", true, true},
                             [SCENARIO_CAN_ENCODER] = {"encoder", false, true},
                             [SCENARIO_INCLINOMETER] = {"inclinometer", false, true},
                             [SCENARIO_FIXED] = {"fixed", false, false}};

enum scenario_laser scenario_laser(const char *driver)
{
	int i = 0;

	while (i < SCENARIO_LASERS && strcmp(lasers[i].driver, driver) != 0)
		i++;
	return (enum scenario_laser)i;
}

enum scenario_servo scenario_servo(const char *word)
{
	int i = 0;

	if (!strcmp(word, "rtu"))
		return SCENARIO_MODBUS;
	if (!strcmp(word, "tcp"))
		return SCENARIO_MODBUS_TCP;
	while (i < SCENARIO_SERVOS && strcmp(servos[i].word, word) != 0)
		i++;
	return (enum scenario_servo)i;
}

const char *scenario_servo_word(enum scenario_servo servo)
{
	return servos[servo].word;
}

bool scenario_servo_commanded(enum scenario_servo servo)
{
	return servos[servo].commanded;
}

bool scenario_uses_can(const struct scenario_params *params)
{
	return servos[params->servo].on_can || params->odometry != SCENARIO_NO_ODOMETRY;
}

/* ---- writing ---- */

struct text {
	char *at;
	size_t cap, len; /* len == cap: it had no room */
};

static void add(struct text *text, const char *format, ...) __attribute__((format(printf, 2, 3)));

static void add(struct text *text, const char *format, ...)
{
	va_list args;
	int n;

	va_start(args, format);
	n = vsnprintf(text->at + text->len, text->cap - text->len, format, args);
	va_end(args);
	text->len = n < 0 || (size_t)n >= text->cap - text->len ? text->cap : text->len + (size_t)n;
}

static void add_laser(struct text *text, const struct scenario_params *params, int port)
{
	const char *driver = lasers[params->laser].driver;

	add(text, "  - {name: laser, driver: %s, ", driver);
	if (params->laser == SCENARIO_LMS2XX)
		add(text, "port: \"%s/laser\", baud: 500000, variant: 180/0.5,\n     ", params->dir);
	else if (params->usb)
		add(text, "connect: \"usb\", ");
	else
		add(text, "connect: \"127.0.0.1:%d\", ", port);
	if (params->encoder)
		add(text, "encoder: {scale: %gdeg, sign: -1}, ", SCENARIO_TICK_DEG);
	add(text, "range: [0.3, %d], tilt: ", lasers[params->laser].range_m);
	if (params->servo == SCENARIO_FIXED)
		add(text, "%gdeg}\n", SCENARIO_FIXED_DEG);
	else
		add(text, "%s}\n", params->encoder ? "laser" : "servo");
}

static void add_modbus(struct text *text, const struct scenario_params *params, bool sweeps, int port)
{
	add(text, "  - {name: servo, driver: modbus, ");
	if (params->servo == SCENARIO_MODBUS_TCP)
		add(text, "connect: \"127.0.0.1:%d\", ", port);
	else
		add(text, "connect: \"%s/servo\", parity: none, ", params->dir);
	/* A played recording waits for the servo's answers at every line, so it is polled faster. */
	add(text,
	    "unit: %d, period: %s,\n"
	    "     position: {function: 3, address: %d, type: i32, scale: 0.001deg, sign: -1},\n"
	    "     target: {function: 16, address: %d, type: i32, scale: 0.001deg, sign: -1},\n"
	    "     speed: {function: 16, address: %d, type: u32, scale: 0.001deg}",
	    SCENARIO_UNIT, sweeps ? "5ms" : "2ms", SIM_DRIVE_POSITION, SIM_DRIVE_TARGET, SIM_DRIVE_SPEED);
	if (sweeps)
		add(text,
		    ",\n     status: {address: %d, fault: %d}, reset: [{address: %d, value: 0x80}, {address: %d, "
		    "value: 0}],\n"
		    "     watchdog: {address: %d, toggle: 1, period: 100ms}, " LIMITS,
		    SIM_DRIVE_STATUS, SIM_DRIVE_HAS_FAULT, SIM_DRIVE_CONTROL, SIM_DRIVE_CONTROL, SIM_DRIVE_WATCHDOG);
	add(text, "}\n");
}

static void add_bus(struct text *text, const struct scenario_params *params)
{
	if (params->can)
		add(text, "connect: %s,", params->can_config ? params->can_config : params->can);
	else
		add(text, "connect: \"unix:%s/can.sock\",", params->dir);
}

static void add_canopen(struct text *text, const struct scenario_params *params)
{
	add(text, "  - {name: servo, driver: canopen, ");
	add_bus(text, params);
	add(text, " node: %d, sign: -1, sync: 10ms, heartbeat: 200ms,\n     ", SCENARIO_NODE);
	if (params->servo == SCENARIO_CAN_ENCODER)
		add(text, "kind: encoder, scale: 0.001deg, wrap: 1474560000}\n");
	else if (params->servo == SCENARIO_INCLINOMETER)
		add(text, "kind: inclinometer}\n");
	else
		add(text, "kind: drive, scale: 0.001deg, mode: %s, acceleration: 300deg, " LIMITS "}\n",
		    params->servo == SCENARIO_CANOPEN_CYCLIC     ? "cyclic"
		    : params->servo == SCENARIO_CANOPEN_VELOCITY ? "velocity"
		                                                 : "position");
}

static void add_angle(struct text *text, const struct scenario_params *params)
{
	add(text, "  - {name: servo, driver: can, ");
	add_bus(text, params);
	add(text,
	    "\n     angle: {id: 0x123, start: 0, length: 24, scale: -0.001deg, counter: {start: 24, length: 8}, valid: "
	    "{bit: 32}}}\n");
}

static void add_odometry(struct text *text, const struct scenario_params *params)
{
	add(text, "  - {name: odometry, driver: odometry, ");
	add_bus(text, params);
	if (params->odometry == SCENARIO_SPEEDS)
		add(text, " track: 0.5,\n     speed: {id: 0x200, length: 16, scale: 0.1mm/s, counter: {start: 48, "
		          "length: 8}, valid: {bit: "
		          "56}},\n     turn: {id: 0x200, start: 16, length: 24, scale: 0.0001deg/s}}\n");
	else
		add(text,
		    " track: 0.5,\n     left: {id: 0x201, length: 16, type: unsigned, scale: 0.1mm, wrap: 65536, "
		    "counter: "
		    "{start: 32, length: 8}, valid: {bit: 40}},\n"
		    "     right: {id: 0x201, start: 16, length: 16, type: unsigned, scale: 0.1mm, wrap: 65536}}\n");
}

int scenario_yaml(const struct scenario_params *params, bool sweeps, int servo_port, int laser_port, char *ret,
                  size_t cap)
{
	struct text text = {.at = ret, .cap = cap};
	enum scenario_servo servo = params->servo;

	/* A recording has every ray through one point; a played line waits for its reader, so its reader may wait too. */
	add(&text, "# Written by `facet simulate %s`: reaches its simulated devices.\n%sdevices:\n",
	    scenario_is_world(params->name) ? params->name : "...",
	    sweeps ? "mount: {base_tilt: {xyz: [0.2, 0, 0.4]}, tilt_laser: {xyz: [0, 0, 0.05]}}\n"
	           : "map: {hold: 1s}\n");
	add_laser(&text, params, laser_port);
	if (servo == SCENARIO_MODBUS || servo == SCENARIO_MODBUS_TCP)
		add_modbus(&text, params, sweeps, servo_port);
	else if (servo == SCENARIO_CAN)
		add_angle(&text, params);
	else if (servo != SCENARIO_FIXED)
		add_canopen(&text, params);
	if (params->odometry != SCENARIO_NO_ODOMETRY)
		add_odometry(&text, params);
	add(&text, "  - {name: pose, driver: pose, listen: \"unix:%s/pose.sock\"}\n", params->dir);
	if (sweeps && servos[servo].commanded)
		add(&text, YAML_SWEEP);
	add(&text, "listen: {native: [\"unix:%s/facetd.sock\"", params->dir);
	if (params->tcp)
		add(&text, ", \"tcp:%s\"", params->tcp);
	add(&text, "], http: \"%s\"}\n", params->http ? params->http : "");
	return text.len == text.cap ? -ENOSPC : (int)text.len;
}

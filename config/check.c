/* What one key says about another: names that must exist, addresses that must be local, values that fit together. */
#include <ctype.h>
#include <errno.h>
#include <string.h>

#include "config/address.h"
#include "config/reader.h"

#define SET_POINTS_NS_MAX \
	50000000 /* between two; a longer pause is taken for a program that slept (drivers/sweeper.c) */

static int device_line(const struct reader *r, int device, const char *key)
{
	return reader_line(r, r->device_node[device], key);
}

static int check_name(struct reader *r, const struct config *config, int i)
{
	const char *name = config->device[i].name;
	char shown[READER_SHOWN_MAX];
	bool good = isalpha((unsigned char)name[0]);
	for (const char *c = name; *c; c++)
		good = good && (isalnum((unsigned char)*c) || *c == '-' || *c == '_') && (unsigned char)*c < 128;
	if (!good)
		return reader_fail(
		    r, device_line(r, i, "name"),
		    "devices[%d].name: '%s' must begin with a letter and hold letters, digits, - and _ only", i,
		    reader_shown(name, shown));
	for (int j = 0; j < i; j++)
		if (strcmp(config->device[j].name, name) == 0)
			return reader_fail(
			    r, device_line(r, i, "name"),
			    "devices[%d].name: '%s' is also the name of the device of line %d; names are unique", i,
			    name, config->device[j].line);
	return 0;
}

static const struct config_device *find_device(const struct config *config, const char *name)
{
	for (int i = 0; i < config->devices; i++)
		if (strcmp(config->device[i].name, name) == 0)
			return &config->device[i];
	return NULL;
}

static bool is_tilt(const struct config_device *device)
{
	return keys_driver(device->driver) & (KEY_SERVO | KEY_CAN | KEY_CARMEN) || device->encoder.set;
}

/* The name of the first device that tilts, for messages. */
static const char *any_tilt(const struct config *config)
{
	for (int i = 0; i < config->devices; i++)
		if (is_tilt(&config->device[i]))
			return config->device[i].name;
	return "none";
}

static int check_tilt_name(struct reader *r, const struct config *config, const char *key, const char *name, int line)
{
	char shown[READER_SHOWN_MAX];
	const struct config_device *device = find_device(config, name);
	if (!device)
		return reader_fail(r, line, "%s: there is no device '%s'; devices that tilt: %s", key,
		                   reader_shown(name, shown), any_tilt(config));
	if (!is_tilt(device))
		return reader_fail(r, line, "%s: the device '%s' tilts nothing (driver %s); devices that tilt: %s", key,
		                   name, device->driver, any_tilt(config));
	return 0;
}

/* The port where a scanner with CoLa listens (COLA_PORT of its driver). */
#define SCANNER_PORT 2112

static bool is_cola(const struct config_device *device)
{
	return keys_driver(device->driver) & KEY_COLA;
}

static bool is_usb(const struct config_device *device)
{
	return is_cola(device) && strncmp(device->connect, "usb", 3) == 0;
}

/* Several devices may be on one bus; on Modbus each has its own unit. */
static bool is_shared(const struct config_device *a, const struct config_device *b)
{
	const unsigned mine = keys_driver(a->driver), theirs = keys_driver(b->driver);
	if (mine & KEY_ON_CAN && theirs & KEY_ON_CAN)
		return true;
	return mine == KEY_MODBUS && theirs == KEY_MODBUS && a->slave != b->slave && a->baud == b->baud &&
	       a->parity == b->parity;
}

/* Two ways to write one address are one line. */
static bool is_same_line(const struct config_device *a, const struct config_device *b)
{
	const char *mine = a->port[0] ? a->port : a->connect, *theirs = b->port[0] ? b->port : b->connect;
	struct address one, other;
	char sentence[ADDRESS_ERROR_MAX];
	if (mine[0] && strcmp(mine, theirs) == 0)
		return true;
	return is_cola(a) && is_cola(b) && !address_parse_number(mine, SCANNER_PORT, &one, sentence) &&
	       !address_parse_number(theirs, SCANNER_PORT, &other, sentence) && strcmp(one.host, other.host) == 0 &&
	       one.port == other.port;
}

static int check_line_shared(struct reader *r, const struct config *config, int i)
{
	const struct config_device *device = &config->device[i];
	const char *key = device->port[0] ? "port" : "connect";
	for (int j = 0; j < i; j++) {
		const struct config_device *other = &config->device[j];
		const bool any = strcmp(device->connect, "usb") == 0 || strcmp(other->connect, "usb") == 0;
		if (is_usb(device) && is_usb(other) && any)
			return reader_fail(r, device_line(r, i, key),
			                   "devices[%d].connect: with two scanners on USB `usb` says too little; write "
			                   "usb:SERIAL or usb:BUS-PORT at both ('%s' is the other)",
			                   i, other->name);
		if (is_same_line(device, other) && !is_shared(device, other))
			return reader_fail(r, device_line(r, i, key), "devices[%d]: '%s' is already the line of '%s'",
			                   i, device->port[0] ? device->port : device->connect, other->name);
	}
	return 0;
}

/* BUS-PORT as the kernel names it, 1-1.2. */
static bool is_usb_port(const char *text)
{
	size_t n = strspn(text, "0123456789");
	if (!n || text[n] != '-')
		return false;
	do {
		const size_t digits = strspn(text + n + 1, "0123456789");
		if (!digits)
			return false;
		n += 1 + digits;
	} while (text[n] == '.');
	return !text[n];
}

/* A serial number is whatever its maker wrote, but a port that is half written is none. */
static bool is_usb_serial(const char *text)
{
	size_t n = 0;
	while (isgraph((unsigned char)text[n]) && (unsigned char)text[n] < 128)
		n++;
	return n && n <= 63 && !text[n] && (!strchr(text, '-') || text[strspn(text, "0123456789-.")]);
}

/* `connect` begins with usb. */
static bool is_usb_connect(const char *connect)
{
	const char *place = connect + 4;
	return !connect[3] || (connect[3] == ':' && (is_usb_port(place) || is_usb_serial(place)));
}

static int check_cola(struct reader *r, const struct config_device *device, int i)
{
	const int line = device_line(r, i, "connect");
	char shown[READER_SHOWN_MAX], sentence[ADDRESS_ERROR_MAX];
	struct address address;
	if (is_usb(device)) {
		if (keys_driver(device->driver) != KEY_TIM)
			return reader_fail(r, line,
			                   "devices[%d].connect: only a tim measures over USB; write HOST[:PORT]", i);
		if (!is_usb_connect(device->connect))
			return reader_fail(
			    r, line,
			    "devices[%d].connect: '%s' is not usb, usb:SERIAL or usb:BUS-PORT (like usb:1-1.2)", i,
			    reader_shown(device->connect, shown));
		return 0;
	}
	if (device->connect[0] == '/')
		return reader_fail(r, line, "devices[%d].connect: a %s has no serial line here; write %sHOST[:PORT]", i,
		                   device->driver, keys_driver(device->driver) == KEY_TIM ? "usb or " : "");
	if (address_parse_number(device->connect, SCANNER_PORT, &address, sentence))
		return reader_fail(r, line, "devices[%d].connect: %s", i, sentence);
	return 0;
}

/* A port that is no path names an adapter: usb:VENDOR:PRODUCT[:SERIAL], as drivers/serial_find.c looks for it. */
static int check_lms2xx(struct reader *r, const struct config_device *device, int i)
{
	static const char hex[] = "0123456789abcdefABCDEF";
	const char *text = device->port;
	char shown[READER_SHOWN_MAX];
	if (strncmp(text, "usb:", 4) != 0)
		return 0;
	const bool good = strspn(text + 4, hex) == 4 && text[8] == ':' && strspn(text + 9, hex) == 4 &&
	                  (!text[13] || (text[13] == ':' && text[14]));
	return good ? 0
	            : reader_fail(r, device_line(r, i, "port"),
	                          "devices[%d].port: '%s' is not usb:VENDOR:PRODUCT[:SERIAL], like usb:0403:6001", i,
	                          reader_shown(text, shown));
}

static int check_modbus(struct reader *r, const struct config_device *device, int i)
{
	const struct {
		const char *name;
		const struct config_register *value;
	} registers[] = {{"position", &device->position}, {"target", &device->target}, {"speed", &device->speed}};
	for (size_t k = 0; k < 3; k++)
		if (registers[k].value->set && registers[k].value->address < device->address_base)
			return reader_fail(r, device_line(r, i, registers[k].name),
			                   "devices[%d].%s.address: with address_base 1 the first register is 1", i,
			                   registers[k].name);
	const struct {
		const char *name;
		const struct config_writes *list;
	} sequences[] = {{"write", &device->write}, {"reset", &device->reset}, {"stop", &device->stop}};
	for (size_t k = 0; k < 3; k++)
		for (int j = 0; j < sequences[k].list->n; j++)
			if (sequences[k].list->item[j].address < device->address_base)
				return reader_fail(r, device_line(r, i, sequences[k].name),
				                   "devices[%d].%s: with address_base 1 the first register is 1", i,
				                   sequences[k].name);
	struct address address;
	char sentence[ADDRESS_ERROR_MAX];
	if (device->connect[0] != '/' && address_parse_host(device->connect, &address, sentence))
		return reader_fail(r, device_line(r, i, "connect"), "devices[%d].connect: %s", i, sentence);
	return 0;
}

/* An interface's name, or a socket. */
static int check_can(struct reader *r, const struct config_device *device, int i)
{
	char shown[READER_SHOWN_MAX], sentence[ADDRESS_ERROR_MAX];
	struct address address;
	const char *c = device->connect;
	if (strncmp(c, "unix:", 5) == 0)
		return address_parse(c, ADDRESS_UNIX, &address, sentence)
		           ? reader_fail(r, device_line(r, i, "connect"), "devices[%d].connect: %s", i, sentence)
		           : 0;
	while (isgraph((unsigned char)*c) && *c != '/' && *c != ':')
		c++;
	return !*c && c - device->connect <= 15
	           ? 0
	           : reader_fail(r, device_line(r, i, "connect"),
	                         "devices[%d].connect: '%s' is no CAN interface (like can0) and no unix:PATH", i,
	                         reader_shown(device->connect, shown));
}

static int check_canopen(struct reader *r, const struct config *config, int i)
{
	const struct config_device *device = &config->device[i];
	if (device->node == device->master)
		return reader_fail(r, device_line(r, i, "node"),
		                   "devices[%d].node: %d is our own id; write another `master`", i, device->node);
	if ((device->sync_ns > 0 && device->sync_ns < 1000000) ||
	    (device->heartbeat_ns > 0 && device->heartbeat_ns < 10000000))
		return reader_fail(r, device->line,
		                   "devices[%d]: `sync` is 0 or at least 1ms, `heartbeat` 0 or at least 10ms", i);
	if (device->count.scale == 0 && (device->kind == CANOPEN_DRIVE || device->kind == CANOPEN_ENCODER))
		return reader_fail(r, device->line, "devices[%d]: `scale` is missing: the angle of one count", i);
	for (int j = 0; j < i; j++) {
		const struct config_device *other = &config->device[j];
		if (keys_driver(other->driver) != KEY_CANOPEN || strcmp(other->connect, device->connect) != 0)
			continue;
		if (other->node == device->node)
			return reader_fail(r, device_line(r, i, "node"),
			                   "devices[%d].node: %d is already the node of '%s'", i, device->node,
			                   other->name);
		if (other->sync_ns > 0 && device->sync_ns > 0)
			return reader_fail(r, device_line(r, i, "sync"),
			                   "devices[%d].sync: '%s' already sends SYNC on %s; write `sync: 0` here", i,
			                   other->name, device->connect);
	}
	return 0;
}

static int check_odometry(struct reader *r, const struct config *config, int i)
{
	const struct config_device *device = &config->device[i];
	const bool speeds = device->ahead.set || device->turn.set, wheels = device->left.set || device->right.set;
	for (int j = 0; j < i; j++)
		if (keys_driver(config->device[j].driver) == KEY_ODOMETRY)
			return reader_fail(r, device->line,
			                   "devices[%d]: '%s' already tells the motion; one odometry is possible", i,
			                   config->device[j].name);
	if (speeds == wheels || (speeds && !(device->ahead.set && device->turn.set)) ||
	    (wheels && !(device->left.set && device->right.set)))
		return reader_fail(r, device->line,
		                   "devices[%d]: an odometry has either `speed` and `turn`, or `left` and `right`", i);
	if (wheels && device->track_m <= 0)
		return reader_fail(r, device_line(r, i, "track"),
		                   "devices[%d].track: the distance between the wheels is missing", i);
	return 0;
}

static int check_pose(struct reader *r, const struct config *config, int i)
{
	const struct config_device *device = &config->device[i];
	if (device->fixed == (device->listen[0] != '\0'))
		return reader_fail(r, device->line, "devices[%d]: a pose device has either `listen` or `fixed`", i);
	for (int j = 0; j < i; j++)
		if (keys_driver(config->device[j].driver) == KEY_POSE)
			return reader_fail(
			    r, device->line,
			    "devices[%d]: '%s' already says where the robot is; one pose device is possible", i,
			    config->device[j].name);
	if (device->fixed)
		return 0;
	struct address address;
	char sentence[ADDRESS_ERROR_MAX];
	int error = address_parse(device->listen, ADDRESS_UNIX | ADDRESS_UDP, &address, sentence);
	if (!error)
		error = address_check_loopback(&address, sentence);
	return error ? reader_fail(r, device_line(r, i, "listen"), "devices[%d].listen: %s", i, sentence) : 0;
}

static int check_device(struct reader *r, const struct config *config, int i)
{
	const struct config_device *device = &config->device[i];
	char key[40];
	snprintf(key, sizeof(key), "devices[%d].tilt", i);
	int error = check_name(r, config, i);
	if (!error)
		error = check_line_shared(r, config, i);
	if (!error && device->tilt[0])
		error = check_tilt_name(r, config, key, device->tilt, device_line(r, i, "tilt"));
	if (!error && keys_driver(device->driver) == KEY_MODBUS)
		error = check_modbus(r, device, i);
	if (!error && keys_driver(device->driver) == KEY_LMS2XX)
		error = check_lms2xx(r, device, i);
	if (!error && is_cola(device))
		error = check_cola(r, device, i);
	if (!error && keys_driver(device->driver) & KEY_ON_CAN)
		error = check_can(r, device, i);
	if (!error && keys_driver(device->driver) == KEY_CANOPEN)
		error = check_canopen(r, config, i);
	if (!error && keys_driver(device->driver) == KEY_ODOMETRY)
		error = check_odometry(r, config, i);
	if (!error && keys_driver(device->driver) == KEY_POSE)
		error = check_pose(r, config, i);
	return error;
}

/* What can be known beforehand is refused beforehand. */
static int check_limits(struct reader *r, const struct config *config, const struct config_device *servo, int node)
{
	const struct {
		const char *name;
		double rad;
		bool set;
	} targets[] = {{"from", config->sweep.from_rad, true},
	               {"to", config->sweep.to_rad, true},
	               {"rest", config->sweep.rest_rad, config->sweep.has_rest}};
	for (size_t i = 0; i < 3 && servo->has_limits; i++)
		if (targets[i].set && (targets[i].rad < servo->limits_rad[0] || targets[i].rad > servo->limits_rad[1]))
			return reader_fail(r, reader_line(r, node, targets[i].name),
			                   "sweep.%s: lies outside the limits of '%s'", targets[i].name, servo->name);
	return 0;
}

static int check_sweep(struct reader *r, const struct config *config)
{
	const int node = reader_child(r, r->tree->root, "sweep");
	if (!config->sweep.set)
		return 0;
	const int error =
	    check_tilt_name(r, config, "sweep.device", config->sweep.device, reader_line(r, node, "device"));
	if (error)
		return error;
	const struct config_device *servo = find_device(config, config->sweep.device);
	if (keys_driver(servo->driver) == KEY_MODBUS
	        ? !servo->target.set
	        : keys_driver(servo->driver) != KEY_CANOPEN || servo->kind == CANOPEN_ENCODER ||
	              servo->kind == CANOPEN_INCLINOMETER)
		return reader_fail(r, reader_line(r, node, "device"),
		                   "sweep.device: '%s' %s, so it cannot be commanded", config->sweep.device,
		                   keys_driver(servo->driver) == KEY_MODBUS ? "has no `target` register"
		                                                            : "only tells its angle");
	/* Its angle is known but for whole turns, its target is not: it would turn as far as it is off. */
	if (keys_driver(servo->driver) == KEY_CANOPEN && servo->count.wrap > 0)
		return reader_fail(r, reader_line(r, node, "device"),
		                   "sweep.device: '%s' has a `wrap`, so its targets could be whole turns away; take "
		                   "`wrap` out and give `zero`",
		                   config->sweep.device);
	if (keys_driver(servo->driver) == KEY_CANOPEN && servo->drive_mode != CANOPEN_POSITION &&
	    servo->sync_ns > SET_POINTS_NS_MAX)
		return reader_fail(r, reader_line(r, node, "device"),
		                   "sweep.device: '%s' is led from SYNC to SYNC, so `sync` may be 50ms at most; or use "
		                   "`mode: position`",
		                   config->sweep.device);
	if (config->sweep.from_rad >= config->sweep.to_rad)
		return reader_fail(r, reader_line(r, node, "from"), "sweep.from: must be smaller than sweep.to");
	return check_limits(r, config, servo, node);
}

static int check_box(struct reader *r, const struct config *config)
{
	const struct vec3 a = config->robot.box_min, b = config->robot.box_max;
	const int node = reader_child(r, reader_child(r, r->tree->root, "robot"), "box");
	if (config->robot.has_box && !(a.x < b.x && a.y < b.y && a.z < b.z))
		return reader_fail(r, reader_line(r, node, "min"),
		                   "robot.box: min must be smaller than max on every axis");
	return 0;
}

static int check_listen(struct reader *r, const struct config *config)
{
	const int line = reader_line(r, reader_child(r, r->tree->root, "listen"), "native");
	for (int i = 0; i < config->listen.natives; i++) {
		const char *text = config->listen.native[i];
		struct address address;
		char sentence[ADDRESS_ERROR_MAX];
		int error = address_parse(text, ADDRESS_UNIX | ADDRESS_TCP, &address, sentence);
		if (!error)
			error = address_check_loopback(&address, sentence);
		if (error)
			return reader_fail(r, line, "listen.native: %s", sentence);
		for (int j = 0; j < i; j++)
			if (strcmp(config->listen.native[j], text) == 0)
				return reader_fail(r, line, "listen.native: '%s' is written twice", text);
	}
	return 0;
}

static int check_origins(struct reader *r, const struct config *config, int listen)
{
	for (int i = 0; i < config->listen.origins; i++) {
		const char *text = config->listen.origin[i], *host = strstr(text, "://");

		if (!host || !host[3] || strchr(host + 3, '/') || (strncmp(text, "http", 4) != 0))
			return reader_fail(
			    r, reader_line(r, listen, "origins"),
			    "listen.origins: '%.60s' is no origin; write it like https://app.foxglove.dev", text);
	}
	return 0;
}

/* Nobody gets in by default (decision D11): beyond loopback a token and TLS are needed. */
static int check_http(struct reader *r, const struct config *config)
{
	const int listen = reader_child(r, r->tree->root, "listen"), line = reader_line(r, listen, "http");
	char text[CONFIG_TEXT_MAX + 4], sentence[ADDRESS_ERROR_MAX];
	struct address address;

	snprintf(text, sizeof(text), "tcp:%s", config->listen.http);
	if (config->listen.http[0] && address_parse(text, ADDRESS_TCP, &address, sentence) < 0)
		return reader_fail(r, line, "listen.http: %s", sentence);
	if (config->listen.http[0] && address_check_loopback(&address, sentence) < 0 &&
	    (!config->listen.token_file[0] || !config->listen.has_tls))
		return reader_fail(r, line,
		                   "listen.http: '%.60s' is beyond loopback: that needs listen.token_file and "
		                   "listen.tls; or use ssh -L",
		                   config->listen.http);
	return check_origins(r, config, listen);
}

int config_check(struct reader *r, const struct config *config)
{
	int error = 0;
	for (int i = 0; i < config->devices && !error; i++)
		error = check_device(r, config, i);
	if (!error)
		error = check_sweep(r, config);
	if (!error)
		error = check_box(r, config);
	if (!error)
		error = check_listen(r, config);
	return error ? error : check_http(r, config);
}

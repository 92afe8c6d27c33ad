/* Law: a configuration is taken as its author meant it, or refused with file, line and what to do (style, rule 32). */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>
#include <errno.h>
#include <math.h>

#include "config/config.h"
#include "config/keys.h"
#include "tests/scarce.h"

#define DEG                  0.017453292519943295
#define assert_near(a, b, e) assert_true(fabs((a) - (b)) <= (e))

static const char building[] =
    "map: {cell: 10cm, tolerance: 0.3, memory: 64M, hold: 0.02}\n"
    "robot: {box: {min: [-0.4, -0.3, -0.5], max: [0.3, 0.3, 0.2]}, step: 5cm, slope: 15deg}\n"
    "mount: {base_tilt: {xyz: [0.2, 0, 0.4], rpy: [0, 0, 0]}, tilt_laser: {xyz: [0, 0, 0.05]}}\n"
    "devices:\n"
    "  - {name: laser, driver: lms2xx, port: /dev/ttyUSB0, baud: 500000, variant: 180/0.25, range: [0.3, 30],\n"
    "     mask: [[-90deg, -80deg], [1.2, 1.5]], tilt: servo, unit: mm, mode: 0x05}\n"
    "  - {name: servo, driver: modbus, connect: 127.0.0.1:502, unit: 7, period: 0, parity: none,\n"
    "     position: {address: 0x10, type: i32, order: CDAB, scale: 0.001deg, zero: 100, sign: -1},\n"
    "     target: {address: 2, type: i16, scale: 0.01deg}, speed: {address: 4, type: u32, scale: 0.001deg/s},\n"
    "     write: [{address: 16, value: 1}, {address: 17, value: 0xff}]}\n"
    "  - {name: pose, driver: pose, listen: udp:127.0.0.1:9000}\n"
    "sweep: {device: servo, from: -65deg, to: 45deg, speed: 30deg, profile: step, step: 0.25deg, settle: 5ms, rest: "
    "0}\n"
    "listen: {native: [unix:/tmp/f.sock, tcp:127.0.0.1:0], send_buffer: 16k, clients: 4, http: , tls: ~}\n"
    "record: {dir: , chunk: 1s, messages: false}\n"
    "state: {checkpoint: 300s}\n";

static int read_text(const char *text, struct config *config, struct config_error *error)
{
	return config_read(text, strlen(text), "f.yaml", config, error);
}

/* A device list that is right, followed by `more`. */
static const char *with_devices(const char *more)
{
	static char text[2000];
	snprintf(text, sizeof(text),
	         "devices:\n"
	         "- {name: laser, driver: lms2xx, port: /dev/l, tilt: servo}\n"
	         "- {name: servo, driver: modbus, connect: /dev/s, position: {address: 0, scale: 0.1deg}}\n"
	         "%s",
	         more);
	return text;
}

static void assert_refused(const char *text, const char *start, const char *part)
{
	static struct config config, untouched;
	struct config_error error;
	memset(&config, 0x5a, sizeof(config));
	untouched = config;
	assert_int_equal(read_text(text, &config, &error), -EINVAL);
	if (strncmp(error.text, start, strlen(start)) || !strstr(error.text, part)) {
		print_error("expected '%s ... %s'\ngot      '%s'\n", start, part, error.text);
		fail();
	}
	assert_null(strchr(error.text, '\n'));
	assert_memory_equal(&config, &untouched, sizeof(config));
}

static void every_value_of_a_whole_file_arrives_in_si(void **state)
{
	(void)state;
	struct config c;
	struct config_error error;
	if (read_text(building, &c, &error))
		fail_msg("%s", error.text);
	assert_near(c.map.cell_m, 0.1, 1e-12);
	assert_near(c.map.tolerance, 0.3, 0);
	assert_true(c.map.reduce && !c.map.planes);
	assert_int_equal(c.map.memory, 64 << 20);
	assert_int_equal(c.map.hold_ns, 20000000);
	assert_true(c.robot.has_box);
	assert_near(c.robot.box_min.z, -0.5, 0);
	assert_near(c.mount.base_tilt.t.x, 0.2, 0);
	assert_near(c.mount.tilt_laser.t.z, 0.05, 0);
	assert_int_equal(c.devices, 3);
	assert_true(c.sweep.set && c.sweep.has_rest);
	assert_near(c.sweep.from_rad, -65 * DEG, 1e-12);
	assert_near(c.sweep.speed_rad_s, 30 * DEG, 1e-12);
	assert_int_equal(c.sweep.profile, SWEEP_STEP);
	assert_int_equal(c.sweep.settle_ns, 5000000);
	assert_int_equal(c.listen.natives, 2);
	assert_string_equal(c.listen.native[1], "tcp:127.0.0.1:0");
	assert_int_equal(c.listen.send_buffer, 16384);
	assert_int_equal(c.listen.clients, 4);
}

static void every_value_of_a_device_arrives(void **state)
{
	(void)state;
	struct config c;
	struct config_error error;
	assert_int_equal(read_text(building, &c, &error), 0);
	const struct config_device *laser = &c.device[0], *servo = &c.device[1];
	assert_string_equal(laser->tilt, "servo");
	assert_int_equal(laser->line, 5);
	assert_int_equal(laser->fov_deg, 180);
	assert_int_equal(laser->resolution_cdeg, 25);
	assert_int_equal(laser->range_unit, UNIT_MM);
	assert_int_equal(laser->mode, 5);
	assert_int_equal(laser->masks, 2);
	assert_near(laser->mask[0].to_rad, -80 * DEG, 1e-12);
	assert_near(laser->mask[1].from_rad, 1.2, 0);
	assert_int_equal(servo->slave, 7);
	assert_int_equal(servo->parity, 'N');
	assert_int_equal(servo->period_ns, 0);
	assert_true(servo->position.set && servo->target.set && servo->speed.set);
	assert_int_equal(servo->position.address, 16);
	assert_int_equal(servo->position.function, 3);
	assert_int_equal(servo->position.type, REGISTER_I32);
	assert_int_equal(servo->position.order, ORDER_CDAB);
	assert_near(servo->position.scale, 0.001 * DEG, 1e-15);
	assert_near(servo->position.zero, 100, 0);
	assert_int_equal(servo->position.sign, -1);
	assert_int_equal(servo->target.function, 6);
	assert_int_equal(servo->speed.function, 16);
	assert_int_equal(servo->write.n, 2);
	assert_int_equal(servo->write.item[1].address, 17);
	assert_int_equal(servo->write.item[1].value, 255);
	assert_string_equal(c.device[2].listen, "udp:127.0.0.1:9000");
}

static void an_empty_file_gives_the_defaults(void **state)
{
	(void)state;
	struct config c, d;
	struct config_error error;
	assert_int_equal(read_text("# nothing\n", &c, &error), 0);
	config_default(&d);
	assert_memory_equal(&c, &d, sizeof(c));
	assert_near(c.map.cell_m, 0.05, 0);
	assert_near(c.map.tolerance, 0.25, 0);
	assert_near(c.map.snap, 0.15, 0);
	assert_int_equal(c.map.lookahead, 2);
	assert_int_equal(c.map.memory, 256 << 20);
	assert_int_equal(c.map.hold_ns, 30000000);
	assert_near(c.mount.base_tilt.r[0], 1, 0);
	assert_false(c.sweep.set || c.robot.has_box);
	assert_string_equal(c.listen.native[0], "unix:/run/facetd/facetd.sock");
	assert_int_equal(c.listen.natives, 2);
}

static void an_unknown_key_names_its_line_and_the_nearest_key(void **state)
{
	(void)state;
	assert_refused("map:\n  cel: 0.05\n", "f.yaml:2: unknown key 'cel' in map", "'cell'");
	assert_refused("- {name: laser, driver: tim, connect: usb}\n",
	               "f.yaml:1: configuration: ", "write `devices:` above");
	assert_refused("\nmpa: {}\n", "f.yaml:2: unknown key 'mpa'", "'map'");
	assert_refused("map: {tolerence: 1}\n", "f.yaml:1:", "'tolerance'");
	assert_refused("devices:\n- name: a\n  driver: lms2xx\n  prot: x\n",
	               "f.yaml:4: unknown key 'prot' in devices[0]", "'port'");
	assert_refused("devices:\n- {name: a, driver: lms2xx, port: x, connect: y}\n", "f.yaml:2: devices[0]",
	               "a key of modbus, tim, lms1xx, lms5xx, can, canopen, odometry, not of lms2xx");
}

static void a_value_out_of_range_names_the_range(void **state)
{
	(void)state;
	assert_refused("map: {cell: 5}", "f.yaml:1: map.cell: '5'", "1cm .. 1m");
	assert_refused("map:\n memory: 1M", "f.yaml:2: map.memory: '1M'", "16M .. 64G");
	assert_refused("map: {hold: 2s}", "f.yaml:1: map.hold: '2s'", "0 .. 1s");
	assert_refused("map: {field: distnce}", "f.yaml:1: map.field", "one of distance, hoppe, direct");
	assert_refused("map: {lookahead: 3}", "f.yaml:1: map.lookahead: '3'", "0 .. 2"); /* the field knows no more */
	assert_refused("map: {reduce: 'off|on'}", "f.yaml:1: map.reduce", "on");
	assert_refused("devices:\n - {name: l, driver: 'lms2xx|modbus'}", "f.yaml:2: devices", "one of");
	assert_refused("map: {lookahead: 1.5}", "f.yaml:1: map.lookahead", "not a whole number");
	assert_refused(with_devices("sweep: {device: servo, from: -65}\n"), "f.yaml:4: sweep.from: '-65'",
	               "-180deg .. 180deg (a number without a unit is in radians; write `deg`");
}

static void a_number_is_a_number_with_a_unit_of_its_kind(void **state)
{
	(void)state;
	assert_refused("map: {cell: 5deg}", "f.yaml:1: map.cell", "m, cm, mm");
	assert_refused("map: {cell: fine}", "f.yaml:1: map.cell: 'fine' is not a number", "1cm");
	assert_refused("map: {cell: nan}", "f.yaml:1:", "not a number");
	assert_refused("map: {cell: inf}", "f.yaml:1:", "not a number");
	assert_refused("map: {cell: 0x1p-4}", "f.yaml:1:", "");
	assert_refused("map: {cell: 1e999}", "f.yaml:1:", "not a number");
	assert_refused("map: {cell: [1]}", "f.yaml:1:", "a number is needed");
	assert_refused("map: {cell: }", "f.yaml:1:", "a number is needed");
	assert_refused("map: {cell: .}", "f.yaml:1:", "not a number");
	assert_refused("map: {reduce: perhaps}", "f.yaml:1: map.reduce", "on or off");
}

static void a_key_written_twice_is_refused_wherever_it_stands(void **state)
{
	(void)state;
	assert_refused("map: {cell: 0.05}\nmap: {}\n", "f.yaml:2: the key 'map' is written twice", "line 1");
	assert_refused("map:\n  cell: 0.1\n  cell: 0.1\n", "f.yaml:3:", "written twice");
	assert_refused("devices: [{name: a, name: b, driver: pose}]", "f.yaml:1:", "written twice");
}

static void what_comes_later_is_accepted_at_its_default_only(void **state)
{
	(void)state;
	struct config c;
	struct config_error error;
	const char *neutral = "map: {planes: off, field: distance, window: none}\nrobot: {step: 5cm, slope: 15deg}\n"
	                      "listen: {http: , tls: , token_file: ''}\nrecord: {dir: , chunk: 1000ms, messages: no,\n"
	                      "max_size: , max_age: }\nstate: {file: , checkpoint: 5min}\n";
	if (read_text(neutral, &c, &error))
		fail_msg("%s", error.text);
	assert_refused("map: {planes: on}", "f.yaml:1: map.planes", "will come later");
	assert_refused("map: {field: hoppe}", "f.yaml:1: map.field", "will come later");
	assert_refused("map: {window: 30m}", "f.yaml:1: map.window", "will come later");
	assert_refused("state: {file: /tmp/m}", "f.yaml:1: state.file", "later");
	assert_refused("robot: {step: 0.1}", "f.yaml:1: robot.step", "later");
}

static void a_page_beyond_loopback_needs_a_token_and_tls(void **state)
{
	struct config_error error;
	struct config c;
	const char *open = "listen: {http: '0.0.0.0:7880', token_file: /etc/t, tls: {certificate: a, key: b}}";

	(void)state;
	assert_int_equal(read_text("{}", &c, &error), 0);
	assert_string_equal(c.listen.http, "127.0.0.1:7880");
	assert_false(c.listen.http_set || c.listen.has_tls);
	assert_int_equal(read_text("listen: {http: }", &c, &error), 0);
	assert_string_equal(c.listen.http, "");
	assert_int_equal(read_text("listen: {http: '[::1]:0'}", &c, &error), 0);
	assert_true(c.listen.http_set);
	assert_int_equal(read_text(open, &c, &error), 0);
	assert_true(c.listen.has_tls);
	assert_string_equal(c.listen.key, "b");
	assert_refused("listen: {http: '192.168.0.5:7880'}", "f.yaml:1: listen.http",
	               "needs listen.token_file and listen.tls");
	assert_refused("listen: {http: '192.168.0.5:80', token_file: /t}", "f.yaml:1: listen.http", "listen.tls");
	assert_refused("listen: {http: robot}", "f.yaml:1: listen.http", "");
	assert_refused("listen: {tls: {certificate: a}}", "f.yaml:1: listen.tls", "key");
	assert_refused("listen: {origins: [app.foxglove.dev]}", "f.yaml:1: listen.origins", "is no origin");
	assert_int_equal(read_text("listen: {origins: ['https://a.b', 'http://localhost:8080']}", &c, &error), 0);
	assert_int_equal(c.listen.origins, 2);
	assert_string_equal(c.listen.origin[1], "http://localhost:8080");
}

static void recordings_have_limits_or_none(void **state)
{
	struct config_error error;
	struct config c;

	(void)state;
	assert_int_equal(
	    read_text("record: {dir: /tmp/r, max_size: 2G, max_age: 1h, keep: , messages: on}", &c, &error), 0);
	assert_string_equal(c.record.dir, "/tmp/r");
	assert_true(c.record.max_size == 2147483648u && c.record.max_age_ns == 3600000000000ll && c.record.keep == 0);
	assert_true(c.record.messages && c.record.chunk_ns == 1000000000);
	assert_refused("record: {chunk: 0s}", "f.yaml:1: record.chunk", "");
}

static void names_must_lead_somewhere(void **state)
{
	(void)state;
	assert_refused("devices: [{name: l, driver: lms2xx, port: /dev/l, tilt: servo}]", "f.yaml:1: devices[0].tilt",
	               "there is no device 'servo'");
	assert_refused(with_devices("- {name: b, driver: lms2xx, port: /dev/b, tilt: laser}"),
	               "f.yaml:4: devices[2].tilt", "tilts nothing");
	assert_refused(with_devices("sweep: {device: srevo}"), "f.yaml:4: sweep.device", "devices that tilt: servo");
	assert_refused(with_devices("sweep: {device: servo}"), "f.yaml:4: sweep.device", "no `target`");
	assert_refused(with_devices("- {name: servo, driver: pose, fixed: {}}"), "f.yaml:4: devices[2].name",
	               "names are unique");
	assert_refused(with_devices("- {name: 'a b', driver: pose, fixed: {}}"), "f.yaml:4:", "letters, digits");
	assert_refused(with_devices("- {name: b, driver: lms2xx, port: /dev/l}"),
	               "f.yaml:4:", "already the line of 'laser'");
}

static void every_driver_gets_what_it_needs(void **state)
{
	(void)state;
	assert_refused("devices: [{name: a}]", "f.yaml:1: devices[0]", "`driver` is missing");
	assert_refused("devices: [{name: a, driver: lms9xx}]",
	               "f.yaml:1:", "one of lms2xx, modbus, pose, tim, lms1xx, lms5xx");
	assert_refused("devices: [{name: a}]", "f.yaml:1:", "one of lms2xx, modbus, pose, tim, lms1xx, lms5xx");
	assert_refused("devices: [{name: a, driver: tim}]", "f.yaml:1: devices[0]", "`connect` is missing");
	assert_refused("devices:\n- driver: lms2xx\n  name: a", "f.yaml:2: devices[0]", "`port` is missing");
	assert_refused("devices: [{driver: pose, fixed: {}}]", "f.yaml:1:", "`name` is missing");
	assert_refused("devices: [{name: a, driver: modbus, connect: /dev/x}]", "f.yaml:1:", "`position` is missing");
	assert_refused("devices: [{name: a, driver: modbus, connect: /x, position: }]",
	               "f.yaml:1:", "`address` is missing");
	assert_refused("devices: [{name: a, driver: modbus, connect: x, position: {address: 1, scale: 1deg}}]",
	               "f.yaml:1:", "a port is missing");
	assert_refused("devices: [{name: a, driver: pose}]", "f.yaml:1:", "either `listen` or `fixed`");
	assert_refused("devices: [{name: a, driver: pose, fixed: {}}, {name: b, driver: pose, fixed: {}}]",
	               "f.yaml:1:", "one pose device");
	assert_refused("devices: [{name: '', driver: pose, fixed: {}}]", "f.yaml:1:", "nothing is written");
	assert_refused("devices: {name: a}", "f.yaml:1: devices", "a list");
	assert_refused("devices: [7]", "f.yaml:1: devices[0]", "`driver` is missing");
	assert_refused("sweep: {from: 1}", "f.yaml:1: sweep", "`device` is missing");
}

static void registers_that_cannot_be_are_refused(void **state)
{
	(void)state;
	char text[400];
	const struct {
		const char *position, *more, *sentence;
	} bad[] = {
	    {"{address: 0, scale: 1deg, function: 6}", "", "read with 3 or 4"},
	    {"{address: 0, scale: 1deg, function: 5}", "", "one of auto, 3, 4, 6, 16"},
	    {"{address: 65536, scale: 1deg}", "", "0 .. 65535"},
	    {"{address: 65535, scale: 1deg, type: i32}", "", "two registers"},
	    {"{address: 0, scale: 0}", "", "outside"},
	    {"{address: 0, scale: 1deg, sign: 2}", "", "one of 1, -1"},
	    {"{address: 0, scale: 1deg, order: ABDC}", "", "one of ABCD"},
	    {"{address: 0, scale: 1deg}", "address_base: 1", "the first register is 1"},
	    {"{address: 0, scale: 1deg}", "target: {address: 1, scale: 1deg, type: i32, function: 6}", "16 bits only"},
	    {"{address: 0, scale: 1deg}", "target: {address: 1, scale: 1deg, function: 3}", "written with 6 or 16"},
	    {"{address: 1, scale: 1deg}", "address_base: 1, write: [{address: 0, value: 1}]",
	     "the first register is 1"},
	    {"{address: 0, scale: 1deg}", "write: [{address: 1}]", "`value` is missing"},
	    {"{address: 0, scale: 1deg}", "write: 7", "a list"},
	    {"{address: 0, scale: 1deg}", "baud: 100", "outside 1200 .. 4000000"},
	};
	for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
		snprintf(text, sizeof(text), "devices:\n- {name: s, driver: modbus, connect: /dev/s, position: %s%s%s}",
		         bad[i].position, bad[i].more[0] ? ", " : "", bad[i].more);
		assert_refused(text, "f.yaml:2: devices[0]", bad[i].sentence);
	}
}

static void nobody_gets_in_from_outside(void **state)
{
	(void)state;
	char text[400];
	assert_refused("listen:\n  native: [tcp:0.0.0.0:7878]", "f.yaml:2: listen.native", "loopback");
	assert_refused("listen: {native: [tcp:192.168.1.2]}", "f.yaml:1: listen.native", "ssh -L");
	assert_refused("listen: {native: [udp:127.0.0.1:1]}", "f.yaml:1:", "unix:PATH or tcp:HOST:PORT");
	assert_refused("listen: {native: [unix:/a, unix:/a]}", "f.yaml:1:", "written twice");
	assert_refused("listen: {native: [unix:a, unix:b, unix:c, unix:d, unix:e]}", "f.yaml:1:", "at most 4");
	assert_refused("listen: {native: unix:/a}", "f.yaml:1: listen.native", "a list");
	assert_refused("devices: [{name: p, driver: pose, listen: udp:10.0.0.1:5}]", "f.yaml:1:", "loopback");
	snprintf(text, sizeof(text), "listen: {native: [unix:/%0108d]}", 0);
	assert_refused(text, "f.yaml:1: listen.native", "less than 108");
}

static void lists_have_the_length_they_need(void **state)
{
	(void)state;
	assert_refused("mount: {base_tilt: {xyz: [1, 2]}}", "f.yaml:1: mount.base_tilt.xyz", "a list of 3 numbers");
	assert_refused("mount: {base_tilt: {xyz: [1, 2, 3, 4]}}", "f.yaml:1: mount.base_tilt.xyz",
	               "a list of 3 numbers");
	assert_refused("mount: {base_tilt: 5}", "f.yaml:1: mount.base_tilt", "`key: value` pairs");
	assert_refused("robot: {box: {min: [0, 0, 0], max: [1, 0, 1]}}", "f.yaml:1: robot.box", "on every axis");
	assert_refused("robot: {box: {min: [0, 0, 0]}}", "f.yaml:1: robot.box", "`max` is missing");
	assert_refused("devices: [{name: a, driver: lms2xx, port: /x, range: [3, 1]}]", "f.yaml:1:", "smaller");
	assert_refused("devices: [{name: a, driver: lms2xx, port: /x, mask: 5}]", "f.yaml:1:", "a list of pairs");
	assert_refused(
	    "devices: [{name: a, driver: lms2xx, port: /x, mask: [[0,1],[0,1],[0,1],[0,1],[0,1],[0,1],[0,1],\n"
	    "[0,1],[0,1]]}]",
	    "f.yaml:2:", "at most 8");
	assert_refused("devices: [{name: a234567890123456789012345678901234567890, driver: pose}]",
	               "f.yaml:1:", "longer than 31");
}

static void seventeen_devices_are_too_many(void **state)
{
	(void)state;
	char text[2000] = "devices:\n";
	for (int i = 0; i < 17; i++)
		snprintf(text + strlen(text), sizeof(text) - strlen(text),
		         "- {name: l%d, driver: lms2xx, port: /dev/l%d}\n", i, i);
	assert_refused(text, "f.yaml:18: devices", "at most 16");
}

static void what_is_not_yaml_names_its_line(void **state)
{
	(void)state;
	assert_refused("map: {\n\ncell: ]", "f.yaml:3: this is not YAML", "");
	assert_refused("map: \"a\n", "f.yaml:", "this is not YAML");
	assert_refused("a\n\n\xff\xfe\xfd", "f.yaml:3: this is not YAML", "");
	assert_refused("{}\n---\n{}\n", "f.yaml:2:", "a second document");
	assert_refused("map: &a {cell: 1}\nrobot: *a\n", "f.yaml:2: aliases", "write the value out");
	assert_refused("just text", "f.yaml:1: configuration", "pairs");
	assert_refused("[map]", "f.yaml:1: configuration", "a list does not stand alone");
	assert_refused("? [a]\n: b", "f.yaml:1:", "the name of a key");
	assert_refused("map: {window: \"a\\0b\"}", "f.yaml:1:", "NUL");
}

static void size_and_depth_are_bounded(void **state)
{
	(void)state;
	static char text[(1 << 20) + 2];
	memset(text, '[', 40);
	assert_refused(text, "f.yaml:1:", "too deeply");
	memset(text, '#', sizeof(text) - 1);
	assert_refused(text, "f.yaml:1:", "larger than 1 MB");
	memcpy(text, "[", 1);
	for (int i = 0; i < 20001; i++)
		memcpy(text + 1 + 2 * i, "1,", 3);
	assert_refused(text, "f.yaml:1:", "too many values");
}

static void every_shorter_file_is_taken_or_refused_in_peace(void **state)
{
	(void)state;
	for (size_t len = 0; len < sizeof(building); len++) {
		struct config c;
		struct config_error error;
		char *exact = malloc(len + 1); /* +1: no malloc(0); the byte after is the sanitizer's */
		assert_non_null(exact);
		memcpy(exact + 1, building, len);
		const int status = config_read(exact + 1, len, "f.yaml", &c, &error);
		assert_true(status == 0 || (status == -EINVAL && error.text[0]));
		free(exact);
	}
}

static void memory_that_runs_out_anywhere_is_said_and_nothing_is_kept(void **state)
{
	(void)state;
	static struct config config, untouched;
	if (!SCARCE_WORKS)
		skip();
	memset(&untouched, 0x5a, sizeof(untouched));
	int status = -ENOMEM;
	long calls = 0;
	for (; status != 0; calls++) {
		struct config_error error;
		config = untouched;
		const long live = scarce_live;
		scarce_left = calls;
		status = read_text(building, &config, &error);
		scarce_left = -1;
		const long leaked = scarce_live - live;
		assert_int_equal(leaked, 0);
		if (status == 0)
			break;
		assert_int_equal(status, -ENOMEM);
		assert_string_equal(error.text, "f.yaml: memory is out");
		assert_memory_equal(&config, &untouched, sizeof(config));
	}
	assert_true(calls > 500);
}

static void edit_distance_counts_swaps_as_one(void **state)
{
	(void)state;
	assert_int_equal(keys_distance("cell", "cell"), 0);
	assert_int_equal(keys_distance("cell", "cel"), 1);
	assert_int_equal(keys_distance("port", "prot"), 1);
	assert_int_equal(keys_distance("", "abc"), 3);
	assert_int_equal(keys_distance("kitten", "sitting"), 3);
	char lengthy[300];
	memset(lengthy, 'a', sizeof(lengthy) - 1);
	lengthy[sizeof(lengthy) - 1] = '\0';
	assert_int_equal(keys_distance(lengthy, ""), 63);
}

static void the_scanner_gets_its_mount_masks_and_pose(void **state)
{
	(void)state;
	struct config c;
	struct config_error error;
	struct sweep_params p;
	assert_int_equal(read_text(building, &c, &error), 0);
	config_sweep_params(&c, 0, &p);
	assert_false(p.fixed_tilt || p.fixed_pose);
	assert_int_equal(p.masks, 2);
	assert_near(p.mask[1].to_rad, 1.5, 0);
	assert_near(p.range_max_m, 30, 0);
	assert_int_equal(p.hold_ns, 20000000);
	const char *fixed = "devices: [{name: p, driver: pose, fixed: {xyz: [1, 2, 3]}},\n"
	                    "{name: l, driver: lms2xx, port: /l, tilt: -10deg}]";
	assert_int_equal(read_text(fixed, &c, &error), 0);
	config_sweep_params(&c, 1, &p);
	assert_true(p.fixed_tilt && p.fixed_pose);
	assert_near(p.tilt_rad, -10 * DEG, 1e-12);
	assert_near(p.map_base.t.y, 2, 0);
}

static const char scanners[] =
    "devices:\n"
    "  - {name: front, driver: tim, connect: \"usb:1-1.2\", protocol: a, every: 2, remission: off, stamp: end,\n"
    "     latency: -2ms, tilt: left, range: [0.1, 10], mask: [[-100deg, -90deg]]}\n"
    "  - {name: left, driver: lms1xx, connect: 192.168.0.1, frequency: 25Hz, resolution: 0.25deg, remission: 16,\n"
    "     angles: [-45deg, 90deg], encoder: {scale: 0.02deg, zero: 5, sign: -1, wrap: 16384}, tilt: left}\n"
    "  - {name: right, driver: lms5xx, connect: \"192.168.0.1:2111\", protocol: b, remission: 8, stamp: start}\n"
    "  - {name: old, driver: lms2xx, port: usb:0403:6001:A10X, indices: on, latency: 1ms}\n";

static void every_value_of_a_scanner_arrives(void **state)
{
	(void)state;
	struct config c;
	struct config_error error;
	if (read_text(scanners, &c, &error))
		fail_msg("%s", error.text);
	const struct config_device *front = &c.device[0], *left = &c.device[1], *right = &c.device[2];
	assert_string_equal(front->connect, "usb:1-1.2");
	assert_int_equal(front->protocol, PROTOCOL_COLA_A);
	assert_int_equal(front->every, 2);
	assert_int_equal(front->remission, REMISSION_OFF);
	assert_int_equal(front->stamp, STAMP_END);
	assert_int_equal(front->latency_ns, -2000000);
	assert_string_equal(front->tilt, "left");
	assert_near(front->range_max_m, 10, 0);
	assert_int_equal(front->masks, 1);
	assert_false(front->encoder.set);
	assert_near(left->frequency_hz, 25, 0);
	assert_near(left->resolution_rad, 0.25 * DEG, 1e-12);
	assert_near(left->angles_from_rad, -45 * DEG, 1e-12);
	assert_near(left->angles_to_rad, 90 * DEG, 1e-12);
	assert_int_equal(left->remission, REMISSION_16);
	assert_true(left->encoder.set);
	assert_near(left->encoder.scale, 0.02 * DEG, 1e-12);
	assert_near(left->encoder.zero, 5, 0);
	assert_int_equal(left->encoder.sign, -1);
	assert_near(left->encoder.wrap, 16384, 0);
	assert_int_equal(right->protocol, PROTOCOL_COLA_B);
	assert_int_equal(right->remission, REMISSION_8);
	assert_int_equal(right->stamp, STAMP_START);
	assert_int_equal(c.device[3].indices, INDICES_ON);
	assert_int_equal(c.device[3].latency_ns, 1000000);
}

static void a_scanner_that_is_only_plugged_in_keeps_its_own_settings(void **state)
{
	(void)state;
	static const struct {
		const char *driver;
		double range_max_m;
	} family[] = {{"tim", 25}, {"lms1xx", 50}, {"lms5xx", 82}};
	for (size_t i = 0; i < sizeof(family) / sizeof(family[0]); i++) {
		struct config c;
		struct config_error error;
		char text[200];
		snprintf(text, sizeof(text), "devices: [{name: a, driver: %s, connect: 10.0.0.1, encoder: }]",
		         family[i].driver);
		if (i == 0)
			snprintf(text, sizeof(text), "devices: [{name: a, driver: tim, connect: usb}]");
		if (read_text(text, &c, &error))
			fail_msg("%s", error.text);
		const struct config_device *d = &c.device[0];
		assert_true(d->frequency_hz == 0 && d->resolution_rad == 0 && d->every == 0);
		assert_true(d->angles_from_rad == d->angles_to_rad && !d->encoder.set && d->latency_ns == 0);
		assert_true(d->protocol == PROTOCOL_AUTO && d->remission == REMISSION_KEEP && d->stamp == STAMP_AUTO);
		assert_near(d->range_max_m, family[i].range_max_m, 0);
	}
}

static void a_scanner_is_connected_in_a_way_it_has(void **state)
{
	(void)state;
	static const struct {
		const char *driver, *connect, *sentence;
	} bad[] = {
	    {"tim", "''", "nothing is written"},
	    {"tim", "usbb", "not usb, usb:SERIAL or usb:BUS-PORT"},
	    {"tim", "'usb:'", "not usb, usb:SERIAL or usb:BUS-PORT"},
	    {"tim", "'usb:1-'", "not usb, usb:SERIAL"},
	    {"tim", "'usb:1-1.'", "not usb, usb:SERIAL"},
	    {"tim", "'usb:1-1.-2'", "not usb, usb:SERIAL"},
	    {"tim", "'usb:a b'", "not usb, usb:SERIAL"},
	    {"tim", "'usb:1234567890123456789012345678901234567890123456789012345678901234'", "not usb, usb:SERIAL"},
	    {"lms1xx", "usb", "only a tim measures over USB; write HOST[:PORT]"},
	    {"lms5xx", "'usb:1-1'", "only a tim measures over USB; write HOST[:PORT]"},
	    {"tim", "/dev/ttyACM0", "no serial line here; write usb or HOST[:PORT]"},
	    {"lms1xx", "/dev/ttyUSB0", "no serial line here; write HOST[:PORT]"},
	    {"lms1xx", "scanner.local", "names are not looked up, write a number like 192.168.0.1"},
	    {"lms1xx", "'10.0.0.1:x'", "is not a port"},
	    {"lms1xx", "'10.0.0.1:0'", "nobody listens on port 0"},
	    {"lms1xx", "'10.0.0.1:65536'", "is not a port"},
	    {"lms1xx", "'[::1'", "the closing ]"},
	};
	char text[400];
	for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
		snprintf(text, sizeof(text), "devices:\n- {name: s, driver: %s, connect: %s}", bad[i].driver,
		         bad[i].connect);
		assert_refused(text, "f.yaml:2: devices[0].connect", bad[i].sentence);
	}
	static const char *const good[] = {
	    "usb", "'usb:16160456'", "'usb:1-1'", "'usb:12-3.4.1'", "'usb:SN-12/34.a'", "localhost", "'[::1]:2111'"};
	for (size_t i = 0; i < sizeof(good) / sizeof(good[0]); i++) {
		struct config c;
		struct config_error error;
		snprintf(text, sizeof(text), "devices: [{name: s, driver: tim, connect: %s}]", good[i]);
		if (read_text(text, &c, &error))
			fail_msg("%s", error.text);
	}
}

static void two_scanners_have_two_lines(void **state)
{
	(void)state;
#define TWO(a, b) \
	"devices:\n- {name: a, driver: tim, connect: \"" a "\"}\n- {name: b, driver: tim, connect: \"" b "\"}\n"
	assert_refused(TWO("usb", "usb"), "f.yaml:3: devices[1].connect", "usb:SERIAL or usb:BUS-PORT at both");
	assert_refused(TWO("usb:1-1", "usb"), "f.yaml:3: devices[1].connect", "('a' is the other)");
	assert_refused(TWO("usb", "usb:1-1"), "f.yaml:3: devices[1].connect", "('a' is the other)");
	assert_refused(TWO("usb:1-1", "usb:1-1"), "f.yaml:3:", "already the line of 'a'");
	assert_refused(TWO("10.0.0.1", "10.0.0.1"), "f.yaml:3:", "already the line of 'a'");
	assert_refused(TWO("10.0.0.1:2112", "10.0.0.1"), "f.yaml:3:", "already the line of 'a'");
	struct config c;
	struct config_error error;
	assert_int_equal(read_text(TWO("usb:1-1", "usb:1-2"), &c, &error), 0);
	assert_int_equal(read_text(TWO("usb", "10.0.0.1"), &c, &error), 0);
	assert_int_equal(read_text(TWO("10.0.0.1:2111", "10.0.0.1"), &c, &error), 0);
#undef TWO
}

static void only_who_has_an_encoder_or_a_servo_tilts(void **state)
{
	(void)state;
	assert_refused("devices: [{name: a, driver: tim, connect: usb, encoder: {scale: 1deg}}]",
	               "f.yaml:1: devices[0]", "'encoder' is a key of lms1xx, lms5xx, carmen, not of tim");
	assert_refused("devices: [{name: a, driver: lms1xx, connect: 10.0.0.1, tilt: a}]", "f.yaml:1: devices[0].tilt",
	               "tilts nothing");
	assert_refused("devices: [{name: a, driver: lms1xx, connect: 10.0.0.1, encoder: {zero: 1}}]",
	               "f.yaml:1:", "`scale` is missing");
	assert_refused("devices: [{name: a, driver: lms1xx, connect: 10.0.0.1, encoder: {scale: 1deg, sign: 0}}]",
	               "f.yaml:1: devices[0].encoder.sign", "one of 1, -1");
	assert_refused("devices: [{name: a, driver: lms1xx, connect: 10.0.0.1, encoder: {scale: 0}}]",
	               "f.yaml:1: devices[0].encoder.scale", "outside");
	assert_refused("devices: [{name: a, driver: lms1xx, connect: 10.0.0.1, encoder: {scale: 1deg, wrap: -1}}]",
	               "f.yaml:1: devices[0].encoder.wrap", "outside");
	assert_refused("devices: [{name: a, driver: lms5xx, connect: 10.0.0.1, encoder: {scale: 1deg}}]\n"
	               "sweep: {device: a}",
	               "f.yaml:2: sweep.device", "only tells its angle");
}

#define SIGNAL_DEVICE(parts) "devices: [{name: a, driver: can, connect: can0, angle: {" parts "}}]"
static void a_signal_of_a_can_frame_is_read_as_a_dbc_file_has_it(void **state)
{
	(void)state;
	struct config c;
	struct config_error error;
	if (read_text(
	        SIGNAL_DEVICE("id: 0x18ff0001, extended: on, start: 7, length: 16, order: motorola, scale: -0.01deg, "
	                      "offset: 90deg, counter: {start: 63, length: 8}, valid: {bit: 48}, "
	                      "mux: {start: 23, length: 8, value: 3}"),
	        &c, &error))
		fail_msg("%s", error.text);
	const struct config_signal *s = &c.device[0].angle;
	assert_true(s->set && s->extended && s->counter.set && s->valid.set && s->mux.set);
	assert_int_equal(s->id, 0x18ff0001);
	assert_int_equal(s->order, SIGNAL_MOTOROLA);
	assert_int_equal(s->type, SIGNAL_SIGNED);
	assert_near(s->scale, -0.01 * DEG, 1e-12);
	assert_near(s->offset, 90 * DEG, 1e-12);
	assert_int_equal(s->valid.value, 1);
	assert_int_equal(s->mux.value, 3);
	assert_int_equal(c.device[0].timeout_ns, 500000000);
}

static void a_signal_that_no_frame_can_hold_is_refused(void **state)
{
	(void)state;
	static const struct {
		const char *text, *sentence;
	} bad[] = {
	    {SIGNAL_DEVICE("id: 0x800, scale: 1deg"), "more than 11 bits"},
	    {SIGNAL_DEVICE("id: 0x7fg, scale: 1deg"), "'0x7fg'"},
	    {SIGNAL_DEVICE("id: 1, scale: 0"), "makes everything 0"},
	    {SIGNAL_DEVICE("id: 1"), "`scale` is missing"},
	    {SIGNAL_DEVICE("id: 1, scale: 1deg, start: 500, length: 16"), "beyond the 512"},
	    {SIGNAL_DEVICE("id: 1, scale: 1deg, start: 511, length: 9, order: motorola"), "beyond the 512"},
	    {SIGNAL_DEVICE("id: 1, scale: 1deg, type: float"), "32 or 64 bits"},
	    {SIGNAL_DEVICE("id: 1, scale: 1deg, counter: {start: 505, length: 8}"), "beyond the 512"},
	    {SIGNAL_DEVICE("id: 1, scale: 1deg, mux: {start: 0, length: 8}"), "`value` is missing"},
	};
	for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++)
		assert_refused(bad[i].text, "f.yaml:1: devices[0].angle", bad[i].sentence);
	struct config c;
	struct config_error error; /* the last bit of the longest frame, either way */
	assert_int_equal(read_text(SIGNAL_DEVICE("id: 1, scale: 1deg, start: 496, length: 16"), &c, &error), 0);
	assert_int_equal(
	    read_text(SIGNAL_DEVICE("id: 1, scale: 1deg, start: 511, length: 8, order: motorola"), &c, &error), 0);
}

static void a_bus_is_shared_by_those_who_can(void **state)
{
	(void)state;
	static const char modbus[] = "{name: %s, driver: modbus, connect: /dev/s, unit: %d, baud: %d, "
	                             "position: {address: 0, scale: 1deg}}";
	static const char drive[] = "{name: %s, driver: canopen, connect: can0, node: %d, sync: %s}";
	char one[300], other[300], text[700];
	struct config c;
	struct config_error error;
	snprintf(one, sizeof(one), modbus, "a", 1, 19200);
	snprintf(other, sizeof(other), modbus, "b", 2, 19200);
	snprintf(text, sizeof(text), "devices: [%s, %s]", one, other);
	assert_int_equal(read_text(text, &c, &error), 0);
	snprintf(other, sizeof(other), modbus, "b", 1, 19200);
	snprintf(text, sizeof(text), "devices: [%s, %s]", one, other);
	assert_refused(text, "f.yaml:1: devices[1]", "already the line of 'a'");
	snprintf(other, sizeof(other), modbus, "b", 2, 9600);
	snprintf(text, sizeof(text), "devices: [%s, %s]", one, other);
	assert_refused(text, "f.yaml:1: devices[1]", "already the line of 'a'");
	snprintf(one, sizeof(one), drive, "a", 4, "10ms");
	snprintf(other, sizeof(other), drive, "b", 5, "0");
	snprintf(text, sizeof(text), "devices: [%s, %s]", one, other);
	assert_int_equal(read_text(text, &c, &error), 0);
	snprintf(other, sizeof(other), drive, "b", 5, "5ms");
	snprintf(text, sizeof(text), "devices: [%s, %s]", one, other);
	assert_refused(text, "f.yaml:1: devices[1].sync", "already sends SYNC");
	snprintf(other, sizeof(other), drive, "b", 4, "0");
	snprintf(text, sizeof(text), "devices: [%s, %s]", one, other);
	assert_refused(text, "f.yaml:1: devices[1].node", "already the node of 'a'");
}

static void servos_and_wheels_that_make_no_sense_are_refused(void **state)
{
	(void)state;
	static const char drive[] = "devices: [{name: d, driver: canopen, connect: can0, node: 5, scale: 1deg, "
	                            "limits: [-50deg, 50deg]%s}]\nsweep: {device: d, from: %s, to: 45deg%s}";
	char text[600];
	struct config c;
	struct config_error error;
	snprintf(text, sizeof(text), drive, "", "-45deg", ", rest: 0deg");
	assert_int_equal(read_text(text, &c, &error), 0);
	snprintf(text, sizeof(text), drive, "", "-51deg", "");
	assert_refused(text, "f.yaml:2: sweep.from", "outside the limits of 'd'");
	snprintf(text, sizeof(text), drive, "", "-45deg", ", rest: 60deg");
	assert_refused(text, "f.yaml:2: sweep.rest", "outside the limits of 'd'");
	snprintf(text, sizeof(text), drive, ", kind: encoder", "-45deg", "");
	assert_refused(text, "f.yaml:2: sweep.device", "only tells its angle");
	snprintf(text, sizeof(text), drive, ", wrap: 360", "-45deg", "");
	assert_refused(text, "f.yaml:2: sweep.device", "whole turns away");
	snprintf(text, sizeof(text), drive, ", sync: 51ms, mode: velocity", "-45deg", "");
	assert_refused(text, "f.yaml:2: sweep.device", "50ms at most");
	snprintf(text, sizeof(text), drive, ", sync: 50ms, mode: cyclic", "-45deg", "");
	assert_int_equal(read_text(text, &c, &error), 0);
	snprintf(text, sizeof(text), drive, ", sync: 51ms", "-45deg", "");
	assert_int_equal(read_text(text, &c, &error), 0);
	snprintf(text, sizeof(text), drive, ", master: 5", "-45deg", "");
	assert_refused(text, "f.yaml:1: devices[0].node", "our own id");
	assert_refused("devices: [{name: a, driver: canopen, connect: can0, node: 5, kind: drive}]",
	               "f.yaml:1: devices[0]", "`scale` is missing");
	assert_refused("devices: [{name: a, driver: canopen, connect: /dev/can0, node: 5}]",
	               "f.yaml:1: devices[0].connect", "no CAN interface");
	assert_refused("devices: [{name: a, driver: canopen, connect: an_interface_that_is_long, node: 5}]",
	               "f.yaml:1: devices[0].connect", "no CAN interface");
	assert_refused("devices: [{name: a, driver: canopen, connect: can0, node: 5, sync: 1us}]",
	               "f.yaml:1: devices[0]", "at least 1ms");
	assert_refused("devices: [{name: a, driver: canopen, connect: can0, node: 5, heartbeat: 1ms}]",
	               "f.yaml:1: devices[0]", "at least 10ms");
	assert_refused("devices: [{name: a, driver: odometry, connect: can0}]", "f.yaml:1: devices[0]",
	               "either `speed` and `turn`, or");
	assert_refused(
	    "devices: [{name: a, driver: odometry, connect: can0, speed: {id: 1, scale: 1}, left: {id: 2, scale: 1}}]",
	    "f.yaml:1: devices[0]", "either `speed` and `turn`, or");
	assert_refused("devices: [{name: a, driver: odometry, connect: can0, right: {id: 1, scale: 1mm}, "
	               "left: {id: 2, scale: 1mm}}]",
	               "f.yaml:1: devices[0].track", "between the wheels");
}

static void values_of_a_scanner_out_of_range_are_refused(void **state)
{
	(void)state;
	static const struct {
		const char *more, *sentence;
	} bad[] = {
	    {"protocol: c", "one of auto, a, b"},
	    {"frequency: 0", "outside keep or 1Hz .. 600Hz"},
	    {"frequency: 25deg", "use one of Hz"},
	    {"resolution: 0.5", "outside keep or 0.01deg .. 10deg (a number without a unit is in radians"},
	    {"angles: [45deg, -45deg]", "the first number must be smaller"},
	    {"angles: [-200deg, 0]", "-180deg .. 180deg"},
	    {"every: 0", "outside keep or 1 .. 1000"},
	    {"every: 1.5", "not a whole number"},
	    {"remission: 12", "one of keep, off, 8, 16"},
	    {"stamp: middle", "one of auto, start, end"},
	    {"latency: 2s", "-1s .. 1s"},
	    {"latency: 5m", "use one of h, min, s"},
	    {"range: [1, 200]", "0 .. 100m"},
	    {"indices: on", "'indices' is a key of lms2xx, not of lms1xx"},
	};
	char text[400];
	for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
		snprintf(text, sizeof(text), "devices:\n- {name: s, driver: lms1xx, connect: 10.0.0.1, %s}",
		         bad[i].more);
		assert_refused(text, "f.yaml:2: devices[0]", bad[i].sentence);
	}
	static const char *const ports[] = {"usb:",          "usb:0403",       "usb:403:6001",
	                                    "usb:0403:60g1", "usb:0403:6001:", "usb:04036001"};
	for (size_t i = 0; i < sizeof(ports) / sizeof(ports[0]); i++) {
		snprintf(text, sizeof(text), "devices: [{name: l, driver: lms2xx, port: '%s'}]", ports[i]);
		assert_refused(text, "f.yaml:1:", "is not usb:VENDOR:PRODUCT[:SERIAL]");
	}
	assert_refused("devices: [{name: l, driver: lms2xx, port: /l, indices: off}]", "f.yaml:1:", "one of keep, on");
	assert_refused("devices: [{name: l, driver: lms2xx, port: /l, latency: -1.5s}]", "f.yaml:1:", "-1s .. 1s");
}

static char *manual(size_t *len)
{
	char *text = NULL;
	FILE *out = open_memstream(&text, len);
	assert_non_null(out);
	keys_write_manual(out);
	fclose(out);
	return text;
}

static void the_manual_in_the_repository_is_the_tables(void **state)
{
	(void)state;
	size_t len;
	char *text = manual(&len);
	FILE *file = fopen("config/facetd.yaml", "r");
	assert_non_null(file);
	char *kept = calloc(1, len + 2);
	assert_non_null(kept);
	const size_t n = fread(kept, 1, len + 2, file);
	fclose(file);
	if (n != len || memcmp(kept, text, len))
		fail_msg("config/facetd.yaml differs from the table: run build/tests/test_config --write-manual");
	free(kept);
	free(text);
}

static void the_manual_is_a_configuration_and_names_every_key(void **state)
{
	(void)state;
	size_t len;
	char *text = manual(&len), word[64];
	struct config c;
	struct config_error error;
	if (config_read(text, len, "config/facetd.yaml", &c, &error))
		fail_msg("%s", error.text);
	assert_int_equal(c.devices, 10); /* one of each driver */
	assert_true(c.sweep.set);
	for (const struct key *key = key_table; key->name; key++) {
		snprintf(word, sizeof(word), "%s:", key->name);
		if (!strstr(text, word))
			fail_msg("the manual does not name '%s'", key->name);
	}
	free(text);
}

static int write_manual(void)
{
	FILE *file = fopen("config/facetd.yaml", "w");
	if (!file)
		return 1;
	keys_write_manual(file);
	return fclose(file) != 0;
}

int main(int argc, char **argv)
{
	if (argc > 1 && strcmp(argv[1], "--write-manual") == 0)
		return write_manual();
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(every_value_of_a_whole_file_arrives_in_si),
	    cmocka_unit_test(every_value_of_a_device_arrives),
	    cmocka_unit_test(an_empty_file_gives_the_defaults),
	    cmocka_unit_test(an_unknown_key_names_its_line_and_the_nearest_key),
	    cmocka_unit_test(a_value_out_of_range_names_the_range),
	    cmocka_unit_test(a_number_is_a_number_with_a_unit_of_its_kind),
	    cmocka_unit_test(a_key_written_twice_is_refused_wherever_it_stands),
	    cmocka_unit_test(what_comes_later_is_accepted_at_its_default_only),
	    cmocka_unit_test(a_page_beyond_loopback_needs_a_token_and_tls),
	    cmocka_unit_test(recordings_have_limits_or_none),
	    cmocka_unit_test(names_must_lead_somewhere),
	    cmocka_unit_test(every_driver_gets_what_it_needs),
	    cmocka_unit_test(registers_that_cannot_be_are_refused),
	    cmocka_unit_test(nobody_gets_in_from_outside),
	    cmocka_unit_test(lists_have_the_length_they_need),
	    cmocka_unit_test(seventeen_devices_are_too_many),
	    cmocka_unit_test(what_is_not_yaml_names_its_line),
	    cmocka_unit_test(size_and_depth_are_bounded),
	    cmocka_unit_test(every_shorter_file_is_taken_or_refused_in_peace),
	    cmocka_unit_test(memory_that_runs_out_anywhere_is_said_and_nothing_is_kept),
	    cmocka_unit_test(edit_distance_counts_swaps_as_one),
	    cmocka_unit_test(every_value_of_a_scanner_arrives),
	    cmocka_unit_test(a_scanner_that_is_only_plugged_in_keeps_its_own_settings),
	    cmocka_unit_test(a_scanner_is_connected_in_a_way_it_has),
	    cmocka_unit_test(two_scanners_have_two_lines),
	    cmocka_unit_test(only_who_has_an_encoder_or_a_servo_tilts),
	    cmocka_unit_test(a_signal_of_a_can_frame_is_read_as_a_dbc_file_has_it),
	    cmocka_unit_test(a_signal_that_no_frame_can_hold_is_refused),
	    cmocka_unit_test(a_bus_is_shared_by_those_who_can),
	    cmocka_unit_test(servos_and_wheels_that_make_no_sense_are_refused),
	    cmocka_unit_test(values_of_a_scanner_out_of_range_are_refused),
	    cmocka_unit_test(the_scanner_gets_its_mount_masks_and_pose),
	    cmocka_unit_test(the_manual_in_the_repository_is_the_tables),
	    cmocka_unit_test(the_manual_is_a_configuration_and_names_every_key),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}

/* Adding a key: one entry here, and a field in config.h where it is stored. The reader (config.c) knows types, never
 * names; what one key says about another is in check.c. Order in the table is order in the manual.
 *
 * Keys that belong to later work are in the table with `later`: they are accepted at their default, so that a file
 * written for a newer version can be read as long as it asks for nothing this version cannot do. */
#include "config/keys.h"

#include <stddef.h>
#include <string.h>

#define CONFIG(member) .offset = offsetof(struct config, member), .size = sizeof(((struct config *)0)->member)
#define DEVICE(member) \
	.offset = offsetof(struct config_device, member), .size = sizeof(((struct config_device *)0)->member)
#define REGISTER_(member) \
	.offset = offsetof(struct config_register, member), .size = sizeof(((struct config_register *)0)->member)
#define WRITE(member) \
	.offset = offsetof(struct config_write, member), .size = sizeof(((struct config_write *)0)->member)
#define SIGNAL(member) \
	.offset = offsetof(struct config_signal, member), .size = sizeof(((struct config_signal *)0)->member)
#define DEVICE_FLAG(member) .flag = offsetof(struct config_device, member)
#define DEG(x)              ((x)*0.017453292519943295)
#define MEGA                1048576.0

/* clang-format off */
const struct key key_table[] = {
	{GROUP_TOP, "map", KEY_GROUP, .inner = GROUP_MAP, .help = "The map: a signed distance in every voxel near a surface, turned into triangles."},
	{GROUP_TOP, "robot", KEY_GROUP, .inner = GROUP_ROBOT, .help = "The robot's own body and what it can climb."},
	{GROUP_TOP, "mount", KEY_GROUP, .inner = GROUP_MOUNT, .help = "Where the scanner sits: map <- base <- tilt axis <- laser, x forward, y left, z up. The lever arm from the axis to the mirror's centre matters: without it walls become double."},
	{GROUP_TOP, "devices", KEY_DEVICES, .inner = GROUP_DEVICE, .help = "What is plugged in; at most 16. Every device has a name and a driver: lms2xx (SICK LMS200, 211, 220, 221, 291), tim (SICK TiM3xx, 5xx, 7xx), lms1xx, lms5xx, modbus and canopen (servos that tilt the scanner, or tell its angle), can (its angle in a CAN frame), pose (the robot's localisation), odometry (the motion of its wheels, in CAN frames), carmen (lines of a CARMEN log, for replay only)."},
	{GROUP_TOP, "sweep", KEY_GROUP, .inner = GROUP_SWEEP, .flag = offsetof(struct config, sweep.set), .help = "How the servo is commanded. Without this section it is only listened to."},
	{GROUP_TOP, "listen", KEY_GROUP, .inner = GROUP_LISTEN, .help = "Where clients connect."},
	{GROUP_TOP, "record", KEY_GROUP, .inner = GROUP_RECORD, .help = "Recordings of what the devices sent."},
	{GROUP_TOP, "state", KEY_GROUP, .inner = GROUP_STATE, .help = "The map on disk, over restarts."},

	{GROUP_MAP, "cell", KEY_REAL, .preset = "0.05", .dimension = DIMENSION_LENGTH, .min = 0.01, .max = 1, CONFIG(map.cell_m), .help = "Edge of a voxel. Half of it needs four times the memory."},
	{GROUP_MAP, "field", KEY_CHOICE, .preset = "distance", .choices = "distance|hoppe|direct", .later = "the fields hoppe and direct", .help = "How a corner gets its value."},
	{GROUP_MAP, "planes", KEY_SWITCH, .preset = "off", CONFIG(map.planes), .later = "the map-wide registry of planes", .help = "Pull vertices onto planes found over the whole map."},
	{GROUP_MAP, "reduce", KEY_SWITCH, .preset = "on", CONFIG(map.reduce), .help = "Replace flat parts by few large triangles."},
	{GROUP_MAP, "tolerance", KEY_REAL, .preset = "0.25", .min = 0.01, .max = 1, CONFIG(map.tolerance), .help = "How far the reduced surface may be from the unreduced one, in cells."},
	{GROUP_MAP, "snap", KEY_REAL, .preset = "0.15", .min = 0, .max = 0.5, CONFIG(map.snap), .help = "How far a vertex may be moved onto a plane, in cells. Used with planes only."},
	{GROUP_MAP, "lookahead", KEY_INTEGER, .preset = "2", .min = 0, .max = 2, CONFIG(map.lookahead), .help = "Rows a row waits for, so that its normals know both sides. Counts as latency."},
	{GROUP_MAP, "memory", KEY_INTEGER, .preset = "256M", .dimension = DIMENSION_BYTES, .min = 16 * MEGA, .max = 65536 * MEGA, CONFIG(map.memory), .help = "What the voxels of the map may take. At the limit new blocks are refused, counted and reported; meshes and what is on its way to clients come on top."},
	{GROUP_MAP, "hold", KEY_DURATION, .preset = "30ms", .dimension = DIMENSION_TIME, .min = 0, .max = 1, CONFIG(map.hold_ns), .help = "How long a profile waits for newer tilt and pose samples."},
	{GROUP_MAP, "archive", KEY_TEXT, .preset = "", CONFIG(map.archive), .help = "Where a map that ends by `on_jump: new_map` is saved, as ID.ply; empty: the working directory."},
	{GROUP_MAP, "window", KEY_TEXT, .preset = "none", .later = "a map that forgets what lies far behind", .help = "Keep only what is near the robot."},

	{GROUP_ROBOT, "box", KEY_GROUP, .inner = GROUP_BOX, .flag = offsetof(struct config, robot.has_box), .example = "{min: [-0.4, -0.3, -0.5], max: [0.3, 0.3, 0.2]}", .help = "Beams that end in this box of the base frame are the robot itself: dropped, and they clear nothing. Leave it out where no beam can hit the robot."},
	{GROUP_ROBOT, "step", KEY_REAL, .preset = "0.05", .dimension = DIMENSION_LENGTH, .min = 0, .max = 1, .later = "the classes of surfaces", .help = "Height the robot can climb."},
	{GROUP_ROBOT, "slope", KEY_REAL, .preset = "15deg", .dimension = DIMENSION_ANGLE, .min = 0, .max = DEG(90), .later = "the classes of surfaces", .help = "Slope the robot can climb."},
	{GROUP_BOX, "min", KEY_VECTOR, .required = true, .dimension = DIMENSION_LENGTH, .min = -100, .max = 100, CONFIG(robot.box_min), .help = "Lower corner: x, y, z."},
	{GROUP_BOX, "max", KEY_VECTOR, .required = true, .dimension = DIMENSION_LENGTH, .min = -100, .max = 100, CONFIG(robot.box_max), .help = "Upper corner: x, y, z."},

	{GROUP_MOUNT, "base_tilt", KEY_TRANSFORM, .preset = "{xyz: [0, 0, 0], rpy: [0, 0, 0]}", .example = "{xyz: [0.2, 0, 0.4], rpy: [0, 0, 0]}", .inner = GROUP_FRAME, CONFIG(mount.base_tilt), .help = "The tilt axis in the base frame: the axis is y, positive angles look down. Without a servo: where the scanner is mounted."},
	{GROUP_MOUNT, "tilt_laser", KEY_TRANSFORM, .preset = "{xyz: [0, 0, 0], rpy: [0, 0, 0]}", .example = "{xyz: [0, 0, 0.05], rpy: [0, 0, 0]}", .inner = GROUP_FRAME, CONFIG(mount.tilt_laser), .help = "The mirror's centre, seen from the axis at angle 0."},
	{GROUP_FRAME, "xyz", KEY_VECTOR, .preset = "[0, 0, 0]", .dimension = DIMENSION_LENGTH, .min = -1e6, .max = 1e6, .offset = 0, .size = sizeof(struct vec3), .help = "Position."},
	{GROUP_FRAME, "rpy", KEY_VECTOR, .preset = "[0, 0, 0]", .dimension = DIMENSION_ANGLE, .min = DEG(-360), .max = DEG(360), .offset = sizeof(struct vec3), .size = sizeof(struct vec3), .help = "Roll, pitch, yaw about the fixed axes x, y, z."},

	{GROUP_DEVICE, "name", KEY_TEXT, KEY_ALL, .required = true, DEVICE(name), .help = "What messages, `tilt` and `sweep.device` call it: letters, digits, - and _."},
	{GROUP_DEVICE, "driver", KEY_TEXT, KEY_ALL, .required = true, .choices = "lms2xx|modbus|pose|tim|lms1xx|lms5xx|can|canopen|odometry|carmen", DEVICE(driver), .help = "What it is."},

	{GROUP_DEVICE, "port", KEY_TEXT, KEY_LMS2XX, .required = true, .example = "/dev/ttyUSB0", DEVICE(port), .help = "Serial line: a path (names under /dev/serial/by-id/ stay the same over reboots), or usb:VENDOR:PRODUCT[:SERIAL], an adapter wherever it is plugged in."},
	{GROUP_DEVICE, "baud", KEY_INTEGER, KEY_LMS2XX, .preset = "38400", .example = "500000", .choices = "9600|19200|38400|500000", DEVICE(baud), .help = "Rate to stream at; the rate the scanner has now is found. 500000 needs RS-422."},
	{GROUP_DEVICE, "variant", KEY_VARIANT, KEY_LMS2XX, .preset = "180/0.5", .choices = "180/1|180/0.5|180/0.25|100/1|100/0.5|100/0.25", .help = "Field of view / resolution in degrees. 180/0.25 is made of partial scans."},
	{GROUP_DEVICE, "unit", KEY_CHOICE, KEY_LMS2XX, .preset = "keep", .choices = "keep|mm|cm", DEVICE(range_unit), .help = "Unit of its ranges; keep: as the scanner is set. Changing it writes its memory, which wears."},
	{GROUP_DEVICE, "mode", KEY_INTEGER, KEY_LMS2XX, .preset = "keep", .word = "keep", .word_value = -1, .choices = "0|1|2|3|4|5|6|15", DEVICE(mode), .help = "Measuring mode: how many bits are range (0-2: 13, 3-4: 14, 5-6: 15, 15: 16)."},
	{GROUP_DEVICE, "indices", KEY_CHOICE, KEY_LMS2XX, .preset = "keep", .choices = "keep|on", DEVICE(indices), .help = "Real-time indices: a count of turns in every profile, the steadiest time base there is; keep: as the scanner is set. Changing it writes its memory, which wears."},

	{GROUP_DEVICE, "connect", KEY_TEXT, KEY_TIM, .required = true, .example = "usb", DEVICE(connect), .help = "usb; usb:SERIAL or usb:BUS-PORT (like usb:1-1.2) where there are several, `facet devices` lists them; or HOST[:PORT], HOST a number, port 2112 where none is written."},
	{GROUP_DEVICE, "connect", KEY_TEXT, KEY_LMS1XX, .required = true, .example = "192.168.0.1", DEVICE(connect), .help = "HOST[:PORT], HOST a number, port 2112 where none is written."},
	{GROUP_DEVICE, "connect", KEY_TEXT, KEY_LMS5XX, .required = true, .example = "\"192.168.0.2:2112\"", DEVICE(connect), .help = "HOST[:PORT], HOST a number, port 2112 where none is written."},
	{GROUP_DEVICE, "protocol", KEY_CHOICE, KEY_COLA, .preset = "auto", .choices = "auto|a|b", DEVICE(protocol), .help = "CoLa dialect, text or binary; auto: found by trying."},
	{GROUP_DEVICE, "frequency", KEY_REAL, KEY_COLA, .preset = "keep", .word = "keep", .word_value = 0, .dimension = DIMENSION_FREQUENCY, .min = 1, .max = 600, DEVICE(frequency_hz), .help = "Of the mirror; keep: as the scanner is set. Frequency and resolution go together: LMS1xx 25Hz with 0.25deg, 50Hz with 0.5deg; LMS5xx 25Hz with 0.1667deg or 0.25deg, 35Hz, 50Hz with 0.3333deg or 0.5deg, 75Hz, 100Hz with 0.6667deg or 1deg. Most TiM have one only."},
	{GROUP_DEVICE, "resolution", KEY_REAL, KEY_COLA, .preset = "keep", .word = "keep", .word_value = 0, .dimension = DIMENSION_ANGLE, .min = DEG(0.01), .max = DEG(10), DEVICE(resolution_rad), .help = "Between two beams; keep: as the scanner is set."},
	{GROUP_DEVICE, "angles", KEY_PAIR, KEY_COLA, .dimension = DIMENSION_ANGLE, .min = DEG(-180), .max = DEG(180), DEVICE(angles_from_rad), .help = "The part of the field of view that is sent, e.g. [-90deg, 90deg]: 0 is straight ahead, positive left. Left out: as the scanner is set."},
	{GROUP_DEVICE, "every", KEY_INTEGER, KEY_COLA, .preset = "keep", .word = "keep", .word_value = 0, .min = 1, .max = 1000, DEVICE(every), .help = "Every n-th scan is sent; keep: as the scanner is set."},
	{GROUP_DEVICE, "remission", KEY_CHOICE, KEY_COLA, .preset = "keep", .choices = "keep|off|8|16", DEVICE(remission), .help = "Bits of remission sent with every beam; keep: as the scanner is set."},
	{GROUP_DEVICE, "stamp", KEY_CHOICE, KEY_COLA, .preset = "auto", .choices = "auto|start|end", DEVICE(stamp), .help = "What the scanner's time stamp marks: the start or the end of a scan; auto: by the model."},
	{GROUP_DEVICE, "message", KEY_TEXT, KEY_CARMEN, .preset = "", .example = "ROBOTLASER1", DEVICE(message), .help = "The message that is this scanner; empty: the front one, FLASER, ROBOTLASER1 or RAWLASER1."},
	{GROUP_DEVICE, "encoder", KEY_GROUP, KEY_CARMEN, .example = "{scale: 57.29578deg, zero: 0, sign: 1}", .inner = GROUP_ENCODER, .flag = offsetof(struct config_device, encoder.set), .help = "What the tilt of a PANTILT line (radians) means: angle = sign * scale * (tilt - zero). Left out: it is the angle, positive looks down. Name this device as `tilt`."},
	{GROUP_DEVICE, "encoder", KEY_GROUP, KEY_LMS1XX | KEY_LMS5XX, .example = "{scale: 0.01deg, zero: 0, sign: 1}", .inner = GROUP_ENCODER, .flag = offsetof(struct config_device, encoder.set), .help = "An incremental encoder on the scanner's own inputs, whose ticks come with every profile: angle = sign * scale * (ticks - zero). Name this device as `tilt`, its own or another scanner's."},

	{GROUP_DEVICE, "latency", KEY_DURATION, KEY_SCANNER, .preset = "0", .dimension = DIMENSION_TIME, .min = -1, .max = 1, DEVICE(latency_ns), .help = "How much earlier a profile was measured than its time says; calibrated, may be negative."},
	{GROUP_DEVICE, "range", KEY_PAIR, KEY_LMS2XX, .preset = "[0.05, 82]", .example = "[0.3, 30]", .dimension = DIMENSION_LENGTH, .min = 0, .max = 100, DEVICE(range_min_m), .help = "Beams outside are dropped and clear nothing."},
	{GROUP_DEVICE, "range", KEY_PAIR, KEY_TIM, .preset = "[0.05, 25]", .dimension = DIMENSION_LENGTH, .min = 0, .max = 100, DEVICE(range_min_m), .help = "Beams outside are dropped and clear nothing."},
	{GROUP_DEVICE, "range", KEY_PAIR, KEY_LMS1XX, .preset = "[0.05, 50]", .dimension = DIMENSION_LENGTH, .min = 0, .max = 100, DEVICE(range_min_m), .help = "Beams outside are dropped and clear nothing."},
	{GROUP_DEVICE, "range", KEY_PAIR, KEY_LMS5XX, .preset = "[0.05, 82]", .dimension = DIMENSION_LENGTH, .min = 0, .max = 100, DEVICE(range_min_m), .help = "Beams outside are dropped and clear nothing."},
	{GROUP_DEVICE, "range", KEY_PAIR, KEY_CARMEN, .preset = "[0.05, 80]", .dimension = DIMENSION_LENGTH, .min = 0, .max = 100, DEVICE(range_min_m), .help = "Beams outside are dropped and clear nothing."},
	{GROUP_DEVICE, "mask", KEY_MASKS, KEY_SCANNER, .preset = "[]", .dimension = DIMENSION_ANGLE, .min = DEG(-180), .max = DEG(180), .help = "Bearings left out, e.g. [[-90deg, -80deg]]: 0 is straight ahead, positive left."},
	{GROUP_DEVICE, "tilt", KEY_TILT, KEY_SCANNER, .preset = "0deg", .example = "servo", .dimension = DIMENSION_ANGLE, .min = DEG(-180), .max = DEG(180), .help = "The device that tilts this one, or the fixed angle at which it is mounted."},

	{GROUP_DEVICE, "connect", KEY_TEXT, KEY_MODBUS, .required = true, .example = "/dev/ttyUSB1", DEVICE(connect), .help = "Serial line (RTU) or HOST:PORT (TCP)."},
	{GROUP_DEVICE, "baud", KEY_INTEGER, KEY_MODBUS, .preset = "115200", .min = 1200, .max = 4000000, DEVICE(baud), .help = "Rate of the serial line."},
	{GROUP_DEVICE, "parity", KEY_LETTER, KEY_MODBUS, .preset = "even", .choices = "none|even|odd", DEVICE(parity), .help = "Parity of the serial line; 8 data bits."},
	{GROUP_DEVICE, "unit", KEY_INTEGER, KEY_MODBUS, .preset = "1", .min = 1, .max = 247, DEVICE(slave), .help = "Modbus unit id."},
	{GROUP_DEVICE, "period", KEY_DURATION, KEY_MODBUS, .preset = "5ms", .dimension = DIMENSION_TIME, .min = 0, .max = 10, DEVICE(period_ns), .help = "Between two polls of the angle; 0: as fast as the answers come."},
	{GROUP_DEVICE, "address_base", KEY_INTEGER, KEY_MODBUS, .preset = "0", .min = 0, .max = 1, DEVICE(address_base), .help = "1 where the device's handbook counts registers from 1."},
	{GROUP_DEVICE, "position", KEY_REGISTER, KEY_MODBUS, .required = true, .example = "{function: 3, address: 0, type: i32, order: ABCD, scale: 0.001deg, zero: 0, sign: 1}", .inner = GROUP_REGISTER, DEVICE(position), .help = "Where the angle is read: angle = sign * scale * (raw - zero); positive looks down."},
	{GROUP_DEVICE, "target", KEY_REGISTER, KEY_MODBUS, .example = "{function: 16, address: 2, type: i32, scale: 0.001deg}", .inner = GROUP_REGISTER, DEVICE(target), .help = "Where the wanted angle is written; needed for `sweep`."},
	{GROUP_DEVICE, "speed", KEY_REGISTER, KEY_MODBUS, .example = "{function: 16, address: 4, type: u32, scale: 0.001deg/s}", .inner = GROUP_REGISTER, DEVICE(speed), .help = "Where the wanted speed is written."},
	{GROUP_DEVICE, "write", KEY_WRITES, KEY_MODBUS, .preset = "[]", .inner = GROUP_WRITE, DEVICE(write), .help = "Registers written at every start, in this order: enable, home, ... E.g. [{address: 16, value: 6}, {address: 16, value: 15, until: {address: 6, mask: 0x27, value: 0x27}}]."},
	{GROUP_DEVICE, "strobe", KEY_GROUP, KEY_MODBUS, .inner = GROUP_STROBE, DEVICE_FLAG(strobe.set), .example = "{address: 16, on: 31, off: 15}", .help = "For drives that take a target at an edge: written after every target, first `on`, then `off`."},
	{GROUP_DEVICE, "watchdog", KEY_GROUP, KEY_MODBUS, .inner = GROUP_WATCHDOG, DEVICE_FLAG(watchdog.set), .example = "{address: 20, value: 0, toggle: 1, period: 100ms}", .help = "The register by which the drive notices that facetd has died, and stops by itself. How long that takes is set in the drive."},
	{GROUP_DEVICE, "status", KEY_GROUP, KEY_MODBUS, .inner = GROUP_STATUS, DEVICE_FLAG(status.set), .example = "{function: 3, address: 6, fault: 0x08}", .help = "Where the drive says that it has a fault: the sweep stops then."},
	{GROUP_DEVICE, "reset", KEY_WRITES, KEY_MODBUS, .preset = "[]", .inner = GROUP_WRITE, DEVICE(reset), .help = "Registers written when `status` says fault, once; then `write` again. A fault that stays is reported."},
	{GROUP_DEVICE, "stop", KEY_WRITES, KEY_MODBUS, .preset = "[]", .inner = GROUP_WRITE, DEVICE(stop), .help = "Registers written at an orderly end, after the rest angle was reached: disable."},

	{GROUP_DEVICE, "connect", KEY_TEXT, KEY_ON_CAN, .required = true, .example = "can0", DEVICE(connect), .help = "The CAN interface, which the system brings up (`ip link set can0 up type can bitrate 500000 restart-ms 100`, or systemd-networkd); or unix:PATH, a socket that carries frames (docs/simulators.md)."},
	{GROUP_DEVICE, "angle", KEY_SIGNAL, KEY_CAN, .required = true, .inner = GROUP_SIGNAL, DEVICE(angle), .example = "{id: 0x181, start: 0, length: 16, order: intel, type: signed, scale: 0.01deg}", .help = "The frame and the bits that hold the angle; positive looks down."},
	{GROUP_DEVICE, "node", KEY_INTEGER, KEY_CANOPEN, .required = true, .example = "5", .min = 1, .max = 127, DEVICE(node), .help = "Its CANopen node id."},
	{GROUP_DEVICE, "master", KEY_INTEGER, KEY_CANOPEN, .preset = "127", .min = 1, .max = 127, DEVICE(master), .help = "The node id of facetd itself, which the drive's heartbeat consumer watches."},
	{GROUP_DEVICE, "kind", KEY_CHOICE, KEY_CANOPEN, .preset = "auto", .choices = "auto|drive|encoder|inclinometer", DEVICE(kind), .help = "drive: CiA 402; encoder: CiA 406; inclinometer: CiA 410; auto: by its object 1000."},
	{GROUP_DEVICE, "scale", KEY_REAL, KEY_CANOPEN, .preset = "0", .example = "0.001deg", .dimension = DIMENSION_ANGLE, .min = 0, .max = DEG(360), DEVICE(count.scale), .help = "Angle of one count; angle = sign * scale * (count - zero). 0: as the inclinometer says; an encoder and a drive need it."},
	{GROUP_DEVICE, "zero", KEY_REAL, KEY_CANOPEN, .preset = "0", DEVICE(count.zero), .help = "Counts at angle 0."},
	{GROUP_DEVICE, "sign", KEY_INTEGER, KEY_CANOPEN, .preset = "1", .choices = "1|-1", DEVICE(count.sign), .help = "-1 where the device counts up when the scanner looks up."},
	{GROUP_DEVICE, "wrap", KEY_REAL, KEY_CANOPEN, .preset = "0", .min = 0, .max = 4294967296.0, DEVICE(count.wrap), .help = "Counts after which the device counts from 0 again; 0: it never does."},
	{GROUP_DEVICE, "axis", KEY_CHOICE, KEY_CANOPEN, .preset = "longitudinal", .choices = "longitudinal|lateral", DEVICE(axis), .help = "Of an inclinometer: object 6010 or 6020."},
	{GROUP_DEVICE, "sync", KEY_DURATION, KEY_CANOPEN, .preset = "10ms", .dimension = DIMENSION_TIME, .min = 0, .max = 1, DEVICE(sync_ns), .help = "SYNC is sent so often, and the angle was measured at it; 0: somebody else sends it, or nobody."},
	{GROUP_DEVICE, "heartbeat", KEY_DURATION, KEY_CANOPEN, .preset = "200ms", .dimension = DIMENSION_TIME, .min = 0, .max = 10, DEVICE(heartbeat_ns), .help = "Heartbeats of both sides. The drive is told to stop when three of ours are missing; 0: none, and it then goes on if facetd dies."},
	{GROUP_DEVICE, "mode", KEY_CHOICE, KEY_CANOPEN, .preset = "position", .choices = "position|velocity|cyclic", DEVICE(drive_mode), .help = "How a drive is commanded: profile position, profile velocity, or cyclic synchronous position at every SYNC."},
	{GROUP_DEVICE, "acceleration", KEY_REAL, KEY_CANOPEN, .preset = "300deg", .dimension = DIMENSION_RATE, .min = DEG(0.1), .max = DEG(1e6), DEVICE(acceleration_rad_s2), .help = "Per second squared, at the turns."},
	{GROUP_DEVICE, "homing", KEY_GROUP, KEY_CANOPEN, .inner = GROUP_HOMING, DEVICE_FLAG(homing.set), .example = "{method: 35, speed: 5deg, offset: 0deg}", .help = "Left out: the drive knows where it is."},

	{GROUP_DEVICE, "limits", KEY_PAIR, KEY_SERVO, .dimension = DIMENSION_ANGLE, .min = DEG(-180), .max = DEG(180), .example = "[-70deg, 50deg]", DEVICE(limits_rad), DEVICE_FLAG(has_limits), .help = "Soft limits: a target outside is refused before it is sent. Those that a CANopen drive has itself hold too."},
	{GROUP_DEVICE, "following", KEY_REAL, KEY_SERVO, .preset = "10deg", .dimension = DIMENSION_ANGLE, .min = 0, .max = DEG(180), DEVICE(following_rad), .help = "Following error: so far from where it should be, the sweep stops and says so; 0: not judged."},
	{GROUP_DEVICE, "timeout", KEY_DURATION, KEY_ON_CAN, .preset = "500ms", .dimension = DIMENSION_TIME, .min = 0.01, .max = 60, DEVICE(timeout_ns), .help = "Without a good frame for so long, it counts as lost."},

	{GROUP_DEVICE, "speed", KEY_SIGNAL, KEY_ODOMETRY, .inner = GROUP_SIGNAL, DEVICE(ahead), .example = "{id: 0x200, start: 0, length: 16, scale: 1mm/s}", .help = "Forward speed, m/s."},
	{GROUP_DEVICE, "turn", KEY_SIGNAL, KEY_ODOMETRY, .inner = GROUP_SIGNAL, DEVICE(turn), .example = "{id: 0x200, start: 16, length: 16, scale: 0.1deg/s}", .help = "Rate of turn, positive to the left."},
	{GROUP_DEVICE, "left", KEY_SIGNAL, KEY_ODOMETRY, .inner = GROUP_SIGNAL, DEVICE(left), .help = "Instead of speed and turn: what the left wheel's encoder counts; scale is the way of one count, wrap where it counts from 0 again (written or not, its length in bits)."},
	{GROUP_DEVICE, "right", KEY_SIGNAL, KEY_ODOMETRY, .inner = GROUP_SIGNAL, DEVICE(right), .help = "The right wheel's."},
	{GROUP_DEVICE, "track", KEY_REAL, KEY_ODOMETRY, .preset = "0", .dimension = DIMENSION_LENGTH, .min = 0, .max = 10, DEVICE(track_m), .help = "Between the wheels; needed with left and right."},
	{GROUP_DEVICE, "drift", KEY_REAL, KEY_ODOMETRY, .preset = "0.02", .min = 0, .max = 1, DEVICE(drift), .help = "How wrong a way may be: sigma, metres per metre."},
	{GROUP_DEVICE, "turn_drift", KEY_REAL, KEY_ODOMETRY, .preset = "1deg", .dimension = DIMENSION_ANGLE, .min = 0, .max = DEG(90), DEVICE(turn_drift_rad_m), .help = "How wrong the heading becomes: sigma per metre, and per radian turned."},
	{GROUP_DEVICE, "trust", KEY_REAL, KEY_ODOMETRY, .preset = "0", .dimension = DIMENSION_LENGTH, .min = 0, .max = 1000, DEVICE(trust_m), .help = "Rows are dropped and counted while the position is less certain (sigma) than this, until an absolute pose comes; 0: odometry alone is good enough."},

	{GROUP_DEVICE, "listen", KEY_TEXT, KEY_POSE, .example = "unix:/run/facetd/pose.sock", DEVICE(listen), .help = "Datagram socket for poses as JSON lines: unix:PATH or udp:HOST:PORT on loopback."},
	{GROUP_DEVICE, "on_jump", KEY_CHOICE, KEY_POSE, .preset = "keep", .choices = "keep|ignore|new_map", DEVICE(on_jump), .help = "When the pose jumps (a loop was closed elsewhere), an event tells clients, and: keep: go on in the same map; ignore: hold the old correction; new_map: begin a new map and save the old one in map.archive."},
	{GROUP_DEVICE, "jump", KEY_REAL, KEY_POSE, .preset = "0.3", .dimension = DIMENSION_LENGTH, .min = 0.001, .max = 1000, DEVICE(jump_m), .help = "A pose so far from where the motion before it leads is a jump."},
	{GROUP_DEVICE, "jump_angle", KEY_REAL, KEY_POSE, .preset = "5deg", .dimension = DIMENSION_ANGLE, .min = DEG(0.1), .max = DEG(180), DEVICE(jump_rad), .help = "The same for its direction."},
	{GROUP_DEVICE, "fixed", KEY_TRANSFORM, KEY_POSE, .inner = GROUP_FRAME, DEVICE(fixed_pose), .flag = offsetof(struct config_device, fixed), .help = "Instead of `listen`: the robot stands here, e.g. {xyz: [0, 0, 0], rpy: [0, 0, 90deg]}."},

	{GROUP_REGISTER, "function", KEY_INTEGER, .preset = "auto", .word = "auto", .word_value = 0, .choices = "3|4|6|16", REGISTER_(function), .help = "Function code. Read: 3 holding, 4 input registers. Written: 6 single, 16 multiple. auto: 3 to read, 6 or 16 to write, by the type."},
	{GROUP_REGISTER, "address", KEY_INTEGER, .required = true, .min = 0, .max = 65535, REGISTER_(address), .help = "First register."},
	{GROUP_REGISTER, "type", KEY_CHOICE, .preset = "i16", .choices = "i16|u16|i32|u32|f32", REGISTER_(type), .help = "What it holds."},
	{GROUP_REGISTER, "order", KEY_CHOICE, .preset = "ABCD", .choices = "ABCD|CDAB|BADC|DCBA", REGISTER_(order), .help = "Order of the bytes of 32 bits; A is the highest. For 16 bits B before A in BADC, DCBA."},
	{GROUP_REGISTER, "scale", KEY_REAL, .required = true, .dimension = DIMENSION_RATE, .min = DEG(1e-6), .max = DEG(360), REGISTER_(scale), .help = "Angle (or angle per second) of one count, e.g. 0.001deg."},
	{GROUP_REGISTER, "zero", KEY_REAL, .preset = "0", REGISTER_(zero), .help = "Raw value at angle 0."},
	{GROUP_REGISTER, "sign", KEY_INTEGER, .preset = "1", .choices = "1|-1", REGISTER_(sign), .help = "-1 where the device counts up when the scanner looks up."},
	{GROUP_WRITE, "address", KEY_INTEGER, .required = true, .min = 0, .max = 65535, WRITE(address), .help = "Register."},
	{GROUP_WRITE, "value", KEY_INTEGER, .required = true, .min = 0, .max = 65535, WRITE(value), .help = "What is written there."},
	{GROUP_WRITE, "delay", KEY_DURATION, .preset = "0", .dimension = DIMENSION_TIME, .min = 0, .max = 60, WRITE(delay_ns), .help = "To wait after it was answered."},
	{GROUP_WRITE, "until", KEY_GROUP, .inner = GROUP_UNTIL, .flag = offsetof(struct config_write, until.set), .example = "{address: 6, mask: 4, value: 4, within: 5s}", .help = "The next step waits until this holding register says so."},
	{GROUP_UNTIL, "address", KEY_INTEGER, .required = true, .min = 0, .max = 65535, WRITE(until.address), .help = "Holding register."},
	{GROUP_UNTIL, "mask", KEY_INTEGER, .preset = "65535", .min = 1, .max = 65535, WRITE(until.mask), .help = "Its bits that matter."},
	{GROUP_UNTIL, "value", KEY_INTEGER, .required = true, .min = 0, .max = 65535, WRITE(until.value), .help = "What these bits must be."},
	{GROUP_UNTIL, "within", KEY_DURATION, .preset = "5s", .dimension = DIMENSION_TIME, .min = 0.01, .max = 300, WRITE(until.within_ns), .help = "Later it has failed."},
	{GROUP_STROBE, "address", KEY_INTEGER, .required = true, .min = 0, .max = 65535, DEVICE(strobe.address), .help = "Register."},
	{GROUP_STROBE, "on", KEY_INTEGER, .required = true, .min = 0, .max = 65535, DEVICE(strobe.on), .help = "Written first."},
	{GROUP_STROBE, "off", KEY_INTEGER, .required = true, .min = 0, .max = 65535, DEVICE(strobe.off), .help = "Written then."},
	{GROUP_WATCHDOG, "address", KEY_INTEGER, .required = true, .min = 0, .max = 65535, DEVICE(watchdog.address), .help = "Register."},
	{GROUP_WATCHDOG, "value", KEY_INTEGER, .preset = "1", .min = 0, .max = 65535, DEVICE(watchdog.value), .help = "What is written there."},
	{GROUP_WATCHDOG, "toggle", KEY_INTEGER, .preset = "0", .min = 0, .max = 65535, DEVICE(watchdog.toggle), .help = "Its bits that change every time."},
	{GROUP_WATCHDOG, "period", KEY_DURATION, .preset = "100ms", .dimension = DIMENSION_TIME, .min = 0.01, .max = 60, DEVICE(watchdog.period_ns), .help = "How often."},
	{GROUP_STATUS, "function", KEY_INTEGER, .preset = "3", .choices = "3|4", DEVICE(status.function), .help = "3 holding, 4 input registers."},
	{GROUP_STATUS, "address", KEY_INTEGER, .required = true, .min = 0, .max = 65535, DEVICE(status.address), .help = "Register."},
	{GROUP_STATUS, "fault", KEY_INTEGER, .required = true, .min = 1, .max = 65535, DEVICE(status.fault), .help = "Bits of which none is set while all is well."},

	{GROUP_SIGNAL, "id", KEY_INTEGER, .required = true, .min = 0, .max = 536870911.0, SIGNAL(id), .help = "Identifier, 0x181 or 385; in a DBC file extended ones have 0x80000000 added: leave that out here."},
	{GROUP_SIGNAL, "extended", KEY_SWITCH, .preset = "off", SIGNAL(extended), .help = "An identifier of 29 bits."},
	{GROUP_SIGNAL, "start", KEY_INTEGER, .preset = "0", .min = 0, .max = 511, SIGNAL(start), .help = "Start bit as in a DBC file: intel, the lowest bit; motorola, the highest."},
	{GROUP_SIGNAL, "length", KEY_INTEGER, .preset = "16", .min = 1, .max = 64, SIGNAL(length), .help = "Bits."},
	{GROUP_SIGNAL, "order", KEY_CHOICE, .preset = "intel", .choices = "intel|motorola", SIGNAL(order), .help = "In a DBC file: @1 intel, @0 motorola."},
	{GROUP_SIGNAL, "type", KEY_CHOICE, .preset = "signed", .choices = "signed|unsigned|float", SIGNAL(type), .help = "In a DBC file: - signed, + unsigned."},
	{GROUP_SIGNAL, "scale", KEY_REAL, .required = true, .dimension = DIMENSION_SIGNAL, SIGNAL(scale), .help = "quantity = raw * scale + offset; negative where it counts the other way."},
	{GROUP_SIGNAL, "offset", KEY_REAL, .preset = "0", .dimension = DIMENSION_SIGNAL, SIGNAL(offset), .help = "The quantity where raw is 0."},
	{GROUP_SIGNAL, "wrap", KEY_REAL, .preset = "0", SIGNAL(wrap), .help = "Raw counts after which the device counts from 0 again; 0: it never does."},
	{GROUP_SIGNAL, "min_dlc", KEY_INTEGER, .preset = "0", .min = 0, .max = 64, SIGNAL(min_dlc), .help = "Shorter frames are refused; those that lack bits of the signal are in any case."},
	{GROUP_SIGNAL, "counter", KEY_GROUP, .inner = GROUP_COUNTER, .flag = offsetof(struct config_signal, counter.set), .example = "{start: 56, length: 8}", .help = "Bits that go up by one from frame to frame: lost frames are counted."},
	{GROUP_SIGNAL, "valid", KEY_GROUP, .inner = GROUP_VALID, .flag = offsetof(struct config_signal, valid.set), .example = "{bit: 48, value: 1}", .help = "The bit that says that the signal is good."},
	{GROUP_SIGNAL, "mux", KEY_GROUP, .inner = GROUP_MUX, .flag = offsetof(struct config_signal, mux.set), .example = "{start: 0, length: 8, value: 3}", .help = "Only frames whose multiplexor has this value hold the signal."},
	{GROUP_COUNTER, "start", KEY_INTEGER, .required = true, .min = 0, .max = 511, SIGNAL(counter.start), .help = "Start bit."},
	{GROUP_COUNTER, "length", KEY_INTEGER, .required = true, .min = 1, .max = 32, SIGNAL(counter.length), .help = "Bits."},
	{GROUP_VALID, "bit", KEY_INTEGER, .required = true, .min = 0, .max = 511, SIGNAL(valid.bit), .help = "Byte * 8 + bit."},
	{GROUP_VALID, "value", KEY_INTEGER, .preset = "1", .choices = "0|1", SIGNAL(valid.value), .help = "What it is while the signal is good."},
	{GROUP_MUX, "start", KEY_INTEGER, .required = true, .min = 0, .max = 511, SIGNAL(mux.start), .help = "Start bit."},
	{GROUP_MUX, "length", KEY_INTEGER, .required = true, .min = 1, .max = 32, SIGNAL(mux.length), .help = "Bits."},
	{GROUP_MUX, "value", KEY_INTEGER, .required = true, .min = 0, .max = 4294967295.0, SIGNAL(mux.value), .help = "What they must say."},

	{GROUP_HOMING, "method", KEY_INTEGER, .required = true, .min = -128, .max = 127, DEVICE(homing.method), .help = "CiA 402, object 6098: 35 or 37 here is home; 1, 2, 17, 18 limit switches; 33, 34 index; below 0 the maker's."},
	{GROUP_HOMING, "speed", KEY_REAL, .preset = "5deg", .dimension = DIMENSION_RATE, .min = DEG(0.001), .max = DEG(1000), DEVICE(homing.speed_rad_s), .help = "Per second."},
	{GROUP_HOMING, "offset", KEY_REAL, .preset = "0deg", .dimension = DIMENSION_ANGLE, .min = DEG(-360), .max = DEG(360), DEVICE(homing.offset_rad), .help = "The angle at the home position."},
	{GROUP_HOMING, "within", KEY_DURATION, .preset = "30s", .dimension = DIMENSION_TIME, .min = 0.1, .max = 600, DEVICE(homing.within_ns), .help = "Later it has failed."},

	{GROUP_ENCODER, "scale", KEY_REAL, .required = true, .dimension = DIMENSION_ANGLE, .min = DEG(1e-6), .max = DEG(360), DEVICE(encoder.scale), .help = "Angle of one tick, e.g. 0.01deg."},
	{GROUP_ENCODER, "zero", KEY_REAL, .preset = "0", DEVICE(encoder.zero), .help = "Ticks at angle 0."},
	{GROUP_ENCODER, "sign", KEY_INTEGER, .preset = "1", .choices = "1|-1", DEVICE(encoder.sign), .help = "-1 where the ticks count up when the scanner looks up."},
	{GROUP_ENCODER, "wrap", KEY_REAL, .preset = "0", .min = 0, .max = 4294967296.0, DEVICE(encoder.wrap), .help = "Ticks after which the device counts from 0 again; 0: 32 bits."},

	{GROUP_SWEEP, "device", KEY_TEXT, .required = true, .example = "servo", CONFIG(sweep.device), .help = "The servo."},
	{GROUP_SWEEP, "from", KEY_REAL, .preset = "-65deg", .dimension = DIMENSION_ANGLE, .min = DEG(-180), .max = DEG(180), CONFIG(sweep.from_rad), .help = "Upper end; positive looks down."},
	{GROUP_SWEEP, "to", KEY_REAL, .preset = "45deg", .dimension = DIMENSION_ANGLE, .min = DEG(-180), .max = DEG(180), CONFIG(sweep.to_rad), .help = "Lower end."},
	{GROUP_SWEEP, "speed", KEY_REAL, .preset = "30deg", .dimension = DIMENSION_RATE, .min = DEG(0.01), .max = DEG(1000), CONFIG(sweep.speed_rad_s), .help = "Per second. Rows lie speed / scan rate apart: 30deg/s at 37.5 Hz are 0.8 degree."},
	{GROUP_SWEEP, "profile", KEY_CHOICE, .preset = "triangle", .choices = "triangle|sinus|step", CONFIG(sweep.profile), .help = "triangle: even speed; sinus: slower at the ends; step: stands for every profile."},
	{GROUP_SWEEP, "step", KEY_REAL, .preset = "0.25deg", .dimension = DIMENSION_ANGLE, .min = DEG(0.001), .max = DEG(90), CONFIG(sweep.step_rad), .help = "Step of `profile: step`."},
	{GROUP_SWEEP, "settle", KEY_DURATION, .preset = "100ms", .dimension = DIMENSION_TIME, .min = 0, .max = 60, CONFIG(sweep.settle_ns), .help = "How long the servo stands after a step."},
	{GROUP_SWEEP, "rest", KEY_REAL, .dimension = DIMENSION_ANGLE, .min = DEG(-180), .max = DEG(180), CONFIG(sweep.rest_rad), .flag = offsetof(struct config, sweep.has_rest), .help = "Where it goes at the end, e.g. 0deg; left out: it stops where it is."},

	{GROUP_LISTEN, "native", KEY_TEXTS, .preset = "[unix:/run/facetd/facetd.sock, tcp:127.0.0.1:7878]", CONFIG(listen.native), .count = offsetof(struct config, listen.natives), .help = "The native protocol and JSON lines: unix:PATH, tcp:HOST:PORT; at most 4. TCP on loopback only: from elsewhere use ssh -L."},
	{GROUP_LISTEN, "group", KEY_TEXT, .preset = "facetd", CONFIG(listen.group), .help = "Group of the unix sockets (mode 0660). Where it does not exist or may not be given, they keep the daemon's own."},
	{GROUP_LISTEN, "send_buffer", KEY_INTEGER, .preset = "0", .dimension = DIMENSION_BYTES, .min = 0, .max = 64 * MEGA, CONFIG(listen.send_buffer), .help = "The kernel's buffer to each client; 0: the system's own."},
	{GROUP_LISTEN, "clients", KEY_INTEGER, .preset = "32", .min = 1, .max = 1024, CONFIG(listen.clients), .help = "At the limit the next one is told so and closed."},
	{GROUP_LISTEN, "http", KEY_TEXT, .preset = "127.0.0.1:7880", CONFIG(listen.http), .flag = offsetof(struct config, listen.http_set), .help = "HOST:PORT of the browser page, snapshots, figures and WebSockets; empty: none. Beyond loopback with token_file and tls only."},
	{GROUP_LISTEN, "token_file", KEY_TEXT, .preset = "", CONFIG(listen.token_file), .help = "File whose first line is the token, 16 letters or more, that HTTP clients must show to change something, and from beyond loopback to see anything. Not readable by everybody. Empty: over HTTP nothing can be changed."},
	{GROUP_LISTEN, "tls", KEY_GROUP, .inner = GROUP_TLS, .flag = offsetof(struct config, listen.has_tls), .example = "", .help = "HTTPS and WSS instead of HTTP and WS: {certificate: /etc/facetd/cert.pem, key: /etc/facetd/key.pem}."},
	{GROUP_LISTEN, "origins", KEY_TEXTS, .preset = "[]", CONFIG(listen.origin), .count = offsetof(struct config, listen.origins), .help = "Origins of other pages, like https://app.foxglove.dev, that may open WebSockets; at most 4. The page that facetd serves itself always may."},
	{GROUP_TLS, "certificate", KEY_TEXT, .required = true, CONFIG(listen.certificate), .help = "Certificate chain, PEM."},
	{GROUP_TLS, "key", KEY_TEXT, .required = true, CONFIG(listen.key), .help = "Its private key, PEM."},

	{GROUP_RECORD, "dir", KEY_TEXT, .preset = "", CONFIG(record.dir), .help = "Folder for recordings, begun with facetd; empty: only where a client asks for one."},
	{GROUP_RECORD, "chunk", KEY_DURATION, .preset = "1s", .dimension = DIMENSION_TIME, .min = 0.01, .max = 60, CONFIG(record.chunk_ns), .help = "What is written at once, and what a loss of power may cost."},
	{GROUP_RECORD, "max_size", KEY_INTEGER, .preset = "0", .dimension = DIMENSION_BYTES, .min = 0, .max = 1048576 * MEGA, CONFIG(record.max_size), .help = "Size at which a new file is begun; 0: never."},
	{GROUP_RECORD, "max_age", KEY_DURATION, .preset = "0", .dimension = DIMENSION_TIME, .min = 0, .max = 31536000, CONFIG(record.max_age_ns), .help = "Age at which a new file is begun; 0: never."},
	{GROUP_RECORD, "keep", KEY_INTEGER, .preset = "0", .dimension = DIMENSION_BYTES, .min = 0, .max = 1048576 * MEGA, CONFIG(record.keep), .help = "What all recordings in the folder may take: beyond, the oldest are deleted; 0: nothing is ever deleted."},
	{GROUP_RECORD, "messages", KEY_SWITCH, .preset = "off", CONFIG(record.messages), .help = "Record what is published, too, in Foxglove's schemas, so that other viewers open the file."},
	{GROUP_STATE, "file", KEY_TEXT, .preset = "", .later = "keeping the map over restarts", .help = "Where the map is kept."},
	{GROUP_STATE, "checkpoint", KEY_DURATION, .preset = "5min", .dimension = DIMENSION_TIME, .min = 1, .max = 86400, .later = "keeping the map over restarts", .help = "How often."},
	{0}
};
/* clang-format on */

static const char *const driver_names[] = {"lms2xx", "modbus",  "pose",     "tim",    "lms1xx", "lms5xx",
                                           "can",    "canopen", "odometry", "carmen", NULL};

unsigned keys_driver(const char *name)
{
	for (unsigned i = 0; driver_names[i]; i++)
		if (strcmp(driver_names[i], name) == 0)
			return 1u << i;
	return 0;
}

const char *keys_driver_name(unsigned bit)
{
	for (unsigned i = 0; driver_names[i]; i++)
		if (bit & 1u << i)
			return driver_names[i];
	return "";
}

static bool belongs(const struct key *key, enum key_group group, unsigned drivers)
{
	return key->group == group && (!drivers || !key->drivers || (key->drivers & drivers));
}

const struct key *keys_find(enum key_group group, const char *name, unsigned drivers)
{
	for (const struct key *key = key_table; key->name; key++)
		if (belongs(key, group, drivers) && strcmp(key->name, name) == 0)
			return key;
	return NULL;
}

const struct key *keys_nearest(enum key_group group, const char *name, unsigned drivers)
{
	const struct key *best = NULL;
	int best_distance = 0;
	for (const struct key *key = key_table; key->name; key++) {
		if (!belongs(key, group, drivers))
			continue;
		const int distance = keys_distance(key->name, name);
		if (!best || distance < best_distance) {
			best = key;
			best_distance = distance;
		}
	}
	return best;
}

static int least(int a, int b, int c)
{
	const int ab = a < b ? a : b;
	return ab < c ? ab : c;
}

/* Three rows of the usual table: the row before last is what a swap of neighbours reaches back to. */
int keys_distance(const char *a, const char *b)
{
	enum { LETTERS = 63 };
	int row[3][LETTERS + 1] = {0};
	const int na = (int)strnlen(a, LETTERS), nb = (int)strnlen(b, LETTERS);
	int *before = row[0], *last = row[1], *now = row[2];
	for (int j = 0; j <= nb; j++)
		last[j] = j;
	for (int i = 1; i <= na; i++) {
		now[0] = i;
		for (int j = 1; j <= nb; j++) {
			now[j] = least(last[j] + 1, now[j - 1] + 1, last[j - 1] + (a[i - 1] != b[j - 1]));
			if (i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] &&
			    before[j - 2] + 1 < now[j])
				now[j] = before[j - 2] + 1;
		}
		int *const free_row = before;
		before = last;
		last = now;
		now = free_row;
	}
	return last[nb];
}

static void print_choices(const struct key *key, char *ret, size_t cap)
{
	size_t n = (size_t)snprintf(ret, cap, "one of %s%s", key->word ? key->word : "", key->word ? ", " : "");
	for (const char *c = key->choices; *c && n + 3 < cap; c++) {
		ret[n++] = *c == '|' ? ',' : *c;
		if (*c == '|')
			ret[n++] = ' ';
	}
	ret[n] = '\0';
}

void keys_print_range(const struct key *key, char *ret, size_t cap)
{
	char min[32], max[32];
	ret[0] = '\0';
	if (key->type == KEY_SWITCH) {
		snprintf(ret, cap, "on or off");
	} else if (key->choices) {
		print_choices(key, ret, cap);
	} else if (key->min != 0 || key->max != 0) {
		units_print(key->min, key->dimension, min, sizeof(min));
		units_print(key->max, key->dimension, max, sizeof(max));
		snprintf(ret, cap, "%s%s%s .. %s", key->word ? key->word : "", key->word ? " or " : "", min, max);
	}
}

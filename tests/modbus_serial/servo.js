// A servo behind the Modbus server of npm's modbus-serial, for tests/e2e_modbus.sh: somebody else's bytes.
//   node servo.js tcp PORTFILE | rtu PATH
// Registers: 100,101 angle, 102,103 target (float32, degrees, low word first), 104 speed (u16, 0.1 degree/s),
// 110 control (1: enabled), 111 status (1: enabled, 2: a target was refused). SIGUSR1: it says what it did; so it does when it is ended.
"use strict";
const fs = require("fs");
const net = require("net");
const ModbusRTU = require("modbus-serial");

const registers = { 104: 300, 110: 0 };
const did = { reads: 0, targets: 0, turns: 0, refused: 0, low: 1e9, high: -1e9, bottom: 1e9, top: -1e9 };
let angle = 0, target = 0, direction = 0;
let at = process.hrtime.bigint();

function floatOf(low, high) {
    const b = Buffer.alloc(4);
    b.writeUInt16BE(high, 0);
    b.writeUInt16BE(low, 2);
    return b.readFloatBE(0);
}

function wordsOf(value) {
    const b = Buffer.alloc(4);
    b.writeFloatBE(value, 0);
    return [b.readUInt16BE(2), b.readUInt16BE(0)];
}

// It moves only when it is looked at: where it stands is a function of time.
function move() {
    const now = process.hrtime.bigint();
    const way = Number(now - at) * 1e-9 * registers[104] * 0.1;
    const before = angle;
    at = now;
    angle = Math.abs(target - angle) <= way ? target : angle + (target > angle ? way : -way);
    const sign = Math.sign(angle - before);
    if (sign && direction && sign !== direction) did.turns++;
    direction = sign || direction;
    did.bottom = Math.min(did.bottom, angle);
    did.top = Math.max(did.top, angle);
}

function take(value) {
    if (!registers[110]) {
        did.refused++;
        return;
    }
    target = value;
    did.targets++;
    did.low = Math.min(did.low, value);
    did.high = Math.max(did.high, value);
}

function read(address) {
    if (address === 100 || address === 101) return wordsOf(angle)[address - 100];
    if (address === 102 || address === 103) return wordsOf(target)[address - 102];
    if (address === 111) return registers[110] | (did.refused ? 2 : 0);
    if (address in registers) return registers[address];
    throw Object.assign(new Error("no such register"), { modbusErrorCode: 2 });
}

function write(address, values) {
    move();
    if (address === 102 && values.length === 2) take(floatOf(values[0], values[1]));
    else if (values.length === 1 && address in registers) registers[address] = values[0];
    else throw Object.assign(new Error("no such register"), { modbusErrorCode: 2 });
}

const vector = {
    getMultipleHoldingRegisters: (address, length) => {
        move();
        did.reads++;
        return Array.from({ length }, (_, i) => read(address + i));
    },
    getHoldingRegister: (address) => {
        move();
        return read(address);
    },
    setRegister: (address, value) => write(address, [value]),
    setRegisterArray: (address, values) => write(address, values),
};

// The library takes port 0 for 502: the system is asked for a free one before.
function serveTcp(portFile) {
    const probe = net.createServer().listen(0, "127.0.0.1", () => {
        const port = probe.address().port;
        probe.close(() => {
            const server = new ModbusRTU.ServerTCP(vector, { host: "127.0.0.1", port, unitID: 7 });
            server.on("initialized", () => fs.writeFileSync(portFile, `${port}\n`));
            server.on("serverError", () => serveTcp(portFile)); // somebody else was faster
            server.on("socketError", () => {});
        });
    });
}

const [kind, where] = process.argv.slice(2);
if (kind === "tcp") {
    serveTcp(where);
} else {
    new ModbusRTU.ServerSerial(vector, { path: where, baudRate: 115200, unitID: 7, interval: 5 }, { lock: false });
}
function tell() {
    move();
    console.log(JSON.stringify({ ...did, angle, enabled: registers[110] }));
}

process.on("SIGUSR1", tell);
process.on("SIGTERM", () => {
    tell();
    process.exit(0);
});

// Somebody else's CANopen master (npm `canopen`) brings up the simulated drive, as a handbook would have it.
//   node canopen_peer.js CANOPEN_NODE      with node_modules/canopen to be found; status 0: all went as it must
'use strict';
const Module = require('module');
const { spawn } = require('child_process');
const assert = require('assert');

// Only block transfers need node-crc, a compiled module; there are none here.
const load = Module._load;
Module._load = (name, ...rest) => (name === 'node-crc' ? { crc: () => 0 } : load(name, ...rest));
const { Device, DataType, NmtState } = require('canopen');

const NODE = 2;
const U8 = DataType.UNSIGNED8, I8 = DataType.INTEGER8, U16 = DataType.UNSIGNED16;
const U32 = DataType.UNSIGNED32, I32 = DataType.INTEGER32, TEXT = DataType.VISIBLE_STRING;

const drive = spawn(process.argv[2]);
const master = new Device({ id: 0x7f });
const heard = [];
const waiting = [];

master.addListener('message', ({ id, data }) =>
	drive.stdin.write(`${id.toString(16)}#${data ? data.toString('hex') : ''}\n`));
let rest = '';
drive.stdout.on('data', (chunk) => {
	const lines = (rest + chunk).split('\n');
	rest = lines.pop();
	for (const line of lines) {
		heard.push(line);
		for (let i = waiting.length - 1; i >= 0; i--)
			if (line.startsWith(waiting[i].begin))
				waiting.splice(i, 1)[0].resolve(line);
		if (line.includes('#')) {
			const [id, hex] = line.split('#');
			master.receive({ id: parseInt(id, 16), data: Buffer.from(hex, 'hex') });
		}
	}
});
drive.stderr.pipe(process.stderr);

const line = (begin) => new Promise((resolve) => waiting.push({ begin, resolve }));
const read = (index, dataType, subIndex) =>
	master.sdo.upload({ serverId: NODE, index, subIndex, dataType, timeout: 60000 });
const write = (index, data, dataType, subIndex) =>
	master.sdo.download({ serverId: NODE, index, subIndex, data, dataType, timeout: 60000 });
const state = async (mask, bits) => {
	for (;;) {
		const word = await read(0x6041, U16);
		if ((word & mask) === bits)
			return word;
	}
};
const refused = (promise, code) => assert.rejects(promise, (e) => e.code === code, `not refused with ${code.toString(16)}`);

async function objects() {
	assert.strictEqual(await read(0x1000, U32), 0x00020192);
	assert.strictEqual(await read(0x1018, U32, 2), 402);
	assert.strictEqual(String(await read(0x1008, TEXT)).replace(/\0/g, ''), 'simulated servo drive');
	await write(0x2000, 'a text that takes several segments', TEXT);
	assert.strictEqual(String(await read(0x2000, TEXT)).replace(/\0/g, ''), 'a text that takes several segments');
	await refused(read(0x5fff, U32), 0x06020000);
	await refused(write(0x6041, 1, U16), 0x06010002);
	await refused(write(0x6060, 5, I8), 0x06090030);
	await refused(write(0x1a00, 1, U8), 0x06010000);
}

async function mapping() {
	await write(0x1800, 0x80000182, U32, 1);
	await write(0x1800, 1, U8, 2);
	await write(0x1a00, 0, U8);
	await write(0x1a00, 0x60410010, U32, 1);
	await write(0x1a00, 0x60640020, U32, 2);
	await write(0x1a00, 2, U8);
	await write(0x1800, 0x182, U32, 1);
}

async function bring_up() {
	await write(0x6060, 1, I8);
	await write(0x6081, 90000, U32);
	await write(0x6040, 0x06, U16);
	await state(0x6f, 0x21);
	await write(0x6040, 0x07, U16);
	await state(0x6f, 0x23);
	await write(0x6040, 0x0f, U16);
	await state(0x6f, 0x27);
	await write(0x607a, -12345, I32);
	await write(0x6040, 0x1f, U16);
	await state(0x1000, 0x1000);
	await write(0x6040, 0x0f, U16);
	await state(0x1400, 0x0400);
	assert.strictEqual(await read(0x6064, I32), -12345);
	const angle = line('angle');
	drive.stdin.write('?\n');
	assert.strictEqual(await angle, 'angle -12.345000');
}

async function process_data() {
	const heartbeat = new Promise((resolve) => master.nmt.addListener('heartbeat',
		({ state: s }) => s === NmtState.OPERATIONAL && resolve()));
	await write(0x1017, 50, U16);
	master.nmt.startNode(NODE);
	await heartbeat;
	const pdo = line('182#');
	master.sync.write();
	assert.match(await pdo, /^182#3706C7CFFFFF$/);
}

async function emergency() {
	const told = new Promise((resolve) => master.emcy.addListener('emergency', ({ em }) => resolve(em)));
	drive.stdin.write('!fault\n');
	assert.strictEqual((await told).code, 0x4310);
	await state(0x4f, 0x08);
	assert.strictEqual(await read(0x603f, U16), 0x4310);
	await write(0x6040, 0x00, U16);
	await write(0x6040, 0x80, U16);
	await state(0x4f, 0x40);
}

async function main() {
	master.eds.addSdoClientParameter(NODE, 0x600 | NODE, 0x580 | NODE);
	master.eds.addHeartbeatConsumer(NODE, 60000);
	master.eds.addEmcyConsumer(0x80 | NODE);
	master.eds.setSyncCobId(0x80);
	master.eds.setSyncGenerationEnable(true);
	await line('702#00');
	master.start();
	for (const part of [objects, mapping, bring_up, process_data, emergency])
		await part();
	const boot = line('702#00');
	master.nmt.resetNode(NODE);
	await boot;
	console.log(`note: npm canopen brought the simulated drive up: ${heard.length} frames heard`);
}

setTimeout(() => {
	console.log('canopen_peer: it took too long; last heard:\n' + heard.slice(-10).join('\n'));
	process.exit(1);
}, 500000);
main().then(() => process.exit(0), (e) => {
	console.log(e, '\nlast heard:\n' + heard.slice(-10).join('\n'));
	process.exit(1);
});

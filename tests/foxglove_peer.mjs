// Law: programs that know nothing of facetd, only Foxglove's protocol, come to hold its map: every patch and no other.
// node tests/foxglove_peer.mjs BUILD MODULES. The judges: @foxglove/ws-protocol's client, mcap-record of its examples
// with @mcap/core, and protobufjs on the descriptors that were advertised.
import assert from 'node:assert/strict';
import { spawn, spawnSync } from 'node:child_process';
import { existsSync, mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { createRequire } from 'node:module';
import { connect, createServer } from 'node:net';
import { tmpdir } from 'node:os';
import { join, resolve } from 'node:path';

const build = resolve(process.argv[2]), modules = resolve(process.argv[3]);
const require = createRequire(join(modules, 'package.json'));
const { FoxgloveClient } = require('@foxglove/ws-protocol');
const { McapStreamReader } = require('@mcap/core');
const { loadDecompressHandlers } = require('@mcap/support');
const { WebSocket } = require('ws');
const protobuf = require('protobufjs');
const descriptor = require('protobufjs/ext/descriptor');

const CELL = 0.05, PATCHES = 220, BEHIND = 100, QUEUED = 192 * 1024;
const dir = mkdtempSync(join(tmpdir(), 'foxglove-'));
const ours = [];
const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

// SECONDS are a fast machine's; this one may be slow, or busy with others.
const PATIENCE = 5;
async function until(what, seconds, ask) {
  for (const end = Date.now() + PATIENCE * seconds * 1000; ;) {
    const answer = await ask();
    if (answer) return answer;
    assert.ok(Date.now() < end, `waited ${PATIENCE * seconds} s for ${typeof what === 'function' ? what() : what}`);
    await sleep(100);
  }
}

function start(program, words, env = {}) {
  const child = spawn(program, words, { stdio: ['ignore', 'ignore', 'pipe'], env: { ...process.env, FACETD: '', ...env } });
  child.log = '';
  child.stderr.setEncoding('utf8').on('data', (text) => (child.log = (child.log + text).slice(-20000)));
  child.gone = new Promise((done) => child.once('exit', done));
  ours.push(child);
  return child;
}

async function end(child, signal) {
  child.kill(signal);
  await Promise.race([child.gone, sleep(120000).then(() => child.kill('SIGKILL'))]);
}

const freePort = () => new Promise((done) => {
  const server = createServer().listen(0, '127.0.0.1', () => {
    const { port } = server.address();
    server.close(() => done(port));
  });
});

// One command over the unix socket; its answer. Between connecting and writing, node may have a turn of its loop to do: on a loaded
// machine it decodes three maps for half a minute in it, and who says nothing for ten seconds was closed by the daemon.
async function command(word) {
  for (let tries = 0; ; tries++) {
    try {
      return await commandOnce(word);
    } catch (error) {
      if (tries === 20) throw error;
      await sleep(200);
    }
  }
}

const commandOnce = (word) => new Promise((done, fail) => {
  const socket = connect(join(dir, 'facetd.sock'));
  let text = '';
  socket.on('error', fail).on('data', (data) => {
    text += data;
    const answer = text.split('\n').slice(0, -1).map((line) => JSON.parse(line)).find((one) => one.class !== 'VERSION');
    if (!answer) return;
    socket.end();
    done(answer);
  });
  socket.write(`?${word}\n`);
});

// What a 3D panel keeps of a topic of SceneUpdates.
const nanos = (t) => BigInt(t?.sec ?? t?.seconds ?? 0) * 1000000000n + BigInt(t?.nsec ?? t?.nanos ?? 0);
class Scene {
  entities = new Map();
  updates = 0; deletions = 0; all = 0;
  take(update) {
    this.updates++;
    for (const { timestamp, type, id } of update.deletions ?? []) {
      if (type) this.all++; else this.deletions++;
      for (const key of type ? [...this.entities.keys()] : [id]) {
        const entity = this.entities.get(key);
        if (!entity) continue;
        assert.ok(nanos(entity.timestamp) < nanos(timestamp), `the deletion of ${key} is older than the entity`);
        this.entities.delete(key);
      }
    }
    for (const entity of update.entities ?? []) {
      assert.equal(entity.frame_id, 'map');
      this.entities.set(entity.id, entity);
    }
  }
  get triangles() {
    let n = 0;
    for (const { triangles } of this.entities.values()) for (const list of triangles) n += list.indices.length / 3;
    return n;
  }
  // Points that triangles use, as the integers of the lattice; each index must name one.
  points() {
    const points = new Set(), at = (v) => Math.round((v ?? 0) * 256 / CELL);
    for (const { triangles } of this.entities.values()) {
      for (const { indices, points: own } of triangles) {
        for (const i of indices) {
          assert.ok(i < own.length);
          points.add(`${at(own[i].x)},${at(own[i].y)},${at(own[i].z)}`);
        }
      }
    }
    return points;
  }
}

// What a channel's schema makes of a message.
function decoder({ encoding, schema, schemaName }) {
  if (encoding === 'json') return (data) => JSON.parse(new TextDecoder().decode(data));
  const set = descriptor.FileDescriptorSet.decode(Buffer.from(schema, 'base64'));
  const type = protobuf.Root.fromDescriptor(set).lookupType(schemaName);
  return (data) => {
    const bytes = new Uint8Array(data.buffer, data.byteOffset, data.byteLength), message = type.decode(bytes);
    return JSON.parse(JSON.stringify(type.toObject(message, { longs: Number, arrays: true, defaults: true })), undefined);
  };
}

// protobufjs calls fields frameId where its reader is not told to keep them.
const plain = (message) => Array.isArray(message) ? message.map(plain)
  : message && typeof message === 'object'
    ? Object.fromEntries(Object.entries(message).map(([key, v]) => [key.replace(/[A-Z]/g, (c) => `_${c.toLowerCase()}`), plain(v)]))
    : message;

class Listener {
  scene = new Scene();
  counts = {};
  last = {};
  errors = [];
  constructor(port, protocol, query = '', topics = () => true) {
    this.ws = new WebSocket(`ws://127.0.0.1:${port}/${query}`, [protocol]);
    const client = new FoxgloveClient({ ws: this.ws }), channels = new Map();
    this.client = client;
    client.on('error', (error) => this.errors.push(String(error)));
    client.on('status', (status) => this.errors.push(status.message));
    client.on('close', (event) => (this.closed = `${event.code} ${event.reason}`));
    client.on('serverInfo', (info) => (this.info = info));
    client.on('advertise', (list) => {
      this.channels = list;
      for (const channel of list)
        if (topics(channel.topic)) channels.set(client.subscribe(channel.id), { ...channel, decode: decoder(channel) });
    });
    client.on('message', ({ subscriptionId, data }) => {
      const channel = channels.get(subscriptionId);
      try {
        const message = channel.encoding === 'json' ? channel.decode(data) : plain(channel.decode(data));
        this.counts[channel.topic] = (this.counts[channel.topic] ?? 0) + 1;
        this.last[channel.topic] = message;
        if (channel.schemaName === 'foxglove.SceneUpdate') this.scene.take(message);
      } catch (error) {
        this.errors.push(String(error));
      }
    });
    client.on('time', () => (this.counts.time = (this.counts.time ?? 0) + 1));
  }
}

async function holds(name, listener, { map_size: map }) {
  await until(() => `${name} to hold ${map.patches} patches, not ${listener.scene.entities.size}`, 60, () => {
    assert.deepEqual(listener.errors, [], name);
    assert.equal(listener.closed, undefined, `${name} was closed`);
    return listener.scene.entities.size === map.patches && listener.scene.triangles === map.triangles;
  });
}

function samePoints(name, scene, points) {
  const mine = scene.points();
  assert.equal(mine.size, points.size, `${name}: points`);
  for (const point of points) assert.ok(mine.has(point), `${name} lacks ${point}`);
}

function savedPoints() {
  const file = join(dir, 'map.obj');
  const { status, stderr } = spawnSync(join(build, 'facet'), ['save', `unix:${join(dir, 'facetd.sock')}`, '-o', file]);
  assert.equal(status, 0, String(stderr));
  const points = new Set();
  for (const line of readFileSync(file, 'utf8').split('\n'))
    if (line.startsWith('v ')) points.add(line.slice(2).split(' ').map((v) => Math.round(v * 256 / CELL)).join(','));
  return points;
}

async function recorded(file) {
  const reader = new McapStreamReader({ decompressHandlers: await loadDecompressHandlers(), validateCrcs: true });
  const channels = new Map(), scene = new Scene(), counts = {};
  reader.append(readFileSync(file));
  for (let record; (record = reader.nextRecord());) {
    if (record.type === 'Channel') channels.set(record.id, record);
    if (record.type !== 'Message') continue;
    const { topic } = channels.get(record.channelId);
    counts[topic] = (counts[topic] ?? 0) + 1;
    if (topic === '/map') scene.take(JSON.parse(new TextDecoder().decode(record.data)));
  }
  assert.ok(reader.done(), 'the file ends as it should');
  return { scene, counts };
}

function expectChain(name, { transforms }) {
  assert.deepEqual(transforms.map((t) => `${t.parent_frame_id}<-${t.child_frame_id}`), ['map<-base', 'base<-tilt', 'tilt<-laser'], name);
  for (const { rotation: { x, y, z, w } } of transforms)
    assert.ok(Math.abs(Math.hypot(x, y, z, w) - 1) < 1e-6, `${name}: a rotation of length 1`);
}

function expectMeasured(name, { last, counts }) {
  expectChain(name, last['/tf']);
  const scan = last['/scan/laser'];
  assert.ok(scan.ranges.length >= 100 && scan.ranges.filter((r) => r > 0.3 && r < 30).length > 50, `${name}: ranges`);
  assert.ok(Math.abs(scan.end_angle - scan.start_angle) > 1 && scan.frame_id === 'laser', `${name}: the fan`);
  assert.equal(last['/pose'].frame_id, 'map');
  assert.ok(last['/log'].message.length > 0 && last['/status'].class === 'STATUS', `${name}: log and status`);
  for (const topic of ['/map', '/tf', '/pose', '/scan/laser', 'time']) assert.ok(counts[topic] > 20, `${name}: ${topic} ${counts[topic]}`);
}

// A replay, told and controlled in binary messages that the old client does not know.
class Replayer {
  scene = new Scene();
  states = [];
  statuses = [];
  data = 0;
  constructor(port) {
    this.ws = new WebSocket(`ws://127.0.0.1:${port}/`, ['foxglove.sdk.v1']);
    this.ws.on('message', (bytes, binary) => {
      if (!binary) {
        const message = JSON.parse(bytes);
        if (message.op === 'serverInfo') this.info = message;
        if (message.op === 'status') this.statuses.push(message.message);
        if (message.op === 'advertise') this.ws.send('{"op":"subscribe","subscriptions":[{"id":0,"channelId":1},{"id":1,"channelId":2}]}');
        return;
      }
      if (bytes[0] === 2) this.time = bytes.readBigUInt64LE(1);
      if (bytes[0] === 5)
        this.states.push({ state: bytes[1], time: bytes.readBigUInt64LE(2), speed: bytes.readFloatLE(10), seeked: bytes[14], name: bytes.subarray(19).toString() });
      if (bytes[0] !== 1) return;
      this.data++;
      if (bytes.readUInt32LE(1) === 0) this.scene.take(JSON.parse(bytes.subarray(13)));
    });
  }
  get state() { return this.states.at(-1); }
  ask(pause, speed, seek, name) {
    const bytes = Buffer.alloc(19 + name.length);
    bytes[0] = 3;
    bytes[1] = pause;
    bytes.writeFloatLE(speed, 2);
    bytes[6] = seek === null ? 0 : 1;
    bytes.writeBigUInt64LE(seek ?? 0n, 7);
    bytes.writeUInt32LE(name.length, 15);
    bytes.write(name, 19);
    this.ws.send(bytes);
    return until(`the answer to ${name}`, 30, () => this.states.find((state) => state.name === name));
  }
}

async function replayed(journal, port, map, points) {
  const daemon = start(join(build, 'facetd'), ['--config', join(dir, 'facetd.yaml'), '--replay', journal]);
  await until('the replay', 30, () => command('STATUS').catch(() => null));
  const client = new Replayer(port);
  await until('how the replay stands', 20, () => client.state);
  assert.deepEqual(client.info.capabilities, ['time', 'playbackControl']);
  const first = nanos(client.info.dataStartTime), last = nanos(client.info.dataEndTime);
  assert.ok(last - first > 3000000000n, `a replay of ${last - first} ns`);
  assert.equal((await client.ask(1, 1, null, 'stop')).state, 1);
  const { time } = client;
  await sleep(500);
  assert.equal(client.time, time, 'time stands while it is stopped');
  const jumped = await client.ask(1, 1, first + (last - first) / 2n, 'half');
  assert.equal(jumped.state === 1 || jumped.state === 2, true);
  await until('half of the drive', 60, () => client.scene.entities.size > 20);
  const whole = client.scene.all;
  await client.ask(0, 1000, first, 'again');
  await until('the map to begin anew', 30, () => client.scene.all > whole);
  await until('the end', 90, () => client.state.state === 3);
  await until('the map of the drive', 60, () => client.scene.entities.size === map.patches && client.scene.triangles === map.triangles);
  samePoints('replay', client.scene, points);
  assert.deepEqual(client.statuses, []);
  assert.ok(client.states.some((state) => state.seeked), 'a seek is told as one');
  assert.ok(client.data > client.scene.updates, `transforms beside ${client.scene.updates} updates of the map, ${client.data} in all`);
  await end(daemon, 'SIGTERM');
}

async function main() {
  const port = await freePort(), file = join(dir, 'recorded.mcap'), socket = join(dir, 'facetd.sock');
  const status = () => command('STATUS'), patches = async () => (await status()).map_size.patches;
  const examples = join(modules, 'node_modules', '@foxglove', 'ws-protocol-examples', 'package.json');
  const tool = join(examples, '..', Object.values(JSON.parse(readFileSync(examples, 'utf8')).bin)[0]);

  start(join(build, 'facet'), ['simulate', 'building', '--endless', '--dir', dir, '--http', `127.0.0.1:${port}`]);
  await until('the simulator', 20, () => existsSync(join(dir, 'facetd.yaml')));
  const daemon = start(join(build, 'facetd'), ['--config', join(dir, 'facetd.yaml'), '--journal', join(dir, 'journal')]);
  await until('facetd', 30, () => existsSync(socket) && status().catch(() => null));

  const json = new Listener(port, 'foxglove.websocket.v1');
  const binary = new Listener(port, 'foxglove.sdk.v1', '?encoding=protobuf');
  const stalled = new Listener(port, 'foxglove.sdk.v1', '', (topic) => topic !== '/log');
  const recorder = start(process.execPath, [tool, 'mcap-record', '-o', file, `ws://127.0.0.1:${port}/`]);
  await until('a map of 40 patches', 60, async () => (await patches()) > 40);
  assert.equal((await command('RESET')).class, 'OK');
  await until('the map anew', 60, async () => (await patches()) > 60 && stalled.scene.all >= 2);

  stalled.ws.pause();
  const stalls = async () => (await status()).clients.filter((c) => c.kind === 'foxglove').sort((a, b) => b.behind - a.behind)[0];
  const behind = await until('a client that is behind', 60, async () => {
    const worst = await stalls();
    return worst?.behind >= BEHIND && (await patches()) > PATCHES && worst;
  });
  assert.ok(behind.queued <= QUEUED, `a stalled client costs ${behind.queued} bytes`);
  stalled.ws.resume();

  const told = ({ counts }) => ['/map', '/tf', '/pose', '/scan/laser', 'time'].every((topic) => counts[topic] > 20);
  await until('much of each topic', 60, () => told(json) && told(binary));
  await command('PAUSE');
  const still = await until('the map to stand', 30, async () => {
    const now = await status();
    return now.queue.idle && now;
  });
  const late = new Listener(port, 'foxglove.sdk.v1', '', (topic) => topic === '/map');
  const points = savedPoints(), { map_size: map } = still;
  const listeners = { json, binary, stalled, late };
  for (const [name, listener] of Object.entries(listeners)) {
    await holds(name, listener, still);
    samePoints(name, listener.scene, points);
  }
  assert.equal(late.scene.updates, 1, 'a late client is given the map in one update');
  expectMeasured('json', json);
  expectMeasured('binary', binary);
  assert.equal(binary.ws.protocol, 'foxglove.sdk.v1');
  assert.deepEqual(json.info.capabilities, ['time']);
  assert.ok(json.scene.all >= 2 && json.scene.deletions > 0, 'patches that vanished');

  json.client.subscribe(77);
  json.client.getParameters(['x']);
  json.ws.send(Buffer.from([1, 0, 0, 0, 0]));
  await until('answers to what is not offered', 10, () => json.errors.length === 3);

  await sleep(500);
  await end(recorder, 'SIGINT');
  const record = await recorded(file);
  assert.equal(record.scene.entities.size, map.patches, `mcap-record: patches; ${recorder.log.slice(-500)}`);
  assert.equal(record.scene.triangles, map.triangles, 'mcap-record: triangles');
  samePoints('mcap-record', record.scene, points);
  await end(daemon, 'SIGTERM');
  await until('the clients to be closed', 10, () => Object.values(listeners).every((listener) => listener.closed));
  await replayed(join(dir, 'journal.2'), port, map, points);
  console.log(`note: ${map.patches} patches, ${map.triangles} triangles, ${points.size} points held alike by ws-protocol ` +
    `(JSON ${json.scene.updates} updates, ${json.scene.deletions} deletions; protobuf ${binary.scene.updates}), mcap-record ` +
    `(${record.scene.updates}) and a client that stalled until ${behind.behind} steps behind (it cost ${behind.queued} bytes)`);
}

let failure = null;
await main().catch((error) => (failure = error));
for (const child of ours) child.kill('SIGKILL');
if (failure) {
  console.error(failure);
  for (const child of ours) console.error(child.spawnargs.slice(0, 3).join(' '), child.log.slice(-2000));
}
rmSync(dir, { recursive: true, force: true });
process.exit(failure ? 1 : 0);

// Law: the page holds what the daemon sent. Its codec, its mirror of the map, its arrays and its lengths, without a browser.
import assert from 'node:assert/strict';
import { readdirSync, readFileSync } from 'node:fs';
import test from 'node:test';
import { buildChunk, chunkKeyOf } from '../viewer/chunk.js';
import { mainBody } from '../viewer/extent.js';
import { between, lengthText } from '../viewer/length.js';
import { Mirror } from '../viewer/mirror.js';
import * as native from '../viewer/native.js';

const corpus = new URL('corpus/native/', import.meta.url);

function frame(type, payload, flags = 0) {
  const bytes = new Uint8Array(8 + payload.length);
  new DataView(bytes.buffer).setUint32(0, 4 + payload.length, true);
  bytes[4] = type;
  bytes[5] = flags;
  bytes.set(payload, 8);
  return bytes;
}

function fields(...list) { // ['u32', 5], ...
  const bytes = new Uint8Array(4096), view = new DataView(bytes.buffer);
  let at = 0;
  const put = { u8: (v) => view.setUint8(at, v) || 1, u16: (v) => view.setUint16(at, v, true) || 2,
    u32: (v) => view.setUint32(at, v, true) || 4, i32: (v) => view.setInt32(at, v, true) || 4,
    u64: (v) => view.setBigUint64(at, BigInt(v), true) || 8, i64: (v) => view.setBigInt64(at, BigInt(v), true) || 8,
    f64: (v) => view.setFloat64(at, v, true) || 8, f32: (v) => view.setFloat32(at, v, true) || 4 };
  for (const [type, ...values] of list) for (const value of values) at += put[type](value);
  return bytes.slice(0, at);
}

// A square floor of two triangles at height z (lattice), of plane 7 and class 1.
function square(key, version, z = 2048) {
  return fields(['i32', ...key], ['u64', version], ['i64', 1_000_000_000, 3_500_000_000], ['u16', 4, 2, 1],
    ['u16', 0, 0, z, 4096, 0, z, 4096, 4096, z, 0, 4096, z], ['u32', 7], ['u8', 1], ['u16', 2], ['u8', 0, 1, 2, 0, 2, 3]);
}
const begin = (step, patches, removals, reset) => fields(['u64', step], ['u32', patches, removals], ['u8', reset]);
const step = (n) => fields(['u64', n]);
const hello = fields(['u16', 1, 0], ['u8', ...Array(16).keys()], ['u32', 3], ['f64', 0.05], ['u64', 812], ['i64', 2_500_000_000]);

function mirrorOf(...frames) {
  const shown = [], mirror = new Mirror((name, patch) => shown.push([name, patch && patch.version]));
  for (const [type, payload] of frames) mirror.take(type, payload);
  return { mirror, shown };
}

test('a HELLO is read as docs/protocol.md draws it', () => {
  assert.deepEqual(native.readHello(hello), { major: 1, minor: 0, map: '000102030405060708090a0b0c0d0e0f', generation: 3,
    cell: 0.05, step: 812, t: 2.5 });
});

test('another major version is refused with a sentence', () => {
  const other = hello.slice();
  other[0] = 2;
  assert.throws(() => native.readHello(other), /version 2/);
});

test('a PATCH is read as docs/protocol.md draws it', () => {
  const patch = native.readPatch(square([-1, 2, 3], 9));
  assert.deepEqual(patch.key, [-1, 2, 3]);
  assert.deepEqual([patch.version, patch.first, patch.last, patch.triangles], [9, 1, 3.5, 2]);
  assert.deepEqual([...patch.vertices], [0, 0, 2048, 4096, 0, 2048, 4096, 4096, 2048, 0, 4096, 2048]);
  assert.deepEqual([...patch.indices], [0, 1, 2, 0, 2, 3]);
  assert.deepEqual([[...patch.planes], [...patch.classes]], [[7, 7], [1, 1]]);
});

test('a PATCH of every shorter length is refused', () => {
  const whole = square([0, 0, 0], 1);
  for (let n = 0; n < whole.length; n++) assert.throws(() => native.readPatch(whole.subarray(0, n)), Error, `${n} bytes`);
});

test('a PATCH that names a vertex it has not is refused', () => {
  const wrong = square([0, 0, 0], 1);
  wrong[wrong.length - 1] = 4;
  assert.throws(() => native.readPatch(wrong), /vertex 4/);
});

test('WANT is a frame that the daemon reads', () => {
  const want = native.writeWant(1000);
  assert.deepEqual([...want.subarray(0, 16)], [36, 0, 0, 0, 2, 0, 0, 0, 1, 0, 0, 0, 0xe8, 3, 0, 0]);
  assert.equal(want.length, 40);
});

test('frames are the same wherever the stream is cut', () => {
  const stream = Buffer.concat([frame(native.HELLO, hello), frame(native.PING, new Uint8Array(0)),
    frame(native.PATCH, square([0, 0, 0], 1))]);
  for (let size = 1; size <= stream.length; size++) {
    const types = [], reader = new native.FrameReader((type, payload) => types.push(type, payload.length));
    for (let at = 0; at < stream.length; at += size) reader.push(new Uint8Array(stream.subarray(at, at + size)));
    assert.deepEqual(types, [1, 48, 11, 0, 4, square([0, 0, 0], 1).length], `pieces of ${size}`);
  }
});

test('lengths and flags that cannot be are refused', () => {
  const reader = () => new native.FrameReader(() => {});
  assert.throws(() => reader().push(new Uint8Array([3, 0, 0, 0, 1, 0, 0, 0])), /3 bytes/);
  assert.throws(() => reader().push(new Uint8Array([0, 0, 0, 2, 1, 0, 0, 0])), /33554432 bytes/);
  assert.throws(() => reader().push(frame(native.PATCH, new Uint8Array(4), 1)), /flags/);
});

test('no bytes of the fuzzed corpus do more than throw', () => {
  for (const name of readdirSync(corpus)) {
    const { mirror } = mirrorOf(), reader = new native.FrameReader((type, payload) => mirror.take(type, payload));
    try {
      reader.push(new Uint8Array(readFileSync(new URL(name, corpus))));
    } catch (error) {
      assert.ok(error instanceof Error && !(error instanceof TypeError), `${name}: ${error.stack}`);
    }
  }
});

test('the session that the C codec is tested with leads to the same map', () => {
  const { mirror } = mirrorOf(), reader = new native.FrameReader((type, payload) => mirror.take(type, payload));
  reader.push(new Uint8Array(readFileSync(new URL('session', corpus))));
  assert.deepEqual([[...mirror.patches.keys()], mirror.triangles, mirror.step, mirror.commits], [['2,0,0', '5,0,0'], 302, 3, 2]);
});

test('the first map is shown as it comes', () => {
  const { mirror, shown } = mirrorOf([1, hello], [3, begin(812, 2, 0, 1)], [4, square([0, 0, 0], 800)]);
  assert.deepEqual(shown, [['0,0,0', 800]]);
  assert.equal(mirror.commits, 0);
});

test('later batches are shown at their COMMIT, whole', () => {
  const { mirror, shown } = mirrorOf([1, hello], [3, begin(812, 1, 0, 1)], [4, square([0, 0, 0], 800)], [8, step(812)],
    [3, begin(830, 1, 1, 0)], [5, fields(['i32', 0, 0, 0])], [4, square([1, 0, 0], 830)]);
  assert.equal(shown.length, 1);
  mirror.take(native.COMMIT, step(830));
  assert.deepEqual(shown.slice(1), [['0,0,0', null], ['1,0,0', 830]]);
  assert.deepEqual([mirror.step, mirror.patches.size, mirror.triangles], [830, 1, 2]);
});

test('an aborted batch leaves no trace', () => {
  const { mirror, shown } = mirrorOf([1, hello], [3, begin(812, 1, 0, 1)], [4, square([0, 0, 0], 800)], [8, step(812)],
    [3, begin(830, 1, 0, 0)], [4, square([1, 0, 0], 830)], [9, step(830)], [3, begin(840, 0, 0, 0)], [8, step(840)]);
  assert.deepEqual([shown.length, mirror.step, mirror.patches.size], [1, 840, 1]);
});

test('a reset replaces everything, at its COMMIT', () => {
  const { mirror, shown } = mirrorOf([1, hello], [3, begin(812, 1, 0, 1)], [4, square([0, 0, 0], 800)], [8, step(812)],
    [1, hello], [3, begin(3, 1, 0, 1)], [4, square([5, 0, 0], 2)]);
  assert.ok(mirror.patches.has('0,0,0'));
  mirror.take(native.COMMIT, step(3));
  assert.deepEqual([...mirror.patches.keys()], ['5,0,0']);
  assert.deepEqual(shown.slice(1), [['0,0,0', null], ['5,0,0', 2]]);
});

test('a batch that is cut off by a lost connection is replaced by the next one', () => {
  const { mirror } = mirrorOf([1, hello], [3, begin(812, 2, 0, 1)], [4, square([0, 0, 0], 800)]);
  mirror.reconnect();
  for (const [type, payload] of [[1, hello], [3, begin(815, 1, 0, 1)], [4, square([1, 0, 0], 800)], [8, step(815)]])
    mirror.take(type, payload);
  assert.deepEqual([...mirror.patches.keys()], ['1,0,0']);
});

test('a PATCH outside a batch and a COMMIT of another step are refused', () => {
  assert.throws(() => mirrorOf([4, square([0, 0, 0], 1)]), /outside/);
  assert.throws(() => mirrorOf([3, begin(5, 0, 0, 0)], [8, step(6)]), /step 6/);
});

test('a chunk has its patches where the lattice says', () => {
  const patch = native.readPatch(square([-1, 5, 0], 1, 100));
  assert.deepEqual(chunkKeyOf(patch.key), [-1, 1, 0]);
  const { position, tag, stamp, vertices } = buildChunk([patch], null, [-1, 1, 0], 1);
  assert.equal(vertices, 6);
  assert.deepEqual([...position.subarray(4, 7)], [3 * 4096 + 4096, 4096, 100]);
  assert.deepEqual([tag[0], stamp[0]], [1, 2.5]);
});

test('smooth normals of a level square point up, also over the border of two patches', () => {
  const patches = [[0, 0, 0], [1, 0, 0]].map((key) => native.readPatch(square(key, 1)));
  const { normal } = buildChunk(patches, patches, [0, 0, 0], 0);
  for (let i = 0; i < 12; i++) assert.deepEqual([...normal.subarray(4 * i, 4 * i + 3)], [0, 0, 127]);
});

test('rims inside a patch are drawn, its border is not', () => {
  const inner = square([0, 0, 0], 1);
  assert.deepEqual(edgeBits(inner), [0, 0]); // all rims lie in the patch's border; the diagonal is no crease
  const view = new DataView(inner.buffer);
  view.setUint16(42, 10, true); // vertex 0 moves off both borders
  view.setUint16(44, 10, true);
  assert.ok(edgeBits(inner).some((bits) => bits !== 0));
});
function edgeBits(payload) {
  const { tag } = buildChunk([native.readPatch(payload)], null, [0, 0, 0], 0);
  return [tag[3], tag[15]];
}

test('specks far away are left out of the frame', () => {
  const room = [];
  for (let x = 0; x < 20; x++) for (let y = 0; y < 10; y++) room.push([x, y, 0]);
  assert.deepEqual(mainBody([...room, [90, 0, 0], [-80, 3, 1]]).high, [19, 9, 0]);
  assert.deepEqual(mainBody([[7, 7, 7]]).low, [7, 7, 7]);
});

test('lengths are right and read well', () => {
  const { distance, level, z, slope } = between({ x: 0, y: 0, z: 0 }, { x: 3, y: 4, z: 5 });
  assert.deepEqual([level, z, slope], [5, 5, Math.PI / 4]);
  assert.ok(Math.abs(distance - Math.sqrt(50)) < 1e-12);
  assert.deepEqual([0.1234, 2.34567, -0.5, 123.456].map(lengthText), ['12.3 cm', '2.346 m', '-50.0 cm', '123.5 m']);
});

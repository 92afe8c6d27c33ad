// The native protocol's bytes (docs/protocol.md): frames from a stream that is cut anywhere, messages from frames, WANT.
// Little-endian throughout, like every machine a browser runs on. What is wrong throws a sentence; the caller reconnects.

export const HELLO = 1, WANT = 2, BEGIN = 3, PATCH = 4, REMOVE = 5, PLANE = 6, PLANE_GONE = 7, COMMIT = 8, ABORT = 9,
  JSON_TEXT = 10, PING = 11;

const HEAD = 8;
const FRAME_MAX = 16 << 20;
const NO_PLANE = 0xffffffff;
const WANT_PLANES = 1;

// Cuts a byte stream into frames. push() takes the next piece and calls back with each whole frame: (type, payload).
// A payload is a view that is valid during the call only.
export class FrameReader {
  constructor(take) {
    this.take = take;
    this.rest = new Uint8Array(0);
  }

  push(piece) {
    let bytes = piece;
    if (this.rest.length) {
      bytes = new Uint8Array(this.rest.length + piece.length);
      bytes.set(this.rest);
      bytes.set(piece, this.rest.length);
    }
    let at = 0;
    while (bytes.length - at >= HEAD) {
      const view = new DataView(bytes.buffer, bytes.byteOffset + at);
      const length = view.getUint32(0, true);
      if (length < 4 || length + 4 > FRAME_MAX) throw new Error(`a frame of ${length} bytes`);
      if (bytes.length - at < length + 4) break;
      if (view.getUint8(5) !== 0) throw new Error(`a frame with flags ${view.getUint8(5)}, which were not asked for`);
      this.take(view.getUint8(4), bytes.subarray(at + HEAD, at + 4 + length));
      at += 4 + length;
    }
    this.rest = bytes.slice(at);
  }
}

const viewOf = (payload, least, what) => {
  if (payload.length < least) throw new Error(`a ${what} of ${payload.length} bytes`);
  return new DataView(payload.buffer, payload.byteOffset, payload.length);
};
const seconds = (view, at) => Number(view.getBigInt64(at, true)) / 1e9;
const keyAt = (view, at) => [view.getInt32(at, true), view.getInt32(at + 4, true), view.getInt32(at + 8, true)];

export function readHello(payload) {
  const view = viewOf(payload, 48, 'HELLO');
  const map = Array.from(payload.subarray(4, 20), (byte) => byte.toString(16).padStart(2, '0')).join('');
  const major = view.getUint16(0, true);
  if (major !== 1) throw new Error(`the daemon speaks version ${major} of the protocol, this page version 1`);
  return { major, minor: view.getUint16(2, true), map, generation: view.getUint32(20, true),
    cell: view.getFloat64(24, true), step: Number(view.getBigUint64(32, true)), t: seconds(view, 40) };
}

export function readBegin(payload) {
  const view = viewOf(payload, 17, 'BEGIN');
  return { step: Number(view.getBigUint64(0, true)), patches: view.getUint32(8, true), removals: view.getUint32(12, true),
    reset: view.getUint8(16) !== 0 };
}

export function readStep(payload) {
  return Number(viewOf(payload, 8, 'COMMIT').getBigUint64(0, true));
}

export function readKey(payload) {
  return keyAt(viewOf(payload, 12, 'REMOVE'), 0);
}

// A patch: vertices are lattice integers 0..4096 inside it; `plane` and `class` are one per triangle.
export function readPatch(payload) {
  const view = viewOf(payload, 42, 'PATCH');
  const vertices = view.getUint16(36, true), triangles = view.getUint16(38, true), runs = view.getUint16(40, true);
  const runsAt = 42 + 6 * vertices, indicesAt = runsAt + 7 * runs, wide = vertices > 256;
  if (payload.length !== indicesAt + 3 * triangles * (wide ? 2 : 1))
    throw new Error(`a PATCH of ${payload.length} bytes with ${vertices} vertices and ${triangles} triangles`);
  const copy = (from, to) => payload.slice(from, to).buffer; // aligned, and free of the message it came in
  const patch = {
    key: keyAt(view, 0), version: Number(view.getBigUint64(12, true)), first: seconds(view, 20), last: seconds(view, 28),
    vertices: new Uint16Array(copy(42, runsAt)),
    indices: wide ? new Uint16Array(copy(indicesAt)) : new Uint8Array(copy(indicesAt)),
    planes: new Uint32Array(triangles).fill(NO_PLANE), classes: new Uint8Array(triangles), triangles,
  };
  for (const index of patch.indices) if (index >= vertices) throw new Error(`a PATCH that names vertex ${index}`);
  let next = 0;
  for (let i = 0, at = runsAt; i < runs; i++, at += 7) {
    const end = Math.min(next + view.getUint16(at + 5, true), triangles);
    patch.planes.fill(view.getUint32(at, true), next, end);
    patch.classes.fill(view.getUint8(at + 4), next, end);
    next = end;
  }
  return patch;
}

export function readPlane(payload) {
  const view = viewOf(payload, 64, 'PLANE');
  return { id: view.getUint32(0, true), normal: [4, 8, 12].map((at) => view.getFloat32(at, true)),
    distance: view.getFloat64(16, true), class: view.getUint8(24), area: view.getFloat32(28, true) };
}

export function readId(payload) {
  return viewOf(payload, 4, 'PLANE_GONE').getUint32(0, true);
}

// The whole map with its planes, as fast as it comes.
export function writeWant(bytesPerSecond = 0) {
  const bytes = new Uint8Array(HEAD + 32);
  const view = new DataView(bytes.buffer);
  view.setUint32(0, 4 + 32, true);
  bytes[4] = WANT;
  bytes[HEAD] = WANT_PLANES;
  view.setUint32(HEAD + 4, bytesPerSecond, true);
  return bytes;
}

export const isPlane = (id) => id !== NO_PLANE;

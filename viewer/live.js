// What the robot measures now, over the Foxglove WebSocket protocol in JSON: the profile of each scanner (LaserScan), the
// frames (FrameTransforms: map <- base <- tilt <- laser) and the pose (PoseInFrame). Only the newest of each is kept.
import { Matrix4, Quaternion, Vector3 } from 'three';
import { Link } from './link.js';

const WANTED = ['foxglove.LaserScan', 'foxglove.FrameTransforms', 'foxglove.PoseInFrame'];
const MESSAGE = 1;

const matrixOf = (translation, rotation) => new Matrix4().compose(
  new Vector3(translation.x, translation.y, translation.z),
  new Quaternion(rotation.x, rotation.y, rotation.z, rotation.w), new Vector3(1, 1, 1));

export class Live {
  // `moved(matrix)`: the robot's pose, each that comes.
  constructor(token, moved) {
    this.moved = moved;
    this.channels = new Map(); // id -> {topic, schemaName}
    this.frames = new Map(); // child -> {parent, matrix}
    this.scans = new Map(); // frame -> {ranges, start, step, intensities, at}
    this.base = null; // the robot's pose, where no transform tells it
    this.profiles = 0;
    this.patienceMs = 1500; // a profile that was not renewed for so long is not drawn any more
    this.version = 0; // one more with every message
    this.decoder = new TextDecoder();
    this.link = new Link('/', ['foxglove.sdk.v1'], token, {
      open: () => this.forget(),
      text: (text) => this.hearText(JSON.parse(text)),
      bytes: (bytes) => this.hearBytes(bytes),
      lost: () => {},
    }, 60000); // a robot that stands says nothing here
  }

  forget() {
    this.channels.clear();
    this.frames.clear();
    this.scans.clear();
    this.base = null;
  }

  hearText(message) {
    if (message.op !== 'advertise') return;
    const subscriptions = [];
    for (const { id, topic, encoding, schemaName } of message.channels) {
      if (encoding !== 'json' || !WANTED.includes(schemaName)) continue;
      this.channels.set(id, { topic, schemaName });
      subscriptions.push({ id, channelId: id });
    }
    if (subscriptions.length) this.link.send(JSON.stringify({ op: 'subscribe', subscriptions }));
  }

  hearBytes(bytes) {
    if (bytes[0] !== MESSAGE || bytes.length < 13) return;
    const id = new DataView(bytes.buffer, bytes.byteOffset).getUint32(1, true);
    const channel = this.channels.get(id);
    if (channel) this.hear(channel.schemaName, JSON.parse(this.decoder.decode(bytes.subarray(13))));
  }

  hear(schema, message) {
    this.version++;
    if (schema === 'foxglove.PoseInFrame') this.base = matrixOf(message.pose.position, message.pose.orientation);
    else if (schema === 'foxglove.FrameTransforms') message.transforms.forEach((transform) => this.frame(transform));
    else this.scan(message);
    const place = schema === 'foxglove.LaserScan' ? null : this.robot;
    if (place) this.moved(place);
  }

  frame({ parent_frame_id: parent, child_frame_id: child, translation, rotation }) {
    this.frames.set(child, { parent, matrix: matrixOf(translation, rotation) });
  }

  scan({ frame_id: frame, pose, start_angle: start, end_angle: end, ranges, intensities }) {
    this.profiles++;
    this.scans.set(frame, { start, step: ranges.length > 1 ? (end - start) / (ranges.length - 1) : 0, ranges,
      intensities: intensities ?? [], pose: pose ? matrixOf(pose.position, pose.orientation) : new Matrix4(),
      at: performance.now() });
  }

  // map <- frame; null while a link of the chain is missing.
  place(frame) {
    const matrix = new Matrix4();
    for (let hops = 0; frame !== 'map' && hops < 16; hops++) {
      const link = this.frames.get(frame);
      if (!link) return frame === 'base' && this.base ? matrix.premultiply(this.base) : null;
      matrix.premultiply(link.matrix);
      frame = link.parent;
    }
    return frame === 'map' ? matrix : null;
  }

  get robot() {
    return this.place('base');
  }

  // Frames of scanners, with the newest profile where there is a fresh one.
  scanners() {
    const now = performance.now();
    return [...this.frames.keys()].filter((frame) => frame.startsWith('laser')).map((frame) => {
      const scan = this.scans.get(frame);
      return { frame, place: this.place(frame), tilt: this.tiltOf(frame),
        scan: scan && now - scan.at < this.patienceMs ? scan : null };
    });
  }

  // Scanners whose profile is drawn.
  get fresh() {
    return this.scanners().filter(({ scan }) => scan).length;
  }

  // The servo's angle, rad, positive looks down: the turn about y of the frame the scanner is mounted in.
  tiltOf(frame) {
    const mount = this.frames.get(this.frames.get(frame)?.parent);
    if (!mount) return null;
    const e = mount.matrix.elements;
    return Math.atan2(e[8], e[10]);
  }
}

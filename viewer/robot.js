// The robot in the scene: its body, the head that the servo turns, the fan of the current profile and the trail.
import {
  BoxGeometry, BufferAttribute, BufferGeometry, CylinderGeometry, DoubleSide, DynamicDrawUsage, Group, Line,
  LineBasicMaterial, Mesh, MeshBasicMaterial, Points, PointsMaterial, EdgesGeometry, LineSegments, Shape, ShapeGeometry,
} from 'three';
import { ACCENT, LASER, TRAIL, channels } from './colours.js';

const BEAMS_MAX = 4096, TRAIL_MAX = 20000, TRAIL_STEP_M = 0.05, NO_ECHO_M = 0.05;

function box(x, y, z, colour, at) {
  const shape = new BoxGeometry(x, y, z);
  const mesh = new Mesh(shape, new MeshBasicMaterial({ color: colour }));
  mesh.add(new LineSegments(new EdgesGeometry(shape), new LineBasicMaterial({ color: '#0b1016' })));
  mesh.position.set(...at);
  return mesh;
}

// Forward, on the robot's lid.
function arrow() {
  const shape = new Shape();
  shape.moveTo(0.24, 0);
  shape.lineTo(0.02, 0.13);
  shape.lineTo(0.07, 0);
  shape.lineTo(0.02, -0.13);
  const mesh = new Mesh(new ShapeGeometry(shape), new MeshBasicMaterial({ color: ACCENT, side: DoubleSide }));
  mesh.position.z = 0.305;
  return mesh;
}

function body() {
  const group = new Group();
  group.add(box(0.56, 0.4, 0.2, '#e8ecef', [0, 0, 0.2]), arrow());
  for (const x of [-0.18, 0.18])
    for (const y of [-0.22, 0.22]) {
      const wheel = new Mesh(new CylinderGeometry(0.1, 0.1, 0.06, 20), new MeshBasicMaterial({ color: '#2b333c' }));
      wheel.position.set(x, y, 0.1);
      group.add(wheel);
    }
  return group;
}

function fan() {
  const geometry = new BufferGeometry();
  geometry.setAttribute('position', new BufferAttribute(new Float32Array(3 * (BEAMS_MAX + 1)), 3).setUsage(DynamicDrawUsage));
  const index = new Uint16Array(3 * BEAMS_MAX);
  for (let i = 0; i + 1 < BEAMS_MAX; i++) index.set([0, i + 1, i + 2], 3 * i);
  geometry.setIndex(new BufferAttribute(index, 1));
  const mesh = new Mesh(geometry, new MeshBasicMaterial({ color: LASER, transparent: true, opacity: 0.16, side: DoubleSide,
    depthWrite: false }));
  const ends = new BufferGeometry();
  ends.setAttribute('position', new BufferAttribute(new Float32Array(3 * BEAMS_MAX), 3).setUsage(DynamicDrawUsage));
  ends.setAttribute('color', new BufferAttribute(new Float32Array(3 * BEAMS_MAX), 3).setUsage(DynamicDrawUsage));
  mesh.add(new Points(ends, new PointsMaterial({ size: 3.2, sizeAttenuation: false, vertexColors: true })));
  mesh.children[0].frustumCulled = mesh.frustumCulled = false;
  mesh.matrixAutoUpdate = false;
  mesh.renderOrder = 3;
  return mesh;
}

// Puts a profile into its fan, in the scanner's frame. Bright where much comes back, where the scanner tells.
function fill(mesh, { ranges, intensities, start, step, pose }) {
  const fanAt = mesh.geometry.attributes.position, ends = mesh.children[0].geometry.attributes;
  const [r, g, b] = channels(LASER), n = Math.min(ranges.length, BEAMS_MAX);
  const most = intensities.reduce((a, v) => Math.max(a, v), 1);
  let points = 0;
  fanAt.setXYZ(0, 0, 0, 0);
  for (let i = 0; i < n; i++) {
    const range = Number.isFinite(ranges[i]) && ranges[i] > NO_ECHO_M ? ranges[i] : 0;
    const x = range * Math.cos(start + i * step), y = range * Math.sin(start + i * step);
    fanAt.setXYZ(i + 1, x, y, 0);
    if (!range) continue;
    const bright = i < intensities.length ? intensities[i] / most : 0.4;
    ends.position.setXYZ(points, x, y, 0);
    ends.color.setXYZ(points++, r + (1 - r) * bright, g + (1 - g) * bright, b + (1 - b) * bright);
  }
  mesh.geometry.setDrawRange(0, 3 * Math.max(n - 1, 0));
  mesh.children[0].geometry.setDrawRange(0, points);
  for (const attribute of [fanAt, ends.position, ends.color]) attribute.needsUpdate = true;
  mesh.userData.pose = pose;
}

class Trail {
  constructor() {
    const geometry = new BufferGeometry();
    this.at = new BufferAttribute(new Float32Array(3 * TRAIL_MAX), 3).setUsage(DynamicDrawUsage);
    geometry.setAttribute('position', this.at);
    this.line = new Line(geometry, new LineBasicMaterial({ color: TRAIL, depthTest: false, transparent: true, opacity: 0.9 }));
    this.line.frustumCulled = false;
    this.line.renderOrder = 2;
    this.clear();
  }

  clear() {
    this.n = 0;
    this.line.geometry.setDrawRange(0, 0);
  }

  add(x, y, z) {
    const last = this.n - 1;
    if (last >= 0 && Math.hypot(this.at.getX(last) - x, this.at.getY(last) - y, this.at.getZ(last) - z) < TRAIL_STEP_M) return;
    if (this.n === TRAIL_MAX) this.thin();
    this.at.setXYZ(this.n++, x, y, z);
    this.at.needsUpdate = true;
    this.line.geometry.setDrawRange(0, this.n);
  }

  thin() { // every second point of the way goes
    for (let i = 0; 2 * i < this.n; i++) this.at.setXYZ(i, this.at.getX(2 * i), this.at.getY(2 * i), this.at.getZ(2 * i));
    this.n = Math.ceil(this.n / 2);
  }
}

export class Robot {
  constructor() {
    this.group = new Group();
    this.body = body();
    this.body.matrixAutoUpdate = false;
    this.body.visible = false;
    this.trail = new Trail();
    this.heads = new Map(); // frame -> {head, fan, scan}
    this.group.add(this.body, this.trail.line);
    this.shown = { laser: true, robot: true, trail: true };
  }

  head(frame) {
    let made = this.heads.get(frame);
    if (!made) {
      const head = new Group();
      head.add(box(0.12, 0.13, 0.12, '#3a6ea5', [0, 0, 0]), box(0.02, 0.1, 0.03, '#101418', [0.06, 0, 0]));
      head.matrixAutoUpdate = false;
      made = { head, fan: fan(), scan: null };
      this.heads.set(frame, made);
      this.group.add(head, made.fan);
    }
    return made;
  }

  moved({ elements: e }) {
    this.trail.add(e[12], e[13], e[14] + 0.03);
  }

  // Once a frame, from what is known now (live.js).
  update(live) {
    const place = live.robot;
    this.body.visible = !!place && this.shown.robot;
    this.trail.line.visible = this.shown.trail;
    if (place) this.body.matrix.copy(place);
    for (const { head, fan: shape } of this.heads.values()) head.visible = shape.visible = false;
    for (const { frame, place: at, scan } of live.scanners()) {
      if (!at) continue;
      const made = this.head(frame);
      made.head.visible = this.shown.robot;
      made.head.matrix.copy(at);
      made.fan.visible = this.shown.laser && !!scan;
      if (scan && scan !== made.scan) fill(made.fan, scan);
      if (scan) made.fan.matrix.multiplyMatrices(at, scan.pose);
      made.scan = scan;
    }
  }
}

// Picks a point of the map; measures between two. What a picture shows is a face: its patch, plane, class and point.
import { BufferAttribute, BufferGeometry, Group, Line, LineBasicMaterial, Mesh, MeshBasicMaterial, Raycaster,
  SphereGeometry, Vector2, Vector3 } from 'three';
import { CLASSES } from './colours.js';
import { between } from './length.js';
import { isPlane } from './native.js';

export class Picker {
  constructor(map) {
    this.map = map;
    this.ray = new Raycaster();
  }

  // `x`, `y`: -1..1 on the screen; `backs`: also sides that face away. Null: nothing is there.
  pick(x, y, camera, section, backs) {
    this.ray.setFromCamera(new Vector2(x, y), camera);
    const hits = this.ray.intersectObjects(this.map.group.children, false);
    const { direction } = this.ray.ray;
    const hit = hits.find(({ point, face }) => point.z <= section && (backs || face.normal.dot(direction) <= 0));
    if (!hit) return null;
    const found = this.map.faceOf(hit);
    return found && { point: hit.point, normal: hit.face.normal.clone(), ...found };
  }
}

export function tell({ patch, plane, class: kind, point, normal }, planes) {
  const known = planes.get(plane);
  const axis = ['x', 'y', 'z'].map((a) => normal[a].toFixed(2)).join(' ');
  return [
    ['Point', ['x', 'y', 'z'].map((a) => point[a].toFixed(2)).join('  ') + ' m'],
    ['Class', CLASSES[kind] ?? `${kind}`],
    ['Plane', isPlane(plane) ? `${plane}` + (known ? `, ${known.area.toFixed(1)} m²` : '') : 'none'],
    ['Normal', axis],
    ['Patch', `${patch.key.join(', ')} · ${patch.triangles} triangles`],
    ['Seen', `${new Date(patch.last * 1000).toLocaleTimeString()} · step ${patch.version}`],
  ];
}

export class Measure {
  constructor() {
    this.group = new Group();
    this.points = [];
    const geometry = new BufferGeometry();
    geometry.setAttribute('position', new BufferAttribute(new Float32Array(6), 3));
    this.line = new Line(geometry, new LineBasicMaterial({ color: '#ffffff', depthTest: false, transparent: true }));
    this.line.frustumCulled = false;
    this.dots = [0, 1].map(() => new Mesh(new SphereGeometry(1, 16, 12),
      new MeshBasicMaterial({ color: '#ffffff', depthTest: false, transparent: true })));
    for (const object of [this.line, ...this.dots]) {
      object.renderOrder = 5;
      object.visible = false;
      this.group.add(object);
    }
  }

  // The first point, the second; the third begins again.
  add(point) {
    if (this.points.length === 2) this.points = [];
    this.points.push(point.clone());
    this.show();
    return this.result;
  }

  // A pick that is no measurement: one mark.
  mark(point) {
    this.points = point ? [point.clone()] : [];
    this.show();
  }

  clear() {
    this.points = [];
    this.show();
  }

  get result() {
    return this.points.length === 2 ? between(...this.points) : null;
  }

  show() {
    const at = this.line.geometry.attributes.position;
    this.points.forEach((point, i) => {
      this.dots[i].position.copy(point);
      at.setXYZ(i, point.x, point.y, point.z);
    });
    at.needsUpdate = true;
    this.dots.forEach((dot, i) => (dot.visible = i < this.points.length));
    this.line.visible = this.points.length === 2;
  }

  // Dots keep their size on the screen; answers where the label belongs (pixels), or null.
  update(camera, width, height) {
    for (const dot of this.dots) {
      const away = camera.isPerspectiveCamera ? camera.position.distanceTo(dot.position) * 0.006
        : ((camera.top - camera.bottom) / camera.zoom) * 0.008;
      dot.scale.setScalar(away);
    }
    if (!this.result) return null;
    const middle = new Vector3().addVectors(...this.points).multiplyScalar(0.5).project(camera);
    return middle.z < 1 ? { x: ((middle.x + 1) / 2) * width, y: ((1 - middle.y) / 2) * height } : null;
  }
}

// The map in the scene. Changed patches make their chunks dirty; what is dirty is taken as it stands at one commit (a
// stage), its arrays are built within a time budget a frame, nearest chunk first, and the stage is shown whole: never a
// crack, never a long frame. The first map, and a stage that takes too long, are shown chunk by chunk.
import { BufferAttribute, BufferGeometry, Box3, Group, Mesh, Sphere, Vector3 } from 'three';
import { PATCHES, PATCH_UNITS, buildChunk, chunkKeyOf } from './chunk.js';
import { mainBody } from './extent.js';
import { nameOf } from './mirror.js';
import { SMOOTH } from './colours.js';
import { mapMaterial } from './shader.js';

const BUDGET_MS = 5, FIRST_MS = 25, PATIENCE_MS = 250;

export class MapScene {
  constructor() {
    this.group = new Group();
    this.material = mapMaterial();
    this.chunks = new Map(); // name -> {key, patches, mesh}
    this.dirty = new Set(); // names
    this.stage = null; // {waiting: [{chunk, patches, around}], ready: [{chunk, arrays}], since}
    this.cell = 0.05;
    this.epoch = null; // s; stamps count from here
    this.latest = 0;
    this.whole = false; // a first map was committed
    this.bounds = new Box3(); // of what is drawn
    this.frame = new Box3(); // of what a picture should show
    this.points = []; // the middles of its patches
    this.measured = 0; // patches, then
    this.drawn = 0; // triangles
  }

  get mode() {
    return this.material.uniforms.mode.value;
  }

  setMode(mode) {
    const smooth = (mode === SMOOTH) !== (this.mode === SMOOTH);
    this.material.uniforms.mode.value = mode;
    if (smooth) for (const name of this.chunks.keys()) this.dirty.add(name);
  }

  // The mirror's report of one patch.
  show(name, key, patch) {
    const chunkKey = chunkKeyOf(key), chunkName = nameOf(chunkKey);
    let chunk = this.chunks.get(chunkName);
    if (!chunk) {
      chunk = { key: chunkKey, patches: new Map(), mesh: null };
      this.chunks.set(chunkName, chunk);
    }
    if (patch) {
      chunk.patches.set(name, patch);
      this.epoch ??= Math.floor(patch.first);
      this.latest = Math.max(this.latest, patch.last);
    } else {
      chunk.patches.delete(name);
    }
    this.dirty.add(chunkName);
  }

  clear() {
    for (const chunk of this.chunks.values()) this.discard(chunk);
    this.chunks.clear();
    this.dirty.clear();
    this.stage = null;
    this.epoch = null;
    this.latest = 0;
    this.drawn = 0;
    this.whole = false;
    this.bounds.makeEmpty();
    this.frame.makeEmpty();
    this.measured = 0;
  }

  discard(chunk) {
    if (!chunk.mesh) return;
    this.group.remove(chunk.mesh);
    chunk.mesh.geometry.dispose();
    this.drawn -= chunk.mesh.userData.triangles;
    chunk.mesh = null;
  }

  // Once a frame that took `dt` s. `whole`: the mirror stands at a commit, so what is dirty fits together. True when
  // something changed. Where frames are slow anyway the budget is a fifth of them.
  update(whole, eye, dt) {
    const budgetMs = dt === Infinity ? dt
      : this.whole ? Math.max(BUDGET_MS, Math.min(200 * dt, 50)) : Math.max(FIRST_MS, Math.min(500 * dt, 400));
    if (!this.stage && this.dirty.size && (whole || !this.whole)) this.begin(eye);
    if (!this.stage) return false;
    const { stage } = this, begun = performance.now();
    while (stage.waiting.length && performance.now() - begun < budgetMs) {
      const { chunk, patches, around } = stage.waiting.pop();
      stage.ready.push({ chunk, patches, arrays: buildChunk(patches, around, chunk.key, this.epoch) });
    }
    const late = begun - stage.since > PATIENCE_MS;
    if (stage.waiting.length && this.whole && !late) return false;
    for (const { chunk, patches, arrays } of stage.ready) this.swap(chunk, patches, arrays);
    stage.ready = [];
    if (!stage.waiting.length) {
      this.stage = null;
      if (whole && !this.dirty.size) this.whole = true;
    }
    return true;
  }

  begin(eye) {
    const waiting = [];
    for (const name of this.dirty) {
      const chunk = this.chunks.get(name);
      const patches = [...chunk.patches.values()];
      waiting.push({ chunk, patches, around: this.mode === SMOOTH ? this.around(chunk) : null,
        far: this.centre(chunk.key).distanceToSquared(eye) });
    }
    this.dirty.clear();
    waiting.sort((a, b) => b.far - a.far); // the nearest is popped first
    this.stage = { waiting, ready: [], since: performance.now() };
  }

  centre(key) {
    return new Vector3(...key).addScalar(0.5).multiplyScalar(PATCHES * (PATCH_UNITS / 256) * this.cell);
  }

  // The chunk's patches and those that touch it.
  around(chunk) {
    const low = chunk.key.map((k) => k * PATCHES - 1), high = chunk.key.map((k) => (k + 1) * PATCHES), found = [];
    for (let x = -1; x <= 1; x++)
      for (let y = -1; y <= 1; y++)
        for (let z = -1; z <= 1; z++) {
          const other = this.chunks.get(nameOf([chunk.key[0] + x, chunk.key[1] + y, chunk.key[2] + z]));
          for (const patch of other?.patches.values() ?? [])
            if (patch.key.every((k, axis) => k >= low[axis] && k <= high[axis])) found.push(patch);
        }
    return found;
  }

  swap(chunk, patches, arrays) {
    this.discard(chunk);
    if (!arrays.vertices) {
      if (!chunk.patches.size) this.chunks.delete(nameOf(chunk.key));
      return;
    }
    const geometry = new BufferGeometry();
    geometry.setAttribute('position', new BufferAttribute(arrays.position, 4));
    geometry.setAttribute('tag', new BufferAttribute(arrays.tag, 4));
    geometry.setAttribute('stamp', new BufferAttribute(arrays.stamp, 1));
    if (arrays.normal) geometry.setAttribute('normal', new BufferAttribute(arrays.normal, 4));
    const half = (PATCHES * PATCH_UNITS) / 2;
    geometry.boundingSphere = new Sphere(new Vector3(half, half, half), half * Math.sqrt(3));
    const mesh = new Mesh(geometry, this.material);
    mesh.position.set(...chunk.key).multiplyScalar(PATCHES * (PATCH_UNITS / 256) * this.cell);
    mesh.scale.setScalar(this.cell / 256);
    mesh.updateMatrix();
    mesh.matrixAutoUpdate = false;
    mesh.userData = { patches, triangles: arrays.vertices / 3 };
    chunk.mesh = mesh;
    this.drawn += mesh.userData.triangles;
    this.group.add(mesh);
    this.grow(mesh, arrays);
  }

  grow(mesh, { position, vertices }) {
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (let i = 0; i < vertices; i++)
      for (let axis = 0; axis < 3; axis++) {
        const p = position[4 * i + axis];
        if (p < low[axis]) low[axis] = p;
        if (p > high[axis]) high[axis] = p;
      }
    const box = new Box3(new Vector3(...low), new Vector3(...high));
    mesh.userData.box = box.applyMatrix4(mesh.matrix);
    this.bounds.union(box);
  }

  // What a picture should show: the patches that hang together, without specks that were seen through a window.
  measure(patches) {
    if (this.bounds.isEmpty() || patches.size === this.measured) return;
    this.measured = patches.size;
    const side = (PATCH_UNITS / 256) * this.cell;
    const { low, high, keys } = mainBody([...patches.values()].map(({ key }) => key));
    this.frame.set(new Vector3(...low).multiplyScalar(side), new Vector3(...high).addScalar(1).multiplyScalar(side));
    this.frame.intersect(this.bounds);
    this.points = keys.map((key) => new Vector3(...key).addScalar(0.5).multiplyScalar(side));
  }

  // Which patch, plane and class a hit of the raycaster is on.
  faceOf({ object, faceIndex }) {
    let left = faceIndex;
    for (const patch of object.userData.patches) {
      if (left < patch.triangles) return { patch, plane: patch.planes[left], class: patch.classes[left], face: left };
      left -= patch.triangles;
    }
    return null;
  }

  // The shader's clock and scale.
  prepare(eye, t) {
    const { uniforms } = this.material;
    uniforms.eye.value.copy(eye);
    uniforms.now.value = t - (this.epoch ?? t);
    uniforms.ageSpan.value = Math.min(Math.max(uniforms.now.value, 10), 600);
    if (!this.frame.isEmpty()) uniforms.heights.value.set(this.frame.min.z, this.frame.max.z);
  }
}

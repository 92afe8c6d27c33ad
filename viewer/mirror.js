// The map as of the last COMMIT. Batches are transactional: what came since BEGIN is put aside and takes effect whole, so
// that no crack is ever shown. Only the first map, while nothing is held yet, is shown as it comes: a picture soon.
// `show(name, patch | null, before)` hears of each patch that came, changed or went.
import * as native from './native.js';

export const nameOf = (key) => key.join(',');

export class Mirror {
  constructor(show) {
    this.show = show;
    this.patches = new Map(); // name -> patch
    this.planes = new Map(); // id -> plane
    this.hello = null;
    this.step = 0;
    this.triangles = 0;
    this.commits = 0;
    this.batch = null;
  }

  // A new connection: what is held stays in sight until the new map is whole.
  reconnect() {
    this.batch = null;
  }

  take(type, payload) {
    switch (type) {
      case native.HELLO: this.hello = native.readHello(payload); break;
      case native.BEGIN: this.begin(native.readBegin(payload)); break;
      case native.PATCH: this.put(native.readPatch(payload)); break;
      case native.REMOVE: this.batch?.changes.set(nameOf(native.readKey(payload)), null); break;
      case native.PLANE: this.plane(native.readPlane(payload)); break;
      case native.PLANE_GONE: this.planes.delete(native.readId(payload)); break;
      case native.COMMIT: this.commit(native.readStep(payload)); break;
      case native.ABORT: this.batch = null; break;
      default: break; // later versions add types
    }
  }

  begin({ step, reset }) {
    if (reset) this.planes.clear();
    this.batch = { step, reset, changes: new Map(), early: reset && this.patches.size === 0 };
  }

  put(patch) {
    if (!this.batch) throw new Error('a PATCH outside a batch');
    const name = nameOf(patch.key);
    if (this.batch.early) this.set(name, patch);
    this.batch.changes.set(name, patch);
  }

  plane(plane) {
    this.planes.set(plane.id, plane);
  }

  commit(step) {
    const { batch } = this;
    if (!batch || batch.step !== step) throw new Error(`a COMMIT of step ${step} that was not begun`);
    if (batch.reset) for (const name of [...this.patches.keys()]) if (!batch.changes.has(name)) this.set(name, null);
    if (!batch.early) for (const [name, patch] of batch.changes) this.set(name, patch);
    this.batch = null;
    this.step = step;
    this.commits++;
  }

  set(name, patch) {
    const before = this.patches.get(name);
    this.triangles += (patch?.triangles ?? 0) - (before?.triangles ?? 0);
    if (patch) this.patches.set(name, patch);
    else this.patches.delete(name);
    if (patch || before) this.show(name, patch, before);
  }
}

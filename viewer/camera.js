// Three ways to look: free (turn, pan, zoom), follow (the same, about the robot), top (a plan: north stays up). Until a
// person touches it the camera frames the whole map, as it grows.
import { MOUSE, OrthographicCamera, PerspectiveCamera, TOUCH, Vector3 } from 'three';
import { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';

const VIEW = new Vector3(-0.62, -0.85, 0.98).normalize(); // from the south-west, above
const EASE_S = 0.25, MARGIN = 0.1;
const THERE_M = 0.001; // nobody sees a glide's last millimetre, and each of its pictures would be made

const glide = (from, to, share) => from.lerp(to, from.distanceTo(to) < THERE_M ? 1 : share);

export class Camera {
  constructor(element, still) {
    this.element = element;
    this.free = new PerspectiveCamera(42, 1, 0.05, 2000);
    this.top = new OrthographicCamera(-1, 1, 1, -1, 0.1, 4000);
    this.free.up.set(0, 0, 1);
    this.top.up.set(0, 1, 0);
    this.free.position.copy(VIEW).multiplyScalar(14);
    this.turn = new OrbitControls(this.free, element);
    this.plan = new OrbitControls(this.top, element);
    this.plan.enableRotate = false;
    this.plan.mouseButtons = { LEFT: MOUSE.PAN, MIDDLE: MOUSE.DOLLY, RIGHT: MOUSE.PAN };
    this.plan.touches = { ONE: TOUCH.PAN, TWO: TOUCH.DOLLY_PAN };
    this.plan.screenSpacePanning = true;
    for (const controls of [this.turn, this.plan]) {
      controls.enableDamping = !still;
      controls.dampingFactor = 0.12;
      controls.zoomToCursor = true;
      controls.addEventListener('start', () => (this.touched = true));
    }
    this.turn.maxPolarAngle = Math.PI * 0.94;
    this.turn.minDistance = 0.3;
    this.still = still;
    this.touched = false;
    this.robot = null;
    this.spread = 8; // m from side to side, of the plan
    this.setMode('free');
  }

  get current() {
    return this.mode === 'top' ? this.top : this.free;
  }

  setMode(mode) {
    this.mode = mode;
    this.turn.enabled = mode !== 'top';
    this.plan.enabled = mode === 'top';
    this.touched = mode === 'follow';
    if (mode === 'follow' && this.robot) this.approach = 1;
  }

  // Frames the map again.
  home() {
    if (this.mode === 'follow') this.setMode('free');
    this.touched = false;
    this.top.zoom = 1;
  }

  // `aside`: pixels on the right that the panel covers; the picture's middle is that of the rest.
  resize(width, height, aside) {
    this.free.aspect = width / height;
    this.ratio = (width - aside) / height;
    this.wide = width / (width - aside);
    for (const camera of [this.free, this.top]) camera.setViewOffset(width, height, aside / 2, 0, width, height);
    this.frameTop();
  }

  frameTop() {
    const half = this.spread / 2, [x, y] = this.ratio > 1 ? [half * this.ratio, half] : [half, half / this.ratio];
    Object.assign(this.top, { left: -x * this.wide, right: x * this.wide, top: y, bottom: -y });
    this.top.updateProjectionMatrix();
  }

  // Of the plan.
  metresPerPixel(height) {
    return (this.top.top - this.top.bottom) / this.top.zoom / height;
  }

  // `robot`: where it is (a Vector3) or null; `bounds` of the map, `points` all over it; `dt` since the last frame, s.
  update(bounds, points, robot, dt) {
    if (!this.touched && points.length) this.frame(bounds, points, this.still ? 1 : 1 - Math.exp(-dt / EASE_S));
    if (this.mode === 'follow' && robot) this.follow(robot, dt);
    this.robot = robot?.clone() ?? null;
    (this.mode === 'top' ? this.plan : this.turn).update(dt);
  }

  frame(bounds, points, share) {
    const centre = bounds.getCenter(new Vector3());
    if (this.mode === 'top') {
      const size = bounds.getSize(new Vector3());
      const spread = 1.12 * Math.max(4, this.ratio > 1 ? Math.max(size.y, size.x / this.ratio)
        : Math.max(size.x, size.y * this.ratio));
      this.spread += (spread - this.spread) * (Math.abs(spread - this.spread) < THERE_M ? 1 : share);
      this.frameTop();
      glide(this.plan.target, centre, share);
      this.top.position.copy(this.plan.target).setZ(bounds.max.z + 100);
      return;
    }
    const { eye, target } = this.standFor(points, centre);
    glide(this.turn.target, target, share);
    glide(this.free.position, eye, share);
  }

  // The nearest place from which all points are in sight along VIEW: each says how far aside the eye may be, by its depth.
  standFor(points, centre) {
    const right = new Vector3(-VIEW.y, VIEW.x, 0).normalize(), up = new Vector3().crossVectors(VIEW, right);
    const tanY = Math.tan((this.free.fov * Math.PI) / 360) * (1 - MARGIN), tanX = tanY * this.ratio;
    const fit = (axis, tan) => {
      let low = -Infinity, high = Infinity;
      for (const point of points) {
        low = Math.max(low, point.dot(axis) + tan * point.dot(VIEW));
        high = Math.min(high, point.dot(axis) - tan * point.dot(VIEW));
      }
      return { away: (low - high) / (2 * tan), aside: (low + high) / 2 };
    };
    const x = fit(right, tanX), y = fit(up, tanY), depth = centre.dot(VIEW);
    const away = Math.max(x.away, y.away, depth + 4);
    const eye = VIEW.clone().multiplyScalar(away).addScaledVector(right, x.aside).addScaledVector(up, y.aside);
    return { eye, target: eye.clone().addScaledVector(VIEW, depth - away) };
  }

  follow(robot, dt) {
    const share = this.robot && !this.approach ? 1 : 1 - Math.exp(-dt / EASE_S);
    const step = robot.clone().sub(this.turn.target).multiplyScalar(share);
    this.turn.target.add(step);
    this.free.position.add(step);
    if (this.approach) {
      const arm = this.free.position.clone().sub(this.turn.target), length = arm.length();
      this.free.position.copy(this.turn.target).addScaledVector(arm, 1 + (Math.min(length, 7) / length - 1) * share);
      if (Math.abs(length - Math.min(length, 7)) < 0.1 && step.length() < 0.02) this.approach = 0;
    }
  }
}

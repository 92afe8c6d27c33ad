// The ground under the map: lines each metre and each five, fading out; it tells scale where nothing is mapped yet.
import { DoubleSide, Mesh, PlaneGeometry, ShaderMaterial, Vector3 } from 'three';

const vertexShader = `
varying vec3 at;
void main() {
  at = (modelMatrix * vec4(position, 1.0)).xyz;
  gl_Position = projectionMatrix * viewMatrix * vec4(at, 1.0);
}`;
const fragmentShader = `
varying vec3 at;
uniform vec3 centre;
uniform float reach;
float lines(float every, float width) {
  vec2 p = at.xy / every, pixel = fwidth(p);
  vec2 near = abs(fract(p - 0.5) - 0.5) / max(pixel, 1e-6);
  return (1.0 - min(min(near.x, near.y) / width, 1.0)) * clamp(0.35 / max(pixel.x, pixel.y), 0.0, 1.0);
}
void main() {
  float fade = 1.0 - smoothstep(0.35, 1.0, length(at.xy - centre.xy) / reach);
  float line = max(0.35 * lines(1.0, 1.0), 0.75 * lines(5.0, 1.3));
  gl_FragColor = vec4(0.50, 0.60, 0.68, 0.42 * line * fade);
}`;

export class Grid {
  constructor() {
    this.mesh = new Mesh(new PlaneGeometry(1, 1), new ShaderMaterial({ vertexShader, fragmentShader, transparent: true,
      depthWrite: false, side: DoubleSide, uniforms: { centre: { value: new Vector3() }, reach: { value: 20 } } }));
    this.mesh.renderOrder = -1;
    this.mesh.frustumCulled = false;
  }

  update(bounds) {
    const { centre, reach } = this.mesh.material.uniforms;
    if (bounds.isEmpty()) {
      centre.value.set(0, 0, 0);
      reach.value = 20;
    } else {
      bounds.getCenter(centre.value).setZ(bounds.min.z - 0.03);
      const size = bounds.getSize(new Vector3());
      reach.value = Math.max(20, 1.1 * Math.hypot(size.x, size.y));
    }
    this.mesh.position.copy(centre.value);
    this.mesh.scale.setScalar(2 * reach.value);
  }
}
